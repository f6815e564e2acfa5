"""Versions of labelled land for training an emissivity map: measured colours and other cover.

Materials get the visible colour of a measured sample, roofs one each, and vegetation may give way to bare ground.
"""

from collections.abc import Iterator

import numpy as np

from thermorender.apps.training.emissivity_training import Labelled
from thermorender.apps.training.measured_colours import ROOFS, colour_of, roofs, smooth, spread
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes

_ROOFS_OF_LAND = ("roof_shingle", "roof_slate", "roof_rubber", "roof_tile_clay", "roof_felt")
# Cover in other climates and seasons: {material: what takes its place}.
CLIMATES: dict[str, dict[str, tuple[str, ...]]] = {
    "as made": {},
    "dry season": {"grass_green": ("grass_dry",), "grass_dry": ("grass_dry", "soil_loam")},
    "ploughed": {"grass_green": ("soil_loam", "soil_dark", "grass_green"), "grass_dry": ("soil_loam", "soil_dark")},
    "arid": {"grass_green": ("soil_arid", "sand_quartz"), "grass_dry": ("soil_arid", "sand_quartz", "soil_loam"),
             "heath_shrub": ("soil_arid", "heath_shrub"), "leaf_litter": ("soil_arid",)},
}  # fmt: skip


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
                target = colour_of(chosen, generator)
                if target is None:
                    target = typical * spread(generator)
                light[part] *= (target / np.maximum(typical, 1e-3)).astype(np.float32)
                material[part] = new.setdefault(chosen, len(new) + 1)
        yield Labelled(
            bytes_from_linear(light), material, {value: name for name, value in new.items()}, item.texel_m,
            item.source, item.domain,
        )  # fmt: skip


def _parts(
    here: np.ndarray, name: str, climate: str, generator: np.random.Generator
) -> Iterator[tuple[np.ndarray, str]]:
    """Yield (mask, material) of the parts of a material's ground, which may become another material each."""
    import cv2

    if name in _ROOFS_OF_LAND:
        number, part = cv2.connectedComponents(here.astype(np.uint8))
        for one in range(1, number):
            yield part == one, list(ROOFS)[generator.choice(len(ROOFS), p=roofs())]
        return
    options = CLIMATES[climate].get(name, (name,))
    if len(options) == 1:
        yield here, options[0]
        return
    noise = smooth(generator, 8, max(here.shape))[: here.shape[0], : here.shape[1]]
    which = np.digitize(noise, np.quantile(noise, np.arange(1, len(options)) / len(options)))
    for number, option in enumerate(options):
        yield here & (which == number), option
