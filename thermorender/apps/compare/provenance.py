"""Provenance of maps: whether training used the scene under test, and whether the map made the reference itself."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.training import duplicates
from thermorender.apps.training.dataset import Dataset
from thermorender.apps.training.training_pictures import searches_in
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import TemperatureMap
from thermorender.scene.scene import Scene

# A map made the reference if their kinetic temperatures agree to this mean difference [K]; the errors of other maps are
# tens of times larger.
_SAME_K = 0.1
# Number of photographs per scene to search for, and of training pictures to search in.
PHOTOGRAPHS, _PICTURES = 6, 2000


@dataclass
class Provenance:
    """Provenance of one map."""

    header: dict[str, Any]  # What its file records of its training
    audited: str = "not audited"  # The pictures that its training was compared with, in words
    leaks: list[str] = field(default_factory=list)  # Sentences; empty where no leak was found


def provenance_of(model: TemperatureMap) -> Provenance:
    """Return the Provenance of a TemperatureMap, from its file alone."""
    about = model.about
    dataset = about.get("dataset", {})
    header = {
        "method": model.method, "source": model.source, "data set": dataset.get("name"),
        "origin": dataset.get("origin"), "pairs": about.get("pairs"), "sequences": about.get("sequences"),
        "training_s": about.get("training_s"), "texel_m": model.texel_range_m and list(model.texel_range_m),
    }  # fmt: skip
    return Provenance(header)


def search_fingerprints(
    found: Sequence[Provenance], models: Sequence[TemperatureMap], scenes: Mapping[str, Sequence[NDArray[np.uint8]]]
) -> None:
    """Search photographs {scene: sequence of (H, W, 3)} for the training pictures of maps, by their fingerprints."""
    named = [(f"{scene} {number}", rgb) for scene, own in scenes.items() for number, rgb in enumerate(own, 1)]
    searches = searches_in(models, [name for name, _ in named], lambda number: named[number][1])
    for own, search in zip(found, searches, strict=True):
        own.audited = search.line
        if search.found:
            own.leaks.append(search.line)


class TrainingPictures:
    """Sketches of a data set's training pictures, in which photographs of a scene are searched."""

    def __init__(self, dataset: Dataset, progress: Callable[[float], object] | None = None) -> None:
        self.name = dataset.card.get("name")
        entries = [entry for entry in dataset.entries if entry.part != "test"]
        step = max(1, -(-len(entries) // _PICTURES))
        self.entries, self.of_all = entries[::step], len(entries)
        self._sketches = []
        for number, entry in enumerate(self.entries):
            self._sketches.append(duplicates.sketch(dataset.pair(entry, truth=False).visible))
            if progress:
                progress((number + 1) / len(self.entries))

    def audit(self, provenance: Provenance, scenes: Mapping[str, Sequence[NDArray[np.uint8]]]) -> None:
        """Search photographs {scene: sequence of (H, W, 3)} among the pictures, and add leaks to a Provenance."""
        pairs = sum((provenance.header["pairs"] or {}).values())
        if pairs > self.of_all:
            provenance.audited += (
                f"; not audited: it was trained on {pairs} pairs of a data set called {self.name!r}, and the one "
                f"given has {self.of_all}"
            )
            return
        photographs = sum(map(len, scenes.values()))
        provenance.audited += (
            f"; {photographs} photograph{'s' * (photographs != 1)} of the test compared by content with "
            f"{len(self.entries)} of {self.of_all} pictures of {self.name!r}"
        )
        for scene, pictures in scenes.items():
            found = duplicates.find([duplicates.sketch(picture) for picture in pictures], self._sketches)
            hits = [(self.entries[match.index].key, match.correlation) for match in found if match is not None]
            if hits:
                key, correlation = max(hits, key=lambda hit: hit[1])
                provenance.leaks.append(
                    f"training has seen {scene}: {len(hits)} of {len(pictures)} photographs match training "
                    f"pictures, such as {key!r} (correlation {correlation:.2f})"
                )


def circular(rendered: Scene, truth: Scene) -> str | None:
    """Return a sentence if the reference has a rendered method's own solved temperatures, else None."""
    apart, count = 0.0, 0
    for own, true in zip(rendered.surfaces[: rendered.terrain_count], truth.surfaces, strict=False):
        both = np.isfinite(own.temperature) & np.isfinite(true.temperature)
        apart += float(np.abs(own.temperature[both] - true.temperature[both]).sum(dtype=np.float64))
        count += int(both.sum())
    if not count or apart / count > _SAME_K:
        return None
    return (
        f"circular: the reference of {truth.name} equals this method's own temperature to {1e3 * apart / count:.0f} "
        "mK, so its error is meaningless"
    )


def matched(datasets: Sequence[TrainingPictures], model: TemperatureMap) -> TrainingPictures | None:
    """Return the TrainingPictures that a map names as its training data, or None."""
    name = model.about.get("dataset", {}).get("name")
    found = [each for each in datasets if each.name == name]
    if len(found) > 1:
        raise ThermorenderError(f"two data sets are called {name!r}; give the one that the maps were trained on")
    return found[0] if found else None
