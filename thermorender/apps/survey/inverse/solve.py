"""The reconstruction: register the frames, then solve map, offsets, lens and poses together until they agree.

The map is in *linear kelvin*: band radiance, scaled so that it is kelvin at one reference temperature. A pixel is a
mean of radiances, so the forward model is exactly linear in it.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermorender import Camera
from thermorender.apps.survey.inverse.normal import Normal, Prior, Sums, Unknowns, footprint
from thermorender.apps.survey.inverse.poses import PoseError, deviation, explained, registered, slopes
from thermorender.apps.survey.inverse.spread import Drawn, Draws, Spread, error_of_curvature, spread_of
from thermorender.apps.survey.inverse.weights import (
    Lattice,
    Sight,
    Viewer,
    bilinear,
    binned,
    binned_camera,
    moved,
    reach_px,
    sharpened,
    softened,
    taps_of,
    texel_means,
)
from thermorender.render.light.exchange import threads

if TYPE_CHECKING:
    from thermorender import Renderer

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
Progress = Callable[[str, float], object]
_T = TypeVar("_T")
# Residuals beyond so many standard deviations lose weight.
_OUTLIER = 4.0
# Terms of the blur's inverse in a step, and frames that its width is taken from.
TERMS, _SAMPLED = 3, 5
# Error of a pose by which edges deviate without being outliers [texels].
_POSE_TEXELS = 0.5
# Relative residual of a solution in the last round, and in the others.
_TOLERANCE, _ROUGH = 1e-4, 1e-2
# Side of the squares whose mean residuals show what neighbouring pixels have in common [px].
_SQUARE_PX = 16
# Frames under way at the same time.
_UNDER_WAY = 3
# Powers of the radius of the vignetting.
_POWERS = (2, 4, 6)


@dataclass(frozen=True)
class Settings:
    """What a reconstruction assumes and how far it goes."""

    texel_m: float = 0.25  # Side of a texel of the map [m]
    taps: int = 2  # Points along a side of a pixel
    rounds: int = 4  # Joint solutions, after the registration to the prior
    # Standard deviations of the measured poses; zeros keep them
    pose_error: PoseError = field(default_factory=PoseError)
    # noise_k, offset_k, vignette_k, pattern_k, class_k, prior_k, level_k: Standard deviations of a pixel's noise, of
    # a frame's offset, of a term of the vignetting at the corner, of the fixed pattern, of a class in the prior, of a
    # texel about its class, and of the camera's common level [K]. The last is the accuracy of calibrated cameras, and
    # is stated without a reference.
    noise_k: float = 0.07
    offset_k: float = 1.0
    vignette_k: float = 2.0
    pattern_k: float = 0.2
    class_k: float = 3.0
    prior_k: float = 2.0
    level_k: float = 2.0


@dataclass(frozen=True, eq=False)
class State:
    """A reconstruction after some rounds."""

    map: Floats  # (h, w) float64 linear kelvin at the middles of the texels; between them the map is bilinear
    classes: Floats  # (C,) float64 offsets of the classes of the prior [K]
    offsets: Floats  # (F,) float64 of the frames [K]
    # (F, 2) float64 change of a frame's offset from the middle to the right and to the lower edge [K]
    tilts: Floats
    tilt_k: float  # Standard deviation of the tilts, by the residuals; 0 in the first rounds [K]
    vignette: Floats  # (V,) float64 terms of the vignetting, each with its value at the corner [K]
    pattern: Floats  # (H, W) float64 fixed pattern [K]
    poses: Floats  # (F, 4, 4) float64
    noise_k: float  # Standard deviation of the residuals of a pixel, robust [K]
    alike_px: float  # Neighbouring pixels that have one error in common, by the residuals; 1 if all are independent
    rounds: int  # Joint solutions so far


class Problem:
    """Frames, (F, H, W) float32 [linear kelvin], NaN where invalid, with poses (F, 4, 4), their error and the prior."""

    def __init__(
        self, renderer: "Renderer", camera: Camera, images: Image, poses: Floats, lattice: Lattice, prior: Prior,
        settings: Settings, error: PoseError,
    ) -> None:  # fmt: skip
        self.error = error
        self.camera, self.images, self.poses, self.prior, self.settings = camera, images, poses, prior, settings
        self.viewer = Viewer(renderer, camera, lattice)
        self.taps = taps_of(settings.taps)
        self.vignetting, self.tilting = vignetting(camera), tilting(camera)
        self.reach = self._reach_texels()
        self.free = error.position_m > 0.0 or error.angle_deg > 0.0

    def _reach_texels(self) -> float:
        """Distance of the outer taps of a pixel, in the median over some frames [texels]."""
        chosen = np.linspace(0, len(self.poses) - 1, min(_SAMPLED, len(self.poses))).astype(int)
        sights = [self.viewer.sight(self.poses[number]) for number in chosen]
        side = [np.sqrt(np.abs(s.across[0] * s.down[1] - s.across[1] * s.down[0])) for s in sights]
        known = [float(np.median(each)) for each in side if each.size]
        return reach_px(self.camera) * float(np.median(known)) if known else 0.0

    def start(self) -> State:
        """Return the State before any solution: the prior and the measured poses."""
        count, terms = len(self.images), len(self.vignetting)
        offsets = np.zeros(count)
        blank = np.zeros((self.camera.height, self.camera.width))
        return State(
            self.prior.mean.copy(), np.zeros(self.prior.count), offsets, np.zeros((count, 2)), 0.0,
            np.zeros(terms), blank, self.poses.copy(), max(1.0, self.settings.noise_k), 1.0, 0,
        )  # fmt: skip

    def predicted(self, state: State, number: int, sight: Sight) -> Floats:
        """Return the values of a frame's pixels, (N,), that a State predicts."""
        own = self._own(state, number)
        around = self.images[number] - own
        return self.viewer.imaged(sight, state.map, self.taps, around) + own.ravel()[sight.pixel]

    def register(self, state: State, progress: Progress | None = None) -> State:
        """Return a State with each frame registered, by images of about 160 pixels a row.

        At first, the target is the part of the frames that prior and orthophoto explain, since the prior may lack the
        day's contrasts; later it is the round's map. Badly registered frames have little weight in the joint solution
        and would follow slowly.
        """
        if not self.free:
            return state
        factor, begins = max(1, round(self.camera.width / 160)), state.rounds == 0
        camera, error = binned_camera(self.camera, factor), self.error
        viewer = Viewer(self.viewer.renderer, camera, self.viewer.lattice)
        images = [
            binned(image if begins else image - self._own(state, number), factor).astype(np.float32)
            for number, image in enumerate(self.images)
        ]
        values = state.map
        if begins:
            values = explained(viewer, images, state.poses, self._features(values), vignetting(camera), error)

        def found(number: int) -> Floats:
            given = images[number], state.poses[number], self.poses[number]
            return registered(viewer, values, *given, error, search=begins)

        poses = state.poses.copy()
        for number, pose in enumerate(_ahead(found, len(poses))):
            poses[number] = pose
            if progress is not None:
                progress("registering the frames", (number + 1) / len(poses))
        return replace(state, poses=poses)

    def _own(self, state: State, number: int) -> Floats:
        """What a frame shows besides the map, (H, W): its offset and tilts, vignetting and fixed pattern."""
        own = state.offsets[number] + state.tilts[number] @ self.tilting
        own += state.vignette @ self.vignetting + state.pattern.ravel()
        return np.asarray(own.reshape(state.pattern.shape))

    def _features(self, values: Floats) -> Floats:
        """A map and the orthophoto's colours with their products, (K, h, w)."""
        colour = self.viewer.renderer.scene.surfaces[0].colour
        red, green, blue = (self.viewer.lattice.of_scene(colour[..., band] / 255.0) for band in range(3))
        return np.array([
            values, red, green, blue, red * red, green * green, blue * blue, red * green, red * blue, green * blue,
        ])  # fmt: skip

    def round(self, state: State, free: bool | None = None, progress: Progress | None = None) -> State:
        """Return the State after one joint solution of map, offsets, vignetting, classes and, if `free`, poses."""
        return self._round(state, self.free if free is None else free, progress)[0]

    def last_round(self, state: State, progress: Progress | None = None) -> tuple[State, Spread]:
        """Return the State after one more joint solution, and its standard deviations."""
        settings = self.settings
        # Frames average their noise in the pattern.
        known = np.isfinite(self.images).sum(axis=0).ravel() / max(state.noise_k, settings.noise_k) ** 2
        left = np.sqrt(1.0 / (known + 1.0 / settings.pattern_k**2)) if settings.pattern_k > 0.0 else 0.0 * known
        draws = Draws(self.prior, len(self.vignetting), 1.0 / settings.offset_k**2, left)
        state, normal = self._round(state, self.free, progress, draws)
        side, terms = self.viewer.lattice.scene_texels, TERMS * state.rounds
        share = error_of_curvature(self.camera, self.reach / reach_px(self.camera), side)
        means = texel_means(state.map, side)
        return state, spread_of(normal, draws, means, self.reach, terms, side, settings.noise_k, share)

    def _round(
        self, state: State, free: bool, progress: Progress | None, draws: Draws | None = None
    ) -> tuple[State, Normal]:
        settings = self.settings
        normal, left, weights, noise_k, alike_px, pattern = self._equations(state, free, progress, draws)
        gradient = normal.gradient(state.map - self.prior.mean, state.classes, state.vignette)
        with threads() as pool:
            # Later rounds go on with what the first leave.
            found, _ = normal.solved(gradient, _TOLERANCE if draws is not None else _ROUGH, each=pool.map)
        made = self._updated(state, found, free, pattern)
        # The first round has the poses of the registration, of which the errors look like tilts.
        square = np.sum(weights * (state.tilts + left) ** 2) / max(float(weights.sum()), 1e-300)
        tilt_k = float(np.sqrt(square)) if state.rounds > 0 else 0.0
        made = replace(made, noise_k=max(noise_k, settings.noise_k), alike_px=alike_px, tilt_k=tilt_k)
        if tilt_k < settings.noise_k:
            # Below the noise, tilts would only share in what the offsets hold.
            made = replace(made, tilts=np.zeros_like(state.tilts), tilt_k=0.0)
        return made, normal

    def _equations(
        self, state: State, free: bool, progress: Progress | None, draws: Draws | None = None
    ) -> tuple[Normal, Floats, Floats, float, float, "Common | None"]:  # fmt: skip
        """(Normal, tilts of the residuals (F, 2), their weights, their standard deviation, pixels alike, Common)."""
        settings, pattern = self.settings, None
        tilted = [1.0 / state.tilt_k**2] * 2 if state.tilt_k > 0.0 else []
        # What pixels have in common, such as a change of the ground between passes, would move poses as if each of them
        # had seen it independently.
        poses = [state.alike_px * self.error.precision] if free else []
        own = np.concatenate([[1.0 / settings.offset_k**2], tilted, *poses])
        terms = np.full(len(self.vignetting), 1.0 / settings.vignette_k**2)
        normal = Normal(self.prior, own, terms)
        if settings.pattern_k > 0.0 and state.rounds > 0:
            sizes = len(self.images), state.pattern.size, max(state.map.shape)
            pattern = Common(*sizes, settings.noise_k, settings.pattern_k)
        # The blur has its part in how an image changes with the pose: slopes of the map alone halve the steps.
        right, down = slopes(softened(state.map, self.reach))
        slope = np.hypot(*slopes(state.map))

        def summed(number: int) -> "_Summed":
            sight, residual, precision, clear, spread = self._measured(state, number, slope)
            plane = np.concatenate([np.ones((1, residual.size)), self.tilting[:, sight.pixel]])
            columns = plane if tilted else plane[:1]
            if free:
                columns = np.concatenate([columns, sight.motion(sight.at(right), sight.at(down))])
            given = residual, precision, columns, self.vignetting[:, sight.pixel]
            seen = footprint(sight)
            drawn = draws.of_frame(number, seen, sight.pixel, *given) if draws is not None else None
            pixels, tilt = (sight, residual, precision), tilt_of(plane, residual, precision)
            alike_px = correlated_pixels(state.pattern.shape, *pixels)
            return _Summed(Sums.of(seen, *given), drawn, tilt, spread, alike_px, (sight, residual, clear))

        spreads, alike, found = list[float](), list[float](), list[Floats]()
        for number, (sums, drawn, tilt, spread, alike_px, pixels) in enumerate(_ahead(summed, len(self.images))):
            spreads.append(spread)
            alike.append(alike_px)
            found.append(tilt)
            away = np.array([state.offsets[number], *(state.tilts[number] if tilted else ())])
            if free:
                away = np.concatenate([away, deviation(state.poses[number], self.poses[number])])
            normal.add(sums, away)
            if draws is not None and drawn is not None:
                draws.add(number, drawn, sums)
            if pattern is not None:
                pattern.add(number, *pixels)
            if progress is not None:
                progress("solving the map", (number + 1) / (len(self.images) + 1))
        tilts, weights = np.array(found).transpose(1, 0, 2)
        return normal, tilts, weights, float(np.median(spreads)), float(np.median(alike)), pattern

    def _measured(self, state: State, number: int, slope: Floats) -> tuple[Sight, Floats, Floats, Floats, float]:
        """Return (pixels, residuals, their precisions 1/σ², those for the pattern, standard deviation) of a frame.

        `slope` (h, w) is that of the state's map.
        """
        sight = self.viewer.sight(state.poses[number])
        measured = self.images[number].ravel()[sight.pixel].astype(np.float64)
        residual = measured - self.predicted(state, number, sight)
        known = np.isfinite(residual)
        if not known.all():
            sight, residual = sight.chosen(known), residual[known]
        steep = sight.at(slope)
        level = float(np.median(residual)) if residual.size else 0.0
        precision, spread = _precision(residual - level, steep, state.noise_k, self.settings.noise_k)
        # Where the map is steep, errors of the pose would become ghosts in the pattern.
        clear = precision / (1.0 + (_POSE_TEXELS * steep / max(spread, self.settings.noise_k)) ** 2)
        return sight, residual, precision, clear, spread

    def _updated(self, state: State, found: Unknowns, free: bool, pattern: "Common | None") -> State:
        poses, tilts = state.poses, state.tilts
        if state.tilt_k > 0.0:
            tilts = tilts + found.frames[:, 1:3]
        if free:
            poses = np.array([moved(pose, step[-6:]) for pose, step in zip(poses, found.frames, strict=True)])
        made = state.pattern
        if pattern is not None:
            common = np.broadcast_to(found.common, (len(poses), len(found.common)))
            own = np.concatenate([found.frames[:, :1], tilts - state.tilts, common], axis=1)
            terms = np.concatenate([np.ones((1, made.size)), self.tilting, self.vignetting])
            made = _without(made + pattern.left(found.map, own, terms).reshape(made.shape), self.vignetting)
        return replace(
            state, map=state.map + sharpened(found.map, self.reach, TERMS), classes=state.classes + found.classes,
            offsets=state.offsets + found.frames[:, 0], tilts=tilts, vignette=state.vignette + found.common,
            pattern=made, poses=poses, rounds=state.rounds + 1,
        )  # fmt: skip


class _Summed(NamedTuple):
    """What a frame adds to the equations, and what its residuals show."""

    sums: Sums
    drawn: Drawn | None
    tilt: Floats
    spread_k: float
    alike_px: float
    pixels: tuple[Sight, Floats, Floats]


class Common:
    """The residuals that all frames share after a step of the map: the change of the fixed pattern.

    Without it, map and pattern would alternate where frames stand on a grid. Map positions are kept, at 6 bytes a
    pixel, to 1/65535 of the map's longer side.
    """

    def __init__(self, frames: int, pixels: int, longest: int, noise_k: float, pattern_k: float) -> None:
        self._row, self._column = np.zeros((2, frames, pixels), np.uint16)
        # Of the precision of a pixel without misfit.
        self._share = np.zeros((frames, pixels), np.float16)
        self._unit, self._best = longest / 65535.0, 1.0 / noise_k**2
        self._pull, self._total = np.zeros(pixels), np.full(pixels, 1.0 / pattern_k**2)

    def add(self, number: int, sight: Sight, residual: Floats, precision: Floats) -> None:
        """Add a frame with the residuals (N,) of its pixels and 1 over their variances."""
        at = sight.pixel
        self._row[number, at], self._column[number, at] = (
            np.rint(place / self._unit) for place in (sight.row, sight.column)
        )
        self._share[number, at] = precision / self._best
        self._pull[at] += precision * residual
        self._total[at] += precision

    def left(self, step: Floats, own: Floats, terms: Floats) -> Floats:
        """Return the common part (pixels,) after a step of the map, (h, w), and one of each frame, `own @ terms`.

        `own` (F, K) are changes of the frames by the terms (K, pixels). Without them, the pattern would compensate the
        map's change: by 1 K where frames tilt.
        """

        def taken(number: int) -> Floats:
            row, column = (self._unit * each[number] for each in (self._row, self._column))
            return np.asarray((bilinear(step, row, column) + own[number] @ terms) * self._share[number] * self._best)

        taking = np.zeros_like(self._pull)
        for values in _ahead(taken, len(self._row)):
            taking += values
        return (self._pull - taking) / self._total


def tilt_of(plane: Floats, residual: Floats, precision: Floats) -> Floats:
    """Return (tilts to the right and down, their weights), (2, 2), of residuals (N,) by the columns 1, right, down.

    The weights are small if only a strip of the frame shows the terrain.
    """
    matrix = (plane * precision) @ plane.T
    found, *_ = np.linalg.lstsq(matrix, (plane * precision) @ residual, rcond=None)
    known = matrix.diagonal()[1:] - matrix[0, 1:] ** 2 / max(float(matrix[0, 0]), 1e-300)
    return np.array([found[1:], np.maximum(known, 0.0)])


def correlated_pixels(shape: tuple[int, int], sight: Sight, residual: Floats, precision: Floats) -> float:
    """Neighbouring pixels that have one error in common, 1 … `_SQUARE_PX`²: by means over squares of residuals (N,)."""
    if not residual.size:
        return 1.0
    image = np.full(shape, np.nan)
    # Outliers have less weight.
    image.ravel()[sight.pixel] = (residual - np.median(residual)) * np.sqrt(precision)
    means = binned(image, _SQUARE_PX)
    known = np.isfinite(means)
    if np.count_nonzero(known) < 2:
        return 1.0
    return max(1.0, _SQUARE_PX**2 * float(means[known].var() / max(np.nanvar(image), 1e-300)))


def _ahead(job: Callable[[int], _T], count: int) -> Iterator[_T]:
    """Yield the results of a job for 0…count−1 in order, with the next ones under way in threads."""
    with threads() as pool:
        coming = deque(pool.submit(job, number) for number in range(min(_UNDER_WAY, count)))
        for number in range(_UNDER_WAY, count + _UNDER_WAY):
            if not coming:
                return
            result = coming.popleft().result()
            if number < count:
                coming.append(pool.submit(job, number))
            yield result


def _precision(residual: Floats, steep: Floats, before_k: float, least_k: float) -> tuple[Floats, float]:
    """(1 over the variance of each pixel, standard deviation of the residuals), with less weight for outliers."""
    if not residual.size:
        return residual, least_k
    spread = float(np.median(np.abs(residual))) / 0.6745
    scale = max(min(spread, before_k), least_k)
    # At edges a small error of the pose makes a large residual, which is no outlier.
    allowed = np.hypot(scale, _POSE_TEXELS * steep)
    weight = 1.0 / np.maximum(1.0, np.abs(residual) / (_OUTLIER * allowed)) ** 2
    return weight / scale**2, spread


def vignetting(camera: Camera) -> Floats:
    """Return powers of the distance from the principal point, (V, H·W), 1 at the farthest corner and with mean 0."""
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    middle = camera.width / 2 + camera.principal_offset_px[0], camera.height / 2 + camera.principal_offset_px[1]
    radius = np.hypot(column - middle[0], row - middle[1]).ravel()
    terms = np.array([(radius / radius.max()) ** power for power in _POWERS])
    return terms - terms.mean(axis=1, keepdims=True)


def tilting(camera: Camera) -> Floats:
    """Return the distance from the middle to the right and down, (2, H·W), 1 at the edges."""
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.array([2.0 * column.ravel() / camera.width - 1.0, 2.0 * row.ravel() / camera.height - 1.0])


def _without(image: Floats, terms: Floats) -> Floats:
    """An image without its mean and the terms of the vignetting."""
    basis = np.concatenate([np.ones((1, image.size)), terms])
    fit, *_ = np.linalg.lstsq(basis.T, image.ravel(), rcond=None)
    return (image.ravel() - fit @ basis).reshape(image.shape)
