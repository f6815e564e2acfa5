"""Sources of tiles: files in pieces read like one, finer files before coarser ones, and nothing beyond a window."""

import numpy as np
import pytest
from rasterio import Affine

from scenes import write_raster
from thermorender.errors import ThermorenderError
from thermorender.scene.raster import Grid, grid_of
from thermorender.scene.sources import Classes, Colours, Heights, rasters_of

CORNER = 500000.0, 5780000.0


def pieces(folder, bands, step, sizes=(130, 170), **options):
    """Write rasters of (bands, h, w) cut into pieces, and return their folder."""
    folder.mkdir()
    for top in range(0, bands.shape[1], sizes[0]):
        for left in range(0, bands.shape[2], sizes[1]):
            part = bands[:, top : top + sizes[0], left : left + sizes[1]]
            corner = CORNER[0] + left * step, CORNER[1] - top * step
            write_raster(folder / f"{top}_{left}.tif", part, step, corner=corner, **options)
    return folder


def part_of(source, pixel, first, count):
    """A grid of `count`² pixels from `first` (column, row) metres of the corner on."""
    corner = CORNER[0] + first[0], CORNER[1] - first[1]
    return Grid(source.extent.crs, Affine(pixel, 0.0, corner[0], 0.0, -pixel, corner[1]), count, count)


@pytest.mark.parametrize("pixel", [1.0, 1.7, 2.0, 4.0, 16.0])
def test_heights_in_pieces_are_those_of_one_file(tmp_path, pixel):
    height = np.random.default_rng(0).normal(100.0, 20.0, (1, 400, 400)).astype(np.float32)
    height[:, 40:44, 60:90] = np.nan
    whole = Heights([write_raster(tmp_path / "whole.tif", height, nodata=np.nan)])
    split = Heights(rasters_of(pieces(tmp_path / "pieces", height, 1.0, nodata=np.nan)))
    grid = part_of(whole, pixel, (7.5, 9.5), int(360 / pixel))
    one, other = whole.read(grid), split.read(grid)
    # Means of a square that two files share are sums in another order.
    np.testing.assert_allclose(other, one, atol=2e-5 if pixel > 1.7 else 0.0)
    assert len(split.layers) == 1


def test_means_of_squares_are_those_of_their_pixels(tmp_path):
    height = np.random.default_rng(1).normal(0.0, 20.0, (1, 64, 64)).astype(np.float32)
    source = Heights([write_raster(tmp_path / "dem.tif", height)])
    found = source.read(part_of(source, 4.0, (0.0, 0.0), 16))
    np.testing.assert_allclose(found, height[0].reshape(16, 4, 16, 4).mean(axis=(1, 3)), atol=1e-5)


def test_colours_and_classes_in_pieces_are_those_of_one_file(tmp_path):
    random = np.random.default_rng(2)
    rgb, number = random.integers(1, 250, (3, 300, 300)).astype(np.uint8), random.integers(1, 5, (1, 300, 300))
    number = number.astype(np.uint8)
    grids = []
    for kind, bands, options in ((Colours, rgb, {"photometric": "RGB"}), (Classes, number, {})):
        whole = kind([write_raster(tmp_path / f"{kind.__name__}.tif", bands, 0.5, **options)])
        split = kind(rasters_of(pieces(tmp_path / kind.__name__, bands, 0.5, **options)))
        grids.append(part_of(whole, 0.5, (11.0, 23.5), 200))
        one, other = whole.read(grids[-1]), split.read(grids[-1])
        np.testing.assert_array_equal(one[0] if kind is Colours else one, other[0] if kind is Colours else other)
    np.testing.assert_array_equal(one, number[0, 47:247, 22:222])


def test_the_finer_file_counts_where_it_has_a_value(tmp_path):
    write_raster(tmp_path / "a_coarse.tif", np.full((1, 50, 50), 10.0, np.float32), 4.0)
    fine = np.full((1, 40, 40), 20.0, np.float32)
    fine[:, :, 20:] = np.nan
    write_raster(tmp_path / "fine.tif", fine, 1.0, corner=(CORNER[0] + 80.0, CORNER[1] - 80.0), nodata=np.nan)
    source = Heights(rasters_of(tmp_path))
    found = source.read(part_of(source, 1.0, (60.0, 60.0), 80))
    assert source.extent.pixel == 1.0
    assert np.isclose(found[20:60, 20:40], 20.0).all() and np.isclose(found[20:60, 40:60], 10.0).all()
    assert np.isclose(found[:20], 10.0).all() and np.isfinite(found).all()


def test_files_beside_a_window_are_not_read(tmp_path):
    height = np.zeros((1, 400, 400), np.float32)
    source = Heights(rasters_of(pieces(tmp_path / "pieces", height, 1.0)))
    grid = part_of(source, 1.0, (10.0, 10.0), 64)
    broken = tmp_path / "pieces" / "260_340.tif"
    broken.write_bytes(broken.read_bytes()[:200])
    assert (source.read(grid) == 0.0).all()
    with pytest.raises(ThermorenderError, match="260_340"):
        source.read(part_of(source, 1.0, (330.0, 250.0), 64))


def test_the_fingerprint_follows_the_files_and_the_geoid(tmp_path):
    path = write_raster(tmp_path / "dem.tif", np.zeros((1, 8, 8), np.float32))
    before = Heights([path]).digest()
    assert Heights([path], 40.0).digest() != before
    write_raster(path, np.ones((1, 9, 8), np.float32))
    assert Heights([path]).digest() != before


def test_a_grid_of_degrees_is_read_onto_a_map_of_metres(tmp_path):
    from rasterio.warp import transform

    (x,), (y,) = transform("EPSG:32634", "EPSG:4326", [500200.0], [5779800.0])
    degrees = write_raster(tmp_path / "wide.tif", np.full((1, 200, 200), 7.0, np.float32), 1e-4, "EPSG:4326",
                           (x - 0.01, y + 0.01))  # fmt: skip
    metres = write_raster(tmp_path / "near.tif", np.full((1, 50, 50), 9.0, np.float32), 1.0)
    source = Heights([degrees, metres])
    assert source.extent.crs == grid_of(metres).crs
    found = source.read(part_of(source, 1.0, (0.0, 0.0), 100))
    assert np.isclose(found[:49, :49], 9.0).all() and np.isclose(found[52:, 52:], 7.0).all()
