"""Geometry against real aerial photographs: the orthophoto seen from a photograph's pose must coincide with it."""

import csv
import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import shared_data, slow

import thermorender as tr
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.scene.georeference import pose_from_map
from thermorender.sensor.camera import load_camera


def photograph(path):
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            return np.ascontiguousarray(np.moveaxis(dataset.read(), 0, -1))


def displacement(rendered, covered, photo):
    """Distances between matched features of both pictures, (n,) [px]; no match is rejected by distance."""
    import cv2

    sift = cv2.SIFT_create(8000)
    inside = cv2.erode((covered * 255).astype(np.uint8), np.ones((25, 25)))
    points_a, features_a = sift.detectAndCompute(cv2.cvtColor(rendered, cv2.COLOR_RGB2GRAY), inside)
    points_b, features_b = sift.detectAndCompute(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), None)
    pairs = cv2.BFMatcher().knnMatch(features_a, features_b, k=2)
    good = [a for a, b in pairs if a.distance < 0.75 * b.distance]
    offsets = [np.subtract(points_b[m.trainIdx].pt, points_a[m.queryIdx].pt) for m in good]
    return np.linalg.norm(offsets, axis=-1)


@pytest.fixture(scope="module")
def toufeng(tmp_path_factory):
    folder = tmp_path_factory.mktemp("terrain") / "toufeng"
    dem = shared_data("terrain/odm_toufeng/dsm_0.8m.tif")
    import_terrain(dem, shared_data("terrain/odm_toufeng/orthophoto_0.2m.tif"), folder)
    return tr.Renderer(tr.load_scene(folder), rays=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["100_0005_0018", "100_0005_0136", "100_0005_0140", "100_0005_0142"])
def test_drone_photographs(toufeng, name):
    folder = shared_data("terrain/odm_toufeng/source_images")
    reconstruction = json.loads((folder / "reconstruction.json").read_text())[0]
    lens = next(iter(reconstruction["cameras"].values()))
    size = max(lens["width"], lens["height"])
    camera = replace(
        load_camera("ideal"),
        name="photograph",
        width=lens["width"],
        height=lens["height"],
        pixel_pitch_um=1.0,
        focal_length_mm=lens["focal_x"] * size * 1e-3,
        principal_offset_px=(lens["c_x"] * size, lens["c_y"] * size),
        distortion=tuple(lens[key] for key in ("k1", "k2", "p1", "p2", "k3")),
    )
    shot = reconstruction["shots"][name]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(shot["rotation"]).as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ shot["translation"]
    # The reconstruction uses the axes of the UTM grid, relative to its reference point.
    from rasterio.crs import CRS
    from rasterio.warp import transform

    utm, reference = CRS.from_epsg(32651), reconstruction["reference_lla"]
    (x,), (y,) = transform(CRS.from_epsg(4326), utm, [reference["longitude"]], [reference["latitude"]])
    pose[:3, 3] += [x, y, reference["altitude"]]
    rendered, covered = toufeng.visible(pose_from_map(toufeng.scene.frame, utm, pose), camera=camera)
    found = displacement(rendered, covered, photograph(folder / f"{name}.tif"))
    assert covered.mean() > 0.85 and len(found) > 500
    assert np.median(found) < 0.45


@pytest.fixture(scope="module")
def baviaans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("terrain") / "baviaans"
    dem = shared_data("terrain/ngi_baviaans/dem_24m.tif")
    import_terrain(dem, shared_data("terrain/ngi_baviaans/orthophoto_6m.tif"), folder)
    return tr.Renderer(tr.load_scene(folder), rays=1)


@pytest.mark.parametrize("row", [0, *slow(1, 2, 3)])
def test_survey_photographs(baviaans, row):
    folder = shared_data("terrain/ngi_baviaans/source_images")
    with open(folder / "ngi_xyz_opk.csv", newline="") as file:
        shot = list(csv.DictReader(file))[row]
    # Integraph DMC: 120 mm focal length over 92.16 mm for 640 columns, no distortion stated.
    camera = replace(
        load_camera("ideal"), name="DMC", width=640, height=1152, pixel_pitch_um=144.0, focal_length_mm=120.0
    )
    omega, phi, kappa = (float(shot[key]) for key in ("omega", "phi", "kappa"))
    pose = np.eye(4)
    # Photogrammetric axes are x right, y up, z backward.
    pose[:3, :3] = Rotation.from_euler("XYZ", [omega, phi, kappa], degrees=True).as_matrix() @ np.diag([1, -1, -1])
    pose[:3, 3] = [float(shot[key]) for key in "xyz"]
    scene = baviaans.scene
    rendered, covered = baviaans.visible(pose_from_map(scene.frame, scene.grid.crs, pose), camera=camera)
    found = displacement(rendered, covered, photograph(folder / f"{shot['filename']}.tif"))
    assert covered.mean() > 0.5 and len(found) > 200
    assert np.median(found) < 0.2
