"""RGB → emissivity: the likely materials of each texel of an orthophoto, from its colour and texture.

A small fully connected network for each kind of land of its training scores the materials, and the networks'
probabilities are averaged (Lakshminarayanan et al. 2017, "Simple and scalable predictive uncertainty estimation using
deep ensembles"): on land unlike any of these, they err in different ways. Within a group of surfaces, shares of the
land cover replace most of what the networks say (`land_cover`). A texel's emissivity, from the material table, is the
mean with these probabilities. It has two uncertainties, of the group's mean and of the texel's own material
(`materials.mixture.Doubt`). Confidence is the largest probability, or 0 for texels unlike the training data. Below a
threshold, texels are *unknown* and get the scene's fallback material.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from thermorender import files, formats
from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity.features import HALO_TEXELS, NAMES, NEAR, features
from thermorender.learned.emissivity.land_cover import levelling, mean_std_of
from thermorender.materials.mixture import Doubt

SHIPPED = {"procedural": Path(__file__).with_name("procedural.npz")}
# Materials are bytes in rasters, where 0 means no picture and 255 an unknown material.
MOST_MATERIALS = 254
# An orthophoto may be this many times coarser than the map's grid; beyond, texture looks different.
COARSEST_RATIO = 2.5
# Largest deviation of a map projection's scale from 1 that texels of nominal size are allowed.
_PROJECTION = 0.005
_TILE_TEXELS = 512  # on the map's grid
_CHUNK_TEXELS = 8192
_FORMAT = 4
# Probability of any material before others are excluded.
_LEAST = 1e-12


# A network: (weight, bias) layers of rectified linear units, softmax at the end.
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclass(frozen=True, eq=False)
class EmissivityMap:
    """A trained RGB → materials map."""

    name: str
    materials: tuple[str, ...]  # Names of its C materials, in the order of its probabilities
    texel_m: float  # Ground sampling distance of its training [m]
    # mean, scale: (F,) float32 mean and scale that standardise the features
    mean: np.ndarray
    scale: np.ndarray
    networks: tuple[Layers, ...]  # Whose probabilities of the C materials are averaged
    centres: np.ndarray  # (K, len(NEAR) typical standardised features of the training texels' near surroundings
    threshold: float  # Distance from the nearest centre above which a texel is unlike the training data
    # Its training: scenes, seeds, split, accuracy on held-out texels, and what was not tested
    about: dict[str, Any]
    groups: tuple[str, ...] = ()  # Group of each material, by default itself
    share: tuple[float, ...] = ()  # Share of each material in its group, by the land cover
    own: tuple[float, ...] = ()  # Part of each material's share in its group that the networks decide, by default all
    spread: tuple[float, float] = (1.0, 1.0)  # Factors of `materials.mixture.Doubt`
    outputs: tuple[int, ...] = ()  # The networks' output of each material, by default all in their order

    def __post_init__(self) -> None:
        """Make each material a group of its own, which the networks decide, where nothing else is given."""
        ones = (1.0,) * len(self.materials)
        numbers = tuple(range(len(self.materials)))
        for name, default in (("groups", self.materials), ("share", ones), ("own", ones), ("outputs", numbers)):
            object.__setattr__(self, name, getattr(self, name) or default)

    @cached_property
    def levelling(self) -> np.ndarray:
        """The matrix (C, C) from probabilities of the networks to those with shares of the land cover."""
        return levelling(self.groups, self.share, self.own)

    def doubt(self, materials: Sequence[str]) -> Doubt:
        """Return the Doubt on materials by name: the map's own, and others that are groups of their own."""
        group = dict(zip(self.materials, self.groups, strict=True))
        groups = tuple(group.get(name, name) for name in materials)
        return Doubt(groups, tuple(map(mean_std_of, groups)), self.spread)

    def moments(self, probability: np.ndarray, emissivity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (mean, standard deviation of a mean over many such texels, of one texel) of emissivities, (…) each.

        `probability` (…, C) is in any unit and `emissivity` (C,) the materials'. See `materials.mixture.Doubt`.
        """
        mean, between, within, unsure = self.spreads(probability, emissivity)
        of_mean, of_texel = self.spread
        mean_std = np.hypot(of_mean * between, unsure)
        # A texel varies at least as much as the mean that it is a part of.
        return mean, mean_std, np.maximum(np.hypot(of_texel * within, unsure), mean_std)

    def spreads(self, probability: np.ndarray, emissivity: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return (mean, standard deviation between groups, between materials, uncertainty of groups' means), (…) each.

        `probability` and `emissivity` are those of `moments`.
        """
        total = probability.sum(axis=-1, keepdims=True, dtype=np.float32)
        share = probability / np.maximum(total, np.float32(1e-12))
        value, mean = np.asarray(emissivity, np.float32), share @ np.float32(emissivity)
        between = np.zeros_like(mean)
        groups = np.array(self.groups)
        for group in dict.fromkeys(self.groups):
            inside = groups == group
            part = share[..., inside].sum(axis=-1)
            own = share[..., inside] @ value[inside] / np.maximum(part, np.float32(1e-12))
            between += part * (own - mean) ** 2
        within = np.maximum(share @ value**2 - mean**2, 0.0)
        unsure = share @ np.array([*map(mean_std_of, self.groups)], np.float32)
        return mean, np.sqrt(between), np.sqrt(within), unsure

    def probabilities(self, described: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (probabilities (N, C) float32, novelty (N,) float32) of features, (N, F).

        Novelty is the distance from the nearest centre over `threshold`; above 1, a texel is unlike the training data.
        """
        standard = (described - self.mean) / self.scale
        # On condition that materials which were left out do not occur.
        value = averaged(self.networks, standard)[:, self.outputs] + np.float32(_LEAST)
        value = value / value.sum(axis=-1, keepdims=True) @ self.levelling
        near = standard[:, NEAR]
        squared = (self.centres**2).sum(axis=-1) - 2.0 * (near @ self.centres.T)
        distance = np.sqrt(np.maximum(squared.min(axis=-1) + (near**2).sum(axis=-1), 0.0))
        return value, distance / np.float32(self.threshold)

    def without(self, materials: Sequence[str]) -> "EmissivityMap":
        """Return this map for land where some of its materials are known not to occur."""
        self._require(materials, "to leave out")
        kept = [k for k, material in enumerate(self.materials) if material not in materials]
        if len(kept) < 2:
            raise ThermorenderError(
                f"emissivity map {self.name!r} has {len(kept)} materials left without {', '.join(materials)}; "
                "keep two or more"
            )

        def of_kept(values: Sequence[Any]) -> tuple[Any, ...]:
            return tuple(values[k] for k in kept)

        return replace(
            self, materials=of_kept(self.materials), groups=of_kept(self.groups), share=of_kept(self.share),
            own=of_kept(self.own), outputs=of_kept(self.outputs),
        )  # fmt: skip

    def with_shares(self, stated: Mapping[str, float]) -> "EmissivityMap":
        """Return this map for land where materials have stated shares of their groups; others share the rest."""
        self._require(stated, "to give a share")
        share = np.array(self.share)
        for group in {self.groups[self.materials.index(name)] for name in stated}:
            inside = [k for k, each in enumerate(self.groups) if each == group]
            given = {k: stated[self.materials[k]] for k in inside if self.materials[k] in stated}
            if all(self.own[k] == 1.0 for k in inside):
                raise ThermorenderError(
                    f"labels decide which {group} it is in emissivity map {self.name!r}; leave out the shares of "
                    f"{', '.join(self.materials[k] for k in given)}"
                )
            rest, total = [k for k in inside if k not in given], sum(given.values())
            if total > 1.0 + 1e-9 or (not rest and abs(total - 1.0) > 1e-9):
                names = ", ".join(f"{self.materials[k]}={value:g}" for k, value in given.items())
                raise ThermorenderError(
                    f"the stated shares {names} of the group {group!r} sum to {total:g}; give shares of a group that "
                    f"sum to {'1' if not rest else 'at most 1'}"
                )
            left = share[rest].sum()
            for k in inside:
                share[k] = given[k] if k in given else (1.0 - total) * share[k] / max(left, 1e-12)
        return replace(self, share=tuple(share.tolist()))

    def _require(self, materials: Iterable[str], why: str) -> None:
        """Raise ThermorenderError for materials that the map does not have."""
        for material in materials:
            if material not in self.materials:
                raise ThermorenderError(
                    f"emissivity map {self.name!r} does not have the material {material!r} {why}; it has "
                    f"{', '.join(self.materials)} besides those left out"
                )

    def __str__(self) -> str:
        size = " → ".join(str(len(bias)) for _, bias in self.networks[0])
        lines = [
            f"{self.name}: RGB → {len(self.materials)} materials at {self.texel_m:g} m",
            f"  materials     {', '.join(self.materials)}",
            f"  networks      {len(self.networks)} of {len(self.mean)} features → {size}",
            *(f"  {key:13s} {value}" for key, value in self.about.items()),
        ]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class Mapped:
    """The materials of an orthophoto by a map."""

    probability: np.ndarray  # (h, w, C) uint8 probability of every material, in 1/255
    confidence: np.ndarray  # (h, w) float32 largest probability; 0 where the texel is unlike the training data

    @cached_property
    def index(self) -> np.ndarray:
        """The three most probable materials, best first, (h, w, 3) uint8 indices of `EmissivityMap.materials`."""
        rest = self.probability.astype(np.int16)
        found = np.zeros((*rest.shape[:2], 3), np.uint8)
        for rank in range(min(rest.shape[2], 3)):
            found[..., rank] = rest.argmax(axis=-1)
            np.put_along_axis(rest, found[..., rank : rank + 1].astype(np.int64), -1, axis=-1)
        return found

    @cached_property
    def share(self) -> np.ndarray:
        """Their probabilities, scaled to a sum of one; 0 for the third of two materials. (h, w, 3) float32."""
        found = np.take_along_axis(self.probability, self.index.astype(np.int64), axis=-1).astype(np.float32)
        found[..., self.probability.shape[2] :] = 0.0
        return found / found.sum(axis=-1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What else is known on the materials of a picture's texels."""

    number: np.ndarray  # (h, w) uint8 number of each texel's case
    # (N, M) float32 factors on the probabilities of the materials in each of N cases. A factor of 0 excludes a
    # material; each case leaves one or more. Materials beyond the map's C occur only where all of the map's are
    # excluded.
    factor: np.ndarray


def hidden(layers: Layers, standard: np.ndarray) -> np.ndarray:
    """Return the values before a network's last layer, (N, H), of standardised features (N, F)."""
    for weight, bias in layers[:-1]:
        standard = np.maximum(standard @ weight + bias, 0.0)
    return standard


def softmax(score: np.ndarray) -> np.ndarray:
    """Return the probabilities, (N, C), of scores (N, C)."""
    value = np.exp(score - score.max(axis=-1, keepdims=True))
    return np.asarray(value / value.sum(axis=-1, keepdims=True))


def averaged(networks: Sequence[Layers], standard: np.ndarray) -> np.ndarray:
    """Return the mean probabilities of networks, (N, C), of standardised features (N, F)."""
    total = sum(softmax(hidden(layers, standard) @ layers[-1][0] + layers[-1][1]) for layers in networks)
    return np.asarray(total / np.float32(len(networks)))


def map_materials(
    model: EmissivityMap, rgb: np.ndarray, texel_m: float, progress: Callable[[float], object] | None = None,
    keep: Callable[[slice, slice, np.ndarray], object] | None = None, evidence: Sequence[Evidence] = (),
    name: str = "the picture",
) -> Mapped:  # fmt: skip
    """Return the Mapped of an orthophoto, (h, w, 3) uint8 sRGB of ground sampling distance `texel_m` [m].

    It is resampled to the model's, and the probabilities back, in tiles that need about 0.4 GB besides the result.
    `keep` (rows, columns, probabilities (C, h', w')) is called for each tile, `progress` with the share done. Each
    Evidence multiplies the probabilities, which are then normalised. `name` is the orthophoto's, for messages.
    """
    import cv2

    on_grid = to_grid(rgb, texel_m, model, name)
    shape, grid_shape = rgb.shape[:2], on_grid.shape[:2]
    ratio = [of_grid / of_texels for of_grid, of_texels in zip(grid_shape, shape, strict=True)]
    materials = evidence[0].factor.shape[1] if evidence else len(model.materials)
    result = Mapped(np.zeros((*shape, materials), np.uint8), np.zeros(shape, np.float32))
    # Whole blocks of tiled rasters, for callers that write what `keep` receives.
    tile = int(np.clip(_TILE_TEXELS / max(ratio) // 256, 1, 6)) * 256
    starts = [(top, left) for top in range(0, shape[0], tile) for left in range(0, shape[1], tile)]
    for number, (top, left) in enumerate(starts):
        here = (slice(top, min(top + tile, shape[0])), slice(left, min(left + tile, shape[1])))
        # Positions of the tile's texel centres on the model's grid, and the part of that grid around them.
        position = [(np.arange(part.start, part.stop) + 0.5) * r - 0.5 for part, r in zip(here, ratio, strict=True)]
        inner = [
            (max(int(np.floor(line[0])), 0), min(int(np.floor(line[-1])) + 2, size))
            for line, size in zip(position, grid_shape, strict=True)
        ]
        found = _on_grid(model, on_grid, inner)
        if grid_shape != shape:
            rows, columns = ((line - low).astype(np.float32) for line, (low, _) in zip(position, inner, strict=True))
            x, y = np.meshgrid(columns, rows)
            planes = [cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in found]
            found = np.stack(planes)
        else:
            found = found[:, : here[0].stop - top, : here[1].stop - left]
        novelty = found[-1]
        probabilities, known = _with_evidence(found[:-1], novelty <= 1.0, here, evidence)
        if keep:
            keep(*here, probabilities)
        result.probability[here] = np.moveaxis(np.rint(255.0 * probabilities), 0, -1)
        result.confidence[here] = np.where(known, probabilities.max(axis=0), 0.0)
        if progress:
            progress((number + 1) / len(starts))
    return result


def _with_evidence(
    probabilities: np.ndarray, known: np.ndarray, here: tuple[slice, slice], evidence: Sequence[Evidence]
) -> tuple[np.ndarray, np.ndarray]:
    """Return (probabilities (C, h, w), known (h, w)) of a tile after evidence.

    Where evidence excludes materials of a texel unlike the training data, the others are equally probable.
    """
    for each in evidence:
        number, materials = each.number[here], each.factor.shape[1]
        excludes = ~known & (each.factor == 0.0).any(axis=1)[number]
        planes = np.zeros((materials, *known.shape), np.float32)
        planes[: len(probabilities)] = probabilities
        # What is left may be below the smallest number.
        planes += np.float32(_LEAST)
        planes[:, excludes] = 1.0
        for plane, factor in zip(planes, each.factor.T, strict=True):
            plane *= factor[number]
        planes /= planes.sum(axis=0)
        probabilities, known = planes, known | excludes
    return probabilities, known


def to_grid(rgb: np.ndarray, texel_m: float, model: EmissivityMap, name: str = "the picture") -> np.ndarray:
    """Return an orthophoto, (h, w, 3) uint8, resampled to the ground sampling distance of an EmissivityMap."""
    import cv2

    # A nominal texel differs from its size on the ground by the scale of the map projection.
    if not texel_m <= (1.0 + _PROJECTION) * COARSEST_RATIO * model.texel_m:
        raise ThermorenderError(
            f"{name} has texels of {texel_m:.3g} m, but emissivity map {model.name!r} was trained at "
            f"{model.texel_m:g} m and takes at most {COARSEST_RATIO * model.texel_m:g} m; give a finer one, or "
            "train a map on it with `thermorender train emissivity`"
        )
    size = [max(1, round(n * texel_m / model.texel_m)) for n in rgb.shape[:2]]
    if abs(texel_m / model.texel_m - 1.0) < 0.02:
        return rgb
    finer = texel_m < model.texel_m
    return cv2.resize(rgb, size[::-1], interpolation=cv2.INTER_AREA if finer else cv2.INTER_CUBIC)


def _on_grid(model: EmissivityMap, image: np.ndarray, inner: Sequence[tuple[int, int]]) -> np.ndarray:
    """Probabilities of a part of an image on the model's grid and, last, its novelty, (C + 1, h, w) float32."""
    (top, bottom), (left, right) = inner
    up, over = max(top - HALO_TEXELS, 0), max(left - HALO_TEXELS, 0)
    part = image[up : bottom + HALO_TEXELS, over : right + HALO_TEXELS]
    described = features(part)[top - up : bottom - up, left - over : right - over]
    described = described.reshape(-1, len(NAMES))
    planes = np.empty((len(model.materials) + 1, len(described)), dtype=np.float32)
    # A chunk of texels fits the processor's cache.
    for start in range(0, len(described), _CHUNK_TEXELS):
        chunk = slice(start, start + _CHUNK_TEXELS)
        probabilities, planes[-1, chunk] = model.probabilities(described[chunk])
        planes[:-1, chunk] = probabilities.T
    return planes.reshape(-1, bottom - top, right - left)


def save_map(model: EmissivityMap, path: files.PathLike) -> None:
    """Write an EmissivityMap as arrays and a JSON text, .npz."""
    head = {
        "format": _FORMAT, "name": model.name, "materials": model.materials, "texel_m": model.texel_m,
        "features": NAMES, "threshold": model.threshold, "groups": model.groups, "share": model.share,
        "own": model.own, "spread": model.spread, "outputs": model.outputs,
        "layers": [len(layers) for layers in model.networks], "about": model.about,
    }  # fmt: skip
    arrays: dict[str, Any] = {"head": np.array(json.dumps(head))}
    arrays |= {"mean": model.mean, "scale": model.scale, "centres": model.centres}
    for network, layers in enumerate(model.networks):
        for number, (weight, bias) in enumerate(layers):
            arrays[f"weight{network}.{number}"], arrays[f"bias{network}.{number}"] = weight, bias
    with files.atomic(path) as part, open(part, "wb") as file:
        np.savez_compressed(file, **arrays)


def load_map(name: files.PathLike) -> EmissivityMap:
    """Return the EmissivityMap of a file, or a shipped one by name."""
    path = SHIPPED.get(str(name), Path(name))
    if not path.is_file():
        raise ThermorenderError(
            f"emissivity map {str(name)!r} does not exist; give a file made by `thermorender train emissivity`, "
            f"or {', '.join(SHIPPED)}"
        )
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            head = formats.finite_json(str(file["head"]))
            if (head["format"], tuple(head["features"])) != (_FORMAT, NAMES):
                raise ValueError("it was made by another version or for other features")
            networks = tuple(
                tuple((_floats(file[f"weight{k}.{n}"]), _floats(file[f"bias{k}.{n}"])) for n in range(count))
                for k, count in enumerate(head["layers"])
            )
            model = EmissivityMap(
                str(head["name"]), tuple(map(str, head["materials"])), float(head["texel_m"]), _floats(file["mean"]),
                _floats(file["scale"]), networks, _floats(file["centres"]), float(head["threshold"]),
                dict(head["about"]), tuple(map(str, head["groups"])), tuple(map(float, head["share"])),
                tuple(map(float, head["own"])), (float(head["spread"][0]), float(head["spread"][1])),
                tuple(map(int, head["outputs"])),
            )  # fmt: skip
        _check(model)
    # A damaged file can raise many kinds of errors in zipfile, zlib, json or NumPy.
    except Exception as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise ThermorenderError(
            f"{path} is not an emissivity map ({reason}); make one with `thermorender train emissivity`"
        ) from None
    return model


def _floats(values: np.ndarray) -> np.ndarray:
    """Values from a file as float32; ValueError if they are not finite."""
    values = np.asarray(values, dtype=np.float32)
    if not np.isfinite(values).all():
        raise ValueError("it holds numbers that are not finite")
    return values


def _check(model: EmissivityMap) -> None:
    """Raise ValueError if arrays do not fit each other or there are too many materials."""
    if not 2 <= len(model.materials) <= MOST_MATERIALS:
        raise ValueError(f"it has {len(model.materials)} materials, not 2…{MOST_MATERIALS}")
    # Last layers are updated together, so they take values of one width.
    fits = len({layers[-1][0].shape[0] for layers in model.networks if layers}) == 1
    for layers in model.networks:
        widths = [len(NAMES), *(len(bias) for _, bias in layers)]
        shapes = [weight.shape for weight, _ in layers]
        fits &= shapes == list(zip(widths[:-1], widths[1:], strict=True))
        fits &= bool(layers) and min(model.outputs) >= 0 and max(model.outputs) < widths[-1]
    fits &= model.mean.shape == model.scale.shape == (len(NAMES),) and model.centres.shape[1:] == (len(NEAR),)
    if len(set(model.materials)) < len(model.materials):
        raise ValueError("it names a material twice")
    of_materials = (model.groups, model.share, model.own, model.outputs)
    fits &= all(len(each) == len(model.materials) for each in of_materials)
    fits &= all(0.0 <= value <= 1.0 for value in (*model.share, *model.own)) and len(model.centres) > 0
    fits &= all(0.01 <= factor <= 100.0 for factor in model.spread) and len(set(model.outputs)) == len(model.outputs)
    total = dict.fromkeys(model.groups, 0.0)
    for group, share in zip(model.groups, model.share, strict=fits):
        total[group] += share
    fits &= min(total.values(), default=0.0) > 0.0
    if not (fits and (model.scale > 0.0).all() and model.texel_m > 0.0 and model.threshold > 0.0):
        raise ValueError("its arrays do not fit each other")
