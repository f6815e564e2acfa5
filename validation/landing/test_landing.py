"""The closed-loop landing: the vehicle's motion, the tracker and its steering, and whole landings."""

import json
from collections import Counter

import numpy as np
import pytest

from examples.landing import guidance, run, sites, vehicle
from thermorender.errors import ThermorenderError

FOCAL_PX = 765.0


def test_vehicle_follows_the_closed_form():
    """dv/dt = (u − v)/τ + k (w − v) has v∞ = (u/τ + k w)/(1/τ + k) and decays at 1/τ + k."""
    command, wind = np.array([1.0, -0.5, -1.0]), np.array([4.0, 2.0, 0.0])
    start, velocity = np.array([3.0, 2.0, 40.0]), np.array([0.2, 0.0, 0.0])
    rate = 1.0 / vehicle.LAG_S + vehicle.DRAG_PER_S
    final = (command / vehicle.LAG_S + vehicle.DRAG_PER_S * wind) / rate
    decay = np.exp(-rate)
    place, speed = vehicle.flown(start, velocity, command, wind, 1.0)
    assert speed == pytest.approx(final + (velocity - final) * decay, abs=1e-4)
    assert place == pytest.approx(start + final + (velocity - final) * (1.0 - decay) / rate, abs=1e-4)
    _, pushed = vehicle.flown(start, np.zeros(3), np.array([100.0, 0.0, 0.0]), np.zeros(3), 0.1)
    assert pushed[0] == pytest.approx(0.1 * vehicle.MOST_M_S2, rel=0.01)


def test_gusts_have_the_stated_spread_and_correlation():
    wind = vehicle.winds(np.array([6.0, 8.0]), 200_000, 1.0 / 9.0, np.random.default_rng(1))
    assert wind.mean(axis=0) == pytest.approx([6.0, 8.0, 0.0], abs=0.1)
    gust = wind[:, 0] - 6.0
    assert gust.std() == pytest.approx(10.0 * vehicle.GUST_SHARE, rel=0.03)
    lag = round(9 * vehicle.GUST_S)
    assert np.corrcoef(gust[:-lag], gust[lag:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.03)


def picture(spots, height_m, seed=0, shape=(256, 320)):
    """Counts with discs of the marker's size: {(row, column): counts above the background}."""
    rows, columns = np.indices(shape)
    image = 8000.0 + np.random.default_rng(seed).normal(scale=10.0, size=shape)
    radius = 0.5 * FOCAL_PX * sites.MARKER_M / height_m
    for (row, column), counts in spots.items():
        image += counts * (np.hypot(rows - row, columns - column) <= radius)
    return image.astype(np.uint16)


def test_spot_is_locked_then_followed_past_a_warmer_one_and_lost():
    tracker = guidance.Tracker(FOCAL_PX, sites.MARKER_M)
    for step in range(guidance.AGREEING):
        assert not tracker.locked
        seen = tracker.look(picture({(100 + step, 200): 60}, 40.0, step), 40.0)
        assert seen == pytest.approx([100 + step, 200], abs=3.0)
    assert tracker.locked
    # A warmer spot far away is ignored.
    seen = tracker.look(picture({(104, 200): 60, (200, 60): 300}, 40.0, 7), 40.0)
    assert seen == pytest.approx([104, 200], abs=3.0)
    for step in range(guidance.MISSING):
        assert tracker.locked
        tracker.look(picture({}, 40.0, 20 + step), 40.0)
    assert not tracker.locked and tracker.at is None


def test_tracker_does_not_lock_on_noise():
    tracker = guidance.Tracker(FOCAL_PX, sites.MARKER_M)
    for step in range(20):
        tracker.look(picture({}, 40.0, 100 + step), 40.0)
        assert not tracker.locked


def test_steering_brings_the_vehicle_to_the_marker_against_wind():
    steering, span = guidance.Steering(np.zeros(2)), 1.0 / 9.0
    position, velocity, wind = np.array([6.0, -4.0, 40.0]), np.zeros(3), np.array([5.0, 3.0, 0.0])
    time_s = 0.0
    while position[2] > 0.2 and time_s < run.LONGEST_S:
        command = steering.command(-position[:2], position[2], span)
        position, velocity = vehicle.flown(position, velocity, command, wind, span)
        time_s += span
    assert position[2] <= 0.2 and np.hypot(*position[:2]) < 0.3
    assert steering.command(None, 20.0, span)[2] == 0.0


def test_conditions_are_reproducible_and_differ_between_runs():
    found = [sites.conditions_of(number) for number in range(104)]
    assert found[3] == sites.conditions_of(3) and len({each.contrast_k for each in found}) == 104
    assert Counter(each.world for each in found) == dict.fromkeys(range(sites.WORLDS), 13)
    assert all(2.0 <= each.contrast_k <= 40.0 and 1.0 <= each.noise <= 4.0 for each in found)


@pytest.mark.slow
def test_landings_are_paired_resumed_and_summarised(tmp_path):
    small = {"heath": (48.0, 0.5, 1.0)}
    found = run.fly(tmp_path, ["fok-1to1"], 1, sizes=small, quality="fast", rays=8)
    assert [each["frames"] for each in found] == ["A", "B fok-1to1", "C fok-1to1"]
    assert len({(each["offset_m"], each["contrast_k"]) for each in found}) == 1
    assert len({tuple(each["path"][0]) for each in found}) == 1
    render = found[0]
    # A marker 30 K warmer than its ground is found and reached.
    assert render["contrast_k"] > 20.0 and render["acquired_s"] < 1.0 and render["right"] > 0.95
    assert render["error_m"] < run.NEAR_M
    lines = (tmp_path / run.LOG).read_text()
    # An incomplete line is not a run.
    (tmp_path / run.LOG).write_text(lines + '{"run": 7, "fra')
    assert run.fly(tmp_path, ["fok-1to1"], 1, sizes=small, quality="fast", rays=8) == json.loads(
        "[" + ",".join(lines.splitlines()) + "]"
    )
    assert (tmp_path / run.LOG).read_text() == lines
    reported = run.write(found, tmp_path)
    assert reported["A"]["near"] == 1.0 and len(run.rows(reported)) == 3
    with pytest.raises(ThermorenderError, match="has landings of other settings"):
        run.fly(tmp_path, ["fok-1to1"], 1, sizes=small, quality="high", rays=8)
    with pytest.raises(ThermorenderError, match="takes hour and weather as input"):
        run.fly(tmp_path, ["procedural-trees+"], 1)
