"""A server in a thread for tests of the link, with a stage that needs no renderer."""

import threading
import time
from contextlib import contextmanager, suppress

import numpy as np

from thermorender import link
from thermorender.apps.link.connections import Limits
from thermorender.apps.link.messages import Opened, reply_bytes, reply_head
from thermorender.apps.link.server import Server
from thermorender.apps.link.wire import HEADER, IMAGES, Type
from thermorender.errors import ThermorenderError

# Time at which a session of `Stills` fails.
FAULT_S = -13.25
TOKEN = "0123456789abcdef" * 4


class Still:
    """A session whose images hold the number of the frame; `gate` lets frames wait."""

    def __init__(self, settings, gate=None, size=(4, 3)):
        self.opened = Opened(*size, 30.0, 0.01, 0.01, 0.01, (7.5, 13.5), 14, (280.0, 300.0))
        self.settings, self.gate, self.index, self.time_s, self.path = settings, gate, -1, -np.inf, []

    @property
    def most_bytes(self):
        return reply_bytes(0x1FF, self.opened.width, self.opened.height)

    def add(self, request):
        if not request.time_s > self.time_s:
            raise ThermorenderError("time runs backwards")
        if (request.poses[:, 3] < 0.0).any():
            raise ThermorenderError("a pose is under the ground")
        self.path += [row[0] for row in request.poses]

    def answer(self, requests, arrived_s, added=0):
        if self.gate is not None:
            self.gate.wait(10.0)
        request = requests[-1]
        if request.time_s <= self.time_s:
            raise ThermorenderError("time runs backwards")
        if any((each.poses[:, 3] < 0.0).any() for each in requests):
            raise ThermorenderError("a pose is under the ground")
        if request.time_s == FAULT_S:
            raise ZeroDivisionError("a fault of the server")
        self.time_s, self.index = request.time_s, self.index + 1
        self.path += [row[0] for each in requests for row in each.poses]
        shape = self.opened.height, self.opened.width
        images = [
            np.full((*shape, depth) if depth > 1 else shape, self.index % 251, kind)
            for product, (kind, depth) in IMAGES.items()
            if request.products & product
        ]
        now = time.perf_counter()
        products = request.products & ~int(link.Product.TARGETS)
        return [
            reply_head(request.time_s, self.settings.seed, self.index, (1.0, 2.0), now - arrived_s, 0.0, products,
                       shape, added + len(requests) - 1, False, 0),
            *images,
        ]  # fmt: skip


class Stills:
    """A stage of such sessions."""

    def __init__(self, gate=None, size=(4, 3)):
        self.gate, self.size, self.opened = gate, size, []

    def describe(self):
        return {"scene": "stills", "cameras": {"still": {}}}

    def open(self, settings):
        if settings.camera not in ("", "still"):
            raise ThermorenderError(f"camera {settings.camera!r} is not served; give still")
        self.opened.append(Still(settings, self.gate, self.size))
        return self.opened[-1]


@contextmanager
def serving(stage=None, **limits):
    """Yield a Server that runs in a thread."""
    server = Server(stage or Stills(), port=0, limits=Limits(**limits))
    server.token = TOKEN
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(20.0)
        assert not thread.is_alive()


def connected(server, **options):
    return link.connect(port=server.port, token=TOKEN, timeout_s=20.0, **options)


def read(own):
    """(type, session, id, payload) of the next message; None at the end of the connection."""

    def exactly(count):
        data = b""
        while len(data) < count:
            with suppress(ConnectionResetError):
                got = own.recv(count - len(data))
                data += got
                if got:
                    continue
            return None
        return data

    head = exactly(HEADER.size)
    if head is None:
        return None
    _, _, kind, length, session, number = HEADER.unpack(head)
    return Type(kind), session, number, exactly(length)


def settled(server):
    """Nothing of closed connections is kept."""
    end = time.monotonic() + 10.0
    while server.in_hand != (0, 0, 0) and time.monotonic() < end:
        time.sleep(0.01)
    assert server.in_hand == (0, 0, 0)
