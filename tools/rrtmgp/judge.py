"""The package's air against all g points: lines of sight and skies through columns that no group was chosen for."""

from collections.abc import Sequence
from os import PathLike
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere import rays
from thermorender.atmosphere.air_column import AirColumn
from thermorender.atmosphere.emission import ALTITUDE_M, Profile, amounts, emission
from thermorender.atmosphere.gpoints import GPoints
from thermorender.atmosphere.model import Atmosphere
from thermorender.files import atomic
from tools.rrtmgp.columns import LEVELS_M, standard
from tools.rrtmgp.merging import CONTRAST_K, Lit

# Steps of a path in ln(3 km + altitude).
_STEP = 0.02
Floats = NDArray[np.float64]
# Bands of cameras [µm].
CAMERAS = (
    (7.5, 13.5), (8.0, 14.0), (8.0, 12.0), (10.0, 12.0), (8.0, 9.5), (3.7, 4.8), (3.1, 4.8), (3.5, 4.1), (3.8, 4.2),
    (4.5, 4.8),
)  # fmt: skip
# (warmer [K], moister) of the columns.
_HELD = ((4, 0.7), (14, 1.2), (-14, 0.8), (0, 2.0))
PATHS = (
    *((up, up, length) for up in (0.0, 300.0, 1200.0, 3500.0, 5500.0) for length in (80.0, 500.0, 2e3, 1e4, 2e4)),
    *((up, 0.0, up / cosine) for up in (60.0, 400.0, 2000.0, 5000.0) for cosine in (1.0, 0.7, 0.3, 0.0872)),
)
SKIES = (1.0, 0.7, 0.35, 0.1)


class Errors(NamedTuple):
    """Errors of one band, in millikelvin at a contrast of 20 K, and of the sky by the slope at the ground.

    `far` are those of the longest line of sight, 57 km from an altitude of 5 km to the ground.
    """

    band_um: tuple[float, float]
    nodes: int
    paths: Floats
    far: Floats
    skies: Floats

    def __str__(self) -> str:
        seen, sky = np.abs(self.paths), np.abs(self.skies)
        return (
            f"{self.band_um[0]:g}–{self.band_um[1]:g} µm, {self.nodes} nodes, median {np.median(seen):.0f}, "
            f"95 % {np.percentile(seen, 95):.0f}, worst {seen.max():.0f}, 57 km {np.abs(self.far).max():.0f}; "
            f"sky {np.sqrt(np.mean(sky**2)):.0f} RMS, {sky.max():.0f} worst"
        )


def errors(tables: GPoints, columns: Sequence[AirColumn], cameras: Sequence[tuple[float, float]]) -> list[Errors]:
    """Return the Errors of each camera's band over columns."""
    found = []
    for band in cameras:
        paths, skies = [], []
        for column in columns:
            fine = column.at(LEVELS_M)
            air = Atmosphere.of_column(fine, band, tables=tables)
            (first, last, length), up = np.array(PATHS).T, np.zeros(len(SKIES))
            seen, sky, kelvin = true_radiance(tables, fine, band)
            passed, own = air.path(first, last, length)
            warm = air.planck(air.air_temperature(last) + CONTRAST_K)
            paths.append(kelvin * ((passed * warm + own).sum(axis=-1) - seen))
            skies.append(kelvin * (air.sky_radiance(up, np.array(SKIES)).sum(axis=-1) - sky))
        off = 1e3 * np.array(paths)
        found.append(Errors(band, air.nodes, off[:, :-1].ravel(), off[:, -1], 1e3 * np.ravel(skies)))
    return found


def write_reference(path: str | PathLike[str], tables: GPoints, cameras: Sequence[tuple[float, float]]) -> None:
    """Write what all g points give for the held columns, to judge the package's nodes by."""
    columns = [(number, *change) for number in range(6) for change in _HELD]
    true = [[true_radiance(tables, standard(*each), band) for each in columns] for band in cameras]
    arrays = {
        "band_um": np.array(cameras), "column": np.array(columns), "path": np.array(PATHS), "sky": np.array(SKIES),
        "contrast_k": np.array(CONTRAST_K), "paths": np.float32([[seen for seen, _, _ in own] for own in true]),
        "skies": np.float32([[sky for _, sky, _ in own] for own in true]),
    }  # fmt: skip
    with atomic(path) as part, open(part, "wb") as file:
        np.savez_compressed(file, **arrays)


def held() -> list[AirColumn]:
    """Return the columns that groups are judged by, at LEVELS_M."""
    return [standard(number, *change) for number in range(6) for change in _HELD]


def true_radiance(tables: GPoints, column: AirColumn, band_um: tuple[float, float]) -> tuple[Floats, Floats, float]:
    """Return (radiance of PATHS, of SKIES, kelvin per radiance at the ground) by all g points, of air at LEVELS_M."""
    lit = Lit.of(tables, column, band_um)
    profile = Profile.of(*(np.exp(_on_grid(np.log(np.maximum(each, 1e-300)))) for each in (lit.absorption, lit.planck)))
    first, last, length = np.array(PATHS).T
    rows = []
    for altitude, steps in (rays.chord(first, last, length, _STEP),
                            rays.outward(np.zeros(len(SKIES)), np.array(SKIES), rays.TOP_M)):  # fmt: skip
        rows.append(emission(profile, np.eye(len(lit.absorption)), altitude, steps, amounts(profile, altitude, steps)))
    targets = np.stack([np.interp(last, LEVELS_M, each) for each in lit.warmer], axis=1)
    return (rows[0][0] * targets + rows[0][1]).sum(axis=-1), rows[1][1].sum(axis=-1), lit.kelvin


def _on_grid(values: Floats) -> Floats:
    """Values (G, L) at LEVELS_M on the grid that paths are integrated on, (points, G)."""
    return np.stack([np.interp(ALTITUDE_M, LEVELS_M, row) for row in values], axis=1)
