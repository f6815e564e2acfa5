"""Pictures of a comparison: small ones inside the page, which show kelvin under the pointer, and full-size files."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.referee.report.figures import error_images, shown_photograph
from thermorender.apps.compare.referee.views import View, evenly

# Steps per kelvin of the pictures inside the page, and their largest total size [bytes].
STEPS_PER_K = 20.0
MOST_BYTES = 12_000_000
# Largest number of poses drawn per scene and in total; each scene gets at least one.
_POSES, _ALL = 3, 12


@dataclass
class Pictures:
    """The pictures of a comparison."""

    folder: Path  # Files are written to its folder `pictures`
    scenes: int = 1  # Number of scenes
    # {"title", "visible", "pictures": [{"label", "source", "reference"}]} of each pose on the page
    views: list[dict[str, Any]] = field(default_factory=list)
    _bytes: int = 0

    def add(self, scene: str, view: View, seen: Mapping[str, NDArray[np.floating]], index: int, count: int,
            reference: str = "reference") -> None:  # fmt: skip
        """Add the pictures of View `index` of `count` if it is drawn: `seen` is {label: (H, W) kelvin}."""
        if index not in evenly(count, min(_POSES, max(1, _ALL // self.scenes))):
            return
        place = self.folder / "pictures"
        place.mkdir(exist_ok=True)
        error_images(place / f"{scene}_{index:04d}.png", view, seen, reference)
        shown = [] if view.truth is None else [(reference, view.truth)]
        pictures: list[dict[str, Any]] = [
            {"label": label, "source": encoded(image, view.known), "reference": label == reference}
            for label, image in (*shown, *seen.items())
        ]
        size = sum(len(each["source"]) for each in pictures)
        if self._bytes + size > MOST_BYTES:
            return
        self._bytes += size
        photograph = cv2.resize(shown_photograph(view), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        self.views.append({
            "title": f"{scene}, {view.time_s:.1f} s",
            "visible": _data("jpeg", cv2.imencode(".jpg", photograph[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1]),
            "pictures": pictures,
        })  # fmt: skip


def encoded(kelvin: NDArray[np.floating], known: NDArray[np.bool_]) -> str:
    """Return a picture at half its size as a data URL of a PNG that encodes kelvin.

    Red and green are the high and low byte of the temperature in steps of 1/20 K, 0 for none; blue is 255 at scored
    pixels.
    """
    small = kelvin[::2, ::2]
    steps = np.where(np.isfinite(small), np.clip(np.rint(np.nan_to_num(small) * STEPS_PER_K), 0, 65535), 0).astype(
        np.uint16
    )
    blue = np.where(known[::2, ::2], 255, 0).astype(np.uint8)
    image = np.stack([blue, (steps & 255).astype(np.uint8), (steps >> 8).astype(np.uint8)], axis=-1)
    return _data("png", cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1])


def _data(kind: str, content: Any) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(np.asarray(content).tobytes()).decode()}"
