"""Where the radiance of single pixels comes from: emission, reflected sky, sun and surroundings, and the air.

A pixel is represented by the ray through its middle. The texels and the face that it hits hold the sum of emission and
reflected light (`thermorender.render.light.texels`); here the light on the faces is split by its origin, to the
rounding of float32. A mirror image is split by what its second ray hits.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.physics.planck import brightness_temperature
from thermorender.render.arrays import Floats, Jit, aligned, view_ray
from thermorender.render.device import flat
from thermorender.render.layers import LayerHit, first_hit
from thermorender.render.loaded import LoadedLight
from thermorender.render.object_numbers import object_names, objects_of_surfaces
from thermorender.render.reflection import mirrors
from thermorender.render.spectrum import REFERENCE_K
from thermorender.render.view import View
from thermorender.sensor.camera import Camera

# The first four leave the surface.
PARTS = ("emission", "sky", "sun", "surroundings", "air", "background")


@dataclass(frozen=True)
class PixelParts:
    """The surface at the middle of a pixel, and the parts of its radiance.

    Attributes
    ----------
    pixel : (2,) ints
        Row and column.
    material, object : str
        Names; "" where nothing is hit, and for an object also on terrain.
    kinetic_k : float
        Temperature of the texel at the middle [K]; NaN where nothing is hit.
    emissivity : float
        In the camera's band at 300 K, at the angle of view; NaN where nothing is hit.
    angle_deg : float
        From the surface's normal to the camera [deg]; NaN where nothing is hit.
    range_m : float
        From the camera [m]; infinite where nothing is hit.
    apparent_k : float
        Temperature of a blackbody with the ray's radiance [K].
    radiance : dict
        {part: band radiance [W m⁻² sr⁻¹]}; the sum is that of the ray through the pixel's middle. "emission", and
        reflected light of "sky", "sun" and "surroundings", as they arrive through the air; "air", which the path adds;
        "background", sky or ground beyond the terrain that the pixel shows itself. Light that other surfaces pass on,
        whatever its origin, is "surroundings", as is all light on objects with a track.
    kelvin : dict
        {part: by how much the apparent temperature would fall without it [K]}.
    """

    pixel: tuple[int, int]
    material: str
    object: str
    kinetic_k: float
    emissivity: float
    angle_deg: float
    range_m: float
    apparent_k: float
    radiance: dict[str, float]
    kelvin: dict[str, float]


def parts_at(view: View, pixels: ArrayLike) -> list[PixelParts]:
    """Return the PixelParts of a view at pixels (n, 2), each a row and a column."""
    pixels = _checked(pixels, view.rays.camera)
    rays = _Rays(view, pixels)
    scene, band = view.baked.scene, view.baked.plan.band_um
    names, owner, found = ("", *object_names(scene)), objects_of_surfaces(scene), []
    for number, (row, column) in enumerate(pixels.tolist()):
        valid, kind, beside = bool(rays.valid[number]), int(rays.kind[number]), float(rays.added[number])
        radiance = dict(zip(PARTS[:4], (rays.leaving(number) @ rays.weight[number]).tolist(), strict=True))
        radiance |= {"air": beside if valid else 0.0, "background": 0.0 if valid else beside}
        total = sum(radiance.values())
        rest = brightness_temperature(np.maximum(total - np.array(list(radiance.values())), 0.0), *band)
        apparent = float(brightness_temperature(total, *band))
        found.append(PixelParts(
            pixel=(row, column),
            material=scene.materials[kind].name if valid else "",
            object=names[owner[rays.surface[number]]] if valid else "",
            kinetic_k=float(rays.kinetic[number]) if valid else np.nan,
            emissivity=rays.emissivity(number) if valid else np.nan,
            angle_deg=float(np.degrees(np.arccos(rays.cosine[number]))) if valid else np.nan,
            range_m=float(rays.distance[number]) if valid else np.inf,
            apparent_k=apparent,
            radiance=radiance,
            kelvin=dict(zip(radiance, (apparent - rest).tolist(), strict=True)),
        ))  # fmt: skip
    return found


def _checked(pixels: ArrayLike, camera: Camera) -> NDArray[np.intp]:
    """Pixels (n, 2) of a camera's image as integers."""
    found = np.asarray(pixels)
    whole = found.ndim == 2 and found.shape[1] == 2 and found.dtype.kind in "iu"
    if not whole or not ((found >= 0) & (found < (camera.height, camera.width))).all():
        raise ThermorenderError(
            f"pixels={shortened(repr(pixels))} is not allowed; give an array (n, 2) of whole numbers, rows "
            f"0…{camera.height - 1} and columns 0…{camera.width - 1}"
        )
    return found.astype(np.intp)


class _Rays:
    """Rays through the middles of n pixels, and what they hit, as of `Hit`: cosine of the angle of view, material and
    temperature [K] of the texel, transmitted share `weight` (n, K) of channels, and air or background `added` [W m⁻²
    sr⁻¹]."""

    def __init__(self, view: View, pixels: NDArray[np.intp]) -> None:
        baked, rays = view.baked, view.rays
        device, mi, self._view, self._baked = baked.device, baked.geometry.mi, view, baked
        order = rays.position[pixels[:, 0] * rays.width + pixels[:, 1]]
        slope = rays.slopes(0.5, 0.5, mi.UInt32(aligned(order, np.uint32)))
        layers, medium = device.layers(view.pose, view.states), device.medium(view.pose, view.states)
        channels = baked.plan.spectrum.channels

        def read(at: LayerHit) -> list[Jit]:
            geometry, hit, texels = at.layer.geometry, at.hit, device.texels[at.number]
            texel = geometry.nearest(hit.surface, *at.place, hit.valid)
            normal = mi.Vector3f(*geometry.normals.at(hit.face, hit.valid))
            _, normal = mirrors.transformed(at.layer.view, layers[0].view, None, normal)
            kind = mi.UInt32(dr.gather(mi.UInt8, texels.material, texel, hit.valid))
            corners = geometry.corners(geometry.lattice(hit.surface, hit.valid), *at.place)
            found = [*normal, kind, *mirrors.met(at.layer, hit, at.place), *(part for pair in corners for part in pair)]
            return found + at.layer.outgoing.at(geometry, hit, at.place)

        hit, place, found = first_hit(layers, lambda layer: view_ray(mi, *layer.view, *slope), read)
        (x, y, z, kind, texel, row), corners, shown = found[:6], found[6:14], found[14:]
        distance, valid, face, surface = hit.distance, hit.valid, hit.face, hit.surface
        ray = view_ray(mi, *layers[0].view, *slope)
        slant, way = dr.dot(mi.Vector3f(x, y, z), ray.d), mi.Float(0.0)
        glint = [mi.Float(0.0) for _ in shown]
        if any(layer.outgoing.directional for layer in layers):
            at = ray.o, ray.d, distance, place, face, texel, row
            added, way = mirrors.correction(layers, mirrors.DEPTH, *at)
            shown = [a + b for a, b in zip(shown, added, strict=True)]
            if baked.plan.sun:
                sunless, _ = mirrors.correction(layers, mirrors.DEPTH, *at, glint=False)
                glint = [a - b for a, b in zip(added, sunless, strict=True)]
        lights = [[mi.Float(float(k == channel)) for k in range(channels)] for channel in range(-1, channels)]
        behind = [sum(medium.at_camera(hit, light, ray.o, ray.d)) for light in lights]
        # Of a mirror: whether its image is of what is above the horizon.
        sky = (row > 0) & (ray.d.z - 2.0 * slant * z >= 0.0) & ~(way < np.inf)
        found = [
            distance,
            valid,
            face,
            surface,
            place,
            dr.minimum(dr.abs(slant), 1.0),
            kind,
            row > 0,
            sky,
            *corners,
            *shown,
            *glint,
            *behind,
        ]
        dr.eval(found)
        # Constants have one entry.
        arrays = [np.broadcast_to(np.array(value), len(order)) for value in found]
        self.distance, self.valid, self.face, self.surface, self.layer, self.cosine, self.kind = arrays[:7]
        self._mirror, self._sky, corners = arrays[7], arrays[8], arrays[9:17]
        self._texel, self._weight = (np.stack(corners[k::2], axis=1) for k in (0, 1))
        self._shown, self._glint = (
            np.stack(arrays[first : first + channels], axis=1).astype(np.float64) for first in (17, 17 + channels)
        )
        self.added, *passed = arrays[17 + 2 * channels :]
        self.weight = np.stack([each - self.added for each in passed], axis=1).astype(np.float64)
        self.kinetic = self._kinetic(self._texel[np.arange(len(order)), self._weight.argmax(axis=1)])

    def _kinetic(self, texel: NDArray[Any]) -> Floats:
        """Temperatures of texels of the static scene, or of the objects hit [K]."""
        found = flat(self._baked.scene.surfaces, "temperature")
        moving = np.array([np.nan, *(state.temperature for state in self._view.states)])
        still = self.valid & (self.layer == 0)
        return np.where(still, found[np.where(still, texel, 0)], moving[self.layer])

    def emissivity(self, number: int) -> float:
        """Return the emissivity of the surface that a ray hits in the band, at REFERENCE_K and at its angle."""
        material, band = self._baked.scene.materials[self.kind[number]], self._baked.plan.band_um
        cosine = float(self.cosine[number]) if material.emissivity_by_angle is not None else None
        return float(material.band_emissivity(*band, REFERENCE_K, cosine))

    def leaving(self, number: int) -> Floats:
        """Return what leaves towards a ray in each channel, (4, K): emission, reflected sky, sun and surroundings."""
        baked, spectrum = self._baked, self._baked.plan.spectrum
        parts = np.zeros((4, spectrum.channels))
        if not self.valid[number]:
            return parts
        if self._mirror[number]:
            material, cosine = baked.scene.materials[self.kind[number]], float(self.cosine[number])

            def emissivity(wavelength: Floats) -> Floats:
                return material.emissivity_at_angle(wavelength, cosine)

            parts[0] = spectrum.emitted_at(emissivity, float(self.kinetic[number]), baked.plan.band_um)
            parts[2] = self._glint[number]
            parts[1 if self._sky[number] else 3] = self._shown[number] - parts[0] - parts[2]
            return parts
        if self.layer[number]:
            emits = baked.scene.materials[self.kind[number]].emissivity_at
            parts[0] = spectrum.emitted_at(emits, float(self.kinetic[number]), baked.plan.band_um)
        else:
            texel, weight = self._texel[number], self._weight[number]
            parts[0] = self._emitted(texel, weight)
            if baked.plan.bake:
                parts[1:3] = self._reflected(int(self.face[number]), texel, weight)
        parts[3] = self._shown[number] - parts[:3].sum(axis=0)
        return parts

    def _emitted(self, texel: NDArray[Any], weight: Floats) -> Floats:
        """Emission of texels of the static scene, weighted, (K,)."""
        plan, scene = self._baked.plan, self._baked.scene
        material, kelvin = (flat(scene.surfaces, name)[texel] for name in ("material", "temperature"))
        total = np.zeros(plan.spectrum.channels)
        for kind in np.unique(material):
            here = material == kind
            warm, emits = kelvin[here], scene.materials[kind].emissivity_at
            grid, table = plan.spectrum.emitted(emits, float(warm.min()), float(warm.max()), plan.band_um)
            total += [weight[here] @ np.interp(warm, grid, channel) for channel in table.T]
        return total

    def _reflected(self, face: int, texel: NDArray[Any], weight: Floats) -> Floats:
        """Sky and sun that texels and the correction of their face reflect, (2, K)."""
        baked = self._baked
        number, share = baked.samples.around(face)
        texels, weights = np.concatenate([texel, number]), np.concatenate([weight, -share])
        count, covers = baked.geometry.face_count, baked.geometry.face_of_texel
        cover = np.array(dr.gather(type(covers), covers, type(covers)(aligned(texels, np.uint32))))
        # A texel without a face has the mean light, which is taken to be split as on this face.
        light = _outside(baked, np.append(np.where(cover < count, cover, face), face))
        reflected = baked.plan.spectrum.reflected[flat(baked.scene.surfaces, "material")[texels]]
        own = np.einsum("t,tkn,stn->sk", weights, reflected, light[:, :-1])
        return own + np.einsum("t,tkn,sn->sk", share, reflected[len(texel) :], light[:, -1])


def _outside(baked: LoadedLight, faces: NDArray[np.intp]) -> Floats:
    """Light of the sky and of the sun on faces (n,) at each node, (2, n, N) [W m⁻² sr⁻¹]."""
    around, transport = baked.environment, baked.transport
    assert transport is not None
    up = transport.up[faces].sum(axis=1, dtype=np.int64) / (2.0 * transport.rays)
    sky = around.light(up, np.zeros(len(faces)), faces)
    sun = np.zeros_like(sky) if around.sun is None else around.sun.on(faces)
    return np.stack([sky, sun])
