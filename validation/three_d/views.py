"""Stated against true errors of whole frames in three dimensions: views drawn over the shipped worlds and an import.

The true error of a frame is its difference from one of the same scene with four times the rays of the bake, other
random numbers, and many rays a pixel. That one's own error is in it, so it is rather too large. What both share is
not in it: shapes of crowns, single leaves, materials, temperatures; so the stated error is that without `leaves`.
"""

import tempfile
from pathlib import Path

import numpy as np

from thermorender import defaults
from thermorender.apps.compare.machine import machine
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.lands.procedural.three_d import SURVEY
from thermorender.paths import data_folder
from thermorender.physics.planck import band_radiance_derivative
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.scene.surface import SURFACE
from thermorender.versions import versions
from validation.three_d.study import renderer_of

# Hours besides the scene's own, in hours from it: night and dawn.
HOURS = (0, -10, -8)
HEADER = ("scene", "views", "stated ≥ true", "true [mK]", "stated ÷ true, least", "median")
_RAYS, _MORE, _SAMPLES = 128, 4, 16
# Angles below the horizon [deg] and heights above the ground [m] are drawn between these.
_ANGLES, _HEIGHTS_M = (5.0, 90.0), (25.0, 250.0)


def run(views=40, seed=0, known=(), keep=None, progress=None, device="auto"):
    """Return {seed, views: [{scene, hour_h, angle_deg, height_m, stated_mk, true_mk}], machine, versions}.

    Parameters
    ----------
    views : int
        In all, over three scenes and an import at three hours each.
    seed : int
        Of the views.
    known : sequence of such views
        Of an earlier run of this seed, which are not measured again.
    keep : callable, optional
        Called with what is returned, after each scene and hour.
    progress : callable, optional
        Called with (step, share done).
    """
    # In the order of the views: five numbers each, whether a view is known or not.
    drawn, found = iter(np.random.default_rng(seed).random((views, 5))), list(known)
    done = {(view["scene"], view["hour_h"]) for view in found}

    def record():
        return {"seed": seed, "views": found, "machine": machine(), "versions": versions()}

    with tempfile.TemporaryDirectory() as folder:
        for number, scene in enumerate(_scenes(Path(folder))):
            counts = [len(part) for part in np.array_split(np.arange(views), 4 * len(HOURS))]
            for turn, hour in enumerate(HOURS):
                places = [next(drawn) for _ in range(counts[number * len(HOURS) + turn])]
                if (scene.name, hour) in done:
                    continue
                if progress:
                    progress(f"{scene.name}, {hour:+d} h", (number + turn / len(HOURS)) / 4)
                now = scene.with_temperature("balance").at(scene.time + np.timedelta64(hour, "h")) if hour else scene
                renderer = renderer_of(now, device)
                more = {"rays": _MORE * _RAYS, "samples": _SAMPLES, "seed": 1}
                like = Renderer(renderer.scene, quality="high", device=device, **more)
                found += [{"scene": scene.name, "hour_h": hour} | _view(renderer, like, place) for place in places]
                if keep:
                    keep(record())
    return record()


def _scenes(folder):
    """The shipped scenes, and the survey of the village as a user would import it."""
    for name in defaults.SCENES:
        yield load_scene(name)
    survey = data_folder("scenes") / "village" / SURVEY
    import_terrain(survey / "elevation.tif", survey / "orthophoto.tif", folder / "imported",
                   ImportSettings(height_reference="ellipsoid"), ThreeD())  # fmt: skip
    scene = load_scene(folder / "imported").with_weather(load_scene(survey).spec.weather).with_temperature("balance")
    yield scene.with_objects({each.name: "balance" for each in scene.spec.objects})


def _view(renderer, reference, place):
    """Stated and true error of a view [mK], from where five numbers in 0…1 place it."""
    reach = 0.3 * float(np.ptp(renderer.scene.main_surface.vertices[:, 0]))
    bounds = np.array([_ANGLES, np.log(_HEIGHTS_M), (-reach, reach), (-reach, reach), (0.0, 360.0)]).T
    angle, height, east, north, yaw = (bounds[0] + (bounds[1] - bounds[0]) * place).tolist()
    height = float(np.exp(height))
    at = renderer.scene.pose(east, north, height, yaw_deg=yaw, pitch_deg=-angle)
    frame = renderer.frame(at)
    surface = (frame.truth["mask"] & SURFACE) > 0
    error = (frame.radiance.astype(float) - reference.frame(at).radiance)[surface]
    per_mk = 1e-3 * band_radiance_derivative(300.0, *frame.camera.band_um)
    stated = np.sqrt(frame.budget_mk["total"] ** 2 - frame.budget_mk.get("leaves", 0.0) ** 2)
    return {"angle_deg": angle, "height_m": float(height), "stated_mk": float(stated),
            "true_mk": float(np.sqrt((error**2).mean()) / per_mk)}  # fmt: skip


def rows(result):
    """Return the views by scene as table rows under HEADER."""
    made = []
    for name in dict.fromkeys(view["scene"] for view in result["views"]):
        own = [view for view in result["views"] if view["scene"] == name]
        ratio = np.array([view["stated_mk"] / view["true_mk"] for view in own])
        true = [view["true_mk"] for view in own]
        made.append((name, len(own), int((ratio >= 1.0).sum()), f"{min(true):.0f}…{max(true):.0f}",
                     f"{ratio.min():.2f}", f"{np.median(ratio):.2f}"))  # fmt: skip
    return made
