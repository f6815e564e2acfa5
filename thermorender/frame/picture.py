"""Temperatures as a picture with a colour bar: in a notebook, in a window, or in colours of a terminal."""

import base64
import io
import sys
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.formats import label
from thermorender.progress import in_notebook
from thermorender.sensor.display import INNER_PERCENT, without_outliers
from thermorender.sensor.palettes import palette

# Share of the pixels at each end that may lie outside the colours, such as a few of sky [%].
_TAILS = 0.5
# Least width of the colours [K], so that a uniform image is not drawn as its rounding.
_LEAST_K = 0.1
_PALETTE = "ironbow"
# Of a picture in a terminal, at most [characters].
_MOST_COLUMNS = 100
# Backends of Matplotlib that only write files.
_FILE_BACKENDS = ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template")


def span(kelvin: NDArray[Any]) -> str:
    """Return the range of temperatures in words."""
    known = kelvin[np.isfinite(kelvin)]
    return f"{known.min():.1f}–{known.max():.1f} K" if known.size else "no temperature"


def limits(kelvin: NDArray[Any]) -> tuple[float, float]:
    """Return the temperatures of the first and the last colour [K]; a few pixels may lie far beyond them."""
    known = kelvin[np.isfinite(kelvin)]
    low = high = 0.0
    if known.size:
        low, high, *inner = np.percentile(known, [_TAILS, 100.0 - _TAILS, *INNER_PERCENT]).tolist()
        low, high = without_outliers(low, high, (inner[0], inner[1]))
    middle, half = 0.5 * (low + high), 0.5 * max(high - low, _LEAST_K)
    return float(middle - half), float(middle + half)


def draw(
    figure: Any, kelvin: NDArray[Any], title: str, of: str = "apparent temperature [K]", texel_m: float | None = None
) -> None:  # fmt: skip
    """Draw temperatures (h, w) [K] with a colour bar, labelled `of`, into an empty Matplotlib figure.

    A map, of which a pixel's side on the ground is `texel_m` [m], has a scale bar below it.
    """
    from matplotlib.colors import ListedColormap

    low, high = limits(kelvin)
    colours = ListedColormap(np.asarray(palette(_PALETTE)) / 255.0, name=_PALETTE)
    axes = figure.add_subplot()
    drawn = axes.imshow(kelvin, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.set_title(label(title), fontsize=9)
    figure.colorbar(drawn, ax=axes, label=of, extend="both", shrink=0.85)
    if texel_m is not None:
        metres = bar_m(kelvin.shape[1] * texel_m)
        end, below = metres / (kelvin.shape[1] * texel_m), -0.03
        axes.plot([0.0, end], [below, below], "k|-", transform=axes.transAxes, clip_on=False, linewidth=2)
        axes.text(end + 0.02, below, f"{metres:g} m", transform=axes.transAxes, va="center", fontsize=9)


def bar_m(width_m: float) -> float:
    """Return the length of the scale bar of a map [m]: 1, 2 or 5 times a power of ten, up to a quarter of its width."""
    power = 10.0 ** np.floor(np.log10(0.25 * width_m))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= 0.25 * width_m))


def png(
    kelvin: NDArray[Any], title: str, of: str = "apparent temperature [K]", texel_m: float | None = None
) -> bytes:  # fmt: skip
    """Return the PNG of the picture of temperatures (h, w) [K], as by `draw`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure, kelvin, title, of, texel_m)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()


def html(kelvin: NDArray[Any], title: str) -> str:
    """Return the picture as HTML that needs no file."""
    data = base64.b64encode(png(kelvin, title)).decode()
    return f'<img alt="{escape(title)}" src="data:image/png;base64,{data}">'


def show(shown: Any, kelvin: NDArray[Any]) -> None:
    """Show an object with `_repr_html_`: in a notebook, else in a window, else in the terminal.

    Where the output is not a terminal either, its line is printed.
    """
    if in_notebook():
        from IPython.display import display  # type: ignore[import-not-found, unused-ignore]

        display(shown)
        return
    import matplotlib.pyplot as plt

    if plt.get_backend().lower() not in _FILE_BACKENDS:
        figure = plt.figure(figsize=(7.5, 5.0), layout="constrained")
        draw(figure, kelvin, repr(shown))
        plt.show()
        return
    if sys.stdout.isatty():
        from rich.console import Console

        console = Console()
        console.print(_half_blocks(kelvin, min(console.width, _MOST_COLUMNS)))
    print(repr(shown))


def _half_blocks(kelvin: NDArray[Any], columns: int) -> Any:
    """Return rich text of a picture: each character is two pixels, one above the other, and a scale below."""
    from rich.text import Text

    low, high = limits(kelvin)
    columns = min(columns, kelvin.shape[1])
    rows = max(2, round(columns * kelvin.shape[0] / kelvin.shape[1] / 2) * 2)
    at = [((np.arange(n) + 0.5) * size / n).astype(int) for n, size in zip((rows, columns), kelvin.shape, strict=True)]
    share = np.nan_to_num((kelvin[np.ix_(*at)] - low) / (high - low))
    table = np.asarray(palette(_PALETTE))
    colour = table[np.clip(np.rint(255.0 * share), 0, 255).astype(int)]
    text = Text()
    for upper, lower in zip(colour[::2], colour[1::2], strict=True):
        for one, other in zip(upper.tolist(), lower.tolist(), strict=True):
            text.append("▀", style=f"rgb({one[0]},{one[1]},{one[2]}) on rgb({other[0]},{other[1]},{other[2]})")
        text.append("\n")
    text.append(f"≤{low:.1f} K ")
    for one in table[:: 256 // 32].tolist():
        text.append("█", style=f"rgb({one[0]},{one[1]},{one[2]})")
    text.append(f" ≥{high:.1f} K")
    return text
