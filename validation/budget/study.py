"""The stated sampling error of frames against frames of 256 rays per pixel with the same light.

The error is that of sampling alone, over the pixels that show a surface: both frames share the light between surfaces.
A view takes a few seconds, mostly for its reference.
"""

import time

import numpy as np

from thermorender import defaults, files, formats
from thermorender.apps.compare import machine
from thermorender.apps.compare.sampling_error import converged
from thermorender.render.renderer import Renderer
from thermorender.versions import versions
from validation.budget import scenes
from validation.budget.figure import figure
from validation.drapes import load_drape
from validation.kept_cases import kept_cases

QUALITIES = ("standard", "high")
# The same light for all, because it is not measured here.
_RAYS = 128
HEADER = ("scene", "view", "quality", "pixels", "true [mK]", "stated [mK]", "stated ÷ true", "image true [mK]",
          "image stated [mK]", "frame [ms]")  # fmt: skip
_TURNS = 5


def run(folder, scene_names=defaults.SCENES, drawn=105, seed=0, qualities=QUALITIES, progress=None, device="auto",
        spread=map):  # fmt: skip
    """Measure the cases that `budget.json` of a folder lacks; return all cases {name: record}, as written there.

    Parameters
    ----------
    folder : path
    scene_names : sequence of str
        Scenes of the chosen views; the drawn views are distributed over them.
    drawn : int
        Total number of drawn views, of the first quality.
    seed : int
        Seed of the drawn views and of the made scenes.
    qualities : sequence of str
    progress : callable, optional
        Called with (step, share done).
    device : {"auto", "cpu", "cuda"}
    spread : callable
        (do, units) → do(unit) of each view, in order.

    Returns
    -------
    dict
        Records hold scene, view, height_m, pitch_deg, quality, drawn (bool), pixels, true_mk, stated_mk and frame_ms;
        image_true_mk and image_stated_mk are the same errors over all pixels, sky and surroundings included.
    """
    folder = files.make_folder(folder)
    path = folder / "budget.json"
    kept = kept_cases(path)
    views = scenes.drawn(drawn, seed)
    jobs = [
        (load_drape(name), [(view, False) for view in map(_view, scenes.CHOSEN)]
         + [(view, True) for view in views[number :: len(scene_names)]])
        for number, name in enumerate(scene_names)
    ]  # fmt: skip
    jobs += [(scene, [(view, False) for view in chosen]) for scene, chosen in scenes.made(seed)]
    units = []
    for number, (scene, chosen) in enumerate(jobs):
        for view, random in chosen:
            asked = qualities[:1] if random else qualities
            wanted = [quality for quality in asked if _key(scene, view, quality) not in kept]
            units += [(number, view, random, wanted)] if wanted else []
    measure = _Views([scene for scene, _ in jobs], qualities[0], device)
    for turn, (unit, found) in enumerate(zip(units, spread(measure, units), strict=True), 1):
        if progress:
            progress(f"{jobs[unit[0]][0].name}, {unit[1].name}", turn / len(units))
        kept.update(found)
        formats.write_json(path, {"machine": machine.machine(), "versions": versions(), "seed": seed, "cases": kept})
    figure(folder / "budget.png", kept)
    if progress:
        progress("measured", 1.0)
    return kept


def summary(kept):
    """Return {views, covered, median} of the drawn views with an error: number, share covered, stated ÷ true."""
    drawn = [case for case in kept.values() if case["drawn"] and case["true_mk"]]
    ratio = np.array([case["stated_mk"] / case["true_mk"] for case in drawn])
    median = float(np.median(ratio)) if ratio.size else None
    return {"views": int(ratio.size), "covered": float((ratio >= 1.0).mean()) if ratio.size else None, "median": median}


def rows(kept):
    """Return the chosen cases as table rows of text under `HEADER`."""
    return [
        (case["scene"], case["view"], case["quality"], str(case["pixels"]), f"{case['true_mk']:.0f}",
         f"{case['stated_mk']:.0f}", f"{case['stated_mk'] / max(case['true_mk'], 1e-9):.2f}",
         f"{case['image_true_mk']:.0f}", f"{case['image_stated_mk']:.0f}", f"{case['frame_ms']:.0f}")
        for case in kept.values() if not case["drawn"]
    ]  # fmt: skip


def _view(numbers):
    return scenes.View(*map(float, numbers))


def _key(scene, view, quality):
    return f"{scene.name}/{view.name}, yaw {view.yaw_deg:.0f}°/{quality}"


class _Views:
    """Measures views, and keeps the renderers of the last scene."""

    def __init__(self, scenes, first, device):
        self.scenes, self.first, self.device = scenes, first, device
        self.number, self.renderers = None, {}

    def __call__(self, unit):
        """Return the cases of a view (number of the scene, view, whether it is drawn, qualities)."""
        number, view, random, wanted = unit
        scene = self.scenes[number]
        if self.number != number:
            self.number, self.renderers = number, {}
        for quality in (self.first, *wanted):
            if quality not in self.renderers:
                like = next(iter(self.renderers.values()), None)
                self.renderers[quality] = Renderer(scene, quality, rays=_RAYS, device=self.device, like=like)
        truth = converged(self.renderers[self.first], view.pose(scene))
        return {
            _key(scene, view, quality): {
                "scene": scene.name, "view": view.name, "height_m": view.height_m, "pitch_deg": view.pitch_deg,
                "quality": quality, "drawn": random, **_measure(self.renderers[quality], view.pose(scene), truth),
            }
            for quality in wanted
        }  # fmt: skip


def _measure(renderer, pose, truth):
    """Return {pixels, true_mk, stated_mk, image_true_mk, image_stated_mk, frame_ms} of one view."""
    frame = renderer.frame(pose)
    shown = np.isfinite(frame.error_mk)
    whole = (frame.radiance - truth) / renderer.plan.radiance_per_mk
    difference, budget = whole[shown], frame.budget_mk
    # What the image states beyond sampling is over the pixels that show a surface.
    others = (budget["total"] ** 2 - budget["sampling"] ** 2) * shown.mean()
    seconds = []
    for _ in range(_TURNS):
        start = time.perf_counter()
        renderer.radiance(pose)
        seconds.append(time.perf_counter() - start)
    true = float(np.sqrt(np.mean(difference**2))) if difference.size else 0.0
    return {"pixels": int(shown.sum()), "true_mk": true, "stated_mk": budget["sampling"],
            "image_true_mk": float(np.sqrt(np.mean(whole**2))),
            "image_stated_mk": float(np.sqrt(max(budget["image"] ** 2 - others, 0.0))),
            "frame_ms": 1e3 * float(np.median(seconds))}  # fmt: skip
