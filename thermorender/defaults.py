"""What stands where nothing else is said, and the names of what ships."""

# Of the shipped cameras [µm], taken as flat.
BAND_UM = (7.5, 13.5)
CAMERA = "zenmuse-xt2"
SCENES = ("heath", "village", "ridge")
SCENE = SCENES[0]
TEMPERATURE_MAPS = ("fok-1to1", "fok-9to1")
TEMPERATURE_MAP = TEMPERATURE_MAPS[0]
# Trained on rendered pictures of procedural scenes, and shipped as files.
TRAINED_MAPS = (
    "procedural-9to1", "procedural-palette", "procedural-trees", "procedural-correlation+", "procedural-trees+",
    "procedural-compact", "procedural-compact+", "procedural-pix2pix",
)  # fmt: skip
# Which tells materials from the orthophoto, and the material of what it does not know.
EMISSIVITY_MAP, FALLBACK_MATERIAL = "procedural", "soil_loam"
