"""Stability of learned maps: unseen colours, noise, fits that colours do not determine, unusual training pictures,
a training that explodes, and one that is killed or runs out of disk.

Networks are narrow here and trained for seconds; the criteria are finite numbers and no lost data.
"""

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from tests.robustness.cases import Found, case
from thermorender.apps.training.task import Example, Task
from thermorender.defaults import BAND_UM, TEMPERATURE_MAPS
from thermorender.learned.correlation import PUBLISHED_9TO1
from thermorender.learned.temperature_map import Inputs, TemperatureMap, load_model
from thermorender.physics.planck import brightness_temperature

COLOURS = {"black": (0, 0, 0), "white": (255, 255, 255), "grey": (128, 128, 128), "saturated magenta": (255, 0, 255),
           "one channel": (0, 0, 255)}  # fmt: skip
# Thermal values are hundredths of a kelvin; intensities 0…1 have a range of 280 K to 300 K.
_KELVIN = np.arange(40000) / 100.0
_COLD, _WARM = 280.0, 300.0
_NETWORKS = ("unet-classes", "unet", "unet-gan-keras", "pix2pix", "pix2pixhd", "cyclegan", "compact")
_SETTINGS = {"width": 4, "batch": 2, "crops": 8, "every": 4}


def pictures(count=12, side=64):
    """Return examples of a land whose temperature is linear in red."""
    found = []
    for seed in range(count):
        generator = np.random.default_rng(seed)
        rgb = np.repeat(np.repeat(generator.integers(0, 256, (side // 8, side // 8, 3), np.uint8), 8, 0), 8, 1)
        values = np.rint(100.0 * (285.0 + rgb[..., 0] / 25.5)).astype(np.uint16)
        found.append(Example(Inputs(rgb, 0.2), values, np.ones(values.shape, bool)))
    return found


def task(method, examples, **more):
    """Return the Task of a method on examples, of the settings above where it is a network."""
    from thermorender.apps.training.training_methods import method as known

    options = known(method).options | (_SETTINGS if known(method).long else {})
    intensity = (_KELVIN - _COLD) / (_WARM - _COLD)
    given = {"texel_range_m": (0.2, 0.2)} | more
    return Task(examples, intensity, _KELVIN, 0, lambda what, share: None, options, 0.2, **given)


@cache
def trained(method):
    """Return a map trained by a method on the examples above."""
    from thermorender.apps.training.training_methods import method as known

    predictor = known(method).fit(task(method, pictures()))
    return TemperatureMap(method, method, predictor, (_COLD, _WARM), BAND_UM, 0.2, (0.2, 0.2), "x", 255.0, "x")


def kelvin(model, rgb):
    """Return apparent temperatures [K] of a picture, NaN where none exists."""
    radiance = model.radiance(Inputs(rgb, model.texel_m))
    return np.where(radiance > 0.0, brightness_temperature(np.maximum(radiance, 1e-3), *model.band_um), np.nan)


@case("maps", "{}: every colour gives a temperature, most [K above 290]", _NETWORKS)
def every_colour(method):
    """An unseen colour may not give any network NaN, or a temperature that no ground has."""
    model = trained(method)
    found = [kelvin(model, np.full((64, 64, 3), colour, np.uint8)) for colour in COLOURS.values()]
    # After seconds of training, it may be anywhere around its range; an explosion is not allowed.
    return Found(float(np.abs(np.array(found) - 290.0).max()), 0.0, 200.0)


@case("maps", "shipped {}: noise and colours never seen, least and most [K about 290]", ("palette", "trees"))
def shipped(name):
    model = load_model(f"procedural-{name}")
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    found = [kelvin(model, noise), *(kelvin(model, np.full((9, 9, 3), each, np.uint8)) for each in COLOURS.values())]
    # Both return means of their training data, which were no colder than −62 °C and no hotter than 80 °C.
    return Found(max(float(np.abs(each - 290.0).max()) for each in found), 0.0, 80.0)


@case("maps", "published 9-to-1 on white noise: deviation is the kernel's gain times the picture's [K]")
def gain_of_noise():
    """Σ of its squared coefficients is 4.3², so the photograph's noise is 4.3 times as strong in the result."""
    noise = np.random.default_rng(1).integers(0, 256, (600, 600, 3), np.uint8)
    model = load_model(TEMPERATURE_MAPS[1])
    intensity = model.intensity(model.radiance(Inputs(noise, model.texel_m)))[1:-1, 1:-1]
    gain = float(np.sqrt((PUBLISHED_9TO1.kernel**2).sum()))
    # Of uniform values 0…255 over 255; 360 000 of them give the deviation to 0.2 %, neighbours share taps: to 0.6 %.
    expected = 10.0 * gain * np.sqrt((256.0**2 - 1.0) / 12.0) / 255.0
    return Found(float(10.0 * intensity.std()), expected, 0.02 * expected)


@case("maps", "rank-deficient fit of {}: grey pictures, with a penalty: error [K]", (1, 3))
def grey_fit(size):
    from thermorender.apps.training.correlation_training import fit_correlation

    grey = []
    for each in pictures():
        rgb = np.repeat(each.inputs.rgb[..., :1], 3, axis=-1)
        grey.append(replace(each, inputs=Inputs(rgb, 0.2)))
    job = replace(task("correlation-1to1", grey), options={"intercept": True, "penalty": 1e-9, "above_air": False})
    fitted = fit_correlation(job, size)
    found = _COLD + (_WARM - _COLD) * fitted.predict(grey[0].inputs, 0.2)
    true = _KELVIN[grey[0].values]
    # A rounded value is half a hundredth off, the penalty's effect is smaller.
    return Found(float(np.abs(found - true)[2:-2, 2:-2].max()), 0.0, 0.02)


@case("maps", "{}: black, white, grey and wholly invalid pictures in a training: numbers that are not finite",
      ("unet-gan-keras", "compact"))  # fmt: skip
def odd_pictures(method):
    from thermorender.apps.training.networks.loop import train_network

    odd = pictures()
    for number, level in enumerate((0, 255, 128)):
        odd[number] = replace(odd[number], inputs=Inputs(np.full((64, 64, 3), level, np.uint8), 0.2))
    odd[4] = replace(odd[4], valid=np.zeros((64, 64), bool))
    # Values without a temperature, such as a radiance below zero.
    table = _KELVIN.copy()
    odd[5] = replace(odd[5], values=np.full((64, 64), 7, np.uint16))
    table[7] = np.nan
    job = replace(task(method, odd), temperature=table, intensity=(table - _COLD) / (_WARM - _COLD))
    state = train_network(job, method).state
    return Found(float(sum((~np.isfinite(values)).sum() for values in state.values())), 0.0, 0.0)


@case("maps", "a GAN that explodes stops, with its last good state: numbers that are not finite")
def explodes():
    from thermorender.apps.training.networks import loop

    original, steps = loop.learner_of, iter(range(100))

    def exploding(*given):
        learner = original(*given)
        step = learner.step

        def stepped(batch):
            if next(steps) == 3:
                for weight in learner.parts["discriminator"].parameters():
                    weight.data *= 1e20
            return step(batch)

        learner.step = stepped
        return learner

    loop.learner_of = exploding
    try:
        found = loop.train_network(task("pix2pix", pictures()), "pix2pix")
    finally:
        loop.learner_of = original
    bad = sum((~np.isfinite(values)).sum() for values in found.state.values())
    return Found(float(bad) if found.trained["stopped"] else np.nan, 0.0, 0.0)


class _Cut(BaseException):
    """Stands in for the end of a process."""


@case("maps", "a training that ends at {} and is resumed: weights that differ", ("its third step", "a full disk"))
def resumed(end):
    from thermorender.apps.training.networks import checkpoint, loop

    calls, original = iter(range(1, 100)), checkpoint.save_file

    def stop(what, share):
        if end == "its third step" and next(calls) == 3:
            raise _Cut

    def full(tensors, path, metadata):
        original(tensors, path, metadata)
        if end == "a full disk" and next(calls) == 3:
            Path(path).write_bytes(Path(path).read_bytes()[:64])
            raise _Cut

    with tempfile.TemporaryDirectory() as folder:
        whole = loop.train_network(task("compact", pictures(), run=Path(folder) / "whole"), "compact")
        checkpoint.save_file = full
        try:
            loop.train_network(replace(task("compact", pictures(), run=Path(folder) / "cut"), progress=stop), "compact")
        except _Cut:
            pass
        finally:
            checkpoint.save_file = original
        again = loop.train_network(task("compact", pictures(), run=Path(folder) / "cut", resume=True), "compact")
    return Found(float(sum((whole.state[name] != values).sum() for name, values in again.state.items())), 0.0, 0.0)
