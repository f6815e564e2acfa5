"""Folder of a training: settings, log and sample pictures, without PyTorch.

It holds `settings.json`, `log.jsonl`, `last.safetensors` (the state to resume from), `best.safetensors` (the network
with the least validation error) and `samples/`.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermorender import files, formats
from thermorender.apps.training.networks.crops import Crop
from thermorender.errors import ThermorenderError
from thermorender.files import PathLike
from thermorender.versions import versions

_EPOCH = ("crops", "seconds", "core_seconds", "validation_mae_k")
_KINDS = {"method": str, "seed": int, "options": dict, "examples": list}
SETTINGS, LOG, SAMPLES, LAST, BEST = "settings.json", "log.jsonl", "samples", "last.safetensors", "best.safetensors"
# Errors are shown from blue to red up to this [K]; truth and translation share a grey scale in each row.
_ERROR_K = 10.0
_GAP = 4


def begin(folder: Path, settings: dict[str, Any], resume: bool) -> None:
    """Write a run's settings, or check that a run with the same ones is to be resumed."""
    for each in (folder, folder / SAMPLES):
        if each.is_dir():
            files.remove_parts(each)
    path, last = folder / SETTINGS, folder / LAST
    if not path.exists() and not last.exists():
        formats.write_json(path, settings | {"versions": versions()})
    else:
        check(folder, settings)
        if not resume:
            raise ThermorenderError(f"{folder} holds a training; continue it with --resume, or give another --run")
    if not last.exists():
        # It was stopped in the first epoch.
        cut_log(folder, 0)
        (folder / BEST).unlink(missing_ok=True)


def check(folder: Path, settings: dict[str, Any]) -> None:
    """Refuse a run of other settings."""
    kept = read_settings(folder)
    differing = [name for name in settings if kept.get(name) != settings[name]]
    if differing:
        raise ThermorenderError(
            f"{folder} holds a training of other settings ({', '.join(differing)}); give another --run"
        )


def read_settings(folder: PathLike) -> dict[str, Any]:
    """Return the settings of a run's folder, a dict with method, seed, options, examples and more."""
    path = Path(folder) / SETTINGS
    try:
        found = formats.finite_json(formats.read_text(path)) if path.is_file() else None
        if not isinstance(found, dict) or not all(isinstance(found.get(key), kind) for key, kind in _KINDS.items()):
            raise ValueError
        numbers = [found["options"].get("width"), found["options"].get("batch"), *found["examples"][:1]]
        if len(numbers) < 3 or not all(isinstance(each, int) for each in numbers) or found["seed"] < 0:
            raise ValueError
    except ValueError:
        raise ThermorenderError(
            f"{folder} is not the folder of a training: it has no valid {SETTINGS}; give a folder that `train --run` "
            "wrote"
        ) from None
    return found


def read_log(folder: PathLike) -> list[dict[str, Any]]:
    """Return the epochs of a run's folder, a list of {crops, seconds, core_seconds, losses, validation_mae_k}."""
    path = Path(folder) / LOG
    found = []
    for line in formats.read_text(path).splitlines() if path.is_file() else ():
        try:
            epoch = formats.finite_json(line)
        except ValueError:
            continue
        if isinstance(epoch, dict) and all(
            isinstance(epoch.get(name), int | float) and epoch[name] >= 0 for name in _EPOCH
        ):
            found.append(epoch)
    return found


def cut_log(folder: PathLike, crops: int) -> None:
    """Remove the epochs after `crops` crops from the log."""
    kept = [line for line in read_log(folder) if line["crops"] <= crops]
    formats.write_text(Path(folder) / LOG, "".join(json.dumps(line) + "\n" for line in kept))


def write_samples(path: Path, shown: Sequence[tuple[Crop, np.ndarray, np.ndarray]]) -> None:
    """Write a PNG with a row of photograph, truth, translation and error for each (crop, true, translated) [K]."""
    rows = []
    for crop, true, found in shown:
        known = np.isfinite(true)
        low, high = np.percentile(true[known], (1.0, 99.0)) if known.any() else (0.0, 1.0)
        grey = [np.nan_to_num(np.clip((each - low) / max(high - low, 0.1), 0.0, 1.0)) for each in (true, found)]
        off = np.clip(np.nan_to_num((found - true) / _ERROR_K), -1.0, 1.0)
        error = np.stack([1.0 + np.minimum(off, 0.0), 1.0 - np.abs(off), 1.0 - np.maximum(off, 0.0)], axis=-1)
        tiles = [crop.inputs.rgb, *(np.repeat(255.0 * each[..., None], 3, axis=-1) for each in grey), 255.0 * error]
        framed = (np.pad(tile.astype(np.uint8), ((_GAP, 0), (_GAP, 0), (0, 0))) for tile in tiles)
        rows.append(np.concatenate(list(framed), axis=1))
    formats.write_image(path, np.concatenate(rows))
