"""Edits drawn at random: time from `Scene.with_…` to the radiance of a frame, and the errors of previews.

A preview is the renderer of `preview_for`, the solution that of `solved_for`, each with one frame of 640×512 from the
same pose. The true error of a preview is its difference from the solution, over all texels and over the frame, which
has the rays of the preview's. Edits "in succession" are of all kinds, each made to the preview of the edit before until
one is solved.
"""

import os
import time
from dataclasses import replace
from functools import partial

import numpy as np

import thermorender as tr
from thermorender.apps.compare.machine import machine
from thermorender.versions import versions

# (east, north, height [m]) of the camera; it looks at the middle.
POSE = (0.0, -100.0, 120.0)
# Edits before those that count: kernels are compiled.
_FIRST = 2
HEADER = ("scene", "quality", "edit", "preview [ms]", "95 %", "solution [ms]", "95 %", "most stated [mK]", "most true",
          "RMS stated", "RMS true")  # fmt: skip


def _emissivity(scene, random, shown):
    """A material becomes grey."""
    return scene.with_material({_any(scene, random, shown): float(random.uniform(0.8, 0.99))})


def _spectrum(scene, random, shown):
    """A point of a material's spectrum is dragged."""
    name, at_um = _any(scene, random, shown), random.uniform(*scene.camera.band_um)
    old = next(material for material in scene.materials if material.name == name)
    near = np.exp(-(((old.wavelength_um - at_um) / 0.3) ** 2)) * random.uniform(-0.2, 0.2)
    return scene.with_material({name: replace(old, emissivity=np.clip(old.emissivity + near, 0.01, 1.0))})


def _assignment(scene, random, shown):
    """A class gets the material of another."""
    one, other = (_any(scene, random, shown) for _ in range(2))
    return scene.with_material({one: other})


def _temperature(scene, random, shown):
    """The texels of a class become warmer or colder."""
    number, by = int(random.choice(shown)), random.uniform(-8.0, 8.0)
    kelvin = [np.where(each.material == number, each.temperature + by, each.temperature)
              for each in scene.surfaces[: scene.terrain_count]]  # fmt: skip
    return scene.with_temperature(scene.spec.temperature, kelvin=kelvin)


KINDS = {"emissivity": _emissivity, "spectrum": _spectrum, "material": _assignment, "temperature": _temperature}
SUCCESSION = "in succession"


def run(scenes, qualities, edits=25, exact_every=5, seed=0, device="auto", progress=None):
    """Return times and errors of previews and solutions, as plain numbers.

    Parameters
    ----------
    scenes, qualities : sequences of str
    edits : int
        Of each kind.
    exact_every : int
        Every n-th edit is solved too.
    seed : int
        Of the edits.
    device : {"auto", "cpu", "cuda"}
    progress : callable, optional
        Called with (step, share done).
    """
    report, cases = progress or (lambda step, share: None), []
    jobs = [(scene, quality) for scene in scenes for quality in qualities]
    for number, (name, quality) in enumerate(jobs):
        report(f"{name}, {quality}", number / len(jobs))
        renderer = tr.Renderer(tr.load_scene(name), quality=quality, device=device)
        pose = renderer.scene.pose(*POSE, look_at=(0.0, 0.0, 0.0))
        renderer.radiance(pose)
        shown = _shown(renderer.scene)
        for kind in (*KINDS, SUCCESSION):
            random, before, found = np.random.default_rng(seed), renderer, []
            made = list(KINDS.values()) if kind == SUCCESSION else [KINDS[kind]]
            for _ in range(_FIRST):
                scene = made[0](renderer.scene, random, shown)
                renderer.preview_for(scene).radiance(pose)
            _ = renderer.solved_for(scene)
            for k in range(edits):
                edit = partial(made[k % len(made)], random=random, shown=shown)
                figures, latest = _measured(before, pose, edit, (k + 1) % exact_every == 0)
                found.append(figures)
                before = latest if kind == SUCCESSION else renderer
            cases.append({"scene": name, "quality": quality, "kind": kind, "edits": found})
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"cases": cases, "seed": seed, "load": load, "machine": machine(), "versions": versions()}


def rows(result):
    """Return the result as table rows under HEADER."""
    found = []
    for case in result["cases"]:
        edits = case["edits"]
        solved = [edit for edit in edits if "solution_ms" in edit]
        times = [[edit[name] for edit in of] for name, of in (("preview_ms", edits), ("solution_ms", solved))]
        errors = [max(edit[name] for edit in solved) for name in ("stated_mk", "true_mk", "stated_rms_mk",
                                                                  "true_rms_mk")]  # fmt: skip
        found.append((case["scene"], case["quality"], case["kind"],
                      *(f"{np.percentile(values, share):.0f}" for values in times for share in (50, 95)),
                      *(f"{value:.3g}" for value in errors)))  # fmt: skip
    return found


def _measured(renderer, pose, edit, exact):
    """(figures of an edit, the renderer of its solution with `exact`, else of its preview)."""
    start, spent = time.perf_counter(), time.process_time()
    scene = edit(renderer.scene)
    preview = renderer.preview_for(scene)
    frame = preview.frame(pose)
    shown = {"preview_ms": 1e3 * (time.perf_counter() - start), "preview_cpu_ms": 1e3 * (time.process_time() - spent)}
    errors = preview.baked.errors_mk
    shown |= {"stated_mk": errors["preview"], "stated_rms_mk": errors["preview_rms"]}
    if not exact:
        return shown, preview
    start, spent = time.perf_counter(), time.process_time()
    solution = renderer.solved_for(scene)
    exact = solution.frame(pose, sampled_as=frame)
    shown |= {"solution_ms": 1e3 * (time.perf_counter() - start),
              "solution_cpu_ms": 1e3 * (time.process_time() - spent)}  # fmt: skip
    apart = [sum(preview.baked.texels) - sum(solution.baked.texels), frame.radiance - exact.radiance]
    per_mk = renderer.plan.radiance_per_mk
    shown["true_mk"] = max(float(np.abs(values).max()) for values in apart) / per_mk
    shown["true_rms_mk"] = max(float(np.sqrt(np.mean(np.square(values)))) for values in apart) / per_mk
    return shown, solution


def _shown(scene):
    """Numbers of the terrain's materials."""
    return np.unique(np.concatenate([each.material.ravel() for each in scene.surfaces[: scene.terrain_count]]))


def _any(scene, random, shown):
    """The name of a material of the terrain."""
    return scene.materials[int(random.choice(shown))].name
