"""Bundle adjustment of frames: poses, lens and heights of the ground together, from matches between the frames.

Brown's k1 and k2, focal length and principal point belong to all frames. Each node of the matches has its own height
about the ground, which is eliminated from the equations: distortion moves with the image, relief stays on the ground,
so both are told apart. Source: Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment — a modern synthesis,
2000, doi:10.1007/3-540-44480-7_21.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from thermorender import Camera
from thermorender.apps.survey.inverse.matches import Matches, View, detailed, matched
from thermorender.apps.survey.inverse.poses import PoseError
from thermorender.apps.survey.inverse.relief import Relief
from thermorender.errors import ThermorenderError
from thermorender.sensor.camera import edge_directions

Floats = NDArray[np.float64]
Progress = Callable[[str, float], object]
# Standard deviations of a nominal lens: focal length [share], principal point [share of the width], k1, k2.
_FOCAL, _POINT, _DISTORTION = 0.05, 0.02, (0.5, 0.5)
# A lens that is so many of them away is none.
_UNLIKELY = 5.0
# Fewer nodes fix no poses, and fewer no lens.
_FEWEST, _FEW = 25, 100
# Standard deviation of the place of a match before the residuals tell it [px].
_MATCH_PX = 0.3
# Residuals beyond so many standard deviations lose weight; so do stated positions and angles.
_OUTLIER, _MISSTATED = 3.0, 3.0
# Most steps of a solution, and change in standard deviations at which it ends.
_STEPS, _SETTLED = 25, 0.1
# Distance over which slopes are taken [m], and steps of the lens: pixels, then k1 and k2.
_SPAN_M, _LENS_STEPS = 0.2, np.array([0.1, 0.1, 0.1, 1e-4, 1e-4])
# Reach of the first search and of the later ones [cells], and standard deviations of the poses that the first covers.
_WIDE, _NARROW, _SIGMAS = 14, 6, 4.0
# Fewer matches than this per frame do not hold its pose.
_LEAST_MATCHES = 8


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Frames after a bundle adjustment.

    Attributes
    ----------
    camera : Camera
        With the lens that fits the frames.
    lens_std : (5,) float64
        Standard deviations of focal length [px], principal point [px] right and down, k1 and k2; zeros for a lens that
        is kept.
    poses : (F, 4, 4) float64
    pose_std : (2,) float64
        Of position [m] and angle [rad], each along an axis, in the median over frames and against the stated poses.
    residual_px : float
        Standard deviation of a match along an axis, robust.
    ground : Relief
        The ground that the nodes stand on: that which was assumed, or the relief of the matches before the last.
    nodes : (K, 2) float64
        East and north of points of the ground [m].
    heights, height_std : (K,) float64
        Their heights above `ground`, and standard deviations [m].
    held : (F,) bool
        Frames with enough matches.
    doubt : str
        Why the lens was kept although it was to be fitted, as a sentence; else empty.
    """

    camera: Camera
    lens_std: Floats
    poses: Floats
    pose_std: Floats
    residual_px: float
    ground: Relief
    nodes: Floats
    heights: Floats
    height_std: Floats
    held: NDArray[np.bool_]
    doubt: str = ""

    @property
    def relief(self) -> Relief:
        """The ground with the heights of the nodes."""
        return Relief.of(self.nodes, self.heights, self.height_std, self.ground)


def adjusted(
    kelvin: NDArray[np.float32], camera: Camera, poses: Floats, error: PoseError, ground: Relief, height_m: float,
    fit_lens: bool = True, fit_ground: bool = False, progress: Progress | None = None,
) -> Adjusted:  # fmt: skip
    """Return the Adjusted of frames.

    Parameters
    ----------
    kelvin : (F, H, W) float32
    camera : Camera
        Nominal, or with its own lens where `fit_lens` is False.
    poses : (F, 4, 4) float64
        As measured.
    error : PoseError
        Of the measured poses.
    ground : Relief
        The ground that is assumed.
    height_m : float
        Standard deviation of its level [m]; single nodes are free about it.
    fit_lens, fit_ground : bool
        Whether the lens, and the ground between the nodes, follow the matches.

    Raises
    ------
    ThermorenderError
        Too few matches, or a lens that folds the image.
    """
    images = detailed(kelvin)
    view = View(camera, poses, ground)
    finest = view.cell_m()
    above = poses[:, 2, 3] - ground(poses[:, 0, 3], poses[:, 1, 3])
    height = float(np.nanmedian(above)) if np.isfinite(above).any() else finest * camera.focal_length_px
    away = _SIGMAS * np.hypot(error.position_m, np.radians(error.angle_deg) * height)
    levels = max(int(np.ceil(np.log2(max(away / (_WIDE * finest), 1.0)))), 1)
    found: Adjusted | None = None
    doubt = ""
    for level in range(levels, -2, -1):
        # The finest twice: its matches depend on the lens a little.
        cell, reach = finest * 2.0 ** max(level, 0), _WIDE if level == levels else _NARROW
        share = (levels - level) / (levels + 2)
        matches = matched(images, view, cell, reach, _scaled(progress, share, 1.0 / (levels + 2)))
        shown = len(np.unique(matches.node))
        if shown < _FEWEST:
            raise ThermorenderError(f"{shown} points of the ground are shown by two frames, fewer than {_FEWEST}")
        if fit_lens and shown < _FEW:
            fit_lens, doubt = False, f"{shown} points that two frames show are too few to fit it"
        found = _solved(matches, view, ground, camera, poses, error, height_m, fit_lens)
        if fit_lens and (doubt := _unlikely(found.camera, camera)):
            fit_lens = False
            view = View(camera, view.poses, ground)
            found = _solved(matches, view, ground, camera, poses, error, height_m, fit_lens)
        if fit_ground and level >= 0:
            ground = found.relief
        view = View(found.camera, found.poses, ground)
    assert found is not None
    return replace(found, doubt=doubt)


def arrays_of(found: Adjusted) -> dict[str, NDArray[np.generic]]:
    """Return an Adjusted as named arrays, for `adjusted_from`."""
    ground = found.ground
    place = np.array([ground.west, ground.south, ground.step_m])
    own = {"lens": lens_of(found.camera), "place": place, "up": ground.up}
    kept = ("lens_std", "poses", "pose_std", "residual_px", "nodes", "heights", "height_std", "held", "doubt")
    return own | {name: np.asarray(getattr(found, name)) for name in kept}


def adjusted_from(arrays: Mapping[str, NDArray[np.generic]], camera: Camera) -> Adjusted:
    """Return the Adjusted of `arrays_of` for frames of a nominal camera."""
    own: dict[str, Any] = dict(arrays)
    lens, place, up = (own.pop(name) for name in ("lens", "place", "up"))
    west, south, step_m = (float(value) for value in place)
    ground = Relief(west, south, step_m, up)
    residual_px, doubt = float(own.pop("residual_px")), str(own.pop("doubt"))
    return Adjusted(
        with_lens(camera, lens - lens_of(camera)), residual_px=residual_px, ground=ground, doubt=doubt, **own
    )


def _scaled(progress: Progress | None, start: float, share: float) -> Progress | None:
    if progress is None:
        return None
    report = progress
    return lambda what, done: report(what, start + share * done)


class _Equations:
    """The linearised problem of one set of matches: what moves a residual, and the weights."""

    def __init__(self, matches: Matches, frames: int, lens: bool) -> None:
        self.matches, self.frames, self.lens = matches, frames, lens
        first, second, node = matches.first, matches.second, matches.node
        seen = np.zeros((len(matches.nodes), frames), bool)
        seen[node, first] = seen[node, second] = True
        number = np.bincount(node, minlength=len(seen))
        # A node in n frames has n(n−1)/2 matches of which n−1 are independent.
        self.share = ((seen.sum(axis=1) - 1) / np.maximum(number, 1))[node] / matches.alike
        poses = [6 * each[:, None] + np.arange(6) for each in (first, second)]
        common = np.broadcast_to(6 * frames + np.arange(5), (len(first), 5))
        # The parameters (N, 12 or 17) that each match depends on.
        self.at = np.concatenate([*poses, common] if lens else poses, axis=1)
        self.size = 6 * frames + (5 if lens else 0)

    def linearised(self, view: View) -> tuple[Floats, Floats, Floats]:
        """Return (misses (N, 2) [px], their changes with the parameters (N, 2, 12 or 17), with the height (N, 2)).

        A miss is where the second frame should show a node minus where it does.
        """
        matches, ground = self.matches, view.ground
        point, way = view.cast(matches.first, matches.first_px)
        there = view.in_frame(matches.second, point)
        # The plane of the ground at each point, by its normal with an upward part of 1.
        east, north = (point[:, axis] for axis in (0, 1))
        slope = [(ground(east + a, north + b) - ground(east - a, north - b)) / _SPAN_M
                 for a, b in ((0.5 * _SPAN_M, 0.0), (0.0, 0.5 * _SPAN_M))]  # fmt: skip
        normal = np.nan_to_num(np.stack([-slope[0], -slope[1], np.ones(len(point))], axis=1))
        facing = np.einsum("ni,ni->n", normal, way)
        # Changes of the point on that plane with a motion of its ray's start or end.
        free = np.eye(3) - way[:, :, None] * normal[:, None, :] / facing[:, None, None]
        depth = np.einsum("ni,ni->n", normal, point - view.poses[matches.first, :3, 3]) / facing
        by_point = np.stack([
            (view.in_frame(matches.second, point + step) - view.in_frame(matches.second, point - step)) / _SPAN_M
            for step in 0.5 * _SPAN_M * np.eye(3)
        ], axis=2)  # fmt: skip
        moves = by_point @ free
        arm = point - view.poses[matches.second, :3, 3]
        parts = [moves, -moves @ _crossed(depth[:, None] * way), -by_point, by_point @ _crossed(arm)]
        if self.lens:
            parts.append(np.stack([
                (_there(replace(view, camera=with_lens(view.camera, change)), matches) - there) / step
                for step, change in zip(_LENS_STEPS, np.diag(_LENS_STEPS), strict=True)
            ], axis=2))  # fmt: skip
        # A higher ground is met earlier on the ray.
        lift = by_point @ (way / facing[:, None])[:, :, None]
        return there - matches.second_px, np.concatenate(parts, axis=2), lift[:, :, 0]

    def jacobian(self, slope: Floats) -> csr_matrix:
        """Return the changes (N, 2, 12 or 17) as a sparse matrix, (2 N, parameters)."""
        width = self.at.shape[1]
        columns = np.repeat(self.at, 2, axis=0).ravel()
        ends = np.arange(0, columns.size + 1, width)
        return csr_matrix((slope.ravel(), columns, ends), shape=(len(ends) - 1, self.size))


def _there(view: View, matches: Matches) -> Floats:
    """Where second frames show the points of first ones, (N, 2) [px]."""
    return view.in_frame(matches.second, view.on_ground(matches.first, matches.first_px))


def _crossed(vector: Floats) -> Floats:
    """The matrices (N, 3, 3) of the cross products v × …."""
    x, y, z = vector.T
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)


def with_lens(camera: Camera, change: Floats) -> Camera:
    """Return a Camera with focal length [px], principal point [px], k1 and k2 changed by (5,)."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = camera.principal_offset_px
    focal = (camera.focal_length_px + change[0]) * camera.pixel_pitch_um * 1e-3
    return replace(
        camera, focal_length_mm=float(focal), principal_offset_px=(float(x + change[1]), float(y + change[2])),
        distortion=(float(k1 + change[3]), float(k2 + change[4]), p1, p2, k3),
    )  # fmt: skip


def lens_of(camera: Camera) -> Floats:
    """Return focal length [px], principal point [px], k1 and k2 of a Camera, (5,)."""
    return np.array([camera.focal_length_px, *camera.principal_offset_px, *camera.distortion[:2]])


def _lens_std(nominal: Camera) -> Floats:
    """Standard deviations of a nominal lens, (5,)."""
    point = _POINT * nominal.width
    return np.array([_FOCAL * nominal.focal_length_px, point, point, *_DISTORTION])


def _solved(
    matches: Matches, view: View, ground: Relief, nominal: Camera, measured: Floats, error: PoseError, height_m: float,
    fit_lens: bool,
) -> Adjusted:  # fmt: skip
    """Gauss–Newton steps from a View to the Adjusted of its matches."""
    frames = len(measured)
    number = np.bincount(np.concatenate([matches.first, matches.second]), minlength=frames)
    view, covariance, residual, heights, height_std = _settled(
        matches, view, nominal, measured, error, height_m, fit_lens
    )
    parameters = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    own = parameters[: 6 * frames].reshape(frames, 6)
    pose_std = np.array([np.median(own[:, :3]), np.median(own[:, 3:])])
    return Adjusted(
        view.camera, parameters[6 * frames :] if fit_lens else np.zeros(5), view.poses, pose_std, residual,
        ground, matches.nodes, heights, height_std, number >= _LEAST_MATCHES,
    )  # fmt: skip


def _settled(
    matches: Matches, view: View, nominal: Camera, measured: Floats, error: PoseError, height_m: float, fit_lens: bool
) -> tuple[View, Floats, float, Floats, Floats]:  # fmt: skip
    """(View, covariance of the parameters, standard deviation of a match [px], heights (K,), their σ (K,))."""
    frames, size = len(measured), len(matches.nodes)
    equations, node = _Equations(matches, frames, fit_lens), matches.node
    own_poses = slice(6 * frames)
    lens_precision = 1.0 / _lens_std(nominal) ** 2
    heights, sigma = np.zeros(size), _MATCH_PX
    # All nodes together know the level once: as independent heights they would fix it, and the slope, to centimetres.
    loose = 1.0 / (height_m**2 * max(len(np.unique(node)), 1))
    floor = np.maximum(error.precision, 1e-12)
    for number in range(_STEPS):
        miss, slope, lift = equations.linearised(view)
        known = np.isfinite(miss).all(axis=1) & np.isfinite(slope).all(axis=(1, 2)) & np.isfinite(lift).all(axis=1)
        miss, slope, lift = (np.where(known.reshape(-1, *(1,) * (each.ndim - 1)), each, 0.0)
                             for each in (miss, slope, lift))  # fmt: skip
        rest = miss + heights[node, None] * lift
        away = np.linalg.norm(rest, axis=1)
        # The median of a Rayleigh distribution.
        sigma = max(float(np.median(away[known])) / 1.1774, 1e-3) if known.any() else _MATCH_PX
        weight = known * equations.share / (1.0 + (away / (_OUTLIER * sigma)) ** 2) / sigma**2
        own = np.bincount(node, weight * (lift**2).sum(axis=1), size) + loose
        pull_height = -np.bincount(node, weight * (lift * rest).sum(axis=1), size) - loose * heights
        if number == 0:
            # Relief alone first: poses would otherwise follow it.
            heights = heights + pull_height / own
            continue
        jacobian = equations.jacobian(slope)
        weighted = jacobian.multiply(np.repeat(weight, 2)[:, None]).tocsr()
        lifts = csr_matrix((lift.ravel(), np.repeat(node, 2), np.arange(2 * len(node) + 1)), (2 * len(node), size))
        matrix, cross = (weighted.T @ jacobian).toarray(), (weighted.T @ lifts).tocsr()
        pull = -(weighted.T @ rest.ravel())
        step = deviations(view.poses, measured)
        prior = _prior(step, floor)
        matrix[np.diag_indices(6 * frames)] += prior.ravel()
        pull[own_poses] -= (prior * step).ravel()
        if fit_lens:
            here = range(6 * frames, equations.size)
            matrix[here, here] += lens_precision
            pull[6 * frames :] -= lens_precision * (lens_of(view.camera) - lens_of(nominal))
        taken = cross.multiply(1.0 / own[None, :]).tocsr()
        reduced = matrix - (taken @ cross.T).toarray()
        change = np.linalg.solve(reduced, pull - taken @ pull_height)
        heights = heights + (pull_height - cross.T @ change) / own
        poses = moved_all(view.poses, change[own_poses].reshape(-1, 6))
        camera = _open(with_lens(view.camera, change[6 * frames :])) if fit_lens else view.camera
        view = View(camera, poses, view.ground)
        if np.sqrt(np.mean(change**2 * reduced.diagonal())) < _SETTLED:
            break
    covariance = np.linalg.inv(reduced)
    spread = 1.0 / own + np.asarray(taken.multiply(covariance @ taken.toarray()).sum(axis=0)).ravel()
    seen = np.bincount(node, weight > 0.0, size) > 0
    return view, covariance, sigma, np.where(seen, heights, np.nan), np.sqrt(spread)


def moved_all(poses: Floats, steps: Floats) -> Floats:
    """Return poses (F, 4, 4) after steps (F, 6), each as of `moved`."""
    found = poses.copy()
    found[:, :3, 3] += steps[:, :3]
    found[:, :3, :3] = Rotation.from_rotvec(steps[:, 3:]).as_matrix() @ poses[:, :3, :3]
    return found


def deviations(poses: Floats, measured: Floats) -> Floats:
    """Return the steps (F, 6) from measured poses to others, each as of `deviation`."""
    turn = Rotation.from_matrix(poses[:, :3, :3] @ measured[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([poses[:, :3, 3] - measured[:, :3, 3], turn], axis=1)


def _unlikely(camera: Camera, nominal: Camera) -> str:
    """A sentence on a lens that no camera has; empty for a likely one."""
    away = (lens_of(camera) - lens_of(nominal)) / _lens_std(nominal)
    if np.abs(away).max() <= _UNLIKELY:
        return ""
    focal, right, down, k1, k2 = lens_of(camera)
    return (
        f"the one that fits the frames has {focal:.0f} pixels of focal length, a principal point ({right:+.0f}, "
        f"{down:+.0f}) pixels from the middle, k1 = {k1:.2f} and k2 = {k2:.2f}, as no camera; check angles, heights "
        "and the focal length, or give the lens"
    )


def _open(camera: Camera) -> Camera:
    """A Camera whose lens does not fold the image; raise if it does."""
    try:
        edge_directions(camera)
    except ThermorenderError:
        raise ThermorenderError(
            "the lens that fits the frames would fold the image, so their angles, heights or focal length are wrong"
        ) from None
    return camera


def _prior(step: Floats, precision: Floats) -> Floats:
    """Precisions of measured poses, (F, 6): less where a pose deviates by far more than it states."""
    found = np.broadcast_to(precision, step.shape).copy()
    for part in (slice(0, 3), slice(3, 6)):
        away = (step[:, part] ** 2 * precision[part]).sum(axis=1) / 3.0
        found[:, part] /= (1.0 + away / _MISSTATED**2)[:, None]
    return found
