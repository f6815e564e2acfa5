"""What a heat balance keeps for previews of edits: light on drawn texels at every step, sums of it on all columns.

An edit of materials changes the light that falls on a texel little. So the columns of drawn texels are solved again in
the light that is known, and other texels take the change of those with like light (`thermorender.render.heat.edited`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.physics.balance import Forcing, State
from thermorender.render.arrays import Jit, aligned
from thermorender.render.geometry import Geometry
from thermorender.render.heat.matter import Parts, PartsOf
from thermorender.render.heat.sun_on_columns import SunMemory

if TYPE_CHECKING:
    from thermorender.render.heat.simulation import _Columns, _Simulation

# Texels drawn of each material, and of all of them in a scene of many materials.
_DRAWN, _MOST = 384, 1 << 14
# Past sunlight is summed with weights that fall by 1/e in these times [s].
_PAST_S = (900.0, 3600.0, 4 * 3600.0, 16 * 3600.0)
# What a column knows: its temperature [K], sums of past sunlight [W m⁻²], the fraction of the hemisphere that is sky,
# air temperature there minus that of the weather [K], heat from within [W m⁻²] and the factor on its reflectance.
KNOWN = 1 + len(_PAST_S) + 4
# Which of them is the sunlight of the last four hours.
SUNLIGHT = 3


@dataclass(frozen=True, eq=False)
class ViewFactors:
    """What the F faces of a geometry receive from one another, from the sky and from the ground beyond the scene."""

    geometry: Geometry
    operator: Any  # (F, F) sparse float32: share of each face in what another receives
    sky: NDArray[np.float32]  # (F,) share of the sky
    background: NDArray[np.float32]  # (F,) share of the ground beyond the scene
    touching: NDArray[np.integer]  # faces that something covers in part


@dataclass(frozen=True, eq=False)
class Record:
    """Of one run for one instant. D drawn texels, C columns, T texels that are solved, F faces of the scene.

    Attributes
    ----------
    parts : sequence
        ((part, share), …) of each material under the weather of the run.
    present : (M,)
        The numbers of the materials of the run, ascending.
    begin : State
        Of the kinds of column of these materials, in their order, at the start.
    inside_k : float
        The air inside buildings [K].
    steps : list of (beginning, length)
        [s] after `start`.
    texel, material, face : (D,)
        The drawn texels, their materials and faces.
    own : (D, KNOWN) float32
        What the columns of the first parts of the drawn texels know.
    light : list of ((sunlight, longwave), (sunlight, longwave))
        Of the drawn texels at both stages of each step, Dr.Jit arrays (D,) [W m⁻²].
    known : (C, KNOWN) float32
        What every column knows.
    faces : (C,) int32
        Face of every column.
    column : (T,) int32
        Column of the first part of each texel, −1 for those that have none.
    factors : ViewFactors
        Between the faces, for a run after an edit, too.
    face_material : (F,)
        The material of each face.
    face_column : (solved faces,)
        Column of the first part of each face that is solved.
    sun : dict
        Results of tests for the sun, for a run after an edit.
    terms : (R, len(TERMS)) float32
        The `balance.TERMS` of the last step [W m⁻²]: rows of columns, or of texels where these have several parts.
    row : (T,) int32
        Row of each texel in `terms`, −1 for those that have no column.
    """

    mi: Any
    parts: PartsOf
    present: NDArray[np.integer]
    begin: State
    inside_k: float
    start: np.datetime64
    steps: list[tuple[float, float]]
    texel: NDArray[np.integer]
    material: NDArray[np.integer]
    face: NDArray[np.integer]
    own: NDArray[np.float32]
    light: list[tuple[tuple[Jit, Jit], tuple[Jit, Jit]]]
    known: NDArray[np.float32]
    faces: NDArray[np.int32]
    column: NDArray[np.int32]
    factors: ViewFactors
    face_material: NDArray[np.integer]
    face_column: NDArray[np.integer]
    sun: SunMemory
    terms: NDArray[np.float32]
    row: NDArray[np.int32]


class Recorder:
    """Follows a run, and makes its Record."""

    def __init__(
        self, simulation: "_Simulation", texels: NDArray[np.integer], parts: Parts, steps: list[tuple[float, float]]
    ) -> None:
        self._of, self._steps, self._texels, self._parts = simulation, steps, texels, parts
        material, rng = simulation.material[texels], np.random.default_rng(0)
        each = np.unique(material)
        most = min(_DRAWN, _MOST // max(len(each), 1))
        order = rng.permutation(len(texels))
        rank = np.empty(len(texels), np.int64)
        by = order[np.argsort(material[order], kind="stable")]
        first = np.searchsorted(material[by], each)
        rank[by] = np.arange(len(by)) - first[np.searchsorted(each, material[by])]
        self._drawn = np.flatnonzero(rank < most)
        self._first = np.searchsorted(parts.place, np.arange(len(texels)))
        # Copies have the temperature of their face's column; that of their texel stands for other leaves.
        face = simulation.covers[texels]
        self._copies = np.zeros(0, np.int64)
        if simulation.copies is not None:
            self._copies = np.flatnonzero((face >= simulation.copies.first) & (face < simulation.faces))
        self._of_copies = np.searchsorted(simulation.of_faces.place, simulation.column[face[self._copies]])
        self._light: list[Any] = []
        self._past: list[Jit] = []

    def columns_are(self, own: NDArray[np.integer], index: Jit = None) -> None:
        """Take note of the number of the column of each part from now on; `index` gives that before of each column."""
        self._columns, self._own = own, own[self._first]
        self._own[self._copies] = self._of_copies
        self._at = self._of.mi.UInt32(aligned(self._own[self._drawn], np.uint32))
        if index is not None:
            self._past = [dr.gather(type(each), each, index) for each in self._past]

    def take(self, forcings: Sequence[Forcing], seconds: float) -> None:
        """Keep the light of a step, at both of its stages."""
        float_of = type(forcings[0].sunlight)
        both = tuple(
            tuple(dr.gather(float_of, each, self._at) for each in (one.sunlight, one.longwave)) for one in forcings
        )
        mean = 0.5 * (forcings[0].sunlight + forcings[1].sunlight)
        self._past = self._past or [dr.zeros(float_of, dr.width(mean)) for _ in _PAST_S]
        self._past = [
            dr.lerp(mean, past, dr.opaque(float_of, float(np.exp(-seconds / past_s))))
            for past, past_s in zip(self._past, _PAST_S, strict=True)
        ]
        dr.eval(both, self._past)
        self._light.append(both)

    def ends(self, terms: Mapping[str, Jit]) -> None:
        """Take note of the `balance.terms` of all columns in the last step, which is evaluated next."""
        self._terms = list(terms.values())
        dr.schedule(self._terms)

    def record(self, columns: "_Columns", kelvin: NDArray[np.float32]) -> Record:
        """Return the Record of columns with these temperatures at the end [K]."""
        simulation = self._of
        place = columns.at_place
        face = np.array(place(columns.face)).astype(np.int64)
        inner = np.zeros(len(face)) if columns.matter.inner_w_m2 is None else np.array(columns.matter.inner_w_m2)
        known = [
            kelvin,
            *map(np.array, self._past),
            simulation.factors.sky[face],
            np.array(place(columns.cooler)),
            inner,
        ]
        first = self._own
        reflects = np.ones(len(face))
        reflects[first] = simulation.reflects[self._texels]
        table = np.column_stack([*known, reflects]).astype(np.float32)
        column = np.full(simulation.texels, -1, np.int32)
        column[self._texels] = first
        column = column[simulation.first]
        terms, row = np.stack([np.array(each) for each in self._terms], axis=1), column
        if self._parts.mixed or simulation.of_faces.mixed:
            of_faces = simulation.of_faces.mean(terms[: len(simulation.of_faces.kind)])
            terms, row = self._parts.mean(terms[self._columns]), np.full_like(column, -1)
            terms[self._copies] = of_faces[simulation.column[simulation.covers[self._texels[self._copies]]]]
            row[self._texels] = np.arange(len(self._texels))
            row = row[simulation.first]
        drawn, at = self._texels[self._drawn], first[self._drawn]
        return Record(
            simulation.mi, simulation.parts, simulation.present.astype(np.int64), simulation.state,
            simulation.inside_k, simulation.start,
            self._steps, drawn, simulation.material[drawn].astype(np.int64), face[at], table[at], self._light,
            table, face.astype(np.int32), column, simulation.factors, simulation.face_material,
            np.asarray(np.searchsorted(simulation.of_faces.place, simulation.column)), simulation.sun.memory or {},
            terms, row,
        )  # fmt: skip
