"""The sun's own long-wave infrared light, above the air."""

import numpy as np

from thermorender.physics.planck import spectral_radiance

# Of the middle of the disc at 11.10 µm, measured: Saiedy and Goody (1959), doi:10.1093/mnras/119.3.213: 5036 ± 30 K.
# The disc is nearly even there, and the temperature changes by 2 % over the long-wave window.
BRIGHTNESS_TEMPERATURE_K = 5036.0
# Nominal solar radius (IAU 2015 resolution B3) at one astronomical unit.
SOLID_ANGLE_SR = np.pi * (6.957e8 / 1.495978707e11) ** 2


def irradiance(wavelength_um):
    """Return the sun's spectral irradiance above the air, square to its rays [W m⁻² µm⁻¹].

    Valid over 7–14 µm to 3 %, and to 3.4 % over the year, as the mean distance is taken.
    """
    return SOLID_ANGLE_SR * spectral_radiance(wavelength_um, BRIGHTNESS_TEMPERATURE_K)


def direction(elevation_deg, azimuth_deg):
    """Return the unit vector (3,) towards the sun in East-North-Up axes; azimuth from north, eastward positive."""
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)])
