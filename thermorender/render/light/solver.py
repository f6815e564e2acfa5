"""The light between the faces of a scene, solved at spectral nodes to an error bound, with its Monte Carlo error."""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.render.arrays import Floats
from thermorender.render.light.environment import Environment
from thermorender.render.light.exchange import Exchange, threads
from thermorender.render.light.gmres import STEPS
from thermorender.render.light.radiosity import Transport

# Memory for the vectors of one solution [bytes].
_KRYLOV_BYTES = 1 << 30
# From this share of reflected light on it is worthwhile to compute a sharper bound of it.
_MUCH_REFLECTED = 0.9
# Above this reflectance light is amplified beyond the resolution of float64.
_MOST_REFLECTED = 1.0 - 1e-7
# Relative accuracy of the Monte Carlo error itself.
_NOISE_ACCURACY = 0.05
# Rounds of exchange; about 6 are needed.
ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Solution:
    """The light on faces, all in W m⁻² sr⁻¹."""

    incident: Floats  # (F, N) mean incident radiance of each face
    bound: float  # Its error bound at every node
    # (F,) a draw of the Monte Carlo error of each face's reflected radiance, summed over the nodes. Only its root
    # mean square over many faces is meaningful: it is one standard error. Draws of other nodes of the same transport
    # add with their signs.
    noise: Floats
    rest: Floats  # (F, N) light that faces have not sent
    rounding: float  # Error of `incident` apart from the rest


def solve(
    transport: Transport, emitted: Floats, reflectance: Floats, environment: Environment, tolerance: float,
    start: NDArray[np.floating] | None = None, tick: Callable[[], object] | None = None,
) -> Solution:  # fmt: skip
    """Return the Solution of the light between the faces, to the error bound `tolerance` at each node [W m⁻² sr⁻¹].

    `emitted` [W m⁻² sr⁻¹] and `reflectance` are means of each face at each node, (F, N). `start` (F, N) is an incident
    radiance close to the solution. `tick` is called every few milliseconds; it may raise.

    With the light s sent so far (see `exchange`) and J = e + ρ x, an error δ of the light obeys δ = K ρ δ + K (J − s).
    K and ρ have no negative entries, and no row of K has a sum above 1. Hence ‖δ‖∞ ≤ ‖J − s‖∞ / (1 − max K ρ), where
    the largest ρ may stand for max K ρ. The bound includes the rounding error, one unit per term of a row.

    The two halves of the rays see the radiosity J as x₁ and x₂. For independent halves (x₁ − x₂) / 2 has the variance
    of their mean's error; for Sobol points it is 1.0 to 1.4 times too large in open scenes. The error is itself
    reflected: δ = K ρ δ + (x₁ − x₂) / 2 to first order, which matters in cavities.
    """
    with threads() as pool:
        amplified = amplification(transport, reflectance)
        wanted = 0.5 * tolerance / amplified
        light = Exchange(transport, pool, emitted, reflectance, environment, tick=tick)
        if start is not None:
            light.send(lambda part: emitted[part] + reflectance[part] * start[part], np.eye(emitted.shape[1]))
        for _ in range(ROUNDS):
            bound = amplified * (light.largest + rounding(transport) * light.brightest)
            if bound <= tolerance:
                noise = _reflected_noise(transport, pool, reflectance, light, tick)
                return Solution(light.incident, bound, noise, light.rest, rounding(transport) * light.brightest)
            light.send(light.settled(wanted))
    raise unsettled(bound, tolerance)


def unsettled(bound: float, tolerance: float) -> ThermorenderError:
    """Return the ThermorenderError of light that does not converge to a tolerance."""
    return ThermorenderError(
        f"the light between surfaces does not converge: {bound:.3g} W m⁻² sr⁻¹ remain where "
        f"{tolerance:.3g} are allowed; give a larger tolerance"
    )


def rounding(transport: Transport) -> float:
    """Return the relative rounding error of the light that a face receives."""
    return float(np.finfo(float).eps * (2 * transport.rays + 4))


def amplification(transport: Transport, reflectance: NDArray[np.floating]) -> float:
    """Return a bound of light over its sources, 1 / (1 − the largest fraction passed on), from `reflectance` (F, N)."""
    reflected = float(reflectance.max(initial=0.0))
    if reflected > _MUCH_REFLECTED:
        top = reflectance.max(axis=1) / (2.0 * transport.rays)
        shares = [(transport.halves(part) @ top).reshape(-1, 2).sum(axis=1).max() for part in transport.parts()]
        reflected = min(reflected, float(max(shares)))
    if reflected > _MOST_REFLECTED:
        raise ThermorenderError(
            f"surfaces that face each other reflect {reflected:.8f} of the light between them, which never "
            "leaves; give them an emissivity of 1e-6 or more"
        )
    return 1.0 / (1.0 - reflected)


def _reflected_noise(
    transport: Transport, pool: Executor, reflectance: Floats, light: Exchange, tick: Callable[[], object] | None
) -> Floats:
    """`light.noise` and its reflections, (F,), for all nodes together, with each face's mean reflectance of its
    light."""
    total = light.incident.sum(axis=1)
    mean = np.einsum("fn,fn->f", reflectance, light.incident) / np.where(total > 0.0, total, 1.0)
    error = Exchange(transport, pool, light.noise[:, None], mean[:, None], strong=light.strong, tick=tick)
    error.send(error.settled(_NOISE_ACCURACY * error.largest))
    return light.noise + mean * error.incident[:, 0]


def blocks(faces: int, nodes: int, vectors: int = STEPS + 4) -> list[slice]:
    """Return slices of nodes, each with as many as the memory for the vectors of a solution allows, at least one."""
    size = max(1, _KRYLOV_BYTES // (8 * max(faces, 1) * vectors))
    return [slice(first, min(first + size, nodes)) for first in range(0, nodes, size)]
