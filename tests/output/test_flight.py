"""Flights: products, records, and resuming to the same bytes."""

import json
import pickle
import shutil
import warnings
from dataclasses import replace

import mitsuba
import numpy as np
import pytest
import trimesh
from support import contents, interrupted, records, slow

import thermorender as tr
from scenes import coarse, scene_object, write_mesh, write_terrain
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.formats import write_image
from thermorender.frame.exr import read_exr
from thermorender.output.flight import FlightOptions, fly
from thermorender.output.products import write
from thermorender.scene.spec import TemperatureSpec
from thermorender.sensor.detector import row_delays
from thermorender.sensor.display import DisplaySettings
from thermorender.sensor.radiometric_files import read_temperature
from thermorender.sensor.radiometry import ThermographySettings

pytestmark = pytest.mark.usefixtures("short_heat")

MARKER = scene_object("marker", [1, 1, 0.1], shape="disc")


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    scene = coarse(tr.load_scene(write_terrain(tmp_path_factory.mktemp("scene") / "tiny", extra=MARKER)))
    renderer = tr.Renderer(scene, rays=4, samples=1, seed=11)
    path = tr.Trajectory(
        time_s=np.array([0.0, 1.0]),
        position=np.array([[-1.0, 0.0, 12.0], [1.0, 0.0, 12.0]]),
        quaternion=np.array([[0.0, 1.0, 0.0, 0.0]] * 2),
    )
    return renderer, path


def test_products_and_records(setting, tmp_path):
    import cv2

    renderer, path = setting
    summary = fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=4.0))
    assert summary["frames"] == 5 and summary["rendered"] == 5
    names = set(contents(tmp_path / "f"))
    assert {"flight.json", "frames.jsonl", "flight.mp4", "frame_000004.exr", "frame_000004.png"} <= names
    assert not any(".part" in name for name in names)
    lines = [json.loads(line) for line in (tmp_path / "f/frames.jsonl").read_text().splitlines()]
    assert [line["index"] for line in lines] == [0, 1, 2, 3, 4]
    assert lines[4]["time_s"] == pytest.approx(1.0) and lines[4]["seed"] == 11
    assert lines[2]["targets"]["marker"]["visible"] and lines[2]["plan"]["samples"] == 1
    np.testing.assert_allclose(np.array(lines[2]["world_from_camera"])[:3, 3], [0, 0, 12], atol=1e-9)

    frame = renderer.frame(path.pose(0.5), time_s=0.5, index=2)
    channels, record = read_exr(tmp_path / "f/frame_000002.exr")
    flown = json.loads((tmp_path / "f/flight.json").read_text())
    assert record["versions"] == flown["versions"] and record["device"] == flown["device"]
    np.testing.assert_array_equal(channels["radiance"], frame.radiance)
    np.testing.assert_array_equal(channels["apparent_temperature"], frame.apparent_temperature)
    np.testing.assert_array_equal(channels["truth.position.z"], frame.truth["position"][..., 2])
    np.testing.assert_array_equal(channels["truth.material"], frame.truth["material"])
    assert record["index"] == 2 and record["units"]["radiance"] == "W m-2 sr-1"
    names = [material.name for material in renderer.scene.materials]
    assert record["materials"] == flown["materials"] == names == list(frame.materials)
    counts = cv2.imread(str(tmp_path / "f/frame_000002_counts.png"), cv2.IMREAD_UNCHANGED)
    assert counts.dtype == np.uint16
    assert np.abs(counts.astype(int) - frame.counts).max() > 0  # a flight's pixels have memory, a single frame's do not
    assert lines[2]["plan"]["sensor"]["motion_px"] == pytest.approx(2.0 * 0.01 * 765 / 4 / 12, rel=0.01)
    video = cv2.VideoCapture(str(tmp_path / "f/flight.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 5 and video.get(cv2.CAP_PROP_FRAME_WIDTH) == 160
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(4.0)


def test_frames_in_python_are_those_of_a_flight(setting, tmp_path):
    renderer, path = setting
    products = ("exr", "truth", "counts", "display")
    fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=4.0, products=products))
    frames = renderer.frames(path, rate_hz=4.0)
    assert len(frames) == 5 and "5 frames, 0.000…1.000 s, 4 Hz" in repr(frames)
    # Twice, since each loop starts with a sensor before its first frame.
    for _ in range(2):
        for frame in frames:
            write(tmp_path / "own", frame, products)
    own, flown = contents(tmp_path / "own"), contents(tmp_path / "f")
    assert len(own) == 15
    assert all(flown[name] == data for name, data in own.items())
    part = list(renderer.frames(path, rate_hz=4.0, start_s=0.5))
    assert [frame.time_s for frame in part] == [0.5, 0.75, 1.0]
    with pytest.raises(ThermorenderError, match=r"trajectory='flight.csv' is not a Trajectory; give what load_traject"):
        renderer.frames("flight.csv")
    with pytest.raises(ThermorenderError, match="stop_s"):
        renderer.frames(path, stop_s=3.0)


def test_resume_gives_the_same_bytes(setting, tmp_path):
    renderer, path = setting
    fly(renderer, path, tmp_path / "whole", FlightOptions(rate_hz=4.0))

    class Stop(Exception):
        pass

    def stop(done, total):
        if done == 3:
            raise Stop

    with pytest.raises(Stop):
        fly(renderer, path, tmp_path / "part", FlightOptions(rate_hz=4.0), progress=stop)
    # A kill may leave half a line and a temporary file.
    with open(tmp_path / "part/frames.jsonl", "a") as file:
        file.write('{"index": 3, "time')
    (tmp_path / "part/frame_000001.png").unlink()
    (tmp_path / "part/.frame_000003.0123abcd.part.exr").write_bytes(b"half")
    summary = fly(renderer, path, tmp_path / "part", FlightOptions(rate_hz=4.0), resume=True)
    assert summary["rendered"] == 4
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")
    assert fly(renderer, path, tmp_path / "part", FlightOptions(rate_hz=4.0), resume=True)["rendered"] == 0


def test_frames_carry_the_budget_of_the_last_audit(setting, tmp_path):
    renderer, path = setting
    flight = FlightOptions(rate_hz=4.0, products=("exr",), audit=2)
    fly(renderer, path, tmp_path / "whole", flight)
    lines = records(tmp_path / "whole")
    assert [line["budget_frame"] for line in lines] == [0, 0, 2, 2, 4]
    own = [renderer.frame(path.pose(line["time_s"]), line["time_s"], index=line["index"]).budget_mk for line in lines]
    stated = [line["budget_mk"] for line in lines]
    assert stated == [{cause: round(value, 2) for cause, value in own[k].items()} for k in (0, 0, 2, 2, 4)]
    assert stated[1] != own[1]
    header = read_exr(tmp_path / "whole/frame_000003.exr")[1]
    assert (header["budget_mk"], header["budget_frame"]) == (stated[2], 2)
    # The part that follows starts between two audits.
    with interrupted(3) as stop:
        fly(renderer, path, tmp_path / "part", flight, progress=stop)
    fly(renderer, path, tmp_path / "part", flight, resume=True)
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")
    with pytest.raises(ThermorenderError, match="was flown with audit=2, now audit=3"):
        fly(renderer, path, tmp_path / "part", replace(flight, audit=3), resume=True)
    with pytest.raises(ThermorenderError, match="audit=0 is not allowed; give 1 for every frame, or more"):
        fly(renderer, path, tmp_path / "none", replace(flight, audit=0))
    carried = list(renderer.frames(path, rate_hz=4.0, audit=2))[3]
    again = pickle.loads(pickle.dumps(carried))
    assert (again.budget_frame, again.budget_mk) == (carried.budget_frame, carried.budget_mk) == (2, own[2])
    fly(renderer, path, tmp_path / "error", replace(flight, rate_hz=1.0, products=("exr", "error")))
    assert [line["budget_frame"] for line in records(tmp_path / "error")] == [0, 1]


@pytest.mark.parametrize("fault", ["removed", "moved", "replaced"])
def test_folder_removed_during_a_flight_is_reported(setting, tmp_path, fault):
    renderer, path = setting
    folder, flight = tmp_path / "f", FlightOptions(rate_hz=4.0, products=("counts",))

    def meddle(done, total):
        if done == 3:
            folder.rename(tmp_path / "elsewhere")
            if fault == "removed":
                shutil.rmtree(tmp_path / "elsewhere")
            if fault == "replaced":
                folder.mkdir()

    with pytest.raises(ThermorenderError, match="f was removed, moved or replaced while it was flown into"):
        fly(renderer, path, folder, flight, progress=meddle)
    # Nothing is written to the old path.
    assert not (folder.exists() and any(folder.iterdir()))
    if fault == "moved":
        assert fly(renderer, path, tmp_path / "elsewhere", flight, resume=True)["rendered"] == 2


@pytest.mark.parametrize("damage", ["cut", "changed"])
def test_damaged_files_are_rendered_again(setting, tmp_path, damage):
    renderer, path = setting
    flight = FlightOptions(rate_hz=4.0, products=("exr", "counts"))
    fly(renderer, path, tmp_path / "f", flight)
    whole = contents(tmp_path / "f")
    recorded = json.loads((tmp_path / "f/frames.jsonl").read_text().splitlines()[2])["files"]
    assert recorded["frame_000002.exr"][0] == len(whole["frame_000002.exr"]) and len(recorded) == 2
    damaged = bytearray(whole["frame_000002.exr"])
    if damage == "cut":
        del damaged[20_000:]
    else:
        damaged[5_000] ^= 1
    (tmp_path / "f/frame_000002.exr").write_bytes(damaged)
    assert fly(renderer, path, tmp_path / "f", flight, resume=True)["rendered"] == (3 if damage == "cut" else 0)
    assert fly(renderer, path, tmp_path / "f", flight, verify=True)["rendered"] == (0 if damage == "cut" else 3)
    assert contents(tmp_path / "f") == whole


@pytest.mark.parametrize(("copied", "product"), [("_counts.png", None), *slow((".exr", "mcap")), (".png", "video")])
def test_resume_does_not_copy_a_flipped_bit_into_another_file(setting, tmp_path, copied, product):
    """Only files from which others are made are read again without `verify`."""
    renderer, path = setting
    flight = FlightOptions(rate_hz=4.0, products=("exr", "counts", "display", *filter(None, [product])))
    fly(renderer, path, tmp_path / "whole", flight)
    with interrupted(4) as stop:
        fly(renderer, path, tmp_path / "f", flight, progress=stop)
    damaged = tmp_path / f"f/frame_000001{copied}"
    data = bytearray(damaged.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    if product is None:
        with warnings.catch_warnings():
            warnings.simplefilter("error", ThermorenderWarning)
            fly(renderer, path, tmp_path / "f", flight, resume=True)
        assert damaged.read_bytes() == data
        return
    with pytest.warns(ThermorenderWarning, match=f"frame_000001{copied} is missing or not as it was written"):
        assert fly(renderer, path, tmp_path / "f", flight, resume=True)["rendered"] == 4
    assert contents(tmp_path / "f") == contents(tmp_path / "whole")


def test_hovering_flight_starts_as_a_single_frame(setting, tmp_path):
    import cv2

    renderer, path = setting
    hovering = tr.Trajectory(path.time_s, path.position[[0, 0]], path.quaternion)
    fly(renderer, hovering, tmp_path / "f", FlightOptions(rate_hz=1.0, products=("counts",)))
    counts = cv2.imread(str(tmp_path / "f/frame_000000_counts.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(counts, renderer.frame(path.pose(0.0)).counts)


@pytest.mark.parametrize("lost", ["nothing", *slow("the state"), "half of the state"])
def test_resume_restores_the_pixels_memory(setting, tmp_path, lost):
    # At 100 Hz a third of a frame is the previous signal; at 4 Hz nothing would be.
    renderer, path = setting
    flight = FlightOptions(rate_hz=100.0, stop_s=0.05, products=("counts",))
    fly(renderer, path, tmp_path / "whole", flight)
    with interrupted(3) as stop:
        fly(renderer, path, tmp_path / "part", flight, progress=stop)
    state = tmp_path / "part/sensor_even.npz"
    assert state.exists()
    if lost == "the state":
        state.unlink()
    elif lost == "half of the state":
        state.write_bytes(state.read_bytes()[: state.stat().st_size // 2])
    assert fly(renderer, path, tmp_path / "part", flight, resume=True)["rendered"] == 3
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")
    assert not list((tmp_path / "part").glob("sensor*"))


@pytest.mark.parametrize("lost", [*slow(False), True])
def test_resume_continues_the_gain_control(setting, tmp_path, lost):
    renderer, path = setting
    display = DisplaySettings("plateau", "ironbow", memory_s=1.0)
    flight = FlightOptions(rate_hz=4.0, products=("display",), display=display)
    fly(renderer, path, tmp_path / "whole", flight)
    with interrupted(3) as stop:
        fly(renderer, path, tmp_path / "part", flight, progress=stop)
    if lost:
        (tmp_path / "part/sensor_even.npz").unlink()
    assert fly(renderer, path, tmp_path / "part", flight, resume=True)["rendered"] == 2
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")
    # Without memory the last frame is different, so this memory has an effect.
    fly(renderer, path, tmp_path / "none", replace(flight, display=DisplaySettings("plateau", "ironbow")))
    assert contents(tmp_path / "none")["frame_000004.png"] != contents(tmp_path / "whole")["frame_000004.png"]
    with pytest.raises(ThermorenderError, match=r"was flown with display.mode="):
        fly(renderer, path, tmp_path / "whole", replace(flight, display=DisplaySettings()), resume=True)


def test_thermography_reading_is_written_with_the_truth(setting, tmp_path):
    renderer, path = setting
    # Shading and drift would also change the reading.
    quiet = replace(renderer.scene.camera, shading_mk=0.0, shading_mk_per_k=0.0, scale_drift_mk=0.0)
    renderer = tr.Renderer(renderer.scene.with_camera(quiet), rays=4, samples=1, seed=11)
    settings = ThermographySettings(emissivity=0.95, reflected_c=-13.15, air_c=15.0, distance_m=12.0)
    flight = FlightOptions(rate_hz=1.0, products=("exr", "truth", "radiometric"), thermography=settings)
    fly(renderer, path, tmp_path / "f", flight)
    channels, record = read_exr(tmp_path / "f/frame_000001.exr")
    read = channels["thermography_temperature"]
    assert record["thermography"]["emissivity"] == 0.95 and record["units"]["thermography_temperature"] == "K"
    assert np.abs(read_temperature(tmp_path / "f/frame_000001_radiometric.tif") - read).max() < 0.0201
    # With neutral settings, the formula and the true apparent temperature differ by noise, blur and fit only.
    flight = FlightOptions(rate_hz=1.0, products=("exr",), thermography=ThermographySettings())
    fly(renderer, path, tmp_path / "g", flight)
    plain = read_exr(tmp_path / "g/frame_000001.exr")[0]
    difference = plain["thermography_temperature"] - plain["apparent_temperature"]
    assert abs(np.median(difference)) < 0.1 and 0.02 < np.median(np.abs(difference)) < 0.3
    assert np.median(read - plain["thermography_temperature"]) > 0.5
    with pytest.raises(ThermorenderError, match="goes into 'exr' and 'radiometric'"):
        fly(renderer, path, tmp_path / "h", FlightOptions(products=("counts",), thermography=settings))


def test_per_pixel_error_is_written_on_request(setting, tmp_path):
    # The full pixel count, as the record samples the light in every sixteenth pixel only.
    renderer, path = tr.Renderer(tr.load_scene(setting[0].scene.spec.folder), rays=4, samples=1), setting[1]
    fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=1.0, products=("exr", "error")))
    channels, record = read_exr(tmp_path / "f/frame_000001.exr")
    assert record["units"]["error"] == "mK at 300 K" and "truth.depth" not in channels
    total = float(np.sqrt(np.nanmean(np.square(channels["error"], dtype=np.float64))))
    assert total == pytest.approx(record["budget_mk"]["total"], rel=0.1)
    fly(renderer, path, tmp_path / "g", FlightOptions(rate_hz=1.0, products=("exr",)))
    assert "error" not in read_exr(tmp_path / "g/frame_000001.exr")[0]
    with pytest.raises(ThermorenderError, match="product 'error' is channels of the EXR; add 'exr'"):
        fly(renderer, path, tmp_path / "h", FlightOptions(products=("error", "counts")))


def flown_over(tmp_path, name, track, path, **keywords):
    folder = write_terrain(tmp_path / name, extra=MARKER + 'track = "marker.csv"\n')
    (folder / "marker.csv").write_text(track)
    renderer = tr.Renderer(tr.load_scene(folder), rays=4, samples=1)
    fly(renderer, path, tmp_path / f"{name} flown", FlightOptions(products=("counts",), **keywords))
    lines = (tmp_path / f"{name} flown" / "frames.jsonl").read_text().splitlines()
    return renderer, [json.loads(line)["plan"]["sensor"] for line in lines]


@pytest.mark.slow
def test_moving_object_is_rendered_in_its_part_of_the_image(tmp_path):
    path = tr.Trajectory(np.array([0.0, 1.0]), np.array([[-1.0, 0, 12], [1.0, 0, 12]]), np.array([[0, 1.0, 0, 0]] * 2))
    for name in ("a", "b"):
        _, sensor = flown_over(tmp_path / name, "scene", "time_s,east_m\n0,1\n1,-1\n", path, rate_hz=2.0)
    # Camera and marker pass each other.
    assert sensor[1]["motion_px"] == pytest.approx(1.3, abs=0.1) and sensor[1]["renders"] >= sensor[1]["instants"] > 5
    first, second = (contents(tmp_path / name / "scene flown") for name in ("a", "b"))
    assert {name for name in first if first[name] != second[name]} == {"flight.json"}


@pytest.mark.parametrize("rate_hz", slow(9.0, 30.0))
def test_warming_marker_is_read_by_rows_at_their_own_time(tmp_path, rate_hz):
    """All three flights have the same noise, so their differences are the marker's."""
    import cv2

    path = tr.Trajectory(np.array([0.0, 1.0]), np.array([[0.1, 0, 2], [0.1, 0, 2]]), np.array([[0, 1.0, 0, 0]] * 2))
    frame = int(rate_hz * 0.5)
    step_s = frame / rate_hz - 0.011
    tracks = {
        "cold": "0,300\n",
        "warm": "0,330\n",
        "step": f"0,300\n{step_s:.9f},300\n{step_s + 1e-6:.9f},330\n1,330\n",
    }
    counts = {}
    for name, rows in tracks.items():
        track = "time_s,temperature_k\n" + rows
        renderer, _ = flown_over(tmp_path, name, track, path, rate_hz=rate_hz, stop_s=(frame + 0.5) / rate_hz)
        image = cv2.imread(str(tmp_path / f"{name} flown/frame_{frame:06d}_counts.png"), cv2.IMREAD_UNCHANGED)
        counts[name] = image.astype(float)
    span = counts["warm"] - counts["cold"]
    shown = span > 0.95 * span.max()
    rows = np.flatnonzero(shown.sum(axis=1) > 3)
    assert len(rows) > 8
    camera = renderer.scene.camera
    since = row_delays(camera, 1.0 / rate_hz) + 0.011
    for row in rows:
        share = ((counts["step"] - counts["cold"])[row, shown[row]] / span[row, shown[row]]).mean()
        assert share == pytest.approx(-np.expm1(-max(since[row], 0.0) / camera.time_constant_s), abs=2.0 / span.max())


def test_resume_refuses_other_settings(setting, tmp_path):
    renderer, path = setting
    fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=2.0, products=("counts",)))
    with pytest.raises(ThermorenderError, match="already holds a flight; give another folder, or set resume"):
        fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=2.0, products=("counts",)))
    with pytest.raises(ThermorenderError, match=r"was flown with rate_hz=2.0, now rate_hz=3.0"):
        fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=3.0, products=("counts",)), resume=True)
    other = tr.Renderer(renderer.scene, rays=4, samples=1, seed=12)
    with pytest.raises(ThermorenderError, match="was flown with seed=11, now seed=12"):
        fly(other, path, tmp_path / "f", FlightOptions(rate_hz=2.0, products=("counts",)), resume=True)
    higher = tr.Trajectory(path.time_s, path.position + [0.0, 0.0, 0.5], path.quaternion)
    with pytest.raises(ThermorenderError, match="was flown with path_digest="):
        fly(renderer, higher, tmp_path / "f", FlightOptions(rate_hz=2.0, products=("counts",)), resume=True)
    # The same positions at the frames (0, 0.5 and 1 s), but another path between them.
    positions = np.array([path.position[0], [0.0, 0.3, 12.0], [0.0, 0.0, 12.0], path.position[1]])
    detour = tr.Trajectory(np.array([0.0, 0.25, 0.5, 1.0]), positions, path.quaternion[[0, 0, 0, 0]])
    np.testing.assert_array_equal(detour.pose(0.5), path.pose(0.5))
    with pytest.raises(ThermorenderError, match="was flown with path_digest="):
        fly(renderer, detour, tmp_path / "f", FlightOptions(rate_hz=2.0, products=("counts",)), resume=True)
    warmer = renderer.scene.with_temperature(TemperatureSpec(source="constant", value=300.0))
    other = tr.Renderer(warmer, rays=4, samples=1, seed=11)
    other.plan = renderer.plan
    with pytest.raises(ThermorenderError, match="was flown with scene_digest="):
        fly(other, path, tmp_path / "f", FlightOptions(rate_hz=2.0, products=("counts",)), resume=True)


def test_resume_compares_everything_that_the_bytes_depend_on(setting, tmp_path):
    renderer, path = setting
    folder, flight = tmp_path / "f", FlightOptions(rate_hz=2.0, products=("counts",))
    fly(renderer, path, folder, flight)
    for setting, was, now in (
        # So close that the spectral nodes are the same.
        ({"tolerance_mk": 4.9}, "plan.tolerance_mk=5.0", "plan.tolerance_mk=4.9"),
        ({"rays": 6}, "plan.bake_rays=4", "plan.bake_rays=6"),
        ({"taps": 8}, "plan.taps=4", "plan.taps=8"),
        ({"edge_mk": 151.0}, "plan.edge_mk=150.0", "plan.edge_mk=151.0"),
    ):
        other = tr.Renderer(renderer.scene, **{"rays": 4, "samples": 1, "seed": 11, **setting})
        with pytest.raises(ThermorenderError, match=f"was flown with {was}, now {now}; resume with the same settings"):
            fly(other, path, folder, flight, resume=True)
    described = tmp_path / "f/flight.json"
    written = json.loads(described.read_text())
    assert written["device"]["variant"] == mitsuba.variant() and len(written["device"]) > 1
    assert {"thermorender", "mitsuba", "drjit", "numpy"} <= set(written["versions"])
    for key in ("device", "versions"):
        for inner in written[key]:
            described.write_text(json.dumps(written | {key: written[key] | {inner: "another"}}))
            with pytest.raises(ThermorenderError, match=f"was flown with {key}.{inner}='another', now {key}.{inner}="):
                fly(renderer, path, folder, flight, resume=True)


@pytest.mark.parametrize("damage", ["not JSON", "frame 2 replaced by 1", *slow("a line missing", "another number")])
def test_resume_from_a_damaged_record(setting, tmp_path, damage):
    renderer, path = setting
    flight = FlightOptions(rate_hz=4.0, products=("counts",))
    fly(renderer, path, tmp_path / "f", flight)
    whole = contents(tmp_path / "f")
    lines = (tmp_path / "f/frames.jsonl").read_text().splitlines()
    lines[2:3] = {
        "not JSON": ['{"index": 2, "ti'], "frame 2 replaced by 1": [lines[1]], "a line missing": [],
        "another number": [lines[2].replace('"seed": ', '"seed": 1')],
    }[damage]  # fmt: skip
    (tmp_path / "f/frames.jsonl").write_text("".join(line + "\n" for line in lines))
    assert fly(renderer, path, tmp_path / "f", flight, resume=True)["rendered"] == 3
    assert contents(tmp_path / "f") == whole


def test_frames_without_terrain_are_counted(setting, tmp_path):
    renderer, path = setting
    # From straight down over the horizon to straight up.
    turning = tr.Trajectory(path.time_s, path.position, np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]))
    poses = turning.sampled(turning.frame_times(8.0)).poses()
    seen = [bool(np.isfinite(renderer.frame(pose).truth["depth"]).any()) for pose in poses]
    assert 0 < sum(seen) < len(seen) == 9
    flight = FlightOptions(rate_hz=8.0, products=("counts",))
    summary = fly(renderer, turning, tmp_path / "whole", flight)
    assert summary["frames_without_terrain"] == seen.count(False)
    assert json.loads((tmp_path / "whole/flight.json").read_text())["frames_without_terrain"] == seen.count(False)
    lines = (tmp_path / "whole/frames.jsonl").read_text().splitlines()
    assert [json.loads(line)["shows_terrain"] for line in lines] == seen
    with interrupted(7) as stop:
        fly(renderer, turning, tmp_path / "part", flight, progress=stop)
    summary = fly(renderer, turning, tmp_path / "part", flight, resume=True)
    assert summary["rendered"] == 2 and summary["frames_without_terrain"] == seen.count(False)
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")


def test_terrain_larger_than_the_picture_counts_as_terrain(tmp_path):
    # No corner of its two triangles is inside the picture.
    square = trimesh.Trimesh([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], [[0, 1, 2], [0, 2, 3]])
    renderer = tr.Renderer(tr.load_scene(write_mesh(tmp_path / "square", square)), rays=4, samples=1)
    path = tr.Trajectory(np.array([0.0, 1.0]), np.array([[0.0, 0, 12], [1.0, 0, 12]]), np.array([[0, 1.0, 0, 0]] * 2))
    summary = fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=1.0, products=("counts",)))
    assert summary["frames_without_terrain"] == 0


def test_products_are_optional(setting, tmp_path):
    renderer, path = setting
    fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=1.0, products=("counts-tiff",)))
    images = {"frame_000000_counts.tif", "frame_000001_counts.tif"}
    assert set(contents(tmp_path / "f")) == {"flight.json", "frames.jsonl", *images}
    for wanted, words in (
        (("exrs",), "product 'exrs' is unknown; give some of exr, counts"),
        (("truth",), "add 'exr'"),
        (("video",), "add 'display'"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            fly(renderer, path, tmp_path / "g", FlightOptions(products=wanted))
    assert not (tmp_path / "g").exists()


def test_colours_keep_their_order(tmp_path):
    import cv2

    write_image(tmp_path / "a.png", np.full((2, 2, 3), (250, 100, 10), np.uint8))
    assert cv2.imread(str(tmp_path / "a.png"))[0, 0].tolist() == [10, 100, 250]


@pytest.fixture
def kernels():
    """A function that returns the kernels that ran since its last call."""
    import drjit as dr

    def ran():
        found = {str(each["hash"]) for each in dr.kernel_history() if "hash" in each}
        dr.kernel_history_clear()
        return found

    flag = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    yield ran
    dr.set_flag(dr.JitFlag.KernelHistory, flag)
    dr.kernel_history_clear()


@pytest.mark.slow
def test_flight_compiles_no_kernel_per_pose(tmp_path, kernels):
    """Compiling a kernel per pose would cost milliseconds, and its memory."""
    from tests.robustness import crash_targets

    crash_targets.write_scene(tmp_path / "scene")
    path, known, products = crash_targets.to_and_fro(12.0), [], ("exr", "truth", "counts", "display", "error")
    renderer, flight = crash_targets.busy(tmp_path / "scene", 12.0), FlightOptions(rate_hz=9.0, products=products)
    fly(renderer, path, tmp_path / "f", flight, progress=lambda done, total: known.append(kernels()))
    whole = round(crash_targets.ROUND_S * 9.0)
    assert len(known) > 2 * whole
    # After one round every object has been in view.
    assert not set().union(*known[whole + 1 :]) - set().union(*known[: whole + 1])


@pytest.mark.slow
def test_scene_is_reloaded_without_compiling(tmp_path, kernels):
    from tests.robustness import crash_targets

    crash_targets.write_scene(tmp_path / "scene")
    kept, known = [], []
    for _ in range(6):
        crash_targets.renderer(tmp_path / "scene").frame(crash_targets.straight(1.0).pose(0.5)).budget_mk  # noqa: B018
        known.append(kernels())
        # Shift memory, so that the scene's arrays have new addresses each time.
        kept.append(np.empty(1000 + 24 * len(kept), np.uint8))
    assert not set().union(*known[1:]) - known[0]


@pytest.mark.slow
def test_another_scene_is_rendered_without_compiling(tmp_path, kernels):
    """Other heights and temperatures: the next hour, an edit, the next scene of a campaign."""
    from tests.robustness import crash_targets

    crash_targets.write_scene(tmp_path / "scene")
    first, known = crash_targets.renderer(tmp_path / "scene"), []
    for turn in range(5):
        surfaces = tuple(
            replace(
                each,
                vertices=(each.vertices * np.float32(1.0 + 0.07 * (turn % 3))).astype(np.float32),
                temperature=(each.temperature + np.float32(3.1 * turn)).astype(np.float32),
            )
            for each in first.scene.surfaces
        )
        found = tr.Renderer(first.scene.with_surfaces(surfaces), rays=8, samples=1)
        frame = found.frame(crash_targets.straight(1.0).pose(0.5))
        assert frame.budget_mk and np.isfinite(frame.error_mk).any()
        known.append(kernels())
    assert not set().union(*known[1:]) - known[0]
