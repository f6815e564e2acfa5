"""Packed weights in files: exact multiples of their steps, and small."""

import json
from pathlib import Path

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.networks.packing import packed, unpacked
from thermorender.learned.temperature_map import SHIPPED, Inputs, load_map, load_model

HERE = Path(__file__).resolve().parents[1]
TERRAIN = (
    "above_m", "normal_east", "normal_north", "normal_up", "sky_view", "sunlight", "sunlight_1h", "sunlight_4h",
    "sunlight_16h",
)  # fmt: skip


def weights(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def test_weights_come_back_as_the_nearest_multiples_of_their_steps():
    state = {"a": weights(40, 60), "b": weights(30, 20, 3, 3, seed=1)}
    # One byte each for one, two bytes for the other.
    steps = {"a": 0.05, "b": 0.001}
    codes, table = packed(state, steps)
    found = unpacked(codes, table)
    for name, step in steps.items():
        assert found[name].shape == state[name].shape and found[name].dtype == np.float32
        assert np.abs(found[name] - state[name]).max() <= 0.5001 * step
    again, _ = packed(found, steps)
    assert np.array_equal(again, codes)
    # A Gaussian spread over that many steps takes log2(σ / step) + 2.05 bits a weight; the Huffman code adds little.
    alone, _ = packed({"a": weights(400, 600)}, {"a": 0.05})
    assert 8.0 * alone.size / 240_000 == pytest.approx(np.log2(20.0) + 2.05, rel=0.02)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda codes, table: (codes[:-9], table), "not those of its table"),
        (lambda codes, table: (codes, [["a", [50, 61], 1, 0.05]]), "not those of its table"),
        (lambda codes, table: (codes, [["a", [50, 60], 3, 0.05]]), "table of weights is none"),
        (lambda codes, table: (codes, [["a", [50, -60], 1, 0.05]]), "table of weights is none"),
        (lambda codes, table: (codes, [["a", [50, 60], 1, float("inf")]]), "table of weights is none"),
        (lambda codes, table: (codes, [["a", [1 << 20, 1 << 20], 1, 0.05]]), "more than a network holds"),
    ],
)
def test_a_table_that_does_not_belong_to_the_codes_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        unpacked(*change(*packed({"a": weights(50, 60)}, {"a": 0.05})))


@pytest.mark.parametrize("name", ["procedural-compact+", "procedural-pix2pix"])
def test_shipped_networks_give_what_their_weights_in_half_precision_gave(name):
    """Pieces of the shipped scenes' orthophotos: 20 mK on average, as the shipped files were packed to keep."""
    with np.load(HERE / "data" / "shipped_networks.npz") as stored:
        arrays = dict(stored)
    model, changes = load_model(name), []
    for scene, facts in json.loads(str(arrays["about"])).items():
        terrain = {plane: arrays[f"{scene} {plane}"].astype(np.float32) for plane in TERRAIN}
        inputs = Inputs(arrays[f"{scene} rgb"], facts["texel_m"], terrain, facts["conditions"])
        before = 200.0 + 1e-3 * arrays[f"{scene} {name}"]
        changes.append(np.abs(apparent_temperature(model.radiance(inputs), model.band_um) - before).mean())
    # Packed they are, and not without change.
    assert model.predictor.steps and 1e-3 < np.mean(changes) <= 0.02


def test_a_damaged_packed_network_is_refused_in_a_sentence(tmp_path):
    with np.load(SHIPPED["procedural-pix2pix"]) as stored:
        arrays = dict(stored)
    arrays["packed"] = arrays["packed"][:-1000]
    # Without its digest, as maps of earlier versions are.
    header = json.loads(str(arrays["header"]))
    del header["digest"]
    arrays["header"] = np.array(json.dumps(header))
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(
        ThermorenderError, match=r"m\.npz is not a learned map of format 1 \(its weights are not those of"
    ):
        load_map(tmp_path / "m.npz")
