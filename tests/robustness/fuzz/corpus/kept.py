"""Files that the package writes and reads itself: data sets, trainings, flights, translations, results, caches."""

import json
import shutil
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.robustness.fuzz.corpus.registry import reader
from thermorender import formats
from thermorender.defaults import TEMPERATURE_MAPS
from thermorender.errors import ThermorenderError

_CARD = {"name": "made", "origin": "made", "licence": "CC0"}


@contextmanager
def _copied(folder):
    """Yield a copy of a folder, which is removed afterwards."""
    with TemporaryDirectory() as place:
        yield Path(shutil.copytree(folder, Path(place) / "copy"))


# --- data sets --------------------------------------------------------------------------------------------------


def _write_dataset(folder):
    from thermorender.apps.training.dataset import Entry, ThermalScale
    from thermorender.apps.training.dataset_writer import Writer, packed

    generator, shape = np.random.default_rng(0), (24, 32)
    writer = Writer(folder, _CARD, ThermalScale("kelvin", 0.01, 0.0))
    pairs = []
    for number, part in enumerate(("train", "train", "validation", "test")):
        entry = Entry(f"a-{number}", part, f"a-{number}", "a", number, shape, 0.2, (49.0, 8.0), "2018-07-28T12:00:00Z",
                      250.0, {"air_k": 290.0, "sun_elevation_deg": 40.0}, {"kind": "made"})  # fmt: skip
        visible = generator.integers(0, 255, (*shape, 3)).astype(np.uint8)
        thermal = generator.integers(28000, 31000, shape).astype(np.uint16)
        truth = {"radiance": generator.uniform(30.0, 50.0, shape), "material": np.ones(shape, np.uint8)}
        pairs.append((entry, packed(visible, thermal, visible[..., 0] > 20, truth)))
    writer.shard("a", pairs)


def _of_dataset(path):
    """Read a data set, and continue a copy of it."""
    from thermorender.apps.training.dataset import read_dataset
    from thermorender.apps.training.dataset_writer import Writer

    folder = path.parents[path.parent.name == "shards"]
    found = read_dataset(folder)
    pairs = [(pair.entry, pair.visible, pair.radiance, pair.valid) for pair in found.pairs()]
    with _copied(folder) as copy:
        Writer(copy, _CARD, found.scale, resume=True)
        read_dataset(copy)
    return found.card, pairs


for _name in ("card.json", "index.jsonl"):
    reader(f"data set's {_name}", _name, lambda path: _write_dataset(path.parent))(_of_dataset)
reader("data set's shard", "shards/a.tar", lambda path: _write_dataset(path.parents[1]))(_of_dataset)


# --- trainings --------------------------------------------------------------------------------------------------


def _write_training(folder):
    settings = {"method": "compact", "seed": 0, "options": {"width": 8, "batch": 2}, "examples": [12, "x"]}
    formats.write_json(folder / "settings.json", settings)
    (folder / "log.jsonl").write_text("".join(
        json.dumps({"crops": 100 * k, "seconds": 2.5 * k, "core_seconds": 5.0 * k, "losses": {"l1": 1.0 / k},
                    "validation_mae_k": 3.0 / k}) + "\n"
        for k in range(1, 9)
    ))  # fmt: skip


def _of_training(path):
    from validation.trainings import study as trainings

    found = trainings.run([path.parent])
    return found, trainings.rows(found)


for _name in ("settings.json", "log.jsonl"):
    reader(f"training's {_name}", _name, lambda path: _write_training(path.parent))(_of_training)


# --- continued jobs: they must end as they would have, or be refused ------------------------------------------------


def _finished(folder, go_on, whole):
    """Continue in a copy of a folder; a result that differs from the complete one is an error."""
    with _copied(folder) as copy:
        go_on(copy)
        found = _contents(copy)
    if found != whole:
        raise AssertionError("what was gone on with is not what it would have been")
    return len(found)


def _contents(folder):
    """{name: bytes} of pictures and of the records of frames."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix == ".png" or path.stem == "frames"}


@cache
def _renderer():
    from tests.robustness.crash_targets import renderer, write_scene

    with TemporaryDirectory() as folder:
        # A flight records the name of its scene.
        return renderer(write_scene(Path(folder) / "scene"))


class _StoppedError(Exception):
    """The end of a flight before its last frame."""


def _fly(folder, frames=3):
    """Hover for three small frames, or continue with those whose files are unchanged, up to some number."""
    from thermorender.output.flight import FlightOptions, fly
    from thermorender.trajectory.path import Trajectory

    def look(done, total):
        if done == frames < total:
            raise _StoppedError

    down = np.array([[0.0, 1.0, 0.0, 0.0]] * 2)
    path = Trajectory(np.array([0.0, 2.0 / 9.0]), np.array([[0.0, 0.0, 20.0]] * 2), down)
    with suppress(_StoppedError):
        fly(_renderer(), path, folder, FlightOptions(rate_hz=9.0, products=("counts",)), verify=True, progress=look)


@cache
def _flown():
    with TemporaryDirectory() as folder:
        _fly(Path(folder))
        return _contents(Path(folder))


def _of_flight(path):
    return _finished(path.parent, _fly, _flown())


for _name in ("flight.json", "frames.jsonl", "sensor_odd.npz", "frame_000001_counts.png"):
    reader(f"flight's {_name}", _name, lambda path: _fly(path.parent, frames=2))(_of_flight)


def _translate(photographs, folder, count=2):
    from thermorender.apps.training.translate import translate
    from thermorender.learned.temperature_map import load_model

    model = load_model(TEMPERATURE_MAPS[0])
    translate(model, [photographs / f"{number}.png" for number in range(count)], folder, resume=True)


def _write_translation(path):
    """Translate one of two photographs."""
    generator, place = np.random.default_rng(0), path.parent / "photographs"
    place.mkdir()
    for number in range(2):
        formats.write_image(place / f"{number}.png", generator.integers(0, 255, (12, 16, 3)).astype(np.uint8))
    _translate(place, path.parent, 1)


@cache
def _translated(photographs):
    with TemporaryDirectory() as folder:
        _translate(photographs, Path(folder))
        return _contents(Path(folder))


def _of_translation(path):
    place = path.with_name("photographs")
    return _finished(path.parent, partial(_translate, place), _translated(place))


for _name in ("translate.json", "translated.jsonl"):
    reader(f"translation's {_name}", _name, _write_translation)(_of_translation)


@reader("kept arrays", "kept.npz", lambda path: formats.write_arrays(path, 7, _ARRAYS))
def _arrays(path):
    found = formats.read_arrays(path, 7)
    if found is None:
        raise ThermorenderError("they are computed again")
    if any(not np.array_equal(found[name], values) for name, values in _ARRAYS.items()):
        raise AssertionError("damaged arrays were taken for whole")
    return found


_ARRAYS = {"power": np.arange(60.0).reshape(3, 20), "count": np.array([3]), "name": np.array("a")}


# --- results of studies -----------------------------------------------------------------------------------------


def _write_result(path):
    case = {"group": "air", "name": "made", "expected_k": 290.0, "found_k": 290.0, "error_k": 1e-6,
            "tolerance_k": 1e-5, "passed": True, "seconds": 0.1, "raised": None}  # fmt: skip
    machine = {"processor": "made", "cores": 2, "memory_gib": 24.0, "system": "Linux"}
    formats.write_json(path, {"machine": machine, "versions": {}, "seconds": 1.0, "failed": 0, "cases": [case] * 3})


@reader("study's result", "stability/stability.json", _write_result)
def _result(path):
    from validation.verdicts import gathered

    # Missing numbers are NaN.
    return [(each.scene, each.holds) for _, verdicts, _ in gathered(path.parents[1]) for each in verdicts or ()]
