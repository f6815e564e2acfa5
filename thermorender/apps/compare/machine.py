"""The machine that a result was measured on, peak memory, and functions run in a separate process."""

import multiprocessing
import os
import platform
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from thermorender.errors import ThermorenderError

_Result = TypeVar("_Result")


def machine() -> dict[str, Any]:
    """Return {processor, cores, memory_gib, system} of this machine; None for unknown values."""
    processor, memory = platform.processor() or None, None
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    with suppress(AttributeError, OSError, ValueError):
        memory = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    return {"processor": processor, "cores": os.cpu_count(), "memory_gib": memory, "system": platform.system()}


def apart(function: Callable[..., _Result], *arguments: Any) -> _Result:
    """Run a function in a separate process, so that its memory and time can be measured; return its result."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            raise ThermorenderError(
                "the measuring process was killed before it ended, perhaps because memory ran out; free memory and "
                "start again"
            ) from None


def forget_peak_memory() -> None:
    """Reset the peak memory of this process (Linux only; elsewhere nothing happens)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_mib() -> float | None:
    """Return the peak memory of this process since the last reset [MiB], or None where it is unknown."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return float(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024.0
    return None
