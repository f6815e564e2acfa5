"""Findings of a comparison, in sentences: offsets, wrong contrast, shifts, emissivities, leaks, better baselines."""

from typing import Any

Finding = dict[str, Any]

# An offset is reported from this size on [K], if it is at least this many standard errors.
_OFFSET_K, _SURE = 0.1, 3.0
# A shift is reported from this size on [px] (second value: a single pose, without a standard error), if the pictures
# correlate at least this well.
_SHIFT_PX, _SINGLE_PX, ALIKE = 0.5, 1.0, 0.5
# A wrong contrast is reported if the gain differs from 1 by this much, the correlation is at least this high, and it
# explains at least this share of the square error; a gain below the last value counts as no contrast.
_GAIN, _PATTERN, _MOST, _FLAT = 0.1, 0.8, 0.5, 0.2
# A material is reported if its error is this many times the median error of the others in the same scenes.
_APART = 3.0
_TITLES = {
    "leak": "Seen in training", "circular": "Circular", "offset": "An offset is most of the error",
    "shift": "Shifted", "unlike": "Frames unlike the scene", "contrast": "Wrong contrast",
    "flat": "Almost no contrast, or inverted contrast", "material": "Materials with unusually large errors",
    "emissivity": "Wrong emissivity", "constant": "Worse than a constant",
}  # fmt: skip


def of(summary: dict[str, Any]) -> list[Finding]:
    """Return [{"grave": bool, "method": label, "kind": word, "says": sentence}] of a comparison's summary.

    Methods with true object temperatures are skipped: their errors on the ground are those of the method without.
    """
    found = []
    for label, own in summary["methods"].items():
        found += [_finding(label, "leak", leak, grave=True) for leak in own["leaks"]]
        found += [_finding(label, "circular", text, grave=True) for text in own["circular"]]
        if not own["errors"] or own["true_objects"]:
            continue
        ground = own["errors"]["radiometric"]["ground"]
        found += _offset(label, ground)
        found += _shift(label, own)
        # An error that a wrong contrast explains needs no other cause.
        found += _contrast(label, own) or _materials(label, own)
        found += _rendered_with(label, own["emissivities"]["scene"])
    found += _beaten(summary)
    return sorted(found, key=lambda each: not each["grave"])


def grouped(found: list[Finding]) -> list[tuple[str, bool, list[str]]]:
    """Return [(title, grave, lines)] of findings by kind; methods with the same finding share a line."""
    groups: dict[tuple[str, bool], dict[str, list[str]]] = {}
    for each in found:
        groups.setdefault((each["kind"], each["grave"]), {}).setdefault(each["says"], []).append(each["method"])
    return [(_TITLES[kind], grave, [f"{', '.join(labels)}: {says}" for says, labels in lines.items()])
            for (kind, grave), lines in groups.items()]  # fmt: skip


def nothing(summary: dict[str, Any]) -> str | None:
    """Return a sentence on what was not found or not checked; None where a list of findings says all."""
    known = [scene["reference"] for scene in summary["scenes"]]
    if not any(known):
        return "Without a truth, no error could be checked."
    if summary["findings"]:
        return None
    return "Nothing unusual was found" + ("." if all(known) else " where the truth is known.")


def _finding(label: str, kind: str, says: str, grave: bool = False) -> Finding:
    return {"grave": grave, "method": label, "kind": kind, "says": says}


def _offset(label: str, ground: dict[str, Any]) -> list[Finding]:
    ends = ground["interval_95"]["me_k"] if ground.get("interval_95") else None
    mean = ground["me_k"]
    if mean is None or ends is None or abs(mean) < _OFFSET_K:
        return []
    error = (ends[1] - ends[0]) / 3.92
    if abs(mean) < _SURE * error or mean**2 < _MOST * ground["rmse_k"] ** 2:
        return []
    return [_finding(label, "offset", f"an offset of {mean:+.2f} K ({ends[0]:+.2f}…{ends[1]:+.2f}) is most of its "
                     f"square error; errors scatter about it by {ground['sd_k']:.2f} K")]  # fmt: skip


def _shift(label: str, own: dict[str, Any]) -> list[Finding]:
    """Return the shift of a method's pictures: of translated photographs against the same map rendered, of another
    program's frames against the reference. Frames rendered here cannot be shifted."""
    if own["letter"] == "foreign":
        shift, against = own["structure"]["shift"], "the reference"
    else:
        shift, against = own["registered"], f"C1 {own['map']}"
    if shift is None or abs(shift["correlation"]) < ALIKE:
        # A map may show anything, but frames of the same pose must look like the reference. Flat frames show no shift.
        return [] if own["letter"] != "foreign" or own["gain"] is None else [_finding(
            label, "unlike", f"its pictures do not look like {against} at any shift tried: they show other poses, are "
                             "shifted too far, or have too little contrast")]  # fmt: skip
    errors = shift["error_px"] or (None, None)
    moved = [(shift[name], error) for name, error in zip(("right_px", "down_px"), errors, strict=True)]
    if not any(abs(value) >= (_SINGLE_PX if error is None else max(_SHIFT_PX, _SURE * error))
               for value, error in moved):  # fmt: skip
        return []
    (right, _), (down, _) = moved
    text = f"its pictures are shifted by {right:+.1f} px to the right and {down:+.1f} px down against {against}"
    text += "" if shift["error_px"] else " (a single pose, so without a standard error)"
    return [_finding(label, "shift", text)]


def _contrast(label: str, own: dict[str, Any]) -> list[Finding]:
    """Return whether a method shows the pattern of the ground with too much, too little or almost no contrast."""
    found = own["gain"]
    if found is None or own["letter"] in ("D", "E"):
        return []
    if found["gain"] < _FLAT:
        return [_finding(label, "flat", f"it shows {found['gain']:.2f} of the reference's contrast (correlation "
                         f"{found['correlation']:.2f})")]  # fmt: skip
    if found["correlation"] < _PATTERN:
        return []
    if abs(found["gain"] - 1.0) < _GAIN or found["explained"] < _MOST:
        return []
    text = (
        f"it shows {found['gain']:.2f} of the reference's contrast, which is {found['explained']:.0%} of its square "
        f"error about each pose's mean (correlation {found['correlation']:.2f})"
    )
    return [_finding(label, "contrast", text)]


def _materials(label: str, method: dict[str, Any]) -> list[Finding]:
    """Return materials with unusually large errors, and the emissivity error that explains it in foreign frames."""
    found = []
    for name, own in method["emissivities"]["explained"].items():
        # A single material cannot be compared with others.
        if own["others_k"] is None or abs(own["error_k"]) < _APART * own["others_k"]:
            continue
        text = f"the error of {name} ({own['share']:.1%} of the ground's pixels) is {own['error_k']:+.2f} K"
        if method["letter"] == "foreign" and own["change"] is not None:
            text += f"; an emissivity wrong by {own['change']:+.3f} explains {own['explained']:.0%} of the square error"
            found.append(_finding(label, "emissivity", text))
        else:
            text += f"; the median of the others in its scenes is {own['others_k']:.2f} K"
            found.append(_finding(label, "material", text))
    return found


def _rendered_with(label: str, emissivities: dict[str, Any]) -> list[Finding]:
    """Return materials that a method renders with another emissivity than the reference."""
    return [
        _finding(label, "emissivity", f"{name} ({own['share']:.1%} of the ground's texels) is rendered with a band "
                 f"emissivity of {own['used']:.3f} instead of {own['true']:.3f}")
        for name, own in emissivities.items()
    ]  # fmt: skip


def _beaten(summary: dict[str, Any]) -> list[Finding]:
    """Return the maps whose error is significantly larger than the constant's, among those that know the hour."""
    worse, limit = [], 0.0
    for label, own in summary["methods"].items():
        more = own["more_than_constant"]
        hour = own["bounds"] != "own" and own["letter"] in ("B", "C1", "C2", "P")
        if not more or not hour or own["true_objects"] or not more["interval_95"] or not more["interval_95"][0] > 0.0:
            continue
        low, high = more["interval_95"]
        limit = more["other_mae_k"]
        worse.append(f"{label} ({more['own_mae_k']:.2f} K, {low:.2f}…{high:.2f} more)")
    if not worse:
        return []
    text = f"the error of one constant of the training part is {limit:.2f} K, significantly less than that of "
    return [_finding("D constant", "constant", text + "; ".join(worse))]
