"""The audit of splits: planted leaks are found and named, other pictures are not, and shares match closed forms."""

import json
import re
from dataclasses import replace
from functools import cache
from math import comb, isclose

import numpy as np
import pytest
from support import shared_data

from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.training import audit as audits
from thermorender.apps.training import duplicates
from thermorender.apps.training.dataset import Entry, ThermalScale, read_dataset
from thermorender.apps.training.dataset_writer import Writer, packed
from thermorender.apps.training.splits import assign
from thermorender.errors import ThermorenderError


def entry(key, part="train", parent=None, sequence=None, order=0, **known):
    return Entry(key, part, parent or key, sequence or key, order, (1, 1), **known)


@cache
def lands():
    """Photographs of two kinds of procedural land, three seeds each, 160×160."""
    return {
        f"{kind}{seed}": make(kind, seed, size_m=size_m, texel_m=texel_m, post_m=texel_m).orthophoto
        for kind, size_m, texel_m in (("heath", 80.0, 0.5), ("village", 64.0, 0.4))
        for seed in range(3)
    }


def dataset(folder, pictures):
    """A data set of {(part, key): picture}, each picture in its own sequence."""
    pairs = [
        (replace(entry(key, part), shape=rgb.shape[:2]), packed(rgb, np.zeros(rgb.shape[:2], np.uint8)))
        for (part, key), rgb in pictures.items()
    ]
    scale = ThermalScale("kelvin", 0.01, 0.0)
    Writer(folder, {"name": "pictures"}, scale).shard("all", pairs)
    return read_dataset(folder)


def copied(rgb, quality=60):
    """A copy: cropped, moved by 9 pixels, made darker, compressed."""
    import cv2

    rgb = np.clip(0.75 * rgb[9:-12, 9:-6].astype(np.float32) + 12.0, 0, 255).astype(np.uint8)
    return cv2.imdecode(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)


def test_a_later_audit_reads_no_picture_unless_the_pairs_changed(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))
    pictures = {("train", "a"): lands()["heath0"], ("test", "b"): copied(lands()["heath0"])}
    first = audits.audit(dataset(tmp_path / "d", pictures))
    assert first.leaks["duplicate"].tests == 1
    read, plain = [], duplicates.sketch
    monkeypatch.setattr(duplicates, "sketch", lambda rgb: read.append(1) or plain(rgb))
    again = read_dataset(tmp_path / "d")
    assert audits.audit(again) == first and not read
    # Other parts, and other pictures of the same keys.
    with pytest.raises(ThermorenderError, match="has no pairs in part 'test'"):
        audits.audit(again.split({"a": "train", "b": "train"}))
    swapped = audits.audit(again.split({"a": "test", "b": "train"}))
    assert len(read) == 3 and swapped.leaks["duplicate"].worst[0][:2] == ("a", "b")
    other = dataset(tmp_path / "e", pictures | {("test", "b"): lands()["village1"]})
    assert audits.audit(other).leaks["duplicate"].tests == 0 and len(read) == 6
    # A damaged file of the cache is searched again.
    for path in (tmp_path / "cache").rglob("*.npz"):
        path.write_bytes(path.read_bytes()[:-3])
    assert audits.audit(again) == first and len(read) == 9


def test_planted_copy_is_found_and_named_and_no_other_picture(tmp_path):
    pictures = {("test" if name in ("heath1", "village2") else "train", name): rgb for name, rgb in lands().items()}
    found = audits.audit(dataset(tmp_path / "clean", pictures))
    assert found.leaks["duplicate"].tests == 0
    assert found.verdict == (
        "none of the 2 test pairs has a leak from training: results on this split measure new pictures, "
        "as far as can be checked without places and labels and conditions"
    )
    mirrored = pictures | {("test", "planted"): lands()["heath2"][:, ::-1]}
    [(test, train, _)] = audits.audit(dataset(tmp_path / "mirrored", mirrored)).leaks["duplicate"].worst
    assert (test, train) == ("planted", "heath2")
    leaky = pictures | {("test", "planted"): copied(lands()["heath2"])}
    found = audits.audit(dataset(tmp_path / "leaky", leaky))
    [(test, train, overlap)] = found.leaks["duplicate"].worst
    assert (test, train) == ("planted", "heath2") and overlap > 0.95
    assert found.verdict == (
        "1 of 3 test pairs (33.3 %) have a picture that shows the same in training: results on this split measure "
        "memory"
    )
    assert "planted – heath2" in "\n".join(found.lines())
    assert json.loads(json.dumps(found.summary()))["leaks"]["duplicate"]["share"] == pytest.approx(1 / 3)


@pytest.mark.parametrize(
    "changed",
    [
        lambda rgb: rgb[:, :80],
        lambda rgb: rgb[::2, ::2],
        lambda rgb: np.rot90(rgb),
        lambda rgb: (255.0 * (rgb / 255.0) ** 0.5).astype(np.uint8),
        lambda rgb: copied(rgb, 20),
        lambda rgb: np.clip(rgb + np.random.default_rng(1).normal(0, 12, rgb.shape), 0, 255).astype(np.uint8),
    ],
    ids=["half", "shrunk", "turned", "brighter", "compressed", "noisy"],
)
def test_modified_copies_are_found_among_pictures_of_the_same_land(changed):
    known = [duplicates.sketch(rgb) for rgb in lands().values()]
    wanted = [duplicates.sketch(np.ascontiguousarray(changed(rgb))) for rgb in lands().values()]
    found = [match and match.index for match in duplicates.find(wanted, known)]
    assert sum(index == number for number, index in enumerate(found)) >= 5
    assert all(index in (None, number) for number, index in enumerate(found))


def test_unrelated_pictures_of_the_same_land_are_not_duplicates():
    sketches = [duplicates.sketch(rgb) for rgb in lands().values()]
    for k, one in enumerate(sketches):
        assert not any(duplicates.compared(one, other) for other in sketches[:k])


def test_overlap_equals_that_of_the_rectangles():
    rgb = lands()["village2"]
    match = duplicates.compared(duplicates.sketch(rgb), duplicates.sketch(rgb[:, 64:]))
    assert match.overlap == pytest.approx(96 / 160, abs=0.02)
    assert duplicates.compared(duplicates.sketch(rgb[:, 64:]), duplicates.sketch(rgb)).overlap > 0.98


def test_pictures_without_structure_are_skipped():
    flat = duplicates.sketch(np.full((40, 60, 3), 90, np.uint8))
    one = duplicates.sketch(np.full((1, 1, 3), 90, np.uint8))
    assert duplicates.find([flat, one], [flat, one]) == [None, None]


def test_road_scenes_far_apart_in_time_are_not_duplicates():
    """Pictures of different drives, by their numbers, except for a corner that two drives pass."""
    import cv2

    paths = sorted(shared_data("pairs/roadscene/visible").glob("*.jpg"))[::2]
    number = [int(re.search(r"\d+", path.name)[0]) for path in paths]
    sketches = [duplicates.sketch(cv2.imread(str(path))) for path in paths]
    half = [k for k in range(len(paths)) if k % 2 == 0]
    rest = [k for k in range(len(paths)) if k % 2 == 1]
    found = duplicates.find([sketches[k] for k in half], [sketches[k] for k in rest])
    apart = [abs(number[k] - number[rest[match.index]]) for k, match in zip(half, found, strict=True) if match]
    assert sum(distance > 200 for distance in apart) <= 1


# --- the index --------------------------------------------------------------------------------------------------


def test_siblings_of_the_published_split_match_the_closed_form():
    """5016 crops, four from each picture, 3511 of them chosen at random for training.

    None of a test crop's three siblings is in training if three of the other 5015 crops, drawn without replacement, are
    all among the 1504 others outside training: 2.7 %.
    """
    crops = [entry(f"p{p}c{c}", parent=f"p{p}", sequence="all", order=p) for p in range(1254) for c in range(4)]
    expected = 1.0 - comb(5015 - 3511, 3) / comb(5015, 3)
    assert round(expected, 3) == 0.973
    shares = []
    for seed in range(16):
        split = assign(crops, "crop", seed=seed)
        test, train = ([each for each in crops if split[each.key] == part] for part in ("test", "train"))
        assert (len(test), len(train)) == (502, 3511)
        shares.append(audits.siblings(test, train).share)
    error = (expected * (1.0 - expected) / 502 / len(shares)) ** 0.5
    assert abs(np.mean(shares) - expected) < 4.0 * error
    # With a split by whole sequences there are none.
    crops = [replace(each, sequence=f"s{each.order // 100}") for each in crops]
    split = assign(crops, "sequence")
    test, train = ([each for each in crops if split[each.key] == part] for part in ("test", "train"))
    assert audits.siblings(test, train).tests == audits.neighbours(test, train).tests == 0


def test_neighbours_are_counted_without_siblings_and_by_distance():
    train = [entry(f"a{k}", sequence="a", order=k, parent="p10" if k == 10 else None) for k in (0, 10, 40)]
    test = [entry("t9", sequence="a", order=9, parent="p10"), entry("t37", sequence="a", order=37), entry("b")]
    leak = audits.neighbours(test, train)
    assert (leak.tests, leak.asked, leak.median) == (2, 3, 6.0)
    assert leak.worst == (("t37", "a40", 3.0), ("t9", "a0", 9.0))


def test_places_within_a_distance():
    # An arc second along a meridian is 30.9 m at 50° north.
    second = 1.0 / 3600.0
    train = [entry("a", place=(50.0, 8.0)), entry("b")]
    test = [entry("near", place=(50.0 + second, 8.0)), entry("far", place=(50.0 + 3 * second, 8.0)), entry("unknown")]
    leak = audits.places(test, train, 50.0)
    assert (leak.tests, leak.asked) == (1, 2)
    assert leak.worst[0][:2] == ("near", "a") and isclose(leak.median, 30.9, abs_tol=0.05)
    assert str(audits.places(test, [entry("b")])) == (
        "unknown whether places coincide: no test pair or no training pair has one"
    )


def test_procedural_worlds_at_one_place_are_different_land():
    """Only a sequence that is in both parts shows the same ground."""
    train = [entry("a", place=(52.0, 21.0), sequence="heath-1")]
    test = [entry("b", place=(52.0, 21.0), sequence="heath-2"), entry("c", place=(52.0, 21.0), sequence="heath-1")]
    assert audits.places(test, train).tests == 2
    leak = audits.places(test, train, lands=True)
    assert (leak.tests, leak.asked, leak.worst[0][0]) == (1, 2, "c")


def test_similar_hour_and_weather_across_midnight_and_new_year():
    def scene(key, hour, day, air_k, kind="heath"):
        return entry(key, labels={"kind": kind}, conditions={"solar_hour": hour, "day": day, "air_k": air_k})

    train = [scene("a", 23.8, 364.0, 290.0)]
    leak = audits.alike(
        [
            scene("same", 0.3, 2.0, 291.0), scene("later", 1.5, 2.0, 290.0), scene("warmer", 23.8, 364.0, 292.5),
            scene("season", 23.8, 340.0, 290.0), scene("land", 23.8, 364.0, 290.0, "ridge"), entry("unknown"),
        ],
        train,
    )  # fmt: skip
    assert (leak.tests, leak.asked) == (1, 5) and leak.worst[0][:2] == ("same", "a")
    # Labels alone are compared with each other.
    assert audits.alike([entry("x", labels={"kind": "heath"})], [entry("y", labels={"kind": "heath"})]).tests == 1


def test_worst_leak_gives_the_verdict():
    none = {kind: audits.Leak(kind, 0, 40, None, ()) for kind in audits.KINDS}

    def verdict(**tests):
        leaks = {kind: replace(leak, tests=tests.get(kind, 0)) for kind, leak in none.items()}
        return audits.Audit(40, 100, leaks).verdict

    assert verdict(sibling=12, place=40) == (
        "12 of 40 test pairs (30 %) have a sibling in training: results on this split measure memory"
    )
    assert verdict(duplicate=1) == (
        "1 of 40 test pairs (2.5 %) have a picture that shows the same in training: results on these measure memory"
    )
    assert verdict(conditions=40).endswith("results on this split do not measure other land, hours or weather")
    assert verdict() == "none of the 40 test pairs has a leak from training: results on this split measure new pictures"


def test_part_without_pairs_is_refused(tmp_path):
    rgb = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(ThermorenderError, match="has no pairs in part 'test'; split it"):
        audits.audit(dataset(tmp_path, {("train", "a"): rgb}))
