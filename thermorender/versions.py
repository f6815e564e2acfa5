"""Versions of this package and of those its results depend on."""

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

_LIBRARIES = (
    "thermorender", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless", "OpenEXR", "rasterio",
    "imageio-ffmpeg",
)  # fmt: skip


def versions():
    """Return {name: version} of Python, thermorender and the libraries that decide the bytes of a frame's files."""
    return {"python": platform.python_version(), **{name: version_of(name) for name in _LIBRARIES}}


@cache
def version_of(name):
    """Return the version of an installed package, or "not installed"."""
    # Looked up once: it reads the folders of all packages, and every frame's EXR tells it.
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
