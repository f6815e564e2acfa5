"""A baked scene on the ray-tracing device: the arrays uploaded once, and the layers of one view."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.materials.mixture import Mixture, uncertainties
from thermorender.physics.planck import band_radiance
from thermorender.render.air import AirView, SceneAir, Vacuum
from thermorender.render.arrays import Channels, Floats, Jit, Mitsuba, aligned, opaque_view
from thermorender.render.baked_light import BakedLight
from thermorender.render.dynamic import DynamicObject, ObjectState
from thermorender.render.geometry import Geometry
from thermorender.render.layers import KeptTexels, Layer, OutgoingRadiance, TexelArrays
from thermorender.render.light.shadows import SunlitFaces
from thermorender.render.object_numbers import objects_of_surfaces
from thermorender.render.pixels.crown_light import sunlit_leaves
from thermorender.render.plan import Plan
from thermorender.render.reflection.device_tables import DeviceTables, DirectionalTexels
from thermorender.render.spectrum import REFERENCE_K
from thermorender.scene.instances import Instances
from thermorender.scene.scene import Scene
from thermorender.scene.surface import Surface

_LABELS = ("material", "flags", "temperature")


class DeviceScene:
    """The arrays of a BakedLight on the device; `outgoing`, `air` and `kept` texels are reused where they are
    given."""

    def __init__(
        self, baked: BakedLight, geometry: Geometry, outgoing: OutgoingRadiance | None = None,
        air: Vacuum | SceneAir | None = None, kept: KeptTexels | None = None,
    ) -> None:  # fmt: skip
        scene, plan, mi = baked.scene, baked.plan, geometry.mi
        self.geometry, self._mi = geometry, mi
        tables = DeviceTables(mi, scene, plan) if plan.specular else None
        directional = None
        if tables and baked.mirror_black is not None:
            number = kept.mirrors if kept is not None else tables.number[flat(scene.surfaces, "material")]
            assert number is not None
            directional = DirectionalTexels(mi, tables, number, baked.mirror_black)
        leaves = None if outgoing else sunlit_leaves(scene, plan, geometry)
        self._outgoing = outgoing or OutgoingRadiance.of(geometry, baked.texels, baked.faces, directional, leaves, kept)
        self._faces, self._light = baked.faces, baked.static_light
        self._face_error = baked.face_error
        self._static_error = None if baked.face_error is None else mi.Float(aligned(baked.face_error))
        self.objects = [DynamicObject(mi, tracked, plan, scene.materials, tables) for tracked in scene.tracked_objects]
        self.air = air or _air(mi, scene, plan)
        self._scene, self._kept = scene, kept
        self._last_light: tuple[Any, Any] = None, None
        self._last_outgoing: tuple[Any, Any] = None, None

    def layers(self, pose: Floats, states: Sequence[ObjectState]) -> list[Layer]:
        """Return the Layers of a view from `pose`: the static scene and each object at its ObjectState."""
        outgoing, own, _ = self._lit(states)
        layers = [Layer(self.geometry, opaque_view(self._mi, pose), outgoing)]
        for item, state, radiance in zip(self.objects, states, own, strict=True):
            layers.append(Layer(item.geometry, opaque_view(self._mi, np.linalg.inv(state.pose) @ pose), radiance))
        return layers

    @property
    def static_outgoing(self) -> OutgoingRadiance:
        """The OutgoingRadiance of the static scene without the light of its moving objects."""
        return self._outgoing

    @cached_property
    def _sunlit(self) -> SunlitFaces | None:
        """The faces that moving objects may shade; None without the sun."""
        sun = None if self._light is None else self._light.sun
        return None if sun is None else SunlitFaces(self.geometry, sun)

    def shaded(self, states: Sequence[ObjectState]) -> Floats:
        """Return the part of `Sunlight.lit` that moving objects take from each face of the static scene, (F,)."""
        found = np.zeros(self.geometry.face_count)
        for item, state in zip(self.objects, states, strict=True):
            if self._sunlit is not None:
                face, taken = item.shadow((state.lit or state).pose, self._sunlit)
                found[face] += taken
        return found

    @cached_property
    def copies_error(self) -> float:
        """Root mean square error of the light on copies of bodies [W m⁻² sr⁻¹]; 0 without copies."""
        surfaces = self.geometry.surfaces
        copies = [isinstance(each.instances, Instances) for each in surfaces]
        if self._face_error is None or not any(copies):
            return 0.0
        of = np.repeat(copies, [len(each.faces) for each in surfaces])
        return float(np.sqrt(np.average(self._face_error[of], weights=self.geometry.area[of])))

    @cached_property
    def texels(self) -> list[TexelArrays]:
        """The TexelArrays of each layer, in the order of `layers`."""
        mi, numbers = self._mi, objects_of_surfaces(self._scene)
        small, found, first = dr.uint8_array_t(mi.Float), [], 0
        for place, surfaces in enumerate([self._scene.surfaces, *(each.surfaces for each in self.objects)]):
            known = self._kept if place == 0 else None
            arrays = (flat(surfaces, name) if known is None else getattr(known, name) for name in _LABELS)
            material, flags, temperature = arrays
            kelvin = mi.Float(aligned(temperature)) if place == 0 else None
            material, flags = (small(aligned(each, np.uint8)) for each in (material, flags))
            own = numbers[first : first + len(surfaces)]
            found.append(TexelArrays(material, flags, kelvin, mi.UInt32(aligned(own, np.uint32))))
            first += len(surfaces)
        return found

    @cached_property
    def emissivities(self) -> list[Jit]:
        """Band emissivity of each material at REFERENCE_K, Float, and of uncertain ones its standard deviations of one
        texel and, by a map, of a mean over many."""
        materials, at = self._scene.materials, (*self._scene.camera.band_um, REFERENCE_K)
        tables: list[Any] = [[each.band_emissivity(*at) for each in materials]]
        if any(isinstance(each, Mixture) for each in materials):
            tables.append([each.band_emissivity_std(*at) for each in materials])
        if any(isinstance(each, Mixture) and each.doubt for each in materials):
            tables[1:] = map(list, zip(*(uncertainties(each, *at) for each in materials), strict=True))
        return [self._mi.Float(aligned(table)) for table in tables]

    def alone(self, name: str, states: Sequence[ObjectState]) -> tuple[Geometry, Floats]:
        """Return (Geometry of one object without the others, pose of its frame in the scene's)."""
        for item, state in zip(self.objects, states, strict=True):
            if state.name == name:
                return item.geometry, state.pose
        return self.geometry.of_object(name, self._scene.terrain_count), np.eye(4)

    def face_errors(self, states: Sequence[ObjectState]) -> list[Jit]:
        """Return the squared error of the light on the faces of each layer, [Float or None] [W² m⁻⁴ sr⁻²]; None without
        light."""
        if self._face_error is None:
            return [None] * (1 + len(self.objects))
        *_, errors = self._lit(states)
        if not errors:
            return [self._static_error]
        whole = self._face_error.copy()
        for faces, _, square in errors:
            whole[faces] += square
        return [self._mi.Float(aligned(whole)), *(self._mi.Float(aligned(own)) for _, own, _ in errors)]

    def medium(self, pose: Floats, states: Sequence[ObjectState], through_air: bool = True) -> Vacuum | AirView:
        """Return the medium of a camera at `pose`; without `through_air` only the background is seen through the
        air."""
        if isinstance(self.air, Vacuum):
            return self.air
        moved = [item.box(state.pose) for item, state in zip(self.objects, states, strict=True)]
        boxes = np.stack([self.geometry.box, *moved])
        box = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        low_m = min(self.geometry.low_m, *(float(each[0, 2]) for each in moved), np.inf)
        return self.air.view(pose[:3, 3], box, low_m, clear=not through_air)

    def _lit(
        self, states: Sequence[ObjectState]
    ) -> tuple[OutgoingRadiance, list[OutgoingRadiance], list[tuple[NDArray[np.int64], Floats, Floats]]]:
        """(OutgoingRadiance of the static scene, [of each object], [(faces, squared error of the object, of these
        faces)])."""
        if not self.objects:
            return self._outgoing, [], []
        lit = [each.lit or each for each in states]
        key, last = tuple(each.key for each in lit), self._last_light
        if last[0] != key:
            static = self.geometry, self._light, self._sunlit
            found = [item.light(state, *static) for item, state in zip(self.objects, lit, strict=True)]
            outgoing = self._outgoing
            if self._light is not None and self._faces is not None:
                light = self._faces.copy()
                for _, (faces, added), _ in found:
                    light[faces] += added
                outgoing = replace(outgoing, faces=Channels(self._mi, light))
            errors = [(faces, *error) for _, (faces, _), error in found]
            last = self._last_light = key, (outgoing, [own for own, *_ in found], errors)
        outgoing, light, errors = last[1]
        shown, last = (key, tuple(each.temperature for each in states)), self._last_outgoing
        if last[0] != shown:
            each = zip(self.objects, states, light, strict=True)
            last = self._last_outgoing = shown, [item.outgoing(one.temperature, own) for item, one, own in each]
        return outgoing, last[1], errors


def _air(mi: Mitsuba, scene: Scene, plan: Plan) -> Vacuum | SceneAir:
    """The medium of a scene."""
    if scene.air is not None:
        return SceneAir(mi, scene, plan.spectrum)
    outside = np.array([scene.spec.sky_temperature, scene.surroundings_temperature])
    return Vacuum(mi, *band_radiance(outside, *plan.band_um)[:, None])


def flat(surfaces: Sequence[Surface], name: str) -> NDArray[Any]:
    """Return an attribute of all texels of surfaces, (T,); the array of a single surface is not copied."""
    images = [getattr(surface, name) for surface in surfaces]
    return images[0].reshape(-1) if len(images) == 1 else np.concatenate([image.ravel() for image in images])
