"""The sun: position, time of sunrise, and thermal infrared irradiance above the atmosphere."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.planck import spectral_radiance

# Brightness temperature of the disc: up to 4 µm of the spectrum of ASTM G173-03 (Gueymard 2004,
# doi:10.1016/j.solener.2003.08.039), to 1.5 %; at 8 µm MODTRAN's; at 11.10 µm measured at the centre by Saiedy and
# Goody (1959), doi:10.1093/mnras/119.3.213: 5036 ± 30 K. The disc is nearly uniform there.
_WAVELENGTH_UM = (3.0, 3.3, 4.0, 8.0, 11.1)
_BRIGHTNESS_K = (5710.0, 5625.0, 5580.0, 5150.0, 5036.0)
# Nominal solar radius (IAU 2015 resolution B3) at one astronomical unit.
SOLID_ANGLE_SR = np.pi * (6.957e8 / 1.495978707e11) ** 2
# Up to this elevation the sun counts as down [deg].
LOWEST_DEG = 0.5
# The Earth's radius as seen from the sun [deg] (IAU 1976: 8.794″).
_PARALLAX_DEG = 8.794 / 3600.0

Times = NDArray[np.datetime64] | np.datetime64


def irradiance(wavelength_um: ArrayLike) -> NDArray[np.float64]:
    """Return the sun's spectral irradiance above the atmosphere, normal to its rays [W m⁻² µm⁻¹].

    At the mean distance, over 3–14 µm; uncertain by 2 % up to 4 µm, by 3 % beyond, and by another 3.4 % over the year.
    """
    return SOLID_ANGLE_SR * spectral_radiance(wavelength_um, brightness_temperature(wavelength_um))


def brightness_temperature(wavelength_um: ArrayLike) -> NDArray[np.float64]:
    """Return the temperature [K] of a blackbody disc as bright as the sun's, over 3–14 µm."""
    return np.interp(np.asarray(wavelength_um, np.float64), _WAVELENGTH_UM, _BRIGHTNESS_K)


def direction(elevation_deg: float, azimuth_deg: float) -> NDArray[np.float64]:
    """Return the unit vector (3,) [1] towards the sun in East-North-Up axes; azimuth clockwise from north [deg]."""
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)])


def position_at(
    time: Times, latitude_deg: float, longitude_deg: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sun's (azimuth clockwise from north, elevation) [deg] at instants, in the shape of `time`.

    Valid from 1950 to 2050 (UTC), for any longitude; at a pole the meridian of the longitude defines the azimuth. The
    elevation is that of the disc's centre. It includes parallax, but not refraction (0.5° at the horizon, 0.1° at 10°).
    The Astronomical Almanac's low-precision formulae, as collected by Michalsky, Solar Energy 40 (1988) 227,
    doi:10.1016/0038-092X(88)90045-X. The error against the full theory is 0.003° on average, 0.011° at most.
    """
    declination, _ = _ecliptic(time)
    lat, dec = np.radians(latitude_deg), np.radians(declination)
    angle = np.radians(15.0 * (solar_hour(time, longitude_deg) - 12.0))
    up = np.sin(lat) * np.sin(dec) + np.cos(lat) * np.cos(dec) * np.cos(angle)
    east = -np.cos(dec) * np.sin(angle)
    north = np.cos(lat) * np.sin(dec) - np.sin(lat) * np.cos(dec) * np.cos(angle)
    level = np.hypot(east, north)
    return np.degrees(np.arctan2(east, north)) % 360.0, np.degrees(np.arctan2(up, level)) - _PARALLAX_DEG * level


def solar_hour(time: Times, longitude_deg: float) -> NDArray[np.float64]:
    """Return the apparent solar time [h], 0 … 24, at UTC instants and a longitude [deg]; source as `position_at`."""
    days = _days(time)
    _, ascension = _ecliptic(time)
    sidereal = 6.697375 + 0.0657098242 * days + 24.0 * ((days + 0.5) % 1.0)
    return (sidereal + (longitude_deg - ascension) / 15.0 + 12.0) % 24.0


def declination(time: Times) -> NDArray[np.float64]:
    """Return the sun's declination [deg] at UTC instants; validity and source as `position_at`."""
    return _ecliptic(time)[0]


def eccentricity(time: Times) -> NDArray[np.float64]:
    """Return the sun's irradiance over that at the mean distance [1], 0.966 … 1.035; instants as in `position_at`."""
    anomaly = np.radians(357.528 + 0.9856003 * _days(time))
    return (1.00014 - 0.01671 * np.cos(anomaly) - 0.00014 * np.cos(2.0 * anomaly)) ** -2


def _days(time: Times) -> Any:
    """Days since 2000-01-01 12:00 UTC."""
    return (np.asarray(time, "datetime64[ms]") - np.datetime64("2000-01-01T12:00")) / np.timedelta64(86_400_000, "ms")


def _ecliptic(time: Times) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(Declination, right ascension) [deg] of the sun."""
    days = _days(time)
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly))
    obliquity = np.radians(23.439 - 4e-7 * days)
    ascension = np.arctan2(np.cos(obliquity) * np.sin(longitude), np.cos(longitude))
    return np.degrees(np.arcsin(np.sin(obliquity) * np.sin(longitude))), np.degrees(ascension)


def sunrise(latitude_deg: float, declination_deg: float) -> float | None:
    """Return the apparent solar time of sunrise over level ground [h], 0 … 12; None without sunrise on that day.

    Iqbal, An Introduction to Solar Radiation (1983), eq. 1.5.4.
    """
    cosine = -np.tan(np.radians(latitude_deg)) * np.tan(np.radians(declination_deg))
    if abs(cosine) > 1.0:
        return None
    return 12.0 - np.degrees(np.arccos(cosine)) / 15.0


def day_h(latitude_deg: float, declination_deg: float) -> float:
    """Return the time from sunrise to sunset over level ground [h], 0 … 24; source as `sunrise`."""
    rises = sunrise(latitude_deg, declination_deg)
    if rises is None:
        return 24.0 if latitude_deg * declination_deg > 0.0 else 0.0
    return 24.0 - 2.0 * rises
