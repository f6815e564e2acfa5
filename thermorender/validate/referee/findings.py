"""What a reader should know first, in sentences: offsets, wrong contrast, shifts, emissivities, leaks, and what beats a
method."""

# An offset is told from this [K], and where it is this many of its standard errors.
_OFFSET_K, _SURE = 0.1, 3.0
# A shift is told from this [px], from the second where a single pose tells no error, where pictures correlate so well.
_SHIFT_PX, _SINGLE_PX, _ALIKE = 0.5, 1.0, 0.5
# A wrong contrast is told from this gain off 1, where the pattern is known so well, and where it is most of the error.
_GAIN, _PATTERN, _MOST = 0.1, 0.8, 0.5
# A material's error stands apart where it is so many times the median one of the others.
_APART = 3.0
_TITLES = {
    "leak": "Seen in training", "circular": "Circular", "offset": "An offset is most of the error",
    "shift": "Shifted", "unlike": "Frames unlike the scene", "contrast": "Wrong contrast",
    "material": "Materials that err apart", "emissivity": "Wrong emissivity", "constant": "Beaten by a constant",
}  # fmt: skip


def of(summary):
    """Return [{"grave": bool, "method": label, "kind": word, "says": words}] of a comparison's summary.

    The row that knows the true objects says of the ground what the row without them says.
    """
    found = []
    for label, own in summary["methods"].items():
        found += [_told(label, "leak", leak, grave=True) for leak in own["leaks"]]
        found += [_told(label, "circular", text, grave=True) for text in own["circular"]]
        if not own["errors"] or own["knows"] == "the objects":
            continue
        ground = own["errors"]["radiometric"]["ground"]
        found += _offset(label, ground)
        found += _shift(label, own)
        contrast = _contrast(label, own)
        # What a wrong contrast explains asks for no other cause.
        found += contrast or _materials(label, own)
        found += _rendered_with(label, own["emissivities"]["scene"])
    found += _beaten(summary)
    return sorted(found, key=lambda each: not each["grave"])


def grouped(found):
    """Return [(title, grave, lines)] of findings by kind; methods of which the same is said share a line."""
    groups = {}
    for each in found:
        groups.setdefault((each["kind"], each["grave"]), {}).setdefault(each["says"], []).append(each["method"])
    return [(_TITLES[kind], grave, [f"{', '.join(labels)}: {says}" for says, labels in lines.items()])
            for (kind, grave), lines in groups.items()]  # fmt: skip


def _told(label, kind, says, grave=False):
    return {"grave": grave, "method": label, "kind": kind, "says": says}


def _offset(label, ground):
    ends = ground["interval_95"]["me_k"] if ground.get("interval_95") else None
    mean = ground["me_k"]
    if mean is None or ends is None or abs(mean) < _OFFSET_K:
        return []
    error = (ends[1] - ends[0]) / 3.92
    if abs(mean) < _SURE * error or abs(mean) < 0.5 * ground["rmse_k"]:
        return []
    return [_told(label, "offset", f"an offset of {mean:+.2f} K ({ends[0]:+.2f}…{ends[1]:+.2f}) is most of its error; "
                                   f"about it errors scatter by {ground['sd_k']:.2f} K")]  # fmt: skip


def _shift(label, own):
    """Whether a method's pictures lie beside what they show: those of a photograph against the same map rendered, those
    of another program against the reference. What is rendered here cannot be shifted."""
    if own["letter"] == "foreign":
        shift, against = own["structure"]["shift"], "the reference"
    else:
        shift, against = own["registered"], f"C1 {own['map']}"
    if shift is None or abs(shift["correlation"]) < _ALIKE:
        # A map may show anything; frames of this very pose have to look like it.
        return [] if own["letter"] != "foreign" or not _varies(own) else [_told(
            label, "unlike", f"its pictures do not look like {against} at any shift that is looked for: they are of "
                             "other poses, far beside, or hardly show what is there")]  # fmt: skip
    errors = shift["error_px"] or (None, None)
    moved = [(shift[name], error) for name, error in zip(("right_px", "down_px"), errors, strict=True)]
    if not any(abs(value) >= (_SINGLE_PX if error is None else max(_SHIFT_PX, _SURE * error))
               for value, error in moved):  # fmt: skip
        return []
    (right, _), (down, _) = moved
    text = f"its pictures are shifted by {right:+.1f} px to the right and {down:+.1f} px down against {against}"
    text += "" if shift["error_px"] else " (of a single pose, so without an error)"
    return [_told(label, "shift", text)]


def _varies(own):
    """Whether a method's pictures show any contrast at all."""
    return own["gain"] is not None


def _contrast(label, own):
    """Whether a method knows the pattern of the ground but shows it too strongly or too weakly."""
    found = own["gain"]
    if found is None or own["letter"] in ("D", "E") or found["correlation"] < _PATTERN:
        return []
    if abs(found["gain"] - 1.0) < _GAIN or found["explained"] < _MOST:
        return []
    text = (
        f"it shows {found['gain']:.2f} of the reference's contrast, which is {found['explained']:.0%} of its square "
        f"error about each pose's mean (correlation {found['correlation']:.2f})"
    )
    return [_told(label, "contrast", text)]


def _materials(label, method):
    """Materials that stand apart: their emissivity, where another program's frames or other materials tell it, else
    their temperature."""
    found, emissivities = [], method["emissivities"]
    for name, own in emissivities["told"].items():
        others = [abs(value) for other, value in emissivities["error_k"].items() if other != name]
        middle = sorted(others)[len(others) // 2] if others else 0.0
        # Of a single material none stands apart.
        if not others or abs(own["error_k"]) < _APART * middle:
            continue
        text = f"{name} ({own['share']:.1%} of the ground) is off by {own['error_k']:+.2f} K"
        if method["letter"] == "foreign" and own["change"] is not None:
            text += (
                f", as an emissivity wrong by {own['change']:+.3f} would be (explains {own['explained']:.0%} of its "
                "square)"
            )
            found.append(_told(label, "emissivity", text))
        else:
            found.append(_told(label, "material", f"{text}, the others by {middle:.2f} K in the median"))
    return found


def _rendered_with(label, emissivities):
    """Materials that a method renders with another emissivity than the reference."""
    return [
        _told(label, "emissivity", f"{name} ({own['share']:.1%} of the ground) is rendered with a band emissivity of "
                                   f"{own['used']:.3f} in place of {own['true']:.3f}")
        for name, own in emissivities.items()
    ]  # fmt: skip


def _beaten(summary):
    """Which maps the constant beats."""
    methods = summary["methods"]
    constant = next((own for label, own in methods.items() if label.startswith("D constant")), None)
    if constant is None or not constant["errors"]:
        return []
    # On the scenes that the constant is had of.
    scenes, told = constant["groups"]["radiometric"]["scene"], []
    scenes = [name for name, row in scenes.items() if row["pixels"]]
    limit = _over(constant, scenes)
    if limit is None:
        return []
    for label, own in methods.items():
        if own["letter"] in ("B", "C1", "C2", "O") and own["errors"]:
            error = _over(own, scenes)
            if error is not None and error > limit:
                told.append(f"{label} ({error:.2f} K)")
    text = f"one constant of the training part errs by {limit:.2f} K, less than {'; '.join(told)}"
    return [_told("D constant", "constant", text)] if told else []


def _over(own, scenes):
    """Mean absolute error of a method over some scenes [K], or None where it lacks one of them."""
    found = own["groups"]["radiometric"]["scene"]
    rows = [found[name] for name in scenes if name in found and found[name]["pixels"]]
    if len(rows) < len(scenes) or not rows:
        return None
    return sum(row["mae_k"] * row["pixels"] for row in rows) / sum(row["pixels"] for row in rows)
