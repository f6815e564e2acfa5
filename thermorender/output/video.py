"""Videos: display images as MP4."""

import subprocess
import tempfile
from contextlib import suppress
from fractions import Fraction
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.formats import decoded


def write_video(path, images, rate_hz):
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
        An image that is damaged, or an encoder that ends before the video does: killed, or on a full disk.
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
        with tempfile.TemporaryFile() as told:
            encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=told)
            try:
                # An encoder that has ended takes no more, and its status tells why.
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
                told.seek(0)
                said = " ".join(told.read().decode(errors="replace").split()[-40:])
                raise OSError(f"the encoder ended with status {status}{': ' if said else ''}{said}")


def _display(path, shape=None):
    """A display image read back, (H, W) or (H, W, 3) RGB uint8; one that is damaged or of another size is refused."""
    import cv2

    image = decoded(Path(path).read_bytes(), cv2.IMREAD_UNCHANGED) if Path(path).is_file() else None
    if image is None or shape not in (None, image.shape):
        raise ThermorenderError(f"{path} is damaged; remove it and continue with --resume")
    return np.ascontiguousarray(image if image.ndim == 2 else image[..., ::-1])
