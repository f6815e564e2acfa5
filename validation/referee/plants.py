"""Frames with planted faults and innocent frames, made from the temperature pictures of a flight over a land."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.ndimage import affine_transform, gaussian_filter
from scipy.ndimage import shift as shifted

from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.physics.planck import band_radiance, brightness_temperature

# Noise of the camera in frames with a fault [K], and a smooth error of this size [K] and length [px].
_NOISE_K, _SMOOTH_K, _LENGTH_PX = 0.05, 0.1, 8.0
# A map whose standard deviation is less than this share of the ground's has almost no contrast.
_FLAT = 0.2
_MAPS = ("fok-1to1", "procedural-palette", "procedural-trees")


@dataclass
class Frame:
    """The frames of a flight and what is wrong with them.

    Attributes
    ----------
    kelvin : list of (H, W) arrays
        One frame for each pose.
    faults : dict of str to float
        Size of each planted kind; empty for innocent frames.
    effect_k : float
        Root mean square change of the ground by all faults, away from objects [K].
    """

    kelvin: list
    faults: dict = field(default_factory=dict)
    effect_k: float = 0.0


def planted(views, other, sky_k, emissivity, band_um, rng):
    """Return {name: Frame} with planted faults.

    Parameters
    ----------
    views : list of View
        Of the land, of at least four poses.
    other : (H, W) array
        Frame of a pose of the land elsewhere [K].
    sky_k : float
    emissivity : (M,) array
        Band emissivities of the land's materials.
    band_um : (lower, upper)
    rng : Generator
    """
    true = [_filled(view) for view in views]
    grounds, away = [_ground(view) for view in views], [_away(view) for view in views]
    ground = np.concatenate([kelvin[here] for kelvin, here in zip(true, grounds, strict=True)])
    mean, found = float(ground.mean()), {}

    def about(size):
        # Sizes vary from land to land.
        return size * float(rng.uniform(0.8, 1.25))

    def plant(name, kelvin, **faults):
        changes = [(one - own)[here] for one, own, here in zip(kelvin, true, away, strict=True)]
        effect = float(np.sqrt(np.mean(np.concatenate(changes) ** 2)))
        found[name] = Frame([one + _noise(rng, one.shape) for one in kelvin], faults, effect)

    def each(change):
        return [change(kelvin) for kelvin in true]

    for size in map(about, (-2.0, -0.5, 0.5)):
        plant(f"offset {size:+.2f} K", each(lambda kelvin, size=size: kelvin + size), offset=size)
    for change in map(about, (-0.3, -0.1, 0.2)):
        gain = 1.0 + change
        plant(f"contrast {gain:.2f}", each(lambda kelvin, gain=gain: mean + gain * (kelvin - mean)), contrast=change)
    for right, down in ((about(0.5), 0.0), (about(2.0), 0.0), (about(-3.0), about(1.0))):
        plant(f"shift {right:.1f} {down:.1f} px", each(lambda kelvin, at=(right, down): moved(kelvin, *at)),
              shift=float(np.hypot(right, down)))  # fmt: skip
    for sigma in map(about, (1.0, 1.5, 2.5)):
        plant(f"blur {sigma:.1f} px", each(lambda kelvin, sigma=sigma: gaussian_filter(kelvin, sigma)), blur=sigma)
    number = _material(views[0], rng)
    if number is not None:
        where = [view.material == number for view in views]
        for size in map(about, (-2.0, 1.5)):
            plant(f"material {size:+.2f} K", [one + size * here for one, here in zip(true, where, strict=True)],
                  material=size)  # fmt: skip
        for change in map(about, (-0.15, -0.06)):
            kelvin = []
            for one, here in zip(true, where, strict=True):
                radiance = band_radiance(one, *band_um)
                contrast = (radiance - band_radiance(sky_k, *band_um)) / max(emissivity[number], 0.1)
                kelvin.append(brightness_temperature(radiance + change * here * contrast, *band_um))
            plant(f"emissivity {change:+.3f}", kelvin, emissivity=change)
    plant("upside down", each(lambda kelvin: kelvin[::-1]), mirrored=1.0)
    plant("left to right", each(lambda kelvin: kelvin[:, ::-1]), mirrored=1.0)
    plant("another pose", [other] * len(true), unlike=1.0)
    damped = each(lambda kelvin: moved(mean + 0.9 * (kelvin - mean), 2.0, 0.0) + 1.0)
    plant("contrast, shift, offset", damped, contrast=-0.1, shift=2.0, offset=1.0)
    plant("shift, blur", each(lambda kelvin: gaussian_filter(moved(kelvin, 1.0, -1.0), 1.5)), shift=2.0**0.5, blur=1.5)
    _by_pose(true, ground, about, plant)
    return found


def _by_pose(true, ground, about, plant):
    """Plant faults that vary by pose, that grow towards the edge of a frame, or that hold beyond a temperature."""
    poses = len(true)
    plant("frames swapped in pairs", [true[k ^ 1 if k ^ 1 < poses else k] for k in range(poses)], order=1.0)
    plant("frames late by one", [true[max(k - 1, 0)] for k in range(poses)], order=1.0)
    plant("frames early by one", [true[min(k + 1, poses - 1)] for k in range(poses)], order=1.0)
    for change in map(about, (0.03, -0.03, 0.01)):
        plant(f"zoom {change:+.3f}", [zoomed(kelvin, change) for kelvin in true], zoom=change)
    for name, offsets in (
        ("drift", np.linspace(-1.0, 1.0, poses) * about(2.0)),
        ("slow drift", np.linspace(0.5, -0.5, poses) * about(1.5)),
        ("jumps", np.resize([1.0, -1.0, -0.5, 0.7], poses) * about(1.0)),
    ):  # fmt: skip
        offsets = offsets - offsets.mean()
        plant(f"{name} {offsets.std():.2f} K", [one + offset for one, offset in zip(true, offsets, strict=True)],
              drift=float(offsets.std()))  # fmt: skip
    for share in map(about, (0.15, 0.35)):
        highest, lowest = np.quantile(ground, (1.0 - share, share))
        plant(f"clipped above, {share:.0%}", [np.minimum(one, highest) for one in true], clipping=share)
        plant(f"clipped below, {share:.0%}", [np.maximum(one, lowest) for one in true], clipping=-share)


def innocent(views, band_um, rng):
    """Return {name: Frame} with errors that have no cause to name: noise, and maps of the photograph.

    Maps are calibrated by a line through this land's own temperatures; a grey picture gets their distribution. A map
    that then varies less than `_FLAT` of the ground does has a cause, almost no contrast, and is planted so.
    """
    true, grounds = [_filled(view) for view in views], [_ground(view) for view in views]
    ground = np.concatenate([kelvin[here] for kelvin, here in zip(true, grounds, strict=True)])

    def of_ground(images):
        return np.concatenate([image[here] for image, here in zip(images, grounds, strict=True)])

    def each(change):
        return [change(kelvin) for kelvin in true]

    found = {f"noise {size:g} K": each(lambda kelvin, size=size: kelvin + size * rng.normal(size=kelvin.shape))
             for size in (0.05, 0.2)}  # fmt: skip
    for length in (2.0, 6.0, 20.0):
        for size in (0.3, 1.0):
            found[f"smooth {length:g} px, {size:g} K"] = each(
                lambda kelvin, at=(length, size): kelvin + smooth(rng, kelvin.shape, *at))  # fmt: skip
    # Noise of another strength on each material, as textures cause it.
    strength = rng.uniform(0.0, 1.0, 256)
    found["by texture"] = [kelvin + strength[view.material] * smooth(rng, kelvin.shape, 3.0, 1.0)
                           for kelvin, view in zip(true, views, strict=True)]  # fmt: skip
    # The camera's tone and noise differ from land to land.
    gamma = rng.uniform(0.7, 1.4)
    toned = [255.0 * (view.visible / 255.0) ** gamma + 2.0 * rng.normal(size=view.visible.shape) for view in views]
    visible = [np.clip(image, 0.0, 255.0).astype(np.uint8) for image in toned]
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(float) for image in visible]
    for name, images in (("grey", grey), ("grey, softened", [gaussian_filter(image, 1.5) for image in grey])):
        images = [image + 1e-3 * rng.normal(size=image.shape) for image in images]
        known = of_ground(images)
        turn = -1.0 if np.corrcoef(known, ground)[0, 1] < 0.0 else 1.0
        found[f"{name}, matched"] = [
            np.interp(turn * image, np.sort(turn * known), np.sort(ground)) for image in images
        ]
    for name in _MAPS:
        model, images = load_model(name), []
        for view, rgb in zip(views, visible, strict=True):
            image = apparent_temperature(model.radiance(Inputs(rgb, view.texel_m)), model.band_um)
            images.append(np.where(np.isfinite(image), image, np.nanmedian(image)).astype(float))
        slope, zero = _line(of_ground(images), ground)
        found[f"{name}, calibrated"] = [zero + slope * image for image in images]
        # Half of the error of a map, in its own pattern, so that contrast and offset of each pose are right.
        found[f"{name}, error without contrast"] = []
        for image, kelvin, here in zip(images, true, grounds, strict=True):
            rest = 0.5 * (zero + slope * image - kelvin)
            less, nought = _line(kelvin[here], rest[here])
            found[f"{name}, error without contrast"].append(kelvin + rest - nought - less * kelvin)
    frames = {}
    for name, kelvin in found.items():
        gain, _ = _line(ground, of_ground(kelvin))
        changes = of_ground([one - own for one, own in zip(kelvin, true, strict=True)])
        flat = of_ground(kelvin).std() < _FLAT * ground.std()
        frames[name] = Frame(kelvin, {"flat": gain - 1.0} if flat else {},
                             float(np.sqrt(np.mean(changes**2))) if flat else 0.0)  # fmt: skip
    return frames


def _noise(rng, shape):
    """Return the noise of a camera and a smooth error, (H, W) [K]."""
    return _NOISE_K * rng.normal(size=shape) + smooth(rng, shape, _LENGTH_PX, _SMOOTH_K)


def smooth(rng, shape, length_px, size):
    """Return a smooth random field of a correlation length and standard deviation, (H, W)."""
    found = gaussian_filter(rng.normal(size=shape), length_px, mode="wrap")
    return size * (found - found.mean()) / found.std()


def moved(image, right, down):
    """Return a picture shifted by fractions of a pixel."""
    return shifted(image, (down, right), order=5, mode="nearest")


def zoomed(image, change):
    """Return a picture that is larger by a share about its middle."""
    middle = 0.5 * (np.array(image.shape) - 1.0)
    return affine_transform(image, np.full(2, 1.0 / (1.0 + change)), middle - middle / (1.0 + change), order=5,
                            mode="nearest")  # fmt: skip


def _line(x, y):
    """Return the slope and the value at zero of the least-squares line; a slope of 0 where x is constant."""
    about = x - x.mean()
    square = float(about @ about)
    slope = float(about @ y) / square if square > 1e-9 * len(x) else 0.0
    return slope, float(y.mean() - slope * x.mean())


def _ground(view):
    return view.known & (view.object < 0)


def _away(view):
    """Return ground not beside objects and the border, where a hot object may be moved onto the ground."""
    found = cv2.erode(_ground(view).astype(np.uint8), np.ones((15, 15), np.uint8), borderValue=0).astype(bool)
    return found if found.any() else _ground(view)


def _filled(view):
    true = view.truth.astype(float)
    return np.where(np.isfinite(true) & (true > 150.0), true, np.median(true[view.known]))


def _material(view, rng):
    """Return the number of a random material with 3 to 60 % of the ground, None without one."""
    counts = np.bincount(view.material[_ground(view)], minlength=256)[:255] / max(_ground(view).sum(), 1)
    possible = np.flatnonzero((counts > 0.03) & (counts < 0.6))
    return int(rng.choice(possible)) if len(possible) else None
