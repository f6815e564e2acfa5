"""Atmosphere tables in files: the shipped table, and files of `Atmosphere.save`, checked array by array."""

from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError

Arrays = dict[str, NDArray[Any]]

# Arrays of a saved atmosphere and their axes: nodes N, powers P, absorbers J, levels L. The first array with an axis
# sets its length.
_AXES = {
    "lower_um": "N", "upper_um": "N", "weight": "N", "tilt": "NP", "altitude_m": "L", "temperature": "L",
    "density": "JL", "absorption": "NJ", "cloud": "2",
}  # fmt: skip
# Those of the column that an atmosphere follows from: levels K with altitude, pressure and temperature, gases M and
# bands E of aerosols.
_COLUMN = {"column": "3K", "gas": "M", "mixing": "MK", "extinction": "EK"}
NAMES = tuple(name for name in _AXES if name != "cloud")
# Range of thermal radiation [µm].
_SHORTEST_UM, _LONGEST_UM = 0.1, 1e4
# At this extinction a micrometre of air is opaque [1/m].
_MOST_EXTINCTION = 1e6
_TABLE = __file__.removesuffix("table_files.py") + "standard.npz"


def read_table() -> Arrays:
    """Return the arrays of the shipped table; `python -m tools.lowtran` makes them."""
    with open(_TABLE, "rb") as file, np.load(file, allow_pickle=False) as stored:
        return {key: stored[key] for key in stored.files}


def read_saved(
    path: str | PathLike[str],
) -> tuple[Arrays, tuple[float, float], tuple[NDArray[Any], list[str], NDArray[Any], NDArray[Any]] | None]:
    """Return (arrays of an Atmosphere by name, (cloud fraction, cloud base [m]), column) of a file of
    `Atmosphere.save`; the column is (altitude, pressure, temperature (3, K), names of gases, mixing, extinction)."""
    give = "a file written by Atmosphere.save"
    values = read_arrays(path, "atmosphere", _AXES, _first_wrong, give)
    cloud = values.pop("cloud")
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
        known = any(name in stored.files for name in _COLUMN)
    column = None
    if known:
        found = read_arrays(path, "atmosphere", _COLUMN, lambda _: None, give)
        column = found["column"], found["gas"].tolist(), found["mixing"], found["extinction"]
    return values, (float(cloud[0]), float(cloud[1])), column


def read_arrays(
    path: str | PathLike[str], kind: str, axes: Mapping[str, str], first_wrong: Callable[[Arrays], str | None],
    give: str,
) -> Arrays:  # fmt: skip
    """Return the arrays of an .npz file by name; numbers are float64.

    `axes` are {array: letters of its axes}: the first array with an axis sets its length, and a digit is a length. The
    array `gas` has text, others finite numbers. `first_wrong` returns the fault of the first invalid array, as a
    clause, or None; `kind` and `give` are for messages, the kind of file and what to give instead.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            values = {name: stored[name] for name in axes if name in stored.files}
    except OSError as error:
        raise ThermorenderError(f"{kind} {path} cannot be read ({error.strerror or error}); give {give}") from None
    except Exception:
        values = {}
    if np.ndim(values.get("tilt", 0.0)) == 1:
        # Files of earlier versions.
        values["tilt"] = values["tilt"][:, None]
    if not values:
        raise ThermorenderError(f"{kind} {path} is not an .npz file with its arrays; give {give}")
    wrong = _misshapen(values, axes)
    if not wrong:
        values = {name: value if name == "gas" else np.float64(value) for name, value in values.items()}
        wrong = first_wrong(values)
    if wrong:
        raise ThermorenderError(f"{kind} {path}: {wrong}; give {give}")
    return values


def _misshapen(values: Mapping[str, NDArray[Any]], axes: Mapping[str, str]) -> str | None:
    """The fault of the first array of another type or shape, as a clause, or None."""
    length: dict[str, tuple[int, str]] = {digit: (int(digit), "") for digit in "23"}
    for name, letters in axes.items():
        if name not in values:
            return f"it has no array {name}"
        value, text = values[name], name == "gas"
        if value.dtype.kind not in ("U" if text else "fiu"):
            return f"{name} is of type {value.dtype}, but {'text is' if text else 'real numbers are'} needed"
        fixed = zip(value.shape, letters, strict=False)
        if value.ndim != len(letters) or any(axis.isdigit() and size != int(axis) for size, axis in fixed):
            return f"{name} is {value.shape}, but {_shape(letters)} is needed"
        for size, axis in zip(value.shape, letters, strict=True):
            known, other = length.setdefault(axis, (size, name))
            if size != known:
                return f"{name} is {value.shape} but {other} is {values[other].shape}; both have the axis {axis}"
        if not text and not np.isfinite(value).all():
            return f"{name} holds {value[~np.isfinite(value)][0]:g}; numbers must be finite"
    for axis, (size, name) in length.items():
        fewest = 2 if axis == "L" else 1
        if size < fewest:
            return f"{name} has {size} on its axis {axis}, but at least {fewest} are needed"
    return None


def wrong_sub_bands(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> str | None:
    """Return the fault of limits (S,) of sub-bands [µm], as a clause, or None for contiguous ones."""
    bands = np.unique(np.stack([lower, upper], axis=1), axis=0)
    apart = (bands[:, 0] >= bands[:, 1]).any() or (np.abs(bands[1:, 0] - bands[:-1, 1]) > 1e-9).any()
    if apart or bands.min() < _SHORTEST_UM or bands.max() > _LONGEST_UM:
        found = ", ".join(f"{low:g}–{high:g}" for low, high in bands)
        return f"lower_um and upper_um are not contiguous sub-bands ({found} µm)"
    return None


def not_rising(name: str, values: NDArray[np.float64]) -> str | None:
    """Return the fault of an array (n,) that does not rise, as a clause, or None."""
    falls = np.flatnonzero(np.diff(values) <= 0.0)
    if falls.size:
        return f"{name} does not rise: {values[falls[0] + 1]:g} follows {values[falls[0]]:g}"
    return None


def _first_wrong(values: Arrays) -> str | None:
    """The fault of the first invalid array of an Atmosphere, as a clause, or None."""
    for name in ("weight", "density", "absorption"):
        if (values[name] < 0.0).any():
            return f"{name} holds {values[name].min():g}; it must not be negative"
    lower, upper, altitude = values["lower_um"], values["upper_um"], values["altitude_m"]
    wrong = wrong_sub_bands(lower, upper) or not_rising("altitude_m", altitude)
    if wrong:
        return wrong
    bands, which = np.unique(np.stack([lower, upper], axis=1), axis=0, return_inverse=True)
    total = np.bincount(which.reshape(-1), values["weight"])
    worst = np.argmax(np.abs(total - 1.0))
    # Single precision is enough, because shares are normalised again in use.
    if abs(total[worst] - 1.0) > 1e-5:
        return f"weight sums to {total[worst]:g} over {bands[worst, 0]:g}–{bands[worst, 1]:g} µm; the sum must be 1"
    tilt = values["tilt"][:, 0]
    far = np.abs(tilt) >= 1.0 / upper
    if far.any():
        return f"tilt holds {tilt[far][0]:g}; it must be smaller than 1/upper_um, a wavenumber in µm⁻¹"
    with np.errstate(over="ignore"):
        most = (values["absorption"] @ values["density"]).max()
    if not most <= _MOST_EXTINCTION:
        return f"absorption and density give an extinction of {most:g} per metre; air has up to {_MOST_EXTINCTION:g}"
    warm = values["temperature"]
    odd = (warm < 100.0) | (warm > 1000.0)
    if odd.any():
        return f"temperature holds {warm[odd][0]:g}, not an air temperature in kelvin (100 … 1000)"
    return None


def _shape(axes: str) -> str:
    return f"({', '.join(axes)}{',' if len(axes) == 1 else ''})"
