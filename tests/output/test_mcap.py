"""A flight's MCAP file, read by two other libraries."""

import json

import numpy as np
import pytest
from support import interrupted

import thermorender as tr
from scenes import coarse, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.frame.exr import read_exr
from thermorender.output.flight import FlightOptions, fly
from thermorender.output.mcap import CAMERA, IMAGE, INFO, POSE, WORLD
from thermorender.trajectory.rotations import rotation_from_wxyz

OPTIONS = FlightOptions(rate_hz=2.0, products=("exr", "mcap"))


@pytest.fixture(scope="module")
def renderer(tmp_path_factory):
    scene = tr.load_scene(write_terrain(tmp_path_factory.mktemp("scene") / "tiny"))
    return tr.Renderer(coarse(scene, 16), rays=4, samples=1)


def path_from(first_s):
    turn = np.array([[0.1, 0.9, 0.2, 0.1], [0.0, 1.0, 0.1, 0.0]])
    return tr.Trajectory(
        time_s=np.array([first_s, first_s + 1.0]),
        position=np.array([[-1.0, 0.5, 12.0], [1.0, 0.0, 13.0]]),
        quaternion=turn / np.linalg.norm(turn, axis=1, keepdims=True),
    )


@pytest.fixture(scope="module")
def flown(renderer, tmp_path_factory):
    folder = tmp_path_factory.mktemp("flown") / "f"
    fly(renderer, path_from(2.25), folder, OPTIONS)
    return folder


def read_by_mcap(file):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with open(file, "rb") as opened:
        reader = make_reader(opened, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            yield channel.topic, message.log_time, decoded


def read_by_rosbags(file):
    from rosbags.highlevel import AnyReader

    with AnyReader([file]) as reader:
        for connection, log, data in reader.messages():
            yield connection.topic, log, reader.deserialize(data, connection.msgtype)


@pytest.mark.parametrize("read", [read_by_mcap, read_by_rosbags])
def test_images_calibration_and_poses_are_those_of_the_frames(renderer, flown, read):
    lines = [json.loads(line) for line in (flown / "frames.jsonl").read_text().splitlines()]
    found = {IMAGE: [], INFO: [], POSE: []}
    for topic, log, message in read(flown / "flight.mcap"):
        found[topic].append((log, message))
    assert [len(each) for each in found.values()] == [3, 3, 3]
    camera = renderer.scene.camera
    for number, line in enumerate(lines):
        log, image = found[IMAGE][number]
        stamp = image.header.stamp
        assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(2.25 + 0.5 * number, abs=1e-9)
        assert log == stamp.sec * 1_000_000_000 + stamp.nanosec
        assert (image.encoding, image.is_bigendian, image.header.frame_id) == ("mono16", 0, CAMERA)
        counts = np.frombuffer(bytes(image.data), "<u2").reshape(image.height, image.step // 2)
        kelvin = read_exr(flown / f"frame_{number:06d}.exr")[0]["apparent_temperature"]
        assert np.abs(0.01 * counts - kelvin).max() <= 0.00502
        info = found[INFO][number][1]
        assert (info.width, info.height, info.distortion_model) == (camera.width, camera.height, "plumb_bob")
        assert list(info.d) == list(camera.distortion)
        # A ray through a pixel, by ROS's matrix, is the camera's; its pixels begin at their corner.
        ray = np.linalg.solve(np.reshape(info.k, (3, 3)), [7.0, 3.0, 1.0])
        np.testing.assert_allclose(ray[:2], camera.directions(np.array([7.5, 3.5])), atol=1e-9)
        (transform,) = found[POSE][number][1].transforms
        assert (transform.header.frame_id, transform.child_frame_id) == (WORLD, CAMERA)
        q, place = transform.transform.rotation, transform.transform.translation
        pose = np.array(line["world_from_camera"])
        np.testing.assert_allclose([place.x, place.y, place.z], pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(rotation_from_wxyz([q.w, q.x, q.y, q.z]).as_matrix(), pose[:3, :3], atol=1e-8)


def test_resume_writes_the_same_file(renderer, flown, tmp_path):
    with interrupted(2) as stop:
        fly(renderer, path_from(2.25), tmp_path / "f", OPTIONS, progress=stop)
    assert not (tmp_path / "f/flight.mcap").exists()
    assert fly(renderer, path_from(2.25), tmp_path / "f", OPTIONS, resume=True)["rendered"] < 3
    assert (tmp_path / "f/flight.mcap").read_bytes() == (flown / "flight.mcap").read_bytes()


def test_times_of_a_scene_with_weather_are_utc(renderer, tmp_path):
    scene = renderer.scene.with_weather(time="2018-07-28T12:00:00Z", air_low_c=12.0, air_high_c=24.0, humidity=0.7,
                                        wind_m_s=2.5, cloud=0.1)  # fmt: skip
    fly(tr.Renderer(scene, rays=4, samples=1), path_from(-1.0), tmp_path / "f", OPTIONS)
    first = next(log for _, log, _ in read_by_mcap(tmp_path / "f/flight.mcap"))
    assert first == 1_532_779_200 * 1_000_000_000


def test_what_cannot_be_written_is_refused_before_the_flight(renderer, tmp_path, monkeypatch):
    with pytest.raises(ThermorenderError, match="product 'mcap' is made of the EXR files; add 'exr'"):
        fly(renderer, path_from(0.0), tmp_path / "g", FlightOptions(products=("counts", "mcap")))
    with pytest.raises(ThermorenderError, match=r"no times before 0; give start_s=0"):
        fly(renderer, path_from(-1.0), tmp_path / "g", OPTIONS)
    monkeypatch.setitem(__import__("sys").modules, "mcap_ros2.writer", None)
    with pytest.raises(ThermorenderError, match=r"run `pip install 'thermorender\[ros\]'`"):
        fly(renderer, path_from(0.0), tmp_path / "g", OPTIONS)
    assert not (tmp_path / "g").exists()
