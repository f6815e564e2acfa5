"""The noise of a camera from a sequence of its frames of an unknown scene.

The lens passes no fine detail, so in flat parts the highest frequencies are noise. The fixed pattern is the mean
product of the spectra of different frames, in which a moving scene averages out. Noise of whole rows and columns is two
lines in a spectrum above their surroundings.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError

Floats = NDArray[np.float64]
# Side of the blocks in which flat parts are searched [px], and the share of blocks that count as flat.
_BLOCK, FLAT = 32, 0.1
# Bands of frequencies that decide whether a block is flat, and that give its noise [cycles per pixel]. They are
# separate, so that the choice of blocks does not bias the noise.
_TEXTURE, _FINE = (0.1, 0.22), (0.5, 0.71)
# Share of the power of a scene's texture that lens and pixels pass as finest detail, from simulated heath.
_LEAK = 0.0015
# Ratio of the power of changes between frames of a static camera, in texture over finest detail, above which the scene
# changes; noise has 1.
_LIVELY = 1.1
# A new fixed pattern shows as more power in finest detail of the difference from the frame before: ratio to the median
# of all differences, and excess in median absolute deviations. Fewest differences for this test.
_ANOTHER, _APART, _FEWEST = 1.05, 5.0, 4
# Relative uncertainty of the power of the noise above which it cannot be separated from the scene.
_INSEPARABLE = 0.5
# First bins beside an axis with the leakage of its line; the following ones are its surroundings.
_LEAKED, _BESIDE = 3, 13
# Row and column noise is measured above this frequency, where little of the scene is left [cycles per pixel].
_LINE_FROM = 0.3
# Power of Hann's window in its central line over that of a flat window, and number of its neighbouring frequencies
# that carry as much information as one independent frequency.
_HANN_LINE, _HANN_ALIKE = 2.0 / 3.0, 3.8


class Spectra:
    """Power spectra of frames of one size; `gain`, (H, W), is each pixel's noise gain by the flat-field correction."""

    def __init__(self, shape: tuple[int, int], gain: Floats | None = None) -> None:
        self.shape, self.count = shape, 0
        self._blocks: list[Floats] = []
        self._changes: list[Floats] = []
        self._last: Floats | None = None
        self.gain = np.ones(shape) if gain is None else gain
        # Blocks that are cut off at an end of the range in any frame.
        self.lost = np.zeros((shape[0] // _BLOCK) * (shape[1] // _BLOCK), bool)
        self._image, self._power = np.zeros(shape), np.zeros((shape[0], shape[1] // 2 + 1))
        self._sum = np.zeros(self._power.shape, complex)
        if min(shape) < 3 * _BLOCK:
            raise ThermorenderError(
                f"frames of {shape[1]}×{shape[0]} pixels are too small to read noise from; give some of at least "
                f"{3 * _BLOCK}×{3 * _BLOCK}"
            )

    def add(self, image: Floats, cut_off: NDArray[np.bool_] | None = None) -> None:
        """Add a frame, (H, W) [K]; NaN is replaced by the mean.

        Blocks with `cut_off` pixels, (H, W) bool, are not flat.
        """
        if image.shape != self.shape:
            raise ThermorenderError(
                f"a frame is {image.shape[1]}×{image.shape[0]} pixels and the others {self.shape[1]}×{self.shape[0]}; "
                "give frames of one camera"
            )
        if not np.isfinite(image).any():
            raise ThermorenderError("a frame has no finite value; leave it out")
        image = np.where(np.isfinite(image), image, np.nanmean(image))
        spectrum = _spectrum(image - image.mean())
        self.count += 1
        self._image += image
        self._power, self._sum = self._power + np.abs(spectrum) ** 2, self._sum + spectrum
        lost = np.zeros(len(self.lost), bool) if cut_off is None else block_means(cut_off.astype(float)) > 0.0
        self.lost |= lost
        self._blocks.append(block_powers(image))
        self._blocks[-1][lost] = np.inf
        if self._last is not None:
            self._changes.append(block_powers((image - self._last) / np.sqrt(2.0)))
            self._changes[-1][lost] = np.inf
        self._last = image

    @property
    def image(self) -> Floats:
        """Mean frame, (H, W) [K]."""
        return self._image / self.count

    @property
    def total(self) -> Floats:
        """Mean power of a frame, (H, W//2+1) [K²]; white noise of variance σ² has σ² at every frequency."""
        return np.asarray(self._power / self.count)

    @property
    def fixed(self) -> Floats:
        """Mean power of the part common to all frames, (H, W//2+1) [K²], unbiased; needs two frames."""
        return np.asarray((np.abs(self._sum) ** 2 - self._power) / (self.count * (self.count - 1)))

    @property
    def blocks(self) -> Floats:
        """Powers of texture and of the finest detail in each block of each frame, (n, 2) [K²]."""
        return np.concatenate(self._blocks)

    @property
    def changes(self) -> Floats:
        """The same powers of the change from each frame to the next, over √2, (n, 2) [K²]; needs two frames."""
        return np.concatenate(self._changes)

    def corrected(self) -> list[int]:
        """Return the frame numbers before which a flat-field correction changed the pattern of a static camera.

        It uses the finest detail of most blocks, and needs five frames.
        """
        if len(self._changes) < _FEWEST or self.lost.all():
            return []
        power = np.array([np.median(change[~self.lost, 1]) for change in self._changes])
        middle = np.median(power)
        spread = 1.48 * np.median(np.abs(power - middle))
        return (1 + np.flatnonzero(power > np.maximum(_ANOTHER * middle, middle + _APART * spread))).tolist()

    def frequencies(self) -> tuple[Floats, Floats]:
        """Return the frequencies (H, 1) down and (1, W//2+1) to the right [cycles per pixel]."""
        down, right = np.fft.fftfreq(self.shape[0])[:, None], np.fft.rfftfreq(self.shape[1])[None]
        return down.astype(np.float64), right.astype(np.float64)

    def off_axis(self, band: tuple[float, float]) -> NDArray[np.bool_]:
        """Return which frequencies are in a band (low, high) and off both axes, (H, W//2+1) bool."""
        down, right = self.frequencies()
        radius = np.hypot(down, right)
        beside = (np.abs(down) * self.shape[0] > _LEAKED) & (right * self.shape[1] > _LEAKED)
        return beside & (radius >= band[0]) & (radius < band[1])


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the parts of the noise in the frames [K], each (value, uncertainty)."""

    # pixel, row, column: (2,) floats noise that changes with each frame, where the gain of the flat-field correction
    # is 1; for a single frame, all noise
    pixel: tuple[float, float]
    row: tuple[float, float]
    column: tuple[float, float]
    # fixed_pixel, fixed_row, fixed_column: (2,) floats constant noise; None for a single frame
    fixed_pixel: tuple[float, float] | None = None
    fixed_row: tuple[float, float] | None = None
    fixed_column: tuple[float, float] | None = None
    static: bool = False  # Whether the camera did not move, so that the scene is in every frame
    lively: bool = False  # Whether the scene changes before a static camera


def noise_of(spectra: Spectra) -> Noise:
    """Return the Noise of Spectra, without blocks that are cut off at an end of the range.

    For a moving camera, pixel noise is that of the flattest tenth of blocks, less the fixed part: too high if no part
    is flat; rows and columns in the scene (fields, roofs) count as noise. For a static camera, it is the difference
    between frames, and the fixed part comes from the flattest blocks of the mean frame. If the difference has more
    power in coarse than in the finest detail, the scene changes; then the tenth of blocks with the least coarse change
    gives the noise.
    """
    window = _window(spectra.shape) ** 2
    seen_gain = float((window * spectra.gain**2).sum() / window.sum())
    lines = [(value / seen_gain, error / seen_gain) for value, error in _lines(spectra, spectra.total, spectra.count)]
    blocks = spectra.blocks
    gains = np.tile(block_means(spectra.gain**2), spectra.count)
    if np.isfinite(blocks[:, 0]).mean() < FLAT:
        raise ThermorenderError(
            "nine tenths of the frames are cut off at an end of the camera's range; give frames within it"
        )
    if spectra.count == 1:
        row, column = (sigma_of(*line) for line in lines)
        return Noise(sigma_of(*_flat_power(blocks, gains, 0.0)), row, column)
    fine, coarse = (spectra.off_axis(band) for band in (_FINE, _TEXTURE))
    fixed_lines = _lines(spectra, spectra.fixed, None)
    changing = [
        (whole[0] - fixed[0] / seen_gain, np.hypot(whole[1], fixed[1] / seen_gain))
        for whole, fixed in zip(lines, fixed_lines, strict=True)
    ]
    alone = fine.sum() / _HANN_ALIKE
    static = bool(spectra.fixed[coarse].mean() > 0.5 * spectra.total[coarse].mean())
    lively = False
    if static:
        changing_power = spectra.total - spectra.fixed
        temporal = float(changing_power[fine].mean()) / seen_gain
        temporal_error = float(temporal / np.sqrt(alone * (spectra.count - 1)))
        coarse_error = temporal / np.sqrt(coarse.sum() / _HANN_ALIKE * (spectra.count - 1))
        coarsely = float(changing_power[coarse].mean()) / seen_gain
        lively = coarsely > _LIVELY * temporal + 5.0 * np.hypot(coarse_error, temporal_error)
        if lively or spectra.lost.any():
            gains = gains[: len(spectra.changes)]
            temporal, temporal_error = _flat_power(spectra.changes, gains, 0.0)
        rest = temporal / spectra.count * block_means(spectra.gain**2)
        power = np.where(spectra.lost[:, None], np.inf, block_powers(spectra.image))
        constant, constant_error = _flat_power(power, np.ones(len(power)), rest)
    else:
        constant = float(spectra.fixed[fine].mean())
        # Uncertainty of the product of frames, and of the pattern as one sample of many.
        pairs = spectra.count * (spectra.count - 1)
        constant_error = float(np.hypot(spectra.total[fine].mean() / np.sqrt(alone * pairs), constant / np.sqrt(alone)))
        temporal, temporal_error = _flat_power(blocks, gains, constant)
        temporal_error = float(np.hypot(temporal_error, constant_error))
    if temporal_error > _INSEPARABLE * max(temporal, 0.0) > 0.0:
        raise ThermorenderError(
            "no part of the frames is flat or constant, so noise cannot be separated from the scene; give frames with "
            "some sky, water or uniform ground"
        )
    row, column = (sigma_of(*line) for line in changing)
    fixed_row, fixed_column = (sigma_of(*line) for line in fixed_lines)
    pixel, fixed_pixel = sigma_of(temporal, temporal_error), sigma_of(constant, constant_error)
    return Noise(pixel, row, column, fixed_pixel, fixed_row, fixed_column, static, bool(lively))


def block_powers(image: Floats) -> Floats:
    """Return the powers of texture and of the finest detail in each block of an image, (n, 2) [K²]."""
    blocks = _cut(image)
    blocks = blocks - blocks.mean(axis=(1, 2), keepdims=True)
    # A slope across the block would leak into all frequencies.
    for slope in np.mgrid[:_BLOCK, :_BLOCK] - 0.5 * (_BLOCK - 1):
        blocks -= np.tensordot(blocks, slope, axes=2)[:, None, None] / (slope**2).sum() * slope
    power = np.abs(_spectrum(blocks)) ** 2
    down, right = np.fft.fftfreq(_BLOCK)[:, None], np.fft.rfftfreq(_BLOCK)[None]
    radius, beside = np.hypot(down, right), (np.abs(down) * _BLOCK > 2) & (right * _BLOCK > 2) & (right < 0.5)
    bands = [beside & (radius >= low) & (radius < high) for low, high in (_TEXTURE, _FINE)]
    return np.stack([power[:, band].mean(axis=1) for band in bands], axis=-1)


def block_means(image: Floats) -> Floats:
    """Return the mean of each block of an image, (n,), in the order of `block_powers`."""
    return _cut(image).mean(axis=(1, 2))


def _cut(image: Floats) -> Floats:
    """Blocks (n, side, side) of an image, row by row."""
    height, width = (n // _BLOCK for n in image.shape)
    blocks = image[: height * _BLOCK, : width * _BLOCK].reshape(height, _BLOCK, width, _BLOCK)
    return blocks.transpose(0, 2, 1, 3).reshape(-1, _BLOCK, _BLOCK)


def _window(shape: Sequence[int]) -> Floats:
    """Hann's window (H, W), without its zero ends."""
    down, right = (np.hanning(n + 2)[1:-1] for n in shape)
    return np.outer(down, right)


def _spectrum(image: Floats) -> NDArray[np.complex128]:
    """Spectrum (…, H, W//2+1) with Hann's window, scaled to preserve the variance of white noise."""
    window = _window(image.shape[-2:])
    return np.asarray(np.fft.rfft2(image * window) / np.sqrt((window**2).sum()))


def _flat_power(blocks: Floats, gains: Floats, other: Floats | float) -> tuple[float, float]:
    """(power of the finest detail in flat blocks, its uncertainty) [K²], over the gain and less other power."""
    fine, whole = np.broadcast_to(blocks[:, 1] - other, gains.shape), np.isfinite(blocks[:, 0])
    blocks, gains, fine = blocks[whole], gains[whole], fine[whole]
    order = np.argsort(blocks[:, 0] / gains)

    def flattest(share: float) -> tuple[float, float]:
        chosen = order[: max(int(share * len(order)), 4)]
        spread = fine[chosen].std() / np.sqrt(len(chosen))
        return fine[chosen].mean() / gains[chosen].mean(), spread / gains[chosen].mean()

    power, error = flattest(FLAT)
    # Change of the power with twice and with half the blocks, and leakage of texture in the flattest blocks.
    change = 0.5 * (flattest(2.0 * FLAT)[0] - flattest(0.5 * FLAT)[0])
    chosen = order[: max(int(FLAT * len(order)), 4)]
    texture = (blocks[chosen, 0] - blocks[chosen, 1]).mean() / gains[chosen].mean()
    return power, float(np.linalg.norm([error, change, _LEAK * max(texture, 0.0)]))


def _lines(spectra: Spectra, power: Floats, count: int | None) -> list[tuple[float, float]]:
    """Return ((variance of row noise, its uncertainty), the same for columns) [K²] from excess power on the two axes.

    With `count` frames, medians reject the scene's own rows and columns, which are at some frequencies only. Powers of
    mixed sign are averaged.
    """
    height, width = spectra.shape
    down, right = (np.abs(axis).ravel() for axis in spectra.frequencies())
    beside_rows = power[:, _LEAKED:_BESIDE]
    beside_columns = np.concatenate([power[_LEAKED:_BESIDE], power[1 - _BESIDE : 1 - _LEAKED]])
    found = []
    for line, beside, frequency, length in (
        (power[:, 0], beside_rows.T, down, width),
        (power[0], beside_columns, right, height),
    ):
        fine = frequency > _LINE_FROM
        line, beside = line[fine], beside[:, fine].ravel()
        if count is None:
            level, around = line.mean(), beside.mean()
        else:
            level, around = (np.median(values) / _gamma_median(count) for values in (line, beside))
        # The frequencies of rows appear twice, with both signs; Hann's window correlates three neighbours of a line.
        alone = fine.sum() / (2.0 if length == width else 1.0) / np.sqrt(_HANN_ALIKE)
        scale = 1.0 / (length * _HANN_LINE)
        found.append(((level - around) * scale, np.std(line) / np.sqrt(alone) * scale))
    return found


def _gamma_median(count: int) -> float:
    """Median over mean of the average of `count` exponentially distributed powers."""
    from scipy.special import gammaincinv

    return float(gammaincinv(count, 0.5)) / count


def sigma_of(variance: float, error: float) -> tuple[float, float]:
    """Return (standard deviation, uncertainty) of a variance and its uncertainty; the variance may be negative."""
    sigma = np.sqrt(max(variance, 0.0))
    return float(sigma), float(np.sqrt(max(variance, 0.0) + error) - sigma)
