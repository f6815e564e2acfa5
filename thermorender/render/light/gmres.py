"""GMRES for the light between strong reflectors: systems x = K ρ x + source, one per spectral node.

Fixed-point iteration converges like ρⁿ and takes thousands of bounces in a cavity of reflective walls. The minimal
residual over the same bounces (Saad & Schultz 1986, doi:10.1137/0907058) takes about eight.
"""

from typing import Any

import numpy as np

from thermorender.render.arrays import Floats

# Steps of one call. Closed cavities of emissivity 0.001 need about 8; every step stores one more vector.
STEPS = 16


def gmres(operator: Any, rho: Floats, source: Floats, wanted: Floats) -> Floats:
    """Return x with |source − x + K ρ x| ≤ wanted (N,) for every face, or the closest after STEPS steps.

    `operator` is K, a sparse array (F, F); `rho` and `source` are reflectance and right-hand side, (F, N), a system per
    node. Every node has its own Krylov space, as a common one would converge like the worst reflectance. All nodes step
    together, so K is read once per step. `scipy.sparse.linalg.gmres` would read it for every node, and it limits the
    root mean square, not the largest residual.
    """
    count, nodes = source.shape
    size = _norm(source)
    basis = [_scaled(source, size)]
    hessenberg = np.zeros((nodes, STEPS + 1, STEPS))
    for step in range(STEPS):
        vector = basis[step] - operator @ (rho * basis[step])
        before = _norm(vector)
        for number, other in enumerate(basis):
            share = np.einsum("fn,fn->n", other, vector)
            hessenberg[:, number, step] = share
            vector -= share * other
        length = _norm(vector)
        # A remainder this small is rounding error, not a new direction.
        length[length < 1e-14 * before] = 0.0
        hessenberg[:, step + 1, step] = length
        basis.append(_scaled(vector, length))
        system = hessenberg[:, : step + 2, : step + 1]
        goal = np.zeros((nodes, step + 2))
        goal[:, 0] = size
        weights = np.einsum("nij,nj->ni", np.linalg.pinv(system), goal)
        left = goal - np.einsum("nij,nj->ni", system, weights)
        # The largest residual is at least the root mean square, which costs nothing to know.
        if (np.linalg.norm(left, axis=1) <= wanted * np.sqrt(count)).all() and (
            np.abs(_combined(basis, left)).max(axis=0) <= wanted
        ).all():
            break
    return _combined(basis[:-1], weights)


def _norm(values: Floats) -> Floats:
    return np.sqrt(np.einsum("fn,fn->n", values, values))


def _scaled(values: Floats, length: Floats) -> Floats:
    return values * np.where(length > 0.0, 1.0 / np.where(length > 0.0, length, 1.0), 0.0)


def _combined(basis: list[Floats], weights: Floats) -> Floats:
    total = basis[0] * weights[:, 0]
    for number, vector in enumerate(basis[1:], start=1):
        total += vector * weights[:, number]
    return total
