"""A data set: pairs of a visible and a thermal picture of the same view, in shards, with an index and a card.

A folder holds

- `card.json`: what all pairs share: where they come from, band and camera, what a thermal value stands for, settings;
- `index.jsonl`: a line per pair, appended once its shard is whole, and never rewritten;
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

from thermorender import files
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
        """Return the Pair of an Entry; `truth` False leaves out what only simulations know.

        Raises
        ------
        ThermorenderError
            A shard is missing or damaged.
        """
        import cv2

        path = self.folder / entry.shard
        found = {}
        try:
            with open(path, "rb") as file:
                for name, (offset, size) in entry.members.items():
                    if truth or not name.startswith("truth"):
                        file.seek(offset)
                        found[name] = file.read(size)
        except OSError as error:
            raise ThermorenderError(
                f"{path} cannot be read ({error.strerror}); copy the data set anew, or leave the shard's lines out of "
                "index.jsonl"
            ) from None

        def picture(name, flag):
            image = cv2.imdecode(np.frombuffer(found[name], np.uint8), flag) if len(found.get(name, b"")) else None
            if image is None or image.shape[:2] != tuple(entry.shape):
                raise ThermorenderError(
                    f"{path} is damaged: {entry.key}.{name} is no picture of {entry.shape[1]}×{entry.shape[0]} pixels; "
                    "make the shard anew"
                )
            return image

        visible = picture("visible.png", cv2.IMREAD_COLOR)[..., ::-1]
        thermal = picture("thermal.png", cv2.IMREAD_UNCHANGED)
        valid = np.ones(thermal.shape, bool)
        if "valid.png" in found:
            valid = picture("valid.png", cv2.IMREAD_GRAYSCALE) > 0
        images = {}
        if found.get("truth.npz"):
            with np.load(io.BytesIO(found["truth.npz"]), allow_pickle=False) as kept:
                images = dict(kept)
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
        card = json.loads(files.read_text(path))
        scale = ThermalScale(**{k: tuple(v) if isinstance(v, list) else v for k, v in card["thermal"].items()})
        if card["format"] != FORMAT or scale.unit not in UNITS:
            raise ValueError(f"format {card['format']}, unit {scale.unit!r}")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ThermorenderError(
            f"{path} is no card of a data set of format {FORMAT} ({error}); make the data set anew"
        ) from None
    entries, seen = [], set()
    index = folder / "index.jsonl"
    lines = files.read_text(index).splitlines() if index.exists() else []
    for number, line in enumerate(lines, 1):
        try:
            values = json.loads(line)
            values["members"] = {name: tuple(at) for name, at in values["members"].items()}
            entry = Entry(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
            usable = _KEY.fullmatch(entry.key) and entry.part in PARTS and _inside(entry.shard)
        except (ValueError, KeyError, TypeError, AttributeError):
            usable = False
            if number == len(lines):
                break
        if not usable or entry.key in seen:
            raise ThermorenderError(f"{index}, line {number} is no pair of its own; remove the line")
        seen.add(entry.key)
        entries.append(entry)
    return Dataset(folder, card, entries, scale)


def _inside(shard):
    return re.fullmatch(r"shards/[A-Za-z0-9_-]+\.tar", shard) is not None


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
        path = self.folder / "card.json"
        # As it is read back.
        self.card = json.loads(json.dumps(self.card))
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
            self.done = {entry.shard for entry in before.entries}
            # Not what another process may be writing.
            files.remove_parts(self.folder / "shards", older_s=_ABANDONED_S)
            self._cut_short()
        elif any(self.folder.iterdir()):
            raise ThermorenderError(f"{self.folder} is not empty and holds no data set; give a new folder")
        else:
            self.done = set()
            files.make_folder(self.folder / "shards")
            files.write_json(path, self.card | {"versions": versions()})

    def _cut_short(self):
        """Take away the last line of the index if a killed process left it without its end."""
        path = self.folder / "index.jsonl"
        if path.exists():
            data = path.read_bytes()
            if data and not data.endswith(b"\n"):
                os.truncate(path, data.rfind(b"\n") + 1)

    def has(self, name):
        """Return whether the shard of this name is whole."""
        return f"shards/{name}.tar" in self.done

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
        """
        entries, shard = [], f"shards/{name}.tar"
        if not _inside(shard):
            raise ThermorenderError(f"{name!r} is no name for a shard; give letters, digits, _ and -")
        with files.atomic(self.folder / shard) as part, tarfile.open(part, "w") as tar:
            for entry, contents in pairs:
                if not _KEY.fullmatch(entry.key):
                    raise ThermorenderError(f"{entry.key!r} is no key of a pair; give letters, digits, _ and -")
                members = {}
                for end, data in contents.items():
                    info = tarfile.TarInfo(f"{entry.key}.{end}")
                    info.size = len(data)
                    tar.addfile(info, io.BytesIO(data))
                    members[end] = (tar.offset - -(-len(data) // 512) * 512, len(data))
                entry = replace(entry, shard=shard, members=members)
                told = json.dumps(asdict(entry)).encode()
                info = tarfile.TarInfo(f"{entry.key}.json")
                info.size = len(told)
                tar.addfile(info, io.BytesIO(told))
                entries.append(entry)
        path = self.folder / "index.jsonl"
        with open(path, "ab") as file:
            file.write("".join(json.dumps(asdict(entry)) + "\n" for entry in entries).encode())
            file.flush()
            os.fsync(file.fileno())
        self.done.add(shard)
        return tuple(entries)


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
