"""Bounds of a data set's thermal values: quartiles and 1.5 interquartile ranges of their aggregated histogram.

They are those of eq. 2 of Generation of artificial infrared camera images for visual navigation simulation, which make
intensity of values of unknown scale: 0 at Q1 − 1.5 (Q3 − Q1) and 1 at Q3 + 1.5 (Q3 − Q1). Counts of 16 bits have few
enough values to count each, so the quartiles are exact.
"""

from dataclasses import dataclass

import numpy as np

from thermorender import files
from thermorender.errors import ThermorenderError
from thermorender.units import ZERO_CELSIUS_K

_VALUES = 65536


class Histogram:
    """How often each 16-bit value occurs.

    Attributes
    ----------
    counts : (65536,) int64
    """

    def __init__(self):
        self.counts = np.zeros(_VALUES, np.int64)

    def add(self, values):
        """Count values, uint8 or uint16 of any shape."""
        self.counts += np.bincount(np.ravel(values), minlength=_VALUES)

    def quantile(self, share):
        """Return the quantile of a share, linear between neighbouring values, as `numpy.quantile` of all of them."""
        total = np.cumsum(self.counts)
        place = share * (total[-1] - 1)
        below, above = (int(np.searchsorted(total, rank, side="right")) for rank in (int(place), int(np.ceil(place))))
        return below + (place - int(place)) * (above - below)


@dataclass(frozen=True)
class Bounds:
    """Bounds of thermal values.

    Attributes
    ----------
    low, high : float
        Q1 − 1.5 IQR and Q3 + 1.5 IQR.
    first_quartile, third_quartile : float
    share_below, share_above : float
        Of the values, outside the bounds.
    """

    low: float
    high: float
    first_quartile: float
    third_quartile: float
    share_below: float
    share_above: float


def bounds_of(histogram):
    """Return the Bounds of a Histogram.

    Raises
    ------
    ThermorenderError
        It holds nothing, or its quartiles are the same.
    """
    total = int(histogram.counts.sum())
    if total == 0:
        raise ThermorenderError("the training part holds no valid thermal pixel; give other shares or pictures")
    first, third = histogram.quantile(0.25), histogram.quantile(0.75)
    if first == third:
        raise ThermorenderError(
            f"half of the thermal pixels of the training part are {first:g}, so no bounds can be told; give pictures "
            "with contrast"
        )
    low, high = first - 1.5 * (third - first), third + 1.5 * (third - first)
    value = np.arange(_VALUES)
    below, above = (float(histogram.counts[outside].sum()) / total for outside in (value < low, value > high))
    return Bounds(float(low), float(high), float(first), float(third), below, above)


def bounds_of_dataset(dataset, usable):
    """Return the Bounds of a Dataset's valid thermal values, of those that are `usable`, (65536,) bool.

    Errors as of `bounds_of`.
    """
    histogram = Histogram()
    for entry in dataset.entries:
        pair = dataset.pair(entry, truth=False)
        histogram.add(pair.thermal[pair.valid])
    histogram.counts[~usable] = 0
    return bounds_of(histogram)


def figure(path, histogram, bounds, scale):
    """Write a PNG of a histogram with its bounds and outliers, over its entire range and around the bounds.

    Parameters
    ----------
    path : path
    histogram : Histogram
    bounds : Bounds
    scale : ThermalScale
        With unit "kelvin" the axis has °C.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    kelvin = scale.unit == "kelvin"

    def shown(value):
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
                shown(starts[which]), heights[which], width=wide * (scale.step if kelvin else 1.0), align="edge",
                color=colour, label=label,
            )  # fmt: skip
        for value, name in ((bounds.low, "lower bound"), (bounds.high, "upper bound")):
            axis.axvline(shown(value), color="black", linestyle="--" if value == bounds.low else ":", linewidth=1.2,
                         label=f"{name}, {shown(value):.4g}")  # fmt: skip
        axis.set(title=title, yscale="log", ylabel="pixels",
                 xlabel="apparent temperature [°C]" if kelvin else "thermal value [count]")  # fmt: skip
    drawing.axes[0].legend(fontsize=8, frameon=False)
    outliers = bounds.share_below + bounds.share_above
    drawing.suptitle(f"thermal pixels of the training part; {outliers:.2%} outside the bounds", fontsize=10)
    with files.atomic(path) as part:
        drawing.savefig(part, dpi=120)
