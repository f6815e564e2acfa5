"""The machine a result was measured on, and the memory and time of a function in its own process."""

import multiprocessing
import os
import platform
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path

from thermorender.errors import ThermorenderError


def machine():
    """Return {processor, cores, memory_gib, system} of this machine, None for what it does not tell."""
    processor, memory = platform.processor() or None, None
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    with suppress(AttributeError, OSError, ValueError):
        memory = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    return {"processor": processor, "cores": os.cpu_count(), "memory_gib": memory, "system": platform.system()}


def apart(function, *arguments):
    """Return what a function returns in a process of its own, whose memory and time are that function's alone.

    Raises
    ------
    ThermorenderError
        The process is killed before it is done.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            raise ThermorenderError(
                "a process that measures was killed before it was done, perhaps for want of memory; free some and "
                "start again"
            ) from None


def forget_peak_memory():
    """Start the record of the most memory this process held anew, where the system keeps one."""
    # Linux starts its record of the most memory held anew.
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_mib():
    """Return the most memory this process held since [MiB], or None where the system does not tell."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return float(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024.0
    return None
