"""Data sets from folders of real pictures: checked, registered, cropped, split, scaled and written, in this order."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.training import bounds as value_bounds
from thermorender.apps.training import pictures, splits
from thermorender.apps.training.audit import audit
from thermorender.apps.training.cut import Cut, moved, piece
from thermorender.apps.training.dataset import PARTS, Entry, ThermalScale, read_dataset
from thermorender.apps.training.dataset_writer import Writer, packed, refuse_strange
from thermorender.apps.training.registration import rig
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress
from thermorender.sensor.radiometric_files import orientation

# Default temperatures of intensity 0 and 1 [°C], published with eq. 2.
RANGE_C = (14.0, 24.0)
# Pictures per shard, before cropping.
_PER_SHARD = 64


@dataclass(frozen=True)
class Source:
    """Folders of pictures and how to read them."""

    visible_folder: Path
    thermal_folder: Path
    # visible, thermal: Patterns of file names; the text that their wildcards match is a pair's name
    visible: str = "*"
    thermal: str = "*"
    valid: str | None = None  # Pattern of masks in the visible folder, non-zero where both pictures show the same
    # (2,) tuple (kelvin per count, kelvin of count 0) of files that declare no scale
    scale: tuple[float, float] | None = None
    # Regular expression whose group is the sequence in a name; None: the name without its last digits
    sequence: str | None = None
    gap: int | None = None  # A larger step of the last number in the names starts a new sequence
    intensity: bool = False  # 16 bits without a scale are intensities, even where they look like temperatures


@dataclass(frozen=True)
class Calibration:
    """Arguments of `thermorender.apps.training.registration.fit.calibrate` for the rig of the pictures."""

    fields_of_view: tuple[Sequence[float], Sequence[float]] | None = None
    resized: bool = False


# Registers visible pictures to thermal ones; None for aligned ones.
Registered = rig.Rig | Calibration | None


def prepare(
    source: Source, output: str | Path, registered: Registered = None, cut: Cut | None = None,
    split: str = "sequence", shares: Sequence[float] = (0.7, 0.2, 0.1), texel_m: float | None = None,
    range_c: Sequence[float] | None = None, licence: str | None = None, skip_bad: bool = False, resume: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Write a data set from folders of pictures to `output`; return a report.

    `registered` registers visible pictures to thermal ones, which must be aligned otherwise. `split` is a rule of
    `splits.assign` or a file. `texel_m` is the ground sampling distance [m]; `range_c` the temperatures assumed for
    intensity 0 and 1 of values of unknown scale [°C]. `skip_bad` leaves out unusable pairs instead of refusing all.

    The report has pairs, entries, parts {name: count}, sequences, left_out {name: reason}, grey (pairs without colour),
    bounds (of the training part, else of all), rig, scale, audit (None without training or test part).
    """
    report_progress, cut, output = progress or (lambda task, fraction: None), cut or Cut(), Path(output)
    _check_settings(cut, texel_m, range_c)
    (refuse_strange if resume else files.check_new_folder)(output)
    kept, found, left_out, keys, sequence_of = _usable(source, registered, cut, skip_bad, report_progress)
    unit = _unit(found)
    if range_c is not None and unit != "intensity":
        raise ThermorenderError("--range-c is for values of unknown scale, and these are temperatures; leave it out")
    entries = _entries(kept, found, keys, sequence_of, cut, texel_m)
    parts = _assigned([entry for of_pair in entries.values() for entry in of_pair], split, shares, cut.seed)
    cameras = _rig(registered, kept, source, output, resume, report_progress)
    plan = _Plan(source, cut, cameras, kept, entries, parts)
    histogram = plan.histogram(report_progress)
    bounds = value_bounds.bounds_of(histogram)
    scale = _scale(unit, bounds, range_c)
    grey = sum(found[pair.name].grey for pair in kept)
    card = {
        "name": output.resolve().name, "licence": licence, "texel_m": texel_m, "pairs": len(kept), "grey": grey,
        "source": f"pictures of {Path(source.visible_folder).name} and {Path(source.thermal_folder).name}",
        "left_out": left_out, "rig": None if cameras is None else asdict(cameras), "bounds": asdict(bounds),
        "checksum": _checksum(kept),
        "settings": _settings(source) | {"split": split, "shares": list(shares)} | asdict(cut),
    }  # fmt: skip
    with files.in_use(files.make_folder(output)):
        files.remove_parts(output)
        plan.write(output, Writer(output, card, scale, resume), report_progress)
        if not (output / "histogram.png").exists():
            value_bounds.figure(output / "histogram.png", histogram, bounds, scale)
        made = read_dataset(output)
        leaks = audit(made, progress=report_progress) if len(made.of("train")) and len(made.of("test")) else None
        if leaks:
            formats.write_json(output / "audit.json", leaks.summary())
    return {
        "audit": leaks,
        "pairs": len(kept), "entries": sum(map(len, entries.values())), "grey": grey, "left_out": left_out,
        "turned": sum(found[pair.name].turned for pair in kept),
        "parts": {part: sum(each == part for each in parts.values()) for part in PARTS},
        "sequences": len({sequence_of[pair.name] for pair in kept}), "bounds": bounds, "rig": cameras, "scale": scale,
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Plan:
    """A data set before it is written: its pairs, their crops and parts, and the rig of their cameras."""

    source: Source
    cut: Cut
    cameras: rig.Rig | None
    pairs: list[pictures.Files]
    entries: dict[str, list[Entry]]  # Of each pair's crops, by its name
    parts: dict[str, str]  # By key

    def pieces(self, pair: pictures.Files) -> Iterator[tuple[Entry, np.ndarray, np.ndarray, np.ndarray]]:
        """Yield (Entry, visible, thermal, valid) of each crop of a pair."""
        images = _registered(pair, self.source, self.cameras, self.cut)
        for number, entry in enumerate(self.entries[pair.name]):
            entry = replace(entry, part=self.parts[entry.key])
            visible, thermal, valid = (piece(image, pair.name, self.cut, number) for image in images)
            yield entry, visible, thermal, valid

    def histogram(self, report_progress: Progress) -> value_bounds.Histogram:
        """Return the Histogram of the training part's valid thermal values; of all parts if it is empty."""
        histogram = value_bounds.Histogram()
        counted = PARTS[:1] if PARTS[0] in self.parts.values() else PARTS
        training = [
            pair for pair in self.pairs if any(self.parts[each.key] in counted for each in self.entries[pair.name])
        ]
        for number, pair in enumerate(training):
            report_progress("counting thermal values", number / len(training))
            for entry, _, thermal, valid in self.pieces(pair):
                if entry.part in counted:
                    histogram.add(thermal[valid])
        return histogram

    def write(self, output: Path, writer: Writer, report_progress: Progress) -> None:
        """Write the rig, its inspection picture and all missing shards."""
        # No other process writes shards now.
        files.remove_parts(output / "shards")
        if self.cameras is not None and not (output / "rig.json").exists():
            rig.save_rig(self.cameras, output / "rig.json")
        if self.cameras is not None and not (output / "overlay.png").exists():
            shown = _shown(self.pairs, self.cameras)
            rig.write_overlay(output / "overlay.png", pictures.read_visible(shown.visible)[0],
                              _temperatures(shown, self.source), self.cameras)  # fmt: skip
        for start in range(0, len(self.pairs), _PER_SHARD):
            report_progress("writing pairs", start / len(self.pairs))
            name = f"{start // _PER_SHARD:06d}"
            if not writer.has(name):
                group = self.pairs[start : start + _PER_SHARD]
                writer.shard(name, ((e, packed(v, t, m)) for pair in group for e, v, t, m in self.pieces(pair)))


def _usable(
    source: Source, registered: Registered, cut: Cut, skip_bad: bool, report_progress: Progress
) -> tuple[list[pictures.Files], dict[str, "_Found"], dict[str, str], dict[str, str], dict[str, str]]:
    """(usable pairs, {name: _Found}, {name: reason} of the others, {name: key}, {name: sequence})."""
    pairs, alone = pictures.matched(
        source.visible_folder, source.thermal_folder, source.visible, source.thermal, source.valid
    )
    sequence_of, keys = pictures.sequences_of(pairs, source.sequence, source.gap), pictures.keys_of(pairs)
    found, left_out = _checked(pairs, source, registered, cut, report_progress)
    left_out = dict.fromkeys(alone, "has no partner") | left_out
    if left_out and not skip_bad:
        _refuse(left_out, len(pairs) + len(alone))
    kept = [pair for pair in pairs if pair.name in found]
    if not kept:
        raise ThermorenderError(f"none of {len(pairs)} pairs can be used, e.g. {next(iter(left_out.values()))}")
    return kept, found, left_out, keys, sequence_of


def _scale(unit: str, bounds: value_bounds.Bounds, range_c: Sequence[float] | None) -> ThermalScale:
    """The ThermalScale of temperatures, or of intensity within the bounds."""
    if unit == "kelvin":
        return ThermalScale("kelvin", pictures.STEP_K, 0.0)
    span = bounds.high - bounds.low
    cold, warm = range_c or RANGE_C
    return ThermalScale("intensity", 1.0 / span, -bounds.low / span, (cold, warm))


def _settings(source: Source) -> dict[str, Any]:
    """Settings of a Source that a data set's card records."""
    return {name: getattr(source, name) for name in ("visible", "thermal", "valid", "scale", "sequence", "gap")}


def _refuse(left_out: Mapping[str, str], count: int) -> None:
    """Refuse names that cannot be used, by reason."""
    reasons = Counter(left_out.values())
    listed = [
        f"{pictures.listed(name for name in left_out if left_out[name] == reason)}: {reason}"
        for reason in list(reasons)[:4]
    ]
    raise ThermorenderError(
        f"{len(left_out)} of {count} names cannot be used ({'; '.join(listed)}); correct or remove them, or leave them "
        "out with --skip-bad"
    )


def _checksum(pairs: Sequence[pictures.Files]) -> str:
    """Checksum of all pictures; resuming a data set requires the same one."""
    paths = [path for pair in pairs for path in (pair.visible, pair.thermal, pair.valid) if path is not None]
    text = "".join(path.name + formats.checksum(path) for path in paths)
    return hashlib.blake2b(text.encode(errors="surrogateescape"), digest_size=16).hexdigest()


# --- checks -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Found:
    """Properties of a pair: shape of its thermal picture, its unit and depth, whether the visible one is grey."""

    shape: tuple[int, int]
    kind: tuple[str, str]
    grey: bool
    turned: bool  # Whether the tags of visible and thermal picture state different orientations


def _check_settings(cut: Cut, texel_m: float | None, range_c: Sequence[float] | None) -> None:
    """Refuse settings out of range, before anything is read."""
    if cut.crops < 0 or cut.size < pictures.LEAST_SIDE:
        raise ThermorenderError(
            f"--crops={cut.crops} --crop-size={cut.size} is not allowed; give a count of 0 or more and a side of at "
            f"least {pictures.LEAST_SIDE} px"
        )
    if cut.seed < 0:
        raise ThermorenderError(f"--seed={cut.seed} is not allowed; give 0 or more")
    if not (np.isfinite(cut.shift_px) and cut.shift_px >= 0.0):
        raise ThermorenderError(f"--shift={cut.shift_px:g} is not a length; give pixels, 0 or more")
    if texel_m is not None and not (np.isfinite(texel_m) and texel_m > 0.0):
        raise ThermorenderError(f"--texel-m={texel_m:g} is not a ground sampling distance; give metres above 0")
    if range_c is not None and not -273.0 < range_c[0] < range_c[1]:
        raise ThermorenderError(f"--range-c={range_c[0]:g},{range_c[1]:g} is not a range; give °C, the lower first")


def _checked(
    pairs: Sequence[pictures.Files], source: Source, registered: Registered, cut: Cut, report_progress: Progress
) -> tuple[dict[str, _Found], dict[str, str]]:
    """({name: _Found}, {name: reason why it cannot be used}) of pairs."""
    found: dict[str, _Found] = {}
    bad: dict[str, str] = {}
    for number, pair in enumerate(pairs):
        report_progress("reading pictures", number / len(pairs))
        try:
            visible, grey = pictures.read_visible(pair.visible)
            thermal = pictures.read_thermal(pair.thermal, source.scale, source.intensity)
            if pair.valid is not None:
                pictures.read_valid(pair.valid, visible.shape[:2])
            _check_sizes(visible.shape[:2], thermal.values.shape, registered, cut)
        except ThermorenderError as error:
            bad[pair.name] = str(error)
            continue
        height, width = thermal.values.shape
        found[pair.name] = _Found(
            (height, width),
            (thermal.unit, thermal.values.dtype.name),
            grey,
            orientation(pair.visible) != orientation(pair.thermal),
        )
    return found, bad


def _check_sizes(visible: tuple[int, ...], thermal: tuple[int, ...], registered: Registered, cut: Cut) -> None:
    """Refuse pictures whose sizes, (rows, columns), do not fit each other, the rig or the crops."""
    sizes = f"{visible[1]}×{visible[0]} and {thermal[1]}×{thermal[0]} pixels"
    if registered is None and visible != thermal:
        raise ThermorenderError(f"visible and thermal picture have {sizes}; give aligned ones, --rig or --calibrate")
    if isinstance(registered, rig.Rig) and (visible, thermal) != (registered.visible_shape, registered.thermal_shape):
        raise ThermorenderError(f"visible and thermal picture have {sizes}, unlike the rig; give another --rig")
    if cut.crops and min(thermal) < cut.size:
        raise ThermorenderError(f"the thermal picture is smaller than --crop-size {cut.size}; give a smaller one")
    if cut.shift_px >= 0.5 * min(thermal):
        raise ThermorenderError(f"--shift={cut.shift_px:g} is half the thermal picture or more; give a smaller one")


def _unit(found: Mapping[str, _Found]) -> str:
    """Unit of all thermal pictures, which must also have the same depth."""
    kinds = Counter(each.kind for each in found.values())
    if len(kinds) > 1:
        names = {kind: next(name for name, each in found.items() if each.kind == kind) for kind in kinds}
        listed = ", ".join(f"{count} of {kind[0]} in {kind[1]} (e.g. {names[kind]})" for kind, count in kinds.items())
        raise ThermorenderError(f"thermal pictures are of several kinds: {listed}; prepare each kind separately")
    return next(iter(kinds))[0]


# --- crops ------------------------------------------------------------------------------------------------------


def _entries(
    pairs: Sequence[pictures.Files], found: Mapping[str, _Found], keys: Mapping[str, str],
    sequence_of: Mapping[str, str], cut: Cut, texel_m: float | None,
) -> dict[str, list[Entry]]:  # fmt: skip
    """{name: [Entry of each of its crops]}, not yet assigned to parts."""
    entries: dict[str, list[Entry]] = {}
    orders: Counter[str] = Counter()
    for pair in pairs:
        sequence, key = sequence_of[pair.name], keys[pair.name]
        shape = (cut.size, cut.size) if cut.crops else found[pair.name].shape
        common = Entry(
            key=key, part=PARTS[0], parent=key, sequence=sequence, order=orders[sequence], shape=shape,
            texel_m=texel_m, place=pictures.place_of(pair.visible),
        )  # fmt: skip
        orders[sequence] += 1
        entries[pair.name] = [replace(common, key=f"{key}-{number}") for number in range(cut.crops)] or [common]
    return entries


def _assigned(entries: Sequence[Entry], rule: str, shares: Sequence[float], seed: int) -> dict[str, str]:
    """{key: part} of all entries, by a rule or a file."""
    if Path(rule).suffix not in splits.SUFFIXES:
        return splits.assign(entries, rule, shares=shares, seed=seed)
    parts = splits.read_split(rule)
    missing = [entry.key for entry in entries if entry.key not in parts]
    if missing:
        raise ThermorenderError(f"{rule} gives no part to {pictures.listed(missing)}; name every pair, or give a rule")
    return {entry.key: parts[entry.key] for entry in entries}


# --- pictures ---------------------------------------------------------------------------------------------------


def _rig(
    registered: Registered, pairs: Sequence[pictures.Files], source: Source, output: Path, resume: bool,
    report_progress: Progress,
) -> rig.Rig | None:  # fmt: skip
    """The Rig of the pictures: given, of the resumed data set, or calibrated; None for aligned pictures."""
    if not isinstance(registered, Calibration):
        return registered
    if resume and (output / "rig.json").exists():
        return rig.load_rig(output / "rig.json")
    from thermorender.apps.training.registration.fit import calibrate

    def reader(pair: pictures.Files) -> Callable[[], tuple[NDArray[np.uint8], np.ndarray]]:
        return lambda: (pictures.read_visible(pair.visible)[0], _temperatures(pair, source))

    frames = [(pair.name, reader(pair)) for pair in pairs]
    return calibrate(frames, registered.fields_of_view, registered.resized, report_progress)


def _temperatures(pair: pictures.Files, source: Source) -> np.ndarray:
    """Values of a pair's thermal picture, (H, W) float32; NaN where not valid."""
    thermal = pictures.read_thermal(pair.thermal, source.scale, source.intensity)
    return np.where(thermal.valid, thermal.values, np.nan).astype(np.float32)


def _shown(pairs: Sequence[pictures.Files], cameras: rig.Rig) -> pictures.Files:
    """Pair for the inspection picture: the best of the calibration, else the middle one."""
    known = [pair for pair in pairs if pair.name in cameras.frames and pair.name not in cameras.rejected]
    return max(known, key=lambda pair: cameras.frames[pair.name]) if known else pairs[len(pairs) // 2]


def _registered(
    pair: pictures.Files, source: Source, cameras: rig.Rig | None, cut: Cut
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(visible (H, W, 3) uint8, thermal (H, W), valid (H, W) bool) of a pair, on the thermal pixels."""
    visible, _ = pictures.read_visible(pair.visible)
    thermal = pictures.read_thermal(pair.thermal, source.scale, source.intensity)
    values, valid = thermal.values.copy(), thermal.valid
    seen = None if pair.valid is None else pictures.read_valid(pair.valid, visible.shape[:2])
    if cameras is not None:
        visible, inside = rig.warped(visible, cameras)
        if seen is not None:
            # A pixel resampled from any invalid pixel is invalid too.
            mask = np.repeat(np.where(seen, 255, 0).astype(np.uint8)[..., None], 3, axis=-1)
            seen = rig.warped(mask, cameras)[0][..., 0] > 250
        seen = inside if seen is None else seen & inside
    if cut.shift_px:
        values, valid = moved(values, valid, pair.name, cut)
    # The median where no value is known.
    values[~valid] = int(np.median(values[valid])) if valid.any() else 0
    return visible, values, valid if seen is None else valid & seen
