"""Objects thinner than a pixel: they add their projected area to an image, from any distance."""

import numpy as np
import pytest
import trimesh
from support import slow

import thermorender as tr
from scenes import plane, scene_object, write_mesh
from thermorender.apps.compare.sampling_error import converged
from thermorender.materials.library import load_library
from thermorender.physics.band import emitted_radiance
from thermorender.physics.planck import band_radiance
from thermorender.render.pixels.slender import boxes, rectangles
from thermorender.scene.load import load_scene

BAND = (7.5, 13.5)
GROUND_K = 290.0


def item(size, kelvin, place=(0.0, 0.0), yaw=0.0, name="item"):
    return scene_object(name, size, [*place, 0.0], kelvin, yaw_deg=yaw)


def added(tmp_path, up, size, kelvin, **turned):
    """(increase of a nadir frame by an object, value of the object's projected area), in ground area times radiance."""
    side = 1.2 * up
    path = write_mesh(tmp_path / "s", plane(side), GROUND_K, 1.0, sky=0.0, extra=item(size, kelvin, **turned))
    scene = load_scene(path)
    pose = tr.pose(0, 0, up, pitch_deg=-90)
    image = tr.Renderer(scene, rays=1, edge_mk=1.0).radiance(pose).astype(np.float64)
    level = band_radiance(GROUND_K, *BAND)
    # Its top reflects a sky of 0 K.
    hot = emitted_radiance(load_library()["paint_black"].emissivity_at, kelvin, *BAND)
    # The top of the object hides ground that is further away.
    pixel = ((up - size[2]) / scene.camera.focal_length_px) ** 2
    # Outside this region rounding errors would add up.
    image = np.where(np.abs(image - level) > 1e-5 * level, image, level)
    return float((image - level).sum()) * pixel, size[0] * size[1] * (hot - level)


@pytest.mark.parametrize(
    ("up", "size", "kelvin", "turned"),
    [
        (500, (0.013, 0.013, 0.001), 1000.0, {"yaw": 10.0, "place": (3.3, 5.1)}),  # 4e-4 of a pixel
        (5000, (0.01, 0.01, 0.001), 1000.0, {"place": (171.3, -55.7)}),  # 2e-6 of a pixel
        (300, (0.04, 30.0, 0.01), 420.0, {"yaw": 33.0}),
        *slow((300, (0.04, 30.0, 0.01), 420.0, {"yaw": 90.0, "place": (0.07, 0.03)})),
        (1000, (1.8, 4.2, 0.05), 330.0, {"yaw": 70.0, "place": (20.0, 11.0)}),
    ],
)
def test_a_small_object_adds_its_projected_area(tmp_path, up, size, kelvin, turned):
    seen, expected = added(tmp_path, up, size, kelvin, **turned)
    # 64 rays over a rectangle give an error of 2 % of its area, also for turned squares and rods. A small object fills
    # two thirds of its rectangle, a rod crosses thirty pixels and more. Three standard errors.
    assert seen == pytest.approx(expected, rel=0.09 if max(size) < 1 else 0.03)


def test_boxes_enclose_connected_parts():
    one = trimesh.creation.box(extents=(4.0, 0.04, 0.5))
    one.apply_transform(trimesh.transformations.rotation_matrix(0.7, [0, 0, 1], [0, 0, 0]))
    other = trimesh.creation.cylinder(radius=0.1, height=3.0)
    other.apply_translation([10, 0, 0])

    class Surface:
        instances = None
        vertices = np.concatenate([one.vertices, other.vertices])
        faces = np.concatenate([one.faces, other.faces + len(one.vertices)])

    found = boxes([Surface])
    assert found.shape == (2, 8, 3)
    sides = np.sort([np.linalg.norm(box[[1, 2, 4]] - box[0], axis=1) for box in found], axis=1)
    np.testing.assert_allclose(sides[0], [0.04, 0.5, 4.0], atol=1e-9)
    np.testing.assert_allclose(sides[1], [0.2, 0.2, 3.0], rtol=0.02)
    assert boxes([]).shape == (0, 8, 3)


def test_rectangles_contain_all_pixels_that_a_band_covers():
    camera, random = load_scene("heath/survey").camera, np.random.default_rng(3)
    pose = tr.pose(0, 0, 400, pitch_deg=-90)
    for _ in range(20):
        rod = trimesh.creation.box(extents=(random.uniform(0.01, 20), 0.1, 0.05))
        rod.apply_transform(trimesh.transformations.random_rotation_matrix(random.random(3)))
        rod.apply_translation([*random.uniform(-100, 100, 2), 20])

        class Surface:
            instances = None
            vertices, faces = rod.vertices, rod.faces

        found = rectangles([(boxes([Surface]), np.eye(4))], pose, camera)
        points = trimesh.sample.sample_surface(rod, 4000, seed=1)[0]
        image = camera.project((points - pose[:3, 3]) @ pose[:3, :3])
        cell = np.floor(image)
        row = np.searchsorted(found.pixels, cell[:, 1] * camera.width + cell[:, 0])
        assert (found.pixels[row] == cell[:, 1] * camera.width + cell[:, 0]).all()
        inside = image - cell - found.corner[row]
        assert (inside > -1e-6).all() and (inside < found.size[row] + 1e-6).all()


@pytest.mark.slow
def test_posts_are_seen_from_afar(tmp_path):
    random = np.random.default_rng(0)
    extra = "".join(
        item((0.04, 0.04, 2.0), 420.0, tuple(random.uniform(-20, 20, 2)), name=f"post {k}") for k in range(40)
    )
    scene = load_scene(write_mesh(tmp_path / "s", plane(200.0), GROUND_K, 1.0, sky=GROUND_K, extra=extra))
    renderer = tr.Renderer(scene, rays=1)
    pose = tr.pose(0, -120, 120, pitch_deg=-45)
    frame = renderer.frame(pose)
    truth = converged(renderer, pose)
    once = tr.Renderer(scene, rays=1, edge_mk=np.inf).radiance(pose)
    true, lost = (
        float(np.sqrt((((image - truth) / renderer.plan.radiance_per_mk) ** 2).mean()))
        for image in (frame.radiance, once)
    )
    # The 256 rays of the reference, which do not know where posts are, have a sizeable part of that error.
    assert true < 0.1 * lost
    assert 0.5 * true < frame.budget_mk["sampling"] < 3 * true
