"""Shapes of houses, greenhouses and solar panels: walls with windows and doors, gables, hips, eaves, parapets."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import Values
from thermorender.apps.lands.solids.facades import WALLS, facade
from thermorender.apps.lands.solids.quads import Paint, Quads

# Overhang of pitched roofs in buildings.house, thickness of roofs, depth of walls below the ground [m].
OVERHANG_M, _ROOF_M, _BELOW_M = 0.45, 0.12, 0.4
# Houses with lower walls are sheds of boards without windows [m].
_SHED_M = 2.3
_SOFFIT = (196, 188, 172)


class Place(NamedTuple):
    """Axes of a building: `position` maps (u, v) to east and north [m]; centre u, v; height of the ground [m]."""

    position: Callable[[float, float], tuple[float, float]]
    u: float
    v: float
    ground_m: float

    def point(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Return east, north and height of a point relative to the centre and the ground."""
        return (*self.position(self.u + x, self.v + y), self.ground_m + z)


class Look(NamedTuple):
    """Colours: `value` numbers a material; draws; linear colour and material of the roof."""

    value: Callable[[str], int]
    draw: np.random.Generator
    colour: NDArray[np.float32]
    material: str


def house(
    quads: Quads, at: Place, look: Look, half: tuple[float, float], wall_m: float, pitch_deg: float | None, hip: bool,
    chimney_u: float | None,
) -> None:  # fmt: skip
    """Add a house whose ridge runs along u; a `pitch_deg` of None is a flat roof."""
    draw = look.draw
    material, tint = WALLS[draw.integers(len(WALLS))]
    if wall_m < _SHED_M:
        material, tint = "wood", (150, 126, 98)
    paint: dict[str, Any] = {"value": look.value, "draw": draw, "material": material, "colour": linear(*tint)}
    paint["colour"] = paint["colour"] * np.exp(draw.normal(0.0, 0.08))
    if pitch_deg is None:
        _flat_roof(quads, at, look, half, wall_m, paint)
        return
    slope = float(np.tan(np.radians(pitch_deg)))
    wide, deep = half[0] + OVERHANG_M, half[1] + OVERHANG_M
    run = min(deep / 1.1, wide - 0.05) if hip else 0.0
    ridge = wall_m + slope * (min(deep, 1.1 * run) if hip else deep)
    ends = wide - run
    p = at.point
    sides = [
        [p(-wide, -deep, wall_m), p(wide, -deep, wall_m), p(ends, 0, ridge), p(-ends, 0, ridge)],
        [p(wide, deep, wall_m), p(-wide, deep, wall_m), p(-ends, 0, ridge), p(ends, 0, ridge)],
    ]
    if hip:
        sides += [
            [p(wide, -deep, wall_m), p(wide, deep, wall_m), p(ends, 0, ridge), p(ends, 0, ridge)],
            [p(-wide, deep, wall_m), p(-wide, -deep, wall_m), p(-ends, 0, ridge), p(-ends, 0, ridge)],
        ]
    soffit = _plain(look, _SOFFIT, "wood")
    for corners in sides:
        quads.add(corners, _tiles(look))
        below = [(e, n, z - _ROOF_M) for e, n, z in corners]
        quads.add([below[1], below[0], below[3], below[2]], soffit)
        quads.add([below[0], below[1], corners[1], corners[0]], soffit)
        if not hip:
            quads.add([below[1], below[2], corners[2], corners[1]], soffit)
            quads.add([below[3], below[0], corners[0], corners[3]], soffit)
    eaves = wall_m + slope * OVERHANG_M - _ROOF_M
    _walls(quads, at, half, eaves, paint)
    if not hip:
        top = ridge - _ROOF_M
        for side in (1.0, -1.0):
            x, y = side * half[0], side * half[1]
            gable = [p(x, -y, eaves), p(x, y, eaves), p(x, 0, top), p(x, 0, top)]
            quads.add(gable, facade(**paint, wide_m=2.0 * half[1], high_m=0.0))
    if chimney_u is not None:
        brick = _plain(look, (150, 108, 92), "brick_clay")
        low, high = wall_m + 0.5 * slope * half[1], wall_m + slope * half[1] + 0.9
        quads.box(at.position, at.u + chimney_u, at.v + 0.4, 0.35, 0.35, at.ground_m + low, at.ground_m + high, brick)


def _walls(quads: Quads, at: Place, half: tuple[float, float], top_m: float, paint: dict[str, Any]) -> None:
    """Add four walls from below the ground to `top_m` above it; the door is in one of the long ones."""
    p = at.point
    ring = [(-half[0], -half[1]), (half[0], -half[1]), (half[0], half[1]), (-half[0], half[1])]
    door = int(paint["draw"].integers(2)) * 2
    for number in range(4):
        a, b = ring[number], ring[(number + 1) % 4]
        wide = float(np.hypot(b[0] - a[0], b[1] - a[1]))
        corners = [p(*a, -_BELOW_M), p(*b, -_BELOW_M), p(*b, top_m), p(*a, top_m)]
        quads.add(corners, facade(**paint, wide_m=wide, high_m=top_m, below_m=_BELOW_M, door=number == door))


def _flat_roof(
    quads: Quads, at: Place, look: Look, half: tuple[float, float], wall_m: float, paint: dict[str, Any]
) -> None:
    """Add a house with a flat roof inside a parapet of 0.35 by 0.3 m."""
    rim, edge = wall_m + 0.3, 0.35
    _walls(quads, at, half, rim, paint)
    p, concrete = at.point, _plain(look, (138, 136, 131), "concrete")
    outer = [(-half[0], -half[1]), (half[0], -half[1]), (half[0], half[1]), (-half[0], half[1])]
    inner = [(x - np.sign(x) * edge, y - np.sign(y) * edge) for x, y in outer]
    for number in range(4):
        after = (number + 1) % 4
        a, b, c, d = outer[number], outer[after], inner[after], inner[number]
        quads.add([p(*a, rim), p(*b, rim), p(*c, rim), p(*d, rim)], concrete)
        quads.add([p(*c, wall_m), p(*d, wall_m), p(*d, rim), p(*c, rim)], concrete)
    quads.add([p(*each, wall_m) for each in inner], _felt(look))


def greenhouse(quads: Quads, at: Place, look: Look, half: tuple[float, float], spans: int) -> None:
    """Add a greenhouse of several glazed spans along v."""
    width, p = 2.0 * half[0] / spans, at.point
    high, ridge = 2.6, 2.6 + 0.55 * 0.5 * width
    glass = _bars(look)
    for number in range(spans):
        left, right = -half[0] + number * width, -half[0] + (number + 1) * width
        middle = 0.5 * (left + right)
        y = half[1]
        quads.add([p(left, y, high), p(left, -y, high), p(middle, -y, ridge), p(middle, y, ridge)], glass)
        quads.add([p(right, -y, high), p(right, y, high), p(middle, y, ridge), p(middle, -y, ridge)], glass)
        for a, b, side in ((left, right, -y), (right, left, y)):
            quads.add([p(a, side, -_BELOW_M), p(b, side, -_BELOW_M), p(b, side, high), p(a, side, high)], glass)
            quads.add([p(a, side, high), p(b, side, high), p(middle, side, ridge), p(middle, side, ridge)], glass)
    for x in (half[0], -half[0]):
        a, b = (-half[1], half[1]) if x > 0 else (half[1], -half[1])
        quads.add([p(x, a, -_BELOW_M), p(x, b, -_BELOW_M), p(x, b, high), p(x, a, high)], glass)


def hide(quads: Quads, at: Place, look: Look) -> None:
    """Add a raised hunting hide: a cabin of boards with openings on four leaning legs, with a ladder behind (−y)."""
    floor, half, foot = 3.2, 0.8, 1.15
    up = lambda y: floor + 1.9 + 0.15 * y  # noqa: E731
    p, boards, dark = at.point, _boards(look), _plain(look, (30, 27, 24), look.material)
    for x in (-1.0, 1.0):
        for y in (-1.0, 1.0):
            beam(quads, p(x * foot, y * foot, -_BELOW_M), p(x * 0.7, y * 0.7, floor), 0.07, boards)
        # Diagonal braces on both sides, and the rails of the ladder.
        beam(quads, p(x * 1.0, -1.0, 0.9), p(x * 0.78, 0.78, 2.6), 0.04, boards)
        beam(quads, p(x * 0.3, -half - 1.3, -_BELOW_M), p(x * 0.3, -half, floor), 0.04, boards)
    for number in range(8):
        rung = 0.4 + 0.36 * number
        y = -half - 1.3 * (1.0 - rung / floor)
        beam(quads, p(-0.3, y, rung), p(0.3, y, rung), 0.025, boards)
    ring = [(-half, -half), (half, -half), (half, half), (-half, half)]
    quads.add([p(x, y, floor) for x, y in reversed(ring)], boards)
    for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
        quads.add([p(*a, floor), p(*b, floor), p(*b, up(b[1])), p(*a, up(a[1]))], boards)
        # An opening, as a dark board just in front of the wall.
        out = np.array([b[1] - a[1], a[0] - b[0]]) / (2.0 * half) * 0.01
        along = np.subtract(b, a)
        (x0, y0), (x1, y1) = (np.add(a, share * along) + out for share in (0.2, 0.8))
        low, top = floor + 0.95, floor + 1.4
        quads.add([p(x0, y0, low), p(x1, y1, low), p(x1, y1, top), p(x0, y0, top)], dark)
    wide = half + 0.25
    ring = [(-wide, -wide), (wide, -wide), (wide, wide), (-wide, wide)]
    roof = [p(x, y, up(y) + 0.06) for x, y in ring]
    below = [(e, n, z - 0.06) for e, n, z in roof]
    felt = _plain(look, (74, 72, 70), "roof_rubber")
    quads.add(roof, felt)
    quads.add(below[::-1], boards)
    for k in range(4):
        quads.add([below[k], below[(k + 1) % 4], roof[(k + 1) % 4], roof[k]], felt)


def beam(
    quads: Quads, low: tuple[float, float, float], high: tuple[float, float, float], half_m: float, paint: Paint
) -> None:
    """Add the four long sides of a square beam between two points [m]."""
    axis = np.subtract(high, low)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 * np.linalg.norm(axis) else [1.0, 0.0, 0.0])
    side *= half_m / np.linalg.norm(side)
    other = np.cross(axis, side)
    other *= half_m / np.linalg.norm(other)
    ring = [-side - other, side - other, side + other, other - side]
    for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
        quads.add([low + a, low + b, high + b, high + a], paint)


def panels(quads: Quads, at: Place, look: Look, half: tuple[float, float], slope: NDArray[np.float64]) -> None:
    """Add solar panels 0.12 m above a plane of height slope · (u, v, 1)."""
    ring = [(-half[0], -half[1]), (half[0], -half[1]), (half[0], half[1]), (-half[0], half[1])]
    corners = []
    for x, y in ring:
        u, v = at.u + x, at.v + y
        corners.append((*at.position(u, v), float(slope @ (u, v, 1.0)) + 0.12))
    cells, frame, glass = look.colour, linear(96, 104, 122), look.value("glass")

    def paint(s: Values, t: Values) -> tuple[Values, int]:
        pitch = np.mod(s * 2.0 * half[0], 1.06) < 0.11
        rows = np.mod(t * 2.0, 1.0) < 0.08
        return np.where((pitch | rows)[..., None], frame, cells), glass

    quads.add(corners, paint)


def _plain(look: Look, colour: tuple[int, int, int], material: str) -> Any:
    tone, number = linear(*colour) * np.exp(look.draw.normal(0.0, 0.05)), look.value(material)
    return lambda s, t: (tone, number)


def _tiles(look: Look) -> Any:
    """A pitched roof: courses, moss and weathering."""
    number, dull = look.value(look.material), look.draw.normal(0.0, 0.08)

    def paint(s: Values, t: Values) -> tuple[Values, int]:
        course = 0.05 * np.cos(2.0 * np.pi * np.arange(len(s))[:, None] / 4.0)
        grain = 0.07 * look.draw.standard_normal(s.shape)
        return look.colour * np.exp(dull + course + grain)[..., None], number

    return paint


def _boards(look: Look) -> Any:
    """Boards of the look's colour and material, side by side."""
    number, dull = look.value(look.material), look.draw.normal(0.0, 0.06)

    def paint(s: Values, t: Values) -> tuple[Values, int]:
        board = 0.1 * look.draw.standard_normal(s.shape[1])
        return look.colour * np.exp(dull + board + 0.05 * look.draw.standard_normal(s.shape))[..., None], number

    return paint


def _felt(look: Look) -> Any:
    """A flat roof: sheets and stains."""
    number, dull = look.value(look.material), look.draw.normal(0.0, 0.2)

    def paint(s: Values, t: Values) -> tuple[Values, int]:
        seam = 0.1 * (np.arange(s.shape[1]) % 12 == 0)
        return look.colour * np.exp(dull + 0.08 * look.draw.standard_normal(s.shape) - seam)[..., None], number

    return paint


def _bars(look: Look) -> Any:
    """Panes of a greenhouse between bars."""
    number, bar = look.value(look.material), linear(206, 210, 208)

    def paint(s: Values, t: Values) -> tuple[Values, int]:
        across = (np.arange(s.shape[1]) % 20 < 1) | np.zeros(s.shape, bool)
        tone = look.colour * np.exp(0.15 * look.draw.standard_normal(s.shape))[..., None]
        return np.where(across[..., None], bar, tone), number

    return paint
