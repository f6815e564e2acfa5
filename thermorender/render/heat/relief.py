"""What a terrain knows of its texels and a photograph does not: slope, aspect, height, sky view, and sun with shadow.

Learned maps that take it as input hold for more than one hour and relief; see
`learned.temperature_map.Inputs.terrain`. The sun is looked for by rays from every texel, now and over the hours before,
as the ground remembers what it absorbed.
"""

from weakref import WeakKeyDictionary

import drjit as dr
import numpy as np

from thermorender.materials.library import load_library
from thermorender.physics.sun import direction
from thermorender.render.geometry import Geometry, aligned
from thermorender.render.heat.conditions import conditions
from thermorender.render.heat.places import sun_cosine, texel_points
from thermorender.render.light import cache
from thermorender.render.variant import activate
from thermorender.scene.surface import FALLBACK
from thermorender.scene.temperature import Texels, from_map

# Sunlight is averaged over the past with weights exp(−t/τ), for these τ [h], in steps of so much, back to so many τ.
MEMORY_H = (1.0, 4.0, 16.0)
_STEP_H, _BACK = 1.0 / 3.0, 2.5
# A place is high or low against the mean of its surroundings: standard deviation of their Gaussian window [m].
_AROUND_M = 15.0
_RAYS = 64
# Steps of the past that weigh less are left out.
_LEAST_SHARE = 1e-4
# By geometry, the planes of the instant that was asked for last: the maps of a comparison ask for the same in turn.
_LAST: WeakKeyDictionary = WeakKeyDictionary()
NAMES = (
    "normal_east", "normal_north", "normal_up", "above_m", "sky_view", "sunlight",
    *(f"sunlight_{hours:g}h" for hours in MEMORY_H),
)  # fmt: skip


def relief(scene, time, geometry=None, progress=None):
    """Return {name of `NAMES`: (h, w) float32} of the texels of a scene's terrain at an instant, as by `reliefs`."""
    return reliefs(scene, [time], geometry, progress)[time]


def reliefs(scene, times, geometry=None, progress=None):
    """Return {time: {name of `NAMES`: (h, w) float32}} of the texels of a scene's terrain.

    Parameters
    ----------
    scene : Scene
        Of a raster terrain, whose map is one of the ground, with [weather].
    times : sequence of datetime64
        UTC. Those near each other share most of what is traced.
    geometry : Geometry, optional
        Of the scene's surfaces, where it is there already.
    progress : callable, optional
        Called with (what, share done).

    Returns
    -------
    dict
        Components of the unit normal; height above the mean around [m]; share of the hemisphere that is sky, cosine
        weighted, one value a face; sunlight on the surface, direct with shadow and diffuse by sky view [W m⁻²], now and
        as weighted means over the past, which begins with the weather and is the present where that has just begun.
        What one instant has does not depend on the others.

    Raises
    ------
    ThermorenderError
        No weather.
    """
    geometry = geometry or Geometry(activate(), scene.surfaces)
    asked = (*times, scene.weather_digest())
    kept, found = _LAST.get(geometry, (None, None))
    if kept != asked:
        found = _traced(scene, times, geometry, progress)
        if len(times) == 1:
            _LAST[geometry] = asked, found
    return found


def _traced(scene, times, geometry, progress):
    """The planes of `reliefs`, traced."""
    import cv2
    from scipy.ndimage import distance_transform_edt

    mi, weather, surface = geometry.mi, scene.weather, scene.surfaces[0]
    shape, texels = surface.material.shape, np.arange(surface.material.size)
    covers = np.array(geometry.face_of_texel())[: texels.size]
    bare = covers >= len(surface.faces)
    if bare.any() and not bare.all():
        # Beyond the outermost posts and in holes: as the nearest texel that a face covers.
        nearest = distance_transform_edt(bare.reshape(shape), return_distances=False, return_indices=True)
        covers = covers[np.ravel_multi_index(tuple(nearest), shape).ravel()]
    corner = surface.vertices[surface.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = (across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)).astype(np.float32)[covers]
    point = texel_points(geometry, texels, covers)
    height = point[:, 2].reshape(shape)
    around = cv2.GaussianBlur(height, (0, 0), _AROUND_M / surface.texel_m, borderType=cv2.BORDER_REFLECT_101)
    view = cache.traced(geometry, _RAYS)[0].sky.sum(axis=1).astype(np.float32)[covers]
    upload = lambda values: [mi.Float(aligned(axis)) for axis in values.T]  # noqa: E731
    point += np.float32(geometry.hair) * normal
    place, up = mi.Point3f(*upload(point)), mi.Vector3f(*upload(normal))
    dr.eval(place, up)

    def sunlight(instant):
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
    # Each instant of the past is traced once, for all times that remember it.
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


def _past(weather, time):
    """{instant: shares (len(MEMORY_H),) of it in the sunlight of the past}.

    An instant is the middle of a step of the day, or of what the weather and `time` leave of it, for which it stands.
    """
    step, day = np.timedelta64(round(_STEP_H * 3600.0), "s"), time.astype("M8[D]").astype("M8[s]")
    until = int((time - day) // step) + 1
    numbers = np.arange(until - round(_BACK * max(MEMORY_H) / _STEP_H) - 1, until + 1)
    edges = np.clip(day + numbers * step, weather.time[0], time)
    ago_h = (time - edges) / np.timedelta64(3600, "s")
    shares = np.diff(np.exp(-ago_h[:, None] / np.array(MEMORY_H)), axis=0)
    if not shares.any():
        # The weather has just begun: there is no past but the present.
        return {time: np.ones(len(MEMORY_H))}
    middles = edges[:-1] + np.diff(edges) // 2
    return dict(zip(middles, shares / shares.sum(axis=0), strict=True))


def mapped(scene, times, geometry=None, progress=None, material=False):
    """Return a scene with its terrain's temperatures by a learned map that takes relief, hour and weather as input.

    Parameters
    ----------
    scene : Scene
        With temperatures of source Conditional.
    times : sequence of datetime64
        UTC, inside the weather.
    geometry, progress
        As of `reliefs`.
    material : bool
        Adds the plane "material", numbers into the names of the shipped library in their order: for oracles only.

    Returns
    -------
    list of Scene
        One per instant. What the map tells of its apparent temperatures is seen under the sky of that instant: the
        scene's own, or that of its air. Where it cannot be trusted, the air's temperature stands in.
    """
    from thermorender.learned.temperature_map import Inputs

    spec, surface, model, made = scene.spec, scene.surfaces[0], scene.temperature_state.source.model, {}
    fields = reliefs(scene, times, geometry, progress) if "terrain" in model.needs else {time: {} for time in times}
    if material:
        names = sorted(load_library())
        number = np.array([names.index(each.name) if each.name in names else np.nan for each in scene.materials])
        own = number.astype(np.float32)[surface.material]
        fields = {time: {**planes, "material": own} for time, planes in fields.items()}
    for time in fields:
        sky = scene.sky_temperature
        report = {}
        texels = Texels(surface.colour, surface.material, scene.materials, scene.grid, surface.texel_m, scene.where,
                        report)  # fmt: skip
        given = conditions(scene.weather, time, spec.weather.inside_c)
        # A material's own temperature knows nothing of the hour; the air's does.
        values, flags = from_map(model, Inputs(surface.colour, surface.texel_m, fields[time], given), texels, sky,
                                 given["air_k"])  # fmt: skip
        known = (surface.flags & ~np.uint8(FALLBACK)) | flags
        made[time] = scene.with_solved_temperatures(time, [values], flags=[known], report=report)
    return [made[time] for time in times]
