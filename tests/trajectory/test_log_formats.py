"""Flight logs of other programs: each format is written here as its program writes it, and read."""

import re
import struct
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from scenes import flat
from thermorender.cli.options import TrajectoryOptions
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.trajectory.column_mapping import READERS, bundled_formats, load_mapping
from thermorender.trajectory.path import Anchor
from thermorender.trajectory.readers import read_trajectory
from thermorender.trajectory.sources import SOURCES

FRAME = LocalFrame(47.0, 8.0, 400.0)
ANCHOR = Anchor(0.0, 0.0, 80.0, 0.0)
EAST, NORTH, UP = np.eye(3)
GUIDE = Path(__file__).resolve().parents[2] / "docs/guides/flight-logs.md"


def read(path, name, **options):
    return read_trajectory(path, format=name, **({"frame": FRAME, "ground": flat} | options))


def view(path, sample=0):
    """The direction of view and the upper edge of the image, in east, north, up."""
    axes = path.rotation[sample].as_matrix()
    return axes[:, 2], -axes[:, 1]


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_formats_are_complete_and_named_everywhere():
    names = "airdata ardupilot dji-gimbal dji-srt euroc gpx kml px4 rocket-firm rosbag tum ulog".split()
    assert bundled_formats() == names
    assert set(SOURCES) == set(READERS)
    (option,) = TrajectoryOptions.__dataclass_fields__["format"].type.__metadata__
    guide = GUIDE.read_text(encoding="utf-8")
    for name in names:
        assert f"{name}," in option.help and f"`{name}`" in guide, name
        assert load_mapping(name).title != name


def test_a_file_of_another_program_names_its_format(tmp_path):
    with pytest.raises(ThermorenderError, match=r"a\.ulg is read with format=ulog; add it"):
        read_trajectory(tmp_path / "a.ulg")
    with pytest.raises(
        ThermorenderError, match=r"column 'time_s' is missing; row 1 names a, b; if another program .* give its format"
    ):
        read_trajectory(write(tmp_path / "a.csv", "a,b\n1,2\n"))


# PX4


def ulog(path, messages):
    """A ULog file of messages {name: {field: cells}}; times are unsigned, other fields doubles."""
    body = b""

    def add(kind, data):
        nonlocal body
        body += struct.pack("<HB", len(data), ord(kind)) + data

    for name, fields in messages.items():
        types = "".join(f"{'uint64_t' if f == 'timestamp' else 'double'} {f};" for f in fields if "[" not in f)
        arrays = {
            f.partition("[")[0]: sum(g.startswith(f.partition("[")[0] + "[") for g in fields)
            for f in fields
            if "[" in f
        }
        add("F", f"{name}:{types}{''.join(f'double[{n}] {f};' for f, n in arrays.items())}".encode())
    for number, name in enumerate(messages):
        add("A", struct.pack("<BH", 0, number) + name.encode())
    for number, fields in enumerate(messages.values()):
        cells = np.broadcast_arrays(*fields.values())
        order = [k for k, f in enumerate(fields) if "[" not in f] + [k for k, f in enumerate(fields) if "[" in f]
        for row in zip(*(cells[k] for k in order), strict=True):
            add("D", struct.pack("<H", number) + struct.pack(f"<Q{len(row) - 1}d", int(row[0]), *row[1:]))
    path.write_bytes(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1000) + body)
    return path


TIME = np.arange(1, 31) * 100_000


def px4(**position):
    local = {
        "timestamp": TIME, "x": 1e-6 * TIME * 5.0, "y": 0.0, "z": -40.0, "xy_valid": 1.0, "z_valid": 1.0,
        "ref_lat": 47.0, "ref_lon": 8.001, "xy_global": 1.0,
    }  # fmt: skip
    half = np.sqrt(0.5)  # the nose to the east
    attitude = {"timestamp": TIME, "q[0]": half, "q[1]": 0.0, "q[2]": 0.0, "q[3]": half}
    return {"vehicle_local_position": local | position, "vehicle_attitude": attitude}


def test_ulog_has_position_attitude_and_the_place_of_its_origin(tmp_path):
    path = read(ulog(tmp_path / "a.ulg", px4()), "ulog", mount=(0, -90, 0))
    assert len(path) == 30 and path.time_s[0] == 0.0 and path.notes == ()
    # 0.001° of longitude east of the scene's origin, on PX4's sphere as on the ellipsoid to the millimetre.
    expected = FRAME.enu_from_geodetic(np.array([47.0]), np.array([8.001]), np.array([400.0]))[0]
    assert np.allclose(path.position[0], [expected[0], 0.5, 40.0], atol=5e-3)
    assert np.ptp(path.position[:, 1]) == pytest.approx(14.5, rel=4e-3)
    down, top = view(path)
    assert np.allclose(down, -UP, atol=1e-4) and np.allclose(top, EAST, atol=1e-4)
    # Without a georeference, or when the log does not know it, positions count from the scene's origin.
    for file, frame in ((px4(), None), (px4(xy_global=0.0), FRAME)):
        path = read(ulog(tmp_path / "b.ulg", file), "ulog", frame=frame)
        assert np.allclose(path.position[0], [0.0, 0.5, 40.0])


@pytest.mark.parametrize("left", [0, 1])
def test_ulog_whose_last_message_is_cut_off_ends(tmp_path, left):
    """The library would go back to its header without end."""
    path = ulog(tmp_path / "a.ulg", {})
    path.write_bytes(path.read_bytes() + struct.pack("<HB", 1 + left, 0) + b"x" * left)
    with pytest.raises(ThermorenderError, match=r"cannot be read as ULog \(EOFError\); copy it again"):
        read(path, "ulog", mount=(0, -90, 0))


def test_ulog_without_a_valid_position_is_refused(tmp_path):
    with pytest.raises(
        ThermorenderError, match=r"a\.ulg \(vehicle_local_position\): column 'xy_valid' is 0 in all 30 sam"
    ):
        read(ulog(tmp_path / "a.ulg", px4(xy_valid=0.0)), "ulog")


@pytest.mark.parametrize(("flags", "yaw"), [(16, 30.0), (32, 120.0)])
def test_gimbal_of_a_ulog_is_relative_to_the_earth_or_to_the_heading(tmp_path, flags, yaw):
    half = np.radians(15.0)  # yaw 30° about down
    gimbal = {
        "timestamp": TIME,
        "device_flags": flags,
        "q[0]": np.cos(half),
        "q[1]": 0.0,
        "q[2]": 0.0,
        "q[3]": np.sin(half),
    }
    file = ulog(tmp_path / "a.ulg", px4() | {"gimbal_device_attitude_status": gimbal})
    path = read(file, "ulog", frame=None)
    assert np.allclose(view(path)[0], [np.sin(np.radians(yaw)), np.cos(np.radians(yaw)), 0.0], atol=1e-6)
    with pytest.raises(ThermorenderError, match=r"mount=.* contradicts .*gimbal"):
        read(file, "ulog", frame=None, mount=(0, 0, 0))


def test_other_and_damaged_binary_files_are_refused(tmp_path, monkeypatch):
    (tmp_path / "a.bin").write_bytes(b"nothing")
    for name, what in (("ulog", "a PX4 log in ULog"), ("ardupilot", "an ArduPilot dataflash log")):
        with pytest.raises(ThermorenderError, match=rf"a\.bin is not {what}: it begins with b'no.*; check format"):
            read(tmp_path / "a.bin", name)
        with pytest.raises(ThermorenderError, match=rf"none cannot be read \(No such file .*\); give {what}"):
            read(tmp_path / "none", name)
    rng = np.random.default_rng(5)
    for name, file in (
        ("ulog", ulog(tmp_path / "a.ulg", px4())),
        ("ardupilot", dataflash(tmp_path / "b.bin", ardupilot())),
    ):
        whole = file.read_bytes()
        for k in range(30):
            damaged = bytearray(whole)
            damaged[int(rng.integers(8, len(whole)))] ^= int(rng.integers(1, 256))
            (tmp_path / "d").write_bytes(damaged[: int(rng.integers(8, len(whole)))] if k % 2 else damaged)
            # Refused in the project's words or read; never another error.
            with suppress(ThermorenderError):
                read(tmp_path / "d", name, anchor=ANCHOR)
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(
        ThermorenderError, match=r"needs pyulog, which is not installed; run pip install 'thermorender\[logs\]'"
    ):
        read(tmp_path / "a.ulg", "ulog")


# ArduPilot


def dataflash(path, messages):
    """A dataflash log of messages {name: (format, fields, rows)}."""
    sizes = {"Q": 8, "f": 4, "I": 4, "H": 2, "L": 4, "B": 1}

    def description(kind, length, name, form, fields):
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, length, name.encode(), form.encode(), fields.encode())

    body = description(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    for kind, (name, (form, fields, _)) in enumerate(messages.items(), start=130):
        body += description(kind, 3 + sum(sizes[c] for c in form), name, form, fields)
    for kind, (form, _, rows) in enumerate(messages.values(), start=130):
        layout = "<" + form.replace("L", "i")
        body += b"".join(b"\xa3\x95" + bytes([kind]) + struct.pack(layout, *row) for row in rows)
    path.write_bytes(body)
    return path


def ardupilot(**more):
    position = [(k * 10**6, 470000000 + 100 * k, 80000000, 500, 40) for k in range(10)]
    attitude = [(k * 10**6, 0, 0, 90) for k in range(10)]
    return {
        "POS": ("QLLff", "TimeUS,Lat,Lng,Alt,RelHomeAlt", position),
        "ATT": ("Qfff", "TimeUS,Roll,Pitch,Yaw", attitude),
    } | more


def test_ardupilot_has_position_attitude_and_mount(tmp_path):
    path = read(dataflash(tmp_path / "a.bin", ardupilot()), "ardupilot", mount=(0, -90, 0))
    assert len(path) == 10 and np.allclose(path.position[:, 2], 40.0, atol=0.01)
    assert path.position[-1, 1] == pytest.approx(9e-5 * 111_170, rel=1e-3)
    assert np.allclose(view(path)[1], EAST, atol=1e-4)
    mount = ("QBfff", "TimeUS,I,Roll,Pitch,YawE", [(k * 10**6, i, 0, -30, 180) for k in range(10) for i in (0, 1)])
    path = read(dataflash(tmp_path / "b.bin", ardupilot(MNT=mount)), "ardupilot")
    assert np.allclose(view(path)[0], [0.0, -np.cos(np.radians(30)), -0.5], atol=1e-4)


def test_ardupilot_estimates_of_former_logs_are_read(tmp_path):
    """Their height above home is RelAlt; the receiver's fixes stand in for no estimate."""
    fixes = ("QBIHLLf", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt", [(10**6, 3, 10**8, 2100, 480000000, 90000000, 500)])
    form, fields, rows = ardupilot()["POS"]
    messages = ardupilot(POS=(form, fields.replace("RelHomeAlt", "RelAlt"), rows), GPS=fixes)
    found = read(dataflash(tmp_path / "a.bin", messages), "ardupilot")
    np.testing.assert_array_equal(
        found.position, read(dataflash(tmp_path / "b.bin", ardupilot()), "ardupilot").position
    )


def test_ardupilot_without_estimates_uses_fixes_of_the_receiver(tmp_path):
    rows = [(k * 10**6, 3 if k > 2 else 1, 10**8 + 1000 * k, 2100, 470000000, 80000000, 500) for k in range(10)]
    messages = ardupilot(GPS=("QBIHLLf", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt", rows))
    del messages["POS"]
    path = read(dataflash(tmp_path / "a.bin", messages), "ardupilot", geoid_undulation_m=50.0)
    assert path.span_s == (3.0, 9.0) and path.position[0, 2] == pytest.approx(150.0, abs=0.01)
    assert "3 of 10 samples (30.0%) are dropped as invalid (fix is 0 in 3)" in path.notes[0]
    with pytest.raises(ThermorenderError, match="neither POS nor GPS is logged"):
        read(dataflash(tmp_path / "b.bin", {"ATT": messages["ATT"]}), "ardupilot")


# DJI


def srt(path, cues, step_s=0.5):
    def clock(s):
        return f"00:{int(s) // 60:02d}:{int(s) % 60:02d},{round(s % 1 * 1000):03d}"

    blocks = (f"{k + 1}\n{clock(k * step_s)} --> {clock((k + 1) * step_s)}\n{cue}\n" for k, cue in enumerate(cues))
    return write(path, "\n".join(blocks))


def test_newer_dji_subtitles(tmp_path):
    cues = [
        f'<font size="28">FrameCnt: {k}, DiffTime: 33ms\n2023-05-31 19:04:26.691\n[iso: 100] [shutter: 1/500.0] '
        f"[latitude: {47.0 + 1e-5 * k:.6f}] [longitude: 8.000000] [rel_alt: {40 + k:.3f} abs_alt: 540.000] "
        "[gb_yaw: 90.0 gb_pitch: -30.0 gb_roll: 0.0] </font>"
        for k in range(5)
    ]
    path = read(srt(tmp_path / "a.srt", cues), "dji-srt")
    assert np.allclose(path.time_s, 0.5 * np.arange(5)) and path.notes == ()
    assert np.allclose(path.position[:, 2], 40.0 + np.arange(5), atol=0.01)
    assert path.position[-1, 1] == pytest.approx(4e-5 * 111_170, rel=1e-3)
    assert np.allclose(view(path)[0], [np.cos(np.radians(30)), 0.0, -0.5], atol=1e-6)


def test_older_dji_subtitles(tmp_path):
    cues = [
        f"F/5.6, SS 400, ISO 100, EV 0, GPS (8.0, {47.0 + 1e-5 * k:.6f}, 15), HOME (8.0, 47.0, 7.60m), D 1.0m, "
        f"H {40 + k}.50m, H.S 5.00m/s, V.S 0.00m/s, F.PRY (-9.0°, 3.0°, -90.0°), G.PRY (-30.0°, 0.0°, 180.0°)"
        for k in range(4)
    ]
    path = read(srt(tmp_path / "a.srt", cues), "dji-srt")
    assert np.allclose(path.position[:, 2], 40.5 + np.arange(4), atol=0.01)
    assert np.allclose(view(path)[0], [0.0, -np.cos(np.radians(30)), -0.5], atol=1e-6)


@pytest.mark.parametrize(
    ("gps", "east", "north"),
    [
        ("8.0010,47.0000,15", 76.06, 0.0),
        ("47.0000,8.0010,0.0M", 76.06, 0.0),
        ("E: 8.0010, N: 47.0000, 450.1m", 76.06, 0.0),
    ],
)
def test_order_of_dji_coordinates(tmp_path, gps, east, north):
    home = "HOME(8.0,47.0) 2017.08.05 14:11:51\n"
    path = read(srt(tmp_path / "a.srt", [f"{home}GPS({gps}) BAROMETER:1.9\nISO:100"] * 2), "dji-srt", mount=(0, 0, 0))
    assert np.allclose(path.position[0], [east, north, 1.9], atol=0.05)
    assert "the log has no yaw" in path.notes[-1]


def test_altitude_of_a_subtitle_needs_an_anchor(tmp_path):
    cues = [f"[latitude: 47.0] [longtitude: 8.0] [altitude: {540.5 + k}]" for k in range(3)]
    file = srt(tmp_path / "a.srt", cues)
    with pytest.raises(
        ThermorenderError, match=r"does not say what its height is relative to; move the flight with anchor"
    ):
        read(file, "dji-srt")
    assert np.allclose(read(file, "dji-srt", anchor=ANCHOR).position[:, 2], [80.0, 81.0, 82.0])


def test_subtitles_without_fix_or_height_are_dropped_or_refused(tmp_path):
    good = "[latitude: 47.0] [longitude: 8.0] [rel_alt: 40.0 abs_alt: 540.0]"
    none = "[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 0.0 abs_alt: 500.0]"
    path = read(srt(tmp_path / "a.srt", [none, none, "[iso: 100]", good, good.replace("47.0", "47.00001")]), "dji-srt")
    assert path.span_s == (1.5, 2.0)
    assert "1 of 5 cues (20.0%) lack one of lat_deg, lon_deg, above_takeoff_m" in path.notes[0]
    assert any("dropped as invalid (lat_deg is 0 in" in note for note in path.notes)
    for cue, message in (("[iso: 100]", "no cue has a position"), ("GPS(8.0,47.0,9)", "no cue has a height")):
        with pytest.raises(ThermorenderError, match=message):
            read(srt(tmp_path / "b.srt", [cue] * 2), "dji-srt")
    with pytest.raises(ThermorenderError, match="no cue with a time"):
        read(write(tmp_path / "c.srt", "hello"), "dji-srt")


def test_repeated_positions_of_a_subtitle_are_steps_of_the_receiver(tmp_path):
    # 30 cues a second, a new position each second, and a hover of four seconds.
    place = np.minimum(np.arange(300) // 30, 5) * 1e-4
    cues = [f"[latitude: {47.0 + p:.6f}] [longitude: 8.0] [rel_alt: 40.0 abs_alt: 1.0]" for p in place]
    path = read(srt(tmp_path / "a.srt", cues, 1 / 30), "dji-srt", course=True)
    speed = np.linalg.norm(np.diff(path.position, axis=0), axis=1) / np.diff(path.time_s)
    assert np.allclose(speed[:5], 11.1, rtol=0.02) and np.allclose(speed[5:], 0.0)
    assert not any("jump" in note for note in path.notes)


AIRDATA = "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet), compass_heading(degrees)"
AIRDATA += ", pitch(degrees), roll(degrees),gimbal_heading(degrees),gimbal_pitch(degrees),gimbal_roll(degrees)\n"


def test_airdata_in_feet_and_metres(tmp_path):
    rows = "0,x,0,0,0,0,0,0,0,0,\n100,x,47.0,8.0,100,10,0,0,90,-30,\n200,x,47.00001,8.0,100,10,0,0,90,-30,\n"
    path = read(write(tmp_path / "a.csv", AIRDATA + rows), "airdata")
    assert path.span_s == (0.1, 0.2) and path.position[0, 2] == pytest.approx(30.48)
    assert np.allclose(view(path)[0], [np.cos(np.radians(30)), 0.0, -0.5], atol=1e-6)
    assert "1 of 3 rows (33.3%) are dropped" in path.notes[0]
    metres = write(tmp_path / "b.csv", AIRDATA.replace("feet", "meters") + rows)
    assert read(metres, "airdata").position[0, 2] == pytest.approx(100.0)
    for old, new in (("gimbal_pitch(degrees)", "gimbal_pitch"), ("takeoff(feet)", "takeoff(yards)")):
        with pytest.raises(
            ThermorenderError, match=r"column '.*' is not one that format='airdata' reads: .*; rename it"
        ):
            read(write(tmp_path / "c.csv", AIRDATA.replace(old, new) + rows), "airdata")


# Tracks


def gpx(*points, head=""):
    inner = "".join(
        f'<trkpt lat="47.0" lon="{8 + 1e-5 * k:.5f}"><ele>540</ele><time>{time}</time>{more}</trkpt>'
        for k, (time, more) in enumerate(points)
    )
    space = 'xmlns="http://www.topografix.com/GPX/1/1"'
    return f'<?xml version="1.0"?>{head}<gpx version="1.1" {space}><trk><trkseg>{inner}</trkseg></trk></gpx>'


def test_gpx_track(tmp_path):
    points = [(f"2024-05-01T10:00:0{k}.5Z", "<fix>none</fix>" if k == 0 else "") for k in range(4)]
    path = read(write(tmp_path / "a.gpx", gpx(*points)), "gpx", geoid_undulation_m=50.0, mount=(0, -90, 0), course=True)
    assert path.span_s == (0.0, 2.0) and path.position[0, 2] == pytest.approx(190.0, abs=1e-3)
    assert np.allclose(view(path)[1], EAST, atol=1e-3)  # the course is east
    (note,) = path.notes
    assert "1 of 4 track points (25.0%) are dropped as invalid (fix is 0 in 1)" in note
    for text, message in (
        (gpx(("", "")), "no track point has all of lat, lon, ele and time, the first lacks time; a flight needs"),
        (gpx(("2024-05-01T10:00:00Z", "")).replace("ele>", "x>"), "the first lacks ele"),
        ("<gpx><rte/></gpx>", "no track points"),
        ("<kml/>", "is not GPX: its outermost element is 'kml'; check format"),
        ("<gpx>", r"is not GPX \(no element found"),
    ):
        with pytest.raises(ThermorenderError, match=message):
            read(write(tmp_path / "b.gpx", text), "gpx")


@pytest.mark.parametrize("name", ["gpx", "kml"])
def test_entities_are_refused(tmp_path, name):
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
    with pytest.raises(ThermorenderError, match=r"holds a document type definition .* is not read; delete it"):
        read(write(tmp_path / f"a.{name}", gpx(("&b;", ""), head=bomb)), name)


def kml(mode="<altitudeMode>absolute</altitudeMode>", angles="<gx:angles>90 0 0</gx:angles>", last="8.00002 47.0 540"):
    coords = ["8.0 47.0 540", "8.00001 47.0 541", last]
    inner = "".join(f"<when>2024-05-01T10:00:0{k}Z</when>" for k in range(3))
    inner += "".join(f"<gx:coord>{text}</gx:coord>" for text in coords) + angles * 3
    spaces = 'xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"'
    return f"<kml {spaces}><Placemark><gx:Track>{mode}{inner}</gx:Track></Placemark></kml>"


def test_kml_track(tmp_path):
    path = read(write(tmp_path / "a.kml", kml()), "kml", geoid_undulation_m=50.0)
    assert np.allclose(path.position[:, 2], [190.0, 191.0, 190.0], atol=1e-3) and path.notes == ()
    assert np.allclose(view(path)[0], EAST, atol=1e-4)
    ground = kml("<altitudeMode>relativeToGround</altitudeMode>", "<gx:angles>90 5 0</gx:angles>")
    path = read(write(tmp_path / "b.kml", ground), "kml")
    assert np.allclose(path.position[:, 2], [540.0, 541.0, 540.0], atol=1e-2)
    assert "a positive tilt lowers the nose, a positive roll the left side" in path.notes[0]
    # Nose down and left side down: clockwise around the axes, as the heading is from above.
    assert np.allclose(view(path)[0], np.cos(np.radians(5)) * EAST - np.sin(np.radians(5)) * UP, atol=1e-4)
    rolled = kml("<altitudeMode>relativeToGround</altitudeMode>", "<gx:angles>0 0 350</gx:angles>")
    edge = view(read(write(tmp_path / "r.kml", rolled), "kml"))[1]
    assert np.allclose(edge, np.cos(np.radians(10)) * UP + np.sin(np.radians(10)) * EAST, atol=1e-4)
    heading = kml("<altitudeMode>relativeToGround</altitudeMode>", "<gx:angles>90</gx:angles>")
    assert read(write(tmp_path / "h.kml", heading), "kml").notes == ()
    clamped = write(tmp_path / "c.kml", kml("", "", last=""))
    path = read(clamped, "kml", anchor=ANCHOR)
    assert np.allclose(path.position[:, 2], [80.0, 81.0], atol=1e-3)
    assert ["clampToGround" in path.notes[0], "1 samples without a position" in path.notes[1]] == [True, True]
    with pytest.raises(ThermorenderError, match="does not say what its height is relative to"):
        read(clamped, "kml")
    for text, message in (
        (kml("<altitudeMode>relativeToSeaFloor</altitudeMode>"), "altitudeMode is relativeToSeaFloor; every track"),
        ("<kml><LineString/></kml>", "has no gx:Track"),
        (kml().replace("<when>2024-05-01T10:00:02Z</when>", ""), "2 times, 3 positions and 3 angles"),
        (kml(last="8 47"), "is not longitude, latitude and altitude"),
        (kml(angles="<gx:angles>9 x 0</gx:angles>"), "gx:angles '9 x 0' is not heading, tilt and roll"),
        (kml(angles="<gx:angles>9 0 0 1</gx:angles>"), "gx:angles '9 0 0 1' is not heading, tilt and roll"),
    ):
        with pytest.raises(ThermorenderError, match=message):
            read(write(tmp_path / "d.kml", text), "kml")


# Poses


def test_tum_poses_are_those_of_the_camera(tmp_path):
    # The camera's axes in the world: right is east, down is −up, along the view is north.
    half = np.sqrt(0.5)
    text = f"# timestamp tx ty tz qx qy qz qw\n1000.5 1 2 3 {-half} 0 0 {half}\n1001.5 2 2 3 {-half} 0 0 {half}\n"
    path = read(write(tmp_path / "a.txt", text), "tum")
    assert np.allclose(path.time_s, [0.0, 1.0]) and np.allclose(path.position[0], [1.0, 2.0, 3.0])
    assert np.allclose(view(path)[0], NORTH) and np.allclose(view(path)[1], UP)
    assert "z of its world is taken as up" in path.notes[0]
    with pytest.raises(ThermorenderError, match=r"line 2: '1 2 3' has 3 columns; eight separated by blanks"):
        read(write(tmp_path / "b.txt", "#\n1 2 3\n"), "tum")


def test_euroc_body_axes_are_those_of_its_inertial_sensor(tmp_path):
    header = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x\n"
    )
    # Level: the sensor's x is up. A turn by −90° about y takes x to z.
    half = np.sqrt(0.5)
    rows = "".join(f"{1403636580838555648 + k * 10**9},1,2,3,{half},0,{-half},0,0\n" for k in range(3))
    path = read(write(tmp_path / "a.csv", header + rows), "euroc")
    assert np.allclose(path.time_s, [0.0, 1.0, 2.0], atol=1e-6) and np.allclose(path.position[0], [1.0, 2.0, 3.0])
    assert np.allclose(view(path)[0], -EAST, atol=1e-9) and np.allclose(view(path)[1], UP, atol=1e-9)


# Bags of ROS 2


def bag(path, storage="MCAP", frame="map", child="base_link", stamped=True, topics=("/odom", "/fix")):
    """Write a bag of one second: odometry that climbs northward and turns to the east, and fixes, one of them bad."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = {name.rpartition("/")[2]: made for name, made in store.types.items()}

    def header(k):
        at = kind["Time"](sec=1_700_000_000 + k // 2 if stamped else 0, nanosec=500_000_000 * (k % 2) if stamped else 0)
        return kind["Header"](stamp=at, frame_id=frame)

    def odometry(k):
        # Yaw from the east, anticlockwise: 90° is north, 0° is east.
        half = np.radians([90.0, 45.0, 0.0][k]) / 2
        turn = kind["Quaternion"](x=0.0, y=0.0, z=np.sin(half), w=np.cos(half))
        pose = kind["Pose"](position=kind["Point"](x=1.0, y=10.0 * k, z=50.0 + k), orientation=turn)
        zero = kind["Vector3"](x=0.0, y=0.0, z=0.0)
        return kind["Odometry"](
            header=header(k), child_frame_id=child,
            pose=kind["PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
            twist=kind["TwistWithCovariance"](twist=kind["Twist"](linear=zero, angular=zero), covariance=np.zeros(36)),
        )  # fmt: skip

    def fix(k):
        status = kind["NavSatStatus"](status=-1 if k == 1 else 0, service=1)
        return kind["NavSatFix"](
            header=header(k), status=status, latitude=47.0 + 1e-4 * k, longitude=8.0, altitude=500.0,
            position_covariance=np.zeros(9), position_covariance_type=0,
        )  # fmt: skip

    def words(k):
        return kind["String"](data="hello")

    made = {"/odom": ("nav_msgs/msg/Odometry", odometry), "/fix": ("sensor_msgs/msg/NavSatFix", fix),
            "/words": ("std_msgs/msg/String", words)}  # fmt: skip
    with Writer(path, version=9, storage_plugin=getattr(StoragePlugin, storage)) as writer:
        for topic in topics:
            name, make = made[topic]
            connection = writer.add_connection(topic, name, typestore=store)
            for k in range(3):
                received = 1_700_000_100_000_000_000 + 250_000_000 * k
                writer.write(connection, received, store.serialize_cdr(make(k), name))
    return path


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_rosbag_of_poses(tmp_path, storage):
    folder = bag(tmp_path / "bag", storage, topics=("/odom", "/words"))
    (file,) = [each for each in folder.iterdir() if each.suffix in (".mcap", ".db3")]
    for given in (folder, file, f"{file}#/odom"):
        path = read(given, "rosbag")
        assert np.allclose(path.time_s, [0.0, 0.5, 1.0], atol=1e-6)
        assert np.allclose(path.position, [[1, 0, 50], [1, 10, 51], [1, 20, 52]])
        assert np.allclose(view(path)[0], NORTH, atol=1e-9) and np.allclose(view(path)[1], UP, atol=1e-9)
        assert np.allclose(view(path, 2)[0], EAST, atol=1e-9)
        assert any("x of frame 'map' is taken as east" in note for note in path.notes)
    with pytest.raises(ThermorenderError, match=r"is read with format=rosbag; add it"):
        read_trajectory(f"{file}#/odom")


def test_rosbag_of_fixes_and_choice_of_a_topic(tmp_path):
    folder = bag(tmp_path / "bag")
    with pytest.raises(
        ThermorenderError, match=r"several topics fit; name one after a #, such as \S+bag#/fix \(there a"
    ):
        read(folder, "rosbag")
    path = read(f"{folder}#/fix", "rosbag")
    assert np.allclose(path.time_s, [0.0, 1.0], atol=1e-6) and np.allclose(path.position[:, 2], 500.0 - FRAME.height_m)
    assert np.allclose(np.diff(path.position[:, 1]), 22.2, atol=0.1)
    notes = "\n".join(path.notes)
    assert (
        "1 of 3 messages (33.3%) are dropped as invalid" in notes
        and "the log has no yaw" in notes
        and "is taken as east" not in notes
    )
    with pytest.raises(ThermorenderError, match=r"topic '/imu' is not one of poses or fixes; name one after a #"):
        read(f"{folder}#/imu", "rosbag")
    with pytest.raises(ThermorenderError, match=r"none\.mcap does not exist; give a bag of ROS 2"):
        read(tmp_path / "none.mcap#/odom", "rosbag")
    damaged = write(tmp_path / "d.mcap", "not a bag")
    with pytest.raises(ThermorenderError, match=r"d\.mcap cannot be read as a bag of ROS 2 \(.*copy it again"):
        read(damaged, "rosbag")
    with pytest.raises(ThermorenderError, match=r"no topic is of PoseStamped, .*, but there is /words \(std_msgs"):
        read(bag(tmp_path / "w", topics=("/words",)), "rosbag")


def test_rosbag_in_other_axes_is_refused_and_headers_without_time_are_said(tmp_path, monkeypatch):
    for k, (frame, child) in enumerate([("map_ned", "base_link"), ("map", "cam_optical_frame"), ("earth", "")]):
        with pytest.raises(ThermorenderError, match=f"the axes of frame '{frame if k != 1 else child}' are .* REP 103"):
            read(bag(tmp_path / f"b{k}", frame=frame, child=child, topics=("/odom",)), "rosbag")
    path = read(bag(tmp_path / "n", stamped=False, topics=("/odom",)), "rosbag")
    assert np.allclose(path.time_s, [0.0, 0.25, 0.5], atol=1e-6)
    assert any("the headers have no time, so that of recording is used" in note for note in path.notes)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(
        ThermorenderError, match=r"needs rosbags, which is not installed; run pip install 'thermorender"
    ):
        read(tmp_path / "n", "rosbag")


# Joining, yaw and course


def test_positions_and_heights_of_two_files_are_joined(tmp_path):
    place = write(tmp_path / "gnss.csv", "time_s,lat_deg,lon_deg\n0,47,8\n1,47.0001,8\n2,47.0002,8\n")
    height = write(tmp_path / "baro.csv", "time_s,above_takeoff_m,yaw_deg\n0.5,10,0\n0.75,20,0\n1.75,20,0\n")
    path = read_trajectory([place, height], frame=FRAME, ground=flat)
    assert np.allclose(path.time_s, [0.5, 0.75, 1.0, 1.75])
    assert np.allclose(path.position[:, 2], [10.0, 20.0, 20.0, 20.0], atol=0.01)
    assert np.allclose(path.position[:, 1], 11.117 * path.time_s, rtol=1e-3)
    other = write(tmp_path / "lon.csv", "time_s,lon_deg\n0,8\n2,8\n")
    lat = write(tmp_path / "lat.csv", "time_s,lat_deg,up_m\n0,47,9\n2,47,9\n")
    with pytest.raises(ThermorenderError, match="lat_deg and lon_deg must be columns of one file"):
        read_trajectory([lat, other], frame=FRAME)


def test_course_over_ground_stands_for_a_missing_yaw(tmp_path):
    north, east = np.clip(np.arange(12), 0, 2) * 10, np.clip(np.arange(12) - 9, 0, 2) * 10
    rows = "".join(f"{k},{e},{n},50\n" for k, (e, n) in enumerate(zip(east, north, strict=True)))
    text = "time_s,east_m,north_m,up_m\n" + rows
    file = write(tmp_path / "a.csv", text)
    path = read_trajectory(file)
    assert np.allclose(view(path, 5)[0], NORTH)
    assert "the log has no yaw, so the vehicle heads north all the time; course turns it" in path.notes[0]
    path = read_trajectory(file, course=True)
    heading = np.degrees(np.arctan2(*path.poses()[:, :2, 2].T))
    # Standing, it keeps its course.
    assert np.allclose(heading[:9], 0.0, atol=1e-6) and np.allclose(heading[-2:], 90.0, atol=1e-6)
    assert path.notes == ()
    with pytest.raises(ThermorenderError, match=r"a\.csv: the positions move less than 1 m, so there is no course"):
        read_trajectory(write(tmp_path / "a.csv", "time_s,east_m,north_m,up_m\n0,0,0,50\n1,0,0.5,50\n"), course=True)
    with pytest.raises(ThermorenderError, match=r"has the vehicle's yaw already; leave course out"):
        read_trajectory(write(tmp_path / "b.csv", "time_s,east_m,north_m,up_m,yaw_deg\n0,0,0,50,7\n"), course=True)


# As loggers and exporters write them


NEWER = (
    "[latitude: {0:.6f}] [longitude: 8.000000] [rel_alt: {1:.3f} abs_alt: 540.000] "
    "[gb_yaw: 90.0 gb_pitch: -30.0 gb_roll: 0.0]"
)


@pytest.mark.parametrize("rewrite", [
    lambda text: text.replace("\n\n", "\n"),
    lambda text: "".join(part.replace(".", ",") if "[" in part else part for part in text.splitlines(keepends=True)),
], ids=["without blank lines", "decimal commas"])  # fmt: skip
def test_subtitles_of_other_writers_have_the_same_path(tmp_path, rewrite):
    plain = srt(tmp_path / "a.srt", [NEWER.format(47.0 + 1e-5 * k, 40.0 + k) for k in range(5)])
    other = write(tmp_path / "b.srt", rewrite(plain.read_text()))
    assert other.read_text() != plain.read_text()
    expected, found = read(plain, "dji-srt"), read(other, "dji-srt")
    np.testing.assert_array_equal(found.time_s, expected.time_s)
    np.testing.assert_array_equal(found.poses(), expected.poses())


def test_gps_with_decimal_commas_is_read_or_named(tmp_path):
    cues = [f"GPS(8,0000, 47,0000{k}, 12) BAROMETER:40" for k in range(5)]
    expected = read(srt(tmp_path / "a.srt", [cue.replace(",0", ".0") for cue in cues]), "dji-srt")
    np.testing.assert_allclose(read(srt(tmp_path / "b.srt", cues), "dji-srt").position, expected.position)
    with pytest.raises(ThermorenderError, match="is not two or three numbers; write them with decimal points"):
        read(srt(tmp_path / "c.srt", [cue.replace(" ", "") for cue in cues]), "dji-srt")


def test_gpx_points_without_a_time_are_dropped_with_their_share(tmp_path):
    stamps = [f"2024-05-01T10:00:0{k}Z" for k in range(5)]
    expected = read(write(tmp_path / "a.gpx", gpx(*((stamp, "") for stamp in stamps))), "gpx", geoid_undulation_m=50.0)
    given = [("", ""), *((stamp, "") for stamp in stamps)]
    shifted = gpx(*given).replace('lon="8.0', 'lon="8.0', 1)
    found = read(write(tmp_path / "b.gpx", shifted), "gpx", geoid_undulation_m=50.0)
    np.testing.assert_array_equal(found.time_s, expected.time_s)
    assert any("1 of 6 track points (16.7%) lack time and are dropped" in note for note in found.notes)


def test_the_second_60_of_gpx_is_the_second_after_59(tmp_path):
    stamps = ["2024-05-01T10:00:59Z", "2024-05-01T10:00:60Z", "2024-05-01T10:01:01Z", "2016-12-31T23:59:60.5Z"]
    path = read(write(tmp_path / "a.gpx", gpx(*((stamp, "") for stamp in stamps[:3]))), "gpx", geoid_undulation_m=50.0)
    np.testing.assert_array_equal(path.time_s, [0.0, 1.0, 2.0])
    late = [("2016-12-31T23:59:59Z", ""), (stamps[3], "")]
    path = read(write(tmp_path / "b.gpx", gpx(*late)), "gpx", geoid_undulation_m=50.0)
    np.testing.assert_array_equal(path.time_s, [0.0, 1.5])


@pytest.mark.parametrize("above", ["sep=;\n", "Flight 12 of 1 May\n", "sep=;\nFlight 12 of 1 May\n"])
def test_a_title_and_a_separator_above_the_names_of_a_log_are_not_read(tmp_path, above):
    rows = ["time_s,east_m,north_m,up_m,yaw_deg", *(f"{k},{k}.5,0,50,90" for k in range(5))]
    expected = read_trajectory(write(tmp_path / "a.csv", "\n".join(rows)))
    given = above + "\n".join(rows).replace(",", ";").replace(".", ",")
    found = read_trajectory(write(tmp_path / "b.csv", given))
    np.testing.assert_array_equal(found.position, expected.position)
    broken = write(tmp_path / "c.csv", given.replace("2;2,5", "2;x"))
    with pytest.raises(ThermorenderError, match=f"row {4 + ('Flight' in above)}, column 'east_m': 'x' is not"):
        read_trajectory(broken)


def test_points_stamped_before_satellites_are_dropped_and_a_pause_is_named(tmp_path):
    stamps = ["1970-01-01T00:00:03Z", "2024-05-01T10:00:00Z", "2024-05-01T10:00:04Z", "2024-05-11T10:00:00Z"]
    path = read(write(tmp_path / "a.gpx", gpx(*((stamp, "") for stamp in stamps))), "gpx", geoid_undulation_m=50.0)
    assert path.span_s == (0.0, 864000.0)
    assert any("1 track points are stamped before 1980" in note for note in path.notes)
    with pytest.raises(ThermorenderError, match="most of them in a pause of 863996 s after 4 s"):
        path.frame_times(9.0)


def test_a_log_that_runs_backwards_is_read_from_its_end(tmp_path):
    head, *rows = ["time_s,east_m,north_m,up_m,yaw_deg", *(f"{k},{k},0,50,90" for k in range(5))]
    expected = read_trajectory(write(tmp_path / "a.csv", "\n".join([head, *rows])))
    found = read_trajectory(write(tmp_path / "b.csv", "\n".join([head, *rows[::-1]])))
    np.testing.assert_array_equal(found.poses(), expected.poses())
    assert any("runs backwards throughout" in note for note in found.notes)


def test_exchanged_latitude_and_longitude_are_named_with_a_mapping_that_mends_them(tmp_path):
    cues = [NEWER.format(47.0 + 1e-5 * k, 40.0 + k) for k in range(5)]
    expected = read(srt(tmp_path / "a.srt", cues), "dji-srt")
    for old, new in (("latitude", "x:"), ("longitude", "latitude"), ("x:", "longitude")):
        cues = [cue.replace(old, new) for cue in cues]
    swapped = srt(tmp_path / "b.srt", cues)
    for anchor in (None, ANCHOR):
        with pytest.raises(ThermorenderError, match=r"latitude and longitude exchanged; exchange the") as caught:
            read(swapped, "dji-srt", anchor=anchor)
    shipped, table = re.search(r"copy of (\S+\.toml) as format, with lines (.*) at its end", str(caught.value)).groups()
    text = Path(shipped).read_text(encoding="utf-8") + table.replace(", ", "\n")
    assert "gimbal_pitch_deg" in table
    mapping = write(tmp_path / "m.toml", text)
    np.testing.assert_allclose(read(swapped, mapping).poses(), expected.poses(), atol=1e-9)


def test_gimbal_angles_against_the_airframe_turn_with_it(tmp_path):
    """A camera 50° down on an aircraft that heads east looks east; against the Earth it looks north, with a note."""
    head = "time_s,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg,gimbal_yaw_deg,gimbal_pitch_deg"
    path = write(tmp_path / "a.csv", f"{head}\n0,0,0,50,90,0,0,0,-50\n1,9,0,50,90,0,0,0,-50\n")
    earth = read_trajectory(path)
    assert np.allclose(view(earth)[0], [0.0, np.cos(np.radians(50)), -np.sin(np.radians(50))])
    assert any("differs from the vehicle's heading by 90°" in note for note in earth.notes)
    body = read_trajectory(path, format=write(tmp_path / "m.toml", '[gimbal]\nrelative_to = "body"\n'))
    assert np.allclose(view(body)[0], [np.cos(np.radians(50)), 0.0, -np.sin(np.radians(50))]) and body.notes == ()
    # A pitch of the airframe adds to the mount's.
    nosed = write(tmp_path / "b.csv", path.read_text().replace(",90,0,", ",90,-5,"))
    lower = read_trajectory(nosed, format=tmp_path / "m.toml")
    assert np.allclose(view(lower)[0], [np.cos(np.radians(55)), 0.0, -np.sin(np.radians(55))])


def test_a_repeated_time_of_an_attitude_does_not_stop_a_gimbal(tmp_path):
    half = np.radians(15.0)
    gimbal = {
        "timestamp": TIME,
        "device_flags": 32,
        "q[0]": np.cos(half),
        "q[1]": 0.0,
        "q[2]": 0.0,
        "q[3]": np.sin(half),
    }
    logs = px4() | {"gimbal_device_attitude_status": gimbal}
    expected = read(ulog(tmp_path / "a.ulg", logs), "ulog", frame=None)
    repeated = np.r_[TIME[:10], TIME[9], TIME[10:]]
    logs["vehicle_attitude"] = logs["vehicle_attitude"] | {"timestamp": repeated}
    found = read(ulog(tmp_path / "b.ulg", logs), "ulog", frame=None)
    np.testing.assert_allclose(found.poses(), expected.poses(), atol=1e-12)
    logs["vehicle_attitude"] = logs["vehicle_attitude"] | {"q[0]": 1e300}
    with pytest.raises(ThermorenderError, match="not a unit quaternion"):
        read(ulog(tmp_path / "c.ulg", logs), "ulog", frame=None)


@pytest.mark.parametrize("length", [0, 1, 2])
def test_a_declaration_of_messages_without_length_is_refused(tmp_path, length):
    file = dataflash(tmp_path / "a.bin", ardupilot())
    data = bytearray(file.read_bytes())
    at = data.index(b"\xa3\x95\x80\x82")
    data[at + 4] = length
    file.write_bytes(data)
    with pytest.raises(ThermorenderError, match=rf"FMT.* gives messages {length} bytes, but their head has 3"):
        read(file, "ardupilot")


def test_a_time_beyond_any_clock_is_refused(tmp_path):
    with pytest.raises(ThermorenderError, match="is not a time of a flight; give seconds, at most 1e"):
        read(write(tmp_path / "a.txt", "-1e308 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n"), "tum", frame=None)


def test_points_at_latitude_and_longitude_0_are_dropped_with_their_share(tmp_path):
    stamps = [(f"2024-05-01T10:00:0{k}Z", "") for k in range(5)]
    text = gpx(*stamps)
    for k in range(2):
        text = text.replace(f'lat="47.0" lon="{8 + 1e-5 * k:.5f}"', 'lat="0.0" lon="0.0000000"')
    found = read(write(tmp_path / "a.gpx", text), "gpx", geoid_undulation_m=50.0)
    assert found.span_s == (0.0, 2.0)
    assert any("2 of 5 track points (40.0%) are dropped as invalid" in note for note in found.notes)
    rows = "time_s,lat_deg,lon_deg,up_m\n0,0,0.0,50\n1,47,8,50\n2,47.00001,8,50\n"
    found = read(write(tmp_path / "a.csv", rows), None, anchor=ANCHOR)
    assert found.span_s == (1.0, 2.0) and any("1 of 3 rows (33.3%)" in note for note in found.notes)


def test_rows_out_of_order_are_sorted_by_the_mapping_that_the_error_names(tmp_path):
    stamps = [(f"2024-05-01T10:00:0{k}Z", "") for k in (0, 2, 1, 3)]
    path = write(tmp_path / "a.gpx", gpx(*stamps))
    with pytest.raises(
        ThermorenderError, match=r"time is running backwards.* copy of (.*gpx\.toml) as format"
    ) as caught:
        read(path, "gpx", geoid_undulation_m=50.0)
    shipped = Path(re.search(r"copy of (\S+\.toml) as format", str(caught.value))[1]).read_text(encoding="utf-8")
    mapping = write(tmp_path / "m.toml", f"sort_by_time = true\n{shipped}")
    assert read(path, mapping, geoid_undulation_m=50.0).span_s == (0.0, 3.0)
