"""The start page: scenes to open, and forms that import a terrain or make a practice scene."""

import os
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import run, ui

from thermorender import defaults
from thermorender.apps.studio.forms import IMPORT, PRACTICE, Field, about, completions, path_of
from thermorender.apps.studio.opening import Studio, Work
from thermorender.apps.studio.scene_list import Listed
from thermorender.errors import ThermorenderError

_FOLDER = Path(__file__).parent
# How often the page looks at the work under way [s].
_LOOKS_S = 0.3
_SHOW_SCENE = 'location.pathname === "/scene" ? location.reload() : location.assign("/scene")'


class Start:
    """The start page in a tab. It shows the scene that the `followed` work opens; `told` says why a tab is here."""

    def __init__(
        self, studio: Studio, shipped: Sequence[Listed], recent: Sequence[Listed], followed: Work | None, told: str
    ) -> None:  # fmt: skip
        self._studio, self._followed, self._told = studio, followed, told
        self._shown: Any = None
        self._faults: dict[str, ui.label] = {}
        ui.add_head_html(f"<style>{(_FOLDER / 'start.css').read_text('utf-8')}</style>")
        ui.query("html").props('lang="en"')
        ui.dark_mode(None)
        with ui.element("header").classes("bar"):
            ui.html("<h1>Thermorender studio</h1>", sanitize=False)
        with ui.element("main").classes("start"):
            self._state()
            with self._part("scenes", "Scenes"):
                self._scenes("cards", shipped)
            if recent:
                with self._part("recent", "Recent scenes"):
                    self._scenes("rows", recent)
            with self._part("folder", "Open a folder"):
                self._folder()
            with ui.element("div").classes("forms"):
                with self._part("import", "Import an elevation model and an orthophoto"):
                    self._import = Form("import", IMPORT, "Import and open", partial(self._begin_form, "import"))
                with self._part("practice", "Make a practice scene"):
                    self._practice = Form("practice", PRACTICE, "Make and open", partial(self._begin_form, "practice"))
        ui.timer(_LOOKS_S, self._look)
        self._look()

    # The parts of the page.

    def _state(self) -> None:
        """What is open, and what is under way."""
        with ui.element("section").classes("now").props('aria-label="State"') as self._state_box:
            if self._told:
                ui.label(self._told).classes("told").props('role="status" data-testid="told"')
            with ui.element("div") as self._open:
                self._open_words = ui.label("").props('data-testid="open"')
                ui.link("Back to it", "/scene").props('data-testid="back"')
            with ui.element("div") as self._work:
                self._work_words = ui.label("").props('data-testid="work"')
                self._progress = ui.element("progress").props('max="1" aria-label="Progress"')
                ui.button("Cancel", on_click=self._studio.cancel).props('outline dense data-testid="cancel"')

    def _part(self, key: str, title: str) -> ui.element:
        with ui.element("section").classes("part") as part:
            ui.html(f"<h2>{title}</h2>", sanitize=False)
            self._faults[key] = ui.label("").classes("fault").props(f'role="alert" data-testid="fault-{key}"')
        return part

    def _scenes(self, kind: str, scenes: Sequence[Listed]) -> None:
        part = "scenes" if kind == "cards" else "recent"
        with ui.element("div").classes(kind):
            for each in scenes:
                with ui.element("button").classes("scene") as button:
                    if kind == "cards" and each.orthophoto is not None:
                        image = ui.element("img").props('alt="" loading="lazy"')
                        image.props["src"] = f"/picture?scene={quote(str(each.folder), safe='')}"
                    ui.label(each.folder.name).classes("name")
                    ui.label(each.title).classes("title")
                    ui.label(each.about).classes("soft")
                    if kind == "rows":
                        ui.label(str(each.folder)).classes("soft path")
                # Names of folders may hold any characters.
                button.props.update({"type": "button", "data-testid": f"scene-{each.folder.name}"})
                button.on("click", partial(self._open_scene, each.folder, part))

    def _folder(self) -> None:
        async def opened() -> None:
            try:
                if not (field.value or "").strip():
                    raise ThermorenderError("the folder is empty; give the path of a scene's folder")
                folder = path_of(field.value)
            except ThermorenderError as error:
                self._faults["folder"].set_text(str(error))
            else:
                await self._open_scene(folder, "folder")

        with ui.element("div").classes("folder"):
            field = PathEntry("Folder with a scene.toml, on the machine of the studio", folders_only=True)
            field.props('data-testid="folder"').on("keydown.enter", opened)
            ui.button("Open", on_click=opened).props('data-testid="open-folder"')

    # What a hand does.

    async def _open_scene(self, folder: Path, part: str) -> None:
        session = self._studio.session
        if session is not None and os.path.realpath(session.base.spec.folder) == os.path.realpath(folder):
            ui.run_javascript(_SHOW_SCENE)
        else:
            await self._begin(part, lambda: self._studio.begin_opening(folder, part))

    async def _begin_form(self, part: str) -> None:
        form = {"import": self._import, "practice": self._practice}[part]
        await self._begin(part, lambda: self._studio.begin_form(part, form.texts()))

    async def _begin(self, part: str, begin: Callable[[], object]) -> None:
        """Begin work that opens a scene, where that is wanted although edits of another one are lost."""
        for fault in self._faults.values():
            fault.set_text("")
        for form in (self._import, self._practice):
            form.show_fault("")
        session = self._studio.session
        if session is not None and session.unsaved and not await _wanted(session.base.name):
            return
        try:
            begin()
            self._followed = self._studio.work
        except ThermorenderError as error:
            self._faults[part].set_text(str(error))
        self._look()

    # What the work shows.

    def _look(self) -> None:
        """Show the work under way, and follow it to the scene."""
        studio, busy, session = self._studio, self._studio.busy, self._studio.session
        words = f"{busy.title} – {busy.what}: {busy.share:.0%}" if busy else ""
        if busy and busy.cancelled:
            words = f"{busy.title} is being cancelled"
        # The page must not keep a scene that is closed.
        shown = words, session is not None and (session.base.spec.folder, session.unsaved)
        if shown != self._shown:
            self._shown = shown
            self._state_box.set_visibility(bool(words or self._told or session))
            self._work.set_visibility(bool(words))
            self._state_box.classes(add="busy" if words else "", remove="" if words else "busy")
            self._open.set_visibility(session is not None)
            self._work_words.set_text(words)
            self._progress.props["value"] = f"{busy.share:.3f}" if busy else "0"
            if session is not None:
                notes = "".join(f"\n{note}" for note in studio.notes)
                unsaved = ", with unsaved edits" if session.unsaved else ""
                self._open_words.set_text(f"{session.base.name} is open{unsaved}.{notes}")
        if self._followed is not None and self._followed.ended:
            work, self._followed = self._followed, None
            self._show_end(work)

    def _show_end(self, work: Work) -> None:
        form = {"import": self._import, "practice": self._practice}.get(work.part)
        if work.cancelled:
            self._faults[work.part].set_text(f"{work.title} was cancelled")
        elif not work.fault:
            ui.run_javascript(_SHOW_SCENE)
        elif form is None or not form.show_fault(work.fault):
            self._faults[work.part].set_text(work.fault)


class PathEntry(ui.input):
    """A field for a path on the machine of the studio, which completes it; Tab takes what it offers."""

    def __init__(self, label: str, folders_only: bool = False) -> None:
        super().__init__(label, on_change=self._typed)
        self.props('outlined dense hide-bottom-space spellcheck="false" autocapitalize="off"')
        self._folders_only = folders_only

    async def _typed(self) -> None:
        text = str(self.value or "")
        self.set_autocomplete(await run.io_bound(completions, text, self._folders_only) or [])


class Form:
    """The fields of a form, of which rare ones are shown on demand, and its button."""

    def __init__(self, name: str, fields: Sequence[Field], says: str, begin: Callable[[], object]) -> None:
        self._name, self._fields = name, fields
        self._entries: dict[str, Any] = {each.key: self._entry(each) for each in fields if not each.rare}
        self._more: ui.expansion | None = None
        if any(each.rare for each in fields):
            with ui.expansion("More").props('dense data-testid="more"').classes("more") as self._more:
                self._entries |= {each.key: self._entry(each) for each in fields if each.rare}
        ui.button(says, on_click=begin).props["data-testid"] = name

    def _entry(self, of: Field) -> Any:
        made: Any
        if of.kind == "flag":
            made = ui.checkbox(of.label).props("dense")
        elif of.kind == "choice":
            made = ui.select(list(defaults.SCENES), label=of.label, value=of.value)
            made.props("outlined dense options-dense hide-bottom-space")
        elif of.kind in ("file", "folder"):
            made = PathEntry(of.label, of.kind == "folder")
        else:
            made = ui.input(of.label, value=of.value).props("outlined dense hide-bottom-space")
        if of.hint:
            made.props["hint"] = of.hint
        made.props["data-testid"] = f"{self._name}-{of.key}"
        return made

    def texts(self) -> dict[str, str]:
        """Return the texts of the fields; a flag is "" or "yes"."""
        values = {key: entry.value for key, entry in self._entries.items()}
        return {key: "yes" if value is True else str(value or "").strip() for key, value in values.items()}

    def show_fault(self, sentence: str) -> bool:
        """Show a sentence at the field that it is about, and return whether there is one; "" takes it away."""
        key = about(sentence, self.texts()) if sentence else ""
        for each in self._fields:
            if each.kind not in ("flag", "choice"):
                self._entries[each.key].error = sentence if each.key == key else None
        rare = [each.key for each in self._fields if each.rare]
        if self._more is not None and any(re.search(rf"\b{name.replace('_', '[-_]')}\b", sentence) for name in rare):
            self._more.open()
        return bool(key)


async def _wanted(name: str) -> bool:
    """Ask whether unsaved edits may be lost."""
    with ui.dialog() as dialog, ui.card():
        ui.label(f"{name} has unsaved edits, which are lost when another scene is opened.")
        with ui.row():
            ui.button("Open without saving", on_click=lambda: dialog.submit(True)).props('data-testid="lose"')
            ui.button("Cancel", on_click=lambda: dialog.submit(False)).props("flat")
    return bool(await dialog)
