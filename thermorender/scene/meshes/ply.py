"""PLY files, read into Pieces, one for each texture; trimesh would put the last of several textures on all faces."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.physics.srgb import linear_from_bytes
from thermorender.scene.meshes.mesh_pieces import GREY, Beside, Coat, Piece, of_faces, several, triangles

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
    "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_MAPS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("tex_u", "tex_v"))
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
# Elements that hold triangles or textures in ways that are not read here.
_REFUSED = ("tristrips", "multi_texture_vertex", "multi_texture_face", "material")
_Values = NDArray[np.float64]


@dataclass
class _List:
    """A list property: the lengths (N,) of its lists, and their values one after another."""

    lengths: NDArray[np.int64]
    values: _Values


@dataclass
class _Element:
    name: str
    count: int
    # (name, type of its values, type of a list's length or None)
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)


_Table = dict[str, "_Values | _List"]


def read(path: Path, beside: Beside) -> list[Piece]:
    """Return the Pieces of a PLY file: `comment TextureFile` names textures, the face property `texnumber` selects one.

    Map coordinates of faces (`texcoord`) take precedence over those of vertices and run up the image. A texture
    replaces vertex colours.
    """
    elements, textures, order, data = _header(path)
    tables = _Ascii(data, path).tables(elements) if order == "" else _Binary(data, order, path).tables(elements)
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    vertices = np.stack([_column(vertex, axis, path) for axis in "xyz"], axis=-1)
    polygons = next((face[name] for name in _CORNERS if name in face), None)
    if not isinstance(polygons, _List):
        if any(element.name == "face" and element.count for element in elements):
            raise ThermorenderError(f"{path} has faces without the list vertex_indices; export the mesh again")
        polygons = _List(np.empty(0, np.int64), np.empty(0))
    index = polygons.values.astype(np.int64)
    corner, polygon = triangles(polygons.lengths, index, vertices, path)
    faces = index[corner]
    number = _texture_numbers(face, len(polygons.lengths), textures, path)[polygon]
    uv = _map(vertex, face, polygons.lengths, faces, corner, polygon, path) if textures else None
    if not textures:
        colour, tint = _colour(tables, elements, faces, polygon, path)
        return [Piece(f"{path.stem}:mesh", vertices, faces, None, Coat(colour=colour), ("mesh",), tint).compact()]
    pieces = []
    for k, name in enumerate(textures):
        if (mine := number == k).any():
            coat = Coat(f"texture {shortened(repr(name))}", image=beside.get(name))
            own = None if uv is None else uv[mine]
            pieces.append(Piece(f"{path.stem}:{name}", vertices, faces[mine], own, coat, (name,)))
    return [piece.compact() for piece in pieces]


def _header(path: Path) -> tuple[list[_Element], list[str], str, bytes]:
    """(elements, names of textures, byte order or "" for text, data after the header)."""
    data = path.read_bytes()
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r)", data)
    if not data.startswith(b"ply") or end is None:
        raise _damaged(path, "it has no header of a PLY")
    lines = data[: end.start()].decode(errors="surrogateescape").splitlines()[1:]
    elements, textures, order = _statements(lines, path)
    refused = next((element.name for element in elements if element.name in _REFUSED and element.count), None)
    if refused is not None:
        raise ThermorenderError(
            f"{path} has the element {refused!r}, which is not supported; export it with vertices and faces only"
        )
    return elements, textures, order, data[end.end() :]


def _statements(lines: list[str], path: Path) -> tuple[list[_Element], list[str], str]:
    """(elements, names of textures, byte order or "" for text) of the lines of a header."""
    elements: list[_Element] = []
    textures, order = [], None
    for line in lines:
        key, _, rest = line.strip().partition(" ")
        words = rest.split()
        if key == "format" and words and words[0] in _ORDERS:
            order = _ORDERS[words[0]]
        elif key == "element" and len(words) == 2 and words[1].isdecimal():
            elements.append(_Element(words[0], int(words[1])))
        elif key == "property" and elements and (one := _property(words)):
            elements[-1].properties.append(one)
        elif key == "comment":
            if words and words[0].lower() == "texturefile":
                textures.append(rest.strip()[len(words[0]) :].strip())
        elif key not in ("obj_info", ""):
            raise _damaged(path, f"its header has the line {shortened(repr(line), 60)}")
    if order is None:
        raise _damaged(path, "its header does not name a format")
    return elements, textures, order


def _property(words: list[str]) -> tuple[str, str, str | None] | None:
    """(name, type of its values, type of a list's length or None) of a property line; None if it is not one."""
    if len(words) == 2 and words[0] in _TYPES:
        return words[1], _TYPES[words[0]], None
    if len(words) == 4 and words[0] == "list" and "float" not in words[1]:
        return words[3], _TYPES[words[2]], _TYPES[words[1]]
    return None


def _damaged(path: Path, reason: str) -> ThermorenderError:
    return ThermorenderError(f"{path} cannot be read as a mesh ({reason}); give an OBJ, GLB or PLY file")


class _Binary:
    """Binary data after a header."""

    def __init__(self, data: bytes, order: str, path: Path) -> None:
        self.data, self.order, self.path, self.at = data, order, path, 0

    def tables(self, elements: list[_Element]) -> dict[str, _Table]:
        """Return the values of each element."""
        found = {element.name: self._table(element) for element in elements}
        if self.data[self.at :].strip():
            raise _damaged(self.path, f"it has {len(self.data) - self.at} bytes more than its header states")
        return found

    def _table(self, element: _Element) -> _Table:
        # Most files have lists of one length: all rows are then like the first.
        lengths = self._lengths_of_row(element) if element.count else {}
        row = self._row(element, lengths)
        size = row.itemsize * element.count
        if self.at + size <= len(self.data):
            table = np.frombuffer(self.data, row, element.count, self.at)
            if all((table[f"#{k}"] == length).all() for k, length in lengths.items()):
                self.at += size
                return {
                    name: table[f"{k}"].astype(np.float64) if kind is None
                    else _List(np.full(element.count, lengths.get(k, 0)), table[f"{k}"].astype(np.float64).ravel())
                    for k, (name, _, kind) in enumerate(element.properties)
                }  # fmt: skip
        elif not lengths:
            raise _damaged(self.path, "it ends early")
        return self._row_by_row(element)

    def _row(self, element: _Element, lengths: dict[int, int]) -> np.dtype:
        fields: list[tuple[str, str] | tuple[str, str, int]] = []
        for k, (_, values, length) in enumerate(element.properties):
            if length is not None:
                fields.append((f"#{k}", self.order + length))
                fields.append((f"{k}", self.order + values, lengths.get(k, 0)))
            else:
                fields.append((f"{k}", self.order + values))
        return np.dtype(fields)

    def _lengths_of_row(self, element: _Element) -> dict[int, int]:
        lengths, at = {}, self.at
        for k, (_, values, length) in enumerate(element.properties):
            if length is not None:
                lengths[k] = self._length(at, length)
                at += np.dtype(length).itemsize + lengths[k] * np.dtype(values).itemsize
            else:
                at += np.dtype(values).itemsize
        return lengths

    def _length(self, at: int, kind: str) -> int:
        size = np.dtype(kind).itemsize
        if at + size > len(self.data):
            raise _damaged(self.path, "it ends early")
        length = int(np.frombuffer(self.data, self.order + kind, 1, at)[0])
        if not 0 <= length <= len(self.data):
            raise _damaged(self.path, f"it has a list of {length} values")
        return length

    def _row_by_row(self, element: _Element) -> _Table:
        plain: list[list[bytes]] = [[] for _ in element.properties]
        counts: list[list[int]] = [[] for _ in element.properties]
        sizes = [
            (np.dtype(values).itemsize, np.dtype(length).itemsize if length else 0)
            for _, values, length in element.properties
        ]
        whole: Literal["big", "little"] = "big" if self.order == ">" else "little"
        data, at = self.data, self.at
        for _ in range(element.count):
            for k, (size, length) in enumerate(sizes):
                count = 1
                if length:
                    count = int.from_bytes(data[at : at + length], whole)
                    at += length
                    counts[k].append(count)
                plain[k].append(data[at : at + count * size])
                at += count * size
            if at > len(data):
                raise _damaged(self.path, "it ends early")
        self.at = at
        found: _Table = {}
        for k, (name, values, kind) in enumerate(element.properties):
            column = np.frombuffer(b"".join(plain[k]), self.order + values).astype(np.float64)
            found[name] = column if kind is None else _List(np.array(counts[k], np.int64), column)
        return found


class _Ascii:
    """Text after a header: numbers in the order of rows and properties, wherever lines end."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.numbers, self.path, self.at = np.array(list(map(float, data.split()))), path, 0

    def tables(self, elements: list[_Element]) -> dict[str, _Table]:
        """Return the values of each element."""
        found = {element.name: self._table(element) for element in elements}
        if self.at < len(self.numbers):
            raise _damaged(self.path, f"it has {len(self.numbers) - self.at} numbers more than its header states")
        return found

    def _table(self, element: _Element) -> _Table:
        lists = [length is not None for _, _, length in element.properties]
        columns: list[tuple[list[int], list[_Values]]] = [([], []) for _ in lists]
        if not any(lists):
            width, count = len(lists), element.count
            table = self._take(width * count).reshape(count, width)
            return {name: table[:, k] for k, (name, _, _) in enumerate(element.properties)}
        for _ in range(element.count):
            for is_list, (counts, values) in zip(lists, columns, strict=True):
                if is_list:
                    count = self._take(1)[0]
                    if not (0 <= count <= len(self.numbers) and count == int(count)):
                        raise _damaged(self.path, f"its numbers do not fit its header, with a list of {count:g} values")
                    counts.append(int(count))
                values.append(self._take(counts[-1] if is_list else 1))
        found: _Table = {}
        for (name, _, length), (counts, values) in zip(element.properties, columns, strict=True):
            column = np.concatenate(values) if values else np.empty(0)
            found[name] = column if length is None else _List(np.array(counts, np.int64), column)
        return found

    def _take(self, count: int) -> _Values:
        self.at += count
        if self.at > len(self.numbers):
            raise _damaged(self.path, "it ends early")
        return self.numbers[self.at - count : self.at]


def _column(table: _Table, name: str, path: Path) -> _Values:
    values = table.get(name)
    if values is None or isinstance(values, _List):
        raise _damaged(path, f"its vertices have no property {name}")
    return values


def _columns(table: _Table, choices: tuple[tuple[str, ...], ...], path: Path) -> _Values | None:
    """The first set of columns that a table has, (N, columns); None without."""
    for names in choices:
        if all(name in table for name in names):
            return np.stack([_column(table, name, path) for name in names], axis=-1)
    return None


def _texture_numbers(face: _Table, faces: int, textures: list[str], path: Path) -> NDArray[np.int64]:
    """The number of each face's texture, (faces,)."""
    number = face.get("texnumber")
    if number is None:
        if len(set(textures)) > 1:
            raise ThermorenderError(
                f"{path} names the textures {shortened(', '.join(textures))}, but its faces have no texnumber that "
                "chooses one; export it with texnumber, or with one texture"
            )
        return np.zeros(faces, np.int64)
    assert not isinstance(number, _List)
    wrong = ~((number >= 0) & (number < len(textures)) & (number % 1.0 == 0.0))
    if textures and wrong.any():
        raise ThermorenderError(
            f"{path} has a face with texnumber {number[wrong][0]:g}, and "
            f"{len(textures)} textures (comment TextureFile), counted from 0; give every face one of them"
        )
    return number.astype(np.int64)


def _map(
    vertex: _Table, face: _Table, lengths: NDArray[np.int64], faces: NDArray[np.int64], corner: NDArray[np.int64],
    polygon: NDArray[np.int64], path: Path,
) -> _Values | None:  # fmt: skip
    """Map coordinates of the triangles, (T, 3, 2), v down; None where the file has none."""
    own = face.get("texcoord")
    if isinstance(own, _List):
        short = own.lengths[polygon] != 2 * lengths[polygon]
        if short.any():
            raise ThermorenderError(
                f"{path} has a face of {lengths[polygon[short][0]]} corners with {own.lengths[polygon[short][0]]} "
                "numbers in its texcoord; give two for each corner"
            )
        # From a corner's number among all corners to the place of its u.
        start, first = np.cumsum(own.lengths) - own.lengths, np.cumsum(lengths) - lengths
        at = start[polygon][:, None] + 2 * (corner - first[polygon][:, None])
        uv = np.stack([own.values[at], own.values[at + 1]], axis=-1)
    else:
        by_vertex = _columns(vertex, _MAPS, path)
        if by_vertex is None:
            return None
        uv = by_vertex[faces]
    return uv * [1.0, -1.0] + [0.0, 1.0]


def _colour(
    tables: dict[str, _Table], elements: list[_Element], faces: NDArray[np.int64], polygon: NDArray[np.int64],
    path: Path,
) -> tuple[NDArray[np.uint8], NDArray[np.float32] | None]:  # fmt: skip
    """Return ((3,) sRGB, None), or (white, light of each triangle); face colours, in sRGB, precede vertex colours."""
    kinds = {(element.name, name): kind for element in elements for name, kind, _ in element.properties}
    for element in ("face", "vertex"):
        for names in _COLOURS:
            colour = _columns(tables.get(element, {}), (names,), path)
            if colour is not None and len(colour):
                # Integers of one byte; real numbers are 0…1 or 0…255.
                kind = kinds[element, names[0]]
                scale = 255.0 if kind[0] == "f" and colour.max() <= 1.0 else 1.0
                if kind == "u2":
                    scale = 1.0 / 257.0
                srgb = np.clip(np.rint(colour * scale), 0, 255).astype(np.uint8)
                if not several(srgb):
                    return srgb[0], None
                linear = linear_from_bytes(srgb)
                white = np.full(3, 255, np.uint8)
                return white, linear[polygon].astype(np.float32) if element == "face" else of_faces(linear, faces)
    return GREY, None
