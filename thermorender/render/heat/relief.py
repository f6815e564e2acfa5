"""What a terrain knows of its texels and a photograph does not: slope, aspect, height, sky view, and sun with shadow.

Learned maps that are told it hold for more than one hour and relief; see `learned.temperature_map.Inputs.terrain`. The
sun is looked for by rays from every texel, now and over the hours before, as the ground remembers what it absorbed.
"""

from dataclasses import replace

import drjit as dr
import numpy as np

from thermorender.physics.sun import direction
from thermorender.render.geometry import Geometry
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
NAMES = (
    "normal_east", "normal_north", "normal_up", "above_m", "sky_view", "sunlight",
    *(f"sunlight_{hours:g}h" for hours in MEMORY_H),
)  # fmt: skip


def relief(scene, time, geometry=None, progress=None):
    """Return {name of `NAMES`: (h, w) float32} of the texels of a scene's terrain at an instant.

    Parameters
    ----------
    scene : Scene
        Of a raster terrain, whose map is one of the ground, with [weather].
    time : datetime64
        UTC.
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

    Raises
    ------
    ThermorenderError
        No weather.
    """
    import cv2

    geometry = geometry or Geometry(activate(), scene.surfaces)
    mi, weather, surface = geometry.mi, scene.weather, scene.surfaces[0]
    shape, texels = surface.material.shape, np.arange(surface.material.size)
    covers = np.minimum(np.array(geometry.face_of_texel())[: texels.size], len(surface.faces) - 1)
    corner = surface.vertices[surface.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = (across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)).astype(np.float32)[covers]
    point = texel_points(geometry, texels, covers)
    height = point[:, 2].reshape(shape)
    around = cv2.GaussianBlur(height, (0, 0), _AROUND_M / surface.texel_m, borderType=cv2.BORDER_REFLECT_101)
    view = cache.traced(geometry, _RAYS)[0].sky.sum(axis=1).astype(np.float32)[covers]
    upload = lambda values: [mi.Float(np.ascontiguousarray(axis)) for axis in values.T]  # noqa: E731
    point += np.float32(64.0 * 2.0**-24 * (1.0 + geometry.reach)) * normal
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

    ago = np.arange(0.5 * _STEP_H, _BACK * max(MEMORY_H), _STEP_H)
    instants = time - np.round(ago * 3600.0).astype("timedelta64[s]")
    ago, instants = ago[instants >= weather.time[0]], instants[instants >= weather.time[0]]
    weight = np.exp(-ago / np.array(MEMORY_H)[:, None])
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    now, past = sunlight(time), np.zeros((len(MEMORY_H), texels.size), dtype=np.float32)
    if not len(instants):
        # The weather has just begun: there is no past but the present.
        past += now
    for number, instant in enumerate(instants):
        light = sunlight(instant)
        for total, share in zip(past, weight[:, number], strict=True):
            if share > 1e-4:
                total += np.float32(share) * light
        if progress:
            progress("following the sun", (number + 1) / len(instants))
    found = (*normal.T, (height - around).ravel(), view, now, *past)
    return {name: np.ascontiguousarray(values.reshape(shape)) for name, values in zip(NAMES, found, strict=True)}


def mapped(scene, times, geometry=None, progress=None):
    """Return a scene with its terrain's temperatures by a learned map that is told relief, hour and weather.

    Parameters
    ----------
    scene : Scene
        Whose `told` is true.
    times : sequence of datetime64
        UTC, inside the weather.
    geometry, progress
        As of `relief`.

    Returns
    -------
    list of Scene
        One per instant. What the map tells of its apparent temperatures is seen under the sky of that instant: the
        scene's own, or that of its air. Where it cannot be trusted, the air's temperature stands in.
    """
    from thermorender.learned.temperature_map import Inputs

    geometry = geometry or Geometry(activate(), scene.surfaces)
    spec, surface, model, made = scene.spec, scene.surfaces[0], scene.told_map, {}
    for time in sorted(set(times)):
        fields = relief(scene, time, geometry, progress) if "terrain" in model.needs else {}
        sky = spec.sky_temperature if scene.air is None else scene.air.sky_temperature(scene.altitude_m)
        report = {}
        texels = Texels(surface.colour, surface.material, scene.materials, scene.grid, surface.texel_m, scene.where,
                        report)  # fmt: skip
        told = conditions(scene.weather, time, spec.weather.inside_c)
        # A material's own temperature knows nothing of the hour; the air's does.
        values, flags = from_map(model, Inputs(surface.colour, surface.texel_m, fields, told), texels, sky,
                                 told["air_k"])  # fmt: skip
        one = scene.heated(time, [values])
        known = replace(one.surfaces[0], flags=(surface.flags & ~np.uint8(FALLBACK)) | flags)
        made[time] = replace(one, surfaces=(known, *one.surfaces[1:]), report=report)
        made[time].__dict__["weather"] = scene.weather
    return [made[time] for time in times]
