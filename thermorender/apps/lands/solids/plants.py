"""Plants: crowns and hedges as tables of turbid ellipsoids and boxes, and trunks as a mesh.

What is known of a plant is columns of leaves, from a lower to an upper end, on a grid. Each plant becomes a few bodies
in the volume of these columns: lobes of a crown, with gaps between, or lengths of a hedge. The leaf area is kept.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.solids.textured_mesh import TexturedMesh
from thermorender.formats import write_text
from thermorender.materials.library import load_library
from thermorender.materials.thermal import table_text
from thermorender.physics.srgb import bytes_from_linear
from thermorender.scene.crowns import DENSITIES, KELVIN
from thermorender.scene.meshes.mesh import one_texel_each

Floats = NDArray[np.float64]

# One side of leaves per volume of a crown [m²/m³], chosen: street and garden trees have 0.5 to 2, narrow conifers and
# clipped hedges more.
DENSITY, DENSITY_CONIFER, DENSITY_HEDGE = 1.2, 2.5, 4.0
# Volume of a lobe [m³], most lobes of a crown, and the width of a lobe relative to its part: there are gaps between.
_LOBE_M3, _LOBES, _WIDER = 5.0, 16, 0.82
# Most lobes of all crowns together, but for one of each: those of a forest are larger.
_MOST_LOBES = 20_000
# Points that stand for the volume of a lobe, and growth of lobes from one trial of their size to the next.
_POINTS, _GOLDEN, _GROWTH = 64, 0.6180339887498949, 1.1
# Longest part of a hedge [m].
_HEDGE_M = 3.0
# Thinner bodies are widened to this [m].
_LEAST_M = 0.1
# Radius of a trunk at its upper end as a share of that at the foot.
_TAPER = 0.35
# Sides of a trunk and length of their parts [m], which have a temperature and light each; sides where that would make
# more parts of all trunks than `_MOST_PARTS`.
_SIDES, _LENGTH_M, _LEAST_SIDES, _MOST_PARTS = 6, 2.5, 4, 32_000
# Materials of leaves, and why their tables differ from those of a closed canopy.
LEAVES = ("broadleaf", "conifer")
_CHOSEN = "chosen: leaves of a crown hang in the air"
_FOLDER = "plants"
_COLUMNS = (
    "east_m", "north_m", "up_m", "width_m", "length_m", "height_m", "yaw_deg", "leaf_area_1_m", "red", "green", "blue"
)  # fmt: skip


def write_leaf_tables(folder: Path) -> None:
    """Write thermal tables of leaves that hang in the air into the materials of a scene's folder.

    The tables of a closed canopy have litter below.
    """
    (folder / "materials" / "thermal").mkdir(parents=True)
    library = load_library()
    for name in LEAVES:
        table = library[name].known_thermal()
        hanging = replace(table, beneath="outside", below=None, source=table.source | {"beneath": _CHOSEN})
        write_text(folder / "materials" / "thermal" / f"{name}.csv", table_text(hanging))


@dataclass
class Bodies:
    """Turbid bodies of a shape and material."""

    shape: str  # Of an object in a scene file
    material: str
    rows: Floats  # (n, len(_COLUMNS))
    kelvin: NDArray[Any] | None = None  # (n, 8) columns of KELVIN

    @property
    def name(self) -> str:
        """The object's name."""
        return f"{self.material}_{'hedges' if self.shape == 'box' else 'crowns'}"


class _Crown(NamedTuple):
    column: Floats  # (C, 4) east, north, lower and upper end [m]
    cell_m: float
    density: float
    colour: NDArray[np.floating]  # (C, 3) linear
    material: str


class _Trunk(NamedTuple):
    east: float
    north: float
    low_m: float
    high_m: float
    radius_m: float


class Plants:
    """Crowns, hedges and trunks under construction. Positions are in metres, in one frame for all."""

    def __init__(self) -> None:
        self._crowns: list[_Crown] = []
        self._hedges: list[_Crown] = []
        self.trunks: list[_Trunk] = []
        self._bark: list[tuple[NDArray[np.floating], int]] = []

    def crown(self, column: Floats, cell_m: float, density: float, colour: NDArray[np.floating], material: str) -> None:
        """Add a crown of columns (C, 4), east, north, lower and upper end [m], with linear colours (C, 3)."""
        _add(self._crowns, column, cell_m, density, colour, material)

    def hedge(self, column: Floats, cell_m: float, density: float, colour: NDArray[np.floating], material: str) -> None:
        """Add a hedge of boxes, with arguments as of `crown`."""
        _add(self._hedges, column, cell_m, density, colour, material)

    @cached_property
    def bodies(self) -> dict[tuple[str, str], Bodies]:
        """Bodies of all crowns and hedges, by shape and material; what is added afterwards is not in them."""
        made: dict[tuple[str, str], list[Floats]] = {}
        lobes = self._lobes()
        parts = [("box", one, _boxes(one)) for one in self._hedges]
        parts += [("sphere", one, _ellipsoids(one, count)) for one, count in zip(self._crowns, lobes, strict=True)]
        for shape, one, found in parts:
            # The leaves of the bodies are those of the columns.
            own = float(np.clip(one.density * _volume(one) / sum(volume for _, volume in found), *DENSITIES))
            rows = np.array([row for row, _ in found])
            rows[:, _COLUMNS.index("leaf_area_1_m")] = own
            made.setdefault((shape, one.material), []).append(rows)
        bodies = {}
        for kind, several in made.items():
            rows = np.concatenate(several)
            rows[:, -3:] = bytes_from_linear(rows[:, -3:].astype(np.float32))
            bodies[kind] = Bodies(*kind, rows)
        return bodies

    def _lobes(self) -> list[int]:
        """Number of lobes of each crown."""
        volume = np.array([_volume(one) for one in self._crowns])
        lobe = _LOBE_M3
        while (count := np.clip(np.rint(volume / lobe), 1, _LOBES)).sum() > max(_MOST_LOBES, len(volume)):
            lobe *= _GROWTH
        found: list[int] = count.astype(int).tolist()
        return found

    def trunk(self, east: float, north: float, low_m: float, high_m: float, radius_m: float,
              colour: NDArray[np.floating], material: int) -> None:  # fmt: skip
        """Add a trunk, which is cut into lengths: light through gaps of the crown falls on parts of it."""
        self.trunks.append(_Trunk(east, north, low_m, high_m, radius_m))
        self._bark.append((colour, material))

    def mesh(self, name: str) -> TexturedMesh:
        """Return all trunks as one TexturedMesh, with a texel for each side of each length."""
        trunk = np.array(self.trunks)
        most = _MOST_PARTS // len(trunk)
        length = np.clip(np.rint((trunk[:, 3] - trunk[:, 2]) / _LENGTH_M), 1, None).astype(int)
        sides = _SIDES if _SIDES * length.mean() <= most else _LEAST_SIDES
        length = np.minimum(length, max(1, most // sides))
        made, order, count = [], [], 0
        for lengths in np.unique(length):
            own = np.flatnonzero(length == lengths)
            vertices, faces = _trunks(trunk[own], sides, lengths)
            made.append((vertices, faces + count))
            order.append(np.repeat(own, sides * lengths))
            count += len(vertices)
        of = np.concatenate(order)
        uv, (rows, columns) = one_texel_each(len(of))
        # Texels without a part are as the last one.
        of = np.append(of, np.full(rows * columns - len(of), of[-1]))
        tone = np.array([np.broadcast_to(colour, 3) for colour, _ in self._bark], np.float32)[of]
        classes = np.array([number for _, number in self._bark], np.uint8)[of]
        return TexturedMesh(
            name, np.concatenate([part[0] for part in made]), np.concatenate([part[1] for part in made]),
            np.repeat(uv, 2, axis=0), bytes_from_linear(tone).reshape(rows, columns, 3), classes.reshape(rows, columns),
        )  # fmt: skip


def _add(
    plants: list[_Crown], column: Floats, cell_m: float, density: float, colour: NDArray[np.floating], material: str
) -> None:
    """Add columns with leaves to a list of crowns or hedges."""
    column, colour = _filled(column, colour)
    if len(column):
        plants.append(_Crown(column, cell_m, density, colour, material))


def _volume(one: _Crown) -> float:
    return float((one.column[:, 3] - one.column[:, 2]).sum()) * one.cell_m**2


def _ellipsoids(one: _Crown, count: int) -> list[tuple[Floats, float]]:
    """(row, volume) of the lobes of a crown."""
    column, depth = one.column, one.column[:, 3] - one.column[:, 2]
    # Points even in the volume, each of a column.
    upto, points = np.cumsum(depth), _POINTS * count
    at = (np.arange(points) + 0.5) / points * upto[-1]
    own = np.minimum(np.searchsorted(upto, at), len(column) - 1)
    height = column[own, 2] + (np.arange(points) * _GOLDEN % 1.0) * depth[own]
    point = np.column_stack([column[own, :2], height])
    if count == 1:
        return [_lobe(point, one.colour[own])]
    lobe = _nearest(point, _seeds(point, count))
    return [_lobe(point[lobe == k], one.colour[own[lobe == k]]) for k in range(count) if (lobe == k).sum() > 1]


def _boxes(one: _Crown) -> list[tuple[Floats, float]]:
    """(row, volume) of the boxes of a hedge."""
    column = one.column
    along = _axes(column[:, :2])[0]
    place = (column[:, :2] - column[:, :2].mean(axis=0)) @ along
    count = max(1, int(np.ceil((np.ptp(place) + one.cell_m) / _HEDGE_M)))
    own = np.minimum(((place - place.min()) / (np.ptp(place) + 1e-9) * count).astype(int), count - 1)
    parts = [(column[own == k], one.colour[own == k]) for k in range(count)]
    return [_box(part, each, one.cell_m, along) for part, each in parts if len(part)]


def _trunks(trunk: Floats, sides: int, lengths: int) -> tuple[Floats, NDArray[np.int64]]:
    """(vertices (V, 3), faces (F, 3)) of trunks (n, 5) of some sides and lengths; a part has two faces."""
    east, north, low, high, radius = trunk.T
    angle, part = 2.0 * np.pi * np.arange(sides) / sides, np.linspace(0.0, 1.0, lengths + 1)
    wide = radius[:, None] * (1.0 - (1.0 - _TAPER) * part)
    up = low[:, None] + part * (high - low)[:, None]
    x, y = (wide[..., None] * turn + centre[:, None, None]
            for turn, centre in ((np.cos(angle), east), (np.sin(angle), north)))  # fmt: skip
    vertices = np.stack([x, y, np.broadcast_to(up[..., None], x.shape)], axis=-1).reshape(-1, 3)
    here = np.arange(sides) + sides * np.arange(lengths)[:, None]
    after = np.roll(here, -1, axis=1)
    faces = np.stack([here, after, after + sides, here, after + sides, here + sides], axis=-1).reshape(-1, 3)
    first = sides * (lengths + 1) * np.arange(len(trunk))
    return vertices, (faces + first[:, None, None]).reshape(-1, 3)


def write_bodies(
    folder: Path, every: "dict[tuple[str, str], Bodies]", down_m: float = 0.0, temperature: str | float = "balance",
    inferred: bool = False,
) -> list[dict[str, Any]]:  # fmt: skip
    """Write tables of bodies into a scene's folder; return the [[object]] tables of scene.toml. `down_m` is taken from
    their heights; `temperature` is of those without temperatures of their own; `inferred` is a key of the tables."""
    if not every:
        return []
    (folder / _FOLDER).mkdir(exist_ok=True)
    tables = []
    for bodies in every.values():
        rows = bodies.rows - down_m * (np.array(_COLUMNS) == "up_m")
        file, warm = f"{_FOLDER}/{bodies.name}.csv.gz", temperature
        write_text(folder / file, _csv(_COLUMNS, rows, "%.2f,%.2f,%.2f,%.2f,%.2f,%.2f,%.0f,%.3f,%.0f,%.0f,%.0f"))
        if bodies.kelvin is not None:
            warm = f"{_FOLDER}/{bodies.name}_kelvin.csv.gz"
            write_text(folder / warm, _csv(KELVIN, bodies.kelvin, ",".join(["%.2f"] * len(KELVIN))))
        flags = {"inferred": inferred, "follows_balance": warm != "balance"}
        tables.append({
            "name": bodies.name, "shape": bodies.shape, "instances": file, "position": [0.0, 0.0, 0.0],
            "leaf_area_1_m": DENSITY, "temperature": warm, "material": bodies.material,
            **dict.fromkeys([name for name, true in flags.items() if true], True),
        })  # fmt: skip
    return tables


def _csv(names: tuple[str, ...], rows: NDArray[Any], form: str) -> str:
    return ",".join(names) + "\n" + "".join(form % tuple(row) + "\n" for row in rows.tolist())


def _filled(column: Floats, colour: NDArray[np.floating]) -> tuple[Floats, NDArray[np.floating]]:
    """Columns with leaves, and their colours."""
    some = column[:, 3] > column[:, 2]
    return column[some].astype(np.float64), np.broadcast_to(colour, (len(column), 3))[some]


def _seeds(place: Floats, count: int) -> Floats:
    """Points far from each other among places (n, 2), moved to the middles of what is nearest to them."""
    chosen = [int(((place - place.mean(axis=0)) ** 2).sum(axis=1).argmax())]
    away = np.full(len(place), np.inf)
    for _ in range(count - 1):
        away = np.minimum(away, ((place - place[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(away.argmax()))
    seeds = place[chosen]
    for _ in range(4):
        own = _nearest(place, seeds)
        some = np.bincount(own, minlength=count)[:, None]
        total = np.column_stack([np.bincount(own, axis, count) for axis in place.T])
        seeds = np.where(some > 0, total / np.maximum(some, 1), seeds)
    return seeds


def _nearest(place: Floats, seeds: Floats) -> NDArray[np.intp]:
    place, seeds = place - place[0], seeds - place[0]
    found: NDArray[np.intp] = ((seeds**2).sum(axis=1) - 2.0 * place @ seeds.T).argmin(axis=1)
    return found


def _axes(place: Floats) -> Floats:
    """Unit vectors along which places (n, 2) are widest and narrowest, as rows."""
    off = place - place.mean(axis=0)
    found: Floats = np.linalg.eigh(off.T @ off)[1].T[::-1]
    return found


def _lobe(point: Floats, colour: NDArray[np.floating]) -> tuple[Floats, float]:
    """(row of a table without its density, volume [m³]) of the ellipsoid with the extents of points (n, 3)."""
    middle = point.mean(axis=0)
    off = point - middle
    square = off.T @ off / len(point)
    variance, axes = np.linalg.eigh(square[:2, :2])
    # The variance along an axis of an ellipsoid is a fifth of the square of its half-axis.
    spread = np.sqrt(np.maximum([*variance, square[2, 2]], 0.0))
    width, length, height = np.maximum(2.0 * np.sqrt(5.0) * _WIDER * spread, _LEAST_M).tolist()
    row = _row((middle[0], middle[1], middle[2] - 0.5 * height), (width, length, height), axes[:, 1], colour)
    return row, np.pi / 6.0 * width * length * height


def _box(
    column: Floats, colour: NDArray[np.floating], cell_m: float, along: Floats
) -> tuple[Floats, float]:  # fmt: skip
    """(row of a table without its density, volume [m³]) of the box around columns, with their plan area."""
    across = np.array([along[1], -along[0]])
    middle = column[:, :2].mean(axis=0)
    length, width = (float(np.ptp((column[:, :2] - middle) @ way)) + cell_m for way in (along, across))
    scale = np.sqrt(len(column) * cell_m**2 / (length * width))
    length, width = (max(scale * each, _LEAST_M) for each in (length, width))
    low, high = float(column[:, 2].mean()), float(np.quantile(column[:, 3], 0.9))
    height = max(high - low, _LEAST_M)
    return _row((middle[0], middle[1], low), (width, length, height), along, colour), width * length * height


def _row(
    base: tuple[float, float, float], size: tuple[float, float, float], axis: Floats, colour: NDArray[np.floating]
) -> Floats:
    """A row of a table, without its density and of linear colour; `axis` (2,) is the direction of the length in the
    plan."""
    yaw = float(np.degrees(np.arctan2(axis[0], axis[1]))) % 360.0
    return np.array([*base, *size, yaw, 0.0, *colour.mean(axis=0)])
