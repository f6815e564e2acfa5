"""Hidden fields of a synthetic scene: moisture, cover and roughness of each texel, only partly visible in its colour.

Wet ground is darker and dry grass yellower. The colour explains a third of the moisture's variance, and nothing of the
other fields. The strength of the variation is drawn for each seed.
"""

import numpy as np

from thermorender.apps.lands.procedural.canvas import Canvas
from thermorender.materials.library import load_library
from thermorender.scene.deviations import Deviations

# Change of the logarithm of colour per standard deviation of visible moisture, per linear sRGB channel. Soil:
# reflectance falls exponentially with moisture to about half of the dry value, equally for four soils as a function of
# the degree of saturation: Lobell & Asner, Soil Sci. Soc. Am. J. 66 (2002) 722, doi:10.2136/sssaj2002.7220; the
# half for water between grains: Twomey, Bohren & Mergenthaler, Appl. Opt. 25 (1986) 431, doi:10.1364/AO.25.000431.
# A fifth of saturation about a third of it, with an e-fold of 0.3, gives 0.15.
_SOIL = np.array([-0.15, -0.15, -0.14], np.float32)
# Grass: red reflectance grows as leaves lose water and green: Tucker, Remote Sens. Environ. 8 (1979) 127,
# doi:10.1016/0034-4257(79)90013-0.
_GRASS = np.array([-0.10, -0.04, 0.03], np.float32)
_SOILS = ("soil_loam", "soil_dark", "sand_quartz", "leaf_litter", "sandstone", "limestone", "granite")
_GRASSES = ("grass_green", "grass_dry", "heath_shrub")
# Correlation of the visible part with moisture.
_SEEN = 0.6
# Standard deviation between lands of the logarithm of each field's strength.
_STRENGTH = 0.25


def deviations_of(canvas: Canvas, again: int = 0) -> Deviations:
    """Tint the canvas by the visible part of moisture, and return its Deviations. With `again` above 0 they are another
    draw for the same photograph: the visible part of moisture stays.

    Standard deviation of each field's part in the factors' logarithms: wetness 0.55 moisture (48 m) and 0.30 cover (9
    m); exchange 0.20 cover and 0.09 roughness (texels); inertia 0.18 moisture and −0.13 cover; reflectance −0.14 cover,
    0.07 roughness and, of soils, −0.15 moisture. Chosen: at a clear noon they cause 0.6 to 1.1 K (mean absolute) that
    neither tables nor weather predict. Painted moisture (hollows, shores) adds to the table's.
    """
    c = canvas
    g = c.stream("hidden")
    wetter, denser, rougher = np.exp(g.normal(0.0, _STRENGTH, 3)).astype(np.float32)
    moisture = wetter * c.fractal("moisture", 48.0, 4, 0.6)
    unseen = wetter * c.fractal("unseen moisture", 30.0, 5, 0.6)
    cover = denser * c.fractal("cover", 9.0, 3, 0.6)
    rough = rougher * c.grain("roughness", max(1.2, 3.0 * c.texel))

    soil, grass = c.among(_SOILS), c.among(_GRASSES)
    rest = np.float32(np.sqrt(1.0 - _SEEN**2))
    seen = np.float32(_SEEN) * moisture + rest * unseen
    if again:
        # Conditional on the visible part, moisture has this mean and the unexplained variance.
        moisture = np.float32(_SEEN) * seen + rest * wetter * c.fractal(f"moisture {again}", 48.0, 4, 0.6)
        denser, rougher = np.exp(c.stream(f"hidden {again}").normal(0.0, _STRENGTH, 2)).astype(np.float32)
        cover = denser * c.fractal(f"cover {again}", 9.0, 3, 0.6)
        rough = rougher * c.grain(f"roughness {again}", max(1.2, 3.0 * c.texel))
    for mask, tint in ((soil, _SOIL), (grass, _GRASS)):
        c.albedo[mask] *= np.exp(seen[mask][:, None] * tint)

    library = load_library()
    usual = np.ones(256, np.float32)
    for value, name in c.names.items():
        # Materials that are never moist stay dry.
        usual[value] = library[name].known_thermal().wetness or np.inf
    painted = 1.0 + np.maximum(c.wetness, 0.0) / usual[c.material]
    reflectance = np.float32(-0.14) * cover + np.float32(0.07) * rough + np.where(soil, _SOIL.mean(), 0.0) * moisture
    return Deviations(
        reflectance=np.exp(reflectance, dtype=np.float32),
        wetness=painted * np.exp(np.float32(0.55) * moisture + np.float32(0.30) * cover),
        exchange=np.exp(np.float32(0.20) * cover + np.float32(0.09) * rough),
        inertia=np.exp(np.float32(0.18) * moisture - np.float32(0.13) * cover),
    )
