"""Precipitation of weather files: tenths of millimetres, amounts of several hours, running totals, plausible sums."""

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError

Floats = NDArray[np.float64]

# A gauge of the United States counts hundredths of an inch. Recorded in whole tenths of a millimetre they are 3, 5, 8 …
_TICK_TENTHS, _BELOW_TENTHS, _MOSTLY = 2.54, 30.0, 0.7
# Periods of synoptic reports [h]; 99 marks an unknown one.
_PERIODS_H = (1, 2, 3, 4, 6, 12, 15, 18, 24)
# Most rain in an hour and a year [mm], near the records of 305 in 42 minutes and 26 470 in a year (WMO archive of
# extremes); above the second limits a note asks.
_HOUR_MM, _YEAR_MM = (200.0, 100.0), (26_500.0, 4000.0)
# A total rises further at least so often in a file, and stays above zero so long [s].
_RISES, _HELD_S, _HELD_LONG_S = 3, 6 * 3600.0, 24 * 3600.0


def in_mm(column: str, depth: Floats, fewest: int, notes: list[str]) -> Floats:
    """Return depths (N,) in mm: whole tenths of a millimetre from a gauge of 0.01 inch are divided by 10.

    At least `fewest` depths below 3 mm are needed to recognise tenths, on which `notes` gets a note; NaN is missing.
    """
    fallen = depth[depth > 0.0]
    low = fallen[fallen < _BELOW_TENTHS]
    if len(low) < fewest or (fallen % 1.0 != 0.0).any():
        return depth
    ticks = np.round(_TICK_TENTHS * np.arange(1, 13))
    if np.isin(low, ticks).mean() < _MOSTLY:
        return depth
    notes.append(f"{column} holds 3, 5, 8 …, hundredths of an inch in tenths of a millimetre: divided by 10.")
    return 0.1 * depth


def by_hour(
    path: object, depth_mm: Floats, period_h: Floats, per_hour: int, periodic: bool, notes: list[str]
) -> Floats:
    """Return amounts (N,) [mm] of single intervals; those of several hours are spread over their hours.

    `depth_mm` fell in the `period_h` hours before the end of an interval; NaN is missing, and an amount without a
    period is that of its interval. Hours with an amount of a shorter period keep it, and the rest of the longer one is
    spread evenly over the others. `periodic`: the last interval precedes the first. `notes` gets notes on spread
    amounts, and on amounts of an unknown period, which count as missing.
    """
    known = ~np.isnan(depth_mm)
    period = np.where(np.isnan(period_h) | (period_h == 0.0), 1.0 / per_hour, period_h)
    unknown = known & (period == 99.0)
    if unknown.any():
        notes.append(
            f"Rain of an unknown period (99 h) in {unknown.sum()} rows, {depth_mm[unknown].sum():.4g} mm, is left out."
        )
    known &= ~unknown
    odd = known & ~np.isin(period, (1.0 / per_hour, *_PERIODS_H))
    if odd.any():
        raise ThermorenderError(
            f"{path}: rain has a period of {period[odd][0]:g} h; give {', '.join(map(str, _PERIODS_H))} h, or leave "
            "the amount empty"
        )
    steps = np.round(period * per_hour).astype(int)
    single = known & (steps <= 1)
    amount, done = np.where(single, depth_mm, np.nan), single.copy()
    several = np.flatnonzero(known & ~single)
    for k in several[np.argsort(steps[several], kind="stable")]:
        window = np.arange(k - steps[k] + 1, k + 1)
        window = window % len(amount) if periodic else window[window >= 0]
        free = window[~done[window]]
        rest = max(depth_mm[k] - np.nansum(amount[window]), 0.0)
        amount[free], done[free] = rest / max(len(free), 1), True
    wet = several[depth_mm[several] > 0.0]
    if wet.size:
        notes.append(
            f"{wet.size} amounts of rain over {period[wet].min():g}–{period[wet].max():g} h are spread over the hours."
        )
    return amount


def looks_like_total(depth: Floats, second: Floats, step_s: float) -> str:
    """Return what amounts (N,) at times [s] in steps of `step_s` look like: "a total …", or "" for amounts.

    A total rises from values above zero or stays, for hours, and falls to nearly zero at one time of day or never;
    amounts fall soon after they rise. A single fall or none needs a day of evidence. NaN is missing.
    """
    known = ~np.isnan(depth)
    value, at = depth[known], second[known]
    change = np.diff(value)
    fall = np.flatnonzero(change < 0.0) + 1
    wet = value[:-1] > 0.0
    rises, held_s = int((wet & (change > 0.0)).sum()), step_s * int((wet & (change == 0.0)).sum())
    off_s = np.abs((np.diff(at[fall]) + 43200.0) % 86400.0 - 43200.0)
    if rises < _RISES or held_s < (_HELD_S if fall.size > 1 else _HELD_LONG_S):
        return ""
    if (value[fall] > 0.5 * value[fall - 1]).any() or (off_s > step_s).any():
        return ""
    return "a total since midnight" if fall.size else "a total that is never reset"


def amounts_of(total: Floats) -> Floats:
    """Return the amounts (N,) of a total (N,) that grows and is reset to zero; the first amount is 0.

    A rise over missing values (NaN) is spread over their intervals. A small fall is a sensor's jitter, not a reset.
    """
    index = np.flatnonzero(~np.isnan(total))
    value = total[index]
    step = np.diff(value)
    rise = np.where(value[1:] < 0.5 * value[:-1], value[1:], np.maximum(step, 0.0))
    found = np.full(total.shape, np.nan)
    found[index[:1]] = 0.0
    for first, last, amount in zip(index[:-1], index[1:], rise, strict=True):
        found[first + 1 : last + 1] = amount / (last - first)
    return found


def check_rain(where: object, column: str, rain_mm_h: Floats, step_s: float, notes: list[str]) -> None:
    """Refuse rain (N,) [mm/h] in steps of `step_s` beyond the records of an hour and a year; note rare totals."""
    advice = "divide the column by 10 if it holds tenths of a millimetre, or leave it empty to go on without rain"
    rain = np.nan_to_num(rain_mm_h) * step_s / 3600.0
    width = max(round(3600.0 / step_s), 1)
    hour = np.convolve(rain, np.ones(width), "valid") if len(rain) >= width else rain[:1]
    years = len(rain) * step_s / (365.0 * 86400.0)
    totals = [("an hour", hour.max(initial=0.0), *_HOUR_MM)]
    if years > 0.98:
        totals.append(("a year", rain.sum() / years, *_YEAR_MM))
    for period, total, most, rare in totals:
        if total > most:
            raise ThermorenderError(
                f"{where}: {column} adds up to {total:.0f} mm in {period}, of which {most:g} are allowed; {advice}"
            )
        if total > rare:
            notes.append(f"{column} adds up to {total:.0f} mm in {period}, which is rare; check its unit.")
