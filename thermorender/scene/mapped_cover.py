"""Shapes of OpenStreetMap that restrict the materials inside them: a GeoJSON of buildings, roads, water and land."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import formats
from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity.kinds import KINDS, kinds_of
from thermorender.learned.emissivity.mapping import Evidence
from thermorender.scene.patch import burnt, part_of, pixels_of, read_features, texels_of
from thermorender.scene.raster import Grid

_FIELDS, _LOOSE = ("low", "soil", "tree"), ("paved", "soil", "sand", "rock", "low", "tree")
_PAVED, _WATER = ("paved", "tree"), ("water",)
# Usual width of a road without tags `width` and `lanes` [m], and of a lane.
HIGHWAYS = {
    "motorway": 12.0, "trunk": 10.0, "primary": 8.0, "secondary": 7.0, "tertiary": 6.0, "unclassified": 5.0,
    "residential": 5.0, "living_street": 5.0, "motorway_link": 5.0, "trunk_link": 5.0, "primary_link": 5.0,
    "secondary_link": 5.0, "tertiary_link": 5.0, "service": 4.0, "pedestrian": 4.0, "road": 5.0, "busway": 5.0,
    "cycleway": 2.0, "footway": 2.0, "steps": 2.0,
}  # fmt: skip
_TRACKS = {"track": 3.0, "path": 1.0, "bridleway": 2.0}
_WATERWAYS = {"river": 10.0, "canal": 8.0, "stream": 2.0, "ditch": 1.0, "drain": 1.0}
_LANE_M = 3.0
# (tag, values with blanks between, kinds of material inside); any value if none is listed. A later rule covers an
# earlier one.
RULES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("landuse", "farmland orchard vineyard allotments plant_nursery grass meadow village_green recreation_ground",
     _FIELDS),
    ("natural", "grassland heath scrub fell", (*_FIELDS, "sand")),
    ("landuse", "forest", ("tree", "low", "soil")),
    ("natural", "wood", ("tree", "low", "soil")),
    ("natural", "sand dune", ("sand",)),
    ("natural", "beach shoal", ("sand", "rock", "soil")),
    ("natural", "bare_rock scree shingle cliff", ("rock",)),
    ("natural", "glacier", ("snow",)),
    ("amenity", "parking", _PAVED),
    ("aeroway", "runway taxiway apron", ("paved",)),
    ("landuse", "reservoir basin", _WATER),
    ("natural", "water", _WATER),
    ("waterway", " ".join(("riverbank", "dock", *_WATERWAYS)), _WATER),
    ("leisure", "swimming_pool", _WATER),
    ("highway", " ".join(_TRACKS), _LOOSE),
    ("highway", " ".join(HIGHWAYS), _PAVED),
    ("building", "", ("roof",)),
)  # fmt: skip
_UNPAVED = ("unpaved", "compacted", "fine_gravel", "gravel", "pebblestone", "ground", "dirt", "earth", "grass", "mud",
            "sand", "rock")  # fmt: skip
# Main tags of OpenStreetMap that a map of an area has.
_MAIN = {"building", "building:part", "landuse", "natural", "leisure", "highway", "amenity", "waterway", "water",
         "landcover", "surface", "barrier", "railway", "man_made", "aeroway", "boundary", "tourism", "place", "shop",
         "office", "power", "historic", "military", "sport", "public_transport", "route", "craft",
         "geological"}  # fmt: skip
_AREAS, _LINES = ("Polygon", "MultiPolygon"), ("LineString", "MultiLineString")
_MOST_NAMED = 5
# Properties that hold several tags as text, a pair of hstore, and a character that a backslash keeps in one.
_PACKED = ("tags", "other_tags", "all_tags")
_PAIR, _UNESCAPED = re.compile(r'"((?:[^"\\]|\\.)*)"\s*=>\s*"((?:[^"\\]|\\.)*)"'), re.compile(r"\\(.)")


@dataclass(frozen=True, eq=False)
class MappedCover:
    """What a GeoJSON says on the materials of a picture's texels."""

    number: NDArray[np.uint8]  # (h, w) uint8 1 … N of the case, 0 where nothing is known
    # The kinds of material that N cases allow, or the name of one material
    cases: tuple[tuple[str, ...] | str, ...]
    notes: tuple[str, ...]  # What was used and what was not, one sentence each

    def states(self, kind: str) -> NDArray[np.bool_]:
        """Return the texels, (h, w) bool, whose case allows a kind of material or is one material."""
        known = np.array([False, *(isinstance(case, str) or kind in case for case in self.cases)])
        return np.asarray(known[self.number])

    def beyond(self, materials: Sequence[str]) -> list[str]:
        """Return the materials of cases that allow none of those given, one for each."""
        return list(dict.fromkeys(
            case if isinstance(case, str) else KINDS[case[0]][0]
            for case in self.cases if not any(_allows(case, name) for name in materials)
        ))  # fmt: skip

    def evidence(self, materials: Sequence[str]) -> Evidence:
        """Return the Evidence on materials by name, of which each case allows one or more."""
        rows = [[_allows(case, name) for name in materials] for case in self.cases]
        return Evidence(self.number, np.array([[True] * len(materials), *rows], np.float32))


def _allows(case: tuple[str, ...] | str, material: str) -> bool:
    """Whether a case allows a material. Snow may lie on all kinds, and a material of unknown kind may be anywhere."""
    kinds = kinds_of(material)
    return material == case if isinstance(case, str) else not kinds or bool({*case, "snow"} & {*kinds})


def read_mapped_cover(
    path: Path, grid: Grid, texel_m: float, walls: bool = False, required: bool = True
) -> MappedCover:  # fmt: skip
    """Return the MappedCover of a GeoJSON of OpenStreetMap tags, or of polygons with a property "material".

    Coordinates are longitude and latitude, or those of the "crs" member. `texel_m` is the side of a texel of `grid`
    [m]. With `walls` a building's material is that of its walls. A file that restricts nothing is refused, or has no
    cases where it is not `required` to.
    """
    features, crs, notes = tagged_features(path)
    left_out: Counter[str] = Counter()
    silent: Counter[str] = Counter()
    shapes = []
    for number, (geometry, tags) in enumerate(features, 1):
        found = _ruled(tags, walls)
        if found is None:
            silent[_named(tags)] += 1
            continue
        order, case, name = found
        kind, width = str(geometry.get("type", "no shape")), _width_m(tags)
        as_area = kind in _AREAS
        if underground(tags):
            left_out["underground"] += 1
        elif as_area and _empty(geometry.get("coordinates")):
            left_out["without a shape"] += 1
        elif not (as_area or (kind in _LINES and width is not None)):
            left_out[f"of {name} as {kind}"] += 1
        elif not as_area and width is not None and width < texel_m:
            left_out["narrower than a texel"] += 1
        else:
            line_px = None if as_area or width is None else width / texel_m
            shapes.append((order, number, geometry, case, name, line_px))
    known = _burnt(path, crs, grid, shapes, left_out, silent, required)
    return replace(known, notes=(*notes, *known.notes)) if known.cases else known


def _empty(coordinates: Any) -> bool:
    """Whether lists of lists hold no corner."""
    return isinstance(coordinates, list) and all(_empty(each) for each in coordinates)


def _burnt(
    path: Path, crs: Any, grid: Grid, shapes: Sequence[Any], left_out: Counter[str], silent: Counter[str],
    required: bool,
) -> MappedCover:  # fmt: skip
    """The MappedCover of shapes [(order, number, geometry, case, name, width [texels] or None)]."""
    number = np.zeros((grid.height, grid.width), np.uint8)
    cases: dict[tuple[str, ...] | str, int] = {}
    by_name: dict[str, int] = {}
    owner = np.zeros(number.shape, np.uint16)
    used = 0
    for _, feature, geometry, case, name, width_px in sorted(shapes, key=lambda shape: shape[:2]):
        where = f"{path}, feature {feature}"
        if width_px is None:
            part, inside = texels_of(geometry, crs, grid, where)
        else:
            part, inside = _line_texels(geometry, crs, grid, width_px, where)
        if not inside.any():
            left_out["outside the picture" if not inside.size else "smaller than a texel"] += 1
            continue
        used += 1
        number[part][inside] = cases.setdefault(case, len(cases) + 1)
        owner[part][inside] = by_name.setdefault(name, len(by_name) + 1)
    if not used and not required:
        return MappedCover(number, (), ())
    if not used:
        reasons = counted(left_out + silent) or "it has no feature"
        raise ThermorenderError(
            f"{path} restricts no texel of {grid.name} ({reasons}); give OpenStreetMap shapes of the terrain as "
            "longitude and latitude unless a 'crs' member names another CRS"
        )
    size = number.size
    # Of what no later shape covers.
    shares = ", ".join(f"{name} {np.count_nonzero(owner == each) / size:.1%}" for name, each in by_name.items())
    notes = [f"{path.name}: {used} of {used + left_out.total() + silent.total()} shapes restrict the materials of "
             f"{np.count_nonzero(number) / size:.1%} of the texels ({shares})"]  # fmt: skip
    if left_out:
        notes.append(f"{path.name}: left out are {counted(left_out)}")
    if silent:
        notes.append(f"{path.name}: tags that say nothing on materials: {counted(silent)}")
    return MappedCover(number, tuple(cases), tuple(notes))


def tagged_features(path: Path) -> tuple[list[tuple[dict[str, Any], dict[str, str]]], Any, tuple[str, ...]]:
    """Return ([(geometry, tags)], CRS, sentences) of a GeoJSON.

    Footprints from pictures, such as those of Microsoft and Google, have no tags: all of their polygons are buildings.
    """
    features, crs = read_features(path)
    found = [_tagged(feature, path, number) for number, feature in enumerate(features, 1)]
    if not found or any({*_MAIN, "material"} & {key.lower() for key in tags} for _, tags in found):
        return found, crs, ()
    note = f"{path.name}: no feature has a tag of OpenStreetMap, so all polygons are buildings"
    return [(geometry, {"building": "yes"}) for geometry, _ in found], crs, (note,)


def _tagged(feature: Any, path: Path, number: int) -> tuple[dict[str, Any], dict[str, str]]:
    """Return (geometry, tags) of feature `number` of a file; {} for a missing geometry.

    Tags are properties, a property "tags", or text in one of `_PACKED`, as GDAL and PostGIS write rarer tags.
    """
    try:
        geometry, about = feature["geometry"], feature.get("properties") or {}
        nested = about.get("tags")
        tags = nested if isinstance(nested, Mapping) else about | _packed(about)
        # A feature may be without a place: RFC 7946, section 3.2.
        geometry = {} if geometry is None else geometry
        if not isinstance(geometry, dict):
            raise ValueError
        return geometry, {str(key): str(value) for key, value in tags.items() if value not in (None, "")}
    except Exception:  # whatever stands in place of a feature
        raise ThermorenderError(
            f"{path}, feature {number} is not a GeoJSON feature with geometry and properties; export the file again"
        ) from None


def _packed(about: Mapping[str, Any]) -> dict[str, Any]:
    """Tags of OpenStreetMap that a property holds as text: JSON, or "key"=>"value" as PostgreSQL's hstore."""
    found: dict[str, Any] = {}
    for text in (about[key] for key in _PACKED if isinstance(about.get(key), str)):
        if text.lstrip().startswith("{"):
            found |= formats.finite_json(text)
        else:
            found |= {_UNESCAPED.sub(r"\1", key): _UNESCAPED.sub(r"\1", value) for key, value in _PAIR.findall(text)}
    return found


def underground(tags: Mapping[str, str]) -> bool:
    """Whether a shape with tags of OpenStreetMap is underground."""
    return tags.get("tunnel", "no") not in ("no", "building_passage") or tags.get("location") == "underground"


def _ruled(tags: Mapping[str, str], walls: bool) -> tuple[int, tuple[str, ...] | str, str] | None:
    """(order, case, name) of the last rule for some tags, or None; with `walls`, a building's material is theirs."""
    if "material" in tags and not (walls and tags.get("building", "no") != "no"):
        return len(RULES), tags["material"], f"material={tags['material']}"
    for order, (key, values, kinds) in reversed(list(enumerate(RULES))):
        value = tags.get(key, "no")
        if value == "no" or (values and value not in values.split()):
            continue
        if key == "highway" and "surface" in tags:
            kinds = _LOOSE if tags["surface"] in _UNPAVED else _PAVED
        if kinds is _WATER and "yes" in (tags.get("intermittent"), tags.get("seasonal")):
            kinds = ("water", "soil", "sand", "rock", "low")
        return order, kinds, key if key in ("building", "highway") else f"{key}={value}"
    return None


def _named(tags: Mapping[str, str]) -> str:
    """A name for tags without a rule."""
    keys = {key for key, _, _ in RULES}
    return next((f"{key}={value}" for key, value in tags.items() if key in keys), "others")


def _width_m(tags: Mapping[str, str]) -> float | None:
    """The width of a road or watercourse [m]; None for anything else."""
    usual = {**HIGHWAYS, **_TRACKS}.get(tags.get("highway", ""), _WATERWAYS.get(tags.get("waterway", "")))
    if usual is None:
        return None
    for text, factor in ((tags.get("width", ""), 1.0), (tags.get("lanes", ""), _LANE_M)):
        try:
            stated = factor * float(text.removesuffix("m"))
        except ValueError:
            continue
        if 0.0 < stated < 200.0:
            return stated
    return usual


def _line_texels(
    geometry: Any, crs: Any, grid: Grid, width_px: float, where: str
) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
    """(part of a grid, which of its texels have their middle within a line of a width) as `texels_of`."""
    try:
        lines = [geometry["coordinates"]] if geometry["type"] == "LineString" else list(geometry["coordinates"])
        made = [pixels_of(line, crs, grid, where) for line in lines]
        every = np.concatenate(made)
    except ThermorenderError:
        raise
    except (KeyError, TypeError, ValueError):
        raise ThermorenderError(f"{where} is not a line with corners; export it again") from None
    part = part_of(grid, every.min(axis=0) - 0.5 * width_px, every.max(axis=0) + 0.5 * width_px)
    return part, burnt([ring for line in made for ring in _ribbon(line, 0.5 * width_px)], part)


def _ribbon(line: NDArray[np.float64], half: float) -> list[NDArray[np.float64]]:
    """Polygons that cover a line of a half width: a rectangle for each step, and a disc at each bend."""
    step = np.diff(line, axis=0)
    length = np.hypot(*step.T)
    across = half * step[:, ::-1] * (-1.0, 1.0) / np.maximum(length, 1e-9)[:, None]
    found = [np.stack([a + n, b + n, b - n, a - n]) for a, b, n in zip(line[:-1], line[1:], across, strict=True)]
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    disc = half * np.column_stack([np.cos(angle), np.sin(angle)])
    return [*found, *(corner + disc for corner in line[1:-1])]


def counted(counts: Counter[str]) -> str:
    """Return names with their counts, the most frequent first."""
    rest = counts.total() - sum(count for _, count in counts.most_common(_MOST_NAMED))
    words = [f"{count} {name}" for name, count in counts.most_common(_MOST_NAMED)]
    return ", ".join([*words, *([f"{rest} more"] if rest else [])])
