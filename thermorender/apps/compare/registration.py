"""Power spectrum of pictures, their shift against the reference, and temporal stability, which a mean error misses."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.view import View
from thermorender.sensor.camera import Camera

Transform = NDArray[np.complexfloating]

# Largest side of the central square whose spectrum is taken, and largest shift searched (at most a quarter of the
# square) [px].
_SIDE, _MOST_SHIFT = 512, 48
# Number of groups of poses of the jackknife.
_GROUPS = 16
# Pictures that correlate at least this well after a shift show the same.
ALIKE = 0.5
# Structure broader than this is filtered out before the shift is measured [px].
_FINE_PX = 6.0
# Edges this near coincide [px].
_NEAR_PX = 2.0
# Spacing of the ground points that are followed from frame to frame [px], and the relative difference of depth up to
# which a point counts as the same.
_EVERY, _SAME_DEPTH = 2, 0.02


@cache
def window(shape: tuple[int, int]) -> tuple[tuple[slice, slice], NDArray[np.float32]]:
    """Return (rows, columns) slices of the central square of a picture, and its Hann window."""
    side = min(_SIDE, *shape)
    top, left = (shape[0] - side) // 2, (shape[1] - side) // 2
    taper = np.hanning(side + 2)[1:-1]
    return (slice(top, top + side), slice(left, left + side)), np.outer(taper, taper).astype(np.float32)


@cache
def _frequencies(side: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return the squared spatial frequency (side, side) [cycles²/px²] of a transform, and the flat ring numbers."""
    frequency = np.fft.fftfreq(side)
    square = frequency[:, None] ** 2 + frequency[None] ** 2
    return square.astype(np.float32), np.rint(np.sqrt(square) * side).astype(int).ravel()


def transform(image: NDArray[np.floating], known: NDArray[np.bool_]) -> Transform:
    """Return the Fourier transform of a picture's central square, (N, N) complex64, minus the mean, also if unknown."""
    from scipy import fft

    height, width = image.shape
    where, taper = window((height, width))
    inside, here = np.asarray(image[where], np.float32), known[where] & np.isfinite(image[where])
    mean = inside[here].mean(dtype=np.float64) if here.any() else 0.0
    spectrum: Transform = fft.fft2(np.where(here, inside - np.float32(mean), np.float32(0.0)) * taper)
    return spectrum


def power(found: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (frequency [cycles/px], power [K² px²]) averaged over rings; white noise of variance σ² has density σ²."""
    side = len(found)
    taper = window((side, side))[1]
    density = np.abs(found) ** 2 / (taper.astype(np.float64) ** 2).sum()
    _, ring = _frequencies(side)
    count = np.bincount(ring)[: side // 2 + 1]
    total = np.bincount(ring, density.ravel())[: side // 2 + 1]
    return np.arange(1, side // 2 + 1) / side, (total / count)[1:]


@dataclass
class Registration:
    """Shift of pictures against others, over all poses."""

    # Sums of cross-correlations at small shifts (see `correlation`) of up to `_GROUPS` groups of poses; leaving out
    # one at a time gives the standard error
    surfaces: list[NDArray[np.float64]] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)  # Sums of their scales
    poses: int = 0

    def add(self, found: Transform, reference: Transform) -> tuple[float, float, float, float] | None:
        """Add the transforms of a pose's two pictures; return the pose's `peak`."""
        surface, scale = correlation(found, reference)
        if self.poses < _GROUPS:
            self.surfaces.append(surface)
            self.scales.append(scale)
        else:
            self.surfaces[self.poses % _GROUPS] += surface
            self.scales[self.poses % _GROUPS] += scale
        self.poses += 1
        return peak(surface, scale)

    def summary(self) -> dict[str, Any] | None:
        """Return {"right_px", "down_px", "error_px", "correlation", "unshifted"} of the peak, or None without one.

        Errors are by the delete-a-group jackknife, None for a single pose; "unshifted" is the correlation without a
        shift.
        """
        if not self.poses:
            return None
        total, scale = np.sum(self.surfaces, axis=0), sum(self.scales)
        found = peak(total, scale)
        if found is None:
            return None
        right, down, height, unshifted = found
        error = None
        if len(self.surfaces) > 1:
            left_out = [peak(total - one, scale - own) for one, own in zip(self.surfaces, self.scales, strict=True)]
            places = np.array([each[:2] for each in left_out if each is not None])
            error = np.sqrt((len(places) - 1) * places.var(axis=0)).tolist() if len(places) > 1 else None
        return {"right_px": right, "down_px": down, "error_px": error, "correlation": height, "unshifted": unshifted}


# Mirrored pictures by name: the axes that are reversed.
MIRRORED: dict[str, tuple[int, ...]] = {"upside down": (0,), "left to right": (1,), "by half a turn": (0, 1)}


def mirrored(found: Transform, name: str) -> Transform:
    """Return the transform of the mirrored picture, up to a shift by a pixel."""
    axes = MIRRORED[name]
    return np.roll(np.flip(found, axes), (1,) * len(axes), axes)


def _edges(image: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the clipped gradient magnitude of a picture, (H, W) float32; 0 at unknown pixels and beside them."""
    import cv2

    here = known & np.isfinite(image)
    filled = np.where(here, image, np.float32(np.median(image[here]) if here.any() else 0.0)).astype(np.float32)
    across, down = (cv2.Sobel(filled, cv2.CV_32F, dx, 1 - dx) for dx in (1, 0))
    inside = cv2.erode(here.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    found: NDArray[np.float32] = np.where(inside, np.hypot(across, down), np.float32(0.0))
    most = np.percentile(found[inside], 95) if inside.any() else 0.0
    return np.minimum(found, np.float32(most))


def same_edges(image: NDArray[np.floating], others: Sequence[NDArray[np.floating]], known: NDArray[np.bool_]) -> float:
    """Return how far the edges of a picture coincide with those of the best of other pictures of the same pose.

    It is the largest correlation of edges within 2 px, in standard deviations of that at other shifts.
    """
    own = transform(_edges(image, known), known)
    found = []
    for other in others:
        surface, _ = correlation(own, transform(_edges(other, known), known))
        most = len(surface) // 2
        shift = np.hypot(*np.ogrid[-most : most + 1, -most : most + 1])
        spread = float(surface[shift > _FINE_PX].std())
        found.append(float(surface[shift <= _NEAR_PX].max()) / spread if spread > 0.0 else 0.0)
    return max(found, default=0.0)


@dataclass
class Likeness:
    """Whether pictures that do not correlate with the reference are mirrored, or show the same edges."""

    # Shifts of the mirrored pictures against the reference, by `MIRRORED`
    mirrored: dict[str, Registration] = field(default_factory=dict)
    edges: list[float] = field(default_factory=list)  # `same_edges` of each pose

    def add(
        self,
        found: Transform,
        reference: Transform,
        image: NDArray[np.floating],
        others: Sequence[NDArray[np.floating]],
        known: NDArray[np.bool_],
    ) -> None:
        """Add a pose: the transforms of its two pictures, its picture, and others of the same pose."""
        for name in MIRRORED:
            self.mirrored.setdefault(name, Registration()).add(mirrored(found, name), reference)
        self.edges.append(same_edges(image, others, known))

    def summary(self) -> dict[str, Any]:
        """Return {"mirrored": {name: correlation}, "edges": median or None}."""
        heights = {name: each.summary() for name, each in self.mirrored.items()}
        return {"mirrored": {name: each["correlation"] for name, each in heights.items() if each},
                "edges": float(np.median(self.edges)) if self.edges else None}  # fmt: skip


@dataclass
class Appearance:
    """Spectrum and shift of a method, over all poses."""

    # power, frequency: Sum over poses of the power [K² px²] at each frequency [cycles/px]
    power: NDArray[np.float64] | None = None
    frequency: NDArray[np.float64] | None = None
    poses: int = 0
    registration: Registration = field(default_factory=Registration)  # Against the reference

    def add(self, found: Transform, reference: Transform) -> tuple[float, float, float, float] | None:
        """Add the transform of a pose, and its correlation with that of the reference; return the pose's `peak`."""
        self.frequency, density = power(found)
        self.power = density if self.power is None else self.power + density
        self.poses += 1
        return self.registration.add(found, reference)

    def summary(self) -> dict[str, Any]:
        """Return {"shift", "spectrum"} as plain numbers, the spectrum in 24 steps."""
        spectrum = None
        if self.power is not None and self.frequency is not None:
            edges = np.geomspace(self.frequency[0], 0.5, 25)
            step = np.clip(np.digitize(self.frequency, edges) - 1, 0, 23)
            rows = [(self.frequency[step == k].mean(), self.power[step == k].mean() / self.poses)
                    for k in range(24) if (step == k).any()]  # fmt: skip
            spectrum = {"cycles_per_px": [float(f) for f, _ in rows], "k2_px2": [float(p) for _, p in rows]}
        return {"shift": self.registration.summary(), "spectrum": spectrum}


def correlation(found: Transform, reference: Transform) -> tuple[NDArray[np.float64], float]:
    """Return (cross-correlation (2 n + 1, 2 n + 1) at shifts of −n…n pixels down and right, n ≤ 48, its scale).

    Both pictures are high-pass filtered; the coefficient is the value over the scale.
    """
    from scipy import fft

    side = len(found)
    square, _ = _frequencies(side)
    high = 1.0 - np.exp(np.float32(-2.0 * (np.pi * _FINE_PX) ** 2) * square)
    one, other = found * high, reference * high
    surface = fft.ifft2(one * np.conj(other)).real
    most = max(1, min(_MOST_SHIFT, side // 4))
    shifts = np.arange(-most, most + 1)
    scale = np.sqrt((np.abs(one) ** 2).sum() * (np.abs(other) ** 2).sum())
    # The copy lets the whole surface be freed.
    return surface[np.ix_(shifts, shifts)].astype(np.float64), float(scale) / (side * side)


def peak(surface: NDArray[np.float64], scale: float) -> tuple[float, float, float, float] | None:
    """Return (right [px], down [px], correlation, correlation without a shift) of the largest absolute correlation.

    Parabolas through the peak give fractions of a pixel; None at the border of the search.
    """
    if not scale > 0.0:
        return None
    surface, most = surface / scale, len(surface) // 2
    row, column = np.unravel_index(np.argmax(np.abs(surface)), surface.shape)
    if not (0 < row < 2 * most and 0 < column < 2 * most):
        return None
    height = surface[row, column]
    signed = np.sign(height) * surface

    def vertex(before: float, here: float, after: float) -> float:
        bend = before - 2.0 * here + after
        return 0.5 * (before - after) / bend if bend else 0.0

    right = column - most + vertex(*signed[row, column - 1 : column + 2])
    down = row - most + vertex(*signed[row - 1 : row + 2, column])
    return float(right), float(down), float(height), float(surface[most, most])


class Track:
    """Ground points of the View of one pose and their pixels in the next."""

    def __init__(self, before: View, after: View, camera: Camera) -> None:
        assert before.position is not None and after.pose is not None and after.depth is not None
        grid = np.zeros(before.known.shape, bool)
        grid[_EVERY // 2 :: _EVERY, _EVERY // 2 :: _EVERY] = True
        self._from = before.ground & grid
        points = before.position[self._from].astype(np.float64)
        local = (points - after.pose[:3, 3]) @ after.pose[:3, :3]
        pixel = camera.project(local)
        height, width = after.known.shape
        with np.errstate(invalid="ignore"):
            inside = (pixel > 1.0).all(axis=-1) & (pixel[:, 0] < width - 1.0) & (pixel[:, 1] < height - 1.0)
        row, column = (np.where(inside, pixel[:, axis], 0.0).astype(int) for axis in (1, 0))
        same = np.abs(after.depth[row, column] / np.maximum(local[:, 2], 1e-6) - 1.0) < _SAME_DEPTH
        self._kept = inside & same & after.known[row, column] & (after.object[row, column] < 0)
        self._to = pixel[self._kept] - 0.5

    def change(self, before: NDArray[np.floating], after: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the second picture's temperature of each point minus the first's, (n,) [K]."""
        from scipy.ndimage import map_coordinates

        there: NDArray[np.floating] = map_coordinates(after, self._to[:, ::-1].T, order=1)
        return there - before[self._from][self._kept]
