"""Long-wave flux at the ground from g points, against line-by-line results of CKDMIP.

Hogan and Matricardi (2020), Geosci. Model Dev. 13, 6501, doi:10.5194/gmd-13-6501-2020.
"""

from os import PathLike

import numpy as np
from numpy.typing import NDArray
from scipy.io import netcdf_file

from thermorender.atmosphere import rays
from thermorender.atmosphere.air_column import AirColumn
from thermorender.atmosphere.gpoints import GPoints

Floats = NDArray[np.float64]
_AVOGADRO, _GRAVITY, _GAS = 6.02214076e23, 9.80665, 8.314462618
# Kilograms per mole of dry air and of water.
_DRY, _WATER = 0.0289652, 0.01801528
_ENDING = "_mole_fraction_fl"


def errors(tables: GPoints, concentrations: str | PathLike[str], fluxes: str | PathLike[str]) -> Floats:
    """Return errors of the downward flux at the ground of all columns, (n,) [W m⁻²]."""
    data = _read(concentrations)
    with netcdf_file(fluxes, mmap=False) as file:
        true = np.array(file.variables["flux_dn_lw"].data[:, -1], np.float64)
    found = []
    for column in range(len(true)):
        mole = _mole(data, column)
        found.append(downward(tables, data["pressure_hl"][column], data["temperature_hl"][column], mole))
    return np.array(found) - true


def columns(concentrations: str | PathLike[str]) -> list[AirColumn]:
    """Return the columns of the file, from their surface at 0 m up."""
    data, found = _read(concentrations), []
    for number, (pressure, temperature) in enumerate(zip(data["pressure_hl"], data["temperature_hl"], strict=True)):
        mole = _mole(data, number)
        pressure, temperature = np.maximum(pressure[::-1], 0.01), temperature[::-1]
        middle = 0.5 * (temperature[1:] + temperature[:-1])
        rise = _GAS * middle / _DRY / _GRAVITY * np.log(pressure[:-1] / pressure[1:])
        altitude = np.concatenate([[0.0], np.cumsum(rise)])
        inside = altitude < rays.TOP_M
        # Gases are those of layers; levels take the mean of the layers around them.
        mixing = {}
        for gas, share in mole.items():
            layer = (share / (1.0 - mole["h2o"]))[::-1]
            mixing[gas] = np.concatenate([layer[:1], 0.5 * (layer[1:] + layer[:-1]), layer[-1:]])[inside]
        found.append(AirColumn(altitude[inside], pressure[inside], temperature[inside], mixing))
    return found


def _read(path: str | PathLike[str]) -> dict[str, Floats]:
    with netcdf_file(path, mmap=False) as file:
        return {name: np.array(each.data, np.float64) for name, each in file.variables.items()}


def _mole(data: dict[str, Floats], column: int) -> dict[str, Floats]:
    """{Gas: (layers,) share of all air} of a column."""
    return {name.removesuffix(_ENDING): values[column] for name, values in data.items() if name.endswith(_ENDING)}


def downward(tables: GPoints, pressure_pa: Floats, temperature: Floats, mole: dict[str, Floats]) -> float:
    """Return the flux [W m⁻²] at the last of half levels (L,), from the top; `mole` is {gas: (L − 1,)} of all air."""
    middle = [0.5 * (each[1:] + each[:-1]) for each in (pressure_pa, temperature)]
    mixing = {name: share / (1.0 - mole["h2o"]) for name, share in mole.items()}
    dry = np.diff(pressure_pa) / _GRAVITY / (_DRY + _WATER * mixing["h2o"]) * _AVOGADRO * 1e-4
    depth = tables.absorption(*middle, mixing) * dry
    share = tables.shares(*middle, mixing)
    planck = tables.radiance(temperature).T[tables.band_of]
    cosine, weight = np.polynomial.legendre.leggauss(6)
    flux = 0.0
    for mu, part in zip(0.5 * (cosine + 1.0), 0.5 * weight, strict=True):
        light = np.zeros(len(depth))
        for layer, own in enumerate((depth / mu).T):
            passed, own = np.exp(-own), np.maximum(own, 1e-9)
            mean = -np.expm1(-own) / own
            first, last = share[:, layer] * planck[:, layer], share[:, layer] * planck[:, layer + 1]
            light = light * passed + first * (mean - passed) + last * (1.0 - mean)
        flux += 2.0 * np.pi * part * mu * float(light.sum())
    return flux
