"""What thermal frames of a campaign tell before the test: bounds, a mean, and a mean per material.

A campaign is an hour, a weather and a camera. Its training part are the other lands that are flown in it: nothing of
the scene under test is ever seen. Bounds are those of eq. 2 of Generation of artificial infrared camera images for
visual navigation simulation: 1.5 interquartile ranges beyond the quartiles of all values.
"""

import hashlib
from dataclasses import dataclass

import numpy as np

from thermorender.campaign.bounds import Histogram, bounds_of
from thermorender.frame import apparent_temperature
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.readout import radiance_from_counts
from thermorender.units import ZERO_CELSIUS_K

# Poses of a land that are read for its campaign's training part, evenly spaced.
POSES = 12


@dataclass(frozen=True, eq=False)
class Thermal:
    """What the thermal frames of one scene hold.

    Attributes
    ----------
    land, campaign : str
        Fingerprints of its relief, and of its hour and weather.
    histogram : Histogram
        Of the counts of known ground.
    radiance, pixels : dict of str to float
        Sum of band radiance and number of pixels of each material.
    """

    land: str
    campaign: str
    histogram: Histogram
    radiance: dict
    pixels: dict


@dataclass(frozen=True)
class Training:
    """The training part of a scene's campaign.

    Attributes
    ----------
    lands : int
    bounds_c : (2,) tuple of float
        Refitted temperatures of intensity 0 and 1 [°C].
    mean_k : float
        Apparent temperature of the mean radiance [K].
    material_k : dict of str to float
        The same per material [K].
    """

    lands: int
    bounds_c: tuple
    mean_k: float
    material_k: dict


def land_of(scene):
    """Return a fingerprint of a scene's relief: the same land under any weather has the same."""
    state = hashlib.blake2b(digest_size=8)
    for surface in scene.surfaces[: scene.terrain_count]:
        state.update(np.ascontiguousarray(surface.vertices[:: 1 + len(surface.vertices) // 100_000]).tobytes())
    return state.hexdigest()


def campaign_of(scene):
    """Return a fingerprint of a scene's hour, weather and camera; that of a scene without weather is its own land's."""
    spec = scene.spec
    if spec.weather is None:
        return land_of(scene)
    return hashlib.blake2b(repr((scene.time, spec.weather, scene.camera)).encode(), digest_size=8).hexdigest()


def thermal_of(scene, views, seed):
    """Return the Thermal of a scene from Views of it, behind its sensor."""
    camera, histogram, radiance, pixels = scene.camera, Histogram(), {}, {}
    sensor = sensor_of(camera, seed)
    for view in views:
        counts = sensor.counts_at_rest(view.truth_radiance, view.index)
        ground = view.known & (view.object < 0)
        histogram.add(counts[ground])
        value, material = radiance_from_counts(counts[ground].astype(np.float64), camera), view.material[ground]
        for number in np.unique(material):
            name, here = view.material_names[number], material == number
            radiance[name] = radiance.get(name, 0.0) + float(value[here].sum())
            pixels[name] = pixels.get(name, 0) + int(here.sum())
    return Thermal(land_of(scene), campaign_of(scene), histogram, radiance, pixels)


def training_of(own, others, camera):
    """Return the Training of a scene's Thermal from those of others in the same campaign; None where there are none."""
    chosen = [each for each in others if each.campaign == own.campaign and each.land != own.land]
    if not chosen or not any(each.histogram.counts.any() for each in chosen):
        return None
    together, radiance, pixels = Histogram(), {}, {}
    for each in chosen:
        together.counts += each.histogram.counts
        for name, count in each.pixels.items():
            radiance[name] = radiance.get(name, 0.0) + each.radiance[name]
            pixels[name] = pixels.get(name, 0) + count
    found = bounds_of(together)
    low, high = apparent_temperature(radiance_from_counts(np.array([found.low, found.high]), camera), camera.band_um)
    mean = sum(radiance.values()) / sum(pixels.values())
    kelvin = apparent_temperature(
        np.array([mean, *(radiance[name] / pixels[name] for name in radiance)]), camera.band_um
    )
    return Training(
        len({each.land for each in chosen}), (float(low) - ZERO_CELSIUS_K, float(high) - ZERO_CELSIUS_K),
        float(kelvin[0]), dict(zip(radiance, map(float, kelvin[1:]), strict=True)),
    )  # fmt: skip
