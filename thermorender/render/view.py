"""One view of a baked scene: its radiance, ground truth and error budget."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.render import labels, truth
from thermorender.render.arrays import Floats
from thermorender.render.baked import BakedScene
from thermorender.render.dynamic import ObjectState
from thermorender.render.geometry import Geometry
from thermorender.render.pixels import budget, slender
from thermorender.render.pixels.sampling import CameraRays
from thermorender.render.pixels.tracer import SampledImage, Tracer
from thermorender.scene.scene import Scene


@dataclass(frozen=True)
class View:
    """A baked scene seen from one pose at one time."""

    baked: BakedScene
    rays: CameraRays
    pose: Floats  # (4, 4) world_from_camera
    states: tuple[ObjectState, ...]  # of the dynamic objects
    to_scene: Floats | None = None  # (4, 4) from the frame of the pose to the scene's, where that is another

    def tracer(self, through_air: bool = True) -> Tracer:
        """Return the Tracer of this view."""
        device = self.baked.device
        medium = device.medium(self.pose, self.states, through_air)
        layers = device.layers(self.pose, self.states)
        shapes = [item.geometry for item in device.objects]
        parts = parts_of(self.baked.scene, self.baked.geometry, shapes, self.states)
        thin = partial(slender.rectangles, parts, self.pose, self.rays.camera)
        return Tracer(layers, self.rays, medium, self.baked.plan, thin, self.pose)

    def radiance(
        self, through_air: bool = True, like: SampledImage | None = None
    ) -> tuple[NDArray[np.float32], SampledImage]:
        """Return (band radiance (H, W) float32 [W m⁻² sr⁻¹], SampledImage); `like` as of `Tracer.image`."""
        plan = self.baked.plan
        limit = plan.sampling.edge_mk * plan.radiance_per_mk
        image, sampling = self.tracer(through_air).image(limit, like, self.baked.device.copies_error)
        return image[0], sampling

    def sees_as(self, other: "View") -> bool:
        """Return whether another view casts the same rays at the same surfaces."""
        here, there = ([view.pose, *(each.pose for each in view.states)] for view in (self, other))
        same = np.array_equal(here, there) and self.rays.camera == other.rays.camera
        one, two = self.baked, other.baked
        return same and one.geometry is two.geometry and one.plan.sampling.samples == two.plan.sampling.samples

    def some(self, only: NDArray[np.bool_], through_air: bool = True) -> NDArray[np.float32]:
        """Return the band radiance of some pixels (H, W), from few rays each; 0 elsewhere."""
        image, pixels = np.zeros(only.shape, np.float32), np.flatnonzero(only)
        if pixels.size:
            image.flat[pixels] = self.tracer(through_air).few(pixels)[0]
        return image

    def truth(self, sampling: SampledImage | None) -> dict[str, NDArray[Any]]:
        """Return the ground truth, as `Frame.truth` without the sensor's flags, from the rays of a SampledImage
        rendered last."""
        last = self.rays.last_hits
        middles = last[1] if last and sampling and last[0] is sampling.hit else None
        found = truth.truth(self.baked, self.rays, self.pose, self.states, middles)
        if self.to_scene is not None:
            position = found["position"]
            moved = position.astype(np.float64) @ self.to_scene[:3, :3].T + self.to_scene[:3, 3]
            found["position"] = moved.astype(position.dtype)
        return found

    @property
    def scene_pose(self) -> Floats:
        """The pose in the scene's frame, (4, 4)."""
        return self.pose if self.to_scene is None else self.to_scene @ self.pose

    def targets(self) -> dict[str, dict[str, Any]]:
        """Return the positions of objects, as `Frame.targets`."""
        return truth.targets(self.baked, self.rays.camera, self.pose, self.states)

    def labels(self, seen: NDArray[np.uint32]) -> dict[str, dict[str, Any]]:
        """Return the extents of objects, as `Frame.labels`; `seen` is the truth's image of objects."""
        return labels.labels(self.baked, self.rays, self.pose, self.states, seen)

    def budget_mk(self, radiance: NDArray[np.float32], sampling: SampledImage | None) -> dict[str, float] | None:
        """Return the error budget of a radiance image, as `Frame.budget_mk`; None without its SampledImage."""
        if sampling is None:
            return None
        return budget.budget_mk(self.baked, self.tracer(), self.pose, self.states, radiance, sampling)

    def error_mk(self, radiance: NDArray[np.float32], sampling: SampledImage | None) -> NDArray[np.float32] | None:
        """Return the estimated error of each pixel, as `Frame.error_mk`; None without its SampledImage."""
        if sampling is None:
            return None
        return budget.error_mk(self.baked, self.tracer(), self.pose, self.states, radiance, sampling)


def parts_of(
    scene: Scene, geometry: Geometry, moving: Sequence[Geometry], placed: Sequence[ObjectState]
) -> list[tuple[Floats, Floats]]:
    """Return the boxes that may be thinner than a pixel, as `slender.rectangles` takes them; raster terrain is left
    out."""
    first = scene.terrain_count if scene.spec.terrain.mesh is None else 0
    return [(geometry.boxes(first), np.eye(4)), *((g.boxes(), p.pose) for g, p in zip(moving, placed, strict=True))]
