"""Edits of a scene: each returns another Scene in which everything that depends on the edit is made again.

An edit changes what the scene declares; `thermorender.scene.state.derived` makes the rest follow. So edits may come in
any order. Two edits of the same thing are the exception, and the last one counts: `with_sky` and `with_air`, `at` and
`with_weather(time=…)`, an edit and itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import TemperatureMap
from thermorender.materials.material import Material
from thermorender.scene.parts.cover import Cover, Painted
from thermorender.scene.parts.read import Parts
from thermorender.scene.spec import WEATHER, AtmosphereSpec, SunSpec, TemperatureSpec
from thermorender.scene.state.arguments import (
    changed_object,
    checked_spec,
    flags_argument,
    kelvin_argument,
    number_of,
    refuse_other,
    surface_temperatures,
    surfaces_argument,
    temperature_spec,
    weather_argument,
)
from thermorender.scene.state.declared import Declared
from thermorender.scene.state.derived import Derived, air_in, of_surfaces
from thermorender.scene.state.material_edits import MaterialEdits
from thermorender.scene.surface import FALLBACK, UNMOVED, Surface, scene_kelvin
from thermorender.scene.temperature import learned_map
from thermorender.scene.temperature_state import Known, Moved
from thermorender.schema import Where, did_you_mean, read
from thermorender.sensor.camera import Camera, load_camera
from thermorender.units import instant, utc_text, with_unit

_S = TypeVar("_S", bound="Edits")


class Edits(MaterialEdits):
    """The edits of a Scene; those of its materials are in `thermorender.scene.state.material_edits`."""

    _derived: Derived
    weather: Any

    def _made(self: _S, parts: Parts | None, declared: Declared, derived: Derived) -> _S:
        """Return the scene of these parts."""
        raise NotImplementedError

    def with_camera(self: _S, camera: str | PathLike[str] | Camera) -> _S:
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

    def with_air(self: _S, air: str | AtmosphereSpec | Atmosphere | None, aerosol: str = "none") -> _S:
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
            if now.sky_temperature is None:
                raise ThermorenderError(
                    f"{now.where}: with_air(None) leaves the scene without a sky; call with_sky(kelvin) instead"
                )
            return self.with_sky(now.sky_temperature)
        if isinstance(air, str):
            air = AtmosphereSpec(standard=air, aerosol=aerosol)
        elif aerosol != "none":
            raise ThermorenderError(f"aerosol={aerosol!r} goes with a standard atmosphere's name only; leave it out")
        if isinstance(air, Atmosphere):
            spec = replace(now.spec, atmosphere=None, sky_temperature=None)
            return self._edited(replace(now, spec=spec, air=air))
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
        return self._edited(replace(now, spec=spec, air=None))

    def with_sky(self: _S, kelvin: float | str, surroundings: float | str | None = None) -> _S:
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
        return self._edited(replace(now, spec=spec, air=None, sky_temperature=kelvin))

    def with_sun(self: _S, elevation_deg: float | None, azimuth_deg: float | None = None) -> _S:
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

    def at(self: _S, time: "str | np.datetime64") -> _S:
        """Return this scene at another instant; temperatures that follow the weather become pending.

        A truth raster is of the scene's own instant and left out at any other.

        Parameters
        ----------
        time : str, datetime or datetime64
            As by `thermorender.units.instant`: text with its zone; a datetime64 is UTC.

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
        if now.spec.temperature.source == "learned" and not self._derived.temperature_state.weather_driven:
            raise ThermorenderError(
                f"{now.where}: time={utc_text(asked)} is not available from learned map "
                f"{now.spec.temperature.model!r}, which does not state the instant and weather of "
                "its training; add [temperature.trained] with the keys of [weather], or leave the time out"
            )
        return self._edited(now.under(replace(now.spec.weather, time=asked), now.weather))

    def with_weather(self: _S, weather: Any = None, **keys: Any) -> _S:
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
        return self._edited(now.under(spec, series))

    def with_temperature(
        self: _S,
        source: "TemperatureSpec | float | str | PathLike[str] | TemperatureMap | Mapping[str, Any]",
        model: TemperatureMap | None = None, kelvin: Sequence[ArrayLike] | None = None,
    ) -> _S:  # fmt: skip
        """Return this scene with its terrain's temperatures from another source.

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
        ground = self._derived.shape.ground
        surfaces = tuple(replace(one, temperature=None) for one in self._declared.spec.surfaces)
        now = replace(
            self._declared, spec=replace(self._declared.spec, temperature=spec, surfaces=surfaces), model=model,
            given=False,
            kelvin=kelvin if kelvin is None else kelvin_argument("with_temperature: kelvin", kelvin, ground, True),
        )  # fmt: skip
        if model is None:
            now = replace(now, model=learned_map(spec))
        return self._edited(now)

    def with_objects(self: _S, objects: Mapping[str, float | Mapping[str, float]]) -> _S:
        """Return this scene with objects at other temperatures or places.

        Parameters
        ----------
        objects : dict
            {name: kelvin}, or {name: {column of a track: value}}: `east_m`, `north_m`, `above_ground_m`, `yaw_deg`,
            `temperature_k`. A column that a track has is held at the value.

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
        self: _S, surfaces: Sequence[Surface] | None = None, materials: Sequence[Material] | None = None,
        terrain_count: int | None = None,
    ) -> _S:  # fmt: skip
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
        now, had = self._declared, self._derived
        shown, made, count = surfaces_argument(surfaces, materials, terrain_count, had, now.where)
        if isinstance(had.temperature_state.source, Moved) and surfaces is None:
            # Move the map again, not the temperatures that a heat balance computed from it.
            own = had.temperature_state.source.temperatures
            moved = (replace(surface, temperature=kelvin) for surface, kelvin in zip(shown, own, strict=False))
            shown = (*moved, *shown[len(own) :])
        ground, static = shown[:count], shown[count:]
        painted = tuple(Painted(s.material, s.colour, s.flags & ~np.uint8(FALLBACK | UNMOVED)) for s in ground)
        shape = replace(
            had.shape, ground=ground, static=static, static_of=(), tracked=had.tracked_objects, tracked_of=(),
            textures=(), balanced=0, highest_m=max(float(surface.vertices[:, 2].max()) for surface in shown),
        )  # fmt: skip
        now, cover = replace(now, given=True), Cover(made, painted, (), had.cover.report)
        return self._made(None, now, of_surfaces(now, shape, cover, had))

    def with_solved_temperatures(
        self: _S, time: np.datetime64, temperatures: Sequence[ArrayLike], *, flags: "Sequence[ArrayLike] | None" = None,
        report: Mapping[str, Any] | None = None, moved_report: Mapping[str, Any] | None = None,
        notes: tuple[str, ...] = (), scatter_k: Sequence[ArrayLike] = (),
    ) -> _S:  # fmt: skip
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
        report, moved_report, notes : optional
            As of `Known`.
        scatter_k : sequence of arrays, optional
            Of the last of these surfaces, as of `Surface`.

        Raises
        ------
        ThermorenderError
            A scene whose temperatures do not follow the weather.
        """
        had, state = self._derived, self._derived.temperature_state
        if state.source is None:
            raise ThermorenderError(
                f"{self._declared.where}: temperatures of source {self._declared.spec.temperature.source!r} are not "
                "solved for an instant; call with_temperature('balance') first"
            )
        terrain = had.surfaces[: len(had.shape.ground) + had.shape.balanced]
        what = "with_solved_temperatures: temperatures"
        kelvin = kelvin_argument(what, temperatures, terrain, no_data=False)
        made = [replace(surface, temperature=values) for surface, values in zip(terrain, kelvin, strict=True)]
        if flags is not None:
            own = flags_argument(flags, terrain)
            made = [replace(surface, flags=values) for surface, values in zip(made, own, strict=True)]
        for number, values in enumerate(scatter_k, start=len(made) - len(scatter_k)):
            shape = made[number].flags.shape
            made[number] = replace(made[number], scatter_k=np.asarray(values, np.float32).reshape(shape))
        moment = instant("with_solved_temperatures: time", time)
        self.weather.at(moment)
        known = Known(state.source, moment, report or state.report, moved_report or {}, notes)
        surfaces = (*made, *had.surfaces[len(terrain) :])
        now = self._declared
        assert now.spec.weather is not None
        declared = now if moment == now.time else now.under(replace(now.spec.weather, time=moment), now.weather)
        air = had.air if had.weather is None else air_in(declared, had.weather)
        scene = self._made(self._parts, declared, replace(had, surfaces=surfaces, temperature_state=known, air=air))
        if "_weather" in vars(self):
            # The weather that was read for one instant holds for the others that were solved with it.
            vars(scene)["_weather"] = vars(self)["_weather"]
        return scene
