"""Files of surveys as they come from the field: tags, tables and values that differ from the expected form."""

import io
import json
import struct
import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.crs import CRS
from rasterio.warp import transform
from scipy.spatial.transform import Rotation

import thermorender as tr
from thermorender.apps.survey.inverse.frames import (
    Place,
    camera_rotation,
    frame_files,
    poses_of,
    read_frames,
    tagged_place,
)
from thermorender.apps.survey.inverse.level import read_references
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.survey.verbs import parse_scale
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.physics.geodesy import LocalFrame
from thermorender.sensor.flir_jpeg import read_flir_jpeg
from thermorender.sensor.radiometric_files import read_temperature

HEAD = "frame,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n"
GOOD = {"GimbalYawDegree": "+190.0", "GimbalPitchDegree": "-90.0", "GimbalRollDegree": "+0.00",
        "RelativeAltitude": "+60.0", "FlightYawDegree": "+10.0"}  # fmt: skip
GPS = {1: "N", 2: (52.0, 12.0, 0.0), 3: "E", 4: (21.0, 0.0, 0.0), 5: b"\x00", 6: 190.0, 18: "WGS-84"}
WGS84 = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328],AUTHORITY["EPSG","4326"]]'
)


@pytest.fixture(scope="module")
def scene():
    return tr.load_scene("heath/survey")


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def tagged(path, gps, values, quote='"'):
    exif = Image.Exif()
    exif[34853] = gps
    attributes = " ".join(f"drone-dji:{name}={quote}{value}{quote}" for name, value in values.items())
    xmp = f"<x:xmpmeta><rdf:Description {attributes}/></x:xmpmeta>".encode()
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(path, exif=exif, xmp=xmp)
    return path


def without(*names):
    return {name: value for name, value in GOOD.items() if name not in names}


@pytest.mark.parametrize("quote", ['"', "'"])
def test_the_gimbal_s_angles_are_those_of_the_camera(tmp_path, quote):
    place = tagged_place(tagged(tmp_path / "a.jpg", GPS, GOOD, quote))
    assert (place.horizontal, place.height_m, place.height_of) == ((52.2, 21.0), 60.0, "above_takeoff_m")
    # The top of the image is ahead: 190° from north, beyond the half turn.
    top = place.rotation.apply([0.0, -1.0, 0.0])
    angle = np.radians(190.0)
    np.testing.assert_allclose(top, [np.cos(angle), np.sin(angle), 0.0], atol=1e-9)


@pytest.mark.parametrize(("reference", "height"), [(2, 190.0), (3, -190.0)])  # Exif 3.0: above and below the ellipsoid.
def test_heights_above_the_ellipsoid_keep_their_sign(tmp_path, reference, height):
    place = tagged_place(tagged(tmp_path / "a.jpg", {**GPS, 5: bytes([reference])}, without("RelativeAltitude")))
    assert (place.height_m, place.height_of) == (height, "alt_ellipsoid_m")


@pytest.mark.parametrize(
    ("gps", "values", "words"),
    [
        ({}, without("GimbalPitchDegree"), "no gimbal pitch"),
        ({}, without("GimbalYawDegree", "GimbalRollDegree"), "no gimbal yaw and roll"),
        ({}, without("RelativeAltitude"), "only one above sea level"),
        ({}, GOOD | {"RelativeAltitude": "n/a"}, "RelativeAltitude='n/a'"),
        ({}, GOOD | {"GimbalPitchDegree": "-90,0"}, "pitch='-90,0'"),
        ({1: ""}, GOOD, "without N or S"),
        ({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, GOOD, "had no fix"),
        ({9: "V"}, GOOD, "had no fix"),
        ({18: "TOKYO"}, GOOD, "datum 'TOKYO'"),
    ],
)
def test_tags_that_are_no_pose_are_refused(tmp_path, gps, values, words):
    with pytest.raises(ThermorenderError, match=f"{words}.*give the poses in a file"):
        tagged_place(tagged(tmp_path / "a.jpg", GPS | gps, values))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEAD + "a,1,5,2,5,40,0,0,0,-90,0,0,0\n", "13 cells where row 1 names 7 columns"),
        (HEAD.strip() + ",east_m\na,1,2,40,0,-90,0,7\n", "'east_m' 2 times"),
        (HEAD + 'a,"1,5",2,40,0,-90,0\n', "point as decimal mark"),
        (HEAD + "\n", "has no rows"),
        (
            HEAD.strip() + ",omega_deg,phi_deg,kappa_deg\na,1,2,40,0,-90,0,0,0,0\n",
            "yaw_deg, pitch_deg, roll_deg or omega_deg, phi_deg, kappa_deg",
        ),
    ],
)
def test_tables_of_other_forms_are_refused(scene, tmp_path, text, words):
    with pytest.raises(ThermorenderError, match=words):
        read_poses(written(tmp_path / "p.csv", text))
    if "frame" not in words and "2 times" not in words:
        table = text.replace("frame,", "name,").replace("frame;", "name;")
        with pytest.raises(ThermorenderError):
            read_references(written(tmp_path / "r.csv", table), None)


def test_blanks_and_a_byte_order_mark_are_no_values(scene, tmp_path):
    text = "\ufeff" + HEAD.replace(",", ", ") + "\na.tif, 1, +2, 40, -370, -90, 0\n"
    (place,) = read_poses(written(tmp_path / "p.csv", text)).values()
    assert (place.horizontal, place.height_m) == ((1.0, 2.0), 40.0)


def test_places_and_heights_that_cannot_be_are_refused(scene, tmp_path):
    frame = scene.frame
    swapped = f"a,{frame.longitude_deg},{frame.latitude_deg},40,0,-90,0\n"
    for row, words in (
        (swapped, "outside its terrain.*order of latitude and longitude"),
        ("a,5780000,500000,40,0,-90,0\n", "is not a place"),
    ):
        text = HEAD.replace("east_m,north_m", "lat_deg,lon_deg") + row
        places = read_poses(written(tmp_path / "p.csv", text))
        with pytest.raises(ThermorenderError, match=words):
            poses_of(list(places.values()), scene)
    places = read_poses(written(tmp_path / "p.csv", HEAD + "a,0,0,40,0,-90,0\nb,0,0,-40,0,-90,0\n"))
    with pytest.raises(ThermorenderError, match="frame 2 of 2 is 40 m below the terrain"):
        poses_of(list(places.values()), scene)
    with pytest.raises(ThermorenderError, match="above_ground_m=-5"):
        poses_of([places["a"]], scene, -5.0)


@pytest.mark.parametrize(
    ("system", "columns", "words"),
    [
        (WGS84, "X/Longitude,Y/Latitude,Z/Altitude,Alpha,Nu,Kappa", "angles yaw, pitch, roll or omega, phi, kappa"),
        (f'COMPD_CS["with EGM96 height",{WGS84},VERT_CS["EGM96 height",VERT_DATUM["EGM96 geoid",2005],'
         'UNIT["metre",1]]]', "X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll", "above sea level"),
        ('LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]',
         "X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll", "neither geographic nor projected"),
        ('PROJCS["feet",' + WGS84 + ',PROJECTION["Transverse_Mercator"],UNIT["US survey foot",0.3048006096012192]]',
         "X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll", "not in metres"),
    ],
)  # fmt: skip
def test_systems_and_angles_of_metashape_that_are_not_read_are_named(scene, tmp_path, system, columns, words):
    text = f"# CoordinateSystem: {system}\n#Label,{columns}\na,21.0,52.2,180,0,0,0\n"
    with pytest.raises(ThermorenderError, match=words):
        read_poses(written(tmp_path / "m.txt", text))


# (omega, phi, kappa) and (yaw, pitch, roll) of the optical axis [deg]. Down with the top to north and to 30°, ahead to
# north and to east 30° from the vertical, and down with the horizon turned by 5° about the north axis.
TURNS = [((0, 0, 0), (0, -90, 0)), ((0, 0, -30), (30, -90, 0)), ((30, 0, 0), (0, -60, 0)),
         ((0, -30, -90), (90, -60, 0)), ((0, 5, 0), (270, -85, 90))]  # fmt: skip


@pytest.mark.parametrize(("turns", "angles"), TURNS)
def test_omega_phi_kappa_are_the_angles_of_the_optical_axis(scene, tmp_path, turns, angles):
    expected = camera_rotation(*angles).as_matrix()
    head = HEAD.replace("yaw_deg,pitch_deg,roll_deg", "omega_deg,phi_deg,kappa_deg")
    row = ",".join(map(str, turns))
    (own,) = read_poses(written(tmp_path / "p.csv", f"{head}a,1,2,40,{row}\n")).values()
    columns = "X/Longitude,Y/Latitude,Z/Altitude,Omega,Phi,Kappa"
    text = f"# CoordinateSystem: {WGS84}\n#Label,{columns}\na,21.0,52.2,180,{row}\n"
    (metashape,) = read_poses(written(tmp_path / "m.txt", text)).values()
    np.testing.assert_allclose(own.rotation.as_matrix(), expected, atol=1e-12)
    np.testing.assert_allclose(metashape.rotation.as_matrix(), expected, atol=1e-12)


LENS = {"projection_type": "brown", "width": 640, "height": 512, "focal_x": 1.2, "focal_y": 1.2, "k1": -0.1}


def odm_project(scene):
    """Two shots of one project as reconstruction.json and, by OpenDroneMap's definition, as shots.geojson."""
    origin = (scene.frame.latitude_deg, scene.frame.longitude_deg, 120.0)
    frame = LocalFrame(*origin)
    zone = CRS.from_epsg(32600 + int((origin[1] + 180.0) // 6.0) + 1)

    def to_map(local):
        latitude, longitude, height = frame.geodetic_from_enu(np.asarray(local))
        (x,), (y,) = transform(CRS.from_epsg(4326), zone, [float(longitude)], [float(latitude)])
        return np.array([x, y, float(height)]), [float(longitude), float(latitude), float(height)]

    middle = to_map(np.zeros(3))[0]
    map_from_local = np.stack([(to_map(10.0 * axis)[0] - middle) / 10.0 for axis in np.eye(3)], axis=-1)
    shots, features = {}, []
    for name, position, turn in (
        ("DJI_0001.JPG", (30.0, -20.0, 40.0), (170, 10, 20)),
        ("b.tif", (0, 9, 41), (180, 0, 0)),
    ):
        rotation = Rotation.from_euler("xyz", turn, degrees=True)
        shots[name] = {"camera": "c", "rotation": rotation.as_rotvec().tolist(),
                       "translation": (-rotation.apply(position)).tolist()}  # fmt: skip
        on_map, degrees = to_map(position)
        turned = cv2.Rodrigues(rotation.as_matrix() @ np.linalg.inv(map_from_local))[0].ravel()
        features.append({"type": "Feature", "geometry": {"type": "Point", "coordinates": degrees},
                         "properties": {"filename": name, "focal": 1.2, "width": 640, "height": 512,
                                        "translation": on_map.tolist(), "rotation": turned.tolist()}})  # fmt: skip
    lla = dict(zip(("latitude", "longitude", "altitude"), origin, strict=True))
    whole = [{"reference_lla": lla, "cameras": {"c": LENS}, "shots": shots, "points": {}}]
    return whole, {"type": "FeatureCollection", "features": features}


def test_shots_and_reconstruction_of_one_project_are_the_same_poses(scene, tmp_path):
    whole, shots = odm_project(scene)
    one = read_poses(written(tmp_path / "reconstruction.json", json.dumps(whole)))
    other = read_poses(written(tmp_path / "shots.geojson", json.dumps(shots)))
    assert list(one) == list(other) == ["DJI_0001", "b"]
    first, second = (poses_of(list(places.values()), scene)[0] for places in (one, other))
    # OpenDroneMap's map is linear about the origin of the project.
    np.testing.assert_allclose(second[:, :3, 3], first[:, :3, 3], atol=0.002)
    np.testing.assert_allclose(second[:, :3, :3], first[:, :3, :3], atol=2e-5)
    assert one["b"].lens.distortion == (-0.1, 0.0, 0.0, 0.0, 0.0)
    assert other["b"].lens.focal_px == one["b"].lens.focal_px == 768.0
    with pytest.raises(ThermorenderError, match=r"768\.0 pixels without the distortion; give cameras\.json"):
        other["b"].lens.applied(scene.camera)


def test_shots_away_from_their_coordinates_are_refused(scene, tmp_path):
    _, shots = odm_project(scene)
    shots["features"][1]["geometry"]["coordinates"][:2] = shots["features"][1]["geometry"]["coordinates"][1::-1]
    with pytest.raises(ThermorenderError, match=r"of b is not at its translation.*reconstruction\.json"):
        read_poses(written(tmp_path / "shots.geojson", json.dumps(shots)))
    del shots["features"][0]["properties"]["rotation"]
    with pytest.raises(ThermorenderError, match="KeyError: 'rotation'"):
        read_poses(written(tmp_path / "shots.geojson", json.dumps(shots)))


def test_frames_of_two_lenses_are_refused(scene, tmp_path):
    whole, _ = odm_project(scene)
    whole[0]["cameras"]["d"] = LENS | {"k1": 0.0}
    whole[0]["shots"]["b.tif"]["camera"] = "d"
    places = read_poses(written(tmp_path / "reconstruction.json", json.dumps(whole)))
    for name in places:
        tiff(tmp_path / f"{name}.tif", np.full((4, 5), 290.0, np.float32), unit="K")
    with pytest.raises(ThermorenderError, match=r"different lenses.*'c'.*'d'"):
        read_frames(frame_files([tmp_path]), places, scene)
    found = read_frames([tmp_path / "b.tif"], places, scene)
    assert found.lens.distortion == (0.0,) * 5


def tiff(path, values, **options):
    unit, step = options.pop("unit", None), options.pop("step", None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", width=values.shape[1], height=values.shape[0], count=1,
                           dtype=values.dtype, **options) as file:  # fmt: skip
            file.write(values, 1)
            file.units = (unit,)
            if step is not None:
                file.scales = (step,)
    return path


def survey_of(folder, scene, scale=None):
    files = frame_files([folder])
    place = Place((0.0, 0.0), False, 40.0, "above_ground_m", camera_rotation(0.0, -90.0, 0.0))
    return read_frames(files, {path.stem: place for path in files}, scene, scale)


@pytest.mark.parametrize(("stated", "expected"), [("", "2021:07:01 12:30:00"), ("7 s", "7 s")])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_times_are_those_of_the_poses_or_else_of_the_tags(scene, tmp_path, stated, expected):
    path = tiff(tmp_path / "a.tif", np.full((4, 5), 290.0, np.float32), unit="K")
    with rasterio.open(path, "r+") as file:
        file.update_tags(TIFFTAG_DATETIME="2021:07:01 12:30:00")
    place = Place((0.0, 0.0), False, 40.0, "above_ground_m", camera_rotation(0.0, -90.0, 0.0), stated)
    assert read_frames([path], {"a": place}, scene).times == (expected,)


def test_values_that_no_surface_has_are_left_out_and_counted(scene, tmp_path):
    kelvin = np.full((4, 5), 290.0, np.float32)
    kelvin[0, :4] = -9999.0, np.inf, np.nan, 0.0
    kelvin[2, 2] = 800.0
    tiff(tmp_path / "a.tif", kelvin, unit="K", tiled=True, blockxsize=16, blockysize=16, BIGTIFF="YES")
    # Infinity is named where the file is read.
    with pytest.warns(ThermorenderWarning, match="pixels outside 100…1500 K are taken for no data"):
        found = survey_of(tmp_path, scene)
    assert np.isnan(found.kelvin[0, 0, :4]).all() and np.isnan(found.kelvin[0, 2, 2])
    assert (found.kelvin[0, 1:] == 290.0).sum() == 14
    # Values that are not above 0 K are no data.
    assert found.notes[0].startswith("1 pixels outside 150–700 K")


@pytest.mark.parametrize(
    ("kelvin", "words"),
    [(np.full((4, 5), 17.0, np.float32), "holds 17 K in the median"),
     (np.full((4, 5), np.nan, np.float32), "has no temperature")],
)  # fmt: skip
def test_frames_without_temperatures_are_refused(scene, tmp_path, kelvin, words):
    tiff(tmp_path / "a.tif", kelvin, unit="K")
    with pytest.raises(ThermorenderError, match=words):
        survey_of(tmp_path, scene)


def test_a_scale_against_the_file_s_own_is_refused(tmp_path):
    path = tiff(tmp_path / "a.tif", np.full((4, 5), 29000, np.uint16), unit="K", step=0.01)
    assert read_temperature(path, (0.01, 0.0)) == pytest.approx(np.full((4, 5), 290.0))
    with pytest.raises(ThermorenderError, match=r"declares 0\.01 K per count.*leave the scale out"):
        read_temperature(path, (0.04, 0.0))


def test_names_are_compared_beyond_neighbours_in_the_folder(tmp_path):
    for name in ("a.tiff", "a.k.tif", "a.tif"):
        (tmp_path / name).touch()
    with pytest.raises(ThermorenderError, match="have the same name"):
        frame_files([tmp_path])


def test_floats_that_are_kelvin_of_a_landscape_only_need_no_unit(tmp_path):
    kelvin = np.linspace(283.3, 311.2, 20).reshape(4, 5).astype(np.float32)
    np.testing.assert_allclose(read_temperature(tiff(tmp_path / "a.tif", kelvin)), kelvin)


@pytest.mark.parametrize(
    ("step", "zero", "words"),
    [(1.0, 273.15, r"scale=1,273\.15 for counts of 1 °C"),
     (5.0 / 9.0, 273.15 - 160.0 / 9.0, r"scale=0\.555556,255\.372 for counts of 1 °F")],
)  # fmt: skip
def test_fractions_without_a_unit_are_asked_for_with_the_likely_one(tmp_path, step, zero, words):
    # Tenths of a degree Celsius would fit the numbers too, and be tens of kelvin wrong.
    values = (np.linspace(293.3, 311.2, 20).reshape(4, 5) - zero) / step
    path = tiff(tmp_path / "a.tif", values.astype(np.float32))
    with pytest.raises(ThermorenderError, match=f"which look like {words}") as refused:
        read_temperature(path)
    assert "counts of 0.1" not in str(refused.value)
    assert read_temperature(path, (step, zero)).max() == pytest.approx(311.2, abs=1e-3)


@pytest.mark.parametrize(
    ("values", "words"),
    [(np.linspace(7100.5, 7500.25, 20, dtype=np.float32), r"look like scale=0\.04,0 for counts of 0\.04 K"),
     (np.linspace(19_000, 43_000, 20).astype(np.uint16), r"look like scale=0\.001,273\.15"),
     (np.full(20, 200, np.uint8), "8 bits a pixel, which is a picture for display")],
)  # fmt: skip
def test_values_without_a_unit_are_refused_with_the_likely_scale(tmp_path, values, words):
    path = tiff(tmp_path / "a.tif", values.reshape(4, 5))
    with pytest.raises(ThermorenderError, match=words):
        read_temperature(path)


def test_a_step_that_turns_warm_into_cold_is_refused():
    with pytest.raises(ThermorenderError, match=r"scale=-0\.01,600 has a STEP of -0\.01 .*above 0"):
        parse_scale("-0.01,600")


def test_copies_of_a_frame_are_left_out_and_named(scene, tmp_path):
    values = np.random.default_rng(0).normal(290.0, 2.0, (2, 4, 5)).astype(np.float32)
    for name, kelvin in zip("abc", values[[0, 1, 0]], strict=True):
        tiff(tmp_path / f"{name}.tif", kelvin, unit="K")
    found = survey_of(tmp_path, scene)
    assert (found.names, len(found.kelvin), len(found.poses)) == (("a", "b"), 2, 2)
    assert found.notes[0].startswith("1 frames are copies of others, pixel by pixel, and are left out: c.tif of a.tif")


def test_hidden_files_of_a_folder_are_not_frames(tmp_path):
    for name in ("a.tif", "._a.tif"):
        (tmp_path / name).touch()
    assert frame_files([tmp_path]) == [tmp_path / "a.tif"]


def test_names_that_differ_between_poses_and_frames_are_shown(scene, tmp_path):
    tiff(tmp_path / "dji_1.tif", np.full((4, 5), 290.0, np.float32), unit="K")
    places = read_poses(written(tmp_path / "p.csv", HEAD + "DJI_1.DNG,0,0,40,0,-90,0\n"))
    with pytest.raises(ThermorenderError, match=r"it names DJI_1\.DNG, and the frames are dji_1\.tif; write"):
        read_frames(frame_files([tmp_path]), places, scene)


@pytest.mark.parametrize("name", ["a.tif", "big.tif", "a.jpg"])
def test_frames_that_are_stored_turned_are_refused(scene, tmp_path, name):
    path = tmp_path / name
    if name == "a.jpg":
        flir(path)
        exif = Image.Exif()
        exif[274] = 6
        block = exif.tobytes()
        path.write_bytes(b"\xff\xd8\xff\xe1" + struct.pack(">H", len(block) + 2) + block + path.read_bytes()[2:])
    else:
        # GDAL does not write this tag, so one of the same form takes its place.
        tiff(path, np.full((4, 5), 290.0, np.float64), unit="K", BIGTIFF="YES" if name == "big.tif" else "NO")
        entry = "<HHQQ" if name == "big.tif" else "<HHII"
        planar, turned = struct.pack(entry, 284, 3, 1, 1), struct.pack(entry, 274, 3, 1, 6)
        assert planar in path.read_bytes()
        path.write_bytes(path.read_bytes().replace(planar, turned))
    with pytest.raises(ThermorenderError, match=r"orientation 6 in its tags.*exiftool -n -Orientation=1"):
        survey_of(tmp_path, scene)


def flir(path, emissivity=0.8, distance_m=40.0):
    """A radiometric JPEG of 8×6 pixels with its settings, and a picture of 4×4."""
    block = bytearray(0x340)
    for at, value in {
        0x20: emissivity, 0x24: distance_m, 0x28: 265.0, 0x2C: 290.15, 0x30: 293.15, 0x34: 1.0, 0x3C: 0.4,
        0x58: 17096.5, 0x5C: 1428.0, 0x60: 1.0, 0x70: 0.006569, 0x74: 0.01262, 0x78: -0.002276, 0x7C: -0.00667,
        0x80: 1.9, 0x90: 408.0, 0x94: 248.0, 0x30C: 0.0468,
    }.items():  # fmt: skip
        struct.pack_into(">f", block, at, value)
    struct.pack_into(">i", block, 0x308, -124)
    raw = struct.pack(">HHH", 3, 8, 6) + bytes(26) + np.full(48, 3050, ">u2").tobytes()
    body, entries = b"", b""
    for kind, data in ((0x01, raw), (0x20, bytes(block))):
        entries += struct.pack(">HHIIIIII", kind, 0, 0, 0, 128 + len(body), len(data), 0, 0).ljust(32, b"\0")
        body += data
    segment = b"FLIR\0\x01\0\0FFF\0" + b"test".ljust(16, b"\0") + struct.pack(">III", 100, 64, 2) + bytes(32)
    segment += entries + body
    picture = io.BytesIO()
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(picture, "JPEG")
    path.write_bytes(b"\xff\xd8\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + picture.getvalue()[2:])
    return path


def test_the_emissivity_in_a_radiometric_jpeg_is_not_removed_beside_the_scene_s(scene, tmp_path):
    picture = read_flir_jpeg(flir(tmp_path / "a.jpg"))
    found = survey_of(tmp_path, scene)
    apparent = picture.temperature(replace(picture.thermography, emissivity=1.0))
    assert found.kelvin.shape == (1, 6, 8)
    np.testing.assert_allclose(found.kelvin[0], apparent, atol=1e-3)
    assert picture.temperature()[0, 0] - apparent[0, 0] > 5.0
    assert any(
        "distance 40 m, air 17 °C, humidity 0.4" in note and "emissivity 0.8 is not" in note for note in found.notes
    )


def test_metashape_in_wgs84_with_heights_is_read_and_other_heads_are_named(scene, tmp_path):
    """EPSG:4979 has the three axes of EPSG:4326 and a height, and so the same places."""
    columns, row = "X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll", "a,21.0,52.2,180,10,1,2"
    found = [
        read_poses(written(tmp_path / "m.txt", f"# CoordinateSystem: {system}\n#Label,{columns}\n{row}\n"))["a"]
        for system in (WGS84, WGS84.replace('"4326"', '"4979"'))
    ]
    assert found[0].horizontal == pytest.approx(found[1].horizontal) and found[0].height_m == found[1].height_m
    np.testing.assert_allclose(found[0].rotation.as_matrix(), found[1].rotation.as_matrix(), atol=1e-12)
    text = f"# CoordinateSystem: {WGS84}\n#Labels,{columns}\n{row}\n"
    with pytest.raises(ThermorenderError, match=r"has the columns Labels, .*, not a label with positions"):
        read_poses(written(tmp_path / "m.txt", text))
