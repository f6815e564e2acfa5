"""Edits of materials and temperatures: previews within their stated error, and solutions from the known light."""

from dataclasses import replace

import numpy as np
import pytest

import thermorender as tr
from scenes import write_terrain

DOWN = {"pitch_deg": -90.0}
AREA = np.array([[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]])


@pytest.fixture(scope="module")
def renderer(tmp_path_factory):
    """A street between walls twice as high as it is wide, half of it warm."""
    height = np.full((24, 24), 12.0)
    height[:, 9:15] = 0.0
    kelvin = np.full((48, 48), 285.0)
    kelvin[:24] = 305.0
    folder = write_terrain(tmp_path_factory.mktemp("edits") / "street", height, kelvin)
    scene = tr.load_scene(folder)
    camera = replace(scene.camera, width=64, height=48)
    # Without a search for edges, so that two images have the same rays.
    return tr.Renderer(scene.with_camera(camera), rays=64, edge_mk=np.inf)


def spectrum(material, at_um, by):
    """A material whose emissivity differs by `by` near a wavelength."""
    near = np.exp(-((material.wavelength_um - at_um) ** 2))
    return replace(material, name="edited", emissivity=np.clip(material.emissivity + by * near, 0.0, 1.0))


def warmer(scene, number, by):
    """The scene with the texels of a material warmer."""
    surface = scene.surfaces[0]
    kelvin = np.where(surface.material == number, by, 0.0) + surface.temperature
    return scene.with_temperature(scene.spec.temperature, kelvin=[kelvin])


EDITS = {
    "emissivity": lambda scene: scene.with_material(grass_green=0.9),
    "nearly black": lambda scene: scene.with_material(grass_green=0.999, sand_quartz=0.999),
    "much reflection": lambda scene: scene.with_material(sand_quartz=0.4),
    "a point of a spectrum": lambda scene: scene.with_material(grass_green=spectrum(scene.materials[0], 9.0, -0.2)),
    "temperature of a class": lambda scene: warmer(scene, 0, 8.0),
    "another material": lambda scene: scene.with_material(sand_quartz="asphalt"),
    "a class like the other": lambda scene: scene.with_material(sand_quartz="grass_green"),
    "an area": lambda scene: scene.with_material_in(AREA, "concrete"),
    "materials and temperature": lambda scene: warmer(scene.with_material(sand_quartz=0.7), 1, -5.0),
}


def off(one, other):
    """Largest difference of texels, of faces and of the images of two renderers [mK]."""
    poses = tr.pose(0, 0, 40, **DOWN), tr.pose(-6, 2, 30, pitch_deg=-60.0, yaw_deg=90.0)
    pairs = [(one.radiance(pose), other.radiance(pose)) for pose in poses]
    pairs.append(tuple(sum(each.baked.texels) for each in (one, other)))
    return max(float(np.abs(a - b).max()) for a, b in pairs) / one.plan.radiance_per_mk


@pytest.mark.parametrize("name", EDITS)
def test_preview_differs_from_the_solution_by_its_stated_error_at_most(renderer, name):
    scene = EDITS[name](renderer.scene)
    preview, exact = renderer.preview_for(scene), renderer.solved_for(scene)
    stated, change = preview.baked.errors_mk["preview"], off(exact, renderer)
    apart = (preview.baked.texels[0] - exact.baked.texels[0]) / renderer.plan.radiance_per_mk
    assert np.sqrt(np.mean(apart**2)) < preview.baked.errors_mk["preview_rms"] <= stated
    assert off(preview, exact) < stated < 0.5 * change
    assert "preview" not in exact.baked.errors_mk


def test_an_edit_back_to_the_known_scene_changes_nothing(renderer):
    edited = renderer.solved_for(EDITS["emissivity"](renderer.scene))
    again = edited.solved_for(EDITS["emissivity"](renderer.scene))
    assert off(edited, again) == 0.0
