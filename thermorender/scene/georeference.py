"""Between map coordinates and a scene's local frame: poses of photogrammetric software, and positions on a map."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.raster import Grid

# Length over which the scale of a map is measured [m].
_STEP_M = 100.0


def pose_from_map(frame: LocalFrame, crs: Any, pose: ArrayLike) -> NDArray[np.float64]:
    """Return a pose in map coordinates as world_from_camera in a local frame, (4, 4).

    `pose` (4, 4) is map_from_camera: easting, northing and ellipsoid height [m], axes east, north, up of the projected
    `crs`. The rotation is corrected for grid convergence and for the Earth's curvature between `frame` and camera.
    """
    from rasterio.crs import CRS
    from rasterio.warp import transform

    pose = np.asarray(pose, dtype=np.float64)
    # The map's axes at the camera, by steps of one metre.
    points = pose[:3, 3] + np.vstack([np.zeros(3), np.eye(3)])
    longitude, latitude = transform(crs, CRS.from_epsg(4326), points[:, 0], points[:, 1])
    local = frame.enu_from_geodetic(np.array(latitude), np.array(longitude), points[:, 2])
    u, _, v = np.linalg.svd((local[1:] - local[0]).T)
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
