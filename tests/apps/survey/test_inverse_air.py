"""The air removed from frames, against the renderer's own radiance at the ground."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import write_mesh
from thermorender.apps.survey.inverse.air import without_air
from thermorender.apps.survey.inverse.frames import Survey
from thermorender.physics.planck import brightness_temperature
from thermorender.render.renderer import Renderer
from thermorender.sensor.camera import load_camera


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """(Renderer, Survey of a nadir and an oblique frame through humid air, their temperatures without it [K])."""
    folder, half = tmp_path_factory.mktemp("air"), 1000.0
    corners = [[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]]
    write_mesh(folder, trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]), 320.0, 0.95)
    full = load_camera("zenmuse-xt2")
    camera = replace(full, width=80, height=64, pixel_pitch_um=8.0 * full.pixel_pitch_um)
    scene = tr.load_scene(folder).with_camera(camera).with_air("tropical")
    renderer = Renderer(scene, quality="fast")
    poses = np.array([tr.pose(0.0, 0.0, 300.0, pitch_deg=-90.0), tr.pose(0.0, -250.0, 250.0, pitch_deg=-45.0)])
    through, at_ground = (
        np.array([brightness_temperature(renderer.radiance(pose, through_air=air), *camera.band_um) for pose in poses])
        for air in (True, False)
    )
    survey = Survey(("a", "b"), ("", ""), through.astype(np.float32), poses)
    return renderer, survey, at_ground


def test_frames_without_air_are_those_of_the_ground(seen):
    renderer, survey, at_ground = seen
    found = without_air(survey, renderer.scene.camera, renderer)
    for before, after, truth in zip(survey.kelvin, found.kelvin, at_ground, strict=True):
        assert np.abs(before - truth).min() > 4.0
        assert np.abs(after - truth).max() < 0.01
    assert "removed from 2 frames" in found.notes[-1]


def test_air_that_a_file_removed_is_not_removed_twice(seen):
    renderer, survey, _ = seen
    found = without_air(replace(survey, air_removed=(True, False)), renderer.scene.camera, renderer)
    np.testing.assert_array_equal(found.kelvin[0], survey.kelvin[0])
    assert np.abs(found.kelvin[1] - survey.kelvin[1]).min() > 0.0
    assert "removed from 1 frames" in found.notes[-1]


def test_pixels_without_a_value_stay_so_and_a_frame_of_the_sky_as_it_is(seen):
    renderer, survey, _ = seen
    kelvin = survey.kelvin.copy()
    kelvin[0, :3] = np.nan
    up = tr.pose(0.0, 0.0, 300.0, pitch_deg=80.0)
    found = without_air(replace(survey, kelvin=kelvin, poses=np.stack([survey.poses[0], up])), renderer.scene.camera,
                        renderer)  # fmt: skip
    assert np.isnan(found.kelvin[0, :3]).all() and np.isfinite(found.kelvin[0, 3:]).all()
    np.testing.assert_array_equal(found.kelvin[1], kelvin[1])
