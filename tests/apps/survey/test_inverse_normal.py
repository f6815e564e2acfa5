"""The normal equations of a reconstruction: the stencil against dense matrices, conjugate gradients against NumPy."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from thermorender.apps.survey.inverse import normal as normal_module
from thermorender.apps.survey.inverse.normal import Normal, Prior, Stencil, Sums, footprint, links
from thermorender.apps.survey.inverse.solve import Common, correlated_pixels
from thermorender.apps.survey.inverse.weights import Sight, bilinear, texel_means

SHAPE = (7, 6)


def seen_at(rng, count=60):
    """A Sight of random points on a map of `SHAPE`."""
    row, column = (rng.uniform(0.01, side - 1.01, count) for side in SHAPE)
    nothing = np.zeros((2, count), np.float32)
    return Sight(np.arange(count), row, column, nothing, nothing, np.zeros((2, 3, count)), np.zeros((3, count)))


def dense(sight):
    """The bilinear weights of a Sight, (N, texels), from `Sight.at` of each texel alone."""
    size = SHAPE[0] * SHAPE[1]
    return np.stack([sight.at(texel.reshape(SHAPE)) for texel in np.eye(size)], axis=1)


def test_stencil_is_the_normal_matrix_of_bilinear_weights():
    rng = np.random.default_rng(1)
    sight, precision = seen_at(rng), rng.uniform(0.5, 2.0, 60)
    stencil = Stencil(SHAPE)
    seen = footprint(sight)
    stencil.link[(slice(None), *seen.window)] += links(seen, precision)
    weights = dense(sight)
    expected = weights.T @ (precision[:, None] * weights)
    found = np.stack([stencil(texel.reshape(SHAPE)).ravel() for texel in np.eye(SHAPE[0] * SHAPE[1])])
    np.testing.assert_allclose(found, expected, atol=1e-13)


def test_stencil_takes_40_bytes_a_texel():
    assert Stencil((30, 20)).link.nbytes == 40 * 600


def made_problem(pixel=1.0, prior_precision=0.2, offset_precision=0.4):
    """Two frames with an offset and a slope each, one common term, three classes.

    Returns (Normal, its right-hand side, solution by dense least squares). `pixel` scales the precision of pixels.
    """
    rng = np.random.default_rng(2)
    size = SHAPE[0] * SHAPE[1]
    classes = np.arange(size).reshape(SHAPE) % 3
    precision = prior_precision * rng.uniform(0.5, 1.5, SHAPE)
    prior = Prior(np.zeros(SHAPE), precision, classes, 0.05)
    own_precision = np.array([offset_precision, 0.7])
    normal = Normal(prior, own_precision, np.array([0.2]))
    away, at_class, at_common = rng.normal(size=SHAPE), rng.normal(size=3), rng.normal(size=1)
    rows, values = [], []
    count = size + 4 + 1 + 3
    for number in range(2):
        sight, weight = seen_at(rng), pixel * rng.uniform(0.5, 2.0, 60)
        own = np.stack([np.ones(60), rng.normal(size=60)])
        common, residual, deviation = rng.normal(size=(1, 60)), rng.normal(size=60), rng.normal(size=2)
        normal.add(Sums.of(footprint(sight), residual, weight, own, common), deviation)
        part = np.zeros((60, count))
        part[:, :size] = dense(sight)
        part[:, size + 2 * number : size + 2 * number + 2] = own.T
        part[:, size + 4] = common[0]
        rows.append(np.sqrt(weight)[:, None] * part)
        values.append(np.sqrt(weight) * residual)
        for k in range(2):
            root = np.sqrt(own_precision[k])
            rows.append(root * np.eye(count)[[size + 2 * number + k]])
            values.append([-root * deviation[k]])
    rows.append(np.sqrt(0.2) * np.eye(count)[[size + 4]])
    values.append(-np.sqrt(0.2) * at_common)
    root = np.sqrt(precision.ravel())
    pull = np.zeros((size, count))
    pull[:, :size] = np.diag(root)
    pull[np.arange(size), size + 5 + classes.ravel()] = -root
    rows.append(pull)
    values.append(-root * (away.ravel() - at_class[classes.ravel()]))
    rows.append(np.sqrt(0.05) * np.eye(count)[size + 5 :])
    values.append(-np.sqrt(0.05) * at_class)
    expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    return normal, normal.gradient(away, at_class, at_common), expected


def flat(x):
    return np.concatenate([np.ravel(part) for part in x])


@pytest.mark.parametrize(
    "keys", [{}, {"pixel": 1e4, "prior_precision": 0.01, "offset_precision": 1e-3}, {"prior_precision": 50.0}]
)
def test_solution_is_that_of_dense_least_squares(keys, monkeypatch):
    monkeypatch.setattr(normal_module, "_TILE", 4)
    normal, gradient, expected = made_problem(**keys)
    found, _ = normal.solved(gradient, tolerance=1e-10)
    np.testing.assert_allclose(flat(found), expected, atol=1e-7)


def test_threads_do_not_change_a_solution():
    normal, gradient, _ = made_problem()
    alone, steps = normal.solved(gradient)
    with ThreadPoolExecutor(2) as pool:
        found, same = normal.solved(gradient, each=pool.map)
    assert steps == same > 2
    np.testing.assert_array_equal(flat(found), flat(alone))


def test_solution_of_no_pull_is_zero():
    normal, gradient, _ = made_problem()
    found, steps = normal.solved(gradient.like(0.0 * gradient.map, 0.0 * gradient.parameters))
    assert steps == 0 and not flat(found).any()


def test_common_part_of_residuals_is_their_weighted_mean_after_the_steps():
    rng = np.random.default_rng(5)
    step, common = rng.normal(size=SHAPE), Common(3, 90, max(SHAPE), 0.001, 0.5)
    own, terms = rng.normal(size=(3, 2)), rng.normal(size=(2, 90))
    pull, total = np.zeros(90), np.full(90, 4.0)
    for number in range(3):
        sight = replace(seen_at(rng), pixel=rng.permutation(90)[:60])
        residual, precision = rng.normal(size=60), 1e6 * rng.uniform(0.5, 1.0, 60)
        common.add(number, sight, residual, precision)
        pull[sight.pixel] += precision * (residual - dense(sight) @ step.ravel() - own[number] @ terms[:, sight.pixel])
        total[sight.pixel] += precision
    # Places are kept to 1/65535 of the side, where values differ by up to 3 a texel, and precisions to 1/2048.
    np.testing.assert_allclose(common.left(step, own, terms), pull / total, atol=3.0 * 7 / 65535 + 3.0 / 2048)


@pytest.mark.parametrize(("side", "alike"), [(1, 1.0), (4, 16.0), (8, 64.0), (16, 256.0)])
def test_pixels_alike_are_the_pixels_of_a_square_with_one_error(side, alike):
    # 1280 squares whose means differ: four standard errors of their variance are 16 %.
    shape, count = (512, 640), 512 * 640
    squares = np.random.default_rng(6).normal(size=(shape[0] // side, shape[1] // side))
    residual = np.kron(squares, np.ones((side, side))).ravel()
    nothing = np.zeros((2, count), np.float32)
    sight = Sight(np.arange(count), nothing[0], nothing[0], nothing, nothing, nothing, nothing)
    assert abs(correlated_pixels(shape, sight, residual, np.full(count, 9.0)) / alike - 1.0) < 0.16


@pytest.mark.parametrize(("side", "count"), [(1.0, 1), (2.0, 2), (3.0, 3), (4.0, 4), (1.25, 2000), (0.4, 1)])
def test_texel_means_are_those_of_the_bilinear_map_at_the_scene_s_texels(side, count):
    values = np.random.default_rng(4).normal(size=SHAPE)
    fine = (np.arange(count) + 0.5) / count - 0.5
    row, column = (3 + fine)[:, None] + 0.0 * fine, (2 + fine)[None, :] + 0.0 * fine[:, None]
    expected = bilinear(values, row.ravel(), column.ravel()).mean()
    # Midpoints stand for an integral to the square of their distance.
    assert abs(texel_means(values, side)[3, 2] - expected) < 1e-6
