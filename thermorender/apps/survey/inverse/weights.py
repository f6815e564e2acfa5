"""The forward model of a frame: each pixel as a weighted sum of the texels of a map, and its change with the pose.

A ray through a pixel's middle meets a face of the terrain. On the plane of that face, the position on the map is an
affine function of the ray, so the pixel's area, the blur of the lens and a small motion of the camera need no more

"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Camera, Scene
from thermorender.errors import ThermorenderError
from thermorender.scene.raster import Grid
from thermorender.sensor.psf import blur_of, blurred, otf

if TYPE_CHECKING:
    from thermorender import Renderer

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
# Pixels with a longer side on the map are left out [texels]: the taps would miss texels between them.
LONGEST_TEXELS = 4.0
# Rays that meet a face at a smaller cosine are left out: an error of the surface model moves them too far.
_STEEPEST = 0.15
# Relative difference up to which a texel is a whole number of the scene's texels.
_SAME = 0.01
# Pixels closer to the map's edge are left out [texels], so that all of their taps are on it.
_MARGIN = 2.0 * LONGEST_TEXELS
# Pixels this close to an object are left out [px].
_BESIDE_PX = 3
# Frequency at which the taps have the transfer of lens and pixel [cycles per pixel].
_MATCHED = 0.25


@dataclass(frozen=True)
class Lattice:
    """The texels of a map: squares of the scene's texel grid, enlarged, and cut to a window."""

    grid: Grid  # Coordinate reference system, transform and size of the map
    scene_texels: float  # Side of a texel of the map in texels of the scene
    # row, column: First row and column of the window, in texels of the map from the corner of the scene's grid
    row: int
    column: int
    texel_m: float  # Side of a texel on the ground [m]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the map."""
        return self.grid.height, self.grid.width

    @classmethod
    def of(cls, scene: Scene, texel_m: float) -> "Lattice":
        """Return the Lattice of all of a scene's terrain."""
        if scene.grid is None or scene.terrain_count != 1:
            raise ThermorenderError(
                f"{scene.where}: a map of temperatures needs terrain from an elevation raster and no far ground; make "
                "the scene with `thermorender import-terrain` and leave terrain.far out"
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


def _means(first: int, count: int, side: float, most: int) -> Any:
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


def taps_of(side: int = 2) -> Floats:
    """Return the offsets (side², 2) [px] of points that are spread evenly over a pixel."""
    if side < 1:
        raise ThermorenderError(f"taps={side!r} is not allowed; give the points along a side of a pixel, 1 or more")
    line = (np.arange(side) + 0.5) / side - 0.5
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


@lru_cache(maxsize=16)
def reach_px(camera: Camera) -> float:
    """Return the spacing [px] of three taps 1/6, 2/3, 1/6 that have a pixel's transfer at half the Nyquist frequency.

    One frequency stands for the width, because diffraction has no finite variance.
    """
    transfer = float(otf(camera, np.array([_MATCHED]))[0]) * float(np.sinc(_MATCHED))
    return float(np.arccos(np.clip(3.0 * transfer - 2.0, -1.0, 1.0))) / (2.0 * np.pi * _MATCHED)


def bilinear(values: Floats, row: NDArray[np.floating], column: NDArray[np.floating]) -> Floats:
    """Return a map's values at positions (N,) [texels]."""
    width, line = values.shape[1], values.ravel()
    i, j = row.astype(np.int64), column.astype(np.int64)
    below, beside = row - i, column - j
    cell = i * width + j
    upper = line.take(cell)
    upper += beside * (line.take(cell + 1) - upper)
    cell += width
    lower = line.take(cell)
    lower += beside * (line.take(cell + 1) - lower)
    return upper + below * (lower - upper)


@dataclass(frozen=True, eq=False)
class Sight:
    """The pixels of a frame that show the map, N of them."""

    pixel: NDArray[np.int64]  # (N,) int64 numbers in the image, row by row
    # row, column: (N,) float64 positions of their middles on the map [texels]; the middle of texel i is at i
    row: Floats
    column: Floats
    # across, down: (2, N) float32 change of (column, row) with a step of one pixel to the right, and down [texels]
    across: Singles
    down: Singles
    slope: Singles  # (2, 3, N) float32 change of (column, row) with the position of the camera [texels/m]
    ray: Singles  # (3, N) float32 from the camera to the points [m]

    def motion(self, right: Floats, down: Floats) -> Floats:
        """Return the change of map values with the pose, (6, N): per metre, then per radian about the axes.

        `right` and `down` (N,) are their changes along the map's columns and rows.
        """
        x, y, z = (right * a + down * b for a, b in zip(*self.slope, strict=True))
        east, north, up = self.ray
        return np.stack([x, y, z, north * z - up * y, up * x - east * z, east * y - north * x])

    def at(self, values: Floats, offset: Floats | None = None) -> Floats:
        """Return a map's values at the middles, bilinear, (N,); `offset` (2,) [px] moves them in the image."""
        row, column = self.row, self.column
        if offset is not None:
            moved = offset[0] * self.across + offset[1] * self.down
            column, row = column + moved[0], row + moved[1]
        return bilinear(values, row, column)

    def seen(self, values: Floats, taps: Floats) -> Floats:
        """Return a map's values in front of the lens, (N,): means over the taps (n, 2) of each pixel."""
        return np.asarray(sum(self.at(values, offset if offset.any() else None) for offset in taps) / len(taps))

    def chosen(self, which: NDArray[np.bool_]) -> "Sight":
        """Return the Sight of some of the pixels."""
        kept = np.flatnonzero(which)
        return Sight(*(values.take(kept, axis=-1) for values in vars(self).values()))


class Viewer:
    """The forward model of one camera over one scene: `sight` casts a frame's rays."""

    def __init__(self, renderer: "Renderer", camera: Camera, lattice: Lattice) -> None:
        self.renderer, self.camera, self.lattice = renderer, camera, lattice
        self._casting = threading.Lock()
        self._blur = blur_of(camera) if camera.diffraction or camera.defocus_um or camera.blur_sigma_px else None
        self._terrain = sum(len(surface.faces) for surface in renderer.scene.surfaces[: renderer.scene.terrain_count])
        own = renderer.face_maps[: self._terrain].astype(np.float64) / lattice.scene_texels
        own[:, 0, 3] -= lattice.column + 0.5
        own[:, 1, 3] -= lattice.row + 0.5
        normal = np.cross(own[:, 0, :3], own[:, 1, :3])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        # Gradient and offset of the column, then of the row, then the normal; one line for each number.
        self._faces = np.concatenate([own.reshape(-1, 8), normal], axis=1).T.astype(np.float32).copy()
        row, column = np.divmod(np.arange(camera.height * camera.width), camera.width)
        middle = np.stack([column, row], axis=-1) + 0.5
        slopes = camera.directions(middle)
        self._direction = np.concatenate([slopes, np.ones((len(middle), 1))], axis=1)
        self._length = np.linalg.norm(self._direction, axis=1).astype(np.float32)
        # Change of the slopes with a step of a pixel, (2, N) each.
        self._steps = [
            2.0 * (camera.directions(middle + step) - camera.directions(middle - step)).T.astype(np.float32)
            for step in 0.25 * np.eye(2)
        ]

    def sight(self, pose: Floats) -> Sight:
        """Return the Sight of a frame taken from a pose, (4, 4) world_from_camera."""
        turn, origin = pose[:3, :3].astype(np.float32), pose[:3, 3]
        direction = self._direction @ pose[:3, :3].T
        with self._casting:
            distance, face = self.renderer.faces(np.broadcast_to(origin, direction.shape), direction)
        pixel = np.flatnonzero(self._apart((face >= 0) & (face < self._terrain), face >= self._terrain))
        way = direction[pixel].T.astype(np.float32)
        length = self._length[pixel]
        depth = distance[pixel] / length
        own = self._faces.take(face[pixel], axis=1)
        normal = own[8:]
        slant = _product(normal, way)
        clear = np.abs(slant) > _STEEPEST * length
        inverse = 1.0 / np.where(clear, slant, 1.0)
        to = depth * way
        place, slope = [], []
        for part in (own[:4], own[4:8]):
            # A moved ray still ends on the plane, so a motion along the ray changes nothing.
            slope.append(part[:3] - _product(part[:3], way) * inverse * normal)
            start = part[0] * origin[0] + part[1] * origin[1] + part[2] * origin[2] + part[3]
            place.append(start + _product(part[:3], to))
        # Changes with the slopes of the ray in camera axes, for column and row.
        by_slope = [[depth * (axis @ part) for axis in turn.T[:2]] for part in slope]
        across, down = (
            np.stack([a * step[0][pixel] + b * step[1][pixel] for a, b in by_slope]) for step in self._steps
        )
        (column, row), (height, width) = place, self.lattice.shape
        side = np.maximum(_product(across, across), _product(down, down))
        clear &= (side < LONGEST_TEXELS**2) & (np.abs(row - 0.5 * height) < 0.5 * height - _MARGIN)
        clear &= np.abs(column - 0.5 * width) < 0.5 * width - _MARGIN
        found = Sight(pixel, row, column, across, down, np.stack(slope), to)
        return found if clear.all() else found.chosen(clear)

    def imaged(self, sight: Sight, values: Floats, taps: Floats, around: NDArray[np.floating]) -> Floats:
        """Return a map's values as the pixels of a Sight measure them, (N,): `Sight.seen`, blurred by the lens.

        `around` (H, W) is used outside the map, such as for sky and objects; NaN there is the median.
        """
        image = np.array(around, np.float32).ravel()
        if not np.isfinite(image).all():
            image[~np.isfinite(image)] = np.nanmedian(image)
        image[sight.pixel] = sight.seen(values, taps)
        made = blurred(image.reshape(self.camera.height, self.camera.width), self._blur)
        return np.asarray(made.ravel()[sight.pixel], np.float64)

    def _apart(self, ground: NDArray[np.bool_], objects: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Pixels of the ground that are not beside an object, of which the blur carries a part into them."""
        if not objects.any():
            return ground
        from scipy.ndimage import binary_dilation

        shape = self.camera.height, self.camera.width
        return ground & ~binary_dilation(objects.reshape(shape), iterations=_BESIDE_PX).ravel()


def binned(image: NDArray[np.floating], factor: int) -> Floats:
    """Return means over squares of `factor` pixels, NaN where one of them is unknown; rest rows and columns go."""
    height, width = (side // factor * factor for side in image.shape)
    parts = np.asarray(image[:height, :width], np.float64)
    return np.asarray(parts.reshape(height // factor, factor, width // factor, factor).mean(axis=(1, 3)))


def binned_camera(camera: Camera, factor: int) -> Camera:
    """Return the Camera of images after `binned`."""
    if factor == 1:
        return camera
    width, height = camera.width // factor, camera.height // factor
    # Rows and columns that are left over move the middle.
    lost = (camera.width - width * factor, camera.height - height * factor)
    across, along = ((own + 0.5 * gone) / factor for own, gone in zip(camera.principal_offset_px, lost, strict=True))
    return replace(
        camera, width=width, height=height, pixel_pitch_um=camera.pixel_pitch_um * factor,
        principal_offset_px=(across, along), blur_sigma_px=camera.blur_sigma_px / factor,
    )  # fmt: skip


def window_of(lattice: Lattice, viewer: Viewer, poses: Sequence[Floats], margin_m: float) -> tuple[Lattice, list[int]]:
    """Return (the part of a lattice that frames show, with a margin [m]; numbers of the frames that show nothing).

    The viewer may have a coarser lattice of the same terrain.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    blind = []
    for number, pose in enumerate(poses):
        sight = viewer.sight(pose)
        if not sight.pixel.size:
            blind.append(number)
        else:
            place = np.stack([sight.row, sight.column])
            low, high = np.minimum(low, place.min(axis=1)), np.maximum(high, place.max(axis=1))
    if not np.isfinite(low).all():
        raise ThermorenderError(
            f"no frame shows the scene's terrain in texels of {lattice.texel_m:g} m; check positions and angles (pitch "
            "−90 looks down, latitude comes before longitude), and give texels of at least a quarter of a pixel on the "
            "ground and at most a twentieth of the terrain's side"
        )
    margin, larger = margin_m / lattice.texel_m + 2.0, viewer.lattice.scene_texels / lattice.scene_texels
    # Positions count from the middle of the first texel, and edges from its corner.
    top, left = np.floor((low - 0.5) * larger - margin).astype(int)
    bottom, right = np.ceil((high + 1.5) * larger + margin).astype(int)
    return lattice.cut(int(top), int(left), int(bottom), int(right)), blind


def _product(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.einsum("kn,kn->n", a, b))


def moved(pose: Floats, step: Floats) -> Floats:
    """Return a pose after a step (6,): metres along the axes, then a rotation vector about the axes [rad]."""
    from scipy.spatial.transform import Rotation

    result = pose.copy()
    result[:3, 3] += step[:3]
    result[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    return result


def texel_means(values: Floats, side: float) -> Floats:
    """Return the means (h, w) of a bilinear map over the scene's texels in each of its texels.

    `side` is a texel's side in texels of the scene: for 1, the mean is the value at the centre; for a fraction, the
    integral over the texel.
    """
    from scipy.ndimage import convolve1d

    line = texel_line(side)
    return np.asarray(convolve1d(convolve1d(values, line, axis=0, mode="nearest"), line, axis=1, mode="nearest"))


def texel_line(side: float) -> Floats:
    """Return the weights (3,) of the middles of three texels in a row in the mean of `texel_means`."""
    count, away = max(round(side), 1), 0.25
    if abs(side - count) < _SAME or side < 1.0:
        away = float(np.abs((np.arange(count) + 0.5) / count - 0.5).mean())
    return np.array([0.5 * away, 1.0 - away, 0.5 * away])


def sharpened(step: Floats, reach: float, terms: int) -> Floats:
    """Return a step of the map (h, w) after the first `terms` of the deconvolution 1 + (1 − B) + (1 − B)² + ….

    B is the blur of a pixel with outer taps `reach` texels away. A transfer b leaves (1 − b)^terms.
    """
    total, rest = step.copy(), step
    for _ in range(terms - 1):
        rest = rest - softened(rest, reach)
        total += rest
    return total


def softened(values: Floats, reach: float) -> Floats:
    """Return a map (h, w) after the blur of lens and pixel, whose outer taps are `reach` [texels] away."""
    from scipy.ndimage import convolve1d

    whole = int(reach)
    line = np.zeros(2 * whole + 3)
    for side in (-1, 1):
        for at, share in ((whole, whole + 1.0 - reach), (whole + 1, reach - whole)):
            line[whole + 1 + side * at] += share / 6.0
    line[whole + 1] += 2.0 / 3.0
    return np.asarray(convolve1d(convolve1d(values, line, axis=0), line, axis=1))
