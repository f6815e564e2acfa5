"""Ridge: an eroded mountain crest with rock, scree, snow gullies, alpine grass, spruces and a lake."""

import heapq
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.canvas import Canvas, crowns, plant, scatter, spline
from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import Values, fractal_noise, ridged_noise, smoothstep, warp
from thermorender.apps.lands.procedural.surroundings import Surroundings
from thermorender.scene.spec import WeatherSpec

LATITUDE_DEG = 49.2
WEATHER = WeatherSpec(
    time=np.datetime64("2018-09-17T12:06:00"),
    air_low_c=-3.2,
    air_high_c=6.3,
    humidity=0.89,
    wind_m_s=3.6,
    cloud=0.0,
    snow_depth_m=0.0,
)
# Altitude of the valley [m].
_FOOT_M = 1380.0


def ridge(canvas: Canvas) -> tuple[list[dict[str, Any]], dict[str, NDArray[np.float64]]]:
    """Paint a mountain ridge on the canvas and return (objects, flight)."""
    c = canvas
    ground, drainage = _mountain(c)
    c.ground += ground
    lake = _basin(c)
    rise, run = np.gradient(_smooth(c.ground, 5.0 / c.texel), c.texel)
    slope = np.hypot(rise, run)
    height = c.ground - _FOOT_M
    _alp(c, height, slope)
    _rock(c, height, slope, drainage)
    _snow(c, height, slope, drainage, rise)
    _water(c, lake, drainage)
    _trail(c)
    _wood(c, height, slope, lake)
    return _objects(c, slope, lake), _flight(c)


def around(far: Surroundings) -> None:
    """Shape and paint mountains with woods at their feet, rock and snow."""
    level = float(np.median(far.ground))
    whole = np.maximum(np.abs(far.east), np.abs(far.north)) / far.reach
    crest = 1.0 - np.abs(far.fractal("crest", 3600.0, 6, 0.42))
    rise = (far.skyline - level) * smoothstep(0.15, 0.9, whole)
    mountains = level - 40.0 + rise * (0.75 + 0.55 * crest) + 90.0 * crest * smoothstep(0.0, 0.3, whole)
    share = smoothstep(0.0, 1.0, far.away / (0.45 * far.size))
    far.ground += share * (mountains - far.ground)
    height = far.ground - _FOOT_M
    slope = far.slope()
    beyond = far.beyond(0.12 * far.size)
    hue, fine = far.fractal("hue", 300.0, 7, 0.6), far.fractal("fine", 30.0, 4, 0.7)
    green = smoothstep(-0.6, 0.8, far.fractal("moist", 500.0, 6) + 1.0 - height / 300.0)[..., None]
    alp = linear(138, 130, 94) + green * (linear(110, 118, 70) - linear(138, 130, 94))
    far.paint(beyond, alp * np.exp(0.12 * hue + 0.12 * fine)[..., None], "grass_dry")
    far.material[(beyond > 0.5) & (green[..., 0] > 0.5)] = far.value("grass_green")
    bare = slope - 0.75 + (height - 450.0) / 700.0 + 0.2 * far.fractal("rock", 200.0, 6, 0.6)
    rock = linear(140, 135, 127) * np.exp(0.12 * hue + 0.18 * fine)[..., None]
    far.paint(beyond * smoothstep(-0.1, 0.1, bare), rock, "granite")
    white = (height - 640.0) / 250.0 + 0.5 * far.fractal("snow", 300.0, 6, 0.6) - 0.6 * np.maximum(slope - 0.7, 0.0)
    far.paint(
        beyond * smoothstep(-0.1, 0.1, white), linear(226, 229, 232) * np.exp(0.04 * fine)[..., None], "snow"
    )  # fmt: skip
    line = 250.0 + 60.0 * far.fractal("tree line", 500.0, 5)
    dense = (line - height) / 120.0 - 0.5 * far.fractal("glades", 260.0, 5)
    dense = np.where((bare > 0.0) | (white > 0.0) | (slope > 0.9), -1.0, dense)
    far.woods(dense, 15.0, [(86, 104, 70), (98, 114, 74)], "conifer")


def _smooth(field: Values, sigma: float) -> Values:
    """Return the field smoothed by a Gaussian of `sigma` texels."""
    import cv2

    return cv2.GaussianBlur(field, (0, 0), max(sigma, 0.5))


def _mountain(c: Canvas) -> tuple[Values, Values]:
    """Return (heights, logarithm of drainage area), (N, N) float32: noise eroded by running water."""
    import cv2

    g = c.stream("mountain")
    relief = 0.30 * c.size
    wide = 1.4  # The eroded area is larger than the picture, so that its base level is not visible.
    finest = int(np.clip(wide * c.size / 7.0, 128, 320))
    tilt, phase = g.uniform(0.10, 0.30), g.uniform(0.0, 6.3)
    field: Values | None = None
    for cells, rounds in ((64, 24), (128, 16), (finest, 9)):
        spacing = wide * c.size / cells
        line = wide * ((np.arange(cells) + 0.5) / cells - 0.5)
        x, y = line[None, :], -line[:, None]
        if field is None:
            bend = 0.05 * fractal_noise(g, (cells, cells), 1.0, 26.0, 4)
            away = y - (0.06 + tilt * x + 0.06 * np.sin(5.0 * x + phase)) + bend
            field = relief * np.exp(-(np.abs(away / 0.30) ** 1.4)) * (1.0 + 0.16 * np.sin(7.0 * x + 2.0 * phase))
            field += 0.07 * relief * fractal_noise(g, (cells, cells), 1.0, 16.0, 5)
        else:
            finer = cv2.resize(field.astype(np.float32), (cells, cells), interpolation=cv2.INTER_CUBIC)
            field = finer + 0.012 * relief * fractal_noise(g, (cells, cells), 1.0, 9.0, 4)
        field, area = _carve(np.asarray(field, np.float64), spacing, rounds)
    assert field is not None
    side = round(wide * c.n)
    low = (side - c.n) // 2
    crop = (slice(low, low + c.n), slice(low, low + c.n))
    ground = cv2.resize(field.astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC)[crop]
    drainage = cv2.resize(np.log(area).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC)[crop]
    ground = _smooth(ground - ground.min(), 4.0 / c.texel)
    # The erosion grid is coarser than the picture: add crags and runnels of finer scales, and warp the terrain a little
    # to hide the grid directions.
    bend_x, bend_y = (7.0 / c.texel * c.fractal(f"bend {k}", 90.0, 4) for k in "xy")
    ground, drainage = warp(ground, bend_x, bend_y), warp(drainage, bend_x, bend_y)
    rise, run = np.gradient(_smooth(ground, 8.0 / c.texel), c.texel)
    slope = np.hypot(rise, run)
    steep = smoothstep(0.45, 1.0, slope)
    crag = ridged_noise(c.stream("crag"), c.shape, c.texel, 70.0, 6, 0.55) - 0.5
    ground += (1.0 + 13.0 * steep) * crag + 0.9 * c.fractal("hummock", 45.0, 5)
    return ground + np.float32(_FOOT_M), drainage


def _basin(c: Canvas) -> NDArray[np.bool_]:
    """Excavate a basin in the southern flank; return the lake's mask."""
    g, s = c.stream("basin"), c.size
    flat = _smooth(c.ground, 0.05 * s / c.texel)
    rise, run = np.gradient(flat, c.texel)
    fit = np.hypot(rise, run) + 1.1 * np.hypot(c.east + g.uniform(-0.2, 0.1) * s, c.north + 0.27 * s) / s
    row, column = np.unravel_index(int(np.argmin(fit)), c.shape)
    radius = 0.058 * s
    turn = g.uniform(0.0, np.pi)
    x, y = c.east - c.east[0, column], c.north - c.north[row, 0]
    u, v = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    r = np.hypot(u / 1.5, v) / radius + 0.17 * c.fractal("shore", 1.6 * radius, 6, 0.45)
    level = float(np.quantile(c.ground[r < 1.0], 0.3))
    floor = level + radius * (0.22 * np.maximum(r - 1.0, 0.0) + 0.05 * (r - 1.0))
    blend = smoothstep(2.4, 1.0, r)
    c.ground += blend * (floor - c.ground)
    lake = (c.ground < level) & (r < 1.3)
    c.ground[lake] = level
    return lake


def _carve(height: NDArray[np.float64], spacing: float, rounds: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (heights, drainage area) after `rounds` of stream-power erosion, two (M, M) float64.

    The north and south edges are the base level. Implicit in time after Braun & Willett, Geomorphology
    180–181 (2013) 170, eqs 21–23 with m = 0.5, n = 1; slopes above 44° slide. Depressions are filled first
    (priority flood, Barnes et al., Computers & Geosciences 62 (2014) 117).
    """
    side = height.shape[0]
    strength = 0.011
    for round_ in range(rounds):
        if round_ % 4 == 0:
            height = _flood(height)
        receiver, distance = _receivers(height, spacing)
        order = np.argsort(height, axis=None, kind="stable")
        target, length = receiver.ravel().tolist(), distance.ravel().tolist()
        area = [spacing * spacing] * (side * side)
        upstream = order[::-1].tolist()
        for cell in upstream:
            if target[cell] != cell:
                area[target[cell]] += area[cell]
        flat = height.ravel().tolist()
        for cell in reversed(upstream):
            to = target[cell]
            if to != cell:
                rate = strength * area[cell] ** 0.5 / length[cell]
                carved = (flat[cell] + rate * flat[to]) / (1.0 + rate)
                flat[cell] = min(carved, flat[to] + 0.97 * length[cell])
        height = np.array(flat).reshape(side, side)
    return height, np.array(area).reshape(side, side)


def _receivers(height: NDArray[np.float64], spacing: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return (index of the steepest lower neighbour or of the cell itself, distance to it), (M, M)."""
    side = height.shape[0]
    padded = np.pad(height, 1, constant_values=np.inf)
    best = np.zeros_like(height)
    index = np.arange(side * side).reshape(side, side)
    receiver = index.copy()
    distance = np.full_like(height, spacing)
    for dy, dx in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        length = spacing * np.hypot(dx, dy)
        drop = (height - padded[1 + dy : 1 + dy + side, 1 + dx : 1 + dx + side]) / length
        better = drop > best
        best[better], distance[better] = drop[better], length
        receiver[better] = (index + dy * side + dx)[better]
    receiver[[0, -1]] = index[[0, -1]]
    return receiver, distance


def _flood(height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return heights without depressions: every cell drains to the north or south edge."""
    side = height.shape[0]
    flat = height.ravel().tolist()
    seen = bytearray(side * side)
    edges = (*range(side), *range(side * (side - 1), side * side))
    heap = [(flat[cell], cell) for cell in edges]
    for _, cell in heap:
        seen[cell] = 1
    heapq.heapify(heap)
    while heap:
        level, cell = heapq.heappop(heap)
        row, column = divmod(cell, side)
        for r in range(max(row - 1, 0), min(row + 2, side)):
            for k in range(max(column - 1, 0), min(column + 2, side)):
                other = r * side + k
                if not seen[other]:
                    seen[other] = 1
                    flat[other] = max(flat[other], level + 0.01)
                    heapq.heappush(heap, (flat[other], other))
    return np.array(flat).reshape(side, side)


def _alp(c: Canvas, height: Values, slope: Values) -> None:
    """Paint alpine grass: green in hollows, tawny on slopes, with stones and terraces."""
    fine, tuft = c.grain("fine", 2.0), c.grain("tuft", 5.0)
    hue = c.fractal("hue", 90.0, 7, 0.62)
    tawny = linear(138, 130, 94) * np.exp(0.16 * hue + 0.13 * fine + 0.10 * tuft)[..., None]
    c.paint(np.ones(c.shape, np.float32), tawny, "grass_dry")
    moist = smoothstep(-0.5, 0.9, c.fractal("moist", 120.0, 7, 0.6) + 1.2 - height / 170.0 - 0.8 * slope)
    green = linear(110, 118, 70) * np.exp(0.12 * hue + 0.14 * fine + 0.08 * tuft)[..., None]
    c.paint(moist, green, "grass_green")
    c.wetness += 0.08 * moist
    terrace = np.cos(2 * np.pi * (c.ground / 2.6 + 0.8 * hue)) * smoothstep(0.45, 0.7, slope)
    c.tint(np.exp(0.05 * terrace))
    c.relief += 0.18 * tuft + 0.10 * fine


def _rock(c: Canvas, height: Values, slope: Values, drainage: Values) -> None:
    """Paint granite walls with joints and lichen, limestone bands, and scree below them."""
    rough = c.fractal("rock", 60.0, 7, 0.65)
    fine, block = c.grain("rock fine", 2.0), c.grain("block", 6.0)
    crest = smoothstep(0.55, 0.95, height / max(float(height.max()), 1.0))
    face = slope + 0.16 * rough + 0.34 * crest - float(np.quantile(slope + 0.34 * crest, 0.70))
    scree = smoothstep(-0.38, -0.16, face + 0.10 * block) * smoothstep(
        0.30, 0.5, height / max(float(height.max()), 1.0) + 0.1 * rough
    )
    tone = linear(158, 152, 142) * np.exp(0.10 * rough + 0.16 * fine + 0.12 * block)[..., None]
    c.paint(scree * smoothstep(-0.5, 0.3, rough + 0.5 * block + 0.5), tone, "granite")
    c.relief += scree * (0.30 * block + 0.25 * fine)
    cover = smoothstep(-0.06, 0.10, face + 0.05 * fine)
    joint = ridged_noise(c.stream("joint"), c.shape, c.texel, 34.0, 5, 0.6)
    strata = np.cos(2 * np.pi * (c.ground + 0.22 * c.east + 9.0 * rough) / 17.0)
    grey = linear(132, 128, 122) * np.exp(0.16 * rough + 0.16 * fine + 0.06 * strata + 0.5 * (joint - 0.6))[..., None]
    lichen = smoothstep(0.2, 1.2, c.fractal("lichen", 30.0, 6, 0.65))[..., None]
    grey = grey + 0.5 * lichen * (linear(120, 118, 86) - grey)
    c.paint(cover, grey, "granite")
    band = cover * smoothstep(0.75, 1.0, c.fractal("band", 240.0, 3) + 0.25 * strata)
    c.paint(band, linear(178, 172, 158) * np.exp(0.10 * rough + 0.14 * fine + 0.08 * strata)[..., None], "limestone")
    c.relief += cover * (2.2 * joint + 0.4 * block + 0.35 * fine)
    runnel = smoothstep(7.6, 9.0, drainage + 0.3 * rough) * smoothstep(60.0, 130.0, height)
    gravel = linear(166, 160, 150) * np.exp(0.14 * fine + 0.1 * block)[..., None]
    c.paint(0.8 * runnel * smoothstep(-0.4, 0.4, block + 0.3), gravel, "granite")


def _snow(c: Canvas, height: Values, slope: Values, drainage: Values, rise: Values) -> None:
    """Paint old snow in shaded gullies and hollows, and along the crest."""
    top = max(float(height.max()), 1.0)
    patch = c.fractal("snow", 70.0, 6, 0.55)
    hollow = _smooth(c.ground, 22.0 / c.texel) - _smooth(c.ground, 5.0 / c.texel)
    # `rise` grows to the south where the ground falls to the north.
    shaded = np.tanh(1.6 * rise)
    high = height / top
    depth = 0.16 * hollow + 0.7 * shaded + 6.0 * (high - 0.70) + 0.6 * patch - 1.2 * np.maximum(slope - 0.9, 0.0)
    depth += 0.35 * np.clip(drainage - 7.0, -2.0, 2.5) * smoothstep(0.45, 0.65, high)
    depth = np.where(high < 0.42, depth - 3.0, depth)
    limit = max(1.1, float(np.quantile(depth, 0.93)))
    cover = smoothstep(limit - 0.15, limit + 0.15, depth + 0.09 * c.grain("snow edge", 3.0))
    dirt = c.fractal("dirt", 25.0, 6, 0.6)
    tone = linear(226, 229, 232) * np.exp(0.05 * dirt + 0.025 * c.grain("snow fine", 2.0))[..., None]
    tone *= (1.0 - 0.16 * smoothstep(0.5, 1.8, dirt))[..., None] * np.array([1.0, 0.985, 0.96], np.float32)
    c.relief *= 1.0 - 0.9 * cover
    c.paint(cover, tone, "snow")
    c.ground += 0.8 * cover
    c.wetness *= 1.0 - cover


def _water(c: Canvas, lake: NDArray[np.bool_], drainage: Values) -> None:
    """Paint the lake with its shallows, and the brook that feeds it."""
    import cv2

    fine = c.grain("brook", 2.0)
    brook = smoothstep(9.9, 10.6, drainage + 0.25 * c.fractal("brook bed", 20.0, 4)) * ~lake
    c.paint(0.85 * brook, linear(170, 166, 156) * np.exp(0.15 * fine)[..., None], "granite")
    thread = smoothstep(10.9, 11.4, drainage + 0.1 * fine) * ~lake
    c.paint(0.85 * thread, linear(98, 110, 108), "water")
    near = cv2.distanceTransform((~lake).astype(np.uint8), cv2.DIST_L2, 5) * np.float32(c.texel)
    bank = smoothstep(7.0, 1.0, near + 2.0 * c.fractal("bank", 12.0, 4)) * ~lake
    c.paint(0.8 * bank, linear(164, 158, 146) * np.exp(0.14 * fine)[..., None], "granite")
    c.wetness += 0.25 * bank
    away = cv2.distanceTransform(lake.astype(np.uint8), cv2.DIST_L2, 5) * np.float32(c.texel)
    deep = smoothstep(0.0, 38.0, away + 3.0 * c.fractal("bed", 30.0, 5))[..., None]
    tone = linear(96, 118, 112) + np.sqrt(deep) * (linear(34, 62, 76) - linear(96, 118, 112))
    ripple = np.exp(0.035 * c.fractal("ripple", 9.0, 4) + 0.04 * c.fractal("gust", 120.0, 4))[..., None]
    mask = lake.astype(np.float32)
    c.relief *= 1.0 - mask
    c.wetness *= 1.0 - mask
    c.paint(mask, tone * ripple, "water")


def _trail(c: Canvas) -> None:
    """Paint a footpath that winds from the lake to the crest."""
    s = c.size
    offset, _ = c.ribbon(
        spline(
            [
                (-0.42 * s, -0.38 * s),
                (-0.27 * s, -0.31 * s),
                (-0.16 * s, -0.29 * s),
                (-0.10 * s, -0.2 * s),
                (-0.17 * s, -0.15 * s),
                (-0.08 * s, -0.09 * s),
                (-0.12 * s, -0.03 * s),
                (-0.03 * s, 0.02 * s),
                (-0.06 * s, 0.08 * s),
            ],
            6.0,
        ),
        6.0,
    )
    d = np.where(np.isfinite(offset), np.abs(offset), 99.0) + 0.5 * c.fractal("trail", 12.0, 4)
    dry = (c.material != c.value("water")) & (c.material != c.value("snow"))
    c.paint(0.75 * smoothstep(1.5, 0.6, d) * dry, linear(180, 168, 144))


def _wood(c: Canvas, height: Values, slope: Values, lake: NDArray[np.bool_]) -> None:
    """Plant spruces at the foot, thinning upwards into dwarf pine and single trees."""
    g = c.stream("wood")
    top = max(float(height.max()), 1.0)
    line = 0.34 + 0.07 * c.fractal("tree line", 130.0, 5)
    soil = ~lake & (slope < 0.9) & np.isin(c.material, [c.value("grass_dry"), c.value("grass_green")])
    stand = smoothstep(0.05, -0.07, height / top - line + 0.05 * c.fractal("glade", 60.0, 4))
    gap = smoothstep(1.1, 0.5, c.fractal("gap", 70.0, 4))
    dense = stand * gap * soil
    floor = linear(92, 88, 58) * np.exp(0.2 * c.grain("floor", 4.0))[..., None]
    c.paint(0.8 * smoothstep(0.4, 0.9, dense), floor, "leaf_litter")
    dark = [(86, 104, 70), (98, 114, 74), (78, 96, 66), (110, 118, 78)]
    dwarf = crowns(g, c.texel, 2.6, "broad", 24)
    bush = smoothstep(0.13, 0.03, np.abs(height / top - line - 0.09)) * smoothstep(
        0.1, 0.8, c.fractal("dwarf", 45.0, 5)
    )
    positions = scatter(g, c, 3.6, 0.85 * bush * soil * (slope < 0.85))
    plant(g, c, positions, dwarf, 1.9, [(84, 102, 62), (96, 110, 66)], "conifer", 0.2, 0.3)
    for radius, spacing, height_m, density in (
        (2.5, 4.6, 17.0, 0.93 * dense),
        (1.8, 7.0, 8.0, 0.35 * smoothstep(0.0, 0.4, stand) * soil),
    ):
        trees = crowns(g, c.texel, radius, "spruce", 30)
        plant(g, c, scatter(g, c, spacing, density), trees, height_m, dark, "conifer", 0.2, 0.06)


def _objects(c: Canvas, slope: Values, lake: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """Return a hut and a signal fire on the flattest dry ground near the lake."""
    fit = _smooth(slope + 9.0 * lake + 3.0 * (c.top > 0.5), 10.0 / c.texel)
    fit = fit + 0.7 * np.hypot(c.east + 0.10 * c.size, c.north + 0.2 * c.size) / c.size
    fit = fit + 9.0 * (np.maximum(np.abs(c.east), np.abs(c.north)) > 0.35 * c.size)
    row, column = np.unravel_index(int(np.argmin(fit)), c.shape)
    east, north = round(float(c.east[0, column]), 1), round(float(c.north[row, 0]), 1)
    hut = {
        "name": "hut", "shape": "box", "size": [9.0, 13.0, 6.0], "position": [east, north, -0.5], "yaw_deg": 35.0,
        "temperature": 287.5, "material": "wood", "colour": [112, 84, 62],
    }  # fmt: skip
    fire = {
        "name": "fire", "shape": "disc", "size": [1.6, 1.6, 0.1],
        "position": [round(east + min(14.0, 0.1 * c.size), 1), north - 6.0, 0.1], "temperature": 620.0,
        "heated": True, "material": "soil_dark", "colour": [70, 54, 46],
    }  # fmt: skip
    return [hut, fire]


def _flight(c: Canvas) -> dict[str, NDArray[np.float64]]:
    """Return the glide: descending along the sunny flank, always at least 100 m above the ground."""
    time = np.arange(0.0, 11.01, 0.5)
    speed = min(28.0, 0.5 * c.size / 11.0)
    heading = np.radians(74.0)
    start = np.array([-0.5 * speed * 11.0 - 0.05 * c.size, -0.14 * c.size])
    distance = speed * time
    east = start[0] + distance * np.sin(heading)
    north = start[1] + distance * np.cos(heading) + 6.0 * np.sin(2 * np.pi * time / 11.0)
    ground = np.array([c.height_at(e, n) for e, n in zip(east, north, strict=True)])
    sink = 2.5 * time
    altitude = float(np.max(ground + 118.0 + sink)) - sink
    course = np.degrees(np.arctan2(np.gradient(east), np.gradient(north)))
    return {
        "time_s": time, "east_m": east, "north_m": north, "altitude_m": altitude,
        "yaw_deg": course + 1.2 * np.sin(2 * np.pi * time / 5.0),
        "gimbal_pitch_deg": -38.0 + 1.0 * np.sin(2 * np.pi * time / 4.0),
    }  # fmt: skip
