"""The verb `studio`: scenes opened, imported and edited in the browser."""

import signal
from functools import partial
from typing import Annotated

import typer

from thermorender.cli.options import SCENE_NAMES, Device, flat
from thermorender.cli.process import end_on_signals
from thermorender.cli.terminal import progress
from thermorender.errors import ThermorenderError


@flat
def studio(
    scene: Annotated[
        str | None,
        typer.Argument(help=f"Scene folder, or the name of a shipped scene: {SCENE_NAMES}. Default: the page begins "
                       "with the scenes to choose from."),
    ] = None,
    *,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on. The default is reached from this machine only; the page is not "
                     "encrypted, and who has its address can open and make scenes in all folders that you can, so use "
                     "another one in a network that you trust."),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0: a free one.", min=0, max=65535)] = 47880,
    pose: Annotated[
        str, typer.Option(help="E,N,U,YAW,PITCH,ROLL of the first view: metres, U above the ground, and degrees.")
    ] = "",
    quality: Annotated[str, typer.Option(help="fast, standard or high: sampling of pixels and light.")] = "fast",
    device: Device = "auto",
) -> None:  # fmt: skip
    """Open or import a scene in the browser, edit its materials and see the frame change, until Ctrl-C."""
    try:
        import nicegui  # noqa: F401
    except ImportError:
        raise ThermorenderError(
            "the studio needs NiceGUI; install it with `pip install 'thermorender[studio]'`"
        ) from None
    from thermorender.apps.link.access import listening
    from thermorender.apps.studio.app import run
    from thermorender.apps.studio.opening import Studio
    from thermorender.render.quality import QUALITIES

    if quality not in QUALITIES:
        raise ThermorenderError(f"quality={quality!r} is unknown; give one of {', '.join(QUALITIES)}")
    if pose and scene is None:
        raise ThermorenderError(f"pose={pose!r} is of the first view of a scene; give the scene too, or leave it out")
    with listening(host, port) as socket:
        studio = Studio(quality, device)
        if scene is not None:
            with progress() as report:
                studio.open(scene, report, pose)
        for note in studio.notes:
            typer.echo(f"note: {note}", err=True)
        end_on_signals(signal.default_int_handler)
        announce = "open {} in a browser; stop with Ctrl-C".format
        run(studio, socket, host, lambda address: typer.echo(announce(address)), partial(typer.echo, err=True))
