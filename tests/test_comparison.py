"""The comparison of learned maps with the radiometric render."""

import json

import numpy as np
import pytest

import thermorender as tr
from scenes import write_terrain
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.physics.planck import brightness_temperature
from thermorender.validate.comparison import ErrorSums, compare


def test_sums_are_those_of_all_errors_together():
    rng = np.random.default_rng(0)
    errors = [rng.normal(1.5, 2.0, size) for size in (100, 37, 1000)]
    sums = ErrorSums()
    for error in errors:
        sums.add(np.append(error, np.nan))
    together = np.concatenate(errors)
    found = sums.summary()
    assert found["mean_c"] == pytest.approx(together.mean())
    assert found["mean_absolute_c"] == pytest.approx(np.abs(together).mean())
    assert found["std_c"] == pytest.approx(together.std())
    assert found["pixels"] == 1137 and found["pixels_without_temperature"] == 3


def test_a_scene_the_map_describes_exactly(tmp_path):
    """Where the truth is the map's own apparent temperature on a black, flat ground, its errors vanish."""
    model = load_model("fok-1to1")
    colour = np.full((32, 32, 3), (150, 110, 90), np.uint8)
    kinetic = brightness_temperature(model.radiance(Inputs(colour)), *model.band_um)
    folder = write_terrain(tmp_path / "s", height=np.zeros((16, 16)), colour=colour, temperature=kinetic)
    text = (folder / "scene.toml").read_text()
    start, end = text.index("[emissivity]"), text.index("[sky]")
    (folder / "scene.toml").write_text(text[:start] + '[emissivity]\nsource = "constant"\nvalue = 1.0\n' + text[end:])
    path = tr.Trajectory(np.array([0.0]), np.array([[0.0, 0.0, 8.0]]), np.array([[0.0, 1.0, 0.0, 0.0]]))
    summary = compare(tr.load_scene(folder), path, tmp_path / "c", ["fok-1to1"], rays=4)
    for method in ("fok-1to1 2D", "fok-1to1 3D"):
        assert summary["errors"][method]["mean_absolute_c"] < 1e-3, method
    written = json.loads((tmp_path / "c/comparison.json").read_text())
    assert written["errors"] == summary["errors"] and written["maps"]["fok-1to1"]["share_outside_0_1"] == 0.0
    assert (tmp_path / "c/pose_0000_fok-1to1.png").stat().st_size > 10_000
    wrong = compare(tr.load_scene(folder), path, tmp_path / "d", ["fok-1to1"], range_c=(24.0, 34.0), rays=4)
    assert wrong["errors"]["fok-1to1 2D"]["mean_c"] == pytest.approx(10.0, abs=0.2)


def test_refusals(tmp_path):
    folder = write_terrain(tmp_path / "s")
    path = tr.Trajectory(np.array([0.0]), np.array([[0.0, 0.0, 8.0]]), np.array([[0.0, 1.0, 0.0, 0.0]]))
    with pytest.raises(ThermorenderError, match="models is empty"):
        compare(tr.load_scene(folder), path, tmp_path / "c", [])
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace('[truth]\ntemperature = "temperature.tif"\n', ""))
    with pytest.raises(ThermorenderError, match="has no truth.temperature"):
        compare(tr.load_scene(folder), path, tmp_path / "c", ["fok-1to1"])
    assert not (tmp_path / "c").exists()
