"""The command line: all verbs, found by `registry`; a verb parses, calls and prints."""

from typing import Annotated

import typer

from thermorender.cli.process import run
from thermorender.cli.registry import Verbs

app = typer.Typer(
    cls=Verbs,
    help="Thermal infrared frames of terrain flights, radiometrically true, in kelvin.",
    add_completion=False,
    pretty_exceptions_enable=False,
    # Markup would swallow units such as [m], here and in all verbs.
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=lambda wanted: wanted and _version(), help="Show it.")
    ] = False,
) -> None:
    """Accept options before the verb; `process.run` reads --debug."""


def _version() -> None:
    from thermorender.versions import version_of

    typer.echo(f"thermorender {version_of('thermorender')}")
    raise typer.Exit


def main() -> None:
    """Run the command line of thermorender."""
    run(app)
