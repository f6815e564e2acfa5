"""The Frame: the image of the camera from one pose with its truth, and how it is drawn, saved and mapped."""

from thermorender.frame.frame import Frame, apparent_temperature

__all__ = ["Frame", "apparent_temperature"]
