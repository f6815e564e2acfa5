"""Temperatures after an edit of materials or of the air, to first order: drawn texels are solved again, others follow.

The drawn texels get the light of the run before the edit and its change: what the faces of edited materials send more,
by the sun on them, straight and reflected once. The change of their temperatures is fitted, material by material, by a
quadratic function of what every column knows of its light. Each drawn texel's residual, as if it had not taken part in
the fit, and a half of what the change of the light does give the error.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.materials.material import Material
from thermorender.physics import balance
from thermorender.physics.balance import TERMS, State
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.render.arrays import aligned
from thermorender.render.heat.known_light import SUNLIGHT, Record
from thermorender.render.heat.matter import Kinds, Matter, Parts, evaluate, forcing_of, of_kinds, open_columns
from thermorender.render.heat.steps import Library
from thermorender.scene import open_ground
from thermorender.scene.scene import Scene
from thermorender.scene.surface import fill, nearest_valid
from thermorender.scene.temperature_state import Available, Balance
from thermorender.scene.weathered_ground import parts_in_weather
from thermorender.weather.series import Conditions, Weather

Floats = NDArray[np.float64]

# Weight of the squares of a fit's coefficients, against the residuals of so many texels.
_RIDGE = 0.01
# Change of the light below which a texel of a material that was not edited keeps its temperature [W m⁻²].
_LEAST_W_M2 = 0.05
# The change of the light is summed with weights that fall by 1/e in this time [s].
_PAST_S = 2 * 3600.0
# What an edit may change that is not light on the ground. The sun of a scene with air is stated once it is solved; it
# follows from what is compared.
_MAY_CHANGE = {"materials", "surfaces", "temperature_state", "spec_weather", "noted_weather", "sun"}
# Share of the change by the light that counts as its error; factors on the error of drawn texels for that of all of
# them, and for the largest. In the village and on the heath they lie above the true ones.
_OF_LIGHT, _SURE, _BEYOND = 0.5, 2.0, 3.0
# Largest error of a preview that is of use, as a share of the change.
_OF_USE = 0.5
# Least error of temperatures [K]: steps are rounded, and columns may settle on other days than those of a run.
_LEAST_K = 5e-3
# Columns at a time where a fit is evaluated.
_AT_ONCE = 1 << 16


@dataclass(eq=False)
class SolvedHeat:
    """A scene with the temperatures of a run that was recorded, from which edits are previewed."""

    scene: Scene
    record: Record
    # Texels that take the temperatures of others since no face shows them, of each surface
    nearest: list[NDArray[np.intp] | None] | None = None

    def preview(self, scene: Scene) -> Scene | None:
        """Return an edit of this scene with temperatures to first order, whose errors its state has; None where it
        needs a run, or where the error would not be below half of the change."""
        before, record = self.scene, self.record
        if not _comparable(before, scene, record):
            return None
        assert scene.time is not None
        parts = parts_in_weather(
            scene.materials, scene.weather, scene.time, scene.altitude_m - scene.weather.altitude_m
        )
        present, materials, count = record.present, np.unique(record.material), len(parts)
        make = open_columns(scene.weather, scene.time)
        # Kinds before an edit come first, with the numbers that they had in the run.
        kinds = Kinds([*record.parts, *parts], np.concatenate([present, count + present]), make)
        same_air = all(map(np.array_equal, _series(before.weather), _series(scene.weather)))
        weather = before.weather if same_air else scene.weather
        edited = np.array([each for each in materials if not (same_air and _same(kinds, each, count + each))], np.int64)
        begin = record.begin, _settled(record, weather, kinds, count + present)
        change, by_light, received = _changes(record, before.weather, weather, kinds, edited, begin)
        solved = before.surfaces[: before.solved_count]
        material, found = (
            np.concatenate([getattr(surface, name).ravel() for surface in solved])
            for name in ("material", "temperature")
        )
        square, most = np.zeros(2), 0.0
        # Texels on faces, material after material.
        texels = np.flatnonzero(record.column >= 0)
        texels = texels[np.argsort(material[texels], kind="stable")]
        ends = np.cumsum(np.bincount(material[texels], minlength=count))
        for number in materials:
            drawn = record.material == number
            fit = Fit(np.column_stack([record.own, received[record.face]])[drawn].astype(float), change[drawn])
            texel = texels[ends[number - 1] if number else 0 : ends[number]]
            # Mixtures with a part in common may share a column, which changes with each of them in its own way.
            column, of_texel = np.unique(record.column[texel], return_inverse=True)
            light = received[record.faces[column]]
            lit = np.flatnonzero((np.abs(light).max(axis=1) > _LEAST_W_M2) | (number in edited))
            moved = np.zeros(len(column), np.float32)
            for part in np.array_split(lit, len(lit) // _AT_ONCE + 1):
                moved[part] = fit(np.column_stack([record.known[column[part]], light[part]]))
            found[texel] += moved[of_texel]
            error = _SURE * np.hypot(fit.residual, _OF_LIGHT * by_light[drawn])
            square += len(texel) * np.array([(error**2).mean(), (change[drawn] ** 2).mean()])
            most = max(most, _BEYOND * float(error.max()))
        if square[0] > _OF_USE**2 * square[1]:
            return None
        state = before.temperature_state
        assert isinstance(state, Available)
        made = scene.with_solved_temperatures(
            scene.time, self._covered(found), scatter_k=[one.scatter_k for one in solved if one.scatter_k is not None],
            notes=state.notes,
            preview_k=(float(np.hypot(np.sqrt(square[0] / len(texels)), _LEAST_K)), most + _BEYOND * _LEAST_K),
        )  # fmt: skip
        return made

    def terms(self, scene: Scene) -> dict[str, NDArray[np.float32]] | None:
        """Return the `balance.TERMS` of all texels in the last step of the run, (T,) each [W m⁻²], NaN where no
        temperature is solved; None where a scene of these surfaces has other temperatures or those of a preview."""
        state, pairs = scene.temperature_state, zip(self.scene.surfaces, scene.surfaces, strict=True)
        same = all(np.array_equal(one.temperature, other.temperature) for one, other in pairs)
        if not same or not isinstance(state, Available) or state.preview_k is not None:
            return None
        record, found = self.record, {}
        others = np.full(sum(each.material.size for each in self.scene.surfaces) - len(record.row), np.nan, np.float32)
        for number, name in enumerate(TERMS):
            parts = self._covered(record.terms[record.row, number])
            found[name] = np.concatenate([*(part.ravel() for part in parts), others])
        return found

    def _covered(self, values: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Values of texels by surface; texels without a face, which only blend, take the nearest's."""
        solved = self.scene.surfaces[: self.scene.solved_count]
        ends = np.cumsum([surface.material.size for surface in solved])[:-1]
        shape = [surface.material.shape for surface in solved]
        if self.nearest is None:
            valid = [part.reshape(of) >= 0 for part, of in zip(np.split(self.record.column, ends), shape, strict=True)]
            self.nearest = [None if part.all() else nearest_valid(part) for part in valid]
        parts = [part.reshape(of) for part, of in zip(np.split(values, ends), shape, strict=True)]
        return [part if of is None else fill(part, of) for part, of in zip(parts, self.nearest, strict=True)]


def _comparable(before: Scene, scene: Scene, record: Record) -> bool:
    """Whether scenes differ in materials, or in weather with the same sun and snow, and in nothing else."""
    if not scene.changes(before) <= _MAY_CHANGE or scene.time != before.time:
        return False
    if not isinstance(scene.temperature_state.source, Balance) or len(scene.materials) != len(before.materials):
        return False
    for one, other in zip(before.surfaces, scene.surfaces, strict=True):
        if one.inner_w_m2 != other.inner_w_m2 or not np.array_equal(one.material, other.material):
            return False
    solved = slice(before.solved_count, None)
    held = list(zip(before.surfaces[solved], scene.surfaces[solved], strict=True))
    if before.solved_count != scene.solved_count or not all(
        np.array_equal(a.temperature, b.temperature) for a, b in held
    ):
        return False
    # What surfaces of known temperature send is not in the change of the light.
    pairs = list(zip(before.materials, scene.materials, strict=True))
    of_known = np.unique(np.concatenate([np.zeros(0, np.uint8), *(np.unique(a.material) for a, _ in held)]))
    if not all(_alike(*pairs[number]) for number in of_known):
        return False
    if before.spec.temperature.brightness:
        # The factor on the reflectance follows colours, and is of mineral ground.
        colours = zip(before.surfaces, scene.surfaces, strict=True)
        if not all(np.array_equal(a.colour, b.colour) for a, b in colours):
            return False
        if any(open_ground.bare(a) != open_ground.bare(b) for a, b in pairs):
            return False
    return scene.weather is before.weather or _alike_sky(before, scene, record)


def _alike(one: Material, other: Material) -> bool:
    """Whether two materials emit and reflect alike."""
    names = ("wavelength_um", "emissivity", "emissivity_by_angle", "solar_absorptance")
    return one is other or all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def _alike_sky(before: Scene, scene: Scene, record: Record) -> bool:
    """Whether two weathers have the same sun, snow, place and sensors from when the ground settles until the instant of
    the scene."""
    assert before.spec.weather is not None and scene.spec.weather is not None and before.time is not None
    old, new = before.weather, scene.weather
    same = "latitude_deg", "longitude_deg", "altitude_m", "air_height_m", "wind_height_m"
    if before.spec.weather.inside_c != scene.spec.weather.inside_c or any(
        getattr(old, name) != getattr(new, name) for name in same
    ):
        return False
    first, other = (max(each.time[0], record.start - open_ground.LOOK_BACK) for each in (old, new))
    if first != other or new.time[-1] < before.time:
        return False
    # Between the rows of both, all quantities are linear.
    times = np.unique(np.concatenate([old.time, new.time, [first, before.time]]))
    times = times[(times >= first) & (times <= before.time)]
    return all(
        np.array_equal(getattr(old.at(times), name), getattr(new.at(times), name))
        for name in ("direct_w_m2", "diffuse_w_m2", "snow_m")
    )


def _series(weather: Weather) -> list[NDArray[Any]]:
    """The instants of a weather, and its quantities there."""
    return [weather.time, *weather.at(weather.time)]


def _same(kinds: Kinds, one: int, other: int) -> bool:
    """Whether two materials have the same columns."""
    return bool(
        kinds.count[one] == kinds.count[other]
        and (kinds.kind[one] == kinds.kind[other]).all()
        and np.allclose(kinds.weight[one], kinds.weight[other], rtol=1e-12, atol=0.0)
    )


def _kinds_of(kinds: Kinds, materials: NDArray[np.integer]) -> NDArray[np.int64]:
    """The numbers of the kinds of column that some materials have, ascending."""
    return np.unique(np.concatenate([kinds.kind[each, : kinds.count[each]] for each in materials]))


def _settled(record: Record, weather: Weather, kinds: Kinds, materials: NDArray[np.integer]) -> State:
    """The State of the kinds of some materials at the start of the run, which settle together as those of a run do, for
    as many days as the slowest of them needs."""
    columns = open_ground.chosen(kinds.columns, _kinds_of(kinds, materials))
    return open_ground.settled(columns, weather, record.start, record.inside_k)[0]


def _changes(
    record: Record, old: Weather, new: Weather, kinds: Kinds, edited: NDArray[np.integer], begin: tuple[State, State]
) -> tuple[Floats, Floats, NDArray[np.float32]]:
    """(change of the temperatures of drawn texels (D,) [K], part of it by the change of the light (D,) [K], change of
    the light on faces in the last hours, of the sun's and long-wave (F, 2) [W m⁻²]). `begin` are the states of
    the kinds at the start before and after the edit."""
    mi, count, drawn = record.mi, len(record.parts), len(record.material)
    # Every drawn texel before the edit, after it in the light before, and after it.
    material = np.concatenate([record.material, count + record.material, count + record.material])
    parts = Parts(kinds, material)
    turn, of = np.divmod(parts.place, drawn)
    at, after = mi.UInt32(aligned(of, np.uint32)), mi.Bool(turn > 0)
    lit = mi.Float(aligned((turn == 2).astype(np.float32)))
    sky, cooler, inner, reflects = (each[of] for each in record.own.T[-4:])
    sky, cooler = mi.Float(aligned(sky)), mi.Float(aligned(cooler))

    def begun(found: State, materials: NDArray[np.integer]) -> tuple[Matter, State]:
        # Rows of all kinds, of which these materials read their own.
        own = _kinds_of(kinds, materials)
        row = np.searchsorted(own, np.arange(len(kinds.columns.absorptance))).clip(max=len(own) - 1)
        liquid = None if found.liquid is None else [each[row] for each in found.liquid]
        whole = State(found.surface_k[row], [each[row] for each in found.layers_k], found.film[row], liquid)
        return of_kinds(mi, kinds.columns, whole, parts.kind, reflects, inner if inner.any() else None)

    present = record.present
    matter, state = begun(begin[0], present)
    state = _where(after, begun(begin[1], count + present)[1], state)
    sending = _Sending(record, edited, of, turn, parts, matter)
    more = [np.zeros(drawn, np.float32)] * 2
    past: Any = 0.0
    for (begin_s, seconds), light in zip(record.steps, record.light, strict=True):
        forcings = []
        change = [mi.Float(aligned(each)) for each in more]
        for offset, given in zip(balance.stage_times(seconds), light, strict=True):
            instant = record.start + np.timedelta64(round(1000.0 * (begin_s + offset)), "ms")
            found: Any = [dr.opaque(mi.Float, float(each)) for each in old.at(instant)]
            if new is not old:
                later = [dr.opaque(mi.Float, float(each)) for each in new.at(instant)]
                found = [dr.select(after, b, a) for a, b in zip(found, later, strict=True)]
            found = Conditions(*found)
            sunlight, longwave = (
                dr.gather(mi.Float, known, at) + lit * dr.gather(mi.Float, plus, at)
                for known, plus in zip(given, change, strict=True)
            )
            longwave += sky * (found.longwave_w_m2 - dr.opaque(mi.Float, float(old.at(instant).longwave_w_m2)))
            air = found.air_k + cooler
            forcings.append(forcing_of(found, record.inside_k, matter, dr.maximum(sunlight, 0.0), longwave, air))
        state, _ = balance.step(Library, state, matter.ground, forcings[0], forcings[1], dr.opaque(mi.Float, seconds))
        evaluate(state)
        sent = sending.change(matter, forcings[1], balance.seen_k(state, matter.ground))
        more = sending.received(sent)
        past = sent + np.exp(-seconds / _PAST_S) * (past - sent)
    kelvin = parts.kelvin(np.array(balance.seen_k(state, matter.ground))).astype(float).reshape(3, drawn)
    return kelvin[2] - kelvin[0], kelvin[2] - kelvin[1], sending.on_faces(past)


class _Sending:
    """How much more the faces of edited materials send, by a linear function of the sun on them, and how much of it
    others receive: straight, and reflected once."""

    def __init__(
        self, record: Record, edited: NDArray[np.integer], of: NDArray[np.integer], turn: NDArray[np.integer],
        parts: Parts, matter: Matter,
    ) -> None:  # fmt: skip
        count = len(record.parts)
        self._count, self._of, self._edited = count, record.material[of], edited
        # In the light before: what is reflected again is left out.
        self._share = np.array([-1.0, 1.0, 0.0])[turn] * parts.share()
        sun = record.own[:, SUNLIGHT].astype(float)
        self._number = number = np.maximum(np.bincount(record.material, minlength=count), 1)
        total, square = (np.bincount(record.material, each, count) for each in (sun, sun**2))
        mean = total / number
        self._spread = np.maximum(square / number - mean**2, 1.0)
        self._lean = sun[of] - mean[self._of]
        # Faces are no brighter or darker than the drawn texels, from which the slope is known.
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, record.material, sun)
        np.maximum.at(high, record.material, sun)
        solved, operator = len(record.face_column), record.factors.operator
        kind = record.face_material[:solved]
        drawn = np.flatnonzero(low <= high)
        lean = np.zeros(solved)
        some = np.isin(kind, drawn)
        on_face = record.known[record.face_column[some], SUNLIGHT]
        lean[some] = np.clip(on_face, low[kind[some]], high[kind[some]]) - mean[kind[some]]
        sends = np.zeros((len(record.face_material), 2 * len(edited)), np.float32)
        for number_of, material in enumerate(edited):
            own = np.flatnonzero(kind == material)
            sends[own, number_of], sends[own, len(edited) + number_of] = 1.0, lean[own]
        straight = operator @ sends
        # (2, F, 2 E) for what E edited materials send in sunlight and long-wave.
        self._on_faces = []
        for reflects in (1.0 - matter.absorptance, 1.0 - matter.ground.emissivity):
            later = np.where(turn == 1, parts.share(), 0.0) * np.array(reflects)
            by_material = np.bincount(self._of, later, count) / number
            reflected = np.zeros((len(sends), 1), np.float32)
            reflected[:solved, 0] = by_material[kind]
            self._on_faces.append(straight + operator @ (reflected * straight))
        self._on_drawn = [each[record.face] for each in self._on_faces]

    def change(self, matter: Matter, forcing: Any, seen_k: Any) -> Floats:
        """Return the change of what edited materials send in sunlight and long-wave (2, 2 E): mean and slope."""
        emits = matter.ground.emissivity * (STEFAN_BOLTZMANN * dr.square(dr.square(seen_k)) - forcing.longwave)
        leaves = [(1.0 - matter.absorptance) * forcing.sunlight, emits + forcing.longwave]
        dr.eval(leaves)
        found = []
        for each in leaves:
            values = self._share * np.array(each)
            mean = np.bincount(self._of, values, self._count) / self._number
            slope = np.bincount(self._of, values * self._lean, self._count) / self._number / self._spread
            found.append(np.concatenate([mean[self._edited], slope[self._edited]]))
        return np.array(found)

    def received(self, sent: Floats) -> list[NDArray[np.float32]]:
        """Return how much more the drawn texels receive, in sunlight and in long-wave (D,) [W m⁻²]."""
        return [on @ np.float32(each) for on, each in zip(self._on_drawn, sent, strict=True)]

    def on_faces(self, sent: Floats) -> NDArray[np.float32]:
        """Return how much more every face receives, in sunlight and long-wave (F, 2) [W m⁻²]."""
        return np.stack([on @ np.float32(each) for on, each in zip(self._on_faces, sent, strict=True)], axis=1)


def _where(mask: Any, one: State, other: State) -> State:
    """The State of one or the other."""
    pick = lambda a, b: [dr.select(mask, x, y) for x, y in zip(a, b, strict=True)]  # noqa: E731
    assert (one.liquid is None) == (other.liquid is None)
    liquid = None if one.liquid is None or other.liquid is None else pick(one.liquid, other.liquid)
    state = State(
        dr.select(mask, one.surface_k, other.surface_k), pick(one.layers_k, other.layers_k),
        dr.select(mask, one.film, other.film), liquid,
    )  # fmt: skip
    evaluate(state)
    return state


class Fit:
    """A quadratic function of several variables, fitted to values (n,); `residual` (n,) is of each without itself."""

    residual: Floats

    def __init__(self, x: Floats, y: Floats) -> None:
        low, high = x.min(axis=0), x.max(axis=0)
        self._varies = np.flatnonzero(high - low > 1e-6 * (1.0 + np.abs(high)))
        self._low, self._high = low[self._varies], high[self._varies]
        terms = self._terms(x)
        inverse = np.linalg.inv(terms.T @ terms + _RIDGE * np.eye(terms.shape[1]))
        self._weight = inverse @ (terms.T @ y)
        self._bounds = y.min(), y.max()
        lever = np.einsum("ij,jk,ik->i", terms, inverse, terms)
        self.residual = (y - terms @ self._weight) / np.maximum(1.0 - lever, 1e-3)

    def __call__(self, x: NDArray[Any]) -> Floats:
        """Return values of the function; outside the range of the variables it is that at their bounds."""
        return np.clip(self._terms(x) @ self._weight, *self._bounds)

    def _terms(self, x: NDArray[Any]) -> NDArray[Any]:
        inside = np.clip(x[:, self._varies], self._low, self._high)
        z = 2.0 * (inside - self._low) / (self._high - self._low) - 1.0
        first, second = np.triu_indices(len(self._low))
        return np.hstack([np.ones((len(z), 1), z.dtype), z, z[:, first] * z[:, second]])
