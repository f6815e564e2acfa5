"""HTTP connections of the studio: half requests, idle ones, and many at once, over a socket."""

import asyncio
import socket
import threading
import time
from contextlib import contextmanager

import pytest

LIMIT_S = 0.6
HOST = "Host: 127.0.0.1\r\n"
WEBSOCKET = f"GET / HTTP/1.1\r\n{HOST}Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n" \
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"  # fmt: skip


async def application(scope, receive, send):
    """Answer a request after its body, "/slow" after more than the limit; a websocket stays open."""
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
        while (await receive())["type"] != "websocket.disconnect":
            await send({"type": "websocket.send", "text": "still here"})
        return
    message = {"more_body": True}
    while message.get("more_body"):
        message = await receive()
    if scope["path"] == "/slow":
        await asyncio.sleep(2.0 * LIMIT_S)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
    await send({"type": "http.response.body", "body": b"ok"})


@pytest.fixture
def connect(monkeypatch):
    """A function that opens a connection to a server of the studio's kind."""
    uvicorn = pytest.importorskip("uvicorn", reason="needs thermorender[studio]")
    from thermorender.apps.studio import connections

    monkeypatch.setattr(connections, "REQUEST_S", LIMIT_S)
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 12)
    config = uvicorn.Config(application, http=connections.Connection, lifespan="off", log_level="error")
    server, listening = uvicorn.Server(config), socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    while not server.started:
        time.sleep(0.01)
    opened = []

    def made(text=""):
        opened.append(socket.create_connection(listening.getsockname(), timeout=20.0))
        opened[-1].sendall(text.encode())
        return opened[-1]

    yield made
    for each in opened:
        each.close()
    server.should_exit = True
    thread.join(20.0)
    listening.close()


@contextmanager
def takes(least_s, most_s):
    begun = time.monotonic()
    yield
    assert least_s <= time.monotonic() - begun <= most_s


def rest(connection):
    """What arrives until the server ends the connection."""
    found = b""
    try:
        while data := connection.recv(4096):
            found += data
    except ConnectionResetError:
        pass
    return found


@pytest.mark.parametrize("half", [
    "", "GET / HT", f"GET / HTTP/1.1\r\n{HOST}", f"POST / HTTP/1.1\r\n{HOST}Content-Length: 100\r\n\r\nhalf",
    f"POST / HTTP/1.1\r\n{HOST}Transfer-Encoding: chunked\r\n\r\n4\r\nhalf\r\n",
])  # fmt: skip
def test_a_half_request_ends_its_connection(connect, half):
    connection = connect(half)
    with takes(0.5 * LIMIT_S, 10.0 * LIMIT_S):
        assert rest(connection) == b""


def test_bytes_that_trickle_in_do_not_keep_a_connection(connect):
    connection = connect(f"GET / HTTP/1.1\r\n{HOST}X: ")
    with takes(0.5 * LIMIT_S, 10.0 * LIMIT_S), pytest.raises((ConnectionResetError, BrokenPipeError)):
        while True:
            connection.sendall(b"x")
            time.sleep(0.05)


def test_a_header_without_end_is_refused(connect):
    connection = connect(f"GET / HTTP/1.1\r\n{HOST}X: {'x' * 200_000}")
    assert rest(connection)[:12] in (b"HTTP/1.1 400", b"")


def test_whole_requests_are_answered_however_long_they_take(connect):
    connection = connect()
    for path in ("/", "/slow", "/"):
        # Each begins its own time.
        for part in (f"POST {path} HTTP/1.1\r\n{HOST}", "Content-Length: 4\r\n\r\nbo", "dy"):
            time.sleep(0.25 * LIMIT_S)
            connection.sendall(part.encode())
        answer = b""
        while not answer.endswith(b"\r\n\r\nok"):
            answer += connection.recv(4096)
        assert answer.startswith(b"HTTP/1.1 200")


def test_idle_connections_keep_nobody_out(connect, monkeypatch):
    monkeypatch.setattr("thermorender.apps.studio.connections.REQUEST_S", 60.0)
    idle = [connect("GET /") for _ in range(40)]
    asked = connect(f"GET / HTTP/1.1\r\n{HOST}Connection: close\r\n\r\n")
    assert rest(asked).endswith(b"ok")
    # Those that wait longest made room.
    for each in idle[:28]:
        assert rest(each) == b""


def test_a_websocket_stays_open_and_is_never_ended_for_another_one(connect):
    page = connect(WEBSOCKET)
    assert page.recv(4096).startswith(b"HTTP/1.1 101")
    for each in [connect("GET /") for _ in range(20)]:
        assert rest(each) == b""
    time.sleep(LIMIT_S)
    page.sendall(b"\x81\x80\x00\x00\x00\x00")
    assert page.recv(4096).endswith(b"still here")
