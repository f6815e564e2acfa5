"""Training of an emissivity map from orthophotos with known materials, fully or partly labelled.

A small multilayer perceptron of scikit-learn is fitted to features of texels of each kind of land (domain), drawn with
rare materials favoured. Distances between typical texels set the novelty threshold. One block of ground in five is held
out for accuracy; uncertainties are calibrated on domains that the other domains' networks map.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity.features import NEAR, features
from thermorender.learned.emissivity.land_cover import group_of, levelling, shares_of
from thermorender.learned.emissivity.mapping import MOST_MATERIALS, EmissivityMap, Layers, averaged, to_grid
from thermorender.progress import Progress

# Side of the blocks of ground that are trained on or held out as a whole [texels]: neighbours look alike, so holding
# out single texels would test nothing.
BLOCK_TEXELS = 24
_HELD_OUT_ONE_IN = 5
# One hidden layer, regularised: a larger network learns its land by heart and errs more on others.
_HIDDEN, _WEIGHT_DECAY = (32,), 1e-2
_MOST_SAMPLES = 30_000
_MOST_PER_IMAGE = 60_000
# Texels of a step, and steps.
_BATCH, _STEPS = 256, 2000
_CENTRES = 160
# Texels of each domain that calibrate the uncertainties.
_CALIBRATION_TESTS = 30_000
# Least standard deviation of a mean, and that of a texel: samples of a material differ.
_LEAST_STD = (0.002, 0.01)
# The share of normal errors within one standard deviation.
_WITHIN_ONE = 0.6827
# Bias of a material that a network never saw.
_NEVER = -60.0
# Texels tested at a time.
_AT_ONCE = 200_000
# Novelty threshold: this quantile of the training texels' distances from their centres, times this margin.
_THRESHOLD_QUANTILE = 0.998
_THRESHOLD_MARGIN = 1.15


@dataclass(frozen=True)
class Labelled:
    """An orthophoto with labels."""

    rgb: np.ndarray  # (h, w, 3) uint8 sRGB
    material: np.ndarray  # (h, w) uint8 number of each texel's material in `names`; 0 where unknown
    names: dict[int, str]
    texel_m: float  # Ground sampling distance [m]
    source: str  # Origin, for the record
    domain: str = ""  # Kind of landscape, camera or season; calibration holds out whole domains
    unused: str = ""  # A sentence on labels that are on no texel, for the record


def train(
    labelled: Iterable[Labelled], texel_m: float, name: str, emissivity: Callable[[str], float], augmentations: int = 0,
    seed: int = 0, progress: Progress | None = None, own: float = 1.0,
) -> tuple[EmissivityMap, np.ndarray]:  # fmt: skip
    """Return (EmissivityMap, confusion (C, C) int) trained on labelled orthophotos at a ground sampling distance [m].

    `emissivity` maps a material's name to its band emissivity. `augmentations` versions of each orthophoto with random
    exposure, white balance, contrast and saturation are added. `own` is the part of a material's share in its group
    that the networks decide; the land cover decides the rest. Confusion has the true material in rows and the most
    probable one in columns, over the held-out ground.
    """
    try:
        import sklearn  # noqa: F401
    except ImportError:
        raise ThermorenderError(
            "training an emissivity map needs scikit-learn; install it with `pip install thermorender[train]`"
        ) from None
    report = progress or _quiet
    generator = np.random.Generator(np.random.Philox(seed))
    names: list[str] = []
    sources, unused, parts, domains = [], [], [], []
    labels = np.zeros(2, dtype=np.int64)
    known: dict[str, int] = {}
    for number, item in enumerate(labelled):
        report("describing the orthophotos", number / (number + 5.0))  # their number is not known in advance
        sources.append(item.source)
        unused += [item.unused] if item.unused else []
        labels += np.array([np.count_nonzero(item.material), item.material.size])
        for found, values, held in _described(item, texel_m, name, augmentations, generator):
            parts.append((found, _numbered(values, item.names, names), held))
            known.setdefault(item.domain or item.source, len(known))
            domains.append(np.full(held.size, known[item.domain or item.source]))
    described, truth, held_out = map(np.concatenate, zip(*parts, strict=True))
    domain = np.concatenate(domains)
    _check_labels(sources, names, np.bincount(truth[~held_out], minlength=len(names)))
    drawn = []
    for number in range(len(known)):
        allowed = np.flatnonzero(~held_out & (domain == number))
        drawn.append(_drawn(truth, allowed, np.bincount(truth[allowed], minlength=len(names)), generator))
    every = np.concatenate(drawn)
    mean, scale = described[every].mean(axis=0), described[every].std(axis=0) + 1e-3
    networks: list[Layers] = []
    for number, texels in enumerate(drawn):
        standard = (described[texels] - mean) / scale
        networks.append(_network(standard, truth[texels], len(names), seed, report, (number, len(drawn))))
    centres, distance = _centres(((described[every] - mean) / scale)[:, NEAR], seed)
    groups, share = tuple(map(group_of, names)), shares_of(names)
    model = EmissivityMap(
        name, tuple(names), float(texel_m), mean.astype(np.float32), scale.astype(np.float32), tuple(networks),
        centres.astype(np.float32), float(_THRESHOLD_MARGIN * np.quantile(distance, _THRESHOLD_QUANTILE)), {},
        groups, share, (float(own),) * len(names),
    )  # fmt: skip
    values = np.array([emissivity(name) for name in names])
    spread = fitted_spread(model, _left_out(model, described, truth, domain, held_out, generator), values)
    if len(networks) == 1:
        # Held-out blocks look like the training, so they cannot show that the map is surer than it says.
        spread = max(spread[0], 1.0), max(spread[1], 1.0)
    model = replace(model, spread=spread)
    confusion = _confusion(model, described[held_out], truth[held_out])
    accuracy = round(float(np.trace(confusion) / confusion.sum()), 4) if confusion.any() else None
    model.about.update(
        trained_on="; ".join(dict.fromkeys(sources)),
        split=f"one block of {BLOCK_TEXELS * texel_m:g} m in {_HELD_OUT_ONE_IN} held out",
        calibrated_on=f"{len(known)} kinds of land, each unseen" if len(known) > 1 else "held-out blocks",
        augmentations=augmentations, seed=seed, texels=len(every), held_out_texels=int(held_out.sum()),
        held_out_accuracy=accuracy,
    )  # fmt: skip
    untested = [name for name, row in zip(names, confusion, strict=True) if not row.any()]
    not_tested = [f"{', '.join(untested)}, of which no texel was held out"] if untested else []
    if labels[0] < labels[1]:
        not_tested.append(f"{1.0 - labels[0] / labels[1]:.0%} of the ground, which has no label")
    if unused:
        model.about["unused_labels"] = "; ".join(unused)
    if not_tested:
        model.about["not_tested"] = "; ".join(not_tested)
    return model, confusion


def _numbered(values: np.ndarray, own: Mapping[int, str], names: list[str]) -> np.ndarray:
    """Labels as indices into `names`, a list that grows by the names of new labels; `own` is {label: name}."""
    names += dict.fromkeys(own[value] for value in np.unique(values) if own[value] not in names)
    return np.asarray(np.array([names.index(own[k]) if own.get(k) in names else 0 for k in range(256)])[values])


def _check_labels(sources: Sequence[str], names: Sequence[str], count: np.ndarray) -> None:
    """Raise ThermorenderError if there are too many materials, or too few texels to train on; `count` is per name."""
    if len(names) > MOST_MATERIALS:
        raise ThermorenderError(
            f"{', '.join(sources)} name {len(names)} materials, but an emissivity map has 2…{MOST_MATERIALS}; label "
            "fewer"
        )
    if len(names) < 2 or (count == 0).any():
        missing = [n for n, k in zip(names, count, strict=True) if k == 0]
        raise ThermorenderError(
            f"an emissivity map needs texels of two or more materials, but {', '.join(sources)} "
            + (f"has too few of {', '.join(missing)}" if missing else f"has those of {', '.join(names) or 'none'} only")
            + "; label more ground"
        )


def _left_out(
    model: EmissivityMap, described: np.ndarray, truth: np.ndarray, domain: np.ndarray, held_out: np.ndarray,
    generator: np.random.Generator,
) -> list[tuple[np.ndarray, np.ndarray]]:  # fmt: skip
    """Pairs (probabilities (N, C), true materials (N,)) of texels of each domain, by the networks of the others.

    With one domain, they are of the held-out blocks, which resemble the training.
    """
    tests = []
    for number in np.unique(domain):
        alone = len(model.networks) == 1
        here = np.flatnonzero(held_out if alone else domain == number)
        here = generator.choice(here, min(_CALIBRATION_TESTS, here.size), replace=False)
        others = model.networks if alone else [each for k, each in enumerate(model.networks) if k != number]
        if here.size:
            standard = (described[here] - model.mean) / model.scale
            tests.append((averaged(others, standard) @ model.levelling, truth[here]))
    return tests


def _quiet(what: str, share: float) -> None:
    """Report nothing."""


def fitted_spread(
    model: EmissivityMap, tests: Sequence[tuple[np.ndarray, np.ndarray]], emissivity: np.ndarray
) -> tuple[float, float]:
    """Return the factors of `materials.mixture.Doubt` with which 68 % of the errors are within a standard deviation.

    `tests` are (probabilities (N, C), true materials (N,)); each counts the same. `emissivity` (C,) is the materials'.
    The true mean of a texel is that of its material's group, with shares of the land cover, which no test can judge.
    """
    group_mean = levelling(model.groups, model.share, (0.0,) * len(emissivity)) @ emissivity
    ratios: tuple[list[float], list[float]] = ([], [])
    for probability, label in tests:
        mean, *deviations = model.spreads(probability, emissivity)[:3]
        for found, truth, std, least in zip(ratios, (group_mean, emissivity), deviations, _LEAST_STD, strict=True):
            ratio = np.abs(mean - truth[label]) / np.hypot(std, least)
            found.append(float(np.quantile(ratio, _WITHIN_ONE)))
    # No few lands show that a map is more than ten times surer, or less sure, than it says.
    factors = [float(np.exp(np.mean(np.log(np.clip(each, 0.1, 10.0))))) if each else 1.0 for each in ratios]
    return factors[0], factors[1]


def _network(
    standard: np.ndarray, truth: np.ndarray, count: int, seed: int, report: Progress, number: tuple[int, int]
) -> Layers:
    """(weight, bias) layers of a network fitted to standardised features; `number` is (its own, all)."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPClassifier

    inside, own = np.unique(truth, return_inverse=True)
    if len(inside) == 1:
        # Nothing but this material was seen there; scikit-learn asks for two.
        only = np.full(count, _NEVER, np.float32)
        only[inside[0]] = 0.0
        sizes = [standard.shape[1], *_HIDDEN]
        first = [(np.zeros(each, np.float32), np.zeros(each[1], np.float32)) for each in pairwise(sizes)]
        return (*first, (np.zeros((_HIDDEN[-1], count), np.float32), only))
    epochs = max(1, round(_STEPS * _BATCH / len(own)))
    network = MLPClassifier(
        _HIDDEN, alpha=_WEIGHT_DECAY, batch_size=min(_BATCH, len(own)), learning_rate_init=2e-3, max_iter=1,
        warm_start=True, random_state=seed,
    )  # fmt: skip
    with warnings.catch_warnings():
        # The number of epochs is fixed, so this warning is expected.
        warnings.simplefilter("ignore", ConvergenceWarning)
        for epoch in range(epochs):
            # The rate falls by a cosine.
            network.set_params(learning_rate_init=2e-3 * 0.5 * (1.0 + np.cos(np.pi * epoch / epochs)))
            network.fit(standard, own)
            report("fitting the networks", (number[0] + (epoch + 1) / epochs) / number[1])
    *before, (weight, bias) = zip(network.coefs_, network.intercepts_, strict=True)
    if len(inside) == 2:
        # scikit-learn has one logistic output for two classes, which is a softmax over 0 and it.
        weight, bias = np.hstack([0.0 * weight, weight]), np.hstack([0.0 * bias, bias])
    wide, all_biases = np.zeros((len(weight), count)), np.full(count, _NEVER)
    wide[:, inside], all_biases[inside] = weight, bias
    return tuple((np.float32(w), np.float32(b)) for w, b in (*before, (wide, all_biases)))  # type: ignore[misc]


def _centres(near: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(cluster centres (K, n) of features (N, n), each row's distance from the nearest)."""
    from sklearn.cluster import MiniBatchKMeans
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        clusters = MiniBatchKMeans(min(_CENTRES, len(near)), random_state=seed, n_init=1, batch_size=4096)
        distance = clusters.fit_transform(near).min(axis=1)
    return clusters.cluster_centers_, distance


def _confusion(model: EmissivityMap, described: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Counts (C, C) of (true material, most probable material) over texels."""
    confusion = np.zeros((len(model.materials),) * 2, dtype=np.int64)
    for start in range(0, len(truth), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        np.add.at(confusion, (truth[part], model.probabilities(described[part])[0].argmax(axis=-1)), 1)
    return confusion


def _described(
    item: Labelled, texel_m: float, name: str, augmentations: int, generator: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield (features (n, F), labels (n,), held out (n,)) of an orthophoto and its augmented versions."""
    import cv2

    nothing = np.zeros(0, np.float32)
    grid = EmissivityMap(name, (), texel_m, nothing, nothing, (), nothing, 0.0, {})
    rgb = to_grid(item.rgb, item.texel_m, grid)
    # Nearest-neighbour labels, so that shares of labels are shares of area where texels are mixed.
    labels = cv2.resize(item.material, rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    rows, columns = np.nonzero(labels)
    across = -(-labels.shape[1] // BLOCK_TEXELS)
    block = rows // BLOCK_TEXELS * across + columns // BLOCK_TEXELS
    blocks = across * -(-labels.shape[0] // BLOCK_TEXELS)
    held = (generator.permutation(blocks) % _HELD_OUT_ONE_IN == 0)[block]
    for number in range(1 + augmentations):
        image = rgb if number == 0 else _augmented(rgb, generator)
        keep = generator.random(rows.size) < _MOST_PER_IMAGE / max(rows.size, 1)
        yield features(image)[rows[keep], columns[keep]], labels[rows[keep], columns[keep]], held[keep]


def _augmented(rgb: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return an orthophoto with random resolution, haze, exposure, colour, sharpening and JPEG compression."""
    import cv2

    image: np.ndarray = rgb / np.float32(255.0)
    blur = generator.uniform(0.0, 1.2)
    if blur > 0.3:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    haze = np.float32(generator.uniform(0.0, 0.25))
    image = image * (1 - haze) + haze * np.array((0.75, 0.8, 0.88), np.float32)
    balance = np.exp(generator.normal(0.0, 0.3) + generator.normal(0.0, 0.1, 3))
    image = image ** np.float32(np.exp(generator.normal(0.0, 0.2))) * balance.astype(np.float32)
    grey = image.mean(axis=-1, keepdims=True)
    image = grey + np.float32(np.exp(generator.normal(0.0, 0.35))) * (image - grey)
    sharpening = np.float32(generator.uniform(0.0, 1.0))
    image = image + sharpening * (image - cv2.GaussianBlur(image, (0, 0), 1.5))
    image = np.clip(255.0 * image + 0.5, 0, 255).astype(np.uint8)
    _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(generator.integers(40, 98))])
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))


def _drawn(
    truth: np.ndarray, allowed: np.ndarray, count: np.ndarray, generator: np.random.Generator, most: int = _MOST_SAMPLES
) -> np.ndarray:
    """Texels to train on, each at most once; each material's number is proportional to the square root of its area."""
    wish = np.sqrt(count / count.sum())
    wish = most * wish / wish.sum()
    chance = np.minimum(wish / np.maximum(count, 1), 1.0)[truth[allowed]]
    return allowed[generator.random(allowed.size) < chance]
