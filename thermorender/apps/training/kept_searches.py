"""Searches for leaks that later runs reuse: their results by a fingerprint of the pictures that were searched."""

import hashlib
import json
import os
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from thermorender import formats
from thermorender.cache import LIMITS, cache_folder, trim
from thermorender.errors import ThermorenderError
from thermorender.versions import versions


def kept(key: object, search: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the plain values that `search` finds, or found before; the `repr` of `key` says all that they depend on.

    A cache that cannot be read or written costs the search only.
    """
    state = repr((versions()["thermorender"], key))
    name = hashlib.blake2b(state.encode(), digest_size=20).hexdigest()
    path = None
    # No home folder exists.
    with suppress(RuntimeError):
        path = cache_folder("leaks") / f"{name}.npz"
    before = None if path is None else formats.read_arrays(path, name)
    if path is not None and before is not None:
        with suppress(OSError):
            # The modification time records when a file was last used.
            os.utime(path)
        found: dict[str, Any] = json.loads(before["json"].tobytes())
        return found
    text = json.dumps(search()).encode()
    if path is not None:
        with suppress(OSError, ThermorenderError):
            formats.write_arrays(path, name, {"json": np.frombuffer(text, np.uint8)})
            trim("leaks", LIMITS["leaks"], keep=path.name)
    # As a later run reads it.
    found = json.loads(text)
    return found
