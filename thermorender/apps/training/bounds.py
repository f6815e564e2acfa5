"""Bounds of a data set's thermal values: quartiles ± 1.5 interquartile ranges of their 16-bit histogram.

Eq. 2 of Generation of artificial infrared camera images for visual navigation simulation maps values of unknown scale
to intensity: 0 at Q1 − 1.5 (Q3 − Q1) and 1 at Q3 + 1.5 (Q3 − Q1).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender import files
from thermorender.apps.training.dataset import Dataset, ThermalScale
from thermorender.errors import ThermorenderError
from thermorender.units import ZERO_CELSIUS_K

_VALUES = 65536


class Histogram:
    """Counts of each 16-bit value, `counts` (65536,) int64."""

    def __init__(self) -> None:
        self.counts = np.zeros(_VALUES, np.int64)

    def add(self, values: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Count values, uint8 or uint16 of any shape."""
        self.counts += np.bincount(np.ravel(values), minlength=_VALUES)

    def quantile(self, share: float) -> float:
        """Return the quantile, linear between neighbouring values like `numpy.quantile`."""
        total = np.cumsum(self.counts)
        at = share * (total[-1] - 1)
        below, above = (int(np.searchsorted(total, k, side="right")) for k in (int(at), int(np.ceil(at))))
        return below + (at - int(at)) * (above - below)


@dataclass(frozen=True)
class Bounds:
    """Bounds of thermal values."""

    # low, high: Q1 − 1.5 IQR and Q3 + 1.5 IQR
    low: float
    high: float
    first_quartile: float
    third_quartile: float
    # share_below, share_above: Shares of the values outside the bounds
    share_below: float
    share_above: float


def bounds_of(histogram: Histogram) -> Bounds:
    """Return the Bounds of a Histogram."""
    total = int(histogram.counts.sum())
    if total == 0:
        raise ThermorenderError("the training part has no valid thermal pixel; give other shares or pictures")
    first, third = histogram.quantile(0.25), histogram.quantile(0.75)
    if first == third:
        raise ThermorenderError(
            f"half of the thermal pixels of the training part are {first:g}, so there are no bounds; give pictures "
            "with contrast"
        )
    low, high = first - 1.5 * (third - first), third + 1.5 * (third - first)
    value = np.arange(_VALUES)
    below, above = (float(histogram.counts[outside].sum()) / total for outside in (value < low, value > high))
    return Bounds(float(low), float(high), float(first), float(third), below, above)


def bounds_of_dataset(dataset: Dataset, usable: NDArray[np.bool_]) -> Bounds:
    """Return the Bounds of a Dataset's valid thermal values where `usable`, (65536,) bool; errors as `bounds_of`."""
    histogram = Histogram()
    for entry in dataset.entries:
        pair = dataset.pair(entry, truth=False)
        histogram.add(pair.thermal[pair.valid])
    histogram.counts[~usable] = 0
    return bounds_of(histogram)


def figure(path: str | Path, histogram: Histogram, bounds: Bounds, scale: ThermalScale) -> None:
    """Write a PNG of a histogram with bounds and outliers: entire range, and around the bounds [°C or counts]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    kelvin = scale.unit == "kelvin"

    def on_axis(value: ArrayLike) -> Any:
        return np.asarray(value, np.float64) * scale.step + scale.zero - ZERO_CELSIUS_K if kelvin else value

    seen = np.flatnonzero(histogram.counts)
    span = bounds.high - bounds.low
    drawing = Figure(figsize=(9.0, 4.2), layout="constrained")
    FigureCanvasAgg(drawing)
    ranges = (seen[0], seen[-1]), (bounds.low - 0.25 * span, bounds.high + 0.25 * span)
    for axis, title, (left, right) in zip(
        drawing.subplots(1, 2), ("entire range", "around the bounds"), ranges, strict=True
    ):
        # About 200 bars of whole values each.
        wide = max(int(np.ceil((right - left + 1) / 200.0)), 1)
        starts = np.arange(max(int(left), 0), min(int(right), _VALUES - 1) + 1, wide)
        heights = np.add.reduceat(histogram.counts, starts)
        heights[-1] = histogram.counts[starts[-1] : starts[-1] + wide].sum()
        outside = (starts + wide - 1 < bounds.low) | (starts > bounds.high)
        for which, colour, label in ((~outside, "#0072B2", "within the bounds"), (outside, "#D55E00", "outliers")):
            axis.bar(
                on_axis(starts[which]), heights[which], width=wide * (scale.step if kelvin else 1.0), align="edge",
                color=colour, label=label,
            )  # fmt: skip
        for value, name in ((bounds.low, "lower bound"), (bounds.high, "upper bound")):
            axis.axvline(on_axis(value), color="black", linestyle="--" if value == bounds.low else ":", linewidth=1.2,
                         label=f"{name}, {on_axis(value):.4g}")  # fmt: skip
        axis.set(title=title, yscale="log", ylabel="pixels",
                 xlabel="apparent temperature [°C]" if kelvin else "thermal value [count]")  # fmt: skip
    drawing.axes[0].legend(fontsize=8, frameon=False)
    outliers = bounds.share_below + bounds.share_above
    drawing.suptitle(f"thermal pixels of the training part; {outliers:.2%} outside the bounds", fontsize=10)
    with files.atomic(path) as part:
        drawing.savefig(part, dpi=120)
