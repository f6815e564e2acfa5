"""Gaps and offsets of measured series: small ones are repaired and noted, large ones refused."""

from collections.abc import Mapping

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


def unbroken(
    time: NDArray[np.datetime64], values: Mapping[str, NDArray[np.float64]], column_of: Mapping[str, str],
    step_s: float, longest_gap_h: float, around: np.datetime64, notes: list[str], zone: str = "Z",
) -> tuple[np.datetime64, np.datetime64]:  # fmt: skip
    """Return the first and last instant around an instant without a gap longer than those interpolated.

    `values` are series (N,) by quantity, `column_of` their names in messages; `notes` gets a note on rows left out,
    whose times have the suffix `zone`. A quantity without any value has no gap.
    """
    first, last = time[0], time[-1]
    step = np.timedelta64(int(step_s), "s")
    gaps = [("all columns", time[k] + step, time[k + 1] - step)
            for k in np.flatnonzero(np.diff(time).astype(np.float64) - step_s > 3600.0 * longest_gap_h)]  # fmt: skip
    for name, series in values.items():
        if name not in ZERO_IN_GAPS and not np.isnan(series).all():
            gaps += [(column_of[name], *gap) for gap in long_gaps(series, time, step_s, longest_gap_h)]
    for column, start, end in gaps:
        period = f"from {start}{zone} to {end}{zone}"
        why = f"because {column} is missing {period}, longer than the {longest_gap_h:g} h interpolated."
        if end < around and end >= first:
            first = end + step
            notes.append(f"Rows before {first}{zone} are left out, {why}")
        elif start > around and start <= last:
            last = start - step
            notes.append(f"Rows after {last}{zone} are left out, {why}")
    return first, last


def filled(
    path: object, column: str, quantity: str, values: NDArray[np.float64], time: NDArray[np.datetime64], step_s: float,
    longest_gap_h: float, notes: list[str], zone: str = "Z",
    advice: str = "leave the column out to have it modelled, keep the rows before or after it, or give a larger "
    "longest_gap_h",
) -> NDArray[np.float64]:  # fmt: skip
    """Return values (N,) with gaps (NaN) up to `longest_gap_h` interpolated; rain and snow are 0 in gaps of any length.

    `notes` gets a note on the gaps. A refusal has times with the suffix `zone` and ends with `advice`.
    """
    hole = np.isnan(values)
    if not hole.any():
        return values
    if quantity in ZERO_IN_GAPS:
        notes.append(f"{hole.sum()} values of {column} are missing and taken as 0.")
        return np.where(hole, 0.0, values)
    if hole.all():
        raise ThermorenderError(
            f"{path}: {column} has no value from {time[0]}{zone} to {time[-1]}{zone}; give values, {advice}"
        )
    long = long_gaps(values, time, step_s, longest_gap_h)
    if long:
        first, last = max(long, key=lambda gap: gap[1] - gap[0])
        raise ThermorenderError(
            f"{path}: {column} is missing from {first}{zone} to {last}{zone}, longer than the {longest_gap_h:g} h that "
            f"are interpolated; fill the gap, {advice}"
        )
    good = np.flatnonzero(~hole)
    second = (time - time[0]).astype(np.float64)
    edges = np.concatenate([[second[0] - step_s], second[good], [second[-1] + step_s]])
    longest_h = (np.diff(edges).max() - step_s) / 3600.0
    notes.append(f"{hole.sum()} values of {column} are missing, for {longest_h:.2g} h at most, and interpolated.")
    return np.interp(second, second[good], values[good])
