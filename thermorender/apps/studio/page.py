"""The page of a tab: its layout, its view of the scene, and what it says of a pixel."""

import asyncio
import contextlib
import json
import math
import secrets
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from thermorender.apps.studio.editor import Editor
from thermorender.apps.studio.panels import VERSION, Map, sentence_of, show_legend
from thermorender.apps.studio.pictures import NAMES, Picture
from thermorender.apps.studio.renders import figures
from thermorender.apps.studio.session import Outdated, Session
from thermorender.apps.studio.timeline import Timeline
from thermorender.apps.studio.view import MODES, Pose, View, command, limits_of
from thermorender.errors import ThermorenderError
from thermorender.render.pixels.parts import PixelParts

_FOLDER = Path(__file__).parent
# Degrees of an orbit over the width of the picture.
_TURN_DEG = 120.0
_TICKS = 5
# Words and tables follow their picture, which their own work in the browser would delay: so long after it, and the
# tables no later than this after an edit [s].
_AFTER_S, _LATEST_S = 0.06, 0.5
# Parts of a pixel's radiance, in words.
_ORIGINS = {
    "emission": "Emission", "sky": "Reflected sky", "sun": "Reflected sun", "surroundings": "Reflected surroundings",
    "air": "Air in between", "background": "Background",
}  # fmt: skip


def first_pose(session: Session) -> str:
    """Return the pose of the first view: over the middle of the terrain, from the south at 45°."""
    base = session.base
    corner = np.concatenate([each.vertices[each.faces[:, 0], :2] for each in base.near_ground])
    # Of nearly all faces: a few large ones may reach to the horizon.
    low, high = np.quantile(corner, (0.05, 0.95), axis=0)
    side = float((high - low).min()) / 0.9
    return f"0,{-0.4 * side:.0f},{0.4 * side:.0f},0,-45,0"


class Tab:
    """A tab of the browser; its first view is at `pose`, E,N,U,YAW,PITCH,ROLL, or "" for one from the south."""

    def __init__(self, session: Session, pose: str) -> None:
        self.session, self.key = session, secrets.token_hex(8)
        self._client, self._loop = ui.context.client, asyncio.get_running_loop()
        self.view = View(Pose.typed(pose or first_pose(session), session.base))
        self.pixel: tuple[int, int] | None = None
        self._under: tuple[int, int] | None = None  # the pixel under the pointer
        self._picture: Picture | None = None
        # Timers of the words of a picture, and of the tables where an edit does not show there yet.
        self._wordless: asyncio.TimerHandle | None = None
        self._behind: asyncio.TimerHandle | None = None
        # The version of the edits that the tab has seen.
        self._seen = -1
        ui.add_head_html(f"<style>{(_FOLDER / 'studio.css').read_text('utf-8')}</style>")
        ui.add_head_html(f"<script>{(_FOLDER / 'studio.js').read_text('utf-8')}</script>")
        ui.query("html").props('lang="en"')
        with ui.element("div").classes("studio"):
            self._header()
            with ui.element("section").classes("left").props('aria-label="Materials"'):
                left = ui.element("div").classes("left").style("flex:1;min-height:0")
            with ui.element("section").classes("middle").props('aria-label="View"'):
                self._tools()
                with ui.element("div") as self._camera_box:
                    self._stage()
                    self._below()
                with ui.element("div").classes("mapside") as self._map_box:
                    self.map = Map(self)
            with ui.element("section").classes("right").props('aria-label="Properties"'):
                right = ui.element("div").classes("right").style("flex:1;min-height:0")
            self.editor = Editor(self, left, right)
            self._map_box.set_visibility(False)
        for name, handler in (("move", self._move), ("hover", self._hover), ("pick", self._pick)):
            ui.on(f"studio_{name}", handler)
        session.tabs.append(self)
        self._client.on_connect(self._connected)
        self._client.on_delete(self._leave)
        ui.colors(primary="#0b6377")
        self.refresh()

    # What the session and the renders call.

    def changed(self, by: str) -> None:
        """Take note of a version of the edits that the tab `by` made; the tables show it after its picture.

        Until then, what this tab sends counts as based on the version before, unless the edit is its own.
        """
        version = self.session.history.version
        if by == self.key and self._seen == version - 1:
            self._see(version)
        if self._behind is None:
            self._behind = self._loop.call_later(_LATEST_S, self._inside, self.refresh)

    def refresh(self) -> None:
        """Show the current version of the edits."""
        if self._behind is not None:
            self._behind.cancel()
            self._behind = None
        history = self.session.history
        self._see(history.version)
        with self._client:
            for (icon, button, tip), what in zip(self._steps, (history.undoes, history.redoes), strict=True):
                button.set_enabled(bool(what))
                tip.set_text(f"{icon.title()}: {what}" if what else f"Nothing to {icon}")
            self._version.set_text(f"version {history.version}")
            self.editor.refresh()
            if self.view.mode == "map":
                self.map.refresh()

    def _see(self, version: int) -> None:
        """Let what the page sends count as based on a version."""
        self._seen = version
        with self._client:
            ui.run_javascript(f"studio.version = {version}")

    def look(self) -> None:
        """Ask for a picture of the view."""
        self.session.renders.look(self.key, self.view, self.later(self._shown))

    def edit(self, version: int, what: str, change: Callable[..., Any], quiet: bool = False) -> str:
        """Change the document; return the sentence of a refusal, else "", and show it unless `quiet` says who does."""
        return self._refused(partial(self.session.edit, version, what, change, self.key), quiet)

    def _refused(self, act: Callable[[], object], quiet: bool = False) -> str:
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
        """`function`, to be called from another thread."""

        def call(*arguments: Any) -> None:
            # The loop is closed where the studio ends.
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._inside, function, *arguments)

        return call

    def _inside(self, function: Callable[..., Any], *arguments: Any) -> None:
        if not self._client.is_deleted:
            with self._client:
                function(*arguments)

    @property
    def closed(self) -> bool:
        """Whether the tab has gone."""
        return self._client.is_deleted

    @property
    def shown(self) -> int:
        """The number of the latest picture."""
        return self._picture.number if self._picture else 0

    def _connected(self) -> None:
        """Bring a page up to date, the first time and after its connection was lost.

        A page that is fetched and never connects costs no frame.
        """
        with self._client:
            ui.run_javascript(f"studio.setUp(); studio.version = {self._seen}")
            if self._picture:
                self._send(self._picture)
            else:
                self.look()

    def _leave(self) -> None:
        self.session.renders.forget(self.key)
        if self in self.session.tabs:
            self.session.tabs.remove(self)

    # The parts of the page.

    def _header(self) -> None:
        with ui.element("header").classes("bar"):
            ui.html("<h1>Material studio</h1>", sanitize=False)
            ui.label(f"{self.session.base.name} · {self.session.base.spec.title or 'untitled'}").classes("scene")
            # Written by the script, together with the picture.
            ui.html("rendering …", sanitize=False).classes("state").props(
                'id="state" role="status" data-testid="state"'
            )
            self._version = ui.label("").classes("soft").style("color:#c3d3df").props('data-testid="version"')
            self._steps = []
            for by, icon in ((-1, "undo"), (1, "redo")):
                button = ui.button(icon=icon).props(f'flat dense round color=white data-testid="{icon}"')
                button.props(f'aria-label="{icon.title()}"')
                button.on("click", lambda e, by=by: self._step(int(e.args), by), js_handler=VERSION)
                with button:
                    self._steps.append((icon, button, ui.tooltip("")))

    def _step(self, version: int, by: int) -> None:
        self.editor.drop_typed()
        self._refused(partial(self.session.step, version, by, self.key))

    def _tools(self) -> None:
        with ui.element("div").classes("tools"):
            mode = ui.select(MODES, value="apparent", label="Show").props('dense outlined data-testid="mode"')
            mode.style("width:228px").on_value_change(lambda e: self._set(mode=e.value))
            with ui.element("div").classes("row") as self._colour_tools:
                colours = ui.select(list(NAMES), value=self.view.palette, label="Palette").props("dense outlined")
                colours.style("width:122px").on_value_change(lambda e: self._set(palette=e.value))
                self._ends = [
                    ui.input(label, placeholder="auto").props(f'dense outlined data-testid="{key}"').style("width:66px")
                    for label, key in (("From", "low"), ("To", "high"))
                ]
                for each in self._ends:
                    each.on("change", self._fixed)
                for icon, says, now in (("lock", "Fix the range", True), ("lock_open", "Automatic range", False)):
                    button = ui.button(icon=icon, on_click=lambda now=now: self._fix(now))
                    button.props(f'flat dense aria-label="{says}"').tooltip(says)

    def _fix(self, now: bool) -> None:
        shown = self._picture if now else None
        given = shown.ends if shown and shown.ends and shown.unit == "K" else None
        for k, each in enumerate(self._ends):
            each.set_value(f"{given[k]:.1f}" if given else "")
        self._fixed()

    def _fixed(self) -> None:
        low, high = (each.value or "" for each in self._ends)
        try:
            self._set(limits=limits_of(low, high))
        except ThermorenderError as error:
            if low.strip() and high.strip():
                self.say(str(error))

    def _stage(self) -> None:
        camera = self.session.base.camera
        with ui.element("div").classes("view"):
            with ui.element("div").classes("stage").style(f"--ratio:{camera.width}/{camera.height}"):
                ui.element("img").props(
                    'id="frame" data-testid="frame" tabindex="0" draggable="false" alt="The scene as the camera sees '
                    'it. Drag to orbit, with Shift to pan, wheel to zoom; arrow keys, + and − do the same."'
                )
                self._cross = ui.element("div").classes("cross").style("display:none")
            with ui.element("div").classes("scale").props('data-testid="scale"') as self._scale:
                self._unit = ui.label("")
                with ui.element("div").classes("ramp"):
                    self._ramp = ui.element("div").classes("colours")
                    with ui.element("div").classes("ticks"):
                        self._ticks = [ui.label("") for _ in range(_TICKS)]
        self._hovered = ui.label("Drag to orbit, Shift-drag to pan, wheel to zoom, click a pixel for its figures")
        self._hovered.classes("hover").props('data-testid="hover"')

    def _below(self) -> None:
        with ui.element("div").classes("tools"):
            self._pose = ui.input("Pose: E,N,U above ground,yaw,pitch,roll [m, deg]", validation=self._pose_fault)
            self._pose.props('dense outlined hide-bottom-space data-testid="pose"').style("flex:1;min-width:280px")
            self._pose.on("change", self._typed_pose)
            self._pose.set_value(self.view.pose.text(self.session.base))
            ui.button("Copy", on_click=self._copy_menu).props("flat dense")
        self.timeline = Timeline(self)
        with ui.element("div").classes("cards"):
            with ui.element("div"):
                ui.html("<h2>Pixel</h2>", sanitize=False)
                with ui.element("div").classes("figures").props('data-testid="figures"') as self._figures:
                    ui.label("Click a pixel in the picture.").classes("soft")
            with ui.element("div"):
                self._notes = ui.label("").classes("soft").props('data-testid="notes"')
                self._parts_title = ui.html("", sanitize=False)
                self._parts = ui.element("div").classes("figures three").props('data-testid="parts"')
                self._legend = ui.element("div").classes("legend").props('data-testid="legend"')

    def _copy_menu(self) -> None:
        text = command(self.session, self.view).strip()
        ui.run_javascript(f"navigator.clipboard.writeText({json.dumps(text)})")
        self.say(f"Copied: {text}", "info")

    # What a hand does.

    def _set(self, **changes: Any) -> None:
        self.view = replace(self.view, **changes)
        on_map = self.view.mode == "map"
        self._map_box.set_visibility(on_map)
        self._colour_tools.set_visibility(not on_map)
        self._camera_box.set_visibility(not on_map)
        if on_map:
            self.map.open()
        else:
            self.look()

    def turn_to(self, pose: Pose, time_s: float | None = None) -> None:
        """Show another pose."""
        self._pose.set_value(pose.text(self.session.base))
        self._set(pose=pose, time_s=self.view.time_s if time_s is None else time_s)

    def _pose_fault(self, text: str) -> str | None:
        return sentence_of(lambda: Pose.typed(text, self.session.base))

    def _typed_pose(self) -> None:
        if self._pose_fault(self._pose.value) is None:
            self._set(pose=Pose.typed(self._pose.value, self.session.base))

    def _move(self, event: Any) -> None:
        given, scene, pose = event.args, self.session.base, self.view.pose
        right, down, zoom = (float(given[key]) for key in ("right", "down", "zoom"))
        if not all(map(math.isfinite, (right, down, zoom))):
            return
        turn = 0.0 if given["pan"] else -_TURN_DEG
        pose = pose.orbited(turn * right, turn * down, zoom, scene)
        self.turn_to(pose.moved(right, down, scene) if given["pan"] else pose)

    def _hover(self, event: Any) -> None:
        self._under = (int(event.args[0]), int(event.args[1]))
        self._ask(self._under, self._hover_shown)

    def _pick(self, event: Any) -> None:
        self.pixel = (int(event.args[0]), int(event.args[1]))
        self._place_cross()
        self._ask(self.pixel, self._figures_shown)

    def _ask(self, pixel: Any, show: Callable[..., Any]) -> None:
        """Find a pixel's figures in the thread that renders, and show them."""
        renders, later = self.session.renders, self.later(show)

        def job() -> None:
            frame = renders.frame(self.key)
            found = None if frame is None else figures(frame, *pixel)
            later(
                found, renders.parts(self.key, (pixel[1], pixel[0])) if found and show == self._figures_shown else None
            )

        renders.run(job)

    # What comes back.

    def _shown(self, picture: Picture) -> None:
        if not picture.data:
            ui.run_javascript("studio.say('not rendered', false)")
            self.say(picture.notes)
            return
        self._picture = picture
        self._send(picture)
        if self._wordless is None:
            self._wordless = self._loop.call_later(_AFTER_S, self._inside, self._words)

    def _words(self) -> None:
        """Say what the latest picture shows."""
        self._wordless, picture = None, self._picture
        if picture is None:
            return
        self._unit.set_text(picture.unit)
        self._scale.style(f"visibility:{'visible' if picture.ends else 'hidden'}")
        self._ramp.style(f"background:{picture.gradient or 'none'}")
        for tick, text in zip(self._ticks, picture.ticks(len(self._ticks)), strict=True):
            tick.set_text(text)
        self._notes.set_text(picture.notes)
        show_legend(self._legend, picture.legend)
        if self.pixel is not None:
            self._ask(self.pixel, self._figures_shown)
        if self._under is not None:
            self._ask(self._under, self._hover_shown)
        if self._behind is not None and picture.version == self.session.history.version:
            self.refresh()

    def _send(self, picture: Picture) -> None:
        address = f"/frame/{self.key}/{picture.number}"
        given = address, picture.version, picture.number, picture.words, picture.exact
        ui.run_javascript(f"studio.show({', '.join(map(json.dumps, given))})")

    def _place_cross(self) -> None:
        if self.pixel is not None:
            camera = self.session.base.camera
            left, top = (100.0 * (self.pixel[k] + 0.5) / size for k, size in ((0, camera.width), (1, camera.height)))
            self._cross.style(f"display:block;left:{left:.3f}%;top:{top:.3f}%")

    def _hover_shown(self, found: dict[str, Any] | None, _: Any) -> None:
        if found:
            what = f" · {found['object'] or found['material']}" if found["material"] else " · no surface"
            self._hovered.set_text(f"{found['apparent_k']:.2f} K apparent{what}")

    def _figures_shown(self, found: dict[str, Any] | None, parts: PixelParts | None) -> None:
        if found is None or self.pixel is None:
            return
        east, north, up = found["position"]
        rows = [
            ("Pixel", f"column {self.pixel[0]}, row {self.pixel[1]}"),
            ("Apparent temperature", f"{found['apparent_k']:.3f} K"),
            ("Radiance", f"{found['radiance']:.4f} W m⁻² sr⁻¹"),
        ]
        if found["material"]:
            rows += [
                ("Kinetic temperature", f"{found['kinetic_k']:.3f} K"),
                ("Band emissivity", f"{found['emissivity']:.4f}"),
                ("Material", found["material"]),
                *([("Object", found["object"])] if found["object"] else []),
                *([("View angle", f"{parts.angle_deg:.1f}°")] if parts else []),
                ("Position E, N, up", f"{east:.1f}, {north:.1f}, {up:.1f} m"),
            ]
        else:
            rows.append(("Surface", "none: sky or surroundings"))
        self._figures.clear()
        self._figures.props(f"data-version={self._picture.version if self._picture else 0}")
        with self._figures:
            for key, value in rows:
                ui.label(key).classes("k")
                ui.label(value).props(f'data-key="{key}"')
        self._parts.clear()
        self._parts_title.set_content("<h2>Radiance by origin</h2>" if parts else "")
        if parts is None:
            return
        with self._parts:
            for head in ("", "W m⁻² sr⁻¹", "K"):
                ui.label(head).classes("k r")
            for name, part in parts.radiance.items():
                ui.label(_ORIGINS.get(name, name)).classes("k")
                ui.label(f"{round(part, 4) + 0.0:.4f}").classes("r").props(f'data-part="{name}"')
                ui.label(f"{round(parts.kelvin[name], 2) + 0.0:.2f}").classes("r")
