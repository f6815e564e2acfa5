"""Tiled ground: frames equal those of one piece, whatever is cut, kept on disk or damaged there."""

import gc
import mmap
import pickle
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from rasterio import Affine
from scipy.spatial.transform import Rotation
from tiled_support import CORNER, hills, write_in_one_piece, write_tiled

import thermorender as tr
from scenes import WEATHER, narrow, write_raster
from thermorender.atmosphere.rays import EARTH_RADIUS_M
from thermorender.cache import cache_folder
from thermorender.errors import ThermorenderError
from thermorender.output.flight import FlightOptions
from thermorender.render.geometry import Geometry
from thermorender.render.renderer import Renderer
from thermorender.render.tiled import loading
from thermorender.render.tiled.baked_tile import TileStore
from thermorender.render.tiled.cells import assembled
from thermorender.render.tiled.squares import Squares
from thermorender.render.tiled.texel_memory import TexelMemory
from thermorender.render.tiled.tiled_renderer import TiledRenderer
from thermorender.render.variant import activate
from thermorender.scene import world as worlds
from thermorender.scene.georeference import place_of
from thermorender.scene.raster import Grid
from thermorender.scene.sources import Classes, Colours, Heights, rasters_of
from thermorender.scene.surface import FILLED, Surface
from thermorender.scene.tile_grid import APRON, Tile
from thermorender.trajectory.path import Trajectory


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def renderer_of(folder, monkeypatch, texels=64, rows=4, **settings):
    """A TiledRenderer of tiles of few texels."""
    monkeypatch.setattr(worlds, "TEXELS", texels)
    scene = narrow(tr.load_scene(folder))
    assert scene.world.grid.texels == texels
    return TiledRenderer(scene, rows=rows, **settings)


def in_one_piece(renderer, pose):
    """(Renderer of the same ground baked as one tile, in the frame of a pose's cell; the pose there)."""
    world, (cell, own) = renderer.world, renderer.at(pose)
    grid = world.grid
    rows = renderer.squares.rows

    class Whole(Squares):
        world = property(lambda self: replace(
            renderer.world, grid=replace(grid, texels=rows * grid.texels, cells=rows * grid.cells, levels=1)
        ))  # fmt: skip

    whole = Whole(renderer.scene, renderer.plan, 1)
    baked = whole.bake(Tile(0, 0, 0))
    memory = TexelMemory(whole.world.grid.texels + 2 * APRON, renderer.plan.spectrum.channels, slots=1)
    for tile, each in baked.items():
        memory.put(tile, each)
    baked = assembled(renderer.scene, renderer.plan, whole.world.grid, memory, cell.scene.frame, 50.0)
    return Renderer.of(baked), own


def radiance(tile, weights):
    """Weighted sum of the channels of a tile, (h, w)."""
    side = len(tile.first) // len(tile.rest)
    rest = np.kron(tile.rest.astype(float) @ weights[1:], np.ones((side, side)))
    return weights[0] * tile.first.astype(float) + rest


VIEWS = [((0, 0, 40, 0, -90, 0), 1.0), ((0, -30, 30, 20, -45, 0), 1.0), ((-20, -50, 18, 10, -12, 0), 1.0)]


@pytest.mark.parametrize("balanced", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_ground_in_tiles_looks_as_in_one_piece(tmp_path, monkeypatch, own_cache, balanced):
    weather = 'source = "balance"', WEATHER.replace('"', "")
    kind = {"temperature": weather[0], "extra": weather[1]} if balanced else {}
    renderer = renderer_of(write_tiled(tmp_path / "scene", **kind), monkeypatch, quality="fast", edge_mk=np.inf)
    for numbers, most_mk in VIEWS:
        pose = renderer.scene.pose(*numbers)
        one, own = in_one_piece(renderer, pose)
        cut, whole = renderer.frame(pose), one.frame(own)
        assert len(renderer.at(pose)[0].scene.surfaces) > 4
        off = 1e3 * (cut.apparent_temperature - whole.apparent_temperature)
        shown = np.isfinite(cut.truth["depth"])
        np.testing.assert_array_equal(shown, np.isfinite(whole.truth["depth"]))
        assert np.sqrt(np.mean(np.square(off[shown]))) < most_mk
        assert np.abs(off[shown]).max() < 100.0


def test_tiled_ground_looks_as_the_same_rasters_in_an_ordinary_scene(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    plain = write_in_one_piece(folder, tmp_path / "plain")
    renderer = renderer_of(folder, monkeypatch, edge_mk=np.inf, rays=256)
    scene = narrow(tr.load_scene(plain))
    other = Renderer(scene, edge_mk=np.inf, rays=256)
    map_of = place_of(renderer.scene.frame, renderer.scene.grid).to_map(np.zeros((1, 3)))
    assert np.allclose(map_of, place_of(scene.frame, scene.grid).to_map(np.zeros((1, 3))), atol=1.5)
    for numbers, _ in VIEWS[:2]:
        one, two = renderer.frame(renderer.scene.pose(*numbers)), other.frame(scene.pose(*numbers))
        # Frames of both scenes have their origins half a post apart; means are of the same ground.
        budget = np.hypot(one.budget_mk["total"], two.budget_mk["total"])
        assert 1e3 * abs(one.apparent_temperature.mean() - two.apparent_temperature.mean()) < 2.0 * budget


def test_a_damaged_or_missing_tile_is_baked_again_to_the_same_frame(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    renderer = renderer_of(folder, monkeypatch, quality="fast")
    pose = renderer.scene.pose(*VIEWS[1][0])
    first = renderer.frame(pose).radiance
    needed = renderer.tiles(renderer.cell(pose))
    stored = [renderer.store.path(tile) for tile in needed if tile.level == 0]
    assert len(stored) >= 4
    before = {path.name: path.read_bytes() for path in cache_folder("tiles").glob("*.npz")}
    stored[0].write_bytes(before[stored[0].name][:1000])
    stored[1].write_bytes(before[stored[1].name][:-300] + bytes(300))
    stored[2].unlink()
    again = renderer_of(folder, monkeypatch, quality="fast")
    np.testing.assert_array_equal(again.frame(pose).radiance, first)
    assert {path.name: path.read_bytes() for path in cache_folder("tiles").glob("*.npz")} == before


def test_tiles_on_disk_serve_again_and_are_not_baked(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    renderer = renderer_of(folder, monkeypatch, quality="fast")
    pose = renderer.scene.pose(*VIEWS[0][0])
    first = renderer.frame(pose).radiance

    def refuse(self, first, progress=None):
        raise AssertionError("a stored tile is baked")

    monkeypatch.setattr(Squares, "bake", refuse)
    again = renderer_of(folder, monkeypatch, quality="fast")
    np.testing.assert_array_equal(again.frame(pose).radiance, first)
    # Another weather, material or setting needs other tiles.
    other = renderer_of(folder, monkeypatch, quality="fast", rays=32)
    with pytest.raises(AssertionError, match="is baked"):
        other.frame(pose)


def test_what_no_texel_of_the_overview_shows_still_asks_for_other_tiles(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    text = (folder / "scene.toml").read_text(encoding="utf-8")
    keys = []
    # A fallback is for gaps of the classes, and the overview has none.
    for change in (("", ""), ('source = "classes"\n', 'source = "classes"\nfallback = "asphalt"\n'),
                   ('source = "classes"\n', 'source = "classes"\nfallback = "water"\n'),
                   ("materials = {", "value = 290.0\nmaterials = {")):  # fmt: skip
        (folder / "scene.toml").write_text(text.replace(*change, 1), encoding="utf-8")
        keys.append(renderer_of(folder, monkeypatch, quality="fast").store.key)
    assert len(set(keys)) == len(keys)
    moved = folder.rename(tmp_path / "moved")
    assert renderer_of(moved, monkeypatch, quality="fast").store.key == keys[-1]


def test_a_changed_file_beside_a_raster_asks_for_other_tiles(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    first = renderer_of(folder, monkeypatch, quality="fast")
    picture = folder / "photo" / "0.tif"
    (folder / "photo" / "0.tif.aux.xml").write_text("<PAMDataset/>", encoding="utf-8")
    later = renderer_of(folder, monkeypatch, quality="fast")
    assert later.store.key != first.store.key
    grid = later.world.grid.texel_grid(Tile(0, 0, 0))
    later.world.colours.read(grid)
    (folder / "photo" / "0.tif.aux.xml").write_text("<PAMDataset></PAMDataset>", encoding="utf-8")
    with pytest.raises(ThermorenderError, match=rf"{picture.name} was changed or removed"):
        later.world.colours.read(grid)


@pytest.mark.parametrize("name", ["photo", "classes", "dem"])
def test_of_files_on_one_another_the_last_by_name_counts(tmp_path, own_cache, name):
    folder = write_tiled(tmp_path / "scene")
    kind = {"photo": Colours, "classes": Classes, "dem": Heights}[name]
    before = kind(rasters_of(folder / name))
    step, (left, _, _, top) = before.extent.pixel, before.extent.bounds
    shape = (16, 16)
    patch = {"photo": np.full((3, *shape), 250, np.uint8), "classes": np.full((1, *shape), 9, np.uint8),
             "dem": np.full((1, *shape), 77.0, np.float32)}[name]  # fmt: skip
    patch[:, :, 8:] = 0 if name != "dem" else np.nan
    more = {"photometric": "RGB"} if name == "photo" else {"nodata": np.nan} if name == "dem" else {}
    write_raster(folder / name / "z.tif", patch, step, corner=(left + 32 * step, top - 32 * step), **more)
    if name == "photo":
        with rasterio.open(folder / name / "z.tif", "r+") as file:
            file.write_mask(np.where(patch[0] > 0, 255, 0).astype(np.uint8))
    for size in (1, 2):
        grid = Grid(before.extent.crs, Affine(size * step, 0.0, left + 32 * step, 0.0, -size * step, top - 32 * step),
                    16 // size, 16 // size)  # fmt: skip
        one, other = (np.asarray(each[0] if name == "photo" else each, float)
                      for each in (before.read(grid), kind(rasters_of(folder / name)).read(grid)))  # fmt: skip
        inner = 8 // size - 1
        assert (other[:, :inner] == patch.flat[0]).all()
        np.testing.assert_array_equal(other[:, inner + 2 :], one[:, inner + 2 :])


def test_a_map_that_takes_hour_or_relief_is_refused_at_once(tmp_path, monkeypatch, own_cache):
    one = 'source = "learned"\nmodel = "procedural-trees+"', WEATHER
    folder = write_tiled(tmp_path / "scene", temperature=one[0], extra=one[1])
    with pytest.raises(ThermorenderError, match="a map that takes hour or relief needs a scene of one raster"):
        renderer_of(folder, monkeypatch, quality="fast")


@pytest.mark.slow
def test_a_frame_keeps_its_tiles_while_later_frames_load_others(tmp_path, monkeypatch, own_cache):
    renderer = renderer_of(write_tiled(tmp_path / "scene"), monkeypatch, quality="fast")
    poses = [renderer.scene.pose(east, -30.0, 12.0, 0.0, -80.0, 0.0) for east in (-30.0, 30.0, 0.0)]
    true = [renderer.frame(pose).truth["kinetic_temperature"] for pose in poses]
    first = renderer.frame(poses[0])
    memory = renderer.loader.memory
    for pose in poses[1:]:
        memory.keep(())
        memory._temperature.array[memory.free] = 0.0
        renderer._made = None
        renderer.radiance(pose)
    assert renderer.loader.memory is memory
    np.testing.assert_array_equal(first.truth["kinetic_temperature"], true[0])
    # Without the frame its slots are free again.
    del first
    gc.collect()
    renderer._made = None
    gc.collect()
    memory.keep(())
    assert len(memory.free) == memory.slots


def two_cells(tmp_path, monkeypatch):
    """(Poses in two cells, the radiance from each, a renderer of the same scene with their tiles on disk)."""
    folder = write_tiled(tmp_path / "scene")
    renderer = renderer_of(folder, monkeypatch, quality="fast")
    poses = [renderer.scene.pose(east, -30.0, 25.0, 90.0, -50.0, 0.0) for east in (-40.0, 20.0)]
    alone = [renderer.frame(pose).radiance for pose in poses]
    return poses, alone, renderer_of(folder, monkeypatch, quality="fast")


@pytest.mark.slow
def test_tiles_that_are_read_ahead_are_those_of_the_next_cell_on_the_way(tmp_path, monkeypatch, own_cache):
    poses, alone, again = two_cells(tmp_path, monkeypatch)
    assert again.expect([poses[0], *poses, poses[1]]) == {2}
    found = [again.frame(poses[0]).radiance]
    for each in again.loader._ahead:
        each.result()
    new = set(again.tiles(again.cell(poses[1]))) - set(again.tiles(again.cell(poses[0])))
    assert new and new <= set(again.loader.memory.tiles) | again.loader._bare
    found += [again.frame(pose).radiance for pose in poses[1:]]
    for one, other in zip(alone, found, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.skipif(not hasattr(mmap, "MADV_DONTNEED"), reason="the system takes no pages back")
def test_memory_of_tiles_that_nothing_needs_goes_back_to_the_system(tmp_path, monkeypatch, own_cache):
    renderer = renderer_of(write_tiled(tmp_path / "scene"), monkeypatch, quality="fast")
    frame = renderer.frame(renderer.scene.pose(-30.0, -30.0, 12.0, 0.0, -80.0, 0.0))
    memory = renderer.loader.memory
    used = sorted(memory._slot.values())
    memory.keep(())
    kept = memory._first.array[: memory.slots * memory._count[0]].reshape(memory.slots, -1)[used]
    assert (kept > 0.0).mean() > 0.9
    # Without the frame and the cell nothing reads them; pages that go back are zero.
    del frame
    gc.collect()
    renderer._made = None
    gc.collect()
    assert len(memory.free) == memory.slots
    kept = memory._first.array[: memory.slots * memory._count[0]].reshape(memory.slots, -1)[used]
    assert (kept == 0.0).mean() > 0.7


def test_no_more_tiles_are_read_ahead_than_memory_allows(tmp_path, monkeypatch, own_cache):
    poses, _, again = two_cells(tmp_path, monkeypatch)
    first, second = (set(again.tiles(again.cell(pose))) for pose in poses)
    new = sorted(second - first)
    assert len(new) > 2
    memory = again.loader.memory
    monkeypatch.setattr(loading, "_AHEAD_BYTES", memory.bytes_of(first) + memory.bytes_of(new[:2]) + 10.0)
    again.expect(poses)
    again.frame(poses[0])
    again.loader._wait()
    # Tiles without ground take nothing, but are counted before they are read.
    assert 0 < len(set(new) & (set(again.loader.memory.tiles) | again.loader._bare)) <= 2 + len(again.loader._bare)


@pytest.mark.slow
def test_colours_of_tiles_are_those_of_the_picture_from_the_first_view_on(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    renderer = renderer_of(folder, monkeypatch, quality="fast")
    poses = [renderer.scene.pose(east, -30.0, 12.0, 0.0, -80.0, 0.0) for east in (-30.0, 30.0)]
    renderer.radiance(poses[0])
    late = [renderer.visible(pose) for pose in poses]
    again = renderer_of(folder, monkeypatch, quality="fast")
    for pose, (image, known) in zip(poses, late, strict=True):
        own, valid = again.visible(pose)
        np.testing.assert_array_equal(own, image)
        np.testing.assert_array_equal(valid, known)
        assert valid.mean() > 0.5 and own[valid].std() > 20.0


def class_numbers(folder):
    """The class numbers of a scene of `write_tiled`, (n, n), in one file."""
    source = Classes(rasters_of(folder / "classes"))
    left, _, right, top = source.extent.bounds
    step, count = source.extent.pixel, round((right - left) / source.extent.pixel)
    numbers = source.read(Grid(source.extent.crs, Affine(step, 0.0, left, 0.0, -step, top), count, count))
    for path in (folder / "classes").iterdir():
        path.unlink()
    write_raster(folder / "classes" / "a.tif", numbers[None], step, corner=(left, top))
    return numbers, step, (left, top)


def test_a_picture_of_a_part_leaves_the_classes_beside_it_at_all_levels(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    text = (folder / "scene.toml").read_text()
    # Heights reach half a post beyond the classes.
    (folder / "scene.toml").write_text(text.replace('"classes"\n[emi', '"classes"\nfallback = "soil_loam"\n[emi'))
    numbers, step, corner = class_numbers(folder)
    for path in (folder / "photo").iterdir():
        path.unlink()
    write_raster(folder / "photo" / "a.tif", np.full((3, 40, 40), 120, np.uint8), step, corner=corner,
                 photometric="RGB")  # fmt: skip
    renderer = renderer_of(folder, monkeypatch, quality="fast", rows=2)
    names = ["grass_green", "sand_quartz", "soil_loam"]
    for tile in (Tile(0, 0, 0), Tile(1, 0, 0)):
        baked, side = renderer.squares.bake(tile)[tile], 64 * 2**tile.level
        # Texels within a block of one class.
        own = np.array([each.name for each in renderer.scene.materials])[baked.material[APRON:-APRON, APRON:-APRON]]
        true = np.array(names)[numbers[:side, :side].reshape(64, 2**tile.level, 64, -1)[:, 0, :, 0] - 1]
        np.testing.assert_array_equal(own, true)


@pytest.mark.slow
def test_a_small_gap_of_the_classes_does_not_stop_a_flight_over_it(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene", size=257)
    numbers, step, corner = class_numbers(folder)
    numbers[100:116, 100:116] = 0
    write_raster(folder / "classes" / "a.tif", numbers[None], step, corner=corner)
    renderer = renderer_of(folder, monkeypatch, quality="fast", rows=2)
    frame = renderer.frame(renderer.scene.pose(-74.0, 74.0, 40.0, 0.0, -90.0, 0.0))
    filled = (frame.truth["mask"] & FILLED) > 0
    assert 0.05 < filled.mean() < 1.0 and np.isfinite(frame.truth["kinetic_temperature"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("cache", ["", "~nobody_of_this_name/cache"])
def test_tiles_in_memory_are_not_baked_again_where_no_cache_can_be_written(tmp_path, monkeypatch, own_cache, cache):
    folder = write_tiled(tmp_path / "scene")
    poses = [tr.pose(east, 0.0, 12.0, 90.0, -70.0, 0.0) for east in (-20.0, 0.0, 20.0)]
    bake, baked = Squares.bake, []
    monkeypatch.setattr(Squares, "bake", lambda self, first, *rest: (baked.append(first), bake(self, first, *rest))[1])
    renderer = renderer_of(folder, monkeypatch, quality="fast", rows=2)
    expected = [renderer.frame(pose).radiance for pose in poses]
    assert len({renderer.cell(pose) for pose in poses}) > 1 and renderer.cache_note is None
    once, where = baked.copy(), cache or str(tmp_path / "file")
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("THERMORENDER_CACHE", where)
    baked.clear()
    again = renderer_of(folder, monkeypatch, quality="fast", rows=2)
    for pose, radiance in zip(poses, expected, strict=True):
        before = set(again.loader.memory.tiles)
        needed = {again.squares.of(tile) for tile in again.tiles(again.cell(pose)) if tile not in before}
        baked.clear()
        np.testing.assert_array_equal(again.frame(pose).radiance, radiance)
        assert set(baked) <= needed
    assert len(set(once)) == len(once) and "are not kept" in again.cache_note


@pytest.mark.slow
def test_tiles_that_another_process_bakes_meanwhile_are_not_baked_again(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    other = renderer_of(folder, monkeypatch, rows=1, quality="fast")
    renderer = renderer_of(folder, monkeypatch, rows=1, quality="fast")
    needed = renderer.tiles(renderer.cell(renderer.scene.pose(*VIEWS[0][0])))
    plain, baked = Squares.bake, []

    def bake(self, first, progress=None):
        baked.append(first)
        if len(baked) == 1:
            # The other one bakes all but this square.
            other.loader.load([tile for tile in needed if tile != first])
        return plain(self, first, progress)

    monkeypatch.setattr(Squares, "bake", bake)
    assert renderer.loader.load(needed).tiles
    assert len(baked) == len(set(baked)) == len(needed)


@pytest.mark.slow
def test_a_tile_that_could_not_be_read_ahead_is_read_again(tmp_path, monkeypatch, own_cache):
    poses, alone, again = two_cells(tmp_path, monkeypatch)
    again.expect(poses)
    load = TileStore.load

    def failing(self, tile):
        raise OSError("once")

    monkeypatch.setattr(again.loader, "read_ahead", lambda tiles: None)
    np.testing.assert_array_equal(again.frame(poses[0]).radiance, alone[0])
    monkeypatch.undo()
    monkeypatch.setenv("THERMORENDER_CACHE", str(own_cache))
    with monkeypatch.context() as patch:
        patch.setattr(TileStore, "load", failing)
        again.loader.read_ahead(again.tiles(again.cell(poses[1])))
        assert again.loader._ahead and all(each.exception() for each in again.loader._ahead)
    assert TileStore.load is load
    np.testing.assert_array_equal(again.frame(poses[1]).radiance, alone[1])


def test_frames_state_pose_and_positions_in_the_frame_of_the_scene(tmp_path, monkeypatch, own_cache):
    renderer = renderer_of(write_tiled(tmp_path / "scene"), monkeypatch, quality="fast")
    scene = renderer.scene
    pose = scene.pose(10.0, -12.0, 30.0, 30.0, -60.0, 0.0)
    frame = renderer.frame(pose)
    np.testing.assert_allclose(frame.pose, pose, atol=1e-9)
    position, depth = frame.truth["position"], frame.truth["depth"]
    shown = np.isfinite(depth)
    along = (position[shown] - pose[:3, 3]) @ pose[:3, 2]
    np.testing.assert_allclose(along, depth[shown], atol=2e-3)
    ground = scene.ground(position[shown][:, 0].astype(float), position[shown][:, 1].astype(float))
    np.testing.assert_allclose(position[shown][:, 2], ground, atol=5e-3)


@pytest.mark.slow
def test_a_flight_over_tiles_is_resumed_to_the_same_bytes(tmp_path, monkeypatch, own_cache):
    renderer = renderer_of(write_tiled(tmp_path / "scene"), monkeypatch, quality="fast")
    scene = renderer.scene
    poses = [scene.pose(east, 0.0, 25.0, 90.0, -50.0, 0.0) for east in (-30.0, 30.0)]
    turn = Rotation.from_matrix([each[:3, :3] for each in poses]).as_quat()[:, [3, 0, 1, 2]]
    path = Trajectory([0.0, 2.0], [each[:3, 3] for each in poses], turn)
    options = FlightOptions(rate_hz=3.0, products=("counts", "exr"))
    tr.fly(renderer, path, tmp_path / "whole", options)
    assert len({renderer.cell(scene.pose(east, 0.0, 25.0, 90.0, -50.0, 0.0)) for east in (-30.0, 0.0, 30.0)}) > 1

    class Stop(Exception):
        pass

    def stop(done, total):
        if done == 3:
            raise Stop

    with pytest.raises(Stop):
        tr.fly(renderer, path, tmp_path / "again", options, progress=stop)
    tr.fly(renderer_of(tmp_path / "scene", monkeypatch, quality="fast"), path, tmp_path / "again", options, resume=True)
    for one in sorted((tmp_path / "whole").glob("frame_*")):
        assert one.read_bytes() == (tmp_path / "again" / one.name).read_bytes(), one.name
    # A file beside a raster may change tiles that the overview does not show.
    (tmp_path / "scene" / "photo" / "0.tif.aux.xml").write_text("<PAMDataset/>", encoding="utf-8")
    changed = renderer_of(tmp_path / "scene", monkeypatch, quality="fast")
    with pytest.raises(ThermorenderError, match="scene_digest"):
        tr.fly(changed, path, tmp_path / "again", options, resume=True)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('orthophoto = "photo"\nclasses = "classes"\n', "", "belong together"),
        ('elevation = "dem"', 'elevation = "nothing"', "does not exist"),
        ('[terrain.tiles]', '[terrain]\nfill = true\n[terrain.tiles]', "fill"),
        ("[surroundings]", '[[object]]\nname = "a"\nshape = "box"\nsize = [1, 1, 1]\nposition = [0, 0, 0]\n'
         'temperature = 300\nmaterial = "paint_black"\n[surroundings]', "object"),
    ],
)  # fmt: skip
def test_what_tiles_do_not_have_is_refused(tmp_path, own_cache, old, new, message):
    path = write_tiled(tmp_path / "scene") / "scene.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ThermorenderError, match=message):
        tr.load_scene(tmp_path / "scene")


def test_a_link_out_of_the_folder_of_tiles_is_refused(tmp_path, own_cache):
    folder = write_tiled(tmp_path / "scene")
    (tmp_path / "other.tif").write_bytes((folder / "dem" / "a.tif").read_bytes())
    (folder / "dem" / "b.tif").symlink_to(tmp_path / "other.tif")
    with pytest.raises(ThermorenderError, match=r"b\.tif is a link"):
        tr.load_scene(folder)


@pytest.mark.slow
def test_a_renderer_of_tiles_is_named_and_survives_pickling(tmp_path, monkeypatch, own_cache):
    monkeypatch.setattr(worlds, "TEXELS", 64)
    scene = narrow(tr.load_scene(write_tiled(tmp_path / "scene")))
    with pytest.raises(ThermorenderError, match="use TiledRenderer"):
        tr.Renderer(scene, "fast")
    renderer = tr.TiledRenderer(scene, "fast", seed=3)
    pose = scene.pose(0, 0, 30, 0, -70, 0)
    frame = renderer.frame(pose)
    again = pickle.loads(pickle.dumps(renderer))
    assert isinstance(again, TiledRenderer) and again.seed == 3
    np.testing.assert_array_equal(again.frame(pose).counts, frame.counts)
    other = renderer.with_seed(4).frame(pose)
    np.testing.assert_array_equal(other.radiance, frame.radiance)
    assert (other.counts != frame.counts).any()


def test_what_needs_one_raster_is_refused(tmp_path, monkeypatch, own_cache):
    monkeypatch.setattr(worlds, "TEXELS", 64)
    scene = narrow(tr.load_scene(write_tiled(tmp_path / "scene")))
    renderer = tr.TiledRenderer(scene, "fast")
    pose = scene.pose(0, 0, 30, 0, -70, 0)
    day = scene.with_weather(time="2018-07-28T12:00:00Z", air_low_c=10.0, air_high_c=20.0, humidity=0.7, wind_m_s=2.0,
                             cloud=0.0, albedo=0.2)  # fmt: skip
    for job in (
        lambda: tr.TiledRenderer(day), lambda: scene.with_material_in([(0, 0), (5, 0), (5, 5)], "sand_quartz"),
        lambda: renderer.frame(pose, sampled_as=renderer.frame(pose)),
        lambda: renderer.parts_at(pose, [(10, 10)]), lambda: renderer.texels(pose), lambda: renderer.solved_for(scene),
        renderer.heat_terms,
    ):  # fmt: skip
        with pytest.raises(ThermorenderError, match=r"terrain\.tiles; cut a part out"):
            job()


@pytest.mark.slow
@pytest.mark.parametrize(("rough_m", "least_mk"), [(0.0, 0.0), (0.25, 100.0)])
def test_coarse_tiles_state_the_relief_that_they_leave_out(tmp_path, monkeypatch, own_cache, rough_m, least_mk):
    """Means over squares of fine tiles, of all materials alike, against the coarse tile on the same ground."""
    one = 'source = "balance"', WEATHER
    folder = write_tiled(tmp_path / "scene", size=257, temperature=one[0], extra=one[1], rough_m=rough_m)
    text = (folder / "scene.toml").read_text()
    for name in ("grass_green", "soil_loam"):
        text = text.replace(f'"{name}"', '"sand_quartz"')
    (folder / "scene.toml").write_text(text)
    renderer = renderer_of(folder, monkeypatch, rows=2, quality="fast")
    sums, per_mk = renderer.plan.spectrum.solver.sum(axis=0), renderer.plan.radiance_per_mk
    coarse = renderer.squares.bake(Tile(2, 0, 0))[Tile(2, 0, 0)]
    inner = slice(APRON, -APRON)
    shown = radiance(coarse, sums)[inner, inner]
    fine = np.zeros((4 * 64, 4 * 64))
    for row in (0, 2):
        for column in (0, 2):
            for tile, baked in renderer.squares.bake(Tile(0, row, column)).items():
                part = tuple(slice(64 * k, 64 * k + 64) for k in (tile.row, tile.column))
                fine[part] = radiance(baked, sums)[inner, inner]
    off = (shown - fine.reshape(64, 4, 64, 4).mean(axis=(1, 3))) / per_mk
    true = np.sqrt(np.mean(np.square(off.reshape(16, 4, 16, 4).mean(axis=(1, 3)))))
    stated = np.sqrt(coarse.face_error.mean()) / per_mk
    assert true > least_mk
    # From above: relief much finer than the posts has other normals, which a pixel averages.
    assert true < stated < 8.0 * true + 100.0


@pytest.mark.slow
def test_heights_in_degrees_and_pictures_of_a_part_are_taken(tmp_path, monkeypatch, own_cache):
    from rasterio.warp import transform

    folder = write_tiled(tmp_path / "scene")
    (longitude,), (latitude,) = transform("EPSG:32634", "EPSG:4326", [CORNER[0]], [CORNER[1]])
    (folder / "dem" / "a.tif").unlink()
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace('"classes"\n[emi', '"classes"\nfallback = "soil_loam"\n[emi'))
    step = 1.0 / 111_000.0
    write_raster(folder / "dem" / "degrees.tif", np.full((1, 160, 260), 12.0, np.float32), step, "EPSG:4326",
                 (longitude - 30 * step, latitude + 20 * step))  # fmt: skip
    for name in ("1", "2"):
        (folder / "photo" / f"{name}.tif").unlink()
    renderer = renderer_of(folder, monkeypatch, quality="fast")
    assert renderer.world.grid.crs.to_epsg() == 32634
    frame = renderer.frame(renderer.scene.pose(20.0, -20.0, 30.0, 0.0, -80.0, 0.0))
    assert np.isfinite(frame.truth["depth"]).all() and frame.truth["depth"].max() < 60.0


def test_gaps_in_the_heights_are_holes(tmp_path, monkeypatch, own_cache):
    folder = write_tiled(tmp_path / "scene")
    height = hills(129, 1.0).astype(np.float32)
    height[50:70, 55:75] = np.nan
    write_raster(folder / "dem" / "a.tif", height[None], 1.0, corner=(CORNER[0] - 0.5, CORNER[1] + 0.5), nodata=np.nan)
    renderer = renderer_of(folder, monkeypatch, quality="fast")
    scene = renderer.scene
    assert np.isnan(scene.ground(0.0, 5.0)) and np.isfinite(scene.ground(30.0, 30.0))
    up = float(scene.ground(30.0, 30.0)) + 300.0
    frame = renderer.frame(tr.pose(0.0, 0.0, up, 0.0, -90.0, 0.0))
    hole = ~np.isfinite(frame.truth["depth"])
    assert 0.005 < hole.mean() < 0.3
    # The background's 285 K, not what lies under a skirt.
    assert abs(frame.apparent_temperature[hole].mean() - 285.0) < 0.5


def test_the_lowest_ground_of_tiles_is_that_over_the_round_earth():
    """Seen from far, the plane of the camera's frame is hundreds of metres above level ground."""
    across = np.array([[-1e3, 0.0], [1e3, 0.0], [0.0, 1e3]]) + [9e4, 0.0]
    points = np.column_stack([across, 300.0 - np.square(across).sum(axis=1) / (2.0 * EARTH_RADIUS_M)])
    texel = np.zeros((2, 2))
    tile = Surface(
        name="terrain", vertices=points, faces=np.array([[0, 1, 2]], np.int32), uv=np.zeros((1, 3, 2), np.float32),
        colour=np.zeros((2, 2, 3), np.uint8), material=texel.astype(np.uint16), temperature=texel + 290.0,
        flags=texel.astype(np.uint8), texel_m=1.0, joined=True,
    )  # fmt: skip
    assert points[:, 2].min() < -250.0
    assert Geometry(activate(), [tile]).low_m == pytest.approx(300.0, abs=1e-6)
