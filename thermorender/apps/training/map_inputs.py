"""Inputs of a learned map from a pair of a data set, the same in training and evaluation."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.training.dataset import Pair
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import Inputs

# Material number in the truth for sky.
NO_MATERIAL = 255


def ground_of(pair: Pair) -> NDArray[np.bool_]:
    """Return where a Pair shows ground, (H, W) bool: valid pixels, without sky if the truth has materials."""
    if "material" not in pair.truth:
        return pair.valid
    return pair.valid & (pair.truth["material"] != NO_MATERIAL)


def inputs_of(pair: Pair, card: dict[str, Any], material: bool = False) -> Inputs:
    """Return the Inputs of a Pair: its picture, ground sampling distance, relief, hour, weather and depth.

    `card` is its data set's; `card["terrain"]` names the truth planes that follow from terrain alone. `material` adds
    the true material for privileged maps: indices into `card["materials"]`, NaN for sky.
    """
    names = [*card.get("terrain", ()), *(["material"] if material else ())]
    for name in names:
        if name not in pair.truth:
            raise ThermorenderError(
                f"pair {pair.entry.key!r} has no plane {name!r}; leave out the maps that need it, or make the data set "
                "again with it"
            )
    terrain = {name: pair.truth[name].astype(np.float32) for name in names}
    if material:
        terrain["material"][pair.truth["material"] == NO_MATERIAL] = np.nan
    return Inputs(pair.visible, pair.entry.texel_m, terrain, pair.entry.conditions, depth_of(pair))


def depth_of(pair: Pair) -> NDArray[np.float32] | None:
    """Return the depth of a Pair's pixels [m], (H, W) float32, NaN for sky; None if the truth has no depth."""
    depth = pair.truth.get("depth")
    return None if depth is None else np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan).astype(np.float32)
