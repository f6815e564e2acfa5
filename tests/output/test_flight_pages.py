"""What a flight reports before it is rendered, and the page that it leaves."""

import json
import re
import shutil
from dataclasses import replace
from html import escape
from types import SimpleNamespace

import numpy as np
import pytest
from support import slow

import thermorender as tr
from scenes import coarse, scene_object, write_terrain
from thermorender.apps.material_tables.plot import plot
from thermorender.errors import ThermorenderError
from thermorender.formats import label
from thermorender.frame import picture
from thermorender.materials.library import load_library
from thermorender.output.day_figure import figure as draw_day
from thermorender.output.flight import FlightOptions, fly
from thermorender.output.flight_pages.cost import Cost
from thermorender.output.flight_pages.flight_figures import Curve, curves, flight_map, sheet
from thermorender.output.flight_pages.flight_preview import preview
from thermorender.output.flight_pages.prospect import Prospect, prospect
from thermorender.output.products import check

DOWN = (0.0, 1.0, 0.0, 0.0)
MARKER = scene_object("marker", [2, 2, 0.1], shape="disc")


@pytest.fixture(scope="module")
def renderer(tmp_path_factory):
    folder = write_terrain(tmp_path_factory.mktemp("scene") / "flat", extra=MARKER, height=np.zeros((16, 16)))
    return tr.Renderer(coarse(tr.load_scene(folder)), rays=4, samples=1)


def flight(*places, seconds=1.0):
    time_s = np.linspace(0.0, seconds, len(places))
    return tr.Trajectory(time_s, np.array(places, float), np.array([DOWN] * len(places)))


@pytest.fixture(scope="module")
def path():
    return flight((-1.0, 0.0, 12.0), (1.0, 0.0, 12.0))


def test_footprint_height_resolution_and_motion_are_those_of_geometry(renderer, path):
    camera = renderer.scene.camera
    seen = prospect(renderer, path, path.frame_times(4.0), 4.0)
    assert seen.index.tolist() == [0, 1, 2, 3, 4] and seen.shows_terrain.all()
    # Level ground at 0 m, seen from 12 m straight above.
    np.testing.assert_allclose(seen.above_ground_m, 12.0, atol=1e-3)
    np.testing.assert_allclose(seen.pixel_m, 12.0 / camera.focal_length_px, rtol=1e-3)
    half = 12.0 * camera.width / 2 / camera.focal_length_px, 12.0 * camera.height / 2 / camera.focal_length_px
    corners = seen.outline[0][[0, 6, 12, 18]] - seen.position[0, :2]
    # Image axes: right is east and down is south.
    wanted = [(-half[0], half[1]), (half[0], half[1]), (half[0], -half[1]), (-half[0], -half[1])]
    inside = np.abs(np.array(wanted) + seen.position[0, :2]).max() < 0.49 * 16.0
    assert inside, "the terrain must hold the footprint, or the test says nothing"
    np.testing.assert_allclose(corners, wanted, rtol=5e-3)
    speed = 2.0 * camera.time_constant_s * camera.focal_length_px / 12.0
    np.testing.assert_allclose(seen.motion_px, speed, rtol=0.01)
    assert seen.length_m == pytest.approx(2.0)


def test_frames_past_the_terrain_are_counted_and_named(renderer):
    away = flight((0.0, 0.0, 12.0), (400.0, 0.0, 12.0))
    seen = prospect(renderer, away, away.frame_times(4.0), 4.0)
    assert seen.shows_terrain.tolist() == [True, False, False, False, False]
    assert seen.as_dict()["without_terrain"] == 4 and np.isnan(seen.outline[1:]).all()
    said = "\n".join(seen.lines())
    assert "4 of 5 frames show none, the first at 0.250 s; point the camera with mount, or move the flight" in said
    assert "off the terrain in 4 of 5 frames" in said


def test_footprint_of_a_view_beyond_the_terrain_ends_on_it(renderer):
    # The picture is 50 m by 41 m, the terrain 15 m.
    high = flight((0.0, 0.0, 60.0), (1.0, 0.0, 60.0))
    ring = prospect(renderer, high, high.frame_times(1.0), 1.0).outline[0]
    assert np.isfinite(ring).all() and 3.0 < np.abs(ring).max() <= 8.0
    # All rays but that in the middle pass by.
    seen = prospect(renderer, flight((9.0, 0.0, 200.0)), np.zeros(1), 1.0)
    assert seen.shows_terrain.all() and np.isnan(seen.outline).all()


def test_backs_of_faces_in_view_are_counted_and_named(renderer, path):
    assert prospect(renderer, path, path.frame_times(4.0), 4.0).backs == 0.0
    # Below the ground a camera that looks up sees its back, and beyond its edge nothing.
    up = tr.Trajectory(np.array([0.0, 1.0]), np.array([[-1.0, 0, -12], [1.0, 0, -12]]), np.array([[0.0, 0, 0, 1]] * 2))
    seen = prospect(renderer, up, up.frame_times(1.0), 1.0)
    assert seen.backs == 1.0 and "100% of what the camera sees is backs of faces" in seen.warning
    assert replace(seen, backs=0.5).warning is None and seen.as_dict()["backs"] == 1.0


def test_long_flights_are_looked_at_in_some_frames(renderer, monkeypatch):
    monkeypatch.setattr("thermorender.output.flight_pages.prospect.MOST_FRAMES", 10)
    slow = flight((-1.0, 0.0, 12.0), (1.0, 0.0, 12.0), seconds=9.0)
    seen = prospect(renderer, slow, slow.frame_times(9.0), 9.0)
    assert seen.frames == 82 and len(seen.index) == 10 and seen.index[[0, -1]].tolist() == [0, 81]
    assert "82 frames at 9 Hz, 9 s, path of 2 m; 10 of them are looked at here" in seen.lines()[0]


def test_orthophoto_coarser_than_a_pixel_is_said(renderer, path):
    seen = prospect(renderer, path, path.frame_times(4.0), 4.0)
    coarser = replace(seen, texel_m=3.0 * float(np.median(seen.pixel_m)))
    assert re.search(r"the orthophoto is coarser, with texels of \S+ m, 3 pixels wide", coarser.lines()[3])
    finer = replace(seen, texel_m=0.5 * float(np.median(seen.pixel_m)))
    assert "are not coarser" in finer.lines()[3]


def test_cost_warns_of_a_disk_that_is_too_small():
    cost = Cost(2214, 0.25, {"exr": 7.0e6, "counts": 0.7e6}, int(10e9), int(1.2e9))
    assert cost.lines() == [
        "time: 0.25 s for a frame, measured here, 9.22 min for 2214 frames",
        "memory: 1.2 GB in use at most so far",
        "disk: 7.7 MB a frame, measured (exr 7.00, counts 0.70), 17 GB for 2214 frames; 10 GB free",
    ]
    assert "2214 frames take 17 GB, and the output's file system has 10 GB free: give another folder" in cost.warning
    assert replace(cost, free=int(20e9)).warning is None


@pytest.mark.parametrize("name", ["a$\\frac{$", *slow("$", "$5", "_hidden"), "<b>&"])
def test_names_are_drawn_as_they_are(renderer, path, tmp_path, name):
    """Matplotlib takes text between dollars as a formula, of which half a one is an error."""
    seen = prospect(renderer, path, path.frame_times(4.0), 4.0)
    flight_map(renderer, seen, {name: (0.0, 0.0)})
    curves(seen.time_s, [Curve("range [m]", {name: seen.above_ground_m})])
    sheet([np.full((8, 8), 300.0, np.float32)] * 2, [np.ones((8, 8), bool)] * 2, ["0", "1"], name)
    picture.png(np.full((8, 8), 300.0), name)
    row = {"solar_hour": 1.0, "air_k": 290.0, "apparent_mean_k": 290.0, "time_utc": "2018-07-28T12:00:00Z"}
    row |= {f"{name}_{kind}_k": 290.0 for kind in ("min", "mean", "max")}
    draw_day(tmp_path / "day.png", name, [row, row | {"solar_hour": 2.0}], (np.arange(3.0), np.ones(3, bool)))
    plot([replace(load_library()["granite"], name=name)], tmp_path / "made.png")


@pytest.mark.parametrize("name", ["a$\\frac{$", "$", "_hidden"])
def test_a_label_shows_the_name(name):
    from matplotlib.cbook import is_math_text
    from matplotlib.figure import Figure

    assert not is_math_text(label(name)) and label(name).replace("\\$", "$").strip() == name
    axis = Figure().subplots()
    axis.plot([0, 1], label=label(name))
    assert len(axis.get_legend_handles_labels()[1]) == 1


def test_preview_writes_its_page_and_no_frames(renderer, path, tmp_path):
    import cv2

    reported = []
    written = preview(renderer, path, FlightOptions(rate_hz=4.0), tmp_path / "p", reported.append)
    assert sorted(file.name for file in (tmp_path / "p").iterdir()) == ["preview.html", "preview.png"]
    assert [file.name for file in written] == ["preview.png", "preview.html"]
    seen, cost = reported
    assert isinstance(seen, Prospect) and cost.frames == 5 and set(cost.sizes) == {"exr", "counts", "display"}
    assert len([*seen.lines(), *cost.lines()]) <= 10
    page = (tmp_path / "p/preview.html").read_text()
    assert all(escape(line) in page for line in (*seen.lines(), *cost.lines())) and "http" not in page
    assert cv2.imread(str(tmp_path / "p/preview.png")).std() > 1.0
    # The flight itself goes into the same folder.
    fly(renderer, path, tmp_path / "p", FlightOptions(rate_hz=4.0, products=("counts",)))
    assert preview(renderer, path, FlightOptions(rate_hz=4.0, products=("counts",)), None, reported.append) == []


@pytest.fixture(scope="module")
def flown(renderer, path, tmp_path_factory):
    """The folder of a flight with the default products, and what it reported beforehand."""
    reported, folder = [], tmp_path_factory.mktemp("flights") / "f"
    fly(renderer, path, folder, FlightOptions(rate_hz=4.0), outlook=reported.append)
    return folder, reported


def test_report_shows_the_flight_and_survives_a_resume(renderer, path, flown, tmp_path):
    import cv2

    folder, reported = flown
    assert [type(part) for part in reported] == [Prospect, Cost]
    about = json.loads((folder / "flight.json").read_text())
    assert about["prospect"] == reported[0].as_dict() and about["prospect"]["above_ground_m"][1] == pytest.approx(12.0)
    page, contact = (folder / "index.html").read_text(), cv2.imread(str(folder / "contact.png"))
    assert contact.std() > 1.0 and "http" not in page
    assert not [link for link in re.findall(r"href='([^']*)'", page) if not (folder / link).is_file()]
    (row,) = re.findall(r"<td>marker</td><td>5</td><td>5</td><td>12.0–12.0</td><td>(\d+)–(\d+)</td>", page)
    area = np.pi * (renderer.scene.camera.focal_length_px / 11.95) ** 2
    assert [int(cell) for cell in row] == pytest.approx([area, area], rel=0.02)
    line = json.loads((folder / "frames.jsonl").read_text().splitlines()[2])
    kelvin = renderer.frame(path.pose(0.5), time_s=0.5, index=2).apparent_temperature
    low, middle, high = line["apparent_k"]
    assert (low, high) == pytest.approx((kelvin.min(), kelvin.max()), abs=2e-3)
    assert middle == pytest.approx(np.median(kelvin), abs=2e-3)
    assert f"<td>{middle:.2f}</td>" in page

    folder = shutil.copytree(folder, tmp_path / "f")
    whole = {name: (folder / name).read_bytes() for name in ("index.html", "contact.png", "flight.json")}
    (folder / "index.html").unlink()
    (folder / "contact.png").write_bytes(b"half")
    lines = (folder / "frames.jsonl").read_text().splitlines(keepends=True)
    (folder / "frames.jsonl").write_text("".join(lines[:3]))
    assert fly(renderer, path, folder, FlightOptions(rate_hz=4.0), resume=True)["rendered"] == 2
    assert {name: (folder / name).read_bytes() for name in whole} == whole


def test_labels_of_curves_have_room_and_legends_cover_no_curve():
    time_s, rows = np.linspace(0.0, 9.0, 50), np.zeros(50)
    wide = curves(time_s, [Curve("pixel on the\nground [m]", {"pixel": np.linspace(0.0675, 0.0785, 50)})])
    assert (wide[:, :2] == 255).all() and (wide[:, -2:] == 255).all()
    # A curve along the top of its panel, where a legend inside would stand: its colour shows in every column.
    named = {"low": rows, "middle": rows + 0.5, "high": rows + 1.0}
    drawn = curves(time_s, [Curve("a [K]", named)]).astype(int)
    green = (np.abs(drawn - (0x00, 0x9E, 0x73)).max(axis=-1) < 40).any(axis=0)
    columns = np.flatnonzero(green)
    assert columns.size > 600 and (np.diff(columns) == 1).all()


def test_report_names_what_is_counted_of_a_target(flown):
    page = (flown[0] / "index.html").read_text()
    assert "frames with its middle visible" in page and "other parts may show" in page


def test_report_is_a_product_of_flights_alone_and_changes_no_frame(renderer, path, flown, tmp_path):
    products = ("exr", "truth", "counts", "display")
    fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=4.0, products=products))
    assert not {"index.html", "contact.png"} & {file.name for file in (tmp_path / "f").iterdir()}
    frames = list((tmp_path / "f").glob("frame*"))
    assert len(frames) == 5 * 3 + 1
    assert all((flown[0] / file.name).read_bytes() == file.read_bytes() for file in frames)
    with pytest.raises(ThermorenderError, match="product 'report' is a page of a flight; leave it out here"):
        check(("counts", "report"))
    assert check(("counts", "report"), flight=True) == ("counts", "report")


def test_command_previews_without_a_folder_and_flies_with_one(tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from thermorender.cli.app import app

    folder = write_terrain(tmp_path / "scene", height=np.zeros((16, 16)))
    (folder / "flight.csv").write_text(
        "time_s,east_m,north_m,above_ground_m,pitch_deg,yaw_deg\n0,0,0,9,-90,0\n1,1,0,9,-90,0\n"
    )
    scene = [str(folder), "--rays", "2", "--quality", "fast", "--rate-hz", "2"]
    run = CliRunner().invoke(app, ["fly", *scene, "--preview"])
    assert run.exit_code == 0 and "flight: 3 frames at 2 Hz" in run.output and "disk: " in run.output
    assert {file.name for file in tmp_path.iterdir()} == {"scene"}
    refused = CliRunner().invoke(app, ["fly", *scene])
    assert isinstance(refused.exception, ThermorenderError) and "-o is missing; give the folder" in str(
        refused.exception
    )
    refused = CliRunner().invoke(app, ["fly", *scene, "--preview", "--resume"])
    assert "--preview writes no frames; leave --resume and --verify out" in str(refused.exception)
    shutil.rmtree(tmp_path / "o", ignore_errors=True)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=10))
    run = CliRunner().invoke(app, ["fly", *scene, "--products", "counts", "-o", str(tmp_path / "o")])
    assert run.exit_code == 0 and "3 frames take" in run.output and "warning: " in run.output
    assert "look at" not in run.output
