"""Pictures of another program as a method: a folder with one picture for each pose or pair."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.view import View
from thermorender.apps.training.dataset import Entry
from thermorender.errors import ThermorenderError
from thermorender.formats import decoded
from thermorender.scene.surface import scene_kelvin
from thermorender.sensor.thermal_files import read_thermal_image

PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")


class Foreign:
    """Another program's pictures of the views, one path each.

    TIFFs that declare their unit are used as they are. Others are converted by the affine fit with least square error
    against the truth, which favours them.
    """

    def __init__(self, name: str, folder: Path, paths: Sequence[Path], scaled: bool = True) -> None:
        self.name, self.folder, self.paths, self.scaled = name, folder, paths, scaled
        self.fit = (1.0, 0.0) if scaled else (0.0, np.nan)

    @classmethod
    def of_poses(
        cls, name: str, folder: Path, scene_name: str, count: int, several: bool, shape: tuple[int, int]
    ) -> "Foreign":
        """Return the frames `pose_0000.tif` and so on of a scene's poses: TIFFs that declare their unit.

        Each of `several` scenes has a folder of its name. Missing frames, wrong sizes and implausible values are
        refused.
        """
        _check_folder(name, folder, "a folder with pose_0000.tif and so on")
        own = folder / scene_name
        place = own if own.is_dir() else folder
        found = cls(name, folder, [place / f"pose_{index:04d}.tif" for index in range(count)])
        for path in found.paths:
            if not path.is_file() or (several and path.parent == folder):
                raise ThermorenderError(
                    f"--foreign {name}={folder} lacks {path.name} for scene {scene_name!r}; give a temperature TIFF of "
                    f"each of the scene's {count} pose{'s' * (count != 1)}, in a folder with the scene's name where "
                    "there are several scenes"
                )
            kelvin = found.values(path, shape)
            if np.isfinite(kelvin).any():
                # Refuses degrees Celsius declared as kelvin.
                scene_kelvin(f"median of {path}", float(np.nanmedian(kelvin)))
        return found

    @classmethod
    def of_pairs(cls, name: str, folder: Path, entries: Sequence[Entry]) -> "Foreign":
        """Return the pictures of a data set's pairs, named by their keys."""
        _check_folder(name, folder, "a folder with a picture for each pair")
        pictures = {path.stem: path.absolute() for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES}
        missing = [entry.key for entry in entries if entry.key not in pictures]
        if missing:
            raise ThermorenderError(
                f"--foreign {name}={folder} has no picture of {len(missing)} of {len(entries)} pairs, the first "
                f"{missing[0]!r}; name each picture by its pair's key, such as {missing[0]}.png"
            )
        paths = [pictures[entry.key] for entry in entries]
        # The first picture decides for all.
        return cls(name, folder, paths, bool(paths) and _declares(paths[0]))

    def temperature(self, view: View) -> NDArray[np.float64]:
        """Return the apparent temperature of a View, (H, W) float64 [K]."""
        values = self.values(self.paths[view.index], view.known.shape)
        return values if self.scaled else self.fit[0] * values + self.fit[1]

    def values(self, path: Path, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return a picture's values, (H, W) float64; kelvin where the picture declares its unit."""
        import cv2

        image: NDArray[Any] | None
        if self.scaled:
            image = read_thermal_image(path, takes_scale=False).kelvin
        else:
            image = decoded(path.read_bytes(), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        if image is not None and image.ndim == 3 and (image[..., :3] == image[..., :1]).all():
            image = image[..., 0]
        if image is None or image.shape != shape:
            height, width = shape
            raise ThermorenderError(
                f"{path} is not a grey picture of {width}×{height} pixels, the size of its reference; write it again "
                "at that size and without a palette"
            )
        return image.astype(np.float64)

    def fitted(self, views: Iterable[View]) -> "Foreign":
        """Find the affine fit over Views, where one is needed; return self."""
        if self.scaled:
            return self
        # Σ 1, x, y, x², xy relative to the first values, so that squares stay small.
        moments, origin = np.zeros(5), (0.0, 0.0)
        for view in views:
            assert view.truth is not None
            x = self.values(self.paths[view.index], view.known.shape)[view.known]
            y = view.truth[view.known].astype(np.float64)
            if not moments[0] and x.size:
                origin = float(x[0]), float(y[0])
            if x.size:
                x, y = x - origin[0], y - origin[1]
                moments += [x.size, x.sum(), y.sum(), (x * x).sum(), (x * y).sum()]
        count, sum_x, sum_y, xx, xy = moments
        spread = count * xx - sum_x * sum_x
        if spread <= 0.0:
            raise ThermorenderError(
                f"--foreign {self.name}={self.folder}: all values are the same, so no scale can be fitted; give "
                "translated pictures"
            )
        slope = (count * xy - sum_x * sum_y) / spread
        self.fit = slope, (sum_y - slope * sum_x) / count + origin[1] - slope * origin[0]
        return self


def _check_folder(name: str, folder: Path, wanted: str) -> None:
    if not folder.is_dir():
        raise ThermorenderError(f"--foreign {name}={folder} is not a folder; give {wanted}")


def _declares(path: Path) -> bool:
    """Return whether a picture is a TIFF that declares its unit."""
    try:
        return path.suffix.lower() in (".tif", ".tiff") and read_thermal_image(path) is not None
    except ThermorenderError:
        return False
