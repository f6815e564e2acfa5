"""Temperatures of walls and other parts of a mesh: faces without a map of their own, and walls against a closed form."""

import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import WEATHER
from thermorender.render.heat import simulation as heat

AT = np.datetime64("2018-07-28T12:00:00")
FRAME = "[frame]\nlatitude_deg = 52.0\nlongitude_deg = 0.0\nheight_m = 0.0\n"


def mesh_scene(folder, mesh, material, weather=WEATHER):
    folder.mkdir(parents=True, exist_ok=True)
    mesh.export(folder / "m.ply")
    (folder / "scene.toml").write_text(
        f'[terrain]\nmesh = "m.ply"\n[temperature]\nsource = "balance"\n[emissivity]\nsource = "material"\n'
        f'material = "{material}"\n[sky]\ntemperature = 255.0\n{FRAME}{weather}'
    )
    return tr.load_scene(folder)


def test_every_face_with_a_colour_of_its_own_has_its_own_sun(tmp_path):
    """Faces that show one texel each: those of a box differ by orientation; each had the sun of the last face."""
    box = trimesh.creation.box((4.0, 4.0, 4.0))
    box.apply_translation((0.0, 0.0, 2.0))
    box.visual.face_colors = np.arange(12)[:, None] * np.array([10, 5, 3, 0]) + np.array([60, 60, 60, 255])
    scene = mesh_scene(tmp_path / "box", box, "roof_rubber")
    solved = heat.solved(scene, [AT])[0]
    surface = solved.surfaces[0]
    corner = surface.vertices[surface.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rows, columns = surface.material.shape
    at = (surface.uv[:, 0] * (columns, rows)).astype(int)
    kelvin = surface.temperature[at[:, 1], at[:, 0]]
    south, north, up = (kelvin[normal @ axis > 0.9].mean() for axis in ([0, -1, 0], [0, 1, 0], [0, 0, 1]))
    # The sun is 57° high in the south: 0.54 of the beam on the south wall, 0.84 on the roof, none on the north wall.
    assert up > south + 3.0 and south > north + 5.0
