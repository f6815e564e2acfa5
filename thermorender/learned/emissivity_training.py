"""Training of an emissivity map from orthophotos whose materials are known, wholly or here and there.

The recipe: bring each orthophoto to one ground sampling distance, optionally augment it, describe
every texel, draw texels with rare materials favoured, fit scikit-learn's multilayer perceptron, and note how far
typical texels lie from each other, so that a texel unlike all of them is found out later. One block of ground in
five is never trained on and tells the accuracy.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity import MOST_MATERIALS, EmissivityMap, to_grid
from thermorender.learned.emissivity_features import NEAR, features

# Side of the blocks of ground that are trained on or held out as a whole [texels]: neighbours look alike, so single
# texels held out would be no test.
BLOCK_TEXELS = 24
_HELD_OUT_ONE_IN = 5
_HIDDEN = (96, 64)
_MOST_SAMPLES = 360_000
_MOST_PER_IMAGE = 400_000
_EPOCHS = 20
_CENTRES = 160
# The novelty threshold: this quantile of the training texels' distances from their centres, times this margin.
_THRESHOLD_QUANTILE = 0.998
_THRESHOLD_MARGIN = 1.15


@dataclass(frozen=True)
class Labelled:
    """An orthophoto and what is known of it.

    Attributes
    ----------
    rgb : (h, w, 3) uint8
        sRGB.
    material : (h, w) uint8
        Number of each texel's material in `names`; 0 where it is unknown.
    names : dict of int to str
    texel_m : float
        Ground sampling distance [m].
    source : str
        Where it comes from, for the record.
    """

    rgb: np.ndarray
    material: np.ndarray
    names: dict
    texel_m: float
    source: str


def train(labelled, texel_m, name, augmentations=0, seed=0, progress=None):
    """Return (EmissivityMap, confusion (C, C) int) trained on labelled orthophotos.

    Parameters
    ----------
    labelled : iterable of Labelled
    texel_m : float
        Ground sampling distance to train at [m].
    name : str
        Of the map.
    augmentations : int
        How many times each orthophoto is also taken with random exposure, white balance, contrast and saturation. Use
        it where the map is meant for other orthophotos than these.
    seed : int
        Same seed, same map (with the same versions of the libraries).
    progress : callable (what, share), optional

    Returns
    -------
    confusion : rows the true material, columns the most probable one, counted over the ground held out.

    Raises
    ------
    ThermorenderError
        scikit-learn is missing, an orthophoto is too coarse, or fewer than two materials have texels to train on.
    """
    try:
        from sklearn.cluster import MiniBatchKMeans
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.neural_network import MLPClassifier
    except ImportError:
        raise ThermorenderError(
            "training an emissivity map needs scikit-learn; install it with `pip install thermorender[train]`"
        ) from None
    tell = progress or (lambda what, share: None)
    generator = np.random.Generator(np.random.Philox(seed))
    described, truth, held_out, names, sources, labels = [], [], [], [], [], np.zeros(2, dtype=np.int64)
    for number, item in enumerate(labelled):
        tell("describing the orthophotos", number / (number + 5.0))  # how many come is not known before the last
        sources.append(item.source)
        labels += np.count_nonzero(item.material), item.material.size
        for found, values, held in _described(item, texel_m, name, augmentations, generator):
            for value in np.unique(values):
                if item.names[value] not in names:
                    names.append(item.names[value])
            number_of = np.array([names.index(item.names[k]) if k in item.names and item.names[k] in names else 0
                                  for k in range(256)])  # fmt: skip
            described.append(found)
            truth.append(number_of[values])
            held_out.append(held)
    described, truth, held_out = (np.concatenate(parts) for parts in (described, truth, held_out))
    if len(names) > MOST_MATERIALS:
        raise ThermorenderError(
            f"{', '.join(sources)} name {len(names)} materials; an emissivity map tells 2…{MOST_MATERIALS} apart, so "
            "label fewer"
        )
    count = np.bincount(truth[~held_out], minlength=len(names))
    if len(names) < 2 or (count == 0).any():
        missing = [n for n, k in zip(names, count, strict=True) if k == 0]
        raise ThermorenderError(
            f"an emissivity map needs texels of two or more materials, but {', '.join(sources)} "
            + (f"has too few of {', '.join(missing)}" if missing else f"has those of {', '.join(names) or 'none'} only")
            + "; label more ground"
        )
    drawn = _drawn(truth, np.flatnonzero(~held_out), count, generator)
    mean, scale = described[drawn].mean(axis=0), described[drawn].std(axis=0) + 1e-3
    standard = (described[drawn] - mean) / scale
    tell("fitting the network", 0.0)
    network = MLPClassifier(
        _HIDDEN, alpha=1e-4, batch_size=256, learning_rate_init=2e-3, max_iter=1, warm_start=True, random_state=seed
    )
    with warnings.catch_warnings():
        # The number of passes is given; that the fit would change further is no news.
        warnings.simplefilter("ignore", ConvergenceWarning)
        for epoch in range(_EPOCHS):
            # Large steps first, then smaller and smaller ones.
            network.set_params(learning_rate_init=2e-3 * 0.5 * (1.0 + np.cos(np.pi * epoch / _EPOCHS)))
            network.fit(standard, truth[drawn])
            tell("fitting the network", (epoch + 1) / _EPOCHS)
    layers = list(zip(network.coefs_, network.intercepts_, strict=True))
    if len(names) == 2:
        # One logistic output stands for two materials: a softmax over 0 and it.
        weight, bias = layers[-1]
        layers[-1] = (np.hstack([0.0 * weight, weight]), np.hstack([0.0 * bias, bias]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        clusters = MiniBatchKMeans(min(_CENTRES, len(standard)), random_state=seed, n_init=1, batch_size=4096)
        distance = clusters.fit_transform(standard[:, NEAR]).min(axis=1)
    model = EmissivityMap(
        name=name,
        materials=tuple(names),
        texel_m=float(texel_m),
        mean=np.float32(mean),
        scale=np.float32(scale),
        layers=tuple((np.float32(weight), np.float32(bias)) for weight, bias in layers),
        centres=np.float32(clusters.cluster_centers_),
        threshold=float(_THRESHOLD_MARGIN * np.quantile(distance, _THRESHOLD_QUANTILE)),
        about={},
    )
    confusion = np.zeros((len(names), len(names)), dtype=np.int64)
    for start in range(0, held_out.sum(), 200_000):
        part = np.flatnonzero(held_out)[start : start + 200_000]
        best = model.probabilities(described[part])[0].argmax(axis=-1)
        np.add.at(confusion, (truth[part], best), 1)
    model.about.update(
        trained_on="; ".join(sources),
        split=f"one block of {BLOCK_TEXELS * texel_m:g} m in {_HELD_OUT_ONE_IN} held out",
        augmentations=augmentations,
        seed=seed,
        texels=len(drawn),
        held_out_texels=int(held_out.sum()),
        held_out_accuracy=round(float(np.trace(confusion) / confusion.sum()), 4) if confusion.any() else None,
    )
    untested = [name for name, row in zip(names, confusion, strict=True) if not row.any()]
    not_tested = [f"{', '.join(untested)}, of which no texel was held out"] if untested else []
    if labels[0] < labels[1]:
        not_tested.append(f"{1.0 - labels[0] / labels[1]:.0%} of the ground, which has no label")
    if not_tested:
        model.about["not_tested"] = "; ".join(not_tested)
    return model, confusion


def _described(item, texel_m, name, augmentations, generator):
    """Yield (features (n, F), labels (n,), held out (n,)) of an orthophoto as it is and augmented."""
    import cv2

    grid = EmissivityMap(name, (), texel_m, None, None, (), None, 0.0, {})
    rgb = to_grid(item.rgb, item.texel_m, grid)
    # The texel at the middle lends its label: where texels are mixed, shares of labels then are shares of area.
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


def _augmented(rgb, generator):
    """Return an orthophoto as another camera on another day might have given it."""
    exposure = np.exp(generator.normal(0.0, 0.3))
    balance = np.exp(generator.normal(0.0, 0.06, 3))
    contrast = np.exp(generator.normal(0.0, 0.15))
    saturation = np.exp(generator.normal(0.0, 0.3))
    image = (rgb / np.float32(255.0)) ** np.float32(contrast) * np.float32(exposure * balance)
    grey = image.mean(axis=-1, keepdims=True)
    image = grey + np.float32(saturation) * (image - grey)
    return np.clip(255.0 * image + 0.5, 0, 255).astype(np.uint8)


def _drawn(truth, allowed, count, generator):
    """Texels to train on: of each material in proportion to the square root of its area, each at most once."""
    wish = np.sqrt(count / count.sum())
    wish = _MOST_SAMPLES * wish / wish.sum()
    chance = np.minimum(wish / np.maximum(count, 1), 1.0)[truth[allowed]]
    return allowed[generator.random(allowed.size) < chance]
