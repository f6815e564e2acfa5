"""What the command line calls for --cluster: the text of the option checked, a flight, and a function like `map`."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from thermorender.apps.cluster import spread
from thermorender.apps.cluster.connect import parse_cluster as parse_cluster
from thermorender.apps.cluster.dispatch import Report
from thermorender.progress import Spread


@contextmanager
def spreading(cluster: str, output: str | os.PathLike[str], report: Report) -> Iterator[Spread]:
    """Yield a function like `map` whose units are done by the workers at an address; `output` is on their disk."""
    with spread.spreading(parse_cluster(cluster), output, report) as found:
        yield found


def fly(renderer: Any, trajectory: Any, folder: Any, cluster: str, options: Any, **more: Any) -> dict[str, Any]:
    """Fly by the workers at an address; return the summary of the flight."""
    from thermorender.apps.cluster.fly import fly as run

    return run(renderer, trajectory, folder, parse_cluster(cluster), options, **more)
