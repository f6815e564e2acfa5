"""Training of a learned temperature map on a data set: the method's inputs, and the map's metadata."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.apps.training.bounds import Bounds, bounds_of_dataset
from thermorender.apps.training.cut import Cut, moved
from thermorender.apps.training.dataset import Dataset, Entry, ThermalScale
from thermorender.apps.training.map_inputs import depth_of, ground_of, inputs_of
from thermorender.apps.training.networks.runs import read_settings
from thermorender.apps.training.task import Example, Task
from thermorender.apps.training.training_methods import METHODS, method
from thermorender.errors import ThermorenderError
from thermorender.learned.fingerprints import Fingerprints, fingerprints_of, stored_numbers
from thermorender.learned.temperature_map import ASSUMED_SKY_K, Inputs, TemperatureMap
from thermorender.learned.training_level import LevelSums, TrainingLevel
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.progress import Progress
from thermorender.units import ZERO_CELSIUS_K
from thermorender.versions import version_of, versions

# Lowest temperature of intensity 0 [K], below any sky's in the band. Chosen.
_COLDEST_K = 150.0
# A map's stated error is measured on this many evenly spaced pairs of those that are left out, and its level on as many
# of training, at every n-th row and column.
_ERROR_PAIRS = 60
_EVERY = 4
# With fewer validation pairs, the error is cross-validated in so many folds.
_FEW_PAIRS, _FOLDS = 30, 5
# Conditions whose range over the training pairs is recorded.
_RANGES = ("air_k", "wind_m_s", "snow_m", "sun_elevation_deg", "solar_hour", "day")


def train_map(
    name: str, method_name: str, dataset: Dataset, options: Mapping[str, Any] | None = None, seed: int = 0,
    progress: Progress | None = None, parts: Sequence[str] = ("train", "validation"), material: bool = False,
    shift_px: float = 0.0, share: float = 1.0, run: str | Path | None = None, resume: bool = False,
    best: bool = False, judged: bool = True,
) -> TemperatureMap:  # fmt: skip
    """Return the TemperatureMap of a method, trained on some parts of a Dataset.

    `options` replace the method's defaults. `material` adds the true material of each pixel (a privileged map).
    `shift_px` is the length of a random shift of each thermal picture [px]. `share` is that of the sequences, evenly
    spaced. `run` is the folder of a network's training; `best` takes the best state there, with the run's own options
    and seed, without training on. `judged` also measures `error_k`, on pairs outside of the fit: the validation part,
    for which the map is fitted again without it, or by cross-validation where that part has fewer than 30. A network is
    judged on every second validation sequence; the others choose its best state.

    Intensity 0 and 1 are 1.5 interquartile ranges beyond the quartiles of the training values (equation 2 of the
    published method), with 0 at 150 K or above; saturated pixels are left out. The published correlations were fitted
    on training and validation.
    """
    how, report_progress = method(method_name), progress or (lambda task, fraction: None)
    if best:
        assert run is not None
        settings = read_settings(run)
        if settings["method"] != method_name:
            raise ThermorenderError(
                f"--run={str(run)!r} holds a training of {settings['method']!r}, not {method_name!r}; give its method"
            )
        options, seed = {**settings["options"], **(options or {})}, settings["seed"]
    options = checked_options(method_name, how.options, options or {})
    if material:
        _refuse_privileged(method_name)
    pairs, cut = _some(dataset.of(*parts), share), Cut(shift_px=shift_px, seed=seed)
    if not len(pairs):
        raise ThermorenderError(f"{dataset.folder} has no pairs in {' or '.join(parts)}; give a split that has some")
    refuse_missing_conditions(method_name, pairs)
    report_progress("counting values", 0.0)
    scale, usable = dataset.scale, ~_saturated(dataset.card, np.arange(65536))
    bounds = bounds_of_dataset(dataset.of("train") if len(dataset.of("train")) else pairs, usable)
    range_k = _range_k(scale, bounds)
    cold, warm = band_radiance(np.array(range_k), *scale.band_um)
    depth = pairs.pair(pairs.entries[0], truth=False).thermal.dtype
    radiance = scale.radiance(np.arange(np.iinfo(depth).max + 1))
    with np.errstate(invalid="ignore"):
        kelvin = brightness_temperature(np.maximum(radiance, 1e-6), *scale.band_um)
    started = time.perf_counter()
    texel_m, texel_range_m = _sampling(pairs.entries)

    def fit(some: Dataset) -> Any:
        held = np.array([entry.part == "validation" for entry in some.entries])
        task = Task(
            _Examples(some, how.plus, options, material, cut, usable), (radiance - cold) / (warm - cold), kelvin, seed,
            report_progress, options, texel_m, texel_range_m, held if held.any() and not held.all() else None,
            None if run is None else Path(run), resume, best,
        )  # fmt: skip
        return how.fit(task)

    tests = held_out(dataset, pairs, how.long)
    predictor = fit(tests[0][0] if how.long and tests else pairs)
    # A resumed training records the time of all its runs.
    seconds = getattr(predictor, "trained", {}).get("seconds", time.perf_counter() - started)
    skies = [entry.sky_temperature for entry in pairs.entries if entry.sky_temperature]
    made = TemperatureMap(
        name=name, method=method_name, predictor=predictor, range_k=range_k, band_um=scale.band_um,
        texel_m=texel_m, texel_range_m=texel_range_m, camera=dataset.card.get("camera", "unknown"),
        sky_temperature=float(np.mean(skies)) if skies else ASSUMED_SKY_K,
        source=f"{method_name} on {_name_of(dataset, len(pairs))}", fingerprints=_fingerprints(pairs),
        level=level_of(pairs, kelvin, usable),
    )  # fmt: skip
    about = _about(dataset, pairs, parts, bounds, {"shift_px": shift_px, "share": share}) | {
        "options": options, "seed": seed, "training_s": round(seconds, 2),
        "training": getattr(predictor, "trained", {}), "versions": versions() | _library(method_name),
    }  # fmt: skip
    made = replace(made, about=about)
    if not judged:
        return made
    report_progress("measuring the error", 0.0)
    fits = [(made if how.long or len(kept) == len(pairs) else replace(made, predictor=fit(kept)), out)
            for kept, out in tests]  # fmt: skip
    return _with_error(made, fits, material)


def held_out(dataset: Dataset, pairs: Dataset, network: bool) -> list[tuple[Dataset, Dataset]]:
    """Return [(pairs to fit, pairs left out)] for the error of a map of some `pairs` of a Dataset; empty: unknown.

    Those left out are whole sequences, unless they are the validation part. A network's best state is chosen by the
    validation pairs that it keeps.
    """
    held = dataset.of("validation")
    if network:
        names = list(dict.fromkeys(entry.sequence for entry in held.entries))
        out = held.having([entry for entry in held.entries if entry.sequence in names[1::2]])
        keys = {entry.key for entry in out.entries}
        return [(pairs.having([entry for entry in pairs.entries if entry.key not in keys]), out)] if keys else []
    train = pairs.of("train")
    if len(held) >= _FEW_PAIRS and len(train):
        return [(train, held)]
    keys = {entry.key for entry in pairs.entries}
    every = dataset.having([*pairs.entries, *(entry for entry in held.entries if entry.key not in keys)])
    names = list(dict.fromkeys(entry.sequence for entry in every.entries))
    count = min(_FOLDS, len(names))
    if count < 2:
        return [(train, held)] if len(train) and len(held) else []
    fold = {name: number % count for number, name in enumerate(names)}

    def of_fold(number: int, out: bool) -> Dataset:
        return every.having([entry for entry in every.entries if (fold[entry.sequence] == number) == out])

    return [(of_fold(number, False), of_fold(number, True)) for number in range(count)]


def level_of(pairs: Dataset, kelvin: np.ndarray, usable: np.ndarray) -> TrainingLevel | None:
    """Return the TrainingLevel of the ground of some evenly spaced pairs.

    `kelvin`, (n,) [K], and `usable`, (65536,) bool, are by value of the thermal picture.
    """
    sums = LevelSums()
    for entry in _some_evenly(pairs):
        pair = pairs.pair(entry, truth=("material",))
        part = np.s_[::_EVERY, ::_EVERY]
        values = pair.thermal[part]
        known = ground_of(pair)[part] & usable[values] & np.isfinite(kelvin[values])
        sums.add(pair.visible[part][known], kelvin[values][known], entry.conditions.get("air_k"))
    return sums.level()


def _some_evenly(pairs: Dataset) -> list[Entry]:
    """Entries of at most `_ERROR_PAIRS` evenly spaced pairs."""
    count = len(pairs)
    return [pairs.entries[k] for k in np.unique(np.linspace(0, count - 1, min(_ERROR_PAIRS, count)).astype(int))]


def _fingerprints(pairs: Dataset) -> Fingerprints:
    """Fingerprints of the training pictures, or of as many as a map stores."""
    some = [pairs.entries[k] for k in stored_numbers(len(pairs))]
    return fingerprints_of((pairs.pair(entry, truth=False).visible for entry in some), len(pairs))


def _library(method_name: str) -> dict[str, str | None]:
    """{name: version} of the library that fitted a method, beside NumPy."""
    name = "torch" if method(method_name).long else "lightgbm" if method_name.startswith("trees") else None
    return {} if name is None else {name: version_of(name)}


def _sampling(entries: Sequence[Entry]) -> tuple[float | None, tuple[float, float] | None]:
    """(median, (least, most)) ground sampling distance of entries [m]; None where one has none."""
    if not all(entry.texel_m for entry in entries):
        return None, None
    known = np.array([entry.texel_m for entry in entries])
    return float(np.exp(np.median(np.log(known)))), (float(known.min()), float(known.max()))


def _name_of(dataset: Dataset, count: int) -> str:
    """Words for the training pairs of a map's source."""
    rendered = ", rendered from procedural scenes" if dataset.card.get("origin") == "rendered" else ""
    return f"{count} pairs of {dataset.card.get('name', dataset.folder.name)}{rendered}"


def _about(
    dataset: Dataset, pairs: Dataset, parts: Sequence[str], bounds: Bounds, shares: dict[str, float]
) -> dict[str, Any]:
    """What a map records of its training pairs."""
    return {
        "dataset": {key: dataset.card.get(key) for key in ("name", "origin", "licence", "camera")},
        "sky_assumed": not any(entry.sky_temperature for entry in pairs.entries),
        "pairs": {part: len(pairs.of(part)) for part in parts}, **shares,
        "sequences": len({entry.sequence for entry in pairs.entries}),
        "conditions": _ranges(pairs.entries), "bounds": [bounds.low, bounds.high], "unit": dataset.scale.unit,
    }  # fmt: skip


def _range_k(scale: ThermalScale, bounds: Bounds) -> tuple[float, float]:
    """Temperatures of intensity 0 and 1 [K]."""
    if scale.unit == "intensity":
        assert scale.range_c is not None
        cold_c, warm_c = scale.range_c
        return cold_c + ZERO_CELSIUS_K, warm_c + ZERO_CELSIUS_K
    # With much sky in the pictures, the lower bound may be a negative radiance.
    ends = np.maximum(scale.radiance([bounds.low, bounds.high]), band_radiance(_COLDEST_K, *scale.band_um))
    cold_k, warm_k = map(float, brightness_temperature(ends, *scale.band_um))
    return cold_k, warm_k


class _Examples(Sequence[Example]):
    """Examples of a Dataset's pairs, read on demand; `usable` is (65536,) bool by value of the thermal picture."""

    def __init__(
        self, pairs: Dataset, plus: bool, options: Mapping[str, Any], material: bool, cut: Cut, usable: np.ndarray
    ) -> None:
        self._pairs, self._plus, self._options, self._material = pairs, plus, options, material
        self._cut, self._usable = cut, usable

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, number: Any) -> Any:
        entry, card = self._pairs.entries[number], self._pairs.card
        planes = (*card.get("terrain", ()), *(["material"] if self._material else ())) if self._plus else ()
        pair = self._pairs.pair(entry, truth=(*planes, *(["depth"] if self._options.get("depth") else ())))
        if self._plus:
            inputs = inputs_of(pair, card, self._material)
        else:
            # Colour only, plus air or depth if an option asks for it.
            known = entry.conditions if self._options.get("above_air") else {}
            inputs = Inputs(pair.visible, entry.texel_m, {}, known, depth_of(pair))
        values, valid = pair.thermal, pair.valid
        if self._cut.shift_px:
            values, valid = moved(values, valid, entry.key, self._cut)
        return Example(inputs, values, valid & self._usable[values])


def has_conditions(dataset: Dataset) -> bool:
    """Return whether a Dataset has the terrain's relief, and hour and weather of all its pairs."""
    return bool(dataset.card.get("terrain")) and all(entry.conditions for entry in dataset.entries)


def refuse_missing_conditions(method_name: str, dataset: Dataset) -> None:
    """Refuse a method that needs relief, hour and weather for a Dataset that lacks them."""
    if method(method_name).plus and not has_conditions(dataset):
        raise ThermorenderError(
            f"method {method_name!r} needs the terrain's relief, hour and weather, which {dataset.folder} does not "
            f"have; take {method_name.rstrip('+') if method_name != 'correlation+' else 'correlation-9to1'}"
        )


def _refuse_privileged(method_name: str) -> None:
    """Refuse a method that does not use materials."""
    if not method(method_name).classes:
        known = ", ".join(name for name, each in METHODS.items() if each.classes)
        raise ThermorenderError(
            f"method {method_name!r} does not use materials, so its map cannot be privileged; take {known}, or leave "
            "out --privileged"
        )


def _some(dataset: Dataset, share: float) -> Dataset:
    """A data set with a share of its sequences, at least one; those of validation all stay."""
    if share >= 1.0:
        return dataset
    names = list(dict.fromkeys(entry.sequence for entry in dataset.entries if entry.part != "validation"))
    count = max(1, round(share * len(names)))
    chosen = {names[k] for k in (np.arange(count) * len(names)) // count}
    return dataset.having([each for each in dataset.entries if each.sequence in chosen or each.part == "validation"])


def _with_error(
    made: TemperatureMap, tests: Sequence[tuple[TemperatureMap, Dataset]], material: bool
) -> TemperatureMap:
    """A map with the RMS error [K] of maps on pairs that they were not fitted to; unknown without any."""
    squares, count, pairs = 0.0, 0, 0
    for model, held in tests:
        for entry in _some_evenly(held) if len(held) else ():
            pair = held.pair(entry)
            inputs = inputs_of(pair, held.card, material)
            part = np.s_[::_EVERY, ::_EVERY]
            found, known = (brightness_temperature(each[part], *model.band_um) for each in
                            (model.radiance(inputs), pair.reference))  # fmt: skip
            # Pixels without a predicted temperature have no error in kelvin.
            here = ground_of(pair)[part] & ~_saturated(held.card, pair.thermal[part]) & np.isfinite(found - known)
            squares += float(((found - known)[here] ** 2).sum())
            count += int(here.sum())
            pairs += int(here.any())
    if not count:
        return made
    about = made.about | {"error_on": {"pairs": pairs, "folds": len(tests)}}
    return replace(made, error_k=float(np.sqrt(squares / count)), about=about)


def _saturated(card: Mapping[str, Any], values: np.ndarray) -> np.ndarray:
    """Where values of a known camera are at either end of its range."""
    from thermorender.sensor.camera import load_camera
    from thermorender.sensor.readout import saturated

    if card.get("origin") != "rendered":
        return np.zeros(np.shape(values), bool)
    return saturated(values, load_camera(card["camera"], "camera"))


def _ranges(entries: Sequence[Entry]) -> dict[str, list[float]]:
    """{condition: [least, most]} of the recorded conditions."""
    known = [entry.conditions for entry in entries if entry.conditions]
    return {name: [min(each[name] for each in known), max(each[name] for each in known)] for name in _RANGES
            if known and all(name in each for each in known)}  # fmt: skip


def checked_options(method_name: str, known: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a method's options with the given values, converted to the options' types."""
    found = dict(known)
    for key, value in given.items():
        if key not in known:
            allowed = f"it has {', '.join(known)}" if known else "it has none"
            raise ThermorenderError(f"method {method_name!r} has no option {key!r}; {allowed}")
        kind = type(known[key])
        try:
            if kind is str:
                found[key] = str(value)
            elif kind is bool:
                found[key] = {"true": True, "false": False}[str(value).lower()]
            else:
                found[key] = kind(value)
                if not np.isfinite(found[key]) or found[key] < 0:
                    raise ValueError
        except (ValueError, KeyError, TypeError):
            wanted = {bool: "true or false", int: "a whole number from 0 up"}.get(kind, "a number from 0 up")
            raise ThermorenderError(
                f"option {key}={value!r} of {method_name!r} is not allowed; give {wanted}"
            ) from None
    return found
