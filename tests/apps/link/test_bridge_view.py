"""The live view as OpenCV sees it, and the thermal range as another process of pymavlink gets it."""

import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import psutil
import pytest
from link_support import connected, serving

import thermorender as tr
from scenes import coarse, write_terrain
from thermorender.apps.link.bridges import view as bridge
from thermorender.apps.link.bridges.mavlink import ThermalRange
from thermorender.apps.link.bridges.view import View
from thermorender.apps.link.stage import Stage
from thermorender.errors import ThermorenderError

DOWN = (0.0, 0.0, 12.0, 0.0, 1.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    scene = coarse(tr.load_scene(write_terrain(tmp_path_factory.mktemp("scene") / "tiny")), 8)
    with serving(Stage(tr.Renderer(scene, rays=4, samples=1))) as made:
        yield made


@pytest.fixture
def view(server):
    made = View(0)
    server.watchers.append(made.show)
    made.start()
    yield made
    server.watchers.remove(made.show)
    made.stop()


@pytest.mark.parametrize("name", ["live.mjpg", "live.mp4"])
def test_a_viewer_sees_the_frames_of_a_client(server, view, name):
    found = []

    def look():
        video = cv2.VideoCapture(view.address.replace("live.mjpg", name), cv2.CAP_FFMPEG)
        found.extend(video.read()[1] for _ in range(3))
        video.release()

    viewer, shown = threading.Thread(target=look), []
    with connected(server) as client:
        session = client.open()
        shown.append(session.frame(0.0, DOWN, products=("display",)).display)
        viewer.start()
        for k in range(1, 400):
            shown.append(session.frame(k / 30.0, DOWN, products=("display",)).display)
            viewer.join(0.03)
            if not viewer.is_alive():
                break
    viewer.join(20.0)
    assert len(found) == 3 and all(image is not None for image in found)
    for image in found:
        errors = [np.abs(image[..., 0].astype(int) - one).mean() for one in shown]
        assert min(errors) < 6.0 and image.shape[:2] == shown[0].shape


def test_nobody_looks_without_the_token(view):
    for wrong in (view.address.rsplit("/", 2)[0] + "/live.mjpg", view.address + "x"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(wrong, timeout=10.0)
    assert view.address.startswith("http://127.0.0.1:")
    assert len(view.address.split("/")[3]) >= 32


def test_half_requests_end_and_keep_no_viewer_out(view, monkeypatch):
    monkeypatch.setattr(bridge, "_TIMEOUT_S", 1.0)
    trickling = socket.create_connection(("127.0.0.1", view.port), timeout=20.0)
    with trickling, pytest.raises((ConnectionResetError, BrokenPipeError)):
        for _ in range(200):
            trickling.sendall(b"x")
            time.sleep(0.05)
    monkeypatch.setattr(bridge, "_TIMEOUT_S", 60.0)
    idle = [socket.create_connection(("127.0.0.1", view.port), timeout=5.0) for _ in range(40)]
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{view.address}x", timeout=10.0)
    # Those that wait longest made room.
    assert [each.recv(1) for each in idle[:24]] == [b""] * 24
    for each in idle:
        each.close()


@pytest.mark.parametrize(("name", "kind", "first"), [
    ("live.mjpg", "multipart/x-mixed-replace", b"--frame"), ("live.mp4", "video/mp4", b"\0\0\0\x1cftypiso5"),
])  # fmt: skip
def test_a_viewer_that_leaves_is_forgotten(server, view, name, kind, first):
    with connected(server) as client:
        session = client.open()
        session.frame(0.0, DOWN)
        with urllib.request.urlopen(view.address.replace("live.mjpg", name), timeout=10.0) as stream:
            assert stream.headers["Content-Type"].startswith(kind)
            assert stream.read(len(first)) == first
            assert view._viewers == 1
        for k in range(1, 200):
            session.frame(k / 30.0, DOWN)
            if not view._viewers:
                break
    assert view._viewers == 0
    assert not [each for each in psutil.Process().children() if "ffmpeg" in each.name()]


RECEIVER = """
import os, sys
os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil
link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{sys.argv[1]}", dialect="common")
print("ready", flush=True)
beat = link.recv_match(type="HEARTBEAT", blocking=True, timeout=60)
got = link.recv_match(type="CAMERA_THERMAL_RANGE", blocking=True, timeout=60)
print(beat.type, beat.get_srcComponent(), got.time_boot_ms, got.stream_id, got.max, got.max_point_x, got.max_point_y,
      got.min, got.min_point_x, got.min_point_y)
"""


def test_another_process_receives_the_thermal_range(server, free_port):
    pytest.importorskip("pymavlink")
    receiver = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", RECEIVER, str(free_port)], stdout=subprocess.PIPE, text=True
    )
    bridge = ThermalRange(f"udpout:127.0.0.1:{free_port}")
    try:
        assert receiver.stdout.readline() == "ready\n"
        server.watchers.append(bridge.show)
        with connected(server) as client:
            kelvin = client.open().frame(1.5, DOWN, products=("temperature",)).temperature
        text = receiver.communicate(timeout=60)[0]
    finally:
        server.watchers.clear()
        receiver.kill()
        bridge.stop()
    kind, component, stamp, stream, *values = (float(word) for word in text.split())
    assert (kind, component, stamp, stream) == (30, 100, 1500, 1)
    for value, across, down, wanted in ((*values[:3], kelvin.max()), (*values[3:], kelvin.min())):
        assert value == pytest.approx(wanted - 273.15, abs=2e-3)
        row, column = int(down * kelvin.shape[0]), int(across * kelvin.shape[1])
        assert kelvin[row, column] == wanted


@pytest.mark.parametrize(
    "address", ["127.0.0.1:14550", "udpout:127.0.0.1:0", "serial:/dev/ttyS0:57600", "udpout:127.0.0.1"]
)
def test_other_addresses_are_refused(address):
    with pytest.raises(ThermorenderError, match=r"give udpout:HOST:PORT"):
        ThermalRange(address)


def test_a_bridge_that_fails_leaves_the_server_as_it_is(server, capfd):
    def fail(number, session):
        raise ZeroDivisionError("a fault of a bridge")

    server.watchers.append(fail)
    try:
        with connected(server) as client:
            session = client.open()
            assert session.frame(0.0, DOWN).index == 0 and session.frame(0.1, DOWN).index > 0
    finally:
        server.watchers.clear()
    assert "a fault of a bridge" in capfd.readouterr().err


@pytest.fixture
def free_port():
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        return own.getsockname()[1]
