"""Scenes in three dimensions: porous crowns, quadrilaterals with pictures, their files, and the survey of a world."""

import numpy as np
import pytest

from thermorender.render.geometry import Geometry
from thermorender.render.survey.from_above import from_above
from thermorender.render.variant import activate
from thermorender.scene.solids.plants import Plants, leaves, surface_m2
from thermorender.scene.surface import Surface


def surface_of(vertices, faces):
    """A Surface of one texel, of triangles in memory."""
    texel = np.zeros((1, 1), np.uint8)
    uv = np.full((len(faces), 3, 2), 0.5, np.float32)
    return Surface("s", vertices, np.asarray(faces, np.int32), uv, np.zeros((1, 1, 3), np.uint8), texel,
                   texel.astype(np.float32), texel, 1.0)  # fmt: skip


@pytest.mark.parametrize("degrees", [0.0, 30.0, 55.0, 70.0])
def test_a_crown_lets_light_through_by_beers_law(degrees):
    """A layer of leaves of all orientations, 2 m deep, seen at an angle: exp(−G D s) with G = 1/2 (Ross 1981).

    The clusters are few, so that the share itself is uncertain; the spread between strips gives its standard error.
    """
    density, depth, half = 1.2, 2.0, 9.0
    cell = 0.5
    line = np.arange(-half + 0.25, half, cell)
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    column = np.column_stack([x, y, np.zeros(len(x)), np.full(len(x), depth)])
    plants = Plants()
    plants.fill(np.random.default_rng(3), column, cell, 0.3, density, np.full((len(x), 3), 0.2), 1)
    skin = plants.skin("leaves")
    # Turning the layer about the x axis is looking at it at an angle.
    turn = np.radians(degrees)
    matrix = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
    geometry = Geometry(activate(), [surface_of((skin.vertices - [0, 0, 0.5 * depth]) @ matrix.T, skin.faces)])
    # Rays that stay inside the layer's sides.
    reach = half * np.cos(turn) - 0.5 * depth * np.sin(turn) - 0.3
    east, north = np.meshgrid(np.linspace(-half + 0.3, half - 0.3, 480), np.linspace(-reach, reach, 240))
    _, texel = from_above(geometry, east, north)
    through = (texel < 0).mean(axis=0).reshape(24, 20).mean(axis=1)
    expected = np.exp(-0.5 * density * depth / np.cos(turn))
    error = through.std(ddof=1) / np.sqrt(len(through))
    print(degrees, through.mean(), expected, error)
    assert error < 0.03
    assert abs(through.mean() - expected) < 3.0 * error


def test_leaves_are_closed_bodies_of_their_stated_surface():
    vertices, faces = leaves(np.random.default_rng(0), np.zeros((5, 3)), 0.4)
    corner = vertices[faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = 0.5 * np.linalg.norm(across, axis=1).reshape(5, 4).sum(axis=1)
    assert area == pytest.approx(np.full(5, surface_m2(0.4)))
    # Normals of a closed body add up to nothing, and its volume is positive where they point outwards.
    assert across.reshape(5, 4, 3).sum(axis=1) == pytest.approx(np.zeros((5, 3)), abs=1e-12)
    assert (np.einsum("fi,fi->f", corner.mean(axis=1), across).reshape(5, 4).sum(axis=1) > 0.0).all()
