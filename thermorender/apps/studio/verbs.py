"""The verb `studio`: materials edited in the browser."""

import signal
from typing import Annotated

import typer

from thermorender.cli.options import Device, SceneName, flat, print_cache_note
from thermorender.cli.process import end_on_signals
from thermorender.cli.terminal import progress
from thermorender.errors import ThermorenderError


@flat
def studio(
    scene: SceneName,
    *,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on. The default is reached from this machine only; the page is not "
                     "encrypted, so use another one in a network that you trust."),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0: a free one.", min=0, max=65535)] = 47880,
    pose: Annotated[
        str, typer.Option(help="E,N,U,YAW,PITCH,ROLL of the first view: metres, U above the ground, and degrees.")
    ] = "",
    quality: Annotated[str, typer.Option(help="fast, standard or high: sampling of pixels and light.")] = "fast",
    device: Device = "auto",
) -> None:  # fmt: skip
    """Edit the materials of a scene in the browser, and see the frame change, until Ctrl-C."""
    try:
        import nicegui  # noqa: F401
    except ImportError:
        raise ThermorenderError(
            "the studio needs NiceGUI; install it with `pip install 'thermorender[studio]'`"
        ) from None
    from thermorender import Renderer, load_scene
    from thermorender.apps.link.access import listening
    from thermorender.apps.studio.app import run
    from thermorender.apps.studio.scene_files import SceneFiles
    from thermorender.apps.studio.view import Pose

    with listening(host, port) as socket:
        with progress() as report:
            loaded = load_scene(scene)
            loaded.refuse_tiles("the studio")
            # Before the light is traced, which takes seconds in which a file may change.
            files = SceneFiles(loaded)
            if pose:
                Pose.typed(pose, loaded, "--pose")
            renderer = Renderer(loaded, quality, device=device, progress=report, edits=True)  # type: ignore[arg-type]
            _ = renderer.baked
        print_cache_note(renderer)
        end_on_signals(signal.default_int_handler)
        announce = "open {} in a browser; stop with Ctrl-C".format
        run(renderer, files, socket, host, pose, quality, lambda address: typer.echo(announce(address)))
