"""The held-out sites: their declaration, and the conversion of public files to their tables."""

from datetime import datetime

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from validation.heat import convert, study
from validation.heat.sites import read_sites

HELD_OUT = study.SITES.with_name("held_out.toml")


def test_held_out_sites_are_not_among_those_of_the_project():
    library, sites = load_library(), read_sites(HELD_OUT)
    assert len(sites) >= 5
    assert not {site.file for site in sites} & {site.file for site in read_sites(study.SITES)}
    for site in sites:
        assert all(library[name].thermal for name, _ in site.cover)
        assert site.aim_k is None, "no aim was set before the scores"


def test_logger_gives_irradiances_in_the_middle_of_ten_minutes():
    """120 µV over 12 µV per W/m², as 10 times the hundred-thousandth of a volt; long-wave adds the body's emission."""
    names = convert.LOGGER_NAMES["roof"]
    row = [1000.0, 20.0, 50.0, 2.0, 133.4, 11.9, -96.3, 9.72, 0.0]
    lines = ["a logger", "TIMESTAMP," + ",".join(names), "units", "kinds"]
    lines += ["2022-06-20 00:10:00," + ",".join(map(str, row)), "2022-06-20 00:20:00," + ",".join(["NAN"] * 9)]
    time, columns = convert.logger("roof", "\n".join(lines).encode())
    assert time[0] == datetime(2022, 6, 20, 0, 5)
    body = 5.670374419e-8 * 273.15**4
    expected = {"sw_down_w_m2": 100.0, "sw_up_w_m2": 10.0, "lw_down_w_m2": body - 100.0, "lw_up_w_m2": body + 10.0}
    assert {name: columns[name][0] for name in expected} == pytest.approx(expected)
    assert all(np.isnan(values[1]) for values in columns.values())


def test_means_need_half_of_the_values():
    time = [datetime(2020, 1, 1, 0, minute) for minute in (5, 15, 25, 35, 45, 55)]
    found, columns = convert.averaged(time, {"a": np.array([1.0, 2.0, np.nan, np.nan, np.nan, 6.0])}, 30)
    assert found == [datetime(2020, 1, 1, 0, 15), datetime(2020, 1, 1, 0, 45)]
    assert columns["a"][0] == 1.5 and np.isnan(columns["a"][1])


def test_meadow_is_in_summer_time():
    light = [f"surface_{way}welling_{long}wave_flux" for way in ("down", "up") for long in ("short", "long")]
    names = ["Date", "rainfall_amount", "wind_speed", "relative_humidity", "air_temperature", *light]
    rows = ["01/07/2015 14:00,0,2,0.5,20,900,350,180,420", "01/12/2015 14:00,0,2,0.5,2,300,250,60,310"]
    time, columns = convert.irrigated_meadow(f"{','.join(names)}\n{chr(10).join(rows)}\n".encode())
    assert time == [datetime(2015, 7, 1, 11, 30)]
    assert {name: values.tolist() for name, values in columns.items()} == {
        "air_c": [20.0], "rh_percent": [50.0], "wind_m_s": [2.0], "rain_mm": [0.0], "sw_down_w_m2": [900.0],
        "sw_up_w_m2": [180.0], "lw_down_w_m2": [350.0], "lw_up_w_m2": [420.0],
    }  # fmt: skip


def test_cover_without_comparison_values_is_refused(tmp_path):
    text = HELD_OUT.read_text("utf-8").replace('"roof_felt"', '"gold_plate"')
    (tmp_path / "sites.toml").write_text(text, "utf-8")
    with pytest.raises(
        ThermorenderError, match=r"site 'roof': cover='gold_plate' has no values .* asphalt, brick_clay"
    ):
        study.run(tmp_path / "sites.toml", tmp_path)
