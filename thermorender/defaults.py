"""Default settings, and the names of the shipped scenes and maps."""

# Band of the shipped microbolometers [µm], with a flat response.
BAND_UM = (7.5, 13.5)
CAMERA = "zenmuse-xt2"
SCENES = ("heath", "village", "ridge")
SCENE = "village"
# A flight measures its sampling error in each n-th frame.
AUDIT = 10
TEMPERATURE_MAPS = ("fok-1to1", "fok-9to1")
TEMPERATURE_MAP = TEMPERATURE_MAPS[0]
# Shipped as files; trained on rendered pictures of procedural scenes.
TRAINED_MAPS = (
    "procedural-9to1", "procedural-palette", "procedural-trees", "procedural-correlation+", "procedural-trees+",
    "procedural-compact+", "procedural-pix2pix",
)  # fmt: skip
# The map that finds materials in the orthophoto, and the material of what it does not recognise.
EMISSIVITY_MAP, FALLBACK_MATERIAL = "procedural", "soil_loam"
# Compression of EXR files, one of `thermorender.frame.exr.COMPRESSIONS`.
EXR_COMPRESSION = "rle"
