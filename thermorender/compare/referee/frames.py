"""Rendered frames of methods, made one method after the other and kept on disk until all are scored.

The lit scenes of all methods at once do not fit an ordinary machine's memory, and a comparison that was stopped goes on
with the first method that was not finished.
"""

import hashlib
import json
import shutil
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from thermorender import formats
from thermorender.compare.referee.terms import Terms
from thermorender.errors import ThermorenderError
from thermorender.versions import versions


@contextmanager
def waiting(output):
    """Give the folder beside an output in which frames wait until all are scored and it is removed.

    A comparison that is refused takes it with it; a kill, a full disk or an interruption leaves it, and the same
    comparison goes on from there.
    """
    output = Path(output).resolve()
    place = output.with_name(f".{output.name}.frames")
    try:
        yield place
    except ThermorenderError as error:
        # What the system refuses it may grant another time.
        if not isinstance(error.__cause__ or error.__context__, OSError):
            shutil.rmtree(place, ignore_errors=True)
        raise


class Frames:
    """The frames of one scene.

    Parameters
    ----------
    folder : Path
        Where frames of any scenes are kept.
    flight : Flight
    reference, learned : Scene or None
        The scene at its true temperatures, and with learned materials.
    asked : object
        All else that frames depend on, told by its `repr`.
    """

    def __init__(self, folder, flight, reference, learned, asked):
        scene = flight.scene
        # A scene with temperatures of its own does not depend on its weather; maps and balances of it do.
        weather = scene.weather_digest() if scene.spec.weather and scene.frame else None
        scenes = [each.digest() for each in (scene, reference, learned) if each is not None]
        state = hashlib.blake2b(repr((scenes, scene.time, weather, asked, versions())).encode(), digest_size=8)
        for values in (flight.times, flight.poses):
            state.update(np.ascontiguousarray(values).tobytes())
        self._folder, self._flight, self._places = folder / state.hexdigest(), flight, {}

    def rendered(self, method, describe, split=False, say=None):
        """Render a Method's frames where they are not there yet, let go of its renderer, and return what is told of it.

        Parameters
        ----------
        method : Method
            A rendered one.
        describe : callable
            (Method) → dict of plain values, asked while its scene is there.
        split : bool
            Whether the pictures of its terms are kept, too.
        say : callable, optional
            Called with (what, share done).

        Returns
        -------
        dict
            As by `describe`, and "once_s", what making its temperatures and solving its light took [s], and "seconds",
            of each frame.
        """
        place = self._place(method)
        facts = place / "facts.json"
        told = _kept(facts)
        if told and (told["split"] or not split):
            return told
        say = say or (lambda what, share: None)
        say(f"solving the light of {method.label}", 0.0)
        place.mkdir(parents=True, exist_ok=True)
        began = method.clock()
        renderer = method.renderer
        # Once for a scene, and so not part of a frame's time.
        _ = renderer.baked
        told = {"once_s": method.clock() - began, "seconds": [], "split": split}
        terms = Terms(method) if split else None
        for index, (time_s, pose) in enumerate(zip(self._flight.times, self._flight.poses, strict=True)):
            say(f"rendering {method.label}", index / len(self._flight.times))
            began = time.perf_counter()
            radiance = renderer.radiance(pose, time_s, method.objects)
            told["seconds"].append(time.perf_counter() - began)
            np.save(place / f"{index:04d}.npy", radiance)
            if terms:
                np.save(place / f"{index:04d}_terms.npy", terms.pictures(pose, time_s))
        told |= describe(method)
        method.close()
        told["checksums"] = {path.name: formats.checksum(path) for path in sorted(place.glob("*.npy"))}
        formats.write_json(facts, formats.sealed(told))
        return told

    def radiance(self, method, index):
        """Return the band radiance of a Method's frame, (H, W) float32 [W m⁻² sr⁻¹]."""
        return np.load(self._place(method) / f"{index:04d}.npy", allow_pickle=False)

    def terms(self, method, index):
        """Return the pictures of a Method's terms, as by `Terms.pictures`."""
        return np.load(self._place(method) / f"{index:04d}_terms.npy", allow_pickle=False)

    def _place(self, method):
        if method.label not in self._places:
            own = (method.label, sorted(method.kelvin.items()), method.model.digest() if method.model else None)
            self._places[method.label] = self._folder / hashlib.blake2b(repr(own).encode(), digest_size=8).hexdigest()
        return self._places[method.label]


def _kept(facts):
    """What is told of frames that wait, or None where it or one of them is damaged or missing."""
    with suppress(OSError, ValueError):
        told = formats.unsealed(json.loads(facts.read_text(encoding="utf-8")))
        if all(formats.checksum(facts.with_name(name)) == known for name, known in told["checksums"].items()):
            return told
    return None
