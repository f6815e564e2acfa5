"""Reconstructions of frames without a scene."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from scipy.spatial.transform import Rotation
from survey_support import FLIGHT_M, HEIGHT, HILL_M, LENS, WIDTH, flight, frame, measured_poses

from thermorender.apps.survey.inverse import run as running
from thermorender.apps.survey.inverse.frames import Place
from thermorender.apps.survey.inverse.own_ground import between, level_scene, relief_scene, stated_camera
from thermorender.apps.survey.inverse.poses import PoseError
from thermorender.apps.survey.inverse.run import Inputs, run
from thermorender.apps.survey.verbs import _parted
from thermorender.errors import ThermorenderError
from thermorender.frame.tiff import write_kelvin
from thermorender.physics.geodesy import LocalFrame
from thermorender.trajectory.readers import enu_from_ned_at

HOME = LocalFrame(48.1, 11.5, 480.0)
CAMERA = f"""width = {WIDTH}
height = {HEIGHT}
pixel_pitch_um = 48.0
focal_length_mm = 9.36
f_number = 1.0
lens_transmittance = 1.0
band_um = [7.5, 13.5]
netd_mk = 50.0
netd_f_number = 1.0
bits = 14
range_c = [-25.0, 135.0]
frame_rate_hz = 9.0
"""


def place_of(pose, height_of="above_takeoff_m", **changes):
    latitude, longitude, height = HOME.geodetic_from_enu(pose[:3, 3])
    turn = enu_from_ned_at(pose[None, :3, 3], HOME).inv() * Rotation.from_matrix(pose[:3, :3])
    own = height if height_of == "alt_ellipsoid_m" else pose[2, 3]
    return replace(Place((float(latitude), float(longitude)), True, float(own), height_of, turn[0]), **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of frames of the hill, their poses as CSV and a nominal camera."""
    path = tmp_path_factory.mktemp("alone")
    poses = flight(lines=2, along=6)
    rng = np.random.default_rng(2)
    (path / "frames").mkdir()
    rows = []
    stated = measured_poses(poses, 0.2, 0.4)
    for number, (pose, own) in enumerate(zip(poses, stated, strict=True)):
        kelvin = frame(pose, LENS) + rng.normal(0.0, 0.05, (HEIGHT, WIDTH)) + rng.normal(0.0, 0.5)
        write_kelvin(path / "frames" / f"f{number:02d}.tif", kelvin.astype(np.float32))
        place = place_of(own)
        omega = (Rotation.from_matrix(own[:3, :3] @ np.diag([1.0, -1.0, -1.0]))).as_euler("XYZ", degrees=True)
        rows.append([f"f{number:02d}", *place.horizontal, place.height_m, *omega])
    with (path / "poses.csv").open("w", newline="") as file:
        head = ["frame", "lat_deg", "lon_deg", "above_takeoff_m", "omega_deg", "phi_deg", "kappa_deg"]
        csv.writer(file).writerows([head, *rows])
    (path / "nominal.toml").write_text(CAMERA)
    return path


def inputs_of(folder, **changes):
    given = {"poses": folder / "poses.csv", "camera": str(folder / "nominal.toml"), "pose_error": (0.2, 0.4)} | changes
    return Inputs((folder / "frames",), **given)


@pytest.fixture(scope="module")
def made(folder):
    out = folder / "out"
    return out, run(inputs_of(folder), out)


def test_lens_relief_and_frames_come_out_of_frames_alone(made):
    out, facts = made
    assert facts["frames"] == 12 and facts["texel_m"] == pytest.approx(1.25 * FLIGHT_M / 195.0, rel=0.1)
    # Two strips tell the distortion to a tenth.
    assert facts["lens"]["k1"] == pytest.approx(LENS[3], abs=0.03)
    with rasterio.open(out / "ground" / "elevation.tif") as file:
        heights = file.read(1)
    assert 0.7 * HILL_M < np.ptp(heights) < 1.6 * HILL_M
    with (out / "offsets.csv").open() as file:
        rest = [float(row["residual_k"]) for row in csv.DictReader(file)]
    # Frames have a contrast of 2.8 K and edges of 2 K in 0.5 m, so a pixel's residual of 0.3 m is 1 K.
    assert np.median(rest) < 0.5
    notes = " ".join(facts["notes"])
    assert "the lens is fitted to the frames" in notes and "the relief that the frames show" in notes


@pytest.mark.slow
def test_the_same_command_continues_from_the_adjustment(folder, made, monkeypatch):
    out, facts = made
    before = (out / "apparent.tif").read_bytes()

    def refused(*_):
        raise AssertionError("adjusted again")

    monkeypatch.setattr(running, "adjusted", refused)
    again = run(inputs_of(folder), out)
    assert (out / "apparent.tif").read_bytes() == before and again["lens"] == facts["lens"]
    (out / "state.npz").unlink()
    run(inputs_of(folder), out)
    assert (out / "apparent.tif").read_bytes() == before


@pytest.mark.slow
def test_a_run_without_states_gives_the_same_bytes(folder, made):
    out, _ = made
    run(inputs_of(folder), folder / "again")
    for name in ("apparent.tif", "apparent_std.tif", "poses.csv", "ground/elevation.tif"):
        assert (folder / "again" / name).read_bytes() == (out / name).read_bytes(), name


def test_the_result_s_scene_has_the_lens_and_lies_on_the_relief(made):
    out, facts = made
    camera = (out / "scene" / "camera.toml").read_text()
    assert f"{facts['lens']['k1']:.4f}"[:7] in camera
    assert json.loads((out / "reconstruction.json").read_text())["scene"] == "ground"


@pytest.mark.parametrize(
    ("changes", "above", "message"),
    [
        ({"geodetic": False}, None, "need latitude and longitude"),
        ({"height_of": "alt_ellipsoid_m"}, None, "give the height of the first frame above the ground as above_ground"),
        ({"height_of": "alt_ellipsoid_m"}, -3.0, "above_ground_m=-3.0 is not allowed"),
        ({"height_m": 0.2}, None, "are up to 0.2 m above their take-off, not 1 to"),
        ({"horizontal": (89.5, 0.0)}, None, "latitude 89.5 is not allowed"),
    ],
)
def test_frames_that_fix_no_level_are_refused(tmp_path, changes, above, message):
    with pytest.raises(ThermorenderError, match=message):
        level_scene([replace(place_of(flight()[0]), **changes)], above, tmp_path / "ground")


def test_heights_of_two_kinds_are_refused(tmp_path):
    pose = flight()[0]
    with pytest.raises(ThermorenderError, match="give one kind"):
        level_scene([place_of(pose), place_of(pose, "alt_ellipsoid_m")], None, tmp_path / "ground")


@pytest.mark.parametrize(
    ("height_of", "above", "level"),
    [("above_takeoff_m", None, 433.0), ("above_ground_m", None, 433.0), ("alt_ellipsoid_m", 50.0, 490.0)],
)
def test_the_level_is_that_of_the_take_off_or_below_the_first_frame(tmp_path, height_of, above, level):
    places = [place_of(pose, height_of, takeoff_m=433.0) for pose in flight()]
    scene = level_scene(places, above, tmp_path / "ground")
    # The raster holds singles, exact to 0.03 mm at 500 m; the ground curves by 2 mm over 160 m.
    assert scene.frame.height_m + scene.ground(0.0, 0.0) == pytest.approx(level, abs=0.01)


def test_a_relief_keeps_its_heights_and_poses_their_place_in_its_scene(tmp_path):
    level = level_scene([place_of(pose, takeoff_m=433.0) for pose in flight()], None, tmp_path / "level")

    def slope(east, north):
        return 0.1 * east - 0.05 * north

    ends = np.array([-80.0, -80.0]), np.array([60.0, 80.0])
    scene = relief_scene(level, slope, *ends, 4.0, tmp_path / "relief")
    moved = between(flight(), level.frame, scene.frame)
    for before, after in zip(flight(), moved, strict=True):
        above = after[2, 3] - scene.ground(*after[:2, 3])
        # Posts of 4 m hold a plane exactly; it curves by 1 mm within the scene.
        assert above == pytest.approx(before[2, 3] - slope(*before[:2, 3]), abs=0.01)
        geodetic = [np.array(f.geodetic_from_enu(p[:3, 3])) for f, p in ((level.frame, before), (scene.frame, after))]
        np.testing.assert_allclose(geodetic[0][:2], geodetic[1][:2], rtol=0.0, atol=1e-9)


def test_size_and_focal_length_of_the_tags_make_a_camera(tmp_path):
    from PIL import Image

    exif = Image.Exif()
    exif[272] = "M3T"
    exif.get_ifd(0x8769).update({37386: 9.1, 41989: 40})
    Image.new("L", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    camera, said = stated_camera(tmp_path / "a.jpg", (512, 640))
    # DJI states 40 mm of 35 mm film and 12 µm for this camera: 9.1 mm / 12 µm = 758 pixels.
    assert camera.focal_length_px == pytest.approx(758.0, abs=2.0) and camera.name == "M3T"
    assert (camera.width, camera.height) == (640, 512) and "758 pixels" in said
    Image.new("L", (8, 8)).save(tmp_path / "b.jpg")
    with pytest.raises(ThermorenderError, match="name the camera"):
        stated_camera(tmp_path / "b.jpg", (512, 640))


def test_positions_by_rtk_are_taken_as_better():
    place = place_of(flight()[0])
    fixed = replace(place, error_m=0.02)
    inputs = Inputs(())
    assert running._error(inputs, [fixed, fixed]) == (PoseError(0.1, 0.7), [])
    error, (said,) = running._error(inputs, [fixed, place])
    assert error == PoseError(1.0, 0.7) and said.startswith("1 of 2 frames have no position by RTK")
    assert running._error(replace(inputs, pose_error=(0.0, 0.0)), [fixed]) == (PoseError(0.0, 0.0), [])


def test_the_first_argument_is_a_scene_if_it_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "field").mkdir()
    (tmp_path / "field" / "scene.toml").write_text("")
    (tmp_path / "frames").mkdir()
    assert _parted(["field", "frames"])[0] == "field"
    assert _parted(["frames"]) == (None, (running.Path("frames"),))
    assert _parted(["heath", "frames"])[0] == "heath"
    # A folder of that name comes first.
    (tmp_path / "heath").mkdir()
    assert _parted(["heath", "frames"])[0] is None
    with pytest.raises(ThermorenderError, match="field is a scene; give frames"):
        _parted(["field"])
