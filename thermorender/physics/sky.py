"""Sun and sky on the ground: the light of clear skies, its division into direct and diffuse, clouds, long-wave.

Irradiances are broadband [W m⁻²]: *direct* on a plane that faces the sun, *diffuse*, *global* and *long-wave* down on a
level plane. Arguments broadcast.
"""

import numpy as np

from thermorender.physics.balance import STEFAN_BOLTZMANN
from thermorender.physics.humidity import precipitable_water

SOLAR_CONSTANT_W_M2 = 1361.0  # IAU 2015 resolution B3
# Aerosol taken where none is stated, optical depth at 0.5 µm at sea level, thinning with altitude by the scale height.
AEROSOL_AT_SEA = 0.1
_AEROSOL_SCALE_M = 2000.0
# Ångström's exponent, which carries the depth at 0.5 µm to 0.38 µm.
_ANGSTROM = 1.3
_OZONE_CM = 0.3
# Beyond this air mass (4° of elevation) Bird's Rayleigh extinction would fall; it grows instead by so much per air
# mass, as Kasten's does there, Solar Energy 56 (1996) 239, doi:10.1016/0038-092X(95)00114-7.
_RAYLEIGH_MASS, _RAYLEIGH_BEYOND = 14.0, 0.013


def standard_aerosol(altitude_m):
    """Return the aerosol optical depth at 0.5 µm [1] taken where none is measured: 0.1 at sea level, e-fold in 2 km.

    A chosen, clean continental air; ± 0.05 is ± 6 % of the direct light at a high sun.
    """
    return AEROSOL_AT_SEA * np.exp(-np.maximum(altitude_m, 0.0) / _AEROSOL_SCALE_M)


def air_mass(elevation_deg):
    """Return the relative optical air mass [1], 1 in the zenith, 38 at the horizon and below.

    Kasten and Young, Appl. Opt. 28 (1989) 4735, doi:10.1364/AO.28.004735, eq. 3, of the refracted elevation; of the
    true one it is 1 % less at 5°.
    """
    elevation = np.maximum(elevation_deg, 0.0)
    return 1.0 / (np.sin(np.radians(elevation)) + 0.50572 * (elevation + 6.07995) ** -1.6364)


def clear_sky(elevation_deg, pressure_pa, water_cm, aerosol, distance=1.0, albedo=0.2):
    """Return (direct, diffuse) irradiance under a cloudless sky [W m⁻²], 0 where the sun is down.

    Parameters
    ----------
    elevation_deg : array
        Of the sun.
    pressure_pa : array
        At the ground.
    water_cm : array
        Precipitable water.
    aerosol : array
        Optical depth at 0.5 µm.
    distance : array
        `sun.eccentricity`.
    albedo : array
        Of the ground, whose light the sky throws back.

    Notes
    -----
    Bird and Hulstrom, A Simplified Clear Sky Model for Direct and Diffuse Insolation, SERI/TR-642-761 (1981); ozone
    0.3 cm, aerosol's single-scattering albedo 0.9 and forward share 0.85. Against rigorous codes 3 % direct, 5 %
    diffuse up to an air mass of 5.6 (10°).
    """
    up = elevation_deg > 0.0
    mass = air_mass(elevation_deg)
    dense = mass * pressure_pa / 101325.0
    most = np.minimum(dense, _RAYLEIGH_MASS)
    rayleigh = 0.0903 * most**0.84 * (1.0 + most - most**1.01) + _RAYLEIGH_BEYOND * (dense - most)
    rayleigh = np.exp(-rayleigh)
    ozone = _OZONE_CM * mass
    ozone = (
        1.0
        - 0.1611 * ozone * (1.0 + 139.48 * ozone) ** -0.3035
        - 0.002715 * ozone / (1.0 + 0.044 * ozone + 3e-4 * ozone**2)
    )
    gas = np.exp(-0.0127 * dense**0.26)
    water = water_cm * mass
    water = 1.0 - 2.4959 * water / ((1.0 + 79.034 * water) ** 0.6828 + 6.385 * water)
    depth = (0.27583 * (0.5 / 0.38) ** _ANGSTROM + 0.35) * aerosol
    haze = np.exp(-(depth**0.873) * (1.0 + depth - depth**0.7088) * mass**0.9108)
    absorbed = 1.0 - 0.1 * (1.0 - mass + mass**1.06) * (1.0 - haze)
    sunlight = SOLAR_CONSTANT_W_M2 * distance * ozone * gas * water
    direct = 0.9662 * sunlight * haze * rayleigh
    height = np.sin(np.radians(np.maximum(elevation_deg, 0.0)))
    scattered = 0.5 * (1.0 - rayleigh) + 0.85 * (1.0 - haze / absorbed)
    scattered = sunlight * height * 0.79 * absorbed * scattered / (1.0 - mass + mass**1.02)
    returned = albedo * (0.0685 + 0.15 * (1.0 - haze / absorbed))
    diffuse = (direct * height + scattered) / (1.0 - returned) - direct * height
    return np.where(up, direct, 0.0), np.where(up, diffuse, 0.0)


def clearest_direct(elevation_deg, pressure_pa, water_cm, distance=1.0):
    """Return the direct irradiance [W m⁻²] of an air without aerosol: none is stronger. As `clear_sky`."""
    return clear_sky(elevation_deg, pressure_pa, water_cm, 0.0, distance)[0]


def split_global(total, elevation_deg, distance, limit):
    """Return (direct, diffuse) of a measured global irradiance [W m⁻²]; direct · sin(elevation) + diffuse is it.

    Parameters
    ----------
    total : array
        Global irradiance, not negative.
    elevation_deg, distance : array
        Of the sun; `sun.eccentricity`.
    limit : array
        Direct light that no air exceeds (`clearest_direct`); near the horizon the division by sin(elevation) would.

    Notes
    -----
    Erbs, Klein and Duffie, Solar Energy 28 (1982) 293, doi:10.1016/0038-092X(82)90302-4: diffuse share by clearness
    index, of hourly values; ± 0.1 of the share for one hour.
    """
    height = np.sin(np.radians(np.maximum(elevation_deg, 0.0)))
    clearness = total / np.maximum(SOLAR_CONSTANT_W_M2 * distance * height, 1e-9)
    k = np.clip(clearness, 0.0, 0.8)
    share = np.where(k <= 0.22, 1.0 - 0.09 * k, 0.9511 - 0.1604 * k + 4.388 * k**2 - 16.638 * k**3 + 12.336 * k**4)
    share = np.where(clearness > 0.8, 0.165, share)
    direct = np.minimum((1.0 - share) * total / np.maximum(height, 1e-9), limit)
    direct = np.where(height > 0.0, direct, 0.0)
    return direct, total - direct * height


def clouded(direct, diffuse, elevation_deg, cloud):
    """Return (direct, diffuse) irradiance [W m⁻²] under clouds on a share of the sky, 0 … 1, from those without.

    Notes
    -----
    Global light falls to 1 − 0.75 c^3.4: Kasten and Czeplak, Solar Energy 24 (1980) 177,
    doi:10.1016/0038-092X(80)90391-6, eq. 10, means over ten years of Hamburg. The sun's disc is free for the share
    1 − c of the time; what is left of the global light is diffuse.
    """
    height = np.sin(np.radians(np.maximum(elevation_deg, 0.0)))
    total = (direct * height + diffuse) * (1.0 - 0.75 * np.asarray(cloud, np.float64) ** 3.4)
    direct = (1.0 - cloud) * direct
    return direct, total - direct * height


def longwave(air_k, vapour_pa, cloud):
    """Return the long-wave irradiance of the sky [W m⁻²] from what is measured near the ground.

    Parameters
    ----------
    air_k, vapour_pa : array
        Air temperature and vapour pressure at about 2 m.
    cloud : array
        Share of the sky under clouds, 0 … 1; or what the sun lacks of clear-sky light.

    Notes
    -----
    Emissivity of the clear sky: Prata, Q. J. R. Meteorol. Soc. 122 (1996) 1127, doi:10.1002/qj.49712253306. Clouds:
    Unsworth and Monteith, Q. J. R. Meteorol. Soc. 101 (1975) 13, doi:10.1002/qj.49710142703, 1 − 0.84 c of it and
    0.84 c. Hourly values of clear nights in valleys stray by 10 to 20 W m⁻², cloudy ones more.
    """
    water = precipitable_water(vapour_pa, air_k)
    clear = 1.0 - (1.0 + water) * np.exp(-np.sqrt(1.2 + 3.0 * water))
    return ((1.0 - 0.84 * cloud) * clear + 0.84 * cloud) * STEFAN_BOLTZMANN * air_k**4
