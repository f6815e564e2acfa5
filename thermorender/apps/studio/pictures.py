"""Pictures for the browser and for files: values in colours with their bar, differences, photographs, materials."""

import io
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.studio.layers import LAYERS, NOTHING, Shot
from thermorender.apps.studio.view import Limits, View
from thermorender.errors import ThermorenderError
from thermorender.formats import encoded_image, label
from thermorender.frame.picture import limits as automatic
from thermorender.sensor.palettes import PALETTES, palette

# Palettes of the package, and some of Matplotlib that also read well for the colour-blind.
NAMES = (*PALETTES, "inferno", "viridis")
# Words, each with its colour as CSS.
Legend = tuple[tuple[str, str], ...]
_DIFFERENCE = "RdBu_r"
# Least end of the colours of a difference, by its unit.
_LEAST_DIFFERENCE = {"K": 0.01, "mK": 0.1, "W/m²": 0.1, "": 1e-4}
# Share of the pixels at each end that may lie outside the colours [%].
_TAILS = 0.5
_NO_SURFACE = (24, 28, 36)
# Levels of a palette for pixels without a value, which are hatched: a single colour may be one of the palette's.
_VALUES, _HATCH = 254, (np.float32(254.0), np.float32(255.0))
_HATCHES = ((96, 103, 112), (150, 157, 166))
_HATCH_PX = 5
# Limits of the lightness L* of colours of materials.
_DARKEST, _LIGHTEST = 28.0, 90.0


@dataclass(frozen=True)
class Picture:
    """An encoded picture with what stands beside it."""

    # number, version: Count of the tab's pictures, and version of the edits
    number: int
    version: int
    words: str  # "exact", or "preview ± x mK"
    exact: bool
    view: View | None = None  # that it is of
    title: str = ""  # What it shows
    difference: bool = False  # from what it is compared with
    data: bytes = b""
    kind: str = "image/png"  # Media type of the data
    sides: tuple[str, str] | None = None  # What it and that which it is compared with are called
    # What it is compared with, beside a slider, and its levels
    other: bytes = b""
    other_levels: NDArray[np.uint8] | None = field(default=None, repr=False)
    ends: tuple[float, float] | None = None  # of the colour bar; None without one
    palette: str = ""
    unit: str = ""
    notes: str = ""  # Mean and extremes, or why there is no picture
    legend: Legend = field(default=())  # Materials in view
    values: NDArray[np.float32] | None = field(default=None, repr=False)  # (H, W) of the pixels
    # (H, W) of the colours, or (H, W, 3) sRGB, and those colours, (256, 3) sRGB
    levels: NDArray[np.uint8] | None = field(default=None, repr=False)
    colours: NDArray[np.uint8] | None = field(default=None, repr=False)

    @classmethod
    def of_fault(cls, sentence: str, version: int) -> "Picture":
        """Return a Picture that only states why there is none."""
        return cls(0, version, "", False, notes=sentence)

    def ticks(self, count: int) -> list[str]:
        """Return the labels of the colour bar, from its upper end down."""
        if self.ends is None:
            return [""] * count
        low, high = self.ends
        across = high - low
        digits = max(0, min(4, 2 - int(np.floor(np.log10(across))))) if across > 0.0 else 3
        digits = min(digits, 1) if self.unit in ("mK", "W/m²") else digits
        sign = "+" if low < 0.0 and self.unit else ""
        values = (round(float(value), digits) + 0.0 for value in np.linspace(high, low, count))
        return [f"{value:{sign if value else ''}.{digits}f}".replace("-", "−") for value in values]


@cache
def table(name: str) -> NDArray[np.uint8]:
    """Return the 256 colours of a palette, (256, 3) uint8 sRGB."""
    if name in PALETTES:
        colours = palette(name)
        return np.repeat(colours[:, None], 3, axis=1) if colours.ndim == 1 else colours
    from matplotlib import colormaps

    return np.rint(255.0 * colormaps[name](np.arange(256))[:, :3]).astype(np.uint8)


@cache
def _table_of_values(name: str) -> NDArray[np.uint8]:
    """The colours of a palette for values, followed by those of pixels without a value, (256, 3) uint8 sRGB."""
    values = table(name)[np.rint(np.linspace(0.0, 255.0, _VALUES)).astype(int)]
    return np.concatenate([values, np.array(_HATCHES, np.uint8)])


def hexadecimal(colour: Sequence[float] | NDArray[Any]) -> str:
    """Return an sRGB colour as CSS, "#rrggbb"."""
    return "#{:02x}{:02x}{:02x}".format(*(int(part) for part in colour))


@cache
def gradient(name: str) -> str:
    """Return a palette as a vertical gradient of CSS, the lowest value at the bottom."""
    stops = table(name)[np.linspace(0, 255, 17).astype(int)]
    return f"linear-gradient(to top, {', '.join(map(hexadecimal, stops))})"


def picture_of(shot: Shot, what: str, blank: Picture, colours: "MaterialColours") -> Picture:
    """Return the Picture of a Shot, filled into `blank`; it is compared with `shot.other`, which is `what`, if any.

    Raises
    ------
    ThermorenderError
        The layer is not there in this view, or is not known yet.
    """
    view, about, other = shot.view, LAYERS[shot.view.layer], shot.other
    if reason := shot.shows(view.layer):
        raise ThermorenderError(reason)
    sides = (f"version {blank.version}", what) if other is not None else None
    blank = replace(blank, title=about.title + (", from above" if view.plan else ""), sides=sides)
    beside = other is not None and (view.slider or not about.channel)
    if not about.channel:
        made = _without_values(shot, blank, colours)
        if not beside or other is None:
            return made
        beside_it = _without_values(other, blank, colours)
        return replace(made, other=beside_it.data, other_levels=beside_it.levels)
    values = shot.values(view.layer)
    before = None if other is None else other.values(view.layer)
    if before is not None and not beside:
        change = values - before
        most = max(_largest(change), _LEAST_DIFFERENCE[about.unit])
        ends = _within(view.limits, (-most, most))
        blank = replace(blank, title=f"{blank.title}, minus that of {what}", difference=True)
        return _drawn(blank, change, _DIFFERENCE, ends, about.unit, words_of(change, about.unit))
    every = values if before is None else np.stack([values, before])
    scale, most = (_DIFFERENCE, max(_largest(every), 1.0)) if about.signed else (view.palette, 0.0)
    ends = _within(view.limits, (-most, most) if about.signed else _automatic(every, about.unit))
    made = _drawn(blank, values, scale, ends, about.unit, words_of(values, about.unit))
    if before is None:
        return made
    levels = _levels(before, *ends)
    return replace(made, other=_png(levels, _table_of_values(scale)), other_levels=levels)


def _without_values(shot: Shot, blank: Picture, colours: "MaterialColours") -> Picture:
    """The Picture of a layer that has no values."""
    layer = shot.view.layer
    if layer == "photograph":
        colour, known = shot.colour
        image = np.where(known[..., None], colour, np.array(_NO_SURFACE, np.uint8))
        return replace(blank, data=encoded_image(".jpg", image), kind="image/jpeg", levels=image)
    if layer == "display" and shot.frame is not None:
        level = shot.frame.display
        shades = table(shot.view.palette)
        made = replace(blank, data=_png(level, shades), levels=level, colours=shades, values=level.astype(np.float32))
        return replace(made, ends=(0.0, 255.0), palette=shot.view.palette, unit="level")
    learned = layer == "learned" and shot.learned is not None
    number = shot.learned_materials() if learned else shot.material
    names = shot.learned.names if learned and shot.learned is not None else shot.names
    words = shot.learned.words if learned and shot.learned is not None else ""
    level = colours.numbers(names)[number]
    shades = colours_of_materials()
    data = _png(level, shades)
    return replace(
        blank, data=data, levels=level, colours=shades, legend=legend_of(number, names, colours), notes=words
    )


def _levels(values: NDArray[np.float32], low: float, high: float) -> NDArray[np.uint8]:
    most = np.float32(_VALUES - 1)
    scaled = np.clip(np.rint((values - np.float32(low)) * (most / np.float32(high - low))), 0.0, most)
    row, column = (np.arange(side) for side in values.shape)
    hatch = np.where((row[:, None] + column) // _HATCH_PX % 2, _HATCH[0], _HATCH[1])
    return np.where(np.isnan(values), hatch, scaled).astype(np.uint8)


def _drawn(
    blank: Picture, values: NDArray[np.float32], colours: str, ends: tuple[float, float], unit: str, notes: str
) -> Picture:
    levels = _levels(values, *ends)
    shades = _table_of_values(colours)
    made = replace(blank, data=_png(levels, shades), levels=levels, colours=shades, values=values)
    return replace(made, ends=ends, palette=colours, unit=unit, notes=notes)


def _automatic(values: NDArray[np.floating], unit: str) -> tuple[float, float]:
    """The ends of the colours: of temperatures as of frames elsewhere, of other quantities all but a few pixels."""
    known = values[np.isfinite(values)]
    if unit == "K" or not known.size:
        return automatic(values)
    low, high = (float(each) for each in np.percentile(known, (_TAILS, 100.0 - _TAILS)))
    return (low, high) if high - low > _LEAST_DIFFERENCE[unit] else (low, low + _LEAST_DIFFERENCE[unit])


def _within(limits: Limits | None, free: tuple[float, float]) -> tuple[float, float]:
    """The ends of the colours: fixed ones, and else those that the picture needs, as far apart where they are free."""
    low, high = limits or (None, None)
    span = free[1] - free[0]
    if low is None:
        low = free[0] if high is None or free[0] < high else high - span
    if high is None:
        high = free[1] if low < free[1] else low + span
    return low, high


def _largest(values: NDArray[np.floating]) -> float:
    known = np.abs(values[np.isfinite(values)])
    return float(known.max()) if known.size else 0.0


def words_of(values: NDArray[np.floating], unit: str) -> str:
    """Return mean and extremes of values in words."""
    known = values[np.isfinite(values)]
    if not known.size:
        return "hatched: no value in view"
    mean, low, high = (quantity(each, unit) for each in (known.mean(dtype=np.float64), known.min(), known.max()))
    return f"mean {mean}, from {low} to {high}" + ("" if known.size == values.size else "; hatched: no value")


def quantity(value: float, unit: str) -> str:
    """Return a value with its unit: a temperature below 1 K, such as a difference, in mK."""
    value = float(value)
    if unit == "K" and abs(value) < 1.0:
        return f"{1000.0 * value:.3g} mK".replace("-", "−")
    digits = {"K": 2, "mK": 1, "W/m²": 1}.get(unit, 4)
    return f"{round(value, digits) + 0.0:.{digits}f} {unit}".rstrip().replace("-", "−")


def figure_of(picture: Picture, title: str, kind: str) -> bytes:
    """Return a picture with its colour bar or legend as a PNG or an SVG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    halves = [each for each in (picture.levels, picture.other_levels) if each is not None]
    figure = Figure(figsize=(7.2 * len(halves) + 0.8, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(halves), squeeze=False)[0]
    for one, levels, side in zip(
        axes, halves, picture.sides if len(halves) > 1 and picture.sides else ("",), strict=True
    ):
        one.imshow(levels if picture.colours is None else picture.colours[levels], interpolation="nearest")
        one.set_axis_off()
        one.set_title(label(side), fontsize=9)
    figure.suptitle(label(title), fontsize=9)
    if picture.ends is not None:
        bar = ScalarMappable(Normalize(*picture.ends), ListedColormap(table(picture.palette) / 255.0))
        figure.colorbar(bar, ax=list(axes), label=label(picture.unit or "1"), shrink=0.8)
    elif picture.legend:
        patches = [Patch(color=colour, label=label(name)) for name, colour in picture.legend]
        figure.legend(handles=patches, loc="outside lower center", ncols=4, fontsize=7, frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format=kind, dpi=150)
    return file.getvalue()


def outline_of(shot: Shot, name: str) -> bytes:
    """Return a transparent PNG with the outlines of a material's pixels."""
    import cv2
    from PIL import Image

    numbers = [number for number, each in enumerate(shot.names) if each == name]
    mask = np.isin(shot.material, numbers).astype(np.uint8)
    cross = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
    edge = (mask > 0) & (cv2.erode(mask, cross, borderValue=1) == 0)
    beside = (cv2.dilate(edge.astype(np.uint8), cross) > 0) & ~edge
    image = np.zeros((*mask.shape, 4), np.uint8)
    image[beside], image[edge] = (0, 0, 0, 150), (255, 255, 255, 255)
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", compress_level=1)
    return file.getvalue()


def legend_of(number: NDArray[np.uint8], names: Sequence[str], colours: "MaterialColours") -> Legend:
    """Return the names and colours of the materials in a picture of their numbers, the largest first."""
    count: dict[str, int] = {}
    for name, each in zip(names, np.bincount(number.ravel(), minlength=NOTHING + 1), strict=False):
        count[name] = count.get(name, 0) + int(each)
    return tuple((name, colours.of(name)) for name in sorted(count, key=lambda name: -count[name]) if count[name])


def _png(levels: NDArray[np.uint8], colours: NDArray[np.uint8]) -> bytes:
    """The PNG of levels (H, W) with a palette: a third of the bytes of true colour.

    It is not compressed, which takes longer than sending it over the loopback.
    """
    from PIL import Image

    image = Image.fromarray(levels, mode="P")
    image.putpalette(colours.tobytes())
    file = io.BytesIO()
    image.save(file, "PNG", compress_level=0)
    return file.getvalue()


class MaterialColours:
    """A colour for each material by its name: the same in the list and in all pictures, whatever is edited."""

    def __init__(self) -> None:
        self._number: dict[str, int] = {}
        self._lock = threading.Lock()

    def number(self, name: str) -> int:
        """Return the number of a material's colour in `colours_of_materials`, the next one for a new name."""
        with self._lock:
            return self._number.setdefault(name, len(self._number) % NOTHING)

    def numbers(self, names: Sequence[str]) -> NDArray[np.uint8]:
        """Return the number of the colour of each material of a scene, (256,); `NOTHING` beyond them."""
        found = np.full(NOTHING + 1, NOTHING, np.uint8)
        found[: len(names)] = [self.number(name) for name in names]
        return found

    def of(self, name: str) -> str:
        """Return the colour of a material as CSS."""
        return hexadecimal(colours_of_materials()[self.number(name)])


@cache
def colours_of_materials() -> NDArray[np.uint8]:
    """Return colours to tell materials apart, (256, 3) uint8 sRGB; 255 is no surface.

    Ten of Tableau are followed by the colours that are farthest, in CIE L*a*b*, from all before them: the
    first 40 differ by ΔE*ab of 27 at least, all by 12.
    """
    import cv2
    from matplotlib import colormaps

    def lab(colours: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.cvtColor(colours[None] / np.float32(255.0), cv2.COLOR_RGB2LAB)[0])

    axis = np.linspace(0.0, 255.0, 18, dtype=np.float32)
    candidates = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    places = lab(candidates)
    # Neither as dark as no surface nor as light as the page.
    seen = (places[:, 0] > _DARKEST) & (places[:, 0] < _LIGHTEST)
    candidates, places = candidates[seen], places[seen]
    colours = np.empty((256, 3), np.float32)
    colours[:10], colours[NOTHING] = 255.0 * np.array(colormaps["tab10"].colors), _NO_SURFACE  # type: ignore[attr-defined]
    known = lab(colours[[*range(10), 255]])
    far = np.linalg.norm(places[:, None] - known, axis=2).min(axis=1)
    for number in range(10, 255):
        best = int(far.argmax())
        colours[number] = candidates[best]
        far = np.minimum(far, np.linalg.norm(places - places[best], axis=1))
    return np.rint(colours).astype(np.uint8)
