"""The plain frame of `render.basic` against the renderer's, in kelvin."""

import numpy as np
import pytest
import trimesh
from support import slow

import thermorender as tr
from scenes import coarse, write_mesh, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import brightness_temperature
from thermorender.render.basic import basic_frame

# Single precision of the renderer's sums (2⁻²⁴ of 300 K and some ten roundings: 0.2 mK), and tables on both sides. [K]
ARITHMETIC_K = 1e-3
AIR = '[atmosphere]\nstandard = "midlatitude-summer"\naerosol = "rural-23km"\n'
# Rays along a side of a pixel: with 16 rays the plain frame samples as finely as the renderer's first refinement.
SIDE = 4
NADIR = {"pitch_deg": -90.0}


def in_air(folder):
    path = folder / "scene.toml"
    text = path.read_text().replace("[sky]\ntemperature = 250.0\n", AIR).replace("[sky]\ntemperature = 260.0\n", AIR)
    path.write_text(text)
    return folder


def room():
    mesh = trimesh.creation.box(extents=(4, 4, 4)).subdivide().subdivide()
    mesh.invert()
    return mesh


def square(side):
    h = side / 2
    return trimesh.Trimesh([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]], [[0, 1, 2], [0, 2, 3]])


def difference_k(renderer, pose, side=1):
    """Apparent temperature of the plain frame less that of the renderer, (H, W) [K]."""
    band = renderer.plan.band_um
    one, other = basic_frame(renderer.baked, pose, side), renderer.frame(pose).radiance
    return brightness_temperature(one, *band) - brightness_temperature(other, *band)


@pytest.mark.parametrize("mesh, pose", [(room(), np.eye(4)), (square(40.0), tr.pose(0, 0, 5, **NADIR))])
def test_uniform_surfaces_are_equal_to_arithmetic(tmp_path, mesh, pose):
    scene = coarse(tr.load_scene(write_mesh(tmp_path / "s", mesh, 300.0, 0.5)), 16)
    assert np.abs(difference_k(tr.Renderer(scene, rays=32), pose)).max() < ARITHMETIC_K


def test_black_ground_through_air_is_equal_to_the_error_of_the_paths(tmp_path):
    # The renderer interpolates paths of 1.2 km in a grid of 8 % and 100 m, within a millikelvin.
    scene = coarse(tr.load_scene(in_air(write_mesh(tmp_path / "s", square(4000.0), 300.0, 1.0))), 16)
    renderer = tr.Renderer(scene, tolerance_mk=0.5)
    found = difference_k(renderer, tr.pose(0, 0, 900, pitch_deg=-50))
    assert np.abs(found).max() < 1e-3 * renderer.plan.spectrum.channels_mk + 2.0 * ARITHMETIC_K


@pytest.mark.parametrize("place", [lambda folder: folder, in_air])
def test_relief_of_two_materials_differs_by_less_than_the_stated_error(tmp_path, place):
    row, column = np.mgrid[:16, :16]
    height = 1.5 * np.sin(column / 2.5) + 0.2 * row
    renderer = tr.Renderer(coarse(tr.load_scene(place(write_terrain(tmp_path / "s", height))), 16), rays=32)
    pose = tr.pose(0, 0, 14, pitch_deg=-70)
    found = basic_frame(renderer.baked, pose, SIDE) - renderer.radiance(pose)
    stated_mk = renderer.frame(pose).budget_mk["image"]
    assert np.sqrt(np.mean(found**2)) / renderer.plan.radiance_per_mk < stated_mk
    assert np.abs(np.mean(found)) / renderer.plan.radiance_per_mk < 0.3 * stated_mk


@pytest.mark.parametrize("name", slow("heath/survey", "ridge/survey", "village/survey"))
def test_shipped_scenes_differ_by_less_than_the_stated_error(name):
    scene = coarse(tr.load_scene(name), 16)
    renderer, pose = tr.Renderer(scene, rays=32), scene.pose(0, 0, 80, pitch_deg=-60)
    found = basic_frame(renderer.baked, pose, SIDE) - renderer.radiance(pose)
    frame = renderer.frame(pose)
    assert np.sqrt(np.mean(found**2)) / renderer.plan.radiance_per_mk < frame.budget_mk["image"]


def test_mirrors_are_refused(tmp_path):
    path = write_mesh(tmp_path / "s", square(40.0)) / "scene.toml"
    constant = 'source = "constant"\nvalue = 0.9'
    path.write_text(path.read_text().replace(constant, 'source = "material"\nmaterial = "water_fresnel"'))
    baked = tr.Renderer(coarse(tr.load_scene(path.parent), 16), rays=8).baked
    with pytest.raises(ThermorenderError, match="moving objects, mirrors, copies or crowns"):
        basic_frame(baked, tr.pose(0, 0, 5, **NADIR))
