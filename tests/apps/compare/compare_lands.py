"""Small lands, maps and frames for comparisons."""

import numpy as np

import thermorender as tr
from scenes import coarse
from thermorender.apps.compare.view import Flight, View
from thermorender.learned.correlation import Correlation
from thermorender.learned.temperature_map import TemperatureMap, save_map
from thermorender.sensor.radiometric_files import write_tlinear

DOWN = [0.0, 1.0, 0.0, 0.0]


BAND = (7.5, 13.5)


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
    """A comparison's summary with its methods, (label, letter, bounds) each, and scenes with or without reference."""
    return {
        "methods": {label: {"letter": letter, "bounds": bounds, "true_objects": label.endswith("true objects")}
                    for label, letter, bounds in methods},
        "scenes": [{"reference": known, "poses": 1, "assumed_materials": assumed, "computed": computed}
                   for known in references],
        "findings": [], "notes": [],
    }  # fmt: skip
