"""What is not known of the air's absorption: the water continuum, and what nodes and cut bands add."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.gpoints import GPoints, Minor
from thermorender.atmosphere.model import Atmosphere

Floats = NDArray[np.float64]

# Relative spread of published versions of the water continuum (MT_CKD), by kind: self and foreign. Together they change
# level paths of 50 m to 20 km by 63 mK in the median and 650 mK at most, as the versions differ (71 to 93, 635).
CONTINUUM = {"h2o_self": 0.17, "h2o_frgn": 0.2}
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

    def changed(one: Minor) -> Minor:
        more = CONTINUUM[kind] if one.kind == kind else 0.0
        return replace(one, cross_section=one.cross_section * (1.0 + more)) if more else one

    def with_more(tables: GPoints) -> GPoints:
        lower, upper = (tuple(map(changed, part)) for part in tables.minor)
        return replace(tables, minor=(lower, upper))

    return air.with_tables(with_more)
