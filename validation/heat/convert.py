"""Tables of the held-out sites from public files: `python -m validation.heat.convert -o DIR`.

Each source is one file of a public repository at a fixed commit. Times become UTC and the middle of the averaging
interval; columns get the names and units that `thermorender.weather` reads. No value is filled or corrected.
"""

import csv
import io
import urllib.request
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from thermorender import files
from thermorender.cli.terminal import output_option
from thermorender.errors import ThermorenderError
from thermorender.formats import write_text
from thermorender.physics.balance import STEFAN_BOLTZMANN
from thermorender.units import ZERO_CELSIUS_K
from validation.command import run_command

_PROMICE = "GEUS-Glaciology-and-Climate/pypromice/4e0ba2555fdcae906e713ce6c4e25906552fed56/tests"
_ARM = "ARM-DOE/arm-test-data/579835e49b1fc76783dfb232173b1a8f5e40e043/data"
_OZFLUX = "gitanjali2022/plot_scale_lst_emissivity/8673e663a9cfea3a502c5e74fddea04b141e7cb2/Data/tern"
_MATSCH = "EURAC-Ecohydro/GEOtopExamples/df1407b4f5407c30c8453a630b9e50e0128f01e7/tests/Matsch_B2_Ref_007"
SOURCES = {
    "ice_margin": f"{_PROMICE}/data/test_raw1.txt",
    "ice_sheet_night": f"{_PROMICE}/unit/bufr_export/tx_l3_test1.csv",
    "roof": f"{_PROMICE}/data/test_raw_DataTable2.txt",
    "irrigated_meadow": f"{_MATSCH}/obss/obs/obs0001.txt",
    "savanna": f"{_OZFLUX}/AdelaideRiver/AdelaideRiver_2009_L3.nc",
    "eucalypt": f"{_OZFLUX}/TUM/Tumbarumba_2016_L3.nc",
    "prairie_grass": "hagne/SURFRAD/7cb8c3e273aa653ca33aca8f16caa3aab3550a42/data/bon_19950510.qdat",
    "pasture_weather": f"{_ARM}/sgpmetE13.b1.20190101.000000.cdf",
    "pasture_light": f"{_ARM}/sgpsirsE13.b1.20190101.000000.cdf",
}
_HOUR = timedelta(hours=1)
# Sensitivities of the radiometers [µV per W/m²], from the station's configuration: short-wave down and up, long-wave
# down and up.
_LOGGERS = {"ice_margin": (14.01, 12.72, 11.08, 11.42), "roof": (13.34, 11.90, 9.63, 9.72)}
_LOGGER_NAMES = {
    "ice_margin": ("AirPressure_Avg", "Temperature_Avg", "RelativeHumidity_Avg", "WindSpeed",
                         "ShortwaveRadiationIn_Avg", "ShortwaveRadiationOut_Avg", "LongwaveRadiationIn_Avg",
                         "LongwaveRadiationOut_Avg", "TemperatureRadSensor_Avg"),
    "roof": ("Pressure_U", "Asp_temp_U", "Humidity_U", "WindSpeed_S_U", "SWUpper", "SWLower", "LWUpper", "LWLower",
             "TemperatureRadSensor"),
}  # fmt: skip
_TABLE = ("pressure_hpa", "air_c", "rh_percent", "wind_m_s", "sw_down_w_m2", "sw_up_w_m2", "lw_down_w_m2", "lw_up_w_m2")


def _number(text):
    try:
        value = float(text)
    except ValueError:
        return np.nan
    return np.nan if value in (-9999.0, -9999.9, -999.0) else value


def _columns(text, delimiter=","):
    rows = list(csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True))
    names = rows[0]
    return {name: [row[k] if k < len(row) else "" for row in rows[1:]] for k, name in enumerate(names)}


def _numbers(cells):
    return np.array([_number(cell) for cell in cells])


def logger(name, data):
    """Return (times, columns) of a raw logger file of an ice-sheet station.

    Long-wave is the thermopile's signal plus the emission of the radiometer; ten-minute means are stamped at their
    end.
    """
    lines = data.decode("utf-8").splitlines()
    table = _columns("\n".join([lines[1], *lines[4:]]))
    time = [datetime.fromisoformat(cell) - _HOUR / 12 for cell in table["TIMESTAMP"]]
    pressure, air, humidity, wind, *raw, body = (_numbers(table[each]) for each in _LOGGER_NAMES[name])
    body = np.where(np.abs(body) > 80.0, np.nan, body)
    gains = _LOGGERS[name]
    emitted = STEFAN_BOLTZMANN * (body + ZERO_CELSIUS_K) ** 4
    light = [10.0 * raw[k] / gains[k] + (emitted if k > 1 else 0.0) for k in range(4)]
    return time, dict(zip(_TABLE, [pressure, air, humidity, wind, *light], strict=True))


def ice_sheet_night(data):
    """Return (times, columns) of hourly means, stamped at their start; humidity is over liquid water."""
    table = _columns(data.decode("utf-8"))
    time = [datetime.fromisoformat(cell) + _HOUR / 2 for cell in table["time"]]
    names = ("p_u", "t_u", "rh_u", "wspd_u", "dsr", "usr", "dlr", "ulr")
    return time, {ours: _numbers(table[name]) for ours, name in zip(_TABLE, names, strict=True)}


def irrigated_meadow(data):
    """Return (times, columns) of hourly means, stamped at their end in local time with summer time (July: UTC + 2)."""
    table = _columns(data.decode("utf-8"))
    stamps = [datetime.strptime(cell, "%d/%m/%Y %H:%M") for cell in next(iter(table.values()))]
    time = [stamp - 2.5 * _HOUR for stamp in stamps]
    light = {
        f"{short}_{way}_w_m2": _numbers(table[f"surface_{way}welling_{long}wave_flux"])
        for short, long in (("sw", "short"), ("lw", "long"))
        for way in ("down", "up")
    }
    columns = {
        "air_c": _numbers(table["air_temperature"]), "rh_percent": 100.0 * _numbers(table["relative_humidity"]),
        "wind_m_s": _numbers(table["wind_speed"]), "rain_mm": _numbers(table["rainfall_amount"]), **light,
    }  # fmt: skip
    keep = [stamp.month in (6, 7, 8) for stamp in stamps]
    return [t for t, k in zip(time, keep, strict=True) if k], {n: v[keep] for n, v in columns.items()}


def prairie_grass(data):
    """Return (times, columns) of 3-minute means; flagged values (above 0) are left out.

    The flags are in the order short-wave down by the unshaded pyranometer (two), diffuse, direct, short-wave up,
    long-wave down, long-wave up.
    """
    table = _columns(data.decode("utf-8").lstrip(" "), " ")
    clock = zip(table["Date"], table["Time"], strict=True)
    time = [datetime.strptime(day, "%Y%m%d") + timedelta(minutes=60 * (int(at) // 100) + int(at) % 100)
            for day, at in clock]  # fmt: skip
    columns = {
        "air_c": _numbers(table["Ta"]) - ZERO_CELSIUS_K, "rh_percent": _numbers(table["RH"]),
        "wind_m_s": _numbers(table["WindSp"]), "sw_down_w_m2": _numbers(table["BESW"]),
        "sw_up_w_m2": _numbers(table["SWup"]), "lw_down_w_m2": _numbers(table["LWdn"]),
        "lw_up_w_m2": _numbers(table["LWup"]),
    }  # fmt: skip
    return time, {name: np.where(np.abs(values) > 2000.0, np.nan, values) for name, values in columns.items()}


def flux_tower(data, offset_h, step_h):
    """Return (times, columns) of a flux tower's netCDF file: means stamped at their end, unflagged values only."""
    try:
        import netCDF4
    except ImportError:
        raise ThermorenderError("netCDF4 is not installed; install it with: pip install netCDF4") from None
    with netCDF4.Dataset("memory", memory=data) as found:

        def column(name):
            values = np.ma.filled(found[name][:].astype(float), np.nan).ravel()
            good = np.asarray(found[f"{name}_QCFlag"][:]).ravel() == 0
            return np.where(good & (values > -9000.0), values, np.nan)

        parts = [np.asarray(found[name][:]).ravel().astype(int) for name in ("Year", "Month", "Day", "Hour", "Minute")]
        # Vapour pressure from absolute humidity [g/m³]: e = ρ R T / M, in hPa.
        air = column("Ta")
        vapour = column("Ah") * 8.314462 * (air + ZERO_CELSIUS_K) / 18.015 / 100.0
        columns = {
            "air_c": air, "vapour_pressure_hpa": vapour,
            "wind_m_s": column("Ws" if "Ws" in found.variables else "Ws_CSAT"), "pressure_kpa": column("ps"),
            "sw_down_w_m2": column("Fsd"), "sw_up_w_m2": column("Fsu"), "lw_down_w_m2": column("Fld"),
            "lw_up_w_m2": column("Flu"),
        }  # fmt: skip
    time = [datetime(*stamp) - (offset_h + 0.5 * step_h) * _HOUR for stamp in zip(*parts, strict=True)]
    return time, columns


def pasture(weather, light):
    """Return (times, columns) of one-minute means of a day; flagged values are missing already."""
    from scipy.io import netcdf_file

    def read(data, names):
        with netcdf_file(io.BytesIO(data), mmap=False) as found:
            base = datetime(1970, 1, 1) + timedelta(seconds=int(found.variables["base_time"][...]))
            seconds = np.array(found.variables["time_offset"][:], float)
            columns = {ours: np.array(found.variables[name][:], float) for ours, name in names.items()}
        bad = {ours: np.where(values < -9000.0, np.nan, values) for ours, values in columns.items()}
        return [base + timedelta(seconds=float(each)) for each in seconds], bad

    time, air = read(weather, {"air_c": "temp_mean", "rh_percent": "rh_mean", "wind_m_s": "wspd_arith_mean",
                               "pressure_kpa": "atmos_pressure"})  # fmt: skip
    # The day is overcast: direct light stays below 6 W/m², and the shaded pyranometer, which has no gaps, sees all.
    when, sun = read(light, {"sw_down_w_m2": "down_short_diffuse_hemisp", "sw_up_w_m2": "up_short_hemisp",
                             "lw_down_w_m2": "down_long_hemisp_shaded", "lw_up_w_m2": "up_long_hemisp"})  # fmt: skip
    if time != when:
        raise ThermorenderError("the two files of the pasture have different times; give files of one day")
    return [each + timedelta(seconds=30) for each in time], air | sun


def averaged(time, columns, step_min):
    """Return (times, columns) as means over steps of `step_min` min with at least half of the values."""
    first = datetime.combine(time[0].date(), datetime.min.time())
    index = np.array([int((each - first).total_seconds() // (60 * step_min)) for each in time])
    steps, inverse, most = np.unique(index, return_inverse=True, return_counts=True)
    found = {}
    for name, values in columns.items():
        good = np.isfinite(values)
        count = np.bincount(inverse, good)
        with np.errstate(invalid="ignore"):
            mean = np.bincount(inverse, np.where(good, values, 0.0)) / np.maximum(count, 1)
        found[name] = np.where(2 * count >= most.max(), mean, np.nan)
    return [first + timedelta(minutes=(int(step) + 0.5) * step_min) for step in steps], found


def _write(path, time, columns):
    lines = [",".join(["time_utc", *columns])]
    for k, at in enumerate(time):
        cells = ["" if not np.isfinite(values[k]) else f"{values[k]:.4g}" if abs(values[k]) < 100 else
                 f"{values[k]:.1f}" for values in columns.values()]  # fmt: skip
        if any(cells):
            lines.append(",".join([at.strftime("%Y-%m-%dT%H:%M:%SZ"), *cells]))
    write_text(path, "\n".join(lines) + "\n")


def main(
    output: Annotated[Path, output_option("-o", "--output", help="Folder for the tables.")],
    sources: Annotated[Path | None, typer.Option(help="Folder of downloaded sources, by their file names.")] = None,
):
    """Download the public files of the held-out sites, and write their tables."""
    folder = files.make_folder(output)

    def data(name):
        path = SOURCES[name]
        if sources:
            return (sources / Path(path).name).read_bytes()
        # Fixed address of a public file; the scheme is ours.
        with urllib.request.urlopen(f"https://raw.githubusercontent.com/{path}", timeout=60) as answer:
            return bytes(answer.read())

    for name in ("ice_margin", "roof"):
        _write(folder / f"{name}.csv", *averaged(*logger(name, data(name)), 30))
    _write(folder / "ice_sheet_night.csv", *ice_sheet_night(data("ice_sheet_night")))
    _write(folder / "irrigated_meadow.csv", *irrigated_meadow(data("irrigated_meadow")))
    _write(folder / "prairie_grass.csv", *averaged(*prairie_grass(data("prairie_grass")), 15))
    _write(folder / "savanna.csv", *flux_tower(data("savanna"), 9.5, 0.5))
    _write(folder / "eucalypt.csv", *flux_tower(data("eucalypt"), 10.0, 1.0))
    _write(folder / "pasture.csv", *averaged(*pasture(data("pasture_weather"), data("pasture_light")), 10))
    typer.echo(f"8 tables in {output}")


if __name__ == "__main__":
    run_command(main)
