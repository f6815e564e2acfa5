"""Shutters in the offsets of frames."""

import numpy as np
import pytest

from thermorender.apps.survey.inverse.shutter import shutters_of


def sawtooth(after=(9, 22), count=32, fall=5.0, noise=0.1, seed=0):
    """Offsets that drift towards `fall` with a time constant of four frames, and return to 0 after each shutter."""
    since = np.arange(count, dtype=float)
    for number in after:
        since[number:] = np.arange(count - number)
    return fall * (1.0 - np.exp(-since / 4.0)) + np.random.default_rng(seed).normal(0.0, noise, count)


def all_of(offsets, when=None):
    return shutters_of(offsets, np.arange(float(len(offsets))) if when is None else when, np.isfinite(offsets))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_frames_after_a_shutter_are_found_and_set_the_level(sign):
    offsets = sign * sawtooth()
    found = all_of(offsets)
    assert found.after.tolist() == [9, 22]
    assert found.level_k == pytest.approx(offsets[[9, 22]].mean())
    assert found.fall_k == pytest.approx(np.abs(offsets[[9, 22]] - offsets[[8, 21]]).mean())
    # The curve keeps the jumps and takes the noise of a frame, 0.1 K.
    assert np.abs(found.drift - sign * sawtooth(noise=0.0)).max() < 0.5


def test_names_out_of_order_do_not_matter():
    when = np.random.default_rng(1).permutation(32)
    found = all_of(sawtooth()[when], when.astype(float))
    assert sorted(when[found.after]) == [9, 22]


def test_what_changes_in_a_gap_of_the_flight_is_no_shutter():
    when = np.arange(32.0)
    when[22:] += 30.0
    assert all_of(sawtooth(), when).after.tolist() == [9]


def test_drift_noise_and_steps_to_both_sides_are_no_shutter():
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(300):
        for offsets in (rng.normal(0.0, 0.5, 40), np.cumsum(rng.normal(0.0, 0.2, 40)), np.linspace(0.0, 6.0, 40)):
            found += all_of(offsets).after.size > 0
    assert found <= 3
    up_and_down = np.concatenate([np.zeros(12), np.full(12, 6.0), np.zeros(12)])
    assert not all_of(up_and_down + rng.normal(0.0, 0.1, 36)).after.size


def test_few_frames_tell_no_jump():
    assert not all_of(np.array([0.0, 0.1, 5.0, 5.1, 5.0, 5.2, 5.1])).after.size


def test_frames_that_show_nothing_are_left_out():
    offsets = sawtooth()
    known = np.arange(32) != 9
    found = shutters_of(np.where(known, offsets, 0.0), np.arange(32.0), known)
    assert found.after.tolist() == [10, 22] and found.drift[9] == 0.0
