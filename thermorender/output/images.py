"""Images and videos: PNG, TIFF, MP4."""

from contextlib import closing

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.files import atomic


def write_image(path, image):
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB, as PNG or TIFF by the path's suffix."""
    import cv2

    ordered = image[..., ::-1] if image.ndim == 3 else image
    with atomic(path) as part:
        if not cv2.imwrite(str(part), np.ascontiguousarray(ordered)):
            raise OSError(f"no encoder took a {image.dtype} image")


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
