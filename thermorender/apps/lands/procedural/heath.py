"""Heath: the landscape of the FOK rocket flights, with heather, sand, tracks, pine forest, fields and a road."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.buildings import Window
from thermorender.apps.lands.procedural.buildings import car as vehicle
from thermorender.apps.lands.procedural.canvas import Canvas, Road, crowns, plant, planted_rows, ruts, scatter, spline
from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import Values, smoothstep
from thermorender.apps.lands.procedural.surroundings import Surroundings
from thermorender.scene.spec import WeatherSpec

LATITUDE_DEG = 52.2
WEATHER = WeatherSpec(
    time=np.datetime64("2018-09-12T12:44:00"),
    air_low_c=10.3,
    air_high_c=22.3,
    humidity=0.84,
    wind_m_s=3.0,
    cloud=0.0,
    snow_depth_m=0.0,
)
MARKER = (4.0, 6.0)  # east, north [m]


def heath(canvas: Canvas) -> tuple[list[dict[str, Any]], dict[str, NDArray[np.float64]]]:
    """Paint a heath on the canvas and return (objects, flight)."""
    c, s = canvas, canvas.size
    c.ground += 112.0 + 1.9 * c.fractal("hills", 190.0, 3) + 0.45 * c.fractal("humps", 45.0, 4)
    edge = 8.0 * c.fractal("edge", 55.0, 6, 0.55)
    g = c.stream("layout")
    shift, bow = s * g.uniform(-0.02, 0.02), s * g.normal(0.0, 0.012, 4)
    road = spline(
        [
            (-0.6 * s, -0.335 * s + shift + bow[0]),
            (-0.2 * s, -0.30 * s + shift + bow[1]),
            (0.2 * s, -0.315 * s + shift + bow[2]),
            (0.6 * s, -0.27 * s + shift + bow[3]),
        ]
    )
    offset_road, along_road = c.ribbon(road, 14.0)
    road_north = np.interp(c.east[0], road[:, 0], road[:, 1]).astype(np.float32)[None, :]
    south = road_north - c.north  # distance south of the road's line
    sway = s * g.normal(0.0, 0.022, 4)
    foot = -0.07 * s + sway[0]
    track = spline(
        [
            (foot, float(np.interp(foot, road[:, 0], road[:, 1]))),
            (-0.055 * s + 0.6 * sway[0], -0.2 * s),
            (-0.015 * s + 0.4 * sway[1], -0.08 * s),
            (-0.014 * s, 0.06 * s),
            (0.03 * s + sway[2], 0.2 * s),
            (0.035 * s + sway[2] + sway[3], 0.6 * s),
        ]
    )
    c.roads.append(Road(road, 3.0, linear(124, 121, 117), "asphalt"))
    c.roads.append(Road(track, 1.6, linear(204, 184, 148), "sand_quartz"))
    _moor(c)
    west, east = np.radians(135.0 + g.uniform(-14.0, 14.0)), np.radians(42.0 + g.uniform(-14.0, 14.0))
    far = s * (0.275 + g.uniform(-0.02, 0.05)), s * (0.315 + g.uniform(-0.02, 0.05))
    pines = 1.6 * edge + np.maximum(
        np.cos(west) * c.east + np.sin(west) * c.north - far[0], np.cos(east) * c.east + np.sin(east) * c.north - far[1]
    )
    sand = _sand(c, track, pines, south)
    _pool(c)
    _fields(c, south, edge)
    _road(c, offset_road, along_road)
    _tracks(c, track, sand)
    _trees(c, pines, south, track, sand)
    _clearing(c)
    if c.solids:
        _hide(c, pines, track)
    return _objects(c, track), _flight(c)


def around(far: Surroundings) -> None:
    """Paint heath, pine woods and fields out to wooded hills."""
    far.hills(5.0, 800.0)
    beyond = far.beyond(45.0)
    hue, fine = far.fractal("hue", 90.0, 6, 0.6), far.fractal("fine", 8.0, 3, 0.7)
    heather = smoothstep(-0.5, 0.3, far.fractal("patch", 110.0, 6, 0.6))[..., None]
    moor = linear(166, 150, 112) + heather * (linear(100, 84, 68) - linear(166, 150, 112))
    far.paint(beyond, moor * np.exp(0.10 * hue + 0.14 * fine)[..., None], "grass_dry")
    far.material[(beyond > 0.5) & (heather[..., 0] > 0.5)] = far.value("heath_shrub")
    south = smoothstep(-0.2, 0.2, far.fractal("farmland", 1900.0, 4) - 1.1 * np.tanh(far.north / 500.0) - 0.2)
    number, border = far.plots("fields", 330.0, 95.0)
    kinds = far.stream("far crops").integers(0, 3, number.max() + 1)[number]
    for index, (colour, material) in enumerate(
        [((190, 171, 128), "grass_dry"), ((124, 98, 74), "soil_dark"), ((104, 124, 62), "grass_green")]
    ):
        tone = linear(*colour) * np.exp(0.08 * hue + 0.07 * fine)[..., None]
        far.paint(beyond * (south > 0.5) * (kinds == index) * smoothstep(0.5, 2.5, border), tone, material)
    far.continue_roads()
    sparse = far.fractal("woods", 700.0, 5, 0.5) + 0.25 * far.fractal("edges", 60.0, 4) - 0.9 * (south - 0.5)
    far.woods(sparse + 0.25, 13.0, [(104, 114, 70), (112, 122, 74)], "conifer")


def _moor(c: Canvas) -> None:
    """Paint heather, grass and moss in patches, with raised cushions."""
    patch = c.fractal("patch", 34.0, 7, 0.62)
    clump = c.grain("clump", 2.4) + 0.7 * c.grain("clump small", 1.1)
    fine = c.grain("fine", 0.5)
    hue = c.fractal("hue", 22.0, 6, 0.6)
    dry = linear(166, 150, 112) * np.exp(0.13 * hue + 0.13 * fine + 0.10 * clump)[..., None]
    c.paint(np.ones(c.shape, np.float32), dry, "grass_dry")
    moss = smoothstep(0.15, 0.9, c.fractal("moss", 28.0, 7, 0.62) + 0.3 * clump)
    green = linear(112, 116, 68) * np.exp(0.12 * fine + 0.10 * hue)[..., None]
    c.paint(0.85 * moss, green, "grass_green")
    heather = smoothstep(-0.25, 0.35, patch + 0.55 * clump)
    purple = 0.5 + 0.5 * np.tanh(1.2 * c.fractal("bloom", 18.0, 6, 0.6))
    tone = linear(94, 82, 62) + purple[..., None] * (linear(112, 88, 84) - linear(94, 82, 62))
    c.paint(heather, tone * np.exp(0.22 * fine + 0.16 * clump + 0.12 * hue)[..., None], "heath_shrub")
    c.relief += heather * (0.12 * clump + 0.04 * fine) + 0.02 * fine
    c.top += heather * np.clip(0.25 + 0.1 * clump, 0.0, 0.6)


def _sand(c: Canvas, track: Values, pines: Values, south: Values) -> Values:
    """Paint open sand in blow-outs and along the track; return its coverage."""
    offset, _ = c.ribbon(track, 30.0)
    near = np.where(np.isfinite(offset), 1.5 * np.exp(-((offset / 9.0) ** 2)), 0.0)
    at_marker = 1.9 * np.exp(-((c.east - MARKER[0]) ** 2 + (c.north - MARKER[1]) ** 2) / 13.0**2)
    dug = c.fractal("sand", 62.0, 7, 0.6) + near + at_marker - 1.45
    field = dug + 0.35 * c.fractal("tufts", 2.2, 3, 0.7)
    cover = smoothstep(-0.12, 0.22, np.where(pines > -4.0, field - 1.5, field))
    ripple = c.grain("ripple", 1.0) * 0.35 + c.grain("sand fine", 0.5) * 0.4 + c.fractal("sand hue", 14.0, 5, 0.6)
    colour = linear(208, 188, 150) * np.exp(0.085 * ripple)[..., None]
    c.relief *= 1.0 - 0.85 * cover
    c.top *= 1.0 - cover
    c.paint(cover, colour, "sand_quartz")
    damp = smoothstep(0.7, 1.6, -c.fractal("damp", 30.0, 5)) * cover
    c.tint(1.0 - 0.22 * damp)
    c.wetness += 0.3 * damp
    c.ground -= 0.7 * smoothstep(0.0, 1.2, dug) * smoothstep(-12.0, -25.0, south)
    return cover


def _pool(c: Canvas) -> None:
    """Paint a small boggy pool with a green fringe."""
    g = c.stream("pool")
    east, north = g.uniform(-0.25, -0.15) * c.size, g.uniform(-0.10, -0.02) * c.size
    wobble = 2.6 * c.fractal("pool", 16.0, 5, 0.55)
    r = np.hypot((c.east - east) / 1.5, c.north - north) + wobble
    fringe = smoothstep(17.0, 11.0, r) * (0.75 + 0.25 * np.tanh(c.grain("reed", 1.2)))
    reed = linear(104, 122, 58) * np.exp(0.2 * c.grain("reed fine", 0.6))[..., None]
    c.paint(np.clip(fringe, 0, 1), reed, "grass_green")
    c.wetness += 0.45 * np.clip(fringe, 0, 1)
    c.top = c.top * (1 - fringe) + 0.5 * fringe * (1 + 0.4 * c.grain("reed top", 0.8))
    water = smoothstep(9.2, 8.4, r)
    level = c.height_at(east, north) - 0.9
    c.ground += smoothstep(20.0, 8.0, r) * (level - c.ground)
    for field in (c.top, c.relief):
        field *= 1.0 - water
    deep = linear(42, 46, 36) + smoothstep(8.5, 4.0, r)[..., None] * (linear(30, 34, 32) - linear(42, 46, 36))
    c.paint(water, deep * np.exp(0.06 * c.fractal("film", 6.0, 4))[..., None], "water")


def _fields(c: Canvas, south: Values, edge: Values) -> None:
    """Paint stubble, ploughed soil and young winter cereal south of the road, separated by grass strips."""
    half = 0.5 * c.size
    within = smoothstep(11.0, 12.5, south + 0.12 * edge)
    g = c.stream("fields")
    lean = g.uniform(-0.06, 0.24)
    across = c.east + lean * c.north + 0.05 * edge  # borders run nearly north, not quite straight
    borders = np.array([-0.16, 0.14]) * c.size + g.uniform(-0.06, 0.06, 2) * c.size
    number = np.digitize(across, borders)
    gap = np.min([np.abs(across - b) for b in borders], axis=0)
    inside = within * smoothstep(1.2, 1.8, gap + 0.35 * c.fractal("balk", 3.0, 3))
    growth = c.fractal("growth", 48.0, 7, 0.6)
    fine = c.grain("field fine", 0.5)
    soft = c.grain("field soft", 1.6)
    # Rows follow the border; on headlands along the road they turn.
    headland = south < 25.0
    drift = 0.35 * c.fractal("row drift", 60.0, 3)
    line = np.where(headland, south + drift, across + drift)
    rows = lambda pitch, phase=0.0: np.cos(2 * np.pi * (line / pitch + phase))  # noqa: E731
    pair = np.abs(np.mod(line, 21.0) - 10.5)
    tram = np.exp(-(((pair - 0.95) / 0.32) ** 2)) * (0.75 + 0.25 * soft)

    stubble = (
        linear(190, 171, 128)
        * np.exp(0.09 * growth + 0.07 * rows(1.0) + 0.05 * rows(6.3, 0.2) + 0.08 * fine + 0.03 * soft)[..., None]
    )
    stubble *= (1.0 - 0.34 * tram)[..., None]
    soil = (
        linear(124, 98, 74)
        * np.exp(0.13 * growth + 0.10 * rows(1.25) + 0.05 * rows(3.9, 0.4) + 0.13 * fine + 0.10 * soft)[..., None]
    )
    bare = np.clip(0.28 + 0.18 * growth + 0.1 * soft, 0.03, 0.9)
    bare = np.clip(bare + 0.28 * rows(0.75) * 0.6 + 0.7 * tram, 0.0, 1.0)[..., None]
    leaf = linear(92, 122, 56) * np.exp(0.10 * growth + 0.12 * fine)[..., None]
    crop = bare * linear(138, 114, 86) + (1.0 - bare) * leaf
    verge = linear(120, 124, 72) * np.exp(0.15 * growth + 0.18 * fine + 0.12 * soft)[..., None]
    south_side = smoothstep(6.0, 7.5, south + 0.2 * edge)
    c.relief *= 1.0 - south_side
    c.top *= 1.0 - south_side
    c.paint(south_side, verge, "grass_green")
    c.relief += south_side * 0.05 * soft
    for index, (colour, material, ridge) in enumerate(
        [(stubble, "grass_dry", 0.025), (soil, "soil_dark", 0.06), (crop, "grass_green", 0.02)]
    ):
        cover = inside * (number == index)
        c.paint(cover, colour, material)
        c.relief += cover * ridge * (rows(1.25 if index == 1 else 1.0) + 0.3 * soft)
        if index == 2:
            c.material[(cover > 0.5) & (bare[..., 0] > 0.6)] = c.value("soil_loam")
        if index == 1:
            fresh = smoothstep(-0.1, 0.1, across + 0.03 * half + 1.2 * c.fractal("plough", 8.0, 3))
            c.tint(1.0 - 0.20 * fresh * cover)
            c.wetness += 0.22 * fresh * cover


def _road(c: Canvas, offset: Values, along: Values) -> None:
    """Paint an asphalt road with worn lanes, patches, broken lines and gravel edges."""
    near = np.isfinite(offset)
    d = np.where(near, np.abs(offset), 99.0) + 0.10 * c.fractal("road edge", 3.0, 4)
    rough = c.fractal("asphalt", 9.0, 5, 0.6)
    fine = c.grain("asphalt fine", 0.5)
    flat = smoothstep(9.0, 4.0, d)
    level = np.float32(np.median(c.ground[np.abs(offset) < 4.0])) if (np.abs(offset) < 4.0).any() else 0.0
    c.ground += flat * (0.6 * (level - c.ground) + 0.35)
    c.relief *= 1.0 - smoothstep(4.2, 3.2, d)
    c.top *= 1.0 - smoothstep(5.5, 4.5, d)
    verge = linear(134, 130, 88) * np.exp(0.16 * rough + 0.2 * fine)[..., None]
    c.paint(smoothstep(7.5, 5.5, d + 0.8 * rough), verge, "grass_dry")
    c.paint(smoothstep(3.9, 3.5, d + 0.25 * rough), linear(168, 156, 134) * np.exp(0.12 * fine)[..., None], "soil_loam")
    wheel = sum(np.exp(-(((offset - w) / 0.45) ** 2)) for w in (-2.35, -0.85, 0.85, 2.35))
    wheel = np.where(near, wheel, 0.0)
    colour = linear(124, 121, 117) * np.exp(0.07 * rough + 0.06 * fine - 0.10 * wheel)[..., None]
    asphalt = smoothstep(3.15, 2.95, d)
    c.paint(asphalt, colour, "asphalt")
    patch = smoothstep(0.9, 1.0, c.grain("repair", 16.0)) * asphalt * (offset > 0.2)
    c.tint(1.0 - 0.16 * patch)
    white = smoothstep(0.14, 0.05, np.abs(np.where(near, offset, 99.0))) * (np.mod(along, 6.0) < 2.0)
    white += smoothstep(0.12, 0.04, np.abs(d - 2.7)) * 0.8
    c.paint(np.clip(white * (0.68 + 0.18 * rough), 0, 0.85), linear(222, 220, 212))


def _tracks(c: Canvas, track: Values, sand: Values) -> None:
    """Paint the sandy track, its fork, wheel marks on the open sand, and footpaths."""
    g, s = c.stream("tracks"), c.size
    fine = c.grain("track fine", 0.6)
    rough = c.fractal("track rough", 7.0, 5, 0.6)
    pale = linear(204, 184, 148) * np.exp(0.07 * fine + 0.09 * rough)[..., None]
    order = np.argsort(track[:, 1])
    at = lambda y: (float(np.interp(y, track[order, 1], track[order, 0])), y)  # noqa: E731
    fork = spline(
        [at(-0.09 * s), (0.06 * s, -0.05 * s), (0.17 * s, -0.03 * s), (0.3 * s, -0.09 * s), (0.6 * s, -0.06 * s)]
    )
    west = spline([at(0.03 * s), (-0.1 * s, 0.075 * s), (-0.25 * s, 0.05 * s), (-0.6 * s, 0.09 * s)])
    for points, width in ((track, 1.9), (fork, 1.5), (west, 1.3)):
        offset, _ = c.ribbon(points, 6.0)
        d = np.where(np.isfinite(offset), np.abs(offset), 99.0) + 0.28 * rough + 0.12 * fine
        cover = smoothstep(width + 0.3, width - 0.25, d)
        middle = smoothstep(0.42, 0.2, d) * smoothstep(-0.2, 0.5, rough + 0.4)
        bed = cover * (1.0 - 0.75 * middle)
        c.ground -= 0.14 * cover
        for field in (c.top, c.relief):
            field *= 1.0 - cover
        c.paint(bed, pale, "sand_quartz")
        rut = ruts(c, points, 1.7, 0.34, 0.5, "rut")
        c.tint(1.0 - 0.36 * rut)
        c.relief -= 0.05 * rut
    start = np.array([at(-0.02 * s), at(0.02 * s)])
    for index in range(5):
        a = start[index % 2] + g.uniform(-2, 2, 2)
        heading = g.uniform(0.0, 2 * np.pi)
        length = g.uniform(9.0, 24.0)
        marks = [a]
        for _ in range(5):
            heading += g.normal(0.0, 0.75)
            marks.append(marks[-1] + length * 0.55 * np.array([np.cos(heading), np.sin(heading)]))
        marks.append(a + g.uniform(-3, 3, 2))
        rut = ruts(c, spline(marks), 1.65, 0.45, 0.95, f"marks {index}")
        on_sand = rut * sand
        c.tint(1.0 - 0.36 * on_sand)
        c.relief -= 0.06 * on_sand
        c.paint(0.55 * rut * (1.0 - sand), pale)
    for index in range(4):
        a, b = g.uniform(-0.5, 0.5, 2) * s, np.array(MARKER) + g.normal(0, 14.0, 2)
        if a[1] < -0.2 * s:
            a[1] = -0.25 * s
        bend = np.linspace(a, b, 7) + np.vstack([[0, 0], g.normal(0.0, 0.022 * s, (5, 2)), [0, 0]])
        offset, _ = c.ribbon(spline(bend), 2.0)
        d = np.where(np.isfinite(offset), np.abs(offset), 9.0) + 0.10 * rough
        cover = 0.8 * smoothstep(0.5, 0.22, d) * np.clip(0.7 + 0.5 * c.grain(f"path {index}", 5.0), 0, 1)
        c.top *= 1.0 - cover
        c.paint(cover, pale * 0.9, "sand_quartz")


def _trees(c: Canvas, pines: Values, south: Values, track: Values, sand: Values) -> None:
    """Plant pine forest with a plantation, birches on its edge, single shrubs on the heath, and trees by the road."""
    g = c.stream("trees")
    offset, _ = c.ribbon(track, 8.0)
    clear = np.where(np.isfinite(offset), np.abs(offset), 99.0) > 4.2
    corridor = np.abs(c.east - MARKER[0]) > 9.0
    stand = smoothstep(-2.0, 5.0, pines)
    floor = linear(98, 86, 60) * np.exp(0.3 * c.fractal("floor", 5.0, 5, 0.6))[..., None]
    c.paint(stand * clear, floor, "leaf_litter")
    c.top *= 1.0 - stand
    tone = [(104, 114, 70), (118, 124, 78), (96, 110, 72), (128, 124, 80)]
    holes = 0.93 - 0.75 * smoothstep(1.0, 1.6, c.fractal("holes", 22.0, 4))
    old = crowns(g, c.texel, 1.9, "pine", 40)
    east_side = c.east > 0.04 * c.size
    positions = scatter(g, c, 3.1, (stand > 0.5) * clear * holes * ~east_side)
    plant(g, c, positions, old, 15.5, tone, "conifer", beneath=0.4)
    young = crowns(g, c.texel, 1.15, "pine", 40)
    rows = planted_rows(g, c, 2.1, 1.7, 0.35, (stand > 0.5) * clear * east_side * (holes + 0.05))
    plant(g, c, rows, young, 7.0, [(106, 120, 70), (118, 128, 76), (98, 114, 70)], "conifer", 0.10, 0.3)
    rim = smoothstep(-7.0, -1.0, pines) * smoothstep(8.0, 2.0, pines) * clear * corridor
    birch = crowns(g, c.texel, 1.7, "broad", 20)
    warm = [(140, 146, 74), (160, 152, 74), (122, 134, 70), (172, 150, 78)]
    plant(g, c, scatter(g, c, 5.0, 0.38 * rim), birch, 9.0, warm, "broadleaf", 0.3)
    plant(g, c, scatter(g, c, 4.0, 0.35 * rim), young, 4.5, tone, "conifer", 0.4, 0.3)
    open_land = (pines < -3.0) & (south < -9.0) & clear & (c.material != c.value("water"))
    lone = open_land * corridor * smoothstep(0.2, 1.6, c.fractal("lone", 40.0, 4)) * (1.0 - 0.9 * sand)
    plant(g, c, scatter(g, c, 6.5, 0.42 * lone), young, 3.4, tone, "conifer", 0.45, 0.3)
    plant(g, c, scatter(g, c, 11.0, 0.3 * lone), birch, 6.5, warm, "broadleaf", 0.35)
    shrub = crowns(g, c.texel, 0.7, "broad", 16)
    plant(
        g, c, scatter(g, c, 4.5, 0.32 * lone + 0.04 * open_land), shrub, 1.1, [(78, 88, 48), (100, 92, 56)],
        "heath_shrub", 0.3,
    )  # fmt: skip
    avenue = (south > 5.5) * (south < 9.5) * (np.abs(c.east - MARKER[0]) > 22.0)
    linden = crowns(g, c.texel, 2.7, "broad", 12)
    plant(
        g, c, scatter(g, c, 9.0, 0.55 * avenue), linden, 9.5, [(112, 128, 68), (124, 136, 72), (138, 136, 70)],
        "broadleaf", 0.22,
    )  # fmt: skip


def _clearing(c: Canvas) -> None:
    """Paint level, bare sand around the marker, so that nothing hides it."""
    r = np.hypot(c.east - MARKER[0], c.north - MARKER[1]) + 0.5 * c.fractal("clearing", 5.0, 4)
    bare = smoothstep(4.6, 3.0, r)
    c.ground += bare * (c.height_at(*MARKER) - c.ground)
    for field in (c.top, c.relief):
        field *= 1.0 - bare
    scuff = c.grain("scuff", 1.0) + 0.7 * c.grain("scuff fine", 0.5)
    c.paint(bare, linear(200, 181, 145) * np.exp(0.08 * scuff)[..., None], "sand_quartz")


def _hide(c: Canvas, pines: Values, track: Values) -> None:
    """Put a raised hide on free ground at the edge of the forest, which looks at the marker."""
    import cv2

    assert c.solids
    offset, _ = c.ribbon(track, 9.0)
    side = 2 * round(2.0 / c.texel) + 1
    overhead = cv2.dilate(c.top, np.ones((side, side), np.uint8))
    away = np.hypot(c.east - MARKER[0], c.north - MARKER[1])
    fit = np.abs(pines + 4.0) + 0.1 * away + 50.0 * (overhead > 1.0) + 50.0 * np.isfinite(offset) + 50.0 * (away < 12.0)
    fit += 50.0 * c.among(("water", "asphalt"))
    fit[np.maximum(np.abs(c.east), np.abs(c.north)) > 0.5 * c.size - 4.0] = np.inf
    row, column = np.unravel_index(int(np.argmin(fit)), c.shape)
    east, north = float(c.east[0, column]), float(c.north[row, 0])
    heading = float(np.degrees(np.arctan2(MARKER[0] - east, MARKER[1] - north)))
    c.solids.hide_stand(Window(c, east, north, heading, 4.0))


def _objects(c: Canvas, track: Values) -> list[dict[str, Any]]:
    """Return the heated marker, and a recovery car parked on the track."""
    marker = {
        "name": "marker", "shape": "disc", "size": [2.0, 2.0, 0.1], "position": [*MARKER, 0.05], "temperature": 330.0,
        "heated": True, "material": "paint_black", "colour": [44, 42, 40],
    }  # fmt: skip
    nearest = track[np.argmin(np.abs(track[:, 1] + 0.03 * c.size))]
    position = [round(float(nearest[0]), 1), round(float(nearest[1]), 1)]
    car = {
        "name": "car", "shape": "box", "size": [1.8, 4.4, 0.8], "position": [*position, 0.25], "yaw_deg": 12.0,
        "upright": True, "temperature": 302.0, "material": "paint_metallic", "colour": [176, 178, 182],
    }  # fmt: skip
    if c.solids:
        return [
            marker,
            *vehicle("car", position[0], position[1], 12.0, (176, 178, 182), "paint_metallic", 302.0, 310.0),
        ]
    cabin = {**car, "name": "car_cabin", "size": [1.6, 2.3, 0.6], "position": [*position, 1.05], "temperature": 304.5}
    return [marker, car, cabin]


def _flight(c: Canvas) -> dict[str, NDArray[np.float64]]:
    """Return the approach: 120 m above the marker's ground, from 45° oblique to straight down."""
    height = 120.0
    time = np.arange(0.0, 11.01, 0.5)
    start = min(height, 0.5 * c.size - 5.0)
    # Constant speed, slowing down over the marker.
    distance = start * (1.0 - smoothstep(0.0, 1.0, 0.15 + 0.85 * time / time[-1])) / (1.0 - smoothstep(0.0, 1.0, 0.15))
    pitch = -np.degrees(np.arctan2(height, distance))
    sway = 1.2 * np.sin(2 * np.pi * time / 7.0)
    east = MARKER[0] + sway * distance / start
    altitude = c.height_at(*MARKER) + height + 0.4 * np.sin(2 * np.pi * time / 5.0)
    yaw = np.degrees(np.arctan2(MARKER[0] - east, np.maximum(distance, 1e-9))) * (distance > 1.0)
    return {
        "time_s": time, "east_m": east, "north_m": MARKER[1] - distance, "altitude_m": altitude, "yaw_deg": yaw,
        "gimbal_pitch_deg": pitch,
    }  # fmt: skip
