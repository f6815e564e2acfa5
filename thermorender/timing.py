"""Where the time of a command goes: seconds of named phases, measured only while a profile is taken."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class PhaseTimes:
    """Seconds of phases, in the order in which they began.

    A phase within another counts for itself only, so the phases of a thread add up to its time. Phases of the threads
    that write files run beside the others; their names begin with "writer".
    """

    def __init__(self) -> None:
        self._begun, self._lock, self._own = time.perf_counter(), threading.Lock(), threading.local()
        # Until now this process has imported modules and read its arguments.
        self._found: dict[str, list[float]] = {"start of the program": [time.process_time(), 1]}

    @contextmanager
    def measured(self, name: str) -> Iterator[None]:
        """Add the time of a block, without that of phases within it, to a phase."""
        # Seconds of the phases within each open phase of this thread.
        within = self._own.__dict__.setdefault("within", [])
        with self._lock:
            entry = self._found.setdefault(name, [0.0, 0])
        within.append(0.0)
        begun = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - begun
            own = spent - within.pop()
            if within:
                within[-1] += spent
            with self._lock:
                entry[0] += own
                entry[1] += 1

    def as_dict(self) -> dict[str, Any]:
        """Return {"wall_s": since the profile began, "phases": {name: {"seconds", "times"}}} as plain values."""
        with self._lock:
            phases = {
                name: {"seconds": round(spent, 4), "times": count} for name, (spent, count) in self._found.items()
            }
        return {"wall_s": round(time.perf_counter() - self._begun, 4), "phases": phases}

    def lines(self) -> list[str]:
        """Return a table of the phases as lines."""
        found = self.as_dict()
        rows = [(name, each["seconds"], each["times"]) for name, each in found["phases"].items()]
        width = max(len(name) for name, *_ in rows)
        lines = [f"{'phase'.ljust(width)}  seconds  times   ms each"]
        lines += [f"{name.ljust(width)}  {spent:7.3f}  {n:5d}  {1e3 * spent / n:8.1f}" for name, spent, n in rows if n]
        return [*lines, f"{'since the program started'.ljust(width)}  {found['wall_s'] + rows[0][1]:7.3f}"]


# The profile that is taken in this process, if any.
_taken: list[PhaseTimes] = []


@contextmanager
def profiled() -> Iterator[PhaseTimes]:
    """Measure the PhaseTimes of a block, in all threads."""
    _taken.append(PhaseTimes())
    try:
        yield _taken[-1]
    finally:
        _taken.pop()


@contextmanager
def phase(name: str) -> Iterator[None]:
    """Measure a block as a phase of the profile that is taken; without one, only run it."""
    if not _taken:
        yield
        return
    with _taken[-1].measured(name):
        yield


def profile_entry() -> dict[str, Any]:
    """Return {"profile": values of the profile that is taken}, for a record; {} without one."""
    return {"profile": _taken[-1].as_dict()} if _taken else {}
