"""Kinetic temperature of every texel of a surface, from the source a scene file names."""

from dataclasses import dataclass, field

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.materials.mixture import Mixture
from thermorender.scene.raster import grid_of, onto, read_band
from thermorender.scene.spec import WeatherSpec
from thermorender.scene.surface import FALLBACK, fill, nearest_valid, scene_kelvin
from thermorender.schema import Where, read
from thermorender.units import ZERO_CELSIUS_K

# Of a map's own error where nobody states it [K]: chosen, about what calibrated cameras are specified to.
ASSUMED_ERROR_K = 2.0


@dataclass(frozen=True)
class Texels:
    """What a temperature source is given: one surface's texels.

    Attributes
    ----------
    colour : (h, w, 3) uint8
    material : (h, w) uint8
    materials : tuple of Material
    grid : Grid or None
        The texels' pixel grid on the map, for rasters; None for meshes.
    texel_m : float
    where : str
        Name of the scene file, for messages.
    report : dict
    model : TemperatureMap or None
        Of a source "learned", as by `learned_map`.
    """

    colour: np.ndarray
    material: np.ndarray
    materials: tuple
    grid: object
    texel_m: float
    where: str
    report: dict = field(default_factory=dict)
    model: object = None


def resolve(spec, texels):
    """Return (temperature (h, w) float32 [K], flags (h, w) uint8) of a surface's texels.

    Parameters
    ----------
    spec : TemperatureSpec
    texels : Texels
        Its `report` gains what a user should know, such as the share of intensities outside 0…1.
    """
    temperature, flags = SOURCES[spec.source](spec, texels)
    return temperature.astype(np.float32), flags


def trained(spec, model=None):
    """Return the WeatherSpec that a source's temperatures are of; None where neither it nor its map says one.

    `model` is the learned map of the source, where it has been read already.

    Raises
    ------
    ThermorenderError
        What the map says of its training is not allowed.
    """
    if spec.trained or spec.source != "learned":
        return spec.trained
    said = (learned_map(spec) if model is None else model).trained
    return said and read(WeatherSpec, said, Where(f"learned map {spec.model!r}", top="trained"))


def map_error_k(spec, model=None):
    """Return one standard deviation of a map's own error [K]: the source's, the map's, or `ASSUMED_ERROR_K`.

    `model` is the learned map of the source, where it has been read already.
    """
    error = spec.map_error_k
    if error is None and spec.source == "learned":
        error = (learned_map(spec) if model is None else model).error_k
    return ASSUMED_ERROR_K if error is None else error


def raster_temperature(path, texels):
    """Return a raster's kelvin on the texel grid, (h, w) float64 with NaN where it has none."""
    if texels.grid is None:
        raise ThermorenderError(
            f"{texels.where}: a temperature raster needs terrain with an elevation raster; a mesh has no map grid"
        )
    grid = grid_of(path)
    values = read_band(path)
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise ThermorenderError(f"{path} has no valid temperature in it; give a raster of kelvin")
    scene_kelvin(str(path), finite)
    values = onto(values, grid, texels.grid, "bilinear")
    if not np.isfinite(values).any():
        raise ThermorenderError(f"{path} does not overlap the texels of {texels.where}; give one of the same area")
    return values


def _constant(spec, texels):
    scene_kelvin("temperature.value", spec.value)
    return np.full(texels.material.shape, spec.value), np.zeros(texels.material.shape, np.uint8)


def _raster(spec, texels):
    values = raster_temperature(spec.raster, texels)
    valid = np.isfinite(values)
    if not valid.all():
        values = fill(values, nearest_valid(valid))
    return values, np.where(valid, 0, FALLBACK).astype(np.uint8)


def _material(spec, texels):
    pure = [part for material in texels.materials for part, _ in getattr(material, "parts", ((material, 1.0),))]
    known = list(dict.fromkeys(material.name for material in pure))
    for name in spec.materials:
        if name not in known:
            raise ThermorenderError(
                f"{texels.where}: temperature.materials.{name} is not a material of this scene; "
                f"it has {', '.join(known)}"
            )

    def own(material):
        if isinstance(material, Mixture):
            return sum(share * own(part) for part, share in material.parts)
        return spec.materials.get(material.name, material.temperature)

    values = np.array([own(material) for material in texels.materials])
    return values[texels.material], np.zeros(texels.material.shape, np.uint8)


def _learned(spec, texels):
    from thermorender.learned.temperature_map import Inputs

    return from_map(texels.model, Inputs(texels.colour, texels.texel_m), texels)


def learned_map(spec):
    """Return the TemperatureMap of a source "learned", None for all others."""
    if spec.source != "learned":
        return None
    from thermorender.learned.temperature_map import load_model

    if spec.range_c:
        scene_kelvin("range_c [K]", ZERO_CELSIUS_K + np.array(spec.range_c))
    return load_model(spec.model, spec.range_c)


def from_map(model, inputs, texels, sky_temperature=None, stand_in=None):
    """Return (temperature (h, w) [K], flags (h, w) uint8) of texels by a learned map, and add to their report.

    Parameters
    ----------
    model : TemperatureMap
    inputs : Inputs
    texels : Texels
    sky_temperature, stand_in : float, optional
        As by `learned.apply.kinetic_from_map`.
    """
    from thermorender.learned.apply import kinetic_from_map

    values, trusted, outside = kinetic_from_map(
        model, inputs, texels.material, texels.materials, sky_temperature, stand_in
    )
    texels.report[model.name] = {
        "share_outside_0_1": outside,
        "share_fallback": float(1.0 - trusted.mean()),
        "texel_m": texels.texel_m,
        "trained_texel_m": model.texel_m,
        "warning": model.texel_warning(texels.texel_m),
    }
    return values, np.where(trusted, 0, FALLBACK).astype(np.uint8)


SOURCES = {"constant": _constant, "raster": _raster, "material": _material, "learned": _learned}
