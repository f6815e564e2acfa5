"""Frames of a draped orthophoto against frames of the same world in three dimensions, in kelvin by angle and kind.

Each world is made once, with walls and porous crowns, and surveyed from above: surface model, orthophoto, materials and
true temperatures of the highest surfaces. So the draped scene has no other error than its shape. Frames of both look at
points of the world from 90 m. Kinds are those of the pixels' middles in three dimensions: façade, roof, crown, ground
within 4 m of a building or crown, other ground, and small things (fences, garden objects, cars).

Learned maps translate the photograph of each view, as a camera's picture would be, and are ranked by their error
against the reference frame: with the draped scene as the world of photograph and reference, and with the other one. The
third ranking is of a simulator that has the draped scene only, and is judged by the world. The offset of each map over
all views is taken out, since none was trained for this day.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.stats import kendalltau

from thermorender.apps.compare.machine import machine
from thermorender.apps.lands.procedural.procedural_scene import KINDS as KINDS_OF_LAND
from thermorender.apps.lands.procedural.procedural_scene import weather_of
from thermorender.apps.lands.procedural.three_d import SURVEY, make_world, write
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.output.photograph import photograph
from thermorender.physics.planck import band_radiance_derivative
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.scene.surface import SURFACE
from thermorender.trajectory.path import pose
from thermorender.versions import versions

ANGLES = (60.0, 45.0, 25.0, 10.0)
HOURS_UTC = (1, 4, 7, 10, 13, 16, 19, 22)
KINDS = ("façade", "roof", "crown", "near ground", "far ground", "small", "all")
MAPS = ("constant", "fok-1to1", "fok-9to1", "procedural-9to1", "procedural-palette", "procedural-trees",
        "procedural-pix2pix")  # fmt: skip
WORLDS = ("2.5-D", "3-D", "draped, judged by 3-D")
HEADER = ("angle [°]", "kind", "share of pixels", "mean absolute [K]", "RMS [K]", "mean [K]")
BUDGET_HEADER = ("angle [°]", "stated exceeds true", "true [mK]", "stated ÷ true")
_WALLS = ("brick_painted", "brick_clay", "glass", "wood")
_CROWNS = ("broadleaf", "conifer", "bark")
_ROOFS = ("roof_shingle", "roof_slate", "roof_rubber")
_DISTANCE_M, _NEAR_M, _WIDTH, _TEXEL_M, _POST_M = 90.0, 4.0, 160, 0.25, 0.5
# Rays per pixel of the true image; for this number of pixels with the largest errors so many times more.
_RAYS, _MOST, _TIMES = 64, 150, 16


def run(seeds=(401, 402, 403), views=3, size_m=90.0, maps=MAPS, progress=None, device="auto"):
    """Return errors of draped frames by angle and kind, rankings of maps, and stated against true sampling errors.

    Parameters
    ----------
    seeds : sequence of int
        Of the worlds.
    views : int
        Per world and angle, from directions and at points drawn from the seed.
    size_m : float
        Side of a world [m].
    maps : sequence of str
    progress : callable, optional
        Called with (step, share done).

    Raises
    ------
    ThermorenderError
        No seed or no view.
    """
    if not seeds or views < 1:
        raise ThermorenderError(f"seeds={tuple(seeds)}, views={views} are not allowed; give a seed and a view")
    errors, scores, covered = [], {name: [] for name in maps}, []
    with tempfile.TemporaryDirectory() as folder:
        for number, seed in enumerate(seeds):
            if progress:
                progress(f"world {seed}", number / len(seeds))
            made = write(make_world("village", seed, size_m, _TEXEL_M, _POST_M), Path(folder) / str(seed))
            draped, solid = (renderer_of(each, device) for each in (made / SURVEY, made))
            random = np.random.default_rng(seed)
            for angle in ANGLES:
                for _ in range(views):
                    at = drawn_pose(random, angle, size_m)
                    flat, true = draped.frame(at), solid.frame(at)
                    kinds = _kinds(solid, true, size_m)
                    errors.append((angle, flat.apparent_temperature - true.apparent_temperature, kinds))
                    pictures = [photograph(each, at)[0] for each in (draped, solid)]
                    for name in maps:
                        scores[name].append(_differences(name, pictures, (flat, true), kinds >= 0))
                    covered.append(coverage(angle, true, random))
    cases = [_case(errors, angle, kind) for angle in ANGLES for kind in range(len(KINDS))]
    return {
        "seeds": list(seeds), "views": views, "size_m": size_m, "cases": cases, "ranking": _ranking(scores),
        "budget": covered, "machine": machine(), "versions": versions(),
    }  # fmt: skip


def by_hour(hours=HOURS_UTC, seed=401, views=3, size_m=90.0, progress=None, device="auto"):
    """Return [{hour_utc, angle_deg, mae_k, mean_k}]: errors of draped frames of one world through its day.

    Parameters
    ----------
    hours : sequence of int
        UTC, which sun time is 1.4 h ahead of.
    seed, views, size_m, progress, device
        As of `run`; the views are the same at each hour.
    """
    found, day = [], str(KINDS_OF_LAND["village"].weather.time)[:10]
    for number, hour in enumerate(hours):
        if progress:
            progress(f"{hour} h UTC", number / len(hours))
        with tempfile.TemporaryDirectory() as folder:
            weather = weather_of("village", time=f"{day}T{hour:02d}:00Z")
            world = make_world("village", seed, size_m, _TEXEL_M, _POST_M, weather=weather)
            made = write(world, Path(folder) / "world")
            draped, solid = (renderer_of(each, device) for each in (made / SURVEY, made))
            random = np.random.default_rng(seed)
            for angle in ANGLES:
                error = []
                for _ in range(views):
                    at = drawn_pose(random, angle, size_m)
                    flat, true = draped.frame(at), solid.frame(at)
                    shown = _kinds(solid, true, size_m) >= 0
                    error.append((flat.apparent_temperature - true.apparent_temperature)[shown])
                joined = np.concatenate(error)
                found.append({"hour_utc": hour, "angle_deg": angle, "mae_k": float(np.nanmean(np.abs(joined))),
                              "mean_k": float(np.nanmean(joined))})  # fmt: skip
    return found


def hour_rows(found):
    """Return the errors by hour as table rows: hour, then the mean absolute error at each of `ANGLES` [K]."""
    return [(f"{hour}", *(f"{each['mae_k']:.2f}" for each in found if each["hour_utc"] == hour))
            for hour in dict.fromkeys(each["hour_utc"] for each in found)]  # fmt: skip


def rows(result):
    """Return the errors by angle and kind as table rows under HEADER."""
    return [
        (f"{case['angle_deg']:g}", case["kind"], f"{case['share']:.1%}", *(f"{case[key]:.2f}" for key in
         ("mae_k", "rms_k", "mean_k")))
        for case in result["cases"] if case["share"] > 0.0
    ]  # fmt: skip


def budget_rows(views):
    """Return stated and true errors of views by angle as table rows under BUDGET_HEADER."""
    found = []
    for angle in ANGLES:
        pairs = [(view["stated_mk"], view["true_mk"]) for view in views if view["angle_deg"] == angle]
        ratio = np.array([stated / max(true, 1e-9) for stated, true in pairs])
        true = [true for _, true in pairs]
        found.append((f"{angle:g}", f"{(ratio >= 1.0).sum()} of {len(ratio)}", f"{min(true):.0f}…{max(true):.0f}",
                      f"{ratio.min():.2f}…{ratio.max():.2f}"))  # fmt: skip
    return found


def ranking_rows(result):
    """Return the errors of the maps [K] as table rows: name, then one error per world of `WORLDS`."""
    return [(name, *(f"{result['ranking']['mae_k'][name][world]:.2f}" for world in WORLDS))
            for name in result["ranking"]["mae_k"]]  # fmt: skip


def renderer_of(scene, device, width=_WIDTH):
    """Return the Renderer of a scene, or of its folder, with the study's camera, `width` pixels wide."""
    scene = load_scene(scene) if isinstance(scene, Path) else scene
    wide = scene.camera.pixel_pitch_um * scene.camera.width / width
    camera = replace(scene.camera, width=width, height=width * 4 // 5, pixel_pitch_um=wide)
    return Renderer(scene.with_camera(camera), quality="standard", rays=128, device=device)


def drawn_pose(random, angle_deg, size_m):
    """Return a pose that looks down at an angle, at a point near the middle, from a drawn direction."""
    yaw = random.uniform(0.0, 360.0)
    target = np.array([*random.uniform(-0.15, 0.15, 2) * size_m, 1.0])
    return pose_at(target, angle_deg, yaw)


def pose_at(target, angle_deg, yaw_deg):
    """Return the pose that looks at a point (3,) [m] from the study's distance, down at an angle."""
    down, across = np.radians(angle_deg), np.radians(yaw_deg)
    ahead = np.array([np.sin(across) * np.cos(down), np.cos(across) * np.cos(down), -np.sin(down)])
    return pose(*(target - _DISTANCE_M * ahead), yaw_deg=yaw_deg, pitch_deg=-angle_deg)


def _kinds(renderer, frame, size_m):
    """Number of the kind of each pixel, (H, W) int, −1 beyond the surveyed square; KINDS[-1] is for all."""
    truth, names = frame.truth, [material.name for material in renderer.scene.materials]
    of = lambda chosen: np.isin(truth["material"], [k for k, name in enumerate(names) if name in chosen])  # noqa: E731
    surveyed = (np.abs(truth["position"][..., :2]) <= 0.5 * size_m).all(axis=-1)
    place = np.where(surveyed[..., None], truth["position"], np.nan)
    # Normals from neighbours' positions tell panels on roofs from windows.
    upright = _upright(place)
    wall, crown = of(_WALLS) & upright, of(_CROWNS)
    roof = of(_ROOFS) | (of(("glass",)) & ~upright)
    car = truth["object"] > 0
    kind = np.full(wall.shape, KINDS.index("far ground"))
    kind[_near(place, (wall | roof | crown) & ~car)] = KINDS.index("near ground")
    # Fences and garden objects are of wood, and low.
    small = car | (of(("wood",)) & ~upright)
    for name, mask in (("roof", roof), ("façade", wall), ("crown", crown), ("small", small)):
        kind[mask & (~car | (name == "small"))] = KINDS.index(name)
    kind[~surveyed | ((truth["mask"] & SURFACE) == 0)] = -1
    return kind


def _upright(place):
    """Whether the surface between neighbouring pixels' positions, (H, W, 3), is steeper than 60°."""
    down, right = np.gradient(place, axis=0), np.gradient(place, axis=1)
    normal = np.cross(down, right)
    with np.errstate(invalid="ignore"):
        return np.abs(normal[..., 2]) < 0.5 * np.linalg.norm(normal, axis=-1)


def _near(place, solid):
    """Whether pixels' positions are within `_NEAR_M` of positions of `solid` pixels in the plan."""
    known = np.isfinite(place).all(axis=-1)
    step = 0.5
    index = np.where(known[..., None], np.floor(place[..., :2] / step), 0.0).astype(int)
    low = index[known].min(axis=0)
    index = np.clip(index - low, 0, None)
    plan = np.ones(index[known].max(axis=0) + 1, bool)
    row, column = index[solid & known].T
    plan[row, column] = False
    away = step * distance_transform_edt(plan) if not plan.all() else np.full(plan.shape, np.inf)
    return known & (away[tuple(np.moveaxis(np.minimum(index, np.array(plan.shape) - 1), -1, 0))] < _NEAR_M)


def _case(errors, angle, kind):
    """Mean errors [K] of pixels of a kind at an angle, and their share."""
    here = [(error, kinds) for own, error, kinds in errors if own == angle]
    masks = [(kinds >= 0) if kind == len(KINDS) - 1 else kinds == kind for _, kinds in here]
    found = np.concatenate([error[mask & np.isfinite(error)] for (error, _), mask in zip(here, masks, strict=True)])
    count = sum(int((kinds >= 0).sum()) for _, kinds in here)
    values = {"mae_k": float(np.abs(found).mean()), "rms_k": float(np.sqrt((found**2).mean())),
              "mean_k": float(found.mean())} if found.size else {}  # fmt: skip
    return {"angle_deg": angle, "kind": KINDS[kind], "share": found.size / count, **values}


def _differences(name, pictures, frames, shown):
    """{world: (n,) errors [K]} of a map's translation of a view's photograph."""
    kelvin = []
    for picture, frame in zip(pictures, frames, strict=True):
        if name == "constant":
            kelvin.append(np.zeros(shown.shape))
            continue
        model = load_model(name)
        radiance = model.radiance(Inputs(picture, _DISTANCE_M / frame.camera.focal_length_px))
        kelvin.append(apparent_temperature(np.maximum(radiance, 1e-3), frame.camera.band_um))
    flat, true = (frame.apparent_temperature for frame in frames)
    pairs = zip(WORLDS, ((kelvin[0], flat), (kelvin[1], true), (kelvin[0], true)), strict=True)
    return {world: (given - reference)[shown].astype(float) for world, (given, reference) in pairs}


def _ranking(scores):
    """Mean absolute errors of the maps by world, without each map's mean offset there, and Kendall's τ to 3-D."""
    mae = {}
    for name, of_views in scores.items():
        joined = {world: np.concatenate([each[world] for each in of_views]) for world in WORLDS}
        mae[name] = {world: float(np.abs(each - np.median(each)).mean()) for world, each in joined.items()}
    order = {world: sorted(mae, key=lambda name, world=world: mae[name][world]) for world in WORLDS}
    places = {world: [order[world].index(name) for name in mae] for world in WORLDS}
    tau = {world: float(kendalltau(places[world], places["3-D"])[0]) for world in WORLDS}
    return {"mae_k": mae, "order": order, "tau": tau}


def coverage(angle, frame, random):
    """Return {angle_deg, stated_mk, true_mk}: an image's error and the true one of sampling, root mean squares."""
    tracer, flat = frame._view.tracer(), frame.radiance.ravel().astype(float)

    def squares(pixels, times):
        """Squared errors of pixels, without bias: the product of two independent errors has no noise of the rays."""
        exact = [np.mean([tracer.resampled(pixels, _RAYS, random)[0] for _ in range(times)], axis=0) for _ in range(2)]
        return np.prod([flat[pixels] - each for each in exact], axis=0)

    pixels = np.arange(flat.size)
    # A few pixels, as at a fire, may have most of the error; rays for them are found by rays of their own.
    most = np.argsort(np.abs(squares(pixels, 1)))[-_MOST:]
    square = squares(pixels, 1)
    square[most] = squares(most, _TIMES)
    per_mk = 1e-3 * band_radiance_derivative(300.0, *frame.camera.band_um)
    true = float(np.sqrt(max(square.mean(), 0.0)) / per_mk)
    return {"angle_deg": angle, "stated_mk": float(frame.budget_mk["image"]), "true_mk": true}
