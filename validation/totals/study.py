"""Stated total errors of whole frames against path tracing, and strips of ground against closed forms."""

import tempfile
import time
from pathlib import Path

import numpy as np

from thermorender import files, formats
from thermorender.apps.compare import machine
from thermorender.physics.planck import brightness_temperature
from thermorender.render import reference
from thermorender.render.renderer import Renderer
from thermorender.versions import versions
from validation.kept_cases import kept_cases
from validation.totals import scenes

HEADER = ("case", "true [mK]", "two standard errors less", "stated [mK]", "stated ÷ true", "strip: frame [K]",
          "path tracer [K]", "closed form [K]", "stated there [mK]")  # fmt: skip
# Paths per pixel of each of two references, and their longest.
PATHS, DEPTH = 384, 24


def run(folder, seed=0, paths=PATHS, names=None, progress=None, device="auto"):
    """Measure the cases that `totals.json` of a folder lacks; return all {name: record}, as written there.

    Records hold true_mk, least_mk (two standard errors less), stated_mk, budget_mk, drawn (bool) and seconds; those
    with a closed form `strip`: frame_k, reference_k, exact_k and stated_mk of the strip.
    """
    folder = files.make_folder(folder)
    path = folder / "totals.json"
    kept = kept_cases(path)
    cases = [(case, False) for case in scenes.chosen()] + [(case, True) for case in scenes.drawn(seed)]
    for turn, (case, drawn) in enumerate(cases):
        if case.name in kept or (names and not any(each in case.name for each in names)):
            continue
        if progress:
            progress(case.name, turn / len(cases))
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as place:
            found = measure(case, Path(place) / "scene", paths, device)
        kept[case.name] = {**found, "drawn": drawn, "seconds": round(time.perf_counter() - start, 1)}
        formats.write_json(path, {"machine": machine.machine(), "versions": versions(), "seed": seed, "cases": kept})
    return kept


def measure(case, folder, paths=PATHS, device="auto"):
    """Return the record of one case, without `drawn` and `seconds`."""
    scene = scenes.load(case, folder)
    pose = case.view(scene)
    renderer = Renderer(scene, device=device)
    frame = renderer.frame(pose)
    references = [reference.render(scene, pose, paths, DEPTH, seed, device) for seed in (1, 2)]
    shown = np.isfinite(frame.error_mk)
    square, error = reference.squared_error(frame.radiance[shown], *(each[shown] for each in references))
    per_mk = renderer.plan.radiance_per_mk
    found = {
        "true_mk": float(np.sqrt(max(square, 0.0)) / per_mk),
        "least_mk": float(np.sqrt(max(square - 2.0 * error, 0.0)) / per_mk),
        "stated_mk": frame.budget_mk["total"],
        "budget_mk": {name: round(value, 1) for name, value in frame.budget_mk.items()},
    }
    if case.strip:
        low, high, expected = case.strip
        x = frame.truth["position"][..., 0]
        number, y = frame.truth["object"], frame.truth["position"][..., 1]
        here = shown & (number == 0) & (x > low) & (x < high) & (np.abs(y) < 6.0)
        epsilon = [float(np.mean(frame.truth["emissivity"][place])) for place in (here, number == 1)]
        band = scenes.BAND_UM
        means = [brightness_temperature(float(np.mean(each[here])), *band)
                 for each in (frame.radiance, 0.5 * sum(references))]  # fmt: skip
        found["strip"] = {"frame_k": float(means[0]), "reference_k": float(means[1]), "exact_k": expected(*epsilon),
                          "stated_mk": float(np.nanmean(frame.error_mk[here]))}  # fmt: skip
    return found


def summary(kept):
    """Return {cases, covered, median} of cases with an error: number, share with stated ≥ true, stated ÷ true."""
    ratio = np.array([case["stated_mk"] / case["true_mk"] for case in kept.values() if case["true_mk"]])
    covered, median = (float((ratio >= 1.0).mean()), float(np.median(ratio))) if ratio.size else (None, None)
    return {"cases": int(ratio.size), "covered": covered, "median": median}


def rows(kept):
    """Return the cases as table rows of text under `HEADER`."""
    found = []
    for name, case in kept.items():
        strip = case.get("strip")
        found.append((
            name, f"{case['true_mk']:.0f}", f"{case['least_mk']:.0f}", f"{case['stated_mk']:.0f}",
            f"{case['stated_mk'] / max(case['true_mk'], 1e-9):.2f}",
            *([f"{strip[key]:.2f}" for key in ("frame_k", "reference_k", "exact_k")] if strip else ("", "", "")),
            f"{strip['stated_mk']:.0f}" if strip else "",
        ))  # fmt: skip
    return found
