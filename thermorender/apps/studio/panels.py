"""Parts of the page: a field that is typed into, what the materials cover, labels to train on, and files."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from nicegui import run, ui

from thermorender import load_scene
from thermorender.apps.studio import labels
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.exports import KINDS, commands, exported
from thermorender.apps.studio.scene_files import Save
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import decimal
from thermorender.units import kelvin

if TYPE_CHECKING:
    from thermorender.apps.studio.page import Tab

# What events of the page send: the version of the edits that it shows, and their value before it.
VERSION, VALUE_AND_VERSION = (
    "() => studio.sent(emit, studio.version)",
    "(value) => studio.sent(emit, value, studio.version)",
)


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

        given.on("update:model-value", done, js_handler="(one) => studio.sent(emit, one && one.label, studio.version)")
        return given


class Training:
    """Labels that a hand draws in the view, and a map that is learned from them."""

    def __init__(self, tab: "Tab") -> None:
        self._tab, self._session = tab, tab.session
        with ui.element("div").classes("part"):
            ui.html("<h2>Learn a map from labels</h2>", sanitize=False)
            ui.label(
                "While this is on, the tools of the view label areas with the chosen material, and paint nothing. "
                "Label two materials or more, each in several places. The map is learned from the orthophoto of the "
                "scene as saved."
            ).classes("soft")
            self._on = ui.switch("Tools label", on_change=tab_follows(tab)).props('dense data-testid="labelling"')
            self._count = ui.label("").classes("soft").props('role="status" data-testid="labels"')
            with ui.row().style("gap:8px;margin-top:6px"):
                for text, does in (("Remove", self._remove), ("Train", self._train), ("Download", self._download)):
                    ui.button(text, on_click=does).props(f'outline dense no-caps data-testid="{text.lower()}"')
                self._cancel = ui.button("Cancel", on_click=self._session.stop_training.set)
                self._cancel.props('flat dense no-caps data-testid="cancel-training"').set_visibility(False)
        self._counted()

    @property
    def labels_now(self) -> bool:
        """Whether strokes label instead of paint."""
        return bool(self._on.value)

    def label(self, geometries: list[dict[str, Any]], material: str) -> None:
        """Label areas with a material."""
        self._session.labels.append([labels.labelled(each, material) for each in geometries])
        self._counted()

    def _counted(self) -> None:
        count = len({each[0]["properties"]["material"] for each in self._session.labels})
        self._count.set_text(f"{len(self._session.labels)} labels, {count} materials")

    def _remove(self) -> None:
        del self._session.labels[-1:]
        self._counted()

    def _download(self) -> None:
        grid = self._session.base.grid
        if grid is None:
            self._tab.say("this scene has no orthophoto to label; labels need a terrain of rasters")
            return
        features = [feature for each in self._session.labels for feature in each]
        ui.download.content(json.dumps(labels.collection(grid, features), indent=1).encode(), "labels.geojson")

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
            session.renders.learned = await run.io_bound(labels.learned_from, session, progress)
        except ThermorenderError as error:
            fault = str(error)
        finally:
            session.training.release()
        if self._tab.closed:
            return
        self._cancel.set_visibility(False)
        self._counted()
        if fault:
            self._tab.say(fault)
        else:
            stage = self._tab.stage
            if stage.view.layer == "learned":
                stage.look()
            else:
                stage.change(layer="learned")


def tab_follows(tab: "Tab") -> Callable[[], None]:
    """Return a function that lets the tools of a tab's view show what they do now."""
    return lambda: tab.stage.refresh()


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
                self._kind = ui.select(KINDS, value="png", label="Kind").props('dense outlined data-testid="kind"')
                self._kind.style("width:290px")
                self._metres = ui.number("Pixel [m]", value=0.5, min=0.01).props("dense outlined").style("width:100px")
                self._metres.bind_visibility_from(self._kind, "value", lambda kind: kind == "map.tif")
                ui.button("Export", on_click=self._export).props('dense data-testid="export"')
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
        self._code.set_text("\n".join(commands(self._session, self._tab.stage.view)))

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
        if self._session.unsaved:
            with ui.dialog() as dialog, ui.card():
                ui.label("Unsaved edits of all tabs are lost when the files are read again.")
                with ui.row():
                    lose = ui.button("Reload without saving", on_click=lambda: dialog.submit(True))
                    lose.props('data-testid="lose"')
                    ui.button("Cancel", on_click=lambda: dialog.submit(False)).props("flat")
            if not await dialog:
                return
        with self._told():
            self._session.reload(await run.io_bound(load_scene, self._session.base.spec.folder))  # type: ignore[arg-type]
            self._tell("read again from disk")
