"""Comparisons with planted faults and innocent comparisons on unseen lands: what the referee names in each.

Each land is rendered in a flight of a few poses. The frames are made from its temperature pictures, and compared as
frames of another program.
"""

import json
import tempfile
from pathlib import Path

import numpy as np

from thermorender import formats
from thermorender.apps.compare import emissivities, findings
from thermorender.apps.compare.frames import Frames
from thermorender.apps.compare.machine import machine
from thermorender.apps.compare.methods import Method
from thermorender.apps.compare.trial import Setup, Totals, Trial
from thermorender.apps.compare.view import Flight, view_of
from thermorender.apps.lands.procedural.procedural_scene import KINDS, make, weather_of
from thermorender.apps.lands.procedural.truth import write
from thermorender.errors import ThermorenderError
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.trajectory.path import Trajectory
from thermorender.versions import versions
from validation.referee import plants

HEADER = ("planted", "comparisons", "named", "nothing named")
_RATES = {
    "accused": "innocent frames accused", "right": "visible faults all named", "faint_right": "faint faults all named",
    "also_wrong": "faults with another cause named too", "flat": "maps of almost no contrast, so named",
}  # fmt: skip
KINDS_NAMED = (
    "offset", "contrast", "shift", "blur", "material", "emissivity", "zoom", "drift", "clipping", "order", "mirrored",
    "unlike",
)  # fmt: skip
# Kinds that are right for another: an offset on the material for a wrong emissivity; a picture of almost no contrast
# looks unlike the ground too.
_LIKE = {"emissivity": {"material"}, "flat": {"contrast", "unlike"}}
# Least root mean square effect of a visible fault [K]: about twice the noise of its frame.
VISIBLE_K = 0.2
# Seeds of the lands of the stated rates, and of those that the referee's thresholds were chosen on.
SEEDS, CHOSEN_ON = tuple(range(7601, 7608)), (7201, 7301, 7302, 7401, 7402, *range(7501, 7508))
# Side and texel of a land [m], its camera's pixels against the full camera, and rays.
_LAND, _COARSER, _SETTINGS = (48.0, 0.25, 1.0), 4, {"rays": 4}
# Heights above the ground [m] and turns about the horizontal axis [rad], by seed; places of the poses [m].
_HEIGHTS_M, _TURNS = (28.0, 32.0, 25.0, 30.0), (0.0, 0.2)
_PLACES = ((-3.0, -1.0), (-1.0, 1.0), (1.0, 0.0), (3.0, 1.5))


def run(folder, kinds=tuple(KINDS), seeds=SEEDS, progress=None):
    """Return {"rates", "confusion", "comparisons": [{"land", "frame", "planted", "named", "sizes", …}]}.

    Parameters
    ----------
    folder : path
        Finished lands are kept in its `lands.jsonl`, and are not compared again.
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
    path, found = folder / "lands.jsonl", []
    kept = {}
    if path.is_file():
        kept = {each["land"]: each["comparisons"] for each in map(json.loads, path.read_text("utf-8").splitlines())}
    for number, (kind, seed) in enumerate(lands):
        if progress:
            progress(f"{kind} {seed}", number / len(lands))
        name = f"{kind} {seed}"
        if name not in kept:
            kept[name] = of_land(kind, seed)
            formats.append_json(path, {"land": name, "comparisons": kept[name]})
        found += kept[name]
    return {"seeds": list(seeds), "kinds": list(kinds), "rates": rates(found),
            "confusion": confusion(found), "comparisons": found,
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
        flight, aside = _flight(scene, seed, _PLACES, 0.0), _flight(scene, seed, ((5.0, 5.0),), 2.0)
        reference = Renderer(scene.with_true_temperature(), **_SETTINGS)
        *views, other = (view_of(reference, pose, float(k), k, True)
                         for k, pose in enumerate([*flight.poses, *aside.poses]))  # fmt: skip
        band_um = scene.camera.band_um
        known = emissivities.band_emissivities(scene)
        frames = {
            **plants.planted(views, other.truth, scene.sky_temperature, known, band_um, rng),
            **plants.innocent(views, band_um, rng),
        }
        found = scored(flight, f"{kind} {seed}", reference, frames, folder)
    return [_case(f"{kind} {seed}", name, frame, found) for name, frame in frames.items()]


def scored(flight, land, reference, frames, folder):
    """Return {name: results} of frames that are compared as frames of another program; nothing is drawn."""
    setup = Setup(flight, land, reference, True, None, Frames(folder, flight, reference.scene, None, {}),
                  [Method("foreign", name, function=lambda view, kelvin=frame.kelvin: kelvin[view.index])
                   for name, frame in frames.items()])  # fmt: skip
    totals = Totals()
    Trial(setup, totals, 0, None).run(None, lambda step, share: None)
    return {own.method.name: own for own in totals.methods.values()}


def _flight(scene, seed, places, yaw):
    """Return the Flight of poses at places from a land's middle [m], turned about the vertical [rad]."""
    height, turn = _HEIGHTS_M[seed % len(_HEIGHTS_M)], _TURNS[seed % len(_TURNS)]
    # Looking straight down, then turned about the camera's horizontal axis.
    half = np.pi / 2.0 - 0.5 * turn
    cosine, sine, c, s = np.cos(half), np.sin(half), np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    # The quaternion of the turn about the vertical times that of the look down, (w, x, y, z).
    look = [float(each) for each in (c * cosine, c * sine, s * sine, s * cosine)]
    above = float(np.nanmax(scene.surfaces[0].vertices[:, 2])) + height
    at = np.array([[*place, above] for place in places])
    times = np.arange(float(len(at)))
    return Flight(scene, times, Trajectory(times, at, np.array([look] * len(at))).sampled(times).poses())


def _case(land, name, frame, found):
    """Return a comparison as plain values."""
    own = found[name].summary(None, 0)
    named = {each["kind"] for each in findings.of_method(name, own)}
    sizes = {}
    for each in own["causes"]["named"] if own["causes"] else []:
        size = each["size"]
        sizes[each["kind"]] = {"shift": float(np.hypot(*size[:2])) if len(size) == 2 else 0.0,
                               "blur": abs(size[0]) ** 0.5, "drift": float(np.std(size)),
                               "clipping": size[-1]}.get(each["kind"], size[0])  # fmt: skip
    ground = own["errors"]["radiometric"]["ground"]
    return {"land": land, "frame": name, "planted": frame.faults, "effect_k": frame.effect_k,
            "named": sorted(named), "sizes": sizes,
            "mae_k": ground["mae_k"], "rmse_k": ground["rmse_k"], "unexplained_k": findings.unexplained(own),
            "correlation": own["gain"]["correlation"] if own["gain"] else None,
            "edges": own["likeness"]["edges"]}  # fmt: skip


def rates(found):
    """Return rates of right and of wrong names, with 95 % intervals; a fault is visible from an effect of VISIBLE_K."""
    innocent = [each for each in found if not each["planted"]]
    # A map of almost no contrast is no planted fault.
    flat = [each for each in found if "flat" in each["planted"]]
    faults = [each for each in found if each["planted"] and "flat" not in each["planted"]]
    visible = [each for each in faults if each["effect_k"] >= VISIBLE_K]
    faint = [each for each in faults if each["effect_k"] < VISIBLE_K]
    counts = {
        "accused": (innocent, lambda each: bool(each["named"])),
        "right": (visible, rightly), "faint_right": (faint, rightly),
        "also_wrong": (faults, lambda each: bool(wrongly(each))), "flat": (flat, rightly),
    }  # fmt: skip
    rated = {name: (sum(map(of, cases)), len(cases)) for name, (cases, of) in counts.items()}
    return {name: {"count": count, "of": of, "interval_95": interval(count, of)} for name, (count, of) in rated.items()}


def named(case):
    """Return the kinds that are named; almost no contrast is a wrong contrast."""
    return {"contrast" if kind == "flat" else kind for kind in case["named"]}


def wrongly(case):
    """Return the kinds that are named but not planted; an offset on the material is right for a wrong emissivity, and
    offsets are right for a contrast."""
    allowed = set(case["planted"]) | ({"material"} if "emissivity" in case["planted"] else set())
    # A contrast about another temperature than the mean of a pose is also an offset of the pose.
    allowed |= {"offset", "drift"} if "contrast" in case["planted"] else set()
    allowed |= {"contrast", "unlike", "offset", "drift"} if "flat" in case["planted"] else set()
    return sorted(named(case) - allowed)


def rightly(case):
    """Return whether all planted kinds are named, or others that are right for them, of `_LIKE`."""
    kinds = named(case)
    return all(kind in kinds or bool(kinds & _LIKE.get(kind, set())) for kind in case["planted"])


def confusion(found):
    """Return {planted kinds or "none": {"comparisons", named kind: number}} of visible faults and innocent frames."""
    table = {}
    for case in found:
        if case["planted"] and case["effect_k"] < VISIBLE_K:
            continue
        row = table.setdefault(" + ".join(case["planted"]) or "none", {"comparisons": 0, "nothing": 0})
        row["comparisons"] += 1
        row["nothing"] += not case["named"]
        for kind in named(case):
            row[kind] = row.get(kind, 0) + 1
    return table


def sizes(found):
    """Return {kind: (n, 2) planted and found sizes} of visible faults with sizes that are named by their own kind."""
    pairs = {}
    for case in found:
        for kind, size in case["planted"].items():
            if kind in case["sizes"] and kind in case["named"] and case["effect_k"] >= VISIBLE_K:
                pairs.setdefault(kind, []).append((size, case["sizes"][kind]))
    return {kind: np.array(values) for kind, values in pairs.items()}


def rows(result):
    """Return the result as table rows under HEADER."""
    found = []
    for kind, row in result["confusion"].items():
        words = ", ".join(f"{name} {count}" for name, count in row.items() if name not in ("comparisons", "nothing"))
        found.append((kind, str(row["comparisons"]), words, str(row["nothing"])))
    for name, each in result["rates"].items():
        low, high = each["interval_95"]
        share = each["count"] / max(each["of"], 1)
        found.append((_RATES[name], str(each["of"]), f"{share:.1%} ({low:.1%}…{high:.1%})", ""))
    return found


def interval(count, of, confidence=0.95):
    """Return the exact interval of a rate, Clopper & Pearson 1934, doi:10.1093/biomet/26.4.404."""
    from scipy.stats import beta

    tail = 0.5 * (1.0 - confidence)
    low = float(beta.ppf(tail, count, of - count + 1)) if count else 0.0
    high = float(beta.ppf(1.0 - tail, count + 1, of - count)) if count < of else 1.0
    return low, high
