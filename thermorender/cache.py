"""The cache: a folder for each kind of file that later runs reuse."""

import os
import re
from contextlib import suppress
from pathlib import Path

from thermorender import files

# Traced light, baked tiles, LOWTRAN7 with its results, searches for leaks, tokens of servers, and recent scenes.
CACHED = ("light", "tiles", "lowtran", "leaks", "link", "studio")
# Largest total size of the files of kinds that grow with use [bytes]; the least recently used are removed first.
LIMITS = {"light": 4 << 30, "tiles": 32 << 30, "leaks": 64 << 20}
# Names of their files: a hash of what the content depends on.
_NAME = r"[0-9a-f]{40}"
# A temporary file of this age [s] remains from a killed process.
_STALE_S = 3600.0


def cache_folder(kind: str) -> Path:
    """Return <cache>/kind, for a kind of `CACHED`; <cache> is $THERMORENDER_CACHE, else the platform's cache folder."""
    import platformdirs

    if kind not in CACHED:
        raise ValueError(f"kind={kind!r} is not cached; give one of {', '.join(CACHED)}")
    chosen = os.environ.get("THERMORENDER_CACHE")
    base = Path(chosen).expanduser() if chosen else platformdirs.user_cache_path("thermorender", appauthor=False)
    return base / kind


def kept(kind: str) -> list[tuple[float, int, Path]]:
    """Return (time of last use, bytes, path) of the files of a kind that grows with use, the oldest first."""
    found = list[tuple[float, int, Path]]()
    with suppress(OSError):
        for path in cache_folder(kind).iterdir():
            if re.fullmatch(rf"{_NAME}\.npz", path.name):
                with suppress(OSError):
                    status = path.stat()
                    found.append((status.st_mtime, status.st_size, path))
    return sorted(found)


def trim(kind: str, limit: int, keep: str = "") -> int:
    """Remove the least recently used files of a kind beyond `limit` bytes in total, but for the one named `keep`, and
    remains of killed processes; return the bytes removed."""
    found = kept(kind)
    total = before = sum(size for _, size, _ in found)
    for _, size, path in found:
        if total <= limit:
            break
        # A file that another process removed or holds open is left to the next process.
        if path.name != keep:
            with suppress(OSError):
                path.unlink()
                total -= size
    if cache_folder(kind).is_dir():
        files.remove_parts(cache_folder(kind), _NAME, _STALE_S)
    return before - total
