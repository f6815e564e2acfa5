"""What a ray brings back from what it meets: through the air of one camera position, or through none.

A path from a given camera is told by its length and the altitude it ends at. For each position the air is computed
on a small grid of both, as wide as the scene can be from there: the weights of the texels' channels and the path
radiance. Rays look it up; rays that meet nothing look up sky and surroundings by their zenith angle.
"""

import drjit as dr
import numpy as np

from thermorender.atmosphere.model import HIGHEST_CAMERA_M, LOWEST_M
from thermorender.atmosphere.rays import EARTH_RADIUS_M, MEAN_RADIUS_M, horizon_cos_zenith
from thermorender.errors import ThermorenderError
from thermorender.render.geometry import aligned

# A grid's lengths grow by at most this factor from one to the next, and its altitudes are at most this far apart [m].
_GROWTH = 1.08
_FEWEST = 4
_ALTITUDE_M = 100.0
# Zenith angles of what lies beyond the surfaces, below and above the horizon; densest there. 5 mK of the sky from
# 120 m.
_BACKGROUND = 64
# Heights above the ground at which these are computed [m], each higher by a factor, and how many are kept.
_LOWEST_M, _STEP, _KEPT = 0.1, 1.03, 16


def refuse_camera(scene, positions):
    """Refuse cameras at positions (..., 3) of a scene's local frame that are above the range of its air, or clouds."""
    if scene.air is None:
        return
    heights = altitude(positions, scene.altitude_m)
    camera = float(np.max(heights))
    scene.air.refuse_above_clouds("pose: the camera", camera)
    lowest = float(np.min(heights))
    if camera > HIGHEST_CAMERA_M or lowest < LOWEST_M:
        outside = lowest if lowest < LOWEST_M else camera
        raise ThermorenderError(
            f"pose: the camera is {outside:.0f} m above sea level, out of range of the air; give −{-LOWEST_M:.0f} … "
            f"{HIGHEST_CAMERA_M:.0f} m"
        )


class Vacuum:
    """No air: channels arrive as they left, from sky and surroundings as they are.

    Parameters
    ----------
    mi : module
    sky, background : (C,) floats
        Channels of rays that meet nothing, above and below the horizon.
    """

    def __init__(self, mi, sky, background):
        rows = (sky, background)
        self._sky, self._background = ([dr.opaque(mi.Float, float(value)) for value in row] for row in rows)

    def at_camera(self, hit, values, origin, direction):
        """Return what rays bring back, a list of Float, of the channels `values` where they meet something."""
        up = direction.z >= 0.0
        return [
            dr.select(hit.valid, value, dr.select(up, sky, background))
            for value, sky, background in zip(values, self._sky, self._background, strict=True)
        ]


class Air:
    """The air of a scene, from which views of single camera positions are made.

    Parameters
    ----------
    mi : module
    scene : Scene
    spectrum : Spectrum
    """

    def __init__(self, mi, scene, spectrum):
        self._mi, self._air, self._solver = mi, scene.air, spectrum.solver
        self._altitude_m, self._background_k = scene.altitude_m, scene.surroundings_temperature
        self._seen = {}

    def view(self, origin, box, clear=False):
        """Return the AirView from a camera position.

        Parameters
        ----------
        origin : (3,) array
            In the scene's local frame [m].
        box : (2, 3) array
            Lowest and highest corner of all that can be met [m].
        clear : bool
            Whether the path to what is met lets all pass and shines not.
        """
        base = self._altitude_m
        camera = float(altitude(origin, base))
        outside = np.maximum(np.maximum(box[0] - origin, origin - box[1]), 0.0)
        nearest = max(float(np.linalg.norm(outside)), 1.0)
        farthest = max(float(np.linalg.norm(np.abs(box - origin).max(axis=0))), 1.01 * nearest)
        corner = np.append(np.abs(box[:, :2]).max(axis=0), box[1, 2])
        limits = base + box[0, 2], float(altitude(corner, base))

        def cells(passed, added):
            if clear:
                passed, added = np.ones_like(passed), np.zeros_like(added)
            return np.concatenate([passed @ self._solver, added.sum(axis=-1, keepdims=True)], axis=-1)

        grid = PathGrid(self._mi, self._air, camera, limits, (nearest, farthest), cells)
        horizon = float(horizon_cos_zenith(camera))
        return AirView(self._mi, grid, base, self._background(camera), horizon)

    def _background(self, camera):
        """Band radiance of rays that meet nothing, (2, _BACKGROUND), linear between altitudes of earlier views."""
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
    """Numbers of the paths from one altitude, by the length of a path and the altitude of its end.

    Parameters
    ----------
    mi : module
    air : Atmosphere
    from_m : float
        Altitude that paths begin at above sea level [m].
    limits : (2,) floats
        Lowest and highest altitude that they end at [m].
    lengths : (2,) floats
        Shortest and longest of them [m].
    cells : callable
        Returns (..., C) numbers of the (transmittances, path radiances) of paths, each (..., n).
    """

    def __init__(self, mi, air, from_m, limits, lengths, cells):
        (low, high), (nearest, farthest) = limits, lengths
        columns = max(_FEWEST, 1 + int(np.ceil(np.log(farthest / nearest) / np.log(_GROWTH))))
        rows = 2 + int((high - low) / _ALTITUDE_M)
        length = np.geomspace(nearest, farthest, columns)
        # At each length, from the lowest to the highest point at that distance.
        bottom, top = np.maximum(low, from_m - length), np.minimum(high, from_m + length)
        end = bottom + np.linspace(0.0, 1.0, rows)[:, None] * np.maximum(top - bottom, 0.0)
        end = np.clip(end, from_m - length, from_m + length)
        values = cells(*air.path(from_m, end, np.broadcast_to(length, end.shape)))
        self._mi, self._count = mi, values.shape[-1]
        padded = np.pad(values.reshape(-1, self._count), ((0, 0), (0, -self._count % 4))).astype(np.float32)
        self._groups = [mi.Float(aligned(padded[:, k : k + 4])) for k in range(0, self._count, 4)]
        frame = (low, high, from_m, np.log(nearest), (columns - 1) / np.log(farthest / nearest), columns, rows - 1)
        self._numbers = [dr.opaque(mi.Float, float(number)) for number in frame]

    def corners(self, distance, end, valid):
        """Return [(weight, [number (Float), …]), …] of the cells round paths of lengths and altitudes of their ends."""
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
    """The air seen from one camera position.

    Parameters
    ----------
    mi : module
    grid : PathGrid
        Of the weights of the channels and the path radiance, K + 1 numbers.
    base : float
        Altitude of the local frame's origin [m].
    background : (2, n) array
        As by `background`.
    horizon : float
        Cosine of the horizon's zenith angle.
    """

    def __init__(self, mi, grid, base, background, horizon):
        self._mi, self._grid, self._base = mi, grid, dr.opaque(mi.Float, float(base))
        self._sky = mi.Float(aligned(background))
        self._horizon = dr.opaque(mi.Float, horizon)

    def at_camera(self, hit, values, origin, direction):
        """Return what rays bring back, [Float], of the channels `values` where they meet something."""
        mi = self._mi
        point = origin + hit.distance * direction
        end = self._base + point.z + 0.5 / MEAN_RADIUS_M * (point.x * point.x + point.y * point.y)
        factors = [*values, 1.0]
        total = mi.Float(0.0)
        for weight, found in self._grid.corners(hit.distance, end, hit.valid):
            total += weight * sum(number * factor for number, factor in zip(found, factors, strict=True))
        return [dr.select(hit.valid, total, self._seen_background(direction.z, ~hit.valid))]

    def _seen_background(self, cosine, active):
        """What rays see that meet nothing."""
        mi, half = self._mi, _BACKGROUND - 1
        # Two tables one after the other, below and above the horizon, as `background` makes them.
        rise = cosine - self._horizon
        above = rise >= 0.0
        span = dr.select(above, 1.0 - self._horizon, 1.0 + self._horizon)
        position = dr.sqrt(dr.clip(dr.abs(rise) / span, 0.0, 1.0)) * (half * 0.9999)
        lower = mi.UInt32(position)
        index = lower + dr.select(above, _BACKGROUND, 0)
        a, b = (dr.gather(mi.Float, self._sky, index + k, active) for k in (0, 1))
        return dr.lerp(a, b, position - mi.Float(lower))


def altitude(points, altitude_m):
    """Return the altitude above sea level [m] of points (..., 3) of the local frame, over a round Earth."""
    points = np.asarray(points, dtype=np.float64)
    return altitude_m + points[..., 2] + np.square(points[..., :2]).sum(axis=-1) * (0.5 / MEAN_RADIUS_M)


def background(air, camera_m, ground_m, temperature, position):
    """Return the band radiance of rays that meet nothing, (2, n): below the horizon, and above it [W m⁻² sr⁻¹].

    Parameters
    ----------
    air : Atmosphere
    camera_m, ground_m : float
        Altitudes of the camera and of the black ground beyond the scene [m].
    temperature : float
        Of that ground [K].
    position : (n,) array
        Square roots of how far the cosine of the zenith angle lies from the horizon's, 0 there, 1 straight down or up.
    """
    horizon = float(horizon_cos_zenith(camera_m))
    rise = np.square(position)
    sky = air.sky_radiance(camera_m, horizon + rise * (1.0 - horizon)).sum(axis=-1)
    # A chord of the sphere down to the ground, at most as long as to its own horizon.
    ground_m = min(ground_m, camera_m - 0.1)
    height, radius = camera_m - ground_m, EARTH_RADIUS_M + ground_m
    along = (radius + height) * (rise * (1.0 + horizon) - horizon)
    reach = np.square(along) - height * (2.0 * radius + height)
    length = along - np.sqrt(np.maximum(reach, 0.0))
    passed, added = air.path(camera_m, ground_m, np.maximum(length, height))
    return np.stack([passed @ air.planck(temperature) + added.sum(axis=-1), sky])
