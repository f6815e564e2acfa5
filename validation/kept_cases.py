"""Results of a study that was stopped, to continue from."""

import json

from thermorender import formats
from thermorender.errors import ThermorenderError


def kept_cases(path):
    """Return the cases {name: record} that a study's JSON file holds, none where there is no file.

    Raises
    ------
    ThermorenderError
        The file is damaged.
    """
    try:
        return dict(json.loads(formats.read_text(path))["cases"]) if path.is_file() else {}
    except (ValueError, KeyError, TypeError):
        raise ThermorenderError(f"{path} is damaged; remove it, or give another folder") from None
