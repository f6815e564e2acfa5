"""Cost of a frame on each device of a machine: time, kernels, host work, memory; and how far apart their frames are.

Each device has a process of its own, since a process renders on one. Frames of two devices agree within a few mK, not
to the bit. Rays are cast by Embree on the processor and by OptiX on a GPU, which decide otherwise at edges. Sums have
another order, and exponentials and square roots another last bit.
"""

import cProfile
import pstats
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np

from thermorender import formats
from thermorender.apps.compare.bench import views
from thermorender.apps.compare.machine import apart, forget_peak_memory, machine, peak_memory_mib
from thermorender.apps.compare.sampling_error import cache_off
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance_derivative
from thermorender.render.quality import QUALITIES
from thermorender.render.renderer import Renderer
from thermorender.render.variant import DEVICES, active_device, works
from thermorender.scene.load import load_scene
from thermorender.versions import versions

SCENES = ("heath", "village")
# All cases end within four minutes where the last one takes less than 40 s.
LIMIT_S = 200.0
# Frames that are timed, after _WARM ones which compile; frames whose host functions are timed, and functions kept.
_TIMED, _WARM, _PROFILED, _FUNCTIONS = 20, 3, 5, 12
# Time after which fewer frames are timed [s], three at least.
_SECONDS = 4.0
# The quality whose frames are compared and whose starts are timed.
_FIRST = "standard"
STARTS = ("device", "scene", "load [s]", "light [s]", "first frame [s]", "of it compiling [s]", "heat [s]",
          "memory [MiB]")  # fmt: skip
FRAMES = ("device", "scene", "view", "quality", "frame [ms]", "with sensor [ms]", "frames/s", "kernels", "copies",
          "on the device [ms]")  # fmt: skip
DIFFERENCES = ("scene", "view", "RMS [mK]", "median [mK]", "stated [mK]")
HOST = ("device", "scene", "view", "host function", "ms a frame")


def run(folder, devices=None, scenes=SCENES, qualities=tuple(QUALITIES), limit_s=LIMIT_S, heat=True, progress=None):
    """Measure devices, write `gpu.json` and the frames as NumPy files to a folder, and return the record.

    Parameters
    ----------
    folder : path
        It exists.
    devices : sequence of {"cpu", "cuda"}, optional
        Those that render on this machine by default.
    scenes : sequence of str or path
    qualities : sequence of str
    limit_s : float
        Cases begin within this time [s], shared by the devices; others are named as left out.
    heat : bool
        Whether the heat balance of each scene is solved.
    progress : callable, optional
        Called with (step, share done).

    Raises
    ------
    ThermorenderError
        A device is unknown or does not render here, or no scene is given.
    """
    states = {device: works(variant) for device, variant in DEVICES.items()}
    devices = [device for device, (good, _) in states.items() if good] if devices is None else list(devices)
    if not devices or not scenes or not set(devices) <= set(DEVICES):
        raise ThermorenderError(
            f"devices={devices}, scenes={list(scenes)} are not allowed; give a scene, and one or both of "
            f"{', '.join(DEVICES)} that render here, as `thermorender doctor` says"
        )
    for device in devices:
        if not states[device][0]:
            raise ThermorenderError(f"device={device!r} does not render here: {states[device][1]}; leave it out")
    found = {}
    for number, device in enumerate(devices):
        if progress:
            progress(device, number / len(devices))
        found[device] = apart(
            measured, device, [str(scene) for scene in scenes], list(qualities), limit_s / len(devices), heat,
            str(folder)
        )  # fmt: skip
    record = {
        "machine": machine(), "versions": versions(), "gpu": graphics_card(),
        "states": {device: reason or "renders" for device, (_, reason) in states.items()},
        "devices": found, "differences": differences(Path(folder), found),
    }  # fmt: skip
    formats.write_json(Path(folder) / "gpu.json", record)
    return record


def measured(device, scenes, qualities, limit_s, heat, folder):
    """Return {variant, scenes: {name: starts and frames}, left_out} of a device, for this process.

    Every scene is loaded and rendered in standard quality first; heat and the other qualities follow.

    Parameters
    ----------
    device, scenes, qualities, limit_s, heat, folder
        As of `run`.
    """
    from thermorender.render.heat.instants import solved_at

    began, left_out, found, ready = time.perf_counter(), [], {}, {}

    def in_time(case):
        if time.perf_counter() - began < limit_s:
            return True
        left_out.append(case)
        return False

    for path in scenes:
        name = Path(path).name
        if in_time(name):
            found[name], ready[name] = _started(path, device, Path(folder))
    for name, (scene, _) in ready.items():
        if heat and in_time(f"{name}, heat"):
            balanced = scene.with_temperature("balance")
            found[name]["heat_s"] = _timed(lambda scene=balanced: solved_at(scene, [scene.time]))[0]
    for name, (scene, first) in ready.items():
        for quality in qualities:
            if quality != _FIRST and in_time(f"{name}, {quality}"):
                found[name]["frames"] += _frames(Renderer(scene, quality=quality, device=device, like=first), quality)
    return {"variant": active_device(), "scenes": found, "left_out": left_out}


def _started(path, device, folder):
    """(starts and frames, (scene, renderer)) of a scene in standard quality; its images go to the folder."""
    forget_peak_memory()
    load_s, scene = _timed(lambda: load_scene(path))
    with cache_off():
        light_s, renderer = _timed(lambda: _lit(scene, device))
    history, (first_s, _) = _kernels(lambda: _timed(lambda: _with_sensor(renderer, views(scene)["oblique"])))
    frames = _frames(renderer, _FIRST, folder / f"{device} {scene.name}")
    return {
        "load_s": load_s, "light_s": light_s, "first_s": first_s, "compile_s": 1e-3 * _compiled(history),
        "heat_s": None, "texels": sum(surface.material.size for surface in scene.surfaces),
        "triangles": sum(len(surface.faces) for surface in scene.surfaces), "host_mib": peak_memory_mib(),
        "gpu_mib": (graphics_card() or {}).get("used_mib"), "frames": frames,
    }, (scene, renderer)  # fmt: skip


def _lit(scene, device):
    renderer = Renderer(scene, quality=_FIRST, device=device)
    _ = renderer.baked
    return renderer


def _frames(renderer, quality, stem=None):
    """Cost of a frame in each view; their radiance goes to files if `stem` (path without ending) is given."""
    made = []
    for view, pose in views(renderer.scene).items():
        made.append({"view": view, "quality": quality, **_frame(renderer, pose)})
        if stem is not None:
            frame = renderer.frame(pose)
            np.save(f"{stem} {view}.npy", frame.radiance)
            slope = band_radiance_derivative(300.0, *renderer.scene.camera.band_um)
            made[-1] |= {"stated_mk": float(frame.budget_mk["image"]), "per_mk": 1e-3 * float(slope)}
    return made


def _timed(job):
    """(seconds, result) of a job, with the work that it leaves on the device."""
    import drjit as dr

    start = time.perf_counter()
    result = job()
    dr.sync_thread()
    return time.perf_counter() - start, result


def _with_sensor(renderer, pose):
    frame = renderer.frame(pose)
    _ = frame.counts, frame.display
    return frame


def _kernels(job):
    """(history of the kernels, result) of a job."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        result = job()
        dr.sync_thread()
        return dr.kernel_history(), result


def _compiled(history):
    """Time of compiling [ms]."""
    return float(sum(each.get("codegen_time", 0.0) + each.get("backend_time", 0.0) for each in history))


def _frame(renderer, pose):
    """Median times of a frame [ms], its kernels and the host's slowest functions."""
    step = np.zeros((4, 4))
    step[2, 3] = 1e-3  # The camera moves by a millimetre each time, so that nothing of the last frame is reused.
    turns = []
    start = time.perf_counter()
    while len(turns) < _WARM + _TIMED and (len(turns) < 2 * _WARM or time.perf_counter() - start < _SECONDS):
        here = pose + len(turns) * step
        turns.append([_timed(lambda: job(renderer, here))[0] for job in (Renderer.radiance, _with_sensor)])  # noqa: B023
    radiance, whole = 1e3 * np.median(turns[_WARM:], axis=0)
    history, _ = _kernels(lambda: _with_sensor(renderer, pose + 0.5 * step))
    kinds = [str(each["type"]).rpartition(".")[2] for each in history]
    profile = cProfile.Profile()
    with profile:
        for turn in range(_PROFILED):
            _with_sensor(renderer, pose + (turn + 0.25) * step)
    own = pstats.Stats(profile).stats  # {(file, line, function): (calls, calls, own time, whole time, callers)}
    slowest = sorted(own.items(), key=lambda each: -each[1][2])[:_FUNCTIONS]
    return {
        "radiance_ms": float(radiance), "frame_ms": float(whole), "frames_per_s": 1e3 / float(whole),
        "kernels": sum(kind not in ("Memcpy", "Memset") for kind in kinds), "copies": kinds.count("Memcpy"),
        "fills": kinds.count("Memset"), "compile_ms": _compiled(history),
        "device_ms": float(sum(each["execution_time"] for each in history)),
        "host_ms": [[f"{Path(file).name}:{line} {function}", 1e3 * values[2] / _PROFILED]
                    for (file, line, function), values in slowest],
    }  # fmt: skip


def graphics_card():
    """Return {name, driver, memory_mib, used_mib} of the first NVIDIA card, None where there is none."""
    if not shutil.which("nvidia-smi"):
        return None
    asked = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,memory.used", "--format=csv,noheader,nounits"]
    answer = subprocess.run(asked, capture_output=True, text=True, timeout=60)
    cells = answer.stdout.splitlines()[0].split(", ") if answer.returncode == 0 and answer.stdout else []
    return dict(zip(("name", "driver", "memory_mib", "used_mib"), cells, strict=False)) or None


def differences(folder, found):
    """Return [{scene, view, rms_mk, median_mk, stated_mk}]: frames of the second device less those of the first."""
    if len(found) < 2:
        return []
    first, second = found
    made = []
    for name, scene in found[first]["scenes"].items():
        for frame in scene["frames"]:
            view = frame["view"]
            paths = [folder / f"{device} {name} {view}.npy" for device in (first, second)]
            if "stated_mk" in frame and all(path.exists() for path in paths):
                one, other = (np.load(path).astype(np.float64) for path in paths)
                apart_mk = (other - one) / frame["per_mk"]
                made.append({
                    "scene": name, "view": view, "rms_mk": float(np.sqrt((apart_mk**2).mean())),
                    "median_mk": float(np.median(np.abs(apart_mk))), "stated_mk": frame["stated_mk"],
                })  # fmt: skip
    return made


def tables(record):
    """Return [(header, rows of text)] of a record: starts, frames, differences, and the host's slowest functions."""
    starts, frames, host = [], [], []
    seconds = lambda value: "" if value is None else f"{value:.1f}"  # noqa: E731
    for device, result in record["devices"].items():
        for name, scene in result["scenes"].items():
            times = (scene[key] for key in ("load_s", "light_s", "first_s", "compile_s", "heat_s"))
            memory = scene["gpu_mib"] if device == "cuda" else scene["host_mib"]
            starts.append((device, name, *map(seconds, times), "" if memory is None else f"{float(memory):.0f}"))
            for frame in scene["frames"]:
                view, quality = frame["view"], frame["quality"]
                frames.append((
                    device, name, view, quality, f"{frame['radiance_ms']:.1f}", f"{frame['frame_ms']:.1f}",
                    f"{frame['frames_per_s']:.0f}", str(frame["kernels"]), str(frame["copies"]),
                    f"{frame['device_ms']:.1f}",
                ))  # fmt: skip
                if quality == _FIRST:
                    host += [(device, name, view, what, f"{ms:.1f}") for what, ms in frame["host_ms"][:4]]
    apart_rows = [(each["scene"], each["view"], *(f"{each[key]:.1f}" for key in ("rms_mk", "median_mk", "stated_mk")))
                  for each in record["differences"]]  # fmt: skip
    return [(STARTS, starts), (FRAMES, frames), (DIFFERENCES, apart_rows), (HOST, host)]


def notes(record):
    """Return sentences on what the tables lack."""
    found = [f"{device} does not render here: {reason}." for device, reason in record["states"].items()
             if reason != "renders"]  # fmt: skip
    return found + [f"{device} left out for time: {'; '.join(result['left_out'])}."
                    for device, result in record["devices"].items() if result["left_out"]]  # fmt: skip
