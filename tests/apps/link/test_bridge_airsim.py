"""AirSim's calls: a public client gets the link's frames; strangers get sentences or a closed connection."""

import contextlib
import json
import re
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import cv2
import msgpack
import numpy as np
import pytest
from link_support import TOKEN, connected, serving

import thermorender as tr
from scenes import coarse, scene_object, write_terrain
from thermorender.apps.link import connect
from thermorender.apps.link.bridges import airsim
from thermorender.apps.link.stage import Stage
from thermorender.trajectory.rotations import rotation_from_angles, wxyz

MARKER = scene_object("marker", [2.0, 1.0, 0.5], [3.0, 3.0, 0.25])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return coarse(tr.load_scene(write_terrain(tmp_path_factory.mktemp("scene") / "tiny", extra=MARKER)), 16)


@pytest.fixture(scope="module")
def server(scene):
    with serving(Stage(tr.Renderer(scene, rays=4, samples=1))) as made:
        yield made


@pytest.fixture
def bridge(server):
    made = airsim.Bridge(0, server.port, TOKEN)
    made.start()
    yield made
    made.stop()


def call(bridge, data, least=1):
    """Messages that come back for some bytes; None where the connection ends."""
    with socket.create_connection(("127.0.0.1", bridge.port), 20.0) as own:
        own.sendall(data)
        unpacker, found = msgpack.Unpacker(), []
        while len(found) < least:
            got = own.recv(1 << 16)
            if not got:
                return None
            unpacker.feed(got)
            found += list(unpacker)
        return found


def test_a_public_client_gets_the_frames_of_the_link(scene, server, bridge, tmp_path):
    pytest.importorskip("cosysairsim")
    script, file = Path(__file__).with_name("airsim_client.py"), tmp_path / "images.npz"
    run = subprocess.run(
        [sys.executable, "-W", "ignore", script, str(bridge.port), file], capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 0, run.stderr
    assert "Cosys-AirSim server is of older" not in run.stderr
    found, images = json.loads(run.stdout.splitlines()[-1]), np.load(file)
    # x north, y east, z down is 3 m east, 1 m north, 12 m up; the camera looks along the vehicle's x axis: down.
    with connected(server) as client:
        session = client.open(attitude="angles", rate_hz=10.0)
        rows = [[-0.0999, 3.0, 1.0, 12.0, 0.0, -90.0, 0.0], [0.0, 3.0, 1.0, 12.0, 0.0, -90.0, 0.0]]
        products = ("temperature", "display", "visible", "depth", "segmentation", "targets")
        wanted = session.frame(0.0, path=rows, products=products)
    np.testing.assert_allclose(images["0"], wanted.temperature, atol=2e-3)
    for number in ("1", "2"):
        image = images[number] if number == "1" else cv2.imdecode(images[number], cv2.IMREAD_COLOR)
        assert (image == image[..., :1]).all()
        np.testing.assert_allclose(image[..., 0].astype(int), wanted.display, atol=1)
    np.testing.assert_array_equal(images["3"][..., ::-1], wanted.visible)
    np.testing.assert_allclose(images["4"], wanted.depth, rtol=1e-5)
    assert np.nanmedian(images["4"]) == pytest.approx(12.0, abs=0.01)
    # The marker, 2 m north of the vehicle, is straight above the middle of the image.
    rows, columns = np.nonzero(images["5"][..., 2] == 1)
    assert columns.mean() == pytest.approx((images["0"].shape[1] - 1) / 2, abs=0.6)
    assert rows.mean() < images["0"].shape[0] / 2 - 3
    assert images["0"][rows, columns].max() > 320.0
    assert found["fov"] == pytest.approx(scene.camera.field_of_view_deg[0], abs=1e-4)
    assert found["matrix"][0][0] == pytest.approx(1.0 / np.tan(np.radians(found["fov"] / 2)), abs=1e-4)
    assert [found["pose"][0][f"{axis}_val"] for axis in "xyz"] == [1.0, 3.0, -12.0]
    turned = wxyz(rotation_from_angles(0.0, -90.0, 0.0))
    assert [found["pose"][1][f"{axis}_val"] for axis in "wxyz"] == pytest.approx(turned, abs=1e-6)
    words = ("image type 6 is not served", "camera 'left' is not served", "unit quaternion", "simGetCollisionInfo")
    assert all(word in error for word, error in zip(words, found["errors"], strict=True))


def test_frames_hold_no_earlier_pose(bridge):
    """Pixels that remembered the pose before would differ from those of a camera that was always there."""
    request = {"camera_name": "0", "image_type": 7, "pixels_as_float": False, "compress": False}
    with contextlib.closing(airsim.Calls(bridge)) as calls:
        for east, pitch_deg in ((0.0, 90.0), (2.0, -90.0)):
            bridge.set_pose(calls, "turned", pose_at(east, pitch_deg))
            error, (found,) = calls.answer("simGetImages", [[request], "turned"])
            assert error is None
        bridge.set_pose(calls, "fresh", pose_at(2.0, -90.0))
        _, (fresh,) = calls.answer("simGetImages", [[request], "fresh"])
    images = [np.frombuffer(each["image_data_uint8"], np.uint8).astype(int) for each in (found, fresh)]
    assert np.abs(images[0] - images[1]).mean() < 4.0
    assert found["time_stamp"] == 100_000_000


def nested(depth):
    """A list in a list in a list."""
    value = []
    for _ in range(depth):
        value = [value]
    return value


NESTED = nested(1010)


def pose_at(east, pitch_deg):
    w, x, y, z = wxyz(rotation_from_angles(0.0, pitch_deg, 0.0))
    return {
        "position": {"x_val": 2.0, "y_val": east, "z_val": -12.0},
        "orientation": {"w_val": w, "x_val": x, "y_val": y, "z_val": z},
    }


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n\r\n", b"\xc1" * 9, msgpack.packb([2, "ping", []]), b"\xdf" + b"\xff" * 99,
        msgpack.packb([0, 5, "ping", [0] * 65]),
        b"\x94\x00" + b"\x91" * 600 + b"\x01" + msgpack.packb("ping") + b"\x90",  # its number cannot be sent back
    ],
)  # fmt: skip
def test_other_bytes_end_the_connection(bridge, data):
    with socket.create_connection(("127.0.0.1", bridge.port), 20.0) as own:
        own.sendall(data)
        own.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            assert own.recv(10) == b""
    assert call(bridge, msgpack.packb([0, 5, "ping", []])) == [[1, 5, None, True]]


@pytest.mark.parametrize(
    "method, arguments",
    [
        ("ping", [1]),
        ("simSetVehiclePose", [{}, True]),
        ("simGetImages", [[{}]]),
        ("simGetImages", [5]),
        ("x" * 999, []),
        (["ping"], []),
        ({"ping": 1}, []),
        (NESTED, []),
        ("simGetImages", [[{"camera_name": NESTED}]]),
        ("simGetImages", [[], NESTED]),
        ("simSetVehiclePose", [{"position": {"x_val": "1" * 10_000}}]),
        ("simSetVehiclePose", [pose_at(0.0, 0.0), True, "x" * 10_000]),
    ],
)
def test_wrong_arguments_are_answered_in_a_sentence(bridge, method, arguments):
    ((kind, number, error, result),) = call(bridge, msgpack.packb([0, 9, method, arguments]))
    assert (kind, number, result) == (1, 9, None)
    assert 20 < len(error) < 400


def request_of_images(vehicle):
    """The bytes of a call that opens a session of the link for a vehicle."""
    image = {"camera_name": "0", "image_type": airsim.INFRARED, "pixels_as_float": True, "compress": False}
    return msgpack.packb([0, 1, "simGetImages", [[image], vehicle]])


def test_calls_without_a_token_leave_half_of_the_sessions_to_those_who_hold_one(server, bridge, monkeypatch):
    monkeypatch.setattr(airsim, "_IDLE_S", 600.0)
    with socket.create_connection(("127.0.0.1", bridge.port), 60.0) as own:
        unpacker, errors = msgpack.Unpacker(), []
        for number in range(40):
            own.sendall(request_of_images(f"drone {number}"))
            while (answer := next(unpacker, None)) is None:
                unpacker.feed(own.recv(1 << 20))
            errors += [answer[2]] if answer[2] else []
        assert len(errors) == 8 and errors[0].startswith("32 cameras of vehicles are in use")
        with connected(server) as client:
            for _ in range(32):
                client.open()
    # The sessions of a connection that ended are free again.
    for _ in range(50):
        ((*_, error, _),) = call(bridge, request_of_images("another"))
        if error is None:
            break
        time.sleep(0.1)
    assert error is None


def infrared(calls, vehicle):
    """The answer (error, response) to a request of one image by the calls of a connection."""
    image = {"camera_name": "0", "image_type": airsim.INFRARED, "pixels_as_float": True, "compress": False}
    error, found = calls.answer("simGetImages", [[image], vehicle])
    return error, found and found[0]


def test_idle_sessions_make_room_for_those_of_other_connections(bridge, monkeypatch):
    with contextlib.closing(airsim.Calls(bridge)) as one, contextlib.closing(airsim.Calls(bridge)) as other:
        monkeypatch.setattr(airsim, "_MOST_SESSIONS", 3)
        monkeypatch.setattr(airsim, "_IDLE_S", 600.0)
        assert all(infrared(one, f"drone {number}")[0] is None for number in range(3))
        error, _ = infrared(other, "another")
        assert error.endswith("try again when one of them has had no call for 600 s")
        # The advice is followed.
        monkeypatch.setattr(airsim, "_IDLE_S", 0.0)
        assert infrared(other, "another")[0] is None
        # That of drone 0, called first, was given up; its frames go on later in time, with the room of another.
        error, found = infrared(one, "drone 0")
        assert error is None and found["time_stamp"] == 100_000_000
        assert infrared(one, "drone 2")[1]["time_stamp"] == 100_000_000
        assert infrared(other, "another")[1]["time_stamp"] == 100_000_000


def test_a_session_in_a_call_is_not_given_up(bridge, monkeypatch):
    monkeypatch.setattr(airsim, "_MOST_SESSIONS", 1)
    monkeypatch.setattr(airsim, "_IDLE_S", 0.0)
    with contextlib.closing(airsim.Calls(bridge)) as one, contextlib.closing(airsim.Calls(bridge)) as other:
        assert infrared(one, "drone")[0] is None
        with one._session("drone", "0"):
            assert infrared(other, "another")[0].startswith("1 cameras of vehicles are in use")
        assert infrared(other, "another")[0] is None


def test_poses_of_connections_that_ended_make_room_oldest_first(bridge):
    here = [pose_at(2.0, -90.0), True]
    with contextlib.closing(airsim.Calls(bridge)) as staying:
        assert staying.answer("simSetVehiclePose", [*here, "staying"])[0] is None
        for client in range(3):
            with contextlib.closing(airsim.Calls(bridge)) as leaving:
                for number in range(64):
                    assert leaving.answer("simSetVehiclePose", [*here, f"{client} {number}"]) == (None, None)
                error, _ = leaving.answer("simSetVehiclePose", [*here, "more"])
                assert error.endswith("the poses of 64 vehicles; use the name of one of them")
                assert leaving.answer("simSetVehiclePose", [*here, f"{client} 0"])[0] is None
        for number in range(32):
            assert staying.answer("simSetVehiclePose", [*here, f"new {number}"])[0] is None
        moved = {name: bridge.pose(name)[0] == 2.0 for name in ("staying", "new 0", "0 1", "1 63", "2 1", "2 63")}
        assert moved == {"staying": True, "new 0": True, "0 1": False, "1 63": False, "2 1": True, "2 63": True}
        assert len(bridge._poses) == 33 + 64


def test_idle_connections_make_room_for_new_ones(bridge, monkeypatch):
    monkeypatch.setattr(airsim, "_IDLE_S", 0.2)
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(socket.create_connection(("127.0.0.1", bridge.port), 20.0)) for _ in range(16)]
        time.sleep(0.4)
        assert call(bridge, msgpack.packb([0, 5, "ping", []])) == [[1, 5, None, True]]
        assert idle[0].recv(1) == b""


def test_it_listens_on_this_machine_only(bridge):
    # All of 127.0.0.0/8 is this machine, but the bridge has one of its addresses only.
    with pytest.raises(OSError, match=r"refused|timed out|assign"):
        socket.create_connection(("127.0.0.2", bridge.port), 5.0)


def serve_command(tmp_path, *options):
    """The command that serves a small terrain."""
    folder = write_terrain(tmp_path / "tiny")
    command = [sys.executable, "-m", "thermorender", "serve", folder, "--port", "0", "--quality", "fast"]
    return [*command, "--token-file", tmp_path / "token", *options]


def test_serve_starts_the_bridges_that_are_asked_for(tmp_path):
    command = serve_command(tmp_path, "--airsim", "0", "--view", "0", "--mavlink", "udpout:127.0.0.1:9")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        calls, view, line = (process.stdout.readline() for _ in range(3))
        assert line.startswith("serving ")
        port = int(re.search(r"127\.0\.0\.1 port (\d+), without a token", calls)[1])
        with socket.create_connection(("127.0.0.1", port), 20.0) as own:
            own.sendall(msgpack.packb([0, 1, "getServerVersion", []]))
            assert msgpack.unpackb(own.recv(100)) == [1, 1, None, 4]
        address = re.fullmatch(r"look at (http://127\.0\.0\.1:\d+/[\w-]{32}/live\.mjpg)\n", view)[1]
        with connect(port=int(re.search(r"port (\d+)", line)[1]), token_path=tmp_path / "token") as client:
            client.open().frame(0.0, (0.0, 0.0, 12.0, 0.0, 1.0, 0.0, 0.0))
            with urllib.request.urlopen(address, timeout=20.0) as stream:
                assert stream.read(7) == b"--frame"
    finally:
        process.terminate()
        rest, errors = process.communicate(timeout=60)
    assert rest == "stopped after 1 frames\n" and "Traceback" not in errors
    assert not (tmp_path / "token").exists()


def test_serve_with_a_bridge_that_cannot_start_is_one_sentence(tmp_path):
    command = serve_command(tmp_path, "--mavlink", "tcp:127.0.0.1:9")
    run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert run.returncode == 2 and "give udpout:HOST:PORT" in run.stderr and "Traceback" not in run.stderr
    assert not (tmp_path / "token").exists()
