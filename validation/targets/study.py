"""The radiance that a small target adds to a frame, against the same view through a long lens.

A target of a few thousandths of a pixel adds its solid angle times its contrast. A lens that shows the target over
hundreds of pixels, aimed at it from the same place, needs no treatment of small details and gives the true sum.
"""

import time
from dataclasses import replace
from functools import partial

import numpy as np

from thermorender.apps.compare import machine
from thermorender.files import atomic
from thermorender.materials.library import load_library
from thermorender.render.renderer import Renderer
from thermorender.trajectory import path
from thermorender.versions import versions
from validation.budget.scenes import box, level
from validation.made_scenes import in_memory

# {name: (sides (east, north, up) [m], temperature [K])}.
TARGETS = {
    "person": ((0.5, 0.5, 1.8), 310.0),
    "car": ((2.0, 4.5, 1.6), 320.0),
    "post of 4 cm": ((0.04, 0.04, 25.0), 300.0),
    "fire": ((0.4, 0.4, 0.4), 700.0),
    "wire of 1 cm": ((30.0, 0.01, 0.01), 320.0),
}
# (distance [m], pitch [deg]).
VIEWS = ((120, -90), (400, -90), (400, -30), (1500, -30), (1500, -10), (5000, -10), (12_000, -20), (38_000, -40))
HEADER = ("target", "distance [m]", "pitch [deg]", "area [px]", "frame ÷ truth", "spread", "lowest", "highest")
_GROUND_K, _SIDE_M, _TEXELS, _RAYS = 290.0, 60_000.0, 64, 64
# The long lens shows the target's longest side over this many pixels.
_SHOWN_PX = 200.0
# Pixels around the target that count beyond its size, and a change of radiance that is not rounding.
_MARGIN_PX, _CHANGE, _CHANGE_LONG = 8, 3e-6, 1e-4


def run(places=6, seed=0, targets=tuple(TARGETS), views=VIEWS, progress=None, device="auto", spread=map):
    """Return {machine, versions, seed, cases}: each case's target, distance, pitch, area and ratios to the truth.

    Parameters
    ----------
    places : int
        Places of each target in each view, spread over parts of a pixel, each seen from another direction.
    seed : int
    targets : sequence of str
        Keys of TARGETS.
    views : sequence of (distance [m], pitch [deg])
    progress : callable, optional
        Called with (step, share done).
    device : {"auto", "cpu", "cuda"}
    spread : callable
        (do, units) → do(unit) of each case, in order.
    """
    random = np.random.Generator(np.random.Philox(seed))
    units = [
        (name, *view, [(random.uniform(-2.0, 2.0, 2), random.uniform(0.0, 360.0)) for _ in range(places)])
        for name in targets for view in views
    ]  # fmt: skip
    cases = []
    for case in spread(partial(_case, device), units):
        cases.append(case)
        if progress:
            progress(f"{case['target']}, {case['distance_m']} m", len(cases) / len(units))
    return {"machine": machine.machine(), "versions": versions(), "seed": seed, "cases": cases}


def rows(result):
    """Return table rows of text under HEADER."""
    return [
        (case["target"], str(case["distance_m"]), str(case["pitch_deg"]), f"{case['area_px']:.2g}",
         f"{np.mean(case['ratios']):.3f}", f"{np.std(case['ratios']):.3f}", f"{min(case['ratios']):.3f}",
         f"{max(case['ratios']):.3f}")
        for case in result["cases"]
    ]  # fmt: skip


def page(where, result):
    """Write the table as Markdown."""
    lines = ["# Small and far targets", "", __doc__.partition("\n\n")[2].strip().replace("\n", " "), "",
             f"| {' | '.join(HEADER)} |", "|" + " --- |" * len(HEADER)]  # fmt: skip
    lines += [f"| {' | '.join(row)} |" for row in rows(result)]
    with atomic(where) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _case(device, unit):
    """Return the record of a case: of a target at drawn places (east, north) [m], seen from drawn directions [deg]."""
    name, distance_m, pitch_deg, drawn = unit
    began = time.perf_counter()
    found = [_measured(*TARGETS[name], distance_m, pitch_deg, *each, device) for each in drawn]
    ratio = np.array([frame / truth for frame, truth, _ in found])
    return {
        "target": name, "distance_m": distance_m, "pitch_deg": pitch_deg,
        "area_px": float(np.mean([area for *_, area in found])), "ratios": ratio.tolist(),
        "seconds": time.perf_counter() - began,
    }  # fmt: skip


def _measured(size, kelvin, distance_m, pitch_deg, place, yaw, device):
    """(radiance added in a frame, truth) [W m⁻² over the target's solid angle], and the area in pixels of the frame."""
    library = load_library()
    ground = level(_SIDE_M / _TEXELS, np.zeros((_TEXELS, _TEXELS), int), np.full((_TEXELS, _TEXELS), _GROUND_K))
    target = box("target", place, size, kelvin)
    # A thin wire hangs; a box that touches the ground would share its plane.
    target = replace(target, vertices=target.vertices + [0.0, 0.0, 10.0 if size[2] < 0.1 else 0.01])
    scene = in_memory("target", [ground, target], [library["soil_loam"], library["paint_black"]])
    scene = scene.with_surfaces(terrain_count=1)
    bare = in_memory("ground", [ground], [library["soil_loam"]])
    pitch, turn = np.radians(-pitch_deg), np.radians(yaw)
    camera = np.array([-np.sin(turn) * np.cos(pitch), -np.cos(turn) * np.cos(pitch), np.sin(pitch)]) * distance_m
    middle = target.vertices.mean(axis=0)
    view = path.pose(*camera, yaw_deg=yaw, pitch_deg=pitch_deg)
    frame, _ = _added(scene, bare, view, middle, max(size) / distance_m, _CHANGE, device)
    east, north, up = middle - camera
    aimed = path.pose(
        *camera, yaw_deg=np.degrees(np.arctan2(east, north)),
        pitch_deg=np.degrees(np.arctan2(up, np.hypot(east, north))),
    )  # fmt: skip
    one = scene.camera
    zoom = max(_SHOWN_PX / one.focal_length_px * distance_m / max(size), 1.0)
    lens = replace(one, focal_length_mm=one.focal_length_mm * zoom)
    truth, angle = _added(
        scene.with_camera(lens), bare.with_camera(lens), aimed, middle, max(size) / distance_m, _CHANGE_LONG, device
    )
    return frame, truth, angle * one.focal_length_px**2


def _added(scene, bare, pose, middle, angle, change, device):
    """(radiance times solid angle that the target adds near its place, solid angle of the changed pixels [sr])."""
    image, ground = (Renderer(each, rays=_RAYS, device=device).radiance(pose).astype(np.float64)
                     for each in (scene, bare))  # fmt: skip
    camera = scene.camera
    focal = camera.focal_length_px
    right, down = np.arange(camera.width) + 0.5 - camera.width / 2, np.arange(camera.height) + 0.5 - camera.height / 2
    solid = focal / (focal**2 + right**2 + down[:, None] ** 2) ** 1.5
    # Light from the target warms the whole ground a little, because the ground is two triangles.
    ground *= np.median(image / ground)
    at = camera.project((np.linalg.inv(pose) @ [*middle, 1.0])[None, :3])[0]
    reach = _MARGIN_PX + 1.5 * angle * focal
    near = (abs(np.arange(camera.height)[:, None] - at[1]) < reach) & (abs(np.arange(camera.width) - at[0]) < reach)
    counted = near & (np.abs(image - ground) > change * ground)
    return float(((image - ground) * solid)[counted].sum()), float(solid[counted].sum())
