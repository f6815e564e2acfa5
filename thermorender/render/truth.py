"""Ground truth: temperature, material, depth and position at the middle of each pixel, and where targets are.

It is not a mean over the pixel: at an edge a mean of depths or materials would describe no surface.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.physics.band import quadrature
from thermorender.physics.fresnel import COSINES
from thermorender.physics.planck import band_radiance, spectral_radiance
from thermorender.render.air import horizon_of
from thermorender.render.arrays import Floats, Jit, aligned, view_ray
from thermorender.render.dynamic import ObjectState
from thermorender.render.geometry import Hit
from thermorender.render.labels import imaged
from thermorender.render.layers import CasterView, LayerHit, first_hit
from thermorender.render.loaded import LoadedLight
from thermorender.render.pixels.sampling import RING, CameraRays
from thermorender.render.reflection.reflectance import directional
from thermorender.render.spectrum import REFERENCE_K
from thermorender.scene.surface import BACKGROUND, BEHIND
from thermorender.sensor.camera import Camera

NO_MATERIAL = 255
# Images of the uncertainty of a learned emissivity: of one texel, and of a mean over many.
EMISSIVITY_STDS = ("emissivity_std", "emissivity_mean_std")
# (H, W) of any dtype.
Image = NDArray[Any]


def truth(
    baked: LoadedLight, rays: CameraRays, pose: Floats, states: Sequence[ObjectState], middles: Hit | None = None
) -> dict[str, NDArray[Any]]:
    """Return the `Frame.truth` images at the pixels' middles; `middles` are their hits where known, see
    `CameraRays.last_hits`."""
    scene, device, band_um = baked.scene, baked.device, rays.camera.band_um
    layers, placed = device.layers(pose, states), (None, *states)
    mi = layers[0].geometry.mi

    def read(at: LayerHit) -> list[Jit]:
        geometry, hit, texels, state = at.layer.geometry, at.hit, device.texels[at.number], placed[at.number]
        texel = geometry.nearest(hit.surface, *at.place, hit.valid)
        slant = -dr.dot(mi.Vector3f(*geometry.normals.at(hit.face, hit.valid)), at.ray.d)
        if state is None:
            warm = dr.gather(mi.Float, texels.temperature, texel, hit.valid)
        else:
            warm = dr.opaque(mi.Float, float(state.temperature))
        own = (mi.UInt32(dr.gather(type(each), each, texel, hit.valid)) for each in (texels.material, texels.flags))
        material, flags = own
        return [warm, material | flags << 8, dr.gather(mi.UInt32, texels.objects, hit.surface, hit.valid), slant]

    seen, (kelvin, kind, number, cosine) = _middles(layers, rays, read, horizon_of(scene, pose), middles)
    of_material = [dr.gather(mi.Float, table, kind & 255, seen.valid) for table in device.emissivities]
    kind |= dr.select(cosine < 0.0, mi.UInt32(BEHIND << 8), 0)
    nothing = NO_MATERIAL | dr.select(seen.up, mi.UInt32(0), BACKGROUND << 8)
    by_angle = directional(scene.materials)
    known = (dr.select(seen.valid, value, np.nan) for value in (kelvin, *seen.position, *of_material))
    kind, number, depth, kelvin, *others = _images(
        rays, [dr.select(seen.valid, kind, nothing), number, seen.depth, *known, *([cosine] if by_angle else [])]
    )
    material, emissivity = (kind & 255).astype(np.uint8), others[3]
    for one in by_angle:
        here = material == one
        wavelength, weight = quadrature(*band_um)
        share = spectral_radiance(wavelength, REFERENCE_K) * weight / band_radiance(REFERENCE_K, *band_um)
        table = scene.materials[one].emissivity_at_angle(wavelength, COSINES[:, None]) @ share
        emissivity[here] = np.interp(np.abs(others[-1][here]), COSINES, table)
    images: dict[str, NDArray[Any]] = {
        "kinetic_temperature": kelvin, "emissivity": emissivity, "material": material, "object": number,
        "depth": depth, "position": np.stack(others[:3], axis=-1), "mask": (kind >> 8).astype(np.uint8),
    }  # fmt: skip
    return images | dict(zip(EMISSIVITY_STDS, others[4 : 3 + len(of_material)], strict=False))


def pixel_middles(
    layers: Sequence[CasterView], rays: CameraRays, horizon: float = 0.0
) -> tuple[Image, Image, Image, Image]:
    """Return images (H, W) at the pixels' middles: whether a surface is hit, its texel over all surfaces of the layers,
    whether the ray points to the horizon or above, and depth along the axis [m], infinite for misses. `horizon` is the
    cosine of its zenith angle."""
    mi = layers[0].geometry.mi
    first = np.cumsum([0, *(int(layer.geometry.texel_start[-1]) for layer in layers)]).tolist()

    def read(at: LayerHit) -> list[Jit]:
        return [first[at.number] + at.layer.geometry.nearest(at.hit.surface, *at.place, at.hit.valid)]

    seen, (number,) = _middles(layers, rays, read, horizon)
    number = dr.select(seen.valid, number, 0)
    valid, number, up, depth = _images(rays, [mi.UInt32(seen.valid), number, mi.UInt32(seen.up), seen.depth])
    return valid > 0, number, up > 0, depth


@dataclass(frozen=True)
class _Middles:
    """The surface points at the pixels' middles: Dr.Jit arrays, one entry per ray."""

    valid: Jit  # whether a surface is hit
    up: Jit  # whether the ray points to the horizon or above
    depth: Jit  # along the optical axis [m]
    position: Jit  # in the local frame [m]; undefined where nothing is hit


def _middles(
    layers: Sequence[CasterView], rays: CameraRays, read: Callable[[LayerHit], list[Jit]], horizon: float,
    known: Hit | None = None,
) -> tuple[_Middles, list[Jit]]:  # fmt: skip
    """(surface points at the pixels' middles, values read there); `read` and `known` as of `first_hit`."""
    mi, slope = layers[0].geometry.mi, rays.slopes(0.5, 0.5)
    hit, _, values = first_hit(layers, lambda layer: view_ray(mi, *layer.view, *slope), read, known=known)
    first, distance = view_ray(mi, *layers[0].view, *slope), hit.distance
    # Directions have unit length, so depth along the axis is distance over the length of (slope, 1).
    depth = distance / dr.sqrt(1.0 + slope[0] * slope[0] + slope[1] * slope[1])
    up = first.d.z >= dr.opaque(mi.Float, horizon)
    return _Middles(distance < np.inf, up, depth, first.o + distance * first.d), values


def _images(rays: CameraRays, values: Sequence[Jit]) -> list[Image]:
    """Images (H, W) of Dr.Jit arrays, one entry per ray in the order of `rays`."""
    sides = rays.height + 2 * RING, rays.width + 2 * RING
    targets = [dr.zeros(type(value), sides[0] * sides[1]) for value in values]
    for target, value in zip(targets, values, strict=True):
        dr.scatter(target, value, rays.ringed)
    # One evaluation for all; separate ones would cast the rays again.
    dr.eval(targets)
    return [target.numpy().reshape(sides)[RING:-RING, RING:-RING].copy() for target in targets]


def targets(
    baked: LoadedLight, camera: Camera, pose: Floats, states: Sequence[ObjectState]
) -> dict[str, dict[str, Any]]:
    """Return {object: {pixel, in_view, visible, range_m}} of the scene's objects, as `Frame.targets` has it."""
    middles = dict(baked.scene.targets)
    for tracked, state in zip(baked.scene.tracked_objects, states, strict=True):
        corner = np.concatenate([surface.vertices for surface in tracked.surfaces])
        middle = 0.5 * (corner.min(axis=0) + corner.max(axis=0))
        middles[tracked.name] = state.pose[:3, :3] @ middle + state.pose[:3, 3]
    if not middles:
        return {}
    centre = np.array(list(middles.values()))
    local = (centre - pose[:3, 3]) @ pose[:3, :3]
    pixel, front = np.full((len(local), 2), np.nan), local[:, 2] > 0.0
    pixel[front] = imaged(camera, local[front, :2] / local[front, 2:])
    distance = np.linalg.norm(local, axis=-1)
    nearest, names = np.full(len(centre), np.inf), np.full(len(centre), "", dtype=object)
    shown = [(baked.geometry, baked.scene.surfaces, np.eye(4))]
    moving = zip(baked.device.objects, states, strict=True)
    shown += [(item.geometry, item.surfaces, each.pose) for item, each in moving]
    for shapes, surfaces, own_pose in shown:
        mi, inverse = shapes.mi, np.linalg.inv(own_pose)
        # Opaque: literals would compile, and keep, a kernel for each pose.
        start = [dr.opaque(mi.Float, float(value)) for value in inverse[:3, :3] @ pose[:3, 3] + inverse[:3, 3]]
        direction = ((centre - pose[:3, 3]) / distance[:, None]) @ inverse[:3, :3].T
        hit = shapes.cast(mi.Ray3f(mi.Point3f(*start), mi.Vector3f(*map(aligned, direction.T))))
        met, surface = np.array(hit.distance), np.array(hit.surface)
        nearer = met < nearest
        names[nearer] = [surfaces[number].name.split(":")[0] for number in surface[nearer]]
        nearest = np.minimum(nearest, met)
    found: dict[str, dict[str, Any]] = {}
    for k, name in enumerate(middles):
        inside = bool(0.0 <= pixel[k, 0] < camera.width and 0.0 <= pixel[k, 1] < camera.height)
        found[name] = {
            "pixel": [round(float(value), 3) for value in pixel[k]] if np.isfinite(pixel[k]).all() else None,
            "in_view": inside,
            "visible": inside and bool(names[k] == name),
            "range_m": round(float(distance[k]), 3),
        }
    return found
