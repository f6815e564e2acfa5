"""Temperatures of a terrain's texels by time stepping of its heat balance on the device, with sun, shadow and
surroundings.

Every texel is a column, or one for each part of a mixture, whose emissions add up: the material on the layers beneath,
at the texel's position on the mesh. At the end of every step a shadow ray from each column tests for the sun, whose
share is linear in time between. Columns of one face and material are one until four hours before the first instant;
from then on those are that also have like sun: 12 mK RMS, and a quarter to a half of the columns.

Reflected sunlight and the long-wave radiation of the surroundings use the rays of the scene's light. They are one value
per face, solved between columns at the faces' middles, every hour at first and every half hour in the last four.

A simulation begins two days before the first instant requested, from settled columns in the open: one day leaves 0.1 K
(RMS) in a village, 0.4 K in its water. Texels are simulated in blocks, each together with all faces, which bounds
memory.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.physics import balance, humidity
from thermorender.physics.balance import Forcing, State
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.physics.srgb import linear_from_bytes
from thermorender.render.arrays import Jit, aligned
from thermorender.render.geometry import Geometry
from thermorender.render.heat.copies import Copies
from thermorender.render.heat.known_light import Record, Recorder, ViewFactors
from thermorender.render.heat.matter import (
    Kinds,
    Matter,
    Parts,
    PartsOf,
    evaluate,
    forcing_of,
    of_kinds,
    open_columns,
    varied,
)
from thermorender.render.heat.places import lit_cosine, texel_points
from thermorender.render.heat.steps import Library, steps_to
from thermorender.render.heat.sun_on_columns import Sun, SunShares, mixed
from thermorender.render.light import contacts, radiosity, transport_cache
from thermorender.render.light.exchange import threads
from thermorender.render.variant import activate
from thermorender.scene import open_ground
from thermorender.scene.crowns import Crowns
from thermorender.scene.deviations import Deviations
from thermorender.scene.scene import Scene
from thermorender.scene.surface import fill, nearest_valid
from thermorender.scene.textures import separate
from thermorender.scene.weathered_ground import is_snow, parts_in_weather
from thermorender.units import ZERO_CELSIUS_K, utc_text

Progress = Callable[[str, float], object]

# Time simulated before the first instant [s].
_BEFORE_S = 48 * 3600.0
# Interval between solutions of the light between faces while texels share columns, and later [s], or a step if that is
# longer; rays per face; reflections of the first solution.
_SHARED_LIGHT_S, _LIGHT_S, _RAYS, _REFLECTIONS = 3600.0, 1800.0, 64, 4
# Time before the first instant in which each texel has its own sun; earlier those of a face and material share it [s].
_OWN_S = 4 * 3600.0
# Columns of texels simulated at a time, about 350 bytes each; four times as many parts where some share a column to the
# end.
_AT_ONCE = 1 << 22
# Largest factor on reflectance from the brightness of a texel over that of its class.
_BRIGHTEST = 2.0
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. ITU-R BT.709-6, item 3.2
_WHAT = "simulating the heat balance"


def solved(
    scene: Scene, times: "Sequence[np.datetime64]", geometry: Geometry | None = None, progress: Progress | None = None,
    deviations: Deviations | None = None, block: int = 1, records: "list[Record] | None" = None,
    known: "Record | None" = None,
) -> list[Scene]:  # fmt: skip
    """Return the scene with the temperatures of terrain and objects that ask for it at each of some instants (UTC),
    from its heat balance. Other objects keep the temperatures of the scene file, cast shadows and radiate. `deviations`
    make a truth that differs from the material tables. Texels of one material in squares of `block` a side of a picture
    have one temperature, of the mean deviations. `progress` is called with (what, share done). `records` is given the
    Record of the run, for previews of edits, unless the texels are simulated in blocks. `known` is the Record of a run
    before an edit: its light between the faces serves again on the same `geometry`, and its tests for the sun where
    points and instants are the same, too."""
    asked = sorted(set(times))
    geometry = geometry or Geometry(activate(), scene.surfaces)
    report_progress = progress or (lambda what, share: None)
    report_progress(_WHAT, 0.0)
    higher_m = scene.altitude_m - scene.weather.altitude_m
    parts = parts_in_weather(scene.materials, scene.weather, asked[0], higher_m)
    simulation = _Simulation(scene, parts, geometry, asked, deviations, block, known)
    simulation.records = records
    kelvin = simulation.covered(simulation.run(lambda share: report_progress(_WHAT, share)))
    # Dr.Jit keeps the memory of the largest step, 1 GB on heath, which no later work needs.
    dr.flush_malloc_cache()
    report_progress(_WHAT, 1.0)
    note = f"the ground did not settle before {utc_text(simulation.start)}: two equal days differed by "
    notes = (f"{note}{simulation.settled_k:.1f} K",) if simulation.settled_k >= open_ground.SETTLED_K else ()
    borders = geometry.texel_start[1 : scene.solved_count]
    scenes = {}
    for number, (at, values) in enumerate(zip(asked, kelvin, strict=True)):
        own = simulation.copies.scatter_k(number) if simulation.copies else ()
        scenes[at] = scene.with_solved_temperatures(at, np.split(values, borders), notes=notes, scatter_k=own)
    return [scenes[at] for at in times]


@dataclass(frozen=True, eq=False)
class _Columns:
    """Columns at points of the terrain: Dr.Jit arrays. Columns of the parts of a mixture stand at one point."""

    # An entry each point, those of the faces first
    point: Any  # a little above the face
    normal: Any
    face: Any
    cooler: Any  # air temperature there minus that of the weather [K]
    hidden: Any  # share of the sky lost by a leaf that differs from the mean of its patch; 0 elsewhere
    # An entry each column
    place: Any  # number of its point; None: its own
    matter: Matter

    def at_place(self, values: Jit) -> Jit:
        """Return values of the points at the columns."""
        return values if self.place is None else dr.gather(type(values), values, self.place)


class _Simulation:
    """Simulations of a terrain's texels, with the faces and the light between them that all share."""

    def __init__(
        self, scene: Scene, parts: PartsOf, geometry: Geometry, asked: "list[np.datetime64]",
        deviations: Deviations | None, block: int, known: Record | None = None,
    ) -> None:  # fmt: skip
        self.scene, self.parts, self.geometry, self.mi, self.asked = scene, parts, geometry, geometry.mi, asked
        assert scene.spec.weather is not None
        self.weather, self.inside_k = scene.weather, scene.spec.weather.inside_c + ZERO_CELSIUS_K
        # Terrain, followed by the objects whose temperatures are solved, copies of bodies last.
        terrain, ground = scene.surfaces[: scene.solved_count], scene.terrain_count
        self.records: list[Record] | None = None
        self.faces = int(geometry.face_start[scene.solved_count])
        self.texels = int(geometry.texel_start[scene.solved_count])
        self.material = np.concatenate([surface.material.ravel() for surface in terrain])
        self.deviations = None if deviations is None else deviations.columns(self.texels)
        corner = np.concatenate([surface.vertices[surface.faces] for surface in terrain])
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        if across[: geometry.face_start[ground], 2].sum() < 0.0:
            raise ThermorenderError(
                f"{scene.where}: most of the terrain's faces point down, so the sun would light their undersides; "
                "reverse the order of their corners, to counter-clockwise seen from above"
            )
        self.middle = corner.mean(axis=1).astype(np.float32)
        self.normal = (across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)).astype(np.float32)
        self.covers = geometry.face_showing(scene.solved_count)
        self.shown = self.covers < geometry.face_count
        for part in np.split(self.shown, geometry.texel_start[1 : scene.solved_count]):
            part |= not part.any()
        self.reflects = self._brightness() * (1.0 if self.deviations is None else self.deviations[0])
        # Faces with a column of their own, and the column of each face: both sides of leaves share one.
        self.alone, self.column = np.unique(_first_sides(geometry)[: self.faces], return_inverse=True)
        self.first = self._firsts(block)
        self.start = max(asked[0] - np.timedelta64(int(_BEFORE_S), "s"), self.weather.time[0])
        same = known is not None and known.factors.geometry is geometry
        self.factors = known.factors if known is not None and same else _view_factors(geometry)
        self.threads = threads()
        self.reflectance, self.emissivity = self._of_faces()
        self.present = np.unique(np.concatenate([self.material, self.face_material[: self.faces]]))
        self.kinds = Kinds(parts, self.present, open_columns(self.weather, asked[0]))
        # `settled_k` is the change of the ground over the last day of settling [K].
        self.state, self.settled_k = open_ground.settled(self.kinds.columns, self.weather, self.start, self.inside_k)
        self.of_faces = Parts(self.kinds, self.face_material[self.alone])
        solid = sum(surface.instances is None for surface in terrain)
        self.bodies = range(*(int(geometry.face_start[number]) for number in (ground, solid)))
        self.solid_faces = int(geometry.face_start[solid])
        self._start_in_the_open(self.factors.touching)
        inner = np.array([surface.inner_w_m2 for surface in terrain], np.float32)
        self.inner_w_m2 = np.repeat(inner, [len(surface.faces) for surface in terrain]) if inner.any() else None
        copies, self.copies = range(solid, scene.solved_count), None
        if copies:
            self.copies = Copies(geometry, copies, len(asked), lambda at_s: self.sun.towards(self.sun.instant(at_s)))
        self.sun = Sun(
            geometry,
            self.weather,
            self.start,
            self.copies.first if self.copies else None,
            None if known is None else known.sun,
        )

    def _start_in_the_open(self, touching: NDArray[np.integer]) -> None:
        """Move the points of bodies' faces that something covers in part to an open part, where their light starts."""
        faces = touching[(touching >= self.bodies.start) & (touching < self.bodies.stop)]
        if not len(faces):
            return
        rays_of = radiosity.FaceRays(self.geometry, 1)
        found = rays_of.start_in_the_open(contacts.solid(self.geometry), faces)
        if found is not None:
            origin, *_ = rays_of(self.mi.UInt32(aligned(found.faces, np.uint32)), 0)
            self.middle[found.faces] = np.array(origin).T[::2]

    def _of_faces(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(reflectance of sunlight, emissivity) of every face of the scene, by the material at its middle."""
        geometry = self.geometry
        found = next(iter(geometry.points_in_faces([(1.0 / 3.0, 1.0 / 3.0)])))
        number = np.array(geometry.nearest(*found))
        surfaces = self.scene.surfaces  # the geometry may be that of a scene before an edit
        material = np.concatenate([surface.material.ravel() for surface in surfaces])[number]
        temperature = np.concatenate([surface.temperature.ravel() for surface in surfaces])[number]
        self.face_material, self.face_kelvin = material, temperature.astype(np.float32)
        self.face_texel = number
        reflects, emits = (
            np.array([self._mean(number, of) for number in range(len(self.parts))], np.float32)
            for of in (lambda one: 1.0 - one.solar_absorptance, open_ground.broadband)
        )
        return reflects[material], emits[material]

    def _mean(self, number: int, of: Callable[[Material], float]) -> float:
        """A property of a material, or the mean over its parts where snow lies on one of them."""
        material, parts = self.scene.materials[number], self.parts[number]
        if any(is_snow(part) for part, _ in parts):
            return sum(share * of(part) for part, share in parts)
        return of(material)

    def run(self, progress: Callable[[float], object]) -> NDArray[np.float32]:
        """Return the temperature of all texels at each instant requested, (n, T) float32 [K]; 0 where none shows."""
        found = np.zeros((len(self.asked), self.texels), dtype=np.float32)
        own = np.flatnonzero(self.shown)
        every = own[self.first[own] == own]
        most = _AT_ONCE if self.deviations is not None or self.scene.spec.temperature.brightness else 4 * _AT_ONCE
        before = np.cumsum(self.kinds.count[self.material[every]]) - 1
        blocks = np.split(every, np.flatnonzero(np.diff(before // most)) + 1)
        # Previews are for scenes that are edited while someone waits.
        self.records = self.records if len(blocks) == 1 else None
        self.sun.memory = None if self.records is None else {}
        for number, texels in enumerate(blocks):

            def report(share: float, n: int = number) -> None:
                progress((n + share) / len(blocks))

            for index, (of_faces, kelvin) in enumerate(self._simulated(texels, report)):
                found[index, texels] = kelvin
                if self.copies is not None:
                    self.copies.take_means(index, found[index], texels, self.covers[texels], of_faces[self.column])
        found[:, own] = found[:, self.first[own]]
        if self.copies is not None:
            self.copies.spread(self.first)
        return found

    def _firsts(self, block: int) -> NDArray[np.integer]:
        """Number of the texel whose column each texel has, (T,): its own, or that of one texel of its square and
        material, which then has the mean deviations of those texels."""
        number, geometry = np.arange(self.texels), self.geometry
        for k, surface in enumerate(self.scene.surfaces[: self.scene.solved_count]):
            start = geometry.texel_start[k]
            part = slice(start, start + surface.material.size)
            if isinstance(surface.instances, Crowns):
                # Each face has the texel of its number.
                faces = slice(geometry.face_start[k], geometry.face_start[k + 1])
                sides = _first_sides(geometry)[faces] - faces.start
                number[start : start + len(sides)] = start + sides
            elif block > 1 and k < self.scene.terrain_count and not separate(surface):
                shown = self.shown[part].reshape(surface.material.shape)
                number[part] = start + _alike(np.where(shown, surface.material, np.int16(-1)), block)
        if block == 1:
            return number
        count = np.maximum(np.bincount(number, minlength=self.texels), 1)
        mean = lambda values: (np.bincount(number, values, self.texels) / count)[number]  # noqa: E731
        self.reflects[:] = mean(self.reflects)
        # Temperatures are nearly linear in the logarithm of the other factors.
        for values in () if self.deviations is None else self.deviations[1:]:
            values[:] = np.exp(mean(np.log(values)))
        return number

    def covered(self, found: NDArray[Any]) -> NDArray[Any]:
        """Return temperatures of all texels, (n, T) [K]; those without a face, which only blend, take the nearest's."""
        for number, surface in enumerate(self.scene.surfaces[: self.scene.solved_count]):
            part = slice(*self.geometry.texel_start[number : number + 2])
            valid = self.shown[part].reshape(surface.material.shape)
            if not valid.all():
                near = nearest_valid(valid)
                for values in found[:, part]:
                    values[:] = fill(values.reshape(valid.shape), near).ravel()
        return found

    def _brightness(self) -> NDArray[np.float32]:
        """Factor on the reflectance of each texel, (T,) float32: its luminance over the mean of its class, or 1."""
        found = np.ones(self.texels, dtype=np.float32)
        if not self.scene.spec.temperature.brightness:
            return found
        # An object has the colour of its file, which no light of the scene lit.
        colour = np.concatenate([s.colour.reshape(-1, 3) for s in self.scene.surfaces[: self.scene.terrain_count]])
        light, material = linear_from_bytes(colour) @ np.array(_LUMINANCE, np.float32), self.material[: len(colour)]
        mean = np.bincount(material, light) / np.maximum(np.bincount(material), 1)
        ratio = light / np.maximum(mean[material], 1e-4)
        # Dark spots in vegetation, water and snow are shade or depth, not absorption.
        mineral = np.array([all(open_ground.bare(part) for part, _ in parts) for parts in self.parts])
        ratio[~mineral[material]] = 1.0
        found[: len(ratio)] = np.clip(ratio, 1.0 / _BRIGHTEST, _BRIGHTEST)
        return found

    def _columns(
        self, texels: NDArray[np.integer], kinds: NDArray[np.integer],
        sharing: tuple[NDArray[np.integer], NDArray[np.integer]] | None = None,
    ) -> tuple[_Columns, State]:  # fmt: skip
        """The _Columns of all faces' parts, then of parts of some texels, of these `kinds`, and the State. Columns have
        the mean deviations of the texels that are `sharing` them: (texels, column of each)."""
        geometry, mi = self.geometry, self.mi
        count = len(self.alone)
        own, place = np.unique(texels, return_inverse=True)
        face, spot = self._points(own)
        above = geometry.hair_at(self.middle[self.alone]) * self.normal[self.alone]
        point = np.concatenate([self.middle[self.alone] + above, spot])
        face = np.concatenate([self.alone, face]).astype(np.uint32)
        hidden = np.zeros(len(face), np.float32)
        if self.copies is not None:
            hidden[count:] = self.copies.hidden(face[count:])
        place = np.concatenate([self.of_faces.place, count + place])
        # A face that no texel shares has the deviations of the texel at its middle.
        column = np.concatenate([self.face_texel[self.alone], own])[place]
        deviations = [] if self.deviations is None else [each[column] for each in self.deviations[1:]]
        reflects = self.reflects[column]
        if sharing is not None and self.deviations is not None:
            number = np.maximum(np.bincount(sharing[1], minlength=len(column)), 1)
            for own, each in zip((reflects, *deviations), (self.reflects, *self.deviations[1:]), strict=True):
                total = np.bincount(sharing[1], each[sharing[0]], len(column))
                np.copyto(own, total / number, where=total > 0.0, casting="same_kind")
        kind = np.concatenate([self.of_faces.kind, kinds])
        inner = None if self.inner_w_m2 is None else self.inner_w_m2[face[place]]
        matter, state = of_kinds(mi, self.kinds.columns, self.state, kind, reflects, inner)
        if deviations:
            matter = matter._replace(ground=varied(matter.ground, *(mi.Float(aligned(each)) for each in deviations)))
        up = geometry.heights_m(point)
        cooler = -humidity.LAPSE_K_M * (up + np.float32(self.scene.altitude_m - self.weather.altitude_m))
        at = None if len(place) == len(face) else mi.UInt32(aligned(place, np.uint32))
        return _Columns(
            *self._uploaded(point, face), mi.Float(aligned(cooler)), mi.Float(aligned(hidden)), at, matter
        ), state  # fmt: skip

    def _points(self, texels: NDArray[np.integer]) -> tuple[NDArray[np.integer], NDArray[np.float32]]:
        """(face of each of some texels, its point a little above it (n, 3) [m]); those without a face have the last of
        their surface, and texels of bodies the middle of their face."""
        last = self.geometry.face_start[np.searchsorted(self.geometry.texel_start, texels, "right")] - 1
        face = np.minimum(self.covers[texels], last)
        spot = texel_points(self.geometry, texels, face)
        body = (face >= self.bodies.start) & (face < self.bodies.stop)
        spot[body] = self.middle[face[body]]
        return face, spot + self.geometry.hair_at(spot) * self.normal[face]

    def _uploaded(self, point: NDArray[np.float32], face: NDArray[np.integer]) -> tuple[Jit, Jit, Jit]:
        """(points, normals of their faces, numbers of these) on the device."""
        mi = self.mi
        upload = lambda values: (mi.Float(aligned(axis)) for axis in values.T)  # noqa: E731
        number = mi.UInt32(aligned(face, np.uint32))
        return mi.Point3f(*upload(point)), dr.gather(mi.Vector3f, mi.Vector3f(*upload(self.normal)), number), number

    def _simulated(
        self, texels: NDArray[np.integer], progress: Callable[[float], object]
    ) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Yield surface temperatures of all faces that have columns and of some texels, float32 [K], at each instant
        requested. Texels of a face share the columns of their materials' parts until four hours before the first
        instant; from then on only those that also have like sun, and with deviations none."""
        mi, parts = self.mi, Parts(self.kinds, self.material[texels])
        light: _Light | None = None
        sun, tested = SunShares(self.sun, len(self.alone)), dict[float, NDArray[np.uint16]]()
        self.arrives: Any = None
        steps = steps_to(self.start, self.asked)
        first_s = float((self.asked[0] - self.start) / np.timedelta64(1, "s"))
        faces, of = len(self.of_faces.kind), texels[parts.place]
        # The column of each part of the texels.
        some: NDArray[np.integer]
        own: NDArray[np.integer]
        later: NDArray[np.integer]
        own = faces + np.arange(len(of))
        records = self.records
        recorder = None if records is None or not steps else Recorder(self, texels, parts, steps)
        shared = bool(first_s) and not self.scene.spec.temperature.brightness
        if shared:
            some, own = self._shared(of, parts.kind)
            columns, state = self._columns(of[some], parts.kind[some], (of, own))
        else:
            columns, state = self._columns(of, parts.kind)
        if recorder is not None:
            recorder.columns_are(own)

        def found() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            kelvin = np.array(balance.seen_k(state, columns.matter.ground))
            return self.of_faces.kelvin(kelvin[:faces]), parts.kelvin(kelvin[own])

        if not first_s:
            yield found()
        for number, (at, seconds) in enumerate(steps):
            if shared and at >= first_s - _OWN_S - 1e-6:
                some, later = np.arange(len(of)), faces + np.arange(len(of))
                if self.deviations is None:
                    ends = [at + seconds for at, seconds in steps[number:]]
                    some, later, tested = self._in_like_sun(texels, parts, ends, first_s)
                index = mi.UInt32(aligned(np.concatenate([np.arange(faces), own[some]]), np.uint32))
                own_of = lambda values, index=index: [dr.gather(mi.Float, each, index) for each in values]  # noqa: E731
                surface_k, film = own_of([state.surface_k, state.film])
                liquid, remainder_k = (each and own_of(each) for each in (state.liquid, state.remainder_k))
                state = State(surface_k, own_of(state.layers_k), film, liquid, remainder_k)
                columns, _ = self._columns(of[some], parts.kind[some])
                evaluate(state)
                own, shared, sun, light = later, False, SunShares(self.sun, len(self.alone), tested), None
                if recorder is not None:
                    recorder.columns_are(own, index)
            sun.step(columns, at, seconds, shared)
            if light is None or at >= light.until:
                every_s = max(_SHARED_LIGHT_S if shared else _LIGHT_S, seconds)
                kelvin = np.array(balance.seen_k(state, columns.matter.ground))[:faces]
                light = self._light(at, seconds, every_s, self.of_faces.kelvin(kelvin), columns, sun)
            first, second = (self._forcing(at + offset, light, columns, sun) for offset in balance.stage_times(seconds))
            if recorder is not None:
                recorder.take((first, second), seconds)
            ground = columns.matter.ground
            state, fluxes = balance.step(Library, state, ground, first, second, dr.opaque(mi.Float, seconds))
            if recorder is not None and number + 1 == len(steps):
                recorder.ends(balance.terms(Library, ground, first, second, fluxes))
            evaluate(state)
            progress((number + 1) / len(steps))
            if self.start + np.timedelta64(round(at + seconds), "s") in self.asked:
                yield found()
        if recorder is not None and records is not None:
            records.append(recorder.record(columns, np.array(balance.seen_k(state, columns.matter.ground))))

    def _shared(
        self, texels: NDArray[np.integer], kinds: NDArray[np.integer]
    ) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
        """(index of the parts that need a column beside those of the faces, number of the column of each part). Parts
        are `kinds` of column at `texels`: those of one kind share a column on a face, its own if it has this kind."""
        face = self.covers[texels].astype(np.int64)
        faces, most = len(self.of_faces.kind), int(self.kinds.kind.max()) + 1
        of_faces = self.of_faces.place * most + self.of_faces.kind
        wanted = self.column[np.minimum(face, self.faces - 1)] * most + kinds
        order = np.argsort(of_faces)
        column = order[np.minimum(np.searchsorted(of_faces, wanted, sorter=order), faces - 1)]
        own = (face >= self.solid_faces) | (of_faces[column] != wanted)
        some, number = _first_of((face * most + kinds)[own])
        column[own] = faces + number
        return np.flatnonzero(own)[some], column

    def _in_like_sun(
        self, texels: NDArray[np.integer], parts: Parts, times_s: Sequence[float], first_s: float
    ) -> tuple[NDArray[np.integer], NDArray[np.integer], dict[float, NDArray[np.uint16]]]:
        """(index of the `parts` of texels that need a column, number of the column of each part, {time: share of the
        sun on each texel with a column}): those of one kind share it on a face where their sun is alike at all these
        times, up to and after the first instant asked for."""

        def tested() -> tuple[NDArray[np.integer], NDArray[np.integer], dict[float, NDArray[np.uint16]]]:
            face, point = self._points(texels)
            key, shares = self.sun.alike(*self._uploaded(point, face), times_s, first_s)
            some, number = _first_of(mixed(key[parts.place] ^ parts.kind.astype(np.uint64)))
            alone = np.unique(parts.place[some])
            return some, number, {time_s: share[alone] for time_s, share in shares.items()}

        depends = np.array([first_s, *times_s]), texels, parts.place, parts.kind, self.middle, self.covers
        some, number, shares = self.sun.remembered(tested, times_s, *depends)
        return some, len(self.of_faces.kind) + number, shares

    def _cosine(self, normal: Jit, face: Jit, more: Jit, share: Jit, at_s: float) -> Jit:
        """Cosine of the sun's rays at columns, 0 in shadow, where a `share` of them arrives; on copies as of
        `Copies.on`."""
        found = lit_cosine(self.geometry, normal, self.sun.towards(self.sun.instant(at_s))) * share
        return found if self.copies is None else self.copies.on(face, more, found, at_s)

    def _forcing(self, at_s: float, light: "_Light", columns: _Columns, sun: SunShares) -> Forcing:
        """The Forcing of columns at an instant [s after the start]."""
        mi, instant = self.mi, self.sun.instant(at_s)
        found = self.weather.at(instant)
        towards = self.sun.towards(instant)
        one = lambda value: dr.opaque(mi.Float, float(value))  # noqa: E731
        gathered = lambda values: dr.gather(mi.Float, values, columns.face)  # noqa: E731
        at_place = columns.at_place
        sine = max(towards[2], 0.0)
        level = found.direct_w_m2 * sine + found.diffuse_w_m2
        sunlight = one(found.diffuse_w_m2) * gathered(light.sky) + one(level) * gathered(light.reflected)
        if towards[2] > 0.0 and found.direct_w_m2 > 0.0:
            more, share = columns.hidden > 0.0, sun.at(at_s)
            sunlight += one(found.direct_w_m2) * self._cosine(columns.normal, columns.face, more, share, at_s)
        air = one(found.air_k) + columns.cooler
        longwave = one(found.longwave_w_m2) * gathered(light.sky) + gathered(light.surroundings)
        if self.copies is not None:
            # Other leaves, about as warm as the air, hide the sky.
            longwave += columns.hidden * (STEFAN_BOLTZMANN * dr.square(dr.square(air)) - one(found.longwave_w_m2))
        if columns.place is not None:
            dr.eval(sunlight, longwave, air)
        sunlight, longwave, air = at_place(sunlight), at_place(longwave), at_place(air)
        return forcing_of(found, self.inside_k, columns.matter, sunlight, longwave, air)

    def _light(
        self, at_s: float, seconds: float, every_s: float, seen_k: NDArray[np.float32], columns: _Columns,
        sun: SunShares,
    ) -> "_Light":  # fmt: skip
        """The _Light between the faces, of temperatures `seen_k`, from `at_s` on, where a step of `seconds` begins, for
        an interval `every_s`; each call adds one reflection to the light of the call before."""
        mi = self.mi
        middle_s = at_s + 0.5 * every_s
        middle = min(self.sun.instant(middle_s), self.weather.time[-1])
        found, towards = self.weather.at(middle), self.sun.towards(middle)
        level = float(found.direct_w_m2 * max(towards[2], 0.0) + found.diffuse_w_m2)
        own = self.factors.sky * np.float32(found.diffuse_w_m2 / max(level, 1.0))
        if towards[2] > 0.0 and found.direct_w_m2 > 0.0:
            here = dr.arange(mi.UInt32, len(self.alone))
            normal, face = dr.gather(mi.Vector3f, columns.normal, here), dr.gather(mi.UInt32, columns.face, here)
            if middle_s <= at_s + seconds:
                share = dr.gather(mi.Float, sun.at(middle_s), here)
            else:

                def tested() -> Jit:
                    share = self.sun.share(dr.gather(mi.Point3f, columns.point, here), normal, face, towards)
                    dr.eval(share)
                    return share

                share = self.sun.remembered(tested, [middle_s], self.middle, self.alone)
            lit = np.array(self._cosine(normal, face, mi.Bool(False), share, middle_s))
            own[: self.faces] += np.float32(found.direct_w_m2 / max(level, 1.0)) * lit[self.column]
        kelvin = self.face_kelvin.copy()
        kelvin[: self.faces] = seen_k[self.column]
        emitted = self.emissivity * np.float32(STEFAN_BOLTZMANN) * kelvin**4
        sky = self.factors.sky * np.float32(found.longwave_w_m2)
        for _ in range(1 if self.arrives is not None else _REFLECTIONS):
            before = np.zeros((len(sky), 2), np.float32) if self.arrives is None else self.arrives
            leaves = (self.reflectance * (own + before[:, 0]), emitted + (1.0 - self.emissivity) * (sky + before[:, 1]))
            self.arrives = np.column_stack(list(self.threads.map(self._arriving, leaves)))
        upload = lambda values: mi.Float(aligned(values[: self.faces]))  # noqa: E731
        until = max(every_s * (np.floor(at_s / every_s + 1e-9) + 1.0), at_s + seconds)
        return _Light(until, upload(self.factors.sky), upload(self.arrives[:, 0]), upload(self.arrives[:, 1]))

    def _arriving(self, leaves: NDArray[np.float32]) -> NDArray[np.float32]:
        """Light from other faces and from beyond the terrain; a product with one vector is faster than with two."""
        return self.factors.operator @ leaves + self.factors.background * np.float32(self.mean(leaves))

    def mean(self, values: NDArray[Any]) -> Any:
        """Mean over the terrain's area."""
        share = self.geometry.share[: self.faces]
        return values[: self.faces] @ share / share.sum()


@dataclass(frozen=True, eq=False)
class _Light:
    """Light on the terrain's faces, Dr.Jit arrays (F,)."""

    # Valid until this time [s].
    until: float
    # Fraction of the hemisphere that is sky.
    sky: Any
    # Reflected sunlight per sunlight on level ground.
    reflected: Any
    # Long-wave radiation of the surroundings [W m⁻²].
    surroundings: Any


def _alike(material: NDArray[np.integer], block: int) -> NDArray[np.int64]:
    """Flat number of the texel that stands for each, (h w,): one with its number in its square of `block` a side.

    Which one differs from square to square, so that shadows are not moved in one direction.
    """
    number = np.arange(material.size).reshape(material.shape)
    found = number.copy()
    places = [divmod(place, block) for place in range(block**2)]
    for turn in range(len(places)):
        row, column = (block * each for each in places[turn])
        order = places[turn:] + places[:turn]
        # A later place stands for none for which an earlier one does.
        for early in reversed(range(len(order))):
            for late in range(early + 1, len(order)):
                (a, b), (c, d) = (
                    (slice(row + r, None, block**2), slice(column + k, None, block**2))
                    for r, k in (order[early], order[late])
                )
                rows, columns = np.minimum(material[a, b].shape, material[c, d].shape)
                one, other = material[a, b][:rows, :columns], material[c, d][:rows, :columns]
                stands = number[a, b][:rows, :columns]
                np.copyto(found[c, d][:rows, :columns], stands, where=one == other)
    return found.reshape(-1)


def _first_of(key: NDArray[Any]) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """(index of the first entry with each value, in ascending order; number among these of each entry's value)."""
    _, first, each = np.unique(key, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[each]


def _leaves(geometry: Geometry) -> NDArray[np.bool_]:
    """Whether each face is that of leaves in crowns, (F,)."""
    crown = [isinstance(surface.instances, Crowns) for surface in geometry.surfaces]
    return np.repeat(crown, np.diff(geometry.face_start))


def _first_sides(geometry: Geometry) -> NDArray[np.integer]:
    """Number of the first side of the leaves of each face, (F,); of others their own."""
    index = np.arange(geometry.face_count)
    start = np.repeat(geometry.face_start[:-1], np.diff(geometry.face_start))
    # Patches that face down and up alternate.
    return np.where(_leaves(geometry), index - (index - start) % 2, index)


def _view_factors(geometry: Geometry) -> ViewFactors:
    """The ViewFactors of a geometry, from the rays of its light."""
    transport, _ = transport_cache.traced(geometry, _RAYS)
    operator = transport.operator.astype(np.float32)
    sky, background = transport.sky.sum(axis=1).astype(np.float32), transport.background.astype(np.float32)
    if geometry.crowns is not None:
        both = _both_sides(geometry)
        operator, sky, background = both @ operator, both @ sky, both @ background
    return ViewFactors(geometry, operator, sky, background, transport.touching)


def _both_sides(geometry: Geometry) -> Any:
    """Matrix (F, F) that gives both sides of leaves in crowns, which are thin, the mean of their light."""
    from scipy.sparse import csr_array

    index = np.arange(geometry.face_count)
    # The sum of the numbers of both sides is twice the first one's and 1; another face is its own second side.
    first = _first_sides(geometry)
    other = np.where(_leaves(geometry), 2 * first + 1 - index, index)
    rows = np.concatenate([index, index])
    half = np.full(len(rows), 0.5, np.float32)
    return csr_array((half, (rows, np.concatenate([index, other]))), (len(index), len(index)))
