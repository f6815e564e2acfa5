"""What an edit of materials or temperatures changes: texels, and the radiance that their faces send."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Channels, Jit, aligned
from thermorender.render.device import flat
from thermorender.render.edits.prior import PriorLight, Tables
from thermorender.render.loaded import LoadedLight
from thermorender.render.plan import Plan
from thermorender.render.spectrum import Spectrum, spectra_at
from thermorender.scene.scene import Scene

# Numbers of pairs of materials are a byte.
_MOST_PAIRS = 255


@dataclass(frozen=True, eq=False)
class Touched:
    """Texels that an edit changes, and their faces."""

    # (M, M') bool whether each material before differs from each after in what it emits or reflects
    differ: NDArray[np.bool_]
    # kinds, kelvin: Material and temperature of all texels after the edit
    kinds: Jit
    kelvin: Jit
    changed: Jit  # 1 for texels with another material, another spectrum of their material, or another temperature
    materials: NDArray[np.intp]  # (m,) int materials after the edit on these texels
    pair: Jit  # Number of the texel's pair of materials, before and after the edit
    pairs: NDArray[np.intp]  # (p, 2) int of each number
    faces: NDArray[np.intp]  # (n,) int faces with such texels, ascending


@dataclass(frozen=True, eq=False)
class Change(Touched):
    """What an edit changes, as the known light shows it."""

    plan: Plan  # Of the edited scene, with the nodes and channels of the one before
    tables: Tables  # Of blackbodies
    # (N, n) float32 change of the radiance that these faces send at each node, in the light before the edit [W m⁻²
    # sr⁻¹]
    sent: NDArray[np.float32]
    # (n,) float32 largest reflectance of a point of these faces at any node, after the edit
    strongest: NDArray[np.float32]


# What an edit may change while rays and spectral nodes stay; weather and time act through these.
_KEPT_LIGHT = {"surfaces", "materials", "spec_surroundings_temperature", "temperature_state", "time",
               "spec_temperature", "spec_weather", "noted_weather"}  # fmt: skip


def comparable(one: Scene, other: Scene) -> bool:
    """Return whether two scenes of the same surfaces may differ in materials, temperatures and surroundings only."""
    return other.changes(one) <= _KEPT_LIGHT and not (one.tracked_objects or other.tracked_objects)


def change_of(
    baked: LoadedLight, prior: PriorLight, scene: Scene, plan: Plan, touched: Touched | None = None
) -> Change | None:  # fmt: skip
    """Return the Change from a baked scene to an edited one; None where nodes or channels differ. `touched` is from
    `touched_by`."""
    before, after = baked.plan.spectrum, plan.spectrum
    if not (np.array_equal(before.label, after.label) and np.array_equal(before.basis, after.basis)):
        return None
    # A fit to all materials may change what those reflect that have the same emissivity.
    differ = _differ(baked, scene) | (before.reflected[:, None] != after.reflected).any(axis=(-2, -1))
    if touched is None or not np.array_equal(differ, touched.differ):
        touched = touched_by(baked, prior, scene, differ)
    if touched is None:
        return None
    tables = prior.tables(plan)
    sent, strongest = _sent(prior, tables, (before, after), touched)
    known_before = {each.name: getattr(touched, each.name) for each in fields(touched)}
    return Change(**known_before, plan=plan, tables=tables, sent=sent, strongest=strongest)


def touched_by(
    baked: LoadedLight, prior: PriorLight, scene: Scene, differ: NDArray[np.bool_] | None = None
) -> Touched | None:  # fmt: skip
    """Return what an edit changes, without light; None for too many pairs of materials. `differ` is as of `Touched`."""
    mi = baked.geometry.mi
    material, temperature = flat(scene.surfaces, "material"), flat(scene.surfaces, "temperature")
    kinds, kelvin = prior.kinds, prior.kelvin
    if not np.array_equal(material, prior.material):
        kinds = mi.UInt8(aligned(material, np.uint8))
    warmer = not np.array_equal(temperature, prior.temperature)
    if warmer:
        kelvin = mi.Float(aligned(temperature))
    if differ is None:
        differ = _differ(baked, scene)
    pair, pairs = _pairs(prior, kinds, differ.shape)
    if len(pairs) > _MOST_PAIRS:
        return None
    changed, materials = _changed(prior, kelvin, pair, pairs, differ)
    faces = np.flatnonzero(prior.samples.with_any(changed))
    return Touched(differ, kinds, kelvin, changed, materials, pair, pairs, faces)


def _differ(baked: LoadedLight, scene: Scene) -> NDArray[np.bool_]:
    """Whether the emissivity of each material before differs from that of each after, (M, M')."""
    one, other = (spectra_at(baked.plan.spectrum.points, each.materials) for each in (baked.scene, scene))
    return np.asarray((one[:, None] != other).any(axis=-1))


def _pairs(prior: PriorLight, kinds: Jit, shape: tuple[int, int]) -> tuple[Jit, NDArray[np.intp]]:
    """(number of each texel's pair of materials, UInt8; the pairs (p, 2))."""
    mi, (before, after) = prior.samples.geometry.mi, shape
    if kinds is prior.kinds:
        # The same numbers, which may be of other materials.
        return kinds, np.repeat(np.arange(min(before, after))[:, None], 2, axis=1)
    code = mi.UInt32(prior.kinds) * dr.opaque(mi.UInt32, after) + mi.UInt32(kinds)
    present = dr.zeros(mi.UInt32, before * after)
    dr.scatter(present, mi.UInt32(1), code)
    found = np.flatnonzero(np.array(present))
    number = np.zeros(before * after, np.uint8)
    number[found] = np.arange(len(found)) & 255
    pair = dr.gather(mi.UInt8, mi.UInt8(aligned(number, np.uint8)), code)
    dr.eval(pair)
    return pair, np.stack(np.divmod(found, after), axis=1)


def _changed(
    prior: PriorLight, kelvin: Jit, pair: Jit, pairs: NDArray[np.intp], differ: NDArray[np.bool_]
) -> tuple[Jit, NDArray[np.intp]]:
    """(flags of the changed texels, UInt8; numbers of their materials after the edit)."""
    mi = prior.samples.geometry.mi
    table = differ[pairs[:, 0], pairs[:, 1]]
    flags = dr.gather(mi.UInt8, mi.UInt8(aligned(table, np.uint8)), mi.UInt32(pair))
    if kelvin is prior.kelvin:
        dr.eval(flags)
        return flags, np.unique(pairs[table, 1])
    flags = dr.select(prior.kelvin != kelvin, mi.UInt8(1), flags)
    present = dr.zeros(mi.UInt32, len(pairs))
    dr.scatter(present, mi.UInt32(1), mi.UInt32(pair), flags > 0)
    dr.eval(flags, present)
    return flags, np.unique(pairs[np.array(present) > 0, 1])


def _sent(
    prior: PriorLight, tables: Tables, spectra: Sequence[Spectrum], touched: Touched
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
    """`Change.sent` and `Change.strongest` of faces."""
    samples, kinds, kelvin, changed = prior.samples, touched.kinds, touched.kelvin, touched.changed
    faces, warmer = touched.faces, kelvin is not prior.kelvin
    mi, nodes = samples.geometry.mi, spectra[1].nodes
    if not len(faces):
        return np.zeros((nodes, 0), np.float32), np.zeros(0, np.float32)
    before, after = (Channels(mi, spectrum.emissivity) for spectrum in spectra)
    strong = mi.Float(aligned(1.0 - spectra[1].emissivity.min(axis=1)))
    face = mi.UInt32(aligned(faces, np.uint32))
    incident, last = prior.incident.at(face), dr.opaque(mi.UInt32, samples.count)

    def body(point: Jit, strongest: Jit, *total: Jit) -> tuple[Jit, ...]:
        texel = samples.texel(face, point)
        on = dr.gather(mi.UInt8, changed, texel) > 0
        kind = mi.UInt32(dr.gather(mi.UInt8, kinds, texel))
        own, old = after.at(kind, on), before.at(mi.UInt32(dr.gather(mi.UInt8, prior.kinds, texel, on)), on)
        black = tables.radiance(dr.gather(mi.Float, kelvin, texel, on), on)
        was = tables.radiance(dr.gather(mi.Float, prior.kelvin, texel, on), on) if warmer else black
        added = (a + e * b - f * c + (f - e) * x
                 for a, e, b, f, c, x in zip(total, own, black, old, was, incident, strict=True))  # fmt: skip
        return (point + 1, dr.maximum(strongest, dr.gather(mi.Float, strong, kind)), *added)

    zero = dr.zeros(mi.Float, len(faces))
    start = (mi.UInt32(0), zero, *(dr.zeros(mi.Float, len(faces)) for _ in range(nodes)))
    _, strongest, *total = dr.while_loop(start, lambda point, *_: point < last, body)
    total = [value / mi.Float(last) for value in total]
    dr.eval(total, strongest)
    return np.stack([np.array(value) for value in total]), np.array(strongest)
