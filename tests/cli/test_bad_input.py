"""Every user error ends in one sentence and status 2, without traceback or warning, and leaves no partial output."""

import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from mesh_support import Gltf
from support import slow

from scenes import scene_object, write_raster
from thermorender import files
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError
from thermorender.frame.exr import read_exr
from thermorender.scene.load import load_scene
from thermorender.scene.raster import opened
from thermorender.scene.surface import BACKGROUND, MOST_TEXELS, SURFACE

SCENE = """title = "tiny"
[terrain]
elevation = "elevation.tif"
orthophoto = "orthophoto.tif"
[temperature]
source = "raster"
raster = "temperature.tif"
[emissivity]
source = "classes"
raster = "classes.tif"
[emissivity.classes]
1 = "grass_green"
2 = "asphalt"
[sky]
temperature = 250.0
[camera]
model = "small.toml"
"""
OBJECT = scene_object("marker", shape="disc")
MESH = """[terrain]
mesh = "model.obj"
[temperature]
source = "constant"
value = 300.0
[emissivity]
source = "constant"
value = 0.9
[sky]
temperature = 250.0
[camera]
model = "small.toml"
"""
CAMERA = """width = 16
height = 12
pixel_pitch_um = 17.0
focal_length_mm = 0.5
f_number = 1.25
lens_transmittance = 0.9
band_um = [7.5, 13.5]
netd_mk = 50.0
netd_f_number = 1.0
bits = 14
range_c = [-25.0, 135.0]
frame_rate_hz = 1.0
"""
COLUMNS = "time_s,east_m,north_m,above_ground_m,gimbal_pitch_deg,gimbal_yaw_deg"
FLIGHT = f"{COLUMNS}\n0,0,0,20,-90,0\n1,1,0,20,-90,0\n2,2,0,20,-90,0\n"
QUICK = ("--rays", 2, "--quality", "fast")
QUAD = "v -8 -8 0\nv 8 -8 0\nv 8 8 0\nv -8 8 0\n"
FACES = "f 1 2 3\nf 1 3 4\n"
FACES_UV = "vt 0 0\nusemtl a\nf 1/1 2/1 3/1\nf 1/1 3/1 4/1\n"


def raster(path, bands, crs="EPSG:32632", corner=(500000.0, 5600000.0), size_m=16.0, nodata=None):
    bands = np.asarray(bands)
    bands = bands[None] if bands.ndim == 2 else bands
    write_raster(path, bands, size_m / bands.shape[1], crs, corner, nodata=nodata)


@pytest.fixture
def scene(tmp_path):
    """Folder of a small scene that renders: 8×8 posts and 16×16 texels."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    draw = np.random.Generator(np.random.Philox(5))
    raster(folder / "elevation.tif", draw.uniform(0.0, 1.0, (8, 8)).astype(np.float32))
    raster(folder / "orthophoto.tif", draw.integers(1, 255, (3, 16, 16)).astype(np.uint8))
    raster(folder / "temperature.tif", draw.uniform(280.0, 300.0, (16, 16)).astype(np.float32))
    raster(folder / "classes.tif", draw.integers(1, 3, (16, 16)).astype(np.uint8))
    (folder / "scene.toml").write_text(SCENE)
    (folder / "small.toml").write_text(CAMERA)
    (folder / "flight.csv").write_text(FLIGHT)
    return folder


def check_sentence(status, errors, words):
    assert status == 2, errors
    assert errors.startswith("error: ") and errors.endswith("\n"), errors
    assert len(errors.splitlines()) == 1, errors
    assert "Traceback" not in errors and "Warning" not in errors
    for word in words:
        assert str(word) in errors, (word, errors)


@pytest.fixture
def refused(call, tmp_path):
    """Run a command with a new output folder; it must fail with these words and leave no folder."""

    def run(words, verb, *arguments):
        output = tmp_path / "new" / "output"
        status, _, errors = call(verb, *arguments, "-o", output)
        check_sentence(status, errors, [words] if isinstance(words, str) else words)
        assert not output.parent.exists()

    return run


def everything(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def change(path, old, new):
    text = path.read_text()
    assert text.count(old) >= 1, old
    path.write_text(text.replace(old, new, 1))


def cut(path, share=0.5):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def test_unchanged_scene_renders(scene, call, tmp_path):
    status, output, errors = call("render", scene, "-o", tmp_path / "o", "--pose", "0,0,20,0,-90,0", *QUICK)
    assert (status, errors) == (0, "")
    assert "apparent temperature" in output and (tmp_path / "o" / "frame_000000.exr").exists()


def test_render_records_versions_device_and_plan(scene, call, tmp_path):
    options = ["--pose", "0,0,20,0,-90,0", "--tolerance-mk", 4, *QUICK]
    for engine in ("renderer", "reference"):
        output = tmp_path / engine
        assert call("render", scene, "-o", output, "--engine", engine, "--paths", 1, *options)[0] == 0
        beside = json.loads((output / "frame_000000.json").read_text())
        for record in (beside, read_exr(output / "frame_000000.exr")[1]):
            assert {"thermorender", "mitsuba", "drjit", "numpy", "python"} <= set(record["versions"])
            assert record["device"]["variant"] in ("llvm_ad_mono", "cuda_ad_mono") and len(record["device"]) > 1
            assert engine == "reference" or record["plan"]["tolerance_mk"] == 4.0


# --- the scene file ---------------------------------------------------------------------------------------------


def test_missing_scene(refused, tmp_path):
    refused([f"scene '{tmp_path / 'none'}' does not exist", "heath"], "render", tmp_path / "none")
    refused(["scene.toml does not exist"], "render", tmp_path / "none" / "scene.toml")
    refused([f"scene '{tmp_path}' holds no scene.toml; give a folder with"], "render", tmp_path)
    (tmp_path / "file").write_text("")
    refused([f"scene '{tmp_path / 'file'}' is a file; give a folder with a scene.toml"], "render", tmp_path / "file")


@pytest.mark.parametrize(
    "key, name", [("terrain.elevation", "elevation"), ("terrain.orthophoto", "orthophoto"),
                  ("temperature.raster", "temperature"), ("emissivity.raster", "classes")],
)  # fmt: skip
def test_missing_file_is_named(scene, refused, key, name):
    (scene / f"{name}.tif").unlink()
    refused(["scene.toml: ", f"{key}='{name}.tif' does not exist"], "render", scene)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ('title = "tiny"', 'titel = "tiny"', ["unknown key 'titel' in the scene", "did you mean 'title'"]),
        ("orthophoto =", "ortophoto =", ["unknown key 'ortophoto' in terrain", "did you mean 'orthophoto'"]),
        ('raster = "temperature.tif"', 'rater = "x"', ["unknown key 'rater' in temperature", "did you mean 'raster'"]),
        ('raster = "classes.tif"', 'rastre = "x"', ["unknown key 'rastre' in emissivity", "did you mean 'raster'"]),
        (
            "temperature = 250.0",
            "temprature = 250.0",
            ["unknown key 'temprature' in sky", "did you mean 'temperature'"],
        ),
        ("model =", "mode =", ["unknown key 'mode' in camera", "did you mean 'model'"]),
        ("[camera]", "[truth]\ntemprature = 3\n[camera]", ["unknown key 'temprature' in truth", "did you mean"]),
        ("[camera]", "[surroundings]\nt = 3\n[camera]", ["unknown key 't' in surroundings", "allowed are temperature"]),
        (
            "[camera]",
            "[frame]\nlatitude = 3\n[camera]",
            ["unknown key 'latitude' in frame", "did you mean 'latitude_deg'"],
        ),
        ("[sky]", OBJECT.replace("shape", "shap") + "[sky]", ["unknown key 'shap' in object 'marker'", "'shape'"]),
    ],
)  # fmt: skip
def test_unknown_keys(scene, refused, old, new, words):
    change(scene / "scene.toml", old, new)
    refused([scene / "scene.toml", *words], "render", scene)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ('"elevation.tif"', "5", ["terrain.elevation=5 is not allowed", "a text"]),
        (
            '"elevation.tif"',
            '"../elevation.tif"',
            ["terrain.elevation='../elevation.tif'", "inside the scene's folder"],
        ),
        ('"elevation.tif"', '"/etc/hostname"', ["terrain.elevation='/etc/hostname'", "inside the scene's folder"]),
        ('"elevation.tif"', '"a\\u0000b"', ["terrain.elevation=", "the name of a file"]),
        ('"elevation.tif"', '"' + 300 * "x" + '"', ["terrain.elevation=", "the name of a file"]),
        ('"small.toml"', '"../small.toml"', ["camera.model='../small.toml'", "inside the scene's folder"]),
        ('"small.toml"', '"zenmus-xt2"', ["camera.model 'zenmus-xt2' is unknown", "zenmuse-xt2"]),
        ("= 250.0", '= "cold"', ["sky.temperature='cold' is not allowed", "a finite number"]),
        ("= 250.0", "= nan", ["sky.temperature=nan is not allowed"]),
        ("= 250.0", "= 1" + 400 * "0", ["sky.temperature=1", "a finite number"]),
        ("= 250.0", "= 1e9", ["sky.temperature=1e+09 is above 3000 K"]),
        ("= 250.0", "= 19.5", ["sky.temperature=19.5 is below 100 K", "add 273.15 to °C"]),
        ("temperature = 250.0", "", ["key 'temperature' is missing in sky"]),
        ('"tiny"', "5", ["title=5 is not allowed"]),
        (
            'source = "raster"',
            'source = "rasterr"',
            ["temperature.source='rasterr'", "constant, raster, material, learned"],
        ),
        ('source = "raster"', 'source = "learned"', ["temperature.model is missing", "source='learned' needs it"]),
        ('source = "raster"', 'source = "learned"\nmodel = "fok"', ["temperature.model: learned map 'fok' is unknown"]),
        ('1 = "grass_green"', '1 = "gras_green"', ["emissivity.classes.1 uses material 'gras_green'", "grass_green"]),
        ('1 = "grass_green"', '"²" = "asphalt"', ["emissivity.classes='²'", "class numbers 1…255"]),
        ('1 = "grass_green"\n', "", ["classes.tif holds class 1", "does not name"]),
        (
            "[sky]",
            OBJECT.replace("paint_black", "pant_black") + "[sky]",
            ["object 'marker' uses material 'pant_black'"],
        ),
        ("[sky]", OBJECT.replace("330.0", "57.0") + "[sky]", ["object 'marker'.temperature=57 is below 100 K"]),
        ("[sky]", OBJECT.replace("[0.0", "[500.0") + "[sky]", ["object 'marker' is at 500 m east", "no terrain"]),
        ("[sky]", OBJECT.replace('"marker"', '"a:b"') + "[sky]", ["object 'a:b'.name='a:b'", "without ':'"]),
        ("[sky]", OBJECT + OBJECT + "[sky]", ["object.name='marker'", "each object a unique name"]),
        (
            "[camera]",
            "[frame]\nlatitude_deg=500\nlongitude_deg=9\nheight_m=0\n[camera]",
            ["frame.latitude_deg=500 is not allowed", "-90…90 deg"],
        ),
        ("[camera]", "[frame]\nlatitude_deg=-50\nlongitude_deg=9\nheight_m=0\n[camera]", ["frame is", "km from"]),
        ("[sky]", "[sky", ["is not valid TOML"]),
    ],
)  # fmt: skip
def test_wrong_values(scene, refused, old, new, words):
    change(scene / "scene.toml", old, new)
    refused([scene / "scene.toml" if "classes.tif" not in words[0] else "classes.tif", *words], "render", scene)


def many_materials(scene, count):
    """Give the scene a library of `count` materials, and its texels one class for each of the first 255."""
    from thermorender.paths import data_folder

    shipped, own = data_folder("materials"), scene / "materials"
    (own / "spectra").mkdir(parents=True)
    header, *rows = (shipped / "index.csv").read_text(encoding="utf-8").splitlines()
    row = next(row for row in rows if row.startswith("asphalt,"))
    names = [f"m{number}" for number in range(1, count + 1)]
    (own / "index.csv").write_text("\n".join([header, *(row.replace("asphalt", name, 1) for name in names)]), "utf-8")
    for name in names:
        (own / "spectra" / f"{name}.csv").symlink_to(own / "spectra" / "all.csv")
    (own / "spectra" / "all.csv").write_bytes((shipped / "spectra" / "asphalt.csv").read_bytes())
    classes = np.arange(256).reshape(16, 16)
    raster(scene / "classes.tif", np.where(classes == 0, 1, classes).astype(np.uint8))
    named = "".join(f'{number} = "{name}"\n' for number, name in enumerate(names[:255], 1))
    change(scene / "scene.toml", '1 = "grass_green"\n2 = "asphalt"\n', named)


def test_255_materials_are_accepted_and_256_refused(scene, refused):
    many_materials(scene, 256)
    loaded = load_scene(scene)
    names = np.array([material.name for material in loaded.materials])
    assert len(names) == 255
    assert names[loaded.surfaces[0].material].ravel()[1:].tolist() == [f"m{number}" for number in range(1, 256)]
    change(scene / "scene.toml", "[sky]", OBJECT.replace("paint_black", "m256") + "[sky]")
    refused([scene / "scene.toml", "'m256' would be the scene's material number 256", "up to 255"], "render", scene)


def test_temperatures_need_a_source(scene):

    loaded = load_scene(scene)
    for given in (np.full((16, 16), 300.0), None, True):
        words = rf"with_temperature was given a {type(given).__name__}; give kelvin, the path of a raster, the name"
        with pytest.raises(ThermorenderError, match=words):
            loaded.with_temperature(given)


@pytest.mark.parametrize("given", [57.0, 0.0, -273.0, np.nan, np.inf, 1e4])
def test_impossible_object_temperatures_are_refused(scene, given):
    change(scene / "scene.toml", "[sky]", OBJECT + "[sky]")
    with pytest.raises(ThermorenderError, match=f"^object 'marker': temperature_k={given:g} is "):
        load_scene(scene).with_objects({"marker": given})


def test_celsius_given_as_kelvin(scene, refused):
    text = (scene / "scene.toml").read_text()
    head, tail = text.split('source = "raster"\nraster = "temperature.tif"\n')
    (scene / "scene.toml").write_text(head + 'source = "constant"\nvalue = 21.5\n' + tail)
    refused(["temperature.value=21.5 is below 100 K", "add 273.15 to °C"], "render", scene)
    new = 'source = "material"\n[temperature.materials]\nasphalt = 31.0\n'
    (scene / "scene.toml").write_text(head + new + tail)
    refused(["temperature.materials.asphalt=31 is below 100 K", "add 273.15 to °C"], "render", scene)
    (scene / "scene.toml").write_text(text)
    raster(scene / "temperature.tif", np.full((16, 16), 21.0, np.float32))
    refused(["temperature.tif=21 is below 100 K", "add 273.15 to °C"], "render", scene)


# --- rasters ----------------------------------------------------------------------------------------------------

HEIGHTS, COLOURS = np.ones((8, 8), np.float32), np.full((3, 16, 16), 99, np.uint8)
LOCAL = 'LOCAL_CS["own",UNIT["metre",1]]'
ELSEWHERE = (700000.0, 100000.0)


@pytest.mark.parametrize(
    "name, bands, how, words",
    [
        ("elevation", HEIGHTS, {"crs": "EPSG:4978"}, ["EPSG:4978, a geocentric CRS and not a map"]),
        ("elevation", HEIGHTS, {"crs": None}, ["no coordinate reference system (CRS)", "assign one"]),
        ("orthophoto", COLOURS, {"crs": None}, ["no coordinate reference system (CRS)", "assign one"]),
        ("elevation", HEIGHTS, {"crs": LOCAL}, ["cannot be converted to EPSG:4326", "assign the CRS"]),
        ("elevation", HEIGHTS, {"crs": "EPSG:4326"}, ["x=500000, y=5599984 is not on Earth in EPSG:4326"]),
        ("elevation", HEIGHTS, {"corner": (1e9, 1e9)}, ["cannot be converted to EPSG:4326", "assign the CRS"]),
        ("orthophoto", COLOURS, {"crs": "EPSG:32633"}, ["has CRS EPSG:32633 but", "thermorender import-terrain"]),
        ("orthophoto", COLOURS, {"corner": ELSEWHERE}, ["x 700000…700016, y 99984…100000", "do not overlap"]),
        ("classes", COLOURS[0], {"corner": ELSEWHERE}, ["x 700000…700016", "do not overlap"]),
        ("temperature", 3 * COLOURS[0].astype(np.int16), {"corner": ELSEWHERE}, ["does not overlap the texels"]),
        ("temperature", 3 * COLOURS[0].astype(np.int16), {"crs": LOCAL}, ["cannot be converted to EPSG:32632"]),
        ("elevation", np.nan * HEIGHTS, {}, ["has no valid height in it"]),
        ("elevation", -9999 * HEIGHTS, {"nodata": -9999}, ["has no valid height in it"]),
        ("elevation", HEIGHTS[:1, :1], {}, ["has 1×1 posts", "at least 2×2"]),
        ("elevation", np.stack(2 * [HEIGHTS]), {}, ["has 2 bands where one is expected"]),
        ("orthophoto", COLOURS[0], {}, ["has 1 bands of uint8", "needs red, green and blue (RGB)"]),
        ("orthophoto", COLOURS.astype(np.uint16), {}, ["does not declare which of its 3 bands", "give --bands"]),
        ("orthophoto", 0 * COLOURS, {}, ["is empty: every texel is masked"]),
        ("temperature", np.full((16, 16), np.nan, np.float32), {}, ["has no valid temperature in it"]),
        ("temperature", np.full((16, 16), 3e38, np.float32), {}, ["=3e+38 is above 3000 K", "nodata"]),
        ("temperature", np.full((16, 16), 300, np.complex64), {}, ["holds complex numbers"]),
        ("classes", np.full((16, 16), 65535, np.uint16), {}, ["holds 65535, which is not a class number", "0…255"]),
        ("classes", np.full((16, 16), 1.5, np.float32), {}, ["holds 1.5, which is not a class number"]),
        ("classes", 0 * COLOURS[0], {}, ["has no class in it"]),
    ],
)  # fmt: skip
def test_wrong_rasters(scene, refused, name, bands, how, words):
    raster(scene / f"{name}.tif", bands, **how)
    refused([f"{name}.tif", *words], "render", scene)


@pytest.mark.parametrize("name", ["elevation", "orthophoto", "temperature", "classes"])
def test_raster_size_is_limited(scene, refused, name):
    """A GeoTIFF that claims 100 000² pixels, and holds none, is refused before memory is allocated for it."""
    import rasterio

    bands, kind = {"orthophoto": (3, "uint8"), "classes": (1, "uint8")}.get(name, (1, "float32"))
    with rasterio.open(
        scene / f"{name}.tif", "w", driver="GTiff", count=bands, height=100_000, width=100_000, dtype=kind,
        crs="EPSG:32632", transform=rasterio.Affine(2e-4, 0, 500000, 0, -2e-4, 5600000), sparse_ok=True, tiled=True,
        blockxsize=4096, blockysize=4096, interleave="pixel",
    ):  # fmt: skip
        pass
    words = [f"{name}.tif has 100000×100000 pixels", "up to 536870912"]
    refused(words, "render", scene)
    if name in ("elevation", "orthophoto"):
        refused(words, "import-terrain", scene / "elevation.tif", scene / "orthophoto.tif")


def test_terrain_larger_than_memory_is_refused_by_file(scene, refused, monkeypatch):
    def full(*_):
        raise MemoryError("Unable to allocate 27.9 GiB")

    monkeypatch.setattr("thermorender.scene.terrain.mesh", full)
    refused(["elevation.tif has", "posts, too many for this machine's memory", "--max-vertices"],
            "render", scene)  # fmt: skip


VRT = """<VRTDataset rasterXSize="8" rasterYSize="8"><SRS>EPSG:32632</SRS>
<GeoTransform>500000,2,0,5600000,0,-2</GeoTransform>
<VRTRasterBand dataType="Float32" band="1"><SimpleSource>
<SourceFilename relativeToVRT="1">../out.tif</SourceFilename><SourceBand>1</SourceBand>
</SimpleSource></VRTRasterBand></VRTDataset>"""
WMS = """<GDAL_WMS><Service name="TMS"><ServerUrl>http://localhost:1/${z}/${x}/${y}.png</ServerUrl></Service>
<DataWindow><UpperLeftX>500000</UpperLeftX><UpperLeftY>5600000</UpperLeftY><LowerRightX>500016</LowerRightX>
<LowerRightY>5599984</LowerRightY><SizeX>8</SizeX><SizeY>8</SizeY></DataWindow><Projection>EPSG:32632</Projection>
<BandsCount>1</BandsCount></GDAL_WMS>"""


@pytest.mark.parametrize("key, old", [("terrain.elevation", "elevation"), ("temperature.raster", "temperature")])
def test_raster_cannot_refer_to_files_outside_the_scene(scene, refused, key, old):
    (scene / f"{old}.tif").rename(scene.parent / "out.tif")
    for text in (VRT, WMS):
        (scene / f"{old}.tif").write_text(text)
        refused([f"{old}.tif cannot be read as a raster", "give a complete file such as a GeoTIFF"], "render", scene)
    (scene / "own.vrt").write_text(VRT)
    change(scene / "scene.toml", f"{old}.tif", "own.vrt")
    refused([f"{key}='own.vrt'", "a raster that contains all its pixels", ".tif"], "render", scene)
    # A sidecar file that only GDAL asks for.
    change(scene / "scene.toml", "own.vrt", f"{old}.tif")
    (scene.parent / "out.tif").rename(scene / f"{old}.tif")
    (scene.parent / "out.xml").write_text("<PAMDataset></PAMDataset>")
    (scene / f"{old}.tif.aux.xml").symlink_to(scene.parent / "out.xml")
    refused([f"{key}='{old}.tif'", f"{old}.tif.aux.xml", "inside the scene's folder"], "render", scene)


def test_sidecar_files_cannot_refer_outside_the_scene(scene, refused, call, tmp_path):
    """GDAL's sidecar file may name overviews anywhere, even on the network."""
    import http.server
    import threading

    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_HEAD(self):
            asked.append(self.path)
            self.send_error(404)

        do_GET = do_HEAD

        def log_message(self, *arguments):
            pass

    def overview(path):
        text = f'<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{path}</MDI></Metadata></PAMDataset>'
        (scene / "orthophoto.tif.aux.xml").write_text(text)

    raster(scene.parent / "out.tif", np.ones((3, 8, 8), np.uint8))
    overview(scene.parent / "out.tif")
    refused(["terrain.orthophoto='orthophoto.tif'", scene.parent / "out.tif"], "render", scene)
    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        overview(f"/vsicurl/http://127.0.0.1:{server.server_port}/x.tif")
        status, _, errors = call("render", scene, "-o", tmp_path / "o", *QUICK)
        server.shutdown()
    assert (status, errors, asked) == (0, "", [])


def test_raster_on_the_command_line_may_be_a_mosaic(scene, call, tmp_path):
    (scene / "elevation.tif").rename(tmp_path / "out.tif")
    (scene / "own.vrt").write_text(VRT)
    status, _, errors = call("import-terrain", scene / "own.vrt", scene / "orthophoto.tif", "-o", tmp_path / "new")
    assert (status, errors) == (0, "")


@pytest.mark.skipif(sys.platform == "win32", reason="makes a pipe, and a name of bytes")
def test_raster_on_the_command_line_must_be_a_regular_file(scene, refused, tmp_path):
    """Reading from a pipe would block for ever."""
    os.mkfifo(tmp_path / "pipe.tif")
    odd = tmp_path / os.fsdecode(b"\xff.tif")
    for path, words in (
        (tmp_path / "pipe.tif", "pipe.tif is a folder or a special file; give a raster file"),
        (scene, "tiny is a folder or a special file; give a raster file"),
        (odd, r"\udcff.tif' is not valid Unicode; rename the file or folder, or set LANG to a locale"),
    ):
        refused(words, "import-terrain", path, scene / "orthophoto.tif")
    (scene / "elevation.tif").rename(odd)
    with pytest.raises(ThermorenderError, match="this name is not valid Unicode, which GDAL needs; rename it"):
        with opened(odd):
            pass


@pytest.mark.parametrize("name", ["scene.toml", "flight.csv", "materials", "elevation.tif", "small.toml"])
def test_links_out_of_a_scene_are_refused(scene, refused, name):
    if name == "materials":
        (scene / name).mkdir()
    (scene / name).rename(scene.parent / f"out {name}")
    (scene / name).symlink_to(scene.parent / f"out {name}")
    refused([name, "inside the scene's folder"], "fly", scene, *QUICK)


def test_scene_folder_may_be_a_link(scene, call, tmp_path):
    (tmp_path / "link").symlink_to(scene)
    status, _, errors = call("plan", tmp_path / "link", *QUICK)
    assert (status, errors) == (0, "")


def test_raster_without_georeference(scene, refused):
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with pytest.warns(NotGeoreferencedWarning), rasterio.open(
        scene / "elevation.tif", "w", driver="GTiff", count=1, height=8, width=8, dtype="float32", crs="EPSG:32632"
    ) as dataset:  # fmt: skip
        dataset.write(HEIGHTS[None])
    refused(["elevation.tif has no geotransform", "assign one"], "render", scene)


@pytest.mark.parametrize("name", ["elevation", "orthophoto", "temperature", "classes"])
@pytest.mark.parametrize("share", [0.9, 0.02])
def test_truncated_raster(scene, refused, name, share):
    cut(scene / f"{name}.tif", share)
    refused([f"{name}.tif"], "render", scene)
    if name in ("elevation", "orthophoto"):
        refused([f"{name}.tif"], "import-terrain", scene / "elevation.tif", scene / "orthophoto.tif")


def test_nodata_islands_become_holes(scene, call, tmp_path):
    height = np.ones((8, 8), np.float32)
    height[3:5, 3:5] = np.nan
    height[0, 0] = -9999.0
    raster(scene / "elevation.tif", height, nodata=-9999.0)
    mesh = load_scene(scene).surfaces[0]
    # 3 × 3 cells of 4 m² touch the island in the middle; one cell touches the corner.
    corner = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(4.0 * (49 - 9 - 1), rel=1e-2)
    status, _, errors = call(
        "render",
        scene,
        "-o",
        tmp_path / "o",
        "--pose",
        "0,0,20,0,-90,0",
        "--local-up",
        "--products",
        "exr,truth",
        *QUICK,
    )
    assert (status, errors) == (0, "")
    channels, _ = read_exr(tmp_path / "o" / "frame_000000.exr")
    mask = channels["truth.mask"]
    assert mask[6, 8] == BACKGROUND and np.isnan(channels["truth.kinetic_temperature"][6, 8])
    assert mask[6, 0] & SURFACE and np.isfinite(channels["truth.kinetic_temperature"][6, 0])
    assert np.isfinite(channels["apparent_temperature"]).all()
    status, _, errors = call("render", scene, "-o", tmp_path / "p", "--pose", "0,0,20,0,-90,0", *QUICK)
    check_sentence(status, errors, ["--pose='0,0,20,0,-90,0' is outside the terrain", "--local-up"])
    assert not (tmp_path / "p").exists()


def test_special_characters_in_file_names_are_escaped_in_the_scene_file(scene, call, tmp_path):
    odd = scene / 'a"\nsky = "\x7f.tif'
    (scene / "orthophoto.tif").rename(odd)
    folder = tmp_path / 'my "own"\x7f\\scene'
    status, _, errors = call("import-terrain", scene / "elevation.tif", odd, "-o", folder)
    assert (status, errors) == (0, "")
    assert load_scene(folder).spec.title == folder.name


def test_failed_import_leaves_nothing(scene, refused, call, tmp_path):
    elevation, orthophoto = scene / "elevation.tif", scene / "orthophoto.tif"
    nan = "sky_temperature=nan is not a finite number"
    refused(nan, "import-terrain", elevation, orthophoto, "--sky-temperature", "nan")
    refused("sky_temperature=-20 is below 100 K", "import-terrain", elevation, orthophoto, "--sky-temperature", "-20")
    refused("geoid_undulation_m=inf", "import-terrain", elevation, orthophoto, "--geoid-undulation-m", "inf")
    sea = "height_reference='sea' is not allowed"
    refused(sea, "import-terrain", elevation, orthophoto, "--height-reference", "sea")
    refused("learned map 'none' is unknown", "import-terrain", elevation, orthophoto, "--model", "none")
    refused("max_texels=-1", "import-terrain", elevation, orthophoto, "--max-texels", "-1")
    raster(tmp_path / "far.tif", COLOURS, corner=ELSEWHERE)
    refused(["far.tif", "do not overlap"], "import-terrain", elevation, tmp_path / "far.tif")
    before = everything(scene)
    status, _, errors = call("import-terrain", elevation, orthophoto, "-o", scene)
    check_sentence(status, errors, [scene, "exists and is not empty"])
    assert everything(scene) == before


# --- meshes -----------------------------------------------------------------------------------------------------


def mesh_scene(scene, name, text=None):
    (scene / "scene.toml").write_text(MESH.replace("model.obj", name))
    if text is not None:
        (scene / name).write_text(text)


def test_damaged_object_mesh_and_mesh_with_map_rasters(scene, refused):
    change(scene / "scene.toml", "[sky]", OBJECT.replace('shape = "disc"', 'file = "car.glb"') + "[sky]")
    refused("object 'marker'.file='car.glb' does not exist", "render", scene)
    (scene / "car.glb").write_bytes(b"")
    refused("car.glb is empty", "render", scene)
    mesh_scene(scene, "model.obj", QUAD + FACES)
    change(scene / "scene.toml", 'source = "constant"\nvalue = 300.0', 'source = "raster"\nraster = "temperature.tif"')
    words = "temperature.tif is a raster for surface 'model:mesh', which has no texture that it could lie on"
    refused(words, "render", scene)


PLY = """ply
format ascii 1.0
comment TextureFile {}
element vertex 3
property float x
property float y
property float z
property float s
property float t
element face 1
property list uchar int vertex_indices
end_header
-8 -8 0 0 0
8 -8 0 1 0
8 8 0 1 1
3 0 1 2
"""


def textured_mesh(scene, kind, image):
    """Give the scene a mesh of the given kind that names an image as its texture."""
    if kind == "obj":
        (scene / "own.mtl").write_text(f"newmtl a\nmap_Kd {image}\n")
        mesh_scene(scene, "model.obj", "mtllib own.mtl\n" + QUAD + FACES_UV)
    elif kind == "ply":
        mesh_scene(scene, "model.ply", PLY.format(image))
    else:
        file = Gltf().square()
        file.tree["images"] = [{"uri": image}]
        mesh_scene(scene, file.write(scene / f"model.{kind}").name)


TEXTURED = ("obj", "ply", "glb", "gltf")


@pytest.mark.parametrize("kind", TEXTURED)
def test_texture_must_be_inside_the_scene(scene, refused, kind):
    from PIL import Image

    red = Image.new("RGB", (4, 4), (200, 0, 0))
    (scene / "textures").mkdir()
    red.save(scene / "textures" / "good one.png")
    textured_mesh(scene, kind, "textures/good one.png")
    colour = load_scene(scene).surfaces[0].colour
    assert colour.shape == (4, 4, 3) and (colour == (200, 0, 0)).all()
    # From a subfolder, a path with ".." that stays within the scene is allowed.
    (scene / "models").mkdir()
    for name in ("own.mtl", "model.bin", f"model.{kind}"):
        if (scene / name).exists():
            (scene / name).rename(scene / "models" / name)
    change(scene / "scene.toml", f"model.{kind}", f"models/model.{kind}")
    for name in ("own.mtl", f"model.{kind}"):
        if (scene / "models" / name).exists():
            data = (scene / "models" / name).read_bytes()
            (scene / "models" / name).write_bytes(data.replace(b"textures/good one.png", b"../textures/other.png"))
    red.save(scene / "textures" / "other.png")
    assert load_scene(scene).surfaces[0].colour.shape == (4, 4, 3)
    # Nothing outside is read, whether it exists or not, and not through a link.
    red.save(scene.parent / "x.png")
    (scene / "link.png").symlink_to(scene.parent / "x.png")
    for image in ("../x.png", "../../x.png", str(scene.parent / "x.png"), "link.png", "http://localhost/x.png"):
        textured_mesh(scene, kind, image)
        outside = "does not exist" if image.startswith("http") else "is outside the scene's folder"
        refused([f"model.{kind} names {image!r}, which {outside}"], "render", scene)
    textured_mesh(scene, kind, "none.png")
    refused([f"model.{kind} names 'none.png', which does not exist"], "render", scene)
    (scene / "none.png").write_text("garbage")
    refused([f"model.{kind}: the texture", "cannot be read", "give a complete PNG or JPEG"], "render", scene)


def test_other_files_of_a_mesh_must_be_inside_the_scene(scene, refused):
    mesh_scene(scene, Gltf().square().write(scene / "model.gltf", buffer="../out.bin").name)
    refused("model.gltf names '../out.bin', which is outside the scene's folder", "render", scene)
    (scene.parent / "out.mtl").write_text("newmtl a\nKd 1 0 0\n")
    mesh_scene(scene, "model.obj", "mtllib ../out.mtl\n" + QUAD + FACES_UV)
    refused("model.obj names '../out.mtl', which is outside the scene's folder", "render", scene)
    car = OBJECT.replace('shape = "disc"', 'file = "model.obj"')
    (scene / "scene.toml").write_text(SCENE.replace("[sky]", car + "[sky]"))
    refused("model.obj names '../out.mtl', which is outside the scene's folder", "render", scene)


def huge_png(path, side=100_000):
    """A PNG of a few bytes whose header claims `side` pixels along each side."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b""))


@pytest.mark.parametrize("kind", TEXTURED)
def test_texture_size_is_limited(scene, refused, kind):
    huge_png(scene / "huge.png")
    textured_mesh(scene, kind, "huge.png")
    refused([f"model.{kind}: the texture", "up to 536870912 pixels"], "render", scene)


def test_texture_limit_is_independent_of_pillows(scene, monkeypatch):
    """Pillow warns above, and refuses above twice, its own limit, which a large texture exceeds."""
    from PIL import Image

    Image.new("RGB", (5, 4)).save(scene / "good.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 6)
    for kind in TEXTURED:
        textured_mesh(scene, kind, "good.png")
        assert load_scene(scene).surfaces[0].colour.shape == (4, 5, 3)
    assert Image.MAX_IMAGE_PIXELS == 6 and MOST_TEXELS >= 16384**2


# --- the camera -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("f_number =", "f_numbr =", ["unknown key 'f_numbr'", "did you mean 'f_number'"]),
        ("netd_mk = 50.0\n", "", ["key 'netd_mk' is missing"]),
        ("netd_mk = 50.0", "netd_mk = -50.0", ["netd_mk=-50.0 is not allowed", "a number above 0 and up to 100000 mK"]),
        ("width = 16", "width = 16.5", ["width=16.5 is not allowed", "a whole number 1…16384 pixels"]),
        ("width = 16", "width = 160000000", ["width=160000000 is not allowed", "a whole number 1…16384 pixels"]),
        ("width = 16", 'width = "16"', ["width='16' is not allowed"]),
        ("width = 16", "width = 1" + 400 * "0", ["width=1", "a whole number 1…16384"]),
        ("bits = 14", "bits = 99", ["bits=99 is not allowed", "a whole number 2…16"]),
        ("[7.5, 13.5]", "[0.0, 13.5]", ["band_um=[0.0, 13.5]", "above 0 and up to 1000 µm"]),
        ("[7.5, 13.5]", "[13.5, 7.5]", ["band_um=[13.5, 7.5]", "lower value first"]),
        ("[7.5, 13.5]", "[7.5]", ["band_um=[7.5] is not allowed", "a list of 2 numbers"]),
        ("[-25.0, 135.0]", "[-300.0, 135.0]", ["range_c=[-300.0, 135.0]", "above -273.15 and up to 5000 °C"]),
        ("= 0.9", "= 90.0", ["lens_transmittance=90", "a number above 0 and up to 1"]),
        ("bits", "distortion = [-50.0, 0, 0, 0, 0]\nbits", ["folds the image before its edge"]),
        ("bits", "distortion = [1e9, -1e200, 5, 0, 0]\nbits", ["folds the image before its edge"]),
        ("bits = 14", "bits = ", ["is not valid TOML"]),
    ],
)
def test_wrong_cameras(scene, refused, old, new, words):
    change(scene / "small.toml", old, new)
    refused(words, "render", scene)


def test_width_may_be_a_whole_float(scene):
    change(scene / "small.toml", "width = 16", "width = 16.0")
    assert load_scene(scene).camera.width == 16 and isinstance(load_scene(scene).camera.width, int)


# --- flights ----------------------------------------------------------------------------------------------------

QUATERNIONS = "time_s,east_m,north_m,up_m,qw,qx,qy,qz\n"


@pytest.mark.parametrize(
    "text, words",
    [
        (f"{COLUMNS}\n1,0,0,20,-90,0\n0,0,0,20,-90,0\n", ["flight.csv, row 3, column 'time_s'", "running backwards"]),
        (f"{COLUMNS}\n0,0,0,nan,-90,0\n", ["row 2, column 'above_ground_m'", "not a finite number"]),
        (f"{COLUMNS}\n0,0,0,20\n", ["row 2: 4 cells where row 1 names 6 columns"]),
        (f"{COLUMNS}\n", ["has no rows below the header"]),
        ("", ["the file is empty"]),
        ("time_s,east_m,above_ground_m\n0,0,20\n", ["column 'north_m' is missing"]),
        ("time_s,east_m,north_m\n0,0,20\n", ["has no height column", "above_ground_m"]),
        ("east_m,north_m,up_m\n0,0,20\n", ["column 'time_s' is missing"]),
        ("time_s,east_m,nort_m,up_m\n0,0,0,20\n", ["column 'nort_m' is not known", "'north_m'"]),
        (QUATERNIONS + "0,0,0,20,1,1,0,0\n", ["row 2, columns qw, qx, qy, qz", "length 1.41421", "unit quaternions"]),
        (QUATERNIONS + "0,0,0,20,1e300,0,0,0\n", ["length inf", "unit quaternions"]),
        (f"{COLUMNS}\n0,0,0,1e300,-90,0\n", ["the position is 1e+297 km from the scene's origin"]),
        (f"{COLUMNS}\n0,1e300,0,20,-90,0\n", ["there is no ground below east 1000000"]),
        (
            f"{COLUMNS}\n0,0,0,20,-90,0\n1e300,0,0,20,-90,0\n",
            ["row 3, column 'time_s'", "1e+300 s is not a time of a flight"],
        ),
    ],
)
def test_wrong_logs(scene, refused, text, words):
    (scene / "flight.csv").write_text(text)
    refused(words, "fly", scene, *QUICK)


def test_missing_and_binary_logs(scene, refused, tmp_path):
    refused(["none.csv cannot be read", "No such file"], "fly", scene, "--trajectory", tmp_path / "none.csv", *QUICK)
    (scene / "flight.csv").write_bytes(b"\xff\xfe\x00")
    refused("flight.csv is not UTF-8 text", "fly", scene, *QUICK)
    (scene / "flight.csv").unlink()
    refused("flight.csv does not exist, and no other log is given; add --trajectory", "fly", scene, *QUICK)


@pytest.mark.slow
def test_two_samples_at_the_same_time(scene, refused, call, tmp_path):
    change(scene / "scene.toml", "[camera]", '[truth]\ntemperature = "temperature.tif"\n[camera]')
    (scene / "flight.csv").write_text(f"{COLUMNS}\n0,0,0,20,-90,0\n0,1,0,20,-90,0\n1,2,0,20,-90,0\n")
    for verb in ("fly", "compare"):
        words = ["flight.csv, row 3, column 'time_s': '0' follows the same time in row 2", "duplicates=spread"]
        refused(words, verb, scene, *QUICK)
        refused("duplicates='all' is unknown", verb, scene, "--duplicates", "all", *QUICK)
        model = ["--models", "fok-1to1"] if verb == "compare" else ["--products", "counts"]
        for choice in ("spread", "first"):
            output = tmp_path / verb / choice
            status, _, errors = call(verb, scene, "-o", output, "--duplicates", choice, *model, *QUICK)
            assert status == 0 and "error" not in errors


def test_frames_without_terrain_are_reported(scene, call, tmp_path):
    flight = ["fly", scene, "--products", "counts", *QUICK]
    status, printed, errors = call(*flight, "-o", tmp_path / "a")
    assert (status, errors) == (0, "") and "show no terrain" not in printed
    (scene / "flight.csv").write_text(f"{COLUMNS}\n0,0,0,20,-90,0\n1,1,0,20,60,0\n2,2,0,20,60,0\n")
    status, printed, errors = call(*flight, "-o", tmp_path / "b")
    assert status == 0 and "2 of 3 frames show no terrain" in printed
    assert errors.startswith(
        "warning: 2 of 3 frames looked at show no terrain: the flight is over the terrain, but the"
    )


def test_path_below_the_terrain(scene, refused, call, tmp_path):
    (scene / "flight.csv").write_text(f"{COLUMNS.replace('above_ground_m', 'up_m')}\n0,0,0,-20,90,0\n")
    refused(["at 0.000 s the camera is 2", "m below the ground"], "fly", scene, *QUICK)
    status, _, errors = call("fly", scene, "-o", tmp_path / "o", "--allow-below-ground", "--products", "counts", *QUICK)
    assert status == 0 and errors.startswith("warning: 100% of what the camera sees is backs of faces: the camera is")
    assert len(errors.splitlines()) == 1


@pytest.mark.parametrize(
    "options, words",
    [
        ("--products counts,bogus", ["product 'bogus' is unknown", "exr, counts"]),
        ("--products ,", ["products is empty"]),
        ("--products truth", ["'truth' is channels of the EXR", "add 'exr'"]),
        ("--products video", ["add 'display'"]),
        ("--products counts --thermography emissivity=0.9", ["goes into 'exr' and 'radiometric'"]),
        ("--thermography emisivity=0.9", ["unknown key 'emisivity'", "did you mean 'emissivity'"]),
        ("--display clahe", ["display mode 'clahe' is unknown", "linear, plateau, local"]),
        ("--palette hot", ["palette 'hot' is unknown", "ironbow"]),
        ("--agc-memory-s -1", ["memory_s=-1 is not allowed"]),
        ("--seed -1", ["seed=-1 is not allowed"]),
        ("--quality finest", ["quality='finest' is unknown", "fast, standard, high"]),
        ("--rays 0", ["rays=0 is not allowed", "1…65536"]),
        ("--device tpu", ["device='tpu' is unknown", "auto, cpu, cuda"]),
        ("--anchor here", ["anchor='here' has 1 values; 4 are needed: E,N,U,heading"]),
        ("--anchor 1,2,x,4", ["anchor='1,2,x,4': U is 'x', not a finite number"]),
        ("--anchor 900,0,20,0", ["anchor: there is no ground below east 900 m"]),
        ("--anchor 0,0,1e300,0", ["km from the scene's origin"]),
        ("--mount 1,2", ["mount='1,2' has 2 values"]),
        ("--lever-arm-m 1,2", ["lever_arm='1,2' has 2 values"]),
        ("--clock-offset-s nan", ["clock_offset_s=nan is not a finite number"]),
        ("--rate-hz 0", ["rate_hz=0", "must be a positive number"]),
        ("--rate-hz 1e12", ["rate_hz=1e+12 makes 2e+12 frames", "up to 1000000"]),
        ("--start-s 5", ["start_s=5, stop_s=2", "0 to 2 s"]),
        ("--format bogus", ["format='bogus' is neither", "dji-gimbal"]),
        ("--temperature bogus", ["learned map 'bogus' is unknown", "fok-1to1"]),
        ("--range-c 1,2", ["--range-c='1,2' needs a learned map"]),
        ("--temperature fok-1to1 --range-c 1", ["--range-c='1' has 1 values"]),
        ("--temperature fok-1to1 --range-c 1e300,2e300", ["range_c=[1e+300, 2e+300] is not allowed", "°C"]),
        ("--bogus", ["No such option: --bogus", "fly --help"]),
        ("--seed x", ["Invalid value for '--seed'"]),
    ],
)
def test_wrong_options_of_a_flight(scene, refused, options, words):
    options = options.split()
    refused(words, "fly", scene, *([] if {"--rays", "--quality"} & set(options) else QUICK), *options)


@pytest.mark.parametrize(
    "options, words",
    [
        ("--pose nonsense", ["--pose='nonsense' has 1 values; 6 are needed: E,N,U,YAW,PITCH,ROLL"]),
        ("--pose 0,0,20,0,nan,0", ["--pose='0,0,20,0,nan,0': PITCH is 'nan'"]),
        ("--pose 0,0,1e30,0,-90,0", ["up 1e+30 m is more than 100 km"]),
        ("--pose 1e300,0,0,0,-90,0", ["is outside the terrain"]),
        ("--seed -1", ["seed=-1 is not allowed"]),
        ("--quality finest", ["quality='finest' is unknown"]),
        ("--products bogus", ["product 'bogus' is unknown"]),
        ("--pose 0,0,-5,0,-90,0", ["--pose='0,0,-5,0,-90,0' is 5 m under the terrain", "--local-up"]),
        ("--engine reference --paths 0", ["--paths=0 is not allowed", "at least 1"]),
        ("--air tropical,rural-23km,5", ["--air='tropical,rural-23km,5' has 3 parts", "ATMOSPHERE,AEROSOL"]),
    ],
)
def test_wrong_options_of_a_render(scene, refused, options, words):
    refused(words, "render", scene, *options.split())


@pytest.mark.parametrize("text, words", [
    ("[[", "is not valid TOML: "),
    ("[time]\nstamps = 5\n", "time.stamps=5 is not allowed; give tables headed [[time.stamps]]"),
    ("[[time.stamps]]\ncolumn = 5\npattern = 7\n", "time.stamps 1.column=5 is not allowed; give a text"),
    ("[tme]\n", "unknown key 'tme'; did you mean 'time'"),
])  # fmt: skip
def test_wrong_mapping_files(scene, refused, tmp_path, text, words):
    (tmp_path / "own.toml").write_text(text)
    refused(["own.toml", words], "fly", scene, "--format", tmp_path / "own.toml", *QUICK)


def test_wrong_command_lines(call):
    for arguments, words in (
        (["nonsense"], "No such command 'nonsense'"),
        (["render"], "Missing argument"),
        (["render", "heath"], "Missing option '-o'"),
    ):
        status, _, errors = call(*arguments)
        check_sentence(status, errors, [words, "--help` lists what is allowed"])
    for arguments in ([], ["--help"], ["fly", "--help"]):
        status, output, errors = call(*arguments)
        assert (status, errors) == (0, "") and "Usage" in output


def test_debug_raises_the_original_error(scene, monkeypatch, tmp_path):

    arguments = ["thermorender", "render", str(scene), "-o", str(tmp_path / "o"), "--quality", "finest", "--debug"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(ThermorenderError, match="quality='finest'"):
        cli.main()


# --- output -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", ["render", "fly", "compare", "import-terrain"])
def test_output_that_cannot_be_written(scene, call, tmp_path, verb):
    change(scene / "scene.toml", "[camera]", '[truth]\ntemperature = "temperature.tif"\n[camera]')
    inputs = [scene / "elevation.tif", scene / "orthophoto.tif"] if verb == "import-terrain" else [scene, *QUICK]
    (tmp_path / "file").write_text("precious")
    for output in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/thermorender")):
        status, _, errors = call(verb, *inputs, "-o", output)
        check_sentence(status, errors, [output])
    assert (tmp_path / "file").read_text() == "precious"
    long = tmp_path / "new" / ("x" * 300)
    status, _, errors = call(verb, *inputs, "-o", long)
    check_sentence(status, errors, ["File name too long"])
    assert not long.parent.exists()


def test_failed_run_removes_its_new_folder(scene, refused, monkeypatch):
    from thermorender.render.renderer import Renderer

    def fail(self, *arguments, **named):
        raise ThermorenderError("the bake failed")

    change(scene / "scene.toml", "[camera]", '[truth]\ntemperature = "temperature.tif"\n[camera]')
    monkeypatch.setattr(Renderer, "frame", fail)
    refused("the bake failed", "render", scene, *QUICK)
    refused("the bake failed", "fly", scene, *QUICK)
    refused("the bake failed", "compare", scene, *QUICK)


def test_compare_names_the_wrong_option(scene, refused):
    change(scene / "scene.toml", "[camera]", '[truth]\ntemperature = "temperature.tif"\n[camera]')
    refused("learned map 'x' is unknown", "compare", scene, "--models", "x", *QUICK)
    refused("models is empty", "compare", scene, "--models", ",", *QUICK)
    refused("--run-time='fok-1to1=0' is not allowed", "compare", scene, "--run-time", "fok-1to1=0", *QUICK)
    refused("--run-time='fok-1to1' is not allowed; give NAME=MS", "compare", scene, "--run-time", "fok-1to1", *QUICK)
    refused(
        "--methods='photograph,G' is not allowed; give some of photograph, true-m",
        "compare",
        scene,
        "--methods",
        "photograph,G",
    )
    refused("quality='finest' is unknown", "compare", scene, "--quality", "finest")


# --- a flight continued -----------------------------------------------------------------------------------------


def test_resume(scene, call, tmp_path):
    output = tmp_path / "o"
    flight = ["fly", scene, "-o", output, "--products", "counts,display,video", *QUICK]
    assert call(*flight)[0] == 0
    whole = everything(output)

    def untouched(words, *more):
        before = everything(output)
        status, _, errors = call(*flight, *more)
        check_sentence(status, errors, words)
        assert everything(output) == before

    untouched([output, "already holds a flight", "set resume"])
    untouched([output / "flight.json", "was flown with seed=0, now seed=1"], "--resume", "--seed", "1")
    untouched(["scene_digest=", ", of the scene with its files, air"], "--resume", "--air", "tropical")
    untouched(["path_digest=", ", of the trajectory with its anchor"], "--resume", "--lever-arm-m", "0,0,1")
    with files.in_use(output):
        untouched([output, "is being written by another process"], "--resume")
    before = everything(output)
    status, _, errors = call("render", scene, "-o", output)
    check_sentence(status, errors, [output, "holds a flight", "another folder"])
    assert everything(output) == before
    untouched(["was flown with products=", "resume with the same settings"], "--resume", "--products", "counts")

    lines = (output / "frames.jsonl").read_text()
    (output / "frames.jsonl").write_text(lines[:-40])
    status, printed, errors = call(*flight, "--resume")
    assert (status, errors) == (0, "") and "3 frames, 1 rendered now" in printed
    assert everything(output) == whole

    (output / "frames.jsonl").write_bytes(b"\xff\xfe\x00 not JSON")
    status, printed, _ = call(*flight, "--resume")
    assert status == 0 and "3 rendered now" in printed and everything(output) == whole

    for damage in (whole[output / "flight.json"][:50], b"[]", b"\xff"):
        (output / "flight.json").write_bytes(damage)
        untouched([output / "flight.json", "is damaged", "another folder"], "--resume")
    (output / "flight.json").unlink()
    untouched([output / "flight.json", "is missing beside frames.jsonl"], "--resume")
    (output / "frames.jsonl").unlink()
    untouched(["already holds frame_000000", "which a flight would overwrite"])

    (output / "flight.json").write_bytes(whole[output / "flight.json"])
    (output / "frames.jsonl").write_bytes(whole[output / "frames.jsonl"])
    (output / "frame_000001.png").write_bytes(b"garbage")
    status, printed, _ = call(*flight, "--resume")
    assert status == 0 and "2 rendered now" in printed and everything(output) == whole


def test_resume_without_a_flight_starts_one(scene, call, tmp_path):
    status, printed, _ = call("fly", scene, "-o", tmp_path / "o", "--resume", "--products", "counts", *QUICK)
    assert status == 0 and "3 rendered now" in printed
    assert json.loads((tmp_path / "o" / "flight.json").read_text())["frames"] == 3


def test_damaged_exr(scene, tmp_path):

    (tmp_path / "a.exr").write_text("garbage")
    with pytest.raises(ThermorenderError, match=r"a.exr cannot be read as EXR"):
        read_exr(tmp_path / "a.exr")


# --- the machine ------------------------------------------------------------------------------------------------


@pytest.fixture
def no_llvm(monkeypatch):
    """A machine without LLVM libraries, as a process that has not chosen a variant yet finds it."""
    import mitsuba

    from thermorender.render import variant

    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(variant, "_SEARCH", ())
    monkeypatch.setattr(variant.ctypes.util, "find_library", lambda name: None)
    monkeypatch.setattr(mitsuba, "variant", lambda: None)
    return variant


def test_device_cannot_change_within_a_process(monkeypatch):
    import mitsuba

    from thermorender.render.variant import activate

    monkeypatch.setattr(mitsuba, "variant", lambda: "cuda_ad_mono")
    monkeypatch.setattr(mitsuba, "set_variant", lambda name: pytest.fail("the variant was changed under its scenes"))
    with pytest.raises(ThermorenderError, match="device='cpu' is not allowed while this process renders on 'cuda'"):
        activate("cpu")
    assert activate("auto") is mitsuba


def test_no_llvm(scene, refused, no_llvm):
    refused(
        ["no LLVM library of version 16 or newer", "apt-get install libllvm19", "DRJIT_LIBLLVM_PATH"],
        "render", scene, "--device", "cpu", *QUICK,
    )  # fmt: skip


def test_old_llvm(scene, refused, no_llvm, monkeypatch, tmp_path):
    (tmp_path / "libLLVM-15.so.1").write_text("")
    monkeypatch.setattr(no_llvm, "_SEARCH", (str(tmp_path / "libLLVM*.so*"),))
    assert list(no_llvm.llvm_libraries().values()) == [15] and no_llvm.usable_llvm() is None
    refused("no LLVM library of version 16 or newer", "render", scene, "--device", "cpu", *QUICK)
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-15.so.1"))
    refused(["libLLVM-15.so.1 is LLVM 15", "apt-get install"], "render", scene, "--device", "cpu", *QUICK)
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "none.so"))
    refused(["none.so does not exist", "apt-get install"], "render", scene, "--device", "cpu", *QUICK)


# --- a separate process -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", [*slow("scene", "mesh", "log"), "raster", "option"])
def test_as_a_process(scene, tmp_path, case):
    """Nothing else writes to the error stream: no logging, no library, no progress bar."""
    arguments, words = ["render", str(scene)], "scene.toml"
    if case == "scene":
        change(scene / "scene.toml", "= 250.0", "= 20.0")
    elif case == "raster":
        cut(scene / "orthophoto.tif", 0.8)
        words = "orthophoto.tif cannot be read as a raster"
    elif case == "mesh":
        mesh_scene(scene, "model.glb", "garbage")
        words = "model.glb cannot be read as a mesh"
    elif case == "log":
        (scene / "flight.csv").write_text("time_s\n")
        arguments, words = ["fly", str(scene)], "flight.csv"
    else:
        arguments, words = ["fly", str(scene), "--seed", "x"], "--seed"
    run = subprocess.run(
        [sys.executable, "-m", "thermorender", *arguments, "-o", str(tmp_path / "o")],
        capture_output=True, text=True, encoding="utf-8", env={**os.environ, "PYTHONIOENCODING": "utf-8"},
    )  # fmt: skip
    check_sentence(run.returncode, run.stderr, [words])
    assert run.stdout == "" and not (tmp_path / "o").exists()
