"""Subtitles that DJI aircraft write beside a video: position, height and angles of each cue.

Older aircraft write `GPS(longitude, latitude, satellites)` with `BAROMETER:`, `Hb:` or `H` above take-off, or with a
unit `GPS(latitude, longitude, altitude)`; `F.PRY` and `G.PRY` are pitch, roll and yaw of aircraft and gimbal. Newer
ones write `[key: value]` pairs, whose `altitude` has no stated reference, so only its changes are used.
"""

import re

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import read_text
from thermorender.trajectory.column_mapping import UNSTATED
from thermorender.trajectory.tables import Floats, Table

_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_TIME = re.compile(r"\b(\d{1,3}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
# Some programs write numbers with decimal commas, in brackets of one value.
_PAIR = re.compile(r"\b([a-z_]+)\s*:\s*([-+]?\d+(?:[.,]\d+)?)")
_GPS = re.compile(r"\bGPS\s*\(([^)]*)\)")
_HEIGHT = re.compile(rf"\b(?:BAROMETER\s*:|Hb\s*:|H)\s*{_NUMBER}")
_ANGLES = re.compile(rf"\b([FG])\.PRY\s*\(\s*{_NUMBER}\D*?,\s*{_NUMBER}\D*?,\s*{_NUMBER}")
# Keys of the newer style; the second spelling of longitude is that of some aircraft.
_KEYS = {
    "latitude": "lat_deg", "longitude": "lon_deg", "longtitude": "lon_deg", "rel_alt": "above_takeoff_m",
    "altitude": UNSTATED, "gb_yaw": "gimbal_yaw_deg", "gb_pitch": "gimbal_pitch_deg", "gb_roll": "gimbal_roll_deg",
    "drone_yaw": "yaw_deg", "drone_pitch": "pitch_deg", "drone_roll": "roll_deg",
}  # fmt: skip
_GIMBAL = ("gimbal_yaw_deg", "gimbal_pitch_deg", "gimbal_roll_deg")
_BODY = ("yaw_deg", "pitch_deg", "roll_deg")
# Positions change less often than cues. A receiver has a new one within the longer of these times [s], so that one that
# stays longer is held; changes within the shorter one are the steps of its digits.
_UPDATE_S = 1.0
_STEP_S = 0.2
# Coarser coordinates than this [m] are reported.
_COARSE_M = 2.0
_M_PER_DEG = 111_320.0


def read_srt(path: str) -> list[Table]:
    """Return the tables of a DJI subtitle file: positions and, if present, the gimbal's and the aircraft's angles."""
    cues = []
    # A cue is the text from its times to the next ones: not all programs write blank lines between cues.
    text = read_text(path, "UTF-8")
    starts = list(_TIME.finditer(text))
    ends = [*(each.start() for each in starts[1:]), len(text)][: len(starts)]
    for time, end in zip(starts, ends, strict=True):
        hour, minute, second = (int(part) for part in time.groups()[:3])
        cue = {"time_s": 3600.0 * hour + 60.0 * minute + second + float(f"0.{time[4]}")}
        cues.append(cue | _values(text[time.end() : end]))
    if not cues:
        raise ThermorenderError(f"{path}: no cue with a time '00:00:00,000 --> …' is found; give a DJI subtitle file")
    height = next((name for name in ("above_takeoff_m", UNSTATED) if any(name in cue for cue in cues)), None)
    if not any("lat_deg" in cue and "lon_deg" in cue for cue in cues):
        gps = _GPS.search(text)
        if gps:
            raise ThermorenderError(
                f"{path}: {shortened(gps[0])} is not two or three numbers; write them with decimal points"
            )
        raise ThermorenderError(f"{path}: no cue has a position ([latitude: …] or GPS(…)); give another log")
    if height is None:
        raise ThermorenderError(
            f"{path}: no cue has a height ([rel_alt: …], [altitude: …], BAROMETER:… or H …m); give another log"
        )
    row = np.arange(1, len(cues) + 1)
    tables = [_select(path, cues, row, ("lat_deg", "lon_deg", height))]
    tables[0] = _thinned(tables[0], height)
    for names in (_GIMBAL, _BODY):
        present = tuple(name for name in names if any(name in cue for cue in cues))
        if present:
            tables.append(_select(path, cues, row, present))
    return tables


def _values(text: str) -> dict[str, float]:
    gps = _GPS.search(text)
    if gps and "." not in gps[1] and gps[1].count(",") > 2:
        # Decimal commas; a blank follows the commas between numbers.
        text = re.sub(r"(?<=\d),(?=\d)", ".", text)
    values = {_KEYS[key]: float(value.replace(",", ".")) for key, value in _PAIR.findall(text) if key in _KEYS}
    gps = _GPS.search(text)
    if gps:
        values |= _position(gps[1])
    height = _HEIGHT.search(text)
    if height:
        values["above_takeoff_m"] = float(height[1])
    for what, pitch, roll, yaw in _ANGLES.findall(text):
        prefix = "gimbal_" if what == "G" else ""
        values |= {f"{prefix}yaw_deg": float(yaw), f"{prefix}pitch_deg": float(pitch), f"{prefix}roll_deg": float(roll)}
    return values


def _position(text: str) -> dict[str, float]:
    """Latitude and longitude of "GPS(…)": in the order of their letters, else by the third number; {} without."""
    parts = [part.strip() for part in text.split(",")]
    found = [re.fullmatch(rf"(?:([ENSW])\s*:?\s*)?{_NUMBER}\s*([mM°]?)", part) for part in parts]
    if len(parts) < 2 or not all(found[:2]):
        return {}
    (letter, first, _), (_, second, _) = (each.groups() for each in found[:2] if each)
    with_altitude = len(found) > 2 and found[2] is not None and found[2][3] in ("m", "M")
    latitude_first = letter in ("N", "S") if letter else with_altitude
    pair = (first, second) if latitude_first else (second, first)
    return {"lat_deg": float(pair[0]), "lon_deg": float(pair[1])}


def _select(path: str, cues: list[dict[str, float]], row: NDArray[np.int64], names: tuple[str, ...]) -> Table:
    """A table of the cues that have all of these values."""
    complete = np.array([all(name in cue for name in names) for cue in cues])
    index = np.flatnonzero(complete)
    if not index.size:
        raise ThermorenderError(f"{path}: no cue has all of {', '.join(names)}; give another log")
    columns: dict[str, Floats] = {name: np.array([cues[k][name] for k in index]) for name in ("time_s", *names)}
    notes: tuple[str, ...] = ()
    if index.size < len(cues):
        share = 1.0 - index.size / len(cues)
        notes = (
            f"{path}: {len(cues) - index.size} of {len(cues)} cues ({share:.1%}) lack one of {', '.join(names)} and "
            "are dropped for these",
        )
    return Table(path, dict(columns), row[index], "cue", notes=notes)


def _thinned(table: Table, height: str) -> Table:
    """The cues at which the position changes, since a cue repeats it until the receiver has another."""
    place = np.stack([np.asarray(table.columns[name]) for name in ("lat_deg", "lon_deg", height)], axis=-1)
    time_s = np.asarray(table.columns["time_s"])
    changed = np.r_[True, (np.diff(place, axis=0) != 0.0).any(axis=1)]
    # A held position stays until one update before it changes.
    before = np.searchsorted(time_s, time_s[changed] - _UPDATE_S, side="right") - 1
    index, last = [], -np.inf
    for k in np.unique(np.r_[0, np.flatnonzero(changed), before[before >= 0], len(table) - 1]):
        if not 0.0 <= time_s[k] - last < _STEP_S:
            index.append(k)
            last = time_s[k]
    kept = table.kept(np.array(index))
    degrees = np.concatenate([np.asarray(kept.columns[name]) for name in ("lat_deg", "lon_deg")])
    digits = next((k for k in range(7) if np.allclose(np.round(degrees, k), degrees, rtol=0.0, atol=1e-9)), 7)
    step = _M_PER_DEG * 10.0**-digits
    moved = np.ptp(place[:, 0]) > 0.0 or np.ptp(place[:, 1]) > 0.0
    if step < _COARSE_M or not moved:
        return kept
    note = f"{table.path}: coordinates have {digits} decimals, so the path moves in steps of {step:.3g} m"
    return Table(kept.path, kept.columns, kept.row, kept.what, notes=(*kept.notes, note))
