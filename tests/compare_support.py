"""Small lands, maps, frames and data sets for comparisons."""

import functools

import cv2
import numpy as np

import thermorender as tr
from scenes import coarse
from thermorender.apps.compare.view import Flight, View
from thermorender.apps.training.dataset import Entry, ThermalScale, read_dataset
from thermorender.apps.training.dataset_writer import Writer, packed
from thermorender.defaults import BAND_UM
from thermorender.learned.correlation import Correlation
from thermorender.learned.temperature_map import Inputs, TemperatureMap, save_map
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.radiometric_files import write_tlinear

DOWN = [0.0, 1.0, 0.0, 0.0]
BAND = (7.5, 13.5)
# Of a data set: size, materials, and the deviation of temperatures from their middles [K].
SHAPE = (48, 64)
MATERIALS = ["grass_green", "asphalt", "own_material"]
HIDDEN_K = 0.8


def flight(folder, height=8.0, poses=3, step=0.6, factor=4):
    """A Flight over a scene's folder, looking straight down, of a camera of `factor` times fewer pixels a side."""
    place = [[step * k, 0.4 * step * k, height] for k in range(poses)]
    path = tr.Trajectory(np.arange(float(poses)), np.array(place), np.array([DOWN] * poses))
    return Flight.of(coarse(tr.load_scene(folder), factor), path, 1.0)


def uniform_map(path, level, name=None, range_k=(280.0, 300.0), **about):
    """A map with the same temperature everywhere: intensity `level` of its range."""
    model = TemperatureMap(
        name or path.stem, "correlation-1to1", Correlation(np.zeros((1, 1, 3)), level), range_k, BAND, 0.5, (0.01, 5.0),
        "zenmuse-xt2", 255.0, "a test", about=about,
    )  # fmt: skip
    save_map(model, path)
    return str(path)


def black(folder):
    """Make all of a scene's folder black."""
    text = (folder / "scene.toml").read_text()
    start, end = text.index("[emissivity]"), text.index("[sky]")
    (folder / "scene.toml").write_text(text[:start] + '[emissivity]\nsource = "constant"\nvalue = 1.0\n' + text[end:])
    return folder


def frames_of(folder, poses, out, change=lambda kelvin, index: kelvin, factor=4):
    """Foreign frames of a scene: its own render, changed."""
    out.mkdir()
    one = flight(folder, poses=poses, factor=factor)
    renderer = tr.Renderer(one.scene, rays=8)
    for index, (time_s, pose) in enumerate(zip(one.times, one.poses, strict=True)):
        kelvin = renderer.frame(pose, time_s, index).apparent_temperature
        write_tlinear(out / f"pose_{index:04d}.tif", change(kelvin, index))
    return out


def structured(seed=3, side=64, spread=4.0):
    """A temperature field with structure of all sizes, (side, side) [K]."""
    rng = np.random.default_rng(seed)
    coarse = np.kron(rng.normal(size=(side // 8, side // 8)), np.ones((8, 8)))
    return 292.0 + spread * (coarse + 0.5 * rng.normal(size=(side, side)))


def errors(summary, label, stage="radiometric", part="ground"):
    return summary["methods"][label]["errors"][stage][part]


def translated(name, more=""):
    """The label of a map on the photograph."""
    return f"{name} on the photograph{more}"


def rendered(name, more=""):
    """The label of a map as kelvin, with true materials."""
    return f"{name} as kelvin, true materials{more}"


def kinds(summary, label):
    return {each["kind"] for each in summary["findings"] if each["method"] == label}


def view(known, **fields):
    """A View of known pixels (H, W): nothing but ground of no material, unless said otherwise."""
    shape = known.shape
    plain = {"index": 0, "band_um": BAND, "visible": np.zeros((*shape, 3), np.uint8), "texel_m": None, "known": known,
             "truth": None, "object": np.full(shape, -1), "material": np.full(shape, 255, np.uint8),
             "material_names": ()}  # fmt: skip
    return View(**{**plain, **fields})


def summary_of(methods=(), references=(True,), assumed=False, computed=False):
    """A comparison's summary with its methods, (label, kind, bounds) each, and scenes with or without reference."""
    return {
        "methods": {label: {"kind": kind, "bounds": bounds, "true_objects": label.endswith("true objects")}
                    for label, kind, bounds in methods},
        "scenes": [{"reference": known, "poses": 1, "assumed_materials": assumed, "computed": computed}
                   for known in references],
        "findings": [], "notes": [],
    }  # fmt: skip


def linear_map(name="linear", intercept=0.0):
    kernel = np.array([[[0.3, 0.4, -0.2]]])
    return TemperatureMap(
        name, "correlation-1to1", Correlation(kernel, intercept), (285.0, 305.0), BAND_UM, 0.1, (0.05, 0.2),
        "zenmuse-xt2", 255.0, "a test", about={"training_s": 3.0},
    )  # fmt: skip


@functools.cache
def known_pair(number):
    """(visible, temperature [K], error of `linear_map` [K], material) of a pair."""
    rng = np.random.default_rng(number)
    visible = cv2.GaussianBlur(rng.integers(0, 256, (*SHAPE, 3)).astype(np.uint8), (0, 0), 2.0)
    error = rng.normal(0.3 * number, 1.0 + 0.1 * number, SHAPE)
    material = rng.integers(0, 3, SHAPE).astype(np.uint8)
    material[:2] = 255
    given = brightness_temperature(linear_map().radiance(Inputs(visible)), *BAND_UM)
    return visible, given - error, error, material


def make_dataset(folder, pairs=10, test=6, truth=True, terrain=("sun",)):
    """A data set of rendered views whose last pairs are the test part."""
    scale = ThermalScale("radiance", 0.002, 0.0)
    card = {"title": "a toy", **({"materials": MATERIALS, "terrain": list(terrain)} if truth else {})}
    writer, members = Writer(folder, card, scale), []
    for number in range(pairs):
        visible, temperature, _, material = known_pair(number)
        radiance = band_radiance(temperature, *BAND_UM)
        rng = np.random.default_rng(100 + number)
        middle = temperature - rng.normal(0.0, HIDDEN_K, SHAPE)
        planes = {
            "radiance": radiance, "material": material, "sun": np.full(SHAPE, 0.5, np.float32),
            "balance": band_radiance(temperature + 1.5, *BAND_UM),
            "redrawn": band_radiance(middle + rng.normal(0.0, HIDDEN_K, SHAPE), *BAND_UM),
        }  # fmt: skip
        valid = np.ones(SHAPE, bool)
        valid[:, :3] = False
        entry = Entry(
            f"p{number}", "test" if number >= pairs - test else "train", f"p{number}", f"world{number}", 0, SHAPE, 0.1,
            conditions={"air_k": 290.0, "solar_hour": 6.0 + number},
            labels={"kind": "heath" if number % 2 else "village", "view": "nadir"},
        )  # fmt: skip
        thermal = np.rint(radiance / scale.step).astype(np.uint16)
        members.append((entry, packed(visible, thermal, valid, planes if truth else None)))
    writer.shard("all", members)
    return read_dataset(folder)
