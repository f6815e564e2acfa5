"""Errors of methods as sums: by pose, material, object, range, view angle and edges, and by ground block.

An error is the apparent temperature of a method minus that of the reference. Errors of pixels are correlated within a
pose, within a piece of ground over all poses, and within an hour. The bootstrap therefore draws whole poses, whole
blocks of ground (Künsch 1989, doi:10.1214/aos/1176347265), or whole scenes where there are several; the widest interval
counts. For one scene the intervals hold for other poses over it; for several, for other lands, hours and weathers like
these.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.compare.evaluation import paired, sums
from thermorender.apps.compare.evaluation.classes import EDGES, edge_class
from thermorender.apps.compare.referee.views import View
from thermorender.apps.training.map_inputs import NO_MATERIAL

Sums = NDArray[np.float64]

RADIOMETRIC, SENSOR = "radiometric", "sensor"
STAGES = (RADIOMETRIC, SENSOR)
GROUND = "ground"
# Class limits of range [m] and of the angle between the line of sight and the vertical [deg].
RANGES_M = (50.0, 100.0, 200.0, 400.0, 800.0)
ANGLES_DEG = (15.0, 30.0, 45.0, 60.0, 75.0)
# Ground blocks per side of a land.
BLOCKS = 8


def class_names(limits: Sequence[float], unit: str) -> list[str]:
    """Return the names of the classes between limits: "below 50 m", "50–100 m", …, "above 800 m"."""
    inner = [f"{low:g}–{high:g} {unit}" for low, high in zip(limits[:-1], limits[1:], strict=True)]
    return [f"below {limits[0]:g} {unit}", *inner, f"above {limits[-1]:g} {unit}"]


CLASSES = {
    "edges": list(EDGES),
    "range": class_names(RANGES_M, "m"),
    "view angle": class_names(ANGLES_DEG, "°"),
}


class PixelClasses:
    """Classes of the known pixels of a View, as flat numbers.

    Parameters
    ----------
    view : View
        With a reference.
    objects : sequence of str
        Names of the scene's objects.
    corners : (2, 2) array
        Lowest and highest east and north of the terrain [m].
    """

    def __init__(self, view: View, objects: Sequence[str], corners: ArrayLike) -> None:
        assert view.truth is not None
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

    def sums(self, error: NDArray[np.float64]) -> Sums:
        """Return the sums of an error (n,) of the known pixels [K]: (surface, material, …classes, 5)."""
        size = int(np.prod(self._shape))
        return sums.rows_by(error, self._flat, size).reshape(*self._shape, sums.WIDTH)

    def block_sums(self, error: NDArray[np.float64]) -> Sums:
        """Return the sums of the ground blocks, (BLOCKS², 5)."""
        return sums.rows_by(error, self._block, BLOCKS * BLOCKS + 1)[:-1]


@dataclass
class Gain:
    """The share of the reference's contrast that a method shows on the ground, over all poses."""

    # (3,) σs², Σst, Σt² of the method's (s) and the true (t) temperature minus their means over the pose [K²]: an
    # offset of a pose is not contrast
    moments: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def add(self, seen: NDArray[np.floating], truth: NDArray[np.floating]) -> None:
        """Add the apparent temperatures (n,) of a pose's ground [K]."""
        both = np.isfinite(seen) & np.isfinite(truth)
        if both.any():
            own, true = (values[both].astype(np.float64) for values in (seen, truth))
            own, true = own - own.mean(), true - true.mean()
            self.moments += [own @ own, own @ true, true @ true]

    def summary(self) -> dict[str, float] | None:
        """Return {"gain", "correlation", "explained"}, or None where a temperature is constant.

        The gain is the least-squares slope of s on t. `explained` is the share of the square error about each pose's
        mean that this slope explains.
        """
        own, both, true = self.moments
        if not own > 0.0 or not true > 0.0:
            return None
        gain, error = both / true, own - 2.0 * both + true
        explained = (1.0 - gain) ** 2 * true / error if error > 1e-12 * true else 0.0
        return {"gain": gain, "correlation": both / np.sqrt(own * true), "explained": explained}


@dataclass
class Tally:
    """Errors of a method over all scenes."""

    # Sums of each pose; parts are "ground", "with objects" and "objects"
    poses: dict[tuple[str, str], list[Sums]] = field(default_factory=dict)
    blocks: dict[tuple[str, int], Sums] = field(default_factory=dict)  # Sums of the ground, radiometric
    groups: dict[tuple[str, str, str], Sums] = field(default_factory=dict)  # Sums of ground and objects
    scenes: dict[tuple[str, str], Sums] = field(default_factory=dict)  # Sums of the ground

    def add(
        self, scene: str, land: str, view: View, stage: str, classes: PixelClasses, error: NDArray[np.float64]
    ) -> list[tuple[str, str, Sums]]:
        """Add the error (n,) of a View's known pixels [K]; return its rows [(surface, material, (5,) sums)]."""
        found = classes.sums(error)
        by_surface = found.reshape(len(classes.surfaces), -1, sums.WIDTH).sum(axis=1)
        parts = {GROUND: by_surface[0], "objects": by_surface[1:].sum(axis=0), "with objects": by_surface.sum(axis=0)}
        for part, row in parts.items():
            self.poses.setdefault((stage, part), []).append(row)
        _into(self.scenes, (stage, scene), parts["ground"])
        materials = found.sum(axis=(2, 3, 4))
        for number in np.flatnonzero(materials[..., 0].any(axis=0) | materials[..., 4].any(axis=0)).tolist():
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
        used = np.argwhere(materials.any(axis=-1)).tolist()
        return [(classes.surfaces[s], _material(view, m), materials[s, m]) for s, m in used]

    def summary(self, seed: int) -> dict[str, dict[str, Any]]:
        """Return {stage: {part: statistics with intervals}}, as plain numbers."""
        found_of: dict[str, dict[str, Any]] = {stage: {} for stage in STAGES}
        for (stage, part), rows in self.poses.items():
            own = np.array(rows)
            found = sums.summary(own.sum(axis=0))
            if found["pixels"]:
                drawn: dict[str, Sequence[Sums] | Sums] = {"poses": own}
                if part == GROUND:
                    drawn["scenes"] = [row for (at, _), row in self.scenes.items() if at == stage]
                    if stage == RADIOMETRIC:
                        drawn["ground blocks"] = list(self.blocks.values())
                found |= intervals(drawn, found["sd_k"], seed)
            found_of[stage][part] = found
        return found_of

    def more_than(self, other: "Tally", seed: int) -> dict[str, Any] | None:
        """Return the mean absolute error on ground minus that of another Tally, noise-free, as {"mae_k", "interval_95",
        "own_mae_k", "other_mae_k"}; None if this one lacks a scene of the other.

        The bootstrap draws the other's scenes, the same for both, or the poses of a single scene.
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

    def grouped(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return {stage: {grouping: {class: statistics}}}, as plain numbers."""
        found: dict[str, dict[str, dict[str, Any]]] = {}
        for (stage, grouping, name), row in self.groups.items():
            found.setdefault(stage, {}).setdefault(grouping, {})[name] = sums.summary(row)
        for (stage, name), row in self.scenes.items():
            found.setdefault(stage, {}).setdefault("scene", {})[name] = sums.summary(row)
        return found


def intervals(drawn: Mapping[str, Sequence[Sums] | Sums], sd_k: float, seed: int) -> dict[str, Any]:
    """Return {interval_95: {me_k, mae_k}, drawn, effective_pixels}, the widest intervals of all units drawn.

    Parameters
    ----------
    drawn : dict of str to sequence of (5,) arrays
        Sums of each unit of the bootstrap, by the name of the unit.
    sd_k : float
        Standard deviation of single pixels [K].
    seed : int

    Notes
    -----
    The effective number of pixels is (σ / standard error of the mean error)²: the number of independent pixels with
    the same standard error.
    """
    found: list[tuple[str, dict[str, Any]]] = []
    for what, units in drawn.items():
        rows = np.asarray(units, float)
        if len(rows) and (rows[:, 0] > 0).sum() > 1:
            found.append((what, sums.intervals(rows, np.arange(len(rows)), seed)))
    if not found:
        return {"interval_95": {"me_k": None, "mae_k": None}, "drawn": None, "effective_pixels": None}
    # The widest of each statistic: the mean may vary with the unit when the mean absolute error does not.
    ends = {name: max((each[name] for _, each in found), key=np.ptp) for name in ("me_k", "mae_k")}
    what = next(what for what, each in found if each["me_k"] == ends["me_k"])
    # The 95 % interval of a normal distribution is 3.92 standard errors wide.
    width = float(np.ptp(ends["me_k"]))
    effective = (sd_k / (width / 3.92)) ** 2 if width > 0.0 else None
    return {"interval_95": ends, "drawn": what, "effective_pixels": effective}


def _into(where: dict[Any, Sums], key: object, row: Sums) -> None:
    where[key] = where[key] + row if key in where else row.copy()


def _material(view: View, number: int) -> str:
    return view.material_names[number] if number < len(view.material_names) else "none"
