"""The microbolometer pixel as a heat capacity: absorbed power, its exponential response, rows read one after another.
The pixel of a photon detector as a mean over its integration time.

C dΔT/dt = P − G ΔT has the time constant C/G. The signal is G ΔT, watts of steady power, so neither C nor G is needed.
Power is linear between known instants, for which the response is exact.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.sensor.camera import Camera, Image

# Remaining share of a difference below which pixels count as settled.
SETTLED = 1e-7


def absorbed_power(irradiance: Any, camera: Camera) -> Any:
    """Return the power that heats a pixel [W], in the shape of `irradiance` [W m⁻²]."""
    return irradiance * (camera.absorptance * (camera.pixel_pitch_um * 1e-6) ** 2)


def response_weights(
    span_s: ArrayLike, time_constant_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return (old, first, last) of a span ≥ 0 [s], whose signal is old·signal + first·P(start) + last·P(end).

    They sum to 1, and are exact where the power is linear in time. With x = t/τ: old = e⁻ˣ, last = 1 − (1−e⁻ˣ)/x, first
    = (1−e⁻ˣ)/x − e⁻ˣ.
    """
    span = np.asarray(span_s, np.float64)
    if not time_constant_s:
        return np.zeros_like(span), np.zeros_like(span), np.ones_like(span)
    x = span / time_constant_s
    # (1−e⁻ˣ)/x, and its limit at x = 0.
    mean = np.where(x > 0.0, -np.expm1(-x) / np.where(x > 0.0, x, 1.0), 1.0)
    old = np.exp(-x)
    return old, mean - old, 1.0 - mean


def forgotten_s(camera: Camera) -> float:
    """Return the time after which pixels have forgotten an earlier state to the last bit [s].

    A difference falls as e⁻ᵗ/τ. After 53 ln 2 time constants it is below the last bit of a float64 signal. It then
    changes a rounding with a probability that ln(100 n) more time constants bring to 1 % for all n pixels. Of 2¹⁴
    counts, half a count is left after 15 ln 2 = 10.4 time constants.
    """
    return camera.time_constant_ms * 1e-3 * float(53.0 * np.log(2.0) + np.log(100.0 * camera.width * camera.height))


def row_delays(camera: Camera, frame_interval_s: float = np.inf) -> NDArray[np.float64]:
    """Return each row's read-out time (H,) [s] from the middle of a read-out that takes at most one interval."""
    row_s = min(camera.row_time_us * 1e-6, frame_interval_s / camera.height)
    return (np.arange(camera.height, dtype=np.float64) - 0.5 * (camera.height - 1)) * row_s


@dataclass(frozen=True)
class PixelState:
    """The pixels at one instant, from which the next frame starts."""

    time_s: float
    # (H, W) float32 of each pixel, if it were read now [W]. Double precision between frames: a frame of a hundredth
    # of a time constant or less changes it by less than single precision holds.
    signal: NDArray[np.floating[Any]]
    power: Image  # (H, W) float32 absorbed by each pixel [W]
    # Estimated error of the signal from following parts of the image, root mean square over all pixels [mK]
    error_mk: float = 0.0


def steady(time_s: float, power: Image) -> PixelState:
    """Return the PixelState of pixels in equilibrium with `power`."""
    return PixelState(float(time_s), power, power)


def stepped(state: PixelState, time_s: float, power: Image, time_constant_s: float) -> PixelState:
    """Return the PixelState at `time_s` if the power was `power` since the last instant."""
    old, _, _ = response_weights(time_s - state.time_s, time_constant_s)
    if old < SETTLED:
        return steady(time_s, power)
    return PixelState(float(time_s), power + old * (state.signal - power), power)


def advanced(state: PixelState, time_s: float, power: Image, time_constant_s: float) -> PixelState:
    """Return the PixelState at `time_s` after the power has changed linearly to `power`."""
    old, first, last = response_weights(time_s - state.time_s, time_constant_s)
    return PixelState(float(time_s), old * state.signal + first * state.power + last * power, power)


def read_rows(
    state: PixelState, time_s: float, power: Image, row_times_s: NDArray[np.float64], rows: slice,
    time_constant_s: float, out: Image,
) -> None:  # fmt: skip
    """Read n rows at `row_times_s` (n,) into `out` while power changes to `power` (H, W) [W] at `time_s`."""
    whole = time_s - state.time_s
    passed = np.asarray(row_times_s) - state.time_s
    old, first, last = response_weights(passed, time_constant_s)
    share = passed / whole if whole > 0.0 else np.ones_like(passed)
    # The power at the time of a row is interpolated between both ends.
    weights = (old, first + last * (1.0 - share), last * share)
    a, b, c = (weight.astype(np.float32)[:, None] for weight in weights)
    out[rows] = a * state.signal[rows] + b * state.power[rows] + c * power[rows]


class Follower:
    """Pixels that are heated from instant to instant, and their rows as they are read in between."""

    def __init__(
        self, pixels: PixelState | None, row_times_s: NDArray[np.float64], time_constant_s: float,
        shape: tuple[int, ...],
    ) -> None:  # fmt: skip
        self.pixels, self.signal = pixels, np.empty(shape, np.float32)
        self._row_times_s, self._time_constant_s, self._done = row_times_s, time_constant_s, 0

    def step(self, time_s: float, power: Image, last: bool) -> None:
        """Advance to an instant at which pixels absorb `power`; the last instant reads all remaining rows."""
        if self.pixels is None:
            self.pixels = steady(time_s, power)
        until = len(self._row_times_s) if last else int(np.searchsorted(self._row_times_s, time_s, "right"))
        if until > self._done:
            rows = slice(self._done, until)
            read_rows(self.pixels, time_s, power, self._row_times_s[rows], rows, self._time_constant_s, self.signal)
            self._done = until
        self.pixels = advanced(self.pixels, time_s, power, self._time_constant_s)


class Integrator:
    """Pixels that collect light from the first to the last instant, linear between; they remember no earlier frame."""

    pixels = None

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.signal = np.zeros(shape, np.float32)
        self._first_s: float | None = None
        self._before: tuple[float, Image] = (0.0, self.signal)

    def step(self, time_s: float, power: Image, last: bool) -> None:
        """Add the light up to an instant with `power` on the pixels; after the last, the signal is the mean power."""
        if self._first_s is None:
            self._first_s = time_s
        else:
            since_s, before = self._before
            self.signal += np.float32(0.5 * (time_s - since_s)) * (before + power)
        self._before = time_s, power
        if last:
            self.signal /= np.float32(time_s - self._first_s)


def follower(
    camera: Camera, pixels: PixelState | None, row_times_s: NDArray[np.float64], shape: tuple[int, ...]
) -> Follower | Integrator:
    """Return what follows a camera's pixels from instant to instant."""
    if camera.well_electrons:
        return Integrator(shape)
    return Follower(pixels, row_times_s, camera.time_constant_s, shape)
