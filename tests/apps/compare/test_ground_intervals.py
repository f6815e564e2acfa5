"""Intervals of errors that are correlated over ground and poses: how often they cover the truth."""

import numpy as np
import pytest

from thermorender.apps.compare import ground_intervals, sums

SIDE, CELL_M = 64, 0.5
# Of normal errors of mean 0 and standard deviation 1.
MAE_K = np.sqrt(2.0 / np.pi)


def field(rng, length, shape):
    """A normal field (SIDE, SIDE) of mean 0 and deviation 1, whose correlation has an integral scale [cells]."""
    frequency = 2.0 * np.pi * np.fft.fftfreq(2 * SIDE)
    square = frequency[:, None] ** 2 + frequency**2
    if shape == "gaussian":
        density = np.exp(-square * length**2 / np.pi)
    else:
        density = (1.0 + square * length**2) ** -1.5
    noise = np.fft.fft2(rng.normal(size=(2 * SIDE, 2 * SIDE)))
    image = np.fft.ifft2(noise * np.sqrt(density)).real
    return (image * 2 * SIDE / np.sqrt(density.sum()))[:SIDE, :SIDE]


def cells(error):
    """The Cells of a pose that sees all of the ground."""
    row, column = np.mgrid[:SIDE, :SIDE]
    place = np.column_stack([column.ravel(), row.ravel()]).astype(np.int32)
    each = np.column_stack([np.ones(SIDE * SIDE), error.ravel(), np.abs(error).ravel()])
    return ground_intervals.Cells("land", CELL_M, place, each.astype(np.float32))


def coverage(shape, length, poses=1, own=0.0, fields=150):
    """Shares of intervals that cover the mean, the mean absolute error; of those that converge; and by the old rule.

    The error of a pose is the ground's and an offset of deviation `own`. The old rule draws 8 × 8 blocks.
    """
    rng, found = np.random.default_rng(3), []
    for seed in range(fields):
        ground = np.sqrt(1.0 - own**2) * field(rng, length, shape)
        seen = [ground + own * rng.normal() for _ in range(poses)]
        each = ground_intervals.interval([cells(one) for one in seen], seed)
        known = {"me_k": 0.0, "mae_k": MAE_K}
        blocks = seen[0].reshape(8, SIDE // 8, 8, SIDE // 8).swapaxes(1, 2).reshape(64, -1)
        old = sums.intervals([sums.row(one) for one in blocks], np.arange(64), seed)
        held = [
            ends[name] is not None and ends[name][0] <= known[name] <= ends[name][1]
            for ends in (each, old)
            for name in known
        ]
        found.append([*held[:2], each["blocks"]["converged"], *held[2:]])
    return np.mean(found, axis=0)


@pytest.mark.parametrize("shape", ["gaussian", "exponential"])
def test_intervals_of_correlated_errors_cover_the_truth_where_fixed_blocks_do_not(shape):
    mean, size, converged, old_mean, _ = coverage(shape, 3.5)
    # Of 150 draws, a share of 95 % has a standard deviation of 1.8 %.
    assert 0.90 <= mean <= 0.98 and 0.90 <= size <= 0.98 and converged > 0.95
    assert old_mean < 0.85


@pytest.mark.slow
def test_intervals_of_shorter_correlation_cover_the_truth():
    for shape in ("gaussian", "exponential"):
        mean, size, converged, *_ = coverage(shape, 1.5, fields=300)
        assert 0.90 <= mean <= 0.98 and 0.90 <= size <= 0.985 and converged == 1.0


def test_offsets_of_poses_are_in_the_interval_and_three_poses_do_not_converge():
    mean, size, converged, *_ = coverage("exponential", 2.5, poses=8, own=0.5, fields=100)
    assert 0.90 <= mean <= 1.0 and 0.90 <= size <= 1.0 and converged > 0.95
    assert coverage("exponential", 2.5, poses=3, own=0.6, fields=30)[2] < 0.3


def test_intervals_over_too_little_ground_do_not_converge():
    mean, _, converged, *_ = coverage("exponential", 20.0, fields=60)
    assert mean < 0.85 and converged < 0.1


def test_the_measured_correlation_length_is_that_of_the_field():
    rng = np.random.default_rng(4)
    for shape, length in (("gaussian", 2.0), ("gaussian", 4.0), ("exponential", 3.0)):
        poses = [cells(field(rng, length, shape)) for _ in range(12)]
        found = ground_intervals.length_m(poses) / CELL_M
        # Cells are wide against a short length, and the mean of each pose is unknown.
        assert found == pytest.approx(length, rel=0.15), shape
        noisy = [cells(field(rng, length, shape) + rng.normal(size=(SIDE, SIDE))) for _ in range(12)]
        # Noise of single cells makes no correlation shorter.
        assert ground_intervals.length_m(noisy) / CELL_M == pytest.approx(length, rel=0.2), shape
    white = [cells(rng.normal(size=(SIDE, SIDE))) for _ in range(12)]
    assert ground_intervals.length_m(white) <= 1.1 * CELL_M


def test_no_pose_has_no_interval_and_the_same_seed_the_same_interval():
    seen = [cells(field(np.random.default_rng(1), 2.0, "gaussian"))]
    assert ground_intervals.interval(seen, 5) == ground_intervals.interval(seen, 5)
    assert ground_intervals.interval([], 0) is None
