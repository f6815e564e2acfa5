"""Frames of a survey: their temperatures, and positions and angles from the files themselves.

A frame's own pose comes from its EXIF and XMP tags: those that `thermorender export geotiff` writes, and DJI's.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermorender import Scene
from thermorender.apps.survey.footage.lens_files import Lens
from thermorender.apps.survey.inverse.linear import RANGE_K
from thermorender.errors import ThermorenderError
from thermorender.formats import picture_tags
from thermorender.sensor.radiometric_files import check_upright
from thermorender.sensor.radiometry import ThermographySettings
from thermorender.sensor.thermal_files import (
    SUFFIXES,
    ThermalFrame,
    ThermalImage,
    files_of,
    thermal_frames,
    thermal_images,
)
from thermorender.trajectory.readers import enu_from_ned_at
from thermorender.trajectory.rotations import BODY_FROM_CAMERA, rotation_from_angles
from thermorender.units import ZERO_CELSIUS_K

Floats = NDArray[np.float64]
# Heights above the take-off point, and those above the terrain, need the terrain; the others do not.
HEIGHTS = ("up_m", "alt_ellipsoid_m", "above_ground_m", "above_takeoff_m")
_ATTRIBUTE = re.compile(r"""[\w-]+:(\w+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
# Datums within about 2 m of WGS 84.
_DATUM = re.compile(r"WGS[ -]?(19)?84|ETRS|JGD2|GDA|NAD[ -]?83|ITRF|CGCS")


@dataclass(frozen=True)
class Place:
    """Where a frame was taken, before the scene's terrain is known.

    Attributes
    ----------
    horizontal : (2,) floats
        (east, north) in the scene's frame [m], or (latitude, longitude) [deg] if `geodetic`.
    geodetic : bool
    height_m : float
    height_of : str
        One of `HEIGHTS`, what the height counts from.
    rotation : Rotation
        From camera axes to local north, east, down.
    time : str
        As in the file; empty if unknown.
    lens : Lens or None
        That the file of poses states with them.
    takeoff_m : float or None
        Height of the take-off above the ellipsoid, or what the frame states as such [m].
    error_m : float or None
        Standard deviation of the position along an axis, where the frame states one [m].
    """

    horizontal: tuple[float, float]
    geodetic: bool
    height_m: float
    height_of: str
    rotation: Rotation
    time: str = ""
    lens: Lens | None = None
    takeoff_m: float | None = None
    error_m: float | None = None


@dataclass(frozen=True, eq=False)
class Survey:
    """Frames with their measured poses.

    Attributes
    ----------
    names : tuple of str
    times : tuple of str
        Of the poses, otherwise of the frames' EXIF tags; empty where neither states one.
    kelvin : (F, H, W) float32
        Apparent temperature [K]; NaN where a pixel has none.
    poses : (F, 4, 4) float64
        world_from_camera in the scene's frame.
    notes : tuple of str
        What was assumed or left out, in sentences.
    lens : Lens or None
        Of all frames, if their poses came with one.
    air_removed : tuple of bool
        Whether the file of a frame removed the air between camera and ground; empty if none did.
    stated : (F, 4, 4) float64 or None
        The poses as measured, where `poses` are those of an adjustment.
    """

    names: tuple[str, ...]
    times: tuple[str, ...]
    kelvin: NDArray[np.float32]
    poses: Floats
    notes: tuple[str, ...] = ()
    lens: Lens | None = None
    air_removed: tuple[bool, ...] = ()
    stated: Floats | None = None

    @property
    def measured(self) -> Floats:
        """The poses (F, 4, 4) of the file or the tags."""
        return self.poses if self.stated is None else self.stated


def frame_files(paths: Iterable[Path]) -> list[Path]:
    """Return the thermal files among files and folders, sorted by name; of folders as `thermal_files.files_of`.

    Raises
    ------
    ThermorenderError
        There is none, or two have the same name.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            found += files_of(path)
        elif path.is_file():
            found.append(path)
        else:
            raise ThermorenderError(f"{path} does not exist; give radiometric frames or folders of them")
    if not found:
        raise ThermorenderError(
            f"{', '.join(map(str, paths))} holds no frame; give files that end in {', '.join(SUFFIXES)}"
        )
    found.sort(key=lambda path: (path.stem, str(path)))
    for one, other in zip(found, found[1:], strict=False):
        if one.stem == other.stem:
            raise ThermorenderError(f"{one} and {other} have the same name; give each frame once")
    return found


def places_of(files: Sequence[Path]) -> dict[str, Place]:
    """Return {name of a frame: Place} of files by their own tags."""
    return {frame.name: tagged_place(frame.path) for frame in thermal_frames(files)}


def read_frames(
    files: Sequence[Path], places: Mapping[str, Place], scene: Scene, scale: tuple[float, float] | None = None,
    above_ground_m: float | None = None,
) -> Survey:  # fmt: skip
    """Return the Survey of frames.

    Parameters
    ----------
    files : sequence of Path
        As from `frame_files`.
    places : dict
        {name of a frame without suffix: Place}, as from `pose_files.read_poses` or `places_of`.
    scene : Scene
        Its place and terrain.
    scale : (2,) floats, optional
        (kelvin per count, kelvin of count 0) of TIFFs that do not declare them.
    above_ground_m : float, optional
        Height of the first frame above the terrain. All heights are shifted to it, whatever they count from.

    Raises
    ------
    ThermorenderError
        A file that cannot be read, frames of different sizes, a frame without pose, or a scene without a place.
    """
    frames, notes = _with_places(thermal_frames(files), places)
    for path in dict.fromkeys(frame.path for frame in frames):
        check_upright(path)
    air_c = _air_of(scene)
    # The scene has emissivities, so that of a setting for all surfaces is not removed as well.
    images = thermal_images(frames, scale, "air", air_c)
    kelvin, read, invalid, copies = _gathered(frames, images)
    notes += _notes_on(invalid, read, copies, air_c)
    chosen = [places[image.frame.name] for image in read]
    poses, said = poses_of(chosen, scene, above_ground_m)
    names = tuple(image.frame.name for image in read)
    times = tuple(place.time or tagged_time(image.frame.path) for image, place in zip(read, chosen, strict=True))
    removed = tuple(image.corrected == "air" for image in read)
    return Survey(names, times, kelvin, poses, (*notes, *said), _common_lens(chosen), removed)


def _with_places(
    frames: Sequence[ThermalFrame], places: Mapping[str, Place]
) -> tuple[Sequence[ThermalFrame], list[str]]:
    """(frames that have a Place, notes on the others)."""
    missing = [frame.label for frame in frames if frame.name not in places]
    notes = []
    if missing:
        notes.append(f"{len(missing)} frames have no pose and are left out: {', '.join(missing[:5])}")
    if len(missing) == len(frames):
        raise ThermorenderError(
            f"no frame has a pose in the file of poses: it names {', '.join(sorted(places)[:3])}, and the frames are "
            f"{', '.join(missing[:3])}; write the frames' names, with the same capitals, into the file"
        )
    return [frame for frame in frames if frame.name in places], notes


def _air_of(scene: Scene) -> float | None:
    """The air's temperature over the scene's ground [°C]: of its weather, otherwise of its air; None without both."""
    if scene.time is not None:
        return float(scene.weather.at(scene.time).air_k) - ZERO_CELSIUS_K
    return None if scene.air is None else float(scene.air.air_temperature(scene.altitude_m)) - ZERO_CELSIUS_K


def _gathered(
    frames: Sequence[ThermalFrame], images: Iterable[ThermalImage]
) -> tuple[NDArray[np.float32], list[ThermalImage], int, dict[str, str]]:
    """(temperatures (F, H, W) [K], the images without their own, number of pixels left out, {copy: its original}).

    Copies of frames, pixel by pixel, are left out.
    """
    kelvin = np.empty((0, 0, 0), np.float32)
    kept, invalid, digests, copies = list[ThermalImage](), 0, dict[bytes, str](), dict[str, str]()
    for image in images:
        label = image.frame.label
        known, outside = _known(str(image.frame.path.with_name(label)), image.kelvin)
        # Even frames, such as of a closed shutter, are alike without being copies.
        even = np.nanmin(known) == np.nanmax(known)
        original = label if even else digests.setdefault(hashlib.sha256(known.tobytes()).digest(), label)
        if original != label:
            copies[label] = original
            continue
        if not kept:
            kelvin = np.empty((len(frames), *known.shape), np.float32)
        if known.shape != kelvin.shape[1:]:
            raise ThermorenderError(
                f"{image.frame.path} has {known.shape[1]}×{known.shape[0]} pixels and {kept[0].frame.path} "
                f"{kelvin.shape[2]}×{kelvin.shape[1]}; give frames of one camera"
            )
        kelvin[len(kept)] = known
        kept.append(replace(image, kelvin=np.empty((0, 0))))
        invalid += outside
    return kelvin[: len(kept)], kept, invalid, copies


def _notes_on(
    invalid: int, images: Sequence[ThermalImage], copies: Mapping[str, str], air_c: float | None
) -> list[str]:  # fmt: skip
    """Sentences on pixels without temperature, on how files were read, and on copies left out."""
    notes = []
    if invalid:
        low, high = RANGE_K
        notes.append(f"{invalid} pixels outside {low:g}–{high:g} K are left out")
    settings = [image.settings for image in images if image.settings is not None]
    if settings:
        notes.append(_said(settings))
    readings = [image.words for image in images if image.words]
    for words in dict.fromkeys(readings):
        notes.append(f"{readings.count(words)} {words}")
    if any(image.air_c is not None for image in images):
        whose = "the files' own" if air_c is None else "that of the scene"
        notes.append(f"the temperature of the air in these readings is {whose}; another moves all of them by kelvins")
    if copies:
        shown = ", ".join(f"{copy} of {original}" for copy, original in list(copies.items())[:5])
        notes.append(
            f"{len(copies)} frames are copies of others, pixel by pixel, and are left out: {shown}; check that the "
            "pose of the one that is kept is that of the picture"
        )
    return notes


def _said(settings: Sequence[ThermographySettings]) -> str:
    """What was done with the settings in files of FLIR, as a sentence."""
    parts = []
    for name, label, unit in (("distance_m", "distance", " m"), ("air_c", "air", " °C"), ("humidity", "humidity", ""),
                              ("emissivity", "emissivity", "")):  # fmt: skip
        values = {round(getattr(each, name), 3) for each in settings}
        low, high = min(values), max(values)
        parts.append(f"{label} {low:g}{unit}" if low == high else f"{label} {low:g}–{high:g}{unit}")
    return (
        f"the files of FLIR correct the air by their own settings ({', '.join(parts[:3])}); their {parts[3]} is "
        "not used, since the scene has emissivities"
    )


def _common_lens(places: Sequence[Place]) -> Lens | None:
    """The lens of all frames, None if none is stated; raise if they differ."""
    lenses = {place.lens and replace(place.lens, source=""): place.lens for place in places}
    if len(lenses) > 1:
        stated = " and ".join(lens.source if lens else "none" for lens in lenses.values())
        raise ThermorenderError(f"the frames have different lenses, {stated}; reconstruct the frames of one camera")
    return next(iter(lenses.values()))


def _known(path: str, kelvin: Floats) -> tuple[NDArray[np.float32], int]:
    """(A frame with NaN for what is not a temperature of a surface [K], number of such pixels with a value)."""
    given = ~np.isnan(kelvin)
    known = given & (kelvin >= RANGE_K[0]) & (kelvin <= RANGE_K[1])
    if 2 * known.sum() <= given.sum():
        raise ThermorenderError(
            f"{path} has no temperature; leave it out" if not given.any() else
            f"{path} holds {np.median(kelvin[given]):.6g} K in the median, outside {RANGE_K[0]:g}–{RANGE_K[1]:g} K; "
            "correct the unit in the file, or scale, or leave the frame out"
        )  # fmt: skip
    return np.where(known, kelvin, np.nan).astype(np.float32), int((given & ~known).sum())


def poses_of(places: Sequence[Place], scene: Scene, above_ground_m: float | None = None) -> tuple[Floats, list[str]]:
    """Return (world_from_camera (F, 4, 4), notes) of places over a scene.

    Raises
    ------
    ThermorenderError
        Latitudes without a place of the scene, or heights above a terrain that is not there.
    """
    position = _positions(places, scene)
    ground = np.asarray(scene.ground(position[:, 0], position[:, 1]), np.float64)
    notes = _raise_heights(position, ground, places, scene, above_ground_m)
    _check_heights(position, ground)
    turn = enu_from_ned_at(position, scene.frame) * Rotation.concatenate([place.rotation for place in places])
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turn.as_matrix(), position
    return poses, notes


def _positions(places: Sequence[Place], scene: Scene) -> Floats:
    """East, north, up (N, 3) [m] of places; up is 0 where the height counts from the terrain."""
    frame = scene.frame
    if frame is None and any(place.geodetic for place in places):
        raise ThermorenderError(
            f"{scene.where}: poses in latitude and longitude need a place of the scene; add [frame] to it"
        )
    position = np.zeros((len(places), 3))
    for row, place in zip(position, places, strict=True):
        ellipsoidal = place.height_of == "alt_ellipsoid_m"
        if place.geodetic:
            assert frame is not None
            if not (abs(place.horizontal[0]) <= 90.0 and abs(place.horizontal[1]) <= 360.0):
                raise ThermorenderError(
                    f"latitude {place.horizontal[0]:g}, longitude {place.horizontal[1]:g} is not a place; give degrees "
                    "in this order, or east_m and north_m"
                )
            row[:] = frame.enu_from_geodetic(*place.horizontal, place.height_m if ellipsoidal else frame.height_m)
        else:
            row[:2] = place.horizontal
        if place.height_of == "up_m":
            row[2] = place.height_m
        elif ellipsoidal and not place.geodetic:
            row[2] = place.height_m - (0.0 if frame is None else frame.height_m)
    return position


def _raise_heights(
    position: Floats, ground: Floats, places: Sequence[Place], scene: Scene, above_ground_m: float | None
) -> list[str]:
    """Set the heights of positions (N, 3) that count from the terrain (N,), and shift all; return notes on it."""
    kinds = {place.height_of for place in places}
    if len(kinds) > 1:
        raise ThermorenderError(f"heights of the frames count from {' and '.join(sorted(kinds))}; give one kind")
    kind, height = kinds.pop(), np.array([place.height_m for place in places])
    if kind == "above_ground_m":
        _check_inside(position, ground, scene)
    elif above_ground_m is not None or kind == "above_takeoff_m":
        _check_inside(position, ground[:1], scene)
    if above_ground_m is not None and not 0.0 < above_ground_m < np.inf:
        raise ThermorenderError(f"above_ground_m={above_ground_m!r} is not allowed; give metres, above 0")
    notes = []
    if kind == "above_ground_m":
        position[:, 2] = ground + height
    elif kind == "above_takeoff_m":
        position[:, 2] = ground[0] + height
        notes.append(f"heights count from the take-off; the terrain below the first frame, {ground[0]:.1f} m, is taken")
    if above_ground_m is not None:
        shift = ground[0] + above_ground_m - position[0, 2]
        position[:, 2] += shift
        # A shift of nothing has no sign.
        rounded = round(float(shift), 1) + 0.0
        notes.append(
            f"all heights are shifted by {rounded:+.1f} m, so that the first frame is {above_ground_m:g} m high"
        )
    return notes


def _check_heights(position: Floats, ground: Floats) -> None:
    """Refuse positions (N, 3) that are not finite, or not above the terrain (N,) where it is known."""
    if not np.isfinite(position).all():
        raise ThermorenderError("a frame's position is not finite; give numbers")
    above = position[:, 2] - ground
    over = np.isfinite(above)
    if over.any() and above[over].max() < 1.0:
        raise ThermorenderError(
            f"the frames are up to {above[over].max():.0f} m above the terrain, so their heights count from elsewhere; "
            "state the height of the first frame as above_ground"
        )
    if (above[over] < 0.0).any():
        number = int(np.flatnonzero(over & (above < 0.0))[0])
        raise ThermorenderError(
            f"frame {number + 1} of {len(position)} is {-above[number]:.0f} m below the terrain and others are above; "
            "correct its height, or leave the frame out"
        )


def _check_inside(position: Floats, ground: Floats, scene: Scene) -> None:
    """Raise if the terrain's height, (N,), is unknown below one of the first N positions."""
    if np.isfinite(ground).all():
        return
    number = int(np.flatnonzero(~np.isfinite(ground))[0])
    raise ThermorenderError(
        f"frame {number + 1} is {position[number, 0]:.0f} m east and {position[number, 1]:.0f} m north of the middle "
        f"of {scene.name}, outside its terrain, and its height counts from there; check the order of latitude and "
        "longitude, and leave out frames beyond the terrain or give heights above the ellipsoid"
    )


def tagged_place(path: Path) -> Place:
    """Return the Place that a frame's EXIF and XMP tags state.

    Raises
    ------
    ThermorenderError
        No position, angles or height in the tags.
    """
    try:
        tags, exif, gps, xmp = picture_tags(path)
    except ValueError as error:
        raise ThermorenderError(f"the tags of {path} cannot be read: {error}; give the poses in a file") from None
    stated = xmp_values(xmp)
    where = _horizontal(path, gps, stated)
    angles = [stated.get(f"Gimbal{name}Degree") for name in ("Yaw", "Pitch", "Roll")]
    absent = [name for name, value in zip(("yaw", "pitch", "roll"), angles, strict=True) if value is None]
    gimbal = "gimbal angles" if len(absent) == 3 else f"gimbal {' and '.join(absent)}"
    missing = [name for name, lacks in (("position", where is None), (gimbal, bool(absent))) if lacks]
    if where is None or missing:
        raise ThermorenderError(
            f"{path} states no {' and no '.join(missing)} in its EXIF and XMP tags; give the poses in a file"
        )
    height, kind = _height(path, gps, stated)
    if height is None:
        sea = ", only one above sea level," if 6 in gps else ""
        raise ThermorenderError(
            f"{path} states no height above the take-off or the ellipsoid{sea} in its EXIF and XMP tags; give the "
            "poses in a file"
        )
    numbers = [_number(path, name, value) for name, value in zip(("yaw", "pitch", "roll"), angles, strict=True)]
    takeoff_m = None
    if kind == "above_takeoff_m" and "AbsoluteAltitude" in stated:
        takeoff_m = _number(path, "AbsoluteAltitude", stated["AbsoluteAltitude"]) - height
    return Place(where, True, height, kind, camera_rotation(*numbers), _time(tags, exif), takeoff_m=takeoff_m,
                 error_m=_position_error(path, stated))  # fmt: skip


def _position_error(path: Path, stated: Mapping[str, str]) -> float | None:
    """Standard deviation of a position [m] by RTK with fixed ambiguities, RtkFlag 50; None if the tags state none."""
    names = "RtkStdLon", "RtkStdLat", "RtkStdHgt"
    if stated.get("RtkFlag", "").strip() != "50" or not all(name in stated for name in names):
        return None
    return max(_number(path, name, stated[name]) for name in names)


def tagged_time(path: Path) -> str:
    """Return the time that a frame's EXIF tags state, as in the file; empty if they state none or cannot be read."""
    try:
        tags, exif, _, _ = picture_tags(path)
    except ValueError:
        return ""
    return _time(tags, exif)


def _time(tags: Mapping[int, Any], exif: Mapping[int, Any]) -> str:
    """The time in a picture's tags: of the exposure, otherwise of the file."""
    return str(exif.get(36867, "") or tags.get(306, "")).strip("\0 ")


def camera_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Rotation:
    """Return the rotation from camera axes to north, east, down, of the optical axis's angles; pitch −90 looks down."""
    return rotation_from_angles(yaw_deg, pitch_deg, roll_deg) * Rotation.from_matrix(BODY_FROM_CAMERA)


def xmp_values(text: str) -> dict[str, str]:
    """Return {name: value} of the attributes and simple elements of an XMP packet, without their namespaces."""
    found = {name: double or single for name, double, single in _ATTRIBUTE.findall(text)}
    return found | dict(re.findall(r"<[\w-]+:(\w+)>([^<]*)</", text))


def _number(path: Path, name: str, value: Any) -> float:
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        found = float("nan")
    if not np.isfinite(found):
        raise ThermorenderError(
            f"{path} states {name}={value!r} in its tags, which is not a number; give the poses in a file"
        )
    return found


def _horizontal(path: Path, gps: Mapping[int, Any], stated: Mapping[str, str]) -> tuple[float, float] | None:
    """(latitude, longitude) [deg] of the tags; None if they state none."""
    found = _stated(path, gps, stated)
    datum = str(gps.get(18, "")).strip("\0 ")
    fault = None
    if found == (0.0, 0.0) or str(gps.get(9, "A")).startswith("V"):
        fault = "that its receiver had no fix (GPSStatus V, or latitude and longitude 0)"
    elif datum and not _DATUM.match(datum.upper()):
        fault = f"positions in the datum {datum!r}, not WGS 84"
    if found is not None and fault:
        raise ThermorenderError(f"{path} states {fault}; give the poses in a file")
    return found


def _stated(path: Path, gps: Mapping[int, Any], stated: Mapping[str, str]) -> tuple[float, float] | None:
    if 2 in gps and 4 in gps:
        signs = []
        for key, positive, negative in ((1, "N", "S"), (3, "E", "W")):
            side = str(gps.get(key, "")).strip("\0 ").upper()[:1]
            if side not in (positive, negative) or not side:
                raise ThermorenderError(
                    f"{path} states a GPS position without {positive} or {negative}; give the poses in a file"
                )
            signs.append(1.0 if side == positive else -1.0)
        latitude, longitude = (_degrees(path, gps[key]) for key in (2, 4))
        return signs[0] * latitude, signs[1] * longitude
    for names in (("GpsLatitude", "GpsLongitude"), ("GpsLatitude", "GpsLongtitude")):
        if all(name in stated for name in names):
            return _number(path, names[0], stated[names[0]]), _number(path, names[1], stated[names[1]])
    return None


def _degrees(path: Path, value: Any) -> float:
    parts = value if isinstance(value, (tuple, list)) else (value,)
    numbers = [_number(path, "a GPS coordinate", part) for part in parts]
    return sum(number / 60.0**power for power, number in enumerate(numbers))


def _height(path: Path, gps: Mapping[int, Any], stated: Mapping[str, str]) -> tuple[float | None, str]:
    """(height [m], what it counts from). DJI's absolute heights are off by up to 100 m."""
    given = gps.get(5, 0)
    # GPSAltitudeRef of Exif 3.0: 0 and 1 above and below sea level, 2 and 3 above and below the ellipsoid.
    reference = given[0] if isinstance(given, bytes) and given else given
    if 6 in gps and (stated.get("VertCS") == "ellipsoidal" or reference in (2, 3)):
        below = -1.0 if reference in (1, 3) else 1.0
        return below * _number(path, "GPSAltitude", gps[6]), "alt_ellipsoid_m"
    if "RelativeAltitude" in stated:
        return _number(path, "RelativeAltitude", stated["RelativeAltitude"]), "above_takeoff_m"
    return None, ""
