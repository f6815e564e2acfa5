"""The check of solved light by random walks, against closed forms and with light that is wrong on purpose."""

import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import coarse, write_mesh
from thermorender.physics.planck import band_radiance
from thermorender.render import reference
from thermorender.render.light import contacts
from thermorender.render.pixels import budget
from validation.totals import scenes

BAND = (7.5, 13.5)


def walked(renderer, point, face, normal, walks=1024):
    """(mean, standard error) of the band radiance that falls on a point [W m⁻² sr⁻¹]."""
    mi = renderer.baked.geometry.mi
    at = mi.Point3f(*(mi.Float([float(v)]) for v in point))
    light, _ = renderer.baked.walks.incident(at, mi.UInt32([face]), mi.Vector3f(*map(float, normal)), walks)
    return light.mean(), light.std() / np.sqrt(walks)


def test_closed_enclosure_of_one_temperature_is_black(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
    sphere.invert()
    renderer = tr.Renderer(coarse(tr.load_scene(write_mesh(tmp_path / "s", sphere, emissivity=0.3)), 8))
    middle, normal = sphere.triangles_center[0], sphere.face_normals[0]
    mean, error = walked(renderer, middle, 0, normal)
    # Each walk ends at ε B with probability ε at each surface: the mean number of surfaces is 1/ε.
    assert abs(mean - band_radiance(300.0, *BAND)) < 4.0 * error
    assert error < 0.05 * mean


def test_light_beside_a_wall_has_the_closed_form(tmp_path):
    scene = scenes.load(scenes.chosen()[2], tmp_path / "s")
    renderer = tr.Renderer(scene)
    share = 0.5 * (1.0 - 0.5 / np.hypot(0.5, 8.0))
    # At the middle of a wall 30 m long, the ends lack 0.1 % of it.
    point = np.array([-4.0, 0.0, 0.0])
    mean, error = walked(renderer, point, 0, [0.0, 0.0, 1.0], 4096)
    wall = float(scene.materials[1].band_emissivity(*BAND, 450.0))
    sky, hot = (band_radiance(t, *BAND) for t in (230.0, 450.0))
    assert abs(mean - (share * wall * hot + (1.0 - share) * sky)) < 4.0 * error + 0.01 * share * hot
    assert error < 0.02 * mean


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    return scenes.load(scenes.chosen()[1], tmp_path_factory.mktemp("wall") / "s")


def test_budget_states_a_bias_that_halves_of_the_rays_share(wall, monkeypatch, tmp_path):
    pose = scenes.chosen()[1].view(wall)
    good = tr.Renderer(wall)
    frame = good.frame(pose)
    # Rays that start inside of the wall: wrong in both halves alike.
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))
    monkeypatch.setattr(contacts, "covered", lambda *_: None)
    other = tr.Renderer(wall).frame(pose)
    bias = float(np.sqrt(np.mean((other.radiance - frame.radiance) ** 2)) / good.plan.radiance_per_mk)
    assert bias > 300.0
    assert other.budget_mk["bake"] > bias
    assert np.sqrt(np.nanmean(other.error_mk**2)) > bias
    monkeypatch.setattr(budget, "_unexplained", lambda *arguments: 0.0 * arguments[-1])
    assert tr.Renderer(wall).frame(pose).budget_mk["bake"] < bias


@pytest.mark.slow
def test_check_agrees_with_path_tracing_pixel_by_pixel(tmp_path):
    case = scenes.chosen()[7]
    scene = scenes.load(case, tmp_path / "s")
    pose, renderer = case.view(scene), tr.Renderer(scene)
    frame = renderer.frame(pose)
    view = frame._view
    numbers = np.arange(len(view.rays.order), dtype=np.uint32)
    one, two = budget._differences(view.baked, view.rays, view.baked.device.layers(pose, ())[0], numbers)
    walked = np.empty(frame.radiance.shape)
    walked.flat[view.rays.order] = 0.5 * (one + two)
    noise = 0.5 * float(np.std(one - two))
    truth = [reference.render(scene, pose, 256, 24, seed=seed) for seed in (1, 2)]
    body = frame.truth["object"] == 1
    traced = frame.radiance - 0.5 * (truth[0] + truth[1])
    error = np.hypot(noise, 0.5 * np.std((truth[0] - truth[1])[body])) / np.sqrt(body.sum())
    assert body.sum() > 50
    assert abs((walked - traced)[body].mean()) < 4.0 * error + 0.02 * np.sqrt(np.mean(traced[body] ** 2))
