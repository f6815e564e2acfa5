"""Checks of the atmosphere's arguments: names, numbers and altitudes."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError


def name_index(what: str, name: str, names: Iterable[object]) -> int:
    """Return the index of a name in a list, or refuse an unknown name with the list of names."""
    known = [str(value) for value in names]
    if name not in known:
        raise ThermorenderError(f"{what}={name!r} is unknown; give one of {', '.join(known)}")
    return known.index(name)


def check_within(name: str, value: float, lowest: float, highest: float, unit: str) -> None:
    """Refuse a value outside its limits."""
    if not lowest <= value <= highest:
        raise ThermorenderError(f"{name}={value:g} is out of range; give {lowest:g} … {highest:g} ({unit})")


def check_altitudes(name: str, values: NDArray[np.float64], lowest: float, highest: float) -> None:
    """Refuse altitudes [m] that are not finite or out of range."""
    bad = ~((values >= lowest) & (values <= highest))
    if bad.any():
        raise ThermorenderError(
            f"{name}={values[bad].flat[0]:g} is out of range; give metres above sea level, −{-lowest:g} … {highest:g}"
        )


def not_covered(covered_um: str, band_um: tuple[float, float]) -> ThermorenderError:
    """Return the error of air that covers other wavelengths than a camera's band [µm]."""
    return ThermorenderError(
        f"the atmosphere covers {covered_um} µm, which does not include the camera's band {band_um[0]:g}–"
        f"{band_um[1]:g} µm; give another atmosphere or a narrower band"
    )
