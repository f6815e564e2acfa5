"""Comparisons from start to end: errors, findings of planted faults, notes, files and refusals."""

import csv
import json
import re
import shutil
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from compare_support import (
    BAND,
    DOWN,
    black,
    errors,
    flight,
    frames_of,
    kinds,
    rendered,
    summary_of,
    translated,
    uniform_map,
)

import thermorender as tr
from scenes import WEATHER, coarse, write_balance, write_terrain
from thermorender.apps.compare import (
    comparison,
    emissivities,
    figures,
    findings,
    report,
)
from thermorender.apps.compare import view as views
from thermorender.apps.compare.comparison import Options, compare
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import Correlation
from thermorender.learned.temperature_map import Inputs, TemperatureMap, load_model, save_map
from thermorender.output.photograph import photograph
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.camera import load_camera, model_path
from validation.referee.plants import zoomed

pytestmark = pytest.mark.usefixtures("short_heat")

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def without_drawings(monkeypatch):
    """Comparisons whose numbers alone count: drawing their frames takes most of the time."""
    monkeypatch.setattr(figures, "error_images", lambda *_: None)


@pytest.fixture(scope="module")
def planted(ground, tmp_path_factory):
    """A comparison of foreign frames with one fault each."""
    place = tmp_path_factory.mktemp("planted")
    other = place / "wrong"
    shutil.copytree(ground, other)
    text = (other / "scene.toml").read_text()
    # Sand with the emissivity of a bright metal.
    (other / "scene.toml").write_text(text.replace('2 = "sand_quartz"', '2 = "paint_metallic"'))
    earlier = []

    def late(kelvin, index):
        earlier.append(kelvin)
        return earlier[max(index - 1, 0)]

    folders = {
        "late": frames_of(ground, 5, place / "late", late, factor=2),
        "drifting": frames_of(ground, 5, place / "drifting", lambda kelvin, k: kelvin + 0.5 * (k - 2), factor=2),
        "zoomed": frames_of(ground, 5, place / "zoomed", lambda kelvin, k: zoomed(kelvin, 0.02), factor=2),
        "clipped": frames_of(ground, 5, place / "clipped", lambda kelvin, k: np.minimum(kelvin, 293.0), factor=2),
        "true": frames_of(ground, 5, place / "true", factor=2),
        "warm": frames_of(ground, 5, place / "warm", lambda kelvin, k: kelvin + 1.0, factor=2),
        "shifted": frames_of(ground, 5, place / "shifted", lambda kelvin, k: np.roll(kelvin, 2, axis=1), factor=2),
        "metal": frames_of(other, 5, place / "metal", factor=2),
    }
    flown = flight(ground, poses=5, factor=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "error_images", lambda *_: None)
        options = Options(foreign=folders, times_s={"true": 0.05, "warm": 0.4}, arrays=True, settings={"rays": 8})
        return compare([flown], place / "c", [], options)


def test_a_map_that_made_the_ground_has_no_error_and_is_called_circular(tmp_path):
    model = load_model("fok-1to1")
    colour = np.full((32, 32, 3), (150, 110, 90), np.uint8)
    kinetic = brightness_temperature(model.radiance(Inputs(colour)), *model.band_um)
    folder = black(write_terrain(tmp_path / "s", height=np.zeros((16, 16)), colour=colour, temperature=kinetic))
    found = compare([flight(folder, poses=1)], tmp_path / "c", ["fok-1to1"], Options(settings={"rays": 4}))
    for label in ("fok-1to1 on the photograph", "fok-1to1 as kelvin, true materials"):
        assert errors(found, label)["mae_k"] < 1e-3, label
    assert "circular" in kinds(found, rendered("fok-1to1")) and "circular" not in kinds(found, translated("fok-1to1"))
    page = (tmp_path / "c/report.html").read_text()
    assert "circular: the reference of s equals this method" in page and "class=grave" in page
    assert "<p>1 scene, 1 pose, " in page and page.count("Grey: no terrain") == 1
    assert "a constant and a mean per material are left out." in page
    assert "The frame&#x27;s own mean needs the truth of the frame itself." in page
    assert "heat balance of tables: the heat balance" not in page and "by a heat balance, with properties" in page
    # One material for all texels is assumed.
    words = "the map is applied to the orthophoto and rendered with the scene&#x27;s materials"
    assert f"<li>map as kelvin, true materials: {words}.</li>" in page
    main = page.split("<h2>Errors on ground</h2>")[1].split("</table>")[0]
    heads = re.findall("<th(?: class=words)?>([^<]*)</th>", main)
    assert len(heads) == 9 and "[K]" in main and "error [°C]" not in main
    # Short words, so that heads that wrap leave room for all columns on a page of 1280 pixels.
    assert max(len(word) for head in heads for word in head.split()) <= 9 and main.startswith("<div class=wide><table>")
    assert json.loads((tmp_path / "c/comparison.json").read_text())["methods"].keys() == found["methods"].keys()
    assert (tmp_path / "c/pictures/s_0000.png").stat().st_size > 10_000


def test_statistics_follow_from_pixels_csv(ground, tmp_path, without_drawings):
    level = uniform_map(tmp_path / "level.npz", 0.5)
    found = compare([flight(ground)], tmp_path / "c", [level], Options(settings={"rays": 8}))
    sums = defaultdict(lambda: np.zeros(4))
    with open(tmp_path / "c/pixels.csv", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            n = int(row["pixels"])
            values = (float(row[f"{name}_error_k"]) for name in ("mean", "mean_absolute", "root_mean_square"))
            mean, absolute, square = values
            sums[row["method"], row["stage"], row["surface"]] += n, n * mean, n * absolute, n * square**2
    for label in found["methods"]:
        for stage in ("radiometric", "sensor"):
            n, mean, absolute, square = sums[label, stage, "ground"]
            reported = errors(found, label, stage)
            assert reported["pixels"] == n
            assert reported["me_k"] == pytest.approx(mean / n, abs=1e-9)
            assert reported["mae_k"] == pytest.approx(absolute / n, abs=1e-9)
            assert reported["sd_k"] == pytest.approx(np.sqrt(square / n - (mean / n) ** 2), abs=1e-6)


def test_errors_equal_those_of_separately_rendered_frames(ground, tmp_path, without_drawings):
    level = uniform_map(tmp_path / "level.npz", 0.25)
    found = compare([flight(ground)], tmp_path / "c", [level], Options(arrays=True, settings={"rays": 8}))
    one = flight(ground)
    renderer, off = tr.Renderer(one.scene, rays=8), []
    cold, warm = band_radiance(np.array([280.0, 300.0]), *BAND)
    said = brightness_temperature(cold + 0.25 * (warm - cold), *BAND)
    for index, (time_s, pose) in enumerate(zip(one.times, one.poses, strict=True)):
        frame = renderer.frame(pose, time_s, index)
        off.append(said - frame.apparent_temperature[np.isfinite(frame.truth["depth"])].astype(float))
        kept = np.load(tmp_path / f"c/arrays/ground_{index:04d}.npz")
        assert np.array_equal(kept["reference"], frame.apparent_temperature)
        assert kept["level_on_the_photograph"].std() < 1e-3
    off = np.concatenate(off)
    reported = errors(found, "level on the photograph")
    assert reported["pixels"] == off.size and reported["me_k"] == pytest.approx(off.mean(), abs=2e-4)
    assert reported["mae_k"] == pytest.approx(np.abs(off).mean(), abs=2e-4)


@pytest.mark.slow
def test_frames_without_a_fault_have_no_findings(planted):
    assert kinds(planted, "true") == set() and errors(planted, "true")["mae_k"] < 0.02


def test_a_bias_of_one_kelvin_is_found(planted):
    (finding,) = [each for each in planted["findings"] if each["method"] == "warm"]
    assert finding["kind"] == "offset" and "offset of +1.00 K" in finding["says"]


def test_faults_that_vary_by_pose_or_grow_to_the_edge_or_with_temperature_are_found(planted):
    for name, kind, words in (
        ("late", "order", "its frames are late by 1 pose"), ("zoomed", "zoom", "its field of view is wrong by -2.0%"),
        ("drifting", "drift", "about its mean over the flight"),
        ("clipped", "clipping", "clipped above 293.0 K"),
    ):  # fmt: skip
        (finding,) = [each for each in planted["findings"] if each["method"] == name]
        assert finding["kind"] == kind and words in finding["says"], finding
        # What is named explains the error, so it is not in the headline.
        assert not any(line.startswith(f"{name}:") for line in findings.headline(planted)), name
        rmse_k = errors(planted, name)["rmse_k"]
        assert rmse_k > 0.3 and findings.unexplained(planted["methods"][name]) < 0.1
    (drift,) = planted["methods"]["drifting"]["causes"]["named"]
    # Four of the five poses are fitted.
    assert np.diff(drift["size"]) == pytest.approx([0.5, 1.0, 0.5], abs=0.05)


def test_run_times_of_other_programs_are_those_given(planted):
    times = {name: planted["methods"][name]["seconds_per_frame"] for name in ("true", "warm", "late")}
    assert times == {"true": 0.05, "warm": 0.4, "late": None}
    drawing = figures.error_and_time(planted)
    (axis,) = drawing.axes
    drawn = {round(float(x), 6) for line in axis.lines for x in line.get_xdata()}
    assert {50.0, 400.0} <= drawn and axis.get_xlabel() == "run time [ms per frame]"


def test_a_shift_of_two_pixels_is_found(planted):
    texts = [each["says"] for each in planted["findings"] if each["method"] == "shifted"]
    assert any("shifted by +2.0 px to the right and +0.0 px down" in text.replace("-0.0", "+0.0") for text in texts), (
        texts
    )


@pytest.mark.slow
def test_shifted_photographs_are_found(ground, tmp_path, monkeypatch):
    """Compared with the same map rendered, however large its error: here it is kelvins."""

    def shifted(*args, **kwargs):
        image, covered = photograph(*args, **kwargs)
        return np.roll(image, (-2, 2), axis=(0, 1)), covered

    flown = flight(ground, height=25.0)
    straight = compare([flown], tmp_path / "c", ["fok-1to1"], Options(settings={"rays": 8}))
    assert "shift" not in kinds(straight, "fok-1to1 on the photograph")
    monkeypatch.setattr(views, "photograph", shifted)
    found = compare([flown], tmp_path / "d", ["fok-1to1"], Options(settings={"rays": 8}))
    (finding,) = [each for each in found["findings"] if each["kind"] == "shift"]
    assert finding["method"] == translated("fok-1to1") and finding["says"].startswith("its pictures are shifted by ")
    assert finding["says"].endswith(" against fok-1to1 as kelvin, true materials")
    shift = found["methods"]["fok-1to1 on the photograph"]["registered"]
    assert shift["right_px"] == pytest.approx(2.0, abs=0.15) and shift["down_px"] == pytest.approx(-2.0, abs=0.15)


def test_a_wrong_emissivity_is_found(planted):
    reported = [each for each in planted["findings"] if each["kind"] == "emissivity"]
    assert reported and {each["method"] for each in reported} == {"metal"}
    for each in reported:
        assert each["says"].startswith("the error of sand_quartz") and "emissivity wrong by -" in each["says"]


def test_emissivities_of_a_rendered_scene_are_compared_with_the_true_ones(ground):
    true = tr.load_scene(ground)
    first = true.surfaces[0]
    names = [each.name for each in true.materials]
    wrong = replace(
        first,
        material=np.where(first.material == names.index("sand_quartz"), names.index("grass_green"), first.material),
    )
    found = emissivities.of_scenes(true.with_surfaces((wrong, *true.surfaces[1:])), true)
    texels, used, known, total = found["sand_quartz"]
    own = {each.name: each.band_emissivity(*BAND, 300.0) for each in true.materials}
    assert texels / total == pytest.approx(24 / 64)
    assert used / texels == pytest.approx(own["grass_green"], abs=1e-4)
    assert known / texels == pytest.approx(own["sand_quartz"], abs=1e-4)
    assert found["grass_green"][1] == pytest.approx(found["grass_green"][2])


@pytest.mark.slow
def test_terms_add_up_and_are_zero_where_nothing_changes(tmp_path):
    """A uniform, flat ground in one colour: only reflection and air differ on the photograph and as kelvin."""
    colour = np.full((64, 64, 3), (120, 100, 80), np.uint8)
    common = {"height": np.zeros((32, 32)), "colour": colour, "texel": 0.5, "classes": np.full((64, 64), 2)}
    level = uniform_map(tmp_path / "level.npz", 0.5)
    dark = black(write_terrain(tmp_path / "dark", **common))
    sand = write_terrain(tmp_path / "sand", **common, sky=200.0)
    misty = write_terrain(tmp_path / "misty", **common)
    text = (misty / "scene.toml").read_text()
    sky = '[atmosphere]\nstandard = "midlatitude-summer"\naerosol = "rural-5km"\n'
    (misty / "scene.toml").write_text(text[: text.index("[sky]")] + sky + text[text.index("[truth]") :])
    flights = [flight(each) for each in (dark, sand, misty)]
    found = compare(flights, tmp_path / "c", [level], Options(settings={"rays": 64}))
    parts = {scene["name"]: scene["terms"]["level"]["terms"] for scene in found["scenes"]}
    assert all(scene["terms_apart_mk"] <= 1.0 for scene in found["scenes"])
    for name, own in parts.items():
        assert own["geometry"]["mae_k"] < 2e-3 and own["emission"]["mae_k"] < 2e-3, name
        total = sum(own[term]["me_k"] for term in ("geometry", "emission", "reflection", "air", "sensor"))
        assert total == pytest.approx(own["whole"]["me_k"], abs=1e-3)
    assert parts["dark"]["reflection"]["mae_k"] < 2e-3 and parts["sand"]["air"]["mae_k"] < 2e-3
    # The sky of 200 K in place of the 255 K of the training, by hand.
    scene = tr.load_scene(sand)
    own = next(each for each in scene.materials if each.name == "sand_quartz")
    from thermorender.physics.band import emitted_radiance, kinetic_temperature

    cold, warm = band_radiance(np.array([280.0, 300.0]), *BAND)
    apparent = cold + 0.5 * (warm - cold)
    kelvin = kinetic_temperature(np.array([apparent]), own.emissivity_at, 255.0, BAND, (200.0, 400.0))
    sent = emitted_radiance(own.emissivity_at, kelvin, *BAND)
    sent = sent + band_radiance(200.0, *BAND) - emitted_radiance(own.emissivity_at, 200.0, *BAND)
    change = brightness_temperature(sent, *BAND)[0] - brightness_temperature(apparent, *BAND)
    assert parts["sand"]["reflection"]["me_k"] == pytest.approx(change, abs=0.02) and change < -0.3
    assert abs(parts["misty"]["air"]["me_k"]) > 0.02


@pytest.mark.slow
def test_pixels_without_temperature_have_no_terms(tmp_path):
    """The map predicts negative radiance for bright ground."""
    colour = np.full((64, 64, 3), 10, np.uint8)
    colour[:, 36:] = 220
    dark = Correlation(np.full((1, 1, 3), -4.0), 0.5)
    steep = TemperatureMap("steep", "correlation-1to1", dark, (280.0, 300.0), BAND,
                           0.5, (0.01, 5.0), "zenmuse-xt2", 255.0, "a test")  # fmt: skip
    save_map(steep, tmp_path / "steep.npz")
    folder = write_terrain(tmp_path / "land", np.zeros((32, 32)), colour=colour)
    options = Options(settings={"rays": 8})
    (scene,) = compare([flight(folder)], tmp_path / "c", [str(tmp_path / "steep.npz")], options)["scenes"]
    own = scene["terms"]["steep"]["terms"]
    assert scene["terms_apart_mk"] <= 1.0 and 0 < own["whole"]["pixels"] < 0.8 * 3 * 160 * 128
    assert len({each["pixels"] for each in own.values()}) == 1 and np.isfinite(own["emission"]["mae_k"])


@pytest.mark.slow
def test_a_scene_without_truth_has_differences_only(ground, tmp_path):
    folder = tmp_path / "real"
    shutil.copytree(ground, folder)
    text = (folder / "scene.toml").read_text().replace('[truth]\ntemperature = "temperature.tif"\n', "")
    (folder / "scene.toml").write_text(text)
    maps = [uniform_map(tmp_path / f"{name}.npz", level) for name, level in (("cool", 0.2), ("warm", 0.4))]
    found = compare([flight(folder)], tmp_path / "c", maps, Options(settings={"rays": 8}))
    assert all(own["errors"] is None for own in found["methods"].values())
    cold, warm = band_radiance(np.array([280.0, 300.0]), *BAND)
    said = brightness_temperature(cold + np.array([0.2, 0.4]) * (warm - cold), *BAND)
    pair = next(
        each
        for each in found["scenes"][0]["differences"]
        if (each["one"], each["other"]) == (translated("cool"), translated("warm"))
    )
    assert pair["me_k"] == pytest.approx(said[1] - said[0], abs=1e-3)
    page = (tmp_path / "c/report.html").read_text()
    assert "The true temperature of real is unknown" in page and "Errors on ground" not in page
    assert "rendered with the scene&#x27;s materials" in page and "rendered with true materials" not in page
    every = len(found["scenes"][0]["differences"])
    listed = page.split(f"<summary>All pairs ({every})</summary>")[1].split("</details>")[0]
    assert every == 15 and listed.count("<tr>") == every + 1
    assert "Mean absolute difference of each pair of methods." in page
    # The terms need no truth.
    assert found["scenes"][0]["terms"]["cool"]["terms"]["whole"]["pixels"] > 0
    assert "Why a map differs on the photograph and as kelvin" in page


def test_a_scene_without_truth_prints_differences_and_that_nothing_was_checked(ground, tmp_path, call):
    folder = shutil.copytree(ground, tmp_path / "real")
    text = (folder / "scene.toml").read_text().replace('[truth]\ntemperature = "temperature.tif"\n', "")
    (folder / "scene.toml").write_text(text)
    maps = [uniform_map(tmp_path / f"{name}.npz", level) for name, level in (("cool", 0.2), ("warm", 0.4))]
    (tmp_path / "log.csv").write_text(
        "time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n0,0,0,8,0,-90,0\n9,0,0,8,0,-90,0\n"
    )
    status, said, errors = call("compare", folder, "-o", tmp_path / "c", "--models", ",".join(maps), "--methods",
                                "photograph", "--trajectory", tmp_path / "log.csv", "--stop-s", "0", "--rays", "2",
                                )  # fmt: skip
    assert status == 0, errors
    head, row, rest, last = said.splitlines()
    assert head.split("  ")[0] == "method" and "mean difference [K]" in head and "RMS difference [K]" in head
    (scene,) = json.loads((tmp_path / "c/comparison.json").read_text())["scenes"]
    pair = scene["differences"][0]
    words = [translated(name) for name in ("warm", "cool")]
    assert row.startswith(words[0]) and row.split(words[1])[1].split()[0] == f"{pair['me_k']:+.3f}"
    assert pair["me_k"] > 1.0
    assert head.index("mean difference") == row.index("+") and scene["assumed_materials"]
    page = (tmp_path / "c/report.html").read_text()
    assert rest == "Without a truth, no error could be checked." and f"<p class=first>{rest}</p>" in page
    assert "nothing unusual" not in page and "1 scene, 1 pose, 2 methods." in page and last.startswith("report.html")
    # No errors to show, and no word on absent methods.
    assert "<option value=error>" not in page and "<li>map as kelvin" not in page and "<li>the frame" not in page


def test_a_computed_reference_is_not_called_true():
    assert "a render from the computed temperatures" in report.introduction(summary_of(computed=True))
    # The stated errors of the heat balance are those of its validation.
    sites = json.loads((ROOT / "validation/heat/heat.json").read_text())["sites"].values()
    for part, stated in (("day", comparison.BALANCE_DAY_K), ("night", comparison.BALANCE_NIGHT_K)):
        own = [site["scores"]["balance"].get(part, {}).get("mae", np.nan) for site in sites]
        assert stated == (round(np.nanmin(own), 1), round(np.nanmax(own), 1)), part


@pytest.mark.slow
def test_a_heat_balance_as_reference_is_labelled_with_its_error_and_left_out_methods_say_why(tmp_path):
    folder = write_balance(tmp_path / "solved", WEATHER, height=np.zeros((32, 32)))
    options = Options(kinds=("photograph", "balance"), settings={"rays": 2})
    found = compare([flight(folder, poses=1)], tmp_path / "c", ["procedural-trees+"], options)
    notes = " ".join(found["notes"])
    assert "The reference of solved is computed by the heat balance, not measured." in notes
    assert "0.3 to 3.1 K by day and 0.2 to 1.6 K by night" in notes
    assert "The heat balance of tables is left out of solved: the reference is that heat balance." in notes
    assert "procedural-trees+ on the photograph is left out: the map also takes " in notes
    page = (tmp_path / "c/report.html").read_text()
    assert "computed by the heat balance</td>" in page and "reference, computed" in page


def test_refusals_leave_nothing_behind(ground, tmp_path):
    one = flight(ground)
    level = uniform_map(tmp_path / "level.npz", 0.5)
    for message, flown, models, extra in (
        ("models is empty", [one], [], {}),
        ("two scenes are called 'ground'", [one, one], [level], {}),
        ("two methods are called 'level'", [one], [level, level], {}),
        (
            "run_time='other' is neither a map nor another program; give level",
            [one],
            [level],
            {"times_s": {"other": 1.0}},
        ),
        ("is not a folder", [one], [], {"foreign": {"theirs": tmp_path / "none"}}),
        ("lacks pose_0000.tif for scene 'ground'", [one], [], {"foreign": {"theirs": tmp_path}}),
    ):
        with pytest.raises(ThermorenderError, match=message):
            compare(flown, tmp_path / "c", models, Options(**extra))
    assert not (tmp_path / "c").exists()


def test_compare_reads_a_flight_log_as_fly_does(ground, tmp_path, call, monkeypatch):
    (tmp_path / "log.csv").write_text(
        "time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n0,0,0,60,0,0,0\n9,9,0,60,0,0,0\n"
    )
    taken = []

    def reported(flights, *_, **__):
        taken.extend(flights)
        raise ThermorenderError("seen")

    monkeypatch.setattr("thermorender.apps.compare.comparison.compare", reported)
    words = ("--mount", "0,-90,0", "--lever-arm-m", "0,0,2", "--clock-offset-s", "10", "--start-s", "12",
             "--stop-s", "15", "--rate-hz", "1")  # fmt: skip
    status, _, errors = call("compare", ground, "-o", tmp_path / "c", "--trajectory", tmp_path / "log.csv", *words)
    assert status != 0 and "seen" in errors
    (flown,) = taken
    assert flown.times.tolist() == [12.0, 13.0, 14.0, 15.0]
    here = flown.scene.ground(np.array([2.0]), np.array([0.0]))[0]
    # Straight down from two metres below the vehicle.
    assert flown.poses[0, :3, 3] == pytest.approx([2.0, 0.0, here + 58.0], abs=1e-4)
    assert flown.poses[0, :3, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-9)


def test_ground_is_followed_from_frame_to_frame(ground, tmp_path, without_drawings):
    """The reference changes by sampling only; a method that warms by 0.5 K per frame changes by that."""
    folders = {"drifting": frames_of(ground, 3, tmp_path / "drifting", lambda kelvin, k: kelvin + 0.5 * k)}
    found = compare([flight(ground)], tmp_path / "c", [], Options(foreign=folders, settings={"rays": 8}))
    own = found["scenes"][0]["steadiness_k"]
    assert found["methods"]["drifting"]["steadiness_k"] == pytest.approx(np.hypot(0.5, own), abs=0.03)
    assert 0.0 < own < 0.5


def test_the_registered_photograph_matches_that_of_the_visible_camera(ground, tmp_path, call):
    camera = load_camera("zenmuse-xt2").visible_camera
    assert camera.field_of_view_deg == pytest.approx((57.12, 42.44), abs=0.01) and camera.width == 4000
    folder = tmp_path / "s"
    shutil.copytree(ground, folder)
    text = model_path("zenmuse-xt2").read_text(encoding="utf-8")
    (folder / "small.toml").write_text(text.replace("visible_width = 4000", "visible_width = 1600"))
    with open(folder / "scene.toml", "a", encoding="utf-8") as file:
        file.write('\n[camera]\nmodel = "small.toml"\n')
    status, _, err = call("render", folder, "-o", tmp_path / "r", "--pose", "0,0,8,0,-90,0", "--products", "visible",
                           "--rays", "4")  # fmt: skip
    assert status == 0, err

    registered, whole = (cv2.imread(str(tmp_path / f"r/frame_000000_visible{end}.png")).astype(float)
                         for end in ("", "_camera"))  # fmt: skip
    assert registered.shape == (512, 640, 3) and whole.shape[1] == 1600
    # Position of the thermal camera's pixels in the wider picture: same axis, another focal length.
    thermal = load_camera("zenmuse-xt2")
    scale = 1600 / (2.0 * np.tan(np.radians(57.12 / 2.0))) / thermal.focal_length_px
    side = whole.shape[0]
    matrix = np.array(
        [[scale, 0.0, 800 - 320 * scale - 0.5 + 0.5 * scale], [0.0, scale, side / 2 - 256 * scale - 0.5 + 0.5 * scale]]
    )
    laid = cv2.warpAffine(whole, matrix, (640, 512), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    middle = np.s_[40:-40, 40:-40]
    assert np.abs(laid[middle] - registered[middle]).mean() < 2.0


@pytest.mark.slow
def test_a_wrong_contrast_is_found_and_no_emissivity_is_blamed(ground, planted, tmp_path):
    def damped(kelvin, index):
        return kelvin.mean() + 0.8 * (kelvin - kelvin.mean())

    frames = frames_of(ground, 3, tmp_path / "damped", damped)
    found = compare([flight(ground)], tmp_path / "c", [], Options(foreign={"damped": frames}, settings={"rays": 8}))
    gain = found["methods"]["damped"]["gain"]
    # Frames are stored in steps of 0.04 K, with a spread of several kelvin.
    assert gain["gain"] == pytest.approx(0.8, abs=0.002) and gain["explained"] > 0.98
    assert kinds(found, "damped") == {"contrast"}


@pytest.mark.slow
def test_pictures_with_almost_no_or_inverted_contrast_are_found(ground, tmp_path):
    folders = {
        name: frames_of(ground, 3, tmp_path / name, lambda kelvin, _, g=g: kelvin.mean() + g * (kelvin - kelvin.mean()))
        for name, g in (("grey", 0.1), ("turned", -1.0))
    }
    found = compare([flight(ground)], tmp_path / "c", [], Options(foreign=folders, settings={"rays": 8}))
    for name, gain in (("grey", "0.10"), ("turned", "-1.00")):
        (reported,) = [each["says"] for each in found["findings"] if each["method"] == name]
        assert reported.startswith(f"it shows {gain} of the reference's contrast")


def test_a_scene_and_its_trajectory_are_seen_once_per_second(ground, tmp_path):
    path = tr.Trajectory([0.0, 1.5], np.array([[0.0, 0.0, 8.0], [0.5, 0.0, 8.0]]), np.array([DOWN] * 2))
    options = Options(kinds=("photograph",), settings={"rays": 2, "samples": 1})
    found = tr.compare([(coarse(tr.load_scene(ground), 8), path)], tmp_path / "c", ["fok-1to1"], options)
    times = {row["time_s"] for row in csv.DictReader((tmp_path / "c/pixels.csv").read_text().splitlines())}
    assert len(found["scenes"]) == 1 and {float(time) for time in times} == {0.0, 1.0}
