"""Labels of objects: which one each pixel shows, its occluded fraction, and its truncation by the border.

The silhouette of an object is found by casting its own mesh alone, at its pose, over the part of the image that its
vertices span.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, aligned, opaque_view, view_ray
from thermorender.render.dynamic import ObjectState
from thermorender.render.geometry import Geometry
from thermorender.render.loaded import LoadedLight
from thermorender.render.object_numbers import object_names
from thermorender.render.pixels.sampling import CameraRays
from thermorender.sensor.camera import Camera

# Rays for the share of an object beyond the border. An edge across a square of them errs by up to 0.4 % of its area.
_RAYS = 1 << 16
# That share counts what lies within so many image sizes round the middle of the image.
_SIZES = 3.0


def labels(
    baked: LoadedLight, rays: CameraRays, pose: Floats, states: Sequence[ObjectState], seen: NDArray[np.uint32]
) -> dict[str, dict[str, Any]]:
    """Return the `Frame.labels` of objects whose extent meets the image; `seen` is the truth's image of objects."""
    found, camera = {}, rays.camera
    bodies = {*baked.scene.targets, *(state.name for state in states)}
    for number, name in enumerate(object_names(baked.scene), start=1):
        if name not in bodies:
            continue
        geometry, own_pose = baked.device.alone(name, states)
        view = np.linalg.inv(own_pose) @ pose
        local = (geometry.vertices - view[:3, 3]) @ view[:3, :3]
        front = local[:, 2] > 0.0
        if not front.any():
            continue
        slope = local[front, :2] / local[front, 2:]
        corner = imaged(camera, slope)
        low, high = corner.min(axis=0), corner.max(axis=0)
        size = np.array([camera.width, camera.height])
        if not front.all():
            low, high = np.minimum(low, 0.0), np.maximum(high, size)
        if (high <= 0.0).any() or (low >= size).any():
            continue
        first, last = np.maximum(np.floor(low), 0).astype(int), np.minimum(np.ceil(high), size).astype(int)
        part = slice(first[1], last[1]), slice(first[0], last[0])
        visible = seen[part] == number
        at = rays.position.reshape(seen.shape)[part][~visible]
        shown = alone = int(visible.sum())
        if at.size:
            hidden = rays.slopes(0.5, 0.5, geometry.mi.UInt32(aligned(at, np.uint32)))
            alone += int(_hits(geometry, view, *hidden).sum())
        within = bool((low >= 0.0).all() and (high <= size).all())
        found[name] = {
            "pixels": shown,
            "silhouette_pixels": alone,
            "occluded": round(1.0 - shown / alone, 4) if alone else None,
            "truncated": 0.0 if within else _beyond(camera, geometry, view, slope, bool(front.all())),
            "full_box": [round(float(v), 3) for v in (*low, *(high - low))] if front.all() else None,
        }
    return found


def _hits(geometry: Geometry, view: Floats, across: Jit, along: Jit) -> NDArray[np.bool_]:
    """Whether rays of slopes (x/z, y/z) hit a geometry seen from `view`, (n,)."""
    mi = geometry.mi
    hit = geometry.seen(view_ray(mi, *opaque_view(mi, view), across, along))
    return np.isfinite(np.array(hit.distance))


def imaged(camera: Camera, slope: Floats) -> Floats:
    """Return image coordinates, (n, 2), of slopes (n, 2); the distortion is constant beyond the corners, as it may fold
    back."""
    inner = slope * np.minimum(1.0, _reach(camera) / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12))
    ahead = np.column_stack([inner, np.ones(len(inner))])
    return camera.project(ahead) + (slope - inner) * camera.focal_length_px


@lru_cache(maxsize=4)
def _reach(camera: Camera) -> float:
    """Largest length of the slopes at the corners."""
    return float(np.linalg.norm(camera.directions(_corners(camera)), axis=-1).max())


def _corners(camera: Camera) -> Floats:
    return np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])


def _beyond(camera: Camera, geometry: Geometry, view: Floats, slope: Floats, in_front: bool) -> float | None:
    """Fraction of an object's undistorted silhouette beyond the image's border, None if no ray hits it. `slope` (n, 2)
    are those of its vertices in front of the camera."""
    corner = camera.directions(_corners(camera))
    middle, half = 0.5 * (corner.min(axis=0) + corner.max(axis=0)), 0.5 * np.ptp(corner, axis=0)
    low, high = middle - _SIZES * half, middle + _SIZES * half
    if in_front:
        low, high = np.maximum(low, slope.min(axis=0)), np.minimum(high, slope.max(axis=0))
    step = (np.arange(int(_RAYS**0.5)) + 0.5) / int(_RAYS**0.5)
    across, along = np.meshgrid(*(low[k] + step * (high[k] - low[k]) for k in (0, 1)))
    rays = np.column_stack([across.ravel(), along.ravel()])
    slopes = (geometry.mi.Float(aligned(values)) for values in rays.T)
    pixel = imaged(camera, rays[_hits(geometry, view, *slopes)])
    if not len(pixel):
        return None
    inside = ((pixel >= 0.0) & (pixel < (camera.width, camera.height))).all(axis=-1)
    return round(1.0 - float(inside.mean()), 4)
