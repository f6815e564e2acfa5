"""Holes and offsets of measured series: mended where they are small, and told; refused where they are not."""

import numpy as np

from thermorender.errors import ThermorenderError

# Where nothing was written of them, nothing is known to have fallen or lain.
ZERO_IN_GAPS = ("rain_mm", "rain_mm_h", "snow_m")


def without_offset(column, values, notes):
    """Return short-wave (N,) with the negative offset of a sensor at night taken as 0, and told."""
    below = values < 0.0
    if below.any():
        notes.append(
            f"{below.sum()} negative values of {column}, down to {np.nanmin(values):.2g} W/m², are taken as 0."
        )
    return np.where(below, 0.0, values)


def filled(path, column, quantity, values, time, step_s, longest_gap_h, notes):
    """Return values (N,) with short gaps interpolated and told; rain and snow are 0 in gaps of any length.

    Parameters
    ----------
    path, column : str
        For messages.
    quantity : str
        Name of ours.
    values : (N,)
        NaN where missing, not everywhere.
    time : (N,) datetime64[s]
    step_s, longest_gap_h : float
        Step of the series; longest gap to interpolate.
    notes : list
        Is added to.

    Raises
    ------
    ThermorenderError
        A longer gap; the sentence says from when to when.
    """
    hole = np.isnan(values)
    if not hole.any():
        return values
    if quantity in ZERO_IN_GAPS:
        notes.append(f"{hole.sum()} values of {column} are missing and taken as 0.")
        return np.where(hole, 0.0, values)
    good = np.flatnonzero(~hole)
    second = (time - time[0]).astype(np.float64)
    # From the series' ends to the first and last value counts as well.
    edges = np.concatenate([[second[0] - step_s], second[good], [second[-1] + step_s]])
    gap = np.diff(edges) - step_s
    k = int(np.argmax(gap))
    if gap[k] > 3600.0 * longest_gap_h:
        first, last = (time[0] + np.timedelta64(int(edge), "s") for edge in (edges[k] + step_s, edges[k + 1] - step_s))
        raise ThermorenderError(
            f"{path}: {column} is missing from {first}Z to {last}Z, longer than the {longest_gap_h:g} h that are "
            "interpolated; fill the gap, leave the column out to have it modelled, or keep the rows before or after it"
        )
    notes.append(f"{hole.sum()} values of {column} are missing, for {gap[k] / 3600.0:.2g} h at most, and interpolated.")
    return np.interp(second, second[good], values[good])
