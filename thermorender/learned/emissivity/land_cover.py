"""Land cover: groups of surfaces, the share of each material in its group, and the mean emissivity of the group.

On pictures of other places, a map distinguishes groups (roof, road, vegetation …) far better than the materials within
them. It therefore takes most of a material's share in its group from here. Shares follow the area of a cover, not the
number of its samples in a library. Rock faces cover 1.4 % and moving sand 4.1 % of the ice-free land (Reich, Eswaran &
Beinroth 2005, "Global Soil Regions"). Most roofs are tile, shingle, concrete or membrane.

A group's `mean_std` is the uncertainty of its mean over 7.5–13.5 µm between climates, from 1030 samples of the
ECOSTRESS library (Meerdink et al. 2019, doi:10.1016/j.rse.2019.05.015) and SLUM (Kotthaus et al. 2014,
doi:10.1016/j.isprsjprs.2014.05.005). Bare land is 0.960 ± 0.004 in temperate climates (49 soils 0.961) and
0.942 ± 0.009 in inhabited deserts with gravel, rock and sand. Where the climate is unknown, it is 0.951 ± 0.010.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.materials.mixture import MATERIAL_STD


@dataclass(frozen=True)
class Group:
    """A kind of surface."""

    mean_std: float  # Standard deviation of the mean emissivity of its samples between climates [1]
    shares: dict[str, float]  # Share of each material in the group's area


GROUPS = {
    "water": Group(0.002, {"water": 1.0}),
    "snow": Group(0.007, {"snow": 1.0}),
    "bare land": Group(0.010, {
        "soil_loam": 0.42, "soil_dark": 0.12, "soil_arid": 0.16, "sand_quartz": 0.10, "limestone": 0.07,
        "granite": 0.06, "leaf_litter": 0.07,
    }),
    "paved": Group(0.007, {"asphalt": 0.5, "concrete": 0.5}),
    # Bare metal is 0.02 to 0.97; a few per cent of the roofs move the mean by as much as all other differences.
    "roof": Group(0.010, {
        "roof_tile_clay": 0.25, "roof_shingle": 0.17, "cement": 0.25, "roof_rubber": 0.10, "roof_slate": 0.05,
        "roof_felt": 0.06, "metal_painted": 0.07, "steel_galvanised_oxidised": 0.04, "glass": 0.005, "wood": 0.005,
    }),
    # Leaves are 0.955 to 0.977, canopies up to 0.99 by their cavities.
    "vegetation": Group(0.010, {
        "grass_green": 0.35, "grass_dry": 0.20, "heath_shrub": 0.10, "conifer": 0.10, "broadleaf": 0.25,
    }),
}  # fmt: skip


def group_of(material: str) -> str:
    """Return the group of a material; one that no group lists is a group of its own."""
    return next((name for name, group in GROUPS.items() if material in group.shares), material)


def mean_std_of(group: str) -> float:
    """Return the uncertainty of a group's mean emissivity, and of a material's that is a group of its own."""
    return GROUPS[group].mean_std if group in GROUPS else MATERIAL_STD


def shares_of(materials: Sequence[str]) -> tuple[float, ...]:
    """Return the share of each material in its group, 1 for one that no group lists."""
    return tuple(GROUPS[group].shares[name] if (group := group_of(name)) in GROUPS else 1.0 for name in materials)


def levelling(groups: Sequence[str], share: Sequence[float], own: Sequence[float]) -> NDArray[np.float32]:
    """Return the matrix (C, C) that multiplies probabilities of materials (N, C) to give them shares of the land cover.

    Each material keeps the part `own` (C,) of its probability. The rest is distributed over its group by `share` (C,).
    """
    among = np.array(groups)
    same = among[:, None] == among
    weight = np.asarray(share, np.float64)
    shared = same * weight / np.maximum((same * weight).sum(axis=1, keepdims=True), 1e-12)
    kept = np.asarray(own, np.float64)
    matrix: NDArray[Any] = np.diag(kept) + (1.0 - kept)[:, None] * shared
    return matrix.astype(np.float32)
