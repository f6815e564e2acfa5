"""Terrain inputs of learned maps that a photograph lacks: slope, aspect, height, sky view, and sunlight with shadow.

Shadow rays from every texel sample the sun at the instant and over the hours before, as the ground stores absorbed
sunlight. See `learned.temperature_map.Inputs.terrain`.
"""

from collections.abc import Callable, Sequence
from typing import Any
from weakref import WeakKeyDictionary

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.materials.library import load_library
from thermorender.physics.sun import direction
from thermorender.render.arrays import aligned
from thermorender.render.geometry import Geometry
from thermorender.render.heat.conditions import conditions
from thermorender.render.heat.places import sun_cosine, texel_points
from thermorender.render.light import transport_cache
from thermorender.render.variant import activate
from thermorender.scene.scene import Scene
from thermorender.scene.surface import FALLBACK
from thermorender.scene.temperature import Texels, from_map
from thermorender.scene.temperature_state import Conditional
from thermorender.weather.series import Weather

Progress = Callable[[str, float], object]
Planes = dict[str, NDArray[np.float32]]

# Sunlight is averaged over the past with weights exp(−t/τ), for these τ [h]: step [h] and length of the past in τ.
MEMORY_H = (1.0, 4.0, 16.0)
_STEP_H, _BACK = 1.0 / 3.0, 2.5
# Heights are relative to a Gaussian mean of the surroundings: its standard deviation [m].
_AROUND_M = 15.0
_RAYS = 64
# Steps of the past with smaller weights are left out.
_LEAST_SHARE = 1e-4
# The latest planes of one instant, by geometry and ground: a comparison evaluates several maps for the same instant.
_LAST: WeakKeyDictionary[Geometry, dict[int, tuple[Any, Any]]] = WeakKeyDictionary()
NAMES = (
    "normal_east", "normal_north", "normal_up", "above_m", "sky_view", "sunlight",
    *(f"sunlight_{hours:g}h" for hours in MEMORY_H),
)  # fmt: skip


def relief(
    scene: Scene, time: np.datetime64, geometry: Geometry | None = None, progress: Progress | None = None
) -> Planes:
    """Return {name of `NAMES`: (h, w) float32} of the texels of a scene's raster at an instant, as `reliefs`."""
    return reliefs(scene, [time], geometry, progress)[time]


def reliefs(
    scene: Scene, times: "Sequence[np.datetime64]", geometry: Geometry | None = None, progress: Progress | None = None,
    ground: int = 0,
) -> "dict[np.datetime64, Planes]":  # fmt: skip
    """Return {time: {name of `NAMES`: (h, w) float32}} of the texels of a scene's raster terrain, or of far `ground` by
    the number of its surface. The planes are the unit normal; height above the mean around [m]; cosine-weighted sky
    view per face; and sunlight, direct with shadow plus diffuse by sky view [W m⁻²], now and as weighted means over the
    past. Without earlier weather the means are the present value. Planes do not depend on the other instants, but close
    instants share rays."""
    geometry = geometry or Geometry(activate(), scene.surfaces)
    asked = (*times, scene.weather_digest())
    last = _LAST.setdefault(geometry, {})
    kept, found = last.get(ground, (None, None))
    if kept != asked:
        found = _traced(scene, ground, times, geometry, progress)
        if len(times) == 1:
            last[ground] = asked, found
    return found


def _traced(
    scene: Scene, ground: int, times: "Sequence[np.datetime64]", geometry: Geometry, progress: Progress | None
) -> "dict[np.datetime64, Planes]":
    """The planes of `reliefs` of one ground, by its number, traced."""
    import cv2
    from scipy.ndimage import distance_transform_edt

    mi, weather, surface = geometry.mi, scene.weather, scene.surfaces[ground]
    shape, texels = surface.material.shape, geometry.texel_start[ground] + np.arange(surface.material.size)
    covers = np.array(geometry.face_of_texel)[texels].astype(np.int64) - geometry.face_start[ground]
    bare = covers >= len(surface.faces)
    if bare.any() and not bare.all():
        # Beyond the outermost posts and in holes the nearest texel that a face covers is used.
        nearest = distance_transform_edt(bare.reshape(shape), return_distances=False, return_indices=True)
        covers = covers[np.ravel_multi_index(tuple(nearest), shape).ravel()]
    corner = surface.vertices[surface.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = (across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)).astype(np.float32)[covers]
    covers += geometry.face_start[ground]
    point = texel_points(geometry, texels, covers)
    height = point[:, 2].reshape(shape)
    around = cv2.GaussianBlur(height, (0, 0), _AROUND_M / surface.texel_m, borderType=cv2.BORDER_REFLECT_101)
    view = transport_cache.traced(geometry, _RAYS)[0].sky.sum(axis=1).astype(np.float32)[covers]
    upload = lambda values: [mi.Float(aligned(axis)) for axis in values.T]  # noqa: E731
    point += geometry.hair_at(point) * normal
    place, up = mi.Point3f(*upload(point)), mi.Vector3f(*upload(normal))
    dr.eval(place, up)

    def sunlight(instant: np.datetime64) -> NDArray[np.float32]:
        azimuth, elevation = map(float, weather.sun(instant))
        found = weather.at(instant)
        total = np.float32(found.diffuse_w_m2) * view
        if elevation > 0.0 and found.direct_w_m2 > 0.0:
            lit = np.array(sun_cosine(geometry, place, up, direction(elevation, azimuth)))
            total = total + np.float32(found.direct_w_m2) * lit
        return total

    shares = {time: _past(weather, time) for time in dict.fromkeys(times)}
    memory = {time: np.zeros((len(MEMORY_H), texels.size), dtype=np.float32) for time in shares}
    instants = sorted({instant for of_time in shares.values() for instant in of_time})
    # Each instant of the past is traced once for all times that include it.
    for number, instant in enumerate(instants):
        light = sunlight(instant)
        for time, of_time in shares.items():
            for total, share in zip(memory[time], of_time.get(instant, ()), strict=False):
                if share > _LEAST_SHARE:
                    total += np.float32(share) * light
        if progress:
            progress("following the sun", (number + 1) / len(instants))
    still = dict(zip(NAMES, (*normal.T, (height - around).ravel(), view), strict=False))
    found = {}
    for time in shares:
        values = {**still, **dict(zip(NAMES[len(still) :], (sunlight(time), *memory[time]), strict=True))}
        found[time] = {name: np.ascontiguousarray(plane.reshape(shape)) for name, plane in values.items()}
    return found


def _past(weather: Weather, time: np.datetime64) -> "dict[np.datetime64, NDArray[np.float64]]":
    """{instant: its weights (len(MEMORY_H),) in past sunlight}: middles of the day's steps, clipped to the weather
    before `time`."""
    step, day = np.timedelta64(round(_STEP_H * 3600.0), "s"), time.astype("M8[D]").astype("M8[s]")
    until = int((time - day) // step) + 1
    numbers = np.arange(until - round(_BACK * max(MEMORY_H) / _STEP_H) - 1, until + 1)
    edges = np.clip(day + numbers * step, weather.time[0], time)
    ago_h = (time - edges) / np.timedelta64(3600, "s")
    shares = np.diff(np.exp(-ago_h[:, None] / np.array(MEMORY_H)), axis=0)
    if not shares.any():
        # The weather begins at this instant: the present stands in for the past.
        return {time: np.ones(len(MEMORY_H))}
    middles = edges[:-1] + np.diff(edges) // 2
    return dict(zip(middles, shares / shares.sum(axis=0), strict=True))


def mapped(
    scene: Scene, times: "Sequence[np.datetime64]", geometry: Geometry | None = None, progress: Progress | None = None,
    material: bool = False,
) -> list[Scene]:  # fmt: skip
    """Return a scene at some instants (UTC), with terrain temperatures by a learned map of relief, hour and weather. A
    map of apparent temperatures refers to the sky of that instant. Where the map reports failure, the air's temperature
    is used. `material` adds the input "material", numbers into the shipped library, for privileged maps only."""
    from thermorender.learned.temperature_map import Inputs

    source = scene.temperature_state.source
    assert isinstance(source, Conditional) and scene.spec.weather is not None
    ground, model, solved = scene.surfaces[: scene.terrain_count], source.model, {}
    planes_of: dict[np.datetime64, list[Planes]] = {time: [{} for _ in ground] for time in times}
    if "terrain" in model.needs:
        geometry = geometry or Geometry(activate(), scene.surfaces)
        each = [reliefs(scene, times, geometry, progress, number) for number in range(len(ground))]
        planes_of = {time: [planes[time] for planes in each] for time in times}
    if material:
        names = sorted(load_library())
        number = np.array([names.index(each.name) if each.name in names else np.nan for each in scene.materials])
        own = [number.astype(np.float32)[surface.material] for surface in ground]
        planes_of = {
            time: [{**one, "material": numbers} for one, numbers in zip(planes, own, strict=True)]
            for time, planes in planes_of.items()
        }
    # The map's apparent temperatures are of its own band, which may not be the camera's.
    sky = scene.sky_temperature_in(model.band_um)
    for time, planes in planes_of.items():
        report: dict[str, Any] = {}
        given = conditions(scene.weather, time, scene.spec.weather.inside_c)
        kelvin, known = [], []
        for surface, one in zip(ground, planes, strict=True):
            texels = Texels(surface.colour, surface.material, scene.materials, None, surface.texel_m, scene.where,
                            {} if surface.far else report)  # fmt: skip
            # Where the map fails, the air's temperature follows the hour; a material's own does not.
            values, flags = from_map(model, Inputs(surface.colour, surface.texel_m, one, given), texels, sky,
                                     given["air_k"])  # fmt: skip
            kelvin.append(values)
            known.append((surface.flags & ~np.uint8(FALLBACK)) | flags)
        solved[time] = scene.with_solved_temperatures(time, kelvin, flags=known, report=report)
    return [solved[time] for time in times]
