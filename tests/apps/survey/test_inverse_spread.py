"""The error of edges within texels against a least squares fit of edges, sample by sample."""

import numpy as np
import pytest

from thermorender.apps.survey.inverse.spread import error_of_curvature, error_of_edges
from thermorender.apps.survey.inverse.weights import texel_line
from thermorender.sensor.camera import load_camera
from thermorender.sensor.psf import otf

# Texels of a closed line, and samples of each.
COUNT, FINE = 60, 60


def camera():
    return load_camera("zenmuse-xt2")


def tents(position, spacing):
    """Bilinear weights of the middles of texels of a spacing, at positions on the closed line, (N, n)."""
    middles = (np.arange(round(COUNT / spacing)) + 0.5) * spacing
    away = (position[:, None] - middles + COUNT / 2) % COUNT - COUNT / 2
    return np.maximum(1.0 - np.abs(away) / spacing, 0.0)


def fitted(side, pixel):
    """(Squares of errors, squares of second differences) of fits to lines with two edges, summed over their places."""
    position = (np.arange(COUNT * FINE) + 0.5) / FINE
    seen = np.abs(np.fft.fftfreq(position.size, 1.0 / FINE)) * pixel
    transfer = otf(camera(), seen) * np.sinc(seen)

    def blurred(values):
        return np.fft.ifft(np.fft.fft(values, axis=0) * transfer[:, None], axis=0).real

    texels = tents(position, 1.0)
    outer, middle, _ = texel_line(side)
    errors = bends = 0.0
    # Edges of 2·side scene texels in a row have each place once.
    for first in range(round(2.0 * side)):
        scene = np.zeros((round(COUNT * side), 1))
        scene[first : first + round(30 * side) + 1] = 1.0
        knots, *_ = np.linalg.lstsq(blurred(texels), blurred(tents(position, 1.0 / side) @ scene), rcond=None)
        means = middle * knots + outer * (np.roll(knots, 1) + np.roll(knots, -1))
        own = scene[np.floor(position * side).astype(int), 0]
        errors += np.sum((means[:, 0] - own.reshape(COUNT, FINE).mean(axis=1)) ** 2)
        bends += np.sum((np.roll(means, 1) - 2.0 * means + np.roll(means, -1)) ** 2)
    return errors, bends


@pytest.mark.parametrize("side, pixel", [(1.5, 0.5), (2.0, 0.5), (2.5, 0.8), (3.0, 0.3)])
def test_the_error_of_edges_is_that_of_fits_to_edges(side, pixel):
    errors, bends = fitted(side, pixel)
    assert error_of_curvature(camera(), pixel, side) == pytest.approx(errors / bends, rel=0.02)


def test_a_map_of_the_scene_s_own_texels_follows_its_edges():
    assert error_of_curvature(camera(), 0.5, 1.0) < 0.01 * error_of_curvature(camera(), 0.5, 2.0)


def test_the_error_lies_where_the_map_bends_and_neither_where_it_slopes_nor_in_its_noise():
    rows, columns = np.mgrid[:20, :20].astype(float)
    noise = np.zeros((20, 20))
    noise[:, 9] = 0.5
    made = error_of_edges(2.0 * rows + 3.0 * columns + 4.0 * (columns >= 10), noise, 0.01)
    np.testing.assert_allclose(made[1:-1, 9], 0.01 * (16.0 - 12.0 * 0.5), rtol=1e-9)
    np.testing.assert_allclose(made[1:-1, 10], 0.01 * 16.0, rtol=1e-9)
    np.testing.assert_allclose(np.delete(made, [9, 10], axis=1)[1:-1, 1:-1], 0.0, atol=1e-12)
