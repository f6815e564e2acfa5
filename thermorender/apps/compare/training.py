"""What methods know of other thermal pictures: bounds, means, means per material, and calibrations of maps.

The source is the training part of a data set, or the other lands of a campaign (one hour, weather and camera), never
the scene under test. Bounds follow eq. 2 of "Generation of artificial infrared camera images for visual navigation
simulation": 1.5 interquartile ranges beyond the quartiles. They suit maps trained within one campaign, but reduce the
contrast of maps trained in many. A calibration, the least-squares line from intensities to radiances, suits both.
"""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.sums import into
from thermorender.apps.compare.view import Levels, View
from thermorender.apps.training.bounds import Histogram, bounds_of
from thermorender.apps.training.dataset import Dataset
from thermorender.apps.training.map_inputs import NO_MATERIAL, ground_of
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs, TemperatureMap
from thermorender.physics.band import radiance_in_band
from thermorender.scene.scene import Scene
from thermorender.schema import every_field
from thermorender.sensor.camera import Camera
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.readout import radiance_from_counts
from thermorender.units import ZERO_CELSIUS_K

# Number of poses per land that are read for the training part, evenly spaced.
POSES = 12
# Two scenes have the same land if their heights differ by no more than this share of the relief, at this many places
# along each side. Their meshes may differ, since they are finer near objects.
_SAME, _PLACES = 0.05, 128


@dataclass(frozen=True, eq=False)
class Thermal:
    """Statistics of the thermal frames of one scene."""

    # land, campaign: Fingerprints of its relief, and of its hour, weather and camera
    land: str
    campaign: str
    histogram: Histogram  # Counts of known ground
    materials: dict[str, NDArray[np.float64]]  # (2,) sum of band radiance and number of pixels of each material
    # For each map: number, Σs, ΣL, Σs², ΣsL of its intensities s and band radiances L of the same ground
    pairs: dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Training:
    """The training part of a scene's campaign."""

    lands: int
    bounds_c: tuple[float, float]  # (2,) tuple refitted temperatures of intensity 0 and 1 [°C]
    mean_k: float  # Apparent temperature of the mean radiance [K]
    material_k: dict[str, float]  # The same per material [K]
    # For each map: band radiance at intensity 0, and its change from 0 to 1 [W m⁻² sr⁻¹]
    calibrations: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class TrainingPart:
    """Statistics of the training part."""

    pairs: int  # Number of pairs read
    mean_k: float | None  # Apparent temperature of the mean radiance [K]; None without pairs
    material_k: dict[str, float]  # The same for each material that occurs [K]
    # (2,) tuple bounds of the 8-bit scale [K]: 1.5 interquartile ranges beyond the quartiles of all values; for
    # pictures of unknown scale, the assumed temperatures
    bounds_k: tuple[float, float] | None


def lands_of(scenes: Sequence[Scene]) -> list[str]:
    """Return the name of each Scene's land: a fingerprint of its relief, which snow and weather hardly change."""
    known: list[tuple[str, NDArray[np.float64]]] = []
    names = []
    for scene in scenes:
        vertices = np.concatenate([surface.vertices for surface in scene.near_ground])
        sides = np.linspace(vertices.min(axis=0), vertices.max(axis=0), _PLACES)[:, :2]
        east, north = np.meshgrid(*sides.T)
        own = np.stack([east, north, scene.ground(east, north)], axis=-1).reshape(-1, 3)
        name = next((name for name, other in known if _same_relief(own, other)), None)
        if name is None:
            name = hashlib.blake2b(np.ascontiguousarray(own).tobytes(), digest_size=8).hexdigest()
            known.append((name, own))
        names.append(name)
    return names


def _same_relief(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    hole = np.isnan(one[:, 2])
    if not np.allclose(one[:, :2], other[:, :2], rtol=0.0, atol=1e-3) or (hole != np.isnan(other[:, 2])).any():
        return False
    return bool((one - other)[~hole, 2].std() <= _SAME * one[~hole, 2].std())


def campaign_of(scene: Scene, land: str) -> str:
    """Return a fingerprint of a scene's hour, weather and camera; of its land alone if the scene has no weather."""
    spec = scene.spec
    if spec.weather is None:
        return land
    known = f"({scene.time!r}, {spec.weather!r}, {every_field(scene.camera, *scene.camera.absent)})"
    return hashlib.blake2b(known.encode(), digest_size=8).hexdigest()


def thermal_of(
    scene: Scene, land: str, views: Iterable[View], seed: int, models: Sequence[TemperatureMap] = ()
) -> Thermal:
    """Return the Thermal of a scene from Views with a reference, with sensor noise of a seed; calibrates `models`."""
    camera, histogram = scene.camera, Histogram()
    materials: dict[str, NDArray[np.float64]] = {}
    pairs: dict[str, NDArray[np.float64]] = {}
    sensor = sensor_of(camera, seed)
    for view in views:
        assert view.truth_radiance is not None
        counts = sensor.counts_at_rest(view.truth_radiance, view.index)
        ground = view.ground
        histogram.add(counts[ground])
        value, material = radiance_from_counts(counts[ground].astype(np.float64), camera), view.material[ground]
        for number in np.unique(material):
            here = material == number
            into(materials, view.material_names[number], np.array([value[here].sum(), here.sum()]))
        for model in models:
            predicted = model.predictor.predict(Inputs(view.visible, view.texel_m), model.texel_m)[ground]
            here = np.isfinite(predicted)
            # The line is that of the map's intensities, which are linear in radiance of its own band.
            s, read = predicted[here].astype(np.float64), radiance_in_band(value[here], camera.band_um, model.band_um)
            into(pairs, model.name, np.array([here.sum(), s.sum(), read.sum(), s @ s, s @ read]))
    return Thermal(land, campaign_of(scene, land), histogram, materials, pairs)


def training_of(own: Thermal | None, others: Iterable[Thermal | None], camera: Camera) -> Training | None:
    """Return the Training of a scene's Thermal from other lands of the same campaign; None if there are none."""
    chosen = [each for each in others if own and each and each.campaign == own.campaign and each.land != own.land]
    if not any(each.histogram.counts.any() for each in chosen):
        return None
    together = Histogram()
    materials: dict[str, NDArray[np.float64]] = {}
    pairs: dict[str, NDArray[np.float64]] = {}
    for each in chosen:
        together.counts += each.histogram.counts
        for total, rows in ((materials, each.materials), (pairs, each.pairs)):
            for name, row in rows.items():
                into(total, name, row)
    found = bounds_of(together)
    low, high = apparent_temperature(radiance_from_counts(np.array([found.low, found.high]), camera), camera.band_um)
    radiance, pixels = np.array([*materials.values()]).T.tolist()
    means = [sum(radiance) / sum(pixels), *(total / count for total, count in zip(radiance, pixels, strict=True))]
    mean_k, *kelvin = apparent_temperature(np.array(means), camera.band_um).tolist()
    return Training(
        len({each.land for each in chosen}), (float(low) - ZERO_CELSIUS_K, float(high) - ZERO_CELSIUS_K), mean_k,
        dict(zip(materials, kelvin, strict=True)), {name: _line(row) for name, row in pairs.items() if row[0]},
    )  # fmt: skip


def _line(row: NDArray[np.float64]) -> tuple[float, float]:
    """Return (value at 0, slope) of the least-squares line of sums as in `Thermal.pairs`; slope 0 if s is constant."""
    _, s, read, square, both = row / row[0]
    spread = square - s * s
    slope = (both - s * read) / spread if spread > 1e-12 * max(square, 1e-12) else 0.0
    return float(read - slope * s), float(slope)


def read_training_part(
    dataset: Dataset, levels: Levels, progress: Callable[[float], object] = lambda share: None
) -> TrainingPart:
    """Return the TrainingPart of a Dataset, read pair by pair."""
    materials = dataset.card.get("materials", [])
    histogram = Histogram()
    total, amount = np.zeros(256), np.zeros(256)
    for number, entry in enumerate(dataset.entries):
        progress(number / len(dataset))
        pair = dataset.pair(entry, truth=bool(materials))
        known = ground_of(pair)
        values = pair.thermal[known]
        histogram.add(values)
        if "material" in pair.truth:
            where = pair.truth["material"][known]
            total += np.bincount(where, levels.radiance(values), 256)
            amount += np.bincount(where, minlength=256)
    bounds: tuple[float, float] | None = None
    if dataset.scale.unit == "intensity" and dataset.scale.range_c is not None:
        cold_c, warm_c = dataset.scale.range_c
        bounds = ZERO_CELSIUS_K + cold_c, ZERO_CELSIUS_K + warm_c
    counts = histogram.counts
    if not counts.any():
        return TrainingPart(len(dataset), None, {}, bounds)
    band, value = dataset.scale.band_um, np.arange(len(counts), dtype=np.uint16)
    mean = (levels.radiance(value) * counts).sum() / counts.sum()
    if bounds is None:
        limits = bounds_of(histogram)
        low, high = map(float, apparent_temperature(dataset.scale.radiance([limits.low, limits.high]), band))
        bounds = low, high
    seen = [number for number in range(min(len(materials), NO_MATERIAL)) if amount[number]]
    means = apparent_temperature(np.array([total[number] / amount[number] for number in seen]), band)
    material_k = {materials[number]: float(kelvin) for number, kelvin in zip(seen, means, strict=True)}
    return TrainingPart(len(dataset), float(apparent_temperature(mean, band)), material_k, bounds)
