"""Finer triangles beside objects: the same shapes and maps, and light that no longer leaks from under them."""

import numpy as np

import thermorender as tr
from scenes import write_terrain
from thermorender.physics.planck import band_radiance
from thermorender.scene.refine import _lattice

DISC = """
[[object]]
name = "plate"
shape = "disc"
size = [2.0, 2.0, 0.1]
position = [0.3, 0.2, 0.05]
temperature = 360.0
material = "paint_black"
"""


def area(surface):
    corner = surface.vertices[surface.faces]
    return np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=-1) / 2


def test_lattice_covers_the_triangle_once():
    for n in (1, 2, 5):
        weights = _lattice(n)
        assert weights.shape == (n * n, 3, 3)
        np.testing.assert_allclose(weights.sum(axis=-1), 1.0)
        # Equal areas that add up, all wound as the whole one.
        flat = weights[..., 1:]
        signed = np.linalg.det(np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=1))
        np.testing.assert_allclose(signed, 1.0 / n**2)


def test_shapes_and_maps_stay(tmp_path):
    height = np.random.default_rng(3).uniform(0, 0.4, (16, 16))
    plain = tr.load_scene(write_terrain(tmp_path / "a", height=height)).surfaces[0]
    scene = tr.load_scene(write_terrain(tmp_path / "b", height=height, extra=DISC))
    fine = scene.surfaces[0]
    assert len(fine.faces) > 1.5 * len(plain.faces)
    np.testing.assert_allclose(area(fine).sum(), area(plain).sum(), rtol=1e-9)
    # The map is the same function of position: here affine, so one fit must hold for the corners of all triangles.
    position, uv = fine.vertices[fine.faces].reshape(-1, 3)[:, :2], fine.uv.reshape(-1, 2)
    system = np.column_stack([position, np.ones(len(position))])
    solution, *_ = np.linalg.lstsq(system, uv, rcond=None)
    assert np.abs(system @ solution - uv).max() < 1e-5
    near = np.linalg.norm(fine.vertices[fine.faces].mean(axis=1)[:, :2] - [0.3, 0.2], axis=-1) < 1.0
    assert np.sqrt(2 * area(fine)[near].max()) < 2.0 / 16
    rng = np.random.default_rng(0)
    east, north = rng.uniform(-6, 6, (2, 200))
    from thermorender.scene.ground import Ground

    np.testing.assert_allclose(Ground([fine])(east, north), Ground([plain])(east, north), atol=1e-9)


def test_heat_stays_under_the_plate(tmp_path):
    temperature, classes = np.full((64, 64), 290.0), np.full((64, 64), 2)
    scene = tr.load_scene(
        write_terrain(tmp_path / "s", height=np.zeros((32, 32)), temperature=temperature, classes=classes, extra=DISC)
    )
    frame = tr.Renderer(scene, rays=256, quality="high").frame(tr.pose(0.3, 0.2, 8, pitch_deg=-90))
    row, column = np.mgrid[:512, :640] - np.array([255.5, 319.5])[:, None, None]
    rim = 1.0 / (8.0 - 0.07) * scene.camera.focal_length_px
    distance = np.hypot(row, column) / rim
    beside = frame.radiance[(distance > 1.35) & (distance < 1.5)].mean()
    far = frame.radiance[distance > 2.4].mean()
    # 0.35 m outside the rim of a half-plane 7 cm above the ground, the view factor to its underside is
    # (1 − a/√(a² + h²))/2; a round plate fills less. Quartz sand reflects 6.5 % of that.
    share = 0.5 * (1.0 - 0.35 / np.hypot(0.35, 0.07))
    assert 0.0 <= beside - far < share * 0.065 * band_radiance(360.0, 7.5, 13.5)
