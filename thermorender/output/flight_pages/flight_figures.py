"""Pictures of a flight: the map with track and footprints, curves over time, a sheet of frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.formats import label
from thermorender.frame.picture import limits
from thermorender.output.flight_pages.prospect import Prospect, chosen
from thermorender.sensor.palettes import palette
from thermorender.units import ZERO_CELSIUS_K

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer

Floats = NDArray[np.float64]
# (h, w, 3) sRGB.
Picture = NDArray[np.uint8]

# Okabe and Ito, Color Universal Design (2008).
_BLUE, _ORANGE, _RED = "#0072B2", "#E69F00", "#D55E00"
_COLOURS = (_BLUE, _RED, "#009E73", _ORANGE, "#56B4E9", "#CC79A7", "black")
# Pixels along the longer side of the map, and rays along each side of a pixel.
_MAP_PX, _RAYS = 700, 2
# Footprints and numbers on a map, frames and columns on a sheet, and the width of a frame on it [px].
_FOOTPRINTS, _NUMBERS, SHEET, _COLUMNS, THUMBNAIL_PX = 20, 8, 24, 6, 210
_DPI = 100


@dataclass(frozen=True)
class Curve:
    """One panel of `curves`: a label with its unit, {name: values (N,)}, and limits (low, high) of a band or None."""

    label: str
    values: Mapping[str, Floats]
    band: tuple[Floats, Floats] | None = None
    celsius: bool = False


def flight_map(renderer: "Renderer", seen: Prospect, marked: Mapping[str, Sequence[float] | Floats] = {}) -> Picture:
    """Return a picture: the track over the orthophoto, footprints of evenly chosen frames, and marked points. `marked`
    is {name: (east, north, …) [m]}."""
    bounds = _bounds(renderer, seen)
    size = bounds[2:] - bounds[:2]
    across, down = _MAP_PX * size / size.max() / _DPI
    # Room for labels and legend [inches].
    below = 0.9 if across > 4.0 else 1.3
    whole = across + 1.0, down + below + 0.2
    figure = _figure(whole)
    axes = figure.add_axes((0.8 / whole[0], below / whole[1], across / whole[0], down / whole[1]))
    axes.imshow(_from_above(renderer, bounds), extent=(bounds[0], bounds[2], bounds[1], bounds[3]), zorder=0)
    for k in chosen(len(seen.index), _FOOTPRINTS):
        ring = seen.outline[k][np.isfinite(seen.outline[k, :, 0])]
        if len(ring) > 2:
            axes.fill(*ring.T, facecolor="none", edgecolor="white", linewidth=0.7, alpha=0.8, zorder=2)
    axes.plot(*seen.position[:, :2].T, color="black", linewidth=3.2, zorder=3, solid_capstyle="round")
    axes.plot(*seen.position[:, :2].T, color=_ORANGE, linewidth=1.8, zorder=3, label="track, with numbers of frames")
    axes.plot([], [], color="0.6", linewidth=0.7, label="footprints on the ground")
    empty = seen.position[~seen.shows_terrain]
    if len(empty):
        axes.plot(*empty[:, :2].T, ".", color=_RED, markersize=4, zorder=4, label="frames without terrain")
    for name, place in marked.items():
        axes.plot(*place[:2], "x", color=_BLUE, markeredgewidth=1.8, zorder=5)
        _word(axes, place[:2], name, _BLUE, -13)
    for k in chosen(len(seen.index), _NUMBERS):
        axes.plot(*seen.position[k, :2], "o", color=_ORANGE, markeredgecolor="black", markersize=5, zorder=4)
        _word(axes, seen.position[k, :2], str(seen.index[k]), "black")
    axes.set(xlim=bounds[[0, 2]], ylim=bounds[[1, 3]], xlabel="east [m]", ylabel="north [m]", aspect="equal")
    figure.legend(loc="lower center", ncols=3 if across > 4.0 else 1, frameon=False, fontsize=8)
    return _pixels(figure)


def curves(time_s: Floats, panels: Sequence[Curve]) -> Picture:
    """Return a picture of quantities over the time of the flight, one panel below the other."""
    tall = 0.7 + 1.6 * len(panels)
    figure = _figure((8.6, tall))
    axes = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
    # Labels of any width have room, and legends stand above their panel, where they cover no curve.
    figure.set_layout_engine("constrained", h_pad=0.05, hspace=0.0)
    for axis, panel in zip(axes, panels, strict=True):
        if panel.band is not None:
            axis.fill_between(time_s, *panel.band, color=_BLUE, alpha=0.2, linewidth=0)
        mark = "o" if len(time_s) < 3 else "None"
        for number, (name, values) in enumerate(panel.values.items()):
            colour = _COLOURS[number % len(_COLOURS)]
            axis.plot(time_s, values, color=colour, linewidth=1.4, marker=mark, markersize=3, label=label(name))
        axis.set_ylabel(panel.label, fontsize=9)
        axis.grid(alpha=0.3)
        axis.margins(x=0.01)
        if len(panel.values) > 1:
            axis.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, frameon=False, borderpad=0.0)
        if panel.celsius:
            other = axis.secondary_yaxis(
                "right", functions=(lambda k: k - ZERO_CELSIUS_K, lambda c: c + ZERO_CELSIUS_K)
            )
            other.set_ylabel("[°C]", fontsize=9)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    return _pixels(figure)


def thumbnail(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an image (H, W) at most `THUMBNAIL_PX` wide, by means over areas."""
    import cv2

    height, width = image.shape
    if width <= THUMBNAIL_PX:
        return image
    size = THUMBNAIL_PX, max(round(height * THUMBNAIL_PX / width), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def sheet(
    kelvin: Sequence[NDArray[np.float32]], surface: Sequence[NDArray[np.bool_]], labels: Sequence[str], title: str
) -> Picture:
    """Return a picture of frames (h, w) [K] in the colours of one bar, with the range of `surface` (h, w)."""
    from matplotlib.colors import ListedColormap

    (height, width), gap, head = kelvin[0].shape, 4, 16
    zoom = max(THUMBNAIL_PX // width, 1)
    height, width = height * zoom, width * zoom
    columns = min(_COLUMNS, len(kelvin))
    rows = -(-len(kelvin) // columns)
    mosaic = np.full((rows * (height + gap + head), columns * (width + gap) - gap), np.nan, np.float32)
    corner = [(k // columns * (height + gap + head) + head, k % columns * (width + gap)) for k in range(len(kelvin))]
    for (top, left), image in zip(corner, kelvin, strict=True):
        mosaic[top : top + height, left : left + width] = image.repeat(zoom, 0).repeat(zoom, 1)
    seen = np.concatenate([image[where] for image, where in zip(kelvin, surface, strict=True)])
    low, high = limits(seen if seen.size else np.stack(kelvin))
    colours = ListedColormap(np.asarray(palette("ironbow")) / 255.0, name="ironbow")
    figure = _figure(((max(mosaic.shape[1], 420) + 124) / _DPI, (mosaic.shape[0] + 34) / _DPI))
    across, down = figure.get_size_inches() * _DPI
    axes = figure.add_axes((10 / across, 4 / down, mosaic.shape[1] / across, mosaic.shape[0] / down))
    drawn = axes.imshow(mosaic, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    axes.set_axis_off()
    for (top, left), word in zip(corner, labels, strict=True):
        axes.text(left, top - 4, word, fontsize=8, va="bottom")
    bar = figure.add_axes((1.0 - 106 / across, 24 / down, 14 / across, (down - 64) / down))
    scale = figure.colorbar(drawn, cax=bar, extend="both")
    scale.set_label("apparent temperature [K]", fontsize=9)
    scale.formatter.set_useOffset(False)
    figure.text(10 / across, 1.0 - 18 / down, label(title), fontsize=10)
    return _pixels(figure)


def _bounds(renderer: "Renderer", seen: Prospect) -> Floats:
    """West, south, east, north of a map of track and footprints, and of the terrain if a frame misses it [m]."""
    place = np.concatenate([seen.position[:, :2], seen.outline.reshape(-1, 2)])
    if not seen.shows_terrain.all():
        scene = renderer.scene
        corner = [surface.vertices[:, :2] for surface in scene.near_ground]
        place = np.concatenate([place, *([each.min(axis=0), each.max(axis=0)] for each in corner)])
    place = place[np.isfinite(place).all(axis=1)]
    low, high = place.min(axis=0), place.max(axis=0)
    # At least 10 m, and not narrower than half its length.
    size = np.maximum(high - low, max(10.0, 0.5 * (high - low).max()))
    middle, half = 0.5 * (low + high), 0.54 * size
    return np.concatenate([middle - half, middle + half])


def _from_above(renderer: "Renderer", bounds: Floats) -> Picture:
    """The colours of the scene from straight above, (h, w, 3) sRGB, north on top; white where there is nothing."""
    import cv2

    size = bounds[2:] - bounds[:2]
    across, down = np.maximum(np.round(_RAYS * _MAP_PX * size / size.max()), 1).astype(int)
    east = bounds[0] + (np.arange(across) + 0.5) / across * size[0]
    north = bounds[3] - (np.arange(down) + 0.5) / down * size[1]
    surfaces = renderer.scene.surfaces
    top = max(float(surface.vertices[:, 2].max()) for surface in surfaces) + 1.0
    origin = np.stack(np.broadcast_arrays(east, north[:, None], top), axis=-1).reshape(-1, 3)
    _, texel = renderer.hits(origin, np.broadcast_to((0.0, 0.0, -1.0), origin.shape))
    colour, first = np.full((len(texel), 3), 255, np.uint8), 0
    for surface in surfaces:
        own = (texel >= first) & (texel < first + surface.material.size)
        colour[own] = surface.colour.reshape(-1, 3)[texel[own] - first]
        first += surface.material.size
    image = colour.reshape(down, across, 3)
    small = (max(across // _RAYS, 1), max(down // _RAYS, 1))
    return np.asarray(cv2.resize(image, small, interpolation=cv2.INTER_AREA), np.uint8)


def _word(axes: Any, place: Sequence[float] | Floats, word: str, colour: str, up: int = 5) -> None:
    """A word beside a point, readable on a picture."""
    from matplotlib.patheffects import withStroke

    at = float(place[0]), float(place[1])
    axes.annotate(label(word), at, (5, up), textcoords="offset points", fontsize=8, color=colour, zorder=6,
                  path_effects=[withStroke(linewidth=2.5, foreground="white")])  # fmt: skip


def _figure(size: tuple[float, float]) -> Any:
    """An empty figure of a size [inches]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=_DPI)
    FigureCanvasAgg(figure)
    return figure


def _pixels(figure: Any) -> Picture:
    figure.canvas.draw()
    return np.ascontiguousarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])


def jpeg(picture: Picture) -> bytes:
    """Return a picture as JPEG."""
    import cv2

    return bytes(cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])[1])
