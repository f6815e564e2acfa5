"""Imports of tiles: the files stay as they are, in a folder that holds all of the scene."""

import os
import re
import shutil

import numpy as np
import pytest
from rasterio import Affine

import thermorender as tr
from scenes import write_raster
from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.apps.lands.import_tiles import import_tiles
from thermorender.errors import ThermorenderError
from thermorender.scene.raster import Grid

CORNER = 500000.0, 5780000.0


@pytest.fixture
def rasters(tmp_path):
    """Folders of heights and pictures in two pieces each."""
    for name in ("dem", "photo"):
        (tmp_path / name).mkdir()
    height = np.random.default_rng(0).uniform(10.0, 14.0, (1, 64, 64)).astype(np.float32)
    colour = np.random.default_rng(1).integers(1, 250, (3, 256, 256)).astype(np.uint8)
    for k in (0, 1):
        write_raster(tmp_path / "dem" / f"{k}.tif", height[:, :, 32 * k : 32 * k + 32], 1.0,
                     corner=(CORNER[0] + 32.0 * k, CORNER[1]))  # fmt: skip
        write_raster(tmp_path / "photo" / f"{k}.tif", colour[:, :, 128 * k : 128 * k + 128], 0.25,
                     corner=(CORNER[0] + 32.0 * k, CORNER[1]), photometric="RGB")  # fmt: skip
    return tmp_path


def test_an_import_links_the_files_and_loads(rasters):
    made = import_tiles(rasters / "dem", rasters / "photo", rasters / "scene", ImportSettings())
    assert made["side_m"] == (64.0, 64.0) and made["texel_m"] == 0.25
    for name, own in (("dem", "elevation"), ("photo", "orthophoto")):
        for path in (rasters / name).iterdir():
            assert os.path.samefile(path, rasters / "scene" / own / path.name)
    scene = tr.load_scene(rasters / "scene")
    assert scene.texel_m == 0.25
    path = tr.load_trajectory(rasters / "scene" / "flight.csv", scene)
    assert np.isfinite(path.above_ground(scene.ground)).all()


def test_single_files_are_imported_too(rasters):
    import_tiles(rasters / "dem" / "0.tif", rasters / "photo" / "0.tif", rasters / "scene", ImportSettings())
    assert tr.load_scene(rasters / "scene").world.within == (500000.0, 5779936.0, 500032.0, 5780000.0)


@pytest.mark.parametrize(("name", "value"), [("fill", True), ("bands", "1,2,3"), ("far", ["a.tif"]), ("collar", 3)])
def test_options_that_change_rasters_are_refused(rasters, name, value):
    with pytest.raises(ThermorenderError, match=name):
        import_tiles(rasters / "dem", rasters / "photo", rasters / "scene", ImportSettings(**{name: value}))
    assert not (rasters / "scene").exists()


def test_nothing_is_left_of_an_import_that_fails(rasters):
    write_raster(rasters / "photo" / "other.tif", np.zeros((2, 8, 8), np.uint8))
    with pytest.raises(ThermorenderError, match=r"other\.tif"):
        import_tiles(rasters / "dem", rasters / "photo", rasters / "scene", ImportSettings())
    assert not (rasters / "scene").exists()


VRT = """<VRTDataset rasterXSize="64" rasterYSize="64">
  <GeoTransform> 5.0e+05, 1.0, 0.0, 5.78e+06, 0.0, -1.0</GeoTransform>
  <VRTRasterBand dataType="Float32" band="1">
    {band}
    {sources}
  </VRTRasterBand>
</VRTDataset>
"""
SOURCE = """<ComplexSource>
      <SourceFilename relativeToVRT="1">dem/{k}.tif</SourceFilename>
      <SourceBand>{number}</SourceBand>
      <SrcRect xOff="0" yOff="0" xSize="32" ySize="64" />
      <DstRect xOff="{left}" yOff="0" xSize="32" ySize="64" />
      {more}
    </ComplexSource>"""


def mosaic(band="", more="", number=1, left=32):
    """A virtual mosaic of both heights, as gdalbuildvrt writes it."""
    rows = [SOURCE.format(k=0, number=number, left=0, more=more), SOURCE.format(k=1, number=1, left=left, more="")]
    return VRT.format(band=band, sources="".join(rows))


def test_a_virtual_mosaic_stands_for_its_files(rasters):
    (rasters / "dem.vrt").write_text(mosaic())
    import_tiles(rasters / "dem.vrt", rasters / "photo", rasters / "scene", ImportSettings())
    for path in (rasters / "dem").iterdir():
        assert os.path.samefile(path, rasters / "scene" / "elevation" / path.name)
    assert tr.load_scene(rasters / "scene").world.within == (500000.0, 5779936.0, 500064.0, 5780000.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (mosaic(band="<NoDataValue>0</NoDataValue>"), "states NoDataValue = 0"),
        (mosaic(more="<NODATA>12</NODATA>"), "states NODATA = 12"),
        (mosaic(band="<UnitType>ft</UnitType>"), "states UnitType = ft"),
        (mosaic(more="<ScaleRatio>2</ScaleRatio>"), "by ScaleRatio"),
        (mosaic(number=2), "takes band 2"),
        (mosaic().replace("<GeoT", "<SRS>EPSG:32633</SRS><GeoT"), r"another CRS than 0\.tif"),
        (mosaic(left=30), r"moves, cuts or turns 1\.tif"),
        (mosaic().replace("5.0e+05, 1.0, 0.0,", "5.0e+05, 1.0, 0.1,"), r"moves, cuts or turns 0\.tif"),
        (mosaic().replace('<SrcRect xOff="0" yOff="0" xSize="32"', '<SrcRect xOff="0" yOff="0" xSize="4"'), "cuts"),
        (re.sub("<DstRect.*/>", "", mosaic()), "cuts"),
        (mosaic(band="<MaskBand/>"), "mask of its own"),
        (mosaic(band="<ColorInterp>Red</ColorInterp>"), "ColorInterp = Red where"),
        (mosaic().replace('"Float32"', '"Int16"'), "the type Int16"),
        (mosaic().replace("dem/1.tif", "dem/9.tif"), r"dem/9\.tif, which is not a file on disk"),
        (mosaic().replace("dem/1.tif", "own.vrt"), r"own\.vrt, which is not of \.tif"),
        (mosaic().replace('xOff="32"', 'xOff="q"'), "is damaged"),
        (mosaic().replace("5.0e+05", "east"), "is damaged"),
        (mosaic(number=7).replace('band="1"', 'band="7"'), "is damaged|as band"),
        (mosaic().replace("<GeoT", "<SRS>nonsense</SRS><GeoT"), "is damaged"),
        (mosaic().replace("<VRTDataset", '<VRTDataset subClass="VRTWarpedDataset"'), "VRTWarpedDataset"),
        (mosaic().replace("ComplexSource", "KernelFilteredSource"), "has a KernelFilteredSource"),
        ("<!DOCTYPE a>" + mosaic(), "document type"),
        ("<VRTDataset>", "is not a VRT"),
        ("<VRTDataset/>", "names no raster"),
    ],
)
def test_a_virtual_mosaic_that_changes_its_files_is_refused(rasters, text, message):
    (rasters / "dem.vrt").write_text(text)
    (rasters / "own.vrt").write_text(mosaic())
    with pytest.raises(ThermorenderError, match=message):
        import_tiles(rasters / "dem.vrt", rasters / "photo", rasters / "scene", ImportSettings())
    assert not (rasters / "scene").exists()


def test_a_virtual_mosaic_takes_all_bands_of_a_picture(rasters):
    text = mosaic().replace("dem/", "photo/").replace("Float32", "Byte").replace("1.0, 0.0", "0.25, 0.0")
    text = text.replace("-1.0<", "-0.25<").replace('xSize="32" ySize="64"', 'xSize="128" ySize="256"')
    (rasters / "photo.vrt").write_text(text.replace('xOff="32"', 'xOff="128"'))
    with pytest.raises(ThermorenderError, match=r"takes 1 of the 3 bands of 0\.tif"):
        import_tiles(rasters / "dem", rasters / "photo.vrt", rasters / "scene", ImportSettings())


def test_of_rasters_on_one_another_the_last_of_a_mosaic_counts(rasters):
    # By name the second one is the last.
    high, low = rasters / "dem" / "0.tif", rasters / "dem" / "1.tif"
    for path, value in ((high, 50.0), (low, 20.0)):
        write_raster(path, np.full((1, 64, 32), value, np.float32), 1.0, corner=CORNER)
    for order, value in ((("0", "1"), 20.0), (("1", "0"), 50.0)):
        rows = [SOURCE.format(k=k, number=1, left=0, more="") for k in order]
        (rasters / "dem.vrt").write_text(VRT.format(band="", sources="".join(rows)))
        import_tiles(rasters / "dem.vrt", rasters / "photo", rasters / "scene", ImportSettings())
        heights = tr.load_scene(rasters / "scene").world.heights
        for step in (1.0, 2.0):
            size = round(32 / step)
            grid = Grid(heights.crs, Affine(step, 0.0, CORNER[0], 0.0, -step, CORNER[1]), 2 * size, size)
            assert (heights.read(grid) == value).all()
        shutil.rmtree(rasters / "scene")


def test_rasters_may_share_a_file_beside_them(rasters):
    for name in ("a", "b"):
        shutil.copy(rasters / "dem" / "0.tif", rasters / "dem" / f"LC08_{name}.TIF")
    (rasters / "dem" / "LC08_MTL.txt").write_text("GROUP = L1_METADATA_FILE\nEND_GROUP = L1_METADATA_FILE\nEND\n")
    import_tiles(rasters / "dem", rasters / "photo", rasters / "scene", ImportSettings())
    assert len(list((rasters / "scene" / "elevation").glob("*.TIF"))) == 2


def test_files_that_are_not_read_are_named(rasters):
    (rasters / "dem" / "0.tif").rename(rasters / "dem.img")
    with pytest.raises(ThermorenderError, match=r"dem\.img is not a raster that is read"):
        import_tiles(rasters / "dem.img", rasters / "photo", rasters / "scene", ImportSettings())
