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
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.units import ZERO_CELSIUS_K
from validation.command import run_command

_PROMICE = "GEUS-Glaciology-and-Climate/pypromice/4e0ba2555fdcae906e713ce6c4e25906552fed56/tests"
_ARM = "ARM-DOE/arm-test-data/579835e49b1fc76783dfb232173b1a8f5e40e043/data"
_OZFLUX = "gitanjali2022/plot_scale_lst_emissivity/8673e663a9cfea3a502c5e74fddea04b141e7cb2/Data/tern"
_MATSCH = "EURAC-Ecohydro/GEOtopExamples/df1407b4f5407c30c8453a630b9e50e0128f01e7/tests/Matsch_B2_Ref_007"
_CROPS = "BryanNsoh/cwsi-swsi-et/6d51384a583e08be19b592dd8963379f9898058d/analysis-2024-09-15/data/data-2024-09-15"
_HOUSES = "anssilaukkarinen/trh-1/2c7de539209660b370c62bf0948b97c0083c9719/database_read_only"
# Plots with an infrared thermometer, by crop: field, treatment and number.
_PLOTS = {
    "corn": (("CORN", 1, 5006), ("CORN", 1, 5010), ("CORN", 1, 5023), ("CORN", 2, 5003), ("CORN", 2, 5012),
             ("CORN", 3, 5001), ("CORN", 3, 5018), ("CORN", 3, 5020)),
    "soybean": (("SOYBEAN", 1, 2006), ("SOYBEAN", 1, 2015), ("SOYBEAN", 1, 2023), ("SOYBEAN", 2, 2001),
                ("SOYBEAN", 2, 2011), ("SOYBEAN", 2, 2026), ("SOYBEAN", 3, 2003), ("SOYBEAN", 3, 2018),
                ("SOYBEAN", 3, 2020)),
}  # fmt: skip
# Weather and sensor of a construction.
_BENEATH = {
    "felt_roof": ("R3_omakotitalo/YP2", "roofmiddle_airtop"),
    "tile_roof": ("R7_omakotitalo/YP1", "roofmiddle_topofunderlay"),
    "metal_roof": ("R6_omakotitalo/YP3", "roofsoutheast_topofunderlay"),
    "brick_wall": ("R1_omakotitalo/US1_puurankaseina_tiiliverhouksella", "tuuletusvali"),
}
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
    "photovoltaic": "pvlib/pvanalytics/06fd59694b2a9461ff29c5d22d691bb23c4f956e/pvanalytics/data/serf_west_15min.csv",
    **{f"{crop}_{plot}": f"{_CROPS}/LINEAR_{field}_trt{treatment}_plot_{plot}_20240915.csv"
       for crop, plots in _PLOTS.items() for field, treatment, plot in plots},
    **{f"{name}_{part}": f"{_HOUSES}/{house}/{file}.csv"
       for name, (house, sensor) in _BENEATH.items() for part, file in (("weather", "fmi"), ("sensor", sensor))},
}  # fmt: skip
_HOUR = timedelta(hours=1)
# Sensitivities of the radiometers [µV per W/m²], from the station's configuration: short-wave down and up, long-wave
# down and up.
_LOGGERS = {"ice_margin": (14.01, 12.72, 11.08, 11.42), "roof": (13.34, 11.90, 9.63, 9.72)}
LOGGER_NAMES = {
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
    pressure, air, humidity, wind, *raw, body = (_numbers(table[each]) for each in LOGGER_NAMES[name])
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


def crop(plots):
    """Return (times, columns) of hourly means of a field's station, with the mean canopy temperature of its plots.

    Times are those of summer (UTC − 5) and of the start of the hour, as the sunlight tells. The mean needs half of the
    plots' infrared thermometers.
    """
    tables = [_columns(data.decode("utf-8")) for data in plots]
    first = max(tables, key=lambda table: len(table["TIMESTAMP"]))
    stamps, canopy = first["TIMESTAMP"], []
    for table in tables:
        (name,) = [name for name in table if name.startswith("IRT")]
        known = dict(zip(table["TIMESTAMP"], _numbers(table[name]), strict=True))
        canopy.append([known.get(stamp, np.nan) for stamp in stamps])
    canopy = np.array(canopy)
    count = np.isfinite(canopy).sum(axis=0)
    mean = np.where(2 * count >= len(canopy), np.nansum(canopy, axis=0) / np.maximum(count, 1), np.nan)
    names = {"air_c": "Ta_2m_Avg", "rh_percent": "RH_2m_Avg", "wind_m_s": "WndAveSpd_3m",
             "sw_down_w_m2": "Solar_2m_Avg", "pressure_hpa": "PresAvg_1pnt5m"}  # fmt: skip
    columns = {ours: _numbers(first[name]) for ours, name in names.items()}
    time = [datetime.fromisoformat(stamp) + 5.5 * _HOUR for stamp in stamps]
    return time, columns | {"canopy_c": mean}


def beneath(weather, sensor):
    """Return (times, columns) of a construction: the nearest station, and the temperature below the outer layer.

    Times are UTC + 2 all year. Temperatures, humidity and wind are instantaneous, light is the mean of the hour before;
    a row takes those of its hour's middle.
    """
    table, found = _columns(weather.decode("utf-8")), _columns(sensor.decode("utf-8"))
    clock = lambda table: np.array(table["t_UTC+2"], "datetime64[s]") - np.timedelta64(7200, "s")  # noqa: E731
    at, own = clock(table), clock(found)
    names = {"air_c": "Te", "rh_percent": "RHe", "wind_m_s": "ws", "sw_down_w_m2": "Rglob", "sw_diffuse_w_m2": "Rdif"}
    # One house has the air only.
    names = names if "Te" in table else {"air_c": "T", "rh_percent": "RH"}
    hours = np.arange(at[0].astype("M8[h]"), at[-1].astype("M8[h]")).astype("M8[s]") + np.timedelta64(1800, "s")
    seconds = lambda times: (times - at[0]).astype(float)  # noqa: E731

    def through(times, values, later_s=0.0):
        good = np.isfinite(values)
        places, known = seconds(hours) + later_s, seconds(times)[good]
        value = np.interp(places, known, values[good])
        # Gaps of more than two hours stay.
        near = known[np.clip(np.searchsorted(known, places), 0, len(known) - 1)]
        before = known[np.clip(np.searchsorted(known, places) - 1, 0, len(known) - 1)]
        return np.where(near - before <= 7200.0, value, np.nan)

    columns = {ours: through(at, _numbers(table[name]), 1800.0 if ours.startswith("sw") else 0.0)
               for ours, name in names.items()}  # fmt: skip
    columns["rh_percent"] = np.minimum(columns["rh_percent"], 100.0)
    columns["sensor_c"] = through(own, _numbers(found["T"]))
    return [each.astype(datetime) for each in hours], columns


def photovoltaic(data):
    """Return (times, columns) of 15-min means in local standard time (UTC − 7): air, light on the modules, modules."""
    table = _columns(data.decode("utf-8"))
    time = [datetime.fromisoformat(stamp) + 7.0 * _HOUR for stamp in next(iter(table.values()))]
    modules = [_numbers(table[f"module_temp_{k}__78{k}"]) for k in (1, 2, 3)]
    columns = {"air_c": _numbers(table["ambient_temp__780"]), "modules_c": np.median(modules, axis=0)}
    return time, columns | {"on_modules_w_m2": _numbers(table["poa_irradiance__771"])}


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
            # Files of one name are told apart by their folders.
            own = sources / "-".join(Path(path).parts[-3:])
            return (own if own.is_file() else sources / Path(path).name).read_bytes()
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
    for name, plots in _PLOTS.items():
        _write(folder / f"{name}.csv", *crop([data(f"{name}_{plot}") for *_, plot in plots]))
    for name in _BENEATH:
        _write(folder / f"{name}.csv", *beneath(data(f"{name}_weather"), data(f"{name}_sensor")))
    _write(folder / "photovoltaic.csv", *photovoltaic(data("photovoltaic")))
    typer.echo(f"{8 + len(_PLOTS) + len(_BENEATH) + 1} tables in {output}")


if __name__ == "__main__":
    run_command(main)
