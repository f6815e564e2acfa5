"""Lenses of photogrammetry's files, against OpenCV and the definitions of their programs."""

import json

import cv2
import numpy as np
import pytest

from thermorender.apps.survey.footage.lens_files import read_lens
from thermorender.errors import ThermorenderError
from thermorender.sensor.camera import load_camera

BROWN = {"projection_type": "brown", "width": 640, "height": 512, "focal_x": 1.2, "focal_y": 1.2, "c_x": 0.013,
         "c_y": -0.008, "k1": -0.21, "k2": 0.09, "p1": 0.004, "p2": -0.003, "k3": 0.02}  # fmt: skip
METASHAPE = {"projection": "frame", "width": 640, "height": 512, "f": 741.0, "cx": 10.0, "cy": 8.5, "k1": -0.03,
             "k2": 0.2, "k3": 0.15, "p1": 0.0087, "p2": 0.0039, "date": "2021-06-10T15:49:39Z"}  # fmt: skip


@pytest.fixture(scope="module")
def points():
    """Points in front of a camera whose images fill a field of 42° × 34°, (N, 3)."""
    x, y = np.meshgrid(np.linspace(-0.38, 0.38, 21), np.linspace(-0.3, 0.3, 17))
    return np.stack([7.0 * x, 7.0 * y, np.full_like(x, 7.0)], -1).reshape(-1, 3)


def odm(path, *cameras):
    path.write_text(json.dumps({f"v2 camera {number}": camera for number, camera in enumerate(cameras)}))
    return path


def metashape(path, values, root="calibration"):
    inside = "".join(f"<{name}>{value}</{name}>" for name, value in values.items())
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n<{root}>{inside}</{root}>')
    return path


def projected(path, points):
    camera, said = read_lens(path).applied(load_camera("zenmuse-xt2"))
    assert str(path) in said
    return camera.project(points)


def by_opencv(points, focal, centre, terms):
    """Pixels of OpenCV, whose first pixel has its middle at 0 and ours at ½."""
    matrix = np.array([[focal, 0.0, 319.5 + centre[0]], [0.0, focal, 255.5 + centre[1]], [0.0, 0.0, 1.0]])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(terms))[0][:, 0] + 0.5


def test_the_brown_model_of_opendronemap_is_that_of_opencv(tmp_path, points):
    expected = by_opencv(points, 1.2 * 640, (0.013 * 640, -0.008 * 640), [-0.21, 0.09, 0.004, -0.003, 0.02])
    np.testing.assert_allclose(projected(odm(tmp_path / "cameras.json", BROWN), points), expected, atol=1e-9)


def test_metashape_s_first_tangential_term_is_opencv_s_second(tmp_path, points):
    expected = by_opencv(points, 741.0, (10.0, 8.5), [-0.03, 0.2, 0.0039, 0.0087, 0.15])
    np.testing.assert_allclose(projected(metashape(tmp_path / "c.xml", METASHAPE), points), expected, atol=1e-9)


def test_a_perspective_lens_of_a_picture_of_twice_the_size(tmp_path, points):
    camera = {"projection_type": "perspective", "width": 1280, "height": 1024, "focal": 1.1, "k1": -0.1, "k2": 0.03}
    x, y, z = points.T
    r2 = (x**2 + y**2) / z**2
    d = 1.0 - 0.1 * r2 + 0.03 * r2**2
    expected = np.stack([1.1 * 640 * d * x / z + 320.0, 1.1 * 640 * d * y / z + 256.0], -1)
    np.testing.assert_allclose(projected(odm(tmp_path / "cameras.json", camera), points), expected, atol=1e-9)


def test_a_fisheye_lens_of_thermal_cameras_is_brown_s_to_the_stated_misfit(tmp_path, points):
    camera = {"projection_type": "fisheye", "width": 640, "height": 512, "focal": 1.2, "k1": -0.05, "k2": 0.01}
    path = odm(tmp_path / "cameras.json", camera)
    x, y, z = points.T
    r = np.hypot(x, y)
    theta = np.arctan2(r, z)
    share = 1.2 * 640 * theta * (1.0 - 0.05 * theta**2 + 0.01 * theta**4) / np.where(r > 0.0, r, 1.0)
    expected = np.stack([share * x + 320.0, share * y + 256.0], -1)
    error = np.abs(projected(path, points) - expected).max()
    assert error <= 1.01 * read_lens(path).misfit_px + 1e-9 < 0.02


def test_unequal_focal_lengths_are_fitted_and_stated(tmp_path):
    lens = read_lens(odm(tmp_path / "cameras.json", BROWN | {"focal_y": 1.2006}))
    # Half of 0.0006 × 640 pixels on the slopes at the edges, ± 0.42 and ± 0.33.
    assert 0.03 < lens.misfit_px < 0.1
    assert "Brown's model to" in lens.applied(load_camera("zenmuse-xt2"))[1]


def test_affinity_of_metashape_is_fitted_in_its_own_convention(tmp_path, points):
    plain = metashape(tmp_path / "a.xml", METASHAPE)
    sheared = metashape(tmp_path / "b.xml", METASHAPE | {"b1": 0.2, "b2": 0.0})
    # b1 widens columns only; a common focal length takes half of it.
    change = projected(sheared, points) - projected(plain, points)
    expected = 0.2 * (by_opencv(points, 1.0, (0, 0), [-0.03, 0.2, 0.0039, 0.0087, 0.15])[:, 0] - 320.0)
    assert np.abs(change[:, 0] - expected).max() <= read_lens(sheared).misfit_px + 0.01


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"projection_type": "spherical"}, "projection_type='spherical' is not read"),
        ({"focal_y": 1.3}, "differs from this lens by"),
        ({"focal_x": "long"}, "focal_x='long' is not a number of a lens"),
        ({"focal_x": -1.2, "focal_y": -1.2}, "give a length above 0"),
        ({"k4": 0.1}, "'k4' is not a key of the model brown"),
        ({"width": 640.5}, "width=640.5 is not allowed"),
        ({"width": 4000, "height": 3000}, "is of 4000×3000 pixels and camera"),
        ({"k1": -6.0}, "folds the image"),
        # Lengths in pixels, and a principal point from the corner.
        ({"focal_x": 768.0, "focal_y": 768.0}, "focal length of 491520 pixels"),
        ({"c_x": 0.513, "c_y": 0.392}, "a point inside the image"),
    ],
)
def test_lenses_that_cannot_be_used_are_refused(tmp_path, change, words):
    path = odm(tmp_path / "cameras.json", BROWN | change)
    with pytest.raises(ThermorenderError, match=words):
        read_lens(path).applied(load_camera("zenmuse-xt2"))


def test_wide_fisheyes_and_several_lenses_are_refused(tmp_path):
    wide = {"projection_type": "fisheye", "width": 640, "height": 512, "focal": 0.35}
    with pytest.raises(ThermorenderError, match=r"80° from its axis|differs from this lens"):
        read_lens(odm(tmp_path / "wide.json", wide))
    with pytest.raises(ThermorenderError, match=r"2 different lenses.*'v2 camera 1'"):
        read_lens(odm(tmp_path / "two.json", BROWN, BROWN | {"k1": -0.2}))
    assert read_lens(odm(tmp_path / "same.json", BROWN, BROWN)).focal_px == 1.2 * 640


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", "[]", "does not state cameras by name"),
        ("a.json", "{", "is not JSON"),
        ("a.xml", "<calibration>", "is not XML"),
        ("a.xml", '<!DOCTYPE c [<!ENTITY a "aaaa">]><calibration><f>&a;</f></calibration>', "document type definition"),
        ("a.xml", "<document/>", "not a camera calibration of Metashape"),
        # PhotoScan's former form counts the principal point from the corner.
        ("a.xml", "<calibration><projection>frame</projection><fx>741</fx></calibration>", "focal length f"),
    ],
)
def test_other_files_are_refused(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(ThermorenderError, match=words):
        read_lens(tmp_path / name)


@pytest.mark.parametrize("name", ["a.json", "a.xml"])
def test_a_missing_file_is_not_called_another_kind_of_file(tmp_path, name):
    with pytest.raises(ThermorenderError, match=f"^{tmp_path / name} cannot be read"):
        read_lens(tmp_path / name)


def test_terms_of_metashape_without_a_counterpart_are_refused(tmp_path):
    for change, words in (({"p3": 0.1}, "without p3 and p4"), ({"projection": "spherical"}, "'spherical' is not read"),
                          ({"skew": 1.0}, "'skew' is not read")):  # fmt: skip
        with pytest.raises(ThermorenderError, match=words):
            read_lens(metashape(tmp_path / "c.xml", METASHAPE | change))
