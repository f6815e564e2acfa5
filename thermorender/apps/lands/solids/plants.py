"""Plants: crowns and hedges as tables of turbid ellipsoids and boxes, and trunks as a mesh.

What is known of a plant is columns of leaves, from a lower to an upper end, on a grid. Each plant becomes a few bodies
in the volume of these columns: lobes of a crown, with gaps between, or lengths of a hedge. The leaf area is kept.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

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
# Points that stand for a crown's volume.
_POINTS, _GOLDEN = 1024, 0.6180339887498949
# Longest part of a hedge [m].
_HEDGE_M = 3.0
# Thinner bodies are widened to this [m].
_LEAST_M = 0.1
# Radius of a trunk at its upper end as a share of that at the foot.
_TAPER = 0.35
# Length of the parts of a trunk, which have a temperature and light each [m].
_LENGTH_M = 2.5
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
    rows: list[Floats] = field(default_factory=list)  # (n, len(_COLUMNS)) each
    kelvin: NDArray[Any] | None = None  # (n, 8) columns of KELVIN

    @property
    def name(self) -> str:
        """The object's name."""
        return f"{self.material}_{'hedges' if self.shape == 'box' else 'crowns'}"


class Plants:
    """Crowns, hedges and trunks under construction. Positions are in metres, in one frame for all."""

    def __init__(self, most_lobes: int = _LOBES) -> None:
        self._most = min(most_lobes, _LOBES)
        self.bodies: dict[tuple[str, str], Bodies] = {}
        self._parts: list[tuple[Floats, NDArray[np.int64], NDArray[np.float32], NDArray[np.uint8]]] = []
        self.trunks = 0  # Faces of trunks

    def __len__(self) -> int:
        return sum(len(rows) for bodies in self.bodies.values() for rows in bodies.rows)

    def crown(self, column: Floats, cell_m: float, density: float, colour: NDArray[np.floating], material: str) -> None:
        """Add a crown of columns (C, 4), east, north, lower and upper end [m], with linear colours (C, 3)."""
        column, colour = _filled(column, colour)
        if not len(column):
            return
        depth = column[:, 3] - column[:, 2]
        count = int(np.clip(round(float(depth.sum()) * cell_m**2 / _LOBE_M3), 1, self._most))
        # Points even in the volume, each of a column.
        upto = np.cumsum(depth)
        at = (np.arange(_POINTS) + 0.5) / _POINTS * upto[-1]
        own = np.minimum(np.searchsorted(upto, at), len(column) - 1)
        height = column[own, 2] + (np.arange(_POINTS) * _GOLDEN % 1.0) * depth[own]
        point = np.column_stack([column[own, :2], height])
        lobe = _nearest(point, _seeds(point, count))
        made = [_lobe(point[lobe == k], colour[own[lobe == k]]) for k in range(count) if (lobe == k).sum() > 1]
        self._add("sphere", material, made, column, cell_m, density)

    def hedge(self, column: Floats, cell_m: float, density: float, colour: NDArray[np.floating], material: str) -> None:
        """Add a hedge of boxes, with arguments as of `crown`."""
        column, colour = _filled(column, colour)
        if not len(column):
            return
        along = _axes(column[:, :2])[0]
        place = (column[:, :2] - column[:, :2].mean(axis=0)) @ along
        count = max(1, int(np.ceil((np.ptp(place) + cell_m) / _HEDGE_M)))
        own = np.minimum(((place - place.min()) / (np.ptp(place) + 1e-9) * count).astype(int), count - 1)
        parts = [(column[own == k], colour[own == k]) for k in range(count)]
        made = [_box(part, each, cell_m, along) for part, each in parts if len(part)]
        self._add("box", material, made, column, cell_m, density)

    def _add(
        self, shape: str, material: str, made: list[tuple[Floats, float]], column: Floats, cell_m: float, density: float
    ) -> None:
        """Add bodies (row, volume) whose leaves are those of the columns."""
        area = density * float((column[:, 3] - column[:, 2]).sum()) * cell_m**2
        own = float(np.clip(area / sum(volume for _, volume in made), *DENSITIES))
        rows = np.array([row for row, _ in made])
        rows[:, _COLUMNS.index("leaf_area_1_m")] = own
        self.bodies.setdefault((shape, material), Bodies(shape, material)).rows.append(rows)

    def trunk(self, east: float, north: float, low_m: float, high_m: float, radius_m: float,
              colour: NDArray[np.floating], material: int) -> None:  # fmt: skip
        """Add a trunk of six sides, in lengths: light through gaps of the crown falls on parts of it."""
        angle = np.arange(6) * np.pi / 3.0
        ring = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
        count = max(1, round((high_m - low_m) / _LENGTH_M))
        vertices = np.concatenate([
            np.column_stack([[east, north] + (1.0 - (1.0 - _TAPER) * part) * ring,
                             np.full(6, low_m + part * (high_m - low_m))])
            for part in np.linspace(0.0, 1.0, count + 1)
        ])  # fmt: skip
        here, after = np.arange(6), (np.arange(6) + 1) % 6
        sides = np.concatenate([
            np.stack([here, after, after + 6], axis=-1), np.stack([here, after + 6, here + 6], axis=-1)
        ])  # fmt: skip
        faces = (sides + 6 * np.arange(count)[:, None, None]).reshape(-1, 3)
        tone = np.broadcast_to(colour, (len(faces), 3)).astype(np.float32)
        self._parts.append((vertices, faces, tone, np.full(len(faces), material, np.uint8)))
        self.trunks += len(faces)

    def mesh(self, name: str) -> TexturedMesh:
        """Return all trunks as one TexturedMesh, with a texel for each face."""
        first = np.cumsum([0, *(len(part[0]) for part in self._parts)])
        faces = np.concatenate([part[1] + start for part, start in zip(self._parts, first, strict=False)])
        uv, (rows, columns) = one_texel_each(len(faces))
        colour, classes = np.zeros((rows * columns, 3), np.float32), np.zeros(rows * columns, np.uint8)
        colour[: len(faces)] = np.concatenate([part[2] for part in self._parts])
        classes[: len(faces)] = np.concatenate([part[3] for part in self._parts])
        classes[len(faces) :] = classes[len(faces) - 1]
        return TexturedMesh(
            name, np.concatenate([part[0] for part in self._parts]), faces, uv,
            bytes_from_linear(colour).reshape(rows, columns, 3), classes.reshape(rows, columns),
        )  # fmt: skip


def write_bodies(
    folder: Path, every: "dict[tuple[str, str], Bodies]", down_m: float = 0.0, temperature: str | float = "balance",
    inferred: bool | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Write tables of bodies into a scene's folder; return the [[object]] tables of scene.toml. `down_m` is taken from
    their heights; `temperature` is of those without temperatures of their own; `inferred` is a key of the tables."""
    if not every:
        return []
    (folder / _FOLDER).mkdir(exist_ok=True)
    tables = []
    for bodies in every.values():
        rows = np.concatenate(bodies.rows)
        rows = rows - down_m * (np.array(_COLUMNS) == "up_m")
        file, warm = f"{_FOLDER}/{bodies.name}.csv", temperature
        write_text(folder / file, _csv(_COLUMNS, rows, "%.2f,%.2f,%.2f,%.2f,%.2f,%.2f,%.0f,%.3f,%.0f,%.0f,%.0f"))
        if bodies.kelvin is not None:
            warm = f"{_FOLDER}/{bodies.name}_kelvin.csv"
            write_text(folder / warm, _csv(KELVIN, bodies.kelvin, ",".join(["%.2f"] * len(KELVIN))))
        tables.append({
            "name": bodies.name, "shape": bodies.shape, "instances": file, "position": [0.0, 0.0, 0.0],
            "leaf_area_1_m": DENSITY, "temperature": warm, "material": bodies.material, "inferred": inferred,
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
        seeds = np.array([place[own == k].mean(axis=0) if (own == k).any() else seeds[k] for k in range(count)])
    return seeds


def _nearest(place: Floats, seeds: Floats) -> NDArray[np.intp]:
    found: NDArray[np.intp] = ((place[:, None] - seeds) ** 2).sum(axis=2).argmin(axis=1)
    return found


def _axes(place: Floats) -> Floats:
    """Unit vectors along which places (n, 2) are widest and narrowest, as rows."""
    off = place - place.mean(axis=0)
    found: Floats = np.linalg.eigh(off.T @ off)[1].T[::-1]
    return found


def _lobe(point: Floats, colour: NDArray[np.floating]) -> tuple[Floats, float]:
    """(row of a table without its density, volume [m³]) of the ellipsoid with the extents of points (n, 3)."""
    axis, middle = _axes(point[:, :2])[0], point.mean(axis=0)
    across = np.array([axis[1], -axis[0]])
    off = point - middle
    # The variance along an axis of an ellipsoid is a fifth of the square of its half-axis.
    spread = [np.std(off[:, :2] @ across), np.std(off[:, :2] @ axis), np.std(off[:, 2])]
    width, length, height = (max(2.0 * np.sqrt(5.0) * _WIDER * float(each), _LEAST_M) for each in spread)
    row = _row((middle[0], middle[1], middle[2] - 0.5 * height), (width, length, height), axis, colour)
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
    """A row of a table, without its density; `axis` (2,) is the direction of the length in the plan."""
    yaw = float(np.degrees(np.arctan2(axis[0], axis[1]))) % 360.0
    rgb = bytes_from_linear(colour.mean(axis=0, keepdims=True).astype(np.float32))[0]
    return np.array([*base, *size, yaw, 0.0, *rgb])
