"""Columns of materials: what they are made of, the parts of a material that are one each, and what acts on them."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.materials.material import Material
from thermorender.physics import humidity, turbulence
from thermorender.physics.balance import ColumnProperties, Forcing, State
from thermorender.render.arrays import Jit, aligned
from thermorender.render.heat.steps import Library
from thermorender.scene import open_ground
from thermorender.weather.series import Conditions, Weather

# ((part, share), …) of each material of a scene.
PartsOf = Sequence[tuple[tuple[Material, float], ...]]


class Matter(NamedTuple):
    """What columns are made of: Dr.Jit arrays, an entry each."""

    ground: ColumnProperties
    absorptance: Any
    wind_factor: Any
    indoors: Any
    inner_w_m2: Any  # heat from within; None: no object has any


class Parts:
    """The parts of places' materials, a column each: `place`, `kind` and share in the `weight` of emission (P,)."""

    def __init__(self, kinds: "Kinds", material: NDArray[np.integer]) -> None:
        count = kinds.count[material]
        self.place = np.repeat(np.arange(len(material)), count)
        self._start = np.cumsum(count) - count
        part = np.arange(len(self.place)) - self._start[self.place]
        self.kind = kinds.kind[material[self.place], part]
        mixed = bool((count > 1).any())
        self._weight, self._area = (
            each[material[self.place], part] if mixed else None for each in (kinds.weight, kinds.area)
        )

    @property
    def mixed(self) -> bool:
        """Whether a place has several parts."""
        return self._area is not None

    def share(self) -> NDArray[np.float64]:
        """Return the share of each part in the emission of its place, (P,)."""
        return np.ones(len(self.place)) if self._weight is None else self._weight

    def kelvin(self, columns: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the temperatures of the places, of which the columns' emissions add up (P,) [K]."""
        if self._weight is None:
            return columns
        return (np.add.reduceat(self._weight * columns.astype(np.float64) ** 4, self._start) ** 0.25).astype(np.float32)

    def mean(self, columns: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the means by area, over the parts of each place, of values of the columns (P, n)."""
        if self._area is None:
            return columns
        return np.add.reduceat(self._area[:, None] * columns, self._start).astype(np.float32)


class Kinds:
    """The kinds of column that parts of materials are: each material has `count` (M,) of them, with the numbers `kind`,
    shares of its `area` and shares in its emission at a common temperature, `weight`, (M, most) each."""

    def __init__(self, parts: PartsOf, present: NDArray[np.integer], make: Callable[[Sequence[Material]], Any]) -> None:
        used = [part for number in present for part, _ in parts[number]]
        columns = make(used)
        # Parts of several mixtures have the same column.
        given = [values for values in columns.ground if values is not None]
        rows = [columns.absorptance, columns.wind_factor, columns.indoors, columns.snow_m, *map(np.atleast_2d, given)]
        _, first, number = np.unique(np.vstack(rows), axis=1, return_index=True, return_inverse=True)
        # Numbered in the order of materials, which an edit of their values keeps.
        order = first.argsort()
        number = order.argsort()[number.reshape(-1)]
        self.columns = columns if len(first) == len(used) else make([used[index] for index in first[order]])
        self.count = np.ones(len(parts), np.int64)
        self.count[present] = [len(parts[each]) for each in present]
        self.kind = np.zeros((len(parts), self.count.max()), np.int64)
        self.weight, self.area = np.ones(self.kind.shape), np.ones(self.kind.shape)
        for material, kinds in zip(present, np.split(number, np.cumsum(self.count[present])[:-1]), strict=True):
            area = np.array([share for _, share in parts[material]])
            emitted = area * [open_ground.broadband(part) for part, _ in parts[material]]
            self.kind[material, : len(kinds)], self.weight[material, : len(kinds)] = kinds, emitted / emitted.sum()
            self.area[material, : len(kinds)] = area / area.sum()


def of_kinds(
    mi: Any, alike: open_ground.Columns, begin: State, kind: NDArray[np.integer], reflects: NDArray[np.float32],
    inner_w_m2: NDArray[np.float32] | None,
) -> tuple[Matter, State]:  # fmt: skip
    """Return (Matter, State) of columns of these kinds of `alike`, which begin in the states `begin` of the kinds, with
    these factors on their reflectances and heat from within."""
    number = mi.UInt32(aligned(kind, np.uint32))
    row = lambda values: dr.gather(mi.Float, mi.Float(aligned(values)), number)  # noqa: E731
    rows = lambda values: [row(each) for each in values]  # noqa: E731
    properties: dict[str, Any] = {
        name: rows(values) if isinstance(values, list) else None if values is None else row(values)
        for name, values in alike.ground._asdict().items()
    }
    liquid = None if begin.liquid is None else rows(begin.liquid)
    state = State(row(begin.surface_k), rows(begin.layers_k), row(begin.film), liquid)
    absorptance = dr.clip(1.0 - row(1.0 - alike.absorptance) * mi.Float(aligned(reflects)), 0.02, 0.98)
    evaluate(state)
    dr.eval(absorptance)
    inner = None if inner_w_m2 is None else mi.Float(aligned(inner_w_m2))
    indoors = row(alike.indoors) > 0.5
    return Matter(ColumnProperties(**properties), absorptance, row(alike.wind_factor), indoors, inner), state


def open_columns(weather: Weather, at: np.datetime64) -> Callable[[Sequence[Material]], open_ground.Columns]:
    """Return the function that makes open columns of parts of materials, under the snow of an instant."""
    snow = float(weather.at(at).snow_m)
    return lambda of: open_ground.columns(of, weather, snow, open_ground.STATION_ROUGHNESS_M)


def forcing_of(found: Conditions, inside_k: float, matter: Matter, sunlight: Jit, longwave: Jit, air: Jit) -> Forcing:
    """Return the Forcing of columns in this light [W m⁻²] and air [K]; `inside_k` is the air inside buildings."""
    one = lambda value: value if isinstance(value, type(air)) else dr.opaque(type(air), float(value))  # noqa: E731
    # Relative humidity is constant with height; pressure follows the lapse of the standard atmosphere.
    saturation, below = (turbulence.saturation_vapour(Library, each)[0] for each in (air, one(found.air_k)))
    thinner = dr.exp(humidity.PRESSURE_EXPONENT * dr.log(air / one(found.air_k)))
    return Forcing(
        absorbed=matter.absorptance * sunlight,
        longwave=longwave,
        # Stomata open in the light on their own leaves.
        sunlight=sunlight,
        air_k=air,
        vapour_pa=one(found.vapour_pa) * (saturation / below),
        wind_m_s=one(found.wind_m_s) * matter.wind_factor,
        pressure_pa=one(found.pressure_pa) * thinner,
        rain_kg_m2_s=one(found.rain_mm_h / 3600.0),
        below_k=dr.select(matter.indoors, one(inside_k), air),
        inner_w_m2=matter.inner_w_m2,
    )


def varied(ground: ColumnProperties, wetness: Jit, exchange: Jit, inertia: Jit) -> ColumnProperties:
    """ColumnProperties with wetness, turbulent exchange and thermal inertia multiplied by these factors."""
    return ground._replace(
        wetness=dr.minimum(ground.wetness * wetness, 1.0),
        log_heat=ground.log_heat / exchange,
        capacity=[each * inertia for each in ground.capacity],
        conductance=[each * inertia for each in ground.conductance],
    )


def evaluate(state: State) -> None:
    """Compute a State in one kernel; dr.eval would use one kernel per entry of a named tuple."""
    dr.eval(state.surface_k, *state.layers_k, state.film, *(state.liquid or ()), *(state.remainder_k or ()))
