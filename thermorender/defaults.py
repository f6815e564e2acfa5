"""What stands where nothing else is said, and the names of what ships."""

# Of the shipped cameras [µm]; taken as flat.
BAND_UM = (7.5, 13.5)
CAMERA = "zenmuse-xt2"
TEMPERATURE_MAP = "fok-1to1"
# Each is made by the layout of its name; the first is the one that commands take.
SCENES = ("heath", "village", "ridge")
