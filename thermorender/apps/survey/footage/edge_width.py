"""The width of a sharp edge in a camera's images: the sharpest straight steps, each fitted as a blurred step.

Thin lines, corners and texture look sharper than they are, so patches must fit one straight step within the noise.
"""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

# Half the side of a patch around an edge [px]; it contains any narrower step.
_HALF = 6
# Steps weaker than the first times the noise, and fits worse than the others, are left out.
_LEAST_STEP, _WORST_MISFIT, _WORST_ERROR = 15.0, 4.0, 0.15
_MOST_PER_FRAME = 60
# Error of the Gaussian model, from simulated frames of lenses from 0.5 to 1.0 px.
_MODEL_PX = 0.02


def edge_widths(image: NDArray[np.float64], noise: float) -> NDArray[np.float64]:
    """Return widths and uncertainties, (n, 2) [px], of straight steps in an image of white noise `noise`.

    Width is the σ of the Gaussian that blurs a step: a + b erf(u / √2 σ) + plane, with u the distance from a line.
    """
    fits = (_fitted(image[i - _HALF : i + _HALF + 1, j - _HALF : j + _HALF + 1], noise, angle)
            for i, j, angle in _steep_edges(image, noise))  # fmt: skip
    found = [
        (sigma, error)
        for sigma, error, misfit, offset in fits
        if misfit < _WORST_MISFIT and error < _WORST_ERROR * max(sigma, 0.5) and abs(offset) < 1.5
    ]
    return np.array(found).reshape(-1, 2)


def sharpest(widths: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return (width, uncertainty) [px] of the sharpest of many edges; None if there are fewer than eight.

    It is the median of the sharpest fifth in the better half of the fits. The selection is biased by 1.28 times the
    uncertainty (a tenth of equal edges looks sharper than that), which is added back. The uncertainty combines that of
    one edge, the spread of that fifth, and the error of the Gaussian model for other steps.
    """
    if len(widths) < 8:
        return None
    better = widths[np.argsort(widths[:, 1])[: max(len(widths) // 2, 8)]]
    better = better[np.argsort(better[:, 0])]
    fifth = better[: max(len(better) // 5, 3)]
    error, spread = float(np.median(better[:, 1])), float(np.std(fifth[:, 0]))
    return float(np.median(fifth[:, 0])) + 1.28 * error, float(np.linalg.norm([error, spread, _MODEL_PX]))


def width_through(transfer: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> float:
    """Return the width that `edge_widths` finds for a sharp step behind a transfer function [px].

    The function is real, of frequencies [cycles per pixel], and includes the pixel aperture.
    """
    from scipy.optimize import least_squares
    from scipy.special import erf

    frequency: NDArray[np.float64] = np.asarray((np.arange(4000) + 0.5) * 1e-3, np.float64)
    value = transfer(frequency)
    # A step is the integral of its line spread: 2/π ∫ T sin(2πfu) / 2f df.
    position = np.linspace(-_HALF, _HALF, 101)
    edge = 2.0 * (np.sin(2.0 * np.pi * position[:, None] * frequency) / (np.pi * frequency)) @ (value * 1e-3)

    def misfit(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return p[1] * erf(position / (np.sqrt(2.0) * p[0])) + p[2] * position - edge

    return float(least_squares(misfit, (0.5, 1.0, 0.0), bounds=([0.01, 0.5, -1.0], [6.0, 2.0, 1.0])).x[0])


def _steep_edges(image: NDArray[np.float64], noise: float) -> Iterator[tuple[int, int, float]]:
    """(row, column, angle) of steep, straight edges, the best first, none within the patch of another."""
    from scipy.ndimage import gaussian_filter, gaussian_filter1d

    down, right = (gaussian_filter1d(gaussian_filter1d(image, 1.0, axis=axis, order=1), 1.0, axis=1 - axis)
                   for axis in (0, 1))  # fmt: skip
    steepness = np.hypot(down, right)
    rr, dd, rd = (gaussian_filter(product, 2.5) for product in (right * right, down * down, right * down))
    straightness = np.sqrt((rr - dd) ** 2 + 4.0 * rd**2) / np.maximum(rr + dd, 1e-30)
    # White noise of σ has σ / √8π in the derivative by a Gaussian of 1 px.
    score = np.where(steepness > _LEAST_STEP * noise / np.sqrt(8.0 * np.pi), steepness * straightness**4, 0.0)
    border = _HALF + 2
    score[:border] = score[-border:] = 0.0
    score[:, :border] = score[:, -border:] = 0.0
    for _ in range(_MOST_PER_FRAME):
        i, j = (int(index) for index in np.unravel_index(score.argmax(), score.shape))
        if score[i, j] <= 0.0:
            return
        yield i, j, float(np.arctan2(down[i, j], right[i, j]))
        score[i - _HALF : i + _HALF + 1, j - _HALF : j + _HALF + 1] = 0.0


def _fitted(patch: NDArray[np.float64], noise: float, angle: float) -> tuple[float, float, float, float]:
    """(σ, its uncertainty, reduced χ², offset of the edge) of a blurred step in a patch [px]."""
    from scipy.optimize import least_squares
    from scipy.special import erf

    y, x = np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1]
    round_patch = x * x + y * y <= (_HALF + 0.5) ** 2
    y, x, value = y[round_patch], x[round_patch], patch[round_patch]

    def left(p: NDArray[np.float64]) -> NDArray[np.float64]:
        u = x * np.cos(p[0]) + y * np.sin(p[0]) - p[1]
        basis = np.stack([np.ones(x.size), erf(u / (np.sqrt(2.0) * np.exp(p[2]))), x, y], axis=-1)
        # Heights and plane are linear, so they are solved for exactly.
        return (basis @ np.linalg.lstsq(basis, value, rcond=None)[0] - value) / noise

    found = least_squares(left, (angle, 0.0, np.log(0.7)), x_scale=(0.1, 0.3, 0.3), max_nfev=30)
    curvature = found.jac.T @ found.jac
    if np.linalg.cond(curvature) > 1e10:
        return np.inf, np.inf, np.inf, np.inf
    sigma = float(np.exp(found.x[2]))
    error = sigma * float(np.sqrt(np.linalg.inv(curvature)[2, 2]))
    return sigma, error, 2.0 * found.cost / (value.size - 7), float(found.x[1])
