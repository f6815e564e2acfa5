"""Light of faces split into texels and a constant per face: means are kept, for any map."""

import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import write_mesh, write_terrain
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.render.geometry import Geometry
from thermorender.render.light import texels
from thermorender.render.variant import activate


def geometry_of(scene):
    return Geometry(activate(), scene.surfaces)


def test_faces_of_one_texel_keep_their_own_light(tmp_path):
    """A long right-angled groove between level banks, all one texel: closed forms of both, through whole frames."""
    line = [(-3.0, 0.0), (-1.0, 0.0), (0.0, -1.0), (1.0, 0.0), (3.0, 0.0)]
    along = np.arange(-40.0, 41.0)
    vertices = [[x, y, z] for y in along for x, z in line]
    faces = []
    for row in range(len(along) - 1):
        for column in range(len(line) - 1):
            a, b = 5 * row + column, 5 * (row + 1) + column
            faces += [[a, a + 1, b + 1], [a, b + 1, b]]
    mesh, emissivity, rays = trimesh.Trimesh(vertices, faces, process=False), 0.5, 1024
    scene = tr.load_scene(write_mesh(tmp_path / "s", mesh, 300.0, emissivity, sky=250.0))
    frame = tr.Renderer(scene, rays=rays, tolerance_mk=0.5).frame(tr.pose(0, 0, 6, pitch_deg=-90))
    black, sky = (band_radiance(kelvin, 7.5, 13.5) for kelvin in (300.0, 250.0))
    # Two plates of one width that meet at an angle α see each other with a share of 1 − sin(α/2) (Howell, C-16).
    factor = 1.0 - np.sin(np.radians(45.0))
    received = (factor * emissivity * black + (1 - factor) * sky) / (1 - factor * (1 - emissivity))
    seen = frame.truth["position"]
    bank, groove = np.abs(seen[..., 0]) > 1.02, np.abs(seen[..., 0]) < 0.98
    per_kelvin = band_radiance_derivative(300.0, 7.5, 13.5)
    level = (frame.radiance[bank] - emissivity * black - (1 - emissivity) * sky) / per_kelvin
    walls = (frame.radiance[groove] - emissivity * black - (1 - emissivity) * received) / per_kelvin
    # Level banks see only sky: only single precision and tables have errors. The error of a face of the groove is that
    # of its rays; the picture shows at least three metres of it, which are twelve faces.
    error = (1 - emissivity) * (received - sky) / factor * np.sqrt(factor * (1 - factor) / rays) / per_kelvin
    assert np.abs(level).max() < 1e-3
    assert abs(walls.mean()) < 3.0 * error / np.sqrt(12.0) < 0.15
    # Light averaged over all faces of the texel would be off by several kelvin.
    assert (1 - emissivity) * (received - sky) / per_kelvin > 2.0


def test_each_texel_knows_the_face_that_covers_it(tmp_path):
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=np.random.default_rng(1).uniform(0, 2, (9, 12))))
    (surface,) = scene.surfaces
    rows, columns = surface.material.shape
    face = np.array(geometry_of(scene).face_of_texel).reshape(rows, columns)
    row, column = np.mgrid[:rows, :columns]
    place = np.stack([column + 0.5, row + 0.5], axis=-1)
    covered = face < len(surface.faces)
    corner = surface.uv[face[covered]] * [columns, rows]
    edge = corner[:, 1:] - corner[:, :1]
    share = np.linalg.solve(edge.transpose(0, 2, 1), (place[covered] - corner[:, 0])[..., None])[..., 0]
    assert share.min() > -1e-3 and share.sum(axis=1).max() < 1 + 1e-3
    # The elevation's cell centres span all but half a cell all round: 11/12 · 8/9 of the area. Texel centres are at a
    # quarter and three quarters of a cell, so each is plainly inside or outside.
    assert covered.sum() == 22 * 16


@pytest.mark.slow
def test_the_mean_of_each_face_is_kept(tmp_path):
    # Steep faces: a texel is on one of them and is seen on several.
    random = np.random.default_rng(3)
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=random.uniform(0, 6, (20, 20))))
    geometry = geometry_of(scene)
    (surface,) = scene.surfaces
    material = random.integers(0, 3, surface.material.size).astype(np.uint8)
    emitted = random.uniform(30, 50, material.size).astype(np.float32)
    light = random.uniform(1, 5, (geometry.face_count + 1, 3)).astype(np.float32)
    texel, face, left = texels.bake_channel(geometry, geometry.face_of_texel, emitted, material, light)
    rows, columns = surface.material.shape
    weight = random.dirichlet([1, 1, 1], size=(4000, geometry.face_count))
    place = np.einsum("pfk,fkc->pfc", weight, surface.uv * [columns, rows]) - 0.5
    low = np.floor(place).astype(int)
    part = place - low
    shown = wanted = 0.0
    for right in (0, 1):
        for down in (0, 1):
            share = np.abs(1 - right - part[..., 0]) * np.abs(1 - down - part[..., 1])
            j, i = np.clip(low[..., 0] + right, 0, columns - 1), np.clip(low[..., 1] + down, 0, rows - 1)
            number = i * columns + j
            shown = shown + share * texel[number]
            wanted = wanted + share * (emitted[number] + light[np.arange(geometry.face_count), material[number]])
    difference = shown + face - wanted
    # The constant is a mean over some ten places: its error is at most the scatter over the root of their number.
    assert np.sqrt((difference.mean(axis=0) ** 2).mean()) < 0.5 * np.sqrt(left).mean()
    assert np.sqrt(left).mean() == pytest.approx(difference.std(axis=0).mean(), rel=0.3)
    assert np.sqrt((face**2).mean()) > 2 * np.sqrt((difference.mean(axis=0) ** 2).mean())


def test_an_object_of_one_texel_keeps_the_light_of_each_face(tmp_path):
    scene = tr.load_scene(write_mesh(tmp_path / "s", trimesh.creation.icosphere(subdivisions=2), 300.0, 0.8))
    geometry = geometry_of(scene)
    light = np.random.default_rng(0).uniform(1, 5, (geometry.face_count + 1, 1)).astype(np.float32)
    texel, face, left = texels.bake_channel(geometry, geometry.face_of_texel, np.float32([7.0]), np.uint8([0]), light)
    # The only texel has the mean.
    np.testing.assert_allclose(texel[0] + face, 7.0 + light[:-1, 0], rtol=1e-6)
    assert texel[0] == np.float32(7.0) + light[-1, 0]
    np.testing.assert_allclose(left, 0.0, atol=1e-10)


def test_light_that_varies_over_faces(tmp_path):
    # A plane of equilateral triangles under light with a gradient: the scatter inside them is known.
    step, count = 0.5, 24
    up = step * np.sqrt(3) / 2
    vertices = [[(i + 0.5 * (j % 2)) * step, j * up, 0.0] for j in range(count) for i in range(count)]
    faces = []
    for j in range(count - 1):
        for i in range(count - 1):
            a, b, c, d = (p * count + q for p, q in ((j, i), (j, i + 1), (j + 1, i), (j + 1, i + 1)))
            faces += [[a, b, c], [b, d, c]] if j % 2 == 0 else [[a, b, d], [a, d, c]]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    geometry = geometry_of(tr.load_scene(write_mesh(tmp_path / "s", mesh)))
    (surface,) = geometry.surfaces
    middle = surface.vertices[surface.faces].mean(axis=1)
    random = np.random.default_rng(0)
    sigma = 0.4
    light = 3.0 * middle[:, 0] + sigma * random.normal(size=len(middle))
    found = texels.variation(geometry, light, np.full(len(middle), sigma))
    assert found == pytest.approx(3.0 * step / np.sqrt(24.0), rel=0.15)
