"""Who may use the studio: a token, the addresses it is reached by, and the size of what a browser sends."""

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import parse_qs

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

# Of a port, since a browser sends the cookies of all ports of an address.
COOKIE = "thermorender_studio_{}"
# Longest body of a request: a spectrum file is far shorter.
MOST_BYTES = 2_000_000
_LOCAL = ("127.0.0.1", "localhost", "[::1]")


class Guard:
    """An ASGI application in front of another one, which refuses what does not come from the studio's own page.

    Parameters
    ----------
    app : ASGI application
    token : str
    host : str
        Address that is listened on. One that is reached from other machines admits every host name.
    port : int
    """

    def __init__(self, app: App, token: str, host: str, port: int) -> None:
        self._app, self._token, self._cookie = app, token, COOKIE.format(port)
        self._names = _LOCAL if host in (*_LOCAL, "::1") else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or a websocket, or refuse it with a sentence."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = {key.decode("latin-1").lower(): value.decode("latin-1") for key, value in scope["headers"]}
        if fault := self._fault(headers):
            await _refuse(scope, send, 403, fault)
            return
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if given and scope["type"] == "http" and self._is_token(given):
            await self._welcome(scope, send)
            return
        if not self._is_token(_cookie(headers.get("cookie", ""), self._cookie)):
            await _refuse(scope, send, 403, "the token is missing or wrong; open the address that thermorender printed")
            return
        if scope["type"] == "http" and int(headers.get("content-length", "0") or 0) > MOST_BYTES:
            await _refuse(scope, send, 413, f"the file is larger than {MOST_BYTES // 1_000_000} MB; give a smaller one")
            return
        await self._app(scope, _limited(receive) if scope["type"] == "http" else receive, send)

    def _fault(self, headers: dict[str, str]) -> str:
        """Why the addresses of a request are not the studio's; "" if they are."""
        host = headers.get("host", "")
        if self._names is not None and host.rpartition(":")[0] not in self._names:
            return f"host {host[:80]!r} is not the studio's; open the address that thermorender printed"
        origin = headers.get("origin")
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return f"origin {origin[:80]!r} is not the studio's page; open the address that thermorender printed"
        return ""

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())

    async def _welcome(self, scope: Scope, send: Send) -> None:
        """Keep the token in a cookie, and take it out of the address."""
        cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
        headers = [(b"location", b"/"), (b"set-cookie", cookie.encode()), (b"cache-control", b"no-store")]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


def _cookie(text: str, name: str) -> str:
    """The value of a cookie; those that other programs set at this address may have any form."""
    pairs = (pair.strip().partition("=") for pair in text.split(";"))
    return next((value for key, _, value in pairs if key == name), "")


def _limited(receive: Receive) -> Receive:
    """`receive` that ends a body without a stated length where it becomes too long."""
    count = 0

    async def limited() -> Message:
        nonlocal count
        message = await receive()
        count += len(message.get("body", b""))
        return message if count <= MOST_BYTES else {"type": "http.disconnect"}

    return limited


async def _refuse(scope: Scope, send: Send, status: int, sentence: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": sentence[:120]})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"cache-control", b"no-store")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": f"{sentence}\n".encode()})
