"""Findings in sentences."""

from compare_support import summary_of

from thermorender.apps.compare import (
    findings,
)


def test_findings_are_grouped_by_kind_and_methods_with_the_same_finding_share_a_line():
    said = [
        (True, "m on the photograph", "leak", "seen"), (False, "m as kelvin, true materials", "offset", "of 1 K"),
        (False, "m as kelvin, learned materials", "emissivity", "too high"),
        (False, "m on the photograph", "offset", "of 2 K"),
        (False, "n as kelvin, learned materials", "emissivity", "too high"),
    ]  # fmt: skip
    reported = [dict(zip(("grave", "method", "kind", "says"), each, strict=True)) for each in said]
    both = "m as kelvin, learned materials; n as kelvin, learned materials"
    assert findings.grouped(reported) == [
        ("Seen in training", True, ["m on the photograph: seen"]),
        ("Offset", False, ["m as kelvin, true materials: of 1 K", "m on the photograph: of 2 K"]),
        ("Wrong emissivity", False, [f"{both}: too high"]),
    ]


def test_only_scenes_with_a_truth_count_as_checked():
    assert findings.nothing(summary_of()) == "Nothing unusual was found."
    assert (
        findings.nothing(summary_of(references=(True, False))) == "Nothing unusual was found where the truth is known."
    )
    assert findings.nothing(summary_of(references=(False,))) == "Without a truth, no error could be checked."
    assert findings.nothing({**summary_of(), "findings": [{}]}) is None
