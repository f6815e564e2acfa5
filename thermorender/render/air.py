"""The medium between camera and surfaces: the scene's air, or vacuum.

A path from a given camera is determined by its length and the altitude of its end. For each camera position the air is
computed on a small grid of both, as wide as the scene requires: the weights of the texels' channels and the path
radiance. Rays interpolate in this grid. Rays that hit nothing look up sky and surroundings by zenith angle; where the
horizon crosses a ray's cell, both are averaged by area.
"""

from collections.abc import Callable

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from thermorender.atmosphere.model import HIGHEST_CAMERA_M, LOWEST_M, Atmosphere
from thermorender.atmosphere.rays import EARTH_RADIUS_M, MEAN_RADIUS_M, horizon_cos_zenith
from thermorender.errors import ThermorenderError
from thermorender.render.arrays import Floats, Jit, Mitsuba, aligned
from thermorender.render.geometry import Hit
from thermorender.render.pixels.footprint import Climb
from thermorender.render.spectrum import Spectrum
from thermorender.scene.scene import Scene
from thermorender.scene.surface import over_round_earth

# Largest ratio of successive path lengths in a grid, fewest lengths, and largest step in altitude [m].
_GROWTH = 1.08
_FEWEST = 4
_ALTITUDE_M = 100.0
# Zenith angles of the background, below and above the horizon and densest there; with the steps
# of rays, the sky from 120 m errs by less than 20 mK.
_BACKGROUND = 64
# The background is computed at heights in geometric steps from the lowest [m]; number of heights kept.
_LOWEST_M, _STEP, _KEPT = 0.1, 1.03, 16


def refuse_camera(scene: Scene, positions: ArrayLike) -> None:
    """Raise for cameras at local positions (..., 3) outside the range of the scene's air or above its clouds."""
    if scene.air is None:
        return
    heights = altitude(positions, scene.altitude_m)
    camera = float(np.max(heights))
    scene.air.refuse_above_clouds("pose: the camera", camera)
    lowest = float(np.min(heights))
    if camera > HIGHEST_CAMERA_M or lowest < LOWEST_M:
        outside = lowest if lowest < LOWEST_M else camera
        raise ThermorenderError(
            f"pose: the camera is {outside:.0f} m above sea level, outside the range of the air; give "
            f"−{-LOWEST_M:.0f} … {HIGHEST_CAMERA_M:.0f} m"
        )


class Vacuum:
    """No air: channels arrive unchanged. `sky` and `background` (C,) are seen by rays that hit nothing."""

    horizon = 0.0

    def __init__(self, mi: Mitsuba, sky: Floats, background: Floats) -> None:
        rows = (sky, background)
        self._sky, self._background = ([dr.opaque(mi.Float, float(value)) for value in row] for row in rows)

    def at_camera(
        self, hit: Hit, values: list[Jit], origin: Jit, direction: Jit, climb: Climb | None = None
    ) -> list[Jit]:
        """Return the radiance at the camera, [Float], from the channels at the points hit; with `climb`, misses average
        their cells."""
        outside = zip(self._sky, self._background, strict=True)
        if climb is None:
            behind = [dr.select(direction.z >= 0.0, sky, background) for sky, background in outside]
        else:
            share, *_ = climb.parts(self.horizon)
            behind = [dr.lerp(background, sky, share) for sky, background in outside]
        return [dr.select(hit.valid, value, other) for value, other in zip(values, behind, strict=True)]


class SceneAir:
    """The air of a scene, which makes views of single camera positions."""

    def __init__(self, mi: Mitsuba, scene: Scene, spectrum: Spectrum) -> None:
        assert scene.air is not None
        self._mi, self._air, self._solver = mi, scene.air, spectrum.solver
        self._altitude_m, self._background_k = scene.altitude_m, scene.surroundings_temperature
        # Far ground lies on the Earth with refraction.
        self._radius_m = EARTH_RADIUS_M if any(surface.on_round_earth for surface in scene.surfaces) else MEAN_RADIUS_M
        self._seen: dict[int, Floats] = {}
        self._last: tuple[bytes, AirView] | None = None

    def view(self, origin: Floats, box: Floats, low_m: float | None = None, clear: bool = False) -> "AirView":
        """Return the AirView from `origin` (3,) [m] to a `box` (2, 3) [m], cached; with `clear`, paths to surfaces have
        no air. Nothing in the box is below `low_m` over a round Earth [m], by default its lowest corner."""
        low_m = float(box[0, 2]) if low_m is None else low_m
        if clear:
            return self._view(origin, box, low_m, clear)
        # Read and replaced as a whole: another thread may render another view meanwhile.
        key, last = origin.tobytes() + box.tobytes(), self._last
        if last is None or last[0] != key:
            last = self._last = key, self._view(origin, box, low_m, clear)
        return last[1]

    def _view(self, origin: Floats, box: Floats, low_m: float, clear: bool) -> "AirView":
        base = self._altitude_m
        camera = float(altitude(origin, base))
        outside = np.maximum(np.maximum(box[0] - origin, origin - box[1]), 0.0)
        nearest = max(float(np.linalg.norm(outside)), 1.0)
        farthest = max(float(np.linalg.norm(np.abs(box - origin).max(axis=0))), 1.01 * nearest)
        corner = np.append(np.abs(box[:, :2]).max(axis=0), box[1, 2])
        limits = base + low_m, float(altitude(corner, base))

        def cells(passed: Floats, added: Floats) -> Floats:
            if clear:
                passed, added = np.ones_like(passed), np.zeros_like(added)
            return np.concatenate([passed @ self._solver, added.sum(axis=-1, keepdims=True)], axis=-1)

        grid = PathGrid(self._mi, self._air, camera, limits, (nearest, farthest), cells)
        horizon = float(horizon_cos_zenith(camera))
        return AirView(self._mi, grid, base, self._background(camera), horizon, self._radius_m)

    def _background(self, camera: float) -> Floats:
        """Band radiance of rays that hit nothing, (2, _BACKGROUND), interpolated between fixed altitudes."""
        height = max(camera - self._altitude_m, _LOWEST_M)
        lower = int(np.log(height / _LOWEST_M) / np.log(_STEP))
        level, both = [], []
        for number in (lower, lower + 1):
            level.append(min(_LOWEST_M * _STEP**number, self._air.ceiling_m - self._altitude_m))
            if number not in self._seen:
                if len(self._seen) >= _KEPT:
                    self._seen.pop(next(iter(self._seen)))
                at, parts = self._altitude_m + level[-1], np.linspace(0.0, 1.0, _BACKGROUND)
                self._seen[number] = background(self._air, at, self._altitude_m, self._background_k, parts)
            both.append(self._seen[number])
        share = (height - level[0]) / max(level[1] - level[0], 1e-6)
        return (1.0 - share) * both[0] + share * both[1]


class PathGrid:
    """Weights and path radiance of the paths from altitude `from_m` [m], by path length and altitude of the end.
    `limits` are the lowest and highest end [m], `lengths` the shortest and longest path [m]. `cells` returns (..., C)
    numbers from (transmittances, path radiances), each (..., n)."""

    def __init__(
        self, mi: Mitsuba, air: Atmosphere, from_m: float, limits: tuple[float, float], lengths: tuple[float, float],
        cells: Callable[[Floats, Floats], Floats],
    ) -> None:  # fmt: skip
        (low, high), (nearest, farthest) = limits, lengths
        columns = max(_FEWEST, 1 + int(np.ceil(np.log(farthest / nearest) / np.log(_GROWTH))))
        rows = 2 + int((high - low) / _ALTITUDE_M)
        length = np.geomspace(nearest, farthest, columns)
        # For each length, ends from the lowest to the highest point that it can reach.
        bottom, top = np.maximum(low, from_m - length), np.minimum(high, from_m + length)
        end = bottom + np.linspace(0.0, 1.0, rows)[:, None] * np.maximum(top - bottom, 0.0)
        end = np.clip(end, from_m - length, from_m + length)
        values = cells(*air.path(from_m, end, np.broadcast_to(length, end.shape)))
        self._mi, self._count = mi, values.shape[-1]
        padded = np.pad(values.reshape(-1, self._count), ((0, 0), (0, -self._count % 4))).astype(np.float32)
        self._groups = [mi.Float(aligned(padded[:, k : k + 4])) for k in range(0, self._count, 4)]
        frame = (low, high, from_m, np.log(nearest), (columns - 1) / np.log(farthest / nearest), columns, rows - 1)
        self._numbers = [dr.opaque(mi.Float, float(number)) for number in frame]

    def corners(self, distance: Jit, end: Jit, valid: Jit) -> list[tuple[Jit, list[Jit]]]:
        """Return [(weight, [Float]), …] of the grid points round paths, given by length and altitude of the end [m]."""
        mi = self._mi
        low, high, start, first, step, count, rows = self._numbers
        column = dr.clip((dr.log(distance) - first) * step, 0.0, count - 1.001)
        bottom, top = dr.maximum(low, start - distance), dr.minimum(high, start + distance)
        row = dr.clip((end - bottom) / dr.maximum(top - bottom, 1e-3), 0.0, 0.9999) * rows
        left, upper = dr.floor(column), dr.floor(row)
        across, down = column - left, row - upper
        cell, below = mi.UInt32(upper * count + left), mi.UInt32(count)
        found = []
        for index, weight in ((cell, (1 - across) * (1 - down)), (cell + 1, across * (1 - down)),
                              (cell + below, (1 - across) * down), (cell + below + 1, across * down)):  # fmt: skip
            parts = [value for group in self._groups for value in dr.gather(mi.Vector4f, group, index, valid)]
            found.append((weight, parts[: self._count]))
        return found


class AirView:
    """The air seen from one camera position: `grid` of the channels' weights and the path radiance, `base` altitude of
    the local origin [m], `background` (2, n), `horizon` cosine of its zenith angle."""

    def __init__(
        self, mi: Mitsuba, grid: PathGrid, base: float, background: Floats, horizon: float, radius_m: float
    ) -> None:  # fmt: skip
        self._mi, self._grid, self._base = mi, grid, dr.opaque(mi.Float, float(base))
        self._curvature = 0.5 / radius_m
        self._sky = mi.Float(aligned(background))
        self.horizon, self._horizon = horizon, dr.opaque(mi.Float, horizon)

    def at_camera(
        self, hit: Hit, values: list[Jit], origin: Jit, direction: Jit, climb: Climb | None = None
    ) -> list[Jit]:
        """Return the radiance at the camera, [Float]; `values` and `climb` as of `Vacuum.at_camera`."""
        mi = self._mi
        point = origin + hit.distance * direction
        end = self._base + point.z + self._curvature * (point.x * point.x + point.y * point.y)
        factors = [*values, 1.0]
        total = mi.Float(0.0)
        for weight, found in self._grid.corners(hit.distance, end, hit.valid):
            total += weight * sum(number * factor for number, factor in zip(found, factors, strict=True))
        if climb is None:
            behind = self._background_at(direction.z - self._horizon, ~hit.valid)
        else:
            behind = self._seen_background(climb, ~hit.valid)
        return [dr.select(hit.valid, total, behind)]

    def _seen_background(self, climb: Climb, active: Jit) -> Jit:
        """Mean band radiance over the cells of rays that hit nothing."""
        share, higher, lower = climb.parts(self._horizon)
        found = self._background_at(higher, active)
        split = (share > 0.0) & (share < 1.0)
        return dr.select(split, dr.lerp(self._background_at(lower, active & split), found, share), found)

    def _background_at(self, rise: Jit, active: Jit) -> Jit:
        """Band radiance at cosines of the zenith angle above the horizon's."""
        mi, half = self._mi, _BACKGROUND - 1
        # Two tables, below and then above the horizon, as from `background`.
        above = rise >= 0.0
        span = dr.select(above, 1.0 - self._horizon, 1.0 + self._horizon)
        position = dr.sqrt(dr.clip(dr.abs(rise) / span, 0.0, 1.0)) * (half * 0.9999)
        lower = mi.UInt32(position)
        index = lower + dr.select(above, _BACKGROUND, 0)
        a, b = (dr.gather(mi.Float, self._sky, index + k, active) for k in (0, 1))
        return dr.lerp(a, b, position - mi.Float(lower))


def altitude(points: ArrayLike, altitude_m: float, radius_m: float = MEAN_RADIUS_M) -> Floats:
    """Return the altitude above sea level [m] of points (..., 3) of the local frame, over a round Earth."""
    return altitude_m + over_round_earth(points, radius_m)


def horizon_of(scene: Scene, pose: Floats) -> float:
    """Return the cosine of the zenith angle of the horizon seen from a pose (4, 4): that of sea level through air, and
    of a plane without air."""
    if scene.air is None:
        return 0.0
    return float(horizon_cos_zenith(altitude(pose[:3, 3], scene.altitude_m)))


def background(air: Atmosphere, camera_m: float, ground_m: float, temperature: float, position: Floats) -> Floats:
    """Return the band radiance of rays that hit nothing, (2, n): below and above the horizon [W m⁻² sr⁻¹]. `ground_m`
    [m] and `temperature` [K] are of the black ground beyond the scene. `position` (n,) is the square root of |cos
    zenith − cos horizon|."""
    horizon = float(horizon_cos_zenith(camera_m))
    rise = np.square(position)
    sky = air.sky_radiance(camera_m, horizon + rise * (1.0 - horizon)).sum(axis=-1)
    # A chord of the sphere down to the ground, at most to the horizon.
    ground_m = min(ground_m, camera_m - 0.1)
    height, radius = camera_m - ground_m, EARTH_RADIUS_M + ground_m
    along = (radius + height) * (rise * (1.0 + horizon) - horizon)
    reach = np.square(along) - height * (2.0 * radius + height)
    length = along - np.sqrt(np.maximum(reach, 0.0))
    passed, added = air.path(camera_m, ground_m, np.maximum(length, height))
    return np.stack([passed @ air.planck(temperature) + added.sum(axis=-1), sky])
