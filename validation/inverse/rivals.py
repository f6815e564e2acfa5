"""Other ways from frames to a map, on the same projection: plain mean, best view, devignetting with offsets."""

import numpy as np

from thermorender.apps.survey.inverse.solve import vignetting
from thermorender.apps.survey.inverse.weights import Viewer


def _binned(sight, values, shape):
    """(sum of values, count) of the pixels on each texel."""
    index = np.rint(sight.row).astype(np.int64) * shape[1] + np.rint(sight.column).astype(np.int64)
    known = np.isfinite(values)
    total = np.bincount(index[known], values[known], shape[0] * shape[1])
    return total.reshape(shape), np.bincount(index[known], minlength=shape[0] * shape[1]).reshape(shape)


def plain_mean(viewer: Viewer, images, poses):
    """Return the mean of all pixels on each texel, (h, w); NaN where there is none."""
    shape = viewer.lattice.shape
    total, count = np.zeros(shape), np.zeros(shape)
    for image, pose in zip(images, poses, strict=True):
        sight = viewer.sight(pose)
        part = _binned(sight, image.ravel()[sight.pixel], shape)
        total, count = total + part[0], count + part[1]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def best_view(viewer: Viewer, images, poses):
    """Return the value of the frame that shows each texel nearest to its middle, (h, w), without blending."""
    shape, camera = viewer.lattice.shape, viewer.camera
    found, nearest = np.full(shape, np.nan), np.full(shape, np.inf)
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    radius = np.hypot(row - camera.height / 2, column - camera.width / 2).ravel()
    for image, pose in zip(images, poses, strict=True):
        sight = viewer.sight(pose)
        total, count = _binned(sight, image.ravel()[sight.pixel], shape)
        far, _ = _binned(sight, radius[sight.pixel], shape)
        far = np.where(count > 0, far / np.maximum(count, 1), np.inf)
        nearer = far < nearest
        found[nearer], nearest[nearer] = (total / np.maximum(count, 1))[nearer], far[nearer]
    return found


def devignetted(viewer: Viewer, images, poses, passes=12):
    """Return (map (h, w), vignetting (H, W)): a radial polynomial of the mean image, then offsets by the overlaps.

    Each frame's offset is its mean difference from the mosaic of all frames, until the mosaic does not change.
    """
    terms = vignetting(viewer.camera)
    mean = np.nanmean(images, axis=0).ravel()
    basis = np.concatenate([np.ones((1, mean.size)), terms])
    fit, *_ = np.linalg.lstsq(basis.T, mean, rcond=None)
    lens = (fit[1:] @ terms).reshape(viewer.camera.height, viewer.camera.width)
    shape = viewer.lattice.shape
    parts = []
    for image, pose in zip(images, poses, strict=True):
        sight = viewer.sight(pose)
        total, count = _binned(sight, (image - lens).ravel()[sight.pixel], shape)
        inside = np.flatnonzero(count.ravel())
        parts.append((inside, total.ravel()[inside], count.ravel()[inside]))
    offsets = np.zeros(len(images))
    for _ in range(passes):
        total, count = np.zeros(shape[0] * shape[1]), np.zeros(shape[0] * shape[1])
        for offset, (inside, values, pixels) in zip(offsets, parts, strict=True):
            total[inside] += values - offset * pixels
            count[inside] += pixels
        mosaic = total / np.maximum(count, 1)
        offsets = np.array([
            (values - mosaic[inside] * pixels).sum() / pixels.sum() for inside, values, pixels in parts
        ])  # fmt: skip
        offsets -= offsets.mean()
    return np.where(count > 0, mosaic, np.nan).reshape(shape), lens
