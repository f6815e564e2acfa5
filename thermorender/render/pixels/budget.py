"""The error budget of a frame: estimated errors of its radiance by cause, in mK at 300 K.

The sampling error of a pixel is first predicted from the image. Some pixels are then rendered again with more rays, and
the prediction is scaled to the errors measured there. Details that no ray has hit and no neighbour indicates are not
included.

Crowns are shown as the mean of all leaves of their density; in a pixel are a few, whose scatter is the error "leaves".

The error of the light includes that of its rays, from the difference of their halves, and that of baking. Halves have
the same bias, so the light in some pixels is computed again by random walks. A difference beyond the rays' error is
added.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.rays import TOP_M
from thermorender.atmosphere.uncertainty import seen_change
from thermorender.materials.mixture import Mixture
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.render.air import altitude
from thermorender.render.arrays import Floats, Jit, aligned, view_ray
from thermorender.render.dynamic import ObjectState
from thermorender.render.geometry import Geometry
from thermorender.render.layers import Layer, LayerHit, first_hit
from thermorender.render.loaded import LoadedLight
from thermorender.render.pixels.crown_light import along
from thermorender.render.pixels.sampling import STAGES, CameraRays, contrast, edge_estimate, texture_estimate
from thermorender.render.pixels.tracer import SampledImage, Tracer
from thermorender.render.plan import Plan
from thermorender.render.reflection import mirrors
from thermorender.render.sobol import sobol
from thermorender.render.spectrum import REFERENCE_K
from thermorender.render.truth import EMISSIVITY_STDS, truth

# Pixels at which the uncertainty of the air's absorption is taken; targets behind air that passes less than this share
# are as warm as the scene in the mean.
_AIRED, _LEAST_PASSED = 256, 0.1
# The light's error is read at every n-th pixel.
_PIXELS = 16
# (number of pixels rendered again, rays per pixel) among pixels of the first image, those of them close to refined
# pixels, refined pixels, pixels that may show something thin, and pixels without a surface. Half are drawn evenly, half
# in proportion to the predicted squared error.
_AUDITED = ((768, STAGES[0]), (256, STAGES[0]), (256, STAGES[-1]), (256, STAGES[-1]), (256, STAGES[0]))
# Close to refined pixels: within this many [px]. Edges end there, and errors are seldom as small as elsewhere.
_CLOSE = 2
# Standard errors added to the measured error: the few pixels with the largest errors are seldom drawn, and one view in
# thousands may be stated too low.
_SURE = 3.5
# Pixels whose light is computed again, of faces beside something solid and of others; points in each of both
# estimates, and walks from each point.
_WALKED, _POINTS, _WALKS = 256, 8, 16
# Largest error of a point at the end of a ray, over the ray's length.
_ROUNDED = 4.0 * 2.0**-24
# Standard errors added to the error that walks find.
_WALKED_SURE = 2.0
# Largest share of light assumed to be passed on between mirrors.
_MOST_PASSED = 0.98
# Error of the light on leaves, relative to what they reflect of the open sky in place of other leaves: the largest mean
# against leaves drawn one by one.
_UNRESOLVED = 0.07
# Smallest predicted error [mK].
_LEAST_MK = 1.0


def budget_mk(
    baked: LoadedLight, tracer: Tracer, pose: Floats, states: Sequence[ObjectState], radiance: NDArray[np.float32],
    sampling: SampledImage,
) -> dict[str, float]:  # fmt: skip
    """Return {cause: estimated root mean square error [mK]} of a frame over the pixels that show a surface. "image" is
    the total over all pixels; sky and surroundings add sampling only. "emissivity" and "emissivity_mean", of a learned
    map, and "gases", of the air's absorption, are not in the total: they are errors of what is declared, not of the
    rendering."""
    errors, shown = sampling_error(baked.plan, tracer, radiance, sampling) / baked.plan.radiance_per_mk, sampling.shown
    parts = _everywhere(baked)
    light, mirrored = _light(baked, tracer.rays, pose, states, _PIXELS)
    parts["bake"] = _rms(light)
    if baked.plan.specular:
        parts["mirrors"] = float(np.hypot(parts["mirrors"], _rms(mirrored)))
    if baked.geometry.crowns is not None:
        parts["leaves"] = _rms(_leaves(baked, tracer, pose, states, _PIXELS))
    parts["sampling"] = _rms(errors[shown])
    total = float(np.sqrt(sum(value**2 for value in parts.values())))
    found = {**parts, "total": total, "image": _rms(np.where(shown, total, errors))}
    found |= _gases(baked, tracer.rays, pose, states, radiance, shown)
    if any(isinstance(material, Mixture) for material in baked.scene.materials):
        seen = truth(baked, tracer.rays, pose, states)
        effect = emissivity_mk(baked, seen)
        found |= {name.removesuffix("_std"): _rms(seen[name] * effect) for name in EMISSIVITY_STDS if name in seen}
    return found


def error_mk(
    baked: LoadedLight, tracer: Tracer, pose: Floats, states: Sequence[ObjectState], radiance: NDArray[np.float32],
    sampling: SampledImage,
) -> NDArray[np.float32]:  # fmt: skip
    """Return the estimated error of each pixel by all causes, (H, W) float32 [mK at 300 K]; NaN without a surface."""
    errors = np.where(sampling.shown, sampling_error(baked.plan, tracer, radiance, sampling), np.nan)
    rays = tracer.rays
    light = np.zeros(radiance.size)
    light[rays.order] = np.nan_to_num(np.hypot(*_light(baked, rays, pose, states, 1)))
    if baked.geometry.crowns is not None:
        light[rays.order] = np.hypot(light[rays.order], np.nan_to_num(_leaves(baked, tracer, pose, states, 1)))
    square = light.reshape(radiance.shape) ** 2 + np.square(errors / baked.plan.radiance_per_mk, dtype=np.float64)
    square += sum(value**2 for value in _everywhere(baked).values())
    return np.sqrt(square).astype(np.float32)


def _gases(
    baked: LoadedLight, rays: CameraRays, pose: Floats, states: Sequence[ObjectState], radiance: NDArray[np.float32],
    shown: NDArray[np.bool_],
) -> dict[str, float]:  # fmt: skip
    """{"gases": standard uncertainty by the air's absorption [mK]} over some pixels; {} without air or for air whose
    column is not known. Targets are blackbodies with the radiance that the pixel shows without the air between."""
    scene, mi = baked.scene, baked.device.geometry.mi
    if scene.air is None or scene.air.column is None:
        return {}
    showing = np.flatnonzero(shown.reshape(-1)[rays.order])
    if not len(showing):
        return {}
    numbers = showing[_one_of(max(len(showing) // _AIRED, 1), len(showing))].astype(np.uint32)
    slope = rays.slopes(0.5, 0.5, mi.UInt32(aligned(numbers, np.uint32)))
    layers = baked.device.layers(pose, states)
    hit, _, _ = first_hit(layers, lambda layer: view_ray(mi, *layer.view, *slope), lambda _: [dr.zeros(mi.Float)])
    ray = view_ray(mi, *layers[0].view, *slope)
    distance, point = np.array(hit.distance, np.float64), np.array(ray.o + hit.distance * ray.d, np.float64).T
    seen = np.isfinite(distance)
    if not seen.any():
        return {}
    band, radius = scene.camera.band_um, baked.geometry.radius_m
    lowest, highest = scene.air.altitude_m[0], TOP_M
    ends = [np.clip(altitude(each, scene.altitude_m, radius), lowest, highest) for each in (pose[:3, 3], point[seen])]
    path = ends[0], ends[1], np.maximum(distance[seen], np.abs(ends[1] - ends[0]))
    passed, added = scene.air.path(*path)
    black = scene.air.planck(REFERENCE_K)
    share = passed @ black / black.sum()
    bare = radiance.reshape(-1)[rays.order[numbers]][seen] - added.sum(axis=-1)
    middle = float(np.mean([baked.plan.coldest, baked.plan.warmest]))
    known = (share > _LEAST_PASSED) & (bare > 0.0)
    kelvin = np.full(len(share), middle)
    kelvin[known] = brightness_temperature(bare[known] / share[known], *band)
    change = seen_change(scene.air, *path, kelvin)
    return {} if change is None else {"gases": _rms(change / baked.plan.radiance_per_mk)}


def emissivity_mk(baked: LoadedLight, images: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return the change of each pixel by an emissivity of 1 more, (H, W) [mK at 300 K]; NaN where no surface is. It is
    an upper estimate: the surface reflects the open sky, or sky and sun at normal incidence, without air before it.
    `images` are those of `Frame.truth`."""
    scene, band = baked.scene, baked.scene.camera.band_um
    known = np.isfinite(images["kinetic_temperature"])
    contrast = np.full(known.shape, np.nan)
    contrast[known] = band_radiance(images["kinetic_temperature"][known], *band)
    contrast = contrast - band_radiance(scene.sky_temperature, *band)
    lit, cosine = 0.0, baked.plan.spectrum.envelope.sun_cosine
    if cosine is not None:
        lit = baked.plan.spectrum.points.sunlight(scene.altitude_m, cosine).sum() / np.pi
    contrast = np.maximum(np.abs(contrast), np.abs(contrast - lit))
    return np.asarray(contrast / baked.plan.radiance_per_mk, dtype=np.float64)


def _everywhere(baked: LoadedLight) -> dict[str, float]:
    """{cause: error [mK]} of causes that affect all pixels alike."""
    plan = baked.plan
    parts = {"nodes": plan.spectrum.nodes_mk + baked.errors_mk["solution"]}
    if baked.scene.air is not None:
        parts["air"] = plan.spectrum.channels_mk
    if "preview_rms" in baked.errors_mk:
        parts["preview"] = baked.errors_mk["preview_rms"]
    if plan.specular:
        parts["mirrors"] = plan.specular.error_mk
    return parts


def _light(
    baked: LoadedLight, rays: CameraRays, pose: Floats, states: Sequence[ObjectState], every: int
) -> tuple[Floats, Floats]:
    """Errors of every n-th pixel [mK], NaN where nothing is hit: of the light, and of limiting mirror reflections."""
    device, mi = baked.device, baked.device.geometry.mi
    numbers, judged = _one_of(every, len(rays.order)), _one_of(_PIXELS, len(rays.order))
    slope = rays.slopes(0.5, 0.5, mi.UInt32(aligned(numbers, np.uint32)))
    # Variation within faces is known for the static scene only.
    within = dr.opaque(mi.Float, (baked.errors_mk["faces"] * baked.plan.radiance_per_mk) ** 2)
    layers, errors = device.layers(pose, states), device.face_errors(states)
    nothing, steps = dr.zeros(mi.Float, len(slope[0])), [dr.zeros(mi.Float, len(slope[0])) for _ in range(2)]

    def read(at: LayerHit) -> list[Jit]:
        hit, error, geometry = at.hit, errors[at.number], at.layer.geometry
        own = nothing
        if error is not None:
            own = dr.gather(mi.Float, error, hit.face, hit.valid) + (0.0 if at.number else within)
        reflects = nothing
        if at.number == 0:
            texel, of = geometry.nearest(hit.surface, *at.place, hit.valid), device.texels[0].material
            material = mi.UInt32(dr.gather(type(of), of, texel, hit.valid))
            reflects = 1.0 - dr.gather(mi.Float, device.emissivities[0], material, hit.valid)
        return [own, reflects, *mirrors.met(at.layer, hit, at.place)]

    hit, number, (square, reflects, texel, row) = first_hit(
        layers, lambda layer: view_ray(mi, *layer.view, *slope), read
    )
    distance, state = hit.distance, [number, hit.face, texel, row]
    if any(layer.outgoing.directional for layer in layers):
        ray = view_ray(mi, *layers[0].view, *slope)
        steps = mirrors.last_steps(layers, ray.o, ray.d, distance, *state)
    dr.eval(square, steps, distance, state, reflects)
    missed = ~np.isfinite(np.array(distance))
    own = np.array(square, dtype=np.float64)
    if baked.transport is not None:
        still = ~missed & (np.array(state[0]) == 0)
        face, shares = np.array(state[1])[still], np.array(reflects, dtype=np.float64)[still]
        again = np.isin(numbers[still], judged)
        own[still] += _unexplained(baked, rays, layers[0], numbers[still], again, face, shares, own[still])
    found = [np.sqrt(own), *(np.array(step, dtype=np.float64) for step in steps)]
    light, mirrored, next_step = (np.where(missed, np.nan, values) / baked.plan.radiance_per_mk for values in found)
    # Later steps are assumed to decrease by the same ratio.
    share = min(_rms(next_step) / max(_rms(mirrored), 1e-30), _MOST_PASSED)
    return light, mirrored / (1.0 - share)


def _leaves(
    baked: LoadedLight, tracer: Tracer, pose: Floats, states: Sequence[ObjectState], every: int
) -> Floats:  # fmt: skip
    """Standard deviation of every n-th pixel over crowns drawn leaf by leaf [mK]; NaN where it shows nothing.

    Leaves of side l at random places cover a share of a pixel of side p with the variance T (1 − T) r / (1 + r), where
    T is the mean share that passes and r = 2/3 (l/p)² (a leaf's mean projected area is half of its own, and of the
    square of it a third). Leaves that are seen differ by the sun on them.
    """
    device, mi, field, rays = baked.device, baked.geometry.mi, baked.geometry.crowns, tracer.rays
    assert field is not None and tracer.crowns is not None
    numbers = _one_of(every, len(rays.order))
    slope = rays.slopes(0.5, 0.5, mi.UInt32(aligned(numbers, np.uint32)))
    layers, sums = device.layers(pose, states), baked.plan.spectrum.solver.sum(axis=0)

    def read(at: LayerHit) -> list[Jit]:
        return at.layer.outgoing.at(at.layer.geometry, at.hit, at.place)

    hit, _, behind = first_hit(layers, lambda layer: view_ray(mi, *layer.view, *slope), read, Geometry.seen_through)
    ray = view_ray(mi, *layers[0].view, *slope)
    outgoing = layers[0].outgoing
    until, walk = dr.select(hit.valid, hit.distance, np.inf), partial(tracer.crowns.walk, tracer.crowns.listed(slope))
    leaves = along(layers[0].geometry, outgoing, ray, until, walk)
    dr.eval(behind, leaves.passed, leaves.distance, leaves.channels, hit.valid, ray.d.z)
    solid, own = (
        sum(weight * np.array(each, np.float64) for weight, each in zip(sums, channels, strict=True))
        for channels in (behind, leaves.channels)
    )
    scene, band, valid = baked.scene, baked.plan.band_um, np.array(hit.valid)
    sky, around = (float(band_radiance(k, *band)) for k in (scene.sky_temperature, scene.surroundings_temperature))
    outside = np.where(np.array(ray.d.z) >= 0.0, sky, around)
    passed, distance = np.array(leaves.passed, np.float64), np.array(leaves.distance, np.float64)
    ratio = 2.0 / 3.0 * np.square(field.leaf_m * rays.camera.focal_length_px / np.maximum(distance, 1e-3))
    spread = passed * np.square(own - np.where(valid, solid, outside))
    if outgoing.leaves:
        spread = spread + outgoing.leaves.scatter(sums) ** 2
    reflects = 1.0 - min(scene.materials[scene.surfaces[k].material.flat[0]].band_emissivity(*band, REFERENCE_K)
                         for k in field.numbers)  # fmt: skip
    mirrored = reflects * (own - sky)
    # The sides of leaves see shares of the sky between 0 and 1, here evenly: the standard deviation is 1/√12.
    spread = spread + np.square(mirrored) / 12.0
    square = (1.0 - passed) * spread * ratio / (1.0 + ratio)
    # Light on leaves is resolved by parts of a crown and by sides that face up and down.
    square += np.square((1.0 - passed) * _UNRESOLVED * mirrored)
    error = np.sqrt(square) / baked.plan.radiance_per_mk
    return np.where(valid | (passed < 1.0), error, np.nan)


def _one_of(every: int, count: int) -> NDArray[np.uint32]:
    """Numbers of rays, one of each `every` successive ones of `count`, at random: a lattice could miss errors a pixel
    wide."""
    numbers = np.arange(0, count, every)
    numbers = numbers + np.random.Generator(np.random.Philox(0)).integers(0, every, len(numbers))
    return np.minimum(numbers, count - 1).astype(np.uint32)


def _unexplained(
    baked: LoadedLight, rays: CameraRays, layer: Layer, pixels: NDArray[np.uint32], judged: NDArray[np.bool_],
    face: NDArray[np.uint32], shares: Floats, explained: Floats,
) -> Floats:  # fmt: skip
    """Mean square error of the light on static surfaces beyond the `explained` one, (n,) [(W m⁻² sr⁻¹)²]. Rays `pixels`
    (n,) hit `face`, with reflectances `shares`. Half of the `judged` ones are drawn evenly, a quarter each in
    proportion to the explained error and to the square of the reflectance; faces beside something solid are a stratum
    of their own."""
    found = np.zeros(len(pixels))
    assert baked.transport is not None
    beside = np.isin(face, baked.transport.touching)
    random = np.random.Generator(np.random.Philox(0))
    shares = np.square(shares)
    for stratum in (beside, ~beside):
        here = np.flatnonzero(stratum & judged)
        known, reflects = explained[here], shares[here]
        if reflects.sum() == 0.0:
            continue
        chance = 0.5 / here.size + 0.25 * reflects / reflects.sum()
        chance += 0.25 * (known / known.sum() if known.sum() > 0.0 else 1.0 / here.size)
        drawn = random.choice(here.size, _WALKED, p=chance)
        one, two = _differences(baked, rays, layer, pixels[here[drawn]])
        square = one * two / (chance[drawn] * here.size)
        more = square.mean() + _WALKED_SURE * square.std() / np.sqrt(_WALKED) - known.mean()
        found[stratum] = max(more, 0.0) * shares[stratum] / reflects.mean()
    return found


def _differences(
    baked: LoadedLight, rays: CameraRays, layer: Layer, pixels: NDArray[np.uint32]
) -> tuple[Floats, Floats]:
    """Radiance that leaves the surfaces in pixels minus that of random walks, by two independent estimates, (n,) each
    [W m⁻² sr⁻¹]. `pixels` are numbers of rays. Each estimate has its own points in a pixel, and its own walks."""
    geometry, spectrum, texels, count = layer.geometry, baked.plan.spectrum, baked.device.texels[0], len(pixels)
    mi, points = geometry.mi, 2 * _POINTS
    place = sobol(2, points) + 0.5 / points
    right, down = (mi.Float(aligned(np.tile(axis, count))) for axis in place.T)
    ray = view_ray(mi, *layer.view, *rays.slopes(right, down, mi.UInt32(aligned(np.repeat(pixels, points), np.uint32))))
    hit, normal = geometry.cast_with_normal(ray)
    point = mi.Point3f(ray.o + hit.distance * ray.d)
    on_map = geometry.map_position(geometry.record(hit.face, hit.valid), point)
    # A back shows its front's light, and is judged by that of its own side.
    normal = -dr.mulsign(normal, dr.dot(normal, ray.d))
    # Hits of long rays are as far from the surface as the length is rounded; walks start above it.
    above = dr.maximum(_ROUNDED * hit.distance - geometry.lift(point), 0.0)
    # Radiance in the band without a path.
    sums = spectrum.solver.sum(axis=0)
    shown = baked.device.static_outgoing.at(geometry, hit, on_map)
    left = sum(weight * np.array(values, dtype=np.float64) for weight, values in zip(sums, shown, strict=True))
    reflected, share = np.tensordot(sums, spectrum.reflected, (0, 1)), np.zeros((len(right), spectrum.nodes))
    for texel, weight in geometry.corners(geometry.lattice(hit.surface, hit.valid), *on_map):
        number = mi.UInt32(dr.gather(type(texels.material), texels.material, texel, hit.valid))
        read = number, dr.gather(mi.Float, texels.temperature, texel, hit.valid), weight
        material, kelvin, part = (np.array(each) for each in read)
        share += part[:, None] * reflected[material]
        left -= part * baked.walks.emitted(material, kelvin)
    light, node = baked.walks.incident(mi.Point3f(point + above * normal), hit.face, normal, _WALKS)
    left = left - (np.take_along_axis(share, node.astype(np.intp), axis=1) * light).mean(axis=1)
    one, two = np.where(np.array(hit.valid), left, 0.0).reshape(count, 2, _POINTS).mean(axis=2).T
    return one, two


def _rms(values: NDArray[Any]) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64)))) if values.size else 0.0


def sampling_error(
    plan: Plan, tracer: Tracer, radiance: NDArray[np.float32], sampling: SampledImage
) -> NDArray[np.float32]:
    """Return the estimated error of each pixel due to its rays and texture, (H, W) float32 [W m⁻² sr⁻¹]."""
    import cv2

    span, samples, taps = contrast(radiance), plan.sampling.samples, plan.sampling.taps
    # Without a search for edges any contrast may be one.
    step = span if sampling.step is None else sampling.step
    guess = edge_estimate(step, samples) ** 2 + texture_estimate(span - step, samples * taps) ** 2
    guess = guess.ravel()
    thin = np.zeros(radiance.size, dtype=bool)
    for part in sampling.refined:
        guess[part.pixels] = edge_estimate(part.step, part.last) ** 2
        thin[part.pixels] = part.within is not None
    guess += (_LEAST_MK * plan.radiance_per_mk) ** 2
    random = np.random.Generator(np.random.Philox(0))
    found = np.empty(guess.shape, dtype=np.float32)
    finer = sampling.finer
    close = cv2.dilate(finer.view(np.uint8), np.ones((2 * _CLOSE + 1,) * 2, np.uint8)).view(bool).ravel()
    first, finer = sampling.hit.ravel() & ~finer.ravel(), finer.ravel()
    strata = first & ~close, first & close, finer & ~thin, thin, ~(first | finer)
    for mask, (count, again) in zip(strata, _AUDITED, strict=True):
        pixels = np.flatnonzero(mask)
        if not pixels.size:
            continue
        known = guess[pixels].astype(np.float64)
        chance = 0.5 / pixels.size + 0.5 * known / known.sum()
        number = random.choice(pixels.size, count, p=chance)
        drawn = pixels[number]
        off = [radiance.ravel()[drawn] - tracer.resampled(drawn, again, random)[0] for _ in range(2)]
        # The errors of two independent renders do not add up; see `reference.squared_error`.
        square = off[0].astype(np.float64) * off[1] / (chance[number] * pixels.size)
        mean = max(square.mean() + _SURE * square.std() / np.sqrt(count), 0.0)
        # Rays may miss something thin, so they cannot lower the prediction there.
        least = 1.0 if mask is thin else 0.0
        found[pixels] = np.sqrt(known * max(mean / known.mean(), least))
    return found.reshape(radiance.shape)
