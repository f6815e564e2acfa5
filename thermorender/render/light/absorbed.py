"""The air between surfaces, which the light between them ignores: an estimate of the error."""

import numpy as np

from thermorender.physics.planck import band_radiance
from thermorender.render.arrays import Floats
from thermorender.render.geometry import farthest
from thermorender.render.light.radiosity import Transport
from thermorender.scene.scene import Scene

# Number of lengths, from 1 m on, at which the change is computed.
_LENGTHS = 24


def left_out(scene: Scene, transport: Transport, reflectance: Floats) -> Floats:
    """Return an estimate from above of the change of light reflected between faces due to air, (F,) [W m⁻² sr⁻¹]. It is
    the larger change of blackbody radiance at a surface's coldest or warmest temperature over each distance between
    faces, reflected with band means `reflectance` (F,)."""
    assert scene.air is not None
    length = np.geomspace(1.0, farthest(scene), _LENGTHS)
    low = scene.altitude_m + min(float(surface.heights_m().min()) for surface in scene.surfaces)
    passed, added = scene.air.path(low, low, length)
    limits = np.array([[each.temperature.min(), each.temperature.max()] for each in scene.surfaces], np.float64)
    seen = scene.air.planck(limits) @ passed.T + added.sum(axis=-1)
    change = np.abs(seen - band_radiance(limits, *scene.camera.band_um)[..., None]).max(axis=1)
    # By surface and length, 0 at length 0.
    change, length = np.pad(change, ((0, 0), (1, 0))), np.append(0.0, length)
    middle = np.concatenate([each.vertices[each.faces].mean(axis=1) for each in scene.surfaces]).astype(np.float32)
    surface = np.repeat(np.arange(len(scene.surfaces)), [len(each.faces) for each in scene.surfaces])
    result = np.empty(len(middle))
    for rows in transport.parts():
        hits = transport.halves(rows)
        face, other = np.repeat(np.arange(rows.start, rows.stop), np.diff(hits.indptr[::2])), hits.indices
        place = np.interp(np.linalg.norm(middle[face] - middle[other], axis=1), length, np.arange(len(length)))
        lower = np.minimum(place.astype(np.intp), len(length) - 2)
        first_end, last_end = (change[surface[other], lower + k] for k in (0, 1))
        lost = hits.data / (2.0 * transport.rays) * (first_end + (place - lower) * (last_end - first_end))
        result[rows] = reflectance[rows] * np.bincount(face - rows.start, lost, rows.stop - rows.start)
    return result
