"""The data of a pose for its comparison: its photograph and the truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.frame import apparent_temperature
from thermorender.output.photograph import photograph
from thermorender.render.renderer import Renderer
from thermorender.scene.surface import FALLBACK, FILLED, SURFACE


@dataclass(frozen=True, eq=False)
class View:
    """A pose of a scene."""

    index: int
    time_s: float
    pose: NDArray[np.float64]  # (4, 4) float64 world_from_camera
    visible: NDArray[np.uint8]  # (H, W, 3) uint8 photograph registered to the thermal camera
    texel_m: float | None  # Median ground sampling distance [m]; None where no ground is visible
    known: NDArray[np.bool_]  # (H, W) bool pixels that are scored: surfaces of known colour and temperature
    object: NDArray[np.integer]  # (H, W) int number of the visible object, −1 for ground and sky
    material: NDArray[np.uint8]  # (H, W) uint8 number in `material_names`, 255 for none
    material_names: tuple[str, ...]
    kinetic: NDArray[np.float32]  # (H, W) float32 kinetic temperature of the surface [K]
    depth: NDArray[np.float32]  # (H, W) float32 depth along the optical axis [m], infinite without a surface
    position: NDArray[np.float32]  # (H, W, 3) float32 position of the surface in the world [m]
    # (H, W) float32 band radiance of the reference [W m⁻² sr⁻¹]; None if the scene's temperatures are unknown
    truth_radiance: NDArray[np.float32] | None
    truth: NDArray[np.float32] | None  # (H, W) float32 its apparent temperature [K]


def view_of(renderer: Renderer, pose: ArrayLike, time_s: float, index: int, has_truth: bool) -> View:
    """Return the View of a pose; `has_truth` says whether the renderer's temperatures are the true ones."""
    frame = renderer.frame(pose, time_s, index)
    visible, covered = photograph(renderer, frame.pose, time_s)
    images: dict[str, Any] = frame.truth
    camera = renderer.scene.camera
    flags = images["mask"]
    known = covered & ((flags & SURFACE) > 0) & ((flags & FILLED) == 0)
    if has_truth:
        known &= (flags & FALLBACK) == 0
    near = images["depth"][known]
    texel_m = float(np.median(near) / camera.focal_length_px) if near.size else None
    radiance = frame.radiance if has_truth else None
    return View(
        index, float(time_s), frame.pose, visible, texel_m, known, renderer.objects_seen(pose, time_s)[0],
        images["material"], tuple(each.name for each in renderer.scene.materials), images["kinetic_temperature"],
        images["depth"], images["position"], radiance,
        None if radiance is None else apparent_temperature(radiance, camera.band_um),
    )  # fmt: skip


def evenly(count: int, most: int) -> list[int]:
    """Return up to `most` different numbers of 0…count − 1, evenly spaced, with the first and the last."""
    numbers: list[int] = np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()
    return list(dict.fromkeys(numbers))
