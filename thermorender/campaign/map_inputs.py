"""What a learned map is given of a pair of a data set: the one place where that is decided.

Training, evaluation and whoever else runs a map over a data set ask here, so that all of them show it the same.
"""

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import Inputs

# Material number in truth where there is none.
NO_MATERIAL = 255


def ground_of(pair):
    """Return where a Pair shows ground, (H, W) bool: all that is valid, but for sky where the truth tells it."""
    if "material" not in pair.truth:
        return pair.valid
    return pair.valid & (pair.truth["material"] != NO_MATERIAL)


def inputs_of(pair, card, material=False):
    """Return the Inputs of a Pair: its picture, ground sampling distance, relief, hour, weather and depth.

    Parameters
    ----------
    pair : Pair
    card : dict
        Of its data set; `card["terrain"]` names the planes of truth that a terrain knows without any thermal picture.
    material : bool
        Adds the plane "material": numbers into `card["materials"]`, NaN where there is none. For oracles only, which
        are allowed to see what no map can know.

    Raises
    ------
    ThermorenderError
        The pair lacks a plane that the card names, or the materials.
    """
    names = [*card.get("terrain", ()), *(["material"] if material else ())]
    for name in names:
        if name not in pair.truth:
            raise ThermorenderError(
                f"pair {pair.entry.key!r} has no plane {name!r}; leave out the maps that need it, or make the data set "
                "anew with it"
            )
    terrain = {name: pair.truth[name].astype(np.float32) for name in names}
    if material:
        terrain["material"][pair.truth["material"] == NO_MATERIAL] = np.nan
    return Inputs(pair.visible, pair.entry.texel_m, terrain, pair.entry.conditions, depth_of(pair))


def depth_of(pair):
    """Return the depth of a Pair's pixels [m], (H, W) float32 and NaN where nothing is, or None where it tells none."""
    depth = pair.truth.get("depth")
    return None if depth is None else np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan).astype(np.float32)
