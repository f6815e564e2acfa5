"""Time and memory of translating a picture with each learned map, and the steps at the borders of its tiles.

Time and memory are for pictures of 640×512 pixels in a separate process for each map. A network that takes squares of a
fixed size predicts different temperatures on both sides of a border. The study compares the mean step between the pixel
lines at borders with the mean step elsewhere: for adjacent squares of 256 pixels, each translated alone; for the same
as pix2pix was published (statistics of each square, and dropout, the same for all); and for the picture as `translate`
makes it.
"""

import time
from dataclasses import replace

import numpy as np

from thermorender.apps.compare.machine import apart, forget_peak_memory, machine, peak_memory_mib
from thermorender.apps.training.dataset import read_dataset
from thermorender.apps.training.map_inputs import inputs_of
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.networks.recipes import RECIPES
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.versions import versions
from validation.drapes import KINDS, load_drape

HEADER = ("map", "load [s]", "640×512 [s]", "peak [MiB]", "picture", "squares [K]", "elsewhere [K]",
          "as published [K]", "elsewhere [K]", "as applied [K]", "elsewhere [K]")  # fmt: skip
SIDE = 256
SIZE = (512, 640)
# Number of timed translations, after an untimed one.
_TURNS = 5


def run(models, dataset, scene=KINDS[0], pictures=6, progress=None):
    """Return the cost of learned maps and the steps at the borders of their tiles, as plain numbers.

    Parameters
    ----------
    models : sequence of str
        Names or files.
    dataset : path
        Folder of a data set; pictures of its test part are translated, cropped to 640×512.
    scene : str or None
        Scene whose orthophoto is translated, too, by maps without extra inputs.
    pictures : int
        Number of pictures of the test part, evenly spaced.
    progress : callable, optional
        Called with (step, share done).

    Returns
    -------
    dict
        Its "maps" have load_s, translate_s, peak_mib (None where unknown), and seams: {"pictures" or the scene's name:
        {way: (mean step at borders, mean step elsewhere) [K]}}. The ways are "squares", "published" (pix2pix and
        pix2pix-b25) and "applied", which is missing if a picture needs a single tile.

    Raises
    ------
    ThermorenderError
        Unknown maps, pictures below 1, a data set without a test part or with too small pictures, or maps whose inputs
        it lacks.
    """
    if pictures < 1:
        raise ThermorenderError(f"pictures={pictures} is not allowed; give 1 or more")
    for model in models:
        load_model(model)
    found = {}
    for number, model in enumerate(models):
        if progress:
            progress(str(model), number / len(models))
        found[str(model)] = apart(_measure, str(model), dataset, scene, pictures)
    return {"maps": found, "size": list(SIZE), "side": SIDE, "machine": machine(), "versions": versions()}


def _measure(name, folder, scene, pictures):
    shown = pictures_of(folder, pictures)
    forget_peak_memory()
    began = time.perf_counter()
    model = load_model(name)
    loaded = time.perf_counter() - began
    seconds = []
    for turn in range(1 + _TURNS):
        began = time.perf_counter()
        model.radiance(shown[turn % len(shown)])
        seconds.append(time.perf_counter() - began)
    peak, seams = peak_memory_mib(), {"pictures": _seams(model, shown)}
    if scene is not None and not model.needs:
        ground = load_drape(scene).surfaces[0]
        seams[str(scene)] = _seams(model, [Inputs(ground.colour, ground.texel_m)])
    return {"load_s": loaded, "translate_s": float(np.median(seconds[1:])), "peak_mib": peak, "seams": seams}


def pictures_of(folder, number):
    """Return Inputs of 640×512 pixels of a data set's test part."""
    dataset = read_dataset(folder)
    test = dataset.of("test")
    large = [entry for entry in test.entries if entry.shape[0] >= SIZE[0] and entry.shape[1] >= SIZE[1]]
    if not large:
        raise ThermorenderError(f"{folder} has no test pairs of 640×512 pixels or more; give another data set")
    chosen = np.unique(np.linspace(0, len(large) - 1, min(number, len(large))).astype(int))
    whole = (inputs_of(test.pair(large[k]), dataset.card) for k in chosen)
    return [_part(each, np.s_[: SIZE[0], : SIZE[1]]) for each in whole]


def _part(inputs, here):
    terrain = {name: plane[here] for name, plane in inputs.terrain.items()}
    depth = None if inputs.depth is None else inputs.depth[here]
    return replace(inputs, rgb=inputs.rgb[here], terrain=terrain, depth=depth)


def _seams(model, shown):
    """Return {way: (mean step at borders, mean step elsewhere)} over pictures [K]."""
    ways = {"squares": model, "applied": model}
    if model.method in RECIPES and "published" in RECIPES[model.method].options:
        for way, published in (("squares", False), ("published", True)):
            ways[way] = replace(model, predictor=replace(model.predictor, published=published))
    found = {}
    for way, applied in ways.items():
        sums = np.zeros((2, 2))
        for inputs in shown:
            if way == "applied":
                given = applied.radiance(inputs)
                lines = applied.predictor.joints(inputs) if hasattr(applied.predictor, "joints") else ((), ())
            else:
                given = side_by_side(applied, inputs)
                lines = tuple(np.arange(SIDE, n, SIDE) for n in given.shape)
            sums += steps_of(apparent_temperature(given, model.band_um), lines)
        if sums[0, 1]:
            found[way] = tuple((sums[:, 0] / sums[:, 1]).tolist())
    return found


def side_by_side(model, inputs):
    """Return the radiance of a picture in squares, each translated alone; partial squares are left out."""
    height, width = (n // SIDE * SIDE for n in inputs.rgb.shape[:2])
    found = np.empty((height, width))
    for top in range(0, height, SIDE):
        for left in range(0, width, SIDE):
            here = np.s_[top : top + SIDE, left : left + SIDE]
            found[here] = model.radiance(_part(inputs, here))
    return found


def steps_of(temperature, lines):
    """Return the sum [K] and number of steps from pixel to pixel, at given lines and elsewhere, (2, 2)."""
    sums = np.zeros((2, 2))
    for axis, places in enumerate(lines):
        steps = np.abs(np.diff(temperature.astype(np.float64), axis=axis))
        meet = np.zeros(steps.shape[axis], bool)
        meet[np.round(places).astype(int) - 1] = True
        for row, chosen in zip(sums, (meet, ~meet), strict=True):
            here = np.compress(chosen, steps, axis=axis)
            here = here[np.isfinite(here)]
            row += here.sum(), here.size
    return sums


def rows(result):
    """Return the result as table rows under HEADER."""
    return [
        (name, f"{each['load_s']:.2f}", f"{each['translate_s']:.2f}", _number(each["peak_mib"], 0), picture,
         *(_number(value) for way in ("squares", "published", "applied") for value in seams.get(way, (None, None))))
        for name, each in result["maps"].items() for picture, seams in each["seams"].items()
    ]  # fmt: skip


def _number(value, digits=2):
    return "–" if value is None else f"{value:.{digits}f}"
