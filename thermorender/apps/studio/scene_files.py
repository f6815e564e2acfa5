r"""What a scene's own files hold of its materials, and what edits write into them, with a difference in words first.

For example::

    files = SceneFiles(tr.load_scene("mine"))
    save = files.plan(files.saved.with_material(measured).of_class(3, measured.name))
    print("\n".join(save.lines))
    files.write(save)

The shipped tables and scenes are never written. A file that changed on disk since it was read is not overwritten.
"""

import re
import warnings
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.material_tables.compare import diff
from thermorender.apps.material_tables.edit import thermal_tables
from thermorender.apps.studio.document import Document
from thermorender.errors import ThermorenderError
from thermorender.files import scratch_folder
from thermorender.formats import checksum
from thermorender.materials.csv_tables import read_text
from thermorender.materials.library import load_library
from thermorender.materials.store import drop_material, replace_files, write_material
from thermorender.materials.thermal import read_thermals, table_text
from thermorender.paths import data_folder, inside
from thermorender.scene.georeference import place_of
from thermorender.scene.patch import areas, texels_of
from thermorender.scene.raster import Grid, grid_of
from thermorender.scene.surface import Surface, fill, nearest_valid
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
        self._folder, self._class_files = scene.spec.folder, scene.class_files
        self._classes = {path: path.read_bytes() for path in self._class_files if path is not None}
        self._known = self._checksums()

    def _checksums(self) -> dict[Path, str]:
        own = sorted((self._folder / "materials").rglob("*.csv"))
        paths = [self._folder / "scene.toml", *own, *self._classes]
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
            rasters, lines_of_classes = self._class_rasters(document, classes)
            files |= rasters
            lines += lines_of_classes
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
            texts = ["–" if value is None else f"{value:.4f}" for value in each.emissivity]
            shift = "" if each.millikelvin is None else f" ({each.millikelvin:+.1f} mK at 300 K)"
            values = "" if texts[0] == texts[1] else f"emissivity {' → '.join(texts)}{shift}: "
            lines.append(f"{each.name}  {values}{_WORDS.get(each.what, each.what)}")
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
            replace_files(_layer_tables(document, self.saved, there / "thermal"))
            try:
                load_library(there if any(there.rglob("*.csv")) else None)
            except ThermorenderError as error:
                raise ThermorenderError(str(error).replace(str(there), str(self._folder / "materials"))) from None
            return {path.relative_to(there): path.read_bytes() for path in sorted(there.rglob("*.csv"))}

    def _class_rasters(self, document: Document, classes: dict[int, str]) -> tuple[_Contents, list[str]]:
        """The class rasters with the painted texels, and the change in words; new classes are added to `classes`."""
        # As they were read: texels that were taken back after a save are no longer in them.
        rasters = {path: _ClassRaster(path, data) for path, data in self._classes.items()}
        for area, name in document.painted:
            number = next((k for k, each in classes.items() if each == name), None)
            if number is None:
                used = set(classes).union(*(raster.used for raster in rasters.values()))
                number = next((k for k in range(1, _MOST_CLASSES) if k not in used), None)
                if number is None:
                    raise ThermorenderError(
                        f"the class rasters have no free number for {name}; assign a class to it instead"
                    )
                classes[number] = name
            for path, pixels in self._pixels(area, rasters):
                rasters[path].paint(pixels, number, document.library[name].colour)
        if any(raster.painted.any() and raster.open.any() for raster in rasters.values()):
            self._keep_open(document, classes, rasters)
        files, lines = _Contents(), list[str]()
        for path, raster in rasters.items():
            data, now = raster.data(), path.read_bytes()
            if data != now:
                files[path] = data
                count = np.count_nonzero(raster.numbers != _ClassRaster(path, now).numbers)
                shown = path.relative_to(self._folder) if inside(path, self._folder) else path
                lines.append(f"{shown}  {count} texels of another class")
        return files, lines

    def _pixels(
        self, area: Mapping[str, Any] | NDArray[np.int64], rasters: Mapping[Path, "_ClassRaster"]
    ) -> Iterator[tuple[Path, NDArray[np.bool_]]]:
        """(class raster, which of its pixels a painted area covers), refused where the files cannot hold it."""
        scene = self.scene
        if (grid := self._other_grid()) is not None:
            yield grid[0], self._on_other_grid(area, grid[1])
            return
        numbers, first = scene.texels_in(area) if isinstance(area, Mapping) else area, 0
        for surface, path in zip(scene.surfaces[: scene.terrain_count], self._class_files, strict=True):
            own = numbers[slice(*np.searchsorted(numbers, [first, first + surface.flags.size]))] - first
            first += surface.flags.size
            if not own.size:
                continue
            if path is None:
                raise ThermorenderError(f"{scene.where}: {_unsaved(surface, scene.grid is not None)}")
            covered = np.zeros(surface.flags.size, bool)
            covered[own] = True
            # A texture may be repeated over the texels.
            rows, columns = rasters[path].numbers.shape
            repeats = covered.reshape(-1, rows, surface.flags.shape[1] // columns, columns)
            pixels = np.asarray(repeats.any(axis=(0, 2)))
            if (pixels != repeats.all(axis=(0, 2))).any():
                raise ThermorenderError(
                    f"{scene.where}: surface {surface.name!r} repeats its texture, so {path.name} holds one class for "
                    "all repeats of a texel; undo that area, or paint the texel in each"
                )
            yield path, pixels

    def _other_grid(self) -> tuple[Path, Grid] | None:
        """(class raster of a raster terrain, its Grid) where its cells are not the texels; else None."""
        path, own = self._class_files[0], self.scene.grid
        grid = None if path is None or own is None else grid_of(path)
        return None if path is None or grid is None or own is None or grid.same_as(own) else (path, grid)

    def _on_other_grid(self, area: Mapping[str, Any] | NDArray[np.int64], grid: Grid) -> NDArray[np.bool_]:
        """Which cells of a class raster have their middle in an area of a raster terrain, whose texels are others."""
        from rasterio.features import shapes

        scene, own = self.scene, self.scene.grid
        place = place_of(scene.frame, own)
        assert own is not None and place is not None
        if isinstance(area, Mapping):
            outlines = [geometry for geometry, _ in areas(area, place, scene.ground)]
        else:
            texels = np.zeros((own.height, own.width), np.uint8)
            texels.flat[area] = 1
            outlines = [geometry for geometry, _ in shapes(texels, texels > 0, transform=own.transform)]
        found = np.zeros((grid.height, grid.width), bool)
        for outline in outlines:
            part, covered = texels_of(outline, own.crs, grid, "the painted area")
            found[part] |= covered
        if not found.any():
            raise ThermorenderError(
                f"{grid.name} has cells too large for a painted area, which covers the middle of none; undo it, or "
                "paint a larger one"
            )
        return found

    def _keep_open(
        self, document: Document, classes: Mapping[int, str], rasters: Mapping[Path, "_ClassRaster"]
    ) -> None:
        """State the classes of pixels without one that take the nearest's, where a painted one would be nearest."""
        if self._other_grid() is not None:
            return
        scene = document.scene(self.scene, self.origin)
        number_of = {name: number for number, name in reversed(list(classes.items()))}
        numbers = np.array([number_of.get(each.name, 0) for each in scene.materials])
        for surface, path in zip(scene.surfaces, self._class_files, strict=False):
            if path is not None:
                rows, columns = rasters[path].numbers.shape
                rasters[path].keep(numbers[surface.material[:rows, :columns]])


def _unsaved(surface: Surface, raster: bool) -> str:
    """Why painted texels of a surface without a raster of classes cannot be saved, and what to do."""
    if surface.far:
        return "painted texels of far ground are not saved; undo them, or paint the scene within it"
    if raster:
        return (
            "there is no raster of classes, which painted areas are saved in; undo them, or make one with "
            "`thermorender map-materials` and name it as emissivity.raster"
        )
    return (
        f"surface {surface.name!r} has no raster of classes in the pixels of its texture, which painted areas are "
        "saved in; undo them, or give it classes in a [[surface]]"
    )


class _ClassRaster:
    """A raster of classes: its `bands`, of which the first has the numbers, and which pixels are `painted`."""

    def __init__(self, path: Path, data: bytes) -> None:
        import rasterio

        self._path, self._before = path, data
        with _quiet(), rasterio.MemoryFile(data) as memory, memory.open() as dataset:
            self.bands, self._profile, self._tags = dataset.read(), dataset.profile, dataset.tags()
            self._colours = dataset.colormap(1) if dataset.colorinterp[0].name == "palette" else None
        self.painted = np.zeros(self.bands[0].shape, bool)

    @property
    def numbers(self) -> NDArray[Any]:
        """The class numbers (h, w)."""
        found: NDArray[Any] = self.bands[0]
        return found

    @property
    def used(self) -> set[Any]:
        """Its numbers, and that of no data."""
        return {*np.unique(self.numbers).tolist(), self._profile.get("nodata")}

    @property
    def open(self) -> NDArray[np.bool_]:
        """The pixels without a class."""
        found: NDArray[np.bool_] = (self.numbers == 0) | (self.numbers == self._profile.get("nodata"))
        return found

    def paint(self, pixels: NDArray[np.bool_], number: int, colour: Sequence[int]) -> None:
        """Give some pixels a class, which a palette without it shows in a colour."""
        self.numbers[pixels] = number
        self.painted |= pixels
        if self._colours is not None:
            self._colours.setdefault(number, (*colour, 255))

    def keep(self, numbers: NDArray[np.int64]) -> None:
        """Give pixels without a class theirs of `numbers`, where the nearest with one is painted and differs."""
        known = ~self.open
        while not known.all():
            near = nearest_valid(known)
            moved = ~known & fill(self.painted, near) & (fill(self.numbers, near) != numbers) & (numbers > 0)
            if not moved.any():
                return
            self.numbers[moved], self.painted[moved], known[moved] = numbers[moved], True, True

    def data(self) -> bytes:
        """Return the bytes of its file; those that were read where no pixel has another class."""
        import rasterio

        if (self.numbers == _ClassRaster(self._path, self._before).numbers).all():
            return self._before
        with scratch_folder() as scratch, _quiet():
            path = scratch / self._path.name
            with rasterio.open(path, "w", **self._profile) as dataset:
                dataset.write(self.bands)
                dataset.update_tags(**self._tags)
                if self._colours:
                    dataset.write_colormap(1, self._colours)
            return path.read_bytes()


@contextmanager
def _quiet() -> Iterator[None]:
    """Read and write pictures without a place on a map, and no file beside them."""
    import rasterio

    with warnings.catch_warnings(), rasterio.Env(GDAL_PAM_ENABLED="NO"):
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        yield


def _layer_tables(document: Document, saved: Document, folder: Path) -> _Contents:
    """Contents of the thermal tables of layers that are no materials and differ from those saved; None: as shipped, or
    no longer there.
    """
    shipped = read_thermals(data_folder("materials"))
    now, before = (
        {name: table_text(each) for name, each in thermal_tables(of.library).items() if name not in of.library}
        for of in (document, saved)
    )
    return {
        folder / f"{name}.csv": None if text is None or (name in shipped and text == table_text(shipped[name])) else
        text.encode()
        for name, text in (dict.fromkeys(before) | now).items()
        if text != before.get(name)
    }  # fmt: skip


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
        each["material"], kelvin = document.objects[each["name"]]
        # Tables, and "balance", stay.
        if kelvin is not None:
            each["temperature"] = kelvin
    if wanted != found:
        raise ThermorenderError(
            "scene.toml is written in a form that cannot be changed safely; change the classes or objects there by "
            "hand and read the scene again"
        )
