"""Scaling of a terrain's solar absorptance to a stated broadband albedo.

A station, a satellite product or a calibrated orthophoto gives the mean solar reflectance of the ground. One factor on
the reflectance of the bare materials makes the area mean equal to it. Leaves, water, snow and object-only materials
keep their tables.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.materials.mixture import Mixture, parts_of
from thermorender.scene.surface import FILLED, Surface
from thermorender.scene.textures import areas, used_texels
from thermorender.units import ZERO_CELSIUS_K

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene

# Standard deviation of an albedo that states none. Products of MODIS are within 0.02 to 0.05 of measurements: Schaaf et
# al., Remote Sens. Environ. 83 (2002) 135.
ASSUMED_STD = 0.03
# Largest reflectance of a material: fresh snow and clean salt are below.
_MOST = 0.95


def shares(ground: Sequence[Surface], covers: Sequence[Any], count: int, mesh: bool) -> NDArray[np.float64]:
    """Return the share of each of `count` materials in the area of a terrain, (count,).

    Texels of unknown material do not count. On a `mesh`, texels that faces use share the area of their surface evenly.
    """
    found = np.zeros(count)
    for surface, cover in zip(ground, covers, strict=True):
        known, area = (cover.flags & FILLED) == 0, 1.0
        if mesh:
            known, area = known & used_texels(surface), float(areas(surface).sum())
        texels = np.bincount(cover.material[known], minlength=count)
        found += area / max(texels.sum(), 1) * texels
    return np.asarray(found / max(found.sum(), 1e-300))


def with_albedo(materials: Sequence[Material], share: NDArray[np.float64], albedo: float, where: str) -> list[Material]:
    """Return the materials with the bare ones scaled to the mean reflectance `albedo`.

    `share` (N,) is each one's area share.
    """
    from thermorender.scene import open_ground

    bare, rest, brightest = 0.0, 0.0, 0.0
    for material, area in zip(materials, share, strict=True):
        for part, of in parts_of(material):
            reflected = 1.0 - part.solar_absorptance
            if open_ground.bare(part):
                bare += area * of * reflected
                brightest = max(brightest, reflected if area > 0.0 else 0.0)
            else:
                rest += area * of * reflected
    if bare == 0.0:
        raise ThermorenderError(
            f"{where}: weather.albedo={albedo:g} sets bare materials that reflect sunlight, and the "
            "terrain has none; leave it out"
        )
    most = rest + bare * _MOST / brightest
    if not rest < albedo <= most:
        raise ThermorenderError(
            f"{where}: weather.albedo={albedo:g} is out of reach of this terrain's bare materials; give a value above "
            f"{rest:.2f} and up to {most:.2f}, or other materials"
        )
    factor = (albedo - rest) / bare
    return [
        _brighter(material, factor) if area > 0.0 else material for material, area in zip(materials, share, strict=True)
    ]


def _brighter(material: Material, factor: float) -> Material:
    """The material with a factor on the reflectance of its bare parts."""
    if isinstance(material, Mixture):
        parts = tuple((_brighter(part, factor), share) for part, share in material.parts)
        mean = sum(share * part.solar_absorptance for part, share in parts)
        return replace(material, parts=parts, solar_absorptance=float(mean))
    from thermorender.scene import open_ground

    if not open_ground.bare(material):
        return material
    return replace(
        material, solar_absorptance=float(np.clip(1.0 - factor * (1.0 - material.solar_absorptance), 0.0, 1.0))
    )


def notes(scene: "Scene") -> tuple[str, ...]:
    """Return a sentence on the stated albedo and its uncertainty [K], or none.

    The uncertainty is the change of the mean temperature of bare, level, open ground for one standard deviation of
    albedo.
    """
    spec = scene.spec.weather
    if spec is None or spec.albedo is None or scene.time is None:
        return ()
    from thermorender.scene import open_ground

    std = ASSUMED_STD if spec.albedo_std is None else spec.albedo_std
    ground = scene.near_ground
    share = shares(ground, ground, len(scene.materials), scene.spec.terrain.mesh is not None)
    used = [(part, area * of) for material, area in zip(scene.materials, share, strict=True) if area > 0.0
            for part, of in parts_of(material) if open_ground.bare(part)]  # fmt: skip
    weight = np.array([area for _, area in used])
    reflected = np.array([1.0 - part.solar_absorptance for part, _ in used])
    step = 0.5 * std / float(weight @ reflected)
    ends = [_brighter(part, factor) for factor in (1.0 - step, 1.0 + step) for part, _ in used]
    weather = scene.weather
    columns = open_ground.columns(ends, weather, 0.0, open_ground.STATION_ROUGHNESS_M)
    state, _ = open_ground.settled(columns, weather, scene.time, spec.inside_c + ZERO_CELSIUS_K)
    dark, bright = np.split(state.surface_k, 2)
    kelvin = abs(float(weight @ (dark - bright))) / weight.sum()
    by_name: dict[str, float] = {part.name: part.solar_absorptance for part, _ in used}
    absorbs = ", ".join(f"{name} absorbs {value:.2f}" for name, value in list(by_name.items())[:4])
    more = f" and {len(by_name) - 4} more" if len(by_name) > 4 else ""
    assumed = "assumed " if spec.albedo_std is None else ""
    return (
        f"albedo={spec.albedo:g} sets the sunlight that bare materials absorb: {absorbs}{more}; its {assumed}± {std:g} "
        f"is ± {kelvin:.1f} K of theirs, level in the open",
    )
