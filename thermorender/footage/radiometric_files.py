"""Files of temperature: 16-bit TIFFs linear in kelvin, written and read, and FLIR's radiometric JPEGs.

Cameras write counts to a TIFF without the unit of a count: 0.04 K for a FLIR core in TLinear mode, a thousandth of a
degree Celsius for others. The scale of a file is used if it is declared with its unit; otherwise the user has to give
it.
"""

import warnings
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.sensor.radiometry import ThermographySettings
from thermorender.units import ZERO_CELSIUS_K

# FLIR Tau 2 product specification, TLinear: kelvin per count in high resolution, as in the TIFFs of a Zenmuse XT2.
TLINEAR_STEP_K = 0.04

_UNITS = {"K": 0.0, "kelvin": 0.0, "°C": ZERO_CELSIUS_K, "degC": ZERO_CELSIUS_K, "C": ZERO_CELSIUS_K}
FLIR_JPEG = (".jpg", ".jpeg")
SUFFIXES = (".tif", ".tiff", *FLIR_JPEG)


def write_tlinear(path: str | PathLike[str], temperature: ArrayLike, step_k: float = TLINEAR_STEP_K) -> None:
    """Write temperatures as a 16-bit TIFF of `step_k` kelvin per count that declares scale and unit.

    Parameters
    ----------
    path : path
    temperature : (H, W) array
        [K]. NaN is written as 0, a value out of range as the nearest count.
    step_k : float

    Notes
    -----
    The TIFF has GDAL's scale, offset and unit, so GDAL, rasterio and QGIS show kelvin; other programs show counts.
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
            path, "w", driver="GTiff", width=width, height=height, count=1, dtype="uint16", compress="deflate"
        ) as file:
            file.write(counts, 1)
            file.scales, file.offsets, file.units = (step_k,), (0.0,), ("K",)


def read_temperature(
    path: str | PathLike[str], scale: tuple[float, float] | None = None,
    thermography: ThermographySettings | None = None,
) -> NDArray[np.float64]:  # fmt: skip
    """Return the temperatures of a radiometric file, (H, W) float64 [K]; NaN where it has none.

    Parameters
    ----------
    path : path
        TIFF of one band, or a radiometric JPEG of FLIR.
    scale : (2,) floats, optional
        (kelvin per count, kelvin of count 0) of a TIFF that does not declare them.
    thermography : ThermographySettings, optional
        In place of the settings stored in a JPEG.

    Raises
    ------
    ThermorenderError
        A file that cannot be read, has several bands, or does not declare the unit of a count.
    """
    path = Path(path)
    if path.suffix.lower() in FLIR_JPEG:
        from thermorender.footage.flir_jpeg import read_flir_jpeg

        if scale is not None:
            raise ThermorenderError(f"{path} contains its calibration; leave out the scale")
        return read_flir_jpeg(path).temperature(thermography)
    if path.suffix.lower() not in SUFFIXES:
        raise ThermorenderError(f"{path} is of unknown kind; give one of {', '.join(SUFFIXES)}")
    counts, declared, _ = read_tiff(path)
    if scale is None and declared is None:
        raise ThermorenderError(
            f"{path} does not declare the unit of its counts; give kelvin per count and kelvin of count 0 (--scale), "
            "e.g. 0.04,0 for a FLIR core in TLinear mode"
        )
    step, zero = scale or declared
    return counts * float(step) + float(zero)


def read_tiff(path: Path) -> tuple[NDArray[np.float64], tuple[float, float] | None, str]:
    """Return ((H, W) float64 values, declared (step, zero) in kelvin or None, dtype in the file) of a TIFF.

    Values are NaN where it has no data.

    Raises
    ------
    ThermorenderError
        A file that cannot be read, or has several bands.
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
    except rasterio.errors.RasterioError as error:
        raise ThermorenderError(f"{path} cannot be read as TIFF: {error}; give a complete file") from None
    return values, (step, zero + _UNITS[unit]) if unit in _UNITS else None, kind
