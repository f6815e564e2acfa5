"""Areas of the terrain whose material an edit names: polygons of a map or of the local frame, or numbers of texels."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender import formats
from thermorender.errors import ThermorenderError, shortened
from thermorender.materials.material import Material
from thermorender.scene.georeference import Place
from thermorender.scene.ground import Ground
from thermorender.scene.raster import Grid
from thermorender.scene.surface import Surface

_POLYGONS = ("Polygon", "MultiPolygon")
# Farther corners are on no map: the Earth is 4e10 mm round.
_FARTHEST_PX = 1e12


@dataclass(frozen=True, eq=False)
class Patch:
    """Texels of a terrain's surfaces, by their ascending numbers over all of them (n,), and their new material."""

    texels: NDArray[np.int64]
    material: Material


def numbered(given: Any, surfaces: Sequence[Surface], where: str) -> NDArray[np.int64]:
    """Return numbers of texels over some surfaces, ascending and once each; refuse others than these have."""
    try:
        found = np.asarray(given).ravel()
    except ValueError:
        found = np.zeros(1)
    count = sum(surface.flags.size for surface in surfaces)
    if not found.size or found.dtype.kind not in "iu" or found.min() < 0 or found.max() >= count:
        raise ThermorenderError(
            f"{where}: texels={shortened(repr(given))} is not allowed; give one or more whole numbers 0…{count - 1} of "
            "the terrain's texels, as Renderer.texels returns, and name objects in with_material"
        )
    return np.unique(found).astype(np.int64)


def name_of(given: str | PathLike[str] | Mapping[str, Any]) -> str:
    """Return what messages call a GeoJSON FeatureCollection: its file, or its "name" member."""
    return str(given.get("name", "GeoJSON") if isinstance(given, Mapping) else given)


def read_features(given: str | PathLike[str] | Mapping[str, Any]) -> tuple[list[Any], Any]:
    """Return (features, rasterio CRS) of a GeoJSON FeatureCollection, a path or its contents; WGS 84 without "crs"."""
    import rasterio
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        content: Any = given
        if not isinstance(given, Mapping):
            content = formats.finite_json(Path(given).read_text(encoding="utf-8-sig"))
        features = content["features"]
        if not isinstance(features, list):
            raise ValueError(f"features is {shortened(repr(features))}, not a list")
        # Within an Env, GDAL prints no error of its own.
        with rasterio.Env():
            crs = CRS.from_user_input(content["crs"]["properties"]["name"] if content.get("crs") else "OGC:CRS84")
        return features, crs
    except OSError as error:
        raise ThermorenderError(f"{given} cannot be read: {error.strerror}; give a GeoJSON file") from None
    except (ValueError, KeyError, TypeError, CRSError) as error:
        raise ThermorenderError(
            f"{name_of(given)} is not a GeoJSON FeatureCollection ({type(error).__name__}: {error}); export one from a "
            "GIS"
        ) from None


def areas(given: Any, place: Place, ground: Ground) -> list[tuple[Any, str | None]]:
    """Return [(GeoJSON geometry in the CRS of the place, property "material" or None)] of an area.

    `given` is GeoJSON of polygons, a file or its contents, or corners (N, 2) of one polygon: local east and north [m].
    """
    if not isinstance(given, (str, PathLike, Mapping)):
        return [(_of_corners(given, place, ground), None)]
    from rasterio.warp import transform_geom

    features, crs = read_features(given)
    found = []
    for number, feature in enumerate(features, 1):
        try:
            geometry, about = feature["geometry"], feature.get("properties") or {}
            if geometry is None:
                continue
            if geometry["type"] not in _POLYGONS:
                raise ValueError
            name = about.get("material") if isinstance(about, Mapping) else None
            corners = np.array(list(_corners(geometry["coordinates"])), np.float64).reshape(-1, 2)
            if crs.is_geographic and (np.abs(corners) > (360.0, 90.0)).any():
                raise _not_of(f"{name_of(given)}, feature {number}", crs)
            found.append((transform_geom(crs, place.crs, geometry), name))
        except ThermorenderError:
            raise
        except Exception:  # GDAL has many exception types for malformed features
            raise ThermorenderError(
                f"{name_of(given)}, feature {number} is not a polygon; export polygons from a GIS"
            ) from None
    if not found:
        raise ThermorenderError(f"{name_of(given)} has no feature; draw at least one polygon")
    return found


def pixels_of(corners: Any, crs: Any, grid: Grid, where: str) -> NDArray[np.float64]:
    """Return corners in a CRS as (column, row) of a grid, (N, 2)."""
    from rasterio.warp import transform

    try:
        x, y = np.array([corner[:2] for corner in corners], np.float64).T
        if crs.is_geographic and not ((np.abs(x) <= 360.0) & (np.abs(y) <= 90.0)).all():
            raise ValueError
        found = np.column_stack(grid.to_pixel(*map(np.array, transform(crs, grid.crs, x, y))))
        if not (np.abs(found) < _FARTHEST_PX).all():
            raise ValueError
    except Exception:  # GDAL's errors share no public base class
        raise _not_of(where, crs) from None
    return found


def _not_of(where: str, crs: Any) -> ThermorenderError:
    return ThermorenderError(
        f"{where} has corners that are not coordinates of {crs.to_string()}; give GeoJSON in longitude and latitude, "
        "or name its CRS in a 'crs' member"
    )


def _corners(coordinates: Any) -> Iterator[Any]:
    """The corners (x, y) in nested lists of coordinates."""
    if coordinates and not isinstance(coordinates[0], list):
        yield coordinates[:2]
    else:
        for each in coordinates:
            yield from _corners(each)


def part_of(grid: Grid, low: ArrayLike, high: ArrayLike) -> tuple[slice, slice]:
    """Return the rows and columns of a grid within (column, row) limits; they are empty outside of it."""
    size = (grid.width, grid.height)
    left, top = np.clip(np.floor(low), 0, size).astype(int)
    right, bottom = np.clip(np.ceil(high), 0, size).astype(int)
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def texels_of(geometry: Any, crs: Any, grid: Grid, where: str) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
    """Return (part of a grid, its texels (h, w) bool with centre in a polygon).

    Polygons and holes without corners are skipped.
    """
    try:
        polygons = [geometry["coordinates"]] if geometry["type"] == "Polygon" else list(geometry["coordinates"])
        filled = [polygon for polygon in polygons if len(polygon) and len(polygon[0])]
        rings = [[pixels_of(ring, crs, grid, where) for ring in polygon if len(ring)] for polygon in filled]
        outer = np.concatenate([polygon[0] for polygon in rings])
    except ThermorenderError:
        raise
    except (KeyError, IndexError, TypeError, ValueError):
        raise ThermorenderError(f"{where} is not a polygon with corners; export polygons from a GIS") from None
    part = part_of(grid, outer.min(axis=0), outer.max(axis=0))
    return part, burnt(rings, part)


def burnt(polygons: Sequence[Any], part: tuple[slice, slice]) -> NDArray[np.bool_]:
    """Return the texels (h, w) bool of a part of a grid whose centre is in a polygon.

    A polygon is a ring (N, 2) in (column, row) of the grid, or rings of which the later ones are holes.
    """
    from rasterio import Affine
    from rasterio.features import rasterize

    rows, columns = (each.stop - each.start for each in part)
    if not min(rows, columns) > 0:
        return np.zeros((0, 0), bool)
    shapes = [
        {"type": "Polygon", "coordinates": [ring.tolist() for ring in ([one] if isinstance(one, np.ndarray) else one)]}
        for one in polygons
    ]
    corner = Affine.translation(part[1].start, part[0].start)
    return np.asarray(rasterize(shapes, out_shape=(rows, columns), transform=corner, dtype="uint8") > 0)


def texels_in(geometry: Any, grid: Grid, name: str) -> NDArray[np.bool_]:
    """Return which texels have their middle in a geometry in the grid's CRS, (h, w); refuse one that has none."""
    burnt = np.zeros((grid.height, grid.width), bool)
    part, inside = texels_of(geometry, grid.crs, grid, name)
    if inside.any():
        burnt[part] = inside
    else:
        raise ThermorenderError(
            f"{name} covers no texel of {grid.name}; draw it on the terrain, not smaller than a texel, and in GeoJSON "
            "as longitude and latitude unless a 'crs' member names another CRS"
        )
    return burnt


def _of_corners(given: Any, place: Place, ground: Ground) -> dict[str, Any]:
    try:
        corners = np.array(given, np.float64)
    except (TypeError, ValueError):
        corners = np.empty(0)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise ThermorenderError(
            f"with_material_in: area={shortened(repr(given))} is not a polygon; give three or more (east, north) in "
            "local metres, or the path of a GeoJSON file"
        )
    up = np.nan_to_num(ground(*corners.T))
    x, y = place.to_map(np.column_stack([corners, up]))
    ring = np.column_stack([x, y]).tolist()
    return {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
