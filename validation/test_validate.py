"""Studies and their tools: errors, Pareto fronts, unbiased references, run times."""

import json
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from support import slow
from typer.testing import CliRunner

import thermorender as tr
from scenes import write_terrain
from thermorender.apps.compare import bench
from thermorender.apps.compare import sampling_error as metrics
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.render.light import transport_cache
from thermorender.render.reference import squared_error
from thermorender.scene.scene import Scene
from thermorender.sensor.camera import load_camera
from validation import cavity, verdicts
from validation.air import study as air
from validation.budget import study
from validation.budget.scenes import made
from validation.command import app_of
from validation.convergence import study as convergence
from validation.convergence.figure import pareto
from validation.edits import study as edits
from validation.emissivity import study as emissivity
from validation.footage import study as sensor_statistics
from validation.gpu import study as gpu
from validation.growth import study as growth
from validation.heights import study as heights
from validation.horizon import study as horizon
from validation.made_scenes import terrain
from validation.sensor import study as sensor

CAMERA = load_camera("zenmuse-xt2")


def study_command(name, *arguments):
    """Run `python -m validation.NAME` in this process."""
    main = import_module(f"validation.{name}.__main__").main
    return CliRunner().invoke(app_of(main), list(arguments), catch_exceptions=False)


def small(scene, width=64, height=48):
    camera = replace(scene.camera, width=width, height=height, pixel_pitch_um=170.0, f_number=12.5)
    return scene.with_camera(camera)


def test_identical_images_have_no_error():
    image = band_radiance(np.random.default_rng(0).uniform(280.0, 300.0, (20, 30)), *CAMERA.band_um)
    assert metrics.rms_mk(image, image, CAMERA) == 0.0 == metrics.rms_mk(image, image, CAMERA, 0.4)


def test_errors_are_in_millikelvin():
    image = band_radiance(np.full((20, 30), 290.0), *CAMERA.band_um)
    warmer = band_radiance(np.full((20, 30), 290.1), *CAMERA.band_um)
    assert metrics.rms_mk(warmer, image, CAMERA) == pytest.approx(100.0, rel=2e-3)
    # A uniform difference passes any lens.
    assert metrics.rms_mk(warmer, image, CAMERA, 2.0) == pytest.approx(100.0, rel=2e-3)


def test_the_gaussian_equals_diffraction_at_the_nyquist_frequency():
    sigma = metrics.optics_sigma_px(CAMERA)
    assert sigma == pytest.approx(0.363, abs=1e-3)
    # The finest stripes of a cosine series, 511/1024 of a cycle per pixel, keep their shape.
    stripes = np.cos(np.pi * 511 * (np.arange(512) + 0.5) / 512) * np.ones((4, 1))
    x = 0.5 * 10.5 * 1.25 / 17.0
    limit = 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x * x))
    np.testing.assert_allclose(metrics.after_optics(stripes, sigma), limit * stripes, atol=3e-3)
    with pytest.raises(ThermorenderError, match=r"camera zenmuse-xt2: f_number=4 blurs more than two pixels"):
        metrics.optics_sigma_px(replace(CAMERA, f_number=4.0))


def test_squared_error_does_not_count_the_references_noise():
    rng = np.random.default_rng(3)
    truth = rng.normal(size=200_000)
    image = truth + rng.normal(scale=0.1, size=truth.size)
    first, second = (truth + rng.normal(scale=2.0, size=truth.size) for _ in range(2))
    found, standard_error = squared_error(image, first, second)
    assert standard_error == pytest.approx(4.0 / np.sqrt(truth.size), rel=0.05)
    assert abs(found - 0.01) < 4 * standard_error
    # With a single noisy reference, its noise would count as the image's error.
    assert ((image - first) ** 2).mean() > 100 * standard_error


def test_pareto_front_of_settings():
    points = [(2.0, 5.0), (1.0, 9.0), (3.0, 6.0), (4.0, 1.0), (1.0, 8.0), (5.0, 1.0)]
    assert pareto(points) == [4, 0, 3]
    assert pareto([]) == []


@pytest.mark.parametrize(("asked", "made"), [(8, 8), (200, 200), (20_000, 20_000), (1000, 1012)])
def test_synthetic_terrain_has_the_triangles_asked_for(asked, made):
    scene = terrain(asked)
    (surface,) = scene.surfaces
    assert len(surface.faces) == made
    corners = surface.vertices[surface.faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0.0).all()
    assert np.isfinite(scene.ground(0.0, 0.0)) and surface.material.max() < len(scene.materials)
    with pytest.raises(ThermorenderError, match="triangles=4 is not allowed; give 8 or more"):
        terrain(4)


def test_converged_image_agrees_with_the_renderer():
    scene = small(terrain(200))
    scene = scene.with_camera(replace(scene.camera, principal_offset_px=(3.3, -2.7)))
    pose = bench.views(scene)["oblique"]
    renderer = tr.Renderer(scene, samples=16, taps=1, edge_mk=np.inf, rays=4)
    finest, image = metrics.converged(renderer, pose), renderer.radiance(pose)
    error = metrics.rms_mk(image, finest, scene.camera)
    for axis in (0, 1):
        # With a quarter at the wrong corner, or half a pixel off, the error would be that of neighbouring pixels.
        assert error < 0.1 * metrics.rms_mk(np.roll(image, 1, axis), finest, scene.camera)


def test_bench_returns_finite_numbers(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))
    monkeypatch.setattr(transport_cache, "WORTH_RAYS", 1)
    result = bench.bench((small(terrain(200)),), repeats=2, settings=(("one", {"samples": 1, "rays": 4}),))
    json.dumps(result)
    # A bake read from disk would take no time.
    assert not list(tmp_path.iterdir())
    _ = tr.Renderer(terrain(200), rays=4).baked
    assert list(tmp_path.iterdir())
    (scene,) = result["scenes"].values()
    assert scene["triangles"] == 200 and scene["bake_s"] > 0.0
    assert set(scene["settings"]["one"]["views"]) == set(bench.VIEWS)
    for seen in scene["settings"]["one"]["views"].values():
        numbers = np.hstack(list(seen.values()))
        assert np.isfinite(numbers).all() and (numbers > 0.0).all()
        assert seen["radiance_over_rays"] == sorted(seen["radiance_over_rays"])
    assert len(bench.rows(result)) == 2 and all(len(row) == len(bench.HEADER) for row in bench.rows(result))
    assert "200 triangles" in bench.costs(result)[0]


def test_bench_refuses_an_empty_list_of_scenes():
    with pytest.raises(ThermorenderError, match="there is no scene to measure; give a scene folder or the name of a"):
        bench.bench(())
    with pytest.raises(ThermorenderError, match=r"repeats=0 is not allowed; give 1 or more"):
        bench.bench((terrain(8),), repeats=0)


def test_closed_cavity_is_black():
    found = cavity.measure("closed", 0.0, 0.5, 4, "auto")
    assert found["error_mk"] < 1.0


def seen_through(loop, point, normal):
    """Share of the diffuse view from points (n, 3) on faces of normals (n, 3) that closed polygons (k, 2, 3) span.

    Lambert's contour integral, exact for any polygon above the horizon: inside a convex body all is.
    """
    one, other = (loop[None, :, k] - point[:, None] for k in (0, 1))
    across = np.cross(one, other)
    length = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(length, (one * other).sum(axis=-1))
    return np.abs((angle / length * np.einsum("nkc,nc->nk", across, normal)).sum(axis=1)) / (2.0 * np.pi)


@pytest.mark.slow
@pytest.mark.parametrize("emissivity", [0.5, 0.1])
def test_open_cavity_agrees_with_the_closed_form_of_its_polyhedron(emissivity):
    import trimesh

    rays = 4096
    found = cavity.measure("open", 0.1, emissivity, rays, "auto")
    ball = trimesh.creation.icosphere(subdivisions=4)
    kept = ball.triangles_center[:, 2] < 0.8
    # Edges of the hole, between a face that is kept and one that is not, in order around the hole.
    edges = ball.vertices[ball.face_adjacency_edges[kept[ball.face_adjacency].sum(axis=1) == 1]]
    clockwise = np.cross(edges[:, 0], edges[:, 1])[:, 2] < 0.0
    edges[clockwise] = edges[clockwise, ::-1]
    centre, inward, area = ball.triangles_center[kept], -ball.face_normals[kept], ball.area_faces[kept]
    # The mean over each face, from the middles of 16 equal parts; its centre alone would be 2e-5 too high.
    corners = ball.triangles[kept]
    thirds = [(i + k / 3.0, j + k / 3.0) for k in (1, 2) for i in range(4) for j in range(5 - k - i)]
    sides = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    places = [corners[:, 0] + sides @ (np.array(at) / 4.0) for at in thirds]
    opening = np.mean([seen_through(edges, place, inward) for place in places], axis=0)
    # All walls have nearly the same radiance m, so the area-weighted mean share of sky suffices.
    black, sky = (float(band_radiance(t, *CAMERA.band_um)) for t in (300.0, 250.0))

    def wall(share):
        received = ((1 - share) * emissivity * black + share * sky) / (1 - (1 - emissivity) * (1 - share))
        return emissivity * black + (1 - emissivity) * received

    scale = 1e3 / float(band_radiance_derivative(300.0, *CAMERA.band_um))
    share = np.average(opening, weights=area)
    missing = 1.0 - area.sum() / ball.area
    assert np.ptp(opening) < 0.003 and share == pytest.approx(missing, abs=1e-3)
    # `measure` returns the error against a sphere with the same open share; the polyhedron differs from it by 1–3 mK.
    own = scale * (wall(share) - wall(missing))
    assert 0.5 < abs(own) < 6.0
    # The error of a face with independent rays; stratified rays have less. The mean over the faces in the picture
    # (45° by 37°) divides it by the root of their number. The mean light m adds its own error, that of all faces
    # multiplied by the number of reflections.
    alone = scale * (1 - emissivity) * (wall(share) - sky) * np.sqrt(share * (1 - share) / rays)
    assert found["error_mk"] < 0.5 * alone
    seen = (np.abs(centre[:, :2]) < -centre[:, 2:] * np.tan(np.radians([45.4 / 2, 37.0 / 2]))).all(axis=1).sum()
    round_about = (1 - emissivity) * (1 - share) / (1 - (1 - emissivity) * (1 - share))
    error = found["error_mk"] * np.hypot(1.0 / np.sqrt(seen), round_about / np.sqrt(len(centre)))
    assert seen > 150 and abs(found["mean_mk"] - own) < 3.0 * error < 9.0


@pytest.mark.slow
def test_convergence_measures_missing_cases_only(tmp_path, monkeypatch):
    monkeypatch.setattr(convergence, "QUALITIES", {"standard": (1, 4, np.inf)})
    engine = "stock direct, BSDF samples"
    sampling, rays = ((1, 1, np.inf),), (4,)
    mode = convergence.Mode((16, 12), ("nadir",), (20000.0,), 4, (engine,), (1,), sampling, rays, (50.0,), (), 0.0)
    scene = small(terrain(200))
    first = convergence.convergence((scene,), tmp_path, mode=mode)
    names = {record["setting"]: record for record in first.values() if record.get("view") != "20000 m"}
    assert names["1 · 1 · inf mK"]["sampling_mk"] >= 0.0 and names["1 · 1 · inf mK"]["seconds"] > 0.0
    # The error of one path per pixel is much larger than that of one ray: its wavelength is random, too.
    (stock,) = (record for record in first.values() if record["engine"] == engine)
    assert stock["error_mk"] > 100.0 > names["1 · 1 · inf mK"]["sampling_mk"]
    assert sum(record.get("default", False) for record in first.values()) == 2
    # From far away, most of the window is empty, which does not count.
    far = [record for record in first.values() if record.get("view") == "20000 m"]
    assert {record["group"] for record in far} == {"sampling"} and min(r["sampling_mk"] for r in far) > 200.0
    assert "1 · 1 · inf mK" in (tmp_path / "convergence.md").read_text(encoding="utf-8")
    assert (tmp_path / f"convergence_{scene.name}.png").stat().st_size > 5000
    monkeypatch.setattr(convergence.Site, "measure", lambda *_, **__: pytest.fail("measured a case that was there"))
    assert convergence.convergence((scene,), tmp_path, mode=mode) == first
    with pytest.raises(ThermorenderError, match=r"convergence.json has cases of other settings; give another folder"):
        convergence.convergence((scene,), tmp_path, mode=replace(mode, reference_paths=8))
    (tmp_path / "convergence.json").write_text("{", encoding="utf-8")
    with pytest.raises(ThermorenderError, match=r"convergence.json is damaged"):
        convergence.convergence((scene,), tmp_path, mode=mode)
    with pytest.raises(ThermorenderError, match=r"mode='slow' is unknown; give one of quick, full"):
        convergence.convergence((), tmp_path, mode="slow")


@pytest.mark.slow
def test_far_ground_makes_frames_toward_the_horizon_more_accurate(tmp_path, short_heat):
    cases = horizon.run(tmp_path, (400.0,), (300.0,), (-5.0,), world_m=8000.0)
    none, coarse = cases
    assert (none["far"], coarse["far"]) == ("none", "400") and none["triangles"] < coarse["triangles"]
    assert none["pixels"] == coarse["pixels"] and sum(none["pixels"]) > 100_000
    assert coarse["rms_k"][1] < none["rms_k"][1] and none["rms_k"][4] is None
    assert [len(row) for row in horizon.rows(cases)] == [len(horizon.HEADER)] * 2
    assert json.loads((tmp_path / "horizon.json").read_text())["cases"] == cases


@pytest.mark.slow
def test_growth_measures_each_case_in_a_separate_process(tmp_path):
    base, axes = (200, 16, 2), {"triangles": (200,), "texels": (16,), "nodes": (1, 4)}
    cases = growth.run(tmp_path, axes, base)
    assert [case["nodes"] for case in cases.values()] == [2, 2, 1, 4]
    assert all(case["bake_s"] > 0.0 and case["frame_ms"] > 0.0 for case in cases.values())
    assert len(growth.rows(cases)) == 4 and (tmp_path / "growth.png").stat().st_size > 5000
    # Existing cases are not measured again.
    path = tmp_path / "growth.json"
    path.write_text(path.read_text().replace('"bake_s": ', '"bake_s": 1e9, "was": '))
    assert all(case["bake_s"] == 1e9 for case in growth.run(tmp_path, axes, base).values())


@pytest.mark.slow
def test_heights_measure_error_and_time_of_each_quality_and_the_peers(tmp_path):
    folder = write_terrain(tmp_path / "tiny", height=np.random.default_rng(1).uniform(0, 1, (32, 32)))
    scene = small(tr.load_scene(folder))
    cases = heights.run(tmp_path, (scene,), (30.0,))
    measured = [case for case in cases.values() if "height_m" in case]
    assert [(case["air"], case["quality"]) for case in measured] == [
        (air, quality) for air in heights.AIRS for quality in heights.QUALITIES
    ]
    for fast, _, high in (measured[:3], measured[3:]):
        assert high["error_mk"] < fast["error_mk"] and high["rays_per_pixel"] > fast["rays_per_pixel"]
        assert fast["optics_error_mk"] < fast["error_mk"] and min(fast["frame_ms"], fast["rays_ms"]) > 0.0
    times = cases[f"peers/{scene.name}"]["peers_ms"]
    assert all(times[name] > 0.0 for name in ("rays alone", "radiance, standard", "Mitsuba, path"))
    assert len(heights.rows(cases)) == 6 + len(times) and (tmp_path / "heights.png").stat().st_size > 5000
    # Existing cases are not measured again.
    path = tmp_path / "heights.json"
    path.write_text(path.read_text().replace('"frame_ms": ', '"frame_ms": 1e9, "was": '))
    again = heights.run(tmp_path, (scene,), (30.0,))
    assert all(case["frame_ms"] == 1e9 for case in again.values() if "height_m" in case)


@pytest.mark.slow
def test_the_study_of_devices_counts_the_kernels_of_each_view_and_quality(tmp_path):
    folder = write_terrain(tmp_path / "tiny", height=np.random.default_rng(1).uniform(0, 1, (32, 32)))
    (tmp_path / "out").mkdir()
    record = gpu.run(tmp_path / "out", ["cpu"], [folder], ("standard", "fast"), heat=False)
    assert json.loads((tmp_path / "out/gpu.json").read_text(encoding="utf-8")) == record
    scene = record["devices"]["cpu"]["scenes"]["tiny"]
    assert [(each["view"], each["quality"]) for each in scene["frames"]] == [
        (view, quality) for quality in ("standard", "fast") for view in bench.VIEWS
    ]
    for frame in scene["frames"]:
        # A frame casts its first rays, reads what they hit, and refines edges; on the CPU arrays are read in place.
        assert frame["kernels"] >= 3 and frame["copies"] == 0 and 0.0 < frame["device_ms"] < 2.0 * frame["frame_ms"]
        assert len(frame["host_ms"]) > 3
    starts, frames, apart, host = gpu.tables(record)
    assert (len(starts[1]), len(frames[1]), apart[1], len(host[1])) == (1, 4, [], 8)
    assert all(len(row) == len(header) for header, rows in (starts, frames, host) for row in rows)
    # Images of two devices differ by what is stated in mK.
    image = np.load(tmp_path / "out/cpu tiny nadir.npy")
    for view in bench.VIEWS:
        np.save(tmp_path / f"out/cuda tiny {view}.npy", image + 5.0 * scene["frames"][0]["per_mk"])
    nadir = gpu.differences(tmp_path / "out", {"cpu": {"scenes": {"tiny": scene}}, "cuda": {}})[0]
    assert nadir["rms_mk"] == pytest.approx(5.0, rel=1e-3) == nadir["median_mk"]
    late = gpu.run(tmp_path / "out", ["cpu"], [folder], limit_s=0.0)
    assert gpu.notes(late)[-1] == "cpu left out for time: tiny." and not late["devices"]["cpu"]["scenes"]
    with pytest.raises(ThermorenderError, match=r"devices=.'tpu'.*give a scene, and one or both of cpu, cuda"):
        gpu.run(tmp_path / "out", ["tpu"])


@pytest.mark.parametrize("text", ["{", "[1]", '{"cases": 3}', "\0"])
def test_damaged_cases_are_refused(tmp_path, text):
    for name, run in (("growth", growth.run), ("budget", study.run), ("heights", heights.run)):
        (tmp_path / f"{name}.json").write_text(text)
        with pytest.raises(ThermorenderError, match=f"{name}.json is damaged; remove it, or give another folder"):
            run(tmp_path)


@pytest.mark.slow
def test_stated_errors_are_compared_with_finer_frames(tmp_path, monkeypatch):
    folder = write_terrain(tmp_path / "tiny", height=np.random.default_rng(1).uniform(0, 1, (32, 32)))
    monkeypatch.setattr(study.scenes, "CHOSEN", ((12, -90),))
    monkeypatch.setattr(study.scenes, "HEIGHTS_M", (20.0, 60.0))
    monkeypatch.setattr(study.scenes, "made", lambda seed: [])
    found = study.run(tmp_path / "out", scene_names=(str(folder),), drawn=2)
    assert [(case["drawn"], case["quality"]) for case in found.values()] == [
        (False, "standard"), (False, "high"), (True, "standard"), (True, "standard")
    ]  # fmt: skip
    plain, fine = list(found.values())[:2]
    assert 0.0 < fine["true_mk"] < plain["true_mk"] < 3.0 * plain["stated_mk"] and plain["pixels"] > 1000
    assert (tmp_path / "out/budget.png").stat().st_size > 5000 and len(study.rows(found)) == 2
    assert study.summary(found)["views"] == 2
    # Existing cases are not measured again.
    monkeypatch.setattr(study, "converged", lambda *_: pytest.fail("measured a view that was there"))
    assert study.run(tmp_path / "out", scene_names=(str(folder),), drawn=2) == found


def test_made_scenes_match_their_names():
    scenes = {scene.name: (scene, views) for scene, views in made()}
    assert set(scenes) == {"random texels", "brass checker", "fire specks", "posts of 4 cm"}
    camera = scenes["random texels"][0].camera
    texels = 120.0 / camera.focal_length_px / scenes["random texels"][0].surfaces[0].texel_m
    assert texels == pytest.approx(2.5, rel=0.01)
    posts = scenes["posts of 4 cm"][0]
    assert posts.terrain_count == 1 and len(posts.surfaces) == 61
    assert np.ptp(posts.surfaces[1].vertices, axis=0) == pytest.approx([0.04, 0.04, 2.5])


# --- the verbs --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_errors_of_air_channels_are_below_the_plan(tmp_path, monkeypatch):
    scene = small(terrain(200))
    run = air.run
    monkeypatch.setattr("thermorender.scene.load.load_scene", lambda name: scene)
    few = {"heights_m": (120.0,), "tolerances_mk": (500.0, 20.0), "rays": 4, "repeats": 1}
    monkeypatch.setattr(air, "run", lambda *arguments, **keywords: run(*arguments, **keywords, **few))
    done = study_command("air", "-o", str(tmp_path), "--air", "tropical,urban-5km")
    assert done.exit_code == 0, done.output
    result = json.loads((tmp_path / "air.json").read_text())
    assert result["air"] == ["tropical", "urban-5km"] and (tmp_path / "air.png").stat().st_size > 5000
    assert [(case["view"], case["tolerance_mk"]) for case in result["cases"]] == [
        (view, tolerance) for view in bench.VIEWS for tolerance in (500.0, 20.0)
    ]
    for loose, tight in zip(result["cases"][::2], result["cases"][1::2], strict=True):
        assert loose["channels"] < tight["channels"] and tight["error_mk"] < loose["error_mk"]
        # The plan holds for any path and surface; the finest channels still have an error of half a millikelvin.
        # Channels and nodes each have their tolerance.
        for case in (loose, tight):
            assert case["error_mk"] < case["planned_mk"] + 0.5 and case["planned_mk"] < 2.0 * case["tolerance_mk"]
            assert case["frame_ms"] > 0.0 and case["over_vacuum"] > 0.0
    assert done.output.count("oblique") == 2


@pytest.mark.parametrize(
    ("verb", "module", "function", "expected"),
    [
        (["convergence", "heath/survey", "--quick"], convergence, "convergence",
         (["survey"], "OUT", "quick", False, "auto")),
        # It makes the drapes.
        *slow((["convergence", "--overwrite"], convergence, "convergence",
               (["heath", "village", "ridge"], "OUT", "full", True, "auto"))),
        (["growth", "--device", "cpu"], growth, "run", ("OUT", "cpu")),
        (["sensor", "heath/survey"], sensor, "sensor", ("OUT", "survey", "auto")),
        (["footage", "a.tif", "b", "--base", "tau2-640", "--scale", "0.04,1", "--name", "x"], sensor_statistics,
         "compare", (["a.tif", "b"], "OUT", "tau2-640", (0.04, 1.0), "heath", "x", "auto")),
        (["emissivity", "--seeds", "7, 8"], emissivity, "evaluate", ("procedural", [7, 8])),
    ],
)  # fmt: skip
def test_studies_receive_their_command_line_options(tmp_path, monkeypatch, verb, module, function, expected):
    asked = []

    def stand_in(*arguments, **keywords):
        asked.extend([*arguments, *keywords.values()])
        return {}

    monkeypatch.setattr(module, function, stand_in)
    if function in ("run", "evaluate", "compare"):
        monkeypatch.setattr(module, "rows", lambda result: [])
    monkeypatch.setattr(emissivity, "write_confusion", lambda result, path: path.write_text(""))
    done = study_command(*verb, "-o", str(tmp_path))
    assert done.exit_code == 0 and str(tmp_path) in "".join(done.output.split())
    given = tuple(item for item in asked if not callable(item))
    # Scenes and files by their names.
    given = tuple([getattr(one, "name", one) for one in item] if isinstance(item, list) else item for item in given)
    given = tuple(item.name if isinstance(item, Scene) else item for item in given)
    assert given == tuple(tmp_path if item == "OUT" else item for item in expected)


def test_bench_command_writes_its_result(tmp_path, monkeypatch):
    run = bench.bench
    few = {"settings": (("one", {"samples": 1, "rays": 4}),)}
    monkeypatch.setattr(bench, "bench", lambda *arguments, **keywords: run(*arguments, **keywords, **few))
    monkeypatch.setattr("thermorender.scene.load.load_scene", lambda name: small(terrain(200)))
    arguments = ["bench", "mine", "--repeats", "1", "-o", str(tmp_path / "b.json")]
    done = CliRunner().invoke(cli.app, arguments, catch_exceptions=False)
    assert done.exit_code == 0 and "200 triangles" in done.output
    (measured,) = json.loads((tmp_path / "b.json").read_text())["scenes"].values()
    assert measured["triangles"] == 200 and set(measured["settings"]) == {"one"}


def test_edits_measure_times_and_errors_of_each_kind(tmp_path, monkeypatch):
    folder = write_terrain(tmp_path / "land", 2.0 * np.indices((40, 40))[0] % 7)
    monkeypatch.setattr(edits, "POSE", (0.0, -10.0, 30.0))
    result = edits.run([folder], ["fast"], edits=2, exact_every=2)
    assert [case["kind"] for case in result["cases"]] == [*edits.KINDS, edits.SUCCESSION]
    (own,) = (each for each in verdicts.STUDIES if each.name == "edits")
    assert len(edits.rows(result)) == 5 and all(each.holds for each in own.read(result))
    for case in result["cases"]:
        assert ["solution_ms" in edit for edit in case["edits"]] == [False, True]
        assert case["edits"][1]["true_rms_mk"] < case["edits"][1]["stated_rms_mk"]
