"""Registration of single frames to a map: a search over shifts of the image, then Gauss–Newton steps, coarse to fine.

The search turns the camera, since a turn hardly differs from a shift for a small field of view. The steps divide the
correction between position and angles by their uncertainties. Contrast, level and tilt of the image are free, because
prior and ground temperatures may differ from those of the frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.survey.inverse.weights import Sight, Viewer, moved, taps_of

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
# Standard deviations of the blur of the levels [px], and steps of each.
_LEVELS = ((4.0, 3), (2.0, 2), (1.0, 2))
# A search ends at so many standard deviations of the pose.
_REACH = 3.0
# Lowest correlation of a shift that is believed.
_LEAST_ALIKE = 0.2
# Fewer pixels than this do not move a pose.
_LEAST_PIXELS = 100
# Features with a smaller standard deviation are constant, and share of its variance that a feature loses in a fit.
_FLAT, _RIDGE = 1e-6, 1e-4
# Structure coarser than this is left out of the search, as share of the image's height.
_COARSEST = 1.0 / 6.0


@dataclass(frozen=True)
class PoseError:
    """Standard deviations of measured poses: along each axis [m], and about each axis [deg]."""

    position_m: float = 1.0
    angle_deg: float = 0.7

    def times(self, factor: float) -> "PoseError":
        """Return standard deviations that are larger by a factor."""
        return PoseError(factor * self.position_m, factor * self.angle_deg)

    @property
    def precision(self) -> Floats:
        """1 over the variances of a step as of `moved`, (6,)."""
        angle = np.radians(self.angle_deg)
        return np.repeat(1.0 / np.maximum([self.position_m**2, angle**2], 1e-12), 3)


def slopes(values: Floats) -> tuple[Floats, Floats]:
    """Return the change of a map (h, w) along its columns and along its rows, by central differences."""
    down, right = np.gradient(values)
    return np.asarray(right), np.asarray(down)


def registered(
    viewer: Viewer, values: Floats, image: Image, pose: Floats, measured: Floats, error: PoseError, search: bool = True
) -> Floats:  # fmt: skip
    """Return the pose (4, 4) that fits an image (H, W) best to a map, within the error of the measured pose.

    It starts at `pose`, with shifts and coarse steps if `search`.
    """
    if search:
        pose = _searched(viewer, values, image, pose, error)
    right, down = slopes(values)
    for sigma, steps in _LEVELS if search else _LEVELS[1:]:
        for _ in range(steps):
            step = _step(viewer, values, (right, down), image, pose, measured, error, sigma)
            pose = moved(pose, step)
            if np.abs(step * np.sqrt(error.precision)).max() < 1e-4:
                break
    return pose


def explained(
    viewer: Viewer, images: Sequence[Image], poses: Floats, features: Floats, lens: Floats, error: PoseError
) -> Floats:  # fmt: skip
    """Return the combination of features (K, h, w), a map without level, that explains the images of frames best.

    Each image has its own level and shares the terms `lens` (V, H·W). Features are smoothed by the error of the poses.
    """
    import cv2

    spread = [feature.std() for feature in features]
    features = np.array([
        (feature - feature.mean()) / each for feature, each in zip(features, spread, strict=True) if each > _FLAT
    ])  # fmt: skip
    if not len(features):
        return np.zeros(viewer.lattice.shape)
    size = len(features) + len(lens)
    matrix, pull, smooth = np.zeros((size, size)), np.zeros(size), None
    for image, pose in zip(images, poses, strict=True):
        sight = viewer.sight(pose)
        known = np.isfinite(image.ravel()[sight.pixel])
        if not known.any():
            continue
        if smooth is None:
            away = np.hypot(
                error.position_m, np.radians(error.angle_deg) * np.median(np.linalg.norm(sight.ray, axis=0))
            )
            width = max(float(away) / viewer.lattice.texel_m, 0.1)
            smooth = [cv2.GaussianBlur(feature, (0, 0), width) for feature in features]
        columns = np.array([*(sight.at(each) for each in smooth), *lens[:, sight.pixel]])[:, known]
        columns -= columns.mean(axis=1, keepdims=True)
        matrix += columns @ columns.T
        pull += columns @ image.ravel()[sight.pixel[known]]
    factors = np.linalg.solve(matrix + np.diag(_RIDGE * matrix.diagonal() + 1e-12), pull)
    return np.asarray(np.tensordot(factors[: len(features)], features, axes=1))


def deviation(pose: Floats, measured: Floats) -> Floats:
    """Return the step (6,) as of `moved` from a measured pose to another."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(pose[:3, :3] @ measured[:3, :3].T).as_rotvec()
    return np.concatenate([pose[:3, 3] - measured[:3, 3], turn])


def _seen(viewer: Viewer, values: Floats, sight: Sight) -> Floats:
    """The map as an image, (H·W,); NaN where the frame does not show it."""
    whole = np.full(viewer.camera.height * viewer.camera.width, np.nan)
    whole[sight.pixel] = sight.seen(values, taps_of())
    return whole


def _searched(viewer: Viewer, values: Floats, image: Image, pose: Floats, error: PoseError) -> Floats:
    """The pose after the turn that shifts the image to its best correlation with the map."""
    camera = viewer.camera
    sight = viewer.sight(pose)
    if not sight.pixel.size:
        return pose
    predicted = _seen(viewer, values, sight).reshape(camera.height, camera.width)
    distance = float(np.median(np.linalg.norm(sight.ray, axis=0)))
    reach = _REACH * np.hypot(error.position_m / distance, np.radians(error.angle_deg)) * camera.focal_length_px
    most = int(np.ceil(min(reach, 0.4 * min(camera.height, camera.width))))
    shift = _shift(_highpass(predicted), _highpass(image.astype(np.float64)), most)
    # A point that should appear `shift` further right and down: the camera turns the other way, about its own axes.
    turn = np.array([shift[1], -shift[0], 0.0]) / camera.focal_length_px
    return moved(pose, np.concatenate([np.zeros(3), pose[:3, :3] @ turn]))


def _highpass(image: Floats) -> Floats:
    """An image without coarse structure, 0 where it is unknown."""
    import cv2

    known = np.isfinite(image)
    filled = np.where(known, image, 0.0)
    sigma = _COARSEST * image.shape[0]
    total, count = (cv2.GaussianBlur(each, (0, 0), sigma) for each in (filled, known.astype(np.float64)))
    found: Any = np.where(known, image - total / np.maximum(count, 1e-9), 0.0)
    limit = 3.0 * found.std()
    return np.asarray(np.clip(found, -limit, limit))


def _shift(predicted: Floats, image: Floats, most: int) -> Floats:
    """Return (right, down) [px], up to `most`, of the image against the prediction; zero if the correlation is low."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    size = tuple(next_fast_len(side + most, real=True) for side in image.shape)

    def crossed(a: Floats, b: Floats) -> Floats:
        found = irfft2(np.conj(rfft2(a, size)) * rfft2(b, size), size)
        line = np.arange(-most, most + 1)
        return np.asarray(found[np.ix_(line, line)])

    product = crossed(predicted, image)
    energy = crossed((predicted != 0.0).astype(float), image**2), crossed(predicted**2, (image != 0.0).astype(float))
    floor = 0.05 * float((image**2).sum()), 0.05 * float((predicted**2).sum())
    score = product / np.sqrt(np.maximum(energy[0], floor[0] + 1e-12) * np.maximum(energy[1], floor[1] + 1e-12))
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    if score[row, column] < _LEAST_ALIKE:
        return np.zeros(2)
    return np.array([column - most, row - most], np.float64)


def _step(
    viewer: Viewer, values: Floats, slope: tuple[Floats, Floats], image: Image, pose: Floats, measured: Floats,
    error: PoseError, sigma: float,
) -> Floats:  # fmt: skip
    """One Gauss–Newton step of a pose, (6,), with contrast, offset and tilt of the image eliminated."""
    import cv2

    camera = viewer.camera
    sight = viewer.sight(pose)
    if sight.pixel.size < _LEAST_PIXELS:
        return np.zeros(6)
    known = np.isfinite(image.ravel()[sight.pixel])
    predicted = sight.seen(values, taps_of())
    columns = np.concatenate([[image.ravel()[sight.pixel], predicted, np.ones_like(predicted)],
                              sight.motion(*(sight.at(each) for each in slope))])  # fmt: skip
    whole = np.zeros((len(columns), camera.height * camera.width))
    whole[:, sight.pixel[known]] = columns[:, known]
    smooth = np.array([
        cv2.GaussianBlur(each.reshape(camera.height, camera.width), (0, 0), sigma).ravel() for each in whole
    ])  # fmt: skip
    # Where most of the blur is known.
    inside = smooth[2] > 0.7
    # Most pixels may have no value, such as in a frame behind a mask.
    if inside.sum() < _LEAST_PIXELS:
        return np.zeros(6)
    smooth = smooth[:, inside] / smooth[2, inside]
    row, column = np.divmod(np.flatnonzero(inside), camera.width)
    plain = np.array([np.ones(len(row)), column / camera.width - 0.5, row / camera.height - 0.5, smooth[1]])
    basis, factor = np.linalg.qr(plain.T)
    # The contrast: factor of the map in the image.
    gain = float(basis[:, 3] @ smooth[0]) / (factor[3, 3] or 1.0)
    rest = smooth[[0, *range(3, 9)]]
    rest = rest - (rest @ basis) @ basis.T
    # Steps towards a map that does not resemble the image would lead anywhere.
    along = gain * abs(float(factor[3, 3]))
    if along < _LEAST_ALIKE * np.hypot(along, np.linalg.norm(rest[0])):
        return np.zeros(6)
    rest[1:] *= np.clip(gain, 0.2, 3.0)
    scale = np.median(np.abs(rest[0])) / 0.6745 + 1e-9
    weight = 1.0 / (1.0 + (rest[0] / (2.0 * scale)) ** 2)
    # Neighbours within the blur are not independent.
    weight = weight / (scale**2 * max(4.0 * np.pi * sigma**2, 1.0))
    matrix = (rest[1:] * weight) @ rest[1:].T + np.diag(error.precision)
    pull = (rest[1:] * weight) @ rest[0] - error.precision * deviation(pose, measured)
    return np.linalg.solve(matrix, pull)
