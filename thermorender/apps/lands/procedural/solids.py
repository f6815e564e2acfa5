"""What stands on a canvas, as geometry: each object that is painted from above is also recorded here.

Painting goes on as without the record, since layouts look at it for free places. The record keeps what lies under each
object, so that the ground can be uncovered afterwards.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural import house_shapes
from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import Values
from thermorender.apps.lands.solids.plants import DENSITY, DENSITY_CONIFER, DENSITY_HEDGE, Plants
from thermorender.apps.lands.solids.quads import Quads

if TYPE_CHECKING:
    from thermorender.apps.lands.procedural.buildings import Window
    from thermorender.apps.lands.procedural.canvas import Canvas

# Fields of a canvas that an object hides.
_FIELDS = ("top", "albedo", "material", "wetness")
# Side of a texel of walls and roofs [m].
_TEXEL_M = 0.2
# Lower than this, a plant is a shrub, whose leaves reach the ground [m].
_SHRUB_M = 3.0
_BARK = (104, 88, 72)
# Least width of a roof of which the slope is read, relative to its length.
_FLAT = 1e-3


class Solids:
    """The solids of a canvas, whose ground is read when a solid is recorded."""

    def __init__(self, canvas: "Canvas") -> None:
        self.canvas = canvas
        self.quads, self.plants = Quads(_TEXEL_M), Plants()
        self.covered = np.zeros(canvas.shape, bool)  # Texels under a solid
        self._kept = {name: np.zeros_like(getattr(canvas, name)) for name in _FIELDS}
        self._draw = canvas.stream("solids")

    def hide(self, part: tuple[slice, slice], mask: NDArray[np.bool_]) -> None:
        """Keep what the canvas shows where a solid will cover `mask` of the window `part`."""
        new = mask & ~self.covered[part]
        for name, kept in self._kept.items():
            kept[part][new] = getattr(self.canvas, name)[part][new]
        self.covered[part] |= mask

    def uncover(self) -> None:
        """Show the ground under all solids on the canvas."""
        for name, kept in self._kept.items():
            getattr(self.canvas, name)[self.covered] = kept[self.covered]

    def _window(self, window: "Window", mask: NDArray[np.bool_]) -> float:
        """Keep the ground under a window's mask; return its median height [m]."""
        self.hide((window.rows, window.columns), mask)
        return float(np.median(window.view(self.canvas.ground)[mask]))

    def house(
        self, window: "Window", body: NDArray[np.bool_], u: float, v: float, half: tuple[float, float], wall_m: float,
        roof: tuple[str, tuple[int, int, int], bool], pitch_deg: float, hip: bool, chimney_u: float | None,
    ) -> None:  # fmt: skip
        """Record a house with the arguments of `buildings.house`."""
        at = house_shapes.Place(window.position, u, v, self._window(window, body))
        made = house_shapes.Look(self.canvas.value, self._draw, linear(*roof[1]), roof[0])
        house_shapes.house(self.quads, at, made, half, wall_m, pitch_deg if roof[2] else None, hip, chimney_u)

    def greenhouse(
        self, window: "Window", body: NDArray[np.bool_], u: float, v: float, half: tuple[float, float], spans: int
    ) -> None:
        """Record a greenhouse with the arguments of `buildings.greenhouse`."""
        at = house_shapes.Place(window.position, u, v, self._window(window, body))
        made = house_shapes.Look(self.canvas.value, self._draw, linear(150, 164, 150), "glass")
        house_shapes.greenhouse(self.quads, at, made, half, spans)

    def panels(
        self, window: "Window", field: NDArray[np.bool_], centre: tuple[float, float], half: tuple[float, float]
    ) -> None:
        """Record solar panels above the roof that the canvas shows; `centre` and `half` in the window's axes [m]."""
        if not field.any():
            return
        height = window.view(self.canvas.ground)[field] + window.view(self.canvas.top)[field]
        place = np.column_stack([window.u[field], window.v[field]]).astype(np.float64)
        middle, mean = place.mean(axis=0), float(height.mean())
        # Large texels in one line leave the panels level across it.
        slope = np.linalg.lstsq(place - middle, height.astype(np.float64) - mean, rcond=_FLAT)[0]
        slope = np.append(slope, mean - slope @ middle)
        self.hide((window.rows, window.columns), field)
        at = house_shapes.Place(window.position, *centre, 0.0)
        made = house_shapes.Look(self.canvas.value, self._draw, linear(38, 46, 68), "glass")
        house_shapes.panels(self.quads, at, made, half, slope)

    def box(
        self, window: "Window", mask: NDArray[np.bool_], u: float, v: float, half: tuple[float, float], height_m: float,
        colour: Values, material: str,
    ) -> None:  # fmt: skip
        """Record a box on the ground."""
        if not mask.any():
            return
        low, number = self._window(window, mask), self.canvas.value(material)
        tone = self._draw.normal(0.0, 0.05)
        self.quads.box(
            window.position, u, v, *half, low - 0.2, low + height_m, lambda s, t: (colour * np.exp(tone), number)
        )

    def hide_stand(self, window: "Window") -> None:
        """Record a raised hunting hide in the middle of a window, with its ladder behind the heading."""
        at = house_shapes.Place(window.position, 0.0, 0.0, self.canvas.height_at(*window.origin))
        made = house_shapes.Look(self.canvas.value, self._draw, linear(128, 108, 84), "wood")
        house_shapes.hide(self.quads, at, made)

    def hedge(self, window: "Window", mask: NDArray[np.bool_], height_m: Values, colour: Values) -> None:
        """Record a hedge; height [m] and linear colour are those of the (n,) texels of the mask."""
        if not mask.any():
            return
        self.hide((window.rows, window.columns), mask)
        c = self.canvas
        east, north = np.broadcast_arrays(c.east[:, window.columns], c.north[window.rows])
        low = window.view(c.ground)[mask] - 0.05
        column = np.column_stack([east[mask], north[mask], low, low + 0.05 + height_m]).astype(np.float64)
        self.plants.hedge(column, c.texel, DENSITY_HEDGE, colour, "broadleaf")

    def tree(
        self, crown: Values, tone: Values, east: float, north: float, height_m: float, colour: Values, material: int,
        beneath: float,
    ) -> None:  # fmt: skip
        """Record a tree or shrub with the arguments of `Canvas.stamp`."""
        c = self.canvas
        row, column = np.nonzero(crown > beneath)
        if not len(row):
            return
        x = (column - crown.shape[1] // 2) * c.texel
        y = (crown.shape[0] // 2 - row) * c.texel
        radius = float(np.sqrt(len(row) / np.pi)) * c.texel
        top = crown[row, column].astype(np.float64) * height_m
        conifer, shrub = c.names[material] == "conifer", height_m < _SHRUB_M
        # Broad crowns are rounded below; those of conifers begin at one height.
        first = 0.05 if shrub else 0.7 * beneath if conifer else 0.28
        bend = 0.0 if shrub or conifer else 0.22
        low = height_m * (first + bend * (x**2 + y**2) / radius**2)
        ground = c.height_at(east, north)
        columns = np.column_stack([east + x, north + y, ground + np.minimum(low, top), ground + top])
        shade = tone[row, column][:, None] * np.asarray(colour, np.float64)
        self.plants.crown(columns, c.texel, DENSITY_CONIFER if conifer else DENSITY, shade, c.names[material])
        radius_m = 0.05 + 0.016 * height_m
        if not shrub and 2.0 * radius_m > c.texel:
            high = ground + (0.75 if conifer else 0.55) * height_m
            bark = linear(*_BARK) * np.exp(self._draw.normal(0.0, 0.15))
            self.plants.trunk(east, north, ground - 0.3, high, radius_m, bark, c.value("bark"))
