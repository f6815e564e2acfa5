"""Coarser ground around an imported scene: heights of a wider area, thinned, with an orthophoto where there is one."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.import_rasters import (
    Picture,
    has_vertical_datum,
    heights_on_map,
    read_heights,
    read_picture,
    write_raster,
)
from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.scene.raster import Grid, onto, step_m
from thermorender.scene.terrain import doubtful_zeros

# Posts of a far ground, and texels along a side of its picture, at most.
_MOST_POSTS, _MOST_TEXELS = 250_000, 2048
# Half side of a far ground: its corners are as far away as positions may be [m].
_REACH_M = 0.7 * FARTHEST_M
# Heights of two surveys differ by less than this in the median where they have the same zero: a geoid is up to 100 m
# from the ellipsoid, and a surface model of 30 m posts a few metres above bare ground [m].
_SAME_ZERO_M = 8.0


class FarGround(NamedTuple):
    """One far ground as it is written."""

    height: NDArray[Any]  # (h, w) [m]
    posts: Grid
    picture: Picture | None
    reference: str | None  # of its heights, where they state another one than the scene's

    def write(self, folder: Path, number: int) -> dict[str, Any]:
        """Write the rasters of the ground of a number to the scene's folder, and return its table of [terrain]."""
        elevation, orthophoto = f"far_{number}_elevation.tif", f"far_{number}_orthophoto.tif"
        write_raster(folder / elevation, self.height[None].astype(np.float32), self.posts, nodata=np.nan, predictor=3)
        if self.picture:
            rgb, valid, grid = self.picture
            write_raster(folder / orthophoto, np.moveaxis(rgb, -1, 0), grid, predictor=2, photometric="RGB", mask=valid)
        return {
            "elevation": elevation,
            "orthophoto": orthophoto if self.picture else None,
            "height_reference": self.reference,
        }


def read_far(
    given: Sequence[str], height: NDArray[Any], posts: Grid, reference: str, settings: ImportSettings
) -> tuple[list[FarGround], tuple[str, ...]]:
    """Return (far grounds from the inner to the outer one, sentences on doubtful ones).

    Each is DEM.tif or DEM.tif,ORTHO.tif. `height` (h, w) [m] on `posts` is the ground of the scene, whose heights are
    above `reference`.
    """
    found, notes = list[FarGround](), list[str]()
    middle = np.array(posts.bounds).reshape(2, 2).mean(axis=0)
    left, bottom, right, top = np.concatenate([middle - _REACH_M, middle + _REACH_M]).tolist()
    for text in given:
        elevation, _, orthophoto = text.partition(",")
        own, grid, bounds = read_heights(Path(elevation), posts.crs, (left, bottom, right, top), _MOST_POSTS)
        notes += doubtful_zeros(Path(elevation), own)
        picture = None
        if orthophoto:
            plain = replace(settings, bands=None, colour_range=None, collar=0, max_texels=_MOST_TEXELS)
            picture, bounds = read_picture(
                Path(orthophoto), plain, Path(elevation), posts.crs, bounds, whole=False
            )  # fmt: skip
        inner = found[-1].posts if found else posts
        across, along = bounds[2] - bounds[0], bounds[3] - bounds[1]
        most = min(_MOST_POSTS, max(4, int(across * along / step_m(posts.crs, inner) ** 2)))
        own, grid_own = heights_on_map(own, grid, posts.crs, bounds, most, square=False)
        if not np.isfinite(own).any():
            raise ThermorenderError(f"{elevation} has no valid height around the scene; give another DEM")
        other = has_vertical_datum(grid.crs) and reference != "geoid"
        stated = "geoid" if other and settings.geoid_undulation_m is not None else None
        if other and stated is None:
            notes.append(f"{Path(elevation).name} counts heights from a vertical datum, and is taken to count from the "
                         "same zero as the scene; --geoid-undulation-m states the difference")  # fmt: skip
        notes += _other_zero(elevation, height, posts, own, grid_own)
        found.append(FarGround(own, grid_own, picture, stated))
    return found, tuple(notes)


def _other_zero(
    name: str, height: NDArray[Any], posts: Grid, far: NDArray[Any], far_posts: Grid
) -> list[str]:  # fmt: skip
    """A sentence on heights that differ from those of the scene as if they had another zero."""
    there = onto(np.asarray(far, np.float64), far_posts, posts, "bilinear")
    both = np.isfinite(there) & np.isfinite(height)
    if not both.any():
        return []
    off_m = float(np.median(there[both] - height[both]))
    if abs(off_m) < _SAME_ZERO_M:
        return []
    side = "above" if off_m > 0.0 else "below"
    return [
        f"{Path(name).name} lies {abs(off_m):.0f} m {side} the ground of the scene in the median, so one may be above "
        "the ellipsoid and one above the geoid; state height_reference in [[terrain.far]] and geoid_undulation_m in "
        "[terrain]"
    ]
