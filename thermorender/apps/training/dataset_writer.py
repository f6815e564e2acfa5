"""Writing a data set, shard by shard, so that an interrupted one can be resumed."""

import io
import json
import os
import re
import tarfile
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.training.dataset import BLOCK, FORMAT, KEY, PARTS, Entry, ThermalScale, is_shard, read_dataset
from thermorender.errors import ThermorenderError
from thermorender.versions import versions

# A temporary shard without writes for this long is the remainder of a killed process [s].
_ABANDONED_S = 3600.0
# Suffixes of the names of a pair's files.
_END = re.compile(r"[a-z]+\.[a-z]+")


def _names(folder: Path) -> set[str]:
    """Names in a folder, without the temporary files of running writers."""
    return {each.name for each in folder.iterdir() if not each.name.startswith(".")}


def refuse_strange(folder: str | Path) -> None:
    """Refuse a folder that holds anything but a data set or the remains of an interrupted start."""
    folder = Path(folder)
    names = _names(folder) if folder.is_dir() else set()
    strange = names - {"shards"} or (names and _names(folder / "shards"))
    if strange and not (folder / "card.json").exists():
        raise ThermorenderError(f"{folder} is not empty and does not hold a data set; give a new folder")


class Writer:
    """Writes a data set, shard by shard; one with the same card is resumed after its last complete shard."""

    def __init__(self, folder: str | Path, card: Mapping[str, Any], scale: ThermalScale, resume: bool = False) -> None:
        self.folder = files.make_folder(folder)
        self.card = {"format": FORMAT, **card, "thermal": asdict(scale)}
        # As read back from the file.
        self.card = json.loads(json.dumps(self.card))
        # {key: shard} of the index lines read so far; the file's inode, and how many bytes were read.
        self._known: dict[str, str] = {}
        self._read = 0, 0
        path, shards = self.folder / "card.json", self.folder / "shards"
        refuse_strange(self.folder)
        files.make_folder(shards)
        # Other processes may start or resume the same data set.
        with self._locked():
            self._begin(path, resume)
            self._read_index()

    def _locked(self) -> AbstractContextManager[None]:
        """Wait for other Writers of this folder; the lock on the folder itself stays free for its users."""
        return files.in_use(self.folder / "shards", wait=True)

    def _begin(self, path: Path, resume: bool) -> None:
        """Write the card, or check that it is the same and remove what a killed process left."""
        if path.exists():
            before = read_dataset(self.folder)
            if not resume:
                raise ThermorenderError(
                    f"{self.folder} already holds a data set; give a new folder, or --resume to continue it"
                )
            for key in self.card | before.card:
                if key != "versions" and before.card.get(key) != self.card.get(key):
                    raise ThermorenderError(
                        f"{path} has {key}={before.card.get(key)!r}, now {self.card.get(key)!r}; continue with the "
                        "same settings, or give another folder"
                    )
            self._remove_partial_line()
            self._remove_incomplete_shards()
        else:
            formats.write_json(path, self.card | {"versions": versions()})
        # Card and index are written under the lock, shards by several processes at a time.
        files.remove_parts(self.folder, "card|index|trial")
        files.remove_parts(self.folder / "shards", older_s=_ABANDONED_S)

    def _remove_partial_line(self) -> None:
        """Remove a last line of the index that a killed process left incomplete."""
        path = self.folder / "index.jsonl"
        if path.exists():
            data = path.read_bytes()
            if data and not data.endswith(b"\n"):
                os.truncate(path, data.rfind(b"\n") + 1)

    def _remove_incomplete_shards(self) -> None:
        """Remove the index lines whose shard is missing, truncated, or only partly indexed."""
        last: dict[str, tuple[int, str]] = {}
        for entry in read_dataset(self.folder).entries:
            end = max((offset + length for offset, length in entry.members.values()), default=0)
            if end >= last.get(entry.shard, (0, ""))[0]:
                last[entry.shard] = end, entry.key
        broken = {shard for shard, (end, key) in last.items() if not self._ends(shard, end, key)}
        if broken:
            self._without(broken)

    def _ends(self, shard: str, end: int, key: str) -> bool:
        """Whether after byte `end` a shard holds exactly one more file, the pair's line."""
        try:
            with open(self.folder / shard, "rb") as file:
                file.seek(-(-end // BLOCK) * BLOCK)
                with tarfile.open(fileobj=file, mode="r:") as rest:
                    return rest.getnames() == [f"{key}.json"]
        except (OSError, tarfile.TarError):
            return False

    def _without(self, shards: set[str]) -> None:
        """Remove the lines of some shards from the index."""
        path = self.folder / "index.jsonl"
        kept = [line for line in formats.read_text(path).splitlines(keepends=True)
                if json.loads(line)["shard"] not in shards]  # fmt: skip
        formats.write_text(path, "".join(kept))

    def _read_index(self) -> None:
        """Read the index lines that other processes added since the last call."""
        self._remove_partial_line()
        path = self.folder / "index.jsonl"
        if not path.exists():
            return
        with open(path, "rb") as file:
            number, size = os.fstat(file.fileno()).st_ino, os.fstat(file.fileno()).st_size
            if number != self._read[0] or size < self._read[1]:
                self._known, self._read = {}, (number, 0)
            file.seek(self._read[1])
            for line in file.read().splitlines():
                entry = json.loads(line)
                self._known[entry["key"]] = entry["shard"]
        self._read = number, size

    def has(self, name: str) -> bool:
        """Return whether the shard of this name is complete."""
        return f"shards/{name}.tar" in self._known.values()

    def shard(self, name: str, pairs: Iterable[tuple[Entry, Mapping[str, bytes]]]) -> tuple[Entry, ...]:
        """Write a shard of pairs with their files as by `packed`, then their index lines; return the Entries."""
        entries, shard = [], f"shards/{name}.tar"
        if not is_shard(shard):
            raise ThermorenderError(f"{name!r} is not a name for a shard; give letters, digits, _ and -")
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
                    members[end] = (tar.offset - -(-len(data) // BLOCK) * BLOCK, len(data))
                entry = replace(entry, shard=shard, members=members)
                line = json.dumps(asdict(entry)).encode()
                info = tarfile.TarInfo(f"{entry.key}.json")
                info.size = len(line)
                tar.addfile(info, io.BytesIO(line))
                entries.append(entry)
        files.on_disk(self.folder / shard)
        self._append(shard, entries)
        return tuple(entries)

    def _append(self, shard: str, entries: Sequence[Entry]) -> None:
        """Append a shard's lines to the index."""
        path = self.folder / "index.jsonl"
        with self._locked():
            self._read_index()
            if shard in self._known.values():
                # Another process wrote the same shard; the file on disk is the last one.
                self._without({shard})
            formats.append_json(path, *map(asdict, entries))
            self._read_index()


def _refuse(entry: Entry, contents: Mapping[str, bytes], taken: set[str]) -> None:
    """Refuse a pair that could not be read back."""
    if not KEY.fullmatch(entry.key):
        raise ThermorenderError(f"{entry.key!r} is not a key of a pair; give letters, digits, _ and -")
    if entry.key in taken:
        raise ThermorenderError(f"{entry.key!r} is the key of two pairs; give each a different one")
    if entry.part not in PARTS:
        raise ThermorenderError(f"part={entry.part!r} of {entry.key!r} is unknown; give one of {', '.join(PARTS)}")
    for end in contents:
        if not _END.fullmatch(end):
            raise ThermorenderError(f"{end!r} of {entry.key!r} is not a suffix of a name; give one such as visible.png")


def packed(
    visible: NDArray[np.uint8], thermal: NDArray[np.uint8] | NDArray[np.uint16], valid: NDArray[np.bool_] | None = None,
    truth: Mapping[str, NDArray[Any]] | None = None,
) -> dict[str, bytes]:  # fmt: skip
    """Return {suffix of a file's name: bytes} of a pair's pictures, (H, W, …).

    No mask is stored if all pixels are valid. Floats of the truth keep 16 bits of their mantissa: relative error 8e-6,
    or 0.4 mK of a radiance.
    """
    import cv2

    def png(image: np.ndarray) -> bytes:
        return cv2.imencode(".png", image)[1].tobytes()

    found = {"visible.png": png(np.ascontiguousarray(visible[..., ::-1])), "thermal.png": png(thermal)}
    if valid is not None and not valid.all():
        found["valid.png"] = png(np.where(valid, 255, 0).astype(np.uint8))
    if truth:
        kept = io.BytesIO()
        # NumPy's .npz format in a third of the time of its own writer, for a few per cent more bytes.
        with zipfile.ZipFile(kept, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, values in truth.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, _rounded(np.asarray(values)), allow_pickle=False)
        found["truth.npz"] = kept.getvalue()
    return found


def _rounded(values: np.ndarray) -> np.ndarray:
    """Floats in single precision with the last 7 mantissa bits 0, to compress better; other types unchanged."""
    if values.dtype.kind != "f" or values.itemsize < 4:
        return values
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    finite = np.isfinite(values)
    return np.where(finite, (bits + np.uint32(64)) & ~np.uint32(127), bits).view(np.float32)
