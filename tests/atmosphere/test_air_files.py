"""Air from the field: MODTRAN's cards and runs, soundings of IGRA and Wyoming, and air that absorbs nothing."""

from dataclasses import replace

import numpy as np
import pytest
from support import shared_data

from thermorender.atmosphere.air_column import saturation_g_m3
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.modtran import atmosphere, read_tape7
from thermorender.atmosphere.profile import read_profile
from thermorender.errors import ThermorenderError

ROWS = [(690.0 + 5 * i, 0.5 + 0.003 * i) for i in range(150)]


def tape7(path, rows, cards="    1    1    0", geometry="   0.00000   0.00000   0.00000   1.00000", end=" -9999."):
    lines = [
        f"T F{cards}    0    1",
        "    1    1    1    0    0    0  23.00000   0.00000   0.00000   0.00000   0.00000",
        " -99.000 -99.000 -99.000",
        " -99.00000 -99.00000 -99.00000",
        "   36TROPICAL MODEL",
        geometry + "   0.00000   0.00000    0        0.00000",
        "  -99  -99  -99  -99",
        " -99.00000 -99.00000",
        "     700.0    1400.0       5.0      10.0NW",
        "    0   0    0.000",
        "    FREQ COMBIN    H2O",
        "    CM-1  TRANS  TRANS",
        *(f"{wavenumber:8.2f} {value:6.4f} 0.9000" for wavenumber, value in rows),
    ]
    path.write_text("\n".join([*lines, end]) + "\n")
    return path


def with_card(path, card):
    lines = path.read_text().splitlines()
    path.write_text("\n".join([card, *lines[1:]]) + "\n")
    return path


@pytest.mark.parametrize("card", ["M F 1    1    0    0    1", "T T 1    1    0    0    1", "MSF+1T   1    0    0    1",
                                  "T   1    1    0    0    1", "CMF 1    1    0    0    1"])  # fmt: skip
def test_card_1_of_every_band_model_gives_the_same_air(tmp_path, card):
    expected = read_tape7(tape7(tmp_path / "t", ROWS), 8.0, 12.0)
    found = read_tape7(with_card(tape7(tmp_path / "m", ROWS), card), 8.0, 12.0)
    assert (found.model, found.aerosol, found.range_m) == (expected.model, expected.aerosol, expected.range_m)
    assert found.band(8.0, 12.0) == expected.band(8.0, 12.0)


def test_numbers_that_touch_are_read_by_their_width(tmp_path):
    # Zenith angle 89.5°, 1117.88687 km.
    geometry = "   0.00000 100.00000  89.500001117.88687"
    tape = read_tape7(tape7(tmp_path / "t", ROWS, cards="    1    3    0", geometry=geometry), 8.0, 12.0)
    assert tape.cos_zenith == pytest.approx(np.cos(np.radians(89.5)))


def test_a_run_of_several_is_chosen(tmp_path):
    one = tape7(tmp_path / "a", ROWS).read_text()
    two = tape7(tmp_path / "b", [(wavenumber, 0.25) for wavenumber, _ in ROWS]).read_text()
    (tmp_path / "both").write_text(one + two)
    with pytest.raises(ThermorenderError, match=r"holds 2 runs; choose one with run=1 … 2"):
        read_tape7(tmp_path / "both", 8.0, 12.0)
    assert read_tape7(tmp_path / "both", 8.0, 12.0, run=2).band(8.0, 12.0)[0] == pytest.approx(0.25)
    assert read_tape7(tmp_path / "both", 8.0, 12.0, run=1).band(8.0, 12.0) == read_tape7(
        tmp_path / "a", 8.0, 12.0
    ).band(8.0, 12.0)
    with pytest.raises(ThermorenderError, match="run=3 is not in"):
        read_tape7(tmp_path / "both", 8.0, 12.0, run=3)
    (tmp_path / "both").write_text(one + two.replace(" -9999.\n", ""))
    with pytest.raises(ThermorenderError, match="holds 2 runs"):
        read_tape7(tmp_path / "both", 8.0, 12.0)
    with pytest.raises(ThermorenderError, match="is truncated"):
        read_tape7(tmp_path / "both", 8.0, 12.0, run=2)


def test_other_spectral_units_are_refused(tmp_path):
    path = tape7(tmp_path / "t", ROWS)
    path.write_text(path.read_text().replace("CM-1", "MICRN"))
    with pytest.raises(ThermorenderError, match="spectral unit 'MICRN'"):
        read_tape7(path, 8.0, 12.0)


def test_imported_table_has_the_transmittance_of_the_file(tmp_path):
    wavenumber = np.arange(690.0, 1431.0, 5.0)
    spectrum = 0.5 + 0.4 * np.sin(wavenumber / 7.0)
    tape = read_tape7(tape7(tmp_path / "tape7", zip(wavenumber, spectrum, strict=True)), 8.0, 12.0)
    assert (tape.model, tape.aerosol, tape.range_m) == ("tropical", "rural-23km", 1000.0)
    air = atmosphere(tape, 8.0, 12.0)
    planck = air.planck(285.0)
    seen = (air.transmittance(0.0, 0.0, 1000.0) * planck).sum() / planck.sum()
    assert seen == pytest.approx(tape.band(8.0, 12.0)[0], abs=2e-4)
    isothermal = replace(air, temperature=0.0 * air.temperature + 290.0)
    assert isothermal.path(0.0, 0.0, 1000.0)[1].sum() < air.planck(290.0).sum()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"end": ""}, "is truncated: its closing line -9999. is missing"),
        ({"rows": [(2000.0 + 5 * i, 0.5) for i in range(50)]}, "covers 4.454–5 µm, .* run MODTRAN from 741 to 1333"),
        ({"rows": [(900.0 + 5 * i, 0.5) for i in range(90)]}, "does not include the camera's band 7.5–13.5 µm"),
        ({"rows": [(700.0, 0.5), (690.0, 0.5)]}, "is damaged: its cards or columns are not numbers"),
        ({"cards": "    7    1    0"}, "has model 7, a user-defined profile"),
        ({"cards": "    1    3    0", "geometry": "   0.00000   0.00000 120.00000   0.00000"}, "unsupported path .*"),
    ],
)
def test_wrong_tape7_is_refused(tmp_path, change, words):
    rows = [(690.0 + 5 * i, 0.5) for i in range(150)]
    with pytest.raises(ThermorenderError, match=words):
        read_tape7(tape7(tmp_path / "tape7", **{"rows": rows, **change}), 7.5, 13.5)


def test_missing_tape7_columns_are_refused(tmp_path):
    (tmp_path / "list.txt").write_text("2000 0.9963\n2001 0.9982\n")
    with pytest.raises(ThermorenderError, match="is not a tape7 of MODTRAN: it has no line of column names"):
        read_tape7(tmp_path / "list.txt", 8.0, 12.0)
    with pytest.raises(ThermorenderError, match="cannot be read"):
        read_tape7(tmp_path / "none", 8.0, 12.0)


def test_modtran_differs_as_the_docs_say():
    """MODTRAN 4, tropical, rural 23 km: a level 5 km path, and straight up; with its gases, which have no CFCs.

    Its sky is 1.7 % darker, of which 0.9 % is scattering.
    """
    gases = dict.fromkeys(("cfc11_ppt", "cfc12_ppt", "cfc22_ppt", "ccl4_ppt", "cf4_ppt"), 0.0) | {"co2_ppm": 330.0}
    level = read_tape7(shared_data("emissivity/pyradi_modtran/horizon5kmtropical.fl7"), 7.5, 13.5)
    up = read_tape7(shared_data("emissivity/pyradi_modtran/tape7.LWIRSun"), 8.0, 12.0)
    for tape, band in ((level, (7.5, 13.5)), (level, (8.0, 12.0)), (up, (8.0, 12.0))):
        air = Atmosphere.standard(tape.model, tape.aerosol, year=1985, gases=gases).in_band(*band)
        planck = air.planck(285.0)
        if tape.cos_zenith is None:
            through = air.transmittance(tape.from_m, tape.to_m, tape.range_m)
        else:
            through = air.sun_transmittance(tape.from_m, tape.cos_zenith)
        expected, light = tape.band(*band)
        assert (through * planck).sum() / planck.sum() == pytest.approx(expected, abs=0.025)
        if light is not None:
            assert air.sky_radiance(tape.from_m, tape.cos_zenith).sum() / light == pytest.approx(1.017, abs=0.005)
    words = r"covers 8–12 µm, which does not include the camera's band 7\.5–13\.5 µm"
    with pytest.raises(ThermorenderError, match=words):
        read_tape7(shared_data("emissivity/pyradi_modtran/tape7.LWIRSun"), 7.5, 13.5)
    with pytest.raises(ThermorenderError, match=r"covers 4.762–5 µm"):
        read_tape7(shared_data("emissivity/pyradi_modtran/ModTrantape7file"), 8.0, 12.0)


# --- air without absorption -----------------------------------------------------------------------------------------


def test_air_that_absorbs_nothing_is_refused(tmp_path):
    air = Atmosphere.standard("tropical")
    replace(air, absorption=0.0 * air.absorption).save(tmp_path / "air.npz")
    with pytest.raises(ThermorenderError, match=r"absorbs nothing over 8–12 µm .*; give the absorption .* or \[sky\]"):
        Atmosphere.load(tmp_path / "air.npz").in_band(8.0, 12.0)


# --- soundings ------------------------------------------------------------------------------------------------------

# Pressure [Pa], height [m], temperature [0.1 °C], humidity [0.1 %], dew point depression [0.1 K].
LEVELS = [
    (100000, 110, 150, 700, -9999),
    (92500, -9999, 102, -9999, 40),
    (85000, 1458, 62, 400, 120),
    (70000, 3040, -8888, 300, 150),
    (50000, 5590, -168, 200, 180),
    (40000, 7210, -290, -9999, -9999),
]


def igra(path, levels=LEVELS, stated=None, hour="00"):
    lines = [f"#USM00070026 2010 06 01 {hour} 2303 {stated or len(levels):4d} ncdc6301 ncdc6301  712889 -1567833"]
    lines += [f"10 -9999 {p:6d}B{z:5d}B{t:5d}B{rh:5d} {dp:5d}    90    51 " for p, z, t, rh, dp in levels]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_igra_soundings_are_read_in_their_units(tmp_path):
    altitude, pressure, temperature, humidity = read_profile(igra(tmp_path / "i.txt"))
    np.testing.assert_allclose(pressure, [1000.0, 925.0, 850.0, 500.0])
    np.testing.assert_allclose(temperature, [288.15, 283.35, 279.35, 256.35])
    np.testing.assert_allclose(altitude[[0, 2, 3]], [110.0, 1458.0, 5590.0])
    # Hydrostatics: 29.27 m/K · 285.75 K · ln(1000/925) above the lowest level.
    assert altitude[1] == pytest.approx(110.0 + 29.27 * 285.75 * np.log(1000 / 925), abs=5.0)
    # Vapour of the dew point, 6.2 °C at 10.2 °C: 76.2 % by Magnus' formula.
    assert humidity[1] == pytest.approx(76.2, abs=0.3) and humidity[0] == 70.0
    assert saturation_g_m3(279.35) < saturation_g_m3(283.35)


def test_igra_files_of_several_or_other_soundings_are_refused(tmp_path):
    text = igra(tmp_path / "a.txt").read_text() + igra(tmp_path / "b.txt", hour="12").read_text()
    (tmp_path / "c.txt").write_text(text)
    with pytest.raises(ThermorenderError, match=r"holds 2 soundings, 2010-06-01T00 to 2010-06-01T12; copy one"):
        read_profile(tmp_path / "c.txt")
    with pytest.raises(ThermorenderError, match="holds 6 levels where its header states 9"):
        read_profile(igra(tmp_path / "a.txt", stated=9))
    wide = igra(tmp_path / "a.txt").read_text().replace("   90    51 ", "   90    51 " + 60 * "1")
    (tmp_path / "a.txt").write_text(wide)
    with pytest.raises(ThermorenderError, match="is not a level of an IGRA sounding"):
        read_profile(tmp_path / "a.txt")


LIST = """\
-----------------------------------------------------------
   PRES   HGHT   TEMP   DWPT   RELH   MIXR
    hPa     m      C      C      %    g/kg
-----------------------------------------------------------
 1000.0    110   15.0    9.6     70   7.52
  850.0   1490    6.2   -6.4     40   2.80
  500.0   5590  -16.8  -34.9     20   0.40
"""


def test_a_list_of_wyoming_states_its_units(tmp_path):
    (tmp_path / "w.txt").write_text(LIST)
    assert read_profile(tmp_path / "w.txt")[2][0] == pytest.approx(288.15)
    (tmp_path / "w.txt").write_text(LIST.replace("hPa", " Pa"))
    with pytest.raises(ThermorenderError, match="states PRES in Pa; give it in hPa"):
        read_profile(tmp_path / "w.txt")
    (tmp_path / "w.txt").write_text(LIST + LIST)
    with pytest.raises(ThermorenderError, match="holds 2 soundings, the second from line 9 on"):
        read_profile(tmp_path / "w.txt")


def test_a_csv_table_of_wyoming_is_read(tmp_path):
    names = (
        "time,longitude,latitude,pressure_hPa,geopotential height_m,temperature_C,relative humidity_%,wind speed_m/s"
    )
    rows = ["1002.0,     , 29.0, 75, 2.1", "1000.0,  110, 15.0, 70, 2.1", " 850.0, 1490,  6.2, 40, 3.0",
            " 500.0, 5590,-16.8, 20, 9.0"]  # fmt: skip
    text = "\n".join([names, *(f"2011-12-31 23:32:00,-99.9900,-99.9900,{row}" for row in rows)])
    (tmp_path / "w.csv").write_text(text + "\n")
    altitude, pressure, temperature, humidity = read_profile(tmp_path / "w.csv")
    assert altitude.tolist() == [110.0, 1490.0, 5590.0] and pressure.tolist() == [1000.0, 850.0, 500.0]
    assert temperature[0] == pytest.approx(288.15) and humidity.tolist() == [70.0, 40.0, 20.0]
