"""A clock that is off: measured sunlight against the sun of the place."""

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics import sun

# What is refused, and what is only told [min]. Clouds of the afternoon move the best fit of a week or more by some
# 20 min, so that an hour may look like 40.
_REFUSED_MIN, _REFUSED_LONG_MIN, _TOLD_MIN = 45, 35, 20
_STEP_MIN = 5
# Blocks are looked at apart, so that summer time shows [days].
_BLOCK_D = 30
# Clouds and hills only take light away, and move the best fit. What proves a shift is light where there cannot be any:
# so many samples above so many times a clear sky's, and so much more [W m⁻²].
_FEWEST, _TIMES, _MORE_W_M2 = 2, 1.5, 20.0
# A fit of a clear day, good enough to tell of half an hour.
_CLEAR_FIT = 0.98
_LONG_D = 7


def check_clock(where, time, light, latitude_deg, longitude_deg, step_s):
    """Return a note, or None, after refusing a series whose sunlight is 45 min or more away from the sun.

    Parameters
    ----------
    where : str
        File, for the message.
    time : (N,) datetime64[s]
        UTC, as stated.
    light : (N,)
        Global or direct · sin(elevation) + diffuse [W m⁻²].
    latitude_deg, longitude_deg, step_s : float
        Of the place; length of an averaging interval.

    Raises
    ------
    ThermorenderError
        The light agrees with the sun when it is shifted, and is there where a clear sky has much less or none.
    """
    note = None
    block = ((time - time[0]) / np.timedelta64(_BLOCK_D, "D")).astype(int)
    for number in range(block.max() + 1):
        part = block == number
        shift, fit, beyond = _shift(time[part], light[part], latitude_deg, longitude_deg, step_s)
        long = time[part][-1] - time[part][0] >= np.timedelta64(_LONG_D, "D")
        if abs(shift) >= (_REFUSED_LONG_MIN if long else _REFUSED_MIN) and beyond >= _FEWEST:
            hours = round(-shift / 30.0) / 2.0
            raise ThermorenderError(
                f"{where}: from {time[part][0]} on the sunlight comes {abs(shift)} min "
                f"{'before' if shift > 0 else 'after'} the sun of {latitude_deg:g}° north, {longitude_deg:g}° east; "
                f"the clock looks like about UTC{hours:+g} h, so state its zone, or correct the coordinates"
            )
        if note is None and abs(shift) >= _TOLD_MIN and fit > _CLEAR_FIT:
            note = (
                f"Sunlight comes {abs(shift)} min {'before' if shift > 0 else 'after'} the sun: times should be the "
                "middles of averaging intervals."
            )
    return note


def _shift(time, light, latitude_deg, longitude_deg, step_s):
    """(Minutes to add to the times, correlation with them, samples with more light than there can be without)."""
    hour = sun.solar_hour(time, longitude_deg)
    lat, dec = np.radians(latitude_deg), np.radians(sun.declination(time))
    level, swing = np.sin(lat) * np.sin(dec), np.cos(lat) * np.cos(dec)
    parts = step_s / 3600.0 * np.array([-0.4, -0.2, 0.0, 0.2, 0.4])

    def clear(later_h):
        """Mean over each interval of Haurwitz' clear sky, J. Meteorol. 2 (1945) 154."""
        height = level + swing * np.cos(np.pi / 12.0 * (hour + later_h + parts[:, None] - 12.0))
        height = np.maximum(height, 1e-3)
        return (1098.0 * height * np.exp(-0.057 / height)).mean(axis=0)

    if time.size < 6 or light.max() < 50.0:
        return 0, 0.0, 0
    shifts = np.arange(-720, 720, _STEP_MIN)
    fits = np.zeros(shifts.size)
    for index, minutes in enumerate(shifts):
        model = clear(minutes / 60.0)
        # At a pole the sun's height hardly changes within a day.
        if model.std() > 1.0 and light.std() > 0.0:
            fits[index] = np.corrcoef(light, model)[0, 1]
    best = int(np.argmax(fits))
    beyond = light > _TIMES * clear(0.0) + _MORE_W_M2
    return int(shifts[best]), fits[best], int(beyond.sum())
