"""Splits into training, validation and test parts: by whole sequences, by place, or by single crops.

Related pairs form a group, and whole groups are assigned to the nearest possible shares.
"""

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.training.dataset import PARTS, Entry
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import ecef_from_geodetic

# The published split: 3511, 1003 and 502 of 5016 crops.
SHARES = (0.7, 0.2, 0.1)
# Rule "place": side of a cell, and the distance within which cells belong together [m]. Chosen: several views of a
# camera at 120 m, and about one view.
CELL_M, APART_M = 500.0, 100.0
_METRES_PER_DEGREE = 111_320.0
SUFFIXES = (".json", ".csv")


def assign(
    entries: Sequence[Entry], rule: str = "sequence", shares: Sequence[float] = SHARES, seed: int = 0,
    cell_m: float = CELL_M, apart_m: float = APART_M,
) -> dict[str, str]:  # fmt: skip
    """Return {key: part} of Entries: whole groups, largest first, each into the part that lacks most pairs.

    A group of `rule` is a "sequence"; a "place", a map cell of side `cell_m` with all within `apart_m` [m]; or a single
    "crop", as published. A part's name puts all pairs there. `shares` are those of training, validation and test, with
    one group or more for a share above 0; `seed` orders groups of equal size.
    """
    if rule in PARTS:
        return {entry.key: rule for entry in entries}
    if rule not in RULES:
        raise ThermorenderError(
            f"split rule {rule!r} is unknown; give one of {', '.join(RULES)}, or {', '.join(PARTS)} to put all there"
        )
    shares = [float(share) for share in shares]
    if len(shares) != len(PARTS) or not all(share >= 0.0 for share in shares) or not 0.0 < sum(shares) < math.inf:
        raise ThermorenderError(
            f"shares={tuple(shares)} are not shares of {', '.join(PARTS)}; give three numbers from 0 up, such as "
            f"{SHARES}"
        )
    groups: dict[str | int, list[str]] = {}
    for entry, name in zip(entries, RULES[rule](entries, cell_m, apart_m), strict=True):
        groups.setdefault(name, []).append(entry.key)
    wanted = {part: share / sum(shares) * len(entries) for part, share in zip(PARTS, shares, strict=True) if share}
    if len(groups) < len(wanted):
        raise ThermorenderError(
            f"split rule {rule!r} finds {len(groups)} groups for {len(wanted)} parts; take more pictures, another "
            f"rule, or put all into one part by {' or '.join(PARTS)}{_SMALLER.get(rule, '')}"
        )
    # Sorted by key, so that the order of the entries does not matter.
    members = sorted(map(sorted, groups.values()))
    members = [members[k] for k in np.random.default_rng(seed).permutation(len(members))]
    members.sort(key=len, reverse=True)
    found: dict[str, str] = {}
    empty = set(wanted)
    for left, group in zip(range(len(members), 0, -1), members, strict=True):
        # The last groups go to the empty parts.
        part = max(empty if left == len(empty) else wanted, key=lambda name: (wanted[name], -PARTS.index(name)))
        wanted[part] -= len(group)
        empty.discard(part)
        found |= dict.fromkeys(group, part)
    return {entry.key: found[entry.key] for entry in entries}


def read_split(path: str | Path) -> dict[str, str]:
    """Return {key: part} from a file.

    It is JSON {"train": [keys], "validation": [keys], "test": [keys]}, or CSV with the columns key and part.
    """
    path = Path(path)
    form = 'JSON {"train": [keys], …} or CSV with the columns key,part'
    if path.suffix.lower() not in SUFFIXES:
        raise ThermorenderError(f"{path} is not a split; give {form}")
    text = formats.read_text(path, "UTF-8")
    try:
        if path.suffix.lower() == ".json":
            kept = formats.finite_json(text)
            rows = [(key, part) for part, keys in kept.items() for key in keys]
            usable = all(isinstance(keys, list) for keys in kept.values())
        else:
            rows = [(row["key"], row["part"]) for row in csv.DictReader(io.StringIO(text))]
            usable = True
        usable = usable and bool(rows) and all(isinstance(key, str) and key for key, _ in rows)
    except (ValueError, KeyError, TypeError, AttributeError):
        usable = False
    if not usable:
        raise ThermorenderError(f"{path} is not a split; give {form}")
    found: dict[str, str] = {}
    for key, part in rows:
        if part not in PARTS:
            raise ThermorenderError(f"{path} puts {key!r} into {part!r}; give one of {', '.join(PARTS)}")
        if found.setdefault(key, part) != part:
            raise ThermorenderError(f"{path} puts {key!r} into {found[key]!r} and {part!r}; leave one of them")
    return found


def write_split(path: str | Path, parts: Mapping[str, str]) -> None:
    """Write {key: part} as JSON or CSV, by the path's suffix; `read_split` reads it."""
    path = Path(path)
    files.check_output_file(path, SUFFIXES)
    if path.suffix.lower() == ".json":
        formats.write_json(path, {part: [key for key, own in parts.items() if own == part] for part in PARTS})
    else:
        formats.write_text(path, "".join(f"{key},{part}\n" for key, part in [("key", "part"), *parts.items()]))


# --- groups -----------------------------------------------------------------------------------------------------


def _sequences(entries: Sequence[Entry], cell_m: float, apart_m: float) -> list[str]:
    return [entry.sequence for entry in entries]


def _crops(entries: Sequence[Entry], cell_m: float, apart_m: float) -> list[str]:
    return [entry.key for entry in entries]


def _places(entries: Sequence[Entry], cell_m: float, apart_m: float) -> list[int]:
    """Group of each entry: its map cell, joined with cells that have an entry within `apart_m`."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    for name, length in (("cell_m", cell_m), ("apart_m", apart_m)):
        if not 0.0 < length < math.inf:
            raise ThermorenderError(f"{name}={length:g} is not allowed; give metres above 0")
    position = positions(entries)
    without = [entry.key for entry, where in zip(entries, position, strict=True) if not np.isfinite(where).all()]
    if without:
        raise ThermorenderError(
            f"split rule 'place' needs a place for every pair; {len(without)} of {len(entries)} lack one, the first "
            f"is {without[0]}; add places, or take the rule 'sequence'"
        )
    latitude, longitude = np.array([entry.place for entry in entries], np.float64).reshape(-1, 2).T
    row = np.floor(latitude * _METRES_PER_DEGREE / cell_m)
    # Length of a degree of longitude at the centre of the row of cells.
    middle = np.radians((row + 0.5) * cell_m / _METRES_PER_DEGREE)
    column = np.floor(longitude * _METRES_PER_DEGREE * np.cos(middle) / cell_m)
    _, cell = np.unique(np.stack([row, column], axis=-1), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    near = cell[cKDTree(position).query_pairs(apart_m, output_type="ndarray")]
    count = int(cell.max(initial=-1)) + 1
    joined = connected_components(coo_matrix((np.ones(len(near)), near.reshape(-1, 2).T), (count, count)))[1]
    return [int(group) for group in joined[cell]]


def positions(entries: Sequence[Entry]) -> NDArray[np.float64]:
    """Return Earth-centred coordinates of Entries, (n, 3) float64 [m]; NaN without a place."""
    places = [(math.nan, math.nan) if entry.place is None else entry.place for entry in entries]
    latitude, longitude = np.array(places, np.float64).reshape(-1, 2).T
    return ecef_from_geodetic(latitude, longitude, 0.0)


# {name: function of (entries, cell_m, apart_m) that returns the group of each entry}.
RULES: dict[str, Callable[[Sequence[Entry], float, float], Sequence[str | int]]] = {
    "sequence": _sequences,
    "place": _places,
    "crop": _crops,
}
_SMALLER = {"place": ", or smaller cell_m and apart_m"}
