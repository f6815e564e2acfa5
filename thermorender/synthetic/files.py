"""A synthetic scene as files: GeoTIFFs, scene.toml and flight.csv, all of them or none."""

from pathlib import Path

import numpy as np

from thermorender import defaults
from thermorender.errors import ThermorenderError
from thermorender.files import atomic_folder, write_text
from thermorender.schema import toml_text

TEMPERATURE_STEP_K = 0.02  # of the stored raster: 6 mK root mean square, below any microbolometer's noise
_TEMPERATURE_BASE_K = 200.0


def write_scene(scene, directory, overwrite=False, temperature_every=2):
    """Return the folder written, a Path; see `synthetic.write`."""
    if temperature_every < 1 or len(scene.temperature) % temperature_every:
        raise ThermorenderError(
            f"temperature_every={temperature_every} does not divide the {len(scene.temperature)} texels "
            "of the scene's side; choose a divisor such as 1"
        )
    with atomic_folder(directory, overwrite) as draft:
        _rasters(scene, draft, temperature_every)
        write_text(draft / "scene.toml", scene_toml(scene))
        write_text(draft / "flight.csv", flight_csv(scene.flight))
    return Path(directory)


def _rasters(scene, folder, every):
    """Write the four GeoTIFFs."""
    import rasterio

    def profile(texel, **more):
        return {
            "driver": "GTiff",
            "crs": f"EPSG:{scene.epsg}",
            "transform": rasterio.Affine(texel, 0.0, scene.corner[0], 0.0, -texel, scene.corner[1]),
            "tiled": True,
            "blockxsize": 512,
            "blockysize": 512,
            **more,
        }

    def save(name, bands, options, scale=None):
        count, height, width = bands.shape
        with rasterio.open(
            folder / name, "w", width=width, height=height, count=count, dtype=bands.dtype, **options
        ) as file:
            file.write(bands)
            if scale is not None:
                file.scales, file.offsets = (scale[0],), (scale[1],)
                file.units = ("K",)

    packed = {"compress": "deflate", "zlevel": 9}
    save("elevation.tif", scene.elevation[None], profile(scene.post_m, predictor=3, **packed))
    save("classes.tif", scene.classes[None], profile(scene.texel_m, **packed))
    save(
        "orthophoto.tif",
        np.ascontiguousarray(scene.orthophoto.transpose(2, 0, 1)),
        profile(scene.texel_m, compress="jpeg", photometric="ycbcr", jpeg_quality=86),
    )
    side = len(scene.temperature) // every
    mean = scene.temperature.astype(np.float64).reshape(side, every, side, every).mean(axis=(1, 3))
    counts = np.round((mean - _TEMPERATURE_BASE_K) / TEMPERATURE_STEP_K)
    save(
        "temperature.tif",
        np.clip(counts, 0, 65535).astype(np.uint16)[None],
        profile(scene.texel_m * every, predictor=2, **packed),
        (TEMPERATURE_STEP_K, _TEMPERATURE_BASE_K),
    )


def scene_toml(scene):
    """Return the text of a scene's scene.toml."""
    values = {
        "title": scene.title,
        "terrain": {"elevation": "elevation.tif", "orthophoto": "orthophoto.tif", "height_reference": "ellipsoid"},
        "temperature": {"source": "raster", "raster": "temperature.tif"},
        "emissivity": {"source": "classes", "raster": "classes.tif", "classes": scene.class_names},
        "sky": {"temperature": round(scene.sky_temperature, 1)},
        "camera": {"model": defaults.CAMERA},
        "truth": {"temperature": "temperature.tif"},
        "object": [{key: _rounded(value) for key, value in item.items()} for item in scene.objects],
    }
    return toml_text(
        values,
        f"Made by thermorender.synthetic.worlds: kind {scene.kind}, seed {scene.seed}, {scene.size_m:g} m.\n"
        f"Sun at azimuth {scene.sun[0]:.1f}°, elevation {scene.sun[1]:.1f}°.",
    )


def _rounded(value):
    """Return a number, or numbers in lists, to three digits behind the point; anything else as it is."""
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return round(value, 3) if isinstance(value, float) else value


def flight_csv(flight):
    """Return the text of a flight's table."""
    rows = zip(*flight.values(), strict=True)
    body = "".join(",".join(f"{value:.3f}" for value in row) + "\n" for row in rows)
    return ",".join(flight) + "\n" + body
