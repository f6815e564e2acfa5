"""Diffuse light between surfaces and from the sky, solved once per scene.

For each face a fixed set of cosine-distributed rays is traced once. What they hit makes a sparse transport
operator K (share of a face's hemisphere that sees each other face); what they miss is sky, or the surroundings
below the horizon. Per spectral node the mean incident radiance x of every face then satisfies the linear system

    x = K (e + ρ x) + outside,

with e and ρ the faces' mean emitted radiance and reflectance; GMRES solves it (Saad & Schultz 1986,
doi:10.1137/0907058) and the residual bounds the error: row sums of K are at most one, so
‖error‖∞ ≤ ‖residual‖∞ / (1 − max ρ). Normals are those of the flat faces.
"""

from dataclasses import dataclass

import drjit as dr
import numpy as np

from thermorender.errors import ThermorenderError

_RAYS_AT_ONCE = 1 << 22
_SEED = 0x7E44


@dataclass(frozen=True)
class Transport:
    """What the faces' rays see, independent of any temperature.

    Attributes
    ----------
    operator : (F, F) scipy.sparse.csr_array of float64
        Share of face i's cosine-weighted hemisphere that sees face j.
    sky, beyond : (F,) float64
        Shares that see the sky, and the surroundings below the horizon.
    """

    operator: object
    sky: np.ndarray
    beyond: np.ndarray


def trace(geometry, rays, progress=None):
    """Return the Transport of a scene.

    Parameters
    ----------
    geometry : Geometry
    rays : int
        Rays per face.
    progress : callable, optional
        Called with the share done, 0…1.
    """
    from scipy.sparse import csr_array

    mi = geometry.mi
    corner, edge_u, edge_v, normal = _faces(geometry.surfaces)
    count = geometry.face_count
    base = np.array(low_discrepancy(rays, 4), dtype=np.float32)
    base = [mi.Float(np.ascontiguousarray(column)) for column in base.T]
    corner, edge_u, edge_v, normal = (mi.Float(np.ascontiguousarray(a, np.float32).ravel()) for a in (corner, edge_u, edge_v, normal))
    lift = 64.0 * 2.0**-24 * (1.0 + geometry.reach)
    seen, hits_per_face = [], np.zeros(count, dtype=np.int64)
    sky, beyond = np.zeros(count), np.zeros(count)
    step = max(1, _RAYS_AT_ONCE // rays)
    for first in range(0, count, step):
        here = min(step, count - first)
        ray_index = dr.arange(mi.UInt32, here * rays)
        face = ray_index // rays + first
        which = ray_index % rays
        # One random shift per face decorrelates neighbours and keeps the set's even spread.
        shift_a, shift_b = mi.sample_tea_32(face, mi.UInt32(_SEED))
        shift_c, shift_d = mi.sample_tea_32(face, mi.UInt32(_SEED + 1))
        u = [
            dr.gather(mi.Float, base[k], which) + mi.Float(shift >> 8) * 2.0**-24
            for k, shift in enumerate((shift_a, shift_b, shift_c, shift_d))
        ]
        u = [value - dr.floor(value) for value in u]
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u[0], u[1]))
        spot = mi.warp.square_to_uniform_triangle(mi.Point2f(u[2], u[3]))
        n = dr.gather(mi.Vector3f, normal, face)
        origin = dr.gather(mi.Vector3f, corner, face)
        origin += spot.x * dr.gather(mi.Vector3f, edge_u, face) + spot.y * dr.gather(mi.Vector3f, edge_v, face)
        direction = mi.Frame3f(mi.Normal3f(n)).to_world(local)
        found = geometry.cast(mi.Ray3f(mi.Point3f(origin + n * lift), direction))
        hit, target, up = (
            np.asarray(a).reshape(here, rays) for a in (found.valid, found.face, direction.z >= 0.0)
        )
        part = slice(first, first + here)
        hits_per_face[part] = hit.sum(axis=1)
        sky[part] = (~hit & up).sum(axis=1) / rays
        beyond[part] = (~hit & ~up).sum(axis=1) / rays
        seen.append(target[hit].astype(np.int32))
        if progress:
            progress((first + here) / count)
    indices = np.concatenate(seen)
    indptr = np.concatenate([[0], np.cumsum(hits_per_face)])
    operator = csr_array((np.full(len(indices), 1.0 / rays), indices, indptr), shape=(count, count))
    return Transport(operator, sky, beyond)


def solve(transport, emitted, reflectance, sky, beyond, tolerance):
    """Return (incident (F, N) mean incident radiance of each face, error bound (N,)), both [W m⁻² sr⁻¹].

    Parameters
    ----------
    transport : Transport
    emitted, reflectance : (F, N)
        Mean emitted radiance [W m⁻² sr⁻¹] and reflectance of each face at each node.
    sky, beyond : (N,)
        Radiance of the sky and of the surroundings [W m⁻² sr⁻¹].
    tolerance : float
        Error bound to reach at each node [W m⁻² sr⁻¹].

    Raises
    ------
    ThermorenderError
        The system does not converge to the tolerance.
    """
    from scipy.sparse.linalg import LinearOperator, gmres

    shape = emitted.shape
    outside = transport.sky[:, None] * sky + transport.beyond[:, None] * beyond
    source = transport.operator @ emitted + outside
    # All nodes are solved as one system: the operator is read once for all of them.
    system = LinearOperator(
        (source.size, source.size),
        lambda x: (x.reshape(shape) - transport.operator @ (reflectance * x.reshape(shape))).ravel(),
        dtype=np.float64,
    )
    amplification = 1.0 / np.maximum(1.0 - reflectance.max(axis=0), 1e-6)
    wanted = 0.3 * tolerance / amplification.max()
    incident = source.ravel()
    for _ in range(6):
        residual = np.abs(source.ravel() - system @ incident).reshape(shape).max(axis=0)
        bounds = residual * amplification
        if bounds.max() <= tolerance:
            return incident.reshape(shape), bounds
        incident, _ = gmres(system, source.ravel(), x0=incident, rtol=0.0, atol=wanted, restart=20, maxiter=50)
    raise ThermorenderError(
        f"the light between surfaces does not converge: {bounds.max():.3g} W m⁻² sr⁻¹ remain where {tolerance:.3g} "
        "are asked; check for surfaces of emissivity near 0"
    )


def _faces(surfaces):
    """(corner, first edge, second edge, unit normal), each (F, 3), of all faces."""
    corners = np.concatenate([surface.vertices[surface.faces] for surface in surfaces])
    edge_u, edge_v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_u, edge_v)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return corners[:, 0], edge_u, edge_v, np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])


def low_discrepancy(count, dimensions):
    """Return (count, dimensions) points in 0…1 of the Kronecker sequence of the generalised golden ratio (Roberts 2018)."""
    ratio = 2.0
    for _ in range(60):
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    alpha = ratio ** -np.arange(1.0, dimensions + 1.0)
    return (np.arange(1, count + 1)[:, None] * alpha) % 1.0
