"""The pictures of a rig's frames, read and reduced to the resolutions at which a rig is fitted."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.training.registration.gradient_directions import directions
from thermorender.apps.training.registration.rig import half_diagonal
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress

# Returns (visible (h, w, 3) uint8, thermal (H, W)) of a frame.
ReadPair = Callable[[], tuple[NDArray[np.uint8], np.ndarray]]
# (rows, columns) of the visible and of the thermal picture.
Shapes = tuple[tuple[int, int], tuple[int, int]]

# Of more frames, this many evenly spaced ones are used.
MOST_FRAMES = 32
# Smallest side of a picture that a rig can be fitted to [px].
_LEAST_SIDE = 48
# Scales searched if the fields of view are unknown, relative to the scale at which both pictures cover the same.
SCALES = (0.25, 1.3)
# Uncertainty of the scale from published fields of view. Chosen: they are rounded and include lens distortion.
FIELD_TOLERANCE = 0.15


@dataclass(frozen=True, eq=False)
class Frame:
    """Grey float32 pictures of a pair; the visible one is reduced by the factor that `read_frames` returns."""

    name: str
    visible: np.ndarray
    thermal: np.ndarray


@dataclass(frozen=True, eq=False)
class Level:
    """Gradient directions of all frames at one resolution."""

    # visible, thermal: (h, w) complex64 each
    visible: list[np.ndarray]
    thermal: list[np.ndarray]
    density: tuple[float, float]  # Pixels of `visible` per pixel of the camera's picture, along columns and rows
    # x, y: (h, w) float64 positions of the pixels of `thermal`, from the picture's centre [thermal px]
    x: np.ndarray
    y: np.ndarray
    every: int  # Stride along both sides in the sums over pixels
    diagonal: float  # Half the diagonal of the visible camera's picture [px]


def scale_of_fields(
    fields_of_view: tuple[ArrayLike, ArrayLike], visible_shape: tuple[int, int], thermal_shape: tuple[int, int]
) -> float:
    """Return visible pixels per thermal pixel from fields of view [deg], the geometric mean of columns and rows."""
    lengths = [
        np.array(shape[::-1]) / 2.0 / np.tan(np.radians(np.asarray(angles, np.float64)) / 2.0)
        for angles, shape in zip(fields_of_view, (visible_shape, thermal_shape), strict=True)
    ]
    return float(np.sqrt(np.prod(lengths[0] / lengths[1])))


def read_frames(
    frames: Iterable[tuple[str, ReadPair]], fields_of_view: tuple[ArrayLike, ArrayLike] | None,
    report_progress: Progress,
) -> tuple[list[Frame], Shapes, float, float | None]:  # fmt: skip
    """Return (list of Frame, (visible shape, thermal shape), reduction of the visible pictures, scale or None)."""
    import cv2

    frames = list(frames)
    if not frames:
        raise ThermorenderError("a rig needs at least one pair of pictures, got none; give one or more")
    if len(frames) > MOST_FRAMES:
        frames = [frames[k] for k in np.linspace(0, len(frames) - 1, MOST_FRAMES).round().astype(int)]
    pictures: list[Frame] = []
    shapes: Shapes | None = None
    start, reduced = None, 1.0
    for number, (name, read) in enumerate(frames):
        report_progress("reading pictures", number / len(frames))
        visible, thermal = read()
        if shapes is None:
            shapes = _shape_of(visible), _shape_of(thermal)
            side = min(*shapes[0], *shapes[1])
            if side < _LEAST_SIDE:
                raise ThermorenderError(
                    f"pair {name!r} has a side of {side} pixels; a rig needs pictures of at least {_LEAST_SIDE}"
                )
            if fields_of_view is not None:
                start = scale_of_fields(fields_of_view, *shapes)
                reduced = max(start * (1.0 - FIELD_TOLERANCE), 1.0)
            else:
                reduced = max(SCALES[0] * filling_scale(shapes), 1.0)
        elif (_shape_of(visible), _shape_of(thermal)) != shapes:
            raise ThermorenderError(
                f"pair {name!r} has pictures of {visible.shape[1]}×{visible.shape[0]} and "
                f"{thermal.shape[1]}×{thermal.shape[0]} pixels, others of {shapes[0][1]}×{shapes[0][0]} and "
                f"{shapes[1][1]}×{shapes[1][0]}; give the pictures of one rig"
            )
        grey = cv2.cvtColor(np.ascontiguousarray(visible), cv2.COLOR_RGB2GRAY)
        size = [round(side / reduced) for side in grey.shape[::-1]]
        pictures.append(Frame(name, cv2.resize(grey, size, interpolation=cv2.INTER_AREA), _clipped(thermal)))
    assert shapes is not None
    return pictures, shapes, reduced, start


def _shape_of(picture: np.ndarray) -> tuple[int, int]:
    """(rows, columns) of a picture."""
    rows, columns = picture.shape[:2]
    return rows, columns


def _clipped(thermal: ArrayLike) -> np.ndarray:
    """A thermal picture as float32, clipped to its 0.5…99.5 % quantiles against fires and dead pixels; NaN → median."""
    values = np.asarray(thermal, np.float32)
    known = values[np.isfinite(values)]
    if not known.size:
        return np.zeros(values.shape, np.float32)
    low, middle, high = np.quantile(known, (0.005, 0.5, 0.995))
    return np.clip(np.where(np.isfinite(values), values, middle), low, high).astype(np.float32)


def filling_scale(shapes: Shapes) -> float:
    """Return the scale at which both pictures cover the same."""
    return float(min(np.array(shapes[0]) / np.array(shapes[1])))


def resized(grey: np.ndarray, factor: float) -> tuple[np.ndarray, tuple[float, float]]:
    """Return a picture reduced by a factor, and its pixels per original pixel along columns and rows."""
    import cv2

    size = [max(round(side / factor), 8) for side in grey.shape[::-1]]
    how = cv2.INTER_AREA if factor >= 1.0 else cv2.INTER_LINEAR
    return cv2.resize(grey, size, interpolation=how), (size[0] / grey.shape[1], size[1] / grey.shape[0])


def level_of(pictures: Sequence[Frame], shapes: Shapes, reduced: float, scale: float, factor: float) -> Level:
    """Return the Level whose pixels are `factor` thermal pixels wide, for a rig of about this scale."""
    visible, thermal = [], []
    for frame in pictures:
        small, _ = resized(frame.visible, max(scale * factor / reduced, 1.0))
        visible.append(directions(small))
        small_thermal, (across, down) = resized(frame.thermal, factor)
        thermal.append(directions(small_thermal))
    density = visible[0].shape[1] / shapes[0][1], visible[0].shape[0] / shapes[0][0]
    height, width = thermal[0].shape
    column, row = (np.arange(width) + 0.5) / across, (np.arange(height) + 0.5) / down
    x, y = np.meshgrid(column - shapes[1][1] / 2.0, row - shapes[1][0] / 2.0)
    return Level(visible, thermal, density, x, y, 2 if width > 400 else 1, half_diagonal(shapes[0]))
