"""Checks of the user's temperatures (kelvin) and instants (UTC); °C and times without a zone are refused."""

import datetime
import re
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError, shortened

# What an argument that is one number may be: Python's or NumPy's, of any precision.
Number: TypeAlias = float | np.floating[Any] | np.integer[Any]
ZERO_CELSIUS_K = 273.15

# Every surface, sky and air of a scene is warmer than this in the thermal band, and nearly every °C value is below it.
# The check therefore catches the commonest mistake: °C given as kelvin.
LOWEST_KELVIN = 100.0
_FARTHEST_ZONE_S = 14 * 3600
# (kelvin per unit, kelvin of 0) by the names that rasters and TIFFs give to units, in lower case without "degrees".
_SCALES = (
    dict.fromkeys(("k", "kelvin", "kelvins"), (1.0, 0.0))
    | dict.fromkeys(("c", "celsius", "centigrade"), (1.0, ZERO_CELSIUS_K))
    | dict.fromkeys(("f", "fahrenheit"), (1.0 / 1.8, ZERO_CELSIUS_K - 32.0 / 1.8))
)
_STATED = re.compile(r"\s*(\d+(?:\.\d+)?)\s*K\s*")


class Stated(float):
    """A temperature whose unit was stated as "77 K", so that it may be below 100 K."""


def with_unit(value: object) -> object:
    """Return a Stated temperature for a text such as "77 K"; any other value unchanged."""
    found = _STATED.fullmatch(value) if isinstance(value, str) else None
    return Stated(found[1]) if found else value


_Temperature = TypeVar("_Temperature", bound=ArrayLike)


def kelvin(name: str, temperature: _Temperature, allow_zero: bool = False) -> _Temperature:
    """Return `temperature` unchanged [K] after refusing values that are not plausible in kelvin, by their `name`.

    NaN means "no value" and is allowed in arrays, not in a single value. `allow_zero` accepts exactly 0 K, which
    radiates nothing (a cold space outside a cavity).
    """
    values = np.asarray(temperature, dtype=np.float64)
    bad = (values < LOWEST_KELVIN) | np.isinf(values) | (np.isnan(values) & (values.ndim == 0))
    if allow_zero:
        bad &= values != 0.0
    if isinstance(temperature, Stated):
        bad &= False
    if bad.any():
        worst = values[bad].min() if values.ndim else float(values)
        raise ThermorenderError(
            f"{name}={worst:g} is below {LOWEST_KELVIN:g} K or not finite; "
            f"values are kelvin, add {ZERO_CELSIUS_K} to °C"
            + (f", or write '{worst:g} K' if it is that cold" if 0.0 <= worst < LOWEST_KELVIN else "")
        )
    return temperature


def kelvin_scale(unit: str | None) -> tuple[float, float] | None:
    """Return (kelvin per unit, kelvin of 0) of a unit's name, such as K, °C or degF; None for other units."""
    word = re.sub(r"^(°|º|deg(rees?)?)?[ _.]*", "", (unit or "").strip().lower())
    return _SCALES.get(word)


def instant(name: str, value: str | datetime.datetime | np.datetime64) -> np.datetime64:
    """Return an instant as datetime64[s], UTC, by its `name` in messages.

    `value` is ISO 8601 with a zone, such as 2018-07-28T14:30Z or 2018-07-28T16:30:00+02:00; or a datetime with a
    zone. Fractions of a second are dropped. NumPy's datetime64 cannot have a zone: it is UTC in all of this package.
    """
    if isinstance(value, np.datetime64) and not np.isnat(value):
        return value.astype("datetime64[s]")
    text = value.isoformat() if isinstance(value, datetime.datetime) else str(value).strip()
    whole = re.sub(r"(?<=\d:\d\d:\d\d)[.,]\d+", "", text)
    found = re.fullmatch(r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d(?::\d\d)?)(?:[Zz]|([+-])(\d\d):?(\d\d))?", whole)
    try:
        day, hour, sign, hours, minutes = found.groups() if found else []
        clock = np.datetime64(f"{day}T{hour}", "s")
        east = datetime.timedelta(hours=int(hours), minutes=int(minutes)) if sign else None
    except ValueError:
        raise ThermorenderError(
            f"{name}={shortened(text)} is not an instant; give date, T, hour, minute and zone, such as "
            "2018-07-28T14:30Z or 2018-07-28T16:30+02:00"
        ) from None
    if east is None:
        if text[-1] in "Zz":
            return clock
        raise ThermorenderError(f"{name}={text} has no zone; add Z for UTC, or the offset from UTC, such as +02:00")
    seconds = int(east.total_seconds())
    if seconds > _FARTHEST_ZONE_S:
        raise ThermorenderError(f"{name}={text} has an impossible offset from UTC; give one from -14:00 to +14:00")
    return clock - np.timedelta64(seconds if sign == "+" else -seconds, "s")


def instants(name: str, values: ArrayLike) -> NDArray[np.datetime64]:
    """Return instants of any shape as datetime64[s], UTC; each is as of `instant`."""
    given = np.asarray(values)
    if given.dtype.kind == "M":
        return given.astype("datetime64[s]")
    found = [instant(name, value) for value in given.ravel().tolist()]
    return np.array(found, "datetime64[s]").reshape(given.shape)


def utc_text(time: np.datetime64) -> str:
    """Return an instant (datetime64, UTC) as ISO 8601 text with a trailing Z."""
    return f"{np.datetime_as_string(time)}Z"
