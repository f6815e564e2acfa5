"""Trees of a surface model: where their leaves and trunks are, which no survey from above sees."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.solids import detection
from thermorender.apps.lands.solids.plants import DENSITY, Plants
from thermorender.errors import ThermorenderError
from thermorender.physics.srgb import linear_from_bytes
from thermorender.scene.instances import MOST_COPIES

# Material of leaves.
LEAVES = "broadleaf"
_BARK_COLOUR = (104, 88, 72)
# How far trunks go into the ground [m].
_SUNK_M = 0.3

Floats = NDArray[np.float64]


def plants_of(
    trees: Sequence[detection.Tree], height: Floats, bare: Floats, at: Callable[..., Floats], post_m: float, bark: int,
    colours: Callable[[NDArray[np.int64]], NDArray[np.float32]],
) -> Plants:  # fmt: skip
    """Return the Plants of trees over a surface model and ground, (h, w) [m]. `at` places columns, rows and heights in
    metres, `bark` is the class of trunks, and `colours` gives linear colours of posts (n, 2).
    """
    if len(trees) > MOST_COPIES:
        raise ThermorenderError(
            f"the surface model has {len(trees)} trees, more than the {MOST_COPIES} whose light fits into an ordinary "
            "machine's memory; give a smaller area"
        )
    plants = Plants()
    for tree in trees:
        row, column = tree.posts.T
        low, top = _columns(tree, height, bare, post_m)
        place = at(column + 0.5, row + 0.5, bare[row, column])
        columns = np.column_stack([place[:, :2], place[:, 2] + low, place[:, 2] + top])
        plants.crown(columns, post_m, DENSITY, colours(tree.posts), LEAVES)
        east, north, up = place[int(np.argmax((row == tree.top[0]) & (column == tree.top[1])))]
        plants.trunk(east, north, up - _SUNK_M, up + 0.55 * tree.height_m, 0.05 + 0.016 * tree.height_m,
                     linear_from_bytes(np.array(_BARK_COLOUR, np.uint8)), bark)  # fmt: skip
    return plants


def _columns(tree: detection.Tree, height: Floats, bare: Floats, post_m: float) -> tuple[Floats, Floats]:
    """The lower and the upper end of a crown above the ground at the posts of a tree, (n,) each [m]."""
    row, column = tree.posts.T
    radius = float(np.sqrt(len(tree.posts) / np.pi)) * post_m
    top = height[row, column] - bare[row, column]
    away = np.hypot(row - tree.top[0], column - tree.top[1]) * post_m / max(radius, post_m)
    low = np.minimum(tree.height_m * (0.28 + 0.22 * np.minimum(away, 1.2) ** 2), 0.8 * top)
    return low, top
