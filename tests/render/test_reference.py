"""The path-traced reference against closed forms, and the renderer against the reference, in standard errors."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from copies_support import leaves
from scipy.spatial import ConvexHull
from support import slow

import thermorender as tr
from scenes import coarse, scene_object, write_materials, write_mesh, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.render import reference
from thermorender.scene.surface import BEHIND

BAND = (7.5, 13.5)
MILLIKELVIN = band_radiance_derivative(300.0, *BAND) * 1e-3


def small(scene):
    """The scene with a camera of 80×64 pixels over the same field of view."""
    camera = scene.camera
    return scene.with_camera(replace(camera, width=80, height=64, pixel_pitch_um=camera.pixel_pitch_um * 8))


@pytest.mark.parametrize("emissivity", [1.0, 0.5])
def test_reference_in_an_isothermal_enclosure(tmp_path, emissivity):
    walls = trimesh.creation.box(extents=(4, 4, 4)).subdivide()
    walls.invert()
    scene = small(tr.load_scene(write_mesh(tmp_path / "s", walls, 300.0, emissivity, sky=0.0)))
    radiance = reference.render(scene, np.eye(4), samples=16, depth=48)
    error = radiance.mean() - band_radiance(300.0, *BAND)
    # Half of the light is lost at each wall: after 48 bounces what remains is negligible.
    assert abs(error) < 4 * radiance.std() / np.sqrt(radiance.size)
    assert abs(error) < 2 * MILLIKELVIN


@pytest.mark.parametrize("relief", [*slow(0.0), 1.0])
def test_renderer_against_the_reference(tmp_path, relief):
    rows, columns = np.mgrid[:24, :24]
    height = relief * (np.sin(rows / 2.0) + np.cos(columns / 3.0))
    scene = small(tr.load_scene(write_terrain(tmp_path / "s", height=height, sky=240.0)))
    pose = tr.pose(0, 0, 14, pitch_deg=-80)
    seen = tr.Renderer(scene, quality="high", rays=512, tolerance_mk=1.0).frame(pose)
    first, second = (reference.render(scene, pose, samples=64, seed=seed) for seed in (1, 2))
    ground = (seen.truth["mask"] & 1) > 0
    assert ground.mean() > 0.9
    error = (seen.radiance - 0.5 * (first + second))[ground] / MILLIKELVIN
    # The mean's own error, from the difference of two independent renders.
    noise = np.std((first - second)[ground] / MILLIKELVIN) / 2 / np.sqrt(ground.sum())
    # On flat ground only the nodes may differ, by less than their tolerance. On relief light is constant per face:
    # the error is some 10 mK from pixel to pixel, and a tenth of that in the mean over hundreds of faces.
    assert abs(error.mean()) < 4 * noise + (0.3 if relief == 0.0 else 1.0)
    images = (image[ground] / MILLIKELVIN for image in (seen.radiance, first, second))
    square, uncertainty = reference.squared_error(*images)
    limit = 3.0 if relief == 0.0 else 20.0
    assert square - 4 * uncertainty < limit**2
    # The limit is meaningful: a change of 1 % of the radiance would exceed it.
    assert np.abs(seen.radiance[ground] * 0.99 - first[ground]).mean() / MILLIKELVIN > 5 * limit


@pytest.mark.slow
def test_thin_leaves_hide_their_projected_area(tmp_path):
    """Black leaves of 280 K before black ground of 340 K: both engines show the areas of their silhouettes."""
    folder = tmp_path / "s"
    folder.mkdir()
    middle = np.column_stack([*(each.ravel() for each in np.mgrid[-2:3, -2:3] * 0.6), np.full(25, 1.0)])
    vertices, faces = leaves(np.random.default_rng(4), middle, 0.4)
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "leaves.ply")
    write_materials(folder)
    extra = scene_object("leaves", [1, 1, 1], [0, 0, 0], 280.0, "black", file="leaves.ply")
    floor = trimesh.creation.box(extents=(40.0, 40.0, 0.1)).apply_translation([0.0, 0.0, -0.05])
    scene = small(tr.load_scene(write_mesh(folder, floor, 340.0, 1.0, sky=0.0, extra=extra)))
    pose = tr.pose(0, 0, 6, pitch_deg=-90)
    corner = scene.camera.project((vertices - pose[:3, 3]) @ pose[:3, :3]).reshape(25, 4, 2)
    pixels = sum(ConvexHull(leaf).volume for leaf in corner)
    leaf, ground = band_radiance(np.array([280.0, 340.0]), *BAND)
    share = pixels / (scene.camera.width * scene.camera.height)
    exact = ground + share * (leaf - ground)
    assert 0.05 < share < 0.3 and (corner > 0.0).all() and (corner < (80, 64)).all()
    means = np.array([reference.render(scene, pose, samples=256, seed=seed).mean() for seed in range(5)])
    error, noise = (means.mean() - exact) / MILLIKELVIN, means.std(ddof=1) / np.sqrt(5) / MILLIKELVIN
    print("reference", error, noise)
    assert abs(error) < 4.0 * noise < 15.0
    frame = tr.Renderer(scene, quality="high", rays=1).frame(pose)
    own = (frame.radiance.mean() - exact) / MILLIKELVIN
    print("renderer", own, frame.budget_mk["sampling"])
    # Errors of pixels are independent.
    assert abs(own) < 4.0 * frame.budget_mk["sampling"] / np.sqrt(frame.radiance.size) < 25.0


def test_reference_as_a_frame(tmp_path):
    scene = small(tr.load_scene(write_mesh(tmp_path / "s", trimesh.creation.box(extents=(9, 9, 0.1)), 300.0, 1.0)))
    renderer = tr.Renderer(scene, rays=1)
    frame = reference.frame(renderer, tr.pose(0, 0, 3, pitch_deg=-90), samples=4)
    assert frame.plan == {"engine": "reference", "paths": 4, "depth": 8}
    assert frame.counts.shape == (64, 80) and abs(frame.apparent_temperature.mean() - 300.0) < 0.2


def test_refusals(tmp_path):
    scene = tr.load_scene(write_mesh(tmp_path / "s", trimesh.creation.box(), 300.0, 1.0))
    with pytest.raises(ThermorenderError, match="samples=0 is not allowed"):
        reference.render(scene, np.eye(4), samples=0)


@pytest.mark.parametrize("height_m", [*slow(30.0), 3000.0])
def test_a_wall_reflects_the_same_horizon_from_any_height(tmp_path, height_m):
    """Half of the light that a steep wall reflects is sky, whatever the height of the camera."""
    tilt = np.radians(70.0)
    wall = trimesh.Trimesh([[-20, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]], [[0, 1, 2], [0, 2, 3]])
    wall.apply_transform(trimesh.transformations.rotation_matrix(tilt, [1, 0, 0]))
    scene = small(tr.load_scene(write_mesh(tmp_path / "s", wall, 300.0, 0.2, sky=220.0)))
    # A telescope: the wall, seen from above, fills the picture.
    camera = replace(scene.camera, focal_length_mm=scene.camera.focal_length_mm * height_m / 8.0)
    scene = scene.with_camera(camera)
    radiance = reference.render(scene, tr.pose(0, 0, height_m, pitch_deg=-90), samples=1024)
    sky, around, own = band_radiance(np.array([220.0, scene.surroundings_temperature, 300.0]), *BAND)
    up = 0.5 * (1.0 + np.cos(tilt))
    exact = 0.2 * own + 0.8 * (up * sky + (1.0 - up) * around)
    error = radiance - exact
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(error.size) + 5.0 * MILLIKELVIN < 40.0 * MILLIKELVIN


def test_sheet_of_the_ground_is_seen_from_both_sides_as_in_frames(tmp_path):
    # Surroundings as warm as the sky, so that both sides reflect the same light.
    sheet = trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    scene = tr.load_scene(
        write_mesh(tmp_path / "s", sheet, emissivity=0.6, extra="[surroundings]\ntemperature = 250.0")
    )
    scene = coarse(scene, 32)
    for up, pitch in ((8.0, -90.0), (-8.0, 90.0)):
        pose = tr.pose(0.0, 0.0, up, pitch_deg=pitch)
        frame = tr.Renderer(scene).frame(pose)
        traced = reference.render(scene, pose, 256)
        assert (frame.truth["mask"] & BEHIND == BEHIND).all() == (up < 0.0)
        np.testing.assert_allclose(traced.mean(), frame.radiance.mean(), rtol=2e-3)


@pytest.mark.slow
def test_steep_ground_has_its_light_and_its_stated_error_from_any_height(tmp_path):
    """Long rays end some millimetres from a face, where walks and paths would start inside of the ground."""
    height = np.random.Generator(np.random.Philox(3)).random((24, 24)) * 3.0
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=height, sky=150.0)).with_material({1: 0.5, 2: 0.5})
    means, noises, stated = [], [], []
    for height_m in (300.0, 10_000.0):
        # About 8 m of the ground, in pixels of 0.1 m.
        focal = scene.camera.pixel_pitch_um * height_m / 100.0
        own = scene.with_camera(replace(scene.camera, width=80, height=64, focal_length_mm=focal))
        pose = tr.pose(0, 0, height_m, pitch_deg=-90)
        first, second = (reference.render(own, pose, samples=256, seed=seed) / MILLIKELVIN for seed in (1, 2))
        means.append(0.5 * (first + second).mean())
        noises.append(np.std(first - second) / 2 / np.sqrt(first.size))
        stated.append(tr.Renderer(own, rays=64).frame(pose).budget_mk["bake"])
    assert abs(means[1] - means[0]) < 4.0 * np.hypot(*noises)
    # The walks start from other points, so that both differ by their noise.
    assert stated[1] == pytest.approx(stated[0], rel=0.2)
