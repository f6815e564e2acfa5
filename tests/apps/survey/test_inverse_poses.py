"""Poses of a survey's frames: the files they come from, the heights they count from, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rasterio.crs import CRS
from rasterio.warp import transform
from scipy.spatial.transform import Rotation

import thermorender as tr
from thermorender.apps.export.survey import geotiff
from thermorender.apps.survey.inverse.frames import frame_files, poses_of, read_frames, xmp_values
from thermorender.apps.survey.inverse.level import read_references
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.survey.inverse.poses import deviation
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.sensor.camera import load_camera


@pytest.fixture(scope="module")
def scene():
    full = load_camera("zenmuse-xt2")
    return tr.load_scene("heath").with_camera(
        replace(full, width=80, height=64, pixel_pitch_um=8 * full.pixel_pitch_um)
    )


@pytest.fixture(scope="module")
def pose(scene):
    return scene.pose(12.0, -7.0, 60.0, yaw_deg=30.0, pitch_deg=-70.0, roll_deg=4.0)


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


HEAD = "frame,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n"


def test_csv_of_poses_is_the_scene_s_pose(scene, pose, tmp_path):
    places = read_poses(written(tmp_path / "p.csv", HEAD + "a.tif,12,-7,60,30,-70,4\n"), scene)
    # Angles are those at the camera's place, and `Scene.pose` has those of the frame's origin.
    step = deviation(poses_of([places["a"]], scene)[0][0], pose)
    assert np.abs(step).max() < 1e-5


@pytest.mark.slow
def test_tags_of_exported_frames_are_their_poses(scene, pose, tmp_path):
    frame = tr.Renderer(scene, quality="fast").frame(pose)
    frame.save(tmp_path / "frames" / "frame_000000.exr")
    geotiff(tmp_path / "frames", tmp_path / "survey")
    survey = read_frames(frame_files([tmp_path / "survey"]), None, scene)
    np.testing.assert_allclose(survey.poses[0][:3, 3], pose[:3, 3], atol=1e-2)
    assert np.abs(deviation(survey.poses[0], pose)[3:]).max() < 1e-6
    assert np.abs(survey.kelvin[0] - frame.apparent_temperature).max() < 0.006


def test_metashape_s_estimates_are_poses_on_the_map(scene, pose, tmp_path):
    crs = scene.grid.crs
    latitude, longitude, height = scene.frame.geodetic_from_enu(pose[:3, 3])
    (x,), (y,) = transform(CRS.from_epsg(4326), crs, [float(longitude)], [float(latitude)])
    text = (
        f"# CoordinateSystem: {crs.to_wkt()}\n#Label,X/Easting,X_est,Y_est,Z_est,Yaw_est,Pitch_est,Roll_est\n"
        f"#Total error,,,,,,,\na.jpg,0,{x!r},{y!r},{float(height)!r},30,0,0\nlost.jpg,0,,,,,,\n"
    )
    places = read_poses(written(tmp_path / "m.txt", text), scene)
    assert list(places) == ["a"]
    found = poses_of([places["a"]], scene)[0][0]
    np.testing.assert_allclose(found[:3, 3], pose[:3, 3], atol=1e-3)
    # Angles 30, 0, 0 look down, with the top of the image 30° east of north.
    down = scene.pose(12.0, -7.0, 60.0, yaw_deg=30.0, pitch_deg=-90.0)
    assert np.degrees(np.abs(deviation(found, down)[3:]).max()) < 0.1


@pytest.mark.parametrize("zone", [-1, 1])
def test_metashape_s_yaw_counts_from_geographic_north_and_kappa_from_that_of_the_grid(scene, pose, tmp_path, zone):
    latitude, longitude, height = (float(each) for each in scene.frame.geodetic_from_enu(pose[:3, 3]))
    number = int((longitude + 180.0) // 6.0) + 1 + zone
    crs = CRS.from_epsg(32600 + number)
    (x,), (y,) = transform(CRS.from_epsg(4326), crs, [longitude], [latitude])

    def heading(angles, columns):
        text = f"# CoordinateSystem: {crs.to_wkt()}\n#Label,X/Easting,Y/Northing,Z/Altitude,{columns}\n"
        row = f"a.jpg,{x!r},{y!r},{height!r},{angles}\n"
        (place,) = read_poses(written(tmp_path / "m.txt", text + row), scene).values()
        north, east, _ = -place.rotation.as_matrix()[:, 1]
        return np.degrees(np.arctan2(east, north))

    # Convergence of a transverse Mercator projection on the sphere, within 0.0005° of that on the ellipsoid.
    away = np.radians(longitude - (6.0 * number - 183.0))
    convergence = np.degrees(np.arctan(np.tan(away) * np.sin(np.radians(latitude))))
    assert abs(convergence) > 2.0
    assert heading("30,0,0", "Yaw,Pitch,Roll") == pytest.approx(30.0, abs=1e-6)
    assert heading("0,0,-30", "Omega,Phi,Kappa") == pytest.approx(30.0 + convergence, abs=0.0005)


def test_opensfm_s_shots_are_poses(scene, pose, tmp_path):
    frame, away = scene.frame, LocalFrame(scene.frame.latitude_deg + 0.01, scene.frame.longitude_deg - 0.02, 0.0)
    turn = away.enu_from_ecef_rotation @ frame.enu_from_ecef_rotation.T
    origin = away.enu_from_geodetic(*frame.geodetic_from_enu(pose[:3, 3]))
    camera_from_world = Rotation.from_matrix(turn @ pose[:3, :3]).inv()
    shot = {"rotation": camera_from_world.as_rotvec().tolist(),
            "translation": (-camera_from_world.apply(origin)).tolist()}  # fmt: skip
    lla = {"latitude": away.latitude_deg, "longitude": away.longitude_deg, "altitude": 0.0}
    text = json.dumps([{"reference_lla": lla, "shots": {"a.tif": shot}}])
    places = read_poses(written(tmp_path / "reconstruction.json", text), scene)
    found = poses_of([places["a"]], scene)[0][0]
    np.testing.assert_allclose(found, pose, atol=1e-4)


def test_heights_are_shifted_above_the_ground(scene, tmp_path):
    text = HEAD.replace("above_ground_m", "up_m") + "a,0,0,300,0,-90,0\nb,5,0,302,0,-90,0\n"
    places = read_poses(written(tmp_path / "p.csv", text), scene)
    poses, notes = poses_of(list(places.values()), scene, 50.0)
    assert poses[0, 2, 3] - scene.ground(0.0, 0.0) == pytest.approx(50.0)
    assert poses[1, 2, 3] - poses[0, 2, 3] == pytest.approx(2.0)
    assert "shifted" in notes[0]
    _, notes = poses_of([replace(places["a"], height_m=float(scene.ground(0.0, 0.0)) + 50.01)], scene, 50.0)
    assert "shifted by +0.0 m" in notes[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame,east_m\na,1\n", "has the columns frame, east_m"),
        (HEAD + "a,1,2,3,4,5,6\na.tif,1,2,3,4,5,6\n", "given twice"),
        (HEAD + "a,1,x,3,4,5,6\n", "north_m='x' is not a finite number"),
    ],
)
def test_bad_poses_are_refused(scene, tmp_path, text, words):
    with pytest.raises(ThermorenderError, match=words):
        read_poses(written(tmp_path / "p.csv", text), scene)


def test_a_file_of_other_json_is_refused(scene, tmp_path):
    with pytest.raises(ThermorenderError, match=r"is neither a reconstruction\.json|has no shots"):
        read_poses(written(tmp_path / "a.json", '{"type": "FeatureCollection"}'), scene)


def test_frames_below_the_terrain_are_refused(scene, tmp_path):
    places = read_poses(
        written(tmp_path / "p.csv", HEAD.replace("above_ground_m", "up_m") + "a,0,0,-99,0,-90,0\n"), scene
    )
    with pytest.raises(ThermorenderError, match="above_ground"):
        poses_of(list(places.values()), scene)


def test_references_are_read_and_refused(tmp_path):
    head = "name,east_m,north_m,radius_m,kelvin,std_k\n"
    (found,) = read_references(written(tmp_path / "a.csv", head + "pond,1,2,3,290,0.1\n"))
    assert (found.name, found.kelvin) == ("pond", 290.0)
    with pytest.raises(ThermorenderError, match="std_k='0' is not allowed"):
        read_references(written(tmp_path / "b.csv", head + "pond,1,2,3,290,0\n"))
    with pytest.raises(ThermorenderError, match="has the columns name"):
        read_references(written(tmp_path / "c.csv", "name\npond\n"))


def test_values_of_xmp_are_found_as_attributes_and_elements():
    text = (
        '<rdf:Description drone-dji:GimbalYawDegree="+12.5" Camera:VertCS="ellipsoidal"><a:B>3</a:B></rdf:Description>'
    )
    assert xmp_values(text) == {"GimbalYawDegree": "+12.5", "VertCS": "ellipsoidal", "B": "3"}
