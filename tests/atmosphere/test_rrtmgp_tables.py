"""The reader of RRTMGP's tables, on small tables whose interpolation has a closed form; merging of their points."""

import numpy as np
import pytest
from scipy.io import netcdf_file

from tools.rrtmgp import files, fluxes
from tools.rrtmgp.columns import LEVELS_M
from tools.rrtmgp.merging import DEPTHS, Group, Lit, chosen, judged

TEMPERATURE = np.arange(200.0, 321.0, 30.0)
PRESSURE = 1.1e5 * np.exp(-0.2 * np.arange(30))
TROPOPAUSE = 9.9e3
POINTS = 3
GASES = ["h2o", "co2"]


def plain(temperature, level, eta, point):
    """Absorption that is linear in each of its arguments."""
    return (point + 1.0) * 1e-22 * (1.0 + 0.01 * (temperature - 200.0)) * (2.0 + 0.05 * level) * (0.5 + eta)


@pytest.fixture
def tables(tmp_path):
    """Tables of one band: water mixed with carbon dioxide below, carbon dioxide alone above."""
    t, level, eta, point = np.meshgrid(TEMPERATURE, np.arange(31.0), np.linspace(0.0, 1.0, 9), np.arange(POINTS),
                                       indexing="ij")  # fmt: skip
    ratio = np.ones((len(TEMPERATURE), 3, 2))
    ratio[:, 1], ratio[:, 2] = 2e-3, 4e-4
    minor = np.broadcast_to(np.linspace(1.0, 2.0, 9)[None, :, None], (len(TEMPERATURE), 9, POINTS)) * 1e-23
    arrays = {
        "key_species": np.array([[[1, 2], [2, 0]]], np.int32), "kmajor": plain(t, level, eta, point),
        "plank_fraction": (point + 1.0) / 6.0 + 0.0 * t, "totplnk": 5.0 + np.arange(196.0)[None],
        "bnd_limits_gpt": np.array([[1, POINTS]], np.int32), "bnd_limits_wavenumber": np.array([[820.0, 980.0]]),
        "minor_limits_gpt_lower": np.array([[1, POINTS]] * 2, np.int32), "press_ref": PRESSURE,
        "minor_limits_gpt_upper": np.array([[1, POINTS]], np.int32), "press_ref_trop": np.array(TROPOPAUSE),
        "minor_scales_with_density_lower": np.array([1, 0], np.int32), "temp_ref": TEMPERATURE, "vmr_ref": ratio,
        "minor_scales_with_density_upper": np.array([0], np.int32),
        "scale_by_complement_lower": np.array([1, 0], np.int32), "scale_by_complement_upper": np.array([0], np.int32),
        "kminor_lower": np.concatenate([minor, 3.0 * minor], axis=-1),
        "kminor_upper": 7.0 * minor, "kminor_start_lower": np.array([1, 1 + POINTS], np.int32),
        "kminor_start_upper": np.array([1], np.int32),
    }  # fmt: skip
    texts = {
        "gas_names": GASES, "gas_minor": ["h2o", "co2"], "identifier_minor": ["h2o_frgn", "co2"],
        "minor_gases_lower": ["h2o_frgn", "co2"], "scaling_gas_lower": ["h2o", ""], "minor_gases_upper": ["co2"],
        "scaling_gas_upper": [""],
    }  # fmt: skip
    path = tmp_path / "tables.nc"
    with netcdf_file(path, "w") as file:
        for name, values in arrays.items():
            names = [f"{name}_{k}" for k in range(values.ndim)]
            for each, size in zip(names, values.shape, strict=True):
                file.createDimension(each, size)
            file.createVariable(name, values.dtype, names)[...] = values
        file.createDimension("letters", 32)
        for name, words in texts.items():
            file.createDimension(f"{name}_0", len(words))
            values = np.array([list(word.ljust(32)) for word in words], "S1")
            file.createVariable(name, "S1", (f"{name}_0", "letters"))[...] = values
    return files.read(path)


def test_absorption_is_that_of_the_tables_between_their_points(tables):
    pressure, temperature = np.array([9e4, 3e4, 5e3]), np.array([287.0, 243.0, 214.0])
    water, carbon = np.array([8e-3, 2e-4, 3e-6]), np.array([4e-4, 4e-4, 4.2e-4])
    found = tables.absorption(pressure, temperature, {"h2o": water, "co2": carbon})
    for k in range(3):
        level = np.log(pressure[k] / PRESSURE[0]) / -0.2
        upper = pressure[k] < TROPOPAUSE
        # Above the tropopause carbon dioxide is mixed with dry air.
        amount = carbon[k] + 4e-4 if upper else water[k] + 5.0 * carbon[k]
        eta = (carbon[k] if upper else water[k]) / amount
        minor = 1e-23 * (1.0 + eta)
        foreign = minor * water[k] * 0.01 * pressure[k] / temperature[k] * (1.0 - water[k] / (1.0 + water[k]))
        more = 7.0 * minor * carbon[k] if upper else foreign + 3.0 * minor * carbon[k]
        for point in range(POINTS):
            true = amount * plain(temperature[k], level + upper, eta, point) + more
            assert found[point, k] == pytest.approx(true, rel=1e-9, abs=0.0)


def test_gases_that_are_not_given_are_absent(tables):
    none = tables.absorption(np.array([9e4]), np.array([280.0]), {})
    assert (none == 0.0).all()


def test_flux_of_isothermal_opaque_air_is_that_of_a_blackbody(tables):
    pressure, temperature = np.linspace(1e4, 1e5, 40), np.full(40, 280.0)
    thick = {"h2o": np.full(39, 0.02), "co2": np.full(39, 0.5)}
    black = np.pi * tables.radiance(np.array([280.0])).sum()
    assert fluxes.downward(tables, pressure, temperature, thick) == pytest.approx(black, rel=1e-6)


def lit(absorption):
    """Air of some absorption coefficients (G,), falling with height; warmer below."""
    fall = np.exp(-LEVELS_M / 6e3)
    planck = np.linspace(1.0, 2.0, len(absorption))[:, None] * (1.0 + 2.0 * fall) / len(absorption)
    share = np.broadcast_to(1.0 / len(absorption), planck.shape)
    return Lit(np.outer(absorption, fall), share, planck, 1.3 * planck, np.stack([planck, 1.3 * planck]))


def test_points_of_equal_absorption_are_merged_without_error():
    air = lit(np.full(4, 2e-4))
    groups = [Group(slice(0, 4), 1.0)]
    assert np.abs(judged(air, groups, [(0.0, 0.0, 5000.0), (3000.0, 0.0, 5000.0)], [1.0, 0.2])).max() < 1e-9


def test_the_search_finds_a_partition_without_error_and_more_nodes_err_less():
    # Two different pairs of equal points in each band.
    air, band_of = lit(np.array([1e-5, 1e-5, 3e-3, 3e-3, 1e-4, 1e-4, 2e-2, 2e-2])), np.repeat([0, 1], 4)
    groups = chosen([air], band_of, 4)
    assert [each.points for each in groups] == [slice(k, k + 2) for k in (0, 2, 4, 6)]
    random = lit(np.sort(np.random.default_rng(2).lognormal(-9.0, 2.0, (2, 8)), axis=1).ravel())
    band_of, worst = np.repeat([0, 1], 8), []
    for nodes in (2, 4, 8, 16):
        groups = chosen([random], band_of, nodes)
        assert len(groups) == nodes and all(each.depth in DEPTHS for each in groups)
        worst.append(np.abs(judged(random, groups, [(0.0, 0.0, r) for r in (100.0, 2e3, 2e4)], [1.0])).max())
    assert worst[0] > 10.0 * worst[2] and worst[3] < 1e-6
