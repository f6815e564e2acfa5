"""Findings in sentences."""

from compare_support import summary_of

from thermorender.apps.compare import (
    findings,
)


def test_findings_are_grouped_by_kind_and_methods_with_the_same_finding_share_a_line():
    said = [
        (True, "B m", "leak", "seen"), (False, "C1 m", "offset", "of 1 K"), (False, "C2 m", "emissivity", "too high"),
        (False, "B m", "offset", "of 2 K"), (False, "C2 n", "emissivity", "too high"),
    ]  # fmt: skip
    reported = [dict(zip(("grave", "method", "kind", "says"), each, strict=True)) for each in said]
    assert findings.grouped(reported) == [
        ("Seen in training", True, ["B m: seen"]),
        ("Offset", False, ["C1 m: of 1 K", "B m: of 2 K"]),
        ("Wrong emissivity", False, ["C2 m, C2 n: too high"]),
    ]


def test_only_scenes_with_a_truth_count_as_checked():
    assert findings.nothing(summary_of()) == "Nothing unusual was found."
    assert (
        findings.nothing(summary_of(references=(True, False))) == "Nothing unusual was found where the truth is known."
    )
    assert findings.nothing(summary_of(references=(False,))) == "Without a truth, no error could be checked."
    assert findings.nothing({**summary_of(), "findings": [{}]}) is None
