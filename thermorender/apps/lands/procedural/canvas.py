"""The canvas of a synthetic scene: height, material, colour and moisture per texel, and functions that paint them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import Values, fractal_noise, smooth_noise, smoothstep, stream

if TYPE_CHECKING:
    from thermorender.apps.lands.procedural.solids import Solids


class Road(NamedTuple):
    """A road or track of a canvas: points (K, 2) east and north [m], half width [m], linear colour, material."""

    points: Values
    half_m: float
    colour: Values
    material: str


class Painting:
    """Fields of a land under construction, each of `shape`, and the means to paint them."""

    def __init__(self, seed: int, shape: tuple[int, int], names: dict[int, str]) -> None:
        self.seed, self.shape = seed, shape
        # Bare ground, height of objects on it, and small relief that is lit but not in the surface model [m].
        self.ground = np.zeros(self.shape, np.float32)
        self.top: Values = np.zeros(self.shape, np.float32)
        self.relief = np.zeros(self.shape, np.float32)
        self.albedo = np.zeros((*self.shape, 3), np.float32)  # Linear colour of a level surface in full sun
        self.material = np.zeros(self.shape, np.uint8)  # Class value
        self.wetness = np.zeros(self.shape, np.float32)  # Added moisture, 0…1
        self.names = names  # Material of each class value

    @property
    def surface(self) -> NDArray[np.float32]:
        """Heights of the surface model, float32 [m]."""
        return self.ground + self.top

    def value(self, name: str) -> int:
        """Return the class value of a material; a new name gets a new value."""
        for value, known in self.names.items():
            if known == name:
                return value
        self.names[len(self.names) + 1] = name
        return len(self.names)

    def among(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """Return whether each texel has one of the materials, bool."""
        return np.isin(self.material, [value for value, known in self.names.items() if known in names])

    def stream(self, name: str) -> np.random.Generator:
        """Return the scene's generator of that name."""
        return stream(self.seed, name)

    def paint(self, cover: Values, colour: Values, material: str | None = None) -> None:
        """Blend a linear colour, (3,) or one for each texel, over the land by `cover` in 0…1; above one half it also
        sets the material.
        """
        for channel in range(3):
            target = self.albedo[..., channel]
            target += cover * (np.asarray(colour)[..., channel] - target)
        if material is not None:
            self.material[cover > 0.5] = self.value(material)

    def tint(self, factor: Values) -> None:
        """Multiply the colour by a factor for each texel, or for each channel of it."""
        self.albedo *= factor[..., None] if factor.ndim == 2 else factor


class Canvas(Painting):
    """A square scene under construction; a layout paints it from the ground up."""

    def __init__(self, seed: int, size_m: float, texel_m: float) -> None:
        self.size, self.texel = size_m, texel_m
        self.n = round(size_m / texel_m)
        super().__init__(seed, (self.n, self.n), {})
        line = ((np.arange(self.n) + 0.5) * texel_m - 0.5 * size_m).astype(np.float32)
        # Texel centres relative to the scene's centre [m]; row 0 in the north.
        self.east, self.north = line[None, :], -line[:, None]
        self.solids: Solids | None = None  # What is placed on the ground, in three dimensions; None: painted only
        self.roads: list[Road] = []  # Roads and tracks that leave the square

    def fractal(self, name: str, wavelength_m: float, octaves: int = 5, gain: float = 0.5) -> NDArray[np.float32]:
        """Return the scene's fractal noise of that name, (N, N) float32."""
        return fractal_noise(self.stream(name), self.shape, self.texel, wavelength_m, octaves, gain)

    def grain(self, name: str, wavelength_m: float) -> NDArray[np.float32]:
        """Return the scene's single-octave noise of that name, (N, N) float32."""
        return smooth_noise(self.stream(name), self.shape, self.texel, wavelength_m)

    def texels(self, east: Any, north: Any) -> tuple[Any, Any]:
        """Return (row, column) of a position [m] as floats, texel centres at integers."""
        return (0.5 * self.size - north) / self.texel - 0.5, (east + 0.5 * self.size) / self.texel - 0.5

    def inside(self, east: float, north: float, margin_m: float = 0.0) -> bool:
        """Return whether a position is within the scene by a margin [m]."""
        half = 0.5 * self.size - margin_m
        return abs(east) <= half and abs(north) <= half

    def height_at(self, east: float, north: float) -> float:
        """Return the bare ground's height at a position [m]."""
        row, column = self.texels(east, north)
        return float(self.ground[int(np.clip(row, 0, self.n - 1)), int(np.clip(column, 0, self.n - 1))])

    def window(self, low_east: float, high_east: float, low_north: float, high_north: float) -> tuple[slice, slice]:
        """Return the (row slice, column slice) of a box [m], empty outside the scene."""
        top, left = self.texels(low_east, high_north)
        bottom, right = self.texels(high_east, low_north)
        clip = lambda v: int(np.clip(v, 0, self.n))  # noqa: E731
        return slice(clip(np.floor(top)), clip(np.ceil(bottom) + 1)), slice(
            clip(np.floor(left)), clip(np.ceil(right) + 1)
        )

    def ribbon(self, points: Values, reach_m: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return (offset, along) of a polyline of points (K, 2) east and north, two (N, N) float32 [m]. Offset is
        positive to the right of the direction of travel, and inf beyond `reach_m`.
        """
        offset = np.full(self.shape, np.inf, np.float32)
        along = np.zeros(self.shape, np.float32)
        travelled = 0.0
        for (e0, n0), (e1, n1) in zip(points[:-1], points[1:], strict=True):
            length = float(np.hypot(e1 - e0, n1 - n0))
            de, dn = (e1 - e0) / length, (n1 - n0) / length
            rows, columns = self.window(
                min(e0, e1) - reach_m, max(e0, e1) + reach_m, min(n0, n1) - reach_m, max(n0, n1) + reach_m
            )
            x, y = self.east[:, columns] - np.float32(e0), self.north[rows] - np.float32(n0)
            t = np.clip(x * np.float32(de) + y * np.float32(dn), 0.0, np.float32(length))
            side = x * np.float32(dn) - y * np.float32(de)
            distance = np.hypot(x - t * np.float32(de), y - t * np.float32(dn))
            nearer = distance < np.abs(offset[rows, columns])
            offset[rows, columns][nearer] = np.copysign(distance, side)[nearer]
            along[rows, columns][nearer] = (travelled + t)[nearer]
            travelled += length
        offset[np.abs(offset) > reach_m] = np.inf
        return offset, along

    def stamp(
        self, crown: Values, tone: Values, east: float, north: float, height_m: float, colour: Values, material: int,
        beneath: float = 0.35,
    ) -> None:  # fmt: skip
        """Place a tree or shrub on the canvas; it is visible where it is higher than the existing surface. `crown`, (h,
        w), is its height as a share of `height_m`, drawn where above `beneath`, and `tone` a factor on the linear
        colour.
        """
        row, column = self.texels(east, north)
        r0, c0 = round(row) - crown.shape[0] // 2, round(column) - crown.shape[1] // 2
        r1, c1 = min(r0 + crown.shape[0], self.n), min(c0 + crown.shape[1], self.n)
        a, b = max(r0, 0), max(c0, 0)
        if a >= r1 or b >= c1:
            return
        piece, shade = crown[a - r0 : r1 - r0, b - c0 : c1 - c0], tone[a - r0 : r1 - r0, b - c0 : c1 - c0]
        top = self.top[a:r1, b:c1]
        higher = (piece > beneath) & (piece * height_m > top)
        if self.solids:
            self.solids.hide((slice(a, r1), slice(b, c1)), higher)
            self.solids.tree(crown, tone, east, north, height_m, colour, material, beneath)
        top[higher] = (piece * np.float32(height_m))[higher]
        self.albedo[a:r1, b:c1][higher] = (shade[..., None] * np.asarray(colour, np.float32))[higher]
        self.material[a:r1, b:c1][higher] = material


def spline(points: ArrayLike, spacing_m: float = 2.0) -> NDArray[np.float64]:
    """Return a Catmull–Rom curve through the points, (K, 2) [m], sampled about every `spacing_m`."""
    p = np.asarray(points, np.float64)
    p = np.vstack([2 * p[0] - p[1], p, 2 * p[-1] - p[-2]])
    pieces = []
    for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True):
        count = max(2, int(np.hypot(*(c - b)) / spacing_m))
        t = np.linspace(0.0, 1.0, count, endpoint=False)[:, None]
        pieces.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3))
    return np.vstack([*pieces, p[-2:-1]])


def ruts(c: Canvas, points: Values, gauge: float, width: float, strength: float, name: str) -> NDArray[np.float32]:
    """Return the marks of a pair of wheels along points (K, 2) east and north [m], (N, N) float32 in 0…1. The noise
    `name` interrupts them; gauge and half width of a mark are in metres.
    """
    offset, along = c.ribbon(points, 3.0)
    near = np.isfinite(offset)
    d = np.where(near, np.abs(np.abs(offset) - 0.5 * gauge), 9.0)
    length = np.hypot(*np.diff(points, axis=0).T).sum()
    fade = smoothstep(0.0, 6.0, along) * smoothstep(length, length - 6.0, along)
    return strength * fade * smoothstep(width, 0.3 * width, d) * np.clip(0.8 + 0.35 * c.grain(name, 3.0), 0, 1)


def crowns(
    generator: np.random.Generator, texel_m: float, radius_m: float, form: str, count: int = 24
) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Return `count` (crown, tone) pairs for `Canvas.stamp`, each (h, w) float32. Forms are "pine" (clumps on a flat
    dome), "spruce" (a cone with whorled branches) and "broad" (many leafy lobes).
    """
    made = []
    for _ in range(count):
        radius = radius_m * np.exp(generator.normal(0.0, 0.16)) / texel_m
        side = 2 * int(np.ceil(1.35 * radius)) + 1
        y, x = (np.mgrid[:side, :side] - side // 2).astype(np.float32)
        x, y = x * np.float32(generator.uniform(0.88, 1.12)), y * np.float32(generator.uniform(0.88, 1.12))
        angle = np.arctan2(y, x)
        outline = np.ones_like(x)
        for wave in range(2, 8):
            outline += np.float32(generator.normal(0.0, 0.22 / wave)) * np.cos(
                wave * angle + np.float32(generator.uniform(0, 6.3))
            )
        rho = np.hypot(x, y) / (np.float32(radius) * np.clip(outline, 0.55, 1.45))
        if form == "spruce":
            branches = generator.integers(7, 12)
            ray = np.abs(np.cos(0.5 * branches * angle + np.float32(generator.uniform(0, 6.3)) + 1.5 * rho))
            body = 1.0 - rho * (1.18 - 0.33 * ray)
            crown = np.clip(body, 0.0, 1.0) ** np.float32(0.85)
            crown += np.float32(0.05) * generator.standard_normal(x.shape, dtype=np.float32) * (crown > 0)
            tone = 0.72 + 0.45 * ray * rho
        else:
            lobes = 9 if form == "pine" else 26
            size = (0.42 if form == "pine" else 0.30) * radius
            crown = np.zeros_like(x)
            tone = np.full_like(x, 0.7)
            for _ in range(lobes):
                r, a = np.sqrt(generator.uniform(0, 0.8)) * radius, generator.uniform(0, 2 * np.pi)
                lobe = np.hypot(x - np.float32(r * np.cos(a)), y - np.float32(r * np.sin(a))) / np.float32(
                    size * generator.uniform(0.7, 1.25)
                )
                dome = np.sqrt(np.maximum(1.0 - lobe**2, 0.0))
                level = 1.0 - 0.42 * (r / radius) ** 2
                lifted = np.where(lobe < 1.0, level * (0.72 + 0.28 * dome), 0.0)
                higher = lifted > crown
                tone[higher] = np.float32(generator.uniform(0.78, 1.22))
                crown = np.maximum(crown, lifted)
            crown *= smoothstep(1.12, 0.92, rho)
            crown += np.float32(0.035) * generator.standard_normal(x.shape, dtype=np.float32) * (crown > 0)
        tone = tone * np.exp(0.10 * generator.standard_normal(x.shape, dtype=np.float32))
        made.append((crown.astype(np.float32), tone.astype(np.float32)))
    return made


def scatter(
    generator: np.random.Generator, canvas: Canvas, spacing_m: float, density: Values, jitter: float = 0.42
) -> NDArray[np.float64]:
    """Return positions on a jittered grid, kept with the probability `density` (N, N), as (K, 2) east and north [m].
    The largest shift is `jitter` of the spacing.
    """
    count = int(np.ceil(canvas.size * 1.05 / spacing_m)) + 2
    j, i = np.mgrid[:count, :count].astype(np.float64)
    i = i + 0.5 * (j % 2)
    position = np.stack([i, j], -1) + generator.uniform(-jitter, jitter, (count, count, 2))
    position = position.reshape(-1, 2) * spacing_m - 0.5 * count * spacing_m
    keep = generator.uniform(size=len(position))
    half = 0.5 * canvas.size
    within = (np.abs(position) < half).all(axis=1)
    position, keep = position[within], keep[within]
    row, column = canvas.texels(position[:, 0], position[:, 1])
    row, column = (np.clip(np.round(v).astype(int), 0, canvas.n - 1) for v in (row, column))
    return position[keep < density[row, column]]


def planted_rows(
    g: np.random.Generator, c: Canvas, between: float, along: float, bearing: float, density: Values
) -> NDArray[np.float64]:
    """Return positions in planted rows, kept with the probability `density` (N, N), as (K, 2) east and north [m].
    `between` and `along` are spacings [m]; `bearing` turns the rows [rad].
    """
    count_a, count_b = int(1.5 * c.size / between), int(1.5 * c.size / along)
    a, b = np.meshgrid(np.arange(count_a) - count_a / 2, np.arange(count_b) - count_b / 2)
    p = np.stack([a.ravel() * between, b.ravel() * along], -1) + g.normal(0.0, 0.2, (a.size, 2))
    turn = np.array([[np.cos(bearing), -np.sin(bearing)], [np.sin(bearing), np.cos(bearing)]])
    p = p @ turn.T
    draw = g.uniform(size=len(p))
    within = (np.abs(p) < 0.5 * c.size).all(axis=1)
    p, draw = p[within], draw[within]
    row, column = (np.clip(np.round(v).astype(int), 0, c.n - 1) for v in c.texels(p[:, 0], p[:, 1]))
    return p[draw < density[row, column]]


def plant(
    generator: np.random.Generator, canvas: Canvas, positions: Values,
    library: Sequence[tuple[Values, Values]], height_m: float, colours: Sequence[tuple[int, int, int]], material: str,
    spread: float = 0.14, beneath: float = 0.35,
) -> None:  # fmt: skip
    """Place a tree or shrub at each of the (K, 2) positions, with crowns of the library and a mix of sRGB colours.
    Heights are log-normal about `height_m` by `spread`.
    """
    value = canvas.value(material)
    palette = np.array([linear(*c) for c in colours])
    for east, north in positions:
        crown, tone = library[int(generator.integers(len(library)))]
        turn = int(generator.integers(8))
        crown, tone = np.rot90(crown, turn % 4), np.rot90(tone, turn % 4)
        if turn > 3:
            crown, tone = crown.T, tone.T
        mix = generator.dirichlet(np.full(len(palette), 0.9))
        colour = mix @ palette * np.exp(generator.normal(0.0, 0.10))
        canvas.stamp(crown, tone, east, north, height_m * np.exp(generator.normal(0.0, spread)), colour, value, beneath)
