"""Search for a map's training pictures in the pictures that it is applied to or tested on."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.training.kept_searches import kept
from thermorender.apps.training.translate import VIDEOS, UnreadableError, first_frame, read_picture, sources_of
from thermorender.files import PathLike
from thermorender.learned.fingerprints import Seen, search
from thermorender.learned.temperature_map import TemperatureMap
from thermorender.progress import Progress

# Most pictures that are searched, evenly spaced over the given ones.
MOST_SEARCHED = 200
_MOST_NAMED = 5


@dataclass(frozen=True)
class Search:
    """Result of a search for a map's training pictures."""

    model: TemperatureMap
    # given, searched: Number of pictures, and of those that were searched
    given: int
    searched: int = 0
    found: dict[str, Seen] = field(default_factory=dict)  # Pictures that show training pictures, by name
    # Names of pictures that could not be read, which are not among the searched ones
    unreadable: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The result as one sentence."""
        model, prints = self.model, self.model.fingerprints
        if prints is None:
            stated = model.about.get("training_pictures", model.source)
            return (
                f"what this map was trained on is unknown: the file of {model.name!r} has no fingerprints of training "
                f"pictures and states only {stated!r}"
            )
        limits = [f"{self.searched} of {self.given} pictures searched"] if self.searched < self.given else []
        if self.unreadable:
            limits.append(f"{len(self.unreadable)} could not be read: {_listed(self.unreadable)}")
        if len(prints) < prints.pictures:
            limits.append(f"fingerprints of {len(prints)} of {prints.pictures} training pictures")
        limited = f" ({'; '.join(limits)})" if limits else ""
        if not self.searched:
            return (
                f"map {model.name!r} was trained on {prints.pictures} pictures, and none was searched for them{limited}"
            )
        if not self.found:
            return (
                f"map {model.name!r} was trained on {prints.pictures} pictures, and none of the {self.searched} "
                f"shows one of them{limited}"
            )
        return (
            f"map {model.name!r} was trained on {len(self.found)} of these {self.searched} pictures or parts of "
            f"them{limited}: {_listed(list(self.found))}; its results on them measure memory"
        )

    def summary(self) -> dict[str, Any]:
        """Return the result as plain values for JSON."""
        prints = self.model.fingerprints
        return {
            "line": self.line, "training_pictures": None if prints is None else prints.pictures,
            "fingerprints": 0 if prints is None else len(prints), "given": self.given, "searched": self.searched,
            "unreadable": list(self.unreadable), "found": {name: asdict(seen) for name, seen in self.found.items()},
        }  # fmt: skip


def _listed(names: Sequence[str]) -> str:
    rest = f" and {len(names) - _MOST_NAMED} others" if len(names) > _MOST_NAMED else ""
    return ", ".join(names[:_MOST_NAMED]) + rest


def search_in(
    model: TemperatureMap, names: Sequence[str], read: Callable[[int], NDArray[np.uint8] | None],
    progress: Callable[[float], object] | None = None,
) -> Search:  # fmt: skip
    """Return the Search for a map's training pictures in named pictures; `progress` takes the share done.

    `read` maps the number of a name to its picture, (h, w, 3) uint8, or None where it cannot be read.
    """
    if model.fingerprints is None or not names:
        return Search(model, len(names))
    chosen = np.unique(np.linspace(0, len(names) - 1, min(len(names), MOST_SEARCHED)).round()).astype(int)
    searched, unreadable = [], []

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for number in map(int, chosen):
            if (picture := read(number)) is None:
                unreadable.append(names[number])
            else:
                searched.append(names[number])
                yield picture

    seen = search(
        model.fingerprints, pictures(),
        lambda done: progress((done + len(unreadable)) / len(chosen)) if progress else None,
    )  # fmt: skip
    found = {name: one for name, one in zip(searched, seen, strict=True) if one is not None}
    return Search(model, len(names), len(searched), found, tuple(unreadable))


def searches_in(
    models: Sequence[TemperatureMap], names: Sequence[str], read: Callable[[int], NDArray[np.uint8] | None],
    progress: Progress | None = None, digest: str | None = None,
) -> list[Search]:  # fmt: skip
    """Return the Search of each map; maps of the same training pictures share one.

    `digest` is a fingerprint of the pictures, by which later runs find the result in the cache; without one, the result
    is not kept. `progress` takes (step, share done).
    """
    report, found = progress or (lambda step, share: None), dict[str, Search]()
    searches = []
    for model in models:
        prints = model.fingerprints
        state = repr(None if prints is None else (prints.rows.tobytes(), prints.pictures))
        key = hashlib.blake2b(state.encode(), digest_size=20).hexdigest()

        def searched(model: TemperatureMap = model) -> dict[str, Any]:
            step = f"searching training pictures of {model.name}"
            return search_in(model, names, read, partial(report, step)).summary()

        if key not in found:
            own = searched() if digest is None or prints is None else kept(("pictures", key, digest), searched)
            seen = {name: Seen(**each) for name, each in own["found"].items()}
            found[key] = Search(model, own["given"], own["searched"], seen, tuple(own["unreadable"]))
        searches.append(replace(found[key], model=model))
    return searches


def search_in_files(
    model: TemperatureMap, paths: Sequence[PathLike], progress: Callable[[float], object] | None = None
) -> Search:
    """Return the Search for training pictures in pictures, first frames of videos, or folders of them."""
    files = sources_of(paths)

    def read(number: int) -> NDArray[np.uint8] | None:
        path = files[number]
        try:
            return first_frame(path) if path.suffix.lower() in VIDEOS else read_picture(path)[0]
        except UnreadableError:
            return None

    return search_in(model, [path.name for path in files], read, progress)
