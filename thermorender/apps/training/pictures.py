"""Picture files of a data set: which files form pairs and sequences, and reading them.

A thermal file is an 8-bit picture, a 16-bit one, or a TIFF or other file of temperatures, of one frame. Temperatures
become 16-bit values of 0.01 K; values of unknown scale stay unchanged.
"""

import re
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.formats import decoded, picture_tags
from thermorender.sensor.radiometric_files import (
    kelvin_of_counts,
    likely_scales,
    margin_values,
    orientation,
    read_tiff,
    scale_request,
)
from thermorender.sensor.thermal_files import is_radiometric, read_thermal_image, sequence_hint
from thermorender.units import ZERO_CELSIUS_K, kelvin

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".irg")
# Step of stored temperatures [K]; 16 bits reach 655.35 K.
STEP_K = 0.01
# Smallest accepted side of a picture [px].
LEAST_SIDE = 16
# Number of files that a message names.
_NAMED = 8
# A landscape's median above this is in kelvin, not °C.
_HOT_C = 150.0


@dataclass(frozen=True)
class Files:
    """A visible and a thermal file of the same view, and their mask."""

    name: str  # Common part of their names
    visible: Path
    thermal: Path
    valid: Path | None = None


@dataclass(frozen=True, eq=False)
class Thermal:
    """A thermal picture."""

    values: NDArray[np.uint8] | NDArray[np.uint16]  # (H, W) uint8
    unit: str  # Hundredths of a kelvin, or counts of unknown scale
    valid: NDArray[np.bool_]  # (H, W) bool false where the file has no value, or one out of range


def matched(
    visible_folder: str | Path, thermal_folder: str | Path, visible: str = "*", thermal: str = "*",
    valid: str | None = None,
) -> tuple[list[Files], list[str]]:  # fmt: skip
    """Return the Files of two folders that share a name, sorted by name, and the names without a partner.

    `visible` and `thermal` are patterns such as *_rgb.png; what their wildcards match is the pair's name. `valid` is
    the pattern of masks in the visible folder, non-zero where both pictures show the same.
    """
    found = _named(visible_folder, visible, "visible"), _named(thermal_folder, thermal, "thermal")
    masks = _named(visible_folder, valid, "valid") if valid else {}
    names = sorted(found[0].keys() & found[1].keys(), key=_by_number)
    if not names:
        raise ThermorenderError(
            f"no file of {visible_folder} ({visible}) shares its name with one in {thermal_folder} ({thermal}): there "
            f"are {listed(found[0])} and {listed(found[1])}; give --visible and --thermal with * for the common part"
        )
    if masks:
        lacking = [name for name in names if name not in masks]
        if lacking:
            raise ThermorenderError(f"mask ({valid}) is missing for {listed(lacking)}; add it, or leave out --valid")
    pairs = [Files(name, found[0][name], found[1][name], masks.get(name)) for name in names]
    return pairs, sorted(found[0].keys() ^ found[1].keys(), key=_by_number)


def read_visible(path: str | Path) -> tuple[NDArray[np.uint8], bool]:
    """Return ((H, W, 3) uint8 sRGB, whether it is grey) of a visible picture."""
    image = _decoded(path)
    if image.dtype != np.uint8:
        raise ThermorenderError(f"{path} has {image.dtype} values; give 8-bit visible pictures")
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=-1)
    # Without alpha; OpenCV orders blue, green, red.
    image = np.ascontiguousarray(image[..., 2::-1])
    _check_content(path, image)
    return image, bool((image[..., 0] == image[..., 1]).all() and (image[..., 1] == image[..., 2]).all())


def read_thermal(path: str | Path, scale: Sequence[float] | None = None, intensity: bool = False) -> Thermal:
    """Return the Thermal picture of a file.

    `scale` is (kelvin per count, kelvin of count 0) where undeclared. `intensity` takes 16 bits without a scale as
    intensities.
    """
    path = Path(path)
    if path.suffix.lower() in (".tif", ".tiff"):
        found = _of_tiff(path, scale, intensity)
    elif is_radiometric(path):
        # Apparent temperature, before any correction for surface and air.
        found = _of_kelvin(_upright(read_thermal_image(path, correction="nothing").kelvin, path))
    else:
        image = _decoded(path)
        if image.ndim == 3:
            if image.shape[2] > 3 or (image != image[..., :1]).any():
                raise ThermorenderError(
                    f"{path} is a thermal picture in colours, whose palette cannot be undone; give grey values, a TIFF "
                    "or the camera's radiometric JPEG"
                )
            image = image[..., 0]
        if image.dtype not in (np.uint8, np.uint16):
            raise ThermorenderError(f"{path} has {image.dtype} values; give 8 or 16 bits")
        found = _of_counts(path, image.astype(np.float64), scale, intensity, image.dtype.name)
    if not found.valid.any():
        raise ThermorenderError(f"{path} has no temperature between 0 and {65535 * STEP_K:.2f} K; leave it out")
    if found.unit == "kelvin":
        kelvin(f"the median temperature of {path}", STEP_K * float(np.median(found.values[found.valid])))
    _check_content(path, found.values, found.values[found.valid])
    return found


def read_valid(path: str | Path, shape: Sequence[int]) -> NDArray[np.bool_]:
    """Return (H, W) bool, where a mask is not zero."""
    image = _decoded(path)
    if image.shape[:2] != tuple(shape):
        raise ThermorenderError(
            f"mask {path} is {image.shape[1]}×{image.shape[0]} pixels and its visible picture {shape[1]}×{shape[0]}; "
            "give masks of the same size"
        )
    return np.asarray(image > 0 if image.ndim == 2 else (image > 0).any(axis=-1))


def place_of(path: str | Path) -> tuple[float, float] | None:
    """Return (latitude, longitude) [deg] from a picture's EXIF, None without valid coordinates."""
    try:
        _, _, gps, _ = picture_tags(path)
        degrees = [float(gps[tag][0]) + float(gps[tag][1]) / 60.0 + float(gps[tag][2]) / 3600.0 for tag in (2, 4)]
        signs = (-1.0 if gps[1] == "S" else 1.0, -1.0 if gps[3] == "W" else 1.0)
        latitude, longitude = (round(sign * value, 7) for sign, value in zip(signs, degrees, strict=True))
    except (KeyError, ValueError, TypeError, IndexError, ZeroDivisionError):
        return None
    return (latitude, longitude) if abs(latitude) <= 90.0 and abs(longitude) <= 180.0 else None


def listed(names: Iterable[str]) -> str:
    """Return names joined for a sentence, shortened to the first few."""
    names = list(names)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def keys_of(pairs: Sequence[Files]) -> dict[str, str]:
    """Return {name: key in a data set} of pairs; refuse names that become the same key."""
    keys = {pair.name: re.sub(r"[^A-Za-z0-9_-]+", "-", pair.name)[:100] for pair in pairs}
    twice = [key for key, count in Counter(keys.values()).items() if count > 1]
    if twice:
        names = [name for name, key in keys.items() if key == twice[0]]
        raise ThermorenderError(
            f"{listed(names)} differ only in characters that keys cannot have, so all become {twice[0]!r}; "
            "rename the files"
        )
    return keys


def sequences_of(pairs: Sequence[Files], sequence: str | None = None, gap: int | None = None) -> dict[str, str]:
    """Return {name: sequence} of pairs sorted by name.

    The sequence is the group of the regular expression `sequence`, by default the name without its last digits. A step
    of the last number above `gap` starts a new one.
    """
    try:
        expression = re.compile(sequence) if sequence else None
    except re.error as error:
        raise ThermorenderError(
            f"--sequence={sequence!r} is not a regular expression: {error}; put the sequence in a group, as in "
            r"'(flight\d+)_'"
        ) from None
    found: dict[str, str] = {}
    # {base: (last number, its sequence)}
    before: dict[str, tuple[int, str]] = {}
    for pair in pairs:
        digits = re.search(r"(\d+)\D*$", pair.name)
        number = int(digits[1]) if digits else None
        base = re.sub(r"[_\-. ]*\d*$", "", pair.name) or "all"
        if expression is not None:
            match = expression.search(pair.name)
            if match is None:
                raise ThermorenderError(
                    f"--sequence={sequence!r} does not match {pair.name!r}; give one that matches every name"
                )
            base = match[1] if expression.groups else match[0]
        found[pair.name] = base
        if gap is not None and number is not None:
            last = before.get(base)
            current = f"{base}_{number}" if last is None or number - last[0] > gap else last[1]
            before[base], found[pair.name] = (number, current), current
    return found


def _named(folder: str | Path, pattern: str, what: str) -> dict[str, Path]:
    """{name: path} of the pictures in a folder that match a pattern."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ThermorenderError(f"{what} folder {folder} does not exist; give a folder of pictures")
    expression = re.compile("".join({"*": "(.*)", "?": "(.)"}.get(each, re.escape(each)) for each in pattern))
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        match = expression.fullmatch(path.name)
        if match is None or path.suffix.lower() not in SUFFIXES or path.name.startswith("."):
            continue
        name = "".join(match.groups())
        name = name.removesuffix(path.suffix) or path.stem
        if name in found:
            raise ThermorenderError(
                f"{found[name]} and {path} are both pair {name!r} by pattern {pattern!r}; give a pattern that one of "
                "them does not match"
            )
        found[name] = path
    if not found:
        raise ThermorenderError(
            f"{folder} has no picture ({', '.join(SUFFIXES)}) that matches {pattern!r}; give another --{what}"
            f"{_unpaired(folder)}{sequence_hint(folder.iterdir())}"
        )
    return found


def _unpaired(folder: Path) -> str:
    """What to do with a sequence of a folder, after another sentence; empty without one."""
    found = next((path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in (".seq", ".csq")), None)
    if found is None:
        return ""
    return (
        f"; {found} is a sequence, of which no frame has a picture of its name, so write its frames as TIFF, which "
        "thermorender.sensor.thermal_files.thermal_images yields"
    )


def _by_number(name: str) -> list[tuple[int, str]]:
    """Sort key in which 10 comes after 9."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _decoded(path: str | Path) -> np.ndarray:
    """Picture of a file as OpenCV decodes it, with one or more channels."""
    import cv2

    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read ({error.strerror}); give a picture") from None
    flags = cv2.IMREAD_UNCHANGED
    if Path(path).suffix.lower() in (".jpg", ".jpeg"):
        flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
        if b"\xff\xd9" not in data[-65536:]:
            raise ThermorenderError(f"{path} is a truncated JPEG; copy it again, or leave it out")
    image = decoded(data, flags)
    if image is None:
        raise ThermorenderError(f"{path} is not a readable picture; copy it again, or leave it out")
    # OpenCV itself turns a TIFF by its tag.
    return image if Path(path).suffix.lower() in (".tif", ".tiff") else _upright(image, Path(path))


def _upright(image: np.ndarray, path: Path) -> np.ndarray:
    """A picture turned by its EXIF tag, as viewers show it and as it is translated."""
    value = orientation(path)
    image = image.swapaxes(0, 1) if value >= 5 else image
    # Rows and columns of the shown picture that run backwards.
    rows, columns = (slice(None, None, -1 if value in those else 1) for those in ((3, 4, 7, 8), (2, 3, 6, 7)))
    return np.ascontiguousarray(image[rows, columns])


def _of_tiff(path: Path, scale: Sequence[float] | None, intensity: bool) -> Thermal:
    """Thermal picture of a TIFF, by its declared scale or the given one."""
    values, declared, kind = read_tiff(path)
    values = _upright(values, path)
    scale = declared or scale
    if kind in ("float32", "float64"):
        if scale is None and np.isfinite(values).any() and np.nanmedian(values) > _HOT_C:
            raise ThermorenderError(
                f"{path} has floats around {np.nanmedian(values):.0f} without a unit, which would be °C; give "
                "--scale=1,0 if they are kelvin"
            )
        return _of_kelvin(kelvin_of_counts(values, scale or (1.0, ZERO_CELSIUS_K)))
    if kind not in ("uint8", "int16", "uint16", "int32", "uint32"):
        raise ThermorenderError(f"{path} has {kind} values; give integers of 8, 16 or 32 bits, or °C in floats")
    return _of_counts(path, values, scale, intensity, kind)


def _of_counts(path: Path, values: np.ndarray, scale: Sequence[float] | None, intensity: bool, kind: str) -> Thermal:
    """Counts in kelvin by a scale; without one, refuse those that look like temperatures."""
    if scale is not None:
        return _of_kelvin(kelvin_of_counts(values, scale))
    valid = np.isfinite(values)
    likely = [] if kind == "uint8" else likely_scales(values, signed=kind != "uint16")
    if kind not in ("uint8", "uint16") or (likely and not intensity):
        raise ThermorenderError(
            f"{path} has {kind} counts of undeclared scale; {scale_request(likely)}"
            + ("; or give --range-c=COLD,WARM if they are intensities" if kind == "uint16" else "")
        )
    # Pictures of 8 bits are for display, and may have a black sky.
    for value in margin_values(values) if kind != "uint8" else ():
        warnings.warn(
            f"pixels of exactly {value:g} in the file are taken for no data, since the others are far from it",
            ThermorenderWarning, stacklevel=3,
        )  # fmt: skip
        valid &= values != value
    return Thermal(np.where(valid, values, 0.0).astype(kind), "intensity", valid)


def _of_kelvin(temperature: ArrayLike) -> Thermal:
    """Hundredths of a kelvin, where they fit."""
    counts = np.rint(np.nan_to_num(np.asarray(temperature, np.float64) / STEP_K, nan=-1.0, posinf=-1.0, neginf=-1.0))
    valid = (counts >= 1.0) & (counts <= 65535.0)
    return Thermal(np.where(valid, counts, 0.0).astype(np.uint16), "kelvin", valid)


def _check_content(path: str | Path, image: np.ndarray, known: np.ndarray | None = None) -> None:
    """Refuse a picture that is too small or has one value."""
    if min(image.shape[:2]) < LEAST_SIDE:
        raise ThermorenderError(
            f"{path} is {image.shape[1]}×{image.shape[0]} pixels; give pictures of at least {LEAST_SIDE} on each side"
        )
    known = image if known is None else known
    if (known == known.flat[0]).all():
        raise ThermorenderError(f"{path} is {known.flat[0]} in all pixels; leave it out")
