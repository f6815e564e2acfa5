"""Materials of a scene and what they cover, as a value: each edit makes another one."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender import Material
from thermorender.apps.material_tables.edit import thermal_tables, with_text
from thermorender.errors import ThermorenderError, shortened
from thermorender.materials.library import NAME, find, load_library, read_library
from thermorender.materials.mixture import parts_of
from thermorender.scene.arguments import number_of
from thermorender.scene.surface import scene_kelvin

if TYPE_CHECKING:
    from thermorender import Scene

# Files are named after materials.
_LONGEST_NAME = 100


class Paint(NamedTuple):
    """Texels of the terrain with another material: a GeoJSON FeatureCollection, or their numbers as of
    `Scene.with_material_at`. Equal is only the same area."""

    area: Mapping[str, Any] | NDArray[np.int64]
    material: str

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Paint) and self.area is other.area and self.material == other.material

    def __ne__(self, other: object) -> bool:
        return not self == other


@dataclass(frozen=True, eq=False)
class Document:
    """Materials of a scene and what they cover.

    Attributes
    ----------
    library : dict of str to Material
        All materials, shipped and own, by name.
    own : frozenset of str
        Names that the shipped library does not have, or that the scene's own folder overrides.
    classes : dict of int to str
        Material of each class of the scene file.
    objects : dict of str to (str, float or None)
        Material and temperature of each object [K]; None for one that the heat balance solves.
    painted : tuple of Paint
        (area, name of its material), the latest last. An area is GeoJSON, as of `Scene.with_material_in`, or numbers of
        texels, as of `Scene.with_material_at`.
    time : datetime64 or None
        Instant of temperatures that follow the weather; None: the scene's own. It is not saved.
    origin : dict of str to Material
        All materials as the files describe them, which give a value's source where an edit brings it back.
    """

    library: Mapping[str, Material]
    own: frozenset[str]
    classes: Mapping[int, str]
    objects: Mapping[str, tuple[str, float | None]]
    painted: tuple[Paint, ...] = ()
    time: "np.datetime64 | None" = None
    origin: Mapping[str, Material] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: "Scene") -> "Document":
        """Return the Document of a scene as its files describe it."""
        folder = scene.spec.folder / "materials"
        own = frozenset(read_library(folder)) if (folder / "index.csv").is_file() else frozenset[str]()
        objects = {
            each.name: (each.material, each.kelvin if np.isfinite(each.kelvin) else None) for each in scene.spec.objects
        }
        library = load_library(folder if folder.is_dir() else None)
        return cls(library, own, dict(scene.spec.emissivity.classes), objects, origin=library)

    def material(self, name: str) -> Material:
        """Return a material; ThermorenderError where it was deleted or renamed."""
        if name not in self.library:
            raise ThermorenderError(
                f"material {name!r} is no longer there, since it was deleted or renamed; choose another one, or undo "
                "that edit"
            )
        return self.library[name]

    def with_material(self, material: Material) -> "Document":
        """Return this Document with a material in place of that of the same name, or in addition."""
        return replace(self, library={**self.library, material.name: material})

    def with_text(self, name: str, key: str, text: str) -> "Document":
        """Return this Document with another text of a material's property, as `material_tables.edit.with_text`.

        The same object is returned where nothing changes.
        """
        if name not in thermal_tables(self.library):
            self.material(name)
        return self.with_library(with_text(self.library, name, key, text, self.origin))

    def with_library(self, library: Mapping[str, Material]) -> "Document":
        """Return this Document with other materials; the same object where `library` is that of this one."""
        return self if library is self.library else replace(self, library=library)

    def duplicated(self, name: str, copy: str) -> "Document":
        """Return this Document with a copy of a material under another name."""
        self._refuse(copy)
        source = self.material(name)
        note = " ".join(filter(None, (f"Copy of {name}.", source.note)))
        made = self.with_material(replace(source, name=copy, title=f"{source.title} (copy)", note=note))
        return replace(made, own=self.own | {copy})

    def renamed(self, name: str, new: str) -> "Document":
        """Return this Document with another name of one of the scene's own materials, wherever it is used."""
        self.material(name)
        self._refuse(new)
        if name not in self.own:
            raise ThermorenderError(f"{name} is a shipped material and keeps its name; duplicate it under another name")
        library = {new if key == name else key: each for key, each in self.library.items()}
        library[new] = replace(library[new], name=new)
        return replace(
            self, library=library, own=(self.own - {name}) | {new},
            classes={key: new if each == name else each for key, each in self.classes.items()},
            objects={key: (new if each == name else each, k) for key, (each, k) in self.objects.items()},
            painted=tuple(Paint(area, new if each == name else each) for area, each in self.painted),
        )  # fmt: skip

    def without(self, name: str) -> "Document":
        """Return this Document without one of the scene's own materials that nothing uses."""
        self.material(name)
        if name not in self.own or name in load_library():
            raise ThermorenderError(
                f"{name} is a material of the shipped library, which stays; undo takes back its edits"
            )
        uses = [f"class {key}" for key, each in self.classes.items() if each == name]
        uses += [f"object {key!r}" for key, (each, _) in self.objects.items() if each == name]
        uses += ["a painted area" for _, each in self.painted if each == name]
        uses += [f"the ground beneath {key}" for key, each in self.library.items()
                 if each.thermal is not None and name in (layer.beneath for layer in each.thermal.layers)]  # fmt: skip
        if uses:
            raise ThermorenderError(f"{name} is the material of {uses[0]}; give that another one before you delete it")
        library = {key: each for key, each in self.library.items() if key != name}
        return replace(self, library=library, own=self.own - {name})

    def _refuse(self, name: str) -> None:
        if not NAME.fullmatch(name) or len(name) > _LONGEST_NAME:
            raise ThermorenderError(
                f"name={shortened(name)!r} is not a material name; use 1 … {_LONGEST_NAME} letters, digits, _ and -"
            )
        # Some systems do not tell files apart by case.
        if known := next((each for each in self.library if each.casefold() == name.casefold()), None):
            raise ThermorenderError(f"there is a material {known!r} already; choose another name")

    def of_class(self, number: int, material: str) -> "Document":
        """Return this Document with another material of a class of the scene."""
        if number not in self.classes:
            raise ThermorenderError(_unknown("class", number, self.classes))
        find(self.library, material, f"class {number}")
        return self if self.classes[number] == material else replace(self, classes={**self.classes, number: material})

    def of_object(self, name: str, material: str | None = None, kelvin: float | None = None) -> "Document":
        """Return this Document with another material or temperature of an object [K]."""
        if name not in self.objects:
            raise ThermorenderError(_unknown("object", name, self.objects))
        if kelvin is not None:
            what = f"object {name!r}: kelvin"
            kelvin = scene_kelvin(what, float(number_of(what, kelvin)))
        before = self.objects[name]
        material, kelvin = material or before[0], before[1] if kelvin is None else kelvin
        find(self.library, material, f"object {name!r}")
        now = material, kelvin
        return self if now == before else replace(self, objects={**self.objects, name: now})

    def with_area(self, area: Mapping[str, Any], material: str) -> "Document":
        """Return this Document with another material within an area, a GeoJSON FeatureCollection."""
        find(self.library, material, "the area")
        return replace(self, painted=(*self.painted, Paint(area, material)))

    def with_texels(self, texels: ArrayLike, material: str) -> "Document":
        """Return this Document with another material on texels of the terrain, by their numbers as `Renderer.texels`
        counts; `scene` refuses those that the terrain does not have."""
        find(self.library, material, "the texels")
        numbers = np.unique(np.asarray(texels))
        if not numbers.size or numbers.dtype.kind not in "iu":
            raise ThermorenderError(
                f"texels={shortened(repr(texels))} is not allowed; give one or more whole numbers, as Renderer.texels "
                "returns"
            )
        numbers = numbers.astype(np.int64)
        numbers.setflags(write=False)
        return replace(self, painted=(*self.painted, Paint(numbers, material)))

    def changed(self, saved: "Document") -> list[str]:
        """Return the names of the materials that differ from those of another Document, or are new."""
        return [name for name, each in self.library.items() if saved.library.get(name) is not each]

    def scene(self, base: "Scene", saved: "Document") -> "Scene":
        """Return the Scene of this Document; `base` is the scene as loaded, and `saved` its Document."""
        used = {part.name for each in base.materials for part, _ in parts_of(each)}
        replaced: dict[int | str, Material] = {
            name: self.library[name]
            for name in used & set(self.library)
            if self.library[name] is not saved.library.get(name)
        }
        for number, name in self.classes.items():
            if name != saved.classes.get(number):
                replaced[number] = self.library[name]
        objects = {key: each for key, each in self.objects.items() if each != saved.objects[key]}
        replaced |= {key: self.library[name] for key, (name, _) in objects.items()}
        scene = base if self.time is None else base.at(self.time)
        scene = scene.with_material(replaced) if replaced else scene
        kelvin = {key: k for key, (_, k) in objects.items() if k is not None and k != saved.objects[key][1]}
        scene = scene.with_objects(kelvin) if kelvin else scene
        for area, name in self.painted:
            material = self.library[name]
            if isinstance(area, Mapping):
                scene = scene.with_material_in(area, material)
            else:
                scene = scene.with_material_at(area, material)
        return scene


def _unknown(what: str, given: object, known: Mapping[Any, Any]) -> str:
    """The sentence on a class or an object that the scene does not have."""
    return f"the scene has no {what} {given!r}; it has {', '.join(map(repr, known)) or 'none'}"
