"""Light on faces that a body covers in part, against closed forms."""

import drjit as dr
import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import write_mesh
from thermorender.physics.planck import brightness_temperature
from thermorender.render.geometry import Geometry
from thermorender.render.light import contacts, radiosity
from thermorender.render.variant import activate
from validation.totals import scenes


def geometry_of(*meshes):
    """The Geometry of trimesh objects, a surface each."""
    from validation.budget.scenes import level

    plain = level(1.0, np.zeros((1, 1), int), np.full((1, 1), 300.0))
    surfaces = []
    for mesh in meshes:
        values = {
            "vertices": np.asarray(mesh.vertices, float), "faces": np.asarray(mesh.faces, np.int32),
            "uv": np.full((len(mesh.faces), 3, 2), 0.5, np.float32),
        }  # fmt: skip
        surfaces.append(tr.scene.surface.replace(plain, **values))
    return Geometry(activate(), surfaces)


def ground(side=12, step=1.0, height=lambda x, y: 0.0 * x):
    """Level or hilly ground as a mesh of squares of `step`, around the origin."""
    place = step * (np.arange(side + 1) - 0.5 * side)
    x, y = np.meshgrid(place, place)
    number = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([b, d, c])])
    return trimesh.Trimesh(np.column_stack([x.ravel(), y.ravel(), height(x, y).ravel()]), faces, process=False)


def box(extents, at):
    """A closed box that stands at a place (x, y, z of its foot)."""
    mesh = trimesh.creation.box(extents=extents)
    mesh.apply_translation([at[0], at[1], at[2] + 0.5 * extents[2]])
    return mesh


def without(mesh, sides):
    """A mesh without the faces whose normals are `sides`."""
    kept = ~np.any([np.abs(mesh.face_normals - side).max(axis=1) < 1e-6 for side in sides], axis=0)
    mesh.update_faces(kept)
    return mesh


def solids(*meshes):
    """Share of the faces of each mesh that have something solid behind them."""
    geometry = geometry_of(*meshes)
    found = contacts.solid(geometry)
    return [float(found[slice(*geometry.face_start[k : k + 2])].mean()) for k in range(len(meshes))]


UP, DOWN, EAST = [0, 0, 1], [0, 0, -1], [1, 0, 0]


def test_bodies_and_the_ground_are_solid():
    hilly = ground(20, 1.0, lambda x, y: np.sin(x) * np.cos(y))
    assert solids(hilly, box([2, 2, 2], [0, 0, -0.5])) == [1.0, 1.0]


def test_house_without_a_floor_is_solid_on_ground_that_goes_on_below():
    assert solids(ground(), without(box([4, 4, 3], [0, 0, -0.5]), [DOWN])) == [1.0, 1.0]


def test_sheets_carports_and_walls_of_open_cavities_are_not_solid():
    sheet = without(box([4, 4, 1], [0, 0, 1.5]), [DOWN, EAST, [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    assert solids(ground(), sheet) == [1.0, 0.0]
    carport = without(box([4, 4, 2.5], [0, 0, 0]), [DOWN, EAST, [-1, 0, 0]])
    assert solids(ground(), carport)[1] == 0.0
    furnace = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    furnace.apply_translation([0, 0, 3])
    furnace.invert()
    assert solids(ground(), furnace) == [1.0, 0.0]


def test_one_part_alone_needs_no_search():
    assert contacts.solid(geometry_of(ground())) is None


def rays_of(geometry, rays=64):
    """(covered, origins (F, rays, 3)) of a geometry's rays."""
    face_rays, mi = radiosity.FaceRays(geometry, rays // 2), geometry.mi
    found = face_rays.start_in_the_open(contacts.solid(geometry), np.arange(geometry.face_count))
    origin, *_ = face_rays(dr.arange(mi.UInt32, geometry.face_count), 0)
    return found, np.array(origin).T.reshape(geometry.face_count, rays, 3)


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_rays_start_outside_of_bodies_and_above_the_ground(angle):
    body = box([3.3, 2.7, 2.0], [0.2, 0.1, -0.6])
    turned = trimesh.transformations.rotation_matrix(angle, UP)
    body.apply_transform(turned)
    cabin = box([1.4, 1.2, 1.0], [0.4, 0.2, 1.4])
    cabin.apply_transform(turned)
    body = body.subdivide().subdivide()
    geometry = geometry_of(ground(), body, cabin)
    covered, origin = rays_of(geometry)
    inside = [np.linalg.inv(turned)[:3, :3] @ origin.reshape(-1, 3).T][0].T.reshape(origin.shape)

    def within(low, high):
        return ((inside > np.array(low) + 1e-3) & (inside < np.array(high) - 1e-3)).all(axis=-1)

    hidden = within([-1.45, -1.25, -0.6], [1.85, 1.45, 1.4]) | within([-0.3, -0.4, 1.4], [1.1, 0.8, 2.4])
    hidden |= origin[..., 2] < -1e-3
    surface = np.searchsorted(geometry.face_start, np.arange(geometry.face_count), side="right") - 1
    # The underside has no open part, and nothing near it is seen.
    normal = np.stack(geometry.normals.at(dr.arange(geometry.mi.UInt32, geometry.face_count)), axis=-1)
    seen = ~((surface == 1) & (np.asarray(normal)[:, 2] < -0.5)) & ~(surface == 2)
    assert not hidden[seen].any()
    assert (covered.start != covered.faces).any() and (covered.start == covered.faces).sum() > 20


def test_open_part_keeps_an_even_spread():
    geometry = geometry_of(ground(2, 4.0), box([4.0, 9.0, 2.0], [3.0, 0.0, 0.0]))
    _, origin = rays_of(geometry, 512)
    # Squares at 0 … 4 are open up to 1 m.
    right = origin[np.flatnonzero((origin[..., 0].mean(axis=1) > 0.0) & (np.arange(len(origin)) < 8))]
    x = right[..., 0].ravel()
    assert len(right) == 4 and x.min() > 0.0 and x.max() < 1.0 + 4.0 / 8.0
    assert x.max() < 1.01 and abs(x.mean() - 0.5) < 0.08


def test_ground_beside_a_standing_wall_has_the_closed_form_light(tmp_path):
    for case in scenes.chosen()[:2]:
        scene = scenes.load(case, tmp_path / case.name)
        frame = tr.Renderer(scene).frame(case.view(scene))
        low, high, expected = case.strip
        x, y = np.moveaxis(frame.truth["position"][..., :2], -1, 0)
        number = frame.truth["object"]
        here = (number == 0) & (x > low) & (x < high) & (np.abs(y) < 6.0)
        epsilon = [float(frame.truth["emissivity"][place].mean()) for place in (here, number == 1)]
        found = brightness_temperature(float(frame.radiance[here].mean()), *scenes.BAND_UM)
        # The mean of the strip's pixels is over about 60 faces with independent errors; see the frame's own statement.
        assert abs(found - expected(*epsilon)) < 3.0 * 1e-3 * np.nanmean(frame.error_mk[here]) / np.sqrt(60), case.name


def test_sun_reaches_the_open_part_of_a_covered_face():
    geometry = geometry_of(ground(2, 4.0), box([4.0, 9.0, 2.0], [3.0, 0.0, 0.0]))
    transport = radiosity.trace(geometry, 64)
    rays_of, mi = radiosity.FaceRays(geometry, 8), geometry.mi
    rays_of.start_in_the_open(contacts.solid(geometry), transport.touching)
    origin, *_ = rays_of(mi.UInt32(np.arange(8, dtype=np.uint32)), 0)
    towards = mi.Vector3f(-0.6, 0.0, 0.8)
    lit = ~np.array(geometry.cast(mi.Ray3f(origin, towards)).valid).reshape(8, 16)
    assert lit.all()


def test_covered_ground_sees_no_inside(tmp_path):
    geometry = geometry_of(ground(), box([3.3, 2.7, 2.0], [0.2, 0.1, 0.0]))
    transport = radiosity.trace(geometry, 256)
    inside = transport.operator[: geometry.face_start[1]].tocoo()
    normal = np.asarray(np.stack(geometry.normals.at(dr.arange(geometry.mi.UInt32, geometry.face_count)), axis=-1))
    # Rays from the ground never meet a face of the roof or of the floor.
    assert not (np.abs(normal[inside.coords[1], 2]) > 0.5).any()
    np.testing.assert_allclose(
        np.asarray(transport.operator.sum(axis=1)).ravel() + transport.sky.sum(axis=1) + transport.background, 1.0,
        atol=1e-12,
    )  # fmt: skip


def test_terrain_with_objects_from_a_file_keeps_its_closed_cavity(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
    sphere.invert()
    scene = tr.load_scene(write_mesh(tmp_path / "s", sphere))
    assert not len(radiosity.trace(Geometry(activate(), scene.surfaces), 64).touching)


def test_copies_sunk_into_the_ground_start_their_rays_above_it(tmp_path):
    case = next(case for case in scenes.chosen() if "copies" in case.name)
    geometry = Geometry(activate(), scenes.load(case, tmp_path / "s").surfaces)
    transport = radiosity.trace(geometry, 64)
    rays_of, mi = radiosity.FaceRays(geometry, 32), geometry.mi
    found = rays_of.start_in_the_open(contacts.solid(geometry), transport.touching)
    copies = found.faces[found.faces >= geometry.face_start[1]]
    opened = np.array([len(np.unique(spots)) for spots in found.spots])[np.isin(found.faces, copies)] < contacts.SPOTS
    origin, *_ = rays_of(mi.UInt32(copies[opened]), 0)
    # Where posts stand side by side, a ray up may meet the next one.
    assert opened.sum() > 50 and (np.array(origin)[2] > 0.0).mean() > 0.995


def test_copies_of_a_sheet_are_not_solid(tmp_path):
    sheet = trimesh.Trimesh([[-2, -2, 2], [2, -2, 2], [2, 2, 2], [-2, 2, 2]], [[0, 1, 2], [0, 2, 3]], process=False)

    def with_sheets(folder):
        next(case for case in scenes.chosen() if "copies" in case.name).make(folder)
        sheet.export(folder / "sheet.ply")
        text = (folder / "scene.toml").read_text(encoding="utf-8").replace('shape = "box"', 'file = "sheet.ply"')
        text = "".join(line for line in text.splitlines(True) if not line.startswith("size"))
        (folder / "scene.toml").write_text(text, encoding="utf-8")
        return tr.load_scene(folder)

    geometry = Geometry(activate(), with_sheets(tmp_path / "s").surfaces)
    found = contacts.solid(geometry)
    assert found[: geometry.face_start[1]].all() and not found[geometry.face_start[1] :].any()
