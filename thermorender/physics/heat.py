"""Force–restore: one implicit step of a surface over a single restoring layer; `balance` has columns of layers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.units import ZERO_CELSIUS_K

_DAY_S = 86400.0
_PSYCHROMETER_PA_K = 66.0  # near sea level: Allen et al., FAO paper 56 (1998), table 2.2


def saturation_vapour(temperature: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return (saturation vapour pressure [Pa], its derivative [Pa/K]) over water at temperatures [K].

    Magnus form: Allen et al., FAO Irrigation and Drainage Paper 56 (1998), eqs 11 and 13.
    """
    celsius = temperature - np.float32(ZERO_CELSIUS_K)
    pressure = 610.8 * np.exp(np.float32(17.27) * celsius / (celsius + np.float32(237.3)))
    return pressure, pressure * np.float32(4098.0) / (celsius + np.float32(237.3)) ** 2


def step(
    temperature: NDArray[np.float32], seconds: float, absorbed: NDArray[np.float32], longwave: NDArray[np.float32],
    exchange: NDArray[np.float32], wet: NDArray[np.float32], air: NDArray[np.float32] | float, vapour_pa: float,
    inertia: NDArray[np.float32], deep: NDArray[np.float32],
) -> NDArray[np.float32]:  # fmt: skip
    """Return surface temperatures after one implicit time step of `seconds`, (H, W) float32 [K].

    `absorbed` and `longwave` are sunlight and downward long-wave [W m⁻²], `exchange` the convective coefficient h [W
    m⁻² K⁻¹], `wet` the evaporation relative to free water, 0…1, `air` the air temperature [K], `inertia` the thermal
    inertia [J m⁻² K⁻¹ s^-1/2] and `deep` the temperature of the restoring layer [K].

    Force–restore: dT/dt = 2√π F / (I √τ) − (2π/τ) (T − T_deep), Deardorff, J. Geophys. Res. 83 (1978) 1889, eq. 8 with
    ρ c d₁ = I √τ. The flux F = S + εL − εσT⁴ − h (T − T_air) − w (h/γ)(e_s(T) − e) has evaporation in Penman's bulk
    form (Proc. R. Soc. A 193 (1948) 120). Backward Euler, solved by Newton's method; emissivity ε = 0.96.
    """
    emissivity = np.float32(0.96)
    gain = np.float32(seconds * 2.0 * np.sqrt(np.pi) / np.sqrt(_DAY_S)) / inertia
    restore = np.float32(2.0 * np.pi * seconds / _DAY_S)
    latent = wet * exchange / np.float32(_PSYCHROMETER_PA_K)
    later = temperature.copy()
    for _ in range(3):
        saturation, slope = saturation_vapour(later)
        excess = saturation - np.float32(vapour_pa)
        cube = emissivity * np.float32(STEFAN_BOLTZMANN) * later**3
        flux = absorbed + emissivity * longwave - cube * later - exchange * (later - air)
        # Dew returns little heat in daytime, so only evaporation counts.
        flux -= latent * np.maximum(excess, 0.0)
        rate = 4.0 * cube + exchange + latent * slope * (excess > 0.0)
        residual = later - temperature - gain * flux + restore * (later - deep)
        later -= np.clip(residual / (1.0 + gain * rate + restore), -25.0, 25.0)
    return later
