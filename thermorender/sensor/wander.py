"""What wanders between flat-field corrections: 1/f noise of single pixels and of the whole scale, pixels that blink.

A correction takes off what it meets, so each of these is its value now less that at the last correction: nothing
right after it, and more the longer it is ago. Values of any instant are drawn by the counter-based generator without
those before. That the pattern of thermal cameras wanders so, by a power of time and alike in both directions of time:
doi:10.1117/12.2663353.

1/f noise is a sum of octaves, each a value that is held for twice as long as that of the octave before and then drawn
anew (Voss's, in Gardner 1978, doi:10.1038/scientificamerican0478-16); the holds of different octaves end at
different ticks, and between ticks the sum changes evenly.
"""

from functools import cached_property, lru_cache

import numpy as np

from thermorender.sensor import noise

# The shortest hold [s], and how many octaves there are.
TICK_S, OCTAVES = 1.0, 10
# Mean number of draws of a blinking pixel in a block of time, of which each has its own random numbers, and the most.
_DRAWS, _MOST_DRAWS = 4.0, 32
# Blocks before the start have numbers too.
_BEFORE = 2**32


def covariance(lag_s):
    """Return the covariance of 1/f noise at two instants, in the shape of their distance [s], for octaves of unit size.

    Notes
    -----
    Ticks k apart have Σ max(0, 1 − k/2ᵒ) over the octaves o; the mean over both instants' places between ticks is its
    sum with the cubic B-spline, which is the linear interpolation's with itself.
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
    """What wanders in one camera with one seed.

    Parameters
    ----------
    camera : Camera
    seed : int
    """

    def __init__(self, camera, seed):
        self.camera, self.seed = camera, seed
        # Kept is what instants that follow each other share.
        for name, most in (("_scale_at", 8), ("_flicker_since", 4), ("_flicker_before", 2),
                           ("_flicker_octave", 2 * OCTAVES), ("_level", 4), ("_draws", 4)):  # fmt: skip
            setattr(self, name, lru_cache(maxsize=most)(getattr(self, name)))

    @cached_property
    def blinking_pixels(self):
        """Numbers of the pixels that blink, (n,) int64, in order: none that is bad."""
        camera = self.camera
        count = round(camera.blinking_pixels * camera.height * camera.width)
        good = np.delete(np.arange(camera.height * camera.width), noise.bad_pixels(camera, self.seed))
        generator = np.random.Generator(noise.philox(self.seed, 0, noise.BLINKING))
        return np.sort(generator.choice(good, count, replace=False))

    def flicker(self, corrected_s, time_s):
        """Yield (share, (H, W) float32 [W]) whose products make the flicker of pixels since a correction."""
        tick, share = _tick(time_s)
        for number, weight in ((tick, 1.0 - share), (tick + 1, share)):
            yield weight, self._flicker_since(corrected_s, number)

    def scale_drift(self, corrected_s, time_s):
        """Return how far the whole scale has wandered since a correction [W]."""

        def at(when_s):
            tick, share = _tick(when_s)
            return (1.0 - share) * self._scale_at(tick) + share * self._scale_at(tick + 1)

        return at(time_s) - at(corrected_s)

    def blinking(self, corrected_s, time_s):
        """Return how far each of `blinking_pixels` has jumped since a correction, (n,) float32 [W].

        Notes
        -----
        A random telegraph signal: one of two levels is drawn at the instants of a Poisson process. As every second
        draw changes nothing, a mean time s at a level takes 2/s draws, and the correlation falls as exp(−2t/s).
        """
        jumped = self._level(time_s) - self._level(corrected_s)
        return jumped.astype(np.float32) * np.float32(noise.noise_power(self.camera, self.camera.blinking_mk))

    def _scale_at(self, tick):
        sigma = np.float32(noise.noise_power(self.camera, self.camera.scale_drift_mk))
        drawn = (noise.normal(self.seed, draw, noise.SCALE, 1, sigma, octave) for octave, draw in _held(tick))
        return sum(float(value[0]) for value in drawn)

    def _flicker_since(self, corrected_s, tick):
        return self._flicker_at(tick) - self._flicker_before(corrected_s)

    def _flicker_before(self, corrected_s):
        tick, share = _tick(corrected_s)
        now, then = (self._flicker_at(number) for number in (tick, tick + 1))
        return now + np.float32(share) * (then - now)

    def _flicker_at(self, tick):
        return sum(self._flicker_octave(octave, draw) for octave, draw in _held(tick))

    def _flicker_octave(self, octave, draw):
        shape = self.camera.height, self.camera.width
        sigma = np.float32(noise.noise_power(self.camera, self.camera.flicker_mk))
        return noise.normal(self.seed, draw, noise.FLICKER, shape, sigma, octave)

    def _level(self, time_s):
        """Which of two levels each blinking pixel is at, (n,) of 0 and 1: as drawn last."""
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

    def _draws(self, block):
        """Instants [blocks] and levels of draws in a block of time, (n, most) each; the block's are those below 1."""
        generator = np.random.Generator(noise.philox(self.seed, block + _BEFORE, noise.BLINKING, 1))
        shape = len(self.blinking_pixels), _MOST_DRAWS
        instants = np.cumsum(generator.exponential(1.0 / _DRAWS, shape), axis=1)
        return np.where(instants < 1.0, instants, np.inf), generator.integers(0, 2, shape)


def _tick(time_s):
    tick, share = divmod(time_s / TICK_S, 1.0)
    return int(tick), share


def _held(tick):
    """(octave, number of its draw) at a tick: at each tick the shortest and one other octave are drawn anew."""
    return [(octave, (tick + (1 << octave >> 1)) >> octave) for octave in range(OCTAVES)]
