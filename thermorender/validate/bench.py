"""Run time of a frame beside that of its ray casting alone, and what is wrong with the frame, in mK.

Everything is measured within one run and taken in turns (rays, frame, frame with sensor, rays, …), so that a busy
machine slows all alike; ratios are medians of the ratios of each turn. The error is that against the same
renderer with 256 rays per pixel: what sampling alone leaves, once as it is and once behind the camera's optics.
"""

import json
import multiprocessing
import os
import platform
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path

import numpy as np

from thermorender import defaults, files
from thermorender.errors import ThermorenderError
from thermorender.materials import library as material_tables
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.scene.scene import Scene
from thermorender.scene.spec import EmissivitySpec, SceneSpec, TemperatureSpec, TerrainSpec
from thermorender.scene.surface import SURFACE, Surface
from thermorender.sensor.camera import load_camera
from thermorender.trajectory import path
from thermorender.validate.metrics import SAMPLING, cache_off, converged, optics_sigma_px, rms_mk
from thermorender.versions import versions

SETTINGS = tuple((name, {"quality": name}) for name in ("fast", "standard", "high"))
HEIGHT_M = 120.0
# Camera pitch [deg] of each view; all look at the middle of the scene.
VIEWS = {"nadir": -90.0, "oblique": -45.0}
HEADER = ("scene", "view", "setting", "rays per pixel", "rays only [ms]", "frame [ms]", "÷ rays", "with sensor [ms]",
          "÷ rays", "frames/s", "error [mK]", "after optics [mK]")  # fmt: skip


def bench(scene_names=(defaults.SCENE,), triangles=None, texels=None, repeats=15, progress=None, settings=SETTINGS,
          device="auto", air=None):  # fmt: skip
    """Return what a frame costs and how wrong it is, for each scene, view and setting; plain numbers.

    Parameters
    ----------
    scene_names : sequence of str or Scene
        Scene folders, names of shipped ones, or scenes in memory.
    triangles : int, optional
        Adds a synthetic terrain of about this many triangles.
    texels : int, optional
        Texels along each of its sides; two per cell of the terrain where None.
    repeats : int
        Turns of each measurement.
    progress : callable, optional
        Called with (what, share done).
    settings : sequence of (label, dict)
        Keywords of Renderer under the name they go by in the result.
    device : {"auto", "cpu", "cuda"}
    air : (str, str), optional
        Standard atmosphere and aerosol to measure the scenes under.

    Returns
    -------
    dict
        machine, versions, repeats, and scenes: {name: {triangles, texels, pixels, optics_sigma_px, build_s, bake_s,
        peak_mib, settings: {label: {plan, views: {view: {rays_per_pixel, rays_ms, radiance_ms, frame_ms,
        radiance_over_rays, frame_over_rays, frames_per_s, error_mk, optics_error_mk}}}}}}. rays_ms is casting all rays
        of the frame and nothing else. Times are medians; a ratio is given as its quartiles, the median in the middle.
        peak_mib is the most memory the process held from the first renderer's start to the last timed frame, None
        where the system does not tell (anything but Linux).

    Raises
    ------
    ThermorenderError
        Nothing to measure, an unknown scene, or repeats below 1.
    """
    if repeats < 1:
        raise ThermorenderError(f"repeats={repeats} is not allowed; give 1 or more")
    jobs = [name if isinstance(name, Scene) else load_scene(name) for name in scene_names]
    jobs += [terrain(triangles, texels)] if triangles else []
    jobs = [scene.with_air(*air) for scene in jobs] if air else jobs
    if not jobs:
        raise ThermorenderError("there is no scene to measure; give a scene, or triangles=… for a synthetic one")
    tell = progress or (lambda what, share: None)
    found = {}
    for number, scene in enumerate(jobs):
        tell(scene.name, number / len(jobs))
        found[scene.name] = _measure(scene, settings, device, repeats)
    tell("measured", 1.0)
    return {"machine": machine(), "versions": versions(), "repeats": repeats, "scenes": found}


def rows(result):
    """Return a result of `bench` as rows of text under `HEADER`."""
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


def costs(result):
    """Return what each scene of a result costs before its first frame, as sentences."""
    return [
        f"{name}: {scene['triangles']} triangles, {scene['texels']} texels; {scene['build_s']:.1f} s to build, "
        f"{scene['bake_s']:.1f} s to bake, "
        + ("peak memory unknown" if scene["peak_mib"] is None else f"peak memory {scene['peak_mib']:.0f} MiB")
        for name, scene in result["scenes"].items()
    ]


def _measure(scene, settings, device, repeats):
    """One scene's part of the result."""
    forget_peak_memory()
    poses, sigma = views(scene), optics_sigma_px(scene.camera)
    first, done, made = None, {}, []
    for label, keywords in settings:
        start = time.perf_counter()
        renderer = Renderer(scene, **{"device": device, "like": first, **keywords})
        built = time.perf_counter()
        with cache_off():
            _ = renderer.baked
        if first is None:
            first, build_s, bake_s = renderer, built - start, time.perf_counter() - built
        found = {view: _times(renderer, pose, repeats) for view, pose in poses.items()}
        done[label] = {"plan": renderer.plan.as_dict(), "views": found}
        made.append((renderer, keywords))
    # The converged images are what nobody renders in use; their memory does not count.
    peak = peak_memory_mib()
    finest_of = {}
    for (renderer, keywords), measured in zip(made, done.values(), strict=True):
        light = {key: value for key, value in keywords.items() if key not in SAMPLING}
        for view, pose in poses.items():
            key = view, renderer.plan.rays, tuple(sorted(light.items()))
            if key not in finest_of:
                finest_of[key] = converged(renderer, pose, light)
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


def _times(renderer, pose, repeats):
    """Times of rays, radiance and frame with sensor from one pose, and their ratios as (25, 50, 75) percentiles."""

    def sensor(pose):
        frame = renderer.frame(pose)
        return frame.counts, frame.display

    rays = renderer.rays(pose)
    per_pixel = sum(len(x) for x, _ in rays) / (renderer.scene.camera.width * renderer.scene.camera.height)
    jobs = (lambda pose: renderer.cast_only(pose, rays), renderer.radiance, sensor)
    # A millimetre further each time: what a frame keeps of the last pose does not count as fast.
    step = np.zeros((4, 4))
    step[2, 3] = 1e-3
    seconds = np.empty((repeats, len(jobs)))
    # The first two turns compile kernels and are not counted.
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


def views(scene, height_m=HEIGHT_M):
    """Return {view: pose}: straight down and 45° down on the middle of the terrain, `height_m` [m] above it."""
    vertices = np.concatenate([surface.vertices for surface in scene.surfaces[: scene.terrain_count]])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    east, north = 0.5 * (low + high)[:2]
    ground = float(scene.ground(east, north))
    up = height_m + (ground if np.isfinite(ground) else high[2])
    return {
        view: path.pose(east, north - height_m / np.tan(np.radians(-pitch)), up, yaw_deg=0.0, pitch_deg=pitch)
        for view, pitch in VIEWS.items()
    }


def terrain(triangles, texels=None, seed=0, side_m=400.0):
    """Return a Scene of a rough terrain made in memory.

    Parameters
    ----------
    triangles : int
        About how many; exact where half of it is a square number, as for 2 million.
    texels : int, optional
        Texels along each side; two per cell where None.
    seed : int
    side_m : float
        Side of the terrain [m].

    Raises
    ------
    ThermorenderError
        Fewer than 8 triangles, or no texel.

    Notes
    -----
    Heights are hills of 6 m with a spectrum falling as frequency^−2.4, and bushes of up to 2 m. Texels are grass,
    sand and loam between 285 and 305 K, the materials in patches.
    """
    if triangles < 8:
        raise ThermorenderError(f"triangles={triangles} is not allowed; give 8 or more")
    if texels is not None and texels < 1:
        raise ThermorenderError(f"texels={texels} is not allowed; give 1 or more along each side")
    rows = int(np.sqrt(triangles / 2))
    columns = int(round(triangles / 2 / rows))
    rng = np.random.Generator(np.random.Philox(seed))
    hills = 6.0 * _noise(rng, (rows + 1, columns + 1), 2.4)
    height = hills + np.clip(_noise(rng, hills.shape, 1.0) - 1.0, 0.0, 1.0) * 2.0
    east = np.linspace(-0.5, 0.5, columns + 1) * side_m
    north = np.linspace(0.5, -0.5, rows + 1) * side_m
    vertices = np.stack([*np.meshgrid(east, north), height], axis=-1).reshape(-1, 3)
    index = np.arange(len(vertices), dtype=np.int32).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.stack([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)], axis=2).reshape(-1, 3)
    u, v = np.meshgrid(np.linspace(0.0, 1.0, columns + 1), np.linspace(0.0, 1.0, rows + 1))
    shape = (texels, texels) if texels else (2 * rows, 2 * columns)
    patches = _noise(rng, shape, 1.8)
    surface = Surface(
        name="terrain",
        vertices=vertices,
        faces=faces,
        uv=np.stack([u, v], axis=-1).reshape(-1, 2)[faces].astype(np.float32),
        colour=np.full((*shape, 3), 128, np.uint8),
        material=((patches > 0.0).astype(np.uint8) + (patches > 0.8)).astype(np.uint8),
        temperature=np.clip(295.0 + 4.0 * _noise(rng, shape, 1.0), 285.0, 305.0).astype(np.float32),
        flags=np.full(shape, SURFACE, np.uint8),
        texel_m=side_m / shape[1],
    )
    library = material_tables.load_library()
    names = ("grass_green", "soil_loam", "sand_quartz")
    return in_memory(f"{2 * rows * columns} triangles", (surface,), [library[name] for name in names])


def in_memory(name, surfaces, materials, sky=260.0, surroundings=None, camera=defaults.CAMERA, terrain_count=None):
    """Return the Scene of surfaces made in memory: no files, no position on Earth, no objects."""
    spec = SceneSpec(
        folder=Path(name), title=name,
        terrain=TerrainSpec(None, None, None, "ellipsoid", None),
        temperature=TemperatureSpec("raster"),
        emissivity=EmissivitySpec("classes", None, None, None, {}),
        sky_temperature=sky, surroundings_temperature=surroundings, camera=camera,
        truth_temperature=None, frame=None, objects=(),
    )  # fmt: skip
    return Scene.of_surfaces(spec, surfaces, materials, load_camera(camera), terrain_count)


def _noise(rng, shape, fall):
    """Gaussian noise (h, w) of unit variance whose amplitude falls as frequency^−fall."""
    along, across = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    frequency = np.hypot(along, across)
    frequency[0, 0] = np.inf
    values = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * frequency**-fall, s=shape)
    return values / values.std()


def kept_cases(path):
    """Return the cases {name: record} that a study's JSON file holds, none where there is no file.

    Raises
    ------
    ThermorenderError
        The file is damaged.
    """
    try:
        return dict(json.loads(files.read_text(path))["cases"]) if path.is_file() else {}
    except (ValueError, KeyError, TypeError):
        raise ThermorenderError(f"{path} is damaged; remove it, or give another folder") from None


def machine():
    """Return {processor, cores, memory_gib, system} of this machine, None for what it does not tell."""
    processor, memory = platform.processor() or None, None
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    with suppress(AttributeError, OSError, ValueError):
        memory = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    return {"processor": processor, "cores": os.cpu_count(), "memory_gib": memory, "system": platform.system()}


def apart(function, *arguments):
    """Return what a function returns in a process of its own, whose memory and time are that function's alone.

    Raises
    ------
    ThermorenderError
        The process is killed before it is done.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            raise ThermorenderError(
                "a process that measures was killed before it was done, perhaps for want of memory; free some and "
                "start again"
            ) from None


def forget_peak_memory():
    """Start the record of the most memory this process held anew, where the system keeps one."""
    # Linux starts its record of the most memory held anew.
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_mib():
    """Return the most memory this process held since [MiB], or None where the system does not tell."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return float(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024.0
    return None
