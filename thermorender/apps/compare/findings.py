"""Findings of a comparison, in sentences: offsets, wrong contrast, shifts, emissivities, leaks, better baselines."""

from collections.abc import Callable
from typing import Any

from thermorender.apps.compare.causes import LEAST, SHARE
from thermorender.apps.compare.registration import ALIKE

Finding = dict[str, Any]

# An offset is reported if it is at least this many standard errors.
_SURE = 3.0
# A shift against another picture of the same map is reported from this size on [px] (second value: a single pose,
# without a standard error).
_SHIFT_PX, _SINGLE_PX = 0.5, 1.0
# Edges that coincide by this many standard deviations show the same pose.
_SAME_EDGES = 3.0
# A gain below this counts as no contrast.
_FLAT = 0.2
_TITLES = {
    "leak": "Seen in training", "empty": "Without temperatures", "circular": "Circular", "offset": "Offset",
    "shift": "Shifted", "mirrored": "Mirrored", "unlike": "Frames unlike the scene", "contrast": "Wrong contrast",
    "blur": "Blurred",
    "flat": "Almost no contrast, or inverted contrast", "material": "An offset on a material",
    "emissivity": "Wrong emissivity", "constant": "Worse than a constant",
}  # fmt: skip


def of(summary: dict[str, Any]) -> list[Finding]:
    """Return [{"grave": bool, "method": label, "kind": word, "says": sentence}] of a comparison's summary.

    Methods with true object temperatures are skipped: their errors on the ground are those of the method without.
    """
    found = []
    for label, own in summary["methods"].items():
        found += of_method(label, own)
    found += _beaten(summary)
    return sorted(found, key=lambda each: not each["grave"])


def of_method(label: str, own: dict[str, Any]) -> list[Finding]:
    """Return the findings of one method's summary."""
    found = [_finding(label, "leak", leak, grave=True) for leak in own["leaks"]]
    found += [_finding(label, "circular", text, grave=True) for text in own["circular"]]
    if not own["errors"] or own["true_objects"]:
        return found
    ground = own["errors"]["radiometric"]["ground"]
    if not ground["pixels"] and ground["pixels_without_temperature"]:
        return [*found, _finding(label, "empty", "none of its pixels on the ground has a temperature, so its error "
                                 "could not be checked", grave=True)]  # fmt: skip
    return [*found, *_causes(label, own), *_rendered_with(label, own["emissivities"]["scene"])]


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


def _causes(label: str, own: dict[str, Any]) -> list[Finding]:
    """Return what explains a method's error; pictures that show something else have no other cause."""
    if own["causes"] is None:
        return [*_constant_offset(label, own), *_registered(label, own)]
    elsewhere = _elsewhere(label, own)
    if elsewhere:
        return elsewhere
    found = _registered(label, own)
    for cause in own["causes"]["named"]:
        found += _SAYS[cause["kind"]](label, own, cause)
    return found


def _elsewhere(label: str, own: dict[str, Any]) -> list[Finding]:
    """Return whether the pictures of another program are mirrored or show other poses."""
    shift = own["structure"]["shift"]
    if own["letter"] != "foreign" or own["gain"] is None or (shift and abs(shift["correlation"]) >= ALIKE):
        return []
    height = own["likeness"]["mirrored"]
    name = max(height, key=lambda each: height[each], default=None)
    if name is not None and height[name] >= ALIKE:
        return [_finding(label, "mirrored", f"its pictures are mirrored {name}: mirrored back, they correlate with the "
                         f"reference by {height[name]:.2f}, as they are by {shift['correlation'] if shift else 0.0:.2f}"
                         )]  # fmt: skip
    if own["causes"]["resembles"] or (own["likeness"]["edges"] or 0.0) >= _SAME_EDGES:
        return []
    return [_finding(label, "unlike", "its pictures do not look like the reference at any shift tried, nor mirrored: "
                     "they show other poses, are shifted too far, or have too little contrast")]  # fmt: skip


def _offset_k(own: dict[str, Any], size: float, error: float) -> float | None:
    """Return the standard error of an offset [K] by the fit or by the bootstrap, the larger; None if it is unknown."""
    ends = (own["errors"]["radiometric"]["ground"].get("interval_95") or {"me_k": None})["me_k"]
    if ends is None:
        return None
    both = max(error, (ends[1] - ends[0]) / 3.92)
    return both if abs(size) >= _SURE * both else None


def _offset(label: str, own: dict[str, Any], cause: dict[str, Any]) -> list[Finding]:
    (size,), (error,) = cause["size"], cause["error"]
    both = _offset_k(own, size, error)
    if both is None:
        return []
    return [_finding(label, "offset", f"an offset of {size:+.2f} K (standard error {both:.2f} K); {_share(cause)}")]


def _constant_offset(label: str, own: dict[str, Any]) -> list[Finding]:
    """Return the offset of a method without contrast, which has no rivals."""
    ground = own["errors"]["radiometric"]["ground"]
    mean = ground["me_k"]
    if mean is None or abs(mean) < LEAST["offset"] or mean**2 < SHARE * ground["rmse_k"] ** 2:
        return []
    both = _offset_k(own, mean, 0.0)
    if both is None:
        return []
    return [_finding(label, "offset", f"an offset of {mean:+.2f} K (standard error {both:.2f} K); errors scatter about "
                     f"it by {ground['sd_k']:.2f} K")]  # fmt: skip


def _shift(label: str, own: dict[str, Any], cause: dict[str, Any]) -> list[Finding]:
    """Return the shift of another program's frames; frames rendered here cannot be shifted."""
    if own["letter"] != "foreign":
        return []
    (right, down), error = cause["size"], max(cause["error"])
    return [_finding(label, "shift", f"its pictures are shifted by {right:+.1f} px to the right and {down:+.1f} px "
                     f"down against the reference (standard error {error:.2f} px); {_share(cause)}")]  # fmt: skip


def _registered(label: str, own: dict[str, Any]) -> list[Finding]:
    """Return the shift of translated photographs against the same map rendered, however large its error."""
    shift = own["registered"]
    if shift is None or abs(shift["correlation"]) < ALIKE:
        return []
    errors = shift["error_px"] or (None, None)
    moved = [(shift[name], error) for name, error in zip(("right_px", "down_px"), errors, strict=True)]
    if not any(abs(value) >= (_SINGLE_PX if error is None else max(_SHIFT_PX, _SURE * error))
               for value, error in moved):  # fmt: skip
        return []
    (right, _), (down, _) = moved
    text = f"its pictures are shifted by {right:+.1f} px to the right and {down:+.1f} px down against C1 {own['map']}"
    text += "" if shift["error_px"] else " (a single pose, so without a standard error)"
    return [_finding(label, "shift", text)]


def _contrast(label: str, own: dict[str, Any], cause: dict[str, Any]) -> list[Finding]:
    """Return whether a method shows the pattern of the ground with too much, too little or almost no contrast."""
    gain, error = 1.0 + cause["size"][0], cause["error"][0]
    text = f"it shows {gain:.2f} of the reference's contrast (standard error {error:.2f}); {_share(cause)}"
    return [_finding(label, "flat" if gain < _FLAT else "contrast", text)]


def _blur(label: str, own: dict[str, Any], cause: dict[str, Any]) -> list[Finding]:
    variance, error = cause["size"][0], cause["error"][0]
    sigma = float(variance**0.5)
    return [_finding(label, "blur", f"its pictures are blurred by a Gaussian of {sigma:.1f} px (standard error "
                     f"{0.5 * error / sigma:.2f} px); {_share(cause)}")]  # fmt: skip


def _material(label: str, own: dict[str, Any], cause: dict[str, Any]) -> list[Finding]:
    """Return an error on one material: by its emissivity, or an offset from whatever cause."""
    name, (size,), (error,) = cause["material"], cause["size"], cause["error"]
    materials = own["groups"]["radiometric"]["material"]
    ground = sum(each["pixels"] for each in materials.values())
    text = f"the error of {name} ({materials[name]['pixels'] / max(ground, 1):.1%} of the pixels) is "
    text += f"{materials[name]['me_k']:+.2f} K; "
    if cause["kind"] == "emissivity":
        text += f"an emissivity wrong by {size:+.3f} (standard error {error:.3f}) explains it better than an offset; "
    else:
        text += f"an offset of {size:+.2f} K on this material (standard error {error:.2f} K), of unknown cause; "
    return [_finding(label, cause["kind"], text + _share(cause))]


def _share(cause: dict[str, Any]) -> str:
    return f"explains {cause['share']:.0%} of the square error left without it"


_SAYS: dict[str, Callable[[str, dict[str, Any], dict[str, Any]], list[Finding]]] = {
    "offset": _offset, "contrast": _contrast, "shift": _shift, "blur": _blur, "material": _material,
    "emissivity": _material,
}  # fmt: skip


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
