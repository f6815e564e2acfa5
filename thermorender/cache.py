"""The cache: a folder for each kind of file that later runs reuse."""

import os
from pathlib import Path

# Traced light, baked tiles, LOWTRAN7 with its results, and the tokens of servers.
CACHED = ("light", "tiles", "lowtran", "link")


def cache_folder(kind: str) -> Path:
    """Return <cache>/kind, for a kind of `CACHED`; <cache> is $THERMORENDER_CACHE, else the platform's cache folder."""
    import platformdirs

    if kind not in CACHED:
        raise ValueError(f"kind={kind!r} is not cached; give one of {', '.join(CACHED)}")
    chosen = os.environ.get("THERMORENDER_CACHE")
    base = Path(chosen).expanduser() if chosen else platformdirs.user_cache_path("thermorender", appauthor=False)
    return base / kind
