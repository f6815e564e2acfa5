"""Poses of a survey's frames from one file: CSV, Metashape's text, and what OpenSfM and OpenDroneMap write.

- CSV: `frame` names the frame, with or without suffix. Position `east_m, north_m` or `lat_deg, lon_deg`; one height of
  `up_m`, `alt_ellipsoid_m`, `above_ground_m`, `above_takeoff_m`; angles of the optical axis `yaw_deg, pitch_deg,
  roll_deg`, where pitch −90 looks down, or `omega_deg, phi_deg, kappa_deg`. `time` is optional. `poses.csv` of a
  reconstruction has this form.
- Metashape: the text of "Export reference", with its coordinate system in the first line. Estimated columns (X_est …)
  take precedence over measured ones. Angles 0, 0, 0 are a camera that looks down with the top of its image to north.
  Yaw counts from geographic north at the camera, whatever the coordinate system of the positions. Omega, phi and kappa
  turn the axes of that system. Heights are above the ellipsoid of its datum.
- OpenSfM's reconstruction.json: each shot has the rotation vector and the translation from topocentric axes at
  `reference_lla` to camera axes, and a lens.
- OpenDroneMap's shots.geojson: each shot has its longitude, latitude and height, its position in a UTM zone that the
  file does not name, and the rotation vector from the axes of that map to camera axes.

Omega, phi and kappa turn east, north, up axes, or those of the map, about the first, then the turned second, then the
turned third axis, into image axes right, top and backwards. Source: Agisoft, "What are yaw, pitch, roll and omega, phi,
kappa angles".
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermorender.apps.survey.footage.lens_files import Lens, opensfm_lens
from thermorender.apps.survey.inverse.frames import HEIGHTS, Place, camera_rotation
from thermorender.errors import ThermorenderError
from thermorender.formats import finite_json, read_text
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.georeference import geodetic_from_map, pose_from_map
from thermorender.trajectory.rotations import ENU_FROM_NED, rotation_from_angles
from thermorender.trajectory.tables import rows_of

Floats = NDArray[np.float64]
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_YPR, _OPK = ("Yaw", "Pitch", "Roll"), ("Omega", "Phi", "Kappa")
_TURNS = ("omega_deg", "phi_deg", "kappa_deg")
# Camera axes right, down, forwards in image axes right, top, backwards.
_IMAGE_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
# Angles that count turns reach beyond 360° [deg].
_LARGEST_DEG = 1e5
# The two positions of a shot agree to this [m].
_SAME_M = 1.0
# Camera axes in those of a vehicle that flies north, for a camera that looks down with the top of its image ahead.
_BODY_FROM_NADIR = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_METASHAPE = "# CoordinateSystem:"
# Estimates first.
_METASHAPE_COLUMNS = (
    *(("X_est", "Y_est", "Z_est", *(f"{name}_est" for name in names)) for names in (_YPR, _OPK)),
    *((*pair, "Z/Altitude", *names) for pair in (("X/Easting", "Y/Northing"), ("X/Longitude", "Y/Latitude"))
      for names in (_YPR, _OPK)),
)  # fmt: skip


def read_poses(path: Path) -> dict[str, Place]:
    """Return {name of a frame without suffix: Place} of a file of poses."""
    text = read_text(path, "CSV UTF-8")
    if path.suffix.lower() in (".json", ".geojson"):
        return _json(path, text)
    if text.startswith(_METASHAPE):
        return _metashape(path, text)
    return _own(path)


def _own(path: Path) -> dict[str, Place]:
    head, rows = rows_of(path)
    local, geodetic = ("east_m", "north_m"), ("lat_deg", "lon_deg")
    pairs = [pair for pair in (local, geodetic) if all(name in head for name in pair)]
    heights = [name for name in HEIGHTS if name in head]
    angles = [names for names in (_ANGLES, _TURNS) if all(name in head for name in names)]
    if "frame" not in head or not len(pairs) == len(heights) == len(angles) == 1:
        raise ThermorenderError(
            f"{path} has the columns {', '.join(head) or 'none'}; give frame, east_m and north_m or lat_deg and "
            f"lon_deg, one of {', '.join(HEIGHTS)}, and {', '.join(_ANGLES)} or {', '.join(_TURNS)}"
        )
    found: dict[str, Place] = {}
    for where, row in rows:
        name = _name(row["frame"], found, where)
        horizontal = [_number(row, key, where) for key in pairs[0]]
        numbers = [_angle(row, key, where) for key in angles[0]]
        turn = (
            Rotation.from_matrix(ENU_FROM_NED.T) * _turned(numbers)
            if angles[0] is _TURNS
            else camera_rotation(*numbers)
        )
        height = _number(row, heights[0], where)
        found[name] = Place(
            (horizontal[0], horizontal[1]), pairs[0] is geodetic, height, heights[0], turn, row.get("time") or ""
        )
    return found


def _metashape(path: Path, text: str) -> dict[str, Place]:
    first, _, rest = text.partition("\n")
    lines = rest.splitlines()
    crs = _system(path, first)
    head = next(([name.strip() for name in line[1:].split(",")] for line in lines if line.startswith("#Label")), [])
    names = next((kind for kind in _METASHAPE_COLUMNS if all(name in head for name in ("Label", *kind))), None)
    if names is None:
        raise ThermorenderError(
            f"{path} has the columns {', '.join(head) or 'none'}, not a label with positions and the angles yaw, "
            "pitch, roll or omega, phi, kappa; set those angles in Metashape's reference settings, and export "
            "separated by commas"
        )
    found: dict[str, Place] = {}
    rows = [line.split(",") for line in lines if line and not line.startswith("#")]
    for number, cells in enumerate(rows, 1):
        row, where = dict(zip(head, cells, strict=False)), f"{path}, camera {number}"
        # A camera that was not aligned has no estimate.
        if not all((row.get(name) or "").strip() for name in names):
            continue
        name = _name(row["Label"], found, where)
        x, y, height = (_number(row, key, where) for key in names[:3])
        angles = [_angle(row, key, where) for key in names[3:]]
        where = f"{path}, camera {row['Label'].strip()!r}"
        found[name] = _on_map(crs, _turned(angles).as_matrix(), (x, y, height), where)
        if names[3].startswith("Yaw"):
            nadir = Rotation.from_matrix(_BODY_FROM_NADIR)
            found[name] = replace(found[name], rotation=rotation_from_angles(*angles) * nadir)
    if not found:
        raise ThermorenderError(f"{path} holds no pose of a camera; align the photographs before you export it")
    return found


def _system(path: Path, line: str) -> Any:
    """The coordinate system that Metashape's first line states, in metres above the ellipsoid."""
    import rasterio
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        # The code at the end is that of the whole system; Metashape's own wording of some projections is not read.
        code = re.search(r'AUTHORITY\["EPSG","(\d{1,9})"\]\]\s*$', line)
        # Within an Env, GDAL prints no error of its own.
        with rasterio.Env():
            crs = CRS.from_epsg(int(code[1])) if code else CRS.from_wkt(line[len(_METASHAPE) :].strip())
    except CRSError:
        raise ThermorenderError(
            f"{path}: its coordinate system cannot be read; export it in one with an EPSG code"
        ) from None
    _check_system(path, crs)
    return crs


def _turned(angles_deg: Sequence[float]) -> Rotation:
    """From camera axes to east, north, up, of omega, phi and kappa [deg]."""
    return Rotation.from_euler("XYZ", angles_deg, degrees=True) * Rotation.from_matrix(_IMAGE_FROM_CAMERA)


def _check_system(path: Path, crs: Any) -> None:
    """Raise unless a coordinate system has heights in metres above the ellipsoid, and axes on a map or globe."""
    fault = None
    if not (crs.is_geographic or crs.is_projected):
        fault = "is neither geographic nor projected"
    elif crs.is_projected and abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        fault = f"counts in {crs.linear_units_factor[0]}, not in metres"
    elif "VERTCRS[" in crs.to_wkt(version="WKT2_2019"):
        fault = "has heights above sea level or another vertical datum"
    if fault:
        raise ThermorenderError(
            f"{path}: its coordinate system {fault}; export in WGS 84 (EPSG::4326), with heights above the ellipsoid"
        )


def _on_map(crs: Any, axes: Floats, position: tuple[float, float, float], where: str) -> Place:
    """The Place of a camera with axes east, north, up of a map and a position on it."""
    try:
        ((latitude, longitude, height),) = geodetic_from_map(crs, [position]).tolist()
        pose = np.eye(4)
        if crs.is_projected:
            pose[:3, :3], pose[:3, 3] = axes, position
            axes = pose_from_map(LocalFrame(latitude, longitude, height), crs, pose)[:3, :3]
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: {error}") from None
    return Place((latitude, longitude), True, height, "alt_ellipsoid_m", Rotation.from_matrix(ENU_FROM_NED.T @ axes))


def _local_axes(frame: LocalFrame, latitude: float, longitude: float) -> Floats:
    """East, north and up at a place, in the axes of a frame (3, 3)."""
    here = LocalFrame(latitude, longitude, 0.0)
    return np.asarray(frame.enu_from_ecef_rotation @ here.enu_from_ecef_rotation.T)


def _json(path: Path, text: str) -> dict[str, Place]:
    try:
        given = finite_json(text)
        shots = isinstance(given, dict) and given.get("type") == "FeatureCollection"
        found = _shots(path, given) if shots else _opensfm(path, given)
    except ThermorenderError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise ThermorenderError(
            f"{path} is neither a reconstruction.json of OpenSfM nor a shots.geojson of OpenDroneMap "
            f"({type(error).__name__}: {error}); give one of them, or poses as CSV"
        ) from None
    if not found:
        raise ThermorenderError(
            f"{path} has no shots; give reconstruction.json of OpenSfM or shots.geojson of OpenDroneMap"
        )
    return found


def _opensfm(path: Path, given: Any) -> dict[str, Place]:
    found: dict[str, Place] = {}
    for part in given if isinstance(given, list) else []:
        lla = part["reference_lla"]
        frame = LocalFrame(float(lla["latitude"]), float(lla["longitude"]), float(lla["altitude"]))
        used = {shot["camera"] for shot in part["shots"].values() if "camera" in shot}
        lenses = {name: opensfm_lens(part["cameras"][name], f"{path}, camera {name!r}") for name in used}
        for label, shot in part["shots"].items():
            camera_from_world = _rotation(shot["rotation"])
            origin = -camera_from_world.inv().apply(_vector(shot["translation"], 1e8))
            latitude, longitude, height = (float(value) for value in frame.geodetic_from_enu(origin))
            axes = _local_axes(frame, latitude, longitude).T @ camera_from_world.inv().as_matrix()
            turn = Rotation.from_matrix(ENU_FROM_NED.T @ axes)
            name, lens = _name(label, found, str(path)), lenses.get(shot.get("camera"))
            found[name] = Place((latitude, longitude), True, height, "alt_ellipsoid_m", turn, "", lens)
    return found


def _shots(path: Path, given: Any) -> dict[str, Place]:
    found: dict[str, Place] = {}
    for feature in given["features"]:
        stated = feature["properties"]
        name = _name(stated["filename"], found, str(path))
        longitude, latitude, _ = (float(value) for value in feature["geometry"]["coordinates"])
        x, y, height = _vector(stated["translation"], 1e8).tolist()
        crs = _utm(path, name, (longitude, latitude), (x, y))
        axes = _rotation(stated["rotation"]).inv().as_matrix()
        width, tall = int(stated["width"]), int(stated["height"])
        focal = float(stated["focal"]) * max(width, tall)
        lens = Lens(width, tall, focal, (0.0, 0.0), None, 0.0, str(path))
        found[name] = replace(_on_map(crs, axes, (x, y, height), f"{path}, {name}"), lens=lens)
    return found


def _utm(path: Path, name: str, degrees: tuple[float, float], metres: tuple[float, float]) -> Any:
    """The CRS of the UTM zone in which (longitude, latitude) is (east, north)."""
    from rasterio.crs import CRS
    from rasterio.warp import transform

    if not (abs(degrees[0]) <= 180.0 and abs(degrees[1]) <= 90.0):
        raise ThermorenderError(
            f"{path}: longitude {degrees[0]:g}, latitude {degrees[1]:g} of {name} is not a place; give degrees in this "
            "order"
        )
    natural = math.floor((degrees[0] + 180.0) / 6.0)
    # A project on the border of two zones has one of them.
    for zone in (natural, natural - 1, natural + 1):
        crs = CRS.from_epsg((32600 if degrees[1] >= 0.0 else 32700) + zone % 60 + 1)
        (east,), (north,) = transform(CRS.from_epsg(4326), crs, [degrees[0]], [degrees[1]])
        if math.hypot(east - metres[0], north - metres[1]) < _SAME_M:
            return crs
    raise ThermorenderError(
        f"{path}: longitude {degrees[0]:g}, latitude {degrees[1]:g} of {name} is not at its translation "
        f"{metres[0]:.1f}, {metres[1]:.1f} in UTM, so the project has no georeference or another map; give "
        "opensfm/reconstruction.json of the same project"
    )


def _vector(value: Any, largest: float) -> Floats:
    """Three numbers of a file, (3,)."""
    found = np.array(value, np.float64)
    if found.shape != (3,) or not (np.abs(found) <= largest).all():
        raise ValueError(f"{value!r:.60} is not three numbers up to {largest:g}")
    return found


def _rotation(value: Any) -> Rotation:
    """The rotation of a vector along its axis, of the angle's length [rad]."""
    return Rotation.from_rotvec(_vector(value, 100.0))


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


def _angle(row: dict[str, Any], key: str, where: str) -> float:
    value = _number(row, key, where)
    if abs(value) > _LARGEST_DEG:
        raise ThermorenderError(f"{where}: {key}={value:g} is not an angle; give degrees up to {_LARGEST_DEG:g}")
    return value
