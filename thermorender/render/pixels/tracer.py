"""From a pose to radiance: rays are cast, what they hit is looked up, passed through the air, and averaged in pixels.

What a point of a surface sends to the camera lies ready in texels and faces (`thermorender.render.light.texels`), so a
frame is casting rays, fetching these, and summing; band radiance is averaged over a pixel's rays, never temperature.
Pixels that show an edge get more rays, in stages, until their error is small enough.
"""

from dataclasses import dataclass, field, replace

import drjit as dr
import numpy as np

from thermorender.render import mirrors
from thermorender.render.geometry import Hit, view_ray
from thermorender.render.pixels.footprint import PLACES, OnMap, Reading
from thermorender.render.pixels.sampling import STAGES, UNSEEN, edge_step, typical_edge_estimate


@dataclass(frozen=True)
class Sampling:
    """What is known of the sampling error of an image.

    Attributes
    ----------
    hit : (H, W) bool
        Whether a pixel's ray meets a surface.
    step : (H, W) float32 or None
        As by `edge_step`; None where edges were not looked for.
    refined : list of (pixels (n,), step (n,), rays)
        Flat numbers of the pixels that got more rays, by how much their rays differ, and how many these were; later
        entries hold for their pixels.
    """

    hit: np.ndarray
    step: np.ndarray | None
    refined: list = field(default_factory=list)


class Tracer:
    """Rays from one pose into the layers of a scene.

    Parameters
    ----------
    layers : sequence of Layer
        The static scene first, then each dynamic object, all seen from this pose.
    rays : CameraRays
    medium : Vacuum or AirView
        What lies between the camera and what it sees.
    plan : Plan
        How many rays and taps.
    """

    def __init__(self, layers, rays, medium, plan):
        self._layers, self.rays, self._medium = layers, rays, medium
        self._samples, self._mi = plan.samples, layers[0].geometry.mi
        many = max(plan.taps, PLACES // plan.samples)
        self._reading = Reading(self._mi, plan.taps, many, 1.0 / plan.samples)
        self._once, self._fourfold = Reading(self._mi, 1, 1, 1.0), Reading(self._mi, 4, 4, 1.0)

    def image(self, edge_limit):
        """Return (image (channels, H, W) float32, Sampling): the mean over each pixel's rays of what they see.

        Parameters
        ----------
        edge_limit : float
            Error, in the unit of the image's channels added up, from which on a pixel that shows an edge gets more
            rays; infinite: never.
        """
        mi, rays = self._mi, self.rays
        several = sum(len(layer.geometry.surfaces) for layer in self._layers) > 1
        total = None
        for cell in rays.footprints(self._samples):
            hit, values = self._shade(cell, self._reading)
            total = values if total is None else [a + b for a, b in zip(total, values, strict=True)]
        channels = len(total)
        total = [value / self._samples for value in total]
        # One or two more channels tell where the edges are.
        x, y = cell.slope
        total.append(dr.select(hit.valid, dr.sqrt(1.0 + x * x + y * y) / (hit.distance + hit.mirrored), 0.0))
        if several and edge_limit < np.inf:
            total.append(mi.Float(hit.surface))
        # A target of its own for each channel: several scatters into one array would each cast the rays again.
        targets = [dr.zeros(mi.Float, rays.width * rays.height) for _ in total]
        for target, value in zip(targets, total, strict=True):
            dr.scatter(target, value, rays.pixel)
        dr.eval(targets)
        image = np.stack([target.numpy() for target in targets]).reshape(-1, rays.height, rays.width)
        guide, image = image[channels:], image[:channels]
        if not edge_limit < np.inf:
            return image, Sampling(guide[0] > 0.0, None)
        step = edge_step(image.sum(axis=0), *guide)
        return image, Sampling(guide[0] > 0.0, step, self._refine(image, step, edge_limit))

    def anew(self, pixels, count):
        """Return (channels, n): the mean over `count` rays of pixels by flat number, judged by nothing an image judges.

        Rays are other ones than those of `image`, and their cells are read at other places, and more finely.
        """
        _, values = self._shade(self.rays.finer(self.rays.position[pixels], 0, count, fresh=True), self._fourfold)
        return np.stack([np.array(dr.block_sum(value, count)) for value in values]) / count

    def slopes(self, sampling):
        """Return the slopes of all rays that an image with this Sampling casts, [(x/z, y/z), …]."""
        rays, first = self.rays, 0
        found = [cell.slope for cell in rays.footprints(self._samples)]
        for pixels, _, last in sampling.refined:
            found.append(rays.finer(rays.position[pixels], first, last).slope)
            first = last
        dr.eval(found)
        return found

    def _refine(self, image, step, edge_limit):
        """Replace pixels of an image (channels, H, W) that err too much for their `step` by the mean of more rays.

        Returns `Sampling.refined`.
        """
        rays = self.rays
        image, refined = image.reshape(len(image), -1), []
        pixels = np.flatnonzero(typical_edge_estimate(step, self._samples) > edge_limit)
        unseen = UNSEEN * step.ravel()[pixels]
        total, low, high, first = 0.0, np.inf, -np.inf, 0
        for last in STAGES:
            if not pixels.size:
                break
            _, values = self._shade(rays.finer(rays.position[pixels], first, last), self._once)
            guide = sum(values)
            dr.eval(values, guide)
            found = [dr.block_sum(value, last - first) for value in values]
            found += [dr.block_reduce(op, guide, last - first) for op in (dr.ReduceOp.Min, dr.ReduceOp.Max)]
            *sums, least, most = (np.array(value) for value in found)
            total, low, high = total + np.stack(sums), np.minimum(low, least), np.maximum(high, most)
            image[:, pixels] = total / last
            left = np.maximum(high - low, unseen)
            refined.append((pixels, left, last))
            on = typical_edge_estimate(left, last) > edge_limit
            pixels, total, low, high, unseen, first = pixels[on], total[:, on], low[on], high[on], unseen[on], last
        return refined

    def _shade(self, cell, reading):
        """Return (hit, channels): what the rays of cells hit, and the mean over these of what comes from there.

        Parameters
        ----------
        cell : Footprint
        reading : Reading
        """
        layers = self._layers
        hit, total = self._trace(layers[0], cell, reading)
        surfaces = len(layers[0].geometry.surfaces)
        for layer in layers[1:]:
            other, values = self._trace(layer, cell, reading)
            nearer = other.distance < hit.distance
            total = [dr.select(nearer, b, a) for a, b in zip(total, values, strict=True)]
            hit = Hit(
                hit.valid | nearer,
                dr.minimum(hit.distance, other.distance),
                dr.select(nearer, other.face, hit.face),
                dr.select(nearer, other.surface + surfaces, hit.surface),
                dr.select(nearer, other.mirrored, hit.mirrored),
            )
            surfaces += len(layer.geometry.surfaces)
        ray = view_ray(self._mi, *layers[0].view, *cell.slope)
        return hit, self._medium.at_camera(hit, total, ray.o, ray.d)

    def _trace(self, layer, cell, reading):
        """As `_shade`, of one layer and before the light passes the medium."""
        mi, geometry, outgoing = self._mi, layer.geometry, layer.outgoing
        rotation, origin = layer.view
        ray = view_ray(mi, rotation, origin, *cell.slope)
        hit = geometry.cast(ray, coherent=True)
        record = geometry.record(hit.face, hit.valid)
        position = geometry.map_position(record, ray.o + hit.distance * ray.d)
        on_map = OnMap.of(mi, rotation, ray.d, hit.distance, record, cell)
        total, level = reading.mean(geometry, outgoing.texels, hit, position, on_map, cell.middle)
        if outgoing.rest:
            total += self._once.mean(geometry, outgoing.rest, hit, position, on_map, cell.middle)[0]
        if outgoing.faces:
            # Squares of texels hold many faces, and the light on them.
            own = outgoing.faces.at(hit.face, hit.valid & (level == 0))
            total = [a + b for a, b in zip(total, own, strict=True)]
        if outgoing.mirror:
            texel = geometry.nearest(hit.surface, *position, hit.valid)
            added, mirrored = mirrors.correction(self._layers, layer, ray, hit, texel)
            hit, total = replace(hit, mirrored=mirrored), [a + b for a, b in zip(total, added, strict=True)]
        return hit, total
