"""Connected areas of one material: across the islands of a texture, and no farther than their faces meet."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

import thermorender as tr
from scenes import write_terrain
from thermorender.errors import ThermorenderError
from thermorender.render.geometry import Geometry
from thermorender.render.regions import region
from thermorender.render.variant import activate
from thermorender.scene.surface import bare

ROOF, WALL = 1, 2


def houses():
    """A surface with two gabled houses, 20 m apart: each has two slopes that meet at the ridge, and two walls below the
    eaves. Each of the eight rectangles has an island of 8 × 8 texels, in shuffled order, with a border between.
    """
    corners, kind = [], []
    for east in (0.0, 20.0):
        for side in (-1.0, 1.0):
            eave, ridge = [east + 3.0 * side, 0.0, 3.0], [east, 0.0, 5.0]
            foot = [east + 3.0 * side, 0.0, 0.0]
            for low, high, of in ((eave, ridge, ROOF), (foot, eave, WALL)):
                far = [np.add(each, [0.0, 8.0, 0.0]) for each in (high, low)]
                corners.append([low, high, *far])
                kind.append(of)
    order = np.random.default_rng(3).permutation(8)
    uv = np.zeros((16, 3, 2), np.float32)
    material = np.zeros((20, 40), np.uint8)
    owner = np.full((20, 40), -1)
    for number, place in enumerate(order):
        row, column = 10 * (place // 4) + 1, 10 * (place % 4) + 1
        material[row : row + 8, column : column + 8] = kind[number]
        owner[row : row + 8, column : column + 8] = number
        square = np.array([[0, 0], [0, 8], [8, 8], [8, 0]])[:, ::-1] + (column, row)
        for half, own in enumerate(((0, 1, 2), (0, 2, 3))):
            uv[2 * number + half] = square[list(own)] / (40.0, 20.0)
    vertices = np.array(corners).reshape(-1, 3)
    first = 4 * np.arange(8)[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.int32)
    surface = bare("houses", vertices, faces, uv, material.shape, 1.0)
    return surface, material, owner


def test_a_roof_is_connected_across_its_ridge_and_all_roofs_are_alike():
    surface, material, owner = houses()
    geometry = Geometry(activate("cpu"), (surface,))
    # Rectangles 0 and 2 are the slopes of the first house, 1 and 3 its walls.
    for start, own, every in ((0, {0, 2}, {0, 2, 4, 6}), (6, {4, 6}, {0, 2, 4, 6}), (3, {3}, {1, 3, 5, 7})):
        texel = int(np.flatnonzero(owner.ravel() == start)[20])
        found = region(geometry, material.ravel(), texel)
        np.testing.assert_array_equal(found, np.flatnonzero(np.isin(owner.ravel(), list(own))))
        found = region(geometry, material.ravel(), texel, alike=True)
        np.testing.assert_array_equal(found, np.flatnonzero(np.isin(owner.ravel(), list(every))))


def test_a_roof_of_the_material_of_its_walls_is_connected_with_them_but_not_alike():
    surface, _, owner = houses()
    geometry, one = Geometry(activate("cpu"), (surface,)), np.ones(owner.size, np.uint8)
    texel = int(np.flatnonzero(owner.ravel() == 0)[20])
    for alike, own in ((False, [0, 1, 2, 3]), (True, [0, 2, 4, 6])):
        found = np.zeros(owner.size, bool)
        found[region(geometry, one, texel, alike)] = True
        found = found.reshape(owner.shape)
        np.testing.assert_array_equal(found[owner >= 0], np.isin(owner, own)[owner >= 0])
        # Texels beside the islands, of which the edge of a face shows a part.
        rim = binary_dilation(np.isin(owner, own), np.ones((3, 3))) & (owner < 0)
        assert found[rim].all() and not found[~rim & (owner < 0)].any()


def test_an_area_of_a_raster_is_connected_by_the_sides_of_its_texels(tmp_path):
    classes = np.ones((32, 32), int)
    classes[4:9, 4:9] = classes[9:14, 9:14] = 2  # They meet at a corner only.
    renderer = tr.Renderer(tr.load_scene(write_terrain(tmp_path / "tiny", classes=classes)), "fast")
    found = renderer.region(5 * 32 + 5)
    rows, columns = np.divmod(found, 32)
    assert len(found) == 25 and rows.max() == 8 and columns.max() == 8
    assert len(renderer.region(5 * 32 + 5, alike=True)) == 50
    with pytest.raises(ThermorenderError, match=r"texel=1024 is not allowed; give one of 0 … 1023"):
        renderer.region(1024)
