"""Edits of the layers beneath a material: inserted, replaced, removed, or given tables of their own.

Layers are chained by the names of their tables, so a table may lie beneath several materials. These edits change one
material: tables that others use too are copied first, under names such as `insulation_deck_of_roof_flat_gravel`.
Depth 0 is the material itself, at the surface.
"""

from collections.abc import Mapping

from thermorender.apps.material_tables.edit import thermal_tables, thermal_text, with_thermal
from thermorender.errors import ThermorenderError
from thermorender.materials.library import find
from thermorender.materials.material import Material
from thermorender.materials.thermal import ENDS, Thermal

Library = Mapping[str, Material]

_OF = "_of_"


def names(library: Library, name: str) -> list[str]:
    """Return the names of a material's layers from the surface down, the first of which is its own."""
    layers = find(library, name, "layers").known_thermal().layers
    return [name, *(each.beneath for each in layers[:-1])]


def users(library: Library, layer: str) -> list[str]:
    """Return the materials whose layers include a table, in the order of the library; the material of that name too."""
    return [name for name, each in library.items() if each.thermal and layer in names(library, name)]


def with_own(library: Library, name: str, depth: int, original: Library) -> Library:
    """Return a library in which the layers of a material down to a depth are beneath no other one.

    `original` gives sources, as in `edit.with_text`; so it does below.
    """
    chain, tables = names(library, name), thermal_tables(library)
    shared = [k for k in range(1, depth + 1) if chain[k] in library or users(library, chain[k]) != [name]]
    copies: dict[str, Thermal] = {}
    settings: dict[str, dict[str, str]] = {}
    above = chain[shared[0] - 1] if shared else ""
    for k in shared:
        copy = _free(chain[k], name, {*tables, *copies, *library})
        copies[copy] = tables[chain[k]]
        settings[above] = {"beneath": copy}
        above = copy
    return with_thermal(library, settings, original, copies) if shared else library


def with_beneath(
    library: Library, name: str, depth: int, of: str, thickness_m: str, own_m: str, original: Library
) -> Library:
    """Return a library with something else directly beneath a layer of a material.

    Parameters
    ----------
    depth : int
        Of the layer above.
    of : str
        A table, inserted as a layer; one of `materials.thermal.ENDS`, where the layers end; or "": the layer above is
        unlimited.
    thickness_m : str
        Of the layer that is inserted [m]; "": it is unlimited.
    own_m : str
        Of the layer above [m], which needs one where something is beneath it; "": as it is.

    Raises
    ------
    ThermorenderError
        There is no such table, or the tables would refuse a thickness.
    """
    library = with_own(library, name, depth, original)
    layer = names(library, name)[depth]
    now = thermal_tables(library)[layer]
    own_m = own_m.strip() or thermal_text(now, "thickness_m")
    if of in ("", *ENDS):
        return with_thermal(library, {layer: {"thickness_m": own_m if of else "", "beneath": of}}, original)
    below = now.beneath if thickness_m.strip() else ""
    return _linked(library, name, layer, of, {"thickness_m": thickness_m.strip(), "beneath": below}, own_m, original)


def with_other(library: Library, name: str, depth: int, of: str, original: Library) -> Library:
    """Return a library in which a layer below the surface is of another table, with its thickness and what is beneath
    it.
    """
    library = with_own(library, name, depth - 1, original)
    chain = names(library, name)
    now = thermal_tables(library)[chain[depth]]
    kept = {key: thermal_text(now, key) for key in ("thickness_m", "beneath")}
    return _linked(library, name, chain[depth - 1], of, kept, "", original)


def without(library: Library, name: str, depth: int, original: Library) -> Library:
    """Return a library without a layer below the surface; what was beneath it lies beneath the one above."""
    library = with_own(library, name, depth - 1, original)
    chain = names(library, name)
    below = thermal_tables(library)[chain[depth]].beneath
    settings = {"beneath": below} | ({} if below else {"thickness_m": ""})
    return with_thermal(library, {chain[depth - 1]: settings}, original)


def _linked(
    library: Library, name: str, above: str, of: str, texts: Mapping[str, str], own_m: str, original: Library
) -> Library:
    """A library in which the table `of` with these thickness and beneath is beneath the layer `above` of a material;
    the table itself where it has them, else a copy.
    """
    tables = thermal_tables(library)
    if of not in tables:
        raise ThermorenderError(f"{of!r} has no thermal table to be a layer; choose one of {', '.join(sorted(tables))}")
    alike = all(thermal_text(tables[of], key) == text for key, text in texts.items())
    copy = of if alike else _free(of, name, {*tables, *library})
    settings: dict[str, Mapping[str, str]] = {} if alike else {copy: texts}
    settings[above] = {"beneath": copy} | ({"thickness_m": own_m} if own_m else {})
    return with_thermal(library, settings, original, {} if alike else {copy: tables[of]})


def _free(layer: str, name: str, taken: set[str]) -> str:
    """A free name for a material's own copy of a layer."""
    first = f"{layer.partition(_OF)[0]}{_OF}{name}"
    return next(each for each in (first, *(f"{first}_{k}" for k in range(2, 1000))) if each not in taken)
