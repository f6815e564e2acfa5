"""What a reader should know first, in sentences: offsets, shifts, emissivities, leaks, and what beats a method."""

# An offset is told from this [K], and where it is this many of its standard errors.
_OFFSET_K, _SURE = 0.1, 3.0
# A shift is told from this [px], where pictures correlate so well.
_SHIFT_PX, _ALIKE = 0.5, 0.5
# A material's error stands apart where it is so many times the median one of the others.
_APART = 3.0


def of(summary):
    """Return [{"grave": bool, "method": label, "kind": word, "text": sentence}] of a comparison's summary."""
    found = []
    for label, own in summary["methods"].items():
        found += [_told(label, "leak", leak, grave=True) for leak in own["leaks"]]
        found += [_told(label, "circular", text, grave=True) for text in own["circular"]]
        if not own["errors"]:
            continue
        ground = own["errors"]["radiometric"]["ground"]
        found += _offset(label, ground)
        found += _shift(label, own)
        found += _materials(label, own)
    found += _beaten(summary)
    return sorted(found, key=lambda each: not each["grave"])


def _told(label, kind, text, grave=False):
    return {"grave": grave, "method": label, "kind": kind, "text": f"{label}: {text}"}


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
    # Pictures that hardly correlate have their peak anywhere.
    if shift is None or shift["error_px"] is None or abs(shift["correlation"]) < _ALIKE:
        return []
    moved = [(shift[name], error) for name, error in zip(("right_px", "down_px"), shift["error_px"], strict=True)]
    if not any(abs(value) >= max(_SHIFT_PX, _SURE * error) for value, error in moved):
        return []
    (right, _), (down, _) = moved
    text = f"its pictures are shifted by {right:+.1f} px to the right and {down:+.1f} px down against {against}"
    return [_told(label, "shift", text)]


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
        if method["letter"] == "foreign":
            text += (
                f", as an emissivity wrong by {own['change']:+.3f} would be (explains {own['explained']:.0%} of its "
                "square)"
            )
            found.append(_told(label, "emissivity", text))
        else:
            found.append(_told(label, "material", f"{text}, the others by {middle:.2f} K in the median"))
    for name, own in emissivities["scene"].items():
        text = (
            f"{name} ({own['share']:.1%} of the ground) is rendered with a band emissivity of {own['used']:.3f} in "
            f"place of {own['true']:.3f}"
        )
        found.append(_told(label, "emissivity", text))
    return found


def _beaten(summary):
    """Which maps the constant beats."""
    methods = summary["methods"]
    constant = next((own for label, own in methods.items() if label.startswith("D constant")), None)
    if constant is None or not constant["errors"]:
        return []
    # On the scenes that the constant is had of.
    scenes, told = constant["groups"]["radiometric"]["scene"], []
    limit = _over(constant, scenes)
    for label, own in methods.items():
        if own["letter"] in ("B", "C1", "C2", "O") and own["errors"]:
            error = _over(own, scenes)
            if error is not None and limit is not None and error > limit:
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
