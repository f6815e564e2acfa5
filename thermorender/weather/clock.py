"""A clock that is off: measured sunlight against the sun of the place."""

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics import sun

# What is refused, and what is only told [min]. Clouds of the afternoon move the best fit of a week or more by up to
# 20 min, so an hour is seen from 40 on.
_REFUSED_MIN, _REFUSED_LONG_MIN, _TOLD_MIN = 45, 40, 20
_STEP_MIN = 5
# Blocks are looked at apart, so that summer time shows [days].
_BLOCK_D = 30
# Light in the dark proves a shift: the sun under −1° all the interval, and more than 3 % of the block's most light.
_DARK_DEG, _LIGHT_SHARE, _FEWEST_DARK = -1.0, 0.03, 2
# So does a day of clear sky that fits when shifted, as afternoon clouds do not; and any sky of so many days.
_CLEAR_FIT, _GAIN, _LONG_D = 0.98, 0.01, 7


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
        The light agrees with the sun when it is shifted, and light in the dark, a clear day or a week proves it.
    """
    note = None
    block = ((time - time[0]) / np.timedelta64(_BLOCK_D, "D")).astype(int)
    for number in range(block.max() + 1):
        part = block == number
        shift, fit, gain, dark = _shift(time[part], light[part], latitude_deg, longitude_deg, step_s)
        long = time[part][-1] - time[part][0] >= np.timedelta64(_LONG_D, "D")
        proven = dark >= _FEWEST_DARK or ((fit > _CLEAR_FIT or long) and gain > _GAIN)
        if abs(shift) >= (_REFUSED_LONG_MIN if long else _REFUSED_MIN) and proven:
            hours = round(-shift / 30.0) / 2.0
            raise ThermorenderError(
                f"{where}: from {time[part][0]} on the sunlight comes {abs(shift)} min "
                f"{'before' if shift > 0 else 'after'} the sun of {latitude_deg:g}° north, {longitude_deg:g}° east; the "
                f"clock looks like about UTC{hours:+g} h, so state its zone, or correct the coordinates"
            )
        if note is None and abs(shift) >= _TOLD_MIN and fit > _CLEAR_FIT:
            note = (
                f"Sunlight comes {abs(shift)} min {'before' if shift > 0 else 'after'} the sun: times should be the "
                "middles of averaging intervals."
            )
    return note


def _shift(time, light, latitude_deg, longitude_deg, step_s):
    """(Minutes to add to the times, correlation with them, its gain over none, samples of light in the dark)."""
    hour = sun.solar_hour(time, longitude_deg)
    lat, dec = np.radians(latitude_deg), np.radians(sun.declination(time))
    shifts = np.arange(-720, 720, _STEP_MIN)
    edge = 0.5 * step_s / 3600.0

    def height(later_h):
        return np.sin(lat) * np.sin(dec) + np.cos(lat) * np.cos(dec) * np.cos(np.pi / 12.0 * (hour + later_h - 12.0))

    if time.size < 6 or light.max() < 50.0:
        return 0, 0.0, 0.0, 0
    fits = np.zeros(shifts.size)
    for index, minutes in enumerate(shifts):
        model = sum(np.maximum(height(minutes / 60.0 + part * edge), 0.0) for part in (-0.8, 0.0, 0.8))
        # Spread of a sun that does not set may vanish at a pole.
        if model.std() > 1e-3 and light.std() > 0.0:
            fits[index] = np.corrcoef(light, model)[0, 1]
    best = int(np.argmax(fits))
    highest = np.maximum(np.maximum(height(-edge), height(edge)), height(0.0))
    dark = (highest < np.sin(np.radians(_DARK_DEG))) & (light > _LIGHT_SHARE * light.max())
    return int(shifts[best]), fits[best], fits[best] - fits[shifts == 0][0], int(dark.sum())
