"""MODTRAN's output file tape7: one path's spectrum, and a standard atmosphere scaled to it.

A tape7 has one line of sight. It can check the embedded atmospheres, and scale the standard atmosphere named in its
header: each node's absorption is multiplied by the factor that gives the file's transmittance along the file's path.
Other paths follow from the altitude profiles of that standard.
"""

import re
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.rays import EARTH_RADIUS_M, TOP_M
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import spectral_radiance

_MODELS = (
    "tropical", "midlatitude-summer", "midlatitude-winter", "subarctic-summer", "subarctic-winter", "us-1976",
)  # fmt: skip
_RURAL = {1: 23.0, 2: 5.0}
# Temperature of the Planck radiance that weights wavenumbers within a sub-band [K].
_WEIGHT_K = 285.0
# Card 1: letters, model, a letter, path type, mode. The line that ends a run.
_CARD_1, _END = re.compile(r"[A-Z+ ]*(\d) *[A-Z]? *(\d) +(\d)(?!\d)"), "-9999."
# Optical depth of an opaque node.
_DEEPEST = 50.0


@dataclass(frozen=True)
class Tape7:
    """One path of MODTRAN."""

    wavenumber: NDArray[np.float64]  # (n,) float64 rising [cm⁻¹]
    transmittance: NDArray[np.float64]  # (n,) float64
    # (n,) float64 thermal emission of the path [W m⁻² sr⁻¹ per cm⁻¹]; None in a transmittance run
    path_radiance: NDArray[np.float64] | None
    # model, aerosol: The standard atmosphere, and the nearest of the embedded aerosols
    model: str
    aerosol: str
    # from_m, to_m, range_m: Altitudes of the observer and of the end of the path, and its length [m]
    from_m: float
    to_m: float
    range_m: float
    cos_zenith: float | None  # Of the direction, for a path to space

    def band(self, lower_um: float, upper_um: float, temperature: float = _WEIGHT_K) -> tuple[float, float | None]:
        """Return (Planck-weighted transmittance, path radiance [W m⁻² sr⁻¹] or None) of a band."""
        fine = np.linspace(1e4 / upper_um, 1e4 / lower_um, 4001)
        step = np.gradient(fine)
        step[[0, -1]] *= 0.5
        planck = spectral_radiance(1e4 / fine, temperature) / fine**2 * step
        through = np.interp(fine, self.wavenumber, self.transmittance) @ planck / planck.sum()
        if self.path_radiance is None:
            return float(through), None
        return float(through), float(np.interp(fine, self.wavenumber, self.path_radiance) @ step)


def read_tape7(path: str | PathLike[str], lower_um: float, upper_um: float, run: int | None = None) -> Tape7:
    """Return the Tape7 of a file that covers the camera's band; `run` is the number, from 1, of one of several runs.

    The reader uses card 1 (model, path type, mode), card 2 (aerosol, visibility), card 3 (geometry) and the columns of
    total transmittance and of thermal path radiance. Card 1 begins with letters for the band model, its speed and the
    kind of output, which differ between versions of MODTRAN; cards have fixed widths, so numbers may touch.
    """
    try:
        with open(path, encoding="latin-1") as file:
            lines = file.read().splitlines()
    except OSError as error:
        raise ThermorenderError(f"tape7 {path} cannot be read ({error.strerror or error}); give its path") from None
    lines = _of_run(path, lines, run)
    start, end = _spectrum_lines(path, lines)
    try:
        card = _CARD_1.match(lines[0])
        if card is None:
            raise ValueError
        model, kind, mode = (int(word) for word in card.groups())
        haze, visibility = int(lines[1][2:5]), float(lines[1][30:40])
        first_km, last_km, angle, range_km = (float(lines[5][10 * k : 10 * k + 10]) for k in range(4))
        wanted = 3 if "PTH_THRML" in lines[start].split() else 2
        table = _numbers(lines[start + 1 : end], wanted)
    except (ValueError, IndexError):
        raise ThermorenderError(
            f"tape7 {path} is damaged: its cards or columns are not numbers; run MODTRAN again"
        ) from None
    if not 1 <= model <= 6:
        raise ThermorenderError(
            f"tape7 {path} has model {model}, a user-defined profile; give one with a standard atmosphere, 1…6"
        )
    _check_covers(path, table[:, 0], lower_um, upper_um)
    geometry = _geometry(path, kind, first_km * 1e3, last_km * 1e3, angle, range_km * 1e3)
    # MODTRAN writes W cm⁻².
    light = table[:, 2] * 1e4 if wanted == 3 and mode else None
    return Tape7(table[:, 0], table[:, 1], light, _MODELS[model - 1], _aerosol(haze, visibility), *geometry)


def _spectrum_lines(path: object, lines: list[str]) -> tuple[int, int]:
    """(Line of the column names, line that ends the spectrum), after refusing other units."""
    start = next((number for number, line in enumerate(lines) if line.split()[:1] == ["FREQ"]), None)
    if start is None or start < 9:
        raise ThermorenderError(
            f"{path} is not a tape7 of MODTRAN: it has no line of column names that begins with FREQ; give another file"
        )
    end = next((number for number, line in enumerate(lines) if number > start and line.strip() == _END), None)
    if end is None:
        raise ThermorenderError(f"tape7 {path} is truncated: its closing line -9999. is missing; run MODTRAN again")
    unit = (lines[start + 1].split() or ["CM-1"])[0]
    if unit[0].isalpha() and unit != "CM-1":
        raise ThermorenderError(f"tape7 {path} has the spectral unit {unit!r}; run MODTRAN with wavenumbers (CM-1)")
    return start, end


def _numbers(lines: list[str], count: int) -> NDArray[np.float64]:
    """The first `count` columns (n, count) of a spectrum, at rising wavenumbers; ValueError if they are damaged."""
    # Transmittance runs have a second line of names and of units.
    rows = [line.split() for line in lines if line.split() and not line.split()[0][0].isalpha()]
    table = np.array([[float(word) for word in row[:count]] for row in rows])
    if table.ndim != 2 or len(table) < 2 or np.any(np.diff(table[:, 0]) <= 0.0) or not np.isfinite(table).all():
        raise ValueError
    return table


def _check_covers(path: object, wavenumber: NDArray[np.float64], lower_um: float, upper_um: float) -> None:
    """Refuse a spectrum that does not include a band [µm]."""
    # One step of the file's grid may be missing at each end.
    slack = float(np.diff(wavenumber).max())
    if 1e4 / lower_um > wavenumber[-1] + slack or 1e4 / upper_um < wavenumber[0] - slack:
        raise ThermorenderError(
            f"tape7 {path} covers {1e4 / wavenumber[-1]:.4g}–{1e4 / wavenumber[0]:.4g} µm, which does not include the "
            f"camera's band {lower_um:g}–{upper_um:g} µm; run MODTRAN from {1e4 / upper_um:.0f} to "
            f"{1e4 / lower_um:.0f} cm⁻¹"
        )


def atmosphere(tape: Tape7, lower_um: float, upper_um: float) -> Atmosphere:
    """Return an Atmosphere for a band with the transmittance of a Tape7 along its path.

    In each sub-band the file's points are sorted by transmittance and divided among the nodes by the nodes' weights,
    most transparent first. A node gets the mean transmittance of its part, so the transmittance of the sub-band is
    exactly the file's.
    """
    base = Atmosphere.standard(tape.model, tape.aerosol).in_band(lower_um, upper_um)
    if tape.cos_zenith is None:
        own = base.transmittance(tape.from_m, tape.to_m, tape.range_m)
    else:
        own = base.sun_transmittance(tape.from_m, tape.cos_zenith)
    wanted = np.empty_like(own)
    for lower, upper in {*zip(base.lower_um, base.upper_um, strict=True)}:
        nodes = np.flatnonzero(base.lower_um == lower)
        nodes = nodes[np.argsort(-own[nodes])]
        fine = np.linspace(1e4 / upper, 1e4 / lower, 2001)
        share = np.interp(fine, tape.wavenumber, tape.transmittance)
        planck = spectral_radiance(1e4 / fine, _WEIGHT_K) / fine**2
        order = np.argsort(-share)
        filled = np.concatenate([[0.0], np.cumsum(planck[order])]) / planck.sum()
        total = np.concatenate([[0.0], np.cumsum((share * planck)[order])]) / planck.sum()
        limits = np.interp(np.concatenate([[0.0], np.cumsum(base.weight[nodes])]), filled, total)
        wanted[nodes] = np.diff(limits) / base.weight[nodes]
    depth = np.minimum(-np.log(np.maximum(wanted, 1e-300)), _DEEPEST)
    factor = depth / np.maximum(-np.log(np.maximum(own, 1e-300)), 1e-12)
    return replace(base, absorption=base.absorption * factor[:, None])


def _of_run(path: object, lines: list[str], run: int | None) -> list[str]:
    """The lines of one run of a file."""
    ends = [number + 1 for number, line in enumerate(lines) if line.strip() == _END]
    if ends and any(line.strip() for line in lines[ends[-1] :]):
        # A last run without its end is truncated.
        ends.append(len(lines))
    if run is None and len(ends) > 1:
        raise ThermorenderError(f"tape7 {path} holds {len(ends)} runs; choose one with run=1 … {len(ends)}")
    if run is not None and not 1 <= run <= max(len(ends), 1):
        raise ThermorenderError(f"run={run} is not in tape7 {path}, which holds runs 1 … {max(len(ends), 1)}")
    number = run or 1
    return lines[[0, *ends][number - 1] : ends[number - 1]] if ends else lines


def _aerosol(haze: int, visibility: float) -> str:
    """Name of the nearest embedded aerosol of MODTRAN's IHAZE and visibility [km]."""
    if haze in _RURAL:
        visibility = visibility or _RURAL[haze]
        return "rural-23km" if visibility > 10.0 else "rural-5km"
    return {4: "maritime-23km", 5: "urban-5km"}.get(haze, "none")


def _geometry(
    path: object, kind: int, first_m: float, last_m: float, angle_deg: float, range_m: float
) -> tuple[float, float, float, float | None]:
    """(from_m, to_m, range_m, cos_zenith) of card 3; cos_zenith is None for a path that ends in the air."""
    cosine = float(np.cos(np.radians(angle_deg)))
    if kind == 1:
        return first_m, first_m, range_m, None
    if kind == 3 and cosine > 0.0:
        return first_m, TOP_M, np.inf, cosine
    if kind == 2:
        if range_m:
            return first_m, last_m, range_m, None
        near = (EARTH_RADIUS_M + first_m) * cosine
        square = near**2 + (EARTH_RADIUS_M + last_m) ** 2 - (EARTH_RADIUS_M + first_m) ** 2
        if square >= 0.0:
            root = np.sqrt(square)
            return first_m, last_m, float(root - near if cosine > 0.0 else -near - root), None
    raise ThermorenderError(
        f"tape7 {path} has an unsupported path (type {kind}, zenith angle {angle_deg:g}°); give a level path, "
        "one between two altitudes, or one up to space"
    )
