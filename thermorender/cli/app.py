"""The command line: all verbs, one module per job; a verb parses, calls and prints."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults
from thermorender.cli.camera import fit_camera, reconstruct
from thermorender.cli.compare import bench, compare
from thermorender.cli.doctor import doctor
from thermorender.cli.export import app as export
from thermorender.cli.maps import dataset, evaluate, prepare, train, translate
from thermorender.cli.materials import app as materials
from thermorender.cli.options import Device
from thermorender.cli.process import run
from thermorender.cli.render import day, fly, render
from thermorender.cli.scenes import import_terrain, make_scene, map_materials, plan
from thermorender.cli.serve import serve, studio
from thermorender.cli.terminal import Results
from thermorender.errors import ThermorenderError

app = typer.Typer(
    help="Long-wave infrared frames of terrain flights, radiometrically true, in kelvin.",
    add_completion=False,
    pretty_exceptions_enable=False,
    # Markup would swallow units such as [m], here and in all verbs.
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def _options(debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False) -> None:
    """Accept options before the verb; `process.run` reads --debug."""


def demo(output: Results = Path("out/demo"), device: Device = "auto") -> None:
    """Run the main job on the shipped heath: a flight towards the heated marker, and the comparison."""
    if (output / "flight" / "flight.json").exists():
        raise ThermorenderError(f"{output} already holds a demo; give another folder with -o, or remove it")
    fly(defaults.SCENE, output / "flight", rate_hz=4.0, device=device)
    compare([defaults.SCENE], output / "comparison", methods="B,C1,D", rate_hz=0.2, device=device)
    typer.echo(f"look at {output / 'flight' / 'flight.mp4'} and at {output / 'comparison' / 'report.html'}")


app.add_typer(materials, name="materials")
app.add_typer(export, name="export")
for _verb in (fit_camera, reconstruct, prepare, dataset, train, evaluate, translate, doctor, import_terrain,
              make_scene, plan, render, fly, day, serve, studio, compare, bench, demo, map_materials):  # fmt: skip
    app.command(_verb.__name__.replace("_", "-"))(_verb)


def main() -> None:
    """Run the command line of thermorender."""
    run(app)
