"""The normal equations of a reconstruction: the stencil against dense matrices, conjugate gradients against NumPy."""

import numpy as np
import pytest

from thermorender.inverse.normal import Normal, Prior, Stencil, Unknowns, cells_of
from thermorender.inverse.weights import Sight

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
    stencil.add(cells_of(sight), precision)
    weights = dense(sight)
    expected = weights.T @ (precision[:, None] * weights)
    found = np.stack([stencil(texel.reshape(SHAPE)).ravel() for texel in np.eye(SHAPE[0] * SHAPE[1])])
    np.testing.assert_allclose(found, expected, atol=1e-13)


def test_stencil_takes_40_bytes_a_texel():
    assert Stencil((30, 20)).link.nbytes == 40 * 600


@pytest.fixture(scope="module")
def problem():
    """Two frames with an offset and a slope each, one common term, three classes: (Normal, dense least squares)."""
    rng = np.random.default_rng(2)
    size = SHAPE[0] * SHAPE[1]
    classes = np.arange(size).reshape(SHAPE) % 3
    precision = rng.uniform(0.1, 0.3, SHAPE)
    prior = Prior(np.zeros(SHAPE), precision, classes, 0.05)
    normal = Normal(prior, np.array([0.4, 0.7]), np.array([0.2]))
    away, at_class, at_common = rng.normal(size=SHAPE), rng.normal(size=3), rng.normal(size=1)
    rows, values = [], []
    count = size + 4 + 1 + 3
    for number in range(2):
        sight, weight = seen_at(rng), rng.uniform(0.5, 2.0, 60)
        own = np.stack([np.ones(60), rng.normal(size=60)])
        common, residual, deviation = rng.normal(size=(1, 60)), rng.normal(size=60), rng.normal(size=2)
        normal.add(sight, residual, weight, own, common, deviation)
        part = np.zeros((60, count))
        part[:, :size] = dense(sight)
        part[:, size + 2 * number : size + 2 * number + 2] = own.T
        part[:, size + 4] = common[0]
        rows.append(np.sqrt(weight)[:, None] * part)
        values.append(np.sqrt(weight) * residual)
        for k in range(2):
            root = np.sqrt((0.4, 0.7)[k])
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


def test_solution_is_that_of_dense_least_squares(problem):
    normal, gradient, expected = problem
    found, _ = normal.solved(gradient, tolerance=1e-9)
    np.testing.assert_allclose(flat(found), expected, atol=1e-5)


def test_conjugate_gradients_solve_the_matrix(problem):
    normal, gradient, _ = problem
    shapes = [part.shape for part in gradient]
    ends = np.cumsum([part.size for part in gradient])
    matrix = []
    for unit in np.eye(ends[-1]):
        parts = (part.reshape(shape) for part, shape in zip(np.split(unit, ends[:-1]), shapes, strict=True))
        matrix.append(flat(normal(Unknowns(*parts))))
    matrix = np.array(matrix)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-6)
    found, steps = normal.solved(gradient, tolerance=1e-8)
    np.testing.assert_allclose(flat(found), np.linalg.solve(matrix, flat(gradient)), atol=1e-5)
    assert steps <= 3 * ends[-1]
