"""The web application of the studio: its routes, how it is served, and who may use it."""

import asyncio
import contextlib
import hmac
import re
import secrets
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

import uvicorn
from fastapi import FastAPI, Response
from nicegui import run as nicegui_run
from nicegui import ui
from starlette.datastructures import Headers
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from thermorender.apps.studio import leaving, scene_list
from thermorender.apps.studio.connections import Connection
from thermorender.apps.studio.opening import Studio, Work
from thermorender.apps.studio.page import Tab
from thermorender.apps.studio.pictures import outline_of
from thermorender.apps.studio.spectrum import MOST_BYTES
from thermorender.apps.studio.start import Start
from thermorender.errors import ThermorenderError

if TYPE_CHECKING:
    import socket

_LEAVES_S = 3
# Time for the files of the listed scenes to be read, which may be on a network [s].
_LISTS_S = 20.0
_LOCAL = ("127.0.0.1", "localhost", "[::1]")
_NOT_KEPT = {"cache-control": "no-store"}


class Guard:
    """An ASGI application in front of another one, which refuses what does not come from the studio's own page. A host
    that other machines reach admits every host name.
    """

    def __init__(self, app: ASGIApp, token: str, host: str, port: int) -> None:
        # A cookie of the port, since a browser sends the cookies of all ports of an address.
        self._app, self._token, self._cookie = app, token, f"thermorender_studio_{port}"
        self._names = _LOCAL if host in (*_LOCAL, "::1") else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or a websocket, or refuse it with a sentence."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        asked, web = HTTPConnection(scope), scope["type"] == "http"
        answer: ASGIApp = self._app
        if fault := self._fault(asked.headers):
            answer = PlainTextResponse(f"{fault}\n", 403, _NOT_KEPT)
        elif web and self._is_token(asked.query_params.get("token", "")):
            # The token goes into a cookie, and out of the address.
            answer = RedirectResponse("/", 303, _NOT_KEPT)
            answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
        elif not self._is_token(asked.cookies.get(self._cookie, "")):
            fault = "the token is missing or wrong; open the address that thermorender printed"
            answer = PlainTextResponse(f"{fault}\n", 403, _NOT_KEPT)
        elif web and int(asked.headers.get("content-length") or 0) > MOST_BYTES:
            fault = f"the file is larger than {MOST_BYTES // 1_000_000} MB; give a smaller one"
            answer = PlainTextResponse(f"{fault}\n", 413, _NOT_KEPT)
        await answer(scope, _limited(receive) if web else receive, send)

    def _fault(self, headers: Headers) -> str:
        """Why the addresses of a request are not the studio's; "" if they are."""
        host, origin = headers.get("host", ""), headers.get("origin")
        # Browsers leave out port 80.
        if self._names is not None and re.sub(r":\d+$", "", host) not in self._names:
            return f"host {host[:80]!r} is not the studio's; open the address that thermorender printed"
        if origin not in (None, f"http://{host}", f"https://{host}"):
            return f"origin {str(origin)[:80]!r} is not the studio's page; open the address that thermorender printed"
        return ""

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())


def _limited(receive: Receive) -> Receive:
    """`receive` that ends a body without a stated length where it becomes too long."""
    count = 0

    async def limited() -> Message:
        nonlocal count
        message = await receive()
        count += len(message.get("body", b""))
        return message if count <= MOST_BYTES else {"type": "http.disconnect"}

    return limited


def run(
    studio: Studio, listening: "socket.socket", host: str, announce: Callable[[str], object],
    say: Callable[[str], object],
) -> None:  # fmt: skip
    """Serve the studio until it is ended; `announce` gets the address that a browser opens, `say` what Ctrl-C asks."""
    token, port = secrets.token_urlsafe(24), int(listening.getsockname()[1])
    config = uvicorn.Config(
        Guard(_application(studio), token, host, port), http=Connection, log_level="error", access_log=False,
        lifespan="on", timeout_graceful_shutdown=_LEAVES_S, ws_max_size=4_000_000, server_header=False,
    )  # fmt: skip
    reached = "127.0.0.1" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    announce(f"http://{reached}:{port}/?token={token}")
    sys.stdout.flush()
    try:
        with contextlib.suppress(KeyboardInterrupt, asyncio.CancelledError):
            leaving.Server(config, studio, say).run(sockets=[listening])
    finally:
        studio.end()


def _application(studio: Studio) -> FastAPI:
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

    @app.get("/")
    def first() -> Response:
        return RedirectResponse(leaving.SCENE if studio.session or studio.busy else "/scenes", 303, _NOT_KEPT)

    @app.get("/frame/{tab}/{number}")
    async def frame(tab: str, number: int) -> Response:
        picture = studio.session.renders.fetch(tab) if studio.session else None
        # A later picture has its own number, under which the page asks for it.
        if picture is None or picture.number != number:
            return Response(status_code=404)
        return Response(picture.data, media_type=picture.kind, headers=_NOT_KEPT)

    @app.get("/other/{tab}/{number}")
    async def other(tab: str, number: int) -> Response:
        _, picture = studio.session.renders.shown(tab) if studio.session else (None, None)
        if picture is None or picture.number != number or not picture.other:
            return Response(status_code=404)
        return Response(picture.other, media_type=picture.kind, headers=_NOT_KEPT)

    @app.get("/outline/{tab}/{number}/{name}")
    def outline(tab: str, number: int, name: str) -> Response:
        shot, picture = studio.session.renders.shown(tab) if studio.session else (None, None)
        if shot is None or picture is None or picture.number != number:
            return Response(status_code=404)
        return Response(outline_of(shot, name), media_type="image/png", headers=_NOT_KEPT)

    @app.get("/picture")
    def picture(scene: str) -> Response:
        try:
            return Response(studio.listed[scene].picture(), media_type="image/jpeg", headers=_NOT_KEPT)
        except (KeyError, OSError, ThermorenderError):
            return Response(status_code=404)

    async def start(followed: Work | None = None, told: str = "") -> None:
        shipped, recent = await nicegui_run.io_bound(scene_list.listed) or ([], [])
        studio.listed = {str(each.folder): each for each in (*shipped, *recent)}
        Start(studio, shipped, recent, followed, told)

    @ui.page("/scenes", title="thermorender studio", response_timeout=_LISTS_S, dark=None)
    async def scenes(request: Request) -> None:
        await start(told=studio.told if "closed" in request.query_params else "")

    # Its query says what a tab shows.
    @ui.page(leaving.SCENE, title="thermorender studio", response_timeout=_LISTS_S, dark=None)
    async def scene(request: Request) -> Response | None:
        work, session = studio.busy, studio.session
        if session is not None:
            ui.page_title(f"{session.base.name} – thermorender studio")
            Tab(session, studio.pose, request.query_params)
            leaving.watch(session)
        elif work is not None:
            await start(followed=work)
        else:
            return RedirectResponse("/scenes", 303, _NOT_KEPT)
        return None

    ui.run_with(
        app, binding_refresh_interval=None, reconnect_timeout=30.0, tailwind=False, show_welcome_message=False,
        favicon="🌡️",
    )  # fmt: skip
    return app
