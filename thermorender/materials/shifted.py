"""Materials that deviate from their tables: one property moved by one standard deviation, or all drawn at random.

Quantities with indistinguishable effects on temperature move together. Positive numbers move by a factor, the
exponential of the standard deviation of their logarithm.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from thermorender.materials.material import Material
from thermorender.materials.mixture import Mixture
from thermorender.materials.thermal import NUMBERS, Thermal

# Largest absorptance of a real surface: a step beyond it is taken downwards.
_MOST_ABSORPTANCE = 0.97
# Constants of nature, which keep their value.
_KNOWN = ("melting_k",)


def shifted(material: Material, name: str) -> Material:
    """Return a Material with one of `PROPERTIES` moved by one standard deviation; for a mixture, that of each part.

    - "absorptance": of sunlight, upwards, or downwards close to one.
    - "inertia": conductivity and heat capacity of all layers up by the same factor, and the skin's conductance.
    - "wetness": down by the uncertainty of wetness over surface resistance, since only the ratio matters; where soil
      has a texture, the resistance moves up.
    - "exchange": momentum roughness length up and heat_roughness_ratio down, each by 1/√2 standard deviations, so that
      their joint effect is one standard deviation.
    """
    if isinstance(material, Mixture):
        return replace(material, parts=tuple((shifted(part, name), share) for part, share in material.parts))
    return PROPERTIES[name](material, material.known_thermal())


def strayed(thermal: Thermal, generator: np.random.Generator, scale: float = 1.0) -> Thermal:
    """Return a Thermal whose numbers are drawn from their uncertainty; the layers beneath stay unchanged.

    Positive numbers are log-normal with the table's mean and standard deviation times `scale`, within the limits of a
    table; zero stays zero.
    """
    values: dict[str, Any] = {}
    for key, (low, high, _) in NUMBERS.items():
        # One draw per property, used or not, so that properties are independent of each other.
        normal, width = generator.standard_normal(), scale * _of_logarithm(thermal, key)
        if width and key not in _KNOWN:
            value = getattr(thermal, key) * np.exp(width * normal - 0.5 * width**2)
            values[key] = float(np.clip(value, low, high))
    return replace(thermal, **values)


def _absorptance(material: Material, thermal: Thermal) -> Material:
    step = material.solar_uncertainty
    fits = material.solar_absorptance + step <= _MOST_ABSORPTANCE
    return replace(material, solar_absorptance=material.solar_absorptance + (step if fits else -step))


def _inertia(material: Material, thermal: Thermal) -> Material:
    return replace(material, thermal=_slower(thermal))


def _slower(thermal: Thermal) -> Thermal:
    parts = ("conductivity_w_m_k", "density_kg_m3", "specific_heat_j_kg_k")
    # The logarithm of the inertia √(kρc) is half the sum of the logarithms.
    factor = np.exp(0.5 * np.sqrt(sum(_of_logarithm(thermal, part) ** 2 for part in parts)))
    skin = thermal.skin_conductance_w_m2_k
    return replace(
        thermal,
        conductivity_w_m_k=thermal.conductivity_w_m_k * factor,
        specific_heat_j_kg_k=thermal.specific_heat_j_kg_k * factor,
        skin_conductance_w_m2_k=skin and skin * np.exp(_of_logarithm(thermal, "skin_conductance_w_m2_k")),
        below=thermal.below and _slower(thermal.below),
    )


def _wetness(material: Material, thermal: Thermal) -> Material:
    both = np.hypot(_of_logarithm(thermal, "wetness"), _of_logarithm(thermal, "surface_resistance_s_m"))
    drier = float(np.exp(-both))
    if thermal.texture and thermal.surface_resistance_s_m:
        # The weather sets the wetness of soils.
        moved = replace(thermal, surface_resistance_s_m=thermal.surface_resistance_s_m / drier)
    else:
        moved = replace(thermal, wetness=thermal.wetness * drier)
    return replace(material, thermal=moved)


def _exchange(material: Material, thermal: Thermal) -> Material:
    rough = thermal.roughness_m * float(np.exp(0.5**0.5 * _of_logarithm(thermal, "roughness_m")))
    ratio = thermal.heat_roughness_ratio - 0.5**0.5 * thermal.uncertainty.get("heat_roughness_ratio", 0.0)
    return replace(material, thermal=replace(thermal, roughness_m=rough, heat_roughness_ratio=max(ratio, 0.0)))


def _of_logarithm(thermal: Thermal, key: str) -> float:
    """Standard deviation of the logarithm of a log-normal property; 0 without a value."""
    value = getattr(thermal, key)
    return float(np.sqrt(np.log1p((thermal.uncertainty.get(key, 0.0) / value) ** 2))) if value else 0.0


PROPERTIES = {"absorptance": _absorptance, "inertia": _inertia, "wetness": _wetness, "exchange": _exchange}
