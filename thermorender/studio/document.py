"""What a user edits: the materials, what they cover, and the history of both.

A Document is a value. Each edit makes another one, so undo and redo only move along a list.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from thermorender.errors import ThermorenderError, shortened
from thermorender.materials.library import NAME, find, load_library
from thermorender.materials.material import Material
from thermorender.materials.mixture import parts_of

if TYPE_CHECKING:
    from pathlib import Path

    from thermorender.scene.scene import Scene

# Edits that undo can take back.
MOST_EDITS = 300
# Files are named after materials.
_LONGEST_NAME = 100


@dataclass(frozen=True, eq=False)
class Painted:
    """An area of the terrain with another material: a file of polygons, as `Scene.with_material_in` reads it."""

    area: "Path"
    material: str


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
    painted : tuple of Painted
        The latest last.
    time : datetime64 or None
        Instant of temperatures that follow the weather; None: the scene's own. It is not saved.
    tables : dict of str to str
        Text of the spectral table of each material that emits by angle.
    """

    library: Mapping[str, Material]
    own: frozenset[str]
    classes: Mapping[int, str]
    objects: Mapping[str, tuple[str, float | None]]
    painted: tuple[Painted, ...] = ()
    time: "np.datetime64 | None" = None
    tables: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, scene: "Scene", library: Mapping[str, Material], own: frozenset[str], tables: dict[str, str]
    ) -> "Document":
        """Return the Document of a scene as its files describe it."""
        objects = {each.name: (each.material, each.temperature) for each in scene.spec.objects}
        return cls(library, own, dict(scene.spec.emissivity.classes), objects, tables=tables)

    def material(self, name: str) -> Material:
        """Return a material; ThermorenderError where another tab has deleted or renamed it."""
        if name not in self.library:
            raise ThermorenderError(
                f"material {name!r} is no longer there, since another tab deleted or renamed it; choose another one, "
                "or undo that edit"
            )
        return self.library[name]

    def with_material(self, material: Material, table: str | None = None) -> "Document":
        """Return this Document with a material in place of that of the same name, or in addition; see `tables`."""
        tables = self.tables if table is None else self.tables | {material.name: table}
        return replace(self, library={**self.library, material.name: material}, tables=tables)

    def duplicated(self, name: str, copy: str) -> "Document":
        """Return this Document with a copy of a material under another name."""
        self._refuse(copy)
        source = self.material(name)
        note = " ".join(filter(None, (f"Copy of {name}.", source.note)))
        made = self.with_material(replace(source, name=copy, title=f"{source.title} (copy)", note=note))
        return replace(made, own=self.own | {copy}, tables=self._with_table(name, copy))

    def _with_table(self, name: str, copy: str) -> dict[str, str]:
        return self.tables | {copy: self.tables[name]} if name in self.tables else self.tables

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
            painted=tuple(replace(each, material=new) if each.material == name else each for each in self.painted),
            tables=self._with_table(name, new),
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
        uses += ["a painted area" for each in self.painted if each.material == name]
        uses += [f"the ground beneath {key}" for key, each in self.library.items()
                 if each.thermal is not None and each.thermal.beneath == name]  # fmt: skip
        if uses:
            raise ThermorenderError(f"{name} is the material of {uses[0]}; give that another one before you delete it")
        library = {key: each for key, each in self.library.items() if key != name}
        return replace(self, library=library, own=self.own - {name})

    def _refuse(self, name: str) -> None:
        if not NAME.fullmatch(name) or len(name) > _LONGEST_NAME:
            raise ThermorenderError(
                f"name={shortened(name)!r} is not a material name; use 1 … {_LONGEST_NAME} letters, digits, _ and -"
            )
        if name in self.library:
            raise ThermorenderError(f"there is a material {name!r} already; choose another name")

    def of_class(self, number: int, material: str) -> "Document":
        """Return this Document with another material of a class."""
        find(self.library, material, f"class {number}")
        return self if self.classes[number] == material else replace(self, classes={**self.classes, number: material})

    def of_object(self, name: str, material: str | None = None, kelvin: float | None = None) -> "Document":
        """Return this Document with another material or temperature of an object [K]."""
        before = self.objects[name]
        material, kelvin = material or before[0], before[1] if kelvin is None else kelvin
        find(self.library, material, f"object {name!r}")
        now = material, kelvin
        return self if now == before else replace(self, objects={**self.objects, name: now})

    def with_area(self, area: Painted) -> "Document":
        """Return this Document with another material within an area."""
        find(self.library, area.material, "the area")
        return replace(self, painted=(*self.painted, area))

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
        for each in self.painted:
            scene = scene.with_material_in(each.area, self.library[each.material])
        return scene


class History:
    """The edits of a scene, and the number of the version that all tabs show.

    Attributes
    ----------
    saved : Document
        As the files hold it.
    version : int
        Counts every edit, undo and redo, so that no two states have the same number.
    """

    def __init__(self, saved: Document) -> None:
        self.saved, self.version = saved, 0
        self._steps: list[tuple[Document, str]] = [(saved, "")]
        self._at = 0
        # Who made the current version, and the first version since which nobody else made one.
        self._by, self._since = "", 0

    def _count(self, by: str) -> None:
        if by != self._by:
            self._by, self._since = by, self.version
        self.version += 1

    @property
    def document(self) -> Document:
        """The Document that is shown."""
        return self._steps[self._at][0]

    @property
    def undoes(self) -> str:
        """What undo would take back; "" for nothing."""
        return self._steps[self._at][1]

    @property
    def redoes(self) -> str:
        """What redo would do again; "" for nothing."""
        return self._steps[self._at + 1][1] if self._at + 1 < len(self._steps) else ""

    def edit(
        self, version: int, what: str, change: Callable[[Document], Document], check: Callable[[Document], object],
        by: str = "",
    ) -> None:  # fmt: skip
        """Change the Document.

        Parameters
        ----------
        version : int
            The version that the user saw.
        what : str
            The edit in words.
        change : callable
            Returns the changed Document.
        check : callable
            Raises where the changed Document cannot be used.
        by : str
            The tab.

        Raises
        ------
        ThermorenderError
            Another tab has made a version since the one that the user saw, or `change` or `check` refuses.
        """
        self.refuse_outdated(version, by)
        made = change(self.document)
        if made is self.document:
            return
        check(made)
        self._steps = [*self._steps[: self._at + 1], (made, what)][-MOST_EDITS:]
        self._at = len(self._steps) - 1
        self._count(by)

    def refuse_outdated(self, version: int, by: str = "") -> None:
        """Raise unless `version` is the current one, or all later ones are of the same tab."""
        if version != self.version and not (by and by == self._by and self._since <= version < self.version):
            raise ThermorenderError(
                f"this tab showed version {version}, and another tab has changed the tables since (version "
                f"{self.version}); nothing was changed, look at the new values and repeat the edit"
            )

    def step(self, version: int, steps: int, by: str = "") -> None:
        """Undo one edit (−1) or redo one (+1)."""
        self.refuse_outdated(version, by)
        if 0 <= self._at + steps < len(self._steps):
            self._at += steps
            self._count(by)

    def loaded(self, saved: Document) -> None:
        """Take over a Document from files; edits before it are gone."""
        self.saved, self._steps, self._at = saved, [(saved, "")], 0
        self._by, self.version = "", self.version + 1
