"""A frame on the map: apparent temperatures at the positions that the pixels show, as an image of the ground."""

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.frame.picture import html, show, span
from thermorender.frame.tiff import write_kelvin
from thermorender.scene.raster import Grid
from thermorender.scene.surface import MOST_TEXELS

if TYPE_CHECKING:
    import xarray as xr

    from thermorender.scene.georeference import Place

# A little more than half the diagonal of a pixel's footprint, since footprints are oblique.
_REACH = 1.1


@dataclass(frozen=True, eq=False)
class Orthoimage:
    """Apparent temperatures on a map.

    Attributes
    ----------
    kelvin : (h, w) float32
        North up [K]; NaN where the frame shows no surface.
    grid : Grid
        Coordinate reference system, affine transform and size.
    """

    kelvin: NDArray[np.float32]
    grid: Grid

    def __repr__(self) -> str:
        left, bottom, right, top = self.grid.bounds
        known = np.isfinite(self.kelvin)
        return (
            f"Orthoimage({self.grid.width}×{self.grid.height}, {span(self.kelvin)}, {known.mean():.0%} known, "
            f"x {left:.9g}…{right:.9g}, y {bottom:.9g}…{top:.9g} in {self.grid.crs.to_string()[:40]})"
        )

    def _repr_html_(self) -> str:
        return html(self.kelvin, repr(self))

    def show(self) -> None:
        """Draw the temperatures with a colour bar [K], in a notebook, a window or the terminal."""
        show(self, self.kelvin)

    def save(self, path: str | PathLike[str]) -> None:
        """Write a GeoTIFF of float32 kelvin, NaN for no data.

        Raises
        ------
        ThermorenderError
            The name does not end in .tif or .tiff, or the file cannot be written.
        """
        if Path(path).suffix.lower() not in (".tif", ".tiff"):
            raise ThermorenderError(f"{path} is not the name of a GeoTIFF; end it in .tif")
        write_kelvin(path, self.kelvin, self.grid.crs, self.grid.transform)

    def to_xarray(self) -> "xr.DataArray":
        """Return an xarray.DataArray with coordinates x, y of the pixels' middles in map units, and the CRS."""
        from thermorender.frame.labelled import of_orthoimage

        return of_orthoimage(self)


def orthorectified(
    radiance: NDArray[np.float32], position: NDArray[np.float32], place: "Place | None", metres: float,
    kelvin_of: Callable[[ArrayLike], NDArray[np.float32]],
) -> Orthoimage:  # fmt: skip
    """Return the Orthoimage of a frame, as `Frame.orthorectified`.

    Parameters
    ----------
    radiance : (H, W) float32
        Band radiance [W m⁻² sr⁻¹].
    position : (H, W, 3) float32
        What the pixels show, in the local frame [m]; NaN where that is no surface.
    place : Place or None
    metres : float
        Size of a map pixel [m].
    kelvin_of : callable
        The apparent temperature [K] of radiances.
    """
    from rasterio import Affine

    if not (np.isfinite(metres) and metres > 0.0):
        raise ThermorenderError(f"orthorectified: metres={metres!r} is not allowed; give the size of a pixel, above 0")
    if place is None:
        raise ThermorenderError(
            "orthorectified needs a place on Earth, which the frame's scene does not have; add [frame] with "
            "latitude_deg, longitude_deg and height_m to its scene.toml"
        )
    point = position.astype(np.float64)
    seen = np.asarray(np.isfinite(point).all(axis=-1))
    if not seen.any():
        raise ThermorenderError("orthorectified: this frame shows no surface; look at the terrain")
    column, row = _in_pixels(place, point, seen, size := place.pixel_size(metres))
    # Whole multiples of the pixel's size, so that maps of several frames have their pixels in common.
    left, top = np.floor(np.nanmin(column)), np.floor(np.nanmin(row))
    width, height = (int(np.floor(np.nanmax(of) - start)) + 1 for of, start in ((column, left), (row, top)))
    if width * height > MOST_TEXELS:
        raise ThermorenderError(
            f"orthorectified: metres={metres:g} makes {width}×{height} pixels of what this frame sees; up to "
            f"{MOST_TEXELS} are allowed: give larger pixels, or look down"
        )
    grid = Grid(place.crs, Affine(size[0], 0.0, left * size[0], 0.0, -size[1], -top * size[1]), height, width)
    mean = _gridded(column - left, row - top, point[..., 2], radiance, (height, width), metres)
    known = np.isfinite(mean)
    kelvin = np.full(mean.shape, np.nan, np.float32)
    kelvin[known] = kelvin_of(mean[known])
    return Orthoimage(kelvin, grid)


def _in_pixels(
    place: "Place", position: NDArray[np.float64], seen: NDArray[np.bool_], size: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(column, row) on a map with its origin at x = y = 0, each (H, W); NaN where nothing is seen."""
    column, row = np.full((2, *seen.shape), np.nan)
    x, y = place.to_map(position[seen])
    column[seen], row[seen] = x / size[0], -y / size[1]
    return column, row


def _gridded(
    column: NDArray[np.float64], row: NDArray[np.float64], up: NDArray[np.float64], values: NDArray[np.float32],
    shape: tuple[int, int], metres: float,
) -> NDArray[np.float64]:  # fmt: skip
    """Return values of the frame's pixels, (H, W), on the map's pixels, (h, w); NaN where there are none.

    A map pixel is the mean of the frame's pixels in it. Of pixels above each other, as on a wall, those below the
    highest by more than the size of a map pixel are left out. A map pixel without any takes the nearest pixel of the
    frame whose footprint reaches it.
    """
    from scipy.spatial import cKDTree

    seen = np.isfinite(column)
    across, along = column[seen], row[seen]
    cell = np.floor(along).astype(np.int64) * shape[1] + np.floor(across).astype(np.int64)
    highest = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(highest, cell, up[seen])
    top = up[seen] >= highest[cell] - metres
    count = np.bincount(cell[top], minlength=highest.size)
    total = np.bincount(cell[top], values[seen][top], minlength=highest.size)
    with np.errstate(invalid="ignore"):
        found = total / np.where(count, count, np.nan)
    empty = np.flatnonzero(count == 0)
    reach = _footprint(column, row)[seen]
    tree = cKDTree(np.column_stack([across, along]))
    middle = np.column_stack([empty % shape[1], empty // shape[1]]) + 0.5
    distance, nearest = tree.query(middle, distance_upper_bound=float(reach.max()) + 1e-9)
    near = np.isfinite(distance)
    near[near] = distance[near] <= reach[nearest[near]]
    found[empty[near]] = values[seen][nearest[near]]
    return found.reshape(shape)


def _footprint(column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half the diagonal of each pixel on the map, (H, W) [map pixels].

    A side is the distance to the nearer of two neighbours, since the other may be behind an edge.
    """
    square = np.zeros(column.shape)
    for axis in (0, 1):
        step = np.hypot(np.diff(column, axis=axis), np.diff(row, axis=axis))
        end = np.full_like(np.take(step, [0], axis=axis), np.nan)
        both = np.concatenate([end, step], axis=axis), np.concatenate([step, end], axis=axis)
        square += np.nan_to_num(np.fmin(*both)) ** 2
    return 0.5 * _REACH * np.sqrt(square)
