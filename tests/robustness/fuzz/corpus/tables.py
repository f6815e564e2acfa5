"""Tables: logs of flights, spectra, soundings, weather."""

import shutil

import numpy as np

from tests.robustness.fuzz.corpus.registry import reader
from thermorender.paths import data_folder

_MATERIALS = data_folder("materials")


_FLIGHT = "time_s,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg\n" + "".join(
    f"{0.5 * k:.3f},{4.0 + k:.3f},{-14.0 + 2 * k:.3f},119.4,{359.0 + k:.3f},-45.0,0.1\n" for k in range(12)
)


@reader("trajectory", "flight.csv", _FLIGHT)
def _trajectory(path):
    from thermorender.trajectory.readers import read_trajectory

    path = read_trajectory(path)
    return path, path.pose(float(np.mean(path.span_s)))


@reader("track", "track.csv", "time_s,east_m,north_m,yaw_deg,temperature_k\n0,0,0,0,300\n1,2,0,10,310\n2,3,1,20,305\n")
def _track(path):
    from thermorender.scene.tracks import read_track

    return read_track(path)


_SOUNDING = "altitude_m,pressure_hpa,temperature_k,relative_humidity_percent\n" + "".join(
    f"{500 * k},{1013.25 * (1 - 0.0065 * 500 * k / 288.15) ** 5.2559:.2f},{288.15 - 3.25 * k:.2f},{60 - 2 * k}\n"
    for k in range(12)
)


@reader("sounding", "profile.csv", _SOUNDING)
def _profile(path):
    from thermorender.atmosphere.profile import from_profile

    air = from_profile(path)
    return air, air.transmittance(0.0, 100.0, 500.0)


@reader("emissivity", "material.csv", _MATERIALS / "spectra" / "asphalt.csv")
def _emissivity(path):
    from thermorender.materials.csv_tables import read_emissivity

    found = read_emissivity(path)
    # Where no spread is known its column is empty.
    return {key: value for key, value in found.items() if key != "emissivity_std"}


@reader("refractive index", "index.csv", "wavelength_um,n,k\n" + "".join(
    f"{7 + 0.5 * k},{1.2 + 0.01 * k},{0.05 + 0.02 * k}\n" for k in range(16)
))  # fmt: skip
def _refractive(path):
    from thermorender.materials.csv_tables import read_refractive_index

    found = read_refractive_index(path, 0.0)
    return {key: value for key, value in found.items() if key != "emissivity_std"}


@reader("emissivity by angle", "angles.csv", "wavelength_um,at_0,at_30,at_60,at_90\n" + "".join(
    f"{7 + k},0.95,0.94,0.9,0.0\n" for k in range(8)
))  # fmt: skip
def _angles(path):
    from thermorender.materials.csv_tables import read_angles

    found = read_angles(path)
    return {key: value for key, value in found.items() if key != "emissivity_std"}


@reader("thermal properties", "thermal.csv", _MATERIALS / "thermal" / "asphalt.csv")
def _thermal(path):
    from thermorender.materials.thermal import read_thermal

    thermal = read_thermal(path)
    return [value for value in vars(thermal).values() if isinstance(value, float) and not np.isnan(value)]


@reader("sample", "sample.csv", "wavelength_um,emissivity_percent\n" + "".join(
    f"{7 + 0.25 * k:.2f},{94 + k % 3}\n" for k in range(30)
))  # fmt: skip
def _sample(path):
    from thermorender.apps.material_tables.samples import read_sample

    return read_sample(path)


_ECOSTRESS = (
    "Name: Sand\nType: Soil\nClass: Entisol\nWavelength Range: All\nOrigin: here\nMeasurement: Directional (10 Degree) "
    "Hemispherical Reflectance\nFirst Column: X\nSecond Column: Y\nX Units: Wavelength (micrometers)\n"
    "Y Units: Reflectance (percent)\nFirst X Value: 14\nLast X Value: 0.545\nNumber of X Values: 118\n\n"
) + "".join(f"{14.0 - 0.115 * k:.4f}\t{5 + k % 7:.3f}\n" for k in range(118))


@reader("ECOSTRESS", "sample.txt", _ECOSTRESS)
def _ecostress(path):
    from thermorender.apps.material_tables.samples import read_sample

    return read_sample(path)


_STATION = "time_utc,air_c,rh_percent,wind_m_s,sw_down_w_m2,pressure_hpa\n" + "".join(
    f"2018-07-{28 + k // 24:02d}T{k % 24:02d}:30Z,{18 + 6 * np.sin((k - 9) / 3.8):.1f},55,2.5,"
    f"{800 * np.sin(np.pi * (k % 24 - 3.5) / 15) if 4 < k % 24 < 19 else 0:.0f},1013\n"
    for k in range(72)
)


@reader("weather", "weather.csv", _STATION)
def _weather(path):
    from thermorender.weather.station import read_station

    return read_station(path, 49.0, 8.0, 120.0)


# Newest row first, a gap in the rows and in a column, and rain as a running total.
_GAPPY = "time;air_f;dew_point_f;wind_knots;ppfd_umol_m2_s;cloud_oktas;rain_total_mm;snow_depth_cm;note\n" + "".join(
    f"2018-07-{28 + k // 24:02d}T{k % 24:02d}:30:00+02:00;{64 + k % 9};{'' if k % 11 == 5 else 50};{k % 7},5;"
    f"{1600 * np.sin(np.pi * (k % 24 - 5.5) / 15) if 6 < k % 24 < 20 else 0:.0f};{k % 10};{k // 20},4;---;x\n"
    for k in range(70, -1, -1)
    if k % 24 != 3
).replace("---", "NA")


@reader("weather with gaps", "weather.csv", _GAPPY)
def _gappy_weather(path):
    from thermorender.weather.station import read_station

    return read_station(path, 49.0, 8.0, 120.0, around=np.datetime64("2018-07-29T12:00:00"))


# --- logs of other programs -------------------------------------------------------------------------------------


def of_log(paths, format):
    """Return (Trajectory, pose at its middle) of a log in a bundled format."""
    from thermorender.trajectory.path import Anchor
    from thermorender.trajectory.readers import read_trajectory

    path = read_trajectory(paths, format=format, anchor=Anchor(0.5, 0.5, 30.0, 0.0))
    return path, path.pose(float(np.mean(path.span_s)))


DJI = (
    "lat_deg,lon_deg,rel_alt_m,flight_yaw_deg,flight_pitch_deg,flight_roll_deg,gimbal_yaw_deg,gimbal_pitch_deg,"
    "gimbal_roll_deg,local_datetime,subsec,utc_at_exposure\n"
) + "".join(
    f"47.2{k},8.5,{40 + k},{k},0,0,0,{k - 90},0,2024:08:06 17:35:0{k},25,{'' if k else '2024-08-06T15:35:00.25Z'}\n"
    for k in range(8)
)


@reader("DJI log", "log.csv", DJI)
def _dji(path):
    return of_log(path, "dji-gimbal")


def _write_px4(path):
    path.write_text("timestamp,x,y,z,vx\n" + "".join(
        f"{1_000_000 + 100_000 * k},{0.5 * k},{-0.3 * k},{-1.0 - k},0.1\n" for k in range(12)
    ))  # fmt: skip
    path.with_name("attitude.csv").write_text("timestamp,q[0],q[1],q[2],q[3]\n" + "".join(
        f"{1_000_500 + 50_000 * k},{np.cos(0.02 * k):.6f},0,0,{np.sin(0.02 * k):.6f}\n" for k in range(24)
    ))  # fmt: skip


def of_px4(path):
    """Return the result of `of_log` for the two files that PX4's log becomes."""
    return of_log([path, path.with_name("attitude.csv")], "px4")


reader("PX4 log", "position.csv", _write_px4)(of_px4)


_ROCKET = (
    "timestamp_seconds,est_position_x_meters,est_position_y_meters,est_position_z_meters,est_quaternion_w,"
    "est_quaternion_x,est_quaternion_y,est_quaternion_z\n"
) + "".join(f"{0.01 * k:.2f},{0.1 * k:.2f},0.0,{0.5 * k:.2f},0.6,0.0,0.8,0.0\n" for k in range(12))


@reader("rocket log", "rocket.csv", _ROCKET)
def _rocket(path):
    return of_log(path, "rocket-firm")


_ESTIMATES = (
    "timestamp,x,y,z,delta_xy[0],delta_xy[1],xy_valid,z_valid,xy_reset_counter,q[0],q[1],q[2],q[3],quat_reset_counter,"
    "delta_q_reset[0],delta_q_reset[1],delta_q_reset[2],delta_q_reset[3]\n"
) + "".join(
    f"{10**6 + 10**5 * k},{k},0,-9,3,0,{int(k != 3)},1,{int(k > 4)},1,0,0,0,{int(k > 5)},1,0,0,0\n" for k in range(9)
)


@reader("PX4 estimates", "estimates.csv", _ESTIMATES)
def _estimates(path):
    return of_log(path, "px4")


_SUBTITLES = (
    "\n".join(
        f"{k + 1}\n00:00:0{k},000 --> 00:00:0{k + 1},000\n[latitude: 47.{k:04d}] [longitude: 8.5] "
        f"[rel_alt: 4{k}.0 abs_alt: 1.0] [gb_yaw: {k}.0 gb_pitch: -80.0 gb_roll: 0.0] F.PRY (1.0°, 2.0°, {k}.0°)\n"
        for k in range(5)
    )
    + "\n9\n00:00:06,000 --> 00:00:07,000\nGPS(8.5,47.0,15) BAROMETER:1.9\n"
)


@reader("DJI subtitles", "video.srt", _SUBTITLES)
def _subtitles(path):
    return of_log(path, "dji-srt")


_AIRDATA = (
    "time(millisecond),latitude,longitude,height_above_takeoff(feet), compass_heading(degrees),gimbal_pitch(degrees)\n"
) + "".join(f"{100 * k},47.{k:04d},8.5,{100 + k},{k},-45\n" for k in range(9))


@reader("AirData log", "airdata.csv", _AIRDATA)
def _airdata(path):
    return of_log(path, "airdata")


_GPX = "<gpx><trk><trkseg>" + "".join(
    f'<trkpt lat="47.{k:04d}" lon="8.5"><ele>{k}</ele><time>2024-05-01T10:00:0{k}Z</time><fix>3d</fix></trkpt>'
    for k in range(9)
) + "</trkseg></trk></gpx>"  # fmt: skip


@reader("GPX track", "track.gpx", _GPX)
def _gpx(path):
    return of_log(path, "gpx")


_KML = "<kml><gx:Track xmlns:gx='x'><altitudeMode>absolute</altitudeMode>" + "".join(
    f"<when>2024-05-01T10:00:0{k}Z</when><gx:coord>8.5 47.{k:04d} {k}</gx:coord><gx:angles>{k} 0 0</gx:angles>"
    for k in range(9)
) + "</gx:Track></kml>"  # fmt: skip


@reader("KML track", "track.kml", _KML)
def _kml(path):
    return of_log(path, "kml")


@reader("pose list", "poses.tum", "# poses\n" + "".join(f"{k}.5 {k} 2 3 0 0.6 0 0.8\n" for k in range(9)))
def _poses(path):
    return of_log(path, "tum")


# --- air of other programs --------------------------------------------------------------------------------------


def _write_tape7(path):
    names = "    FREQ  TOT_TRANS  PTH_THRML  THRML_SCT  SURF_EMIS"
    rows = "".join(
        f"{wavenumber:8.2f} {0.7 + 0.2 * np.sin(wavenumber):.8f} {4e-6:.4E} 0.0000E+00 0.0000E+00\n"
        for wavenumber in range(995, 1120)
    )
    path.write_text(
        "T F 2    2    1    1    1    1    1    1    1    1    1    0    0   0.000   0.00\n"
        "    1    1    1    0    0    0  23.00000   0.00000   0.00000   0.00000   0.00000\n"
        " -99.000 -99.000 -99.000\n -99.00000 -99.00000 -99.00000  4.114728  0.000594\n   36MIDLATITUDE SUMMER\n"
        "   0.12000   0.00000 180.00000   0.12000   0.00000   0.00000    0        0.00000\n"
        "    1    2    1    0\n   0.00000   0.00000 -23.07000 359.19250  12.00000   0.00000   0.00000   0.00000\n"
        f"     995.0    1119.0       1.0       2.0NW\n    0   0    0.000  0    0.000  0    1.000\n{names}\n{rows}"
        "  -9999.\n"
    )


def of_tape7(path):
    """Return the Atmosphere, from 9 to 10 µm, of a tape7."""
    from thermorender.atmosphere.modtran import atmosphere, read_tape7

    return atmosphere(read_tape7(path, 9.0, 10.0), 9.0, 10.0)


@reader("tape7", "tape7.txt", _write_tape7)
def _tape7(path):
    air = of_tape7(path)
    return air, air.transmittance(0.0, 50.0, 100.0), air.path_radiance(0.0, 50.0, 100.0)


# --- weather years ----------------------------------------------------------------------------------------------


def _hours():
    """Yield (day, hour 1…24, air [°C], global light [W/m²]) of three days of July."""
    for k in range(72):
        light = max(0.0, 800 * np.sin((k % 24 - 5) / 4.8)) if 5 < k % 24 < 20 else 0.0
        yield 28 + k // 24, k % 24 + 1, 18 + 6 * np.sin((k - 9) / 3.8), light


_EPW = "LOCATION,Here,-,DEU,made,0,49.0,8.0,1.0,120.0\n" + "DESIGN CONDITIONS,0\n" * 6 + (
    "DATA PERIODS,1,1,Data,Saturday,7/28,7/30\n"
) + "".join(
    f"2018,7,{day},{hour},60,?9,{air:.1f},11.0,55,101300,0,0,330,{light:.0f},{0.7 * light:.0f},{0.3 * light:.0f},0,0,"
    "0,0,180,2.5,3,3,20,77777,9,999999999,15,0.1,0,88,0.2,0,0\n"
    for day, hour, air, light in _hours()
)  # fmt: skip


def _year(path):
    from thermorender.weather.epw import read_epw

    return read_epw(path, 2018)


reader("weather year EPW", "year.epw", _EPW)(_year)


_TMY3 = (
    '724666,"HERE",CO,1.0,49.0,8.0,120\nDate (MM/DD/YYYY),Time (HH:MM),GHI (W/m^2),DNI (W/m^2),DHI (W/m^2),'
    "TotCld (tenths),Dry-bulb (C),Dew-point (C),RHum (%),Pressure (mbar),Wspd (m/s),Lprecip depth (mm)\n"
) + "".join(
    f"07/{day}/1988,{hour:02d}:00,{light:.0f},{0.7 * light:.0f},{0.3 * light:.0f},3,{air:.1f},11.0,55,1000,2.5,0\n"
    for day, hour, air, light in _hours()
)

reader("weather year TMY3", "year.csv", _TMY3)(_year)

_PSM = (
    "Source,Location ID,Latitude,Longitude,Time Zone,Elevation,Local Time Zone,Temperature Units,Pressure Units,"
    "Dew Point Units,Wind Speed Units\nNSRDB,1,49.0,8.0,1,120,1,c,mbar,c,m/s\n"
    "Year,Month,Day,Hour,Minute,GHI,DNI,DHI,Temperature,Dew Point,Pressure,Wind Speed,Relative Humidity\n"
) + "".join(
    f"2018,7,{day},{hour - 1},30,{light:.0f},{0.7 * light:.0f},{0.3 * light:.0f},{air:.1f},11.0,1000,2.5,60\n"
    for day, hour, air, light in _hours()
)

reader("weather year PSM", "year.csv", _PSM)(_year)


# --- libraries of materials -------------------------------------------------------------------------------------


def _write_index(path):
    names = ("asphalt", "grass_dry", "water")
    (path.parent / "spectra").mkdir(exist_ok=True)
    for name in names:
        shutil.copy(_MATERIALS / "spectra" / f"{name}.csv", path.parent / "spectra")
    lines = (_MATERIALS / "index.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    path.write_text(lines[0] + "".join(line for line in lines if line.partition(",")[0] in names), encoding="utf-8")


@reader("material index", "index.csv", _write_index)
def _index(path):
    from thermorender.materials.library import read_library

    # Where no spread is known it is NaN.
    return [
        (each.wavelength_um, each.emissivity, each.colour, each.solar_absorptance, each.temperature, each.rms_slope)
        for each in read_library(path.parent).values()
    ]


def _write_slum(path):
    path.write_text("wavelength,A001,B002\n" + "".join(f"{7 + 0.25 * k},{0.95 - 0.001 * k},0.9\n" for k in range(30)))
    path.with_name("made_SW.csv").write_text("wavelength,A001,B002\n" + "".join(
        f"{400 + 50 * k},{12 + k % 4},8\n" for k in range(40)
    ))  # fmt: skip


@reader("SLUM", "made_IR.csv", _write_slum)
def _slum(path):
    from thermorender.apps.material_tables.samples import read_sample

    return read_sample(path, "A001")


def _write_selection(path):
    _write_slum(path.with_name("made_IR.csv"))
    path.write_text(
        "material,title,file,colour_r,colour_g,colour_b,solar_absorptance,temperature_k,note\n"
        "roof,Roof,made_IR.csv#A001,90,80,80,0.8,300,tiles\nroof,,made_IR.csv#B002,,,,,,\n"
        "wall,Wall,made_IR.csv#B002,190,180,180,0.5,295,\n"
    )


@reader("selection of samples", "selection.csv", _write_selection)
def _selection(path):
    from thermorender.apps.material_tables.from_samples import read_selection

    return [(each.wavelength_um, each.emissivity, each.colour, each.solar_absorptance, each.temperature)
            for each in read_selection(path, [path.parent])]  # fmt: skip
