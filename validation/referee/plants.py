"""Frames with planted faults and innocent frames, made from the temperature picture of a rendered land."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as shifted

from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.physics.planck import band_radiance, brightness_temperature

# Noise of the camera in frames with a fault [K], and a smooth error of this size [K] and length [px].
_NOISE_K, _SMOOTH_K, _LENGTH_PX = 0.05, 0.1, 8.0
_MAPS = ("fok-1to1", "procedural-palette", "procedural-trees")


@dataclass
class Frame:
    """A frame and what is wrong with it.

    Attributes
    ----------
    kelvin : (H, W) array
    faults : dict of str to float
        Size of each planted kind; empty for an innocent frame.
    effect_k : float
        Root mean square change of the ground by all faults, away from objects [K].
    """

    kelvin: np.ndarray
    faults: dict = field(default_factory=dict)
    effect_k: float = 0.0


def planted(view, other, sky_k, emissivity, band_um, rng):
    """Return {name: Frame} with planted faults.

    Parameters
    ----------
    view : View
        Of the land.
    other : (H, W) array
        Frame of another pose of the land [K].
    sky_k : float
    emissivity : (M,) array
        Band emissivities of the land's materials.
    band_um : (lower, upper)
    rng : Generator
    """
    true = _filled(view)
    mean = float(true[_ground(view)].mean())
    # Not beside objects and the border, where a hot object may be moved onto the ground.
    away = cv2.erode(_ground(view).astype(np.uint8), np.ones((15, 15), np.uint8), borderValue=0).astype(bool)
    away = away if away.any() else _ground(view)
    found = {}

    def about(size):
        # Sizes vary from land to land.
        return size * float(rng.uniform(0.8, 1.25))

    def plant(name, kelvin, **faults):
        effect = float(np.sqrt(np.mean((kelvin - true)[away] ** 2)))
        noise = _NOISE_K * rng.normal(size=kelvin.shape) + smooth(rng, kelvin.shape, _LENGTH_PX, _SMOOTH_K)
        found[name] = Frame(kelvin + noise, faults, effect)

    for size in map(about, (-2.0, -0.5, 0.5)):
        plant(f"offset {size:+.2f} K", true + size, offset=size)
    for change in map(about, (-0.3, -0.1, 0.2)):
        plant(f"contrast {1.0 + change:.2f}", mean + (1.0 + change) * (true - mean), contrast=change)
    for right, down in ((about(0.5), 0.0), (about(2.0), 0.0), (about(-3.0), about(1.0))):
        plant(f"shift {right:.1f} {down:.1f} px", moved(true, right, down), shift=float(np.hypot(right, down)))
    for sigma in map(about, (1.0, 1.5, 2.5)):
        plant(f"blur {sigma:.1f} px", gaussian_filter(true, sigma), blur=sigma)
    number = _material(view, rng)
    if number is not None:
        here = view.material == number
        for size in map(about, (-2.0, 1.5)):
            plant(f"material {size:+.2f} K", true + size * here, material=size)
        for change in map(about, (-0.15, -0.06)):
            radiance = band_radiance(true, *band_um)
            contrast = (radiance - band_radiance(sky_k, *band_um)) / max(emissivity[number], 0.1)
            kelvin = brightness_temperature(radiance + change * here * contrast, *band_um)
            plant(f"emissivity {change:+.3f}", kelvin, emissivity=change)
    plant("upside down", true[::-1], mirrored=1.0)
    plant("left to right", true[:, ::-1], mirrored=1.0)
    plant("another pose", other, unlike=1.0)
    damped = mean + 0.9 * (true - mean)
    plant("contrast, shift, offset", moved(damped, 2.0, 0.0) + 1.0, contrast=-0.1, shift=2.0, offset=1.0)
    plant("shift, blur", gaussian_filter(moved(true, 1.0, -1.0), 1.5), shift=2.0**0.5, blur=1.5)
    return found


def innocent(view, band_um, rng):
    """Return {name: Frame} with errors that have no cause to name: noise, and maps of the photograph.

    Maps are calibrated by a line through this land's own temperatures; a grey picture gets their distribution.
    """
    true, ground = _filled(view), _ground(view)
    found = {f"noise {size:g} K": true + size * rng.normal(size=true.shape) for size in (0.05, 0.2)}
    for length in (2.0, 6.0, 20.0):
        for size in (0.3, 1.0):
            found[f"smooth {length:g} px, {size:g} K"] = true + smooth(rng, true.shape, length, size)
    # Noise of another strength on each material, as textures cause it.
    found["by texture"] = true + rng.uniform(0.0, 1.0, 256)[view.material] * smooth(rng, true.shape, 3.0, 1.0)
    # The camera's tone and noise differ from land to land.
    toned = 255.0 * (view.visible / 255.0) ** rng.uniform(0.7, 1.4) + 2.0 * rng.normal(size=view.visible.shape)
    visible = np.clip(toned, 0.0, 255.0).astype(np.uint8)
    grey = cv2.cvtColor(visible, cv2.COLOR_RGB2GRAY).astype(float)
    for name, image in (("grey", grey), ("grey, softened", gaussian_filter(grey, 1.5))):
        found[f"{name}, matched"] = _matched(image, true, ground, rng)
    for name in _MAPS:
        model = load_model(name)
        image = apparent_temperature(model.radiance(Inputs(visible, view.texel_m)), model.band_um)
        image = np.where(np.isfinite(image), image, np.nanmedian(image)).astype(float)
        slope, zero = _line(image[ground], true[ground])
        found[f"{name}, calibrated"] = zero + slope * image
        found[f"half {name}"] = 0.5 * true + 0.5 * (zero + slope * image)
    # Half of the error of a map, in its own pattern, so that its contrast is right.
    for name in _MAPS:
        rest = found.pop(f"half {name}") - true
        slope, zero = _line(true[ground], rest[ground])
        found[f"{name}, error without contrast"] = true + rest - zero - slope * true
    return {name: Frame(kelvin) for name, kelvin in found.items()}


def smooth(rng, shape, length_px, size):
    """Return a smooth random field of a correlation length and standard deviation, (H, W)."""
    found = gaussian_filter(rng.normal(size=shape), length_px, mode="wrap")
    return size * (found - found.mean()) / found.std()


def moved(image, right, down):
    """Return a picture shifted by fractions of a pixel."""
    return shifted(image, (down, right), order=5, mode="nearest")


def _line(x, y):
    """Return the slope and the value at zero of the least-squares line; a slope of 0 where x is constant."""
    about = x - x.mean()
    square = float(about @ about)
    slope = float(about @ y) / square if square > 1e-9 * len(x) else 0.0
    return slope, float(y.mean() - slope * x.mean())


def _ground(view):
    return view.known & (view.object < 0)


def _filled(view):
    true = view.truth.astype(float)
    return np.where(np.isfinite(true) & (true > 150.0), true, np.median(true[view.known]))


def _material(view, rng):
    """Return the number of a random material with 3 to 60 % of the ground, None without one."""
    counts = np.bincount(view.material[_ground(view)], minlength=256)[:255] / max(_ground(view).sum(), 1)
    possible = np.flatnonzero((counts > 0.03) & (counts < 0.6))
    return int(rng.choice(possible)) if len(possible) else None


def _matched(grey, true, ground, rng):
    """Return a grey picture with the temperatures of the ground, the bright ones warm if that correlates better."""
    image = grey + 1e-3 * rng.normal(size=grey.shape)
    if np.corrcoef(image[ground], true[ground])[0, 1] < 0.0:
        image = -image
    return np.interp(image, np.sort(image[ground]), np.sort(true[ground]))
