"""The lens's blur: its optical transfer function, and the small kernel that applies it to an image of pixels.

A rendered pixel already contains the pixel aperture. Detail finer than pixels is aliased before the blur, and not after
it as in a camera; the study `validation.sensor` measures this error.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.planck import spectral_radiance
from thermorender.sensor.camera import Camera, Image

# Number of wavelengths that sample the band, and the temperature whose spectrum weights them [K].
_WAVELENGTHS, _SOURCE_K = 8, 300.0
# Sides of the two kernels, and width of a square of the coarse one [px].
FINE, COARSE, STEP = 7, 5, 8
# Frequencies per axis of the fit, and the lowest: one cycle per image [cycles per pixel].
_FREQUENCIES, _LOWEST = 64, 1.0 / 640.0


def lens_otf(
    frequency: ArrayLike, wavelength_um: float, f_number: float, defocus_um: float = 0.0
) -> NDArray[np.float64]:
    """Return the real optical transfer function of an aberration-free lens, round aperture, at `frequency` [1/µm].

    Overlap of two apertures shifted by s = ν λ F of their diameter, with the phase 4 W s x between them, where W = δ/(8
    F²) is the path difference at the rim for a detector δ from focus (Hopkins 1955, doi:10.1098/rspa.1955.0158). In
    focus it is 2/π (arccos s − s √(1−s²)) (Goodman, Introduction to Fourier Optics, eq. 6-31).
    """
    shift = np.minimum(np.abs(np.asarray(frequency, np.float64)) * wavelength_um * f_number, 1.0)
    if not defocus_um:
        return 2.0 / np.pi * (np.arccos(shift) - shift * np.sqrt(1.0 - shift**2))
    path = defocus_um / (8.0 * f_number**2)
    node, weight = np.polynomial.legendre.leggauss(200)
    # x = 1 − s − (1−s) u² takes the root out of the integrand at the rim.
    u = 0.5 * (node + 1.0)
    width = 1.0 - shift[..., None]
    x = width * (1.0 - u**2)
    height = np.sqrt(np.maximum(1.0 - (x + shift[..., None]) ** 2, 0.0))
    wave = np.cos(8.0 * np.pi * path / wavelength_um * shift[..., None] * x)
    return 4.0 / np.pi * ((height * wave * 2.0 * width * u) @ (0.5 * weight))


def gaussian_otf(frequency: NDArray[np.float64], sigma_px: float) -> NDArray[np.float64]:
    """Return the transfer function of a Gaussian of width `sigma_px` [px] at frequencies [cycles per pixel]."""
    return np.exp(-2.0 * (np.pi * sigma_px * frequency) ** 2)


def otf(camera: Camera, frequency: ArrayLike) -> NDArray[np.float64]:
    """Return the transfer function of a camera's lens at frequencies [cycles per pixel], without the pixel aperture.

    The mean over the band, weighted with the spectrum of a blackbody at 300 K, times the Gaussian of all other blur.
    """
    frequency = np.asarray(frequency, np.float64)
    blur = gaussian_otf(frequency, camera.blur_sigma_px)
    if not (camera.diffraction or camera.defocus_um):
        return blur
    low, high = camera.band_um
    wavelength = low + (np.arange(_WAVELENGTHS) + 0.5) / _WAVELENGTHS * (high - low)
    weight = spectral_radiance(wavelength, _SOURCE_K)
    along = frequency / camera.pixel_pitch_um
    each = [lens_otf(along, value, camera.f_number, camera.defocus_um) for value in wavelength]
    return blur * np.tensordot(weight / weight.sum(), np.array(each), axes=1)


class Blur(NamedTuple):
    """A blur as two kernels, one on the pixels and one on squares of `STEP` pixels for the far tails."""

    # fine, coarse: (n, n) float32 their total sum is 1
    fine: Image
    coarse: Image
    error: float  # Root mean square error over the contrast of a scene, with the scene spectrum of `blur_of`


@lru_cache(maxsize=16)
def blur_of(camera: Camera, fine: int = FINE, coarse: int = COARSE) -> Blur:
    """Return the Blur that applies `otf` to an image of pixels, by kernels of odd sides; `coarse` 0 for none.

    Least squares up to the Nyquist frequencies, weighted with the spectrum of scenes: power falls with the square of
    frequency (Field 1987, doi:10.1364/JOSAA.4.002379), times the pixel aperture. The tails matter: a round aperture
    spreads 6 % of the light beyond 2.5 pixels. A 5 × 5 kernel without them changes a scene's contrast by 1.9 % root
    mean square.
    """
    edge = np.concatenate([[0.0], np.geomspace(_LOWEST, 0.5, _FREQUENCIES)])
    line, width = 0.5 * (edge[1:] + edge[:-1]), np.diff(edge)
    radius = np.hypot(line[:, None], line)
    table = np.concatenate([[0.0], np.geomspace(0.1 * _LOWEST, np.sqrt(0.5), 2000)])
    transfer = np.interp(radius, table, otf(camera, table))
    scene = np.outer(np.sinc(line) ** 2 * width, np.sinc(line) ** 2 * width) / (radius**2 + _LOWEST**2)
    # Averaging over squares, and linear interpolation back to pixels.
    there_and_back = np.sinc(STEP * line) ** 3
    fine_waves = _waves(line, fine)
    coarse_waves = [there_and_back[:, None] * wave * there_and_back for wave in _waves(STEP * line, coarse)]
    waves = np.stack([*fine_waves, *coarse_waves], axis=-1)
    # The centre of the fine kernel, which comes first, completes the sum to 1.
    count = np.array([wave[0] for wave in _waves(np.zeros(1), fine) + _waves(np.zeros(1), coarse)]).ravel()
    free, weight = waves[..., 1:] - count[1:], np.sqrt(scene)
    wanted = ((transfer - 1.0) * weight).ravel()
    basis = (free * weight[..., None]).reshape(wanted.size, -1)
    values = np.linalg.lstsq(basis, wanted, rcond=None)[0]
    error = float(np.sqrt(((wanted - basis @ values) ** 2).sum() / scene.sum()))
    values = np.concatenate([[1.0 - count[1:] @ values], values])
    split = len(fine_waves)
    return Blur(_kernel(values[:split], fine), _kernel(values[split:], coarse), error)


def blurred(image: Image, blur: Blur | None) -> Image:
    """Return an image (H, W) after a Blur, in the precision of the image, mirrored at its borders; None: unchanged."""
    import cv2

    if blur is None:
        return image
    near: Any = cv2.filter2D(image, -1, blur.fine, borderType=cv2.BORDER_REFLECT)
    if not blur.coarse.size:
        return near
    height, width = image.shape
    down, right = -height % STEP, -width % STEP
    # In whole squares.
    whole: Any = cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REFLECT) if down or right else image
    size = (whole.shape[1], whole.shape[0])
    squares = cv2.resize(whole, (size[0] // STEP, size[1] // STEP), interpolation=cv2.INTER_AREA)
    squares = cv2.filter2D(squares, -1, blur.coarse, borderType=cv2.BORDER_REFLECT)
    far: Any = cv2.resize(squares, size, interpolation=cv2.INTER_LINEAR)
    near += far[:height, :width]
    return near


def filtered(image: ArrayLike, transfer: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return an image (H, W) float64 after a transfer function of frequency [cycles/px], mirrored at its borders.

    It is exact, by the cosine series: the slow reference of `blurred`.
    """
    from scipy.fft import dctn, idctn

    image = np.asarray(image, np.float64)
    row, column = (0.5 * np.arange(n) / n for n in image.shape)
    return idctn(dctn(image, norm="ortho") * transfer(np.hypot(row[:, None], column)), norm="ortho")


def _offsets(side: int) -> list[tuple[int, int]]:
    """Offsets (m, n) of the weights in one eighth of a kernel, 0 ≤ n ≤ m; the others are mirrored."""
    return [(m, n) for m in range(side // 2 + 1) for n in range(m + 1)] if side else []


def _waves(line: NDArray[np.float64], side: int) -> list[NDArray[np.float64]]:
    """Transfer functions over a quarter of the plane of ones at (±m, ±n) and (±n, ±m), for each of `_offsets`."""
    cosine = [np.cos(2.0 * np.pi * m * line) * (2.0 if m else 1.0) for m in range(side // 2 + 1)]
    return [
        np.outer(cosine[m], cosine[n]) + (np.outer(cosine[n], cosine[m]) if m != n else 0.0) for m, n in _offsets(side)
    ]


def _kernel(values: NDArray[np.float64], side: int) -> Image:
    half, weights = side // 2, np.zeros((side, side), np.float32)
    for (m, n), value in zip(_offsets(side), values, strict=True):
        for i, j in ((m, n), (n, m)):
            weights[np.ix_([half - i, half + i], [half - j, half + j])] = value
    return weights
