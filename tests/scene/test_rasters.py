"""Rasters as the field delivers them: what a file declares is followed, or it is refused; open ground is stated."""

import struct
import warnings
import zlib

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp, Resampling
from rasterio.shutil import copy

from scenes import write_terrain
from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.scene import terrain
from thermorender.scene.load import load_scene
from thermorender.scene.orthophoto import read_colour
from thermorender.scene.raster import opened
from thermorender.scene.surface import FALLBACK, FILLED, UNKNOWN

CRS, LEFT, TOP, SIDE = "EPSG:32632", 500000.0, 5300000.0, 32.0
RED, GREEN, BLUE, NIR, NONE = (getattr(ColorInterp, name) for name in ("red", "green", "blue", "nir", "undefined"))
PLACE = {"crs": CRS, "transform": rasterio.Affine(1.0, 0.0, LEFT, 0.0, -1.0, TOP)}
GREY, ALPHA = ColorInterp.gray, ColorInterp.alpha
# A colour per quarter, so that a turned or mirrored picture differs.
QUARTERS = np.array([[(200, 60, 30), (40, 150, 70)], [(50, 80, 180), (160, 150, 140)]], np.uint8)


def rgb(side=32):
    return np.kron(np.moveaxis(QUARTERS, -1, 0), np.ones((side // 2, side // 2), np.uint8))


def write(path, bands, colours=None, words=None, units=None, scale=None, mask=None, transform=None, **profile):
    bands = np.asarray(bands)
    bands = bands[None] if bands.ndim == 2 else bands
    step = SIDE / bands.shape[1]
    transform = transform or rasterio.Affine(step, 0.0, LEFT, 0.0, -step, TOP)
    profile = {"driver": "GTiff", "crs": CRS, "dtype": bands.dtype, "count": len(bands)} | profile
    if colours and colours[0] != RED:
        profile["photometric"] = "MINISBLACK"
    with rasterio.open(
        path, "w", height=bands.shape[1], width=bands.shape[2], transform=transform, **profile
    ) as file:  # fmt: skip
        file.write(bands)
        if colours:
            file.colorinterp = colours
        if words:
            file.descriptions = words
        if units:
            file.units = (units,)
        if scale:
            file.scales, file.offsets = (scale[0],) * len(bands), (scale[1],) * len(bands)
        if mask is not None:
            file.write_mask(mask)
    return path


def scene_of(folder, orthophoto, **settings):
    height = 100.0 + np.arange(256.0, dtype=np.float32).reshape(16, 16) / 64.0
    write(folder / "dem.tif", height)
    import_terrain(folder / "dem.tif", orthophoto, folder / "s", ImportSettings(**settings))
    return load_scene(folder / "s")


# --- colours ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "order, colours, words",
    [
        ((2, 1, 0), (BLUE, GREEN, RED), None),
        ((1, 2, 0), (GREEN, BLUE, RED), None),
        ((2, 1, 0, 0), (BLUE, GREEN, RED, NIR), None),
        ((0, 2, 1, 0), (NIR, BLUE, GREEN, RED), None),
        ((2, 1, 0, 0), (GREY, NONE, NONE, NONE), ("Blue", "Green", "Red", "NIR")),
    ],
)
def test_bands_follow_their_declared_colours(tmp_path, order, colours, words):
    write(tmp_path / "o.tif", rgb()[list(order)], colours, words)
    found, valid = read_colour(tmp_path / "o.tif")
    np.testing.assert_array_equal(found, np.moveaxis(rgb(), 0, -1))
    assert valid.all()


def test_bands_without_declared_colours_are_refused_and_may_be_stated(tmp_path, call):
    path = write(tmp_path / "o.tif", rgb()[[2, 1, 0]], (GREY, NONE, NONE))
    with pytest.raises(ThermorenderError, match=r"does not declare which of its 3 bands.*give --bands RED,GREEN,BLUE"):
        read_colour(path)
    write(tmp_path / "dem.tif", np.full((16, 16), 100.0, np.float32))
    status, _, errors = call("import-terrain", tmp_path / "dem.tif", path, "--bands=3,2,1", "-o", tmp_path / "s")
    assert (status, errors) == (0, "")
    np.testing.assert_array_equal(read_colour(tmp_path / "s" / "orthophoto.tif")[0], np.moveaxis(rgb(), 0, -1))
    with pytest.raises(ThermorenderError, match=r"bands=1,2,4 .* are not allowed"):
        read_colour(path, (1, 2, 4))
    with rasterio.open(path, "r+") as file:  # as the message advises with rio
        file.colorinterp = (BLUE, GREEN, RED)
    np.testing.assert_array_equal(read_colour(path)[0], np.moveaxis(rgb(), 0, -1))


def test_names_that_contradict_the_colours_are_refused(tmp_path):
    path = write(tmp_path / "o.tif", rgb(), (RED, GREEN, BLUE), ("blue", "green", "red"))
    with pytest.raises(ThermorenderError, match="contradicts itself: red, green and blue are band 1, band 2, band 3"):
        read_colour(path)


def overstated(path):
    """A small picture whose header states 13000² pixels, for which arrays would take 0.7 GB and more."""
    from PIL import Image

    Image.fromarray(np.moveaxis(rgb(), 0, -1)).save(path)
    data = bytearray(path.read_bytes())
    # Width and height follow the name of PNG's first chunk, and the precision of JPEG's frame, height first.
    png = path.suffix == ".png"
    at, form = (data.index(b"IHDR") + 4, ">II") if png else (data.index(b"\xff\xc0") + 5, ">HH")
    struct.pack_into(form, data, at, 13000, 13000)
    if png:
        struct.pack_into(">I", data, at + 13, zlib.crc32(data[at - 4 : at + 13]))
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_more_pixels_than_the_bytes_of_a_picture_hold_are_refused_before_they_are_read(tmp_path, name):
    from thermorender import formats
    from thermorender.apps.training.pictures import read_thermal
    from thermorender.apps.training.translate import read_picture

    path = overstated(tmp_path / name)
    with pytest.raises(ThermorenderError, match="states 169000000 pixels in 3 bands, for which it has too few bytes"):
        read_colour(path)
    with pytest.raises(ThermorenderError, match="is not a readable picture"):
        read_thermal(path, (0.04, 0.0))
    with pytest.raises(ThermorenderError, match="has too few bytes for its 13000×13000 pixels"):
        read_picture(path)
    assert formats.decoded(path.read_bytes(), -1) is None


@pytest.mark.parametrize(
    ("size", "stated"),
    [((1, 30000, 10000), "300000000 pixels,"), ((3000, 300, 10000), "3000000 pixels in 3000 bands,")],
)
def test_a_raster_of_a_few_bytes_that_states_many_values_is_refused_before_it_is_read(tmp_path, size, stated):
    path, (bands, height, width) = tmp_path / "a.tif", size
    options = {"count": bands, "height": height, "width": width, "dtype": "uint8", "SPARSE_OK": True}
    with rasterio.open(path, "w", driver="GTiff", blockysize=height, interleave="pixel", **PLACE, **options):
        pass
    with pytest.raises(ThermorenderError, match=f"states {stated} for which it has too few bytes"):
        read_colour(path)


def test_a_constant_in_the_best_compression_is_opened(tmp_path):
    path, side = tmp_path / "a.tif", 8192
    options = {"compress": "lerc_zstd", "tiled": True, "blockxsize": side, "blockysize": side, "dtype": "uint8"}
    with rasterio.open(path, "w", driver="GTiff", width=side, height=side, count=1, **PLACE, **options) as dataset:
        dataset.write(np.full((1, side, side), 3, np.uint8))
    assert path.stat().st_size < side**2 / 5e4
    with opened(path) as dataset:
        assert dataset.width == side


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_the_most_compressed_pictures_are_read(tmp_path, name):
    from PIL import Image

    Image.new("RGB", (4000, 4000), (90, 120, 60)).save(tmp_path / name, optimize=True, progressive=True)
    assert read_colour(tmp_path / name)[0].shape == (4000, 4000, 3)


def test_a_palette_is_followed_and_grey_refused(tmp_path):
    index = np.kron(np.array([[5, 7], [9, 11]], np.uint8), np.ones((16, 16), np.uint8))
    path = write(tmp_path / "o.tif", index, nodata=11)
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {number: (*QUARTERS.reshape(4, 3)[k], 255) for k, number in enumerate((5, 7, 9, 11))})
    found, valid = read_colour(path)
    np.testing.assert_array_equal(found[valid], np.moveaxis(rgb(), 0, -1)[valid])
    np.testing.assert_array_equal(valid, index != 11)
    with pytest.raises(ThermorenderError, match=r"has 1 bands of uint8 \(gray\).*red, green and blue"):
        read_colour(write(tmp_path / "g.tif", index))


def test_alpha_nodata_and_masks_are_holes(tmp_path):
    """Also a mask beside the file, and alpha with the noise of lossy compression."""
    known = np.ones((32, 32), bool)
    known[8:12, 8:20] = False
    alpha = np.where(known, 250, 3).astype(np.uint8)
    grey = np.where(known, rgb(), 7).astype(np.uint8)
    files = [write(tmp_path / "a.tif", np.concatenate([rgb(), alpha[None]]), (RED, GREEN, BLUE, ALPHA)),
             write(tmp_path / "n.tif", grey, nodata=7)]  # fmt: skip
    for inside in (True, False):
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=inside):
            files.append(write(tmp_path / f"m{inside}.tif", rgb(), mask=known))
    assert (tmp_path / "mFalse.tif.msk").exists() and not (tmp_path / "mTrue.tif.msk").exists()
    for path in files:
        np.testing.assert_array_equal(read_colour(path)[1], known, err_msg=path.name)


def test_near_infrared_declared_as_alpha_is_refused(tmp_path):
    """GDAL declares the fourth band of bytes alpha, whatever it holds."""
    near_infrared = np.random.default_rng(0).integers(40, 200, (1, 32, 32), np.uint8)
    path = write(tmp_path / "o.tif", np.concatenate([rgb(), near_infrared]))
    with pytest.raises(ThermorenderError, match="declares band 4 as alpha, but 100% of it is half transparent"):
        read_colour(path)


@pytest.mark.parametrize(
    "kind, factor, scale, ends",
    [("uint16", 16.0, None, (0, 4080)), ("float32", 1.0 / 255.0, None, (0.0, 1.0)), ("int16", 16.0, None, (0, 4080)),
     ("uint16", 10.0, (0.1, 0.0), (0.0, 255.0)), ("uint8", 1.0, (2.0, 10.0), (10.0, 520.0))],
)  # fmt: skip
def test_other_than_8_bits_need_the_values_of_black_and_white(tmp_path, kind, factor, scale, ends):
    path = write(tmp_path / "o.tif", (rgb() * factor).astype(kind), (RED, GREEN, BLUE), scale=scale, photometric="RGB")
    with pytest.raises(ThermorenderError, match=f"of {kind} that hold .* give --colour-range BLACK,WHITE"):
        read_colour(path)
    found, _ = read_colour(path, colour_range=ends)
    np.testing.assert_array_equal(found, np.moveaxis(rgb(), 0, -1))
    with pytest.raises(ThermorenderError, match="give black below white"):
        read_colour(path, colour_range=ends[::-1])


@pytest.mark.parametrize("level", [3, 252])
def test_collars_are_named_and_left_out_on_request(tmp_path, call, level):
    picture = rgb()
    picture[:, :, :4] = level + np.random.default_rng(1).integers(-3, 4, (3, 32, 4))
    write(tmp_path / "o.tif", picture)
    write(tmp_path / "dem.tif", np.full((16, 16), 100.0, np.float32))
    asked = ("import-terrain", tmp_path / "dem.tif", tmp_path / "o.tif", "-o")
    status, output, errors = call(*asked, tmp_path / "a")
    assert status == 0 and "12.5% of the orthophoto is near black or white" in errors and "--collar=15" in errors
    assert "0.0% without colour" in output
    status, output, errors = call(*asked, tmp_path / "b", "--collar=15")
    assert (status, errors) == (0, "") and "12.5% without colour" in output


def test_a_small_collar_is_not_a_share_of_zero(tmp_path, call):
    picture = np.tile(rgb(), (1, 10, 10))
    picture[:, 0, :64] = 3
    write(tmp_path / "o.tif", picture)
    write(tmp_path / "dem.tif", np.full((16, 16), 100.0, np.float32))
    status, _, errors = call("import-terrain", tmp_path / "dem.tif", tmp_path / "o.tif", "-o", tmp_path / "a")
    assert status == 0 and "less than 0.1% of the orthophoto is near black or white" in errors


@pytest.mark.parametrize("most", [24, 11], ids=["bilinear", "average"])
def test_empty_pixels_do_not_bleed_into_their_neighbours(tmp_path, most):
    known = np.ones((32, 32), bool)
    known[10:20, 10:20] = False
    one = np.where(known, np.array([200, 90, 40], np.uint8)[:, None, None], 0)
    path = write(tmp_path / "o.tif", one, mask=known)
    surface = scene_of(tmp_path, path, max_texels=most).surfaces[0]
    assert surface.colour.shape == (most, most, 3)
    missing = (surface.flags & FILLED) > 0
    # A texel counts as known from half of its area on.
    assert 0.6 < missing.mean() * 32**2 / 100 < 1.4
    np.testing.assert_array_equal(surface.colour[~missing], np.broadcast_to([200, 90, 40], (most, most, 3))[~missing])


def test_heights_given_as_temperatures_are_named_and_warm_hills_are_not(tmp_path):
    def heights(rows, columns):
        return 280.0 + 12.0 * np.sin(rows / 4.0) + columns

    # Posts of 1 m, and texels of 0.5 m whose middles lie between them.
    height = heights(*np.indices((16, 16)))
    rows, columns = np.indices((32, 32)) / 2.0 - 0.25
    fine = heights(rows, columns)
    noise = np.random.default_rng(2).normal(0.0, 0.2, fine.shape)
    for name, values, named in (
        ("heights", fine, True),
        ("lapse", 290.0 - 0.0065 * (fine - 280.0) + noise, False),
        ("slopes", 290.0 + 5.0 * np.cos(rows / 4.0), False),
    ):
        folder = write_terrain(tmp_path / name, height=height, temperature=values)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", ThermorenderWarning)
            assert load_scene(folder).surfaces
        words = "follows the heights of the terrain by 1.00 per metre, so it may hold heights"
        assert [words in str(one.message) for one in caught] == [True] * named


@pytest.mark.parametrize("most", [24, 11], ids=["bilinear", "average"])
def test_whole_pictures_are_filtered_as_those_with_a_hole(tmp_path, most):
    """Whole ones are filtered in bytes, the others by real weights."""
    picture, known = np.random.default_rng(1).integers(0, 256, (3, 32, 32)).astype(np.uint8), np.ones((32, 32), bool)
    known[:4, :4] = False
    colours = []
    for name, mask in (("whole", None), ("hole", known)):
        (tmp_path / name).mkdir()
        path = write(tmp_path / f"{name}.tif", picture, mask=mask)
        colours.append(scene_of(tmp_path / name, path, max_texels=most).surfaces[0].colour.astype(int))
    away = np.abs(colours[0] - colours[1])[most // 4 :, most // 4 :]
    assert away.max() <= 1 and colours[0].std() > 20.0


def test_overviews_tiles_and_turned_grids_show_the_same_picture(tmp_path):
    step = 1.0
    plain = write(tmp_path / "plain.tif", rgb())
    flipped = {
        "south": (rgb()[:, ::-1], rasterio.Affine(step, 0.0, LEFT, 0.0, step, TOP - SIDE)),
        "west": (rgb()[:, :, ::-1], rasterio.Affine(-step, 0.0, LEFT + SIDE, 0.0, -step, TOP)),
        "turned": (np.rot90(rgb(), 1, (1, 2)), rasterio.Affine(0.0, -step, LEFT + SIDE, -step, 0.0, TOP)),
    }
    files = [write(tmp_path / f"{name}.tif", bands, transform=where) for name, (bands, where) in flipped.items()]
    copy(plain, tmp_path / "cog.tif", driver="COG", overview_resampling="nearest")
    with rasterio.open(write(tmp_path / "overview.tif", rgb()), "r+") as file:
        file.build_overviews([2, 4], Resampling.nearest)
    for path in (plain, *files, tmp_path / "cog.tif", tmp_path / "overview.tif"):
        (tmp_path / path.stem).mkdir()
        scene = scene_of(tmp_path / path.stem, path)
        assert scene.surfaces[0].colour.shape == (32, 32, 3)
        np.testing.assert_array_equal(scene.surfaces[0].colour[::31, ::31], QUARTERS, err_msg=path.stem)


def test_posts_of_a_point_raster_are_at_its_points(tmp_path):
    """A raster of points states the position of its first point, one of areas the corner of its first area."""
    height = np.full((16, 16), 100.0, np.float32)
    for kind in ("Area", "Point"):
        path = write(tmp_path / f"{kind}.tif", height)
        with rasterio.open(path, "r+") as file:
            file.update_tags(AREA_OR_POINT=kind)
    bounds = [terrain.read_elevation(tmp_path / f"{kind}.tif")[1].bounds for kind in ("Area", "Point")]
    assert bounds[0] == pytest.approx(bounds[1])


def test_a_file_of_several_rasters_is_refused_by_their_names(tmp_path):
    height = np.full((16, 16), 100.0, np.float32)
    path = write(tmp_path / "two.tif", height)
    write(tmp_path / "second.tif", height)
    copy(tmp_path / "second.tif", path, driver="GTiff", APPEND_SUBDATASET=True)
    with pytest.raises(ThermorenderError, match=r"holds 2 rasters \(GTIFF_DIR:1:.*rio convert 'GTIFF_DIR:1:"):
        terrain.read_elevation(path)


# --- rasters draped on the terrain -------------------------------------------------------------------------------


@pytest.fixture
def scene(tmp_path):
    """Folder of a scene whose classes and temperatures are still to be written."""
    scene_of(tmp_path, write(tmp_path / "o.tif", rgb()))
    return tmp_path / "s"


def change(folder, old, new):
    text = (folder / "scene.toml").read_text()
    assert old in text
    (folder / "scene.toml").write_text(text.replace(old, new))


CLASSES = 'source = "classes"\nraster = "c.tif"\n{}[emissivity.classes]\n1 = "grass_green"\n2 = "asphalt"\n'


def test_ground_without_a_class_is_refused_or_unknown(scene, call):
    """A raster of the western half says nothing about the eastern one."""
    change(scene, 'source = "material"\nmaterial = "soil_loam"\n', CLASSES.format(""))
    write(scene / "c.tif", np.full((32, 16), 2, np.uint8))
    with pytest.raises(ThermorenderError, match=r"c\.tif leaves 50\.0% of the terrain .* emissivity\.fallback"):
        load_scene(scene)
    change(scene, 'raster = "c.tif"\n', 'raster = "c.tif"\nfallback = "water"\n')
    found = load_scene(scene)
    names = np.array([material.name for material in found.materials])[found.surfaces[0].material]
    assert (names[:, :16] == "asphalt").all() and (names[:, 16:] == "water").all()
    np.testing.assert_array_equal(found.surfaces[0].flags & UNKNOWN > 0, np.arange(32) >= 16 + np.zeros((32, 1)))
    status, output, _ = call("plan", scene)
    assert status == 0 and "50.0% of the texels are of unknown material and taken for water" in output


def test_classes_beyond_the_terrain_and_few_gaps_are_accepted(scene):
    """Ground without height, and colourless texels, need no class; a gap of few texels is stated."""
    change(scene, 'source = "material"\nmaterial = "soil_loam"\n', CLASSES.format(""))
    with rasterio.open(scene / "elevation.tif", "r+") as file:
        height = file.read(1)
        height[:, 8:] = np.nan
        file.write(height, 1)
    classes = np.full((32, 16), 2, np.uint8)
    write(scene / "c.tif", classes)
    assert load_scene(scene).emissivity_report == {}
    classes[3, 3:5] = 0
    write(scene / "c.tif", classes)
    report = load_scene(scene).emissivity_report
    assert report["share_unknown"] == pytest.approx(2.0 / 512.0) and report["fallback"] == "the class beside them"


def test_ground_without_a_temperature_is_refused_or_has_the_stated_one(scene, call):
    change(scene, 'source = "learned"\nmodel = "fok-1to1"\n', 'source = "raster"\nraster = "t.tif"\n')
    write(scene / "t.tif", np.full((32, 16), 300.0, np.float32))
    with pytest.raises(ThermorenderError, match=r"t\.tif leaves 50\.0% of the terrain .* temperature\.value"):
        load_scene(scene)
    change(scene, 'raster = "t.tif"\n', 'raster = "t.tif"\nvalue = 280.0\n')
    surface = load_scene(scene).surfaces[0]
    assert (surface.temperature[:, :15] == 300.0).all() and (surface.temperature[:, 17:] == 280.0).all()
    assert (surface.flags[:, 17:] & FALLBACK).all() and not (surface.flags[:, :15] & FALLBACK).any()
    status, _, errors = call("plan", scene)
    assert status == 0 and "50.0% of the terrain has no temperature" in errors and "280 K" in errors


@pytest.mark.parametrize(
    "values, how, expected",
    [
        (np.float32(300.0), {}, 300.0),
        (np.float32(300.0), {"units": "K"}, 300.0),
        (np.float32(120.0), {"units": "°F"}, (120.0 - 32.0) / 1.8 + 273.15),
        (np.float32(20.0), {"units": "degree Celsius"}, 293.15),
        (np.int16(215), {"units": "degC", "scale": (0.1, 0.0)}, 294.65),
        (np.uint16(44000), {"units": "K", "scale": (0.00341802, 149.0)}, 44000 * 0.00341802 + 149.0),
        (np.uint8(200), {}, "8-bit values without a unit, which are grey levels"),
        (np.uint8(50), {"units": "K", "scale": (1.0, 250.0)}, 300.0),
        (np.uint16(2950), {}, "around 2950 without a unit, which are not kelvin"),
        (np.float32(300.0), {"units": "W/m2"}, "holds values in 'W/m2'; give K, °C or °F"),
        (np.float32(20.0), {}, "is below 100 K"),
    ],
)
def test_temperatures_follow_their_unit(scene, values, how, expected):
    change(scene, 'source = "learned"\nmodel = "fok-1to1"\n', 'source = "raster"\nraster = "t.tif"\n')
    write(scene / "t.tif", np.full((32, 32), values), **how)
    if isinstance(expected, str):
        with pytest.raises(ThermorenderError, match=expected):
            load_scene(scene)
    else:
        np.testing.assert_allclose(load_scene(scene).surfaces[0].temperature, expected, rtol=1e-6)


# --- imports without a picture or with a weather ------------------------------------------------------------------

STATION = "time,air_c\n" + "".join(
    f"2021-06-{day:02d}T{hour:02d}:00Z,{15 + 8 * np.sin((hour - 9) / 24 * 2 * np.pi):.1f}\n"
    for day in range(8, 23)
    for hour in range(24)
)


def test_an_elevation_model_alone_is_a_scene(tmp_path, call):
    write(tmp_path / "dem.tif", np.arange(256.0, dtype=np.float32).reshape(16, 16))
    status, output, errors = call("import-terrain", tmp_path / "dem.tif", "--material", "granite", "-o", tmp_path / "s")
    assert (status, errors) == (0, "") and "no orthophoto" in output and "temperatures are a placeholder" in output
    scene = load_scene(tmp_path / "s")
    assert [material.name for material in scene.materials] == ["granite"] and scene.surfaces[0].material.shape == (
        16,
        16,
    )
    assert np.ptp(scene.surfaces[0].temperature) == 0.0


def test_a_weather_gives_an_import_its_heat_balance(tmp_path, call):
    write(tmp_path / "dem.tif", np.full((16, 16), 100.0, np.float32))
    write(tmp_path / "o.tif", rgb())
    (tmp_path / "w.csv").write_text(STATION)
    asked = ("import-terrain", tmp_path / "dem.tif", tmp_path / "o.tif", "-o", tmp_path / "s", "--weather")
    status, _, errors = call(*asked, tmp_path / "w.csv")
    assert status == 2 and "needs the scene's instant; give time" in errors and not (tmp_path / "s").exists()
    status, _, errors = call(*asked, tmp_path / "w.csv", "--time", "2024-06-15T12:00Z")
    assert status == 2 and "is outside the weather" in errors and not (tmp_path / "s").exists()
    status, output, errors = call(*asked, tmp_path / "w.csv", "--time", "2021-06-15T12:00Z")
    assert (
        (status, errors) == (0, "") and "a heat balance at 2021-06-15T12:00Z" in output and "placeholder" not in output
    )
    scene = load_scene(tmp_path / "s")
    assert scene.balanced and scene.spec.emissivity.source == "learned"
    assert scene.spec.atmosphere.standard == "weather"
    assert scene.spec.emissivity.fallback == "soil_loam" and str(scene.time) == "2021-06-15T12:00:00"


@pytest.mark.parametrize("kind", [0, 99])
def test_a_private_tag_of_unknown_type_is_skipped_as_gdal_skips_it(tmp_path, kind):
    """GDAL warns of the tag, and its next call would raise the warning."""
    import struct

    import tifffile

    from thermorender.scene.orthophoto import read_colour

    rgb = np.random.default_rng(3).integers(40, 200, (24, 24, 3), np.uint8)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, rgb, photometric="rgb", extratags=[(65000, "H", 1, 5, True)])
    data = path.read_bytes()
    entry = struct.pack("<HHI", 65000, 3, 1)
    assert data.count(entry) == 1
    path.write_bytes(data.replace(entry, struct.pack("<HHI", 65000, kind, 1)))
    np.testing.assert_array_equal(read_colour(path)[0], rgb)
