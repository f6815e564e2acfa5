"""Shares of heights and slopes on each surface of procedural land, for `learned.emissivity.elevation`.

Run it as `python -m validation.emissivity.relief`.
"""

import numpy as np

from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.learned.emissivity import elevation
from thermorender.learned.emissivity.kinds import kinds_of

LANDS = (("village", 101), ("village", 102), ("village", 103), ("heath", 101), ("heath", 102))


def shares(scenes):
    """Return {surface: share of each case (9,)} over procedural scenes.

    Materials of a single surface count, each of each scene with the square root of its area.
    """
    import cv2

    found = {}
    for scene in scenes:
        above, slope = elevation.above_ground(scene.elevation.astype(np.float64), scene.post_m)
        case = elevation.case_of(*(cv2.resize(each, scene.classes.shape, interpolation=cv2.INTER_LINEAR)
                                for each in (above, slope)))  # fmt: skip
        for value, name in scene.class_names.items():
            surfaces = {elevation.SURFACES[kind] for kind in kinds_of(name) if kind in elevation.SURFACES}
            count = np.bincount(case[scene.classes == value], minlength=elevation.CASES + 1)[1:]
            if len(surfaces) == 1 and count.any():
                found.setdefault(surfaces.pop(), []).append(count / np.sqrt(count.sum()))
    return {surface: np.sum(counts, axis=0) / np.sum(counts) for surface, counts in found.items()}


if __name__ == "__main__":
    for surface, share in shares(make(*land) for land in LANDS).items():
        print(surface, share.round(4).tolist())
