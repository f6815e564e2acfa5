"""Kinetic temperature of every texel of a surface, from the source that a scene file names."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.materials.mixture import Mixture, parts_of, spectra_of
from thermorender.scene.raster import Grid, grid_of, onto, opened, read_band
from thermorender.scene.spec import TemperatureSpec, WeatherSpec
from thermorender.scene.surface import FALLBACK, MOST_OPEN, Surface, fill, nearest_valid, open_share, scene_kelvin
from thermorender.scene.textures import Texture, onto_texels, separate, used_texels
from thermorender.schema import Where, read
from thermorender.sensor.radiometric_files import likely_scales
from thermorender.units import ZERO_CELSIUS_K, kelvin_scale

if TYPE_CHECKING:
    from thermorender.learned.temperature_map import Inputs, TemperatureMap

_Kelvin = NDArray[np.float32] | NDArray[np.float64]
# Assumed error of a map that states none [K]: about the specification of calibrated cameras.
ASSUMED_ERROR_K = 2.0
# No terrain has a higher median; fires and lava cover less [K].
_HOTTEST_MEDIAN_K = 700.0
# Larger values mark missing data.
_PLACEHOLDER = 1e6


@dataclass(frozen=True)
class Texels:
    """Texels of one surface, the input of a temperature source."""

    colour: NDArray[np.uint8]  # (h, w, 3) uint8
    material: NDArray[np.uint8]  # (h, w) uint8
    materials: Sequence[Material]
    grid: Grid | None  # The texels' pixel grid on the map, for rasters; None for meshes
    texel_m: float
    where: str  # Name of the scene file, for messages
    report: dict[str, Any] = field(default_factory=dict)
    model: "TemperatureMap | None" = None  # The map of a source "learned", as by `learned_map`
    on_ground: NDArray[np.bool_] | None = None  # (h, w) bool texels on the terrain; None if all of them are
    # surface, texture: Of a mesh, for rasters in the pixels of its texture
    surface: Surface | None = None
    texture: Texture | None = None


def resolve(spec: TemperatureSpec, texels: Texels) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return (temperature (h, w) float32 [K], flags (h, w) uint8) of a surface; notes go to `texels.report`."""
    temperature, flags = SOURCES[spec.source](spec, texels)
    return temperature.astype(np.float32), flags


def trained(spec: TemperatureSpec, model: "TemperatureMap | None" = None) -> WeatherSpec | None:
    """Return the instant and weather of a source's temperatures, from the source or its `model`; None if unstated."""
    if spec.trained or spec.source != "learned":
        return spec.trained
    stated = _map_of(spec, model).trained
    return read(WeatherSpec, stated, Where(f"learned map {spec.model!r}", top="trained")) if stated else None


def map_error_k(spec: TemperatureSpec, model: "TemperatureMap | None" = None) -> float:
    """Return one standard deviation of a map's error [K], from the source or its `model`, else `ASSUMED_ERROR_K`."""
    error = spec.map_error_k
    if error is None and spec.source == "learned":
        error = _map_of(spec, model).error_k
    return ASSUMED_ERROR_K if error is None else error


def _map_of(spec: TemperatureSpec, model: "TemperatureMap | None") -> "TemperatureMap":
    model = learned_map(spec) if model is None else model
    assert model is not None
    return model


def raster_temperature(path: Path, texels: Texels) -> NDArray[np.float64]:
    """Return a raster's temperatures on the texel grid, (h, w) [K], NaN where it has none."""
    if texels.grid is None and (texels.surface is None or texels.texture is None):
        raise ThermorenderError(
            f"{texels.where}: a temperature raster needs terrain that files describe, and its surfaces were made in "
            "memory; give the temperatures of its texels as with_temperature(…, kelvin=…)"
        )
    values = _in_kelvin(path)
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise ThermorenderError(f"{path} has no valid temperature in it; give a raster of kelvin")
    scene_kelvin(str(path), finite)
    if texels.grid is None:
        assert texels.surface is not None and texels.texture is not None
        return onto_texels(values, path, texels.surface, texels.texture)
    values = onto(values, grid_of(path), texels.grid, "bilinear")
    if not np.isfinite(values).any():
        raise ThermorenderError(f"{path} does not overlap the texels of {texels.where}; give one of the same area")
    return values


def _in_kelvin(path: Path) -> NDArray[np.float64]:
    """A raster's temperatures, (h, w) [K], by the unit it declares; kelvin without one."""
    with opened(path) as dataset:
        unit, kind = (dataset.units[0] or "", dataset.dtypes[0]) if dataset.count else ("", "")
        plain = dataset.count == 0 or (dataset.scales[0], dataset.offsets[0]) == (1.0, 0.0)
    values = read_band(path)
    scale = kelvin_scale(unit)
    if unit and scale is None:
        raise ThermorenderError(
            f"{path} holds values in {unit!r}; give K, °C or °F, or declare the right unit with "
            "`rio edit-info --bidx 1 --units K FILE`"
        )
    if scale is not None:
        return values * scale[0] + scale[1]
    if plain and kind == "uint8":
        raise ThermorenderError(
            f"{path} holds 8-bit values without a unit, which are grey levels and not kelvin; give a raster of "
            "kelvin, or declare its unit and scale"
        )
    if plain and np.isfinite(values).any() and _HOTTEST_MEDIAN_K < np.nanmedian(values) < _PLACEHOLDER:
        names = likely_scales(values)
        raise ThermorenderError(
            f"{path} holds values around {np.nanmedian(values):.6g} without a unit, which are not kelvin"
            + (f" but perhaps counts of {' or '.join(names)}" if names else "")
            + "; give a raster of kelvin, or declare its scale, offset and unit, for example with "
            "`gdal_edit.py -scale 0.1 -offset 0 -units K`"
        )
    return values


def _constant(spec: TemperatureSpec, texels: Texels) -> tuple[_Kelvin, NDArray[np.uint8]]:
    assert spec.value is not None
    scene_kelvin("temperature.value", spec.value)
    return np.full(texels.material.shape, spec.value, np.float64), np.zeros(texels.material.shape, np.uint8)


def _raster(spec: TemperatureSpec, texels: Texels) -> tuple[_Kelvin, NDArray[np.uint8]]:
    assert spec.raster is not None
    values = raster_temperature(spec.raster, texels)
    valid = np.isfinite(values)
    if not valid.all():
        on_ground = texels.on_ground if texels.surface is None else used_texels(texels.surface)
        share = open_share(~valid, on_ground)
        if spec.value is None and share > MOST_OPEN:
            raise ThermorenderError(
                f"{spec.raster} leaves {share:.1%} of the terrain of {texels.where} without a temperature; give one "
                "that covers it, or state the kelvin of the rest as temperature.value"
            )
        if share > 0.0:
            rest = "the nearest one" if spec.value is None else f"temperature.value={spec.value:g} K"
            texels.report[str(spec.raster)] = {"share_fallback": share, "fallback": rest}
        values = fill(values, nearest_valid(valid)) if spec.value is None else np.where(valid, values, spec.value)
    return values, np.where(valid, 0, FALLBACK).astype(np.uint8)


def _material(spec: TemperatureSpec, texels: Texels) -> tuple[_Kelvin, NDArray[np.uint8]]:
    # A map that is not sure of a material has it in none of its mixtures' main parts, perhaps.
    pure = [part for material in texels.materials for part, _ in (*parts_of(material), *spectra_of(material))]
    known = list(dict.fromkeys(material.name for material in pure))
    for name in spec.materials:
        if name not in known:
            raise ThermorenderError(
                f"{texels.where}: temperature.materials.{name} is not a material of this scene; "
                f"it has {', '.join(known)}"
            )

    def own(material: Material) -> float:
        if isinstance(material, Mixture):
            return sum(share * own(part) for part, share in material.parts)
        return float(spec.materials.get(material.name, material.temperature))

    values = np.array([own(material) for material in texels.materials])
    return values[texels.material], np.zeros(texels.material.shape, np.uint8)


def _learned(spec: TemperatureSpec, texels: Texels) -> tuple[_Kelvin, NDArray[np.uint8]]:
    from thermorender.learned.even import even
    from thermorender.learned.temperature_map import Inputs

    assert texels.model is not None
    if texels.surface is None or texels.material.size == 1 or not separate(texels.surface):
        return from_map(texels.model, Inputs(texels.colour, texels.texel_m), texels)
    # Faces with a colour each: neighbouring texels are not neighbours in space.
    return from_map(even(texels.model), Inputs(texels.colour, None), texels)


def learned_map(spec: TemperatureSpec) -> "TemperatureMap | None":
    """Return the TemperatureMap of a source "learned", None for all others."""
    if spec.source != "learned" or spec.model is None:
        return None
    from thermorender.learned.temperature_map import load_model

    if spec.range_c:
        scene_kelvin("range_c [K]", ZERO_CELSIUS_K + np.array(spec.range_c))
    return load_model(spec.model, spec.range_c)


def from_map(
    model: "TemperatureMap", inputs: "Inputs", texels: Texels, sky_temperature: float | None = None,
    stand_in: float | None = None,
) -> tuple[_Kelvin, NDArray[np.uint8]]:  # fmt: skip
    """Return (temperature (h, w) [K], flags (h, w) uint8) of texels from a learned map, and add to their report.

    `sky_temperature` and `stand_in` [K] are as of `learned.apply.kinetic_from_map`.
    """
    from thermorender.learned.apply import InBand, kinetic_from_map

    values, trusted, outside = kinetic_from_map(
        model, inputs, texels.material, InBand(model, texels.materials, texels.where), sky_temperature, stand_in
    )
    # A mesh has several surfaces: their mean.
    count, before = trusted.size, texels.report.get(model.name, {"texels": 0})
    now = {"share_outside_0_1": outside, "share_fallback": float(1.0 - trusted.mean())}
    total = before["texels"] + count
    texels.report[model.name] = {
        **{key: (before.get(key, 0.0) * before["texels"] + value * count) / total for key, value in now.items()},
        "texels": total,
        "texel_m": texels.texel_m,
        "trained_texel_m": model.texel_m,
        "warning": model.texel_warning(texels.texel_m),
    }
    return values, np.where(trusted, 0, FALLBACK).astype(np.uint8)


SOURCES = {"constant": _constant, "raster": _raster, "material": _material, "learned": _learned}
