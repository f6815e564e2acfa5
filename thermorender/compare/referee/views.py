"""A pose as it is judged: its photograph, and what is really there."""

from dataclasses import dataclass

import numpy as np

from thermorender.frame import apparent_temperature
from thermorender.output.photograph import photograph
from thermorender.scene.surface import FALLBACK, FILLED, SURFACE


@dataclass(frozen=True, eq=False)
class View:
    """A pose of a scene.

    Attributes
    ----------
    index : int
    time_s : float
    pose : (4, 4) float64
        world_from_camera.
    visible : (H, W, 3) uint8
        Photograph registered to the thermal camera.
    texel_m : float or None
        Ground sampling distance [m], a median; None where no ground is seen.
    known : (H, W) bool
        Where methods are judged: something of the scene, in a known colour and at a known temperature.
    object : (H, W) int
        Number of the object that is seen, −1 for ground and sky.
    material : (H, W) uint8
        Number in `material_names`, 255 for none.
    material_names : tuple of str
    kinetic : (H, W) float32
        Temperature of the surface [K].
    depth : (H, W) float32
        Along the optical axis [m], infinite where nothing is.
    position : (H, W, 3) float32
        [m]
    truth_radiance : (H, W) float32 or None
        Of the reference [W m⁻² sr⁻¹]; None where the scene's temperatures are not known.
    truth : (H, W) float32 or None
        Its apparent temperature [K].
    """

    index: int
    time_s: float
    pose: np.ndarray
    visible: np.ndarray
    texel_m: float | None
    known: np.ndarray
    object: np.ndarray
    material: np.ndarray
    material_names: tuple
    kinetic: np.ndarray
    depth: np.ndarray
    position: np.ndarray
    truth_radiance: np.ndarray | None
    truth: np.ndarray | None


def view_of(renderer, pose, time_s, index, has_truth):
    """Return the View of a pose; with `has_truth` the renderer's temperatures are the true ones."""
    frame = renderer.frame(pose, time_s, index)
    visible, covered = photograph(renderer, pose, time_s)
    images, camera = frame.truth, renderer.scene.camera
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


def evenly(count, most):
    """Return up to `most` different numbers of 0…count − 1, evenly spaced, the first and the last among them."""
    return list(dict.fromkeys(np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()))
