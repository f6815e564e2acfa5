"""The scene file `scene.toml`, read into frozen dataclasses with every key checked.

A key is a field of its table's dataclass; see `thermorender.schema`. File names are relative to the scene's folder, and
all files must be inside it.
"""

import os
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from thermorender import defaults, units
from thermorender.errors import ThermorenderError
from thermorender.paths import inside
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.scene.crowns import DENSITIES, LEAF_M
from thermorender.scene.meshes.axes import Axes
from thermorender.scene.raster import FORMATS, files_of
from thermorender.scene.sources import rasters_of
from thermorender.scene.surface import scene_kelvin
from thermorender.schema import (
    Where,
    choice,
    entry,
    file_inside,
    flag,
    key,
    mapping,
    number,
    read,
    read_toml,
    table,
    tables,
    text,
    texts,
    unit_of,
)

# Where a learned emissivity map's most probable material is less probable than this, the texel is unknown.
# Below the probability of any most probable material: only texels unlike the training data are unknown.
DEFAULT_CONFIDENCE = 0.003
# Texels whose learned emissivity has a larger standard deviation are flagged.
DEFAULT_MOST_STD = 0.05
# No scene's coldest temperature is above this [°C], so a range that begins there is one of kelvin.
_WARMEST_COLD_C = 150.0
# The [atmosphere] that follows [weather].
WEATHER = "weather"
# The temperature of an object that the heat balance solves.
BALANCE = "balance"
# Shares written in two digits sum to 1 within this.
_SHARES_OFF = 0.01
_CLASS_NUMBERS = {str(count): count for count in range(1, 256)}


# Readers for scenes


def kelvin(value: Any, where: Where, allow_zero: bool = False) -> float:
    """Read a temperature of a surface [K], or of a sky, which may be 0 K; below 100 K as a text, "77 K"."""
    stated = units.with_unit(value)
    if isinstance(stated, units.Stated):
        return scene_kelvin(str(where), stated)
    return float(scene_kelvin(str(where), number()(value, where), allow_zero))


def kelvin_of_object(value: Any, where: Where) -> "float | Path | None":
    """Read a temperature [K], the name of a table of leaf temperatures, or None: "balance", by the heat balance."""
    if isinstance(value, str) and value.lower().endswith((".csv", ".csv.gz")):
        return file_inside(value, where)
    return None if value == BALANCE else kelvin(value, where)


cold = partial(kelvin, allow_zero=True)
share = number(0.0, 1.0, above=True)
scale = number(0.0, 1e6, above=True)


def instant(value: Any, where: Where) -> "np.datetime64":
    """Read an instant with its time zone; return datetime64[s], UTC."""
    return units.instant(str(where), value)


def kelvin_or_raster(value: Any, where: Where) -> "float | Path":
    """Read a temperature [K], or the name of a raster of temperatures."""
    raster = isinstance(value, str) and not isinstance(units.with_unit(value), units.Stated)
    return raster_inside(value, where) if raster else kelvin(value, where)


def raster_or_true(value: Any, where: Where) -> "Path | bool":
    """Read the name of a raster of true temperatures, or true: those that the file declares."""
    if value is False:
        where.refuse(value, "true, where the temperatures of this file are true, or a raster; else leave [truth] out")
    return True if value is True else raster_inside(value, where)


def raster_inside(value: Any, where: Where) -> Path:
    """Read the name of a raster whose files are all in the scene's folder; return its Path."""
    path = file_inside(value, where)
    if path.suffix.lower() not in FORMATS:
        where.refuse(value, f"a raster that contains all its pixels: {', '.join(FORMATS)}")
    assert where.folder is not None
    for part in files_of(path):
        if not inside(part, where.folder):
            where.refuse(value, f"a raster whose files are all inside the scene's folder; {part} is not")
    return path


def camera_model(value: Any, where: Where) -> str:
    """Read the name of a shipped camera model, or a file of one."""
    return str(file_inside(value, where) if text(value, where).endswith(".toml") else value)


def temperature_map(value: Any, where: Where) -> str:
    """Read the name of a shipped learned map of temperatures, or a file of one."""
    from thermorender.learned.temperature_map import load_model

    name = str(file_inside(value, where) if text(value, where).endswith(".npz") else value)
    try:
        load_model(name)
        return name
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: {error}") from None


def emissivity_map(value: Any, where: Where) -> str:
    """Read the name of a shipped map of materials, or a file of one."""
    from thermorender.learned.emissivity.mapping import SHIPPED

    return str(value if text(value, where) in SHIPPED else file_inside(value, where))


def class_number(name: str, where: Where) -> int:
    """Read the key of a class, which is a string in TOML."""
    return _CLASS_NUMBERS[name] if name in _CLASS_NUMBERS else where.refuse(name, "class numbers 1…255 (0: no data)")


def _needed(where: Where, values: Any, needs: Mapping[str, list[str]]) -> None:
    """Refuse a table without the keys that its source needs."""
    for name in needs[values.source]:
        if getattr(values, name) in (None, {}):
            raise where.error(f"{where.of(name).key} is missing; source={values.source!r} needs it")


def _of_mesh_file(where: Where, given: Mapping[str, Any], is_mesh: bool, name: str) -> None:
    """Refuse keys of a mesh file where there is none."""
    for each in ("up", "scale_to_m", "flip"):
        if each in given and not is_mesh:
            where.of(each).refuse(given[each], f"it with {name} only")


# Tables


@dataclass(frozen=True)
class FarSpec:
    """Coarser ground around the scene, or around the far ground before it."""

    elevation: Path = key(raster_inside)
    orthophoto: Path | None = key(raster_inside, None)
    # Class numbers, whose materials [emissivity.classes] names; a texel of several pixels has their shares.
    classes: Path | None = key(raster_inside, None)
    # Kelvin, or a raster of it, in place of those of [temperature]; a heat balance solves far ground itself.
    temperature: "float | Path | None" = key(kelvin_or_raster, None)
    # Of its heights; by default as those of the terrain.
    height_reference: str | None = key(choice("ellipsoid", "geoid"), None)


def far_grounds(value: Any, where: Where) -> "tuple[FarSpec, ...]":
    """Read one table of far ground, or a list of them from the inner to the outer one."""
    if not isinstance(value, list):
        return (read(FarSpec, value, where),)
    return tuple(read(FarSpec, item, replace(where, key=f"{where.key} {n}")) for n, item in enumerate(value, 1))


def rasters_inside(value: Any, where: Where) -> Path:
    """Read the name of a folder of rasters in the scene's folder, or of one raster of any size; return its Path."""
    folder = Path(os.path.realpath((where.folder or Path()) / text(value, where)))
    if not folder.is_dir():
        path = file_inside(value, where)
        if path.suffix.lower() not in FORMATS:
            where.refuse(value, f"a folder of rasters, or a raster that contains its pixels: {', '.join(FORMATS)}")
        return path
    if where.folder is not None and not inside(folder, where.folder):
        where.refuse(value, "a folder inside the scene's folder")
    for path in rasters_of(folder):
        if not inside(path, folder):
            where.refuse(value, f"a folder that holds its files themselves; {path.name} is a link to another place")
    return folder


@dataclass(frozen=True)
class TilesSpec:
    """Ground of any size, read in tiles: folders of rasters, or single ones."""

    elevation: Path = key(rasters_inside)
    orthophoto: Path | None = key(rasters_inside, None)
    classes: Path | None = key(rasters_inside, None)


@dataclass(frozen=True)
class TerrainSpec:
    """Ground of the scene: an elevation raster with an orthophoto, one textured mesh, or tiles; and far ground around
    the first two."""

    elevation: Path | None = key(raster_inside, None)
    mesh: Path | None = key(file_inside, None)
    tiles: TilesSpec | None = key(table(TilesSpec), None)
    orthophoto: Path | None = key(raster_inside, None)
    height_reference: str = key(choice("ellipsoid", "geoid"), "ellipsoid")
    geoid_undulation_m: float | None = key(number(), None)
    # Fills enclosed gaps in the heights and flags them in the truth mask; otherwise they are holes.
    fill: bool = key(flag, False)
    # up, scale_to_m, flip: of the mesh, as in `thermorender.scene.meshes.axes.Axes`
    up: str | None = key(choice("y", "z"), None)
    scale_to_m: float = key(scale, 1.0)
    flip: bool = key(flag, False)
    far: tuple[FarSpec, ...] = key(far_grounds, ())

    @property
    def axes(self) -> Axes:
        """How the numbers of the mesh are meant."""
        return Axes(self.up, self.scale_to_m, self.flip)

    def check(self, where: Where, given: Mapping[str, Any]) -> None:
        """Refuse none or two kinds of ground, and keys of the other kind."""
        kind = where.exactly_one(given, ("elevation", "mesh", "tiles"))
        _of_mesh_file(where, given, kind == "mesh", "mesh")
        for name in ("orthophoto", "fill", "far"):
            if self.tiles and name in given:
                raise where.error(f"terrain.{name} is given, and terrain.tiles has all of the ground; leave it out")
        if self.mesh and self.fill:
            raise where.error("terrain.fill fills islands of an elevation raster, and this is a mesh; leave it out")
        if self.mesh and self.orthophoto:
            raise where.error("terrain.orthophoto needs 'elevation'; a mesh brings its own texture")


@dataclass(frozen=True)
class TemperatureSpec:
    """Source of the kinetic temperature of each texel."""

    source: str = key(choice("constant", "raster", "material", "learned", "balance"))
    value: float | None = key(kelvin, None)
    raster: Path | None = key(raster_inside, None)
    model: str | None = key(temperature_map, None)
    # Temperatures of a learned map's intensities 0 and 1 [°C].
    range_c: tuple[float, float] | None = key(number(-200.0, 3000.0, count=2, ordered=True), None)
    materials: dict[str, float] = key(mapping(kelvin), {})
    # The orthophoto's brightness sets the short-wave absorptance within a bare material (heat balance).
    brightness: bool = key(flag, False)
    # Instant and weather of a learned map or raster, in place of those in the map's file. With the error below, the
    # heat balance moves the temperatures to the time of [weather].
    trained: "WeatherSpec | None" = key(lambda value, where: read(WeatherSpec, value, where), None)
    # One standard deviation of the error of these temperatures [K].
    map_error_k: float | None = key(number(0.0, 50.0), None)

    def check(self, where: Where, given: Mapping[str, Any]) -> None:
        """Refuse a source without its keys, and keys that it would ignore."""
        needs = {"constant": ["value"], "raster": ["raster"], "learned": ["model"], "material": ["materials"],
                 "balance": []}  # fmt: skip
        _needed(where, self, needs)
        if self.range_c is not None and self.range_c[0] > _WARMEST_COLD_C:
            where.of("range_c").refuse(
                list(self.range_c), f"°C; those look like kelvin, subtract {units.ZERO_CELSIUS_K}"
            )
        if "brightness" in given and self.source != "balance":
            where.of("brightness").refuse(given["brightness"], f"it with source='balance' only, not {self.source!r}")
        for name in ("trained", "map_error_k"):
            if name in given and self.source not in ("learned", "raster"):
                only = f"it with source='learned' or 'raster' only, not {self.source!r}"
                where.of(name).refuse(given[name], only)


@dataclass(frozen=True)
class EmissivitySpec:
    """Source of the material of each texel."""

    source: str = key(choice("constant", "material", "classes", "learned"))
    value: float | None = key(share, None)
    material: str | None = key(text, None)
    raster: Path | None = key(raster_inside, None)
    classes: dict[int, str] = key(mapping(text, class_number), {})
    model: str | None = key(emissivity_map, None)
    fallback: str | None = key(text, None)
    confidence: float = key(share, DEFAULT_CONFIDENCE)
    most_std: float = key(share, DEFAULT_MOST_STD)
    without: tuple[str, ...] = key(texts, ())
    # Snow materials that stay possible although the weather excludes snow.
    present: tuple[str, ...] = key(texts, ())
    # Stated share of a material in the area of its group of surfaces, in place of a learned map's.
    shares: dict[str, float] = key(mapping(share, text), {})
    # GeoJSON of OpenStreetMap tags that restrict the materials inside its shapes, for a learned map.
    known: Path | None = key(file_inside, None)
    # Whether heights above the ground and slopes weigh the materials of a learned map.
    heights: bool = key(flag, True)

    def check(self, where: Where, given: Mapping[str, Any]) -> None:
        """Refuse a source without its keys, and keys that it would ignore."""
        needs = {"constant": ["value"], "material": ["material"], "classes": ["classes"],
                 "learned": ["model", "fallback"]}  # fmt: skip
        _needed(where, self, needs)
        for name in ("present", "shares", "known", "heights"):
            if name in given and self.source != "learned":
                where.of(name).refuse(given[name], f"it with source='learned' only, not {self.source!r}")
        for name in set(self.present) & set(self.without):
            where.of("present").refuse(list(self.present), f"{name!r} in one of 'present' and 'without'")


@dataclass(frozen=True, kw_only=True)
class SurfaceSpec:
    """Part of a mesh whose material or temperature is not that of [emissivity] or [temperature]."""

    # Of a node, group, material or texture in the mesh's file.
    name: str = key(text)
    material: str | None = key(text, None)
    # Raster of class numbers in the pixels of the texture; [emissivity.classes] names their materials.
    classes: Path | None = key(raster_inside, None)
    # Kelvin, or a raster in the pixels of the texture.
    temperature: "float | Path | None" = key(kelvin_or_raster, None)
    # The shape is not measured, such as a wall below the roof of a survey from above.
    inferred: bool | None = key(flag, None)

    def check(self, where: Where, given: Mapping[str, Any]) -> None:
        """Refuse a surface without a statement, and one of two materials."""
        if not {"material", "classes", "temperature", "inferred"} & set(given):
            raise where.error(f"{where.key} states nothing; give material, classes, temperature or inferred")
        if "material" in given and "classes" in given:
            raise where.error(f"{where.key} has both material and classes; give one of them")


@dataclass(frozen=True, kw_only=True)
class ObjectSpec:
    """A solid object in the scene: a primitive or a mesh file, with one material and temperature."""

    name: str = key(text)
    shape: str | None = key(choice("disc", "box", "sphere"), None)
    file: Path | None = key(file_inside, None)
    size: tuple[float, float, float] = key(number(0.0, FARTHEST_M, above=True, count=3, unit="m"), (1.0, 1.0, 1.0))
    position: tuple[float, float, float] = key(number(-FARTHEST_M, FARTHEST_M, count=3, unit="m"))
    yaw_deg: float = key(number(), 0.0)
    # up, scale_to_m, flip: of the file, as in `thermorender.scene.meshes.axes.Axes`
    up: str | None = key(choice("y", "z"), None)
    scale_to_m: float = key(scale, 1.0)
    flip: bool = key(flag, False)
    # Whether it stands upright on a slope; by default `thermorender.scene.footing.upright` decides.
    upright: bool | None = key(flag, None)
    # Kelvin, or of crowns a table; None is solved by the heat balance.
    temperature: "float | Path | None" = key(kelvin_of_object)
    # Whether the heat balance solves it in place of that where the terrain's temperatures come from one.
    follows_balance: bool = key(flag, False)
    material: str = key(text)
    # Heat that enters the sheets from within, such as an engine's, and its shares by parts of the mesh's file; without
    # shares it is even over the area.
    inner_heat_w: float = key(number(0.0, 1e9), 0.0)
    inner_heat_share: dict[str, float] = key(mapping(share), {})
    colour: tuple[float, float, float] = key(number(0.0, 255.0, count=3, unit="(sRGB)"), (128.0, 128.0, 128.0))
    track: Path | None = key(file_inside, None)
    instances: Path | None = key(file_inside, None)
    # Area of one side of leaves per volume of a crown, as of `thermorender.scene.crowns` [m²/m³]; without it, a solid.
    leaf_area_1_m: float | None = key(number(*DENSITIES, unit="m²/m³"), None)
    # Side of a leaf of a crown [m], for the stated error.
    leaf_m: float = key(number(1e-3, 10.0, unit="m"), LEAF_M)
    # Whether nobody has seen its shape, as of a SurfaceSpec.
    inferred: bool | None = key(flag, None)

    def check(self, where: Where, given: Mapping[str, Any]) -> None:
        """Refuse none or two kinds of solid, and a name that could be a part's."""
        _of_mesh_file(where, given, where.exactly_one(given, ("shape", "file")) == "file", "file")
        if ":" in self.name:
            where.of("name").refuse(self.name, "a name without ':', which separates the parts of an object")
        if self.track and self.instances:
            where.of("instances").refuse(str(self.instances), "it without track: copies do not move")
        if (self.instances or self.leaf_area_1_m) and self.upright is False:
            where.of("upright").refuse(False, "it without instances and leaf_area_1_m: copies and crowns stand upright")
        if self.leaf_area_1_m is not None and (self.track or self.shape not in ("box", "sphere")):
            where.of("leaf_area_1_m").refuse(
                self.leaf_area_1_m, "it with shape='box' or 'sphere', and without track: a crown stands still"
            )
        if "leaf_m" in given and self.leaf_area_1_m is None:
            where.of("leaf_m").refuse(self.leaf_m, "it with leaf_area_1_m only")
        if isinstance(self.temperature, Path) and not (self.leaf_area_1_m and self.instances):
            where.of("temperature").refuse(
                str(self.temperature), "a table with leaf_area_1_m and instances only, for each of these crowns"
            )
        if self.follows_balance and self.track:
            where.of("follows_balance").refuse(True, "it without track only: the heat balance solves what stands still")
        if self.temperature is None and self.track:
            where.of("temperature").refuse(
                BALANCE, "it to what stands still only: kelvin here or temperature_k in its track, or leave track out"
            )
        self._check_inner_heat(where)

    def _check_inner_heat(self, where: Where) -> None:
        """Refuse inner heat that no temperature follows, and shares of parts that are none."""
        balanced = self.temperature is None or self.follows_balance
        if self.inner_heat_w and (not balanced or self.instances or self.leaf_area_1_m):
            where.of("inner_heat_w").refuse(
                self.inner_heat_w,
                "it with temperature='balance' or follows_balance = true only, and without instances and leaf_area_1_m",
            )
        if self.inner_heat_share and not self.file:
            where.of("inner_heat_share").refuse(dict(self.inner_heat_share), "it with file only, whose parts it names")
        total = sum(self.inner_heat_share.values())
        if self.inner_heat_share and abs(total - 1.0) > _SHARES_OFF:
            where.of("inner_heat_share").refuse(
                dict(self.inner_heat_share), f"shares whose sum is 1; that of these is {total:g}"
            )

    @property
    def axes(self) -> Axes:
        """How the numbers of the file are meant."""
        return Axes(self.up, self.scale_to_m, self.flip)

    @property
    def kelvin(self) -> float:
        """The temperature [K]; NaN where the heat balance solves it, and of crowns with a table."""
        return self.temperature if isinstance(self.temperature, float) else np.nan


@dataclass(frozen=True)
class AtmosphereSpec:
    """The air: a standard atmosphere, a table or a measured profile, its clouds, and the altitude of the scene.

    The standard "weather" is the air of [weather] at each instant; its clouds follow the long-wave irradiance.
    """

    standard: str | None = key(text, None)
    file: Path | None = key(file_inside, None)
    profile: Path | None = key(file_inside, None)
    absorption: Path | None = key(file_inside, None)
    aerosol: str = key(text, "none")
    visibility_km: float = key(number(), 23.0)
    temperature_offset_k: float = key(number(), 0.0)
    humidity_factor: float = key(number(), 1.0)
    year: float | None = key(number(), None)
    gases: dict[str, float] = key(mapping(number()), {})
    cloud_fraction: float | None = key(number(), None)
    cloud_base_m: float | None = key(number(), None)
    altitude_m: float | None = key(number(), None)

    def check(self, where: Where, given: Mapping[str, Any]) -> None:
        """Refuse none or two kinds of air, and keys that the kind would ignore."""
        kind = where.exactly_one(given, ("standard", "file", "profile"))
        only = {"aerosol": ("standard", "profile"), "visibility_km": ("profile",),
                "temperature_offset_k": ("standard",), "humidity_factor": ("standard",),
                "year": ("standard", "profile"), "gases": ("standard", "profile"),
                "absorption": ("profile",)}  # fmt: skip
        for name, kinds in only.items():
            if name in given and kind not in kinds:
                where.of(name).refuse(given[name], f"it with {' or '.join(kinds)} only, not with {kind}")
        for name in ("temperature_offset_k", "humidity_factor"):
            if name in given and self.standard == WEATHER:
                where.of(name).refuse(given[name], "it without standard='weather' only, which measures the air")
        if "year" in given and self.standard == WEATHER:
            where.of("year").refuse(given["year"], "it without standard='weather' only, which has an instant")
        for name in ("aerosol", "visibility_km", "year", "gases"):
            if name in given and "absorption" in given:
                where.of(name).refuse(given[name], "it without absorption only, which already includes all gases")


@dataclass(frozen=True)
class SunSpec:
    """The sun's position: above the horizon, and from north, eastward positive."""

    elevation_deg: float = key(number(-90.0, 90.0))
    azimuth_deg: float = key(number(-360.0, 360.0))


@dataclass(frozen=True)
class WeatherSpec:
    """The weather, from a station's record, a weather year or a described day, and the scene's instant.

    `albedo` is the mean reflectance of the terrain for sunlight; it sets the bare materials' solar absorptance.
    """

    time: np.datetime64 = key(instant)
    file: Path | None = key(file_inside, None)
    epw: Path | None = key(file_inside, None)
    air_low_c: float | None = key(number(-90.0, 60.0), None)
    air_high_c: float | None = key(number(-90.0, 60.0), None)
    humidity: float | None = key(share, None)
    wind_m_s: float | None = key(number(0.0, 60.0), None)
    cloud: float | None = key(number(0.0, 1.0), None)
    snow_depth_m: float | None = key(number(0.0, 20.0), None)
    inside_c: float = key(number(-60.0, 60.0), 20.0)
    albedo: float | None = key(number(0.02, 0.95), None)
    albedo_std: float | None = key(number(0.0, 0.3), None)
    longest_gap_h: float | None = key(number(0.0, 24.0), None)
    air_height_m: float | None = key(number(0.1, 100.0), None)
    wind_height_m: float | None = key(number(0.1, 200.0), None)
    light_shift_min: float | None = key(number(-120.0, 120.0), None)

    def check(self, where: Where, given: Mapping[str, Any]) -> None:
        """Refuse none or two kinds of weather, and an incomplete described day."""
        kind = where.exactly_one(given, ("file", "epw", "air_high_c"), "station, weather year or named day")
        if "albedo_std" in given and "albedo" not in given:
            where.of("albedo_std").refuse(given["albedo_std"], "it with albedo only")
        # A station may lack wind.
        of_station = ("longest_gap_h", "air_height_m", "wind_height_m")
        also = (
            {"wind_m_s": ("air_high_c", "file")} | dict.fromkeys(of_station, ("file",)) | {"light_shift_min": ("epw",)}
        )
        for name in ("air_low_c", "humidity", "wind_m_s", "cloud", *of_station, "light_shift_min"):
            kinds = also.get(name, ("air_high_c",))
            if kind not in kinds and name in given:
                where.of(name).refuse(given[name], f"it with {' or '.join(kinds)} only, not with {kind}")
            if name in (*of_station, "light_shift_min"):
                continue
            if kind == "air_high_c" and name not in given:
                raise where.error(f"{where.of(name).key} is missing; a named day needs it{unit_of(name, ' in ')}")
        low, high = self.air_low_c, self.air_high_c
        if kind == "air_high_c" and low is not None and high is not None and low > high:
            where.of("air_low_c").refuse(given["air_low_c"], f"a value not above air_high_c={self.air_high_c:g}")


@dataclass(frozen=True)
class _Frame:
    latitude_deg: float = key(number(-90.0, 90.0))
    longitude_deg: float = key(number(-360.0, 360.0))
    height_m: float = key(number())


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """A whole scene file; `sky_temperature` is None with an atmosphere, which has its own sky.

    Without sky and atmosphere, the air is that of the weather.
    """

    folder: Path
    title: str = key(lambda value, where: value if value == "" else text(value, where), "")
    terrain: TerrainSpec = key(table(TerrainSpec))
    temperature: TemperatureSpec = key(table(TemperatureSpec))
    emissivity: EmissivitySpec = key(table(EmissivitySpec))
    sky_temperature: float | None = key(entry("temperature", cold), None, name="sky")
    atmosphere: AtmosphereSpec | None = key(table(AtmosphereSpec), None)
    sun: SunSpec | None = key(table(SunSpec), None)
    weather: WeatherSpec | None = key(table(WeatherSpec), None)
    surroundings_temperature: float | None = key(entry("temperature", cold, None), None, name="surroundings")
    camera: str = key(entry("model", camera_model, defaults.CAMERA), defaults.CAMERA)
    truth_temperature: "Path | bool | None" = key(entry("temperature", raster_or_true, None), None, name="truth")
    frame: tuple[float, float, float] | None = key(lambda value, where: astuple(read(_Frame, value, where)), None)
    objects: tuple[ObjectSpec, ...] = key(tables(ObjectSpec), (), name="object")
    surfaces: tuple[SurfaceSpec, ...] = key(tables(SurfaceSpec), (), name="surface")

    def check(self, where: Where, given: Mapping[str, Any]) -> None:
        """Refuse none or two skies, a sun without air or beside the weather's, and two objects of one name."""
        self._check_surfaces(where)
        if not ("weather" in given and "sky" not in given and "atmosphere" not in given):
            where.exactly_one(
                given, ("sky", "atmosphere"),
                "a sky of one temperature and no air, or air with its sky; with [weather] none means its air and sky",
            )  # fmt: skip
        if self.weather is None and self.atmosphere and self.atmosphere.standard == WEATHER:
            raise where.error("atmosphere.standard='weather' needs the weather; add [weather], or name another air")
        if self.sun and not (self.atmosphere or (self.weather and self.sky_temperature is None)):
            raise where.error("[sun] shines through the air; add [atmosphere] or leave [sun] out")
        moved = self.temperature.trained and self.weather
        if self.sun and (moved or self.temperature.source == "balance"):
            why = "temperature.trained" if moved else "temperature.source='balance'"
            raise where.error(f"[sun] follows from weather.time with {why}; leave it out")
        for kind, items in (("object", self.objects), ("surface", self.surfaces)):
            names = [item.name for item in items]
            for name in names:
                if names.count(name) > 1:
                    where.of(f"{kind}.name").refuse(name, f"each {kind} a unique name")

    def _check_surfaces(self, where: Where) -> None:
        """Refuse surfaces of a raster terrain, and classes without names or raster."""
        if self.surfaces and not self.terrain.mesh:
            raise where.error(
                "[[surface]] names a part of a mesh, and this terrain is an elevation raster; give its materials by "
                "emissivity.source='classes'"
            )
        if self.emissivity.known and self.terrain.mesh and self.frame is None:
            raise where.error(
                "emissivity.known lies on a map, and this mesh has no place on it; add [frame] with latitude_deg, "
                "longitude_deg and height_m, or give the materials of its parts in [[surface]]"
            )
        self._check_tiles(where)
        stated = self.terrain.mesh or self.emissivity.raster or self.terrain.tiles
        if self.emissivity.source == "classes" and not stated:
            raise where.error("emissivity.raster is missing; source='classes' needs it")
        if any(one.classes for one in self.terrain.far) and self.emissivity.source not in ("classes", "learned"):
            raise where.error(
                f"terrain.far.classes is given, and emissivity.source={self.emissivity.source!r} gives all ground one "
                "material; leave it out, or give emissivity.source='classes'"
            )
        for name, items in (("surface", self.surfaces), ("terrain.far", self.terrain.far)):
            if any(one.classes for one in items) and not self.emissivity.classes:
                raise where.error(f"{name}.classes needs the materials of its numbers; add [emissivity.classes]")
        if self.temperature.source == "balance" and any(one.temperature is not None for one in self.terrain.far):
            raise where.error(
                "terrain.far.temperature is given, and temperature.source='balance' solves far ground too; leave it out"
            )
        if self.terrain.far and self.terrain.mesh and self.frame is None:
            raise where.error(
                "terrain.far lies on a map, and this mesh has no place on it; add [frame] with latitude_deg, "
                "longitude_deg and height_m"
            )

    def _check_tiles(self, where: Where) -> None:
        """Refuse what tiles do not have yet, and classes without names."""
        tiles = self.terrain.tiles
        if tiles is None:
            return
        if (self.emissivity.source == "classes") != bool(tiles.classes):
            raise where.error(
                "terrain.tiles.classes and emissivity.source='classes' belong together; give both, with the materials "
                "in [emissivity.classes], or none"
            )
        if self.lacking_on_tiles:
            raise where.error(
                f"{self.lacking_on_tiles} is not supported on terrain.tiles; leave it out, or cut a scene of one raster"
            )

    @property
    def lacking_on_tiles(self) -> str | None:
        """The first key that a tiled ground does not have; None without one."""
        stated = {
            "emissivity.raster": self.emissivity.raster,
            "emissivity.source='learned'": self.emissivity.source == "learned",
            "temperature.raster": self.temperature.raster, "temperature.brightness": self.temperature.brightness,
            "temperature.trained": self.temperature.trained, "weather.albedo": self.weather and self.weather.albedo,
            "[[object]]": self.objects, "[truth]": self.truth_temperature,
        }  # fmt: skip
        return next((name for name, given in stated.items() if given), None)


def read_scene(folder: Path | str) -> SceneSpec:
    """Return the SceneSpec of a scene folder or of the path of its `scene.toml`."""
    path = Path(folder)
    if path.name != "scene.toml":
        path = path / "scene.toml"
    if not path.exists():
        raise ThermorenderError(f"{path} does not exist; a scene is a folder with a scene.toml")
    folder = path.parent.resolve()
    for name in (path.name, "flight.csv", "materials"):
        if not inside(folder / name, folder):
            raise ThermorenderError(
                f"{folder / name} is a link to {os.path.realpath(folder / name)}, which is not allowed; put "
                "the file itself inside the scene's folder"
            )
    spec = read(SceneSpec, read_toml(path), Where(path, folder, top="the scene"), folder=folder)
    if spec.sky_temperature is None and spec.atmosphere is None:
        spec = replace(spec, atmosphere=AtmosphereSpec(standard=WEATHER))
    return replace(spec, title=spec.title or folder.name)
