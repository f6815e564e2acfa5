"""Versions of this package and of the packages its results depend on."""

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

_LIBRARIES = (
    "thermorender", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless", "OpenEXR", "rasterio",
    "imageio-ffmpeg",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Return {name: version} of Python, thermorender and the libraries that determine the bytes of a frame's files."""
    return {"python": platform.python_version(), **{name: version_of(name) for name in _LIBRARIES}}


@cache
def version_of(name: str) -> str:
    """Return the version of an installed package, or "not installed"."""
    # Cached: the look-up reads the folders of all packages, and every frame's EXR header has the versions.
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
