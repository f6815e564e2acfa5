"""Fits of correlations: exact sums, recovery of known coefficients, and pictures with too little information."""

import numpy as np
import pytest
from support import shared_data

from thermorender.apps.training.correlation_training import _equations, _Table, fit_correlation
from thermorender.apps.training.task import Example, Task
from thermorender.apps.training.training_methods import method
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import PUBLISHED_1TO1, PUBLISHED_9TO1
from thermorender.learned.temperature_map import Inputs
from thermorender.paths import data_folder
from thermorender.scene.orthophoto import read_colour


def task(examples, intensity, **options):
    return Task(examples, intensity, intensity + 280.0, 0, lambda *_: None, options)


def as_values(intensity):
    """Intensities as integers, and the table that they index."""
    table, values = np.unique(intensity, return_inverse=True)
    return values.reshape(intensity.shape), table


def described_by(map_, rgb, valid=None):
    """(example, table) of a picture whose thermal picture is the output of a map."""
    values, table = as_values(map_.predict(Inputs(rgb), 1.0))
    return Example(Inputs(rgb), values, np.ones(values.shape, bool) if valid is None else valid), table


@pytest.fixture(params=["shipped", "surveyed"])
def orthophoto(request):
    """(rgb, valid) of an orthophoto: a procedural one, and one from drone photographs."""
    if request.param == "shipped":
        return read_colour(data_folder("scenes") / "village" / "survey" / "orthophoto.tif")
    return read_colour(shared_data("terrain/odm_toufeng/orthophoto_0.2m.tif"))


@pytest.mark.parametrize(("size", "known"), [(1, PUBLISHED_1TO1), (3, PUBLISHED_9TO1)], ids=["1to1", "9to1"])
def test_fit_recovers_known_coefficients(orthophoto, size, known):
    rgb, valid = orthophoto
    middle = slice(len(rgb) // 2 - 300, len(rgb) // 2 + 300)
    example, table = described_by(known, rgb[middle, middle], valid[middle, middle])
    found = fit_correlation(task([example], table), size)
    assert np.abs(found.kernel - known.kernel).max() < 1e-9
    assert found.intercept == 0.0
    with_intercept = fit_correlation(task([example], table, intercept=True), size)
    assert np.abs(with_intercept.kernel - known.kernel).max() < 1e-9 and abs(with_intercept.intercept) < 1e-9


@pytest.mark.parametrize(("darkest", "invalid"), [(0, 0.0), (0, 0.01), (0, 0.2), (255, 0.0), (255, 0.2)])
def test_normal_equations_are_integers_without_rounding(darkest, invalid):
    g = np.random.default_rng(1)
    rgb, valid = g.integers(darkest, 256, (19, 530, 3), dtype=np.uint8), g.random((19, 530)) >= invalid
    values = g.integers(0, 1000, (19, 530))
    intensity = np.linspace(-0.3, 1.4, 1000)
    found = _equations(Example(Inputs(rgb), values, valid), 3, _Table(intensity))
    rows, target = [], []
    for i in range(1, 18):
        for j in range(1, 529):
            # A neighbourhood counts only where all of it is valid.
            if valid[i - 1 : i + 2, j - 1 : j + 2].all():
                rows.append([*rgb[i - 1 : i + 2, j - 1 : j + 2].ravel().tolist(), 1])
                target.append(intensity[values[i, j]])
    a = np.array(rows, dtype=np.int64)
    np.testing.assert_array_equal(np.triu(found[:28, :28]), np.triu(a.T @ a))
    np.testing.assert_allclose(found[:28, 28], a.T @ np.array(target), rtol=1e-11)


@pytest.mark.parametrize("size", [5, 7])
def test_larger_neighbourhoods_are_least_squares_too(size):
    g = np.random.default_rng(size)
    rgb, noise = g.integers(0, 256, (60, 70, 3), dtype=np.uint8), g.random((60, 70))
    values, table = as_values(noise)
    found = fit_correlation(task([Example(Inputs(rgb), values, np.ones(values.shape, bool))], table, intercept=True),
                            size)  # fmt: skip
    ring = size // 2
    windows = np.lib.stride_tricks.sliding_window_view(rgb / 255.0, (size, size), axis=(0, 1))
    a = np.moveaxis(windows, 2, -1).reshape(-1, 3 * size * size)
    a = np.column_stack([a, np.ones(len(a))])
    expected = np.linalg.lstsq(a, noise[ring:-ring, ring:-ring].ravel(), rcond=None)[0]
    np.testing.assert_allclose(found.kernel.ravel(), expected[:-1], atol=1e-10)
    assert found.intercept == pytest.approx(expected[-1], abs=1e-10)


def test_pictures_are_summed_and_invalid_ones_ignored():
    g = np.random.default_rng(2)
    pictures = [g.integers(0, 256, (24, 24, 3), dtype=np.uint8) for _ in range(40)]
    joined = np.concatenate(pictures)
    values, table = as_values(PUBLISHED_1TO1.predict(Inputs(joined), 1.0))
    parts = np.split(values, 40)
    full = np.ones((24, 24), bool)
    examples = [Example(Inputs(p), v, full) for p, v in zip(pictures, parts, strict=True)]
    wrong = Example(Inputs(pictures[0]), parts[1], ~full)
    found = fit_correlation(task([*examples, wrong], table), 1)
    np.testing.assert_allclose(found.kernel, PUBLISHED_1TO1.kernel, atol=1e-10)


def test_ridge_matches_its_closed_form():
    g = np.random.default_rng(3)
    rgb, target = g.integers(0, 256, (40, 40, 3), dtype=np.uint8), g.random((40, 40))
    values, table = as_values(target)
    example = Example(Inputs(rgb), values, np.ones(values.shape, bool))
    a = rgb.reshape(-1, 3) / 255.0
    for ridge in (0.0, 0.01, 1.0):
        expected = np.linalg.solve(a.T @ a / len(a) + ridge * np.eye(3), a.T @ target.ravel() / len(a))
        found = fit_correlation(task([example], table, penalty=ridge), 1)
        np.testing.assert_allclose(found.kernel.ravel(), expected, rtol=1e-10)


def test_kelvin_above_air_temperature():
    g = np.random.default_rng(6)
    known, examples = PUBLISHED_1TO1, []
    air = (270.0, 301.25)
    pictures = [g.integers(0, 256, (30, 30, 3), dtype=np.uint8) for _ in air]
    kelvin = np.stack([10.0 * known.predict(Inputs(p), 1.0) + 3.0 + a for p, a in zip(pictures, air, strict=True)])
    values, table = as_values(kelvin)
    for rgb, own, a in zip(pictures, values, air, strict=True):
        examples.append(Example(Inputs(rgb, conditions={"air_k": a}), own, np.ones(own.shape, bool)))
    options = {"intercept": True, "above_air": True}
    found = fit_correlation(Task(examples, table - 280.0, table, 0, lambda *_: None, options), 1)
    np.testing.assert_allclose(found.kernel, 10.0 * known.kernel, atol=1e-8)
    assert found.intercept == pytest.approx(3.0, abs=1e-8) and found.above_air and found.needs == ("conditions",)
    with pytest.raises(ThermorenderError, match="above_air=true needs the air's temperature of every pair"):
        fit_correlation(task([Example(Inputs(pictures[0]), values[0], np.ones((30, 30), bool))], table, above_air=True),
                        1)  # fmt: skip


def test_underdetermined_fits_are_refused():
    grey = np.repeat(np.random.default_rng(4).integers(0, 256, (30, 30, 1), dtype=np.uint8), 3, axis=2)
    values, table = as_values(grey[..., 0] / 255.0)
    example = Example(Inputs(grey), values, np.ones(values.shape, bool))
    with pytest.raises(ThermorenderError, match=r"determine only 9 of 27 coefficients.*grey.*penalty=1e-6"):
        fit_correlation(task([example], table), 3)
    assert np.isfinite(fit_correlation(task([example], table, penalty=1e-6), 3).kernel).all()
    small = Example(Inputs(grey[:2, :2]), values[:2, :2], np.ones((2, 2), bool))
    with pytest.raises(ThermorenderError, match="no picture has a valid neighbourhood of 3 × 3 pixels"):
        fit_correlation(task([small], table), 3)
    with pytest.raises(ThermorenderError, match="method 'correlation-9to2' is unknown; did you mean"):
        method("correlation-9to2")
    for name in ("correlation-4x4", "correlation-17x17", "correlation-3x5"):
        with pytest.raises(ThermorenderError, match="odd N up to 15"):
            method(name)
