"""What a ray brings back from what it meets: through the air of one camera position, or through none.

A path from a given camera is told by its length and the altitude it ends at. For each position the air is computed
on a small grid of both, as wide as the scene can be from there: the weights of the texels' channels and the path
radiance. Rays look it up; rays that meet nothing look up sky and surroundings by their zenith angle. What a mirror
shows has passed air before: a grid of both lengths, to the mirror and on, tells how the weights change.
"""

import drjit as dr
import numpy as np

from thermorender.atmosphere.model import HIGHEST_CAMERA_M
from thermorender.atmosphere.rays import EARTH_RADIUS_M, MEAN_RADIUS_M, horizon_cos_zenith
from thermorender.errors import ThermorenderError

# A grid's lengths grow by at most this factor from one to the next, and its altitudes are at most this far apart [m].
_GROWTH = 1.08
# The same of the grid of paths by way of mirrors, which tells a part of the light alone.
_COARSE = 1.2
# Shorter paths count as this long [m].
_SHORTEST_M = 1.0
_FEWEST = 4
_ALTITUDE_M = 100.0
# Zenith angles of what lies beyond the surfaces, below and above the horizon; densest there. 5 mK of the sky from
# 120 m.
_BACKGROUND = 64
# Heights above the ground at which these are computed [m], each higher by a factor, and how many are kept.
_LOWEST_M, _STEP, _KEPT = 0.1, 1.03, 16


class Vacuum:
    """No air: channels arrive as they left, from sky and surroundings as they are.

    Parameters
    ----------
    mi : module
    sky, background : (C,) floats
        Channels of rays that meet nothing, above and below the horizon.
    """

    to_mirrors = None

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
    to_mirrors : AirToMirrors, optional
        Where the scene has mirrors.
    """

    def __init__(self, mi, scene, spectrum, to_mirrors=None):
        self._mi, self._air, self._solver, self._to_mirrors = mi, scene.air, spectrum.solver, to_mirrors
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
        if camera > HIGHEST_CAMERA_M:
            raise ThermorenderError(
                f"pose: the camera is {camera:.0f} m above sea level, out of range of the air; give up to "
                f"{HIGHEST_CAMERA_M:.0f} m"
            )
        outside = np.maximum(np.maximum(box[0] - origin, origin - box[1]), 0.0)
        nearest = max(float(np.linalg.norm(outside)), _SHORTEST_M)
        farthest = max(float(np.linalg.norm(np.abs(box - origin).max(axis=0))), 1.01 * nearest)
        passed, added, frame = _paths(self._air, base, camera, box, nearest, farthest)
        if clear:
            passed, added = np.ones_like(passed), np.zeros_like(added)
        cells = np.concatenate([passed @ self._solver, added.sum(axis=-1, keepdims=True)], axis=-1)
        horizon = float(horizon_cos_zenith(camera))
        to_mirrors = self._to_mirrors and self._to_mirrors.seen_from(camera, nearest, farthest, clear)
        return AirView(self._mi, PathTable(self._mi, cells, frame), self._background(camera), horizon, to_mirrors)

    def _background(self, camera):
        """Band radiance of rays that meet nothing, (2, _BACKGROUND), linear between altitudes of earlier views."""
        height = max(camera - self._altitude_m, _LOWEST_M)
        position = np.log(height / _LOWEST_M) / np.log(_STEP)
        lower = int(position)
        both = []
        for number in (lower, lower + 1):
            if number not in self._seen:
                if len(self._seen) >= _KEPT:
                    self._seen.pop(next(iter(self._seen)))
                at = min(self._altitude_m + _LOWEST_M * _STEP**number, HIGHEST_CAMERA_M)
                parts = np.linspace(0.0, 1.0, _BACKGROUND)
                self._seen[number] = background(self._air, at, self._altitude_m, self._background_k, parts)
            both.append(self._seen[number])
        share = (height / _LOWEST_M / _STEP**lower - 1.0) / (_STEP - 1.0)
        return (1.0 - share) * both[0] + share * both[1]


class PathTable:
    """Numbers of the paths from one altitude, by their length and the altitude they end at.

    Parameters
    ----------
    mi : module
    cells : (…, rows, columns, n) array
        By altitude of the end and length of the path; planes of these one after the other.
    frame : tuple
        Altitude of the local frame's origin, of the lowest and the highest end, and of the start [m]; logarithm of
        the first column's length, and columns per unit of it.
    """

    def __init__(self, mi, cells, frame):
        self._mi, (rows, columns, self._count) = mi, cells.shape[-3:]
        padded = np.pad(cells.reshape(-1, self._count), ((0, 0), (0, -self._count % 4))).astype(np.float32)
        groups = range(0, padded.shape[1], 4)
        self._groups = [mi.Float(np.ascontiguousarray(padded[:, k : k + 4]).ravel()) for k in groups]
        self._numbers = [dr.opaque(mi.Float, float(number)) for number in (*frame, columns, rows - 1)]

    def at(self, point, distance, active, plane=0):
        """Return the n numbers of paths that end at points of the local frame after distances [m], a list of Float."""
        mi = self._mi
        base, low, high, start, first, step, count, rows = self._numbers
        end = base + point.z + 0.5 / MEAN_RADIUS_M * (point.x * point.x + point.y * point.y)
        column = dr.clip((dr.log(distance) - first) * step, 0.0, count - 1.001)
        bottom, top = dr.maximum(low, start - distance), dr.minimum(high, start + distance)
        row = dr.clip((end - bottom) / dr.maximum(top - bottom, 1e-3), 0.0, 0.9999) * rows
        left, upper = dr.floor(column), dr.floor(row)
        across, down = column - left, row - upper
        cell, below = mi.UInt32(upper * count + left) + plane * mi.UInt32((rows + 1.0) * count), mi.UInt32(count)
        total = [mi.Float(0.0) for _ in range(self._count)]
        for index, weight in ((cell, (1 - across) * (1 - down)), (cell + 1, across * (1 - down)),
                              (cell + below, (1 - across) * down), (cell + below + 1, across * down)):  # fmt: skip
            found = [value for group in self._groups for value in dr.gather(mi.Vector4f, group, index, active)]
            total = [a + weight * value for a, value in zip(total, found, strict=False)]
        return total


class AirView:
    """The air seen from one camera position.

    Parameters
    ----------
    mi : module
    paths : PathTable
        Weights of the channels and path radiance, K + 1 numbers.
    background : (2, n) array
        As by `background`.
    horizon : float
        Cosine of the horizon's zenith angle.
    to_mirrors : MirrorView or None
        None where the scene has no mirrors.
    """

    def __init__(self, mi, paths, background, horizon, to_mirrors):
        self._mi, self._paths, self.to_mirrors = mi, paths, to_mirrors
        self._sky = mi.Float(background.astype(np.float32).ravel())
        self._horizon = dr.opaque(mi.Float, horizon)

    def at_camera(self, hit, values, origin, direction):
        """Return what rays bring back, [Float], of the channels `values` where they meet something."""
        *weights, added = self._paths.at(origin + hit.distance * direction, hit.distance, hit.valid)
        total = added + sum(weight * value for weight, value in zip(weights, values, strict=True))
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


class AirToMirrors:
    """The air between mirrors and what they show, as if all mirrors lay at one altitude.

    Parameters
    ----------
    mi : module
    scene : Scene
    spectrum : Spectrum
    at_m : float
        Mean altitude of the mirrors [m].
    box : (2, 3) array
        Lowest and highest corner of what stands still; ends of paths beyond it count as at its edge [m].

    Notes
    -----
    Air as warm as its light is bright, of the blackbody B, makes t L + (1 − t) B = B + t (L − B) of light L. So what a
    mirror reflects of L − B has passed both paths, and is weighted as light behind the two of them. B is a blackbody at
    the mirrors, times what makes the air's band radiance right.
    """

    def __init__(self, mi, scene, spectrum, at_m, box):
        air, longest = scene.air, max(float(np.linalg.norm(box[1] - box[0])), 2.0 * _SHORTEST_M)
        self._mi, self._air, self._solver, self._at_m = mi, air, spectrum.solver, at_m
        self._passed, added, self._frame = _paths(air, scene.altitude_m, at_m, box, _SHORTEST_M, longest, _COARSE)
        black = air.planck(air.air_temperature(at_m))
        self._share = added.sum(axis=-1) / ((1.0 - self._passed) @ black)
        self._black = [dr.opaque(mi.Float, float(value)) for value in spectrum.basis @ black]

    def seen_from(self, camera, nearest, farthest, clear):
        """Return the MirrorView from a camera's altitude, of mirrors between two distances [m]; `clear` as of `Air`."""
        count = max(2, 1 + int(np.ceil(np.log(farthest / nearest) / np.log(_COARSE))))
        length = np.geomspace(nearest, farthest, count)
        passed = np.ones((count, self._passed.shape[-1]))
        if not clear:
            passed = self._air.transmittance(camera, np.clip(self._at_m, camera - length, camera + length), length)
        less = (passed[:, None, None] * (self._passed - 1.0)) @ self._solver
        share = np.broadcast_to(self._share[..., None], (*less.shape[:-1], 1))
        table = PathTable(self._mi, np.concatenate([less, share], axis=-1), self._frame)
        scale = np.log(nearest), (count - 1) / np.log(farthest / nearest), count
        return MirrorView(self._mi, table, scale, self._black)


class MirrorView:
    """The air between mirrors and what they show, seen from one camera position.

    Parameters
    ----------
    mi : module
    table : PathTable
        Change of the channels' weights by the path beyond the mirror and share of the blackbody, K + 1 numbers; a plane
        for each distance of the mirror.
    scale : tuple
        Logarithm of the first distance, planes per unit of it, and their number.
    black : list of Float
        Channels of a blackbody as warm as the air at the mirrors.
    """

    def __init__(self, mi, table, scale, black):
        self._mi, self._table, self._black = mi, table, black
        self._scale = [dr.opaque(mi.Float, float(number)) for number in scale]

    def at(self, distance, point, beyond, active):
        """Return (change of each channel's weight, channels of the air as a blackbody), two lists of Float.

        Parameters
        ----------
        distance, beyond : Float
            Lengths to the mirror and from there on [m].
        point : Point3f
            What is shown, in the scene's local frame.
        active : Bool
        """
        first, step, count = self._scale
        position = dr.clip((dr.log(distance) - first) * step, 0.0, count - 1.001)
        lower = dr.floor(position)
        near, far = (self._table.at(point, beyond, active, self._mi.UInt32(lower) + k) for k in (0, 1))
        *change, share = (dr.lerp(a, b, position - lower) for a, b in zip(near, far, strict=True))
        return change, [share * value for value in self._black]


def _paths(air, base, start, box, nearest, farthest, growth=_GROWTH):
    """(transmittance, emission (rows, columns, n), frame) of paths from an altitude into a box, for a `PathTable`."""
    corner = np.append(np.abs(box[:, :2]).max(axis=0), box[1, 2])
    low, high = base + box[0, 2], float(altitude(corner, base))
    columns = max(_FEWEST, 1 + int(np.ceil(np.log(farthest / nearest) / np.log(growth))))
    rows = 2 + int((high - low) / _ALTITUDE_M)
    length = np.geomspace(nearest, farthest, columns)
    # At each length, from the lowest to the highest point at that distance.
    bottom, top = np.maximum(low, start - length), np.minimum(high, start + length)
    end = bottom + np.linspace(0.0, 1.0, rows)[:, None] * np.maximum(top - bottom, 0.0)
    end = np.clip(end, start - length, start + length)
    passed, added = air.path(start, end, np.broadcast_to(length, end.shape))
    return passed, added, (base, low, high, start, np.log(nearest), (columns - 1) / np.log(farthest / nearest))


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
