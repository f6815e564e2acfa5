"""A part of a flight, rendered beside other processes that render other parts of it: an array of jobs, for example."""

from os import PathLike
from typing import TYPE_CHECKING, Any

from thermorender import files
from thermorender.errors import ThermorenderError
from thermorender.output.blocks import finished_blocks, join, write_block
from thermorender.output.flight import Flight, FlightOptions

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import Trajectory


def fly_part(
    renderer: "Renderer", trajectory: "Trajectory", folder: str | PathLike[str], options: FlightOptions, first: int,
    stop: int,
) -> dict[str, Any]:  # fmt: skip
    """Render the frames from `first` up to `stop`, or the end, as a block; do nothing if it is finished. A flight into
    the folder with `resume` takes over the blocks."""
    flight = Flight(renderer, trajectory, options, None)
    flight.sheet = []
    frames = len(flight.times)
    if not 0 <= first < min(stop, frames):
        raise ThermorenderError(
            f"frames={first}:{stop} holds no frame of this flight; give numbers between 0 and {frames}"
        )
    stop = min(stop, frames)
    with files.output_folder(folder) as out:
        join(out, flight)
        kept = finished_blocks(out, flight.settings, verify=False).get(first)
        if kept is None or kept.stop < stop:
            write_block(flight, out, first, stop)
    return {"frames": frames, "first": first, "stop": stop, "folder": str(folder)}
