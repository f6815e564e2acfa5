"""The products of a frame: which there are, their files, and all of them written."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from thermorender.errors import ThermorenderError
from thermorender.footage.radiometric_files import write_tlinear
from thermorender.formats import atomic_raster, write_image
from thermorender.output.exr import write_exr
from thermorender.sensor.radiometry import ThermographySettings, thermography_reading

DEFAULT = ("exr", "truth", "counts", "display", "video")
# Products that are part of others.
_PARTS = ("truth", "error", "video")


def write_radiometric(path, frame, thermography):
    """Write what thermography software reads as a 16-bit TIFF of 0.04 K per count."""
    reading = thermography_reading(frame.counts, frame.camera, thermography or ThermographySettings())
    with atomic_raster(path) as part:
        write_tlinear(part, reading)


@dataclass(frozen=True)
class _Extras:
    """What products are made of beside the frame: as of `write`."""

    truth: bool
    error: bool
    image: Any
    thermography: Any
    photograph: Any


# {product: (end of the file name, writer(path, frame, extras))}
WRITERS = {
    "exr": (".exr", lambda path, frame, extras: write_exr(
        path, frame, extras.truth, extras.thermography, extras.error
    )),
    "counts": ("_counts.png", lambda path, frame, extras: write_image(path, frame.counts)),
    "counts-tiff": ("_counts.tif", lambda path, frame, extras: write_image(path, frame.counts)),
    "radiometric": (
        "_radiometric.tif", lambda path, frame, extras: write_radiometric(path, frame, extras.thermography)
    ),
    "display": (".png", lambda path, frame, extras: write_image(path, extras.image)),
    "visible": ("_visible.png", lambda path, frame, extras: write_image(path, extras.photograph(frame.camera))),
    "visible-camera": (
        "_visible_camera.png",
        lambda path, frame, extras: write_image(path, extras.photograph(frame.camera.visible_camera)),
    ),
}  # fmt: skip


def check(products, thermography=None, camera=None):
    """Return the products as a tuple after refusing unknown names and combinations that give nothing.

    The product "visible" is two pictures where `camera` has a visible one beside it: registered, and as that sees it.
    """
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
    for name in ("truth", "error"):
        if name in products and "exr" not in products:
            raise ThermorenderError(f"product {name!r} is channels of the EXR; add 'exr'")
    if "video" in products and "display" not in products:
        raise ThermorenderError("product 'video' is made of the display images; add 'display'")
    if thermography is not None and not {"exr", "radiometric"} & set(products):
        raise ThermorenderError("the thermography reading goes into 'exr' and 'radiometric'; add one of these products")
    return products


def paths(folder, index, products):
    """Return {product: path} of a frame's files."""
    return {
        name: Path(folder) / f"frame_{index:06d}{WRITERS[name][0]}" for name in products if name in WRITERS
    }


def write(folder, frame, products, image=None, thermography=None, photograph=None):
    """Write a frame's files and return their paths.

    Parameters
    ----------
    folder : path
    frame : Frame
    products : sequence of str
    image : (H, W) or (H, W, 3) uint8, optional
        What `display` shows; `frame.display` where None.
    thermography : ThermographySettings, optional
        For `radiometric` and the EXR: what thermography software then reads.
    photograph : callable, optional
        (camera) → (H, W, 3) uint8, for `visible`.
    """
    extras = _Extras("truth" in products, "error" in products, image, thermography, photograph)
    files = paths(folder, frame.index, products)
    if image is None and "display" in files:
        extras = replace(extras, image=frame.display)
    for name, path in files.items():
        WRITERS[name][1](path, frame, extras)
    return files
