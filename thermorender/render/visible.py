"""The visible view: the orthophoto's colours as light that surfaces send out."""

import numpy as np

from thermorender.render.geometry import Channels, OutgoingRadiance
from thermorender.scene.surface import FILLED


def outgoing(geometry):
    """Return the linear colour of a Geometry's texels, and 1 where it is known, else 0, as OutgoingRadiance."""
    surfaces = geometry.surfaces
    linear = linear_from_srgb(np.concatenate([surface.colour.reshape(-1, 3) for surface in surfaces]))
    flags = np.concatenate([surface.flags.ravel() for surface in surfaces])
    known = ((flags & FILLED) == 0).astype(np.float32)
    return OutgoingRadiance(Channels(geometry.mi, np.column_stack([linear, known])))


def linear_from_srgb(colour):
    """Linear light, float32, of sRGB bytes (IEC 61966-2-1)."""
    value = np.arange(256) / 255.0
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[colour]


def srgb_from_linear(light):
    """sRGB bytes of linear light, (…) uint8 (IEC 61966-2-1)."""
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(value * 255.0), 0, 255).astype(np.uint8)
