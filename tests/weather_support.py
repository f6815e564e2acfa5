"""Clean weather files for tests to spoil: a station's, and years in two formats."""

import numpy as np

from thermorender.physics import humidity, sky, sun

PLACE = 47.0, 11.0, 600.0
START = np.datetime64("2018-07-20T00:30", "s")


def sunlight(time, place=PLACE):
    """Global, direct and diffuse of a clear sky at instants."""
    elevation = sun.position_at(time, *place[:2])[1]
    direct, diffuse = sky.clear_sky(elevation, humidity.standard_pressure(place[2]), 1.5, 0.1, sun.eccentricity(time))
    return direct * np.sin(np.radians(np.maximum(elevation, 0.0))) + diffuse, direct, diffuse


def station(path, changes=None, days=3, step_h=1.0, clock_h=0.0, lines=None):
    """Write a clean station's file of `days` days, columns replaced or added by `changes`; None removes one."""
    time = START + np.timedelta64(int(3600 * step_h), "s") * np.arange(int(days * 24 / step_h))
    hour = np.arange(time.size) * step_h
    table = {
        "time_utc": [f"{stamp}Z" for stamp in time + np.timedelta64(int(3600 * clock_h), "s")],
        "air_c": 15.0 - 6.0 * np.cos(2 * np.pi * (hour - 3.0) / 24.0),
        "rh_percent": np.full(time.size, 60.0),
        "wind_m_s": np.full(time.size, 2.0),
        "sw_down_w_m2": np.round(sunlight(time)[0], 1),
        **(changes or {}),
    }
    table = {
        name: np.asarray(value(time) if callable(value) else value)
        for name, value in table.items()
        if value is not None
    }
    rows = [",".join(table), *(",".join(map(str, row)) for row in zip(*table.values(), strict=True))]
    path.write_text("\n".join(lines(rows) if lines else rows) + "\n")
    return path


def hours(days, start):
    """Ends of the hours of `days` days in local time, and their middles in UTC, for a zone of one hour."""
    ends = np.datetime64(start, "s") + np.timedelta64(3600, "s") * (1 + np.arange(24 * days))
    return ends, ends - np.timedelta64(1800, "s") - np.timedelta64(3600, "s")


def write_epw(path, days=2, start="2007-07-20", changes=None, years=(2007,)):
    ends, middles = hours(days, start)
    total, direct, diffuse = sunlight(middles)
    lines = [
        "LOCATION,Somewhere,-,XXX,made,000000,47.0,11.0,1.0,600.0", "DESIGN CONDITIONS,0", "TYPICAL/EXTREME PERIODS,0",
        "GROUND TEMPERATURES,0", "HOLIDAYS/DAYLIGHT SAVINGS,No,0,0,0", "COMMENTS 1,", "COMMENTS 2,",
        "DATA PERIODS,1,1,Data,Sunday, 1/ 1,12/31",
    ]  # fmt: skip
    for k, end in enumerate(ends):
        day = (end - np.timedelta64(1, "s")).item()
        hour = (end - np.timedelta64(1, "s")).item().hour + 1
        row = {
            0: years[k % len(years)], 1: day.month, 2: day.day, 3: hour, 4: 0, 5: "?", 6: round(10.0 + 0.5 * hour, 2),
            7: 5.0, 8: 999, 9: 94300, 10: 9999, 11: 9999, 12: 300, 13: round(total[k], 2), 14: round(direct[k], 2),
            15: round(diffuse[k], 2), 16: 999999, 17: 999999, 18: 999999, 19: 9999, 20: 180, 21: 3.0, 22: 2, 23: 2,
            24: 9999, 25: 99999, 26: 9, 27: "999999999", 28: 999, 29: 0.999, 30: 7, 31: 99, 32: 999, 33: 0.4, 34: 1.0,
            **(changes or {}),
        }  # fmt: skip
        lines.append(",".join(str(row[column]) for column in range(35)))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_tmy3(path, days=2):
    ends, middles = hours(days, "2007-07-20")
    total, direct, diffuse = np.round(sunlight(middles), 1)
    names = ["Date (MM/DD/YYYY)", "Time (HH:MM)", "ETR (W/m^2)", "GHI (W/m^2)", "DNI (W/m^2)", "DHI (W/m^2)",
             "TotCld (tenths)", "Dry-bulb (C)", "Dew-point (C)", "RHum (%)", "Pressure (mbar)", "Wspd (m/s)",
             "Lprecip depth (mm)"]  # fmt: skip
    lines = ['000000,"SOMEWHERE",XX,1.0,47.000,11.000,600', ",".join(names)]
    for k in range(24 * days):
        stamp = (ends[k] - np.timedelta64(1, "s")).item()
        row = [f"{stamp:%m/%d}/1998", f"{k % 24 + 1:02d}:00", 0, total[k], direct[k], diffuse[k], 3,
               10.0 + k % 24, 5.0, 50, 943, 3.0, -9900]  # fmt: skip
        lines.append(",".join(map(str, row)))
    path.write_text("\n".join(lines) + "\n")
    return path
