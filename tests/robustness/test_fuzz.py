"""Readers of damaged files, and checks that the fuzzer finds known faults."""

import pytest

from tests.robustness.fuzz import run as fuzz
from tests.robustness.fuzz.corpus import READERS
from thermorender.errors import ThermorenderError

COUNT = 100


@pytest.mark.parametrize("name", READERS)
def test_the_undamaged_file_is_read(name, tmp_path):
    reader = READERS[name]
    reader.make(tmp_path)
    assert not list(fuzz.infinite(reader.read(tmp_path / reader.file)))


@pytest.mark.slow
@pytest.mark.parametrize("name", fuzz.USES)
def test_the_undamaged_file_is_used(name, tmp_path):
    reader = READERS[name]
    reader.make(tmp_path)
    found = fuzz.USES[name](tmp_path / reader.file)
    assert len(found) and not list(fuzz.infinite(found))


@pytest.mark.slow
def test_damaged_files_are_refused_in_a_sentence_or_read_as_finite():
    counts, faults = fuzz.run(COUNT, rendered=0)
    assert not faults, faults[:5]
    assert all(sum(of.values()) == COUNT for of in counts.values())
    assert sum(of["accepted"] > 0 for of in counts.values()) > 0.8 * len(counts)
    # A job that continues after damage may do all of it again.
    assert sum(of["refused"] > 0 for of in counts.values()) > 0.9 * len(counts)


@pytest.mark.slow
def test_accepted_files_can_be_used():
    counts, faults = fuzz.run(COUNT, ["sounding", "mesh obj"], rendered=2)
    assert not faults and all(of["rendered"] >= 2 and of["accepted"] >= of["rendered"] for of in counts.values())


# Inputs out of ten thousand each that once broke a reader (True: its use); none may again.
BROKE = [
    ("track", True, [106, 400, 459]),
    ("thermal properties", False, [2437]),
    ("atmosphere", False, [3786, 4549, 5976, 8611]),
    ("atmosphere", True, [83, 163, 2623]),
    ("map correlation+", False, [882, 1056, 2267, 4772]),
    ("map correlation+", True, [414]),
    ("map palette", False, [266, 2432, 2897]),
    ("map trees", False, [1113, 1683, 2030, 3177, 1868]),
    ("map trees", True, [1154]),
    ("emissivity map", False, [9069, 9327]),
    ("elevation", False, [1468]),
    ("scene", True, [793, 1520, 3206]),
    ("EXR", False, [824, 2044, 4653]),
    ("thermal picture", False, [268]),
    ("mesh glb", False, [1711, 2632, 3852]),
    ("DJI log", False, [3571, 3801]),
    ("tape7", False, [4109]),
    ("selection of samples", True, [226]),
    ("weather year EPW", False, [187]),
    ("data set's card.json", False, [170]),
    ("training's settings.json", False, [62, 249, 279]),
    ("training's log.jsonl", False, [152, 154, 216]),
    ("checkpoint", False, [48, 69, 98]),
    ("flight's frames.jsonl", False, [2324, 3089, 8026, 8979]),
]


@pytest.mark.parametrize("name", READERS)
def test_a_few_damaged_files_are_refused_in_a_sentence_or_read_as_finite(name, tmp_path):
    """Without a separate process: some of the many inputs, and those that once broke this reader."""
    READERS[name].make(tmp_path)
    path = tmp_path / READERS[name].file
    whole = path.read_bytes()
    for number in (*range(5), *(k for broken, used, numbers in BROKE if broken == name and not used for k in numbers)):
        path.write_bytes(fuzz.damaged(whole, name, number))
        fuzz.check(name, path)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "used", "numbers"), BROKE)
def test_inputs_that_once_broke_a_reader_are_refused_or_read(name, used, numbers):
    job, limits = (fuzz.USES[name], fuzz.RENDERING) if used else (READERS[name].read, fuzz.READING)
    ends = fuzz.ends_of(name, job, numbers, 0, limits)
    assert {end.kind for end in ends} <= {"refused", "accepted"}, ends


def test_an_input_is_reproducible():
    whole = b"a = 1.5\nb = [2, 3]\n"
    found = [fuzz.damaged(whole, "camera", number) for number in range(200)]
    assert found == [fuzz.damaged(whole, "camera", number) for number in range(200)]
    assert len(set(found)) > 150 and whole not in found[:3]
    assert found != [fuzz.damaged(whole, "scene", number) for number in range(200)]


def test_an_unknown_reader_is_refused():
    with pytest.raises(ThermorenderError, match="reader 'x' is unknown; give some of atmosphere"):
        fuzz.run(1, ["x"])
