"""What a view consists of: layers of geometry with the radiance that leaves their surfaces."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.render.arrays import Channels, Jit
from thermorender.render.geometry import Geometry, Hit
from thermorender.render.pixels.crown_light import SunlitLeaves
from thermorender.render.reflection.device_tables import DirectionalTexels
from thermorender.scene.crowns import PATCHES


@dataclass(frozen=True)
class KeptTexels:
    """Texels of the static scene with their means over squares, by the numbers of a Geometry with slots."""

    first: Channels  # The first spectral channel
    rest: Channels | None  # The others; coarse
    material: NDArray[np.uint8]  # (T,)
    flags: NDArray[np.uint8]  # (T,)
    temperature: NDArray[np.float32]  # (T,) [K]
    lease: object  # Keeps the texels as long as it lives
    faces: Channels | None = None  # Corrections of the faces
    colours: Channels | None = None  # Linear colours, and 1 where they are known; None until they are asked for
    mirrors: NDArray[np.uint8] | None = None  # (T,) numbers of the directional texels' tables; None without any


@dataclass(frozen=True)
class OutgoingRadiance:
    """Radiance that leaves surfaces towards a camera: channels of texels and corrections of faces."""

    # From `Geometry.averaged`, read at every tap: all channels, or the first spectral one, which carries nearly all.
    texels: Channels
    rest: Channels | None = None  # the other spectral channels, about a hundredth of the first, read once per ray
    faces: Channels | None = None  # corrections added to all channels of the texels
    directional: DirectionalTexels | None = None  # data of the directional texels
    leaves: SunlitLeaves | None = None  # of crowns that the sun warms
    _patches: list[list[Jit]] = field(default_factory=list, init=False)  # what `patches` returns, once known

    @classmethod
    def of(
        cls, geometry: Geometry, texels: Sequence[NDArray[np.float32]], faces: ArrayLike | None = None,
        directional: DirectionalTexels | None = None, leaves: SunlitLeaves | None = None,
        kept: KeptTexels | None = None,
    ) -> "OutgoingRadiance":  # fmt: skip
        """Return the radiance of spectral channels of texels, K arrays (T,) or `kept`, and of faces, (F, K)."""
        if kept is not None:
            return cls(kept.first, kept.rest, kept.faces, directional, leaves)
        own = None if faces is None else Channels(geometry.mi, faces)
        rest = geometry.averaged(np.stack(texels[1:], axis=1)) if len(texels) > 1 else None
        return cls(geometry.averaged(texels[0][:, None]), rest, own, directional, leaves)

    @property
    def channels(self) -> int:
        """Number of all channels."""
        return self.texels.count + (self.rest.count if self.rest else 0)

    def patches(self, geometry: Geometry) -> list[Jit]:
        """Return the radiance of the patches of all crowns in each channel, [Float (PATCHES n,)]."""
        crowns, mi = geometry.crowns, geometry.mi
        if not self._patches and crowns is not None:
            index = dr.arange(mi.UInt32, PATCHES * crowns.count)
            crown, patch = index // PATCHES, index % PATCHES
            first = crowns.first_texel, crowns.first_face
            texel, face = (dr.gather(mi.UInt32, each, crown) + patch for each in first)
            found = self.at_texel(geometry, texel, face, True)
            dr.eval(found)
            self._patches.append(found)
        return self._patches[0]

    def at_texel(self, geometry: Geometry, texel: Jit, face: Jit, active: Jit) -> list[Jit]:
        """Return all channels of texels seen on faces, as a list of Float; 0 where inactive."""
        parts = (part for part in (self.texels, self.rest) if part)
        values = [part.at(geometry.coarse_square(texel, active) if part.coarse else texel, active) for part in parts]
        return self._on(face, sum(values, list[Jit]()), active)

    def at(self, geometry: Geometry, hit: Hit, position: tuple[Jit, Jit]) -> list[Jit]:
        """Return all channels at positions (column, row) of a Hit, bilinear, as a list of Float."""
        values = list[Jit]()
        for part in (self.texels, self.rest):
            if part:
                level = geometry.finest(hit.surface, hit.valid) if part.coarse else None
                scale = 1.0 if level is None else 1.0 / geometry.mi.Float(1 << level)
                column, row = (scale * each for each in position)
                lattice = geometry.lattice(hit.surface, hit.valid, level)
                values += geometry.bilinear(part, lattice, column, row, hit.valid)
        return self._on(hit.face, values, hit.valid)

    def _on(self, face: Jit, values: list[Jit], active: Jit) -> list[Jit]:
        added = self.faces.at(face, active) if self.faces else [0.0] * len(values)
        return [a + b for a, b in zip(values, added, strict=True)]


@dataclass(frozen=True)
class CasterView:
    """A ray caster, and the view (rotation, origin) in its frame."""

    geometry: Geometry
    view: tuple[list[Jit], Jit]


@dataclass(frozen=True)
class Layer(CasterView):
    """A CasterView with the radiance that leaves its surfaces."""

    outgoing: OutgoingRadiance


@dataclass(frozen=True)
class LayerHit:
    """Where rays meet one layer: Dr.Jit arrays, one entry per ray."""

    number: int  # of the layer
    layer: Any  # CasterView or Layer, as `first_hit` got it
    ray: Jit  # in the layer's frame
    hit: Hit
    record: tuple[Jit, ...]  # of the face hit, as of `Geometry.record`
    place: tuple[Jit, Jit]  # (column, row) on the texel map


def first_hit(
    layers: Sequence[CasterView], rays: Callable[[CasterView], Jit], read: Callable[[LayerHit], list[Jit]],
    cast: Callable[[Geometry, Jit], Hit] = Geometry.seen, known: Hit | None = None,
) -> tuple[Hit, Jit, list[Jit]]:  # fmt: skip
    """Return (nearest Hit over all layers, number of its layer, values read there). `rays` returns the rays in a
    layer's frame, `read` the values of hits. `known` is this Hit if already cast."""
    best: list[Jit] = []
    surfaces = 0
    for number, layer in enumerate(layers):
        geometry, ray, hit = layer.geometry, rays(layer), known
        if hit is None:
            hit = cast(geometry, ray)
        elif len(layers) > 1:
            # Below 0 the number wraps to a large one.
            own_surface = hit.surface - dr.opaque(geometry.mi.UInt32, surfaces)
            on_layer = hit.valid & (own_surface < dr.opaque(geometry.mi.UInt32, len(geometry.surfaces)))
            hit = Hit(on_layer, hit.distance, hit.face, own_surface)
        record = geometry.record(hit.face, hit.valid)
        place = geometry.map_position(record, ray.o + hit.distance * ray.d)
        own = [hit.distance, hit.valid, hit.face, hit.surface + surfaces, geometry.mi.UInt32(number)]
        own += read(LayerHit(number, layer, ray, hit, record, place))
        nearer = best and (hit.distance < best[0] if known is None else hit.valid)
        best = [dr.select(nearer, a, b) for a, b in zip(own, best, strict=True)] if best else own
        surfaces += len(geometry.surfaces)
    distance, valid, face, surface, layer_number, *values = best
    return Hit(valid, distance, face, surface), layer_number, values


@dataclass(frozen=True)
class TexelArrays:
    """What the texels of a layer are, for the truth."""

    material: Jit  # (T,) UInt8
    flags: Jit  # (T,) UInt8, flags of `thermorender.scene.surface`
    temperature: Jit  # (T,) Float [K]; None for a dynamic object, whose ObjectState has it
    objects: Jit  # UInt32, number of the object that each surface belongs to, as `labels.objects_of_surfaces`
