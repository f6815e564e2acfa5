"""Where the data that ship with the package lie, in the wheel or beside it in a checkout; what lies in a folder."""

import os
from pathlib import Path

from thermorender.errors import ThermorenderError


def data_folder(kind):
    """Return the folder of the shipped data of one kind, "materials" or "scenes".

    A wheel carries them inside the package as `_data/<kind>`; in a source checkout they lie in the
    repository's top level, where people edit them.

    Raises
    ------
    ThermorenderError
        Neither folder exists.
    """
    package = Path(__file__).resolve().parent
    candidates = (package / "_data" / kind, package.parent / kind)
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise ThermorenderError(
        f"the shipped {kind!r} were looked for in {candidates[0]} and {candidates[1]} and are in neither; "
        "reinstall thermorender, or work in a complete checkout"
    )


def inside(path, folder):
    """Return whether a path, all its symbolic links followed, lies in a folder."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
