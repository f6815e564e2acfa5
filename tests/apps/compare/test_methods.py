"""Methods, predictors that remember, and frames of another program."""

import time
from dataclasses import replace

import numpy as np
import pytest
from compare_support import BAND, black, errors, flight, frames_of, structured, uniform_map

import thermorender as tr
from scenes import WEATHER, scene_object, write_terrain
from thermorender.apps.compare import methods, predictors
from thermorender.apps.compare.comparison import Options, compare
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import Correlation
from thermorender.learned.temperature_map import Inputs, TemperatureMap, save_map


@pytest.mark.slow
def test_only_the_method_with_true_objects_knows_their_temperatures(tmp_path):
    hot = scene_object("plate", [4.0, 4.0, 0.1], [0.0, 0.0, 0.05], 360.0, shape="disc", colour=[40, 40, 40])
    folder = write_terrain(tmp_path / "s", height=np.zeros((32, 32)), extra=hot)
    level = uniform_map(tmp_path / "level.npz", 0.5)
    found = compare([flight(folder, height=15.0)], tmp_path / "c", [level], Options(settings={"rays": 8}))
    plain, true = (
        errors(found, label, part="objects")["me_k"]
        for label in ("level as kelvin, true materials", "level as kelvin, true materials, true objects")
    )
    assert plain < -50.0 and abs(true) < 1.0
    # Of radiance, so above that of temperature by a little.
    assert 0.0 < errors(found, "the frame's own mean")["me_k"] < 0.2
    assert errors(found, "level on the photograph", part="objects")["me_k"] == pytest.approx(plain, abs=3.0)
    target = {
        label: found["methods"][label]["targets"]["objects"]["plate"]
        for label in ("level on the photograph", "level as kelvin, true materials, true objects")
    }
    assert (
        target["level on the photograph"]["true_contrast_k"] > 50.0
        and abs(target["level on the photograph"]["contrast_k"]) < 0.1
    )
    assert (
        target["level as kelvin, true materials, true objects"]["found"] == 1.0
        and target["level as kelvin, true materials, true objects"]["offset_px"] < 2.0
    )
    known = found["targets"]["objects"]["plate"]
    assert known["found"] == 1.0 and known["contrast_k"] == known["true_contrast_k"] > 50.0
    page = (tmp_path / "c" / "report.html").read_text(encoding="utf-8")
    assert "<td>reference</td>" in page.split("<h2>Targets</h2>")[1]


@pytest.mark.slow
def test_learned_materials_do_not_change_objects():
    scene = tr.load_scene("heath/survey")
    reported = scene.with_learned_materials(methods.learned_materials())
    for before, after in zip(scene.surfaces[1:], reported.surfaces[1:], strict=True):
        assert [scene.materials[k].name for k in np.unique(before.material)] == [
            reported.materials[k].name for k in np.unique(after.material)
        ]
    assert (
        reported.emissivity_report["model"] == "procedural"
        and reported.surfaces[0].material.shape == scene.surfaces[0].material.shape
    )


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
    ways = ["", ", calibrated", ", refitted"]
    uses = ("m as kelvin, true materials", "m on the photograph")
    known = [f"{use}{way}" for use in uses for way in ways]
    assert sorted(own) == ["m as kelvin, learned materials, calibrated", *known]
    for label, found in own.items():
        assert (found["seconds_per_frame"] if "photograph" in label else found["once_s"]) >= 0.05, label


def test_foreign_frames_are_checked_before_anything_is_rendered(ground, tmp_path):
    celsius = frames_of(ground, 3, tmp_path / "celsius", lambda kelvin, index: kelvin - 273.15)
    with pytest.raises(ThermorenderError, match="below 100 K"):
        compare([flight(ground)], tmp_path / "c", [], Options(foreign={"celsius": celsius}, settings={"rays": 8}))
    small = frames_of(ground, 3, tmp_path / "small", lambda kelvin, index: kelvin[::2])
    with pytest.raises(ThermorenderError, match="is not a grey picture of 160×128 pixels, the size of its reference"):
        compare([flight(ground)], tmp_path / "c", [], Options(foreign={"small": small}, settings={"rays": 8}))
    level = uniform_map(tmp_path / "small.npz", 0.5)
    with pytest.raises(ThermorenderError, match="two methods are called 'small'"):
        compare([flight(ground)], tmp_path / "c", [level], Options(foreign={"small": small}, settings={"rays": 8}))
    assert not (tmp_path / "c").exists()


def test_a_new_method_is_a_function_and_a_line(ground, tmp_path, monkeypatch):
    """It is chosen by its kind, scored like all others, and says why a scene lacks it."""

    def lukewarm(given):
        if given.scene.name == "ground":
            yield methods.Method("lukewarm", "20 °C", function=lambda view: np.full(view.known.shape, 293.15))
        else:
            yield f"20 °C is left out of {given.scene.name}."

    monkeypatch.setitem(methods.OF_SCENES, "lukewarm", lukewarm)
    other = write_terrain(tmp_path / "other")
    level = uniform_map(tmp_path / "level.npz", 0.5)
    options = Options(kinds=("lukewarm",), arrays=True, settings={"rays": 2, "samples": 1})
    found = compare([flight(ground, poses=1), flight(other, poses=1)], tmp_path / "c", [level], options)
    assert list(found["methods"]) == ["20 °C"] and "20 °C is left out of other." in found["notes"]
    with np.load(tmp_path / "c/arrays/ground_0000.npz") as kept:
        assert np.allclose(kept["20__C"], 293.15, atol=1e-3)
        off = (293.15 - kept["reference"])[kept["known"]]
    assert errors(found, "20 °C")["me_k"] == pytest.approx(off.mean(), abs=1e-3)


def test_a_wrong_kind_lists_the_right_ones(ground, tmp_path, call):
    with pytest.raises(
        ThermorenderError, match="--methods='photograph,X' is not allowed; give some of photograph, true-m"
    ):
        compare([flight(ground)], tmp_path / "c", ["fok-1to1"], Options(kinds=("photograph", "X")))
    status, _, err = call("compare", ground, "-o", tmp_path / "c", "--methods", "")
    assert status == 2 and "--methods='' is not allowed" in err and not (tmp_path / "c").exists()


def test_without_kinds_the_command_compares_all_methods(ground, tmp_path, call, monkeypatch):
    asked = []

    def reported(flights, output, models, options, *rest):
        asked.append(tuple(options.kinds))
        raise ThermorenderError("seen")

    monkeypatch.setattr("thermorender.apps.compare.comparison.compare", reported)
    log = tmp_path / "log.csv"
    log.write_text(
        "time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n0,0,0,8,0,-90,0\n1,0,0,8,0,-90,0\n"
    )
    call("compare", ground, "-o", tmp_path / "c", "--trajectory", log)
    assert asked == [methods.KINDS]


@pytest.mark.slow
def test_a_camera_of_another_band_leaves_a_maps_temperatures(tmp_path):
    """On the photograph, calibrated too, and the terms under a mid-wave camera, with a map of the long wave."""
    heights = np.random.default_rng(1).uniform(0.0, 0.3, (2, 32, 32))
    lands = [black(write_terrain(tmp_path / f"land{k}", heights[k], structured(5 + k), extra=WEATHER)) for k in (0, 1)]
    text = (lands[1] / "scene.toml").read_text()
    air = '[atmosphere]\nstandard = "midlatitude-summer"\n'
    (lands[1] / "scene.toml").write_text(text[: text.index("[sky]")] + air + text[text.index("[truth]") :])
    # Its intensities follow the colours, which have nothing to do with the temperatures.
    grey = TemperatureMap("grey", "correlation-1to1", Correlation(np.full((1, 1, 3), 0.2), 0.2), (280.0, 300.0), BAND,
                          0.5, (0.01, 5.0), "zenmuse-xt2", 255.0, "a test")  # fmt: skip
    save_map(grey, tmp_path / "grey.npz")
    found = {}
    for name, band_um in (("long", BAND), ("mid", (3.7, 4.8))):
        flights = [flight(each) for each in lands]
        flights = [
            replace(one, scene=one.scene.with_camera(replace(one.scene.camera, name=name, band_um=band_um)))
            for one in flights
        ]
        options = Options(kinds=("photograph", "true-materials"), settings={"rays": 8})
        found[name] = compare(flights, tmp_path / name, [str(tmp_path / "grey.npz")], options)
    long, mid = found["long"], found["mid"]
    # Refitted bounds are of counts, whose quartiles reach farther in the mid-wave.
    for label in (
        "grey on the photograph",
        "grey as kelvin, true materials",
        "grey on the photograph, calibrated",
        "grey as kelvin, true materials, calibrated",
    ):
        one, other = (errors(each, label) for each in (long, mid))
        # Pixels mix radiance, the mid-wave weighs warm parts more, and photographs have no air.
        assert other["me_k"] == pytest.approx(one["me_k"], abs=0.5), label
        assert other["mae_k"] == pytest.approx(one["mae_k"], abs=0.5), label
    for one, other in zip(long["scenes"], mid["scenes"], strict=True):
        assert other["terms_apart_mk"] <= 1.0
        for term in ("geometry", "emission", "reflection"):
            own, known = (each["terms"]["grey"]["terms"][term]["me_k"] for each in (other, one))
            assert own == pytest.approx(known, abs=0.05), term
    notes = [[note for note in each["notes"] if "another band" in note] for each in (long, mid)]
    assert not notes[0] and len(notes[1]) == 2
    assert notes[1][0].startswith("Learned map 'grey' gives apparent temperatures of 7.5–13.5 µm, another band than")
