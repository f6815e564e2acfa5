"""Kinds of materials: what else is known of a place, such as its height or a map of buildings, names kinds."""

KINDS: dict[str, tuple[str, ...]] = {
    "roof": (
        "roof_shingle", "roof_slate", "roof_slate_urban", "roof_rubber", "roof_rubber_black", "roof_rubber_white",
        "roof_tile_clay", "roof_tile_cement", "roof_tile_loft", "roof_tar_paper", "roof_felt", "roof_flat_gravel",
        "roof_flat_membrane", "roof_metal_insulated", "fibre_cement", "pvc_roofing", "metal_painted",
        "steel_galvanised", "steel_galvanised_oxidised", "steel_aluzinc", "aluminium_sheet", "aluminium_stucco",
        "aluminium_weathered", "lead_weathered", "iron_weathered", "glass", "glass_fresnel", "tar", "concrete",
        "concrete_urban", "cement", "wood",
    ),
    "paved": (
        "asphalt", "asphalt_stone", "road_asphalt", "tarmac", "tar", "concrete", "concrete_urban", "pavement_concrete",
        "cement", "granite_paving", "brick_clay", "brick_cement",
    ),
    "timber": ("wood",),
    "soil": ("soil_loam", "soil_dark", "soil_arid"),
    "sand": ("sand_quartz", "sand_gypsum"),
    "rock": ("granite", "granite_powder", "limestone", "basalt", "sandstone", "marble", "quartzite"),
    "low": ("grass_green", "grass_dry", "heath_shrub", "lichen", "leaf_litter"),
    "tree": ("conifer", "broadleaf", "leaf_litter", "needles_dry", "oak_leaves", "maple_leaves", "bark"),
    "water": ("water", "water_fresnel", "water_breeze", "sea_foam"),
    "snow": ("snow", "snow_fine", "snow_medium", "snow_coarse", "frost", "ice", "ice_fresnel"),
}  # fmt: skip


def kinds_of(material: str) -> tuple[str, ...]:
    """Return the kinds of a material by its name; () for one that is not listed."""
    return tuple(kind for kind, names in KINDS.items() if material in names)
