"""Poses of a survey's frames from one file: thermorender's CSV, Metashape's text, OpenSfM's reconstruction.json.

- CSV: `frame` names the frame, with or without suffix. Position `east_m, north_m` or `lat_deg, lon_deg`; one height of
  `up_m`, `alt_ellipsoid_m`, `above_ground_m`, `above_takeoff_m`; angles of the optical axis `yaw_deg, pitch_deg,
  roll_deg`, where pitch −90 looks down. `time` is optional. `poses.csv` of a reconstruction has this form.
- Metashape: the text of "Export reference", with its coordinate system in the first line. Estimated columns (X_est …)
  take precedence over measured ones. Angles 0, 0, 0 are a camera that looks down with the top of its image to north.
- OpenSfM, as OpenDroneMap writes it: each shot has the rotation vector and the translation from topocentric axes at
  `reference_lla` to camera axes.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermorender.errors import ThermorenderError
from thermorender.formats import finite_json, read_text
from thermorender.inverse.frames import HEIGHTS, Place, camera_rotation
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.georeference import pose_from_map
from thermorender.scene.scene import Scene
from thermorender.trajectory.rotations import ENU_FROM_NED, rotation_from_angles
from thermorender.trajectory.tables import rows_of

Floats = NDArray[np.float64]
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
# Camera axes in those of a vehicle that flies north, for a camera that looks down with the top of its image ahead.
_BODY_FROM_NADIR = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_METASHAPE = "# CoordinateSystem:"


def read_poses(path: Path, scene: Scene) -> dict[str, Place]:
    """Return {name of a frame without suffix: Place} of a file of poses.

    Raises
    ------
    ThermorenderError
        The file cannot be read, is of another kind, or states a pose twice or not as numbers.
    """
    text = read_text(path, "CSV UTF-8")
    if path.suffix.lower() in (".json", ".geojson"):
        return _opensfm(path, text, scene)
    if text.startswith(_METASHAPE):
        return _metashape(path, text, scene)
    return _own(path)


def _own(path: Path) -> dict[str, Place]:
    head, rows = rows_of(path)
    local, geodetic = ("east_m", "north_m"), ("lat_deg", "lon_deg")
    pairs = [pair for pair in (local, geodetic) if all(name in head for name in pair)]
    heights = [name for name in HEIGHTS if name in head]
    missing = [name for name in ("frame", *_ANGLES) if name not in head]
    if missing or len(pairs) != 1 or len(heights) != 1:
        raise ThermorenderError(
            f"{path} has the columns {', '.join(head) or 'none'}; give frame, east_m and north_m or lat_deg and "
            f"lon_deg, one of {', '.join(HEIGHTS)}, and {', '.join(_ANGLES)}"
        )
    found: dict[str, Place] = {}
    for where, row in rows:
        name = _name(row["frame"], found, where)
        horizontal = [_number(row, key, where) for key in pairs[0]]
        turn = camera_rotation(*(_number(row, key, where) for key in _ANGLES))
        height = _number(row, heights[0], where)
        found[name] = Place(
            (horizontal[0], horizontal[1]), pairs[0] is geodetic, height, heights[0], turn, row.get("time") or ""
        )
    return found


def _metashape(path: Path, text: str, scene: Scene) -> dict[str, Place]:
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    first, _, rest = text.partition("\n")
    lines = rest.splitlines()
    head = next((line[1:].split(",") for line in lines if line.startswith("#Label")), None)
    try:
        # The code at the end is that of the whole system; Metashape's own wording of some projections is not read.
        code = re.search(r'AUTHORITY\["EPSG","(\d+)"\]\]\s*$', first)
        crs = CRS.from_epsg(int(code[1])) if code else CRS.from_wkt(first[len(_METASHAPE) :].strip())
    except CRSError:
        raise ThermorenderError(
            f"{path}: its coordinate system cannot be read; export it in one with an EPSG code"
        ) from None
    _check_system(path, crs)
    kinds = (("X_est", "Y_est", "Z_est", "Yaw_est", "Pitch_est", "Roll_est"),
             ("X/Easting", "Y/Northing", "Z/Altitude", "Yaw", "Pitch", "Roll"),
             ("X/Longitude", "Y/Latitude", "Z/Altitude", "Yaw", "Pitch", "Roll"))  # fmt: skip
    names = next((kind for kind in kinds if head and all(name in head for name in kind)), None)
    if names is None or head is None:
        raise ThermorenderError(
            f"{path} has the columns {', '.join(head or ()) or 'none'}, not a label with positions and the angles yaw, "
            "pitch, roll; set those angles in Metashape's reference settings, and export separated by commas"
        )
    if scene.frame is None:
        raise ThermorenderError(f"{scene.where}: poses on a map need a place of the scene; add [frame] to it")
    found: dict[str, Place] = {}
    rows = [line.split(",") for line in lines if line and not line.startswith("#")]
    for number, cells in enumerate(rows, 1):
        row, where = dict(zip(head, cells, strict=False)), f"{path}, camera {number}"
        # A camera that was not aligned has no estimate.
        if not all((row.get(name) or "").strip() for name in names):
            continue
        name = _name(row["Label"], found, where)
        x, y, height, *angles = (_number(row, key, where) for key in names)
        axes = ENU_FROM_NED @ (rotation_from_angles(*angles) * Rotation.from_matrix(_BODY_FROM_NADIR)).as_matrix()
        found[name] = _on_map(scene.frame, crs, axes, (x, y, height))
    return found


def _check_system(path: Path, crs: Any) -> None:
    """Raise unless a coordinate system has heights in metres above the ellipsoid, and axes on a map or globe."""
    fault = None
    if not (crs.is_geographic or crs.is_projected):
        fault = "is neither geographic nor projected"
    elif crs.is_projected and abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        fault = f"counts in {crs.linear_units_factor[0]}, not in metres"
    elif "VERT_" in crs.to_wkt(version="WKT1_GDAL"):
        fault = "has heights above sea level or another vertical datum"
    if fault:
        raise ThermorenderError(
            f"{path}: its coordinate system {fault}; export in WGS 84 (EPSG::4326), with heights above the ellipsoid"
        )


def _on_map(frame: LocalFrame, crs: Any, axes: Floats, position: tuple[float, float, float]) -> Place:
    """The Place of a camera with axes east, north, up of a map and a position on it."""
    from rasterio.crs import CRS
    from rasterio.warp import transform

    (longitude,), (latitude,) = transform(crs, CRS.from_epsg(4326), [position[0]], [position[1]])
    pose = np.eye(4)
    if crs.is_projected:
        pose[:3, :3], pose[:3, 3] = axes, position
        pose = pose_from_map(frame, crs, pose)
        axes = pose[:3, :3]
        # In the scene's frame north and down are those of its origin; `Place` has those of the camera.
        axes = _local_axes(frame, latitude, longitude).T @ axes
    return Place(
        (latitude, longitude), True, position[2], "alt_ellipsoid_m", Rotation.from_matrix(ENU_FROM_NED.T @ axes)
    )


def _local_axes(frame: LocalFrame, latitude: float, longitude: float) -> Floats:
    """East, north and up at a place, in the axes of a frame (3, 3)."""
    here = LocalFrame(latitude, longitude, 0.0)
    return np.asarray(frame.enu_from_ecef_rotation @ here.enu_from_ecef_rotation.T)


def _opensfm(path: Path, text: str, scene: Scene) -> dict[str, Place]:
    try:
        given = finite_json(text)
        parts = given if isinstance(given, list) else []
        found: dict[str, Place] = {}
        for part in parts:
            lla = part["reference_lla"]
            frame = LocalFrame(float(lla["latitude"]), float(lla["longitude"]), float(lla["altitude"]))
            for label, shot in part["shots"].items():
                camera_from_world = Rotation.from_rotvec(np.array(shot["rotation"], np.float64))
                origin = -camera_from_world.inv().apply(np.array(shot["translation"], np.float64))
                latitude, longitude, height = (float(value) for value in frame.geodetic_from_enu(origin))
                axes = _local_axes(frame, latitude, longitude).T @ camera_from_world.inv().as_matrix()
                turn = Rotation.from_matrix(ENU_FROM_NED.T @ axes)
                name = _name(label, found, str(path))
                found[name] = Place((latitude, longitude), True, height, "alt_ellipsoid_m", turn)
    except ThermorenderError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ThermorenderError(
            f"{path} is not a reconstruction.json of OpenSfM or OpenDroneMap ({type(error).__name__}: {error}); give "
            "that file, or poses as CSV"
        ) from None
    if not found:
        raise ThermorenderError(f"{path} has no shots; give reconstruction.json of OpenSfM or OpenDroneMap")
    return found


def _name(label: str, found: dict[str, Place], where: str) -> str:
    name = label.strip()
    stem = Path(name).stem if Path(name).suffix.lower() in (".tif", ".tiff", ".jpg", ".jpeg", ".png") else name
    if not stem or stem in found:
        raise ThermorenderError(f"{where}: frame={label!r} is {'given twice' if stem else 'empty'}; name each once")
    return stem


def _number(row: dict[str, Any], key: str, where: str) -> float:
    try:
        value = float(row[key])
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise ThermorenderError(
            f"{where}: {key}={row.get(key)!r} is not a finite number; give one, with a point as decimal mark"
        )
    return value
