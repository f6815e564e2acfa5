"""TreeTypes of trees of a surface model: each tree is a copy of a typical one of about its size.

A wood of 10⁵ trees with leaves of their own has 10⁸ triangles. As copies it has those of a few typical trees, and a
place, heading and scale for each tree. Leaves scale with the crown, so a copy at scale s has 1/s of the leaf area per
volume. TreeTypes therefore differ in size and slenderness, and scales are near 1.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.solids import detection
from thermorender.apps.lands.solids.plants import DENSITY, Plants, edge_of
from thermorender.apps.lands.solids.textured_mesh import TexturedMesh, write_mesh
from thermorender.errors import ThermorenderError
from thermorender.formats import write_text
from thermorender.physics.srgb import linear_from_bytes

# Most trees: crowns of 12 patches and trunks of 6 have as many as `instances.MOST_COPIES` crowns alone.
MOST_TREES = 100_000
# Materials of leaves and trunks.
LEAVES, BARK = "broadleaf", "bark"
# Most types of trees; types whose trees differ less than this (standard deviation of the logarithm) are not divided.
_KINDS, _ALIKE = 16, 0.05
_BARK_COLOUR = (104, 88, 72)
# How far trunks go into the ground [m].
_SUNK_M = 0.3
_FOLDER = "trees"

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TreeType:
    """A typical tree, and its copies."""

    # By material: leaves, unless the crown is too small for any, and trunk. The foot is the origin.
    parts: dict[str, TexturedMesh]
    places: Floats  # (n, 4) float64 east, north [m], heading [°] and scale of each copy


def columns_of(tree: detection.Tree, height: Floats, bare: Floats, post_m: float) -> tuple[Floats, Floats]:
    """Return the lower and the upper end of a crown above the ground at the posts of a tree, (n,) each [m]."""
    row, column = tree.posts.T
    radius = radius_of(tree, post_m)
    top = height[row, column] - bare[row, column]
    away = np.hypot(row - tree.top[0], column - tree.top[1]) * post_m / max(radius, post_m)
    low = np.minimum(tree.height_m * (0.28 + 0.22 * np.minimum(away, 1.2) ** 2), 0.8 * top)
    return low, top


def radius_of(tree: detection.Tree, post_m: float) -> float:
    """Return the radius of a circle as large as a tree's crown in the plan [m]."""
    return float(np.sqrt(len(tree.posts) / np.pi)) * post_m


def add_trunk(plants: Plants, foot: Sequence[float], height_m: float, number: int) -> None:
    """Add the trunk of a tree of a height to plants; `foot` is its place on the ground."""
    east, north, up = foot
    plants.trunk(east, north, up - _SUNK_M, up + 0.55 * height_m, 0.05 + 0.016 * height_m,
                 linear_from_bytes(np.array(_BARK_COLOUR, np.uint8)), number)  # fmt: skip


def tree_types_of(
    trees: Sequence[detection.Tree], height: Floats, bare: Floats, at: Callable[..., Floats], draw: np.random.Generator,
    post_m: float, number: Mapping[str, int], colours: Callable[[NDArray[np.int64]], NDArray[np.float32]],
) -> tuple[TreeType, ...]:  # fmt: skip
    """Return the TreeTypes of trees over a surface model and ground, (h, w) [m]. `at` places columns, rows and heights
    in metres, `number` maps materials to classes, and `colours` gives linear colours of posts (n, 2).
    """
    if len(trees) > MOST_TREES:
        raise ThermorenderError(
            f"the surface model has {len(trees)} trees, more than the {MOST_TREES} whose light fits into an ordinary "
            "machine's memory as copies; give a smaller area"
        )
    size = np.log([[radius_of(tree, post_m), tree.height_m] for tree in trees])
    row, column = np.array([_middle(tree) for tree in trees]).T
    east, north, _ = at(column + 0.5, row + 0.5, bare[row, column]).T
    yaw = draw.uniform(0.0, 360.0, len(trees))
    made = []
    for own in _alike(size):
        typical = own[np.argmin(((size[own] - size[own].mean(axis=0)) ** 2).sum(axis=1))]
        # Of the same volume in the mean: two lengths across and one upwards.
        scale = np.exp((size[own] - size[typical]) @ [2.0 / 3.0, 1.0 / 3.0])
        parts = _parts(trees[typical], height, bare, at, draw, post_m, number, colours)
        made.append(TreeType(parts, np.column_stack([east[own], north[own], yaw[own], scale])))
    return tuple(made)


def _middle(tree: detection.Tree) -> NDArray[np.int64]:
    """The post of a tree (row, column) nearest to the middle of its crown: the foot of its copy.

    The highest post may be far from the middle, and copies are turned about their feet.
    """
    middle: NDArray[np.int64] = tree.posts[((tree.posts - tree.posts.mean(axis=0)) ** 2).sum(axis=1).argmin()]
    return middle


def _alike(size: Floats) -> list[NDArray[np.int64]]:
    """Rows of `size` (n, 2) in groups: the group of the largest sum of squares is divided at its mean, again and again.

    Each group is divided along the axis in which it is wider.
    """
    groups = [np.arange(len(size))]
    while len(groups) < _KINDS:
        spread = np.array([size[own].std(axis=0) for own in groups])
        square = spread.max(axis=1) ** 2 * [len(own) for own in groups]
        square[spread.max(axis=1) < _ALIKE] = 0.0
        widest = int(np.argmax(square))
        if not square[widest]:
            break
        own = groups.pop(widest)
        along = size[own, int(np.argmax(spread[widest]))]
        groups += [own[along <= along.mean()], own[along > along.mean()]]
    return groups


def _parts(
    tree: detection.Tree, height: Floats, bare: Floats, at: Callable[..., Floats], draw: np.random.Generator,
    post_m: float, number: Mapping[str, int], colours: Callable[[NDArray[np.int64]], NDArray[np.float32]],
) -> dict[str, TexturedMesh]:  # fmt: skip
    """Meshes of a tree that stands at the origin, on level ground."""
    crown, trunk = Plants(), Plants()
    low, top = columns_of(tree, height, bare, post_m)
    row, column = np.vstack([tree.posts, _middle(tree)]).T
    plan = at(column + 0.5, row + 0.5, np.full(len(row), bare[tree.top]))[:, :2]
    columns = np.column_stack([plan[:-1] - plan[-1], low, top])
    crown.fill(draw, columns, post_m, edge_of(radius_of(tree, post_m)), DENSITY, colours(tree.posts), number[LEAVES])
    add_trunk(trunk, (0.0, 0.0, 0.0), tree.height_m, number[BARK])
    return {name: plants.mesh(name) for name, plants in ((LEAVES, crown), (BARK, trunk)) if plants.faces}


def write_tree_types(folder: Path, types: Sequence[TreeType]) -> list[dict[str, Any]]:
    """Write meshes and tables of tree types into a scene's folder; return the [[object]] tables of scene.toml."""
    if types:
        (folder / _FOLDER).mkdir()
    tables = []
    for count, each in enumerate(types, 1):
        places = f"{_FOLDER}/{count}.csv"
        rows = "".join("{:.3f},{:.3f},{:.1f},{:.4f}\n".format(*row) for row in each.places.tolist())
        write_text(folder / places, "east_m,north_m,yaw_deg,scale\n" + rows)
        for material, mesh in each.parts.items():
            file = f"{_FOLDER}/{count}_{material}.glb"
            write_mesh(folder / file, [mesh])
            tables.append({
                "name": f"{material}_{count}", "file": file, "instances": places, "position": [0.0, 0.0, 0.0],
                "temperature": "balance", "material": material,
            })  # fmt: skip
    return tables
