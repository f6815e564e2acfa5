"""Progressive radiosity: light is exchanged between faces in rounds, until little unsent radiosity is left.

The light x that faces receive from what they have sent, s, is x = K s + outside. A face that emits e and reflects ρ has
the unsent rest e + ρ x − s. A round sends any part d of the rests: x grows by K d and the rests by ρ K d − d. The
relation holds whatever d is, so d may be a guess, and errors do not accumulate.

Two guesses save rounds and time. Strong reflectors first exchange light among themselves, by GMRES, and send the
result; in a cavity these are all faces. The spectra of rests hardly differ from face to face, so a round sends their
principal components only, and the remainder stays a rest. Where few faces have a significant rest, only they send, by
the rays that hit them.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats
from thermorender.render.light.environment import Environment
from thermorender.render.light.gmres import gmres
from thermorender.render.light.radiosity import Transport

_T = TypeVar("_T")
# See `Exchange.send_few`.
SeenOn = Callable[[NDArray[np.intp], Floats], tuple[NDArray[Any], Floats]]
# Numbers of faces, and what they see, as `Transport.among`.
Strong = tuple[NDArray[np.intp], Any, Any]
# Faces that reflect more than this exchange light among themselves first. One of less reflects a tenth or less of what
# it receives, so that every round leaves a tenth of the rests or less.
_STRONG = 0.1
# What a round's guesses may leave, as a share of the largest rest.
_GUESS = 0.03
# Share of the squares of all rests that principal components may leave; of the rests of few faces.
_LEFT_OUT, _FEW_LEFT_OUT = 3e-4, 1e-8


def threads() -> ThreadPoolExecutor:
    """Return a pool with a thread for each core that this process may use; SciPy's products release Python's lock."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count())


def strong_reflectors(transport: Transport, reflectance: NDArray[np.floating], known: Strong | None = None) -> Strong:
    """Return the strong reflectors and what they see, as `Transport.among`; `known` where it has all of them."""
    strong = reflectance.max(axis=1) > _STRONG
    if known is not None and np.count_nonzero(strong) == np.count_nonzero(strong[known[0]]):
        return known
    faces = np.flatnonzero(strong)
    return faces, *transport.among(faces)


class Exchange:
    """Light between faces at some nodes; faces emit `emitted` [W m⁻² sr⁻¹] and reflect `reflectance`, both (F, N). The
    number of threads of `pool` does not change the result. `strong` of another Exchange is reused where it has all
    strong reflectors of this one. `tick` is called every few milliseconds; it may raise."""

    def __init__(
        self, transport: Transport, pool: Executor, emitted: Floats, reflectance: NDArray[np.floating],
        environment: Environment | None = None, strong: Strong | None = None,
        tick: Callable[[], object] | None = None,
    ) -> None:  # fmt: skip
        self._transport, self._pool, self._reflectance, self._tick = transport, pool, reflectance, tick
        self._parts, self._known_strong = transport.parts(), strong
        # (F, N): radiance that faces receive, and radiance that leaves them and is not sent yet [W m⁻² sr⁻¹].
        self.incident, self.rest = np.zeros(emitted.shape), emitted.copy()
        # (F,): half the difference that the two halves of the rays make to the reflected light, over all nodes [W m⁻²
        # sr⁻¹].
        self.noise = np.zeros(len(emitted))

        def begin(part: slice) -> tuple[float, float]:
            if environment is None:
                return self._received(part, np.zeros((1, 1)), np.zeros((1, 1)))
            whole, difference = environment.received(transport, part)
            return self._received(part, whole, difference)

        self._measure(begin)

    @cached_property
    def strong(self) -> Strong:
        """The strong reflectors, which exchange light among themselves first; computed when needed."""
        return strong_reflectors(self._transport, self._reflectance, self._known_strong)

    def _measure(self, receive: Callable[[slice], tuple[float, float]]) -> None:
        """Let all parts of the faces receive light, and update `brightest` and `largest`."""
        # The largest incident radiance and the largest rest [W m⁻² sr⁻¹].
        self.brightest, self.largest = map(max, zip(*self._each(receive, self._parts), strict=True))

    def _each(self, job: Callable[[Any], _T], items: Iterable[Any]) -> list[_T]:
        """Results of a job for all items; after a tick that raises, no other item is begun."""
        found = []
        results = self._pool.map(job, items)
        try:
            for result in results:
                found.append(result)
                if self._tick:
                    self._tick()
        finally:
            # A generator, which cancels what waits.
            results.close()  # type: ignore[attr-defined]
        return found

    def _received(self, part: slice, light: Floats, difference: Floats) -> tuple[float, float]:
        """Add light to a part of the faces, and the difference of the halves of their rays; return largest values."""
        reflectance = self._reflectance[part]
        self.noise[part] += np.einsum("fn,fn->f", reflectance, difference)
        self.incident[part] += light
        self.rest[part] += reflectance * light
        return float(np.abs(self.incident[part]).max()), float(np.abs(self.rest[part]).max())

    def settled(self, wanted: float) -> Callable[[slice], Floats]:
        """Return what faces should send so that at most `wanted` is left: rests, after exchange among strong
        reflectors."""
        faces, seen, mutual = self.strong
        if self._tick:
            self._tick()
        sent = self.rest.copy()

        def settle(node: int) -> None:
            own = self._reflectance[faces, node]
            received = (seen @ self.rest[:, node])[:, None]
            left = np.array([max(0.5 * wanted, _GUESS * float(np.abs(received).max(initial=0.0)))])
            if len(faces):
                sent[faces, node] += own * gmres(mutual, own[:, None], received, left)[:, 0]

        self._each(settle, range(sent.shape[1]))
        return sent.__getitem__

    def send(self, sent: Callable[[slice], Floats], basis: Floats | None = None) -> None:
        """Send radiance, (n, N) for a part of the faces, in its principal components or an orthonormal `basis` [W m⁻²
        sr⁻¹]."""
        if basis is None:
            basis = self._components(sent)
        # The share of each ray.
        shares, rays = np.empty((len(self.rest), len(basis))), 2.0 * self._transport.rays

        def divide(part: slice) -> None:
            shares[part] = sent(part) @ (basis.T / rays)

        def receive(part: slice) -> tuple[float, float]:
            seen = (self._transport.halves(part) @ shares).reshape(-1, 2, len(basis))
            self.rest[part] -= shares[part] @ (basis * rays)
            return self._received(part, (seen[:, 0] + seen[:, 1]) @ basis, (seen[:, 0] - seen[:, 1]) @ basis)

        self._each(divide, self._parts)
        self._measure(receive)

    def _components(self, sent: Callable[[slice], Floats]) -> Floats:
        """Principal components of the spectra of all faces, (n, N) orthonormal, as many as represent them."""
        gram: Any = sum(self._each(lambda part: sent(part).T @ sent(part), self._parts))
        return _axes(gram, _LEFT_OUT)

    def above(self, least: float) -> NDArray[np.intp]:
        """Return the faces with a rest of more than `least` at any node, ascending."""
        over = (self.rest > least) | (self.rest < -least)
        return np.flatnonzero(np.logical_or.reduce(over.T))

    def send_few(self, faces: NDArray[np.intp], seen_on: SeenOn) -> None:
        """Send the rests of some faces (n,), ascending. `seen_on` maps the faces and the radiance that they send, (n,
        k), to the faces that receive it (m,), and what these receive by each half of their rays, (m, 2, k)."""
        sent = self.rest[faces]
        basis = _axes(sent.T @ sent, _FEW_LEFT_OUT)
        shares = sent @ basis.T
        rows, seen = seen_on(faces, shares)
        self.rest[faces] -= shares @ basis
        light, reflectance = seen.sum(axis=1) @ basis, self._reflectance[rows]
        self.noise[rows] += np.einsum("fn,fn->f", reflectance, (seen[:, 0] - seen[:, 1]) @ basis)
        self.incident[rows] += light
        self.rest[rows] += reflectance * light
        self.brightest, self.largest = (float(np.abs(values).max()) for values in (self.incident, self.rest))
        if self._tick:
            self._tick()


def _axes(gram: Floats, left_out: float) -> Floats:
    """Principal axes (n, N) of a sum of squares (N, N), without a share of it."""
    size, axes = np.linalg.eigh(gram)
    kept = np.cumsum(np.maximum(size, 0.0)) > left_out * size.sum()
    # Without any light one is kept.
    kept[-1] = True
    return np.asarray(axes[:, kept].T)
