"""Structure of the scene within the texels of a map: the error that it makes, from the curvature of the map.

A map that is bilinear between the middles of its texels cannot follow an edge between them. The error is alike in all
frames: parts of the frames that are compared with each other do not show it, and more frames do not lessen it. An edge
that is known to lie between texels of the scene has a known error, in proportion to the second differences of the map.
"""

import numpy as np
from numpy.typing import NDArray

from thermorender.inverse.weights import texel_line
from thermorender.sensor.camera import Camera
from thermorender.sensor.psf import otf

Floats = NDArray[np.float64]
# Frequencies below half a cycle per texel, and their repetitions to either side.
_STEPS, _ALIASES = 128, 64
# Edges between texels of the scene in a row: whole cycles for sides of halves, thirds, quarters and fifths.
_PLACES = 60


def error_of_edges(means: Floats, variance: Floats, share: float) -> Floats:
    """Return the square of the error that edges within texels make, (h, w) [K²].

    Parameters
    ----------
    means : (h, w) array
        The map's means over the texels [K].
    variance : (h, w) array
        Of their noise, of which second differences along rows and columns have twelve times as much [K²].
    share : float
        From `error_of_curvature`.
    """
    padded = np.pad(means, 1, mode="edge")
    down = padded[2:, 1:-1] - 2.0 * means + padded[:-2, 1:-1]
    across = padded[1:-1, 2:] - 2.0 * means + padded[1:-1, :-2]
    return np.asarray(share * np.maximum(down**2 + across**2 - 12.0 * variance, 0.0))


def error_of_curvature(camera: Camera, pixel: float, side: float) -> float:
    """Return the square of the error of edges over the square of the second differences of the map, in the mean.

    Parameters
    ----------
    camera : Camera
        Its lens and pixels blur the edge.
    pixel : float
        Side of a pixel on the map [texels]; 0 if no frame shows it.
    side : float
        Of a texel, in texels of the scene, as of `weights.texel_means`. The scene is bilinear between the middles of
        its texels, so a map of the same or smaller texels has no such error.

    Notes
    -----
    Many frames sample the map without gaps. The map is then the projection of the edge, blurred by a pixel, on bilinear
    maps that are blurred alike. Both squares are summed along a line across the edge, and over its places in a texel.
    """
    if pixel <= 0.0 or side < 1.0:
        return 0.0
    base = (np.arange(_STEPS) + 0.5) / _STEPS - 0.5
    frequency = base + np.arange(-_ALIASES, _ALIASES + 1)[:, None]
    seen = np.abs(frequency * pixel)
    transfer = (otf(camera, seen.ravel()).reshape(seen.shape) * np.sinc(seen)) ** 2
    tent = np.sinc(frequency) ** 2
    outer, middle, _ = texel_line(side)
    wave = np.cos(2.0 * np.pi * base)
    means, bends = middle + 2.0 * outer * wave, 2.0 - 2.0 * wave
    # A step between two texels of the scene, before these are joined bilinearly, or each fills its own texel.
    step = 1.0 / (2j * side * np.sin(np.pi * frequency / side))
    scene_texel = np.sinc(frequency / side)
    error = curvature = 0.0
    for place in np.arange(_PLACES) / side % 1.0 - 0.5:
        edge = step * np.exp(-2j * np.pi * frequency * place) * scene_texel
        middles = (transfer * tent * scene_texel * edge).sum(axis=0) / (transfer * tent**2).sum(axis=0)
        truth = (np.sinc(frequency) * edge).sum(axis=0)
        error += float(np.mean(np.abs(middles * means - truth) ** 2))
        curvature += float(np.mean(np.abs(middles * means * bends) ** 2))
    return error / curvature
