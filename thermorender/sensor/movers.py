"""Moving or warming objects: the regions of an image that they change, and how fast."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.sensor.camera import Camera, Pose
from thermorender.sensor.psf import COARSE, STEP

# Evenly spaced times at which objects are projected, in addition to the bends of their tracks.
_LOOKS = 9
# Motion over less than this share of a span is a jump; both its ends are instants.
_JUMP = 0.02
# Radiance is nonlinear in temperature: over a step of this size [K] a straight line has a mean error of 7 mK at 300 K.
_WARMING_K = 3.0
# Squares of the coarse blur kernel that reach into a region.
_REACH = COARSE // 2 + 1


@dataclass(frozen=True)
class Mover:
    """An object that moves or warms along a track."""

    # Time [s] → (n, 3) corners of its bounding box, in the world [m]
    corners_at: Callable[[float], NDArray[np.float64]]
    temperature_at: Callable[[float], float]  # Time [s] → [K]
    times_s: NDArray[np.float64]  # (n,) float64 rising; position and temperature are linear between them [s]


@dataclass(frozen=True)
class ChangingRegion:
    """A region of an image that moving or warming objects change."""

    # rows, columns: Of the image
    rows: slice
    columns: slice
    px_per_s: float  # Largest speed of the objects in the image, without jumps [px/s]
    bends_s: NDArray[np.float64]  # (n,) float64 bends of their tracks, rising [s]
    # (n,) float64 times between, where they warm so fast that radiance is not linear in time, rising [s]
    warming_s: NDArray[np.float64]

    def around(self, height: int, width: int) -> tuple[slice, slice]:
        """Return (rows, columns) from which the lens blurs into this region, in whole squares of the coarse kernel."""

        def wider(side: slice, n: int) -> slice:
            first, last = side.start // STEP - _REACH, -(-side.stop // STEP) + _REACH
            return slice(max(first * STEP, 0), min(last * STEP, n))

        return wider(self.rows, height), wider(self.columns, width)


def changing_regions(
    camera: Camera, pose_at: Callable[[float], Pose], movers: Sequence[Mover], since_s: float, until_s: float,
    margin_px: int, moved_s: float = 0.0,
) -> list[ChangingRegion]:  # fmt: skip
    """Return the disjoint ChangingRegions of an image that objects change between two times [s].

    `pose_at` maps a time to world_from_camera, `margin_px` surrounds the objects' boxes, and `moved_s` is the longest
    time over which images are moved.
    """
    made = (_changing_region(camera, pose_at, mover, since_s, until_s, margin_px, moved_s) for mover in movers)
    found, apart = [region for region in made if region], list[ChangingRegion]()
    while found:
        region = found.pop()
        other = next((other for other in found if _overlap(region, other)), None)
        if other is None:
            apart.append(region)
            continue
        found.remove(other)
        rows, columns = (slice(min(a.start, b.start), max(a.stop, b.stop)) for a, b in _sides(region, other))
        bends, warming = np.union1d(region.bends_s, other.bends_s), np.union1d(region.warming_s, other.warming_s)
        found.append(ChangingRegion(rows, columns, max(region.px_per_s, other.px_per_s), bends, warming))
    return apart


def _changing_region(
    camera: Camera, pose_at: Callable[[float], Pose], mover: Mover, since_s: float, until_s: float, margin_px: int,
    moved_s: float,
) -> ChangingRegion | None:  # fmt: skip
    """The region of one object; None if it does not change or is not visible."""
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
    # An object partly behind the camera may be anywhere in the image.
    beside = hidden.any()
    least, most = (np.zeros(2), size) if beside else (end(shown, axis=(0, 1, 2)) for end in (np.nanmin, np.nanmax))
    first = np.clip(np.floor(least) - margin_px, 0, size).astype(int)
    last = np.clip(np.ceil(most) + margin_px, 0, size).astype(int)
    if (first >= last).any():
        return None
    span = np.diff(times)
    lasting = np.minimum(span / (camera.memory_s or span), 1.0)
    steps = np.ceil(np.abs(np.diff(warm)) / _WARMING_K * np.sqrt(lasting)).astype(int)
    spans = zip(times[:-1], times[1:], steps, strict=True)
    warming = [np.linspace(start, end, n, endpoint=False)[1:] for start, end, n in spans]
    slow = span > _JUMP * (until_s - since_s)
    with np.errstate(invalid="ignore"):
        speed = np.linalg.norm(np.diff(pixel, axis=0), axis=-1)[slow] / span[slow, None]
    # Of an object from behind the camera, the visible corners give the speed.
    fastest = float(np.nanmax(speed)) if not np.isnan(speed).all() else float(size.max() / (until_s - since_s))
    return ChangingRegion(slice(first[1], last[1]), slice(first[0], last[0]), fastest, bends, np.concatenate(warming))


def _sides(one: ChangingRegion, other: ChangingRegion) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    return (one.rows, other.rows), (one.columns, other.columns)


def _overlap(one: ChangingRegion, other: ChangingRegion) -> bool:
    return all(a.start < b.stop and b.start < a.stop for a, b in _sides(one, other))


def outside(regions: Sequence[ChangingRegion], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return whether pixels (H, W) are outside all regions; those inside are followed apart, with their own error."""
    found = np.ones(shape, dtype=bool)
    for region in regions:
        found[region.rows, region.columns] = False
    return found
