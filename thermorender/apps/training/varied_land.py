"""Versions of labelled land for training an emissivity map: measured colours, other cover, and towns.

Materials get the visible colour of a measured sample, roofs one each, and vegetation may give way to bare ground. Towns
add dense roofs, streets and yards. Colours are linear sRGB under D65, from reflectance spectra of the ECOSTRESS library
(Meerdink et al. 2019, doi:10.1016/j.rse.2019.05.015) and of SLUM (Kotthaus et al. 2014,
doi:10.1016/j.isprsjprs.2014.05.005).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from thermorender.apps.training.emissivity_training import Labelled
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes

# Linear sRGB of measured samples; a material that is not listed keeps its colours.
COLOURS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "asphalt": ((.224, .193, .145), (.192, .175, .142), (.187, .159, .119), (.122, .101, .080), (.134, .125, .110),
                (.078, .072, .063), (.097, .083, .070), (.088, .071, .051), (.079, .075, .070)),
    "concrete": ((.310, .249, .181), (.354, .330, .293), (.321, .244, .201), (.326, .246, .156), (.271, .240, .196),
                 (.398, .369, .308), (.396, .319, .231), (.443, .369, .279), (.237, .208, .163)),
    "soil_loam": ((.289, .167, .052), (.206, .136, .075), (.285, .159, .070), (.264, .159, .054), (.219, .157, .096)),
    "soil_dark": ((.106, .059, .020), (.102, .064, .025), (.152, .070, .010)),
    "soil_arid": ((.303, .169, .059), (.328, .156, .016), (.264, .159, .054), (.437, .342, .222)),
    "sand_quartz": ((.437, .342, .222), (.447, .354, .238), (.503, .444, .323), (.262, .195, .112)),
    "roof_tile_clay": ((.325, .136, .088), (.244, .095, .064), (.203, .082, .067), (.316, .127, .096),
                       (.164, .078, .047), (.165, .105, .074), (.113, .080, .060), (.147, .110, .085)),
    "roof_shingle": ((.307, .302, .286), (.296, .275, .241), (.060, .038, .031)),
    "roof_slate": ((.184, .170, .159), (.091, .089, .083), (.109, .098, .080), (.052, .050, .048)),
    "roof_rubber": ((.563, .511, .413), (.063, .062, .059), (.695, .653, .563)),
    "roof_felt": ((.070, .067, .065), (.042, .042, .042)),
    "metal_painted": ((.083, .091, .099), (.468, .475, .468), (.406, .096, .052), (.013, .103, .202),
                      (.255, .083, .047), (.226, .352, .257)),
    "steel_galvanised_oxidised": ((.236, .264, .284), (.281, .304, .297), (.526, .497, .441)),
    # Clear, green, brown and turbid water from above, with little light from the bottom.
    "water": ((.027, .027, .029), (.020, .045, .040), (.060, .075, .050), (.110, .095, .060), (.030, .070, .090)),
    "granite": ((.340, .359, .338), (.532, .403, .323), (.454, .412, .362), (.168, .171, .151), (.255, .186, .141)),
    "limestone": ((.385, .313, .220), (.648, .550, .390), (.127, .130, .125), (.182, .156, .124)),
}  # fmt: skip
# How often a roof has each covering: most are tile, shingle, concrete or membrane.
ROOFS = {
    "roof_tile_clay": 0.25, "roof_shingle": 0.2, "concrete": 0.25, "roof_rubber": 0.1, "roof_slate": 0.06,
    "roof_felt": 0.06, "metal_painted": 0.06, "steel_galvanised_oxidised": 0.02,
}  # fmt: skip
_ROOFS_OF_LAND = ("roof_shingle", "roof_slate", "roof_rubber", "roof_tile_clay", "roof_felt")
# Cover in other climates and seasons: {material: what takes its place}.
CLIMATES: dict[str, dict[str, tuple[str, ...]]] = {
    "as made": {},
    "dry season": {"grass_green": ("grass_dry",), "grass_dry": ("grass_dry", "soil_loam")},
    "ploughed": {"grass_green": ("soil_loam", "soil_dark", "grass_green"), "grass_dry": ("soil_loam", "soil_dark")},
    "arid": {"grass_green": ("soil_arid", "sand_quartz"), "grass_dry": ("soil_arid", "sand_quartz", "soil_loam"),
             "heath_shrub": ("soil_arid", "heath_shrub"), "leaf_litter": ("soil_arid",)},
}  # fmt: skip
# Spread of a material's brightness and of its colour between places (natural logarithm).
_BRIGHTNESS, _TINT = 0.25, 0.06
_TOWN_TEXELS, _TOWN_TEXEL_M = 900, 0.4


def versions(item: Labelled, count: int, generator: np.random.Generator) -> Iterator[Labelled]:
    """Yield `count` versions of a Labelled, each in a random climate and with colours of measured samples."""
    for _ in range(count):
        climate = list(CLIMATES)[generator.integers(len(CLIMATES))]
        names = {int(value): item.names[int(value)] for value in np.unique(item.material) if value}
        light = linear_from_bytes(item.rgb)
        material = np.zeros_like(item.material)
        new: dict[str, int] = {}
        for value, name in names.items():
            here = item.material == value
            place = light[here]
            typical = place.mean(axis=0)
            for part, chosen in _parts(here, name, climate, generator):
                target = _colour(chosen, generator)
                if target is None:
                    target = typical * _spread(generator)
                light[part] *= (target / np.maximum(typical, 1e-3)).astype(np.float32)
                material[part] = new.setdefault(chosen, len(new) + 1)
        yield Labelled(
            bytes_from_linear(light), material, {value: name for name, value in new.items()}, item.texel_m,
            item.source, item.domain,
        )  # fmt: skip


def town(seed: int) -> Labelled:
    """Return the Labelled of a made town: roofs in blocks, streets, yards, trees and shadows; no relief."""
    generator = np.random.Generator(np.random.Philox([seed, 77]))
    side = _TOWN_TEXELS
    names: dict[str, int] = {}
    material = np.zeros((side, side), np.uint8)
    light = np.zeros((side, side, 3), np.float32)
    yards = [("soil_loam", "soil_arid", "sand_quartz", "grass_dry", "grass_green", "concrete")[k]
             for k in generator.permutation(6)[:3]]  # fmt: skip
    patch: Any = sum(_smooth(generator, cells, side) for cells in (5, 12, 30))
    limits = np.quantile(patch, [0.5, 0.8])
    for number, name in enumerate(yards):
        _paint(light, material, np.digitize(patch, limits) == number, name, names, generator)
    height = np.zeros((side, side), np.float32)
    water = patch > np.quantile(patch, 1.0 - generator.choice([0.0, 0.05, 0.3]))
    angle = generator.uniform(0.0, np.pi / 2)
    block_m, street_m = generator.uniform(25.0, 90.0), generator.uniform(5.0, 14.0)
    v, u = np.indices((side, side)) * _TOWN_TEXEL_M
    across, along = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    street = ((across % block_m) < street_m) | ((along % (1.6 * block_m)) < street_m)
    surface = ("asphalt", "asphalt", "concrete", "soil_loam")[generator.integers(4)]
    _paint(light, material, street & ~water, surface, names, generator)
    _paint(light, material, water, "water", names, generator)
    # Buildings stand on a grid of plots, turned with the streets.
    plot = generator.uniform(9.0, 28.0)
    cells = np.stack([np.floor(across / plot), np.floor(along / plot)], axis=-1).astype(np.int64)
    cells -= cells.reshape(-1, 2).min(axis=0)
    cell = cells[..., 0] * (cells[..., 1].max() + 1) + cells[..., 1]
    inside = np.minimum(np.minimum(across % plot, plot - across % plot), np.minimum(along % plot, plot - along % plot))
    count = int(cell.max()) + 1
    margin, built = generator.uniform(0.5, 0.3 * plot, count), generator.random(count) < generator.uniform(0.4, 0.95)
    roof = (inside > margin[cell]) & built[cell] & ~street & ~water
    kinds = generator.choice(len(ROOFS), count, p=np.array(list(ROOFS.values())) / sum(ROOFS.values()))
    colours = np.array([_colour(list(ROOFS)[kind], generator) for kind in kinds], np.float32)
    pitched = np.isin(kinds, [0, 1, 4]) & (generator.random(count) < 0.8)
    sun = generator.uniform(0.0, 2.0 * np.pi)
    slope = np.where(across % plot < plot / 2, 1.0, -1.0) * np.cos(sun - angle)
    shade = (1.0 + 0.35 * slope * pitched[cell]).astype(np.float32)
    light[roof] = (colours[cell] * shade[..., None])[roof]
    for kind, name in enumerate(ROOFS):
        material[roof & (kinds[cell] == kind)] = names.setdefault(name, len(names) + 1)
    height[roof] = generator.uniform(3.0, 15.0, count)[cell][roof]
    _clutter(light, roof, generator)
    _trees(light, material, height, names, ~roof & ~water, generator)
    light *= np.exp(np.float32(0.10) * generator.normal(size=(side, side, 1)).astype(np.float32))
    _cast_shadows(light, height, sun, generator.uniform(0.5, 2.0))
    return Labelled(bytes_from_linear(light), material, {value: name for name, value in names.items()}, _TOWN_TEXEL_M,
                    "made towns", "town")  # fmt: skip


def _parts(
    here: np.ndarray, name: str, climate: str, generator: np.random.Generator
) -> Iterator[tuple[np.ndarray, str]]:
    """Yield (mask, material) of the parts of a material's ground, which may become another material each."""
    import cv2

    if name in _ROOFS_OF_LAND:
        number, part = cv2.connectedComponents(here.astype(np.uint8))
        for one in range(1, number):
            yield part == one, list(ROOFS)[generator.choice(len(ROOFS), p=list(ROOFS.values()))]
        return
    options = CLIMATES[climate].get(name, (name,))
    if len(options) == 1:
        yield here, options[0]
        return
    noise = _smooth(generator, 8, max(here.shape))[: here.shape[0], : here.shape[1]]
    which = np.digitize(noise, np.quantile(noise, np.arange(1, len(options)) / len(options)))
    for number, option in enumerate(options):
        yield here & (which == number), option


def _smooth(generator: np.random.Generator, cells: int, side: int) -> np.ndarray:
    """Smooth noise (side, side) of normal values on a grid of cells."""
    import cv2

    values = generator.normal(size=(cells, cells)).astype(np.float32)
    return cv2.resize(values, (side, side), interpolation=cv2.INTER_CUBIC)


def _spread(generator: np.random.Generator) -> np.ndarray:
    """A random factor on a colour, (3,)."""
    return np.exp(generator.normal(0.0, _BRIGHTNESS) + generator.normal(0.0, _TINT, 3))


def _colour(name: str, generator: np.random.Generator) -> np.ndarray | None:
    """Linear colour of a place covered by a material, (3,), or None if no sample was measured."""
    samples = COLOURS.get(name)
    return None if samples is None else np.array(samples[generator.integers(len(samples))]) * _spread(generator)


# Vegetation in towns [linear sRGB].
_GREEN = {"grass_green": (0.06, 0.10, 0.03), "grass_dry": (0.22, 0.19, 0.10), "broadleaf": (0.035, 0.06, 0.02)}


def _paint(
    light: np.ndarray, material: np.ndarray, here: np.ndarray, name: str, names: dict[str, int],
    generator: np.random.Generator,
) -> None:  # fmt: skip
    """Cover ground with a material, numbered in `names`."""
    colour = _colour(name, generator)
    light[here] = np.array(_GREEN[name]) * _spread(generator) if colour is None else colour
    material[here] = names.setdefault(name, len(names) + 1)


def _clutter(light: np.ndarray, roof: np.ndarray, generator: np.random.Generator) -> None:
    """Change small rectangles of roofs: tanks, vents, stairs."""
    rows, columns = np.nonzero(roof)
    for number in generator.integers(0, rows.size, rows.size // 1500):
        high, wide = generator.integers(2, 8, 2)
        part = (slice(rows[number], rows[number] + high), slice(columns[number], columns[number] + wide))
        light[part] *= np.float32(np.exp(generator.normal(0.0, 0.5)))


def _trees(
    light: np.ndarray, material: np.ndarray, height: np.ndarray, names: dict[str, int], free: np.ndarray,
    generator: np.random.Generator,
) -> None:  # fmt: skip
    """Draw crowns on free ground."""
    side = len(light)
    value = names.setdefault("broadleaf", len(names) + 1)
    for _ in range(generator.integers(20, 400)):
        row, column = generator.integers(0, side, 2)
        radius = generator.uniform(1.5, 5.0) / _TOWN_TEXEL_M
        if not free[row, column]:
            continue
        low = np.maximum(np.array([row, column]) - int(radius) - 1, 0)
        part = (slice(low[0], row + int(radius) + 2), slice(low[1], column + int(radius) + 2))
        v, u = np.mgrid[part[0], part[1]][:, : side - low[0], : side - low[1]]
        away = np.hypot(v - row, u - column) * np.exp(generator.normal(0.0, 0.15, v.shape))
        crown = away < radius
        tone = np.exp(generator.normal(0.0, 0.3, (*v.shape, 1)))
        colour = np.array(_GREEN["broadleaf"]) * _spread(generator) * tone
        light[part][crown] = colour[crown]
        material[part][crown] = value
        height[part][crown] = radius * _TOWN_TEXEL_M * 1.5


def _cast_shadows(light: np.ndarray, height: np.ndarray, sun: float, length: float) -> None:
    """Darken ground that higher neighbours towards the sun cover; `length` is the shadow per metre of height."""
    shaded = np.zeros(height.shape, bool)
    for step in range(1, 40):
        away_m = step * _TOWN_TEXEL_M
        shift = np.rint(np.array([np.sin(sun), np.cos(sun)]) * step).astype(int)
        shaded |= np.roll(height, shift, (0, 1)) - height > away_m / length + 0.5
    light[shaded] *= np.array((0.22, 0.25, 0.32), np.float32)
