"""Numbers in text: the comma-separated values of an option or a field, checked and named in errors."""

from collections.abc import Sequence

import numpy as np

from thermorender.errors import ThermorenderError


def parse_numbers(name: str, text: str, labels: Sequence[str]) -> tuple[float, ...]:
    """Return the comma-separated numbers of a command-line option as floats, one per label."""
    cells = [cell.strip() for cell in str(text).split(",")]
    wanted = ",".join(labels)
    if len(cells) != len(labels):
        raise ThermorenderError(f"{name}={text!r} has {len(cells)} values; {len(labels)} are needed: {wanted}")
    values = []
    for label, cell in zip(labels, cells, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise ThermorenderError(f"{name}={text!r}: {label} is {cell!r}, not a finite number; give {wanted}")
        values.append(value)
    return tuple(values)


def parse_scale(text: str | None) -> tuple[float, float] | None:
    """Return (kelvin per count, kelvin of count 0) of "STEP,ZERO"; None if it is not given."""
    if not text:
        return None
    step, zero = parse_numbers("scale", text, ("STEP", "ZERO"))
    if step <= 0.0:
        raise ThermorenderError(f"scale={text} has a STEP of {step:g} kelvin per count; give a number above 0")
    return step, zero
