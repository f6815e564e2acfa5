"""Options that spread work over several processes or machines; the application `cluster` provides the workers."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermorender.cli.registry import provided
from thermorender.cli.terminal import Progress, table
from thermorender.errors import ThermorenderError
from thermorender.progress import Spread

if TYPE_CHECKING:
    from thermorender.output.flight import FlightOptions
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory import Trajectory

Cluster = Annotated[
    str | None,
    typer.Option(help="Share the work among workers of Dask: local:N for N processes on this machine, "
                 "tcp://SCHEDULER:8786, or the file of a Dask configuration. The folder must be on a disk that all "
                 "share."),
]  # fmt: skip
# Columns of a worker's time.
_SPENT = ("loading [s]", "warm-up [s]", "frames [s]", "moving [s]")


@contextmanager
def spread_over(cluster: str | None, output: Path) -> Iterator[Spread]:
    """Yield `map`, or a function like it that the workers of --cluster carry out; print lines on workers."""
    if cluster is None:
        yield map
        return
    with provided("workers").spreading(cluster, output, lambda line: typer.echo(line, err=True)) as spread:
        yield spread


@dataclass(frozen=True)
class ClusterOptions:
    """Where the frames of a flight are rendered."""

    cluster: Cluster = None
    frames: Annotated[
        str | None,
        typer.Option(help="FIRST:STOP: render only these frames, beside other processes that render others; "
                     "--resume puts them together.", rich_help_panel="workers"),
    ] = None  # fmt: skip
    block: Annotated[
        int | None,
        typer.Option(
            help="Frames that a worker renders at a time; default: by the sensor's memory.", rich_help_panel="workers"
        ),
    ] = None

    def refuse_with(self, preview: bool, resume: bool) -> None:
        """Raise ThermorenderError for options that contradict each other or have no effect."""
        from thermorender.output.blocks import parse_frames

        if self.frames:
            parse_frames(self.frames)
        if self.cluster:
            provided("workers").parse_cluster(self.cluster)
        if self.block is not None and not self.cluster:
            raise ThermorenderError("--block has no effect without --cluster; add --cluster local:2, or leave it out")
        if self.frames and self.cluster:
            raise ThermorenderError("--frames and --cluster both divide the flight; give one of them")
        if preview and (self.frames or self.cluster):
            raise ThermorenderError("--preview writes no frames; leave --cluster and --frames out")
        if self.frames and resume:
            raise ThermorenderError("--frames needs no --resume; leave it out, or leave --frames out to continue all")

    def run(
        self, renderer: "Renderer", trajectory: "Trajectory", folder: Path, options: "FlightOptions",
        progress: Progress, **more: Any,
    ) -> dict[str, Any]:  # fmt: skip
        """Fly by a cluster, print its messages and a table of its workers, and return the summary of the flight."""
        assert self.cluster
        summary: dict[str, Any] = provided("workers").fly(
            renderer, trajectory, folder, self.cluster, options, block=self.block,
            report=lambda line: typer.echo(line, err=True),
            progress=lambda done, total: progress(f"frame {done} of {total}", done / total),
            of_worker=lambda name, done, total: progress(f"{name}: {done} frames", done / total), **more,
        )  # fmt: skip
        if summary["workers"]:
            names = ("worker", "blocks", "frames", "failed", *_SPENT, "MB")
            seconds = ("loading_s", "warm_up_s", "frames_s", "moving_s")
            rows = [
                (name, one["blocks"], one["frames"], one["failed"], *(f"{one[key]:.3g}" for key in seconds),
                 f"{one['bytes'] / 1e6:.3g}")
                for name, one in sorted(summary["workers"].items())
            ]  # fmt: skip
            table(names, rows)
        return summary

    def part(self, renderer: "Renderer", trajectory: "Trajectory", folder: Path, options: "FlightOptions") -> str:
        """Render the frames of --frames and return a line on them."""
        from thermorender.output.blocks import parse_frames
        from thermorender.output.flight_part import fly_part

        assert self.frames
        first, stop = parse_frames(self.frames)
        found = fly_part(renderer, trajectory, folder, options, first, stop)
        return (
            f"frames {first} to {found['stop'] - 1} of {found['frames']} in {folder}; continue with --resume, without "
            "--frames, when all parts are rendered"
        )
