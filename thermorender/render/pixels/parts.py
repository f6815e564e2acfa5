"""Where the radiance of single pixels comes from: emission, reflected sky, sun and surroundings, and the air.

A pixel is represented by the ray through its middle. The texels and the face that it hits hold the sum of emission and
reflected light (`thermorender.render.light.texels`). What is not emission is divided as the light on the face is, which
no blending with other faces' texels makes negative. A mirror image is split by what its second ray hits.
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
        {part: band radiance [W m⁻² sr⁻¹]}, from 0 on; the sum is that of the ray through the pixel's middle.
        "emission", and reflected light of "sky", "sun" and "surroundings", as they arrive through the air; "air", which
        the path adds; "background", sky or ground beyond the terrain that the pixel shows itself. Light that other
        surfaces pass on, whatever its origin, is "surroundings", as is all light on objects with a track. Reflected
        light has the shares of the light on the face, in a preview those of its solution.
    kelvin : dict
        {part: by how much the apparent temperature would fall without it [K]}, from 0 on.
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
        radiance = dict(zip(PARTS[:4], rays.leaving(number).tolist(), strict=True))
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
            kelvin=dict(zip(radiance, np.maximum(apparent - rest, 0.0).tolist(), strict=True)),
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
        texel, self._weight = (np.stack(corners[k::2], axis=1) for k in (0, 1))
        self._shown, self._glint = (
            np.stack(arrays[first : first + channels], axis=1).astype(np.float64) for first in (17, 17 + channels)
        )
        self.added, *passed = arrays[17 + 2 * channels :]
        self.weight = np.stack([each - self.added for each in passed], axis=1).astype(np.float64)
        self._read(texel)

    def _read(self, texel: NDArray[Any]) -> None:
        """Take note of temperatures [K], and on static surfaces of the texels (n, 4) and of the light on the faces."""
        baked, still = self._baked, self.valid & (self.layer == 0)
        texel, face = np.where(still[:, None], texel, 0), np.where(still, self.face, 0)
        self._kinds, self._warm = (flat(baked.scene.surfaces, name)[texel] for name in ("material", "temperature"))
        nearest = self._warm[np.arange(len(texel)), self._weight.argmax(axis=1)]
        moving = np.array([np.nan, *(state.temperature for state in self._view.states)])
        self.kinetic = np.where(still, nearest, moving[self.layer])
        self._light = _light_on(baked, face) if baked.plan.bake else None
        # What moving objects change: the sun on the faces (n,), and all that the faces reflect (n, K).
        self._shade, self._added = np.zeros(len(face)), np.zeros((len(face), baked.plan.spectrum.channels))
        if self._view.states and baked.faces is not None:
            outgoing, mi = baked.device.layers(self._view.pose, self._view.states)[0].outgoing, baked.geometry.mi
            assert outgoing.faces is not None
            now = np.stack([np.array(each) for each in outgoing.faces.at(mi.UInt32(aligned(face, np.uint32)))], axis=1)
            self._shade, self._added = baked.device.shaded(self._view.states)[face], now - baked.faces[face]

    def emissivity(self, number: int) -> float:
        """Return the emissivity of the surface that a ray hits in the band, at REFERENCE_K and at its angle."""
        material, band = self._baked.scene.materials[self.kind[number]], self._baked.plan.band_um
        cosine = float(self.cosine[number]) if material.emissivity_by_angle is not None else None
        return float(material.band_emissivity(*band, REFERENCE_K, cosine))

    def leaving(self, number: int) -> Floats:
        """Return what reaches the camera of light that leaves towards a ray, (4,) [W m⁻² sr⁻¹]: emission, reflected
        sky, sun and surroundings."""
        if not self.valid[number]:
            return np.zeros(4)
        baked, weight, lights = self._baked, self.weight[number], np.zeros(3)
        plan, total = baked.plan, float(self._shown[number] @ weight)
        material, kelvin = baked.scene.materials[self.kind[number]], float(self.kinetic[number])
        if self._mirror[number]:
            cosine = float(self.cosine[number])

            def emissivity(wavelength: Floats) -> Floats:
                return material.emissivity_at_angle(wavelength, cosine)

            emitted = plan.spectrum.emitted_at(emissivity, kelvin, plan.band_um) @ weight
            lights[1] = self._glint[number] @ weight
            lights[0 if self._sky[number] else 2] = total - emitted - lights[1]
        elif self.layer[number]:
            emitted = plan.spectrum.emitted_at(material.emissivity_at, kelvin, plan.band_um) @ weight
        else:
            emitted = self._emitted(number) @ weight
            if self._light is not None:
                reflects = np.tensordot(self._weight[number], plan.spectrum.reflected[self._kinds[number]], 1)
                lights = self._moved(number, self._light[:, number] @ (weight @ reflects))
        reflected, lights = max(total - float(emitted), 0.0), np.maximum(lights, 0.0)
        shares = lights / lights.sum() if lights.any() else np.array([0.0, 0.0, 1.0])
        return np.array([total - reflected, *(reflected * shares)])

    def _moved(self, number: int, lights: Floats) -> Floats:
        """Reflected sky, sun and surroundings (3,) with what moving objects send and hide, which is the sun's by its
        shadow; other light that they hide is sky and surroundings alike."""
        sky, sun, surroundings = lights
        around, added = self._baked.environment.sun, float(self._added[number] @ self.weight[number])
        lit = 0.0 if around is None else float(around.lit[self.face[number]])
        taken = sun * min(self._shade[number] / lit, 1.0) if lit > 0.0 else 0.0
        added += taken
        kept = max(1.0 + min(added, 0.0) / max(sky + surroundings, 1e-300), 0.0)
        return np.array([kept * sky, sun - taken, kept * surroundings + max(added, 0.0)])

    def _emitted(self, number: int) -> Floats:
        """Emission of the texels of the static scene that a ray reads, (K,)."""
        plan, materials = self._baked.plan, self._baked.scene.materials
        kinds, warm, weight = self._kinds[number], self._warm[number], self._weight[number]
        total = np.zeros(plan.spectrum.channels)
        for kind in np.unique(kinds):
            here = kinds == kind
            limits = float(warm[here].min()), float(warm[here].max())
            grid, table = plan.spectrum.emitted(materials[kind].emissivity_at, *limits, plan.band_um)
            total += [weight[here] @ np.interp(warm[here], grid, channel) for channel in table.T]
        return total


def _light_on(baked: LoadedLight, faces: NDArray[np.integer]) -> Floats:
    """Light of the sky, the sun and the surroundings on faces (n,) at each node, (3, n, N) [W m⁻² sr⁻¹]."""
    around, transport, incident = baked.environment, baked.transport, baked.solved.incident
    assert transport is not None and incident is not None
    up = transport.up[faces].sum(axis=1, dtype=np.int64) / (2.0 * transport.rays)
    sky = around.light(up, np.zeros(len(faces)), faces)
    sun = np.zeros_like(sky) if around.sun is None else around.sun.on(faces)
    return np.stack([sky, sun, np.maximum(incident[faces] - sky - sun, 0.0)])
