"""What a reader should know first, in sentences: offsets, wrong contrast, shifts, emissivities, leaks, and what beats a
method."""

# An offset is told from this [K], and where it is this many of its standard errors.
_OFFSET_K, _SURE = 0.1, 3.0
# A shift is told from this [px], from the second where a single pose tells no error, where pictures correlate so well.
_SHIFT_PX, _SINGLE_PX, ALIKE = 0.5, 1.0, 0.5
# A wrong contrast is told from this gain off 1, where the pattern is known so well, and where it is most of the error;
# less than this is hardly any.
_GAIN, _PATTERN, _MOST, _FLAT = 0.1, 0.8, 0.5, 0.2
# A material's error stands apart where it is so many times the median one of the others in the same scenes.
_APART = 3.0
_TITLES = {
    "leak": "Seen in training", "circular": "Circular", "offset": "An offset is most of the error",
    "shift": "Shifted", "unlike": "Frames unlike the scene", "contrast": "Wrong contrast",
    "flat": "Hardly any of the contrast, or it turned around", "material": "Materials that err apart",
    "emissivity": "Wrong emissivity", "constant": "Beaten by a constant",
}  # fmt: skip


def of(summary):
    """Return [{"grave": bool, "method": label, "kind": word, "says": words}] of a comparison's summary.

    The row that knows the true objects says of the ground what the row without them says.
    """
    found = []
    for label, own in summary["methods"].items():
        found += [_told(label, "leak", leak, grave=True) for leak in own["leaks"]]
        found += [_told(label, "circular", text, grave=True) for text in own["circular"]]
        if not own["errors"] or own["true_objects"]:
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
    if abs(mean) < _SURE * error or mean**2 < _MOST * ground["rmse_k"] ** 2:
        return []
    return [_told(label, "offset", f"an offset of {mean:+.2f} K ({ends[0]:+.2f}…{ends[1]:+.2f}) is most of its square "
                                   f"error; about it errors scatter by {ground['sd_k']:.2f} K")]  # fmt: skip


def _shift(label, own):
    """Whether a method's pictures lie beside what they show: those of a photograph against the same map rendered, those
    of another program against the reference. What is rendered here cannot be shifted."""
    if own["letter"] == "foreign":
        shift, against = own["structure"]["shift"], "the reference"
    else:
        shift, against = own["registered"], f"C1 {own['map']}"
    if shift is None or abs(shift["correlation"]) < ALIKE:
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
    """Whether a method knows the pattern of the ground but shows it too strongly or too weakly, or hardly shows it."""
    found = own["gain"]
    if found is None or own["letter"] in ("D", "E"):
        return []
    if found["gain"] < _FLAT:
        return [_told(label, "flat", f"it shows {found['gain']:.2f} of the reference's contrast (correlation "
                                     f"{found['correlation']:.2f})")]  # fmt: skip
    if found["correlation"] < _PATTERN:
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
    found = []
    for name, own in method["emissivities"]["told"].items():
        # Of a single material none stands apart.
        if own["others_k"] is None or abs(own["error_k"]) < _APART * own["others_k"]:
            continue
        text = f"{name} ({own['share']:.1%} of the ground's pixels) is off by {own['error_k']:+.2f} K"
        if method["letter"] == "foreign" and own["change"] is not None:
            text += (
                f", as an emissivity wrong by {own['change']:+.3f} would be (explains {own['explained']:.0%} of its "
                "square)"
            )
            found.append(_told(label, "emissivity", text))
        else:
            text += f", the others in its scenes by {own['others_k']:.2f} K in the median"
            found.append(_told(label, "material", text))
    return found


def _rendered_with(label, emissivities):
    """Materials that a method renders with another emissivity than the reference."""
    return [
        _told(label, "emissivity", f"{name} ({own['share']:.1%} of the ground's texels) is rendered with a band "
                                   f"emissivity of {own['used']:.3f} in place of {own['true']:.3f}")
        for name, own in emissivities.items()
    ]  # fmt: skip


def _beaten(summary):
    """Which maps the constant surely beats, of those that are told the hour as it is."""
    told, limit = [], None
    for label, own in summary["methods"].items():
        more = own["more_than_constant"]
        hour = own["bounds"] != "own" and own["letter"] in ("B", "C1", "C2", "O")
        if not more or not hour or own["true_objects"] or not more["interval_95"] or not more["interval_95"][0] > 0.0:
            continue
        low, high = more["interval_95"]
        limit = more["other_mae_k"]
        told.append(f"{label} ({more['own_mae_k']:.2f} K, {low:.2f}…{high:.2f} more)")
    if not told:
        return []
    text = f"one constant of the training part errs by {limit:.2f} K, surely less than {'; '.join(told)}"
    return [_told("D constant", "constant", text)]
