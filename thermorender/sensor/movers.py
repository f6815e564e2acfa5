"""Things that move or warm by themselves: which parts of an image they change, and how fast.

What moves with the camera alone moves all over the image, and one image tells much of the others. A thing with a course
of its own is followed in the part of the image that it crosses, and only there.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thermorender.sensor.psf import COARSE, STEP

# Evenly spaced times at which things are projected, besides those at which their courses bend.
_LOOKS = 9
# Motion over less than this share of a span is a jump: its two ends are instants of their own.
_JUMP = 0.02
# Radiance curves over temperature: between instants so far apart [K] a straight line errs by 10 mK in the mean.
_WARMING_K = 3.0
# How many squares, over which the tails of the lens's blur are summed, reach into a part.
_REACH = COARSE // 2 + 1


@dataclass(frozen=True)
class Mover:
    """A thing with a course of its own.

    Attributes
    ----------
    corners_at : callable
        Time [s] → (n, 3) corners of a box round it, in the world [m].
    temperature_at : callable
        Time [s] → [K].
    times_s : (n,) float64
        Rising; between them its place and temperature change evenly [s].
    """

    corners_at: Callable
    temperature_at: Callable
    times_s: np.ndarray


@dataclass(frozen=True)
class Part:
    """A part of an image that things change while they are watched.

    Attributes
    ----------
    rows, columns : slice
        Of the image.
    px_per_s : float
        How fast they move in the image, at most, jumps apart [px/s].
    bends_s : (n,) float64
        When their courses bend, rising [s].
    warming_s : (n,) float64
        Between that, where they warm so much that their radiance curves, rising [s].
    """

    rows: slice
    columns: slice
    px_per_s: float
    bends_s: np.ndarray
    warming_s: np.ndarray

    def around(self, height, width):
        """Return (rows, columns) that hold all that the lens spreads into this part, in whole squares of its tails."""
        found = []
        for side, n in ((self.rows, height), (self.columns, width)):
            first, last = side.start // STEP - _REACH, -(-side.stop // STEP) + _REACH
            found.append(slice(max(first * STEP, 0), min(last * STEP, n)))
        return tuple(found)


def parts(camera, pose_at, movers, since_s, until_s, margin_px, moved_s=0.0):
    """Return the Parts of an image that things change between two times; none overlap.

    Parameters
    ----------
    camera : Camera
    pose_at : callable
        Time [s] → (4, 4) world_from_camera.
    movers : sequence of Mover
    since_s, until_s : float
    margin_px : int
        Of a part beyond the things' boxes.
    moved_s : float
        Up to how far images are moved in time, which shows things where poses so much before and after have them [s].
    """
    found = [_part(camera, pose_at, mover, since_s, until_s, margin_px, moved_s) for mover in movers]
    found, apart = [part for part in found if part], []
    while found:
        part = found.pop()
        other = next((other for other in found if _overlap(part, other)), None)
        if other is None:
            apart.append(part)
            continue
        found.remove(other)
        found.append(
            Part(
                *(slice(min(a.start, b.start), max(a.stop, b.stop)) for a, b in _sides(part, other)),
                max(part.px_per_s, other.px_per_s),
                np.union1d(part.bends_s, other.bends_s),
                np.union1d(part.warming_s, other.warming_s),
            )
        )
    return apart


def _part(camera, pose_at, mover, since_s, until_s, margin_px, moved_s):
    """That of one thing; None where it stays as it is or is not seen."""
    bends = mover.times_s[(mover.times_s > since_s) & (mover.times_s < until_s)]
    times = np.union1d(np.linspace(since_s, until_s, _LOOKS), bends)
    corners = [mover.corners_at(time_s) for time_s in times]
    warm = [mover.temperature_at(time_s) for time_s in times]
    if np.ptp(corners, axis=0).max() == 0.0 and np.ptp(warm) == 0.0:
        return None
    shown, size = [], np.array([camera.width, camera.height])
    for late_s in (0.0, -moved_s, moved_s) if moved_s else (0.0,):
        poses = [pose_at(time_s + late_s) for time_s in times]
        seen = [(corner - pose[:3, 3]) @ pose[:3, :3] for pose, corner in zip(poses, corners, strict=True)]
        shown.append(camera.project(np.array(seen)))
    pixel = shown[0]
    hidden = np.isnan(pixel[..., 0])
    if hidden.all():
        return None
    # What is partly beside the camera may be anywhere.
    beside = hidden.any()
    least, most = (np.zeros(2), size) if beside else (end(shown, axis=(0, 1, 2)) for end in (np.nanmin, np.nanmax))
    first = np.clip(np.floor(least) - margin_px, 0, size).astype(int)
    last = np.clip(np.ceil(most) + margin_px, 0, size).astype(int)
    if (first >= last).any():
        return None
    span = np.diff(times)
    lasting = np.minimum(span / (camera.time_constant_s or span), 1.0)
    steps = np.ceil(np.abs(np.diff(warm)) / _WARMING_K * np.sqrt(lasting)).astype(int)
    warming = [np.linspace(*ends, n, endpoint=False)[1:] for *ends, n in zip(times[:-1], times[1:], steps, strict=True)]
    slow = span > _JUMP * (until_s - since_s)
    with np.errstate(invalid="ignore"):
        speed = np.linalg.norm(np.diff(pixel, axis=0), axis=-1)[slow] / span[slow, None]
    # Of what comes from behind the camera the seen corners tell.
    fastest = float(np.nanmax(speed)) if not np.isnan(speed).all() else float(size.max() / (until_s - since_s))
    return Part(slice(first[1], last[1]), slice(first[0], last[0]), fastest, bends, np.concatenate(warming))


def _sides(one, other):
    return (one.rows, other.rows), (one.columns, other.columns)


def _overlap(one, other):
    return all(a.start < b.stop and b.start < a.stop for a, b in _sides(one, other))
