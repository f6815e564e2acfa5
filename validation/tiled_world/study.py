"""Ground in tiles: against one piece, coarse tiles against fine ones, and what a flight over a world of 100 km costs.

The heath of the shipped survey is cut into tiles of one bake, and seen as one tile in the same local frame. The world
is made as it is read (`lazy_world`), so that what a flight does not see is never made. Baked tiles are kept in a folder
of their own.
"""

import os
import shutil
import tempfile
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermorender import formats
from thermorender.apps.compare import machine
from thermorender.apps.compare.machine import forget_peak_memory, peak_memory_mib
from thermorender.apps.compare.sampling_error import converged
from thermorender.paths import data_folder
from thermorender.render.renderer import Renderer
from thermorender.render.tiled.cells import assembled
from thermorender.render.tiled.squares import Squares
from thermorender.render.tiled.texel_memory import TexelMemory
from thermorender.render.tiled.tiled_renderer import TiledRenderer
from thermorender.scene.load import load_scene
from thermorender.scene.tile_grid import APRON, Tile
from thermorender.scene.world import world_of
from thermorender.trajectory.path import pose as pose_of
from thermorender.versions import versions
from validation.tiled_world import lazy_world

# East, north, height above ground [m], yaw and pitch [°] of views of the heath.
VIEWS = (
    (0, 0, 80, 0, -90),
    (0, -60, 80, 0, -45),
    (60, 60, 40, 200, -45),
    (0, -120, 40, 0, -10),
    (-60, -60, 25, 60, -10),
)
# A flight: height above ground and speed [m, m/s], pitch [°], duration [s].
FLIGHT = (120.0, 10.0, -90.0, 6.0)
# Drawn views of a world of this side [m]; share of a picture that shows ground, at least.
DRAWN, DRAWN_SIDE_M, _LEAST_SHOWN = 30, 1638.4, 0.1
HEADER = ("part", "figure", "value")
_DAY = """[weather]
time = 2018-09-12T12:44:00Z
air_low_c = 10.3
air_high_c = 22.3
humidity = 0.84
wind_m_s = 3.0
cloud = 0.0
"""


def run(folder, views=VIEWS, flight=FLIGHT, drawn=DRAWN, side=DRAWN_SIDE_M, progress=None, device="auto"):
    """Measure tiles of the heath and of the world, write `tiled_world.json`, and return the result, a dict."""
    report = progress or (lambda what, share: None)
    with tempfile.TemporaryDirectory() as made, _own_cache(Path(made)):
        report("heath in tiles", 0.0)
        pieces = one_piece(heath(Path(made)), views, device)
        report("coarse tiles", 0.2)
        scene = world_scene(Path(made))
        coarse = coarse_tiles(scene, device)
        report("flight over the world", 0.3)
        flown = flight_costs(scene, flight, device, Path(made), lambda share: report("flight", 0.3 + 0.3 * share))
        found = drawn_views(world_scene(Path(made), side=side), drawn, device,
                            lambda share: report("drawn views", 0.6 + 0.4 * share))  # fmt: skip
    result = {"machine": machine.machine(), "versions": versions(), "heath": pieces, "coarse": coarse, "flight": flown,
              "drawn": found}  # fmt: skip
    formats.write_json(Path(folder) / "tiled_world.json", result)
    return result


@contextmanager
def _own_cache(folder):
    before = os.environ.get("THERMORENDER_CACHE")
    os.environ["THERMORENDER_CACHE"] = str(folder / "cache")
    try:
        yield
    finally:
        os.environ.pop("THERMORENDER_CACHE")
        if before is not None:
            os.environ["THERMORENDER_CACHE"] = before


def heath(folder):
    """The shipped survey of the heath without its objects, as a tiled ground under a heat balance."""
    survey = data_folder("scenes") / "heath" / "survey"
    (folder / "heath").mkdir()
    for name in ("elevation", "orthophoto", "classes"):
        shutil.copyfile(survey / f"{name}.tif", folder / "heath" / f"{name}.tif")
    names = "\n".join(f'{k} = "{v}"' for k, v in load_scene(survey).spec.emissivity.classes.items())
    (folder / "heath" / "scene.toml").write_text(
        f'[terrain.tiles]\nelevation = "elevation.tif"\northophoto = "orthophoto.tif"\nclasses = "classes.tif"\n'
        f'[temperature]\nsource = "balance"\n[emissivity]\nsource = "classes"\n[emissivity.classes]\n{names}\n{_DAY}',
        encoding="utf-8",
    )  # fmt: skip
    return load_scene(folder / "heath")


def one_piece(scene, views, device):
    """[{view, RMS and largest difference [mK], pixels beyond 100 mK, ms of both}] of the heath in tiles and in one."""
    renderer = TiledRenderer(scene, device=device, rows=4)
    grid = renderer.world.grid

    class Whole(Squares):
        world = property(lambda self: replace(renderer.world, grid=replace(
            grid, texels=4 * grid.texels, cells=4 * grid.cells, levels=1
        )))  # fmt: skip

    whole = Whole(renderer.scene, renderer.plan, 1)
    memory = TexelMemory(whole.world.grid.texels + 2 * APRON, renderer.plan.spectrum.channels, slots=1)
    for tile, each in whole.bake(Tile(0, 0, 0)).items():
        memory.put(tile, each)
    found = []
    for east, north, up, yaw, pitch in views:
        pose = renderer.scene.pose(east, north, up, yaw, pitch, 0.0)
        cell, own = renderer.at(pose)
        one = Renderer.of(assembled(renderer.scene, renderer.plan, whole.world.grid, memory, cell.scene.frame, up))
        frames = cell.frame(own), one.frame(own)
        shown = np.isfinite(frames[0].truth["depth"])
        off = 1e3 * (frames[0].apparent_temperature - frames[1].apparent_temperature)[shown].astype(np.float64)
        times = [[], []]
        for number in range(12):
            start = time.perf_counter()
            (cell, one)[number % 2].radiance(own)
            times[number % 2].append(time.perf_counter() - start)
        found.append({
            "view": [east, north, up, yaw, pitch], "rms_mk": float(np.sqrt(np.mean(off**2))),
            "worst_mk": float(np.abs(off).max()), "beyond_100_mk": int((np.abs(off) > 100.0).sum()),
            "tiles_ms": 1e3 * float(np.median(times[0])), "one_ms": 1e3 * float(np.median(times[1])),
        })  # fmt: skip
    return found


def world_scene(folder, seed=1, side=lazy_world.SIDE_M):
    """A scene on the world of a seed, of a side [m]."""
    from rasterio import Affine
    from rasterio import open as raster

    names = "\n".join(f'{number} = "{name}"' for number, name in lazy_world.CLASSES.items())
    for name, dtype in (("elevation", "float32"), ("classes", "uint8")):
        place = Affine(1.0, 0.0, lazy_world.LEFT, 0.0, -1.0, lazy_world.TOP)
        with raster(folder / f"{name}.tif", "w", driver="GTiff", count=1, dtype=dtype, height=64, width=64,
                    crs=lazy_world.CRS, transform=place) as file:  # fmt: skip
            # Of no consequence: the world is put in its place.
            file.write(np.ones((1, 64, 64), dtype))
    (folder / "scene.toml").write_text(
        f'[terrain.tiles]\nelevation = "elevation.tif"\nclasses = "classes.tif"\n[temperature]\nsource = "balance"\n'
        f'[emissivity]\nsource = "classes"\n[emissivity.classes]\n{names}\n{_DAY}', encoding="utf-8",
    )  # fmt: skip
    scene = load_scene(folder)
    world = world_of(
        lazy_world.LazyHeights(seed, lazy_world.POST_M, side), lazy_world.LazyColours(seed, lazy_world.TEXEL_M, side),
        lazy_world.LazyClasses(seed, lazy_world.TEXEL_M, side), lazy_world.CLASSES, scene._declared.files.library,
        scene.where,
    )  # fmt: skip
    return scene.on_world(world)


def drawn_views(scene, count, device, report):
    """[{view, levels of its tiles, true and stated error [mK]}] of drawn views of a small world, against converged ones
    of its finest tiles."""
    renderer = TiledRenderer(scene, device=device)
    scene, world, random = renderer.scene, renderer.world, np.random.default_rng(5)
    side, per_mk, found = world.grid.side(0), renderer.plan.radiance_per_mk, []
    left, bottom, right, top = world.within
    finest = [Tile(0, row, column) for row in range(int(np.ceil((top - bottom) / side)))
              for column in range(int(np.ceil((right - left) / side)))]  # fmt: skip
    half = 0.5 * (right - left)
    while len(found) < count:
        report(len(found) / count)
        up, pitch = float(np.exp(random.uniform(np.log(30.0), np.log(5000.0)))), -float(random.uniform(8.0, 90.0))
        yaw, target = float(random.uniform(0.0, 360.0)), random.uniform(-0.7, 0.7, 2) * half
        # The axis meets the ground of the world, or the camera is above its edge.
        away = min(up / np.tan(np.radians(-pitch)), 4.0 * half)
        east, north = target - away * np.array([np.sin(np.radians(yaw)), np.cos(np.radians(yaw))])
        height = up + float(scene.ground(*(float(each) for each in np.clip((east, north), -0.9 * half, 0.9 * half))))
        pose = pose_of(float(east), float(north), height, yaw, pitch, 0.0)
        frame = renderer.frame(pose)
        shown = np.isfinite(frame.error_mk)
        if shown.mean() < _LEAST_SHOWN:
            continue
        levels = sorted({tile.level for tile in renderer.loader.memory.tiles})
        chosen, renderer.tiles, renderer._made = renderer.tiles, lambda cell: finest, None
        true = converged(*renderer.at(pose))
        renderer.tiles, renderer._made = chosen, None
        off = (frame.radiance - true)[shown] / per_mk
        found.append({
            "view": [up, pitch], "levels": levels, "shown": float(shown.mean()),
            "true_mk": float(np.sqrt(np.mean(off**2))), "stated_mk": frame.budget_mk["total"],
            "sampling_mk": frame.budget_mk["sampling"],
        })  # fmt: skip
    return found


def coarse_tiles(scene, device):
    """{level, true_mk, stated_mk}: difference of a tile of level 2 from the means of the fine ones, over pixels of four
    of its texels, and the error of its light as stated."""
    renderer = TiledRenderer(scene, device=device)
    sums, per_mk, texels = renderer.plan.spectrum.solver.sum(axis=0), renderer.plan.radiance_per_mk, 512
    top = Tile(2, 100, 100)
    baked = renderer.squares.bake(top)[top]

    def radiance(tile):
        side = len(tile.first) // len(tile.rest)
        rest = np.kron(tile.rest.astype(np.float64) @ sums[1:], np.ones((side, side)))
        return (sums[0] * tile.first.astype(np.float64) + rest)[APRON:-APRON, APRON:-APRON]

    fine = np.zeros((4 * texels, 4 * texels))
    for row in (0, 2):
        for column in (0, 2):
            for tile, own in renderer.squares.bake(Tile(0, 4 * top.row + row, 4 * top.column + column)).items():
                i, j = (texels * (each % 4) for each in (tile.row, tile.column))
                fine[i : i + texels, j : j + texels] = radiance(own)
    off = (radiance(baked) - fine.reshape(texels, 4, texels, 4).mean(axis=(1, 3))) / per_mk
    pixels = off.reshape(texels // 4, 4, texels // 4, 4).mean(axis=(1, 3))
    return {"level": 2, "true_mk": float(np.sqrt(np.mean(pixels**2))), "mean_mk": float(off.mean()),
            "stated_mk": float(np.sqrt(baked.face_error.mean()) / per_mk)}  # fmt: skip


def flight_costs(scene, flight, device, folder, report):
    """What a flight over the world takes, from its first tile on."""
    height, speed, pitch, duration = flight
    forget_peak_memory()
    read = lazy_world.READ[0]
    renderer = TiledRenderer(scene, device=device)
    along = np.arange(0.0, duration + 0.25, 0.5)
    poses = [renderer.scene.pose(100.0 + speed * at, 200.0, height, 90.0, pitch, 0.0) for at in along]
    cells = [renderer.cell(pose) for pose in poses]
    needed = [renderer.tiles(cell) for cell in cells]
    missing = {renderer.squares.of(tile) for tiles in needed for tile in tiles}
    before = _stored(folder)
    core = time.process_time()
    forecast = renderer.outlook(np.array(poses))[0]
    for number, tiles in enumerate(needed):
        renderer.loader.load(tiles)
        report((number + 1) / len(needed))
    baked = time.process_time() - core
    renderer.loader.load(())
    made, frames, last = [], [], None
    for pose, cell in zip(poses, cells, strict=True):
        start = time.perf_counter()
        renderer.radiance(pose)
        (frames if cell == last else made).append(time.perf_counter() - start)
        last = cell
    return {
        "flight": list(flight), "forecast": forecast, "cells": len(made), "tiles": len({t for n in needed for t in n}),
        "most_tiles": max(map(len, needed)), "squares": len(missing), "bake_cpu_s": baked,
        "disk_mb": (_stored(folder) - before) / 1e6, "cell_s": float(np.median(made)),
        "frame_ms": 1e3 * float(np.median(frames)),
        "peak_mib": peak_memory_mib(), "read_mb": (lazy_world.READ[0] - read) / 1e6,
        "world_mb": sum(each.size() for each in (scene.world.heights, scene.world.colours, scene.world.classes)) / 1e6,
    }  # fmt: skip


def _stored(folder):
    """Bytes of baked tiles on disk."""
    return sum(path.stat().st_size for path in (folder / "cache" / "tiles").rglob("*.npz"))


def rows(result):
    """Return the result as table rows of text under HEADER."""
    found = []
    for one in result["heath"]:
        _, _, up, _, pitch = one["view"]
        found.append((f"heath from {up:g} m, {-pitch:g}° down", "tiles against one piece, RMS, worst [mK]",
                      f"{one['rms_mk']:.2f}, {one['worst_mk']:.0f}"))  # fmt: skip
        found.append(("", "frame of tiles, of one piece [ms]", f"{one['tiles_ms']:.0f}, {one['one_ms']:.0f}"))
    coarse, flown = result["coarse"], result["flight"]
    found.append(
        ("world, level 2", "against fine tiles, stated [mK]", f"{coarse['true_mk']:.0f}, {coarse['stated_mk']:.0f}")
    )
    found.append(
        (
            "world, flight",
            "tiles, most in a frame, squares",
            f"{flown['tiles']}, {flown['most_tiles']}, {flown['squares']}",
        )
    )
    found.append(
        ("", "bake [CPU s], a square", f"{flown['bake_cpu_s']:.0f}, {flown['bake_cpu_s'] / flown['squares']:.0f}")
    )
    found.append(("", "disk [MB], peak memory [MiB]", f"{flown['disk_mb']:.0f}, {flown['peak_mib'] or 0:.0f}"))
    found.append(("", "read of the world [MB]", f"{flown['read_mb']:.0f} of {flown['world_mb']:.0f}"))
    found.append(("", "new cell [s], frame [ms]", f"{flown['cell_s']:.1f}, {flown['frame_ms']:.0f}"))
    ratio = [one["stated_mk"] / one["true_mk"] for one in result["drawn"]]
    found.append(("drawn views", "number, stated over true: least, median",
                  f"{len(ratio)}, {min(ratio):.2f}, {np.median(ratio):.2f}"))  # fmt: skip
    return found
