"""ArduPilot's dataflash logs (.bin): messages POS, ATT and MNT, and GPS where POS is not logged.

POS is the estimator's position with its height above home, ATT roll, pitch and yaw, MNT the angles of a mount (YawE
relative to the Earth). A GPS status of 3 is a fix in three dimensions.
"""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.trajectory.sources.extra import check_file, library, said_by_library
from thermorender.trajectory.tables import Floats, Table

# Of each message, the log's field to our column.
_FIELDS = {
    "POS": {"Lat": "lat_deg", "Lng": "lon_deg", "RelHomeAlt": "above_takeoff_m"},
    "GPS": {"Lat": "lat_deg", "Lng": "lon_deg", "Alt": "alt_geoid_m", "Status": "fix"},
    "ATT": {"Yaw": "yaw_deg", "Pitch": "pitch_deg", "Roll": "roll_deg"},
    "MNT": {"YawE": "gimbal_yaw_deg", "Pitch": "gimbal_pitch_deg", "Roll": "gimbal_roll_deg"},
}
# Names that fields had before 2016.
_FORMER = {"RelHomeAlt": "RelAlt"}
_HEAD = b"\xa3\x95"
# Head of a message FMT, which declares the length of a type of messages.
_FORMAT = _HEAD + b"\x80"
_FIX = 3


def read_dataflash(path: str) -> list[Table]:
    """Return the tables of a dataflash log: positions, attitudes and, if logged, the mount's angles."""
    check_file(path, _HEAD, "an ArduPilot dataflash log")
    _check_lengths(path)
    reader = library("pymavlink.DFReader", "an ArduPilot log")
    rows: dict[str, list[list[float]]] = {name: [] for name in _FIELDS}
    try:
        with said_by_library() as said, contextlib.ExitStack() as stack:
            log = reader.DFReader_binary.__new__(reader.DFReader_binary)
            # The library leaves its file open, also when its constructor fails.
            stack.callback(lambda: log.filehandle.close() if hasattr(log, "filehandle") else None)
            log.__init__(str(path), zero_time_base=True)
            while (message := log.recv_match(type=list(_FIELDS))) is not None:
                row = _row(message)
                if row is not None:
                    rows[message.get_type()].append(row)
    except Exception as error:  # the library raises whatever a damaged file leads to
        raise ThermorenderError(
            f"{path} cannot be read as a dataflash log ({type(error).__name__}); copy it again"
        ) from error
    if rows["POS"]:
        del rows["GPS"]
    if not (rows["POS"] or rows.get("GPS")):
        raise ThermorenderError(f"{path}: neither POS nor GPS is logged; a flight needs positions")
    notes = (f"{path}: a part of the log is damaged and was skipped",) if "bad" in said.getvalue().lower() else ()
    tables = [_table(path, name, np.array(values)) for name, values in rows.items() if values]
    return [Table(tables[0].path, tables[0].columns, tables[0].row, "sample", notes=notes), *tables[1:]]


def _check_lengths(path: str) -> None:
    """Refuse a log that declares messages shorter than their head, in which the library would not advance."""
    data = Path(path).read_bytes()
    at = data.find(_FORMAT)
    while at >= 0:
        # The head of a declaration is followed by the type and the length of the messages that it declares.
        declared = data[at + len(_FORMAT) : at + len(_FORMAT) + 2]
        if len(declared) == 2 and declared[1] < len(_FORMAT):
            raise ThermorenderError(
                f"{path}: a declaration (FMT) at byte {at} gives messages {declared[1]} bytes, but their head has "
                f"{len(_FORMAT)}; the log is damaged: copy it again"
            )
        at = data.find(_FORMAT, at + 1)


def _row(message: Any) -> list[float] | None:
    """Time and fields of a message; None for another instance than the first, and without a field's value."""
    instance = getattr(message, "I", 0)
    time_us = getattr(message, "TimeUS", None)
    if time_us is None:
        # Before 2015 in milliseconds since the start; a GPS message has that time in T, and TimeMS is the satellites'.
        time_us = getattr(message, "T" if message.get_type() == "GPS" else "TimeMS", np.nan) * 1e3
    fields = _FIELDS[message.get_type()]
    values = [float(getattr(message, field, getattr(message, _FORMER.get(field, ""), np.nan))) for field in fields]
    return None if instance != 0 or not np.isfinite([time_us, *values]).all() else [time_us * 1e-6, *values]


def _table(path: str, name: str, values: Floats) -> Table:
    columns = dict(zip(("time_s", *_FIELDS[name].values()), values.T, strict=True))
    if name == "GPS":
        columns["fix"] = (columns["fix"] >= _FIX).astype(np.float64)
    return Table(f"{path} ({name})", dict(columns), np.arange(1, len(values) + 1), "sample")
