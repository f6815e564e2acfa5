"""Claims in pages and docstrings: `validation/claims.toml` names the test or the result that holds each of them.

A claim is a sentence that states a bound, an accuracy, a comparison or a cost. An entry of the table has

- `in`, the file, and `says`, an excerpt of it, or a list of excerpts,
- `held_by`: `tests/FILE.py::TEST`; a file of results, or of the study that makes them; `FILE#TEXT` for a text in that
  file; "once" for times and memories that were measured once, of which no result is kept,
- `value`, optional: a Python expression of the JSON results in `held_by`, by their stems, that gives the numbers of the
  excerpts in their order. They must agree in all printed digits. None skips a number; for a limit, it is whether the
  results keep it.
"""

import functools
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from validation.page import rows
from validation.verdicts import gathered

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
CLAIMS = tomllib.loads((ROOT / "validation" / "claims.toml").read_text("utf-8"))["claim"]


@functools.cache
def plain(path):
    """The text of a file with single blanks, without the signs of comments."""
    return " ".join(re.sub(r"\n\s*#:?\s", " ", (ROOT / path).read_text("utf-8")).split())


@functools.cache
def result(path):
    return json.loads((ROOT / path).read_text("utf-8"))


def excerpts(claim):
    return [claim["says"]] if isinstance(claim["says"], str) else claim["says"]


def names(claim):
    return f"{claim['in']}: {excerpts(claim)[0][:60]}"


def missing(holder):
    """What a holder lacks, or None."""
    if holder == "once":
        return None
    if "::" in holder:
        path, test = holder.split("::")
        found = (ROOT / path).is_file() and re.search(rf"^def {test}\(", (ROOT / path).read_text("utf-8"), re.M)
        return None if found else f"no test {holder}"
    path, _, text = holder.partition("#")
    if not (ROOT / path).is_file():
        return f"no file {path}"
    return None if text in plain(path) else f"{path} does not say {text!r}"


def disagreements(claim):
    """The printed numbers of a claim that differ from its results, as (printed, found)."""
    printed = re.findall(r"(?<![\w.])[-+−]?\d+(?:[.,]\d+)*", " ".join(excerpts(claim)))
    paths = [holder for holder in claim["held_by"] if holder.endswith(".json")]
    found = eval(claim["value"], {Path(path).stem.replace("-", "_"): result(path) for path in paths} | {"np": np})
    found = list(found) if isinstance(found, (list, tuple, np.ndarray)) else [found]
    assert len(found) == len(printed), f"{len(found)} values for {printed}"
    apart = []
    for text, value in zip(printed, found, strict=True):
        text = text.replace("−", "-").replace(",", "")
        unit = 10.0 ** -len(text.partition(".")[2])
        if isinstance(value, (bool, np.bool_)):
            if not value:
                apart.append((text, value))
        elif value is not None and abs(float(text) - value) > 0.5001 * unit:
            apart.append((text, value))
    return apart


@pytest.mark.parametrize("claim", CLAIMS, ids=names)
def test_a_claim_stands_and_is_held(claim):
    assert set(claim) <= {"in", "says", "held_by", "value"} and claim["held_by"]
    gone = [each for each in excerpts(claim) if " ".join(each.split()) not in plain(claim["in"])]
    assert not gone, f"{claim['in']} does not say this any more; change or remove the entry"
    assert not [fault for fault in map(missing, claim["held_by"]) if fault]
    if "value" in claim:
        assert not disagreements(claim), "the sentence and the result differ"


def test_a_number_that_differs_from_its_result_is_found():
    claim = {"in": "README.md", "says": "41 mK of 1,024 paths", "held_by": ["validation/convergence/convergence.json"]}
    value = "[40.6, convergence['settings']['reference_paths']]"
    assert not disagreements(claim | {"value": value})
    assert disagreements(claim | {"value": value, "says": "42 mK of 1,024 paths"}) == [("42", 40.6)]
    assert missing("validation/test_claims.py::test_nothing") and missing(
        "validation/claims.toml#no such text, it says"
    )


def test_the_table_of_studies_is_that_of_the_verdicts():
    page = plain("docs/accuracy.md")
    found = {row[0]: row for row in rows(gathered(ROOT / "validation"))}
    for name in ("stability", "fuzz", "convergence", "budget", "totals", "air", "sensor", "heat", "moved"):
        _, cases, hold, worst, _ = found[name]
        assert re.search(rf"\| {name}: [^|]*\| {cases} \| {hold} \| {float(worst):g} \|", page), found[name]
