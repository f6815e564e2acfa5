"""Videos: display images as MP4."""

import os
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from fractions import Fraction
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files
from thermorender.errors import ThermorenderError
from thermorender.formats import decoded


class VideoWriter:
    """Writes 8-bit images, (H, W) grey or (H, W, 3) RGB, as an H.264 MP4, in the order in which they are given. The
    file gets its name when the block ends; an error leaves no file. The end of the block reports an encoder that
    failed."""

    def __init__(self, path: str | PathLike[str], rate_hz: float) -> None:
        self._path, self._rate, self._shape = Path(path), rate_hz, tuple[int, ...]()
        self._part: Path | None = None
        self._encoder: Any = None
        self._open = ExitStack()

    def __enter__(self) -> "VideoWriter":
        return self

    def write(self, image: NDArray[np.uint8]) -> None:
        """Encode the next image, of the shape of the first."""
        if self._encoder is None:
            self._start(image.shape)
        # The status at the end reports an encoder that has ended.
        with suppress(BrokenPipeError):
            self._encoder.stdin.write(np.ascontiguousarray(image).data)

    def write_file(self, path: Path) -> None:
        """Encode a PNG file; raise ThermorenderError if it is damaged or of another shape."""
        self.write(_display(path, self._shape or None))

    def _start(self, shape: tuple[int, ...]) -> None:
        import imageio_ffmpeg

        self._shape, self._part = shape, files.write_aside(self._path, b"")
        command = [
            imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error",
            *("-f", "rawvideo", "-pix_fmt", "gray" if len(shape) == 2 else "rgb24"),
            "-s", f"{shape[1]}x{shape[0]}", "-r", str(Fraction(self._rate).limit_denominator()),
            *("-i", "-"),
            # One thread and no time stamps or version strings: the same frames give the same bytes. The preset takes a
            # quarter of the time of x264's default, for a third more bytes at a PSNR that is 0.5 dB lower.
            *("-an", "-vcodec", "libx264", "-preset", "superfast", "-pix_fmt", "yuv420p", "-crf", "18"),
            *("-threads", "1"),
            *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-flags:v", "+bitexact", "-fflags", "+bitexact"),
            str(self._part),
        ]  # fmt: skip
        self._messages = self._open.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        self._encoder = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._messages
        )

    def _ended(self) -> None:
        """Close the encoder; raise OSError if it did not encode all images."""
        with suppress(BrokenPipeError):
            self._encoder.stdin.close()
        status = self._encoder.wait()
        self._messages.seek(0)
        said = " ".join(self._messages.read().decode(errors="replace").split()[-40:])
        if status:
            raise OSError(f"the encoder ended with status {status}{': ' if said else ''}{said}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._part is None:
            return
        try:
            if kind is not None:
                self._encoder.kill()
                with suppress(OSError):
                    self._ended()
                return
            with files.reported(self._path):
                self._ended()
            files.put_in_place(self._part, self._path)
        finally:
            self._open.close()
            self._part.unlink(missing_ok=True)


def write_video(path: str | PathLike[str], images: Sequence[Path], rate_hz: float) -> None:
    """Write 8-bit PNG files, grey or colour, as an H.264 MP4."""
    with VideoWriter(path, rate_hz) as video:
        for image in images:
            video.write_file(image)


def _display(path: Path, shape: tuple[int, ...] | None = None) -> NDArray[np.uint8]:
    """A display image, (H, W) or (H, W, 3) RGB uint8; a damaged one or one of another shape is refused."""
    import cv2

    image = decoded(Path(path).read_bytes(), cv2.IMREAD_UNCHANGED) if os.path.isfile(path) else None
    if image is None or shape not in (None, image.shape):
        raise ThermorenderError(f"{path} is damaged; remove it and continue with resume")
    return np.ascontiguousarray(image if image.ndim == 2 else image[..., ::-1])
