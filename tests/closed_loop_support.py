"""A field with a fire for closed loops, and a server of it."""

import numpy as np
from scipy.ndimage import gaussian_filter

import thermorender as tr
from scenes import coarse, scene_object, write_raster, write_terrain
from thermorender.apps.link.stage import Stage

MAP = "fok-1to1"
# Middle of the fire [m].
FIRE = np.array([0.0, 0.0, 1.5])
_OBJECT = scene_object("fire", [4.0, 4.0, 3.0], [0.0, 0.0, 1.5], temperature=390.0, colour=[255, 120, 30])


def field(folder):
    """Flat grass and sand, 400 m wide; the fire is orange, so that a map finds it warm, too."""
    rough = gaussian_filter(np.random.default_rng(1).normal(size=(100, 100)), 2)
    rough /= rough.std()
    colour = np.clip((100, 115, 75) + rough[..., None] * (18, 15, 12), 0, 255)
    write_terrain(folder, np.zeros((400, 400)), 295.0 + 2.0 * rough, np.where(rough > 0, 1, 2), colour, 4.0, _OBJECT)
    write_raster(folder / "elevation.tif", np.zeros((1, 100, 100), np.float32), 4.0, nodata=np.nan)
    scene = coarse(tr.load_scene(folder), 8)
    renderer = tr.Renderer(scene, rays=4, samples=1)
    return Stage(renderer, maps=(MAP,))
