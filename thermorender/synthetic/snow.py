"""Snow on a synthetic scene: it covers ground and roofs, lies on part of the trees, and slides off what is steep."""

import numpy as np

from thermorender.synthetic.light import linear
from thermorender.synthetic.noise import smoothstep

# Still water bears ice after days below this lowest air [°C].
_FREEZES_C = -5.0
# Depth at which half of open, even ground is covered [m], and of trees and shrubs, off whose branches it slides.
_GROUND_M, _TREES_M = 0.02, 0.25
_TREES = ("conifer", "broadleaf", "heath_shrub")
# Glass over warm air sheds it.
_BARE = ("glass", "water")
# Slopes on which half of it holds, and their spread [m/m]: avalanches run from 30° to 50°.
_STEEP, _SPREAD = 1.1, 0.25


def lay_snow(canvas, depth_m, air_low_c):
    """Cover the canvas with new snow of a depth [m]; on water only where it has frozen."""
    import cv2

    c = canvas
    if air_low_c < _FREEZES_C:
        ice = c.among(("water",))
        c.paint(ice.astype(np.float32), linear(168, 182, 188), "ice")
        c.wetness[ice] = 0.0
    if depth_m <= 0.0:
        return
    trees, bare = c.among(_TREES), c.among(_BARE)
    # Wind and tufts make a thin cover patchy; a thick one hides them.
    patchy = 0.6 * c.fractal("snow patches", 14.0, 6, 0.6)
    need = np.where(trees, np.float32(_TREES_M), np.float32(_GROUND_M))
    cover = smoothstep(-0.5, 0.5, np.log(np.float32(depth_m) / need) + patchy)
    # The slope of land and roofs, not that of their edges or of single tufts.
    rise, run = np.gradient(cv2.GaussianBlur(c.surface, (0, 0), max(0.5, 1.0 / c.texel)), c.texel)
    steep = np.where(trees, 0.0, np.hypot(rise, run))
    cover *= 1.0 - smoothstep(_STEEP - _SPREAD, _STEEP + _SPREAD, steep)
    cover[bare] = 0.0
    tone = linear(234, 238, 243) * np.exp(0.03 * c.fractal("snow tone", 20.0, 6, 0.6))[..., None]
    c.paint(cover, tone, "snow")
    covered = cover > 0.5
    c.wetness[covered] = 0.0
    c.relief *= 1.0 - 0.8 * cover
    c.top += np.float32(depth_m) * cover
