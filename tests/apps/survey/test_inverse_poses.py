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
from thermorender.apps.survey.inverse.frames import frame_files, places_of, poses_of, read_frames, xmp_values
from thermorender.apps.survey.inverse.level import read_references
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.survey.inverse.poses import deviation
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame, ecef_from_geodetic
from thermorender.scene.patch import read_features
from thermorender.sensor.camera import load_camera


@pytest.fixture(scope="module")
def scene():
    full = load_camera("zenmuse-xt2")
    return tr.load_scene("heath/survey").with_camera(
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
    places = read_poses(written(tmp_path / "p.csv", HEAD + "a.tif,12,-7,60,30,-70,4\n"))
    # Angles are those at the camera's place, and `Scene.pose` has those of the frame's origin.
    step = deviation(poses_of([places["a"]], scene)[0][0], pose)
    assert np.abs(step).max() < 1e-5


@pytest.mark.slow
def test_tags_of_exported_frames_are_their_poses(scene, pose, tmp_path):
    frame = tr.Renderer(scene, quality="fast").frame(pose)
    frame.save(tmp_path / "frames" / "frame_000000.exr")
    geotiff(tmp_path / "frames", tmp_path / "survey")
    files = frame_files([tmp_path / "survey"])
    survey = read_frames(files, places_of(files), scene)
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
    places = read_poses(written(tmp_path / "m.txt", text))
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
        (place,) = read_poses(written(tmp_path / "m.txt", text + row)).values()
        north, east, _ = -place.rotation.as_matrix()[:, 1]
        return np.degrees(np.arctan2(east, north))

    # Convergence of a transverse Mercator projection on the sphere, within 0.0005° of that on the ellipsoid.
    away = np.radians(longitude - (6.0 * number - 183.0))
    convergence = np.degrees(np.arctan(np.tan(away) * np.sin(np.radians(latitude))))
    assert abs(convergence) > 2.0
    assert heading("30,0,0", "Yaw,Pitch,Roll") == pytest.approx(30.0, abs=1e-6)
    assert heading("0,0,-30", "Omega,Phi,Kappa") == pytest.approx(30.0 + convergence, abs=0.0005)


def metashape(path, system, *rows):
    """A text of Metashape with positions and yaw, pitch, roll in a system, which is WKT or an EPSG code."""
    wkt = system if isinstance(system, str) else f'LOCAL_CS["as coded",AUTHORITY["EPSG","{system}"]]'
    head = f"# CoordinateSystem: {wkt}\n#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll\n"
    return written(path, head + "".join(f"{row}\n" for row in rows))


# Places of points 180 m above the ellipsoids of these systems by pyproj 3.7.2: Transformer.from_crs(CRS(code).to_3d(),
# 4979), (latitude [deg], longitude [deg], height [m]).
OTHER_DATUMS = {
    (4179, 21.0, 52.2): (52.19973312551487, 20.99818368820923, 210.95538184046745),
    (3333, 3520000.0, 5786000.0): (52.20197972645806, 15.290695726569636, 220.09415466617793),
    (28404, 4500000.0, 5786000.0): (52.20240101508734, 20.99812663451726, 207.72659373935312),
    (31469, 5600000.0, 5790000.0): (52.23450403781153, 16.461791601094188, 218.9648447530344),
    (4979, 21.0, 52.2): (52.2, 21.0, 180.0),
}


@pytest.mark.parametrize(("given", "expected"), OTHER_DATUMS.items(), ids=[str(code) for code, *_ in OTHER_DATUMS])
def test_heights_above_the_ellipsoid_of_another_datum_become_wgs84(scene, tmp_path, given, expected):
    code, x, y = given
    (place,) = read_poses(metashape(tmp_path / "m.txt", code, f"a,{x},{y},180,0,0,0")).values()
    assert place.horizontal == pytest.approx(expected[:2], abs=1e-8)
    assert place.height_m == pytest.approx(expected[2], abs=1e-3)


def test_heights_of_a_datum_that_the_file_defines_become_wgs84(scene, tmp_path):
    """Against a position vector transformation of geocentric coordinates, EPSG method 9606."""
    a, f, latitude, longitude = 6377397.155, 1.0 / 299.1528128, np.radians(52.2), np.radians(21.0)
    wkt = (
        f'GEOGCS["own",DATUM["own",SPHEROID["Bessel",{a},{1.0 / f!r}],'
        'TOWGS84[598.1,73.7,418.2,0.202,0.045,-2.455,6.7]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
    )
    (place,) = read_poses(metashape(tmp_path / "m.txt", wkt, "a,21.0,52.2,180,0,0,0")).values()
    square = f * (2.0 - f)
    radius = a / np.sqrt(1.0 - square * np.sin(latitude) ** 2)
    flat = (radius + 180.0) * np.cos(latitude)
    geocentric = [flat * np.cos(longitude), flat * np.sin(longitude),
                  (radius * (1.0 - square) + 180.0) * np.sin(latitude)]  # fmt: skip
    x, y, z = np.radians(np.array([0.202, 0.045, -2.455]) / 3600.0)
    turned = np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]]) @ geocentric
    expected = [598.1, 73.7, 418.2] + (1.0 + 6.7e-6) * turned
    found = ecef_from_geodetic(*place.horizontal, place.height_m)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert place.height_m - 180.0 > 20.0


@pytest.mark.parametrize(
    ("system", "row", "words"),
    [
        (25832, "a.jpg,32500000,5700000,100,0,0,0", r"camera 'a\.jpg': 32500000, 5700000 is not a place in EPSG"),
        (3857, "a,1e6,-1e9,100,0,0,0", "camera 'a': 1000000, -1000000000 is not a place in EPSG:3857; give coord"),
        (4326, "a,21,152.2,100,0,0,0", "camera 'a': 21, 152.2 is not a place in EPSG:4326"),
        (32634, "a,1e300,1e300,100,0,0,0", "is not a place in EPSG:32634"),
        (4326, "a,21,52.2,100,1e308,0,0", r"camera 1: Yaw=1e\+308 is not an angle; give degrees up to 100000"),
        (4326, "a,,,,,,", r"m\.txt holds no pose of a camera; align the photographs before you export it"),
    ],
)  # fmt: skip
def test_poses_of_metashape_that_are_nowhere_are_named(scene, tmp_path, system, row, words):
    with pytest.raises(ThermorenderError, match=words):
        read_poses(metashape(tmp_path / "m.txt", system, row))


def test_an_angle_of_a_csv_that_is_none_is_named(scene, tmp_path):
    with pytest.raises(ThermorenderError, match=r"pitch_deg=-1e\+308 is not an angle"):
        read_poses(written(tmp_path / "p.csv", HEAD + "a,0,0,60,0,-1e308,0\n"))


def test_an_unknown_code_is_one_sentence_without_lines_of_gdal(scene, tmp_path, capfd):
    with pytest.raises(ThermorenderError, match="coordinate system cannot be read; export it in one with an EPSG code"):
        read_poses(metashape(tmp_path / "m.txt", 99999, "a,0,0,0,0,0,0"))
    content = {"type": "FeatureCollection", "features": [], "crs": {"properties": {"name": "EPSG:99999"}}}
    with pytest.raises(ThermorenderError):
        read_features(content)
    assert capfd.readouterr().err == ""


def test_opensfm_s_shots_are_poses(scene, pose, tmp_path):
    frame, away = scene.frame, LocalFrame(scene.frame.latitude_deg + 0.01, scene.frame.longitude_deg - 0.02, 0.0)
    turn = away.enu_from_ecef_rotation @ frame.enu_from_ecef_rotation.T
    origin = away.enu_from_geodetic(*frame.geodetic_from_enu(pose[:3, 3]))
    camera_from_world = Rotation.from_matrix(turn @ pose[:3, :3]).inv()
    shot = {"rotation": camera_from_world.as_rotvec().tolist(),
            "translation": (-camera_from_world.apply(origin)).tolist()}  # fmt: skip
    lla = {"latitude": away.latitude_deg, "longitude": away.longitude_deg, "altitude": 0.0}
    text = json.dumps([{"reference_lla": lla, "shots": {"a.tif": shot}}])
    places = read_poses(written(tmp_path / "reconstruction.json", text))
    found = poses_of([places["a"]], scene)[0][0]
    np.testing.assert_allclose(found, pose, atol=1e-4)


def test_heights_are_shifted_above_the_ground(scene, tmp_path):
    text = HEAD.replace("above_ground_m", "up_m") + "a,0,0,300,0,-90,0\nb,5,0,302,0,-90,0\n"
    places = read_poses(written(tmp_path / "p.csv", text))
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
        read_poses(written(tmp_path / "p.csv", text))


def test_a_file_of_other_json_is_refused(scene, tmp_path):
    with pytest.raises(ThermorenderError, match=r"is neither a reconstruction\.json|has no shots"):
        read_poses(written(tmp_path / "a.json", '{"type": "FeatureCollection"}'))


def test_frames_below_the_terrain_are_refused(scene, tmp_path):
    places = read_poses(written(tmp_path / "p.csv", HEAD.replace("above_ground_m", "up_m") + "a,0,0,-99,0,-90,0\n"))
    with pytest.raises(ThermorenderError, match="above_ground"):
        poses_of(list(places.values()), scene)


def test_references_are_read_and_refused(tmp_path):
    head = "name,east_m,north_m,radius_m,kelvin,std_k\n"
    (found,) = read_references(written(tmp_path / "a.csv", head + "pond,1,2,3,290,0.1\n"), None)
    assert (found.name, found.kelvin) == ("pond", 290.0)
    with pytest.raises(ThermorenderError, match="std_k='0' is not allowed"):
        read_references(written(tmp_path / "b.csv", head + "pond,1,2,3,290,0\n"), None)
    with pytest.raises(ThermorenderError, match="has the columns name"):
        read_references(written(tmp_path / "c.csv", "name\npond\n"), None)


def test_values_of_xmp_are_found_as_attributes_and_elements():
    text = (
        '<rdf:Description drone-dji:GimbalYawDegree="+12.5" Camera:VertCS="ellipsoidal"><a:B>3</a:B></rdf:Description>'
    )
    assert xmp_values(text) == {"GimbalYawDegree": "+12.5", "VertCS": "ellipsoidal", "B": "3"}


def test_references_in_degrees_need_the_scene_s_place(tmp_path):
    frame = LocalFrame(48.0, 11.0, 500.0)
    head = "name,lat_deg,lon_deg,radius_m,kelvin,std_k\n"
    path = written(tmp_path / "a.csv", head + "pond,48.001,11.002,3,290,0.1\n")
    (found,) = read_references(path, frame)
    # A degree of latitude is 111.2 km at 48°, one of longitude 74.6 km.
    assert found.north_m == pytest.approx(111.2, abs=0.1) and found.east_m == pytest.approx(149.2, abs=0.2)
    with pytest.raises(ThermorenderError, match="need a place of the scene"):
        read_references(path, None)
    with pytest.raises(ThermorenderError, match="lat_deg=98, lon_deg=11 is not a place"):
        read_references(written(tmp_path / "b.csv", head + "pond,98,11,3,290,0.1\n"), frame)
    both = "name,lat_deg,lon_deg,east_m,north_m,radius_m,kelvin,std_k\npond,48,11,0,0,3,290,0.1\n"
    with pytest.raises(ThermorenderError, match="east_m, north_m or lat_deg, lon_deg"):
        read_references(written(tmp_path / "c.csv", both), frame)
