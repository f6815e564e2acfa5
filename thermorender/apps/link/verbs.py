"""The verb `serve`: frames to a simulator."""

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermorender import files
from thermorender.cli.options import (
    Device,
    SamplingOptions,
    SceneName,
    SceneOptions,
    TemperatureOptions,
    flat,
    print_cache_note,
)
from thermorender.cli.process import end_on_signals
from thermorender.cli.terminal import output_option, progress

if TYPE_CHECKING:
    from thermorender.apps.link.server import Server


@flat
def serve(
    scene: SceneName,
    *,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on. The default is reached from this machine only; the link is not "
                     "encrypted, so use another one in a network that you trust."),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0: a free one.", min=0, max=65535)] = 47800,
    token_file: Annotated[
        Path | None,
        output_option("--token-file", help="File for the token that clients need, readable by its owner only. Default: "
                      "in the cache folder, where a client of the same user finds it.", check=files.check_output_file),
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option(help="Another camera that clients may choose, name or file; repeat for more.")
    ] = None,
    map: Annotated[
        list[str] | None, typer.Option(help="Learned map for methods B and C, name or file; repeat for more.")
    ] = None,
    airsim: Annotated[
        int | None,
        typer.Option(help="Also answer calls of AirSim's Python clients, on this port of this machine; 41451 is "
                     "AirSim's. Its calls have no token: any program of this machine can make them.", min=0, max=65535),
    ] = None,
    view: Annotated[
        int | None,
        typer.Option(help="Also show the frames to a browser or player, on this port of this machine; 0: a free one. "
                     "The printed address holds a token.", min=0, max=65535),
    ] = None,
    mavlink: Annotated[
        str | None,
        typer.Option(help="Also send the thermal range of each frame as MAVLink, e.g. to udpout:127.0.0.1:14550."),
    ] = None,
    situation: SceneOptions,
    source: TemperatureOptions,
    sampling: SamplingOptions,
    device: Device = "auto",
) -> None:  # fmt: skip
    """Serve frames to a simulator over a socket, pose by pose, until Ctrl-C."""
    from thermorender import load_camera
    from thermorender.apps.link.access import drop_token, listening, new_token
    from thermorender.apps.link.access import token_file as default_file
    from thermorender.apps.link.bridges.listener import HOST
    from thermorender.apps.link.server import Server
    from thermorender.apps.link.stage import Stage

    for number, of in ((port, host), (airsim, HOST), (view, HOST)):
        if number:
            # An occupied port is found before the scene is loaded.
            listening(of, number).close()
    cameras = {each.name: each for each in (load_camera(name, "--camera") for name in camera or ())}
    with progress() as report:
        loaded = situation.load(scene, source.source())
        renderer = sampling.renderer(loaded, 0, device, report)
        renderer.prepare()
    print_cache_note(renderer)
    stage = Stage(renderer, cameras, tuple(map or ()))
    for note in stage.notes:
        typer.echo(f"note: {note}", err=True)
    server = Server(stage, host, port)
    kept = token_file or default_file(server.address, server.port)
    end_on_signals(signal.default_int_handler)
    bridges: list[Any] = []
    try:
        server.token = new_token(kept)
        _bridge(bridges, server, host, airsim, view, mavlink)
        typer.echo(f"serving {loaded.name} on {host} port {server.port}; the token is in {kept}; stop with Ctrl-C")
        server.run()
    except KeyboardInterrupt:
        pass  # Ctrl-C or SIGTERM is how the service ends; what it holds is released below.
    finally:
        for bridge in bridges:
            bridge.stop()
        drop_token(kept, server.token)
        typer.echo(f"stopped after {server.answered} frames")


def _bridge(
    made: list[Any], server: "Server", host: str, airsim: int | None, view: int | None, mavlink: str | None
) -> None:
    """Start the bridges that are asked for, and put them into a list."""
    if airsim is not None:
        from thermorender.apps.link.bridges.airsim import Bridge

        reached = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        made.append(Bridge(airsim, server.port, server.token, reached))
        made[-1].start()
        typer.echo(f"AirSim's calls are answered on 127.0.0.1 port {made[-1].port}, without a token")
    if view is not None:
        from thermorender.apps.link.bridges.view import View

        made.append(View(view))
        made[-1].start()
        server.watchers.append(made[-1].show)
        typer.echo(f"look at {made[-1].address}")
    if mavlink is not None:
        from thermorender.apps.link.bridges.mavlink import ThermalRange

        made.append(ThermalRange(mavlink))
        server.watchers.append(made[-1].show)
