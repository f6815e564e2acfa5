"""Adaptation of an emissivity map to one scene by a few labelled polygons.

The last layer is refitted with a penalty on the change of its weights. Whole polygons are left out in turn to choose
the penalty and calibrate the probabilities, because texels of one polygon look alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from thermorender.apps.training.emissivity_training import Labelled, emissivity_loss, fitted_posterior
from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity.features import NAMES, NEAR, features
from thermorender.learned.emissivity.mapping import MOST_MATERIALS, EmissivityMap, hidden, to_grid

# Penalties tried, from almost free to almost fixed weights.
_PENALTIES = (1e-3, 1e-2, 1e-1)
_FOLDS = 5
# Texels used of each polygon and of all, and the fewest polygons.
_MOST_PER_POLYGON, _MOST_TEXELS, _FEWEST_POLYGONS = 150, 60_000, 4
# Score of a material that the map does not know yet, below the largest of the others.
_NEW = -4.0


def adapted(
    model: EmissivityMap, item: Labelled, name: str, emissivity: Callable[[str], float], seed: int = 0
) -> EmissivityMap:
    """Return an EmissivityMap for the land of a Labelled, from a map for other land; materials may be added.

    A connected area of one material is a polygon. `emissivity` maps a material's name to its band emissivity.
    """
    import cv2

    generator = np.random.Generator(np.random.Philox(seed))
    rgb = to_grid(item.rgb, item.texel_m, model)
    labels = cv2.resize(item.material, rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    present = [int(value) for value in np.unique(labels) if value]
    materials = list(dict.fromkeys([*model.materials, *(item.names[value] for value in present)]))
    if len(materials) > MOST_MATERIALS:
        raise ThermorenderError(
            f"{item.source} and map {model.name!r} name {len(materials)} materials together; label fewer, at most "
            f"{MOST_MATERIALS} in all"
        )
    polygons = [(value, inside) for value in present for inside in _connected(labels == value)]
    if len(polygons) < _FEWEST_POLYGONS:
        raise ThermorenderError(
            f"{item.source} has {len(polygons)} polygons, but {_FEWEST_POLYGONS} or more can update a map; add some"
        )
    if len(present) < 2:
        raise ThermorenderError(
            f"{item.source} has polygons of {item.names[present[0]]} only, but a map is updated by those of two "
            "or more materials; label another material too"
        )
    described = features(rgb).reshape(-1, len(NAMES))
    most = min(_MOST_PER_POLYGON, max(1, _MOST_TEXELS // len(polygons)))
    texels, truth, polygon = [], [], []
    for number, (value, inside) in enumerate(polygons):
        texels.append(described[inside[generator.permutation(len(inside))[:most]]])
        truth.append(np.full(len(texels[-1]), materials.index(item.names[value])))
        polygon.append(np.full(len(texels[-1]), number))
    found, label, of = map(np.concatenate, (texels, truth, polygon))
    standard = (found - model.mean) / model.scale
    before = hidden(model.layers, standard)
    start = _start(model, before, len(materials))
    folds = np.array_split(generator.permutation(len(polygon)), min(_FOLDS, len(polygon)))
    scored = {penalty: _left_out(start, before, label, of, folds, penalty) for penalty in _PENALTIES}
    values = np.array([emissivity(each) for each in materials])
    posteriors = {penalty: fitted_posterior(*scores, values) for penalty, scores in scored.items()}
    best = min(_PENALTIES, key=lambda penalty: emissivity_loss(*scored[penalty], values, *posteriors[penalty]))
    weight, bias = _fitted(start, before, label, of, best)
    softening, prior = posteriors[best]
    near = np.stack([standard[of == one][:, NEAR].mean(axis=0) for one in range(len(polygon))])
    about = {**model.about, "adapted_to": f"{len(polygon)} polygons: {item.source}", "adapted_from": model.name}
    if item.unused:
        about["unused_labels"] = item.unused
    return replace(
        model, name=name, materials=tuple(materials), layers=(*model.layers[:-1], (weight, bias)), about=about,
        centres=np.concatenate([model.centres, near.astype(np.float32)]), softening=softening, prior=prior,
    )  # fmt: skip


def _connected(mask: np.ndarray) -> list[np.ndarray]:
    """Texel numbers of each connected area of a mask, (h, w) bool, in a list."""
    import cv2

    number, part = cv2.connectedComponents(mask.astype(np.uint8))
    order = np.argsort(part, axis=None, kind="stable")
    return np.split(order, np.searchsorted(part.ravel()[order], np.arange(1, number)))[1:]


def _start(model: EmissivityMap, before: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Last layer (weight, bias) with columns for `count` materials; the new ones are improbable."""
    weight, bias = model.layers[-1]
    new = count - len(bias)
    lowest = np.float32((before @ weight + bias).max(axis=1).mean() + _NEW)
    return np.hstack([weight, np.zeros((len(weight), new), np.float32)]), np.append(bias, np.full(new, lowest))


def _fitted(
    start: tuple[np.ndarray, np.ndarray], before: np.ndarray, label: np.ndarray, polygon: np.ndarray, penalty: float
) -> tuple[np.ndarray, np.ndarray]:
    """Last layer fitted to texels; each polygon counts the same."""
    from scipy.optimize import minimize

    weight, bias = start
    scale = before.std(axis=0) + 1e-3
    first = np.vstack([weight * scale[:, None], bias]).astype(np.float64)
    entry = np.hstack([before / scale, np.ones((len(before), 1))]).astype(np.float64)
    share = 1.0 / np.bincount(polygon)[polygon]
    share /= share.sum()
    hot = np.zeros((len(label), len(bias)))
    hot[np.arange(len(label)), label] = 1.0

    def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
        change = flat.reshape(first.shape)
        score = entry @ (first + change)
        score -= score.max(axis=1, keepdims=True)
        probability = np.exp(score)
        probability /= probability.sum(axis=1, keepdims=True)
        value = -(share * np.log(np.maximum(probability[np.arange(len(label)), label], 1e-30))).sum()
        slope = entry.T @ (share[:, None] * (probability - hot)) + penalty * change
        return value + 0.5 * penalty * (change**2).sum(), slope.ravel()

    change = minimize(loss, np.zeros(first.size), jac=True, method="L-BFGS-B", options={"maxiter": 60}).x
    last = first + change.reshape(first.shape)
    return (last[:-1] / scale[:, None]).astype(np.float32), last[-1].astype(np.float32)


def _left_out(
    start: tuple[np.ndarray, np.ndarray], before: np.ndarray, label: np.ndarray, polygon: np.ndarray,
    folds: Sequence[np.ndarray], penalty: float,
) -> tuple[list[np.ndarray], list[np.ndarray]]:  # fmt: skip
    """(scores, labels) of polygons left out of the fit, a pair of lists with an array per fold."""
    scores, labels = [], []
    for fold in folds:
        out = np.isin(polygon, fold)
        _, own = np.unique(polygon[~out], return_inverse=True)
        weight, bias = _fitted(start, before[~out], label[~out], own, penalty)
        scores.append(before[out] @ weight + bias)
        labels.append(label[out])
    return scores, labels
