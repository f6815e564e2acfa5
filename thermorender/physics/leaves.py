"""Leaves by season and weather: their greenness, and how stomata respond to light, dry air and temperature."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

# Lowest temperature of a day [°C], its vapour pressure deficit [Pa] and length [h] at which leaves are absent, and from
# which on they are unlimited: Jolly, Nemani and Running, Glob. Change Biol. 11 (2005) 619, table 1.
_COLD_C, _DRY_PA, _DARK_H = (-2.0, 5.0), (4100.0, 900.0), (10.0, 11.0)
# Days over which the index is averaged: there, page 622.
MEMORY_D = 21
# Air temperature at which stomata are widest [K], and their loss per square kelvin: Noilhan and Planton, Mon. Weather
# Rev. 117 (1989) 536, doi:10.1175/1520-0493(1989)117<0536:ASPOLS>2.0.CO;2, eq. B5.
_BEST_K, _LOSS_K2 = 298.0, 0.0016


def growing_season(lowest_c: ArrayLike, day_h: ArrayLike) -> Floats:
    """Return the growing season index of days by frost and light, 0 (dormant) … 1 (green).

    Parameters
    ----------
    lowest_c : array
        Lowest air temperature of a day [°C].
    day_h : array
        Time from sunrise to sunset [h].

    Notes
    -----
    Product of linear ramps, with `moist` as the third: Jolly, Nemani and Running, Glob. Change Biol. 11 (2005) 619,
    doi:10.1111/j.1365-2486.2005.00930.x, eqs 1–4. The greenness of land is its mean over 21 days.
    """
    return _ramp(lowest_c, *_COLD_C) * _ramp(day_h, *_DARK_H)


def moist(deficit_pa: ArrayLike) -> Floats:
    """Return the growing season index by the mean vapour pressure deficit of a day's light [Pa], 0 … 1.

    Dry air stands for dry soil; source as `growing_season`.
    """
    return _ramp(deficit_pa, *_DRY_PA)


def _ramp(value: ArrayLike, none: float, full: float) -> Floats:
    return np.clip((np.asarray(value, np.float64) - none) / (full - none), 0.0, 1.0)


def stomata(xp: Any, resistance: Any, sunlight_w_m2: Any, deficit_pa: Any, air_k: Any) -> Any:
    """Return the surface resistance of leaves [s/m] for given sunlight, saturation deficit and temperature.

    Parameters
    ----------
    xp : module
        NumPy or Dr.Jit.
    resistance : array
        In full sun and moist air [s/m].
    sunlight_w_m2 : array
        On the leaves [W m⁻²].
    deficit_pa : array
        Saturation deficit of the air [Pa].
    air_k : array
        [K]

    Notes
    -----
    Sunlight: IFS documentation CY41R2, part IV, eq. 8.11. Deficit: Leuning, Plant Cell Environ. 18 (1995) 339, with
    half the conductance at 1500 Pa, relative to the 1000 Pa of published minimum resistances. Temperature: Noilhan and
    Planton (1989), eq. B5; closed 25 K away from 298 K.
    """
    light = (0.004 * sunlight_w_m2 + 0.05) / (0.81 * (0.004 * sunlight_w_m2 + 1.0))
    dry = (1.0 + xp.maximum(deficit_pa, 0.0) / 1500.0) / (1.0 + 1000.0 / 1500.0)
    warm = 1.0 - _LOSS_K2 * (_BEST_K - air_k) ** 2
    return resistance * xp.maximum(dry, 0.7) / (xp.minimum(light, 1.0) * xp.maximum(warm, 1e-3))
