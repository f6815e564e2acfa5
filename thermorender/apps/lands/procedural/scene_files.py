"""Files of a synthetic scene: GeoTIFFs, scene.toml and flight.csv, first without and then with its temperatures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import defaults
from thermorender.apps.lands.procedural.procedural_scene import SyntheticScene
from thermorender.errors import ThermorenderError
from thermorender.formats import atomic_raster, write_text
from thermorender.schema import toml_text
from thermorender.units import utc_text

# Step of the stored raster [K]: rounding is 6 mK RMS, below any microbolometer's noise.
TEMPERATURE_STEP_K = 0.02
_TEMPERATURE_BASE_K = 200.0
# Without loss, by codecs that rasterio's wheels and QGIS read. LERC takes a seventh less of temperatures than DEFLATE.
_PACKED: dict[str, Any] = {"compress": "zstd", "zstd_level": 19}
_TEMPERATURES: dict[str, Any] = {"compress": "lerc_zstd", "zstd_level": 19, "max_z_error": 0}
# Small rasters are one block, which needs no padding; those above this side are cut into blocks of `_BLOCK` [pixels].
_ONE_BLOCK, _BLOCK = 2048, 512


def write_declared(scene: SyntheticScene, folder: Path) -> None:
    """Write a SyntheticScene into a folder, with its temperature to be solved by the heat balance."""
    texel = scene.texel_m
    picture = np.ascontiguousarray(scene.orthophoto.transpose(2, 0, 1))
    jpeg: dict[str, Any] = {"compress": "jpeg", "photometric": "ycbcr", "jpeg_quality": 86}
    _raster(scene, folder / "elevation.tif", scene.elevation[None], scene.post_m, predictor=3, **_PACKED)
    _raster(scene, folder / "classes.tif", scene.classes[None], texel, **_PACKED)
    _raster(scene, folder / "orthophoto.tif", picture, texel, **jpeg)
    write_text(folder / "scene.toml", scene_toml(scene, known=False))
    write_text(folder / "flight.csv", flight_csv(scene.flight))


def write_temperature(scene: SyntheticScene, folder: Path, temperature: NDArray[Any], every: int) -> None:
    """Add the true temperature (N, N) [K] to a scene's folder as its source, averaged over `every` texels a side."""
    side = len(temperature) // every
    mean = temperature.astype(np.float64).reshape(side, every, side, every).mean(axis=(1, 3))
    counts = np.clip(np.round((mean - _TEMPERATURE_BASE_K) / TEMPERATURE_STEP_K), 0, 65535).astype(np.uint16)
    scale = TEMPERATURE_STEP_K, _TEMPERATURE_BASE_K
    _raster(scene, folder / "temperature.tif", counts[None], scene.texel_m * every, scale, **_TEMPERATURES)
    write_text(folder / "scene.toml", scene_toml(scene))


def refuse_every(scene: SyntheticScene, every: int) -> None:
    """Raise unless `every` divides the scene's texels per side."""
    if every < 1 or len(scene.classes) % every:
        raise ThermorenderError(
            f"temperature_every={every} does not divide the {len(scene.classes)} texels of the scene's side; choose a "
            "divisor such as 1"
        )


def _block(side: int) -> int:
    """Side of the blocks of a raster [pixels]; TIFF takes multiples of 16."""
    return -(-side // 16) * 16 if side <= _ONE_BLOCK else _BLOCK


def _raster(
    scene: SyntheticScene, path: Path, bands: NDArray[Any], texel_m: float,
    scale: tuple[float, float] | None = None, **options: Any,
) -> None:  # fmt: skip
    """Write (bands, h, w) as a GeoTIFF whose upper left corner is the scene's."""
    import rasterio

    count, height, width = bands.shape
    side = _block(max(height, width))
    transform = rasterio.Affine(texel_m, 0.0, scene.corner[0], 0.0, -texel_m, scene.corner[1])
    with atomic_raster(path) as part, rasterio.open(
        part, "w", driver="GTiff", width=width, height=height, count=count, dtype=bands.dtype, transform=transform,
        crs=f"EPSG:{scene.epsg}", tiled=True, blockxsize=side, blockysize=side, **options,
    ) as file:  # fmt: skip
        file.write(bands)
        if scale is not None:
            file.scales, file.offsets = (scale[0],), (scale[1],)
            file.units = ("K",)


def scene_toml(scene: SyntheticScene, known: bool = True, other: Mapping[str, Any] | None = None) -> str:
    """Return the text of scene.toml, with a known temperature or one to be solved by the heat balance.

    `other` replaces tables, those that are None by nothing.
    """
    raster = {"source": "raster", "raster": "temperature.tif"}
    weather = {key: value for key, value in vars(scene.weather).items() if value is not None}
    values = {
        "title": scene.title,
        "terrain": {"elevation": "elevation.tif", "orthophoto": "orthophoto.tif", "height_reference": "ellipsoid"},
        "temperature": raster if known else {"source": "balance"},
        "weather": weather | {"time": utc_text(scene.weather.time)},
        "emissivity": {"source": "classes", "raster": "classes.tif", "classes": scene.class_names},
        "sky": {"temperature": round(scene.sky_temperature, 1)},
        "camera": {"model": defaults.CAMERA},
        "truth": {"temperature": "temperature.tif"} if known else None,
        "object": [{key: _rounded(value) for key, value in item.items()} for item in scene.objects],
    }
    return toml_text(
        values | dict(other or {}),
        f"Made by thermorender: kind {scene.kind}, seed {scene.seed}, {scene.size_m:g} m.\n"
        f"Photographed with the sun at azimuth {scene.sun[0]:.1f}°, elevation {scene.sun[1]:.1f}°.",
    )


def _rounded(value: Any) -> Any:
    """Return a float, or floats in lists, rounded to three decimals; other values unchanged."""
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return round(value, 3) if isinstance(value, float) else value


def flight_csv(flight: Mapping[str, NDArray[Any]]) -> str:
    """Return the CSV text of a flight."""
    rows = zip(*flight.values(), strict=True)
    body = "".join(",".join(f"{value:.3f}" for value in row) + "\n" for row in rows)
    return ",".join(flight) + "\n" + body
