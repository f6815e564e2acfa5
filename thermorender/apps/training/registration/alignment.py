"""Fit of a rig's parameters at one resolution: maximum of the pooled correlation of gradient directions.

The steps are those of Evangelidis and Psarakis, Parametric image alignment using enhanced correlation coefficient
maximization, IEEE TPAMI 30 (2008) 1858, doi:10.1109/TPAMI.2008.113.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from thermorender.apps.training.registration.levels import Level
from thermorender.apps.training.registration.rig import positions

# Border within which gradients are affected by the picture's edge: three standard deviations of the blur, plus one
# [px].
_MARGIN = 4
# JᵀJ, Jᵀz of thermal, Jᵀz of visible, ⟨visible, thermal⟩, |visible|², |thermal|² of a frame.
Normals = tuple[np.ndarray, np.ndarray, np.ndarray, float, float, float]
# Steps of the central differences by each parameter.
_DELTA = np.array([1e-5, 1e-5, 1e-3, 1e-3, 1e-5, 1e-5])


def sample(
    level: Level, parameters: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:  # fmt: skip
    """Return ([(h, w) complex64 visible directions on the thermal pixels], (h, w) bool where known)."""
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


def within_borders(shape: tuple[int, ...]) -> np.ndarray:
    """Return (h, w) bool, False along the borders, where gradients are affected by the picture's edge."""
    within = np.zeros(shape, bool)
    within[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN] = True
    return within


def moves_of(level: Level, parameters: np.ndarray, free: Sequence[int]) -> np.ndarray:
    """Return the derivative of positions by each free parameter, (h, w, free, 2) [level px], by central differences."""
    x, y = (values[:: level.every, :: level.every] for values in (level.x, level.y))

    def at(change: np.ndarray, dx: float = 0.0, dy: float = 0.0) -> np.ndarray:
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
        # Back to the thermal picture, by the inverse of the mapping's Jacobian.
        moved.append(np.stack([down[..., 1] * u - down[..., 0] * v, right[..., 0] * v - right[..., 1] * u], axis=-1))
    return np.stack(moved, axis=-2)


def normals_of(level: Level, parameters: np.ndarray, free: Sequence[int]) -> list[Normals]:
    """Return the Normals of each frame."""
    sampled, inside = sample(level, parameters, level.x, level.y)
    every = slice(None, None, level.every)
    moves = moves_of(level, parameters, free)
    inside = (inside & within_borders(inside.shape))[every, every]
    moves = moves[inside].astype(np.float32)
    found = []
    for seen, known in zip(sampled, level.thermal, strict=True):
        down, across = np.gradient(seen)
        across, down, value = (image[every, every][inside] for image in (across, down, seen))
        known = known[every, every][inside]
        turned = -2j * value
        rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        # Real and imaginary parts separately: products of real matrices are several times faster.
        for part in (np.real, np.imag):
            design = part(across)[:, None] * moves[..., 0] + part(down)[:, None] * moves[..., 1]
            design[:, free.index(1)] += part(turned)
            seen_part, known_part = (part(each) - part(each).mean() for each in (value, known))
            rows.append((design - design.mean(axis=0), seen_part, known_part))
        found.append((
            np.add(*(design.T @ design for design, _, _ in rows)).astype(np.float64),
            np.add(*(design.T @ own for design, _, own in rows)).astype(np.float64),
            np.add(*(design.T @ own for design, own, _ in rows)).astype(np.float64),
            sum(float(seen @ own) for _, seen, own in rows), sum(float(seen @ seen) for _, seen, _ in rows),
            sum(float(own @ own) for _, _, own in rows),
        ))  # fmt: skip
    return found


def pooled(normals: Sequence[Normals]) -> tuple[float, float]:
    """Return (correlation pooled over frames, factor on the thermal directions in a step)."""
    # The last three: ⟨visible, thermal⟩, |visible|², |thermal|².
    product, seen, known = (sum(some) for some in zip(*(each[3:] for each in normals), strict=True))
    return product / np.sqrt(max(seen * known, 1e-12)), seen / max(product, 1e-3 * seen, 1e-12)


def climb(
    level: Level, parameters: np.ndarray, free: Sequence[int], most: int = 25
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Return (parameters at the maximum of the pooled correlation near a start, the correlation there)."""
    normals = normals_of(level, parameters, free)
    score, factor = pooled(normals)
    for _ in range(most):
        step = np.zeros(6)
        step[list(free)] = step_of(normals, factor)
        for shorter in (1.0, 0.5, 0.2):
            trial = parameters + shorter * step
            after = normals_of(level, trial, free) if _possible(level, trial) else None
            if after is not None and pooled(after)[0] > score:
                break
        else:
            return parameters, score
        moved = np.stack(positions(trial, level.x, level.y, level.diagonal))
        moved = np.abs(moved - np.stack(positions(parameters, level.x, level.y, level.diagonal))).max()
        parameters, normals = trial, after
        score, factor = pooled(normals)
        # A hundredth of a pixel of this level.
        if moved < 0.01 * abs(level.x[0, 1] - level.x[0, 0]) * np.exp(parameters[0]):
            break
    return parameters, score


def step_of(normals: Sequence[Normals], factor: float) -> np.ndarray:
    """Return the step of the free parameters for the sum over frames."""
    matrix: Any = sum(each[0] for each in normals)
    slope: Any = sum(factor * each[1] - each[2] for each in normals)
    unit = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    return np.asarray(np.linalg.lstsq(matrix / np.outer(unit, unit), slope / unit, rcond=1e-9)[0] / unit)


def _possible(level: Level, parameters: np.ndarray) -> bool:
    """Whether the visible picture covers half of the thermal one and the distortion stays monotonic."""
    column, row = positions(parameters, level.x, level.y, level.diagonal)
    height, width = level.visible[0].shape
    inside = (np.abs(column) * level.density[0] <= width / 2.0) & (np.abs(row) * level.density[1] <= height / 2.0)
    return bool(inside.mean() >= 0.5 and abs(parameters[4]) < 0.8 and abs(parameters[1]) < 0.35)


def scores_of(level: Level, parameters: np.ndarray, roll: int = 0) -> np.ndarray:
    """Return the correlation of each frame's directions, (frames,), with the visible picture `roll` frames later."""
    sampled, inside = sample(level, parameters, level.x, level.y)
    inside, found = inside & within_borders(inside.shape), []
    for number, known in enumerate(level.thermal):
        seen, own = sampled[(number + roll) % len(sampled)][inside], known[inside]
        seen, own = seen - seen.mean(), own - own.mean()
        power = np.vdot(seen, seen).real * np.vdot(own, own).real
        found.append(np.vdot(seen, own).real / np.sqrt(max(power, 1e-12)))
    return np.array(found)
