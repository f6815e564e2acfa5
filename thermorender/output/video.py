"""Videos: display images as MP4."""

import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from fractions import Fraction
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.formats import decoded


def write_video(path: str | PathLike[str], images: Sequence[Path], rate_hz: float) -> None:
    """Write 8-bit PNG files, grey or colour, as an H.264 MP4.

    Parameters
    ----------
    path : path
    images : sequence of paths
        Display images, in order.
    rate_hz : float
        Frames per second.

    Raises
    ------
    ThermorenderError
        A damaged image.
    OSError
        An encoder that ends too early: killed, or on a full disk.
    """
    import imageio_ffmpeg

    first = _display(images[0])
    with atomic(path) as part:
        command = [
            imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error",
            *("-f", "rawvideo", "-pix_fmt", "gray" if first.ndim == 2 else "rgb24"),
            "-s", f"{first.shape[1]}x{first.shape[0]}", "-r", str(Fraction(rate_hz).limit_denominator()),
            *("-i", "-"),
            # One thread and no time stamps or version strings: the same frames give the same bytes.
            *("-an", "-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-threads", "1"),
            *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-flags:v", "+bitexact", "-fflags", "+bitexact"),
            str(part),
        ]  # fmt: skip
        with tempfile.TemporaryFile() as messages:
            encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=messages)
            try:
                # The status below reports an encoder that has ended.
                with suppress(BrokenPipeError):
                    for image in images:
                        encoder.stdin.write(_display(image, first.shape).data)
                    encoder.stdin.flush()
            except BaseException:
                encoder.kill()
                raise
            finally:
                with suppress(BrokenPipeError):
                    encoder.stdin.close()
                status = encoder.wait()
            if status:
                messages.seek(0)
                said = " ".join(messages.read().decode(errors="replace").split()[-40:])
                raise OSError(f"the encoder ended with status {status}{': ' if said else ''}{said}")


def _display(path: Path, shape: tuple[int, ...] | None = None) -> NDArray[np.uint8]:
    """A display image, (H, W) or (H, W, 3) RGB uint8; a damaged one or one of another shape is refused."""
    import cv2

    image = decoded(Path(path).read_bytes(), cv2.IMREAD_UNCHANGED) if Path(path).is_file() else None
    if image is None or shape not in (None, image.shape):
        raise ThermorenderError(f"{path} is damaged; remove it and continue with --resume")
    return np.ascontiguousarray(image if image.ndim == 2 else image[..., ::-1])
