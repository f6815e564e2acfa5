"""Crowns as copies of a body, and the same leaves one by one."""

from dataclasses import replace

import numpy as np
import trimesh

from thermorender.apps.lands.solids.plants import leaves
from thermorender.scene.instances import expanded
from thermorender.scene.meshes.mesh import one_texel_each


def write_crown(folder, drawn, side, most=None):
    """Write crown.ply, a porous sphere of clusters of leaves, into a folder; `drawn` points are tried."""
    random = np.random.default_rng(4)
    middle = random.uniform(-1.0, 1.0, (drawn, 3))
    middle = 1.2 * middle[(middle**2).sum(axis=1) < 1.0][:most] + [0.0, 0.0, 2.0]
    trimesh.Trimesh(*leaves(random, middle, side), process=False).export(folder / "crown.ply")


def apart(scene):
    """The scene with leaves of their own in its terrain, so that its heat balance solves each."""
    made = []
    for surface in scene.surfaces:
        if surface.instances is not None:
            surface = expanded(surface)
            uv, shape = one_texel_each(len(surface.faces))
            one = {name: np.broadcast_to(getattr(surface, name)[0, 0], shape) for name in ("material", "temperature")}
            colour = np.broadcast_to(surface.colour[0, 0], (*shape, 3))
            surface = replace(surface, uv=uv, colour=colour, flags=np.zeros(shape, np.uint8), **one)
        made.append(surface)
    return scene.with_surfaces(made, terrain_count=2).with_temperature("balance")
