"""Traced light kept on disk, so that a scene is traced once and not once per process.

A file's name is a hash of everything its content depends on. A file is written whole or not at all, and its checksum
reveals damage. Only files with such names in the cache's folder are ever removed. The cache affects speed only: without
a usable folder the caller receives the reason to display.
"""

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import formats
from thermorender.cache import LIMITS, cache_folder, trim
from thermorender.errors import ThermorenderError
from thermorender.render.geometry import Geometry
from thermorender.render.light import radiosity
from thermorender.timing import phase

# Largest total size of the files [bytes]; the least recently used are removed first.
LIMIT = LIMITS["light"]
# Tracing fewer rays takes about as long as reading a file.
WORTH_RAYS = 1 << 22


def traced(
    geometry: Geometry, rays: int, progress: Callable[[float], object] | None = None, seed: int = 0
) -> tuple[radiosity.Transport, str | None]:
    """Return (Transport as of `radiosity.trace`, reason why the cache was not used or None); under WORTH_RAYS it is not
    used."""
    if not geometry.kept or geometry.face_count * rays < WORTH_RAYS:
        return radiosity.trace(geometry, rays, progress, seed), None
    name = key(geometry, rays, seed)
    with phase("light read from the cache"):
        transport = load(name)
    if transport is not None:
        return transport, None
    with phase("light traced"):
        transport = radiosity.trace(geometry, rays, progress, seed)
        return transport, store(name, transport)


def key(geometry: Geometry, rays: int, seed: int = 0) -> str:
    """Return the name of a scene's traced light: a hash of its surfaces, the rays, the seed and the versions."""
    digest = hashlib.blake2b(digest_size=20)
    # The ray casters of CPU and GPU differ in the last digits, so each has its own files.
    mi = geometry.mi
    digest.update(repr((radiosity.VERSION, mi.__version__, mi.variant(), rays, seed, len(geometry.surfaces))).encode())
    for surface in geometry.surfaces:
        for values in (surface.vertices, surface.faces):
            _feed(digest, values)
        if surface.seeds is not None:
            _feed(digest, surface.seeds)
        if surface.instances is not None:
            for each in fields(surface.instances):
                # The size of leaves changes the stated error alone.
                if each.name != "leaf_m":
                    _feed(digest, getattr(surface.instances, each.name))
    return digest.hexdigest()


def load(name: str) -> radiosity.Transport | None:
    """Return the Transport stored under `name`, or None where no undamaged one exists."""
    try:
        path = cache_folder("light") / f"{name}.npz"
    except RuntimeError:
        # No home folder exists.
        return None
    found = formats.read_arrays(path, name)
    if found is None:
        return None
    rays = int(found.pop("rays"))
    transport = radiosity.Transport(rays=rays, **found)
    with suppress(OSError):
        # The modification time records when a file was last used.
        os.utime(path)
    return transport


def store(name: str, transport: radiosity.Transport, limit: int | None = None) -> str | None:
    """Store a Transport under `name`, within `limit` bytes of all files, LIMIT where None; return None, or why that
    failed."""
    limit = LIMIT if limit is None else limit
    arrays = {field.name: np.asarray(getattr(transport, field.name)) for field in fields(transport)}
    size = sum(values.nbytes for values in arrays.values())
    if size > limit:
        return f"traced light is not kept: its {size / 1e9:.2g} GB exceed the cache's limit of {limit / 1e9:.2g} GB"
    folder: Path | None = None
    try:
        folder = cache_folder("light")
        formats.write_arrays(folder / f"{name}.npz", name, arrays)
        trim("light", limit, keep=f"{name}.npz")
    except (OSError, RuntimeError, ThermorenderError) as error:
        # RuntimeError: no home folder exists.
        why = error.__cause__ or error
        return (
            f"traced light is not kept: {folder or 'the cache folder'} cannot be written "
            f"({getattr(why, 'strerror', None) or why}); "
            "set THERMORENDER_CACHE to a writable folder"
        )
    return None


def _feed(digest: "hashlib.blake2b", values: NDArray[Any]) -> None:
    """Add an array to a hash, with type and shape, as equal bytes may represent other numbers."""
    values = np.ascontiguousarray(values)
    digest.update(f"{values.dtype.str}{values.shape}".encode())
    digest.update(values.reshape(-1).view(np.uint8).data)
