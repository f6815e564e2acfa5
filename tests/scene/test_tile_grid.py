"""Tiles: they cover the ground once, are fine where a camera of the cell may look, and depend on the cell alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thermorender.scene.tile_grid import APRON, Tile, TileGrid, cell_of

GRID = TileGrid("a map", 0.0, 0.0, 0.25, 64, 10)
WITHIN = 3000.0, -52000.0, 51000.0, -4000.0
# Of a lens of 19 mm on pixels of 17 µm, 640 × 512.
SLOPE, HALF = 17e-3 / 19.0, (320 * 17e-3 / 19.0, 256 * 17e-3 / 19.0)


def pose(random, height=None):
    """A place over the ground and a rotation, drawn; columns are right, down, forward."""
    up = height or float(np.exp(random.uniform(np.log(30.0), np.log(5000.0))))
    yaw, pitch, roll = random.uniform(-180.0, 180.0), random.uniform(-90.0, 5.0), random.uniform(-15.0, 15.0)
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    turn = Rotation.from_euler("zxz", [yaw, pitch, 0.0], degrees=True).as_matrix() @ level
    turn = turn @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    return np.array([*random.uniform(10000.0, 40000.0, 2) * (1, -1), up]), turn


def tiles_at(place, turn):
    cell = cell_of(place, turn, place[2], HALF)
    return cell, sorted(GRID.chosen(cell, SLOPE, lambda bounds: (0.0, 0.0), WITHIN))


@pytest.mark.parametrize("seed", range(6))
def test_tiles_cover_the_ground_once(seed):
    _, tiles = tiles_at(*pose(np.random.default_rng(seed)))
    assert len(set(tiles)) == len(tiles)
    for one in tiles:
        for level in range(one.level + 1, GRID.levels):
            up = level - one.level
            assert Tile(level, one.row >> up, one.column >> up) not in tiles
    finest = sum(4**tile.level for tile in tiles)
    left, bottom, right, top = (int(np.floor(each / GRID.side(0))) for each in WITHIN)
    assert finest >= (right - left) * (top - bottom)


@pytest.mark.parametrize("seed", range(12))
def test_every_ray_of_every_pose_of_a_cell_meets_a_tile_much_finer_than_its_pixel(seed):
    """A pixel on level ground holds 16 texels, and is 2.8 texels wide at least."""
    random = np.random.default_rng(seed)
    place, turn = pose(random)
    cell, tiles = tiles_at(place, turn)
    found = {tile: GRID.bounds(tile) for tile in tiles}
    met = 0
    low, high = np.array(cell.low), np.array(cell.high)
    for _ in range(600):
        other = low + random.uniform(0.0, 1.0, 3) * (high - low)
        axes = Rotation.from_rotvec(random.normal(0.0, 0.02, 3)).as_matrix() @ turn
        if other[2] < 1.0 or cell_of(other, axes, place[2], HALF) != cell:
            continue
        ray = axes @ np.array([*random.uniform(-1.0, 1.0, 2) * HALF, 1.0])
        if ray[2] > -1e-3:
            continue
        distance = -other[2] / ray[2]
        x, y, _ = other + distance * ray
        if not (WITHIN[0] < x < WITHIN[2] and WITHIN[1] < y < WITHIN[3]):
            continue
        (tile,) = [one for one, box in found.items() if box[0] <= x < box[2] and box[1] < y <= box[3]]
        met += 1
        texel, wide = 0.25 * 2**tile.level, SLOPE * distance * np.linalg.norm(ray)
        sine = -ray[2] / np.linalg.norm(ray)
        assert tile.level == 0 or 1.0001 * wide**2 / sine >= 16.0 * texel**2
        assert tile.level == 0 or 1.0001 * wide >= 8.0**0.5 * texel
    assert met > 5 or turn[2, 2] > -0.3


@pytest.mark.parametrize("seed", range(4))
def test_poses_of_one_cell_have_the_same_tiles(seed):
    random = np.random.default_rng(seed)
    place, turn = pose(random)
    cell, tiles = tiles_at(place, turn)
    low, high = np.array(cell.low), np.array(cell.high)
    for _ in range(5):
        other = low + random.uniform(0.01, 0.99, 3) * (high - low)
        # The height above ground decides how large a cell is.
        assert cell_of(other, turn, place[2], HALF) == cell
    assert tiles == sorted(GRID.chosen(cell, SLOPE, lambda bounds: (0.0, 0.0), WITHIN))


def test_posts_and_texels_of_neighbours_are_the_same_places():
    one, other = Tile(3, 5, 7), Tile(3, 5, 8)
    first, second = GRID.posts(one), GRID.posts(other)
    np.testing.assert_allclose(first.to_map(64.5, 10.5), second.to_map(0.5, 10.5))
    first, second = GRID.texel_grid(one), GRID.texel_grid(other)
    np.testing.assert_allclose(first.to_map(APRON + 512, 3.0), second.to_map(APRON, 3.0))
    assert GRID.posts(one, 4, 1).height == 4 * 64 + 3


def test_a_tile_of_the_next_level_covers_its_four():
    box = GRID.bounds(Tile(4, 2, 3))
    below = np.array([GRID.bounds(tile) for tile in Tile(4, 2, 3).below()])
    np.testing.assert_allclose([below[:, 0].min(), below[:, 1].min(), below[:, 2].max(), below[:, 3].max()], box)
