"""A first-order preview of an edit: changed texels in the known light, and one bounce of the change of their radiosity.

With K the form factors and ρ the reflectance, the incident light x on the faces changes by δ = K d + K ρ δ. Here d is
the change of the radiosity of changed faces in the light known before. A preview shows K d, in the few spectral
components that d has, and leaves out K ρ δ, the further reflections.

The error is estimated from the second bounce, K ρ |K d|, and from the components left out. They are computed on the
faces that reflect most of what they receive, on those that change, and on faces drawn by their area. Where at most a
fraction q of reflected light is passed on, later bounces add a factor of 1 / (1 − q). For a preview of a preview the
estimate sums what both left out.
"""

from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Channels, Floats, Jit, aligned
from thermorender.render.baked_light import with_previewed
from thermorender.render.device import DeviceScene
from thermorender.render.edits.change import Change, change_of, comparable, touched_by
from thermorender.render.edits.prior import LeftOut, PriorLight, Samples
from thermorender.render.layers import OutgoingRadiance
from thermorender.render.light.exchange import threads
from thermorender.render.loaded import Loaded, LoadedLight
from thermorender.render.plan import Plan, make_plan
from thermorender.scene.scene import Scene

# What spectral components may leave out of what faces send [mK], and their number.
_LEFT_MK, _MOST_SPECTRA = 200.0, 2
# Faces of each kind on which the second bounce is computed, and standard errors added to its mean square.
_JUDGED, _SURE = 3000, 3.5
# From this share of light passed on, a preview is of no use.
_MOST_PASSED = 0.9
# A preview begins from the one before where the solution has more than so many times its rays to changed faces, and
# more rays than take a few milliseconds.
_WORTH, _QUICK_RAYS = 1.3, 1_000_000


def preview(baked: LoadedLight, scene: Scene) -> LoadedLight | None:
    """Return the preview of an edited scene; None where the edit needs a solution."""
    exact = baked.solved
    if exact.incident is None or exact.faces is None or not comparable(exact.scene, scene):
        return None
    start, touched = exact, touched_by(exact, exact.prior, scene)
    if touched is not None and baked is not exact:
        rays_on = exact.prior.samples.rays_on
        rays = rays_on(touched.faces)
        later = touched_by(baked, baked.prior, scene) if rays > _QUICK_RAYS else None
        if later is not None and rays > _WORTH * rays_on(later.faces):
            start, touched = baked, later
    plan = edited_plan(start, scene)
    if not plan.bake or plan.sun != exact.plan.sun or plan.specular or exact.plan.specular:
        return None
    change = None if touched is None else change_of(start, start.prior, scene, plan, touched)
    return None if change is None else _previewed(start, start.prior, scene, change)


def prepare(baked: LoadedLight) -> None:
    """Precompute and cache what all previews of a BakedScene need."""
    if (baked.incident is not None and baked.faces is not None) or baked.loaded.solved:
        samples = baked.prior.samples
        samples.prepare()
        _strongest(baked, samples)


def edited_plan(baked: LoadedLight, scene: Scene) -> Plan:
    """Return the Plan of an edited scene that keeps nodes and channels."""
    return make_plan(scene, baked.plan.sampling, (baked.plan, baked.scene))


def _previewed(baked: LoadedLight, prior: PriorLight, scene: Scene, change: Change) -> LoadedLight:
    geometry = baked.geometry
    # NumPy's part of the work goes on beside Dr.Jit's.
    with threads() as pool:
        basis, light, left = _light(baked, prior, scene, change, pool)
        errors = pool.submit(_errors_mk, baked, prior.samples, change, basis, light, left)
        tables = _ChangedTexels(baked, prior, scene, change, basis, light)
        found, added = tables.texels()
        texels = [values.numpy() for values in found]
        parts = [texels[0][:, None], *([np.stack(texels[1:], axis=1)] if len(texels) > 1 else [])]
        means = [pool.submit(geometry.averaged, part) for part in parts]
        faces = tables.corrected(added)
        first, *rest = (each.result() for each in means)
        errors_mk, left_out = errors.result()
    outgoing = OutgoingRadiance(first, rest[0] if rest else None, Channels(geometry.mi, faces))
    solved, loaded = baked.solved, Loaded(geometry=geometry, samples=prior.samples, left_out=left_out)
    loaded.solved = solved
    loaded.prior_later = partial(prior.after, scene, change.kinds, change.kelvin, basis, light, found)
    shown = replace(
        baked, scene=scene, plan=change.plan, incident=None, texels=tuple(texels), faces=faces,
        errors_mk=with_previewed(solved.errors_mk | errors_mk, scene), loaded=loaded,
    )  # fmt: skip
    same_air = scene.surroundings_temperature == solved.scene.surroundings_temperature
    loaded.device = DeviceScene(shown, geometry, outgoing, solved.device.air if same_air else None)
    return shown


def _light(
    baked: LoadedLight, prior: PriorLight, scene: Scene, change: Change, pool: Executor
) -> tuple[Floats, NDArray[np.float32], tuple[NDArray[np.float32], float]]:  # fmt: skip
    """(orthonormal spectra (k, N), change of the light on faces in them (k, F), what they leave out)."""
    samples, plan = prior.samples, change.plan
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
    baked: LoadedLight, samples: Samples, change: Change, basis: Floats, light: NDArray[np.float32],
    left: tuple[NDArray[np.float32], float],
) -> tuple[dict[str, float], LeftOut]:  # fmt: skip
    """(stated errors of a preview, as of `BakedScene.preview_for` [mK]; what it leaves out)."""
    plan = change.plan
    left_out = _left_out(baked, samples, change, basis, light, left)
    most, typical = (value / plan.radiance_per_mk for value in _errors(baked, samples, change, left_out))
    nodes = plan.spectrum.nodes_mk
    # The solution may have other nodes: where these err too much, where most faces change, and where the rounding of
    # edits has added up.
    more = nodes + max(plan.sampling.tolerance_mk, baked.plan.spectrum.nodes_mk)
    # The solutions before and after the edit have errors of their own, and texels are rounded.
    brightest = max(float(values.max()) for values in baked.texels)
    rounding = float(np.finfo(np.float32).eps) * brightest / plan.radiance_per_mk
    more += 2.0 * (baked.errors_mk["solution"] + rounding)
    return {"preview": most + more, "preview_rms": typical + more}, left_out


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


def _left_out(
    baked: LoadedLight, samples: Samples, change: Change, basis: Floats, light: NDArray[np.float32],
    left: tuple[NDArray[np.float32], float],
) -> LeftOut:  # fmt: skip
    """The light of the second bounce, and of spectra left out, with what the preview before left out."""
    changed, before = change.faces, baked.loaded.left_out
    reflecting = _reflecting(baked, samples, change)
    missing = reflecting * (np.abs(basis).sum(axis=1).astype(np.float32) @ np.abs(light))
    missing[changed] += left[0]
    faces = changed[_most(change.strongest * samples.seen[changed])]
    if before is None:
        return LeftOut(missing, left[1], faces)
    faces = np.union1d(faces, before.faces)
    faces = faces[_most((reflecting * samples.seen)[faces])]
    return LeftOut(missing + before.missing, left[1] + before.outside, faces)


def _reflecting(baked: LoadedLight, samples: Samples, change: Change) -> NDArray[np.float32]:
    """Largest reflectance of a point of each face at any node after an edit, (F,)."""
    strongest = _strongest(baked, samples)[0].copy()
    strongest[change.faces] = change.strongest
    return strongest


def _errors(baked: LoadedLight, samples: Samples, change: Change, left_out: LeftOut) -> tuple[float, float]:
    """Estimates of the preview's largest error and of its root mean square over all faces [W m⁻² sr⁻¹]."""
    strongest = _reflecting(baked, samples, change)
    number = np.random.Generator(np.random.Philox(0)).random(_JUDGED)
    drawn = np.searchsorted(samples.area, number * samples.area[-1])
    faces = np.concatenate([drawn, _strongest(baked, samples)[1], left_out.faces])
    received = samples.received_by(faces, left_out.missing) + left_out.outside * (1.0 - samples.seen[faces])
    passed = float((strongest[faces] * samples.seen[faces]).max())
    error = strongest[faces] * received / (1.0 - min(passed, _MOST_PASSED))
    square = error[:_JUDGED] ** 2
    typical = np.sqrt(square.mean() + _SURE * square.std() / np.sqrt(_JUDGED))
    return float(error.max()) if passed < _MOST_PASSED else np.inf, float(typical)


def _most(values: NDArray[Any]) -> NDArray[np.intp]:
    """Indices of the `_JUDGED` largest values."""
    return (
        np.argpartition(values, len(values) - _JUDGED)[-_JUDGED:] if len(values) > _JUDGED else np.arange(len(values))
    )


def _strongest(baked: LoadedLight, samples: Samples) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """(largest reflectance of each face at any node, (F,); faces that reflect most of what they receive), cached."""
    if baked.loaded.strongest is None:
        geometry, prior = baked.geometry, baked.prior
        mi = geometry.mi
        table = mi.Float(aligned(1.0 - baked.plan.spectrum.emissivity.min(axis=1)))
        face, last = dr.arange(mi.UInt32, geometry.face_count), dr.opaque(mi.UInt32, samples.count)

        def body(point: Jit, found: Jit) -> tuple[Jit, Jit]:
            kind = mi.UInt32(dr.gather(mi.UInt8, prior.kinds, samples.texel(face, point)))
            return point + 1, dr.maximum(found, dr.gather(mi.Float, table, kind))

        start = mi.UInt32(0), dr.zeros(mi.Float, geometry.face_count)
        found = np.array(dr.while_loop(start, lambda point, _: point < last, body)[1])
        baked.loaded.strongest = found, _most(found * samples.seen)
    return baked.loaded.strongest


class _ChangedTexels:
    """The change of texels and faces, from the change of the light on faces. It depends on the pair of materials before
    and after the edit; pairs that occur are numbered."""

    def __init__(
        self,
        baked: LoadedLight,
        prior: PriorLight,
        scene: Scene,
        change: Change,
        basis: Floats,
        light: NDArray[np.float32],
    ) -> None:
        self._mi = mi = baked.geometry.mi
        self._baked, self._prior, self._change = baked, prior, change
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

    def texels(self) -> tuple[list[Jit], list[Jit]]:
        """Return (radiance of texels, K of Float; change of the light that they reflect, K of Float)."""
        mi, prior, change = self._mi, self._prior, self._change
        cover = self._baked.geometry.face_of_texel
        on, kind, pair = change.changed > 0, mi.UInt32(change.kinds), mi.UInt32(change.pair)
        lower, share = change.tables.interval(change.kelvin)
        lower += dr.gather(mi.UInt32, self._row, kind, on) * change.tables.count
        ends = (self._emitted.at(lower + k, on) for k in (0, 1))
        emitted = [dr.lerp(a, b, share) for a, b in zip(*ends, strict=True)]
        incident, light = prior.incident.at(cover, on), self._light.at(cover)
        found, added = [], []
        for channel, texel in enumerate(prior.texels):
            table = self._reflects[channel].at(pair)
            more = _dot(table[: self._spectra], light)
            added.append(_dot(table[self._spectra :], incident) + more)
            found.append(dr.select(on, emitted[channel] + _dot(self._reflected[channel].at(kind, on), incident), texel))
            found[-1] += more
        dr.eval(found, added)
        return found, added

    def corrected(self, added: list[Jit]) -> NDArray[np.float32]:
        """Return the correction of faces, (F, K); `added` as of `texels`."""
        mi, samples, pairs = self._mi, self._prior.samples, self._change.pair
        starts, texels, weights = samples.others
        faces = self._baked.faces
        assert faces is not None
        face = dr.arange(mi.UInt32, len(faces))
        light = [*self._light.at(face), *self._prior.incident.at(face)]
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
