"""Trajectories: interpolation, axes, heights, anchoring, and the errors of flight logs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import shared_data

from scenes import flat
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.trajectory.path import (
    Anchor,
    Trajectory,
    check_above_ground,
    parse_anchor,
    parse_lever_arm,
    parse_mount,
)
from thermorender.trajectory.readers import read_trajectory
from thermorender.trajectory.rotations import rotation_from_angles, wxyz

FRAME = LocalFrame(47.2, 8.5, 430.0)

EAST, NORTH, UP = np.eye(3)


def slope(east, north):
    return 100.0 + 0.1 * np.asarray(east) - 0.05 * np.asarray(north)


def write(folder, text, name="flight.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def read(folder, text, **options):
    return read_trajectory(write(folder, text), **options)


def axes(trajectory, sample=0):
    """The camera's right, down and forward directions in east, north, up."""
    return trajectory.rotation[sample].as_matrix().T


def straight(count=3, step=(0.0, 10.0, 0.0)):
    """A flight that looks north."""
    times = np.arange(count, dtype=float)
    looking_north = wxyz(Rotation.from_matrix(np.stack([EAST, -UP, NORTH], axis=-1)))
    return Trajectory(times, times[:, None] * np.array(step) + [0.0, 0.0, 50.0], np.tile(looking_north, (count, 1)))


# Interpolation


def test_slerp_turns_evenly_and_position_is_linear():
    turn = Rotation.from_rotvec(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    path = Trajectory([10.0, 14.0], [[0.0, 0.0, 0.0], [8.0, -4.0, 2.0]], wxyz(turn))
    for share in (0.0, 0.25, 0.7, 1.0):
        pose = path.pose(10.0 + 4.0 * share)
        # About a fixed axis slerp is a rotation by the share of the angle.
        c, s = np.cos(2.0 * share), np.sin(2.0 * share)
        assert np.allclose(pose[:3, :3], [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], atol=1e-14)
        assert np.allclose(pose[:3, 3], np.array([8.0, -4.0, 2.0]) * share, atol=1e-14)
        assert np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])


def test_slerp_takes_the_shorter_way_for_either_sign_of_the_quaternion():
    quaternion = wxyz(Rotation.from_euler("z", [[170.0], [190.0]], degrees=True))
    for sign in (1.0, -1.0):
        path = Trajectory([0.0, 1.0], np.zeros((2, 3)), quaternion * np.array([[1.0], [sign]]))
        assert np.allclose(path.pose(0.5)[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-14)


def test_poses_survive_the_round_trip():
    generator = np.random.Generator(np.random.Philox(3))
    quaternion = generator.normal(size=(20, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1)[:, None]
    position = generator.normal(size=(20, 3)) * 100.0
    path = Trajectory(np.arange(20.0), position, quaternion)
    w, x, y, z = quaternion.T
    closed_form = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    assert np.allclose(path.poses()[:, :3, :3], closed_form, atol=1e-14)
    assert np.array_equal(path.poses()[:, :3, 3], position)
    for k in (0, 7, 19):
        assert np.allclose(path.pose(float(k)), path.poses()[k], atol=1e-13)
    again = path.sampled(path.time_s)
    assert np.allclose(np.abs(np.sum(again.quaternion * quaternion, axis=1)), 1.0, atol=1e-14)


@pytest.mark.parametrize("time_s", [-0.001, 2.001, float("nan")])
def test_outside_the_span_is_refused(time_s):
    with pytest.raises(ThermorenderError, match="outside the trajectory, which spans 0 to 2 s"):
        straight().pose(time_s)


def test_a_single_sample_is_a_trajectory():
    path = straight(1)
    assert np.allclose(path.pose(0.0)[:3, 3], [0.0, 0.0, 50.0])
    assert np.array_equal(path.frame_times(30.0), [0.0])
    with pytest.raises(ThermorenderError, match="spans 0 to 0 s"):
        path.pose(0.1)


def test_frame_times_reach_the_end_despite_rounding():
    path = Trajectory([0.1, 0.4], np.zeros((2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
    times = path.frame_times(10.0)
    assert np.allclose(times, [0.1, 0.2, 0.3, 0.4]) and times[-1] <= 0.4
    assert np.allclose(straight().frame_times(0.8), [0.0, 1.25])
    assert np.allclose(straight().frame_times(2.0, start_s=0.5, stop_s=1.4), [0.5, 1.0])
    with pytest.raises(ThermorenderError, match=r"rate_hz=0.* must be a positive number"):
        path.frame_times(0.0)
    with pytest.raises(ThermorenderError, match="within the trajectory's span, 0 to 2 s"):
        straight().frame_times(2.0, start_s=-1.0)


def test_invalid_trajectories_are_refused():
    path = straight()
    with pytest.raises(ThermorenderError, match="sample 2 at 1 s follows 1 s: time is running backwards or standing"):
        Trajectory([0.0, 1.0, 1.0], path.position, path.quaternion)
    with pytest.raises(ThermorenderError, match=r"position has shape \(3, 2\); 3 times need \(3, 3\)"):
        Trajectory(path.time_s, path.position[:, :2], path.quaternion)
    with pytest.raises(ThermorenderError, match="sample 1 is nan; all values must be finite"):
        Trajectory([0.0, np.nan, 2.0], path.position, path.quaternion)
    with pytest.raises(ThermorenderError, match="sample 0 has length 2; unit quaternions"):
        Trajectory(path.time_s, path.position, path.quaternion * 2.0)
    rounded = Trajectory(path.time_s, path.position, path.quaternion * 1.0005)
    assert np.allclose(np.linalg.norm(rounded.quaternion, axis=1), 1.0, rtol=0.0, atol=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        path.position[0, 0] = 1.0
    assert "3 samples, 0.000…2.000 s" in repr(path) and "north 0.0…20.0 m" in repr(path)


# Axes


def test_without_attitude_the_camera_looks_level_and_north(tmp_path):
    path = read(tmp_path, "time_s,east_m,north_m,up_m\n0,1,2,3\n")
    assert np.allclose(axes(path), [EAST, -UP, NORTH], atol=1e-14)
    assert np.allclose(path.position, [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("angles", "right", "forward"),
    [
        ((0, -90, 0), EAST, -UP),  # straight down, north at the image's upper edge
        ((90, -90, 0), -NORTH, -UP),  # the same flying east: east on top
        ((90, 0, 0), -NORTH, EAST),
        ((0, 90, 0), EAST, UP),
        ((0, 0, 90), -UP, NORTH),  # right wing down: the image's right edge points down
        ((180, -45, 0), -EAST, (-NORTH - UP) / 2**0.5),
    ],
)
def test_aviation_angles_by_hand(tmp_path, angles, right, forward):
    header = "time_s,east_m,north_m,up_m,{0}yaw_deg,{0}pitch_deg,{0}roll_deg\n0,0,0,9,{1},{2},{3}\n"
    body = read(tmp_path, header.format("", *angles))
    assert np.allclose(axes(body)[[0, 2]], [right, forward], atol=1e-14)
    assert np.allclose(axes(body)[1], np.cross(forward, right), atol=1e-14)
    gimbal = read(tmp_path, header.format("gimbal_", *angles))
    assert np.allclose(axes(gimbal), axes(body), atol=1e-14)
    # A forward-looking vehicle with the same angles as its camera mount sees the same.
    mounted = read(tmp_path, "time_s,east_m,north_m,up_m\n0,0,0,9\n", mount=angles)
    assert np.allclose(axes(mounted), axes(body), atol=1e-14)


def test_mount_turns_with_the_body(tmp_path):
    text = "time_s,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg\n0,0,0,9,90,-10,0\n"
    right, down, forward = axes(read(tmp_path, text, mount=(0.0, -80.0, 0.0)))
    assert np.allclose([right, down, forward], [-NORTH, -EAST, -UP], atol=1e-14)
    aft = axes(read(tmp_path, "time_s,east_m,north_m,up_m\n0,0,0,9\n", mount=(180.0, 0.0, 0.0)))
    assert np.allclose(aft, [-EAST, -UP, -NORTH], atol=1e-14)


def test_quaternion_is_body_frd_to_ned(tmp_path):
    half = np.sqrt(0.5)
    # 90° about NED's down axis: the nose turns from north to east.
    path = read(tmp_path, f"time_s,east_m,north_m,up_m,qw,qx,qy,qz\n0,0,0,9,{half},0,0,{half}\n")
    assert np.allclose(axes(path), [-NORTH, -UP, EAST], atol=1e-9)
    angles = (37.0, -12.0, 140.0)
    w, x, y, z = wxyz(rotation_from_angles(*angles))
    quaternion = read(tmp_path, f"time_s,east_m,north_m,up_m,qw,qx,qy,qz\n0,0,0,9,{w},{x},{y},{z}\n")
    text = "time_s,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg\n0,0,0,9,37,-12,140\n"
    assert np.allclose(axes(quaternion), axes(read(tmp_path, text)), atol=1e-12)


def test_gimbal_without_yaw_follows_the_body_and_the_body_turns_only_the_lever(tmp_path):
    text = "time_s,east_m,north_m,up_m,yaw_deg,roll_deg,gimbal_pitch_deg\n0,0,0,9,90,20,-90\n"
    assert np.allclose(axes(read(tmp_path, text)), [-NORTH, -EAST, -UP], atol=1e-14)
    text = "time_s,east_m,north_m,up_m,yaw_deg,gimbal_yaw_deg,gimbal_pitch_deg\n0,0,0,9,90,0,-90\n"
    path = read(tmp_path, text, lever_arm_m=(2.0, 0.5, 1.0))
    assert np.allclose(path.position, [[2.0, -0.5, 8.0]], atol=1e-14)
    assert np.allclose(axes(path), [EAST, -NORTH, -UP], atol=1e-14)


def test_gimbal_flip_is_the_same_attitude(tmp_path):
    header = "time_s,east_m,north_m,up_m,gimbal_yaw_deg,gimbal_pitch_deg,gimbal_roll_deg\n"
    flipped = read(tmp_path, header + "0,0,0,9,-91,-90,180\n")
    plain = read(tmp_path, header + "0,0,0,9,89,-90,0\n")
    assert np.allclose(axes(flipped), axes(plain), atol=1e-14)


# Positions and heights


def test_latitude_and_longitude_agree_with_local_coordinates_to_a_millimetre(tmp_path):
    generator = np.random.Generator(np.random.Philox(5))
    local = generator.uniform(-5000.0, 5000.0, (30, 3)) * [1.0, 1.0, 0.1] + [0.0, 0.0, 700.0]
    lat, lon, height = FRAME.geodetic_from_enu(local)
    rows = "".join(f"{k},{a:.11f},{o:.11f},{h:.6f}\n" for k, (a, o, h) in enumerate(zip(lat, lon, height, strict=True)))
    path = read(tmp_path, "time_s,lat_deg,lon_deg,alt_ellipsoid_m\n" + rows, frame=FRAME)
    assert np.abs(path.position - local).max() < 1e-3
    geoid = "".join(
        f"{k},{a:.11f},{o:.11f},{h - 47.5:.6f}\n" for k, (a, o, h) in enumerate(zip(lat, lon, height, strict=True))
    )
    path = read(tmp_path, "time_s,lat_deg,lon_deg,alt_geoid_m\n" + geoid, frame=FRAME, geoid_undulation_m=47.5)
    assert np.abs(path.position - local).max() < 1e-3
    up = "".join(
        f"{k},{a:.11f},{o:.11f},{u:.6f}\n" for k, (a, o, u) in enumerate(zip(lat, lon, local[:, 2], strict=True))
    )
    path = read(tmp_path, "time_s,lat_deg,lon_deg,up_m\n" + up, frame=FRAME)
    assert np.abs(path.position - local).max() < 1e-3
    mixed = "".join(f"{k},{p[0]:.6f},{p[1]:.6f},{h:.6f}\n" for k, (p, h) in enumerate(zip(local, height, strict=True)))
    path = read(tmp_path, "time_s,east_m,north_m,alt_ellipsoid_m\n" + mixed, frame=FRAME)
    assert np.abs(path.position - local).max() < 1e-3


def test_north_and_down_are_local_to_the_place(tmp_path):
    # 50 km east the vertical tilts by 50/6388 rad and north by longitude × sin(latitude).
    lat, lon, height = FRAME.geodetic_from_enu(np.array([50e3, 0.0, 1000.0]))
    text = f"time_s,lat_deg,lon_deg,alt_ellipsoid_m,gimbal_pitch_deg\n0,{lat:.10f},{lon:.10f},{height:.3f},-90\n"
    right, _, forward = axes(read(tmp_path, text, frame=FRAME))
    dlon = np.radians(lon - FRAME.longitude_deg)
    assert forward[0] == pytest.approx(-np.cos(np.radians(lat)) * np.sin(dlon), abs=1e-12)
    assert right[1] == pytest.approx(np.sin(np.radians(FRAME.latitude_deg)) * np.sin(dlon), abs=1e-12)


@pytest.mark.parametrize("geodetic", [False, True])
def test_heights_above_ground_and_above_takeoff(tmp_path, geodetic):
    positions = np.array([[0.0, 0.0], [800.0, 0.0], [800.0, -600.0]])
    if geodetic:
        lat, lon, _ = FRAME.geodetic_from_enu(np.column_stack([positions, slope(*positions.T)]))
        names, pairs = "lat_deg,lon_deg", [f"{a:.11f},{o:.11f}" for a, o in zip(lat, lon, strict=True)]
    else:
        names, pairs = "east_m,north_m", [f"{e},{n}" for e, n in positions]
    heights = [30.0, 40.0, 50.0]
    rows = "".join(f"{k},{pair},{h}\n" for k, (pair, h) in enumerate(zip(pairs, heights, strict=True)))
    above = read(tmp_path, f"time_s,{names},above_ground_m\n" + rows, frame=FRAME, ground=slope)
    assert np.allclose(above.above_ground(slope), heights, atol=1e-3)
    assert np.allclose(above.position[:, 2], slope(*positions.T) + heights, atol=0.01)
    takeoff = read(tmp_path, f"time_s,{names},above_takeoff_m\n" + rows, frame=FRAME, ground=slope)
    # Altitudes follow the Earth's curvature, 8 cm down at 1 km; local coordinates are taken as they are.
    drop = (np.hypot(*positions.T) ** 2 / (2 * 6.38e6)) if geodetic else 0.0
    assert np.allclose(takeoff.position[:, 2], 100.0 + np.array(heights) - drop, atol=1e-3)


def test_exact_duplicates_are_dropped_and_the_clock_is_shifted(tmp_path):
    text = "time_s,east_m,north_m,up_m\n0,0,0,1\n0,0,0,1\n\n1,5,0,1\n"
    path = read(tmp_path, text, clock_offset_s=-2.5)
    assert np.array_equal(path.time_s, [-2.5, -1.5])
    assert np.allclose(path.position[:, 0], [0.0, 5.0])


# Anchoring


def test_anchoring_moves_and_turns_rigidly():
    generator = np.random.Generator(np.random.Philox(7))
    quaternion = generator.normal(size=(6, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1)[:, None]
    path = Trajectory(np.arange(6.0), generator.normal(size=(6, 3)) * 100.0, quaternion)
    moved = path.anchored(1000.0, -200.0, 75.0)
    assert np.allclose(moved.position[0], [1000.0, -200.0, path.position[0, 2]])
    assert moved.first_heading_deg == pytest.approx(75.0)
    assert np.allclose(moved.position[:, 2], path.position[:, 2])
    # The camera's view of the flight's other positions does not change.
    before, after = path.poses(), moved.poses()
    assert np.allclose(np.linalg.inv(before[0]) @ before[4], np.linalg.inv(after[0]) @ after[4], atol=1e-9)
    back = moved.anchored(*path.position[0, :2], path.first_heading_deg)
    assert np.allclose(back.poses(), path.poses(), atol=1e-9)
    assert moved.anchored(0.0, 0.0, 0.0, up=7.0).position[0, 2] == pytest.approx(7.0)


def test_first_heading():
    assert straight().first_heading_deg == pytest.approx(0.0)
    assert straight(step=(-3.0, 0.0, 1.0)).first_heading_deg == pytest.approx(270.0)
    # Standing still: the view's direction; straight down, the image's upper edge.
    assert straight(step=(0.0, 0.0, 5.0)).first_heading_deg == pytest.approx(0.0)
    down = wxyz(Rotation.from_matrix(np.stack([-NORTH, -EAST, -UP], axis=-1)))
    assert Trajectory([0.0], [[0.0, 0.0, 9.0]], [down]).first_heading_deg == pytest.approx(90.0)
    # Jitter before the flight starts to move does not count.
    jitter = Trajectory([0.0, 1.0, 2.0], [[0, 0, 0], [-0.3, 0, 0], [4.0, 0, 0]], straight().quaternion)
    assert jitter.first_heading_deg == pytest.approx(90.0)


def test_an_anchored_log_keeps_its_shape_and_starts_above_the_ground(tmp_path):
    text = "time_s,east_m,north_m,up_m\n0,7000,8000,300\n1,7000,8010,310\n2,7000,8020,305\n"
    anchor = Anchor(10.0, 20.0, 60.0, 90.0)
    path = read(tmp_path, text, anchor=anchor, ground=slope)
    start = slope(10.0, 20.0) + 60.0
    assert np.allclose(path.position, [[10, 20, start], [20, 20, start + 10], [30, 20, start + 5]])
    assert np.allclose(axes(path), [-NORTH, -UP, EAST], atol=1e-12)
    free = read(tmp_path, text, anchor=anchor)
    assert np.allclose(free.position[:, 2], [60.0, 70.0, 65.0])


def test_an_anchored_log_above_ground_follows_the_new_ground(tmp_path):
    text = "time_s,east_m,north_m,above_ground_m\n0,0,0,40\n1,0,100,45\n"
    path = read(tmp_path, text, anchor=Anchor(0.0, 0.0, 60.0, 90.0), ground=slope)
    assert np.allclose(path.above_ground(slope), [60.0, 65.0])
    assert np.allclose(path.position[1], [100.0, 0.0, 175.0])
    with pytest.raises(ThermorenderError, match="a log of above_ground_m follows the ground, and none is given"):
        read(tmp_path, text, anchor=Anchor(0.0, 0.0, 60.0, 90.0))


@pytest.mark.parametrize("height", ["alt_ellipsoid_m", "alt_geoid_m", "above_takeoff_m", "up_m"])
def test_anchoring_brings_a_far_log_into_a_scene_without_georeference(tmp_path, height):
    far = LocalFrame(-33.9, 151.2, 0.0)
    # The last point is 20 km away, where an altitude is 31 m higher than local up.
    local = np.array([[0.0, 0.0, 80.0], [0.0, 30.0, 90.0], [0.0, 20e3, 85.0]])
    lat, lon, altitude = far.geodetic_from_enu(local)
    value = local[:, 2] if height == "up_m" else altitude
    rows = "".join(f"{k},{a:.12f},{o:.12f},{v:.6f}\n" for k, (a, o, v) in enumerate(zip(lat, lon, value, strict=True)))
    text = f"time_s,lat_deg,lon_deg,{height}\n" + rows
    path = read(tmp_path, text, anchor=Anchor(5.0, 6.0, 80.0, 0.0), ground=flat)
    assert np.allclose(path.position, local + [5.0, 6.0, 0.0], atol=1e-3)


# Command-line values


def test_command_line_values_are_parsed():
    assert parse_anchor("1.5, -2,30,270") == Anchor(1.5, -2.0, 30.0, 270.0)
    assert parse_mount("0,-90,0") == (0.0, -90.0, 0.0)
    assert parse_lever_arm("1,2,3") == (1.0, 2.0, 3.0)
    with pytest.raises(ThermorenderError, match="anchor='1,2,3' has 3 values; 4 are needed: E,N,U,heading"):
        parse_anchor("1,2,3")
    with pytest.raises(ThermorenderError, match="heading is 'north', not a finite number"):
        parse_anchor("1,2,3,north")
    with pytest.raises(ThermorenderError, match=r"mount=.*pitch is 'nan', not a finite number"):
        parse_mount("0,nan,0")


# Below ground


def test_positions_below_ground_are_refused():
    path = straight(step=(0.0, 0.0, -30.0))
    assert check_above_ground(straight(), flat) == pytest.approx(50.0)
    with pytest.raises(
        ThermorenderError, match=r"at 2\.000 s the camera is 10\.00 m below the ground \(1 of 3 samples"
    ):
        check_above_ground(path, flat)
    with pytest.raises(
        ThermorenderError, match=r"at 1\.000 s the camera is 5\.00 m below the lowest height allowed, 25"
    ):
        check_above_ground(path, flat, minimum_m=25.0)
    # Outside the terrain there is no ground to be below.
    assert np.isnan(check_above_ground(path, lambda east, north: np.full(east.shape, np.nan)))


# Errors of a log

LOCAL = "time_s,east_m,north_m,up_m"


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("", {}, r"flight\.csv: the file is empty; row 1 must name the columns"),
        (f"{LOCAL}\n", {}, "has no rows below the header; at least one sample"),
        (
            "t,east_m,north_m,up_m\n0,0,0,0\n",
            {},
            r"flight\.csv: column 'time_s' is missing; row 1 names t, east_m",
        ),
        (
            f"{LOCAL}\n0,0,0,0\n1,0,zero,0\n",
            {},
            r"flight\.csv, row 3, column 'north_m': 'zero' is not a finite",
        ),
        (f"{LOCAL}\n0,0,0,nan\n", {}, "row 2, column 'up_m': 'nan' is not a finite number"),
        (f"{LOCAL}\n0,0,,0\n", {}, "row 2, column 'north_m': '' is not a finite number; fill the cell"),
        (f"{LOCAL}\n0,0,0\n", {}, "row 2: 3 cells where row 1 names 4 columns; give each column one cell"),
        (f"{LOCAL}\n0,0,0,2,5\n", {}, "row 2: 5 cells where row 1 names 4 columns; give each column one cell, with a"),
        (f'{LOCAL}\n0,0,0,"2,5"\n', {}, "column 'up_m': '2,5' is not a finite number; write it with a point as"),
        (f"\n{LOCAL}\n0,0,0,20\n", {}, "flight.csv: row 1 is blank; row 1 must name the columns"),
        (f"{LOCAL}\n0,0,0,20\0\n", {}, "it holds zero bytes.; save it as CSV UTF-8"),
        (f"{LOCAL},up_m\n0,0,0,0,0\n", {}, "row 1 names column 'up_m' 2 times"),
        (
            f"{LOCAL}\n0,0,0,0\n2,0,0,0\n\n1.5,0,0,0\n",
            {},
            r"row 5, column 'time_s': '1\.5' follows '2' in row 3: time is running backwards, and must strictly",
        ),
        (
            f"{LOCAL}\n0,0,0,0\n0,0,0,1\n",
            {},
            "row 3, column 'time_s': '0' follows the same time in row 2, but time must strictly increase",
        ),
        (
            f"{LOCAL},qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,0,0,0,1,0,0.1,0\n",
            {},
            r"row 3, columns qw, qx, qy, qz: the quaternion has length 1\.00499; "
            r"attitudes are unit quaternions, to within",
        ),
        (
            f"{LOCAL},qw,qx,qz\n0,0,0,0,1,0,0\n",
            {},
            "column 'qy' is missing; a quaternion needs qw, qx, qy, qz",
        ),
        (f"{LOCAL},qw,qx,qy,qz,yaw_deg\n0,0,0,0,1,0,0,0,0\n", {}, "the attitude is given twice"),
        (f"{LOCAL},yaw_rad\n0,0,0,0,1\n", {}, "column 'yaw_rad' is not known; rename it to 'yaw_deg'"),
        (
            f"{LOCAL},gimbal_pich_deg\n0,0,0,0,1\n",
            {},
            "column 'gimbal_pich_deg' is not known; .*'gimbal_pitch_deg'",
        ),
        (
            "time_s,up_m\n0,0\n",
            {},
            "has neither of the position columns east_m, north_m and lat_deg, lon_deg",
        ),
        ("time_s,east_m,north_m,lat_deg,lon_deg,up_m\n0,0,0,0,0,0\n", {}, "has both of the position columns"),
        ("time_s,lat_deg,up_m\n0,0,0\n", {}, "column 'lon_deg' is missing; lat_deg and lon_deg go together"),
        (
            "time_s,east_m,north_m\n0,0,0\n",
            {},
            "no height column; exactly one of up_m, alt_ellipsoid_m, alt_geoid_m, above_ground_m, above_takeoff_m",
        ),
        (
            f"{LOCAL},above_ground_m\n0,0,0,0,0\n",
            {},
            "has the height columns up_m, above_ground_m; exactly one of",
        ),
        (
            "time_s,lat_deg,lon_deg,up_m\n0,47,8,0\n1,97,8,0\n",
            {"frame": FRAME},
            "row 3, column 'lat_deg': 97 is not allowed; latitudes are −90…90 deg",
        ),
        (
            "time_s,lat_deg,lon_deg,up_m\n0,47,-190,0\n",
            {"frame": FRAME},
            "column 'lon_deg': -190 is not allowed",
        ),
        (
            "time_s,lat_deg,lon_deg,up_m\n0,47,8,0\n",
            {},
            "latitude and longitude need the scene's georeference",
        ),
        (
            "time_s,lat_deg,lon_deg,up_m\n0,49,8,0\n",
            {"frame": FRAME},
            r"row 2, column 'lat_deg': the position is 20\d km from the scene's origin; up to "
            r"100 km .*anchor=E,N,U",
        ),
        (f"{LOCAL}\n0,0,0,0\n1,200000,0,0\n", {}, r"at 1\.000 s: the position is 200 km from .*anchor="),
        (
            "time_s,lat_deg,lon_deg,up_m\n0,49,8,0\n1,0,1,0\n",
            {"anchor": Anchor(0, 0, 50, 0)},
            "row 3, .* km from the first sample; .*delete rows without a fix",
        ),
        (
            "time_s,east_m,north_m,alt_geoid_m\n0,0,0,0\n",
            {"frame": FRAME},
            "column 'alt_geoid_m': heights above the geoid need the scene's geoid_undulation_m",
        ),
        (
            "time_s,east_m,north_m,alt_ellipsoid_m\n0,0,0,0\n",
            {},
            "above the ellipsoid need the scene's georeference",
        ),
        (
            "time_s,east_m,north_m,above_ground_m\n0,0,0,0\n",
            {},
            "'above_ground_m': heights of this reference need the",
        ),
        (
            "time_s,east_m,north_m,above_takeoff_m\n0,0,0,0\n",
            {},
            "'above_takeoff_m': heights of this reference need",
        ),
        (
            "time_s,east_m,north_m,above_ground_m\n0,0,0,0\n1,9,0,0\n",
            {"ground": lambda e, n: np.where(e > 5.0, np.nan, 0.0)},
            r"row 3, column 'above_ground_m': there is no ground below east 9\.0 m, north 0\.0 m",
        ),
        (
            f"{LOCAL}\n0,0,0,0\n",
            {"anchor": Anchor(7, 0, 9, 0), "ground": lambda e, n: np.full(e.shape, np.nan)},
            "anchor: there is no ground below east 7 m",
        ),
        (
            f"{LOCAL},gimbal_pitch_deg\n0,0,0,0,-90\n",
            {"mount": (0, 0, 0)},
            r"mount=\(0, 0, 0\) contradicts .*gimbal",
        ),
        (f"{LOCAL}\n0,0,0,0\n", {"mount": (0, 0)}, "must be three finite numbers: yaw, pitch, roll"),
        (
            f"{LOCAL}\n0,0,0,0\n",
            {"lever_arm_m": (0, 0, np.inf)},
            "must be three finite numbers: forward, right, down",
        ),
        (
            f"{LOCAL}\n0,0,0,0\n",
            {"format": "dji"},
            "format='dji' is neither a bundled .*dji-gimbal, dji-srt, euroc",
        ),
        (
            "timestamp,x,y,z\n0,0,0,0\n",
            {},
            "column 'time_s' is missing; .*the columns fit format=px4",
        ),
    ],
)
def test_bad_logs_are_refused_with_file_and_row(tmp_path, text, options, message):
    with pytest.raises(ThermorenderError, match=message):
        read(tmp_path, text, **options)


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(ThermorenderError, match=r"none\.csv cannot be read \(No such file"):
        read_trajectory(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ThermorenderError, match=r"binary\.csv is not UTF-8 text .*; save it as CSV UTF-8"):
        read_trajectory(tmp_path / "binary.csv")
    with pytest.raises(ThermorenderError, match="paths is empty"):
        read_trajectory([])


# Logs of other programs

MAPPING = """
[time]
column = "t"
scale = 1e-3
[columns]
east_m = { column = "w", scale = -0.3048, offset = 1.0 }
north_m = "n"
up_m = 50.0
qw = "a"
qx = "b"
qy = "c"
qz = "d"
[quaternion]
world = "ENU"
body = "FLU"
"""


def test_a_users_mapping_scales_shifts_fills_and_turns_axes(tmp_path):
    mapping = write(tmp_path, MAPPING, "mine.toml")
    half = np.sqrt(0.5)
    # FLU to ENU: the identity looks east; 90° about up turns the nose north.
    text = f"t,w,n,a,b,c,d\n1000,10,2,1,0,0,0\n2000,20,2,{half},0,0,{half}\n"
    path = read(tmp_path, text, format=mapping)
    assert np.allclose(path.time_s, [1.0, 2.0])
    assert np.allclose(path.position, [[-2.048, 2.0, 50.0], [-5.096, 2.0, 50.0]])
    assert np.allclose(axes(path, 0), [-NORTH, -UP, EAST], atol=1e-9)
    assert np.allclose(axes(path, 1), [EAST, -UP, NORTH], atol=1e-9)
    inverse = write(tmp_path, MAPPING + "inverse = true\n", "inverse.toml")
    assert np.allclose(axes(read(tmp_path, text, format=inverse), 1), [-EAST, -UP, -NORTH], atol=1e-9)
    signed = write(tmp_path, MAPPING.replace('"FLU"', '["-y", "-x", "-z"]'), "signed.toml")
    assert np.allclose(axes(read(tmp_path, text, format=signed), 0), [-EAST, -UP, -NORTH], atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'north_m = "n"',
            'nort_m = "n"',
            r"mine\.toml: unknown key 'nort_m' in columns; did you mean 'north_m' in m\? allowed are east_m, north_m",
        ),
        ("scale = 1e-3", 'scale = "m"', r"mine\.toml: time\.scale='m' is not allowed; give a finite number"),
        ('"ENU"', '"NWU"', "quaternion.world='NWU' is not allowed; give one of NED, ENU"),
        ('"FLU"', '["x", "y", "-z"]', "quaternion.body=.*as a right-handed set"),
        ('column = "t"', "", "time needs exactly one of column, stamps, but none is given"),
        ('north_m = "n"', "north_m = true", r"columns\.north_m=True is not allowed; give a column's name, a number"),
        ("[time]", 'sort_by_time = "no"\n[time]', r"sort_by_time='no' is not allowed; give one of false, true"),
        ("scale = 1e-3", "scale = nan", r"time\.scale=nan is not allowed; give a finite number"),
        ("[time]", "[time", r"mine\.toml is not valid TOML: .*line 2"),
        ('north_m = "n"', 'north_m = "missing"', r"column 'missing' \(north_m\) is missing; format="),
    ],
)
def test_mistakes_in_a_mapping_are_refused(tmp_path, old, new, message):
    mapping = write(tmp_path, MAPPING.replace(old, new), "mine.toml")
    with pytest.raises(ThermorenderError, match=message):
        read(tmp_path, "t,w,n,a,b,c,d\n1000,10,2,1,0,0,0\n", format=mapping)


def test_several_files_are_joined_on_all_their_times(tmp_path):
    position = write(tmp_path, "time_s,east_m,north_m,up_m\n0,0,0,9\n2,20,0,9\n4,40,0,9\n", "position.csv")
    attitude = write(tmp_path, "time_s,yaw_deg\n1,0\n3,60\n5,90\n", "attitude.csv")
    path = read_trajectory([attitude, position])
    assert np.array_equal(path.time_s, [1.0, 2.0, 3.0, 4.0])
    assert np.allclose(path.position[:, 0], [10.0, 20.0, 30.0, 40.0])
    heading = np.degrees(np.arctan2(*path.poses()[:, :2, 2].T))
    assert np.allclose(heading, [0.0, 30.0, 60.0, 75.0])
    late = write(tmp_path, "time_s,yaw_deg\n10,0\n11,60\n", "late.csv")
    with pytest.raises(ThermorenderError, match=r"the files share no time: .*position\.csv 0…4 s, .*late\.csv 10…11 s"):
        read_trajectory([position, late])
    with pytest.raises(ThermorenderError, match=r"column 'yaw_deg' is in both .*attitude\.csv and .*late\.csv"):
        read_trajectory([position, attitude, late])


def test_date_times_of_a_dji_log(tmp_path):
    header = "lat_deg,lon_deg,rel_alt_m,flight_yaw_deg,flight_pitch_deg,flight_roll_deg,gimbal_yaw_deg,"
    header += "gimbal_pitch_deg,gimbal_roll_deg,local_datetime,subsec,utc_at_exposure\n"
    row = "47.2,8.5,40,0,0,0,0,-90,0,"
    options = {"frame": FRAME, "ground": flat, "format": "dji-gimbal"}
    # Out of order, because the image counter starts again; the digits of 007 are milliseconds.
    stamps = ["2021:07:01 00:00:01,007,", "2021:06:30 23:59:58,5,"]
    path = read(tmp_path, header + "".join(row + s + "\n" for s in stamps), **options)
    assert np.allclose(path.time_s, [0.0, 2.507], atol=1e-6)
    stamps = ["x,,2024-08-06T15:35:05.250000Z", "x,,2024-08-06T17:35:06+02:00"]
    path = read(tmp_path, header + "".join(row + s + "\n" for s in stamps), **options)
    assert np.allclose(path.time_s, [0.0, 0.75], atol=1e-6)
    with pytest.raises(
        ThermorenderError, match=r"row 2, column 'local_datetime': 'noon' with .* is not a time written as"
    ):
        read(tmp_path, header + row + "noon,0,\n", **options)
    with pytest.raises(ThermorenderError, match="no time: none of the columns utc_at_exposure, local_datetime"):
        read(tmp_path, header + row + ",0,\n", **options)


DJI = "lat_deg,lon_deg,rel_alt_m,flight_yaw_deg,flight_pitch_deg,flight_roll_deg,gimbal_yaw_deg,"
DJI += "gimbal_pitch_deg,gimbal_roll_deg,local_datetime,subsec,utc_at_exposure\n"


def test_two_images_in_one_second(tmp_path):
    # The camera's clock has whole seconds, and the column with fractions is empty.
    options = {"frame": FRAME, "ground": flat, "format": "dji-gimbal"}
    stamps = ["10", "11", "11", "11", "13", "13"]
    rows = [f"47.2,8.5,{40 + k},0,0,0,0,-90,0,2022:06:02 14:22:{second},,\n" for k, second in enumerate(stamps)]
    with pytest.raises(
        ThermorenderError,
        match=r"row 4, column 'local_datetime': '2022:06:02 14:22:11' follows the same time in row 3, but time must "
        r"strictly increase; give duplicates=spread, .*, or duplicates=first",
    ):
        read(tmp_path, DJI + "".join(rows), **options)
    spread = read(tmp_path, DJI + "".join(rows), duplicates="spread", **options)
    # Within the second that the clock shows, never up to the next one; a double resolves times since 1970 to 2⁻²² s.
    assert np.allclose(spread.time_s, [0.0, 1.0, 4 / 3, 5 / 3, 3.0, 3.5], atol=2.0**-21, rtol=0.0)
    assert np.allclose(spread.position[:, 2], 40.0 + np.arange(6))
    first = read(tmp_path, DJI + "".join(rows), duplicates="first", **options)
    assert np.array_equal(first.time_s, [0.0, 1.0, 3.0]) and np.allclose(first.position[:, 2], [40.0, 41.0, 44.0])
    with pytest.raises(ThermorenderError, match="duplicates='all' is unknown; give one of refuse, spread, first"):
        read(tmp_path, DJI + "".join(rows), duplicates="all", **options)


def test_spread_times_stay_within_the_last_digit(tmp_path):
    text = f"{LOCAL}\n0.25,0,0,0\n0.5,0,0,1\n0.5,0,0,2\n0.75,0,0,3\n"
    spread = read(tmp_path, text, duplicates="spread")
    assert np.allclose(spread.time_s, [0.25, 0.5, 0.505, 0.75], atol=1e-12)
    # Time that runs backwards is not a duplicate.
    for choice in ("refuse", "spread", "first"):
        with pytest.raises(ThermorenderError, match="row 3, column 'time_s': '1' follows '2' in row 2: time is"):
            read(tmp_path, f"{LOCAL}\n2,0,0,0\n1,0,0,0\n", duplicates=choice)


def real(*parts):
    return shared_data("/".join(("trajectories", *parts)))


def test_real_rocket_reaches_its_apogee_nose_first():
    path = read_trajectory(real("ncsu_rocket", "jackpot_launch_1.csv"), format="rocket-firm", ground=flat)
    top = int(path.position[:, 2].argmax())
    assert path.position[top, 2] == pytest.approx(762.28, abs=0.05)
    # On the rail, 20° off the vertical, then along the velocity while the motor burns.
    forward = path.rotation.as_matrix()[:, :, 2]
    assert np.degrees(np.arccos(forward[0, 2])) == pytest.approx(18.4, abs=1.0)
    # The motor burns until 1212.0 s; half a second before, from which every row is here.
    burn = (path.time_s > 1211.31) & (path.time_s < 1211.86)
    assert burn.sum() == 50
    velocity = np.gradient(path.position, path.time_s, axis=0)[burn].mean(axis=0)
    cosine = forward[burn].mean(axis=0) @ velocity / np.linalg.norm(velocity)
    assert np.degrees(np.arccos(cosine)) < 6.0
    assert path.rotation[0].as_matrix()[2, 1] < 0.0  # the image is upright: its lower edge points down
    anchored = read_trajectory(
        real("ncsu_rocket", "jackpot_launch_1.csv"),
        format="rocket-firm",
        anchor=Anchor(0, 0, 1.5, 64.0),
        ground=slope,
    )
    assert anchored.first_heading_deg == pytest.approx(64.0)
    assert anchored.position[:, 2].max() == pytest.approx(762.28 + 101.5, abs=0.1)


def test_real_uav_flight_looks_down_from_40_m():
    frame = LocalFrame(46.3974, 6.2382, 358.0)
    log = real("uav_thermal_flights", "eth_crops_xt_flight1_20210701.csv")
    path = read_trajectory(log, format="dji-gimbal", frame=frame, ground=flat)
    assert len(path) == 234 and path.span_s == pytest.approx((0.0, 467.303), abs=1e-5)
    assert np.allclose(path.position[:, 2], 40.0, atol=0.25)
    assert np.hypot(*path.position[:, :2].T).max() < 150.0
    speed = np.linalg.norm(np.diff(path.position, axis=0), axis=1) / np.diff(path.time_s)
    assert np.median(speed) == pytest.approx(3.0, abs=2.0) and speed.max() < 8.0
    right, _, forward = path.rotation.as_matrix().transpose(2, 0, 1)
    assert (forward[:, 2] < -0.99999).all()
    # The flight starts in row 133 of the log: its gimbal yaw of 119.7° is the heading of the upper edge.
    assert np.degrees(np.arctan2(right[0, 0], right[0, 1])) % 360.0 == pytest.approx(119.7 + 90.0, abs=0.01)


@pytest.mark.parametrize(("duplicates", "images"), [("spread", 64), ("first", 32)])
def test_real_log_of_two_cameras_on_a_clock_of_seconds(tmp_path, duplicates, images):
    # The same aircraft's log without the time of exposure: pairs of images with the same second.
    log = real("uav_thermal_flights", "kalmthout_heath_m3t_20240806.csv")
    header, *rows = (line.split(",") for line in log.read_text().splitlines())
    when = header.index("utc_at_exposure")
    blank = ([*row[:when], "", *row[when + 1 :]] for row in rows)
    pairs = [pair for row in blank for pair in (row, [row[0].replace("_T", "_W"), *row[1:]])]
    text = "".join(",".join(cells) + "\n" for cells in (header, *pairs))
    options = {"format": "dji-gimbal", "anchor": Anchor(0.0, 0.0, 75.0, 90.0)}
    with pytest.raises(ThermorenderError, match="row 3, column 'local_datetime': '2024:08:06 17:34:49' follows the"):
        read(tmp_path, text, **options)
    path = read(tmp_path, text, duplicates=duplicates, **options)
    # 17:34:49 … 17:35:34; each pair is half a second apart.
    assert len(path) == images and path.span_s == pytest.approx((0.0, 45.5 if images == 64 else 45.0), abs=1e-6)
    assert (np.diff(path.time_s) > 0.0).all()


def test_real_gimbal_flips_are_not_jumps():
    log = real("uav_thermal_flights", "kalmthout_heath_m3t_20240806.csv")
    path = read_trajectory(log, format="dji-gimbal", anchor=Anchor(0.0, 0.0, 75.0, 90.0))
    assert len(path) == 32 and path.position[0, 2] == pytest.approx(75.0)
    rolls = [line.split(",")[8] for line in log.read_text().splitlines()[1:]]
    assert "+180.00" in rolls and "+0.00" in rolls
    turn = np.degrees((path.rotation[1:] * path.rotation[:-1].inv()).magnitude())
    # From its angles alone, a flip would be a turn by 180°; only the aircraft's own turn remains, in two steps.
    assert np.sort(turn)[:-2].max() < 3.0
    assert turn.max() < 100.0


def test_real_px4_log_is_continuous():
    files = [real("px4_pyulog", f"sample_vehicle_{what}_0.csv") for what in ("attitude", "local_position")]
    path = read_trajectory(files, format="px4", ground=flat)
    assert path.span_s[0] == pytest.approx(112.574307)
    assert len(path) > 1000  # every time of either file in their common span
    assert np.degrees((path.rotation[1:] * path.rotation[:-1].inv()).magnitude()).max() < 3.0
    # The log's own yaw, from its other file: −0.588 rad at the start.
    assert np.degrees(np.arctan2(*path.pose(112.6)[:2, 2])) == pytest.approx(np.degrees(-0.588), abs=0.5)
    assert np.allclose(path.position[:, 2], -0.1, atol=0.02)
