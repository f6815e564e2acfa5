"""The heat balance of a desert wadi against a thermal map that a drone took, with a stated albedo and without.

Surface models, shade and thermal maps of patches of the wadi Zeelim by the Dead Sea: Itzkovitch et al., data of
github.com/levyofi/Itzkovitch_el_al_JTB (MIT). `day.csv` has their station's records on that day; local time is UTC+2.
The light between records follows the clear sky, and the day before is taken to be the same. Nothing is fitted to the
maps.
"""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
from scipy import ndimage

from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.physics import turbulence
from thermorender.render.geometry import Geometry
from thermorender.render.heat.simulation import solved
from thermorender.render.variant import activate
from thermorender.scene import open_ground
from thermorender.scene.load import load_scene
from thermorender.scene.raster import grid_of, onto, read_band
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.complete import complete
from thermorender.weather.named_day import named_day

AT = np.datetime64("2021-05-31T13:16:00")
PLACE = (31.355, 35.36, -240.0)
# The authors' model takes the station's wind at 2 m.
SENSORS_M = {"air_height_m": 2.0, "wind_height_m": 2.0}
MATERIAL = "soil_arid"
# Albedo of the ground: that of the reanalysis in the data set, for this flight. Arid land of southern Israel reflects
# up to 0.35, seen from the air: Ben-Gai et al., Theor. Appl. Climatol. 61 (1998) 207.
ALBEDO, ALBEDO_STD = 0.2575, 0.04
# The station's ground sensor minus the thermal map at its place on this flight, which the authors add to the map [K].
STATION_MINUS_MAP_K = 4.43
_DAY_S = 86400.0
# Pixels at the edge of a patch that are not scored: land beyond it casts no shadow there.
_EDGE = 8
# Posts of the surface model that are averaged along each side, to 0.6 m.
_BLOCK = 2
# Standard deviation of the Gaussian that separates fine from coarse patterns [m].
_FINE_M = 5.0
HEADER = ("patch", "run", "bias [K]", "MAE [K]", "MAE after one offset [K]", "correlation", "below 10 m",
          "error's spread [K]", "map's spread [K]", "MAE of the map as read [K]")  # fmt: skip
_WORDS = {"table": "table's absorptance", "albedo": f"albedo {ALBEDO:g}"}


def station():
    """Return {column: (N,) values} of the station's day; `time` is datetime64, UTC."""
    with open(Path(__file__).with_name("day.csv"), encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found = {name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name != "time_utc"}
    return found | {"time": np.array([np.datetime64(row["time_utc"][:-1], "s") for row in rows])}


def weather(days=3):
    """Return the Weather of the station's day, which is also that of the days before."""
    own = station()
    first = AT.astype("M8[D]") - np.timedelta64(days - 1, "D")
    time = (first + np.arange(48 * days + 1) * np.timedelta64(1800, "s")).astype("M8[s]")
    clear = named_day(AT, PLACE, air_low_c=26.0, air_high_c=38.0, humidity_low=0.55, wind_m_s=2.0, cloud=0.0)

    def light(at):
        now, sine = clear.at(at), np.sin(np.radians(clear.sun(at)[1]))
        return np.where(sine > 0.0, now.direct_w_m2 * np.maximum(sine, 0.0) + now.diffuse_w_m2, 0.0)

    def of_day(at):
        return (at - at.astype("M8[D]")) / np.timedelta64(1, "s")

    def through(values):
        return np.interp(of_day(time), of_day(own["time"]), values, period=_DAY_S)

    saturated, _ = turbulence.saturation_vapour(np, own["air_c"] + ZERO_CELSIUS_K)
    given = {
        "air_k": through(own["air_c"]) + ZERO_CELSIUS_K,
        "vapour_pa": through(saturated * own["rh_percent"] / 100.0),
        "wind_m_s": through(own["wind_m_s"]),
        "pressure_pa": 100.0 * through(own["pressure_hpa"]),
        "global_w_m2": light(time) * through(own["global_w_m2"] / light(own["time"])),
    }
    return complete(time, PLACE, given, **SENSORS_M)


def at_station(albedo=ALBEDO, **thermal):
    """Return the modelled minus the measured ground temperature at the station, (N,) [K], at each of its records.

    `thermal` replaces properties of the material's table.
    """
    return at_station_of([(albedo, thermal)])[0]


def at_station_of(cases):
    """Return what `at_station` does for each of some (albedo, replaced properties), (cases, N) [K], all at once."""
    own, air = station(), weather()
    usual = load_library()[MATERIAL]
    grounds = [
        replace(usual, solar_absorptance=1.0 - albedo, thermal=replace(usual.known_thermal(), **thermal))
        for albedo, thermal in cases
    ]
    columns = open_ground.columns(grounds, air)
    now, found = air.time[0] + np.timedelta64(1, "D"), []
    state, _ = open_ground.settled(columns, air, now)
    for at in own["time"]:
        state = open_ground.march(columns, air, state, now, at)[-1] if at > now else state
        now = max(now, at)
        found.append(state.surface_k - ZERO_CELSIUS_K)
    return np.array(found).T - own["ground_c"]


def scene_of(folder, surface_model, title):
    """Write the scene of a surface model into a folder and return it with the station's weather."""
    folder.mkdir(parents=True, exist_ok=True)
    with rasterio.open(surface_model) as source:
        # Means of blocks: the map's pixels cannot be told from their neighbours'.
        shape = source.height // _BLOCK, source.width // _BLOCK
        area = (slice(0, shape[0] * _BLOCK), slice(0, shape[1] * _BLOCK))
        height = source.read(1)[area].reshape(shape[0], _BLOCK, shape[1], _BLOCK).mean(axis=(1, 3))
        grid = source.transform * rasterio.Affine.scale(_BLOCK)
        with rasterio.open(folder / "elevation.tif", "w", driver="GTiff", count=1, dtype="float32", height=shape[0],
                           width=shape[1], crs=source.crs, transform=grid) as made:  # fmt: skip
            made.write(height.astype(np.float32), 1)
    (folder / "scene.toml").write_text(
        f'title = "{title}"\n[terrain]\nelevation = "elevation.tif"\n[temperature]\nsource = "balance"\n'
        f'[emissivity]\nsource = "material"\nmaterial = "{MATERIAL}"\n[camera]\nmodel = "zenmuse-xt2"\n'
        "[weather]\ntime = 2021-05-31T13:16:00Z\nair_low_c = 26.0\nair_high_c = 38.0\nhumidity = 0.55\n"
        "wind_m_s = 2.0\ncloud = 0.0\n",
        encoding="utf-8",
    )
    return load_scene(folder).with_weather(weather(), time=AT)


def scores(found, read):
    """Return the scores of temperatures against a thermal map as read, (h, w) each [°C]."""
    inner = (slice(_EDGE, -_EDGE),) * 2
    found, read = found[inner].ravel(), read[inner].ravel()
    known = np.isfinite(found) & np.isfinite(read)
    found, read = found[known], read[known]
    error = found - (read + STATION_MINUS_MAP_K)
    return {
        "bias_k": error.mean(), "mae_k": np.abs(error).mean(),
        "mae_after_offset_k": np.abs(error - np.median(error)).mean(),
        "correlation": np.corrcoef(found, read)[0, 1], "spread_k": error.std(), "map_spread_k": read.std(),
        "mae_as_read_k": np.abs(found - read).mean(),
    }  # fmt: skip


def fine(found, read, texel_m):
    """Return the correlation of two maps without what varies over more than some metres."""
    inner, reach = (slice(_EDGE, -_EDGE),) * 2, _FINE_M / texel_m
    planes = [(each - ndimage.gaussian_filter(each, reach))[inner].ravel() for each in (found, read)]
    return float(np.corrcoef(*planes)[0, 1])


def explained(error, height, shade, texel_m):
    """Return {group: R² of a least-squares fit of the error} for groups of properties of the relief, alone and all."""
    north, east = np.gradient(height, texel_m)
    smooth = {size: ndimage.uniform_filter(height, round(size / texel_m)) for size in (1.5, 6.0, 24.0)}
    rough = {size: np.sqrt(np.maximum(ndimage.uniform_filter((height - smooth[size]) ** 2, round(size / texel_m)), 0.0))
             for size in (1.5, 6.0)}  # fmt: skip
    groups = {
        "slope and aspect": [east, -north, np.hypot(east, north), east**2, north**2],
        "height within 1.5, 6 and 24 m": [height - smooth[size] for size in smooth],
        "roughness within 1.5 and 6 m": [np.log(rough[size] + 1e-3) for size in rough],
        "shade, and shade within 3 m": [shade, ndimage.uniform_filter(shade, round(3.0 / texel_m))],
        "height": [height, height**2],
    }
    row, column = np.mgrid[: height.shape[0], : height.shape[1]] / max(height.shape)
    groups["all of the relief"] = [each for group in list(groups.values()) for each in group]
    groups["place in the patch, quadratic"] = [row, column, row**2, column**2, row * column]
    inner = (slice(_EDGE, -_EDGE),) * 2
    target = error[inner].ravel() - error[inner].mean()
    found = {}
    for name, planes in groups.items():
        columns = np.column_stack([np.ones(target.size), *(plane[inner].ravel() for plane in planes)])
        columns[:, 1:] = (columns[:, 1:] - columns[:, 1:].mean(axis=0)) / np.maximum(columns[:, 1:].std(axis=0), 1e-12)
        fit, *_ = np.linalg.lstsq(columns, target, rcond=None)
        found[name] = float(1.0 - ((target - columns @ fit) ** 2).mean() / target.var())
    return found


def run(data, scratch, progress=None):
    """Return the numbers of the study, as plain values.

    Parameters
    ----------
    data : path
        Folder with `N_dsm.tif`, `N_shade.tif` and `N_thermal_degC.tif` of patches N.
    scratch : path
        Folder for scenes.
    progress : callable, optional
        Called with (what, share done).

    Raises
    ------
    ThermorenderError
        The folder has no patch.
    """
    data, report = Path(data), progress or (lambda what, share: None)
    names = sorted(match[1] for path in data.glob("*_dsm.tif") if (match := re.fullmatch(r"(\w+)_dsm\.tif", path.name)))
    if not names:
        raise ThermorenderError(f"--data={data} has no patch; give a folder with N_dsm.tif and N_thermal_degC.tif")
    patches = {}
    for number, name in enumerate(names):
        report(f"patch {name}", number / len(names))
        scene = scene_of(scratch / name, data / f"{name}_dsm.tif", f"patch {name}")
        read = onto(read_band(data / f"{name}_thermal_degC.tif"), grid_of(data / f"{name}_thermal_degC.tif"),
                    scene.grid, "bilinear")  # fmt: skip
        shade = onto(read_band(data / f"{name}_shade.tif"), grid_of(data / f"{name}_shade.tif"), scene.grid, "bilinear")
        geometry, runs = Geometry(activate(), scene.surfaces), {}
        for key, one in (("table", scene), ("albedo", scene.with_weather(albedo=ALBEDO, albedo_std=ALBEDO_STD))):
            found = solved(one, [AT], geometry)[0].surfaces[0].temperature.astype(np.float64) - ZERO_CELSIUS_K
            whole = np.where(np.isfinite(read), read, np.nanmean(read))
            texel_m = scene.surfaces[0].texel_m
            runs[key] = scores(found, read) | {"fine_correlation": fine(found, whole, texel_m)}
        height = onto(read_band(data / f"{name}_dsm.tif"), grid_of(data / f"{name}_dsm.tif"), scene.grid, "bilinear")
        height = np.where(np.isfinite(height), height, np.nanmean(height))
        shade = np.nan_to_num(shade)
        error = found - whole
        patches[name] = {
            "runs": runs, "explained": explained(error, height, shade, texel_m),
            "explained_of_map": explained(whole, height, shade, texel_m),
        }  # fmt: skip
    notes = list(scene.with_weather(albedo=ALBEDO, albedo_std=ALBEDO_STD).weather_notes)
    return {"albedo": ALBEDO, "albedo_std": ALBEDO_STD, "station_minus_map_k": STATION_MINUS_MAP_K,
            "at_station_k": dict(zip(map(str, station()["time"]), map(float, at_station()), strict=True)),
            "notes": notes, "patches": patches}  # fmt: skip


def rows(result):
    """Return the rows of the study's table; see `HEADER`."""
    keys = (
        "bias_k",
        "mae_k",
        "mae_after_offset_k",
        "correlation",
        "fine_correlation",
        "spread_k",
        "map_spread_k",
        "mae_as_read_k",
    )
    return [
        (name, _WORDS[run], *(f"{scores[key]:.2f}" for key in keys))
        for name, patch in result["patches"].items()
        for run, scores in patch["runs"].items()
    ]
