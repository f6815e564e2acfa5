"""The products of a frame: their names, files and encoders."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import defaults
from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.formats import encoded_image
from thermorender.frame.exr import exr_encoder
from thermorender.sensor.camera import Camera
from thermorender.sensor.radiometric_files import write_tlinear
from thermorender.sensor.radiometry import ThermographySettings, thermography_reading

if TYPE_CHECKING:
    from thermorender.frame import Frame

DEFAULT = ("exr", "truth", "counts", "display", "video", "report")
# Products that are parts of others, or made of all frames.
_PARTS = ("truth", "error", "video", "mcap", "report")


def _radiometric(frame: "Frame", thermography: ThermographySettings | None) -> bytes:
    """The reading of thermography software as a 16-bit TIFF of 0.04 K per count."""
    from rasterio.io import MemoryFile

    reading = thermography_reading(frame.counts, frame.camera, thermography or ThermographySettings())
    with MemoryFile(ext=".tif") as memory:
        write_tlinear(memory.name, reading)
        return bytes(memory.getbuffer())


@dataclass(frozen=True)
class _Extras:
    """Inputs of the encoders in addition to the frame; see `encoders`."""

    truth: bool
    error: bool
    image: Any
    thermography: Any
    photograph: Any
    compression: str


def _image(suffix: str, image: NDArray[Any]) -> "Encoder":
    return partial(encoded_image, suffix, image)


def _radiometric_encoder(frame: "Frame", extras: _Extras) -> "Encoder":
    # Encoded at once, since GDAL's warnings are silenced for the whole process.
    data = _radiometric(frame, extras.thermography)
    return lambda: data


Encoder = Callable[[], bytes]
# {product: (end of the file name, returns the encoder of (frame, extras))}
WRITERS: dict[str, tuple[str, Callable[["Frame", _Extras], Encoder]]] = {
    "exr": (".exr", lambda frame, extras: exr_encoder(
        frame, extras.truth, extras.thermography, extras.error, extras.compression
    )),
    "counts": ("_counts.png", lambda frame, extras: _image(".png", frame.counts)),
    "counts-tiff": ("_counts.tif", lambda frame, extras: _image(".tif", frame.counts)),
    "radiometric": ("_radiometric.tif", _radiometric_encoder),
    "display": (".png", lambda frame, extras: _image(".png", frame.display if extras.image is None else extras.image)),
    "visible": ("_visible.png", lambda frame, extras: _image(".png", extras.photograph(frame.camera))),
    "visible-camera": (
        "_visible_camera.png", lambda frame, extras: _image(".png", extras.photograph(frame.camera.visible_camera))
    ),
}  # fmt: skip


# (Product, the one that it needs, what it is.)
_NEEDS = (
    ("truth", "exr", "channels of the EXR"), ("error", "exr", "channels of the EXR"),
    ("video", "display", "made of the display images"), ("mcap", "exr", "made of the EXR files"),
)  # fmt: skip


def check(
    products: Iterable[str], thermography: ThermographySettings | None = None, camera: Camera | None = None,
    flight: bool = False,
) -> tuple[str, ...]:  # fmt: skip
    """Return the products as a tuple, after refusing unknown names and combinations without effect. If `camera` has a
    visible camera beside it, the product "visible" is two images: registered, and by that camera. "report" and "mcap"
    are products of a `flight` only."""
    products = tuple(products)
    if "visible" in products and camera is not None and camera.visible_camera is not None:
        products = tuple(dict.fromkeys((*products, "visible-camera")))
    if not products:
        raise ThermorenderError(f"products is empty; give some of {', '.join((*WRITERS, *_PARTS))}")
    known = (*WRITERS, *_PARTS)
    for name in products:
        if name not in known:
            raise ThermorenderError(f"product {name!r} is unknown; give some of {', '.join(known)}")
    if "visible-camera" in products and camera is not None and camera.visible_camera is None:
        raise ThermorenderError(
            f"product 'visible-camera' needs a visible camera, which {camera.name} does not have; add visible_width "
            "and visible_field_of_view_deg to its file, or take 'visible', registered to the thermal camera"
        )
    for name, what in (("report", "a page"), ("mcap", "a file")):
        if name in products and not flight:
            raise ThermorenderError(f"product {name!r} is {what} of a flight; leave it out here")
    for name, needed, what in _NEEDS:
        if name in products and needed not in products:
            raise ThermorenderError(f"product {name!r} is {what}; add {needed!r}")
    if thermography is not None and not {"exr", "radiometric"} & set(products):
        raise ThermorenderError("the thermography reading goes into 'exr' and 'radiometric'; add one of these products")
    return products


def paths(folder: str | PathLike[str], index: int, products: Iterable[str]) -> dict[str, Path]:
    """Return {product: path} of a frame's files."""
    return {name: Path(folder) / f"frame_{index:06d}{WRITERS[name][0]}" for name in products if name in WRITERS}


def copied(products: Iterable[str]) -> set[str]:
    """Return the products of a frame whose files others of the flight are made of."""
    return {needed for name, needed, _ in _NEEDS if name in products and name in ("video", "mcap")}


def encoders(
    frame: "Frame", products: Iterable[str], image: NDArray[np.uint8] | None = None,
    thermography: ThermographySettings | None = None,
    photograph: Callable[[Camera], NDArray[np.uint8]] | None = None, compression: str = defaults.EXR_COMPRESSION,
) -> dict[str, Encoder]:  # fmt: skip
    """Return {product: function that returns the bytes of its file}, to be called in any thread. Everything that needs
    the renderer is computed before this returns. `image` replaces `frame.display`; `thermography` gives the reading in
    `radiometric` and the EXR; `photograph` maps a camera to the (H, W, 3) uint8 of `visible`."""
    extras = _Extras("truth" in products, "error" in products, image, thermography, photograph, compression)
    return {name: WRITERS[name][1](frame, extras) for name in products if name in WRITERS}


def write(
    folder: str | PathLike[str], frame: "Frame", products: Iterable[str], image: NDArray[np.uint8] | None = None,
    thermography: ThermographySettings | None = None,
    photograph: Callable[[Camera], NDArray[np.uint8]] | None = None,
) -> dict[str, Path]:  # fmt: skip
    """Write a frame's files and return their paths; the arguments are those of `encoders`."""
    files = paths(folder, frame.index, products)
    for name, encode in encoders(frame, products, image, thermography, photograph).items():
        with atomic(files[name]) as part:
            part.write_bytes(encode())
    return files
