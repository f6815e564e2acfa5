"""Stated against true sampling errors of oblique views of a scene that `import-terrain --three-d` made.

A procedural village is surveyed from above, and its surface model and orthophoto are imported as a user's would be:
buildings and trees are found by height. The heat balance under the village's weather gives the temperatures, so that
walls, roofs and crowns differ. The true error of a view is that of `study.coverage`.
"""

import tempfile
from pathlib import Path

import numpy as np

from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.lands.procedural.three_d import SURVEY, make_world, write
from thermorender.scene.load import load_scene
from thermorender.versions import versions
from validation.three_d import study

_TEXEL_M, _POST_M = 0.25, 0.5


def run(seed=401, views=2, size_m=60.0, device="auto"):
    """Return {seed, size_m, buildings, trees, views, versions}; each view has its angle, stated and true error [mK].

    Parameters
    ----------
    seed : int
        Of the village, and of the directions and points of view.
    views : int
        Per angle.
    size_m : float
        Side of the village [m].
    """
    with tempfile.TemporaryDirectory() as folder:
        made = write(make_world("village", seed, size_m, _TEXEL_M, _POST_M), Path(folder) / "world") / SURVEY
        found = import_terrain(
            made / "elevation.tif", made / "orthophoto.tif", Path(folder) / "imported",
            ImportSettings(height_reference="ellipsoid"), ThreeD(),
        )  # fmt: skip
        weather = load_scene(made).spec.weather
        scene = load_scene(Path(folder) / "imported").with_weather(weather).with_temperature("balance")
        scene = scene.with_objects({each.name: "balance" for each in scene.spec.objects})
        renderer = study.renderer_of(scene, device)
        random = np.random.default_rng(seed)
        seen = []
        for angle in study.ANGLES:
            for _ in range(views):
                frame = renderer.frame(study.drawn_pose(random, angle, size_m))
                seen.append(study.coverage(angle, frame, random))
    return {"seed": seed, "size_m": size_m, "buildings": found["buildings"], "trees": found["trees"], "views": seen,
            "versions": versions()}  # fmt: skip
