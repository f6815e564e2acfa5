"""The material of each texel and object: emissivity of the scene file, replacements by edits, and spectral bands."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity.mapping import COARSEST_RATIO, load_map
from thermorender.materials import library as material_tables
from thermorender.materials.material import Material, grey
from thermorender.materials.mixture import mix, parts_of
from thermorender.scene.drape import Drape
from thermorender.scene.folder import SceneFiles
from thermorender.scene.material_map import Context, Picture, context_of, learned_materials, model_of
from thermorender.scene.patch import Patch
from thermorender.scene.spec import EmissivitySpec, SurfaceSpec
from thermorender.scene.surface import (
    FILLED,
    MOST_MATERIALS,
    MOST_OPEN,
    SURFACE,
    UNKNOWN,
    Surface,
    fill,
    nearest_valid,
    open_share,
)
from thermorender.scene.terrain import texel_size_m
from thermorender.scene.textures import Texture, areas, named, separate, stating, used_texels

# New materials by what they replace: a class number, a material's name, or "object:" or "surface:" and a name.
Replaced = Mapping[int | str, Material]
OBJECT, SURFACE_OF_MESH = "object:", "surface:"
# The name of the grey material of an emissivity of source "constant".
CONSTANT = "constant"
# Stands in a report for the reason why no snow lies there: another weather changes the reason and not the materials.
WHY = "{why no snow lies there}"


@dataclass(frozen=True, eq=False)
class Painted:
    """Material number, colour and flags of the texels of one terrain surface, (h, w)."""

    material: NDArray[np.uint8]
    colour: NDArray[np.uint8]
    flags: NDArray[np.uint8]


class Covering(NamedTuple):
    """What a scene declares on its materials."""

    emissivity: EmissivitySpec
    objects: tuple[tuple[str, str], ...]  # (name, material) of each object
    surfaces: tuple[SurfaceSpec, ...]  # Parts of a mesh with their own material
    # Materials in place of others, as `Replaced` says; all are replaced at once, by the names the files give
    replaced: Replaced
    painted: tuple[Patch, ...]  # Texels of the terrain with another material, the latest last
    band_um: tuple[float, float] | None  # The camera's band [µm], which a learned map mixes materials for, else None


@dataclass(frozen=True, eq=False)
class Cover:
    """Which material covers what."""

    tables: tuple[Material, ...]  # In the order of their first use; what material numbers index
    ground: tuple[Painted, ...]  # One per terrain surface
    objects: tuple[int, ...]  # The material number of each object
    report: Mapping[str, Any]  # Report of the learned emissivity map; empty without one


class MaterialList:
    """Materials a scene uses, in the order of their first use."""

    def __init__(
        self, library: Mapping[str, Material], replaced: Replaced, band_um: tuple[float, float] | None, where: str
    ) -> None:
        self.library, self.replaced, self.band_um, self.where = library, replaced, band_um, where
        self.used: list[Material] = []
        self.numbers: dict[int, int] = {}
        self.mixtures: dict[tuple[tuple[int, float], ...], Material] = {}
        self.unused = set(replaced)

    def index(self, name: str, key: str, *by: int | str) -> int:
        """Return the number of a material, which is added where it is new; arguments as of `found`."""
        return self.add(self.found(name, key, *by))

    def found(self, name: str, key: str, *by: int | str) -> Material:
        """Return a material by its name; `by` are other keys to replace it by, in order of priority."""
        own = [one for one in (*by, name) if one in self.replaced]
        self.unused -= set(own)
        if own:
            return self.replaced[own[0]]
        return material_tables.find(self.library, name, f"{self.where}: {key}")

    def add(self, material: Material) -> int:
        """Return the number of a material, which is added where it is new."""
        if id(material) not in self.numbers:
            if len(self.used) == MOST_MATERIALS:
                raise ThermorenderError(
                    f"{self.where}: {material.name!r} would be the scene's material number {len(self.used) + 1}; a "
                    f"scene may use up to {MOST_MATERIALS}, mixes of a learned emissivity map included, so give fewer"
                )
            self.numbers[id(material)] = len(self.used)
            self.used.append(material)
        return self.numbers[id(material)]

    def mixed(self, parts: Sequence[tuple[Material, float]]) -> int:
        """Return the number of the mixture of materials, the same for the same (Material, share) pairs."""
        key = tuple((id(material), share) for material, share in parts)
        if key not in self.mixtures:
            self.mixtures[key] = mix(parts)
        return self.add(self.mixtures[key])


def cover_of(files: SceneFiles, covering: Covering, snow: bool, where: str) -> Cover:
    """Return the Cover of a scene.

    Without `snow` a learned map may not find snow; the report then gives `WHY` as the reason.
    """
    emissivity, objects, surfaces, replaced, painted, _ = covering
    no_snow = "" if snow else WHY
    materials = MaterialList(files.library, replaced, covering.band_um, where)
    report: dict[str, Any] = {}
    ground = _mesh_cover(files, emissivity, surfaces, materials, report, no_snow) if files.textures else []
    for surface, drape in zip(files.ground[len(files.textures) :], files.drapes, strict=True):
        # The report is on the scene itself.
        ground.append(_raster_cover(surface, drape, emissivity, materials, {} if surface.far else report, no_snow))
    if painted:
        # A mesh has its own colours.
        coloured = [*(False for _ in files.textures), *(drape.colour is None for drape in files.drapes)]
        start = np.cumsum([0, *(own.flags.size for own in ground)])
        ground = [_painted(*each, painted, materials) for each in zip(ground, start[:-1], coloured, strict=True)]
    numbers = tuple(materials.index(material, f"object {name!r}", OBJECT + name) for name, material in objects)
    for key in materials.unused:
        known = dict.fromkeys(part.name for each in materials.used for part, _ in parts_of(each))
        raise ThermorenderError(
            f"{where}: with_material was given {_key_words(key)}, which this scene does not have; give one of its "
            f"materials {', '.join(known)}, a class number or the name of an object or of a mesh's surface "
            "(an object or group of an OBJ once a [[surface]] of scene.toml names it)"
        )
    return Cover(tuple(materials.used), tuple(ground), numbers, report)


def _key_words(key: int | str) -> str:
    return f"class {key}" if isinstance(key, int) else repr(str(key).removeprefix(OBJECT).removeprefix(SURFACE_OF_MESH))


def _raster_cover(
    surface: Surface,
    drape: Drape,
    emissivity: EmissivitySpec,
    materials: MaterialList,
    report: dict[str, Any],
    no_snow: str,
) -> Painted:
    """The Painted of a raster ground: by its classes, else by [emissivity]."""
    shape, colour = surface.flags.shape, drape.colour
    unknown = np.zeros(shape, dtype=bool)
    # Where the colour is known, and where the material is.
    valid = known = np.ones(shape, dtype=bool) if drape.valid is None else drape.valid
    if drape.classes is not None and emissivity.source in (("classes", "learned") if surface.far else ("classes",)):
        name = f"{drape.classes_file}"
        material, known, unknown, share = _of_classes(
            drape.classes, valid, drape.on_ground, name, emissivity, materials, drape.mixed, drape.most_open
        )
        if share > 0.0:
            rest = emissivity.fallback or "the class beside them"
            report.update(model=name, fallback=rest, share_unknown=share)
    elif emissivity.source == "learned" and drape.colour is not None and _readable(surface, emissivity):
        filled = drape.colour if valid.all() else fill(drape.colour, nearest_valid(valid))
        assert drape.height is not None
        picture = Picture(filled, valid, surface.texel_m,
                          context_of(emissivity, *drape.height, drape.grid, surface.texel_m))  # fmt: skip
        (material,), (unknown,) = _learned([picture], emissivity, materials, report, no_snow)
    else:
        number = _of_emissivity(surface, emissivity, materials)
        if number is None:
            assert emissivity.fallback is not None
            number = materials.index(emissivity.fallback, "emissivity.fallback")
        material = np.full(shape, number, np.uint8)
        unknown |= emissivity.source in ("classes", "learned")
    if not known.all():
        material = fill(material, nearest_valid(known))
    if colour is None:
        colour = np.array([m.colour for m in materials.used], dtype=np.uint8)[material]
    elif not valid.all():
        colour = fill(colour, nearest_valid(valid))
    flags = np.full(shape, SURFACE, np.uint8)
    flags[~(valid & known)] |= FILLED
    if drape.filled is not None:
        flags[drape.filled] |= FILLED
    flags[unknown] |= UNKNOWN
    return Painted(material, colour, flags)


def _of_classes(
    classes: NDArray[np.uint8], valid: NDArray[np.bool_], on_ground: NDArray[np.bool_] | None, name: str,
    emissivity: EmissivitySpec, materials: MaterialList, mixed: Sequence[Mapping[int, float]] = (),
    most_open: float = MOST_OPEN,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_], float]:  # fmt: skip
    """(material numbers, where they are known, where they are the fallback, share without a class) of class numbers,
    or of numbers of the `mixed` shares of classes."""
    lookup = np.full(256, 255, dtype=np.uint8)
    lookup[0] = 0
    for number, parts in enumerate(mixed, 1):
        pure = [(materials.found(emissivity.classes[value], f"emissivity.classes.{value}", value), share)
                for value, share in parts.items()]  # fmt: skip
        lookup[number] = materials.mixed(_joined(pure))
    for value, material in emissivity.classes.items() if not mixed else ():
        lookup[value] = materials.index(material, f"emissivity.classes.{value}", value)
    known, unknown = classes != 0, np.zeros(classes.shape, bool)
    share = open_share(~known & valid, on_ground)
    if emissivity.fallback and share > 0.0:
        lookup[0], unknown = materials.index(emissivity.fallback, "emissivity.fallback"), ~known & valid
        known = known | unknown
    elif share > most_open or not known.any():
        part = f"{share:.1%}" if most_open < 1.0 else "a part"
        raise ThermorenderError(
            f"{name} leaves {part} of the terrain of {materials.where} without a class; give one "
            "that covers it, or name the material of the rest as emissivity.fallback"
        )
    return lookup[classes], known, unknown, share


def _joined(parts: Sequence[tuple[Material, float]]) -> list[tuple[Material, float]]:
    """(Material, share) pairs in which each material occurs once: several classes may have the same."""
    share = dict[int, float]()
    for material, part in parts:
        share[id(material)] = share.get(id(material), 0.0) + part
    return [(material, share[id(material)]) for material in {id(one): one for one, _ in parts}.values()]


def _readable(surface: Surface, emissivity: EmissivitySpec) -> bool:
    """Whether a learned map reads the texels of a ground; those of far ground may be too coarse for it."""
    assert emissivity.model is not None
    return not surface.far or surface.texel_m <= COARSEST_RATIO * load_map(emissivity.model).texel_m


def _mesh_cover(
    files: SceneFiles, emissivity: EmissivitySpec, surfaces: Sequence[SurfaceSpec], materials: MaterialList,
    report: dict[str, Any], no_snow: str,
) -> list[Painted]:  # fmt: skip
    """The Painted of each surface of a mesh: by an edit, its [[surface]], its class raster or [emissivity]."""
    textures, where = files.textures, materials.where
    edits = [str(key).removeprefix(SURFACE_OF_MESH) for key in materials.replaced
             if str(key).startswith(SURFACE_OF_MESH)]  # fmt: skip
    edited = named(textures, edits, where, "with_material: surface")
    stated = stating(textures, surfaces, ("material", "classes"), where)
    found: list[Painted | None] = []
    missing: list[tuple[float, float]] = []
    for surface, texture, edit, own in zip(files.near, textures, edited, stated, strict=True):
        number: int | None
        if edit is not None:
            key = SURFACE_OF_MESH + edits[edit]
            materials.unused.discard(key)
            number = materials.add(materials.replaced[key])
        elif own is not None and own.material is not None:
            number = materials.index(own.material, f"surface {own.name!r}")
        elif texture.classes is not None:
            painted, share = _of_class_raster(surface, texture, emissivity, materials)
            missing.append((share, float(areas(surface).sum())))
            found.append(painted)
            continue
        else:
            number = _of_emissivity(surface, emissivity, materials)
        if number is not None:
            material = np.full(surface.flags.shape, number, np.uint8)
            found.append(Painted(material, surface.colour, surface.flags))
        else:
            found.append(None)
    if any(share for share, _ in missing):
        share = float(np.average([share for share, _ in missing], weights=[area for _, area in missing]))
        rest = emissivity.fallback or "the class beside them"
        report.update(model="the class rasters", fallback=rest, share_unknown=share)
    waiting = [k for k, painted in enumerate(found) if painted is None]
    if waiting:
        made = _learned_mesh(files, waiting, emissivity, materials, report, no_snow)
        for k, painted in zip(waiting, made, strict=True):
            found[k] = painted
    return [painted for painted in found if painted is not None]


def _of_class_raster(
    surface: Surface, texture: Texture, emissivity: EmissivitySpec, materials: MaterialList
) -> tuple[Painted, float]:
    """(Painted, share without a class) of a mesh's surface by the class numbers (h, w) of its texels.

    What a map does not show, such as the ground below a roof, has the nearest class.
    """
    assert texture.classes is not None
    everywhere = np.ones(surface.flags.shape, bool)
    # Which texels are used matters only where some have no class.
    used = everywhere.copy() if texture.classes.all() else used_texels(surface)
    if texture.shown is not None:
        used &= texture.shown
    name = f"the class raster of surface {surface.name!r}"
    material, known, unknown, share = _of_classes(texture.classes, everywhere, used, name, emissivity, materials)
    if texture.shown is not None:
        known &= texture.shown
    if not known.all():
        material = fill(material, nearest_valid(known))
    flags = surface.flags | np.where(known | ~used, 0, FILLED) | np.where(unknown & used, UNKNOWN, 0)
    return Painted(material, surface.colour, flags.astype(np.uint8)), share


def _of_emissivity(surface: Surface, emissivity: EmissivitySpec, materials: MaterialList) -> int | None:
    """The number of the one material that [emissivity] gives a surface; None where a learned map finds them."""
    if emissivity.source == "learned":
        return None
    if emissivity.source != "classes":
        return _single(emissivity, materials)
    if not emissivity.fallback:
        how = "terrain.far.classes" if surface.far else "it classes or a material in a [[surface]]"
        raise ThermorenderError(
            f"{materials.where}: surface {surface.name!r} has no class raster; give {how}, or name the material of the "
            "rest as emissivity.fallback"
        )
    return materials.index(emissivity.fallback, "emissivity.fallback")


def _learned_mesh(
    files: SceneFiles,
    numbers: Sequence[int],
    emissivity: EmissivitySpec,
    materials: MaterialList,
    report: dict[str, Any],
    no_snow: str,
) -> list[Painted]:
    """The Painted of some surfaces by a learned map; those without a texture have the fallback."""
    pictured = [k for k in numbers if files.textures[k].size and not separate(files.ground[k])]
    if not pictured:
        raise ThermorenderError(
            f"{materials.where}: emissivity.source='learned' reads materials from textures, and this mesh has none; "
            "bake its colours into a texture, or give materials in [[surface]] tables"
        )
    pictures: list[Picture] = []
    context = _mesh_context(files, emissivity, materials.where)
    for k in pictured:
        surface = files.ground[k]
        used = used_texels(surface)
        colour = surface.colour if used.all() else fill(surface.colour, nearest_valid(used))
        own = None if files.map_view is None else context.onto(files.map_view, k)
        name = f"{materials.where}: the texture of surface {surface.name!r}"
        pictures.append(Picture(colour, used, surface.texel_m, own, name))
    number, unknown = _learned(pictures, emissivity, materials, report, no_snow)
    report["context"] = (*report["context"], *context.notes)
    assert emissivity.fallback is not None
    rest = materials.index(emissivity.fallback, "emissivity.fallback")
    of = dict(zip(pictured, zip(number, unknown, strict=True), strict=True))
    found = []
    for k in numbers:
        surface = files.ground[k]
        shape = surface.flags.shape
        material, flagged = of.get(k, (np.full(shape, rest, np.uint8), np.ones(shape, bool)))
        flags = surface.flags | np.where(flagged, UNKNOWN, 0).astype(np.uint8)
        found.append(Painted(material, surface.colour, flags))
    return found


def _mesh_context(files: SceneFiles, emissivity: EmissivitySpec, where: str) -> Context:
    """The Context of the cells of a mesh's map, with the mesh as its surface model; a mesh on no map has none."""
    view = files.map_view
    if view is None or files.frame is None:
        if emissivity.known:
            raise ThermorenderError(
                f"{where}: emissivity.known restricts what is seen from above, and this mesh has walls or leaves only; "
                "leave it out"
            )
        return Context(None, None, ("heights are not used: the mesh is on no map",))
    cell_m = texel_size_m(view.grid, files.frame)
    return context_of(emissivity, *view.heights(cell_m), view.grid, cell_m, walls=True)


def _painted(own: Painted, first: int, coloured: bool, painted: Sequence[Patch], materials: MaterialList) -> Painted:
    """The cover of a surface, whose texels have the numbers from `first` on, with the materials of patches, and with
    their colours where materials give these."""
    material, colour, flags = own.material.copy(), own.colour, own.flags.copy()
    colour = colour.copy() if coloured else colour
    for patch in painted:
        texels = patch.texels[slice(*np.searchsorted(patch.texels, [first, first + flags.size]))] - first
        if texels.size:
            material.flat[texels] = materials.add(patch.material)
            flags.flat[texels] &= ~np.uint8(UNKNOWN)
        if coloured:
            colour.reshape(-1, 3)[texels] = patch.material.colour
    return Painted(material, colour, flags)


def _learned(
    pictures: Sequence[Picture],
    emissivity: EmissivitySpec,
    materials: MaterialList,
    report: dict[str, Any],
    no_snow: str,
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.bool_]]]:
    """(material numbers, whether they are unknown) of the texels of pictures by their colour, (h, w) each."""
    assert materials.band_um is not None
    model, _ = model_of(emissivity, materials.library, materials.where, no_snow)
    names = {*model.materials, emissivity.fallback}
    for each in pictures:
        if each.context and each.context.known:
            names |= {*each.context.known.beyond(model.materials)}
    own = {str(name): material for name, material in materials.replaced.items() if name in names}
    materials.unused -= set(own)
    numbers, used, unknown, found = learned_materials(
        emissivity, {**materials.library, **own}, pictures, materials.band_um, materials.where, no_snow
    )
    report.update(found)
    lookup = np.array([materials.add(material) for material in used], dtype=np.uint8)
    return [lookup[number] for number in numbers], unknown


def _single(source: EmissivitySpec, materials: MaterialList) -> int:
    if source.source == "material" and source.material:
        return materials.index(source.material, "emissivity.material")
    if CONSTANT in materials.replaced:
        return materials.index(CONSTANT, "emissivity.value")
    assert source.value is not None
    return materials.add(grey(CONSTANT, source.value))
