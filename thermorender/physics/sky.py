"""Solar and sky irradiance at the ground: clear skies, direct and diffuse light, clouds, long-wave.

Irradiances are broadband [W m⁻²]: *direct* is normal to the sun's rays; *diffuse*, *global* and *long-wave* are
downward on a level plane. Arguments broadcast.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.humidity import precipitable_water
from thermorender.physics.planck import STEFAN_BOLTZMANN

Floats = NDArray[np.float64]

SOLAR_CONSTANT_W_M2 = 1361.0  # IAU 2015 resolution B3
# Default aerosol: optical depth at 0.5 µm at sea level, and the scale height by which it falls with altitude.
AEROSOL_AT_SEA = 0.1
_AEROSOL_SCALE_M = 2000.0
# Ångström exponent, to convert the depth at 0.5 µm to 0.38 µm.
_ANGSTROM = 1.3
_OZONE_CM = 0.3
# Beyond this air mass (4° of elevation) Bird's Rayleigh extinction would fall. Instead it grows by the second number
# per air mass, as Kasten's does there, Solar Energy 56 (1996) 239, doi:10.1016/0038-092X(95)00114-7.
_RAYLEIGH_MASS, _RAYLEIGH_BEYOND = 14.0, 0.013
# Of an overcast sky's clouds, as seen from the ground through the air below them: Unsworth and Monteith (1975).
CLOUD_EMISSIVITY = 0.84
# Relative humidity near the ground from which on clouds are likely.
_HUMID = 0.5


def standard_aerosol(altitude_m: ArrayLike) -> Floats:
    """Return the default aerosol optical depth at 0.5 µm [1]: 0.1 at sea level, falling by e per 2 km of altitude.

    The value is an assumption, a clean continental air; ± 0.05 is ± 4 to 5 % of the direct light for a high sun.
    """
    return AEROSOL_AT_SEA * np.exp(-np.maximum(altitude_m, 0.0) / _AEROSOL_SCALE_M)


def air_mass(elevation_deg: ArrayLike) -> Floats:
    """Return the relative optical air mass [1]: 1 at the zenith, 38 at the horizon and below.

    Kasten and Young, Appl. Opt. 28 (1989) 4735, doi:10.1364/AO.28.004735, eq. 3, for the refracted elevation. The true
    elevation gives 3 % more at 5°.
    """
    elevation = np.maximum(elevation_deg, 0.0)
    return 1.0 / (np.sin(np.radians(elevation)) + 0.50572 * (elevation + 6.07995) ** -1.6364)


def clear_sky(
    elevation_deg: Floats, pressure_pa: Floats | float, water_cm: Floats | float, aerosol: Floats | float,
    distance: Floats | float = 1.0, albedo: Floats | float = 0.2,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return (direct, diffuse) irradiance under a cloudless sky [W m⁻²], 0 where the sun is down.

    `elevation_deg` is that of the sun, `pressure_pa` at the ground, `water_cm` precipitable water, `aerosol` the
    optical depth at 0.5 µm, `distance` `sun.eccentricity`, and `albedo` that of the ground, which the sky reflects in
    part.

    Bird and Hulstrom, A Simplified Clear Sky Model for Direct and Diffuse Insolation, SERI/TR-642-761 (1981), with 0.3
    cm of ozone, an aerosol single-scattering albedo of 0.9 and forward share of 0.85. Up to an air mass of 5.6 (10°)
    the error against rigorous codes is 3 % direct, 5 % diffuse.
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


def clearest_direct(
    elevation_deg: Floats, pressure_pa: Floats | float, water_cm: Floats | float, distance: Floats | float = 1.0
) -> Floats:
    """Return the direct irradiance [W m⁻²] without aerosol, the upper limit of `clear_sky`."""
    return clear_sky(elevation_deg, pressure_pa, water_cm, 0.0, distance)[0]


def split_global(
    total: Floats, elevation_deg: Floats, distance: Floats | float, limit: Floats | float
) -> tuple[Floats, Floats]:
    """Return (direct, diffuse) of a measured global irradiance [W m⁻²]: total = direct · sin(elevation) + diffuse.

    Erbs, Klein and Duffie, Solar Energy 28 (1982) 293, doi:10.1016/0038-092X(82)90302-4: diffuse share from the
    clearness index, for hourly values; its uncertainty is ± 0.1 for one hour. `distance` is `sun.eccentricity`. `limit`
    is the upper limit of the direct irradiance (`clearest_direct`), for the division by sin(elevation) near the
    horizon.
    """
    height = np.sin(np.radians(np.maximum(elevation_deg, 0.0)))
    clearness = total / np.maximum(SOLAR_CONSTANT_W_M2 * distance * height, 1e-9)
    k = np.clip(clearness, 0.0, 0.8)
    share = np.where(k <= 0.22, 1.0 - 0.09 * k, 0.9511 - 0.1604 * k + 4.388 * k**2 - 16.638 * k**3 + 12.336 * k**4)
    share = np.where(clearness > 0.8, 0.165, share)
    direct = np.minimum((1.0 - share) * total / np.maximum(height, 1e-9), limit)
    direct = np.where(height > 0.0, direct, 0.0)
    return direct, total - direct * height


def clouded(direct: Floats, diffuse: Floats, elevation_deg: Floats, cloud: Floats | float) -> tuple[Floats, Floats]:
    """Return (direct, diffuse) irradiance [W m⁻²] under a cloud cover of 0 … 1, from clear-sky values.

    Global light falls to 1 − 0.75 c^3.4: Kasten and Czeplak, Solar Energy 24 (1980) 177,
    doi:10.1016/0038-092X(80)90391-6, eq. 10, means over ten years in Hamburg. The sun is unobscured for the share 1 − c
    of the time; the rest of the global light is diffuse.
    """
    height = np.sin(np.radians(np.maximum(elevation_deg, 0.0)))
    total = (direct * height + diffuse) * (1.0 - 0.75 * np.asarray(cloud, np.float64) ** 3.4)
    direct = (1.0 - cloud) * direct
    return direct, total - direct * height


def cloud_of_humidity(humidity: Floats) -> Floats:
    """Return the cloud cover [1] that a relative humidity near the ground [1] makes likely at night.

    1 − √((1 − h)/(1 − h₀)): Sundqvist, Berge and Kristjánsson, Mon. Weather Rev. 117 (1989) 1641,
    doi:10.1175/1520-0493(1989)117<1641:CACPSW>2.0.CO;2, for the humidity of a cloud's layer. Near the ground it is the
    mean over the nights of eleven places with a pyrgeometer, to 0.1 with h₀ = 0.5, though 0.1 too low in saturated air.
    """
    return 1.0 - np.sqrt(np.clip((1.0 - humidity) / (1.0 - _HUMID), 0.0, 1.0))


def longwave(air_k: Floats, vapour_pa: Floats, cloud: Floats | float) -> Floats:
    """Return the downward long-wave irradiance of the sky [W m⁻²] from measurements at about 2 m.

    `cloud` is the cloud cover, 0 … 1, or the relative deficit of sunlight against the clear sky. Clear-sky emissivity
    ε: Prata, Q. J. R. Meteorol. Soc. 122 (1996) 1127, doi:10.1002/qj.49712253306. With clouds, (1 − 0.84 c) ε + 0.84 c:
    Unsworth and Monteith, Q. J. R. Meteorol. Soc. 101 (1975) 13, doi:10.1002/qj.49710142703. The error of hourly values
    on clear nights in valleys is 8 to 18 W m⁻², more under clouds.
    """
    water = precipitable_water(vapour_pa, air_k)
    clear = 1.0 - (1.0 + water) * np.exp(-np.sqrt(1.2 + 3.0 * water))
    black = CLOUD_EMISSIVITY * cloud
    return ((1.0 - black) * clear + black) * STEFAN_BOLTZMANN * air_k**4
