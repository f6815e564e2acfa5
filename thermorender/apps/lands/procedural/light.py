"""Sunlight on a surface model, and the orthophoto of the lit surface."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.noise import smooth_noise, stream
from thermorender.physics import srgb
from thermorender.physics.sun import LOWEST_DEG

# Light on a horizontal, unshaded surface: sun and sky shares per linear sRGB channel. Skylight is blue, sunlight warm;
# they sum to one, so colours are those in full sun.
_SUN_SHARE = np.array([0.82, 0.795, 0.755], np.float32)
_SKY_SHARE = 1.0 - _SUN_SHARE


def _shifted(field: NDArray[np.float32], east_texels: float, north_texels: float) -> Any:
    """Return the field sampled at a constant offset; edges are repeated."""
    import cv2

    affine = np.array([[1.0, 0.0, east_texels], [0.0, 1.0, -north_texels]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(field, affine, field.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)


def sun_visibility(
    surface: NDArray[np.float32], texel_m: float, azimuth_deg: float, elevation_deg: float, penumbra_m: float = 0.12
) -> NDArray[np.float32]:
    """Return the visible fraction of the sun's disc from each texel of a surface of heights [m], (H, W) float32, 0 in
    cast shadow. Shadows soften over `penumbra_m` of height.

    A texel is in shadow where the surface towards the sun rises above the ray. The highest such ray, M(x) = max_s h(x +
    s d) − s tan(elevation), is computed by doubling the searched range at each step.
    """
    if elevation_deg <= LOWEST_DEG:
        return np.zeros_like(surface)
    azimuth, slope = np.radians(azimuth_deg), np.tan(np.radians(elevation_deg))
    east, north = np.sin(azimuth), np.cos(azimuth)
    length = float(surface.max() - surface.min()) / slope
    height = _shifted(surface, east, north) - np.float32(slope * texel_m)
    step = 1.0
    while step * texel_m < length and step < max(surface.shape):
        np.maximum(height, _shifted(height, step * east, step * north) - np.float32(step * slope * texel_m), out=height)
        step *= 2.0
    return np.clip(1.0 - (height - surface) / np.float32(penumbra_m), 0.0, 1.0)


def sky_view(
    surface: NDArray[np.float32], texel_m: float, azimuths: int = 8, reach_m: float = 40.0
) -> NDArray[np.float32]:
    """Return the sky view factor of a level element at each texel, (H, W) float32 in 0…1.

    Mean over azimuths of cos²(horizon elevation): Dozier & Frew, IEEE TGRS 28 (1990) 963, eq. 7b for a level surface;
    horizons are searched at distances that double.
    """
    total = np.zeros_like(surface)
    for index in range(azimuths):
        azimuth = 2.0 * np.pi * (index + 0.5) / azimuths
        tangent = np.zeros_like(surface)
        distance = 1.5 * texel_m
        while distance <= reach_m:
            texels = distance / texel_m
            seen = _shifted(surface, texels * np.sin(azimuth), texels * np.cos(azimuth))
            np.maximum(tangent, (seen - surface) / np.float32(distance), out=tangent)
            distance *= 2.0
        total += 1.0 / (1.0 + tangent * tangent)
    return total / np.float32(azimuths)


def normals(
    surface: NDArray[np.float32], texel_m: float, steepest: float = 2.0
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return unit normals as (east, north, up), three (H, W) float32.

    Slopes are limited to `steepest` [m/m]: a step between two texels is an edge, not a facet.
    """
    rise_row, rise_column = np.gradient(surface, np.float32(texel_m))
    steep = np.sqrt(rise_row**2 + rise_column**2)
    limit = np.minimum(1.0, np.float32(steepest) / np.maximum(steep, 1e-6))
    up = 1.0 / np.sqrt(1.0 + (limit * steep) ** 2)
    return -rise_column * limit * up, rise_row * limit * up, up


def incidence(normal: tuple[NDArray[np.float32], ...], azimuth_deg: float, elevation_deg: float) -> NDArray[np.float32]:
    """Return the cosine between surface normals and the sun, (H, W) float32, 0 if the sun is behind the surface."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    toward = (np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation))
    cosine = sum(np.float32(t) * n for t, n in zip(toward, normal, strict=True))
    return np.maximum(cosine, 0.0)


def linear(red: int, green: int, blue: int) -> NDArray[np.float32]:
    """Return linear sRGB, (3,) float32 in 0…1, of an 8-bit sRGB colour."""
    # Single precision, as in all painting.
    return srgb.decoded(np.array([red, green, blue], np.float32) / 255.0)


def photograph(
    albedo: NDArray[np.float32], visible: NDArray[np.float32], cosine: NDArray[np.float32], view: NDArray[np.float32],
    elevation_deg: float, seed: int, blur_texels: float = 0.55, noise: float = 1.1, cloud: float = 0.0,
) -> NDArray[np.uint8]:  # fmt: skip
    """Return the orthophoto of a lit surface, (H, W, 3) uint8 sRGB, with lens blur (Gaussian σ in texels) and sensor
    noise [8-bit steps]. The albedo is linear; `visible`, `cosine` and `view` are sun visibility, cosine of incidence
    and sky view factor, (H, W). Clouds scatter sunlight, and the exposure compensates for their absorption.
    """
    import cv2

    direct, ambient = _light(visible, cosine, view, elevation_deg, cloud)
    shape = albedo.shape[:2]
    generator = stream(seed, "photograph")
    grain = generator.standard_normal(shape, dtype=np.float32)
    # Exposure differs by a few per cent between the photographs of an orthophoto mosaic.
    drift = 1.0 + np.float32(0.018) * smooth_noise(generator, shape, 1.0, max(shape) * 0.7)
    picture = np.empty((*shape, 3), np.uint8)
    for channel in range(3):
        light = _SUN_SHARE[channel] * direct + _SKY_SHARE[channel] * ambient
        value = _developed(albedo[..., channel] * light * drift, channel)
        blurred = np.asarray(cv2.GaussianBlur(value, (0, 0), blur_texels), np.float32)
        value = 255.0 * srgb.encoded(blurred) + np.float32(noise) * grain
        picture[..., channel] = np.clip(value + 0.5, 0, 255).astype(np.uint8)
    return picture


def _light(
    visible: NDArray[np.float32] | float, cosine: NDArray[np.float32], view: NDArray[np.float32], elevation_deg: float,
    cloud: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
    """(direct, ambient) light as shares of that on a level surface in full sun."""
    # At grazing sun, rough surfaces are brighter than Lambertian ones (Minnaert-like, exponent 0.75). Below the lowest
    # sun there is skylight only.
    level = np.float32(np.sin(np.radians(max(elevation_deg, LOWEST_DEG))))
    direct = visible * (cosine / level) ** np.float32(0.75)
    ambient = view * np.float32(0.92) + np.float32(0.08)
    return np.float32(1.0 - cloud) * direct + np.float32(cloud) * ambient, ambient


def _developed(value: NDArray[np.float32], channel: int) -> NDArray[np.float32]:
    """Light of one channel on the picture: a soft shoulder instead of clipping, then a little haze."""
    value = np.where(value > 0.7, 0.7 + 0.3 * np.tanh((value - 0.7) / 0.3), value)
    return np.float32(0.008 * (1.0, 1.1, 1.35)[channel]) + np.float32(0.985) * np.maximum(value, 0.0)


def exposed(
    albedo: NDArray[np.float32], cosine: NDArray[np.float32], view: NDArray[np.float32], elevation_deg: float,
    cloud: float = 0.0,
) -> NDArray[np.float32]:  # fmt: skip
    """Return the linear light on a picture of T lit texels, (T, 3) float32, without blur and noise. `cosine`, (T,), is
    0 in shadow, and `view` the sky view factor.
    """
    direct, ambient = _light(1.0, cosine, view, elevation_deg, cloud)
    parts = [_SUN_SHARE[k] * direct + _SKY_SHARE[k] * ambient for k in range(3)]
    return np.stack([_developed(albedo[:, k] * light, k) for k, light in enumerate(parts)], axis=-1)
