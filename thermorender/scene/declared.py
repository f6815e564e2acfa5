"""What a scene declares: the scene file, the edits, and values given in place of files.

`thermorender.scene.stages` derives all other state from these.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.materials.material import Material
from thermorender.scene.cover import Cover
from thermorender.scene.folder import SceneFiles
from thermorender.scene.patch import Patch
from thermorender.scene.shape import Shape
from thermorender.scene.spec import SceneSpec, WeatherSpec
from thermorender.sensor.camera import Camera

if TYPE_CHECKING:
    from thermorender.learned.temperature_map import TemperatureMap
    from thermorender.weather.series import Weather


@dataclass(frozen=True, eq=False)
class InMemory:
    """Surfaces made in memory, in place of those that files describe."""

    shape: Shape
    cover: Cover
    materials: tuple[Material, ...]
    # fixed: Values of inputs that cannot be edited any more, by what the message calls them
    fixed: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Declared:
    """Declarations of a scene: the inputs of its stages, by these names and those of `inputs`."""

    spec: SceneSpec  # The scene file with those edits that it has keys for
    camera: Camera
    files: SceneFiles | None = None  # The content of the folder; None for surfaces made in memory
    in_memory: InMemory | None = None
    time: "np.datetime64 | None" = None  # The instant requested, UTC; None without [weather]
    # Altitude of the frame's origin that the scene file's [atmosphere] states [m]. It belongs to the place, so
    # another air does not change it.
    place_altitude_m: float | None = None
    last_sky: float | None = None  # The last declared sky [K], which `with_air(None)` restores
    given_air: Atmosphere | None = None  # In place of the air that `spec` names; not cut to the camera's band
    given_weather: "Weather | None" = None  # In place of the weather that `spec` names
    temperature_map: "TemperatureMap | None" = None  # The learned map of the temperatures, in place of its file
    # Temperatures of the terrain in place of the raster's or the map's [K]
    given_kelvin: tuple[NDArray[Any], ...] | None = None
    # Materials in place of others, as `thermorender.scene.cover.Replaced` says
    replaced: Mapping[int | str, Material] = field(default_factory=dict)
    painted: tuple[Patch, ...] = ()  # Texels of the terrain with another material, the latest last
    # Columns of tracks that an edit fixes at one value, by the name of the object
    held: Mapping[str, frozenset[str]] = field(default_factory=dict)
    of_file: SceneSpec | None = None  # The scene file without edits; None for surfaces made in memory
    given: bool = False  # Whether the terrain's temperatures came with surfaces made in memory

    @property
    def inputs(self) -> dict[str, Any]:
        """{name: value} for the stages; the key `x` of the scene file is `spec_x`."""
        of_file = {f"spec_{row.name}": getattr(self.spec, row.name) for row in fields(self.spec)}
        return of_file | {row.name: getattr(self, row.name) for row in fields(self) if row.name != "spec"}

    @property
    def where(self) -> str:
        """Path of the scene file, for messages."""
        return str(self.spec.folder / "scene.toml")

    def under(self, weather: WeatherSpec, series: Any) -> "Declared":
        """Return these declarations under another weather; the truth belongs to that of the scene file only."""
        same = self.of_file is not None and series is None and weather == self.of_file.weather
        truth = self.of_file.truth_temperature if self.of_file is not None and same else None
        spec = replace(self.spec, weather=weather, truth_temperature=truth)
        return replace(self, spec=spec, given_weather=series, time=weather.time)
