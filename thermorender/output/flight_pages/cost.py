"""What a flight costs: time, memory and space on the disk, from frames that were just rendered and written."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike

# Frames that are rendered for a measurement: the first also compiles kernels and traces light.
MEASURED = 2


@dataclass(frozen=True)
class Cost:
    """The cost of the frames of a flight that are still to be written."""

    frames: int  # Still to be written
    # For the frame that was measured last, with its files, which are written while the next frame is rendered
    seconds: float
    sizes: Mapping[str, float]  # {product: bytes of a frame}, the mean of the frames measured
    free: int  # Free bytes of the output's file system
    memory: int | None  # Most memory that this process had in use [bytes]; None where the system does not state it

    @classmethod
    def of(cls, folder: PathLike[str], frames: int, seconds: float, sizes: Mapping[str, float]) -> "Cost":
        """Return the Cost with the free space of a folder's file system and the memory of this process."""
        return cls(frames, seconds, sizes, shutil.disk_usage(folder).free, _memory())

    @property
    def space(self) -> float:
        """Bytes of all frames still to be written."""
        return self.frames * sum(self.sizes.values())

    def lines(self) -> list[str]:
        """Return the cost in sentences."""
        parts = ", ".join(f"{name} {size / 1e6:.2f}" for name, size in self.sizes.items()) or "no files"
        memory = "unknown" if self.memory is None else f"{self.memory / 1e9:.2g} GB in use at most so far"
        return [
            f"time: {self.seconds:.2g} s for a frame, measured here, {_duration(self.frames * self.seconds)} for "
            f"{self.frames} frames",
            f"memory: {memory}",
            f"disk: {sum(self.sizes.values()) / 1e6:.3g} MB a frame, measured ({parts}), {_size(self.space)} for "
            f"{self.frames} frames; {_size(self.free)} free",
        ]

    @property
    def warning(self) -> str | None:
        """A warning that the frames do not fit on the disk, else None."""
        if self.space < self.free:
            return None
        return (
            f"{self.frames} frames take {_size(self.space)}, and the output's file system has {_size(self.free)} free: "
            "give another folder, fewer products, a lower rate_hz, or a part with start_s and stop_s"
        )


def _memory() -> int | None:
    import sys

    try:
        import resource
    except ImportError:  # on Windows
        return None
    # In kilobytes, on macOS in bytes.
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.2g} s"
    return f"{seconds / 60.0:.3g} min" if seconds < 6000.0 else f"{seconds / 3600.0:.3g} h"


def _size(count: float) -> str:
    return f"{count / 1e9:.3g} GB" if count >= 1e9 else f"{count / 1e6:.3g} MB"
