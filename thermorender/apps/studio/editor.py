"""The list of materials and the panels of the chosen one: its spectrum, its optical and its thermal properties."""

from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

from nicegui import ui

from thermorender import Material
from thermorender.apps.material_tables.edit import EMISSIVITY, is_chosen, text_of
from thermorender.apps.studio import spectrum
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.panels import VERSION, Cover, Entry, Files, draw
from thermorender.apps.studio.pictures import hexadecimal
from thermorender.apps.studio.session import BAND_K, band_mean
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import SOLAR_STD_COLUMN

if TYPE_CHECKING:
    from thermorender.apps.studio.page import Tab

# Labels of the fields by the columns of the tables; those without a unit are wide, but for the licence.
_OPTICAL = {
    EMISSIVITY: "Emissivity, flat [1]", "solar_absorptance": "Solar absorptance [1]",
    SOLAR_STD_COLUMN: "± standard deviation [1]", "temperature_k": "Typical temperature [K]", "title": "Title",
    "source": "Source", "citation": "Citation", "licence": "Licence", "note": "Note",
}  # fmt: skip
_THERMAL = {
    "cover": "Cover", "conductivity_w_m_k": "Conductivity [W m⁻¹ K⁻¹]", "density_kg_m3": "Density [kg m⁻³]",
    "specific_heat_j_kg_k": "Specific heat [J kg⁻¹ K⁻¹]", "thickness_m": "Thickness [m]", "beneath": "Beneath",
    "skin_conductance_w_m2_k": "Skin conductance [W m⁻² K⁻¹]", "roughness_m": "Roughness length [m]",
    "heat_roughness_ratio": "ln(z0/z0h) [1]", "surface_resistance_s_m": "Surface resistance [s m⁻¹]",
    "wetness": "Wetness [1]", "water_share": "Freezable water [m³ m⁻³]",
    "attenuation_1_m": "Attenuation of sunlight [m⁻¹]", "melting_k": "Melting point [K]", "texture": "Soil texture",
}  # fmt: skip
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
    """What a tab shows of the materials: the list on the left, and the panels on the right."""

    def __init__(self, tab: "Tab", left: ui.element, right: ui.element) -> None:
        self._tab, self._session = tab, tab.session
        self._band_um = tab.session.base.camera.band_um
        self.name = self._first()
        self._entries: dict[str, Entry] = {}
        self._about: dict[str, ui.html] = {}
        self._overlay: Material | None = None
        with left:
            self._list()
        with right:
            self._panels()
        ui.on("studio_spectrum", self._dragged)

    def refresh(self) -> None:
        """Show the current version of the edits."""
        if self.name not in self._session.document.library:
            gone, self.name = self.name, self._first()
            self._tab.say(f"{gone} is no longer there; the fields show {self.name} now", "info")
            # What is typed for one material must not go on in the field of another.
            ui.run_javascript("document.activeElement.blur()")
        self._show()
        self._cover.refresh()

    def drop_typed(self) -> None:
        """Let the next refresh replace text that is typed and not part of the edits."""
        for entry in self._entries.values():
            entry.drop_typed()
        self._cover.drop_typed()

    def choose(self, name: str) -> None:
        """Show another material."""
        if name in self._session.document.library:
            self.name = name
            self._show()

    def _show(self) -> None:
        self._fill_list()
        self._fill()

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
            self._all = ui.toggle({False: "Scene", True: "All"}, value=False, on_change=self._fill_list)
            self._all.props('dense no-caps data-testid="scope"')
        with ui.element("div").classes("head"):
            for label, ask in (("Duplicate", self._duplicate), ("Rename", self._rename), ("Delete", self._delete)):
                button = ui.button(label).props(f'outline dense data-testid="{label.lower()}"').style("padding:0 8px")
                button.on("click", ask, js_handler=VERSION)
        with ui.element("div").classes("grow list"):
            self._table: ui.table = ui.table(rows=[], columns=_COLUMNS, row_key="name", pagination=0)
            self._table.props('flat dense hide-pagination :rows-per-page-options="[0]" data-testid="materials"')
            self._table.props('no-data-label="No material of the library is in use; All lists them"')
            self._table.add_slot("body", _ROW)
            self._table.on("pick", lambda e: self.choose(str(e.args)))

    def _fill_list(self) -> None:
        document, shares = self._session.document, self._session.shares()
        edited = set(document.changed(self._session.files.saved))
        used = set(shares) | set(document.classes.values()) | {name for name, _ in document.objects.values()} | edited
        self._table.rows = [
            {
                "name": name, "band": band_mean(each, self._band_um), "share": shares.get(name, 0.0),
                "colour": hexadecimal(each.colour), "edited": name in edited,
                "chosen": name == self.name, "title": each.title,
            }
            for name, each in sorted(document.library.items(), key=lambda item: (-shares.get(item[0], 0.0), item[0]))
            if self._all.value or name in used
        ]  # fmt: skip

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

        accept.on("click", done, js_handler=VERSION)
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
                with ui.element("div").classes("part"), ui.element("div").classes("fields"):
                    for key, label in _OPTICAL.items():
                        entry = self._entry(key, label)
                        if "[" not in label and key != "licence":
                            entry.classes("wide")
            with ui.tab_panel(thermal), ui.element("div").classes("part"):
                self._thermal_note = ui.label("").classes("soft")
                with ui.element("div").classes("thermal"):
                    for key, label in _THERMAL.items():
                        self._entry(key, label)
                        self._about[key] = ui.html("", sanitize=False).classes("about")
            with ui.tab_panel(cover):
                self._cover = Cover(self._tab)
            with ui.tab_panel(files):
                Files(self._tab)

    def _entry(self, key: str, label: str) -> Entry:
        called = label.partition(" [")[0].lower()
        self._entries[key] = Entry(
            self._tab, key, f"field-{key}", lambda document, text: document.with_text(self.name, key, text),
            lambda text: f"{self.name}: {called} {text}", label=label,
        )  # fmt: skip
        return self._entries[key]

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
                self._width = ui.select(_WIDTHS, value=0.5).props('dense borderless aria-label="Width of a drag"')

    def _load(self) -> None:
        """Ask for a spectrum, to replace that of the material or to lay over it."""
        name = self.name
        given: dict[str, Any] = {"name": "pasted text", "data": b""}

        async def uploaded(event: Any) -> None:
            given["name"], given["data"] = event.file.name, await event.file.read()

        def read(document: Document) -> Material:
            pasted = str(text.value or "").encode()
            source, data = ("pasted text", pasted) if pasted else (str(given["name"]), bytes(given["data"]))
            sample = str(column.value or "").strip() or None
            return spectrum.read_spectrum(source, data, document.material(name), sample)

        def overlay() -> None:
            try:
                self._overlay = read(self._session.document)
            except ThermorenderError as error:
                fault.set_text(str(error))
                return
            dialog.close()
            self._fill()

        def use(event: Any) -> None:
            change = f"{name}: spectrum of {given['name']}"
            refused = self._tab.edit(
                int(event.args), change, lambda document: document.with_material(read(document)), True
            )
            fault.set_text(refused)
            if not refused:
                dialog.close()

        def too_large() -> None:
            fault.set_text(
                f"the file is larger than {spectrum.MOST_BYTES // 1_000_000} MB; give a table of one spectrum"
            )

        with ui.dialog() as dialog, ui.card().style("min-width:min(620px,90vw)"):
            dialog.on("hide", dialog.delete)
            ui.label(f"Spectrum for {name}").style("font-weight:600")
            ui.upload(label="ECOSTRESS, SLUM or CSV file", auto_upload=True, max_file_size=spectrum.MOST_BYTES - 4096,
                      max_files=1, on_upload=uploaded, on_rejected=too_large).style("width:100%")  # fmt: skip
            text = ui.textarea("Or paste columns with headings: wavelength_um,emissivity or wavelength_um,n,k")
            text.props('outlined data-testid="paste"').style("width:100%")
            column = ui.input("Sample of a table with several").props("dense outlined").style("width:100%")
            fault = ui.label("").classes("say").props('data-testid="load-fault"')
            with ui.row():
                replace = ui.button("Replace the spectrum").props('data-testid="replace"')
                replace.on("click", use, js_handler=VERSION)
                ui.button("Lay over it", on_click=overlay).props("outline")
                ui.button("Cancel", on_click=dialog.close).props("flat")
        dialog.open()

    def _fill(self) -> None:
        material, saved = self._session.document.material(self.name), self._session.files.saved.library.get(self.name)
        self._title.set_text(self.name)
        self._subtitle.set_text(material.title)
        for key, entry in self._entries.items():
            entry.fill(self.name, text_of(material, key))
        self._fill_spectrum(material, None if saved is material else saved)
        thermal = material.thermal
        self._thermal_note.set_text(
            f"Value ± one standard deviation, and its source. Thermal inertia {thermal.inertia:.0f} J m⁻² K⁻¹ s^-½."
            if thermal
            else "No thermal table: a heat balance cannot use this material until all values are given."
        )
        for key, about in self._about.items():
            spread = thermal.uncertainty.get(key) if thermal else None
            source = thermal.source.get(key, "").removeprefix("chosen:").strip() if thermal else ""
            flag = '<span class="flag">chosen, not measured</span> ' if is_chosen(material, key) else ""
            words = escape(" · ".join(filter(None, (f"± {spread:g}" if spread else "", source))))
            about.set_content(f'<div title="{words}">{flag}{words}</div>')

    def _fill_spectrum(self, material: Material, saved: Material | None) -> None:
        band, mean = self._band_um, band_mean(material, self._band_um)
        self._band.set_text(
            f"{mean:.4f} over {band[0]:g}–{band[1]:g} µm at {BAND_K:g} K"
            if mean is not None
            else f"not measured over {band[0]:g}–{band[1]:g} µm"
        )
        directional = material.emissivity_by_angle is not None and mean is not None
        self._angles.set_visibility(directional)
        draw(self._chart, spectrum.options(material, saved, self._overlay, band))
        if directional:
            draw(self._angles, spectrum.by_angle(material, band, BAND_K))
        ui.run_javascript(f"studio.spectrum({self._chart.id}, {spectrum.HANDLES})")

    def _dragged(self, event: Any) -> None:
        given, name, width = event.args, self.name, float(self._width.value)
        wavelength, value = float(given["wavelength"]), float(given["value"])

        def change(document: Document) -> Document:
            return document.with_material(spectrum.dragged(document.material(name), wavelength, value, width))

        if self._tab.edit(int(given["version"]), f"{name}: emissivity at {wavelength:.2f} µm {value:.3f}", change):
            self._fill()
