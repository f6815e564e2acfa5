"""Traced light kept on disk, so that a scene is traced once and not once per process.

A file's name is a hash of all that its content depends on; a scene that changes has another name. A file is written
under a temporary name and renamed when complete, so neither an interruption nor another process leaves half a
file; a checksum tells what is damaged, and what is damaged is traced again. Only the speed depends on the cache:
without a usable folder everything works, and the reason is handed to the caller to be shown.
"""

import hashlib
import os
import sys
import tempfile
import time
from dataclasses import fields
from pathlib import Path

import numpy as np

from thermorender.render.light import radiosity

# Bytes that all files together may take; the longest unused go first.
LIMIT = 4 << 30
# A scene of fewer rays is traced in about the time that reading a file takes.
WORTH_RAYS = 1 << 22
# A temporary file this old [s] is left over from a process that was killed.
_STALE_S = 3600.0
_ARRAYS = tuple(field.name for field in fields(radiosity.Transport) if field.name != "rays")


def folder():
    """Return the cache's folder: $THERMORENDER_CACHE, else the user's cache folder of this platform."""
    chosen = os.environ.get("THERMORENDER_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "thermorender"


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
        path = folder() / f"{name}.npz"
        # Opened here, because NumPy leaves a file open that it cannot read.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            found = {which: stored[which] for which in ("rays", *_ARRAYS, "checksum")}
        transport = radiosity.Transport(int(found["rays"]), *(found[which] for which in _ARRAYS))
        if str(found["checksum"]) != _checksum(name, transport):
            return None
    except Exception:
        # Absent, or damaged, which shows as nearly any exception of zipfile's and NumPy's parsers: trace again.
        return None
    try:
        # The time of change tells when a file was last used.
        os.utime(path)
    except OSError:
        pass
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
    arrays = {which: getattr(transport, which) for which in _ARRAYS}
    size = sum(values.nbytes for values in arrays.values())
    if size > limit:
        return f"traced light is not kept: its {size / 1e9:.2g} GB are more than the {limit / 1e9:.2g} GB of the cache"
    place, temporary = "the cache folder", None
    try:
        place = folder()
        place.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=name, suffix=".part", dir=place)
        with os.fdopen(handle, "wb") as file:
            np.savez(file, rays=transport.rays, checksum=_checksum(name, transport), **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, place / f"{name}.npz")
        temporary = None
        _trim(place, limit, keep=f"{name}.npz")
    except (OSError, RuntimeError) as error:
        # RuntimeError: there is no home folder.
        why = getattr(error, "strerror", None) or error
        return (
            f"traced light is not kept: {place} cannot be written ({why}); "
            "set THERMORENDER_CACHE to a folder that can"
        )
    finally:
        # Not only after an error: an interruption passes here too.
        if temporary is not None:
            _remove(Path(temporary))
    return None


def _trim(place, limit, keep):
    """Remove the longest unused files until all take at most `limit` bytes, and what killed processes left."""
    files = []
    for path in place.iterdir():
        try:
            status = path.stat()
        except OSError:
            continue
        if path.suffix == ".part" and time.time() - status.st_mtime > _STALE_S:
            _remove(path)
        elif path.suffix == ".npz" and path.name != keep:
            files.append((status.st_mtime, status.st_size, path))
        elif path.name == keep:
            limit -= status.st_size
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= limit:
            break
        _remove(path)
        total -= size


def _remove(path):
    try:
        path.unlink()
    except OSError:
        # Another process was faster, or holds it open; the next one removes it.
        pass


def _checksum(name, transport):
    digest = hashlib.blake2b(f"{name} {transport.rays}".encode(), digest_size=20)
    for which in _ARRAYS:
        _feed(digest, getattr(transport, which))
    return digest.hexdigest()


def _feed(digest, values):
    """Add an array to a hash: type and shape too, as equal bytes may mean other numbers."""
    values = np.ascontiguousarray(values)
    digest.update(f"{values.dtype.str}{values.shape}".encode())
    digest.update(values.reshape(-1).view(np.uint8))
