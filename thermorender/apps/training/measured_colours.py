"""Measured visible colours of materials, and how often each covers roofs: what made and varied land are coloured with.

Colours are linear sRGB under D65, from reflectance spectra of the ECOSTRESS library (Meerdink et al. 2019,
doi:10.1016/j.rse.2019.05.015) and of SLUM (Kotthaus et al. 2014, doi:10.1016/j.isprsjprs.2014.05.005).
"""

import numpy as np

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
# Roofs of screed or plastered concrete.
COLOURS["cement"] = COLOURS["concrete"]
# How often a roof has each covering: most are tile, shingle, concrete or membrane.
ROOFS = {
    "roof_tile_clay": 0.25, "roof_shingle": 0.2, "cement": 0.25, "roof_rubber": 0.1, "roof_slate": 0.06,
    "roof_felt": 0.06, "metal_painted": 0.06, "steel_galvanised_oxidised": 0.02,
}  # fmt: skip
# Spread of a material's brightness and of its colour between places (natural logarithm).
_BRIGHTNESS, _TINT = 0.25, 0.06


def spread(generator: np.random.Generator) -> np.ndarray:
    """Return a random factor on a colour, (3,)."""
    return np.exp(generator.normal(0.0, _BRIGHTNESS) + generator.normal(0.0, _TINT, 3))


def colour_of(name: str, generator: np.random.Generator) -> np.ndarray | None:
    """Return the linear colour of a place covered by a material, (3,), or None if no sample was measured."""
    samples = COLOURS.get(name)
    return None if samples is None else np.array(samples[generator.integers(len(samples))]) * spread(generator)


def smooth(generator: np.random.Generator, cells: int, side: int) -> np.ndarray:
    """Return smooth noise (side, side) of normal values on a grid of cells."""
    import cv2

    values = generator.normal(size=(cells, cells)).astype(np.float32)
    return cv2.resize(values, (side, side), interpolation=cv2.INTER_CUBIC)


def roofs() -> np.ndarray:
    """Return the shares of ROOFS, which sum to one."""
    share = np.array(list(ROOFS.values()))
    return share / share.sum()
