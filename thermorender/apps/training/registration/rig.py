"""A rig: a visible and a thermal camera fixed to each other, and the visible picture resampled onto the thermal one.

For points far away compared with the distance of the cameras, a thermal position x maps to a visible position v by

    q = scale · R(rotation) · x + shift,    v = q · (1 + k1 · |q|² / d²),

with x and v in pixels from the pictures' centres and d half the diagonal of the visible picture. If visible pictures
were resized unequally along their sides, the row of v is multiplied by the aspect. A rig is calibrated once
(`thermorender.apps.training.registration.fit`) and stored as JSON.
"""

from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from thermorender import formats
from thermorender.errors import ThermorenderError, shortened

FORMAT = 1
# Side of the squares of an inspection picture's checkerboard [px].
_SQUARE = 40


# Of a rig's numbers: least, largest and how many (0: a single one).
_RANGES: dict[str, tuple[float, float, int]] = {
    "visible_shape": (1, 100_000, 2),
    "thermal_shape": (1, 100_000, 2),
    "scale": (1e-3, 1e3, 0),
    "rotation_deg": (-360.0, 360.0, 0),
    "shift_px": (-1e6, 1e6, 2),
    "k1": (-10.0, 10.0, 0),
    "aspect": (0.1, 10.0, 0),
}


@dataclass(frozen=True)
class Rig:
    """Mapping between the pictures of two cameras fixed to each other."""

    # visible_shape, thermal_shape: (2,) tuple rows and columns
    visible_shape: tuple[int, int]
    thermal_shape: tuple[int, int]
    scale: float  # Visible pixels per thermal pixel at the centre
    rotation_deg: float  # Rotation of the visible axes relative to the thermal ones, from right towards down
    # (2,) tuple thermal centre in the visible picture, from its centre, right and down [visible px]
    shift_px: tuple[float, float]
    k1: float  # Radial distortion of the visible lens, at half the diagonal
    aspect: float = 1.0  # Rows over columns of a square's image in the visible picture; 1 unless resized unequally
    # Standard errors of scale, rotation_deg, column_px, row_px, k1, aspect by the jackknife over frames, and
    # `position_px`, the RMS error of positions in the thermal picture; empty for a single frame
    errors: dict[str, float] = field(default_factory=dict)
    # Mean correlation of unsigned gradient directions over the frames used: 1 for identical directions, 0 for
    # unrelated pictures
    score: float | None = None
    # The same with each thermal picture paired with another frame's visible picture
    score_unrelated: float | None = None
    frames: dict[str, float] = field(default_factory=dict)  # Score of each frame
    rejected: dict[str, str] = field(default_factory=dict)  # Reason for each frame that was left out

    def visible_from_thermal(self, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return visible positions (column, row) of thermal ones [px]; the centre of the first pixel is at ½."""
        height, width = self.thermal_shape
        x, y = positions(
            parameters_of(self), column - width / 2.0, row - height / 2.0, half_diagonal(self.visible_shape)
        )
        return x + self.visible_shape[1] / 2.0, y + self.visible_shape[0] / 2.0

    @property
    def crop(self) -> tuple[int, int, int, int]:
        """Part of the visible picture that the thermal one covers: (first column, first row, columns, rows)."""
        column, row = self.visible_from_thermal(*_corners_and_sides(self.thermal_shape))
        height, width = self.visible_shape
        left, right = np.clip((np.floor(column.min()), np.ceil(column.max())), 0, width)
        top, bottom = np.clip((np.floor(row.min()), np.ceil(row.max())), 0, height)
        return int(left), int(top), int(right - left), int(bottom - top)

    def __str__(self) -> str:
        plus_minus = {key: f" ± {value:.2g}" for key, value in self.errors.items()}
        lines = [
            f"scale {self.scale:.5g}{plus_minus.get('scale', '')} visible px per thermal px",
            f"rotation {self.rotation_deg:.4g}{plus_minus.get('rotation_deg', '')}°",
            f"shift {self.shift_px[0]:.4g}{plus_minus.get('column_px', '')}, "
            f"{self.shift_px[1]:.4g}{plus_minus.get('row_px', '')} visible px",
            f"k1 {self.k1:.4g}{plus_minus.get('k1', '')}",
        ]
        if self.aspect != 1.0:
            lines.append(f"aspect {self.aspect:.5g}{plus_minus.get('aspect', '')}")
        if self.score is not None:
            used = len(self.frames) - len(self.rejected)
            lines.append(f"score {self.score:.3f} over {used} of {len(self.frames)} frames")
        if self.score_unrelated is not None:
            lines[-1] += f", {self.score_unrelated:.3f} of unrelated pictures"
        return "\n".join(lines)


def parameters_of(rig: Rig) -> NDArray[np.float64]:
    """Return the (6,) parameters of a Rig, as `positions` takes them."""
    shift = np.array(rig.shift_px) / rig.scale
    return np.array([np.log(rig.scale), np.radians(rig.rotation_deg), *shift, rig.k1, np.log(rig.aspect)])


def half_diagonal(shape: tuple[int, ...]) -> float:
    """Return half the diagonal of a picture of (rows, columns) [px]."""
    return 0.5 * float(np.hypot(shape[0], shape[1]))


def positions(
    parameters: np.ndarray, x: np.ndarray, y: np.ndarray, diagonal: float
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return (x, y) in the visible picture of points of the thermal one, both from the pictures' centres [px].

    The (6,) parameters are ln scale, rotation [rad], shift over scale (right, down) [thermal px], k1 and ln aspect;
    `diagonal` is half that of the visible picture [px].
    """
    scale, (cos, sin) = np.exp(parameters[0]), (np.cos(parameters[1]), np.sin(parameters[1]))
    u, v = scale * (cos * x - sin * y + parameters[2]), scale * (sin * x + cos * y + parameters[3])
    stretched = 1.0 + parameters[4] * (u**2 + v**2) / diagonal**2
    return u * stretched, v * stretched * np.exp(parameters[5])


def warped(
    visible: NDArray[np.uint8], rig: Rig, shape: tuple[int, int] | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the visible picture on thermal pixels of `shape`: ((H, W, 3) uint8 sRGB, (H, W) bool known)."""
    import cv2

    if tuple(visible.shape[:2]) != tuple(rig.visible_shape):
        raise ThermorenderError(
            f"the visible picture is {_size(visible.shape)} pixels and the rig's {_size(rig.visible_shape)}; give the "
            "camera's original pictures, or calibrate again"
        )
    height, width = shape or rig.thermal_shape
    column, row = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    x, y = rig.visible_from_thermal(column * rig.thermal_shape[1], row * rig.thermal_shape[0])
    # Reduced to the result's resolution first, so that fine detail is averaged, not subsampled.
    coarser = max(rig.scale * rig.thermal_shape[1] / width, 1.0)
    small = [max(round(side / coarser), 1) for side in visible.shape[1::-1]]
    source: np.ndarray = visible
    if coarser > 1.0:
        source = cv2.resize(visible, small, interpolation=cv2.INTER_AREA)
    x = (x * (small[0] / rig.visible_shape[1]) - 0.5).astype(np.float32)
    y = (y * (small[1] / rig.visible_shape[0]) - 0.5).astype(np.float32)
    found = cv2.remap(source, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    valid = (x >= 0.0) & (y >= 0.0) & (x <= small[0] - 1.0) & (y <= small[1] - 1.0)
    found[~valid] = 0
    return np.asarray(found, np.uint8), valid


def write_overlay(path: str | Path, visible: NDArray[np.uint8], thermal: np.ndarray, rig: Rig) -> None:
    """Write a PNG to inspect a rig: thermal edges over the warped visible picture, and a checkerboard of both."""
    import cv2

    from thermorender.formats import write_image

    height, width = thermal.shape
    colours, _ = warped(visible, rig, (height, width))
    low, high = np.nanpercentile(thermal, (1.0, 99.0))
    grey = np.nan_to_num(255.0 * np.clip((thermal - low) / max(high - low, 1e-9), 0.0, 1.0)).astype(np.uint8)
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    # Crests of the steepest tenth.
    edges = cv2.Canny(smooth, 0.5 * float(np.quantile(slope, 0.9)), float(np.quantile(slope, 0.9)), L2gradient=True)
    drawn = colours.copy()
    drawn[edges > 0] = (255, 40, 40)
    row, column = np.indices(thermal.shape) // _SQUARE
    board = np.where(((row + column) % 2 == 0)[..., None], colours, grey[..., None])
    write_image(path, np.hstack([drawn, board]))


def save_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as JSON."""
    formats.write_json(path, {"format": FORMAT, **asdict(rig)})


def load_rig(path: str | Path) -> Rig:
    """Return the Rig of a file."""
    text = formats.read_text(path, "JSON")
    try:
        values = formats.finite_json(text)
        if values.pop("format") != FORMAT:
            raise ValueError("another format")
        known: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
        rig = Rig(**known)
        _check(rig)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        names = ", ".join(each.name for each in fields(Rig))
        raise ThermorenderError(
            f"{path} is not a rig of format {FORMAT} ({error}), which has {names}; make one with `thermorender "
            "prepare --calibrate`"
        ) from None
    return rig


def _is_number(value: object, whole: bool = False) -> TypeGuard[float]:
    """Whether a value of a file is a number, or a whole one."""
    return isinstance(value, int if whole else (int, float)) and not isinstance(value, bool)


def _check(rig: Rig) -> None:
    """Raise ValueError if a Rig from a file has a value of a wrong kind or out of range."""
    for name, (low, high, count) in _RANGES.items():
        value = getattr(rig, name)
        numbers, whole = value if count else (value,), name.endswith("_shape")
        right = isinstance(numbers, tuple) and len(numbers) == (count or 1)
        if not right or not all(_is_number(one, whole) and low <= one <= high for one in numbers):
            what = f"{count} numbers" if count else "a number"
            raise ValueError(f"{name}={shortened(repr(value))} is not {what} of {low:g}…{high:g}")
    for name in ("errors", "frames"):
        value = getattr(rig, name)
        if not isinstance(value, dict) or not all(map(_is_number, value.values())):
            raise ValueError(f"{name}={shortened(repr(value))} is not a table of numbers")
    if not isinstance(rig.rejected, dict) or not all(isinstance(one, str) for one in rig.rejected.values()):
        raise ValueError(f"rejected={shortened(repr(rig.rejected))} is not a table of texts")
    for name in ("score", "score_unrelated"):
        value = getattr(rig, name)
        if value is not None and not _is_number(value):
            raise ValueError(f"{name}={shortened(repr(value))} is not a number")


def _corners_and_sides(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of points along a picture's border."""
    height, width = shape
    along, down = np.linspace(0.0, width, 33), np.linspace(0.0, height, 33)
    column = np.concatenate([along, along, np.zeros(33), np.full(33, float(width))])
    return column, np.concatenate([np.zeros(33), np.full(33, float(height)), down, down])


def _size(shape: tuple[int, ...]) -> str:
    """Words for the size of a picture."""
    return f"{shape[1]}×{shape[0]}"
