"""Data sets on disk: round trips, shard format, interrupted and concurrent writers, and damage."""

import io
import json
import pickle
import subprocess
import sys
import tarfile
import textwrap
from dataclasses import asdict, replace

import numpy as np
import pytest

from thermorender.apps.training.dataset import Entry, ThermalScale, read_dataset
from thermorender.apps.training.dataset_writer import Writer, packed
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance

SCALE = ThermalScale("radiance", 1e-3, 2.0)
CARD = {"name": "pictures", "origin": "made", "licence": "CC0"}
SHAPE = (24, 32)


def pictures(seed, kind=np.uint16, shape=SHAPE):
    """(visible, thermal, valid, truth) of a pair; truth has channels of every kind."""
    rng = np.random.default_rng(seed)
    truth = {
        "radiance": rng.uniform(20, 60, shape), "mask": rng.integers(0, 9, shape, np.uint8),
        "sunlight": rng.uniform(0, 900, shape).astype(np.float16),
    }  # fmt: skip
    truth["radiance"][0, 0] = np.nan
    visible, thermal = rng.integers(0, 256, (*shape, 3), np.uint8), rng.integers(0, np.iinfo(kind).max, shape, kind)
    return visible, thermal, rng.random(shape) > 0.1, truth


def entry(key, part="train", shape=SHAPE, **known):
    return Entry(key, part, key, key.rpartition("-")[0], 0, shape, **known)


def shard_of(name, count=2, **known):
    """Pairs of a shard, as a Writer takes them."""
    return [(entry(f"{name}-{k}", **known), packed(*pictures(k))) for k in range(count)]


def made(folder, names=("a", "b"), count=2):
    writer = Writer(folder, CARD, SCALE)
    for name in names:
        writer.shard(name, shard_of(name, count))
    return folder


def lines(folder):
    return (folder / "index.jsonl").read_bytes().splitlines(keepends=True)


def keys(folder):
    return [each.key for each in read_dataset(folder).entries]


def bytes_of(folder):
    return {path.name: path.read_bytes() for path in (folder / "shards").iterdir()}


# --- round trips ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_pair_is_read_as_it_was_written(tmp_path, kind):
    known = {
        "texel_m": 0.2, "place": (48.5, 21.0), "time": "2018-07-28T12:00:00Z", "sky_temperature": 250.25,
        "conditions": {"air_k": 290.5}, "labels": {"kind": "heath"},
    }  # fmt: skip
    visible, thermal, valid, truth = pictures(3, kind)
    given = entry("flight_1-07", "test", **known)
    (kept,) = Writer(tmp_path / "set", CARD, SCALE).shard("one", [(given, packed(visible, thermal, valid, truth))])
    dataset = read_dataset(tmp_path / "set")
    assert dataset.entries == (kept,) and replace(kept, shard="", members={}) == given
    assert dataset.scale == SCALE and dataset.card["licence"] == "CC0"
    (pair,) = dataset.pairs()
    for found, expected in ((pair.visible, visible), (pair.thermal, thermal), (pair.valid, valid)):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    assert set(pair.truth) == set(truth)
    for name in ("mask", "sunlight"):
        assert pair.truth[name].dtype == truth[name].dtype
        np.testing.assert_array_equal(pair.truth[name], truth[name])
    # A mantissa of 16 bits, rounded to nearest.
    np.testing.assert_allclose(pair.truth["radiance"], truth["radiance"], rtol=2.0**-17)
    np.testing.assert_array_equal(pair.radiance, thermal * 1e-3 + 2.0)
    np.testing.assert_array_equal(pair.reference, pair.truth["radiance"].astype(np.float64))
    bare = dataset.pair(kept, truth=False)
    assert bare.truth == {}
    np.testing.assert_array_equal(bare.reference, pair.radiance)


def test_thermal_values_convert_to_radiance():
    kelvin = ThermalScale("kelvin", 0.01, 200.0, None, (8.0, 14.0))
    np.testing.assert_array_equal(kelvin.radiance(np.uint16([0, 9000])), band_radiance([200.0, 290.0], 8.0, 14.0))
    share = ThermalScale("intensity", 1 / 200, -0.1, (14.0, 24.0))
    low, high = band_radiance([287.15, 297.15], *share.band_um)
    # Linear in radiance, not in temperature.
    np.testing.assert_allclose(share.radiance(np.uint8([20, 120, 220])), [low, (low + high) / 2, high], rtol=1e-12)


def test_shards_are_plain_tar_files_in_webdatasets_format(tmp_path):
    """Files of a pair are adjacent and named by its key, which ends at the first dot."""
    long = "k" * 120
    writer = Writer(tmp_path / "set", CARD, SCALE)
    writer.shard("s", [(entry(key), packed(*pictures(number))) for number, key in enumerate(("a-0", long, "b-0"))])
    dataset = read_dataset(tmp_path / "set")
    with tarfile.open(tmp_path / "set/shards/s.tar", "r:") as tar:
        members = tar.getmembers()
        groups = list(dict.fromkeys(member.name.split(".", 1)[0] for member in members))
        assert groups == [each.key for each in dataset.entries] == ["a-0", long, "b-0"]
        assert [member.name.split(".", 1)[0] for member in members] == [key for key in groups for _ in range(5)]
        where = {member.name: (member.offset_data, member.size) for member in members}
        for each in dataset.entries:
            ends = {name.split(".", 1)[1] for name in where if name.startswith(f"{each.key}.")}
            assert ends == {"visible.png", "thermal.png", "valid.png", "truth.npz", "json"}
            assert each.members == {end: where[f"{each.key}.{end}"] for end in ends - {"json"}}
            written = json.load(tar.extractfile(f"{each.key}.json"))
            assert written == json.loads(json.dumps(asdict(each)))
        assert all(member.isfile() and member.mtime == 0 for member in members)
    # Random access, in any order.
    for number in (2, 0, 1):
        np.testing.assert_array_equal(dataset.pair(dataset.entries[number]).thermal, pictures(number)[1])


def test_without_holes_no_mask_is_stored(tmp_path):
    visible, thermal, _, _ = pictures(0)
    assert set(packed(visible, thermal, np.ones(SHAPE, bool))) == {"visible.png", "thermal.png"}
    Writer(tmp_path / "set", CARD, SCALE).shard("s", [(entry("a-0"), packed(visible, thermal))])
    assert next(read_dataset(tmp_path / "set").pairs()).valid.all()


def test_dataset_works_with_batch_loaders(tmp_path):
    """Length, indices from either end, IndexError outside, arrays that stack, and pickling for workers."""
    dataset = read_dataset(made(tmp_path / "set"))
    assert len(dataset) == 4 and len(list(dataset)) == 4
    assert dataset[np.int64(3)]["key"] == dataset[-1]["key"] == "b-1"
    for beyond in (4, -5):
        with pytest.raises(IndexError):
            dataset[beyond]
    sent = pickle.loads(pickle.dumps(dataset))
    batch = {name: [one[name] for one in sent] for name in dataset[0]}
    assert batch.pop("key") == ["a-0", "a-1", "b-0", "b-1"]
    kinds = {"visible": np.uint8, "thermal": np.int32, "radiance": np.float32, "valid": bool}
    for name, values in batch.items():
        assert np.stack(values).dtype == kinds[name] and np.stack(values).shape[:3] == (4, *SHAPE)
        # torch.from_numpy refuses negative strides and warns about read-only arrays.
        assert all(value.flags.c_contiguous and value.flags.writeable for value in values), name


def test_parts_and_splits(tmp_path):
    dataset = read_dataset(made(tmp_path / "set"))
    split = dataset.split({"a-0": "test", "b-1": "validation"})
    assert [(each.key, each.part) for each in split.entries] == [("a-0", "test"), ("b-1", "validation")]
    assert len(split.of("test", "validation")) == 2 and len(split.of("train")) == 0 and len(dataset.of("train")) == 4
    with pytest.raises(ThermorenderError, match=r"the split names 'c', which .* does not hold; leave it out"):
        dataset.split({"c": "test"})
    with pytest.raises(ThermorenderError, match="puts 'a-0' into 'tests'; give one of train, validation, test"):
        dataset.split({"a-0": "tests"})


# --- continued --------------------------------------------------------------------------------------------------


def continued(folder, names=("a", "b")):
    """Write the missing shards; return the names of those written."""
    writer, written = Writer(folder, CARD, SCALE, resume=True), []
    for name in names:
        if not writer.has(name):
            writer.shard(name, shard_of(name))
            written.append(name)
    return written


def test_existing_shards_are_not_written_again(tmp_path):
    folder = made(tmp_path / "set")
    before = bytes_of(folder), lines(folder)
    assert continued(folder) == []
    assert (bytes_of(folder), lines(folder)) == before


@pytest.mark.parametrize("keep", [0, 1, 40, -1])
@pytest.mark.parametrize("line", [0, 1, 2, 3])
def test_truncated_index_loses_no_pair(tmp_path, line, keep):
    """The index ends within a line; whole lines of a shard do not make it complete."""
    whole, folder = made(tmp_path / "whole"), made(tmp_path / "set")
    written = lines(folder)
    (folder / "index.jsonl").write_bytes(b"".join(written[:line]) + written[line][:keep])
    # Readable without the missing pairs; a line that lacks only its newline is whole.
    assert keys(folder) == ["a-0", "a-1", "b-0", "b-1"][: line + (keep == -1)]
    assert continued(folder) == ([["a", "b"], ["a", "b"], ["b"], ["b"]][line])
    assert sorted(lines(folder)) == sorted(lines(whole)) and bytes_of(folder) == bytes_of(whole)
    assert len(list(read_dataset(folder).pairs())) == 4


def test_partial_shard_or_one_without_lines_is_written_again(tmp_path):
    whole, folder = made(tmp_path / "whole"), made(tmp_path / "set", "a")
    half = bytes_of(whole)["b.tar"][:700]
    (folder / "shards/.b.0123abcd.part.tar").write_bytes(half)
    assert continued(folder) == ["b"] and lines(folder) == lines(whole)
    (folder / "index.jsonl").write_bytes(b"".join(lines(whole)[:2]))
    assert continued(folder) == ["b"] and lines(folder) == lines(whole)
    # A temporary file, which another process may be writing, is left alone.
    assert (folder / "shards/.b.0123abcd.part.tar").read_bytes() == half


def test_missing_or_truncated_shard_is_written_again(tmp_path):
    whole, folder = made(tmp_path / "whole"), made(tmp_path / "set")
    (folder / "shards/a.tar").unlink()
    assert continued(folder) == ["a"]
    assert sorted(lines(folder)) == sorted(lines(whole)) and bytes_of(folder) == bytes_of(whole)
    (folder / "shards/a.tar").write_bytes(bytes_of(whole)["a.tar"][:3000])
    assert continued(folder) == ["a"] and bytes_of(folder) == bytes_of(whole)


def test_killed_start_can_be_continued(tmp_path):
    """Left over: an empty folder for shards, a temporary file, or a card without that folder."""
    for name in ("shards", "part", "card"):
        (tmp_path / name).mkdir()
    (tmp_path / "shards/shards").mkdir()
    (tmp_path / "part/.card.0123abcd.part.json").write_text("{")
    made(tmp_path / "whole", ())
    (tmp_path / "card/card.json").write_bytes((tmp_path / "whole/card.json").read_bytes())
    for name in ("shards", "part", "card"):
        assert continued(tmp_path / name) == ["a", "b"], name
        assert len(read_dataset(tmp_path / name)) == 4
        assert not any(path.name.startswith(".") for path in (tmp_path / name).iterdir())


def test_continuing_with_other_settings_is_refused(tmp_path):
    folder = made(tmp_path / "set")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(ThermorenderError, match="holds a data set; give a new folder, or --resume to continue it"):
        Writer(folder, CARD, SCALE)
    for card, scale, words in (
        ({**CARD, "licence": "MIT"}, SCALE, "has licence='CC0', now 'MIT'; continue with the same settings"),
        ({**CARD, "hours": 3}, SCALE, "has hours=None, now 3;"),
        ({"name": "pictures", "origin": "made"}, SCALE, "has licence='CC0', now None;"),
        (CARD, replace(SCALE, step=2e-3), r"has thermal=\{.*'step': 0.001.*now .*0.002"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            Writer(folder, card, scale, resume=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/picture.png").write_bytes(b"")
    with pytest.raises(ThermorenderError, match="other is not empty and does not hold a data set; give a new folder"):
        Writer(tmp_path / "other", CARD, SCALE, resume=True)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_two_writers_of_one_folder_lose_nothing(tmp_path):
    """One is killed in mid-line while the other writes; and both write the same shard."""
    folder = made(tmp_path / "set", "a")
    other = Writer(folder, CARD, SCALE, resume=True)
    with open(folder / "index.jsonl", "ab") as file:
        file.write(b'{"key": "killed')
    other.shard("b", shard_of("b"))
    assert keys(folder) == ["a-0", "a-1", "b-0", "b-1"]
    first, second = (Writer(folder, CARD, SCALE, resume=True) for _ in range(2))
    first.shard("c", shard_of("c"))
    second.shard("c", shard_of("c", 3))
    assert keys(folder) == ["a-0", "a-1", "b-0", "b-1", "c-0", "c-1", "c-2"]
    assert len(list(read_dataset(folder).pairs())) == 7


def test_two_processes_fill_one_folder(tmp_path):
    script = textwrap.dedent("""
        import sys
        from pathlib import Path
        import numpy as np
        from thermorender.apps.training.dataset import Entry, ThermalScale
        from thermorender.apps.training.dataset_writer import Writer, packed
        ready, turn = Path(sys.argv[1]), int(sys.argv[2])
        (ready / f"ready{turn}").touch()
        while not (ready / f"ready{1 - turn}").exists():
            pass
        writer = Writer(ready / "set", {"name": "pictures"}, ThermalScale("radiance", 1e-3, 2.0), resume=True)
        pair = packed(np.zeros((24, 32, 3), np.uint8), np.full((24, 32), turn, np.uint16))
        for number in range(turn, 40, 2):
            name = f"s{number}"
            writer.shard(name, [(Entry(f"{name}-0", "train", f"{name}-0", name, 0, (24, 32)), pair)])
    """)
    both = [
        subprocess.Popen([sys.executable, "-c", script, tmp_path, str(turn)], stderr=subprocess.PIPE, text=True)
        for turn in (0, 1)
    ]
    for process in both:
        assert (process.communicate(timeout=60)[1], process.returncode) == ("", 0)
    assert sorted(keys(tmp_path / "set")) == sorted(f"s{number}-0" for number in range(40))
    assert len(list(read_dataset(tmp_path / "set").pairs())) == 40


# --- what is refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["../a", "a/b", "", "a.b", "a\n", "k" * 121, "/a", "ä"])
def test_keys_and_names_outside_the_folder_are_refused(tmp_path, key):
    folder = made(tmp_path / "set", "a")
    before = lines(folder), bytes_of(folder)
    writer = Writer(folder, CARD, SCALE, resume=True)
    with pytest.raises(ThermorenderError, match=r"is not a key of a pair; give letters, digits, _ and -"):
        writer.shard("b", [(entry(key), packed(*pictures(0)))])
    if len(key) < 121:
        with pytest.raises(ThermorenderError, match=r"is not a name for a shard; give letters, digits, _ and -"):
            writer.shard(key, shard_of("b"))
    # A reader refuses them as well in an index that somebody else wrote.
    written = json.loads(lines(folder)[0])
    for name, value in (("key", key), ("shard", f"shards/{key}"), ("shard", "shards/../../a.tar"), ("shard", "/a.tar")):
        (folder / "index.jsonl").write_text(json.dumps({**written, name: value}) + "\n")
        with pytest.raises(ThermorenderError, match=r"index.jsonl, line 1 is not a pair or repeats a key; remove"):
            read_dataset(folder)
    (folder / "index.jsonl").write_bytes(b"".join(before[0]))
    assert (lines(folder), bytes_of(folder)) == before and set(tmp_path.iterdir()) == {folder}


def test_unreadable_pairs_are_not_written(tmp_path):
    folder = made(tmp_path / "set", "a")
    before = lines(folder), bytes_of(folder)
    writer, files = Writer(folder, CARD, SCALE, resume=True), packed(*pictures(0))
    for pairs, words in (
        ([(entry("b-0"), files), (entry("b-0"), files)], "'b-0' is the key of two pairs; give each a different one"),
        ([(entry("a-1"), files)], "'a-1' is the key of two pairs; give each a different one"),
        ([(entry("b-0", "tests"), files)], "part='tests' of 'b-0' is unknown; give one of train, validation, test"),
        ([(entry("b-0"), {"../../x.png": b""})], "'../../x.png' of 'b-0' is not a suffix of a name; give one such as "),
    ):
        with pytest.raises(ThermorenderError, match=words):
            writer.shard("b", pairs)
    assert (lines(folder), bytes_of(folder)) == before
    # The name of a refused shard is still free.
    assert not writer.has("b") and writer.shard("b", shard_of("b")) and writer.has("b")


def test_locked_folder_can_be_written_by_its_owner(tmp_path):
    """A process that fills a folder as a whole holds its lock, and writing does not wait for that lock."""
    from thermorender import files

    writer = Writer(tmp_path / "set", CARD, SCALE)
    with files.in_use(tmp_path / "set"):
        writer.shard("a", shard_of("a"))
    assert len(read_dataset(tmp_path / "set")) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"part": "tests"}, {"shape": [24]}, {"shape": [24, 0]}, {"shape": "24"}, {"order": "1"}, {"key": 3},
        {"members": {"visible.png": [-512, 5]}}, {"members": {"visible.png": [0, -1]}}, {"conditions": [1]},
        {"members": {"visible.png": [0]}}, {"members": {"visible.png": [0.5, 7]}}, {"members": []}, {"more": 1},
        {"labels": None}, {"texel_m": "1"}, {"conditions": {"air_k": "warm"}}, {"place": [1]}, {"sequence": 5},
    ],
    ids=str,
)  # fmt: skip
def test_wrong_index_lines_are_refused_at_any_position(tmp_path, change):
    folder = made(tmp_path / "set", "a")
    first, second = lines(folder)
    bad = json.dumps({**json.loads(first), **change}).encode() + b"\n"
    for content, number in ((bad + second, 1), (second + bad, 2)):
        (folder / "index.jsonl").write_bytes(content)
        with pytest.raises(ThermorenderError, match=f"index.jsonl, line {number} is not a pair or repeats a key;"):
            read_dataset(folder)


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "3", "{}", '{"format": 1}', '{"format": 1, "thermal": []}', "\x00",
        *(
            json.dumps({"format": 1, "name": "a", "thermal": {**asdict(SCALE), **change}})
            for change in ({"unit": "counts"}, {"step": "1"}, {"step": 0.0}, {"step": None}, {"zero": float("nan")},
                           {"unit": "intensity"}, {"range_c": [1]}, {"band_um": [14, 8]}, {"band_um": 3}, {"more": 1})
        ),
        json.dumps({"format": 2, "thermal": asdict(SCALE)}),
    ],
)  # fmt: skip
def test_cards_without_a_valid_scale_are_refused(tmp_path, text):
    folder = made(tmp_path / "set", "a")
    (folder / "card.json").write_text(text)
    with pytest.raises(ThermorenderError, match=r"card.json is not the card of a data set of format 1 .*; make the"):
        read_dataset(folder)


def test_folder_without_card_is_refused(tmp_path):
    words = r"is not a data set: card\.json is missing; make one with `thermorender"
    with pytest.raises(ThermorenderError, match=words):
        read_dataset(tmp_path)


def npz(**planes):
    kept = io.BytesIO()
    np.savez(kept, **planes)
    return kept.getvalue()


def png(image):
    import cv2

    return cv2.imencode(".png", image)[1].tobytes()


def flipped(data):
    """Bits flipped in the middle."""
    middle = len(data) // 2
    return data[:middle] + bytes(255 - value for value in data[middle : middle + 40]) + data[middle + 40 :]


WHOLE = packed(*pictures(0))


class Evil:
    """A pickle that would run code when it is read."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)


@pytest.mark.parametrize(
    ("end", "data"),
    [
        ("visible.png", b""), ("visible.png", b"no picture"), ("visible.png", flipped(WHOLE["visible.png"])),
        ("visible.png", WHOLE["visible.png"][:-300]), ("thermal.png", WHOLE["thermal.png"][:200]),
        ("thermal.png", png(np.zeros((24, 33), np.uint16))), ("thermal.png", png(np.zeros((*SHAPE, 3), np.uint8))),
        # A header that claims 2⁶⁰ pixels.
        ("visible.png", WHOLE["visible.png"][:16] + b"\x3f\xff\xff\xff\x3f\xff\xff\xff" + WHOLE["visible.png"][24:]),
        ("valid.png", b"no picture"), ("truth.npz", b""), ("truth.npz", b"no archive"),
        ("truth.npz", WHOLE["truth.npz"][:-30]), ("truth.npz", flipped(WHOLE["truth.npz"])),
        ("truth.npz", npz(radiance=np.zeros((3, 3)))), ("truth.npz", npz(radiance=np.array([[Evil()]], object))),
    ],
    ids=lambda value: value if isinstance(value, str) else str(len(value)),
)  # fmt: skip
def test_damaged_files_are_named_in_one_sentence(tmp_path, capfd, end, data):
    Writer(tmp_path / "set", CARD, SCALE).shard("s", [(entry("a-0"), {**WHOLE, end: data})])
    dataset = read_dataset(tmp_path / "set")
    with pytest.raises(ThermorenderError) as refused:
        dataset[0]
    said = str(refused.value)
    assert f"{tmp_path / 'set/shards/s.tar'} is damaged: a-0.{end} is not " in said
    assert said.endswith("; write the shard again")
    assert "\n" not in said and said.count(". ") == 0


def test_damaged_shards_are_named_in_one_sentence(tmp_path):
    folder = made(tmp_path / "set", "a")
    path = folder / "shards/a.tar"
    whole, dataset = path.read_bytes(), read_dataset(folder)
    last = dataset.entries[-1]
    end = sum(last.members["truth.npz"])
    # Cut inside the last file; rewritten with files of other lengths; empty.
    for data in (whole[: end - 5], whole[512:], bytes(512) + whole, b""):
        path.write_bytes(data)
        with pytest.raises(ThermorenderError, match=r"shards/a.tar is damaged: a-1\.\S+ is not .*; write the"):
            dataset.pair(last)
    path.unlink()
    words = r"shards/a.tar cannot be read \(No such file or directory\); copy the data set again, or remove the shard's"
    with pytest.raises(ThermorenderError, match=words):
        dataset[0]


def test_index_that_states_a_huge_length_blames_the_shard(tmp_path):
    folder = made(tmp_path / "set", "a")
    written = json.loads(lines(folder)[0])
    name, (offset, _) = next(iter(written["members"].items()))
    for place in ((offset, 2**62), (2**62, 10), (0, 10)):
        changed = {**written, "members": {**written["members"], name: place}}
        (folder / "index.jsonl").write_text(json.dumps(changed) + "\n")
        dataset = read_dataset(folder)
        with pytest.raises(
            ThermorenderError, match=rf"a\.tar is damaged: .*{name} is not complete at the offset in the"
        ):
            dataset.pair(dataset.entries[0])
