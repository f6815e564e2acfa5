"""Village: houses and gardens along a street, with sheds, a greenhouse, a pond, trees and parked cars."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.buildings import (
    ROOFS,
    Window,
    car,
    clutter,
    greenhouse,
    house,
    panels,
    street,
)
from thermorender.apps.lands.procedural.canvas import Canvas, Road, crowns, plant, scatter, spline
from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import Values, smoothstep
from thermorender.apps.lands.procedural.surroundings import Surroundings
from thermorender.scene.spec import WeatherSpec

LATITUDE_DEG = 51.9
WEATHER = WeatherSpec(
    time=np.datetime64("2018-09-02T12:30:00"),
    air_low_c=12.4,
    air_high_c=23.9,
    humidity=0.80,
    wind_m_s=2.8,
    cloud=0.0,
    snow_depth_m=0.0,
)
# Positions (east, north) [m] of trees, conifers and shrubs.
_Position = tuple[float, float]
_Plants = tuple[list[_Position], list[_Position], list[_Position]]
_LAWNS = [(118, 132, 74), (108, 126, 66), (136, 140, 86), (126, 132, 82)]
_CARS = [
    ((188, 190, 194), "paint_metallic", 301.0),
    ((36, 38, 42), "paint_black", 309.0),
    ((128, 34, 32), "paint_metallic", 304.0),
    ((64, 78, 104), "paint_metallic", 304.5),
    ((226, 226, 222), "paint_metallic", 299.5),
]


def village(canvas: Canvas) -> tuple[list[dict[str, Any]], dict[str, NDArray[np.float64]]]:
    """Paint a village on the canvas and return (objects, flight)."""
    c, s = canvas, canvas.size
    c.ground += 134.0 + 1.5 * c.fractal("hills", 210.0, 2) + 0.12 * c.fractal("humps", 25.0, 4)
    roads = c.stream("roads")
    bend = roads.normal(0.0, 0.016 * s, 4)
    right, left = s * roads.uniform(0.05, 0.13), s * roads.uniform(-0.23, -0.12)
    tilt = s * roads.uniform(-0.06, 0.06)
    main = spline(
        [
            (-0.6 * s, -0.06 * s + tilt),
            (-0.2 * s, -0.02 * s + bend[0]),
            (0.15 * s, 0.03 * s + bend[1]),
            (0.6 * s, -0.01 * s - 0.5 * tilt),
        ]
    )
    at = lambda x: (x, float(np.interp(x, main[:, 0], main[:, 1])))  # noqa: E731
    north = spline([at(right), (right, 0.2 * s), (right + 0.04 * s + bend[2], 0.38 * s), (right + 0.03 * s, 0.62 * s)])
    south = spline([at(left), (left - 0.02 * s, -0.2 * s), (left + bend[3], -0.38 * s), (left - 0.03 * s, -0.62 * s)])
    fine = c.grain("fine", 0.5)
    soft = c.fractal("soft", 7.0, 5, 0.6)
    _land(c, fine, soft)
    taken = np.zeros(c.shape, bool)
    for points, half in ((north, 2.5), (south, 2.4), (main, 3.1)):
        street(c, points, half, fine, soft, taken)
        c.roads.append(Road(points, half, linear(118, 116, 113), "asphalt"))
    pond = (right - 0.16 * s, (0.16 + roads.uniform(-0.01, 0.06)) * s)
    taken |= np.hypot(c.east - pond[0], c.north - pond[1]) < 19.0
    g = c.stream("plots")
    plants: _Plants = ([], [], [])
    objects: list[dict[str, Any]] = []
    _greenhouse(c, g, fine, taken, at)
    for points, set_back in ((main, 15.5), (north, 14.0), (south, 14.0)):
        for side in (1.0, -1.0):
            _plots(c, g, points, set_back, side, fine, soft, taken, plants, objects)
    _pond(c, pond)
    _parked(c, g, main, objects)
    _green(c, taken, plants)
    return objects, _flight(c, main)


def around(far: Surroundings) -> None:
    """Paint fields, meadows and copses out to wooded hills."""
    far.hills(4.0, 900.0)
    beyond = far.beyond(30.0)
    hue, fine = far.fractal("hue", 90.0, 6, 0.6), far.fractal("fine", 8.0, 3, 0.7)
    far.paint(beyond, linear(126, 134, 82) * np.exp(0.12 * hue + 0.12 * fine)[..., None], "grass_green")
    number, border = far.plots("fields", 300.0, 85.0)
    kinds = far.stream("far crops").integers(0, 6, number.max() + 1)[number]
    inside = beyond * smoothstep(0.5, 2.5, border)
    for index, (colour, material) in enumerate(
        [((192, 174, 130), "grass_dry"), ((122, 98, 76), "soil_loam"), ((104, 128, 64), "grass_green"),
         ((176, 164, 116), "grass_dry")]
    ):  # fmt: skip
        tone = linear(*colour) * np.exp(0.07 * hue + 0.06 * fine)[..., None]
        far.paint(inside * (kinds == index), tone, material)
    hedge = beyond * smoothstep(4.0, 2.0, border) * (number % 3 == 0)
    far.paint(hedge, linear(92, 108, 60) * np.exp(0.2 * fine)[..., None], "broadleaf")
    far.continue_roads()
    sparse = far.fractal("woods", 900.0, 5, 0.5) + 0.2 * far.fractal("edges", 60.0, 4)
    whole = np.maximum(np.abs(far.east), np.abs(far.north)) / far.reach
    far.woods(sparse - 0.9 + 1.0 * whole, 13.0, [(104, 120, 66), (96, 112, 66)], "broadleaf")


def _land(c: Canvas, fine: Values, soft: Values) -> None:
    """Paint meadow everywhere, a stubble field and a ploughed field beyond the gardens."""
    s = c.size
    growth = c.fractal("growth", 45.0, 7, 0.6)
    tuft = c.grain("tuft", 1.3)
    meadow = linear(126, 134, 82) * np.exp(0.14 * growth + 0.12 * fine + 0.07 * tuft)[..., None]
    c.paint(np.ones(c.shape, np.float32), meadow, "grass_green")
    c.relief += 0.03 * tuft + 0.02 * fine
    dry = smoothstep(0.3, 1.2, growth + 0.4 * soft)
    c.paint(0.8 * dry, linear(164, 154, 110) * np.exp(0.1 * fine + 0.06 * tuft)[..., None], "grass_dry")
    wobble = 0.6 * c.fractal("border", 25.0, 4)
    drift = 0.3 * c.fractal("drift", 60.0, 3)
    edge = 0.36 * s
    for index, (distance, line, colour, pitch, material, ridge) in enumerate(
        [
            (
                -c.east * 0.97 + c.north * 0.25 - edge + wobble,
                c.east * 0.97 - c.north * 0.25,
                (192, 174, 130),
                1.0,
                "grass_dry",
                0.03,
            ),
            (
                c.east * 0.95 - c.north * 0.31 - edge + wobble,
                c.east * 0.95 - c.north * 0.31,
                (122, 98, 76),
                1.25,
                "soil_loam",
                0.06,
            ),
        ]
    ):
        cover = smoothstep(0.0, 0.8, distance + 0.3 * soft)
        row = np.cos(2 * np.pi * (line + drift) / pitch)
        tram = np.exp(-(((np.abs(np.mod(line + drift, 18.0) - 9.0) - 0.9) / 0.25) ** 2))
        tone = linear(*colour) * np.exp(0.10 * growth + 0.08 * row + 0.10 * fine + 0.04 * tuft - 0.2 * tram)[..., None]
        c.paint(cover, tone, material)
        c.relief += cover * ridge * row
        if index:
            c.wetness += 0.15 * cover * smoothstep(-0.5, 1.0, growth)


def _plots(
    c: Canvas, g: np.random.Generator, points: Values, set_back: float, side: float, fine: Values, soft: Values,
    taken: NDArray[np.bool_], plants: _Plants, objects: list[dict[str, Any]],
) -> None:  # fmt: skip
    """Lay out houses and gardens along one side of a street wherever there is room."""
    leg = np.hypot(*np.diff(points, axis=0).T)
    length = np.concatenate([[0.0], np.cumsum(leg)])
    where = g.uniform(4.0, 12.0)
    while where < length[-1] - 6.0:
        width = g.uniform(20.0, 27.0)
        middle = where + 0.5 * width
        where += width
        index = int(np.clip(np.searchsorted(length, middle) - 1, 0, len(leg) - 1))
        p = points[index] + (points[index + 1] - points[index]) * (middle - length[index]) / leg[index]
        course = np.degrees(np.arctan2(*(points[index + 1] - points[index])))
        heading = course + 90.0 * side
        window = Window(c, p[0], p[1], heading, 46.0)
        if window.u.size == 0 or not c.inside(*window.position(0.0, set_back), -8.0):
            continue
        depth = g.uniform(32.0, 42.0)
        room = (np.abs(window.u) < 0.5 * width - 1.0) & (window.v > set_back - 6.0) & (window.v < set_back + 9.0)
        if not room.any() or window.view(taken)[room].any():
            continue
        plot = (np.abs(window.u) < 0.5 * width) & (window.v > 0.0) & (window.v < depth)
        free = ~window.view(taken)
        _garden(window, g, width, depth, set_back, fine, soft, free)
        _house(window, g, width, set_back, fine, objects)
        _planting(window, g, width, depth, set_back, plants, free)
        window.view(taken)[plot] = True


def _garden(
    window: Window, g: np.random.Generator, width: float, depth: float, set_back: float, fine: Values, soft: Values,
    free: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Paint lawn, drive, terrace, beds and hedges of a plot."""
    c = window.canvas
    near = 5.0
    grain, blotch = window.view(fine), window.view(soft)
    lawn = window.box(0.0, 0.5 * (depth + near), 0.5 * width - 0.4, 0.5 * (depth - near)) * free
    tint = linear(*_LAWNS[g.integers(len(_LAWNS))])
    stripes = 0.035 * np.sign(np.cos(2 * np.pi * window.u / g.uniform(2.0, 3.0))) * (g.uniform() < 0.3)
    c_relief = window.view(c.relief)
    c_relief *= 1.0 - 0.6 * lawn
    window.paint(lawn, tint * np.exp(0.09 * grain + 0.13 * blotch + stripes)[..., None], "grass_green")
    dryness = g.uniform(0.3, 1.4)
    window.paint(
        0.7 * lawn * smoothstep(dryness, dryness + 0.7, blotch),
        linear(162, 152, 108) * np.exp(0.1 * grain)[..., None],
        "grass_dry",
    )
    drive_u = (0.5 * width - 2.9) * (1 if g.uniform() < 0.5 else -1)
    drive = window.box(drive_u, 0.5 * (set_back + 3.0), 1.7, 0.5 * (set_back + 1.5)) * (window.v > 3.0) * free
    slab = [(160, 154, 144), (142, 126, 114), (128, 124, 120)][g.integers(3)]
    joint = 0.05 * ((np.mod(window.u, 0.8) < 0.2) ^ (np.mod(window.v, 0.8) < 0.2))
    window.paint(drive, linear(*slab) * np.exp(0.08 * grain - joint + 0.06 * blotch)[..., None], "concrete")
    terrace = window.box(g.uniform(-2, 2), set_back + 7.0, 3.2, 2.2) * free
    window.paint(terrace, linear(178, 168, 150) * np.exp(0.07 * grain - joint)[..., None], "concrete")
    path = window.box(drive_u * -0.2, 0.5 * set_back, 0.6, 0.5 * set_back - 2.0) * (window.v > 4.5) * free
    window.paint(path, linear(172, 164, 150) * np.exp(0.08 * grain)[..., None], "concrete")
    if g.uniform() < 0.55:
        u, v = g.uniform(-0.2, 0.2) * width, depth - 6.0
        half = (g.uniform(2.5, 4.5), g.uniform(1.8, 3.0))
        bed = window.box(u, v, *half, soft=0.25) * free
        rows = np.cos(2 * np.pi * window.u / 1.1)
        leaf = smoothstep(0.0, 0.8, rows + 0.5 * grain)[..., None]
        window.paint(bed, linear(116, 94, 72) * (1 - leaf) + leaf * linear(96, 118, 60), "soil_dark")
        window.view(c.wetness)[...] += 0.2 * bed
        part = window.view(c.top)
        part += 0.25 * bed * leaf[..., 0]
    clutter(window, g, width, set_back + 7.0, depth, free)
    bump = 0.55 * grain + 0.6 * blotch
    for u, v, half_u, half_v, kind in (
        (-0.5 * width, 0.5 * (depth + near), 0.55, 0.5 * (depth - near), 0.45),
        (0.5 * width, 0.5 * (depth + near), 0.55, 0.5 * (depth - near), 0.45),
        (0.0, depth, 0.5 * width, 0.7, 0.7),
    ):
        if g.uniform() > kind:
            fence = (
                window.box(u, v, min(half_u, 0.5 * width), half_v, 0.05)
                * ((np.abs(window.u - u) < 0.12) if half_u < 1 else (np.abs(window.v - v) < 0.12))
                * free
            )
            if c.solids and (fence > 0.5).any():
                across = (0.03, half_v) if half_u < 1 else (half_u, 0.03)
                c.solids.box(window, fence > 0.5, u, v, across, 1.0, linear(150, 132, 110), "wood")
            window.paint(0.8 * fence, linear(150, 132, 110), "wood")
            continue
        d = np.minimum(half_u - np.abs(window.u - u), half_v - np.abs(window.v - v)) + 0.16 * bump
        hedge = (d > 0.0) & free
        high = (g.uniform(1.3, 2.2) * (0.8 + 0.4 * np.minimum(d, 0.5) + 0.09 * bump))[hedge]
        leaf = (linear(98, 116, 66) * np.exp(0.22 * bump)[..., None])[hedge]
        if c.solids:
            c.solids.hedge(window, hedge, high, leaf)
        window.view(c.top)[hedge], window.view(c.albedo)[hedge] = high, leaf
        window.view(c.material)[hedge] = c.value("broadleaf")


def _house(
    window: Window, g: np.random.Generator, width: float, set_back: float, fine: Values, objects: list[dict[str, Any]]
) -> None:
    """Build a house with its wing or garage, chimney, panels, shed, and a car on the drive."""
    c = window.canvas
    half_u, half_v = min(0.5 * width - 5.2, g.uniform(5.0, 6.6)), g.uniform(4.0, 4.9)
    roof = ROOFS[g.integers(len(ROOFS) - 1)] if g.uniform() < 0.9 else ROOFS[-1]
    wall, pitch = g.uniform(3.0, 5.6), g.uniform(32.0, 44.0)
    g.uniform()  # Unused draw that keeps the following houses unchanged.
    hip = g.uniform() < 0.3
    turned = g.uniform() < 0.4
    frame = window
    u0, v0 = g.uniform(-1.0, 1.0), set_back
    if turned:
        east, north = window.position(u0, v0)
        frame = Window(c, east, north, window.heading + 90.0, 16.0)
        u0 = v0 = 0.0
        half_u, half_v = half_u * 1.05, half_v * 0.95
    house(frame, fine, g, u0, v0, half_u, half_v, wall, roof, pitch, hip)
    if g.uniform() < 0.35 and roof[2]:
        east, north = frame.position(u0 + g.choice([-0.4, 0.4]) * half_u, v0 + 0.75 * half_v)
        wing = Window(c, east, north, frame.heading + 90.0, 14.0)
        house(wing, fine, g, 0.0, 0.0, 0.6 * half_v + 1.0, 0.40 * half_u, wall - 0.3, roof, pitch)
    # Panels are on the slope that faces south most.
    facing = np.cos(np.radians(frame.heading - 180.0))
    if roof[2] and not hip and abs(facing) > 0.45 and g.uniform() < 0.5:
        columns = int(g.integers(4, 1 + int(1.6 * half_u)))
        lean = float(np.cos(np.radians(pitch)))
        panels(frame, u0 + g.uniform(-0.6, 0.6), v0 + np.sign(facing) * 0.52 * half_v, columns, 2, lean)
    side = 1 if g.uniform() < 0.5 else -1
    if g.uniform() < 0.5:
        house(window, fine, g, side * (0.5 * width - 2.6), set_back + g.uniform(-1, 5), 2.0, 3.2, 2.6, ROOFS[-1])
    if g.uniform() < 0.55:
        u, v = g.uniform(-0.3, 0.3) * width, set_back + g.uniform(14.0, 19.0)
        if not (window.view(c.top)[(np.abs(window.u - u) < 2.5) & (np.abs(window.v - v) < 2.5)] > 1.2).any():
            shed = ("roof_shingle", (124, 104, 84), True)
            house(window, fine, g, u, v, g.uniform(1.4, 2.4), g.uniform(1.1, 1.7), 2.0, shed, 22.0)
    if g.uniform() < 0.5 and len(objects) < 4 * 9:
        colour, material, temperature = _CARS[g.integers(len(_CARS))]
        for u in ((0.5 * width - 2.9), -(0.5 * width - 2.9)):
            east, north = window.position(u, 6.6)
            row, column = (int(np.clip(k, 0, c.n - 1)) for k in c.texels(east, north))
            if c.inside(east, north, 4.0) and c.material[row, column] == c.value("concrete"):
                bonnet = temperature + (g.uniform(8.0, 20.0) if g.uniform() < 0.4 else 1.5)
                objects += car(
                    f"car_{len(objects) // 4}", east, north, window.heading, colour, material, temperature, bonnet
                )
                break


def _planting(
    window: Window, g: np.random.Generator, width: float, depth: float, set_back: float, plants: _Plants,
    free: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Choose positions of the garden's trees and shrubs."""
    trees, conifers, shrubs = plants
    c = window.canvas
    for _ in range(int(g.integers(9, 20))):
        u, v = g.uniform(-0.46, 0.46) * width, g.uniform(set_back + 8.0, depth - 1.0)
        if g.uniform() < 0.25:
            v = g.uniform(7.5, set_back - 6.0)
        hit = (np.abs(window.u - u) < 1.6) & (np.abs(window.v - v) < 1.6)
        if not hit.any() or (window.view(c.top)[hit] > 2.3).any() or not free[hit].all():
            continue
        kind = g.uniform()
        (shrubs if kind < 0.45 or v < set_back else trees if kind < 0.85 else conifers).append(window.position(u, v))


def _greenhouse(
    c: Canvas, g: np.random.Generator, fine: Values, taken: NDArray[np.bool_], at: Callable[[float], _Position]
) -> None:
    """Build a nursery with greenhouses and a flat-roofed hall south-east of the crossing."""
    s = c.size
    x, y = at(0.23 * s)
    window = Window(c, x, y - 0.155 * s, 8.0, 40.0)
    yard = window.box(2.0, 0.0, 25.0, 17.0, 0.6)
    soft = window.view(fine)
    window.level(yard)
    window.paint(yard, linear(158, 148, 130) * np.exp(0.12 * soft)[..., None], "soil_loam")
    lane = window.box(-4.0, 0.09 * s, 2.2, 0.10 * s) * ~window.view(taken)
    window.paint(lane, linear(164, 154, 138) * np.exp(0.1 * soft)[..., None], "soil_loam")
    greenhouse(window, fine, -11.0, 0.0, 9.6, 13.0, 3)
    hall = ("roof_rubber", (128, 126, 122), False)
    house(window, fine, g, 15.0, 4.0, 8.0, 10.0, 5.5, hall)
    panels(window, 15.0, 7.5, 12, 2, 0.9)
    panels(window, 15.0, 1.0, 12, 2, 0.9)
    window.view(taken)[window.box(2.0, 0.0, 26.0, 18.0) > 0.5] = True
    window.view(taken)[lane > 0.5] = True


def _pond(c: Canvas, centre: tuple[float, float]) -> None:
    """Paint the village pond: reeds, muddy rim, dark water."""
    wobble = 1.5 * c.fractal("pond", 18.0, 5, 0.5)
    r = np.hypot((c.east - centre[0]) / 1.35, c.north - centre[1]) + wobble
    grain = c.grain("reed", 1.1)
    rim = smoothstep(15.0, 10.5, r + grain)
    c.paint(rim, linear(108, 122, 66) * np.exp(0.2 * grain)[..., None], "grass_green")
    c.wetness += 0.4 * rim
    c.top += rim * np.clip(0.5 + 0.35 * grain, 0, 2) * smoothstep(0.0, 1.0, c.fractal("reeds", 9.0, 3))
    water = smoothstep(9.4, 9.0, r)
    level = c.height_at(*centre) - 0.8
    c.ground += smoothstep(14.0, 9.0, r) * (level - c.ground)
    for field in (c.top, c.relief):
        field *= 1.0 - water
    tone = linear(58, 66, 50) + smoothstep(9.0, 4.0, r)[..., None] * (linear(40, 48, 44) - linear(58, 66, 50))
    weed = smoothstep(0.9, 1.4, c.fractal("weed", 7.0, 5, 0.6))[..., None]
    c.paint(water, (tone + 0.5 * weed * (linear(92, 110, 56) - tone)) * np.exp(0.05 * grain)[..., None], "water")


def _parked(c: Canvas, g: np.random.Generator, main: Values, objects: list[dict[str, Any]]) -> None:
    """Park cars at the kerb of the main street, one of them with a warm bonnet."""
    course = np.degrees(np.arctan2(np.gradient(main[:, 0]), np.gradient(main[:, 1])))
    for index, east in enumerate(np.array([-0.24, -0.09, 0.02, 0.19]) * c.size + g.normal(0, 3.0, 4)):
        k = int(np.argmin(np.abs(main[:, 0] - east)))
        side = -1.0 if index % 2 else 1.0
        right = np.radians(course[k] + 90.0)
        p = main[k] + side * 2.05 * np.array([np.sin(right), np.cos(right)])
        colour, material, temperature = _CARS[g.integers(len(_CARS))]
        if c.inside(p[0], p[1], 4.0):
            heading = course[k] + (180.0 if side < 0 else 0.0)
            bonnet = temperature + (22.0 if index == 1 else 2.0)
            objects += car(f"car_{len(objects) // 4}", p[0], p[1], heading, colour, material, temperature, bonnet)


def _green(c: Canvas, taken: NDArray[np.bool_], plants: _Plants) -> None:
    """Plant the gardens' trees, a copse and an orchard on free land, and shrubs by the pond."""
    g = c.stream("green")
    trees, conifers, shrubs = (np.array(p).reshape(-1, 2) for p in plants)
    leaf = [(114, 130, 72), (126, 138, 78), (104, 120, 66), (134, 134, 76)]
    dark = [(84, 104, 70), (94, 112, 74)]
    large, small, bush = (crowns(g, c.texel, r, "broad", n) for r, n in ((3.1, 16), (2.0, 20), (0.8, 16)))
    spruce = crowns(g, c.texel, 1.9, "spruce", 14)
    plant(g, c, shrubs, bush, 1.5, leaf, "broadleaf", 0.3)
    plant(g, c, trees[::2], large, 8.0, leaf, "broadleaf", 0.25)
    plant(g, c, trees[1::2], small, 5.0, leaf, "broadleaf", 0.3)
    plant(g, c, conifers, spruce, 10.0, dark, "conifer", 0.3, 0.08)
    free = ~taken & (c.material != c.value("soil_loam")) & (c.material != c.value("water"))
    meadow = free & (np.abs(c.east) < 0.34 * c.size)
    wild = smoothstep(0.7, 1.5, c.fractal("wild", 50.0, 4)) * meadow
    plant(g, c, scatter(g, c, 5.2, 0.8 * wild), large, 10.5, leaf, "broadleaf", 0.22)
    plant(g, c, scatter(g, c, 5.0, 0.08 * meadow), bush, 1.6, leaf, "broadleaf", 0.35)
    strip = free & (np.abs(np.abs(c.east) - 0.355 * c.size) < 3.5)
    plant(g, c, scatter(g, c, 3.4, 0.5 * strip), small, 5.5, leaf, "broadleaf", 0.35)


def _flight(c: Canvas, main: Values) -> dict[str, NDArray[np.float64]]:
    """Return the flight: 80 m above the main street, along it, looking ahead and down."""
    time = np.arange(0.0, 11.01, 0.5)
    speed = min(10.0, 0.5 * c.size / 11.0)
    east = -0.22 * c.size + speed * time
    north = np.interp(east, main[:, 0], main[:, 1])
    course = np.degrees(np.arctan2(np.gradient(east), np.gradient(north)))
    base = c.height_at(0.0, float(np.interp(0.0, main[:, 0], main[:, 1])))
    altitude = base + 80.0 + 0.5 * np.sin(2 * np.pi * time / 6.0)
    pitch = -58.0 - 22.0 * smoothstep(0.0, 11.0, time) + 0.6 * np.sin(2 * np.pi * time / 3.3)
    return {
        "time_s": time, "east_m": east, "north_m": north, "altitude_m": altitude,
        "yaw_deg": course + 1.5 * np.sin(2 * np.pi * time / 8.0), "gimbal_pitch_deg": pitch,
    }  # fmt: skip
