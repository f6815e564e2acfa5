"""The link under damaged messages, clients that are killed, and a long session: alive, right, and with flat memory."""

import os
import re
import resource
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from link_support import TOKEN, Stills, connected, read, serving, settled
from support import hear_signals, slow

import thermorender as tr
from scenes import coarse, write_terrain
from thermorender import link
from thermorender.apps.link import Code
from thermorender.apps.link.access import read_token, token_file
from thermorender.apps.link.messages import Open, Request
from thermorender.apps.link.stage import Stage
from thermorender.apps.link.wire import HEADER, Type, message

DOWN = (0.0, 0.0, 12.0, 0.0, 1.0, 0.0, 0.0)
HEADS = [struct.pack("<I", value) for value in (0, 1, 2**31 - 1, 2**32 - 1)] + [
    struct.pack("<d", value) for value in (np.nan, np.inf, -1e300, 1e-320, 13.5)
]


def corpus(rng, time_s):
    """One valid message, as bytes."""
    poses = np.array([[time_s + k / 100.0, *DOWN] for k in range(rng.integers(0, 4))]).reshape(-1, 8)
    objects = [("plate", time_s, {"yaw_deg": 1.0})] if rng.random() < 0.3 else []
    picture = np.zeros((5, 4, 3), np.uint8) if rng.random() < 0.1 else None
    request = Request(time_s, int(rng.integers(1, 512)), rng.random() < 0.3, poses, objects, picture)
    kinds = [
        (Type.REQUEST, request.packed()), (Type.REQUEST, request.packed()), (Type.REQUEST, request.packed()),
        (Type.OPEN, [Open(method=rng.choice(["A", "B"]), audit=int(rng.integers(3))).packed()]), (Type.CLOSE, []),
        (Type.HELLO, [TOKEN.encode()]),
    ]  # fmt: skip
    kind, parts = kinds[rng.integers(len(kinds))]
    return b"".join(message(kind, int(rng.choice([1, 1, 1, 2, 3])), int(rng.integers(2**63)), parts))


def mutated(rng, data):
    """A message with one kind of damage, or none."""
    data, place = bytearray(data), int(rng.integers(len(data)))
    match int(rng.integers(14)):
        case 0:
            for _ in range(rng.integers(1, 9)):
                data[rng.integers(len(data))] = rng.integers(256)
        case 1:
            del data[place:]
        case 2:
            data[place:place] = rng.bytes(int(rng.integers(1, 40)))
        case 3:
            head = HEADS[rng.integers(len(HEADS))]
            data[place : place + len(head)] = head
        case 4:
            del data[place : place + int(rng.integers(1, 20))]
        case 5:  # an honest length around damaged contents
            if len(data) > HEADER.size:
                data[rng.integers(HEADER.size, len(data))] ^= 1 << int(rng.integers(8))
        case 6:
            body = rng.bytes(int(rng.integers(0, 300)))
            kind = rng.choice([Type.OPEN, Type.REQUEST])
            data = bytearray(b"".join(message(Type(kind), 1, 1, [body])))
    return bytes(data)


def hammer(server, count, seed):
    """Send damaged messages; return {error code: number} and the number of frames."""
    rng, sent, codes, frames = np.random.default_rng(seed), 0, {}, 0
    opening = b"".join([*message(Type.HELLO, 0, 1, [TOKEN.encode()]), *message(Type.OPEN, 1, 2, [Open().packed()])])
    while sent < count:
        burst = int(rng.integers(1, 9))
        data = b"".join(mutated(rng, corpus(rng, sent + k + 100.0)) for k in range(burst))
        sent += burst
        own = socket.create_connection(("127.0.0.1", server.port), 20.0)
        try:
            own.sendall((opening if rng.random() < 0.95 else b"") + data)
            if rng.random() < 0.8:
                own.shutdown(socket.SHUT_WR)
                while (got := read(own)) is not None:
                    kind, _, _, payload = got
                    frames += kind == Type.REPLY
                    if kind == Type.ERROR:
                        text = payload[4:].decode()
                        assert text and text.isprintable() and len(text) < 1000
                        code = Code(struct.unpack_from("<I", payload)[0])
                        codes[code] = codes.get(code, 0) + 1
        except ConnectionError:
            pass
        finally:
            own.close()
    return codes, frames


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    scene = coarse(tr.load_scene(write_terrain(tmp_path_factory.mktemp("scene") / "tiny")), 64)
    return Stage(tr.Renderer(scene, rays=4, samples=1), maps=("fok-1to1",))


@pytest.mark.parametrize("count", [300, *slow(3000)])
def test_damaged_messages_to_a_renderer(stage, count, capfd):
    with connected_to(stage) as (server, frame):
        wanted = frame().counts
        codes, frames = hammer(server, count, seed=count)
        assert frame().counts.tobytes() == wanted.tobytes()
        settled(server)
    assert Code.INTERNAL not in codes and codes[Code.MALFORMED] and codes[Code.REFUSED] and frames
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_a_hundred_thousand_damaged_messages(capfd):
    with connected_to(Stills()) as (server, frame):
        hammer(server, 2000, seed=1)
        before = resident_mib()
        codes, _ = hammer(server, 100_000, seed=2)
        assert resident_mib() - before < 30.0
        assert frame().index == 0
        settled(server)
    assert Code.INTERNAL not in codes
    assert capfd.readouterr().err == ""


class connected_to:
    """A server, and a function that opens a session and returns its first frame."""

    def __init__(self, stage):
        self.serving = serving(stage, sessions=1000, message_s=2.0, hello_s=2.0)

    def __enter__(self):
        self.server = self.serving.__enter__()
        return self.server, self.frame

    def frame(self):
        with connected(self.server) as client:
            return client.open(seed=5).frame(0.0, DOWN)

    def __exit__(self, *error):
        return self.serving.__exit__(*error)


def resident_mib():
    """Memory of this process now [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


CLIENT = """
import sys
from thermorender import link
client = link.connect(port=int(sys.argv[1]), token=sys.argv[2])
sessions = [client.open(seed=k) for k in range(3)]
pose, n = (0, 0, 12.0, 0, 1, 0, 0), 0
print("ready", flush=True)
while True:
    for session in sessions:
        session.send(float(n), pose, products=("counts", "depth"), latest=n % 3 == 0)
    n += 1
    if n % 2 == 0:
        client.receive()
"""


@pytest.mark.parametrize("kills", [3, *slow(200)])
def test_killed_clients_leave_nothing_behind(kills, capfd):
    rng = np.random.default_rng(kills)
    with connected_to(Stills()) as (server, frame):
        for _ in range(kills):
            process = subprocess.Popen(
                [sys.executable, "-c", CLIENT, str(server.port), TOKEN], stdout=subprocess.PIPE, text=True
            )
            if rng.random() < 0.9:
                process.stdout.readline()
            time.sleep(rng.exponential(0.03))
            process.send_signal(signal.SIGKILL)
            process.wait()
            process.stdout.close()
        assert frame().index == 0
        settled(server)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("count", [2000, *slow(100_000)])
def test_no_frame_of_a_long_session_is_lost_or_doubled(count):
    with connected_to(Stills()) as (server, _), connected(server) as client:
        session, ahead, before = client.open(), 6, 0.0
        expected = [session.send(float(k) + 20.0, DOWN) for k in range(ahead)]
        for k in range(count):
            if k == 1500:
                before = resident_mib()
            reply = client.receive()
            assert (reply.id, reply.index, reply.time_s) == (expected[k % ahead], k, k + 20.0)
            if k + ahead < count:
                expected[k % ahead] = session.send(float(k + ahead) + 20.0, DOWN)
        assert resident_mib() - before < 10.0


@pytest.mark.slow
def test_no_frame_of_a_renderer_is_lost_or_doubled(stage):
    with connected_to(stage) as (server, _), connected(server) as client:
        session, before = client.open(rate_hz=30.0), 0.0
        for k in range(10_000):
            if k == 1000:
                before = resident_mib()
            reply = session.frame(k / 30.0, (0.0, 0.001 * k - 5.0, *DOWN[2:]), products=("temperature",))
            assert (reply.index, reply.time_s) == (k, k / 30.0) and np.isfinite(reply.temperature).all()
        assert resident_mib() - before < 20.0


def started(folder, *options):
    """(process, port, token file) of `thermorender serve` on a tiny scene."""
    scene = write_terrain(folder / "tiny")
    command = [sys.executable, "-m", "thermorender", "serve", str(scene), "--port", "0", "--rays", "4", *options]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=hear_signals
    )
    line = process.stdout.readline()
    port, token = re.search(r"port (\d+); the token is in (.+); stop with Ctrl-C", line).groups()
    return process, int(port), Path(token)


@pytest.mark.parametrize("number", [signal.SIGTERM, *slow(signal.SIGINT, signal.SIGHUP)])
def test_the_command_serves_and_stops_cleanly(tmp_path, number):
    process, port, token = started(tmp_path, "--camera", "boson-640", "--map", "fok-1to1")
    try:
        assert token == token_file("127.0.0.1", port) and token.is_relative_to(os.environ["THERMORENDER_CACHE"])
        assert token.stat().st_mode & 0o777 == 0o600 and len(read_token(token)) == 64
        with link.connect(port=port) as client:
            assert client.server["cameras"].keys() == {"zenmuse-xt2", "boson-640"}
            assert client.open("boson-640").opened.width == 640
            waiting = client.open(method="B", map="fok-1to1").send(0.0, DOWN)
            assert waiting
            process.send_signal(number)
            out, error = process.communicate(timeout=30)
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, error) == (0, "")
    assert re.fullmatch(r"stopped after [01] frames\n", out)
    assert not token.exists()
