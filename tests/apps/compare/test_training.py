"""Statistics of a campaign."""

from dataclasses import replace

import numpy as np
import pytest
from compare_support import BAND, black, errors, flight, rendered, structured, translated

import thermorender as tr
from scenes import WEATHER, scene_object, write_terrain
from thermorender.apps.compare import (
    training,
)
from thermorender.apps.compare.comparison import Options, compare
from thermorender.learned.correlation import Correlation
from thermorender.learned.temperature_map import Inputs, TemperatureMap, save_map
from thermorender.output.photograph import photograph
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.camera import load_camera
from thermorender.sensor.readout import radiance_from_counts


def test_a_land_is_the_same_under_snow_but_differs_from_other_lands(tmp_path):
    rng = np.random.default_rng(3)
    one, other = rng.uniform(0.0, 2.0, (2, 32, 32))
    snow = np.where(rng.uniform(size=one.shape) < 0.2, 0.03, 0.0)
    heights = {"bare": one, "snowy": one + snow, "other": other, "flat": np.zeros((32, 32))}
    # The ground's mesh is finer around an object.
    box = scene_object("box", position=[1, 2, 0], material="brass")
    scenes = [
        tr.load_scene(write_terrain(tmp_path / name, height, extra=box if name == "snowy" else ""))
        for name, height in heights.items()
    ]
    assert len(scenes[0].surfaces[0].vertices) != len(scenes[1].surfaces[0].vertices)
    bare, snowy, *rest = training.lands_of(scenes)
    assert bare == snowy and len({bare, *rest}) == 3


def test_means_of_the_training_part_are_means_of_radiance():
    histogram = training.Histogram()
    histogram.add(np.array([8000, 8200, 8400, 8600], np.uint16))
    radiance = band_radiance(np.array([290.0, 300.0]), *BAND)
    materials = {name: np.array([2.0 * each, 2.0]) for name, each in zip(("grass", "sand"), radiance, strict=True)}
    thermal = training.Thermal("a", "day", histogram, materials, {})
    own = replace(thermal, land="b")
    found = training.training_of(own, [thermal, own], load_camera("zenmuse-xt2"))
    assert found.material_k == pytest.approx({"grass": 290.0, "sand": 300.0}, abs=1e-3)
    assert found.mean_k == pytest.approx(brightness_temperature(radiance.mean(), *BAND), abs=1e-3)
    assert training.training_of(own, [own], load_camera("zenmuse-xt2")) is None
    assert training.training_of(own, [replace(thermal, campaign="night")], load_camera("zenmuse-xt2")) is None


@pytest.mark.slow
def test_bounds_are_refitted_on_other_lands_of_the_same_hour_and_weather(tmp_path):
    day = ('[weather]\ntime = 2018-07-28T14:30:00Z\nair_low_c = 9.0\nair_high_c = 22.0\nhumidity = 0.6\n'
           'wind_m_s = 3.0\ncloud = 0.2\n')  # fmt: skip
    other = day.replace("14:30", "06:30")
    rng = np.random.default_rng(1)
    relief = [rng.uniform(0.0, 0.3, (32, 32)) for _ in range(3)]
    folders = [
        black(write_terrain(tmp_path / name, relief[land], structured(land, spread=spread), extra=weather))
        for name, land, spread, weather in (
            ("a", 0, 4.0, day), ("b", 1, 1.0, day), ("c", 2, 9.0, other), ("a-again", 0, 30.0, day),
        )
    ]  # fmt: skip
    flown = [flight(folder) for folder in folders]
    found = compare(flown, tmp_path / "o", ["fok-1to1"], Options(settings={"rays": 2, "samples": 1}))
    reported = {scene["name"]: scene["campaign"] for scene in found["scenes"]}
    assert reported["c"] is None and reported["a"]["lands"] == 1
    # The range of `a` is that between the quartiles of what the camera reads over `b` alone.
    renderer, counts = tr.Renderer(flown[1].scene, rays=2, samples=1), []
    for index, pose in enumerate(flown[1].poses):
        frame = renderer.frame(pose, float(index), index)
        counts.append(frame.counts[np.isfinite(frame.truth["depth"])])
    first, third = np.quantile(np.concatenate(counts), [0.25, 0.75])
    camera = flown[1].scene.camera
    ends = radiance_from_counts(np.array([first - 1.5 * (third - first), third + 1.5 * (third - first)]), camera)
    expected = brightness_temperature(ends, *BAND) - 273.15
    assert reported["a"]["bounds_c"] == pytest.approx(expected, abs=0.02)
    assert reported["a-again"]["bounds_c"] == reported["a"]["bounds_c"] != reported["b"]["bounds_c"]
    labels = set(found["methods"])
    ways = ("", ", refitted", ", calibrated")
    assert {use("fok-1to1", way) for use in (translated, rendered) for way in ways} <= labels
    assert {"a constant", "a mean per material"} <= labels
    assert len({scene["land"] for scene in found["scenes"]}) == 3


@pytest.mark.slow
def test_calibration_removes_the_scale_of_a_map(tmp_path):
    """A map and one of half its contrast, inverted, have equal calibrated errors: those of the least-squares line by
    `np.polyfit` through the camera's radiances of the other land."""
    rng = np.random.default_rng(5)
    folders = []
    for k in range(2):
        warm = structured(k, spread=3.0)
        grey = np.clip(40.0 + 8.0 * (warm - 280.0) + rng.normal(0.0, 6.0, warm.shape), 0, 255).astype(np.uint8)
        folders.append(black(write_terrain(tmp_path / f"land{k}", rng.uniform(0.0, 0.3, (32, 32)), warm,
                                           colour=np.repeat(grey[..., None], 3, axis=-1), extra=WEATHER)))  # fmt: skip
    plain = TemperatureMap("plain", "correlation-1to1", Correlation(np.full((1, 1, 3), 0.4), 0.1), (280.0, 300.0), BAND,
                           0.5, (0.01, 5.0), "zenmuse-xt2", 255.0, "a test")  # fmt: skip
    turned = replace(plain, name="turned", range_k=(220.0, 330.0),
                     predictor=Correlation(np.full((1, 1, 3), -0.2), 0.9))  # fmt: skip
    files = []
    for model in (plain, turned):
        save_map(model, tmp_path / f"{model.name}.npz")
        files.append(str(tmp_path / f"{model.name}.npz"))
    flown = [flight(folder) for folder in folders]
    found = compare(flown, tmp_path / "c", files, Options(arrays=True, settings={"rays": 2}))
    own = {label: errors(found, label) for label in found["methods"]}
    for use in (translated, rendered):
        one, two = (own[use(name, ", calibrated")] for name in ("plain", "turned"))
        assert one["mae_k"] == pytest.approx(two["mae_k"], abs=1e-3)
        assert one["mae_k"] < own[use("plain", ", refitted")]["mae_k"]
        assert own[use("turned", ", refitted")]["mae_k"] > 2.0 * two["mae_k"]

    def said(visible, frame):
        depth = frame.truth["depth"]
        texel_m = float(np.median(depth[np.isfinite(depth)])) / flown[0].scene.camera.focal_length_px
        return plain.radiance(Inputs(visible, texel_m))

    seen, read = [], []
    renderer = tr.Renderer(flown[1].scene, rays=2)
    for k, pose in enumerate(flown[1].poses):
        frame, (visible, _) = renderer.frame(pose, float(k), k), photograph(renderer, pose, float(k))
        here = np.isfinite(frame.truth["depth"])
        seen.append(said(visible, frame)[here])
        read.append(radiance_from_counts(frame.counts[here].astype(float), flown[1].scene.camera))
    slope, zero = np.polyfit(np.concatenate(seen), np.concatenate(read).astype(float), 1)
    renderer = tr.Renderer(flown[0].scene, rays=2)
    visible, _ = photograph(renderer, flown[0].poses[0], 0.0)
    expected = zero + slope * said(visible, renderer.frame(flown[0].poses[0], 0.0, 0))
    expected = brightness_temperature(expected, *BAND)
    with np.load(tmp_path / "c" / "arrays" / "land0_0000.npz") as kept:
        assert np.abs(kept["plain_on_the_photograph__calibrated"] - expected)[kept["known"]].max() < 0.02
