"""A scene edited in any order equals, to the bit, a scene made fresh with the same inputs.

`EDITS` has an entry for each key of a scene file that an edit can change, and for each edit without a key. An entry
edits a scene, and records the same change in a `Fresh`, from which a scene file is written and read again.
"""

import copy
import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scene_content import different, refusal
from support import slow

import thermorender as tr
from scenes import write_raster, write_terrain
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.scene.spec import (
    AtmosphereSpec,
    EmissivitySpec,
    SceneSpec,
    TemperatureSpec,
    WeatherSpec,
)
from thermorender.sensor.camera import load_camera
from thermorender.weather.named_day import named_day

DAY = {"air_low_c": 12.0, "air_high_c": 24.0, "humidity": 0.7, "wind_m_s": 2.5, "cloud": 0.1}
BOX = {"shape": "box", "size": [3.0, 3.0, 1.0], "position": [2.0, 1.0, 0.0], "temperature": 330.0}
TERRAIN: dict[str, Any] = {
    "terrain": {"elevation": "elevation.tif", "orthophoto": "orthophoto.tif"},
    "temperature": {"source": "raster", "raster": "temperature.tif"},
    "emissivity": {"source": "classes", "raster": "classes.tif",
                   "classes": {"1": "grass_green", "2": "sand_quartz"}},
    "sky": {"temperature": 260.0},
    "truth": {"temperature": "temperature.tif"},
    "weather": {"time": "2018-07-28T12:00:00Z", **DAY},
    "object": [
        {"name": "marker", "material": "asphalt", **BOX},
        {"name": "car", "material": "asphalt", **BOX, "track": "car.csv"},
        {"name": "bush", "material": "grass_green", **BOX, "position": [0.0, 0.0, 0.0], "size": [0.5, 0.5, 1.0],
         "instances": "places.csv"},
    ],
}  # fmt: skip
MESH: dict[str, Any] = {
    "terrain": {"mesh": "m.obj"},
    "temperature": {"source": "constant", "value": 290.0},
    "emissivity": {"source": "material", "material": "soil_loam", "classes": {"1": "grass_green", "2": "asphalt"}},
    "sky": {"temperature": 255.0},
    "frame": {"latitude_deg": 52.0, "longitude_deg": 20.0, "height_m": 100.0},
    "weather": {"time": "2018-07-28T12:00:00Z", **DAY},
    "surface": [{"name": "tiles", "material": "roof_tile_clay"}, {"name": "north", "classes": "classes.png"}],
}
OBJ = (
    "mtllib m.mtl\nv 0 0 0\nv 20 0 0\nv 20 20 0\nv 0 20 0\nv 5 5 3\nv 9 5 3\nv 9 9 3\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    "usemtl ground\no south\nf 1/1 2/2 3/3\no north\nf 1/1 3/3 4/4\no roof\nusemtl tiles\nf 5 6 7\n"
)
SQUARE = [[-3.0, -3.0], [1.0, -3.0], [1.0, 2.0], [-3.0, 2.0]]


# --- scene files and what they are made of ------------------------------------------------------------------------


@dataclass
class Fresh:
    """A scene file, and edits for which it has no key."""

    base: dict[str, Any]
    file: dict[str, Any] = field(init=False)
    materials: dict[Any, Any] = field(default_factory=dict)
    areas: list[Any] = field(default_factory=list)
    held: dict[str, Any] = field(default_factory=dict)  # Columns of a track
    camera: Any = None
    air: Any = None
    weather: Any = None
    kelvin: Any = None
    sky: float | None = field(init=False)  # The last declared one

    def __post_init__(self) -> None:
        self.file = copy.deepcopy(self.base)
        self.sky = self.file["sky"]["temperature"]

    def named(self, kind: str, name: str) -> dict[str, Any]:
        """The table of an object or surface, added where there is none."""
        rows = self.file.setdefault(kind, [])
        found = [row for row in rows if row["name"] == name]
        rows += [] if found else [{"name": name}]
        return found[0] if found else rows[-1]

    def scene(self, folder: Path) -> tr.Scene:
        """Write the file, read it and edit the rest."""
        file = dict(self.file)
        if self.weather is not None or file["weather"] != self.base["weather"]:
            # A truth raster is of its own weather.
            file.pop("truth", None)
        (folder / "scene.toml").write_text(toml(file), encoding="utf-8")
        made = tr.load_scene(folder)
        if self.weather is not None:
            made = made.with_weather(self.weather)
        if self.kelvin is not None:
            made = made.with_temperature(TemperatureSpec("raster"), kelvin=self.kelvin)
        if self.air is not None:
            made = made.with_air(self.air)
        if self.camera is not None:
            made = made.with_camera(self.camera)
        if self.held:
            made = made.with_objects(self.held)
        if self.materials:
            made = made.with_material(self.materials)
        for area, material in self.areas:
            made = made.with_material_in(area, material)
        return made


def toml(table: dict[str, Any], within: str = "") -> str:
    """A TOML file of nested tables."""
    plain = {key: value for key, value in table.items() if not isinstance(value, dict) and not _tables(value)}
    text = "".join(f"{key} = {json.dumps(value)}\n" for key, value in plain.items())
    for key, value in table.items():
        if isinstance(value, dict):
            text += f"[{within}{key}]\n" + toml(value, f"{within}{key}.")
        elif _tables(value):
            text += "".join(f"[[{within}{key}]]\n" + toml(row, f"{within}{key}.") for row in value)
    return text


def _tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def write_files(folder: Path) -> Path:
    """Write the files that the scene files name."""
    slope = np.add.outer(np.linspace(0.0, 2.0, 16), np.linspace(0.0, 0.5, 16))
    write_terrain(folder, slope)
    (folder / "car.csv").write_text("time_s,east_m,temperature_k\n0,0,310\n10,3,330\n")
    (folder / "places.csv").write_text("east_m,north_m,scale\n-4,3,1\n-5,-2,1.5\n")
    rows = [f"2018-07-{day:02d}T{hour:02d}:00:00Z,{15 + hour / 4},{60 + day / 2}"
            for day in (27, 28, 29) for hour in range(24)]  # fmt: skip
    (folder / "station.csv").write_text("\n".join(["time_utc,air_c,rh_percent", *rows]) + "\n")
    model = (Path(tr.__file__).parent / "sensor/cameras/zenmuse-xt2.toml").read_text(encoding="utf-8")
    assert "band_um = [7.5, 13.5]" in model
    (folder / "narrow.toml").write_text(model.replace("band_um = [7.5, 13.5]", "band_um = [8.0, 12.0]"))
    write_raster(folder / "warm.tif", np.full((1, 32, 32), 311.0, np.float32), 0.5, nodata=np.nan)
    Image.fromarray(np.full((16, 8, 3), (60, 110, 40), np.uint8)).save(folder / "t.png")
    Image.fromarray(np.repeat(np.uint8([[1], [2]]), 8, axis=0) * np.ones((1, 8), np.uint8)).save(folder / "classes.png")
    write_raster(folder / "parts.tif", np.linspace(280, 300, 128, dtype=np.float32).reshape(1, 16, 8), nodata=np.nan)
    (folder / "m.mtl").write_text("newmtl ground\nmap_Kd t.png\nnewmtl tiles\nKd 0.6 0.2 0.1\n")
    (folder / "m.obj").write_text(OBJ)
    return folder


# --- edits --------------------------------------------------------------------------------------------------------


class Edit(NamedTuple):
    """Values, the edit of a scene with one, and the same in a Fresh."""

    values: list[Any]
    edit: Any
    record: Any


def _aired(fresh: Fresh, keys: dict[str, Any]) -> None:
    fresh.file.pop("sky", None)
    fresh.file["atmosphere"], fresh.air = dict(keys), None


def _with_sky(fresh: Fresh, kelvin: float) -> None:
    fresh.file.pop("atmosphere", None)
    fresh.file["sky"], fresh.air, fresh.sky = {"temperature": kelvin}, None, kelvin


def _surrounded(fresh: Fresh, values: tuple[float, float]) -> None:
    _with_sky(fresh, values[0])
    fresh.file["surroundings"] = {"temperature": values[1]}


def _no_air(fresh: Fresh, _: Any) -> None:
    assert fresh.sky is not None
    _with_sky(fresh, fresh.sky)


def _given_air(fresh: Fresh, air: Atmosphere) -> None:
    # A file has a sky or an air, which the edit replaces.
    _with_sky(fresh, fresh.sky or 250.0)
    fresh.air = air


def _shone(fresh: Fresh, sun: tuple[float, float] | None) -> None:
    fresh.file.pop("sun", None)
    if sun is not None:
        fresh.file["sun"] = {"elevation_deg": sun[0], "azimuth_deg": sun[1]}


KINDS = {"file": {"longest_gap_h", "air_height_m", "wind_height_m"}, "air_high_c": {*DAY} - {"air_high_c"}}


def _weathered(fresh: Fresh, keys: dict[str, Any]) -> None:
    now = fresh.file["weather"]
    for kind, others in KINDS.items():
        if kind not in keys and any(other in keys for other in KINDS):
            for name in {kind, *others} - {*keys}:
                now.pop(name, None)
    now.update(keys)
    if not {*keys} <= {"time", "inside_c", "albedo", "albedo_std"}:
        fresh.weather = None


def _weather_given(fresh: Fresh, weather: Any) -> None:
    fresh.weather = weather


def _temperature(scene: tr.Scene, keys: dict[str, Any]) -> tr.Scene:
    own = dict(keys)
    if "raster" in own:
        own["raster"] = scene.spec.folder / own["raster"]
    if "range_c" in own:
        own["range_c"] = tuple(own["range_c"])
    if "trained" in own:
        own["trained"] = WeatherSpec(**own["trained"] | {"time": np.datetime64("2018-07-28T09:00:00")})
    return scene.with_temperature(TemperatureSpec(**own))


def _recorded_temperature(fresh: Fresh, keys: dict[str, Any]) -> None:
    fresh.file["temperature"], fresh.kelvin = dict(keys), None
    for row in fresh.file.get("surface", []):
        row.pop("temperature", None)
    if "surface" in fresh.file:
        fresh.file["surface"] = [row for row in fresh.file["surface"] if len(row) > 1]


def _kelvin_given(fresh: Fresh, kelvin: Any) -> None:
    _recorded_temperature(fresh, {"source": "raster", "raster": "temperature.tif"})
    fresh.kelvin = kelvin


def _object(name: str) -> Any:
    def record(fresh: Fresh, values: dict[str, Any]) -> None:
        row = fresh.named("object", name)
        place = dict(zip(("east_m", "north_m", "above_ground_m"), row["position"], strict=True))
        row["position"] = [*(place | {key: value for key, value in values.items() if key in place}).values()]
        row["temperature"] = values.get("temperature_k", row["temperature"])
        if row["temperature"] != "balance":
            row.pop("inner_heat_w", None)
        if "inner_heat_w" in values:
            row["inner_heat_w"] = values["inner_heat_w"]
        if "yaw_deg" in values:
            row["yaw_deg"] = values["yaw_deg"]
        if "track" in row:
            fresh.held[name] = fresh.held.get(name, {}) | values

    return record


def _material(fresh: Fresh, values: dict[Any, Any]) -> None:
    fresh.materials |= values


def _part(fresh: Fresh, values: dict[str, Any]) -> None:
    for name, value in values.items():
        fresh.named("surface", name)["temperature"] = value


def _of_parts(scene: tr.Scene, values: dict[str, Any]) -> tr.Scene:
    own = {name: scene.spec.folder / value if isinstance(value, str) else value for name, value in values.items()}
    return scene.with_temperature(own)


def _learned(fresh: Fresh, keys: dict[str, Any]) -> None:
    fresh.file["emissivity"] = {"source": "learned", "model": "procedural", **keys}


def _camera_file(scene: tr.Scene, name: str) -> tr.Scene:
    return scene.with_camera(scene.spec.folder / name if name.endswith(".toml") else name)


def _camera(fresh: Fresh, name: str) -> None:
    fresh.file["camera"], fresh.camera = {"model": name}, None


GIVEN_CAMERA = dataclasses.replace(load_camera("ideal"), name="given", band_um=(8.0, 14.0))
GIVEN_AIR = Atmosphere.standard("subarctic-summer")
GIVEN_WEATHER = [
    named_day(np.datetime64("2018-07-28T12:00"), (52.0, 20.0, 100.0), 10.0, 20.0, wind_m_s=speed)
    for speed in (1.0, 6.0)
]  # fmt: skip
GIVEN_KELVIN = [[kelvin + np.arange(1024.0).reshape(32, 32) % 7] for kelvin in (280.0, 300.0)]
TRAINED = {"time": "2018-07-28T09:00:00Z", **DAY}
LEARNED = {"source": "learned", "model": "fok-1to1"}
WEATHER_KEYS: dict[str, list[Any]] = {
    "time": ["2018-07-28T12:00:00Z", "2018-07-28T05:00:00Z", "2018-07-28T23:00:00Z"],
    "air_low_c": [3.0, 15.0], "air_high_c": [24.0, 31.0], "humidity": [0.4, 0.7], "wind_m_s": [2.5, 7.0],
    "cloud": [0.1, 0.9], "snow_depth_m": [0.0, 0.3], "inside_c": [18.0, 5.0], "albedo": [0.2, 0.3],
    "albedo_std": [0.05], "longest_gap_h": [3.0], "air_height_m": [2.0, 10.0], "wind_height_m": [2.0, 10.0],
    "file": ["station.csv"], "epw": [], "light_shift_min": [],
}  # fmt: skip
EDITS: dict[str, Edit] = {
    "camera.model": Edit(["zenmuse-xt2", "ideal", "narrow.toml"], _camera_file, _camera),
    "a Camera": Edit([GIVEN_CAMERA], tr.Scene.with_camera, lambda fresh, value: setattr(fresh, "camera", value)),
    "sky.temperature": Edit([230.0, 260.0], tr.Scene.with_sky, _with_sky),
    "surroundings.temperature": Edit([(250.0, 280.0), (260.0, 0.0)], lambda s, v: s.with_sky(*v), _surrounded),
    "no air": Edit([None], tr.Scene.with_air, _no_air),
    "atmosphere": Edit(
        [{"standard": "tropical"}, {"standard": "weather"}, {"standard": "tropical", "altitude_m": 900.0},
         {"standard": "midlatitude-summer", "temperature_offset_k": 5.0, "humidity_factor": 0.5,
          "aerosol": "rural-23km"},
         {"standard": "tropical", "cloud_fraction": 0.4, "cloud_base_m": 1500.0}],
        lambda s, v: s.with_air(AtmosphereSpec(**v)), _aired,
    ),
    "an Atmosphere": Edit([GIVEN_AIR], tr.Scene.with_air, _given_air),
    "sun": Edit([(40.0, 150.0), (10.0, 270.0), None], lambda s, v: s.with_sun(*(v or (None,))), _shone),
    **{
        f"weather.{name}": Edit(
            [{name: value} for value in values], lambda s, v: s.with_weather(**v), _weathered
        )
        for name, values in WEATHER_KEYS.items() if values
    },
    "a Weather": Edit(GIVEN_WEATHER, tr.Scene.with_weather, _weather_given),
    "a named day": Edit([DAY, DAY | {"cloud": 0.8}], lambda s, v: s.with_weather(**v), _weathered),
    "at": Edit([{"time": value} for value in WEATHER_KEYS["time"]], lambda s, v: s.at(v["time"]), _weathered),
    "temperature": Edit(
        [{"source": "constant", "value": 305.0}, {"source": "raster", "raster": "temperature.tif"},
         {"source": "raster", "raster": "warm.tif", "trained": TRAINED, "map_error_k": 1.5},
         {"source": "material", "materials": {"grass_green": 299.0}}, LEARNED, LEARNED | {"range_c": [5.0, 45.0]},
         LEARNED | {"trained": TRAINED}, {"source": "balance"}, {"source": "balance", "brightness": True}],
        _temperature, _recorded_temperature,
    ),
    "kelvin": Edit(
        GIVEN_KELVIN, lambda s, v: s.with_temperature(TemperatureSpec("raster"), kelvin=v), _kelvin_given
    ),
    "emissivity": Edit(
        [{"fallback": "sand_quartz"}, {"fallback": "soil_loam", "without": ["snow"], "heights": False},
         {"fallback": "sand_quartz", "confidence": 0.2, "most_std": 0.01, "present": ["asphalt"]}],
        lambda s, v: s.with_learned_materials(EmissivitySpec("learned", model="procedural", **{
            key: tuple(value) if isinstance(value, list) else value for key, value in v.items()})), _learned,
    ),
    "object.marker": Edit(
        [{"temperature_k": 310.0}, {"east_m": -2.0, "north_m": 3.0}, {"above_ground_m": 0.5, "yaw_deg": 30.0},
         {"temperature_k": "balance"}, {"temperature_k": "balance", "inner_heat_w": 50.0}, {"inner_heat_w": 20.0}],
        lambda s, v: s.with_objects({"marker": v}), _object("marker"),
    ),
    "object.car": Edit(
        [{"temperature_k": 300.0}, {"east_m": 1.0}, {"yaw_deg": 45.0}],
        lambda s, v: s.with_objects({"car": v}), _object("car"),
    ),
    "object.bush": Edit(
        [{"temperature_k": 295.0}, {"north_m": 1.0}, {"yaw_deg": 90.0}, {"temperature_k": "balance"}],
        lambda s, v: s.with_objects({"bush": v}), _object("bush"),
    ),
    "a material": Edit(
        [{"grass_green": "soil_loam"}, {"sand_quartz": "snow"}, {2: "asphalt"}, {"marker": "sand_quartz"},
         {"car": "grass_green"}],
        tr.Scene.with_material, _material,
    ),
    "an area": Edit(
        [(SQUARE, "asphalt"), (SQUARE[:3], 0.8)], lambda s, v: s.with_material_in(*v),
        lambda fresh, v: fresh.areas.append(v),
    ),
}  # fmt: skip
OF_MESH = {
    "surface.temperature": Edit(
        [{"tiles": 310.0}, {"north": "parts.tif"}, {"south": 284.0}, {"tiles": 280.0, "south": "parts.tif"}],
        _of_parts, _part,
    ),
    "a material of a part": Edit([{"roof": "snow"}, {"t.png": "asphalt"}, {1: "sand_quartz"}],
                                 tr.Scene.with_material, _material),
    **{name: each for name, each in EDITS.items()
       if not name.startswith(("object", "emissivity", "a material", "an area", "temperature", "kelvin"))},
    "temperature": EDITS["temperature"]._replace(values=[{"source": "constant", "value": 305.0}, {"source": "balance"},
                                                         {"source": "material", "materials": {"soil_loam": 299.0}}]),
}  # fmt: skip


def test_each_key_of_a_scene_file_has_an_edit_or_none_by_choice():
    named = {name.partition(".")[0] for name in (*EDITS, *OF_MESH)}
    # No edit changes the shape of the terrain, its place or its title.
    keys = {row.metadata.get("name") or row.name for row in dataclasses.fields(SceneSpec)}
    assert keys - named - {"folder", "title", "terrain", "frame", "truth"} == set()
    assert {row.name for row in dataclasses.fields(WeatherSpec)} == {*WEATHER_KEYS}


# --- the property -------------------------------------------------------------------------------------------------


def steps(edits: dict[str, Edit], most: int = 5) -> Any:
    """Strategy of some edits: (name, number of the value, whether to look at the scene before)."""
    one = st.sampled_from(sorted(edits)).flatmap(
        lambda name: st.tuples(st.just(name), st.integers(0, len(edits[name].values) - 1), st.booleans())
    )
    return st.lists(one, min_size=1, max_size=most)


def edited(scene: tr.Scene, fresh: Fresh, edits: dict[str, Edit], chosen: Any) -> tr.Scene:
    """Apply edits to a scene and record them; those that are refused change nothing."""
    for name, number, looked_at in chosen:
        each = edits[name]
        if looked_at:
            # Values that are made when asked for.
            refusal(scene.digest), refusal(scene.weather_digest), refusal(scene.refuse_disagreement), scene.ground(0, 0)
        try:
            scene = each.edit(scene, each.values[number])
        except ThermorenderError:
            continue
        each.record(fresh, each.values[number])
    if "sun" in fresh.file and "atmosphere" not in fresh.file:
        # A file refuses a sun without air, and the renderer does.
        scene = scene.with_sun(None)
        fresh.file.pop("sun")
    return scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("equal") / "tiny")


@pytest.fixture(scope="module")
def loaded(folder):
    """The scenes before any edit."""
    return {name: Fresh(base).scene(folder) for name, base in (("terrain", TERRAIN), ("mesh", MESH))}


# A learned map takes a second.
QUICK = {name: each for name, each in EDITS.items() if name != "emissivity"}


@given(chosen=steps(QUICK))
def test_a_terrain_edited_in_any_order_equals_a_fresh_one(folder, loaded, chosen):
    fresh = Fresh(TERRAIN)
    scene = edited(loaded["terrain"], fresh, QUICK, chosen)
    assert different(scene, fresh.scene(folder)) == []


@given(chosen=steps(OF_MESH))
def test_a_mesh_edited_in_any_order_equals_a_fresh_one(folder, loaded, chosen):
    fresh = Fresh(MESH)
    scene = edited(loaded["mesh"], fresh, OF_MESH, chosen)
    assert different(scene, fresh.scene(folder)) == []


# Pairs of edits in which the later one acts through an input that is easily forgotten.
CHAINS = {
    "the altitude of the air, of the weather": [("temperature", 7), ("atmosphere", 2)],
    "the instant, of the weather's air": [("atmosphere", 1), ("at", 1)],
    "the band, of an Atmosphere": [("an Atmosphere", 0), ("camera.model", 2)],
    "the albedo, of an object's material": [("weather.albedo", 0), ("a material", 3)],
    "a material, of temperatures by material": [("temperature", 3), ("a material", 0)],
    "the place, of copies": [("object.bush", 1), ("object.bush", 0), ("a material", 3)],
    "a column of a track": [("object.car", 1), ("a material", 4), ("object.car", 0)],
    "the weather in memory, of its instant": [("a Weather", 1), ("at", 1), ("temperature", 7)],
    "the sun, of its air": [("atmosphere", 0), ("sun", 0), ("weather.cloud", 1)],
    "a heat balance, of an object and its inner heat": [
        ("temperature", 7),
        ("object.marker", 3),
        ("a material", 3),
        ("object.bush", 3),
        ("object.marker", 5),
        ("at", 1),
    ],
    "kelvin, of an object with inner heat": [
        ("temperature", 7),
        ("object.marker", 4),
        ("object.marker", 0),
        ("object.marker", 3),
    ],
    "kelvin in memory, of a material": [("kelvin", 0), ("a material", 0), ("camera.model", 2)],
}


@pytest.mark.parametrize("name", [*list(CHAINS)[::2], *slow(*list(CHAINS)[1::2])])
def test_an_edit_reaches_all_that_depends_on_it(folder, loaded, name):
    fresh = Fresh(TERRAIN)
    scene = edited(loaded["terrain"], fresh, QUICK, [(*step, True) for step in CHAINS[name]])
    assert different(scene, fresh.scene(folder)) == []


@pytest.mark.slow
@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("name", ["weather.air_low_c", "at", "camera.model", "a material", "object.marker"])
def test_learned_materials_edited_before_or_after_equal_fresh_ones(folder, loaded, name, number):
    other = (name, len(EDITS[name].values) - 1, True)
    for chosen in ([("emissivity", number, True), other], [other, ("emissivity", number, True)]):
        fresh = Fresh(TERRAIN)
        scene = edited(loaded["terrain"], fresh, EDITS, chosen)
        assert different(scene, fresh.scene(folder)) == []


# The altitude of an air is also that of the weather, and left out.
AIRY = {name: QUICK[name] for name in ("camera.model", "sky.temperature", "an Atmosphere")}
AIRY["atmosphere"] = QUICK["atmosphere"]._replace(values=[{"standard": "tropical"}, {"standard": "weather"}])


@given(chosen=steps(AIRY, 3))
def test_surfaces_made_in_memory_before_or_after_an_edit_make_the_same_scene(loaded, chosen):
    before = edited(loaded["terrain"].with_surfaces(), Fresh(TERRAIN), AIRY, chosen)
    after = edited(loaded["terrain"], Fresh(TERRAIN), AIRY, chosen).with_surfaces()
    assert different(before, after) == []


@pytest.fixture(scope="module")
def balanced(loaded):
    return loaded["terrain"].with_temperature("balance").with_objects({"marker": "balance"})


def solved(scene: tr.Scene, time: Any = None) -> tr.Scene:
    """A scene with made-up temperatures in place of those of a heat balance."""
    kelvin = [np.full(each.material.shape, 290.0 + k) for k, each in enumerate(scene.surfaces[: scene.solved_count])]
    return scene.with_solved_temperatures(scene.time if time is None else time, kelvin, notes=("solved",))


@given(chosen=steps(AIRY, 3))
def test_solved_temperatures_stay_after_edits_they_do_not_depend_on(balanced, chosen):
    after = edited(solved(balanced), Fresh(TERRAIN), AIRY, chosen)
    before = solved(edited(balanced, Fresh(TERRAIN), AIRY, chosen))
    assert after.temperature_state.solved and different(after, before) == []


NEEDED = [("weather.cloud", 1), ("at", 1), ("a material", 0), ("object.marker", 0), ("weather.inside_c", 1),
          ("an area", 0), ("temperature", 8), ("weather.albedo", 0), ("object.bush", 1), ("atmosphere", 2),
          ("object.marker", 1), ("a named day", 1), ("object.marker", 5), ("object.bush", 3)]  # fmt: skip


# Every third one is enough each time: the weather, an object, the temperature, the air, and an object's balance.
@pytest.mark.parametrize(
    ("name", "number"), [*NEEDED[::3], *slow(*(each for each in NEEDED if each not in NEEDED[::3]))]
)
def test_solved_temperatures_are_pending_after_an_edit_they_depend_on(balanced, name, number):
    each = QUICK[name]
    after, before = each.edit(solved(balanced), each.values[number]), each.edit(balanced, each.values[number])
    assert not after.temperature_state.solved and different(after, before) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["the altitude of the air, of the weather", "the albedo, of an object's material",
                                  "a column of a track"])  # fmt: skip
def test_a_frame_of_an_edited_scene_has_the_bytes_of_a_fresh_one(folder, loaded, name):
    camera = dataclasses.replace(load_camera("zenmuse-xt2"), width=16, height=12, pixel_pitch_um=400.0, f_number=12.0)
    fresh = Fresh(TERRAIN)
    scene = edited(loaded["terrain"], fresh, QUICK, [(*step, True) for step in CHAINS[name]])
    frames = [
        tr.Renderer(each.with_camera(camera), rays=2, samples=1).frame(tr.pose(0, 0, 12, pitch_deg=-90)).radiance
        for each in (scene, fresh.scene(folder))
    ]
    assert frames[0].tobytes() == frames[1].tobytes()


def test_scenes_differ_by_what_was_edited(loaded):
    scene = loaded["terrain"]
    seen = scene.with_camera("ideal")
    assert scene.changes(seen) == {"camera"} and scene.changes(scene) == frozenset()
    assert scene.changes(seen.with_camera(scene.camera)) == frozenset()
    assert scene.changes(scene.with_sky(250.0)) == {"spec_sky_temperature"}
    assert scene.changes(scene.with_temperature(300.0)) == {"surfaces", "temperature_state", "spec_temperature"}
    assert "terrain_count" in scene.changes(scene.with_surfaces(terrain_count=2))
