"""The forward model of a frame: each pixel as a weighted sum of the texels of a map, and its change with the pose.

A ray through a pixel's middle meets a face of the terrain. On the plane of that face, the position on the map is an
affine function of the ray, so the pixel's area, the blur of the lens and a small motion of the camera need no more
rays. A pixel is the mean of several taps round its middle, and each tap is bilinear between four texels.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from thermorender.errors import ThermorenderError
from thermorender.scene.raster import Grid
from thermorender.scene.scene import Scene
from thermorender.sensor.camera import Camera

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer

Floats = NDArray[np.float64]
# Pixels with a longer side on the map are left out [texels]: the taps would miss texels between them.
LONGEST_TEXELS = 4.0
# Rays that meet a face at a smaller cosine are left out: an error of the surface model moves them too far.
_STEEPEST = 0.15
# Relative difference up to which a texel is a whole number of the scene's texels.
_SAME = 0.01
# Frequency at which the taps have the transfer of lens and pixel [cycles per pixel].
_MATCHED = 0.25


@dataclass(frozen=True)
class Lattice:
    """The texels of a map: squares of the scene's texel grid, enlarged, and cut to a window.

    Attributes
    ----------
    grid : Grid
        Coordinate reference system, transform and size of the map.
    scene_texels : float
        Side of a texel of the map in texels of the scene.
    row, column : int
        First row and column of the window, in texels of the map from the corner of the scene's grid.
    texel_m : float
        Side of a texel on the ground [m].
    """

    grid: Grid
    scene_texels: float
    row: int
    column: int
    texel_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the map."""
        return self.grid.height, self.grid.width

    @classmethod
    def of(cls, scene: Scene, texel_m: float) -> "Lattice":
        """Return the Lattice of all of a scene's terrain.

        Raises
        ------
        ThermorenderError
            The scene's terrain is not a raster with a coordinate reference system, or the size is not allowed.
        """
        if scene.grid is None or scene.terrain_count != 1:
            raise ThermorenderError(
                f"{scene.where}: a map of temperatures needs terrain from an elevation raster; make the scene with "
                "`thermorender import-terrain`"
            )
        if not (np.isfinite(texel_m) and texel_m > 0.0):
            raise ThermorenderError(f"texel_m={texel_m!r} is not allowed; give the side of a texel in metres, above 0")
        scale = texel_m / scene.surfaces[0].texel_m
        # The scale of a map projection makes the scene's own size odd.
        if abs(scale / max(round(scale), 1) - 1.0) < _SAME:
            scale = max(round(scale), 1)
        height, width = (int(np.ceil(side / scale - 1e-9)) for side in scene.surfaces[0].material.shape)
        transform = scene.grid.transform @ _scaling(scale)
        return cls(Grid(scene.grid.crs, transform, height, width), scale, 0, 0, texel_m)

    def cut(self, top: int, left: int, bottom: int, right: int) -> "Lattice":
        """Return the window of these rows and columns, which are limited to the map."""
        top, left = max(top, 0), max(left, 0)
        bottom, right = min(bottom, self.grid.height), min(right, self.grid.width)
        transform = self.grid.transform @ _shift(left, top)
        grid = Grid(self.grid.crs, transform, bottom - top, right - left)
        return replace(self, grid=grid, row=self.row + top, column=self.column + left)

    def of_scene(self, values: NDArray[np.floating]) -> Floats:
        """Return means over the map's texels of values on the scene's texels, (h, w), by areas."""
        row = _means(self.row, self.shape[0], self.scene_texels, values.shape[0])
        column = _means(self.column, self.shape[1], self.scene_texels, values.shape[1])
        return np.asarray((column @ (row @ np.asarray(values, np.float64)).T).T)

    def middles(self, shape: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return (rows, columns) of the scene's texels, of which there are `shape`, at the middles of the map's."""
        found = [
            np.clip(((first + np.arange(count) + 0.5) * self.scene_texels).astype(np.intp), 0, most - 1)
            for first, count, most in zip((self.row, self.column), self.shape, shape, strict=True)
        ]
        return found[0], found[1]


def _scaling(factor: float) -> object:
    from rasterio import Affine

    return Affine.scale(factor)


def _shift(columns: float, rows: float) -> object:
    from rasterio import Affine

    return Affine.translation(columns, rows)


def _means(first: int, count: int, side: float, most: int):  # type: ignore[no-untyped-def]
    """The sparse matrix (count, most) of means over stretches of `side` texels."""
    from scipy.sparse import csr_matrix

    edge = np.minimum((first + np.arange(count + 1)) * side, most)
    rows, columns, weights = [], [], []
    for number, (start, stop) in enumerate(zip(edge[:-1], edge[1:], strict=True)):
        inside = np.arange(int(start), max(int(np.ceil(stop - 1e-9)), int(start) + 1)).clip(0, most - 1)
        share = np.minimum(inside + 1.0, stop) - np.maximum(inside, start)
        share = np.maximum(share, 1e-12)
        rows.append(np.full(len(inside), number))
        columns.append(inside)
        weights.append(share / share.sum())
    parts = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    return csr_matrix(parts, shape=(count, most))


def taps_of(camera: Camera, count: int = 5) -> tuple[Floats, Floats]:
    """Return (offsets (n, 2) [px], weights (n,)) of points whose mean stands for a pixel's response.

    The response is the mean over the pixel's area after the blur of the lens. `count` is 1 (the middle alone), 5 (a
    cross) or 9 (a square).
    """
    if count == 1:
        return np.zeros((1, 2)), np.ones(1)
    reach, sixth = _reach_px(camera), 1.0 / 6.0
    line, share = np.array([-reach, 0.0, reach]), np.array([sixth, 1.0 - 2.0 * sixth, sixth])
    if count == 9:
        grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        return grid, np.outer(share, share).ravel()
    if count != 5:
        raise ThermorenderError(f"taps={count!r} is not allowed; give 1, 5 or 9")
    cross = np.array([[0.0, 0.0], [-reach, 0.0], [reach, 0.0], [0.0, -reach], [0.0, reach]])
    return cross, np.array([1.0 - 4.0 * sixth, sixth, sixth, sixth, sixth])


@lru_cache(maxsize=16)
def _reach_px(camera: Camera) -> float:
    """Distance of the outer taps [px]: three in a row have the response's transfer at half the Nyquist frequency.

    Diffraction has no finite variance, so the transfer at one frequency stands for the width.
    """
    from thermorender.sensor.psf import otf

    transfer = float(otf(camera, np.array([_MATCHED]))[0]) * float(np.sinc(_MATCHED))
    return float(np.arccos(np.clip(3.0 * transfer - 2.0, -1.0, 1.0))) / (2.0 * np.pi * _MATCHED)


@dataclass(frozen=True, eq=False)
class Sight:
    """The pixels of a frame that show the map, N of them.

    Attributes
    ----------
    pixel : (N,) int64
        Numbers in the image, row by row.
    row, column : (N,) float64
        Positions of their middles on the map [texels]; the middle of texel i is at i.
    across, down : (N, 2) float64
        Change of (column, row) with a step of one pixel to the right, and down [texels].
    slope : (N, 2, 3) float64
        Change of (column, row) with the position of the camera [texels/m].
    turned : (N, 3) float64
        Vectors from the camera to the points [m].
    """

    pixel: NDArray[np.int64]
    row: Floats
    column: Floats
    across: Floats
    down: Floats
    slope: Floats
    turned: Floats

    def motion(self) -> Floats:
        """Return the change of (column, row) with the pose, (N, 2, 6): per metre, then per radian about the axes."""
        turn = np.cross(self.turned[:, None, :], self.slope)
        return np.concatenate([self.slope, turn], axis=-1)

    def at(self, values: Floats, offset: Floats | None = None) -> Floats:
        """Return a map's values at the middles, bilinear, (N,); `offset` (2,) [px] moves them in the image."""
        row, column = self.row, self.column
        if offset is not None:
            moved = offset[0] * self.across + offset[1] * self.down
            column, row = column + moved[:, 0], row + moved[:, 1]
        return np.asarray(map_coordinates(values, [row, column], order=1, mode="nearest"))

    def seen(self, values: Floats, taps: tuple[Floats, Floats]) -> Floats:
        """Return a map's values as the pixels see them, (N,): means over the taps."""
        total = np.zeros(len(self.row))
        for offset, weight in zip(*taps, strict=True):
            total += weight * self.at(values, offset)
        return total


class Viewer:
    """The forward model of one camera over one scene: `sight` casts a frame's rays.

    Parameters
    ----------
    renderer : Renderer
    camera : Camera
    lattice : Lattice
    """

    def __init__(self, renderer: "Renderer", camera: Camera, lattice: Lattice) -> None:
        self.renderer, self.camera, self.lattice = renderer, camera, lattice
        self._maps = renderer.face_maps
        self._terrain = sum(len(surface.faces) for surface in renderer.scene.surfaces[: renderer.scene.terrain_count])
        row, column = np.divmod(np.arange(camera.height * camera.width), camera.width)
        middle = np.stack([column, row], axis=-1) + 0.5
        self._direction = _rays(camera, middle)
        step = 0.25 * np.eye(2)
        self._across, self._down = (
            2.0 * (_rays(camera, middle + each) - _rays(camera, middle - each)) for each in step
        )

    def on(self, lattice: Lattice) -> "Viewer":
        """Return this Viewer on another map of the same scene."""
        other = object.__new__(Viewer)
        vars(other).update(vars(self), lattice=lattice)
        return other

    def sight(self, pose: Floats) -> Sight:
        """Return the Sight of a frame taken from a pose, (4, 4) world_from_camera."""
        turn, origin = pose[:3, :3], pose[:3, 3]
        direction = self._direction @ turn.T
        length = np.linalg.norm(direction, axis=1)
        distance, face = self.renderer.faces(np.broadcast_to(origin, direction.shape), direction)
        hit = (face >= 0) & (face < self._terrain)
        chosen, direction, length = np.flatnonzero(hit), direction[hit], length[hit]
        depth, own = distance[hit] / length, self._maps[face[hit]].astype(np.float64)
        gradient, offset = own[:, :, :3], own[:, :, 3]
        normal = np.cross(gradient[:, 0], gradient[:, 1])
        size = np.linalg.norm(normal, axis=1)
        slant = np.einsum("nk,nk->n", normal, direction)
        clear = np.abs(slant) > _STEEPEST * size * length
        to = depth[:, None] * direction
        place = np.einsum("nak,nk->na", gradient, origin + to) + offset
        # A moved ray still ends on the plane, so a motion along the ray changes nothing.
        along = np.einsum("nak,nk->na", gradient, direction) / np.where(clear, slant, 1.0)[:, None]
        slope = gradient - along[:, :, None] * normal[:, None, :]
        across, down = (
            depth[:, None] * np.einsum("nak,nk->na", slope, step[chosen] @ turn.T)
            for step in (self._across, self._down)
        )
        scale, lattice = 1.0 / self.lattice.scene_texels, self.lattice
        column, row = (place * scale - (lattice.column + 0.5, lattice.row + 0.5)).T
        side = scale * np.sqrt(np.maximum((across**2).sum(axis=1), (down**2).sum(axis=1)))
        height, width = lattice.shape
        clear &= (side < LONGEST_TEXELS) & (row > 0.0) & (row < height - 1.0) & (column > 0.0) & (column < width - 1.0)
        return Sight(
            chosen[clear], row[clear], column[clear], scale * across[clear], scale * down[clear],
            scale * slope[clear], to[clear],
        )  # fmt: skip


def _rays(camera: Camera, pixel: Floats) -> Floats:
    """Directions (n, 3) of image positions (n, 2), with depth 1."""
    return np.concatenate([camera.directions(pixel), np.ones((len(pixel), 1))], axis=1)


def moved(pose: Floats, step: Floats) -> Floats:
    """Return a pose after a step (6,): metres along the axes, then a rotation vector about the axes [rad]."""
    from scipy.spatial.transform import Rotation

    result = pose.copy()
    result[:3, 3] += step[:3]
    result[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    return result
