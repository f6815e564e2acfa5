"""TIFFs of temperature: 16-bit ones linear in kelvin are written; those of other programs are read too.

Cameras write TIFF counts without their unit: 0.04 K for a FLIR core in TLinear mode, 0.001 °C for others. The user has
to give a scale that the file does not declare.
"""

import struct
import warnings
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.formats import picture_tags
from thermorender.units import LOWEST_KELVIN, ZERO_CELSIUS_K, kelvin_scale

# FLIR Tau 2 product specification, TLinear: kelvin per count in high resolution, as in the TIFFs of a Zenmuse XT2.
TLINEAR_STEP_K = 0.04

# Common scales of integer files, (kelvin per count, kelvin of 0): hundredths of a kelvin (FLIR Boson and others),
# TLinear, tenths of a kelvin, and tenths, hundredths and thousandths of a degree Celsius (DJI Thermal SDK,
# `dji_irp -a measure`: int16 of 0.1 °C); kelvin, degrees Celsius and degrees Fahrenheit as fractions.
_LIKELY = {
    "1 K": (1.0, 0.0), "1 °C": (1.0, ZERO_CELSIUS_K), "1 °F": (1.0 / 1.8, ZERO_CELSIUS_K - 32.0 / 1.8),
    "0.01 K": (0.01, 0.0), "0.04 K": (TLINEAR_STEP_K, 0.0), "0.1 K": (0.1, 0.0), "0.1 °C": (0.1, ZERO_CELSIUS_K),
    "0.01 °C": (0.01, ZERO_CELSIUS_K), "0.001 °C": (0.001, ZERO_CELSIUS_K),
}  # fmt: skip
_AS_FRACTION = ("1 K", "1 °C", "1 °F")
_AS_INTENSITY = ("0.04 K", "0.01 °C", "0.001 °C")
# A landscape in a picture: most pixels, and every pixel [K].
_COMMON_K, _RARE_K = (238.0, 338.0), (150.0, 1000.0)
# Temperatures of a pixel; kilns and lava are below the upper one [K].
_POSSIBLE_K = (LOWEST_KELVIN, 1500.0)
# Smallest and largest share of pixels that have the value of a margin.
_LEAST_MARGIN, _MOST_MARGIN = 0.001, 0.9
# Temperatures of a picture have no gap of so many kelvin around 0 °C, which some of its pixels have exactly.
_APART_K = 2.0
# The tag of EXIF and TIFF.
_ORIENTATION = 274


def write_tlinear(path: str | PathLike[str], temperature: ArrayLike, step_k: float = TLINEAR_STEP_K) -> None:
    """Write temperatures (H, W) [K] as a 16-bit TIFF of `step_k` per count; NaN is 0, others at the nearest count.

    The TIFF has GDAL's scale, offset, unit and mark of no data, so GDAL, rasterio and QGIS show kelvin; other programs
    show counts.
    """
    counts = np.rint(np.nan_to_num(np.asarray(temperature, np.float64), nan=0.0) / step_k)
    write_tlinear_counts(path, np.clip(counts, 0, 65535).astype(np.uint16), step_k)


def write_tlinear_counts(path: str | PathLike[str], counts: NDArray[np.uint16], step_k: float = TLINEAR_STEP_K) -> None:
    """Write counts, (H, W) uint16 of `step_k` kelvin each, as `write_tlinear` does."""
    import rasterio

    height, width = counts.shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(
            path, "w", driver="GTiff", width=width, height=height, count=1, dtype="uint16", nodata=0, compress="deflate"
        ) as file:
            file.write(counts, 1)
            file.scales, file.offsets, file.units = (step_k,), (0.0,), ("K",)


def read_temperature(
    path: str | PathLike[str], scale: tuple[float, float] | None = None, *, takes_scale: bool = True
) -> NDArray[np.float64]:
    """Return the temperatures of a TIFF of one band, (H, W) float64 [K]; NaN where none.

    `scale` is (kelvin per count, kelvin of count 0) of a TIFF that does not declare them; floats between 238 and 338
    are kelvin without it. Margins count as no data, as in `kelvin_of_counts`, and so do values that are not finite and
    above 0 K. `takes_scale` is whether the user can state a scale.
    """
    path = Path(path)
    counts, declared, kind = read_tiff(path)
    if scale is None and declared is None and kind in ("uint8", "int8"):
        raise ThermorenderError(
            f"{path} has 8 bits a pixel, which is a picture for display; give the radiometric file"
            + (", or state kelvin per count and kelvin of count 0 as scale" if takes_scale else "")
        )
    if scale is None and declared is None and kind.startswith("float") and likely_scales(counts) == ["1 K"]:
        # Floats that are a landscape's temperatures in kelvin only.
        scale = 1.0, 0.0
    if scale is None and declared is None:
        likely = likely_scales(counts)
        step, zero = _LIKELY[likely[0]] if likely else (TLINEAR_STEP_K, 0.0)
        asked = f", perhaps {' or '.join(likely)};" if likely else ";"
        asked = f"; {scale_request(likely)}, or" if takes_scale else asked
        raise ThermorenderError(
            f"{path} does not declare the unit of its counts{asked} declare it in the file, for example with "
            f"`gdal_edit.py -scale {step:g} -offset {zero:g} -units K {path}`"
        )
    if scale is not None and declared is not None and not np.allclose(scale, declared):
        raise ThermorenderError(
            f"{path} declares {declared[0]:g} K per count and {declared[1]:g} K at count 0, not the given "
            f"{scale[0]:g},{scale[1]:g}; leave the scale out, or correct the file with "
            "`gdal_edit.py -scale STEP -offset ZERO`"
        )
    step, zero = scale or declared  # type: ignore[misc]  # one of them is given
    found = kelvin_of_counts(counts, (step, zero))
    return np.where((found > 0.0) & np.isfinite(found), found, np.nan)


def orientation(path: Path) -> int:
    """Return how a file's tags state that its pixels are stored, 1 to 8 of EXIF; 1, upright, without a tag."""
    from PIL import TiffImagePlugin

    value: object = 1
    try:
        if path.suffix.lower() not in (".tif", ".tiff"):
            value = picture_tags(path)[0].get(_ORIENTATION, 1)
        else:
            # Pillow opens fewer kinds of pixels than TIFF has.
            with path.open("rb") as file:
                start = file.read(8)
                big = start[2:3] == b"+" or start[3:4] == b"+"
                tags = TiffImagePlugin.ImageFileDirectory_v2(start + (file.read(8) if big else b""))
                file.seek(tags.next)
                tags.load(file)
                value = tags.get(_ORIENTATION, 1)
    except (OSError, SyntaxError, ValueError, struct.error):
        pass  # Who reads the pixels says what is wrong with the file.
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def check_upright(path: Path) -> None:
    """Raise if a file's tags state that its pixels are stored turned or mirrored."""
    value = orientation(path)
    if value != 1:
        raise ThermorenderError(
            f"{path} states orientation {value} in its tags, so its pixels are stored turned or mirrored; if its pose "
            f"is that of the stored pixels, as in OpenSfM's files, set it to 1 with `exiftool -n -Orientation=1 "
            f"{path}`, otherwise turn the pixels"
        )


def kelvin_of_counts(counts: NDArray[np.float64], scale: Sequence[float]) -> NDArray[np.float64]:
    """Return the temperatures of counts (H, W) by their scale (step, zero) [K], NaN where a value marks no data.

    Such are values of `margin_values` that no landscape has, zeros of °C or °F far from all others, and temperatures
    that no pixel has. A warning names each.
    """
    step, zero = float(scale[0]), float(scale[1])
    found = counts * step + zero
    known = found[np.isfinite(found)]
    marks = {
        value: "the others are far from it"
        for value in margin_values(counts)
        if not _COMMON_K[0] <= value * step + zero <= _COMMON_K[1]
    }
    rest = np.abs(counts[np.isfinite(counts) & (counts != 0.0)])
    if zero > 0.0 and (counts == 0.0).any() and rest.size and rest.min() * step >= _APART_K:
        marks[0.0] = f"all others are at least {_APART_K:g} K from it"
    for value, why in marks.items():
        # The same text for all files, so that it is printed once.
        warnings.warn(
            f"pixels of exactly {value * step + zero:g} K, which are {value:g} in the file, are taken for no data, "
            f"since {why}",
            ThermorenderWarning, stacklevel=3,
        )  # fmt: skip
    found = np.where(np.isin(counts, list(marks)), np.nan, found)
    low, high = _POSSIBLE_K
    # A wrong scale, by which most are impossible, is judged by who asks for the temperatures.
    if known.size and low <= np.median(known) <= high:
        impossible = (found < low) | (found > high)
        if impossible.any():
            warnings.warn(f"pixels outside {low:g}…{high:g} K are taken for no data", ThermorenderWarning, stacklevel=3)
            found = np.where(impossible, np.nan, found)
    return found


def margin_values(values: NDArray[np.float64]) -> list[float]:
    """Return the lowest and the highest of the values (H, W) that mark no data, as in the margin of a warped picture.

    Such a value is on the edge of the picture, and farther from all others than those are from each other. A saturated
    spot is not: its blurred outline has all values between.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        return []
    ends = float(known.min()), float(known.max())
    inner = known[(known != ends[0]) & (known != ends[1])]
    if inner.size < (1.0 - _MOST_MARGIN) * known.size:
        return []
    gaps = inner.min() - ends[0], ends[1] - inner.max()
    edge = np.concatenate([values[0], values[-1], values[:, 0], values[:, -1]])
    return [
        end
        for end, gap in zip(ends, gaps, strict=True)
        if gap > np.ptp(inner) and (known == end).mean() >= _LEAST_MARGIN and (edge == end).any()
    ]


def likely_scales(counts: ArrayLike, signed: bool = True) -> list[str]:
    """Return the names of common scales by which counts (H, W) are temperatures of a landscape.

    Unsigned counts are often intensities, so scales that common intensities fit too are left out.
    """
    values = np.asarray(counts, np.float64)
    # A margin says nothing about the unit.
    known = values[np.isfinite(values) & ~np.isin(values, margin_values(values))]
    if 0.0 < float((known == 0.0).mean() if known.size else 0.0) < _MOST_MARGIN:
        inner = known[known != 0.0]
        known = inner if inner.min() > 0.0 else known
    if not known.size or (not signed and known.max() <= 255.0):
        return []
    low, high = np.percentile(known, (1.0, 99.0))
    whole = bool((known == np.rint(known)).all())
    found = []
    for name, (step, zero) in _LIKELY.items():
        if (not signed and name in _AS_INTENSITY) or (whole and name in _AS_FRACTION):
            continue
        common = _COMMON_K[0] <= low * step + zero and high * step + zero <= _COMMON_K[1]
        rare = _RARE_K[0] <= known.min() * step + zero and known.max() * step + zero <= _RARE_K[1]
        # Tenths and hundredths of a degree overlap: a landscape differs by more than 1 K.
        if common and rare and (high - low) * step > 1.0:
            found.append(name)
    # Fractions are temperatures before they are counts, such as means of counts.
    return [name for name in found if name in _AS_FRACTION] or found


def scale_request(names: Sequence[str]) -> str:
    """Return the half sentence that asks for a scale, with the options of the likely ones."""
    likely = [f"scale={_LIKELY[name][0]:g},{_LIKELY[name][1]:g} for counts of {name}" for name in names]
    return "state kelvin per count and kelvin of count 0, " + (
        "which look like " + " or ".join(likely) if likely else "e.g. scale=0.04,0 for a FLIR core in TLinear mode"
    )


def read_tiff(path: Path) -> tuple[NDArray[np.float64], tuple[float, float] | None, str]:
    """Return ((H, W) float64 values, declared (step, zero) in kelvin or None, dtype in the file) of a TIFF.

    Values are NaN where it has no data. Scale and offset tags without a unit of temperature are applied, and the dtype
    is then float64.
    """
    import rasterio

    if not path.is_file():
        raise ThermorenderError(f"{path} does not exist; give a radiometric TIFF")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path) as file:
                if file.count != 1:
                    raise ThermorenderError(f"{path} has {file.count} bands; give a TIFF of one band, the counts")
                values = file.read(1, masked=True).astype(np.float64).filled(np.nan)
                unit, step, zero, kind = file.units[0], file.scales[0], file.offsets[0], file.dtypes[0]
                if file.subdatasets:
                    raise ThermorenderError(
                        f"{path} has {len(file.subdatasets)} pictures; write each to its own file, for example with "
                        f"`rio convert {file.subdatasets[0]} FIRST.tif`"
                    )
    except (rasterio.errors.RasterioError, UnicodeDecodeError) as error:
        raise ThermorenderError(f"{path} cannot be read as TIFF: {error}; give a complete file") from None
    scale = kelvin_scale(unit)
    if scale is not None:
        return values, (scale[0] * step, scale[0] * zero + scale[1]), kind
    if (step, zero) != (1.0, 0.0):
        values, kind = values * step + zero, "float64"
    if unit and kind.startswith("float"):
        raise ThermorenderError(f"{path} holds values in {unit!r}; give a TIFF in K, °C or °F")
    return values, None, kind
