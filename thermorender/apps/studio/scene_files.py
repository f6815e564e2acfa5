r"""What a scene's own files hold of its materials, and what edits write into them, with a difference in words first.

For example::

    files = SceneFiles(tr.load_scene("mine"))
    save = files.plan(files.saved.with_material(measured).of_class(3, measured.name))
    print("\n".join(save.lines))
    files.write(save)

The shipped tables and scenes are never written. A file that changed on disk since it was read is not overwritten.
"""

import re
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender.apps.material_tables.compare import diff
from thermorender.apps.studio.document import Document
from thermorender.errors import ThermorenderError
from thermorender.files import scratch_folder
from thermorender.formats import checksum
from thermorender.materials.csv_tables import read_text
from thermorender.materials.library import load_library
from thermorender.materials.store import drop_material, replace_files, write_material
from thermorender.paths import data_folder, inside
from thermorender.scene.georeference import place_of
from thermorender.scene.patch import areas, texels_in
from thermorender.scene.raster import grid_of
from thermorender.schema import parse_toml

if TYPE_CHECKING:
    from thermorender import Scene

_Contents = dict[Path, bytes | None]

_MOST_CLASSES = 255
# A line that assigns a string or a number.
_ASSIGNED = re.compile(r"""(?P<key>[^=]*=\s*)("(\\.|[^"\\])*"|'[^']*'|[^\s"'#]+)(?P<comment>\s*(#.*)?)""")
# Of a difference between the tables before and after.
_WORDS = {"only in the second": "new material", "only in the first": "removed"}


@dataclass(frozen=True, eq=False)
class Save:
    """A save of a Document: the new contents of files (None: removed), and what changes, in lines for people.

    `known` has the checksums of the files that it begins from.
    """

    files: _Contents
    lines: tuple[str, ...]
    document: Document
    known: Mapping[Path, str]


class SceneFiles:
    """The files of a scene that a save may write.

    Parameters
    ----------
    scene : Scene
        As loaded. Its files are noted as they are now.

    Attributes
    ----------
    scene : Scene
    origin : Document
        Of the scene.
    saved : Document
        As the files hold it after the latest save.
    """

    def __init__(self, scene: "Scene") -> None:
        self.scene = scene
        self.origin = self.saved = Document.of(scene)
        self._folder, self._raster = scene.spec.folder, scene.spec.emissivity.raster
        self._known, self._classes = self._checksums(), self._raster.read_bytes() if self._raster else b""

    def _checksums(self) -> dict[Path, str]:
        own = sorted((self._folder / "materials").rglob("*.csv"))
        paths = [self._folder / "scene.toml", *own, *([self._raster] if self._raster else [])]
        return {path: checksum(path) for path in paths if path.is_file()}

    def refuse_changed(self) -> None:
        """Raise if a file that a save may write is not as it was read."""
        now = self._checksums()
        for path in {**self._known, **now}:
            if now.get(path) != self._known.get(path):
                raise ThermorenderError(
                    f"{path} has changed on disk since it was read; nothing was written, so read the scene again "
                    "(edits are lost), or undo the change there"
                )

    def plan(self, document: Document) -> Save:
        """Return the Save of a Document.

        Raises
        ------
        ThermorenderError
            A shipped scene, files that changed on disk, or an edit that the scene's files cannot hold.
        """
        if inside(self._folder, data_folder("scenes")):
            raise ThermorenderError(
                f"{self.scene.name} is a shipped scene, which is not written; copy its folder {self._folder} and open "
                "the copy"
            )
        self.refuse_changed()
        files, lines = self._tables(document)
        path = self._folder / "scene.toml"
        text = old = read_text(path)
        known = parse_toml(text.encode(), self.scene.where).get("emissivity", {}).get("classes", {})
        # Classes that an earlier save of painted areas added are given again, or dropped.
        classes = dict(document.classes)
        if document.painted or self.saved.painted:
            raster, lines_of_map = self._class_raster(document, classes)
            files |= raster
            lines += lines_of_map
        for number, name in (dict.fromkeys(map(int, known)) | classes).items():
            if name != known.get(str(number)):
                text = _stated(text, "[emissivity.classes]", None, str(number), name and f'"{name}"')
        for name, (material, kelvin) in document.objects.items():
            if material != self.saved.objects[name][0]:
                text = _stated(text, "[[object]]", name, "material", f'"{material}"')
            if kelvin is not None and kelvin != self.saved.objects[name][1]:
                text = _stated(text, "[[object]]", name, "temperature", f"{kelvin:.12g}")
        _refuse_names_left(text, self.saved.library.keys() - document.library.keys())
        if text != old:
            _refuse_other_meaning(old, text, document, classes)
            files[path] = _as_in(path.read_bytes(), text)
            before, after = (Counter(each.splitlines()) for each in (old, text))
            lines += [f"scene.toml  −{line}" for line in before - after]
            lines += [f"scene.toml  +{line}" for line in after - before]
        return Save(files, tuple(lines), document, self._known)

    def write(self, save: Save) -> None:
        """Write a Save, all files or none.

        Raises
        ------
        ThermorenderError
            Files have changed since the Save was planned, or a file cannot be written.
        """
        self.refuse_changed()
        if save.known != self._known:
            raise ThermorenderError(
                "another save has been written since this one was planned; nothing was written, so plan it again"
            )
        own = self._folder / "materials"
        try:
            replace_files(save.files)
        finally:
            # A scene with an empty folder of materials is refused.
            for folder in (own / "spectra", own / "thermal", own):
                if folder.is_dir() and not any(folder.iterdir()):
                    folder.rmdir()
        self._known, self.saved = self._checksums(), save.document

    def _tables(self, document: Document) -> tuple[_Contents, list[str]]:
        """Contents of the tables that change, and the differences in words, by writing them beside the scene first."""
        saved, own = self.saved, self._folder / "materials"
        changed = document.changed(saved)
        # A shipped material that is as shipped again needs no table of the scene.
        shipped = {
            name for name in changed
            if name not in self.origin.own and document.library[name] is self.origin.library.get(name)
        }  # fmt: skip
        removed = [name for name in saved.library if name not in document.library or name in shipped]
        if not changed and not removed:
            return {}, []
        before = {path.relative_to(own): path.read_bytes() for path in sorted(own.rglob("*.csv"))}
        after = self._rewritten(document, before, [name for name in changed if name not in shipped], removed)
        files: _Contents = {
            own / name: after.get(name) for name in {**before, **after} if before.get(name) != after.get(name)
        }
        lines = []
        for each in diff(dict(saved.library), dict(document.library), self.scene.camera.band_um):
            values = " → ".join("–" if value is None else f"{value:.4f}" for value in each.emissivity)
            shift = "" if each.millikelvin is None else f" ({each.millikelvin:+.1f} mK at 300 K)"
            lines.append(f"{each.name}  emissivity {values}{shift}: {_WORDS.get(each.what, each.what)}")
        return files, lines + [f"materials/{path.relative_to(own)}  written" for path in files]

    def _rewritten(
        self, document: Document, before: Mapping[Path, bytes], changed: Sequence[str], removed: Sequence[str]
    ) -> dict[Path, bytes]:
        """Contents of all tables after changes and removals, tried as a library beside the scene."""
        with scratch_folder() as scratch:
            there = scratch / "materials"
            replace_files({there / name: data for name, data in before.items()})
            for name in removed:
                drop_material(name, there)
            for name in changed:
                write_material(document.library[name], there, replace=True)
            try:
                load_library(there if any(there.rglob("*.csv")) else None)
            except ThermorenderError as error:
                raise ThermorenderError(str(error).replace(str(there), str(self._folder / "materials"))) from None
            return {path.relative_to(there): path.read_bytes() for path in sorted(there.rglob("*.csv"))}

    def _class_raster(self, document: Document, classes: dict[int, str]) -> tuple[_Contents, list[str]]:
        """The class raster with the painted areas, and the change in words; new classes are added to `classes`."""
        import rasterio

        scene = self.scene
        if scene.spec.emissivity.source != "classes" or self._raster is None or scene.grid is None:
            raise ThermorenderError(
                f"{scene.where} has no raster of classes, which painted areas are saved in; undo them, or make one "
                "with `thermorender map-materials` and name it as emissivity.raster"
            )
        place, grid = place_of(scene.frame, scene.grid), grid_of(self._raster)
        assert place is not None
        # As it was read: an area that was taken back after a save is no longer in it.
        with rasterio.MemoryFile(self._classes) as memory, memory.open() as dataset:
            values, profile, tags = dataset.read(1), dataset.profile, dataset.tags()
            colours = dataset.colormap(1) if dataset.colorinterp[0].name == "palette" else None
        before = values.copy()
        for area, name in document.painted:
            number = next((k for k, each in classes.items() if each == name), None)
            if number is None:
                used = {*classes, *np.unique(values).tolist(), profile.get("nodata")}
                number = next((k for k in range(1, _MOST_CLASSES) if k not in used), None)
                if number is None:
                    raise ThermorenderError(
                        f"the class raster has no free number for {name}; assign a class to it instead"
                    )
                classes[number] = name
            for geometry, _ in areas(area, place, scene.ground):
                values[texels_in(geometry, grid, "the painted area")] = number
        with scratch_folder() as scratch:
            path = scratch / self._raster.name
            with rasterio.open(path, "w", **profile) as dataset:
                dataset.write(values, 1)
                dataset.update_tags(**tags)
                if colours:
                    dataset.write_colormap(1, colours)
            data = path.read_bytes()
        if data == self._raster.read_bytes():
            return {}, []
        count = int(np.count_nonzero(values != before))
        words = f"{self._raster.name}  {count} texels of another class; painted areas: {len(document.painted)}"
        return {self._raster: data}, [words]


def _stated(text: str, table: str, name: str | None, key: str, value: str | None) -> str:
    """Return the text of a scene file in which `key` of a table, given by its first line such as "[[object]]" and its
    name, has another value; None removes it. A name that the only table lacks is added.
    """
    lines = text.splitlines(keepends=True)
    bare = [line.split("#")[0].strip() for line in lines]
    for start, end in pairwise([*(k for k, line in enumerate(bare) if line.startswith("[")), len(lines)]):
        pairs = {k: tuple(part.strip("\"' ") for part in bare[k].partition("=")[::2]) for k in range(start + 1, end)}
        if bare[start] != table or (name is not None and ("name", name) not in pairs.values()):
            continue
        at = next((k for k, (known, _) in pairs.items() if known == key), None)
        if at is None and name is None:
            return "".join([*lines[: start + 1], f"{key} = {value}\n", *lines[start + 1 :]])
        if at is not None and value is None:
            return "".join([*lines[:at], *lines[at + 1 :]])
        if at is not None and (assigned := _ASSIGNED.fullmatch(lines[at].rstrip("\n"))):
            return "".join([*lines[:at], f"{assigned['key']}{value}{assigned['comment']}\n", *lines[at + 1 :]])
        break
    raise ThermorenderError(
        f"scene.toml does not state {key} of {name or table} on a line of its own, so it cannot be changed there; "
        f"write {key} = {value} there by hand and read the scene again"
    )


def _refuse_names_left(text: str, gone: set[str]) -> None:
    """Raise if a scene file names materials that a save would remove, such as renamed ones."""
    left = sorted(gone & _words_of(parse_toml(text.encode(), "scene.toml")))
    if left:
        raise ThermorenderError(
            f"scene.toml names {left[0]} outside its classes and objects, where a save does not change it; undo its "
            "deletion or new name, or give it another material there by hand and read the scene again"
        )


def _words_of(given: Any) -> set[str]:
    """All keys and texts in the contents of a TOML file."""
    if isinstance(given, str):
        return {given}
    parts = [*given, *given.values()] if isinstance(given, dict) else given if isinstance(given, list) else []
    return set().union(*map(_words_of, parts))


def _as_in(old: bytes, text: str) -> bytes:
    """Return a text with the line ends and the byte order mark of a file."""
    text = text.replace("\n", "\r\n") if b"\r\n" in old else text
    return text.encode("utf-8-sig" if old.startswith(BOM_UTF8) else "utf-8")


def _refuse_other_meaning(old: str, new: str, document: Document, classes: dict[int, str]) -> None:
    """Raise unless a changed scene file states exactly what is to change."""
    wanted, found = (parse_toml(text.encode(), "scene.toml") for text in (old, new))
    if classes:
        wanted["emissivity"]["classes"] = {str(number): name for number, name in classes.items()}
    for each in wanted.get("object", ()):
        each["material"], each["temperature"] = document.objects[each["name"]]
    if wanted != found:
        raise ThermorenderError(
            "scene.toml is written in a form that cannot be changed safely; change the classes or objects there by "
            "hand and read the scene again"
        )
