"""Versions of this package and of those its results depend on."""

import platform
from importlib.metadata import PackageNotFoundError, version


def versions():
    """Return {name: version} of Python, thermorender and the libraries that decide a frame's bytes."""
    found = {"python": platform.python_version()}
    for name in ("thermorender", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless", "OpenEXR"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
