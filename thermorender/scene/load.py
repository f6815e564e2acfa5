"""A scene in memory: surfaces with their texels, materials, sky and camera, made from a scene folder."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.declared import declared_air
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.materials import library as material_tables
from thermorender.materials.material import Material, grey
from thermorender.materials.mixture import Mixture
from thermorender.paths import data_folder
from thermorender.physics.geodesy import FARTHEST_M, LocalFrame
from thermorender.scene import mesh, terrain
from thermorender.scene.ground import Ground
from thermorender.scene.material_map import learned_materials
from thermorender.scene.raster import Grid, bounds_in, grid_of, onto, read_classes, read_colour
from thermorender.scene.refine import evened, refined
from thermorender.scene.spec import (
    AtmosphereSpec,
    EmissivitySpec,
    ObjectSpec,
    SceneSpec,
    SunSpec,
    TemperatureSpec,
    read_scene,
)
from thermorender.scene.surface import (
    FALLBACK,
    FILLED,
    MOST_MATERIALS,
    SURFACE,
    UNKNOWN,
    UNMOVED,
    Surface,
    fill,
    nearest_valid,
    scene_kelvin,
)
from thermorender.scene.temperature import Texels, learned_map, resolve, trained, waiting
from thermorender.scene.tracks import TrackedObject, read_track
from thermorender.sensor.camera import Camera, load_camera
from thermorender.units import instant, utc_text

if TYPE_CHECKING:
    from thermorender.weather.series import Weather

# The sun shines where its direct irradiance is above this [W m⁻²]: World Meteorological Organization, Guide to
# Instruments and Methods of Observation, WMO-No. 8 (2018), volume I, 8.1.1.
_SUNSHINE_W_M2 = 120.0
# Number of a texel's material (h, w), and whether it is known, or unknown, there (h, w).
_Map = tuple[NDArray[np.uint8], NDArray[np.bool_]]


@dataclass(frozen=True)
class Scene:
    """Everything a render needs.

    Attributes
    ----------
    spec : SceneSpec
        What the scene file says.
    frame : LocalFrame or None
        Where the local East-North-Up frame lies on Earth; None for a mesh without [frame].
    surfaces : tuple of Surface
        The terrain's first, then one or more per static object.
    terrain_count : int
        How many of them are terrain.
    materials : tuple of Material
        What `Surface.material` indexes.
    camera : Camera
    grid : Grid or None
        Map grid of the terrain's texels.
    air : Atmosphere or None
        What the scene declares, in the camera's band.
    tracked_objects : tuple of TrackedObject
        Objects with a track.
    report : dict
        What the temperature source has to tell, per learned map.
    emissivity_report : dict
        What the learned emissivity map has to tell; empty without one.
    time : datetime64[s] or None
        The instant that is asked for, UTC; None for a scene without [weather].
    mapped : tuple of (h, w) float32 arrays, or None
        Temperatures of a map at the instant it was trained for, of each of the terrain's surfaces [K], where a heat
        balance moves them to `time`; None elsewhere.
    moved_report : dict
        What moving them told; empty until it is done.
    told_map : TemperatureMap or None
        The learned map of the terrain's temperatures where it is told relief, hour or weather, as its file was when the
        source was set; None elsewhere.
    """

    spec: SceneSpec
    frame: LocalFrame | None
    surfaces: tuple[Surface, ...]
    terrain_count: int
    materials: tuple[Material, ...]
    camera: Camera
    grid: Grid | None
    air: Atmosphere | None = None
    tracked_objects: tuple[TrackedObject, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)
    emissivity_report: dict[str, Any] = field(default_factory=dict)
    time: "np.datetime64 | None" = None
    mapped: "tuple[NDArray[np.float32], ...] | None" = None
    moved_report: dict[str, Any] = field(default_factory=dict)
    told_map: Any = None

    @property
    def name(self) -> str:
        """Name of the scene's folder."""
        return self.spec.folder.name

    @property
    def where(self) -> str:
        """Path of the scene file, for messages."""
        return str(self.spec.folder / "scene.toml")

    @property
    def altitude_m(self) -> float:
        """Altitude of the local frame's origin above sea level [m]: as declared, else as the frame lies, else 0."""
        air = self.spec.atmosphere
        if air and air.altitude_m is not None:
            return air.altitude_m
        return self.frame.height_m - (self.geoid_undulation_m or 0.0) if self.frame else 0.0

    @property
    def sky_temperature(self) -> float:
        """Temperature of the isotropic black sky that shines in the camera's band as the scene's does [K]."""
        if self.air is not None:
            return float(self.air.sky_temperature(self.altitude_m))
        assert self.spec.sky_temperature is not None
        return self.spec.sky_temperature

    @property
    def surroundings_temperature(self) -> float:
        """Temperature of the black background beyond the terrain's edge [K]: as stated, else its texels' mean."""
        if self.spec.surroundings_temperature is not None:
            return self.spec.surroundings_temperature
        self.refuse_unwarmed()
        terrain = [surface.temperature.ravel() for surface in self.surfaces[: self.terrain_count]]
        return float(np.concatenate(terrain).mean(dtype=np.float64))

    @property
    def truth_temperature_spec(self) -> TemperatureSpec:
        """TemperatureSpec of the truth raster, or without one of the heat balance.

        Raises
        ------
        ThermorenderError
            The scene has neither.
        """
        if self.spec.truth_temperature is None:
            if self.balanced:
                return self.spec.temperature
            raise ThermorenderError(f"{self.where} has no truth.temperature; name a raster of kelvin there")
        return TemperatureSpec(source="raster", raster=self.spec.truth_temperature)

    @property
    def geoid_undulation_m(self) -> float | None:
        """Height of the geoid above the ellipsoid that this scene declares [m], or None."""
        declared = self.spec.terrain.geoid_undulation_m
        return 0.0 if declared is None and self.spec.terrain.height_reference == "geoid" else declared

    @property
    def balanced(self) -> bool:
        """Whether the terrain's temperatures are those of a heat balance, at an instant and under a weather."""
        return self.spec.temperature.source == "balance"

    @property
    def marched(self) -> bool:
        """Whether the terrain's temperatures follow the weather: a heat balance's own, a map's that it moves, or those
        of a map that is told hour and weather."""
        return self.balanced or self.mapped is not None or self.told

    @property
    def told(self) -> bool:
        """Whether the terrain's temperatures are those of a learned map that is told relief, hour or weather."""
        return self.told_map is not None

    @property
    def warmed(self) -> bool:
        """Whether the terrain's temperatures are there: those of a balance are NaN until they are solved."""
        terrain = self.surfaces[: self.terrain_count]
        return not self.marched or all(np.isfinite(surface.temperature).all() for surface in terrain)

    def refuse_unwarmed(self) -> None:
        """Raise unless the terrain's temperatures are there."""
        if not self.warmed:
            raise ThermorenderError(
                f"{self.where}: the temperatures of {self._marched_words()} are not solved yet; take "
                "Renderer(scene).scene, whose are"
            )

    @cached_property
    def weather(self) -> "Weather":
        """The Weather that the scene declares, at its own place; read when first asked for.

        Raises
        ------
        ThermorenderError
            No [weather], no place, a file that cannot be used, or `time` outside of it.
        """
        if self.spec.weather is None or self.time is None:
            raise ThermorenderError(f"{self.where} has no [weather]; add it")
        if self.frame is None:
            raise ThermorenderError(
                f"{self.where}: [weather] needs a place, which a mesh does not have; add [frame] with latitude_deg, "
                "longitude_deg and height_m"
            )
        from thermorender.weather.declared import declared_weather

        place = self.frame.latitude_deg, self.frame.longitude_deg, self.altitude_m
        try:
            return declared_weather(self.spec.weather, *place)
        except ThermorenderError as error:
            raise ThermorenderError(f"{self.where}: {error}") from None

    @property
    def weather_notes(self) -> tuple[str, ...]:
        """What the weather lacked and how it was filled, and how little of it lies before `time`, in sentences."""
        before_h = (self.time - self.weather.time[0]) / np.timedelta64(3600, "s")
        notes = list(self.weather.notes)
        if before_h < 24.0:
            notes.append(
                f"the weather begins {before_h:.1f} h before {utc_text(self.time)}: less than a day leaves the ground "
                "near the state it was started in"
            )
        snow = float(self.weather.at(self.time).snow_m)
        if snow > 0.0 and not any(each.thermal and each.thermal.cover == "snow" for each in self.materials):
            notes.append(
                f"snow lies {snow:g} m deep by the weather, but no material of the scene is snow: its ground is taken "
                "as bare; map the material snow where it lies"
            )
        return tuple(notes)

    def at(self, time: "str | np.datetime64") -> "Scene":
        """Return this scene asked for at another instant; the temperatures of a heat balance are then to be solved.

        A truth raster is of the scene's own instant and left out at any other.

        Parameters
        ----------
        time : str, datetime or datetime64
            As by `thermorender.units.instant`: text with its zone; a datetime64 is UTC.

        Raises
        ------
        ThermorenderError
            No instant, or a scene that has no hour.
        """
        asked = instant("time", time)
        if self.spec.weather is None:
            raise ThermorenderError(
                f"{self.where}: time={utc_text(asked)} needs temperature.source='balance' with [weather], and this "
                f"scene's temperatures are of source={self.spec.temperature.source!r} without an hour; add both, or "
                "leave the time out"
            )
        if asked == self.time:
            return self
        if self.spec.temperature.source == "learned" and not self.marched:
            raise ThermorenderError(
                f"{self.where}: time={utc_text(asked)} cannot be had of learned map {self.spec.temperature.model!r}, "
                "which does not say when and in what weather it was trained; add [temperature.trained] with the keys "
                "of [weather], or leave the time out"
            )
        spec = replace(self.spec, weather=replace(self.spec.weather, time=asked), truth_temperature=None)
        scene = replace(self, spec=spec, time=asked)
        # The map it was loaded with, whatever its file holds by now.
        return scene.with_temperature(spec.temperature, self.told_map) if self.marched else scene

    def heated(self, time: np.datetime64, temperatures: "Sequence[ArrayLike]") -> "Scene":
        """Return this scene at an instant of its weather, as its heat balance found it.

        Where air is declared the sun stands in it as it does at that instant, if it shines.

        Parameters
        ----------
        time : datetime64
            UTC.
        temperatures : sequence of (h, w) arrays
            Kinetic temperature of the texels of each of the terrain's surfaces [K].
        """
        made = [
            replace(surface, temperature=np.asarray(values, dtype=np.float32).reshape(surface.temperature.shape))
            for surface, values in zip(self.surfaces[: self.terrain_count], temperatures, strict=True)
        ]
        spec = self.spec
        if spec.atmosphere:
            azimuth, elevation = map(float, self.weather.sun(time))
            shines = elevation > 0.0 and float(self.weather.at(time).direct_w_m2) > _SUNSHINE_W_M2
            spec = replace(spec, sun=SunSpec(elevation, azimuth) if shines else None)
        surfaces = (*made, *self.surfaces[self.terrain_count :])
        scene = replace(self, spec=spec, surfaces=surfaces, time=time.astype("datetime64[s]"))
        # Whatever was read for the instant asked for holds for the others of its day.
        scene.__dict__["weather"] = self.weather
        return scene

    @cached_property
    def ground(self) -> Ground:
        """Callable (east, north) → local height of the terrain [m], NaN off it."""
        return Ground(self.surfaces[: self.terrain_count])

    @cached_property
    def targets(self) -> dict[str, NDArray[np.float64]]:
        """{name: (3,) local position of its middle [m]} of the static objects."""
        found = {}
        for item in (item for item in self.spec.objects if item.track is None):
            corners = np.concatenate(
                [s.vertices for s in self.surfaces[self.terrain_count :] if s.name.split(":")[0] == item.name]
            )
            found[item.name] = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        return found

    def with_temperature(self, spec: TemperatureSpec, model: Any = None) -> "Scene":
        """Return this scene with its terrain's temperatures from another source.

        Parameters
        ----------
        spec : TemperatureSpec
        model : TemperatureMap, optional
            The learned map that the source names, where it is at hand already.
        """
        if not isinstance(spec, TemperatureSpec):
            raise ThermorenderError(
                f"with_temperature was given a {type(spec).__name__}; give a TemperatureSpec, for kelvins of one's own "
                "TemperatureSpec(source='raster', raster=path) with the path of a GeoTIFF"
            )
        model = learned_map(spec) if model is None else model
        # A map that must be told relief, hour or weather.
        told = model if model is not None and model.needs else None
        if told and spec.trained:
            raise ThermorenderError(
                f"{self.where}: temperature.model={spec.model!r} is told hour and weather and is not moved by "
                "temperature.trained; leave that out"
            )
        moves = told is None and self.spec.weather is not None and trained(spec) is not None
        if told and self.grid is None:
            raise ThermorenderError(
                f"{self.where}: temperature.model={spec.model!r} is told relief or hour and needs a terrain with an "
                "elevation raster, and this one is a mesh; take a map that sees colour only"
            )
        if moves or spec.source == "balance" or told:
            self._refuse_balance("trained" if moves else f"model={spec.model!r}" if spec.model else "source='balance'")
        report: dict[str, Any] = {}
        surfaces = list(self.surfaces)
        for index, surface in enumerate(surfaces[: self.terrain_count]):
            texels = Texels(
                surface.colour, surface.material, self.materials, self.grid, surface.texel_m, self.where, report,
                model,
            )  # fmt: skip
            temperature, flags = waiting(texels) if told else resolve(spec, texels)
            known = surface.flags & ~np.uint8(FALLBACK | UNMOVED)
            surfaces[index] = replace(surface, temperature=temperature, flags=known | flags)
        own, mapped = replace(self.spec, temperature=spec), None
        if moves:
            ground = surfaces[: self.terrain_count]
            mapped = tuple(surface.temperature for surface in ground)
            surfaces[: self.terrain_count] = [
                replace(surface, temperature=np.full_like(surface.temperature, np.nan)) for surface in ground
            ]
        if moves or spec.source == "balance" or told:
            # The sun stands where it does at the instant that is solved.
            own = replace(own, sun=None)
        return replace(
            self, spec=own, surfaces=tuple(surfaces), report=report, mapped=mapped, moved_report={}, told_map=told
        )

    def _marched_words(self) -> str:
        if self.told:
            return "a learned map that is told hour and weather"
        return "source='balance'" if self.balanced else "a map that is moved to another time"

    def _refuse_balance(self, key: str) -> None:
        """Raise where a heat balance has no weather or no place."""
        why = f"{self.where}: temperature.{key} "
        if self.spec.weather is None:
            raise ThermorenderError(f"{why}needs the weather; add [weather] with time and one of file, epw, air_high_c")
        if self.frame is None:
            raise ThermorenderError(
                f"{why}needs a place, which a mesh does not have; add [frame] with latitude_deg, longitude_deg and "
                "height_m"
            )

    def with_learned_materials(self, spec: EmissivitySpec) -> "Scene":
        """Return this scene with its terrain's materials told from the orthophoto, as of a source "learned".

        Raises
        ------
        ThermorenderError
            A terrain without an orthophoto, or a map that cannot be used.
        """
        if not self.spec.terrain.orthophoto:
            raise ThermorenderError(
                f"{self.where}: a learned emissivity map reads materials from an orthophoto; add terrain.orthophoto"
            )
        folder, first = self.spec.folder, self.surfaces[0]
        own = folder / "materials"
        materials = _Materials(material_tables.load_library(own if own.is_dir() else None), self.camera, self.where)
        # Those of objects keep their numbers.
        materials.used = list(self.materials)
        report: dict[str, Any] = {}
        changed = replace(self.spec, emissivity=spec)
        valid = (first.flags & FILLED) == 0
        number, unknown = _learned_map(changed, materials, first.colour, valid, first.texel_m, report)
        flags = (first.flags & ~np.uint8(UNKNOWN)) | np.where(unknown, UNKNOWN, 0).astype(np.uint8)
        ground = replace(first, material=number, flags=flags)
        return replace(
            self, spec=changed, surfaces=(ground, *self.surfaces[1:]), materials=tuple(materials.used),
            emissivity_report=report,
        )  # fmt: skip

    def with_object_temperatures(self, kelvin: Mapping[str, float]) -> "Scene":
        """Return this scene with static objects of these names at other temperatures [K].

        Raises
        ------
        ThermorenderError
            A temperature that no object has.
        """
        for name, value in kelvin.items():
            scene_kelvin(f"object {name!r}: temperature", value)
        made = [
            replace(surface, temperature=np.full_like(surface.temperature, kelvin[name])) if name in kelvin else surface
            for surface in self.surfaces[self.terrain_count :]
            for name in (surface.name.split(":")[0],)
        ]
        return replace(self, surfaces=(*self.surfaces[: self.terrain_count], *made))

    def with_air(self, standard: str, aerosol: str = "none") -> "Scene":
        """Return this scene under a standard atmosphere, in place of its own sky or air.

        Parameters
        ----------
        standard, aerosol : str
            As `Atmosphere.standard`.
        """
        air = AtmosphereSpec(standard=standard, aerosol=aerosol)
        spec = replace(self.spec, sky_temperature=None, atmosphere=air)
        return replace(self, spec=spec, air=declared_air(air, self.camera.band_um, self.name))

    def digest(self) -> str:
        """Return a fingerprint (hex) of everything a frame of this scene depends on."""
        # Libraries change how NumPy writes numbers, for the whole process.
        with np.printoptions(legacy=False):
            return self._digest()

    def _digest(self) -> str:
        state = hashlib.blake2b(digest_size=16)
        own = [surface for tracked in self.tracked_objects for surface in tracked.surfaces]
        for surface in (*self.surfaces, *own):
            for item in fields(surface):
                value = getattr(surface, item.name)
                state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        for material in self.materials:
            state.update(material.name.encode() + material.wavelength_um.tobytes() + material.emissivity.tobytes())
            for table in (material.cosines, material.emissivity_by_angle):
                state.update(b"" if table is None else table.tobytes())
            layers = material.thermal.layers if material.thermal else ()
            state.update(repr((material.solar_absorptance, [layer.values for layer in layers])).encode())
        for tracked in self.tracked_objects:
            state.update(repr((tracked.item, tracked.lift_m)).encode() + tracked.time_s.tobytes())
            for name, values in tracked.columns.items():
                state.update(name.encode() + values.tobytes())
        spec = self.spec
        state.update(repr((self.camera, spec.sky_temperature, spec.surroundings_temperature)).encode())
        if self.air:
            state.update(repr((self.air.cloud_fraction, self.air.cloud_base_m, self.altitude_m, spec.sun)).encode())
            for item in fields(self.air):
                if isinstance(value := getattr(self.air, item.name), np.ndarray):
                    state.update(value.tobytes())
        if self.marched:
            state.update(repr((self.time, spec.temperature, spec.weather)).encode() + self.weather_digest().encode())
        for values in self.mapped or ():
            state.update(values.tobytes())
        if self.told:
            # At this instant another map may give the same, and differ at others of a flight.
            state.update(self.told_map.digest().encode())
        return state.hexdigest()

    def weather_digest(self) -> str:
        """Return a fingerprint (hex) of the weather: its series, its place and what was filled in."""
        state = hashlib.blake2b(digest_size=16)
        with np.printoptions(legacy=False):
            for item in fields(self.weather):
                value = getattr(self.weather, item.name)
                state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        return state.hexdigest()

    def __str__(self) -> str:
        faces = sum(len(surface.faces) for surface in self.surfaces)
        texels = sum(surface.material.size for surface in self.surfaces)
        lines = [
            f"{self.name}: {self.spec.title}",
            f"  mesh          {faces} triangles, {texels} texels of {self.surfaces[0].texel_m:.3g} m",
            f"  temperature   {self.spec.temperature.source}, {self._temperature_words()}",
            f"  materials     {self._materials_words()}",
            f"  sky           {self._sky_words()}",
            f"  objects       {', '.join(item.name for item in self.spec.objects) or 'none'}",
            f"  camera        {self.camera.name}, {self.camera.width}×{self.camera.height}",
        ]
        if self.frame:
            lines.insert(2, f"  origin        {self.frame.latitude_deg:.6f}°, {self.frame.longitude_deg:.6f}°, "
                            f"{self.frame.height_m:g} m above the ellipsoid")  # fmt: skip
        return "\n".join(lines)

    def _temperature_words(self) -> str:
        if not self.warmed:
            return f"to be solved for {utc_text(self.time)}"
        terrain = np.concatenate([s.temperature.ravel() for s in self.surfaces[: self.terrain_count]])
        return f"{terrain.min():.1f}–{terrain.max():.1f} K" + (f" at {utc_text(self.time)}" if self.marched else "")

    def _sky_words(self) -> str:
        if self.air is None:
            return f"{self.spec.sky_temperature:g} K"
        return f"that of {self.air}, {self.altitude_m:.0f} m above sea level"

    def _materials_words(self) -> str:
        pure = [material.name for material in self.materials if not isinstance(material, Mixture)]
        mixes, report = len(self.materials) - len(pure), self.emissivity_report
        words = ", ".join(pure) + (f" and {mixes} mixes of them" if mixes else "")
        if report:
            words += (
                f"; told from colour by {report['model']!r}, {report['share_unknown']:.1%} unknown and taken for "
                f"{report['fallback']}"
            )
        return words


def scene_folder(name: str | PathLike[str]) -> Path:
    """Return the folder of a scene given by path, or by the name of a shipped one.

    Raises
    ------
    ThermorenderError
        Neither exists; the message lists the shipped scenes.
    """
    path = Path(name)
    if (path / "scene.toml").is_file() or path.name == "scene.toml":
        return path
    shipped = data_folder("scenes")
    if (shipped / str(name) / "scene.toml").is_file() and len(Path(name).parts) == 1:
        return shipped / str(name)
    known = ", ".join(sorted(item.parent.name for item in shipped.glob("*/scene.toml")))
    what = "holds no scene.toml" if path.is_dir() else "is a file" if path.exists() else "does not exist"
    raise ThermorenderError(f"scene {str(name)!r} {what}; give a folder with a scene.toml or one of {known}")


def load_scene(name: str | PathLike[str]) -> Scene:
    """Return the Scene of a folder, or of a shipped scene by name.

    Parameters
    ----------
    name : path or str
        Folder holding `scene.toml`, or "heath", "village", "ridge".

    Raises
    ------
    ThermorenderError
        Anything in the scene file or the files it names that cannot be used, in one sentence.
    """
    spec = read_scene(scene_folder(name))
    library = material_tables.load_library(
        spec.folder / "materials" if (spec.folder / "materials").is_dir() else None
    )
    where = str(spec.folder / "scene.toml")
    camera = load_camera(spec.camera, f"{where}: camera.model")
    materials = _Materials(library, camera, where)
    emissivity_report: dict[str, Any] = {}
    frame: LocalFrame | None
    grid: Grid | None
    if spec.terrain.elevation:
        frame, grid, surfaces = _raster_terrain(spec, materials, emissivity_report)
    else:
        frame, grid, surfaces = _mesh_terrain(spec, materials)
    scene = Scene(
        spec, frame, tuple(surfaces), len(surfaces), (), camera, grid,
        air=declared_air(spec.atmosphere, camera.band_um, where), emissivity_report=emissivity_report,
        time=spec.weather.time if spec.weather else None,
    )  # fmt: skip
    objects = [_object(item, materials, spec.folder) for item in spec.objects]
    static = [surface for one in objects if not one.item.track for surface in _in_scene(one, one.at(0.0), scene)]
    tracked = [one for one in objects if one.item.track]
    along = [surface for one in tracked for values in one.stations() for surface in _in_scene(one, values, scene)]
    if scene.air is not None:
        highest = max(surface.vertices[:, 2].max() for surface in (*scene.surfaces, *static, *along))
        scene.air.refuse_above_clouds(f"{where}: the highest surface", scene.altitude_m + float(highest))
    terrain_surfaces, done = refined(scene.surfaces, static + along)
    terrain_surfaces = [evened(surface) for surface in terrain_surfaces]
    static = done[: len(static)]
    tracked_objects = tuple(replace(one, surfaces=tuple(refined((), one.surfaces)[1])) for one in tracked)
    scene = replace(
        scene, surfaces=(*terrain_surfaces, *static), tracked_objects=tracked_objects, materials=tuple(materials.used)
    )
    return scene.with_temperature(spec.temperature)


class _Materials:
    """Materials a scene uses, in the order of their first use; each checked against the camera's band."""

    def __init__(self, library: Mapping[str, Material], camera: Camera, where: str) -> None:
        self.library, self.camera, self.where = library, camera, where
        self.used: list[Material] = []

    def index(self, name: str, key: str) -> int:
        found = material_tables.find(self.library, name, f"{self.where}: {key}")
        return self.add(found)

    def add(self, material: Material) -> int:
        if material not in self.used:
            try:
                material.emissivity_at(np.array(self.camera.band_um))
            except ThermorenderError as error:
                raise ThermorenderError(f"{self.where}: {error}") from None
            if len(self.used) == MOST_MATERIALS:
                raise ThermorenderError(
                    f"{self.where}: {material.name!r} would be the scene's material number {len(self.used) + 1}; a "
                    f"scene may use up to {MOST_MATERIALS}, mixes of a learned emissivity map included, so give fewer"
                )
            self.used.append(material)
        return self.used.index(material)


def _raster_terrain(
    spec: SceneSpec, materials: _Materials, report: dict[str, Any]
) -> tuple[LocalFrame, Grid, list[Surface]]:
    source = spec.terrain
    height, grid = terrain.read_elevation(source.elevation)
    if source.height_reference == "geoid":
        height = height + (source.geoid_undulation_m or 0.0)
    height, made = terrain.filled(height) if source.fill else (height, None)
    frame = LocalFrame(*spec.frame) if spec.frame else terrain.frame_of(height, grid)
    texels = _texel_grid(spec, grid)
    if texels.crs != grid.crs:
        raise ThermorenderError(
            f"{texels.name} has CRS {texels.crs.to_string()} but {grid.name} has {grid.crs.to_string()}; bring both "
            "together with `thermorender import-terrain`"
        )
    _require_overlap(texels, grid)
    try:
        vertices, faces, uv = terrain.mesh(height, grid, frame, texels)
    except MemoryError:
        raise ThermorenderError(
            f"{source.elevation} has {grid.width}×{grid.height} posts, for whose mesh this machine's memory is not "
            "enough; thin it with `thermorender import-terrain --max-vertices`"
        ) from None
    away = np.linalg.norm(vertices, axis=-1).min()
    if away > FARTHEST_M:
        raise ThermorenderError(
            f"{materials.where}: frame lies {away / 1e3:.0f} km from {grid.name}; "
            "give a position on it, or leave [frame] out"
        )
    shape = (texels.height, texels.width)
    valid = np.ones(shape, dtype=bool)
    if spec.emissivity.source == "learned" and not source.orthophoto:
        raise ThermorenderError(
            f"{materials.where}: emissivity.source='learned' reads materials from an orthophoto; add terrain.orthophoto"
        )
    if source.orthophoto:
        colour, valid = read_colour(source.orthophoto)
        if not valid.any():
            raise ThermorenderError(f"{source.orthophoto} is empty: every texel is masked; give another orthophoto")
    texel_m = terrain.texel_size_m(texels, frame)
    unknown = np.zeros(shape, dtype=bool)
    if spec.emissivity.source == "learned":
        material, unknown = _learned_map(spec, materials, colour, valid, texel_m, report)
    else:
        material, known = _material_map(spec, materials, texels)
        valid &= known
    if not source.orthophoto:
        typical = np.array([m.colour for m in materials.used], dtype=np.uint8)
        colour = typical[material]
    if not valid.all():
        index = nearest_valid(valid)
        colour, material = fill(colour, index), fill(material, index)
    if made is not None:
        valid &= onto(made.astype(np.float32), grid, texels, "max") != 1.0
    surface = Surface(
        name="terrain",
        vertices=vertices,
        faces=faces,
        uv=uv,
        colour=colour,
        material=material,
        temperature=np.full(shape, np.nan, np.float32),
        flags=(SURFACE | np.where(valid, 0, FILLED) | np.where(unknown, UNKNOWN, 0)).astype(np.uint8),
        texel_m=texel_m,
    )
    return frame, texels, [surface]


def _texel_grid(spec: SceneSpec, elevation_grid: Grid) -> Grid:
    """The finest description of the ground sets the texels: orthophoto, else classes, else temperature."""
    for path in (spec.terrain.orthophoto, spec.emissivity.raster, spec.temperature.raster):
        if path:
            return grid_of(path)
    return elevation_grid


def _require_overlap(one: Grid, other: Grid) -> None:
    a, b = bounds_in(other.crs, one), other.bounds
    if min(a[2], b[2]) <= max(a[0], b[0]) or min(a[3], b[3]) <= max(a[1], b[1]):
        raise ThermorenderError(
            f"{one.name} covers {_extent(a)} and {other.name} covers {_extent(b)}: they do not overlap; "
            "give rasters of the same area"
        )


def _extent(bounds: tuple[float, ...]) -> str:
    return f"x {bounds[0]:.0f}…{bounds[2]:.0f}, y {bounds[1]:.0f}…{bounds[3]:.0f}"


def _material_map(spec: SceneSpec, materials: _Materials, texels: Grid) -> _Map:
    """(material index (h, w) uint8, known (h, w) bool) of the terrain's texels."""
    source = spec.emissivity
    shape = (texels.height, texels.width)
    if source.source != "classes":
        return np.full(shape, _single_material(source, materials), np.uint8), np.ones(shape, dtype=bool)
    grid = grid_of(source.raster)
    _require_overlap(grid, texels)
    classes = onto(read_classes(source.raster), grid, texels, "nearest")
    lookup = np.full(256, 255, dtype=np.uint8)
    for value, name in source.classes.items():
        lookup[value] = materials.index(name, f"emissivity.classes.{value}")
    present = np.unique(classes)
    for value in present[present != 0]:
        if value not in source.classes:
            raise ThermorenderError(
                f"{source.raster} holds class {value}, which emissivity.classes of {materials.where} does not name; "
                "add it there (0 marks no data)"
            )
    material = lookup[classes]
    known = classes != 0
    if not known.any():
        raise ThermorenderError(f"{source.raster} has no class in it, only 0 (no data); give a raster of class numbers")
    return np.where(known, material, 0).astype(np.uint8), known


def _learned_map(
    spec: SceneSpec, materials: _Materials, colour: NDArray[np.uint8], valid: NDArray[np.bool_], texel_m: float,
    report: dict[str, Any],
) -> _Map:  # fmt: skip
    """(material index (h, w) uint8, unknown (h, w) bool) of the terrain's texels, told from their colour."""
    if not valid.all():
        colour = fill(colour, nearest_valid(valid))
    number, used, unknown, told = learned_materials(
        spec.emissivity, materials.library, colour, valid, texel_m, materials.camera.band_um, materials.where
    )
    report.update(told)
    return np.array([materials.add(material) for material in used], dtype=np.uint8)[number], unknown


def _single_material(source: EmissivitySpec, materials: _Materials) -> int:
    if source.source == "material" and source.material:
        return materials.index(source.material, "emissivity.material")
    return materials.add(grey("constant", source.value))


def _mesh_terrain(spec: SceneSpec, materials: _Materials) -> tuple[LocalFrame | None, None, list[Surface]]:
    if spec.emissivity.source in ("classes", "learned"):
        raise ThermorenderError(
            f"{materials.where}: emissivity.source={spec.emissivity.source!r} needs an elevation raster; give "
            "'constant' or 'material'"
        )
    index = _single_material(spec.emissivity, materials)
    surfaces = [_part_surface(part, index, np.nan) for part in mesh.load(spec.terrain.mesh, spec.folder)]
    return (LocalFrame(*spec.frame) if spec.frame else None), None, surfaces


def _part_surface(part: mesh.Part, material: int, temperature: float) -> Surface:
    shape = part.colour.shape[:2]
    corners = part.vertices[part.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1).sum()
    return Surface(
        name=part.name,
        vertices=part.vertices,
        faces=part.faces,
        uv=part.uv,
        colour=part.colour,
        material=np.full(shape, material, np.uint8),
        temperature=np.full(shape, temperature, np.float32),
        flags=np.full(shape, SURFACE, np.uint8),
        texel_m=float(np.sqrt(area / (shape[0] * shape[1]))),
    )


def _object(item: ObjectSpec, materials: _Materials, folder: Path) -> TrackedObject:
    """The TrackedObject of one object: its surfaces in its own frame, and its track; one row where it has none."""
    if item.shape:
        vertices, faces = mesh.primitive(item.shape, item.size)
        colour = np.array(item.colour, dtype=np.uint8).reshape(1, 1, 3)
        parts = [mesh.Part(item.shape, vertices, faces, np.full((len(faces), 3, 2), 0.5, np.float32), colour)]
    else:
        parts = mesh.load(item.file, folder)
    # A flat object lies a finger above the ground it covers, so that neither hides the other.
    lift = 0.02 if item.shape == "disc" else 0.0
    material = materials.index(item.material, f"object {item.name!r}")
    surfaces = (
        _part_surface(replace(part, name=f"{item.name}:{part.name}"), material, item.temperature) for part in parts
    )
    time_s, columns = read_track(item.track) if item.track else (np.zeros(1), {})
    return TrackedObject(item, tuple(surfaces), lift, time_s, columns)


def _in_scene(tracked: TrackedObject, values: Mapping[str, float], scene: Scene) -> list[Surface]:
    """Surfaces of an object in the scene's frame, for values as by `TrackedObject.at`."""
    try:
        matrix = tracked.world_from_own(values, scene.ground)
    except ThermorenderError as error:
        raise ThermorenderError(f"{scene.where}: {error}") from None
    return [
        replace(surface, vertices=surface.vertices @ matrix[:3, :3].T + matrix[:3, 3]) for surface in tracked.surfaces
    ]
