"""What thermal frames of a campaign tell before the test: bounds, a mean, a mean per material, and maps' calibrations.

A campaign is an hour, a weather and a camera. Its training part are the other lands that are flown in it: nothing of
the scene under test is ever seen. Bounds are those of eq. 2 of Generation of artificial infrared camera images for
visual navigation simulation: 1.5 interquartile ranges beyond the quartiles of all values. They suit a map whose
intensities were made by the same rule in one campaign. One that was trained in many gives temperatures, of which the
same rule makes a fraction of their contrast; a calibration, the straight line by least squares from what the map says
of the training part's photographs to what the camera reads of them, is fair to both.
"""

import hashlib
from dataclasses import dataclass

import numpy as np

from thermorender.campaign.bounds import Histogram, bounds_of
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs
from thermorender.schema import every_field
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.readout import radiance_from_counts
from thermorender.units import ZERO_CELSIUS_K

# Poses of a land that are read for its campaign's training part, evenly spaced.
POSES = 12
# Two scenes are of one land where their heights differ by no more than this share of the relief, at so many places
# along each side. Meshes may differ all the same: they are finer beside objects.
_SAME, _PLACES = 0.05, 128


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
    pairs : dict of str to (5,) array
        Of each map: number, Σs, ΣL, Σs², ΣsL of its intensities s and band radiances L of the same ground.
    """

    land: str
    campaign: str
    histogram: Histogram
    radiance: dict
    pixels: dict
    pairs: dict


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
    calibrations : dict of str to (2,) tuple of float
        Of each map: band radiance at intensity 0, and its change from 0 to 1 [W m⁻² sr⁻¹].
    """

    lands: int
    bounds_c: tuple
    mean_k: float
    material_k: dict
    calibrations: dict


def lands_of(scenes):
    """Return the name of each Scene's land, a fingerprint of its relief, the same where reliefs are the same.

    A land is the same under any weather: what lies on it, such as snow, changes heights by little against the relief.
    """
    known, names = [], []
    for scene in scenes:
        vertices = np.concatenate([surface.vertices for surface in scene.surfaces[: scene.terrain_count]])
        sides = np.linspace(vertices.min(axis=0), vertices.max(axis=0), _PLACES)[:, :2]
        east, north = np.meshgrid(*sides.T)
        own = np.stack([east, north, scene.ground(east, north)], axis=-1).reshape(-1, 3)
        name = next((name for name, other in known if _same_relief(own, other)), None)
        if name is None:
            name = hashlib.blake2b(np.ascontiguousarray(own).tobytes(), digest_size=8).hexdigest()
            known.append((name, own))
        names.append(name)
    return names


def _same_relief(one, other):
    hole = np.isnan(one[:, 2])
    if not np.allclose(one[:, :2], other[:, :2], rtol=0.0, atol=1e-3) or (hole != np.isnan(other[:, 2])).any():
        return False
    return bool((one - other)[~hole, 2].std() <= _SAME * one[~hole, 2].std())


def campaign_of(scene, land):
    """Return a fingerprint of a scene's hour, weather and camera; a scene without weather is by itself, with its
    land."""
    spec = scene.spec
    if spec.weather is None:
        return land
    known = f"({scene.time!r}, {spec.weather!r}, {every_field(scene.camera)})"
    return hashlib.blake2b(known.encode(), digest_size=8).hexdigest()


def thermal_of(scene, land, views, seed, models=()):
    """Return the Thermal of a scene from Views of it, behind its sensor.

    Parameters
    ----------
    scene : Scene
    land : str
        As by `lands_of`.
    views : iterable of View
    seed : int
        Of the sensor's noise.
    models : sequence of TemperatureMap
        Of colour only: those that are calibrated.
    """
    camera, histogram, radiance, pixels, pairs = scene.camera, Histogram(), {}, {}, {}
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
        for model in models:
            said = model.predictor.predict(Inputs(view.visible, view.texel_m), model.texel_m)[ground]
            here = np.isfinite(said)
            s, read = said[here].astype(np.float64), value[here]
            row = np.array([here.sum(), s.sum(), read.sum(), s @ s, s @ read])
            pairs[model.name] = pairs.get(model.name, 0.0) + row
    return Thermal(land, campaign_of(scene, land), histogram, radiance, pixels, pairs)


def training_of(own, others, camera):
    """Return the Training of a scene's Thermal from those of others in the same campaign; None where there are none."""
    chosen = [each for each in others if each.campaign == own.campaign and each.land != own.land]
    if not chosen or not any(each.histogram.counts.any() for each in chosen):
        return None
    together, radiance, pixels, pairs = Histogram(), {}, {}, {}
    for each in chosen:
        together.counts += each.histogram.counts
        for name, row in each.pairs.items():
            pairs[name] = pairs.get(name, 0.0) + row
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
        {name: _line(row) for name, row in pairs.items() if row[0]},
    )  # fmt: skip


def _line(row):
    """(Value at 0, slope) of the straight line by least squares of sums as of `Thermal.pairs`; level where all s are
    one."""
    count, s, read, square, both = row / row[0]
    spread = square - s * s
    slope = (both - s * read) / spread if spread > 1e-12 * max(square, 1e-12) else 0.0
    return float(read - slope * s), float(slope)
