"""Wavefront OBJ files and their material libraries, read into Pieces, one for each material.

trimesh silently shows faces of a missing material grey and ignores texture options, so OBJ is read here.
"""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.physics.srgb import linear_from_bytes
from thermorender.scene.meshes.mesh_pieces import GREY, Beside, Coat, Piece, of_faces, several, triangles

# Statements without influence on triangles and their colour; points and lines have no area.
_IGNORED = frozenset("vn vp s mg l p lod bevel c_interp d_interp shadow_obj trace_obj".split())
_NO_INDEX = np.iinfo(np.int64).min  # of a corner without map coordinates
_CHUNK = 100_000  # lines, which bounds the memory of their words
_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]
# Options of a texture by the number of their values, and those without influence on colour.
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_OPTION = re.compile(
    rf"-(o|s|t)((?:\s+{_NUMBER}(?=\s)){{1,3}})\s+|-(mm)((?:\s+{_NUMBER}){{2}})\s+|-([a-zA-Z]\w*)\s+(\S+)\s+"
)
_HARMLESS = ("blendu", "blendv", "boost", "bm", "texres")
_NEUTRAL = {"o": (0.0,), "t": (0.0,), "s": (1.0,), "mm": (0.0, 1.0)}


@dataclass
class _Content:
    """The statements of an OBJ file, still text."""

    vertices: list[str] = field(default_factory=list)
    map_corners: list[str] = field(default_factory=list)
    faces: list[str] = field(default_factory=list)
    libraries: dict[str, None] = field(default_factory=dict)
    # (number of faces before it, name)
    uses: list[tuple[int, str]] = field(default_factory=list)
    # The same of objects (o) and groups (g).
    objects: list[tuple[int, str]] = field(default_factory=list)
    groups: list[tuple[int, str]] = field(default_factory=list)
    # Vertices and map coordinates so far, by the number of a face with negative numbers.
    so_far: dict[int, tuple[int, int]] = field(default_factory=dict)


def read(path: Path, beside: Beside, named: Collection[str] | None = ()) -> list[Piece]:
    """Return the Pieces of an OBJ file, one for each material, and for each object and group in `named`
    (None: all).

    A texture replaces vertex colours and `Kd`; vertex colours replace `Kd`. Constant transparency is ignored, since
    panes are opaque in the long-wave infrared. Map coordinates run up the image in the file.
    """
    content = _content(path)
    vertices, colour = _vertices(content.vertices, path)
    uv = _map_corners(content.map_corners, path)
    lengths, index, map_index = _faces(content, path, len(vertices), len(uv))
    corner, polygon = triangles(lengths, index, vertices, path)
    kinds = [_used(content.uses, len(lengths))]
    kinds += [_used([(n, x if named is None or x in named else "") for n, x in kind], len(lengths))
              for kind in (content.objects, content.groups)]  # fmt: skip
    library = _Library(path, beside, content.libraries)
    pieces = []
    numbers = np.stack([kind.number for kind in kinds], axis=-1)[polygon]
    for own_numbers in np.unique(numbers, axis=0):
        mine = (numbers == own_numbers).all(axis=1)
        name, *others = (kind.names[number] for kind, number in zip(kinds, own_numbers, strict=True))
        faces = index[corner[mine]]
        coat, tint = _coat(library, name, colour, faces)
        own = None if coat.image is None else _texture_uv(uv, map_index[corner[mine]], path)
        names = (name or "mesh", *(other or "" for other in others), coat.file)
        whole = ":".join(filter(None, (path.stem, *names[:-1])))
        pieces.append(Piece(whole, vertices, faces, own, coat, names, tint).compact())
    return pieces


def _coat(
    library: "_Library", name: str | None, colour: NDArray[np.uint8] | None, faces: _Ints
) -> tuple[Coat, NDArray[np.float32] | None]:
    """(Coat, tint or None) of the triangles (T, 3) of a material, where vertices may have a `colour` (V, 3)."""
    coat = library.coat(name)
    if coat.image is not None:
        return coat, None
    if colour is not None and several(colour):
        return Coat(colour=np.full(3, 255, np.uint8)), of_faces(linear_from_bytes(colour), faces)
    if name is None or not library.materials:
        return Coat(colour=GREY if colour is None else colour[0]), None
    return coat, None


def _texture_uv(uv: _Floats, corners: _Ints, path: Path) -> _Floats:
    """Map coordinates (T, 3, 2) of the corners (T, 3) of triangles, v down the image."""
    lacking = (corners == _NO_INDEX).any(axis=1)
    if lacking.any():
        raise ThermorenderError(
            f"{path} has a texture but no map coordinates for it on {int(lacking.sum())} triangles; export the mesh "
            "with UVs"
        )
    return uv[corners] * [1.0, -1.0] + [0.0, 1.0]


def _content(path: Path) -> _Content:
    # Bytes that are not UTF-8 stay as they are, in names too.
    text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    if "\0" in text[:200]:
        raise ThermorenderError(
            f"{path} cannot be read as a mesh (it holds zero bytes); give an OBJ, GLB or PLY file, OBJ as UTF-8 text"
        )
    found = _Content()
    for number, line in enumerate(text.replace("\\\n", " ").split("\n"), 1):
        words = line.split(None, 1)
        if not words or words[0][0] == "#":
            continue
        key, rest = words[0], words[1].strip() if len(words) > 1 else ""
        if key == "v":
            found.vertices.append(rest)
        elif key == "vt":
            found.map_corners.append(rest)
        elif key == "f":
            rest = rest.partition("#")[0]
            if "-" in rest:
                found.so_far[len(found.faces)] = len(found.vertices), len(found.map_corners)
            found.faces.append(rest)
        elif key in ("usemtl", "o", "g"):
            {"usemtl": found.uses, "o": found.objects, "g": found.groups}[key].append((len(found.faces), rest))
        elif key == "mtllib":
            found.libraries[rest] = None
        elif key not in _IGNORED:
            raise ThermorenderError(
                f"{path} cannot be read as a mesh (line {number} begins with {shortened(repr(key), 40)}); give an OBJ, "
                "GLB or PLY file of triangles or polygons"
            )
    return found


def _vertices(lines: list[str], path: Path) -> tuple[_Floats, NDArray[np.uint8] | None]:
    """(positions (V, 3), colours (V, 3) or None) of the vertices."""
    table = _table(lines)
    if table is None or table.shape[1] not in (3, 4, 6, 7):
        raise ThermorenderError(
            f"{path} cannot be read as a mesh (its vertices do not all have x, y, z, or x, y, z and colour); export "
            "the mesh again"
        )
    if table.shape[1] == 4 and (table[:, 3] != 1.0).any():
        raise ThermorenderError(f"{path} has vertices with a weight other than 1; export it as plain polygons")
    return table[:, :3], _bytes(table[:, 3:6]) if table.shape[1] > 4 else None


def _bytes(colour: _Floats) -> NDArray[np.uint8]:
    """SRGB bytes of colours 0…1 or 0…255."""
    return np.clip(np.rint(colour * (255.0 if colour.max(initial=0.0) <= 1.0 else 1.0)), 0, 255).astype(np.uint8)


def _map_corners(lines: list[str], path: Path) -> _Floats:
    """Map coordinates, (M, 2); a missing v is 0."""
    table = _table(lines)
    if table is None:
        table = _table([" ".join((line.split() + ["0"])[:2]) for line in lines])
    if table is None or not 1 <= table.shape[1] <= 3:
        raise ThermorenderError(f"{path} cannot be read as a mesh (map coordinates without u and v); export it again")
    return table[:, :2] if table.shape[1] > 1 else np.pad(table, ((0, 0), (0, 1)))


def _table(lines: list[str]) -> _Floats | None:
    """The numbers of lines, (N, columns); None where lines have different numbers of them."""
    if not lines:
        return np.zeros((0, 3))
    parts, columns = [], len(lines[0].partition("#")[0].split())
    for start in range(0, len(lines), _CHUNK):
        rows = [line.partition("#")[0].split() for line in lines[start : start + _CHUNK]]
        if any(len(row) != columns for row in rows):
            return None
        parts.append(np.array(list(map(float, chain.from_iterable(rows)))).reshape(-1, columns))
    return np.concatenate(parts)


def _faces(content: _Content, path: Path, vertices: int, map_corners: int) -> tuple[_Ints, _Ints, _Ints]:
    """(number of corners (P,), vertex (C,), map coordinates (C,)) of the polygons; `_NO_INDEX` without the latter."""
    lengths, numbers = [np.empty(0, np.int64)], [np.empty((0, 2), np.int64)]
    for start in range(0, len(content.faces), _CHUNK):
        rows = [line.split() for line in content.faces[start : start + _CHUNK]]
        lengths.append(np.array([len(row) for row in rows], np.int64))
        numbers.append(_numbers(list(chain.from_iterable(rows))))
    length, number = np.concatenate(lengths), np.concatenate(numbers)
    if (number == 0).any():
        raise ThermorenderError(
            f"{path} has a face with a corner of number 0; numbers begin with 1, so export the mesh again"
        )
    # Numbers count from 1, or backwards from the last one so far.
    so_far = np.tile(np.array([vertices, map_corners], np.int64), (len(length), 1))
    for face, counts in content.so_far.items():
        so_far[face] = counts
    given = number != _NO_INDEX
    index = np.where(number > 0, number - 1, np.where(given, number + np.repeat(so_far, length, axis=0), number))
    if (given & (index < 0)).any() or (index[:, 1] >= map_corners).any():
        raise ThermorenderError(
            f"{path} cannot be read as a mesh (a face names a vertex or map coordinates that it does not have); export "
            "the mesh again"
        )
    return length, index[:, 0], index[:, 1]


def _numbers(corners: list[str]) -> _Ints:
    """(vertex, map coordinates) of corners such as 1, 1/2, 1/2/3 and 1//3, (C, 2)."""
    slashes = corners[0].count("/") if corners else 0
    if not any("//" in corner or corner[-1] == "/" or corner.count("/") != slashes for corner in corners):
        values = np.array(list(map(int, " ".join(corners).replace("/", " ").split())), np.int64)
        table = values.reshape(-1, slashes + 1)[:, :2]
        return table if slashes else np.pad(table, ((0, 0), (0, 1)), constant_values=_NO_INDEX)
    split = [corner.split("/") for corner in corners]
    return np.array([(int(a[0]), int(a[1]) if len(a) > 1 and a[1] else _NO_INDEX) for a in split], np.int64)


@dataclass(frozen=True, eq=False)
class _Used:
    names: tuple[str | None, ...]
    number: _Ints


def _used(uses: list[tuple[int, str]], faces: int) -> _Used:
    """The names of materials, objects or groups, None for faces before the first, and each face's number among them."""
    names: dict[str | None, int] = {None: 0}
    numbers = [0, *(names.setdefault(name, len(names)) for _, name in uses)]
    number = np.repeat(numbers, np.diff([0, *(start for start, _ in uses), faces]))
    return _Used(tuple(names), number)


class _Library:
    """The materials of an OBJ file."""

    def __init__(self, path: Path, beside: Beside, names: Iterable[str]) -> None:
        self.path, self.beside, self.names = path, beside, list(names)
        self.materials: dict[str, dict[str, str]] = {}
        for name in self.names:
            whole = beside.find(name).is_file() if len(name) < 256 else False
            # A line may name several files; a blank may as well belong to a name.
            for one in (name,) if whole or not name else name.split():
                self._add(beside.get(one).decode("utf-8-sig", errors="surrogateescape"))

    def _add(self, text: str) -> None:
        found: dict[str, dict[str, str]] = {}
        current: dict[str, str] = {}
        for line in text.replace("\\\n", " ").splitlines():
            key, _, rest = line.strip().replace("\t", " ").partition(" ")
            if key.lower() == "newmtl":
                current = {}
                if found.setdefault(rest.strip(), current) is not current:
                    raise ThermorenderError(f"{self.path}: its library has two materials {rest.strip()!r}; rename one")
            elif not key.startswith("#"):
                current[key.lower()] = rest.strip()
        for name, material in found.items():
            if self.materials.setdefault(name, material) != material:
                raise ThermorenderError(f"{self.path}: its libraries have two materials {name!r}; rename one")

    def coat(self, name: str | None) -> Coat:
        """Return the Coat of a material by its name; None takes the only one there is."""
        if name is None:
            if len(self.materials) > 1:
                raise ThermorenderError(
                    f"{self.path} has faces before any usemtl, and its library has {len(self.materials)} materials; "
                    "add a line such as 'usemtl NAME' before its first face"
                )
            name = next(iter(self.materials), None)
            if name is None:
                return Coat()
        if name not in self.materials:
            known = ", ".join(map(repr, self.materials)) or "no material"
            where = f"its library {', '.join(self.names)} has {known}" if self.names else "it has no mtllib line"
            raise ThermorenderError(
                f"{self.path} uses the material {shortened(repr(name))}, but {shortened(where)}; correct the name, or "
                "export the mesh again with its materials"
            )
        return self._coat(name, self.materials[name])

    def _coat(self, name: str, material: dict[str, str]) -> Coat:
        if "map_d" in material:
            raise ThermorenderError(
                f"{self.path}: material {shortened(repr(name))} has holes by its map_d, which is not supported; cut "
                "them into the mesh, or delete that line where the surface has none"
            )
        if "map_kd" in material:
            file, repeats = self._texture(name, material["map_kd"])
            what, image = f"texture {shortened(repr(file))}", self.beside.get(file)
            return Coat(what, image=image, repeats=repeats, file=PureWindowsPath(file).name)
        if "kd" not in material:
            return Coat()
        try:
            light = [float(word) for word in material["kd"].split()]
            shade = np.array(light if len(light) == 3 else 3 * light, dtype=np.float64).reshape(3)
        except ValueError:
            raise ThermorenderError(
                f"{self.path}: material {shortened(repr(name))} has Kd {shortened(material['kd'])}; give red, "
                "green and blue 0…1"
            ) from None
        return Coat(colour=_bytes(np.clip(shade, 0.0, 1.0)))

    def _texture(self, name: str, text: str) -> tuple[str, bool]:
        """(file, whether it repeats) of a texture, after its options."""
        repeats, rest = True, text
        while match := _OPTION.match(rest):
            option, *values = " ".join(filter(None, match.groups())).split()
            rest = rest[match.end() :]
            if option == "clamp":
                repeats = values != ["on"]
            elif option in _NEUTRAL:
                neutral = (*_NEUTRAL[option], *(len(values) * _NEUTRAL[option])) if option != "mm" else _NEUTRAL["mm"]
                if tuple(map(float, values)) != neutral[: len(values)]:
                    self._refuse_option(name, option, values)
            elif option not in _HARMLESS and values != ["off"]:
                self._refuse_option(name, option, values)
        if not rest:
            raise ThermorenderError(
                f"{self.path}: material {shortened(repr(name))} has map_Kd without a file; name one"
            )
        return rest, repeats

    def _refuse_option(self, name: str, option: str, values: list[str]) -> None:
        raise ThermorenderError(
            f"{self.path}: the texture of material {shortened(repr(name))} has the option "
            f"{shortened(' '.join(['-' + option, *values]))}, which is not supported; bake it into the image and map "
            "coordinates"
        )
