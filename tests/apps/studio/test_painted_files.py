"""Painted texels in the class rasters of a scene's own files: what is read again is what was shown."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from rasterio.warp import transform

import thermorender as tr
from scenes import write_raster, write_terrain
from thermorender.apps.studio.scene_files import SceneFiles
from thermorender.errors import ThermorenderError
from thermorender.scene.georeference import place_of

FRAME = "[frame]\nlatitude_deg = 52.0\nlongitude_deg = 20.0\nheight_m = 100.0\n"
# Ground of 20 m with a texture of 16 × 8 texels, which its `repeat` shows more than once; a wall on it; a roof beside.
OBJ = (
    "mtllib m.mtl\nv 0 0 0\nv 20 0 0\nv 20 20 0\nv 0 20 0\nv 5 5 3\nv 9 5 3\nv 9 9 3\nv 20 20 5\nv 0 20 5\n"
    "vt 0 0\nvt {repeat} 0\nvt {repeat} 1\nvt 0 1\nusemtl ground\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    "usemtl wall\nf 4/1 3/2 8/3\nf 4/1 8/3 9/4\nusemtl tiles\nf 5 6 7\n"
)
SURFACES = (
    '[[surface]]\nname = "t.png"\nclasses = "ground.png"\n[[surface]]\nname = "u.png"\nclasses = "wall.png"\n'
    '[[surface]]\nname = "tiles"\nmaterial = "roof_tile_clay"\n'
)
PALETTE = [0, 0, 0, 10, 160, 20, 90, 90, 95]


def write_mesh_scene(folder, repeat=1):
    """Write a mesh of ground, a wall and a roof, with a class raster in a palette and a grey one; return its folder."""
    folder.mkdir(exist_ok=True)
    for name in ("t.png", "u.png"):
        Image.fromarray(np.full((16, 8, 3), 120, np.uint8)).save(folder / name)
    (folder / "m.mtl").write_text(
        "newmtl ground\nmap_Kd t.png\nnewmtl wall\nmap_Kd u.png\nnewmtl tiles\nKd 0.6 0.2 0.1\n"
    )
    (folder / "m.obj").write_text(OBJ.format(repeat=repeat))
    numbers = np.ones((16, 8), np.uint8)
    numbers[8:] = 2
    Image.fromarray(numbers).save(folder / "wall.png")
    # A texel without a class, which has that of the nearest one.
    numbers[4, 4] = 0
    ground = Image.fromarray(numbers, "P")
    ground.putpalette(PALETTE)
    ground.save(folder / "ground.png")
    (folder / "scene.toml").write_text(
        '[terrain]\nmesh = "m.obj"\n[temperature]\nsource = "constant"\nvalue = 290.0\n[emissivity]\n'
        'source = "material"\nmaterial = "soil_loam"\n[emissivity.classes]\n1 = "grass_green"\n2 = "asphalt"\n'
        f"[sky]\ntemperature = 255.0\n{FRAME}{SURFACES}",
        encoding="utf-8",
    )
    return folder


def write_raster_scene(folder, step=0.5):
    """Write a raster terrain of 32 × 32 texels whose class raster has cells of `step` [m]; return its folder."""
    side = round(16 / step)
    classes = np.where(np.arange(side) < side // 2, 1, 2) * np.ones((side, 1), np.int64)
    if step <= 0.5:
        # Cells without a class, which have that of the nearest one.
        classes[3, side // 2 : side // 2 + 3] = 0
    write_terrain(folder, classes=np.ones((32, 32)))
    write_raster(folder / "classes.tif", classes[None].astype(np.uint8), step)
    return folder


def names(scene):
    """The name of each texel's material, of the terrain's surfaces one after the other."""
    known = np.array([material.name for material in scene.materials])
    return np.concatenate([known[surface.material].ravel() for surface in scene.surfaces[: scene.terrain_count]])


def box(scene, low, high):
    """GeoJSON of a box between two corners (east, north) [m], in longitude and latitude."""
    corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]), (low[0], low[1])]
    place = place_of(scene.frame, scene.grid)
    lon_lat = np.column_stack(transform(place.crs, "OGC:CRS84", *place.to_map([(*each, 0.0) for each in corners])))
    geometry = {"type": "Polygon", "coordinates": [lon_lat.tolist()]}
    return {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": geometry}]}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def assert_saved_as_shown(files, document):
    """Save a document; what is read again has the materials that it shows."""
    save = files.plan(document)
    files.write(save)
    read, shown = tr.load_scene(files.scene.spec.folder), document.scene(files.scene, files.origin)
    np.testing.assert_array_equal(names(read), names(shown))
    assert files.plan(document).files == {}
    return save.lines


@pytest.mark.parametrize("write", [write_raster_scene, write_mesh_scene])
def test_painted_texels_are_read_again_as_they_were_shown_also_after_undo(tmp_path, write):
    folder = write(tmp_path / "scene")
    before, scene = contents(folder), tr.load_scene(folder)
    files = SceneFiles(scene)
    area = scene.texels_in(box(scene, (2.0, 2.0), (7.0, 6.0)))
    # Beside the texels without a class, which keep theirs.
    near = np.flatnonzero(np.abs(np.arange(1024) - 3 * 32 - 16) < 2) if scene.grid else [3 * 8 + 4, 4 * 8 + 3]
    first = files.saved.with_texels(near, "snow").with_area(box(scene, (2.0, 2.0), (7.0, 6.0)), "sand_quartz")
    second = first.with_texels(area[: len(area) // 2], "concrete").with_texels(near[:1], "asphalt")
    lines = assert_saved_as_shown(files, first)
    (line,) = (each for each in lines if "texels of another class" in each)
    changed = int((names(scene) != names(first.scene(scene, files.origin))).sum())
    # And what the texels without a class would take from painted ones.
    assert line.split("  ")[0] == ("classes.tif" if scene.grid else "ground.png")
    assert changed <= int(line.split()[1]) <= changed + 3 and {"snow", "sand_quartz"} <= set(
        names(tr.load_scene(folder))
    )
    assert_saved_as_shown(files, second)
    assert_saved_as_shown(files, first)
    assert_saved_as_shown(files, replace(first, painted=()))
    # Where all is taken back, files have the bytes that were read.
    assert contents(folder) == before
    # Another session begins from saved files.
    files.write(files.plan(second))
    again = SceneFiles(tr.load_scene(folder))
    assert_saved_as_shown(again, again.saved.with_texels([0], "snow"))


def test_class_images_of_a_mesh_keep_their_mode_palette_and_size(tmp_path):
    folder = write_mesh_scene(tmp_path / "scene")
    scene = tr.load_scene(folder)
    files, (ground, *_) = SceneFiles(scene), scene.surfaces
    texels = [5, 6, ground.material.size + 3, ground.material.size + 4, ground.material.size + 5]
    lines = assert_saved_as_shown(files, files.saved.with_texels(texels, "snow"))
    assert [each for each in lines if "texels" in each] == [
        "ground.png  2 texels of another class", "wall.png  3 texels of another class"
    ]  # fmt: skip
    with Image.open(folder / "ground.png") as image, Image.open(folder / "wall.png") as other:
        assert (image.mode, image.size, other.mode, other.size) == ("P", (8, 16), "L", (8, 16))
        numbers = np.array(image)
        shown = np.array(image.convert("RGB"))
    # Old classes have their colours, and the new one that of its material.
    snow = next(material for material in tr.load_scene(folder).materials if material.name == "snow")
    assert tuple(shown[numbers == 3][0]) == tuple(snow.colour) and (numbers == 3).sum() == 2
    assert tuple(shown[numbers == 1][0]) == (10, 160, 20) and tuple(shown[numbers == 2][0]) == (90, 90, 95)
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        ["t.png", "u.png", "m.mtl", "m.obj", "ground.png", "wall.png", "scene.toml"]
    )


def test_texels_are_saved_in_finer_cells_of_the_class_raster(tmp_path):
    files = SceneFiles(tr.load_scene(write_raster_scene(tmp_path / "scene", step=0.125)))
    assert files.scene.surfaces[0].material.shape == (32, 32)
    lines = assert_saved_as_shown(files, files.saved.with_texels([40, 41, 500, 733], "snow"))
    assert "classes.tif  64 texels of another class" in lines


def test_texels_are_saved_in_coarser_cells_by_their_middles(tmp_path):
    folder = write_raster_scene(tmp_path / "scene", step=2.0)
    files = SceneFiles(tr.load_scene(folder))
    with pytest.raises(ThermorenderError, match=r"classes\.tif has cells too large for a painted area.*paint a larger"):
        files.plan(files.saved.with_texels([0], "snow"))
    row, column = np.mgrid[:32, :32]
    files.write(files.plan(files.saved.with_texels(np.flatnonzero((row < 6) & (column < 8)), "snow")))
    found = (names(tr.load_scene(folder)) == "snow").reshape(32, 32)
    # Cells are 4 texels wide.
    # The middle of the second row of cells is on the border of what was painted, so that it may be in or out.
    assert found[:4, :8].all() and not (found & ~((row < 8) & (column < 8))).any()
    assert len(np.unique(found[4:8, :8])) == 1


def no_classes(folder):
    path = folder / "scene.toml"
    path.write_text(path.read_text().replace(SURFACES[: SURFACES.index('[[surface]]\nname = "u')], ""))


def write_far_scene(folder):
    """Write a raster terrain amid far ground with classes of its own."""
    far = '[[terrain.far]]\nelevation = "far.tif"\ntemperature = 280.0\nclasses = "far_classes.tif"\n'
    write_terrain(folder, extra=far)
    for name, values in (
        ("far.tif", np.zeros((1, 61, 61), np.float32)),
        ("far_classes.tif", np.ones((1, 61, 61), "u1")),
    ):
        write_raster(folder / name, values, 40.0, corner=(500008.0 - 1220.0, 5779992.0 + 1220.0))
    return folder


REFUSED = {
    "surface 'm:tiles' has no raster of classes in the pixels of its texture.*; undo them, or give it classes in": (
        write_mesh_scene, lambda files: [files.scene.surfaces[0].material.size * 2]),
    "surface 'm:ground' has no raster of classes in the pixels": (
        lambda folder: (write_mesh_scene(folder), no_classes(folder))[0], lambda files: [3]),
    "surface 'm:ground' repeats its texture, so ground.png holds one class for all repeats": (
        lambda folder: write_mesh_scene(folder, repeat=3), lambda files: [3]),
    "there is no raster of classes, which painted areas are saved in; undo them, or make one with": (
        lambda folder: write_plain(folder), lambda files: [3]),
    "painted texels of far ground are not saved; undo them, or paint the scene within it": (
        lambda folder: write_far_scene(folder), lambda files: [files.scene.surfaces[0].material.size + 5]),
    "with_material_at: texels=.* is not allowed; give one or more whole numbers 0…1023": (
        write_raster_scene, lambda files: [4096]),
}  # fmt: skip


def write_plain(folder):
    """Write a raster terrain of one material."""
    path = write_terrain(folder) / "scene.toml"
    text = path.read_text()
    begin, end = text.index("[emissivity]"), text.index("[sky]")
    path.write_text(f'{text[:begin]}[emissivity]\nsource = "material"\nmaterial = "soil_loam"\n{text[end:]}')
    return folder


@pytest.mark.parametrize("words", REFUSED)
def test_what_files_cannot_hold_is_refused_in_one_sentence_and_nothing_is_written(tmp_path, words):
    write, texels = REFUSED[words]
    folder = write(tmp_path / "scene")
    files, before = SceneFiles(tr.load_scene(folder)), contents(folder)
    with pytest.raises(ThermorenderError, match=words) as error:
        document = files.saved.with_texels(texels(files), "snow")
        _ = document.scene(files.scene, files.origin), files.plan(document)
    assert "\n" not in str(error.value) and contents(folder) == before


def test_all_repeats_of_a_texel_are_saved(tmp_path):
    files = SceneFiles(tr.load_scene(write_mesh_scene(tmp_path / "scene", repeat=2)))
    surface = files.scene.surfaces[0]
    assert surface.material.shape == (16, 16)
    assert_saved_as_shown(files, files.saved.with_texels([3, 11], "snow"))


def test_a_class_image_that_changed_on_disk_is_not_overwritten(tmp_path):
    folder = write_mesh_scene(tmp_path / "scene")
    files = SceneFiles(tr.load_scene(folder))
    save = files.plan(files.saved.with_texels([3], "snow"))
    Image.fromarray(np.ones((16, 8), np.uint8)).save(folder / "wall.png")
    with pytest.raises(
        ThermorenderError, match=r"wall\.png has changed on disk since it was read; nothing was written"
    ):
        files.write(save)


def test_paints_of_texels_are_compared_as_the_same_ones_or_others(tmp_path):
    document = SceneFiles(tr.load_scene(write_mesh_scene(tmp_path / "scene"))).saved
    one, other = document.with_texels([1, 2], "snow"), document.with_texels([1, 2], "snow")
    assert one.painted != other.painted and one.painted == replace(one, classes={}).painted
    assert one.with_text("snow", "emissivity", "0.9").painted == one.painted
    for texels in ([], [0.5], [True], "3"):
        with pytest.raises(ThermorenderError, match=r"texels=.* is not allowed; give one or more whole numbers"):
            document.with_texels(texels, "snow")
    with pytest.raises(ThermorenderError, match="the texels uses material 'aspalt'"):
        document.with_texels([1], "aspalt")


@pytest.mark.slow
def test_walls_of_a_made_village_are_saved_in_their_images(tmp_path, call):
    folder = tmp_path / "village"
    arguments = "--seed", "7", "--size-m", "60", "--texel-m", "0.5", "-o", folder
    assert call("make-scene", "village", *arguments)[0] == 0
    before, scene = contents(folder), tr.load_scene(folder)
    files = SceneFiles(scene)
    shown = tr.Renderer(scene, quality="fast").texels(scene.pose(0, -25, 6, yaw_deg=0, pitch_deg=-10))
    walls = np.unique(shown[200:300, 200:420])
    ground = scene.texels_in(box(scene, (-20.0, -20.0), (20.0, 20.0)))
    document = files.saved.with_texels(walls[walls >= 0], "metal_painted").with_texels(ground, "sand_quartz")
    lines = assert_saved_as_shown(files, document)
    assert {each.split("  ")[0] for each in lines} == {"buildings_classes.png", "ground_classes.png", "scene.toml"}
    assert_saved_as_shown(files, replace(document, painted=document.painted[1:]))
    assert_saved_as_shown(files, files.origin)
    assert contents(folder) == before
