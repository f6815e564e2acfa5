"""Traced light kept on disk, so that a scene is traced once and not once per process.

A file's name is a hash of all that its content depends on; a scene that changes has another name. A file is written
whole or not at all, and a checksum tells what is damaged; what is damaged is traced again. Only files of such names in
the cache's own folder for light are ever removed. Only the speed depends on the cache: without a usable folder
everything works, and the reason is handed to the caller to be shown.
"""

import hashlib
import os
import re
from contextlib import suppress
from dataclasses import fields

import numpy as np

from thermorender import files, formats
from thermorender.cache import cache_folder
from thermorender.errors import ThermorenderError
from thermorender.render.light import radiosity

# Bytes that all files together may take; the longest unused go first.
LIMIT = 4 << 30
# A scene of fewer rays is traced in about the time that reading a file takes.
WORTH_RAYS = 1 << 22
# What a file is called, without its suffix: the hash of `key`.
_NAME = r"[0-9a-f]{40}"
# A temporary file this old [s] is left over from a process that was killed.
_STALE_S = 3600.0


def traced(geometry, rays, progress=None, seed=0):
    """Return (Transport of a scene, reason why the disk cache could not be used or None).

    As `radiosity.trace`, but read from disk where the same scene was traced before. Small scenes, below WORTH_RAYS, are
    always traced.
    """
    if geometry.face_count * rays < WORTH_RAYS:
        return radiosity.trace(geometry, rays, progress, seed), None
    name = key(geometry, rays, seed)
    transport = load(name)
    if transport is not None:
        return transport, None
    transport = radiosity.trace(geometry, rays, progress, seed)
    return transport, store(name, transport)


def key(geometry, rays, seed=0):
    """Return the name of a scene's traced light: a hash of its surfaces, the rays, the seed and the program."""
    digest = hashlib.blake2b(digest_size=20)
    # The CPU's and the GPU's ray casters differ in the last digits, so each keeps its own.
    mi = geometry.mi
    digest.update(repr((radiosity.VERSION, mi.__version__, mi.variant(), rays, seed, len(geometry.surfaces))).encode())
    for surface in geometry.surfaces:
        for values in (surface.vertices, surface.faces):
            _feed(digest, values)
    return digest.hexdigest()


def load(name):
    """Return the Transport stored under `name`, or None where there is none that is whole."""
    try:
        path = cache_folder("light") / f"{name}.npz"
    except RuntimeError:
        # There is no home folder.
        return None
    found = formats.read_arrays(path, name)
    if found is None:
        return None
    transport = radiosity.Transport(**found | {"rays": int(found["rays"])})
    with suppress(OSError):
        # The time of change tells when a file was last used.
        os.utime(path)
    return transport


def store(name, transport, limit=None):
    """Store a Transport under `name`; return None, or the reason why that was not possible.

    Parameters
    ----------
    name : str
    transport : Transport
    limit : int, optional
        Bytes that all files together may take; LIMIT where None. The longest unused are removed.
    """
    limit = LIMIT if limit is None else limit
    arrays = {field.name: np.asarray(getattr(transport, field.name)) for field in fields(transport)}
    size = sum(values.nbytes for values in arrays.values())
    if size > limit:
        return f"traced light is not kept: its {size / 1e9:.2g} GB are more than the {limit / 1e9:.2g} GB of the cache"
    folder = "the cache folder"
    try:
        folder = cache_folder("light")
        formats.write_arrays(folder / f"{name}.npz", name, arrays)
        _trim(folder, limit, keep=f"{name}.npz")
    except (OSError, RuntimeError, ThermorenderError) as error:
        # RuntimeError: there is no home folder.
        why = error.__cause__ or error
        return (
            f"traced light is not kept: {folder} cannot be written ({getattr(why, 'strerror', None) or why}); "
            "set THERMORENDER_CACHE to a folder that can"
        )
    return None


def _trim(folder, limit, keep):
    """Remove the longest unused files until all take at most `limit` bytes, and what killed processes left."""
    kept = []
    for path in folder.iterdir():
        if re.fullmatch(rf"{_NAME}\.npz", path.name):
            with suppress(OSError):
                status = path.stat()
                kept.append((path.name == keep, status.st_mtime, status.st_size, path))
    total = sum(size for _, _, size, _ in kept)
    for newest, _, size, path in sorted(kept):
        if newest or total <= limit:
            break
        # Where another process was faster, or holds it open, the next one removes it.
        with suppress(OSError):
            path.unlink()
        total -= size
    files.remove_parts(folder, _NAME, _STALE_S)


def _feed(digest, values):
    """Add an array to a hash: type and shape too, as equal bytes may mean other numbers."""
    values = np.ascontiguousarray(values)
    digest.update(f"{values.dtype.str}{values.shape}".encode())
    digest.update(values.reshape(-1).view(np.uint8))
