"""Snow on a synthetic scene: it covers ground and roofs and part of the trees, but not steep slopes."""

import numpy as np

from thermorender.apps.lands.procedural.canvas import Canvas
from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import smoothstep

# Still water is frozen if the lowest air temperature is below this [°C].
_FREEZES_C = -5.0
# Depth at which half of the open ground is covered [m], and of trees and shrubs, whose branches shed snow.
_GROUND_M, _TREES_M = 0.02, 0.25
_TREES = ("conifer", "broadleaf", "heath_shrub")
# Warm glass sheds snow.
_BARE = ("glass", "water")
# Slope at which half of the snow holds, and its spread [m/m]: avalanches start at 30° to 50°.
_STEEP, _SPREAD = 1.1, 0.25


def lay_snow(canvas: Canvas, depth_m: float, air_low_c: float) -> None:
    """Cover the canvas with new snow of a depth [m]; water only if it is frozen."""
    import cv2

    c = canvas
    if air_low_c < _FREEZES_C:
        ice = c.among(("water",))
        c.paint(ice.astype(np.float32), linear(168, 182, 188), "ice")
        c.wetness[ice] = 0.0
    if depth_m <= 0.0:
        return
    trees, bare = c.among(_TREES), c.among(_BARE)
    # Wind and tufts make thin snow patchy; deep snow covers them.
    patchy = 0.6 * c.fractal("snow patches", 14.0, 6, 0.6)
    need = np.where(trees, np.float32(_TREES_M), np.float32(_GROUND_M))
    cover = smoothstep(-0.5, 0.5, np.log(np.float32(depth_m) / need) + patchy)
    # The slope of land and roofs, without edges and single tufts.
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
