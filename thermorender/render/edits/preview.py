"""A first-order preview of an edit: changed texels in the known light, and one bounce of the change of what they send.

With K the share of a face's hemisphere that shows each other face and ρ the reflectance, the light x on the faces
changes by δ = K d + K ρ δ. Here d is the change of what changed faces send in the light known before. A preview shows
K d, in the few spectral components that d has, and leaves out K ρ δ: light of the change that is reflected twice.

Its error is estimated from the light of the second bounce, K ρ |K d|, and of the components left out. They are computed
on the faces that reflect most of what they receive, on those that change, and on faces drawn by their area. Where a
share q of reflected light is passed on at most, later bounces add a factor of 1 / (1 − q).
"""

from concurrent.futures import Executor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Channels, Floats, Jit, aligned
from thermorender.render.edits.change import Change, change_of, comparable
from thermorender.render.edits.known import Known, Samples, known_of
from thermorender.render.layers import OutgoingRadiance
from thermorender.render.light.exchange import threads
from thermorender.render.plan import Plan, make_plan
from thermorender.scene.scene import Scene

if TYPE_CHECKING:
    from thermorender.render.baked import BakedScene

# What spectral components may leave out of what faces send [mK], and their number.
_LEFT_MK, _MOST_SPECTRA = 200.0, 2
# Faces of each kind on which the second bounce is computed, and standard errors added to its mean square.
_JUDGED, _SURE = 3000, 3.5
# From this share of light passed on, a preview is of no use.
_MOST_PASSED = 0.9


def preview(baked: "BakedScene", scene: Scene) -> "BakedScene | None":
    """Return the preview of an edited scene; None where the edit needs a solution."""
    if baked.incident is None or baked.faces is None or not comparable(baked.scene, scene):
        return None
    plan = edited_plan(baked, scene)
    if not plan.bake or plan.sun != baked.plan.sun or plan.specular or baked.plan.specular:
        return None
    known = known_of(baked)
    change = change_of(baked, known, scene, plan)
    if change is None:
        return None
    return _previewed(baked, known, scene, change)


def prepare(baked: "BakedScene") -> None:
    """Make what all previews of a BakedScene begin from, and keep it there."""
    if baked.incident is not None and baked.faces is not None:
        samples = known_of(baked).samples
        samples.prepare()
        _strongest(baked, samples)


def edited_plan(baked: "BakedScene", scene: Scene) -> Plan:
    """Return the Plan of an edited scene that keeps nodes and channels."""
    old = baked.plan
    return make_plan(
        scene, samples=old.samples, taps=old.taps, edge_mk=old.edge_mk, rays=old.rays, tolerance_mk=old.tolerance_mk,
        kept=(old, baked.scene),
    )  # fmt: skip


def _previewed(baked: "BakedScene", known: Known, scene: Scene, change: Change) -> "BakedScene":
    geometry, plan = baked.geometry, change.plan
    # NumPy's part of the work goes on beside Dr.Jit's.
    with threads() as pool:
        basis, light, left = _light(baked, known, scene, change, pool)
        errors = pool.submit(_errors_mk, baked, known.samples, change, basis, light, left)
        tables = _Tables(baked, known, scene, change, basis, light)
        texels, added = tables.texels()
        parts = [texels[0][:, None], *([np.stack(texels[1:], axis=1)] if len(texels) > 1 else [])]
        means = [pool.submit(geometry.averaged, part) for part in parts]
        faces = tables.corrected(added)
        first, *rest = (each.result() for each in means)
    outgoing = OutgoingRadiance(first, rest[0] if rest else None, Channels(geometry.mi, faces))
    kept = {name: baked._uploaded[name] for name in ("geometry", "samples")}
    shown = replace(
        baked, scene=scene, plan=plan, incident=None, texels=tuple(texels), faces=faces,
        errors_mk=baked.errors_mk | errors.result(), _uploaded=kept | {"exact": baked},
    )  # fmt: skip
    kept["scene"] = shown._uploaded["scene"] = baked.device.showing(shown, outgoing)
    return shown


def _light(
    baked: "BakedScene", known: Known, scene: Scene, change: Change, pool: Executor
) -> tuple[Floats, NDArray[np.float32], tuple[NDArray[np.float32], float]]:  # fmt: skip
    """(orthonormal spectra (k, N), change of the light on faces in them (k, F), what they leave out)."""
    samples, plan = known.samples, change.plan
    outside = plan.spectrum.black([scene.surroundings_temperature])[0]
    outside = outside - baked.plan.spectrum.black([baked.scene.surroundings_temperature])[0]
    basis, left = _components(change.sent, outside, _LEFT_MK * plan.radiance_per_mk)
    sent = np.zeros((len(basis), len(samples.seen)), np.float32)
    sent[:, change.faces] = basis.astype(np.float32) @ change.sent
    light = samples.received(sent, change.faces, pool)
    if outside.any():
        light += samples.background * (basis @ outside)[:, None]
    return basis, light, left


def _errors_mk(
    baked: "BakedScene", samples: Samples, change: Change, basis: Floats, light: NDArray[np.float32],
    left: tuple[NDArray[np.float32], float],
) -> dict[str, float]:  # fmt: skip
    """Stated errors of a preview, as of `BakedScene.preview_for` [mK]."""
    plan = change.plan
    most, typical = (value / plan.radiance_per_mk for value in _errors(baked, samples, change, basis, light, left))
    nodes = plan.spectrum.nodes_mk
    # The solution may have other nodes: where these err too much, where most faces change, and where the rounding of
    # edits has added up.
    more = nodes + plan.tolerance_mk
    # The solutions before and after the edit have errors of their own, and texels are rounded.
    brightest = max(float(values.max()) for values in baked.texels)
    rounding = float(np.finfo(np.float32).eps) * brightest / plan.radiance_per_mk
    more += 2.0 * (baked.errors_mk["solution"] + rounding)
    return {"preview": most + more, "preview_rms": typical + more}


def _components(
    sent: NDArray[np.float32], outside: Floats, wanted: float
) -> tuple[Floats, tuple[NDArray[np.float32], float]]:
    """(orthonormal spectra (k, N), what they leave out, summed over the nodes: (of each face (n,), of the outside))."""
    gram = (sent @ sent.T).astype(np.float64) + np.outer(outside, outside)
    axes = np.linalg.eigh(gram)[1][:, ::-1].T
    parts: list[NDArray[Any]] = [axes.astype(np.float32) @ sent, axes @ outside[:, None]]
    for count in range(1, _MOST_SPECTRA + 1):
        # The sum over the nodes is at most √N times the root of the sum of squares.
        rest = [np.sqrt(len(axes) * np.einsum("kn,kn->n", part[count:], part[count:])) for part in parts]
        if max(float(values.max(initial=0.0)) for values in rest) <= wanted:
            break
    return axes[:count], (rest[0], float(rest[1][0]))


def _errors(
    baked: "BakedScene", samples: Samples, change: Change, basis: Floats, light: NDArray[np.float32],
    left: tuple[NDArray[np.float32], float],
) -> tuple[float, float]:  # fmt: skip
    """Estimates of the preview's largest error and of its root mean square over all faces [W m⁻² sr⁻¹]."""
    own, most_reflecting = _strongest(baked, samples)
    strongest, changed = own.copy(), change.faces
    strongest[changed] = change.strongest
    # Light that is not followed: of the second bounce, and of spectra left out.
    missing = strongest * (np.abs(basis).sum(axis=1).astype(np.float32) @ np.abs(light))
    missing[changed] += left[0]
    number = np.random.Generator(np.random.Philox(0)).random(_JUDGED)
    drawn = np.searchsorted(samples.area, number * samples.area[-1])
    faces = np.concatenate([drawn, most_reflecting, changed[_most(change.strongest * samples.seen[changed])]])
    received = samples.received_by(faces, missing) + left[1] * (1.0 - samples.seen[faces])
    passed = float((strongest[faces] * samples.seen[faces]).max())
    error = strongest[faces] * received / (1.0 - min(passed, _MOST_PASSED))
    square = error[:_JUDGED] ** 2
    typical = np.sqrt(square.mean() + _SURE * square.std() / np.sqrt(_JUDGED))
    return float(error.max()) if passed < _MOST_PASSED else np.inf, float(typical)


def _most(values: NDArray[Any]) -> NDArray[np.intp]:
    """Places of the `_JUDGED` largest values."""
    return (
        np.argpartition(values, len(values) - _JUDGED)[-_JUDGED:] if len(values) > _JUDGED else np.arange(len(values))
    )


def _strongest(baked: "BakedScene", samples: Samples) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """(largest reflectance of a point of each face at any node, (F,); faces that reflect most of what they receive).

    They are kept with the baked scene.
    """
    kept = baked._uploaded
    if "strongest" not in kept:
        geometry, known = baked.geometry, kept["known"]
        mi = geometry.mi
        table = mi.Float(aligned(1.0 - baked.plan.spectrum.emissivity.min(axis=1)))
        face, last = dr.arange(mi.UInt32, geometry.face_count), dr.opaque(mi.UInt32, samples.count)

        def body(point: Jit, found: Jit) -> tuple[Jit, Jit]:
            kind = mi.UInt32(dr.gather(mi.UInt8, known.kinds, samples.texel(face, point)))
            return point + 1, dr.maximum(found, dr.gather(mi.Float, table, kind))

        start = mi.UInt32(0), dr.zeros(mi.Float, geometry.face_count)
        found = np.array(dr.while_loop(start, lambda point, _: point < last, body)[1])
        kept["strongest"] = found, _most(found * samples.seen)
    return kept["strongest"]


class _Tables:
    """The change of texels and faces, from the change of the light on faces.

    Texels differ in what they emit, and in what they reflect of the light before and of its change: these depend on the
    pair of materials before and after the edit. Pairs that occur are numbered.
    """

    def __init__(
        self, baked: "BakedScene", known: Known, scene: Scene, change: Change, basis: Floats, light: NDArray[np.float32]
    ) -> None:
        self._mi = mi = baked.geometry.mi
        self._baked, self._known, self._change = baked, known, change
        before, after = baked.plan.spectrum, change.plan.spectrum
        mean = light.mean(axis=1, dtype=np.float64).astype(np.float32)
        self._light = Channels(mi, np.vstack([light.T, mean]))
        old, new = change.pairs.T
        shares, more = after.reflected[new] @ basis.T, after.reflected[new] - before.reflected[old]
        # Of each pair and channel: what it reflects of the light, and how much more than before.
        self._reflects = [
            Channels(mi, np.concatenate([shares[:, channel], more[:, channel]], axis=1))
            for channel in range(after.channels)
        ]
        self._spectra = len(basis)
        # Emission of the materials of changed texels.
        row = np.zeros(len(scene.materials), dtype=np.uint32)
        row[change.materials] = np.arange(len(change.materials))
        found = [
            after.emitted(scene.materials[number].emissivity_at, *change.tables.limits_k, change.plan.band_um)[1]
            for number in change.materials
        ]
        self._row = mi.UInt32(aligned(row, np.uint32))
        self._emitted = Channels(mi, np.concatenate(found) if found else np.zeros((1, after.channels)))
        self._reflected = [Channels(mi, after.reflected[:, channel]) for channel in range(after.channels)]

    def texels(self) -> tuple[list[NDArray[np.float32]], list[Jit]]:
        """Return (radiance of texels, K arrays (T,); change of the light that they reflect, K of Float)."""
        mi, known, change = self._mi, self._known, self._change
        cover = self._baked.geometry.face_of_texel
        on, kind, pair = change.changed > 0, mi.UInt32(change.kinds), mi.UInt32(change.pair)
        lower, share = change.tables.interval(change.kelvin)
        lower += dr.gather(mi.UInt32, self._row, kind, on) * change.tables.count
        ends = (self._emitted.at(lower + k, on) for k in (0, 1))
        emitted = [dr.lerp(a, b, share) for a, b in zip(*ends, strict=True)]
        incident, light = known.incident.at(cover, on), self._light.at(cover)
        found, added = [], []
        for channel, texel in enumerate(known.texels):
            table = self._reflects[channel].at(pair)
            more = _dot(table[: self._spectra], light)
            added.append(_dot(table[self._spectra :], incident) + more)
            found.append(dr.select(on, emitted[channel] + _dot(self._reflected[channel].at(kind, on), incident), texel))
            found[-1] += more
        dr.eval(found, added)
        return [value.numpy() for value in found], added

    def corrected(self, added: list[Jit]) -> NDArray[np.float32]:
        """Return the correction of faces, (F, K); `added` as of `texels`."""
        mi, samples, pairs = self._mi, self._known.samples, self._change.pair
        starts, texels, weights = samples.others
        faces = self._baked.faces
        assert faces is not None
        face = dr.arange(mi.UInt32, len(faces))
        light = [*self._light.at(face), *self._known.incident.at(face)]
        last = dr.gather(mi.UInt32, starts, face + 1)

        def body(entry: Jit, *so_far: Jit) -> tuple[Jit, ...]:
            texel, weight = dr.gather(mi.UInt32, texels, entry), dr.gather(mi.Float, weights, entry)
            pair = mi.UInt32(dr.gather(mi.UInt8, pairs, texel))
            more = (
                weight * (_dot(table.at(pair), light) - dr.gather(mi.Float, added[channel], texel))
                for channel, table in enumerate(self._reflects)
            )
            return (entry + 1, *(a + b for a, b in zip(so_far, more, strict=True)))

        start = (dr.gather(mi.UInt32, starts, face), *(dr.zeros(mi.Float, len(faces)) for _ in added))
        _, *total = dr.while_loop(start, lambda entry, *_: entry < last, body)
        dr.eval(total)
        return np.asarray(faces + np.stack([np.array(value) for value in total], axis=1))


def _dot(one: list[Jit], other: list[Jit]) -> Jit:
    return sum(a * b for a, b in zip(one, other, strict=True))
