"""A sheet of pictures of a user's rasters, draped and in three dimensions: `python -m validation.three_d.pictures`.

Rows are angles of view from 90 m. Columns are the draped orthophoto and the scene of `import-terrain --three-d`, each
for visible light and then in the infrared, with one scale of grey for both. Both have temperatures of the same learned
map, so that the infrared shows shapes and no place's true temperatures.
"""

import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import rasterio
import typer
from rasterio.windows import from_bounds

from thermorender import formats
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.output.photograph import photograph
from thermorender.scene.surface import SURFACE
from validation.command import Device, run_command
from validation.three_d.study import ANGLES, pose_at, renderer_of

_LINE, _WIDTH = 4, 240


def main(
    elevation: Annotated[Path, typer.Argument(help="GeoTIFF of heights of the surface.")],
    orthophoto: Annotated[Path, typer.Argument(help="GeoTIFF of colours.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="JPEG or PNG of the sheet.")],
    size_m: Annotated[float, typer.Option(help="Side of the square around the middle that is used [m].")] = 150.0,
    east_m: Annotated[float, typer.Option(help="Its middle, east of that of the heights [m].")] = 0.0,
    north_m: Annotated[float, typer.Option(help="Its middle, north of that of the heights [m].")] = 0.0,
    yaw_deg: Annotated[float, typer.Option(help="Direction of view.")] = 30.0,
    device: Device = "auto",
):
    """Draw one sheet."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        square = _square(elevation, size_m, east_m, north_m)
        rasters = [_cut(path, folder / f"{name}.tif", square) for path, name in ((elevation, "dsm"), (orthophoto, "o"))]
        columns = []
        for name, three_d in (("draped", None), ("solid", ThreeD())):
            import_terrain(
                *rasters, folder / name, ImportSettings(height_reference="ellipsoid", fill=three_d is None), three_d
            )
            columns.append(_views(folder / name, yaw_deg, device))
    formats.write_image(output, sheet(*columns))


def _square(path, size_m, east_m, north_m):
    """(left, bottom, right, top) of a square in the map of a raster."""
    with rasterio.open(path) as file:
        box = file.bounds
    x, y = 0.5 * (box.left + box.right) + east_m, 0.5 * (box.bottom + box.top) + north_m
    return x - 0.5 * size_m, y - 0.5 * size_m, x + 0.5 * size_m, y + 0.5 * size_m


def _cut(path, target, square):
    """Write what a raster has within a square to `target`, and return that."""
    with rasterio.open(path) as file:
        window = from_bounds(*square, file.transform).round_offsets().round_lengths()
        profile = file.profile | {"driver": "GTiff", "height": int(window.height), "width": int(window.width),
                                  "transform": file.window_transform(window)}  # fmt: skip
        for key in ("blockxsize", "blockysize", "tiled", "photometric", "compress"):
            profile.pop(key, None)
        with rasterio.open(target, "w", **profile) as made:
            made.write(file.read(window=window))
    return target


def _views(folder, yaw_deg, device):
    """[(visible (H, W, 3) uint8, kelvin (H, W), NaN where no surface is)] by angle."""
    renderer = renderer_of(folder, device, _WIDTH)
    found = []
    for angle in ANGLES:
        at = pose_at(np.array([0.0, 0.0, 1.0]), angle, yaw_deg)
        frame = renderer.frame(at)
        kelvin = np.where(frame.truth["mask"] & SURFACE, frame.apparent_temperature, np.nan)
        found.append((photograph(renderer, at)[0], kelvin))
    return found


def sheet(draped, solid):
    """Return the sheet (h, w, 3) uint8 of two lists of (visible, kelvin): visible of both, infrared of both."""
    rows = []
    for pair in zip(draped, solid, strict=True):
        low, high = np.nanpercentile(np.concatenate([kelvin.ravel() for _, kelvin in pair]), (1.0, 99.0))
        grey = [np.nan_to_num((kelvin - low) / max(high - low, 1e-6)).clip(0.0, 1.0) for _, kelvin in pair]
        infrared = [np.repeat(np.round(255.0 * each).astype(np.uint8)[..., None], 3, axis=2) for each in grey]
        cells = [np.pad(cell, ((0, _LINE), (0, _LINE), (0, 0)), constant_values=255)
                 for cell in (*(visible for visible, _ in pair), *infrared)]  # fmt: skip
        rows.append(np.concatenate(cells, axis=1))
    return np.concatenate(rows)


if __name__ == "__main__":
    run_command(main)
