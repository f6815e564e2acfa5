"""Radiance to counts: irradiance, noise of the stated size, read-out and display."""

from dataclasses import replace

import numpy as np
import pytest

from thermorender.frames import apparent_temperature
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor import bolometer, display, optics
from thermorender.sensor.camera import load_camera

CAMERA = load_camera("zenmuse-xt2")
BLACKBODY = np.full((512, 640), band_radiance(300.0, *CAMERA.band_um), np.float32)


def seen_noise_mk(camera, frames=20):
    """Standard deviation over frames of the apparent temperature behind the counts [mK]."""
    found = np.array(
        [
            apparent_temperature(
                bolometer.radiance_from_counts(bolometer.counts(BLACKBODY, camera, 0, index), camera), camera.band_um
            )
            for index in range(frames)
        ]
    )
    return float(np.sqrt(found.var(axis=0, ddof=1).mean()) * 1e3)


def test_published_irradiance_of_the_netd():
    # 50 mK at f/1.0 and 300 K: 0.139 W m⁻² of scene exitance, 0.0277 W m⁻² at the detector.
    difference = 0.050 * band_radiance_derivative(300.0, 7.5, 13.5)
    assert np.pi * difference == pytest.approx(0.139, abs=5e-4)
    assert optics.detector_irradiance(difference, 1.0) == pytest.approx(0.0277, abs=5e-5)
    assert bolometer.noise_irradiance(CAMERA) == pytest.approx(0.0277, abs=5e-5)


@pytest.mark.parametrize(("f_number", "expected_mk"), [(1.0, 50.0), (1.25, 72.5)])
def test_netd_as_seen_in_counts(f_number, expected_mk):
    # 16 bits over a narrow range, so that rounding to counts adds next to nothing.
    camera = replace(CAMERA, f_number=f_number, lens_transmittance=1.0, bits=16, range_c=(0.0, 60.0))
    assert seen_noise_mk(camera) == pytest.approx(expected_mk, rel=0.02)


def test_noise_depends_on_seed_and_index_only():
    a = bolometer.counts(BLACKBODY, CAMERA, 7, 3)
    assert (a == bolometer.counts(BLACKBODY, CAMERA, 7, 3)).all()
    assert (a != bolometer.counts(BLACKBODY, CAMERA, 7, 4)).mean() > 0.5
    assert (a != bolometer.counts(BLACKBODY, CAMERA, 8, 3)).mean() > 0.5


def test_noise_free_read_out_inverts_within_half_a_count():
    camera = replace(CAMERA, netd_mk=1e-9)
    radiance = np.linspace(*band_radiance(np.array([250.0, 400.0]), *camera.band_um), 512 * 640).reshape(512, 640)
    back = bolometer.radiance_from_counts(bolometer.counts(radiance, camera, 0, 0), camera)
    step = np.diff(bolometer.radiance_from_counts(np.array([0, 1]), camera))[0]
    assert np.abs(back - radiance).max() <= 0.5001 * step


def test_ends_of_the_range():
    camera = replace(CAMERA, netd_mk=1e-9)
    ends = band_radiance(np.array(camera.range_c) + 273.15, *camera.band_um)
    full = bolometer.counts(ends[:, None], replace(camera, width=1, height=2), 0, 0)
    assert full.ravel().tolist() == [0, 2**14 - 1]
    hot = bolometer.counts(np.full((512, 640), 1e4, np.float32), CAMERA, 0, 0)
    assert bolometer.saturated(hot, CAMERA).all() and not bolometer.saturated(full + 5, camera)[0, 0]
    assert bolometer.saturated(full, camera).all()


def test_display_stretches_and_keeps_noise_quiet():
    ramp = np.linspace(2000, 6000, 512 * 640).reshape(512, 640).astype(np.uint16)
    shown = display.linear(ramp)
    assert shown.min() == 0 and shown.max() == 255 and (np.diff(shown.ravel().astype(int)) >= 0).all()
    quiet = display.linear(np.random.default_rng(0).normal(5000, 2, (512, 640)).astype(np.uint16))
    assert quiet.std() < 12
