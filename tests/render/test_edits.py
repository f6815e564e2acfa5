"""Edits of materials and temperatures: previews within their stated error, and solutions from the known light."""

import gc
import pickle
import time
import weakref
from dataclasses import replace
from unittest.mock import Mock

import drjit as dr
import numpy as np
import pytest

import thermorender as tr
from scenes import scene_object, write_terrain
from thermorender.render.baked import bake
from thermorender.render.edits import preview as edits
from thermorender.render.light.solved import solve_scene

DOWN = {"pitch_deg": -90.0}
AREA = np.array([[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]])


@pytest.fixture(scope="module")
def renderer(tmp_path_factory):
    """A street between walls twice as high as it is wide, half of it warm."""
    height = np.full((24, 24), 12.0)
    height[:, 9:15] = 0.0
    kelvin = np.full((48, 48), 285.0)
    kelvin[:24] = 305.0
    folder = write_terrain(tmp_path_factory.mktemp("edits") / "street", height, kelvin)
    scene = tr.load_scene(folder)
    camera = replace(scene.camera, width=64, height=48)
    # Without a search for edges, so that two images have the same rays.
    return tr.Renderer(scene.with_camera(camera), rays=64, edge_mk=np.inf)


def spectrum(material, at_um, by):
    """A material whose emissivity differs by `by` near a wavelength."""
    near = np.exp(-((material.wavelength_um - at_um) ** 2))
    return replace(material, name="edited", emissivity=np.clip(material.emissivity + by * near, 0.0, 1.0))


def warmer(scene, number, by):
    """The scene with the texels of a material warmer."""
    surface = scene.surfaces[0]
    kelvin = np.where(surface.material == number, by, 0.0) + surface.temperature
    return scene.with_temperature(scene.spec.temperature, kelvin=[kelvin])


EDITS = {
    "emissivity": lambda scene: scene.with_material(grass_green=0.9),
    "nearly black": lambda scene: scene.with_material(grass_green=0.999, sand_quartz=0.999),
    "much reflection": lambda scene: scene.with_material(sand_quartz=0.4),
    "a point of a spectrum": lambda scene: scene.with_material(grass_green=spectrum(scene.materials[0], 9.0, -0.2)),
    "temperature of a class": lambda scene: warmer(scene, 0, 8.0),
    "another material": lambda scene: scene.with_material(sand_quartz="asphalt"),
    "a class like the other": lambda scene: scene.with_material(sand_quartz="grass_green"),
    "an area": lambda scene: scene.with_material_in(AREA, "concrete"),
    "materials and temperature": lambda scene: warmer(scene.with_material(sand_quartz=0.7), 1, -5.0),
}


def off(one, other):
    """Largest difference of texels, of faces and of the images of two renderers [mK]."""
    poses = tr.pose(0, 0, 40, **DOWN), tr.pose(-6, 2, 30, pitch_deg=-60.0, yaw_deg=90.0)
    pairs = [(one.radiance(pose), other.radiance(pose)) for pose in poses]
    pairs.append(tuple(sum(each.baked.texels) for each in (one, other)))
    return max(float(np.abs(a - b).max()) for a, b in pairs) / one.plan.radiance_per_mk


def test_a_frame_sampled_as_another_differs_by_its_light_alone(renderer):
    edged = tr.Renderer(renderer.scene, quality="fast", rays=64, like=renderer)
    pose = edged.scene.pose(-6, 2, 30, pitch_deg=-60.0, yaw_deg=90.0)
    before = edged.frame(pose)
    assert np.array_equal(edged.frame(pose, sampled_as=before).radiance, before.radiance)
    scene = edged.scene.with_material(grass_green=0.5)
    preview, exact = (made.frame(pose) for made in (edged.preview_for(scene), edged.solved_for(scene)))
    alike = edged.solved_for(scene).frame(pose, sampled_as=preview)
    # Rays of the frames' own choice differ.
    assert not np.array_equal(alike.radiance, exact.radiance)
    stated = edged.preview_for(scene).baked.errors_mk["preview"]
    assert np.abs(alike.radiance - preview.radiance).max() < stated * edged.plan.radiance_per_mk


@pytest.mark.parametrize("other", ["pose", "quality", "camera"])
def test_a_frame_sampled_as_one_of_another_view_is_refused(renderer, other):
    pose, scene = renderer.scene.pose(0, 0, 40, pitch_deg=-90.0), renderer.scene
    frame = renderer.frame(pose)
    if other == "pose":
        pose = renderer.scene.pose(1, 0, 40, pitch_deg=-90.0)
    elif other == "camera":
        renderer = tr.Renderer(scene.with_camera(replace(scene.camera, width=60)), rays=64, like=renderer)
    else:
        renderer = tr.Renderer(scene, quality="high", rays=64, like=renderer)
    with pytest.raises(tr.ThermorenderError, match=r"sampled_as=… is a frame of another view.*give one"):
        renderer.frame(pose, sampled_as=frame)


@pytest.mark.parametrize("name", EDITS)
def test_preview_differs_from_the_solution_by_its_stated_error_at_most(renderer, name):
    scene = EDITS[name](renderer.scene)
    preview, exact = renderer.preview_for(scene), renderer.solved_for(scene)
    stated, change = preview.baked.errors_mk["preview"], off(exact, renderer)
    apart = (preview.baked.texels[0] - exact.baked.texels[0]) / renderer.plan.radiance_per_mk
    assert np.sqrt(np.mean(apart**2)) < preview.baked.errors_mk["preview_rms"] <= stated
    assert off(preview, exact) < stated < 0.5 * change
    assert "preview" not in exact.baked.errors_mk


def test_texels_of_other_faces_have_the_weights_of_the_points_in_a_face(renderer):
    samples, cover = renderer.baked.samples, np.array(renderer.baked.geometry.face_of_texel)
    mi = renderer.baked.geometry.mi
    start, texels, weights = (np.array(each) for each in samples.others)
    assert len(start) == renderer.baked.geometry.face_count + 1 and start[-1] == len(texels) > 0
    for face in range(0, renderer.baked.geometry.face_count, 7):
        expected, points = np.zeros(len(cover)), dr.arange(mi.UInt32, samples.count)
        for texel, weight in samples.corners(dr.full(mi.UInt32, face, samples.count), points):
            np.add.at(expected, np.array(texel), np.array(weight) / samples.count)
        expected[cover == face] = 0.0
        found = np.zeros(len(cover))
        found[texels[start[face] : start[face + 1]]] = weights[start[face] : start[face + 1]]
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_light_of_few_faces_is_that_of_all_rays(renderer):
    transport, samples = renderer.baked.transport, renderer.baked.samples
    count = len(transport.up)
    # One that no other face sees, and some that others see.
    hits = np.bincount(transport.seen, minlength=count)
    faces = np.sort(np.concatenate([np.flatnonzero(hits == 0)[:1], np.flatnonzero(hits)[[3, 40, 41]]]))
    sent = np.zeros((count, 2))
    sent[faces] = np.random.default_rng(0).random((len(faces), 2))
    rows, seen = samples.seen_on(faces, sent[faces])
    expected = (transport.halves(slice(0, count)) @ sent / (2.0 * transport.rays)).reshape(count, 2, 2)
    assert len(rows) < count / 2
    np.testing.assert_allclose(seen, expected[rows], rtol=1e-12)
    assert not np.delete(expected, rows, axis=0).any()


@pytest.mark.parametrize("few", [0.0, np.inf])
@pytest.mark.parametrize("name", EDITS)
def test_solution_of_an_edit_is_that_of_the_edited_scene(renderer, name, few, monkeypatch):
    """It begins from the light before, and its error bound is that of any solution, whichever faces send."""
    scene = EDITS[name](renderer.scene)
    monkeypatch.setattr("thermorender.render.edits.solution._MOST_CHANGED", 1.0)
    monkeypatch.setattr("thermorender.render.edits.solution._FEW", few)
    found = renderer.baked.solved_for(scene)
    alone = bake(scene, found.plan, like=renderer.baked)
    apart = np.abs(found.incident - alone.incident).max() / renderer.plan.radiance_per_mk
    assert found.errors_mk["solution"] <= 0.1 * found.plan.sampling.tolerance_mk
    assert apart <= 0.2 * found.plan.sampling.tolerance_mk / found.plan.nodes
    assert found.errors_mk == pytest.approx(alone.errors_mk, rel=0.05, abs=0.5)


def test_most_edits_are_solved_from_the_light_before(renderer, monkeypatch):
    """All light is solved when rounding has added up, or when an edit needs other nodes."""
    monkeypatch.setattr("thermorender.render.edits.solution._MOST_CHANGED", 1.0)
    whole, baked = Mock(side_effect=solve_scene), renderer.baked
    monkeypatch.setattr("thermorender.render.baked.solve_scene", whole)
    for number in range(30):
        scene = renderer.scene.with_material(sand_quartz=0.9 + 0.002 * number)
        baked = baked.solved_for(warmer(scene, 0, 0.1 * number))
        assert baked.errors_mk["solution"] <= 0.1 * baked.plan.sampling.tolerance_mk
    assert whole.call_count <= 3
    back = baked.solved_for(renderer.scene)
    assert off(tr.Renderer.of(back), renderer) <= 0.2 * back.plan.sampling.tolerance_mk


def test_an_edit_of_nothing_changes_nothing(renderer):
    scene = renderer.scene.with_material(grass_green="grass_green")
    preview, exact = renderer.preview_for(scene), renderer.solved_for(scene)
    assert off(preview, renderer) == 0.0 and off(exact, renderer) <= 0.2 * renderer.plan.sampling.tolerance_mk


def test_edits_of_sky_are_solved_and_not_previewed(renderer):
    scene = renderer.scene.with_sky(250.0)
    preview = renderer.preview_for(scene)
    assert "preview" not in preview.baked.errors_mk
    assert off(preview, renderer.solved_for(scene)) == 0.0


def test_previews_of_previews_that_change_little_begin_from_the_solution(renderer):
    first, second = (renderer.scene.with_material(grass_green=value) for value in (0.5, 0.95))
    chained = renderer.preview_for(first).preview_for(second)
    assert off(chained, renderer.preview_for(second)) == 0.0
    assert off(chained.solved_for(first), renderer.solved_for(first)) == 0.0
    # Sent to another process, a preview has no light to begin from, and is solved.
    sent = tr.Renderer.of(pickle.loads(pickle.dumps(chained.baked)))
    assert "preview" not in sent.preview_for(first).baked.errors_mk
    assert off(sent.preview_for(first), renderer.solved_for(first)) <= 0.2 * renderer.plan.sampling.tolerance_mk


@pytest.mark.parametrize("last", ["a class like the other", "emissivity", "an area"])
def test_a_preview_that_begins_from_the_one_before_states_the_errors_of_both(renderer, last, monkeypatch):
    monkeypatch.setattr(edits, "_QUICK_RAYS", -1)
    first = renderer.scene.with_material(sand_quartz=0.4)
    scene = EDITS[last](first)
    monkeypatch.setattr(edits, "_WORTH", -1.0)
    before = renderer.preview_for(first)
    chained = before.preview_for(scene)
    monkeypatch.setattr(edits, "_WORTH", np.inf)
    fresh, exact = before.preview_for(scene), renderer.solved_for(scene)
    assert off(chained, fresh) > 0.0
    for made in (chained, fresh):
        stated = made.baked.errors_mk
        apart = (made.baked.texels[0] - exact.baked.texels[0]) / renderer.plan.radiance_per_mk
        assert np.sqrt(np.mean(apart**2)) < stated["preview_rms"] <= stated["preview"]
        assert off(made, exact) < stated["preview"]
    # What the first preview leaves out stays left out, and is stated, also where the edit goes back.
    monkeypatch.setattr(edits, "_WORTH", -1.0)
    back = before.preview_for(renderer.scene)
    assert off(back, renderer) < back.baked.errors_mk["preview"]
    assert off(chained.solved_for(scene), exact) == 0.0


def test_a_frame_states_that_it_is_a_preview(renderer):
    pose = tr.pose(0, 0, 40, **DOWN)
    preview = renderer.preview_for(renderer.scene.with_material(sand_quartz=0.5))
    budget = preview.frame(pose).budget_mk
    assert budget["preview"] == preview.baked.errors_mk["preview_rms"] > 0.0
    assert budget["total"] > renderer.frame(pose).budget_mk["total"]
    assert "preview" not in renderer.frame(pose).budget_mk
    truth = preview.frame(pose).truth
    names = [material.name for material in preview.scene.materials]
    new = truth["material"] == names.index("sand_quartz") if "sand_quartz" in names else truth["emissivity"] == 0.5
    assert new.any()


def test_a_solution_stops_where_its_progress_raises(renderer):
    """And says something every few milliseconds, so that the next edit need not wait."""
    calls = []

    def stop(what, share):
        calls.append(time.perf_counter())
        if len(calls) == 3:
            raise KeyboardInterrupt

    for scene in (renderer.scene.with_material(grass_green=0.9), renderer.scene.with_sky(250.0)):
        calls.clear()
        with pytest.raises(KeyboardInterrupt):
            renderer.baked.solved_for(scene, stop)
        assert len(calls) == 3
        calls.clear()
        renderer.baked.solved_for(scene, lambda *_: calls.append(time.perf_counter()))
        assert len(calls) > 20


@pytest.mark.parametrize("kind", ["mirror", "track"])
def test_an_edit_without_a_preview_is_solved_and_stops_where_its_progress_raises(tmp_path, kind):
    material = {"mirror": "gold_polished", "track": "paint_black"}[kind]
    box = scene_object("box", [3.0, 3.0, 2.0], temperature=310.0, material=material)
    box += 'track = "box.csv"\n' if kind == "track" else ""
    folder = write_terrain(tmp_path / "s", np.add.outer(np.zeros(16), np.abs(np.arange(16.0) - 8.0)), extra=box)
    (folder / "box.csv").write_text("time_s,east_m\n0,-3\n2,3\n", encoding="utf-8")
    scene = tr.load_scene(folder)
    renderer = tr.Renderer(scene.with_camera(replace(scene.camera, width=48, height=40)), rays=16, edge_mk=np.inf)
    edited, calls = renderer.scene.with_material(grass_green=0.8), []

    def stop(what, share):
        calls.append(what)
        if len(calls) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        renderer.preview_for(edited, stop)
    assert len(calls) == 3
    shown = renderer.preview_for(edited, lambda *_: None)
    assert "preview" not in shown.baked.errors_mk
    fresh = tr.Renderer(edited, rays=16, edge_mk=np.inf)
    limit = renderer.plan.sampling.tolerance_mk
    assert off(shown, fresh) < limit < off(shown, renderer)


def test_images_from_one_pose_cast_no_rays_again(renderer, monkeypatch):
    pose, other = tr.pose(0, 0, 40, **DOWN), tr.pose(-6, 2, 30, pitch_deg=-60.0)
    first = renderer.radiance(pose)
    renderer.radiance(other)
    preview = renderer.preview_for(renderer.scene.with_material(grass_green=0.9))
    again = preview.radiance(other)
    monkeypatch.setattr(type(preview.baked.geometry), "seen", lambda *_: pytest.fail("rays were cast"))
    np.testing.assert_array_equal(preview.radiance(other), again)
    monkeypatch.undo()
    np.testing.assert_array_equal(renderer.radiance(pose), first)


@pytest.mark.slow
def test_memory_does_not_grow_with_previews(renderer):
    pose, sizes = tr.pose(0, 0, 40, **DOWN), []
    for number in range(50):
        shown = renderer.preview_for(renderer.scene.with_material(grass_green=0.5 + 0.009 * number))
        shown.radiance(pose)
        known = weakref.ref(shown.baked)
        del shown
        if number % 10 == 9:
            gc.collect()
            assert known() is None
            sizes.append((len(dr.whos(as_string=True).splitlines()), len(gc.get_objects())))
    arrays, objects = np.array(sizes[1:]).T
    assert np.ptp(arrays) <= 2 and np.ptp(objects) < 200


def test_an_edit_back_to_the_known_scene_changes_nothing(renderer):
    edited = renderer.solved_for(EDITS["emissivity"](renderer.scene))
    again = edited.solved_for(EDITS["emissivity"](renderer.scene))
    assert off(edited, again) == 0.0
