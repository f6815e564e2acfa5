"""What is a building in a surface model alone, and what is the edge of a terrace or a wood."""

import numpy as np
import pytest
from rasterio import Affine
from scipy.ndimage import binary_opening

from thermorender.apps.lands.solids import detection
from thermorender.scene.raster import Grid

POST_M, SIDE = 0.8, 120
NORTH, EAST = (POST_M * each for each in np.mgrid[:SIDE, :SIDE][:, ::-1])
# A terrace rises 15 % towards its edge, which is a wall of 4.5 m above level ground; its flanks fall by 20 %.
ALONG = np.abs(EAST - 48.0)
TERRACE = np.where(
    NORTH > 40.0, np.maximum(4.5 - 0.15 * (NORTH - 40.0) - 0.2 * np.maximum(ALONG - 10.0, 0.0), 0.0), 0.0
)


def house(low_m, high_m, north_m=64.0):
    """Heights of the terrace with a house of 12 by 9 m, and its posts."""
    covered = (np.abs(EAST - 48.0) < 6.0) & (np.abs(NORTH - north_m) < 4.5)
    return np.where(covered, low_m + high_m, TERRACE), covered


def covered_by(outlines):
    row, column = np.mgrid[:SIDE, :SIDE] + 0.5
    points = np.column_stack([column.ravel(), row.ravel()])
    made = np.zeros(SIDE * SIDE, bool)
    for each in outlines:
        made |= detection.even_odd(points, each.rings)
    return made.reshape(SIDE, SIDE)


def test_the_edge_of_a_terrace_is_ground_and_no_building():
    bare = detection.ground_below(TERRACE, POST_M)
    assert detection.outlines_by_height(TERRACE, bare, POST_M) == []
    # The filter alone takes up to 3.75 m from 200 posts; a fringe of lower posts than LEAST_M remains.
    assert (TERRACE - bare > detection.LEAST_M).sum() < 10
    assert np.abs(TERRACE - bare)[(NORTH > 40.5) & (NORTH < 48.0) & (ALONG < 8.0)].max() < 0.1


@pytest.mark.parametrize("north_m", [20.0, 64.0])
def test_a_house_below_or_on_a_terrace_is_a_building(north_m):
    height, covered = house(float(TERRACE[np.abs(NORTH - north_m) < 4.5].max()), 5.0, north_m)
    bare = detection.ground_below(height, POST_M)
    outlines = detection.outlines_by_height(height, bare, POST_M)
    assert len(outlines) == 1
    assert (covered_by(outlines) ^ covered).sum() < 0.15 * covered.sum()


def test_a_house_dug_into_a_slope_is_a_building():
    """Its roof continues the slope behind it, and its three other sides are walls of 5 m."""
    height, covered = house(0.0, 5.0, 20.0)
    height = np.where(NORTH >= 24.5, 5.0 + 0.1 * (NORTH - 24.5), height)
    bare = detection.ground_below(height, POST_M)
    made = covered_by(detection.outlines_by_height(height, bare, POST_M))
    # The filtered ground falls from 5 m behind it to 0 m in front, so that 60 % of it are LEAST_M above the ground.
    assert (made & covered).sum() > 0.6 * covered.sum() and (made & ~covered).sum() < 0.05 * covered.sum()


def test_a_wood_as_smooth_as_a_roof_is_told_by_its_colour():
    height, covered = house(0.0, 5.0, 20.0)
    grid = Grid(None, Affine(POST_M, 0.0, 0.0, 0.0, -POST_M, 0.0), SIDE, SIDE)
    bare = detection.ground_below(height, POST_M)
    for colour, count in (((70, 96, 52), 0), ((120, 120, 118), 1), ((150, 90, 70), 1), ((90, 190, 205), 1)):
        rgb = np.full((SIDE, SIDE, 3), 130, np.uint8)
        rgb[covered] = colour
        green = detection.is_green(rgb, np.ones((SIDE, SIDE), bool), grid, grid)
        assert len(detection.outlines_by_height(height, bare, POST_M, green)) == count


@pytest.mark.parametrize(("width", "count"), [(0, 0), (1, 1), (2, 1), (4, 1)])
def test_a_narrow_tree_that_stands_alone_is_a_tree_and_the_fringe_of_a_house_is_not(width, count):
    above, taken = np.zeros((30, 30)), np.zeros((30, 30), bool)
    taken[4:12, 4:14] = True
    above[4:12, 14] = 4.0
    above[20 : 20 + width, 20 : 20 + width] = 6.0
    trees = detection.trees_in(above, taken, 1.0)
    assert len(trees) == count
    assert all((tree.posts >= 20).all() and len(tree.posts) == width**2 and tree.height_m == 6.0 for tree in trees)
    # A pole of a quarter of a metre is not a tree.
    assert width != 1 or detection.trees_in(above, taken, 0.25) == []


def test_each_post_of_a_wood_belongs_to_a_crown():
    """Crowns of uneven heights beside each other, whose edges are lower than their neighbours' gaps."""
    draw = np.random.default_rng(1)
    row, column = np.mgrid[:60, :60].astype(float)
    above = np.zeros((60, 60))
    for _ in range(40):
        at, high = draw.uniform(12.0, 48.0, 2), draw.uniform(3.0, 16.0)
        above = np.maximum(above, high * (1.0 - ((row - at[0]) ** 2 + (column - at[1]) ** 2) / 36.0))
    above += draw.uniform(0.0, 1.0, above.shape) * (above > detection.LEAST_M)
    wood = binary_opening(above > detection.LEAST_M, np.ones((3, 3)))
    trees = detection.trees_in(above, np.zeros(above.shape, bool), 1.0)
    posts = np.concatenate([tree.posts for tree in trees])
    assert len(np.unique(posts, axis=0)) == len(posts)
    missing = wood.copy()
    missing[posts[:, 0], posts[:, 1]] = False
    assert not missing.any() and len(trees) > 5
