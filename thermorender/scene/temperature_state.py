"""The state of a scene's terrain temperatures: known, or pending until a renderer solves them for an instant.

Both states keep the source of temperatures that follow the weather, so a solved scene can be solved again.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.spec import WeatherSpec


@dataclass(frozen=True, eq=False)
class Balance:
    """Temperatures of the terrain's heat balance."""

    @property
    def words(self) -> str:
        """The source in words, for messages."""
        return "source='balance'"


@dataclass(frozen=True, eq=False)
class Moved:
    """Temperatures of a map at the instant it was trained for, which the heat balance moves to the scene's instant."""

    temperatures: tuple[NDArray[np.float32], ...]  # Of each terrain surface at the trained instant [K]
    trained: WeatherSpec  # The instant and the weather of these temperatures
    error_k: float  # One standard deviation of the map's own error [K]

    @property
    def words(self) -> str:
        """The source in words, for messages."""
        return "a map that is moved to another time"


@dataclass(frozen=True, eq=False)
class Conditional:
    """Temperatures of a learned map that takes relief, hour or weather as input."""

    model: Any  # As read when the source was set, even if its file changes later

    @property
    def words(self) -> str:
        """The source in words, for messages."""
        return "a learned map that takes hour and weather as input"


WeatherSource = Balance | Moved | Conditional


@dataclass(frozen=True, eq=False)
class Available:
    """The terrain's temperatures are in its texels."""

    # The source they were solved from; None where they do not follow the weather
    source: WeatherSource | None = None
    # The instant they were solved for, UTC; None where they do not follow the weather
    time: "np.datetime64 | None" = None
    report: Mapping[str, Any] = field(default_factory=dict)  # Reports of the learned maps, by their names
    # Report of moving a map to `time`; empty for other sources
    moved_report: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # Notes of solving, added to those of the weather
    # Estimated error of temperatures that preview an edit: root mean square, and largest [K]; None for those of a run
    preview_k: tuple[float, float] | None = None

    @property
    def solved(self) -> bool:
        """Whether the texels hold their temperatures: True."""
        return True

    @property
    def weather_driven(self) -> bool:
        """Whether the temperatures follow the weather."""
        return self.source is not None


@dataclass(frozen=True, eq=False)
class Pending:
    """The terrain's temperatures are NaN: a renderer solves them for the scene's instant."""

    source: WeatherSource
    # Report of the learned map of a Moved source, by its name
    report: Mapping[str, Any] = field(default_factory=dict)

    @property
    def solved(self) -> bool:
        """Whether the texels hold their temperatures: False."""
        return False

    @property
    def weather_driven(self) -> bool:
        """Whether the temperatures follow the weather: True."""
        return True

    @property
    def moved_report(self) -> Mapping[str, Any]:
        """Empty: nothing has been moved yet."""
        return {}


TemperatureState = Available | Pending
