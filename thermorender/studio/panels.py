"""Panels beside those of a material: what the materials cover, the map to paint on, and files."""

import json
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from nicegui import run, ui

from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import decimal
from thermorender.scene.load import load_scene
from thermorender.studio import ground, saving
from thermorender.studio.document import Document
from thermorender.studio.fields import alike
from thermorender.studio.pictures import Legend
from thermorender.units import kelvin

if TYPE_CHECKING:
    from thermorender.studio.page import Tab

_TOOLS = {"fill": "Fill region", "polygon": "Polygon", "lasso": "Lasso"}
_HOW = "Fill: click a region. Polygon: click corners, double-click the last. Lasso: drag around."
_STAGE = """
<div id="mapstage" tabindex="0" role="application" aria-label="Map to paint on: arrow keys move the mark, Space puts a
corner there, Enter closes the area, Escape drops it"><img id="map" alt="Map of the materials over the orthophoto"
data-testid="map" draggable="false"><svg id="mapdraw" viewBox="0 0 1 1" preserveAspectRatio="none"></svg></div>
"""
_LAYERS = {"materials": "Materials", "learned": "Learned", "uncertainty": "Uncertainty"}
_KINDS = {
    "png": "PNG, display", "exr": "EXR, radiance and truth", "tif": "TIFF, apparent [K]", "map": "GeoTIFF, map [K]",
    "npz": "NPZ, arrays",
}  # fmt: skip


def show_legend(box: ui.element, legend: Legend) -> None:
    """Fill an element with a legend."""
    box.clear()
    with box:
        for words, colour in legend:
            with ui.element("div"):
                ui.element("span").classes("swatch").style(f"background:{colour}")
                ui.label(words)


def _shown(temperature: float | None) -> str:
    return "balance" if temperature is None else f"{temperature:g}"


class Cover:
    """The material of each class and object, in place."""

    def __init__(self, tab: "Tab") -> None:
        self._tab, self._session = tab, tab.session
        # Classes and objects that the elements below were made of, materials to choose from, and those elements.
        self._known: Any = None
        self._names: list[str] = []
        self._choices: dict[int | str, ui.select] = {}
        self._kelvins: dict[str, ui.input] = {}
        # Text that each temperature was last filled with.
        self._filled: dict[str, str] = {}
        self._box = ui.element("div").classes("part")

    def refresh(self) -> None:
        """Show the current version of the edits."""
        document = self._session.document
        things, names = (sorted(document.classes), list(document.objects)), sorted(document.library)
        if things != self._known:
            self._known, self._names = things, names
            self._make(*things, names)
        elif names != self._names:
            self._names = names
            for choice in self._choices.values():
                choice.set_options(names)
        for number, name in document.classes.items():
            self._choices[number].set_value(name)
        for thing, (name, temperature) in document.objects.items():
            self._choices[thing].set_value(name)
            known, text, given = self._filled.get(thing), _shown(temperature), self._kelvins[thing]
            self._filled[thing] = text
            if known is None or alike(str(given.value or ""), known):
                given.set_value(text)
            elif known != text and not alike(str(given.value or ""), text):
                self._tab.say(f"the temperature of {thing} is now {text}; the text in the field stays as typed", "info")

    def drop_typed(self) -> None:
        """Let the next refresh replace temperatures that are typed and not part of the edits."""
        self._filled.clear()

    def _make(self, classes: list[int], objects: list[str], names: list[str]) -> None:
        self._box.clear()
        self._choices, self._kelvins, self._filled = {}, {}, {}
        with self._box:
            ui.html("<h2>Classes</h2>", sanitize=False)
            if not classes:
                ui.label("This scene's materials do not come from classes.").classes("soft")
            with ui.element("div").classes("cover"):
                for number in classes:
                    ui.label(f"Class {number}").classes("soft")
                    change = partial(Document.of_class, number=number)
                    self._choices[number] = self._choice(names, f"class-{number}", f"class {number}", change)
            if not objects:
                return
            ui.html("<h2>Objects</h2>", sanitize=False)
            with ui.element("div").classes("cover three"):
                for thing in objects:
                    ui.label(thing).classes("soft")
                    change = partial(Document.of_object, name=thing)
                    self._choices[thing] = self._choice(names, f"object-{thing}", thing, change)
                    self._kelvins[thing] = self._kelvin(thing)

    def _choice(self, names: list[str], test: str, what: str, change: Callable[..., Document]) -> ui.select:
        given: ui.select = ui.select(names, with_input=True)
        given.props("dense outlined options-dense hide-bottom-space")
        # Names of a scene file may hold any characters, so they are not parsed as properties.
        given.props.update({"aria-label": f"Material of {what}", "data-testid": test})

        def done(event: Any) -> None:
            chosen, version = event.args
            if chosen and self._tab.edit(
                int(version), f"{what}: {chosen}", lambda document: change(document, material=str(chosen))
            ):
                self.refresh()

        given.on("update:model-value", done, js_handler="(one) => emit(one && one.label, studio.version)")
        return given

    def _kelvin(self, thing: str) -> ui.input:
        def fault(text: str) -> str | None:
            if text == _shown(self._session.document.objects[thing][1]):
                return None
            try:
                kelvin(f"temperature of {thing}", decimal(text))
            except ValueError:
                return f"{text!r} is not a number of kelvin"
            except ThermorenderError as error:
                return str(error)
            return None

        def done(event: Any) -> None:
            text = str(event.args[0])
            if fault(text) is None and text != _shown(self._session.document.objects[thing][1]):
                change = partial(Document.of_object, name=thing, kelvin=decimal(text))
                known = self._filled.pop(thing, None)
                refused = self._tab.edit(int(event.args[1]), f"{thing}: {text} K", change)
                if known and thing not in self._filled:
                    self._filled[thing] = known if refused else text

        given = ui.input(validation=fault, suffix="K").props("dense outlined hide-bottom-space")
        given.props.update({"aria-label": f"Temperature of {thing} [K]", "data-testid": f"kelvin-{thing}"})
        given.on("change", done, js_handler="(value) => emit(value, studio.version)")
        return given


class Map:
    """The orthophoto with the materials over it, and tools to paint on it."""

    def __init__(self, tab: "Tab") -> None:
        self._tab, self._session = tab, tab.session
        self._percent = 45
        with ui.element("div").classes("tools"):
            self._tool = ui.select(_TOOLS, value="fill", label="Tool").props('dense outlined data-testid="tool"')
            self._tool.style("width:148px").on_value_change(
                lambda e: ui.run_javascript(f"studio.tool({json.dumps(e.value)})")
            )
            self._paint = ui.select([], label="Material to paint", with_input=True)
            self._paint.props('dense outlined options-dense data-testid="paint"').style("width:200px")
            ui.label("Opacity").classes("soft")
            slider = ui.slider(min=0, max=100, value=self._percent).props('aria-label="Opacity of the materials"')
            slider.style("width:110px").on("change", lambda e: self._shown(int(e.args)))
        self._labels()
        with ui.element("div").classes("mapbox"):
            ui.html(_STAGE, sanitize=False)
        self._words = ui.label("").classes("hover").props('data-testid="map-words"')
        self._legend = ui.element("div").classes("legend maplegend").props('data-testid="map-legend"')
        ui.on("studio_area", self._area)

    def _labels(self) -> None:
        """Controls of areas that label the ground for training."""
        with ui.element("div").classes("tools"):
            self._use = ui.toggle({"paint": "Paint", "label": "Label"}, value="paint")
            self._use.props('dense no-caps data-testid="use"').on_value_change(lambda: self._labelled())
            self._layer = ui.select(_LAYERS, value="materials", label="Layer").props(
                'dense outlined data-testid="layer"'
            )
            self._layer.style("width:165px").on_value_change(lambda: self._layered())
            self._label_tools = ui.element("div").classes("row grow")
            with self._label_tools:
                self._count = ui.label("").classes("soft count").props('role="status" data-testid="labels"')
                for text, does in (("Remove", self._remove), ("Train", self._train), ("Download", self._download)):
                    ui.button(text, on_click=does).props(f'outline dense no-caps data-testid="{text.lower()}"')
                self._cancel = ui.button("Cancel", on_click=self._session.stop_training.set)
                self._cancel.props('flat dense no-caps data-testid="cancel-training"').set_visibility(False)
        self._label_tools.set_visibility(False)

    def _labelled(self) -> None:
        """Show the labels, where areas are labels."""
        labels, grid, on = self._session.labels, self._session.base.grid, self._use.value == "label"
        self._label_tools.set_visibility(on)
        self._count.set_text(f"{len(labels)} labels, {len({each.material for each in labels})} materials")
        shapes = ground.outlines(grid, labels) if on and grid is not None else []
        ui.run_javascript(f"studio.showLabels({json.dumps(shapes)})")

    def _layered(self) -> None:
        learned, layer = self._session.learned, self._layer.value
        missing = "No map is learned yet: label areas of two or more materials, and press Train."
        self._words.set_text(_HOW if layer == "materials" else learned.words[layer] if learned else missing)
        self.refresh()

    def _remove(self) -> None:
        del self._session.labels[-1:]
        self._labelled()

    def _download(self) -> None:
        grid = self._session.base.grid
        if grid is not None:
            text = ground.labels_text(grid, self._session.labels)
            ui.download.content(text.encode(), "labels.geojson")

    async def _train(self) -> None:
        """Train a map on the labels beside the thread that renders, and show it."""
        session, said = self._session, self._tab.later(self._count.set_text)

        def progress(what: str, share: float) -> None:
            if session.stop_training.is_set() or self._tab.closed:
                raise ThermorenderError("the training was cancelled; press Train to begin again")
            said(f"{what}: {share:.0%}")

        if not session.training.acquire(blocking=False):
            self._tab.say("a training is under way in this or another tab; wait for it, or cancel it there")
            return
        session.stop_training.clear()
        self._cancel.set_visibility(True)
        fault = ""
        try:
            session.learned = await run.io_bound(ground.learned_from, session, progress)
        except ThermorenderError as error:
            fault = str(error)
        finally:
            session.training.release()
        if self._tab.closed:
            return
        self._cancel.set_visibility(False)
        self._labelled()
        if fault:
            self._tab.say(fault)
        elif self._layer.value == "materials":
            self._layer.set_value("learned")
        else:
            self._layered()

    def _shown(self, percent: int) -> None:
        self._percent = percent
        self.refresh()

    def open(self) -> None:
        """Show the map of the current version."""
        self._paint.set_options(sorted(self._session.document.library), value=self._tab.editor.name)
        self._layered()
        ui.run_javascript(f"studio.setUpMap(); studio.tool({json.dumps(self._tool.value)})")

    def refresh(self) -> None:
        """Show the current version of the edits."""
        address = f"/map/{self._layer.value}/{self._session.history.version}/{self._percent}"
        ui.run_javascript(f"studio.showMap({json.dumps(address)}, {self._session.history.version})")
        show_legend(self._legend, ground.legend(self._session, self._layer.value))

    def _area(self, event: Any) -> None:
        given, scene, session = event.args, self._session.scene, self._session
        material = self._paint.value
        try:
            if not material:
                raise ThermorenderError("no material to paint with is chosen; choose one above the map")
            ground.refuse_without_map(scene)
            points = given["points"]
            if given["tool"] == "fill":
                shape = ground.filled(scene, *map(float, points[0]))
            else:
                shape = ground.polygon(scene, points)
        except ThermorenderError as error:
            self._tab.say(str(error))
            return

        if self._use.value == "label":
            session.labels.append(ground.Label(shape, str(material)))
            self._labelled()
            return
        self._tab.edit(
            int(given["version"]), f"area of {material}", partial(ground.painted, session, shape, str(material))
        )


class Files:
    """Save, reload, export, and the same as Python or on the command line."""

    def __init__(self, tab: "Tab") -> None:
        self._tab, self._session = tab, tab.session
        with ui.element("div").classes("part"):
            ui.html("<h2>Save</h2>", sanitize=False)
            ui.label(f"Into {self._session.base.spec.folder}: its own materials/, scene.toml and class map.").classes(
                "soft"
            )
            with ui.row().style("gap:8px;margin-top:6px"):
                ui.button("Show changes", on_click=self._plan).props('outline dense data-testid="plan"')
                save = ui.button("Save").props('dense data-testid="save"')
                save.on("click", self._save, js_handler="() => emit(studio.version)")
                ui.button("Reload", on_click=self._reload).props('outline dense data-testid="reload"')
            self._diff = ui.label("").classes("diff").props('data-testid="diff"')
        with ui.element("div").classes("part"):
            ui.html("<h2>Export the view</h2>", sanitize=False)
            with ui.row().style("gap:8px;align-items:center"):
                kind = ui.select(_KINDS, value="png", label="Kind").props("dense outlined").style("width:200px")
                metres = ui.number("Pixel [m]", value=0.5, min=0.01).props("dense outlined").style("width:100px")
                ui.button("Export", on_click=lambda: self._export(kind.value, metres.value)).props("dense")
        with ui.element("div").classes("part"):
            ui.html("<h2>The same without the page</h2>", sanitize=False)
            ui.button("Show", on_click=self._commands).props("outline dense")
            self._code = ui.label("").classes("diff").props('data-testid="code"')
            self._code.set_visibility(False)
        self._diff.set_visibility(False)

    async def _export(self, kind: str, metres: Any) -> None:
        try:
            made = await run.io_bound(saving.exported, self._session, self._tab.key, kind, float(metres or 0.5))
        except ThermorenderError as error:
            self._tell(str(error))
            return
        if made is not None:
            ui.download.content(*made)

    def _commands(self) -> None:
        self._code.set_visibility(True)
        self._code.set_text("\n".join(saving.commands(self._session, self._tab.view)))

    def _plan(self) -> saving.Save | None:
        try:
            save = saving.planned(self._session)
        except ThermorenderError as error:
            self._tell(str(error))
            return None
        self._tell("\n".join(save.lines) or "nothing to save: the files hold what is shown")
        return save

    def _tell(self, text: str) -> None:
        self._diff.set_visibility(True)
        self._diff.set_text(text)

    async def _save(self, event: Any) -> None:
        try:
            self._session.history.refuse_outdated(int(event.args), self._tab.key)
        except ThermorenderError as error:
            self._tell(str(error))
            return
        save = self._plan()
        if save is None or not save.files:
            return
        with ui.dialog() as dialog, ui.card().style("min-width:min(760px,90vw)"):
            ui.label("These changes will be written").style("font-weight:600")
            ui.label("\n".join(save.lines)).classes("diff").style("max-height:55vh;overflow:auto;width:100%")
            with ui.row():
                ui.button("Write", on_click=lambda: dialog.submit(True)).props('data-testid="write"')
                ui.button("Cancel", on_click=lambda: dialog.submit(False)).props("flat")
        if not await dialog:
            return
        try:
            saving.write(self._session, save)
        except ThermorenderError as error:
            self._tell(str(error))
            return
        self._tell(f"saved: {len(save.files)} files\n" + "\n".join(save.lines))

    async def _reload(self) -> None:
        try:
            self._session.reload(await run.io_bound(load_scene, self._session.base.spec.folder))  # type: ignore[arg-type]
        except ThermorenderError as error:
            self._tell(str(error))
            return
        self._tell("read again from disk")
