"""Terrain from an elevation raster: a mesh in the scene's local frame, mapped by the orthophoto's pixel grid."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.georeference import definition
from thermorender.scene.raster import Grid, RasterWindow, grid_of, lon_lat, opened, read_band

# Metres in a unit of height, by the names in use; a raster of a map in metres is in metres if it names no unit.
METRES = (
    dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0)
    | dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet"), 0.3048)
    | dict.fromkeys(("us-ft", "ftus", "us survey foot", "us survey feet", "foot_us", "us_survey_foot"), 1200.0 / 3937.0)
)
# Placeholders for missing heights in files that declare none.
_PLACEHOLDERS = (-9999.0, -32767.0, -32768.0, 32767.0, 65535.0)
# Posts of 0 m this far below all others may be missing [m].
_DOUBTFUL_M = 20.0


def read_elevation(
    path: Path, part: RasterWindow | None = None, undeclared: Any = None
) -> tuple[NDArray[np.float64], Grid]:  # fmt: skip
    """Return (heights (h, w) float64 [m] with NaN where missing, Grid) of an elevation raster, or its window;
    `undeclared` is the CRS of a raster that declares none."""
    grid = part.grid if part else grid_of(path, undeclared=undeclared)
    left, bottom, right, top = grid.bounds
    lon_lat(grid, np.array([left, right]), np.array([bottom, top]))
    height = heights_in(path, part, grid.crs)
    if min(height.shape) < 2:
        raise ThermorenderError(f"{path} has {height.shape[0]}×{height.shape[1]} posts; terrain needs at least 2×2")
    if not np.isfinite(height).any():
        raise ThermorenderError(
            f"{path} has no valid height in it (all nodata, NaN or beyond ±9000 m); give another DEM"
        )
    return height, grid


def heights_in(path: Path, part: RasterWindow | None = None, undeclared: Any = None) -> NDArray[np.float64]:
    """Return the heights of an elevation raster, or of its window, (h, w) [m]; NaN where missing. `undeclared` is the
    CRS of one that declares none."""
    height = _metres(path, undeclared) * read_band(path, _PLACEHOLDERS, part)
    # ±3.4e38 and others.
    height[~(np.abs(height) < 9000.0)] = np.nan
    return height


def doubtful_zeros(path: Path, height: NDArray[np.floating]) -> tuple[str, ...]:
    """Return a sentence on heights of exactly 0 far below all others in a raster without a no-data value.

    Such zeros are gaps in some files and sea level in others.
    """
    with opened(path, any_size=True) as dataset:
        declared = dataset.nodata is not None
    zero = height == 0.0
    others = height[np.isfinite(height) & ~zero]
    if declared or not zero.any() or not others.size or float(others.min()) < _DOUBTFUL_M:
        return ()
    return (
        f"{Path(path).name} has {int(zero.sum())} posts of exactly 0 m, and all others are {float(others.min()):.0f} m "
        "or higher: if they are missing, declare it with `rio edit-info --nodata 0 FILE`",
    )


def _metres(path: Path, undeclared: Any) -> float:
    """Metres in the unit of a raster's heights, by its band and its vertical CRS."""
    with opened(path, any_size=True) as dataset:
        unit = (dataset.units[0] if dataset.count else None) or ""
        declare = "declare the right unit with `rio edit-info --bidx 1 --units m FILE` (or ft, or us-ft)"
        return metres_of_heights(path, dataset.crs or undeclared, unit, declare)


def metres_of_heights(path: Path, crs: Any, unit: str, declare: str) -> float:
    """Return the metres in the unit of a file's heights, from the CRS or the file's own `unit` ("" if undeclared).

    `declare` says in messages how to declare it.
    """
    map_unit = crs.linear_units if crs.is_projected else "metre"
    crs = definition(crs)
    factor = METRES.get(unit.strip().lower()) if unit else None
    if unit and factor is None:
        raise ThermorenderError(f"{path} holds heights in {unit!r}; give metres or feet, or {declare}")
    crs = crs.get("source_crs", crs)
    axes = [axis for part in crs.get("components", [crs]) for axis in part.get("coordinate_system", {}).get("axis", [])]
    if any(axis["direction"] == "down" for axis in axes):
        raise ThermorenderError(f"{path} holds depths by its vertical CRS; give heights, which count upward")
    for axis in (axis for axis in axes if axis["direction"] == "up"):
        stated = axis["unit"]
        of_crs = float(stated["conversion_factor"]) if isinstance(stated, dict) else 1.0
        if factor is not None and abs(factor / of_crs - 1.0) > 1e-9:
            raise ThermorenderError(
                f"{path} contradicts itself: its heights are in {unit!r} by the band, and in units of {of_crs:.7g} m "
                f"by the vertical CRS; {declare}, or another CRS"
            )
        return of_crs
    if factor is None and METRES.get(map_unit.lower(), 1.0) != 1.0:
        raise ThermorenderError(
            f"{path} does not declare the unit of its heights, and its map is in {map_unit}; {declare}"
        )
    return 1.0 if factor is None else factor


def zero_of_heights(crs: Any) -> str | None:
    """Return the height reference of a CRS: a vertical datum with a code, "the ellipsoid", or None if unstated."""
    found = definition(crs)
    found = found.get("source_crs", found)
    for part in found.get("components", [found]):
        if any(axis["direction"] == "up" for axis in part.get("coordinate_system", {}).get("axis", [])):
            datum = part.get("datum") or part.get("datum_ensemble") or part
            if part["type"] != "VerticalCRS":
                return "the ellipsoid"
            return str(datum["name"]) if "id" in part or "id" in datum else None
    return None


def filled(height: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return (heights (h, w) with enclosed gaps filled, posts of the new cells (h, w) bool); gaps at the edge stay.

    Filled heights are linear on the Delaunay triangles of the posts around the gaps.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.ndimage import binary_dilation, label

    missing, near = ~np.isfinite(height), np.ones((3, 3))
    areas, _ = label(missing, near)
    edge = np.concatenate([areas[0], areas[-1], areas[:, 0], areas[:, -1]])
    island = missing & ~np.isin(areas, edge)
    if not island.any():
        return height, island
    made = binary_dilation(island, near)
    rim, height = made & ~missing, height.copy()
    height[island] = LinearNDInterpolator(np.argwhere(rim), height[rim])(np.argwhere(island))
    return height, made


def frame_of(height: NDArray[np.float64], grid: Grid) -> LocalFrame:
    """Return the LocalFrame at the centre of an elevation raster, at its median height rounded to metres."""
    x, y = grid.to_map(grid.width / 2, grid.height / 2)
    longitude, latitude = lon_lat(grid, np.array([x]), np.array([y]))
    return LocalFrame(float(latitude[0]), float(longitude[0]), float(np.round(np.nanmedian(height))))


def mesh(
    height: NDArray[np.float64], grid: Grid, frame: LocalFrame, texels: Grid
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float32]]:
    """Return (vertices (V, 3) [m], faces (F, 3), uv (F, 3, 2)) of ellipsoid heights (h, w) [m], NaN where missing.

    Posts are pixel centres of `grid`; uv refer to the grid `texels` in the same CRS. Cells with a missing post are left
    out, the others split from the upper left to the lower right post.
    """
    known = np.isfinite(height)
    whole = whole_cells(known)
    if not whole.any():
        raise ThermorenderError(f"{grid.name} has no cell with four valid posts; give a denser DEM")
    rows, columns = height.shape
    column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    x, y = grid.to_map(column, row)
    longitude, latitude = lon_lat(grid, x.ravel(), y.ravel())
    # No face uses posts without height, but their positions must be finite.
    level = np.where(known, height, height[known].min())
    vertices = frame.enu_from_geodetic(latitude, longitude, level.ravel())

    texel_column, texel_row = texels.to_pixel(x, y)
    uv = np.stack([texel_column / texels.width, texel_row / texels.height], axis=-1).reshape(-1, 2)

    # Counter-clockwise seen from above for a north-up raster.
    faces = triangles(whole)
    if grid.transform.determinant > 0.0:
        faces = faces[:, ::-1]
    return vertices, np.ascontiguousarray(faces), uv[faces].astype(np.float32)


def whole_cells(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells whose four posts are known, (h - 1, w - 1), of posts (h, w)."""
    found: NDArray[np.bool_] = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    return found


def triangles(cells: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return the two triangles of each of some cells (h - 1, w - 1), row by row, (2 n, 3) numbers of posts."""
    row, column = np.nonzero(cells)
    across = cells.shape[1] + 1
    a = (row * across + column).astype(np.int32)
    b, c, d = a + 1, a + across, a + across + 1
    return np.stack([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)], axis=1).reshape(-1, 3)


def texel_size_m(texels: Grid, frame: LocalFrame) -> float:
    """Return the side of a texel at the middle of its grid [m] (root of its area)."""
    column, row = texels.width / 2 + np.array([0.0, 1.0, 0.0]), texels.height / 2 + np.array([0.0, 0.0, 1.0])
    longitude, latitude = lon_lat(texels, *texels.to_map(column, row))
    corner, right, down = frame.enu_from_geodetic(latitude, longitude, frame.height_m)
    return float(np.sqrt(np.linalg.norm(np.cross(right - corner, down - corner))))
