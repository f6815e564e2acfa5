"""Bars for long work: on a terminal, and in a notebook."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any

# Time between the lines of a log [s].
_EVERY_S = 30.0
# Called with (what, share done).
Progress = Callable[[str, float], object]
# (do, units) → do(unit) of each, in order: `map`, or what spreads the units over the workers of a cluster.
Spread = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and getattr(shell, "kernel", None) is not None


@contextmanager
def progress() -> Iterator[Progress]:
    """Yield a function (what, share done) that draws a bar on a terminal, and prints a line now and then elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines()
        return
    with Bars(*columns, console=console, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def report(what: str, share: float) -> None:
            key = "frames" if what.startswith("frame ") else what.partition(":")[0]
            if key not in tasks:
                tasks[key] = bars.add_task(what, total=1.0)
            bars.update(tasks[key], completed=share, description=what)

        yield report


def _lines(every_s: float = _EVERY_S) -> Progress:
    """A function that prints what is done to a log, at most once in a time [s]."""
    last = time.monotonic()

    def report(what: str, share: float) -> None:
        nonlocal last
        if time.monotonic() - last >= every_s:
            last = time.monotonic()
            print(f"{what}: {share:.0%}", file=sys.stderr, flush=True)

    return report


@contextmanager
def interactive(given: Progress | None = None) -> Iterator[Progress | None]:
    """Yield `given`; without it a bar in a notebook or at Python's prompt, and None in a program."""
    if given is not None:
        yield given
    elif in_notebook():
        with _in_cell() as report:
            yield report
    elif hasattr(sys, "ps1"):
        with progress() as report:
            yield report
    else:
        yield None


@contextmanager
def _in_cell() -> Iterator[Progress]:
    """Yield a function that draws a bar below the cell; it disappears at the end."""
    from IPython.display import HTML, display  # type: ignore[import-not-found, unused-ignore]

    handle = display(HTML(""), display_id=True)

    def report(what: str, share: float) -> None:
        handle.update(HTML(f'<progress value="{share:.3f}" max="1"></progress> {escape(what)}'))

    try:
        yield report
    finally:
        handle.update(HTML(""))
