"""Pictures of façades: plaster or brick, with windows by storey and a door; and the walls that tags declare."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender import Material
from thermorender.apps.lands.solids.quads import Paint
from thermorender.physics.srgb import linear_from_bytes

# Material and sRGB colour of walls.
WALLS = (
    ("brick_painted", (214, 202, 178)), ("brick_painted", (226, 222, 212)), ("brick_painted", (206, 186, 150)),
    ("brick_clay", (150, 96, 78)), ("brick_clay", (164, 118, 92)), ("brick_painted", (190, 194, 190)),
)  # fmt: skip
GLASS, DOOR = "glass", "wood"
# Materials of the library by the values of OpenStreetMap's tags `building:cladding` and `building:material`, in the
# order of preference: what covers a wall is what radiates.
TAGS, COLOURS = ("building:cladding", "building:material"), ("building:colour", "building:color")
MATERIALS = ("material", *TAGS)
OF_TAG = {
    "brick": "brick_clay", "bricks": "brick_clay", "clinker": "brick_clay", "plaster": "brick_painted",
    "render": "brick_painted", "stucco": "brick_painted", "timber_framing": "brick_painted", "cement": "cement",
    "concrete": "concrete_urban", "reinforced_concrete": "concrete_urban", "cement_block": "concrete_urban",
    "wood": "wood", "timber": "wood", "metal": "metal_painted", "metal_plates": "metal_painted",
    "steel": "steel_galvanised", "aluminium": "aluminium_weathered", "glass": "glass", "mirror": "glass",
    "stone": "sandstone_building", "sandstone": "sandstone_building", "limestone": "limestone_building",
    "granite": "granite", "slate": "roof_slate", "marble": "marble", "tiles": "roof_tile_clay",
    "vinyl": "pvc_roofing", "plastic": "pvc_roofing",
}  # fmt: skip
# Height of a storey, and sill, height, width and spacing of windows [m].
_STOREY_M, _SILL_M, _WINDOW_M, _WIDE_M, _EVERY_M = 2.7, 0.9, 1.3, 1.1, 2.7
_PANE, _FRAME, _LEAF = (52, 60, 70), (232, 230, 224), (112, 78, 56)


@dataclass(frozen=True)
class Wall:
    """The walls of a building: material, and sRGB colour where it is not the material's own."""

    material: str
    colour: tuple[int, int, int] | None = None


def wall_of(
    tags: Mapping[str, str], by_kind: Mapping[str, str], usual: str, library: Mapping[str, Material]
) -> tuple[Wall, tuple[str, ...]]:
    """Return (Wall, tags without a match such as "building:material=reed") of a building. A tag `material` names one of
    the library; else OpenStreetMap's tags count, then `by_kind` by the tag `building`, then `usual`.
    """
    unmatched = []
    material = by_kind.get(tags.get("building", ""), usual)
    for key in MATERIALS:
        if key not in tags:
            continue
        name = tags[key] if key == "material" else OF_TAG.get(tags[key].lower().replace(" ", "_"), "")
        if name in library and library[name].thermal is not None:
            material = name
            break
        unmatched.append(f"{key}={tags[key]}")
    colour = None
    for key in COLOURS:
        if key in tags:
            colour = _colour(tags[key])
            unmatched += [] if colour else [f"{key}={tags[key]}"]
    return Wall(material, colour), tuple(unmatched)


def _colour(text: str) -> tuple[int, int, int] | None:
    """The sRGB colour of a name of HTML or of #rrggbb, or None."""
    from PIL import ImageColor

    try:
        red, green, blue = ImageColor.getrgb(text.strip().replace("_", "").replace(" ", ""))[:3]
        return red, green, blue
    except ValueError:
        return None


def facade(
    value: Callable[[str], int], draw: np.random.Generator, material: str, colour: NDArray[np.floating], wide_m: float,
    high_m: float, below_m: float = 0.0, door: bool = False, storeys_m: float | None = None,
    part: tuple[float, float] = (0.0, 1.0),
) -> Paint:  # fmt: skip
    """Return the Paint of a façade of storeys with windows; boards of wood, and gables, whose height is 0, have none.
    Lengths are in metres, `part` the beginning and end of the picture as shares of the width, and `value` numbers
    materials.
    """
    pane, frame, leaf = (linear_from_bytes(np.array(each, np.uint8)) for each in (_PANE, _FRAME, _LEAF))
    storeys = 0 if material == DOOR else int((high_m if storeys_m is None else storeys_m) / _STOREY_M + 0.15)
    columns = int((wide_m - 0.8) / _EVERY_M)

    def paint(s: NDArray[np.float64], t: NDArray[np.float64]) -> tuple[NDArray[np.floating], NDArray[np.integer]]:
        x, z = (part[0] + s * (part[1] - part[0])) * wide_m, t * (high_m + below_m) - below_m
        foot = 0.12 * np.exp(-np.maximum(z, 0.0) / 0.4) if high_m else 0.0
        stain = 0.04 * draw.standard_normal(s.shape) - foot
        tone = np.asarray(colour, np.float64) * np.exp(stain)[..., None]
        number = np.full(s.shape, value(material))
        if storeys > 0 and columns > 0:
            # Windows with their frames do not meet: only the nearest counts.
            nearest = np.clip(np.floor(x * columns / wide_m), 0, columns - 1)
            storey = np.clip(np.rint((z - _SILL_M - 0.5 * _WINDOW_M) / _STOREY_M), 0, storeys - 1)
            away = np.abs(x - wide_m * (nearest + 0.5) / columns) - 0.5 * _WIDE_M
            up = np.abs(z - storey * _STOREY_M - _SILL_M - 0.5 * _WINDOW_M) - 0.5 * _WINDOW_M
            inside = np.maximum(away, up)
            tone = np.where((inside < 0.1)[..., None], frame, tone)
            tone = np.where((inside < 0.0)[..., None], pane, tone)
            number = np.where(inside < 0.0, value(GLASS), number)
        if door:
            middle = wide_m * 0.5 / max(columns, 1) if columns % 2 else 0.5 * wide_m
            here = (np.abs(x - middle) < 0.55) & (z < 2.1)
            tone, number = np.where(here[..., None], leaf, tone), np.where(here, value(DOOR), number)
        return tone, number

    return paint
