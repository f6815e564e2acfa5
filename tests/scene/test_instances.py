"""Copies of a body as patches: hits, areas, light and files, against the same triangles as ordinary faces."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from copies_support import write_crown

import thermorender as tr
from scenes import coarse, scene_object, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.render.geometry import Geometry
from thermorender.render.light import radiosity, transport_cache
from thermorender.render.pixels import budget
from thermorender.render.plan import make_plan
from thermorender.render.variant import activate
from thermorender.scene import instances
from thermorender.scene.instances import alone, expanded, placed

PLACES = "east_m,north_m,above_ground_m,yaw_deg,scale\n-3,2,0,0,1\n3,1.5,0.2,70,0.7\n0,-3,0,200,1.3\n2,-2.5,0,-35,1\n"


def write_copies(folder, places=PLACES, extra="", material="broadleaf", kelvin=290.0, **terrain):
    """Write a flat scene with four porous crowns and return its folder."""
    folder.mkdir(parents=True)
    write_crown(folder, 500, 0.4)
    (folder / "places.csv").write_text(places, encoding="utf-8")
    trees = scene_object("trees", temperature=kelvin, material=material, file="crown.ply", instances="places.csv")
    return write_terrain(folder, extra=trees + extra, **terrain)


def apart(scene):
    """The scene with its copies as ordinary triangles."""
    return scene.with_surfaces([expanded(surface) for surface in scene.surfaces])


def test_rays_meet_the_same_triangles_as_ordinary_faces(tmp_path):
    scene = tr.load_scene(write_copies(tmp_path / "s", extra="colour = [90.0, 120.0, 60.0]"))
    mi = activate()
    geometries = [Geometry(mi, each.surfaces) for each in (scene, apart(scene))]
    random = np.random.default_rng(1)
    start = np.column_stack([random.uniform(-4.0, 4.0, (4000, 2)), np.full(4000, 9.0)])
    towards = np.column_stack([random.uniform(-0.6, 0.6, (4000, 2)), np.full(4000, -1.0)])
    ray = mi.Ray3f(mi.Point3f(*map(mi.Float, start.T)), dr.normalize(mi.Vector3f(*map(mi.Float, towards.T))))
    copies, single = (each.cast(ray) for each in geometries)
    assert (np.array(copies.surface) == 1).mean() > 0.1
    np.testing.assert_array_equal(np.array(copies.surface), np.array(single.surface))
    met = np.array(single.valid)
    np.testing.assert_allclose(np.array(copies.distance)[met], np.array(single.distance)[met], atol=1e-4)
    # The face of a copy is the patch, whose texel the ordinary triangle has too.
    texels = []
    for geometry, hit in zip(geometries, (copies, single), strict=True):
        place = geometry.map_position(geometry.record(hit.face), ray.o + hit.distance * ray.d)
        texels.append(np.array(geometry.nearest(hit.surface, *place))[np.array(hit.surface) == 1])
    assert len(np.unique(texels[0])) > 15
    np.testing.assert_array_equal(*texels)


def test_patches_have_the_area_and_the_heights_of_their_triangles(tmp_path):
    scene = tr.load_scene(write_copies(tmp_path / "s"))
    mi, trees = activate(), scene.surfaces[1]
    one, other = (Geometry(mi, [each]) for each in (trees, expanded(trees)))
    assert one.face_count == 4 * trees.instances.patches == 48
    assert one.area.sum() == pytest.approx(other.area.sum(), rel=1e-6)
    heights = [surface.vertices[:, 2] for surface in (trees, expanded(trees))]
    assert [h.min() for h in heights] == pytest.approx([heights[0].min()] * 2)
    assert [h.max() for h in heights] == pytest.approx([heights[0].max()] * 2)


def test_frame_is_that_of_ordinary_triangles_within_the_stated_error(tmp_path):
    scene = tr.load_scene(write_copies(tmp_path / "s", sky=230.0))
    # The same rays in both, so that only the light differs.
    same = {"rays": 256, "samples": 16, "edge_mk": np.inf}
    copies, single = (tr.Renderer(coarse(each, 8), "fast", **same) for each in (scene, apart(scene)))
    pose = tr.pose(0.0, -14.0, 14.0, look_at=(0.0, 0.0, 1.5))
    frame, other = copies.frame(pose), single.frame(pose)
    np.testing.assert_array_equal(frame.truth["object"], other.truth["object"])
    trees = frame.truth["object"] == 1
    assert 100 < trees.sum() < trees.size // 2
    difference = 1e3 * (frame.apparent_temperature - other.apparent_temperature)
    first = copies.baked.geometry.face_start[1]
    shown = copies.baked.face_error[first:].reshape(4, -1)
    # From above, the triangles that face up are seen most, and the upper ones.
    stated = np.sqrt(shown[:, 7::2].mean()) / copies.baked.plan.radiance_per_mk
    assert abs(difference[trees].mean()) < 0.2 * stated
    assert np.sqrt((difference[trees] ** 2).mean()) < stated
    assert abs(difference[~trees].mean()) < 10.0
    assert copies.baked.errors_mk["faces"] > 5.0 * single.baked.errors_mk["faces"]
    assert not (frame.truth["mask"][trees] & tr.scene.surface.BEHIND).any()
    again = tr.Renderer(coarse(tr.load_scene(tmp_path / "s"), 8), "fast", **same).frame(pose)
    np.testing.assert_array_equal(again.radiance, frame.radiance)


def test_copies_in_an_isothermal_enclosure_are_a_blackbody(tmp_path):
    warm = np.full((32, 32), 290.0)
    scene = tr.load_scene(write_copies(tmp_path / "s", temperature=warm, sky=290.0))
    frame = tr.Renderer(coarse(scene, 8), "fast").frame(tr.pose(0.0, 0.0, 20.0, pitch_deg=-90.0))
    trees = frame.truth["object"] == 1
    assert trees.sum() > 100
    np.testing.assert_allclose(frame.apparent_temperature[trees], 290.0, atol=0.01)


def test_place_and_heading_of_the_object_move_all_copies(tmp_path):
    scene = tr.load_scene(write_copies(tmp_path / "s"))
    moved = scene.with_objects({"trees": {"east_m": 1.0, "above_ground_m": 0.5}})
    step = moved.surfaces[1].instances.position - scene.surfaces[1].instances.position
    np.testing.assert_allclose(step, np.tile([1.0, 0.0, 0.5], (4, 1)), atol=1e-6)
    with pytest.raises(ThermorenderError, match=r"other .* in surface 'trees:crown"):
        tr.Renderer(scene, "fast").baked.solved_for(moved)


def test_patches_have_the_colours_of_their_parts_of_the_texture(tmp_path):
    trees = tr.load_scene(write_copies(tmp_path / "s")).surfaces[1]
    body = alone(trees)
    corner = body.vertices[body.faces]
    up = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] > 0.0
    uv = np.where(up, 0.25, 0.75)[:, None, None] * np.ones((1, 3, 2), np.float32)
    colour = np.zeros((2, 2, 3), np.uint8)
    colour[0, 0], colour[1, 1] = (200, 40, 40), (20, 120, 20)
    place = {name: getattr(trees.instances, name) for name in ("position", "yaw_deg", "scale")}
    made = placed(replace(body, uv=uv.astype(np.float32), colour=colour), place)
    own = made.colour.reshape(-1, 3)[: len(made.faces)].reshape(4, 12, 3)
    np.testing.assert_array_equal(own[:, ::2], np.broadcast_to(colour[1, 1], (4, 6, 3)))
    np.testing.assert_array_equal(own[:, 1::2], np.broadcast_to(colour[0, 0], (4, 6, 3)))


def test_body_alone_is_traced_once(tmp_path, monkeypatch):
    traced, openness = [], radiosity.openness
    monkeypatch.setattr(radiosity, "openness", lambda geometry: traced.append(geometry) or openness(geometry))
    assert tr.Renderer(coarse(tr.load_scene(write_copies(tmp_path / "s")), 8), "fast").baked.face_error is not None
    assert len(traced) == 1


def test_pixels_of_copies_get_rays_until_their_light_errs_more(tmp_path):
    scene = coarse(tr.load_scene(write_copies(tmp_path / "s", sky=230.0)), 4)
    renderer, pose = tr.Renderer(scene, rays=64), tr.pose(0.0, -14.0, 14.0, look_at=(0.0, 0.0, 1.5))
    view = renderer._view(pose)
    radiance, sampling = view.radiance()
    per_mk, copies = renderer.plan.radiance_per_mk, [part for part in sampling.refined if part.copies]
    seen = np.unique(np.concatenate([part.pixels for part in copies]))
    assert len(seen) > 300
    # Of 16 and 64 rays each before: most have an error below that of their light with 4.
    assert sum(len(part.pixels) * (part.last - part.first) for part in copies) < 6 * len(seen)
    assert renderer.baked.device.copies_error > 2.0 * renderer.plan.sampling.edge_mk * per_mk
    finer = replace(renderer.plan, sampling=replace(renderer.plan.sampling, samples=16, edge_mk=1.0))
    exact = tr.Renderer.of(renderer.baked.seen_as(scene, finer))
    off = ((radiance - exact.radiance(pose)) / per_mk).ravel()
    stated = (budget.sampling_error(renderer.plan, view.tracer(), radiance, sampling) / per_mk).ravel()
    for pixels in (seen, np.setdiff1d(np.arange(off.size), seen)):
        true, own = np.sqrt((off[pixels] ** 2).mean()), np.sqrt((stated[pixels] ** 2).mean())
        assert 0.3 * own < true < own
    # Another radiance of the same view gets the same rays.
    again, same = view.radiance(like=sampling)
    np.testing.assert_array_equal(again, radiance)
    assert [len(part.pixels) for part in same.refined] == [len(part.pixels) for part in sampling.refined]


def test_table_with_a_byte_order_mark_is_read(tmp_path):
    folder = write_copies(tmp_path / "s")
    (folder / "places.csv").write_text(PLACES, encoding="utf-8-sig")
    assert len(tr.load_scene(folder).surfaces[1].instances) == 4


def test_more_copies_than_the_memory_holds_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(instances, "MOST_COPIES", 3)
    with pytest.raises(ThermorenderError, match=r"places.csv has 4 rows, more than the 3 copies .*; give fewer rows"):
        tr.load_scene(write_copies(tmp_path / "s"))


def test_scene_says_how_many_copies_it_has(tmp_path):
    assert "trees (4 copies)" in str(tr.load_scene(write_copies(tmp_path / "s")))


@pytest.mark.parametrize("rays", [2, 6])
def test_rays_of_copies_need_no_whole_number_of_lanes(tmp_path, rays):
    geometry = Geometry(activate(), tr.load_scene(write_copies(tmp_path / "s")).surfaces)
    origin, *_ = radiosity.FaceRays(geometry, rays // 2)(geometry.mi.UInt32([0, 1, 2]), 0)
    assert np.isfinite(np.array(origin)).all() and dr.width(origin) == 3 * rays


def test_plan_says_how_many_copies_of_how_many_bodies_there_are(tmp_path):
    scene = tr.load_scene(write_copies(tmp_path / "s"))
    row = next(row for row in make_plan(scene).rows() if row[0] == "copies")
    assert row[1] == "4" and row[2].startswith("of 1 body; a copy has the light and temperatures of at most 12 groups")
    plain = make_plan(scene.with_surfaces(scene.surfaces[:1]))
    assert "copies" not in {row[0] for row in plain.rows()}


def test_light_is_kept_by_the_copies_too(tmp_path):
    scene = tr.load_scene(write_copies(tmp_path / "s"))
    trees = scene.surfaces[1]
    mirrored = replace(trees.instances, faces=trees.instances.faces[:, ::-1])
    names = [
        transport_cache.key(Geometry(activate(), [scene.surfaces[0], each]), 64)
        for each in (trees, replace(trees, instances=mirrored))
    ]
    assert names[0] != names[1]
    # Stand-ins of patches are the same, so the fingerprint must include the body.
    other = scene.with_surfaces([scene.surfaces[0], replace(trees, instances=mirrored)])
    assert other.digest() != scene.with_surfaces(scene.surfaces).digest()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"places": "east_m,north_m\n0,0\n99,2\n"}, r"has a copy at 99 m east, 2 m north, where there is no terrain"),
        ({"places": "east_m,north_m,scale\n0,0,1\n1,2,0\n"}, r"places.csv, row 3: scale=0 is not allowed; .*0.001"),
        ({"places": "east_m,north_m,scale\n0,0,1e-9\n"}, r"places.csv, row 2: scale=1e-09 is not allowed; .*0.001"),
        ({"places": "east_m,north_m,scale\n0,0,-1\n"}, r"places.csv, row 2: scale=-1 is not allowed"),
        (
            {"places": "east_m,north_m,above_ground_m\n0,0,-5\n"},
            r"copy at 0 m east, 0 m north whose top is .*below the",
        ),
        ({"places": "east_m north_m\n0,5 1\n"}, r"the column 'east_m north_m'; give .*, separated by commas"),
        ({"places": 'east_m,north_m\n"0,5",1\n'}, r"row 2: '0,5,1' is not 2 finite numbers"),
        ({"places": "east_m,north_m\n"}, r"places.csv lacks east_m, north_m or rows of numbers"),
        ({"kelvin": "balance"}, r"temperature of object 'trees' is 'balance', and .*source='raster'; give"),
        ({"places": "east_m,yaw_deg\n0,0\n"}, r"places.csv lacks east_m, north_m or rows of numbers"),
        ({"places": "east_m,north_m,size\n0,0,1\n"}, r"places.csv has the column 'size'; give a header with east_m"),
        ({"places": "east_m,north_m\n0,nan\n"}, r"places.csv, row 2: '0,nan' is not 2 finite numbers"),
        (
            {"material": "water_fresnel"},
            r"object 'trees' has 4 copies of the material 'water_fresnel', whose emissivity depends",
        ),
        ({"extra": 'track = "places.csv"'}, r"instances='?.*places.csv.* it without track: copies do not move"),
    ],
)
def test_tables_that_cannot_be_used_are_refused(tmp_path, change, words):
    with pytest.raises(ThermorenderError, match=words):
        tr.load_scene(write_copies(tmp_path / "s", **change))
