"""Orthophotos: the bands that are red, green and blue, their scale to 8 bits, and where the picture is valid."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.scene.raster import Grid, RasterWindow, onto, opened

_COLOURS = ("red", "green", "blue")
# Levels from black or white of a collar that lossy compression changed; the default of GDAL's `nearblack`.
COLLAR = 15


def read_colour(
    path: Path,
    bands: Sequence[int] | None = None,
    colour_range: tuple[float, float] | None = None,
    collar: int = 0,
    part: RasterWindow | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return (rgb (h, w, 3) uint8, valid (h, w) bool) of an orthophoto.

    `bands` are the numbers of red, green and blue, from 1, by default the declared ones. `colour_range` becomes 0 and
    255 and is needed for other than 8 bits. A border within `collar` levels of black or white is empty, but for that of
    a RasterWindow in the file.
    """
    with opened(path, part is not None) as dataset:
        names = [each.name for each in dataset.colorinterp]
        if dataset.count == 1 and names == ["palette"] and bands is None:
            rgb, valid = _of_palette(dataset, part)
        else:
            chosen = list(bands or _declared(path, dataset, names))
            if len(chosen) != 3 or not all(1 <= band <= dataset.count for band in chosen):
                raise ThermorenderError(
                    f"bands={','.join(map(str, chosen))} of {path} are not allowed; give the numbers of the red, green "
                    f"and blue band, 1…{dataset.count}"
                )
            options = part.options(len(chosen)) if part else {}
            values = dataset.read(chosen, **options)
            scales = [(dataset.scales[band - 1], dataset.offsets[band - 1]) for band in chosen]
            valid = (dataset.read_masks(chosen, **_nearest(options)) > 0).any(axis=0)
            if values.dtype.kind == "f":
                valid &= np.isfinite(values).all(axis=0)
            if "alpha" in names:
                valid &= _opaque(path, dataset, names, part)
            rgb = np.ascontiguousarray(np.moveaxis(_in_8_bits(path, values, scales, colour_range, valid), 0, -1))
    return rgb, valid if part and not part.whole else valid & ~empty_border(rgb, collar)


def resampled(
    rgb: NDArray[np.uint8], valid: NDArray[np.bool_], grid: Grid, target: Grid, resampling: str
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return (rgb (h, w, 3), valid (h, w)) on another grid; colours that are not valid do not bleed into others."""
    if valid.all():
        # In bytes, a third of the time.
        shown = onto(valid.astype(np.uint8), grid, target, resampling) > 0
        return np.where(shown[..., None], onto(rgb, grid, target, resampling), 0), shown
    weight = np.nan_to_num(onto(valid.astype(np.float32), grid, target, resampling))
    filtered = onto(rgb * valid[..., None].astype(np.float32), grid, target, resampling)
    valid = weight > 0.5
    mean = np.where(valid[..., None], filtered / np.maximum(weight, 1e-6)[..., None], 0.0)
    return np.clip(np.rint(np.nan_to_num(mean)), 0, 255).astype(np.uint8), valid


def _nearest(options: dict[str, Any]) -> dict[str, Any]:
    """Options of reading a RasterWindow without means: of masks and of palettes."""
    return {name: value for name, value in options.items() if name != "resampling"}


def _declared(path: Path, dataset: Any, names: list[str]) -> list[int]:
    """Numbers of the bands that colour interpretation or descriptions declare red, green and blue."""
    words = [(text or "").strip().lower() for text in dataset.descriptions]
    if dataset.count < 3:
        raise ThermorenderError(
            f"{path} has {dataset.count} bands of {dataset.dtypes[0]} ({', '.join(names)}); an orthophoto needs red, "
            "green and blue (RGB), so give one in colour, or none"
        )
    found = [[k + 1 for k, name in enumerate(kind) if name == colour] for kind in (names, words) for colour in _COLOURS]
    by_colour, by_word = found[:3], found[3:]
    whole = [all(len(each) == 1 for each in kind) for kind in (by_colour, by_word)]
    if all(whole) and by_colour != by_word:
        listed = [", ".join(f"band {each[0]}" for each in kind) for kind in (by_colour, by_word)]
        raise ThermorenderError(
            f"{path} contradicts itself: red, green and blue are {listed[0]} by colour interpretation and {listed[1]} "
            "by name; give --bands RED,GREEN,BLUE to import-terrain"
        )
    if not any(whole):
        declared = ",".join((*_COLOURS, *["undefined"] * (dataset.count - 3)))
        command = f", or declare them with `rio edit-info --colorinterp {declared} FILE`"
        # A command cut short would not work.
        or_declare = command if dataset.count <= 16 else ""
        raise ThermorenderError(
            f"{path} does not declare which of its {dataset.count} bands are red, green and blue (colour "
            f"interpretation {shortened(', '.join(names))}); give --bands RED,GREEN,BLUE to import-terrain{or_declare}"
        )
    return [each[0] for each in (by_colour if whole[0] else by_word)]


def _opaque(path: Path, dataset: Any, names: list[str], part: RasterWindow | None) -> NDArray[np.bool_]:
    """Where the band that is declared alpha is at least half opaque."""
    alpha = dataset.read(names.index("alpha") + 1, **_nearest(part.options() if part else {}))
    highest = np.iinfo(alpha.dtype).max if alpha.dtype.kind in "iu" else 1.0
    between = float(((alpha > 0.04 * highest) & (alpha < 0.96 * highest)).mean())
    if between > 0.5:
        raise ThermorenderError(
            f"{path} declares band {names.index('alpha') + 1} as alpha, but {between:.0%} of it is half transparent; "
            "if it is another band, such as near infrared, declare that: `rio edit-info --colorinterp "
            f"{','.join('undefined' if name == 'alpha' else name for name in names)} FILE`"
        )
    opaque: NDArray[np.bool_] = alpha >= 0.5 * highest
    return opaque


def _of_palette(dataset: Any, part: RasterWindow | None) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    options = _nearest(part.options() if part else {})
    index = dataset.read(1, **options)
    table = np.zeros((int(np.iinfo(index.dtype).max) + 1, 4), np.uint8)
    for number, colour in dataset.colormap(1).items():
        table[number] = colour
    return np.ascontiguousarray(table[index, :3]), (dataset.read_masks(1, **options) > 0) & (table[index, 3] > 127)


def _in_8_bits(
    path: Path, values: NDArray[Any], scales: Sequence[tuple[float, float]],
    colour_range: tuple[float, float] | None, valid: NDArray[np.bool_],
) -> NDArray[np.uint8]:  # fmt: skip
    """Bands (3, h, w) in 0…255; `colour_range` is in the units of the file's scale and offset tags."""
    plain = all(scale == (1.0, 0.0) for scale in scales)
    if values.dtype == np.uint8 and plain and colour_range is None:
        return values
    if values.dtype.kind not in "iuf":
        raise ThermorenderError(f"{path} holds {values.dtype}; give integers or real numbers")
    step, zero = (np.array(each, np.float32)[:, None, None] for each in zip(*scales, strict=True))
    scaled = values * step + zero
    if colour_range is None:
        known = scaled[:, valid]
        reach = f"{known.min():.6g}…{known.max():.6g}" if known.size else "nothing"
        raise ThermorenderError(
            f"{path} has bands of {values.dtype} that hold {reach}; an orthophoto needs the values of black and white, "
            "so give --colour-range BLACK,WHITE to import-terrain, e.g. 0,4095 for 12 bits"
        )
    low, high = colour_range
    if not (np.isfinite([low, high]).all() and low < high):
        raise ThermorenderError(f"colour_range={low:g},{high:g} is not allowed; give black below white")
    level = np.nan_to_num((scaled - np.float32(low)) * np.float32(255.0 / (high - low)))
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


def empty_border(rgb: NDArray[np.uint8], collar: int = 0) -> NDArray[np.bool_]:
    """Return where an orthophoto is empty, (h, w): areas connected to its edge within `collar` of black or white."""
    from scipy.ndimage import label

    empty = np.zeros(rgb.shape[:2], dtype=bool)
    # The darkest and the lightest colour; a reduction over the last axis would take ten times as long.
    red, green, blue = np.moveaxis(rgb, -1, 0)
    least, most = np.minimum(np.minimum(red, green), blue), np.maximum(np.maximum(red, green), blue)
    for flat in (most <= collar, least >= 255 - collar):
        if flat[0].any() or flat[-1].any() or flat[:, 0].any() or flat[:, -1].any():
            areas, count = label(flat)
            edge = np.concatenate([areas[0], areas[-1], areas[:, 0], areas[:, -1]])
            touching = np.bincount(edge, minlength=count + 1)
            # A few such pixels on the edge are image content, not border.
            large = np.bincount(areas.ravel(), minlength=count + 1) >= 64
            keep = (touching > 0) & large
            keep[0] = False
            empty |= keep[areas]
    return empty
