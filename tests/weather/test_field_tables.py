"""Weather tables as loggers, services and spreadsheets write them: the same weather, or one sentence that mends it."""

import numpy as np
import pytest
from test_weather import PLACE, station, write_epw

from thermorender.errors import ThermorenderError
from thermorender.weather.epw import read_epw
from thermorender.weather.rain import looks_like_total
from thermorender.weather.station import read_station

RAIN = np.tile([0.0] * 6 + [1.0, 0.5, 2.0] + [0.0] * 15, 3)
SINCE_MIDNIGHT = np.cumsum(RAIN.reshape(3, 24), axis=1).ravel()


def same(path, expected):
    """Whether a table has the weather of another, but for notes."""
    found = read_station(path, *PLACE)
    for name in ("air_k", "vapour_pa", "direct_w_m2", "diffuse_w_m2", "rain_mm_h", "longwave_w_m2"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=0, atol=1e-9, err_msg=name)
    return found


@pytest.mark.parametrize("mark", [";", "\t", "|"])
def test_a_table_with_decimal_commas_is_read(tmp_path, mark):
    expected = read_station(station(tmp_path / "a.csv"), *PLACE)
    path = station(tmp_path / "b.csv")
    path.write_text(path.read_text().replace(",", mark).replace(".", ","))
    same(path, expected)


@pytest.mark.parametrize("above", [
    "sep=;\r\n", '"sep=;"\n', "Station Falkenberg, 73 m\n\n# mean of ten minutes; raw\n", "sep=;\nexported by hand\n",
])  # fmt: skip
def test_lines_above_the_names_of_the_columns_are_not_read(tmp_path, above):
    expected = read_station(station(tmp_path / "a.csv"), *PLACE)
    path = station(tmp_path / "b.csv")
    path.write_text(above + path.read_text().replace(",", ";").replace(".", ","))
    lines = above.count("\n") - ("sep=" in above)
    note = f"Lines above the names of the columns ({lines}) are not read."
    assert same(path, expected).notes == ((note,) if lines else ()) + expected.notes
    path.write_text(path.read_text().replace("60,0", "x", 1))
    # Excel does not show the line of the separator, which is not counted.
    with pytest.raises(ThermorenderError, match=f"row {lines + 2}: rh_percent='x'"):
        read_station(path, *PLACE)


def test_a_leap_second_beside_the_row_of_midnight_is_left_out(tmp_path):
    whole = {"time_utc": lambda t: [f"{x}Z" for x in np.datetime64("2018-07-20T00:00:00") + (t - t[0])]}
    expected = read_station(station(tmp_path / "a.csv", whole), *PLACE)
    for newest_first in (False, True):
        path = station(tmp_path / "b.csv", whole)
        rows = path.read_text().splitlines()
        at = next(k for k, row in enumerate(rows) if "T00:00:00" in row and k > 1)
        day, _, cells = rows[at].partition(",")
        before = np.datetime64(day[:-1]) - np.timedelta64(1, "s")
        rows.insert(at, f"{str(before).replace(':59Z', '')[:-2]}60Z,{cells}")
        path.write_text("\n".join([rows[0], *(rows[:0:-1] if newest_first else rows[1:])]) + "\n")
        assert "T23:59:60Z" in path.read_text()
        same(path, expected)


def test_a_table_with_the_newest_row_first_is_read_in_reverse(tmp_path):
    expected = read_station(station(tmp_path / "a.csv"), *PLACE)
    newest = station(tmp_path / "b.csv", lines=lambda rows: [rows[0], *rows[:0:-1]])
    assert "Its rows are newest first, and read in reverse." in same(newest, expected).notes


@pytest.mark.parametrize("as_written", [
    lambda t: [f"{x - np.timedelta64(1, 'D')}Z".replace("T00:00:00", "T24:00:00") if str(x).endswith("T00:00:00")
               else f"{x}Z" for x in t],
    lambda t: [f"{x - np.timedelta64(60, 's')}Z".replace(":00Z", ":60Z") if k == 24 else f"{x}Z"
               for k, x in enumerate(t)],
], ids=["24:00", "leap second"])  # fmt: skip
def test_midnight_of_the_day_before_and_leap_seconds_are_the_next_second(tmp_path, as_written):
    whole = np.datetime64("2018-07-20T00:00:00")
    times = lambda t: whole + (t - t[0])  # noqa: E731
    expected = read_station(station(tmp_path / "a.csv", {"time_utc": lambda t: [f"{x}Z" for x in times(t)]}), *PLACE)
    path = station(tmp_path / "b.csv", {"time_utc": lambda t: as_written(times(t))})
    assert ":60Z" in path.read_text() or "T24:" in path.read_text()
    same(path, expected)


def test_a_hidden_sky_of_nine_oktas_is_overcast(tmp_path):
    changes = {"cloud_oktas": [9] * 5 + [3] * 67, "sw_down_w_m2": None}
    found = read_station(station(tmp_path / "a.csv", changes), *PLACE)
    changes["cloud_oktas"] = [8] * 5 + [3] * 67
    same(station(tmp_path / "b.csv", changes), found)
    assert any("5 values of cloud_oktas are 9" in note for note in found.notes)


@pytest.mark.parametrize("total", [SINCE_MIDNIGHT, 40.0 + np.cumsum(RAIN)], ids=["since midnight", "counter"])
def test_a_total_of_rain_is_refused_as_amounts_and_read_under_its_name(tmp_path, total):
    expected = read_station(station(tmp_path / "a.csv", {"rain_mm": RAIN}), *PLACE)
    with pytest.raises(ThermorenderError, match=r"rain_mm looks like a total .* rename the column to rain_total_mm"):
        read_station(station(tmp_path / "b.csv", {"rain_mm": total}), *PLACE)
    same(station(tmp_path / "c.csv", {"rain_total_mm": total}), expected)
    with pytest.raises(ThermorenderError, match="columns rain_total_mm and rain_mm are rain twice"):
        read_station(station(tmp_path / "d.csv", {"rain_total_mm": total, "rain_mm": RAIN}), *PLACE)


@pytest.mark.parametrize("seed", range(20))
def test_random_rain_of_intervals_does_not_look_like_a_total(seed):
    """Showers at any hour, and a drizzle of one amount for hours of each day."""
    random = np.random.default_rng(seed)
    rain = np.where(random.random(24 * 14) < 0.2, np.round(random.gamma(0.7, 1.5, 24 * 14), 1), 0.0)
    second = 3600.0 * np.arange(24 * 14)
    assert looks_like_total(rain, second, 3600.0) == ""
    drizzle = np.tile([0.0] * 6 + [0.2] * 8 + [0.0] * 10, 14)
    assert looks_like_total(drizzle, second, 3600.0) == ""
    storm = np.repeat([0.0, 0.3, 1.2, 2.4, 3.0, 0.0], [2, 3, 3, 3, 3, 6])
    assert looks_like_total(storm, second[:20], 3600.0) == ""
    assert looks_like_total(np.cumsum(rain), second, 3600.0) == "a total that is never reset"


def test_columns_under_other_names_are_listed_in_one_sentence(tmp_path):
    path = station(tmp_path / "s.csv")
    path.write_text(path.read_text().replace("air_c", "temp_air").replace("wind_m_s", "wind_speed"))
    with pytest.raises(ThermorenderError, match=r"'temp_air', 'wind_speed' is not .*rename it to air_c, wind_m_s"):
        read_station(path, *PLACE)


@pytest.mark.parametrize(
    ("line", "words"),
    [("DATA PERIODS,1,inf,Data", "states inf records per hour"), ("DATA PERIODS,1,nan,Data", "states nan records per"),
     ("DATA PERIODS,1,1.5,Data", "states 1.5 records per hour"),
     ("COMMENTS 1,Irradiance Time Offset (h): 1..2\nDATA PERIODS,1,1,Data", r"'1\.\.2' in Irradiance Time Offset")],
)  # fmt: skip
def test_numbers_of_a_year_file_that_are_none_are_refused(tmp_path, line, words):
    path = write_epw(tmp_path / "a.epw")
    lines = path.read_text().splitlines()
    lines = [line if each.startswith("DATA PERIODS") else each for each in lines]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(ThermorenderError, match=words):
        read_epw(path, 2018)


@pytest.mark.parametrize("column", ["air_c", "sw_down_w_m2"])
def test_an_instant_before_a_record_that_begins_with_a_gap_is_refused(tmp_path, column):
    path = station(tmp_path / "s.csv")
    head, *rows = path.read_text().splitlines()
    number = head.split(",").index(column)
    for k, row in enumerate(rows[:5]):
        cells = row.split(",")
        cells[number] = ""
        rows[k] = ",".join(cells)
    path.write_text("\n".join([head, *rows]) + "\n")
    before = np.datetime64(rows[0].split(",")[0].rstrip("Z")) - np.timedelta64(1, "D")
    with pytest.raises(ThermorenderError, match=rf"has no row around .* because {column} is missing .*Give a time"):
        read_station(path, *PLACE, around=before)


def test_a_cell_of_a_page_is_not_quoted_whole_and_the_advice_stays(tmp_path):
    path = tmp_path / "s.csv"
    path.write_text("time,air_c,rh_percent\n" + 9000 * "x" + ",17,60\n2018-07-28 01:00Z,18,60\n")
    with pytest.raises(
        ThermorenderError, match=r"time='x+ … x+' is not a time; write it as 2018-07-28T14:30Z$"
    ) as info:
        read_station(path, *PLACE)
    assert len(str(info.value)) < 2600


def test_a_column_without_a_value_in_the_rows_that_are_left_is_refused(tmp_path):
    """The gap of ten hours parts the last row from the others, and that row has no wind."""
    path = tmp_path / "s.csv"
    path.write_text(
        "time,air_c,rh_percent,wind_m_s\n2018-07-28 00:00Z,17,60,1\n2018-07-28 01:00Z,18,60,1\n"
        "2018-07-28 02:00Z,17,60,1\n2018-07-28 12:00Z,27,60,\n"
    )
    with pytest.raises(
        ThermorenderError, match=r"wind_m_s has no value from 2018-07-28T12:00:00Z to .*leave the column"
    ):
        read_station(path, *PLACE, around=np.datetime64("2018-07-28T12:00"))


def test_a_gap_of_a_year_file_far_from_the_instant_leaves_rows_out(tmp_path):
    """The same weather at the instant, and a note; within the gap the refusal names what can be done."""
    at = np.datetime64("2018-07-24T12:00")
    whole = write_epw(tmp_path / "a.epw", days=60, start="2018-06-01")
    lines = whole.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("DATA PERIODS")) + 1
    for k in range(first + 24 * 10, first + 24 * 20):
        cells = lines[k].split(",")
        cells[13] = cells[14] = cells[15] = "9999"
        lines[k] = ",".join(cells)
    broken = tmp_path / "b.epw"
    broken.write_text("\n".join(lines) + "\n")
    found, expected = read_epw(broken, at), read_epw(whole, at)
    assert found.at(at) == expected.at(at)
    assert any(note.startswith("Rows before 2018-06-2") and "global_w_m2" in note for note in found.notes)
    with pytest.raises(ThermorenderError, match="choose an instant outside of it, or give a station"):
        read_epw(broken, np.datetime64("2018-06-15T12:00"))


@pytest.mark.parametrize("lost", [None, slice(30, 32)], ids=["whole", "with gaps"])
def test_a_total_with_gaps_is_recognised_and_its_rise_spread_over_them(tmp_path, lost):
    total = np.tile([0.0] * 6 + [1.0, 2.0, 3.0, 4.0] + [5.0] * 14, 3)
    column = [str(value) for value in total]
    if lost:
        column[lost] = [""] * 2
    with pytest.raises(ThermorenderError, match="looks like a total since midnight"):
        read_station(station(tmp_path / "a.csv", {"rain_mm": column}), *PLACE)
    found = read_station(station(tmp_path / "b.csv", {"rain_total_mm": column}), *PLACE)
    assert found.rain_mm_h.sum() == pytest.approx(15.0)


def test_jitter_of_a_counter_is_no_rain(tmp_path):
    found = read_station(station(tmp_path / "a.csv", {"rain_total_mm": [150.2, 150.3] * 36}), *PLACE)
    assert found.rain_mm_h.sum() < 4.0


def test_semicolons_with_points_do_not_make_decimals_of_thousands(tmp_path):
    path = station(tmp_path / "a.csv")
    path.write_text(path.read_text().replace(",", ";").replace(";2.0;", ";1,013;"))
    with pytest.raises(ThermorenderError, match="wind_m_s='1,013' is not a number"):
        read_station(path, *PLACE)


def test_a_common_year_with_a_gap_serves_a_leap_year(tmp_path):
    whole = write_epw(tmp_path / "a.epw", days=365, start="2019-01-01")
    lines = whole.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("DATA PERIODS")) + 1
    for k in range(first + 24 * 273, first + 24 * 273 + 6):
        cells = lines[k].split(",")
        cells[13] = "9999"
        lines[k] = ",".join(cells)
    whole.write_text("\n".join(lines) + "\n")
    found = read_epw(whole, np.datetime64("2020-07-24T12:00"))
    assert any(note.startswith("Rows after 2020-09-") for note in found.notes), found.notes
