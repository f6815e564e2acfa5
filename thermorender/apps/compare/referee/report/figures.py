"""Figures of a comparison: error images, errors against run time, spectra, the terms of a difference, and ROC."""

import io
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.compare.referee.methods import CALIBRATED, REFITTED
from thermorender.apps.compare.referee.views import View
from thermorender.units import ZERO_CELSIUS_K

Summary = dict[str, Any]
_Look = dict[str, Any]

_FITTED = (REFITTED, CALIBRATED)

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#F0E442", "#000000")
# The colour of pixels that are not scored, as in the pictures of the page.
GREY = 136
# Legends are read at 100 pixels per inch, where 10 points of a figure are 10.4 points on the page.
_DPI, _WORDS_PT = 100, 10
# Most entries in one column of a legend, and most characters in one line of a picture's title.
_ENTRIES, _TITLE = 18, 26
_STYLE = {"B": "-", "C1": "--", "C2": ":"}
_MARKS = {"B": "○ 2D translation", "C1": "□ rendered", "C2": "◇ learned materials"}
_LETTER = {"B": "o", "C1": "s", "C2": "D", "D": "x", "E": "+", "F": "^", "P": "*", "foreign": "P"}


def colour_tables() -> dict[str, list[list[int]]]:
    """Return {"temperature", "error"}: 256 colours (red, green, blue) each, 0…255."""
    from matplotlib import colormaps

    tables = {"temperature": "inferno", "error": "RdBu_r"}
    return {name: (255.0 * colormaps[table](np.linspace(0.0, 1.0, 256))[:, :3]).round().astype(int).tolist()
            for name, table in tables.items()}  # fmt: skip


def shown_photograph(view: View) -> NDArray[np.uint8]:
    """Return a View's photograph with the grey of the other pictures where it is black for lack of terrain."""
    image = view.visible.copy()
    image[~view.known & ~view.visible.any(axis=-1)] = GREY
    return image


def error_images(
    path: Path, view: View, seen: Mapping[str, NDArray[np.floating]], reference: str = "reference"
) -> None:
    """Write the frames of a pose as PNG: on the reference's scale, on their own scale, and their errors.

    Without a reference, the first frame gives the common scale, and there are no errors.

    Parameters
    ----------
    path : Path
    view : View
    seen : dict of str to (H, W) array
        Apparent temperature of each method [K].
    reference : str
        Name of the reference.
    """
    from matplotlib import colormaps

    figure, pyplot = _figure()
    labels = list(seen)
    columns = min(6, len(labels) + 1)
    bands = -(-(len(labels) + 1) // columns)
    step = 3 if view.truth is not None else 2
    rows = bands * step
    height, width = view.known.shape
    size = 2.4 * columns, 2.4 * rows * height / width + 0.5 * bands + 0.7
    drawing = figure(figsize=size, layout="constrained")
    axes = drawing.subplots(rows, columns, squeeze=False)
    base = view.truth if view.truth is not None else seen[labels[0]]
    low, high = _scale(base, view.known)
    errors: dict[str, NDArray[np.floating]] = {}
    if view.truth is not None:
        errors = {label: np.where(view.known, image - view.truth, np.nan) for label, image in seen.items()}
    off = np.concatenate([np.zeros(0), *(np.abs(error[np.isfinite(error)][::17]) for error in errors.values())])
    limit = float(np.percentile(off, 95)) if off.size else 1.0
    photograph = shown_photograph(view)
    warmth, fault = (colormaps[name].with_extremes(bad=(GREY / 255.0,) * 3) for name in ("inferno", "RdBu_r"))
    shown = drawn = None
    first = reference if view.truth is not None else "photograph"
    for number, label in enumerate([first, *labels]):
        axis, own, *below = axes[number // columns * step : (number // columns + 1) * step, number % columns]
        image = view.truth if number == 0 else seen[label]
        if image is None:
            axis.imshow(photograph)
        else:
            celsius = np.where(view.known, image - ZERO_CELSIUS_K, np.nan)
            shown = axis.imshow(celsius, cmap=warmth, vmin=low, vmax=high)
        if number:
            cold, warm = _scale(seen[label], view.known)
            own.imshow(np.where(view.known, seen[label] - ZERO_CELSIUS_K, np.nan), cmap=warmth, vmin=cold, vmax=warm)
            own.set_title(f"own scale, {cold:.1f}…{warm:.1f} °C", fontsize=8)
        elif view.truth is not None:
            own.imshow(photograph)
        axis.set_title(formats.label(textwrap.fill(label, _TITLE)), fontsize=9)
        if number and below:
            drawn = below[0].imshow(errors[label], cmap=fault, vmin=-limit, vmax=limit)
            below[0].set_title("error", fontsize=8)
    for axis in axes.ravel():
        axis.set_axis_off()
    below = axes[-1, : columns // 2].tolist(), axes[-1, columns // 2 :].tolist()
    scales = (shown, below[0], "common scale [°C]; grey: no terrain"), (drawn, below[1], "error [K]")
    for image, place, words in scales:
        if image is not None and place:
            drawing.colorbar(image, ax=place, label=words, location="bottom", aspect=30, shrink=0.8)
    with files.atomic(path) as part:
        drawing.savefig(part, dpi=_DPI, format="png")
    pyplot.close(drawing)


def _scale(image: NDArray[np.floating], known: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the 1st and 99th percentile of a frame's scored pixels [°C]."""
    warm = image[known & np.isfinite(image)] - ZERO_CELSIUS_K
    low, high = np.percentile(warm, [1, 99]).tolist() if warm.size else (0.0, 1.0)
    return low, high


def against_time(summary: Summary) -> bytes | None:
    """Return a PNG of mean absolute error on ground against seconds per frame, or None."""
    scored = [(own, own["errors"]["radiometric"]["ground"]) for own in summary["methods"].values() if own["errors"]]
    # A logarithmic scale cannot show an error of exactly 0.
    scored = [(own, error) for own, error in scored if error["mae_k"] and own["seconds_per_frame"]]
    if not scored:
        return None
    figure, pyplot = _figure()
    drawing = figure(figsize=(8.0, 4.6), layout="constrained")
    axis = drawing.subplots()
    colours = _coloured(own for own, _ in scored)
    used: set[str] = set()
    for own, error in scored:
        ends = (error.get("interval_95") or {}).get("mae_k")
        bars = None if ends is None else [[max(error["mae_k"] - ends[0], 0.0)], [max(ends[1] - error["mae_k"], 0.0)]]
        label = formats.label(own["map"]) if own["map"] not in used else None
        used.add(own["map"])
        axis.errorbar(1e3 * own["seconds_per_frame"], error["mae_k"], yerr=bars, marker=_LETTER[own["letter"]], ls="",
                      color=colours[own["map"]], label=label, capsize=2,
                      mfc="none" if own["bounds"] in _FITTED else None)  # fmt: skip
    axis.set(xscale="log", yscale="log", xlabel="run time [ms per frame]", ylabel="mean absolute error on ground [K]")
    marks = [words for letter, words in _MARKS.items() if any(own["letter"] == letter for own, _ in scored)]
    hollow = "; hollow: refitted, calibrated" if any(own["bounds"] in _FITTED for own, _ in scored) else ""
    axis.set_title("  ".join(marks) + hollow, fontsize=_WORDS_PT)
    _plain(axis.xaxis, axis.yaxis)
    axis.grid(alpha=0.3, which="both")
    _beside(axis, axis.get_legend_handles_labels()[0])
    return _png(drawing, pyplot)


def spectra(summary: Summary) -> bytes | None:
    """Return a PNG of the power of the methods and of the reference against spatial frequency, or None."""
    references = [each["spectrum"] for each in summary["scenes"] if each["spectrum"]]
    # A logarithmic scale cannot show zero power. C2 is left out: learned materials change its spectrum little.
    curves = [(own, own["structure"]["spectrum"]) for own in _best(summary)
              if own["letter"] not in ("C2", "D", "E") and own["structure"]["spectrum"]
              and min(own["structure"]["spectrum"]["k2_px2"]) > 0.0]  # fmt: skip
    if not references or not curves or not min(references[0]["k2_px2"]) > 0.0:
        return None
    figure, pyplot = _figure()
    drawing = figure(figsize=(8.0, 4.6), layout="constrained")
    axis = drawing.subplots()
    weight = np.array([each["poses"] for each in summary["scenes"] if each["spectrum"]], float)
    frequency = references[0]["cycles_per_px"]
    mean = np.average([each["k2_px2"] for each in references], axis=0, weights=weight)
    axis.plot(frequency, mean, color="black", lw=2.5, label="reference")
    colours = _coloured(own for own, _ in curves)
    for own, curve in curves:
        axis.plot(curve["cycles_per_px"], curve["k2_px2"], lw=1.0, **_line(own, colours))
    axis.set(
        xscale="log", yscale="log", xlabel="spatial frequency [cycles/px]", ylabel="power spectral density [K² px²]"
    )
    _plain(axis.xaxis)
    axis.grid(alpha=0.3, which="both")
    _legend(axis, pyplot, [own for own, _ in curves], colours, [("reference", {"color": "black", "lw": 2.5})])
    return _png(drawing, pyplot)


def differences(summary: Summary) -> bytes | None:
    """Return a PNG of the mean absolute difference of each pair of methods in scenes without truth, or None."""
    total: dict[tuple[str, str], NDArray[np.float64]] = {}
    for scene in summary["scenes"]:
        for each in scene["differences"]:
            if each["pixels"]:
                row = total.setdefault((each["one"], each["other"]), np.zeros(2))
                row += np.array([each["mae_k"], 1.0]) * each["pixels"]
    labels = list(dict.fromkeys(label for pair in total for label in pair))
    # For two methods, the table suffices.
    if len(labels) < 3:
        return None
    matrix = np.full((len(labels), len(labels)), np.nan)
    for (one, other), (kelvin, pixels) in total.items():
        k, j = labels.index(one), labels.index(other)
        matrix[k, j] = matrix[j, k] = kelvin / pixels
    figure, pyplot = _figure()
    side = 2.8 + 0.36 * max(len(labels), 8)
    drawing = figure(figsize=(side + 0.6, side), layout="constrained")
    axis = drawing.subplots()
    image = axis.imshow(matrix, cmap="viridis")
    dark = np.nanmin(matrix) + 0.6 * (np.nanmax(matrix) - np.nanmin(matrix))
    for (k, j), kelvin in np.ndenumerate(matrix):
        if np.isfinite(kelvin):
            words = f"{kelvin:.1f}" if kelvin < 9.95 else f"{kelvin:.0f}"
            axis.text(j, k, words, ha="center", va="center", fontsize=9, color="white" if kelvin < dark else "black")
    shown = [formats.label(label) for label in labels]
    axis.set_xticks(range(len(labels)), shown, rotation=90, fontsize=9)
    axis.set_yticks(range(len(labels)), shown, fontsize=9)
    drawing.colorbar(image, ax=axis, label="mean absolute difference [K]", shrink=0.6)
    return _png(drawing, pyplot)


def terms(summary: Summary, names: Sequence[str]) -> bytes | None:
    """Return a PNG of the mean absolute size of the terms between B and C, per map over all scenes, or None."""
    total: dict[str, dict[str, NDArray[np.float64]]] = {}
    for scene in summary["scenes"]:
        for name, pair in scene["terms"].items():
            for term in (*names, "whole"):
                own = pair["terms"][term]
                if own["pixels"]:
                    row = total.setdefault(name, {}).setdefault(term, np.zeros(2))
                    row += np.array([own["mae_k"], 1.0]) * own["pixels"]
    if not total:
        return None
    figure, pyplot = _figure()
    drawing = figure(figsize=(8.0, 1.2 + 0.5 * len(total)), layout="constrained")
    axis = drawing.subplots()
    for number, term in enumerate((*names, "whole")):
        place = np.arange(len(total)) + (number - len(names) / 2.0) * 0.13
        values = [own[term][0] / own[term][1] if term in own else 0.0 for own in total.values()]
        axis.barh(place, values, height=0.12, color=_COLOURS[number % 8] if term != "whole" else "black", label=term)
    axis.set_yticks(range(len(total)), [formats.label(name) for name in total], fontsize=_WORDS_PT)
    axis.invert_yaxis()
    axis.set(xlabel="mean absolute size [K]")
    _beside(axis, axis.get_legend_handles_labels()[0])
    return _png(drawing, pyplot)


def roc(summary: Summary) -> bytes | None:
    """Return a PNG of the share of targets that a simple detector finds against its false alarms, or None."""
    curves = [(own, own["targets"]["roc"]) for own in _best(summary) if own["letter"] != "C2" and own["targets"]["roc"]]
    known = summary["targets"]["roc"]
    if not curves:
        return None
    figure, pyplot = _figure()
    drawing = figure(figsize=(8.0, 4.6), layout="constrained")
    axis = drawing.subplots()
    colours = _coloured(own for own, _ in curves)
    black: _Look = {"color": "black", "lw": 2.5}
    if known:
        x, y = np.array(known)[:, :2].T
        axis.step(np.maximum(x, 1e-2), y, where="post", **black)
    for own, curve in curves:
        x, y = np.array(curve)[:, :2].T
        axis.step(np.maximum(x, 1e-2), y, where="post", lw=1.0, **_line(own, colours))
    axis.set(xscale="log", xlabel="false alarms per frame", ylabel="share of targets found", ylim=(-0.02, 1.02))
    _plain(axis.xaxis)
    axis.grid(alpha=0.3)
    _legend(axis, pyplot, [own for own, _ in curves], colours, [("reference", black)] if known else [])
    return _png(drawing, pyplot)


def _best(summary: Summary) -> list[dict[str, Any]]:
    """Return the methods that a figure shows: for each map and letter the one with the best bounds, which is last."""
    methods = [own for own in summary["methods"].values() if not own["true_objects"]]
    return list({(own["letter"], own["map"]): own for own in methods}.values())


def _coloured(methods: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return {map: colour}."""
    from matplotlib import colormaps

    names = list(dict.fromkeys(own["map"] for own in methods))
    palette: Sequence[Any] = _COLOURS if len(names) <= len(_COLOURS) else list(colormaps["tab20"](np.arange(20)))
    return {name: palette[number % len(palette)] for number, name in enumerate(names)}


def _line(own: dict[str, Any], colours: Mapping[str, Any]) -> _Look:
    return {"color": colours[own["map"]], "ls": _STYLE.get(own["letter"], "-.")}


def _legend(
    axis: Any,
    pyplot: Any,
    methods: Sequence[dict[str, Any]],
    colours: Mapping[str, Any],
    first: Sequence[tuple[str, _Look]] = (),
) -> None:
    """Draw a legend of maps by colour, and of letters by dashes."""
    letters = [letter for letter in _STYLE if any(own["letter"] == letter for own in methods)]
    entries: list[tuple[str, _Look]] = [*first, *((name, {"color": colour}) for name, colour in colours.items())]
    entries += [(letter, {"color": "grey", "ls": _STYLE[letter]}) for letter in letters]
    handles = [pyplot.Line2D([], [], label=formats.label(name), **look) for name, look in entries]
    _beside(axis, handles)


def _beside(axis: Any, handles: Sequence[Any]) -> None:
    """Draw a legend of handles to the right of the axes."""
    axis.legend(handles=handles, fontsize=_WORDS_PT, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5),
                ncols=-(-len(handles) // _ENTRIES))  # fmt: skip


def _plain(*axes: Any) -> None:
    """Label logarithmic axes with plain numbers: 6, not 6 × 10⁰."""
    from matplotlib.ticker import LogFormatter

    class Plain(LogFormatter):
        """Labels the ticks that its base labels."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    for axis in axes:
        axis.set_major_formatter(Plain())
        axis.set_minor_formatter(Plain(minor_thresholds=(1.0, 0.4)))


def _figure() -> tuple[Callable[..., Any], Any]:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.figure, pyplot


def _png(drawing: Any, pyplot: Any) -> bytes:
    content = io.BytesIO()
    drawing.savefig(content, dpi=_DPI, format="png")
    pyplot.close(drawing)
    return content.getvalue()
