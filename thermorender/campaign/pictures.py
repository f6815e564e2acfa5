"""Pictures of folders for a data set: which belong together, and what a camera's file holds.

A thermal file is an 8-bit picture, a 16-bit one, a TIFF of temperatures or a radiometric JPEG of FLIR. Temperatures
become 16-bit values of 0.01 K; values of unknown scale stay as they are.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.footage.flir_jpeg import read_flir_jpeg
from thermorender.footage.radiometric_files import read_tiff
from thermorender.formats import decoded
from thermorender.sensor.radiometry import ThermographySettings
from thermorender.units import ZERO_CELSIUS_K, kelvin

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
# Of the values that temperatures are kept as [K]; 16 bits of it end at 655.35 K.
STEP_K = 0.01
# Smallest side of a picture that is of use [px].
LEAST_SIDE = 16
# A message names so many files.
_NAMED = 8
# Medians above this are no °C of a landscape, but kelvin.
_HOT_C = 150.0


@dataclass(frozen=True)
class Files:
    """Two files that belong together, and the mask of where they do.

    Attributes
    ----------
    name : str
        What their names have in common.
    visible, thermal : Path
    valid : Path or None
    """

    name: str
    visible: Path
    thermal: Path
    valid: Path | None = None


@dataclass(frozen=True, eq=False)
class Thermal:
    """A thermal picture.

    Attributes
    ----------
    values : (H, W) uint8 or uint16
    unit : {"kelvin", "intensity"}
        Hundredths of a kelvin, or counts of unknown scale.
    valid : (H, W) bool
        False where the file holds nothing, or more than the values can tell.
    """

    values: np.ndarray
    unit: str
    valid: np.ndarray


def matched(visible_folder, thermal_folder, visible="*", thermal="*", valid=None):
    """Return the Files of two folders that have the same name, sorted by it, and names that stand alone.

    Parameters
    ----------
    visible_folder, thermal_folder : path
    visible, thermal : str
        Patterns of file names, such as *_rgb.png; what its wildcards stand for is the pair's name.
    valid : str, optional
        Pattern of masks in the visible folder, non-zero where both pictures show the same.

    Returns
    -------
    (list of Files, list of str)

    Raises
    ------
    ThermorenderError
        A missing folder, a pattern that finds nothing or the same name twice, or no pair.
    """
    found = _named(visible_folder, visible, "visible"), _named(thermal_folder, thermal, "thermal")
    masks = _named(visible_folder, valid, "valid") if valid else {}
    names = sorted(found[0].keys() & found[1].keys(), key=_by_number)
    if not names:
        raise ThermorenderError(
            f"no file of {visible_folder} ({visible}) has the name of one in {thermal_folder} ({thermal}): there are "
            f"{listed(found[0])} and {listed(found[1])}; give --visible and --thermal with * for what is the same"
        )
    if masks:
        lacking = [name for name in names if name not in masks]
        if lacking:
            raise ThermorenderError(f"no mask ({valid}) is there for {listed(lacking)}; add it, or leave out --valid")
    pairs = [Files(name, found[0][name], found[1][name], masks.get(name)) for name in names]
    return pairs, sorted(found[0].keys() ^ found[1].keys(), key=_by_number)


def read_visible(path):
    """Return ((H, W, 3) uint8 sRGB, whether it is grey) of a visible picture.

    Raises
    ------
    ThermorenderError
        A file that cannot be read, is not 8-bit, too small, or the same everywhere.
    """
    image = _decoded(path)
    if image.dtype != np.uint8:
        raise ThermorenderError(f"{path} has values of {image.dtype}; give visible pictures of 8 bits")
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=-1)
    # An alpha channel tells nothing here; OpenCV orders blue, green, red.
    image = np.ascontiguousarray(image[..., 2::-1])
    _check_content(path, image)
    return image, bool((image[..., 0] == image[..., 1]).all() and (image[..., 1] == image[..., 2]).all())


def read_thermal(path, scale=None):
    """Return the Thermal picture of a file.

    Parameters
    ----------
    path : path
    scale : (2,) floats, optional
        (kelvin per count, kelvin of count 0) of 16-bit files that declare none.

    Raises
    ------
    ThermorenderError
        A file that cannot be read, has colours, is of a depth that no camera has, too small, or the same everywhere.
    """
    path = Path(path)
    if path.suffix.lower() in (".jpg", ".jpeg") and _radiometric(path):
        # As the camera sees it, before any correction for surface and air.
        found = _of_kelvin(read_flir_jpeg(path).temperature(ThermographySettings()))
    elif path.suffix.lower() in (".tif", ".tiff"):
        found = _of_tiff(path, scale)
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
            raise ThermorenderError(f"{path} has values of {image.dtype}; give 8 or 16 bits")
        if image.dtype == np.uint16 and scale is not None:
            found = _of_kelvin(image * float(scale[0]) + float(scale[1]))
        else:
            found = Thermal(image, "intensity", np.ones(image.shape, bool))
    if not found.valid.any():
        raise ThermorenderError(
            f"{path} holds no temperature between 0 and {65535 * STEP_K:.2f} K; leave it out"
        )
    if found.unit == "kelvin":
        kelvin(f"the median temperature of {path}", STEP_K * float(np.median(found.values[found.valid])))
    _check_content(path, found.values, found.values[found.valid])
    return found


def read_valid(path, shape):
    """Return (H, W) bool, where a mask is not zero.

    Raises
    ------
    ThermorenderError
        A file that cannot be read, or of another size.
    """
    image = _decoded(path)
    if image.shape[:2] != tuple(shape):
        raise ThermorenderError(
            f"mask {path} is {image.shape[1]}×{image.shape[0]} pixels and its visible picture {shape[1]}×{shape[0]}; "
            "give masks of the same size"
        )
    return image > 0 if image.ndim == 2 else (image > 0).any(axis=-1)


def place_of(path):
    """Return (latitude, longitude) [deg] by the EXIF of a picture, None where it tells none."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            gps = image.getexif().get_ifd(0x8825)
        degrees = [float(gps[tag][0]) + float(gps[tag][1]) / 60.0 + float(gps[tag][2]) / 3600.0 for tag in (2, 4)]
        signs = (-1.0 if gps[1] == "S" else 1.0, -1.0 if gps[3] == "W" else 1.0)
        place = tuple(round(sign * value, 7) for sign, value in zip(signs, degrees, strict=True))
    except (OSError, KeyError, ValueError, TypeError, IndexError, ZeroDivisionError, SyntaxError):
        return None
    return place if abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0 else None


def listed(names):
    """Return names in a sentence, the first few of many."""
    names = list(names)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _named(folder, pattern, what):
    """{name: path} of the pictures in a folder that a pattern finds."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ThermorenderError(f"{what} folder {folder} does not exist; give a folder of pictures")
    expression = re.compile("".join({"*": "(.*)", "?": "(.)"}.get(each, re.escape(each)) for each in pattern))
    found = {}
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
            f"{folder} holds no picture ({', '.join(SUFFIXES)}) that {pattern!r} matches; give another --{what}"
        )
    return found


def _by_number(name):
    """Order in which 10 comes after 9."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _decoded(path):
    """The picture of a file as OpenCV has it, with one or more channels."""
    import cv2

    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read ({error.strerror}); give a picture") from None
    flags = cv2.IMREAD_UNCHANGED
    if Path(path).suffix.lower() in (".jpg", ".jpeg"):
        # As it is stored, so that it lies on a thermal picture that knows of no turning.
        flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
        if b"\xff\xd9" not in data[-65536:]:
            raise ThermorenderError(f"{path} is a JPEG cut short; copy it anew, or leave it out")
    image = decoded(data, flags)
    if image is None:
        raise ThermorenderError(f"{path} is no picture that can be read; copy it anew, or leave it out")
    return image


def _radiometric(path):
    """Whether a JPEG carries FLIR's data."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read ({error.strerror}); give a picture") from None
    return re.search(rb"\xff\xe1..FLIR\0", data, re.DOTALL) is not None


def _of_tiff(path, scale):
    values, declared, kind = read_tiff(path)
    step_zero = declared or scale
    if kind in ("float32", "float64"):
        if declared is None and np.isfinite(values).any() and np.nanmedian(values) > _HOT_C:
            raise ThermorenderError(
                f"{path} holds floats around {np.nanmedian(values):.0f} and names no unit; floats without one are °C: "
                "declare the unit K in the file, or store °C"
            )
        return _of_kelvin(values * declared[0] + declared[1] if declared else values + ZERO_CELSIUS_K)
    if kind not in ("uint8", "uint16"):
        raise ThermorenderError(f"{path} has values of {kind}; give 8 or 16 bits, or °C in floats")
    if kind == "uint16" and step_zero is not None:
        return _of_kelvin(values * step_zero[0] + step_zero[1])
    valid = np.isfinite(values)
    return Thermal(np.where(valid, values, 0.0).astype(kind), "intensity", valid)


def _of_kelvin(temperature):
    """Hundredths of a kelvin, where they fit."""
    counts = np.rint(np.nan_to_num(np.asarray(temperature, np.float64) / STEP_K, nan=-1.0, posinf=-1.0, neginf=-1.0))
    valid = (counts >= 1.0) & (counts <= 65535.0)
    return Thermal(np.where(valid, counts, 0.0).astype(np.uint16), "kelvin", valid)


def _check_content(path, image, known=None):
    if min(image.shape[:2]) < LEAST_SIDE:
        raise ThermorenderError(
            f"{path} is {image.shape[1]}×{image.shape[0]} pixels; give pictures of at least {LEAST_SIDE} on each side"
        )
    known = image if known is None else known
    if (known == known.flat[0]).all():
        raise ThermorenderError(f"{path} is {known.flat[0]} in all its pixels; leave it out")
