"""The view in the page: its tools, the picture with its bar, and what is said of it."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from thermorender.apps.studio import cards, labels, painting
from thermorender.apps.studio.layers import LAYERS, Shot, layers_of
from thermorender.apps.studio.panels import Training, sentence_of
from thermorender.apps.studio.pictures import NAMES, Picture, gradient
from thermorender.apps.studio.timeline import Timeline
from thermorender.apps.studio.view import Pose, View, limits_of, parsed_hour
from thermorender.errors import ThermorenderError

if TYPE_CHECKING:
    from thermorender.apps.studio.page import Tab

# Degrees of an orbit over the width of the picture.
_TURN_DEG = 120.0
_TICKS = 5
# Words follow their picture, which their own work would delay, so long after it [s].
_AFTER_S = 0.06
_MOST_POINTS = 12
_HINTS = {
    False: "Drag to orbit, Shift-drag to pan, wheel to zoom, click a pixel for its figures",
    True: "Drag to pan, wheel to zoom, click a pixel for its figures",
}
_GONE = "the picture has changed several times since you pointed at it, so nothing was done; point at the new one"
_STAGE = """
<div class="view"><div class="stage" id="stage" style="--width:{width};--height:{height}">
<img id="frame" data-testid="frame" tabindex="0" draggable="false" alt="The scene as the camera sees it. Drag to orbit,
with Shift to pan, wheel to zoom; arrow keys, + and − do the same. With the tool Point, arrow keys move a mark and Enter
picks its pixel."><img id="other" alt="What it is compared with" hidden><img id="outline" alt="" hidden>
<svg id="draw" viewBox="0 0 1 1" preserveAspectRatio="none" aria-hidden="true"></svg><div id="marks"></div>
<input id="slider" type="range" min="0" max="100" value="50" aria-label="Share of the view on the left" hidden>
<div id="sides" hidden><span id="side-a"></span><span id="side-b"></span></div><div id="stale" hidden></div></div>
<div class="scale" id="scale" data-testid="scale"><div class="unit"></div><div class="ramp"><div class="colours"></div>
<div class="ticks"></div></div></div></div>
<div class="title" id="title" data-testid="picture-title"></div>
<div class="hover" id="hover" data-testid="hover"></div>
"""
_CARDS = """
<div class="cards" id="cards"><div><h2>Pixel</h2><div class="figures" id="figures" data-testid="figures">
<span class="soft">Click a pixel in the picture.</span></div></div>
<div><div id="parts" data-testid="parts"></div><div id="heat" data-testid="heat"></div></div>
<div class="whole"><div id="notes" class="soft" data-testid="notes"></div><div id="legend" class="legend"
data-testid="legend"></div></div>
<div class="whole" id="probes" data-testid="probes"></div><div class="whole" id="table" data-testid="table"></div></div>
"""


class Stage:
    """The view of a tab."""

    def __init__(self, tab: "Tab", view: View) -> None:
        self._tab, self._session, self.view = tab, tab.session, view
        self._picked: cards.Point | None = None
        # What a hand has picked in which Shot, until the figures are asked for.
        self._picking: tuple[cards.Pixel, Shot] | None = None
        self._under: cards.Pixel | None = None  # under the pointer
        self._picture: Picture | None = None
        self._looks = 0  # views that were asked for
        self._tools()
        camera = self._session.base.camera
        ui.html(_STAGE.format(width=camera.width, height=camera.height), sanitize=False).classes("viewbox")
        self._below()
        ui.html(_CARDS, sanitize=False)
        self.timeline.follow(view.time_s)
        handlers: dict[str, Callable[[Any], object]] = {
            "move": self._move, "hover": self._hover, "pick": self._pick, "stroke": self._stroke, "keep": self._keep,
            "drop": self._drop, "choose": lambda event: self._tab.editor.choose(str(event.args)),
        }  # fmt: skip
        for name, handler in handlers.items():
            ui.on(f"studio_{name}", handler)

    @property
    def _training(self) -> Training:
        return self._tab.editor.training

    # The tools.

    def _tools(self) -> None:
        with ui.element("div").classes("tools"):
            self._layer = ui.select(self._layers(), value=self.view.layer, label="Show")
            self._layer.props('dense outlined options-dense data-testid="layer"').style("width:236px")
            self._layer.on_value_change(lambda e: self.change(new=True, layer=e.value))
            self._from = ui.toggle({False: "Camera", True: "From above"}, value=self.view.plan)
            self._from.props('dense no-caps data-testid="projection"')
            self._from.on_value_change(lambda e: self._seen_from(bool(e.value)))
            self._against = ui.select({"": "alone"}, value="", label="Compare with")
            self._against.props('dense outlined options-dense data-testid="against"').style("width:190px")
            self._against.on_value_change(lambda e: self._compared(str(e.value or "")))
            self._hour = ui.input("At hour", value="12", validation=lambda text: sentence_of(lambda: parsed_hour(text)))
            self._hour.props('dense outlined hide-bottom-space data-testid="against-hour"').style("width:130px")
            self._hour.on("change", lambda: self._compared("hour"))
            self._as = ui.toggle({False: "Difference", True: "Split"}, value=self.view.slider)
            self._as.props('dense no-caps data-testid="compare-as"')
            self._as.on_value_change(lambda e: self.change(slider=bool(e.value)))
        with ui.element("div").classes("tools"):
            self._tool = ui.toggle(painting.TOOLS, value="look").props('dense no-caps data-testid="tool"')
            self._tool.on_value_change(lambda e: self._tools_follow())
            self._radius = ui.number("Radius [px]", value=8, min=1, max=200, step=1).props("dense outlined")
            self._radius.props('data-testid="radius"').style("width:92px")
            self._paints = ui.label("").classes("soft count").props('data-testid="paints"')
            ui.element("div").style("flex:1")
            colours = ui.button(icon="palette").props('flat dense aria-label="Colours" data-testid="colours"')
            colours.on("click", lambda: self._colour_tools.set_visibility(not self._colour_tools.visible))
            colours.tooltip("Colours")
            self._colours = colours
        self._colour_tools: ui.element = ui.element("div").classes("tools")
        with self._colour_tools:
            self._palette = ui.select(list(NAMES), value=self.view.palette, label="Palette")
            self._palette.props("dense outlined").style("width:130px")
            self._palette.on_value_change(lambda e: self.change(palette=e.value))
            self._ends = [
                ui.input(label, placeholder="auto").props(f'dense outlined data-testid="{key}"').style("width:92px")
                for label, key in (("From", "low"), ("To", "high"))
            ]
            for each in self._ends:
                each.on("change", self._fixed)
            ui.button("Fix the range", on_click=lambda: self._fix(True)).props("outline dense")
            ui.button("Automatic", on_click=lambda: self._fix(False)).props("outline dense")
        self._colour_tools.set_visibility(False)

    def _layers(self) -> dict[str, str]:
        """The titles of the layers that this scene and this view have."""
        return layers_of(self._session.base, self.view.plan, self._session.renders.learned is not None)

    def _tools_follow(self) -> None:
        """Let the tools show the view, and the script know the tool."""
        view, tool = self.view, str(self._tool.value)
        about, names = LAYERS[view.layer], self._layers()
        self._layer.set_options(names, value=view.layer)
        self._from.set_value(view.plan)
        self._as.set_value(view.slider)
        self._palette.set_value(view.palette)
        versions = {
            f"version {version}": f"version {version}: {what or 'as read'}"
            for version, what, steps in reversed(self._session.history.entries) if steps
        }  # fmt: skip
        driven = self._session.base.temperature_state.weather_driven
        known = {"": "nothing", "saved": "the saved scene", **({"hour": "another hour"} if driven else {}), **versions}
        chosen = "hour" if view.against.startswith("hour") else view.against
        known.setdefault(chosen, chosen)
        self._against.set_options(known, value=chosen)
        self._hour.set_visibility(chosen == "hour")
        if chosen == "hour":
            self._hour.set_value(view.against.removeprefix("hour "))
        self._as.set_visibility(bool(chosen) and bool(about.channel))
        self._colours.set_visibility(bool(about.channel) or view.layer == "display")
        self._radius.set_visibility(tool == "brush")
        painted = tool in painting.PAINTS
        self._paints.set_visibility(painted)
        if painted:
            how = "labels" if self._training.labels_now else "paints"
            self._paints.set_text(f"{how} {self._tab.editor.name}")
        given = json.dumps(tool), json.dumps(float(self._radius.value or 8))
        ui.run_javascript(f"studio.use({', '.join(given)})")

    def _seen_from(self, plan: bool) -> None:
        if plan == self.view.plan:
            return
        about = LAYERS[self.view.layer]
        there = about.plan if plan else about.camera
        self.change(new=True, plan=plan, **({} if there else {"layer": "kinetic"}))

    def _compared(self, against: str) -> None:
        if against == "hour":
            try:
                against = f"hour {parsed_hour(self._hour.value):g}"
            except ThermorenderError:
                return  # The field says so.
        if against != self.view.against:
            self.change(new=True, against=against)

    def _fix(self, now: bool) -> None:
        ends = self._picture.ends if now and self._picture else None
        for k, each in enumerate(self._ends):
            each.set_value(f"{ends[k]:.6g}" if ends else "")
        self._fixed()

    def _show_ends(self) -> None:
        for each, end in zip(self._ends, self.view.limits or (None, None), strict=True):
            each.set_value("" if end is None else f"{end:.6g}")

    def _fixed(self) -> None:
        low, high = (each.value or "" for each in self._ends)
        try:
            self.change(limits=limits_of(low, high))
        except ThermorenderError as error:
            self._tab.say(str(error))

    def _below(self) -> None:
        with ui.element("div").classes("tools"):
            self._pose = ui.input("Pose: E,N,U above ground,yaw,pitch,roll [m, deg]", validation=self._pose_fault)
            self._pose.props('dense outlined hide-bottom-space data-testid="pose"').style("flex:1;min-width:240px")
            self._pose.on("change", self._typed_pose)
            self._pose.set_value(self.view.pose.text(self._session.base))
            whole = ui.button(icon="home", on_click=self._home)
            whole.props('flat dense round aria-label="First view" data-testid="home"').tooltip("First view")
        self.timeline = Timeline(self._tab, self)

    # The view.

    def change(self, new: bool = False, **changes: Any) -> None:
        """Show another view; a `new` one is a step that the browser's Back takes back."""
        made = replace(self.view, **changes)
        if not made.against:
            made = replace(made, slider=False)
        # Ends of one quantity mean nothing for another one.
        if _quantity(made) != _quantity(self.view):
            made = replace(made, limits=changes.get("limits"))
        if made != self.view:
            self.show(made, new=new)

    def show(self, view: View, new: bool = False, remember: bool = True) -> None:
        """Show a view."""
        self.view = view
        self._pose.set_value(view.pose.text(self._session.base))
        self._show_ends()
        self._tools_follow()
        self.look()
        if remember:
            self._tab.remember(new)
        else:
            self.timeline.follow(view.time_s)

    def turn_to(self, pose: Pose, time_s: float | None = None) -> None:
        """Show another pose."""
        self.show(replace(self.view, pose=pose, time_s=self.view.time_s if time_s is None else time_s))

    def look(self) -> None:
        """Ask for a picture of the view."""
        try:
            reference = self._session.reference(self.view.against)
        except ThermorenderError as error:
            self._tab.say(str(error))
            self.change(against="")
            return
        later = self._tab.later
        self._looks += 1
        about = LAYERS[self.view.layer]
        exact = f"{about.title} is known with the exact solution" if about.terms else ""
        waits = exact, f"{reference[1]} is being solved" if reference else exact
        ui.run_javascript(f"studio.asked({self._looks}, {json.dumps(waits)})")
        self._session.renders.look(self._tab.key, self.view, later(self._shown), reference, later(self._working))

    def chosen(self) -> None:
        """Outline the chosen material in the picture, and keep it in the address."""
        self._tools_follow()
        self._outline()
        self._tab.remember()

    def _outline(self) -> None:
        if self._picture is not None:
            address = f"/outline/{self._tab.key}/{self._picture.number}/{self._tab.editor.name}"
            ui.run_javascript(f"studio.outline({json.dumps(address)}, {self._picture.number})")

    def picked_texel(self) -> int | None:
        """Return the texel of the picked point; None without one."""
        return self._picked.texel if self._picked is not None and self._picked.texel >= 0 else None

    def refresh(self) -> None:
        """Show the current version of the edits."""
        self._tools_follow()
        self.timeline.refresh()
        kind, _, version = self.view.against.partition(" ")
        gone = kind == "version" and not self._session.history.has(int(version))
        if kind == "hour" or gone:
            self.look()

    def connected(self) -> None:
        """Bring the page up to date after it has connected."""
        self._tools_follow()
        if self._picture is not None:
            self._send(self._picture)
            self._words()
        else:
            self.look()

    @property
    def shown(self) -> int:
        """The number of the latest picture."""
        return self._picture.number if self._picture else 0

    # What a hand does.

    def _home(self) -> None:
        """Show the first pose again."""
        first = self._tab.first
        self.turn_to(first.pose, first.time_s)
        self.timeline.follow(first.time_s)

    def _pose_fault(self, text: str) -> str | None:
        return sentence_of(lambda: Pose.typed(text, self._session.base))

    def _typed_pose(self) -> None:
        if self._pose_fault(self._pose.value) is None:
            self.turn_to(Pose.typed(self._pose.value, self._session.base))

    def _move(self, event: Any) -> None:
        given, scene, pose = event.args, self._session.base, self.view.pose
        right, down, zoom = (float(given[key]) for key in ("right", "down", "zoom"))
        if not all(map(math.isfinite, (right, down, zoom))):
            return
        pan = given["pan"] or self.view.plan
        turn = 0.0 if pan else -_TURN_DEG
        moved = pose.orbited(turn * right, turn * down, zoom, scene)
        if pan and self.view.plan:
            # The picture's north is up, whatever the camera's heading.
            wide = 2.0 * math.tan(math.radians(scene.camera.field_of_view_deg[0]) / 2.0)
            moved = replace(moved, yaw_deg=0.0).moved(wide * right, wide * down, scene)
            moved = replace(moved, yaw_deg=pose.yaw_deg)
        elif pan:
            moved = moved.moved(right, down, scene)
        self.turn_to(moved)

    def _hover(self, event: Any) -> None:
        self._under = (int(event.args[0]), int(event.args[1]))
        self._ask(self._say_under)

    def _pick(self, event: Any) -> None:
        column, row, number = map(int, event.args)
        shot, _ = self._session.renders.shown(self._tab.key, number)
        if shot is None:
            self._tab.say(_GONE)
            return
        self._picking = (column, row), shot
        self._describe()

    def _keep(self, event: Any) -> None:
        """Keep the picked point."""
        point, kept = self._picked, self._session.points
        if point is None or not np.isfinite(point.position).all():
            self._tab.say("this pixel shows no surface, so it cannot be kept; pick one on a surface")
            return
        if len(kept) == _MOST_POINTS:
            self._tab.say(f"{_MOST_POINTS} points are kept already; remove one first")
            return
        self._session.keep([*kept, replace(point, name=self._session.next_name())])

    def _drop(self, event: Any) -> None:
        self._session.keep([point for point in self._session.points if point.name != str(event.args)])

    def pointed(self) -> None:
        """Show the points that are kept now."""
        self._describe()

    def _stroke(self, event: Any) -> None:
        """Paint or label what a stroke covers."""
        given, material = event.args, self._tab.editor.name
        shot, _ = self._session.renders.shown(self._tab.key, int(given["number"]))
        try:
            if shot is None:
                raise ThermorenderError(_GONE)
            texels = painting.texels_of(shot, str(given["tool"]), given["points"], float(self._radius.value or 8))
            if self._training.labels_now:
                self._training.label(labels.geometry_of(self._session.base, texels), material)
                return
        except ThermorenderError as error:
            self._tab.say(str(error))
            return
        what = f"{painting.TOOLS[str(given['tool'])].lower()} → {material}"
        self._tab.edit(int(given["version"]), what, lambda document: document.with_texels(texels, material))

    # What comes back.

    def _working(self, version: int, share: float | None) -> None:
        ui.run_javascript(f"studio.working({version}, {json.dumps(share)})")

    def _shown(self, picture: Picture) -> None:
        if not picture.data:
            ui.run_javascript(f"studio.fault({picture.version})")
            self._tab.say(picture.notes)
            return
        self._picture = picture
        self._send(picture)
        self._tab.after(_AFTER_S, self._words)

    def _send(self, picture: Picture) -> None:
        """Send a picture with all that belongs to it, which the script shows at once."""
        key, number = self._tab.key, picture.number
        given = {
            "source": f"/frame/{key}/{number}", "other": f"/other/{key}/{number}" if picture.other else "",
            "look": self._looks if picture.view == self.view else -1,
            "number": number, "version": picture.version, "words": picture.words, "exact": picture.exact,
            "title": picture.title, "unit": picture.unit, "notes": picture.notes, "legend": picture.legend,
            "gradient": gradient(picture.palette) if picture.ends else "", "ticks": picture.ticks(_TICKS),
            "sides": picture.sides,
            "hint": _HINTS[self.view.plan], "place": repr(picture.view and picture.view.place),
        }  # fmt: skip
        ui.run_javascript(f"studio.show({json.dumps(given)})")

    def _words(self) -> None:
        """Say what the latest picture shows."""
        picture = self._picture
        if picture is None:
            return
        self._outline()
        self._describe()
        if self._under is not None:
            self._ask(self._say_under)
        if self._tab.behind and picture.version == self._session.history.version:
            self._tab.refresh()

    def _ask(self, job: Callable[[Shot, Picture], dict[str, Any] | None]) -> None:
        """Let the thread that renders find what is said of the latest picture, and send it to the script."""
        renders, later = self._session.renders, self._tab.later(lambda told: self._tell(told))

        def asked() -> None:
            shot, picture = renders.shown(self._tab.key)
            if shot is not None and picture is not None and (told := job(shot, picture)) is not None:
                later({"number": picture.number, "version": picture.version, **told})

        renders.run(asked)

    def _tell(self, told: dict[str, Any]) -> None:
        material = told.pop("picked_material", "")
        if material:
            self._tab.editor.choose(material)
        ui.run_javascript(f"studio.describe({json.dumps(told)})")

    def _say_under(self, shot: Shot, picture: Picture) -> dict[str, Any] | None:
        words = "" if self._under is None else cards.hovered(shot, picture, self._under)
        return {"hover": words} if words else None

    def _describe(self) -> None:
        picking, self._picking = self._picking, None
        self._ask(lambda shot, picture: self._below_picture(shot, picture, picking))

    def _below_picture(
        self, shot: Shot, picture: Picture, picking: tuple[cards.Pixel, Shot] | None
    ) -> dict[str, Any]:  # fmt: skip
        """What stands below a picture, after a hand has picked a pixel of a Shot."""
        session = self._session
        if picking is not None:
            self._picked = cards.Point.at(picking[1], picking[0])
        place = self._picked.pixel_in(shot) if self._picked is not None else None
        parts = None if place is None else session.renders.parts(self._tab.key, (place[1], place[0]))
        told = cards.below(shot, picture, self._picked, session.points, parts, session.areas(), session.renders.colours)
        found = picking[1].figures(*picking[0]) if picking is not None else None
        if found and found["material"] and not found["object"]:
            told["picked_material"] = found["material"]
        return told


def _quantity(view: View) -> tuple[str, bool]:
    """What the ends of a view's colours are of: a layer, or its difference."""
    return view.layer, bool(view.against) and not view.slider
