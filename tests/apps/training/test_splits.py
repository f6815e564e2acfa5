"""Splits: shares, whole groups, distances between parts, files."""

import itertools
import math

import numpy as np
import pytest

from thermorender.apps.training.dataset import PARTS, Entry
from thermorender.apps.training.splits import assign, read_split, write_split
from thermorender.errors import ThermorenderError


def entry(key, sequence="a", place=None, parent=None):
    return Entry(key, "train", parent or key, sequence, 0, (8, 8), place=place)


def sized(*sizes):
    return [entry(f"s{s}_{k}", f"s{s}") for s, size in enumerate(sizes) for k in range(size)]


def counts(split):
    return tuple(sum(part == name for part in split.values()) for name in PARTS)


def test_crops_are_split_as_published():
    crops = [entry(f"p{p}_{k}", f"p{p}") for p in range(1254) for k in range(4)]
    assert counts(assign(crops, "crop")) == (3511, 1003, 502)


def test_sequences_stay_whole_in_any_order_of_the_entries():
    entries = sized(30, 12, 9, 7, 7, 7, 5, 3, 3, 2)
    split = assign(entries, "sequence", seed=3)
    for name in {each.sequence for each in entries}:
        assert len({split[each.key] for each in entries if each.sequence == name}) == 1
    assert assign(entries[::-1], "sequence", seed=3) == split
    assert any(assign(entries, "sequence", seed=seed) != split for seed in range(8))


@pytest.mark.parametrize("sizes", [(9, 5, 4, 3, 2, 2, 1, 1), (6, 6, 5, 4, 4, 3), (20, 3, 2, 1), (1, 1, 1)])
def test_shares_are_nearly_the_best_for_whole_groups(sizes):
    total, wanted = sum(sizes), np.array((0.7, 0.2, 0.1))
    found = np.abs(np.array(counts(assign(sized(*sizes), "sequence"))) / total - wanted).sum()
    every = []
    for choice in itertools.product(range(3), repeat=len(sizes)):
        if set(choice) == {0, 1, 2}:
            every.append(np.abs(np.bincount(choice, sizes, 3) / total - wanted).sum())
    # Not always the best, which is a knapsack problem, but within its smallest group.
    assert found <= min(every) + 2 * min(sizes) / total + 1e-12


def test_a_part_of_share_zero_stays_empty_and_no_other_does():
    assert counts(assign(sized(5, 5), "sequence", (0.9, 0.0, 0.1))) == (5, 0, 5)
    assert min(counts(assign(sized(50, 1, 1), "sequence"))) == 1


def test_parts_by_place_are_apart():
    generator = np.random.default_rng(5)
    # Villages of many views, scattered over 40 km on both sides of the date line.
    centres = generator.uniform(-0.2, 0.2, (40, 2))
    entries = []
    for c, centre in enumerate(centres):
        for k, (north, east) in enumerate(generator.normal(0.0, 0.0015, (12, 2)) + centre):
            longitude = (180.0 + east + 180.0) % 360.0 - 180.0
            entries.append(entry(f"c{c}_{k}", "one", place=(60.0 + north, longitude)))
    split = assign(entries, "place", cell_m=300.0, apart_m=150.0)
    assert min(counts(split)) > 0

    def metres(a, b):
        # Haversine on a sphere.
        (p, q), (r, s) = np.radians(a), np.radians(b)
        chord = math.sin((r - p) / 2) ** 2 + math.cos(p) * math.cos(r) * math.sin((s - q) / 2) ** 2
        return 2 * 6371000.0 * math.asin(math.sqrt(chord))

    apart = [metres(a.place, b.place) for a, b in itertools.combinations(entries, 2) if split[a.key] != split[b.key]]
    # The ellipsoid is up to 0.6 % off the sphere.
    assert min(apart) > 150.0 * 0.99
    # A cell is wholly in one part, although its ends are further apart than neighbours.
    assert len({assign(entries, "place", cell_m=5e3, apart_m=1.0)[e.key] for e in entries[:12]}) == 1


@pytest.mark.parametrize("part", PARTS)
def test_all_into_one_part(part):
    entries = sized(1, 2)
    assert assign(entries, part) == {entry.key: part for entry in entries}


def test_refusals():
    with pytest.raises(ThermorenderError, match="rule 'random' is unknown; give one of sequence, place, crop"):
        assign(sized(3, 3, 3), "random")
    with pytest.raises(ThermorenderError, match="'sequence' finds 2 groups for 3 parts"):
        assign(sized(3, 3))
    with pytest.raises(ThermorenderError, match="1 of 4 lack one, the first is s0_0"):
        assign([*sized(1), *(entry(f"k{k}", place=(k, k)) for k in range(3))], "place")
    with pytest.raises(ThermorenderError, match="smaller cell_m and apart_m"):
        assign([entry(f"k{k}", place=(50.0, 8.0)) for k in range(5)], "place")
    for shares in ((0.7, 0.3), (1.0, -1.0, 1.0), (0.0, 0.0, 0.0), (math.nan, 1.0, 1.0)):
        with pytest.raises(ThermorenderError, match="are not shares of train, validation, test"):
            assign(sized(3, 3, 3), shares=shares)
    with pytest.raises(ThermorenderError, match="cell_m=0 is not allowed"):
        assign([entry(f"k{k}", place=(k, k)) for k in range(3)], "place", cell_m=0.0)


@pytest.mark.parametrize("name", ["split.json", "split.csv"])
def test_a_split_survives_its_file(name, tmp_path):
    split = assign(sized(5, 4, 3, 2), "crop", seed=2)
    write_split(tmp_path / name, split)
    assert read_split(tmp_path / name) == split


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", '{"train": ["x"], "tset": ["y"]}', "puts 'y' into 'tset'; give one of train, validation, test"),
        ("a.json", '{"train": ["x"], "test": ["x"]}', "puts 'x' into 'train' and 'test'"),
        ("a.json", '{"train": [1]}', "is not a split; give JSON"),
        ("a.json", '["x"]', "is not a split; give JSON"),
        ("a.json", '{"train": "x"}', "is not a split; give JSON"),
        ("a.json", "{", "is not a split; give JSON"),
        ("a.csv", "name,part\nx,train\n", "is not a split; give JSON"),
        ("a.csv", "key,part\nx,learn\n", "puts 'x' into 'learn'"),
        ("a.csv", "", "is not a split; give JSON"),
        ("a.txt", "", "is not a split; give JSON"),
    ],
)
def test_files_that_are_not_a_split_are_refused(name, text, words, tmp_path):
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(ThermorenderError, match=words):
        read_split(tmp_path / name)
