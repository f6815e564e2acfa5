"""What frames state of their own sampling error, held against frames of 256 rays per pixel of the same light.

The error is that over the pixels that show a surface, of sampling alone: both frames share the light between surfaces.
A view costs as much as its reference, a few seconds.
"""

import time

import numpy as np

from thermorender import defaults, files, formats
from thermorender.compare import machine
from thermorender.compare.sampling_error import converged
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.versions import versions
from validation.budget import scenes
from validation.budget.figure import figure
from validation.kept_cases import kept_cases

QUALITIES = ("standard", "high")
# Light, which is not what is measured, is the same for all.
_RAYS = 128
HEADER = ("scene", "view", "quality", "pixels", "true [mK]", "stated [mK]", "stated ÷ true", "frame [ms]")
_TURNS = 5


def run(folder, scenes=defaults.SCENES, drawn=105, seed=0, qualities=QUALITIES, progress=None, device="auto"):
    """Measure what is not yet in `budget.json` of a folder; return its cases {name: record}, as written there.

    Parameters
    ----------
    folder : path
    scenes : sequence of str
        Whose chosen views are looked at, and over which the drawn ones are spread.
    drawn : int
        Views drawn in all, of the first quality.
    seed : int
        Of the drawn views and of the made scenes.
    qualities : sequence of str
    progress : callable, optional
        Called with (what, share done).
    device : {"auto", "cpu", "cuda"}

    Returns
    -------
    dict
        Records hold scene, view, height_m, pitch_deg, quality, drawn (bool), pixels, true_mk, stated_mk and frame_ms.
    """
    folder = files.make_folder(folder)
    path = folder / "budget.json"
    kept = kept_cases(path)
    views = scenes.drawn(drawn, seed)
    jobs = [
        (load_scene(name), [(view, False) for view in map(_view, scenes.CHOSEN)]
         + [(view, True) for view in views[number :: len(scenes)]])
        for number, name in enumerate(scenes)
    ]  # fmt: skip
    jobs += [(scene, [(view, False) for view in chosen]) for scene, chosen in scenes.made(seed)]
    for number, (scene, chosen) in enumerate(jobs):
        renderers = {}
        for part, (view, random) in enumerate(chosen):
            if progress:
                progress(f"{scene.name}, {view.name}", (number + part / len(chosen)) / len(jobs))
            asked = qualities[:1] if random else qualities
            wanted = [quality for quality in asked if _key(scene, view, quality) not in kept]
            if not wanted:
                continue
            for quality in (qualities[0], *wanted):
                if quality not in renderers:
                    renderers[quality] = Renderer(
                        scene, quality, rays=_RAYS, device=device, like=next(iter(renderers.values()), None)
                    )
            truth = converged(renderers[qualities[0]], view.pose(scene), {"device": device})
            for quality in wanted:
                found = _measure(renderers[quality], view.pose(scene), truth)
                kept[_key(scene, view, quality)] = {
                    "scene": scene.name, "view": view.name, "height_m": view.height_m, "pitch_deg": view.pitch_deg,
                    "quality": quality, "drawn": random, **found,
                }  # fmt: skip
            record = {"machine": machine.machine(), "versions": versions(), "seed": seed, "cases": kept}
            formats.write_json(path, record)
    figure(folder / "budget.png", kept)
    if progress:
        progress("measured", 1.0)
    return kept


def summary(kept):
    """Return {drawn views, covered share, median of stated ÷ true} of the drawn views that show something."""
    drawn = [case for case in kept.values() if case["drawn"] and case["true_mk"]]
    ratio = np.array([case["stated_mk"] / case["true_mk"] for case in drawn])
    median = float(np.median(ratio)) if ratio.size else None
    return {"views": int(ratio.size), "covered": float((ratio >= 1.0).mean()) if ratio.size else None, "median": median}


def rows(kept):
    """Return the chosen cases as rows of text under `HEADER`."""
    return [
        (case["scene"], case["view"], case["quality"], str(case["pixels"]), f"{case['true_mk']:.0f}",
         f"{case['stated_mk']:.0f}", f"{case['stated_mk'] / max(case['true_mk'], 1e-9):.2f}", f"{case['frame_ms']:.0f}")
        for case in kept.values() if not case["drawn"]
    ]  # fmt: skip


def _view(numbers):
    return scenes.View(*map(float, numbers))


def _key(scene, view, quality):
    return f"{scene.name}/{view.name}, yaw {view.yaw_deg:.0f}°/{quality}"


def _measure(renderer, pose, truth):
    """{pixels, true_mk, stated_mk, frame_ms} of one view."""
    frame = renderer.frame(pose)
    shown = np.isfinite(frame.error_mk)
    difference = (frame.radiance - truth)[shown] / renderer.plan.radiance_per_mk
    seconds = []
    for _ in range(_TURNS):
        start = time.perf_counter()
        renderer.radiance(pose)
        seconds.append(time.perf_counter() - start)
    true = float(np.sqrt(np.mean(difference**2))) if difference.size else 0.0
    return {"pixels": int(shown.sum()), "true_mk": true, "stated_mk": frame.budget_mk["sampling"],
            "frame_ms": 1e3 * float(np.median(seconds))}  # fmt: skip
