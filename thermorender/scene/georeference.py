"""Camera poses from map coordinates, as photogrammetric software states them, to a scene's local frame."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.geodesy import LocalFrame


def pose_from_map(frame: LocalFrame, crs: Any, pose: ArrayLike) -> NDArray[np.float64]:
    """Return a pose in map coordinates as world_from_camera in a local frame, (4, 4).

    The rotation is corrected for the grid's convergence and for the Earth's curvature between frame and camera.

    Parameters
    ----------
    frame : LocalFrame
        The scene's.
    crs : rasterio.crs.CRS
        Projected CRS of the map, in metres.
    pose : (4, 4) array
        map_from_camera: position (easting, northing, ellipsoid height) and axes (east, north, up) of the grid.
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
