"""A server in a thread for tests of the link, with a stage that needs no renderer."""

import threading
import time
from contextlib import contextmanager

import numpy as np

from thermorender import link
from thermorender.errors import ThermorenderError
from thermorender.link.messages import Opened, reply_head
from thermorender.link.server import Limits, Server
from thermorender.link.wire import IMAGES

TOKEN = "0123456789abcdef" * 4


class Still:
    """A session whose images hold the number of the frame; `gate` lets frames wait."""

    def __init__(self, settings, gate=None):
        self.opened = Opened(4, 3, 30.0, 0.01, 0.01, 0.01, (7.5, 13.5), 14, (280.0, 300.0))
        self.settings, self.gate, self.index, self.time_s, self.path = settings, gate, -1, -np.inf, []

    most_bytes = 1000

    def answer(self, requests, arrived_s):
        if self.gate is not None:
            self.gate.wait(10.0)
        request = requests[-1]
        if request.time_s <= self.time_s:
            raise ThermorenderError("time runs backwards")
        if request.time_s == 13.0:
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
                       shape, len(requests) - 1, False, 0),
            *images,
        ]  # fmt: skip


class Stills:
    """A stage of such sessions."""

    def __init__(self, gate=None):
        self.gate, self.opened = gate, []

    def describe(self):
        return {"scene": "stills", "cameras": {"still": {}}}

    def open(self, settings):
        if settings.camera not in ("", "still"):
            raise ThermorenderError(f"camera {settings.camera!r} is not served; give still")
        self.opened.append(Still(settings, self.gate))
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
