"""The camera: its file, its projection and its fields of view."""

from dataclasses import replace

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.sensor.camera import load_camera


def test_zenmuse_field_of_view():
    camera = load_camera("zenmuse-xt2")
    assert (camera.width, camera.height) == (640, 512)
    assert camera.field_of_view_deg == pytest.approx((45.4, 37.0), abs=0.05)


def test_directions_and_projection_agree_with_opencv():
    import cv2

    camera = replace(
        load_camera("ideal"), distortion=(-0.26, 0.10, 7e-4, 3e-4, -0.026), principal_offset_px=(3.0, -2.0)
    )
    points = np.random.default_rng(0).uniform([-3, -2.4, 8], [3, 2.4, 12], (500, 3))
    f = camera.focal_length_px
    matrix = np.array([[f, 0, camera.width / 2 + 3.0], [0, f, camera.height / 2 - 2.0], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))
    pixel = camera.project(points)
    np.testing.assert_allclose(pixel, expected[:, 0], atol=1e-6)
    slope = camera.directions(pixel)
    np.testing.assert_allclose(slope, points[:, :2] / points[:, 2:], atol=1e-9)


def test_within_a_pixel_a_lens_is_nearly_linear():
    """3e-4 of a pixel, as the renderer and the reference state that follow it so."""
    camera = replace(load_camera("ideal"), distortion=(-0.26, 0.10, 7e-4, 3e-4, -0.026))
    left = np.random.default_rng(1).uniform([0.0, 0.0], [camera.width - 1.0, camera.height - 1.0], (500, 2))
    begin, middle, end = (camera.directions(left + part) * camera.focal_length_px for part in (0.0, 0.5, 1.0))
    assert 1e-4 < np.abs(middle - 0.5 * (begin + end)).max() < 3e-4


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(load_camera("ideal").project([0.0, 0.0, -1.0])).all()


def test_folding_distortion_is_refused():
    camera = replace(load_camera("ideal"), distortion=(-5.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ThermorenderError, match=r"camera ideal: distortion=.*folds the image"):
        camera.directions(np.array([[0.5, 0.5]]))


def test_camera_files(tmp_path):
    with pytest.raises(ThermorenderError, match="give one of boson-640, ideal, neutrino-lc, tau2-640, zenmuse-xt2"):
        load_camera("zenmuse")
    text = (load_camera.__globals__["Path"](load_camera.__code__.co_filename).parent / "cameras/ideal.toml").read_text()
    path = tmp_path / "mine.toml"
    for old, new, words in (
        ("f_number = 1.0", "f_numbr = 1.0", "unknown key 'f_numbr'; did you mean 'f_number'"),
        ("netd_mk = 0.001\n", "", "key 'netd_mk' is missing"),
        ("f_number = 1.0", "f_number = -1.0", "f_number=-1.0 is not allowed; give a number 0.2…100"),
        ("[7.5, 13.5]", "[13.5, 7.5]", "give a list of 2 numbers above 0 and up to 1000 µm, the lower value first"),
        ("bits = 16", "bits = 20", "bits=20 is not allowed; give a whole number 2…16"),
        ("pixel_pitch_um = 17.0", "pixel_pitch_mm = 0.017", "'pixel_pitch_mm'; did you mean 'pixel_pitch_um' in µm"),
        ("pixel_pitch_um = 17.0", "pixel_pitch_um = 17e-6", "pixel_pitch_um=1.7e-05 .* give a number 0.5…1000 µm"),
        ("focal_length_mm = 13.0\n", "", "key 'focal_length_mm' is missing; add it in mm"),
        ("bits = 16", "bits = 16\ntime_constant_ms = -1", "time_constant_ms=-1 .* give a number 0…10000 ms"),
        ("bits = 16", "bits = 16\ncase_temperature_c = 298.15", "_c=298.15 .* give a number -100…150 °C"),
        ("bits = 16", "bits = 16\ndrift_mk_per_k = 'a'", "drift_mk_per_k='a' is not allowed; give .* mK per K"),
        ("bits = 16", "bits = 16\ndiffraction = 1", "diffraction=1 is not allowed; give one of false, true"),
        ("bits = 16", "bits = 16\ngain = 'middle'", "gain='middle' is not allowed; give one of high, low"),
        ("bits = 16", "bits = 16\ntlinear_mk = 0.04", "tlinear_mk=0.04 .* give one of 0.0, 40.0, 400.0 mK"),
        ("bits = 16", "bits = 16\nsigma_tv_mk = 0.001", "leave nothing of netd_mk=0.001"),
    ):
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(ThermorenderError, match=words):
            load_camera(str(path))
    path.write_text(text + "gain = 'low'\ntlinear_mk = 400\n")
    camera = load_camera(str(path))
    assert camera.name == "mine" and camera.tlinear_mk == 400.0
    assert camera.count_range_k == pytest.approx((233.15, 823.15))


@pytest.mark.parametrize(
    ("name", "field_deg"),
    [
        ("zenmuse-xt2-9mm", (69.0, 56.0)),
        ("zenmuse-xt2-19mm", (32.0, 26.0)),
        ("tau2-640", (32.0, 26.0)),
        ("boson-640", (31.0, 25.0)),
    ],
)
def test_published_fields_of_view(name, field_deg):
    camera = load_camera(name)
    middle = np.array([[0.0, 256.0], [320.0, 0.0]])
    half = np.degrees(np.arctan(np.abs(camera.directions(middle)).max(axis=1)))
    assert 2.0 * half == pytest.approx(field_deg, abs=1.0)
