"""The verb that serves frames to a simulator."""

import signal
from pathlib import Path
from typing import Annotated

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
from thermorender.cli.terminal import output_option, progress


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
    situation: SceneOptions,
    source: TemperatureOptions,
    sampling: SamplingOptions,
    device: Device = "auto",
) -> None:  # fmt: skip
    """Serve frames to a simulator over a socket, pose by pose, until Ctrl-C."""
    from thermorender.link.access import drop_token, new_token
    from thermorender.link.access import token_file as default_file
    from thermorender.link.server import Server
    from thermorender.link.stage import Stage
    from thermorender.sensor.camera import load_camera

    cameras = {each.name: each for each in (load_camera(name, "--camera") for name in camera or ())}
    with progress() as report:
        loaded = situation.load(scene, source.source())
        renderer = sampling.renderer(loaded, 0, device, report)
        _ = renderer.baked
    print_cache_note(renderer)
    stage = Stage(renderer, cameras, tuple(map or ()), sampling.settings() | {"device": device})
    server = Server(stage, host, port)
    kept = token_file or default_file(server.port)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        server.token = new_token(kept)
        typer.echo(f"serving {loaded.name} on {host} port {server.port}; the token is in {kept}; stop with Ctrl-C")
        server.run()
    except KeyboardInterrupt:
        pass
    finally:
        drop_token(kept, server.token)
        typer.echo(f"stopped after {server.answered} frames")
