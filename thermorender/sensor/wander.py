"""Drift between flat-field corrections: 1/f noise of single pixels and of the whole scale, blinking pixels.

Each drift is its value less that at the last correction, so zero right after it. The counter-based generator gives any
instant without those before. Thermal cameras drift by such a power of time (doi:10.1117/12.2663353).

1/f noise is a sum of octaves, each of which holds a random value twice as long as the octave before (Voss's algorithm,
in Gardner 1978, doi:10.1038/scientificamerican0478-16). The holds end at different ticks; the sum is linear between.
"""

from collections.abc import Iterator
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.sensor import noise
from thermorender.sensor.camera import Camera, Image

# The shortest hold [s], and the number of octaves.
TICK_S, OCTAVES = 1.0, 10
# Mean and largest number of draws of a blinking pixel in a block of time; each block has separate random numbers.
_DRAWS, _MOST_DRAWS = 4.0, 32
# Offset of block numbers, since blocks before the start have negative ones.
_BEFORE = 2**32


def covariance(lag_s: ArrayLike) -> NDArray[np.float64]:
    """Return the covariance of 1/f noise at two instants `lag_s` apart [s], for octaves of unit size.

    Ticks k apart have Σ max(0, 1 − k/2ᵒ) over the octaves o, weighted with the cubic B-spline for positions between
    ticks.
    """
    lag = np.abs(np.asarray(lag_s, np.float64)) / TICK_S
    first, total = np.floor(lag), np.zeros_like(lag)
    for step in range(-1, 3):
        off = np.abs(lag - first - step)
        spline = np.where(off < 1.0, 2.0 / 3.0 - off**2 + 0.5 * off**3, np.maximum(2.0 - off, 0.0) ** 3 / 6.0)
        held = sum(np.maximum(1.0 - np.abs(first + step) / 2**octave, 0.0) for octave in range(OCTAVES))
        total += spline * held
    return total


class Wander:
    """The drift of one camera with one seed."""

    def __init__(self, camera: Camera, seed: int) -> None:
        self.camera, self.seed = camera, seed
        # Caches of the values that successive instants share.
        for name, most in (("_scale_at", 8), ("_flicker_since", 4), ("_flicker_before", 2),
                           ("_flicker_octave", 2 * OCTAVES), ("_level", 4), ("_draws", 4)):  # fmt: skip
            setattr(self, name, lru_cache(maxsize=most)(getattr(self, name)))

    @cached_property
    def blinking_pixels(self) -> NDArray[np.int64]:
        """Flat indices of the blinking pixels, (n,) int64, in order; none of them is bad."""
        camera = self.camera
        count = round(camera.blinking_pixels * camera.height * camera.width)
        good = np.delete(np.arange(camera.height * camera.width), noise.bad_pixels(camera, self.seed))
        generator = np.random.Generator(noise.philox(self.seed, 0, noise.BLINKING))
        return np.sort(generator.choice(good, count, replace=False))

    def flicker(self, corrected_s: float, time_s: float) -> Iterator[tuple[float, Image]]:
        """Yield (share, (H, W) float32 [W]); the sum of products is the flicker of pixels since a correction."""
        tick, share = _tick(time_s)
        for number, weight in ((tick, 1.0 - share), (tick + 1, share)):
            yield weight, self._flicker_since(corrected_s, number)

    def scale_drift(self, corrected_s: float, time_s: float) -> float:
        """Return the drift of the whole scale since a correction [W]."""

        def at(when_s: float) -> float:
            tick, share = _tick(when_s)
            return (1.0 - share) * self._scale_at(tick) + share * self._scale_at(tick + 1)

        return at(time_s) - at(corrected_s)

    def blinking(self, corrected_s: float, time_s: float) -> Image:
        """Return the jump of each of `blinking_pixels` since a correction, (n,) float32 [W].

        A random telegraph signal: one of two levels is drawn at the instants of a Poisson process, 2/s draws for a mean
        time s at a level, and the correlation falls as exp(−2t/s).
        """
        jumped = self._level(time_s) - self._level(corrected_s)
        return jumped.astype(np.float32) * np.float32(noise.noise_power(self.camera, self.camera.blinking_mk))

    def _scale_at(self, tick: int) -> float:
        sigma = np.float32(noise.noise_power(self.camera, self.camera.scale_drift_mk))
        drawn = (noise.normal(self.seed, draw, noise.SCALE, 1, sigma, octave) for octave, draw in _held(tick))
        return sum(float(value[0]) for value in drawn)

    def _flicker_since(self, corrected_s: float, tick: int) -> Image:
        return self._flicker_at(tick) - self._flicker_before(corrected_s)

    def _flicker_before(self, corrected_s: float) -> Image:
        tick, share = _tick(corrected_s)
        now, then = (self._flicker_at(number) for number in (tick, tick + 1))
        return now + np.float32(share) * (then - now)

    def _flicker_at(self, tick: int) -> Image:
        total: Any = sum(self._flicker_octave(octave, draw) for octave, draw in _held(tick))
        return total

    def _flicker_octave(self, octave: int, draw: int) -> Image:
        shape = self.camera.height, self.camera.width
        sigma = np.float32(noise.noise_power(self.camera, self.camera.flicker_mk))
        return noise.normal(self.seed, draw, noise.FLICKER, shape, sigma, octave)

    def _level(self, time_s: float) -> NDArray[np.int64]:
        """The level of each blinking pixel by its last draw, (n,) of 0 and 1."""
        span_s = 0.5 * self.camera.blinking_s * _DRAWS
        block = int(time_s // span_s)
        level = np.full(len(self.blinking_pixels), -1)
        while (level < 0).any():
            instants, drawn = self._draws(block)
            past = (instants <= time_s / span_s - block).sum(axis=1)
            found = np.take_along_axis(drawn, np.maximum(past - 1, 0)[:, None], axis=1)[:, 0]
            level = np.where((level < 0) & (past > 0), found, level)
            block -= 1
        return level

    def _draws(self, block: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Instants [blocks] and levels of draws, (n, most) each; instants from 1 on are beyond the block: infinite."""
        generator = np.random.Generator(noise.philox(self.seed, block + _BEFORE, noise.BLINKING, 1))
        shape = len(self.blinking_pixels), _MOST_DRAWS
        instants = np.cumsum(generator.exponential(1.0 / _DRAWS, shape), axis=1)
        return np.where(instants < 1.0, instants, np.inf), generator.integers(0, 2, shape)


def _tick(time_s: float) -> tuple[int, float]:
    tick, share = divmod(time_s / TICK_S, 1.0)
    return int(tick), share


def _held(tick: int) -> list[tuple[int, int]]:
    """(octave, number of its draw) at a tick: each tick has a new draw of the shortest and of one other octave."""
    return [(octave, (tick + (1 << octave >> 1)) >> octave) for octave in range(OCTAVES)]
