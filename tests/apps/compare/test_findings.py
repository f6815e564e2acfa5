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


def method(rmse, unexplained, kind="foreign"):
    """A method of a comparison: its RMS error [K], and the share of the square error without a named cause."""
    ground = {"me_k": 0.0, "mae_k": rmse, "sd_k": rmse, "rmse_k": rmse, "pixels": 9, "pixels_without_temperature": 0}
    return {"kind": kind, "bounds": None, "true_objects": False, "errors": {"radiometric": {"ground": ground}},
            "causes": {"unexplained": unexplained, "named": [], "resembles": True}, "order": [], "gain": None,
            "structure": {"shift": None}}  # fmt: skip


def test_the_headline_is_the_largest_error_without_a_named_cause():
    summary = summary_of() | {"methods": {"a": method(1.0, 0.04), "b": method(2.0, 1.0), "c": method(0.5, 0.0)}}
    assert findings.headline(summary) == [
        "b: no named cause explains 2.00 K of its RMS error on ground of 2.00 K.",
        "a: no named cause explains 0.20 K of its RMS error on ground of 1.00 K.",
    ]
    # A constant competes with nobody, and its error is that it has no pattern.
    summary["methods"] = {"mean": method(5.0, 1.0, "frame-mean"), "c": method(0.5, 0.0)}
    assert findings.headline(summary) == ["Named causes explain all errors to 0.1 K (RMS); nothing unusual was found."]
    # Words of calm stand only where nothing at all is named.
    assert "nothing unusual" not in findings.headline({**summary, "findings": [{}]})[0]


def test_only_scenes_with_a_truth_count_as_checked():
    some = {"methods": {"a": method(0.05, 1.0)}}
    assert findings.headline(summary_of() | some)[0].endswith("nothing unusual was found.")
    assert "where the truth is known" in findings.headline(summary_of(references=(True, False)) | some)[0]
    assert findings.headline(summary_of(references=(False,)) | some) == ["Without a truth, no error could be checked."]
