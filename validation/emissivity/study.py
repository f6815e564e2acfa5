"""Evaluation of the learned emissivity map on procedural scenes with known materials.

The learned map is also judged with the heights of the surface model, where these are evidence. Three simpler methods
are compared: the material whose mean colour in the scene is nearest (it uses the truth), the
scene's most common material everywhere, and the fallback everywhere. Errors are those of the band emissivity and of
apparent temperature. The latter is seen from straight above without air, under the scene's unobstructed sky, with each
texel at the typical temperature of its true material.
"""

import time

import numpy as np

from thermorender.apps.lands.procedural.procedural_scene import KINDS, make
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.learned.emissivity import elevation
from thermorender.learned.emissivity.mapping import load_map, map_materials
from thermorender.learned.pixel_features import lab
from thermorender.materials.extended import within_band
from thermorender.materials.library import find, load_library
from thermorender.physics.band import RadianceTable, quadrature
from thermorender.physics.planck import spectral_radiance
from thermorender.scene.spec import DEFAULT_CONFIDENCE

METHODS = (
    "learned, mean of all",
    "learned, with heights",
    "learned, most probable",
    "nearest colour",
    "commonest material",
    "fallback",
)


def evaluate(model="procedural", seeds=(201, 202), fallback="soil_loam", confidence=DEFAULT_CONFIDENCE,
             kinds=tuple(KINDS), progress=None):  # fmt: skip
    """Return the errors of each of METHODS, per scene and over all, and the confusion table, as a dict.

    Parameters
    ----------
    model : str
        Name or file of the emissivity map.
    seeds : sequence of int
        Seeds of scenes that the map was not trained on.
    fallback : str
        Material of unknown texels.
    confidence : float
        Confidence below which a texel is unknown.
    kinds : sequence of str
        Kinds of procedural scene.
    progress : callable, optional
        Called with (step, share done).

    Raises
    ------
    ThermorenderError
        The map was trained on one of these scenes.
    """
    report = progress or (lambda step, share: None)
    model, library = load_map(model), load_library()
    # The others have no data in this band, unless the map names them: scenes assume their missing part.
    low, high = BAND_UM
    whole = {n: m for n, m in library.items() if m.valid_range_um[0] <= low and m.valid_range_um[1] >= high}
    named = {n: within_band(m, BAND_UM, library, model.name) for n, m in library.items() if n in model.materials}
    library = whole | named
    names = list(library)
    own = [find(library, name, f"emissivity map {model.name!r}").name for name in model.materials]
    own = np.array([names.index(name) for name in own])
    stand_in = names.index(find(library, fallback, "fallback").name)
    jobs = [(kind, seed) for seed in seeds for kind in kinds]
    for kind, seed in jobs:
        if f"procedural {kind} seed {seed}" in str(model.about.get("trained_on", "")).split("; "):
            raise ThermorenderError(f"seed={seed} is a seed that {model.name!r} was trained on; give another one")
    confusion = np.zeros((len(names), len(names) + 1), np.int64)
    scenes, every = {}, {method: [] for method in METHODS}
    for number, (kind, seed) in enumerate(jobs):
        report("making and mapping landscapes", number / len(jobs))
        scene = make(kind, seed)
        number_of = np.zeros(256, np.int64)
        for value, name in scene.class_names.items():
            number_of[value] = names.index(name)
        truth = number_of[scene.classes]
        began = time.perf_counter()
        mapped = map_materials(model, scene.orthophoto, scene.texel_m)
        seconds = time.perf_counter() - began
        unknown = mapped.confidence < confidence
        best = own[mapped.index[..., 0]]
        np.add.at(confusion, (truth, np.where(unknown, len(names), best)), 1)
        best[unknown] = stand_in
        index, share = _mixture(best, unknown, mapped.probability, own)
        simple = (
            best, _nearest_colour(scene.orthophoto, truth),
            np.full(truth.shape, np.bincount(truth.ravel()).argmax()), np.full(truth.shape, stand_in),
        )  # fmt: skip
        weighed, why = _with_heights(model, scene, mapped)
        with_heights = _mixture(own[weighed.index[..., 0]], weighed.confidence < confidence, weighed.probability, own)
        guesses = dict(zip(METHODS, ((index, share), with_heights, *map(pure, simple)), strict=True))
        kelvin = np.array([library[name].temperature for name in names], dtype=np.float32)
        errors_of = Errors(list(library.values()), kelvin[truth], scene.sky_temperature)
        found = {}
        for method, guess in guesses.items():
            errors = errors_of(truth, *guess)
            every[method].append(errors)
            found[method] = {**_summary(*errors), "balanced": _balanced(errors[0], truth)}
        scenes[f"{kind} {seed}"] = {"texels": truth.size, "share_unknown": round(float(unknown.mean()), 5),
                                    "heights": why or "used",
                                    "seconds": round(seconds, 2), "methods": found}  # fmt: skip
    seen = np.flatnonzero(confusion.sum(axis=1) + confusion.sum(axis=0)[:-1])
    confusion, names = confusion[seen][:, [*seen, -1]], [names[k] for k in seen]
    accuracy = np.diag(confusion) / np.maximum(confusion.sum(axis=1), 1)
    return {
        "model": model.name, "about": model.about, "seeds": list(seeds), "materials": names,
        "confusion": confusion.tolist(),
        "class_accuracy": {name: round(float(part), 4) for name, part, row in
                           zip(names, accuracy, confusion.sum(axis=1), strict=True) if row},
        "scenes": scenes,
        "all": {method: _summary(*map(np.concatenate, zip(*errors, strict=True))) for method, errors in every.items()},
    }  # fmt: skip


def _with_heights(model, scene, mapped):
    """(Mapped with the heights of a scene as evidence, why they are none)."""
    import cv2

    above, slope, why = elevation.seen(scene.elevation.astype(np.float64), scene.post_m)
    if why:
        return mapped, why
    case = elevation.case_of(*(cv2.resize(each, scene.classes.shape, interpolation=cv2.INTER_LINEAR)
                            for each in (above, slope)))  # fmt: skip
    more = [elevation.evidence(case, model.materials)]
    return map_materials(model, scene.orthophoto, scene.texel_m, evidence=more), why


def _balanced(right, truth):
    """Mean share of right texels over the materials that cover a thousandth of the scene or more."""
    count = np.bincount(truth.ravel())
    return round(
        float(np.mean((np.bincount(truth.ravel(), right) / np.maximum(count, 1))[count > 1e-3 * truth.size])), 4
    )


def rows(result):
    """Return the comparison as table rows of text under HEADER, one per method."""
    return [
        (method, f"{e['accuracy']:.1%}", f"{e['emissivity_mean']:.4f}", f"{e['emissivity_rms']:.4f}",
         f"{e['mk_mean']:.0f}", f"{e['mk_rms']:.0f}", f"{e['mk_95']:.0f}")
        for method, e in result["all"].items()
    ]  # fmt: skip


HEADER = ("method", "accuracy", "mean |Δε|", "rms Δε", "mean |ΔT|, mK", "rms ΔT, mK", "95 % of |ΔT|, mK")


class Errors:
    """Errors of predicted materials on the texels of a scene with known temperatures."""

    def __init__(self, materials, temperature, sky):
        wavelength, weight = quadrature(*BAND_UM)
        low, high = float(temperature.min()), float(temperature.max())
        spectra = np.array([material.emissivity_at(wavelength) for material in materials])
        planck = weight * spectral_radiance(wavelength, 0.5 * (low + high))
        self.emissivity = spectra @ planck / planck.sum()
        self.reflected = (1.0 - spectra) @ (weight * spectral_radiance(wavelength, sky))
        self.emitted = {}
        self.materials, self.range = materials, (low, high)
        self.apparent = RadianceTable.of(np.ones_like, min(low, sky) - 5.0, high + 5.0, *BAND_UM)
        self.temperature = temperature.astype(np.float64)

    def __call__(self, truth, index, share):
        """Return (correct, Δε, ΔT [K]) of every texel, (N,) each."""
        radiance, emissivity = self._seen(index, share)
        true_radiance, true_emissivity = self._seen(*pure(truth))
        error = self.apparent.inverse(radiance) - self.apparent.inverse(true_radiance)
        right = index[..., 0] == truth
        return right.ravel(), np.float32(emissivity - true_emissivity).ravel(), np.float32(error).ravel()

    def _seen(self, index, share):
        radiance, emissivity = np.zeros(self.temperature.shape), np.zeros(self.temperature.shape)
        for rank in range(index.shape[-1]):
            for material in np.unique(index[..., rank]):
                here = index[..., rank] == material
                if material not in self.emitted:
                    table = RadianceTable.of(self.materials[material].emissivity_at, *self.range, *BAND_UM)
                    self.emitted[material] = table
                seen = self.emitted[material](self.temperature[here]) + self.reflected[material]
                radiance[here] += share[here][:, rank] * seen
                emissivity[here] += share[here][:, rank] * self.emissivity[material]
        return radiance, emissivity


def _mixture(best, unknown, probability, own):
    """(index, share), both (h, w, C): a map's materials by probability; unknown texels have the first only."""
    order = np.argsort(-probability.astype(np.int16), axis=-1, kind="stable")
    index, share = own[order], np.take_along_axis(probability, order, axis=-1).astype(np.float32)
    share /= share.sum(axis=-1, keepdims=True)
    index[unknown, 0], share[unknown] = best[unknown], np.eye(1, share.shape[-1], dtype=np.float32)
    return index, share


def pure(index):
    return index[..., None].astype(np.int64), np.ones((*index.shape, 1))


def _nearest_colour(rgb, truth):
    """Return the material whose mean colour in this scene is nearest in CIELAB."""
    image = lab(rgb)
    best, nearest = np.full(truth.shape, np.inf, np.float32), np.zeros(truth.shape, np.int64)
    for material in np.unique(truth):
        away = ((image - image[truth == material].mean(axis=0)) ** 2).sum(axis=-1)
        nearest[away < best] = material
        best = np.minimum(best, away)
    return nearest


def _summary(right, emissivity, temperature):
    mk = 1e3 * np.abs(temperature.astype(np.float64))
    return {
        "accuracy": round(float(right.mean()), 4),
        "emissivity_mean": round(float(np.abs(emissivity).mean(dtype=np.float64)), 5),
        "emissivity_rms": round(float(np.sqrt((emissivity.astype(np.float64) ** 2).mean())), 5),
        "mk_mean": round(float(mk.mean()), 1),
        "mk_rms": round(float(np.sqrt((mk**2).mean())), 1),
        "mk_95": round(float(np.quantile(mk, 0.95)), 1),
    }


def write_confusion(result, path):
    """Write the confusion table as CSV: texels by true material (rows) and mapped material (columns)."""
    import csv

    with atomic(path) as part, open(part, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["true material", *result["materials"], "unknown", "share right"])
        for name, row in zip(result["materials"], result["confusion"], strict=True):
            if sum(row):
                table.writerow([name, *row, result["class_accuracy"][name]])
