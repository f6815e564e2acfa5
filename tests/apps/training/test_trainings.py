"""Comparison of trainings: numbers from their logs, and refused folders."""

import json

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from validation.trainings import study as trainings


def write(folder, errors, crops=100, core_s=10.0, method="pix2pix", pairs=30):
    """A training's folder with validation errors after each epoch, and its sample pictures."""
    import cv2

    (folder / "samples").mkdir(parents=True)
    settings = {"method": method, "seed": 0, "options": {"width": 16, "batch": 4}, "examples": [pairs, "d"]}
    (folder / "settings.json").write_text(json.dumps(settings), encoding="utf-8")
    lines = []
    for number, error in enumerate(errors, 1):
        lines.append({"crops": crops * number, "seconds": 1.0, "core_seconds": core_s * number, "losses": {},
                      "validation_mae_k": error})  # fmt: skip
        cv2.imwrite(str(folder / "samples" / f"{crops * number:09d}.png"), np.zeros((80, 80, 3), np.uint8))
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    return folder


def test_curves_best_errors_and_plateaus_are_read_from_logs(tmp_path):
    falling = write(tmp_path / "falling.run", [5.0, 4.0, 3.0, 2.0, 1.0])
    flat = write(tmp_path / "flat.run", [3.0, 2.0, 2.5, 2.2, 1.99], core_s=100.0)
    result = trainings.run([flat, falling])
    one, other = result["runs"]
    assert (one["name"], one["best_mae_k"], one["best_crops"], one["best_core_s"]) == ("falling", 1.0, 500, 50.0)
    # Over the last fifth of the crops, one halves its error, the other improves by half a percent.
    assert one["last_fifth"] == pytest.approx(0.5) and other["last_fifth"] == pytest.approx(0.005)
    assert one["published_crops"] == 3511 * 200
    rows = {row[0]: row for row in trainings.rows(result)}
    assert rows["flat"][-1] == "−0.5 %, plateau" and rows["falling"][-1] == "−50.0 %"
    short = trainings.run([write(tmp_path / "short.run", [2.0, 1.0])])
    assert short["runs"][0]["last_fifth"] is None and trainings.rows(short)[0][-1] == "too short"
    # Both have the same method, which is not compared with itself.
    assert not trainings.sentences(result)


def test_only_a_falling_curve_is_extrapolated_by_its_power_law(tmp_path):
    falling = write(tmp_path / "falling.run", [8.0 * n**-0.5 for n in range(1, 11)], core_s=360.0, method="unet-gan")
    flat = write(tmp_path / "flat.run", [3.0, 2.0, 2.5, 2.2, 1.99])
    result = trainings.run([flat, falling])
    flat, falling = result["runs"]
    assert flat["extrapolated"] is None
    best = 8.0 / 10.0**0.5
    assert falling["extrapolated"] == pytest.approx({"core_s": 7200.0, "mae_k": best / 2.0**0.5, "exponent": -0.5})
    assert trainings.extrapolations(result) == [
        "falling: 2.53 K after 1.00 core hours; extrapolated, not measured: 1.79 K after 2.00"
    ]
    # Both readings of the study's epochs.
    assert [row[5] for row in trainings.rows(result)] == [702_200, "392000000 or 98000"]


@pytest.mark.parametrize(
    "seconds",
    [[1.0, 2.0, 3.0, 3.0, 5.0], [5.0, 4.0, 3.0, 2.0, 1.0], [0.0] * 5, [1.0, 1.0 + 1e-9, 1.0 + 2e-9, 1.1, 1.2]],
)
def test_a_curve_without_a_power_law_is_not_extrapolated(seconds):
    curve = [(100 * (k + 1), second, 8.0 * 0.5**k) for k, second in enumerate(seconds)]
    assert trainings.extrapolated(curve, 0.5) is None


def test_a_method_is_ahead_with_less_error_in_a_tenth_of_the_time(tmp_path):
    slow = write(tmp_path / "slow.run", [3.0, 2.0], core_s=100.0)
    # Within 20 core seconds 1.5 K; the slower one's best, 2 K, took 200.
    fast = write(tmp_path / "fast.run", [2.5, 1.5], method="compact")
    assert trainings.sentences(trainings.run([slow, fast])) == [
        "compact is ahead of pix2pix by at least 0.50 K, within 1/10 of the core time of its best error"
    ]
    # A second run with a smaller or an earlier best error is not behind.
    for number, other in enumerate(([1.4], [1.9])):
        more = write(tmp_path / f"{number}.run", other, core_s=1000.0 if number == 0 else 50.0)
        assert not trainings.sentences(trainings.run([slow, fast, more]))


def test_the_study_draws_curves_and_strips(tmp_path, call_module):
    run = write(tmp_path / "one.run", [5.0, 4.0, 3.0])
    status, out, err = call_module("validation.trainings", run, "-o", tmp_path / "o")
    assert status == 0 and "one" in out and "3.00" in out, err
    assert {path.name for path in (tmp_path / "o").iterdir()} == {"trainings.json", "curves.png", "strip_one.png"}


def test_folders_without_comparable_trainings_are_refused(tmp_path):
    with pytest.raises(ThermorenderError, match="no training was given"):
        trainings.run([])
    with pytest.raises(ThermorenderError, match=r"is not the folder of a training: it has no valid settings.json"):
        trainings.run([tmp_path])
    for text in ("3", "{}", "["):
        (tmp_path / "settings.json").write_text(text, encoding="utf-8")
        with pytest.raises(ThermorenderError, match="is not the folder of a training"):
            trainings.run([tmp_path])
    with pytest.raises(ThermorenderError, match="has a training without a complete epoch"):
        trainings.run([write(tmp_path / "empty", [])])
    same = [write(tmp_path / name / "r.run", [1.0]) for name in "ab"]
    with pytest.raises(ThermorenderError, match="two trainings are called 'r'"):
        trainings.run(same)
    other = write(tmp_path / "other", [1.0], pairs=40)
    with pytest.raises(ThermorenderError, match="used data sets of 30, 40 pairs, so their errors are not comparable"):
        trainings.run([same[0], other])
