"""The light of an edited scene from that of the scene before: only the change is solved, to the same error bound.

The light x on the faces is known, with residual light that is not sent yet (`thermorender.render.light.exchange`). An
edit adds to that residual the change of what faces send in the light x. Rounds of exchange distribute it until its
bound is as small as that of any solution.
"""

from collections.abc import Callable

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Channels, Jit, aligned
from thermorender.render.edits.change import Change, change_of, comparable
from thermorender.render.edits.preview import edited_plan
from thermorender.render.edits.prior import PriorLight, Samples
from thermorender.render.light import environment, solver
from thermorender.render.light.exchange import Exchange, threads
from thermorender.render.light.solved import Kept, SolvedLight, black_share, in_steps, tolerance_of
from thermorender.render.loaded import LoadedLight
from thermorender.render.plan import Plan
from thermorender.render.spectrum import Spectrum
from thermorender.scene.scene import Scene

# Where more texels or faces change, all light is solved again, which is as fast.
_MOST_CHANGED = 0.8
# Rounding of the light and of its change to float32, relative to the brightest light.
_ROUNDED = float(np.finfo(np.float32).eps)
# Rests of less than this share of what is allowed are not sent. Where faces with more are seen by fewer faces than this
# share of all, only they send; where that leaves more than a share, the next round begins with the strong reflectors.
_UNSENT, _FEW, _QUICK = 0.25, 0.25, 0.3
# The tolerance is divided between the rounding of edits so far and what is left.
_FOR_ROUNDING = 0.5


def solved_change(
    baked: LoadedLight, scene: Scene, tick: Callable[[], object]
) -> tuple[Plan, SolvedLight] | None:  # fmt: skip
    """Return (Plan, SolvedLight) of an edited scene; None where all light has to be solved. `tick` may raise."""
    kept, old = baked.loaded.solution, baked.plan
    if kept is None or baked.incident is None or not comparable(baked.scene, scene) or _warmer(baked.scene, scene):
        return None
    plan = edited_plan(baked, scene)
    spectrum = plan.spectrum
    if (
        not plan.bake
        or plan.sun != old.sun
        or max(spectrum.nodes_mk, spectrum.channels_mk) > max(plan.sampling.tolerance_mk, old.spectrum.nodes_mk)
    ):
        return None
    prior = baked.prior
    change = change_of(baked, prior, scene, plan)
    tick()
    if change is None or len(change.faces) > _MOST_CHANGED * baked.geometry.face_count:
        return None
    found = _solved(baked, prior, scene, change, kept, tick)
    return None if found is None else (plan, found)


def _warmer(one: Scene, other: Scene) -> bool:
    """Whether most texels differ in temperature."""
    pairs = [(a.temperature, b.temperature) for a, b in zip(one.surfaces, other.surfaces, strict=True)]
    changed = sum(int(np.count_nonzero(a != b)) for a, b in pairs if a is not b)
    return changed > _MOST_CHANGED * sum(a.size for a, _ in pairs)


def _solved(
    baked: LoadedLight, prior: PriorLight, scene: Scene, change: Change, kept: Kept, tick: Callable[[], object]
) -> SolvedLight | None:
    geometry, plan, transport, incident = baked.geometry, change.plan, baked.transport, baked.incident
    assert transport is not None and incident is not None
    before = kept.reflectance
    if before is None:
        everything = np.arange(geometry.face_count)
        before = _reflectance(prior, prior.kinds, baked.plan.spectrum, everything)
        tick()
    reflectance = before.copy()
    reflectance[change.faces] = _reflectance(prior, change.kinds, plan.spectrum, change.faces)
    tick()
    residual = kept.residual + _ROUNDED * float(incident.max(initial=0.0))
    tolerance, amplified = tolerance_of(plan), solver.amplification(transport, reflectance)
    if amplified * residual > _FOR_ROUNDING * tolerance:
        return None
    tolerance = (1.0 - _FOR_ROUNDING) * tolerance
    rest = np.asarray(kept.rest * kept.step, dtype=np.float64)
    rest[change.faces] += change.sent.T
    outside = plan.spectrum.black([scene.surroundings_temperature])[0]
    outside = outside - baked.plan.spectrum.black([baked.scene.surroundings_temperature])[0]
    around = environment.even(np.zeros(plan.spectrum.nodes), outside, geometry.face_count) if outside.any() else None
    with threads() as pool:
        light = Exchange(transport, pool, rest, reflectance, around, prior.samples.strong, tick)
        left = _settle(light, prior.samples, tolerance / amplified)
    if left * amplified > tolerance:
        raise solver.unsettled(left * amplified, tolerance)
    # The noise of light known before is reflected as that light is.
    shares, noise = black_share(plan), kept.noise.astype(np.float64)
    mean, was = (values[change.faces] @ shares for values in (reflectance, before))
    noise[change.faces] *= mean / np.maximum(was, 1e-6)
    noise += light.noise
    tick()
    bounds = np.full(plan.spectrum.nodes, amplified * (left + residual))
    new = Kept.of([in_steps(light.rest)], residual, noise, reflectance)
    tick()
    return SolvedLight(
        (incident + light.incident).astype(np.float32), noise, reflectance @ shares, bounds,
        geometry.share @ reflectance, None, new,
    )  # fmt: skip


def _settle(light: Exchange, samples: Samples, wanted: float) -> float:
    """Send light until at most `wanted` is left, with rounding; return what is left."""
    quick = True
    for _ in range(solver.ROUNDS):
        before, left = light.largest, light.largest + solver.rounding(samples.transport) * light.brightest
        if left <= wanted:
            break
        faces = light.above(_UNSENT * wanted)
        if quick and samples.rays_on(faces) < _FEW * len(samples.seen):
            light.send_few(faces, samples.seen_on)
            # Faces that reflect much exchange light among themselves first.
            quick = light.largest < _QUICK * before
        else:
            light.send(light.settled(0.5 * wanted))
            samples.strong, quick = light.strong, True
    return left


def _reflectance(prior: PriorLight, kinds: Jit, spectrum: Spectrum, faces: NDArray[np.intp]) -> NDArray[np.float32]:
    """Mean reflectance of faces at each node, (n, N), of the materials `kinds` of all texels."""
    samples, mi = prior.samples, prior.samples.geometry.mi
    if not len(faces):
        return np.zeros((0, spectrum.nodes), np.float32)
    table = Channels(mi, 1.0 - spectrum.emissivity)
    face, last = mi.UInt32(aligned(faces, np.uint32)), dr.opaque(mi.UInt32, samples.count)

    def body(point: Jit, *total: Jit) -> tuple[Jit, ...]:
        own = table.at(mi.UInt32(dr.gather(mi.UInt8, kinds, samples.texel(face, point))))
        return (point + 1, *(a + b for a, b in zip(total, own, strict=True)))

    start = (mi.UInt32(0), *(dr.zeros(mi.Float, len(faces)) for _ in range(spectrum.nodes)))
    _, *total = dr.while_loop(start, lambda point, *_: point < last, body)
    dr.eval(total)
    found = np.stack([np.array(value, dtype=np.float32) for value in total], axis=1)
    found /= np.float32(samples.count)
    return found
