"""Fingerprints of training pictures: copies and parts are found, other pictures are not, and maps carry them."""

import json
from functools import cache

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from thermorender.apps.compare import provenance
from thermorender.apps.training import training_pictures
from thermorender.apps.training.training_pictures import search_in, search_in_files
from thermorender.cli.app import app
from thermorender.defaults import TRAINED_MAPS
from thermorender.errors import ThermorenderError
from thermorender.learned import fingerprints
from thermorender.learned.fingerprints import BYTES, Fingerprints, fingerprints_of, search, stored_numbers
from thermorender.learned.temperature_map import SHIPPED, load_map, load_model, save_map


@cache
def picture(seed, height=150, width=200):
    """A picture with structure at all scales: sums of smoothed noise of three sizes."""
    generator = np.random.default_rng(seed)
    layers = [cv2.resize(generator.normal(size=(height // k, width // k, 3)), (width, height)) for k in (2, 7, 23)]
    return np.clip(128.0 + 30.0 * sum(layers), 0, 255).astype(np.uint8)


def part(rgb, share, scale):
    """A part of a picture with a share of its area, resized."""
    height, width = (round(length * share**0.5) for length in rgb.shape[:2])
    top, left = rgb.shape[0] // 3, rgb.shape[1] // 4
    return cv2.resize(rgb[top : top + height, left : left + width], None, fx=scale, fy=scale)


CHANGES = {
    "identical": lambda rgb: rgb,
    "compressed": lambda rgb: cv2.imdecode(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, 20])[1], 1),
    "mirrored": lambda rgb: rgb[:, ::-1],
    "upside down and mirrored": lambda rgb: rgb[::-1],
    "turned by 90°": lambda rgb: np.rot90(rgb),
    "turned by 270° and mirrored": lambda rgb: np.rot90(rgb, 3)[:, ::-1],
    "a fifth, enlarged": lambda rgb: part(rgb, 0.2, 1.7),
    "a fifth, turned": lambda rgb: np.rot90(part(rgb, 0.2, 1.0)),
    "brighter": lambda rgb: np.clip(1.4 * rgb.astype(float) - 10.0, 0, 255).astype(np.uint8),
}


@pytest.mark.parametrize("change", CHANGES)
def test_changed_copies_are_found_and_the_training_picture_is_named(change):
    known = fingerprints_of([picture(seed) for seed in range(4)], 4)
    seen = search(known, [CHANGES[change](picture(seed)) for seed in (1, 3)])
    assert [each and each.index for each in seen] == [1, 3]


def test_other_pictures_and_flat_ones_are_not_found():
    known = fingerprints_of([*(picture(seed) for seed in range(4)), np.full((30, 40, 3), 90, np.uint8)], 5)
    flat = np.full((60, 80, 3), 90, np.uint8)
    assert search(known, [picture(seed) for seed in range(10, 14)] + [flat, flat[:1, :1], flat[:3]]) == [None] * 7


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (40, 3), (9, 2000)])
def test_a_fingerprint_has_a_fixed_size_for_any_shape_of_picture(shape):
    rgb = np.random.default_rng(0).integers(0, 255, (*shape, 3), np.uint8)
    known = fingerprints_of([rgb], 1)
    assert known.rows.shape == (1, BYTES) and known.rows.dtype == np.uint8
    search(known, [rgb])


def test_a_map_stores_evenly_spaced_pictures_of_a_large_set():
    assert stored_numbers(3) == [0, 1, 2]
    some = stored_numbers(10_000)
    assert len(some) == fingerprints.MOST_PICTURES and some[0] == 0 and some[-1] == 9999
    assert max(np.diff(some)) - min(np.diff(some)) <= 1


def with_prints(count=2, pictures=2):
    from dataclasses import replace

    made = fingerprints_of([picture(seed) for seed in range(count)], pictures)
    return replace(load_model("fok-1to1"), fingerprints=made)


def test_the_file_of_a_map_keeps_its_fingerprints(tmp_path):
    save_map(with_prints(2, 7), tmp_path / "m.npz")
    kept = load_map(tmp_path / "m.npz").fingerprints
    assert kept.pictures == 7 and (kept.rows == with_prints().fingerprints.rows).all()
    save_map(load_model("fok-1to1"), tmp_path / "none.npz")
    assert load_map(tmp_path / "none.npz").fingerprints is None


def test_a_file_whose_contents_were_changed_is_refused(tmp_path):
    save_map(with_prints(), tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as file:
        arrays = dict(file)
    for changed in ({"fingerprints": arrays["fingerprints"][::-1]}, {"kernel": arrays["kernel"] + 1e-9}):
        np.savez_compressed(tmp_path / "changed.npz", **(arrays | changed))
        with pytest.raises(ThermorenderError, match="its contents differ from its digest"):
            load_map(tmp_path / "changed.npz")


@pytest.mark.parametrize("name", TRAINED_MAPS)
def test_shipped_maps_state_a_digest_and_the_libraries_that_fitted_them(name):
    """The digest is checked as a map is read; networks need their library to be read."""
    with np.load(SHIPPED[name]) as file:
        header = json.loads(str(file["header"]))
    assert len(header["digest"]) == 32 and header["about"]["versions"]["numpy"]
    library = {"network": "torch", "trees": "lightgbm"}.get(header["predictor"])
    assert library is None or header["about"]["versions"][library]


@pytest.mark.parametrize(
    "rows, pictures",
    [(np.zeros((0, BYTES), np.uint8), 1), (np.ones((2, BYTES), np.uint8), 1), (np.ones((1, 9), np.uint8), 1),
     (np.full((1, BYTES), 255, np.uint8), 1), (np.ones((1, BYTES), np.int64), 1)],
)  # fmt: skip
def test_impossible_fingerprints_are_refused(rows, pictures):
    with pytest.raises(ValueError, match="fingerprints"):
        Fingerprints(rows, pictures)


def test_a_search_says_what_it_found_what_it_left_out_and_what_is_unknown(monkeypatch):
    names = ["a", "b", "c"]
    pictures = [picture(20), picture(1)[:, ::-1], picture(21)]
    found = search_in(with_prints(), names, pictures.__getitem__)
    assert list(found.found) == ["b"] and found.found["b"].index == 1
    assert found.line == (
        "map 'fok-1to1' was trained on 1 of these 3 pictures or parts of them: b; its results on them measure memory"
    )
    clean = search_in(with_prints(2, 9), ["a"], pictures.__getitem__)
    assert clean.line == (
        "map 'fok-1to1' was trained on 9 pictures, and none of the 1 shows one of them (fingerprints of 2 of 9 "
        "training pictures)"
    )
    unknown = search_in(load_model("fok-1to1"), names, pictures.__getitem__)
    assert unknown.line.startswith("what this map was trained on is unknown: the file of 'fok-1to1' has no finger")
    shipped = search_in(load_model("procedural-trees"), names, pictures.__getitem__)
    assert "states only 'procedural pictures of `thermorender dataset` 0.1.0" in shipped.line
    monkeypatch.setattr(training_pictures, "MOST_SEARCHED", 2)
    many = search_in(with_prints(), names, pictures.__getitem__)
    assert not many.found and "(2 of 3 pictures searched)" in many.line


def test_a_picture_that_cannot_be_read_is_not_counted_as_searched(tmp_path):
    pictures = {"a": picture(20), "b": None, "c": picture(1)}
    names = list(pictures)
    found = search_in(with_prints(), names, lambda number: pictures[names[number]])
    assert (found.given, found.searched, found.unreadable, list(found.found)) == (3, 2, ("b",), ["c"])
    assert found.line.startswith(
        "map 'fok-1to1' was trained on 1 of these 2 pictures or parts of them (2 of 3 pictures searched; 1 could not "
        "be read: b): c; "
    )
    assert found.summary()["unreadable"] == ["b"]
    nothing = search_in(with_prints(), ["b"], lambda number: None)
    assert nothing.line.endswith("none was searched for them (0 of 1 pictures searched; 1 could not be read: b)")
    cv2.imwrite(str(tmp_path / "good.png"), picture(20))
    (tmp_path / "bad.png").write_bytes(b"no picture")
    of_files = search_in_files(with_prints(), [tmp_path / "bad.png", tmp_path / "good.png"])
    assert (of_files.searched, of_files.unreadable) == (1, ("bad.png",))


def test_compare_states_which_scenes_a_map_was_trained_on():
    own = provenance.provenance_of(with_prints())
    scenes = {"hill": [picture(40), picture(41)], "lake": [picture(1)[::-1]]}
    provenance.search_fingerprints([own], [with_prints()], scenes)
    (leak,) = own.leaks
    assert "was trained on 1 of these 3 pictures or parts of them: lake 1;" in leak
    clean = provenance.provenance_of(with_prints())
    provenance.search_fingerprints([clean], [with_prints()], {"hill": [picture(40)]})
    assert not clean.leaks and "none of the 1 shows one of them" in clean.audited


def test_translate_names_the_pictures_that_the_map_was_trained_on(tmp_path):
    save_map(with_prints(), tmp_path / "m.npz")
    for name, rgb in (("new", picture(30)), ("old", np.rot90(picture(0)))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), rgb[..., ::-1])
    words = ["translate", str(tmp_path / "m.npz"), str(tmp_path / "new.png"), str(tmp_path / "old.png")]
    said = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "out"), "--audit"], catch_exceptions=False)
    assert "was trained on 1 of these 2 pictures or parts of them: old.png" in said.output
    said = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "quiet")], catch_exceptions=False)
    assert "trained on" not in said.output


@pytest.mark.parametrize("size", [(0, 5), (5, 0), (255, 255)])
def test_grid_without_cells_or_with_too_many_is_refused(size):
    rows = np.zeros((1, BYTES), np.uint8)
    rows[0, :2] = size
    with pytest.raises(ValueError, match="do not fit their number of pictures or cells"):
        Fingerprints(rows, 1)
