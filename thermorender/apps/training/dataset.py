"""A data set on disk: pairs of a visible and a thermal picture of the same view, in shards, with an index and a card.

A folder holds

- `card.json`: what all pairs share: origin, band and camera, the meaning of thermal values, settings;
- `index.jsonl`: a line per pair, appended once its shard is complete; resuming a data set removes the lines of
  incomplete shards;
- `shards/*.tar`: uncompressed tar files in WebDataset's form, up to five files per pair: `KEY.visible.png` (sRGB,
  8 bit), `KEY.thermal.png` (8 or 16 bit), `KEY.valid.png` (0 or 255) if some pixels are invalid, `KEY.truth.npz` if
  ground truth is known, and `KEY.json`, the pair's line of the index.

The index holds the byte offset of every file in its shard, so a pair is read without the others. A `Dataset` has a
length and returns each pair as a dict of arrays, as a PyTorch DataLoader expects.
"""

import hashlib
import io
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender import formats
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance
from thermorender.units import ZERO_CELSIUS_K

FORMAT = 1
PARTS = ("train", "validation", "test")
UNITS = ("radiance", "kelvin", "intensity")
KEY = re.compile(r"[A-Za-z0-9_-]{1,120}")
# Smallest and largest value of a thermal picture.
_ENDS = np.array([0, 65535])
# Size of a tar header, and of the blocks that file data are padded to [bytes].
BLOCK = 512


@dataclass(frozen=True)
class ThermalScale:
    """The meaning of thermal pictures' values.

    Attributes
    ----------
    unit : {"radiance", "kelvin", "intensity"}
        Band radiance [W m⁻² sr⁻¹] or apparent temperature [K], as step × value + zero; or counts of unknown scale,
        linear in band radiance.
    step, zero : float
        Size of one count, and the quantity at count 0. For intensity, step × value + zero is 0…1 between the bounds of
        the published normalisation (1.5 interquartile ranges).
    range_c : (2,) tuple of float, or None
        Temperatures assumed for intensity 0 and 1 [°C]; for intensity only.
    band_um : (2,) tuple of float
    """

    unit: str
    step: float
    zero: float
    range_c: tuple[float, float] | None = None
    band_um: tuple[float, float] = BAND_UM

    def radiance(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return apparent band radiance [W m⁻² sr⁻¹], float64, of values of thermal pictures."""
        found = np.asarray(values, np.float64) * self.step + self.zero
        if self.unit == "kelvin":
            return band_radiance(found, *self.band_um)
        if self.unit == "intensity":
            cold, warm = band_radiance(ZERO_CELSIUS_K + np.array(self.range_c, np.float64), *self.band_um)
            return cold + (warm - cold) * found
        return found


@dataclass(frozen=True)
class Entry:
    """A pair's line of the index.

    Attributes
    ----------
    key : str
        Unique name in the data set.
    part : str
        "train", "validation" or "test".
    parent : str
        The picture it was cropped from; its own key if it is the whole picture.
    sequence : str
        The flight, video or scene it belongs to.
    order : int
        Position in the sequence.
    shape : (2,) tuple of int
        Rows and columns.
    texel_m : float or None
        Typical ground sampling distance of the picture [m].
    place : (2,) tuple of float, or None
        Latitude and longitude [deg].
    time : str or None
        UTC.
    sky_temperature : float or None
        Temperature of a blackbody with the sky's radiance in the camera's band [K].
    conditions : dict of str to float
        Hour and weather as numbers, from `thermorender.render.heat.conditions`; empty if unknown.
    labels : dict of str to str
        Other properties that distinguish pairs: kind of land, view, weather.
    shard : str
        Path below the data set's folder.
    members : dict of str to (offset, size)
        Byte range of each of its files in the shard, by the suffix of the file's name.
    """

    key: str
    part: str
    parent: str
    sequence: str
    order: int
    shape: tuple[int, int]
    texel_m: float | None = None
    place: tuple[float, float] | None = None
    time: str | None = None
    sky_temperature: float | None = None
    conditions: dict[str, float] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    shard: str = ""
    members: dict[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Pair:
    """A pair in memory.

    Attributes
    ----------
    entry : Entry
    visible : (H, W, 3) uint8
        sRGB.
    thermal : (H, W) uint8 or uint16
        The camera's values.
    valid : (H, W) bool
        Where both pictures show the same ground.
    truth : dict of str to (H, W) arrays
        Noise-free "radiance" and other planes of ground truth; empty for pictures of real cameras.
    scale : ThermalScale
    """

    entry: Entry
    visible: NDArray[np.uint8]
    thermal: NDArray[np.uint8] | NDArray[np.uint16]
    valid: NDArray[np.bool_]
    truth: dict[str, NDArray[Any]]
    scale: ThermalScale

    @cached_property
    def radiance(self) -> NDArray[np.float64]:
        """Apparent band radiance of the thermal picture, (H, W) float64 [W m⁻² sr⁻¹]."""
        return self.scale.radiance(self.thermal)

    @cached_property
    def reference(self) -> NDArray[np.float64]:
        """Reference for scores, (H, W) float64 [W m⁻² sr⁻¹]: the noise-free radiance if known, else the picture's."""
        known = self.truth.get("radiance")
        return self.radiance if known is None else known.astype(np.float64)


class Dataset:
    """A data set on disk, or a subset of one.

    Attributes
    ----------
    folder : Path
    card : dict
    entries : tuple of Entry
    scale : ThermalScale
    """

    def __init__(self, folder: Path, card: dict[str, Any], entries: Iterable[Entry], scale: ThermalScale) -> None:
        self.folder, self.card, self.entries, self.scale = folder, card, tuple(entries), scale

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return pair number `index` as {"key", "visible", "thermal", "radiance", "valid"} for a training loop."""
        found = self.pair(self.entries[index])
        return {
            "key": found.entry.key, "visible": found.visible, "thermal": found.thermal.astype(np.int32),
            "radiance": found.radiance.astype(np.float32), "valid": found.valid,
        }  # fmt: skip

    def digest(self) -> str:
        """Return a fingerprint (hex) of the pairs, their parts, and the sizes and times of change of their files."""
        state = hashlib.blake2b(repr((sorted(self.card.items(), key=str), self.entries)).encode(), digest_size=20)
        for shard in sorted({entry.shard for entry in self.entries}):
            with suppress(OSError):
                status = (self.folder / shard).stat()
                state.update(repr((shard, status.st_size, status.st_mtime_ns)).encode())
        return state.hexdigest()

    def of(self, *parts: str) -> "Dataset":
        """Return the subset in the given parts."""
        return self.having([entry for entry in self.entries if entry.part in parts])

    def having(self, entries: Iterable[Entry]) -> "Dataset":
        """Return the subset with the given entries."""
        return Dataset(self.folder, self.card, entries, self.scale)

    def split(self, parts: Mapping[str, str]) -> "Dataset":
        """Return the data set with parts assigned by {key: part}; pairs without an assignment are left out.

        Raises
        ------
        ThermorenderError
            A key is not in this data set, or a part is unknown.
        """
        known = {entry.key for entry in self.entries}
        for key, part in parts.items():
            if key not in known:
                raise ThermorenderError(f"the split names {key!r}, which {self.folder} does not hold; leave it out")
            if part not in PARTS:
                raise ThermorenderError(f"the split puts {key!r} into {part!r}; give one of {', '.join(PARTS)}")
        return self.having([replace(each, part=parts[each.key]) for each in self.entries if each.key in parts])

    def pairs(self) -> Iterator[Pair]:
        """Yield every Pair in the order of the index."""
        for entry in self.entries:
            yield self.pair(entry)

    def pair(self, entry: Entry, truth: bool | Sequence[str] = True) -> Pair:
        """Return the Pair of an Entry.

        Parameters
        ----------
        entry : Entry
        truth : bool or sequence of str
            Planes of ground truth to read: all, none, or those of the given names that exist.

        Raises
        ------
        ThermorenderError
            A shard is missing or damaged.
        """
        import cv2

        found = self._members(entry, bool(truth))
        visible = self._picture(found, entry, "visible.png", cv2.IMREAD_COLOR)[..., ::-1]
        thermal = self._picture(found, entry, "thermal.png", cv2.IMREAD_UNCHANGED, (np.uint8, np.uint16))
        valid = np.ones(thermal.shape, bool)
        if "valid.png" in found:
            valid = self._picture(found, entry, "valid.png", cv2.IMREAD_GRAYSCALE) > 0
        planes = {} if "truth.npz" not in found else self._planes(found["truth.npz"], entry, truth)
        return Pair(entry, np.ascontiguousarray(visible), thermal, valid, planes, self.scale)

    def _damaged(self, entry: Entry, name: str, what: str) -> ThermorenderError:
        """The error for a file of a pair that is not what it should be."""
        path = self.folder / entry.shard
        return ThermorenderError(f"{path} is damaged: {entry.key}.{name} is not {what}; write the shard again")

    def _members(self, entry: Entry, truth: bool) -> dict[str, bytes]:
        """{suffix of a file's name: bytes} of a pair, with ground truth or without."""
        path, found = self.folder / entry.shard, {}
        try:
            with open(path, "rb") as file:
                end = os.fstat(file.fileno()).st_size
                for name, (offset, length) in entry.members.items():
                    if not truth and name.startswith("truth"):
                        continue
                    # Before reading, because an index may state any length.
                    if offset < BLOCK or offset + length > end:
                        raise self._damaged(entry, name, "complete at the offset in the index")
                    file.seek(offset - BLOCK)
                    data = file.read(BLOCK + length)
                    # The tar header names the file that the index expects here.
                    named = data[:100].rstrip(b"\0") == f"{entry.key}.{name}".encode()[:100]
                    if not named or len(data) != BLOCK + length:
                        raise self._damaged(entry, name, "complete at the offset in the index")
                    found[name] = data[BLOCK:]
        except (OSError, OverflowError) as error:
            raise ThermorenderError(
                f"{path} cannot be read ({getattr(error, 'strerror', error)}); copy the data set again, or remove "
                "the shard's lines from index.jsonl"
            ) from None
        return found

    def _picture(
        self, found: Mapping[str, bytes], entry: Entry, name: str, flag: int, kinds: Sequence[type] = (np.uint8,)
    ) -> NDArray[Any]:
        """Decoded picture of a pair's file, of one of these types."""
        import cv2

        image = formats.decoded(found.get(name, b""), flag)
        sides = (*entry.shape, 3) if flag == cv2.IMREAD_COLOR else tuple(entry.shape)
        if image is None or image.shape != sides or image.dtype not in kinds:
            what = "thermal picture" if len(kinds) > 1 else "picture"
            raise self._damaged(entry, name, f"a {what} {_size_of(entry)}")
        return image

    def _planes(self, data: bytes, entry: Entry, truth: bool | Sequence[str]) -> dict[str, NDArray[Any]]:
        """{name: plane} of ground truth, (H, W) each: all, or those of the given names that exist."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as kept:
                wanted = kept if isinstance(truth, bool) else [name for name in kept if name in truth]
                images = {name: kept[name] for name in wanted}
            whole = all(values.shape == tuple(entry.shape) for values in images.values())
        except Exception:
            # On damaged data zipfile's and NumPy's parsers raise nearly any exception.
            whole = False
        if not whole:
            raise self._damaged(entry, "truth.npz", f"an archive of planes {_size_of(entry)}")
        return images


def _size_of(entry: Entry) -> str:
    """Words for the size of a pair's pictures."""
    return f"of {entry.shape[1]}×{entry.shape[0]} pixels"


def read_dataset(folder: str | Path) -> Dataset:
    """Return the Dataset of a folder.

    Raises
    ------
    ThermorenderError
        The folder is not a data set, has another format, or has an invalid index. A truncated last line is ignored.
    """
    folder = Path(folder)
    path = folder / "card.json"
    if not path.is_file():
        raise ThermorenderError(
            f"{folder} is not a data set: card.json is missing; make one with `thermorender prepare`"
        )
    try:
        card = formats.finite_json(formats.read_text(path))
        known: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in card["thermal"].items()}
        scale = ThermalScale(**known)
        if card["format"] != FORMAT or scale.unit not in UNITS:
            raise ValueError(f"format {card['format']}, unit {scale.unit!r}")
        if not _is_usable_scale(scale):
            raise ValueError(f"thermal {card['thermal']}")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ThermorenderError(
            f"{path} is not the card of a data set of format {FORMAT} ({error}); make the data set again"
        ) from None
    entries, seen = [], set()
    index = folder / "index.jsonl"
    text = formats.read_text(index) if index.exists() else ""
    for number, line in enumerate(text.splitlines(), 1):
        try:
            values = formats.finite_json(line)
            values["members"] = {name: tuple(at) for name, at in values["members"].items()}
            known = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
            entry = Entry(**known)
            usable = _is_usable_entry(entry)
        except (ValueError, KeyError, TypeError, AttributeError):
            usable = False
        if not usable and number == text.count("\n") + 1:
            break
        if not usable or entry.key in seen:
            raise ThermorenderError(f"{index}, line {number} is not a pair or repeats a key; remove the line")
        seen.add(entry.key)
        entries.append(entry)
    return Dataset(folder, card, entries, scale)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and bool(np.isfinite(value))


def _is_usable_scale(scale: ThermalScale) -> bool:
    """Whether a ThermalScale from a file gives finite radiances for all values up to 16 bits."""
    ranges: list[Any] = [scale.band_um]
    ranges += [scale.range_c] if scale.range_c is not None or scale.unit == "intensity" else []
    return bool(
        _is_number(scale.step) and _is_number(scale.zero) and scale.step != 0
        and all(isinstance(each, tuple) and len(each) == 2 and all(map(_is_number, each)) for each in ranges)
        and all(low < high for low, high in ranges) and np.isfinite(scale.radiance(_ENDS)).all()
    )  # fmt: skip


def _is_usable_entry(entry: Entry) -> bool:
    """Whether an Entry from a file has the right types and a shard inside its data set."""
    texts = entry.key, entry.part, entry.parent, entry.sequence, entry.shard
    pairs = (entry.shape, *entry.members.values())
    return (
        all(isinstance(text, str) for text in texts)
        and bool(KEY.fullmatch(entry.key)) and entry.part in PARTS and is_shard(entry.shard)
        and all(len(pair) == 2 and all(type(value) is int and value >= 0 for value in pair) for pair in pairs)
        and min(entry.shape) > 0 and type(entry.order) is int
        and all(value is None or _is_number(value) for value in (entry.texel_m, entry.sky_temperature))
        and (entry.place is None or (len(entry.place) == 2 and all(map(_is_number, entry.place))))
        and all(map(_is_number, entry.conditions.values()))
        and isinstance(entry.labels, dict)
    )  # fmt: skip


def is_shard(shard: str) -> bool:
    """Return whether a path below the data set's folder may be a shard."""
    return re.fullmatch(r"shards/[A-Za-z0-9_-]+\.tar", shard) is not None
