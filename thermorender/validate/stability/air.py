"""Stability of air: what is as warm as all around it cannot be seen, near and far."""

from dataclasses import replace
from functools import cache

import numpy as np

from thermorender.atmosphere.model import Atmosphere
from thermorender.physics.planck import band_radiance_derivative
from thermorender.validate.stability.cases import Found, case

KELVIN, ROUNDING_K = 290.0, 1e-5


@cache
def isothermal():
    """Hazy tropical air of one temperature all the way up."""
    air = Atmosphere.standard("tropical", "rural-5km")
    return replace(air, temperature=np.full_like(air.temperature, KELVIN))


@case("air", "isothermal air before a wall as warm, path of {:g} m", (2.0, 100.0, 1e4, 1e5))
def path(range_m):
    """τ B + L_path = B, level at 1 km. An ulp of single precision, 6e-8, times L over dL/dT, 70 K, is 4e-6 K."""
    air = isothermal()
    transmittance, radiance = air.path(1000.0, 1000.0, range_m)
    black = air.planck(KELVIN)
    error = float((transmittance * black + radiance - black).sum())
    slope = band_radiance_derivative(KELVIN, air.lower_um.min(), air.upper_um.max())
    return Found(KELVIN + error / slope, KELVIN, ROUNDING_K)


@case("air", "black wall of 300 K through {:g} m of air of 290 K", (0.0, 1e-6))
def near(range_m):
    """Nothing lies between: the wall is seen as it is."""
    air = isothermal()
    transmittance, radiance = air.path(1000.0, 1000.0, range_m)
    error = float((transmittance * air.planck(300.0) + radiance - air.planck(300.0)).sum())
    slope = band_radiance_derivative(300.0, air.lower_um.min(), air.upper_um.max())
    return Found(300.0 + error / slope, 300.0, ROUNDING_K)
