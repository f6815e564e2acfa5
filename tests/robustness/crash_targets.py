"""Jobs that run in a process which may be killed, starved or disturbed: the cases of faults use them.

`main` runs the job in the folder given on the command line. It prints "begun" when it is set up, continues where an
earlier one stopped, and ends with status 2 and a sentence if it is refused.
"""

import ctypes
import json
import os
import resource
import signal
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from tests.robustness.fuzz.corpus.images import write_colour, write_elevation
from thermorender import files, formats
from thermorender.errors import ThermorenderError

FRAMES = 12
_PRODUCTS = ("exr", "truth", "counts", "radiometric", "display", "video")
_SCENE = """[terrain]
elevation = "elevation.tif"
orthophoto = "orthophoto.tif"
[temperature]
source = "{source}"
{value}
[emissivity]
source = "material"
material = "grass_green"
[sky]
temperature = 260.0
[camera]
model = "zenmuse-xt2"
[weather]
time = 2018-07-28T12:00:00Z
air_low_c = 12.0
air_high_c = 24.0
humidity = 0.7
wind_m_s = 2.5
cloud = 0.1
"""
_THING = """[[object]]
name = "{}"
shape = "box"
size = [2.0, 3.0, 1.5]
position = [{}, 0.75]
temperature = 320.0
material = "asphalt"
{}
"""
_NOBODY = 65534
# Period of a long flight, there and back [s].
ROUND_S = 50.0 / 9.0


# --- scenes and paths -------------------------------------------------------------------------------------------


def write_scene(folder, balance=False):
    """Write a small scene, its temperature constant or that of a heat balance, and return its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    source = {"source": "balance", "value": ""} if balance else {"source": "constant", "value": "value = 290.0"}
    (folder / "scene.toml").write_text(_SCENE.format(**source), encoding="utf-8")
    write_elevation(folder / "elevation.tif")
    write_colour(folder / "orthophoto.tif")
    return folder


def small(scene, width=48, height=36):
    """Return a Scene with a camera of few pixels."""
    return scene.with_camera(replace(scene.camera, width=width, height=height))


def renderer(folder, **settings):
    """Return a quick Renderer of a scene's folder."""
    from thermorender.render.renderer import Renderer
    from thermorender.scene.load import load_scene

    return Renderer(small(load_scene(folder)), **{"rays": 8, "samples": 1, "seed": 3} | settings)


def straight(seconds):
    """Return the Trajectory of a level flight straight over the scene."""
    from thermorender.trajectory.path import Trajectory

    places = np.array([[-3.0, 0.0, 20.0], [3.0, 0.0, 20.0]])
    return Trajectory(np.array([0.0, seconds]), places, np.array([[0.0, 1.0, 0.0, 0.0]] * 2))


def to_and_fro(seconds):
    """Return the Trajectory of a level flight over the scene and back, in `ROUND_S`, for some seconds."""
    from thermorender.trajectory.path import Trajectory

    times = _turns(seconds)
    places = np.array([[-3.0 + 6.0 * (turn % 2), 0.0, 20.0] for turn in range(len(times))])
    return Trajectory(times, places, np.array([[0.0, 1.0, 0.0, 0.0]] * len(times)))


def _turns(seconds):
    return np.arange(0.0, seconds + ROUND_S, ROUND_S / 2.0)


# --- jobs that are killed and begun again -----------------------------------------------------------------------


def flight(folder, rate_hz=9.0, products=_PRODUCTS, **more):
    """Fly `FRAMES` frames of all products into FOLDER/out, or continue them."""
    from thermorender.output.flight import FlightOptions, fly

    drawn = renderer(folder.parent / "scene")
    _begun()
    length = (FRAMES - 1) / rate_hz
    options = FlightOptions(rate_hz=rate_hz, products=products)
    return fly(drawn, straight(length), folder / "out", options, **{"resume": True} | more)


def bake(folder):
    """Trace the light of a scene with the cache in FOLDER/cache, and write the resulting frame."""
    from thermorender.render.light import transport_cache as kept

    os.environ["THERMORENDER_CACHE"] = str(folder / "cache")
    kept.WORTH_RAYS = 0
    drawn = renderer(folder.parent / "scene", rays=4096)
    _begun()
    drawn.frame(straight(1.0).pose(0.5)).radiance.tofile(folder / "radiance")


def heat(folder):
    """A flight of minutes with simulated temperatures, and light from a cache in FOLDER/cache."""
    from thermorender.render.light import transport_cache as kept

    os.environ["THERMORENDER_CACHE"] = str(folder / "cache")
    kept.WORTH_RAYS = 0
    return flight(folder, rate_hz=1.0 / 30.0, products=("counts",))


def day(folder):
    """A day of a scene in steps of six hours: all at once, or nothing."""
    from thermorender.output.day import day
    from thermorender.scene.load import load_scene

    scene = small(load_scene(folder.parent / "scene"))
    _begun()
    if not (folder / "out").exists():
        day(scene, straight(1.0).pose(0.5), folder / "out", step_min=360, products=("exr", "counts"), rays=8, samples=1)


def training(folder):
    """Train a narrow network in FOLDER/run, and write its weights and the losses of its epochs."""
    from tests.robustness.maps import pictures, task
    from thermorender.apps.training.networks.loop import train_network
    from thermorender.apps.training.networks.runs import read_log

    _begun()
    job = task("compact", pictures(), run=folder / "run", resume=True)
    found = train_network(replace(job, options=job.options | {"crops": 24}), "compact")
    with files.atomic(folder / "weights.npz") as part:
        np.savez(part, **found.state)
    epochs = [(line["crops"], line["losses"], line["validation_mae_k"]) for line in read_log(folder / "run")]
    formats.write_json(folder / "epochs.json", epochs)


# --- jobs in a hostile place ------------------------------------------------------------------------------------


def starved(folder, *limits):
    """Fly under file size limits, one after the other, then without; print the messages that were not sentences."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    wrong = []
    for limit in (*map(int, limits), resource.RLIM_INFINITY):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        wrong += _unlike_a_sentence(lambda: flight(folder), limit == resource.RLIM_INFINITY)
    _print(wrong)


def writers(folder):
    """Write a file of each kind with room for none of it, for a part, and for all but its last byte."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    wrong = []
    for name, write in WRITERS.items():
        path = folder / name
        write(path)
        size = path.stat().st_size
        path.unlink()
        for limit in (0, size // 2, size - 1):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            found = _unlike_a_sentence(lambda write=write, path=path: write(path), False)
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            wrong += [f"{name}, {limit} of {size} bytes: {each}" for each in found]
            path.unlink(missing_ok=True)
    wrong += [path.name for path in folder.iterdir() if path.name.startswith(".")]
    _print(wrong)


def write_picture(path):
    """Write a PNG so small that all of it is in a buffer when it is closed."""
    formats.write_image(path, np.full((32, 40), 7, np.uint16))


def images(folder):
    """Write four images and return their paths."""
    generator, paths = np.random.default_rng(0), []
    for number in range(4):
        paths.append(folder / f"{number}.png")
        if not paths[-1].exists():
            formats.write_image(paths[-1], generator.integers(0, 255, (32, 40)).astype(np.uint8))
    return paths


@cache
def nets():
    """Return a narrow network by name."""
    from tests.robustness.maps import trained

    return {"net": trained("compact").predictor.net}


def write_checkpoint(path):
    """Write the state of that network."""
    from thermorender.apps.training.networks import checkpoint

    checkpoint.save(path, nets(), {"crops": 1})


@cache
def _frame():
    with tempfile.TemporaryDirectory() as folder:
        return renderer(write_scene(Path(folder))).frame(straight(1.0).pose(0.5))


def _write_video(path):
    from thermorender.output.video import write_video

    place = path.parent.with_name("images")
    place.mkdir(exist_ok=True)
    write_video(path, images(place), 8.0)


def _write_radiometric(path):
    from thermorender.sensor.radiometric_files import write_tlinear

    with formats.atomic_raster(path) as part:
        write_tlinear(part, np.full((32, 40), 300.0))


def _write_map(path):
    from tests.robustness.maps import trained
    from thermorender.learned.temperature_map import save_map

    save_map(trained("compact"), path)


def _write_exr(path):
    from thermorender.frame.exr import write_exr

    write_exr(path, _frame(), False)


# {name of a file: writes it}
WRITERS = {
    "a.png": write_picture, "a.tif": write_picture, "radiometric.tif": _write_radiometric, "a.exr": _write_exr,
    "a.mp4": _write_video, "a.safetensors": write_checkpoint, "map.npz": _write_map,
    "a.json": lambda path: formats.write_json(path, list(range(999))),
}  # fmt: skip


def shut_out(folder):
    """As user nobody if this is root: fly into folders without write permission, from one without read permission."""
    os.environ["THERMORENDER_CACHE"] = str(folder / "cache")
    from thermorender.render.light import transport_cache as kept

    kept.WORTH_RAYS = 0
    from thermorender.output.flight import FlightOptions, fly

    # Late imports must not need files that not everybody may read.
    flight(folder)
    fly(renderer(folder.parent / "scene"), straight(1.0), folder / "early", FlightOptions(rate_hz=1.0))
    (folder / "out").rename(folder / "before")
    for name in ("mine", "shut"):
        (folder / name / "out").mkdir(parents=True)
    os.chmod(folder / "mine", 0o777)
    os.chmod(folder / "mine" / "out", 0o777)
    (folder / "mine" / "scene").symlink_to(folder.parent / "scene")
    for name in ("shut", "shut/out", "before", "cache", "cache/light"):
        os.chmod(folder / name, 0o555)
    secret = write_scene(folder / "secret") / "elevation.tif"
    os.chmod(secret, 0)
    if os.geteuid() == 0:
        os.setgid(_NOBODY)
        os.setuid(_NOBODY)
    drawn = renderer(folder.parent / "scene", seed=4)
    wrong = _unlike_a_sentence(lambda: renderer(folder / "secret"), False)
    for place in ("shut/out", "shut/new", "before"):
        wrong += _unlike_a_sentence(lambda place=place: fly(drawn, straight(1.0), folder / place, resume=True), False)
    # Without a cache everything works, and the reason is reported.
    options = FlightOptions(rate_hz=1.0)
    wrong += _unlike_a_sentence(lambda: fly(drawn, straight(1.0), folder / "mine" / "out", options), True)
    other = renderer(folder.parent / "scene", rays=16)
    if "cannot be written" not in str(other.baked.cache_note):
        wrong.append(f"note of a cache that cannot be written: {other.baked.cache_note}")
    _print(wrong)


def backwards(folder):
    """Fly while the clock goes back by an hour at every reading, and all files are from the future."""
    now = [4e9]

    def clock():
        now[0] -= 3600.0
        return now[0]

    time.time = clock
    for path in (folder.parent / "scene").iterdir():
        os.utime(path, (4.2e9, 4.2e9))

    def stop(done, total):
        if done in (4, 9):
            raise InterruptedError

    for _ in range(3):
        for path in (folder / "out").glob("*") if (folder / "out").exists() else ():
            os.utime(path, (4.2e9, 4.2e9))
        with suppress(InterruptedError):
            flight(folder, progress=stop)


# --- jobs with watched memory -----------------------------------------------------------------------------------


def frames(folder, count, kind="still"):
    """Fly `count` small frames; print (frames, memory [MB], time of all cores [s]) after each part of 25.

    They show still ground; "busy" adds still objects and a moving one, air and photographs. Each round shows all of
    it, so kernels for objects that come into view are compiled early.
    """
    printed = []

    def look(done, total):
        if done % 25 == 0:
            printed.append((done, memory_mb(), time.process_time()))

    from thermorender.output.flight import FlightOptions, fly

    drawn, products = renderer(folder.parent / "scene"), ("exr", "truth", "counts", "display")
    if kind == "busy":
        drawn = busy(folder.parent / "scene", int(count) / 9.0)
        products = (*products, "error", "visible", "radiometric")
    options = FlightOptions(rate_hz=9.0, products=products)
    fly(drawn, to_and_fro(int(count) / 9.0), folder / "out", options, progress=look)
    _print(printed)


def busy(folder, seconds):
    """Return a Renderer of a scene's folder with still objects and one that moves for some seconds, through air."""
    from thermorender.render.renderer import Renderer
    from thermorender.scene.load import load_scene

    # Against the camera's direction of flight.
    rows = [f"{time},{('3,0,300', '-3,0,330')[turn % 2]}\n" for turn, time in enumerate(_turns(seconds))]
    (folder / "track.csv").write_text("time_s,east_m,north_m,temperature_k\n" + "".join(rows))
    with open(folder / "scene.toml", "a", encoding="utf-8") as file:
        file.write(_THING.format("car", "0.0, 0.0", 'track = "track.csv"') + _THING.format("hut", "3.0, 3.0", ""))
    scene = small(load_scene(folder)).with_air("midlatitude-summer", "rural-23km")
    camera = replace(scene.camera, visible_width=64)
    return Renderer(scene.with_camera(camera), rays=8, samples=1, seed=3)


def scenes(folder, count):
    """Load, bake, fly and drop `count` scenes; print the memory after each [MB]."""
    printed = []
    for _ in range(int(count)):
        renderer(folder.parent / "scene").frame(straight(1.0).pose(0.5))
        printed.append(memory_mb())
    _print(printed)


def references(folder, count):
    """Path trace `count` frames of one scene; print the memory after each [MB]."""
    from thermorender.render import reference
    from thermorender.scene.load import load_scene

    # The lens is an array of 8 bytes a pixel and would show if it were kept: 16 MB where the rest varies by 0.01 MB.
    scene, printed = small(load_scene(folder.parent / "scene"), 1600, 1280), []
    for _ in range(int(count)):
        reference.render(scene, straight(1.0).pose(0.5), samples=1, depth=2)
        printed.append(memory_mb())
    _print(printed)


def memory_mb():
    """Return the memory that this process holds [MB], without shared files.

    Memory that was freed and is kept by the allocator, in pieces of 8 and 16 MB here, is given back first. Pages of
    files are left out: the system maps those of a library, 14 MB of LLVM's at a time, at arbitrary moments.
    """
    ctypes.CDLL(None).malloc_trim(0)
    resident, of_files = map(int, Path("/proc/self/statm").read_text(encoding="ascii").split()[1:3])
    return (resident - of_files) * os.sysconf("SC_PAGE_SIZE") / 1e6


# --- output -----------------------------------------------------------------------------------------------------


def sentence(text):
    """Return whether a text is one non-empty line."""
    return bool(text.strip()) and "\n" not in text


def _unlike_a_sentence(job, done):
    """[The outcome of a job], unless it finished or was refused in a sentence, as it should be."""
    try:
        job()
    except ThermorenderError as error:
        return [] if sentence(str(error)) and not done else [str(error)]
    except Exception as error:
        return [f"{type(error).__name__}: {error}"]
    return [] if done else ["not refused"]


def _begun():
    print("begun", flush=True)


def _print(value):
    print(json.dumps(value), flush=True)


JOBS = {
    each.__name__: each
    for each in (
        flight,
        bake,
        heat,
        day,
        training,
        starved,
        writers,
        shut_out,
        backwards,
        frames,
        scenes,
        references,
    )
}


def main():
    """Run JOB in FOLDER, with further arguments from the command line."""
    try:
        JOBS[sys.argv[1]](Path(sys.argv[2]), *sys.argv[3:])
    except ThermorenderError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
