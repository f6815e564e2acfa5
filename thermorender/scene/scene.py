"""The Scene: an immutable value with its declarations and the state derived from them.

Its edits (`thermorender.scene.edit`) return other scenes, in which everything that depends on the edit is made again.
Single fields cannot be replaced.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.edit import Edits
from thermorender.scene.ground import Ground
from thermorender.scene.parts import coplanar
from thermorender.scene.parts.cover import Cover, Painted
from thermorender.scene.parts.read import Parts
from thermorender.scene.parts.shape import Shape
from thermorender.scene.parts.tracks import TrackedObject
from thermorender.scene.raster import Grid
from thermorender.scene.spec import SceneSpec, SunSpec, TemperatureSpec
from thermorender.scene.state import albedo, digest, text
from thermorender.scene.state.agreement import contradictions, refuse_disagreement
from thermorender.scene.state.declared import Declared
from thermorender.scene.state.derived import Derived, camera_alone_differs, derived, of_surfaces
from thermorender.scene.state.own_weather import weather_of
from thermorender.scene.surface import Surface
from thermorender.scene.temperature_state import TemperatureState
from thermorender.sensor.camera import Camera
from thermorender.trajectory.path import pose
from thermorender.units import ZERO_CELSIUS_K, utc_text

if TYPE_CHECKING:
    from thermorender.weather.series import Weather

# The sun shines where its direct irradiance is above this [W m⁻²]: World Meteorological Organization, Guide to
# Instruments and Methods of Observation, WMO-No. 8 (2018), volume I, 8.1.1.
_SUNSHINE_W_M2 = 120.0
# Water in snow that nobody recorded [mm], and difference of rooms from the air outside [K], that are reported.
_LIKELY_SNOW_MM, _INDOORS_K = 3.0, 12.0


class Scene(Edits):
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
    materials : tuple of Material
        Indexed by `Surface.material`.
    air : Atmosphere or None
        The declared air in the camera's band.
    tracked_objects : tuple of TrackedObject
        Objects with a track.
    temperature_state : Known or Pending
        Whether the terrain's temperatures are known, and the source of those that follow the weather.
    emissivity_report : dict
        Report of the learned emissivity map; empty without one.
    """

    _parts: Parts | None
    _declared: Declared
    _derived: Derived

    def __init__(self, parts: Parts | None, declared: Declared, made: Derived | None = None) -> None:
        vars(self).update(_parts=parts, _declared=declared, _derived=derived(parts, declared) if made is None else made)

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
        declared = Declared(spec, camera, sky_temperature=spec.sky_temperature, given=True)
        count = len(surfaces) if terrain_count is None else terrain_count
        ground, static = tuple(surfaces[:count]), tuple(surfaces[count:])
        highest_m = max(float(surface.vertices[:, 2].max()) for surface in surfaces)
        shape = Shape(None, None, ground, None, static, (), (), (), highest_m)
        painted = tuple(Painted(each.material, each.colour, each.flags) for each in ground)
        return cls(None, declared, of_surfaces(declared, shape, Cover(tuple(materials), painted, (), {}), None))

    def _made(self, parts: Parts | None, declared: Declared, made: Derived) -> "Scene":
        scene = Scene(parts, declared, made)
        if "_weather" in vars(self) and self._weather_key() == scene._weather_key():
            vars(scene)["_weather"] = self._weather
        if made.shape.ground is self._derived.shape.ground and "ground" in vars(self):
            vars(scene)["ground"] = self.ground
        return scene

    def _edited(self, declared: Declared) -> "Scene":
        return self._made(self._parts, declared, derived(self._parts, declared, (self._declared, self._derived)))

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
    def frame(self) -> LocalFrame | None:  # noqa: D102
        return self._derived.shape.frame

    @property
    def grid(self) -> Grid | None:  # noqa: D102
        return self._derived.shape.grid

    @property
    def surfaces(self) -> tuple[Surface, ...]:  # noqa: D102
        return self._derived.surfaces

    @property
    def terrain_count(self) -> int:  # noqa: D102
        return len(self._derived.shape.ground)

    @property
    def solved_count(self) -> int:
        """Number of surfaces whose temperatures the heat balance solves: the terrain, and copies of bodies."""
        return len(self._derived.shape.ground) + self._derived.shape.balanced

    @property
    def materials(self) -> tuple[Material, ...]:  # noqa: D102
        return self._derived.cover.materials

    @property
    def air(self) -> Atmosphere | None:  # noqa: D102
        return self._derived.air

    @property
    def tracked_objects(self) -> tuple[TrackedObject, ...]:  # noqa: D102
        return self._derived.tracked_objects

    @property
    def temperature_state(self) -> TemperatureState:  # noqa: D102
        return self._derived.temperature_state

    @property
    def emissivity_report(self) -> Mapping[str, Any]:  # noqa: D102
        return self._derived.cover.report

    @property
    def name(self) -> str:
        """Name of the scene's folder."""
        return str(self.spec.folder.name)

    @property
    def where(self) -> str:
        """Path of the scene file, for messages."""
        return self._declared.where

    @property
    def altitude_m(self) -> float:
        """Altitude of the local frame's origin above sea level [m]: as declared, else from the frame, else 0."""
        return self._declared.height_m(self.frame)

    @property
    def geoid_undulation_m(self) -> float | None:
        """Height of the geoid above the ellipsoid that this scene declares [m], or None."""
        return self._declared.geoid_undulation_m

    @property
    def sky_temperature(self) -> float:
        """Temperature of the isotropic black sky with the radiance of the scene's sky in the camera's band [K]."""
        if self.air is not None:
            return float(self.air.sky_temperature(self.altitude_m))
        assert self.spec.sky_temperature is not None
        return float(self.spec.sky_temperature)

    @cached_property
    def surroundings_temperature(self) -> float:
        """Temperature of the black background beyond the terrain's edge [K]: as stated, else its texels' mean."""
        if self.spec.surroundings_temperature is not None:
            return float(self.spec.surroundings_temperature)
        self.refuse_unsolved()
        terrain = [surface.temperature.ravel() for surface in self.surfaces[: self.terrain_count]]
        return float(np.concatenate(terrain).mean(dtype=np.float64))

    @property
    def truth_temperature_spec(self) -> TemperatureSpec:
        """TemperatureSpec of the truth raster, or of the heat balance without one.

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
    def balanced(self) -> bool:
        """Whether the terrain's temperatures come from a heat balance."""
        return bool(self.spec.temperature.source == "balance")

    @cached_property
    def sun(self) -> SunSpec | None:
        """The sun that shines on the scene; None without one.

        If temperatures follow the weather, its position is that at `time`, and it shines through air if its direct
        irradiance is above 120 W m⁻²; until they are solved there is none. Otherwise it is the declared one.
        """
        if not self.temperature_state.weather_driven:
            return self.spec.sun
        if self.air is None or not self.temperature_state.solved:
            return None
        weather, time = self.weather, self.time
        assert time is not None
        azimuth, elevation = map(float, weather.sun(time))
        shines = elevation > 0.0 and float(weather.at(time).direct_w_m2) > _SUNSHINE_W_M2
        return SunSpec(elevation, azimuth) if shines else None

    @cached_property
    def weather(self) -> "Weather":
        """The Weather that the scene declares, at its own place; read when first asked for.

        Raises
        ------
        ThermorenderError
            No [weather], no place, a file that cannot be used, or `time` outside of it.
        """
        notes = getattr(self.temperature_state, "notes", ())
        return replace(self._weather, notes=(*self._weather.notes, *notes)) if notes else self._weather

    @cached_property
    def _weather(self) -> "Weather":
        """The Weather without the notes of solving the temperatures."""
        if self._derived.weather is not None:
            return self._derived.weather
        return weather_of(self._declared, self._derived.shape)

    def _weather_key(self) -> tuple[Any, ...]:
        return self.spec.weather, id(self._declared.weather), self.altitude_m, self.frame

    @cached_property
    def sky_notes(self) -> tuple[str, ...]:
        """Sentences on a declared air or sky that contradicts the scene's weather; none without [weather]."""
        if self.spec.weather is None or (self._declared.weather is None and self.frame is None):
            return ()
        return contradictions(self._declared, self._derived, self._weather)

    @cached_property
    def surface_notes(self) -> tuple[str, ...]:
        """Sentences on objects that share a plane with another surface, so that pixels show either."""
        return coplanar.notes(self.surfaces, self.terrain_count)

    @property
    def weather_notes(self) -> tuple[str, ...]:
        """Notes on filled gaps of the weather, a short record before `time`, snow, likely snow, rooms and albedo."""
        from thermorender.scene.open_ground import over_room
        from thermorender.scene.state.weathered_ground import leaf_notes

        weather, time = self.weather, self.time
        assert time is not None
        before_h = (time - weather.time[0]) / np.timedelta64(3600, "s")
        notes = list(weather.notes)
        if before_h < 24.0:
            notes.append(
                f"the weather begins {before_h:.1f} h before {utc_text(time)}: with less than a day the ground "
                "stays near its initial state"
            )
        snow = float(weather.at(time).snow_m)
        if snow > 0.0 and not any(each.thermal and each.thermal.cover == "snow" for each in self.materials):
            notes.append(
                f"the weather has {snow:.2g} m of snow, but no material of the scene is snow, so the heat balance lays "
                "it on soil, grass and heath only, with their own emissivity; use the material snow where there is snow"
            )
        likely = weather.likely_snow_mm(time)
        if likely > _LIKELY_SNOW_MM:
            notes.append(
                f"about {likely:.0f} mm of water fell as snow and have not melted by {utc_text(time)}, and the weather "
                "states no snow on the ground, so the ground gets too warm; leave snow_depth_m out or state the depth"
            )
        outside_c, inside_c = float(weather.at(time).air_k) - ZERO_CELSIUS_K, self.spec.weather.inside_c  # type: ignore[union-attr]
        if abs(outside_c - inside_c) > _INDOORS_K and any(over_room(material) for material in self.materials):
            notes.append(
                f"rooms below roofs are at inside_c={inside_c:g} °C, and the air outside is at {outside_c:.0f} °C; "
                "state inside_c in [weather] if that is wrong"
            )
        return (*notes, *leaf_notes(self.materials, weather, time), *self._albedo_notes)

    @cached_property
    def _albedo_notes(self) -> tuple[str, ...]:
        return albedo.notes(self)

    @cached_property
    def ground(self) -> Ground:
        """Callable (east, north) → local height of the terrain [m], NaN off it."""
        return Ground(self.surfaces[: self.terrain_count])

    def pose(
        self, east: float, north: float, above_ground_m: float, yaw_deg: float = 0.0, pitch_deg: float = 0.0,
        roll_deg: float = 0.0, look_at: Sequence[float] | None = None,
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
        here, point = (east, north, above_ground_m), look_at
        if above_ground_m < 0.0:
            raise ThermorenderError(
                f"pose={here!r} is {-above_ground_m:.6g} m under the terrain; give metres above the ground, or local "
                "up to tr.pose"
            )
        up = self._local_up("pose", here)
        if point is not None and np.shape(point) == (3,):
            point = (point[0], point[1], self._local_up("look_at", point))
        return pose(east, north, up, yaw_deg, pitch_deg, roll_deg, point)

    def _local_up(self, name: str, point: Sequence[float]) -> float:
        ground = float(self.ground(float(point[0]), float(point[1])))
        if ground != ground:
            raise ThermorenderError(
                f"{name}={tuple(point)!r} is outside the terrain; move it, or give local up (tr.pose, --local-up)"
            )
        return ground + float(point[2])

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

    def refuse_unsolved(self) -> None:
        """Raise unless the terrain's temperatures are known."""
        state = self.temperature_state
        if not state.solved and state.source is not None:
            raise ThermorenderError(
                f"{self.where}: the temperatures of {state.source.words} are not solved yet; use Renderer(scene).scene"
            )

    def refuse_disagreement(self) -> None:
        """Raise unless band, materials, air, sun and the instant of the temperatures agree with each other."""
        refuse_disagreement(self._declared, self._derived)

    def like_but_for_camera(self, other: "Scene") -> bool:
        """Return whether another scene differs in the camera only."""
        same = self._derived.shape is other._derived.shape and self._derived.cover is other._derived.cover
        return same and camera_alone_differs(self._declared, other._declared)

    def digest(self) -> str:
        """Return a fingerprint (hex) of everything a frame of this scene depends on."""
        weather = self.weather if self.temperature_state.weather_driven else None
        return digest.digest_of(self._declared, self._derived, self.sun, weather)

    def weather_digest(self) -> str:
        """Return a fingerprint (hex) of the weather: its series, its place and what was filled in."""
        return digest.weather_digest_of(self.weather)

    def __repr__(self) -> str:
        return text.line_of(self._declared, self._derived)

    def __str__(self) -> str:
        return text.table_of(self._declared, self._derived)

    def _repr_html_(self) -> str:
        return text.html_of(self._declared, self._derived)


_EDITS = (
    "use with_camera, with_air, with_sky, with_sun, with_weather, with_temperature, with_material, with_material_in, "
    "with_objects, with_surfaces, with_learned_materials, with_solved_temperatures or at, which return another scene"
)
