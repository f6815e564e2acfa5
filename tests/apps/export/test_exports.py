"""Exports of frames, read back by other programs: COCO labels, masks, geotagged TIFFs."""

import json
import pickle
import re
import shutil
import subprocess
import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio
from scipy.ndimage import distance_transform_cdt
from scipy.spatial.transform import Rotation
from support import records

import thermorender as tr
from scenes import narrow, scene_object, write_mesh, write_terrain
from thermorender.apps.export.labels import coco, masks, run_lengths
from thermorender.apps.export.survey import geotiff, ground
from thermorender.errors import ThermorenderError
from thermorender.frame.exr import read_exr, write_exr
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.georeference import Place
from thermorender.sensor.radiometric_files import read_temperature

# car_1 is under one half of roof-1; car_2 drives east.
OBJECTS = (
    scene_object("car_1", [2.0, 2.0, 1.0])
    + scene_object("roof-1", [1.0, 1.0, 0.0001], [0.5, 0.5, 2.0], 280.0)
    + scene_object("car_2", [1.0, 1.0, 1.0], [-4.0, 0.0, 0.0], 340.0, track="track.csv")
)


def write_scene(folder, extra=OBJECTS, **terrain):
    write_terrain(folder, extra=extra, **terrain)
    (folder / "track.csv").write_text("time_s,east_m\n0,-3.0\n4,1.0\n")
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return narrow(tr.load_scene(write_scene(tmp_path_factory.mktemp("exports") / "scene")), 320, 256)


@pytest.fixture(scope="module")
def renderer(scene):
    return tr.Renderer(scene, quality="fast", rays=16)


@pytest.fixture(scope="module")
def flight(renderer, scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    log = folder / "log.csv"
    log.write_text(
        "time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n"
        "0,-1,0,20,0,-90,0\n1,0,-3,16,20,-75,8\n2,3,3,15,230,-70,-12\n"
    )
    path = tr.load_trajectory(log, scene)
    tr.fly(renderer, path, folder / "out", tr.FlightOptions(rate_hz=1.0, products=("exr", "truth", "display")))
    return folder / "out"


def test_boxes_and_hidden_shares_of_known_geometry(renderer, scene):
    frame = renderer.frame(scene.pose(0.0, 0.0, 10.0, 0.0, -90.0), time_s=1.0)
    focal = scene.camera.focal_length_px
    number = {name: k for k, name in enumerate(frame.objects, start=1)}
    # Name, half side [m] and middle (east, north) of the upper side, its distance [m].
    for name, half, middle, far in (("car_1", 1.0, (0, 0), 9.0), ("roof-1", 0.5, (0.5, 0.5), 8.0)):
        left, right = ((middle[0] + sign * half) * focal / far + 160.0 for sign in (-1, 1))
        top, low = ((-middle[1] + sign * half) * focal / far + 128.0 for sign in (-1, 1))
        label = frame.labels[name]
        assert np.allclose(label["full_box"], [left, top, right - left, low - top], atol=0.02)
        assert label["truncated"] == 0.0
        assert abs(label["silhouette_pixels"] - (right - left) * (low - top)) < 2 * (right - left)
        if name == "roof-1":
            rows, columns = np.nonzero(frame.truth["object"] == number[name])
            box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            assert np.allclose(box, [left, top, right, low], atol=1.0)
    # The roof covers 1 m² at 8 m of a car of 4 m² at 9 m; beyond the car's edge lies (9/8 − 1) of its width.
    assert frame.labels["roof-1"]["occluded"] == 0.0
    assert abs(frame.labels["car_1"]["occluded"] - 0.25) < 0.01
    assert frame.labels["car_1"]["pixels"] == (frame.truth["object"] == number["car_1"]).sum()
    assert (renderer.objects_seen(frame.pose, 1.0)[0] + 1 == frame.truth["object"]).all()


def test_a_table_of_crowns_is_a_crowd_without_extents(tmp_path):
    (tmp_path / "out").mkdir()
    folder = write_terrain(tmp_path / "s", extra=scene_object("car", [1.0, 1.0, 1.0], [3.0, 0.0, 0.0], 310.0) + (
        '[[object]]\nname = "trees"\nshape = "sphere"\nsize = [2.0, 2.0, 2.0]\nposition = [0.0, 0.0, 0.0]\n'
        'temperature = 290.0\nmaterial = "broadleaf"\nleaf_area_1_m = 5.0\ninstances = "trees.csv"\n'
    ))  # fmt: skip
    (folder / "trees.csv").write_text("east_m,north_m\n-1.0,0.0\n-3.0,1.0\n")
    scene = narrow(tr.load_scene(folder), 160, 128)
    frame = tr.Renderer(scene, quality="fast", rays=16).frame(scene.pose(0.0, 0.0, 45.0, 0.0, -90.0))
    assert (frame.truth["object"] == frame.objects.index("trees") + 1).any()
    assert set(frame.labels) == set(frame.targets) == {"car"}
    write_exr(tmp_path / "out" / "frame_000000.exr", frame, truth=True)
    coco(tmp_path / "out", tmp_path / "labels.json")
    found = {one["object"]: one for one in json.loads((tmp_path / "labels.json").read_text())["annotations"]}
    assert (found["car"]["iscrowd"], found["trees"]["iscrowd"]) == (0, 1)
    assert found["trees"]["range_m"] is None and found["trees"]["full_box"] is None and found["trees"]["area"] > 100


@pytest.mark.parametrize("side", ["left", "right"])
def test_share_beyond_the_border(renderer, scene, side):
    # Middle of the car 2 m from the axis: its upper side reaches from 1.5 to 2.5 m at a distance of 9 m.
    edge = 160.0 * 9.0 / scene.camera.focal_length_px
    frame = renderer.frame(scene.pose(0.0 if side == "left" else -4.0, 0.0, 10.0, 0.0, -90.0), time_s=1.0)
    assert 1.5 < edge < 2.5
    # The side towards the axis is visible too: in slopes it reaches from 1.5 / 10 to 1.5 / 9.
    inner, whole = 1.5 / 9.0 - 1.5 / 10.0, 1.0 / 9.0
    label = frame.labels["car_2"]
    assert abs(label["truncated"] - (2.5 - edge) / 9.0 / (whole + inner)) < 0.01
    left, _, width, _ = label["full_box"]
    assert left < 0.0 if side == "left" else left + width > 320.0
    away = renderer.frame(scene.pose(0.0, 0.0, 10.0, 0.0, -90.0), time_s=-99.0)
    assert "car_2" not in away.labels and away.targets["car_2"]["in_view"] is False


def test_a_lens_that_folds_far_out_shows_nothing_from_there(renderer, scene):
    camera = replace(scene.camera, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    folded = tr.Renderer(scene.with_camera(camera), quality="fast", rays=16, like=renderer)
    # A point at a slope of (1/0.3)^½ would be imaged in the middle of the image.
    frame = folded.frame(scene.pose(5.5, 0.0, 3.5, 0.0, -90.0))
    assert frame.targets["car_1"]["in_view"] is False
    assert "car_1" not in frame.labels


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_coco_agrees_with_the_truth(flight, tmp_path, capsys):
    import pycocotools.coco

    assert coco(flight, tmp_path / "labels.json") == {"images": 3, "annotations": 9, "categories": 2}
    read = pycocotools.coco.COCO(str(tmp_path / "labels.json"))
    capsys.readouterr()
    assert {each["id"]: each["name"] for each in read.loadCats(read.getCatIds())} == {1: "car", 2: "roof"}
    lines = records(flight)
    for image in read.loadImgs(read.getImgIds()):
        assert (flight / image["file_name"]).suffix == ".png" and (flight / image["file_name"]).exists()
        channels, about = read_exr(flight / f"frame_{image['id'] - 1:06d}.exr")
        shown, kelvin = channels["truth.object"], channels["apparent_temperature"]
        found = read.loadAnns(read.getAnnIds(image["id"]))
        assert sorted(each["track_id"] for each in found) == np.unique(shown[shown > 0]).tolist()
        for each in found:
            mask = read.annToMask(each).astype(bool)
            assert (mask == (shown == each["track_id"])).all()
            assert each["object"] == about["objects"][each["track_id"] - 1]
            assert each["area"] == mask.sum() == pycocotools.coco.maskUtils.area(read.annToRLE(each))
            assert (pycocotools.coco.maskUtils.toBbox(read.annToRLE(each)) == each["bbox"]).all()
            assert each["range_m"] == lines[image["id"] - 1]["targets"][each["object"]]["range_m"]
            distance = distance_transform_cdt(~mask, metric="chessboard")
            around = kelvin[(distance > 1) & (distance <= 5) & (shown == 0)]
            own = kelvin[mask].mean(dtype=float)
            assert abs(each["apparent_k"] - own) < 1e-3
            if len(around):
                assert abs(each["contrast_k"] - (own - around.mean(dtype=float))) < 2e-3
            else:
                assert each["contrast_k"] is None


def test_run_lengths_begin_outside():
    assert run_lengths(np.array([[True, False], [True, True]])) == {"size": [2, 2], "counts": [0, 2, 1, 1]}
    assert run_lengths(np.zeros((2, 3), bool)) == {"size": [2, 3], "counts": [6]}


def test_masks_are_the_truth(flight, tmp_path):
    assert masks(flight, tmp_path) == 3
    legend = json.loads((tmp_path / "legend.json").read_text())
    channels, _ = read_exr(flight / "frame_000001.exr")
    for name, kind in (("material", np.uint8), ("object", np.uint16)):
        mask = cv2.imread(str(tmp_path / f"frame_000001_{name}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.dtype == kind and (mask == channels[f"truth.{name}"]).all()
        assert {str(number) for number in np.unique(mask)} <= set(legend[name])
    paint = next(int(number) for number, name in legend["material"].items() if name == "paint_black")
    assert ((channels["truth.material"] == paint) == (channels["truth.object"] > 0)).all()


def test_masks_of_many_mixtures_have_ten_classes_and_other_over_all_frames(tmp_path, monkeypatch):
    # Material m fills m + 1 columns of the first frame; 30 to 33 are mixtures, in the second.
    names = [f"kind {number}" for number in range(30)]
    mixed = {
        "0.625 kind 3 + 0.375 kind 29": "kind 3", "0.25 kind 1 + 0.375 kind 2 + 0.375 kind 4": "kind 2",
        "0.125 kind 29 + 0.875 kind 2": "kind 2", "0.5 kind 0 + 0.5 kind 9": "kind 0",
    }  # fmt: skip
    first = np.repeat(np.arange(30), np.arange(30) + 1)[None].repeat(2, axis=0)
    second = np.full_like(first, 255)
    second[0, :400] = np.arange(400) % 4 + 30
    frames = [
        (n, {"truth.material": image, "truth.object": 0 * image}, {"materials": [*names, *mixed], "objects": ["a"]})
        for n, image in enumerate((first, second))
    ]
    monkeypatch.setattr("thermorender.apps.export.labels.exr_frames", lambda *_: iter(frames))
    assert masks(tmp_path, tmp_path / "out") == 2
    legend = json.loads((tmp_path / "out/legend.json").read_text())
    # Pixels: kind 2 has 6 + 200, kind 3 has 8 + 100, kind 0 has 2 + 100, kind 29 has 60, kind 28 has 58 …
    wanted = ["kind 2", "kind 3", "kind 0", *(f"kind {n}" for n in range(29, 22, -1)), "other"]
    assert legend["class"] == {str(n): name for n, name in enumerate(wanted)} | {"255": "none"}
    one, two = (cv2.imread(str(tmp_path / f"out/frame_{n:06d}_class.png"), cv2.IMREAD_UNCHANGED) for n in (0, 1))
    assert one.dtype == np.uint8 and all(
        legend["class"][str(shown)] == (name if name in wanted else "other")
        for shown, name in zip(one[1], [names[n] for n in first[1]], strict=True)
    )
    assert [wanted[n] for n in two[0, :4]] == list(mixed.values()) and (two[0, 400:] == 255).all()


def angles_and_position(tags):
    """Angles of both conventions [deg] and (latitude, longitude, height) from ExifTool's JSON with -n."""
    nadir, gimbal = (
        Rotation.from_euler("ZYX", [float(tags[name]) for name in names], degrees=True).as_matrix()
        for names in (("Yaw", "Pitch", "Roll"), ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"))
    )
    return nadir, gimbal, [float(tags[f"GPS{name}"]) for name in ("Latitude", "Longitude", "Altitude")]


def tags_by_exiftool(path):
    done = subprocess.run(["exiftool", "-n", "-json", str(path)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)[0]


def tags_by_tifffile(path):
    import tifffile

    with tifffile.TiffFile(path) as file:
        tags = {tag.name: tag.value for tag in file.pages[0].tags.values()}
    exif, gps, xmp = tags["ExifTag"], tags["GPSTag"], bytes(tags["XMP"]).decode()
    found = dict(re.findall(r'Camera:(\w+)="([^"]*)"', xmp)) | dict(re.findall(r"<drone-dji:(\w+)>([^<]*)<", xmp))

    def number(ratio):
        return ratio[0] / ratio[1] if isinstance(ratio, (tuple, list)) else float(ratio)

    for name in ("Latitude", "Longitude"):
        parts = np.reshape(gps[f"GPS{name}"], (3, 2))
        sign = -1.0 if gps[f"GPS{name}Ref"] in "SW" else 1.0
        found[f"GPS{name}"] = sign * (parts[:, 0] / parts[:, 1] @ [1.0, 1 / 60, 1 / 3600])
    below = gps["GPSAltitudeRef"] in (1, b"\x01")
    found["GPSAltitude"] = (-1.0 if below else 1.0) * number(gps["GPSAltitude"])
    return found | {
        "Make": tags["Make"], "Model": tags["Model"], "FocalLength": number(exif["FocalLength"]),
        "FocalPlaneXResolution": number(exif["FocalPlaneXResolution"]),
        "FocalPlaneResolutionUnit": int(exif["FocalPlaneResolutionUnit"]),
    }  # fmt: skip


@pytest.mark.parametrize("tags_of", [tags_by_exiftool, tags_by_tifffile], ids=["exiftool", "tifffile"])
def test_tags_project_targets_to_the_pixels_of_the_truth(flight, scene, tmp_path, tags_of):
    if tags_of is tags_by_exiftool and not shutil.which("exiftool"):
        pytest.skip("exiftool is not installed")
    assert geotiff(flight, tmp_path) == 3
    camera = scene.camera
    for index, line in enumerate(records(flight)):
        tags = tags_of(tmp_path / f"frame_{index:06d}.tif")
        assert tags["Make"] == "thermorender" and tags["Model"] == camera.name
        assert tags["BandName"] == "LWIR" and int(tags["FocalPlaneResolutionUnit"]) == 3
        focal_px = tags["FocalLength"] * tags["FocalPlaneXResolution"] / 10.0
        assert abs(focal_px - camera.focal_length_px) < 1e-4
        nadir, gimbal, place = angles_and_position(tags)
        origin = scene.frame.enu_from_geodetic(*place)
        enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
        # Camera axes (right, down, ahead) in body axes: of a camera that looks ahead, and of one that looks down.
        ahead, down = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
        for world_from_camera in (enu @ gimbal @ ahead, enu @ nadir @ down):
            # Where the truth says the objects are: at their pixel and range.
            for target in line["targets"].values():
                slope = np.append(camera.directions(target["pixel"]), 1.0)
                pose = np.array(line["world_from_camera"])
                point = pose[:3, 3] + target["range_m"] * pose[:3, :3] @ slope / np.linalg.norm(slope)
                x, y, z = (point - origin) @ world_from_camera
                pixel = np.array([x, y]) / z * focal_px + [camera.width / 2, camera.height / 2]
                assert np.abs(pixel - target["pixel"]).max() < 0.05


def test_files_that_are_not_frames_stay_out(flight, tmp_path):
    """A copy of a frame under another name has no number, and numbers beyond six digits keep their order."""
    shutil.copytree(flight, tmp_path / "flight")
    for name in ("frame_000001_copy", "frame_best", "frame_1000000"):
        shutil.copy(flight / "frame_000001.exr", tmp_path / "flight" / f"{name}.exr")
    assert coco(tmp_path / "flight", tmp_path / "labels.json")["images"] == 4
    labels = json.loads((tmp_path / "labels.json").read_text())
    assert [image["id"] for image in labels["images"]] == [1, 2, 3, 1000001]


@pytest.fixture(scope="module")
def frame(renderer):
    """A frame from the origin of the scene, with all that is written of it."""
    return pickle.loads(pickle.dumps(renderer.frame(np.eye(4))))


def tags_at(folder, frame, latitude_deg, longitude_deg, height_m=0.0, time=None):
    """GPS and EXIF tags of a frame at the origin of a scene at a place on Earth."""
    from PIL import Image

    place = Place(LocalFrame(latitude_deg, longitude_deg, height_m), frame.place.crs)
    folder.mkdir()
    write_exr(folder / "frame_000000.exr", replace(frame, place=place, time=time and np.datetime64(time)), truth=False)
    assert geotiff(folder, folder / "out") == 1
    with Image.open(folder / "out" / "frame_000000.tif") as image:
        return [image.getexif().get_ifd(number) for number in (0x8825, 0x8769)]


def test_seconds_of_a_position_stay_below_60(frame, tmp_path):
    for number, value in enumerate((20.0, 20.0 - 1e-13, 19.999999999, -0.5, 179.99999999999)):
        gps, _ = tags_at(tmp_path / str(number), frame, 10.0, value)
        degrees, minutes, seconds = map(float, gps[4])
        assert minutes < 60.0 and seconds < 60.0
        assert degrees + minutes / 60.0 + seconds / 3600.0 == pytest.approx(abs(value), abs=1e-10)


def test_geotiff_is_kelvin_for_gdal_and_this_package(flight, tmp_path):
    kelvin = read_exr(flight / "frame_000002.exr")[0]["apparent_temperature"]
    for float32, kind, error in ((False, "uint16", 0.0051), (True, "float32", 1e-4)):
        folder = tmp_path / kind
        geotiff(flight, folder, float32)
        path = folder / "frame_000002.tif"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            file = rasterio.open(path)
        with file:
            assert file.dtypes == (kind,) and file.units == ("K",)
            assert np.abs(file.read(1) * file.scales[0] + file.offsets[0] - kelvin).max() < error
        assert np.abs(read_temperature(path) - kelvin).max() < error
        assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).dtype == kind


def test_time_of_a_survey_is_utc(frame, tmp_path):
    gps, more = tags_at(tmp_path / "f", frame, -33.5, -70.25, -12.5, "2018-07-28T12:34:56.250000000")
    assert (gps[1], gps[3], gps[5]) == ("S", "W", b"\x01") and abs(float(gps[6]) - 12.5) < 1e-6
    assert [float(v) for v in gps[2]] == [33.0, 30.0, 0.0] and [float(v) for v in gps[4]] == [70.0, 15.0, 0.0]
    assert [float(v) for v in gps[7]] == [12.0, 34.0, 56.25] and gps[29] == "2018:07:28"
    assert more[36867] == "2018:07:28 12:34:56" and more[36881] == "+00:00" and int(more[37521]) == 250000000


def test_ground_is_the_orthorectified_frame(flight, renderer, tmp_path):
    assert ground(flight, tmp_path, 0.25) == 3
    line = records(flight)[1]
    frame = renderer.frame(line["world_from_camera"], line["time_s"])
    own = frame.orthorectified(0.25)
    with rasterio.open(tmp_path / "frame_000001_ground.tif") as file:
        assert file.crs == own.grid.crs and np.allclose(file.transform, own.grid.transform)
        # Poses on file are rounded, so single pixels may fall beside their cell's border.
        difference = np.abs(file.read(1) - own.kelvin)
        assert (difference[np.isfinite(difference)] < 1e-2).mean() > 0.99


def test_commands_count_one_and_several(flight, tmp_path, call):
    one = tmp_path / "one"
    one.mkdir()
    shutil.copy(flight / "frame_000000.exr", one)
    for verb, option, words in (("ground", ["--metres=0.5"], "map"), ("geotiff", [], "image")):
        for folder, wanted in ((one, f"1 {words} in"), (flight, f"3 {words}s in")):
            status, output, _ = call("export", verb, folder, *option, "-o", tmp_path / f"{verb}-{folder.name}")
            assert status == 0 and output.startswith(wanted)


def test_what_cannot_be_exported_is_refused(tmp_path):
    with pytest.raises(ThermorenderError, match=r"holds no frame_\*.exr; give a folder of"):
        coco(tmp_path, tmp_path / "labels.json")
    import trimesh

    mesh = write_mesh(tmp_path / "mesh", trimesh.creation.box((20, 20, 1)), temperature=700.0)
    scene = narrow(tr.load_scene(mesh), 16, 16)
    frame = tr.Renderer(scene, quality="fast", rays=16).frame(tr.pose(0, 0, 10, pitch_deg=-90))
    from thermorender.frame.exr import write_exr

    (tmp_path / "bare").mkdir()
    write_exr(tmp_path / "bare" / "frame_000000.exr", frame, truth=False)
    with pytest.raises(
        ThermorenderError, match=r"has no 'truth.material'; render it again with the products exr,truth"
    ):
        masks(tmp_path / "bare", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(ThermorenderError, match=r"without a place on Earth; add \[frame\] with latitude_deg"):
        geotiff(tmp_path / "bare", tmp_path / "out")
    toml = mesh / "scene.toml"
    toml.write_text(toml.read_text() + "[frame]\nlatitude_deg = 50\nlongitude_deg = 8\nheight_m = 100\n")
    scene = narrow(tr.load_scene(mesh), 16, 16)
    frame = tr.Renderer(scene, quality="fast", rays=16).frame(tr.pose(0, 0, 10, pitch_deg=-90))
    write_exr(tmp_path / "bare" / "frame_000000.exr", frame, truth=False)
    with pytest.raises(ThermorenderError, match=r"reaches 6\d\d K, and counts of 0.01 K end at 655.35 K; set float32"):
        geotiff(tmp_path / "bare", tmp_path / "out")
    assert geotiff(tmp_path / "bare", tmp_path / "out", float32=True) == 1
