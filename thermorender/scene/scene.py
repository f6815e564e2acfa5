"""The Scene: an immutable value that returns other scenes by its edits.

An edit changes what the scene declares; `thermorender.scene.stages` makes the rest follow. So edits may come in any
order. Two edits of the same thing are the exception, and the last one counts: `with_sky` and `with_air`, `at` and
`with_weather(time=…)`, an edit and itself.
"""

import hashlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.learned.temperature_map import TemperatureMap
from thermorender.materials.material import Material
from thermorender.scene import stages, text
from thermorender.scene.arguments import (
    changed_object,
    checked_spec,
    flags_argument,
    kelvin_argument,
    material_of,
    number_of,
    objects_under,
    refuse_other,
    surface_temperatures,
    surfaces_argument,
    temperature_spec,
    weather_argument,
)
from thermorender.scene.cover import OBJECT, SURFACE_OF_MESH, Cover, Painted
from thermorender.scene.declared import Declared
from thermorender.scene.folder import of_ground
from thermorender.scene.georeference import place_of
from thermorender.scene.patch import Patch, areas, numbered, texels_in
from thermorender.scene.pipeline import Values
from thermorender.scene.shape import Shape
from thermorender.scene.spec import WEATHER, AtmosphereSpec, EmissivitySpec, SceneSpec, SunSpec, TemperatureSpec
from thermorender.scene.surface import FALLBACK, UNMOVED, Surface, scene_kelvin
from thermorender.scene.temperature import learned_map
from thermorender.scene.temperature_state import Available, Moved
from thermorender.scene.terrain_temperature import Temperatures
from thermorender.schema import Where, did_you_mean, every_field, read
from thermorender.sensor.camera import Camera, load_camera
from thermorender.trajectory.path import pose
from thermorender.units import Number, instant, utc_text, with_unit

if TYPE_CHECKING:
    from thermorender.physics.geodesy import LocalFrame
    from thermorender.scene.world import World, WorldGround
    from thermorender.weather.series import Weather

_T = TypeVar("_T")


class _Result(Generic[_T]):
    """The value of a stage, as an attribute of the scene."""

    def __init__(self, stage: Callable[..., _T]) -> None:
        self.name, self.__doc__ = stage.__name__, stage.__doc__

    @overload
    def __get__(self, scene: None, owner: type) -> "_Result[_T]": ...

    @overload
    def __get__(self, scene: "Scene", owner: type) -> _T: ...

    def __get__(self, scene: "Scene | None", owner: type) -> "_Result[_T] | _T":
        return self if scene is None else scene._values[self.name]


class Scene:
    """Everything a render needs, as `load_scene` returns it; compared by identity.

    Attributes
    ----------
    spec : SceneSpec
        The scene file with those edits that it has keys for.
    camera : Camera
    time : datetime64[s] or None
        The instant requested, or that the temperatures were solved for, UTC; None without [weather].
    frame : LocalFrame or None
        Position of the local East-North-Up frame on Earth; None for a mesh without [frame].
    grid : Grid or None
        Map grid of the terrain's texels.
    surfaces : tuple of Surface
        The terrain's first, then one or more per static object.
    terrain_count : int
        How many of them are terrain.
    solved_count : int
        How many of them have temperatures that the heat balance solves: the terrain, and objects of that kind.
    materials : tuple of Material
        Indexed by `Surface.material`.
    air : Atmosphere or None
        The declared air in the camera's band.
    tracked_objects : tuple of TrackedObject
        Objects with a track.
    temperature_state : Available or Pending
        Whether the terrain's temperatures are known, and the source of those that follow the weather.
    emissivity_report : dict
        Report of the learned emissivity map; empty without one.
    where : str
        Path of the scene file, for messages.
    altitude_m : float
        Altitude of the local frame's origin above sea level [m]: as declared, else from the frame, else 0.
    geoid_undulation_m : float or None
        Height of the geoid above the ellipsoid that this scene declares [m].
    surroundings_temperature : float
        Temperature of the black background beyond the terrain's edge [K]: as stated, else its texels' mean.
    sun : SunSpec or None
        The sun that shines on the scene: the declared one, or that of the weather at `time`, through air if its direct
        irradiance is above 120 W m⁻². Until temperatures that follow the weather are solved there is none.
    weather : Weather
        The weather that the scene declares, at its own place; read when first asked for.
    ground : callable
        (east, north) → local height of the terrain [m], NaN off it.
    surface_notes : tuple of str
        Sentences on objects that are partly under the ground, and on those that share a plane with another surface.
    """

    _declared: Declared
    _values: Values

    frame = _Result(stages.frame)
    grid = _Result(stages.grid)
    surfaces = _Result(stages.surfaces)
    terrain_count = _Result(stages.terrain_count)
    solved_count = _Result(stages.solved_count)
    materials = _Result(stages.materials)
    air = _Result(stages.air)
    tracked_objects = _Result(stages.tracked_objects)
    temperature_state = _Result(stages.temperature_state)
    emissivity_report = _Result(stages.emissivity_report)
    where = _Result(stages.where)
    altitude_m = _Result(stages.altitude_m)
    geoid_undulation_m = _Result(stages.geoid_undulation_m)
    surroundings_temperature = _Result(stages.surroundings_temperature)
    sun = _Result(stages.sun)
    weather = _Result(stages.noted_weather)
    ground = _Result(stages.ground)
    surface_notes = _Result(stages.surface_notes)

    def __init__(self, declared: Declared, values: Values | None = None) -> None:
        vars(self).update(_declared=declared, _values=values or Values(stages.PIPELINE, declared.inputs))

    @classmethod
    def of_surfaces(
        cls, spec: SceneSpec, surfaces: Sequence[Surface], materials: Sequence[Material], camera: Camera,
        terrain_count: int | None = None,
    ) -> "Scene":  # fmt: skip
        """Return the Scene of surfaces made in memory, without files, place or objects.

        Parameters
        ----------
        spec : SceneSpec
            Its sky, surroundings and title are used.
        surfaces : sequence of Surface
            The terrain's first, with their temperatures.
        materials : sequence of Material
            Indexed by `Surface.material`.
        camera : Camera
        terrain_count : int, optional
            How many of the surfaces are terrain; all by default.
        """
        count = len(surfaces) if terrain_count is None else terrain_count
        ground, static = tuple(surfaces[:count]), tuple(surfaces[count:])
        highest_m = max(float(surface.heights_m().max()) for surface in surfaces)
        shape = Shape(None, ground, static, (), (), (), highest_m)
        painted = tuple(Painted(each.material, each.colour, each.flags) for each in ground)
        declared = Declared(replace(spec, atmosphere=None), camera, last_sky=spec.sky_temperature)
        return cls(stages.made_in_memory(declared, shape, Cover((), painted, (), {}), tuple(materials)))

    def _edited(self, declared: Declared, given: Mapping[str, Any] | None = None) -> "Scene":
        return Scene(declared, self._values.edited(declared.inputs, given))

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        raise ThermorenderError(f"scene.{name} cannot be set; {_EDITS}")

    def __delattr__(self, name: str) -> NoReturn:
        raise ThermorenderError(f"scene.{name} cannot be deleted; {_EDITS}")

    def __replace__(self, **changes: Any) -> NoReturn:
        raise ThermorenderError(f"replace(scene, {', '.join(changes)}=…) would leave parts of it stale; {_EDITS}")

    @property
    def spec(self) -> SceneSpec:  # noqa: D102 - as the attributes of the class say
        return self._declared.spec

    @property
    def camera(self) -> Camera:  # noqa: D102
        return self._declared.camera

    @property
    def time(self) -> "np.datetime64 | None":  # noqa: D102
        return self._declared.time

    @property
    def name(self) -> str:
        """Name of the scene's folder."""
        return str(self.spec.folder.name)

    @property
    def main_surface(self) -> Surface:
        """The terrain's Surface with the most texels: its raster, or the ground of a mesh in whose texels figures and
        notes are."""
        return max(self.near_ground, key=lambda surface: surface.material.size)

    @property
    def texel_m(self) -> float:
        """Side of the terrain's finest texels on the ground [m]."""
        return self.main_surface.texel_m if self.world is None else self.world.grid.texel

    @property
    def near_ground(self) -> tuple[Surface, ...]:
        """The terrain's Surfaces without the far ground around the scene."""
        return tuple(surface for surface in self.surfaces[: self.terrain_count] if not surface.far)

    @property
    def sky_temperature(self) -> float:
        """Temperature of the isotropic black sky with the radiance of the scene's sky in the camera's band [K]."""
        if self.air is not None:
            return float(self.air.sky_temperature(self.altitude_m))
        assert self.spec.sky_temperature is not None
        return float(self.spec.sky_temperature)

    def sky_temperature_in(self, band_um: tuple[float, float]) -> float:
        """Return `sky_temperature` as it is in another band than the camera's, such as a learned map's [µm]; a declared
        sky is black.

        Raises
        ------
        ThermorenderError
            The scene's air does not cover the band.
        """
        if self.air is None or tuple(band_um) == tuple(self.camera.band_um):
            return self.sky_temperature
        now, values = self._declared, self._values
        try:
            air = stages.air(
                now.given_air, now.spec.atmosphere, values["air_of_weather"], (band_um[0], band_um[1]),
                lambda: values["weather_now"], self.where,
            )  # fmt: skip
        except ThermorenderError:
            raise ThermorenderError(
                f"{self.where}: a learned map of {band_um[0]:g}–{band_um[1]:g} µm needs the sky of this band, which "
                "the scene's air does not cover; give air that covers it, or take a map of the camera's band"
            ) from None
        assert air is not None
        return float(air.sky_temperature(self.altitude_m))

    @property
    def world(self) -> "World | None":
        """The tiled ground of which the terrain is an overview; None for others."""
        files = self._declared.files
        return None if files is None else files.world

    def on_world(self, world: "World") -> "Scene":
        """Return this scene on a tiled ground, whose sources may be made in memory."""
        files = replace(of_ground(world, world.overview()), world=world)
        return self._edited(replace(self._declared, files=files))

    def not_on_tiles(self, what: str, other: str = "") -> ThermorenderError:
        """Return the error of what a tiled ground does not have."""
        return ThermorenderError(
            f"{self.where}: {what} needs a scene of one raster, and this one has terrain.tiles; {other}cut a part out "
            "of its rasters with `thermorender import-terrain --around`"
        )

    def refuse_tiles(self, what: str, other: str = "") -> None:
        """Raise if the ground is tiled; `other` begins the advice."""
        if self.world is not None:
            raise self.not_on_tiles(what, other)

    def on_ground(self, ground: "WorldGround") -> "Scene":
        """Return this scene on a part of its tiled ground, lit by the same sun, sky and air."""
        world = self.world
        assert world is not None
        return self._edited(replace(self._placed(ground.frame), files=of_ground(world, ground)))

    def of_tiles(self, surfaces: Sequence[Surface], frame: "LocalFrame") -> "Scene":
        """Return this scene with tiles of its ground in another frame, at the temperatures in their texels."""
        shape = Shape(frame, tuple(surfaces), (), (), (), (), max(float(each.heights_m().max()) for each in surfaces))
        painted = tuple(Painted(each.material, each.colour, each.flags) for each in surfaces)
        now = self._placed(frame)
        spec = replace(
            now.spec, temperature=TemperatureSpec("constant", value=300.0), sun=self._sun_in(now.given_weather)
        )
        return self._edited(
            stages.made_in_memory(replace(now, spec=spec), shape, Cover((), painted, (), {}), self.materials)
        )

    def _placed(self, frame: "LocalFrame") -> Declared:
        """Declarations of this scene at another place, under the same weather and air."""
        now, own = self._declared, self.frame
        assert own is not None
        higher_m = frame.height_m - own.height_m
        spec = replace(now.spec, surroundings_temperature=self.surroundings_temperature)
        if spec.atmosphere is not None and spec.atmosphere.altitude_m is not None:
            altitude_m = spec.atmosphere.altitude_m + higher_m
            spec = replace(spec, atmosphere=replace(spec.atmosphere, altitude_m=altitude_m))
        place_m = None if now.place_altitude_m is None else now.place_altitude_m + higher_m
        weather = None if spec.weather is None else replace(
            self._values["weather"], latitude_deg=frame.latitude_deg, longitude_deg=frame.longitude_deg
        )  # fmt: skip
        return replace(now, spec=spec, place_altitude_m=place_m, given_weather=weather, given_air=self.air)

    def _sun_in(self, weather: "Weather | None") -> SunSpec | None:
        """The sun that shines on this scene, at the place of a weather."""
        if self.sun is None or weather is None or not self.temperature_state.weather_driven:
            return self.sun
        assert self.time is not None
        azimuth, elevation = map(float, weather.sun(self.time))
        return SunSpec(elevation, azimuth)

    def with_true_temperature(self) -> "Scene":
        """Return this scene at the true temperatures of its terrain: those of [truth], or of the heat balance without.

        Raises
        ------
        ThermorenderError
            The scene has neither.
        """
        truth, file = self.spec.truth_temperature, self._declared.of_file
        if truth is None and not self.balanced:
            if file is not None and file.truth_temperature is not None and file.weather is not None:
                raise ThermorenderError(
                    f"{self.where}: its truth is of {utc_text(file.weather.time)} and the weather of the file, not of "
                    "this scene's; leave time and weather as they are, or give the temperature 'balance'"
                )
            raise ThermorenderError(
                f"{self.where} has no truth.temperature; name a raster of kelvin there, or true where the temperatures "
                "of the file are true"
            )
        if truth is None:
            return self.with_temperature(self.spec.temperature)
        if isinstance(truth, Path):
            return self.with_temperature(TemperatureSpec(source="raster", raster=truth))
        assert file is not None
        found, own = self.with_temperature(file.temperature), {row.name: row.temperature for row in file.surfaces}
        surfaces = tuple(replace(one, temperature=own.get(one.name)) for one in self._declared.spec.surfaces)
        return found._edited(replace(found._declared, spec=replace(found._declared.spec, surfaces=surfaces)))

    @property
    def balanced(self) -> bool:
        """Whether the terrain's temperatures come from a heat balance."""
        return bool(self.spec.temperature.source == "balance")

    @cached_property
    def sky_notes(self) -> tuple[str, ...]:
        """Sentences on a declared air or sky that contradicts the scene's weather; none without [weather]."""
        from thermorender.scene import notes

        if self.spec.weather is None or (self._declared.given_weather is None and self.frame is None):
            return ()
        return notes.of_sky(self)

    @cached_property
    def weather_notes(self) -> tuple[str, ...]:
        """Notes on filled gaps of the weather, a short record before `time`, snow, likely snow, rooms and albedo."""
        from thermorender.scene import notes

        return notes.of_weather(self)

    def pose(
        self, east: Number, north: Number, above_ground_m: Number, yaw_deg: Number = 0.0, pitch_deg: Number = 0.0,
        roll_deg: Number = 0.0, look_at: ArrayLike | None = None,
    ) -> NDArray[np.float64]:  # fmt: skip
        """Return world_from_camera, (4, 4), of a camera above this scene's ground, as `--pose` on the command line.

        Parameters
        ----------
        east, north, above_ground_m : float
            Position: local east and north [m], and height above the terrain there [m].
        yaw_deg, pitch_deg, roll_deg : float
            As of `thermorender.pose` [deg].
        look_at : (3,) floats, optional
            Point on the optical axis, in place of yaw and pitch: east, north, and height above the ground there [m].

        Raises
        ------
        ThermorenderError
            A position or point off the terrain, a camera under it, or angles that contradict `look_at`.
        """
        here = east, north, above_ground_m
        if above_ground_m < 0.0:
            raise ThermorenderError(
                f"pose={here!r} is {-above_ground_m:.6g} m under the terrain; give metres above the ground, or local "
                "up to tr.pose"
            )
        up = self._local_up("pose", here)
        if look_at is not None and np.shape(look_at) == (3,):
            point = np.asarray(look_at).tolist()
            look_at = point[0], point[1], self._local_up("look_at", point)
        return pose(east, north, up, yaw_deg, pitch_deg, roll_deg, look_at)

    def _local_up(self, name: str, point: Sequence[Number]) -> float:
        ground = float(self.ground(float(point[0]), float(point[1])))
        if ground != ground:
            raise ThermorenderError(
                f"{name}={tuple(point)!r} is outside the terrain; move it, or give local up (tr.pose, --local-up)"
            )
        return ground + float(point[2])

    @cached_property
    def targets(self) -> dict[str, NDArray[np.float64]]:
        """{name: (3,) local position of its middle [m]} of the static objects that are one body, not a table of
        them."""
        found = {}
        for item in (item for item in self.spec.objects if item.track is None and item.instances is None):
            corners = np.concatenate(
                [s.vertices for s in self.surfaces[self.terrain_count :] if s.name.split(":")[0] == item.name]
            )
            found[item.name] = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        return found

    def with_camera(self, camera: str | PathLike[str] | Camera) -> "Scene":
        """Return this scene seen by another camera: air and learned materials follow its band.

        Parameters
        ----------
        camera : str, path or Camera
            The name of a shipped model, the path of a TOML file, or a Camera.

        Raises
        ------
        ThermorenderError
            An unknown camera, or a band that the scene's air or materials do not cover.
        """
        if not isinstance(camera, (str, PathLike, Camera)):
            raise ThermorenderError(
                f"with_camera was given a {type(camera).__name__}; give the name of a camera, the path of a TOML file "
                "or a Camera"
            )
        own = camera if isinstance(camera, Camera) else load_camera(camera, "with_camera: camera")
        name = camera.name if isinstance(camera, Camera) else str(camera)
        spec = replace(self._declared.spec, camera=name)
        return self._edited(replace(self._declared, camera=own, spec=spec))

    def with_air(self, air: str | AtmosphereSpec | Atmosphere | None, aerosol: str = "none") -> "Scene":
        """Return this scene under another air, which replaces its sky or air.

        Parameters
        ----------
        air : str, AtmosphereSpec, Atmosphere or None
            The name of a standard atmosphere, the keys of [atmosphere], or an Atmosphere that covers the camera's band.
            None: no air, under the sky that was declared last.
        aerosol : str
            Of a standard atmosphere, as `Atmosphere.standard`.

        Raises
        ------
        ThermorenderError
            An unknown air, one that does not cover the camera's band, or no air for a scene that declares no sky.

        Notes
        -----
        The altitude that the scene file states in [atmosphere] is of the place and stays.
        """
        now = self._declared
        if air is None:
            if now.last_sky is None:
                raise ThermorenderError(
                    f"{now.where}: with_air(None) leaves the scene without a sky; call with_sky(kelvin) instead"
                )
            return self.with_sky(now.last_sky)
        if isinstance(air, str):
            air = AtmosphereSpec(standard=air, aerosol=aerosol)
        elif aerosol != "none":
            raise ThermorenderError(f"aerosol={aerosol!r} goes with a standard atmosphere's name only; leave it out")
        if isinstance(air, Atmosphere):
            spec = replace(now.spec, atmosphere=None, sky_temperature=None)
            return self._edited(replace(now, spec=spec, given_air=air))
        if not isinstance(air, AtmosphereSpec):
            raise ThermorenderError(
                f"with_air was given a {type(air).__name__}; give the name of a standard atmosphere, an "
                "AtmosphereSpec, an Atmosphere or None"
            )
        air = checked_spec(air, "with_air", now.spec.folder)
        if air.standard == WEATHER and now.spec.weather is None:
            raise ThermorenderError(
                f"{now.where}: with_air('weather') needs the weather, and this scene has none; call with_weather "
                "first, or name another air"
            )
        spec = replace(now.spec, atmosphere=air, sky_temperature=None)
        return self._edited(replace(now, spec=spec, given_air=None))

    def with_sky(self, kelvin: Number | str, surroundings: Number | str | None = None) -> "Scene":
        """Return this scene under an isotropic black sky and without air.

        Parameters
        ----------
        kelvin : float or str
            Temperature of the sky [K]; 0 for none, and below 100 K with its unit, "3 K".
        surroundings : float, optional
            Temperature of the black surroundings beyond the terrain [K]; by default it stays as it is.
        """
        now = self._declared
        follows = ", or call with_air('weather') for the air and sky of the weather"
        kelvin = number_of("with_sky: kelvin", with_unit(kelvin), follows)
        scene_kelvin("with_sky: kelvin", kelvin, allow_zero=True)
        around = now.spec.surroundings_temperature
        if surroundings is not None:
            around = number_of("with_sky: surroundings", with_unit(surroundings))
            scene_kelvin("with_sky: surroundings", around, allow_zero=True)
        spec = replace(now.spec, atmosphere=None, sky_temperature=kelvin, surroundings_temperature=around)
        return self._edited(replace(now, spec=spec, given_air=None, last_sky=kelvin))

    def with_sun(self, elevation_deg: Number | None, azimuth_deg: Number | None = None) -> "Scene":
        """Return this scene with the sun elsewhere.

        Parameters
        ----------
        elevation_deg : float or None
            Above the horizon [deg]; None: no sun.
        azimuth_deg : float, optional
            From north, eastward positive [deg]; by default that of the scene's own sun.

        Raises
        ------
        ThermorenderError
            An angle out of range, or a scene whose weather says where the sun stands. A sun without air is refused
            when the scene is rendered.
        """
        now, sun = self._declared, None
        if elevation_deg is not None:
            elevation_deg = number_of("with_sun: elevation_deg", elevation_deg)
            if azimuth_deg is None and now.spec.sun is not None:
                azimuth_deg = now.spec.sun.azimuth_deg
            if azimuth_deg is None:
                raise ThermorenderError(
                    f"with_sun(elevation_deg={elevation_deg:g}) has no azimuth, and the scene declares no sun; give "
                    "azimuth_deg, from north, eastward positive"
                )
            angles = {"elevation_deg": elevation_deg, "azimuth_deg": azimuth_deg}
            sun = read(SunSpec, angles, Where("with_sun"))
        return self._edited(replace(now, spec=replace(now.spec, sun=sun)))

    def at(self, time: "str | datetime | np.datetime64") -> "Scene":
        """Return this scene at another instant; temperatures that follow the weather become pending.

        A truth raster is of the scene's own instant and left out at any other.

        Parameters
        ----------
        time : str, datetime or datetime64
            Text or datetime with its zone; without one it is refused. A datetime64 has no zone and is UTC, as all
            instants of this package are. Fractions of a second are dropped.

        Raises
        ------
        ThermorenderError
            An invalid instant, a scene without [weather], or a learned map without a stated hour.
        """
        asked, now = instant("time", time), self._declared
        if now.spec.weather is None:
            raise ThermorenderError(
                f"{now.where}: time={utc_text(asked)} needs temperature.source='balance' with [weather], and this "
                f"scene's temperatures are of source={now.spec.temperature.source!r} without an hour; add both, or "
                "leave the time out"
            )
        if asked == now.time:
            return self
        if now.spec.temperature.source == "learned" and not self.temperature_state.weather_driven:
            raise ThermorenderError(
                f"{now.where}: time={utc_text(asked)} is not available from learned map "
                f"{now.spec.temperature.model!r}, which does not state the instant and weather of "
                "its training; add [temperature.trained] with the keys of [weather], or leave the time out"
            )
        self._warn_of_fixed_temperatures("time")
        return self._edited(now.under(replace(now.spec.weather, time=asked), now.given_weather))

    def with_weather(self, weather: Any = None, **keys: Any) -> "Scene":
        """Return this scene under another weather; temperatures that follow it become pending.

        A truth raster is of the scene's own weather and left out under any other.

        Parameters
        ----------
        weather : WeatherSpec or Weather, optional
            All keys of [weather], or the weather itself. A Weather comes with `time` where the scene has none.
        **keys
            Keys of [weather] to change, as the scene file has them: `wind_m_s=8`, `time="2018-07-28T12:00Z"`.

        Raises
        ------
        ThermorenderError
            An unknown key, a value out of range, or neither weather nor keys.
        """
        now = self._declared
        if weather is None and not keys:
            raise ThermorenderError("with_weather was given nothing; give a WeatherSpec, a Weather or keys to change")
        spec, series = weather_argument(weather, keys, now)
        self._warn_of_fixed_temperatures("the weather")
        return self._edited(now.under(spec, series))

    def _warn_of_fixed_temperatures(self, what: str) -> None:
        if not self.temperature_state.weather_driven:
            # A mesh may have temperatures for each of its surfaces.
            parts = any(part.temperature is not None for part in self.spec.surfaces)
            source = "of its surfaces" if parts else f"of source {self.spec.temperature.source!r}"
            follow = "; those of a heat balance do: give the temperature 'balance'" if self.spec.weather else ""
            warnings.warn(f"temperatures {source} do not change with {what}{follow}", ThermorenderWarning, stacklevel=3)

    def with_temperature(
        self,
        source: "TemperatureSpec | Number | str | PathLike[str] | TemperatureMap | Mapping[str, Any]",
        model: TemperatureMap | None = None, kelvin: Sequence[ArrayLike] | None = None,
    ) -> "Scene":  # fmt: skip
        """Return this scene with its terrain's temperatures from another source. Objects with the key
        `follows_balance` are solved with a heat balance, and have the file's kelvin under any other source.

        Parameters
        ----------
        source : TemperatureSpec, number, str, path, TemperatureMap or dict
            Kelvin for all texels, the path of a raster of kelvin, the name or path of a learned map, "balance", or the
            keys of [temperature]; it replaces the temperatures of all [[surface]] too. A dict gives parts of a mesh
            their own: {name of a node, group, material or texture: kelvin or the path of a raster in its pixels}.
        model : TemperatureMap, optional
            The learned map that `source` names, where it has been read already.
        kelvin : sequence of (h, w) arrays, optional
            Temperatures of each terrain surface in place of those of the raster or map that `source` describes, NaN
            for no data [K].

        Raises
        ------
        ThermorenderError
            A source that cannot be used in this scene.
        """
        if model is not None and not isinstance(model, TemperatureMap):
            raise ThermorenderError(f"with_temperature: model is a {type(model).__name__}; give a TemperatureMap")
        if isinstance(source, Mapping):
            return self._edited(replace(self._declared, spec=surface_temperatures(self._declared.spec, source)))
        if isinstance(source, TemperatureMap):
            model, spec = source, TemperatureSpec(source="learned", model=source.name)
        else:
            spec = temperature_spec(source, self._declared.spec.folder, kelvin is not None or model is not None)
        ground = self.surfaces[: self.terrain_count]
        now = self._declared
        surfaces = tuple(replace(one, temperature=None) for one in now.spec.surfaces)
        objects = objects_under(spec.source, now.spec.objects, now.of_file)
        given = None if kelvin is None else kelvin_argument("with_temperature: kelvin", kelvin, ground, True)
        return self._edited(replace(
            now, spec=replace(now.spec, temperature=spec, surfaces=surfaces, objects=objects), given=False,
            temperature_map=learned_map(spec) if model is None else model, given_kelvin=given,
        ))  # fmt: skip

    def with_objects(self, objects: "Mapping[str, Number | str | Mapping[str, Number | str]]") -> "Scene":
        """Return this scene with objects at other temperatures or places.

        Parameters
        ----------
        objects : dict
            {name: kelvin or "balance"}, or {name: {key: value}}: `temperature_k` (kelvin or "balance"), `inner_heat_w`
            (W, with "balance" only), and `east_m`, `north_m`, `above_ground_m`, `yaw_deg`. A column that a track has is
            held at the value.

        Raises
        ------
        ThermorenderError
            An unknown object or column, a temperature that no object has, or a place without terrain.
        """
        now, known = self._declared, {item.name: item for item in self._declared.spec.objects}
        held = dict(now.held)
        refuse_other("with_objects", objects, "{name: kelvin} or {name: {key: value}}")
        for name, given in objects.items():
            if name not in known:
                raise ThermorenderError(
                    f"{now.where} has no object {name!r}; {did_you_mean(name, known)}it has "
                    f"{', '.join(known) or 'none'}"
                )
            values = given if isinstance(given, Mapping) else {"temperature_k": given}
            known[name] = changed_object(known[name], values)
            if known[name].track is not None:
                held[name] = held.get(name, frozenset()) | frozenset(values)
        spec = replace(now.spec, objects=tuple(known.values()))
        return self._edited(replace(now, spec=spec, held=held))

    def with_surfaces(
        self, surfaces: Sequence[Surface] | None = None, materials: Sequence[Material] | None = None,
        terrain_count: int | None = None,
    ) -> "Scene":  # fmt: skip
        """Return this scene with surfaces or materials made in memory, in place of those its files describe.

        Temperatures that follow the weather become pending; others are those in the surfaces' texels. Later edits of
        materials and objects are refused, because no file describes them.

        Parameters
        ----------
        surfaces : sequence of Surface, optional
            The terrain's first.
        materials : sequence of Material, optional
            Indexed by `Surface.material`.
        terrain_count : int, optional
            How many of the surfaces are terrain.

        Raises
        ------
        ThermorenderError
            A texel whose material number is beyond the materials.
        """
        now, state, shape = self._declared, self.temperature_state, self._values["shape"]
        shown, made, count = surfaces_argument(surfaces, materials, terrain_count, self)
        if isinstance(state.source, Moved) and surfaces is None:
            # Move the map again, not the temperatures that a heat balance computed from it.
            own = state.source.temperatures
            moved = (replace(surface, temperature=kelvin) for surface, kelvin in zip(shown, own, strict=False))
            shown = (*moved, *shown[len(own) :])
        ground, static = shown[:count], shown[count:]
        painted = tuple(Painted(s.material, s.colour, s.flags & ~np.uint8(FALLBACK | UNMOVED)) for s in ground)
        shape = replace(
            shape, ground=ground, static=static, static_of=(), tracked=self.tracked_objects, tracked_of=(),
            textures=(), drapes=() if shape.textures else shape.drapes,
            balanced=shape.balanced if surfaces is None else 0, inner_1_m2=(),
            highest_m=max(float(surface.heights_m().max()) for surface in shown),
        )  # fmt: skip
        cover = Cover((), painted, (), self.emissivity_report)
        return self._edited(stages.made_in_memory(now, shape, cover, made))

    def with_solved_temperatures(
        self, time: np.datetime64, temperatures: Sequence[ArrayLike], *, flags: "Sequence[ArrayLike] | None" = None,
        report: Mapping[str, Any] | None = None, moved_report: Mapping[str, Any] | None = None,
        notes: tuple[str, ...] = (), scatter_k: Sequence[ArrayLike] = (), preview_k: tuple[float, float] | None = None,
    ) -> "Scene":  # fmt: skip
        """Return this scene at an instant of its weather, with the temperatures that were solved for it.

        In a scene with air, the sun is at its position at that instant, if it shines.

        Parameters
        ----------
        time : datetime64
            UTC.
        temperatures : sequence of (h, w) arrays
            Kinetic temperature of the texels of each of the first `Scene.solved_count` surfaces [K].
        flags : sequence of (h, w) uint8 arrays, optional
            Flags of these texels, in place of the scene's own.
        report, moved_report, notes, preview_k : optional
            As of `Available`.
        scatter_k : sequence of arrays, optional
            Of the last of these surfaces, as of `Surface`.

        Raises
        ------
        ThermorenderError
            A scene whose temperatures do not follow the weather.
        """
        now, state = self._declared, self.temperature_state
        if state.source is None:
            raise ThermorenderError(
                f"{self.where}: temperatures of source {self.spec.temperature.source!r} are not "
                "solved for an instant; call with_temperature('balance') first"
            )
        solved = self.surfaces[: self.solved_count]
        kelvin = kelvin_argument("with_solved_temperatures: temperatures", temperatures, solved, no_data=False)
        own = flags_argument(flags, solved) if flags is not None else [surface.flags for surface in solved]
        moment = instant("with_solved_temperatures: time", time)
        self.weather.at(moment)
        known = Available(state.source, moment, report or state.report, moved_report or {}, notes, preview_k)
        count = self.terrain_count
        objects = kelvin[count:]
        spread = [None] * (len(objects) - len(scatter_k)) + [np.asarray(each, np.float32) for each in scatter_k]
        result = Temperatures(
            kelvin[:count],
            [each & np.uint8(FALLBACK | UNMOVED) for each in own[:count]],
            known,
            [(own, None if std is None else std.reshape(own.shape)) for own, std in zip(objects, spread, strict=True)],
        )
        assert now.spec.weather is not None
        if moment != now.time:
            now = now.under(replace(now.spec.weather, time=moment), now.given_weather)
        # What was read for one instant holds for the others that were solved with it.
        given = {name: self._values[name] for name in ("weather", "no_snow")}
        return self._edited(now, {**given, "temperatures": result})

    def with_learned_materials(self, spec: EmissivitySpec) -> "Scene":
        """Return this scene with its terrain's materials read from orthophoto or textures, as of a source "learned".

        The materials of a [[surface]] stay.
        """
        if not isinstance(spec, EmissivitySpec) or spec.source != "learned":
            shown = f"source={spec.source!r}" if isinstance(spec, EmissivitySpec) else f"a {type(spec).__name__}"
            raise ThermorenderError(
                f"with_learned_materials was given {shown}; give EmissivitySpec('learned', model=…, fallback=…)"
            )
        spec = checked_spec(spec, "with_learned_materials", self._declared.spec.folder)
        terrain = self._declared.spec.terrain
        if not (terrain.orthophoto or terrain.mesh):
            raise ThermorenderError(
                f"{self._declared.where}: a learned emissivity map reads materials from an orthophoto; add "
                "terrain.orthophoto"
            )
        return self._edited(replace(self._declared, spec=replace(self._declared.spec, emissivity=spec)))

    def with_material(
        self, replaced: Mapping[int | str, str | Number | Material] | None = None, /,
        **more: str | Number | Material,
    ) -> "Scene":  # fmt: skip
        """Return this scene with materials of its terrain or objects replaced by others.

        Parameters
        ----------
        replaced, **more : str, float or Material, by what it replaces
            A key is a class number, the name of an object, the name of a mesh's node, group, material or texture, or
            the name of a material, as in the scene's files; the first of these that the scene has counts. A value is
            the name of a material, a grey emissivity 0…1, or a Material. All replacements apply at once: with
            `grass="sand"` and `sand="snow"` grass becomes sand, and sand becomes snow.
        """
        now, files = self._declared, self._declared.files
        refuse_other("with_material", replaced or {}, "{what it replaces: material}, or name=material")
        given: dict[int | str, str | Number | Material] = dict(replaced or {})
        given.update(more)
        if files is None:
            raise ThermorenderError(
                f"{now.where}: with_material needs materials that files describe, and this scene's surfaces were made "
                "in memory; give with_surfaces other materials"
            )
        names = {item.name for item in now.spec.objects}
        of_mesh = frozenset[str]().union(*(texture.known for texture in files.textures))

        def place(key: int | str) -> int | str:
            if not isinstance(key, str) or key not in names | of_mesh:
                return key
            return (OBJECT if key in names else SURFACE_OF_MESH) + key

        found = {place(key): material_of(key, value, files.library) for key, value in given.items()}
        return self._edited(replace(now, replaced={**now.replaced, **found}))

    def with_material_in(
        self, area: str | PathLike[str] | Mapping[str, Any] | ArrayLike,
        material: str | Number | Material | None = None,
    ) -> "Scene":  # fmt: skip
        """Return this scene with another material within an area of its terrain, such as one roof.

        On a mesh, the area covers what is seen from above: roofs hide the ground below them, and walls and leaves keep
        their materials.

        Parameters
        ----------
        area : path, dict or (N, 2) array
            GeoJSON of polygons, a file or its contents, in longitude and latitude unless its "crs" member names another
            CRS; or the corners of one polygon, local east and north [m]. Texels with their middle inside get the
            material.
        material : str, float or Material, optional
            The name of a material, a grey emissivity 0…1, or a Material; by default the property "material" of each
            polygon. It has no other effect: temperatures of a raster or map stay.
        """
        patches = []
        for texels, own in self._texels_in(area, "with_material_in"):
            chosen = own if material is None else material
            if chosen is None:
                raise ThermorenderError(
                    f"{_area_name(area, 'with_material_in')} has a polygon without the property 'material'; give a "
                    "material, or name it there"
                )
            patches.append(Patch(texels, self._given_material(chosen, "with_material_in")))
        return self._edited(replace(self._declared, painted=(*self._declared.painted, *patches)))

    def with_material_at(self, texels: ArrayLike, material: str | Number | Material) -> "Scene":
        """Return this scene with another material on texels of its terrain, also of walls and of what roofs hide.

        Parameters
        ----------
        texels : (n,) ints
            Their numbers over the terrain's surfaces, row by row, as `Renderer.texels` returns. A surface whose faces
            have a texel each, such as leaves, is painted face by face; objects have one material.
        material : str, float or Material
            As of `with_material_in`. Later areas and texels cover earlier ones.
        """
        self.refuse_tiles("with_material_at")
        files = self._declared.files
        if files is None:
            raise self._in_memory("with_material_at")
        numbers = numbered(texels, files.ground, "with_material_at")
        patch = Patch(numbers, self._given_material(material, "with_material_at"))
        return self._edited(replace(self._declared, painted=(*self._declared.painted, patch)))

    def texels_in(self, area: str | PathLike[str] | Mapping[str, Any] | ArrayLike) -> NDArray[np.int64]:
        """Return the numbers of the terrain's texels that `with_material_in` changes in an area, (n,) ascending."""
        return np.unique(np.concatenate([texels for texels, _ in self._texels_in(area, "texels_in")]))

    def _texels_in(self, area: Any, edit: str) -> list[tuple[NDArray[np.int64], str | None]]:
        """[(numbers of the terrain's texels, property "material" or None)] of the polygons of an area."""
        self.refuse_tiles(edit)
        now, files = self._declared, self._declared.files
        place = place_of(files.frame, files.grid) if files else None
        if files is None:
            raise self._in_memory(edit)
        if place is None:
            raise ThermorenderError(
                f"{now.where}: {edit} needs a terrain with a place on a map; add [frame] with latitude_deg, "
                "longitude_deg and height_m, or name a part of the mesh in with_material"
            )
        map_view = files.map_view
        if map_view is None:
            raise ThermorenderError(
                f"{now.where}: {edit} takes what is seen from above, and this mesh has walls or leaves only; name a "
                "part of it in with_material, or give its texels to with_material_at"
            )
        found, name = [], _area_name(area, edit)
        for geometry, own in areas(area, place, self.ground):
            texels = map_view.texels(texels_in(geometry, map_view.grid, name))
            if not texels.size:
                raise ThermorenderError(
                    f"{name} covers no texel of a ground or roof that is seen from above; draw it on one"
                )
            found.append((texels, own))
        return found

    def _given_material(self, material: str | Number | Material, edit: str) -> Material:
        """The Material of an edit's argument."""
        assert self._declared.files is not None
        return material_of("material", material, self._declared.files.library, edit)

    def _in_memory(self, edit: str) -> ThermorenderError:
        """The error on an edit of surfaces that no files describe."""
        return ThermorenderError(
            f"{self._declared.where}: {edit} needs a terrain that files describe; edit the scene before with_surfaces"
        )

    @property
    def class_files(self) -> tuple[Path | None, ...]:
        """The raster of each terrain surface's classes: of a mesh, in the pixels of its texture; None without one, for
        far ground and for tiles."""
        files = self._declared.files
        if files is None or files.world is not None:
            return (None,) * self.terrain_count
        own = (*(texture.file for texture in files.textures), *(drape.classes_file for drape in files.drapes))
        return tuple(None if each.far else path for each, path in zip(files.ground, own, strict=True))

    def refuse_unsolved(self) -> None:
        """Raise unless the terrain's temperatures are known."""
        self._values["refuse_unsolved"]

    def refuse_disagreement(self) -> None:
        """Raise unless the scene can be rendered: a sky or air, air for its sun, materials and temperatures."""
        self._values["agreement"]

    def changes(self, other: "Scene") -> frozenset[str]:
        """Return what differs from another scene of all that a frame depends on, by the parameters of `digest`.

        Surfaces, materials and air made in two ways differ, even if they are equal.
        """
        own = frozenset() if self.terrain_count == other.terrain_count else {"terrain_count"}
        return self._values.changes(other._values, "digest") | own

    def digest(self) -> str:
        """Return a fingerprint (hex) of everything a frame of this scene depends on."""
        own = str(self._values["digest"])
        if self.world is None:
            return own
        # Tiles depend on files and rules that the overview may not show. Of a map's file the content counts.
        model, spec = self._declared.temperature_map, self.spec
        rules = every_field(spec.temperature, "model"), every_field(spec.emissivity), model and model.digest()
        return hashlib.blake2b(repr((own, self.world.digest(), rules)).encode(), digest_size=16).hexdigest()

    def weather_digest(self) -> str:
        """Return a fingerprint (hex) of the weather: its series, its place and what was filled in."""
        return str(self._values["weather_digest"])

    def __repr__(self) -> str:
        return text.line_of(self)

    def __str__(self) -> str:
        return text.table_of(self)

    def _repr_html_(self) -> str:
        return text.html_of(self)


def _area_name(area: Any, edit: str) -> str:
    """What messages call an area."""
    return f"area {area}" if isinstance(area, (str, PathLike)) else f"{edit}: the area"


_EDITS = (
    "use with_camera, with_air, with_sky, with_sun, with_weather, with_temperature, with_material, with_material_in, "
    "with_material_at, with_objects, with_surfaces, with_learned_materials, with_solved_temperatures or at, which "
    "return another scene"
)
