"""A first-order preview of an edit: changed texels in the known light, and one bounce of the change of what they send.

With K the share of a face's hemisphere that shows each other face and ρ the reflectance, the light x on the faces
changes by δ = K d + K ρ δ. Here d is the change of what changed faces send in the light known before. A preview shows
K d, in the few spectral components that d has, and leaves out K ρ δ: light of the change that is reflected twice.

Its error is estimated from the radiance K ρ |K d| of the second bounce on the faces that reflect most of what they
receive, on those that change, and on some at random. Where the share q of reflected light is passed on at most, later
bounces add a factor of 1 / (1 − q). Correction of faces of less than `_LEAST_MK` are left out, and components of d of
less than `_LEFT_MK` in the light; both are added.
"""

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

# Change of a face's correction that is left out, and of the light due to components left out [mK].
_LEAST_MK, _LEFT_MK = 1.0, 2.0
# Faces on which the second bounce is computed: most reflecting, changed, and any.
_JUDGED = 8000
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


def edited_plan(baked: "BakedScene", scene: Scene) -> Plan:
    """Return the Plan of an edited scene that keeps nodes and channels."""
    old = baked.plan
    return make_plan(
        scene, samples=old.samples, taps=old.taps, edge_mk=old.edge_mk, rays=old.rays, tolerance_mk=old.tolerance_mk,
        kept=(old, baked.scene),
    )  # fmt: skip


def _previewed(baked: "BakedScene", known: Known, scene: Scene, change: Change) -> "BakedScene":
    geometry, plan = baked.geometry, change.plan
    basis, light, error = _light(baked, known, scene, change)
    tables = _Tables(baked, known, scene, change, basis, light)
    texels, added = tables.texels()
    faces = tables.corrected(added)
    rest = geometry.averaged(np.stack(texels[1:], axis=1)) if len(texels) > 1 else None
    outgoing = OutgoingRadiance(geometry.averaged(texels[0][:, None]), rest, Channels(geometry.mi, faces))
    kept = {name: baked._uploaded[name] for name in ("geometry", "samples")}
    shown = replace(
        baked, scene=scene, plan=plan, incident=None, texels=tuple(texels), faces=faces,
        errors_mk={**baked.errors_mk, "preview": error}, _uploaded=kept | {"exact": baked},
    )  # fmt: skip
    kept["scene"] = shown._uploaded["scene"] = baked.device.showing(shown, outgoing)
    return shown


def _light(
    baked: "BakedScene", known: Known, scene: Scene, change: Change
) -> tuple[Floats, NDArray[np.float32], float]:
    """(orthonormal spectra (k, N), change of the light on faces in them (F, k), error of the preview [mK])."""
    samples, plan, transport = known.samples, change.plan, baked.transport
    assert transport is not None
    outside = plan.spectrum.black([scene.surroundings_temperature])[0]
    outside = outside - baked.plan.spectrum.black([baked.scene.surroundings_temperature])[0]
    basis, left = _components(change.sent, outside, _LEFT_MK * plan.radiance_per_mk)
    sent = np.zeros((len(samples.seen), len(basis)), np.float32)
    sent[change.faces] = change.sent @ basis.T.astype(np.float32)
    with threads() as pool:
        light = samples.received(sent, pool)
    if outside.any():
        light += transport.background[:, None] * (outside @ basis.T)
    error = _error(baked, samples, change, basis, light, left) / plan.radiance_per_mk
    nodes = plan.spectrum.nodes_mk
    if nodes > plan.tolerance_mk:
        # The solution has other nodes.
        error += nodes + plan.tolerance_mk
    return basis, light, error


def _components(sent: NDArray[np.float32], outside: Floats, wanted: float) -> tuple[Floats, float]:
    """(orthonormal spectra (k, N), largest sum over the nodes of what they leave out of any face's light)."""
    sent = sent.astype(np.float64)
    gram = sent.T @ sent + np.outer(outside, outside)
    axes = np.linalg.eigh(gram)[1][:, ::-1].T
    left = np.inf
    for count in range(1, len(axes) + 1):
        basis = axes[:count]
        rest = [values - values @ basis.T @ basis for values in (sent, outside[None])]
        left = sum(float(np.abs(values).sum(axis=1).max(initial=0.0)) for values in rest)
        if left <= wanted:
            break
    return basis, left


def _error(
    baked: "BakedScene", samples: Samples, change: Change, basis: Floats, light: NDArray[np.float32], left: float
) -> float:
    """Estimate of the preview's error from above [W m⁻² sr⁻¹]."""
    strongest = _strongest(baked, samples).copy()
    strongest[change.faces] = change.strongest
    reflected = strongest * np.abs(light @ basis.astype(np.float32)).sum(axis=1)
    passed = strongest * samples.seen
    most = float(passed.max(initial=0.0))
    if most >= _MOST_PASSED:
        return np.inf
    random = np.random.Generator(np.random.Philox(0))
    chosen = [_most(passed, _JUDGED), random.integers(0, len(passed), _JUDGED)]
    chosen.append(change.faces[_most(passed[change.faces], _JUDGED)])
    faces = np.unique(np.concatenate(chosen))
    second = float((strongest[faces] * samples.received_by(faces, reflected)).max())
    return second / (1.0 - most) + most * left + 2.0 * _LEAST_MK * change.plan.radiance_per_mk


def _most(values: NDArray[Any], count: int) -> NDArray[np.intp]:
    return np.argpartition(values, len(values) - count)[-count:] if len(values) > count else np.arange(len(values))


def _strongest(baked: "BakedScene", samples: Samples) -> NDArray[np.float32]:
    """Largest reflectance of a point of each face at any node, (F,); kept with the baked scene."""
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
        kept["strongest"] = np.array(dr.while_loop(start, lambda point, _: point < last, body)[1])
    return kept["strongest"]


class _Tables:
    """The change of texels and faces, from the change of the light on faces."""

    def __init__(
        self, baked: "BakedScene", known: Known, scene: Scene, change: Change, basis: Floats, light: NDArray[np.float32]
    ) -> None:
        self._mi = mi = baked.geometry.mi
        self._baked, self._known, self._change, self._count = baked, known, change, len(basis)
        before, after = baked.plan.spectrum, change.plan.spectrum
        mean = light.mean(axis=0, keepdims=True, dtype=np.float64).astype(np.float32)
        self._light = Channels(mi, np.vstack([light, mean]))
        self._strength = np.abs(light).sum(axis=1)
        self._reflects, self._reflected, self._shares = (
            [Channels(mi, table[:, channel]) for channel in range(after.channels)]
            for table in (before.reflected, after.reflected, after.reflected @ basis.T)
        )
        # Emission of the materials of changed texels.
        row = np.zeros(len(scene.materials), dtype=np.uint32)
        row[change.materials] = np.arange(len(change.materials))
        found = [
            after.emitted(scene.materials[number].emissivity_at, *change.tables.limits_k, change.plan.band_um)[1]
            for number in change.materials
        ]
        self._row = mi.UInt32(aligned(row, np.uint32))
        self._emitted = Channels(mi, np.concatenate(found) if found else np.zeros((1, after.channels)))

    def texels(self) -> tuple[list[NDArray[np.float32]], list[Jit]]:
        """Return (radiance of texels, K arrays (T,); change of the light that they reflect, K of Float)."""
        mi, known, change = self._mi, self._known, self._change
        cover = self._baked.geometry.face_of_texel
        on, kind = change.changed > 0, mi.UInt32(change.kinds)
        old = dr.select(on, mi.UInt32(known.kinds), 0)
        lower, share = change.tables.interval(change.kelvin)
        lower += dr.gather(mi.UInt32, self._row, kind, on) * change.tables.count
        ends = (self._emitted.at(lower + k, on) for k in (0, 1))
        emitted = [dr.lerp(a, b, share) for a, b in zip(*ends, strict=True)]
        incident, light = known.incident.at(cover, on), self._light.at(cover)
        found, added = [], []
        for channel, texel in enumerate(known.texels):
            new, was = (_dot(table[channel].at(of, on), incident)
                        for table, of in ((self._reflected, kind), (self._reflects, old)))  # fmt: skip
            more = _dot(self._shares[channel].at(kind), light)
            found.append(dr.select(on, emitted[channel] + new, texel) + more)
            added.append(new - was + more)
        dr.eval(found, added)
        return [value.numpy() for value in found], added

    def corrected(self, added: list[Jit]) -> NDArray[np.float32]:
        """Return the correction of faces, (F, K); `added` as of `texels`."""
        mi, known, change, samples = self._mi, self._known, self._change, self._known.samples
        faces, changed = self._baked.faces, change.changed
        assert faces is not None
        found = faces.copy()
        chosen = self._uneven(added)
        if not len(chosen):
            return found
        face, last = mi.UInt32(aligned(chosen, np.uint32)), dr.opaque(mi.UInt32, samples.count)
        incident, light = known.incident.at(face), self._light.at(face)

        def body(point: Jit, *so_far: Jit) -> tuple[Jit, ...]:
            total = list(so_far)
            for texel, weight in samples.corners(face, point):
                on = dr.gather(mi.UInt8, changed, texel) > 0
                kind = mi.UInt32(dr.gather(mi.UInt8, change.kinds, texel))
                old = mi.UInt32(dr.gather(mi.UInt8, known.kinds, texel, on))
                for channel in range(len(total)):
                    own = _dot(self._shares[channel].at(kind), light)
                    own += _dot(self._reflected[channel].at(kind, on), incident)
                    own -= _dot(self._reflects[channel].at(old, on), incident)
                    total[channel] += weight * (own - dr.gather(mi.Float, added[channel], texel))
            return (point + 1, *total)

        start = (mi.UInt32(0), *(dr.zeros(mi.Float, len(chosen)) for _ in added))
        _, *total = dr.while_loop(start, lambda point, *_: point < last, body)
        dr.eval(total)
        found[chosen] += np.stack([np.array(value) for value in total], axis=1) / np.float32(samples.count)
        return found

    def _uneven(self, added: list[Jit]) -> NDArray[np.intp]:
        """Faces whose correction may change by more than `_LEAST_MK`."""
        import cv2

        mi, samples, change = self._mi, self._known.samples, self._change
        least = _LEAST_MK * change.plan.radiance_per_mk
        band = sum(dr.abs(value) for value in added)
        flags = dr.select((change.changed > 0) | (band > dr.opaque(mi.Float, least)), mi.UInt8(1), mi.UInt8(0))
        # Corners of a point's square of texels are neighbours of its texel.
        whole, geometry, near = flags.numpy(), samples.geometry, np.ones((3, 3), np.uint8)
        for first, surface in zip(geometry.texel_start, geometry.surfaces, strict=False):
            part = whole[first : first + surface.material.size].reshape(surface.material.shape)
            if part.any():
                part[...] = cv2.dilate(part, near)
        chosen = samples.with_any(mi.UInt8(aligned(whole, np.uint8)))
        most = float((1.0 - change.plan.spectrum.emissivity).max())
        return np.union1d(chosen, np.flatnonzero(most * self._strength > least))


def _dot(one: list[Jit], other: list[Jit]) -> Jit:
    return sum(a * b for a, b in zip(one, other, strict=True))
