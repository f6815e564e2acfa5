"""Frames without terrain are found from the geometry before any is rendered."""

import numpy as np
import pytest

import thermorender as tr
from scenes import write_terrain
from thermorender.output.terrain_in_view import empty_frames_note, shows_terrain


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("terrain") / "s"
    write_terrain(folder, height=np.zeros((16, 16)))
    return tr.load_scene(folder)


def poses(*given):
    return np.stack([tr.pose(*place, **angles) for *place, angles in given])


def test_terrain_is_found_from_above_from_beside_and_from_low(scene):
    half = 0.5 * np.ptp(scene.surfaces[0].vertices[:, 0])
    views = poses(
        (0, 0, 50, {"pitch_deg": -90}),
        # So low that the picture lies within a face.
        (0.1, 0.2, 0.05, {"pitch_deg": -90}),
        (0, -3 * half, 5, {"pitch_deg": -5}),
        # Past the terrain: up, level from its middle, and away from it.
        (0, 0, 50, {"pitch_deg": 60}),
        (0, 0, 3 * half, {"pitch_deg": 0}),
        (0, -3 * half, 5, {"pitch_deg": -5, "yaw_deg": 180}),
    )
    assert shows_terrain(scene, views).tolist() == [True, True, True, False, False, False]


def test_note_names_the_option_that_mends_it(scene):
    down, level = {"pitch_deg": -90}, {"pitch_deg": 0}
    assert empty_frames_note(scene, poses(*[(0, 0, 50, down)] * 2, (900, 0, 50, down))) is None
    note = empty_frames_note(scene, poses((0, 0, 50, down), *[(0, 0, 90, level)] * 2))
    assert note.startswith(
        "2 of 3 frames looked at show no terrain: the flight is over the terrain, but the camera looks"
    )
    assert "0° below the horizon; point it with mount YAW,PITCH,ROLL (0,-90,0 looks down)" in note
    note = empty_frames_note(scene, poses(*[(900, 70, 50, down)] * 1000))
    assert "200 of 200 frames" in note or "of 167 frames" in note
    assert "off the scene's terrain, about east 900 m, north 70 m" in note and "anchor=E,N,U,HEADING" in note
