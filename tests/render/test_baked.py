"""Baked scenes and frames are values: picklable, solvable again for an edit, and independent of earlier renders."""

import copy
import gc
import pickle
import shutil
import subprocess
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import thermorender as tr
from scenes import scene_object, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.render.light import radiosity
from thermorender.scene.spec import AtmosphereSpec, TemperatureSpec
from thermorender.scene.surface import SATURATED

DOWN = {"pitch_deg": -90.0}
CAR = scene_object("car", [2.0, 2.0, 1.5], temperature=320.0, track="car.csv")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A terrain with a step and a car that drives east and cools from time 0 to 2."""
    height = np.zeros((16, 16))
    height[:, 9:] = 2.0
    made = write_terrain(tmp_path_factory.mktemp("baked") / "s", height, extra=CAR)
    (made / "car.csv").write_text("time_s,east_m,temperature_k\n0,-5,340\n2,0,320\n", encoding="utf-8")
    return made


@pytest.fixture(scope="module")
def renderer(folder):
    scene = tr.load_scene(folder)
    return tr.Renderer(scene.with_camera(replace(scene.camera, width=96, height=80)), rays=16, seed=5)


@pytest.fixture(scope="module")
def pose():
    return tr.pose(0, 0, 100, **DOWN)


def test_radiance_is_a_function_of_pose_time_and_objects(renderer, pose):
    first, later = renderer.radiance(pose), renderer.radiance(pose, 2.0)
    assert (first != later).any()
    renderer.frame(pose, time_s=2.0, objects={"car": {"temperature_k": 370.0}})
    np.testing.assert_array_equal(renderer.radiance(pose), first)
    np.testing.assert_array_equal(renderer.frame(pose, time_s=2.0).radiance, later)
    colour, _ = renderer.visible(pose)
    renderer.frame(pose, time_s=2.0)
    np.testing.assert_array_equal(renderer.visible(pose)[0], colour)
    assert (renderer.visible(pose, time_s=2.0)[0] != colour).any()


def test_lazily_computed_properties_belong_to_the_frames_own_time(renderer, pose):
    early = renderer.frame(pose, time_s=0.0)
    late = renderer.frame(pose, time_s=2.0)
    # Computed only now: the car was at 340 K west of the middle, then at 320 K in the middle.
    assert early.targets["car"]["pixel"][0] < late.targets["car"]["pixel"][0]
    # The car cools by 20 K; the terrain is between 285 and 300 K.
    assert np.nanmax(early.truth["kinetic_temperature"]) == 340.0
    assert np.nanmax(late.truth["kinetic_temperature"]) == 320.0


def test_frame_is_pickled_with_its_truth_and_without_its_scene(renderer, pose):
    frame = renderer.frame(pose, time_s=1.0, index=3)
    sent = pickle.dumps(frame)
    back = pickle.loads(sent)
    # 96 × 80 pixels: 4 bytes of radiance, 4 of its error, 30 of truth. The scene's texels and rays would be megabytes.
    assert len(sent) < 96 * 80 * (4 + 4 + 30) + 20_000
    np.testing.assert_array_equal(back.error_mk, frame.error_mk)
    for name, values in frame.truth.items():
        np.testing.assert_array_equal(back.truth[name], values)
    np.testing.assert_array_equal(back.counts, frame.counts)
    assert (back.targets, back.budget_mk, back.seed, back.index) == (frame.targets, frame.budget_mk, 5, 3)


def test_baked_scene_renders_the_same_bytes_in_another_process(renderer, pose, tmp_path):
    (tmp_path / "baked").write_bytes(pickle.dumps(renderer.baked))
    np.save(tmp_path / "pose.npy", pose)
    code = (
        "import pickle, sys, numpy as np, thermorender as tr\n"
        "renderer = tr.Renderer.of(pickle.load(open(sys.argv[1] + '/baked', 'rb')), seed=5)\n"
        "frame = renderer.frame(np.load(sys.argv[1] + '/pose.npy'), time_s=1.0, index=3)\n"
        "np.savez(sys.argv[1] + '/found.npz', radiance=frame.radiance, counts=frame.counts, **frame.truth)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    frame = renderer.frame(pose, time_s=1.0, index=3)
    with np.load(tmp_path / "found.npz") as found:
        for name, values in {"radiance": frame.radiance, "counts": frame.counts, **frame.truth}.items():
            np.testing.assert_array_equal(found[name], values)


def within(renderer, one, other):
    """Whether two images differ by no more than the errors that the solutions of their scenes state."""
    mk = renderer.baked.plan.sampling.tolerance_mk * 0.1
    return np.abs(one - other).max() <= 2.0 * mk * renderer.plan.radiance_per_mk


def test_edit_is_solved_without_tracing(renderer, pose, monkeypatch):
    warmer = renderer.scene.with_temperature(TemperatureSpec(source="constant", value=310.0))
    alone, baked = tr.Renderer(warmer, rays=16, seed=5), renderer.baked
    again = alone.radiance(pose)
    monkeypatch.setattr(radiosity, "trace", lambda *_: pytest.fail("light was traced again"))
    edited = baked.solved_for(warmer)
    assert within(renderer, tr.Renderer.of(edited).radiance(pose), again)
    assert edited.errors_mk == pytest.approx(alone.baked.errors_mk, rel=0.02, abs=0.5)
    # A renderer depends on its scene alone.
    np.testing.assert_array_equal(tr.Renderer(warmer, rays=16, like=renderer).radiance(pose), again)
    # After other materials on the same surfaces, the old light is not reused.
    swapped = renderer.scene.with_surfaces(materials=renderer.scene.materials[::-1])
    assert (tr.Renderer(swapped, rays=16, like=renderer).radiance(pose) != renderer.radiance(pose)).any()


def test_errors_of_edits_do_not_accumulate(renderer, pose):
    baked, known = renderer.baked, weakref.ref(renderer.baked.solved_for(renderer.scene.with_sky(250.0)))
    material = renderer.scene.materials[0].name
    for number in range(10):
        edited = renderer.scene.with_material({material: 0.4 + 0.05 * number}).with_sky(200.0 + 5.0 * number)
        baked = baked.solved_for(edited)
        baked = baked.solved_for(renderer.scene.with_temperature(290.0 + number))
        assert baked.errors_mk["solution"] <= 0.1 * baked.plan.sampling.tolerance_mk
    back = tr.Renderer.of(baked.solved_for(renderer.scene))
    assert within(renderer, back.radiance(pose), renderer.radiance(pose))
    gc.collect()
    assert known() is None


def test_edits_in_two_threads_at_once(renderer):
    edits = [renderer.scene.with_temperature(kelvin) for kelvin in (280.0, 310.0)]
    alone = [renderer.baked.solved_for(edit).incident for edit in edits]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda edit: renderer.baked.solved_for(edit).incident, edits * 3))
    for one, other in zip(together, alone * 3, strict=True):
        np.testing.assert_array_equal(one, other)


def test_like_compares_content(folder, renderer, pose):
    scene = tr.load_scene(folder)
    with pytest.raises(ThermorenderError, match="device='tpu' is unknown"):
        tr.Renderer(scene, rays=16, device="tpu", like=renderer)
    again = scene.with_camera(renderer.scene.camera)
    assert again.surfaces[0].vertices is not renderer.scene.surfaces[0].vertices
    np.testing.assert_array_equal(tr.Renderer(again, rays=16, like=renderer).radiance(pose), renderer.radiance(pose))

    def with_first(**changes):
        return scene.with_surfaces((replace(scene.surfaces[0], **changes), *scene.surfaces[1:]))

    first = scene.surfaces[0]
    moved = first.vertices.copy()
    moved[0, 2] += 1e-6
    for other, words in (
        (with_first(vertices=moved), "like=… has other vertices in surface 'terrain'; give one of the same surfaces"),
        (with_first(faces=first.faces[:, [1, 2, 0]]), "like=… has other faces in surface 'terrain'"),
        (with_first(uv=first.uv + np.float32(0.01)), "like=… has other uv in surface 'terrain'"),
        (scene.with_surfaces(scene.surfaces * 2), "like=… has 1 surfaces, not 2"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            tr.Renderer(other, rays=16, like=renderer)


def test_unpickled_frame_can_be_changed(renderer, pose):
    back = pickle.loads(pickle.dumps(renderer.frame(pose, index=3)))
    later, want = replace(back, index=4), renderer.frame(pose, index=4)
    np.testing.assert_array_equal(later.counts, want.counts)
    assert (later.targets, later.budget_mk) == (want.targets, want.budget_mk)
    # The sensor's flags in the truth follow the new reading, not the previous one.
    full = back.with_reading(np.full_like(want.counts, 2**14 - 1), {})
    for sent in (full, pickle.loads(pickle.dumps(full))):
        assert (sent.truth["mask"] & SATURATED).all()
        assert not (replace(sent, _reading=want.counts).truth["mask"] & SATURATED).any()
    for one in (copy.copy(full), copy.deepcopy(full)):
        np.testing.assert_array_equal(one.truth["depth"], want.truth["depth"])
    assert back in (want, back) and len({back, want}) == 2


def test_light_from_another_altitude_is_not_reused(renderer, pose):
    high = renderer.scene.with_air("tropical")
    low = high.with_air(AtmosphereSpec(standard="tropical", altitude_m=high.altitude_m + 3000.0))
    found = tr.Renderer(low, rays=16, like=tr.Renderer(high, rays=16, like=renderer)).radiance(pose)
    np.testing.assert_array_equal(found, tr.Renderer(low, rays=16).radiance(pose))


def test_scene_like_another_has_its_own_colours_and_names(folder, renderer, pose):
    first, *others = renderer.scene.surfaces
    dark = renderer.scene.with_surfaces((replace(first, colour=first.colour // 2, name="land"), *others))
    alone = tr.Renderer(dark, rays=16)
    for like in (tr.Renderer(dark, rays=16, like=renderer), tr.Renderer.of(renderer.baked.solved_for(dark))):
        np.testing.assert_array_equal(like.visible(pose)[0], alone.visible(pose)[0])
    # An object's name decides whether a target is visible.
    still = (folder / "scene.toml").read_text().replace('track = "car.csv"\n', "")
    other = folder.parent / "still"
    shutil.copytree(folder, other)
    (other / "scene.toml").write_text(still)
    scene = tr.load_scene(other)
    (other / "scene.toml").write_text(still.replace('"car"', '"van"'))
    made = tr.Renderer(scene, rays=4)
    assert tr.Renderer(tr.load_scene(other), rays=4, like=made).frame(pose).targets["van"]["visible"]
