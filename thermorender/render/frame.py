"""The renderer: a scene baked once, with the first frame, then one frame per pose.

What a pixel needs is folded beforehand into the radiance of each texel and a correction of each face: see
`thermorender.render.fold`. A frame is casting rays, fetching these, and summing; band radiance is averaged over a
pixel's rays, never temperature.
"""

from copy import copy
from dataclasses import replace

import drjit as dr
import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.frames import Frame
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.render import bake, cache, fold, specular, truth
from thermorender.render.air import Air, Vacuum
from thermorender.render.geometry import Channels, Geometry, Hit, Layer, Shown, opaque_view, view_ray
from thermorender.render.moving import Moving, Still
from thermorender.render.outside import of_scene
from thermorender.render.plan import REFERENCE_K, make_plan
from thermorender.render.sampling import (
    STAGES,
    UNSEEN,
    CameraRays,
    contrast,
    edge_bound,
    edge_error,
    edge_step,
    places,
    texture_error,
)
from thermorender.render.variant import activate
from thermorender.scene.surface import FILLED

# Every how many pixels the light's error is looked up for a frame's budget.
_BUDGET_PIXELS = 16
# Error from which on edge pixels of a visible view get more rays: a share of white, summed over the colours.
_VISIBLE_EDGE = 0.03


class Renderer:
    """Renders frames of one scene.

    Parameters
    ----------
    scene : Scene
    quality : {"fast", "standard", "high"}
        How finely a pixel is sampled; see `thermorender.render.plan.QUALITIES`.
    samples, taps, edge_mk : optional
        Rays per pixel, texture places per ray, and the error from which on a pixel that shows an edge gets more rays
        [mK], in place of the quality's own.
    rays : int
        Rays per face of the bake.
    tolerance_mk : float
        Error allowed to the spectral nodes and to the solution of the bake [mK].
    seed : int
        Seed of the sensor's noise.
    device : {"auto", "cpu", "cuda"}
    progress : callable, optional
        Called with (what, share done) while the scene is baked.
    like : Renderer, optional
        A renderer of the same surfaces at other temperatures; its traced light is used again.

    Attributes
    ----------
    plan : Plan
        What this scene needs and what was left out.
    bake_mk : dict or None
        Errors of the reflected light [mK]: "solution", a bound, and root mean squares over the surfaces: "noise" of
        the rays, from independent halves, "faces", of light taken as constant over a face, and "texels", of folding
        it into texels. None before `prepare`.
    cache_note : str or None
        Why the traced light could not be kept on disk, where it could not.
    """

    def __init__(self, scene, quality="standard", samples=None, taps=None, edge_mk=None, rays=128,
                 tolerance_mk=5.0, seed=0, device="auto", progress=None, like=None):  # fmt: skip
        self.scene, self.seed = scene, seed
        self.plan = make_plan(scene, quality, samples, taps, edge_mk, rays, tolerance_mk)
        if not 0 <= seed < 2**64:
            raise ThermorenderError(f"seed={seed} is not allowed; give a whole number 0 … 2⁶⁴−1")
        self._mi = activate(device)
        same = like is not None and all(
            a.faces is b.faces for a, b in zip(like.scene.surfaces, scene.surfaces, strict=True)
        )
        if like is not None and not same:
            raise ThermorenderError(
                "like=… renders other surfaces; give a renderer of the same scene at other temperatures"
            )
        self._geometry = like._geometry if same else Geometry(self._mi, scene.surfaces)
        corner = [limit(surface.vertices, axis=0) for limit in (np.min, np.max) for surface in scene.surfaces]
        self._box = np.stack([np.min(corner, axis=0), np.max(corner, axis=0)])
        self._transport = None
        if same and like.plan.rays == rays:
            like.prepare()
            self._transport = like._transport
        self._progress = progress or (lambda what, share: None)
        self._material = _flat([surface.material for surface in scene.surfaces])
        self._temperature = _flat([surface.temperature for surface in scene.surfaces])
        self._tolerance_mk = tolerance_mk
        self._per_mk = float(band_radiance_derivative(REFERENCE_K, *self.plan.band_um)) * 1e-3
        self.cache_note = None
        self.bake_mk = self._shown = self._face_error = self._colour = None
        if scene.air is None:
            outside = np.array([scene.spec.sky_temperature, scene.surroundings_temperature])
            self._air = Vacuum(self._mi, *band_radiance(outside, *self.plan.band_um)[:, None])
        else:
            self._air = Air(self._mi, scene, self.plan.spectrum)
        self._laws = specular.Laws(self._mi, self.plan.specular) if self.plan.specular else None
        self._between_here = None
        self._rays_of = {}
        self._still = self._faces_alone = None
        self._placed = not scene.movers
        self._moving = [
            Moving(self._mi, mover, self.plan, scene.materials, linear_from_bytes, self._laws)
            for mover in scene.movers
        ]
        if same and scene.surfaces is like.scene.surfaces and scene.spec == like.scene.spec and not scene.movers:
            if like._tolerance_mk == tolerance_mk and like.plan.rays == rays and like.plan.band_um == self.plan.band_um:
                # The same light: another camera or sampling of one scene needs no new solution.
                self._shown, self._face_error = like._shown, like._face_error
                self.bake_mk = like.bake_mk

    def prepare(self):
        """Trace and solve the light between surfaces now rather than with the first frame."""
        if self.bake_mk is None:
            self._bake(self._tolerance_mk)

    def frame(self, pose, time_s=0.0, index=0, objects=None):
        """Return the Frame seen from `pose`.

        Parameters
        ----------
        pose : (4, 4) array
            world_from_camera: camera looks along +z, x right, y down; metres in the scene's local frame.
        time_s : float
            Where on their tracks moving objects are [s].
        index : int
            Number of the frame; with the seed it decides the noise.
        objects : dict, optional
            {name of a moving object: {column of its track: value}} to take instead of the track's.

        Raises
        ------
        ThermorenderError
            A pose that is no rigid transform, or an object that does not move or leaves the terrain.
        """
        pose = checked_pose(pose)
        self.prepare()
        if self._moving or objects:
            self._put(time_s, objects or {})
        layers = self._layers(pose)
        radiance, sampling = self._radiance(pose, layers)
        budget = lambda: self._budget(pose, radiance, sampling)  # noqa: E731
        return self.frame_of(radiance, pose, time_s, index, budget=budget, layers=layers)

    def frame_of(self, radiance, pose, time_s=0.0, index=0, plan=None, budget=None, layers=None):
        """Return the Frame of a radiance image (H, W) that was made elsewhere for this pose; `plan` says how."""
        rays, layers = self._camera_rays(self.scene.camera), layers or self._layers(pose)
        # Truth and targets are found when asked for, of the objects where they are now.
        moving = [copy(each) for each in self._moving]
        warm = [each.temperature for each in moving]
        return Frame(
            radiance=radiance,
            pose=pose,
            time_s=float(time_s),
            index=int(index),
            seed=self.seed,
            camera=self.scene.camera,
            plan=plan or self.plan.as_dict(),
            _targets=lambda: truth.targets(self.scene, self._geometry, moving, pose),
            _truth=lambda: truth.truth(self.scene, rays, layers, warm),
            _budget=budget,
        )

    def radiance(self, pose):
        """Return the band radiance seen from a pose, (H, W) float32 [W m⁻² sr⁻¹], without noise or truth.

        Moving objects are where the last frame had them, at first at their tracks' time 0.
        """
        self.prepare()
        if not self._placed:
            self._put(0.0, {})
        return self._radiance(pose, self._layers(pose))[0]

    def _put(self, time_s, objects):
        """Move the moving objects to where they are at a time, and their light with them."""
        self._placed = True
        movers = {mover.name: mover for mover in self.scene.movers}
        for name in objects:
            if name not in movers:
                raise ThermorenderError(
                    f"object {name!r} does not move; give one with a track ({', '.join(movers) or 'there is none'})"
                )
        added = []
        for moving in self._moving:
            mover = movers[moving.name]
            values = mover.at(time_s, **objects.get(moving.name, {}))
            world = mover.world_from_own(values, self.scene.ground)
            added.append(moving.put(world, values["temperature_k"], self._still))
        if self._still is not None:
            light = self._faces_alone.copy()
            for faces, more in added:
                light[faces] += more
            self._shown = replace(self._shown, faces=Channels(self._mi, light))

    def _layers(self, pose, colour=False):
        """The still scene and each moving object where it is now, with their light or their colour."""
        layers = [Layer(self._geometry, opaque_view(self._mi, pose), self._colour if colour else self._shown)]
        for moving in self._moving:
            own = opaque_view(self._mi, np.linalg.inv(moving.pose) @ pose)
            layers.append(Layer(moving.geometry, own, moving.colour if colour else moving.shown))
        return layers

    def _radiance(self, pose, layers):
        limit = self.plan.edge_mk * self._per_mk
        image, sampling = self._shade(layers, self.scene.camera, self._between(pose), limit)
        return image[0], sampling

    def _between(self, pose):
        """What lies between a camera at `pose` and what it sees: its air, or none."""
        if self.scene.air is None:
            return self._air
        boxes = [self._box, *(moving.box() for moving in self._moving)]
        box = np.stack([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])
        key = pose[:3, 3].tobytes() + box.tobytes()
        if self._between_here is None or self._between_here[0] != key:
            self._between_here = key, self._air.view(pose[:3, 3], box)
        return self._between_here[1]

    def _budget(self, pose, radiance, sampling):
        plan, mi = self.plan, self._mi
        step, refined = sampling
        span = contrast(radiance)
        if step is None:
            # Nothing was asked about edges: any contrast may be one.
            step = span
        edges = edge_bound(step, plan.samples).ravel()
        for pixels, left, count in refined:
            edges[pixels] = edge_bound(left, count)
        texture = texture_error(span - step, plan.samples * plan.taps)
        light = 0.0
        if self._face_error is not None:
            # Of the faces that some of the pixels show; what differs within the faces is known of the scene only.
            rays = self._camera_rays(self.scene.camera)
            slope = rays.slopes(0.5, 0.5, dr.arange(mi.UInt32, 0, len(rays.order), _BUDGET_PIXELS))
            hit = self._geometry.cast(view_ray(mi, *opaque_view(mi, pose), *slope))
            shown = np.array(dr.gather(mi.Float, self._face_error, hit.face, hit.valid), dtype=np.float64)
            light = np.sqrt(shown.mean() / self._per_mk**2 + self.bake_mk["faces"] ** 2)
        parts = {
            "nodes": plan.spectrum.nodes_mk + self.bake_mk["solution"],
            "bake": float(light),
            "sampling": float(np.sqrt(np.mean(edges**2) + np.mean(texture**2)) / self._per_mk),
        }
        if self.scene.air is not None:
            parts["air"] = plan.spectrum.channels_mk
        if plan.specular:
            parts["mirrors"] = plan.specular.error_mk
        return {**parts, "total": float(np.sqrt(sum(value**2 for value in parts.values())))}

    def rays(self, pose):
        """Return the slopes of all rays that a frame from `pose` casts into the still scene, [(x/z, y/z), …]."""
        _, (_, refined) = self._radiance(checked_pose(pose), self._layers(pose))
        rays = self._camera_rays(self.scene.camera)
        slopes, first = [rays.slopes(*place) for place, _ in places(self.plan.samples, self.plan.taps)], 0
        for pixels, _, last in refined:
            slopes.append(rays.edge_slopes(rays.position[pixels], first, last))
            first = last
        dr.eval(slopes)
        return slopes

    def cast_only(self, pose, rays):
        """Cast rays, as by `rays`, and nothing else: the floor under the time of a frame."""
        view = opaque_view(self._mi, checked_pose(pose))
        cast = self._geometry.caster.ray_intersect_preliminary
        dr.eval([cast(view_ray(self._mi, *view, *slope), coherent=True).t for slope in rays])
        dr.sync_thread()

    def visible(self, pose, camera=None):
        """Return (image (H, W, 3) uint8 sRGB, valid (H, W) bool): the orthophoto seen from `pose`.

        The texture carries its own sun and shade; light is averaged linearly over a pixel's rays. Pixels without
        surface, or where its colour is unknown, are not valid.
        """
        pose, camera = checked_pose(pose), camera or self.scene.camera
        if self._colour is None:
            linear = linear_from_bytes(np.concatenate([s.colour.reshape(-1, 3) for s in self.scene.surfaces]))
            flags = np.concatenate([surface.flags.ravel() for surface in self.scene.surfaces])
            known = ((flags & FILLED) == 0).astype(np.float32)
            self._colour = Shown(Channels(self._mi, np.column_stack([linear, known])))
        if not self._placed:
            self._put(0.0, {})
        nothing = Vacuum(self._mi, *np.zeros((2, 4)))
        found, _ = self._shade(self._layers(pose, colour=True), camera, nothing, _VISIBLE_EDGE)
        return bytes_from_linear(np.moveaxis(found[:3], 0, -1)), found[3] > 0.999

    def _bake(self, tolerance_mk):
        """Fold the scene into texel channels, face channels and the radiance of sky and surroundings."""
        plan, scene, mi = self.plan, self.scene, self._mi
        spectrum = plan.spectrum
        texel = fold.emitted(plan, scene.materials, self._material, self._temperature)
        mirror = None
        if self._laws:
            black = specular.black_of(plan, self._laws, self._material, self._temperature)
            mirror = specular.Mirror(mi, self._laws, self._material, black)
        if not plan.bake:
            self.bake_mk = dict.fromkeys(("solution", "noise", "faces", "texels"), 0.0)
            self._shown = Shown.of(mi, texel, mirror=mirror)
            return
        if self._transport is None:
            what = "tracing the light between surfaces"
            self._progress(what, 0.0)
            self._transport, self.cache_note = cache.traced(
                self._geometry, plan.rays, lambda share: self._progress(what, share)
            )
        self._progress("solving the light between surfaces", 0.0)
        face_emitted, face_reflectance = fold.face_means(self._geometry, plan, self._material, self._temperature)
        outside = of_scene(scene, plan, self._geometry)
        tolerance = 0.1 * tolerance_mk * self._per_mk / spectrum.nodes
        incident, bounds = bake.solve(self._transport, face_emitted, face_reflectance, outside, tolerance)
        noise = bake.noise(self._transport, face_emitted, face_reflectance, outside, incident)
        face = np.empty((self._geometry.face_count, spectrum.channels), dtype=np.float32)
        covers = self._geometry.face_of_texel()
        if spectrum.channels > 1:
            # What scatter means in kelvin is told by the band, whose light no path has weakened.
            light = fold.light(incident, np.tensordot(spectrum.solver.sum(axis=0), spectrum.reflected, (0, 1)))
            _, _, scatter = fold.fold(self._geometry, covers, texel[0], self._material, light)
        for channel in range(spectrum.channels):
            light = fold.light(incident, spectrum.reflected[:, channel])
            texel[channel], face[:, channel], left = fold.fold(
                self._geometry, covers, texel[channel], self._material, light
            )
        scatter = left if spectrum.channels == 1 else scatter
        self._shown = Shown.of(mi, texel, face, mirror)
        if self._moving:
            leaving = face_emitted + face_reflectance * incident
            self._still = Still(self._geometry, leaving, face_reflectance, outside)
            self._faces_alone = face
        share = self._geometry.share
        # Of each face, for the budget of a frame that shows some of them.
        self._face_error = mi.Float(np.float32(noise**2 + scatter))
        varies = fold.variation(self._geometry, incident @ (share @ face_reflectance), noise)
        solution = ((1.0 - spectrum.emissivity).max(axis=0) * bounds).sum()
        rms = [np.sqrt(share @ square) for square in (noise**2, scatter)]
        errors = {"solution": solution, "noise": rms[0], "faces": varies, "texels": rms[1]}
        self.bake_mk = {name: float(value / self._per_mk) for name, value in errors.items()}
        self._progress("solving the light between surfaces", 1.0)

    def _camera_rays(self, camera):
        if camera not in self._rays_of:
            self._rays_of[camera] = CameraRays(self._mi, camera)
        return self._rays_of[camera]

    def _shade(self, layers, camera, between, edge_limit):
        """Return (image, sampling): the mean over a pixel's rays of what they see, and what is known of its error.

        image : (channels, H, W) float32
        sampling : (step, [(pixels, step, rays), …])
            As by `edge_step`, None where edges are not looked for, and the pixels that got more rays.
        """
        mi = self._mi
        rays = self._camera_rays(camera)
        several = len(layers) + len(self.scene.surfaces) > 2
        total = None
        pattern = places(self.plan.samples, self.plan.taps)
        for place, taps in pattern:
            slope = rays.slopes(*place)
            taps = [slope if tap == place else rays.slopes(*tap) for tap in taps]
            hit, values = self._look(layers, slope, taps, between)
            total = values if total is None else [a + b for a, b in zip(total, values, strict=True)]
        channels = len(total)
        total = [value / len(pattern) for value in total]
        if edge_limit < np.inf:
            # One or two more channels tell where the edges are.
            x, y = slope
            total.append(dr.select(hit.valid, dr.sqrt(1.0 + x * x + y * y) / (hit.distance + hit.mirrored), 0.0))
            if several:
                total.append(mi.Float(hit.surface))
        size = camera.height * camera.width
        # A target of its own for each channel: several scatters into one array would each cast the rays again.
        targets = [dr.zeros(mi.Float, size) for _ in total]
        for target, value in zip(targets, total, strict=True):
            dr.scatter(target, value, rays.pixel)
        dr.eval(targets)
        image = np.stack([target.numpy() for target in targets]).reshape(-1, camera.height, camera.width)
        step, refined = None, []
        if edge_limit < np.inf:
            guide, image = image[channels:], image[:channels]
            step = edge_step(image.sum(axis=0), *guide)
            look = lambda slope: self._look(layers, slope, [slope], between)[1]  # noqa: E731
            refined = self._refine(rays, image, step, edge_limit, look)
        return image, (step, refined)

    def _refine(self, rays, image, step, edge_limit, look):
        """Replace pixels of an image (channels, H, W) that err too much for their `step` by the mean of more rays.

        Returns [(pixels, step within them, rays), …].
        """
        image, refined = image.reshape(len(image), -1), []
        pixels = np.flatnonzero(edge_error(step, self.plan.samples) > edge_limit)
        unseen = UNSEEN * step.ravel()[pixels]
        total, low, high, first = 0.0, np.inf, -np.inf, 0
        for last in STAGES:
            if not pixels.size:
                break
            values = look(rays.edge_slopes(rays.position[pixels], first, last))
            guide = sum(values)
            dr.eval(values, guide)
            found = [dr.block_sum(value, last - first) for value in values]
            found += [dr.block_reduce(op, guide, last - first) for op in (dr.ReduceOp.Min, dr.ReduceOp.Max)]
            *sums, least, most = (np.array(value) for value in found)
            total, low, high = total + np.stack(sums), np.minimum(low, least), np.maximum(high, most)
            image[:, pixels] = total / last
            left = np.maximum(high - low, unseen)
            refined.append((pixels, left, last))
            on = edge_error(left, last) > edge_limit
            pixels, total, low, high, unseen, first = pixels[on], total[:, on], low[on], high[on], unseen[on], last
        return refined

    def _look(self, layers, slope, taps, between):
        """Return (hit, channels): what rays hit, and the mean over their taps of the light that comes from there."""
        hit, total = self._meet(layers, layers[0], slope, taps)
        surfaces = len(layers[0].geometry.surfaces)
        for layer in layers[1:]:
            other, values = self._meet(layers, layer, slope, taps)
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
        return hit, between.arrive(hit, total, ray.o, ray.d)

    def _meet(self, layers, layer, slope, taps):
        """As `_look`, of one layer and without what lies beyond it."""
        mi, geometry = self._mi, layer.geometry
        rotation, origin = layer.view
        ray = view_ray(mi, rotation, origin, *slope)
        hit = geometry.cast(ray, coherent=True)
        record = geometry.record(hit.face, hit.valid)
        lattice = geometry.lattice(hit.surface, hit.valid)
        normal = geometry.normal(record)
        height = hit.distance * dr.dot(normal, ray.d)
        shown, met = layer.shown, ray.o + hit.distance * ray.d
        total = [mi.Float(0.0) for _ in range(shown.texels.count)]
        for tap in taps:
            if tap is slope:
                point = met
            else:
                # Where the tap's own ray would meet the plane of the face that was hit.
                along = mi.Vector3f(*(dr.dot(row, mi.Vector3f(*tap, 1.0)) for row in rotation))
                slant = dr.dot(normal, along)
                point = origin + dr.select(slant != 0.0, height / slant, 0.0) * along
            values = geometry.bilinear(shown.texels, lattice, *geometry.place(record, point), hit.valid)
            total = [a + b for a, b in zip(total, values, strict=True)]
        total = [value / len(taps) for value in total]
        if shown.rest:
            total += geometry.bilinear(shown.rest, lattice, *geometry.place(record, met), hit.valid)
        if shown.faces:
            total = [a + b for a, b in zip(total, shown.faces.at(hit.face, hit.valid), strict=True)]
        if shown.mirror:
            texel = geometry.nearest(hit.surface, *geometry.place(record, met), hit.valid)
            added, mirrored = specular.changed(layers, layer, ray, hit, texel)
            hit, total = replace(hit, mirrored=mirrored), [a + b for a, b in zip(total, added, strict=True)]
        return hit, total


def checked_pose(pose):
    """Return a pose as (4, 4) float64 after refusing what is no rigid transform."""
    pose = np.array(pose, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.allclose(pose[3], [0, 0, 0, 1]):
        raise ThermorenderError(
            f"pose of shape {pose.shape} is no world_from_camera; give (4, 4) with last row 0 0 0 1"
        )
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0.0:
        raise ThermorenderError(
            "pose has a rotation that is not orthonormal and right-handed; normalise its quaternion"
        )
    return pose


def _flat(images):
    """All texels side by side; a single image is not copied, as it may fill gigabytes."""
    return images[0].reshape(-1) if len(images) == 1 else np.concatenate([image.ravel() for image in images])
