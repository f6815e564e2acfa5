"""Long-wave radiation in a courtyard from six directions, modelled with its walls and measured by the hour.

The site is the courtyard of Kronenhuset in Gothenburg on 7 October 2005, a clear day (Lindberg, Holmer and Thorsson
2008, doi:10.1007/s00484-008-0162-7). Three net radiometers measured what arrives from above, from below and from the
four sides. The surface model, the ground's heights and the classes of land cover become walls by `import-terrain
--three-d`, with its usual materials. A heat balance under the weather of a roof nearby gives their temperatures.
Nothing is fitted.

The weather is that of one day, which is repeated so that walls are in balance with it. The long-wave of the sky is
modelled first. From the measurement from above, without the modelled light of the walls there, follows the sky of a
second case; at night it keeps the mean ratio of both. What the walls are made of is not known: they are painted brick,
then red brick. Hours of the weather begin at their label, in UTC+1, and those of the measurement end at it: the sun in
the courtyard and the sum of direct and diffuse light say so.

A side's sensor gets half of its light from the ground. What the walls radiate follows from the measurement without the
measured light of the ground and that of the case's sky, each by its share of the sensor's view.
"""

import csv
import tempfile
from pathlib import Path

import numpy as np

from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.physics.sun import direction
from thermorender.render.arrays import aligned
from thermorender.render.geometry import Geometry
from thermorender.render.heat.simulation import solved
from thermorender.render.variant import activate
from thermorender.scene import open_ground
from thermorender.scene.load import load_scene
from thermorender.scene.raster import grid_of, lon_lat
from thermorender.versions import versions

HEADER = ("walls, sky", "from", "measured", "bias", "MAE", "RMS [W/m²]", "walls in view", "walls' bias", "MAE [K]")
DAY, LABEL_S = "2005-10-07", 3600.0
# Files of the site, place of the mast in the map of the rasters (file POI_KR of the same data) and height of the
# sensors: SOLWEIG's usual 1.1 m.
FILES = ("DSM_KR.tif", "DEM_KR.tif", "landcover_KR.tif", "MetFile_Prepared.txt", "measurements_kr.csv")
MAST, HIGH_M, ROOFS_CLASS = (147837.67, 6398728.30), 1.1, 2
PAVING = "granite_paving"
# Direction of each sensor: east, north, up.
SENSORS = {
    "north": (0, 1, 0), "east": (1, 0, 0), "south": (0, -1, 0), "west": (-1, 0, 0), "up": (0, 0, 1), "down": (0, 0, -1),
}  # fmt: skip
_COLUMNS = {"north": "Ln", "east": "Le", "south": "Ls", "west": "Lw", "up": "Ldown", "down": "Lup"}
SIDES = ("north", "east", "south", "west")
SKIES = ("modelled", "measured")
# Days of the same weather before the day itself, reflections that are followed, and steps of the sun in an hour.
_REPEATS, _BOUNCES, _STEPS = 3, 3, 12


def run(folder, rays=16384, walls=("brick_painted", "brick_clay"), progress=None):
    """Return modelled and measured long-wave by direction and hour [W m⁻²], as plain numbers.

    Parameters
    ----------
    folder : path
        Of the site's files, FILES.
    rays : int
        Of each sensor.
    walls : sequence of str
        Materials of all walls, one after another, each with both skies.

    Raises
    ------
    ThermorenderError
        A file is missing.
    """
    folder, report = Path(folder), progress or (lambda step, share: None)
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise ThermorenderError(f"--data={folder} lacks {', '.join(missing)}; give the folder kronenhuset of the site")
    table = _measured(folder / FILES[4])
    times = [np.datetime64(f"{DAY}T00:00") + np.timedelta64(int(60 * (float(row["hour"]) - 1.5)), "m") for row in table]
    measured = {name: np.array([float(row[_COLUMNS[name]]) for row in table]) for name in SENSORS}
    cases, sky = {}, None
    for number, (wall, kind) in enumerate((wall, kind) for kind in SKIES for wall in walls):
        report(f"{wall}, sky {kind}", number / (len(SKIES) * len(walls)))
        cases[f"{wall}, {kind}"], weather, found = _modelled(folder, wall, times, rays, sky)
        if kind == SKIES[0] and wall == walls[-1]:
            sky = _sky_behind(cases[f"{walls[0]}, {kind}"], weather, times, measured["up"])
    return {
        "versions": versions(), "site": "Kronenhuset, Gothenburg, 7 October 2005", "buildings": found["buildings"],
        "hours": [float(row["hour"]) for row in table], "sunlit": found["sunlit"],
        "measured_global_w_m2": [float(row["Kdown"]) for row in table],
        "cases": {name: {"sky_w_m2": each["sky"].tolist(),
                         "sensors": {sensor: _scores(measured, each, sensor) for sensor in SENSORS}}
                  for name, each in cases.items()},
    }  # fmt: skip


def _sky_behind(case, weather, times, measured):
    """Long-wave of the sky (n,) [W m⁻²] at a Weather's rows: what is measured from above without the walls' share."""
    share = case["up"]["shares"]["sky"]
    ratio = (measured - case["up"]["total"] + share * case["sky"]) / share / case["sky"]
    rows, hours = (np.array(each, "M8[s]").astype(float) for each in (weather.time, times))
    return np.interp(rows, hours, ratio, left=ratio.mean(), right=ratio.mean()) * weather.longwave_w_m2


def rows(result):
    """Return the errors by direction as table rows under HEADER."""
    found = []
    for case, of in result["cases"].items():
        for name, each in of["sensors"].items():
            error = np.array(each["modelled_w_m2"]) - each["measured_w_m2"]
            walls = (f"{each['view']['walls']:.0%}", "", "")
            if "wall_k" in each:
                apart = np.array(each["wall_k"]) - each["measured_wall_k"]
                walls = (walls[0], f"{apart.mean():+.1f}", f"{np.abs(apart).mean():.1f}")
            found.append((case, name, f"{np.mean(each['measured_w_m2']):.0f}", f"{error.mean():+.1f}",
                          f"{np.abs(error).mean():.1f}", f"{np.sqrt((error**2).mean()):.1f}", *walls))  # fmt: skip
    return found


def _modelled(folder, wall, times, rays, longwave=None):
    """({sensor: as `_arriving`, "sky": (T,)}, Weather, {buildings, sunlit}) with walls of a material."""
    with tempfile.TemporaryDirectory() as made:
        weather = Path(made) / "weather.csv"
        weather.write_text(_weather(folder / FILES[3], longwave))
        three_d = ThreeD(folder / FILES[1], [wall], ROOFS_CLASS)
        found = import_terrain(
            folder / FILES[0], None, Path(made) / "scene",
            ImportSettings(material=PAVING, weather=weather, time=f"{times[0]}Z", known=folder / FILES[2]), three_d,
        )  # fmt: skip
        scene = load_scene(Path(made) / "scene")
    geometry = Geometry(activate(), scene.surfaces)
    scenes = solved(scene, times, geometry)
    (longitude,), (latitude,) = lon_lat(grid_of(folder / FILES[0]), *(np.array([v]) for v in MAST))
    east, north, _ = scene.frame.enu_from_geodetic(*(np.array([v]) for v in (latitude, longitude, 0.0)))[0]
    mast = np.array([east, north, float(scene.ground(east, north)) + HIGH_M])
    sky = np.array([float(scene.weather.at(time).longwave_w_m2) for time in times])
    light = {name: arriving(geometry, scenes, mast, np.array(axis, float), sky, rays) for name, axis in SENSORS.items()}
    sunlit = [_sunlit(geometry, scene, mast, time) for time in times]
    return light | {"sky": sky}, scene.weather, {"buildings": found["buildings"], "sunlit": sunlit}


def _measured(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _weather(path, longwave=None):
    """The table of a day's weather, repeated on the days before, as a station's CSV; `longwave` (n,) is of its rows."""
    names, *lines = (line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip())
    at = {name: names.index(name) for name in ("it", "Wind", "RH", "Td", "Kdiff", "Kdir")}
    head = "time_utc,air_c,rh_percent,wind_m_s,sw_direct_normal_w_m2,sw_diffuse_w_m2"
    table = [head + (",lw_down_w_m2" if longwave is not None else "")]
    for day in range(-_REPEATS, 2):
        for line in lines:
            value = {name: float(line[column]) for name, column in at.items()}
            # The middle of the hour that begins at the label.
            minutes = int(day * 1440 + (value["it"] - 0.5) * 60)
            time = np.datetime64(f"{DAY}T00:00") + np.timedelta64(minutes, "m")
            row = f"{time}Z,{value['Td']},{value['RH']},{value['Wind']},{value['Kdir']},{value['Kdiff']}"
            table.append(row + (f",{longwave[len(table) - 1]:.1f}" if longwave is not None else ""))
    return "\n".join(table) + "\n"


def _sunlit(geometry, scene, mast, time):
    """Share of an hour in which the mast is in the sun."""
    lit = 0
    for k in range(_STEPS):
        instant = time + np.timedelta64(round(LABEL_S * ((k + 0.5) / _STEPS - 0.5)), "s")
        azimuth, elevation = scene.weather.sun(instant)
        if elevation > 0.0:
            lit += not _cast(geometry, mast[None], direction(float(elevation), float(azimuth))[None])[0][0]
    return lit / _STEPS


def _cast(geometry, origin, towards):
    """(whether rays (n, 3) hit, their lengths, face, texel) as arrays (n,)."""
    mi = geometry.mi
    upload = lambda values: [mi.Float(aligned(axis.astype(np.float32))) for axis in values.T]  # noqa: E731
    point, ahead = mi.Point3f(*upload(origin)), mi.Vector3f(*upload(towards))
    hit = geometry.cast(mi.Ray3f(point, ahead))
    column, row = geometry.map_position(geometry.record(hit.face, hit.valid), point + hit.distance * ahead)
    texel = geometry.nearest(hit.surface, column, row, hit.valid)
    return tuple(np.array(each) for each in (hit.valid, hit.distance, hit.face, texel))


def arriving(geometry, scenes, mast, axis, sky, rays):
    """Return the light of each hour on a sensor that faces along an axis, and what its view consists of.

    Returns
    -------
    dict
        total (T,), shares {"sky", "walls", "ground", other}, walls (T,): mean radiosity of the walls in view [W m⁻²].
    """
    random = np.random.default_rng(0)
    surfaces = scenes[0].surfaces
    kind = np.repeat(np.arange(len(surfaces)), [len(surface.faces) for surface in surfaces])
    names = [surface.name.split(":")[-1] for surface in surfaces]
    kelvin = np.array([np.concatenate([s.temperature.ravel() for s in each.surfaces]) for each in scenes])
    number = np.concatenate([surface.material.ravel() for surface in surfaces])
    emissivity = np.array([open_ground.broadband(material) for material in scenes[0].materials])
    corner = np.concatenate([surface.vertices[surface.faces] for surface in surfaces])
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = int(np.sqrt(rays))
    origin = np.repeat(mast[None], side * side, axis=0)
    towards = _off(np.repeat(axis[None], side * side, axis=0), _even(side, random))
    light = np.zeros((side * side, len(sky)))
    through, of = np.ones(side * side), np.arange(side * side)
    first = None
    for bounce in range(_BOUNCES):
        valid, length, face, texel = _cast(geometry, origin, towards)
        light[of[~valid]] += through[~valid, None] * sky
        if first is None:
            first = np.where(valid, kind[face], -1)
        of, through, origin, towards, length, face, texel = (
            each[valid] for each in (of, through, origin, towards, length, face, texel)
        )
        emits = emissivity[number[texel]]
        black = STEFAN_BOLTZMANN * kelvin[:, texel].T.astype(float) ** 4
        # What is reflected in the end came from a surface like it.
        light[of] += (through * (emits if bounce + 1 < _BOUNCES else 1.0))[:, None] * black
        through = through * (1.0 - emits)
        facing = -np.sign((normal[face] * towards).sum(axis=1))[:, None] * normal[face]
        origin = origin + length[:, None] * towards + geometry.hair * facing
        towards = _off(facing, random.random((len(facing), 2)))
    shares = {name: float(np.isin(first, [k for k, each in enumerate(names) if each == name]).mean())
              for name in names} | {"sky": float((first < 0).mean())}  # fmt: skip
    wall = first == names.index("walls")
    return {"total": light.mean(axis=0), "shares": shares, "walls": light[wall].mean(axis=0) if wall.any() else None}


def _even(side, random):
    """Pairs of numbers 0…1, (side², 2), one in each square of a lattice."""
    row, column = np.divmod(np.arange(side * side), side)
    return (np.column_stack([row, column]) + random.random((side * side, 2))) / side


def _off(normal, even):
    """Directions off normals (n, 3) by the cosine law."""
    across = np.where(np.abs(normal[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    one = np.cross(normal, across)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    radius, angle = np.sqrt(even[:, :1]), 2.0 * np.pi * even[:, 1:]
    plan = np.cos(angle) * one + np.sin(angle) * np.cross(normal, one)
    return radius * plan + np.sqrt(1.0 - even[:, :1]) * normal


def _scores(measured, modelled, name):
    """Plain numbers of one sensor; for the sides also the temperatures at which walls radiate."""
    own = modelled[name]
    share = own["shares"]
    found = {"measured_w_m2": measured[name].tolist(), "modelled_w_m2": own["total"].tolist(), "view": share}
    if name in SIDES:
        ground = 1.0 - share["sky"] - share["walls"]
        rest = measured[name] - share["sky"] * modelled["sky"] - ground * measured["down"]
        found["measured_wall_k"] = ((rest / share["walls"] / STEFAN_BOLTZMANN) ** 0.25).tolist()
        found["wall_k"] = ((own["walls"] / STEFAN_BOLTZMANN) ** 0.25).tolist()
    return found
