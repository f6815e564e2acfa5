"""What no map of a synthetic scene tells: moisture, cover and roughness of each texel, seen by the camera in part.

Wet ground is darker and dry grass yellower, as it is outdoors, and with as much scatter: the colour knows a third of
the moisture's variance and nothing of the rest. How strongly a land varies is drawn for each seed.
"""

import numpy as np

from thermorender.materials.library import load_library
from thermorender.scene.deviations import Deviations

# Logarithm of the photograph's change per standard deviation of what it sees of moisture, per linear sRGB channel.
# Soil: reflectance falls exponentially with moisture to about half of the dry one, alike for four soils when moisture
# is the degree of saturation: Lobell & Asner, Soil Sci. Soc. Am. J. 66 (2002) 722, doi:10.2136/sssaj2002.7220; the
# half for water between grains: Twomey, Bohren & Mergenthaler, Appl. Opt. 25 (1986) 431, doi:10.1364/AO.25.000431.
# A fifth of saturation about a third of it, e-fold at 0.3, makes 0.15.
_SOIL = np.array([-0.15, -0.15, -0.14], np.float32)
# Grass: red reflectance grows as leaves lose water and green: Tucker, Remote Sens. Environ. 8 (1979) 127,
# doi:10.1016/0034-4257(79)90013-0.
_GRASS = np.array([-0.10, -0.04, 0.03], np.float32)
_SOILS = ("soil_loam", "soil_dark", "sand_quartz", "leaf_litter", "sandstone", "limestone", "granite")
_GRASSES = ("grass_green", "grass_dry", "heath_shrub")
# Correlation of what the photograph sees with moisture.
_SEEN = 0.6
# Standard deviation, from land to land, of the logarithm of each field's strength.
_STRENGTH = 0.25


def deviations_of(canvas, again=0):
    """Tint the canvas with what is seen of moisture, and return its Deviations.

    With `again` above 0 the Deviations is another draw that the same photograph allows: what is seen of moisture stays,
    the rest is drawn anew.

    Notes
    -----
    Logarithms of the factors, standard deviation of each field's share: wetness 0.55 moisture (48 m) and 0.30 cover
    (9 m); exchange 0.20 cover and 0.09 roughness (texels); inertia 0.18 moisture and −0.13 cover; reflectance −0.14
    cover, 0.07 roughness and, of soils, −0.15 moisture. Chosen: of a clear noon they leave 0.6 to 1.1 K (mean absolute)
    that neither table nor weather tells. Painted moisture (hollows, shores) adds to the table's.
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
        # Given what is seen, moisture has this mean and the variance that the rest explains.
        moisture = np.float32(_SEEN) * seen + rest * wetter * c.fractal(f"moisture {again}", 48.0, 4, 0.6)
        denser, rougher = np.exp(c.stream(f"hidden {again}").normal(0.0, _STRENGTH, 2)).astype(np.float32)
        cover = denser * c.fractal(f"cover {again}", 9.0, 3, 0.6)
        rough = rougher * c.grain(f"roughness {again}", max(1.2, 3.0 * c.texel))
    for mask, tint in ((soil, _SOIL), (grass, _GRASS)):
        c.albedo[mask] *= np.exp(seen[mask][:, None] * tint)

    library = load_library()
    usual = np.ones(256, np.float32)
    for value, name in c.names.items():
        # What never is moist stays dry.
        usual[value] = library[name].known_thermal().wetness or np.inf
    painted = 1.0 + np.maximum(c.wetness, 0.0) / usual[c.material]
    reflectance = np.float32(-0.14) * cover + np.float32(0.07) * rough + np.where(soil, _SOIL.mean(), 0.0) * moisture
    return Deviations(
        reflectance=np.exp(reflectance, dtype=np.float32),
        wetness=painted * np.exp(np.float32(0.55) * moisture + np.float32(0.30) * cover),
        exchange=np.exp(np.float32(0.20) * cover + np.float32(0.09) * rough),
        inertia=np.exp(np.float32(0.18) * moisture - np.float32(0.13) * cover),
    )
