"""Gaps and offsets of measured series: small ones are repaired and noted, large ones refused."""

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError

# Missing values of rain and snow count as 0.
ZERO_IN_GAPS = ("rain_mm", "rain_mm_h", "snow_m")


def without_offset(column: str, values: NDArray[np.float64], notes: list[str]) -> NDArray[np.float64]:
    """Return short-wave (N,) with a sensor's negative offsets at night set to 0, and add a note."""
    below = values < 0.0
    if below.any():
        notes.append(
            f"{below.sum()} negative values of {column}, down to {np.nanmin(values):.2g} W/m², are taken as 0."
        )
    return np.where(below, 0.0, values)


def long_gaps(
    values: NDArray[np.float64], time: NDArray[np.datetime64], step_s: float, longest_gap_h: float
) -> list[tuple[np.datetime64, np.datetime64]]:
    """Return (first, last missing instant) of the gaps above `longest_gap_h`, also at the ends of the series."""
    good = np.flatnonzero(~np.isnan(values))
    second = (time - time[0]).astype(np.float64)
    edges = np.concatenate([[second[0] - step_s], second[good], [second[-1] + step_s]])
    wide = np.flatnonzero(np.diff(edges) - step_s > 3600.0 * longest_gap_h)
    at = [time[0] + np.timedelta64(int(edge), "s") for edge in edges]
    step = np.timedelta64(int(step_s), "s")
    return [(at[k] + step, at[k + 1] - step) for k in wide]


def filled(
    path: object, column: str, quantity: str, values: NDArray[np.float64], time: NDArray[np.datetime64], step_s: float,
    longest_gap_h: float, notes: list[str],
) -> NDArray[np.float64]:  # fmt: skip
    """Return values (N,) with gaps (NaN) up to `longest_gap_h` interpolated; rain and snow are 0 in gaps of any length.

    At least one value is a number; `notes` gets a note on the gaps.
    """
    hole = np.isnan(values)
    if not hole.any():
        return values
    if quantity in ZERO_IN_GAPS:
        notes.append(f"{hole.sum()} values of {column} are missing and taken as 0.")
        return np.where(hole, 0.0, values)
    long = long_gaps(values, time, step_s, longest_gap_h)
    if long:
        first, last = max(long, key=lambda gap: gap[1] - gap[0])
        raise ThermorenderError(
            f"{path}: {column} is missing from {first}Z to {last}Z, longer than the {longest_gap_h:g} h that are "
            "interpolated; fill the gap, leave the column out to have it modelled, keep the rows before or after it, "
            "or give a larger longest_gap_h"
        )
    good = np.flatnonzero(~hole)
    second = (time - time[0]).astype(np.float64)
    edges = np.concatenate([[second[0] - step_s], second[good], [second[-1] + step_s]])
    longest_h = (np.diff(edges).max() - step_s) / 3600.0
    notes.append(f"{hole.sum()} values of {column} are missing, for {longest_h:.2g} h at most, and interpolated.")
    return np.interp(second, second[good], values[good])
