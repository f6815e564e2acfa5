"""The user's absorption data: k-distributions by pressure, temperature and gas, applied to a profile.

A k-distribution sorts the wavelengths of a sub-band by absorption (correlated k: Lacis and Oinas 1991,
doi:10.1029/90JD01945). A g point represents the same wavelengths at every pressure and temperature and for every gas,
so it is a node of an `Atmosphere`. Its absorption coefficient at a level is the sum over gases of cross section times
number density.
"""

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.air_column import between, exponential
from thermorender.atmosphere.emission import ALTITUDE_M
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.profile import read_gases
from thermorender.atmosphere.table_files import not_rising, read_arrays, wrong_sub_bands
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import BOLTZMANN

Floats = NDArray[np.float64]

# Arrays of a file of absorption data and their axes: gases M, sub-bands S, g points G, pressures P, temperatures T.
_AXES = {
    "gas": "M", "lower_um": "S", "upper_um": "S", "weight": "SG", "pressure_hpa": "P", "temperature": "T",
    "cross_section_cm2": "MSGPT",
}  # fmt: skip
# With this number the air of a camera position takes 1.7 s to compute.
_MOST_NODES = 512
# Above the cross section of any molecule in the thermal infrared [cm²]: strong lines reach 1e-17 at their centres.
_LARGEST_CM2 = 1e-10
# Every 16th point of the integration grid, 80 m apart at the ground, becomes a level between those of a profile.
_EVERY = 16


def from_absorption(
    absorption: str | PathLike[str], profile: str | PathLike[str], cloud_fraction: float = 0.0,
    cloud_base_m: float = 2000.0,
) -> Atmosphere:  # fmt: skip
    """Return the Atmosphere of a profile with the user's absorption data.

    Parameters
    ----------
    absorption : str or Path
        File as in `read_absorption`.
    profile : str or Path
        CSV file with the columns altitude_m (above sea level), pressure_hpa, temperature_k and, for each gas of the
        data, its name with _ppm: parts per million of all molecules. Lowest level first; there is no air above the
        highest level.
    cloud_fraction, cloud_base_m : float
        As in `Atmosphere.standard`.

    Raises
    ------
    ThermorenderError
        A file is missing or invalid, or the data do not cover the pressure or temperature of a level.

    Notes
    -----
    Between levels temperature is linear, and pressure and gases are exponential, in altitude.
    """
    data = read_absorption(absorption)
    altitude, pressure, temperature, ppm = read_gases(profile, data["gas"].tolist())
    inside = ALTITUDE_M[::_EVERY]
    fine = np.unique(np.concatenate([altitude, inside[(inside > altitude[0]) & (inside < altitude[-1])]]))
    pressure = np.exp(np.interp(fine, altitude, np.log(pressure)))
    temperature = np.interp(fine, altitude, temperature)
    for name, values in (("pressure_hpa", pressure), ("temperature", temperature)):
        least, most = data[name][[0, -1]] * (1.0 - 1e-9, 1.0 + 1e-9)
        outside = np.flatnonzero((values < least) | (values > most))
        if outside.size:
            raise ThermorenderError(
                f"profile {profile}: at {fine[outside[0]]:.0f} m {name} is {values[outside[0]]:.4g}, which absorption "
                f"data {absorption} do not cover ({least:.4g} … {most:.4g}); extend the data or end the profile there"
            )
    # Molecules per cubic centimetre: p/kT.
    number = 1e-4 * pressure / (BOLTZMANN * temperature)
    section = _at(data, pressure, temperature)
    amount = exponential(fine, altitude, ppm) * 1e-6 * number
    # From cm⁻¹ to m⁻¹.
    coefficient = 100.0 * np.einsum("ml,msgl->sgl", amount, section).reshape(-1, len(fine))
    points = data["weight"].shape[1]
    air = Atmosphere(
        lower_um=np.repeat(data["lower_um"], points),
        upper_um=np.repeat(data["upper_um"], points),
        weight=data["weight"].ravel(),
        tilt=np.zeros((data["weight"].size, 1)),
        altitude_m=fine,
        temperature=temperature,
        # Each node has its own absorber.
        density=coefficient,
        absorption=np.eye(len(coefficient)),
    )
    return air.clouded(cloud_fraction, cloud_base_m)


def read_absorption(path: str | PathLike[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file of absorption data by name; numbers are float64.

    Parameters
    ----------
    path : str or Path
        .npz file of plain arrays (no pickle): `gas` (M,) names; `lower_um`, `upper_um` (S,) limits of contiguous
        sub-bands [µm]; `weight` (S, G) share of each g point in its sub-band's light, with sum 1; `pressure_hpa` (P,)
        and `temperature` (T,) [K], rising; `cross_section_cm2` (M, S, G, P, T) absorption cross section per molecule
        [cm²].

    Raises
    ------
    ThermorenderError
        The file is missing or not an .npz file, or an array is missing, of another type or shape, or impossible.
    """
    give = "an .npz file as docs/reference/file-formats.md describes it"
    return read_arrays(path, "absorption data", _AXES, _first_wrong, give)


def _first_wrong(data: dict[str, NDArray[Any]]) -> str | None:
    """The fault of the first invalid array, as a clause, or None."""
    gas, weight, section = data["gas"].tolist(), data["weight"], data["cross_section_cm2"]
    for name in gas:
        if not name.isidentifier() or gas.count(name) > 1:
            return f"gas holds {name[:40]!r}; names must be unique, of letters, digits and _"
    for name in ("weight", "cross_section_cm2"):
        if (data[name] < 0.0).any():
            return f"{name} holds {data[name].min():g}; it must not be negative"
    if section.max() > _LARGEST_CM2:
        return f"cross_section_cm2 holds {section.max():g}, but no molecule has more than {_LARGEST_CM2:g} cm²"
    if weight.size > _MOST_NODES:
        return f"weight holds {weight.size} nodes (sub-bands times g points), but up to {_MOST_NODES} are allowed"
    total = weight.sum(axis=1)
    worst = np.argmax(np.abs(total - 1.0))
    if not abs(total[worst] - 1.0) < 1e-5:
        low, high = data["lower_um"][worst], data["upper_um"][worst]
        return f"weight sums to {total[worst]:g} over {low:g}–{high:g} µm; the sum must be 1"
    for name, least, most in (("pressure_hpa", 1e-9, 1e5), ("temperature", 50.0, 5000.0)):
        values = data[name]
        odd = (values < least) | (values > most)
        if odd.any():
            return f"{name} holds {values[odd][0]:g}; allowed are {least:g} … {most:g}"
    rising = ("lower_um", "pressure_hpa", "temperature")
    wrong = [not_rising(name, data[name]) for name in rising]
    return next(filter(None, [*wrong, wrong_sub_bands(data["lower_um"], data["upper_um"])]), None)


def _at(data: Mapping[str, NDArray[Any]], pressure: Floats, temperature: Floats) -> Floats:
    """Cross sections (M, S, G, L) at levels: exponential in ln p and in T, or linear where an end is 0."""
    section = data["cross_section_cm2"]
    if len(data["temperature"]) == 1:
        section, warm, share = section[..., [0, 0]], np.zeros(len(temperature), int), np.zeros(len(temperature))
    else:
        warm, share = _interval(data["temperature"], temperature)
    if len(data["pressure_hpa"]) == 1:
        section, low, part = section[..., [0, 0], :], np.zeros(len(pressure), int), np.zeros(len(pressure))
    else:
        low, part = _interval(np.log(data["pressure_hpa"]), np.log(pressure))
    lower, upper = (between(section[..., low + k, warm], section[..., low + k, warm + 1], share) for k in (0, 1))
    return between(lower, upper, part)


def _interval(grid: Floats, values: Floats) -> tuple[NDArray[np.intp], Floats]:
    """(index of the grid point below, fraction of the interval to the next) of values within a rising grid."""
    lower = np.clip(np.searchsorted(grid, values) - 1, 0, len(grid) - 2)
    return lower, np.clip((values - grid[lower]) / (grid[lower + 1] - grid[lower]), 0.0, 1.0)
