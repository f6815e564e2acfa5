"""Cost of air in a frame, and the error of its spectral channels: error against run time.

Times are measured in turns, the frame without air first, and reported as medians of the ratios of each turn. The error
is that of a whole frame against the most channels available; the plan's estimate is for any path and surface.
"""

import time

import numpy as np

from thermorender.apps.compare.bench import views
from thermorender.apps.compare.machine import machine
from thermorender.apps.compare.sampling_error import rms_mk
from thermorender.render.renderer import Renderer
from thermorender.versions import versions

TOLERANCES_MK = (2000.0, 200.0, 50.0, 20.0, 5.0)
FINEST_MK = 1.0
HEADER = ("height [m]", "view", "asked [mK]", "nodes", "channels", "planned [mK]", "error [mK]", "frame [ms]",
          "÷ without air")  # fmt: skip


def run(scene, air=("midlatitude-summer", "rural-23km"), heights_m=(120.0, 2000.0), tolerances_mk=TOLERANCES_MK,
        rays=32, repeats=15, device="auto", progress=None):  # fmt: skip
    """Return the cost of a scene's frames with and without air, and the error of the channels, as plain numbers.

    Parameters
    ----------
    scene : Scene
    air : (str, str)
        Standard atmosphere and aerosol.
    heights_m : sequence of float
        Heights of the camera above the ground [m]; it looks straight and 45° down from each.
    tolerances_mk : sequence of float
        Tolerances of nodes and channels [mK].
    rays : int
        Rays per face of the bake.
    repeats : int
        Number of turns of each measurement.
    device : {"auto", "cpu", "cuda"}
    progress : callable, optional
        Called with (step, share done).

    Returns
    -------
    dict
        machine, versions, scene, air, and cases: [{height_m, view, tolerance_mk, nodes, channels, planned_mk,
        error_mk, frame_ms, over_vacuum}].
    """
    report = progress or (lambda step, share: None)
    own = {"rays": rays, "device": device}
    vacuum = Renderer(scene, **own)
    aired = vacuum.scene.with_air(*air)
    made = []
    for number, tolerance in enumerate((FINEST_MK, *tolerances_mk)):
        report(f"baking for {tolerance:g} mK", number / (len(tolerances_mk) + 1))
        made.append(Renderer(aired, tolerance_mk=tolerance, like=vacuum, **own))
        _ = made[-1].baked
    cases = []
    step = np.zeros((4, 4))
    step[2, 3] = 1e-3
    for height in heights_m:
        for view, pose in views(scene, height).items():
            seconds = np.empty((repeats, len(made)))
            for turn in range(-2, repeats):
                for number, renderer in enumerate((vacuum, *made[1:])):
                    start = time.perf_counter()
                    renderer.radiance(pose + turn * step)
                    if turn >= 0:
                        seconds[turn, number] = time.perf_counter() - start
            exact = made[0].radiance(pose).astype(np.float64)
            for number, (tolerance, renderer) in enumerate(zip(tolerances_mk, made[1:], strict=True), 1):
                spectrum = renderer.plan.spectrum
                cases.append({
                    "height_m": height, "view": view, "tolerance_mk": tolerance, "nodes": spectrum.nodes,
                    "channels": spectrum.channels, "planned_mk": spectrum.channels_mk + spectrum.nodes_mk,
                    "error_mk": rms_mk(renderer.radiance(pose), exact, scene.camera),
                    "frame_ms": 1e3 * float(np.median(seconds[:, number])),
                    "over_vacuum": float(np.median(seconds[:, number] / seconds[:, 0])),
                })  # fmt: skip
    report("measured", 1.0)
    return {"machine": machine(), "versions": versions(), "scene": scene.name, "air": list(air), "cases": cases}


def rows(result):
    """Return a result of `run` as table rows of text under `HEADER`."""
    return [
        (f"{case['height_m']:g}", case["view"], f"{case['tolerance_mk']:g}", str(case["nodes"]), str(case["channels"]),
         f"{case['planned_mk']:.1f}", f"{case['error_mk']:.2f}", f"{case['frame_ms']:.1f}",
         f"{case['over_vacuum']:.2f}")
        for case in result["cases"]
    ]  # fmt: skip
