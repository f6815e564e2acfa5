"""A data set: pairs of a visible and a thermal picture of the same view, in shards, with an index and a card.

A folder holds

- `card.json`: what all pairs share: where they come from, band and camera, what a thermal value stands for, settings;
- `index.jsonl`: a line per pair, appended once its shard is whole; lines whose shard is not are taken away when a data
  set is continued;
- `shards/*.tar`: uncompressed tar files in the form that WebDataset reads, up to four files a pair:
  `KEY.visible.png` (sRGB, 8 bit), `KEY.thermal.png` (8 or 16 bit), where some pixels hold nothing `KEY.valid.png`
  (0 or 255), and where the truth is known `KEY.truth.npz`; and `KEY.json`, the pair's line of the index.

The index knows where in its shard each file lies, so any pair is read without the others. A `Dataset` has a length and
gives each pair as a dict of arrays, which is all that a PyTorch DataLoader asks for.
"""

import io
import json
import os
import re
import tarfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from thermorender import files, formats
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance
from thermorender.units import ZERO_CELSIUS_K
from thermorender.versions import versions

FORMAT = 1
PARTS = ("train", "validation", "test")
UNITS = ("radiance", "kelvin", "intensity")
# A temporary shard that nobody wrote to for so long is left of a killed process [s].
_ABANDONED_S = 3600.0
_KEY = re.compile(r"[A-Za-z0-9_-]{1,120}")
# Least and largest value of a thermal picture.
_ENDS = np.array([0, 65535])
# How names of a pair's files end.
_END = re.compile(r"[a-z]+\.[a-z]+")
# Of a tar file: what a header takes, and what the data behind it are padded to [bytes].
_BLOCK = 512


@dataclass(frozen=True)
class ThermalScale:
    """What the values of thermal pictures stand for.

    Attributes
    ----------
    unit : {"radiance", "kelvin", "intensity"}
        Band radiance [W m⁻² sr⁻¹] or apparent temperature [K], of step and zero; or counts of unknown scale, linear in
        band radiance.
    step, zero : float
        Of a value, and of value 0. For intensity: a value is step × value + zero between 0 and 1, the bounds of the
        published normalisation (1.5 interquartile ranges).
    range_c : (2,) tuple of float, or None
        Temperatures that intensity 0 and 1 are taken for [°C]; for intensity only.
    band_um : (2,) tuple of float
    """

    unit: str
    step: float
    zero: float
    range_c: tuple | None = None
    band_um: tuple = BAND_UM

    def radiance(self, values):
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
    """What the index knows of a pair.

    Attributes
    ----------
    key : str
        Its name, unique in the data set.
    part : str
        "train", "validation" or "test".
    parent : str
        The picture it was cut from; its own key where it is whole.
    sequence : str
        The flight, video or scene it belongs to.
    order : int
        Its place in the sequence.
    shape : (2,) tuple of int
        Rows and columns.
    texel_m : float or None
        Ground sampling distance, typical of the picture [m].
    place : (2,) tuple of float, or None
        Latitude and longitude [deg].
    time : str or None
        UTC.
    sky_temperature : float or None
        Of the blackbody that shines as the sky did in the camera's band [K].
    conditions : dict of str to float
        Hour and weather in numbers, as by `thermorender.render.heat.conditions`; empty where unknown.
    labels : dict of str to str
        Whatever else tells pairs apart: kind of land, view, weather.
    shard : str
        File below the data set's folder.
    members : dict of str to (offset, size)
        Where in the shard its files lie, by the end of their names.
    """

    key: str
    part: str
    parent: str
    sequence: str
    order: int
    shape: tuple
    texel_m: float | None = None
    place: tuple | None = None
    time: str | None = None
    sky_temperature: float | None = None
    conditions: dict = field(default_factory=dict)
    labels: dict = field(default_factory=dict)
    shard: str = ""
    members: dict = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Pair:
    """A pair in memory.

    Attributes
    ----------
    entry : Entry
    visible : (H, W, 3) uint8
        sRGB.
    thermal : (H, W) uint8 or uint16
        As the camera gave it.
    valid : (H, W) bool
        Where both pictures show the same ground.
    truth : dict of str to (H, W) arrays
        Noise-free "radiance" and whatever else is known per pixel; empty for pictures of real cameras.
    scale : ThermalScale
    """

    entry: Entry
    visible: np.ndarray
    thermal: np.ndarray
    valid: np.ndarray
    truth: dict
    scale: ThermalScale

    @cached_property
    def radiance(self):
        """Apparent band radiance of the thermal picture, (H, W) float64 [W m⁻² sr⁻¹]."""
        return self.scale.radiance(self.thermal)

    @cached_property
    def reference(self):
        """What translations are scored against, (H, W) float64: noise-free radiance where known, else the picture's."""
        known = self.truth.get("radiance")
        return self.radiance if known is None else known.astype(np.float64)


class Dataset:
    """A data set on disk; a part of it is one too.

    Attributes
    ----------
    folder : Path
    card : dict
    entries : tuple of Entry
    scale : ThermalScale
    """

    def __init__(self, folder, card, entries, scale):
        self.folder, self.card, self.entries, self.scale = folder, card, tuple(entries), scale

    def __len__(self):
        return len(self.entries)

    def __getitem__(self, index):
        """Return pair number `index` as {"key", "visible", "thermal", "radiance", "valid"} for a training loop."""
        found = self.pair(self.entries[index])
        return {
            "key": found.entry.key, "visible": found.visible, "thermal": found.thermal.astype(np.int32),
            "radiance": found.radiance.astype(np.float32), "valid": found.valid,
        }  # fmt: skip

    def of(self, *parts):
        """Return the Dataset of some parts."""
        return self.having([entry for entry in self.entries if entry.part in parts])

    def having(self, entries):
        """Return this data set with other Entries of it."""
        return Dataset(self.folder, self.card, entries, self.scale)

    def split(self, parts):
        """Return this data set with each key's part as {key: part} says; keys that it lacks are left out.

        Raises
        ------
        ThermorenderError
            A key that is not of this data set, or a part of another name.
        """
        known = {entry.key for entry in self.entries}
        for key, part in parts.items():
            if key not in known:
                raise ThermorenderError(f"the split names {key!r}, which {self.folder} does not hold; leave it out")
            if part not in PARTS:
                raise ThermorenderError(f"the split puts {key!r} into {part!r}; give one of {', '.join(PARTS)}")
        return self.having([replace(each, part=parts[each.key]) for each in self.entries if each.key in parts])

    def pairs(self) -> Iterator[Pair]:
        """Give every Pair, in the index's order."""
        for entry in self.entries:
            yield self.pair(entry)

    def pair(self, entry, truth=True):
        """Return the Pair of an Entry.

        Parameters
        ----------
        entry : Entry
        truth : bool or sequence of str
            What only simulations know: all, nothing, or these planes of it, as far as they are there.

        Raises
        ------
        ThermorenderError
            A shard is missing or damaged.
        """
        import cv2

        path = self.folder / entry.shard

        def damaged(name, what):
            return ThermorenderError(f"{path} is damaged: {entry.key}.{name} is no {what}; make the shard anew")

        size = f"of {entry.shape[1]}×{entry.shape[0]} pixels"
        found = {}
        try:
            with open(path, "rb") as file:
                for name, (offset, length) in entry.members.items():
                    if truth or not name.startswith("truth"):
                        file.seek(max(offset - _BLOCK, 0))
                        data = file.read(_BLOCK + length)
                        # Its header tells whether this is the shard that the index was written for.
                        told = data[:100].rstrip(b"\0") == f"{entry.key}.{name}".encode()[:100]
                        if not told or len(data) != _BLOCK + length:
                            raise damaged(name, "whole file where the index has it")
                        found[name] = data[_BLOCK:]
        except (OSError, OverflowError) as error:
            raise ThermorenderError(
                f"{path} cannot be read ({getattr(error, 'strerror', error)}); copy the data set anew, or leave the "
                "shard's lines out of index.jsonl"
            ) from None

        def picture(name, flag, kinds=(np.uint8,)):
            image = formats.decoded(found.get(name, b""), flag)
            sides = (*entry.shape, 3) if flag == cv2.IMREAD_COLOR else tuple(entry.shape)
            if image is None or image.shape != sides or image.dtype not in kinds:
                raise damaged(name, f"{'thermal ' if len(kinds) > 1 else ''}picture {size}")
            return image

        visible = picture("visible.png", cv2.IMREAD_COLOR)[..., ::-1]
        thermal = picture("thermal.png", cv2.IMREAD_UNCHANGED, (np.uint8, np.uint16))
        valid = np.ones(thermal.shape, bool)
        if "valid.png" in found:
            valid = picture("valid.png", cv2.IMREAD_GRAYSCALE) > 0
        images = {}
        if "truth.npz" in found:
            try:
                with np.load(io.BytesIO(found["truth.npz"]), allow_pickle=False) as kept:
                    images = {name: kept[name] for name in kept if truth is True or name in truth}
                whole = all(values.shape == tuple(entry.shape) for values in images.values())
            except Exception:
                # What is damaged shows as nearly any exception of zipfile's and NumPy's parsers.
                whole = False
            if not whole:
                raise damaged("truth.npz", f"archive of planes {size}")
        return Pair(entry, np.ascontiguousarray(visible), thermal, valid, images, self.scale)


def read_dataset(folder):
    """Return the Dataset of a folder.

    Raises
    ------
    ThermorenderError
        No data set, one of another format, or an index that cannot be used; a last line cut short is passed over.
    """
    folder = Path(folder)
    path = folder / "card.json"
    if not path.is_file():
        raise ThermorenderError(f"{folder} is no data set: card.json is missing; make one with `thermorender prepare`")
    try:
        card = formats.finite_json(formats.read_text(path))
        scale = ThermalScale(**{k: tuple(v) if isinstance(v, list) else v for k, v in card["thermal"].items()})
        if card["format"] != FORMAT or scale.unit not in UNITS:
            raise ValueError(f"format {card['format']}, unit {scale.unit!r}")
        if not _tells(scale):
            raise ValueError(f"thermal {card['thermal']}")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ThermorenderError(
            f"{path} is no card of a data set of format {FORMAT} ({error}); make the data set anew"
        ) from None
    entries, seen = [], set()
    index = folder / "index.jsonl"
    text = formats.read_text(index) if index.exists() else ""
    for number, line in enumerate(text.splitlines(), 1):
        try:
            values = formats.finite_json(line)
            values["members"] = {name: tuple(at) for name, at in values["members"].items()}
            entry = Entry(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
            usable = _usable(entry)
        except (ValueError, KeyError, TypeError, AttributeError):
            usable = False
        if not usable and number == text.count("\n") + 1:
            break
        if not usable or entry.key in seen:
            raise ThermorenderError(f"{index}, line {number} is no pair of its own; remove the line")
        seen.add(entry.key)
        entries.append(entry)
    return Dataset(folder, card, entries, scale)


def _number(value):
    return isinstance(value, (int, float)) and bool(np.isfinite(value))


def _tells(scale):
    """Whether a ThermalScale that was read tells what values stand for, of 16 bits at most."""
    ranges = [scale.band_um, *([scale.range_c] if scale.range_c is not None or scale.unit == "intensity" else [])]
    return (
        _number(scale.step) and _number(scale.zero) and scale.step != 0
        and all(isinstance(each, tuple) and len(each) == 2 and all(map(_number, each)) for each in ranges)
        and all(low < high for low, high in ranges) and np.isfinite(scale.radiance(_ENDS)).all()
    )  # fmt: skip


def _usable(entry):
    """Whether an Entry that was read is of the kinds it should be, and leads nowhere outside its data set."""
    texts = entry.key, entry.part, entry.parent, entry.sequence, entry.shard
    pairs = (entry.shape, *entry.members.values())
    return (
        all(isinstance(text, str) for text in texts)
        and bool(_KEY.fullmatch(entry.key)) and entry.part in PARTS and _inside(entry.shard)
        and all(len(pair) == 2 and all(type(value) is int and value >= 0 for value in pair) for pair in pairs)
        and min(entry.shape) > 0 and type(entry.order) is int
        and all(value is None or _number(value) for value in (entry.texel_m, entry.sky_temperature))
        and (entry.place is None or (len(entry.place) == 2 and all(map(_number, entry.place))))
        and all(map(_number, entry.conditions.values()))
        and isinstance(entry.labels, dict)
    )  # fmt: skip


def _inside(shard):
    return re.fullmatch(r"shards/[A-Za-z0-9_-]+\.tar", shard) is not None


def _names(folder):
    """Names of what lies in a folder, but for what others try or write there at this moment."""
    return {each.name for each in folder.iterdir() if not each.name.startswith(".")}


def refuse_strange(folder):
    """Refuse a folder that holds something else than a data set, or than what was left when one was begun."""
    folder = Path(folder)
    names = _names(folder) if folder.is_dir() else set()
    strange = names - {"shards"} or (names and _names(folder / "shards"))
    if strange and not (folder / "card.json").exists():
        raise ThermorenderError(f"{folder} is not empty and holds no data set; give a new folder")


class Writer:
    """Writes a data set, shard by shard; what is whole stays, so that it can be continued.

    Parameters
    ----------
    folder : path
    card : dict
        What all pairs share; `format`, `thermal` and `versions` are added.
    scale : ThermalScale
    resume : bool
        Continue a data set of the same card.

    Raises
    ------
    ThermorenderError
        A folder that holds something else, or a card that differs.
    """

    def __init__(self, folder, card, scale, resume=False):
        self.folder = files.make_folder(folder)
        self.card = {"format": FORMAT, **card, "thermal": asdict(scale)}
        # As it is read back.
        self.card = json.loads(json.dumps(self.card))
        # {key: shard} of the index as far as it was read: the file's number and how many bytes of it.
        self._known, self._read = {}, (0, 0)
        path, shards = self.folder / "card.json", self.folder / "shards"
        refuse_strange(self.folder)
        files.make_folder(shards)
        # Others may be beginning or continuing the same data set.
        with self._alone():
            self._begin(path, resume)
            self._look()

    def _alone(self):
        """Wait for other Writers of this folder; whoever uses it as a whole may keep the folder itself."""
        return files.in_use(self.folder / "shards", wait=True)

    def _begin(self, path, resume):
        if path.exists():
            before = read_dataset(self.folder)
            if not resume:
                raise ThermorenderError(
                    f"{self.folder} holds a data set; give a new folder, or --resume to continue it"
                )
            for key in self.card | before.card:
                if key != "versions" and before.card.get(key) != self.card.get(key):
                    raise ThermorenderError(
                        f"{path} has {key}={before.card.get(key)!r}, now {self.card.get(key)!r}; continue with the "
                        "same settings, or give another folder"
                    )
            self._cut_short()
            self._leave_out_what_is_not_whole()
        else:
            formats.write_json(path, self.card | {"versions": versions()})
        # Card and index are written by whoever is alone, shards by several at a time.
        files.remove_parts(self.folder, "card|index|trial")
        files.remove_parts(self.folder / "shards", older_s=_ABANDONED_S)

    def _cut_short(self):
        """Take away the last line of the index if a killed process left it without its end."""
        path = self.folder / "index.jsonl"
        if path.exists():
            data = path.read_bytes()
            if data and not data.endswith(b"\n"):
                os.truncate(path, data.rfind(b"\n") + 1)

    def _leave_out_what_is_not_whole(self):
        """Take the lines out of the index whose shard is missing or cut, or holds pairs that the index does not know.

        A process that is killed while it appends a shard's lines may leave the first of them.
        """
        last = {}
        for entry in read_dataset(self.folder).entries:
            end = max((offset + length for offset, length in entry.members.values()), default=0)
            if end >= last.get(entry.shard, (0, ""))[0]:
                last[entry.shard] = end, entry.key
        broken = {shard for shard, (end, key) in last.items() if not self._ends(shard, end, key)}
        if broken:
            self._without(broken)

    def _ends(self, shard, end, key):
        """Whether behind some bytes of a shard there is one file more, a pair's line, and no other."""
        try:
            with open(self.folder / shard, "rb") as file:
                file.seek(-(-end // _BLOCK) * _BLOCK)
                with tarfile.open(fileobj=file, mode="r:") as rest:
                    return rest.getnames() == [f"{key}.json"]
        except (OSError, tarfile.TarError):
            return False

    def _without(self, shards):
        """Take the lines of some shards out of the index."""
        path = self.folder / "index.jsonl"
        kept = [line for line in formats.read_text(path).splitlines(keepends=True)
                if json.loads(line)["shard"] not in shards]  # fmt: skip
        formats.write_text(path, "".join(kept))

    def _look(self):
        """Learn what the index holds, which others may have changed since the last look."""
        self._cut_short()
        path = self.folder / "index.jsonl"
        if not path.exists():
            return
        with open(path, "rb") as file:
            number, size = os.fstat(file.fileno()).st_ino, os.fstat(file.fileno()).st_size
            if number != self._read[0] or size < self._read[1]:
                self._known, self._read = {}, (number, 0)
            file.seek(self._read[1])
            for line in file.read().splitlines():
                told = json.loads(line)
                self._known[told["key"]] = told["shard"]
        self._read = number, size

    def has(self, name):
        """Return whether the shard of this name is whole."""
        return f"shards/{name}.tar" in self._known.values()

    def shard(self, name: str, pairs: Iterable[tuple[Entry, Mapping[str, bytes]]]):
        """Write a shard of pairs and then their lines of the index.

        Parameters
        ----------
        name : str
            Of the shard, without its ending.
        pairs : iterable of (Entry, {end of a file's name: bytes})
            As `packed` makes them.

        Returns
        -------
        tuple of Entry

        Raises
        ------
        ThermorenderError
            A name or key that is not allowed, a key that another pair has, an unknown part, or a file that cannot be
            written; the data set stays as it was.
        """
        entries, shard = [], f"shards/{name}.tar"
        if not _inside(shard):
            raise ThermorenderError(f"{name!r} is no name for a shard; give letters, digits, _ and -")
        taken = {key for key, of in self._known.items() if of != shard}
        with files.atomic(self.folder / shard) as part, tarfile.open(part, "w") as tar:
            for entry, contents in pairs:
                _refuse(entry, contents, taken)
                taken.add(entry.key)
                members = {}
                for end, data in contents.items():
                    info = tarfile.TarInfo(f"{entry.key}.{end}")
                    info.size = len(data)
                    tar.addfile(info, io.BytesIO(data))
                    members[end] = (tar.offset - -(-len(data) // _BLOCK) * _BLOCK, len(data))
                entry = replace(entry, shard=shard, members=members)
                told = json.dumps(asdict(entry)).encode()
                info = tarfile.TarInfo(f"{entry.key}.json")
                info.size = len(told)
                tar.addfile(info, io.BytesIO(told))
                entries.append(entry)
        files.on_disk(self.folder / shard)
        self._append(shard, entries)
        return tuple(entries)

    def _append(self, shard, entries):
        """Give the index the lines of a shard."""
        path = self.folder / "index.jsonl"
        with self._alone():
            self._look()
            if shard in self._known.values():
                # Another process has written it too, and the last one's is there.
                self._without({shard})
            formats.append_json(path, *map(asdict, entries))
            self._look()


def _refuse(entry, contents, taken):
    """Refuse a pair that could not be read again."""
    if not _KEY.fullmatch(entry.key):
        raise ThermorenderError(f"{entry.key!r} is no key of a pair; give letters, digits, _ and -")
    if entry.key in taken:
        raise ThermorenderError(f"{entry.key!r} is the key of two pairs; give each its own")
    if entry.part not in PARTS:
        raise ThermorenderError(f"part={entry.part!r} of {entry.key!r} is unknown; give one of {', '.join(PARTS)}")
    for end in contents:
        if not _END.fullmatch(end):
            raise ThermorenderError(f"{end!r} of {entry.key!r} is no end of a name; give one such as visible.png")


def packed(visible, thermal, valid=None, truth=None):
    """Return {end of a file's name: bytes} of a pair's pictures.

    Parameters
    ----------
    visible : (H, W, 3) uint8
    thermal : (H, W) uint8 or uint16
    valid : (H, W) bool, optional
        Left out where all are.
    truth : dict of str to (H, W) arrays, optional
        Floats keep 16 bits of their mantissa: 8e-6 of the value, 0.4 mK of a radiance.
    """
    import cv2

    def png(image):
        return cv2.imencode(".png", image)[1].tobytes()

    found = {"visible.png": png(np.ascontiguousarray(visible[..., ::-1])), "thermal.png": png(thermal)}
    if valid is not None and not valid.all():
        found["valid.png"] = png(np.where(valid, 255, 0).astype(np.uint8))
    if truth:
        kept = io.BytesIO()
        # NumPy's own .npz at a third of its writer's time, for some per cent more bytes.
        with zipfile.ZipFile(kept, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, values in truth.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, _rounded(np.asarray(values)), allow_pickle=False)
        found["truth.npz"] = kept.getvalue()
    return found


def _rounded(values):
    """Floats in single precision with the last 7 bits of their mantissa 0, to compress better; others as they are."""
    if values.dtype.kind != "f" or values.itemsize < 4:
        return values
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    finite = np.isfinite(values)
    return np.where(finite, (bits + np.uint32(64)) & ~np.uint32(127), bits).view(np.float32)
