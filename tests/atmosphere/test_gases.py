"""Absorption by the gases: nodes against all of RRTMGP's g points, LOWTRAN7 as a second opinion, gases of a year.

`gpoints_reference.npz` and `gpoints_midwave_reference.npz` hold radiances of lines of sight and skies by all g points
of the published file, in double precision, of columns that the nodes were not chosen for. `python -m tools.rrtmgp`
writes them.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermorender.atmosphere.air_column import AEROSOL_CM1, AirColumn, of_year, with_gases
from thermorender.atmosphere.gpoints import GPoints
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.nodes import MOST_NODES, inside_of
from thermorender.atmosphere.packed import packed, unpacked
from thermorender.atmosphere.rays import EARTH_RADIUS_M
from thermorender.atmosphere.standards import standard_column
from thermorender.atmosphere.table_files import read_table
from thermorender.atmosphere.uncertainty import CONTINUUM, seen_change
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance, band_radiance_derivative, brightness_temperature

HERE = Path(__file__).parent
# Of the page on limits [mK at 20 K of contrast]: median and worst of lines of sight, worst of those of 57 km, root mean
# square of skies.
REFERENCES = ("gpoints_reference.npz", "gpoints_midwave_reference.npz")
STATED_MK = {
    (3.7, 4.8): (15, 129, 92, 16), (3.1, 4.8): (12, 108, 67, 17), (3.5, 4.1): (9, 75, 105, 10),
    (3.8, 4.2): (21, 215, 182, 52), (4.5, 4.8): (22, 187, 110, 35),
    (7.5, 13.5): (10, 81, 62, 54), (8.0, 14.0): (7, 75, 62, 56), (8.0, 12.0): (23, 144, 97, 73),
    (10.0, 12.0): (10, 151, 191, 61), (8.0, 9.5): (21, 78, 101, 49),
}  # fmt: skip


def errors():
    """{band: (errors of lines of sight up to 23 km [mK], of 57 km, of skies, nodes)} against all g points."""
    found = {}
    for name in REFERENCES:
        found |= errors_against(HERE / name)
    return found


def errors_against(path):
    """The same of one file."""
    with np.load(path, allow_pickle=False) as stored:
        data = dict(stored)
    columns = [standard_column(str(read_table()["model"][int(n)]), *change) for n, *change in data["column"]]
    first, last, length = data["path"].T
    found = {}
    for band, paths, skies in zip(data["band_um"], data["paths"], data["skies"], strict=True):
        off: tuple[list, list] = ([], [])
        for column, seen, sky in zip(columns, paths, skies, strict=True):
            air = Atmosphere.of_column(column, tuple(band))
            through, own = air.path(first, last, length)
            target = air.planck(air.air_temperature(last) + data["contrast_k"])
            slope = band_radiance_derivative(float(air.temperature[0]) + 0.5 * float(data["contrast_k"]), *band)
            off[0].append(((through * target + own).sum(axis=-1) - seen) / slope)
            up = np.zeros(len(data["sky"]))
            off[1].append((air.sky_radiance(up, data["sky"]).sum(axis=-1) - sky) / slope)
        # The last line of sight is 57 km long, 85° from the vertical.
        paths = 1e3 * np.array(off[0])
        found[tuple(band.tolist())] = paths[:, :-1], paths[:, -1], 1e3 * np.array(off[1]), air.nodes
    return found


def test_nodes_err_against_all_g_points_as_stated():
    found = errors()
    assert {*found} == {*STATED_MK}
    for band, (paths, far, skies, nodes) in found.items():
        assert nodes <= MOST_NODES == 20
        seen = np.median(np.abs(paths)), np.abs(paths).max(), np.abs(far).max(), np.sqrt(np.mean(skies**2))
        # Millikelvins repeat: the file and the tables are fixed.
        assert seen == pytest.approx(STATED_MK[band], abs=2.0, rel=0.05), band


def test_lowtran_differs_as_stated():
    """LOWTRAN7, with gases of its time: 6 standard atmospheres without aerosol, targets 20 K warmer than their air."""
    with np.load(HERE / "atmosphere_reference.npz", allow_pickle=False) as stored:
        case, offset, path, value = (np.float64(stored[key]) for key in ("case", "offset", "path", "value"))
    gases = dict.fromkeys(("cfc11_ppt", "cfc12_ppt", "cfc22_ppt", "ccl4_ppt", "cf4_ppt"), 0.0) | {"co2_ppm": 330.0}
    off = []
    for (model, haze), (warmer, _), (from_m, to_m, zenith), true in zip(case, offset, path, value, strict=True):
        if haze or warmer or not to_m:
            continue
        air = Atmosphere.standard(str(read_table()["model"][int(model)]), year=1985, gases=gases).in_band(7.5, 13.5)
        cosine, up, low = np.cos(np.radians(zenith)), EARTH_RADIUS_M + from_m, EARTH_RADIUS_M + to_m
        root = np.sqrt(max((up * cosine) ** 2 + low**2 - up**2, 0.0))
        length = max(-up * cosine + (root if cosine > 0.0 else -root), abs(to_m - from_m))
        through, own = air.path(from_m, to_m, length)
        seen = (through * air.planck(air.air_temperature(to_m) + 20.0) + own).sum()
        kelvin = brightness_temperature(np.array([seen, true[0, 0]]), 7.5, 13.5)
        off.append(1e3 * (kelvin[0] - kelvin[1]))
    assert len(off) == 24
    # 282 mK in the median: much more than the nodes' own error.
    assert np.median(np.abs(off)) == pytest.approx(282.0, abs=2.0)
    assert np.abs(off).max() == pytest.approx(1543.0, abs=5.0)


# Transmittance of MODTRAN 4's gases and of its haze over 5 km, weighed by a blackbody of 300 K (pyradi's tape
# `horizon5kmtropical`), and of our gases, by band [µm].
MODTRAN = {
    (3.08, 3.73): (0.450, 0.910, 0.417), (3.73, 4.17): (0.707, 0.920, 0.660), (4.17, 4.45): (0.013, 0.923, 0.007),
    (4.45, 4.8): (0.192, 0.926, 0.175), (3.7, 4.8): (0.271, 0.924, 0.248),
}  # fmt: skip


def test_modtran_differs_in_the_mid_wave_as_stated():
    """Tropical air at the ground with a rural haze of 23 km, 330 ppm of CO₂ and no CFCs."""
    others = ("cfc11", "cfc12", "cfc22", "ccl4", "cf4", "hfc134a", "hfc23", "hfc32", "hfc125", "hfc143a")
    gases = {f"{gas}_ppt": 0.0 for gas in others} | {"co2_ppm": 330.0}
    clear, hazy = (Atmosphere.standard("tropical", each, year=2000, gases=gases) for each in ("none", "rural-23km"))
    for band, (theirs, haze, ours) in MODTRAN.items():
        seen = []
        for air in (clear, hazy):
            own = air.in_band(*band)
            black = own.planck(300.0)
            seen.append(float(own.transmittance(0.0, 0.0, 5000.0) @ black / black.sum()))
        assert seen[0] == pytest.approx(ours, abs=1e-3) and abs(seen[0] - theirs) < 0.05, band
        # Both have the haze of Shettle and Fenn (1979).
        assert seen[1] / seen[0] == pytest.approx(haze, rel=6e-3), band


def test_carbon_monoxide_and_nitrogen_are_those_of_the_atmospheres():
    """Anderson and others (1986), US standard: 0.150 ppm at the ground, 0.130 at 5 km, 0.0996 at 10 km."""
    column = standard_column("us-1976")
    found = np.interp([0.0, 5e3, 1e4], column.altitude_m, 1e6 * column.mixing["co"])
    assert found == pytest.approx([0.150, 0.1303, 0.0996], rel=0.01)
    assert (column.mixing["n2"] == 0.78084).all()


def test_packed_numbers_come_back():
    random = np.random.default_rng(3)
    values = random.lognormal(-50.0, 8.0, (5, 7, 3, 4)) * (random.random((5, 7, 3, 4)) > 0.2)
    found = unpacked(*packed(values))
    assert (found[values == 0.0] == 0.0).all() and (found[values > 0.0] > 0.0).all()
    ratio = np.log(found[values > 0.0] / values[values > 0.0])
    span = np.log(values[values > 0.0])
    # Half a step of the 65534 between the least and the largest of a point.
    assert np.abs(ratio).max() < 0.51 * np.ptp(span) / 65533
    assert np.abs(np.log(unpacked(*packed(values, 1e-2))[values > 0.0] / values[values > 0.0])).max() < 0.00501
    nothing = np.zeros((2, 2, 1, 2))
    assert np.array_equal(unpacked(*packed(nothing)), nothing)


def test_spectra_of_g_points_are_distributions_within_their_bands():
    tables = GPoints.shipped()
    assert tables.spectrum.min() >= 0.0
    # Half precision.
    np.testing.assert_allclose(tables.spectrum.sum(axis=-1), 1.0, atol=2e-3)
    middle, own = tables.middles(), tables.wavenumber[tables.band_of]
    outside = (middle < own[:, :1]) | (middle > own[:, 1:])
    assert (tables.spectrum[:, outside] == 0.0).all()
    # Both parts of a cut are the whole.
    for water in (1e-7, 3e-4, 0.02, 0.1):
        halves = sum(inside_of(tables, *ends, water) for ends in ((630.0, 741.3), (741.3, 1480.0)))
        np.testing.assert_allclose(halves.sum(axis=1), tables.spectrum_at(water).sum(axis=1), atol=2e-3)


def test_a_band_that_barely_reaches_into_another_changes_little():
    column = standard_column("us-1976")
    whole, cut = (Atmosphere.of_column(column, (8.475, upper)) for upper in (10.2040, 10.2060))
    through = [
        (air.transmittance(0.0, 0.0, 5e3) * air.planck(290.0)).sum() / air.planck(290.0).sum() for air in (whole, cut)
    ]
    assert through[0] == pytest.approx(through[1], abs=1e-3)


def test_another_band_follows_from_the_column_again():
    air = Atmosphere.standard("tropical", "rural-5km", cloud_fraction=0.5, cloud_base_m=1500.0)
    twice, once = air.in_band(8.0, 14.0).in_band(10.0, 12.0), air.in_band(10.0, 12.0)
    assert np.array_equal(twice.density, once.density) and np.array_equal(twice.weight, once.weight)
    assert twice.cloud_fraction == 0.5 and twice.cloud_base_m == 1500.0 and twice.column is air.column
    # Arrays of one's own have no column, so that a band is cut from them.
    thinner = replace(once, density=0.5 * once.density)
    assert thinner.column is None
    assert np.array_equal(thinner.in_band(10.0, 11.0).density, 0.5 * once.density)


def test_gases_of_a_year_are_the_tables():
    gases = of_year(2024)
    assert gases["co2"] == pytest.approx(422.77e-6) and gases["ch4"] == pytest.approx(1929.7e-9)
    assert gases["cfc12"] == pytest.approx(482.9e-12)
    assert of_year(2022)["co2"] == pytest.approx(417.605e-6) and of_year(1900) == of_year(1985)
    # By the slope of 2020 to 2024.
    assert of_year(2028)["co2"] == pytest.approx(433.1e-6)
    assert of_year(2040)["ccl4"] > 0.0
    for year in (1700.0, 2041.0, np.nan):
        with pytest.raises(ThermorenderError, match=r"year=.* is out of range; give 1750 … 2040 \(of the gases\)"):
            of_year(year)


def test_stated_gases_replace_those_of_the_year_and_keep_their_profile():
    water, carbon = np.array([1e-2, 1e-5]), np.array([3.3e-4, 3.0e-4])
    mixing = with_gases({"h2o": water, "o3": water, "co2": carbon}, 2020, {"co2_ppm": 660.0})
    assert mixing["co2"] == pytest.approx([6.6e-4, 6.0e-4]) and mixing["h2o"] is water
    assert mixing["n2o"] == pytest.approx(np.full(2, 333.29e-9))
    words = r"gases has the key 'co2'; give one of co2_ppm, ch4_ppb,"
    with pytest.raises(ThermorenderError, match=words):
        Atmosphere.standard(gases={"co2": 500.0})
    with pytest.raises(ThermorenderError, match="gases has the key 'xenon_ppm'; give one of co2_ppm"):
        Atmosphere.standard(gases={"co2_ppm": 500.0, "xenon_ppm": 1.0})
    with pytest.raises(ThermorenderError, match=r"gases.co2_ppm=-1 is out of range"):
        Atmosphere.standard(gases={"co2_ppm": -1.0})


@pytest.mark.parametrize(("gas", "band"), [("co2_ppm", (12.5, 13.5)), ("ch4_ppb", (7.5, 8.2)), ("n2o_ppb", (7.5, 8.2)),
                                           ("cfc12_ppt", (10.7, 11.0)), ("cfc11_ppt", (11.6, 12.0))])  # fmt: skip
def test_more_of_a_gas_absorbs_more_in_its_band(gas, band):
    now = of_year(2025)[gas.rpartition("_")[0]] / {"ppm": 1e-6, "ppb": 1e-9, "ppt": 1e-12}[gas.rpartition("_")[2]]
    through = [
        (lambda air: (air.transmittance(0.0, 0.0, 5e3) * air.weight).sum())(
            Atmosphere.standard("subarctic-winter", gases={gas: times * now}).in_band(*band)
        )
        for times in (0.0, 1.0, 2.0)
    ]
    assert through[0] > through[1] > through[2]


def test_dry_cold_and_thin_columns_are_finite():
    levels = np.array([0.0, 3e4, 1e5])
    for kelvin, water in ((150.0, 0.0), (340.0, 0.5), (250.0, 1e-7)):
        mixing = {"h2o": np.full(3, water), "o3": np.zeros(3)}
        column = AirColumn(levels, np.array([1.1e5, 1.2e3, 0.03]), np.full(3, kelvin), with_gases(mixing))
        air = Atmosphere.of_column(column, (7.5, 13.5))
        sky = air.sky_radiance(0.0, 0.3)
        assert np.isfinite(sky).all() and (sky >= 0.0).all()
        assert sky.sum() <= air.planck(kelvin).sum() * (1.0 + 1e-12)


def test_uncertainty_is_that_of_the_continuum_and_of_what_the_air_changes():
    air = Atmosphere.standard("tropical").in_band(7.5, 13.5)
    path, target = (0.0, 0.0, 2000.0), 320.0
    found = seen_change(air, *path, target)
    tables = GPoints.shipped()
    through, added = air.path(*path)
    seen = (through * air.planck(target) + added).sum()
    square = (0.005 * (seen - air.planck(target).sum())) ** 2
    assert tables.continuum == (0.17, 0.2)
    for kind, more in zip(CONTINUUM, tables.continuum, strict=True):
        minor = [
            tuple(replace(one, cross_section=one.cross_section * (1.0 + more * (one.kind == kind))) for one in part)
            for part in tables.minor
        ]
        wetter = Atmosphere.of_column(air.column, (7.5, 13.5), tables=replace(tables, minor=tuple(minor)))
        through, added = wetter.path(*path)
        square += ((through * wetter.planck(target) + added).sum() - seen) ** 2
    assert found == pytest.approx(np.sqrt(square), rel=1e-9)
    # A tenth of the change that tropical air makes, at most; none where target and air are equally warm.
    assert 0.01 * abs(seen - air.planck(target).sum()) < found < 0.1 * abs(seen - air.planck(target).sum())
    same = replace(air, temperature=np.full_like(air.temperature, target))
    assert seen_change(same, *path, target) is None
    dry = Atmosphere.standard("tropical", humidity_factor=0.0).in_band(7.5, 13.5)
    through, added = dry.path(*path)
    change = (through * dry.planck(target) + added).sum() - dry.planck(target).sum()
    assert seen_change(dry, *path, target) == pytest.approx(0.005 * abs(change), rel=1e-6)


def test_a_saved_atmosphere_keeps_its_column(tmp_path):
    whole = Atmosphere.standard("tropical", "rural-5km", 3.0, 1.5, 0.3, 1500.0)
    whole.save(tmp_path / "air.npz")
    found, wanted = (each.in_band(8.0, 14.0) for each in (Atmosphere.load(tmp_path / "air.npz"), whole))
    assert np.array_equal(found.density, wanted.density) and np.array_equal(found.weight, wanted.weight)
    assert found.cloud_fraction == 0.3 and found.column.mixing.keys() == whole.column.mixing.keys()
    # The band that was saved comes back as it is.
    wanted.save(tmp_path / "band.npz")
    again = Atmosphere.load(tmp_path / "band.npz")
    assert again.in_band(8.0, 14.0) is again
    with np.load(tmp_path / "air.npz") as stored:
        values = dict(stored)
    for name, change, words in (
        ("gas", lambda v: np.where(v == "h2o", "xenon", v), "mixing has no h2o"),
        ("gas", lambda v: np.array([*v[:-1], "xenon"]), "mixing has the gas 'xenon'; the tables know h2o,"),
        ("mixing", lambda v: -v, "mixing of .* holds -.*; it must not be negative"),
        ("mixing", lambda v: v[:, :-1], r"mixing is .* but column is .*; both have the axis K"),
        ("column", lambda v: v[:2], r"column is \(2, 37\), but \(3, K\) is needed"),
        ("column", lambda v: v * [[1.0], [0.01], [1.0]], "pressure_pa is 1013 at the lowest level; give pascals"),
        ("extinction", lambda v: v[:3], r"extinction has the shape \(3, 37\); give \(30, 37\)"),
        ("extinction", None, "it has no array extinction"),
    ):
        other = values | {name: change(values[name])} if change else {k: v for k, v in values.items() if k != name}
        np.savez(tmp_path / "bad.npz", **other)
        with pytest.raises(ThermorenderError, match=words) as caught:
            Atmosphere.load(tmp_path / "bad.npz")
        assert "bad.npz" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"altitude_m": [0.0, 0.0, 1e4]}, "levels are out of order; altitude_m must rise and pressure_pa fall"),
        ({"pressure_pa": [1e5, 1.1e5, 3e4]}, "levels are out of order"),
        ({"temperature": [20.0, 10.0, -30.0]}, "temperature holds 20, not an air temperature in kelvin"),
        ({"temperature": [290.0, np.nan, 240.0]}, "temperature holds nan; give finite numbers"),
        ({"mixing": {"co2": [4e-4] * 3}}, "mixing has no h2o; give water vapour, at least zeros"),
        ({"mixing": {"h2o": [1e-2, 1e-3]}}, r"mixing of h2o has the shape \(2,\); give as many numbers"),
        ({"mixing": {"h2o": [1e-2, -1e-3, 0.0]}}, "mixing of h2o holds -0.001; it must not be negative"),
    ],
)
def test_a_column_that_is_no_air_is_refused(change, words):
    column = {"altitude_m": [0.0, 2e3, 1e4], "pressure_pa": [1e5, 8e4, 3e4], "temperature": [290.0, 280.0, 240.0],
              "mixing": {"h2o": [1e-2, 1e-3, 1e-5]}}  # fmt: skip
    assert Atmosphere.of_column(AirColumn(**column), (8.0, 12.0)).nodes
    with pytest.raises(ThermorenderError, match=words):
        AirColumn(**column | change)


def test_a_column_cannot_be_changed_later():
    air = Atmosphere.standard()
    with pytest.raises(ValueError, match="read-only"):
        air.column.mixing["co2"][:] *= 2.0


def test_a_sounding_of_thousands_of_levels_is_air_as_that_of_every_tenth():
    altitude = np.linspace(0.0, 3e4, 4801)
    temperature, pressure = 300.0 - 6e-3 * np.minimum(altitude, 1.2e4), 1e5 * np.exp(-altitude / 8e3)
    mixing = with_gases({"h2o": 1e-2 * np.exp(-altitude / 2e3), "o3": np.full(4801, 1e-7)})
    fine = AirColumn(altitude, pressure, temperature, mixing)
    coarse = fine.at(altitude[::10])
    one, other = (Atmosphere.of_column(each, (7.5, 13.5)) for each in (fine, coarse))
    assert len(one.altitude_m) < 600
    seen = [air.path(2000.0, 0.0, 2500.0)[1].sum() for air in (one, other)]
    assert 1e3 * abs(seen[0] - seen[1]) / band_radiance_derivative(290.0, 7.5, 13.5) < 5.0


def test_bands_in_the_wrong_order_and_amounts_that_are_no_numbers_are_named():
    air = Atmosphere.standard()
    for band in ((14.0, 8.0), (9.0, 9.0), (np.nan, 9.0)):
        with pytest.raises(ThermorenderError, match="µm is empty; give the shorter wavelength first"):
            air.in_band(*band)
    with pytest.raises(ThermorenderError, match="year is '2020'; give a number"):
        Atmosphere.standard(year="2020")
    with pytest.raises(ThermorenderError, match=r"gases.co2_ppm is '400'; give a number of ppm"):
        Atmosphere.standard(gases={"co2_ppm": "400"})
    with pytest.raises(ThermorenderError, match=r"gases.ch4_ppb=2e\+09 is out of range; give 0 … 1e\+09 \(ppb\)"):
        Atmosphere.standard(gases={"ch4_ppb": 2e9})
    # Whole metres are numbers too.
    assert air.sky_temperature(0) == air.sky_temperature(0.0)


def test_an_aerosol_is_in_the_nodes_whose_light_it_meets():
    column = standard_column("us-1976")
    above = AEROSOL_CM1[:-1] > 1100.0
    extinction = np.where(above[:, None], 1e-3, 0.0) * np.ones(len(column.altitude_m))
    clear, hazy = (Atmosphere.of_column(column, (7.5, 13.5), each) for each in (None, extinction))
    added = (hazy.density - clear.density)[:, 0]
    wavenumber = 1e4 / clear.upper_um, 1e4 / clear.lower_um
    assert np.abs(added[wavenumber[1] < 1100.0]).max() < 1e-9
    assert added[wavenumber[0] > 1150.0] == pytest.approx(1e-3, rel=1e-6)
    # The band that 1130 cm⁻¹ cuts has its share of it.
    cut = (wavenumber[0] < 1130.0) & (wavenumber[1] > 1130.0)
    part = band_radiance(285.0, 1e4 / wavenumber[1][cut][0], 1e4 / 1130.0)
    whole = band_radiance(285.0, clear.lower_um[cut][0], clear.upper_um[cut][0])
    assert clear.weight[cut] @ added[cut] == pytest.approx(1e-3 * part / whole, rel=0.02)
