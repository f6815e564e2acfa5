"""Classes for which errors are reported: of pixels (material, man-made or natural, edges) and of pictures."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.training.dataset import Entry
from thermorender.apps.training.map_inputs import NO_MATERIAL

# Man-made and natural materials of the library; other materials, such as a scene's own, count for neither group.
MAN_MADE = frozenset(
    "asphalt concrete roof_shingle roof_slate roof_rubber glass paint_black paint_metallic wood brass tar "
    "paint_black_gloss paint_black_matt gold_plate roof_rubber_black roof_rubber_white brick_clay roof_tile_clay "
    "paint_olive roof_tar_paper steel_galvanised steel_galvanised_oxidised aluminium_sheet asphalt_stone tarmac "
    "roof_felt brick_cement brick_painted cement concrete_urban granite_paving roof_slate_urban fibre_cement "
    "roof_tile_cement sandstone_building limestone_building pvc_roofing quartzite metal_painted steel_aluzinc "
    "aluminium_stucco aluminium_weathered lead_weathered iron_weathered glass_fresnel silica_fused "
    "aluminium_polished copper_polished gold_polished iron_polished roof_tile_loft roof_flat_gravel roof_flat_membrane "
    "roof_metal_insulated road_asphalt pavement_concrete".split()
)
NATURAL = frozenset(
    "grass_green grass_dry heath_shrub conifer broadleaf leaf_litter bark soil_loam soil_dark sand_quartz granite "
    "limestone basalt water snow ice lichen needles_dry oak_leaves maple_leaves soil_arid sand_gypsum granite_powder "
    "sandstone marble sea_foam frost snow_fine snow_medium snow_coarse water_fresnel water_breeze ice_fresnel".split()
)
# An edge: a gradient of the true apparent temperature above this [K/px], widened by this many pixels.
EDGE_K_PX = 1.0
EDGE_PX = 2
EDGES = (f"within {EDGE_PX} px of an edge", "elsewhere")
# Labels of pairs that define groups.
LABELS = ("kind", "view", "weather", "season")


def edge_class(temperature: ArrayLike) -> NDArray[np.intp]:
    """Return the number in `EDGES` of each pixel of a true picture [K], (H, W) int.

    Gradients are central differences. A pixel is near an edge where its 5 × 5 neighbourhood has a strong gradient.
    Unknown temperatures make no edge.
    """
    import cv2

    down, right = np.gradient(np.asarray(temperature, np.float64))
    # False where either is NaN.
    strong = np.hypot(down, right) > EDGE_K_PX
    side = 2 * EDGE_PX + 1
    widened: NDArray[np.intp] = cv2.dilate(strong.astype(np.uint8), np.ones((side, side), np.uint8)).astype(np.intp)
    return 1 - widened


def picture_classes(entry: Entry) -> dict[str, str]:
    """Return {grouping: class} of an Entry: its local solar hour and its labels, where present."""
    found = {}
    if "solar_hour" in entry.conditions:
        hour = int(entry.conditions["solar_hour"] % 24.0)
        found["hour"] = f"{hour:02d}–{hour + 1:02d} h"
    return found | {name: str(entry.labels[name]) for name in LABELS if name in entry.labels}


def material_groups(
    rows: NDArray[np.float64], names: Sequence[str]
) -> tuple[dict[str, NDArray[np.float64]], dict[str, NDArray[np.float64]]]:
    """Return ({material: sums}, {"man-made" and "natural": sums}) of the rows of sums of all material numbers."""
    materials: dict[str, NDArray[np.float64]] = {}
    surfaces: dict[str, NDArray[np.float64]] = {}
    for number, name in enumerate(names[:NO_MATERIAL]):
        if rows[number].any():
            materials[name] = rows[number]
            for surface, members in (("man-made", MAN_MADE), ("natural", NATURAL)):
                if name in members:
                    surfaces[surface] = surfaces.get(surface, 0.0) + rows[number]
    return materials, surfaces
