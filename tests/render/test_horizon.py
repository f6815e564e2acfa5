"""Pixels that the horizon crosses, faces smaller than a pixel in uneven light, and the budget of the whole image."""

import numpy as np
import pytest
from support import slow

import thermorender as tr
from scenes import narrow, scene_object, write_terrain
from thermorender.apps.compare.sampling_error import converged
from thermorender.physics.planck import band_radiance

BAND = 7.5, 13.5


def shares(pose, camera, finer=32):
    """The share of each pixel above a level horizon, (H, W), from `finer`² points."""
    at = (np.arange(finer) + 0.5) / finer
    found = np.empty((camera.height, camera.width))
    for row in range(camera.height):
        column, down, right = np.meshgrid(np.arange(camera.width), at, at, indexing="ij")
        slope = camera.directions(np.stack([column + right, row + down], axis=-1))
        up = slope @ pose[2, :2] + pose[2, 2]
        found[row] = (up >= 0.0).mean(axis=(1, 2))
    return found


@pytest.mark.parametrize("quality", ["standard", *slow("high")])
@pytest.mark.parametrize("roll_deg", [0.0, 33.0])
def test_a_pixel_on_the_horizon_has_its_share_of_sky(tmp_path, quality, roll_deg):
    extra = "[surroundings]\ntemperature = 295.0\n"
    scene = narrow(tr.load_scene(write_terrain(tmp_path / "s", height=np.zeros((8, 8)), extra=extra)))
    # Looks away from the terrain.
    pose = tr.pose(0, 500, 80, pitch_deg=0.31, roll_deg=roll_deg)
    renderer = tr.Renderer(scene, quality=quality, rays=1)
    image = renderer.radiance(pose)
    sky, around = band_radiance(np.array([scene.sky_temperature, 295.0]), *BAND)
    share = shares(pose, scene.camera)
    assert ((share > 0.0) & (share < 1.0)).sum() > 0.9 * scene.camera.width
    found = (image - around) / (sky - around)
    # Points err by up to a row of them, and by their count where the horizon is inclined.
    assert np.abs(found - share).max() < (0.04 if roll_deg == 0.0 else 0.02)
    whole = (share == 0.0) | (share == 1.0)
    assert np.abs(found - share)[whole].max() < 0.01


@pytest.mark.parametrize("air", [None, "midlatitude-summer"])
def test_budget_of_the_image_covers_the_horizon(tmp_path, air):
    random = np.random.default_rng(3)
    extra = "[surroundings]\ntemperature = 310.0\n"
    warm = random.uniform(290, 300, (64, 64))
    scene = narrow(
        tr.load_scene(write_terrain(tmp_path / "s", random.uniform(0, 2, (32, 32)), temperature=warm, extra=extra))
    )
    scene = scene if air is None else scene.with_air(air, "rural-23km")
    renderer, pose = tr.Renderer(scene, rays=8), tr.pose(0, -40, 3.5, pitch_deg=-3, roll_deg=3)
    frame = renderer.frame(pose)
    shown = np.isfinite(frame.error_mk)
    assert 0.02 < shown.mean() < 0.9
    error = (frame.radiance - converged(renderer, pose)) / renderer.plan.radiance_per_mk
    behind, everywhere = (float(np.sqrt((part**2).mean())) for part in (error[~shown], error))
    budget = frame.budget_mk
    assert behind < 0.5 * everywhere < everywhere < budget["image"]
    # Sampling alone: the other parts are in the figure of the image in proportion to the pixels with a surface.
    others = (budget["total"] ** 2 - budget["sampling"] ** 2) * shown.mean()
    assert np.sqrt(budget["image"] ** 2 - others) < 3.0 * everywhere


def test_budget_of_a_full_image_is_the_total(tmp_path):
    scene = narrow(tr.load_scene(write_terrain(tmp_path / "s", height=np.zeros((32, 32)))))
    budget = tr.Renderer(scene, rays=8).frame(tr.pose(0, 0, 10, pitch_deg=-90)).budget_mk
    assert budget["image"] == pytest.approx(budget["total"], rel=1e-6)


def test_faces_in_uneven_light_are_averaged(tmp_path):
    """A metal box beside a hot wall, whose faces are smaller than a pixel and know the wall from few rays each."""
    extra = scene_object("box", [8, 8, 1], [0, 0, 0.5], 300.0, "paint_metallic")
    extra += scene_object("wall", [0.4, 12, 4], [6, 0, 2], 900.0)
    scene = narrow(tr.load_scene(write_terrain(tmp_path / "s", height=np.zeros((32, 32)), extra=extra)))
    renderer, pose = tr.Renderer(scene, rays=64), tr.pose(0, 0, 600, pitch_deg=-90)
    frame = renderer.frame(pose)
    error = (frame.radiance - converged(renderer, pose)) / renderer.plan.radiance_per_mk
    own, names = renderer.objects_seen(pose)
    inside = own == names.index("box")
    for axis in (0, 1):
        inside &= np.roll(inside, 1, axis) & np.roll(inside, -1, axis)
    # One face for each pixel erred by 11 K.
    assert inside.sum() > 50 and np.sqrt((error[inside] ** 2).mean()) < 3000.0
    assert np.sqrt((error**2).mean()) < frame.budget_mk["sampling"]
