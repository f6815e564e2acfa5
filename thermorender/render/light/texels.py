"""Emitted and reflected light baked into one radiance per texel and one correction per face.

Each texel takes the light of the face that covers it. Where a face is seen through texels of other faces (a wall
narrower than a texel, an object of one texel), a constant per face restores its mean. A pixel then needs one texture
and one number per face, whatever the number of spectral nodes. The remaining scatter within faces is an error.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.materials.material import Material
from thermorender.physics.band import RadianceTable
from thermorender.render.arrays import Floats, Jit, aligned
from thermorender.render.geometry import Geometry
from thermorender.render.light.exchange import threads
from thermorender.render.plan import Plan
from thermorender.render.spectrum import Spectrum

# Number of points for the mean of a face: least, most, and per texel of an average face.
_FEWEST, _MOST, _PER_TEXEL = 4, 64, 2
_TEXELS_AT_ONCE = 1 << 18


def face_means(
    geometry: Geometry, plan: Plan, material: NDArray[np.uint8], temperature: NDArray[np.float32],
    blocks: Sequence[slice], tick: Callable[[], object] = lambda: None,
) -> Iterator[tuple[Floats, Floats]]:  # fmt: skip
    """Yield, for each slice of nodes, mean emitted radiance and reflectance of each face, both (F, n) float64.
    `material` and `temperature` [K] are of all texels, (T,)."""
    mi, count, spectrum = geometry.mi, geometry.face_count, plan.spectrum
    grid = RadianceTable.grid(plan.coldest, plan.warmest)
    black = spectrum.black(grid).astype(np.float32)
    materials, temperatures = mi.UInt8(aligned(material, np.uint8)), mi.Float(aligned(temperature))
    # Opaque: literals would compile the kernels again for each scene and hour.
    coldest, step, last = (dr.opaque(mi.Float, float(value)) for value in (grid[0], grid[1] - grid[0], len(grid) - 2))
    # Position of each point on the temperature grid, and its material: five bytes a point.
    places = []
    for found in geometry.points_in_faces(pattern(geometry)):
        number = geometry.nearest(*found)
        position = (dr.gather(mi.Float, temperatures, number) - coldest) / step
        kind = dr.gather(mi.UInt8, materials, number)
        dr.eval(position, kind)
        places.append((position, kind))
        tick()
    for block in blocks:
        nodes = range(*block.indices(spectrum.nodes))
        emitted, reflectance = np.empty((count, len(nodes))), np.empty((count, len(nodes)))
        for column, node in enumerate(nodes):
            table = mi.Float(aligned(black[:, node]))
            emissivity = mi.Float(aligned(spectrum.emissivity[:, node]))
            leaving, epsilon = dr.zeros(mi.Float, count), dr.zeros(mi.Float, count)
            for position, kind in places:
                lower = mi.UInt32(dr.clip(position, 0.0, last))
                planck = dr.lerp(*(dr.gather(mi.Float, table, lower + k) for k in (0, 1)), position - mi.Float(lower))
                here = dr.gather(mi.Float, emissivity, mi.UInt32(kind))
                leaving, epsilon = leaving + planck * here, epsilon + here
                dr.eval(leaving, epsilon)
            tick()
            emitted[:, column] = np.array(leaving, dtype=np.float64) / len(places)
            reflectance[:, column] = 1.0 - np.array(epsilon, dtype=np.float64) / len(places)
        yield emitted, reflectance


def emitted(
    plan: Plan, materials: Sequence[Material], material: NDArray[np.uint8], temperature: NDArray[np.float32],
    tick: Callable[[], object] = lambda: None,
) -> list[NDArray[np.float32]]:  # fmt: skip
    """Return the emission of each texel into each channel, K arrays (T,) float32 [W m⁻² sr⁻¹]. `material` and
    `temperature` [K] are of all texels, (T,)."""
    found = [np.empty(len(material), dtype=np.float32) for _ in range(plan.spectrum.channels)]
    limits = float(temperature.min()), float(temperature.max())
    tables = [plan.spectrum.emitted(each.emissivity_at, *limits, plan.band_um) for each in materials]

    def fill(start: int) -> None:
        part = slice(start, start + _TEXELS_AT_ONCE)
        for number in np.unique(material[part]):
            here = np.flatnonzero(material[part] == number)
            warm, (grid, table) = temperature[part][here], tables[number]
            for channel, values in enumerate(table.T):
                found[channel][part][here] = np.interp(warm, grid, values)

    # Parts, as the interpolation uses float64.
    with threads() as pool:
        for _ in pool.map(fill, range(0, len(material), _TEXELS_AT_ONCE)):
            tick()
    return found


def bake_channel(
    geometry: Geometry, covers: Jit, emitted: NDArray[np.float32], material: NDArray[np.uint8],
    light: NDArray[np.float32], tick: Callable[[], object] = lambda: None,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:  # fmt: skip
    """Return (radiance of each texel (T,), correction of each face (F,), remaining scatter (F,)), float32. Radiance and
    correction are in W m⁻² sr⁻¹; the scatter is the mean square deviation within a face that a constant does not
    restore. `covers` is `Geometry.face_of_texel`, `light` (F + 1, M) from `light`."""
    mi, count, kinds = geometry.mi, geometry.face_count, light.shape[1]
    table = mi.Float(aligned(light))
    materials = mi.UInt8(aligned(material, np.uint8))

    def reflected(face: Jit, number: Jit) -> Jit:
        return dr.gather(mi.Float, table, face * kinds + mi.UInt32(dr.gather(mi.UInt8, materials, number)))

    texel = mi.Float(aligned(emitted)) + reflected(covers, dr.arange(mi.UInt32, len(emitted)))
    dr.eval(texel)
    tick()
    face = dr.arange(mi.UInt32, count)
    mean, square = dr.zeros(mi.Float, count), dr.zeros(mi.Float, count)
    points = pattern(geometry)
    for surface, column, row in geometry.points_in_faces(points):
        missing = mi.Float(0.0)
        for number, weight in geometry.corners(geometry.lattice(surface), column, row):
            missing += weight * (reflected(face, number) - reflected(dr.gather(mi.UInt32, covers, number), number))
        mean, square = mean + missing, square + missing * missing
        dr.eval(mean, square)
        tick()
    mean, square = np.array(mean) / len(points), np.array(square) / len(points)
    return texel.numpy(), mean, np.maximum(square - mean * mean, 0.0)


def reflect(
    radiance: list[NDArray[Any]], geometry: Geometry, spectrum: Spectrum, material: NDArray[np.uint8],
    incident: NDArray[np.float32], tick: Callable[[], object] = lambda: None,
) -> tuple[NDArray[np.float32], NDArray[Any]]:  # fmt: skip
    """Add what texels reflect to their emission `radiance`, K arrays (T,), in place; return (correction of each face
    (F, K), scatter (F,)) as of `bake_channel`. `incident` is the radiance (F, N) on the faces [W m⁻² sr⁻¹]."""
    covers = geometry.face_of_texel
    faces = np.empty((geometry.face_count, spectrum.channels), dtype=np.float32)
    if spectrum.channels > 1:
        # Scatter is converted to kelvin in the band radiance without a path.
        own = light(incident, np.tensordot(spectrum.solver.sum(axis=0), spectrum.reflected, (0, 1)))
        _, _, scatter = bake_channel(geometry, covers, radiance[0], material, own, tick)
    for channel in range(spectrum.channels):
        own = light(incident, spectrum.reflected[:, channel])
        tick()
        baked = bake_channel(geometry, covers, radiance[channel], material, own, tick)
        radiance[channel], faces[:, channel], left = baked
    return faces, left if spectrum.channels == 1 else scatter


def light(incident: NDArray[np.float32], reflected: Floats) -> NDArray[np.float32]:
    """Return the radiance that each material reflects on each face, (F + 1, M) float32 [W m⁻² sr⁻¹], from incident
    radiance (F, N) and reflectance (M, N). The last row is the mean, for texels without a face."""
    found = np.empty((len(incident) + 1, len(reflected)), np.float32)
    np.matmul(incident, reflected.T.astype(np.float32), out=found[:-1])
    found[-1] = found[:-1].mean(axis=0, dtype=np.float64)
    return found


def variation(
    geometry: Geometry, reflected: NDArray[Any], noise: Floats, far: bool = False, samples: int = 2000, seed: int = 0
) -> float:
    """Return the root mean square error of taking light as constant over a face, in the unit of `reflected`.

    It is that of the surfaces without far ground, or of `far` ground alone, whose faces are large.

    `reflected` and `noise` (F,) are the light of each face at the mean reflectance of all, and its Monte Carlo error.
    Over an equilateral triangle of side a, a gradient g leaves g a / √24 around the mean. Neighbours differ by g a / √6
    in the mean square over their three directions: half of that is the error. Light jumps at creases, so only
    neighbours whose normals differ by less than 8° count. `samples` vertices of each surface are drawn.
    """
    random = np.random.Generator(np.random.Philox(seed))
    total = weight = 0.0
    for surface, first in zip(geometry.surfaces, geometry.face_start[:-1], strict=True):
        if surface.far != far:
            continue
        chosen = np.zeros(len(surface.vertices), dtype=bool)
        chosen[random.integers(0, len(chosen), samples)] = True
        face = np.flatnonzero(chosen[surface.faces].any(axis=1))
        corner = surface.faces[face]
        side = np.sort(np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]]), axis=1)
        owner = first + np.tile(face, 3)
        order = np.lexsort(side.T)
        side, owner = side[order], owner[order]
        shared = (side[1:] == side[:-1]).all(axis=1)
        one, other = owner[1:][shared], owner[:-1][shared]
        corners = [surface.vertices[surface.faces[numbers - first]] for numbers in (one, other)]
        normal = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in corners]
        length = [np.linalg.norm(n, axis=1) for n in normal]
        flat = np.einsum("ij,ij->i", *normal) > 0.99 * length[0] * length[1]
        one, other = one[flat], other[flat]
        area = geometry.share[one] + geometry.share[other]
        # The faces of the sample represent their whole surface.
        scale = geometry.share[first : first + len(surface.faces)].sum() / max(area.sum(), 1e-300)
        total += scale * (area @ ((reflected[one] - reflected[other]) ** 2 - noise[one] ** 2 - noise[other] ** 2))
        weight += scale * area.sum()
    return float(np.sqrt(max(total / max(weight, 1e-300), 0.0) / 4.0))


def pattern(geometry: Geometry) -> list[tuple[float, float]]:
    """Return barycentric points (n, 2), evenly spread over a triangle: those that represent a face."""
    texels, faces = np.diff(geometry.texel_start), np.diff(geometry.face_start)
    count = max(
        1 if t == 1 else int(np.clip(np.ceil(_PER_TEXEL * t / f), _FEWEST, _MOST))
        for t, f in zip(texels, faces, strict=True)
    )
    # Square root and product spread the square's points evenly over the triangle.
    return [(1.0 - np.sqrt(a), np.sqrt(a) * b) for a, b in _low_discrepancy(count, 2)]


def _low_discrepancy(count: int, dimensions: int) -> Floats:
    """Return (count, dimensions) points in 0…1, even for any count: the Kronecker sequence of the generalised golden
    ratio (Roberts 2018, "The unreasonable effectiveness of quasirandom sequences")."""
    ratio = 2.0
    for _ in range(60):
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    alpha = ratio ** -np.arange(1.0, dimensions + 1.0)
    return (np.arange(1, count + 1)[:, None] * alpha) % 1.0
