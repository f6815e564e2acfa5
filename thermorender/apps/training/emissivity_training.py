"""Training of an emissivity map from orthophotos with known materials, fully or partly labelled.

A multilayer perceptron of scikit-learn is fitted to features of texels, drawn with rare materials favoured. Distances
between typical texels set the novelty threshold. One block of ground in five is held out for accuracy; probabilities
are calibrated on kinds of landscape (domains) left out of training in turn.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity.features import NEAR, features
from thermorender.learned.emissivity.mapping import MOST_MATERIALS, EmissivityMap, outputs, posterior, to_grid
from thermorender.progress import Progress

# Side of the blocks of ground that are trained on or held out as a whole [texels]: neighbours look alike, so holding
# out single texels would test nothing.
BLOCK_TEXELS = 24
_HELD_OUT_ONE_IN = 5
_HIDDEN = (96, 64)
_MOST_SAMPLES = 360_000
_MOST_PER_IMAGE = 150_000
_EPOCHS = 20
_CENTRES = 160
# Calibration: networks, texels each is fitted to and tested on, epochs.
_FOLDS, _CALIBRATION_SAMPLES, _CALIBRATION_TESTS, _CALIBRATION_EPOCHS = 4, 90_000, 30_000, 8
# Spread of a material's emissivity between samples.
_SAMPLE_STD = 0.01
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
    seed: int = 0, progress: Progress | None = None,
) -> tuple[EmissivityMap, np.ndarray]:  # fmt: skip
    """Return (EmissivityMap, confusion (C, C) int) trained on labelled orthophotos at a ground sampling distance [m].

    `emissivity` maps a material's name to its band emissivity. `augmentations` versions of each orthophoto with random
    exposure, white balance, contrast and saturation are added. Confusion has the true material in rows and the most
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
    count = np.bincount(truth[~held_out], minlength=len(names))
    _check_labels(sources, names, count)
    values = np.array([emissivity(name) for name in names])
    softening, prior = _calibration(described, truth, np.concatenate(domains), held_out, values, seed, report)
    drawn = _drawn(truth, np.flatnonzero(~held_out), count, generator)
    mean, scale = described[drawn].mean(axis=0), described[drawn].std(axis=0) + 1e-3
    standard = (described[drawn] - mean) / scale
    layers = _layers(standard, truth[drawn], len(names), seed, _EPOCHS, report)
    centres, distance = _centres(standard[:, NEAR], seed)
    model = EmissivityMap(
        name, tuple(names), float(texel_m), mean.astype(np.float32), scale.astype(np.float32),
        layers=tuple((weight.astype(np.float32), bias.astype(np.float32)) for weight, bias in layers),
        centres=centres.astype(np.float32),
        threshold=float(_THRESHOLD_MARGIN * np.quantile(distance, _THRESHOLD_QUANTILE)), about={},
        softening=softening, prior=prior,
    )  # fmt: skip
    confusion = _confusion(model, described[held_out], truth[held_out])
    accuracy = round(float(np.trace(confusion) / confusion.sum()), 4) if confusion.any() else None
    model.about.update(
        trained_on="; ".join(dict.fromkeys(sources)),
        split=f"one block of {BLOCK_TEXELS * texel_m:g} m in {_HELD_OUT_ONE_IN} held out",
        calibrated_on=f"{len(known)} kinds of land, each unseen" if len(known) > 1 else "held-out blocks",
        augmentations=augmentations, seed=seed, texels=len(drawn), held_out_texels=int(held_out.sum()),
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


def _calibration(
    described: np.ndarray, truth: np.ndarray, domain: np.ndarray, held_out: np.ndarray, emissivity: np.ndarray,
    seed: int, report: Progress,
) -> tuple[float, float]:  # fmt: skip
    """Return (softening, prior) fitted on domains that a network did not see, all of equal weight.

    With one domain, it is fitted on the held-out blocks, which resemble the training.
    """
    generator = np.random.Generator(np.random.Philox(seed))
    domains = np.unique(domain)
    folds = np.array_split(generator.permutation(domains), min(len(domains), _FOLDS))
    if len(domains) == 1:
        folds, domain = [np.array([1])], held_out.astype(np.int64)
    found, truths = [], []
    for number, fold in enumerate(folds):
        tested = np.isin(domain, fold)
        report("calibrating", number / len(folds))
        if tested.all() or not tested.any():
            continue
        # Materials get numbers within this training; others have no score there.
        inside = np.unique(truth[~tested])
        if len(inside) < 2:
            continue
        count = np.bincount(truth[~tested], minlength=inside.max() + 1)
        drawn = _drawn(truth, np.flatnonzero(~tested), count, generator, _CALIBRATION_SAMPLES)
        mean, scale = described[drawn].mean(axis=0), described[drawn].std(axis=0) + 1e-3
        own = np.searchsorted(inside, truth[drawn])
        layers = _layers((described[drawn] - mean) / scale, own, len(inside), seed, _CALIBRATION_EPOCHS, _quiet)
        test = generator.choice(np.flatnonzero(tested), min(_CALIBRATION_TESTS, int(tested.sum())), replace=False)
        score = np.full((test.size, int(truth.max()) + 1), -np.inf, dtype=np.float32)
        score[:, inside] = outputs(layers, (described[test] - mean) / scale)
        found.append(score)
        truths.append(truth[test])
    return fitted_posterior(found, truths, emissivity) if found else (1.0, 0.0)


def _quiet(what: str, share: float) -> None:
    """Report nothing."""


def fitted_posterior(
    scores: Sequence[np.ndarray], truths: Sequence[np.ndarray], emissivity: np.ndarray
) -> tuple[float, float]:
    """Return (softening, prior) of the largest likelihood of the emissivity of labels (N,) by scores (N, C).

    A texel's emissivity is normal with mean and standard deviation of the posterior over materials of `emissivity`
    (C,). A score of minus infinity marks a material unknown to that domain's network. Softening is 1…20, prior
    0.001…0.95; domains have equal weight.
    """
    from scipy.optimize import minimize

    def loss(free: np.ndarray) -> float:
        softening, prior = np.exp(free[0]), 1.0 / (1.0 + np.exp(-free[1]))
        return emissivity_loss(scores, truths, emissivity, softening, prior)

    bounds = [(0.0, np.log(20.0)), (np.log(0.001 / 0.999), np.log(0.95 / 0.05))]
    found = minimize(loss, [np.log(2.0), 0.0], bounds=bounds, method="L-BFGS-B")
    return float(np.exp(found.x[0])), float(1.0 / (1.0 + np.exp(-found.x[1])))


def emissivity_loss(
    scores: Sequence[np.ndarray], truths: Sequence[np.ndarray], emissivity: np.ndarray, softening: float, prior: float
) -> float:
    """Return the mean negative log-likelihood of the labels' emissivity, as in `fitted_posterior`."""
    parts = []
    for score, label in zip(scores, truths, strict=True):
        probability = posterior(score.astype(np.float64), softening, prior)
        mean = probability @ emissivity
        variance = np.maximum(probability @ emissivity**2 - mean**2, 0.0) + _SAMPLE_STD**2
        parts.append(0.5 * np.mean(np.log(variance) + (emissivity[label] - mean) ** 2 / variance))
    return float(np.mean(parts))


def _layers(
    standard: np.ndarray, truth: np.ndarray, count: int, seed: int, epochs: int, report: Progress
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(weight, bias) layers of a network fitted to standardised features."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPClassifier

    report("fitting the network", 0.0)
    network = MLPClassifier(
        _HIDDEN, alpha=1e-4, batch_size=256, learning_rate_init=2e-3, max_iter=1, warm_start=True, random_state=seed
    )
    with warnings.catch_warnings():
        # The number of epochs is fixed, so this warning is expected.
        warnings.simplefilter("ignore", ConvergenceWarning)
        for epoch in range(epochs):
            # The rate falls by a cosine.
            network.set_params(learning_rate_init=2e-3 * 0.5 * (1.0 + np.cos(np.pi * epoch / epochs)))
            network.fit(standard, truth)
            report("fitting the network", (epoch + 1) / epochs)
    layers = list(zip(network.coefs_, network.intercepts_, strict=True))
    if count == 2:
        # scikit-learn has one logistic output for two classes, which is a softmax over 0 and it.
        weight, bias = layers[-1]
        layers[-1] = (np.hstack([0.0 * weight, weight]), np.hstack([0.0 * bias, bias]))
    return layers


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
