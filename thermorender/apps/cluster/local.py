"""Dask's scheduler and workers on this machine: on loopback only, without a dashboard or any other port for people."""

import logging
from typing import Any

from distributed import Nanny, Scheduler, SpecCluster, Worker

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
    options = {"nthreads": 1, "worker_class": _QuietWorker, "host": _LOOPBACK, "silence_logs": logging.CRITICAL,
               "memory_limit": 0}  # fmt: skip
    return SpecCluster(
        scheduler={"cls": _QuietScheduler, "options": {"host": _LOOPBACK, "dashboard": False}},
        workers={number: {"cls": Nanny, "options": options} for number in range(workers)},
        silence_logs=logging.CRITICAL,
    )
