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
from thermorender.render.sampling import STAGES, UNSEEN, edge_step, offsets, typical_edge_estimate


@dataclass(frozen=True)
class Sampling:
    """What is known of the sampling error of an image.

    Attributes
    ----------
    step : (H, W) float32 or None
        As by `edge_step`; None where edges were not looked for.
    refined : list of (pixels (n,), step (n,), rays)
        Flat numbers of the pixels that got more rays, by how much their rays differ, and how many these were; later
        entries hold for their pixels.
    """

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
        self._layers, self._rays, self._medium = layers, rays, medium
        self._samples, self._taps = plan.samples, plan.taps
        self._mi = layers[0].geometry.mi

    def image(self, edge_limit):
        """Return (image (channels, H, W) float32, Sampling): the mean over each pixel's rays of what they see.

        Parameters
        ----------
        edge_limit : float
            Error, in the unit of the image's channels added up, from which on a pixel that shows an edge gets more
            rays; infinite: never.
        """
        mi, rays = self._mi, self._rays
        several = sum(len(layer.geometry.surfaces) for layer in self._layers) > 1
        total = None
        pattern = offsets(self._samples, self._taps)
        for offset, taps in pattern:
            slope = rays.slopes(*offset)
            taps = [slope if tap == offset else rays.slopes(*tap) for tap in taps]
            hit, values = self._shade(slope, taps)
            total = values if total is None else [a + b for a, b in zip(total, values, strict=True)]
        channels = len(total)
        total = [value / len(pattern) for value in total]
        if edge_limit < np.inf:
            # One or two more channels tell where the edges are.
            x, y = slope
            total.append(dr.select(hit.valid, dr.sqrt(1.0 + x * x + y * y) / (hit.distance + hit.mirrored), 0.0))
            if several:
                total.append(mi.Float(hit.surface))
        # A target of its own for each channel: several scatters into one array would each cast the rays again.
        targets = [dr.zeros(mi.Float, rays.width * rays.height) for _ in total]
        for target, value in zip(targets, total, strict=True):
            dr.scatter(target, value, rays.pixel)
        dr.eval(targets)
        image = np.stack([target.numpy() for target in targets]).reshape(-1, rays.height, rays.width)
        if not edge_limit < np.inf:
            return image, Sampling(None)
        guide, image = image[channels:], image[:channels]
        step = edge_step(image.sum(axis=0), *guide)
        return image, Sampling(step, self._refine(image, step, edge_limit))

    def slopes(self, sampling):
        """Return the slopes of all rays that an image with this Sampling casts, [(x/z, y/z), …]."""
        rays, first = self._rays, 0
        found = [rays.slopes(*offset) for offset, _ in offsets(self._samples, self._taps)]
        for pixels, _, last in sampling.refined:
            found.append(rays.edge_slopes(rays.position[pixels], first, last))
            first = last
        dr.eval(found)
        return found

    def _refine(self, image, step, edge_limit):
        """Replace pixels of an image (channels, H, W) that err too much for their `step` by the mean of more rays.

        Returns `Sampling.refined`.
        """
        rays = self._rays
        image, refined = image.reshape(len(image), -1), []
        pixels = np.flatnonzero(typical_edge_estimate(step, self._samples) > edge_limit)
        unseen = UNSEEN * step.ravel()[pixels]
        total, low, high, first = 0.0, np.inf, -np.inf, 0
        for last in STAGES:
            if not pixels.size:
                break
            slope = rays.edge_slopes(rays.position[pixels], first, last)
            _, values = self._shade(slope, [slope])
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

    def _shade(self, slope, taps):
        """Return (hit, channels): what rays hit, and the mean over their taps of the light that comes from there."""
        layers = self._layers
        hit, total = self._trace(layers[0], slope, taps)
        surfaces = len(layers[0].geometry.surfaces)
        for layer in layers[1:]:
            other, values = self._trace(layer, slope, taps)
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
        ray = view_ray(self._mi, *layers[0].view, *slope)
        return hit, self._medium.at_camera(hit, total, ray.o, ray.d)

    def _trace(self, layer, slope, taps):
        """As `_shade`, of one layer and before the light passes the medium."""
        mi, geometry = self._mi, layer.geometry
        rotation, origin = layer.view
        ray = view_ray(mi, rotation, origin, *slope)
        hit = geometry.cast(ray, coherent=True)
        record = geometry.record(hit.face, hit.valid)
        lattice = geometry.lattice(hit.surface, hit.valid)
        normal = geometry.normal(record)
        height = hit.distance * dr.dot(normal, ray.d)
        outgoing, met = layer.outgoing, ray.o + hit.distance * ray.d
        total = [mi.Float(0.0) for _ in range(outgoing.texels.count)]
        for tap in taps:
            if tap is slope:
                point = met
            else:
                # Where the tap's own ray would meet the plane of the face that was hit.
                along = mi.Vector3f(*(dr.dot(row, mi.Vector3f(*tap, 1.0)) for row in rotation))
                slant = dr.dot(normal, along)
                point = origin + dr.select(slant != 0.0, height / slant, 0.0) * along
            values = geometry.bilinear(outgoing.texels, lattice, *geometry.map_position(record, point), hit.valid)
            total = [a + b for a, b in zip(total, values, strict=True)]
        total = [value / len(taps) for value in total]
        if outgoing.rest:
            total += geometry.bilinear(outgoing.rest, lattice, *geometry.map_position(record, met), hit.valid)
        if outgoing.faces:
            total = [a + b for a, b in zip(total, outgoing.faces.at(hit.face, hit.valid), strict=True)]
        if outgoing.mirror:
            texel = geometry.nearest(hit.surface, *geometry.map_position(record, met), hit.valid)
            added, mirrored = mirrors.correction(self._layers, layer, ray, hit, texel)
            hit, total = replace(hit, mirrored=mirrored), [a + b for a, b in zip(total, added, strict=True)]
        return hit, total
