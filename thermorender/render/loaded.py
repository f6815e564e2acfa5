"""Baked light in a process: its geometry, its arrays on the device, and the caches of its edits."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.render.baked_light import BakedLight
from thermorender.render.device import DeviceScene
from thermorender.render.edits.prior import LeftOut, PriorLight, Samples
from thermorender.render.geometry import Geometry
from thermorender.render.layers import KeptTexels
from thermorender.render.light.environment import Environment, of_scene
from thermorender.render.light.solved import Kept
from thermorender.render.light.walks import Walks
from thermorender.render.variant import activate


@dataclass(eq=False)
class Loaded:
    """Caches of a BakedLight in a process; an entry that is None is computed at first use."""

    geometry: Geometry | None = None
    kept: KeptTexels | None = None  # texels that are in memory already; then `texels` are empty
    device: DeviceScene | None = None
    environment: Environment | None = None
    walks: Walks | None = None
    samples: Samples | None = None
    prior: PriorLight | None = None
    prior_later: Callable[[], PriorLight] | None = None  # makes `prior` of a preview
    # (largest reflectance of a point of each face (F,), faces that reflect most of what they receive)
    strongest: tuple[NDArray[np.float32], NDArray[np.intp]] | None = None
    solution: Kept | None = None  # what the next solution begins from; None in a preview
    solved: "LoadedLight | None" = None  # the solution that a preview was made of; None in a solution
    left_out: LeftOut | None = None  # light that a preview leaves out


@dataclass(frozen=True, eq=False)
class LoadedLight(BakedLight):
    """A BakedLight with its caches of this process, which are not pickled."""

    loaded: Loaded = field(default_factory=Loaded, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in fields(self)} | {"loaded": Loaded()}

    @property
    def geometry(self) -> Geometry:
        """The Geometry of the scene's surfaces on the device."""
        if self.loaded.geometry is None:
            self.loaded.geometry = Geometry(activate(), self.scene.surfaces)
        return self.loaded.geometry

    @property
    def device(self) -> DeviceScene:
        """The DeviceScene, uploaded on first use."""
        if self.loaded.device is None:
            self.loaded.device = DeviceScene(self, self.geometry, kept=self.loaded.kept)
        return self.loaded.device

    @property
    def solved(self) -> "LoadedLight":
        """The solution that a preview was made of; a solution itself."""
        return self.loaded.solved or self

    @property
    def environment(self) -> Environment:
        """The light from beyond the surfaces; a preview has that of its solution."""
        own = self.solved
        if own.loaded.environment is None:
            assert own.transport is not None
            own.loaded.environment = of_scene(own.scene, own.plan, own.geometry, own.transport.touching)
        return own.loaded.environment

    @property
    def walks(self) -> Walks:
        """Random walks in this scene, to check its light."""
        if self.loaded.walks is None:
            texels = self.device.texels[0]
            self.loaded.walks = Walks(self.scene.materials, self.plan, self.geometry, self.environment, texels)
        return self.loaded.walks

    @property
    def samples(self) -> Samples:
        """The points that represent the faces, and the rays between these."""
        if self.loaded.samples is None:
            assert self.transport is not None
            self.loaded.samples = Samples(self.geometry, self.transport)
        return self.loaded.samples

    @property
    def prior(self) -> PriorLight:
        """Texels and light on the device, from which an edit begins."""
        if self.loaded.prior is None:
            later, self.loaded.prior_later = self.loaded.prior_later, None
            self.loaded.prior = later() if later else PriorLight.of(self, self.samples)
        return self.loaded.prior
