"""Errors of a method, summed over views: by view, scene, ground block and class, with structure and similarity.

An error is the apparent temperature of a method minus that of the reference. Errors are correlated within a pose, a
piece of ground and an hour. The bootstrap therefore draws poses and blocks of ground together, or whole scenes; the
wider interval counts. It holds for other poses over the one scene, or, for several scenes, for other lands, hours and
weathers like these.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare import sums
from thermorender.apps.compare.classes import GROUND, PixelClasses
from thermorender.apps.compare.ground_intervals import Cells, interval
from thermorender.apps.compare.sums import Sums
from thermorender.apps.compare.view import View

RADIOMETRIC, SENSOR = "radiometric", "sensor"
STAGES = (RADIOMETRIC, SENSOR)


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
        """Return {"gain" (slope of s on t), "correlation", "explained"}, or None where a temperature is constant.

        `explained` is the share of the square error about each pose's mean that this slope explains.
        """
        own, both, true = self.moments
        if not own > 0.0 or not true > 0.0:
            return None
        gain, error = both / true, own - 2.0 * both + true
        explained = (1.0 - gain) ** 2 * true / error if error > 1e-12 * true else 0.0
        return {"gain": gain, "correlation": both / np.sqrt(own * true), "explained": explained}


@dataclass
class Tally:
    """Errors of a method over views; tallies of workers are merged."""

    # Sums of each view by (stage, part): "ground", "with objects" and "objects"
    views: dict[tuple[str, str], list[Sums]] = field(default_factory=dict)
    groups: dict[tuple[str, str, str], Sums] = field(default_factory=dict)  # By (stage, grouping, class)
    cells: list[Cells] = field(default_factory=list)  # Ground before the sensor, of each view
    structure: list[NDArray[np.float64]] = field(default_factory=list)  # `structure.row` of each view
    similarity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))  # Σ of `structure.Similarity.row`

    def add(
        self, view: View, stage: str, classes: PixelClasses, error: NDArray[np.float64], scene: str = "", land: str = ""
    ) -> list[tuple[str, str, Sums]]:
        """Add the error (n,) of a View's known pixels [K]; return its rows [(surface, material, (5,) sums)]."""
        found = classes.sums(error)
        by_surface = found.reshape(len(classes.surfaces), -1, sums.WIDTH).sum(axis=1)
        parts = {GROUND: by_surface[0], "objects": by_surface[1:].sum(axis=0), "with objects": by_surface.sum(axis=0)}
        for part, row in parts.items():
            self.views.setdefault((stage, part), []).append(row)
        materials = found.sum(axis=tuple(range(2, found.ndim - 1)))
        for number in np.flatnonzero(materials[..., 0].any(axis=0) | materials[..., 4].any(axis=0)).tolist():
            self.into((stage, "material", _material(view, number)), materials[:, number].sum(axis=0))
        for axis, (grouping, names) in enumerate(classes.groupings.items(), 2):
            rest = tuple(k for k in range(found.ndim - 1) if k != axis)
            for name, row in zip(names, found.sum(axis=rest), strict=True):
                if row.any():
                    self.into((stage, grouping, name), row)
        for name, row in zip(classes.surfaces, by_surface, strict=True):
            if row.any():
                self.into((stage, "surface", name), row)
        if scene:
            self.into((stage, "scene", scene), parts[GROUND])
        if stage == RADIOMETRIC:
            cells = classes.cells(error, land)
            self.cells += [] if cells is None else [cells]
        used = np.argwhere(materials.any(axis=-1)).tolist()
        return [(classes.surfaces[s], _material(view, m), materials[s, m]) for s, m in used]

    def into(self, key: tuple[str, str, str], row: Sums) -> None:
        """Add a row to the group (stage, grouping, class)."""
        sums.into(self.groups, key, row)

    def merge(self, other: "Tally") -> None:
        """Add the views of another Tally after those of this one."""
        for key, rows in other.views.items():
            self.views.setdefault(key, []).extend(rows)
        for name, row in other.groups.items():
            sums.into(self.groups, name, row)
        self.cells += other.cells
        self.structure += other.structure
        self.similarity += other.similarity

    def of(self, stage: str, grouping: str) -> dict[str, Sums]:
        """Return {class: sums} of a grouping."""
        return {name: row for (at, what, name), row in self.groups.items() if (at, what) == (stage, grouping)}

    def summary(self, seed: int) -> dict[str, dict[str, Any]]:
        """Return {stage: {part: statistics with intervals}}, as plain numbers."""
        found_of: dict[str, dict[str, Any]] = {stage: {} for stage in STAGES}
        for (stage, part), rows in self.views.items():
            own = np.array(rows)
            found = sums.summary(own.sum(axis=0))
            if found["pixels"]:
                blocks = interval(self.cells, seed) if (stage, part) == (RADIOMETRIC, GROUND) else None
                known = {"poses and ground blocks": blocks} if blocks and blocks["me_k"] else {}
                drawn: dict[str, Sequence[Sums] | Sums] = {} if known else {"poses": own}
                if part == GROUND:
                    drawn["scenes"] = list(self.of(stage, "scene").values())
                found |= sums.widest(drawn, found["sd_k"], seed, known)
                found |= {"blocks": blocks["blocks"]} if blocks else {}
            found_of[stage][part] = found
        return found_of

    def more_than(self, other: "Tally", seed: int) -> dict[str, Any] | None:
        """Return the mean absolute error on ground minus that of another Tally, noise-free; None if it lacks scenes.

        Keys: "mae_k", "interval_95", "own_mae_k", "other_mae_k". The bootstrap draws the other's scenes, the same for
        both, or the poses of a single scene.
        """
        mine, theirs = ({scene: row for scene, row in each.of(RADIOMETRIC, "scene").items() if row[0]}
                        for each in (self, other))  # fmt: skip
        if not theirs or not set(theirs) <= set(mine):
            return None
        rows = [[each[name] for name in theirs] for each in (theirs, mine)]
        if len(theirs) == 1 and len(mine) == 1:
            rows = [each.views[RADIOMETRIC, GROUND] for each in (other, self)]
        ((_, error, ends),) = sums.differences(rows, [[0], [1]], np.arange(len(rows[0])), seed)
        own, limit = (sums.summary(np.sum(each, axis=0))["mae_k"] for each in reversed(rows))
        return {"mae_k": error, "interval_95": ends, "own_mae_k": own, "other_mae_k": limit}

    def grouped(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return {stage: {grouping: {class: statistics}}}, as plain numbers."""
        found: dict[str, dict[str, dict[str, Any]]] = {}
        for (stage, grouping, name), row in self.groups.items():
            found.setdefault(stage, {}).setdefault(grouping, {})[name] = sums.summary(row)
        return found


def _material(view: View, number: int) -> str:
    return view.material_names[number] if number < len(view.material_names) else "none"
