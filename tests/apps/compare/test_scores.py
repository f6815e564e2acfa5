"""Sums of errors, classes, intervals, and scores of structure."""

import cv2
import numpy as np
import pytest

from thermorender.apps.compare import (
    classes,
    scores,
    structure,
    sums,
)
from thermorender.apps.training.dataset import Entry
from thermorender.materials.library import load_library

SHAPE = (48, 64)


def test_effective_pixels_of_independent_and_of_common_errors():
    rng = np.random.default_rng(6)
    pixels, blocks = 400, 150
    for common, expected in ((False, pixels * blocks), (True, blocks)):
        error = rng.normal(size=(blocks, pixels if not common else 1)) + np.zeros((blocks, pixels))
        rows = np.array([sums.row(each) for each in error])
        found = sums.widest({"poses": rows}, error.std(), seed=0)
        assert found["effective_pixels"] == pytest.approx(expected, rel=0.35), common
        low, high = found["interval_95"]["me_k"]
        assert low < 0.0 < high or common is False


def test_the_widest_interval_of_poses_blocks_and_scenes_is_reported():
    rng = np.random.default_rng(7)
    alike = np.array([sums.row(rng.normal(size=500)) for _ in range(40)])
    apart = np.array([sums.row(rng.normal(size=500) + offset) for offset in rng.normal(size=40)])
    for names in (("poses", "scenes"), ("scenes", "poses")):
        assert sums.widest(dict(zip(names, (alike, apart), strict=True)), 1.0, 0)["drawn"] == names[1]
    # Where scenes differ, they limit the mean, however many poses each has.
    tally, other = scores.Tally(), scores.Tally()
    offsets = rng.normal(0.0, 3.0, 12)
    for number, offset in enumerate(offsets):
        for one, own in ((tally, offset), (other, offset + rng.normal(0.0, 0.1))):
            rows = [sums.row(own + rng.normal(size=500)) for _ in range(5)]
            one.views.setdefault((scores.RADIOMETRIC, "ground"), []).extend(rows)
            one.into((scores.RADIOMETRIC, "scene", f"s{number}"), sum(rows))
    found = tally.summary(0)[scores.RADIOMETRIC]["ground"]
    low, high = found["interval_95"]["me_k"]
    assert found["drawn"] == "scenes" and high - low == pytest.approx(3.92 * offsets.std() / 12**0.5, rel=0.2)
    # The difference of two methods in the same scenes is known far better.
    more = other.more_than(tally, 0)
    assert more["mae_k"] == pytest.approx(more["own_mae_k"] - more["other_mae_k"]) and np.ptp(more["interval_95"]) < 0.3
    other.groups.pop((scores.RADIOMETRIC, "scene", "s3"))
    assert other.more_than(tally, 0) is None and tally.more_than(other, 0)["interval_95"]


def test_sums_of_parts_add_up_to_the_statistics_of_all_errors():
    rng = np.random.default_rng(1)
    error, group = rng.normal(1.5, 2.0, (30, 40)), rng.integers(0, 3, (30, 40))
    error[3, 4:9] = np.nan
    rows = sums.rows_by(error, group, 4)
    reported, all_of_it = sums.summary(rows.sum(axis=0)), error[np.isfinite(error)]
    assert reported["me_k"] == pytest.approx(all_of_it.mean()) and reported["sd_k"] == pytest.approx(all_of_it.std())
    assert reported["mae_k"] == pytest.approx(np.abs(all_of_it).mean())
    assert reported["rmse_k"] == pytest.approx(np.sqrt((all_of_it**2).mean()))
    assert reported["pixels"] == 1195 and reported["pixels_without_temperature"] == 5
    assert sums.summary(rows[2])["mae_k"] == pytest.approx(np.nanmean(np.abs(error[group == 2])))
    assert sums.summary(rows[3])["mae_k"] is None
    np.testing.assert_allclose(sums.row(error), rows.sum(axis=0))


def test_interval_of_a_known_distribution():
    """Means of 400 independent clusters of 9 equal errors: ±1.96 σ/√400, whatever is inside a cluster."""
    error = np.repeat(np.random.default_rng(2).normal(0.5, 2.0, 400), 9)
    rows = np.stack([sums.row(one) for one in error])
    low, high = sums.intervals(rows, np.arange(3600) // 9, seed=3)["me_k"]
    assert low < error.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * error.std() / np.sqrt(400), rel=0.1)
    assert sums.intervals(rows, np.arange(3600) // 9, seed=3)["me_k"] == (low, high)
    assert sums.intervals(rows, np.zeros(3600, int))["me_k"] is None


def of_errors(absolute, pixels=100):
    """Rows of sums of pictures with given mean absolute errors."""
    absolute = np.asarray(absolute, np.float64)
    row = np.zeros((*absolute.shape, sums.WIDTH))
    row[..., 0], row[..., 2] = pixels, pixels * absolute
    return row


def test_interval_of_a_difference_is_paired_by_picture():
    rng = np.random.default_rng(5)
    common, own = rng.normal(9.0, 2.0, 400), rng.normal(0.25, 0.1, 400)
    cluster = np.arange(3600) // 9
    rows = np.repeat(of_errors([common, common + own]), 9, axis=1)
    ((group, more, (low, high)),) = sums.differences(rows, [[0], [1]], cluster, seed=1)
    assert group == [1] and more == pytest.approx(own.mean())
    # Their common error, twenty times the scatter of the difference, does not widen the interval.
    assert high - low == pytest.approx(2 * 1.96 * own.std() / np.sqrt(400), rel=0.1) and low < more < high
    # A picture that one of them lacks counts for neither, and one cluster gives no interval.
    rows[1, :9] = 0.0
    assert sums.differences(rows, [[0], [1]], cluster)[0][1] == pytest.approx(own[1:].mean())
    assert sums.differences(rows, [[0], [1]], np.zeros(3600, int))[0][2] is None
    # Without a picture that both have, there is nothing to compare.
    rows[1] = 0.0
    assert sums.differences(rows, [[0], [1]], cluster) == [([1], None, None)]
    assert sums.differences(rows[:, :0], [[0], [1]], cluster[:0]) == [([1], None, None)]


def test_interval_of_a_difference_includes_the_scatter_of_seeds():
    """Equal pictures, so only seeds scatter: s √(1/3 + 1/3) for two methods with three seeds each."""
    first, other = np.array([1.0, 1.3, 1.6]), np.array([2.0, 2.3, 2.6])
    rows = of_errors(np.repeat([*first, *other], 50).reshape(6, 50))
    ((_, more, (low, high)),) = sums.differences(rows, [[0, 1, 2], [3, 4, 5]], np.arange(50), seed=2)
    assert more == pytest.approx(1.0) and low < 1.0 < high
    # Few values are drawn, so the percentiles are coarse.
    assert high - low == pytest.approx(2 * 1.96 * first.std(ddof=1) * np.sqrt(2.0 / 3.0), rel=0.15)


def test_whole_sequences_are_resampled_however_few_they_are():
    entries = [Entry(f"k{n}", "test", f"parent{n // 4}", f"flight{n % 2}", 0, SHAPE) for n in range(12)]
    number, what = sums.clusters(entries)
    assert what == "2 sequences" and number.tolist() == [0, 1] * 6
    assert sums.clusters(entries[:1])[1] == "1 sequence"


def smooth(seed, side=96):
    """A picture whose structure is some 10 px large, of standard deviation 1 [K]."""
    image = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(side, side)), (0, 0), 4.0)
    return 290.0 + (image - image.mean()) / image.std()


def test_structure_scores_follow_a_known_relation_to_the_truth():
    """A guess 5 + 0.5 (T − mean) + noise of standard deviation 0.5 K."""
    true, known = smooth(0), np.ones((96, 96), bool)
    noise = 0.5 * (smooth(1) - 290.0)
    across = noise - (noise * (true - 290.0)).mean() * (true - 290.0)
    across *= 0.5 / across.std()
    guess = 295.0 + 0.5 * (true - 290.0) + across
    found = structure.summary([structure.row(guess, true, known)], [0])
    assert found["correlation"] == pytest.approx(np.sqrt(0.5), abs=1e-6)
    assert found["slope"] == pytest.approx(0.5, abs=1e-6)
    error = across - 0.5 * (true - 290.0)
    assert found["mae_without_mean_k"] == pytest.approx(np.abs(error).mean(), abs=1e-6)
    # A hidden pixel counts nowhere.
    known[40, 40], guess[40, 40] = False, 1e4
    assert structure.summary([structure.row(guess, true, known)], [0])["slope"] == pytest.approx(0.5, abs=0.01)


def test_the_shift_shows_structure_that_a_constant_lacks():
    true, known = smooth(2), np.ones((96, 96), bool)
    exact = structure.summary([structure.row(true, true, known)], [0])
    # Of two independent pictures of standard deviation 1, the mean absolute difference is 2 / √π.
    assert exact["shift_more_k"] == pytest.approx(2.0 / np.sqrt(np.pi), abs=0.25)
    assert exact["correlation"] == pytest.approx(1.0) and abs(exact["correlation_shifted"]) < 0.35
    flat = structure.summary([structure.row(np.full_like(true, 290.0), true, known)], [0])
    assert flat["correlation"] is None and flat["slope"] == 0.0 and abs(flat["shift_more_k"]) < 0.1
    assert flat["mae_without_mean_k"] == pytest.approx(np.abs(true - 290.0).mean(), abs=1e-6)


def test_structure_intervals_are_those_of_sequences():
    """Equal pictures of two sequences: a draw by picture would give a narrow interval, one by sequence both ends."""
    rows = np.ones((40, structure.WIDTH))
    rows[20:, 0] = 0.0
    number = np.repeat([0, 1], 20)
    assert structure.summary(rows, number)["interval_95"]["correlation"] == (0.0, 1.0)
    low, high = structure.summary(rows, np.arange(40))["interval_95"]["slope"]
    assert low == high == 1.0
    assert structure.summary(rows, np.zeros(40, int))["interval_95"]["correlation"] is None
    assert structure.summary(np.full((3, structure.WIDTH), np.nan), [0, 1, 2])["slope"] is None


def test_pictures_without_the_method_or_too_narrow_to_shift_are_left_out():
    true, known = smooth(3)[:12, :12], np.ones((12, 12), bool)
    narrow = structure.row(true + 1.0, true, known)
    none = structure.row(np.full_like(true, np.nan), true, known)
    found = structure.summary([narrow, none], [0, 1])
    assert found["correlation"] == pytest.approx(1.0) and found["shift_more_k"] is None
    assert found["mae_without_mean_k"] == pytest.approx(0.0, abs=1e-9)


def test_structural_similarity_equals_a_direct_sum():
    rng = np.random.default_rng(4)
    true = np.rint(rng.uniform(0, 255, (20, 23)))
    other = np.clip(true + np.rint(rng.normal(10, 30, true.shape)), 0, 255)
    known = np.ones(true.shape, bool)
    known[0, 0] = known[7, 16] = False
    found = structure.Similarity(true, known).row(other)
    axis = np.arange(-5, 6)
    window = np.exp(-(axis[:, None] ** 2 + axis**2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for row in range(5, 15):
        for column in range(5, 18):
            part = np.s_[row - 5 : row + 6, column - 5 : column + 6]
            if known[part].all():
                x, y = other[part], true[part]
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                xy = (window * (x - mx) * (y - my)).sum()
                c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
                values.append((2 * mx * my + c1) * (2 * xy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    reported = structure.similarity(found)
    assert found[3] == len(values) > 20 and reported["ssim"] == pytest.approx(np.mean(values), rel=1e-9)
    square = ((other - true)[known] ** 2).mean()
    assert reported["psnr_db"] == pytest.approx(10 * np.log10(255**2 / square))
    same = structure.similarity(structure.Similarity(true, known).row(true))
    assert same["ssim"] == pytest.approx(1.0) and same["psnr_db"] is None


def test_eight_bit_values_are_clipped_between_bounds():
    shown = structure.eight_bit(np.array([280.0, 290.0, 295.0, 310.0, 320.0, np.nan]), (290.0, 310.0))
    assert shown.tolist() == [0.0, 0.0, 64.0, 255.0, 255.0, 0.0]


def test_every_material_of_the_library_is_natural_or_man_made():
    assert not classes.MAN_MADE & classes.NATURAL
    assert set(load_library()) == classes.MAN_MADE | classes.NATURAL


def test_edges_are_two_pixels_around_a_step():
    image = np.full((9, 12), 290.0)
    image[:, 6:] += 3.0
    # Central differences see the step from columns 5 and 6.
    assert (classes.edge_class(image) == 0).all(axis=0).nonzero()[0].tolist() == list(range(3, 9))
    image[:, 6:] -= 1.5
    assert classes.edge_class(image).all(), "0.75 K a pixel is none"
