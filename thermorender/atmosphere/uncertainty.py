"""What is not known of the air's absorption: the water continuum, and what nodes and cut bands add."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.gpoints import GPoints, Minor
from thermorender.atmosphere.model import Atmosphere

Floats = NDArray[np.float64]

# The kinds of the water continuum, in the order of `GPoints.continuum`.
CONTINUUM = ("h2o_self", "h2o_frgn")
# Error of nodes (0.2 to 0.4 %) and of the edges of a camera's band, as a share of what the air changes.
_FITTED = 0.005


def seen_change(
    air: Atmosphere, from_m: ArrayLike, to_m: ArrayLike, range_m: ArrayLike, kelvin: ArrayLike
) -> Floats | None:
    """Return the standard uncertainty of the band radiance of blackbodies seen along paths [W m⁻² sr⁻¹].

    Parameters
    ----------
    air : Atmosphere
    from_m, to_m, range_m : array
        As in `Atmosphere.transmittance`.
    kelvin : array
        Of the blackbodies at `to_m`.

    Returns
    -------
    array, or None for air without a column, whose source is not known.
    """
    if air.column is None:
        return None
    black = air.planck(kelvin)
    seen = _seen(air, from_m, to_m, range_m, black)
    square = np.square(_FITTED * (seen - black.sum(axis=-1)))
    for kind in CONTINUUM:
        square += np.square(_seen(_stronger(air, kind), from_m, to_m, range_m, black) - seen)
    return np.sqrt(square)


def _seen(air: Atmosphere, from_m: ArrayLike, to_m: ArrayLike, range_m: ArrayLike, black: Floats) -> Floats:
    """Band radiance of targets with the radiance `black` (..., N) in the nodes."""
    passed, added = air.path(from_m, to_m, range_m)
    found: Floats = (passed * black + added).sum(axis=-1)
    return found


@lru_cache(maxsize=8)
def _stronger(air: Atmosphere, kind: str) -> Atmosphere:
    """The air with more of one continuum."""

    def with_more(tables: GPoints) -> GPoints:
        more = 1.0 + tables.continuum[CONTINUUM.index(kind)]

        def changed(one: Minor) -> Minor:
            return replace(one, cross_section=one.cross_section * more) if one.kind == kind else one

        lower, upper = (tuple(map(changed, part)) for part in tables.minor)
        return replace(tables, minor=(lower, upper))

    return air.with_tables(with_more)
