"""The camera as data and as geometry."""

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


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(load_camera("ideal").project([0.0, 0.0, -1.0])).all()


def test_folding_distortion_is_refused():
    camera = replace(load_camera("ideal"), distortion=(-5.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ThermorenderError, match="camera ideal: distortion=.*folds the image"):
        camera.directions(np.array([[0.5, 0.5]]))


def test_camera_files(tmp_path):
    with pytest.raises(ThermorenderError, match="'zenmuse' is unknown; give one of ideal, zenmuse-xt2"):
        load_camera("zenmuse")
    text = (load_camera.__globals__["Path"](load_camera.__code__.co_filename).parent / "cameras/ideal.toml").read_text()
    path = tmp_path / "mine.toml"
    for old, new, words in (
        ("f_number = 1.0", "f_numbr = 1.0", "unknown key 'f_numbr'; did you mean 'f_number'"),
        ("netd_mk = 0.001\n", "", "key 'netd_mk' is missing"),
        ("f_number = 1.0", "f_number = -1.0", "f_number=-1.0 is not allowed; give a number above 0"),
        ("[7.5, 13.5]", "[13.5, 7.5]", "give the lower value first"),
        ("bits = 16", "bits = 20", "bits=20 is not allowed; give 2…16"),
    ):
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(ThermorenderError, match=words):
            load_camera(str(path))
    path.write_text(text)
    assert load_camera(str(path)).name == "mine"
