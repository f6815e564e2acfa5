"""The link: a session gives the bytes of `fly`, checks what arrives, and has its own sensor."""

import gc
import json
import time
import weakref
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from link_support import connected, serving
from scipy.spatial.transform import Rotation

import thermorender as tr
from scenes import WEATHER, coarse, scene_object, write_balance, write_terrain
from thermorender.apps.link import Code, LinkError
from thermorender.apps.link.messages import Open, Request
from thermorender.apps.link.session import ServerSession
from thermorender.apps.link.stage import Stage
from thermorender.apps.link.wire import Product
from thermorender.errors import ThermorenderError
from thermorender.frame.exr import read_exr
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.output.flight import FlightOptions, fly
from thermorender.output.photograph import photograph
from thermorender.physics.planck import band_radiance
from thermorender.render.flight.live import LiveFrames
from thermorender.sensor.schedule import SUBPIXEL_PX
from thermorender.trajectory.rotations import rotation_from_wxyz, wxyz

pytestmark = pytest.mark.usefixtures("short_heat")

DOWN = (0.0, 1.0, 0.0, 0.0)
PRODUCTS = ("exr", "truth", "counts", "display")
OBJECTS = scene_object("plate", [2, 2, 0.1], [0.5, 0.0, 0.2], shape="disc", track="plate.csv")
TRACK = "time_s,east_m,temperature_k\n0,-1,320\n0.4,1,340\n1,1.5,335\n"


@pytest.fixture(scope="module")
def renderer(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    folder.mkdir()
    (folder / "plate.csv").write_text(TRACK)
    scene = coarse(tr.load_scene(write_terrain(folder, extra=OBJECTS)), 8)
    return tr.Renderer(scene, rays=4, samples=1, seed=11)


@pytest.fixture(scope="module")
def path():
    """A fast path that turns, with samples between the frames."""
    rng, time_s = np.random.default_rng(3), np.linspace(0.0, 1.0, 41)
    position = np.column_stack([3.0 * np.sin(3.0 * time_s), 2.0 * time_s - 1.0, 12.0 + time_s])
    turn = Rotation.from_rotvec(np.cumsum(rng.normal(0.0, 0.01, (41, 3)), axis=0))
    return tr.Trajectory(time_s, position, wxyz(turn * rotation_from_wxyz(DOWN)))


@pytest.fixture(scope="module")
def flown(renderer, path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("flown") / "f"
    fly(renderer, path, folder, FlightOptions(rate_hz=9.0, stop_s=0.7, products=PRODUCTS, audit=4))
    return folder


@pytest.fixture(scope="module")
def server(renderer):
    cameras = {"half": renderer.scene.camera.coarser(2)}
    with serving(Stage(renderer, cameras, ("fok-1to1",))) as made:
        yield made


@pytest.fixture
def client(server):
    with connected(server) as made:
        yield made


def samples(path, first, last):
    """Rows of a path after one time up to another."""
    rows = np.column_stack([path.time_s, path.position, path.quaternion])
    return rows[(path.time_s > first) & (path.time_s <= last)]


def flight(session, path, times, **request):
    """Replies of a session at times, each with the path as far ahead as the frame depends on it."""
    sent = -np.inf
    for time_s in times:
        rows = samples(path, sent, np.inf)
        # Interpolation needs the sample after the end.
        ends = rows[:, 0] <= time_s + session.opened.ahead_s
        rows = rows[: int(ends.sum()) + 1]
        sent = rows[-1, 0] if len(rows) else sent
        yield session.frame(time_s, path=rows, **request)


def test_same_bytes_as_a_flight(client, path, flown):
    session = client.open(seed=11, rate_hz=9.0, audit=4)
    names = ("counts", "display", "radiance", "temperature", "depth", "segmentation", "material", "targets")
    lines = [json.loads(line) for line in (flown / "frames.jsonl").read_text().splitlines()]
    assert len(lines) == 7
    assert max(line["plan"]["sensor"]["motion_px"] for line in lines) > SUBPIXEL_PX  # the pixels' past matters
    for line, reply in zip(
        lines, flight(session, path, [line["time_s"] for line in lines], products=names), strict=True
    ):
        stem = flown / f"frame_{line['index']:06d}"
        channels, _ = read_exr(stem.with_suffix(".exr"))
        images = {
            "counts": cv2.imread(f"{stem}_counts.png", cv2.IMREAD_UNCHANGED),
            "display": cv2.imread(f"{stem}.png", cv2.IMREAD_UNCHANGED),
            "radiance": channels["radiance"],
            "temperature": channels["apparent_temperature"],
            "depth": channels["truth.depth"],
            "segmentation": channels["truth.object"],
            "material": channels["truth.material"],
        }
        for name, image in images.items():
            assert getattr(reply, name).tobytes() == image.astype(getattr(reply, name).dtype).tobytes(), name
        assert json.loads(json.dumps(reply.targets)) == line["targets"]
        assert (reply.index, reply.time_s, reply.seed) == (line["index"], line["time_s"], 11)
        assert reply.budget_mk == pytest.approx(line["budget_mk"]["total"], abs=0.006)
        assert reply.image_budget_mk == pytest.approx(line["budget_mk"]["image"], abs=0.006)


def test_sessions_have_their_own_sensor(client, path, flown):
    times = np.arange(2) / 9.0
    first, other = client.open(seed=11, rate_hz=9.0), client.open(seed=12, rate_hz=9.0)
    pairs = list(zip(flight(first, path, times), flight(other, path, times), strict=True))
    for index, (one, two) in enumerate(pairs):
        counts = cv2.imread(str(flown / f"frame_{index:06d}_counts.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(one.counts, counts)
        assert (two.counts != counts).mean() > 0.5


def test_cameras_of_one_vehicle(client, renderer):
    pose, other = tr.pose(0.0, 0.0, 14.0, pitch_deg=-90.0), renderer.scene.camera.coarser(2)
    wanted = tr.Renderer(renderer.scene.with_camera(other), rays=4, samples=1, like=renderer).frame(pose)
    one, two = client.open(), client.open("half")
    first, second = (session.frame(0.0, pose, products=("temperature",)) for session in (one, two))
    assert first.temperature.tobytes() == renderer.frame(pose).apparent_temperature.tobytes()
    assert second.temperature.tobytes() == wanted.apparent_temperature.tobytes()


def test_given_objects_replace_their_tracks(client, path, flown):
    session = client.open(seed=11, rate_hz=9.0)
    table = np.array([line.split(",") for line in TRACK.split()[1:]], float)
    objects = [("plate", row[0], {"east_m": row[1], "temperature_k": row[2]}) for row in table[:2]]
    times = np.arange(3) / 9.0
    for index, time_s in enumerate(times):
        rows = samples(path, -1.0 if index == 0 else times[index - 1] + 0.15, time_s + 0.15)
        reply = session.frame(time_s, path=rows, objects=objects if index == 0 else ())
        counts = cv2.imread(str(flown / f"frame_{index:06d}_counts.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(reply.counts, counts)
    warm = session.frame(0.5, path=samples(path, times[-1] + 0.15, 0.6), products=("temperature", "segmentation"),
                         objects={"plate": {"temperature_k": 400.0}})  # fmt: skip
    assert warm.temperature[warm.segmentation == 1].max() > 370.0


@pytest.mark.parametrize("attitude", ["body", "angles"])
@pytest.mark.parametrize("position", ["enu", "wgs84"])
def test_poses_follow_the_conventions_of_logs(client, renderer, tmp_path, position, attitude):
    scene = renderer.scene
    north_west, angles, mount, lever = (-2.0, 3.0, 14.0), (40.0, 5.0, -3.0), (10.0, -80.0, 0.0), (0.3, 0.1, -0.2)
    latitude, longitude, height = scene.frame.geodetic_from_enu(np.array(north_west))
    place, names = (north_west, "east_m,north_m,up_m") if position == "enu" else (
        (latitude, longitude, height), "lat_deg,lon_deg,alt_ellipsoid_m")  # fmt: skip
    text = ",".join(map(repr, map(float, (*place, *angles))))
    (tmp_path / "log.csv").write_text(f"time_s,{names},yaw_deg,pitch_deg,roll_deg\n0,{text}\n1,{text}\n")
    wanted = tr.load_trajectory(tmp_path / "log.csv", scene, mount=mount, lever_arm_m=lever)
    session = client.open(position=position, attitude=attitude, mount_deg=mount, lever_arm_m=lever)
    turn = angles if attitude == "angles" else wxyz(Rotation.from_euler("ZYX", angles, degrees=True))
    reply = session.frame(0.0, (*place, *turn), products=("depth", "targets"))
    frame = renderer.frame(wanted.pose(0.0))
    np.testing.assert_allclose(reply.depth, frame.truth["depth"], rtol=1e-5)
    assert reply.targets["plate"]["pixel"] == pytest.approx(frame.targets["plate"]["pixel"], abs=2e-3)


def test_translations_are_those_of_the_map(client, renderer):
    pose, model = tr.pose(0.0, 0.0, 14.0, pitch_deg=-90.0), load_model("fok-1to1")
    session = client.open(method="B", map="fok-1to1")
    reply = session.frame(0.0, pose, products=("radiance", "visible", "depth", "counts"))
    photo, covered = photograph(renderer, pose)
    np.testing.assert_array_equal(reply.visible, photo)
    texel = float(np.median(reply.depth[covered])) / renderer.scene.camera.focal_length_px
    # Nothing is colder than the map's limit.
    coldest = band_radiance(model.limits_k[0], *model.band_um)
    np.testing.assert_allclose(reply.radiance, np.maximum(model.radiance(Inputs(photo, texel)), coldest), rtol=1e-5)
    assert np.isnan(reply.budget_mk) and session.opened.range_k == model.range_k
    own = np.random.default_rng(1).integers(0, 256, photo.shape, np.uint8)
    reply = session.frame(1.0, pose, products=("radiance", "visible"), picture=own, texel_m=0.3)
    np.testing.assert_array_equal(reply.visible, own)
    np.testing.assert_allclose(reply.radiance, np.maximum(model.radiance(Inputs(own, 0.3)), coldest), rtol=1e-5)
    with pytest.raises(LinkError, match=r"9 × 7 pixels; resize it to those of the session's camera, 80 × 64"):
        session.frame(2.0, pose, picture=own[:7, :9])


def test_translations_keep_the_maps_temperature_under_a_camera_of_another_band(renderer):
    """The replies, and the note of the server."""
    own = renderer.scene.camera
    mid = replace(own, name="mid", band_um=(3.7, 4.8))
    stage = Stage(renderer, {"mid": mid}, ("fok-1to1",))
    (note,) = stage.notes
    assert note.startswith("learned map 'fok-1to1'") and note.endswith("another band than that of camera mid")
    picture = np.random.default_rng(1).integers(0, 256, (own.height, own.width, 3), np.uint8)
    kelvin = []
    for name in (own.name, "mid"):
        session = stage.open(Open(method="B", map="fok-1to1", camera=name))
        poses = np.array([[0.0, 0.0, 0.0, 14.0, *DOWN]])
        session.answer([Request(0.0, int(Product.TEMPERATURE), False, poses, (), picture, 0.3)], time.perf_counter())
        kelvin.append(session.last.apparent_temperature)
    known = np.isfinite(kelvin[0])
    assert known.mean() > 0.9
    np.testing.assert_allclose(kelvin[1][known], kelvin[0][known], atol=1e-3)


def test_map_on_the_orthophoto_is_that_of_compare(client, renderer):
    from thermorender.apps.compare.methods import rendered

    pose = tr.pose(0.0, -3.0, 14.0, pitch_deg=-75.0)
    model = load_model("fok-1to1")
    method = rendered(renderer.scene, "fok-1to1", model, renderer)[0]
    assert method.renderer.plan.sampling == renderer.plan.sampling
    reply = client.open(method="C", map="fok-1to1").frame(0.0, pose, products=("radiance",))
    wanted = method.renderer.radiance(pose, 0.0, method.objects)
    assert reply.radiance.tobytes() == wanted.tobytes()
    assert np.abs(wanted - renderer.radiance(pose)).mean() > 0.01


@pytest.mark.slow
def test_temperatures_follow_the_weather_as_in_a_flight(tmp_path):
    scene = coarse(tr.load_scene(write_balance(tmp_path / "tiny", WEATHER)), 16)
    renderer = tr.Renderer(scene, rays=4, samples=1)
    path = tr.Trajectory([0.0, 200.0], [[-1.0, 0.0, 12.0], [1.0, 0.0, 12.0]], [DOWN, DOWN])
    frames, live = list(renderer.frames(path, rate_hz=1 / 50.0)), LiveFrames(renderer, rate_hz=1 / 50.0)
    taken = [live.take(frame.time_s, path if frame.index == 0 else None) for frame in frames]
    for frame, one in zip(frames, taken, strict=True):
        assert one.counts.tobytes() == frame.counts.tobytes() and one.time == frame.time
    assert (taken[-1].radiance != taken[0].radiance).mean() > 0.9
    end = scene.weather.time[-1] - scene.time
    late = end / np.timedelta64(1, "s") + 60.0
    with pytest.raises(ThermorenderError, match=r"is after the weather of the scene, which ends at .*; stop there, or"):
        live.take(late, tr.Trajectory([late], [[0.0, 0.0, 12.0]], [DOWN]))


HIGH = (0.0, 0.0, 12.0, *DOWN)


IMPOSSIBLE = [
    ({"time_s": 0.5}, r"time_s=0.5 does not follow the frame before, at 1 s; time must rise"),
    ({"time_s": 1.0}, r"does not follow the frame before"),
    ({"time_s": np.nan}, r"time_s=nan is not a time"),
    ({"time_s": np.inf}, r"time_s=inf is not a time"),
    ({"pose": (0, 0, 12, 0, 2, 0, 0)}, r"quaternion: sample 0 has length 2; unit quaternions are needed"),
    ({"pose": (0, np.nan, 12, *DOWN)}, r"pose 0 is .*nan.*; all its values must be finite numbers"),
    ({"pose": (0, 0, -7, *DOWN)}, r"the camera is 7.00 m under the terrain; give a higher position"),
    ({"pose": (0, 0, 2e5, *DOWN)}, r"more than 100 km from the scene's origin"),
    ({"pose": None}, r"time_s=2 is outside the path, which spans 1 to 1 s; give its samples up to"),
    ({"path": [(3, *HIGH), (2.5, *HIGH)], "pose": None}, r"time is running backwards"),
    ({"path": [(0.5, *HIGH)], "pose": None}, r"path: the sample at 0.5 s does not follow the one at 1 s"),
    (
        {"objects": {"car": {"yaw_deg": 1.0}}},
        r"object 'car' has no track and cannot change; give one that has \(plate\)",
    ),
    ({"objects": {"plate": {"temperature_k": -1.0}}}, r"temperature_k.*kelvin"),
    ({"objects": {"plate": {"east_m": np.nan}}}, r"object 'plate': east_m=nan is not allowed"),
    ({"objects": {"plate": {"east_m": 900.0}}}, r"object 'plate' is at 900 m east, .* where there is no terrain"),
    ({"picture": np.zeros((2, 2, 3), np.uint8)}, r"the picture has no use in method A"),
    ({"texel_m": 0.3}, r"texel_m=0.3 is that of a picture, and the request has none; leave it out, or give one"),
    ({"time_s": 1.7e18}, r"time_s=1.7e\+18 is not a time; give seconds, at most 1e\+11 from 0"),
    ({"path": [(2.0, *HIGH), (1e300, *HIGH)], "pose": None}, r"path: time_s=1e\+300 is not a time"),
    ({"objects": [("plate", -1e12, {"yaw_deg": 1.0})]}, r"object 'plate': time_s=-1e\+12 is not a time"),
    ({"pose": (0, 0, 1e308, *DOWN)}, r"\[0, 0, 1e\+308\] m is more than 100 km"),
]


def test_impossible_requests_are_refused_in_one_sentence(client):
    session, again = client.open(seed=11), client.open(seed=11)
    for each in (session, again):
        each.frame(1.0, HIGH)
    for request, sentence in IMPOSSIBLE:
        with pytest.raises(LinkError, match=sentence) as error:
            session.frame(**{"time_s": 2.0, "pose": HIGH} | request)
        assert error.value.code == Code.REFUSED, request
    # The session is as before.
    kept, wanted = (each.frame(2.0, HIGH, objects={"plate": {"yaw_deg": 0.0}}) for each in (session, again))
    assert kept.counts.tobytes() == wanted.counts.tobytes()


def test_requests_added_one_by_one_give_the_frame_of_all_together(renderer):
    stage = Stage(renderer)
    asked = [Request(t, poses=np.array([[t, x, 0.0, 12.0, *DOWN]]), objects=[("plate", t, {"yaw_deg": 90.0 * x})])
             for t, x in ((0.0, 0.0), (0.01, 0.3), (0.02, 0.8), (0.03, 1.5))]  # fmt: skip
    whole, parts = (stage.open(Open(seed=5, rate_hz=9.0)) for _ in range(2))
    for each in (whole, parts):
        each.answer(asked[:1], 0.0)
    wanted = whole.answer(asked[1:], 0.0)
    for one in asked[1:3]:
        for wrong, sentence in (
            (replace(one, poses=one.poses * [[1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0]]), "unit quaternions are needed"),
            (replace(one, time_s=np.nan), "is not a time"),
            (replace(one, objects=[("car", 0.0, {"yaw_deg": 1.0})]), "object 'car' has no track"),
        ):
            with pytest.raises(ThermorenderError, match=sentence):
                parts.add(wrong)
        parts.add(one)
    found = parts.answer(asked[3:], 0.0, added=2)
    assert [bytes(each) for each in found[1:]] == [bytes(each) for each in wanted[1:]]
    # All but the times that it took.
    assert found[0][:32] == wanted[0][:32] and found[0][40:] == wanted[0][40:]


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (
            {"camera": "x"},
            r"camera 'x' is not served; give one of zenmuse-xt2, half, or start the server with this camera",
        ),
        ({"method": "B"}, r"map '' is not served; give one of fok-1to1"),
        ({"method": "C", "map": "/etc/passwd"}, r"map '/etc/passwd' is not served"),
        ({"map": "fok-1to1"}, r"map 'fok-1to1' has no use in method A"),
        ({"rate_hz": -1.0}, r"rate_hz=-1.0"),
        ({"rate_hz": 1e18}, r"rate_hz=1e\+18 is not allowed; give frames per second, 1e-06 to 1e\+06"),
        ({"rate_hz": 1e-300}, r"rate_hz=1e-300 is not allowed"),
        ({"mount_deg": (0.0, 1.0, 0.0)}, r"mount and lever arm belong to attitudes of a vehicle"),
    ],
)
def test_impossible_sessions_are_refused_in_one_sentence(client, settings, sentence):
    with pytest.raises(LinkError, match=sentence):
        client.open(**settings)
    client.open()


def test_client_checks_before_it_sends(client):
    session = client.open()
    for request, sentence in (
        ({"products": ("heat",)}, "product 'heat' is unknown; give some of counts, temperature"),
        ({"pose": (1, 2, 3)}, r"a pose has 3 numbers; give a position \(3\) and a quaternion"),
        ({"objects": {"plate": {"speed": 1.0}}}, "object 'plate' has no 'speed' to set"),
        ({"objects": {"p" * 65: {}}}, "name 'p*' has 65 bytes in UTF-8; the link takes up to 64: shorten it"),
        ({"objects": ["plate"]}, "the request cannot be sent"),
        ({"objects": {"plate": {"east_m": "x"}}}, "the request cannot be sent"),
        ({"pose": "abc"}, "the request cannot be sent"),
        ({"pose": None, "path": [(1, 2), (1,)]}, "the request cannot be sent"),
        ({"time_s": None}, "the request cannot be sent"),
        ({"products": None}, "the request cannot be sent"),
        ({"pose": np.diag([2.0, -2.0, -2.0, 1.0])}, "rotation that is not orthonormal"),
        ({"pose": np.diag([-1.0, -1.0, -1.0, 1.0])}, "rotation that is not orthonormal and right-handed"),
        ({"pose": np.diag([1.0, -1.0, -1.0, 7.0])}, "give .4, 4. with last row 0 0 0 1"),
        (
            {"picture": np.full((64, 80, 3), 0.5)},
            r"picture of type float64 and shape \(64, 80, 3\) is not sRGB of 8 bits",
        ),
        ({"picture": np.full((64, 80, 3), 300, np.int16)}, "give uint8 of shape"),
        ({"picture": np.zeros((64, 80, 4), np.uint8)}, r"shape \(64, 80, 4\)"),
        ({"picture": [[1, 2, 3]]}, r"shape \(1, 3\)"),
        ({"picture": np.zeros((4000, 8000, 3), np.uint8)}, "the picture of 8000 × 4000 pixels is not allowed"),
    ):
        with pytest.raises(ThermorenderError, match=sentence) as error:
            session.frame(**{"time_s": 0.0, "pose": HIGH} | request)
        assert not isinstance(error.value, LinkError)
    with pytest.raises(ThermorenderError, match="settings cannot be sent"):
        client.open(seed=-1)


@pytest.mark.parametrize("settings", [{"attitude": "body"}, {"attitude": "angles"}, {"position": "wgs84"}])
def test_poses_of_a_camera_belong_to_sessions_of_a_camera(client, settings):
    session = client.open(**settings)
    matrix = tr.pose(0.0, 0.0, 14.0, pitch_deg=-90.0)
    for pose in ({"pose": matrix}, {"path": tr.Trajectory([0.0], [[0.0, 0.0, 14.0]], [DOWN])}):
        with pytest.raises(
            ThermorenderError, match=r"holds a camera in east, north, up, .*; open one with enu and camera"
        ):
            session.frame(0.0, **pose)


def test_pictures_that_are_too_fine_for_a_map_are_refused(client):
    """The taps of a kernel would be thousands of pixels apart, as near the ground, and memory would end."""
    session = client.open(method="B", map="fok-1to1", attitude="angles", mount_deg=(0.0, -90.0, 0.0))
    picture = np.zeros((64, 80, 3), np.uint8)
    with pytest.raises(
        LinkError, match=r"1e-06 m a pixel is too fine for learned map 'fok-1to1'.*give at least"
    ) as error:
        session.frame(0.0, (0.0, 0.0, 14.0, 0.0, 0.0, 0.0), picture=picture, texel_m=1e-6)
    assert error.value.code == Code.REFUSED
    session.frame(0.0, (0.0, 0.0, 14.0, 0.0, 0.0, 0.0), picture=picture, texel_m=0.1)


def test_names_that_the_link_cannot_carry_are_refused_at_the_start(renderer):
    camera = replace(renderer.scene.camera, name="é" * 33)
    with pytest.raises(ThermorenderError, match=r"name 'é*' has 66 bytes in UTF-8; the link takes up to 64: shorten"):
        Stage(renderer, {camera.name: camera})


@pytest.mark.parametrize("position", ["enu", "wgs84"])
def test_paths_are_those_of_logs_up_to_rounding(renderer, tmp_path, position):
    """A difference of 10 nm changes counts of a few pixels."""
    scene, mount, lever = renderer.scene, (10.0, -80.0, 3.0), (0.3, 0.1, -0.2)
    draw = np.random.default_rng(4)
    places = draw.uniform((-5.0, -5.0, 12.0), (5.0, 5.0, 20.0), (40, 3))
    names = "east_m,north_m,up_m"
    if position == "wgs84":
        places, names = np.column_stack(scene.frame.geodetic_from_enu(places)), "lat_deg,lon_deg,alt_ellipsoid_m"
    rows = np.column_stack([np.arange(40.0), places, draw.uniform(-40.0, 40.0, (40, 3)), np.zeros(40)])
    lines = [",".join(map(repr, map(float, row[:7]))) for row in rows]
    (tmp_path / "log.csv").write_text("\n".join([f"time_s,{names},yaw_deg,pitch_deg,roll_deg", *lines]))
    wanted = tr.load_trajectory(tmp_path / "log.csv", scene, mount=mount, lever_arm_m=lever)
    session = ServerSession(Open("", "", "A", position, "angles", mount_deg=mount, lever_arm_m=lever), renderer)
    for pieces in ([rows], np.split(rows, 40), np.split(rows, [3, 20])):
        paths = []
        session.frames = SimpleNamespace(add=lambda time_s, path, objects, paths=paths: paths.append(path))
        for piece in pieces:
            session.add(Request(piece[-1, 0], poses=piece))
        for name, most in (("time_s", 0.0), ("position", 1e-13), ("quaternion", 1e-15)):
            found = np.concatenate([getattr(path, name) for path in paths])
            np.testing.assert_allclose(found, getattr(wanted, name), rtol=0.0, atol=most)


@pytest.mark.parametrize("how", ["closed", "disconnected"])
def test_the_memory_of_a_session_is_free_at_its_end(server, path, monkeypatch, how):
    """At once: Python's search for cycles runs much later."""
    open_session, made = server._stage.open, []

    def opened(settings):
        session = open_session(settings)
        made.extend(map(weakref.ref, (session, session.frames, session.renderer)))
        return session

    def free():
        end = time.monotonic() + 10.0
        while any(each() for each in made) and time.monotonic() < end:
            time.sleep(0.01)
        return not any(each() for each in made)

    monkeypatch.setattr(server._stage, "open", opened)
    gc.disable()
    try:
        with connected(server) as client:
            session = client.open(rate_hz=9.0)
            moved = {"plate": {"east_m": 0.5}}
            for reply in flight(session, path, (0.0, 0.1), products=("counts", "targets"), objects=moved):
                assert reply.counts.any()
            assert len(made) == 3 and all(each() for each in made)
            if how == "closed":
                session.close()
                assert free()
        assert free()
    finally:
        gc.enable()
