"""What a log says about itself: invalid rows, resets of the estimator, jumps of the position."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes import flat
from thermorender.errors import ThermorenderError
from thermorender.trajectory.column_mapping import load_mapping
from thermorender.trajectory.readers import read_trajectory
from thermorender.trajectory.rotations import rotation_from_wxyz, wxyz

TIME = np.arange(40) * 0.1


def write(path, columns):
    rows = zip(*(np.broadcast_to(cells, TIME.shape) for cells in columns.values()), strict=True)
    path.write_text(",".join(columns) + "\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


def px4(folder, position=None, attitude=None):
    """A flight north at 2 m/s, 50 m above the ground, as ulog2csv writes it."""
    stamp = 1000000 + np.round(TIME * 1e6).astype(int)
    local = {
        "timestamp": stamp, "x": 2.0 * TIME, "y": 0.0, "z": -50.0, "delta_xy[0]": 0.0, "delta_xy[1]": 0.0,
        "delta_z": 0.0, "xy_valid": 1, "z_valid": 1, "xy_reset_counter": 0, "z_reset_counter": 0,
    }  # fmt: skip
    level = {"timestamp": stamp, "q[0]": 1.0, "q[1]": 0.0, "q[2]": 0.0, "q[3]": 0.0}
    return [
        write(folder / "local.csv", local | (position or {})),
        write(folder / "attitude.csv", level | (attitude or {})),
    ]


def read(folder, position=None, attitude=None):
    return read_trajectory(px4(folder, position, attitude), format="px4", ground=flat)


def after(row, value, before=0.0):
    return np.where(np.arange(TIME.size) >= row, value, before)


@pytest.mark.parametrize("flag", ["xy_valid", "z_valid", "heading_good_for_control"])
def test_log_without_a_valid_row_is_refused(tmp_path, flag):
    with pytest.raises(ThermorenderError, match=rf"local\.csv: column '{flag}' is 0 in all 40 rows: the log itself"):
        read(tmp_path, {flag: 0})
    half = after(20, 1)
    with pytest.raises(ThermorenderError, match=r"no row is valid \(xy_valid is 0 in 20, z_valid is 0 in 20 of 40"):
        read(tmp_path, {"xy_valid": half, "z_valid": 1 - half})


def test_invalid_rows_are_dropped_with_their_share(tmp_path):
    valid = after(10, 1)
    valid[20:25] = 0
    # Values of rows that are not valid need not be numbers.
    x = np.where(valid == 1, 2.0 * TIME, np.nan)
    path = read(tmp_path, {"xy_valid": valid, "x": x})
    assert path.span_s == pytest.approx((2.0, 4.9))
    assert np.allclose(path.position[:, 1], 2.0 * (path.time_s - 1.0))
    (note,) = path.notes
    assert "15 of 40 rows (37.5%) are dropped as invalid" in note
    assert "1 gaps, the longest between rows 21 and 27 (xy_valid is 0 in 15)" in note
    with pytest.raises(ThermorenderError, match="row 2, column 'x': 'nan' is not a finite number"):
        read(tmp_path, {"x": x})


def test_dead_reckoning_is_reported_and_older_logs_have_no_flags(tmp_path):
    path = read(tmp_path, {"dead_reckoning": after(30, 1)})
    assert len(path) == 40 and "dead_reckoning is set in 10 of 40 rows (25.0%)" in path.notes[0]
    files = px4(tmp_path)
    stamp = 1000000 + np.round(TIME * 1e6).astype(int)
    files[0] = write(tmp_path / "old.csv", {"timestamp": stamp, "x": 2.0 * TIME, "y": 0.0, "z": -50.0})
    assert read_trajectory(files, format="px4", ground=flat).notes == ()


def test_resets_of_the_position_are_taken_out(tmp_path):
    clean = read(tmp_path).position
    reset = {
        "x": 2.0 * TIME + after(15, 30.0) + after(25, -7.0), "y": after(15, -4.0), "z": -50.0 + after(30, -12.0),
        "delta_xy[0]": after(25, -7.0, after(15, 30.0)), "delta_xy[1]": after(15, -4.0) * (1 - after(25, 1.0)),
        "delta_z": after(30, -12.0), "xy_reset_counter": (after(15, 1) + after(25, 1) + 255) % 256,
        "z_reset_counter": after(30, 1),
    }  # fmt: skip
    path = read(tmp_path, reset)
    assert np.allclose(path.position, clean)
    horizontal, vertical = path.notes
    assert "was reset 2 times, first at 2.500 s (row 17, column 'xy_reset_counter')" in horizontal
    assert "north_m by up to 30 m, east_m by up to 4 m" in horizontal
    assert "once at 4.000 s (row 32, column 'z_reset_counter'): it changed above_takeoff_m by up to 12 m" in vertical


@pytest.mark.parametrize("change", [{"xy_reset_counter": after(15, 2)}, {"delta_xy[0]": None}])
def test_change_that_is_not_recorded_is_taken_from_the_rows(tmp_path, change):
    reset = {"x": 2.0 * TIME + after(15, 30.0), "delta_xy[0]": after(15, 11.0), "xy_reset_counter": after(15, 1)}
    files = px4(tmp_path, reset | {name: cells for name, cells in change.items() if cells is not None})
    if "delta_xy[0]" in change:
        files[0].write_text(files[0].read_text().replace("delta_xy[0]", "other"))
    path = read_trajectory(files, format="px4", ground=flat)
    # Without the motion of 0.2 m in the step of the reset.
    assert np.allclose(path.position[:, 1], 2.0 * TIME - after(15, 0.2))
    assert "1 of these changes are not recorded and are taken from the rows before and after" in path.notes[0]


def test_reset_between_invalid_rows_is_taken_out(tmp_path):
    valid = 1 - after(10, 1) + after(20, 1)
    reset = {
        "xy_valid": valid, "x": 2.0 * TIME + after(15, 30.0), "delta_xy[0]": after(15, 30.0),
        "xy_reset_counter": after(15, 1),
    }  # fmt: skip
    path = read(tmp_path, reset)
    assert np.allclose(path.position[:, 1], 2.0 * (path.time_s - 1.0))
    # A reset before the first valid row concerns none of the rows.
    early = reset | {"xy_valid": after(20, 1)}
    path = read(tmp_path, early)
    assert path.position[0, 1] == pytest.approx(2.0 * TIME[20] + 30.0) and len(path.notes) == 1


def test_attitudes_before_a_reset_are_turned_to_the_corrected_one(tmp_path):
    true = Rotation.from_euler("ZYX", np.stack([40.0 + 3.0 * TIME, 5.0 * np.sin(TIME), 0.0 * TIME], -1), degrees=True)
    change = Rotation.from_euler("z", 25.0, degrees=True)
    early = np.arange(TIME.size) < 15
    logged = np.where(early[:, None], wxyz(change.inv() * true), wxyz(true))
    delta = np.where(early[:, None], [1.0, 0.0, 0.0, 0.0], wxyz(change))
    columns = {f"q[{k}]": logged[:, k] for k in range(4)} | {f"delta_q_reset[{k}]": delta[:, k] for k in range(4)}
    path = read(tmp_path, None, columns | {"quat_reset_counter": after(15, 1)})
    expected = read(tmp_path, None, {f"q[{k}]": wxyz(true)[:, k] for k in range(4)})
    turn = rotation_from_wxyz(path.quaternion) * rotation_from_wxyz(expected.quaternion).inv()
    assert np.degrees(turn.magnitude()).max() < 1e-6
    assert "it turned the attitude by up to 25 deg" in path.notes[0]


def test_reset_of_the_heading_needs_the_attitudes_counter(tmp_path):
    heading = {"heading_reset_counter": after(15, 1)}
    with pytest.raises(
        ThermorenderError,
        match=r"local\.csv: column 'heading_reset_counter' counts a reset of the estimator at 2\.500 s \(row 17\), but "
        r"no file has the column 'quat_reset_counter'",
    ):
        read(tmp_path, heading)
    assert len(read(tmp_path, heading, {"quat_reset_counter": 0})) == 40


def test_jumps_are_named_with_their_time_and_speed(tmp_path):
    path = read(tmp_path, {"x": 2.0 * TIME + after(15, 30.0)})
    (note,) = path.notes
    assert "the position jumps by 30.2 m within 0.1 s at 2.500 s (row 17), 302 m/s where up to 20 m/s" in note
    # One wrong sample is two jumps.
    spike = np.where(np.arange(TIME.size) == 15, 30.0, 0.0)
    assert "so do 1 other steps, the first at 2.500 s" in read(tmp_path, {"x": 2.0 * TIME + spike}).notes[0]
    # A rocket is fast, but does not jump.
    assert read(tmp_path, {"z": -100.0 * TIME**2}).notes == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[resets]]\ncounter = "n"\n', "needs exactly one of shift, turn, unless, but none is given"),
        ('[[resets]]\ncounter = "n"\nshift = { x = "d" }\n', "'x' is not allowed; give names of east_m"),
        ('[[resets]]\ncounter = "n"\nturn = ["a"]\n', "four columns: w, x, y, z"),
        ('valid = "ok"\n', "valid='ok' is not allowed; give a list of texts"),
    ],
)
def test_mistakes_in_a_mapping_of_resets_are_refused(tmp_path, text, message):
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(ThermorenderError, match=message):
        load_mapping(tmp_path / "m.toml")
