"""Findings of a comparison, in sentences: offsets, wrong contrast, shifts, emissivities, leaks, better baselines."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from thermorender.apps.compare.causes import LEAST, SHARE, Named
from thermorender.apps.compare.methods import A_CONSTANT, FLAT, FOREIGN, LABELS, MAPPED, TRUE_MATERIALS
from thermorender.apps.compare.registration import ALIKE

Finding = dict[str, Any]
# (kind of finding, sentence)
Said = Iterator[tuple[str, str]]

# An offset is reported if it is at least this many standard errors.
_SURE = 3.0
# A shift against another picture of the same map is reported from this size on [px] (second value: a single pose,
# without a standard error).
_SHIFT_PX, _SINGLE_PX = 0.5, 1.0
# Edges that coincide by this many standard deviations show the same pose.
_SAME_EDGES = 3.0
# A gain below this counts as no contrast.
_FLAT = 0.2
# Most frames that are named.
_MOST_FRAMES = 6
_TITLES = {
    "leak": "Seen in training", "empty": "Without temperatures", "circular": "Circular", "offset": "Offset",
    "drift": "Offset that changes", "shift": "Shifted", "zoom": "Wrong field of view", "clipping": "Clipped",
    "order": "Frames of other poses", "mirrored": "Mirrored",
    "unlike": "Frames unlike the scene", "contrast": "Wrong contrast",
    "blur": "Blurred",
    "flat": "Almost no contrast, or inverted contrast", "material": "An offset on a material",
    "emissivity": "Wrong emissivity", "constant": "Worse than a constant",
}  # fmt: skip
_GRAVE = ("leak", "circular", "empty")


def of(summary: dict[str, Any]) -> list[Finding]:
    """Return [{"grave": bool, "method": label, "kind": word, "says": sentence}] of a comparison's summary.

    Methods with true object temperatures are skipped, since their ground is that of the method without.
    """
    found = [each for label, own in summary["methods"].items() for each in of_method(label, own)]
    beaten = _beaten(summary)
    if beaten:
        found.append({"grave": False, "method": A_CONSTANT, "kind": "constant", "says": beaten})
    return sorted(found, key=lambda each: not each["grave"])


def of_method(label: str, own: dict[str, Any]) -> list[Finding]:
    """Return the findings of one method's summary."""
    return [{"grave": kind in _GRAVE, "method": label, "kind": kind, "says": says} for kind, says in _of_method(own)]


def grouped(found: list[Finding]) -> list[tuple[str, bool, list[str]]]:
    """Return [(title, grave, lines)] of findings by kind; methods with the same finding share a line."""
    groups: dict[tuple[str, bool], dict[str, list[str]]] = {}
    for each in found:
        groups.setdefault((each["kind"], each["grave"]), {}).setdefault(each["says"], []).append(each["method"])
    return [(_TITLES[kind], grave, [f"{'; '.join(labels)}: {says}" for says, labels in lines.items()])
            for (kind, grave), lines in groups.items()]  # fmt: skip


def unexplained(own: dict[str, Any]) -> float | None:
    """Return the root mean square error on ground that no named cause of a method explains [K]; None if unchecked.

    Of a method without a pattern of its own, it is the error about its mean.
    """
    if not own["errors"] or own["errors"]["radiometric"]["ground"]["rmse_k"] is None:
        return None
    ground = own["errors"]["radiometric"]["ground"]
    if any(_elsewhere(own)):
        shown = own["order"]
        # Mirrored and unlike pictures are explained as a whole, frames of other poses by the pose that they show.
        return float(ground["rmse_k"] * (1.0 - min(each["share"] for each in shown)) ** 0.5) if shown else 0.0
    if own["causes"] is None:
        said = any(_constant_offset(own))
        return float(ground["sd_k"] if said else ground["rmse_k"])
    return float(ground["rmse_k"] * own["causes"]["unexplained"] ** 0.5)


def headline(summary: dict[str, Any]) -> list[str]:
    """Return sentences on the errors that no named cause explains, the largest first, or that nothing was checked."""
    known = [scene["reference"] for scene in summary["scenes"]]
    if not any(known):
        return ["Without a truth, no error could be checked."]
    rivals = {label: own for label, own in summary["methods"].items()
              if not own["true_objects"] and own["kind"] not in FLAT}  # fmt: skip
    left = {label: value for label, own in rivals.items() if (value := unexplained(own)) is not None}
    if not left:
        return []
    where = "" if all(known) else " where the truth is known"
    large = sorted((label for label in left if left[label] >= LEAST["offset"]), key=lambda label: -left[label])
    if not large:
        words = "" if summary["findings"] else "; nothing unusual was found"
        return [f"Named causes explain all errors{where} to {LEAST['offset']:g} K (RMS){words}."]
    return [f"{label}: no named cause explains {left[label]:.2f} K of its RMS error on ground of "
            f"{summary['methods'][label]['errors']['radiometric']['ground']['rmse_k']:.2f} K{where}."
            for label in large]  # fmt: skip


def _of_method(own: dict[str, Any]) -> Said:
    yield from (("leak", leak) for leak in own["leaks"])
    yield from (("circular", text) for text in own["circular"])
    if not own["errors"] or own["true_objects"]:
        return
    ground = own["errors"]["radiometric"]["ground"]
    if not ground["pixels"] and ground["pixels_without_temperature"]:
        yield "empty", "none of its pixels on the ground has a temperature, so its error could not be checked"
        return
    yield from _causes(own)
    # Materials that a method renders with another emissivity than the reference.
    for name, each in own["emissivities"]["scene"].items():
        yield "emissivity", (f"{name} ({each['share']:.1%} of the ground's texels) is rendered with a band emissivity "
                             f"of {each['used']:.3f} instead of {each['true']:.3f}")  # fmt: skip


def _causes(own: dict[str, Any]) -> Said:
    """Yield what explains a method's error; pictures that show something else have no other cause."""
    if own["causes"] is None:
        yield from _constant_offset(own)
        yield from _registered(own)
        return
    elsewhere = list(_elsewhere(own))
    if elsewhere:
        yield from elsewhere
        return
    yield from _registered(own)
    for cause in own["causes"]["named"]:
        share = f"explains {cause['share']:.0%} of the square error left without it"
        for kind, says in _cause(own, cause):
            yield kind, f"{says}; {share}"


def _cause(own: dict[str, Any], cause: dict[str, Any]) -> Said:
    """Yield a named cause with its size."""
    kind, size, error = cause["kind"], cause["size"], cause["error"]
    if kind == "offset":
        yield kind, f"an offset of {size[0]:+.2f} K (standard error {error[0]:.2f} K)"
    elif kind == "contrast":
        gain = 1.0 + size[0]
        yield ("flat" if gain < _FLAT else kind,
               f"it shows {gain:.2f} of the reference's contrast (standard error {error[0]:.2f})")  # fmt: skip
    elif kind == "shift":
        yield kind, (f"its pictures are shifted by {size[0]:+.1f} px to the right and {size[1]:+.1f} px down "
                     f"against the reference (standard error {max(error):.2f} px)")  # fmt: skip
    elif kind == "zoom":
        yield kind, (f"its pictures are {1.0 + size[0]:.3f} times as large as the reference's (standard error "
                     f"{error[0]:.4f}): its field of view is wrong by {-size[0]:+.1%}")  # fmt: skip
    elif kind == "drift":
        yield kind, (f"its offset changes from pose to pose, by a standard deviation of {_spread(size):.2f} K, "
                     f"{_trend(size)}")  # fmt: skip
    elif kind == "clipping":
        yield kind, (f"its temperatures are clipped {'above' if size[1] > 0.0 else 'below'} {size[0]:.1f} K, on "
                     f"{abs(size[1]):.0%} of the ground of the poses concerned")  # fmt: skip
    elif kind == "blur":
        sigma = float(size[0] ** 0.5)
        yield kind, (f"its pictures are blurred by a Gaussian of {sigma:.1f} px (standard error "
                     f"{0.5 * error[0] / sigma:.2f} px)")  # fmt: skip
    else:
        yield kind, _material(own, kind, cause["material"], size[0], error[0])


def _spread(offsets: Sequence[float]) -> float:
    return float(np.std(offsets))


def _trend(offsets: Sequence[float]) -> str:
    """Return the first and the last offset where it rises or falls over the poses fitted, else the range."""
    steps = np.diff(offsets)
    if (steps > 0.0).all() or (steps < 0.0).all():
        return f"from {offsets[0]:+.2f} to {offsets[-1]:+.2f} K about its mean over the flight"
    return f"between {min(offsets):+.2f} and {max(offsets):+.2f} K about its mean"


def _material(own: dict[str, Any], kind: str, name: str, size: float, error: float) -> str:
    """Return an error on one material in words: by its emissivity, or an offset from whatever cause."""
    materials = own["groups"]["radiometric"]["material"]
    ground = sum(each["pixels"] for each in materials.values())
    text = f"the error of {name} ({materials[name]['pixels'] / max(ground, 1):.1%} of the pixels) is "
    text += f"{materials[name]['me_k']:+.2f} K; "
    if kind == "emissivity":
        text += f"an emissivity wrong by {size:+.3f} (standard error {error:.3f})"
        return f"{text} explains it better than an offset"
    return text + f"an offset of {size:+.2f} K on this material (standard error {error:.2f} K), of unknown cause"


def _elsewhere(own: dict[str, Any]) -> Said:
    """Yield whether the pictures of another program are mirrored or show other poses."""
    if own["order"]:
        yield from (("order", _ordered(each, len(own["order"]) > 1)) for each in own["order"])
        return
    shift = own["structure"]["shift"]
    if own["kind"] != FOREIGN or own["gain"] is None or (shift and abs(shift["correlation"]) >= ALIKE):
        return
    height = own["likeness"]["mirrored"]
    name = max(height, key=lambda each: height[each], default=None)
    if name is not None and height[name] >= ALIKE:
        now = shift["correlation"] if shift else 0.0
        yield "mirrored", (f"its pictures are mirrored {name}: mirrored back, they correlate with the reference by "
                           f"{height[name]:.2f}, as they are by {now:.2f}")  # fmt: skip
    elif not own["causes"]["resembles"] and (own["likeness"]["edges"] or 0.0) < _SAME_EDGES:
        yield "unlike", ("its pictures do not look like the reference at any shift tried, nor mirrored: they show "
                         "other poses, are shifted too far, or have too little contrast")  # fmt: skip


def _ordered(found: dict[str, Any], several: bool) -> str:
    """Return which poses frames show, in words."""
    shows, late = found["shows"], found["late"]
    where = f"in {found['scene']}, " if several else ""
    if late is not None:
        words = f"its frames are {'late' if late > 0 else 'early'} by {abs(late)} pose{'s' * (abs(late) > 1)}"
    else:
        other = [f"frame {k} shows pose {pose}" for k, pose in enumerate(shows) if k != pose]
        words = f"its frames show other poses: {', '.join(other[:_MOST_FRAMES])}"
        words += f" and {len(other) - _MOST_FRAMES} more" if len(other) > _MOST_FRAMES else ""
    return f"{where}{words}; this explains {found['share']:.0%} of the square error about a line"


def said(kind: str, ends: tuple[float, float] | None, cause: Named, rest: float) -> bool:
    """Return whether a cause of a kind of method is reported; `ends` are those of its mean error's interval [K].

    Frames rendered here cannot be shifted. An offset is also sure by the bootstrap, of which the scatter counts that
    other causes leave, a share `rest` of the square error about the offset.
    """
    if cause.cause[0] == "shift":
        return kind == FOREIGN
    if cause.cause[0] == "offset":
        error = _error_of_mean(ends)
        return error is not None and abs(cause.size[0]) >= _SURE * max(rest**0.5 * error, cause.error[0])
    return True


def _ends(own: dict[str, Any]) -> tuple[float, float] | None:
    found: tuple[float, float] | None = (own["errors"]["radiometric"]["ground"].get("interval_95") or {}).get("me_k")
    return found


def _error_of_mean(ends: tuple[float, float] | None) -> float | None:
    """Return the standard error of a mean error [K] by its interval of 95 %; None without one."""
    return None if ends is None else (ends[1] - ends[0]) / 3.92


def _constant_offset(own: dict[str, Any]) -> Said:
    """Yield the offset of a method without contrast, which has no rivals."""
    ground = own["errors"]["radiometric"]["ground"]
    mean = ground["me_k"]
    if mean is None or abs(mean) < LEAST["offset"] or mean**2 < SHARE * ground["rmse_k"] ** 2:
        return
    both = _error_of_mean(_ends(own))
    if both is not None and abs(mean) >= _SURE * both:
        yield "offset", (f"an offset of {mean:+.2f} K (standard error {both:.2f} K); errors scatter about it by "
                         f"{ground['sd_k']:.2f} K")  # fmt: skip


def _registered(own: dict[str, Any]) -> Said:
    """Yield the shift of translated photographs against the same map rendered, however large its error."""
    shift = own["registered"]
    if shift is None or abs(shift["correlation"]) < ALIKE:
        return
    moved = shift["right_px"], shift["down_px"]
    least = [max(_SHIFT_PX, _SURE * error) for error in shift["error_px"] or ()] or [_SINGLE_PX] * 2
    if any(abs(value) >= limit for value, limit in zip(moved, least, strict=True)):
        yield "shift", (f"its pictures are shifted by {moved[0]:+.1f} px to the right and {moved[1]:+.1f} px down "
                        f"against {LABELS[TRUE_MATERIALS].format(own['map'])}"
                        + ("" if shift["error_px"] else " (a single pose, so without a standard error)"))  # fmt: skip


def _beaten(summary: dict[str, Any]) -> str:
    """Return the maps that know the hour and whose error is significantly larger than the constant's, in words."""
    worse, limit = [], 0.0
    for label, own in summary["methods"].items():
        more = own["more_than_constant"]
        hour = own["bounds"] != "own" and own["kind"] in MAPPED
        if not more or not hour or own["true_objects"] or not more["interval_95"] or not more["interval_95"][0] > 0.0:
            continue
        low, high = more["interval_95"]
        limit = more["other_mae_k"]
        worse.append(f"{label} ({more['own_mae_k']:.2f} K, {low:.2f}…{high:.2f} more)")
    if not worse:
        return ""
    return (f"the error of one constant of the training part is {limit:.2f} K, significantly less than that of "
            + "; ".join(worse))  # fmt: skip
