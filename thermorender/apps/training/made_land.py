"""Made pictures of land with known materials, for training an emissivity map: towns, suburbs, fields, quarries, coasts.

They are flat drawings in measured colours (`measured_colours`) with shadows, without heights or physics. Networks that
saw one kind of land each err in different ways on pictures of other places, and their mean errs less than any.
"""

from collections.abc import Callable

import numpy as np

from thermorender.apps.training.emissivity_training import Labelled
from thermorender.apps.training.measured_colours import ROOFS, colour_of, roofs, smooth, spread
from thermorender.physics.srgb import bytes_from_linear

_SIDE, _TEXEL_M = 900, 0.4
# Vegetation, whose colours are not those of a dry sample [linear sRGB].
_GREEN = {
    "grass_green": (0.06, 0.10, 0.03), "grass_dry": (0.22, 0.19, 0.10), "broadleaf": (0.035, 0.06, 0.02),
    "conifer": (0.020, 0.035, 0.015), "heath_shrub": (0.07, 0.065, 0.04),
}  # fmt: skip
_FOAM = (0.6, 0.62, 0.62)


def made_land(kind: str, seed: int) -> Labelled:
    """Return the Labelled of a made land of a kind of MAKERS, 360 m wide."""
    canvas = _Canvas(np.random.Generator(np.random.Philox([seed, 77])))
    MAKERS[kind](canvas)
    return canvas.finished(kind)


class _Canvas:
    """Colours, materials and heights of a land that is being drawn."""

    def __init__(self, generator: np.random.Generator) -> None:
        self.random = generator
        self.light = np.zeros((_SIDE, _SIDE, 3), np.float32)
        self.material = np.zeros((_SIDE, _SIDE), np.uint8)
        self.height = np.zeros((_SIDE, _SIDE), np.float32)
        self.names: dict[str, int] = {}
        self.y, self.x = np.indices((_SIDE, _SIDE)) * np.float32(_TEXEL_M)
        self.sun = generator.uniform(0.0, 2.0 * np.pi)

    def colour(self, name: str) -> np.ndarray:
        """Linear colour of a place covered by a material, (3,)."""
        found = colour_of(name, self.random)
        return np.array(_GREEN[name]) * spread(self.random) if found is None else found

    def number(self, name: str) -> int:
        """Number of a material in the picture, from 1."""
        return self.names.setdefault(name, len(self.names) + 1)

    def paint(self, here: np.ndarray, name: str, patches: float = 0.1) -> None:
        """Cover ground with a material, whose brightness varies by `patches` (logarithm) over some metres."""
        tone = np.exp(np.float32(patches) * self.noise(60))
        self.light[here] = (tone[..., None] * self.colour(name).astype(np.float32))[here]
        self.material[here] = self.number(name)

    def noise(self, cells: int) -> np.ndarray:
        """Smooth noise over the land, of normal values on a grid of cells."""
        return smooth(self.random, cells, _SIDE)

    def choice(self, *names: str) -> str:
        """One of some names, each as likely."""
        return names[self.random.integers(len(names))]

    def turned(self, angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates [m] along axes that are turned by an angle."""
        return self.x * np.cos(angle) + self.y * np.sin(angle), self.y * np.cos(angle) - self.x * np.sin(angle)

    def rows(self, here: np.ndarray, angle: float, apart_m: float, share: float, name: str) -> None:
        """Plants in rows."""
        across, _ = self.turned(angle)
        wave = across % apart_m / apart_m + 0.06 * self.noise(200)
        self.paint(here & (wave < share), name, 0.2)

    def house(self, row: float, column: float, angle: float, size: tuple[float, float], name: str, pitch: str) -> None:
        """A roof of a size [m] at a place [texels]: "flat", "gable" or "hip"; tanks, vents and stairs stand on it."""
        radius = int(np.hypot(*size) / 2.0 / _TEXEL_M) + 3
        top, left = max(int(row) - radius, 0), max(int(column) - radius, 0)
        part = (slice(top, int(row) + radius), slice(left, int(column) + radius))
        y, x = self.y[part] - row * _TEXEL_M, self.x[part] - column * _TEXEL_M
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        inside = (np.abs(along) < size[0] / 2.0) & (np.abs(across) < size[1] / 2.0)
        if not inside.any():
            return
        facing = angle + np.where(across > 0.0, 0.5, -0.5) * np.pi
        if pitch == "hip":
            end = size[0] / 2.0 - np.abs(along) < size[1] / 2.0 - np.abs(across)
            facing = np.where(end, angle + np.where(along > 0.0, 0.0, np.pi), facing)
        shade = np.ones(facing.shape) if pitch == "flat" else 1.0 + 0.35 * np.cos(facing - self.sun)
        tone = np.exp(self.random.normal(0.0, 0.06, shade.shape)) * shade
        self.light[part][inside] = (tone[..., None] * self.colour(name)).astype(np.float32)[inside]
        self.material[part][inside] = self.number(name)
        self.height[part][inside] = self.random.uniform(3.0, 12.0)
        for _ in range(self.random.poisson(inside.sum() / 1500.0)):
            v, u = self.random.integers(0, inside.shape[0]), self.random.integers(0, inside.shape[1])
            tall, wide = self.random.integers(2, 8, 2)
            piece = (slice(v, v + tall), slice(u, u + wide))
            self.light[part][piece][inside[piece]] *= np.float32(np.exp(self.random.normal(0.0, 0.5)))

    def trees(
        self, free: np.ndarray, count: int, name: str = "broadleaf", radius_m: tuple[float, float] = (1.5, 5.0)
    ) -> None:
        """Crowns on free ground."""
        self.crowns(self.random.integers(0, _SIDE, (count, 2)), free, name, radius_m)

    def crowns(self, places: np.ndarray, free: np.ndarray, name: str, radius_m: tuple[float, float]) -> None:
        """Crowns at places (N, 2) [texels] where ground is free."""
        value = self.number(name)
        base = self.colour(name)
        for row, column in places:
            if not (0 <= row < _SIDE and 0 <= column < _SIDE and free[row, column]):
                continue
            radius = self.random.uniform(*radius_m) / _TEXEL_M
            low = np.maximum(np.array([row, column]) - int(radius) - 1, 0)
            part = (slice(low[0], row + int(radius) + 2), slice(low[1], column + int(radius) + 2))
            v, u = np.mgrid[part[0], part[1]][:, : _SIDE - low[0], : _SIDE - low[1]]
            away = np.hypot(v - row, u - column) * np.exp(self.random.normal(0.0, 0.15, v.shape))
            crown = away < radius
            tone = np.exp(self.random.normal(0.0, 0.3, (*v.shape, 1))) * np.exp(self.random.normal(0.0, 0.15))
            self.light[part][crown] = (tone * base).astype(np.float32)[crown]
            self.material[part][crown] = value
            self.height[part][crown] = radius * _TEXEL_M * 1.5

    def finished(self, kind: str) -> Labelled:
        """The picture with grain and shadows."""
        self.light *= np.exp(np.float32(0.10) * self.random.normal(size=(_SIDE, _SIDE, 1)).astype(np.float32))
        self._shade(self.random.uniform(0.5, 2.0))
        names = {value: name for name, value in self.names.items()}
        return Labelled(bytes_from_linear(self.light), self.material, names, _TEXEL_M, f"made {kind}", kind)

    def _shade(self, length: float) -> None:
        """Darken ground that higher neighbours towards the sun cover; `length` is the shadow per metre of height."""
        shaded = np.zeros(self.height.shape, bool)
        for step in range(1, 40):
            shift = np.rint(np.array([np.sin(self.sun), np.cos(self.sun)]) * step).astype(int)
            shaded |= np.roll(self.height, shift, (0, 1)) - self.height > step * _TEXEL_M / length + 0.5
        self.light[shaded] *= np.array((0.22, 0.25, 0.32), np.float32)


def _ground(canvas: _Canvas, names: tuple[str, ...], cells: tuple[int, ...] = (5, 12, 30)) -> np.ndarray:
    """Cover the land with patches of materials, equal areas; return the noise that parts them."""
    patch = sum((canvas.noise(cell) for cell in cells), np.zeros((), np.float32))
    limits = np.quantile(patch, np.arange(1, len(names)) / len(names))
    for number, name in enumerate(names):
        canvas.paint(np.digitize(patch, limits) == number, name)
    return np.asarray(patch)


def _town(canvas: _Canvas) -> None:
    """Roofs in blocks, streets, yards and trees."""
    random = canvas.random
    yards = ("soil_loam", "soil_arid", "sand_quartz", "grass_dry", "grass_green", "concrete")
    patch = _ground(canvas, tuple(yards[k] for k in random.permutation(6)[:3]))
    water = patch > np.quantile(patch, 1.0 - random.choice([0.0, 0.05, 0.3]))
    angle = random.uniform(0.0, np.pi / 2)
    block_m, street_m = random.uniform(25.0, 90.0), random.uniform(5.0, 14.0)
    across, along = canvas.turned(angle)
    street = ((across % block_m) < street_m) | ((along % (1.6 * block_m)) < street_m)
    canvas.paint(street & ~water, canvas.choice("asphalt", "asphalt", "concrete", "soil_loam"), 0.05)
    canvas.paint(water, "water", 0.05)
    free = ~street & ~water
    # Buildings stand on a grid of plots, turned with the streets.
    plot = random.uniform(9.0, 28.0)
    built = random.uniform(0.4, 0.95)
    reach = int(1.5 * _SIDE * _TEXEL_M / plot)
    for i in range(-reach, reach):
        for j in range(-reach, reach):
            a, b = (i + 0.5) * plot, (j + 0.5) * plot
            column = (a * np.cos(angle) - b * np.sin(angle)) / _TEXEL_M
            row = (a * np.sin(angle) + b * np.cos(angle)) / _TEXEL_M
            if (
                not (0 <= row < _SIDE and 0 <= column < _SIDE and free[int(row), int(column)])
                or random.random() > built
            ):
                continue
            side = plot - 2.0 * random.uniform(0.5, 0.3 * plot)
            _building(canvas, row, column, angle, (side, side * random.uniform(0.7, 1.0)), 0.5)
    canvas.trees(free & (canvas.height == 0.0), int(random.integers(20, 400)))


def _building(canvas: _Canvas, row: float, column: float, angle: float, size: tuple[float, float], flat: float) -> None:
    """A building with a roof of common materials; a share of the roofs is flat."""
    name = list(ROOFS)[canvas.random.choice(len(ROOFS), p=roofs())]
    pitched = name in ("roof_tile_clay", "roof_shingle", "roof_slate") or canvas.random.random() > flat
    canvas.house(row, column, angle, size, name, canvas.choice("gable", "hip") if pitched else "flat")


def _suburb(canvas: _Canvas) -> None:
    """Houses of all directions in gardens, along bent streets with drives and pools."""
    random = canvas.random
    _ground(canvas, tuple(canvas.choice("grass_green", "grass_green", "grass_dry", "soil_loam") for _ in range(3)))
    across, along = canvas.turned(random.uniform(0.0, np.pi))
    bend = 12.0 * canvas.noise(6)
    block_m, street_m = random.uniform(45.0, 80.0), random.uniform(6.0, 10.0)
    from_street = np.minimum((across + bend) % block_m, (along + bend) % (2.0 * block_m))
    street = from_street < street_m
    canvas.paint(from_street < street_m + 2.0, "concrete", 0.05)
    canvas.paint(street, canvas.choice("asphalt", "asphalt", "concrete"), 0.05)
    step = random.uniform(14.0, 24.0) / _TEXEL_M
    for row in np.arange(step / 2, _SIDE, step):
        for column in np.arange(step / 2, _SIDE, step):
            v, u = row + random.uniform(-2, 2) / _TEXEL_M, column + random.uniform(-2, 2) / _TEXEL_M
            if street[int(np.clip(v, 0, _SIDE - 1)), int(np.clip(u, 0, _SIDE - 1))] or random.random() > 0.85:
                continue
            long, wide = random.uniform(9.0, 17.0), random.uniform(7.0, 11.0)
            angle = random.uniform(0.0, np.pi)
            if random.random() < 0.4:
                _slab(canvas, v, u + (wide / 2 + 3.0) / _TEXEL_M, (3.5, 9.0), canvas.choice("concrete", "asphalt"))
            if random.random() < 0.12:
                _slab(canvas, v + (long / 2 + 3.0) / _TEXEL_M, u, (4.0, 8.0), "water", np.array((0.08, 0.35, 0.42)))
            _building(canvas, v, u, angle, (long, wide), 0.3)
    canvas.trees((canvas.height == 0.0) & ~street, int(random.integers(200, 900)), radius_m=(1.0, 4.5))


def _slab(
    canvas: _Canvas, row: float, column: float, size: tuple[float, float], name: str, colour: np.ndarray | None = None
) -> None:
    """A level rectangle of a size [m] at a place [texels]."""
    (top, left), (tall, wide) = (row, column), (size[0] / _TEXEL_M, size[1] / _TEXEL_M)
    part = (
        slice(max(int(top - tall / 2), 0), max(int(top + tall / 2), 0)),
        slice(max(int(left - wide / 2), 0), max(int(left + wide / 2), 0)),
    )
    free = canvas.height[part] == 0.0
    canvas.light[part][free] = canvas.colour(name) if colour is None else colour
    canvas.material[part][free] = canvas.number(name)


def _fields(canvas: _Canvas) -> None:
    """Parcels of crops, stubble and ploughed soil with rows, orchards, tracks, a farm and a pond."""
    random = canvas.random
    angle = random.uniform(0.0, np.pi)
    across, along = canvas.turned(angle)
    wide, long = random.uniform(30.0, 110.0), random.uniform(60.0, 200.0)
    parcel = np.floor(across / wide).astype(int) * 101 + np.floor(along / long).astype(int)
    edge = np.minimum(across % wide, along % long)
    for number in np.unique(parcel):
        here = parcel == number
        turn = angle + random.choice([0.0, 0.5 * np.pi])
        soil = canvas.choice("soil_loam", "soil_dark", "soil_arid", "soil_loam")
        kind = random.choice(["crop", "young", "stubble", "bare", "orchard", "meadow"])
        if kind == "crop":
            canvas.paint(here, "grass_green", 0.15)
        elif kind == "meadow":
            canvas.paint(here, canvas.choice("grass_green", "grass_dry"), 0.25)
        elif kind == "stubble":
            canvas.paint(here, "grass_dry", 0.1)
            canvas.rows(here, turn, random.uniform(2.0, 6.0), 0.3, "grass_dry")
        else:
            canvas.paint(here, soil, 0.12)
            if kind == "young":
                canvas.rows(here, turn, random.uniform(0.8, 3.0), random.uniform(0.3, 0.6), "grass_green")
            elif kind == "bare":
                tone = 1.0 + 0.12 * np.sin(2.0 * np.pi * canvas.turned(turn)[0] / random.uniform(0.9, 3.0))
                canvas.light[here] *= tone[here][:, None].astype(np.float32)
            else:
                apart = random.uniform(4.0, 9.0)
                u, v = canvas.turned(turn)
                on_grid = (u % apart < _TEXEL_M) & (v % apart < _TEXEL_M) & here
                canvas.crowns(np.argwhere(on_grid), here, "broadleaf", (0.25 * apart, 0.45 * apart))
    track = (edge < random.uniform(2.0, 5.0)) & (canvas.height == 0.0)
    canvas.paint(track, canvas.choice("soil_loam", "soil_arid", "asphalt", "grass_dry"))
    canvas.trees((edge < 8.0) & ~track, int(random.integers(50, 500)))
    if random.random() < 0.6:
        pond = canvas.noise(4)
        canvas.paint((pond > np.quantile(pond, 0.97)) & (canvas.height == 0.0), "water", 0.05)
    row, column = random.integers(100, _SIDE - 100, 2)
    for _ in range(random.integers(0, 9)):
        v, u = np.array([row, column]) + random.normal(0.0, 60.0, 2)
        size = (random.uniform(12.0, 45.0), random.uniform(9.0, 20.0))
        name = canvas.choice("metal_painted", "steel_galvanised_oxidised", "roof_tile_clay", "roof_felt", "concrete")
        canvas.house(v, u, angle, size, name, canvas.choice("gable", "flat"))


def _quarry(canvas: _Canvas) -> None:
    """Terraces of rock, heaps, bare soil with gullies, haul roads, a pit lake and scrub."""
    random = canvas.random
    rock = canvas.choice("granite", "limestone", "limestone", "sand_quartz")
    soil = canvas.choice("soil_loam", "soil_arid", "soil_arid", "soil_dark")
    _ground(canvas, (soil, rock, canvas.choice(soil, "sand_quartz", "soil_arid")), (4, 9, 25))
    level = canvas.noise(4) + 0.3 * canvas.noise(12)
    if random.random() < 0.6:
        # Faces of terraces are steep: bright towards the sun, dark away from it.
        step = np.floor(3.0 * level)
        down, right = np.gradient(level)
        facing = np.cos(np.arctan2(down, right) - canvas.sun)
        face = (3.0 * level - step < 0.25) & (level < 0.5)
        canvas.paint(face, rock, 0.25)
        canvas.light[face] *= (1.0 + 0.45 * facing[face])[:, None].astype(np.float32)
    gully = np.abs(canvas.noise(25)) < 0.05
    canvas.light[gully] *= np.float32(0.75)
    across, _ = canvas.turned(random.uniform(0.0, np.pi))
    road = np.abs((across + 25.0 * canvas.noise(5)) % random.uniform(90.0, 200.0) - 10.0) < random.uniform(2.5, 6.0)
    canvas.paint(road, canvas.choice(rock, soil), 0.05)
    lake = level > np.quantile(level, 1.0 - random.choice([0.0, 0.05, 0.15]))
    canvas.paint(lake, "water", 0.05)
    scrub = ~lake & ~road & (canvas.noise(15) > random.uniform(-0.5, 1.0))
    canvas.trees(scrub, int(random.integers(100, 2500)), canvas.choice("heath_shrub", "broadleaf"), (0.5, 2.0))
    canvas.paint(scrub & (canvas.noise(90) > 0.8) & (canvas.height == 0.0), "grass_dry", 0.15)
    for _ in range(random.integers(0, 6)):
        size = (random.uniform(10.0, 40.0), random.uniform(8.0, 18.0))
        name = canvas.choice("metal_painted", "steel_galvanised_oxidised", "concrete")
        row, column = random.uniform(0, _SIDE, 2)
        canvas.house(row, column, random.uniform(0.0, np.pi), size, name, "gable")


def _coast(canvas: _Canvas) -> None:
    """Sea with waves and surf, beach, dunes or rocks, a quay, and land behind."""
    random = canvas.random
    across, along = canvas.turned(random.uniform(0.0, 2.0 * np.pi))
    shore = across - across.mean() + 18.0 * canvas.noise(5) + 3.0 * canvas.noise(30)
    _ground(canvas, (canvas.choice("grass_green", "grass_dry"), canvas.choice("soil_loam", "grass_dry", "soil_arid")))
    beach = random.uniform(5.0, 60.0)
    sand = canvas.choice("sand_quartz", "sand_quartz", "granite", "limestone")
    canvas.paint(shore < beach, sand)
    dune = (shore > 0.6 * beach) & (shore < 1.6 * beach) & (canvas.noise(60) > 0.3)
    canvas.paint(dune, canvas.choice("grass_dry", "heath_shrub"), 0.2)
    wet = shore < random.uniform(1.0, 6.0)
    canvas.light[wet & (shore > 0.0)] *= np.float32(0.6)
    sea = shore < 0.0
    canvas.paint(sea, "water", 0.05)
    deep = np.exp(np.clip(shore / random.uniform(20.0, 150.0), -3.0, 0.0))
    canvas.light[sea] *= (0.6 + 1.2 * deep[sea])[:, None].astype(np.float32)
    waves = (
        1.0 + 0.15 * np.sin(2.0 * np.pi * (shore + 0.4 * along) / random.uniform(2.5, 9.0)) + 0.05 * canvas.noise(200)
    )
    canvas.light[sea] *= waves[sea][:, None].astype(np.float32)
    surf = sea & (shore > -random.uniform(3.0, 25.0)) & (canvas.noise(80) > random.uniform(0.5, 1.5))
    canvas.light[surf] = _FOAM
    if random.random() < 0.4:
        quay = (shore < 25.0) & (np.abs(along - along.mean()) < random.uniform(10.0, 60.0)) & (shore > -20.0)
        canvas.paint(quay, canvas.choice("concrete", "asphalt"), 0.05)
    land = shore > 1.2 * beach
    for row, column in random.uniform(0, _SIDE, (random.integers(0, 120), 2)):
        if land[int(row), int(column)]:
            size = (random.uniform(8.0, 20.0), random.uniform(7.0, 12.0))
            _building(canvas, row, column, random.uniform(0.0, np.pi), size, 0.4)
    canvas.trees(land & (canvas.height == 0.0), int(random.integers(20, 800)), canvas.choice("broadleaf", "conifer"))


MAKERS: dict[str, Callable[[_Canvas], None]] = {
    "town": _town, "suburb": _suburb, "fields": _fields, "quarry": _quarry, "coast": _coast,
}  # fmt: skip
