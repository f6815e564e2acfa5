"""The server of the link: access, bounds, and clients that break the protocol, vanish or hurry."""

import contextlib
import re
import socket
import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from link_support import FAULT_S, TOKEN, Stills, connected, read, serving, settled

from thermorender import link
from thermorender.apps.link import Code, LinkError, Product, access, messages
from thermorender.apps.link.connections import DEFAULT_LIMITS
from thermorender.apps.link.messages import Open, Request
from thermorender.apps.link.server import Server
from thermorender.apps.link.wire import HEADER, IMAGES, Type, message
from thermorender.errors import ThermorenderError

POSE = (0.0, 0.0, 100.0, 0.0, 1.0, 0.0, 0.0)


def raw(server, token=TOKEN):
    """A socket; with a token, after its WELCOME."""
    own = socket.create_connection(("127.0.0.1", server.port), 10.0)
    if token is not None:
        own.sendall(b"".join(message(Type.HELLO, 0, 1, [token.encode()])))
        read(own)
    return own


def request(number, time_s, session=1, **options):
    poses = np.array([[time_s, *POSE]])
    return b"".join(message(Type.REQUEST, session, number, Request(time_s, poses=poses, **options).packed()))


def opened(server):
    own = raw(server)
    own.sendall(b"".join(message(Type.OPEN, 1, 2, [Open().packed()])))
    assert read(own)[0] == Type.OPENED
    return own


def alive(server, shape=(3, 4)):
    """A new client gets the right frames."""
    with connected(server) as client:
        session = client.open(seed=7)
        for index in range(3):
            reply = session.frame(float(index), POSE, products=("counts", "visible"))
            assert (reply.index, reply.seed, reply.counts.shape, reply.visible.shape) == (index, 7, shape, (*shape, 3))
            assert (reply.counts == index).all()


def test_access_needs_the_token(tmp_path):
    with serving() as server:
        for token in ("f" * 64, TOKEN[:-1] + "e"):
            with pytest.raises(LinkError, match="the token is wrong; give the one in the file that the server printed"):
                link.connect(port=server.port, token=token)
        with pytest.raises(ThermorenderError, match="token does not hold 64 hexadecimal digits"):
            link.connect(port=server.port, token="secret")
        # Nothing else is answered before.
        for first in (message(Type.OPEN, 1, 2, [Open().packed()]), message(Type.HELLO, 0, 1, [b"x"])):
            own = raw(server, None)
            own.sendall(b"".join(first))
            kind, _, _, payload = read(own)
            assert kind == Type.ERROR and struct.unpack_from("<I", payload) == (Code.ACCESS,)
            assert read(own) is None
            own.close()
        kept = tmp_path / "deep" / "token"
        token = access.new_token(kept)
        assert kept.stat().st_mode & 0o777 == 0o600 and access.read_token(kept) == token
        assert access.new_token(kept) != token
        alive(server)
        settled(server)


@pytest.mark.parametrize(
    ("bytes_", "code"),
    [
        (b"GET / HTTP/1.1\r\nHost: a\r\n\r\n", Code.MALFORMED),
        (HEADER.pack(b"TRLK", 2, Type.OPEN, 0, 1, 1), Code.MALFORMED),
        (HEADER.pack(b"TRLK", 1, 77, 0, 1, 1), Code.MALFORMED),
        (HEADER.pack(b"TRLK", 1, Type.REPLY, 0, 1, 1), Code.MALFORMED),
        (HEADER.pack(b"TRLK", 1, Type.REQUEST, 0xFFFFFFFF, 1, 1), Code.MALFORMED),
        (HEADER.pack(b"TRLK", 1, Type.OPEN, 201, 1, 1), Code.MALFORMED),
        (b"".join(message(Type.REQUEST, 1, 5, [b"\0" * 10])), Code.REFUSED),
        (b"".join(message(Type.REQUEST, 9, 5, Request(0.0).packed())), Code.REFUSED),
        (b"".join(message(Type.REQUEST, 1, 5, [struct.pack("<dIIIIIId", 0, 1, 0, 2**31, 0, 0, 0, 0)])), Code.REFUSED),
        (b"".join(message(Type.REQUEST, 1, 5, [struct.pack("<dIIIIIId", 0, 1, 0, 0, 0, 9, 0, 0)])), Code.REFUSED),
        (b"".join(message(Type.REQUEST, 1, 5, Request(0.0, products=0).packed())), Code.REFUSED),
        (b"".join(message(Type.REQUEST, 1, 5, Request(0.0, products=1 << 20).packed())), Code.REFUSED),
        (b"".join(message(Type.OPEN, 1, 5, [Open().packed()])), Code.REFUSED),
        (b"".join(message(Type.OPEN, 2, 5, [Open(camera="x").packed()])), Code.REFUSED),
        (b"".join(message(Type.OPEN, 2, 5, [b"\xff" + Open().packed()[1:]])), Code.REFUSED),
        (b"".join(message(Type.CLOSE, 2, 5)), Code.REFUSED),
        (b"".join(message(Type.HELLO, 0, 5, [TOKEN.encode()])), Code.REFUSED),
        (request(5, FAULT_S), Code.INTERNAL),
    ],
    ids=lambda value: value.name if isinstance(value, Code) else "",
)  # fmt: skip
def test_wrong_messages_get_an_error(bytes_, code, capfd):
    with serving() as server:
        own = opened(server)
        own.sendall(bytes_)
        kind, _, number, payload = read(own)
        text = payload[4:].decode()
        assert kind == Type.ERROR and struct.unpack_from("<I", payload) == (code,)
        assert text and "\n" not in text and "Traceback" not in text
        if code == Code.MALFORMED:
            assert read(own) is None
        else:
            # The session continues.
            assert number == 5
            own.sendall(request(6, 20.0))
            assert read(own)[:3] == (Type.REPLY, 1, 6)
        own.close()
        alive(server)
        settled(server)
    assert ("ZeroDivisionError" in capfd.readouterr().err) == (code == Code.INTERNAL)


def test_half_messages_and_silent_clients_are_closed():
    with serving(hello_s=0.2, message_s=0.2) as server:
        silent, short, half, idle = raw(server, None), opened(server), opened(server), opened(server)
        short.sendall(request(3, 1.0)[:11])
        half.sendall(request(3, 1.0)[:50])
        for own in (silent, short, half):
            assert read(own) is None
            own.close()
        # A session without requests may wait.
        idle.sendall(request(3, 1.0))
        assert read(idle)[0] == Type.REPLY
        idle.close()
        settled(server)


def test_a_message_has_its_time_from_its_first_byte_to_its_last():
    """A client that sends the head late has no more time for the rest."""
    with serving(message_s=1.0) as server:
        slow, data = opened(server), request(3, 1.0)
        start = time.monotonic()
        slow.sendall(data[:10])
        time.sleep(0.7)
        slow.sendall(data[10:40])
        assert read(slow) is None
        assert time.monotonic() - start < 1.5
        slow.close()


def test_a_client_that_does_not_read_is_closed():
    gate = threading.Event()
    with serving(Stills(gate, (200, 200)), reply_s=0.3, memory_bytes=8 << 20) as server:
        own = socket.socket()
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        own.connect(("127.0.0.1", server.port))
        own.sendall(b"".join(message(Type.HELLO, 0, 1, [TOKEN.encode()])))
        own.sendall(b"".join(message(Type.OPEN, 1, 2, [Open().packed()])))
        read(own), read(own)
        gate.set()
        own.settimeout(0.2)
        sent, products = 0, sum(map(int, IMAGES))
        with contextlib.suppress(OSError):
            while sent < 10**5:
                own.sendall(request(sent, float(sent) + 20.0, products=products))
                sent += 1
        assert sent < 10**5
        end = time.monotonic() + 10.0
        while server.in_hand != (0, 0, 0) and time.monotonic() < end:
            with contextlib.suppress(OSError):
                own.sendall(request(sent, float(sent) + 20.0, products=products))
            time.sleep(0.02)
        settled(server)
        own.close()
        alive(server, (200, 200))


def test_errors_to_a_client_that_does_not_read_are_bounded():
    with serving(reply_s=30.0, sent_bytes=1 << 14) as server:
        own = opened(server)
        data, sent = b"".join(message(Type.CLOSE, 9, 5)) * 500, 0
        own.settimeout(1.0)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 14)
        with contextlib.suppress(OSError):
            while sent < 5000:
                own.sendall(data)
                sent += 1
        # The server stops reading, so no more is sent than the sockets' buffers hold, some megabytes each.
        assert sent < 5000
        own.close()
        settled(server)
        alive(server)


def test_waiting_requests_are_bounded():
    gate = threading.Event()
    with serving(Stills(gate), waiting=3) as server:
        own = opened(server)
        for number in range(50):
            own.sendall(request(number, float(number) + 20.0))
        time.sleep(0.3)
        connections, sessions, held = server.in_hand
        assert (connections, sessions) == (1, 1) and 0 < held <= 3 * (500 + len(request(0, 0.0)))
        gate.set()
        assert [read(own)[2] for _ in range(50)] == list(range(50))
        own.close()
        settled(server)


def test_requests_sent_behind_open_count_with_their_replies():
    gate = threading.Event()
    with serving(Stills(gate, size=(200, 200)), memory_bytes=3 << 20) as server:
        own, products = raw(server), sum(IMAGES)
        requests = [request(number, float(number), products=products) for number in range(7)]
        own.sendall(b"".join([*message(Type.OPEN, 1, 2, [Open().packed()]), *requests]))
        assert read(own)[0] == Type.OPENED
        time.sleep(0.3)
        # Each reply has 0.76 MB.
        assert 2 << 20 < server.in_hand[2] <= 3 << 20
        gate.set()
        assert [read(own)[2] for _ in range(7)] == list(range(7))
        # After an OPEN that fails, its requests are refused.
        own.sendall(b"".join([*message(Type.OPEN, 2, 8, [Open("x").packed()]), request(9, 0.0, session=2)]))
        errors = [read(own) for _ in range(2)]
        assert [each[0] for each in errors] == [Type.ERROR] * 2 and b"session 2 is not open" in errors[1][3]
        own.close()
        settled(server)


def test_a_token_file_belongs_to_one_server(tmp_path, monkeypatch):
    kept, link_ = tmp_path / "token", tmp_path / "link"
    first, other = access.new_token(kept), tmp_path / "other"
    # The file of a server that took the name later stays; a link is replaced, not followed.
    second = access.new_token(kept)
    access.drop_token(kept, first)
    assert access.read_token(kept) == second
    link_.symlink_to(other)
    access.new_token(link_)
    assert not other.exists() and not link_.is_symlink()
    access.drop_token(kept, second)
    access.drop_token(kept, second)
    assert not kept.exists()
    (kept / "folder").mkdir(parents=True)
    with pytest.raises(
        ThermorenderError, match=r"token file .*token cannot be written \(.*\); give a file in a folder of yours"
    ):
        access.new_token(kept)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["link", "token"]
    # Machines with a common cache folder have files of their own.
    monkeypatch.setattr("platform.node", lambda: "a/b")
    assert (one := access.token_file("127.0.0.1", 1)).name == "a_b-127.0.0.1-1.token"
    monkeypatch.setattr("platform.node", lambda: "c")
    two = access.token_file("127.0.0.1", 1)
    assert two != one and two.parent == one.parent


def test_servers_of_one_port_have_token_files_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))

    @contextlib.contextmanager
    def listening(host, port, width):
        server = Server(Stills(size=(width, 3)), host, port)
        server.token = access.new_token(access.token_file(server.address, server.port))
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            yield server.port
        finally:
            server.stop()
            thread.join(20.0)

    def width_at(host, port):
        with link.connect(host, port) as client:
            return client.open().opened.width

    with listening("127.0.0.1", 0, 4) as port, listening("127.0.0.2", port, 5):
        assert (width_at("127.0.0.1", port), width_at("127.0.0.2", port)) == (4, 5)
    assert len([*tmp_path.rglob("*.token")]) == 2 and access.token_file("::1", 1).name.endswith("-__1-1.token")
    # A server of all addresses is reached at each of them, although one before it has left its file.
    with listening("0.0.0.0", port, 9):
        assert (width_at("127.0.0.1", port), width_at("127.0.0.2", port)) == (9, 9)


def test_a_client_that_waits_outlives_the_token_of_a_killed_server(tmp_path):
    kept = tmp_path / "token"
    access.new_token(kept)
    with serving() as server:
        with pytest.raises(LinkError, match="the token is wrong"):
            link.connect(port=server.port, token_path=kept)
        replaced = threading.Timer(0.4, kept.write_text, (TOKEN,))
        replaced.start()
        with link.connect(port=server.port, token_path=kept, wait_s=10.0) as client:
            assert client.server["scene"] == "stills"
        start = time.monotonic()
        with pytest.raises(LinkError, match="the token is wrong"):
            link.connect(port=server.port, token="f" * 64, wait_s=10.0)
        assert time.monotonic() - start < 5.0


def test_clients_without_the_token_keep_nobody_out():
    with serving(connections=3, hello_s=20.0) as server:
        with connected(server):
            silent = [socket.create_connection(("127.0.0.1", server.port), 10.0) for _ in range(9)]
            for _ in range(3):
                alive(server)
            assert server.in_hand[0] <= 3
            # The oldest ones were closed.
            assert read(silent[0]) is None
            for own in silent:
                own.close()
        settled(server)


def test_limits_of_connections_and_sessions():
    with serving(connections=3, sessions=2) as server:
        with connected(server) as one, connected(server) as two:
            first = one.open()
            one.open()
            with pytest.raises(LinkError, match="2 sessions are open; close one, or wait") as error:
                two.open()
            assert error.value.code == Code.BUSY
            first.close()
            two.open()
            with connected(server), pytest.raises(LinkError, match="3 connections are open; close one, or wait"):
                connected(server)
        settled(server)
        alive(server)


def test_a_hundred_connections():
    with serving(sessions=100) as server:
        clients = [connected(server) for _ in range(100)]
        sessions = [client.open(seed=seed) for seed, client in enumerate(clients)]
        for index in range(3):
            numbers = [session.send(float(index), POSE) for session in sessions]
            for seed, (client, number) in enumerate(zip(clients, numbers, strict=True)):
                reply = client.reply_to(number)
                assert (reply.seed, reply.index, reply.counts[0, 0]) == (seed, index, index)
        for client in clients:
            client.close()
        settled(server)


def test_latest_pose_wins_and_none_of_the_path_is_lost():
    gate, stage = threading.Event(), None
    stage = Stills(gate)
    with serving(stage) as server, connected(server) as client:
        session, other = client.open(), client.open()
        first = session.send(0.0, POSE)
        time.sleep(0.1)  # it is being rendered
        numbers = [session.send(float(time_s), POSE, latest=True) for time_s in range(1, 101)]
        last = other.send(0.0, POSE)
        time.sleep(0.2)
        gate.set()
        replies = [client.receive() for _ in range(3)]
        assert [reply.id for reply in replies] == [first, numbers[-1], last]
        assert [reply.superseded for reply in replies] == [0, 99, 0]
        assert replies[1].time_s == 100.0 and 0.1 < replies[1].age_s < 5.0
        assert stage.opened[0].path == [float(time_s) for time_s in range(101)]
        # A request that must not be replaced keeps its place between others.
        gate.clear()
        busy = other.send(1.0, POSE)
        time.sleep(0.1)
        numbers = [session.send(101.0 + k, POSE, latest=k != 2) for k in range(5)]
        time.sleep(0.1)
        gate.set()
        assert [client.receive().id for _ in range(4)] == [busy, numbers[1], numbers[2], numbers[4]]


def test_a_wrong_request_of_a_group_is_refused_alone():
    gate = threading.Event()
    stage = Stills(gate)
    with serving(stage) as server, connected(server) as client:
        session, wrong = client.open(), (0.0, 0.0, -1.0, *POSE[3:])
        first = session.send(0.0, POSE)
        time.sleep(0.1)  # it is being rendered
        numbers = [session.send(float(k), wrong if k in (2, 4) else POSE, latest=True) for k in range(1, 7)]
        time.sleep(0.2)
        gate.set()
        assert client.receive().id == first
        for number in (numbers[1], numbers[3]):
            with pytest.raises(LinkError, match="a pose is under the ground") as error:
                client.receive()
            assert (error.value.id, error.value.session, error.value.code) == (number, session.number, Code.REFUSED)
        reply = client.receive()
        assert (reply.id, reply.superseded, reply.time_s) == (numbers[5], 3, 6.0)
        assert stage.opened[0].path == [0.0, 1.0, 3.0, 5.0, 6.0]
        # The last one is wrong: what the others gave stays.
        gate.clear()
        busy = session.send(7.0, POSE)
        time.sleep(0.1)
        numbers = [session.send(float(k), wrong if k == 10 else POSE, latest=True) for k in range(8, 11)]
        time.sleep(0.2)
        gate.set()
        assert client.receive().id == busy
        with pytest.raises(LinkError, match="a pose is under the ground") as error:
            client.receive()
        assert error.value.id == numbers[2]
        assert session.frame(11.0, POSE).superseded == 0
        assert stage.opened[0].path[-4:] == [7.0, 8.0, 9.0, 11.0]
    settled(server)


def test_closed_comes_after_the_replies_of_its_session():
    gate = threading.Event()
    with serving(Stills(gate)) as server:
        own = opened(server)
        own.sendall(request(3, 0.0) + request(4, 1.0, latest=True) + b"".join(message(Type.CLOSE, 1, 5)))
        own.sendall(b"".join(message(Type.OPEN, 1, 6, [Open().packed()])) + request(7, 0.0))
        time.sleep(0.2)
        gate.set()
        kinds = Type.REPLY, Type.REPLY, Type.CLOSED, Type.OPENED, Type.REPLY
        assert [read(own)[:3:2] for _ in range(5)] == [(kind, 3 + k) for k, kind in enumerate(kinds)]
        own.close()
        settled(server)


def test_replies_of_several_sessions_are_kept_apart():
    with serving() as server, connected(server) as client:
        one, two = client.open(seed=1), client.open(seed=2)
        sent = one.send(0.0, POSE)
        assert two.frame(0.0, POSE).seed == 2
        assert one.frame(1.0, POSE).index == 1
        assert client.receive().id == sent
        with pytest.raises(AttributeError, match="product 'depth' was not asked for"):
            _ = two.frame(1.0, POSE).depth


def test_stop_ends_open_connections():
    with serving() as server:
        client = connected(server)
        session = client.open()
    with pytest.raises(LinkError, match="the connection to the server is lost"):
        session.frame(0.0, POSE)
    client.close()
    with pytest.raises(ThermorenderError, match=r"cannot be reached .*; start `thermorender serve SCENE`"):
        connected(server)


def test_addresses_that_cannot_be_used_are_refused():
    with serving() as server:
        for host, port, why in (
            ("127.0.0.1", server.port, "Address already in use"),
            ("192.0.2.1", 0, "Cannot assign"),
            ("é" * 64, 0, "not a name of a machine"),
        ):
            with pytest.raises(
                ThermorenderError, match=rf"{host} port {port} cannot be listened on \({why}.*another port"
            ):
                Server(Stills(), host, port)
    # An empty host would be all addresses.
    with pytest.raises(ThermorenderError, match=r"host is empty; give 0\.0\.0\.0 for all addresses"):
        Server(Stills(), "")
    for host, port in (("é" * 64, 1), ("127.0.0.1", 99999)):
        with pytest.raises(ThermorenderError, match=f"{host} port {port} cannot be reached"):
            link.connect(host, port, TOKEN)
    with pytest.raises(ThermorenderError, match="token does not hold 64 hexadecimal digits"):
        link.connect(token=TOKEN.encode())


PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "link.md"
LAYOUTS = {
    "HEADER": HEADER.format, "OPEN": messages._OPEN.format, "OPENED": messages._OPENED.format,
    "REQUEST": messages._REQUEST.format, "POSE": "<8d", "OBJECT": messages._OBJECT.format,
    "REPLY": messages._REPLY.format, "TARGET": "<64sdddBB6s",
}  # fmt: skip
LETTERS = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "f32": "f", "f64": "d", "c": "c"}


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_page_states_the_layout(name):
    """Offsets and types of a table of the page are those of the code."""
    table = PAGE.read_text(encoding="utf-8").split(f"<!-- {name} -->\n")[1].split("\n\n")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    kinds = [re.fullmatch(r"(?:(\d+) )?(.+)", kind).groups() for _, kind, _, _ in rows]
    stated = "<" + "".join(int(count or 1) * LETTERS.get(kind, f"[{kind}]") for count, kind in kinds)

    def spelled(layout):
        """One letter for each value."""
        parts = re.findall(r"\[(\d+s)\]|(\d+s)|(\d*)([a-zA-Z])", layout)
        return [text or single or int(count or 1) * letter for text, single, count, letter in parts]

    assert "".join(spelled(stated)) == "".join(spelled(LAYOUTS[name]))
    at = 0
    for (offset, *_), (count, kind) in zip(rows, kinds, strict=True):
        assert int(offset) == at, (name, offset)
        at += int(count or 1) * struct.calcsize("<" + LETTERS.get(kind, kind))
    assert at == struct.calcsize(LAYOUTS[name])
    stated = re.search(rf"^\| \d \| {name} \| \w+ \| (\d+) bytes", PAGE.read_text(encoding="utf-8"), flags=re.M)
    assert stated is None or int(stated[1]) == at


def test_the_page_states_numbers_and_limits():
    text = PAGE.read_text(encoding="utf-8")
    for kind in Type:
        assert f"| {int(kind)} | {kind.name} | " in text
    for product in Product:
        assert f"| {int(product)} | {str(product.name).lower()} | " in text
    limits = DEFAULT_LIMITS
    assert f"serves {limits.connections} connections and {limits.sessions} sessions" in text
    assert (
        f"up to {limits.memory_bytes >> 20} MiB of messages" in text
        and f"up to {limits.waiting} requests ahead" in text
    )
    assert (
        f"within {limits.hello_s:g} s" in text and f"{limits.message_s:g} s" in text and f"{limits.reply_s:g} s" in text
    )
    assert f"up to {messages.MOST_POSES}" in text and f"up to {messages.MOST_OBJECTS}" in text
    assert len(Code) == len(re.findall(r"^\| \d \| .*\|$", text.split("## Errors")[1], flags=re.M))
