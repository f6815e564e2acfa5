"""From a pose to radiance: rays are cast, radiance at their hits is read, passed through the air, and averaged in
pixels.

Texels and faces hold the radiance that surfaces send to the camera (`thermorender.render.light.texels`). Band radiance
is averaged over a pixel's rays, never temperature. Pixels that show an edge get more rays, in stages, until their error
is small enough.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.air import AirView, Vacuum
from thermorender.render.arrays import Jit, aligned, view_ray
from thermorender.render.geometry import Geometry, Hit
from thermorender.render.layers import Layer, LayerHit, first_hit
from thermorender.render.pixels.crown_light import along
from thermorender.render.pixels.crown_tiles import tiles_of
from thermorender.render.pixels.footprint import PLACES, Climb, OnMap, Reading
from thermorender.render.pixels.sampling import (
    COPIES_STAGES,
    RING,
    STAGES,
    UNSEEN,
    CameraRays,
    Footprint,
    edge_step,
    touched,
    typical_edge_estimate,
    usual_step,
)
from thermorender.render.pixels.slender import Rectangles
from thermorender.render.plan import Plan
from thermorender.render.reflection import mirrors
from thermorender.scene.instances import Instances

# Rays of a pixel without a search for edges.
_FEW = 4
# Error of a detail with edges all round, relative to one edge: 1.3 to 1.4 for 3000 rotated squares and rods.
_ISLAND = 1.5
# Factor of a hash of the numbers of faces (Knuth's).
_HASH = 2654435761
# Share of leaves in front of a surface from which it counts as another one.
_SOME_LEAVES = 0.02
# Inverse depth of the sky in a mirror [1/m]: above 0, which means that nothing is hit.
_ENDLESS = 1e-37


@dataclass(frozen=True)
class Refined:
    """Pixels that got more rays."""

    pixels: NDArray[np.int64]  # (n,) flat numbers
    step: NDArray[Any]  # (n,) largest difference of radiance in a pixel
    first: int  # number of the first of these rays
    last: int  # total number of rays of the pixels
    within: Rectangles | None  # parts of the pixels that contain these rays; None for whole pixels
    copies: bool = False  # whether the pixels show copies of a body


@dataclass(frozen=True)
class SampledImage:
    """How an image was sampled, for its sampling error."""

    hit: NDArray[np.bool_]  # (H, W), whether a pixel's ray hits a surface
    step: NDArray[np.float32] | None  # (H, W) from `edge_step`; None without a search for edges
    refined: list[Refined] = field(default_factory=list)  # pixels with more rays; later entries replace earlier ones

    @property
    def finer(self) -> NDArray[np.bool_]:
        """Pixels with more rays, (H, W)."""
        found = np.zeros(self.hit.shape, dtype=bool)
        for part in self.refined:
            found.flat[part.pixels] = True
        return found

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Pixels that show a surface, or may at an edge, (H, W); the others show sky or surroundings."""
        return self.hit | self.finer


class Tracer:
    """Rays from one pose through a medium into the layers of a scene, the static one first. `slender` returns the
    Rectangles of details thinner than a pixel. In a view without moving objects, the first rays of a `pose` (4, 4) are
    cast once."""

    def __init__(
        self, layers: Sequence[Layer], rays: CameraRays, medium: Vacuum | AirView, plan: Plan,
        slender: Callable[[], Rectangles], pose: NDArray[Any],
    ) -> None:  # fmt: skip
        self._slender = slender
        # The crowns of the view by tiles of the image; None without.
        self.crowns = tiles_of(layers[0], rays)
        if self.crowns:
            # Here, since nothing can be evaluated in a branch of a kernel.
            layers[0].outgoing.patches(layers[0].geometry)
        self._place = None if len(layers) > 1 else (layers[0].geometry, pose.tobytes())
        self._layers, self.rays, self._medium = layers, rays, medium
        copies = [isinstance(each.instances, Instances) for layer in layers for each in layer.geometry.surfaces]
        self._copies = layers[0].geometry.mi.Float(aligned(copies)) if any(copies) else None
        # Copies and crowns have soft edges, for which few rays suffice.
        self._soft = self._copies is not None or self.crowns is not None
        sampling, self._mi = plan.sampling, layers[0].geometry.mi
        self._samples = sampling.samples
        # As the kernels have it, in single precision.
        self._up = pose[2, :3].astype(np.float32).astype(np.float64)
        strong = usual_step(sampling.edge_mk * plan.radiance_per_mk, sampling.samples)
        self._strong = dr.opaque(self._mi.Float, strong)
        self._reading = Reading(self._mi, sampling.taps, max(sampling.taps, PLACES), 1.0 / sampling.samples)
        self._once, self._judge = Reading(self._mi, 1, 1, 1.0), Reading(self._mi, PLACES, 1, 1.0, judges=True)

    def image(
        self, edge_limit: float, like: SampledImage | None = None, copies_limit: float = 0.0
    ) -> tuple[NDArray[np.float32], SampledImage]:
        """Return (image (channels, H, W) float32, SampledImage): the mean radiance over each pixel's rays. `edge_limit`
        is the error, in the unit of the sum of the channels, above which a pixel with an edge gets more rays; infinite:
        never. Where copies of a body show, `copies_limit` replaces a lower one: the error of their light, which more
        rays do not reduce. With `like`, each pixel gets the rays that it had in another image of this view."""
        search = edge_limit < np.inf
        targets, channels, hit = self._first_rays(search)
        # While the kernel runs: both depend on the pose alone.
        crossed, thin = self._at_horizon(), self._slender() if search else None
        sides = self.rays.height + 2 * RING, self.rays.width + 2 * RING
        ringed = np.stack([target.numpy() for target in targets]).reshape(-1, *sides)
        inside = ..., slice(RING, -RING), slice(RING, -RING)
        image, guide = ringed[inside][:channels].copy(), ringed[channels:]
        met = guide[inside][0] > 0.0
        if self._samples == 1:
            # Not what depends on the radiance. The hits of rays that pass crowns are not those of the truth.
            self.rays.last_hits = met if self.crowns is None else None, hit, self._place
        flat = image.reshape(channels, -1)
        crossed = crossed[~met.flat[crossed]]
        if crossed.size:
            flat[:, crossed] = self._rays_in(crossed, 0, self._samples, None)[0] / self._samples
        if thin is None:
            return image, SampledImage(met, None)
        copies = np.zeros(met.size, dtype=bool)
        if self._soft:
            guide, copies = guide[:-1], touched(guide[-1] > 0.0).ravel()
        step = edge_step(ringed[:channels].sum(axis=0), *guide)
        refined = self._refine_edges(flat, step, copies, thin, (edge_limit, max(edge_limit, copies_limit)), like)
        # What is thin and behind leaves, such as trunks, shows little: few rays suffice for most.
        behind = copies[thin.pixels]
        for soft, limit in ((False, edge_limit), (True, max(edge_limit, copies_limit))):
            some = thin.of(behind == soft)
            if some.pixels.size:
                stages = None
                if like is not None:
                    stages = [part.pixels for part in like.refined if part.within is not None and part.copies == soft]
                refined += self._refine(flat, some.pixels, np.zeros(len(some.pixels)), limit, some, stages, soft)
        return image, SampledImage(met, step, refined)

    def _first_rays(self, search: bool) -> tuple[list[Jit], int, Hit]:
        """(channels and guides over the image with its ring, [Float]; number of channels; hits of the last rays, which
        pass all crowns); evaluated."""
        mi, rays = self._mi, self.rays
        total: list[Jit] = []
        # Read and replaced as a whole: another thread may render another view meanwhile.
        single, known, last = self._samples == 1, None, rays.last_hits
        if single and last and self._place is not None and last[2] == self._place:
            known = last[1]
        for cell in rays.footprints(self._samples):
            hit, values = self._shade(cell, self._reading, False, known)
            total = [a + b for a, b in zip(total, values, strict=True)] if total else values
        channels = len(total)
        total = [value / self._samples for value in total] + self._guides(hit, cell, search)
        # One target per channel: several scatters into one array would each cast the rays again.
        targets = [dr.zeros(mi.Float, (rays.height + 2 * RING) * (rays.width + 2 * RING)) for _ in total]
        for target, value in zip(targets, total, strict=True):
            dr.scatter(target, value, rays.ringed)
        solid = Hit(hit.valid, hit.distance, hit.face, hit.surface)
        if self.crowns is not None:
            solid = replace(solid, valid=hit.valid & ~hit.alone, distance=dr.select(hit.alone, np.inf, hit.distance))
        dr.eval(targets, (solid.valid, solid.distance, solid.face, solid.surface) if single else ())
        return targets, channels, solid

    def _guides(self, hit: Hit, cell: Footprint, search: bool) -> list[Jit]:
        """Images that show the edges, [Float]: inverse depth [1/m], 0 for misses; in a search also surfaces, and
        whether of copies."""
        mi, (x, y) = self._mi, cell.slope
        near = dr.sqrt(1.0 + x * x + y * y) / (hit.distance + hit.mirrored)
        guides = [dr.select(hit.valid, dr.maximum(near, _ENDLESS), 0.0)]
        # Not whether some light is strong: other temperatures would then compile another kernel.
        uneven = any(layer.outgoing.faces is not None for layer in self._layers)
        several = uneven or sum(len(layer.geometry.surfaces) for layer in self._layers) > 1
        if several and search:
            # Faces in strong light count as surfaces of their own: smaller than a pixel, they differ without an edge.
            number = dr.select(hit.strong, (hit.face * _HASH >> 27) + 1, 0)
            leaves = dr.select(hit.leaves > _SOME_LEAVES, 0.5, 0.0)
            guides.append(self._body(hit) + mi.Float(number) / 64.0 + leaves)
        if self._soft and search:
            copies = dr.gather(mi.Float, self._copies, hit.surface, hit.valid) if self._copies is not None else 0.0
            guides.append(dr.select(hit.leaves > _SOME_LEAVES, 1.0, copies))
        return guides

    def _body(self, hit: Hit) -> Jit:
        """The surface of hits; tiles of one ground are one."""
        joined = self._layers[0].geometry.joined
        if joined is None:
            return self._mi.Float(hit.surface)
        return dr.gather(self._mi.Float, joined, hit.surface, hit.valid)

    def _refine_edges(
        self, image: NDArray[np.float32], step: NDArray[np.float32], copies: NDArray[np.bool_], thin: Rectangles,
        limits: tuple[float, float], like: SampledImage | None,
    ) -> list[Refined]:  # fmt: skip
        """Refine pixels of an image (channels, H W) that show an edge, those without `copies` (H W) before those with.
        Each group has its own error in `limits`. `step` is from `edge_step`; pixels of `thin` are left out."""
        refined: list[Refined] = []
        for number, limit in enumerate(limits if self._soft else limits[:1]):
            on = (typical_edge_estimate(step, self._samples).ravel() > limit) & (copies == bool(number))
            on[thin.pixels] = False
            stages = None
            if like is not None:
                stages = [part.pixels for part in like.refined if part.within is None and part.copies == bool(number)]
            pixels = np.flatnonzero(on) if stages is None else stages[0] if stages else np.empty(0, np.int64)
            if number and stages is None:
                pixels = pixels[np.argsort(self.rays.position[pixels])]
            unseen = UNSEEN * step.ravel()[pixels]
            refined += self._refine(image, pixels, unseen, limit, stages=stages, copies=bool(number))
        return refined

    def resampled(self, pixels: NDArray[np.integer], count: int, random: np.random.Generator) -> NDArray[Any]:
        """Return (channels, n): the mean over `count` independent random rays of pixels by flat number, for the error
        budget."""
        shift = random.random((len(pixels), 2))
        _, values = self._shade(self.rays.finer(self.rays.position[pixels], 0, count, shift=shift), self._judge)
        return np.stack([np.array(dr.block_sum(value, count)) for value in values]) / count

    def few(self, pixels: NDArray[np.int64]) -> NDArray[Any]:
        """Return (channels, n): the mean over few rays of pixels by flat number, whether they show an edge or not."""
        return self._rays_in(pixels, 0, _FEW, None)[0] / _FEW

    def slopes(self, sampling: SampledImage) -> list[Sequence[Jit]]:
        """Return the slopes of all rays that an image with this SampledImage casts, [(x/z, y/z), …]."""
        rays = self.rays
        found: list[Sequence[Jit]] = [cell.slope for cell in rays.footprints(self._samples)]
        crossed = self._at_horizon()
        crossed = crossed[~sampling.hit.flat[crossed]]
        if crossed.size:
            found.append(rays.finer(rays.position[crossed], 0, self._samples).slope)
        for part in sampling.refined:
            position = rays.position[part.pixels]
            found.append(rays.finer(position, part.first, part.last, part.within).slope)
            if part.within is not None and part.first == 0:
                found.append(rays.finer(position, 0, STAGES[0]).slope)
        dr.eval(found)
        return found

    def _at_horizon(self) -> NDArray[np.int64]:
        """Flat numbers of the pixels that the horizon crosses."""
        return self.rays.crossed(self._up, self._medium.horizon)

    def _refine(
        self, image: NDArray[np.float32], pixels: NDArray[Any], unseen: NDArray[Any], edge_limit: float,
        within: Rectangles | None = None, stages: Sequence[NDArray[Any]] | None = None, copies: bool = False,
    ) -> list[Refined]:  # fmt: skip
        """Replace pixels of an image (channels, H W) by the mean of more rays until their error is below `edge_limit`.
        `unseen` (n,) is the contrast that no ray may have shown. Rays go to the Rectangles `within`, weighted by area.
        `stages` gives the pixels of each stage instead of the limit."""
        refined: list[Refined] = []
        total: Any = 0.0
        low: Any = np.inf
        high: Any = -np.inf
        share: NDArray[Any] = np.ones(len(pixels))
        outside: NDArray[Any] = np.zeros((len(image), len(pixels)))
        spread: NDArray[Any] = np.zeros(len(pixels))
        if within is not None:
            share = within.share
            around, spread = self._outside(pixels, within)
            outside, spread = (1.0 - share) * around, (1.0 - share) * spread
        first = 0
        numbers: Sequence[int] = STAGES
        if within is not None:
            # Thin details may lie between few rays.
            numbers = STAGES if copies else STAGES[-1:]
        elif copies:
            numbers = [count for count in COPIES_STAGES if count > self._samples]
        for last in numbers:
            if not pixels.size:
                break
            sums, least, most = self._rays_in(pixels, first, last, within)
            total, low, high = total + sums, np.minimum(low, least), np.maximum(high, most)
            image[:, pixels] = outside + share * total / last
            left = np.maximum(high - low, unseen)
            if within is not None:
                left = _ISLAND * share * left + spread
            refined.append(Refined(pixels, left, first, last, within, copies))
            if stages is None:
                on = typical_edge_estimate(left, last) > edge_limit
            else:
                on = (
                    np.isin(pixels, stages[len(refined)]) if len(refined) < len(stages) else np.zeros(len(pixels), bool)
                )
            pixels, low, high, unseen, share = (a[on] for a in (pixels, low, high, unseen, share))
            total, outside, spread, first = total[:, on], outside[:, on], spread[on], last
            within = None if within is None else within.of(on)
        return refined

    def _rays_in(
        self, pixels: NDArray[np.int64], first: int, last: int, within: Rectangles | None
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """(sums (channels, n), least (n,), most (n,)) of rays first … last − 1 of pixels, or of parts of them."""
        _, values = self._shade(self.rays.finer(self.rays.position[pixels], first, last, within), self._once)
        guide = sum(values)
        dr.eval(values, guide)
        sums = np.stack([np.array(dr.block_sum(value, last - first)) for value in values])
        least, most = (np.array(dr.block_reduce(op, guide, last - first)) for op in (dr.ReduceOp.Min, dr.ReduceOp.Max))
        return sums, least, most

    def _outside(self, pixels: NDArray[np.int64], within: Rectangles) -> tuple[NDArray[Any], NDArray[Any]]:
        """(mean (channels, n), range (n,)) of a pixel's rays outside their Rectangles."""
        count = STAGES[0]
        _, channels = self._shade(self.rays.finer(self.rays.position[pixels], 0, count), self._once)
        dr.eval(channels)
        values = np.stack([np.array(value) for value in channels]).reshape(len(channels), -1, count)
        out = self.rays.outside(within, count)
        # No ray is outside a rectangle that fills its pixel.
        number = np.maximum(out.sum(axis=1), 1)
        guide = values.sum(axis=0)
        span = np.where(out, guide, -np.inf).max(axis=1) - np.where(out, guide, np.inf).min(axis=1)
        return (values * out).sum(axis=2) / number, np.where(out.any(axis=1), span, 0.0)

    def _shade(
        self, cell: Footprint, reading: Reading, split: bool = True, known: Hit | None = None
    ) -> tuple[Hit, list[Jit]]:
        """Return (hits of the rays of cells, mean radiance over the cells as channels). Without `split`, cells that the
        horizon crosses show the side of their ray only. `known` are the hits, if already cast."""
        layers, mi = self._layers, self._mi
        hit, number, (strong, texel, row, *total) = first_hit(
            layers,
            lambda layer: view_ray(mi, *layer.view, *cell.slope),
            partial(self._read, cell, reading),
            Geometry.seen_through,
            known=known,
        )
        hit, ray = replace(hit, strong=strong), view_ray(mi, *layers[0].view, *cell.slope)
        if any(layer.outgoing.directional for layer in layers):
            met = ray.o, ray.d, hit.distance, number, hit.face, texel, row
            added, mirrored = mirrors.correction(layers, mirrors.DEPTH, *met)
            hit, total = replace(hit, mirrored=mirrored), [a + b for a, b in zip(total, added, strict=True)]
        climb = Climb.of(layers[0].view[0], ray.d.z, cell) if split else None
        values = self._medium.at_camera(hit, total, ray.o, ray.d, climb)
        return (hit, values) if self.crowns is None else self._behind_leaves(ray, cell.slope, hit, values)

    def _behind_leaves(self, ray: Jit, slope: Sequence[Jit], hit: Hit, values: list[Jit]) -> tuple[Hit, list[Jit]]:
        """(hits, radiance) of rays with the leaves in front of what they hit, from those without."""
        layer, crowns = self._layers[0], self.crowns
        assert crowns is not None
        listed, until = crowns.listed(slope), dr.select(hit.valid, hit.distance, np.inf)

        def leafy() -> tuple[Jit, ...]:
            leaves = along(layer.geometry, layer.outgoing, ray, until, partial(crowns.walk, listed))
            some = leaves.passed < 1.0
            near = Hit(some, dr.select(some, leaves.distance, 1.0), hit.face, hit.surface)
            shown = self._medium.at_camera(near, leaves.channels, ray.o, ray.d)
            seen = (dr.select(some, dr.lerp(b, a, leaves.passed), a) for a, b in zip(values, shown, strict=True))
            return (leaves.passed, leaves.distance, *seen)

        def bare() -> tuple[Jit, ...]:
            return (self._mi.Float(1.0), self._mi.Float(0.0), *values)

        # Vectors of rays without crowns pass by.
        passed, distance, *values = dr.if_stmt((), listed[0] < listed[1], leafy, bare)
        # Of leaves before the sky.
        alone = ~hit.valid & (passed < 0.5)
        seen = Hit(hit.valid | alone, dr.select(alone, distance, hit.distance), hit.face, hit.surface)
        return replace(seen, mirrored=hit.mirrored, strong=hit.strong, leaves=1.0 - passed, alone=alone), values

    def _read(self, cell: Footprint, reading: Reading, at: LayerHit) -> list[Jit]:
        """[whether the light on the face is strong, texel and row as of `mirrors.met`, mean channels over the cell]."""
        layer, hit = at.layer, at.hit
        geometry, outgoing, strong = layer.geometry, layer.outgoing, hit.strong
        on_map = OnMap.of(self._mi, layer.view[0], at.ray.d, hit.distance, at.record, cell)
        total, level = reading.mean(geometry, outgoing.texels, hit, at.place, on_map, cell.middle)
        if outgoing.rest:
            total += self._once.mean(geometry, outgoing.rest, hit, at.place, on_map, cell.middle)[0]
        if outgoing.faces:
            # Squares of texels contain many faces with their light.
            own = outgoing.faces.at(hit.face, hit.valid & (level == 0))
            total = [a + b for a, b in zip(total, own, strict=True)]
            strong = dr.abs(sum(own)) > self._strong
        return [self._mi.Bool(strong), *mirrors.met(layer, hit, at.place), *total]
