"""Dask's scheduler and workers on this machine: on loopback, without a dashboard or any other port for people.

Dask runs code that is sent to its ports, so they take only those who hold a key that is made for the run.
"""

import logging
from typing import Any

from distributed import Nanny, Scheduler, Security, SpecCluster, Worker

from thermorender.errors import ThermorenderError

_LOOPBACK = "127.0.0.1"


class _QuietScheduler(Scheduler):
    def start_http_server(self, *arguments: Any, **options: Any) -> None:
        """Open no port; Dask opens one even where the dashboard is switched off."""


class _QuietWorker(Worker):
    def start_http_server(self, *arguments: Any, **options: Any) -> None:
        """Open no port."""


def local_cluster(workers: int) -> SpecCluster:
    """Return a cluster of processes on this machine, each of which renders one block at a time."""
    # A lost worker is reported by the flight.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        security = Security.temporary()
    except ImportError:
        raise ThermorenderError(
            "local workers need the package cryptography, which is not installed; add it with "
            "`pip install 'thermorender[cluster]'`"
        ) from None
    shared = {"host": _LOOPBACK, "protocol": "tls://", "security": security}
    options = shared | {"nthreads": 1, "worker_class": _QuietWorker, "silence_logs": logging.CRITICAL,
                        "memory_limit": 0}  # fmt: skip
    return SpecCluster(
        scheduler={"cls": _QuietScheduler, "options": shared | {"dashboard": False}},
        workers={number: {"cls": Nanny, "options": options} for number in range(workers)},
        security=security,
        silence_logs=logging.CRITICAL,
    )
