"""The cache: a folder for each kind of file that is kept between runs."""

import os
from pathlib import Path

# Traced light, and LOWTRAN7 with what it computed.
CACHED = ("light", "lowtran")


def cache_folder(kind):
    """Return the folder of one kind of kept files, of `CACHED`: <cache>/kind.

    The cache is $THERMORENDER_CACHE, else the user's cache folder of this platform.
    """
    import platformdirs

    if kind not in CACHED:
        raise ValueError(f"kind={kind!r} is not kept; give one of {', '.join(CACHED)}")
    chosen = os.environ.get("THERMORENDER_CACHE")
    base = Path(chosen).expanduser() if chosen else platformdirs.user_cache_path("thermorender", appauthor=False)
    return base / kind
