"""Ground truth: temperature, material, depth and position at the middle of each pixel, and where targets are.

Truth describes the one surface that a pixel's middle shows. It is not a mean over the pixel: at an edge a mean of
depths or materials would describe no surface.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.materials.mixture import Mixture
from thermorender.physics.band import quadrature
from thermorender.physics.fresnel import COSINES
from thermorender.physics.planck import band_radiance, spectral_radiance
from thermorender.render.arrays import Floats, aligned, view_ray
from thermorender.render.dynamic import Placement
from thermorender.render.labels import imaged, object_numbers
from thermorender.render.layers import Shape
from thermorender.render.pixels.sampling import CameraRays
from thermorender.render.reflection.reflectance import directional
from thermorender.render.spectrum import REFERENCE_K
from thermorender.scene.surface import BACKGROUND, BEHIND
from thermorender.sensor.camera import Camera

if TYPE_CHECKING:
    from thermorender.render.baked import BakedScene

NO_MATERIAL = 255
# (H, W) of any dtype.
Image = NDArray[Any]


def truth(
    baked: "BakedScene", rays: CameraRays, pose: Floats, placements: Sequence[Placement]
) -> dict[str, NDArray[Any]]:
    """Return {name: image} of the ground truth at the pixels' middles, as `Frame.truth` has it."""
    scene, camera, layers = baked.scene, rays.camera, baked.device.layers(pose, placements)
    warm = [placement.temperature for placement in placements]
    by_angle = directional(scene.materials)
    valid, number, up, cosine, depth, position = pixel_middles(layers, rays, facing=True)
    dynamic = [surface for tracked in scene.tracked_objects for surface in tracked.surfaces]
    flags, material = (
        np.concatenate([getattr(surface, which).ravel() for surface in (*scene.surfaces, *dynamic)])[number]
        for which in ("flags", "material")
    )
    sizes = [int(layer.geometry.texel_start[-1]) for layer in layers[1:]]
    static = [surface.temperature.ravel() for surface in scene.surfaces]
    temperature = np.concatenate([*static, np.repeat(warm, sizes).astype(np.float32)])[number]
    band_um = camera.band_um
    emissivity = np.array([each.band_emissivity(*band_um, REFERENCE_K) for each in scene.materials])[material]
    for one in by_angle:
        here = material == one
        wavelength, weight = quadrature(*band_um)
        share = spectral_radiance(wavelength, REFERENCE_K) * weight / band_radiance(REFERENCE_K, *band_um)
        table = scene.materials[one].emissivity_at_angle(wavelength, COSINES[:, None]) @ share
        emissivity[here] = np.interp(np.abs(cosine[here]), COSINES, table)
    found: dict[str, NDArray[Any]] = {
        "kinetic_temperature": np.where(valid, temperature, np.nan).astype(np.float32),
        "emissivity": np.where(valid, emissivity, np.nan).astype(np.float32),
        "material": np.where(valid, material, NO_MATERIAL).astype(np.uint8),
        "object": object_numbers(scene, valid, number),
        "depth": np.where(valid, depth, np.inf).astype(np.float32),
        "position": np.where(valid[..., None], np.stack(position, axis=-1), np.nan).astype(np.float32),
        "mask": np.where(valid, flags | np.where(cosine < 0, BEHIND, 0), np.where(up, 0, BACKGROUND)).astype(np.uint8),
    }
    if any(isinstance(each, Mixture) for each in scene.materials):
        std = np.array([each.band_emissivity_std(*band_um, REFERENCE_K) for each in scene.materials])[material]
        found["emissivity_std"] = np.where(valid, std, np.nan).astype(np.float32)
    return found


def pixel_middles(
    layers: Sequence[Shape], rays: CameraRays, facing: bool = False
) -> tuple[Image, Image, Image, Image, Image, list[Image]]:
    """Return the surface points at the pixels' middles as images (H, W): valid, texel, up, cosine, depth, position.

    Returns
    -------
    valid, up : bool
        Whether a surface is hit, and whether the ray points to the horizon or above.
    texel : uint32
        Its number over all surfaces of the layers.
    cosine, depth : float32
        Of the angle at the surface, below 0 on its back, computed only if `facing`; along the optical axis [m],
        infinity where nothing is hit.
    position : list of three float32
        In the local frame [m].
    """
    mi = layers[0].geometry.mi
    slope = rays.slopes(0.5, 0.5)
    valid, distance, texel, first = mi.Bool(False), mi.Float(np.inf), mi.UInt32(0), 0
    cosine = mi.Float(0.0)
    for layer in layers:
        geometry = layer.geometry
        ray = view_ray(mi, *layer.view, *slope)
        hit = geometry.seen(ray)
        column, row = geometry.map_position(geometry.record(hit.face, hit.valid), ray.o + hit.distance * ray.d)
        nearer = hit.distance < distance
        found = first + geometry.nearest(hit.surface, column, row, hit.valid)
        texel, distance = dr.select(nearer, found, texel), dr.minimum(distance, hit.distance)
        if facing:
            slant = -dr.dot(mi.Vector3f(*geometry.normals.at(hit.face, hit.valid)), ray.d)
            cosine = dr.select(nearer, slant, cosine)
        valid |= nearer
        first += int(geometry.texel_start[-1])
    ray = view_ray(mi, *layers[0].view, *slope)
    position = ray.o + distance * ray.d
    # Directions have unit length, so depth along the axis is distance over the length of (slope, 1).
    depth = distance / dr.sqrt(1.0 + slope[0] * slope[0] + slope[1] * slope[1])
    found = [mi.UInt32(valid), texel, mi.UInt32(ray.d.z >= 0.0), cosine, depth, *position]
    # One evaluation for all; separate ones would cast the rays again.
    dr.eval(found)
    images = []
    for values in found:
        flat = np.empty(rays.camera.height * rays.camera.width, np.array(values).dtype)
        flat[rays.order] = np.array(values)[: flat.size]
        images.append(flat.reshape(rays.camera.height, rays.camera.width))
    valid, number, up, cosine, depth, *position = images
    return valid > 0, number, up > 0, cosine, depth, position


def targets(
    baked: "BakedScene", camera: Camera, pose: Floats, placements: Sequence[Placement]
) -> dict[str, dict[str, Any]]:
    """Return {object: {pixel, in_view, visible, range_m}} of the scene's objects, as `Frame.targets` has it."""
    middles = dict(baked.scene.targets)
    for tracked, placement in zip(baked.scene.tracked_objects, placements, strict=True):
        corner = np.concatenate([surface.vertices for surface in tracked.surfaces])
        middle = 0.5 * (corner.min(axis=0) + corner.max(axis=0))
        middles[tracked.name] = placement.pose[:3, :3] @ middle + placement.pose[:3, 3]
    if not middles:
        return {}
    centre = np.array(list(middles.values()))
    local = (centre - pose[:3, 3]) @ pose[:3, :3]
    pixel, front = np.full((len(local), 2), np.nan), local[:, 2] > 0.0
    pixel[front] = imaged(camera, local[front, :2] / local[front, 2:])
    distance = np.linalg.norm(local, axis=-1)
    nearest, names = np.full(len(centre), np.inf), np.full(len(centre), "", dtype=object)
    shown = [(baked.geometry, baked.scene.surfaces, np.eye(4))]
    moving = zip(baked.device.objects, placements, strict=True)
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
