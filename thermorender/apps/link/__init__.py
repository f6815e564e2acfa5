"""The link: a running renderer behind a simulator, frame by frame over a socket.

A client::

    from thermorender import link
    with link.connect() as server:  # started by `thermorender serve heath`
        camera = server.open()
        reply = camera.frame(0.0, (0.0, 0.0, 120.0, 0.0, 1.0, 0.0, 0.0), products=("counts", "temperature"))
        reply.counts, reply.temperature, reply.budget_mk

These are the parts that a client needs; they import NumPy and no renderer. `apps.link.server` is the other end.
"""

from thermorender.apps.link.client import Client, Session, connect
from thermorender.apps.link.messages import Opened, Reply
from thermorender.apps.link.wire import DEFAULT_PORT, Code, LinkError, Product

__all__ = ["DEFAULT_PORT", "Client", "Code", "LinkError", "Opened", "Product", "Reply", "Session", "connect"]

RANK = 50
VERBS = {"serve": "verbs:serve"}
