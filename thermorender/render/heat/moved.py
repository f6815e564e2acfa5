"""A map's temperatures moved from the instant it was trained for to another hour and weather, by heat balance.

At the trained instant t₀ a texel of the map differs from its heat balance by d = T_map(t₀) − T_balance(t₀). The
difference at t is modelled as a Gaussian process over instants and weathers with three independent parts:

- deviations of the material from its table: Σₖ Sₖ(t) pₖ, with pₖ ~ N(0, 1) for each property of
  `materials.shifted.PROPERTIES` in units of its standard deviation, and Sₖ(t) [K] its effect in a simulation of the
  balance. S includes recently absorbed sunlight, shadow, wind, and the column's memory of them: too high an absorptance
  hardly warms an asphalt at night, while too high an inertia warms it by night and cools it by day.
- errors of the balance that these properties do not explain, of variance w²;
- the map's own error, of variance e², which the truth does not share.

w is correlated between t₀ and t by ρ = exp(−½ Σ (Δ/reach)²) over hour of day, day, sunshine, air temperature and wind
(`REACH`, chosen, not measured). The map's error is correlated over a quarter of these reaches, ρ¹⁶. The result thus
equals the map at t₀ and changes continuously into the linear estimate of least variance (kriging; Rasmussen & Williams,
Gaussian Processes for Machine Learning, 2006, eq. 2.25). With C = Σ Sₖ(t) Sₖ(t₀), D = Σ Sₖ(t₀)² and A = Σ Sₖ(t)², for
each texel

    T(t) = T_balance(t) + g d,    g = (C + ρ w² + ρ¹⁶ e²) / (D + w² + e²),

whose error against the truth has the variance g² (D + w² + e²) − 2 g (C + ρ w²) + A + w²: e² at t₀, and without a map
(g = 0) the balance's own, A + w². Where the differences of a material's texels exceed this model, C, D, A and e² are
scaled by a common ratio, from the median of d².

The balance is used alone, and the texel is UNMOVED, where the map had no own temperature, where snow lay or melted at
only one of the instants, or where rain had fallen before only one of them. Snow never exceeds its melting point.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.materials.mixture import parts_of
from thermorender.materials.shifted import PROPERTIES, shifted
from thermorender.render.geometry import Geometry
from thermorender.render.heat.simulation import solved
from thermorender.render.variant import activate
from thermorender.scene.scene import Scene
from thermorender.scene.surface import FALLBACK, UNMOVED
from thermorender.scene.temperature_state import Moved
from thermorender.units import ZERO_CELSIUS_K, utc_text
from thermorender.weather.series import Weather

# Error of a balance with the right properties, one standard deviation w [K]: chosen.
BALANCE_ERROR_K = 0.5
# Differences of two instants at which the unexplained error has lost 40 % of its correlation, all chosen: hours of the
# day, days of the year, sunlight on level ground in the last hours [W m⁻²], air [K], wind [m/s].
REACH = {"hour": 4.0, "day": 45.0, "sun": 300.0, "air": 10.0, "wind": 3.0}
_RECENT = np.arange(-6, 1) * np.timedelta64(1800, "s")
# A surface is wet if at least this much rain [mm] fell in this time before an instant [h].
_WET_H, _WET_MM = 6, 0.1
# Snow this near to its melting point may melt [K].
_MELTS_K = 0.05
# Standard deviation above which a texel is flagged, unless the map's own error is larger [K]: chosen.
MOST_STD_K = 5.0
# Median of the square of a standard normal variable.
_MEDIAN_OF_SQUARE = 0.4549
# Exponent of ρ for the map's own error: a quarter of the reaches.
_OF_ERROR = 16.0

Progress = Callable[[str, float], object]
# A weather, and an instant in it.
Instant = tuple[Weather, np.datetime64]


@dataclass(frozen=True)
class MovedMap:
    """A map moved to one instant."""

    # With the moved temperatures, UNMOVED in its flags, and a summary in the `moved_report` of its temperature state
    scene: Scene
    # One standard deviation of the temperatures of each of the terrain's surfaces [K]
    std_k: tuple[NDArray[np.float32], ...]


def moved(
    scene: Scene, times: "Sequence[np.datetime64]", geometry: Geometry | None = None, progress: Progress | None = None
) -> list[MovedMap]:
    """Return a scene whose map gives temperatures of one instant, moved to each of some instants (UTC) of its weather.
    It takes one simulation of the balance and one per property under each of the two weathers, and 12 bytes per texel
    and instant."""
    here, there = balances(scene)
    geometry = geometry or Geometry(activate(), scene.surfaces)
    asked = sorted(set(times))
    assert there.time is not None
    first, second = _share_of(progress, 0, 2), _share_of(progress, 1, 2)
    before = expected(there, [there.time], geometry, first)[0]
    found = {}
    if there.time in asked and here.weather_digest() == there.weather_digest():
        # The result is the same to the last bit.
        found[there.time] = before
    others = [at for at in asked if at not in found]
    found.update(zip(others, expected(here, others, geometry, second), strict=True))
    carried = Carried(scene, there, here, before)
    results = {at: carried.to(at, found[at]) for at in asked}
    return [results[at] for at in times]


def balances(scene: Scene) -> tuple[Scene, Scene]:
    """Return (the scene with source "balance", the same at the trained instant and weather), both unsolved."""
    if not isinstance(scene.temperature_state.source, Moved):
        raise ThermorenderError(
            f"{scene.where} has no map that could be moved; add [weather], and [temperature.trained] with the time and "
            "weather of its temperatures"
        )
    here = scene.with_temperature("balance")
    # The ground is the same at both instants.
    own, trained = scene.spec.weather, scene.temperature_state.source.trained
    if own is not None and trained.albedo is None:
        trained = replace(trained, albedo=own.albedo, albedo_std=own.albedo_std)
    there = here.with_weather(trained)
    try:
        there.weather  # noqa: B018 - read here, so that its errors name the right section
    except ThermorenderError as error:
        raise ThermorenderError(str(error).replace("[weather]", "[temperature.trained]", 1)) from None
    return here, there


@dataclass(frozen=True)
class Expected:
    """Result of the heat balance for the terrain's texels at an instant."""

    kelvin: NDArray[np.float32]  # (T,)
    changes: NDArray[np.float16]  # (P, T) effect of one standard deviation of each of `PROPERTIES` [K], to 0.05 %


def expected(
    scene: Scene, times: "Sequence[np.datetime64]", geometry: Geometry, progress: Progress | None = None
) -> list[Expected]:
    """Return the Expected of a scene at each of some instants, from one simulation and one per property."""
    if not len(times):
        return []
    count = len(PROPERTIES) + 1

    def simulated(of: Scene, number: int) -> list[NDArray[np.float32]]:
        return [_kelvin(each) for each in solved(of, times, geometry, _share_of(progress, number, count))]

    kelvin = simulated(scene, 0)
    changes = [np.empty((len(PROPERTIES), len(values)), dtype=np.float16) for values in kelvin]
    for number, name in enumerate(PROPERTIES):
        other = scene.with_surfaces(materials=tuple(shifted(material, name) for material in scene.materials))
        for change, values, own in zip(changes, simulated(other, number + 1), kelvin, strict=True):
            change[number] = values - own
    return [Expected(*each) for each in zip(kelvin, changes, strict=True)]


class Carried:
    """Differences of a map's texels from the balance at the trained instant; `there` and `here` come from
    `balances`."""

    def __init__(self, scene: Scene, there: Scene, here: Scene, before: Expected) -> None:
        assert there.time is not None
        self.scene, self.before, self.here, self.trained = scene, before, here.weather, (there.weather, there.time)
        terrain = scene.surfaces[: scene.terrain_count]
        self.shape = [surface.material.shape for surface in terrain]
        material = np.concatenate([surface.material.ravel() for surface in terrain])
        self.failed = np.concatenate([surface.flags.ravel() & FALLBACK for surface in terrain]) > 0
        source = scene.temperature_state.source
        assert isinstance(source, Moved)
        given = np.concatenate([values.ravel() for values in source.temperatures]).astype(np.float64)
        self.difference = np.where(self.failed, 0.0, given - before.kelvin)
        self.error = source.error_k**2
        self.snow = np.array([_is_snow(each) for each in scene.materials])[material]
        own, ratio = _product(before, before), np.ones(len(scene.materials))
        for number in np.unique(material[~self.failed]):
            of = (material == number) & ~self.failed
            observed = float(np.median(self.difference[of] ** 2)) / _MEDIAN_OF_SQUARE
            predicted = max(float(np.median(own[of])) + self.error, 1e-12)
            ratio[number] = max(1.0, (observed - BALANCE_ERROR_K**2) / predicted)
        self.ratio = ratio[material]
        self.own = self.ratio * own

    def to(self, at: np.datetime64, after: Expected) -> MovedMap:
        """Return the MovedMap at an instant, given the Expected of that instant."""
        kelvin, rest = after.kelvin, BALANCE_ERROR_K**2
        shared, spread = self.ratio * _product(self.before, after), self.ratio * _product(after, after)
        correlation = _correlation(self.trained, (self.here, at))
        error = self.ratio * self.error
        whole = self.own + rest + error
        gain = (shared + correlation * rest + correlation**_OF_ERROR * error) / whole
        alone = self.failed | self._ground_changes(at, kelvin)
        gain[alone] = 0.0
        variance = gain**2 * whole - 2.0 * gain * (shared + correlation * rest) + spread + rest
        std = np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)
        # At the trained instant the error is the map's own, up to rounding.
        unmoved = alone | (std > np.maximum(MOST_STD_K, 1.001 * np.sqrt(error)))
        values = kelvin + gain * self.difference
        # Snow is not warmer than its melting point.
        values = np.where(self.snow, np.minimum(values, np.maximum(kelvin, ZERO_CELSIUS_K)), values)
        flags = [
            (surface.flags & ~np.uint8(UNMOVED)) | np.where(mask, np.uint8(UNMOVED), np.uint8(0))
            for surface, mask in zip(self.scene.surfaces, self._split(unmoved), strict=False)
        ]
        report = {
            "trained": utc_text(self.trained[1]),
            "mean_absolute_difference_k": round(float(np.abs(self.difference[~self.failed]).mean()), 3)
            if not self.failed.all() else None,
            "mean_uncertainty_k": round(float(std.mean(dtype=np.float64)), 3),
            "share_unmoved": round(float(unmoved.mean()), 5),
            "correlation": round(correlation, 3),
        }  # fmt: skip
        solved_scene = self.scene.with_solved_temperatures(at, self._split(values), flags=flags, moved_report=report)
        return MovedMap(solved_scene, tuple(self._split(std)))

    def _split(self, flat: NDArray[Any]) -> list[NDArray[Any]]:
        """An array over all texels as one per surface."""
        pieces = np.split(flat, np.cumsum([np.prod(shape) for shape in self.shape])[:-1])
        return [piece.reshape(shape) for piece, shape in zip(pieces, self.shape, strict=True)]

    def _ground_changes(self, at: np.datetime64, kelvin: NDArray[Any]) -> NDArray[np.bool_]:
        """Where the ground is white, wet or melting at only one of the instants."""
        both = self.trained, (self.here, at)
        white = [bool(weather.at(instant).snow_m > 0.0) for weather, instant in both]
        wet = [_wet(*each) for each in both]
        if white[0] != white[1] or wet[0] != wet[1]:
            return np.ones(len(kelvin), dtype=bool)
        melts = [values > ZERO_CELSIUS_K - _MELTS_K for values in (self.before.kelvin, kelvin)]
        return self.snow & (melts[0] != melts[1])


def _share_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Progress of one of `count` equal parts of the work."""
    return None if progress is None else lambda what, share: progress(what, (number + share) / count)


def _product(one: Expected, other: Expected) -> NDArray[np.float64]:
    """Σ S(t) S(t′) over the properties, (T,) [K²]."""
    total = np.zeros(len(one.kelvin))
    for first, second in zip(one.changes, other.changes, strict=True):
        total += first.astype(np.float64) * second
    return total


def _kelvin(scene: Scene) -> NDArray[np.float32]:
    return np.concatenate([surface.temperature.ravel() for surface in scene.surfaces[: scene.terrain_count]])


def _is_snow(material: Material) -> bool:
    return any(part.thermal is not None and part.thermal.cover == "snow" for part, _ in parts_of(material))


def _wet(weather: Weather, at: np.datetime64) -> bool:
    """Whether rain has fallen in the hours before an instant, or since the weather begins."""
    hours = at - np.arange(_WET_H) * np.timedelta64(3600, "s")
    return float(weather.at(np.maximum(hours, weather.time[0])).rain_mm_h.sum()) > _WET_MM


def _correlation(there: Instant, here: Instant) -> float:
    """ρ between the trained instant and another, of the error that no property explains."""
    both = []
    for weather, instant in (there, here):
        recent = np.maximum(instant + _RECENT, weather.time[0])
        seen = weather.at(recent)
        sine = np.sin(np.radians(np.maximum(weather.sun(recent)[1], 0.0)))
        both.append({
            "sun": float((seen.direct_w_m2 * sine + seen.diffuse_w_m2).mean()),
            "air": float(seen.air_k[-1]),
            "wind": float(seen.wind_m_s.mean()),
        })  # fmt: skip
    hours = float((here[1] - there[1]) / np.timedelta64(1, "h"))
    # The nearest way round the clock, and round the year.
    away = {
        "hour": abs((hours + 12.0) % 24.0 - 12.0),
        "day": abs((hours / 24.0 + 182.6) % 365.25 - 182.6),
        **{name: both[0][name] - both[1][name] for name in both[0]},
    }
    return float(np.exp(-0.5 * sum((away[name] / reach) ** 2 for name, reach in REACH.items())))
