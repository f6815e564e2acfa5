"""Weather files from the field: what they state about text, units, periods and clocks is obeyed or refused."""

import re

import numpy as np
import pytest
from support import slow
from weather_support import PLACE, hours, station, sunlight, write_epw, write_tmy3

from scenes import write_terrain
from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.errors import ThermorenderError
from thermorender.scene.load import load_scene
from thermorender.scene.spec import WeatherSpec
from thermorender.weather.epw import read_epw
from thermorender.weather.rain import by_hour, check_rain, in_mm
from thermorender.weather.station import read_station

GAUGE = [3, 5, 8, 10, 13, 15, 18, 20, 23, 25]


def edited(path, *changes):
    """Replace pieces of a text file; keep it."""
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def cells(path, change, first):
    """Pass each row of cells from line `first` (from 0) on through change(number, cells)."""
    lines = path.read_text().splitlines()
    lines[first:] = [",".join(map(str, change(k, line.split(",")))) for k, line in enumerate(lines[first:])]
    path.write_text("\n".join(lines) + "\n")
    return path


# --- text ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "cp1252"])
def test_letters_in_comments_do_not_matter(tmp_path, encoding):
    path = edited(write_epw(tmp_path / "a.epw"), ("Somewhere", "Köln"), ("COMMENTS 1,", "COMMENTS 1,für Bau"))
    expected = read_epw(path, 2018)
    path.write_bytes(path.read_text().replace("\n", "\r\n").encode(encoding))
    np.testing.assert_array_equal(read_epw(path, 2018).air_k, expected.air_k)


def test_a_name_with_a_comma_does_not_hide_semicolons(tmp_path):
    path = station(tmp_path / "a.csv")
    expected = read_station(path, *PLACE)
    text = path.read_text().replace(",", ";").replace(".", ",").replace("\n", ";1\n")
    path.write_text(text.replace(";1", ";Sicht, km", 1))
    np.testing.assert_array_equal(read_station(path, *PLACE).air_k, expected.air_k)


def test_lines_above_names_of_which_none_is_a_time_are_named(tmp_path):
    path = station(tmp_path / "a.csv")
    names, _, rest = path.read_text().partition("\n")
    path.write_text("latitude,longitude\n49.0,8.0\n\n" + names.replace("time", "when") + "\n" + rest)
    with pytest.raises(ThermorenderError, match=r"row 4: 5 cells where row 1 names 2 columns; delete lines"):
        read_station(path, *PLACE)


def test_names_of_other_services_are_refused_with_ours_in_their_unit(tmp_path):
    """Open-Meteo writes units behind its names, and airports' reports have degrees Fahrenheit."""
    path = edited(
        station(tmp_path / "a.csv"), ("air_c", "temperature_2m (°C)"), ("sw_down_w_m2", "shortwave_radiation (W/m²)")
    )
    with pytest.raises(ThermorenderError, match="not known by this name; rename it to air_c, sw_down_w_m2 if that"):
        read_station(path, *PLACE)
    path = edited(station(tmp_path / "b.csv"), ("air_c", "temp_air_f"), ("wind_m_s", "sknt"))
    with pytest.raises(ThermorenderError, match="not known by this name; rename it to air_f, wind_knots if that"):
        read_station(path, *PLACE)


# --- clocks -------------------------------------------------------------------------------------------------------


def shifted(path, minutes, days=130):
    """An EPW file whose light is that of `minutes` after the middles of its hours."""
    write_epw(path, days=days, start="2007-03-01")
    light = np.round(sunlight(hours(days, "2007-03-01")[1] + np.timedelta64(minutes, "m")), 2)

    def change(k, row):
        row[13:16] = light[:, k]
        return row

    return cells(path, change, 8)


@pytest.mark.parametrize("minutes", [*slow(30), -30, *slow(40)])
def test_advice_on_half_an_hour_leads_on(tmp_path, minutes):
    path = shifted(tmp_path / "a.epw", minutes)
    with pytest.raises(ThermorenderError, match="light_shift_min = ") as error:
        read_epw(path, 2007)
    advice = float(re.search(r"light_shift_min = (-?\d+)", str(error.value))[1])
    assert advice == pytest.approx(minutes, abs=5.0)
    weather = read_epw(path, 2007, light_shift_min=float(minutes))
    truth = sunlight(weather.time)[1]
    assert np.abs(weather.direct_w_m2 - truth).max() < 0.1
    # Air at 13:00 in the zone stays at 13:00: its label.
    noon = np.datetime64("2007-06-01T12:00")
    assert weather.at(noon).air_k == pytest.approx(273.15 + 10.0 + 0.5 * 13, abs=0.01)
    assert any(f"shifted by {minutes} min" in note for note in weather.notes)


def test_a_stated_offset_of_the_light_is_obeyed(tmp_path):
    # Light of 10 min after the labels, which are the ends of hours: 40 min after the middles.
    path = shifted(tmp_path / "a.epw", 40, days=31)
    edited(path, ("COMMENTS 2,", "COMMENTS 2,Irradiance Time Offset (h):0.1667"))
    weather = read_epw(path, 2007)
    assert np.abs(weather.direct_w_m2 - sunlight(weather.time)[1]).max() < 0.1
    assert any("0.1667 h after its labels" in note for note in weather.notes)


def test_the_shift_is_a_key_of_weather_years():
    assert "light_shift_min" in WeatherSpec.__dataclass_fields__


def test_midnight_may_be_the_next_days_or_the_same_days_zero(tmp_path):
    expected = read_epw(write_epw(tmp_path / "a.epw"), 2018)
    path = cells(write_epw(tmp_path / "b.epw"), lambda k, row: [*row[:3], int(row[3]) % 24, *row[4:]], 8)
    np.testing.assert_array_equal(read_epw(path, 2018).direct_w_m2, expected.direct_w_m2)
    table = write_tmy3(tmp_path / "a.csv")
    expected = read_epw(table, 2018)
    edited(table, ("07/20/1998,24:00", "07/21/1998,00:00"), ("07/21/1998,24:00", "07/22/1998,00:00"))
    np.testing.assert_array_equal(read_epw(table, 2018).direct_w_m2, expected.direct_w_m2)


def test_half_hourly_rows_are_read(tmp_path):
    path = write_epw(tmp_path / "a.epw")
    lines = path.read_text().splitlines()
    half = [line.split(",") for line in lines[8:] for _ in range(2)]
    for k, row in enumerate(half):
        row[4] = 30 * (k % 2 + 1)
    edges = hours(2, "2007-07-20")[1][0] - np.timedelta64(30, "m")
    middles = edges + np.timedelta64(15, "m") + np.timedelta64(30, "m") * np.arange(96)
    for row, *light in zip(half, *np.round(sunlight(middles), 2), strict=True):
        row[13:16] = light
    lines[7] = "DATA PERIODS,1,2,Data,Sunday, 1/ 1,12/31"
    path.write_text("\n".join([*lines[:8], *(",".join(map(str, row)) for row in half)]) + "\n")
    weather = read_epw(path, 2018)
    assert weather.time.size == 96 and weather.time[0] == np.datetime64("2018-07-19T23:15")
    np.testing.assert_allclose(weather.direct_w_m2, sunlight(middles)[1], atol=0.01)
    # 0.4 mm in half an hour.
    assert weather.rain_mm_h[0] == pytest.approx(0.8)
    lines[7] = "DATA PERIODS,1,1,Data,Sunday, 1/ 1,12/31"
    path.write_text("\n".join([*lines[:8], *(",".join(map(str, row)) for row in half)]) + "\n")
    with pytest.raises(ThermorenderError, match=r"does not follow the row above"):
        read_epw(path, 2018)


def test_one_real_year_is_not_a_typical_year(tmp_path):
    path = write_epw(tmp_path / "a.epw", years=(2007,))
    assert read_epw(path, 2018).notes[0] == "Its rows of the year 2007 are mapped to 2018."
    assert read_epw(path, 2007).notes[0] == "Its rows are of 2007."
    assert "typical year" in read_epw(write_epw(path, years=(2007, 2009)), 2018).notes[0]


# --- rain ---------------------------------------------------------------------------------------------------------


def rainy(path, depths, periods=None):
    write_tmy3(path)
    lines = path.read_text().splitlines()
    lines[1] += ",Lprecip quantity (hr)"
    for k in range(48):
        row = lines[2 + k].split(",")[:-1]
        lines[2 + k] = ",".join(map(str, [*row, depths.get(k, 0), (periods or {}).get(k, 1)]))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_tenths_of_a_millimetre_are_divided(tmp_path):
    weather = read_epw(rainy(tmp_path / "a.csv", {5 + k: depth for k, depth in enumerate(GAUGE)}), 2018)
    np.testing.assert_allclose(weather.rain_mm_h[5:15], 0.1 * np.array(GAUGE))
    assert any("divided by 10" in note for note in weather.notes)
    # Decimals are millimetres, as are whole numbers that no gauge of 0.01 inch gives.
    for depths in ({5: 0.3, 6: 0.5}, {5: 1, 6: 2, 7: 1, 8: 3, 9: 4}):
        weather = read_epw(rainy(tmp_path / "a.csv", depths), 2018)
        assert weather.rain_mm_h[5] == next(iter(depths.values()))


def test_amounts_of_several_hours_are_spread(tmp_path):
    depths = {5: 0.6, 8: 1.0, 11: 2.2, 12: 5.0}
    weather = read_epw(rainy(tmp_path / "a.csv", depths, {5: 6, 11: 6, 12: 99}), 2018)
    # 6 h to 06:00 shared by none; of the 2.2 mm to 12:00 one hour has 1.0, and the unknown period is left out.
    spread = [0.0] * 5 + [0.6]
    assert weather.rain_mm_h[:6].sum() == pytest.approx(sum(spread))
    assert weather.rain_mm_h[:12].sum() == pytest.approx(0.6 + 2.2) and weather.rain_mm_h[8] == 1.0
    assert weather.rain_mm_h[12] == 0.0
    assert any("unknown period" in note for note in weather.notes)


def test_spread_amounts_fill_only_hours_without_their_own():
    depth = np.array([np.nan, 1.0, np.nan, 4.0, np.nan, 9.0])
    amount = by_hour("f", depth, np.array([np.nan, 1.0, np.nan, 3.0, np.nan, 6.0]), 1, False, [])
    # 4 mm in 3 h hold the 1 mm; 9 mm in 6 h hold those 4 mm.
    np.testing.assert_allclose(amount, [5.0 / 3.0, 1.0, 1.5, 1.5, 5.0 / 3.0, 5.0 / 3.0])
    with pytest.raises(ThermorenderError, match="period of 7 h"):
        by_hour("f", np.array([1.0]), np.array([7.0]), 1, False, [])


def test_impossible_rain_is_refused_and_rare_rain_noted():
    notes = []
    with pytest.raises(ThermorenderError, match=r"500 mm in an hour.* divide the column by 10"):
        check_rain("f", "rain", np.array([0.0, 500.0]), 3600.0, notes)
    check_rain("f", "rain", np.array([0.0, 400.0]), 600.0, notes)
    assert not notes
    check_rain("f", "rain", np.full(8760, 0.9), 3600.0, notes)
    assert "7884 mm in a year, which is rare" in notes[0]
    with pytest.raises(ThermorenderError, match="in a year"):
        check_rain("f", "rain", np.full(8760, 9.0), 3600.0, notes)
    assert in_mm("f", np.array([3.0, 5.0]), 5, notes)[0] == 3.0


# --- units of named columns -----------------------------------------------------------------------------------------


def test_a_stray_parenthesis_of_a_unit_does_not_hide_a_column(tmp_path):
    expected = read_epw(write_tmy3(tmp_path / "a.csv"), 2018)
    path = edited(write_tmy3(tmp_path / "b.csv"), ("DNI (W/m^2)", "DNI (W/m^2))"))
    np.testing.assert_array_equal(read_epw(path, 2018).direct_w_m2, expected.direct_w_m2)


def write_psm(path, zone=1, step_min=60, first_min=30, units="c"):
    days = 3
    middles = np.datetime64("2019-07-20", "s") + np.timedelta64(60 * first_min, "s")
    local = middles + np.timedelta64(60 * step_min, "s") * np.arange(days * 1440 // step_min)
    total, direct, diffuse = np.round(sunlight(local - np.timedelta64(zone, "h")), 1)
    lines = ["Source,Location ID,City,State,Country,Latitude,Longitude,Time Zone,Elevation,Local Time Zone,"
             "Temperature Units",
             f"NSRDB,1,-,-,-,47.0,11.0,{zone},600,1,{units}",
             "Year,Month,Day,Hour,Minute,DHI,GHI,DNI,Dew Point,Temperature,Pressure,Wind Speed"]  # fmt: skip
    for k, stamp in enumerate(local):
        when = stamp.item()
        row = [when.year, when.month, when.day, when.hour, when.minute, diffuse[k], total[k], direct[k], 5.0,
               10 + k % 24, 943, 2.0]  # fmt: skip
        lines.append(",".join(map(str, row)))
    path.write_text("\n".join(lines) + "\n")
    return path, local - np.timedelta64(zone, "h")


@pytest.mark.parametrize(("zone", "step_min", "first_min"), [(1, 60, 30), (0, 30, 0), (1, 30, 0)])
def test_rows_of_psm_are_instants_in_the_stated_zone(tmp_path, zone, step_min, first_min):
    path, instants = write_psm(tmp_path / "a.csv", zone, step_min, first_min)
    weather = read_epw(path, 2019)
    np.testing.assert_array_equal(weather.time, instants)
    np.testing.assert_allclose(weather.direct_w_m2, sunlight(instants)[1], atol=0.1)
    assert weather.air_k[5] == pytest.approx(288.15) and weather.pressure_pa[0] == pytest.approx(94300.0)
    assert weather.notes[0] == "Its rows are of 2019."


# --- years that are refused -----------------------------------------------------------------------------------------


def spoilt(write, *edits, **how):
    """A function that writes a weather year with pieces of its text replaced."""
    return lambda path: edited(write(path, **how), *edits)


def with_column(number, change):
    """A function that writes an EPW file with changed values in a column: change(number of the row, its cells)."""
    return lambda path: cells(
        write_epw(path), lambda k, row: [*row[:number], change(k, row), *row[number + 1 :]], first=8
    )


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (spoilt(write_epw, changes={6: 99.9}), "no air temperature"),
        (spoilt(write_epw, changes={6: "x"}), "'x' in column 7 is not a number"),
        (spoilt(write_epw, changes={3: 5}), "hours 1 to 24, in"),
        (spoilt(write_epw, changes={21: 120}), "wind_m_s=120 in hour 1 is not allowed"),
        (spoilt(write_epw, changes={9: 101325}), "pressure has the median"),
        (spoilt(write_epw, changes={1: 7, 2: 20}), "7/20 occurs twice"),
        (spoilt(write_epw, changes={1: 13}), "row 9: 13/20 is not a date"),
        (spoilt(write_epw, changes={2: "nan"}), "row 9: 7/nan is not a date"),
        (spoilt(write_epw, changes={13: 0, 14: 0, 15: 0}), "global_w_m2 is 0 W/m² at most"),
        (spoilt(write_epw, ("47.0,11.0,1.0,", "47.0,11.0,nan,")), "zone nan h in the header is not valid"),
        (spoilt(write_epw, ("47.0,11.0,1.0,", "47.0,11.0,-7.0,"), days=10), "the sunlight is 480 min"),
        (with_column(6, lambda k, row: "99.9" if 4 <= k < 10 else row[6]), "air_k is missing from 2018-07-20"),
        (with_column(3, lambda k, row: int(row[3]) - 1), "rows from 0 on; give whole days of hours 1 to 24"),
        (lambda path: path.write_bytes("LOCATION,Köln".encode("utf-16")), "holds zero bytes"),
        (spoilt(write_tmy3, ("Dry-bulb (C)", "Dry-bulb (F)")), "unit 'F' of Dry-bulb; convert the column to C"),
        (spoilt(write_tmy3, ("Lprecip depth (mm)", "Lprecip depth (in)")), "unit 'in' of Lprecip depth"),
        (spoilt(write_tmy3, ('000000,"SOMEWHERE"', '0,"Averaging Method: Start of Period"')),
         "averaging method 'Start of Period'"),
        (lambda path: write_psm(path, units="f"), "row 1 states the unit 'f' of Temperature"),
        (lambda path: path.write_text("a,b\n1,2\n"), "neither an EPW file, .* nor a TMY3 table"),
    ],
)  # fmt: skip
def test_a_bad_weather_year_is_refused_in_one_sentence(tmp_path, write, words):
    write(tmp_path / "a.epw")
    with pytest.raises(ThermorenderError, match=words) as error:
        read_epw(tmp_path / "a.epw", 2018)
    assert "\n" not in str(error.value)


# --- stations -------------------------------------------------------------------------------------------------------


def test_rain_in_inches_is_read(tmp_path):
    """An inch has 25.4 mm."""
    path = station(tmp_path / "s.csv")
    head, *rows = path.read_text().splitlines()
    inches = np.where(np.arange(len(rows)) % 7 == 3, 0.1, 0.0)
    for name, column in (("rain_in", inches), ("rain_total_in", np.cumsum(inches))):
        path.write_text("\n".join([f"{head},{name}", *(f"{row},{x:.1f}" for row, x in zip(rows, column, strict=True))]))
        step_h = float(np.diff(read_station(path, *PLACE).time)[0] / np.timedelta64(1, "h"))
        np.testing.assert_allclose(read_station(path, *PLACE).rain_mm_h * step_h, 25.4 * inches, atol=1e-9)


def test_all_wrong_columns_and_a_missing_air_temperature_are_refused_in_one_error(tmp_path):
    path = station(tmp_path / "s.csv")
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{head},prcp_in", *(f"{row},0.0" for row in rows)]))
    with pytest.raises(ThermorenderError, match="'prcp_in' is not known by this name; rename it to rain_in") as error:
        read_station(path, *PLACE)
    assert "air temperature" not in str(error.value)
    edited(path, ("air_c", "x"), ("sw_down_w_m2", "ghi"))
    with pytest.raises(ThermorenderError, match=r"'ghi', 'prcp_in' is not known .*; it has no air temperature: add"):
        read_station(path, *PLACE)


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [("global_w_m2", "sw_down_w_m2"), ("GHI", "sw_down_w_m2"), ("relative_humidity_percent", "rh_percent"),
     ("wind_speed", "wind_m_s"), ("temp_air", "air_c")],
)  # fmt: skip
def test_usual_names_of_columns_are_refused_with_ours(tmp_path, theirs, ours):
    path = edited(station(tmp_path / "s.csv"), (ours, theirs))
    with pytest.raises(ThermorenderError, match=f"column '{theirs}' is not known by this name; rename it to {ours}"):
        read_station(path, *PLACE)
    edited(path, (theirs, ours))
    read_station(path, *PLACE)


def test_columns_that_are_not_read_are_named(tmp_path):
    weather = read_station(station(tmp_path / "s.csv", {"soil_water": [0.2] * 72}), *PLACE)
    assert "Columns that are not read: soil_water." in weather.notes
    assert not any("not read" in note for note in read_station(station(tmp_path / "s.csv"), *PLACE).notes)


@pytest.mark.parametrize("factor", [1 / 2.78, 0.5])
def test_light_in_other_units_is_refused_over_a_season(tmp_path, factor):
    def light(time):
        return np.round(factor * sunlight(time)[0], 1)

    read_station(station(tmp_path / "s.csv", days=45), *PLACE)
    with pytest.raises(ThermorenderError, match="of a clear sky's light in its brightest hours"):
        read_station(station(tmp_path / "s.csv", {"sw_down_w_m2": light}, days=45), *PLACE)


def test_an_import_takes_a_table_of_the_nsrdb_for_a_weather_year(tmp_path):
    """The import distinguishes weather files as the reader of weather years does."""
    terrain = write_terrain(tmp_path / "t") / "elevation.tif"
    psm, _ = write_psm(tmp_path / "w.csv")
    import_terrain(terrain, None, tmp_path / "s", ImportSettings(weather=psm, time="2019-07-21T12:00Z"))
    assert load_scene(tmp_path / "s").spec.weather.epw == tmp_path / "s" / "weather.csv"
