"""Positions in the scene's frame from a log's coordinates and its height column.

Geodetic coordinates are converted through ECEF, which includes the Earth's curvature and the tilt of the vertical.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import FARTHEST_M, LocalFrame, ecef_from_geodetic
from thermorender.trajectory.column_mapping import POSITION_GEODETIC, UNSTATED, Mapping, changed_mapping
from thermorender.trajectory.logs import Log
from thermorender.trajectory.path import GroundHeight, Trajectory

Floats = NDArray[np.float64]

_MOVE = "move the flight into the scene with anchor=E,N,U,heading"


def frame_of_first_sample(log: Log) -> LocalFrame:
    """Return a `LocalFrame` on the ellipsoid at the first row's latitude and longitude."""
    _refuse_impossible_coordinates(log)
    return LocalFrame(float(log.values["lat_deg"][0]), float(log.values["lon_deg"][0]), 0.0)


def geodetic_of_local(log: Log, radius_m: float = 6_371_000.0) -> Log:
    """Return a log of local positions with latitude and longitude, by PX4's azimuthal equidistant projection.

    On a sphere: Snyder, Map Projections: A Working Manual, 1987, eq. 20-14, 20-15, doi:10.3133/pp1395.
    """
    assert log.origin is not None, "called for a log with an origin"
    values = dict(log.values)
    east, north = values.pop("east_m") / radius_m, values.pop("north_m") / radius_m
    latitude, longitude = np.radians(log.origin)
    angle = np.hypot(east, north)
    share = np.sinc(angle / np.pi)
    sine = np.cos(angle) * np.sin(latitude) + north * share * np.cos(latitude)
    turned = np.arctan2(east * share, np.cos(latitude) * np.cos(angle) - north * np.sin(latitude) * share)
    values["lat_deg"] = np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))
    values["lon_deg"] = np.degrees(longitude + turned)
    return replace(log, values=values)


def _refuse_impossible_coordinates(log: Log) -> None:
    latitude, longitude = log.values["lat_deg"], log.values["lon_deg"]
    log.refuse("lat_deg", np.abs(latitude) > 90.0, "latitudes are −90…90 deg")
    log.refuse("lon_deg", (longitude < -180.0) | (longitude > 360.0), "longitudes are −180…180 or 0…360 deg")


def local_positions(
    log: Log, horizontal: tuple[str, ...], height: str, frame: LocalFrame | None, ground: GroundHeight | None,
    undulation: float | None, relative: bool,
) -> Floats:  # fmt: skip
    """Return the vehicle's positions at the log's rows, (N, 3) local east, north, up [m].

    `horizontal` and `height` name its columns; `frame`, `ground` and `undulation` are as in `read_trajectory`. With
    `relative`, for an anchored flight, only changes of height matter.
    """
    value = log.values[height]
    where = log.where(height, 0)
    if relative:
        follows_ellipsoid = horizontal == POSITION_GEODETIC and height not in ("up_m", "above_ground_m")
        height = "alt_ellipsoid_m" if follows_ellipsoid else "up_m"
    if height == UNSTATED:
        raise ThermorenderError(
            f"{where}: the log does not say what its height is relative to; move the flight with anchor "
            "E,N,U,HEADING, where U is the height of its first position above the ground"
        )
    if height == "alt_geoid_m":
        if undulation is None:
            raise ThermorenderError(
                f"{where}: heights above the geoid need the scene's geoid_undulation_m, which is not given; "
                "add it to the scene or give alt_ellipsoid_m"
            )
        height, value = "alt_ellipsoid_m", value + undulation
    if height in ("above_ground_m", "above_takeoff_m") and ground is None:
        raise ThermorenderError(
            f"{where}: heights of this reference need the ground, and none is given; render a scene with "
            "terrain, or give an anchor or a height of another reference (up_m, alt_ellipsoid_m, alt_geoid_m)"
        )
    # With above_ground_m and above_takeoff_m the ground is known from here on.
    if horizontal == POSITION_GEODETIC:
        return _geodetic_positions(log, frame, ground, height, value, relative)
    east, north = log.values["east_m"], log.values["north_m"]
    if height == "alt_ellipsoid_m":
        if frame is None:
            raise ThermorenderError(
                f"{where}: heights above the ellipsoid need the scene's georeference, which is not given; write up_m"
            )
        up = value - frame.height_m
        # The vertical tilts by less than 0.9° within 100 km, so each step reduces the error to 1e-4 of it.
        for _ in range(3):
            up = up + value - frame.geodetic_from_enu(np.stack([east, north, up], axis=-1))[2]
    elif height == "above_ground_m":
        up = value + _ground_below(log, height, ground, east, north)
    elif height == "above_takeoff_m":
        up = value + _ground_below(log, height, ground, east[:1], north[:1])[0]
    else:
        up = value
    return np.stack([east, north, up], axis=-1)


def refuse_exchanged(log: Log, frame: LocalFrame, mapping: Mapping, logs: Sequence[Log]) -> None:
    """Raise if all coordinates of a log are near the scene only with latitude and longitude exchanged.

    `mapping` and all `logs` of the flight are for the advice.
    """
    latitude, longitude = log.values["lat_deg"], log.values["lon_deg"]
    if (np.abs(longitude) > 90.0).any():
        return
    as_given, exchanged = (
        np.linalg.norm(ecef_from_geodetic(*pair, frame.height_m) - frame.origin_ecef, axis=-1)
        for pair in ((latitude, longitude), (longitude, latitude))
    )
    if as_given.min() > FARTHEST_M and exchanged.max() <= FARTHEST_M:
        latitude_column, longitude_column = (log.columns.get(name, name) for name in POSITION_GEODETIC)
        columns = {name: column for each in logs for name, column in each.columns.items()}
        columns |= {"lat_deg": longitude_column, "lon_deg": latitude_column}
        table = ", ".join(f"{name} = {column!r}" for name, column in columns.items())
        raise ThermorenderError(
            f"{log.path}: the positions are {_km(as_given.min())} km from the scene's origin, and "
            f"{exchanged.min() / 1e3:.3g} km with latitude and longitude exchanged; exchange the columns "
            f"{latitude_column!r} and {longitude_column!r} in the log, or give {changed_mapping(mapping)} as format, "
            "with " + ("the two exchanged" if mapping.quantities else f"lines [columns], {table} at its end")
        )


def _geodetic_positions(
    log: Log, frame: LocalFrame | None, ground: GroundHeight | None, height: str, value: Floats, relative: bool
) -> Floats:
    latitude, longitude = log.values["lat_deg"], log.values["lon_deg"]
    if frame is None:
        raise ThermorenderError(
            f"{log.where('lat_deg', 0)}: latitude and longitude need the scene's georeference, which is not "
            "given; move the flight into the scene with an anchor"
        )
    _refuse_impossible_coordinates(log)
    distance = np.linalg.norm(ecef_from_geodetic(latitude, longitude, frame.height_m) - frame.origin_ecef, axis=-1)
    if (distance > FARTHEST_M).any():
        k = int(np.argmax(distance > FARTHEST_M))
        raise ThermorenderError(
            f"{log.where('lat_deg', k)}: the position is {_km(distance[k])} km from "
            + (
                f"the first sample; up to {FARTHEST_M / 1e3:.0f} km are allowed: delete rows without a fix"
                if relative
                else f"the scene's origin; up to {FARTHEST_M / 1e3:.0f} km are allowed: {_MOVE}"
            )
        )

    # At fixed latitude and longitude a point moves along a straight line with its ellipsoid height.
    foot = frame.enu_from_geodetic(latitude, longitude, 0.0)
    normal = frame.enu_from_geodetic(latitude, longitude, 1.0) - foot

    def at_up(up: Floats) -> Floats:
        return foot + ((up - foot[:, 2]) / normal[:, 2])[:, None] * normal

    if height == "alt_ellipsoid_m":
        return frame.enu_from_geodetic(latitude, longitude, value)
    if height == "up_m":
        return at_up(value)
    # Because the vertical is tilted, the point on the ground depends on the ground's height: iterate.
    up = np.zeros(value.size)
    samples = slice(None) if height == "above_ground_m" else slice(0, 1)
    for _ in range(5):
        position = at_up(up)[samples]
        terrain = _ground_below(log, height, ground, position[:, 0], position[:, 1])
        up = terrain + value if height == "above_ground_m" else np.full(value.size, terrain[0])
    if height == "above_ground_m":
        return at_up(up)
    takeoff_ellipsoid = (up[0] - foot[0, 2]) / normal[0, 2]
    return foot + (takeoff_ellipsoid + value)[:, None] * normal


def _ground_below(log: Log, height: str, ground: GroundHeight | None, east: Floats, north: Floats) -> Floats:
    assert ground is not None, "local_positions refuses heights above an unknown ground"
    up = np.asarray(ground(east, north), np.float64)
    if not np.isfinite(up).all():
        k = int(np.argmax(~np.isfinite(up)))
        raise ThermorenderError(
            f"{log.where(height, k)}: there is no ground below east {east[k]:.1f} m, north {north[k]:.1f} m; "
            "the position is off the scene's terrain: move the flight with an anchor or give a height of "
            "another reference"
        )
    return up


def _km(distance: float) -> str:
    kilometres = distance / 1e3
    return f"{kilometres:.0f}" if kilometres < 1e9 else f"{kilometres:.3g}"


def refuse_far(log: Log, trajectory: Trajectory) -> None:
    """Raise if a camera position is more than 100 km from the scene's origin."""
    east, north, up = trajectory.position.T
    distance = np.hypot(np.hypot(east, north), up)
    if (distance > FARTHEST_M).any():
        k = int(np.argmax(distance > FARTHEST_M))
        raise ThermorenderError(
            f"{log.path}, at {trajectory.time_s[k]:.3f} s: the position is {_km(distance[k])} km from "
            f"the scene's origin; up to {FARTHEST_M / 1e3:.0f} km are allowed: {_MOVE}"
        )
