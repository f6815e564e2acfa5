"""Adaptation of an emissivity map to one scene by a few labelled polygons.

The last layers of its networks are refitted together, with a penalty on the change of their weights. Whole polygons are
left out in turn to choose the penalty and calibrate the uncertainties, because texels of one polygon look alike. In a
group of surfaces with labels, the labels and not the land cover decide which material it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from thermorender.apps.training.emissivity_training import Labelled, fitted_spread
from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity.features import NAMES, NEAR, features
from thermorender.learned.emissivity.land_cover import group_of, shares_of
from thermorender.learned.emissivity.mapping import MOST_MATERIALS, EmissivityMap, hidden, softmax, to_grid

# Penalties tried, from almost free to almost fixed weights.
_PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1)
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
    more = materials[len(model.materials) :]
    width = len(model.networks[0][-1][1])
    outputs = (*model.outputs, *range(width, width + len(more)))
    texels, truth, polygon = [], [], []
    for number, (value, inside) in enumerate(polygons):
        texels.append(described[inside[generator.permutation(len(inside))[:most]]])
        truth.append(np.full(len(texels[-1]), outputs[materials.index(item.names[value])]))
        polygon.append(np.full(len(texels[-1]), number))
    found, label, of = map(np.concatenate, (texels, truth, polygon))
    standard = (found - model.mean) / model.scale
    before = np.stack([hidden(layers, standard) for layers in model.networks])
    start = _start(model, before, width + len(more))
    folds = np.array_split(generator.permutation(len(polygon)), min(_FOLDS, len(polygon)))
    scored = {penalty: _left_out(start, before, label, of, folds, penalty) for penalty in _PENALTIES}
    values = np.zeros(width + len(more))
    values[list(outputs)] = [emissivity(each) for each in materials]
    best = min(_PENALTIES, key=lambda penalty: _error(scored[penalty], values))
    weight, bias = _fitted(start, before, label, of, best)
    near = np.stack([standard[of == one][:, NEAR].mean(axis=0) for one in range(len(polygon))])
    about = {**model.about, "adapted_to": f"{len(polygon)} polygons: {item.source}", "adapted_from": model.name}
    if item.unused:
        about["unused_labels"] = item.unused
    groups = (*model.groups, *map(group_of, more))
    told = {groups[materials.index(item.names[value])] for value in present}
    own = (*model.own, *(1.0,) * len(more))
    new = replace(
        model, name=name, materials=tuple(materials), about=about,
        networks=tuple((*layers[:-1], last) for layers, last in zip(model.networks, zip(weight, bias, strict=True),
                                                                    strict=True)),
        centres=np.concatenate([model.centres, near.astype(np.float32)]), groups=groups,
        share=(*model.share, *shares_of(more)),
        own=tuple(1.0 if group in told else part for group, part in zip(groups, own, strict=True)), outputs=outputs,
    )  # fmt: skip
    place = np.zeros(width + len(more), np.int64)
    place[list(outputs)] = np.arange(len(outputs))
    tests = [(probability[:, outputs] @ new.levelling, place[each]) for probability, each in scored[best]]
    spread = fitted_spread(new, tests, values[list(outputs)])
    # Few polygons of one picture cannot show that the map is surer than it says.
    return replace(new, spread=(max(spread[0], 1.0), max(spread[1], 1.0)))


def _connected(mask: np.ndarray) -> list[np.ndarray]:
    """Texel numbers of each connected area of a mask, (h, w) bool, in a list."""
    import cv2

    number, part = cv2.connectedComponents(mask.astype(np.uint8))
    order = np.argsort(part, axis=None, kind="stable")
    return np.split(order, np.searchsorted(part.ravel()[order], np.arange(1, number)))[1:]


def _start(model: EmissivityMap, before: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Last layers, weights (M, H, C) and biases (M, C), with columns for `count` materials; new ones are improbable."""
    weights, biases = [], []
    for values, layers in zip(before, model.networks, strict=True):
        weight, bias = layers[-1]
        new = count - len(bias)
        lowest = np.float32((values @ weight + bias).max(axis=1).mean() + _NEW)
        # Labels may show materials that a network never saw.
        seen = np.maximum(bias, lowest)
        weights.append(np.hstack([weight, np.zeros((len(weight), new), np.float32)]))
        biases.append(np.append(seen, np.full(new, lowest)))
    return np.stack(weights), np.stack(biases)


def _fitted(
    start: tuple[np.ndarray, np.ndarray], before: np.ndarray, label: np.ndarray, polygon: np.ndarray, penalty: float
) -> tuple[np.ndarray, np.ndarray]:
    """Last layers fitted to texels by the likelihood of the networks' mean; each polygon counts the same."""
    from scipy.optimize import minimize

    weight, bias = start
    scale = before.std(axis=1)[:, :, None] + 1e-3
    first = np.concatenate([weight * scale, bias[:, None]], axis=1).astype(np.float64)
    ones = np.ones((*before.shape[:2], 1))
    entry = np.concatenate([before / scale.transpose(0, 2, 1), ones], axis=2).astype(np.float64)
    share = 1.0 / np.bincount(polygon)[polygon]
    share /= share.sum()
    texel = np.arange(len(label))
    # Each network sees a part of the misfit only.
    penalty /= len(first)

    def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
        change = flat.reshape(first.shape)
        probability = softmax(entry @ (first + change))
        right = probability[:, texel, label]
        whole = np.maximum(right.sum(axis=0), 1e-30)
        value = -(share * np.log(whole / len(right))).sum() + 0.5 * penalty * (change**2).sum()
        # Each network answers for a texel by its part of the right material's probability.
        part = share * right / whole
        slope = part[..., None] * probability
        slope[:, texel, label] -= part
        return value, (entry.transpose(0, 2, 1) @ slope + penalty * change).ravel()

    change = minimize(loss, np.zeros(first.size), jac=True, method="L-BFGS-B", options={"maxiter": 60}).x
    last = first + change.reshape(first.shape)
    return (last[:, :-1] / scale).astype(np.float32), last[:, -1].astype(np.float32)


def _left_out(
    start: tuple[np.ndarray, np.ndarray], before: np.ndarray, label: np.ndarray, polygon: np.ndarray,
    folds: Sequence[np.ndarray], penalty: float,
) -> list[tuple[np.ndarray, np.ndarray]]:  # fmt: skip
    """(probabilities, labels) of polygons left out of the fit, a pair per fold."""
    found = []
    for fold in folds:
        out = np.isin(polygon, fold)
        _, own = np.unique(polygon[~out], return_inverse=True)
        weight, bias = _fitted(start, before[:, ~out], label[~out], own, penalty)
        found.append((softmax(before[:, out] @ weight + bias[:, None]).mean(axis=0), label[out]))
    return found


def _error(scored: Sequence[tuple[np.ndarray, np.ndarray]], emissivity: np.ndarray) -> float:
    """Root mean square error of the emissivity of (probabilities, labels) pairs; `emissivity` is by output."""
    return float(np.sqrt(np.mean([
        np.mean((probability @ emissivity - emissivity[label]) ** 2) for probability, label in scored
    ])))  # fmt: skip
