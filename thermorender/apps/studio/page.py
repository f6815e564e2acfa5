"""The page of a tab: its layout, what it knows of the edits, and what connects it with the session."""

import asyncio
import contextlib
import json
import secrets
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import ui

from thermorender.apps.studio import leaving
from thermorender.apps.studio.address import query_of, view_at
from thermorender.apps.studio.editor import Editor
from thermorender.apps.studio.panels import VERSION
from thermorender.apps.studio.session import Outdated, Session, extent
from thermorender.apps.studio.stage import Stage
from thermorender.apps.studio.view import Pose, View
from thermorender.errors import ThermorenderError

_FOLDER = Path(__file__).parent
_STYLES, _SCRIPTS = ("studio.css",), ("state.js", "hand.js", "spectrum.js")
# The tables follow the picture of an edit, which their own work in the browser would delay; at most so long after the
# edit [s].
_LATEST_S = 0.5


def first_pose(session: Session) -> str:
    """Return the pose of the first view: over the middle of the terrain, from the south at 45°."""
    low, high = extent(session.base)
    side = float((high - low).min())
    east, north = 0.5 * (low + high)
    return f"{east + 0.0:.0f},{north - 0.4 * side:.0f},{0.4 * side:.0f},0,-45,0".replace("-0,", "0,", 1)


class Tab:
    """A tab of the browser; its first view is at `pose`, E,N,U,YAW,PITCH,ROLL, or "" for one from the south, unless the
    address names another one.
    """

    def __init__(self, session: Session, pose: str, query: Mapping[str, str]) -> None:
        self.session, self.key = session, secrets.token_hex(8)
        self._client, self._loop = ui.context.client, asyncio.get_running_loop()
        # The view of an address that states none.
        self.first = View(Pose.typed(pose or first_pose(session), session.base))
        # A timer of the tables where an edit does not show there yet, and the version that they show.
        self._behind: asyncio.TimerHandle | None = None
        self._seen = -1
        self.dark = False  # whether charts are drawn for a dark page
        style = "".join((_FOLDER / name).read_text("utf-8") for name in _STYLES)
        script = "".join((_FOLDER / name).read_text("utf-8") for name in _SCRIPTS)
        ui.add_head_html(f"<style>{style}</style><script>{script}</script>")
        ui.query("html").props('lang="en"')
        with ui.element("div").classes("studio"):
            self._header()
            with ui.element("section").classes("left").props('aria-label="Materials"') as left:
                pass
            with ui.element("section").classes("middle").props('aria-label="View"'):
                self.stage = Stage(self, self._view_at(query))
            with ui.element("section").classes("right").props('aria-label="Properties"') as right:
                pass
        self.editor = Editor(self, left, right)
        self.stage.refresh()
        for name, handler in (
            ("step", self._stepped),
            ("heard", self._heard),
            ("address", self._addressed),
            ("theme", self._themed),
        ):
            ui.on(f"studio_{name}", handler)
        session.tabs.append(self)
        self._client.on_connect(self._connected)
        self._client.on_delete(self._leave)
        ui.colors(primary="#0b6377")
        self.refresh()
        self.editor.choose(query.get("material", ""))

    # What the session calls.

    def changed(self, by: str) -> None:
        """Take note of a version of the edits that the tab `by` made; the tables show it after its picture.

        Until then, what this tab sends counts as based on the version before, unless the edit is its own.
        """
        version = self.session.history.version
        own = by == self.key
        self.later(self._expect)(version, own)

    def _expect(self, version: int, own: bool) -> None:
        ui.run_javascript(f"studio.at({version})")
        if own:
            self._see(version)
        if self._behind is None:
            self._behind = self._loop.call_later(_LATEST_S, self._inside, self.refresh)

    def saved(self) -> None:
        """Take note of what is saved now."""
        self.refresh()
        if self.stage.view.against == "saved":
            self.stage.look()

    def refresh(self) -> None:
        """Show the current version of the edits in the tables."""
        if self._behind is not None:
            self._behind.cancel()
            self._behind = None
        history = self.session.history
        self._see(history.version)
        with self._client:
            for (icon, button, tip), what in zip(self._steps, (history.undoes, history.redoes), strict=True):
                button.set_enabled(bool(what))
                tip.set_text(f"{icon.title()}: {what}" if what else f"Nothing to {icon}")
            self.editor.refresh()
            self.stage.refresh()

    @property
    def behind(self) -> bool:
        """Whether an edit does not show in the tables yet."""
        return self._behind is not None

    def _see(self, version: int) -> None:
        """Let what the page sends count as based on a version."""
        self._seen = version
        with self._client:
            ui.run_javascript(f"studio.version = {version}; studio.at({version})")
        leaving.mark(self.session)

    def edit(self, version: int, what: str, change: Callable[..., Any], quiet: bool = False) -> str:
        """Change the document; return the sentence of a refusal, else "", and show it unless `quiet` says who does."""
        return self.refused(partial(self.session.edit, version, what, change, self.key), quiet)

    def refused(self, act: Callable[[], object], quiet: bool = False) -> str:
        """Return the sentence of a refusal, else "", and show it unless `quiet` says who does."""
        try:
            act()
        except ThermorenderError as error:
            outdated = isinstance(error, Outdated)
            if outdated or not quiet:
                self.say(str(error))
            if outdated:
                self.refresh()
            return str(error)
        return ""

    def say(self, sentence: str, kind: str = "negative") -> None:
        """Show a sentence for a while."""
        with self._client:
            ui.notify(sentence, type=kind, position="bottom", multi_line=True, timeout=8000, close_button="Close")  # type: ignore[arg-type]

    def later(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap `function` so other threads may call it."""

        def call(*arguments: Any) -> None:
            # The loop is closed where the studio ends.
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._inside, function, *arguments)

        return call

    def after(self, seconds: float, function: Callable[[], Any]) -> asyncio.TimerHandle:
        """Call a function after a while, unless the tab has gone."""
        return self._loop.call_later(seconds, self._inside, function)

    def _inside(self, function: Callable[..., Any], *arguments: Any) -> None:
        if not self.closed:
            with self._client:
                function(*arguments)

    @property
    def closed(self) -> bool:
        """Whether the tab has gone."""
        return self._client.is_deleted

    def _connected(self) -> None:
        """Bring a page up to date, the first time and after its connection was lost.

        A page that is fetched and never connects costs no frame.
        """
        with self._client:
            ui.run_javascript(f"studio.setUp(); studio.version = {self._seen}")
            ui.run_javascript(f"studio.at({self.session.history.version})")
            self.stage.connected()
        self.remember()

    def _leave(self) -> None:
        self.session.renders.forget(self.key)
        if self in self.session.tabs:
            self.session.tabs.remove(self)

    # The address.

    def _view_at(self, query: Mapping[str, str]) -> View:
        return view_at(query, self.session.base, self.first, self.session.renders.learned is not None)

    def remember(self, new: bool = False) -> None:
        """Put view and material into the address; a `new` one is a step that the browser's Back takes back."""
        query = query_of(self.stage.view, self.session.base, self.editor.name)
        with self._client:
            ui.run_javascript(f"studio.address({json.dumps(query)}, {json.dumps(new)})")

    def _addressed(self, event: Any) -> None:
        query = {str(key): str(value) for key, value in dict(event.args).items()}
        self.stage.show(self._view_at(query), remember=False)
        self.editor.choose(query.get("material", ""))

    # The header.

    def _header(self) -> None:
        with ui.element("header").classes("bar"):
            ui.html('<a class="skip" href="#frame">To the picture</a><h1>Thermorender studio</h1>', sanitize=False)
            leaving.scenes_link(self.session)
            ui.label(f"{self.session.base.name} · {self.session.base.spec.title or 'untitled'}").classes("scene")
            # Written by the script, together with the picture.
            ui.html("", sanitize=False).classes("soft").props('id="version" data-testid="version"')
            ui.html("rendering …", sanitize=False).classes("state").props(
                'id="state" role="status" data-testid="state"'
            ).tooltip("exact: solved, no preview. Show the estimated error of the rendering for that of each pixel.")
            self._steps = []
            for by, icon in ((-1, "undo"), (1, "redo")):
                button = ui.button(icon=icon).props(f'flat dense round color=white data-testid="{icon}"')
                button.props(f'aria-label="{icon.title()}"')
                button.on("click", lambda e, by=by: self.step(int(e.args), by), js_handler=VERSION)
                with button:
                    self._steps.append((icon, button, ui.tooltip("")))
            with ui.button(icon="history").props('flat dense round color=white aria-label="Edits" data-testid="edits"'):
                ui.tooltip("Edits")
                self._edits = ui.menu().props('anchor="bottom right" self="top right"').classes("edits")
                self._edits.on_value_change(lambda e: self._list_edits() if e.value else None)

    def _list_edits(self) -> None:
        self._edits.clear()
        with self._edits:
            for version, what, steps in reversed(self.session.history.entries):
                item = ui.menu_item("").props(f'data-version="{version}"').classes("" if steps else "chosen")
                with item:
                    ui.label(f"{version} · {what or 'as read from the files'}")
                item.on("click", lambda e, steps=steps: self.step(int(e.args), steps), js_handler=VERSION)

    def step(self, version: int, by: int) -> None:
        """Undo or redo so many edits."""
        self.editor.drop_typed()
        self.refused(partial(self.session.step, version, by, self.key))

    def _stepped(self, event: Any) -> None:
        self.step(int(event.args["version"]), int(event.args["by"]))

    def _themed(self, event: Any) -> None:
        if bool(event.args) != self.dark:
            self.dark = bool(event.args)
            self.editor.refresh()
            self.stage.timeline.redraw()

    def _heard(self, event: Any) -> None:
        ui.run_javascript(f"studio.heard({int(event.args)})")
