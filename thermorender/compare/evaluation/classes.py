"""Which classes errors are told for: of pixels, by material, man-made or natural, and edges; and of pictures."""

import numpy as np

from thermorender.campaign.map_inputs import NO_MATERIAL

# The materials of the library: what people made or laid, and what lies or grows by itself. One that stands in neither,
# as a scene's own, counts for neither.
MAN_MADE = frozenset(
    "asphalt concrete roof_shingle roof_slate roof_rubber glass paint_black paint_metallic wood brass tar "
    "paint_black_gloss paint_black_matt gold_plate roof_rubber_black roof_rubber_white brick_clay roof_tile_clay "
    "paint_olive roof_tar_paper steel_galvanised steel_galvanised_oxidised aluminium_sheet asphalt_stone tarmac "
    "roof_felt brick_cement brick_painted cement concrete_urban granite_paving roof_slate_urban fibre_cement "
    "roof_tile_cement sandstone_building limestone_building pvc_roofing quartzite metal_painted steel_aluzinc "
    "aluminium_stucco aluminium_weathered lead_weathered iron_weathered glass_fresnel silica_fused "
    "aluminium_polished copper_polished gold_polished iron_polished".split()
)
NATURAL = frozenset(
    "grass_green grass_dry heath_shrub conifer broadleaf leaf_litter bark soil_loam soil_dark sand_quartz granite "
    "limestone basalt water snow ice lichen needles_dry oak_leaves maple_leaves soil_arid sand_gypsum granite_powder "
    "sandstone marble sea_foam frost snow_fine snow_medium snow_coarse water_fresnel water_breeze ice_fresnel".split()
)
# An edge: where the true apparent temperature changes by more than this [K/px], and so many pixels around.
EDGE_K_PX = 1.0
EDGE_PX = 2
EDGES = (f"within {EDGE_PX} px of an edge", "elsewhere")
# Labels of pairs that make groups, where they have them.
LABELS = ("kind", "view", "weather", "season")


def edge_class(temperature):
    """Return (H, W) int: number in `EDGES` of each pixel of a true picture [K].

    The gradient is that of central differences; a pixel counts whose square of 5 × 5 holds one of a strong gradient.
    Where the temperature is not known there is no edge.
    """
    import cv2

    down, right = np.gradient(np.asarray(temperature, np.float64))
    # False where either is NaN.
    strong = np.hypot(down, right) > EDGE_K_PX
    side = 2 * EDGE_PX + 1
    return 1 - cv2.dilate(strong.astype(np.uint8), np.ones((side, side), np.uint8)).astype(np.intp)


def picture_classes(entry):
    """Return {grouping: class} of an Entry: local solar hour and labels, those that it has."""
    found = {}
    if "solar_hour" in entry.conditions:
        hour = int(entry.conditions["solar_hour"] % 24.0)
        found["hour"] = f"{hour:02d}–{hour + 1:02d} h"
    return found | {name: str(entry.labels[name]) for name in LABELS if name in entry.labels}


def material_groups(rows, names):
    """Return ({material: row of sums}, {"man-made" and "natural": row}) of the rows of all material numbers."""
    materials, surfaces = {}, {}
    for number, name in enumerate(names[:NO_MATERIAL]):
        if rows[number].any():
            materials[name] = rows[number]
            for surface, members in (("man-made", MAN_MADE), ("natural", NATURAL)):
                if name in members:
                    surfaces[surface] = surfaces.get(surface, 0.0) + rows[number]
    return materials, surfaces
