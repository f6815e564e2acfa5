"""What translating a picture costs with each learned map, and how far its tiles disagree where they meet.

Seconds and memory are those of pictures of 640×512 in a process of its own for each map. A network that takes squares
of one size gives another temperature on either side of where two of them meet. That is the mean step from one line of
pixels to the next there, beside the mean step everywhere else: of squares of 256 pixels side by side, each translated
alone, once as pix2pix applies itself (statistics of each square, and dropout, the same for all), and of the picture as
`translate` gives it.
"""

import time
from dataclasses import replace

import numpy as np

from thermorender import defaults
from thermorender.campaign.dataset import read_dataset
from thermorender.campaign.map_inputs import inputs_of
from thermorender.compare.machine import apart, forget_peak_memory, machine, peak_memory_mib
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.networks.recipes import RECIPES
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.scene.load import load_scene
from thermorender.versions import versions

HEADER = ("map", "load [s]", "640×512 [s]", "peak [MiB]", "picture", "squares [K]", "elsewhere [K]",
          "as published [K]", "elsewhere [K]", "as applied [K]", "elsewhere [K]")  # fmt: skip
SIDE = 256
SIZE = (512, 640)
# Translations that are timed, after one that is not.
_TURNS = 5


def run(models, dataset, scene=defaults.SCENE, pictures=6, progress=None):
    """Return what learned maps cost and how far their tiles disagree; plain numbers.

    Parameters
    ----------
    models : sequence of str
        Names or files.
    dataset : path
        Folder of a data set, pictures of whose test part are translated, cut to 640×512 where they are larger.
    scene : str or None
        Whose terrain's orthophoto is translated, too, by maps that need colour only; None: none.
    pictures : int
        Of the test part, evenly spaced.
    progress : callable, optional
        Called with (what, share done).

    Returns
    -------
    dict
        Its "maps" have load_s, translate_s, peak_mib (None where the system does not tell), and seams: {"pictures" or
        the scene's name: {way: (mean step where squares meet, mean step elsewhere) [K]}}, the ways being "squares",
        "published" (pix2pix) and "applied", which is missing where a picture needs one tile only.

    Raises
    ------
    ThermorenderError
        Unknown maps, pictures below 1, a data set without a test part or too small pictures, or maps that need what it
        lacks.
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
    shown = _pictures(folder, pictures)
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
        ground = load_scene(scene).surfaces[0]
        seams[str(scene)] = _seams(model, [Inputs(ground.colour, ground.texel_m)])
    return {"load_s": loaded, "translate_s": float(np.median(seconds[1:])), "peak_mib": peak, "seams": seams}


def _pictures(folder, number):
    """Inputs of 640×512 pixels of a data set's test part."""
    dataset = read_dataset(folder)
    test = dataset.of("test")
    large = [entry for entry in test.entries if entry.shape[0] >= SIZE[0] and entry.shape[1] >= SIZE[1]]
    if not large:
        raise ThermorenderError(f"{folder} has no test pairs of 640×512 or more; give a data set that has")
    chosen = np.unique(np.linspace(0, len(large) - 1, min(number, len(large))).astype(int))
    whole = (inputs_of(test.pair(large[k]), dataset.card) for k in chosen)
    return [_part(each, np.s_[: SIZE[0], : SIZE[1]]) for each in whole]


def _part(inputs, here):
    terrain = {name: plane[here] for name, plane in inputs.terrain.items()}
    depth = None if inputs.depth is None else inputs.depth[here]
    return replace(inputs, rgb=inputs.rgb[here], terrain=terrain, depth=depth)


def _seams(model, shown):
    """{way: (step where squares meet, step elsewhere)} over pictures [K]."""
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
                given = _side_by_side(applied, inputs)
                lines = tuple(np.arange(SIDE, n, SIDE) for n in given.shape)
            sums += _steps(apparent_temperature(given, model.band_um), lines)
        if sums[0, 1]:
            found[way] = tuple((sums[:, 0] / sums[:, 1]).tolist())
    return found


def _side_by_side(model, inputs):
    """Radiance of a picture in squares, each translated alone; what is left of whole squares is not."""
    height, width = (n // SIDE * SIDE for n in inputs.rgb.shape[:2])
    found = np.empty((height, width))
    for top in range(0, height, SIDE):
        for left in range(0, width, SIDE):
            here = np.s_[top : top + SIDE, left : left + SIDE]
            found[here] = model.radiance(_part(inputs, here))
    return found


def _steps(temperature, lines):
    """Sum [K] and number of steps from pixel to pixel, at given lines and elsewhere, (2, 2)."""
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
    """Return the rows of a result's table."""
    return [
        (name, f"{each['load_s']:.2f}", f"{each['translate_s']:.2f}", _number(each["peak_mib"], 0), picture,
         *(_number(value) for way in ("squares", "published", "applied") for value in seams.get(way, (None, None))))
        for name, each in result["maps"].items() for picture, seams in each["seams"].items()
    ]  # fmt: skip


def _number(value, digits=2):
    return "–" if value is None else f"{value:.{digits}f}"
