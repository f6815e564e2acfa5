"""Targets in frames, and the detector of hot spots."""

import numpy as np
import pytest
from compare_support import view

from thermorender.apps.compare import (
    hot_spots,
    targets,
)


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
    seen_from = view(np.ones(rows.shape, bool), object=number, truth=truth)
    found = targets.Targets()
    found.add("s", seen_from, list(places), truth, 8000.0 + 25.0 * (truth - 290.0) + rng.normal(0.0, 10.0, rows.shape))
    reported = found.summary()["objects"]
    assert {name: own["found"] for name, own in reported.items()} == {"warm": 1.0, "cold": 1.0, "elsewhere": 0.0}
    assert reported["cold"]["contrast_k"] == reported["cold"]["true_contrast_k"] == pytest.approx(-12.0, abs=0.5)
    assert reported["cold"]["offset_px"] < 2.0
