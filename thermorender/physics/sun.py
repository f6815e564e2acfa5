"""The sun: where it stands, when it rises, its light on the ground, and its own long-wave infrared above the air."""

import numpy as np

from thermorender.physics.planck import spectral_radiance

# Of the middle of the disc at 11.10 µm, measured: Saiedy and Goody (1959), doi:10.1093/mnras/119.3.213: 5036 ± 30 K.
# The disc is nearly even there, and the temperature changes by 2 % over the long-wave window.
BRIGHTNESS_TEMPERATURE_K = 5036.0
# Nominal solar radius (IAU 2015 resolution B3) at one astronomical unit.
SOLID_ANGLE_SR = np.pi * (6.957e8 / 1.495978707e11) ** 2
# Elevation up to which the sun is taken to be down [deg]: its light then lies along the ground.
LOWEST_DEG = 0.5


def irradiance(wavelength_um):
    """Return the sun's spectral irradiance above the air, square to its rays [W m⁻² µm⁻¹].

    Valid over 7–14 µm to 3 %, and to 3.4 % over the year, as the mean distance is taken.
    """
    return SOLID_ANGLE_SR * spectral_radiance(wavelength_um, BRIGHTNESS_TEMPERATURE_K)


def direction(elevation_deg, azimuth_deg):
    """Return the unit vector (3,) towards the sun in East-North-Up axes; azimuth from north, eastward positive."""
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)])


def position(latitude_deg, declination_deg, solar_hour):
    """Return the sun's (azimuth clockwise from north, elevation) [deg].

    Parameters
    ----------
    latitude_deg, declination_deg : float
        Of the site and of the sun [deg].
    solar_hour : float
        Apparent solar time [h]; 12 is the culmination.

    Notes
    -----
    Iqbal, An Introduction to Solar Radiation (1983), eqs 1.5.1 and 1.5.2.
    """
    lat, dec = np.radians(latitude_deg), np.radians(declination_deg)
    angle = np.radians(15.0 * (solar_hour - 12.0))
    up = np.sin(lat) * np.sin(dec) + np.cos(lat) * np.cos(dec) * np.cos(angle)
    east = -np.cos(dec) * np.sin(angle)
    north = np.cos(lat) * np.sin(dec) - np.sin(lat) * np.cos(dec) * np.cos(angle)
    return float(np.degrees(np.arctan2(east, north)) % 360.0), float(np.degrees(np.arcsin(np.clip(up, -1.0, 1.0))))


def sunrise(latitude_deg, declination_deg):
    """Return the apparent solar time at which the sun's centre rises over level ground [h], 0 … 12, or None.

    None is for a sun that stays up or down all day. Iqbal, An Introduction to Solar Radiation (1983), eq. 1.5.4.
    """
    cosine = -np.tan(np.radians(latitude_deg)) * np.tan(np.radians(declination_deg))
    if abs(cosine) > 1.0:
        return None
    return 12.0 - np.degrees(np.arccos(cosine)) / 15.0


def clear_sky(elevation_deg):
    """Return (direct on a plane facing the sun, diffuse on a level plane) irradiance [W m⁻²].

    Notes
    -----
    Direct: 1353 · 0.7^(m^0.678), Meinel & Meinel, Applied Solar Energy (1976), with air mass m = 1/sin(e).
    Diffuse: a tenth of the direct, as usual for clear skies.
    """
    if elevation_deg <= LOWEST_DEG:
        return 0.0, 0.0
    mass = 1.0 / np.sin(np.radians(elevation_deg))
    direct = 1353.0 * 0.7 ** (mass**0.678)
    return direct, 0.1 * direct
