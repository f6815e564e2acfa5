"""Between map coordinates and a scene's local frame: poses of photogrammetric software, and positions on a map."""

import json
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.raster import Grid

# Length over which the scale of a map is measured [m].
_STEP_M = 100.0
# A metre of a map that is less on Earth is outside of its projection's domain [m].
_LEAST_M = 1e-3
# Points along a side of the lattice on which datums are compared, and heights that do not differ [m].
_LATTICE, _SAME_M = 9, 1e-3
_UP = {"name": "Ellipsoidal height", "abbreviation": "h", "direction": "up", "unit": "metre"}


def geodetic_from_map(crs: Any, points: ArrayLike) -> NDArray[np.float64]:
    """Return WGS 84 latitude, longitude [deg] and height above its ellipsoid [m], (N, 3).

    `points` (N, 3) are easting, northing of the projected `crs` [m] or longitude, latitude of the geographic one [deg],
    and the height above the ellipsoid of its own datum [m].
    """
    from rasterio.crs import CRS
    from rasterio.warp import transform

    points = np.asarray(points, np.float64)
    try:
        longitude, latitude, height = transform(_with_heights(crs), CRS.from_epsg(4979), *points.T.tolist())
        found = np.column_stack([latitude, longitude, height])
        if not (np.isfinite(found).all() and (np.abs(found[:, 0]) <= 90.0).all()):
            raise ValueError
    except Exception:  # GDAL's errors share no public base class
        raise _outside(crs, points[0]) from None
    return found


def datum_heights(grid: Grid) -> NDArray[np.float64]:
    """Return what heights above the ellipsoid of a grid's own datum lack to those above that of WGS 84, (h, w) [m].

    They are exactly 0 for datums within a millimetre of WGS 84. A lattice of few points is interpolated: ellipsoids
    approach each other by centimetres per kilometre.
    """
    from scipy.ndimage import map_coordinates

    sides = [np.linspace(0.0, side, _LATTICE) for side in (grid.height, grid.width)]
    row, column = np.meshgrid(*sides, indexing="ij")
    x, y = grid.to_map(column.ravel(), row.ravel())
    more = geodetic_from_map(grid.crs, np.column_stack([x, y, np.zeros(x.size)]))[:, 2].reshape(row.shape)
    if np.abs(more).max() < _SAME_M:
        return np.zeros((grid.height, grid.width))
    place = np.meshgrid(
        *((np.arange(side) + 0.5) / side * (_LATTICE - 1) for side in (grid.height, grid.width)), indexing="ij"
    )
    return np.asarray(map_coordinates(more, np.array(place), order=1))


def definition(crs: Any) -> dict[str, Any]:
    """The PROJJSON of a rasterio CRS."""
    try:
        found: dict[str, Any] = crs.to_dict(projjson=True)
    except ValueError:  # PROJ writes what is no JSON for some damaged WKT
        raise ThermorenderError(
            f"the coordinate system {crs.to_string()[:60]!r} is malformed; give the file one by its EPSG code"
        ) from None
    return found


@lru_cache(maxsize=8)
def _with_heights(crs: Any) -> Any:
    """The CRS with an axis of heights above its ellipsoid. Without it, PROJ leaves heights out of a change of datum."""
    from rasterio.crs import CRS

    found = definition(crs)
    parts = [found]
    for part in parts:
        parts += [part[name] for name in ("base_crs", "source_crs", "target_crs") if name in part]
        axes = part.get("coordinate_system", {}).get("axis", [])
        if len(axes) == 2:
            axes.append(_UP)
            # The code is that of the CRS without heights.
            part.pop("id", None)
    return CRS.from_user_input(json.dumps(found))


def _outside(crs: Any, point: NDArray[np.float64]) -> ThermorenderError:
    code = crs.to_epsg()
    return ThermorenderError(
        f"{point[0]:.12g}, {point[1]:.12g} is not a place in {f'EPSG:{code}' if code else 'this coordinate system'}; "
        "give coordinates and the system that they are in"
    )


def pose_from_map(frame: LocalFrame, crs: Any, pose: ArrayLike) -> NDArray[np.float64]:
    """Return a pose in map coordinates as world_from_camera in a local frame, (4, 4).

    `pose` (4, 4) is map_from_camera: easting, northing and height above the ellipsoid of the map's datum [m], axes
    east, north, up of the projected `crs`. The rotation is corrected for grid convergence and for the Earth's curvature
    between `frame` and camera.
    """
    pose = np.asarray(pose, dtype=np.float64)
    # The map's axes at the camera, by steps of one metre.
    latitude, longitude, height = geodetic_from_map(crs, pose[:3, 3] + np.vstack([np.zeros(3), np.eye(3)])).T
    local = frame.enu_from_geodetic(latitude, longitude, height)
    u, scales, v = np.linalg.svd((local[1:] - local[0]).T)
    if not (scales[-1] > _LEAST_M and np.linalg.det(u @ v) > 0.0):
        raise _outside(crs, pose[:3, 3])
    result = np.eye(4)
    result[:3, :3] = u @ v @ pose[:3, :3]
    result[:3, 3] = local[0]
    return result


@dataclass(frozen=True)
class Place:
    """Where a scene lies on Earth."""

    frame: LocalFrame  # The scene's
    crs: Any  # Of its map: the terrain's rasters, or for a mesh with [frame] the UTM zone of its origin

    def to_map(self, position: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return map coordinates (x, y), each (N,), of local positions (N, 3) [m]."""
        from rasterio.crs import CRS
        from rasterio.warp import transform

        latitude, longitude, _ = self.frame.geodetic_from_enu(np.asarray(position, np.float64))
        x, y = transform(CRS.from_epsg(4326), self.crs, longitude, latitude)
        return np.asarray(x), np.asarray(y)

    def pixel_size(self, metres: float) -> tuple[float, float]:
        """Return the size of a map pixel (across, along), in map units, that is so many metres wide at the origin."""
        x, y = self.to_map(_STEP_M * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
        map_per_m = np.array([[x[1] - x[0], x[2] - x[0]], [y[1] - y[0], y[2] - y[0]]]) / _STEP_M
        across, along = metres / np.linalg.norm(np.linalg.inv(map_per_m), axis=0)
        return float(across), float(along)


def place_of(frame: LocalFrame | None, grid: Grid | None) -> Place | None:
    """Return the Place of a scene by its frame and map grid; None for a mesh without [frame]."""
    if frame is None:
        return None
    if grid is not None:
        return Place(frame, grid.crs)
    from rasterio.crs import CRS

    zone = int((frame.longitude_deg + 180.0) // 6.0) % 60 + 1
    return Place(frame, CRS.from_epsg((32600 if frame.latitude_deg >= 0.0 else 32700) + zone))
