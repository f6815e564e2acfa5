"""A pixel's footprint on the texture: means over squares of texels, and frames from any distance and slant."""

import numpy as np
import pytest
from support import slow

import thermorender as tr
from scenes import narrow, scene_object, write_terrain
from thermorender.apps.compare.sampling_error import converged
from thermorender.render.pixels.pyramid import sizes, squares


def test_squares_are_means_of_texels():
    random = np.random.default_rng(0)
    image = random.uniform(1, 9, (16, 32, 2)).astype(np.float32)
    for level, found in enumerate(squares(image), start=1):
        side = 2**level
        if side <= 16:
            want = image.reshape(16 // side, side, 32 // side, side, 2).mean(axis=(1, 3))
            np.testing.assert_allclose(found, want, rtol=1e-6)
    assert found.shape == (1, 1, 2)
    assert [part.shape[:2] for part in squares(image[:5, :3])] == sizes(5, 3)[1:] == [(3, 2), (2, 1), (1, 1)]


def test_squares_ignore_uncovered_texels():
    random = np.random.default_rng(1)
    image = random.uniform(1, 9, (8, 8, 1)).astype(np.float32)
    covered = np.arange(64).reshape(8, 8) % 3 > 0
    covered[:2, :2] = False
    spoiled = np.where(covered[..., None], image, np.float32(1e3))
    spoiled[:2, :2] = 5.0
    first, *_, last = squares(spoiled, covered)
    # An uncovered texel has a weight of 1e-6, and 1e3 is a hundred times the other values.
    assert first[0, 0, 0] == pytest.approx(5.0)
    np.testing.assert_allclose(first[1, 1, 0], image[2:4, 2:4, 0][covered[2:4, 2:4]].mean(), rtol=1e-3)
    np.testing.assert_allclose(last[0, 0, 0], image[..., 0][covered].mean(), rtol=1e-3)


def averaged(texels, on_map, pose, camera, pixels, finer=16):
    """Mean over pixels (n, 2), (column, row), of texels on level ground at 0 m, linear between their centres.

    Plain arithmetic; `on_map` (2, 3) maps (east, north, 1) to (column, row) on the texels' map.
    """
    offset = np.stack(np.meshgrid(*[(np.arange(finer) + 0.5) / finer] * 2), axis=-1).reshape(-1, 2)
    slopes = camera.directions((pixels[:, None] + offset).reshape(-1, 2))
    directions = np.column_stack([slopes, np.ones(len(slopes))]) @ pose[:3, :3].T
    ground = pose[:2, 3] - directions[:, :2] * (pose[2, 3] / directions[:, 2:])
    place = ground @ on_map[:, :2].T + on_map[:, 2] - 0.5
    corner = np.floor(place).astype(int)
    share = place - corner
    values = np.zeros(len(place))
    for down in (0, 1):
        for right in (0, 1):
            i, j = (np.clip(corner[:, axis] + step, 0, len(texels) - 1) for axis, step in ((1, down), (0, right)))
            values += np.abs(1 - down - share[:, 1]) * np.abs(1 - right - share[:, 0]) * texels[i, j]
    inside = ((place > 2) & (place < len(texels) - 3)).all(axis=-1)
    return values.reshape(-1, finer**2).mean(axis=1), inside.reshape(-1, finer**2).all(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(("up", "pitch_deg"), [(800, -45), *slow((150, -90), (800, -90), (5000, -90), (1500, -30))])
def test_pixel_is_the_mean_of_its_texels(tmp_path, up, pitch_deg):
    # 1024² independent texels of 0.5 m; a pixel's side is 0.4 to 13 of them.
    random = np.random.default_rng(2)
    flat, warm = np.zeros((512, 512)), random.uniform(280, 320, (1024, 1024))
    scene = narrow(tr.load_scene(write_terrain(tmp_path / "s", flat, warm, np.ones_like(warm))))
    surface, north = scene.surfaces[0], 0.0 if pitch_deg == -90 else -up / np.tan(np.radians(-pitch_deg))
    corner = surface.vertices[surface.faces].reshape(-1, 3)
    known = np.column_stack([corner[:, :2], np.ones(len(corner))])
    on_map = np.linalg.lstsq(known, surface.uv.reshape(-1, 2) * 1024.0, rcond=None)[0].T
    renderer, pose = tr.Renderer(scene, rays=1, edge_mk=np.inf), tr.pose(0, north, up, pitch_deg=pitch_deg)
    radiance = renderer.baked.texels[0].reshape(1024, 1024).astype(np.float64)
    image = renderer.radiance(pose)
    shown = np.argwhere(renderer.texels(pose) >= 0)[:, ::-1]
    pixels = shown[random.choice(len(shown), 3000)]
    want, inside = averaged(radiance, on_map, pose, scene.camera, pixels)
    assert inside.sum() > 1000
    found, spread = (image[pixels[:, 1], pixels[:, 0]] - want)[inside], radiance.std()
    # Sixteen samples that read n of a pixel's N independent texels have an error of σ √(1/n − 1/N). The squares have at
    # least 0.35 of a sample's share per side; interpolation between their centres makes them half as large again.
    pixel = up / scene.camera.focal_length_px / 0.5 / np.sin(np.radians(-pitch_deg)) ** 1.5
    texels = 16 * max(1.5 * 0.35 * pixel / 4, 1.5) ** 2
    limit = spread * np.sqrt(max(1.0 / texels - 1.0 / pixel**2, 2e-3))
    assert found.std() < limit
    assert abs(found.mean()) < 4 * found.std() / np.sqrt(inside.sum()) + 1e-4 * spread


@pytest.mark.parametrize(("up", "pitch_deg"), [(900, -40), *slow((60, -90), (900, -90), (6000, -90))])
def test_budget_covers_the_sampling_error_from_any_height(tmp_path, up, pitch_deg):
    random = np.random.default_rng(4)
    height, warm = random.uniform(0, 1.5, (256, 256)), random.uniform(270, 330, (512, 512))
    extra = scene_object("box", [12, 7, 9], [1, 2, 0], yaw_deg=20, temperature=360.0)
    scene = narrow(tr.load_scene(write_terrain(tmp_path / "s", height=height, temperature=warm, extra=extra)))
    renderer = tr.Renderer(scene, rays=8)
    pose = tr.pose(0, 0 if pitch_deg == -90 else -up / np.tan(np.radians(-pitch_deg)), up, pitch_deg=pitch_deg)
    frame = renderer.frame(pose)
    shown = np.isfinite(frame.truth["depth"])
    error = (frame.radiance - converged(renderer, pose))[shown] / renderer.plan.radiance_per_mk
    true = float(np.sqrt((error**2).mean()))
    assert true < frame.budget_mk["sampling"] < 3 * true


@pytest.mark.slow
def test_budget_covers_correlated_footprint_errors(tmp_path):
    """Slopes that face the camera are warm and hide cold ones, which distant footprints reach into."""
    row = np.arange(256)
    height = np.broadcast_to(2.0 * (row % 2)[:, None], (256, 256))
    # Texels half a post wide: two warm rows, two cold ones.
    warm = np.broadcast_to(np.where(np.arange(512) // 2 % 2 == 0, 320.0, 280.0)[:, None], (512, 512))
    scene = narrow(tr.load_scene(write_terrain(tmp_path / "s", height=height, temperature=warm)))
    renderer, up = tr.Renderer(scene, rays=8), 4000.0
    for yaw_deg in (0.0, 180.0):
        away = up / np.tan(np.radians(30.0)) * (-1.0 if yaw_deg == 0.0 else 1.0)
        pose = tr.pose(0, away, up, yaw_deg=yaw_deg, pitch_deg=-30.0)
        frame = renderer.frame(pose)
        shown = np.isfinite(frame.error_mk)
        error = (frame.radiance - converged(renderer, pose))[shown] / renderer.plan.radiance_per_mk
        true = float(np.sqrt((error**2).mean()))
        assert shown.sum() > 200
        assert abs(error.mean()) > 0.3 * true and true < frame.budget_mk["sampling"] < 3 * true
