"""Buildings of synthetic scenes: streets, houses, solar panels, greenhouses, garden objects, cars."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.canvas import Canvas
from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import Values, smoothstep

# Roofs: material, sRGB colour, whether it is pitched.
ROOFS = (
    ("roof_shingle", (168, 98, 74), True), ("roof_shingle", (142, 84, 68), True),
    ("roof_shingle", (182, 122, 90), True), ("roof_shingle", (120, 92, 78), True),
    ("roof_slate", (104, 106, 110), True), ("roof_slate", (84, 86, 92), True), ("concrete", (150, 146, 138), True),
    ("roof_rubber", (112, 109, 104), False),
)  # fmt: skip

# Heat that an engine gives to a bonnet per kelvin of its excess over the body [W/K], whose upper and lower side lose
# about 20 W m⁻² K⁻¹; an excess that is the sun's [K].
_ENGINE_W_K, _SUNLIT_K = 75.0, 2.0


class Window:
    """A window of the canvas in a local frame: u to the right of `heading_deg` (clockwise from north), v along it. Its
    origin and half side are in metres.
    """

    def __init__(self, canvas: Canvas, east: float, north: float, heading_deg: float, half_m: float) -> None:
        self.canvas = canvas
        self.rows, self.columns = canvas.window(east - half_m, east + half_m, north - half_m, north + half_m)
        self.origin, self.heading = (east, north), heading_deg
        x, y = canvas.east[:, self.columns] - np.float32(east), canvas.north[self.rows] - np.float32(north)
        s, c = np.float32(np.sin(np.radians(heading_deg))), np.float32(np.cos(np.radians(heading_deg)))
        self.u, self.v = x * c - y * s, x * s + y * c

    def view(self, field: Values) -> Values:
        """Return the window of a canvas field, as a writable view."""
        return field[self.rows, self.columns]

    def position(self, u: float, v: float) -> tuple[float, float]:
        """Return the map position (east, north) [m] of a local position."""
        s, c = np.sin(np.radians(self.heading)), np.cos(np.radians(self.heading))
        return self.origin[0] + u * c + v * s, self.origin[1] - u * s + v * c

    def box(self, u: float, v: float, half_u: float, half_v: float, soft: float = 0.12) -> Values:
        """Return the coverage of a rectangle, 0…1, with edges softened over `soft` [m]."""
        d = np.minimum(half_u - np.abs(self.u - u), half_v - np.abs(self.v - v))
        return smoothstep(-soft, soft, d)

    def paint(self, cover: Values, colour: Values, material: str | None = None) -> None:
        """Blend a colour into the window; coverage above one half also sets the material."""
        colour = np.asarray(colour, np.float32)
        albedo = self.view(self.canvas.albedo)
        albedo += cover[..., None] * (colour - albedo)
        if material is not None:
            self.view(self.canvas.material)[cover > 0.5] = self.canvas.value(material)

    def level(self, cover: Values) -> None:
        """Make the window's ground flat and bare where covered."""
        ground = self.view(self.canvas.ground)
        if (cover > 0.5).any():
            ground += cover * (np.median(ground[cover > 0.5]) - ground)
        for field in (self.canvas.top, self.canvas.relief):
            part = self.view(field)
            part *= 1.0 - cover


def house(
    window: Window, fine: Values, generator: np.random.Generator, u: float, v: float, half_u: float, half_v: float,
    wall_m: float, roof: tuple[str, tuple[int, int, int], bool], pitch_deg: float = 40.0, hip: bool = False,
) -> NDArray[np.bool_]:  # fmt: skip
    """Build a house with its ridge along u and a roof of `ROOFS`; return its footprint in the window. Lengths are half
    sides [m]; `fine`, (N, N), is noise for the roofing, and `hip` slopes the gable ends too.
    """
    c = window.canvas
    material, colour, pitched = roof
    overhang = 0.45 if pitched else 0.0
    x, y = window.u - np.float32(u), window.v - np.float32(v)
    du, dv = half_u + overhang - np.abs(x), half_v + overhang - np.abs(y)
    inside = np.minimum(du, dv)
    body = inside > 0.0
    if not body.any():
        return body
    ground = window.view(c.ground)
    window.level(smoothstep(-1.5, 0.0, inside))
    slope = np.float32(np.tan(np.radians(pitch_deg))) if pitched else np.float32(0.01)
    rise = slope * (np.minimum(dv, du * 1.1) if hip and pitched else dv)
    grain = window.view(fine)
    if pitched:
        courses = np.cos(2 * np.pi * dv / 0.83) * 0.03 + np.cos(2 * np.pi * x / 0.61) * 0.02
        moss = smoothstep(0.6, 1.6, grain * 0.5 + generator.normal(0.2, 0.5)) * 0.18
        weather = generator.normal(0.0, 0.10) + 0.06 * window.view(fine)[::-1, ::-1]
        tone = linear(*colour) * np.exp(0.07 * grain + courses - moss + weather)[..., None]
    else:
        seams = 0.10 * (np.abs(np.mod(x, 2.4) - 1.2) > 1.1)
        stain = 0.10 * grain + generator.normal(0.0, 0.22)
        tone = linear(*colour) * np.exp(stain - seams)[..., None]
    height = np.where(body, wall_m + rise, 0.0).astype(np.float32)
    if not pitched:
        parapet = body & (inside < 0.35)
        height[parapet] += 0.3
        tone = np.where(parapet[..., None], linear(138, 136, 131), tone)
    else:
        ridge = (np.abs(y) < 0.16) & body
        tone = np.where(ridge[..., None], tone * 1.18, tone)
        gutter = body & (dv < 0.2)
        tone = np.where(gutter[..., None], linear(128, 124, 118), tone)
    chimney = None
    if pitched and generator.uniform() < 0.8:
        at = chimney = generator.uniform(-0.6, 0.6) * half_u
        stack = (np.abs(x - at) < 0.42) & (np.abs(y - 0.4) < 0.42)
        height[stack] = wall_m + slope * half_v + 0.9
        tone = np.where(stack[..., None], linear(150, 108, 92), tone)
    # Where two wings meet, the higher roof is visible.
    top = window.view(c.top)
    shown = body & (height > top)
    if c.solids:
        c.solids.house(window, body, u, v, (half_u, half_v), wall_m, roof, pitch_deg, hip, chimney)
    top[shown] = height[shown]
    window.view(c.albedo)[shown] = tone[shown]
    window.view(c.material)[shown] = c.value(material)
    window.view(c.wetness)[shown] = 0.0
    ground[body] = np.median(ground[body])
    return body


def panels(
    window: Window, u: float, v: float, columns: int, rows: int, lean_v: float, size: tuple[float, float] = (1.04, 1.72)
) -> None:
    """Add an array of solar panels centred at (u, v), on top of the existing surface.

    `lean_v` is the foreshortening of a row seen from above (cosine of the roof's pitch).
    """
    c = window.canvas
    pitch_u, pitch_v = size[0] + 0.02, (size[1] + 0.02) * lean_v
    x = window.u - np.float32(u) + 0.5 * columns * pitch_u
    y = window.v - np.float32(v) + 0.5 * rows * pitch_v
    field = (x > 0) & (x < columns * pitch_u) & (y > 0) & (y < rows * pitch_v)
    frame = (np.mod(x, pitch_u) < 0.11) | (np.mod(y, pitch_v) < 0.13)
    if c.solids:
        c.solids.panels(window, field, (u, v), (0.5 * columns * pitch_u, 0.5 * rows * pitch_v))
    window.view(c.albedo)[field] = linear(38, 46, 68)
    window.view(c.albedo)[field & frame] = linear(96, 104, 122)
    window.view(c.material)[field] = c.value("glass")
    window.view(c.top)[field] += np.float32(0.12)


def greenhouse(window: Window, fine: Values, u: float, v: float, half_u: float, half_v: float, spans: int) -> None:
    """Build a greenhouse of several glazed spans along v."""
    c = window.canvas
    inside = np.minimum(half_u - np.abs(window.u - u), half_v - np.abs(window.v - v))
    body = inside > 0.0
    if not body.any():
        return
    window.level(smoothstep(-1.5, 0.0, inside))
    width = 2.0 * half_u / spans
    across = np.mod(window.u - u + half_u, width) - 0.5 * width
    height = 2.6 + 0.55 * (0.5 * width - np.abs(across))
    grain = window.view(fine)
    inner = smoothstep(-0.6, 0.9, grain + np.cos(2 * np.pi * (window.u - u) / 1.6))
    tone = linear(150, 164, 150) + inner[..., None] * (linear(112, 136, 102) - linear(150, 164, 150))
    west = across < 0
    tone = tone * np.where(west, 1.12, 0.9)[..., None]
    bar = (np.abs(np.mod(window.v - v, 2.0) - 1.0) > 0.9) | (np.abs(across) < 0.15) | (inside < 0.2)
    bar |= np.abs(np.abs(across) - 0.5 * width) < 0.14
    tone = np.where(bar[..., None], linear(206, 210, 208), tone)
    if c.solids:
        c.solids.greenhouse(window, body, u, v, (half_u, half_v), spans)
    window.view(c.top)[body] = height[body]
    window.view(c.albedo)[body] = tone[body]
    window.view(c.material)[body] = c.value("glass")


def clutter(
    window: Window, generator: np.random.Generator, width: float, low: float, high: float, free: NDArray[np.bool_]
) -> None:
    """Scatter garden objects: tables, woodpiles, trampolines, sandpits, covers."""
    c = window.canvas
    colours = [
        (224, 222, 214), (70, 72, 76), (150, 120, 88), (96, 128, 160), (176, 90, 70), (120, 112, 100),
        (198, 184, 150),
    ]  # fmt: skip
    for _ in range(int(generator.integers(4, 11))):
        u, v = generator.uniform(-0.44, 0.44) * width, generator.uniform(low, high - 1.5)
        half = generator.uniform(0.35, 1.1, 2)
        tint = linear(*colours[generator.integers(len(colours))]) * np.exp(generator.normal(0.0, 0.15))
        if generator.uniform() < 0.2:
            r = np.hypot(window.u - u, window.v - v)
            mark, rim = smoothstep(1.65, 1.5, r) * free, smoothstep(1.25, 1.4, r)[..., None]
            tint = linear(52, 54, 58) + rim * (linear(88, 116, 148) - linear(52, 54, 58))
        else:
            mark = window.box(u, v, half[0], half[1], 0.1) * free
        mark = mark * (window.view(c.top) < 0.6)
        height = generator.uniform(0.3, 0.9)
        if c.solids:
            flat = tint if tint.ndim == 1 else linear(70, 88, 108)
            c.solids.box(window, mark > 0.5, u, v, (half[0], half[1]), height, flat, "wood")
        window.paint(mark, tint, "wood")
        top = window.view(c.top)
        np.maximum(top, (mark > 0.5) * np.float32(height), out=top)


def street(c: Canvas, points: Values, half: float, fine: Values, soft: Values, taken: NDArray[np.bool_]) -> None:
    """Add an asphalt street with kerbs, pavements and repairs, and mark it as taken."""
    offset, along = c.ribbon(points, half + 5.0)
    near = np.isfinite(offset)
    d = np.where(near, np.abs(offset), 99.0) + 0.06 * soft
    flat = smoothstep(half + 4.5, half + 1.5, d)
    for field in (c.relief, c.top):
        field *= 1.0 - flat
    walk = smoothstep(half + 1.75, half + 1.6, d)
    slabs = 0.07 * (np.mod(along, 1.0) < 0.2)
    c.paint(walk, linear(168, 162, 152) * np.exp(0.08 * fine + 0.08 * soft - slabs)[..., None], "concrete")
    kerb = smoothstep(half + 0.28, half + 0.2, d)
    c.paint(kerb, linear(196, 192, 184) * np.exp(0.06 * fine)[..., None], "concrete")
    c.ground += 0.12 * walk * (1.0 - kerb)
    wheel = np.where(near, sum(np.exp(-(((offset - w * half) / 0.5) ** 2)) for w in (-0.72, -0.28, 0.28, 0.72)), 0.0)
    tone = linear(118, 116, 113) * np.exp(0.06 * fine + 0.08 * soft - 0.07 * wheel)[..., None]
    asphalt = smoothstep(half + 0.05, half - 0.08, d)
    c.paint(asphalt, tone, "asphalt")
    for k, (low, factor) in enumerate(((1.0, 0.82), (1.2, 1.1))):
        block = c.grain(f"repair {half} {k}", 9.0) > low
        c.tint(1.0 - (1.0 - factor) * asphalt * block)
    crack = (np.abs(c.fractal(f"crack {half}", 14.0, 5, 0.6)) < 0.03) * asphalt
    c.tint(1.0 - 0.25 * crack)
    if half > 3.0:
        dash = smoothstep(0.14, 0.06, np.abs(np.where(near, offset, 9.0))) * (np.mod(along, 6.0) < 2.0)
        c.paint(0.75 * dash * asphalt, linear(222, 220, 214))
    taken |= d < half + 2.2


def car(
    name: str, east: float, north: float, heading_deg: float, colour: tuple[int, int, int], material: str,
    temperature: float, bonnet: float,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the [[object]] tables of a car: body, cabin, bonnet. Centre [m], heading clockwise from north [deg], sRGB,
    and the temperatures of body and bonnet [K]. Where the heat balance solves these, an engine heats a warmer bonnet.
    """
    s, c = np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))

    def part(
        suffix: str, size: list[float], ahead: float, base: float, kelvin: float, tint: Sequence[int]
    ) -> dict[str, Any]:
        return {
            "name": name + suffix, "shape": "box", "size": size,
            "position": [round(float(east + ahead * s), 2), round(float(north + ahead * c), 2), base],
            "yaw_deg": round(float(heading_deg) % 360.0, 1), "upright": True, "temperature": round(float(kelvin), 1),
            "material": material, "colour": [int(v) for v in tint],
        }  # fmt: skip

    glass = [52, 58, 64]
    engine = round(_ENGINE_W_K * max(bonnet - temperature - _SUNLIT_K, 0.0), 1)
    return [
        part("", [1.8, 4.4, 0.7], 0.0, 0.25, temperature, colour),
        {**part("_cabin", [1.58, 2.2, 0.5], -0.35, 0.95, temperature + 1.5, glass), "material": "glass"},
        part("_roof", [1.5, 1.7, 0.05], -0.4, 1.45, temperature + 2.0, colour),
        {**part("_bonnet", [1.6, 1.1, 0.04], 1.55, 0.95, bonnet, colour), "inner_heat_w": engine},
    ]
