"""Snow on the ground by its age: density, albedo, conductivity, and the share of the ground that it covers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_DAY_S = 86400.0
# Density of snow that has fallen on land and was packed by wind: Sturm et al., J. Hydrometeorol. 11 (2010) 1380,
# doi:10.1175/2010JHM1202.1, table 4, begins with 217 … 258 in all its classes [kg m⁻³]. What it settles to in frost and
# in melt, and the rate: Essery, Geosci. Model Dev. 8 (2015) 3867, doi:10.5194/gmd-8-3867-2015, table 1, 200 h.
NEW_KG_M3, SETTLED_KG_M3, WET_KG_M3, _SETTLES_D = 250.0, 300.0, 500.0, 0.12
# Albedo of new and of old snow, its loss by day in frost, its rate in melt [1/day], and the new snow that makes it new
# [mm]: Douville, Royer and Mahfouf, Clim. Dyn. 12 (1995) 21, doi:10.1007/BF00208760, table 1.
NEW_ALBEDO, OLD_ALBEDO = 0.85, 0.5
_LOSES_D, _MELTS_D, _RENEWS_MM = 0.008, 0.24, 10.0
# Niu and Yang, J. Geophys. Res. 112 (2007) D21101, doi:10.1029/2007JD008674, eq. 4.
_COVERS = 2.5


class Pack(NamedTuple):
    """Snow on the ground: depth [m], density [kg m⁻³] and broadband albedo [1]."""

    depth_m: float
    density_kg_m3: float
    albedo: float


def packs(seconds: Floats, air_c: Floats, depth_m: Floats, first: Pack) -> Pack:
    """Return the Pack after intervals of `seconds` (N,) [s], which begin with the Pack `first`.

    `depth_m` (N,) is the depth at the end of each interval [m]; an increase is new snow. Snow melts in air of 0 °C and
    warmer, by `air_c` (N,) [°C]. Albedo falls linearly in frost and exponentially in melt, and new snow raises it in
    proportion: Douville, Royer and Mahfouf (1995), eqs 16–18. Density approaches that of settled or of wet snow
    exponentially (Essery 2015, eq. 14), and is averaged with that of new snow.
    """
    depth, density, albedo = first
    for length, now, celsius in zip((seconds / _DAY_S).tolist(), depth_m.tolist(), air_c.tolist(), strict=True):
        density = _settled(density, length, celsius)
        if celsius < 0.0:
            albedo = max(albedo - _LOSES_D * length, OLD_ALBEDO)
        else:
            albedo = OLD_ALBEDO + (albedo - OLD_ALBEDO) * float(np.exp(-_MELTS_D * length))
        gained = max(now - depth, 0.0)
        if gained:
            fell_mm = gained * NEW_KG_M3
            # On bare ground all snow is new.
            share = max(fell_mm / _RENEWS_MM, gained / now)
            albedo += min(share, 1.0) * (NEW_ALBEDO - albedo)
            density = (depth * density + fell_mm) / now
        depth = now
    return Pack(depth, density, albedo)


def depths(seconds: Floats, air_c: Floats, water_mm: Floats) -> Floats:
    """Return snow depths (N,) [m] from the water at the end of intervals (N,) [s, mm], settled as in `packs`."""
    found, water, density = np.zeros(len(water_mm)), 0.0, NEW_KG_M3
    rows = zip((seconds / _DAY_S).tolist(), air_c.tolist(), water_mm.tolist(), strict=True)
    for k, (length, celsius, now) in enumerate(rows):
        density = _settled(density, length, celsius) if water else NEW_KG_M3
        if now > water:
            density = now / (water / density + (now - water) / NEW_KG_M3)
        water = now
        found[k] = water / density
    return found


def _settled(density_kg_m3: float, days: float, celsius: float) -> float:
    most = SETTLED_KG_M3 if celsius < 0.0 else WET_KG_M3
    return max(most + (density_kg_m3 - most) * float(np.exp(-_SETTLES_D * days)), density_kg_m3)


def conductivity(density_kg_m3: ArrayLike) -> Floats:
    """Return the thermal conductivity of snow [W m⁻¹ K⁻¹] by its density [kg m⁻³].

    Calonne et al., Geophys. Res. Lett. 38 (2011) L23501, doi:10.1029/2011GL049234, eq. 12.
    """
    density = np.asarray(density_kg_m3, np.float64)
    return 2.5e-6 * density**2 - 1.23e-4 * density + 0.024


def covers(depth_m: ArrayLike, roughness_m: ArrayLike) -> Floats:
    """Return the share of the view that snow of a depth [m] covers, 0 … 1.

    `roughness_m` is that of the ground without snow [m]: stones and stalks stand out. Niu and Yang (2007), eq. 4, as of
    new snow; in melt they let the share fall with density, which describes the patches of a whole landscape.
    """
    return np.tanh(np.asarray(depth_m, np.float64) / (_COVERS * np.asarray(roughness_m, np.float64)))
