"""The verb `cache`: what later runs reuse, where it is and how large, and how to make it smaller."""

from typing import Annotated

import numpy as np
import typer

from thermorender.cache import CACHED, LIMITS, cache_folder, kept, trim
from thermorender.cli.terminal import table
from thermorender.errors import ThermorenderError

_HOLDS = {
    "light": "traced light of scenes", "tiles": "baked tiles of ground of any size",
    "lowtran": "LOWTRAN7 and its results", "leaks": "searches of data sets for leaks",
    "link": "tokens of servers", "studio": "recent scenes",
}  # fmt: skip


def cache(
    shrink: Annotated[
        list[str] | None, typer.Option(help="KIND=GB: remove the least recently used files of light, tiles or leaks "
                                       "beyond so many gigabytes; may be repeated.")
    ] = None,
) -> None:  # fmt: skip
    """Print what later runs reuse and how large it is; or make it smaller."""
    try:
        cache_folder(CACHED[0])
    except RuntimeError as error:
        raise ThermorenderError("no home folder is known; set THERMORENDER_CACHE to a folder") from error
    for text in shrink or ():
        kind, limit = _parsed(text)
        typer.echo(f"{kind}: {trim(kind, limit) / 1e9:.3g} GB removed")
    rows = []
    for kind in CACHED:
        folder = cache_folder(kind)
        sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()] if folder.is_dir() else []
        used = kept(kind)
        last = np.datetime64(int(used[-1][0]), "s").item().isoformat(" ", "minutes") + "Z" if used else ""
        most = f"{LIMITS[kind] / 1e9:.3g} GB" if kind in LIMITS else ""
        rows.append((kind, str(len(sizes)), f"{sum(sizes) / 1e9:.3g} GB", most, last, _HOLDS[kind], str(folder)))
    table(("kind", "files", "size", "at most", "last used", "holds", "folder"), rows)


def _parsed(text: str) -> tuple[str, int]:
    """(Kind, bytes) of KIND=GB."""
    kind, mark, number = text.partition("=")
    try:
        limit = float(number)
    except ValueError:
        limit = -1.0
    if kind not in LIMITS or not mark or not 0.0 <= limit < 1e6:
        raise ThermorenderError(
            f"--shrink={text!r} is not allowed; give {' or '.join(LIMITS)}, = and gigabytes, as in --shrink tiles=5"
        )
    return kind, int(limit * 1e9)
