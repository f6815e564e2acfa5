"""A flight before it is rendered: what it will show, what it costs, and a page of both."""

import tempfile
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from thermorender import files
from thermorender.output.flight import FlightOptions, measured
from thermorender.output.flight_pages.cost import Cost
from thermorender.output.flight_pages.flight_page import write_preview
from thermorender.output.flight_pages.prospect import Prospect, prospect
from thermorender.trajectory.path import Trajectory

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer


def preview(
    renderer: "Renderer", trajectory: Trajectory, options: FlightOptions,
    folder: str | PathLike[str] | None = None, outlook: Callable[[Prospect | Cost], object] | None = None,
) -> list[Path]:  # fmt: skip
    """Write `preview.html` and `preview.png` of a flight into a folder, if given, and return their paths. Two frames
    are rendered and written to a temporary folder, which measures time and space. `outlook` is as in
    `thermorender.output.flight.fly`."""
    report = outlook or (lambda part: None)
    rate_hz = renderer.scene.camera.frame_rate_hz if options.rate_hz is None else options.rate_hz
    times = trajectory.frame_times(rate_hz, options.start_s, options.stop_s)
    seen = prospect(renderer, trajectory, times, rate_hz)
    report(seen)
    if folder is None:
        with tempfile.TemporaryDirectory() as trial:
            report(measured(renderer, trajectory, options, Path(trial), seen))
        return []
    with files.output_folder(folder) as out:
        with tempfile.TemporaryDirectory(dir=out, prefix=".preview.") as trial:
            cost = measured(renderer, trajectory, options, Path(trial), seen)
        report(cost)
        return write_preview(out, renderer, seen, cost)
