"""Earlier results of a study that continues."""

import json

from thermorender import formats
from thermorender.errors import ThermorenderError


def kept_cases(path):
    """Return the cases {name: record} of a study's JSON file; empty without a file.

    Raises
    ------
    ThermorenderError
        The file is damaged.
    """
    try:
        return dict(json.loads(formats.read_text(path))["cases"]) if path.is_file() else {}
    except (ValueError, KeyError, TypeError):
        raise ThermorenderError(f"{path} is damaged; remove it, or give another folder") from None


def kept_parts(path, settings):
    """Return the parts {name: record} of a study's JSON file, of these `settings` {name: value}; those without a file.

    Raises
    ------
    ThermorenderError
        The file is damaged, or of other settings.
    """
    if not path.is_file():
        return dict(settings)
    try:
        found = dict(json.loads(formats.read_text(path)))
    except (ValueError, TypeError):
        raise ThermorenderError(f"{path} is damaged; remove it, or give another folder") from None
    for name, value in settings.items():
        if found.get(name) != value:
            raise ThermorenderError(
                f"{path} has {name}={found.get(name)}, not {value}; give the former value, or another folder"
            )
    return found
