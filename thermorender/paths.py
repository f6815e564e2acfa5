"""Paths: the folders of the shipped data, and a check that a path is inside a folder."""

import os
from pathlib import Path

from thermorender.errors import ThermorenderError


def data_folder(kind: str) -> Path:
    """Return the folder of shipped "materials" or "scenes": `_data/<kind>` if installed, `<kind>` in a checkout."""
    package = Path(__file__).resolve().parent
    candidates = (package / "_data" / kind, package.parent / kind)
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise ThermorenderError(
        f"the shipped {kind!r} are neither in {candidates[0]} nor in {candidates[1]}; "
        "reinstall thermorender, or work in a complete checkout"
    )


def inside(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> bool:
    """Return whether a path is inside a folder, after all symbolic links are resolved."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
