"""The recipes of docs/architecture.md run as written there, and do what they say."""

import re
from pathlib import Path

import numpy as np
import pytest

import thermorender as tr
from scenes import write_terrain
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.materials.library import load_library

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
RECIPES = dict(re.findall(r"^### An? (.+?)\n.*?```python\n(.*?)```", PAGE, flags=re.S | re.M))


@pytest.fixture
def run(tmp_path):
    folder = write_terrain(tmp_path / "scene")

    def run(name):
        found = {"scene_folder": folder}
        exec(compile(RECIPES[name], f"recipe: {name}", "exec"), found)
        return found

    return run


def test_there_are_three_of_at_most_twenty_lines():
    assert set(RECIPES) == {"material", "camera", "learned map"}
    for name, code in RECIPES.items():
        assert len([line for line in code.splitlines() if line.strip()]) <= 20, name


def test_a_material_is_added(run):
    folder = run("material")["scene_folder"]
    found = load_library(folder / "materials")["roof_membrane"]
    # Six decimals are stored.
    assert found.emissivity_at(10.0) == pytest.approx(0.94 + 0.02 * np.cos(10.0), abs=1e-6)
    text = (folder / "scene.toml").read_text(encoding="utf-8").replace("grass_green", "roof_membrane")
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    assert "roof_membrane" in [material.name for material in tr.load_scene(folder).materials]


def test_a_camera_is_added(run):
    found = run("camera")
    assert found["frame"].camera.focal_length_mm == 25.0
    assert found["frame"].radiance.shape == (512, 640)


def test_a_learned_map_is_added(run):
    found = run("learned map")
    mine = load_model(found["scene_folder"] / "green.npz")
    # The map is applied texel by texel; for a grey scene the intensity is the kernel's sum times the brightness.
    grey = mine.radiance(Inputs(np.full((4, 4, 3), 128, np.uint8)))
    np.testing.assert_allclose(mine.intensity(grey), 0.5 * 128 / 255, atol=1e-12)
    share = found["scene"].temperature_state.report["green-is-cool"]["share_fallback"]
    assert 0.0 <= share < 0.5
