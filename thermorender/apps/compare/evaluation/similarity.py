"""Similarity of two pictures on an 8-bit scale: peak signal-to-noise ratio and structural similarity.

The scale is linear in apparent temperature between two bounds, the same for all methods. Values outside are clipped;
pixels without temperature are 0.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

PEAK = 255.0
# Wang et al. 2004: a Gaussian window of 11 × 11 pixels and 1.5 px, and the two constants.
RADIUS, SIGMA_PX = 5, 1.5
K1, K2 = 0.01, 0.03


def eight_bit(temperature: ArrayLike, bounds: tuple[float, float]) -> NDArray[np.float64]:
    """Return temperatures between two bounds [K] as whole numbers 0…255, (H, W) float64."""
    low, high = bounds
    return np.rint(PEAK * np.clip((np.nan_to_num(temperature, nan=low) - low) / (high - low), 0.0, 1.0))


class Similarity:
    """Compares pictures with one true picture.

    Parameters
    ----------
    true : (H, W) array
        As `eight_bit` returns it.
    known : (H, W) bool
        Where the true picture is known.

    Notes
    -----
    Wang, Bovik, Sheikh & Simoncelli, IEEE Trans. Image Process. 13 (2004) 600, doi:10.1109/TIP.2003.819861, equation
    13: SSIM = (2 µx µy + C1)(2 σxy + C2) / ((µx² + µy² + C1)(σx² + σy² + C2)), with moments weighted by the window.
    Only windows inside the picture whose pixels are all known count.
    """

    def __init__(self, true: NDArray[np.floating], known: NDArray[np.bool_]) -> None:
        import cv2

        self.known = known
        self.true = np.where(known, true, 0.0)
        side = 2 * RADIUS + 1
        # The border value 0 excludes windows that leave the picture.
        self.whole: NDArray[np.bool_] = cv2.erode(
            known.astype(np.uint8), np.ones((side, side), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
        ).astype(bool)
        self.mean = _blurred(self.true)
        self.variance = _blurred(self.true**2) - self.mean**2

    def row(self, image: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return sums that can be added over pictures, (4,): Σ squared difference, pixels, Σ SSIM, windows."""
        image = np.where(self.known, image, 0.0)
        square = float(((image - self.true) ** 2).sum())
        mean = _blurred(image)
        variance, joint = _blurred(image**2) - mean**2, _blurred(image * self.true) - mean * self.mean
        c1, c2 = (K1 * PEAK) ** 2, (K2 * PEAK) ** 2
        like = (2.0 * mean * self.mean + c1) * (2.0 * joint + c2)
        like /= (mean**2 + self.mean**2 + c1) * (variance + self.variance + c2)
        return np.array([square, self.known.sum(), like[self.whole].sum(), self.whole.sum()], np.float64)


def summary(total: ArrayLike) -> dict[str, float | None]:
    """Return {psnr_db, ssim} of a row: PSNR of the mean square over all pixels, mean SSIM over all windows.

    None where nothing was compared; PSNR is also None for equal pictures, where it is infinite.
    """
    square, pixels, like, windows = np.asarray(total, np.float64)
    return {
        "psnr_db": float(10.0 * np.log10(PEAK**2 * pixels / square)) if pixels and square else None,
        "ssim": float(like / windows) if windows else None,
    }


def _blurred(image: NDArray[Any]) -> NDArray[np.float64]:
    import cv2

    side = 2 * RADIUS + 1
    return np.asarray(cv2.GaussianBlur(image.astype(np.float64), (side, side), SIGMA_PX), np.float64)
