"""The light between the surfaces of a scene, solved at all spectral nodes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats
from thermorender.render.dynamic import StaticLight
from thermorender.render.geometry import Geometry
from thermorender.render.light import environment, radiosity, solver, texels
from thermorender.render.plan import Plan
from thermorender.render.spectrum import REFERENCE_K
from thermorender.scene.scene import Scene

# Vectors of a node that a solution from a guess holds.
_VECTORS = 8
# Steps of the rests kept, on either side of 0.
_STEPS = 127
# Light (F, n) in whole steps, and the step of each node (n,).
Steps = tuple[NDArray[np.int8], Floats]


@dataclass(frozen=True, eq=False)
class Kept:
    """Start of the solution of an edit, beside the incident radiance."""

    rest: NDArray[np.int8]  # (F, N) int8 light that faces have not sent, in units of `step`
    step: Floats  # (N,) float64 of each node [W m⁻² sr⁻¹]
    residual: float  # Error of the incident radiance, and so of what faces send, apart from the rest [W m⁻² sr⁻¹]
    noise: NDArray[np.float32]  # (F,) float32 as of SolvedLight
    reflectance: NDArray[np.float32] | None = None  # (F, N) float32 of each face at each node, where it is known

    @classmethod
    def of(
        cls, rests: Sequence[Steps], residual: float, noise: Floats,
        reflectance: NDArray[np.float32] | None = None,
    ) -> "Kept":  # fmt: skip
        """Return the Kept of light that faces have not sent, as of `in_steps` for each part of the nodes."""
        whole, step = (np.concatenate(parts, axis=-1) for parts in zip(*rests, strict=True))
        return cls(whole, step, residual + float(step.max()), noise.astype(np.float32), reflectance)


def in_steps(rest: Floats) -> Steps:
    """Return light that faces have not sent, (F, n), in Steps."""
    step = np.maximum(np.abs(rest).max(axis=0, initial=0.0), 1e-30) / _STEPS
    return np.rint(rest / step).astype(np.int8), step


@dataclass(frozen=True, eq=False)
class SolvedLight:
    """Light between surfaces at all nodes."""

    incident: NDArray[np.float32]  # (F, N) mean incident radiance of each face [W m⁻² sr⁻¹]
    noise: Floats  # (F,) a draw of the Monte Carlo error of each face's reflected radiance [W m⁻² sr⁻¹]
    reflectance: Floats  # (F,) mean over the nodes
    bounds: Floats  # (N,) error bound of `incident` [W m⁻² sr⁻¹]
    mean_reflectance: Floats  # (N,) mean over the faces
    static: StaticLight | None  # None without dynamic objects
    kept: Kept


def tolerance_of(plan: Plan) -> float:
    """Return the error bound to reach at each node [W m⁻² sr⁻¹]."""
    return 0.1 * plan.sampling.tolerance_mk * plan.radiance_per_mk / plan.spectrum.nodes


def black_share(plan: Plan) -> Floats:
    """Return the share of each node in a blackbody's light, (N,)."""
    black = plan.spectrum.black([REFERENCE_K])
    return black[0] / black.sum()


def solve_scene(
    scene: Scene, plan: Plan, geometry: Geometry, known: radiosity.Transport,
    texel: tuple[NDArray[np.uint8], NDArray[np.float32]], guess: Floats | None, tick: Callable[[], object],
) -> SolvedLight:  # fmt: skip
    """Return the SolvedLight of a scene with known Transport, in blocks of nodes. `texel` holds materials and
    temperatures [K], (T,) each; `guess` (F, N) is an incident radiance close to the solution."""
    spectrum = plan.spectrum
    around = environment.of_scene(scene, plan, geometry, known.touching)
    tolerance, shares = tolerance_of(plan), black_share(plan)
    shape = (geometry.face_count, spectrum.nodes)
    incident, noise, mean = np.empty(shape, dtype=np.float32), np.zeros(shape[0]), np.zeros(shape[0])
    bounds, mean_reflectance, residual, rests = np.empty(shape[1]), np.empty(shape[1]), 0.0, list[Steps]()
    static = StaticLight.around(around, *shape) if scene.tracked_objects else None
    blocks = solver.blocks(*shape) if guess is None else solver.blocks(*shape, _VECTORS)
    means = texels.face_means(geometry, plan, *texel, blocks, tick)
    for nodes, (emitted, reflectance) in zip(blocks, means, strict=True):
        near = None if guess is None else guess[:, nodes]
        found = solver.solve(known, emitted, reflectance, around.at(nodes), tolerance, near, tick)
        noise += found.noise
        rests.append(in_steps(found.rest))
        bounds[nodes], residual = found.bound, max(residual, found.rounding)
        incident[:, nodes], mean_reflectance[nodes] = found.incident, geometry.share @ reflectance
        mean += reflectance @ shares[nodes]
        if static:
            static.add(nodes, emitted + reflectance * found.incident, reflectance)
    kept = Kept.of(rests, residual, noise)
    return SolvedLight(incident, noise, mean, bounds, mean_reflectance, static, kept)
