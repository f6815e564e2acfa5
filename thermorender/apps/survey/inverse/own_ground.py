"""A scene for frames alone: level ground at the height of the take-off around them, and the relief that they show."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Camera, Scene, load_camera, load_scene
from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.survey.inverse.frames import Place
from thermorender.defaults import CAMERA
from thermorender.errors import ThermorenderError
from thermorender.formats import picture_tags
from thermorender.frame.tiff import write_kelvin
from thermorender.physics.geodesy import LocalFrame

Floats = NDArray[np.float64]
# Diagonal of a frame of 35 mm film [mm], of which lenses state an equivalent focal length.
_FILM_MM = float(np.hypot(36.0, 24.0))
# Tags: model of the camera, focal length [mm], and that of 35 mm film [mm].
_MODEL, _FOCAL, _FOCAL_35 = 272, 37386, 41989
# Ground around the frames: multiples of their height, at most, and posts along it.
_FARTHEST, _POSTS = 3.0, 40
# Frames are up to so high [m], and not so many times as far from all others as those are.
_HIGHEST_M, _APART = 20_000.0, 100.0
# Focal lengths of lenses, as those of 35 mm film [mm].
_FOCAL_MM = 5.0, 1000.0
# Half of the angle across a frame that is assumed around it [deg], with what frames may be tilted.
_HALF_DEG = 40.0


def level_scene(places: Sequence[Place], above_ground_m: float | None, folder: Path) -> Scene:
    """Write a scene of level ground around frames into a new folder, and return it.

    Raises
    ------
    ThermorenderError
        Frames without latitude and longitude, or without a height above the take-off or the ground.
    """
    if not all(place.geodetic for place in places):
        raise ThermorenderError(
            "frames without a scene need latitude and longitude in their tags or poses; give a scene for frames in "
            "metres, such as from `thermorender import-terrain`"
        )
    latitude, longitude = np.array([place.horizontal for place in places]).T
    if not (np.abs(latitude) <= 85.0).all():
        raise ThermorenderError(
            f"latitude {latitude[np.argmax(np.abs(latitude))]:g} is not allowed; give degrees from -85 to 85"
        )
    level, height = _level(places, above_ground_m)
    middle = float(np.median(latitude)), float(np.median(longitude))
    frame = LocalFrame(*middle, level)
    position = frame.enu_from_geodetic(latitude, longitude, np.full(len(places), level))
    _refuse_far(position[:, :2])
    axis = np.array([place.rotation.as_matrix()[:, 2] for place in places])
    tilt = np.degrees(np.arccos(np.clip(axis[:, 2], -1.0, 1.0)))
    reach = height * min(np.tan(np.radians(min(_HALF_DEG + float(tilt.max()), 85.0))), _FARTHEST)
    low, high = position[:, :2].min(axis=0) - reach, position[:, :2].max(axis=0) + reach
    return _written(frame, low, high, 2.0 * reach / _POSTS, lambda east, north: np.zeros(east.shape), folder)


def _refuse_far(position: Floats) -> None:
    """Raise if one of the positions (N, 2) [m] is far from all others."""
    from scipy.spatial import cKDTree

    if len(position) < 3:
        return
    nearest = cKDTree(position).query(position, 2)[0][:, 1]
    farthest = int(np.argmax(nearest))
    if nearest[farthest] > _APART * max(float(np.median(nearest)), 1.0):
        raise ThermorenderError(
            f"frame {farthest + 1} of {len(position)} is {nearest[farthest] / 1e3:.3g} km from all others; correct its "
            "position, or leave it out"
        )


def _level(places: Sequence[Place], above_ground_m: float | None) -> tuple[float, float]:
    """(ellipsoid height of the ground [m], largest height of a frame above it [m])."""
    if above_ground_m is not None and not 0.0 < above_ground_m <= _HIGHEST_M:
        raise ThermorenderError(
            f"above_ground_m={above_ground_m!r} is not allowed; give metres, above 0 and up to {_HIGHEST_M:g}"
        )
    kinds = {place.height_of for place in places}
    if len(kinds) > 1:
        raise ThermorenderError(f"heights of the frames count from {' and '.join(sorted(kinds))}; give one kind")
    kind, height = kinds.pop(), np.array([place.height_m for place in places])
    if kind in ("above_takeoff_m", "above_ground_m"):
        stated = [place.takeoff_m for place in places if place.takeoff_m is not None]
        top = float(height.max()) + (above_ground_m - float(height[0]) if above_ground_m is not None else 0.0)
        if not 1.0 < top <= _HIGHEST_M:
            raise ThermorenderError(
                f"the frames are up to {top:g} m above their take-off, not 1 to {_HIGHEST_M:g} m; give the height "
                "of the first frame above the "
                "ground as above_ground"
            )
        return (float(np.median(stated)) if stated else 0.0), top
    if above_ground_m is None:
        raise ThermorenderError(
            f"the frames state no height above the take-off, only {kind}, from which no level of the ground follows; "
            "give the height of the first frame above the ground as above_ground, or a scene"
        )
    return float(height[0]) - above_ground_m, float(np.ptp(height)) + above_ground_m


def relief_scene(level: Scene, relief: Callable[[Floats, Floats], Floats], low: Floats, high: Floats, step_m: float,
                 folder: Path) -> Scene:  # fmt: skip
    """Write a scene with a relief in the frame of another scene, from `low` to `high` (2,) [m], and return it."""
    assert level.frame is not None
    return _written(level.frame, low, high, step_m, relief, folder)


def _written(
    frame: LocalFrame, low: Floats, high: Floats, step_m: float, relief: Callable[[Floats, Floats], Floats],
    folder: Path,
) -> Scene:  # fmt: skip
    """Write heights [m] above a frame's tangent plane as a raster of its UTM zone, import it, and return the Scene."""
    from rasterio import Affine
    from rasterio.crs import CRS
    from rasterio.warp import transform

    zone = int((frame.longitude_deg + 180.0) // 6.0) % 60 + 1
    crs = CRS.from_epsg((32600 if frame.latitude_deg >= 0.0 else 32700) + zone)
    corners = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]])
    latitude, longitude, _ = frame.geodetic_from_enu(np.concatenate([corners, np.zeros((4, 1))], axis=1))
    x, y = (np.array(each) for each in transform(CRS.from_epsg(4326), crs, longitude.tolist(), latitude.tolist()))
    west, north = np.floor(x.min() / step_m) * step_m, np.ceil(y.max() / step_m) * step_m
    width, height = (int(np.ceil(side / step_m)) for side in (x.max() - west, north - y.min()))
    place = Affine(step_m, 0.0, west, 0.0, -step_m, north)
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    across, along = west + step_m * column.ravel(), north - step_m * row.ravel()
    lon, lat = (np.array(each) for each in transform(crs, CRS.from_epsg(4326), across.tolist(), along.tolist()))
    point = frame.enu_from_geodetic(lat, lon, np.full(lat.shape, frame.height_m))
    up = relief(point[:, 0], point[:, 1])
    _, _, above = frame.geodetic_from_enu(np.stack([point[:, 0], point[:, 1], up], axis=1))
    heights = folder.with_name(f"{folder.name}.tif")
    write_kelvin(heights, above.reshape(height, width).astype(np.float32), crs, place, "ellipsoid height", "m")
    try:
        import_terrain(heights, None, folder, ImportSettings(height_reference="ellipsoid"))
    finally:
        heights.unlink()
    return load_scene(folder)


def between(poses: Floats, one: LocalFrame, other: LocalFrame) -> Floats:
    """Return poses (F, 4, 4) of one frame in another."""
    turn = other.enu_from_ecef_rotation @ one.enu_from_ecef_rotation.T
    found = poses.copy()
    found[:, :3, :3] = turn @ poses[:, :3, :3]
    place = one.geodetic_from_enu(poses[:, :3, 3])
    found[:, :3, 3] = other.enu_from_geodetic(*place)
    return found


def stated_camera(path: Path, shape: tuple[int, int]) -> tuple[Camera, str]:
    """Return (a Camera with the size and the focal length that a frame's tags state, a sentence that says so).

    Raises
    ------
    ThermorenderError
        Tags without focal lengths.
    """
    height, width = shape
    try:
        tags, exif = picture_tags(path)[:2]
    except ValueError:
        tags, exif = {}, {}
    focal_mm, equal_mm = (_positive(exif.get(tag)) for tag in (_FOCAL, _FOCAL_35))
    if not (focal_mm and _FOCAL_MM[0] <= equal_mm <= _FOCAL_MM[1]):
        stated = f"{equal_mm:g} mm as" if equal_mm else "no"
        raise ThermorenderError(
            f"{path} states {stated} focal length of 35 mm film in its EXIF tags, not {_FOCAL_MM[0]:g} to "
            f"{_FOCAL_MM[1]:g} mm; name the camera, a model or its .toml file, as camera"
        )
    base = load_camera(CAMERA)
    focal_px = equal_mm / _FILM_MM * float(np.hypot(width, height))
    camera = replace(
        base, name=str(tags.get(_MODEL, "")).strip("\0 ") or "the frames' camera", width=width, height=height,
        pixel_pitch_um=1e3 * focal_mm / focal_px,
        focal_length_mm=focal_mm,
    )  # fmt: skip
    return camera, (
        f"no camera is given: size and focal length, {focal_px:.0f} pixels before the fit, are those of the frames' "
        f"tags; band, blur and noise are those of {base.name}"
    )


def _positive(value: Any) -> float:
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return found if 0.0 < found < 1e4 else 0.0
