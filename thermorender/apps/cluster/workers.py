"""What the command line calls for a cluster: its address checked, a flight, and a function like `map`."""

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermorender import files
from thermorender.apps.cluster.connect import connected
from thermorender.apps.cluster.connect import parse_cluster as parse_cluster
from thermorender.apps.cluster.engine import Report, do_unit, results, sentence, store
from thermorender.errors import ThermorenderError
from thermorender.progress import Spread

if TYPE_CHECKING:
    from distributed import Client


def fly(renderer: Any, trajectory: Any, folder: Any, cluster: str, options: Any, **more: Any) -> dict[str, Any]:
    """Fly by the workers at an address; return the summary of the flight."""
    from thermorender.apps.cluster.fly import fly as run

    return run(renderer, trajectory, folder, parse_cluster(cluster), options, **more)


@contextmanager
def spreading(cluster: str, output: str | os.PathLike[str], report: Report = lambda line: None) -> Iterator[Spread]:
    """Yield a function (do, units) that yields do(unit) for all units, in their order, as `map` does.

    Workers read `do` once, from a folder beside `output`, which must be on a disk that all share. The folder is removed
    at the end. A unit that fails ends the run, as it does without a cluster; that of a lost worker is done again.
    """
    parent, address = Path(output).resolve().parent, parse_cluster(cluster)
    with connected(address) as client, files.output_folder(parent):
        with tempfile.TemporaryDirectory(prefix=f".{Path(output).name}.", suffix=".work", dir=parent) as place:
            yield partial(_spread, client, Path(place), address.local, report)


def _spread(
    client: "Client", place: Path, processes: int, report: Report, do: Callable[[Any], Any], units: Sequence[Any]
) -> Iterator[Any]:
    """Yield the results of units in their order."""
    job = store(partial(_numbered, do), place / f"{len(list(place.iterdir()))}.pickle", processes)
    early: dict[int, Any] = {}
    turn = 0
    for (number, _), found in results(
        client, partial(do_unit, job), list(enumerate(units)), report, "run the command again"
    ):
        if "error" in found:
            raise ThermorenderError(sentence(found))
        early[number] = found["value"]
        while turn in early:
            yield early.pop(turn)
            turn += 1


def _numbered(do: Callable[[Any], Any], unit: tuple[int, Any]) -> Any:
    """The result of a unit with its place in the order."""
    return do(unit[1])
