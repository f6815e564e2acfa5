"""The microbolometer pixel as a heat capacity: absorbed power, its exponential response, rows read one after another.

C dΔT/dt = P − G ΔT has the time constant C/G. The signal is kept in watts of steady power, G ΔT, so that neither C nor
G is needed. Between two instants at which the power is known it is taken as linear in time; the response to that is
exact, so no step is too long for it.
"""

from dataclasses import dataclass

import numpy as np

# Share of a difference that pixels no longer show.
SETTLED = 1e-7


def absorbed_power(irradiance, camera):
    """Return the power that heats a pixel [W], in the shape of `irradiance` [W m⁻²]."""
    return irradiance * (camera.absorptance * (camera.pixel_pitch_um * 1e-6) ** 2)


def response_weights(span_s, time_constant_s):
    """Return (old, first, last): the signal after a span is old·signal + first·P(start) + last·P(end).

    Parameters
    ----------
    span_s : array
        Time that passes, at or above 0 [s].
    time_constant_s : float
        At or above 0 [s].

    Returns
    -------
    old, first, last : arrays in the shape of `span_s`
        They sum to 1. Exact where the power is linear in time between start and end.

    Notes
    -----
    With x = t/τ: old = e⁻ˣ, last = 1 − (1−e⁻ˣ)/x, first = (1−e⁻ˣ)/x − e⁻ˣ.
    """
    span = np.asarray(span_s, np.float64)
    if not time_constant_s:
        return np.zeros_like(span), np.zeros_like(span), np.ones_like(span)
    x = span / time_constant_s
    # (1−e⁻ˣ)/x, and its limit where nothing passes.
    mean = np.where(x > 0.0, -np.expm1(-x) / np.where(x > 0.0, x, 1.0), 1.0)
    old = np.exp(-x)
    return old, mean - old, 1.0 - mean


def row_delays(camera, frame_interval_s=np.inf):
    """Return when each row is read, (H,) [s], against the frame's time: the middle of the read-out.

    No read-out takes longer than from one frame to the next.
    """
    row_s = min(camera.row_time_us * 1e-6, frame_interval_s / camera.height)
    return (np.arange(camera.height) - 0.5 * (camera.height - 1)) * row_s


@dataclass(frozen=True)
class PixelState:
    """The pixels at one instant: what the next frame starts from.

    Attributes
    ----------
    time_s : float
    signal : (H, W) float32
        What each pixel would be read as [W].
    power : (H, W) float32
        What heats each pixel [W].
    error_mk : float
        Estimated error of the signal by what was followed in parts of the image, root mean square over all [mK].
    """

    time_s: float
    signal: np.ndarray
    power: np.ndarray
    error_mk: float = 0.0


def steady(time_s, power):
    """Return the PixelState of pixels that have been heated with `power` for long."""
    return PixelState(float(time_s), power, power)


def stepped(state, time_s, power, time_constant_s):
    """Return the PixelState at `time_s` after the power has been as it is now ever since the last instant."""
    old, _, _ = response_weights(time_s - state.time_s, time_constant_s)
    if old < SETTLED:
        return steady(time_s, power)
    signal = power + np.float32(old) * (state.signal - power)
    return PixelState(float(time_s), signal, power)


def advanced(state, time_s, power, time_constant_s):
    """Return the PixelState at `time_s` after the power has changed evenly to `power`."""
    old, first, last = map(np.float32, response_weights(time_s - state.time_s, time_constant_s))
    return PixelState(float(time_s), old * state.signal + first * state.power + last * power, power)


def read_rows(state, time_s, power, row_times_s, rows, time_constant_s, out):
    """Read those rows into `out` that come up while the power changes evenly to `power` at `time_s`.

    Parameters
    ----------
    state : PixelState
        The pixels at the start.
    time_s, power
        The end, and the (H, W) power then [W].
    row_times_s : (n,) array
        When each of the rows is read, between start and end [s].
    rows : slice of n rows
    out : (H, W) float32
    """
    whole = time_s - state.time_s
    passed = np.asarray(row_times_s) - state.time_s
    old, first, last = response_weights(passed, time_constant_s)
    share = passed / whole if whole > 0.0 else np.ones_like(passed)
    # The power at a row's own instant lies between those at both ends.
    weights = (old, first + last * (1.0 - share), last * share)
    old, first, last = (weight.astype(np.float32)[:, None] for weight in weights)
    out[rows] = old * state.signal[rows] + first * state.power[rows] + last * power[rows]
