"""Frames written beside the rendering: order, bounded memory, and errors in the threads that write."""

import errno
import hashlib
import json
import os
import threading
import time
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from support import contents, interrupted, slow

from tests.robustness import crash_targets
from thermorender import files, timing
from thermorender.errors import ThermorenderError
from thermorender.frame.exr import COMPRESSIONS, read_exr
from thermorender.output import video, writer
from thermorender.output.flight import FlightOptions, fly


@pytest.fixture(autouse=True)
def three_workers(monkeypatch):
    monkeypatch.setattr(writer, "WORKERS", 3)
    monkeypatch.setattr(writer, "MOST", 4)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return crash_targets.write_scene(tmp_path_factory.mktemp("scene") / "scene")


def flown(scene, folder, **more):
    (folder / "scene").symlink_to(scene)
    (folder / "work").mkdir()
    crash_targets.flight(folder / "work", **more)


# --- the writer -------------------------------------------------------------------------------------------------


def test_jobs_are_finished_in_order_and_few_are_in_hand():
    finished, reported, running, most, lock = [], [], 0, 0, threading.Lock()

    def prepare(number):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        # Later jobs are faster.
        time.sleep(0.02 if number % 3 == 0 else 0.0)
        with lock:
            running -= 1
        return number

    started = []
    with writer.OrderedWriter(finished.append, reported.append, pytest.fail) as jobs:
        for number in range(30):
            jobs.put(partial(prepare, number))
            started.append(number + 1 - len(reported))
        jobs.drain()
        assert len(reported) == 30
        jobs.put(partial(prepare, 30))
    assert finished == reported == list(range(31))
    assert most <= 3 and max(started) <= 4


def test_jobs_in_hand_wait_for_the_slowest():
    release, started = threading.Event(), []

    def prepare(number):
        started.append(number)
        assert number or release.wait(10.0)

    with writer.OrderedWriter(lambda found: None, lambda found: None, lambda found: None) as jobs:
        thread = threading.Thread(target=lambda: [jobs.put(partial(prepare, number)) for number in range(9)])
        thread.start()
        end = time.monotonic() + 10.0
        while len(started) < 5 and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(0.05)
        # The first is not finished, so a fifth is taken but no sixth.
        assert thread.is_alive() and set(started) == {0, 1, 2, 3, 4}
        release.set()
        thread.join()
    assert sorted(started) == list(range(9))


def test_an_error_is_raised_in_its_turn_and_later_jobs_are_discarded():
    finished, discarded = [], []

    def prepare(number):
        if number == 2:
            raise ThermorenderError("no room for 2")
        return number

    def put_all():
        with writer.OrderedWriter(finished.append, lambda found: None, discarded.append) as jobs:
            for number in range(9):
                jobs.put(partial(prepare, number))

    with pytest.raises(ThermorenderError, match="no room for 2"):
        put_all()
    assert finished == [0, 1] and not set(discarded) & {0, 1, 2}


def test_nothing_is_finished_after_an_interruption():
    finished, discarded = [], []

    def report(number):
        if number == 1:
            raise KeyboardInterrupt

    def put_all():
        with writer.OrderedWriter(finished.append, report, discarded.append) as jobs:
            for number in range(9):
                jobs.put(partial(int, number))
                time.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        put_all()
    assert finished == [0, 1] and not set(discarded) & {0, 1}


# --- flights ----------------------------------------------------------------------------------------------------


def test_frames_that_take_longer_to_write_keep_their_order(scene, tmp_path, monkeypatch):
    aside = files.write_aside

    def slowly(path, data):
        time.sleep(0.03 if path.name in ("frame_000002.exr", "frame_000005.exr") else 0.0)
        return aside(path, data)

    (tmp_path / "a").mkdir()
    flown(scene, tmp_path / "a", products=("exr", "counts"))
    monkeypatch.setattr(files, "write_aside", slowly)
    (tmp_path / "b").mkdir()
    flown(scene, tmp_path / "b", products=("exr", "counts"))
    assert contents(tmp_path / "a/work/out") == contents(tmp_path / "b/work/out")


@pytest.mark.parametrize("fault", ["full", *slow("broken")])
def test_an_error_while_a_frame_is_written_stops_the_flight(scene, tmp_path, monkeypatch, fault):
    (tmp_path / "a").mkdir()
    flown(scene, tmp_path / "a", products=("exr", "counts"))
    (tmp_path / "b").mkdir()
    aside = files.write_aside

    def fails(path, data):
        if path.name != "frame_000003_counts.png":
            return aside(path, data)
        with files.reported(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) if fault == "full" else RuntimeError("no memory")

    words = {"full": "No space left on device", "broken": "no memory"}[fault]
    with monkeypatch.context() as patch:
        patch.setattr(files, "write_aside", fails)
        with pytest.raises(ThermorenderError, match=rf"frame_000003_counts.png cannot be written: {words}; check") as e:
            flown(scene, tmp_path / "b", products=("exr", "counts"))
    assert crash_targets.sentence(str(e.value))
    left = contents(tmp_path / "b/work/out")
    assert len(left["frames.jsonl"].splitlines()) == 3
    # Files of later frames were removed, and the state after the last frame is kept.
    assert {name for name in left if name.startswith("frame_")} == {
        f"frame_{number:06d}{end}" for number in range(3) for end in (".exr", "_counts.png")
    }
    assert not [name for name in left if ".part" in name] and "sensor_even.npz" in left
    assert crash_targets.flight(tmp_path / "b/work", products=("exr", "counts"))["rendered"] == crash_targets.FRAMES - 3
    assert contents(tmp_path / "b/work/out") == contents(tmp_path / "a/work/out")


# --- video --------------------------------------------------------------------------------------------------------


def images_of(path):
    video = cv2.VideoCapture(str(path))
    return int(video.get(cv2.CAP_PROP_FRAME_COUNT))


def test_the_video_is_encoded_from_the_frames_as_they_are_finished(scene, tmp_path, monkeypatch):
    products, read = ("counts", "display", "video"), []
    of_file = video.VideoWriter.write_file

    def noted(self, path):
        read.append(path.name)
        of_file(self, path)

    monkeypatch.setattr(video.VideoWriter, "write_file", noted)
    (tmp_path / "whole").mkdir()
    flown(scene, tmp_path / "whole", products=products)
    assert not read and images_of(tmp_path / "whole/work/out/flight.mp4") == crash_targets.FRAMES
    (tmp_path / "part").mkdir()
    with interrupted(5) as stop:
        flown(scene, tmp_path / "part", products=products, progress=stop)
    left = contents(tmp_path / "part/work/out")
    assert not [name for name in left if name.endswith(".mp4")], "half a video is removed"
    # Only the images before the stop are read again.
    crash_targets.flight(tmp_path / "part/work", products=products)
    assert read == [f"frame_{number:06d}.png" for number in range(len(left["frames.jsonl"].splitlines()))]
    assert contents(tmp_path / "part/work/out") == contents(tmp_path / "whole/work/out")


def test_an_encoder_that_is_killed_leaves_all_frames(scene, tmp_path, monkeypatch):
    products, write = ("counts", "display", "video"), video.VideoWriter.write

    def kills(self, image):
        write(self, image)
        self._encoder.kill()

    (tmp_path / "f").mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(video.VideoWriter, "write", kills)
        with pytest.raises(ThermorenderError, match=r"flight.mp4 cannot be written: the encoder ended with status -9"):
            flown(scene, tmp_path / "f", products=products)
    left = contents(tmp_path / "f/work/out")
    assert len(left["frames.jsonl"].splitlines()) == crash_targets.FRAMES
    assert not [name for name in left if name.endswith(".mp4")]
    assert crash_targets.flight(tmp_path / "f/work", products=products)["rendered"] == 0
    assert images_of(tmp_path / "f/work/out/flight.mp4") == crash_targets.FRAMES


# --- compression ------------------------------------------------------------------------------------------------


def test_every_compression_keeps_all_bits(scene):
    import OpenEXR

    from thermorender.frame.exr import exr_encoder

    frame = crash_targets.renderer(scene).frame(crash_targets.straight(1.0).pose(0.5))
    found, sizes = {}, {}
    for name in COMPRESSIONS:
        path = scene.parent / f"{name}.exr"
        path.write_bytes(exr_encoder(frame, True, compression=name)())
        found[name], record = read_exr(path)
        sizes[name] = path.stat().st_size
        assert record["budget_frame"] == 0
        with OpenEXR.File(str(path)) as file:
            assert file.header()["compression"].name == f"{COMPRESSIONS[name]}_COMPRESSION"
    (scene.parent / "usual.exr").write_bytes(exr_encoder(frame, True)())
    with OpenEXR.File(str(scene.parent / "usual.exr")) as file:
        assert file.header()["compression"].name == "RLE_COMPRESSION"
    assert len(sizes) == 4 and sizes["none"] > sizes["rle"] > sizes["zip"]
    for channels in found.values():
        for name, values in found["none"].items():
            np.testing.assert_array_equal(channels[name], values)


def test_the_compression_of_a_flight_is_recorded(scene, tmp_path):
    options = FlightOptions(rate_hz=1.0, products=("exr",), exr_compression="htj2k32")
    renderer, path = crash_targets.renderer(scene), crash_targets.straight(1.0)
    fly(renderer, path, tmp_path / "small", options)
    assert json.loads((tmp_path / "small/flight.json").read_text())["exr_compression"] == "htj2k32"
    fly(renderer, path, tmp_path / "usual", replace(options, exr_compression="zip"))
    small, usual = (read_exr(tmp_path / f"{name}/frame_000001.exr") for name in ("small", "usual"))
    np.testing.assert_array_equal(small[0]["radiance"], usual[0]["radiance"])
    assert small[1] == usual[1]
    with pytest.raises(ThermorenderError, match="was flown with exr_compression='htj2k32', now exr_compression='zip'"):
        fly(renderer, path, tmp_path / "small", replace(options, exr_compression="zip"), resume=True)
    with pytest.raises(
        ThermorenderError, match="exr_compression='piz' is unknown; give one of zip, htj2k32, rle, none"
    ):
        FlightOptions(exr_compression="piz")


def test_checksums_are_those_of_sha256sum(scene, tmp_path):
    (tmp_path / "f").mkdir()
    flown(scene, tmp_path / "f", products=("counts",))
    out = tmp_path / "f/work/out"
    line = json.loads((out / "frames.jsonl").read_text().splitlines()[2])
    data = (out / "frame_000002_counts.png").read_bytes()
    assert line["files"] == {"frame_000002_counts.png": [len(data), hashlib.sha256(data).hexdigest()]}


# --- profile ------------------------------------------------------------------------------------------------------


def test_phases_count_without_those_within_them(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    with timing.profiled() as profile:
        for _ in range(2):
            with timing.phase("outer"):
                now[0] += 2.0
                with timing.phase("inner"):
                    now[0] += 5.0
                now[0] += 1.0
        now[0] += 1.0
    found = profile.as_dict()
    assert found["wall_s"] == 17.0 and found["phases"]["inner"] == {"seconds": 10.0, "times": 2}
    assert found["phases"]["outer"] == {"seconds": 6.0, "times": 2}
    assert any(line.split() == ["outer", "6.000", "2", "3000.0"] for line in profile.lines())
    assert timing.profile_entry() == {}
    with timing.phase("none is taken"):
        pass
    assert "none is taken" not in profile.as_dict()["phases"]


def test_profiles_are_printed_and_recorded(scene, tmp_path, call):
    log = tmp_path / "log.csv"
    log.write_text("time_s,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg\n0,-3,0,20,0,-90,0\n1,3,0,20,0,-90,0\n")
    arguments = ("--profile", "--rays", 4, "--quality", "fast", "--products", "counts,display")
    for verb, more, record in (
        ("fly", ("--trajectory", log, "--rate-hz", 2), "flight.json"), ("render", (), "frame_000000.json"),
    ):  # fmt: skip
        status, _, errors = call(verb, scene, "-o", tmp_path / verb, *arguments, *more)
        assert status == 0
        found = json.loads((tmp_path / verb / record).read_text())["profile"]
        assert {"start of the program", "imports", "scene", "renderer", "light solved"} <= set(found["phases"])
        own = {name: each for name, each in found["phases"].items() if not name.startswith(("writer", "start"))}
        assert 0.0 < sum(each["seconds"] for each in own.values()) <= found["wall_s"]
        # A row of the table for each phase.
        assert all(any(line.startswith(f"{name} ") for line in errors.splitlines()) for name in own)
    phases = json.loads((tmp_path / "fly/flight.json").read_text())["profile"]["phases"]
    assert phases["first frame: radiance and sensor"]["times"] == 1 and phases["frames: display"]["times"] == 2
    assert {"writer: .png encoded", "writer: checksums", "waiting for the writer"} <= set(phases)
    assert call("render", scene, "-o", tmp_path / "quiet", "--rays", 4, "--quality", "fast")[0] == 0
    assert "profile" not in json.loads((tmp_path / "quiet/frame_000000.json").read_text())
