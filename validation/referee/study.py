"""Comparisons with planted faults and innocent comparisons on unseen lands: what the referee names in each.

Each land is rendered once. The frames are made from its temperature picture and compared as frames of another program.
"""

import tempfile
from pathlib import Path

import numpy as np

from thermorender.campaign.procedural_truth import write
from thermorender.compare.machine import machine
from thermorender.compare.referee import emissivities, views
from thermorender.compare.referee.flight import Flight
from thermorender.compare.referee.run import Options, compare
from thermorender.errors import ThermorenderError
from thermorender.footage.radiometric_files import write_tlinear
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.synthetic.procedural_scene import KINDS, make, weather_of
from thermorender.trajectory.path import Trajectory
from thermorender.versions import versions
from validation.referee import plants

HEADER = ("frames", "comparisons", "named rightly", "size within", "wrongly named too")
# Seeds of the lands of the stated rates, and of those that the referee's thresholds were chosen on.
SEEDS, CHOSEN_ON = (7301, 7302, 7303, 7304), (7201, 7202)
# Side and texel of a land [m], its camera's pixels against the full camera, and rays.
_LAND, _COARSER, _SETTINGS = (80.0, 0.25, 1.0), 2, {"rays": 4}
# Heights above the ground [m] and turns about the horizontal axis [rad], by seed.
_HEIGHTS_M, _TURNS = (55.0, 65.0, 50.0, 60.0), (0.0, 0.2)
# A kind that another kind includes: an offset on a material is an honest name for a wrong emissivity.
_ALSO = {"emissivity": {"material"}, "material": {"emissivity"}}
KINDS_NAMED = ("offset", "contrast", "shift", "blur", "material", "emissivity", "mirrored", "unlike")


def run(kinds=tuple(KINDS), seeds=SEEDS, progress=None):
    """Return {"comparisons": [{"land", "frame", "planted", "named", ...}], "rates"} as plain values.

    Parameters
    ----------
    kinds : sequence of str
        Kinds of procedural land.
    seeds : sequence of int
    progress : callable, optional
        Called with (step, share done).

    Raises
    ------
    ThermorenderError
        An unknown kind.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise ThermorenderError(f"kind={kind!r} is not a kind of land; give some of {', '.join(KINDS)}")
    lands = [(kind, seed) for seed in seeds for kind in kinds]
    found = []
    for number, (kind, seed) in enumerate(lands):
        if progress:
            progress(f"{kind} {seed}", number / len(lands))
        found += of_land(kind, seed)
    return {"seeds": list(seeds), "kinds": list(kinds), "comparisons": found, "rates": rates(found),
            "machine": machine(), "versions": versions()}  # fmt: skip


def of_land(kind, seed):
    """Return the comparisons of a land."""
    rng = np.random.default_rng([seed, sorted(KINDS).index(kind)])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        # Every other land has the kind's own clear afternoon; the others may be almost uniform.
        weather = weather_of(kind, weather_seed=None if seed % 2 else seed)
        scene = load_scene(write(make(kind, seed, *_LAND, weather=weather), folder / f"{kind}_{seed}"))
        scene = scene.with_camera(scene.camera.coarser(_COARSER))
        flights = [_flight(scene, seed, aside) for aside in (0.0, 10.0)]
        reference = Renderer(scene.with_temperature(scene.truth_temperature_spec), **_SETTINGS)
        view, other = (views.view_of(reference, each.poses[0], 0.0, 0, True) for each in flights)
        band_um = scene.camera.band_um
        known = emissivities.band_emissivities(scene)
        frames = {**plants.planted(view, other.truth, scene.sky_temperature, known, band_um, rng),
                  **plants.innocent(view, band_um, rng)}  # fmt: skip
        foreign = {}
        for number, (name, frame) in enumerate(frames.items()):
            foreign[name] = folder / f"f{number}"
            foreign[name].mkdir()
            write_tlinear(foreign[name] / "pose_0000.tif", frame.kelvin.astype(np.float32))
        summary = compare([flights[0]], folder / "out", [], Options(letters=(), foreign=foreign, settings=_SETTINGS))
    return [_case(f"{kind} {seed}", name, frame, summary) for name, frame in frames.items()]


def _flight(scene, seed, aside_m):
    """Return the Flight of one pose above a land's middle, or beside it."""
    height, turn = _HEIGHTS_M[seed % len(_HEIGHTS_M)], _TURNS[seed % len(_TURNS)]
    # Looking straight down, then turned about the camera's horizontal axis.
    half = np.pi / 2.0 - 0.5 * turn
    look = [float(np.cos(half)), float(np.sin(half)), 0.0, 0.0]
    place = [[aside_m, aside_m, float(np.nanmax(scene.surfaces[0].vertices[:, 2])) + height]]
    return Flight.of(scene, Trajectory(np.zeros(1), np.array(place), np.array([look])), 1.0)


def _case(land, name, frame, summary):
    """Return a comparison as plain values."""
    label = f"foreign {name}"
    own = summary["methods"][label]
    named = {}
    for each in summary["findings"]:
        if each["method"] == label:
            named[each["kind"]] = named.get(each["kind"], 0) + 1
    sizes = {}
    for each in own["causes"]["named"] if own["causes"] else []:
        size = each["size"]
        sizes[each["kind"]] = {"shift": float(np.hypot(*size[:2])) if len(size) == 2 else 0.0,
                               "blur": abs(size[0]) ** 0.5}.get(each["kind"], size[0])  # fmt: skip
    ground = own["errors"]["radiometric"]["ground"]
    return {"land": land, "frame": name, "planted": frame.faults, "effect_k": frame.effect_k,
            "named": sorted(named), "sizes": sizes,
            "mae_k": ground["mae_k"], "correlation": own["gain"]["correlation"] if own["gain"] else None,
            "edges": own["likeness"]["edges"], "causes": own["causes"]["named"] if own["causes"] else []}  # fmt: skip


def rates(found):
    """Return rates of right and of wrong names, with 95 % binomial intervals (Clopper & Pearson 1934)."""
    innocent = [each for each in found if not each["planted"]]
    planted = [each for each in found if each["planted"]]
    false = sum(bool(each["named"]) for each in innocent)
    wrong = sum(bool(wrongly(each)) for each in planted)
    right = sum(rightly(each) for each in planted)
    return {
        "innocent": len(innocent), "accused": false, "accused_95": interval(false, len(innocent)),
        "planted": len(planted), "right": right, "right_95": interval(right, len(planted)),
        "also_wrong": wrong, "also_wrong_95": interval(wrong, len(planted)),
    }  # fmt: skip


def wrongly(case):
    """Return the kinds that are named but not planted."""
    allowed = set(case["planted"])
    for kind in case["planted"]:
        allowed |= _ALSO.get(kind, set()) if kind == "emissivity" else set()
    return sorted({"contrast" if kind == "flat" else kind for kind in case["named"]} - allowed)


def rightly(case):
    """Return whether all planted kinds are named; an offset on the material counts for a wrong emissivity."""
    return all(kind in case["named"] or (_ALSO.get(kind, set()) & set(case["named"]) and kind == "emissivity")
               for kind in case["planted"])  # fmt: skip


def interval(count, of, confidence=0.95):
    """Return the Clopper–Pearson interval of a rate."""
    from scipy.stats import beta

    tail = 0.5 * (1.0 - confidence)
    low = float(beta.ppf(tail, count, of - count + 1)) if count else 0.0
    high = float(beta.ppf(1.0 - tail, count + 1, of - count)) if count < of else 1.0
    return low, high
