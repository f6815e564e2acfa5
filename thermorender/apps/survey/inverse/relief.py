"""The ground between points of known height: posts on a grid, bilinear between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.survey.inverse.matches import Ground
from thermorender.errors import ThermorenderError

Floats = NDArray[np.float64]
# Posts with a smaller share of a node's weight take those of a wider circle; width of the first circle [posts].
_NEAR, _WIDTH = 1e-3, 0.7


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights on posts, bilinear between them and constant beyond; callable as a ground."""

    west: float  # East of the first post [m]
    south: float  # North of the first post [m]
    step_m: float
    up: Floats  # (rows northwards, columns eastwards) float64 [m]

    @classmethod
    def of(cls, nodes: Floats, heights: Floats, std: Floats, ground: "Relief") -> "Relief":
        """Return a ground that is raised by the weighted means of heights at nodes around each post.

        `nodes` (K, 2) are east and north on a grid [m], `heights` (K,) above the ground with standard deviations (K,);
        unknown heights are NaN.
        """
        from scipy.ndimage import gaussian_filter

        known = np.isfinite(heights)
        if any(len(np.unique(nodes[known, axis])) < 2 for axis in (0, 1)):
            raise ThermorenderError("the points of the ground that two frames show lie on one line")
        step_m = float(np.median(np.diff(np.unique(nodes[:, 0]))))
        nodes, heights, std = (each[known] for each in (nodes, heights, std))
        low, high = nodes.min(axis=0), nodes.max(axis=0)
        shape = tuple(np.ceil((high - low) / step_m).astype(int) + 1)[::-1]
        column, row = np.rint((nodes - low) / step_m).astype(int).T
        weight, total = np.zeros(shape), np.zeros(shape)
        np.add.at(weight, (row, column), 1.0 / std**2)
        np.add.at(total, (row, column), heights / std**2)
        mean, width = np.zeros(shape), _WIDTH
        filled = np.zeros(shape, bool)
        # Around each post as near as there are nodes.
        while not filled.all():
            near, sums = gaussian_filter(weight, width), gaussian_filter(total, width)
            new = ~filled & (near > _NEAR * weight[weight > 0.0].min())
            mean[new] = sums[new] / near[new]
            filled |= new
            width *= 2.0
        east, north = np.meshgrid(low[0] + step_m * np.arange(shape[1]), low[1] + step_m * np.arange(shape[0]))
        base = ground(east.ravel(), north.ravel()).reshape(shape)
        return cls(float(low[0]), float(low[1]), step_m, base + mean)

    @classmethod
    def sampled(cls, ground: Ground, low: Floats, high: Floats, step_m: float) -> "Relief":
        """Return a ground on posts from `low` to `high` (2,), east and north [m], which is quicker to ask."""
        columns, rows = np.ceil((high - low) / step_m).astype(int) + 1
        east, north = np.meshgrid(low[0] + step_m * np.arange(columns), low[1] + step_m * np.arange(rows))
        up = np.asarray(ground(east.ravel(), north.ravel()), np.float64)
        return cls(float(low[0]), float(low[1]), step_m, up.reshape(rows, columns))

    def __call__(self, east: Floats, north: Floats) -> Floats:
        """Return the heights (N,) at east and north (N,)."""
        from scipy.ndimage import map_coordinates

        place = np.stack([(north - self.south) / self.step_m, (east - self.west) / self.step_m])
        inside = np.isfinite(place).all(axis=0)
        found = map_coordinates(self.up, np.where(inside, place, 0.0), order=1, mode="nearest")
        return np.where(inside, found, np.nan)
