"""Porous crowns: clusters of leaves in the volume of a crown, through which ground and sky show.

A cluster is a small flat tetrahedron, turned at random. Its mean silhouette over all directions is a quarter of its
surface (Cauchy's theorem for convex bodies), so that clusters of density D [m² of one side per m³] at random places let
the share exp(−D s / 2) of the rays of a path s [m] through: Beer's law with G = 1/2, the leaf projection function of
Ross (1981) for leaves of all orientations.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.solids.textured_mesh import TexturedMesh
from thermorender.formats import write_text
from thermorender.materials.library import load_library
from thermorender.materials.thermal import table_text
from thermorender.physics.srgb import bytes_from_linear
from thermorender.scene.meshes.mesh import one_texel_each

# One side of leaves per volume of a crown [m²/m³], chosen: street and garden trees have 0.5 to 2, narrow conifers and
# clipped hedges more.
DENSITY, DENSITY_CONIFER, DENSITY_HEDGE = 1.2, 2.5, 4.0
# Radius of a trunk at its upper end as a share of that at the foot.
_TAPER = 0.35
# Length of the parts of a trunk, which have a temperature and light each [m].
_LENGTH_M = 0.7
# Materials of leaves, and why their tables differ from those of a closed canopy.
LEAVES = ("broadleaf", "conifer")
_CHOSEN = "chosen: leaves of a crown hang in the air"
# Edge of a cluster [m]: this share of the radius of a crown, within limits.
_EDGE_SHARE, _EDGES = 0.2, (0.28, 0.9)
# Height of a cluster's tetrahedron as a share of a regular one's.
_FLAT = 0.1
_CORNERS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) / np.sqrt(8.0)
# Counter-clockwise from outside.
_FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def gap(depth_m: Any, density: float = DENSITY) -> Any:
    """Return the share of rays that a path of `depth_m` [m] through a crown lets through, by Beer's law."""
    return np.exp(-0.5 * density * np.asarray(depth_m))


def edge_of(radius_m: float) -> float:
    """Return the edge of a cluster in a crown of a radius [m]."""
    return float(np.clip(_EDGE_SHARE * radius_m, *_EDGES))


def leaves(
    generator: np.random.Generator, middle: NDArray[np.float64], edge_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return (vertices (4 K, 3), faces (4 K, 3)) of clusters around their middles (K, 3) [m]."""
    axes, _ = np.linalg.qr(generator.standard_normal((len(middle), 3, 3)))
    # A rotation, so that outside stays outside.
    axes[np.linalg.det(axes) < 0.0, 0] *= -1.0
    corner = middle[:, None] + edge_m * _flat() @ axes
    faces = _FACES + 4 * np.arange(len(middle))[:, None, None]
    return corner.reshape(-1, 3), faces.reshape(-1, 3)


def _flat() -> NDArray[np.float64]:
    """A tetrahedron of edge 1, flattened along the axis through its first corner."""
    axis = _CORNERS[0] / np.linalg.norm(_CORNERS[0])
    flat: NDArray[np.float64] = _CORNERS - (1.0 - _FLAT) * np.outer(_CORNERS @ axis, axis)
    return flat


def surface_m2(edge_m: float) -> float:
    """Return the surface of a cluster [m²]: twice one side of the leaves that it stands for."""
    corner = (edge_m * _flat())[_FACES]
    return float(0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum())


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


class Plants:
    """Crowns, hedges and trunks under construction: faces with a texel each."""

    def __init__(self) -> None:
        self._parts: list[tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float32], NDArray[np.uint8]]] = []
        self.faces = 0

    def fill(
        self, generator: np.random.Generator, column: NDArray[np.float64], cell_m: float, edge_m: float,
        density: float, colour: NDArray[np.floating], material: int,
    ) -> None:  # fmt: skip
        """Fill columns (C, 4), east, north, lower and upper end [m], with clusters of leaves of linear colours (C, 3).
        `density` is one side of leaves per volume [m²/m³].
        """
        depth = np.maximum(column[:, 3] - column[:, 2], 0.0)
        volume = float(depth.sum()) * cell_m**2
        count = round(2.0 * density * volume / surface_m2(edge_m))
        if not count:
            return
        chosen = generator.choice(len(column), count, p=depth / depth.sum())
        middle = np.column_stack([
            column[chosen, :2] + generator.uniform(-0.5 * cell_m, 0.5 * cell_m, (count, 2)),
            column[chosen, 2] + depth[chosen] * generator.uniform(size=count),
        ])  # fmt: skip
        vertices, faces = leaves(generator, middle, edge_m)
        tone = colour[chosen] * np.exp(0.12 * generator.standard_normal((count, 1)))
        self._add(vertices, faces, np.repeat(tone, len(_FACES), axis=0), material)

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
        self._add(vertices, faces, np.broadcast_to(colour, (len(faces), 3)), material)

    def _add(self, vertices: NDArray[np.float64], faces: NDArray[np.int64], colour: NDArray[np.floating],
             material: int) -> None:  # fmt: skip
        number = np.full(len(faces), material, np.uint8)
        self._parts.append((vertices, faces, np.asarray(colour, np.float32), number))
        self.faces += len(faces)

    def mesh(self, name: str) -> TexturedMesh:
        """Return all plants as one TexturedMesh."""
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
