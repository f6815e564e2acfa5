"""Judge RRTMGP's g points by line-by-line fluxes, and few merged nodes by all g points.

    python -m tools.rrtmgp rrtmgp-gas-lw-g256.nc [CONCENTRATIONS.nc FLUXES.nc]

The first file is of the RRTMGP data (BSD-3), the others of CKDMIP's set `evaluation1`, present-day, in the classic
format of netCDF, as ecRad's folder `test/ckdmip` has them.
"""

import sys

import numpy as np

from tools.rrtmgp import fluxes
from tools.rrtmgp.columns import standard
from tools.rrtmgp.gpoints import GPoints
from tools.rrtmgp.merging import Lit, chosen, judged

# Bands of 700–1390 cm⁻¹, of 16 points.
BANDS, POINTS = slice(4, 9), 16
# (warmer [K], moister) of the columns that the groups are chosen for, and of others.
_CHOSEN, _HELD = ((0, 1), (8, 1.5), (-8, 0.5)), ((4, 0.7), (14, 1.2), (-14, 0.8), (0, 2.0))
_PATHS = (
    *((up, up, length) for up in (0.0, 300.0, 1200.0, 3500.0, 5500.0) for length in (80.0, 500.0, 2e3, 1e4, 2e4)),
    *((up, 0.0, up / cosine) for up in (60.0, 400.0, 2000.0, 5000.0) for cosine in (1.0, 0.7, 0.3, 0.0872)),
)
_SKIES = (1.0, 0.7, 0.35, 0.1)


def main(arguments):
    """Print what was found."""
    tables = GPoints.read(arguments[0])
    say = sys.stdout.write
    if len(arguments) > 1:
        off = fluxes.errors(tables, *arguments[1:3])
        say(f"downward flux at the ground against line by line, {len(off)} columns [W/m²]: mean {off.mean():+.2f}, "
            f"standard deviation {off.std():.2f}, worst {np.abs(off).max():.2f}\n")  # fmt: skip
    lit, held = ([Lit.of(tables, standard(number, *change), BANDS) for number in range(6) for change in changes]
                 for changes in (_CHOSEN, _HELD))  # fmt: skip
    band_of = np.repeat(np.arange(5), POINTS)
    for nodes in (12, 16, 20, 24):
        groups = chosen(lit, band_of, nodes)
        off = 1e3 * np.array([judged(each, groups, _PATHS, _SKIES) for each in held])
        seen, sky = np.abs(off[:, : len(_PATHS)]), off[:, len(_PATHS) :]
        say(f"{nodes} nodes, 20 K of contrast on other paths and columns [mK]: median {np.median(seen):.0f}, 95 % "
            f"{np.percentile(seen, 95):.0f}, worst {seen.max():.0f}; sky, radiance over slope at the ground: "
            f"{np.sqrt(np.mean(sky**2)):.0f} RMS, {np.abs(sky).max():.0f} worst\n")  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
