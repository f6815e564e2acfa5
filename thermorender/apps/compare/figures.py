"""Figures: error images, errors against run time, spectra, terms of a difference, ROC, and the pictures of a page."""

import base64
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.compare.methods import (
    BALANCE,
    CALIBRATED,
    CONSTANT,
    FLAT,
    FOREIGN,
    FRAME_MEAN,
    LEARNED_MATERIALS,
    PER_MATERIAL,
    PHOTOGRAPH,
    PRIVILEGED,
    REFITTED,
    TRUE_MATERIALS,
)
from thermorender.apps.compare.view import Image, View, evenly

Summary = dict[str, Any]
Curves = Mapping[str, Sequence[tuple[float, float]]]
_Look = dict[str, Any]

_FITTED = (REFITTED, CALIBRATED)

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#F0E442", "#000000")
# The colour of pixels that are not scored, as in the pictures of the page.
GREY = 136
DPI = 100
# Figures of a comparison have the width of a column of a paper [in], and words of this size there [pt].
COLUMN_IN, _WORDS_PT = 85.0 / 25.4, 7.0
# Most pictures in a line of that width, and characters in a line of a picture's title, there and at full size.
_PANELS, _NARROW, _TITLE = 4, 15, 26
# Most methods whose pictures open the page.
_OPENING = 6
_STYLE = {PHOTOGRAPH: "-", TRUE_MATERIALS: "--", LEARNED_MATERIALS: ":"}
_USES = {PHOTOGRAPH: "on the photograph", TRUE_MATERIALS: "as kelvin, true materials",
         LEARNED_MATERIALS: "as kelvin, learned materials"}  # fmt: skip
_MARKS = {PHOTOGRAPH: "o", TRUE_MATERIALS: "s", LEARNED_MATERIALS: "D", CONSTANT: "x", PER_MATERIAL: "+",
          FRAME_MEAN: "1", BALANCE: "^", PRIVILEGED: "*", FOREIGN: "P"}  # fmt: skip
# Of an evaluation: markers of maps (one per ten colours), dashes of the baselines' lines, and the number of methods
# from which three columns are used.
_MARKERS = "osv^"
_DASHES = ((1, 1), (4, 1), (1, 4), (8, 2), (4, 1, 1, 1), (8, 1, 1, 1, 1, 1), (12, 4))
_FOLDED = 6
# Size of its legends [pt], 9 points on a page that shows the figure at 80 pixels per inch; most entries in a column.
_LEGEND_PT, _LONGEST = 11, 20
# Pictures inside the page: steps per kelvin, largest total size [bytes], and largest number of poses drawn per scene
# and in total; each scene gets at least one.
STEPS_PER_K = 20.0
MOST_BYTES = 12_000_000
_POSES, _ALL = 3, 12


def pyplot() -> Any:
    """Return matplotlib.pyplot, drawing without a display."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def save(figure: Any, path: Path, dpi: int = 80) -> None:
    """Write a figure as PNG, whole or not at all, and close it."""
    with files.atomic(path) as part:
        figure.savefig(part, dpi=dpi, format="png")
    pyplot().close(figure)


def publish(figure: Any, folder: Path, name: str) -> bytes:
    """Write a figure as `figures/NAME.pdf` and `.svg` in a folder, each whole or not at all; return the SVG."""
    place = folder / "figures"
    place.mkdir(exist_ok=True)
    # Text stays text in a PDF, and neither file has a date, so that equal figures are equal files.
    with pyplot().rc_context({"pdf.fonttype": 42, "svg.hashsalt": name}):
        for kind, dates in (("pdf", {"CreationDate": None}), ("svg", {"Date": None})):
            with files.atomic(place / f"{name}.{kind}") as part:
                figure.savefig(part, format=kind, metadata=dates, dpi=600)
    pyplot().close(figure)
    return (place / f"{name}.svg").read_bytes()


def _column(height_in: float) -> tuple[Any, Any]:
    """Return a figure of a column's width and its axes, with words of a paper's size."""
    drawing = pyplot().figure(figsize=(COLUMN_IN, height_in), layout="constrained")
    axis = drawing.subplots()
    axis.tick_params(which="both", labelsize=_WORDS_PT)
    axis.xaxis.label.set_size(_WORDS_PT)
    axis.yaxis.label.set_size(_WORDS_PT)
    return drawing, axis


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


def error_images(path: Path, view: View, seen: Mapping[str, Image], reference: str = "reference") -> None:
    """Write the frames of a pose, {label: (H, W) [K]}: on the reference's scale, on their own scale, and their errors.

    Without a reference, the first frame gives the common scale, and there are no errors.
    """
    from matplotlib import colormaps

    labels = list(seen)
    columns = min(6, len(labels) + 1)
    bands = -(-(len(labels) + 1) // columns)
    step = 3 if view.truth is not None else 2
    rows = bands * step
    height, width = view.known.shape
    size = 2.4 * columns, 2.4 * rows * height / width + 0.5 * bands + 0.7
    drawing = pyplot().figure(figsize=size, layout="constrained")
    axes = drawing.subplots(rows, columns, squeeze=False)
    base = view.truth if view.truth is not None else seen[labels[0]]
    low, high = _scale(base, view.known)
    errors, limit = _errors(view, seen)
    photograph = shown_photograph(view)
    warmth, fault = (colormaps[name].with_extremes(bad=(GREY / 255.0,) * 3) for name in ("inferno", "RdBu_r"))

    def scored(image: Image) -> Image:
        return np.where(view.known, image, np.nan)

    shown = drawn = None
    for number, label in enumerate([reference if view.truth is not None else "photograph", *labels]):
        axis, own, *below = axes[number // columns * step : (number // columns + 1) * step, number % columns]
        image = view.truth if number == 0 else seen[label]
        if image is None:
            axis.imshow(photograph)
        else:
            shown = axis.imshow(scored(image), cmap=warmth, vmin=low, vmax=high)
        if number:
            cold, warm = _scale(seen[label], view.known)
            own.imshow(scored(seen[label]), cmap=warmth, vmin=cold, vmax=warm)
            own.set_title(f"own scale, {cold:.1f}…{warm:.1f} K", fontsize=8, y=1.0)
        elif view.truth is not None:
            own.imshow(photograph)
        # A stated height, since the search for one takes half of the drawing.
        axis.set_title(formats.label(textwrap.fill(label, _TITLE)), fontsize=9, y=1.0)
        if label in errors and below:
            drawn = below[0].imshow(errors[label], cmap=fault, vmin=-limit, vmax=limit)
            below[0].set_title("error", fontsize=8, y=1.0)
    for axis in axes.ravel():
        axis.set_axis_off()
    below = axes[-1, : columns // 2].tolist(), axes[-1, columns // 2 :].tolist()
    scales = (shown, below[0], "common scale [K]; grey: no terrain"), (drawn, below[1], "error [K]")
    for image, place, words in scales:
        if image is not None and place:
            drawing.colorbar(image, ax=place, label=words, location="bottom", aspect=30, shrink=0.8)
    save(drawing, path, DPI)


def _errors(view: View, seen: Mapping[str, Image]) -> tuple[dict[str, Image], float]:
    """Return ({label: error (H, W) [K], NaN where not scored}, the end of their scale [K])."""
    if view.truth is None:
        return {}, 1.0
    errors = {label: np.where(view.known, image - view.truth, np.nan) for label, image in seen.items()}
    off = np.concatenate([np.zeros(0), *(np.abs(error[np.isfinite(error)][::17]) for error in errors.values())])
    return errors, float(np.percentile(off, 95)) if off.size else 1.0


def _scale(image: NDArray[np.floating], known: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the 1st and 99th percentile of a frame's scored pixels [K]."""
    warm = image[known & np.isfinite(image)]
    low, high = np.percentile(warm, [1, 99]).tolist() if warm.size else (0.0, 1.0)
    return low, high


def error_and_time(summary: Summary) -> Any:
    """Return the figure of mean absolute error on ground against seconds per frame, or None."""
    scored = [(own, own["errors"]["radiometric"]["ground"]) for own in summary["methods"].values() if own["errors"]]
    # A logarithmic scale cannot show an error of exactly 0.
    scored = [(own, error) for own, error in scored if error["mae_k"] and own["seconds_per_frame"]]
    if not scored:
        return None
    drawing, axis = _column(2.3)
    colours = _coloured(own for own, _ in scored)
    for own, error in scored:
        ends = (error.get("interval_95") or {}).get("mae_k")
        bars = None if ends is None else [[max(error["mae_k"] - ends[0], 0.0)], [max(ends[1] - error["mae_k"], 0.0)]]
        axis.errorbar(1e3 * own["seconds_per_frame"], error["mae_k"], yerr=bars, ls="", ms=4, lw=0.8,
                      marker=_MARKS.get(own["kind"], "v"), color=colours[own["map"]], capsize=1.5,
                      mfc="none" if own["bounds"] in _FITTED else None)  # fmt: skip
    axis.set(xscale="log", yscale="log", xlabel="run time [ms per frame]", ylabel="mean absolute error [K]")
    _plain(axis.xaxis, axis.yaxis)
    axis.grid(alpha=0.3, which="both", lw=0.4)
    # A map has a marker for each of its uses, any other method its own.
    marks = {own["map"]: "o" if own["kind"] in _USES else _MARKS.get(own["kind"], "v") for own, _ in scored}
    entries: list[tuple[str, _Look]] = [(name, {"color": colour, "marker": marks[name], "ls": ""})
                                        for name, colour in colours.items()]  # fmt: skip
    kinds = {own["kind"] for own, _ in scored}
    entries += [(words, {"color": "grey", "marker": _MARKS[kind], "ls": ""}) for kind, words in _USES.items()
                if kind in kinds]  # fmt: skip
    if any(own["bounds"] in _FITTED for own, _ in scored):
        entries.append(("refitted or calibrated", {"color": "grey", "marker": "o", "ls": "", "mfc": "none"}))
    _below(drawing, entries)
    return drawing


def spectra(summary: Summary) -> Any:
    """Return the figure of the power of the methods and of the reference against spatial frequency, or None."""
    references = [each["spectrum"] for each in summary["scenes"] if each["spectrum"]]
    # A logarithmic scale cannot show zero power. Learned materials change a spectrum little.
    curves = [(own, own["structure"]["spectrum"]) for own in _best(summary)
              if own["kind"] not in (LEARNED_MATERIALS, *FLAT) and own["structure"]["spectrum"]
              and min(own["structure"]["spectrum"]["k2_px2"]) > 0.0]  # fmt: skip
    if not references or not curves or not min(references[0]["k2_px2"]) > 0.0:
        return None
    drawing, axis = _column(2.3)
    weight = np.array([each["poses"] for each in summary["scenes"] if each["spectrum"]], float)
    frequency = references[0]["cycles_per_px"]
    mean = np.average([each["k2_px2"] for each in references], axis=0, weights=weight)
    black: _Look = {"color": "black", "lw": 1.6}
    axis.plot(frequency, mean, **black)
    colours = _coloured(own for own, _ in curves)
    for own, curve in curves:
        axis.plot(curve["cycles_per_px"], curve["k2_px2"], lw=0.8, **_line(own, colours))
    axis.set(xscale="log", yscale="log", xlabel="spatial frequency [cycles/px]", ylabel="power density [K² px²]")
    _plain(axis.xaxis)
    axis.grid(alpha=0.3, which="both", lw=0.4)
    _below(drawing, _curves_of([own for own, _ in curves], colours, [("reference", black)]))
    return drawing


def differences(summary: Summary) -> Any:
    """Return the figure of the mean absolute difference of each pair of methods in scenes without truth, or None."""
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
    # Many methods need more than a column.
    side = max(COLUMN_IN, 1.7 + 0.26 * len(labels))
    drawing = pyplot().figure(figsize=(side + 0.3, side), layout="constrained")
    axis = drawing.subplots()
    image = axis.imshow(matrix, cmap="viridis")
    dark = np.nanmin(matrix) + 0.6 * (np.nanmax(matrix) - np.nanmin(matrix))
    for (k, j), kelvin in np.ndenumerate(matrix):
        if np.isfinite(kelvin):
            words = f"{kelvin:.1f}" if kelvin < 9.95 else f"{kelvin:.0f}"
            axis.text(j, k, words, ha="center", va="center", fontsize=_WORDS_PT,
                      color="white" if kelvin < dark else "black")  # fmt: skip
    shown = [formats.label(textwrap.fill(label, _TITLE)) for label in labels]
    axis.set_xticks(range(len(labels)), shown, rotation=90, fontsize=_WORDS_PT)
    axis.set_yticks(range(len(labels)), shown, fontsize=_WORDS_PT)
    bar = drawing.colorbar(image, ax=axis, shrink=0.6)
    bar.set_label("mean absolute difference [K]", size=_WORDS_PT)
    bar.ax.tick_params(labelsize=_WORDS_PT)
    return drawing


def terms(summary: Summary, names: Sequence[str]) -> Any:
    """Return the figure of the mean absolute size of each map's terms over all scenes, or None."""
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
    drawing, axis = _column(1.0 + 0.4 * len(total))
    entries: list[tuple[str, _Look]] = []
    for number, term in enumerate((*names, "whole")):
        place = np.arange(len(total)) + (number - len(names) / 2.0) * 0.13
        values = [own[term][0] / own[term][1] if term in own else 0.0 for own in total.values()]
        colour = _COLOURS[number % 8] if term != "whole" else "black"
        axis.barh(place, values, height=0.12, color=colour)
        entries.append((term, {"color": colour, "lw": 4}))
    axis.set_yticks(range(len(total)), [formats.label(name) for name in total], fontsize=_WORDS_PT)
    axis.invert_yaxis()
    axis.set(xlabel="mean absolute size [K]")
    _below(drawing, entries, 3)
    return drawing


def roc(summary: Summary) -> Any:
    """Return the figure of the share of targets that a simple detector finds against its false alarms, or None."""
    curves = [(own, own["targets"]["roc"]) for own in _best(summary)
              if own["kind"] != LEARNED_MATERIALS and own["targets"]["roc"]]  # fmt: skip
    known = summary["targets"]["roc"]
    if not curves:
        return None
    drawing, axis = _column(2.3)
    colours = _coloured(own for own, _ in curves)
    black: _Look = {"color": "black", "lw": 1.6}
    if known:
        x, y = np.array(known)[:, :2].T
        axis.step(np.maximum(x, 1e-2), y, where="post", **black)
    for own, curve in curves:
        x, y = np.array(curve)[:, :2].T
        axis.step(np.maximum(x, 1e-2), y, where="post", lw=0.8, **_line(own, colours))
    axis.set(xscale="log", xlabel="false alarms per frame", ylabel="share of targets found", ylim=(-0.02, 1.02))
    _plain(axis.xaxis)
    axis.grid(alpha=0.3, lw=0.4)
    _below(drawing, _curves_of([own for own, _ in curves], colours, [("reference", black)] if known else []))
    return drawing


def _best(summary: Summary) -> list[dict[str, Any]]:
    """Return the methods that a figure shows: for each map and kind the one with the best bounds, which is last."""
    return list(_best_labelled(summary).values())


def _best_labelled(summary: Summary) -> dict[str, dict[str, Any]]:
    """Return {label: method} of the methods that a figure shows."""
    methods = [(label, own) for label, own in summary["methods"].items() if not own["true_objects"]]
    return dict({(own["kind"], own["map"]): (label, own) for label, own in methods}.values())


def _coloured(methods: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return {map: colour}."""
    from matplotlib import colormaps

    names = list(dict.fromkeys(own["map"] for own in methods))
    palette: Sequence[Any] = _COLOURS if len(names) <= len(_COLOURS) else list(colormaps["tab20"](np.arange(20)))
    return {name: palette[number % len(palette)] for number, name in enumerate(names)}


def _line(own: dict[str, Any], colours: Mapping[str, Any]) -> _Look:
    return {"color": colours[own["map"]], "ls": _STYLE.get(own["kind"], "-.")}


def _curves_of(
    methods: Sequence[dict[str, Any]], colours: Mapping[str, Any], first: Sequence[tuple[str, _Look]] = ()
) -> list[tuple[str, _Look]]:
    """Return the entries of a legend of maps by colour, and of their uses by dashes."""
    kinds = {own["kind"] for own in methods}
    dashes = {own["map"]: "-" if own["kind"] in _STYLE else "-." for own in methods}
    return [
        *first,
        *((name, {"color": colour, "ls": dashes[name]}) for name, colour in colours.items()),
        *((words, {"color": "grey", "ls": _STYLE[kind]}) for kind, words in _USES.items() if kind in kinds),
    ]


def _below(drawing: Any, entries: Sequence[tuple[str, _Look]], columns: int = 2) -> None:
    """Draw a legend of (words, look of a line) below the axes of a figure, which grows by its height."""
    handles = [pyplot().Line2D([], [], label=formats.label(name), **{"ms": 4, **look}) for name, look in entries]
    width, height = drawing.get_size_inches()
    drawing.set_size_inches(width, height + 0.14 * -(-len(handles) // columns))
    drawing.legend(handles=handles, fontsize=_WORDS_PT, frameon=False, loc="outside lower center", ncols=columns,
                   handlelength=1.6, columnspacing=1.0, labelspacing=0.25)  # fmt: skip


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


def _ends(present: Any) -> tuple[int, int]:
    """Return the range of places of what is present; the whole range where nothing is."""
    found = np.flatnonzero(present)
    return (int(found[0]), int(found[-1]) + 1) if found.size else (0, present.size)


@dataclass(frozen=True)
class Opening:
    """The pictures of one pose at half size, which open the page and its printed figure."""

    title: str
    photograph: NDArray[np.uint8]  # (h, w, 3)
    known: NDArray[np.bool_]  # (h, w)
    truth: Image | None  # (h, w) [K]
    reference: str  # Label of the reference
    seen: dict[str, Image]  # (h, w) [K] of each method by label

    @classmethod
    def of(cls, title: str, view: View, seen: Mapping[str, Image], reference: str) -> "Opening":
        """Return the pictures of a View and of the methods, cut to what is known."""
        inside = tuple(slice(*_ends(view.known.any(axis))) for axis in (1, 0))

        def half(image: Any) -> Any:
            return image[inside][::2, ::2]

        truth = None if view.truth is None else half(view.truth)
        halves = {label: half(image).astype(np.float32) for label, image in seen.items()}
        return cls(title, half(shown_photograph(view)), half(view.known), truth, reference, halves)

    def shown(self, summary: Summary) -> list[str]:
        """Return the labels of the methods shown: those of the smallest error, without any that has no pattern."""
        found = [(own["errors"]["radiometric"]["ground"]["mae_k"] if own["errors"] else 0.0, label)
                 for label, own in _best_labelled(summary).items()
                 if label in self.seen and own["kind"] not in FLAT]  # fmt: skip
        kept = {label for _, label in sorted(found, key=lambda each: np.inf if each[0] is None else each[0])[:_OPENING]}
        return [label for _, label in found if label in kept]

    def scales(self, labels: Sequence[str]) -> tuple[tuple[float, float], float]:
        """Return (coldest and warmest colour of the temperatures, end of the colours of the errors), all in kelvin."""
        base = self.truth if self.truth is not None else self.seen[labels[0]]
        off = (
            [np.abs((self.seen[label] - self.truth)[self.known]) for label in labels] if self.truth is not None else []
        )
        errors = np.concatenate([np.zeros(0), *(each[np.isfinite(each)] for each in off)])
        low, high = _scale(base, self.known)
        return (low, high), float(np.percentile(errors, 95)) if errors.size else 1.0

    def painted(self, labels: Sequence[str]) -> list[tuple[str, NDArray[np.uint8], NDArray[np.uint8] | None]]:
        """Return [(title, RGB picture, RGB picture of its error or None)]: photograph, reference, methods."""
        from matplotlib import colormaps

        (low, high), limit = self.scales(labels)

        def colours(values: Image, table: str, ends: tuple[float, float]) -> NDArray[np.uint8]:
            share = (values - ends[0]) / (ends[1] - ends[0] or 1.0)
            own = (255.0 * colormaps[table](np.nan_to_num(share))[..., :3]).round().astype(np.uint8)
            own[~self.known | ~np.isfinite(values)] = GREY
            return own

        found: list[tuple[str, NDArray[np.uint8], NDArray[np.uint8] | None]] = [("photograph", self.photograph, None)]
        if self.truth is not None:
            found.append((self.reference, colours(self.truth, "inferno", (low, high)), None))
        for label in labels:
            image = self.seen[label]
            error = None if self.truth is None else colours(image - self.truth, "RdBu_r", (-limit, limit))
            found.append((label, colours(image, "inferno", (low, high)), error))
        return found

    def printed(self, summary: Summary) -> Any:
        """Return the figure of a column's width: pictures, and below each method's its error, with bars in kelvin."""
        labels = self.shown(summary)
        panels = self.painted(labels)
        columns, step = min(_PANELS, len(panels)), 2 if self.truth is not None else 1
        lines = -(-len(panels) // columns)
        height, width = self.known.shape
        side = COLUMN_IN / columns
        size = COLUMN_IN, lines * (step * (side * height / width + 0.04) + 0.36) + 0.36
        drawing = pyplot().figure(figsize=size, layout="constrained")
        drawing.get_layout_engine().set(w_pad=0.015, h_pad=0.015, wspace=0.01, hspace=0.01)
        axes = drawing.subplots(step * lines, columns, squeeze=False)
        for number, (title, image, error) in enumerate(panels):
            place = axes[number // columns * step :, number % columns]
            place[0].imshow(image)
            place[0].set_title(formats.label(textwrap.fill(title, _NARROW)), fontsize=_WORDS_PT, pad=2, y=1.0)
            if error is not None:
                place[1].imshow(error)
        for axis in axes.ravel():
            axis.set_axis_off()
        from matplotlib import cm, colors

        ends, limit = self.scales(labels)
        bars = [("inferno", ends, "apparent temperature [K]")]
        if self.truth is not None:
            bars.append(("RdBu_r", (-limit, limit), "error [K]"))
        middle = columns // 2 if len(bars) > 1 else columns
        for (table, (low, high), words), below in zip(bars, (axes[-1, :middle], axes[-1, middle:]), strict=False):
            bar = drawing.colorbar(cm.ScalarMappable(colors.Normalize(low, high), table), ax=below.tolist(),
                                   location="bottom", aspect=22, shrink=0.9, pad=0.02)  # fmt: skip
            bar.set_label(words, size=_WORDS_PT, labelpad=1)
            bar.ax.tick_params(labelsize=_WORDS_PT, length=2, pad=1)
        return drawing


@dataclass
class Pictures:
    """The pictures of a comparison."""

    folder: Path  # Files are written to its folder `pictures`
    scenes: int = 1  # Number of scenes
    # {"title", "visible", "pictures": [{"label", "source", "reference"}]} of each pose on the page
    views: list[dict[str, Any]] = field(default_factory=list)
    opening: "Opening | None" = None  # A pose in the middle of the first scene
    _bytes: int = 0

    def add(self, scene: str, view: View, seen: Mapping[str, Image], count: int, reference: str = "reference") -> None:
        """Add the pictures of one of `count` Views if it is drawn: `seen` is {label: (H, W) kelvin}."""
        drawn = evenly(count, min(_POSES, max(1, _ALL // self.scenes)))
        if view.index not in drawn:
            return
        place = self.folder / "pictures"
        place.mkdir(exist_ok=True)
        error_images(place / f"{scene}_{view.index:04d}.png", view, seen, reference)
        if self.opening is None and view.index == drawn[len(drawn) // 2]:
            self.opening = Opening.of(f"{scene}, {view.time_s:.1f} s", view, seen, reference)
        shown = [] if view.truth is None else [(reference, view.truth)]
        pictures: list[dict[str, Any]] = [
            {"label": label, "source": encoded(image, view.known), "reference": label == reference}
            for label, image in (*shown, *seen.items())
        ]
        size = sum(len(each["source"]) for each in pictures)
        if self._bytes + size > MOST_BYTES:
            return
        self._bytes += size
        photograph = cv2.resize(shown_photograph(view), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        self.views.append({
            "title": f"{scene}, {view.time_s:.1f} s",
            "visible": jpeg(photograph),
            "pictures": pictures,
        })  # fmt: skip


def encoded(kelvin: NDArray[np.floating], known: NDArray[np.bool_]) -> str:
    """Return a picture at half its size as a data URL of a PNG that encodes kelvin.

    Red and green are high and low byte in steps of 1/20 K, 0 for none; blue is 255 at scored pixels.
    """
    small = kelvin[::2, ::2]
    steps = np.where(np.isfinite(small), np.clip(np.rint(np.nan_to_num(small) * STEPS_PER_K), 0, 65535), 0).astype(
        np.uint16
    )
    blue = np.where(known[::2, ::2], 255, 0).astype(np.uint8)
    image = np.stack([blue, (steps & 255).astype(np.uint8), (steps >> 8).astype(np.uint8)], axis=-1)
    return _data_url("png", ".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 6])


def jpeg(image: NDArray[Any]) -> str:
    """Return an RGB picture as a data URL."""
    return _data_url("jpeg", ".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])


def _data_url(kind: str, suffix: str, image: Any, options: Sequence[int]) -> str:
    content = np.asarray(cv2.imencode(suffix, image, options)[1]).tobytes()
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def picture(path: Path, view: View, guesses: Mapping[str, Image], share: float) -> None:
    """Draw a pair: its visible and true picture, and each method's picture {label: (H, W) [K]} and error.

    `share` is the quantile of this pair in the first method's error.
    """
    assert view.truth is not None and view.pair is not None
    plot, (height, width) = pyplot(), view.truth.shape
    columns = 1 if len(guesses) < _FOLDED else 3
    lines = -(-(len(guesses) + 1) // columns)
    size = 11.0 * columns**0.5, (0.35 + 4.6 / columns**0.5 * height / width) * lines + 0.8
    figure, axes = plot.subplots(lines, 2 * columns, figsize=size, layout="constrained", squeeze=False)
    pairs = axes.reshape(-1, 2)
    true = np.where(view.known, view.truth, np.nan)
    errors = {name: np.where(view.known, guess - view.truth, np.nan) for name, guess in guesses.items()}
    low, high = np.nanpercentile(true, [1, 99])
    every = np.abs(np.concatenate([error[np.isfinite(error)] for error in errors.values()]))
    limit = float(np.percentile(every, 98)) if every.any() else 1.0
    pairs[0, 0].imshow(view.pair.visible)
    pairs[0, 0].set_title(f"{formats.label(view.pair.entry.key)}: visible", fontsize=10)
    warm = pairs[0, 1].imshow(true, cmap="inferno", vmin=low, vmax=high)
    pairs[0, 1].set_title(f"true; quantile {share:g} of the first map's error", fontsize=10)
    for (name, guess), (left, right) in zip(guesses.items(), pairs[1:], strict=False):
        left.imshow(guess, cmap="inferno", vmin=low, vmax=high)
        left.set_title(formats.label(name), fontsize=10)
        off = right.imshow(errors[name], cmap="RdBu_r", vmin=-limit, vmax=limit)
        finite = errors[name][np.isfinite(errors[name])]
        if finite.size:
            right.set_title(f"error: ME {finite.mean():+.2f}, MAE {np.abs(finite).mean():.2f} K", fontsize=10)
    for axis in axes.ravel():
        axis.set_axis_off()
    below = axes[-1, :columns].tolist(), axes[-1, columns:].tolist()
    for shown, place, label in ((warm, below[0], "apparent temperature [K]"), (off, below[1], "error [K]")):
        figure.colorbar(shown, ax=place, label=label, location="bottom", aspect=40, shrink=0.8)
    save(figure, path)


def against_time(path: Path, result: dict[str, Any]) -> None:
    """Draw the maps' mean absolute error of an evaluation against inference time, with the baselines as lines."""
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
    columns = -(-len(axis.get_legend_handles_labels()[0]) // _LONGEST)
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
