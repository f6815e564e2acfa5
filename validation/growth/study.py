"""Cost against triangles, texels and spectral nodes, varied one at a time, each case in a separate process.

A separate process measures the peak memory of one case: synthetic terrain, ray caster, bake and frames, without the
generation of the terrain. The number of nodes is given directly, not by a tolerance.
"""

import time
from dataclasses import replace

import numpy as np

from thermorender import files, formats
from thermorender.apps.compare import bench, machine
from thermorender.apps.compare.sampling_error import cache_off
from thermorender.versions import versions
from validation.growth.figure import figure
from validation.kept_cases import kept_cases
from validation.made_scenes import terrain

# Values of the axes that are not varied: triangles, texels along a side, nodes.
BASE = (1_000_000, 2048, 8)
AXES = {
    "triangles": (100_000, 300_000, 1_000_000, 3_000_000, 10_000_000),
    "texels": (1024, 2048, 4096, 8192, 16384),
    "nodes": (1, 4, 16, 64),
}
RAYS = 16
HEADER = ("varied", "triangles", "texels", "nodes", "build [s]", "bake [s]", "frame [ms]", "peak [GiB]")


def run(folder, axes=AXES, base=BASE, progress=None, device="auto"):
    """Measure the cases that `growth.json` of a folder lacks; return {case: record}, as written there.

    Parameters
    ----------
    folder : path
    axes : dict
        Values of triangles, texels (along a side) and nodes.
    base : (int, int, int)
        Values of the axes that are not varied.
    progress : callable, optional
        Called with (step, share done).
    device : {"auto", "cpu", "cuda"}
    """
    folder = files.make_folder(folder)
    path = folder / "growth.json"
    kept = kept_cases(path)
    names = tuple(AXES)
    jobs = [
        (axis, dict(zip(names, base, strict=True)) | {axis: value}) for axis, values in axes.items() for value in values
    ]
    for number, (axis, case) in enumerate(jobs):
        name = "/".join((axis, *(str(value) for value in case.values())))
        if progress:
            progress(name, number / len(jobs))
        if name in kept:
            continue
        kept[name] = {"varied": axis, **case, **machine.apart(_measure, *case.values(), device)}
        record = {"machine": machine.machine(), "versions": versions(), "rays": RAYS, "cases": kept}
        formats.write_json(path, record)
        figure(folder / "growth.png", kept)
    if progress:
        progress("measured", 1.0)
    return kept


def _measure(triangles, texels, nodes, device):
    from thermorender.render.baked import bake
    from thermorender.render.geometry import Geometry
    from thermorender.render.plan import make_plan
    from thermorender.render.quality import Sampling
    from thermorender.render.renderer import Renderer
    from thermorender.render.spectrum import with_nodes
    from thermorender.render.variant import activate

    scene = terrain(triangles, texels)
    machine.forget_peak_memory()
    start = time.perf_counter()
    plan = make_plan(scene, Sampling.of(rays=RAYS))
    plan = replace(plan, spectrum=with_nodes(plan.spectrum, scene.materials, nodes))
    geometry = Geometry(activate(device), scene.surfaces)
    built = time.perf_counter()
    with cache_off():
        renderer = Renderer.of(bake(scene, plan, geometry))
    baked = time.perf_counter()
    pose, seconds = bench.views(scene)["oblique"], []
    for turn in range(7):
        begin = time.perf_counter()
        renderer.radiance(pose)
        if turn > 1:
            seconds.append(time.perf_counter() - begin)
    return {
        "build_s": built - start, "bake_s": baked - built, "frame_ms": 1e3 * float(np.median(seconds)),
        "peak_mib": machine.peak_memory_mib(),
    }  # fmt: skip


def rows(cases):
    """Return the cases as table rows of text under `HEADER`."""
    return [
        (case["varied"], str(case["triangles"]), f"{case['texels']}²", str(case["nodes"]), f"{case['build_s']:.1f}",
         f"{case['bake_s']:.1f}", f"{case['frame_ms']:.0f}",
         "unknown" if case["peak_mib"] is None else f"{case['peak_mib'] / 1024:.2f}")
        for case in cases.values()
    ]  # fmt: skip
