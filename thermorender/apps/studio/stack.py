"""The layers of the chosen material: their section, and tools that insert, replace and remove them."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from nicegui import ui

from thermorender.apps.material_tables import layers
from thermorender.apps.material_tables.edit import thermal_tables
from thermorender.apps.studio import section
from thermorender.apps.studio.document import Document
from thermorender.apps.studio.panels import VERSION
from thermorender.materials.thermal import Thermal

if TYPE_CHECKING:
    from thermorender.apps.studio.page import Tab

# What may be beneath a layer besides a material.
_ENDS = {
    "": "Nothing: the layer is unlimited", "inside": "Room air", "outside": "Outdoor air",
    "ventilated": "Outdoor air in a cavity or loft",
}  # fmt: skip
_TOOLS = {
    "Insert below": "A layer, or what is behind, directly beneath the chosen layer",
    "Replace": "Another material of the chosen layer, of the same thickness",
    "Remove": "Without the chosen layer; what is beneath it moves up",
    "Own copy": "A table of the chosen layer for this material only",
}
# Sends the layer that is clicked in the section.
_DEPTH = "(e) => { const at = e.target.closest('[data-depth]'); if (at) emit(Number(at.dataset.depth)); }"
_MOST_NAMED = 3


class Stack:
    """The layers of the material that `name` gives; `changed` is called where another one is chosen.

    Attributes
    ----------
    depth : int
        Of the chosen layer, 0 at the surface.
    layer : str
        Its name.
    thermal : Thermal or None
        Its table.
    """

    def __init__(self, tab: "Tab", name: Callable[[], str], changed: Callable[[], object]) -> None:
        self._tab, self._session, self._name, self._changed = tab, tab.session, name, changed
        self.depth, self.layer = 0, name()
        self.thermal: Thermal | None = None
        self._rows: list[tuple[ui.element, list[ui.label]]] = []
        with ui.element("div").classes("part") as self._box:
            ui.html("<h2>Layers</h2>", sanitize=False)
            with ui.element("div").classes("stack"):
                self._drawing = ui.html("", sanitize=False).props('data-testid="section"')
                self._drawing.on("click", lambda e: self._pick(int(e.args)), js_handler=_DEPTH)
                self._list = ui.element("div").classes("rows")
                self._list.props('role="group" aria-label="Layers from the surface down"')
            self._totals = ui.element("div").classes("figures totals").props('data-testid="totals"')
            self._use = ui.label("").classes("soft").props('data-testid="use-of-layer"')
            with ui.element("div").classes("row layertools"):
                self._tools = {
                    label: ui.button(label)
                    .props(f'outline dense data-testid="layer-{label.split()[0].lower()}"')
                    .tooltip(tip)
                    for label, tip in _TOOLS.items()
                }
        self._tools["Insert below"].on_click(self._ask_beneath)
        self._tools["Replace"].on_click(self._ask_other)
        for label, change in (("Remove", layers.without), ("Own copy", layers.with_own)):
            self._tools[label].on("click", partial(self._change, label, change), js_handler=VERSION)

    def choose(self, depth: int) -> None:
        """Let the next fill show another layer."""
        self.depth = depth

    def _pick(self, depth: int) -> None:
        self.choose(depth)
        self._changed()

    def fill(self, surface: Thermal | None) -> None:
        """Show the layers of the material, whose own table is `surface`."""
        self._box.set_visibility(surface is not None)
        if surface is None:
            self.depth, self.layer, self.thermal = 0, self._name(), None
            return
        library, stack = self._session.document.library, surface.layers
        names = layers.names(library, self._name())
        self.depth = min(self.depth, len(stack) - 1)
        self.layer, self.thermal = names[self.depth], stack[self.depth]
        self._drawing.set_content(section.drawing(stack, self.depth))
        if len(self._rows) != len(stack):
            self._make_rows(len(stack))
        for k, ((button, labels), layer) in enumerate(zip(self._rows, stack, strict=True)):
            button.props(f'aria-pressed="{"true" if k == self.depth else "false"}" title="{names[k]}"')
            for label, text in zip(labels, (names[k], *section.words(layer)), strict=True):
                label.set_text(text)
        weather = self._session.base.spec.weather
        behind = section.behind(stack[-1].beneath, weather.inside_c if weather else None)
        self._end.set_text(behind)
        self._end.set_visibility(bool(behind))
        self._totals.clear()
        with self._totals:
            for what, value in section.totals(surface):
                ui.label(what).classes("k")
                ui.label(value)
        others = [each for each in layers.users(library, self.layer) if each not in (self._name(), self.layer)]
        own = self.layer not in library and not others
        self._use.set_visibility(self.depth > 0)
        also = ", ".join(others) if len(others) <= _MOST_NAMED else f"{len(others)} materials"
        where = f"beneath {also} too" if others else "also the material of that name"
        self._use.set_text(f"{self.layer} lies " + ("beneath this material only" if own else where))
        for tool in ("Replace", "Remove", "Own copy"):
            self._tools[tool].set_enabled(self.depth > 0 and not (tool == "Own copy" and own))

    def _make_rows(self, count: int) -> None:
        self._list.clear()
        self._rows = []
        with self._list:
            for k in range(count):
                with ui.element("button").props(f'type="button" data-testid="layer-{k}"') as button:
                    button.on("click", partial(self._pick, k))
                    labels = [ui.label("").classes(each) for each in ("layername", "thick", "soft")]
                    self._rows.append((button, labels))
            self._end = ui.label("").classes("soft end").props('data-testid="behind"')

    def _change(self, label: str, change: Callable[..., Any], event: Any) -> None:
        name, depth = self._name(), self.depth
        self._tab.edit(
            int(event.args), f"{name}: {label.lower()} {self.layer}",
            lambda document: document.with_library(change(document.library, name, depth, document.origin)),
        )  # fmt: skip

    def _ask_beneath(self) -> None:
        """Ask for what is directly beneath the chosen layer."""
        name, depth, layer = self._name(), self.depth, self.layer
        unlimited = self.thermal is None or self.thermal.thickness_m is None
        asked = ["Thickness of that layer [m], empty: unlimited", *([f"Thickness of {layer} [m]"] if unlimited else [])]

        def change(document: Document, of: str, thickness: str, own: str = "") -> Document:
            return document.with_library(
                layers.with_beneath(document.library, name, depth, of, thickness, own, document.origin)
            )

        self._ask(f"Directly beneath {layer}", _ENDS, asked, change)

    def _ask_other(self) -> None:
        """Ask for another material of the chosen layer."""
        name, depth = self._name(), self.depth

        def change(document: Document, of: str) -> Document:
            return document.with_library(layers.with_other(document.library, name, depth, of, document.origin))

        self._ask(f"In place of {self.layer}", {}, [], change)

    def _ask(self, title: str, ends: dict[str, str], asked: list[str], change: Callable[..., Document]) -> None:
        """Ask for a table or one of `ends` and for thicknesses, and change the Document with them."""
        name = self._name()
        with ui.dialog() as dialog, ui.card().style("min-width:min(420px,90vw)"):
            dialog.props(f'aria-label="{title}"').on("hide", dialog.delete)
            ui.label(title).style("font-weight:600")
            tables = {each: each for each in sorted(thermal_tables(self._session.document.library))}
            choice: ui.select = ui.select(ends | tables, label="Material", with_input=True)
            choice.props('dense outlined options-dense data-testid="layer-material"').style("width:100%")
            given = [
                ui.input(label).props(f'dense outlined data-testid="layer-thickness-{k}"').style("width:100%")
                for k, label in enumerate(asked)
            ]
            fault = ui.label("").classes("say").props('role="alert" data-testid="layer-fault"')
            with ui.row():
                accept = ui.button("OK").props('data-testid="layer-accept"')
                ui.button("Cancel", on_click=dialog.close).props("flat")

        def done(event: Any) -> None:
            of, texts = choice.value, [str(each.value or "") for each in given]
            refused = "no material is chosen; choose one in the list"
            if of is not None:
                what = f"{name}: {title.lower()} {of or 'nothing'}"
                refused = self._tab.edit(int(event.args), what, lambda document: change(document, of, *texts), True)
            fault.set_text(refused)
            if not refused:
                dialog.close()

        accept.on("click", done, js_handler=VERSION)
        dialog.open()
