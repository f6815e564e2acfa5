"""Tables of air in files: the shipped one, and those that `Atmosphere.save` writes, checked array by array."""

import numpy as np

from thermorender.errors import ThermorenderError

# Arrays of a saved atmosphere and their axes: nodes N, absorbers J, levels L. An axis has the length of the first
# array that names it.
_AXES = {
    "lower_um": "N", "upper_um": "N", "weight": "N", "tilt": "N", "altitude_m": "L", "temperature": "L",
    "density": "JL", "absorption": "NJ", "cloud": "2",
}  # fmt: skip
NAMES = tuple(name for name in _AXES if name != "cloud")
_TABLE = __file__.removesuffix("tables.py") + "standard.npz"


def read_table():
    """Return the arrays of the shipped table; `lowtran.fit` makes them."""
    with open(_TABLE, "rb") as file, np.load(file, allow_pickle=False) as stored:
        return {key: stored[key] for key in stored.files}


def read_saved(path):
    """Return (arrays of an Atmosphere by name, (cloud fraction, cloud base [m])) of a file of `Atmosphere.save`.

    Raises
    ------
    ThermorenderError
        The file is missing or no table, or an array is missing, of another type or shape, or impossible.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            values = {name: stored[name] for name in _AXES if name in stored.files}
    except OSError as error:
        raise ThermorenderError(f"atmosphere {path} cannot be read ({error.strerror or error}); give a file "
                                "written by Atmosphere.save") from None
    except Exception:
        values = {}
    if not values:
        raise ThermorenderError(f"atmosphere {path} is no table of an atmosphere; give a file written by "
                                "Atmosphere.save")
    wrong = _first_wrong(values)
    if wrong:
        raise ThermorenderError(f"atmosphere {path}: {wrong}; give a file written by Atmosphere.save")
    values = {name: np.float64(value) for name, value in values.items()}
    cloud = values.pop("cloud")
    return values, (float(cloud[0]), float(cloud[1]))


def _first_wrong(values):
    """What is wrong with the first array that is out of order, as a clause; None where all are as they must be."""
    length = {"2": (2, None)}
    for name, axes in _AXES.items():
        if name not in values:
            return f"it has no array {name}"
        value = values[name]
        if value.dtype.kind not in "fiu":
            return f"{name} is of type {value.dtype}, where real numbers are needed"
        if value.ndim != len(axes) or (axes == "2" and len(value) != 2):
            return f"{name} is {value.shape}, where {_shape(axes)} is needed"
        for size, axis in zip(value.shape, axes, strict=True):
            known, other = length.setdefault(axis, (size, name))
            if size != known:
                return f"{name} is {value.shape} where {other} is {values[other].shape}; both share the axis {axis}"
        if not np.isfinite(value).all():
            return f"{name} holds {value[~np.isfinite(value)][0]:g}; numbers must be finite"
    for axis, fewest in (("N", 1), ("L", 2)):
        if length[axis][0] < fewest:
            return f"{length[axis][1]} holds {length[axis][0]} numbers, where at least {fewest} are needed"
    for name in ("weight", "density", "absorption"):
        if (values[name] < 0.0).any():
            return f"{name} holds {values[name].min():g}; it must not be negative"
    lower, upper, altitude = values["lower_um"], values["upper_um"], values["altitude_m"]
    bands, which = np.unique(np.stack([lower, upper], axis=1), axis=0, return_inverse=True)
    if bands.min() <= 0.0 or (bands[:, 0] >= bands[:, 1]).any() or (np.abs(bands[1:, 0] - bands[:-1, 1]) > 1e-9).any():
        found = ", ".join(f"{low:g}–{high:g}" for low, high in bands)
        return f"lower_um and upper_um make no sub-bands that adjoin ({found} µm)"
    total = np.bincount(which.reshape(-1), values["weight"])
    worst = np.argmax(np.abs(total - 1.0))
    # Single precision is enough: shares are normalised again wherever they are used.
    if abs(total[worst] - 1.0) > 1e-5:
        return f"weight sums to {total[worst]:g} over {bands[worst, 0]:g}–{bands[worst, 1]:g} µm, where it must be 1"
    far = np.abs(values["tilt"]) >= 1.0 / upper
    if far.any():
        return f"tilt holds {values['tilt'][far][0]:g}; it must be smaller than 1/upper_um, a wavenumber in µm⁻¹"
    falls = np.flatnonzero(np.diff(altitude) <= 0.0)
    if falls.size:
        return f"altitude_m does not rise: {altitude[falls[0] + 1]:g} follows {altitude[falls[0]]:g}"
    warm = values["temperature"]
    odd = (warm < 100.0) | (warm > 1000.0)
    if odd.any():
        return f"temperature holds {warm[odd][0]:g}, no air temperature in kelvin (100 … 1000)"
    return None


def _shape(axes):
    return f"({', '.join(axes)}{',' if len(axes) == 1 else ''})"
