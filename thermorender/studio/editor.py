"""The list of materials and the panels of the chosen one: its spectrum, its optical and its thermal properties."""

from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

from nicegui import ui

from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.studio import fields, spectrum
from thermorender.studio.access import MOST_BYTES
from thermorender.studio.document import Document
from thermorender.studio.fields import OPTICAL, THERMAL, Field, alike, chosen, text_of
from thermorender.studio.panels import Cover, Files
from thermorender.studio.pictures import hexadecimal
from thermorender.studio.session import BAND_K

if TYPE_CHECKING:
    from thermorender.studio.page import Tab

_COLUMNS = [
    {"name": "name", "label": "Material", "field": "name", "align": "left", "sortable": True},
    {"name": "band", "label": "ε band", "field": "band", "align": "right", "sortable": True},
    {"name": "share", "label": "Cover", "field": "share", "align": "right", "sortable": True},
]
_ROW = """
<q-tr :props="props" tabindex="0" :data-name="props.row.name" :class="props.row.chosen ? 'chosen' : ''"
      :aria-selected="props.row.chosen ? 'true' : 'false'"
      @click="$parent.$emit('pick', props.row.name)" @keydown.enter="$parent.$emit('pick', props.row.name)">
  <q-td><div class="name"><span class="swatch" :style="{background: props.row.colour}"></span>
    <span class="text" :title="props.row.title">{{ props.row.name }}</span>
    <span v-if="props.row.edited" class="edited" title="edited, not saved">●</span></div></q-td>
  <q-td class="text-right">{{ props.row.band === null ? '–' : props.row.band.toFixed(3) }}</q-td>
  <q-td class="text-right">{{ props.row.share ? (100 * props.row.share).toFixed(1) + ' %' : '' }}</q-td>
</q-tr>
"""
_WIDTHS = {0.0: "this point", 0.15: "± 0.15 µm", 0.5: "± 0.5 µm", 1.5: "± 1.5 µm"}


class Editor:
    """What a tab shows of the materials.

    Parameters
    ----------
    tab : Tab
    left, right : ui.element
        Where the list and the panels go.
    """

    def __init__(self, tab: "Tab", left: ui.element, right: ui.element) -> None:
        self._tab, self._session = tab, tab.session
        self.name = self._first()
        self._inputs: dict[str, Any] = {}
        self._about: dict[str, ui.html] = {}
        # Material and text that each field was last filled with; key and text of an edit that is not shown yet.
        self._filled: dict[str, tuple[str, str]] = {}
        self._typed = "", ""
        self._all, self._width = False, 0.5
        self._overlay: Material | None = None
        with left:
            self._list()
        with right:
            self._panels()
        ui.on("studio_spectrum", self._dragged)

    @property
    def material(self) -> Material:
        """The chosen material."""
        return self._session.document.library[self.name]

    def refresh(self) -> None:
        """Show the current version of the edits."""
        if self.name not in self._session.document.library:
            gone, self.name = self.name, self._first()
            self._tab.say(f"{gone} is no longer there; the fields show {self.name} now", "info")
            # What is typed for one material must not go on in the field of another.
            ui.run_javascript("document.activeElement.blur()")
        self._fill_list()
        self._fill()
        self._cover.refresh()

    def drop_typed(self) -> None:
        """Let the next refresh replace text that is typed and not part of the edits."""
        self._filled.clear()
        self._cover.drop_typed()

    def _first(self) -> str:
        """The material that covers most."""
        library, shares = self._session.document.library, self._session.shares()
        return max(library, key=lambda name: shares.get(name, 0.0))

    # The list.

    def _list(self) -> None:
        with ui.element("div").classes("head"):
            search = ui.input(placeholder="Search materials").props(
                'dense outlined clearable aria-label="Search materials" data-testid="search"'
            )
            search.on_value_change(lambda e: self._table.props.__setitem__("filter", e.value or ""))
            scope = ui.toggle({False: "Scene", True: "All"}, value=False).props('dense no-caps data-testid="scope"')
            scope.on_value_change(self._scoped)
        with ui.element("div").classes("head"):
            for label, ask in (("Duplicate", self._duplicate), ("Rename", self._rename)):
                ui.button(label, on_click=ask).props(f'outline dense data-testid="{label.lower()}"').style(
                    "padding:0 8px"
                )
            delete = ui.button("Delete").props('outline dense data-testid="delete"').style("padding:0 8px")
            delete.on("click", self._delete, js_handler="() => emit(studio.version)")
        with ui.element("div").classes("grow list"):
            self._table: ui.table = ui.table(rows=[], columns=_COLUMNS, row_key="name", pagination=0)
            self._table.props('flat dense hide-pagination :rows-per-page-options="[0]" data-testid="materials"')
            self._table.props('no-data-label="No material of the library is in use; All lists them"')
            self._table.add_slot("body", _ROW)
            self._table.on("pick", lambda e: self.choose(str(e.args)))

    def _scoped(self, event: Any) -> None:
        self._all = bool(event.value)
        self._fill_list()

    def _fill_list(self) -> None:
        document, shares = self._session.document, self._session.shares()
        edited = set(document.changed(self._session.history.saved))
        used = set(shares) | set(document.classes.values()) | {name for name, _ in document.objects.values()} | edited
        rows = [
            {
                "name": name, "band": self._session.band_mean(each), "share": shares.get(name, 0.0),
                "colour": hexadecimal(each.colour), "edited": name in edited,
                "chosen": name == self.name, "title": each.title,
            }
            for name, each in sorted(document.library.items(), key=lambda item: (-shares.get(item[0], 0.0), item[0]))
            if self._all or name in used
        ]  # fmt: skip
        self._table.rows = rows

    def choose(self, name: str) -> None:
        """Show another material."""
        if name in self._session.document.library:
            self.name = name
            self._fill_list()
            self._fill()

    def _named(self, title: str, proposal: str, change: Callable[[Document, str], Document], what: str) -> None:
        """Ask for a name, and change the document with it."""
        with ui.dialog() as dialog, ui.card():
            dialog.on("hide", dialog.delete)
            ui.label(title)
            given = ui.input("Name", value=proposal).props('autofocus outlined dense data-testid="new-name"')
            given.style("min-width:260px")
            with ui.row():
                accept = ui.button("OK").props('data-testid="accept"')
                ui.button("Cancel", on_click=dialog.close).props("flat")

        def done(event: Any) -> None:
            name = (given.value or "").strip()
            if fault := self._tab.edit(
                int(event.args), f"{what} {name}", lambda document: change(document, name), True
            ):
                given.error = fault
                return
            dialog.close()
            self.choose(name)

        accept.on("click", done, js_handler="() => emit(studio.version)")
        dialog.open()

    def _duplicate(self) -> None:
        old = self.name
        self._named(f"Copy of {old}", f"{old}_2", lambda document, name: document.duplicated(old, name), f"{old} as")

    def _rename(self) -> None:
        old = self.name
        self._named(f"New name of {old}", old, lambda document, name: document.renamed(old, name), f"{old} renamed")

    def _delete(self, event: Any) -> None:
        name = self.name
        self._tab.edit(int(event.args), f"{name} deleted", lambda document: document.without(name))

    # The panels.

    def _panels(self) -> None:
        with ui.element("div").classes("part titleline"):
            self._title = ui.label("").classes("big").props('data-testid="title"')
            self._subtitle = ui.label("").classes("soft")
        with ui.tabs().props("dense align=left no-caps") as tabs:
            optical, thermal, cover, files = map(ui.tab, ("Optical", "Thermal", "Cover", "Files"))
        with ui.tab_panels(tabs, value=optical, animated=False).classes("grow"):
            with ui.tab_panel(optical):
                self._spectrum_part()
                with ui.element("div").classes("part"):
                    with ui.element("div").classes("fields"):
                        for one in OPTICAL:
                            self._field(one, wide=not one.unit and one.key != "licence")
            with ui.tab_panel(thermal):
                with ui.element("div").classes("part"):
                    self._thermal_note = ui.label("").classes("soft")
                    with ui.element("div").classes("thermal"):
                        for one in THERMAL:
                            self._field(one)
                            self._about[one.key] = ui.html("", sanitize=False).classes("about")
            with ui.tab_panel(cover):
                self._cover = Cover(self._tab)
            with ui.tab_panel(files):
                Files(self._tab)

    def _spectrum_part(self) -> None:
        with ui.element("div").classes("part"):
            with ui.element("div").classes("titleline"):
                ui.html("<h2>Emissivity</h2>", sanitize=False)
                self._band = ui.label("").classes("soft").props('data-testid="band"')
            self._chart = ui.echart({"series": []}).style("height:190px;width:100%").props('data-testid="spectrum"')
            self._chart.props('role="img" aria-label="Emissivity against wavelength, with the band of the camera"')
            self._angles = ui.echart({"series": []}).style("height:150px;width:100%")
            self._angles.props('role="img" aria-label="Band emissivity against the angle from the normal"')
            with ui.element("div").classes("row"):
                ui.label("Drag a point").classes("soft")
                ui.button("Load or paste", on_click=self._load).props('outline dense data-testid="load"')
                width = ui.select(_WIDTHS, value=self._width).props('dense borderless aria-label="Width of a drag"')
                width.on_value_change(lambda e: setattr(self, "_width", float(e.value)))

    def _load(self) -> None:
        """Ask for a spectrum, to replace that of the material or to lay over it."""
        name = self.name
        given: dict[str, Any] = {"name": "pasted text", "data": b""}

        async def uploaded(event: Any) -> None:
            given["name"], given["data"] = event.file.name, await event.file.read()

        def read(document: Document) -> tuple[Material, str | None]:
            pasted = str(text.value or "").encode()
            source, data = ("pasted text", pasted) if pasted else (str(given["name"]), bytes(given["data"]))
            return fields.read_spectrum(source, data, document.material(name), str(column.value or "").strip())

        def overlay() -> None:
            try:
                self._overlay = read(self._session.document)[0]
            except ThermorenderError as error:
                fault.set_text(str(error))
                return
            dialog.close()
            self._fill()

        def use(event: Any) -> None:
            change = f"{name}: spectrum of {given['name']}"
            refused = self._tab.edit(
                int(event.args), change, lambda document: document.with_material(*read(document)), True
            )
            fault.set_text(refused)
            if not refused:
                dialog.close()

        def too_large() -> None:
            fault.set_text(f"the file is larger than {MOST_BYTES // 1_000_000} MB; give a table of one spectrum")

        with ui.dialog() as dialog, ui.card().style("min-width:min(620px,90vw)"):
            dialog.on("hide", dialog.delete)
            ui.label(f"Spectrum for {name}").style("font-weight:600")
            ui.upload(label="ECOSTRESS, SLUM or CSV file", auto_upload=True, max_file_size=MOST_BYTES - 4096,
                      max_files=1, on_upload=uploaded, on_rejected=too_large).style("width:100%")  # fmt: skip
            text = ui.textarea("Or paste columns with headings: wavelength_um,emissivity or wavelength_um,n,k")
            text.props('outlined data-testid="paste"').style("width:100%")
            column = ui.input("Sample of a table with several").props("dense outlined").style("width:100%")
            fault = ui.label("").classes("say").props('data-testid="load-fault"')
            with ui.row():
                replace = ui.button("Replace the spectrum").props('data-testid="replace"')
                replace.on("click", use, js_handler="() => emit(studio.version)")
                ui.button("Lay over it", on_click=overlay).props("outline")
                ui.button("Cancel", on_click=dialog.close).props("flat")
        dialog.open()

    def _field(self, one: Field, wide: bool = False) -> None:
        def fault(text: str) -> str | None:
            try:
                fields.changed(self._session.document, self.name, one.key, text or "")
            except ThermorenderError as error:
                return str(error)
            return None

        def done(event: Any) -> None:
            text, version, name = str(event.args[0] or ""), int(event.args[1]), self.name
            what, self._typed = f"{name}: {one.label.lower()} {text}", (one.key, text)
            known = self._filled.pop(one.key, None)
            refused = self._tab.edit(
                version, what, lambda document: fields.changed(document, name, one.key, text), True
            )
            given.error = refused or None
            if refused and known and one.key not in self._filled:
                # Text that is refused stays to be corrected.
                self._filled[one.key] = known

        label = f"{one.label} [{one.unit}]" if one.unit else one.label
        given = ui.input(label, validation=fault).props(f'dense outlined data-testid="field-{one.key}"')
        if wide:
            given.classes("wide")
        given.on("change", done, js_handler="(value) => emit(value, studio.version)")
        self._inputs[one.key] = given

    def _fill(self) -> None:
        material, saved = self.material, self._session.history.saved.library.get(self.name)
        self._title.set_text(self.name)
        self._subtitle.set_text(material.title)
        for key, given in self._inputs.items():
            known, text = self._filled.get(key), text_of(material, key)
            self._filled[key] = (self.name, text)
            # A field whose edit this is keeps its own form of the value: what is typed next may be in it already.
            if known == self._filled[key] or (key == self._typed[0] and alike(text, self._typed[1])):
                continue
            if known and known[0] == self.name and not alike(str(given.value or ""), known[1]):
                self._tab.say(
                    f"{key} of {self.name} is now {text or 'empty'}; the text in the field stays as typed", "info"
                )
                continue
            given.set_value(text)
            given.error = None
        self._fill_spectrum(material, None if saved is material else saved)
        thermal = material.thermal
        self._thermal_note.set_text(
            f"Value ± one standard deviation, and its source. Thermal inertia {thermal.inertia:.0f} J m⁻² K⁻¹ s^-½."
            if thermal
            else "No thermal table: a heat balance cannot use this material until all values are given."
        )
        self._typed = "", ""
        for key, about in self._about.items():
            spread = thermal.uncertainty.get(key) if thermal else None
            source = thermal.source.get(key, "") if thermal else ""
            flag = '<span class="flag">chosen, not measured</span> ' if chosen(material, key) else ""
            words = " · ".join(
                filter(None, (f"± {spread:g}" if spread else "", source.removeprefix("chosen:").strip()))
            )
            about.set_content(f'<div title="{escape(words)}">{flag}{escape(words)}</div>')

    def _fill_spectrum(self, material: Material, saved: Material | None) -> None:
        band = self._session.base.camera.band_um
        mean = self._session.band_mean(material)
        self._band.set_text(
            f"{mean:.4f} over {band[0]:g}–{band[1]:g} µm at {BAND_K:g} K"
            if mean is not None
            else f"not measured over {band[0]:g}–{band[1]:g} µm"
        )
        self._chart.options.clear()
        self._chart.options.update(spectrum.options(material, saved, self._overlay, band))
        self._chart.update()
        directional = material.emissivity_by_angle is not None and mean is not None
        self._angles.set_visibility(directional)
        if directional:
            self._angles.options.clear()
            self._angles.options.update(spectrum.by_angle(material, band, BAND_K))
            self._angles.update()
        ui.run_javascript(f"studio.spectrum({self._chart.id}, {spectrum.HANDLES})")

    def _dragged(self, event: Any) -> None:
        given, name, width = event.args, self.name, self._width
        wavelength, value = float(given["wavelength"]), float(given["value"])

        def change(document: Document) -> Document:
            return document.with_material(fields.dragged(document.material(name), wavelength, value, width))

        if self._tab.edit(int(given["version"]), f"{name}: emissivity at {wavelength:.2f} µm {value:.3f}", change):
            self._fill()
