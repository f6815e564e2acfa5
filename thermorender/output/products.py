"""Files of a frame: EXR, counts, display image, video, and its record."""

import json
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.footage.radiometric_files import write_tlinear
from thermorender.render.variant import active_device
from thermorender.sensor.radiometry import Operator, camera_constants, operator_temperature
from thermorender.sensor.readout import radiance_from_counts
from thermorender.versions import versions

DEFAULT = ("exr", "truth", "counts", "display", "video")


def write_image(path, image):
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB, as PNG or TIFF by the path's suffix."""
    import cv2

    ordered = image[..., ::-1] if image.ndim == 3 else image
    with atomic(path) as part:
        if not cv2.imwrite(str(part), np.ascontiguousarray(ordered)):
            raise OSError(f"no encoder took a {image.dtype} image")


def write_exr(path, frame, truth, operator=None):
    """Write a frame's radiance and apparent temperature, and its truth where asked, as one multi-channel EXR.

    With an `operator`, what his software reads from the counts stands beside them. The header's `thermorender`
    attribute holds time, pose, seed, plan, versions, device and units as JSON.
    """
    import OpenEXR

    channels = {"radiance": frame.radiance, "apparent_temperature": frame.apparent_temperature}
    if operator is not None:
        channels["operator_temperature"] = operator_reading(frame, operator)
    if truth:
        for name, values in frame.truth.items():
            if values.dtype == np.uint8:
                channels[f"truth.{name}"] = values.astype(np.uint32)
            elif values.ndim == 3:
                for axis, letter in enumerate("xyz"):
                    channels[f"truth.{name}.{letter}"] = np.ascontiguousarray(values[..., axis])
            else:
                channels[f"truth.{name}"] = values
    units = {
        "radiance": "W m-2 sr-1",
        "apparent_temperature": "K",
        "operator_temperature": "K",
        "truth.kinetic_temperature": "K",
        "truth.depth": "m along the optical axis",
        "truth.position": "m, local East-North-Up",
    }
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "thermorender": json.dumps(
            {**record(frame), **made_by(), "operator": operator and asdict(operator), "units": units}
        ),
    }
    with atomic(path) as part:
        OpenEXR.File(header, channels).write(str(part))


def read_exr(path):
    """Return ({channel: (H, W) array}, the frame's record) of an EXR written by `write_exr`."""
    import OpenEXR

    if not Path(path).is_file():
        raise ThermorenderError(f"{path} does not exist; give an EXR file written by thermorender")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            return channels, json.loads(file.header().get("thermorender", "{}"))
    except (RuntimeError, ValueError) as error:
        raise ThermorenderError(
            f"{path} cannot be read as EXR: {error}; give a whole file written by thermorender"
        ) from None


def record(frame):
    """Return what a frame's line in `frames.jsonl` says: time, pose, seed, plan and targets, as plain values."""
    return {
        "index": frame.index,
        "time_s": frame.time_s,
        "world_from_camera": np.round(frame.pose, 9).tolist(),
        "seed": frame.seed,
        "camera": frame.camera.name,
        "plan": frame.plan,
        "budget_mk": frame.budget_mk and {cause: round(value, 2) for cause, value in frame.budget_mk.items()},
        "targets": frame.targets,
    }


def made_by():
    """Return what makes the frames of this process, as plain values: {"versions": …, "device": …}."""
    return {"versions": versions(), "device": active_device()}


def operator_reading(frame, operator):
    """Return the temperatures an operator's software reads from a frame's counts, (H, W) float32 [K]."""
    # There are fewer counts than pixels.
    signal = radiance_from_counts(np.arange(int(frame.counts.max()) + 1), frame.camera)
    read = operator_temperature(signal, camera_constants(frame.camera), operator).astype(np.float32)
    return read[frame.counts]


def write_radiometric(path, frame, operator):
    """Write what the operator's software reads as a 16-bit TIFF of 0.04 K per count."""
    with atomic(path) as part:
        write_tlinear(part, operator_reading(frame, operator or Operator()))


# {product: (end of the file name, writer(path, frame, truth, operator, image))}
WRITERS = {
    "exr": (".exr", lambda path, frame, truth, operator, image: write_exr(path, frame, truth, operator)),
    "counts": ("_counts.png", lambda path, frame, truth, operator, image: write_image(path, frame.counts)),
    "counts-tiff": ("_counts.tif", lambda path, frame, truth, operator, image: write_image(path, frame.counts)),
    "radiometric": (
        "_radiometric.tif", lambda path, frame, truth, operator, image: write_radiometric(path, frame, operator),
    ),
    "display": (".png", lambda path, frame, truth, operator, image: write_image(path, image)),
}


def check(products, operator=None):
    """Return the products as a tuple after refusing unknown names and combinations that give nothing."""
    products = tuple(products)
    if not products:
        raise ThermorenderError(f"products is empty; give some of {', '.join((*WRITERS, 'truth', 'video'))}")
    known = (*WRITERS, "truth", "video")
    for name in products:
        if name not in known:
            raise ThermorenderError(f"product {name!r} is unknown; give some of {', '.join(known)}")
    if "truth" in products and "exr" not in products:
        raise ThermorenderError("product 'truth' is channels of the EXR; add 'exr'")
    if "video" in products and "display" not in products:
        raise ThermorenderError("product 'video' is made of the display images; add 'display'")
    if operator is not None and not {"exr", "radiometric"} & set(products):
        raise ThermorenderError("the operator's reading goes into 'exr' and 'radiometric'; add one of these products")
    return products


def paths(folder, index, products):
    """Return {product: path} of a frame's files."""
    return {
        name: Path(folder) / f"frame_{index:06d}{WRITERS[name][0]}" for name in products if name in WRITERS
    }


def write(folder, frame, products, image=None, operator=None):
    """Write a frame's files and return their paths.

    Parameters
    ----------
    folder : path
    frame : Frame
    products : sequence of str
    image : (H, W) or (H, W, 3) uint8, optional
        What `display` shows; `frame.display` where None.
    operator : Operator, optional
        Settings of the operator's software, for `radiometric` and the EXR.
    """
    files = paths(folder, frame.index, products)
    if image is None and "display" in files:
        image = frame.display
    for name, path in files.items():
        WRITERS[name][1](path, frame, "truth" in products, operator, image)
    return files


def write_video(path, images, rate_hz):
    """Write 8-bit PNG files, grey or colour, as an H.264 MP4.

    Parameters
    ----------
    path : path
    images : sequence of paths
        Display images, in order.
    rate_hz : float
        Frames per second.
    """
    import imageio_ffmpeg

    first = _display(images[0])
    with atomic(path) as part:
        writer = imageio_ffmpeg.write_frames(
            str(part),
            (first.shape[1], first.shape[0]),
            fps=rate_hz,
            pix_fmt_in="gray" if first.ndim == 2 else "rgb24",
            pix_fmt_out="yuv420p",
            codec="libx264",
            macro_block_size=1,
            ffmpeg_log_level="error",
            # One thread and no time stamps or version strings: the same frames give the same bytes.
            output_params=[
                *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-crf", "18", "-threads", "1"),
                *("-flags:v", "+bitexact", "-fflags", "+bitexact"),
            ],
        )
        # Closed in any case: the encoder is a process of its own, which would write on.
        with closing(writer):
            writer.send(None)
            for image in images:
                writer.send(_display(image, first.shape))


def _display(path, shape=None):
    """A display image read back, (H, W) or (H, W, 3) RGB uint8; one that is damaged or of another size is refused."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or shape not in (None, image.shape):
        raise ThermorenderError(f"{path} is damaged; remove it and continue with --resume")
    return np.ascontiguousarray(image if image.ndim == 2 else image[..., ::-1])
