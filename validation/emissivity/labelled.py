"""Learned emissivity on labelled aerial pictures: five groups of ground, whose mean emissivity is the truth.

The labels say water, bare land, road, building or vegetation, not the material. A texel's true emissivity is therefore
taken as the mean of the library's materials of its group. Which materials lie there is the larger uncertainty, so two
tables judge: the whole GROUPS, and one whose bare land is soils and sand alone. A constant for the whole set, chosen
with the labels, is the strictest rival.
"""

from pathlib import Path

import numpy as np

from thermorender.apps.compare.figures import pyplot, save
from thermorender.apps.training.emissivity_adaptation import adapted
from thermorender.apps.training.emissivity_training import Labelled
from thermorender.apps.training.material_training import band_emissivity_of
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.formats import decoded
from thermorender.learned.emissivity.mapping import load_map, map_materials
from thermorender.materials.extended import within_band
from thermorender.materials.library import load_library
from thermorender.physics.planck import band_radiance, brightness_temperature

GROUPS = {
    "water": ("water",),
    "bare land": ("soil_loam", "soil_dark", "soil_arid", "sand_quartz", "granite", "limestone", "leaf_litter"),
    "road": ("asphalt", "concrete"),
    "building": ("roof_shingle", "roof_slate", "roof_rubber", "roof_tile_clay", "roof_felt", "metal_painted", "glass",
                 "wood", "concrete"),
    "vegetation": ("grass_green", "grass_dry", "heath_shrub", "conifer", "broadleaf"),
}  # fmt: skip
# Bare land of the second table.
SOILS = ("soil_loam", "soil_dark", "soil_arid", "sand_quartz")
JUDGES = ("groups", "soils")
# A map's further materials count to these groups; those of the table above to the first that names them.
_FURTHER = {"steel_galvanised_oxidised": "building", "cement": "building", "snow": "water"}
# Apparent temperatures are of ground of this temperature under these skies [K].
_GROUND_K, SKIES_K = 300.0, {"clear": 250.0, "cloudy": 285.0}
HEADER = ("set", "tiles", "judge", "accuracy", "balanced", "mean |Δε|", "constant 0.95", "÷ 0.95", "best constant",
          "clear [K]", "cloudy [K]", "1 σ", "2 σ", "σ of mean", "σ of texel")  # fmt: skip
UPDATED_HEADER = ("set", "pictures", "|Δε| before", "after", "constant 0.95", "balanced before", "after", "1 σ",
                  "2 σ")  # fmt: skip
_PER_TILE = 20_000
# The material that labelled squares of each group name, and their side [m].
_NAMED, _SQUARE_M = ("water", "soil_loam", "asphalt", "roof_shingle", "grass_green"), 10.0


def run(folders, texel_m, model="procedural", seed=0, progress=None):
    """Return {model, sets: {name: record}} of labelled folders.

    Parameters
    ----------
    folders : sequence of path
        Each holds NAME.jpg with NAME_label.png, the number of the group in the order of GROUPS, 255 for none.
    texel_m : sequence of float
        Ground sampling distance of each folder [m].
    model : str
        Name or file of the emissivity map.
    seed : int
        Seed of the texels that are judged.
    progress : callable, optional
        Called with (step, share done).

    Raises
    ------
    ThermorenderError
        A folder without labelled pictures, or one distance too few.
    """
    if len(folders) != len(texel_m):
        raise ThermorenderError(f"{len(folders)} folders have {len(texel_m)} ground sampling distances; give one each")
    model = load_map(model)
    emissivity, group, truth = _tables(model)
    sets = {}
    for folder, metres in zip(map(Path, folders), texel_m, strict=True):
        labels = sorted(folder.glob("*_label.png"))
        if not labels:
            raise ThermorenderError(f"{folder} has no NAME_label.png; give a folder of labelled pictures")
        random = np.random.Generator(np.random.Philox(seed))
        parts = []
        for number, path in enumerate(labels):
            if progress:
                progress(f"{folder.name}, {path.stem}", number / len(labels))
            mapped, label, _ = _mapped(model, path, metres)
            known = np.flatnonzero(label.ravel() < len(GROUPS))
            known = random.choice(known, min(_PER_TILE, known.size), replace=False)
            probability = mapped.probability.reshape(-1, len(model.materials))[known] / 255.0
            probability /= probability.sum(axis=1, keepdims=True)
            parts.append((probability, label.ravel()[known]))
        probability, label = map(np.concatenate, zip(*parts, strict=True))
        sets[folder.name] = {"tiles": len(labels), "texel_m": metres,
                             **_scores(model, probability, label, emissivity, group, truth)}  # fmt: skip
    tables = {judge: dict(zip(GROUPS, table.round(4).tolist(), strict=True))
              for judge, table in zip(JUDGES, truth, strict=True)}  # fmt: skip
    return {"model": model.name, "about": model.about, "tables": tables, "sets": sets}


def updated(folders, texel_m, squares=10, tiles=5, model="procedural", seed=0, progress=None):
    """Return {set: record} of maps that squares of each picture update, scored on the rest of the picture.

    Parameters
    ----------
    folders, texel_m, model, seed, progress
        As for `run`.
    squares : int
        Labelled squares of 10 m, as many of each group as there are.
    tiles : int
        Pictures of each folder, evenly spaced; those with squares of a single group are left out.

    Notes
    -----
    A square's label names one material of the group, which then stands for the group's mean emissivity.
    """
    import cv2

    model, found = load_map(model), {}
    for folder, metres in zip(map(Path, folders), texel_m, strict=True):
        random = np.random.Generator(np.random.Philox(seed))
        labels = sorted(folder.glob("*_label.png"))
        records = []
        for number, path in enumerate(labels[:: max(1, len(labels) // tiles)][:tiles]):
            if progress:
                progress(f"{folder.name}, {path.stem}, {squares} squares", number / tiles)
            before, label, rgb = _mapped(model, path, metres)
            drawn = _squares(label, round(_SQUARE_M / metres), squares, random)
            if len(np.unique(drawn[drawn > 0])) < 2:
                continue  # one group cannot update a map
            names = dict(enumerate(_NAMED, 1))
            new = adapted(model, Labelled(rgb, drawn, names, metres, path.stem), "updated", band_emissivity_of())
            rest = np.flatnonzero((label.ravel() < len(GROUPS)) & (drawn.ravel() == 0))
            rest = random.choice(rest, min(_PER_TILE, rest.size), replace=False)
            pair = []
            for each, mapped in ((model, before), (new, map_materials(new, rgb, metres))):
                emissivity, group, truth = _tables(each)
                if each is new:
                    for value, name in enumerate(_NAMED):
                        emissivity[each.materials.index(name)] = truth[0, value]
                probability = mapped.probability.reshape(-1, len(each.materials))[rest] / 255.0
                probability /= probability.sum(axis=1, keepdims=True)
                pair.append(_scores(each, probability, label.ravel()[rest], emissivity, group, truth))
            count = cv2.connectedComponents((drawn > 0).astype(np.uint8))[0] - 1
            records.append({"picture": path.stem, "squares": count, "before": pair[0], "after": pair[1]})
        if records:
            found[folder.name] = records
    return found


def updated_rows(result):
    """Return table rows of text under UPDATED_HEADER: means over the pictures of each set, by the first judge."""
    return [
        (name, str(len(records)), *(f"{np.mean([one[when]['groups']['error'] for one in records]):.4f}"
                                    for when in ("before", "after")),
         f"{np.mean([one['after']['groups']['constant_095'] for one in records]):.4f}",
         *(f"{np.mean([one[when]['balanced'] for one in records]):.2f}" for when in ("before", "after")),
         *(f"{np.mean([one['after']['groups']['within'][times] for one in records]):.0%}" for times in (0, 1)))
        for name, records in result.items()
    ]  # fmt: skip


def rows(result):
    """Return table rows of text under HEADER: each set by each judge."""
    return [
        (name, str(one["tiles"]), judge, f"{one['accuracy']:.2f}", f"{one['balanced']:.2f}",
         f"{one[judge]['error']:.4f}", f"{one[judge]['constant_095']:.4f}",
         f"{one[judge]['error'] / one[judge]['constant_095']:.2f}", f"{one[judge]['best_constant']:.4f}",
         f"{one[judge]['kelvin']['clear']:.2f}", f"{one[judge]['kelvin']['cloudy']:.2f}",
         *(f"{share:.0%}" for share in one[judge]["within"]), f"{one['mean_std']:.3f}", f"{one['std']:.3f}")
        for name, one in result["sets"].items() for judge in JUDGES
    ]  # fmt: skip


def figure(path, result):
    """Draw the calibration: the share of texels whose error is below a multiple of σ, for each set."""
    drawing, axis = pyplot().subplots(figsize=(5.6, 4.6), layout="constrained")
    at = np.array(_MULTIPLES)
    for name, one in result["sets"].items():
        axis.plot(at, one["groups"]["calibration"], label=name)
    from scipy.special import erf

    axis.plot(at, erf(at / np.sqrt(2.0)), color="0.5", linestyle="--", label="normal distribution")
    axis.set(xlabel="multiple of the stated standard deviation", ylabel="share of texels with a smaller error",
             xlim=(0, at[-1]), ylim=(0, 1))  # fmt: skip
    axis.legend(fontsize=8)
    axis.grid(lw=0.3, color="0.85")
    save(drawing, path)


def pictures(path, labels, texel_m, model="procedural"):
    """Draw labelled pictures beside their labels, learned emissivity and its standard deviations, one row each."""
    model = load_map(model)
    emissivity, _, truth = _tables(model)
    drawing, axes = pyplot().subplots(
        len(labels), 5, figsize=(17.0, 3.4 * len(labels)), layout="constrained", squeeze=False
    )
    for row, (label_path, metres) in enumerate(zip(labels, texel_m, strict=True)):
        mapped, label, rgb = _mapped(model, Path(label_path), metres)
        mean, mean_std, std = model.moments(mapped.probability, emissivity)
        true = np.append(truth[0], np.full(256 - len(GROUPS), np.nan))[label]
        axes[row, 0].imshow(rgb)
        for axis, image, (low, high), title in (
            (axes[row, 1], true, (0.9, 0.99), "mean of the labelled group"),
            (axes[row, 2], mean, (0.9, 0.99), "learned emissivity"),
            (axes[row, 3], mean_std, (0.0, 0.03), "standard deviation of a mean"),
            (axes[row, 4], std, (0.0, 0.06), "standard deviation of a texel"),
        ):
            drawing.colorbar(axis.imshow(image, vmin=low, vmax=high, cmap="viridis"), ax=axis, shrink=0.8)
            axis.set_title(title, fontsize=9)
        axes[row, 0].set_title(Path(label_path).stem.removesuffix("_label"), fontsize=9)
        for axis in axes[row]:
            axis.set_axis_off()
    save(drawing, path)


def first(folders, texel_m, count=2):
    """Return (paths, distances) of the first labelled pictures of each folder."""
    found = [(path, metres) for folder, metres in zip(folders, texel_m, strict=True)
             for path in sorted(Path(folder).glob("*_label.png"))[:count]]  # fmt: skip
    return tuple(zip(*found, strict=True))


_MULTIPLES = np.linspace(0.0, 3.0, 31).tolist()


def _tables(model):
    """(emissivity (C,) and group (C,) of a map's materials, true emissivity of each group by JUDGES (2, G))."""
    library = load_library()
    named = {*model.materials, *(name for group in GROUPS.values() for name in group)} & set(library)
    mean = {name: float(within_band(library[name], BAND_UM, library, name).band_emissivity(*BAND_UM, _GROUND_K))
            for name in named}  # fmt: skip
    names = list(GROUPS)
    of = {name: names.index(_FURTHER[name]) for name in _FURTHER}
    for number, group in reversed(list(enumerate(GROUPS.values()))):
        of |= dict.fromkeys(group, number)
    truth = np.array([
        [np.mean([mean[name] for name in group]) for group in table.values()]
        for table in (GROUPS, {**GROUPS, "bare land": SOILS})
    ])  # fmt: skip
    unknown = [name for name in model.materials if name not in of or name not in mean]
    if unknown:
        raise ThermorenderError(f"map {model.name!r} has {', '.join(unknown)}, which belong to no group; add them")
    return np.array([mean[n] for n in model.materials]), np.array([of[n] for n in model.materials]), truth


def _mapped(model, label_path, texel_m):
    import cv2

    picture = label_path.with_name(label_path.name.replace("_label.png", ".jpg"))
    rgb, label = decoded(picture.read_bytes(), cv2.IMREAD_COLOR), decoded(label_path.read_bytes(), cv2.IMREAD_GRAYSCALE)
    if rgb is None or label is None or rgb.shape[:2] != label.shape:
        raise ThermorenderError(f"{picture} and {label_path} are not pictures of one size; give them as JPEG and PNG")
    rgb = np.ascontiguousarray(rgb[..., ::-1])
    return map_materials(model, rgb, texel_m), label, rgb


def _squares(label, side, count, random):
    """Numbers 1… of the groups (h, w) uint8 in squares of one label, 0 elsewhere; the groups take turns."""
    drawn = np.zeros(label.shape, np.uint8)
    texels = {value: np.flatnonzero(label == value) for value in range(len(GROUPS))}
    groups = [value for value, where in texels.items() if where.size > 0.02 * label.size]
    made = 0
    for attempt in range(300 * count if groups else 0):
        value = groups[attempt % len(groups)]
        top, left = divmod(int(random.choice(texels[value])), label.shape[1])
        part = (slice(top, top + side), slice(left, left + side))
        around = drawn[max(top - 2, 0) : top + side + 2, max(left - 2, 0) : left + side + 2]
        if label[part].shape == (side, side) and (label[part] == value).mean() > 0.97 and not around.any():
            drawn[part] = value + 1
            made += 1
        if made == count:
            break
    return drawn


def _scores(model, probability, label, emissivity, group, truth):
    likely = np.stack([probability[:, group == number].sum(axis=1) for number in range(len(GROUPS))], axis=1).argmax(1)
    mean, mean_std, std = model.moments(probability, emissivity)
    present = np.unique(label)
    found = {
        "texels": int(label.size), "accuracy": float((likely == label).mean()),
        "balanced": float(np.mean([(likely == label)[label == number].mean() for number in present])),
        "recall": {name: float((likely == label)[label == number].mean())
                   for number, name in enumerate(GROUPS) if number in present},
        "mean_std": float(mean_std.mean()), "std": float(std.mean()),
    }  # fmt: skip
    for judge, table in zip(JUDGES, truth, strict=True):
        true = table[label]
        error = np.abs(mean - true)
        constants = [float(np.abs(value - true).mean()) for value in np.arange(0.85, 1.0, 0.001)]
        found[judge] = {
            "error": float(error.mean()), "constant_095": float(np.abs(0.95 - true).mean()),
            "best_constant": min(constants),
            "kelvin": {name: float(np.abs(_apparent(mean, sky) - _apparent(true, sky)).mean())
                       for name, sky in SKIES_K.items()},
            "within": [float((error / mean_std < times).mean()) for times in (1.0, 2.0)],
            "calibration": [float((error / mean_std < times).mean()) for times in _MULTIPLES],
        }  # fmt: skip
    return found


def _apparent(emissivity, sky_k):
    own, sky = (float(band_radiance(value, *BAND_UM)) for value in (_GROUND_K, sky_k))
    return brightness_temperature(emissivity * own + (1.0 - emissivity) * sky, *BAND_UM)
