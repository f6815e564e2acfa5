"""What was trained on what: whether a map has seen the scene under test, or has made the reference itself."""

from dataclasses import dataclass, field

import numpy as np

from thermorender.campaign import duplicates
from thermorender.errors import ThermorenderError

# The reference is the map's own where its kinetic temperatures agree so well on average [K]: a map that did not make
# the truth errs by tens of times as much.
_SAME_K = 0.1
# Photographs of a scene that are looked for among training pictures, and training pictures that are looked at.
PHOTOGRAPHS, _PICTURES = 6, 2000


@dataclass
class Provenance:
    """What is known of one map.

    Attributes
    ----------
    told : dict
        What its file says of its training.
    audited : str
        Against what its training was held, in words.
    leaks : list of str
        Sentences; empty where none was found.
    """

    told: dict
    audited: str = "not audited: its training pictures are not at hand"
    leaks: list = field(default_factory=list)


def provenance_of(model):
    """Return the Provenance of a TemperatureMap, from its file alone."""
    about = model.about
    dataset = about.get("dataset", {})
    told = {
        "method": model.method, "source": model.source, "data set": dataset.get("name"),
        "origin": dataset.get("origin"), "pairs": about.get("pairs"), "sequences": about.get("sequences"),
        "training_s": about.get("training_s"), "texel_m": list(model.texel_range_m),
    }  # fmt: skip
    return Provenance(told)


class TrainingPictures:
    """The training pictures of a data set, sketched once, to look for photographs of a scene in.

    Parameters
    ----------
    dataset : Dataset
    progress : callable, optional
        Called with the share done.
    """

    def __init__(self, dataset, progress=None):
        self.name = dataset.card.get("name")
        entries = [entry for entry in dataset.entries if entry.part != "test"]
        step = max(1, -(-len(entries) // _PICTURES))
        self.entries, self.of_all = entries[::step], len(entries)
        self._sketches = []
        for number, entry in enumerate(self.entries):
            self._sketches.append(duplicates.sketch(dataset.pair(entry, truth=False).visible))
            if progress:
                progress((number + 1) / len(self.entries))

    def audit(self, provenance, scenes):
        """Look for photographs {scene: sequence of (H, W, 3)} among the pictures, and tell a Provenance."""
        pairs = sum((provenance.told["pairs"] or {}).values())
        if pairs > self.of_all:
            provenance.audited = (
                f"not audited: it was trained on {pairs} pairs of a data set called {self.name!r}, and the one given "
                f"has {self.of_all}"
            )
            return
        provenance.audited = (
            f"{sum(len(pictures) for pictures in scenes.values())} photographs of the test held against "
            f"{len(self.entries)} of {self.of_all} pictures of {self.name!r} by content"
        )
        for scene, pictures in scenes.items():
            found = duplicates.find([duplicates.sketch(picture) for picture in pictures], self._sketches)
            hits = [(self.entries[match.index].key, match.correlation) for match in found if match is not None]
            if hits:
                key, correlation = max(hits, key=lambda hit: hit[1])
                provenance.leaks.append(
                    f"training has seen {scene}: {len(hits)} of {len(pictures)} photographs of it show what training "
                    f"pictures show, such as {key!r} (correlation {correlation:.2f})"
                )


def circular(rendered, truth):
    """Return a sentence where the reference's temperatures are a rendered method's own, else None.

    Parameters
    ----------
    rendered, truth : Scene
        Of the same texels, temperatures solved.
    """
    apart, count = 0.0, 0
    for own, true in zip(rendered.surfaces[: rendered.terrain_count], truth.surfaces, strict=False):
        both = np.isfinite(own.temperature) & np.isfinite(true.temperature)
        apart += float(np.abs(own.temperature[both] - true.temperature[both]).sum(dtype=np.float64))
        count += int(both.sum())
    if not count or apart / count > _SAME_K:
        return None
    return (
        f"circular: the reference of {truth.name} is this method's own temperature to {1e3 * apart / count:.0f} mK, so "
        "its error says nothing"
    )


def matched(datasets, model):
    """Return the TrainingPictures among several that a map names as its training, or None.

    Raises
    ------
    ThermorenderError
        Two data sets of one name.
    """
    name = model.about.get("dataset", {}).get("name")
    found = [each for each in datasets if each.name == name]
    if len(found) > 1:
        raise ThermorenderError(f"two data sets are called {name!r}; give the one that the maps were trained on")
    return found[0] if found else None
