"""Miss distances of a rocket in RocketPy and an aircraft in JSBSim whose seekers see a fire on the shipped heath.

Frames: A rendered, B the visible view translated, C the translated orthophoto rendered. The fire is orange, so that the
map finds it warm, too. Each flight starts elsewhere; the same starts serve all methods. All frames go through the link.
"""

import shutil
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np

import thermorender as tr
from thermorender import link
from thermorender.apps.compare.figures import pyplot, save
from thermorender.apps.compare.machine import machine
from thermorender.apps.link.access import new_token
from thermorender.apps.link.server import Server
from thermorender.apps.link.stage import Stage
from thermorender.errors import ThermorenderError
from thermorender.versions import versions
from validation.drapes import drape

MAP, METHODS, RATE_HZ, SAMPLING = "fok-1to1", ("A", "B", "C"), 15.0, {"rays": 4, "samples": 1}
VEHICLES = ("rocket", "aircraft")
HEADER = ("vehicle", "frames", "flights", "median miss [m]", "largest [m]", "frames with the spot")
# Side and height of the fire [m], its place, east and north [m], and its temperature [K].
SIDE_M, HIGH_M, PLACE, KELVIN = 4.0, 3.0, (30.0, 60.0), 390.0
_OBJECT = """
[[object]]
name = "fire"
shape = "box"
size = [{side}, {side}, {high}]
position = [{east}, {north}, {up}]
upright = true
temperature = {kelvin}
material = "paint_black"
colour = [255, 120, 30]
"""


def run(runs, progress=None, device="auto"):
    """Return the result as plain values.

    Parameters
    ----------
    runs : int
        Flights of each vehicle and method.
    progress : callable, optional
        Called with (what, share done).
    device : str
    """
    aircraft, rocket = _simulators()
    report, flights = progress or (lambda what, share: None), []
    with _served(device) as (client, scene, focal_px):
        target = _middle(scene)
        for number in range(runs):
            for vehicle in VEHICLES:
                start, heading = start_of(vehicle, number, target)
                for method in ("", *METHODS):
                    report(f"{vehicle}, flight {number}, {method or 'unguided'}", number / runs)
                    session = None
                    if method:
                        how = {"position": "wgs84", "attitude": "body"} if vehicle == "aircraft" else {}
                        session = client.open(method=method, map="" if method == "A" else MAP, rate_hz=RATE_HZ,
                                              seed=number, **how)  # fmt: skip
                    if vehicle == "rocket":
                        flown = rocket.fly(session, focal_px, target, start, heading, target[2] - HIGH_M / 2.0)
                    else:
                        flown = aircraft.fly(session, scene.frame, focal_px, target, start, heading)
                    if session is not None:
                        session.close()
                    way = (flown["path"][:: 1 + len(flown["path"]) // 60] - target).round(1)
                    flights.append({"vehicle": vehicle, "method": method, "flight": number, "miss_m": flown["miss_m"],
                                    "seen": flown["seen"], "path": way.tolist()})  # fmt: skip
    return {"machine": machine(), "versions": versions(), "map": MAP, "rate_hz": RATE_HZ, "flights": flights}


def start_of(vehicle, number, target):
    """Return the place (3,) [m] and the heading [deg] of a start: towards the target, with an error of the aim."""
    rng = np.random.default_rng([1873, VEHICLES.index(vehicle), number])
    heading, aside = rng.uniform(-30.0, 30.0), rng.uniform(15.0, 30.0) * rng.choice((-1.0, 1.0))
    back, high = (225.0, 270.0) if vehicle == "rocket" else (350.0, 150.0)
    forward = np.array([np.sin(np.deg2rad(heading)), np.cos(np.deg2rad(heading)), 0.0])
    right = np.array([forward[1], -forward[0], 0.0])
    return target - back * forward + aside * right + (0.0, 0.0, high), heading


def rows(result):
    """Return the rows of the table."""
    found = []
    for vehicle in VEHICLES:
        for method in ("", *METHODS):
            own = [each for each in result["flights"] if (each["vehicle"], each["method"]) == (vehicle, method)]
            misses = [each["miss_m"] for each in own]
            seen = f"{np.mean([each['seen'] for each in own]):.0%}" if method else "–"
            found.append((vehicle, method or "unguided", len(own), f"{np.median(misses):.1f}", f"{max(misses):.1f}",
                          seen))  # fmt: skip
    return found


def figure(path, result):
    """Draw the paths over the ground and the miss distances."""
    drawing, panels = pyplot().subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    kinds = ("", *METHODS)
    for vehicle, panel in zip(VEHICLES, panels[:2], strict=True):
        for each in (each for each in result["flights"] if each["vehicle"] == vehicle):
            way, number = np.array(each["path"]), kinds.index(each["method"])
            panel.plot(way[:, 0], way[:, 1], color=f"C{number}", lw=0.9,
                       label=(each["method"] or "unguided") if each["flight"] == 0 else None)  # fmt: skip
        panel.plot(0.0, 0.0, "k+", ms=10)
        panel.set(xlabel="east of the fire [m]", ylabel="north of the fire [m]", title=vehicle, aspect="equal",
                  xlim=(-220.0, 220.0), ylim=(-380.0, 80.0))  # fmt: skip
    panels[0].legend()
    for each in result["flights"]:
        number = kinds.index(each["method"])
        at = number + (0.1 if each["vehicle"] == "aircraft" else -0.1)
        panels[2].plot(at, max(each["miss_m"], 0.1), "o" if each["vehicle"] == "rocket" else "x", color=f"C{number}")
    panels[2].set(yscale="log", ylabel="miss distance [m]", title="o rocket, × aircraft")
    panels[2].set_xticks(range(len(kinds)), [kind or "unguided" for kind in kinds])
    save(drawing, path)


def _simulators():
    try:
        from examples.closed_loop import aircraft, rocket
    except ImportError as error:
        raise ThermorenderError(
            f"closed loops need {error.name}, which is not installed; run `pip install 'thermorender[sim]'`"
        ) from None
    return aircraft, rocket


@contextmanager
def _served(device):
    """A client, the scene with the fire, and the focal length of its camera [px]."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "heath"
        shutil.copytree(drape("heath"), place)
        text = (place / "scene.toml").read_text(encoding="utf-8")
        fire = _OBJECT.format(side=SIDE_M, high=HIGH_M, east=PLACE[0], north=PLACE[1], up=HIGH_M / 2.0, kelvin=KELVIN)
        (place / "scene.toml").write_text(text + fire, encoding="utf-8")
        scene = tr.load_scene(place)
        scene = scene.with_camera(scene.camera.coarser(8))
        renderer = tr.Renderer(scene, device=device, **SAMPLING)
        server = Server(Stage(renderer, maps=(MAP,)), port=0)
        server.token = new_token(Path(folder) / "token")
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            with link.connect(port=server.port, token=server.token) as client:
                yield client, scene, scene.camera.focal_length_px
        finally:
            server.stop()
            thread.join()


def _middle(scene):
    """The middle of the fire [m]."""
    (surface,) = (each for each in scene.surfaces if each.name.split(":")[0] == "fire")
    return 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
