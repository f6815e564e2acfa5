"""Porous bodies of clusters of leaves, for copies and crowns, and the same leaves one by one.

A cluster is a small flat tetrahedron, turned at random. Its mean silhouette over all directions is a quarter of its
surface (Cauchy's theorem for convex bodies).
"""

from dataclasses import replace

import numpy as np
import trimesh

from thermorender.scene.instances import expanded
from thermorender.scene.meshes.mesh import one_texel_each

# Height of a cluster's tetrahedron as a share of a regular one's; its faces are counter-clockwise from outside.
_FLAT = 0.1
_CORNERS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) / np.sqrt(8.0)
_FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def edge_of(radius_m):
    """Return the edge of a cluster in a crown of a radius [m]."""
    return float(np.clip(0.2 * radius_m, 0.28, 0.9))


def leaves(generator, middle, edge_m):
    """Return (vertices (4 K, 3), faces (4 K, 3)) of clusters around their middles (K, 3) [m]."""
    axes, _ = np.linalg.qr(generator.standard_normal((len(middle), 3, 3)))
    # A rotation, so that outside stays outside.
    axes[np.linalg.det(axes) < 0.0, 0] *= -1.0
    corner = middle[:, None] + edge_m * _flat() @ axes
    faces = _FACES + 4 * np.arange(len(middle))[:, None, None]
    return corner.reshape(-1, 3), faces.reshape(-1, 3)


def _flat():
    """A tetrahedron of edge 1, flattened along the axis through its first corner."""
    axis = _CORNERS[0] / np.linalg.norm(_CORNERS[0])
    return _CORNERS - (1.0 - _FLAT) * np.outer(_CORNERS @ axis, axis)


def surface_m2(edge_m):
    """Return the surface of a cluster [m²]: twice one side of the leaves that it stands for."""
    corner = (edge_m * _flat())[_FACES]
    return float(0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum())


def write_crown(folder, drawn, side, most=None):
    """Write crown.ply, a porous sphere of clusters of leaves, into a folder; `drawn` points are tried."""
    random = np.random.default_rng(4)
    middle = random.uniform(-1.0, 1.0, (drawn, 3))
    middle = 1.2 * middle[(middle**2).sum(axis=1) < 1.0][:most] + [0.0, 0.0, 2.0]
    trimesh.Trimesh(*leaves(random, middle, side), process=False).export(folder / "crown.ply")


def apart(scene, halvings=0):
    """The scene with leaves of their own in its terrain, so that its heat balance solves each. `halvings` of its edges
    cut a triangle in four each time.
    """
    made = []
    for surface in scene.surfaces:
        if surface.instances is not None:
            surface = expanded(surface)
            for _ in range(halvings):
                corner = surface.vertices[surface.faces]
                half = 0.5 * (corner + np.roll(corner, -1, axis=1))
                four = np.stack([corner, half, np.roll(half, 1, axis=1)], axis=2)
                vertices = np.concatenate([four, half[:, None]], axis=1).reshape(-1, 3).astype(np.float32)
                faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
                surface = replace(surface, vertices=vertices, faces=faces, uv=None)
            uv, shape = one_texel_each(len(surface.faces))
            one = {name: np.broadcast_to(getattr(surface, name)[0, 0], shape) for name in ("material", "temperature")}
            colour = np.broadcast_to(surface.colour[0, 0], (*shape, 3))
            surface = replace(surface, uv=uv, colour=colour, flags=np.zeros(shape, np.uint8), **one)
        made.append(surface)
    return scene.with_surfaces(made, terrain_count=2).with_temperature("balance")
