"""Frames that are kept until all methods are scored."""

from dataclasses import replace

import numpy as np
import pytest
from compare_support import errors, flight, uniform_map

import thermorender as tr
from scenes import WEATHER, write_balance
from thermorender.apps.compare import (
    frames,
    methods,
    trial,
)
from thermorender.apps.compare.comparison import Options, compare
from thermorender.apps.compare.view import Flight
from thermorender.errors import ThermorenderError
from thermorender.scene.spec import TemperatureSpec


def test_kept_frames_have_unique_names():
    found = trial.array_names(["B a.b", "B a b", "known"])
    assert list(found.values()) == ["B_a_b", "B_a_b_2", "known_2"]


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [None, "facts.json", "0000.npy"])
def test_an_interrupted_comparison_continues_with_the_missing_frames(ground, tmp_path, monkeypatch, damaged):
    level = uniform_map(tmp_path / "level.npz", 0.5)
    whole = compare([flight(ground)], tmp_path / "whole", [level], Options(settings={"rays": 8}))
    plain, lit = frames.Frames.rendered, []

    def stopped(self, method, *rest):
        if len(lit) == 1:
            raise KeyboardInterrupt
        lit.append(method.label)
        return plain(self, method, *rest)

    monkeypatch.setattr(frames.Frames, "rendered", stopped)
    with pytest.raises(KeyboardInterrupt):
        compare([flight(ground)], tmp_path / "c", [level], Options(settings={"rays": 8}))
    assert not (tmp_path / "c").exists() and (tmp_path / ".c.frames").is_dir()
    monkeypatch.setattr(frames.Frames, "rendered", plain)
    for path in (tmp_path / ".c.frames").glob(f"*/*/{damaged}"):
        # One number is another.
        path.write_bytes(path.read_bytes()[:-40] + b"7" + path.read_bytes()[-39:])
    built = []
    plain_of = methods.renderer_of
    monkeypatch.setattr(methods, "renderer_of", lambda *given, **more: built.append(1) or plain_of(*given, **more))
    found = compare([flight(ground)], tmp_path / "c", [level], Options(settings={"rays": 8}))
    rendered = [label for label in found["methods"] if "as kelvin" in label]
    assert len(rendered) == 2 and len(built) == (2 if damaged else 1)
    for label in found["methods"]:
        assert errors(found, label) == errors(whole, label)
    assert not (tmp_path / ".c.frames").exists()


def test_kept_frames_depend_on_hour_weather_truth_and_materials(tmp_path):
    scene = tr.load_scene(write_balance(tmp_path / "s", WEATHER))
    scene = scene.with_temperature(TemperatureSpec(source="constant", value=290.0))
    one = Flight(scene, np.zeros(1), np.eye(4)[None])
    places = [
        frames.Frames(tmp_path, each, truth, learned, {}).folder
        for each, truth, learned in (
            (one, scene, None),
            (replace(one, scene=scene.with_weather(cloud=0.9)), scene, None),
            (replace(one, scene=scene.at(scene.time + np.timedelta64(3, "h"))), scene, None),
            (one, scene.with_temperature(TemperatureSpec(source="constant", value=291.0)), None),
            (one, scene, scene),
            (replace(one, times=np.ones(1)), scene, None),
        )
    ]
    assert len(set(places)) == len(places)


def test_kept_frames_outlive_a_full_disk_but_not_a_refusal(tmp_path):
    for error, kept in ((OSError("no space"), True), (None, False)):
        with pytest.raises(ThermorenderError), frames.waiting(tmp_path / "c") as place:
            place.mkdir(exist_ok=True)
            raise ThermorenderError("a sentence") from error
        assert place.is_dir() == kept
