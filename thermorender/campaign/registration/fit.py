"""Calibration of a rig: the mapping from thermal to visible pictures by the directions of their gradients.

All frames of a rig share one mapping: their correlations are summed before a maximum is looked for. First over scale
and rotation on a grid and over all shifts, on small pictures; then all parameters together on finer and finer pictures
by the steps of Evangelidis and Psarakis, Parametric image alignment using enhanced correlation coefficient
maximization, IEEE TPAMI 30 (2008) 1858, doi:10.1109/TPAMI.2008.113. Frames by themselves serve only to find those that
lie elsewhere, which are left out.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.campaign.registration.gradient_directions import best_shift, directions
from thermorender.campaign.registration.rig import Rig, half_diagonal, positions
from thermorender.errors import ThermorenderError

# Frames are taken evenly spread where there are more.
MOST_FRAMES = 32
# Smallest side of a picture that a rig can be seen in [px].
_LEAST_SIDE = 48
# Columns of the small pictures of the first search, and how many of them are enough there.
_SMALL, _FIRST_FRAMES = 112, 16
_SCALE_STEP, _ROTATIONS_DEG = 0.04, (-4.0, -2.0, 0.0, 2.0, 4.0)
# Scales looked at where fields of view are not known: of that which makes both pictures cover the same.
_SCALES = (0.25, 1.3)
# Uncertainty of the scale by published fields of view. Chosen: they are rounded, and of lenses with distortion.
_FIELD_TOLERANCE = 0.15
# The canvas of correlations over all shifts, in pictures; so shifts reach a quarter of a picture.
_CANVAS = 1.5
# Frames that lie further off than this share of the columns are elsewhere.
_ELSEWHERE = 0.05
_OUTLIER = 3.5 * 1.4826
# Of a picture whose gradients know of its border: three standard deviations of their blur and one more [px].
_MARGIN = 4
# Lower scores are those of pictures that do not show the same. Chosen: unrelated ones reach 0.06 where they fit best,
# real pairs 0.2 to 0.5.
_LEAST_SCORE = 0.1
# Parameters: ln scale, rotation, shift, shift, k1, ln aspect.
_RIGID, _DISTORTED, _RESIZED = (0, 1, 2, 3), (0, 1, 2, 3, 4), (0, 1, 2, 3, 4, 5)
_WANTED = "give pairs of one rig with detail in both pictures, far away compared with the cameras' distance"
_DELTA = np.array([1e-5, 1e-5, 1e-3, 1e-3, 1e-5, 1e-5])


@dataclass(frozen=True, eq=False)
class _Frame:
    """Grey pictures of a pair, float32; the visible one coarser by `Frames.reduced` than the camera's."""

    name: str
    visible: np.ndarray
    thermal: np.ndarray


@dataclass(frozen=True, eq=False)
class _Level:
    """Gradient directions of all frames at one resolution.

    Attributes
    ----------
    visible, thermal : list of (h, w) complex64
    density : (2,) floats
        Pixels of the visible ones to a pixel of the camera's, along columns and rows.
    x, y : (h, w) float64
        Of the thermal ones' pixels, from the picture's middle [thermal px].
    every : int
        Of so many pixels along each side one is looked at.
    diagonal : float
        Half that of the visible camera's picture [px].
    """

    visible: list
    thermal: list
    density: tuple
    x: np.ndarray
    y: np.ndarray
    every: int
    diagonal: float


def calibrate(frames, fields_of_view=None, resized=False, progress=None):
    """Return the Rig of frames.

    Parameters
    ----------
    frames : sequence of (name, callable)
        The callable gives (visible (h, w, 3) uint8, thermal (H, W) array); NaN where nothing was measured.
    fields_of_view : ((2,), (2,)) floats, optional
        Horizontal and vertical, of the visible and of the thermal camera [deg]: where to begin.
    resized : bool
        Whether the visible pictures may have been resized unequally along their sides, whose ratio is then found too.
    progress : callable, optional
        Called with (what, share done).

    Raises
    ------
    ThermorenderError
        Frames of several sizes, or of which half or more do not agree on one rig, or none that show the same.
    """
    tell = progress or (lambda what, share: None)
    pictures, shapes, reduced, start = _read(frames, fields_of_view, tell)
    visible_shape, thermal_shape = shapes
    free = _RESIZED if resized else _DISTORTED
    tell("looking for scale and rotation", 0.0)
    begins = _searched(pictures, shapes, reduced, start, tell)
    coarse = thermal_shape[1] / _SMALL
    levels = [factor for factor in (4.0, 2.0, 1.0) if factor <= max(coarse, 1.0)] or [1.0]
    found = []
    for begin in begins:
        level = _level(pictures, shapes, reduced, np.exp(begin[0]), coarse)
        found.append(_climb(level, _climb(level, begin, _RIGID)[0], free))
    parameters = max(found, key=lambda each: each[1])[0]
    used, rejected = list(range(len(pictures))), {}
    for number, factor in enumerate(levels):
        tell("fitting the rig", number / len(levels))
        level = _level([pictures[k] for k in used], shapes, reduced, np.exp(parameters[0]), factor)
        parameters, _ = _climb(level, parameters, free)
        if number == 0 and len(pictures) > 1:
            rejected = _outliers(level, parameters, [frame.name for frame in pictures], factor, thermal_shape[1])
            used = [k for k in used if pictures[k].name not in rejected]
            if 2 * len(used) <= len(pictures):
                raise ThermorenderError(
                    f"{len(used)} of {len(pictures)} pairs of pictures agree on how the cameras lie to each other; "
                    f"{_WANTED}"
                )
    normals = _normals(level, parameters, free)
    judge = _level(pictures, shapes, reduced, np.exp(parameters[0]), max(thermal_shape[1] / 320.0, 1.0))
    own = _scores(judge, parameters)
    if own[used].mean() < _LEAST_SCORE:
        raise ThermorenderError(
            f"pictures laid onto each other at their best have a score of {own[used].mean():.3f}, and those that show "
            f"the same at least {_LEAST_SCORE}; {_WANTED}"
        )
    other = _scores(judge, parameters, roll=1)[used] if len(pictures) > 1 else None
    scale = float(np.exp(parameters[0]))
    return Rig(
        visible_shape=visible_shape, thermal_shape=thermal_shape, scale=scale,
        rotation_deg=float(np.degrees(parameters[1])), shift_px=tuple(float(scale * each) for each in parameters[2:4]),
        k1=float(parameters[4]), aspect=float(np.exp(parameters[5])),
        errors=_errors(normals, free, parameters, level), score=float(own[used].mean()),
        score_unrelated=None if other is None else float(other.mean()),
        frames={frame.name: float(score) for frame, score in zip(pictures, own, strict=True)}, rejected=rejected,
    )  # fmt: skip


def scores(rig, frames, progress=None):
    """Return the score of each frame under a rig, {name: correlation of gradient directions}.

    Parameters
    ----------
    rig : Rig
    frames : sequence of (name, callable)
        As for `calibrate`.
    """
    pictures, shapes, reduced, _ = _read(frames, None, progress or (lambda what, share: None))
    parameters = parameters_of(rig)
    judge = _level(pictures, shapes, reduced, rig.scale, max(shapes[1][1] / 320.0, 1.0))
    return dict(zip([frame.name for frame in pictures], _scores(judge, parameters).tolist(), strict=True))


def parameters_of(rig):
    """Return the (6,) parameters of a Rig, as `thermorender.campaign.registration.rig.positions` takes them."""
    shift = np.array(rig.shift_px) / rig.scale
    return np.array([np.log(rig.scale), np.radians(rig.rotation_deg), *shift, rig.k1, np.log(rig.aspect)])


def scale_of_fields(fields_of_view, visible_shape, thermal_shape):
    """Return visible pixels to a thermal pixel by fields of view [deg], the geometric mean of columns and rows."""
    lengths = [
        np.array(shape[::-1]) / 2.0 / np.tan(np.radians(np.asarray(angles, np.float64)) / 2.0)
        for angles, shape in zip(fields_of_view, (visible_shape, thermal_shape), strict=True)
    ]
    return float(np.sqrt(np.prod(lengths[0] / lengths[1])))


# --- pictures ---------------------------------------------------------------------------------------------------


def _read(frames, fields_of_view, tell):
    """(list of _Frame, (visible shape, thermal shape), how much coarser visible pictures were made, scale or None)."""
    import cv2

    frames = list(frames)
    if not frames:
        raise ThermorenderError("a rig needs at least one pair of pictures, got none; give some")
    if len(frames) > MOST_FRAMES:
        frames = [frames[k] for k in np.linspace(0, len(frames) - 1, MOST_FRAMES).round().astype(int)]
    pictures, shapes, start, reduced = [], None, None, 1.0
    for number, (name, read) in enumerate(frames):
        tell("reading pictures", number / len(frames))
        visible, thermal = read()
        if shapes is None:
            shapes = tuple(visible.shape[:2]), tuple(thermal.shape)
            side = min(*shapes[0], *shapes[1])
            if side < _LEAST_SIDE:
                raise ThermorenderError(
                    f"pair {name!r} has a side of {side} pixels; a rig needs pictures of at least {_LEAST_SIDE}"
                )
            if fields_of_view is not None:
                start = scale_of_fields(fields_of_view, *shapes)
                reduced = max(start * (1.0 - _FIELD_TOLERANCE), 1.0)
            else:
                reduced = max(_SCALES[0] * _filling(shapes), 1.0)
        elif (tuple(visible.shape[:2]), tuple(thermal.shape)) != shapes:
            raise ThermorenderError(
                f"pair {name!r} has pictures of {visible.shape[1]}×{visible.shape[0]} and "
                f"{thermal.shape[1]}×{thermal.shape[0]} pixels, others of {shapes[0][1]}×{shapes[0][0]} and "
                f"{shapes[1][1]}×{shapes[1][0]}; give the pictures of one rig"
            )
        grey = cv2.cvtColor(np.ascontiguousarray(visible), cv2.COLOR_RGB2GRAY)
        size = tuple(round(side / reduced) for side in grey.shape[::-1])
        pictures.append(_Frame(name, cv2.resize(grey, size, interpolation=cv2.INTER_AREA), _calm(thermal)))
    return pictures, shapes, reduced, start


def _calm(thermal):
    """A thermal picture as float32 without its extremes, which fires and dead pixels have; NaN takes the median."""
    values = np.asarray(thermal, np.float32)
    known = values[np.isfinite(values)]
    if not known.size:
        return np.zeros(values.shape, np.float32)
    low, middle, high = np.quantile(known, (0.005, 0.5, 0.995))
    return np.clip(np.where(np.isfinite(values), values, middle), low, high).astype(np.float32)


def _filling(shapes):
    """The scale at which both pictures cover the same."""
    return float(min(np.array(shapes[0]) / np.array(shapes[1])))


def _resized(grey, factor):
    """A picture made coarser by a factor, and its pixels to one of the original's along columns and rows."""
    import cv2

    size = tuple(max(round(side / factor), 8) for side in grey.shape[::-1])
    how = cv2.INTER_AREA if factor >= 1.0 else cv2.INTER_LINEAR
    return cv2.resize(grey, size, interpolation=how), (size[0] / grey.shape[1], size[1] / grey.shape[0])


def _level(pictures, shapes, reduced, scale, factor):
    """The _Level at which a pixel is `factor` thermal pixels wide, for a rig of about this scale."""
    visible, thermal = [], []
    for frame in pictures:
        small, _ = _resized(frame.visible, max(scale * factor / reduced, 1.0))
        visible.append(directions(small))
        small_thermal, (across, down) = _resized(frame.thermal, factor)
        thermal.append(directions(small_thermal))
    density = visible[0].shape[1] / shapes[0][1], visible[0].shape[0] / shapes[0][0]
    height, width = thermal[0].shape
    column, row = (np.arange(width) + 0.5) / across, (np.arange(height) + 0.5) / down
    x, y = np.meshgrid(column - shapes[1][1] / 2.0, row - shapes[1][0] / 2.0)
    return _Level(visible, thermal, density, x, y, 2 if width > 400 else 1, half_diagonal(shapes[0]))


# --- first search -----------------------------------------------------------------------------------------------


def _searched(pictures, shapes, reduced, start, tell):
    """Up to three (6,) parameters to begin with, the best first: scale, rotation and shift on small pictures."""
    import cv2

    factor = shapes[1][1] / min(_SMALL, shapes[1][1])
    if len(pictures) > _FIRST_FRAMES:
        pictures = [pictures[k] for k in np.linspace(0, len(pictures) - 1, _FIRST_FRAMES).round().astype(int)]
    thermal = [directions(_resized(frame.thermal, factor)[0]) for frame in pictures]
    shape = thermal[0].shape
    filling = _filling(shapes)
    low, high = np.log(_SCALES) + np.log(filling)
    if start is not None:
        low, high = np.log(start) + np.log1p(-_FIELD_TOLERANCE), np.log(start) + np.log1p(_FIELD_TOLERANCE)
    found = []
    canvas = tuple(int(np.ceil(_CANVAS * side)) for side in shape)
    grid = np.linspace(low, high, int(np.ceil((high - low) / _SCALE_STEP)) + 1)
    for number, log_scale in enumerate(grid):
        tell("looking for scale and rotation", number / len(grid))
        small = [_resized(frame.visible, np.exp(log_scale) * factor / reduced)[0] for frame in pictures]
        height, width = small[0].shape
        for angle in _ROTATIONS_DEG:
            # From the canvas into the small visible picture, about both middles, whose pixels count from theirs.
            cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            turn = np.array([[cos, -sin], [sin, cos]])
            middle = (np.array([width, height]) - 1.0) / 2.0 - turn @ ((np.array(canvas[::-1]) - 1.0) / 2.0)
            matrix, flags = np.column_stack([turn, middle]), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            inside = cv2.warpAffine(np.ones((height, width), np.uint8), matrix, canvas[::-1], flags=flags)
            inside = cv2.erode(inside, np.ones((5, 5), np.uint8), borderValue=0) > 0
            turned = [
                directions(cv2.warpAffine(each, matrix, canvas[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE))
                for each in small
            ]
            score, shift = best_shift(turned, thermal, inside)
            # What lies at x in the thermal picture lies at R(x + shift) in the visible one.
            shift = turn @ shift * factor
            found.append((score, np.array([log_scale, np.radians(angle), *shift, 0.0, 0.0])))
    found.sort(key=lambda each: -each[0])
    begins = []
    for _, each in found:
        apart = [abs(each[0] - other[0]) > 1.5 * _SCALE_STEP or abs(each[1] - other[1]) > 0.04 for other in begins]
        if all(apart):
            begins.append(each)
        if len(begins) == 3:
            break
    return begins


# --- fit --------------------------------------------------------------------------------------------------------


def _sampled(level, parameters, x, y):
    """([(h, w) complex64 visible directions as the thermal camera sees them], (h, w) bool where known)."""
    import cv2

    column, row = positions(parameters, x, y, level.diagonal)
    height, width = level.visible[0].shape
    column = (column * level.density[0] + width / 2.0 - 0.5).astype(np.float32)
    row = (row * level.density[1] + height / 2.0 - 0.5).astype(np.float32)
    inside = (column >= _MARGIN) & (row >= _MARGIN) & (column < width - _MARGIN) & (row < height - _MARGIN)
    turn = np.complex64(np.exp(-2j * parameters[1]))
    found = []
    for each in level.visible:
        pairs = cv2.remap(each.view(np.float32).reshape(height, width, 2), column, row, cv2.INTER_LINEAR)
        found.append(np.ascontiguousarray(pairs).view(np.complex64)[..., 0] * turn)
    return found, inside


def _within(shape):
    """(h, w) bool, False along the borders, where the gradients of a picture alone are not those of the scene."""
    within = np.zeros(shape, bool)
    within[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN] = True
    return within


def _moves(level, parameters, free):
    """How far a unit of each free parameter moves what is seen, (h, w, free, 2) [level px], by central differences."""
    x, y = (values[:: level.every, :: level.every] for values in (level.x, level.y))

    def at(change, dx=0.0, dy=0.0):
        return np.stack(positions(parameters + change, x + dx, y + dy, level.diagonal), axis=-1)

    none = np.zeros(6)
    right, down = at(none, 0.5, 0.0) - at(none, -0.5, 0.0), at(none, 0.0, 0.5) - at(none, 0.0, -0.5)
    determinant = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
    pixel = abs(level.x[0, 1] - level.x[0, 0])
    moved = []
    for k in free:
        step = np.zeros(6)
        step[k] = _DELTA[k]
        u, v = np.moveaxis((at(step) - at(-step)) / (2.0 * _DELTA[k] * pixel * determinant[..., None]), -1, 0)
        # Back to the thermal picture, by the inverse of the mapping's slope.
        moved.append(np.stack([down[..., 1] * u - down[..., 0] * v, right[..., 0] * v - right[..., 1] * u], axis=-1))
    return np.stack(moved, axis=-2)


def _normals(level, parameters, free):
    """Of each frame (JᵀJ, Jᵀz of thermal, Jᵀz of visible, ⟨visible, thermal⟩, |visible|², |thermal|²)."""
    sampled, inside = _sampled(level, parameters, level.x, level.y)
    every = slice(None, None, level.every)
    moves = _moves(level, parameters, free)
    inside = (inside & _within(inside.shape))[every, every]
    moves = moves[inside].astype(np.float32)
    found = []
    for seen, known in zip(sampled, level.thermal, strict=True):
        down, across = np.gradient(seen)
        across, down, value = (image[every, every][inside] for image in (across, down, seen))
        known = known[every, every][inside]
        turned = -2j * value
        rows = []
        # Real and imaginary parts apart: products of real matrices are several times faster.
        for part in (np.real, np.imag):
            design = part(across)[:, None] * moves[..., 0] + part(down)[:, None] * moves[..., 1]
            design[:, free.index(1)] += part(turned)
            rows.append((design - design.mean(axis=0), *(part(each) - part(each).mean() for each in (value, known))))
        found.append((
            sum(design.T @ design for design, _, _ in rows).astype(np.float64),
            sum(design.T @ own for design, _, own in rows).astype(np.float64),
            sum(design.T @ own for design, own, _ in rows).astype(np.float64),
            sum(float(seen @ own) for _, seen, own in rows), sum(float(seen @ seen) for _, seen, _ in rows),
            sum(float(own @ own) for _, _, own in rows),
        ))  # fmt: skip
    return found


def _pooled(normals):
    """(correlation pooled over frames, factor that the thermal directions get in a step)."""
    product, seen, known = (sum(each[k] for each in normals) for k in (3, 4, 5))
    return product / np.sqrt(max(seen * known, 1e-12)), seen / max(product, 1e-3 * seen, 1e-12)


def _climb(level, parameters, free, most=25):
    """(parameters at the maximum of the pooled correlation near a start, the correlation there)."""
    normals = _normals(level, parameters, free)
    score, factor = _pooled(normals)
    for _ in range(most):
        step = np.zeros(6)
        step[list(free)] = _step(normals, factor)
        for shorter in (1.0, 0.5, 0.2):
            trial = parameters + shorter * step
            after = _normals(level, trial, free) if _possible(level, trial) else None
            if after is not None and _pooled(after)[0] > score:
                break
        else:
            return parameters, score
        moved = np.stack(positions(trial, level.x, level.y, level.diagonal))
        moved = np.abs(moved - np.stack(positions(parameters, level.x, level.y, level.diagonal))).max()
        parameters, normals = trial, after
        score, factor = _pooled(normals)
        # A hundredth of a pixel of this level.
        if moved < 0.01 * abs(level.x[0, 1] - level.x[0, 0]) * np.exp(parameters[0]):
            break
    return parameters, score


def _step(normals, factor):
    """Change of the free parameters: of the sum over frames."""
    matrix = sum(each[0] for each in normals)
    slope = sum(factor * each[1] - each[2] for each in normals)
    unit = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    return np.linalg.lstsq(matrix / np.outer(unit, unit), slope / unit, rcond=1e-9)[0] / unit


def _possible(level, parameters):
    """Whether at least half of the thermal picture is seen and the distortion does not fold."""
    column, row = positions(parameters, level.x, level.y, level.diagonal)
    height, width = level.visible[0].shape
    inside = (np.abs(column) * level.density[0] <= width / 2.0) & (np.abs(row) * level.density[1] <= height / 2.0)
    return bool(inside.mean() >= 0.5 and abs(parameters[4]) < 0.8 and abs(parameters[1]) < 0.35)


def _scores(level, parameters, roll=0):
    """Correlation of each frame's directions, (frames,); with the visible ones `roll` frames on."""
    sampled, inside = _sampled(level, parameters, level.x, level.y)
    inside, found = inside & _within(inside.shape), []
    for number, known in enumerate(level.thermal):
        seen, own = sampled[(number + roll) % len(sampled)][inside], known[inside]
        seen, own = seen - seen.mean(), own - own.mean()
        power = np.vdot(seen, seen).real * np.vdot(own, own).real
        found.append(np.vdot(seen, own).real / np.sqrt(max(power, 1e-12)))
    return np.array(found)


def _outliers(level, parameters, names, factor, columns):
    """{name: why} of frames that lie elsewhere than the pooled mapping says, each by itself."""
    height, width = level.thermal[0].shape
    canvas = tuple(int(np.ceil(_CANVAS * side)) for side in (height, width))
    # The grid of the thermal pixels, continued on all sides.
    pitch = level.x[0, 1] - level.x[0, 0], level.y[1, 0] - level.y[0, 0]
    x = (np.arange(canvas[1]) - (canvas[1] - 1) / 2.0) * pitch[0]
    y = (np.arange(canvas[0]) - (canvas[0] - 1) / 2.0) * pitch[1]
    sampled, inside = _sampled(level, parameters, *np.meshgrid(x, y))
    shifts = []
    for seen, known in zip(sampled, level.thermal, strict=True):
        shifts.append(best_shift([seen], [known], inside)[1] * factor)
    shifts, own = np.array(shifts), _scores(level, parameters)
    away = np.hypot(*(shifts - np.median(shifts, axis=0)).T)
    allowed = min(max(_OUTLIER * np.median(away), 2.0 * factor), _ELSEWHERE * columns)
    # A spread of 0.02 is that of equal scenes.
    least = np.median(own) - _OUTLIER * max(np.median(np.abs(own - np.median(own))), 0.02)
    found = {}
    for name, distance, score in zip(names, away, own, strict=True):
        if distance > allowed:
            found[name] = f"lies {distance:.0f} thermal px off the others"
        elif score < least:
            found[name] = f"score {score:.3f}, of the others {np.median(own):.3f}"
    return found


def _errors(normals, free, parameters, level):
    """Standard errors by the jackknife: each frame left out in turn, by one step from the common maximum."""
    count = len(normals)
    if count < 2:
        return {}
    _, factor = _pooled(normals)
    without = np.array([_step(normals[:k] + normals[k + 1 :], factor) for k in range(count)])
    spread = without - without.mean(axis=0)
    covariance = (count - 1) / count * spread.T @ spread
    moves = _moves(level, parameters, free) * abs(level.x[0, 1] - level.x[0, 0])
    position = np.sqrt(np.einsum("...ik,ij,...jk->...", moves, covariance, moves).mean())
    error, scale = np.zeros(6), float(np.exp(parameters[0]))
    error[list(free)] = np.sqrt(np.diag(covariance))
    found = {
        "scale": scale * error[0], "rotation_deg": np.degrees(error[1]), "column_px": scale * error[2],
        "row_px": scale * error[3], "k1": error[4], "aspect": np.exp(parameters[5]) * error[5],
        "position_px": position,
    }  # fmt: skip
    return {key: float(value) for key, value in found.items() if value > 0.0}
