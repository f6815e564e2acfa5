"""Spectra and shifts of pictures."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from thermorender.apps.compare import (
    registration,
)


def test_spectrum_of_white_noise_is_its_variance():
    rng = np.random.default_rng(2)
    known = np.ones((512, 640), bool)
    total = 0.0
    for _ in range(8):
        found = registration.transform(rng.normal(0.0, 0.5, known.shape), known)
        frequency, density = registration.power(found)
        total = total + density / 8
    high = frequency > 0.05
    assert total[high].mean() == pytest.approx(0.25, rel=0.01) and frequency[-1] == 0.5


@pytest.mark.parametrize(("right", "down", "sign"), [(2.0, 0.0, 1), (-3.4, 1.7, 1), (0.0, 5.0, -1), (0.0, 0.0, 1)])
def test_a_shift_is_measured_to_a_tenth_of_a_pixel(right, down, sign):
    from scipy.ndimage import fourier_shift, gaussian_filter

    rng = np.random.default_rng(4)
    image = gaussian_filter(rng.normal(size=(512, 640)), 1.5)
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(image), (down, right))).real
    known = np.ones(image.shape, bool)
    found = registration.Appearance()
    for _ in range(2):
        noise = 0.3 * image.std() * rng.normal(size=image.shape)
        found.add(registration.transform(sign * moved + noise, known), registration.transform(image, known))
    shift = found.registration.summary()
    assert shift["right_px"] == pytest.approx(right, abs=0.1) and shift["down_px"] == pytest.approx(down, abs=0.1)
    assert np.sign(shift["correlation"]) == sign and max(shift["error_px"]) < 0.1
    # The data stored for each of hundreds of methods are small: no view of a whole picture.
    assert all(one.base is None and one.size < 100**2 for one in found.registration.surfaces)


def test_a_shift_of_forty_pixels_and_one_of_a_single_pose_are_found(tmp_path):
    rng = np.random.default_rng(2)
    image = 290.0 + gaussian_filter(rng.normal(size=(256, 256)), 1.5) * 20.0
    moved = np.roll(image, (25, -40), (0, 1))
    known = np.ones(image.shape, bool)
    pair = [registration.transform(each, known) for each in (moved, image)]
    shift = registration.Registration()
    shift.add(*pair)
    found = shift.summary()
    assert found["right_px"] == pytest.approx(-40.0, abs=0.1) and found["down_px"] == pytest.approx(25.0, abs=0.1)
    assert found["error_px"] is None and found["correlation"] > 0.5
    for _ in range(40):
        shift.add(*pair)
    assert len(shift.surfaces) < shift.poses == 41
    assert shift.summary()["right_px"] == pytest.approx(found["right_px"]) and shift.summary()["error_px"]
