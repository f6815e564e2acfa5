"""Outlines of buildings that files state: a GeoJSON of OpenStreetMap's tags, or a raster of classes."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.solids.borders import THIN
from thermorender.apps.lands.solids.detection import Outline, Ring, area_of, even_odd, outlines_of
from thermorender.apps.lands.solids.facades import COLOURS, MATERIALS
from thermorender.errors import ThermorenderError
from thermorender.scene.mapped_cover import counted, tagged_features, underground
from thermorender.scene.patch import pixels_of
from thermorender.scene.raster import Grid, grid_of, onto, read_classes

_KEYS = ("building", "building:part")
# Values of these tags without a building that stands.
_NONE = ("no", "false", "0", "entrance", "proposed", "planned", "demolished", "razed", "removed")
# Tags of a building or part that begins above the ground, and values of `building` without walls.
_LIFTED, _OPEN = ("min_height", "building:min_height", "building:min_level"), ("roof", "carport")
# Rings of less area are lines or points [squares of a post].
_NO_AREA = 1e-6


def outlines_in(path: Path, grid: Grid, others: bool = False) -> tuple[list[Outline], tuple[str, ...]]:
    """Return (Outlines of a GeoJSON's buildings and their parts, sentences on what the file states beside them).

    Closed lines with such a tag are outlines too, and so are polygons in collections. A part inside a building is one
    `of` it, and has its tags but for those of its own. Outlines and holes without area are left out and counted. Where
    `others` have a use, a file may hold other shapes only.
    """
    features, crs, plain = tagged_features(path)
    found: list[Outline] = []
    left_out: Counter[str] = Counter()
    beside = areas_beside = 0
    for number, (geometry, tags) in enumerate(features, 1):
        where = f"{path}, feature {number}"
        shapes = list(_polygons(geometry, where))
        if not is_building(tags):
            beside, areas_beside = beside + 1, areas_beside + bool(shapes)
            continue
        if underground(tags) or not shapes:
            kind = geometry.get("type")
            shapeless = kind in (None, "MultiPolygon")
            left_out["underground" if shapes else "without a shape" if shapeless else f"drawn as {kind}"] += 1
            continue
        for shape in shapes:
            rings = _rings(shape, crs, grid, where, left_out)
            if not rings:
                left_out["with no area or almost none"] += 1
            elif _meets(rings, grid):
                found.append(Outline(rings, tags))
            else:
                left_out[
                    "with latitude before longitude" if _swapped(shape, crs, grid) else "outside of the model"
                ] += 1
    if areas_beside and not others:
        left_out["polygons without a tag 'building'"] = areas_beside
    if not found and not (others and beside):
        raise ThermorenderError(
            f"{path} has no polygon with a tag 'building' on {grid.name} (left out: {counted(left_out) or 'nothing'}); "
            "give one of this area whose buildings have a property building=yes, or leave known out so that buildings "
            "are found by height"
        )
    notes = [*plain]
    notes += [f"{path.name}: {len(found)} outlines of buildings; left out: {counted(left_out)}"] if left_out else []
    for what, count in (
        ("begin above the ground by their tags, and their walls reach down to it", sum(map(_lifted, found))),
        ("are roofs without walls by their tags, and have walls", sum(e.tags.get("building") in _OPEN for e in found)),
    ):
        notes += [f"{path.name}: {count} outlines {what}"] if count else []
    return _with_wholes(found), tuple(notes)


def is_building(tags: Mapping[str, str]) -> bool:
    """Whether tags of OpenStreetMap are those of a building that stands, or of a part of one."""
    return any(_stated(tags, key) for key in _KEYS)


def _stated(tags: Mapping[str, str], key: str) -> bool:
    """Whether a tag states something that stands."""
    return tags.get(key, "no").lower() not in _NONE


def _lifted(outline: Outline) -> bool:
    """Whether a building begins above the ground by its tags."""
    stated = (re.match(r"\s*\d+(\.\d+)?", outline.tags.get(key, "")) for key in _LIFTED)
    return any(each and float(each.group()) > 0.0 for each in stated)


def _polygons(geometry: Mapping[str, Any], where: str) -> Iterator[Any]:
    """Yield the rings of each polygon of a geometry, as its file has them."""
    kind = geometry.get("type")
    given: Any = geometry.get("coordinates")
    try:
        if kind == "GeometryCollection":
            for each in geometry["geometries"]:
                yield from _polygons(each, where)
        elif kind == "Polygon":
            yield [list(ring) for ring in given]
        elif kind == "MultiPolygon":
            yield from [[list(ring) for ring in shape] for shape in given]
        elif kind == "LineString" and len(given) > 3 and given[0] == given[-1]:
            # A closed way of OpenStreetMap.
            yield [list(given)]
    except (AttributeError, KeyError, TypeError):
        raise ThermorenderError(f"{where} is not a polygon with corners; export polygons from a GIS") from None


def _rings(shape: Sequence[Any], crs: Any, grid: Grid, where: str, left_out: Counter[str]) -> list[Ring]:
    """The rings of a polygon on a grid; none if the outer one has no area. Adds unused holes to `left_out`."""
    rings = [_ring(pixels_of(ring, crs, grid, where)) if ring else np.empty((0, 2)) for ring in shape]
    if not rings or _thin(rings[0]):
        return []
    holes = [ring for ring in rings[1:] if len(ring) > 2 and area_of(ring) >= _NO_AREA]
    # By the even-odd rule a hole beside its outline would be a building.
    inner = [hole for hole in holes if even_odd(_inner(hole), rings[:1]).mean() > 0.5]
    unused = {"holes without area": len(rings) - 1 - len(holes), "holes beside their outlines": len(holes) - len(inner)}
    left_out.update({name: count for name, count in unused.items() if count})
    return [rings[0], *inner]


def _thin(ring: Ring) -> bool:
    """Whether a ring has no area, or is thinner than `THIN` in the mean."""
    if len(ring) < 3 or area_of(ring) < _NO_AREA:
        return True
    length = float(np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1).sum())
    return 2.0 * area_of(ring) < THIN * length


def _inner(ring: Ring) -> Ring:
    """Corners a little towards the middle of a ring: those of a hole or part may be on the side of what is around."""
    moved: Ring = ring + 0.05 * (ring.mean(axis=0) - ring)
    return moved


def _ring(corner: NDArray[np.float64]) -> Ring:
    """Corners once each: without those that repeat the one before, and the first at the end."""
    return corner[np.abs(corner - np.roll(corner, 1, axis=0)).max(axis=1) > 1e-9]


def _meets(rings: Sequence[Ring], grid: Grid) -> bool:
    """Whether the box of an outline meets a grid."""
    low, high = rings[0].min(axis=0), rings[0].max(axis=0)
    return bool((high > 0.0).all() and (low < (grid.width, grid.height)).all())


def _swapped(shape: Sequence[Any], crs: Any, grid: Grid) -> bool:
    """Whether a polygon is on a grid if its latitudes are before its longitudes."""
    try:
        ring = [(corner[1], corner[0]) for corner in shape[0]]
        return bool(crs.is_geographic) and _meets([pixels_of(ring, crs, grid, "it")], grid)
    except ThermorenderError:
        return False


def _with_wholes(outlines: Sequence[Outline]) -> list[Outline]:
    """Outlines whose parts name the smallest building that has most of their corners inside."""
    wholes = sorted(
        (each for each in outlines if _stated(each.tags, "building")),
        key=lambda each: area_of(each.rings[0]),
    )
    boxes = np.array([[*each.rings[0].min(axis=0), *each.rings[0].max(axis=0)] for each in wholes]).reshape(-1, 4)
    made = []
    for each in outlines:
        if _stated(each.tags, "building"):
            made.append(each)
            continue
        inner = _inner(each.rings[0])
        near = np.flatnonzero((boxes[:, :2] < inner.mean(axis=0)).all(axis=1)
                              & (boxes[:, 2:] > inner.mean(axis=0)).all(axis=1))  # fmt: skip
        of = next((wholes[k] for k in near if even_odd(inner, wholes[k].rings).mean() > 0.5), None)
        made.append(each if of is None else replace(each, of=of, tags=_inherited(of.tags, each.tags)))
    return made


def _inherited(whole: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Tags of a part: its own, and those of its building without the walls' material or colour if it has its own."""
    without = {key for keys in (MATERIALS, COLOURS) if any(key in own for key in keys) for key in keys}
    return {**{key: value for key, value in whole.items() if key not in without}, **own}


def outlines_in_classes(path: Path, number: int, grid: Grid) -> list[Outline]:
    """Return the Outlines of connected pixels of a raster that have a class number."""
    if number == 0:
        raise ThermorenderError(f"building_class=0 marks pixels without data in {path}; give the number of buildings")
    classes = onto(read_classes(path).astype(np.float32), grid_of(path), grid, "nearest")
    found = outlines_of(classes == number)
    if not found:
        held = np.unique(classes[np.isfinite(classes)]).astype(int).tolist()
        raise ThermorenderError(
            f"{path} has no building of class {number} on {grid.name}; it holds the classes {held[:20]}, so give the "
            "one of buildings as building_class, or a raster of this area"
        )
    return found
