"""Pictures of a frame for the browser: temperatures in colours, a difference, the camera's display, materials."""

import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Frame
from thermorender.apps.studio.view import View
from thermorender.formats import encoded_image
from thermorender.frame.picture import limits as automatic
from thermorender.sensor.palettes import PALETTES, palette

# Palettes of the package, and some of Matplotlib that also read well for the colour-blind.
NAMES = (*PALETTES, "inferno", "viridis")
# Words, each with its colour as CSS.
Legend = tuple[tuple[str, str], ...]
_DIFFERENCE = "RdBu_r"
_LEAST_DIFFERENCE_K = 0.01
_NO_SURFACE = (24, 28, 36)


@dataclass(frozen=True)
class Picture:
    """An encoded picture with what stands beside it."""

    # number, version: Count of the tab's pictures, and version of the edits
    number: int
    version: int
    words: str  # "exact", or "preview ± x mK"
    exact: bool
    data: bytes = b""
    kind: str = "image/png"  # Media type of the data
    ends: tuple[float, float] | None = None  # (float, float) or of the colour bar; None without one
    gradient: str = ""  # Its colours as CSS
    unit: str = ""
    notes: str = ""  # Mean and extremes of a difference, or why there is no picture
    legend: Legend = field(default=())  # Materials in view

    @classmethod
    def of_fault(cls, sentence: str, version: int) -> "Picture":
        """Return a Picture that only states why there is none."""
        return cls(0, version, "", False, notes=sentence)

    def ticks(self, count: int) -> list[str]:
        """Return the labels of the colour bar, from its upper end down."""
        if self.ends is None:
            return [""] * count
        low, high = self.ends
        digits = 0 if self.unit != "K" else 1 if high - low >= 10.0 else 2 if high - low >= 0.5 else 3
        sign = "+" if low < 0.0 else ""
        return [f"{value:{sign}.{digits}f}" for value in np.linspace(high, low, count)]


@cache
def table(name: str) -> NDArray[np.uint8]:
    """Return the 256 colours of a palette, (256, 3) uint8 sRGB."""
    if name in PALETTES:
        colours = palette(name)
        return np.repeat(colours[:, None], 3, axis=1) if colours.ndim == 1 else colours
    from matplotlib import colormaps

    return np.rint(255.0 * colormaps[name](np.arange(256))[:, :3]).astype(np.uint8)


def hexadecimal(colour: Sequence[float] | NDArray[Any]) -> str:
    """Return an sRGB colour as CSS, "#rrggbb"."""
    return "#{:02x}{:02x}{:02x}".format(*(int(part) for part in colour))


@cache
def gradient(name: str) -> str:
    """Return a palette as a vertical gradient of CSS, the lowest value at the bottom."""
    stops = table(name)[np.linspace(0, 255, 17).astype(int)]
    return f"linear-gradient(to top, {', '.join(map(hexadecimal, stops))})"


def picture_of(
    frame: Frame, view: View, blank: Picture, before: NDArray[np.float32] | None,
    colour: tuple[NDArray[np.uint8], NDArray[np.bool_]] | None,
) -> Picture:  # fmt: skip
    """Return the Picture of a frame, filled into `blank`; `before` is the apparent temperature of the saved tables for
    a difference (H, W) [K], and `colour` the photograph as of `Renderer.visible`.
    """

    def drawn(
        levels: NDArray[np.uint8], colours: str, ends: tuple[float, float], unit: str, notes: str = ""
    ) -> Picture:
        data = _png(levels, table(colours))
        return replace(blank, data=data, ends=ends, gradient=gradient(colours), unit=unit, notes=notes)

    kelvin = frame.apparent_temperature
    if view.mode == "photograph" and colour is not None:
        image = np.where(colour[1][..., None], colour[0], np.array(_NO_SURFACE, np.uint8))
        return replace(blank, data=encoded_image(".jpg", image), kind="image/jpeg")
    if view.mode == "materials":
        number = np.where(np.isfinite(frame.truth["depth"]), frame.truth["material"], np.uint8(255))
        return replace(blank, data=_png(number, colours_of_materials()), legend=legend_of(number, frame.materials))
    if view.mode == "display":
        return drawn(frame.display, view.palette, (0.0, 255.0), "level")
    if view.mode == "difference" and before is not None:
        change = kelvin - before
        most = max(float(np.nanmax(np.abs(change))), _LEAST_DIFFERENCE_K)
        notes = (
            f"mean {change.mean(dtype=np.float64):+.3f} K, from {change.min():+.3f} to {change.max():+.3f} K against "
            "the saved tables"
        )
        return drawn(_levels(change, -most, most), _DIFFERENCE, (-most, most), "K", notes)
    ends = view.limits or automatic(kelvin)
    return drawn(_levels(kelvin, *ends), view.palette, ends, "K")


def _levels(values: NDArray[np.float32], low: float, high: float) -> NDArray[np.uint8]:
    scaled = (values - np.float32(low)) * np.float32(255.0 / (high - low))
    return np.nan_to_num(np.clip(np.rint(scaled), 0.0, 255.0)).astype(np.uint8)


def legend_of(number: NDArray[np.uint8], names: Sequence[str]) -> Legend:
    """Return the names and colours of the materials in a picture of their numbers, the largest first."""
    count = np.bincount(number.ravel(), minlength=256)[: len(names)]
    order = (int(k) for k in np.argsort(-count, kind="stable") if count[k])
    return tuple((names[k], hexadecimal(colours_of_materials()[k])) for k in order)


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


@cache
def colours_of_materials() -> NDArray[np.uint8]:
    """Return a colour for each material number, (256, 3) uint8 sRGB; 255 is no surface."""
    from matplotlib import colormaps

    colours = np.rint(255.0 * colormaps["tab20"](np.arange(256) % 20)[:, :3]).astype(np.uint8)
    colours[255] = _NO_SURFACE
    return colours
