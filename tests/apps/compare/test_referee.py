"""The comparison of methods with the radiometric render: its measures and its findings."""

import csv
import json
import re
import shutil
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import thermorender as tr
from scenes import WEATHER, coarse, write_balance, write_terrain
from thermorender.apps.compare import hot_spots
from thermorender.apps.compare.referee import (
    emissivities,
    findings,
    frames,
    methods,
    predictors,
    provenance,
    run,
    scores,
    structure,
    targets,
    training,
    trial,
    views,
)
from thermorender.apps.compare.referee.flight import Flight
from thermorender.apps.compare.referee.report import figures, introduction, tables
from thermorender.apps.compare.referee.run import Options, compare
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import Correlation
from thermorender.learned.temperature_map import Inputs, TemperatureMap, load_model, save_map
from thermorender.output.photograph import photograph
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.scene.spec import TemperatureSpec
from thermorender.sensor.camera import load_camera, model_path
from thermorender.sensor.radiometric_files import write_tlinear
from thermorender.sensor.readout import radiance_from_counts

ROOT = Path(__file__).resolve().parents[3]
DOWN = [0.0, 1.0, 0.0, 0.0]
BAND = (7.5, 13.5)


def flight(folder, height=8.0, poses=3, step=0.6, factor=4):
    """A Flight over a scene's folder, looking straight down, of a camera of `factor` times fewer pixels a side."""
    place = [[step * k, 0.4 * step * k, height] for k in range(poses)]
    path = tr.Trajectory(np.arange(float(poses)), np.array(place), np.array([DOWN] * poses))
    return Flight.of(coarse(tr.load_scene(folder), factor), path, 1.0)


def uniform_map(path, level, name=None, range_k=(280.0, 300.0), **about):
    """A map with the same temperature everywhere: intensity `level` of its range."""
    model = TemperatureMap(
        name or path.stem, "correlation-1to1", Correlation(np.zeros((1, 1, 3)), level), range_k, BAND, 0.5, (0.01, 5.0),
        "zenmuse-xt2", 255.0, "a test", about=about,
    )  # fmt: skip
    save_map(model, path)
    return str(path)


def black(folder):
    """Make all of a scene's folder black."""
    text = (folder / "scene.toml").read_text()
    start, end = text.index("[emissivity]"), text.index("[sky]")
    (folder / "scene.toml").write_text(text[:start] + '[emissivity]\nsource = "constant"\nvalue = 1.0\n' + text[end:])
    return folder


def frames_of(folder, poses, out, change=lambda kelvin, index: kelvin, factor=4):
    """Foreign frames of a scene: its own render, changed."""
    out.mkdir()
    one = flight(folder, poses=poses, factor=factor)
    renderer = tr.Renderer(one.scene, rays=8)
    for index, (time_s, pose) in enumerate(zip(one.times, one.poses, strict=True)):
        kelvin = renderer.frame(pose, time_s, index).apparent_temperature
        write_tlinear(out / f"pose_{index:04d}.tif", change(kelvin, index))
    return out


def structured(seed=3, side=64, spread=4.0):
    """A temperature field with structure of all sizes, (side, side) [K]."""
    rng = np.random.default_rng(seed)
    coarse = np.kron(rng.normal(size=(side // 8, side // 8)), np.ones((8, 8)))
    return 292.0 + spread * (coarse + 0.5 * rng.normal(size=(side, side)))


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ground") / "ground"
    classes = np.ones((64, 64), int)
    classes[:, 40:] = 2
    return write_terrain(folder, height=np.zeros((32, 32)), temperature=structured(), classes=classes)


def errors(summary, label, stage="radiometric", part="ground"):
    return summary["methods"][label]["errors"][stage][part]


def kinds(summary, label):
    return {each["kind"] for each in summary["findings"] if each["method"] == label}


def test_a_map_that_made_the_ground_has_no_error_and_is_called_circular(tmp_path):
    model = load_model("fok-1to1")
    colour = np.full((32, 32, 3), (150, 110, 90), np.uint8)
    kinetic = brightness_temperature(model.radiance(Inputs(colour)), *model.band_um)
    folder = black(write_terrain(tmp_path / "s", height=np.zeros((16, 16)), colour=colour, temperature=kinetic))
    found = compare([flight(folder, poses=1)], tmp_path / "c", ["fok-1to1"], Options(settings={"rays": 4}))
    for label in ("B fok-1to1", "C1 fok-1to1"):
        assert errors(found, label)["mae_k"] < 1e-3, label
    assert "circular" in kinds(found, "C1 fok-1to1") and "circular" not in kinds(found, "B fok-1to1")
    page = (tmp_path / "c/report.html").read_text()
    assert "circular: the reference of s equals this method" in page and "class=grave" in page
    assert "<p>1 scene, 1 pose, " in page and page.count("Grey: no terrain") == 1
    assert "D constant and E mean per material are left out." in page
    assert "D the frame&#x27;s own mean needs the truth of the frame itself." in page
    assert "F: the heat balance" not in page and "by a heat balance, with properties" in page
    # One material for all texels is assumed.
    assert "<li>C1: the map applied to the orthophoto and rendered with the scene&#x27;s materials.</li>" in page
    main = page.split("<h2>Errors on ground</h2>")[1].split("</table>")[0]
    heads = re.findall("<th(?: class=words)?>([^<]*)</th>", main)
    assert len(heads) == 16 and "[K]" in main and "error [°C]" not in main
    # Short words, so that heads that wrap leave room for all columns on a page of 1280 pixels.
    assert (
        max(len(word) for head in heads for word in head.split()) <= 9
        and main.startswith("<p")
        and "<div class=wide><table>" in main
    )
    assert json.loads((tmp_path / "c/comparison.json").read_text())["methods"].keys() == found["methods"].keys()
    assert (tmp_path / "c/pictures/s_0000.png").stat().st_size > 10_000


def test_statistics_follow_from_pixels_csv(ground, tmp_path):
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


def test_errors_equal_those_of_separately_rendered_frames(ground, tmp_path):
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
        assert np.array_equal(kept["reference"], frame.apparent_temperature) and kept["B_level"].std() < 1e-3
    off = np.concatenate(off)
    reported = errors(found, "B level")
    assert reported["pixels"] == off.size and reported["me_k"] == pytest.approx(off.mean(), abs=2e-4)
    assert reported["mae_k"] == pytest.approx(np.abs(off).mean(), abs=2e-4)


@pytest.fixture(scope="module")
def planted(ground, tmp_path_factory):
    """A comparison of foreign frames with one fault each."""
    place = tmp_path_factory.mktemp("planted")
    other = place / "wrong"
    shutil.copytree(ground, other)
    text = (other / "scene.toml").read_text()
    # Sand with the emissivity of a bright metal.
    (other / "scene.toml").write_text(text.replace('2 = "sand_quartz"', '2 = "paint_metallic"'))
    folders = {
        "true": frames_of(ground, 5, place / "true", factor=2),
        "warm": frames_of(ground, 5, place / "warm", lambda kelvin, k: kelvin + 1.0, factor=2),
        "shifted": frames_of(ground, 5, place / "shifted", lambda kelvin, k: np.roll(kelvin, 2, axis=1), factor=2),
        "metal": frames_of(other, 5, place / "metal", factor=2),
    }
    flown = flight(ground, poses=5, factor=2)
    return compare([flown], place / "c", [], Options(foreign=folders, arrays=True, settings={"rays": 8}))


@pytest.mark.slow
def test_frames_without_a_fault_have_no_findings(planted):
    assert kinds(planted, "foreign true") == set() and errors(planted, "foreign true")["mae_k"] < 0.02


def test_findings_are_grouped_by_kind_and_methods_with_the_same_finding_share_a_line():
    said = [
        (True, "B m", "leak", "seen"), (False, "C1 m", "offset", "of 1 K"), (False, "C2 m", "emissivity", "too high"),
        (False, "B m", "offset", "of 2 K"), (False, "C2 n", "emissivity", "too high"),
    ]  # fmt: skip
    reported = [dict(zip(("grave", "method", "kind", "says"), each, strict=True)) for each in said]
    assert findings.grouped(reported) == [
        ("Seen in training", True, ["B m: seen"]),
        ("Offset", False, ["C1 m: of 1 K", "B m: of 2 K"]),
        ("Wrong emissivity", False, ["C2 m, C2 n: too high"]),
    ]


def test_a_bias_of_one_kelvin_is_found(planted):
    (finding,) = [each for each in planted["findings"] if each["method"] == "foreign warm"]
    assert finding["kind"] == "offset" and "offset of +1.00 K" in finding["says"]


def test_a_shift_of_two_pixels_is_found(planted):
    texts = [each["says"] for each in planted["findings"] if each["method"] == "foreign shifted"]
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
    assert "shift" not in kinds(straight, "B fok-1to1")
    monkeypatch.setattr(views, "photograph", shifted)
    found = compare([flown], tmp_path / "d", ["fok-1to1"], Options(settings={"rays": 8}))
    (finding,) = [each for each in found["findings"] if each["kind"] == "shift"]
    assert finding["method"] == "B fok-1to1" and finding["says"].startswith("its pictures are shifted by ")
    assert finding["says"].endswith(" against C1 fok-1to1")
    shift = found["methods"]["B fok-1to1"]["registered"]
    assert shift["right_px"] == pytest.approx(2.0, abs=0.15) and shift["down_px"] == pytest.approx(-2.0, abs=0.15)


def test_a_wrong_emissivity_is_found(planted):
    reported = [each for each in planted["findings"] if each["kind"] == "emissivity"]
    assert reported and {each["method"] for each in reported} == {"foreign metal"}
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


class _Pairs:
    """A substitute for a Dataset: a name and training pictures."""

    def __init__(self, name, pictures):
        from types import SimpleNamespace

        self.card = {"name": name}
        self.entries = [SimpleNamespace(key=f"p{k}", part="train", picture=each) for k, each in enumerate(pictures)]

    def pair(self, entry, truth=True):
        from types import SimpleNamespace

        return SimpleNamespace(visible=entry.picture)


@pytest.mark.slow
def test_a_map_that_has_seen_the_scene_is_found(tmp_path):
    rng = np.random.default_rng(8)
    colour = np.kron(rng.integers(30, 220, (32, 32, 3)), np.ones((4, 4, 1), int)).astype(np.uint8)
    folder = write_terrain(tmp_path / "seen", height=np.zeros((64, 64)), colour=colour, texel=0.5)
    flown = flight(folder, height=25.0, factor=1)
    renderer = tr.Renderer(flown.scene, rays=2)
    taken = [photograph(renderer, pose)[0] for pose in flown.poses]
    foreign = rng.integers(0, 255, (3, 512, 640, 3)).astype(np.uint8)
    leaky = uniform_map(tmp_path / "leaky.npz", 0.5, dataset={"name": "theirs"})
    fair = uniform_map(tmp_path / "fair.npz", 0.4, dataset={"name": "others"})
    unknown = uniform_map(tmp_path / "unknown.npz", 0.3)
    # The same name, but more training pictures: another data set.
    larger = uniform_map(tmp_path / "larger.npz", 0.2, dataset={"name": "others"}, pairs={"train": 36, "validation": 4})
    data = [_Pairs("theirs", [*foreign, taken[1]]), _Pairs("others", list(foreign))]
    options = Options(datasets=data, settings={"rays": 2})
    found = compare([flown], tmp_path / "c", [leaky, fair, unknown, larger], options)
    (text,) = {each["says"] for each in found["findings"] if each["kind"] == "leak"}
    assert text.startswith("training has seen seen: 3 of 3 photographs") and "'p3'" in text
    assert "leak" in kinds(found, "B leaky") and "leak" not in kinds(found, "B fair")
    assert "what this map was trained on is unknown" in found["methods"]["B unknown"]["training"]["audited"]
    assert found["methods"]["B larger"]["training"]["audited"].count("not audited: it was trained on 40 pairs")
    assert "3 photographs" in found["methods"]["B fair"]["training"]["audited"]


@pytest.mark.slow
def test_bounds_are_refitted_on_other_lands_of_the_same_hour_and_weather(tmp_path):
    day = ('[weather]\ntime = 2018-07-28T14:30:00Z\nair_low_c = 9.0\nair_high_c = 22.0\nhumidity = 0.6\n'
           'wind_m_s = 3.0\ncloud = 0.2\n')  # fmt: skip
    other = day.replace("14:30", "06:30")
    rng = np.random.default_rng(1)
    relief = [rng.uniform(0.0, 0.3, (32, 32)) for _ in range(3)]
    folders = [
        black(write_terrain(tmp_path / name, relief[land], structured(land, spread=spread), extra=weather))
        for name, land, spread, weather in (
            ("a", 0, 4.0, day), ("b", 1, 1.0, day), ("c", 2, 9.0, other), ("a-again", 0, 30.0, day),
        )
    ]  # fmt: skip
    flown = [flight(folder) for folder in folders]
    found = compare(flown, tmp_path / "o", ["fok-1to1"], Options(settings={"rays": 2, "samples": 1}))
    reported = {scene["name"]: scene["campaign"] for scene in found["scenes"]}
    assert reported["c"] is None and reported["a"]["lands"] == 1
    # The range of `a` is that between the quartiles of what the camera reads over `b` alone.
    renderer, counts = tr.Renderer(flown[1].scene, rays=2, samples=1), []
    for index, pose in enumerate(flown[1].poses):
        frame = renderer.frame(pose, float(index), index)
        counts.append(frame.counts[np.isfinite(frame.truth["depth"])])
    first, third = np.quantile(np.concatenate(counts), [0.25, 0.75])
    camera = flown[1].scene.camera
    ends = radiance_from_counts(np.array([first - 1.5 * (third - first), third + 1.5 * (third - first)]), camera)
    expected = brightness_temperature(ends, *BAND) - 273.15
    assert reported["a"]["bounds_c"] == pytest.approx(expected, abs=0.02)
    assert reported["a-again"]["bounds_c"] == reported["a"]["bounds_c"] != reported["b"]["bounds_c"]
    labels = set(found["methods"])
    ways = {"fok-1to1", "fok-1to1, refitted", "fok-1to1, calibrated"}
    assert {f"{letter} {way}" for letter in ("B", "C1") for way in ways} <= labels
    assert {"D constant", "E mean per material"} <= labels
    assert len({scene["land"] for scene in found["scenes"]}) == 3


def test_a_land_is_the_same_under_snow_but_differs_from_other_lands(tmp_path):
    rng = np.random.default_rng(3)
    one, other = rng.uniform(0.0, 2.0, (2, 32, 32))
    snow = np.where(rng.uniform(size=one.shape) < 0.2, 0.03, 0.0)
    heights = {"bare": one, "snowy": one + snow, "other": other, "flat": np.zeros((32, 32))}
    # The ground's mesh is finer around an object.
    box = '[[object]]\nname = "box"\nshape = "box"\nposition = [1, 2, 0]\ntemperature = 330.0\nmaterial = "brass"\n'
    scenes = [
        tr.load_scene(write_terrain(tmp_path / name, height, extra=box if name == "snowy" else ""))
        for name, height in heights.items()
    ]
    assert len(scenes[0].surfaces[0].vertices) != len(scenes[1].surfaces[0].vertices)
    bare, snowy, *rest = training.lands_of(scenes)
    assert bare == snowy and len({bare, *rest}) == 3


@pytest.mark.slow
def test_calibration_removes_the_scale_of_a_map(tmp_path):
    """A map and one of half its contrast, inverted, have equal calibrated errors: those of the least-squares line by
    `np.polyfit` through the camera's radiances of the other land."""
    rng = np.random.default_rng(5)
    folders = []
    for k in range(2):
        warm = structured(k, spread=3.0)
        grey = np.clip(40.0 + 8.0 * (warm - 280.0) + rng.normal(0.0, 6.0, warm.shape), 0, 255).astype(np.uint8)
        folders.append(black(write_terrain(tmp_path / f"land{k}", rng.uniform(0.0, 0.3, (32, 32)), warm,
                                           colour=np.repeat(grey[..., None], 3, axis=-1), extra=WEATHER)))  # fmt: skip
    plain = TemperatureMap("plain", "correlation-1to1", Correlation(np.full((1, 1, 3), 0.4), 0.1), (280.0, 300.0), BAND,
                           0.5, (0.01, 5.0), "zenmuse-xt2", 255.0, "a test")  # fmt: skip
    turned = replace(plain, name="turned", range_k=(220.0, 330.0),
                     predictor=Correlation(np.full((1, 1, 3), -0.2), 0.9))  # fmt: skip
    files = []
    for model in (plain, turned):
        save_map(model, tmp_path / f"{model.name}.npz")
        files.append(str(tmp_path / f"{model.name}.npz"))
    flown = [flight(folder) for folder in folders]
    found = compare(flown, tmp_path / "c", files, Options(arrays=True, settings={"rays": 2}))
    own = {label: errors(found, label) for label in found["methods"]}
    for letter in ("B", "C1"):
        one, two = (own[f"{letter} {name}, calibrated"] for name in ("plain", "turned"))
        assert one["mae_k"] == pytest.approx(two["mae_k"], abs=1e-3)
        assert one["mae_k"] < own[f"{letter} plain, refitted"]["mae_k"]
        assert own[f"{letter} turned, refitted"]["mae_k"] > 2.0 * two["mae_k"]

    def said(visible, frame):
        depth = frame.truth["depth"]
        texel_m = float(np.median(depth[np.isfinite(depth)])) / flown[0].scene.camera.focal_length_px
        return plain.radiance(Inputs(visible, texel_m))

    seen, read = [], []
    renderer = tr.Renderer(flown[1].scene, rays=2)
    for k, pose in enumerate(flown[1].poses):
        frame, (visible, _) = renderer.frame(pose, float(k), k), photograph(renderer, pose, float(k))
        here = np.isfinite(frame.truth["depth"])
        seen.append(said(visible, frame)[here])
        read.append(radiance_from_counts(frame.counts[here].astype(float), flown[1].scene.camera))
    slope, zero = np.polyfit(np.concatenate(seen), np.concatenate(read).astype(float), 1)
    renderer = tr.Renderer(flown[0].scene, rays=2)
    visible, _ = photograph(renderer, flown[0].poses[0], 0.0)
    expected = zero + slope * said(visible, renderer.frame(flown[0].poses[0], 0.0, 0))
    expected = brightness_temperature(expected, *BAND)
    with np.load(tmp_path / "c" / "arrays" / "land0_0000.npz") as kept:
        assert np.abs(kept["B_plain__calibrated"] - expected)[kept["known"]].max() < 0.02


@pytest.mark.slow
def test_terms_add_up_and_are_zero_where_nothing_changes(tmp_path):
    """A uniform, flat ground in one colour: only reflection and air differ between B and C."""
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
    from thermorender.physics.band import emitted_radiance
    from thermorender.physics.surface import kinetic_temperature

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
def test_only_the_method_with_true_objects_knows_their_temperatures(tmp_path):
    hot = ('[[object]]\nname = "plate"\nshape = "disc"\nsize = [4.0, 4.0, 0.1]\nposition = [0.0, 0.0, 0.05]\n'
           'temperature = 360.0\nmaterial = "paint_black"\ncolour = [40, 40, 40]\n')  # fmt: skip
    folder = write_terrain(tmp_path / "s", height=np.zeros((32, 32)), extra=hot)
    level = uniform_map(tmp_path / "level.npz", 0.5)
    found = compare([flight(folder, height=15.0)], tmp_path / "c", [level], Options(settings={"rays": 8}))
    plain, true = (errors(found, label, part="objects")["me_k"] for label in ("C1 level", "C1 level, true objects"))
    assert plain < -50.0 and abs(true) < 1.0
    # Of radiance, so above that of temperature by a little.
    assert 0.0 < errors(found, "D the frame's own mean")["me_k"] < 0.2
    assert errors(found, "B level", part="objects")["me_k"] == pytest.approx(plain, abs=3.0)
    target = {
        label: found["methods"][label]["targets"]["objects"]["plate"] for label in ("B level", "C1 level, true objects")
    }
    assert target["B level"]["true_contrast_k"] > 50.0 and abs(target["B level"]["contrast_k"]) < 0.1
    assert target["C1 level, true objects"]["found"] == 1.0 and target["C1 level, true objects"]["offset_px"] < 2.0
    known = found["targets"]["objects"]["plate"]
    assert known["found"] == 1.0 and known["contrast_k"] == known["true_contrast_k"] > 50.0
    page = (tmp_path / "c" / "report.html").read_text(encoding="utf-8")
    assert "<td>reference</td>" in page.split("<h2>Targets</h2>")[1]


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
        each for each in found["scenes"][0]["differences"] if (each["one"], each["other"]) == ("B cool", "B warm")
    )
    assert pair["me_k"] == pytest.approx(said[1] - said[0], abs=1e-3)
    page = (tmp_path / "c/report.html").read_text()
    assert "The true temperature of real is unknown" in page and "Errors on ground" not in page
    assert "rendered with the scene&#x27;s materials" in page and "true materials" not in page
    every = len(found["scenes"][0]["differences"])
    listed = page.split(f"<summary>All pairs ({every})</summary>")[1].split("</details>")[0]
    assert every == 15 and listed.count("<tr>") == every + 1
    assert "Mean absolute difference of each pair of methods." in page
    # The terms of B and C need no truth.
    assert found["scenes"][0]["terms"]["cool"]["terms"]["whole"]["pixels"] > 0 and "Why B and C differ" in page


def test_a_scene_without_truth_prints_differences_and_that_nothing_was_checked(ground, tmp_path, call):
    folder = shutil.copytree(ground, tmp_path / "real")
    text = (folder / "scene.toml").read_text().replace('[truth]\ntemperature = "temperature.tif"\n', "")
    (folder / "scene.toml").write_text(text)
    maps = [uniform_map(tmp_path / f"{name}.npz", level) for name, level in (("cool", 0.2), ("warm", 0.4))]
    (tmp_path / "log.csv").write_text(
        "time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n0,0,0,8,0,-90,0\n9,0,0,8,0,-90,0\n"
    )
    status, said, errors = call("compare", folder, "-o", tmp_path / "c", "--models", ",".join(maps), "--methods", "B",
                                "--trajectory", tmp_path / "log.csv", "--stop-s", "0", "--rays", "2")  # fmt: skip
    assert status == 0, errors
    head, row, rest, last = said.splitlines()
    assert head.split("  ")[0] == "method" and "mean difference [K]" in head and "RMS difference [K]" in head
    (scene,) = json.loads((tmp_path / "c/comparison.json").read_text())["scenes"]
    pair = scene["differences"][0]
    assert row.split()[:5] == ["B", "warm", "B", "cool", f"{pair['me_k']:+.3f}"] and pair["me_k"] > 1.0
    assert head.index("mean difference") == row.index("+") and scene["assumed_materials"]
    page = (tmp_path / "c/report.html").read_text()
    assert rest == "Without a truth, no error could be checked." and f"<p>{rest}</p>" in page
    assert "Nothing unusual" not in page and "1 scene, 1 pose, 2 methods." in page and last.startswith("report.html")
    # No errors to show, and no word on absent methods.
    assert "<option value=error>" not in page and "<li>C1" not in page and "<li>D the frame" not in page


def summary_of(methods=(), references=(True,), assumed=False, computed=False):
    """A comparison's summary with its methods, (label, letter, bounds) each, and scenes with or without reference."""
    return {
        "methods": {label: {"letter": letter, "bounds": bounds, "true_objects": label.endswith("true objects")}
                    for label, letter, bounds in methods},
        "scenes": [{"reference": known, "poses": 1, "assumed_materials": assumed, "computed": computed}
                   for known in references],
        "findings": [], "notes": [],
    }  # fmt: skip


def test_the_introduction_explains_the_methods_of_the_run_only():
    few = summary_of([("B m", "B", "own"), ("C1 m", "C1", "own")])
    assert [name for name, _ in introduction.explained(few)] == ["B", "C1"]
    assert "rendered with true materials" in dict(introduction.explained(few))["C1"]
    more = summary_of([("D the frame's own mean", "D", None), ("C1 m, calibrated", "C1", "calibrated"),
                       ("C1 m, true objects", "C1", "own")], assumed=True)  # fmt: skip
    found = dict(introduction.explained(more))
    assert list(found) == ["C1", "D the frame's own mean", "calibrated", "true objects"]
    assert "rendered with the scene's materials" in found["C1"]
    page = introduction.introduction(more)
    assert "1 scene, 1 pose, 3 methods." in page and "true temperatures and the scene&#x27;s materials" in page
    assert "Errors are" not in introduction.introduction(summary_of(references=(False, False)))


def test_a_computed_reference_is_not_called_true():
    assert "a render from the computed temperatures" in introduction.introduction(summary_of(computed=True))
    # The stated errors of the heat balance are those of its validation.
    sites = json.loads((ROOT / "validation/heat/heat.json").read_text())["sites"].values()
    for part, stated in (("day", run.BALANCE_DAY_K), ("night", run.BALANCE_NIGHT_K)):
        own = [site["scores"]["balance"].get(part, {}).get("mae", np.nan) for site in sites]
        assert stated == (round(np.nanmin(own), 1), round(np.nanmax(own), 1)), part


@pytest.mark.slow
def test_a_heat_balance_as_reference_is_labelled_with_its_error_and_left_out_methods_say_why(tmp_path):
    folder = write_balance(tmp_path / "solved", WEATHER, height=np.zeros((32, 32)))
    options = Options(letters=("B", "F"), settings={"rays": 2})
    found = compare([flight(folder, poses=1)], tmp_path / "c", ["procedural-trees+"], options)
    notes = " ".join(found["notes"])
    assert "The reference of solved is computed by the heat balance, not measured." in notes
    assert "0.3 to 3.1 K by day and 0.2 to 1.6 K by night" in notes
    assert "F, the heat balance of tables, is left out of solved: the reference is that heat balance." in notes
    assert "B procedural-trees+ is left out: the map also takes " in notes
    page = (tmp_path / "c/report.html").read_text()
    assert "computed by the heat balance</td>" in page and "reference, computed" in page


def test_each_frame_has_its_own_scale_beside_the_common_one(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "_figure", lambda figure=figures._figure: (
        lambda **options: drawn.append(figure()[0](**options)) or drawn[-1], figure()[1]))  # fmt: skip
    truth = np.linspace(290.0, 300.0, 64 * 80).reshape(64, 80).astype(np.float32)
    view = SimpleNamespace(truth=truth, known=np.ones(truth.shape, bool), visible=np.zeros((64, 80, 3), np.uint8))
    figures.error_images(tmp_path / "a.png", view, {"cold": truth - 40.0}, "reference, computed")
    axes = [axis for axis in drawn[0].axes if axis.images]
    titles = {axis.get_title(): axis.images[0].get_clim() for axis in axes}
    (name,) = [title for title in titles if title.startswith("own scale, ")]
    common, own = titles["cold"], titles[name]
    assert name == f"own scale, {own[0]:.1f}…{own[1]:.1f} °C"
    assert titles["reference, computed"] == common == pytest.approx((16.95, 26.75), abs=0.01)
    assert own == pytest.approx((common[0] - 40.0, common[1] - 40.0), abs=0.01) and "error" in titles


def test_only_scenes_with_a_truth_count_as_checked():
    assert findings.nothing(summary_of()) == "Nothing unusual was found."
    assert (
        findings.nothing(summary_of(references=(True, False))) == "Nothing unusual was found where the truth is known."
    )
    assert findings.nothing(summary_of(references=(False,))) == "Without a truth, no error could be checked."
    assert findings.nothing({**summary_of(), "findings": [{}]}) is None


def test_tables_of_the_terminal_are_in_kelvin():
    ground = {"me_k": -1.0, "mae_k": 2.0, "sd_k": 3.0, "rmse_k": 4.0, "pixels": 5,
              "interval_95": {"me_k": None, "mae_k": (1.5, 2.5)}}  # fmt: skip
    pairs = [("a", "b", 1.0), ("a", "c", None), ("b", "c", 3.0)]
    apart = [{"one": one, "other": other, "me_k": k, "mae_k": k, "rmse_k": k, "pixels": 7} for one, other, k in pairs]
    summary = {"methods": {"B m": {"errors": {"radiometric": {"ground": ground}}}, "a": {"errors": None}},
               "scenes": [{"name": "known", "differences": []}, {"name": "real", "differences": apart}]}  # fmt: skip
    (errors_head, error_rows), (head, rows) = tables.of(summary)
    assert error_rows == [("B m", "-1.000", "2.000", "1.50…2.50", "3.000", "4.000", "5")]
    assert rows == [("", "b", "a", "+1.000", "1.000", "1.000", "7"), ("", "c", "a", "none", "none", "none", "7")]
    assert len(errors_head) == len(error_rows[0]) and len(head) == len(rows[0]) and "°C" not in str(errors_head)
    summary["scenes"].append({"name": "other", "differences": apart[:1]})
    assert [row[0] for row in tables.differences(summary)] == ["real", "real", "other"]


def test_axes_have_plain_numbers_and_legends_can_be_read(monkeypatch):
    monkeypatch.setattr(figures, "_png", lambda drawing, pyplot: drawing)
    own = [{"letter": letter, "map": "m", "bounds": "own", "seconds_per_frame": 0.01 * (k + 1),
            "errors": {"radiometric": {"ground": {"mae_k": 4.0 + 2.0 * k}}}}
           for k, letter in enumerate(("B", "C1"))]  # fmt: skip
    drawing = figures.against_time({"methods": dict(enumerate(own))})
    drawing.canvas.draw()
    (axis,) = drawing.axes
    labels = [each.get_text() for which in ("major", "minor") for each in axis.get_yticklabels(which=which)]
    assert {"4", "5", "6"} <= set(labels) and not any("$" in label for label in labels)
    assert axis.get_title() == "○ 2D translation  □ rendered"
    # Points of a figure at its resolution are larger than those of a page, of which 72 are 96 pixels.
    sizes = [each.get_fontsize() * figures._DPI / 96.0 for each in axis.get_legend().get_texts()]
    assert sizes and min(sizes) >= 9.0


def test_the_photograph_is_grey_where_there_is_no_terrain():
    known = np.array([[True, False, False]])
    view = SimpleNamespace(known=known, visible=np.array([[[0, 0, 0], [0, 0, 0], [90, 120, 200]]], np.uint8))
    shown = figures.shown_photograph(view)
    # Black ground stays black, and the sky blue.
    assert shown.tolist() == [[[0, 0, 0], [136, 136, 136], [90, 120, 200]]] and not view.visible[0, 1].any()


def test_refusals_leave_nothing_behind(ground, tmp_path):
    one = flight(ground)
    level = uniform_map(tmp_path / "level.npz", 0.5)
    for message, flown, models, extra in (
        ("models is empty", [one], [], {}),
        ("two scenes are called 'ground'", [one, one], [level], {}),
        ("two methods are called 'level'", [one], [level, level], {}),
        ("is not a folder", [one], [], {"foreign": {"theirs": tmp_path / "none"}}),
        ("lacks pose_0000.tif for scene 'ground'", [one], [], {"foreign": {"theirs": tmp_path}}),
    ):
        with pytest.raises(ThermorenderError, match=message):
            compare(flown, tmp_path / "c", models, Options(**extra))
    assert not (tmp_path / "c").exists()


def test_names_cannot_break_the_page(ground, tmp_path):
    nasty = uniform_map(tmp_path / "n.npz", 0.5, name="<script>alert(1)<script>")
    compare([flight(ground, poses=1)], tmp_path / "c", [nasty], Options(settings={"rays": 2}))
    page = (tmp_path / "c/report.html").read_text()
    assert "<script>alert" not in page.replace("\\u003c", "") and "&lt;script&gt;alert" in page
    assert "rendered with true materials" in page


def test_spectrum_of_white_noise_is_its_variance():
    rng = np.random.default_rng(2)
    known = np.ones((512, 640), bool)
    total = 0.0
    for _ in range(8):
        found = structure.transform(rng.normal(0.0, 0.5, known.shape), known)
        frequency, density = structure.power(found)
        total = total + density / 8
    high = frequency > 0.05
    assert total[high].mean() == pytest.approx(0.25, rel=0.01) and frequency[-1] == 0.5


@pytest.mark.parametrize(("right", "down", "sign"), [(2.0, 0.0, 1), (-3.4, 1.7, 1), (0.0, 5.0, -1), (0.0, 0.0, 1)])
def test_a_shift_is_measured_to_a_tenth_of_a_pixel(right, down, sign):
    from scipy.ndimage import fourier_shift, gaussian_filter

    rng = np.random.default_rng(4)
    image = gaussian_filter(rng.normal(size=(512, 640)), 1.5)
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(image), (down, right))).real
    known = np.ones(image.shape, bool)
    found = structure.Structure()
    for _ in range(2):
        noise = 0.3 * image.std() * rng.normal(size=image.shape)
        found.add(structure.transform(sign * moved + noise, known), structure.transform(image, known))
    shift = found.registration.summary()
    assert shift["right_px"] == pytest.approx(right, abs=0.1) and shift["down_px"] == pytest.approx(down, abs=0.1)
    assert np.sign(shift["correlation"]) == sign and max(shift["error_px"]) < 0.1
    # The data stored for each of hundreds of methods are small: no view of a whole picture.
    assert all(one.base is None and one.size < 100**2 for one in found.registration.surfaces)


def test_compare_reads_a_flight_log_as_fly_does(ground, tmp_path, call, monkeypatch):
    (tmp_path / "log.csv").write_text(
        "time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n0,0,0,60,0,0,0\n9,9,0,60,0,0,0\n"
    )
    taken = []

    def reported(flights, *_, **__):
        taken.extend(flights)
        raise ThermorenderError("seen")

    monkeypatch.setattr("thermorender.apps.compare.referee.run.compare", reported)
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


def test_ground_is_followed_from_frame_to_frame(ground, tmp_path):
    """The reference changes by sampling only; a method that warms by 0.5 K per frame changes by that."""
    folders = {"drifting": frames_of(ground, 3, tmp_path / "drifting", lambda kelvin, k: kelvin + 0.5 * k)}
    found = compare([flight(ground)], tmp_path / "c", [], Options(foreign=folders, settings={"rays": 8}))
    own = found["scenes"][0]["steadiness_k"]
    assert found["methods"]["foreign drifting"]["steadiness_k"] == pytest.approx(np.hypot(0.5, own), abs=0.03)
    assert 0.0 < own < 0.5


def test_effective_pixels_of_independent_and_of_common_errors():
    rng = np.random.default_rng(6)
    pixels, blocks = 400, 150
    for common, expected in ((False, pixels * blocks), (True, blocks)):
        error = rng.normal(size=(blocks, pixels if not common else 1)) + np.zeros((blocks, pixels))
        from thermorender.apps.compare.evaluation import sums

        rows = np.array([sums.row(each) for each in error])
        found = scores.intervals({"poses": rows}, error.std(), seed=0)
        assert found["effective_pixels"] == pytest.approx(expected, rel=0.35), common
        low, high = found["interval_95"]["me_k"]
        assert low < 0.0 < high or common is False


def test_the_widest_interval_of_poses_blocks_and_scenes_is_reported():
    from thermorender.apps.compare.evaluation import sums

    rng = np.random.default_rng(7)
    alike = np.array([sums.row(rng.normal(size=500)) for _ in range(40)])
    apart = np.array([sums.row(rng.normal(size=500) + offset) for offset in rng.normal(size=40)])
    for names in (("poses", "scenes"), ("scenes", "poses")):
        assert scores.intervals(dict(zip(names, (alike, apart), strict=True)), 1.0, 0)["drawn"] == names[1]
    # Where scenes differ, they limit the mean, however many poses each has.
    tally, other = scores.Tally(), scores.Tally()
    offsets = rng.normal(0.0, 3.0, 12)
    for number, offset in enumerate(offsets):
        for one, own in ((tally, offset), (other, offset + rng.normal(0.0, 0.1))):
            rows = [sums.row(own + rng.normal(size=500)) for _ in range(5)]
            one.poses.setdefault((scores.RADIOMETRIC, "ground"), []).extend(rows)
            one.scenes[scores.RADIOMETRIC, f"s{number}"] = sum(rows)
    found = tally.summary(0)[scores.RADIOMETRIC]["ground"]
    low, high = found["interval_95"]["me_k"]
    assert found["drawn"] == "scenes" and high - low == pytest.approx(3.92 * offsets.std() / 12**0.5, rel=0.2)
    # The difference of two methods in the same scenes is known far better.
    more = other.more_than(tally, 0)
    assert more["mae_k"] == pytest.approx(more["own_mae_k"] - more["other_mae_k"]) and np.ptp(more["interval_95"]) < 0.3
    other.scenes.pop((scores.RADIOMETRIC, "s3"))
    assert other.more_than(tally, 0) is None and tally.more_than(other, 0)["interval_95"]


def test_the_detector_finds_a_disc_and_nothing_in_noise():
    rng = np.random.default_rng(9)
    image = rng.normal(8000.0, 10.0, (256, 320))
    rows, columns = np.mgrid[:256, :320]
    disc = np.hypot(rows - 100, columns - 200) < 3
    found = hot_spots.response(image + 60.0 * disc, 5.0)
    row, column, value = (each[0] for each in hot_spots.peaks(found, 5.0, 5.0))
    assert np.hypot(row - 100, column - 200) <= 1.5 and value > 8.0
    assert not len(hot_spots.peaks(hot_spots.response(image, 5.0), 5.0, 6.0)[0])


def test_warm_and_cold_targets_are_found_but_not_a_misplaced_one():
    from types import SimpleNamespace

    rng = np.random.default_rng(12)
    rows, columns = np.mgrid[:256, :320]
    places = {"warm": (100, 200), "cold": (60, 80), "elsewhere": (180, 120)}
    number, truth = np.full(rows.shape, -1), np.full(rows.shape, 290.0)
    for k, (name, (row, column)) in enumerate(places.items()):
        disc = np.hypot(rows - row, columns - column) < 4
        number[disc] = k
        # The last one is shown 15 px from its place.
        away = 15 if name == "elsewhere" else 0
        truth[np.hypot(rows - row, columns - column - away) < 4] += -12.0 if name == "cold" else 12.0
    view = SimpleNamespace(object=number, known=np.ones(rows.shape, bool), truth=truth, index=0)
    found = targets.Targets()
    found.add("s", view, list(places), truth, 8000.0 + 25.0 * (truth - 290.0) + rng.normal(0.0, 10.0, rows.shape))
    reported = found.summary()["objects"]
    assert {name: own["found"] for name, own in reported.items()} == {"warm": 1.0, "cold": 1.0, "elsewhere": 0.0}
    assert reported["cold"]["contrast_k"] == reported["cold"]["true_contrast_k"] == pytest.approx(-12.0, abs=0.5)
    assert reported["cold"]["offset_px"] < 2.0


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
    import cv2

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
def test_learned_materials_do_not_change_objects():
    scene = tr.load_scene("heath")
    reported = scene.with_learned_materials(methods.learned_materials())
    for before, after in zip(scene.surfaces[1:], reported.surfaces[1:], strict=True):
        assert [scene.materials[k].name for k in np.unique(before.material)] == [
            reported.materials[k].name for k in np.unique(after.material)
        ]
    assert (
        reported.emissivity_report["model"] == "procedural"
        and reported.surfaces[0].material.shape == scene.surfaces[0].material.shape
    )


def test_means_of_the_training_part_are_means_of_radiance():
    histogram = training.Histogram()
    histogram.add(np.array([8000, 8200, 8400, 8600], np.uint16))
    radiance = band_radiance(np.array([290.0, 300.0]), *BAND)
    thermal = training.Thermal(
        "a", "day", histogram, {"grass": 2 * radiance[0], "sand": 2 * radiance[1]}, {"grass": 2, "sand": 2}, {}
    )
    own = replace(thermal, land="b")
    found = training.training_of(own, [thermal, own], load_camera("zenmuse-xt2"))
    assert found.material_k == pytest.approx({"grass": 290.0, "sand": 300.0}, abs=1e-3)
    assert found.mean_k == pytest.approx(brightness_temperature(radiance.mean(), *BAND), abs=1e-3)
    assert training.training_of(own, [own], load_camera("zenmuse-xt2")) is None
    assert training.training_of(own, [replace(thermal, campaign="night")], load_camera("zenmuse-xt2")) is None


def test_provenance_is_read_from_the_file_of_a_map():
    model = load_model("procedural-palette")
    own = provenance.provenance_of(model)
    assert own.header["data set"] == "campaign" and own.header["pairs"]["train"] == 1620
    assert "not audited" in own.audited


@pytest.mark.slow
def test_a_wrong_contrast_is_found_and_no_emissivity_is_blamed(ground, planted, tmp_path):
    def damped(kelvin, index):
        return kelvin.mean() + 0.8 * (kelvin - kelvin.mean())

    frames = frames_of(ground, 3, tmp_path / "damped", damped)
    found = compare([flight(ground)], tmp_path / "c", [], Options(foreign={"damped": frames}, settings={"rays": 8}))
    gain = found["methods"]["foreign damped"]["gain"]
    # Frames are stored in steps of 0.04 K, with a spread of several kelvin.
    assert gain["gain"] == pytest.approx(0.8, abs=0.002) and gain["explained"] > 0.98
    assert kinds(found, "foreign damped") == {"contrast"}


def test_a_shift_of_forty_pixels_and_one_of_a_single_pose_are_found(tmp_path):
    rng = np.random.default_rng(2)
    image = 290.0 + gaussian_filter(rng.normal(size=(256, 256)), 1.5) * 20.0
    moved = np.roll(image, (25, -40), (0, 1))
    known = np.ones(image.shape, bool)
    pair = [structure.transform(each, known) for each in (moved, image)]
    registration = structure.Registration()
    registration.add(*pair)
    found = registration.summary()
    assert found["right_px"] == pytest.approx(-40.0, abs=0.1) and found["down_px"] == pytest.approx(25.0, abs=0.1)
    assert found["error_px"] is None and found["correlation"] > 0.5
    for _ in range(40):
        registration.add(*pair)
    assert len(registration.surfaces) < registration.poses == 41
    assert registration.summary()["right_px"] == pytest.approx(found["right_px"]) and registration.summary()["error_px"]


@pytest.mark.slow
def test_pictures_with_almost_no_or_inverted_contrast_are_found(ground, tmp_path):
    folders = {
        name: frames_of(ground, 3, tmp_path / name, lambda kelvin, _, g=g: kelvin.mean() + g * (kelvin - kelvin.mean()))
        for name, g in (("grey", 0.1), ("turned", -1.0))
    }
    found = compare([flight(ground)], tmp_path / "c", [], Options(foreign=folders, settings={"rays": 8}))
    for name, gain in (("grey", "0.10"), ("turned", "-1.00")):
        (reported,) = [each["says"] for each in found["findings"] if each["method"] == f"foreign {name}"]
        assert reported.startswith(f"it shows {gain} of the reference's contrast")


def test_kept_frames_have_unique_names():
    found = trial.array_names(["B a.b", "B a b", "known"])
    assert list(found.values()) == ["B_a_b", "B_a_b_2", "known_2"]


def test_foreign_frames_are_checked_before_anything_is_rendered(ground, tmp_path):
    celsius = frames_of(ground, 3, tmp_path / "celsius", lambda kelvin, index: kelvin - 273.15)
    with pytest.raises(ThermorenderError, match="below 100 K"):
        compare([flight(ground)], tmp_path / "c", [], Options(foreign={"celsius": celsius}, settings={"rays": 8}))
    small = frames_of(ground, 3, tmp_path / "small", lambda kelvin, index: kelvin[::2])
    with pytest.raises(ThermorenderError, match="pixels, but the camera has"):
        compare([flight(ground)], tmp_path / "c", [], Options(foreign={"small": small}, settings={"rays": 8}))
    level = uniform_map(tmp_path / "small.npz", 0.5)
    with pytest.raises(ThermorenderError, match="two methods are called 'small'"):
        compare([flight(ground)], tmp_path / "c", [level], Options(foreign={"small": small}, settings={"rays": 8}))
    assert not (tmp_path / "c").exists()


@pytest.mark.slow
def test_a_picture_is_translated_once_for_all_bounds_and_its_time_counts_for_each(tmp_path, monkeypatch):
    asked = []
    plain = Correlation.predict

    def counted(self, inputs, texel_m):
        asked.append(inputs.rgb.shape)
        time.sleep(0.05)
        return plain(self, inputs, texel_m)

    monkeypatch.setattr(Correlation, "predict", counted)
    heights = np.random.default_rng(1).uniform(0.0, 0.3, (2, 32, 32))
    lands = [write_terrain(tmp_path / f"land{k}", heights[k], structured(5 + k), extra=WEATHER) for k in range(2)]
    flights = [flight(each, poses=2) for each in lands]
    reported = compare(flights, tmp_path / "c", [uniform_map(tmp_path / "m.npz", 0.5)], Options(settings={"rays": 8}))
    texels = flights[0].scene.surfaces[0].colour.shape
    photograph_of = (flights[0].scene.camera.height, flights[0].scene.camera.width, 3)
    # The photographs are translated once more, to calibrate the map for the other land.
    assert asked.count(texels) == len(lands) and asked.count(photograph_of) == 2 * 2 * len(lands)
    own = {label: found for label, found in reported["methods"].items() if found["map"] == "m"}
    ways = ["m", "m, calibrated", "m, refitted"]
    assert sorted(own) == [*(f"{letter} {way}" for letter in ("B", "C1") for way in ways), "C2 m, calibrated"]
    for label, found in own.items():
        assert (found["seconds_per_frame"] if label[0] == "B" else found["once_s"]) >= 0.05, label


def test_remembered_predictions_differ_by_every_input_of_a_map():
    class Told:
        needs, above_air, header, arrays = frozenset({"terrain", "conditions"}), True, None, None
        asked = 0

        def predict(self, inputs, texel_m):
            self.asked += 1
            time.sleep(0.02)
            return np.full(inputs.rgb.shape[:2], float(self.asked))

    rgb, slope = np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32)
    first = Inputs(rgb, 0.2, {"slope": slope}, {"air_k": 280.0})
    others = [replace(first, rgb=rgb + 1), replace(first, texel_m=0.3), replace(first, terrain={"slope": slope + 1}),
              replace(first, conditions={"air_k": 281.0}), replace(first, depth=slope),
              replace(first, terrain={"height": slope}), replace(first, rgb=rgb.reshape(2, 8, 3))]  # fmt: skip
    kept = predictors.Remembered(Told())
    for number, inputs in enumerate((first, *others), 1):
        assert (kept.predict(inputs, 0.2) == number).all()
    again = replace(first, rgb=rgb.copy(), terrain={"slope": slope.copy()})
    before = kept.spared_s
    # The time of fingerprints is subtracted.
    assert (kept.predict(again, 0.2) == 1).all() and before < 0.0 < kept.spared_s - before
    last = predictors.Remembered(Told(), most=1)
    assert [last.predict(each, 0.2)[0, 0] for each in (first, first, others[0], first)] == [1, 1, 2, 3]


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [None, "facts.json", "0000.npy"])
def test_an_interrupted_comparison_continues_with_the_missing_frames(ground, tmp_path, monkeypatch, damaged):
    level = uniform_map(tmp_path / "level.npz", 0.5)
    whole = compare([flight(ground)], tmp_path / "whole", [level], Options(settings={"rays": 8}))
    plain, lit = frames.Frames.rendered, []

    def stopped(self, method, *rest):
        if len(lit) == 1:
            raise KeyboardInterrupt
        lit.append(method.label)
        return plain(self, method, *rest)

    monkeypatch.setattr(frames.Frames, "rendered", stopped)
    with pytest.raises(KeyboardInterrupt):
        compare([flight(ground)], tmp_path / "c", [level], Options(settings={"rays": 8}))
    assert not (tmp_path / "c").exists() and (tmp_path / ".c.frames").is_dir()
    monkeypatch.setattr(frames.Frames, "rendered", plain)
    for path in (tmp_path / ".c.frames").glob(f"*/*/{damaged}"):
        # One number is another.
        path.write_bytes(path.read_bytes()[:-40] + b"7" + path.read_bytes()[-39:])
    built = []
    monkeypatch.setattr(methods, "Renderer", lambda *given, **more: built.append(1) or tr.Renderer(*given, **more))
    found = compare([flight(ground)], tmp_path / "c", [level], Options(settings={"rays": 8}))
    rendered = [label for label in found["methods"] if label.startswith("C")]
    assert len(rendered) == 2 and len(built) == (2 if damaged else 1)
    for label in found["methods"]:
        assert errors(found, label) == errors(whole, label)
    assert not (tmp_path / ".c.frames").exists()


def test_kept_frames_depend_on_hour_weather_truth_and_materials(tmp_path):
    scene = tr.load_scene(write_balance(tmp_path / "s", WEATHER))
    scene = scene.with_temperature(TemperatureSpec(source="constant", value=290.0))
    one = Flight(scene, np.zeros(1), np.eye(4)[None])
    places = [
        frames.Frames(tmp_path, each, truth, learned, {})._folder
        for each, truth, learned in (
            (one, scene, None),
            (replace(one, scene=scene.with_weather(cloud=0.9)), scene, None),
            (replace(one, scene=scene.at(scene.time + np.timedelta64(3, "h"))), scene, None),
            (one, scene.with_temperature(TemperatureSpec(source="constant", value=291.0)), None),
            (one, scene, scene),
            (replace(one, times=np.ones(1)), scene, None),
        )
    ]
    assert len(set(places)) == len(places)


def test_kept_frames_outlive_a_full_disk_but_not_a_refusal(tmp_path):
    for error, kept in ((OSError("no space"), True), (None, False)):
        with pytest.raises(ThermorenderError), frames.waiting(tmp_path / "c") as place:
            place.mkdir(exist_ok=True)
            raise ThermorenderError("a sentence") from error
        assert place.is_dir() == kept


def test_a_scene_and_its_trajectory_are_seen_once_per_second(ground, tmp_path):
    path = tr.Trajectory([0.0, 1.5], np.array([[0.0, 0.0, 8.0], [0.5, 0.0, 8.0]]), np.array([DOWN] * 2))
    options = Options(letters=("B",), settings={"rays": 2, "samples": 1})
    found = tr.compare([(coarse(tr.load_scene(ground), 8), path)], tmp_path / "c", ["fok-1to1"], options)
    times = {row["time_s"] for row in csv.DictReader((tmp_path / "c/pixels.csv").read_text().splitlines())}
    assert len(found["scenes"]) == 1 and {float(time) for time in times} == {0.0, 1.0}
