"""What a scene file says: `scene.toml` read into frozen dataclasses, every key checked.

Each table is described once, as key → (reader, default). A reader turns the TOML value into ours or raises a
sentence; a key that is not described is an error naming the key and its table. Files are named relative to the
scene's folder and must lie inside it, and so must what they name in turn.
"""

import difflib
import os
import sys
from dataclasses import dataclass, field, fields
from pathlib import Path

from thermorender.errors import ThermorenderError, shortened
from thermorender.paths import inside
from thermorender.scene.raster import FORMATS, files_of
from thermorender.scene.surface import scene_kelvin

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

REQUIRED = object()
# A learned emissivity map's texel is unknown where its most probable material is less probable than this.
DEFAULT_CONFIDENCE = 0.35
_CLASS_NUMBERS = {str(number) for number in range(1, 256)}


@dataclass(frozen=True)
class TerrainSpec:
    """Ground of the scene: an elevation raster with an orthophoto, or one textured mesh."""

    elevation: Path | None
    mesh: Path | None
    orthophoto: Path | None
    height_reference: str
    geoid_undulation_m: float | None


@dataclass(frozen=True)
class TemperatureSpec:
    """Where the kinetic temperature of each texel comes from."""

    source: str
    value: float | None = None
    raster: Path | None = None
    model: str | None = None
    range_c: tuple[float, float] | None = None
    materials: dict = field(default_factory=dict)


@dataclass(frozen=True)
class EmissivitySpec:
    """Where the material of each texel comes from."""

    source: str
    value: float | None
    material: str | None
    raster: Path | None
    classes: dict
    model: str | None = None
    fallback: str | None = None
    confidence: float = DEFAULT_CONFIDENCE
    without: tuple[str, ...] = ()


@dataclass(frozen=True)
class ObjectSpec:
    """A solid standing in the scene: a primitive or a mesh file, with one material and temperature."""

    name: str
    shape: str | None
    file: Path | None
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    yaw_deg: float
    temperature: float
    material: str
    colour: tuple[float, float, float]
    track: Path | None


@dataclass(frozen=True)
class AtmosphereSpec:
    """The air: a standard atmosphere, a table or a measured profile, its clouds, and where the scene lies in it."""

    standard: str | None = None
    file: Path | None = None
    profile: Path | None = None
    aerosol: str = "none"
    visibility_km: float = 23.0
    temperature_offset_k: float = 0.0
    humidity_factor: float = 1.0
    cloud_fraction: float = 0.0
    cloud_base_m: float = 2000.0
    altitude_m: float | None = None


@dataclass(frozen=True)
class SunSpec:
    """Where the sun stands."""

    elevation_deg: float
    azimuth_deg: float


@dataclass(frozen=True)
class SceneSpec:
    """A whole scene file; `sky_temperature` is None where there is an atmosphere, whose sky it is then."""

    folder: Path
    title: str
    terrain: TerrainSpec
    temperature: TemperatureSpec
    emissivity: EmissivitySpec
    sky_temperature: float | None
    surroundings_temperature: float | None
    camera: str
    truth_temperature: Path | None
    frame: tuple[float, float, float] | None
    objects: tuple[ObjectSpec, ...]
    atmosphere: AtmosphereSpec | None = None
    sun: SunSpec | None = None


def read_scene(folder):
    """Return the SceneSpec of a scene folder.

    Parameters
    ----------
    folder : path
        Folder holding `scene.toml` (or the path of that file itself).

    Raises
    ------
    ThermorenderError
        A missing file, invalid TOML, an unknown or missing key, a value out of range; the message names
        file, table, key, what arrived and what is allowed.
    """
    path = Path(folder)
    if path.name != "scene.toml":
        path = path / "scene.toml"
    reader = _Reader(path)
    for name in (path.name, "flight.csv", "materials"):
        if not inside(reader.folder / name, reader.folder):
            raise ThermorenderError(
                f"{reader.folder / name} is a link to {os.path.realpath(reader.folder / name)}; what a scene uses lies "
                "inside the scene's folder, so put it there"
            )
    try:
        with open(path, "rb") as file:
            raw = tomllib.load(file)
    except FileNotFoundError:
        raise ThermorenderError(f"{path} does not exist; a scene is a folder with a scene.toml") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ThermorenderError(f"{path} is not valid TOML: {error}") from None
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read: {error.strerror}") from None
    return reader.scene(raw)


class _Reader:
    """Reads one file; methods named after value kinds take (value, "table.key") and return ours."""

    def __init__(self, path):
        self.path = path
        self.folder = path.parent.resolve()

    def fail(self, where, value, allowed):
        raise ThermorenderError(f"{self.path}: {where}={shortened(repr(value))} is not allowed; give {allowed}")

    def text(self, value, where):
        if not isinstance(value, str) or not value.strip():
            self.fail(where, value, "a text")
        return value

    def number(self, value, where):
        # The bound also refuses NaN, infinity and whole numbers that fit no float.
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
            self.fail(where, value, "a finite number")
        return float(value)

    def share(self, value, where):
        if not 0.0 < self.number(value, where) <= 1.0:
            self.fail(where, value, "a number above 0 and up to 1")
        return float(value)

    def temperature(self, value, where):
        return scene_kelvin(f"{self.path}: {where}", self.number(value, where))

    def cold(self, value, where):
        return scene_kelvin(f"{self.path}: {where}", self.number(value, where), allow_zero=True)

    def file(self, value, where):
        try:
            path = Path(os.path.realpath(self.folder / self.text(value, where)))
            there = path.is_file()
        except (OSError, ValueError) as error:  # too long, or with a NUL in it
            if isinstance(error, ThermorenderError):
                raise
            self.fail(where, value, "the name of a file")
        if not inside(path, self.folder):
            self.fail(where, value, "a path inside the scene's folder")
        if not there:
            raise ThermorenderError(f"{self.path}: {where}={value!r} does not exist; give a file in {self.folder}")
        return path

    def raster(self, value, where):
        path = self.file(value, where)
        if path.suffix.lower() not in FORMATS:
            self.fail(where, value, f"a raster that holds all its pixels itself: {', '.join(FORMATS)}")
        for part in files_of(path):
            if not inside(part, self.folder):
                self.fail(where, value, f"a raster whose files all lie inside the scene's folder, as {part} does not")
        return path

    def camera_model(self, value, where):
        return str(self.file(value, where)) if self.text(value, where).endswith(".toml") else value

    def learned_map(self, value, where):
        from thermorender.learned.correlation import load_model

        try:
            return load_model(self.text(value, where)).name
        except ThermorenderError as error:
            raise ThermorenderError(f"{self.path}: {where}: {error}") from None

    def texts(self, value, where):
        if not isinstance(value, list):
            self.fail(where, value, "a list of texts")
        return tuple(self.text(item, where) for item in value)

    def emissivity_map(self, value, where):
        from thermorender.learned.emissivity import SHIPPED

        return value if self.text(value, where) in SHIPPED else str(self.file(value, where))

    def vector(self, length):
        def read(value, where):
            if not isinstance(value, list) or len(value) != length:
                self.fail(where, value, f"a list of {length} numbers")
            return tuple(self.number(item, where) for item in value)

        return read

    def choice(self, *allowed):
        def read(value, where):
            if value not in allowed:
                self.fail(where, value, f"one of {', '.join(allowed)}")
            return value

        return read

    def mapping(self, read_value):
        def read(value, where):
            if not isinstance(value, dict) or not value:
                self.fail(where, value, "a table with at least one entry")
            return {key: read_value(item, f"{where}.{key}") for key, item in value.items()}

        return read

    def table(self, raw, name, keys):
        """Read one table: {key: (reader, default)} → {key: value}; REQUIRED marks a key without default."""
        if not isinstance(raw, dict):
            self.fail(name, raw, "a table")
        for key in raw:
            if key not in keys:
                close = difflib.get_close_matches(key, keys, n=1)
                hint = f"did you mean {close[0]!r}? " if close else ""
                raise ThermorenderError(
                    f"{self.path}: unknown key {key!r} in {name}; {hint}allowed are {', '.join(keys)}"
                )
        values = {}
        for key, (read, default) in keys.items():
            if key in raw:
                values[key] = read(raw[key], f"{name}.{key}")
            elif default is REQUIRED:
                raise ThermorenderError(f"{self.path}: key {key!r} is missing in {name}; add it")
            else:
                values[key] = default
        return values

    def needs(self, values, table, key, reason):
        if values[key] in (None, {}):
            raise ThermorenderError(f"{self.path}: {table}.{key} is missing; {reason} needs it")

    def scene(self, raw):
        sections = {
            key: (lambda value, where: value, default)
            for key, default in {
                "title": "",
                "terrain": REQUIRED,
                "temperature": REQUIRED,
                "emissivity": REQUIRED,
                "sky": None,
                "atmosphere": None,
                "sun": None,
                "surroundings": {},
                "camera": {},
                "truth": {},
                "frame": None,
                "object": [],
            }.items()
        }
        top = self.table(raw, "the scene", sections)
        if not isinstance(top["object"], list):
            self.fail("object", top["object"], "tables headed [[object]]")
        frame = top["frame"]
        if frame is not None:
            axes = ("latitude_deg", "longitude_deg", "height_m")
            frame = tuple(self.table(frame, "frame", {axis: (self.number, REQUIRED) for axis in axes}).values())
            if not (abs(frame[0]) <= 90.0 and abs(frame[1]) <= 360.0):
                self.fail("frame", list(frame), "latitude −90…90, longitude −180…180 or 0…360 and a height in metres")
        if (top["sky"] is None) == (top["atmosphere"] is None):
            raise ThermorenderError(
                f"{self.path}: the scene needs either [sky], of one temperature and without air, or [atmosphere], "
                "whose sky it then has; give exactly one"
            )
        if top["sun"] is not None and top["atmosphere"] is None:
            raise ThermorenderError(f"{self.path}: [sun] shines through the air; add [atmosphere] or leave [sun] out")
        sky = {"temperature": None}
        if top["sky"] is not None:
            sky = self.table(top["sky"], "sky", {"temperature": (self.cold, REQUIRED)})
        surroundings = self.table(top["surroundings"], "surroundings", {"temperature": (self.cold, None)})
        camera = self.table(top["camera"], "camera", {"model": (self.camera_model, "zenmuse-xt2")})
        truth = self.table(top["truth"], "truth", {"temperature": (self.raster, None)})
        objects = tuple(self.object(item, index) for index, item in enumerate(top["object"], 1))
        names = [item.name for item in objects]
        for name in names:
            if names.count(name) > 1:
                self.fail("object.name", name, "a name of its own to each object")
        return SceneSpec(
            folder=self.folder,
            title=self.text(top["title"] or self.folder.name, "title"),
            terrain=self.terrain(top["terrain"]),
            temperature=self.temperature_source(top["temperature"]),
            emissivity=self.emissivity(top["emissivity"]),
            sky_temperature=sky["temperature"],
            atmosphere=None if top["atmosphere"] is None else self.atmosphere(top["atmosphere"]),
            sun=None if top["sun"] is None else self.sun(top["sun"]),
            surroundings_temperature=surroundings["temperature"],
            camera=camera["model"],
            truth_temperature=truth["temperature"],
            frame=frame,
            objects=objects,
        )

    def terrain(self, raw):
        keys = {
            "elevation": (self.raster, None),
            "mesh": (self.file, None),
            "orthophoto": (self.raster, None),
            "height_reference": (self.choice("ellipsoid", "geoid"), "ellipsoid"),
            "geoid_undulation_m": (self.number, None),
        }
        values = self.table(raw, "terrain", keys)
        if (values["elevation"] is None) == (values["mesh"] is None):
            raise ThermorenderError(f"{self.path}: terrain needs either 'elevation' or 'mesh'; give exactly one")
        if values["mesh"] and values["orthophoto"]:
            raise ThermorenderError(f"{self.path}: terrain.orthophoto needs 'elevation'; a mesh brings its own texture")
        return TerrainSpec(**values)

    def temperature_source(self, raw):
        keys = {
            "source": (self.choice("constant", "raster", "material", "learned"), REQUIRED),
            "value": (self.temperature, None),
            "raster": (self.raster, None),
            "model": (self.learned_map, None),
            "range_c": (self.vector(2), None),
            "materials": (self.mapping(self.temperature), {}),
        }
        values = self.table(raw, "temperature", keys)
        needs = {"constant": "value", "raster": "raster", "learned": "model", "material": "materials"}
        needed = needs[values["source"]]
        self.needs(values, "temperature", needed, f"source={values['source']!r}")
        low_high = values["range_c"]
        if low_high and not low_high[0] < low_high[1]:
            self.fail("temperature.range_c", list(low_high), "[coldest, warmest] in °C, the first below the second")
        return TemperatureSpec(**values)

    def emissivity(self, raw):
        keys = {
            "source": (self.choice("constant", "material", "classes", "learned"), REQUIRED),
            "value": (self.share, None),
            "material": (self.text, None),
            "raster": (self.raster, None),
            "classes": (self.mapping(self.text), {}),
            "model": (self.emissivity_map, None),
            "fallback": (self.text, None),
            "confidence": (self.share, DEFAULT_CONFIDENCE),
            "without": (self.texts, ()),
        }
        values = self.table(raw, "emissivity", keys)
        source = values["source"]
        needs = {"constant": ["value"], "material": ["material"], "classes": ["raster", "classes"],
                 "learned": ["model", "fallback"]}  # fmt: skip
        for key in needs[source]:
            self.needs(values, "emissivity", key, f"source={source!r}")
        classes = {}
        for key, name in values["classes"].items():
            if key not in _CLASS_NUMBERS:
                self.fail("emissivity.classes", key, "class numbers 1…255 (0 marks no data)")
            classes[int(key)] = name
        return EmissivitySpec(**{**values, "classes": classes})

    def atmosphere(self, raw):
        readers = {"standard": self.text, "file": self.file, "profile": self.file, "aerosol": self.text}
        keys = {item.name: (readers.get(item.name, self.number), item.default) for item in fields(AtmosphereSpec)}
        values = self.table(raw, "atmosphere", keys)
        given = [key for key in ("standard", "file", "profile") if values[key] is not None]
        if len(given) != 1:
            self.fail("atmosphere", dict(raw), "exactly one of standard = …, file = … or profile = …")
        # What another kind of air would ignore is refused rather than passed over.
        only = {"aerosol": ("standard", "profile"), "visibility_km": ("profile",),
                "temperature_offset_k": ("standard",), "humidity_factor": ("standard",)}  # fmt: skip
        for key, kinds in only.items():
            if key in raw and given[0] not in kinds:
                self.fail(f"atmosphere.{key}", raw[key], f"it with {' or '.join(kinds)} only, not with {given[0]}")
        return AtmosphereSpec(**values)

    def sun(self, raw):
        keys = {"elevation_deg": (self.number, REQUIRED), "azimuth_deg": (self.number, REQUIRED)}
        values = self.table(raw, "sun", keys)
        if not -90.0 <= values["elevation_deg"] <= 90.0:
            self.fail("sun.elevation_deg", values["elevation_deg"], "degrees above the horizon, −90…90")
        if not abs(values["azimuth_deg"]) <= 360.0:
            self.fail("sun.azimuth_deg", values["azimuth_deg"], "degrees from north, eastward positive, −360…360")
        return SunSpec(**values)

    def object(self, raw, index):
        name = raw.get("name", f"number {index}") if isinstance(raw, dict) else f"number {index}"
        where = f"object {name!r}"
        keys = {
            "name": (self.text, REQUIRED),
            "shape": (self.choice("disc", "box", "sphere"), None),
            "file": (self.file, None),
            "size": (self.vector(3), (1.0, 1.0, 1.0)),
            "position": (self.vector(3), REQUIRED),
            "yaw_deg": (self.number, 0.0),
            "temperature": (self.temperature, REQUIRED),
            "material": (self.text, REQUIRED),
            "colour": (self.vector(3), (128.0, 128.0, 128.0)),
            "track": (self.file, None),
        }
        values = self.table(raw, where, keys)
        if (values["shape"] is None) == (values["file"] is None):
            raise ThermorenderError(f"{self.path}: {where} needs either 'shape' or 'file'; give exactly one")
        if ":" in values["name"]:
            self.fail(f"{where}.name", values["name"], "a name without ':', which separates the parts of an object")
        if min(values["size"]) <= 0.0:
            self.fail(f"{where}.size", list(values["size"]), "three lengths above 0 in metres")
        if not all(0.0 <= channel <= 255.0 for channel in values["colour"]):
            self.fail(f"{where}.colour", list(values["colour"]), "three sRGB values 0…255")
        return ObjectSpec(**values)
