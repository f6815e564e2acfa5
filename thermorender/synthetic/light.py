"""The sun of a synthetic scene: what it lights on a surface model, how that photographs."""

import numpy as np

from thermorender.physics import srgb
from thermorender.physics.sun import LOWEST_DEG
from thermorender.synthetic.noise import smooth_noise, stream

# Colour of light on a horizontal, unshaded surface: sun and sky shares per linear sRGB channel. Skylight is
# blue, sunlight warm; they add up to one, so a colour is given as it looks in full sun.
_SUN_SHARE = np.array([0.82, 0.795, 0.755], np.float32)
_SKY_SHARE = 1.0 - _SUN_SHARE


def _shifted(field, east_texels, north_texels):
    """Return the field read at a constant offset; edge values are repeated."""
    import cv2

    affine = np.array([[1.0, 0.0, east_texels], [0.0, 1.0, -north_texels]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(field, affine, field.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)


def sun_visibility(surface, texel_m, azimuth_deg, elevation_deg, penumbra_m=0.12):
    """Return the share of the sun's disc seen from each texel, (H, W) float32, 0 in cast shadow.

    Parameters
    ----------
    surface : (H, W) float32
        Surface heights [m], row 0 in the north.
    texel_m : float
        Side of a texel [m].
    azimuth_deg, elevation_deg : float
        Of the sun [deg].
    penumbra_m : float
        Height range over which light passes into shadow [m].

    Notes
    -----
    A texel is in shadow where the surface towards the sun rises above the ray. The highest such ray,
    M(x) = max_s h(x + s d) − s tan(elevation), is built by doubling the range marched at each step.
    """
    if elevation_deg <= LOWEST_DEG:
        return np.zeros_like(surface)
    azimuth, slope = np.radians(azimuth_deg), np.tan(np.radians(elevation_deg))
    east, north = np.sin(azimuth), np.cos(azimuth)
    length = float(surface.max() - surface.min()) / slope
    height = _shifted(surface, east, north) - np.float32(slope * texel_m)
    step = 1.0
    while step * texel_m < length and step < max(surface.shape):
        np.maximum(
            height,
            _shifted(height, step * east, step * north) - np.float32(step * slope * texel_m),
            out=height,
        )
        step *= 2.0
    return np.clip(1.0 - (height - surface) / np.float32(penumbra_m), 0.0, 1.0)


def sky_view(surface, texel_m, azimuths=8, reach_m=40.0):
    """Return the sky view factor of each texel, (H, W) float32 in 0…1, as seen by a level element.

    Notes
    -----
    Mean over azimuths of cos²(horizon elevation): Dozier & Frew, IEEE TGRS 28 (1990) 963, eq. 7b for a
    level surface; horizons are marched at distances that grow by a factor of two.
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


def normals(surface, texel_m, steepest=2.0):
    """Return unit normals as (east, north, up), three (H, W) float32.

    Slopes are limited to `steepest` [m/m]: a step between two texels is an edge, not a facet.
    """
    rise_row, rise_column = np.gradient(surface, np.float32(texel_m))
    steep = np.sqrt(rise_row**2 + rise_column**2)
    limit = np.minimum(1.0, np.float32(steepest) / np.maximum(steep, 1e-6))
    up = 1.0 / np.sqrt(1.0 + (limit * steep) ** 2)
    return -rise_column * limit * up, rise_row * limit * up, up


def incidence(normal, azimuth_deg, elevation_deg):
    """Return the cosine between surface normals and the sun, (H, W) float32, 0 where it is behind."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    toward = (
        np.cos(elevation) * np.sin(azimuth),
        np.cos(elevation) * np.cos(azimuth),
        np.sin(elevation),
    )
    cosine = sum(np.float32(t) * n for t, n in zip(toward, normal, strict=True))
    return np.maximum(cosine, 0.0)


def linear(red, green, blue):
    """Return linear sRGB, (3,) float32 in 0…1, of an 8-bit sRGB colour."""
    # In single precision throughout, as all of the painting.
    return srgb.decoded(np.array([red, green, blue], np.float32) / 255.0)


def photograph(albedo, visible, cosine, view, elevation_deg, seed, blur_texels=0.55, noise=1.1, cloud=0.0):
    """Return the orthophoto of a lit surface, (H, W, 3) uint8 sRGB.

    Parameters
    ----------
    albedo : (H, W, 3) float32
        Linear colour as it looks lying level in full sun.
    visible, cosine, view : (H, W) float32
        Sun visibility, cosine of incidence, sky view factor.
    elevation_deg : float
        Sun elevation [deg].
    seed : int
        Of the sensor noise.
    blur_texels, noise : float
        Lens blur (Gaussian σ) [texels] and sensor noise [8-bit steps].
    cloud : float
        Share of the sky whose clouds scatter the sun's light, 0…1; the exposure makes up for what they keep.
    """
    import cv2

    # Rough surfaces do not go fully dark at grazing sun: half the contrast of a Lambertian facet is kept
    # out of the direct share (Minnaert-like flattening, exponent 0.75).
    # Below the lowest sun nothing is visible: skylight alone.
    level = np.float32(np.sin(np.radians(max(elevation_deg, LOWEST_DEG))))
    direct = visible * (cosine / level) ** np.float32(0.75)
    ambient = view * np.float32(0.92) + np.float32(0.08)
    direct = np.float32(1.0 - cloud) * direct + np.float32(cloud) * ambient
    shape = albedo.shape[:2]
    generator = stream(seed, "photograph")
    grain = generator.standard_normal(shape, dtype=np.float32)
    # Exposure drifts by a few per cent between the photographs an orthophoto is stitched from.
    drift = 1.0 + np.float32(0.018) * smooth_noise(generator, shape, 1.0, max(shape) * 0.7)
    picture = np.empty((*shape, 3), np.uint8)
    for channel in range(3):
        light = _SUN_SHARE[channel] * direct + _SKY_SHARE[channel] * ambient
        value = albedo[..., channel] * light * drift
        # A shoulder instead of clipping, then a trace of haze.
        value = np.where(value > 0.7, 0.7 + 0.3 * np.tanh((value - 0.7) / 0.3), value)
        value = np.float32(0.008 * (1.0, 1.1, 1.35)[channel]) + np.float32(0.985) * np.maximum(value, 0.0)
        value = cv2.GaussianBlur(value, (0, 0), blur_texels)
        value = 255.0 * srgb.encoded(value) + np.float32(noise) * grain
        picture[..., channel] = np.clip(value + 0.5, 0, 255).astype(np.uint8)
    return picture


def sky_colour(sine, cloud=0.0):
    """Return the linear sRGB colour of the day's sky, (..., 3) float32.

    Parameters
    ----------
    sine : (...) array
        Of the elevation above the horizon, 0…1.
    cloud : float
        Share of the sky under clouds, 0…1, spread evenly: no single clouds are drawn.

    Notes
    -----
    Blue overhead and white towards the horizon, where the path through the air is long; grey under clouds, whose
    zenith is three times as bright as their horizon (Moon & Spencer, 1942, the CIE's overcast sky). Colours chosen.
    """
    high = np.clip(np.asarray(sine, np.float32), 0.0, 1.0)[..., None]
    zenith, horizon = linear(92, 138, 200), linear(206, 219, 232)
    clear = zenith + (horizon - zenith) * np.exp(-4.0 * high)
    overcast = linear(214, 216, 220) * (1.0 + 2.0 * high) / 3.0
    return ((1.0 - cloud) * clear + cloud * overcast).astype(np.float32)
