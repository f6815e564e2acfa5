"""Run time of a frame, run time of its ray casting alone, and the frame's sampling error in mK.

The measurements alternate (rays, frame, frame with sensor, rays, …), so other load slows all alike. Ratios are medians
of the ratios of each turn. The reference of the sampling error has 256 rays per pixel, with and without the optics.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import defaults
from thermorender.apps.compare.machine import forget_peak_memory, machine, peak_memory_mib
from thermorender.apps.compare.sampling_error import cache_off, converged, optics_sigma_px, rms_mk
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress
from thermorender.render.quality import QUALITIES
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.scene.scene import Scene
from thermorender.trajectory import path
from thermorender.versions import versions

Settings = Sequence[tuple[str, dict[str, Any]]]
SETTINGS: Settings = tuple((name, {"quality": name}) for name in QUALITIES)
HEIGHT_M = 120.0
# Camera pitch [deg] of each view; every view looks at the middle of the scene.
VIEWS = {"nadir": -90.0, "oblique": -45.0}
HEADER = ("scene", "view", "setting", "rays per pixel", "rays only [ms]", "frame [ms]", "÷ rays", "with sensor [ms]",
          "÷ rays", "frames/s", "error [mK]", "after optics [mK]")  # fmt: skip


def bench(
    scene_names: Sequence[str | Scene] = (defaults.SCENE,),
    repeats: int = 15,
    progress: Progress | None = None,
    settings: Settings = SETTINGS,
    device: str = "auto",
    air: tuple[str, ...] | None = None,
) -> dict[str, Any]:
    """Return the cost and the error of a frame for each scene, view and setting, as plain numbers.

    `settings` are keywords of Renderer by their name in the result; `air` (standard atmosphere, and aerosol) replaces
    the scenes' own; `repeats` is the number of turns.

    The result holds machine, versions, repeats, and scenes: {name: {triangles, texels, pixels, optics_sigma_px,
    build_s, bake_s, peak_mib, settings: {label: {plan, views: {view: {rays_per_pixel, rays_ms, radiance_ms, frame_ms,
    radiance_over_rays, frame_over_rays, frames_per_s, error_mk, optics_error_mk}}}}}}. Times are medians; ratios are
    (25, 50, 75) percentiles. peak_mib is the process's peak memory up to then, None where unknown (not on Linux).
    """
    if repeats < 1:
        raise ThermorenderError(f"repeats={repeats} is not allowed; give 1 or more")
    jobs = [name if isinstance(name, Scene) else load_scene(name) for name in scene_names]
    jobs = [scene.with_air(*air) for scene in jobs] if air else jobs
    if not jobs:
        raise ThermorenderError("there is no scene to measure; give a scene folder or the name of a shipped scene")
    report = progress or (lambda step, share: None)
    measured = {}
    for number, scene in enumerate(jobs):
        report(scene.name, number / len(jobs))
        measured[scene.name] = _measure(scene, settings, device, repeats)
    report("measured", 1.0)
    return {"machine": machine(), "versions": versions(), "repeats": repeats, "scenes": measured}


def rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return a result of `bench` as table rows of text under `HEADER`."""
    return [
        (
            name, view, label, f"{seen['rays_per_pixel']:.2f}", f"{seen['rays_ms']:.1f}", f"{seen['radiance_ms']:.1f}",
            f"{seen['radiance_over_rays'][1]:.2f}", f"{seen['frame_ms']:.1f}", f"{seen['frame_over_rays'][1]:.2f}",
            f"{seen['frames_per_s']:.1f}", f"{seen['error_mk']:.1f}", f"{seen['optics_error_mk']:.1f}",
        )
        for name, scene in result["scenes"].items()
        for label, setting in scene["settings"].items()
        for view, seen in setting["views"].items()
    ]  # fmt: skip


def costs(result: dict[str, Any]) -> list[str]:
    """Return one line per scene: its size, and the time and memory needed before its first frame."""
    return [
        f"{name}: {scene['triangles']} triangles, {scene['texels']} texels; {scene['build_s']:.1f} s to build, "
        f"{scene['bake_s']:.1f} s to bake, "
        + ("peak memory unknown" if scene["peak_mib"] is None else f"peak memory {scene['peak_mib']:.0f} MiB")
        for name, scene in result["scenes"].items()
    ]


def _measure(scene: Scene, settings: Settings, device: str, repeats: int) -> dict[str, Any]:
    """Return the result of one scene."""
    scene.refuse_tiles("bench")
    forget_peak_memory()
    poses, sigma = views(scene), optics_sigma_px(scene.camera)
    first: Renderer | None = None
    done: dict[str, dict[str, Any]] = {}
    renderers: list[Renderer] = []
    for label, keywords in settings:
        start = time.perf_counter()
        renderer = Renderer(scene, **{"device": device, "like": first, **keywords})
        built = time.perf_counter()
        with cache_off():
            _ = renderer.baked
        if first is None:
            first, build_s, bake_s = renderer, built - start, time.perf_counter() - built
        times = {view: _times(renderer, pose, repeats) for view, pose in poses.items()}
        done[label] = {"plan": renderer.plan.as_dict(), "views": times}
        renderers.append(renderer)
    # The peak is read here, because users do not render the converged images below.
    peak = peak_memory_mib()
    finest_of: dict[Any, NDArray[np.float64]] = {}
    for renderer, measured in zip(renderers, done.values(), strict=True):
        sampling = renderer.plan.sampling
        for view, pose in poses.items():
            key = view, sampling.rays, sampling.tolerance_mk
            if key not in finest_of:
                finest_of[key] = converged(renderer, pose)
            finest, image = finest_of[key], renderer.radiance(pose)
            measured["views"][view]["error_mk"] = rms_mk(image, finest, scene.camera)
            measured["views"][view]["optics_error_mk"] = rms_mk(image, finest, scene.camera, sigma)
    return {
        "triangles": sum(len(surface.faces) for surface in scene.surfaces),
        "texels": sum(surface.material.size for surface in scene.surfaces),
        "pixels": [scene.camera.width, scene.camera.height],
        "optics_sigma_px": sigma,
        "build_s": build_s,
        "bake_s": bake_s,
        "peak_mib": peak,
        "settings": done,
    }


def _times(renderer: Renderer, pose: NDArray[np.float64], repeats: int) -> dict[str, Any]:
    """Return times of rays, radiance and frame with sensor at one pose, and ratios as (25, 50, 75) percentiles."""

    def sensor(pose: NDArray[np.float64]) -> Any:
        frame = renderer.frame(pose)
        return frame.counts, frame.display

    rays = renderer.rays(pose)
    per_pixel = sum(len(x) for x, _ in rays) / (renderer.scene.camera.width * renderer.scene.camera.height)
    jobs: tuple[Callable[[NDArray[np.float64]], Any], ...] = (
        lambda pose: renderer.cast_only(pose, rays), renderer.radiance, sensor,
    )  # fmt: skip
    # The camera moves by a millimetre each time, so that nothing cached for the last pose is reused.
    step = np.zeros((4, 4))
    step[2, 3] = 1e-3
    seconds = np.empty((repeats, len(jobs)))
    # The first two turns compile kernels; they do not count.
    for turn in range(-2, repeats):
        for number, job in enumerate(jobs):
            here = pose + turn * step
            start = time.perf_counter()
            job(here)
            if turn >= 0:
                seconds[turn, number] = time.perf_counter() - start
    casting, radiance, frame = np.median(seconds, axis=0)
    quartiles = np.percentile(seconds[:, 1:] / seconds[:, :1], (25, 50, 75), axis=0)
    return {
        "rays_per_pixel": per_pixel,
        "rays_ms": 1e3 * float(casting),
        "radiance_ms": 1e3 * float(radiance),
        "frame_ms": 1e3 * float(frame),
        "radiance_over_rays": quartiles[:, 0].tolist(),
        "frame_over_rays": quartiles[:, 1].tolist(),
        "frames_per_s": 1.0 / float(frame),
    }


def views(scene: Scene, height_m: float = HEIGHT_M) -> Mapping[str, NDArray[np.float64]]:
    """Return {view: pose (4, 4)}: straight and 45° down at the middle of the terrain, `height_m` [m] above it."""
    vertices = np.concatenate([surface.vertices for surface in scene.near_ground])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    east, north = 0.5 * (low + high)[:2]
    ground = float(scene.ground(east, north))
    up = height_m + (ground if np.isfinite(ground) else high[2])
    return {
        view: path.pose(east, north - height_m / np.tan(np.radians(-pitch)), up, yaw_deg=0.0, pitch_deg=pitch)
        for view, pitch in VIEWS.items()
    }
