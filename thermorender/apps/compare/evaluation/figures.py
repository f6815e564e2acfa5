"""Figures of an evaluation: error images, and error against run time, training share and shift."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.compare.evaluation.estimators import View
from thermorender.units import ZERO_CELSIUS_K

Curves = Mapping[str, Sequence[tuple[float, float]]]

# Markers of maps (one per ten colours), and dashes of the baselines' lines.
_MARKERS = "osv^"
_DASHES = ((1, 1), (4, 1), (1, 4), (8, 2), (4, 1, 1, 1), (8, 1, 1, 1, 1, 1), (12, 4))
# From this many methods on, three columns are used.
_FOLDED = 6
# Size of legends [pt], 9 points on a page that shows the figure at 80 pixels per inch; most entries in one column.
_LEGEND_PT, _ENTRIES = 11, 20


def picture(path: Path, view: View, guesses: Mapping[str, NDArray[np.floating]], share: float) -> None:
    """Draw a view: its visible and true picture, and below them each method's picture and error.

    Parameters
    ----------
    path : path
    view : View
    guesses : dict of str to (H, W) array
        Apparent temperatures [K].
    share : float
        Quantile of this view in the first method's error.
    """
    plot, (height, width) = pyplot(), view.true.shape
    columns = 1 if len(guesses) < _FOLDED else 3
    lines = -(-(len(guesses) + 1) // columns)
    size = 11.0 * columns**0.5, (0.35 + 4.6 / columns**0.5 * height / width) * lines + 0.8
    figure, axes = plot.subplots(lines, 2 * columns, figsize=size, layout="constrained", squeeze=False)
    pairs = axes.reshape(-1, 2)
    true = np.where(view.known, view.true, np.nan) - ZERO_CELSIUS_K
    errors = {name: np.where(view.known, guess - view.true, np.nan) for name, guess in guesses.items()}
    low, high = np.nanpercentile(true, [1, 99])
    every = np.abs(np.concatenate([error[np.isfinite(error)] for error in errors.values()]))
    limit = float(np.percentile(every, 98)) if every.any() else 1.0
    pairs[0, 0].imshow(view.pair.visible)
    pairs[0, 0].set_title(f"{formats.label(view.pair.entry.key)}: visible", fontsize=10)
    warm = pairs[0, 1].imshow(true, cmap="inferno", vmin=low, vmax=high)
    pairs[0, 1].set_title(f"true; quantile {share:g} of the first map's error", fontsize=10)
    for (name, guess), (left, right) in zip(guesses.items(), pairs[1:], strict=False):
        left.imshow(guess - ZERO_CELSIUS_K, cmap="inferno", vmin=low, vmax=high)
        left.set_title(formats.label(name), fontsize=10)
        off = right.imshow(errors[name], cmap="RdBu_r", vmin=-limit, vmax=limit)
        finite = errors[name][np.isfinite(errors[name])]
        if finite.size:
            right.set_title(f"error: ME {finite.mean():+.2f}, MAE {np.abs(finite).mean():.2f} K", fontsize=10)
    for axis in axes.ravel():
        axis.set_axis_off()
    below = axes[-1, :columns].tolist(), axes[-1, columns:].tolist()
    for shown, place, label in ((warm, below[0], "apparent temperature [°C]"), (off, below[1], "error [K]")):
        figure.colorbar(shown, ax=place, label=label, location="bottom", aspect=40, shrink=0.8)
    save(figure, path)


def against_time(path: Path, result: dict[str, Any]) -> None:
    """Draw the maps' mean absolute error against inference time, with the baselines as lines.

    Parameters
    ----------
    path : path
    result : dict
        As `evaluate` returns it.
    """
    plot = pyplot()
    figure, axis = plot.subplots(figsize=(10, 5), layout="constrained")
    dashes = iter(_DASHES)
    for number, (label, found) in enumerate(result["methods"].items()):
        if found["mae_k"] is None:
            continue
        if found.get("seconds_per_mpixel") is None:
            axis.axhline(found["mae_k"], color="0.3", lw=1, ls=(0, next(dashes, (1, 0))), label=formats.label(label))
            continue
        ends = found["interval_95"]["mae_k"] or (found["mae_k"],) * 2
        bars = np.abs(np.array(ends) - found["mae_k"])[:, None]
        axis.errorbar(found["seconds_per_mpixel"], found["mae_k"], bars, fmt=_MARKERS[number // 10 % len(_MARKERS)],
                      color=f"C{number % 10}", capsize=3, label=formats.label(label))  # fmt: skip
    axis.set(xscale="log", xlabel="inference [s per megapixel]", ylabel="mean absolute error [K]")
    fastest, slowest = axis.get_xlim()
    axis.set_xlim(fastest / 2.0, slowest * 2.0)
    axis.set_ylim(bottom=0.0)
    axis.grid(True, which="both", lw=0.3, color="0.85")
    columns = -(-len(axis.get_legend_handles_labels()[0]) // _ENTRIES)
    figure.legend(fontsize=_LEGEND_PT, loc="outside right upper", ncols=max(columns, 1))
    save(figure, path)


def against_share(path: Path, curves: Curves) -> None:
    """Draw {method: [(share, mean absolute error [K])]} against the share of the training part."""
    _curves(path, curves, "share of the training part", "log")


def against_shift(path: Path, curves: Curves) -> None:
    """Draw {method: [(shift [px], mean absolute error [K])]} against the shift of the training pairs."""
    _curves(path, curves, "shift of thermal against visible pictures in training [px]", "linear")


def _curves(path: Path, curves: Curves, label: str, scale: str) -> None:
    plot = pyplot()
    figure, axis = plot.subplots(figsize=(8, 5), layout="constrained")
    for name, curve in curves.items():
        x, error = np.array(sorted(curve)).T
        axis.plot(x, error, "o-", label=formats.label(name))
    axis.set(xscale=scale, xlabel=label, ylabel="mean absolute error [K]")
    axis.set_ylim(bottom=0.0)
    axis.grid(True, which="both", lw=0.3, color="0.85")
    axis.legend(fontsize=_LEGEND_PT)
    save(figure, path)


def pyplot() -> Any:
    """Return matplotlib.pyplot, drawing without a display."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def save(figure: Any, path: Path, dpi: int = 80) -> None:
    """Write a figure as PNG, whole or not at all, and close it."""
    from matplotlib import pyplot

    with files.atomic(path) as part:
        figure.savefig(part, dpi=dpi)
    pyplot.close(figure)
