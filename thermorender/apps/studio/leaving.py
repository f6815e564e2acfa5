"""Unsaved edits are not lost unasked: by closing the last tab, by the list of scenes, or by Ctrl-C in the terminal."""

import asyncio
import json
import signal
import weakref
from collections.abc import Callable
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING

import uvicorn
from nicegui import Client, ui

if TYPE_CHECKING:
    import socket

    from thermorender.apps.studio.opening import Studio
    from thermorender.apps.studio.session import Session

# The page of a scene.
SCENE = "/scene"
# Time for tabs to show that the studio ends [s].
_TOLD_S = 0.3
# The tabs of the scene, also those whose connection may come back.
_TABS = weakref.WeakSet[Client]()
SCRIPT = """
// Set by the server: edits are unsaved, and this is the last tab that shows them.
studio.unsaved = false;
addEventListener("beforeunload", (e) => { if (studio.unsaved) e.preventDefault(); });
"""


def mark(session: "Session") -> None:
    """Let the browser ask before the last tab with unsaved edits is closed, and no other one."""
    shown = [client for client in _TABS if client.has_socket_connection]
    asks = json.dumps(len(shown) == 1 and session.unsaved)
    for client in shown:
        client.run_javascript(f"studio.unsaved = {asks}")


def watch(session: "Session") -> None:
    """Mark the tabs again when that of this page comes or goes."""
    client = ui.context.client
    _TABS.add(client)
    ui.add_head_html(f"<script>{SCRIPT}</script>")
    client.on_connect(lambda: mark(session))
    client.on_disconnect(lambda: mark(session))


def scenes_link(session: "Session") -> None:
    """A link to the list of scenes, which asks first where this is the last tab with unsaved edits."""

    async def ask() -> None:
        with ui.dialog() as dialog, ui.card():
            ui.label(f"{session.base.name} has unsaved edits. They stay until another scene is opened or the studio "
                     "ends.")  # fmt: skip
            with ui.row():
                ui.button("Show the scenes", on_click=lambda: dialog.submit(True)).props('data-testid="leave"')
                ui.button("Stay", on_click=lambda: dialog.submit(False)).props("flat")
        if await dialog:
            _send(ui.context.client, "/scenes")

    link = ui.link("Scenes", "/scenes").style("color: inherit").props('data-testid="scenes"')
    link.on("click", ask, js_handler="(e) => { if (studio.unsaved) { e.preventDefault(); emit(); } }")


def _send(client: Client, address: str) -> None:
    """Show another page in a tab, unasked."""
    client.run_javascript(f"studio.unsaved = false; location.assign({json.dumps(address)})")


def send_away() -> None:
    """Show the start page in all tabs of a scene that is closed, and keep nothing of the scene for them.

    The library keeps a page for a while after its tab has left it.
    """
    for client in list(_TABS):
        _send(client, "/scenes?closed")
        for handler in client.delete_handlers:
            client.safe_invoke(handler)
        for handlers in (client.connect_handlers, client.disconnect_handlers, client.delete_handlers):
            handlers.clear()
        client.remove_all_elements()
        _TABS.discard(client)


class Server(uvicorn.Server):
    """The server of a studio. The first Ctrl-C with unsaved edits asks in the terminal; the next one, and any other
    signal, ends the studio, and its tabs say so.
    """

    def __init__(self, config: uvicorn.Config, studio: "Studio", say: Callable[[str], object]) -> None:
        super().__init__(config)
        self._studio, self._say = studio, say
        # The session and the version of the edits that were asked about.
        self._asked: object = None

    async def startup(self, sockets: "list[socket.socket] | None" = None) -> None:
        """Listen."""
        self._studio.leave = partial(asyncio.get_running_loop().call_soon_threadsafe, send_away)
        await super().startup(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """End at a signal, or ask first."""
        if self.should_exit:
            super().handle_exit(sig, frame)
        else:
            asyncio.get_running_loop().call_soon_threadsafe(self._end, sig, frame)

    def _end(self, sig: int, frame: FrameType | None) -> None:
        session = self._studio.session
        if sig == signal.SIGINT and session is not None and session.unsaved:
            now, unsaved = (weakref.ref(session), session.history.version), f"unsaved edits of {session.base.name}"
            if self._asked != now:
                self._asked = now
                self._say(f"{unsaved}: press Ctrl-C again to end without saving")
                _tell(f"{unsaved}: the terminal ends the studio without saving at the next Ctrl-C", "warning")
                return
        asyncio.get_running_loop().call_later(_TOLD_S, super().handle_exit, sig, frame)
        for client in _TABS:
            client.run_javascript("studio.unsaved = false")
        _tell("the studio has ended; start it again in the terminal, which prints a new address", "info")


def _tell(sentence: str, kind: str) -> None:
    """Show a sentence in all tabs."""
    for client in list(Client.instances.values()):
        if client.has_socket_connection:
            with client:
                ui.notify(sentence, type=kind, position="top", multi_line=True, timeout=0, close_button="Close")  # type: ignore[arg-type]
