"""A frame in plain lines: rays, texels, Planck's law, reflected light, air. Read this file first.

`basic_frame` renders what `Renderer.frame` renders, node by node, with NumPy and Mitsuba's ray caster alone. It takes
the light between surfaces from a BakedScene. The renderer is faster and more accurate:

- it sums the spectrum once, into channels of texels (`spectrum`, `light.texels`);
- it reads texture over the footprint of each ray (`pixels.footprint`), and casts more rays at edges (`pixels.tracer`);
- it interpolates the air between a few paths (`air`), and corrects what the nodes leave out (`spectrum.make_spectrum`);
- it adds moving objects (`dynamic`), mirrors (`reflection.mirrors`) and instanced bodies (`pixels.shapes`).
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.rays import horizon_cos_zenith
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance
from thermorender.render.air import altitude, background
from thermorender.render.arrays import Floats, Jit
from thermorender.render.baked import BakedScene
from thermorender.render.variant import activate
from thermorender.trajectory.rotations import checked_pose

# Points of tables that are interpolated.
_STEPS = 512
# As of `_tables`.
_Tables = tuple[Floats, Floats, Floats]


def basic_frame(baked: BakedScene, pose: ArrayLike, side: int = 1) -> Floats:
    """Return the band radiance (H, W) seen from `pose` [W m⁻² sr⁻¹], the mean of side × side rays in each pixel."""
    scene, camera = baked.scene, baked.scene.camera
    if scene.tracked_objects or baked.plan.specular or any(surface.instances is not None for surface in scene.surfaces):
        raise ThermorenderError(f"{scene.where} has moving objects, mirrors, copies or crowns; render it with Renderer")
    pose, caster, tables = checked_pose(pose), _caster(baked), _tables(baked)
    row, column = np.mgrid[: camera.height, : camera.width]
    total = np.zeros((camera.height, camera.width))
    for down in (np.arange(side) + 0.5) / side:
        for right in (np.arange(side) + 0.5) / side:
            slope = camera.directions(np.stack([column + right, row + down], axis=-1)).reshape(-1, 2)
            ray = np.column_stack([slope, np.ones(len(slope))]) @ pose[:3, :3].T
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            total += _radiance(baked, caster, tables, pose[:3, 3], ray).reshape(total.shape)
    return total / side**2


def _caster(baked: BakedScene) -> Jit:
    """All surfaces as one mesh, so that Mitsuba's number of a triangle is that of the face in the scene."""
    mi, surfaces = activate(), baked.scene.surfaces
    first = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    faces = np.concatenate([surface.faces + start for surface, start in zip(surfaces, first, strict=False)])
    mesh = mi.Mesh("scene", int(first[-1]), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (
        np.concatenate([surface.vertices for surface in surfaces]).astype(np.float32).ravel()
    )
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    # Without robust intersections rays leak between triangles.
    return mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "mesh": mesh})


def _radiance(baked: BakedScene, caster: Jit, tables: _Tables, eye: Floats, ray: Floats) -> Floats:
    """Band radiance (n,) that arrives at a point `eye` (3,) [m] against directions (n, 3) of length 1 [W m⁻² sr⁻¹]."""
    found, (hit, distance, face, u, v) = _beyond(baked, eye, ray), _hits(caster, eye, ray)
    if not hit.any():
        return found
    passed, added = _air(baked, eye, eye + distance[:, None] * ray[hit], distance)
    radiance = added.sum(axis=1)
    for material, temperature, weight in _texels(baked, face, u, v):
        for node in range(passed.shape[1]):
            radiance += weight * passed[:, node] * _leaving(baked, tables, node, face, material, temperature)
    found[hit] = radiance
    return found


def _hits(caster: Jit, eye: Floats, ray: Floats) -> tuple[NDArray[np.bool_], Floats, NDArray[np.int64], Floats, Floats]:
    """(whether each ray hits a surface; of those that do: distance [m], face, and two barycentric coordinates)."""
    mi = activate()
    start = mi.Point3f(*(np.full(len(ray), value, np.float32) for value in eye))
    found = caster.ray_intersect_preliminary(mi.Ray3f(start, mi.Vector3f(*ray.T.astype(np.float32))))
    hit = np.isfinite(np.array(found.t))
    distance, face, u, v = (np.array(values)[hit] for values in (found.t, found.prim_index, *found.prim_uv))
    return hit, distance.astype(np.float64), face.astype(np.int64), u.astype(np.float64), v.astype(np.float64)


def _texels(
    baked: BakedScene, face: NDArray[np.int64], u: Floats, v: Floats
) -> Iterator[tuple[NDArray[np.int64], Floats, Floats]]:
    """Yield (number of the material, temperature [K], weight) of each of the four texels round points of faces."""
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        material, temperature, weight, first = (
            np.zeros(len(face), np.int64),
            np.zeros(len(face)),
            np.zeros(len(face)),
            0,
        )
        for surface in baked.scene.surfaces:
            own = (face >= first) & (face < first + len(surface.faces))
            corner, (rows, columns) = surface.uv[face[own] - first], surface.material.shape
            share = np.stack([1.0 - u[own] - v[own], u[own], v[own]], axis=1)
            x, y = (np.einsum("nc,nca->na", share, corner) * (columns, rows) - 0.5).T
            column, row = np.floor(x) + right, np.floor(y) + down
            at = tuple(np.clip(k, 0, n - 1).astype(int) for k, n in ((row, rows), (column, columns)))
            material[own], temperature[own] = surface.material[at], surface.temperature[at]
            weight[own] = (1.0 - np.abs(x - column)) * (1.0 - np.abs(y - row))
            first += len(surface.faces)
        yield material, temperature, weight


def _tables(baked: BakedScene) -> _Tables:
    """(temperatures (G,) [K], emission (M, G, n) [W m⁻² sr⁻¹], reflectance (M, N, n)) of M materials, n nodes of air, N
    of light."""
    spectrum, points = baked.plan.spectrum, baked.plan.spectrum.points
    grid = np.linspace(baked.plan.coldest, baked.plan.warmest + 1e-3, _STEPS)
    of_air = np.equal.outer(points.node, np.arange(points.node.max() + 1)).astype(np.float64)
    of_light = np.equal.outer(np.arange(spectrum.nodes), spectrum.label) * points.planck(300.0)
    of_light /= of_light.sum(axis=1, keepdims=True)
    emissivity = [material.emissivity_at(points.wavelength_um) for material in baked.scene.materials]
    emitted = np.stack([points.planck(grid) * each @ of_air for each in emissivity])
    return grid, emitted, np.stack([of_light * (1.0 - each) @ of_air for each in emissivity])


def _leaving(
    baked: BakedScene, tables: _Tables, node: int, face: NDArray[np.int64],
    material: NDArray[np.int64], temperature: Floats,
) -> Floats:  # fmt: skip
    """Radiance (n,) that leaves surfaces in one node of the air, emitted and reflected [W m⁻² sr⁻¹]."""
    (grid, emitted, reflected), found = tables, np.zeros(len(face))
    for number in np.unique(material):
        here = material == number
        found[here] = np.interp(temperature[here], grid, emitted[number, :, node])
        if baked.incident is not None:
            found[here] += baked.incident[face[here]] @ reflected[number, :, node]
    return found


def _air(baked: BakedScene, eye: Floats, point: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """(transmittance, radiance added [W m⁻² sr⁻¹]) of paths from `eye` to points (n, 3) at each node, (n, nodes)."""
    air, base = baked.scene.air, baked.scene.altitude_m
    if air is None:
        return np.ones((len(distance), 1)), np.zeros((len(distance), 1))
    return air.path(float(altitude(eye, base)), altitude(point, base), distance)


def _beyond(baked: BakedScene, eye: Floats, ray: Floats) -> Floats:
    """Band radiance (n,) of rays that hit nothing: sky above the horizon, black surroundings below [W m⁻² sr⁻¹]."""
    scene, ground_k = baked.scene, baked.scene.surroundings_temperature
    if scene.air is None:
        sky, ground = band_radiance(np.array([scene.sky_temperature, ground_k]), *baked.plan.band_um)
        return np.where(ray[:, 2] >= 0.0, sky, ground)
    camera, position = float(altitude(eye, scene.altitude_m)), np.linspace(0.0, 1.0, _STEPS)
    ground, sky = background(scene.air, camera, scene.altitude_m, ground_k, position)
    rise = ray[:, 2] - float(horizon_cos_zenith(camera))
    above = np.sqrt(np.maximum(rise, 0.0) / (1.0 - float(horizon_cos_zenith(camera))))
    below = np.sqrt(np.maximum(-rise, 0.0) / (1.0 + float(horizon_cos_zenith(camera))))
    return np.where(rise >= 0.0, np.interp(above, position, sky), np.interp(below, position, ground))
