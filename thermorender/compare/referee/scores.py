"""Errors of methods as sums that add up: by pose, material, object, range, view angle and edges, and by ground block.

An error is the apparent temperature that a method gives less the reference's. Pixels of one pose err alike, so does one
piece of ground in every pose that sees it, and so do all poses of one hour; intervals of means are therefore those of
whole poses, of whole blocks of ground, or where there are several of whole scenes drawn with replacement, whichever are
widest (Künsch 1989, doi:10.1214/aos/1176347265, for the blocks). Of one scene they tell what other poses over it would
bring, of many what other lands, hours and weathers like these would.
"""

from dataclasses import dataclass, field

import numpy as np

from thermorender.campaign.map_inputs import NO_MATERIAL
from thermorender.compare.evaluation import paired, sums
from thermorender.compare.evaluation.classes import EDGES, edge_class

RADIOMETRIC, SENSOR = "radiometric", "sensor"
STAGES = (RADIOMETRIC, SENSOR)
GROUND = "ground"
# Limits of the classes of range [m] and of the angle between line of sight and plumb line [deg].
RANGES_M = (50.0, 100.0, 200.0, 400.0, 800.0)
ANGLES_DEG = (15.0, 30.0, 45.0, 60.0, 75.0)
# A land is cut into so many blocks a side.
BLOCKS = 8


def class_names(limits, unit):
    """Return the names of the classes between limits: "below 50 m", "50–100 m", …, "above 800 m"."""
    inner = [f"{low:g}–{high:g} {unit}" for low, high in zip(limits[:-1], limits[1:], strict=True)]
    return [f"below {limits[0]:g} {unit}", *inner, f"above {limits[-1]:g} {unit}"]


CLASSES = {
    "edges": list(EDGES),
    "range": class_names(RANGES_M, "m"),
    "view angle": class_names(ANGLES_DEG, "°"),
}


class PixelClasses:
    """Which classes the known pixels of a View belong to, as flat numbers.

    Parameters
    ----------
    view : View
    objects : sequence of str
        Names of the scene's objects.
    corners : (2, 2) array
        Lowest and highest east and north of the terrain [m].
    """

    def __init__(self, view, objects, corners):
        known = view.known
        self.known, self.surfaces = known, [GROUND, *objects]
        surface = view.object[known] + 1
        offset = view.position[known] - view.pose[:3, 3].astype(np.float32)
        distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-6)
        slant = np.degrees(np.arccos(np.clip(-offset[:, 2] / distance, -1.0, 1.0)))
        parts = (
            edge_class(np.where(known, view.truth, np.nan))[known], np.digitize(distance, RANGES_M),
            np.digitize(slant, ANGLES_DEG),
        )  # fmt: skip
        self._shape = (len(self.surfaces), NO_MATERIAL + 1, *(len(names) for names in CLASSES.values()))
        self._flat = np.ravel_multi_index((surface, view.material[known], *parts), self._shape)
        low, high = np.asarray(corners, np.float64)
        cell = (view.position[known][:, :2] - low) / np.maximum(high - low, 1e-9) * BLOCKS
        cell = np.clip(cell.astype(int), 0, BLOCKS - 1)
        self._block = np.where(surface == 0, cell[:, 1] * BLOCKS + cell[:, 0], BLOCKS * BLOCKS)

    def sums(self, error):
        """Return the rows of sums of an error (n,) of the known pixels [K]: (surface, material, …classes, 5)."""
        size = int(np.prod(self._shape))
        return sums.rows_by(error, self._flat, size).reshape(*self._shape, sums.WIDTH)

    def block_sums(self, error):
        """Return the rows of sums of the ground's blocks, (BLOCKS², 5)."""
        return sums.rows_by(error, self._block, BLOCKS * BLOCKS + 1)[:-1]


@dataclass
class Gain:
    """How much of the reference's contrast a method shows on the ground, over all poses.

    Attributes
    ----------
    moments : (3,) array
        Σs², Σst, Σt² of what it shows (s) and what is true (t) [K²], each less its mean over the pose: an offset of a
        pose or of a scene is no contrast.
    """

    moments: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def add(self, seen, truth):
        """Add the apparent temperatures (n,) of a pose's ground [K]."""
        both = np.isfinite(seen) & np.isfinite(truth)
        if both.any():
            own, true = (values[both].astype(np.float64) for values in (seen, truth))
            own, true = own - own.mean(), true - true.mean()
            self.moments += (own @ own, own @ true, true @ true)

    def summary(self):
        """Return {"gain", "correlation", "explained"} or None where nothing varies.

        The gain is the slope of s on t by least squares, `explained` the share of the square error about each pose's
        mean that this slope alone takes away.
        """
        own, both, true = self.moments
        if not own > 0.0 or not true > 0.0:
            return None
        gain, error = both / true, own - 2.0 * both + true
        explained = (1.0 - gain) ** 2 * true / error if error > 1e-12 * true else 0.0
        return {"gain": gain, "correlation": both / np.sqrt(own * true), "explained": explained}


@dataclass
class Tally:
    """What a method errs, over all scenes.

    Attributes
    ----------
    poses : dict of (stage, part) to list of (5,) array
        Sums of each pose; parts are "ground", "with objects" and "objects".
    blocks : dict of (land, block) to (5,) array
        Of the ground, radiometric.
    groups : dict of (stage, grouping, class) to (5,) array
        Of ground and objects.
    scenes : dict of (stage, scene) to (5,) array
        Of ground.
    """

    poses: dict = field(default_factory=dict)
    blocks: dict = field(default_factory=dict)
    groups: dict = field(default_factory=dict)
    scenes: dict = field(default_factory=dict)

    def add(self, scene, land, view, stage, classes, error):
        """Add the error (n,) of a View's known pixels; return its rows: [(surface, material, (5,) sums)]."""
        found = classes.sums(error)
        by_surface = found.reshape(len(classes.surfaces), -1, sums.WIDTH).sum(axis=1)
        parts = {GROUND: by_surface[0], "objects": by_surface[1:].sum(axis=0), "with objects": by_surface.sum(axis=0)}
        for part, row in parts.items():
            self.poses.setdefault((stage, part), []).append(row)
        _into(self.scenes, (stage, scene), parts["ground"])
        materials = found.sum(axis=(2, 3, 4))
        for number in np.flatnonzero(materials[..., 0].any(axis=0) | materials[..., 4].any(axis=0)):
            _into(self.groups, (stage, "material", _material(view, number)), materials[:, number].sum(axis=0))
        for axis, (grouping, names) in enumerate(CLASSES.items()):
            rest = tuple(k for k in range(5) if k != axis + 2)
            for name, row in zip(names, found.sum(axis=rest), strict=True):
                if row.any():
                    _into(self.groups, (stage, grouping, name), row)
        for name, row in zip(classes.surfaces, by_surface, strict=True):
            if row.any():
                _into(self.groups, (stage, "surface", name), row)
        if stage == RADIOMETRIC:
            for number, row in enumerate(classes.block_sums(error)):
                if row[0]:
                    _into(self.blocks, (land, number), row)
        used = np.argwhere(materials.any(axis=-1))
        return [(classes.surfaces[s], _material(view, m), materials[s, m]) for s, m in used]

    def summary(self, seed):
        """Return {stage: {part: statistics}}, plain numbers; of the ground, radiometric, with intervals."""
        told = {stage: {} for stage in STAGES}
        for (stage, part), rows in self.poses.items():
            own = np.array(rows)
            found = sums.summary(own.sum(axis=0))
            if found["pixels"]:
                drawn = {"poses": own}
                if part == GROUND:
                    drawn["scenes"] = self._of_scenes(stage)
                    drawn |= {"ground blocks": list(self.blocks.values())} if stage == RADIOMETRIC else {}
                found |= intervals(drawn, found["sd_k"], seed)
            told[stage][part] = found
        return told

    def _of_scenes(self, stage):
        return [row for (own, _), row in self.scenes.items() if own == stage]

    def more_than(self, other, seed):
        """Return by how much this errs more than another Tally on ground, noise-free, as {"mae_k", "interval_95",
        "own_mae_k", "other_mae_k"}; None where it lacks a scene of the other's.

        The other's scenes are drawn anew, the same for both; of a single one its poses.
        """
        mine, theirs = ({scene: row for (stage, scene), row in each.scenes.items() if stage == RADIOMETRIC and row[0]}
                        for each in (self, other))  # fmt: skip
        if not theirs or not set(theirs) <= set(mine):
            return None
        rows = [[each[name] for name in theirs] for each in (theirs, mine)]
        if len(theirs) == 1 and len(mine) == 1:
            rows = [each.poses[RADIOMETRIC, GROUND] for each in (other, self)]
        ((_, error, ends),) = paired.differences(rows, [[0], [1]], np.arange(len(rows[0])), seed)
        own, limit = (sums.summary(np.sum(each, axis=0))["mae_k"] for each in reversed(rows))
        return {"mae_k": error, "interval_95": ends, "own_mae_k": own, "other_mae_k": limit}

    def grouped(self):
        """Return {stage: {grouping: {class: statistics}}}, plain numbers."""
        told = {}
        for (stage, grouping, name), row in self.groups.items():
            told.setdefault(stage, {}).setdefault(grouping, {})[name] = sums.summary(row)
        for (stage, name), row in self.scenes.items():
            told.setdefault(stage, {}).setdefault("scene", {})[name] = sums.summary(row)
        return told


def intervals(drawn, sd_k, seed):
    """Return {interval_95: {me_k, mae_k}, drawn, effective_pixels}: those of what is drawn, the widest.

    Parameters
    ----------
    drawn : dict of str to sequence of (5,) arrays
        Sums of each that is drawn, by what they are.
    sd_k : float
        Standard deviation of single pixels [K].
    seed : int

    Notes
    -----
    The effective number of pixels is (σ / standard error of the mean error)²: so many independent pixels would tell the
    mean as well.
    """
    found = []
    for what, rows in drawn.items():
        rows = np.asarray(rows, float)
        if len(rows) and (rows[:, 0] > 0).sum() > 1:
            found.append((what, sums.intervals(rows, np.arange(len(rows)), seed)))
    if not found:
        return {"interval_95": {"me_k": None, "mae_k": None}, "drawn": None, "effective_pixels": None}
    # Each statistic by itself: errors of either sign wander in the mean, and not in the mean absolute error.
    ends = {name: max((each[name] for _, each in found), key=np.ptp) for name in ("me_k", "mae_k")}
    what = next(what for what, each in found if each["me_k"] == ends["me_k"])
    # A normal law's 95 % are 3.92 standard errors wide.
    width = float(np.ptp(ends["me_k"]))
    effective = (sd_k / (width / 3.92)) ** 2 if width > 0.0 else None
    return {"interval_95": ends, "drawn": what, "effective_pixels": effective}


def _into(where, key, row):
    where[key] = where[key] + row if key in where else row.copy()


def _material(view, number):
    return view.material_names[number] if number < len(view.material_names) else "none"
