"""Parts of the page: a field that is typed into, what the materials cover, the map to paint on, and files."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from nicegui import run, ui

from thermorender import load_scene
from thermorender.apps.studio import ground
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.pictures import Legend
from thermorender.apps.studio.scene_files import Save
from thermorender.apps.studio.view import commands, exported
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import decimal
from thermorender.units import kelvin

if TYPE_CHECKING:
    from thermorender.apps.studio.page import Tab

# What events of the page send: the version of the edits that it shows, and their value before it.
VERSION, VALUE_AND_VERSION = "() => emit(studio.version)", "(value) => emit(value, studio.version)"
_TOOLS = {"fill": "Fill region", "polygon": "Polygon", "lasso": "Lasso"}
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


def sentence_of(call: Callable[[], object]) -> str | None:
    """Return the sentence with which a function refuses, or None."""
    try:
        call()
    except ThermorenderError as error:
        return str(error)
    return None


def draw(chart: ui.echart, options: dict[str, Any]) -> None:
    """Show other options in a chart."""
    chart.options.clear()
    chart.options.update(options)
    chart.update()


def show_legend(box: ui.element, legend: Legend) -> None:
    """Fill an element with a legend."""
    box.clear()
    with box:
        for words, colour in legend:
            with ui.element("div"):
                ui.element("span").classes("swatch").style(f"background:{colour}")
                ui.label(words)


def _alike(one: str, other: str) -> bool:
    """Whether two texts of a field stand for the same value, as 0.90 and 0.9 do."""
    try:
        return decimal(one) == decimal(other)
    except ValueError:
        return one.strip() == other.strip()


class Entry(ui.input):
    """A field whose text edits the Document by `change`; text that is being typed stays while another tab edits.
    `words` describes an edit.
    """

    def __init__(
        self, tab: "Tab", called: str, test: str, change: Callable[[Document, str], Document],
        words: Callable[[str], str], **options: Any,
    ) -> None:  # fmt: skip
        history = tab.session.history
        super().__init__(validation=lambda text: sentence_of(lambda: change(history.document, text or "")), **options)
        # Names of a scene file may hold any characters, so they are not parsed as properties.
        self.props("dense outlined").props.update({"data-testid": test})
        self.on("change", self._entered, js_handler=VALUE_AND_VERSION)
        self._tab, self._called, self._change, self._words = tab, called, change, words
        # Owner and text that the field was last filled with; text of an edit that is not shown yet.
        self._filled: tuple[str, str] | None = None
        self._typed: str | None = None

    def _entered(self, event: Any) -> None:
        text, version = str(event.args[0] or ""), int(event.args[1])
        known, self._filled, self._typed = self._filled, None, text
        refused = self._tab.edit(version, self._words(text), lambda document: self._change(document, text), quiet=True)
        self.error = refused or None
        if refused:
            # Text that is refused stays to be corrected.
            self._filled, self._typed = self._filled or known, None

    def fill(self, owner: str, text: str) -> None:
        """Show the text of an owner's value, unless another one is being typed."""
        known, typed, value = self._filled, self._typed, str(self.value or "")
        self._filled, self._typed = (owner, text), None
        # A field whose edit this is keeps its own form of the value: what is typed next may be in it already.
        if known == self._filled or (typed is not None and _alike(text, typed)):
            return
        if known and known[0] == owner and not _alike(value, known[1]):
            self._tab.say(
                f"{self._called} of {owner} is now {text or 'empty'}; the text in the field stays as typed", "info"
            )
            return
        self.set_value(text)
        self.error = None

    def drop_typed(self) -> None:
        """Let the next text replace one that is typed and not part of the edits."""
        self._filled = None


def _shown(temperature: float | None) -> str:
    return "balance" if temperature is None else f"{temperature:g}"


def _heated(thing: str, document: Document, text: str) -> Document:
    """The Document with another temperature of an object, from a text."""
    if text == _shown(document.objects[thing][1]):
        return document
    try:
        value = decimal(text)
    except ValueError:
        raise ThermorenderError(f"{text!r} is not a number of kelvin") from None
    kelvin(f"temperature of {thing}", value)
    return document.of_object(thing, kelvin=value)


class Cover:
    """The material of each class and object, in place."""

    def __init__(self, tab: "Tab") -> None:
        self._tab, self._session = tab, tab.session
        # Classes and objects that the elements below were made of, materials to choose from, and those elements.
        self._known: Any = None
        self._names: list[str] = []
        self._choices: dict[int | str, ui.select] = {}
        self._kelvins: dict[str, Entry] = {}
        self._box = ui.element("div").classes("part")

    def refresh(self) -> None:
        """Show the current version of the edits."""
        document = self._session.document
        things, names = (sorted(document.classes), list(document.objects)), sorted(document.library)
        if things != self._known:
            self._known, self._names = things, names
            self._make(*things)
        elif names != self._names:
            self._names = names
            for choice in self._choices.values():
                choice.set_options(names)
        for number, name in document.classes.items():
            self._choices[number].set_value(name)
        for thing, (name, temperature) in document.objects.items():
            self._choices[thing].set_value(name)
            self._kelvins[thing].fill(thing, _shown(temperature))

    def drop_typed(self) -> None:
        """Let the next refresh replace temperatures that are typed and not part of the edits."""
        for entry in self._kelvins.values():
            entry.drop_typed()

    def _make(self, classes: list[int], objects: list[str]) -> None:
        self._box.clear()
        self._choices, self._kelvins = {}, {}
        with self._box:
            ui.html("<h2>Classes</h2>", sanitize=False)
            if not classes:
                ui.label("This scene's materials do not come from classes.").classes("soft")
            with ui.element("div").classes("cover"):
                for number in classes:
                    ui.label(f"Class {number}").classes("soft")
                    change = partial(Document.of_class, number=number)
                    self._choices[number] = self._choice(f"class-{number}", f"class {number}", change)
            if not objects:
                return
            ui.html("<h2>Objects</h2>", sanitize=False)
            with ui.element("div").classes("cover three"):
                for thing in objects:
                    ui.label(thing).classes("soft")
                    change = partial(Document.of_object, name=thing)
                    self._choices[thing] = self._choice(f"object-{thing}", thing, change)
                    self._kelvins[thing] = Entry(
                        self._tab, "temperature", f"kelvin-{thing}", partial(_heated, thing),
                        partial("{}: {} K".format, thing), suffix="K",
                    )  # fmt: skip
                    self._kelvins[thing].props("hide-bottom-space").props["aria-label"] = f"Temperature of {thing} [K]"

    def _choice(self, test: str, what: str, change: Callable[..., Document]) -> ui.select:
        given: ui.select = ui.select(self._names, with_input=True)
        given.props("dense outlined options-dense hide-bottom-space")
        given.props.update({"aria-label": f"Material of {what}", "data-testid": test})

        def done(event: Any) -> None:
            chosen, version = event.args
            if chosen and self._tab.edit(
                int(version), f"{what}: {chosen}", lambda document: change(document, material=str(chosen))
            ):
                self.refresh()

        given.on("update:model-value", done, js_handler="(one) => emit(one && one.label, studio.version)")
        return given


class Map:
    """The orthophoto with the materials over it, and tools to paint on it."""

    def __init__(self, tab: "Tab") -> None:
        self._tab, self._session = tab, tab.session
        with ui.element("div").classes("tools"):
            self._tool = ui.select(_TOOLS, value="fill", label="Tool").props('dense outlined data-testid="tool"')
            self._tool.style("width:148px").on_value_change(
                lambda e: ui.run_javascript(f"studio.tool({json.dumps(e.value)})")
            )
            self._paint = ui.select([], label="Material to paint", with_input=True)
            self._paint.props('dense outlined options-dense data-testid="paint"').style("width:200px")
            ui.label("Opacity").classes("soft")
            self._percent = ui.slider(min=0, max=100, value=45).props('aria-label="Opacity of the materials"')
            self._percent.style("width:110px").on("change", self.refresh)
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
            self._use.props('dense no-caps data-testid="use"').on_value_change(self._labelled)
            self._layer = ui.select(_LAYERS, value="materials", label="Layer").props(
                'dense outlined data-testid="layer"'
            )
            self._layer.style("width:165px").on_value_change(self.refresh)
            with ui.element("div").classes("row grow") as self._label_tools:
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
        count = len({each["properties"]["material"] for each in labels})
        self._count.set_text(f"{len(labels)} labels, {count} materials")
        shapes = ground.outlines(grid, labels) if on and grid is not None else []
        ui.run_javascript(f"studio.showLabels({json.dumps(shapes)})")

    def _remove(self) -> None:
        del self._session.labels[-1:]
        self._labelled()

    def _download(self) -> None:
        grid = self._session.base.grid
        if grid is not None:
            text = json.dumps(ground.collection(grid, self._session.labels), indent=1)
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
            session.learned = await run.io_bound(ground.learned_from, session, progress) or {}
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
            self.refresh()

    def open(self) -> None:
        """Show the map of the current version."""
        self._paint.set_options(sorted(self._session.document.library), value=self._tab.editor.name)
        self.refresh()
        ui.run_javascript(f"studio.setUpMap(); studio.tool({json.dumps(self._tool.value)})")

    def refresh(self) -> None:
        """Show the current version of the edits."""
        version, layer = self._session.history.version, ground.layer_of(self._session, self._layer.value)
        address = f"/map/{self._layer.value}/{version}/{int(self._percent.value)}"
        ui.run_javascript(f"studio.showMap({json.dumps(address)}, {version})")
        self._words.set_text(layer.words)
        show_legend(self._legend, layer.legend)

    def _area(self, event: Any) -> None:
        given, scene, material = event.args, self._session.scene, str(self._paint.value or "")
        try:
            if not material:
                raise ThermorenderError("no material to paint with is chosen; choose one above the map")
            if given["tool"] == "fill":
                shape = ground.filled(scene, *map(float, given["points"][0]))
            else:
                shape = ground.polygon(scene, given["points"])
        except ThermorenderError as error:
            self._tab.say(str(error))
            return
        label = ground.labelled(shape, material)
        if self._use.value == "label":
            self._session.labels.append(label)
            self._labelled()
            return
        area = ground.collection(ground.grid_of(scene), [label])
        self._tab.edit(
            int(given["version"]), f"area of {material}", lambda document: document.with_area(area, material)
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
                ui.button("Save").props('dense data-testid="save"').on("click", self._save, js_handler=VERSION)
                ui.button("Reload", on_click=self._reload).props('outline dense data-testid="reload"')
            self._diff = ui.label("").classes("diff").props('data-testid="diff"')
        with ui.element("div").classes("part"):
            ui.html("<h2>Export the view</h2>", sanitize=False)
            with ui.row().style("gap:8px;align-items:center"):
                self._kind = ui.select(_KINDS, value="png", label="Kind").props("dense outlined").style("width:200px")
                self._metres = ui.number("Pixel [m]", value=0.5, min=0.01).props("dense outlined").style("width:100px")
                ui.button("Export", on_click=self._export).props("dense")
        with ui.element("div").classes("part"):
            ui.html("<h2>The same without the page</h2>", sanitize=False)
            ui.button("Show", on_click=self._commands).props("outline dense")
            self._code = ui.label("").classes("diff").props('data-testid="code"')
            self._code.set_visibility(False)
        self._diff.set_visibility(False)

    def _tell(self, text: str) -> None:
        self._diff.set_visibility(True)
        self._diff.set_text(text)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Show the sentence of a refusal."""
        try:
            yield
        except ThermorenderError as error:
            self._tell(str(error))

    async def _export(self) -> None:
        with self._told():
            metres = float(self._metres.value or 0.5)
            made = await run.io_bound(exported, self._session, self._tab.key, self._kind.value, metres)
            if made is not None:
                ui.download.content(*made)

    def _commands(self) -> None:
        self._code.set_visibility(True)
        self._code.set_text("\n".join(commands(self._session, self._tab.view)))

    def _plan(self) -> Save | None:
        with self._told():
            save = self._session.files.plan(self._session.document)
            self._tell("\n".join(save.lines) or "nothing to save: the files hold what is shown")
            return save
        return None

    async def _save(self, event: Any) -> None:
        with self._told():
            self._session.history.refuse_outdated(int(event.args), self._tab.key)
            save = self._plan()
            if save is None or not save.files:
                return
            with ui.dialog() as dialog, ui.card().style("min-width:min(760px,90vw)"):
                ui.label("These changes will be written").style("font-weight:600")
                ui.label("\n".join(save.lines)).classes("diff").style("max-height:55vh;overflow:auto;width:100%")
                with ui.row():
                    ui.button("Write", on_click=lambda: dialog.submit(True)).props('data-testid="write"')
                    ui.button("Cancel", on_click=lambda: dialog.submit(False)).props("flat")
            if await dialog:
                self._session.write(save)
                self._tell(f"saved: {len(save.files)} files\n" + "\n".join(save.lines))

    async def _reload(self) -> None:
        with self._told():
            self._session.reload(await run.io_bound(load_scene, self._session.base.spec.folder))  # type: ignore[arg-type]
            self._tell("read again from disk")
