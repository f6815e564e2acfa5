"""Finer triangles around objects: shapes and maps stay the same, and no light leaks from under the objects."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import scene_object, write_mesh, write_terrain
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.render import reference
from thermorender.scene import refine
from thermorender.scene.ground import Ground
from thermorender.scene.refine import evened
from thermorender.trajectory.path import pose

DISC = scene_object("plate", [2.0, 2.0, 0.1], [0.3, 0.2, 0.05], shape="disc", temperature=360.0)


def area(surface):
    corner = surface.vertices[surface.faces]
    return np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=-1) / 2


def test_refining_keeps_shapes_and_maps(tmp_path):
    height = np.random.default_rng(3).uniform(0, 0.4, (16, 16))
    plain = tr.load_scene(write_terrain(tmp_path / "a", height=height)).surfaces[0]
    scene = tr.load_scene(write_terrain(tmp_path / "b", height=height, extra=DISC))
    fine = scene.surfaces[0]
    assert len(fine.faces) > 1.5 * len(plain.faces)
    np.testing.assert_allclose(area(fine).sum(), area(plain).sum(), rtol=1e-9)
    corner = fine.vertices[fine.faces]
    assert (np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] > 0.0).all()
    # The map is the same function of position: affine here, so one fit must hold for the corners of all triangles.
    position, uv = fine.vertices[fine.faces].reshape(-1, 3)[:, :2], fine.uv.reshape(-1, 2)
    system = np.column_stack([position, np.ones(len(position))])
    solution, *_ = np.linalg.lstsq(system, uv, rcond=None)
    assert np.abs(system @ solution - uv).max() < 1e-5
    near = np.linalg.norm(fine.vertices[fine.faces].mean(axis=1)[:, :2] - [0.3, 0.2], axis=-1) < 1.0
    assert np.sqrt(2 * area(fine)[near].max()) < 2.0 / 16
    rng = np.random.default_rng(0)
    east, north = rng.uniform(-6, 6, (2, 200))
    np.testing.assert_allclose(Ground([fine])(east, north), Ground([plain])(east, north), atol=1e-9)


def test_many_small_objects_gain_few_triangles_and_a_large_one_beside_them_too(tmp_path):
    small = [scene_object(f"o{k}", [0.1, 0.1, 0.1], [k % 20 * 0.5 - 5, k // 20 * 0.5 - 4, 0.02], shape="disc")
             for k in range(300)]  # fmt: skip
    shed = scene_object("shed", [4.0, 3.0, 2.0], [0.0, 0.0, 0.0])
    plain = tr.load_scene(write_terrain(tmp_path / "plain", height=np.zeros((16, 16)))).surfaces[0]
    alone = tr.load_scene(write_terrain(tmp_path / "one", height=np.zeros((16, 16)), extra=shed))
    scene = tr.load_scene(write_terrain(tmp_path / "many", height=np.zeros((16, 16)), extra="\n".join([shed, *small])))
    discs = [surface for surface in scene.surfaces if surface.name.startswith("o")]
    assert len(discs) == 300
    # A sixteenth of a disc's width alone would make 1.2 million triangles on discs and a million beside them.
    assert sum(len(surface.faces) for surface in discs) < 100_000
    assert len(scene.surfaces[0].faces) < 150_000
    (beside,) = (surface for surface in scene.surfaces if surface.name == "shed:box")
    assert len(alone.surfaces[1].faces) <= len(beside.faces) < 20_000
    np.testing.assert_allclose(area(scene.surfaces[0]).sum(), area(plain).sum(), rtol=1e-9)


def test_ground_beside_many_small_objects_gains_at_most_the_stated_number_of_triangles(tmp_path, monkeypatch):
    small = [scene_object(f"o{k}", [0.05, 0.05, 0.05], [k % 10 - 5.0, k // 10 - 4.0, 0.02], shape="disc")
             for k in range(80)]  # fmt: skip
    plain = tr.load_scene(write_terrain(tmp_path / "plain", height=np.zeros((16, 16)))).surfaces[0]
    most = 4000
    monkeypatch.setattr(refine, "_MOST_BESIDE", most)
    scene = tr.load_scene(write_terrain(tmp_path / "many", height=np.zeros((16, 16)), extra="\n".join(small)))
    assert len(plain.faces) < len(scene.surfaces[0].faces) < len(plain.faces) + 1.1 * most
    np.testing.assert_allclose(area(scene.surfaces[0]).sum(), area(plain).sum(), rtol=1e-9)
    monkeypatch.setattr(refine, "_MOST_BESIDE", 1 << 30)
    free = tr.load_scene(write_terrain(tmp_path / "free", height=np.zeros((16, 16)), extra="\n".join(small)))
    assert len(free.surfaces[0].faces) > len(plain.faces) + 3 * most


def test_an_object_far_from_others_does_not_coarsen_the_ground_beside_them(tmp_path, monkeypatch):
    small = [scene_object(f"o{k}", [0.05, 0.05, 0.05], [k % 10 * 0.5 - 4.0, k // 10 * 0.5 - 4.0, 0.02], shape="disc")
             for k in range(80)]  # fmt: skip
    far = scene_object("far", [0.05, 0.05, 0.05], [29.0, 29.0, 0.02], shape="disc")
    monkeypatch.setattr(refine, "_MOST_BESIDE", 8000)
    few, more = (
        tr.load_scene(write_terrain(tmp_path / name, height=np.zeros((64, 64)), extra="\n".join(extra))).surfaces[0]
        for name, extra in (("few", small), ("more", [*small, far]))
    )
    assert len(few.faces) <= len(more.faces)


def shown(surface, up):
    """Triangles (n, 3 corners, 3) of a surface that face up by `up` at least."""
    corner = surface.vertices[surface.faces].astype(float)
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return corner[across[:, 2] > up * np.linalg.norm(across, axis=1)]


def longest(corner):
    return np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=-1).max(axis=1)


def test_a_body_is_cut_where_another_rises_before_it_and_not_beneath(tmp_path):
    """A block of 2 m on a slab of 8 m: the slab's top is fine at the block's foot, coarse away from it and under it."""
    slab = scene_object("slab", [8.0, 8.0, 0.5], [0.0, 0.0, 0.0])
    block = scene_object("block", [2.0, 2.0, 2.0], [0.0, 0.0, 0.5])
    scene = tr.load_scene(write_terrain(tmp_path / "a", height=np.zeros((32, 32)), extra="\n".join([slab, block])))
    below, above = scene.surfaces[1:]
    top = shown(below, 0.9)
    far = np.abs(top[..., :2]).max(axis=2) - 1.0  # of corners from the block's foot
    foot, away, under = (
        (far.min(axis=1) < 0.1) & (far.max(axis=1) > 0.01),
        far.min(axis=1) > 1.5,
        far.max(axis=1) < 0.01,
    )
    assert longest(top[foot]).max() <= 2.0 / 16 + 1e-6 and longest(top[away]).max() > 0.5
    # Light never reaches the middle under the block; only cuts from its rim go on there.
    middle = under & (np.abs(top[..., :2]).max(axis=(1, 2)) < 0.6)
    assert not middle.any() or longest(top[middle]).max() > 3.0 * 2.0 / 16
    # Nothing rises before the block's top: a quarter of its extent.
    roof = shown(above, 0.9)
    assert 0.25 < longest(roof).max() <= 0.5 and len(above.faces) < 1000
    # The block stands behind the slab's underside: a quarter of the slab's extent, but for cuts that meet the sides'.
    flat = below.vertices[below.faces].astype(float)
    under_slab = flat[np.ptp(flat[..., 2], axis=1) + flat[..., 2].max(axis=1) < flat[..., 2].min() + 0.01]
    assert np.median(longest(under_slab)) > 1.0
    # Cuts meet: every edge of the closed bodies has two triangles.
    for surface in (below, above):
        assert (edges_of(surface)[1] == 2).all()


def test_ground_beneath_a_sheet_in_the_air_is_cut(tmp_path):
    """A sheet is no body: what lies behind it is seen."""
    scene = tr.load_scene(write_terrain(tmp_path / "a", height=np.zeros((32, 32)), extra=DISC))
    ground = shown(scene.surfaces[0], 0.9)
    near = np.linalg.norm(ground.mean(axis=1)[:, :2] - [0.3, 0.2], axis=1) < 1.0
    assert near.sum() > 100 and longest(ground[near]).max() <= 2.0 / 16 + 1e-6


@pytest.mark.parametrize("at_once", [7, 1 << 20])
def test_heights_of_a_plane_are_found_a_part_at_a_time(tmp_path, monkeypatch, at_once):
    monkeypatch.setattr("thermorender.scene.ground._FACES_AT_ONCE", at_once)
    surface = tr.load_scene(write_terrain(tmp_path / "a")).surfaces[0]
    vertices = surface.vertices.copy()
    vertices[:, 2] = 0.3 * vertices[:, 0] - 0.2 * vertices[:, 1]
    ground = Ground([replace(surface, vertices=vertices)])
    east, north = np.random.default_rng(2).uniform(-3.0, 3.0, (2, 10, 50))
    east[0, 0] = 1e4
    found = ground(east, north)
    assert np.isnan(found[0, 0]) and ground(np.empty(0), np.empty(0)).shape == (0,)
    np.testing.assert_allclose(found.ravel()[1:], (0.3 * east - 0.2 * north).ravel()[1:], atol=1e-9)


def test_a_finely_cut_spot_leaves_few_bins_to_large_triangles(tmp_path):
    """Ten thousand triangles of 1 mm in a plane of two of 100 m, which would be in 10⁹ bins of their size."""
    corner = np.array([[0.0, 0, 0], [100, 0, 10], [0, 100, 0], [100, 0, 10], [100, 100, 10], [0, 100, 0]])
    step = np.stack(np.meshgrid(np.arange(100), np.arange(100)), axis=-1).reshape(-1, 1, 2) * 1e-3 + 120.0
    tiny = np.concatenate([step + 1e-3 * np.array([[0.0, 0], [1, 0], [0, 1]]), np.zeros((10_000, 3, 1))], axis=-1)
    vertices = np.concatenate([corner, tiny.reshape(-1, 3)])
    surface = tr.load_scene(write_terrain(tmp_path / "a")).surfaces[0]
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    ground = Ground([replace(surface, vertices=vertices, faces=faces)])
    assert ground(30.0, 20.0) == pytest.approx(3.0) and ground(120.0503, 120.0502) == pytest.approx(0.0)
    assert sum(len(bins._triangle) for bins in ground._bins) <= 8 * (2 + 10_000)


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


def edges_of(surface):
    """(End points of the edges (E, 2), number of triangles at each) of a surface."""
    _, place = np.unique(surface.vertices, axis=0, return_inverse=True)
    ends = np.sort(place.reshape(-1)[surface.faces][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(ends, axis=0, return_counts=True)


@pytest.mark.parametrize("textured", [False, True])
def test_the_largest_triangles_are_cut_along_shared_edges(tmp_path, textured):
    """A closed body of 12 triangles and one of many stay closed, also where corners are not shared."""
    surface = tr.load_scene(write_terrain(tmp_path / "a")).surfaces[0]
    for body in (trimesh.creation.box((40.0, 3.0, 8.0)), trimesh.creation.icosphere(subdivisions=4)):
        vertices = body.vertices.copy()
        vertices[vertices[:, 2] > 0.7] *= (1.0, 1.0, 4.0)
        vertices, faces = vertices.astype(np.float32), body.faces
        if textured:
            vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
        uv = np.random.default_rng(1).random((len(faces), 3, 2)).astype(np.float32)
        one = replace(surface, vertices=vertices, faces=faces.astype(np.int32), uv=uv)
        fine = evened(one)
        # Neighbours of a halved triangle are cut with it.
        more = len(fine.faces) - len(faces)
        assert 0.5 * max(1000, 0.2 * len(faces)) < more < 2.0 * max(1000, 0.2 * len(faces))
        assert (edges_of(fine)[1] == 2).all() and area(fine).max() < 0.5 * area(one).max()
        np.testing.assert_allclose(area(fine).sum(), area(one).sum(), rtol=1e-5)
        # Same winding as before.
        corner, old = fine.vertices[fine.faces], vertices[faces]
        volume = [np.linalg.det(each.astype(float)).sum() for each in (corner, old)]
        assert volume[0] == pytest.approx(volume[1], rel=1e-5) and volume[0] > 0.0


def test_equal_triangles_are_not_cut(tmp_path):
    surface = tr.load_scene(write_terrain(tmp_path, height=np.random.default_rng(0).normal(0, 0.2, (60, 60)))).surfaces[
        0
    ]
    assert evened(surface) is surface


def test_light_changes_up_a_wall_of_two_triangles(tmp_path):
    """Metal beside metal ground: four bands of the wall's height against path tracing."""
    y, height_m, ground_m = 30.0, 8.0, 12.0
    vertices = [[0, -y, 0], [ground_m, -y, 0], [ground_m, y, 0], [0, y, 0], [0, -y, height_m], [0, y, height_m]]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3], [0, 3, 5], [0, 5, 4]], process=False)
    scene = tr.load_scene(write_mesh(tmp_path, mesh, emissivity=0.3, sky=200.0))
    camera = replace(scene.camera, width=32, height=24, pixel_pitch_um=scene.camera.pixel_pitch_um * 20)
    scene = scene.with_camera(camera)
    view = pose(14.0, 0.0, 4.0, yaw_deg=270.0)
    found = tr.Renderer(scene, rays=512, samples=16).radiance(view)
    paths = np.array([reference.render(scene, view, samples=1024, depth=12, seed=seed) for seed in range(4)])
    height = 4.0 - 14.0 * camera.directions(np.stack([np.full(24, 16.0), np.arange(24) + 0.5], axis=-1))[:, 1]
    per_mk = 1e-3 * band_radiance_derivative(300.0, *camera.band_um)
    off = []
    for low in range(0, 8, 2):
        band = (height > low + 0.3) & (height < low + 1.7)
        means = paths[:, band].mean(axis=(1, 2))
        error_mk = means.std(ddof=1) / 2.0 / per_mk
        off.append((found[band].mean() - means.mean()) / per_mk)
        # Light is constant over triangles of 1 m: a tenth of the difference between neighbours.
        assert error_mk < 40.0 and abs(off[-1]) < 4.0 * error_mk + 60.0
    levels = [paths[:, (height > low) & (height < low + 2)].mean() / per_mk for low in (0, 6)]
    assert abs(levels[0] - levels[1]) > 3000.0
