"""What an import finds: pools, which become water, buildings, and patches that no material explains."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import defaults
from thermorender.apps.lands.pools import pools, stands_high
from thermorender.apps.lands.solids.detection import Outline, inside
from thermorender.formats import finite_json, write_json
from thermorender.learned.emissivity.elevation import above_ground
from thermorender.learned.emissivity.mapping import COARSEST_RATIO, load_map, map_materials
from thermorender.scene.mapped_cover import MappedCover
from thermorender.scene.patch import read_features
from thermorender.scene.raster import Grid, lon_lat, onto
from thermorender.scene.spec import DEFAULT_CONFIDENCE
from thermorender.scene.surface import fill, nearest_valid

# Least area of a patch that is named [m²], and the most patches.
_LEAST_M2, _MOST = 25.0, 5
# A patch is uniform if this share of its texels is within so many levels of its median colour.
_UNIFORM, _LEVELS = 0.75, 48.0
# Edges have a larger standard deviation of some band than this within this width [m].
_CALM, _GAP_M = 30.0, 1.0
# A patch covers at least these shares of its outline and of its convex hull.
_WHOLE, _COMPACT = 0.85, 0.6
# Hues that water may have [deg].
_WATERY_DEG = (150.0, 235.0)


@dataclass(frozen=True, eq=False)
class Photograph:
    """An orthophoto on a map, and the surface model below it."""

    rgb: NDArray[np.uint8]  # (h, w, 3) sRGB
    valid: NDArray[np.bool_]  # (h, w)
    grid: Grid  # Its texels
    texel_m: float
    height: NDArray[np.floating]  # (rows, columns) [m]
    posts: Grid
    post_m: float

    def above_m(self) -> NDArray[np.floating]:
        """Height of the surface above the ground at each texel, (h, w) [m]; NaN where it is unknown."""
        above = above_ground(np.asarray(self.height, np.float64), self.post_m)[0]
        found: NDArray[np.floating] = onto(above, self.posts, self.grid, "bilinear")
        return found


def with_found(
    known: Path | None, cover: MappedCover | None, picture: Photograph, buildings: Sequence[Outline] = ()
) -> tuple[dict[str, Any] | None, NDArray[np.bool_], tuple[str, ...]]:
    """Return (GeoJSON of a file's shapes and of what is found beside them, None if that is nothing; the texels that
    are water, roofs or one material by these, (h, w) bool; sentences). `cover` is what the file states.

    Found are pools, unless the file states water or a material there, and `buildings` by their height: roofs are of
    roof materials, whatever grows around them.
    """
    from rasterio.warp import transform_geom

    empty = np.zeros(picture.valid.shape, bool)
    # A shape of land, such as grass, states what is around a pool or a patch, not what it is.
    as_water, roof = (empty, empty) if cover is None else (cover.states("water"), cover.states("roof"))
    stated = as_water | roof
    number = pools(picture.rgb, picture.valid, picture.texel_m, picture.above_m())
    shapes = []
    for k in range(1, int(number.max()) + 1):
        own = number == k
        if as_water[own].mean() < 0.5:
            shapes.append((_outline(own, picture.grid), own))
            stated = stated | own
    if not shapes and not buildings:
        return None, stated, ()
    content: Mapping[str, Any] = {"type": "FeatureCollection", "features": []}
    crs: Any = "OGC:CRS84"
    if known is not None:
        content, crs = finite_json(known.read_text(encoding="utf-8-sig")), read_features(known)[1]
    made = [
        {"type": "Feature", "geometry": transform_geom(picture.grid.crs, crs, shape),
         "properties": {"leisure": "swimming_pool", "note": "found by its colour"}}
        for shape, _ in shapes
    ] + [
        {"type": "Feature", "geometry": transform_geom(picture.posts.crs, crs, _on_map(each, picture.posts)),
         "properties": {"building": "yes", "note": "found by its height"}}
        for each in buildings
    ]  # fmt: skip
    if buildings:
        body = inside(buildings, picture.posts).astype(np.float32)
        stated = stated | (onto(body, picture.posts, picture.grid, "nearest") == 1.0)
    whole = {**content, "features": [*content["features"], *made]}
    if not shapes:
        return whole, stated, ()
    words = "; ".join(_place(own, picture) for _, own in shapes[:_MOST])
    more = f" and {len(shapes) - _MOST} more" if len(shapes) > _MOST else ""
    note = (
        f"{len(shapes)} pools are water by their colour: {words}{more}; known.geojson of the scene has their outlines, "
        "so remove there what is none"
    )
    return whole, stated, (note,)


def _on_map(outline: Outline, grid: Grid) -> dict[str, Any]:
    """The GeoJSON polygon of an outline on a grid, in the grid's CRS."""
    rings = [np.column_stack(grid.to_map(*np.asarray(ring, np.float64).T)) for ring in outline.rings]
    return {"type": "Polygon", "coordinates": [[*ring.tolist(), ring[0].tolist()] for ring in rings]}


def write_unexplained(
    folder: Path, shown_as: Path, stated: NDArray[np.bool_], picture: Photograph, material: str,
    progress: Callable[[float], object] | None = None,
) -> tuple[str, ...]:  # fmt: skip
    """Write the outlines of large uniform patches that the learned map does not explain, each to a GeoJSON in a folder.

    Return a sentence on each, which names the file in `shown_as`. `stated` (h, w) is where the scene knows materials.
    `progress` is called with the share done.
    """
    from rasterio.warp import transform_geom

    model = load_map(defaults.EMISSIVITY_MAP)
    if picture.texel_m > COARSEST_RATIO * model.texel_m:
        # The scene says so where it is loaded.
        return ()
    colour = picture.rgb if picture.valid.all() else fill(picture.rgb, nearest_valid(picture.valid))
    confidence = map_materials(model, colour, picture.texel_m, progress).confidence
    unknown = picture.valid & ~stated & (confidence < DEFAULT_CONFIDENCE)
    notes = []
    above = picture.above_m()
    for number, own in enumerate(_uniform(unknown, picture), 1):
        wet = _watery(picture.rgb[own].mean(axis=0)) and not stands_high(above[own])
        guess = "water" if wet else "metal_painted"
        name = f"unexplained-{number}.geojson"
        geometry = transform_geom(picture.grid.crs, "OGC:CRS84", _outline(own, picture.grid))
        feature = {"type": "Feature", "properties": {"material": guess}, "geometry": geometry}
        write_json(folder / name, {"type": "FeatureCollection", "features": [feature]})
        notes.append(
            f"no material of the learned map explains {_place(own, picture)}, which has {material}; if it is {guess}, "
            f"give --paint {shown_as / name}={guess}, or to import-terrain --known {shown_as / name}"
        )
    return tuple(notes)


def _uniform(unknown: NDArray[np.bool_], picture: Photograph) -> list[NDArray[np.bool_]]:
    """Large, compact, uniform patches of a mask, (h, w) each, the largest first.

    What is around something new is new too, to a map that sees texture: such rims have edges or a hole.
    """
    import cv2

    side = max(1, round(_GAP_M / picture.texel_m)) | 1
    level = np.ascontiguousarray(picture.rgb, np.float32)
    spread = (cv2.blur(level**2, (side, side)) - cv2.blur(level, (side, side)) ** 2).max(axis=-1)
    kernel = np.ones((side, side), np.uint8)
    mask = cv2.morphologyEx((unknown & (spread < _CALM**2)).astype(np.uint8), cv2.MORPH_OPEN, kernel)
    _, label, about, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    found: list[NDArray[np.bool_]] = []
    for k in np.argsort(-about[1:, cv2.CC_STAT_AREA], kind="stable") + 1:
        texels = int(about[k, cv2.CC_STAT_AREA])
        if texels * picture.texel_m**2 < _LEAST_M2 or len(found) == _MOST:
            break
        own = label == k
        rings, _ = cv2.findContours(own.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        ring = max(rings, key=len)
        near = np.linalg.norm(level - np.median(level[own], axis=0), axis=-1) < _LEVELS
        whole = texels > _WHOLE * cv2.contourArea(ring) and texels > _COMPACT * cv2.contourArea(cv2.convexHull(ring))
        if whole and near[own].mean() > _UNIFORM:
            # To its edge.
            found.append(own | ((cv2.dilate(own.astype(np.uint8), kernel) > 0) & near))
    return found


def _outline(own: NDArray[np.bool_], grid: Grid) -> dict[str, Any]:
    """The GeoJSON geometry of a connected part of a grid, in its CRS, with the borders of texels as its sides."""
    from rasterio.features import shapes

    return dict(next(shape for shape, _ in shapes(own.astype(np.uint8), mask=own, transform=grid.transform)))


def _place(own: NDArray[np.bool_], picture: Photograph) -> str:
    """Size, colour and place of a part of a picture, in words."""
    row, column = np.nonzero(own)
    x, y = picture.grid.to_map(column.mean() + 0.5, row.mean() + 0.5)
    (longitude,), (latitude,) = lon_lat(picture.grid, np.array([x]), np.array([y]))
    colour = "#" + "".join(f"{int(level):02x}" for level in np.rint(picture.rgb[own].mean(axis=0)))
    return f"{len(row) * picture.texel_m**2:.0f} m² of {colour} at latitude {latitude:.6f}, longitude {longitude:.6f}"


def _watery(rgb: NDArray[np.floating]) -> bool:
    """Whether a mean colour (3,) may be water's: cyan, blue or dark."""
    import cv2

    pixel: NDArray[np.float32] = np.reshape(rgb / 255.0, (1, 1, 3)).astype(np.float32)
    hue, saturation, value = np.ravel(cv2.cvtColor(pixel, cv2.COLOR_RGB2HSV))
    return bool(value < 0.25 or (saturation > 0.15 and _WATERY_DEG[0] < hue < _WATERY_DEG[1]))
