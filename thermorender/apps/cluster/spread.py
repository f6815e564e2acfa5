"""Independent units of work by the workers of a cluster: a function like `map`, with results in the order of units."""

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermorender import files, formats
from thermorender.apps.cluster.connect import Address, connected
from thermorender.apps.cluster.dispatch import Report, attempted, results, sentence
from thermorender.apps.cluster.work import ONE, ready, unpickled
from thermorender.errors import ThermorenderError
from thermorender.progress import Spread
from thermorender.render.variant import active_device
from thermorender.versions import versions

if TYPE_CHECKING:
    from distributed import Client

# The function of this process: (checksum of its file, function).
_known: tuple[str, Callable[[Any], Any]] | None = None


@dataclass(frozen=True)
class _Job:
    """A function for workers; it is sent with every unit, so it is small."""

    # path, checksum: Of the file that holds the function with its arguments. It is unpickled only if it has this
    # checksum.
    path: str
    checksum: str
    processes: int  # On this machine, which share its cores; 0: unknown
    # versions, device: Other workers are refused
    versions: dict[str, str] = field(default_factory=versions)
    device: dict[str, str] = field(default_factory=active_device)


@contextmanager
def spreading(address: Address, output: str | os.PathLike[str], report: Report = lambda line: None) -> Iterator[Spread]:
    """Yield a function (do, units) that yields do(unit) for all units, in their order, as `map` does.

    Workers read `do` once, from a folder beside `output`, which must be on a disk that all share. The folder is removed
    at the end. A unit that fails ends the run, as it does without a cluster; that of a lost worker is done again.

    Parameters
    ----------
    address : Address
    output : path
        Of the results.
    report : callable
        Called with lines on workers that join or are lost.
    """
    parent = Path(output).resolve().parent
    with connected(address) as client, files.output_folder(parent):
        with tempfile.TemporaryDirectory(prefix=f".{Path(output).name}.", suffix=".work", dir=parent) as place:
            yield partial(_spread, client, Path(place), address.local, report)


def _spread(
    client: "Client", place: Path, processes: int, report: Report, do: Callable[[Any], Any], units: Sequence[Any]
) -> Iterator[Any]:
    """Yield the results of units in their order."""
    from distributed.protocol import pickle

    data = pickle.dumps(do)
    path = place / f"{formats.checksum(data)}.pickle"
    with files.reported(path):
        files.put_in_place(files.write_aside(path, data), path)
    work = partial(_unit, _Job(str(path), formats.checksum(data), processes))
    early: dict[int, Any] = {}
    turn = 0
    for (number, _), found in results(client, work, list(enumerate(units)), report, "run the command again"):
        if "error" in found:
            raise ThermorenderError(sentence(found))
        early[number] = found["value"]
        while turn in early:
            yield early.pop(turn)
            turn += 1


def _unit(job: _Job, unit: tuple[int, Any]) -> dict[str, Any]:
    """Do a unit in this process; return worker, and value or error."""

    def do() -> dict[str, Any]:
        global _known
        if _known is None or _known[0] != job.checksum:
            _known = None
            ready(job.versions, job.processes, job.device)
            _known = job.checksum, unpickled(Path(job.path), job.checksum)
        return {"value": _known[1](unit[1])}

    with ONE:
        return attempted(do)
