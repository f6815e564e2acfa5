"""What a scene file says: `scene.toml` read into frozen dataclasses, every key checked.

A key is a row of its table's dataclass; see `thermorender.schema`. Files are named relative to the scene's folder and
must lie inside it.
"""

from dataclasses import astuple, dataclass, replace
from functools import partial
from pathlib import Path

from thermorender import defaults
from thermorender.errors import ThermorenderError
from thermorender.scene.surface import scene_kelvin
from thermorender.schema import (
    Where,
    choice,
    entry,
    file_inside,
    key,
    mapping,
    number,
    read,
    read_toml,
    table,
    tables,
    text,
    texts,
)

# A learned emissivity map's texel is unknown where its most probable material is less probable than this.
DEFAULT_CONFIDENCE = 0.35
_CLASS_NUMBERS = {str(count): count for count in range(1, 256)}


# Readers of what only scenes have


def kelvin(value, where, allow_zero=False):
    """Read a temperature of a surface [K], or of a sky, which may be 0 K."""
    return scene_kelvin(str(where), number()(value, where), allow_zero)


cold = partial(kelvin, allow_zero=True)
share = number(0.0, 1.0, above=True)


def camera_model(value, where):
    """Read the name of a shipped camera model, or a file of one."""
    return str(file_inside(value, where)) if text(value, where).endswith(".toml") else value


def temperature_map(value, where):
    """Read the name of a learned map of temperatures."""
    from thermorender.learned.correlation import load_model

    try:
        return load_model(text(value, where)).name
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: {error}") from None


def emissivity_map(value, where):
    """Read the name of a shipped map of materials, or a file of one."""
    from thermorender.learned.emissivity import SHIPPED

    return value if text(value, where) in SHIPPED else str(file_inside(value, where))


def class_number(name, where):
    """Read the key of a class, which TOML gives as a text."""
    return _CLASS_NUMBERS[name] if name in _CLASS_NUMBERS else where.refuse(name, "class numbers 1…255 (0: no data)")


def _needed(where, values, needs):
    """Refuse that what the table's source needs is missing."""
    for name in needs[values.source]:
        if getattr(values, name) in (None, {}):
            raise where.error(f"{where.key}.{name} is missing; source={values.source!r} needs it")


# Tables


@dataclass(frozen=True)
class TerrainSpec:
    """Ground of the scene: an elevation raster with an orthophoto, or one textured mesh."""

    elevation: Path | None = key(file_inside, None)
    mesh: Path | None = key(file_inside, None)
    orthophoto: Path | None = key(file_inside, None)
    height_reference: str = key(choice("ellipsoid", "geoid"), "ellipsoid")
    geoid_undulation_m: float | None = key(number(), None)

    def check(self, where, given):
        """Refuse none or two kinds of ground."""
        where.exactly_one(given, ("elevation", "mesh"))
        if self.mesh and self.orthophoto:
            raise where.error("terrain.orthophoto needs 'elevation'; a mesh brings its own texture")


@dataclass(frozen=True)
class TemperatureSpec:
    """Where the kinetic temperature of each texel comes from; `range_c` is of intensities 0 and 1 of a learned map."""

    source: str = key(choice("constant", "raster", "material", "learned"))
    value: float | None = key(kelvin, None)
    raster: Path | None = key(file_inside, None)
    model: str | None = key(temperature_map, None)
    range_c: tuple[float, float] | None = key(number(count=2, ordered=True), None)
    materials: dict = key(mapping(kelvin), {})

    def check(self, where, given):
        """Refuse a source without what it needs."""
        needs = {"constant": ["value"], "raster": ["raster"], "learned": ["model"], "material": ["materials"]}
        _needed(where, self, needs)


@dataclass(frozen=True)
class EmissivitySpec:
    """Where the material of each texel comes from."""

    source: str = key(choice("constant", "material", "classes", "learned"))
    value: float | None = key(share, None)
    material: str | None = key(text, None)
    raster: Path | None = key(file_inside, None)
    classes: dict = key(mapping(text, class_number), {})
    model: str | None = key(emissivity_map, None)
    fallback: str | None = key(text, None)
    confidence: float = key(share, DEFAULT_CONFIDENCE)
    without: tuple[str, ...] = key(texts, ())

    def check(self, where, given):
        """Refuse a source without what it needs."""
        needs = {"constant": ["value"], "material": ["material"], "classes": ["raster", "classes"],
                 "learned": ["model", "fallback"]}  # fmt: skip
        _needed(where, self, needs)


@dataclass(frozen=True, kw_only=True)
class ObjectSpec:
    """A solid standing in the scene: a primitive or a mesh file, with one material and temperature."""

    name: str = key(text)
    shape: str | None = key(choice("disc", "box", "sphere"), None)
    file: Path | None = key(file_inside, None)
    size: tuple[float, float, float] = key(number(0.0, above=True, count=3, unit="m"), (1.0, 1.0, 1.0))
    position: tuple[float, float, float] = key(number(count=3, unit="m"))
    yaw_deg: float = key(number(), 0.0)
    temperature: float = key(kelvin)
    material: str = key(text)
    colour: tuple[float, float, float] = key(number(0.0, 255.0, count=3, unit="(sRGB)"), (128.0, 128.0, 128.0))
    track: Path | None = key(file_inside, None)

    def check(self, where, given):
        """Refuse none or two kinds of solid, and a name that could be a part's."""
        where.exactly_one(given, ("shape", "file"))
        if ":" in self.name:
            where.of("name").refuse(self.name, "a name without ':', which separates the parts of an object")


@dataclass(frozen=True)
class AtmosphereSpec:
    """The air: a standard atmosphere, a table or a measured profile, its clouds, and where the scene lies in it."""

    standard: str | None = key(text, None)
    file: Path | None = key(file_inside, None)
    profile: Path | None = key(file_inside, None)
    aerosol: str = key(text, "none")
    visibility_km: float = key(number(), 23.0)
    temperature_offset_k: float = key(number(), 0.0)
    humidity_factor: float = key(number(), 1.0)
    cloud_fraction: float = key(number(), 0.0)
    cloud_base_m: float = key(number(), 2000.0)
    altitude_m: float | None = key(number(), None)

    def check(self, where, given):
        """Refuse none or two kinds of air, and what another kind would pass over."""
        kind = where.exactly_one(given, ("standard", "file", "profile"))
        only = {"aerosol": ("standard", "profile"), "visibility_km": ("profile",),
                "temperature_offset_k": ("standard",), "humidity_factor": ("standard",)}  # fmt: skip
        for name, kinds in only.items():
            if name in given and kind not in kinds:
                where.of(name).refuse(given[name], f"it with {' or '.join(kinds)} only, not with {kind}")


@dataclass(frozen=True)
class SunSpec:
    """Where the sun stands: above the horizon, and from north, eastward positive."""

    elevation_deg: float = key(number(-90.0, 90.0))
    azimuth_deg: float = key(number(-360.0, 360.0))


@dataclass(frozen=True)
class _Frame:
    latitude_deg: float = key(number(-90.0, 90.0))
    longitude_deg: float = key(number(-360.0, 360.0))
    height_m: float = key(number())


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """A whole scene file; `sky_temperature` is None where there is an atmosphere, whose sky it is then."""

    folder: Path
    # A blank title is none.
    title: str = key(lambda value, where: value if value == "" else text(value, where), "")
    terrain: TerrainSpec = key(table(TerrainSpec))
    temperature: TemperatureSpec = key(table(TemperatureSpec))
    emissivity: EmissivitySpec = key(table(EmissivitySpec))
    sky_temperature: float | None = key(entry("temperature", cold), None, name="sky")
    atmosphere: AtmosphereSpec | None = key(table(AtmosphereSpec), None)
    sun: SunSpec | None = key(table(SunSpec), None)
    surroundings_temperature: float | None = key(entry("temperature", cold, None), None, name="surroundings")
    camera: str = key(entry("model", camera_model, defaults.CAMERA), defaults.CAMERA)
    truth_temperature: Path | None = key(entry("temperature", file_inside, None), None, name="truth")
    frame: tuple[float, float, float] | None = key(lambda value, where: astuple(read(_Frame, value, where)), None)
    objects: tuple[ObjectSpec, ...] = key(tables(ObjectSpec), (), name="object")

    def check(self, where, given):
        """Refuse none or two skies, a sun without air, and two objects of one name."""
        where.exactly_one(given, ("sky", "atmosphere"), "a sky of one temperature and no air, or air with its sky")
        if self.sun and not self.atmosphere:
            raise where.error("[sun] shines through the air; add [atmosphere] or leave [sun] out")
        names = [item.name for item in self.objects]
        for name in names:
            if names.count(name) > 1:
                where.of("object.name").refuse(name, "a name of its own to each object")


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
    if not path.exists():
        raise ThermorenderError(f"{path} does not exist; a scene is a folder with a scene.toml")
    folder = path.parent.resolve()
    spec = read(SceneSpec, read_toml(path), Where(path, folder, top="the scene"), folder=folder)
    return replace(spec, title=spec.title or folder.name)
