"""Check of a station's clock: measured sunlight against the sun's position."""

from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics import sun

# Shifts that are refused and noted [min]. Afternoon clouds move the best fit of a week or more by about 20 min, so an
# hour may look like 40 min.
_REFUSED_MIN, _REFUSED_LONG_MIN, _NOTED_MIN = 45, 35, 20
# The median of several blocks is within 5 min for correct clocks, so half an hour is certain.
_REFUSED_MEDIAN_MIN, _BLOCKS = 25, 4
_STEP_MIN = 5
# The series is checked in blocks, to detect summer time [days].
_BLOCK_D = 30
# Clouds and hills reduce light and so move the best fit. Only impossible light proves a shift: at least this many
# samples above this factor times clear-sky light plus this margin [W m⁻²].
_FEWEST, _TIMES, _MORE_W_M2 = 2, 1.5, 20.0
# Correlation on a clear day, enough to detect half an hour.
_CLEAR_FIT = 0.98
_LONG_D = 7

Times = NDArray[np.datetime64]


def check_clock(
    where: object, time: Times, light: NDArray[np.float64], latitude_deg: float, longitude_deg: float,
    step_s: float, light_shift_min: float | None = None,
) -> str | None:  # fmt: skip
    """Return a note, or None; refuse a series (N,) whose sunlight deviates from the sun's position by 45 min or more.

    Over four months or more, 25 min are refused. `light` is global, or direct · sin(elevation) + diffuse [W m⁻²], in
    intervals of `step_s`; `light_shift_min` is the user's value of that setting, None if there is none.
    """
    note, found = None, []
    block = ((time - time[0]) / np.timedelta64(_BLOCK_D, "D")).astype(int)
    for number in range(block.max() + 1):
        part = block == number
        shift, fit, beyond = _shift(time[part], light[part], latitude_deg, longitude_deg, step_s)
        long = time[part][-1] - time[part][0] >= np.timedelta64(_LONG_D, "D")
        found.append((shift, beyond, _REFUSED_LONG_MIN if long else _REFUSED_MIN, time[part][0]))
        if note is None and abs(shift) >= _NOTED_MIN and fit > _CLEAR_FIT:
            note = (
                f"Sunlight is {abs(shift)} min {'before' if shift > 0 else 'after'} the sun: times should be the "
                "middles of averaging intervals."
            )
    median = float(np.median([shift for shift, *_ in found]))
    half = 30 * round(median / 30.0)
    # Half hours are conventions; others are taken as fitted.
    whole = half if abs(median - half) <= _STEP_MIN else _STEP_MIN * round(median / _STEP_MIN)
    if len(found) >= _BLOCKS and abs(median) >= _REFUSED_MEDIAN_MIN and sum(each[1] for each in found) >= _FEWEST:
        _refuse(where, time[0], whole, latitude_deg, longitude_deg, light_shift_min)
    for shift, beyond, refused, start in found:
        if abs(shift) >= refused and beyond >= _FEWEST:
            shift = whole if abs(shift - whole) <= _NOTED_MIN else shift
            _refuse(where, start, shift, latitude_deg, longitude_deg, light_shift_min)
    return note


def _refuse(
    where: object,
    start: np.datetime64,
    shift: int,
    latitude_deg: float,
    longitude_deg: float,
    light_shift_min: float | None,
) -> NoReturn:
    hours = round(-shift / 30.0) / 2.0
    fix = "write times as the middles of averaging intervals"
    if light_shift_min is not None:
        fix = f"write light_shift_min = {light_shift_min + shift:g} into [weather] if its hours are labelled otherwise"
    raise ThermorenderError(
        f"{where}: from {start} on the sunlight is {abs(shift)} min {'before' if shift > 0 else 'after'} the sun at "
        f"{latitude_deg:g}° north, {longitude_deg:g}° east; the clock looks like about UTC{hours:+g} h, so {fix}, "
        "state its zone, or correct the coordinates"
    )


def _shift(
    time: Times, light: NDArray[np.float64], latitude_deg: float, longitude_deg: float, step_s: float
) -> tuple[int, float, int]:
    """(Minutes to add to the times, correlation after that, number of samples with impossible light before it)."""
    hour = sun.solar_hour(time, longitude_deg)
    lat, dec = np.radians(latitude_deg), np.radians(sun.declination(time))
    level, swing = np.sin(lat) * np.sin(dec), np.cos(lat) * np.cos(dec)
    parts = step_s / 3600.0 * np.array([-0.4, -0.2, 0.0, 0.2, 0.4])

    def clear(later_h: float) -> NDArray[np.float64]:
        """Interval means of Haurwitz' clear-sky irradiance, J. Meteorol. 2 (1945) 154."""
        height = level + swing * np.cos(np.pi / 12.0 * (hour + later_h + parts[:, None] - 12.0))
        height = np.maximum(height, 1e-3)
        return (1098.0 * height * np.exp(-0.057 / height)).mean(axis=0)

    if time.size < 6 or light.max() < 50.0:
        return 0, 0.0, 0
    shifts = np.arange(-720, 720, _STEP_MIN)
    fits = np.zeros(shifts.size)
    for index, minutes in enumerate(shifts):
        model = clear(minutes / 60.0)
        # At a pole the sun's elevation hardly changes within a day.
        if model.std() > 1.0 and light.std() > 0.0:
            fits[index] = np.corrcoef(light, model)[0, 1]
    best = int(np.argmax(fits))
    beyond = light > _TIMES * clear(0.0) + _MORE_W_M2
    return int(shifts[best]), float(fits[best]), int(beyond.sum())
