"""The visible view: the orthophoto's colours as light that surfaces send out."""

import numpy as np

from thermorender.physics.srgb import linear_from_bytes
from thermorender.render.geometry import Channels, OutgoingRadiance
from thermorender.scene.surface import FILLED


def outgoing(geometry):
    """Return the linear colour of a Geometry's texels, and 1 where it is known, else 0, as OutgoingRadiance."""
    surfaces = geometry.surfaces
    linear = linear_from_bytes(np.concatenate([surface.colour.reshape(-1, 3) for surface in surfaces]))
    flags = np.concatenate([surface.flags.ravel() for surface in surfaces])
    known = ((flags & FILLED) == 0).astype(np.float32)
    return OutgoingRadiance(Channels(geometry.mi, np.column_stack([linear, known])))
