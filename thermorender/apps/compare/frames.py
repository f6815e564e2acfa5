"""Rendered frames of the methods, kept on disk until all are scored, because all lit scenes do not fit in memory.

An interrupted comparison continues with the first unfinished method.
"""

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import formats
from thermorender.apps.compare.methods import Method
from thermorender.apps.compare.terms import Terms
from thermorender.apps.compare.view import Flight
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress
from thermorender.scene.scene import Scene
from thermorender.versions import versions


@contextmanager
def waiting(output: str | PathLike[str]) -> Iterator[Path]:
    """Give the folder beside an output that holds the frames until all are scored; the caller removes it then.

    It is removed when the comparison is refused, and remains for the same comparison after an interruption.
    """
    output = Path(output).resolve()
    place = output.with_name(f".{output.name}.frames")
    try:
        yield place
    except ThermorenderError as error:
        # An error of the operating system may be temporary, so the frames remain.
        if not isinstance(error.__cause__ or error.__context__, OSError):
            shutil.rmtree(place, ignore_errors=True)
        raise


class Frames:
    """The frames of one scene with true temperatures (`reference`) and with learned materials (`learned`).

    The `repr` of `settings` identifies all else that the frames depend on.
    """

    def __init__(self, folder: Path, flight: Flight, reference: Scene, learned: Scene | None, settings: object):
        scene = flight.scene
        # The scene's digest leaves out the weather where it gives the temperatures itself; maps and balances need it.
        weather = scene.weather_digest() if scene.spec.weather and scene.frame else None
        scenes = [each.digest() for each in (scene, reference, learned) if each is not None]
        state = hashlib.blake2b(repr((scenes, scene.time, weather, settings, versions())).encode(), digest_size=8)
        for values in (flight.times, flight.poses):
            state.update(np.ascontiguousarray(values).tobytes())
        self.folder, self._flight = folder / state.hexdigest(), flight
        self._places: dict[str, Path] = {}

    def rendered(
        self,
        method: Method,
        describe: Callable[[Method], dict[str, Any]],
        split: bool = False,
        report: Progress = lambda step, share: None,
    ) -> dict[str, Any]:
        """Render the missing frames of a Method, close its renderer, and return its facts.

        Facts are the plain values of `describe` (called while the scene is in memory); "once_s", the time for
        temperatures and light [s]; and "seconds" per frame. `split` also keeps the pictures of the terms.
        """
        place = self._place(method)
        path = place / "facts.json"
        kept = _kept(path)
        if kept and (kept["split"] or not split):
            return kept
        report(f"solving the light of {method.label}", 0.0)
        place.mkdir(parents=True, exist_ok=True)
        began = method.clock()
        renderer = method.renderer
        # Light is not part of a frame's time; that of tiles is where a frame first needs them.
        renderer.prepare()
        once_s, seconds = method.clock() - began, []
        terms = Terms(method) if split else None
        for index, (time_s, pose) in enumerate(zip(self._flight.times, self._flight.poses, strict=True)):
            report(f"rendering {method.label}", index / len(self._flight.times))
            began = time.perf_counter()
            renderer.prepare(pose)
            ready = time.perf_counter()
            radiance = renderer.radiance(pose, time_s, method.objects)
            once_s += ready - began
            seconds.append(time.perf_counter() - ready)
            np.save(place / f"{index:04d}.npy", radiance)
            if terms:
                np.save(place / f"{index:04d}_terms.npy", terms.pictures(pose, time_s))
        facts = {"once_s": once_s, "seconds": seconds, "split": split} | describe(method)
        method.close()
        facts["checksums"] = {frame.name: formats.checksum(frame) for frame in sorted(place.glob("*.npy"))}
        formats.write_json(path, formats.sealed(facts))
        return facts

    def radiance(self, method: Method, index: int) -> NDArray[np.float32]:
        """Return the band radiance of a Method's frame, (H, W) float32 [W m⁻² sr⁻¹]."""
        return self._load(method, f"{index:04d}.npy")

    def terms(self, method: Method, index: int) -> NDArray[np.float32]:
        """Return the pictures of a Method's terms, as `Terms.pictures` returns them."""
        return self._load(method, f"{index:04d}_terms.npy")

    def _load(self, method: Method, name: str) -> NDArray[np.float32]:
        values: NDArray[np.float32] = np.load(self._place(method) / name, allow_pickle=False)
        return values

    def _place(self, method: Method) -> Path:
        if method.label not in self._places:
            own = (method.label, sorted(method.kelvin.items()), method.model.digest() if method.model else None)
            self._places[method.label] = self.folder / hashlib.blake2b(repr(own).encode(), digest_size=8).hexdigest()
        return self._places[method.label]


def _kept(path: Path) -> dict[str, Any] | None:
    """Return the facts of kept frames, or None where the file or one of the frames is damaged or missing."""
    with suppress(OSError, ValueError):
        facts: dict[str, Any] = formats.unsealed(json.loads(path.read_text(encoding="utf-8")))
        if all(formats.checksum(path.with_name(name)) == known for name, known in facts["checksums"].items()):
            return facts
    return None
