"""A data set whose worlds are rendered by the workers of a Dask cluster."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from thermorender.apps.cluster.connect import Address, connected
from thermorender.apps.cluster.engine import Report, attempted, ready, results, sentence
from thermorender.apps.training.dataset import Dataset, read_dataset
from thermorender.apps.training.rendered import World, render_campaign
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress
from thermorender.versions import versions


@dataclass(frozen=True)
class _Campaign:
    """What a worker needs to know of a campaign."""

    folder: str
    worlds: tuple[World, ...]
    hours: int
    views: int
    processes: int
    versions: dict[str, str]


def render_campaign_by(
    folder: str | Path, of: Sequence[World], hours: int, views: int, address: Address, *,
    resume: bool = False, progress: Progress | None = None,
    report: Report = lambda line: None,
) -> Dataset:  # fmt: skip
    """Render Worlds into a data set by the workers of a cluster; return the Dataset.

    All workers must share the folder's disk. Shards equal those of one machine; index lines are in the order of
    completion.
    """
    # Without a world of its own, it makes the folder or refuses another data set.
    render_campaign(folder, of, hours, views, resume=resume, turn=(len(of), 1))
    job = _Campaign(os.path.abspath(folder), tuple(of), hours, views, address.local, versions())
    failures, done = [], 0
    with connected(address) as client:
        for number, found in results(client, partial(_world, job), range(len(of)), report):
            if "error" in found:
                failures.append(f"{of[number].name} on {sentence(found)}")
                report(failures[-1])
                continue
            done += 1
            if progress:
                progress(f"worlds: {done} of {len(of)}", done / len(of))
    if failures:
        raise ThermorenderError(
            f"{len(failures)} of {len(of)} worlds failed, the first: {failures[0]}; the others are finished, mend the "
            "cause and continue with --resume"
        )
    return read_dataset(folder)


def _world(job: _Campaign, number: int) -> dict[str, Any]:
    """Render a world in this process, unless its shard is complete."""

    def do() -> dict[str, Any]:
        ready(job.versions, job.processes)
        if not os.path.isfile(os.path.join(job.folder, "card.json")):
            raise ThermorenderError(
                f"{job.folder} holds no data set on this machine; mount the folder there under the same path"
            )
        render_campaign(
            job.folder, job.worlds, job.hours, job.views, resume=True, turn=(number, len(job.worlds))
        )  # fmt: skip
        return {}

    return attempted(do)
