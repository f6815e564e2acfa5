"""What a stopped flight left in its folder: finished frames to keep, and the state of sensor and display."""

import json
import os
import warnings
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.output import products as product_files

# Explanations of digests, for the error that they differ.
_DIGESTED = {
    "scene_digest": ", of the scene with its files, air and temperatures",
    "path_digest": ", of the trajectory with its anchor, mount, lever arm and clock offset",
}


def finished(folder: Path, settings: dict[str, Any], products: Sequence[str], resume: bool, verify: bool) -> list[bool]:
    """Return for each finished frame whether it shows terrain; drop the lines of other frames from `frames.jsonl`. To
    resume, `settings` must equal those of `flight.json`; otherwise the folder must hold no flight. `verify` compares
    checksums of all files, not only sizes and the checksums of those from which video and MCAP are made."""
    described, lines = folder / "flight.json", folder / "frames.jsonl"
    if not resume:
        refuse_used(folder)
        return []
    files.remove_parts(folder)
    if not described.exists():
        if lines.exists():
            raise ThermorenderError(
                f"{described} is missing beside frames.jsonl; start the flight again in another folder"
            )
        return []
    refuse_other_settings(described, settings)
    kept, terrain, copied = [], [], product_files.copied(products)
    text = lines.read_text(encoding="utf-8", errors="replace") if lines.exists() else ""
    for number, line in enumerate(text.splitlines()):
        try:
            stored = formats.unsealed(json.loads(line))
            index, shows, known, _ = (stored[key] for key in ("index", "shows_terrain", "files", "apparent_k"))
            known = {path: known[path.name] for path in product_files.paths(folder, number, products).values()}
            if index != number or is_damaged(known, product_files.paths(folder, number, copied).values(), verify):
                break
        except (ValueError, KeyError, TypeError):
            break
        kept.append(json.dumps(formats.sealed(stored)))
        terrain.append(shows)
    formats.write_text(lines, "".join(line + "\n" for line in kept))
    return terrain


def refuse_used(folder: Path) -> None:
    """Raise ThermorenderError for a folder that holds a flight or other frames."""
    if (folder / "flight.json").exists() or (folder / "frames.jsonl").exists():
        raise ThermorenderError(
            f"{folder} already holds a flight; give another folder, or set resume to continue that one"
        )
    other = next(folder.glob("frame_*"), None)
    if other:
        raise ThermorenderError(
            f"{folder} already holds {other.name}, which a flight would overwrite; give another folder"
        )


def refuse_other_settings(described: Path, settings: dict[str, Any]) -> None:
    """Raise ThermorenderError if a `flight.json` is damaged or has other settings."""
    try:
        before = json.loads(described.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = None
    if not isinstance(before, dict):
        raise ThermorenderError(f"{described} is damaged; start the flight again in another folder")
    for key, value in settings.items():
        was = before.get(key)
        if was != value:
            if isinstance(was, dict) and isinstance(value, dict):
                inner = next(name for name in was | value if was.get(name, ...) != value.get(name, ...))
                key, was, value = f"{key}.{inner}", was.get(inner), value.get(inner)
            raise ThermorenderError(
                f"{described} was flown with {key}={was!r}, now {key}={value!r}{_DIGESTED.get(key, '')}; resume with "
                "the same settings or give another folder"
            )


def is_damaged(known: Mapping[Path, tuple[int, str]], copied: Collection[Path], verify: bool) -> bool:
    """Return whether one of some files, {path: (size, checksum)}, is not as it was written, and warn of the first. The
    checksums of those that are `copied` into other files are compared, with `verify` those of all."""
    for path, (size, checksum) in known.items():
        whole = path.exists() and path.stat().st_size == size
        if not whole or ((verify or path in copied) and formats.checksum(path) != checksum):
            warnings.warn(
                f"{path} is missing or not as it was written; its frame and those after it are rendered again",
                ThermorenderWarning, stacklevel=2,
            )  # fmt: skip
            return True
    return False


def refuse_moved(folder: Path, before: os.stat_result) -> None:
    """Refuse to continue in a folder that is not the one of the start: files would be lost and locks separate."""
    try:
        same = os.path.samestat(os.stat(folder), before)
    except OSError:
        same = False
    if not same:
        raise ThermorenderError(
            f"{folder} was removed, moved or replaced while it was flown into; continue with resume where it is now, "
            "or start again"
        )


def state_file(folder: Path, index: int) -> Path:
    """Return the file of the state after a frame: one of two in turn, so that the state before is kept."""
    return _state_files(folder)[index % 2]


def load_state(folder: Path, index: int) -> dict[str, NDArray[Any]] | None:
    """Return the state after a frame, {name: array}; None if it is lost or damaged."""
    return formats.read_arrays(state_file(folder, index), index)


def remove_state(folder: Path) -> None:
    """Remove the files of the state, if they exist."""
    for path in _state_files(folder):
        path.unlink(missing_ok=True)


def _state_files(folder: Path) -> tuple[Path, Path]:
    """The files of the state after frames of even and of odd number."""
    return folder / "sensor_even.npz", folder / "sensor_odd.npz"
