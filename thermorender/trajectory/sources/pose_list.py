"""Lists of poses as the TUM RGB-D benchmark writes them: time, position and quaternion x, y, z, w in each line."""

import numpy as np

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import read_text
from thermorender.trajectory.tables import Table

_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def read_poses(path: str) -> list[Table]:
    """Return the table of a list of poses; lines that begin with # are comments."""
    rows, numbers = [], []
    for number, line in enumerate(read_text(path, "UTF-8").splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = line.split()
        if len(cells) != len(_COLUMNS):
            raise ThermorenderError(
                f"{path}, line {number}: {shortened(repr(line))} has {len(cells)} columns; eight separated by blanks "
                f"are needed: {' '.join(_COLUMNS)}"
            )
        rows.append(cells)
        numbers.append(number)
    if not rows:
        raise ThermorenderError(f"{path} has no poses; each line needs {' '.join(_COLUMNS)}")
    columns = dict(zip(_COLUMNS, map(list, zip(*rows, strict=True)), strict=True))
    return [Table(path, dict(columns), np.array(numbers), "line")]
