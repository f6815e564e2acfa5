"""Stability of pixels: objects far smaller than a pixel, textures of one texel and of thousands a side, °C as K."""

import tempfile
from pathlib import Path

import numpy as np

from tests.robustness.air import refused
from tests.robustness.cases import Found, case
from thermorender.defaults import BAND_UM
from thermorender.formats import write_text
from thermorender.materials.library import load_library
from thermorender.materials.material import grey
from thermorender.physics.band import emitted_radiance
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.scene.load import load_scene
from thermorender.schema import toml_text
from thermorender.sensor.display import DisplaySettings
from thermorender.units import ZERO_CELSIUS_K

_GROUND_K = 290.0
_ADD = f"add {ZERO_CELSIUS_K} to °C"
# Three standard errors of 64 rays over the rectangle around a small object, which fills two thirds of its area.
_RAYS = 0.09


def _shown(surfaces, up, second=None, **settings):
    """(Renderer, pose) of black ground, with objects of a second material on it, from straight above without sky."""
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose
    from validation.made_scenes import in_memory

    materials = [grey("black", 1.0), second or grey("black", 1.0)]
    scene = in_memory("pixels", surfaces, materials, sky=0.0, surroundings=_GROUND_K, terrain_count=1)
    return Renderer(scene, rays=1, device="cpu", **settings), pose(0.0, 0.0, up, yaw_deg=20.0, pitch_deg=-90.0)


@case("pixels", "spot of 1000 K, {:g} of a pixel", (4e-4, 2e-6))
def spot(share):
    """From 500 m, and for a centimetre from 5 km: the pixel's radiance rises by its share of the difference."""
    from validation.budget.scenes import box, level

    side, up = {4e-4: (0.013, 500.0), 2e-6: (0.01, 5000.0)}[share]
    ground = level(1.2 * up, np.zeros((1, 1), int), np.full((1, 1), _GROUND_K))
    paint = load_library()["paint_black"]
    pixel = up / 764.7
    box_object = box("object", (0.3 * pixel, 0.4 * pixel), (side, side, 0.1 * side), 1000.0)
    # The finest setting: at a coarser one so little light would not be worth the rays.
    renderer, pose = _shown([ground, box_object], up, paint, edge_mk=1.0)
    image = renderer.radiance(pose)
    share = side**2 * (renderer.scene.camera.focal_length_px / (up - 0.1 * side)) ** 2
    dark = band_radiance(_GROUND_K, *BAND_UM)
    rise = share * (emitted_radiance(paint.emissivity_at, 1000.0, *BAND_UM) - dark)
    found = float((image.astype(np.float64) - dark)[250:262, 314:326].max())
    expected = float(brightness_temperature(dark + rise, *BAND_UM))
    tolerance = expected - float(brightness_temperature(dark + (1.0 - _RAYS) * rise, *BAND_UM))
    return Found(float(brightness_temperature(dark + found, *BAND_UM)), expected, tolerance)


@case("pixels", "texture of {:d} rows", (1, 16384))
def texture(rows):
    """Black ground alternating between 250 and 350 K, or of one of them: pixels show the mean of their radiance.

    For some thousand pixels across the long one's stripes, six in each; the tolerance is a hundredth of the stripes'
    difference.
    """
    from validation.budget.scenes import level

    shape = (rows, 1 if rows == 1 else 64)
    stripes = np.where(np.arange(rows)[:, None] % 2, 350.0, 250.0) * np.ones(shape)
    ground = level(458.0 / rows, np.zeros(shape, int), stripes)
    renderer, pose = _shown([ground], 120.0)
    image, number = renderer.radiance(pose), renderer.texels(pose)
    middle = image[number >= 0].astype(np.float64)
    both = band_radiance(np.array([250.0, 350.0]), *BAND_UM)
    expected, allowed = (both.mean(), 0.01 * np.ptp(both)) if rows > 1 else (both[0], 1e-6 * both[0])
    kelvin = [float(brightness_temperature(value, *BAND_UM)) for value in (middle.mean(), expected, expected + allowed)]
    return Found(kelvin[0], kelvin[1], kelvin[2] - kelvin[1])


@case("pixels", "one texel of 1000 K among 65 536, from {:g} m: error of a frame by what is stated", (120.0, 3000.0))
def hot_texel(up):
    """Half a metre: three pixels, and a sixteenth of one. The error of the frame against 256 rays a pixel, RMS."""
    from thermorender.apps.compare.sampling_error import converged
    from validation.budget.scenes import level

    warm = np.full((256, 256), _GROUND_K)
    warm[130, 127] = 1000.0
    renderer, pose = _shown([level(0.5, np.zeros(warm.shape, int), warm)], up)
    frame = renderer.frame(pose)
    difference = (frame.radiance - converged(renderer, pose))[np.isfinite(frame.error_mk)]
    found = float(np.sqrt(np.mean(np.square(difference, dtype=np.float64)))) / renderer.plan.radiance_per_mk
    return Found(1e-3 * found, 0.0, 1e-3 * frame.budget_mk["total"])


@case("pixels", "-273 typed as {} is refused",
      ("temperature.value", "temperature.materials", "sky", "surroundings", "object"))  # fmt: skip
def celsius(where):
    """Refused in one sentence, which says what to add; only a sky may have 0 K."""
    wrong = dict.fromkeys(("value", "sky", "surroundings", "object"), 290.0) | {where.rpartition(".")[2]: -273.0}
    temperature = {"source": "constant", "value": wrong["value"]}
    if where == "temperature.materials":
        temperature = {"source": "material", "materials": {"soil_loam": -273.0}}
    text = {
        "title": "typed", "terrain": {"mesh": "ground.obj"}, "temperature": temperature,
        "emissivity": {"source": "material", "material": "soil_loam"}, "sky": {"temperature": wrong["sky"]},
        "surroundings": {"temperature": wrong["surroundings"]},
        "object": [{"name": "box", "shape": "box", "size": [1.0, 1.0, 1.0], "position": [0.0, 0.0, 0.0],
                    "temperature": wrong["object"], "material": "paint_black"}],
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        write_text(Path(folder) / "ground.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        write_text(Path(folder) / "scene.toml", toml_text(text))
        return refused(lambda: load_scene(folder), _ADD)


@case("pixels", "a raster of -273 is refused")
def celsius_raster():
    """Values like °C that were taken for kelvin."""
    from tests.robustness.geometry import land

    return refused(lambda: land(np.zeros((4, 4)), np.full((4, 4), -273.0), 1.0, (5e5, 5e6)), _ADD)


@case("pixels", "a constant image displayed by {}: how far apart its darkest and its brightest byte are",
      ("linear", "plateau", "local"))  # fmt: skip
def constant(mode):
    """No division by an empty range; all counts are equal, and so is the picture."""
    counts = np.full((64, 80), 7000, np.uint16)
    return Found(float(np.ptp(DisplaySettings(mode=mode).image(counts)[1].astype(float))), 0.0, 0.0)
