"""Declarations of a scene: the scene file, the edits made to it, and values given in place of files.

All other state is derived from these and from the files of the folder, so no edit can leave a part stale.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.materials.material import Material
from thermorender.scene.parts.patch import Patch
from thermorender.scene.spec import SceneSpec, WeatherSpec
from thermorender.sensor.camera import Camera


@dataclass(frozen=True, eq=False)
class Declared:
    """Declarations of a scene."""

    spec: SceneSpec  # The scene file with those edits that it has keys for
    camera: Camera
    time: "np.datetime64 | None" = None  # The instant requested, UTC; None without [weather]
    # Altitude of the frame's origin that the scene file's [atmosphere] states [m]. It belongs to the place, so
    # another air does not change it.
    altitude_m: float | None = None
    sky_temperature: float | None = None  # The last declared sky [K], which `with_air(None)` restores
    air: Atmosphere | None = None  # In place of the air that `spec` names; not cut to the camera's band
    weather: Any = None  # In place of the weather that `spec` names
    model: Any = None  # The learned map of the temperatures, in place of its file
    # Temperatures of the terrain in place of the raster's or the map's [K]
    kelvin: tuple[NDArray[Any], ...] | None = None
    # Materials in place of others, as `thermorender.scene.parts.cover.Replaced` says
    replaced: Mapping[int | str, Material] = field(default_factory=dict)
    painted: tuple[Patch, ...] = ()  # Areas of the terrain with another material, the latest last
    # Columns of tracks that an edit fixes at one value, by the name of the object
    held: Mapping[str, frozenset[str]] = field(default_factory=dict)
    # truth, truth_weather: The truth raster of the scene file, and the weather it belongs to
    truth: Path | None = None
    truth_weather: WeatherSpec | None = None
    given: bool = False  # Whether the terrain's temperatures came with surfaces made in memory

    @property
    def where(self) -> str:
        """Path of the scene file, for messages."""
        return str(self.spec.folder / "scene.toml")

    @property
    def has_air(self) -> bool:
        """Whether an air is declared, by its Atmosphere or by `spec`."""
        return self.air is not None or self.spec.atmosphere is not None

    def height_m(self, frame: Any) -> float:
        """Return the altitude of a frame's origin above sea level [m]: as declared, else from the frame, else 0."""
        if self.stated_altitude_m is not None:
            return self.stated_altitude_m
        return float(frame.height_m - (self.geoid_undulation_m or 0.0)) if frame else 0.0

    @property
    def stated_altitude_m(self) -> float | None:
        """Altitude of the frame's origin above sea level that the air states, else the scene file [m]."""
        air = self.spec.atmosphere
        own: float | None = air.altitude_m if air is not None else None
        return self.altitude_m if own is None else own

    def under(self, weather: WeatherSpec, series: Any) -> "Declared":
        """Return these declarations under another weather; the truth raster belongs to that of the scene file only."""
        truth = self.truth if series is None and weather == self.truth_weather else None
        spec = replace(self.spec, weather=weather, truth_temperature=truth)
        return replace(self, spec=spec, weather=series, time=weather.time)

    @property
    def geoid_undulation_m(self) -> float | None:
        """Height of the geoid above the ellipsoid [m], or None where it is not declared."""
        declared: float | None = self.spec.terrain.geoid_undulation_m
        return 0.0 if declared is None and self.spec.terrain.height_reference == "geoid" else declared
