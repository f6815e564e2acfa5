"""The list of materials and the panels of the chosen one: its spectrum, its optical and its thermal properties."""

from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

from nicegui import ui

from thermorender import Material
from thermorender.apps.material_tables.edit import EMISSIVITY, text_of, thermal_text
from thermorender.apps.studio import spectrum
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.layers import BAND_K
from thermorender.apps.studio.panels import VERSION, Cover, Entry, Files, Training, draw
from thermorender.apps.studio.session import band_mean
from thermorender.apps.studio.stack import Stack
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import SOLAR_STD_COLUMN, decimal
from thermorender.materials.thermal import CHOSEN, PROPERTIES

if TYPE_CHECKING:
    from thermorender.apps.studio.page import Tab

# Labels of the fields by the columns of the tables; those without a unit are wide, but for the licence.
_OPTICAL = {
    EMISSIVITY: "Grey emissivity [1]", "solar_absorptance": "Solar absorptance [1]",
    SOLAR_STD_COLUMN: "Its standard deviation [1]", "temperature_k": "Typical temperature [K]", "title": "Title",
    "source": "Source", "citation": "Citation", "licence": "Licence", "note": "Note",
}  # fmt: skip
_THERMAL = {
    "cover": "Kind of cover", "conductivity_w_m_k": "Conductivity [W m⁻¹ K⁻¹]", "density_kg_m3": "Density [kg m⁻³]",
    "specific_heat_j_kg_k": "Specific heat [J kg⁻¹ K⁻¹]", "thickness_m": "Thickness [m]", "beneath": "Beneath",
    "skin_conductance_w_m2_k": "Skin conductance [W m⁻² K⁻¹]", "roughness_m": "Roughness length [m]",
    "heat_roughness_ratio": "ln(z0/z0h) [1]", "surface_resistance_s_m": "Surface resistance [s m⁻¹]",
    "wetness": "Wetness [1]", "water_share": "Freezable water [m³ m⁻³]",
    "attenuation_1_m": "Attenuation of sunlight [m⁻¹]", "melting_k": "Melting point [K]", "texture": "Soil texture",
}  # fmt: skip
# Of a layer below the surface, these count.
_OF_LAYERS = (
    "cover", "conductivity_w_m_k", "density_kg_m3", "specific_heat_j_kg_k", "thickness_m", "beneath", "water_share",
)  # fmt: skip
_COLUMNS = [
    {"name": "name", "label": "Material", "field": "name", "align": "left", "sortable": True},
    {"name": "band", "label": "Emissivity", "field": "band", "align": "right", "sortable": True},
    {"name": "share", "label": "Area", "field": "share", "align": "right", "sortable": True},
]
_ROW = """
<q-tr :props="props" tabindex="0" :data-name="props.row.name" :class="props.row.chosen ? 'chosen' : ''"
      :aria-selected="props.row.chosen ? 'true' : 'false'"
      @click="$parent.$emit('pick', props.row.name)" @keydown.enter="$parent.$emit('pick', props.row.name)">
  <q-td><div class="name"><span class="swatch" :class="props.row.colour ? '' : 'none'"
      :title="props.row.colour ? 'colour on the map of materials' : 'not in the scene'"
      :style="{background: props.row.colour}"></span>
    <span class="text" :title="props.row.tip">{{ props.row.name }}</span>
    <span v-if="props.row.edited" class="edited" title="edited, not saved">●</span></div></q-td>
  <q-td class="text-right">{{ props.row.band === null ? '–' : props.row.band.toFixed(3) }}</q-td>
  <q-td class="text-right">{{ props.row.share ? (100 * props.row.share).toFixed(1) + ' %' : '' }}</q-td>
</q-tr>
"""
# Standard deviations of the bell curve along which a point moves its surroundings [µm].
_WIDTHS = {0.0: "this point only", 0.15: "within 0.15 µm", 0.5: "within 0.5 µm", 1.5: "within 1.5 µm"}
_SPECTRUM_HELP = (
    "An ECOSTRESS or SLUM file, or columns of wavelength and emissivity or reflectance, as a spreadsheet copies them. "
    "Headings state the units, such as wavelength_um and emissivity; without headings, the values must allow one unit "
    "only. Columns wavelength_um, n and k make the material emit by angle."
)


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
            self._stack.choose(0)
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
            self._stack.choose(0)
            self._show()
            self._tab.stage.chosen()

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
        # As on the map of materials.
        colours = {each.name: self._session.renders.colours.of(each.name) for each in self._session.scene.materials}
        used = set(shares) | set(document.classes.values()) | {name for name, _ in document.objects.values()} | edited
        self._table.rows = [
            {
                "name": name, "band": band_mean(each, self._band_um), "share": shares.get(name, 0.0),
                "colour": colours.get(name, ""), "edited": name in edited,
                "chosen": name == self.name, "tip": ": ".join(filter(None, (name, each.title))),
            }
            for name, each in sorted(document.library.items(), key=lambda item: (-shares.get(item[0], 0.0), item[0]))
            if self._all.value or name in used
        ]  # fmt: skip

    def _named(self, title: str, proposal: str, change: Callable[[Document, str], Document], what: str) -> None:
        """Ask for a name, and change the document with it."""
        with ui.dialog() as dialog, ui.card():
            dialog.props(f'aria-label="{title}"').on("hide", dialog.delete)
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
        given.on("keydown.enter", done, js_handler=VERSION)
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
            names = ("Optical", "Thermal", "Cover", "Labels", "Files")
            optical, thermal, cover, labels, files = map(ui.tab, names)
        with ui.tab_panels(tabs, value=optical, animated=False).classes("grow"):
            with ui.tab_panel(optical):
                self._spectrum_part()
                with ui.element("div").classes("part"), ui.element("div").classes("fields"):
                    for key, label in _OPTICAL.items():
                        entry = self._entry(key, label)
                        if "[" not in label and key != "licence":
                            entry.classes("wide")
            with ui.tab_panel(thermal):
                self._stack = Stack(self._tab, lambda: self.name, self._fill)
                with ui.element("div").classes("part"):
                    self._thermal_note = ui.label("").classes("soft")
                    with ui.element("div").classes("thermal"):
                        for key, label in _THERMAL.items():
                            self._entry(key, label)
                            self._about[key] = ui.html("", sanitize=False).classes("about")
            with ui.tab_panel(cover):
                self._cover = Cover(self._tab)
            with ui.tab_panel(labels):
                self.training = Training(self._tab)
            with ui.tab_panel(files):
                Files(self._tab)

    def _entry(self, key: str, label: str) -> Entry:
        called = label.partition(" [")[0].lower()

        def owner() -> str:
            return self._stack.layer if key in PROPERTIES else self.name

        self._entries[key] = Entry(
            self._tab, key, f"field-{key}", lambda document, text: document.with_text(owner(), key, text),
            lambda text: f"{owner()}: {called} {text}", label=label,
        )  # fmt: skip
        return self._entries[key]

    def _spectrum_part(self) -> None:
        with ui.element("div").classes("part"):
            with ui.element("div").classes("titleline"):
                ui.html("<h2>Emissivity</h2>", sanitize=False)
                self._band = ui.label("").classes("soft").props('data-testid="band"')
                self._range = ui.toggle({False: "Thermal", True: "Solar"}, value=False, on_change=self._fill)
                self._range.props('dense no-caps data-testid="range"')
            self._chart = ui.echart({"series": []}).style("height:190px;width:100%").props('data-testid="spectrum"')
            self._chart.props('role="img" aria-label="Emissivity against wavelength, with the band of the camera"')
            self._angles = ui.echart({"series": []}).style("height:150px;width:100%")
            self._angles.props('role="img" aria-label="Band emissivity against the angle from the normal"')
            self._words = ui.label("").classes("soft").props('data-testid="spectrum-words"')
            with ui.element("div").classes("fields point") as self._point:
                self._at = ui.input("Wavelength [µm]").props('dense outlined data-testid="point-wavelength"')
                self._to = ui.input("Emissivity [1]").props('dense outlined data-testid="point-emissivity"')
                self._width = ui.select(_WIDTHS, value=0.5, label="Moves with it")
                self._width.props('dense outlined data-testid="width"')
                button = ui.button("Set the point").props('outline dense data-testid="point-set"')
                button.on("click", self._typed_point, js_handler=VERSION)
                for field in (self._at, self._to):
                    field.on("keydown.enter", self._typed_point, js_handler=VERSION)
            ui.button("Load or paste", on_click=self._load).props('outline dense data-testid="load"')

    def _typed_point(self, event: Any) -> None:
        """Move the spectrum to a point that is typed."""
        numbers = []
        for field in (self._at, self._to):
            try:
                numbers.append(decimal(str(field.value or "").strip()))
                field.error = None
            except ValueError:
                field.error = "write a number with a point as decimal mark"
        if len(numbers) == 2:
            self._to.error = self._moved(int(event.args), numbers[0], numbers[1], quiet=True) or None

    def _load(self) -> None:
        """Ask for a spectrum, to replace that of the material or to lay over it."""
        name = self.name
        given: dict[str, Any] = {"name": "pasted text", "data": b""}

        async def uploaded(event: Any) -> None:
            given["name"], given["data"] = event.file.name, await event.file.read()
            text.set_value("")
            look()

        def source() -> tuple[str, bytes]:
            pasted = str(text.value or "").encode()
            return ("pasted text", pasted) if pasted.strip() else (str(given["name"]), bytes(given["data"]))

        def read(document: Document) -> tuple[Material, str]:
            sample = str(column.value or "").strip() or None
            return spectrum.read_spectrum(*source(), document.material(name), sample)

        def look() -> None:
            """Say what was read, or why it cannot be."""
            found, sentence = "", ""
            if source()[1]:
                try:
                    found = read(self._session.document)[1]
                except ThermorenderError as error:
                    sentence = str(error)
            words.set_text(found and f"Read: {found}")
            fault.set_text(sentence)
            for button in (replace, lay):
                button.set_enabled(bool(found))

        def overlay() -> None:
            self._overlay = read(self._session.document)[0]
            dialog.close()
            self._fill()

        def use(event: Any) -> None:
            change = f"{name}: spectrum from {source()[0]}"
            refused = self._tab.edit(
                int(event.args), change, lambda document: document.with_material(read(document)[0]), True
            )
            fault.set_text(refused)
            if not refused:
                dialog.close()

        def too_large() -> None:
            fault.set_text(
                f"the file is larger than {spectrum.MOST_BYTES // 1_000_000} MB; give a table of one spectrum"
            )

        with ui.dialog() as dialog, ui.card().style("min-width:min(620px,90vw)"):
            dialog.props(f'aria-label="Spectrum for {name}"').on("hide", dialog.delete)
            ui.label(f"Spectrum for {name}").style("font-weight:600")
            ui.label(_SPECTRUM_HELP).classes("soft")
            # Its own controls have no names for screen readers.
            upload = ui.upload(auto_upload=True, max_file_size=spectrum.MOST_BYTES - 4096, max_files=1,
                               on_upload=uploaded, on_rejected=too_large).style("display:none")  # fmt: skip
            pick = f"() => ['reset', 'pickFiles'].forEach((does) => runMethod({upload.id}, does, []))"
            ui.button("Open a file").props('outline dense data-testid="open-file"').on("click", js_handler=pick)
            text = ui.textarea("Or paste columns", on_change=look).props('outlined debounce=200 data-testid="paste"')
            text.style("width:100%")
            column = ui.input("Sample of a table with several", on_change=look).props("dense outlined debounce=200")
            column.style("width:100%")
            words = ui.label("").props('role="status" data-testid="load-words"')
            fault = ui.label("").classes("say").props('role="alert" data-testid="load-fault"')
            with ui.row():
                replace = ui.button("Replace the spectrum").props('data-testid="replace"')
                replace.on("click", use, js_handler=VERSION)
                lay = ui.button("Lay over it", on_click=overlay).props('outline data-testid="lay-over"')
                ui.button("Cancel", on_click=dialog.close).props("flat")
        look()
        dialog.open()

    def _fill(self) -> None:
        material, saved = self._session.document.material(self.name), self._session.files.saved.library.get(self.name)
        self._title.set_text(self.name)
        self._subtitle.set_text(material.title)
        self._stack.fill(material.thermal)
        thermal, layer = self._stack.thermal, self._stack.layer
        for key, entry in self._entries.items():
            of_layer = key in PROPERTIES
            entry.fill(
                layer if of_layer else self.name, thermal_text(thermal, key) if of_layer else text_of(material, key)
            )
        self._fill_spectrum(material, None if saved is material else saved)
        self._thermal_note.set_text(
            f"{layer}: each value ± one standard deviation, and its source."
            if thermal
            else "No thermal table: a heat balance cannot use this material until all values are given."
        )
        for key, about in self._about.items():
            shown = self._stack.depth == 0 or key in _OF_LAYERS
            self._entries[key].set_visibility(shown)
            about.set_visibility(shown)
            spread = thermal.uncertainty.get(key) if thermal else None
            source = thermal.source.get(key, "") if thermal else ""
            flag = '<span class="flag">chosen, not measured</span> ' if source.startswith(CHOSEN) else ""
            source = source.removeprefix(CHOSEN).strip()
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
        sunlit = spectrum.reaches_sunlight(material)
        self._range.set_visibility(sunlit)
        solar = bool(sunlit and self._range.value)
        self._angles.set_visibility(directional)
        draw(self._chart, spectrum.options(material, saved, self._overlay, band, solar, self._tab.dark))
        if directional:
            draw(self._angles, spectrum.by_angle(material, band, BAND_K, self._tab.dark))
        self._point.set_visibility(material.directional == "lambertian" and not solar)
        spread, sunlight = spectrum.words(material)
        self._words.set_text(f"{spread[0].upper()}{spread[1:]}. {sunlight[0].upper()}{sunlight[1:]}.")
        ui.run_javascript(f"studio.spectrum({self._chart.id}, {spectrum.HANDLES})")

    def _dragged(self, event: Any) -> None:
        given = event.args
        if self._moved(int(given["version"]), float(given["wavelength"]), float(given["value"])):
            self._fill()

    def _moved(self, version: int, wavelength_um: float, emissivity: float, quiet: bool = False) -> str:
        """Move the spectrum to a point; return the sentence of a refusal, else ""."""
        name, width = self.name, float(self._width.value)

        def change(document: Document) -> Document:
            return document.with_material(spectrum.dragged(document.material(name), wavelength_um, emissivity, width))

        return self._tab.edit(version, f"{name}: emissivity at {wavelength_um:.4g} µm {emissivity:.3g}", change, quiet)
