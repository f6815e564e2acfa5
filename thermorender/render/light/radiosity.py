"""Diffuse light between surfaces and from the sky, solved once per scene.

For each face a fixed set of cosine-distributed rays is traced once. What they hit makes a sparse transport
operator K (share of a face's hemisphere that sees each other face); what they miss is sky, or the surroundings
below the horizon. Per spectral node the mean incident radiance x of every face then satisfies the linear system

    x = K (e + ρ x) + outside,

with e and ρ the faces' mean emitted radiance and reflectance. GMRES solves it, whose work hardly depends on ρ,
and the residual bounds the error: see `solve`.

The rays of a face are the points of Sobol' (1967, doi:10.1016/0041-5553(67)90144-9) in four dimensions, two of
direction and two of place, whose digits each face shifts at random (Owen 2003, doi:10.1145/945511.945518). They come
in two halves, and what these disagree about tells the Monte Carlo error of their mean, too large rather than too
small: see `noise`. Normals are those of the flat faces.
"""

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.render.geometry import aligned, of_faces
from thermorender.render.light.gmres import STEPS, gmres

# A cached Transport of another version is not used: count up with every change of what `trace` returns.
VERSION = 4
# Bins of zenith angle in which rays to the sky are counted, even in the root of its cosine: narrow at the horizon.
SKY_BINS = 16
# Some 30 bytes per ray at once.
_RAYS_AT_ONCE = 1 << 21
# Some 300 bytes per face at once.
_FACES_AT_ONCE = 1 << 18
_SEED = 0x7E44
# Memory that the vectors of one solution may take.
_KRYLOV_BYTES = 1 << 30
# Reflected back more completely than this, light is amplified beyond what float64 resolves.
_MOST_REFLECTED = 1.0 - 1e-7
# Accuracy to which the Monte Carlo error itself is wanted.
_NOISE_ACCURACY = 0.05
# Steps of the table from which chords of the unit disk are drawn.
_CHORDS = 4096


@dataclass(frozen=True)
class Transport:
    """What the faces' rays see, independent of any temperature.

    Attributes
    ----------
    rays : int
        Rays per face in each of the two halves.
    start : (2 F + 1,) int64
        Rows 2 i and 2 i + 1, what the first and second half of face i's rays hit, lie at start[row]:start[row + 1].
    seen : (nnz,) int32
        Faces that are hit, ascending in each row.
    hits : (nnz,) uint16
        How many rays hit them.
    up : (F, 2, SKY_BINS) uint16
        Rays of each half that see the sky, by zenith angle.
    down : (F, 2) uint16
        Rays of each half that see the surroundings below the horizon.
    """

    rays: int
    start: np.ndarray
    seen: np.ndarray
    hits: np.ndarray
    up: np.ndarray
    down: np.ndarray

    def __getstate__(self):
        # The operator is made again from the rest, and is as large.
        return {name: value for name, value in vars(self).items() if name != "operator"}

    @property
    def sky(self):
        """Share of each face's cosine-weighted hemisphere that sees each bin of the sky, (F, SKY_BINS)."""
        return self.up.sum(axis=1) / (2.0 * self.rays)

    @property
    def background(self):
        """Share of each face's cosine-weighted hemisphere that sees the surroundings below the horizon, (F,)."""
        return self.down.sum(axis=1) / (2.0 * self.rays)

    @cached_property
    def operator(self):
        """Share of face i's cosine-weighted hemisphere that sees face j, (F, F) csr_array of float64."""
        from scipy.sparse import csr_array

        # A row of the sum is both halves' rows one after the other: every second border is left out.
        weight = self.hits / (2.0 * self.rays)
        return csr_array((weight, self.seen, self._borders[::2].copy()), shape=(len(self.up), len(self.up)))

    def forget_operator(self):
        """Free the operator's memory until it is asked for again."""
        vars(self).pop("operator", None)

    @property
    def halves(self):
        """Rows 2 i and 2 i + 1 add up to row i of `operator`, (2 F, F); shares the operator's memory."""
        from scipy.sparse import csr_array

        return csr_array((self.operator.data, self.seen, self._borders), shape=(2 * len(self.up), len(self.up)))

    @property
    def _borders(self):
        # SciPy would widen the int32 columns to the borders' type, at twice the memory.
        return self.start.astype(np.int32) if self.start[-1] < 2**31 else self.start


def trace(geometry, rays, progress=None, seed=0):
    """Return the Transport of a scene.

    Parameters
    ----------
    geometry : Geometry
    rays : int
        Rays per face, 1…65536; an odd number counts as the next even one, for two equal halves. Powers of two spread
        evenest.
    progress : callable, optional
        Called with the share done, 0…1.
    seed : int
        0…2³²−1; another seed is another, independent estimate.
    """
    mi, count, half = geometry.mi, geometry.face_count, (rays + 1) // 2
    rays_of = FaceRays(geometry, half)
    up, down = np.empty((count, 2, SKY_BINS), dtype=np.uint16), np.empty((count, 2), dtype=np.uint16)
    lengths, seen, hits = [], [], []
    step = max(1, _RAYS_AT_ONCE // (2 * half))
    for first in range(0, count, step):
        here = min(step, count - first)
        origin, direction, _, _ = rays_of(first, here, seed)
        found = geometry.cast(mi.Ray3f(origin, direction))
        # One number per ray: the face, or one beyond the last for each bin of the sky and for the surroundings.
        code = dr.select(found.valid, found.face, count + background_code(mi, direction))
        part = _counted(np.array(code, dtype=np.int32).reshape(2 * here, half), count)
        for whole, values in zip((lengths, seen, hits), part[:3], strict=True):
            whole.append(values)
        up[first : first + here] = part[3][:, :SKY_BINS].reshape(here, 2, SKY_BINS)
        down[first : first + here] = part[3][:, SKY_BINS].reshape(here, 2)
        if progress:
            progress((first + here) / count)
    start = np.concatenate([[0], np.cumsum(np.concatenate(lengths), dtype=np.int64)])
    return Transport(half, start, np.concatenate(seen), np.concatenate(hits), up, down)


def sky_edges():
    """Return the cosines of zenith angle between which the bins of the sky lie, (SKY_BINS + 1,)."""
    return (np.arange(SKY_BINS + 1) / SKY_BINS) ** 2


def background_code(mi, direction):
    """Return what a ray sees that hits nothing: the bin of the sky, or SKY_BINS for the surroundings, UInt32."""
    position = mi.UInt32(dr.sqrt(dr.clip(direction.z, 0.0, 1.0)) * SKY_BINS)
    return dr.select(direction.z >= 0.0, dr.minimum(position, SKY_BINS - 1), SKY_BINS)


def solve(transport, emitted, reflectance, environment, tolerance):
    """Return (incident (F, N) mean incident radiance of each face, error bound (N,)), both [W m⁻² sr⁻¹].

    Parameters
    ----------
    transport : Transport
    emitted, reflectance : (F, N)
        Mean emitted radiance [W m⁻² sr⁻¹] and reflectance of each face at each node.
    environment : Environment
        Light from sky, surroundings and sun.
    tolerance : float
        Error bound to reach at each node [W m⁻² sr⁻¹].

    Raises
    ------
    ThermorenderError
        The system does not converge to the tolerance.

    Notes
    -----
    An error δ with the residual r obeys δ = K ρ δ + r, and K ρ has no negative entries, hence
    ‖δ‖∞ ≤ ‖r‖∞ / (1 − max K ρ). The residual is itself rounded, once per number that a row adds up. Nodes are solved
    side by side, so that the operator is read once for all of them; see `blocks` for how many.
    """
    operator = transport.operator
    source = operator @ emitted + _beyond(transport, environment, 1.0)
    if environment.direct is not None:
        source += environment.direct
    reflected = (operator @ reflectance).max(axis=0, initial=0.0)
    if reflected.max() > _MOST_REFLECTED:
        raise ThermorenderError(
            f"surfaces that face each other reflect {reflected.max():.8f} of the light between them, which never "
            "leaves; give them an emissivity of 1e-6 or more"
        )
    amplification = 1.0 / (1.0 - reflected)
    wanted = 0.5 * tolerance / amplification
    rounding = 0.5 * np.finfo(float).eps * (2 * transport.rays + 4)
    x, residual = np.zeros(source.shape), source
    for _ in range(6):
        x += gmres(operator, reflectance, residual, wanted)
        residual = source - x + operator @ (reflectance * x)
        bound = (np.abs(residual).max(axis=0) + rounding * np.abs(x).max(axis=0, initial=0.0)) * amplification
        if bound.max() <= tolerance:
            return x, bound
    raise ThermorenderError(
        f"the light between surfaces does not converge: {bound.max():.3g} W m⁻² sr⁻¹ remain where "
        f"{tolerance:.3g} are asked; give a larger tolerance"
    )


def noise(transport, emitted, reflectance, environment, incident):
    """Return a draw of the Monte Carlo error of each face's reflected radiance, (F,) [W m⁻² sr⁻¹].

    The sum over nodes. That of one face tells little by itself; the root mean square over many faces is one standard
    error. Draws of other nodes of the same transport add up with their signs.

    Parameters
    ----------
    transport, emitted, reflectance, environment
        As given to `solve`.
    incident : (F, N)
        Its result.

    Notes
    -----
    The two halves of the rays see the solved radiosity J = e + ρ x as x₁ and x₂. If they were independent,
    (x₁ − x₂) / 2 would have the variance of their mean's error. But they fill each other's gaps, and it is 1.0 to 1.4
    times as large in scenes of the open. That error is light in its own right and is reflected on:
    δ = K ρ δ + (x₁ − x₂) / 2 to first order, which matters in cavities.
    """
    seen = (transport.halves @ (emitted + reflectance * incident)).reshape(len(emitted), 2, -1)
    source = seen[:, 0] - seen[:, 1] + _beyond(transport, environment, -1.0)
    size = np.abs(source).max(axis=0)
    return (reflectance * gmres(transport.operator, reflectance, source, _NOISE_ACCURACY * size)).sum(axis=1)


def blocks(faces, nodes):
    """Return slices of nodes, as many at a time as the vectors of a solution have room for, at least one."""
    size = max(1, _KRYLOV_BYTES // (8 * max(faces, 1) * (STEPS + 4)))
    return [slice(first, min(first + size, nodes)) for first in range(0, nodes, size)]


def _beyond(transport, environment, sign):
    """Light from beyond the surfaces on each face, (F, N): of both halves of its rays, the second times `sign`."""
    light = np.empty((len(transport.up), len(environment.background)))
    for first in range(0, len(light), _FACES_AT_ONCE):
        part = slice(first, first + _FACES_AT_ONCE)
        up, down = (
            (counted[part, 0] + sign * counted[part, 1]) / (2.0 * transport.rays)
            for counted in (transport.up, transport.down)
        )
        light[part] = environment.light(up, down, part)
    return light


def face_rays(geometry, half):
    """Return (origin, direction, origin on the face's other side, normal) of 2 × `half` rays off every face.

    Dr.Jit arrays, the rays of a face side by side.
    """
    return FaceRays(geometry, half)(0, geometry.face_count, 0)


class FaceRays:
    """The cosine-distributed rays off faces, in two halves of `half` rays.

    Notes
    -----
    Cosine-distributed directions stand evenly over the unit disk (Malley's method). That is crossed here by level
    chords: at angle θ, sin θ off the middle, with shares 1/2 + (θ + sin θ cos θ) / π of the disk below. A far horizon
    then lies at one share of all chords, whatever the slope, which Sobol's points tell apart to 1 / n.
    """

    def __init__(self, geometry, half):
        from scipy.stats import qmc

        self._mi, self._rays = geometry.mi, 2 * half
        # A power of two of them, which SciPy asks for, of which the first serve.
        points = qmc.Sobol(4, scramble=False).random_base2((2 * half - 1).bit_length())[: 2 * half]
        self._base = [self._mi.UInt32(aligned(column * 2.0**24, np.uint32)) for column in points.T]
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 64 * _CHORDS)
        share = 0.5 + (angle + np.sin(angle) * np.cos(angle)) / np.pi
        self._chord = self._mi.Float(aligned(np.interp(np.linspace(0.0, 1.0, _CHORDS + 1), share, angle)))
        found = of_faces(geometry.surfaces, _frames, (4, 3))
        self._faces = [self._mi.Float(aligned(found[:, k])) for k in range(4)]
        self._lift = dr.opaque(self._mi.Float, geometry.hair)

    def __call__(self, first, count, seed):
        """(origin, direction, origin on the other side, normal) of the rays of `count` faces from `first` on."""
        mi = self._mi
        index = dr.arange(mi.UInt32, count * self._rays)
        # Opaque numbers: as literals they would have the kernel compiled anew for each part.
        face, number = index // self._rays + dr.opaque(mi.UInt32, first), index % self._rays
        corner, edge_u, edge_v, normal = (dr.gather(mi.Vector3f, values, face) for values in self._faces)
        # One random shift per face decorrelates neighbours, and keeps the even spread.
        key = dr.opaque(mi.UInt32, seed) * 2 + _SEED
        # With the customary 4 rounds the shifts of successive faces are correlated; with 6 no test tells.
        shifts = (*mi.sample_tea_32(face, key, 8), *mi.sample_tea_32(face, key + 1, 8))
        base = (dr.gather(mi.UInt32, values, number) for values in self._base)
        u = [mi.Float(value ^ (shift >> 8)) * 2.0**-24 for value, shift in zip(base, shifts, strict=True)]
        # A chord of the unit disk across the slope, drawn by its length, and a place along it.
        at = u[0] * _CHORDS
        left = dr.minimum(mi.UInt32(at), _CHORDS - 1)
        angle = dr.lerp(*(dr.gather(mi.Float, self._chord, left + k) for k in (0, 1)), at - mi.Float(left))
        across, half_chord = dr.sincos(angle)
        along = (2.0 * u[1] - 1.0) * half_chord
        out = dr.safe_sqrt((1.0 - dr.square(along)) - dr.square(across))
        spot = mi.warp.square_to_uniform_triangle(mi.Point2f(u[2], u[3]))
        point, lift = corner + spot.x * edge_u + spot.y * edge_v, normal * self._lift
        level = mi.Vector3f(-normal.y, normal.x, 0.0)
        level = dr.normalize(dr.select(dr.squared_norm(level) > 1e-12, level, mi.Vector3f(1.0, 0.0, 0.0)))
        towards = dr.normalize(along * dr.cross(normal, level) + across * level + out * normal)
        return mi.Point3f(point + lift), towards, mi.Point3f(point - lift), normal


def _counted(code, count):
    """(length of each row, faces, hits, rays to nothing (rows, SKY_BINS + 1)) of what (rows, rays) of rays see."""
    rows, rays = code.shape
    code.sort(axis=1)
    flat = code.ravel()
    begins = np.empty(flat.size, dtype=bool)
    np.not_equal(flat[1:], flat[:-1], out=begins[1:])
    begins[::rays] = True
    first = np.flatnonzero(begins)
    hits = np.diff(first, append=flat.size).astype(np.uint16)
    seen = flat[first]
    missing = np.zeros((rows, SKY_BINS + 1), dtype=np.uint16)
    surface = seen < count
    missed = ~surface
    missing[first[missed] // rays, seen[missed] - count] = hits[missed]
    return np.bincount(first[surface] // rays, minlength=rows), seen[surface], hits[surface], missing


def _frames(surface, part):
    """Corner, first edge, second edge and unit normal of faces, (n, 4, 3)."""
    corners = surface.vertices[surface.faces[part]]
    edge_u, edge_v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_u, edge_v)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    # A face without area sees nothing that matters, but a normal of 0 would make rays without direction.
    normal = np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])
    return np.stack([corners[:, 0], edge_u, edge_v, normal], axis=1)
