"""Vehicles of two public flight simulators steer by frames of the link: rendered, translated, and mapped."""

import numpy as np
import pytest
from closed_loop_support import FIRE, MAP, field
from link_support import connected, serving

from examples.closed_loop.seeker import MISSING, Seeker, closest
from validation.closed_loop import study

# RocketPy and its libraries may warn.
pytestmark = pytest.mark.filterwarnings("default")
FOCAL_PX = 95.6
ALSO_SLOW = [pytest.param(method, marks=pytest.mark.slow) for method in "BC"]


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    made = field(tmp_path_factory.mktemp("field") / "field")
    assert made.renderer.scene.camera.focal_length_px == pytest.approx(FOCAL_PX, abs=0.1)
    return made


def session_of(client, method, **options):
    return client.open(method=method, map="" if method == "A" else MAP, rate_hz=15.0, **options)


@pytest.mark.parametrize("method", ["A", *ALSO_SLOW])
def test_rocket_hits_what_its_seeker_sees(stage, method):
    pytest.importorskip("rocketpy")
    from examples.closed_loop import rocket

    start = np.array([-25.0, -220.0, 270.0])
    with serving(stage) as server, connected(server) as client:
        flown = rocket.fly(session_of(client, method), FOCAL_PX, FIRE, start, 3.0)
        assert server.answered >= 40
    unguided = rocket.fly(None, FOCAL_PX, FIRE, start, 3.0)
    assert unguided["miss_m"] > 20.0
    assert flown["miss_m"] < 3.0
    assert flown["seen"] > 0.5


@pytest.mark.parametrize("method", [pytest.param("A", marks=pytest.mark.slow), "B", ALSO_SLOW[1]])
def test_aircraft_flies_to_what_its_seeker_sees(stage, method):
    pytest.importorskip("jsbsim")
    from examples.closed_loop import aircraft

    frame, start = stage.renderer.scene.frame, np.array([-45.0, -380.0, 150.0])
    with serving(stage) as server, connected(server) as client:
        session = session_of(client, method, position="wgs84", attitude="body")
        flown = aircraft.fly(session, frame, FOCAL_PX, FIRE, start, 0.0)
        assert server.answered >= 80
    unguided = aircraft.fly(None, frame, FOCAL_PX, FIRE, start, 0.0)
    assert unguided["miss_m"] > 40.0
    assert flown["miss_m"] < 4.0
    assert flown["seen"] > 0.5


def test_seeker_finds_a_spot_and_no_edge():
    rows, columns = np.indices((64, 80))
    image = 2500.0 + np.random.default_rng(3).normal(scale=5.0, size=rows.shape)
    image[:20] -= 1500.0
    north = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0])
    seeker = Seeker(100.0)
    seeker.look(0.0, image, north, np.zeros(3))
    assert seeker.at is None and not seeker.acceleration(np.array([0.0, 50.0, 0.0])).any()
    land = image.copy()
    image += 800.0 * np.exp(-((columns - 51.5) ** 2 + (rows - 40.0) ** 2) / 2.0)
    seeker.look(0.1, image, north, np.zeros(3))
    assert seeker.at == pytest.approx([51.5, 40.0], abs=0.2)
    # The camera looks north: east of the middle, and below it.
    ray = np.array([12.0, 100.0, -8.5]) / np.linalg.norm([12.0, 100.0, -8.5])
    assert seeker.sight == pytest.approx(ray, abs=2e-3)
    # One frame with a spot does not steer; three in a row do, until it is missing for long.
    assert not seeker.acceleration(np.array([0.0, 50.0, 0.0])).any()
    for step in (2, 3):
        seeker.look(0.1 * step, image, north, np.zeros(3))
    assert seeker.acceleration(np.array([0.0, 50.0, 0.0])).any()
    for step in range(4, 4 + MISSING):
        assert seeker.locked
        seeker.look(0.1 * step, land, north, np.zeros(3))
    assert not seeker.locked and seeker.at is None


def test_navigation_turns_towards_a_sight_that_moves_and_carries_the_weight():
    seeker = Seeker(100.0, locked=True, sight=np.array([0.0, 1.0, 0.0]), rate=np.array([0.1, 0.0, 0.0]))
    assert seeker.acceleration(np.array([0.0, 50.0, 0.0])) == pytest.approx([15.0, 0.0, 9.80665])


def test_closest_is_between_samples():
    path = np.array([[0.0, -10.0, 0.0], [0.0, 10.0, 0.0], [0.0, 30.0, 0.0]])
    assert closest(path, np.array([3.0, 4.0, 0.0])) == pytest.approx(3.0)


def test_study_tabulates_and_draws_its_flights(tmp_path):
    path = [[0.0, -200.0, 250.0], [1.0, -1.0, 0.0]]
    flights = [
        {"vehicle": vehicle, "method": method, "flight": 0, "miss_m": miss, "seen": 0.5, "path": path}
        for vehicle in study.VEHICLES
        for method, miss in (("", 30.0), ("A", 1.25), ("B", 2.0), ("C", 3.0))
    ]
    result = {"flights": flights}
    assert study.rows(result)[1] == ("rocket", "A", 1, "1.2", "1.2", "50%")
    study.figure(tmp_path / "f.png", result)
    assert (tmp_path / "f.png").stat().st_size > 10_000
    (start, heading), again = (study.start_of("rocket", 3, FIRE) for _ in range(2))
    assert again[1] == heading and 15.0 < np.hypot(*(start - FIRE)[:2]) < 240.0
    forward = np.array([np.sin(np.deg2rad(heading)), np.cos(np.deg2rad(heading))])
    assert (FIRE - start)[:2] @ forward == pytest.approx(225.0)
