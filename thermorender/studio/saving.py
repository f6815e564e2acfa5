"""What a save writes into the scene's own folder, shown as a difference first, and what a user takes away.

The shipped tables and scenes are never written. A file that changed on disk since it was read is not overwritten.
"""

import re
import shlex
from codecs import BOM_UTF8
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.formats import checksum
from thermorender.materials.compare import diff
from thermorender.materials.csv_tables import read_text
from thermorender.materials.library import load_library
from thermorender.materials.material import Material
from thermorender.materials.store import drop_material, index_row, replace_files, store, write_material
from thermorender.materials.thermal import table_text
from thermorender.paths import data_folder, inside
from thermorender.scene.georeference import place_of
from thermorender.scene.parts.patch import areas, texels_in
from thermorender.scene.raster import grid_of
from thermorender.schema import parse_toml
from thermorender.studio.document import Document
from thermorender.studio.fields import scratch_folder
from thermorender.units import utc_text

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene
    from thermorender.studio.session import Session

_MOST_CLASSES = 255
# A line of TOML that assigns a string or a number.
_ASSIGNED = re.compile(r"""(?P<key>[^=]*=\s*)("(\\.|[^"\\])*"|'[^']*'|[^\s"'#]+)(?P<comment>\s*(#.*)?)""")
# Of a difference between the tables before and after.
_WORDS = {"only in the second": "new material", "only in the first": "removed"}


def snapshot(scene: "Scene") -> dict[Path, str]:
    """Return the checksums of the files that a save may write, as they are now."""
    folder, raster = scene.spec.folder, scene.spec.emissivity.raster
    paths = [folder / "scene.toml", *sorted((folder / "materials").rglob("*.csv")), *([raster] if raster else [])]
    return {path: checksum(path) for path in paths if path.is_file()}


@dataclass(frozen=True, eq=False)
class Save:
    """A save of a Document: the new contents of files (None: removed), and what changes, in lines for people."""

    files: dict[Path, bytes | None]
    lines: tuple[str, ...]
    document: Document


def planned(session: "Session") -> Save:
    """Return the Save of the edits since the last one.

    Raises
    ------
    ThermorenderError
        A shipped scene, files that changed on disk, or an edit that the scene's files cannot hold.
    """
    scene, document, saved = session.base, session.document, session.history.saved
    folder = scene.spec.folder
    if inside(folder, data_folder("scenes")):
        raise ThermorenderError(
            f"{scene.name} is a shipped scene, which the studio does not write; copy its folder {folder} and open the "
            "copy"
        )
    refuse_changed(session)
    files, lines = _tables(session)
    path = folder / "scene.toml"
    text = old = read_text(path)
    stated = parse_toml(text.encode(), scene.where).get("emissivity", {}).get("classes", {})
    # Classes that an earlier save of painted areas added are given again, or dropped.
    classes = dict(document.classes)
    if document.painted or saved.painted:
        raster, lines_of_map = _class_raster(session, classes)
        files |= raster
        lines += lines_of_map
    for number, name in (dict.fromkeys(map(int, stated)) | classes).items():
        if name != stated.get(str(number)):
            text = _stated(text, "[emissivity.classes]", None, str(number), name and f'"{name}"')
    for name, (material, kelvin) in document.objects.items():
        if material != saved.objects[name][0]:
            text = _stated(text, "[[object]]", name, "material", f'"{material}"')
        if kelvin is not None and kelvin != saved.objects[name][1]:
            text = _stated(text, "[[object]]", name, "temperature", f"{kelvin:.12g}")
    _refuse_names_left(text, saved.library.keys() - document.library.keys())
    if text != old:
        _refuse_other_meaning(old, text, document, classes)
        files[path] = _as_in(path.read_bytes(), text)
        before, after = (Counter(each.splitlines()) for each in (old, text))
        lines += [f"scene.toml  −{line}" for line in before - after]
        lines += [f"scene.toml  +{line}" for line in after - before]
    return Save(files, tuple(lines), document)


def _refuse_names_left(text: str, gone: set[str]) -> None:
    """Raise if a scene file names materials that a save would remove, such as renamed ones."""
    left = sorted(gone & _words_of(parse_toml(text.encode(), "scene.toml")))
    if left:
        raise ThermorenderError(
            f"scene.toml names {left[0]} outside its classes and objects, which the studio does not change; undo "
            "its deletion or new name, or give it another material there by hand and press Reload"
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


def refuse_changed(session: "Session") -> None:
    """Raise if a file that a save may write is not as it was read."""
    now = snapshot(session.base)
    for path in {**session.files, **now}:
        if now.get(path) != session.files.get(path):
            raise ThermorenderError(
                f"{path} has changed on disk since the studio read it; nothing was written, so press Reload to read it "
                "again (edits are lost), or undo the change there"
            )


def write(session: "Session", save: Save) -> None:
    """Write a Save, all files or none; the edits then count as saved.

    Raises
    ------
    ThermorenderError
        Files or edits have changed since the Save was planned, or a file cannot be written.
    """
    refuse_changed(session)
    if save.document is not session.document:
        raise ThermorenderError(
            "another tab has changed the tables since these changes were listed; nothing was written, so press Save "
            "again to see all changes"
        )
    own = session.base.spec.folder / "materials"
    try:
        replace_files(save.files)
    finally:
        # A scene with an empty folder of materials is refused.
        for folder in (own / "spectra", own / "thermal", own):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
    session.saved(snapshot(session.base))


def _tables(session: "Session") -> tuple[dict[Path, bytes | None], list[str]]:
    """Contents of the tables that change, and the differences in words, by writing them beside the scene first."""
    document, saved, origin = session.document, session.history.saved, session.origin
    own, band_um = session.base.spec.folder / "materials", session.base.camera.band_um
    changed = document.changed(saved)
    # A shipped material that is as shipped again needs no table of the scene.
    shipped = {
        name for name in changed if name not in origin.own and document.library[name] is origin.library.get(name)
    }
    removed = [name for name in saved.library if name not in document.library or name in shipped]
    if not changed and not removed:
        return {}, []
    with scratch_folder() as scratch:
        there = Path(scratch, "materials")
        before = {path.relative_to(own): path.read_bytes() for path in sorted(own.rglob("*.csv"))}
        replace_files({there / name: data for name, data in before.items()})
        for name in removed:
            drop_material(name, there)
        for name in [each for each in changed if each not in shipped]:
            _write(document.library[name], there, document.tables.get(name))
        try:
            load_library(there if any(there.rglob("*.csv")) else None)
        except ThermorenderError as error:
            raise ThermorenderError(str(error).replace(str(there), str(own))) from None
        after = {path.relative_to(there): path.read_bytes() for path in sorted(there.rglob("*.csv"))}
    files: dict[Path, bytes | None] = {
        own / name: after.get(name) for name in {**before, **after} if before.get(name) != after.get(name)
    }
    lines = []
    for each in diff(dict(saved.library), dict(document.library), band_um):
        values = " → ".join("–" if value is None else f"{value:.4f}" for value in each.emissivity)
        shift = "" if each.millikelvin is None else f" ({each.millikelvin:+.1f} mK at 300 K)"
        lines.append(f"{each.name}  emissivity {values}{shift}: {_WORDS.get(each.what, each.what)}")
    return files, lines + [f"materials/{path.relative_to(own)}  written" for path in files]


def _write(material: Material, folder: Path, table: str | None) -> None:
    """Write a material into a folder; `table` is the text of the spectral table of one that emits by angle."""
    if table is None:
        write_material(material, folder, replace=True)
        return
    store(index_row(material), table, folder, True, table_text(material.thermal) if material.thermal else None)


def _stated(text: str, table: str, name: str | None, key: str, value: str | None) -> str:
    """Return a scene file in which a table states another value, or none, in the same place; `name` is an object's."""
    lines, here, start = text.splitlines(keepends=True), False, None
    named = name is None
    for number, line in enumerate(lines):
        bare = line.split("#")[0].strip()
        if bare.startswith("["):
            if here and named and start is not None:
                break
            here, named, start = bare == table, name is None, None
        elif here:
            known, _, given = (part.strip() for part in bare.partition("="))
            named = named or (known == "name" and given.strip("\"'") == name)
            if known.strip("\"'") == key:
                start = number
    if start is not None and named and value is None:
        return "".join([*lines[:start], *lines[start + 1 :]])
    if start is not None and named:
        assigned = _ASSIGNED.fullmatch(lines[start].rstrip("\n"))
        if assigned is None:
            raise _unstated(name or table, key, value)
        lines[start] = f"{assigned['key']}{value}{assigned['comment']}\n"
        return "".join(lines)
    if table in (line.split("#")[0].strip() for line in lines) and name is None:
        at = next(k for k, line in enumerate(lines) if line.split("#")[0].strip() == table)
        lines.insert(at + 1, f"{key} = {value}\n")
        return "".join(lines)
    raise _unstated(name or table, key, value)


def _unstated(what: str, key: str, value: str | None) -> ThermorenderError:
    return ThermorenderError(
        f"scene.toml does not state {key} of {what} on a line of its own, so the studio cannot change it; "
        f"write {key} = {value} there by hand and press Reload"
    )


def _refuse_other_meaning(old: str, new: str, document: Document, classes: dict[int, str]) -> None:
    """Raise unless a changed scene file states exactly what is to change."""
    wanted, found = (parse_toml(text.encode(), "scene.toml") for text in (old, new))
    if classes:
        wanted["emissivity"]["classes"] = {str(number): name for number, name in classes.items()}
    for each in wanted.get("object", ()):
        each["material"], each["temperature"] = document.objects[each["name"]]
    if wanted != found:
        raise ThermorenderError(
            "scene.toml is written in a form that the studio cannot change safely; change the classes or objects there "
            "by hand and press Reload"
        )


def _class_raster(session: "Session", classes: dict[int, str]) -> tuple[dict[Path, bytes | None], list[str]]:
    """The class raster with the painted areas, and the change in words; new classes are added to `classes`."""
    import rasterio

    scene, painted, source = session.base, session.document.painted, session.base.spec.emissivity
    if source.source != "classes" or source.raster is None or scene.grid is None:
        raise ThermorenderError(
            f"{scene.where} has no raster of classes, which painted areas are saved in; undo them, or make one with "
            "`thermorender map-materials` and name it as emissivity.raster"
        )
    place, grid = place_of(scene.frame, scene.grid), grid_of(source.raster)
    assert place is not None
    # As it was read: an area that undo took back after a save is no longer in it.
    with rasterio.MemoryFile(session.class_raster) as memory, memory.open() as dataset:
        values, profile, tags = dataset.read(1), dataset.profile, dataset.tags()
        colours = dataset.colormap(1) if dataset.colorinterp[0].name == "palette" else None
    before = values.copy()
    for each in painted:
        number = next((k for k, name in classes.items() if name == each.material), None)
        if number is None:
            used = {*classes, *np.unique(values).tolist(), profile.get("nodata")}
            number = next((k for k in range(1, _MOST_CLASSES) if k not in used), None)
            if number is None:
                raise ThermorenderError(
                    f"the class raster has no free number for {each.material}; assign a class to it instead"
                )
            classes[number] = each.material
        for geometry, _ in areas(each.area, place, scene.ground):
            values[texels_in(geometry, grid, "the painted area")] = number
    with scratch_folder() as scratch:
        path = Path(scratch, source.raster.name)
        with rasterio.open(path, "w", **profile) as dataset:
            dataset.write(values, 1)
            dataset.update_tags(**tags)
            if colours:
                dataset.write_colormap(1, colours)
        data = path.read_bytes()
    count = int(np.count_nonzero(values != before))
    if data == source.raster.read_bytes():
        return {}, []
    words = f"{source.raster.name}  {count} texels of another class; painted areas: {len(painted)}"
    return {source.raster: data}, [words]


def exported(session: "Session", tab: str, kind: str, metres: float) -> tuple[bytes, str]:
    """Return (contents, name) of a file of a tab's frame: png, exr, npz, tif, or map for an orthorectified GeoTIFF."""
    frame = session.renders.frame(tab)
    if frame is None or kind not in ("png", "exr", "npz", "tif", "map"):
        raise ThermorenderError("there is no frame yet, or no such kind of file; reload the page")
    name = f"{session.base.name}-{kind}.tif" if kind == "map" else f"{session.base.name}.{kind}"

    def made() -> bytes:
        with scratch_folder() as scratch:
            path = Path(scratch, f"frame.{'tif' if kind == 'map' else kind}")
            (frame.orthorectified(metres) if kind == "map" else frame).save(path)
            return path.read_bytes()

    return session.renders.call(made), name


def commands(session: "Session", view: Any) -> tuple[str, str]:
    """Return (Python, command line) that render a view; unsaved edits of tables are named, not repeated."""
    scene, document, saved = session.base, session.document, session.history.saved
    pose, place = view.pose.text(scene), str(scene.spec.folder)
    numbers = pose.replace(",", ", ")
    edits: dict[Any, str] = {key: name for key, name in document.classes.items() if name != saved.classes.get(key)}
    objects = {key: each for key, each in document.objects.items() if each != saved.objects.get(key)}
    edits |= {key: name for key, (name, _) in objects.items() if name != saved.objects[key][0]}
    kelvin = {key: k for key, (_, k) in objects.items() if k != saved.objects[key][1]}
    unsaved = document.changed(saved) + (["painted areas"] if document.painted != saved.painted else [])
    python = [_not_here(unsaved) + f"import thermorender as tr\n\nscene = tr.load_scene({place!r})"]
    python += [f"scene = scene.at({utc_text(document.time)!r})"] if document.time is not None else []
    python += [f"scene = scene.with_material({edits!r})"] if edits else []
    python += [f"scene = scene.with_objects({kelvin!r})"] if kelvin else []
    python += [f"renderer = tr.Renderer(scene, {session.quality!r})"]
    python += [f"frame = renderer.frame(scene.pose({numbers}), {view.time_s:g})", 'frame.save("frame.exr")', ""]
    return "\n".join(python), _not_here(unsaved + [str(key) for key in {**edits, **kelvin}]) + command(session, view)


def _not_here(unsaved: list[str]) -> str:
    return f"# not saved yet, so not in these lines: {', '.join(unsaved)}\n" if unsaved else ""


def command(session: "Session", view: Any) -> str:
    """Return the command line that renders a view of the saved scene."""
    scene, time = session.base, session.document.time
    options = [str(scene.spec.folder), "--quality", session.quality, f"--pose={view.pose.text(scene)}"]
    options += ["--time", utc_text(time)] if time is not None else []
    return shlex.join(["thermorender", "render", *options, "-o", "out"]) + "\n"
