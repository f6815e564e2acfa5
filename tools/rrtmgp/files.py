"""RRTMGP's tables from and to files: netCDF as published, and the package's .npz of some bands."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import netcdf_file

from thermorender.atmosphere.gpoints import NO_KEY, GPoints, Minor
from thermorender.atmosphere.packed import packed
from thermorender.files import atomic

Floats = NDArray[np.float64]
# Relative steps in which shares and minor gases are stored: 0.05 % of an absorption is less than 1 mK.
_STEP = 1e-3


def read(path: str | PathLike[str]) -> GPoints:
    """Return the tables of a file of netCDF (classic) such as `rrtmgp-gas-lw-g256.nc`, without spectra and groups."""
    with netcdf_file(path, mmap=False) as file:
        data = {name: np.array(each.data) for name, each in file.variables.items()}
    names = {name: _texts(values) for name, values in data.items() if values.dtype.kind == "S" and values.ndim == 2}
    key = np.array(data["key_species"], np.intp)
    key[(key == 0).all(axis=-1)] = NO_KEY
    limits = data["bnd_limits_gpt"]
    band_of = np.repeat(np.arange(len(limits)), limits[:, 1] - limits[:, 0] + 1)
    gas_of = dict(zip(names["identifier_minor"], names["gas_minor"], strict=True))
    minor = tuple(tuple(_minor(data, names, gas_of, part)) for part in ("lower", "upper"))
    return GPoints(
        tuple(names["gas_names"]), _floats(data["bnd_limits_wavenumber"]), band_of, _floats(data["press_ref"]),
        _floats(data["temp_ref"]), float(data["press_ref_trop"]), key, _floats(data["vmr_ref"]),
        _floats(data["kmajor"]), _floats(data["plank_fraction"]), (minor[0], minor[1]),
        # Some editions of the files have 0 … 195 there.
        160.0 + np.arange(data["totplnk"].shape[1]), _floats(data["totplnk"]), np.zeros((1, len(band_of), 0)),
        np.zeros(1),
    )  # fmt: skip


def of_bands(tables: GPoints, bands: slice) -> GPoints:
    """Return the tables of neighbouring bands alone."""
    points = tables.points(bands)
    first, end = int(points[0]), int(points[-1]) + 1
    low, high = tables.wavenumber[bands][[0, -1], [0, 1]]
    bins = (tables.middles() > low) & (tables.middles() < high)
    minor = tuple(
        tuple(replace(each, points=slice(each.points.start - first, each.points.stop - first)) for each in part
              if first <= each.points.start < end)
        for part in tables.minor
    )  # fmt: skip
    return replace(
        tables, wavenumber=tables.wavenumber[bands], band_of=tables.band_of[points] - tables.band_of[first],
        key=tables.key[bands], major=tables.major[..., first:end], share=tables.share[..., first:end],
        minor=(minor[0], minor[1]), planck=tables.planck[bands], spectrum=tables.spectrum[:, points][..., bins],
    )  # fmt: skip


def write(path: str | PathLike[str], tables: GPoints) -> None:
    """Write tables with spectra and groups to the package's .npz of plain arrays."""
    every = [(upper, each) for upper, part in enumerate(tables.minor) for each in part]
    major, major_scale = packed(tables.major)
    share, share_scale = packed(tables.share, _STEP)
    minor, minor_scale = packed(np.concatenate([each.cross_section for _, each in every], axis=-1), _STEP)
    number = {gas: k for k, gas in enumerate(tables.gases)} | {"": -1}
    arrays = {
        "gases": np.array(tables.gases), "wavenumber": tables.wavenumber, "band_of": tables.band_of,
        "pressure": tables.pressure, "temperature": tables.temperature, "tropopause_pa": tables.tropopause_pa,
        "key": tables.key, "ratio": np.float32(tables.ratio), "major": major, "major_scale": major_scale,
        "share": share, "share_scale": share_scale, "minor": minor, "minor_scale": minor_scale,
        "minor_kind": np.array([f"{each.kind}/{each.gas}" for _, each in every]),
        "minor_of": np.array([(upper, each.points.start, each.points.stop, each.with_density, number[each.scaled_by],
                               each.by_complement) for upper, each in every]),
        "planck_k": tables.planck_k, "planck": np.float32(tables.planck), "spectrum": np.float16(tables.spectrum),
        "spectrum_water": tables.spectrum_water,
        "group": np.array([(k, each.start, each.stop) for k, own in enumerate(tables.groupings) for each, _ in own]),
        "depth": np.array([depth for own in tables.groupings for _, depth in own]), "powers": np.array(tables.powers),
        "continuum": np.array(tables.continuum),
        "source": np.array("rrtmgp-gas-lw-g256.nc of RRTMGP (BSD-3), Pincus et al. (2019), doi:10.1029/2019MS001621"),
    }  # fmt: skip
    with atomic(path) as part, open(part, "wb") as file:
        np.savez_compressed(file, **arrays)


def _minor(
    data: Mapping[str, NDArray[Any]], names: Mapping[str, list[str]], gas_of: Mapping[str, str], part: str
) -> Iterator[Minor]:
    for number, kind in enumerate(names[f"minor_gases_{part}"]):
        first, last = data[f"minor_limits_gpt_{part}"][number]
        start = int(data[f"kminor_start_{part}"][number]) - 1
        yield Minor(
            gas_of[kind], kind, slice(int(first) - 1, int(last)),
            _floats(data[f"kminor_{part}"][..., start : start + int(last - first) + 1]),
            bool(data[f"minor_scales_with_density_{part}"][number]), names[f"scaling_gas_{part}"][number],
            bool(data[f"scale_by_complement_{part}"][number]),
        )  # fmt: skip


def _texts(values: NDArray[Any]) -> list[str]:
    return [b"".join(row).decode("ascii").strip() for row in values]


def _floats(values: NDArray[Any]) -> Floats:
    return np.array(values, np.float64)
