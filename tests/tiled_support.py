"""Small grounds in tiles, and the same rasters in an ordinary scene."""

import numpy as np
from rasterio import Affine

from scenes import write_raster
from thermorender.scene.raster import Grid
from thermorender.scene.sources import Classes, Colours, Heights, rasters_of

CORNER = 500000.0, 5780000.0
MATERIALS = 'source = "material"\nmaterials = {grass_green = 296.0, sand_quartz = 300.0, soil_loam = 298.0}'


def hills(size, step, seed=3):
    """Heights of gentle hills, (n, n) [m]."""
    x, y = np.meshgrid(*[np.arange(size) * step] * 2)
    random = np.random.default_rng(seed)
    found = np.zeros((size, size))
    for wavelength in (90.0, 40.0, 17.0):
        a, b, c = random.uniform(0.0, 2.0 * np.pi, 3)
        found += (
            0.03
            * wavelength
            * np.sin(2 * np.pi * (x * np.cos(c) + y * np.sin(c)) / wavelength + a)
            * np.cos(2 * np.pi * y / wavelength + b)
        )
    return found


def write_tiled(folder, size=129, step=1.0, texel=0.5, temperature=MATERIALS, extra="", rough_m=0.0):
    """Write a scene of tiles: heights, colours and classes in pieces."""
    for name in ("dem", "photo", "classes"):
        (folder / name).mkdir(parents=True)
    height, count = hills(size, step), round((size - 1) * step / texel)
    height = height + rough_m * np.random.default_rng(9).normal(size=height.shape)
    random = np.random.default_rng(4)
    # Posts are in the middle of pixels, at corners of texels.
    corner = CORNER[0] - 0.5 * step, CORNER[1] + 0.5 * step
    write_raster(folder / "dem" / "a.tif", height[None].astype(np.float32), step, corner=corner)
    colour = random.integers(40, 200, (3, count, count)).astype(np.uint8)
    block = np.kron(random.integers(1, 4, (count // 8, count // 8)), np.ones((8, 8))).astype(np.uint8)
    half = count // 2
    for number, (rows, columns) in enumerate([(slice(0, half), slice(0, half)), (slice(0, half), slice(half, None)),
                                              (slice(half, None), slice(0, None))]):  # fmt: skip
        there = CORNER[0] + columns.start * texel, CORNER[1] - rows.start * texel
        write_raster(folder / "photo" / f"{number}.tif", colour[:, rows, columns], texel, corner=there,
                     photometric="RGB")  # fmt: skip
        write_raster(folder / "classes" / f"{number}.tif", block[None, rows, columns], texel, corner=there)
    (folder / "scene.toml").write_text(
        f"""[terrain.tiles]
elevation = "dem"
orthophoto = "photo"
classes = "classes"
[temperature]
{temperature}
[emissivity]
source = "classes"
[emissivity.classes]
1 = "grass_green"
2 = "sand_quartz"
3 = "soil_loam"
[surroundings]
temperature = 285.0
{extra or "[sky]" + chr(10) + "temperature = 255.0"}
""",
        encoding="utf-8",
    )
    return folder


def write_in_one_piece(folder, plain):
    """Write the rasters of a scene from `write_tiled` as an ordinary scene."""
    plain.mkdir()
    text = (folder / "scene.toml").read_text().replace("[terrain.tiles]", "[terrain]")
    text = text.replace('"dem"', '"dem.tif"').replace('"photo"', '"photo.tif"').replace('classes = "classes"\n', "")
    (plain / "scene.toml").write_text(text.replace('source = "classes"', 'source = "classes"\nraster = "classes.tif"'))
    for name, kind in (("dem", Heights), ("photo", Colours), ("classes", Classes)):
        source = kind(rasters_of(folder / name))
        left, _, right, top = source.extent.bounds
        step, count = source.extent.pixel, round((right - left) / source.extent.pixel)
        grid = Grid(source.extent.crs, Affine(step, 0.0, left, 0.0, -step, top), count, count)
        values = source.read(grid)
        bands = np.moveaxis(values[0], -1, 0) if name == "photo" else values[None]
        write_raster(plain / f"{name}.tif", bands.astype(np.float32) if name == "dem" else bands, step,
                     corner=(left, top), **({"photometric": "RGB"} if name == "photo" else {}))  # fmt: skip
    return plain
