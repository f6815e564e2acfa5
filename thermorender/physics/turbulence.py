"""Exchange of heat and vapour between a surface and the air: turbulence with stability, evaporation and dew.

The functions take NumPy or Dr.Jit arrays; `xp` is the library. They have no branches and process all texels of a
terrain at once.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thermorender.physics.humidity import MAGNUS
from thermorender.units import ZERO_CELSIUS_K

GRAVITY = 9.80665  # m s⁻²
KARMAN = 0.4
AIR_HEAT = 1005.0  # J kg⁻¹ K⁻¹
AIR_GAS = 287.05  # J kg⁻¹ K⁻¹
VAPORISATION, SUBLIMATION = 2.46e6, 2.83e6  # J kg⁻¹
_VAPOUR_TO_AIR = 0.622
# Exchange in calm air: Jordan, CRREL Special Report 91-16 (1991), uses 2 W m⁻² K⁻¹ over snow.
CALM_W_M2_K = 2.0
_CALMEST_M_S = 0.1
# Depth of the layer near the ground in which a calm night's temperature profile lies: a tenth of a stable boundary
# layer of 100 m (Stull, An Introduction to Boundary Layer Meteorology (1988), sections 1.5 and 12.1) [m].
STABLE_M = 10.0
# Air temperature at which stomata are widest [K], and their loss per square kelvin: Noilhan and Planton, Mon. Weather
# Rev. 117 (1989) 536, doi:10.1175/1520-0493(1989)117<0536:ASPOLS>2.0.CO;2, eq. B5.
_BEST_K, _LOSS_K2 = 298.0, 0.0016
# Blending height: above it the wind is independent of the surface below [m].
BLENDING_M = 60.0


def wind_factor(
    height_m: ArrayLike, roughness_m: ArrayLike, station_height_m: float, station_roughness_m: float
) -> Any:
    """Return the ratio of the wind at a height over other land to a station's wind [1]; both are equal at 60 m.

    Neutral air: Wieringa, Q. J. R. Meteorol. Soc. 112 (1986) 867, eq. 2.
    """
    roughness_m = np.asarray(roughness_m, dtype=np.float64)
    up = np.log(BLENDING_M / station_roughness_m) / np.log(station_height_m / station_roughness_m)
    return up * np.log(height_m / roughness_m) / np.log(BLENDING_M / roughness_m)


def air_density(pressure_pa: Any, air_k: Any) -> Any:
    """Return the density of dry air [kg m⁻³]; moist air is up to 1 % lighter."""
    return pressure_pa / (AIR_GAS * air_k)


def convection(
    xp: Any, surface_k: Any, air_k: Any, wind_m_s: Any, density: Any, log_wind: Any, log_heat: Any, height_m: Any,
) -> tuple[Any, Any]:  # fmt: skip
    """Return (exchange coefficient h [W m⁻² K⁻¹], its derivative with respect to surface temperature).

    `log_wind` is ln(z/z₀) for momentum and `log_heat` is ln(z/z₀ₕ) for heat; `height_m` is the height of the air
    temperature above the displacement plane, `density` that of the air [kg m⁻³].

    h = ρ c κ² U f / (ln(z/z₀) ln(z/z₀ₕ)), Garratt, The Atmospheric Boundary Layer (1992), eq. 3.52, plus a constant for
    calm air. Unstable: f of the bulk Richardson number by Louis, Tiedtke & Geleyn, "A short history of the PBL
    parameterization at ECMWF" (1982), b = c = 5. Stable: f = 1 / (1 + 10 Ri), the long tail of Brown et al.,
    Boundary-Layer Meteorol. 128 (2008) 117, with the height of Ri limited to `STABLE_M`. With it the heat flux from the
    air never falls as the surface cools, so the surface stays coupled on a calm night and has a unique temperature.
    """
    wind = xp.maximum(wind_m_s, _CALMEST_M_S)
    slope = GRAVITY * height_m / (0.5 * (surface_k + air_k) * wind * wind)
    richardson = slope * (air_k - surface_k)
    shallow = xp.minimum(height_m, STABLE_M) / xp.maximum(height_m, 1e-6)
    stable, unstable = shallow * xp.maximum(richardson, 0.0), xp.maximum(-richardson, 1e-9)
    neutral = AIR_HEAT * density * KARMAN**2 / (log_wind * log_heat) * wind
    damped = 1.0 / (1.0 + 10.0 * stable)
    falls = 10.0 * shallow * damped * damped
    free = 75.0 * KARMAN**2 / (log_wind * log_heat) * xp.sqrt(xp.exp(log_wind) * unstable)
    lifted = 15.0 / (1.0 + free)
    warm = richardson < 0.0
    factor = xp.where(warm, 1.0 + lifted * unstable, damped)
    bend = xp.where(warm, lifted * (1.0 - 0.5 * free / (1.0 + free)), falls)
    return neutral * factor + CALM_W_M2_K, neutral * bend * slope


def saturation_vapour(xp: Any, temperature_k: Any) -> tuple[Any, Any]:
    """Return (saturation vapour pressure [Pa], its derivative [Pa/K]) over water, below 0 °C over ice.

    Magnus form with the coefficients of Alduchov & Eskridge, J. Appl. Meteorol. 35 (1996) 601, eqs 21 and 23;
    within 0.4 % over −40…50 °C.
    """
    celsius = temperature_k - ZERO_CELSIUS_K
    ice = celsius < 0.0
    scale, a, b = (xp.where(ice, *pair) for pair in zip(MAGNUS["ice"], MAGNUS["water"], strict=True))
    celsius = xp.maximum(celsius, -150.0)
    pressure = scale * xp.exp(a * celsius / (b + celsius))
    return pressure, pressure * a * b / (b + celsius) ** 2


def evaporation(
    xp: Any, surface_k: Any, vapour_pa: Any, pressure_pa: Any, convective: Any, bend: Any, density: Any,
    resistance: Any, film: Any, frozen: Any,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """Return (latent heat flux [W m⁻²], its derivative with respect to surface temperature, heat per mass [J kg⁻¹]).

    `convective` and `bend` are h and its derivative from `convection`, `density` that of the air [kg m⁻³], `resistance`
    that of the surface [s/m] (very large without evaporation) and `film` the share of the surface under free water,
    0…1. `frozen` selects sublimation. It does not follow `surface_k`: the heat per mass would jump by a seventh at 0
    °C, and two temperatures could balance.

    Bulk transfer with resistances in series, the aerodynamic one as for heat: Monteith & Unsworth, Principles of
    Environmental Physics (4th ed. 2013), ch. 13. Dew meets the aerodynamic resistance only.
    """
    saturation, slope = saturation_vapour(xp, surface_k)
    excess = saturation - vapour_pa
    heat = xp.where(frozen, SUBLIMATION, VAPORISATION)
    aerodynamic = density * AIR_HEAT / convective
    open_share = xp.where(excess < 0.0, 1.0, film)
    passed = aerodynamic / (aerodynamic + resistance)
    conductance = (open_share + (1.0 - open_share) * passed) / aerodynamic
    steeper = (open_share + (1.0 - open_share) * passed * passed) / (density * AIR_HEAT) * bend
    gain = heat * _VAPOUR_TO_AIR * density / pressure_pa
    return gain * conductance * excess, gain * (conductance * slope + steeper * excess), heat


def stomata(xp: Any, resistance: Any, sunlight_w_m2: Any, deficit_pa: Any, air_k: Any) -> Any:
    """Return the surface resistance of leaves [s/m] for sunlight on them, saturation deficit and air temperature.

    `resistance` is that in full sun and moist air. Sunlight: IFS documentation CY41R2, part IV, eq. 8.11. Deficit:
    Leuning, Plant Cell Environ. 18 (1995) 339, with half the conductance at 1500 Pa, relative to the 1000 Pa of
    published minimum resistances. Temperature: Noilhan and Planton (1989), eq. B5; closed 25 K away from 298 K.
    """
    light = (0.004 * sunlight_w_m2 + 0.05) / (0.81 * (0.004 * sunlight_w_m2 + 1.0))
    dry = (1.0 + xp.maximum(deficit_pa, 0.0) / 1500.0) / (1.0 + 1000.0 / 1500.0)
    warm = 1.0 - _LOSS_K2 * (_BEST_K - air_k) ** 2
    return resistance * xp.maximum(dry, 0.7) / (xp.minimum(light, 1.0) * xp.maximum(warm, 1e-3))
