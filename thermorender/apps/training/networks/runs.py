"""Settings and log of a training's folder, read without PyTorch."""

import json
from pathlib import Path
from typing import Any

from thermorender import formats
from thermorender.errors import ThermorenderError
from thermorender.files import PathLike

_EPOCH = ("crops", "seconds", "core_seconds", "validation_mae_k")
_KINDS = {"method": str, "seed": int, "options": dict, "examples": list}
SETTINGS, LOG, SAMPLES = "settings.json", "log.jsonl", "samples"


def read_settings(folder: PathLike) -> dict[str, Any]:
    """Return the settings of a run's folder, a dict with method, seed, options, examples and more."""
    path = Path(folder) / SETTINGS
    try:
        found = formats.finite_json(formats.read_text(path)) if path.is_file() else None
        if not isinstance(found, dict) or not all(isinstance(found.get(key), kind) for key, kind in _KINDS.items()):
            raise ValueError
        numbers = [found["options"].get("width"), found["options"].get("batch"), *found["examples"][:1]]
        if len(numbers) < 3 or not all(isinstance(each, int) for each in numbers):
            raise ValueError
    except ValueError:
        raise ThermorenderError(
            f"{folder} is not the folder of a training: it has no valid {SETTINGS}; give a folder that `train --run` "
            "wrote"
        ) from None
    return found


def read_log(folder: PathLike) -> list[dict[str, Any]]:
    """Return the epochs of a run's folder, a list of {crops, seconds, core_seconds, losses, validation_mae_k}.

    Incomplete lines are skipped.
    """
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
