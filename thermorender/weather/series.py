"""The Weather of a place, a time series."""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics import moisture, sun
from thermorender.units import ZERO_CELSIUS_K, instants

Floats = NDArray[np.float64]

# Lowest and highest value of each quantity and number of a Weather.
_LIMITS = {
    "air_k": (150.0, 350.0), "vapour_pa": (0.0, 20e3), "wind_m_s": (0.0, 120.0), "direct_w_m2": (0.0, 2000.0),
    "diffuse_w_m2": (0.0, 2000.0), "longwave_w_m2": (0.0, 1000.0), "rain_mm_h": (0.0, 2500.0),
    "pressure_pa": (10e3, 120e3), "snow_m": (0.0, 50.0), "latitude_deg": (-90.0, 90.0),
    "longitude_deg": (-360.0, 360.0), "altitude_m": (-1000.0, 10e3), "air_height_m": (0.01, 1000.0),
    "wind_height_m": (0.01, 1000.0),
}  # fmt: skip
# Snow may lie longer than it is recorded: old patches of a metre [mm of water] at a density of 500 kg/m³ melt within
# this time [days]. Shorter records than the second time do not show it.
_OLD_SNOW_MM, _PATCHES_D, _SHORTEST_D = 500.0, 30.0, 2.0


class Conditions(NamedTuple):
    """The weather at some instants: arrays of their shape, units as in `Weather`."""

    air_k: Floats
    vapour_pa: Floats
    wind_m_s: Floats
    direct_w_m2: Floats
    diffuse_w_m2: Floats
    longwave_w_m2: Floats
    rain_mm_h: Floats
    pressure_pa: Floats
    snow_m: Floats


@dataclass(frozen=True, eq=False)
class Weather:
    """Weather at N ≥ 2 instants, (N,) float64 each.

    Attributes
    ----------
    time : (N,) datetime64[s]
        Rising; the middles of averaging intervals. A datetime64 is UTC; text and datetimes need their zone.
    air_k, vapour_pa, wind_m_s : (N,)
        Air temperature, vapour pressure, wind speed.
    direct_w_m2, diffuse_w_m2, longwave_w_m2 : (N,)
        Direct sunlight normal to its rays; the sky's short-wave and broadband long-wave on a level plane.
    rain_mm_h, pressure_pa, snow_m : (N,)
        Rate of precipitation as water, air pressure, depth of snow on the ground.
    latitude_deg, longitude_deg, altitude_m : float
        Of the place; north and east positive, altitude above sea level.
    air_height_m, wind_height_m : float
        Of the sensors above the ground (above a canopy's displacement height).
    notes : tuple of str
        How missing or invalid values were replaced, one sentence each.
    """

    time: NDArray[np.datetime64]
    air_k: Floats
    vapour_pa: Floats
    wind_m_s: Floats
    direct_w_m2: Floats
    diffuse_w_m2: Floats
    longwave_w_m2: Floats
    rain_mm_h: Floats
    pressure_pa: Floats
    snow_m: Floats
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    air_height_m: float = 2.0
    wind_height_m: float = 10.0
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse times that do not rise, series of other lengths, and values that are not finite or out of range."""
        time = np.array(instants("time", self.time))
        time.flags.writeable = False
        object.__setattr__(self, "time", time)
        if self.time.ndim != 1 or self.time.size < 2 or not (np.diff(self.time) > np.timedelta64(0, "s")).all():
            raise ThermorenderError("time of a Weather does not rise; give at least two instants in rising order")
        for name in Conditions._fields:
            values = np.asarray(getattr(self, name), np.float64)
            if values.shape != self.time.shape or not np.isfinite(values).all():
                raise ThermorenderError(
                    f"{name} of a Weather has the shape {values.shape} or values that are not finite; give "
                    f"{self.time.size} finite numbers, one for each instant"
                )
            values = values.copy()
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        for name, (low, high) in _LIMITS.items():
            values = np.atleast_1d(np.asarray(getattr(self, name), np.float64))
            # Rounding may leave light just below 0.
            if not (fits := (values >= low - 1e-6) & (values <= high)).all():
                raise ThermorenderError(
                    f"{name} of a Weather is {values[np.argmin(fits)]:g}, which is not allowed; give {low:g} … {high:g}"
                )

    def at(self, time: sun.Times) -> Conditions:
        """Return the Conditions, linearly interpolated, at instants of any shape, as of `time`.

        Raises
        ------
        ThermorenderError
            An instant is outside the series, or a text or datetime without a zone.
        """
        time = instants("time", time)
        outside = (time < self.time[0]) | (time > self.time[-1]) | np.isnat(time)
        if outside.any():
            raise ThermorenderError(
                f"time={time[outside].flat[0]}Z is outside the weather, which runs from {self.time[0]}Z to "
                f"{self.time[-1]}Z; ask for a time within it, or give the weather of that time"
            )
        second = (self.time - self.time[0]).astype(np.float64)
        asked = (time - self.time[0]).astype(np.float64)
        return Conditions(*(np.interp(asked, second, getattr(self, name)) for name in Conditions._fields))

    @property
    def knows_rain(self) -> bool:
        """Whether rain is in the series; a series without any says nothing on the soil's moisture."""
        return bool(self.rain_mm_h.any())

    def likely_snow_mm(self, time: np.datetime64) -> float:
        """Return the water [mm] that fell as snow before an instant and has not melted since, where none is stated.

        `moisture.snow_water`; 0 if the series has snow on the ground.
        """
        if self.snow_m.any():
            return 0.0
        past = slice(max(int(np.searchsorted(self.time, time, side="right")), 1))
        snow, _ = moisture.snow_water(self.time[past], self.latitude_deg, self.air_k[past], self.rain_mm_h[past])
        return float(snow[-1])

    def why_no_snow(self, time: np.datetime64) -> str:
        """Return why no snow or ice can lie at an instant, as a clause; "" if it may, or if too little is known.

        In the 30 days before, or what the series has of them, no snow was on the ground, the air was too warm for
        precipitation to be snow, and by the degree days of `moisture` it melts a metre of old snow in 30 days.
        """
        days = (time - self.time) / np.timedelta64(1, "D")
        past = (days >= 0.0) & (days <= _PATCHES_D)
        length = float(np.ptp(days[past])) if past.sum() > 1 else 0.0
        if length < _SHORTEST_D or self.snow_m[past].any():
            return ""
        air, when = self.air_k[past], self.time[past]
        lowest = float(air.min()) - ZERO_CELSIUS_K
        daily = float(moisture.melt(when, self.latitude_deg, air).sum()) / length
        if lowest < moisture.SNOW_C or daily * _PATCHES_D < _OLD_SNOW_MM:
            return ""
        return (
            f"in the {length:.0f} days before, the weather has no snow on the ground and air of {lowest:.1f} °C or "
            f"more, which melts a metre of old snow in {_OLD_SNOW_MM / daily:.0f} days"
        )

    def sun(self, time: sun.Times) -> tuple[Floats, Floats]:
        """Return the sun's (azimuth clockwise from north, elevation) [deg] at instants; see `sun.position_at`."""
        return sun.position_at(instants("time", time), self.latitude_deg, self.longitude_deg)

    def __repr__(self) -> str:
        """Return period, place, ranges and notes, one per line."""
        lines = [
            f"Weather of {self.latitude_deg:.3f}°, {self.longitude_deg:.3f}°, {self.altitude_m:.0f} m, "
            f"{self.time[0]}Z to {self.time[-1]}Z, {self.time.size} instants"
        ]
        for item in fields(self):
            if item.name in Conditions._fields:
                values = getattr(self, item.name)
                lines.append(f"  {item.name}: {values.min():.5g} … {values.max():.5g}")
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])
