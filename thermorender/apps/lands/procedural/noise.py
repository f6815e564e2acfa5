"""Seeded random streams, and fractal noise in the plane without a visible lattice."""

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Of texels, (N, N), or of positions, (K, 2).
Values = NDArray[Any]


def stream(seed: int, name: str) -> np.random.Generator:
    """Return a generator that depends on the seed, 0 … 2⁶⁴−1, and the name of a purpose only. With one stream per
    feature, changing a feature does not affect the others.
    """
    return np.random.Generator(np.random.Philox(key=np.array([int(seed), zlib.crc32(name.encode())], np.uint64)))


def smooth_noise(
    generator: np.random.Generator, shape: tuple[int, int], texel_m: float, wavelength_m: float
) -> NDArray[np.float32]:
    """Return one octave of band-limited noise, (H, W) float32, mean about 0, standard deviation about 1.

    Normal deviates on a lattice of `wavelength_m` / 2, rotated by a random angle to hide its axes, and interpolated
    cubically. Below two texels the noise is white.
    """
    import cv2

    step = 0.5 * wavelength_m / texel_m
    angle = generator.uniform(0.0, 2.0 * np.pi)
    shift = generator.uniform(0.0, 1.0, 2)
    if step <= 1.0:
        return generator.standard_normal(shape, dtype=np.float32)
    height, width = shape
    side = int(np.ceil(np.hypot(height, width) / step)) + 6
    lattice = generator.standard_normal((side, side), dtype=np.float32)
    c, s = np.cos(angle) / step, np.sin(angle) / step
    middle = 0.5 * side + shift
    affine = np.array(
        [[c, -s, middle[0] - 0.5 * (c * width - s * height)], [s, c, middle[1] - 0.5 * (s * width + c * height)]]
    )
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    field = cv2.warpAffine(lattice, affine, (width, height), flags=flags, borderMode=cv2.BORDER_REFLECT)
    # Cubic interpolation of unit white noise keeps 0.80 of its standard deviation on average.
    return field / np.float32(0.80)


def fractal_noise(
    generator: np.random.Generator, shape: tuple[int, int], texel_m: float, wavelength_m: float, octaves: int = 5,
    gain: float = 0.5,
) -> NDArray[np.float32]:  # fmt: skip
    """Return a sum of octaves, (H, W) float32, mean about 0, standard deviation about 1. The longest is `wavelength_m`;
    each further one halves it, down to the texel, with `gain` times the amplitude.
    """
    total = np.zeros(shape, np.float32)
    power = 0.0
    amplitude = 1.0
    for _ in range(octaves):
        total += np.float32(amplitude) * smooth_noise(generator, shape, texel_m, wavelength_m)
        power += amplitude**2
        if wavelength_m <= 2.0 * texel_m:
            break
        amplitude *= gain
        wavelength_m *= 0.5
    return total / np.float32(np.sqrt(power))


def ridged_noise(
    generator: np.random.Generator, shape: tuple[int, int], texel_m: float, wavelength_m: float, octaves: int = 5,
    gain: float = 0.5,
) -> NDArray[np.float32]:  # fmt: skip
    """Return noise whose crests are sharp lines, (H, W) float32 between about 0 and 1.

    Parameters are those of `fractal_noise`; each octave is 1 − |noise| (Musgrave's ridged multifractal
    without feedback: Ebert et al., Texturing and Modeling, 3rd ed. 2003, ch. 16).
    """
    total = np.zeros(shape, np.float32)
    weight = 0.0
    amplitude = 1.0
    for _ in range(octaves):
        crest = 1.0 - np.abs(smooth_noise(generator, shape, texel_m, wavelength_m))
        total += np.float32(amplitude) * np.clip(crest, 0.0, 1.0)
        weight += amplitude
        amplitude *= gain
        wavelength_m *= 0.5
        if wavelength_m <= 2.0 * texel_m:
            break
    return total / np.float32(weight)


def warp(field: Values, offset_x: Values, offset_y: Values) -> Values:
    """Return the (H, W) field sampled at positions shifted by the (H, W) offsets [texels]; edges are repeated."""
    import cv2

    height, width = field.shape[:2]
    columns = np.arange(width, dtype=np.float32)[None, :] + offset_x.astype(np.float32)
    rows = np.arange(height, dtype=np.float32)[:, None] + offset_y.astype(np.float32)
    return cv2.remap(field, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def smoothstep(low: float, high: float, value: Values | float) -> Values:
    """Return the cubic step that is 0 below `low` and 1 above `high`, in the value's shape."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
