"""Units at the border: temperatures are kelvin and instants UTC inside; °C and clocks without a zone are refused."""

import datetime
import re

import numpy as np

from thermorender.errors import ThermorenderError, shortened

ZERO_CELSIUS_K = 273.15

# No surface, sky or air of a scene is colder than this in the thermal band, and nearly every °C value
# is below it, so the check catches the commonest mistake: °C given as kelvin.
LOWEST_KELVIN = 100.0
_FARTHEST_ZONE_S = 14 * 3600


def kelvin(name, temperature, allow_zero=False):
    """Return `temperature` unchanged [K] after refusing values that cannot be a scene's kelvin.

    Parameters
    ----------
    name : str
        What the value is called where the user wrote it, for the message.
    temperature : float or array
        Kelvin; NaN marks "no value" in arrays and passes there, not in a single value.
    allow_zero : bool
        Accept exactly 0 K, which radiates nothing (a cold space outside a cavity).

    Raises
    ------
    ThermorenderError
        A value is below 100 K (most likely °C) or infinite.
    """
    values = np.asarray(temperature, dtype=np.float64)
    bad = (values < LOWEST_KELVIN) | np.isinf(values) | (np.isnan(values) & (values.ndim == 0))
    if allow_zero:
        bad &= values != 0.0
    if bad.any():
        worst = values[bad].min() if values.ndim else float(values)
        raise ThermorenderError(
            f"{name}={worst:g} is below {LOWEST_KELVIN:g} K or not finite; "
            f"values are kelvin, add {ZERO_CELSIUS_K} to °C"
        )
    return temperature


def instant(name, value):
    """Return an instant as datetime64[s], UTC.

    Parameters
    ----------
    name : str
        What the value is called where the user wrote it, for the message.
    value : str, datetime or datetime64
        ISO 8601 with its zone, such as 2018-07-28T14:30Z or 2018-07-28T16:30:00+02:00, to whole seconds; a datetime
        with its zone; a datetime64, which is UTC.

    Raises
    ------
    ThermorenderError
        No such instant, or one without a zone.
    """
    if isinstance(value, np.datetime64) and not np.isnat(value):
        return value.astype("datetime64[s]")
    text = value.isoformat() if isinstance(value, datetime.datetime) else str(value).strip()
    found = re.fullmatch(r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d(?::\d\d)?)(?:[Zz]|([+-])(\d\d):?(\d\d))?", text)
    try:
        clock = np.datetime64(f"{found[1]}T{found[2]}", "s")
        east = datetime.timedelta(hours=int(found[4] or 0), minutes=int(found[5] or 0)) if found[3] else None
    except (TypeError, ValueError):
        raise ThermorenderError(
            f"{name}={shortened(text)} is no instant; give date, T, hour and minute with their zone, such as "
            "2018-07-28T14:30Z or 2018-07-28T16:30+02:00"
        ) from None
    if east is None:
        if text[-1] in "Zz":
            return clock
        raise ThermorenderError(
            f"{name}={text} has no zone; add Z where it is UTC, or the offset from UTC of its clock, such as +02:00"
        )
    seconds = int(east.total_seconds())
    if seconds > _FARTHEST_ZONE_S:
        raise ThermorenderError(f"{name}={text} has an offset that no clock has; give one from -14:00 to +14:00")
    return clock - np.timedelta64(seconds if found[3] == "+" else -seconds, "s")


def utc_text(time):
    """Return an instant (datetime64, UTC) as ISO 8601 text that ends in Z."""
    return f"{np.datetime_as_string(time)}Z"
