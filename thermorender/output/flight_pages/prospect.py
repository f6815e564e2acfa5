"""What a flight will show, from the geometry alone: footprints on the ground, heights, ground resolution, motion.

Rays of each frame, along lines from its middle to its border, intersect the terrain and the static objects. Long
flights are sampled at evenly spaced frames.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.output.terrain_in_view import shows_terrain
from thermorender.trajectory.path import Trajectory

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer
    from thermorender.scene.scene import Scene
    from thermorender.sensor.camera import Camera

Floats = NDArray[np.float64]

# Frames that are sampled; points along each side of a frame, and rays between the middle and each of them.
MOST_FRAMES, _SIDE, _ALONG = 5000, 6, 5
# Share of a frame's points whose motion is not larger, as in the record of the sensor [%].
_MOTION = 98.0
# Share of what is seen that may be backs of faces.
_MOST_BACKS = 0.5


@dataclass(frozen=True, eq=False)
class Prospect:
    """A flight before it is rendered."""

    frames: int  # Frames of the flight
    rate_hz: float
    # index, time_s: (N,) numbers and times of the sampled frames
    index: NDArray[np.int64]
    time_s: Floats
    position: Floats  # (N, 3) float64 of the camera [m]
    above_ground_m: Floats  # (N,) float64, NaN off the terrain
    # (N, K, 2) float64 east and north on the ground, around the footprint, clockwise: of the rays to a point of the
    # frame's border, the outermost that meets a surface; NaN where none does [m]
    outline: Floats
    # (N,) bool whether a ray of the frame meets a surface, or a corner of the terrain's faces is in the picture
    shows_terrain: NDArray[np.bool_]
    # (N,) float64 size of a pixel across the view, the median over the frame's rays that meet a surface; NaN without
    # one [m]
    pixel_m: Floats
    # (N,) float64 motion of the image within the detector's memory, the 98th percentile over the frame; NaN
    # unknown
    motion_px: Floats
    texel_m: float
    memory_s: float
    memory: str  # What it is called
    length_m: float  # Of the path over the ground between the sampled frames
    backs: float  # Share of the rays that meet a surface from behind, of those that meet one
    notes: tuple[str, ...] = ()  # What the renderer says of the flight before it begins

    def as_dict(self) -> dict[str, Any]:
        """Return the figures of `lines` as plain values, for the record of the flight."""
        return {
            "frames_looked_at": len(self.index),
            "path_m": _rounded(self.length_m),
            "above_ground_m": _three(self.above_ground_m),
            "without_terrain": int((~self.shows_terrain).sum()),
            "pixel_m": _three(self.pixel_m),
            "texel_m": _rounded(self.texel_m),
            "motion_px": _three(self.motion_px),
            "backs": _rounded(self.backs),
        }

    @property
    def warning(self) -> str | None:
        """What is wrong with what the flight shows; None if nothing is."""
        return backs_warning(self.backs)

    def lines(self) -> list[str]:
        """Return what the flight will show, in sentences."""
        duration = (self.frames - 1) / self.rate_hz
        some = "" if len(self.index) == self.frames else f"; {len(self.index)} of them are looked at here"
        flown = f"{duration:.4g} s, path of {self.length_m:.4g} m"
        return [
            f"flight: {self.frames} frames at {self.rate_hz:g} Hz, {flown}{some}",
            f"height above the ground: {_range(self.above_ground_m, 'm')}{self._off()}",
            self._empty(),
            f"pixel on the ground: {_range(self.pixel_m, 'm')}{self._texels()}",
            f"motion within the detector's {self.memory} of {1e3 * self.memory_s:g} ms: {_range(self.motion_px, 'px')}",
            *self.notes,
        ]

    def _off(self) -> str:
        off = int(np.isnan(self.above_ground_m).sum())
        return f"; off the terrain in {off} of {len(self.index)} frames" if off else ""

    def _empty(self) -> str:
        empty, some = int((~self.shows_terrain).sum()), len(self.index)
        if not empty:
            return "terrain: in all frames"
        where = f", the first at {self.time_s[~self.shows_terrain][0]:.3f} s"
        return (
            f"terrain: {empty} of {some} frames show none{where}; point the camera with mount, or move the flight "
            "with anchor"
        )

    def _texels(self) -> str:
        """How wide a texel of the orthophoto is, in pixels."""
        if not self.shows_terrain.any():
            return ""
        pixels = self.texel_m / float(np.nanmedian(self.pixel_m))
        if pixels <= 1.0:
            return f"; the orthophoto's texels of {self.texel_m:.3g} m are not coarser"
        return f"; the orthophoto is coarser, with texels of {self.texel_m:.3g} m, {pixels:.3g} pixels wide"


def backs_warning(share: float) -> str | None:
    """Return a warning if most of what is seen, as a share, are backs of faces; else None."""
    if share <= _MOST_BACKS:
        return None
    return (
        f"{share:.0%} of what the camera sees is backs of faces: the camera is below the ground or in a body, or the "
        "faces of a mesh are clockwise seen from outside, which flip = true in its table of scene.toml mends"
    )


def chosen(count: int, most: int) -> NDArray[np.int64]:
    """Return the numbers of up to `most` evenly chosen frames of `count`, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def prospect(renderer: "Renderer", trajectory: Trajectory, times_s: Floats, rate_hz: float) -> Prospect:
    """Return the Prospect of a flight whose frames are at `times_s` (N,)."""
    scene, camera = renderer.scene, renderer.scene.camera
    index = chosen(len(times_s), MOST_FRAMES)
    time_s = times_s[index]
    pose = trajectory.sampled(time_s).poses()
    slope = _slopes(camera)
    direction = np.concatenate([slope, np.ones((len(slope), 1))], axis=1)
    world = np.einsum("nij,kj->nki", pose[:, :3, :3], direction)
    origin = np.broadcast_to(pose[:, None, :3, 3], world.shape)
    distance, face = renderer.faces(origin.reshape(-1, 3), world.reshape(-1, 3))
    # Along the axis, in which the directions have length 1.
    depth = distance.reshape(world.shape[:2]) / np.linalg.norm(direction, axis=1)
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float64)
    point = origin + depth[..., None] * world
    position = pose[:, :3, 3]
    shows = np.isfinite(depth).any(axis=1)
    # Terrain between the rays.
    shows[~shows] = shows_terrain(scene, pose[~shows])
    return Prospect(
        frames=len(times_s), rate_hz=rate_hz, index=index, time_s=time_s, position=position,
        above_ground_m=position[:, 2] - np.asarray(scene.ground(position[:, 0], position[:, 1]), np.float64),
        outline=_outermost(point[:, 1:, :2]), shows_terrain=shows,
        pixel_m=_over(np.median, depth) / camera.focal_length_px,
        motion_px=_motion(trajectory, camera, time_s, point), texel_m=scene.texel_m,
        memory_s=camera.memory_s, memory="integration time" if camera.well_electrons else "time constant",
        length_m=float(np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1).sum()),
        backs=_backs(scene, world.reshape(-1, 3), face), notes=renderer.outlook(pose),
    )  # fmt: skip


def _backs(scene: "Scene", direction: Floats, face: NDArray[np.int64]) -> float:
    """Share of rays (N, 3) that meet the back of a face (N,), −1 for none, of those that meet one; 0 without any."""
    first, behind = 0, 0
    for surface in scene.surfaces:
        own = np.flatnonzero((face >= first) & (face < first + len(surface.faces)))
        # Faces of copies stand for others.
        if surface.instances is None:
            a, b, c = np.moveaxis(surface.vertices[surface.faces[face[own] - first]], 1, 0)
            behind += int((np.einsum("ni,ni->n", np.cross(b - a, c - a), direction[own]) > 0.0).sum())
        first += len(surface.faces)
    return behind / max(int((face >= 0).sum()), 1)


def _slopes(camera: "Camera") -> Floats:
    """Slopes (1 + K, 2) of rays: the middle of the image, then along lines to points of its border, outermost last."""
    side, zero = np.arange(_SIDE) / _SIDE, np.zeros(_SIDE)
    edge = np.concatenate([[side, zero], [zero + 1.0, side], [1.0 - side, zero + 1.0], [zero, 1.0 - side]], axis=1)
    share = np.arange(1, _ALONG + 1)[:, None, None] / _ALONG
    place = np.concatenate([[[0.5, 0.5]], (0.5 + share * (edge.T - 0.5)).reshape(-1, 2)])
    return camera.directions(place * (camera.width, camera.height))


def _outermost(point: Floats) -> Floats:
    """The outermost known point (N, 4 · _SIDE, 2) of each line of points (N, K, 2); NaN without one."""
    lines = point.reshape(len(point), _ALONG, 4 * _SIDE, 2)
    found = lines[:, 0]
    for further in lines.transpose(1, 0, 2, 3)[1:]:
        found = np.where(np.isfinite(further), further, found)
    return found


def _motion(trajectory: Trajectory, camera: "Camera", time_s: Floats, point: Floats) -> Floats:
    """Motion of the points (N, K, 3) of each frame within a time constant [px]; NaN where unknown."""
    found = np.full(len(time_s), np.nan)
    first, last = trajectory.span_s
    step = camera.memory_s
    late = time_s + step > last
    for chosen, shift in ((~late, step), (late & (time_s - step >= first), -step)):
        if not chosen.any():
            continue
        pixel = []
        for at in (time_s[chosen], time_s[chosen] + shift):
            pose = trajectory.sampled(at).poses()
            own = np.einsum("nji,nkj->nki", pose[:, :3, :3], point[chosen] - pose[:, None, :3, 3])
            pixel.append(camera.project(own))
        found[chosen] = _over(lambda one: np.percentile(one, _MOTION), np.linalg.norm(pixel[1] - pixel[0], axis=-1))
    return found


def _over(function: Any, values: Floats) -> Floats:
    """A function of the known values of each row (N, K); NaN for a row without one."""
    return np.array([function(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in values])


def _three(values: Floats) -> list[float] | None:
    """[min, median, max] of the known values; None without one."""
    known = values[np.isfinite(values)]
    return [_rounded(float(of(known))) for of in (np.min, np.median, np.max)] if known.size else None


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")


def _range(values: Floats, unit: str) -> str:
    found = _three(values)
    if found is None:
        return "unknown"
    low, middle, high = found
    return f"{middle:.3g} {unit} in the median ({low:.3g}–{high:.3g} {unit})"
