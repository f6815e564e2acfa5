"""A frame in Python: aimed, shown, saved by suffix, labelled, and laid on the map."""

import json
import re
import sys
import types
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
import rasterio
import trimesh
from rasterio.errors import NotGeoreferencedWarning
from rasterio.warp import transform
from scipy.stats import norm

import thermorender as tr
from scenes import write_mesh, write_terrain
from thermorender.formats import encoded_image
from thermorender.frame import picture
from thermorender.frame.exr import read_exr
from thermorender.progress import interactive


@pytest.fixture(autouse=True)
def _no_window():
    matplotlib.use("Agg")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A hilly terrain of 16 m in UTM zone 34."""
    height = np.random.default_rng(3).uniform(0.0, 0.5, (16, 16))
    return write_terrain(tmp_path_factory.mktemp("scenes") / "hilly", height=height)


@pytest.fixture(scope="module")
def scene(folder):
    return tr.load_scene(folder).with_camera(tr.load_scene(folder).camera.coarser(8))


@pytest.fixture(scope="module")
def frame(scene):
    # Turned, so that the picture is not parallel to the map.
    return tr.Renderer(scene, quality="fast").frame(scene.pose(0, 0, 12, yaw_deg=30, pitch_deg=-90))


def test_the_first_lines_that_a_user_writes(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene = tr.load_scene(folder).with_camera("boson-640").with_sky(230.0).with_material(grass_green="asphalt")
    scene = scene.with_temperature(300.0)
    view = tr.pose(0, 0, 12, look_at=(0, 0, 0))
    renderer = tr.Renderer(scene, quality="fast")
    frame = renderer.frame(view)
    frame.show()
    frame.save("frame.exr")
    frame.orthorectified(0.25).save("ground.tif")
    assert "Frame(0, boson-640 640×512" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame.exr", "ground.tif"]
    pytest.importorskip("xarray")
    assert frame.to_xarray().apparent_temperature.shape == (512, 640)


# --- aiming -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("point", [(3.0, 4.0, 0.0), (-50.0, 8.0, -20.0), (0.0, -9.0, 40.0), (1.0, 1.0, 10.0)])
def test_a_camera_looks_at_a_point(point):
    pose = tr.pose(1.0, 2.0, 10.0, roll_deg=25.0, look_at=point)
    seen = pose[:3, :3].T @ (np.array(point) - pose[:3, 3])
    np.testing.assert_allclose(seen[:2], 0.0, atol=1e-9)
    assert seen[2] > 0.0
    level = tr.pose(1.0, 2.0, 10.0, look_at=point)
    assert level[2, 0] == pytest.approx(0.0, abs=1e-12), "the image's rows are level without a roll"


def test_straight_down_the_heading_stays(scene):
    np.testing.assert_allclose(tr.pose(0, 0, 9, 70.0, look_at=(0, 0, 1)), tr.pose(0, 0, 9, 70.0, -90.0), atol=1e-12)
    with pytest.raises(tr.ThermorenderError, match=r"sets yaw and pitch, and yaw_deg=70, pitch_deg=0 were given too"):
        tr.pose(0, 0, 9, 70.0, look_at=(3, 0, 1))
    with pytest.raises(tr.ThermorenderError, match="is the camera's own position"):
        tr.pose(0, 0, 9, look_at=(0, 0, 9))
    with pytest.raises(tr.ThermorenderError, match="is not a point; give three finite numbers"):
        tr.pose(0, 0, 9, look_at=(0, 0))


def test_a_pose_of_a_scene_is_above_its_ground(scene):
    pose = scene.pose(2.0, -3.0, above_ground_m=7.0, look_at=(-4.0, 5.0, 1.0))
    same = tr.pose(2.0, -3.0, scene.ground(2.0, -3.0) + 7.0, look_at=(-4.0, 5.0, scene.ground(-4.0, 5.0) + 1.0))
    np.testing.assert_array_equal(pose, same)
    for call, words in (
        (lambda: scene.pose(0, 900, 7), r"pose=\(0, 900, 7\) is outside the terrain; move it, or give local up"),
        (lambda: scene.pose(0, 0, 7, look_at=(0, 900, 0)), r"look_at=\(0, 900, 0\) is outside the terrain"),
        (lambda: scene.pose(0, 0, -7), r"pose=\(0, 0, -7\) is 7 m under the terrain"),
    ):
        with pytest.raises(tr.ThermorenderError, match=words):
            call()


def test_the_command_line_aims_as_python_does(folder, tmp_path, call):
    options = "--products exr --quality fast --rays 4".split()
    status, _, errors = call(
        "render", folder, "--pose", "2,-3,7", "--look-at=-4,5,1", *options, "-o", tmp_path / "out"
    )  # fmt: skip
    assert status == 0, errors
    found = json.loads((tmp_path / "out/frame_000000.json").read_text())["world_from_camera"]
    own = tr.load_scene(folder)
    np.testing.assert_allclose(found, own.pose(2, -3, 7, look_at=(-4, 5, 1)), atol=1e-8)
    status, _, errors = call("render", folder, "--pose", "2,-3,7,0,-90,0", "--look-at", "0,0,0", "-o", tmp_path / "x")
    assert status == 2 and "--pose='2,-3,7,0,-90,0' has 6 values; 3 are needed: E,N,U" in errors


# --- files --------------------------------------------------------------------------------------------------


def test_an_exr_equals_that_of_the_command_line(folder, tmp_path, call):
    status, _, errors = call("render", folder, "--pose", "0,0,12,0,-90,0", "--rays", 8, "-o", tmp_path / "out")
    assert status == 0, errors
    own = tr.load_scene(folder)
    again = tr.Renderer(own, rays=8).frame(own.pose(0, 0, 12, pitch_deg=-90))
    again.save(tmp_path / "own.exr")
    again.save(tmp_path / "own.png")
    assert (tmp_path / "own.exr").read_bytes() == (tmp_path / "out/frame_000000.exr").read_bytes()
    assert (tmp_path / "own.png").read_bytes() == (tmp_path / "out/frame_000000.png").read_bytes()
    assert read_exr(tmp_path / "own.exr")[1]["device"]["variant"]


def test_a_tiff_is_float32_kelvin(frame, tmp_path):
    frame.save(tmp_path / "frame.tif")
    # The camera's image has no place on the map.
    with pytest.warns(NotGeoreferencedWarning):
        file = rasterio.open(tmp_path / "frame.tif")
    with file:
        assert (file.dtypes, file.units, file.crs) == (("float32",), ("K",), None)
        np.testing.assert_array_equal(file.read(1), frame.apparent_temperature)


def test_tiffs_open_in_tifffile_without_imagecodecs(frame, tmp_path):
    import tifffile

    frame.save(tmp_path / "f.tif")
    (tmp_path / "counts.tif").write_bytes(encoded_image(".tif", frame.counts))
    for name, wanted in (("f.tif", frame.apparent_temperature), ("counts.tif", frame.counts)):
        with tifffile.TiffFile(tmp_path / name) as file:
            # Codecs of zlib, and horizontal differencing: what tifffile decodes itself.
            assert (int(file.pages[0].compression), int(file.pages[0].predictor)) == (8, 2)
            assert np.array_equal(file.asarray(), wanted)


def test_an_npz_has_the_images_and_no_pickle(frame, tmp_path):
    frame.save(tmp_path / "frame.npz")
    with np.load(tmp_path / "frame.npz", allow_pickle=False) as file:
        found = dict(file)
    record = json.loads(str(found.pop("record")))
    assert record["units"]["apparent_temperature"] == "K" and record["materials"] == list(frame.materials)
    truth = {f"truth.{name}": values for name, values in frame.truth.items()}
    expected = {"radiance": frame.radiance, "apparent_temperature": frame.apparent_temperature, "counts": frame.counts}
    assert set(found) == {*expected, *truth}
    for name, values in (expected | truth).items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_other_suffixes_are_refused(frame, tmp_path):
    with pytest.raises(tr.ThermorenderError, match=r"frame.jpg ends in '.jpg'; give one of .exr, .tif, .tiff, .png"):
        frame.save(tmp_path / "frame.jpg")
    with pytest.raises(tr.ThermorenderError, match=r"ground.png is not the name of a GeoTIFF; end it in .tif"):
        frame.orthorectified(1.0).save(tmp_path / "ground.png")
    assert not list(tmp_path.iterdir())


# --- on the map ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("metres", [0.04, 0.25, 1.0])
def test_a_map_lies_where_the_truth_is(scene, frame, tmp_path, metres):
    frame.orthorectified(metres).save(tmp_path / "ground.tif")
    position = frame.truth["position"].astype(np.float64)
    with rasterio.open(tmp_path / "ground.tif") as file:
        kelvin, crs, bounds, size = file.read(1), file.crs, file.bounds, file.res
        assert crs == scene.grid.crs and file.nodata != file.nodata and file.units == ("K",)
        east, north, up = position[np.isfinite(position[..., 0])].T
        lat, lon, _ = scene.frame.geodetic_from_enu(np.column_stack([east, north, up]))
        x, y = map(np.array, transform("EPSG:4326", crs, lon, lat))
        # The outermost positions lie in the outermost pixels.
        for own, edge in ((x.min(), bounds.left), (x.max(), bounds.right)):
            assert abs(own - edge) <= size[0]
        for own, edge in ((y.min(), bounds.bottom), (y.max(), bounds.top)):
            assert abs(own - edge) <= size[1]
        for corner in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
            lat, lon, _ = scene.frame.geodetic_from_enu(position[corner])
            (x,), (y,) = transform("EPSG:4326", crs, [lon], [lat])
            row, column = file.index(x, y)
            middle = np.array(file.xy(row, column))
            assert (abs(middle - (x, y)) <= np.array(size) / 2.0 + 1e-6).all()
            if metres == 0.04:
                # Several map pixels to a pixel of the frame.
                assert kelvin[row, column] == pytest.approx(frame.apparent_temperature[corner], abs=1e-3)
    assert size == pytest.approx((metres, metres), rel=1e-3), "the map's scale is that of UTM, 0.9996"
    assert np.nanmean(kelvin) == pytest.approx(frame.apparent_temperature.mean(), abs=0.3)


def test_a_coarse_map_averages_and_a_fine_one_has_no_holes(scene):
    renderer = tr.Renderer(scene, quality="fast")
    frame = renderer.frame(scene.pose(0, 0, 8, pitch_deg=-90))
    fine = frame.orthorectified(0.02).kelvin
    inner = fine[10:-10, 10:-10]
    assert np.isfinite(inner).mean() > 0.999
    coarse = frame.orthorectified(100.0).kelvin
    known = coarse[np.isfinite(coarse)]
    # All of the frame in one pixel, or in few where the origin's lines cross it.
    assert known.min() >= frame.apparent_temperature.min() and known.max() <= frame.apparent_temperature.max()


def test_a_wall_does_not_hide_the_roof_above_it(tmp_path):
    cube = trimesh.creation.box((4.0, 4.0, 4.0))
    cube.apply_translation((0.0, 0.0, 2.0))
    place = "[frame]\nlatitude_deg = 50.0\nlongitude_deg = 9.0\nheight_m = 100.0"
    scene = tr.load_scene(write_mesh(tmp_path / "cube", cube, temperature=300.0, extra=place))
    scene = scene.with_camera(scene.camera.coarser(8))
    frame = tr.Renderer(scene, quality="fast").frame(tr.pose(0, -9, 9, look_at=(0, 0, 2)))
    image = frame.orthorectified(0.5)
    assert image.grid.crs.to_epsg() == 32632
    # The roof of 4 m × 4 m fills the map; the wall is its southern edge.
    assert image.kelvin.shape[0] in (8, 9, 10) and image.kelvin.shape[1] in (8, 9, 10)


def test_a_frame_without_place_or_ground_is_refused(tmp_path, frame, scene):
    nowhere = tr.load_scene(write_mesh(tmp_path / "box", trimesh.creation.box((4.0, 4.0, 4.0))))
    nowhere = nowhere.with_camera(nowhere.camera.coarser(8))
    with pytest.raises(tr.ThermorenderError, match=r"needs a place on Earth.*add \[frame\]"):
        tr.Renderer(nowhere, quality="fast").frame(tr.pose(0, 0, 9, pitch_deg=-90)).orthorectified(1.0)
    with pytest.raises(tr.ThermorenderError, match="metres=0 is not allowed; give the size of a pixel, above 0"):
        frame.orthorectified(0)
    with pytest.raises(tr.ThermorenderError, match="allowed: give larger pixels, or look down"):
        frame.orthorectified(1e-4)
    with pytest.raises(tr.ThermorenderError, match="shows no surface; look at the terrain"):
        tr.Renderer(scene, quality="fast").frame(scene.pose(0, 0, 9, pitch_deg=90)).orthorectified(1.0)


# --- xarray -------------------------------------------------------------------------------------------------


def test_a_dataset_has_units_coordinates_and_crs(scene, frame):
    pytest.importorskip("xarray")
    import xarray

    found = frame.to_xarray()
    assert isinstance(found, xarray.Dataset)
    np.testing.assert_array_equal(found.apparent_temperature, frame.apparent_temperature)
    assert found.apparent_temperature.units == "K" and found.radiance.units == "W m-2 sr-1"
    assert found.depth.units == "m along the optical axis"
    np.testing.assert_array_equal(np.stack([found.east, found.north, found.up], axis=-1), frame.truth["position"])
    assert rasterio.crs.CRS.from_wkt(found.spatial_ref.crs_wkt) == scene.grid.crs
    left, bottom, right, top = scene.grid.bounds
    inside = (found.map_x > left) & (found.map_x < right) & (found.map_y > bottom) & (found.map_y < top)
    assert inside.all()
    names = found.material.flag_meanings.split()
    assert names[int(found.material[0, 0])] == frame.materials[frame.truth["material"][0, 0]]


def test_the_meanings_of_material_numbers_are_one_word_each(frame):
    pytest.importorskip("xarray")
    mixed = replace(frame, materials=("0.5 grass_green + 0.5 sand_quartz", "asphalt"))
    assert mixed.to_xarray().material.attrs["flag_meanings"] == "0.5_grass_green_+_0.5_sand_quartz asphalt"


def test_an_orthoimage_has_the_coordinates_of_its_pixels(frame):
    pytest.importorskip("xarray")
    image = frame.orthorectified(0.5)
    found = image.to_xarray()
    left, bottom, right, top = image.grid.bounds
    assert found.x[0] == pytest.approx(left + 0.25) and found.x[-1] == pytest.approx(right - 0.25)
    assert found.y[0] == pytest.approx(top - 0.25) and found.y[-1] == pytest.approx(bottom + 0.25)
    assert found.units == "K" and found.shape == image.kelvin.shape


def test_a_missing_xarray_is_named_with_its_installation(frame, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(tr.ThermorenderError, match=r"needs xarray.*pip install 'thermorender\[xarray\]'"):
        frame.to_xarray()


# --- pictures -----------------------------------------------------------------------------------------------


def test_printing_a_frame_teaches(frame):
    text = str(frame)
    for words in ("apparent_temperature", " K, of a blackbody", "W m⁻² sr⁻¹", "mK at 300 K", "kinetic_temperature [K]"):
        assert words in text
    assert len(repr(frame).splitlines()) == 1


def test_warm_cars_at_night_leave_the_colours_to_the_ground():
    ground = np.random.default_rng(7).normal(283.0, 0.5, (100, 100))
    ground[:, :4] = 318.0
    low, high = picture.limits(ground)
    # The range ends three widths of the middle 80 % beyond them.
    lower, upper = 283.0 + 0.5 * norm.ppf(np.array([0.1, 0.9]) / 0.96)
    assert 281.3 < low < 281.9 and high == pytest.approx(upper + 3.0 * (upper - lower), abs=0.15)
    assert picture.limits(np.where(ground > 300.0, 290.0, 283.0))[1] == 290.0


def test_a_notebook_shows_the_picture(frame, monkeypatch):
    assert frame._repr_html_().startswith('<img alt="Frame(0')
    shown = []
    shell = types.SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", types.SimpleNamespace(display=shown.append))
    frame.show()
    assert shown == [frame]


def test_a_terminal_shows_colours_and_a_file_one_line(frame, monkeypatch, capsys):
    frame.show()
    assert capsys.readouterr().out == f"{frame!r}\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "50")
    frame.show()
    *lines, last = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    assert last == repr(frame)
    assert len(lines) == 21 and set(lines[0]) == {"▀"} and len(lines[0]) == 50
    low, high = picture.limits(frame.apparent_temperature)
    assert lines[-1].startswith(f"≤{low:.1f} K") and lines[-1].endswith(f"≥{high:.1f} K")
    assert frame.apparent_temperature.min() <= low < high <= frame.apparent_temperature.max()


def test_a_notebook_has_a_bar_for_long_work_and_a_program_has_none(scene, monkeypatch, capsys):
    drawn = []
    handle = types.SimpleNamespace(update=drawn.append)
    shell = types.SimpleNamespace(kernel=object())
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
        inside = types.SimpleNamespace(HTML=lambda text: text, display=lambda shown, display_id: handle)
        patch.setitem(sys.modules, "IPython.display", inside)
        patch.setenv("THERMORENDER_CACHE", "")
        assert tr.Renderer(scene, quality="fast", rays=5).baked
    assert '<progress value="0.' in "".join(drawn) and drawn[-1] == "", "the bar disappears"
    with interactive() as report:
        assert report is None
    mine = []
    with interactive(lambda *state: mine.append(state)) as report:
        report("baking", 0.5)
    assert mine == [("baking", 0.5)]
    assert capsys.readouterr().err == ""


def test_objects_print_what_they_are(scene, tmp_path):
    html = scene._repr_html_()
    assert "data:image/png;base64," in html and "materials" in html and "260 K" in html
    mesh = tr.load_scene(write_mesh(tmp_path / "box", trimesh.creation.box((2.0, 2.0, 2.0))))
    assert mesh._repr_html_().startswith("<pre>box: ")
    camera = str(tr.load_camera("boson-640"))
    for words in ("µm", "°", "mrad per pixel", "NETD", "mK", "bits over", "no visible camera beside it"):
        assert words in camera


def test_render_says_that_a_camera_below_the_ground_sees_backs(tmp_path, call):
    folder = write_terrain(tmp_path / "tiny")
    for name, pose, backs in (("below", "0,0,-20,0,90,0", True), ("above", "0,0,30,0,-90,0", False)):
        options = ("--local-up", "--pose", pose, "--rays", 8, "-o", tmp_path / name)
        status, _, errors = call("render", folder, *options)
        assert status == 0, errors
        assert ("100% of what the camera sees is backs of faces: the camera is below the" in errors) == backs
        assert ("with --local-up is 20 m under the ground; leave --local-up out" in errors) == backs
