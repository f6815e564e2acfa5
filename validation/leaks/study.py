"""Planted leaks found by the fingerprints of a map, and pictures found by mistake.

Some pictures are those a map was trained on. Changed copies of them are leaks, and must be found; the other pictures
are innocent, and must not. The local features that `campaign.audit` compares data sets by are counted beside. They
read the training pictures themselves, where fingerprints are a few bytes in the map's file.
"""

import time
from pathlib import Path

import numpy as np

from thermorender.apps.compare.machine import machine
from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.training import duplicates
from thermorender.apps.training.translate import PICTURES, read_picture
from thermorender.errors import ThermorenderError
from thermorender.learned import fingerprints
from thermorender.versions import versions

# Numbers of procedural pictures that a map was trained on, and of innocent ones.
TRAINING, INNOCENT = 20, 200
# Leaks of each kind.
PLANTED = 20
# Share of the area of a crop, and the range of its scales.
CROP, SCALES = 0.2, (0.6, 1.7)
# Heaths differ by their seed in everything; villages share the layout of street, pond and nursery.
_KIND, _SIZE_M, _TEXEL_M = "heath", 64.0, 0.4
HEADER = ("pictures", "kind", "number", "found by fingerprints", "lowest agreement", "found by features")


def _compressed(rgb, _):
    import cv2

    return cv2.imdecode(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, 25])[1], cv2.IMREAD_COLOR)


def _cropped(rgb, generator):
    """A random part of `CROP` of the area, at a random scale."""
    import cv2

    height, width = (round(side * CROP**0.5) for side in rgb.shape[:2])
    top, left = (generator.integers(whole - side + 1) for whole, side in zip(rgb.shape, (height, width), strict=False))
    scale = generator.uniform(*SCALES)
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    part = np.ascontiguousarray(rgb[top : top + height, left : left + width])
    return cv2.resize(part, None, fx=scale, fy=scale, interpolation=how)


def _lit(rgb, generator):
    """Brightness and contrast changed at random, and clipped."""
    contrast, brightness = generator.uniform(0.6, 1.5), generator.uniform(-30.0, 30.0)
    return np.clip(contrast * (rgb - 128.0) + 128.0 + brightness, 0, 255).astype(np.uint8)


LEAKS = {
    "identical": lambda rgb, _: rgb,
    "compressed to JPEG of quality 25": _compressed,
    "mirrored": lambda rgb, _: np.ascontiguousarray(rgb[:, ::-1]),
    "turned by 90°": lambda rgb, _: np.ascontiguousarray(np.rot90(rgb)),
    "a fifth of the area at another scale": _cropped,
    "brightness and contrast changed": _lit,
}


def run(folders, seed=0, progress=None):
    """Return counts of leaks found and of innocent pictures found, as plain numbers.

    Parameters
    ----------
    folders : sequence of path
        Folders of pictures beside the procedural ones. In order of names, the first `PLANTED` are trained on, and the
        rest is innocent: frames of one drive stay together as far as names allow.
    seed : int
    progress : callable, optional
        Called with (step, share done).

    Raises
    ------
    ThermorenderError
        A folder with too few pictures.
    """
    report = progress or (lambda step, share: None)
    sets = {"procedural": procedural_pictures(report)}
    for folder in map(Path, folders):
        sets[folder.parent.name if folder.name == "visible" else folder.name] = pictures_in(folder)
    found = {}
    for number, (name, (known, innocent)) in enumerate(sets.items()):
        report(f"searching {name}", number / len(sets))
        found[name] = _counted(known, innocent, seed)
    return {
        "bytes_per_picture": fingerprints.BYTES, "most_pictures": fingerprints.MOST_PICTURES,
        "least_agreement": fingerprints.LEAST_AGREEMENT, "crop": CROP, "seed": seed, "sets": found,
        "machine": machine(), "versions": versions(),
    }  # fmt: skip


def rows(result):
    """Return the result as table rows under HEADER."""
    return [
        (name, kind, each["number"], each["found"], f"{each['lowest']:.1f}" if "lowest" in each else "",
         each["by_features"])
        for name, own in result["sets"].items() for kind, each in own["cases"].items()
    ]  # fmt: skip


def procedural_pictures(report):
    """{name: picture} of training and of innocent procedural pictures."""
    pictures = {}
    for number in range(TRAINING + INNOCENT):
        report("making procedural pictures", number / (TRAINING + INNOCENT))
        made = make(_KIND, 1000 + number, size_m=_SIZE_M, texel_m=_TEXEL_M, post_m=_TEXEL_M)
        pictures[f"{_KIND} {number}"] = made.orthophoto
    names = list(pictures)
    return tuple({name: pictures[name] for name in some} for some in (names[:TRAINING], names[TRAINING:]))


def pictures_in(folder):
    """{name: picture} of training and of innocent pictures of a folder."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in PICTURES and "label" not in path.stem)
    if len(paths) < 3 * PLANTED // 2:
        raise ThermorenderError(
            f"{folder} has {len(paths)} pictures; give a folder of at least {3 * PLANTED // 2}, in it or below it"
        )
    return tuple({path.stem: read_picture(path)[0] for path in some} for some in (paths[:PLANTED], paths[PLANTED:]))


def _counted(known, innocent, seed):
    """Leaks of each kind found, and innocent pictures found."""
    generator, names = np.random.default_rng(seed), list(known)
    chosen = [int(k) for k in np.linspace(0, len(names) - 1, PLANTED).round()]
    began = time.process_time()
    prints = fingerprints.fingerprints_of(known.values(), len(known))
    sketches = [duplicates.sketch(rgb) for rgb in known.values()]
    cases = {}
    for kind, change in LEAKS.items():
        changed = [change(known[names[k]], generator) for k in chosen]
        agreement = fingerprints.agreements(prints, changed)[np.arange(PLANTED), chosen]
        features = duplicates.find([duplicates.sketch(rgb) for rgb in changed], sketches)
        cases[kind] = {
            "number": PLANTED, "found": int((agreement >= fingerprints.LEAST_AGREEMENT).sum()),
            "lowest": float(agreement.min()), "by_features": sum(each is not None for each in features),
        }  # fmt: skip
    seen = fingerprints.search(prints, innocent.values())
    features = duplicates.find([duplicates.sketch(rgb) for rgb in innocent.values()], sketches)
    mistaken = {name: [names[each.index], each.agreement] for name, each in zip(innocent, seen, strict=True) if each}
    cases["innocent pictures"] = {
        "number": len(innocent), "found": len(mistaken), "by_features": sum(each is not None for each in features)
    }  # fmt: skip
    return {"training": len(known), "cases": cases, "named": mistaken, "cpu_s": time.process_time() - began}
