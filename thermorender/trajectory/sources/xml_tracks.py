"""Tracks in GPX and KML: positions with date-times.

Document type definitions are refused, because entities can expand without limit. GPX counts `ele` from mean sea level
(GPX 1.1 schema). KML counts `absolute` altitudes from sea level, and ignores those of the default `clampToGround` (OGC
07-147r2, KML 2.2): only their changes are used, with an anchor. The angles of a track are heading, tilt and roll [deg],
clockwise around z (up), x (right) and y (forward) (OGC 12-007r2, KML 2.3). So a positive tilt lowers the nose, and a
positive roll lowers the left side. Missing angles are 0.
"""

from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.formats import xml_root
from thermorender.trajectory.column_mapping import ANGLES, UNSTATED
from thermorender.trajectory.tables import Table

_HEIGHTS = {"absolute": "alt_geoid_m", "relativeToGround": "above_ground_m", "clampToGround": UNSTATED}


def read_gpx(path: str) -> list[Table]:
    """Return the table of all track points of a GPX file."""
    root = _root(path, "gpx")
    segments = [node for node in root.iter() if _name(node) == "trkseg"]
    points = [node for segment in segments for node in segment if _name(node) == "trkpt"]
    if not points:
        raise ThermorenderError(
            f"{path} has no track points (trkpt); routes and way points have no times: give a track"
        )
    rows, numbers, lacking = [], [], []
    for number, point in enumerate(points, start=1):
        inner = {_name(node): (node.text or "").strip() for node in point}
        cells = {"lat": point.get("lat"), "lon": point.get("lon"), "ele": inner.get("ele"), "time": inner.get("time")}
        absent = [what for what, cell in cells.items() if not cell]
        if absent:
            lacking.append(absent[0])
            continue
        # A fix in two dimensions has no measured elevation.
        rows.append([*cells.values(), "0" if inner.get("fix") in ("none", "2d") else "1"])
        numbers.append(number)
    if not rows:
        raise ThermorenderError(
            f"{path}: no track point has all of lat, lon, ele and time, the first lacks {lacking[0]}; a flight needs "
            "them: export the track with them"
        )
    notes = []
    if lacking:
        notes.append(
            f"{path}: {len(lacking)} of {len(points)} track points ({len(lacking) / len(points):.1%}) lack "
            f"{' or '.join(dict.fromkeys(lacking))} and are dropped"
        )
    if len(segments) > 1:
        notes.append(f"{path}: the track has {len(segments)} segments, and the path is straight between them")
    names = ("lat_deg", "lon_deg", "alt_geoid_m", "time", "fix")
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    return [Table(path, {**columns}, np.array(numbers), "track point", notes=tuple(notes))]


def read_kml(path: str) -> list[Table]:
    """Return the table of all samples of the tracks (gx:Track) of a KML file."""
    root = _root(path, "kml")
    tracks = [node for node in root.iter() if _name(node) == "Track"]
    if not tracks:
        raise ThermorenderError(
            f"{path} has no gx:Track; a path without times cannot be flown: export a track with times"
        )
    found = [_track(path, node) for node in tracks]
    height_column = _height_column(path, found)
    when = [text for track in found for text in track.when]
    positions = [text.split() for track in found for text in track.coord]
    turned = [_angles(path, text) for track in found for text in track.angles]
    empty = sum(track.empty for track in found)
    if not when:
        raise ThermorenderError(f"{path}: the tracks have no samples; export a track with times")
    longitude, latitude, height = (list(cells) for cells in zip(*positions, strict=True))
    columns: dict[str, Any] = {
        "time": when, "lat_deg": latitude, "lon_deg": longitude, height_column: height,
    }  # fmt: skip
    notes = []
    if len(turned) == len(when):
        columns |= dict(zip(ANGLES, np.array(turned).T, strict=True))
        if any(pitch or roll for _, pitch, roll in turned):
            notes.append(
                f"{path}: tilt and roll of gx:angles are read as KML defines them: a positive tilt lowers the nose, a "
                "positive roll the left side"
            )
    if UNSTATED in columns:
        notes.append(f"{path}: altitudeMode is clampToGround, by which KML ignores altitudes; their changes are flown")
    if empty:
        notes.append(f"{path}: {empty} samples without a position are dropped")
    return [Table(path, columns, np.arange(1, len(when) + 1), "sample", notes=tuple(notes))]


class _Track(NamedTuple):
    """The samples of a gx:Track that have a position, as texts."""

    mode: str  # Its altitudeMode
    when: list[str]
    coord: list[str]
    angles: list[str]  # One for each sample, or none
    empty: int  # Number of samples without a position


def _height_column(path: str, tracks: list[_Track]) -> str:
    """The column of the altitudes by the altitudeMode, which all tracks share."""
    modes = {track.mode for track in tracks}
    if len(modes) > 1 or not modes <= set(_HEIGHTS):
        raise ThermorenderError(
            f"{path}: altitudeMode is {' and '.join(sorted(modes))}; every track needs the same of "
            f"{', '.join(_HEIGHTS)}"
        )
    return _HEIGHTS[modes.pop()]


def _track(path: str, track: ElementTree.Element) -> _Track:
    parts: dict[str, list[str]] = {"when": [], "coord": [], "angles": [], "altitudeMode": []}
    for node in track:
        if _name(node) in parts:
            parts[_name(node)].append((node.text or "").strip())
    when, coord, angles = (parts[name] for name in ("when", "coord", "angles"))
    if len(when) != len(coord) or (angles and len(angles) != len(when)):
        raise ThermorenderError(
            f"{path}: a track has {len(when)} times, {len(coord)} positions and {len(angles)} angles; their "
            "numbers must be equal (angles may be absent)"
        )
    # An empty coordinate is a sample without a position.
    filled = [k for k, text in enumerate(coord) if text]
    empty = len(coord) - len(filled)
    when, coord, angles = ([cells[k] for k in filled] if cells else [] for cells in (when, coord, angles))
    for text in coord:
        if len(text.split()) != 3:
            raise ThermorenderError(
                f"{path}: gx:coord {text!r} is not longitude, latitude and altitude; give all three"
            )
    mode = parts["altitudeMode"][0] if parts["altitudeMode"] else "clampToGround"
    return _Track(mode, when, coord, angles, empty)


def _angles(path: str, text: str) -> tuple[float, ...]:
    """Yaw, pitch and roll [deg] of the text of gx:angles."""
    try:
        angles = [float(cell) for cell in text.split()]
    except ValueError:
        angles = []
    if not 1 <= len(angles) <= 3 or not np.isfinite(angles).all():
        raise ThermorenderError(f"{path}: gx:angles {text!r} is not heading, tilt and roll; give up to three numbers")
    heading, tilt, roll = (*angles, 0.0, 0.0)[:3]
    return heading, -tilt, -roll


def _name(node: ElementTree.Element) -> str:
    """The name of a node without its namespace."""
    return str(node.tag).rpartition("}")[2]


def _root(path: str, kind: str) -> ElementTree.Element:
    root = xml_root(path, kind.upper(), "export it again")
    if _name(root) != kind:
        raise ThermorenderError(f"{path} is not {kind.upper()}: its outermost element is {_name(root)!r}; check format")
    return root
