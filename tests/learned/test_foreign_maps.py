"""Learned maps from others: damaged, hostile or wrong files are refused in one sentence, without running code."""

import io
import json
import zipfile

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.learned.linear import names_of_columns
from thermorender.learned.pixel_features import NAMES
from thermorender.learned.rows import ExtraInputs
from thermorender.learned.temperature_map import Inputs, load_map
from thermorender.learned.trees import Trees

HEADER = {
    "format": 1, "predictor": "correlation", "name": "m", "method": "x", "range_k": [280.0, 300.0],
    "band_um": [7.5, 13.5], "texel_m": 0.5, "texel_range_m": [0.4, 0.6], "camera": "c", "sky_temperature": 250.0,
    "source": "s", "trained": None, "error_k": None, "about": {},
    "of_predictor": {"intercept": 0.0, "above_air": False},
}  # fmt: skip
KERNEL = np.zeros((1, 1, 3))


def put(folder, header=HEADER, **arrays):
    path = folder / "m.npz"
    text = header if isinstance(header, str) else json.dumps(header)
    with open(path, "wb") as file:
        np.savez_compressed(file, header=np.array(text), **arrays)
    return path


def refused(path, words=""):
    with pytest.raises(ThermorenderError, match=r"m\.npz is not a learned map of format 1 \(.*" + words) as refusal:
        load_map(path)
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 400 + len(str(path))


def test_base_header_is_a_valid_map(tmp_path):
    assert load_map(put(tmp_path, kernel=KERNEL)).radiance(Inputs(np.zeros((2, 2, 3), np.uint8))).shape == (2, 2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"range_k": [300.0, 280.0]}, "range_k does not rise"),
        ({"range_k": [300.0, 300.0]}, "range_k does not rise"),
        ({"range_k": ["a", "b"]}, "range_k is not two numbers"),
        ({"range_k": [300.0]}, "range_k is not two numbers"),
        ({"range_k": [float("nan"), 300.0]}, "it holds NaN, which is not finite"),
        ({"band_um": [13.5, 7.5]}, "band_um does not rise"),
        ({"texel_m": 0.0}, "texel_m is not a number above 0"),
        ({"texel_range_m": [0.6, 0.4]}, "texel_range_m does not rise"),
        ({"sky_temperature": "cold"}, "sky_temperature is not a number"),
        ({"error_k": -1.0}, "error_k is not a number"),
        ({"trained": "noon"}, "trained or about is not a table"),
        ({"name": "../../mine"}, "cannot be a file"),
        ({"name": "a\\b"}, "cannot be a file"),
        ({"name": ".."}, "cannot be a file"),
        ({"name": 5}, "name is not a text"),
        ({"predictor": ["correlation"]}, ""),
        ({"extra": 1}, "extra"),
        ({"of_predictor": {"intercept": float("nan"), "above_air": False}}, "not finite"),
        ({"of_predictor": {"intercept": 0.0, "above_air": "no"}}, "above_air is neither"),
    ],
)
def test_wrong_headers(tmp_path, change, words):
    refused(put(tmp_path, HEADER | change, kernel=KERNEL), words)


def test_wrong_coefficients(tmp_path):
    for kernel, words in ((KERNEL * np.nan, "not finite"), (np.zeros((17, 17, 3)), "17 wide, more than 15"),
                          (np.zeros((0, 0, 3)), "with odd k"), (KERNEL.astype(str) + "x", "")):  # fmt: skip
        refused(put(tmp_path, kernel=kernel), words)
    refused(put(tmp_path), "kernel")
    inputs = {"terrain": ["sunlight"], "conditions": ["air_k"], "offset": 0.0}
    weight = np.zeros(len(names_of_columns(ExtraInputs(("sunlight",), ("air_k",)))))
    linear = HEADER | {"predictor": "linear", "of_predictor": inputs}
    refused(put(tmp_path, linear, weight=weight * np.nan), "not finite")
    refused(put(tmp_path, linear, weight=weight[1:]), "other columns")
    alone = linear | {"of_predictor": inputs | {"terrain": [], "conditions": []}}
    refused(put(tmp_path, alone, weight=np.zeros(28)), "does not take the air's temperature")
    for cell, value in ((0.0, 0.0), (1e-300, 0.0), (64.0, np.nan)):
        palette = HEADER | {"predictor": "palette", "of_predictor": {"cell": cell}}
        refused(put(tmp_path, palette, value=np.full((4, 4, 4), value), count=np.zeros((4, 4, 4), int)), "wrong size")


class _Runs:
    def __reduce__(self):
        return exec, ("raise SystemExit('code of a file was run')",)


def test_pickled_objects_are_refused(tmp_path):
    path = tmp_path / "m.npz"
    for arrays in ({"header": np.array(json.dumps(HEADER)), "kernel": np.array([_Runs()], object)},
                   {"header": np.array([_Runs()], object), "kernel": KERNEL}):  # fmt: skip
        with open(path, "wb") as file:
            np.savez(file, **arrays)
        refused(path, "Object arrays cannot be loaded")


def test_damaged_files(tmp_path):
    path = put(tmp_path, kernel=np.random.default_rng(0).normal(size=(15, 15, 3)))
    whole = path.read_bytes()
    flipped = bytearray(whole)
    for place in range(120, 160):
        flipped[place] ^= 255
    for content in (whole[: len(whole) // 2], b"", b"hello", bytes(flipped)):
        path.write_bytes(content)
        refused(path)
    refused(put(tmp_path, "[" * 200_000, kernel=KERNEL))
    refused(put(tmp_path, "[1, 2]", kernel=KERNEL))


def test_file_that_unpacks_too_large_is_not_unpacked(tmp_path, monkeypatch):
    path = put(tmp_path, kernel=np.zeros((3, 3, 3)))
    from thermorender.learned import temperature_map

    monkeypatch.setattr(temperature_map, "_MOST_BYTES", 500)
    monkeypatch.setattr(np, "load", None)
    refused(path, "it unpacks to")
    # An array may claim more than the file holds.
    monkeypatch.undo()
    shape = io.BytesIO()
    np.lib.format.write_array_header_1_0(shape, {"descr": "<f8", "fortran_order": False, "shape": (10**15, 1000)})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("more.npy", shape.getvalue() + b"123")
    refused(path)


# --- trees ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def text():
    """A tree model over all features, as LightGBM writes it."""
    import lightgbm

    rng = np.random.default_rng(0)
    rows = rng.random((600, len(NAMES)))
    settings = {"objective": "l1", "verbosity": -1, "num_leaves": 6, "min_data_in_leaf": 5, "num_threads": 1}
    return lightgbm.train(settings, lightgbm.Dataset(rows, rows[:, 0]), 4).model_to_string()


def of_trees(folder, text, damaged=None, **change):
    whole = Trees(text, ExtraInputs((), ()))
    arrays = whole.arrays() if damaged is None else {"trees": np.frombuffer(damaged.encode(), np.uint8)}
    return put(folder, HEADER | {"predictor": "trees", "of_predictor": whole.header() | change}, **arrays)


def test_trees_are_read(tmp_path, text):
    assert load_map(of_trees(tmp_path, text)).predictor.text == text


@pytest.mark.parametrize("damage", ["cut short", "one letter", "no checksum"])
def test_damaged_trees_are_refused(tmp_path, text, damage):
    middle = len(text) // 2
    letter = "1" if text[middle] != "1" else "2"
    path = {
        "cut short": lambda: of_trees(tmp_path, text, text[:middle]),
        "one letter": lambda: of_trees(tmp_path, text, text[:middle] + letter + text[middle + 1 :]),
        "no checksum": lambda: of_trees(tmp_path, text, checksum=None),
    }[damage]()
    refused(path, "its trees are damaged: their checksum differs")
