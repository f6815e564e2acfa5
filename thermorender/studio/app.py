"""The web application of the studio: its routes, and how it is served."""

import asyncio
import contextlib
import secrets
import sys
from typing import TYPE_CHECKING, Any

from thermorender.errors import ThermorenderError
from thermorender.studio.access import Guard

if TYPE_CHECKING:
    import socket
    from pathlib import Path

    from thermorender.render.renderer import Renderer

_LEAVES_S = 3


def refuse_missing() -> None:
    """Raise unless the libraries of the extra are installed."""
    try:
        import nicegui  # noqa: F401
    except ImportError:
        raise ThermorenderError(
            "the studio needs NiceGUI; install it with `pip install 'thermorender[studio]'`"
        ) from None


def run(
    renderer: "Renderer", files: "dict[Path, str]", listening: "socket.socket", host: str, pose: str, quality: str,
    announce: Any,
) -> None:  # fmt: skip
    """Serve the studio until Ctrl-C.

    Parameters
    ----------
    renderer : Renderer
    files : dict
        `thermorender.studio.saving.snapshot` of its scene, from when it was loaded.
    listening : socket
        Of `thermorender.link.access.listening`.
    host : str
        Its address.
    pose : str
        E,N,U,YAW,PITCH,ROLL of the first view.
    quality : str
        Of the renderer.
    announce : callable (address)
        Called with the address that a browser opens.
    """
    import uvicorn

    from thermorender.studio.session import Session

    token, port = secrets.token_urlsafe(24), int(listening.getsockname()[1])
    session = Session(renderer, quality, files)
    app = _application(session, pose)
    config = uvicorn.Config(
        Guard(app, token, host, port), log_level="error", access_log=False, lifespan="on",
        timeout_graceful_shutdown=_LEAVES_S, ws_max_size=4_000_000, server_header=False,
    )  # fmt: skip
    reached = "127.0.0.1" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    session.renders.start()
    announce(f"http://{reached}:{port}/?token={token}")
    sys.stdout.flush()
    try:
        with contextlib.suppress(KeyboardInterrupt, asyncio.CancelledError):
            uvicorn.Server(config).run(sockets=[listening])
    finally:
        session.close()


def _application(session: Any, pose: str) -> Any:
    from fastapi import FastAPI, Response
    from nicegui import ui

    from thermorender.studio.page import Tab

    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

    @app.get("/frame/{tab}/{number}")
    async def frame(tab: str, number: int) -> Response:
        picture = session.renders.fetch(tab)
        if picture is None or not picture.data:
            return Response(status_code=404)
        return Response(picture.data, media_type=picture.kind, headers={"cache-control": "no-store"})

    @app.get("/map/{layer}/{version}/{percent}")
    def map_of(layer: str, version: int, percent: int) -> Response:
        from thermorender.studio.ground import map_picture

        return Response(
            map_picture(session, percent, layer), media_type="image/jpeg", headers={"cache-control": "no-store"}
        )

    @ui.page("/", title=f"{session.base.name} – thermorender studio", reconnect_timeout=30.0)
    def page() -> None:
        Tab(session, pose)

    ui.run_with(
        app, binding_refresh_interval=None, reconnect_timeout=30.0, tailwind=False, show_welcome_message=False,
        favicon="🌡️",
    )  # fmt: skip
    return app
