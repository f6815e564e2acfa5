"""Lenses that photogrammetry fitted: `cameras.json` of OpenDroneMap and OpenSfM, and camera calibrations of Metashape.

A lens of another model becomes Brown's with three radial and two tangential terms, which a `Camera` has.

- OpenSfM's lengths are shares of the longer side of the image, and its principal point counts from the middle of the
  image. Source: OpenSfM's documentation, "Geometric Models".
- Metashape's lengths are pixels, and its principal point counts from the middle. Its P1 and P2 are p2 and p1 of Brown's
  model in the order of OpenCV. Source: Agisoft Metashape User Manual, appendix "Camera models".
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Camera
from thermorender.errors import ThermorenderError
from thermorender.formats import finite_json, read_text, xml_root
from thermorender.sensor.camera import MOST_PIXELS, edge_directions

Floats = NDArray[np.float64]
# The largest difference between a lens and its Brown model [px], and the largest that goes without a note.
MOST_MISFIT_PX, _EXACT_PX = 0.25, 0.01
# Focal lengths of lenses, as shares of the longer side.
_FOCAL_SHARES = 0.05, 200.0
# No length [px] and no coefficient of a lens is larger.
_LARGEST = 1e6
# Directions up to this angle from the axis are tried [deg]; a lens that shows more has no Brown model.
_WIDEST_DEG = 80.0
# The keys that each of OpenSfM's models requires, and those that are 0 by default.
_FOCAL, _CENTRE = ("focal_x", "focal_y"), ("c_x", "c_y")
_OPENSFM = {
    "perspective": (("focal",), ("k1", "k2")),
    "simple_radial": (_FOCAL, (*_CENTRE, "k1")),
    "radial": (_FOCAL, (*_CENTRE, "k1", "k2")),
    "brown": (_FOCAL, (*_CENTRE, "k1", "k2", "k3", "p1", "p2")),
    "fisheye": (("focal",), ("k1", "k2")),
    "fisheye_opencv": (_FOCAL, (*_CENTRE, "k1", "k2", "k3", "k4")),
}
_METASHAPE = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


@dataclass(frozen=True)
class Lens:
    """The geometry of a lens, without its blur."""

    # width, height: Size of the image that it was fitted to [px]
    width: int
    height: int
    focal_px: float
    principal_offset_px: tuple[float, float]  # (2,) floats as in `Camera`
    # (5,) floats as in `Camera`; None if the file does not state it
    distortion: tuple[float, float, float, float, float] | None
    misfit_px: float = 0.0  # Largest difference in the image from the model that the file states
    source: str = "lens"  # Where it comes from, for notes and errors

    def applied(self, camera: Camera) -> tuple[Camera, str]:
        """Return (camera with this lens, a sentence that says so)."""
        if self.distortion is None:
            raise ThermorenderError(
                f"{self.source} states a focal length of {self.focal_px:.1f} pixels without the distortion; give "
                "cameras.json of the same project as lens, or the camera that took the frames"
            )
        if self.width * camera.height != self.height * camera.width:
            raise ThermorenderError(
                f"{self.source} is of {self.width}×{self.height} pixels and camera {camera.name} has "
                f"{camera.width}×{camera.height}; give the lens of the thermal camera"
            )
        low, high = (share * max(self.width, self.height) for share in _FOCAL_SHARES)
        if not low <= self.focal_px <= high or any(
            abs(offset) > 0.5 * side
            for offset, side in zip(self.principal_offset_px, (self.width, self.height), strict=True)
        ):
            raise ThermorenderError(
                f"{self.source} has a focal length of {self.focal_px:.6g} pixels and a principal point "
                f"{self.principal_offset_px[0]:.6g}, {self.principal_offset_px[1]:.6g} pixels from the middle of "
                f"{self.width}×{self.height} pixels; give {low:g} to {high:g} pixels and a point inside the image"
            )
        scale = camera.width / self.width
        x, y = (scale * value for value in self.principal_offset_px)
        changed = replace(
            camera, focal_length_mm=scale * self.focal_px * camera.pixel_pitch_um * 1e-3,
            principal_offset_px=(x, y), distortion=self.distortion,
        )  # fmt: skip
        try:
            edge_directions(changed)
        except ThermorenderError as error:
            raise ThermorenderError(f"{self.source}: {error}") from None
        misfit = scale * self.misfit_px
        rest = f", with Brown's model to {misfit:.2f} pixels" if misfit > _EXACT_PX else ""
        return changed, (
            f"the lens is that of {self.source}: {scale * self.focal_px:.1f} pixels of focal length, principal point "
            f"({x:+.1f}, {y:+.1f}) pixels from the middle{rest}"
        )


def read_lens(path: Path) -> Lens:
    """Return the Lens of `cameras.json` of OpenDroneMap or OpenSfM, or of Metashape's calibration as XML."""
    if path.suffix.lower() == ".xml":
        return _metashape(path)
    written = read_text(path, "JSON")
    try:
        cameras = finite_json(written)
    except ValueError as error:
        raise ThermorenderError(f"{path} is not JSON: {error}; give cameras.json of OpenDroneMap") from None
    if not isinstance(cameras, dict) or not cameras or not all(isinstance(each, dict) for each in cameras.values()):
        raise ThermorenderError(
            f"{path} does not state cameras by name; give cameras.json of OpenDroneMap, camera_models.json of OpenSfM "
            "or a calibration of Metashape as .xml"
        )
    lenses = {replace(opensfm_lens(each, f"{path}, camera {name!r}"), source="") for name, each in cameras.items()}
    if len(lenses) > 1:
        raise ThermorenderError(
            f"{path} states {len(lenses)} different lenses: {', '.join(map(repr, cameras))}; leave only that of the "
            "thermal camera in it"
        )
    return replace(lenses.pop(), source=str(path))


def opensfm_lens(camera: Mapping[str, Any], source: str) -> Lens:
    """Return the Lens of a camera model of OpenSfM, a table of its JSON."""
    kind = camera.get("projection_type")
    if not isinstance(kind, str) or kind not in _OPENSFM:
        raise ThermorenderError(
            f"{source}: projection_type={kind!r} is not read; compute the poses with one of {', '.join(_OPENSFM)}"
        )
    required, optional = _OPENSFM[kind]
    known = {"projection_type", "width", "height", *required, *optional}
    # OpenSfM also writes what it began from.
    unknown = [name for name in camera if name not in known and not name.endswith("_prior")]
    if unknown:
        raise ThermorenderError(f"{source}: {unknown[0]!r} is not a key of the model {kind}; correct or remove it")
    width, height = (_count(camera.get(name), name, source) for name in ("width", "height"))
    lengths = [_value(camera.get(name), name, source) for name in required]
    value = {name: _value(camera.get(name, 0.0), name, source) for name in optional}
    longer = max(width, height)
    focal = longer * np.array([lengths[0], lengths[-1]])
    centre = longer * np.array([value.get(name, 0.0) for name in _CENTRE])
    k = [value.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")]
    if min(focal) <= 0.0:
        raise ThermorenderError(f"{source}: {required[0]}={lengths[0]:g} is not allowed; give a length above 0")
    if "fisheye" in kind:
        return _fitted(lambda slope: focal * _equidistant(slope, k) + centre, (width, height), source)
    brown = (k[0], k[1], value.get("p1", 0.0), value.get("p2", 0.0), k[2])
    if focal[0] == focal[1]:
        return Lens(width, height, float(focal[0]), (float(centre[0]), float(centre[1])), brown, 0.0, source)
    return _fitted(lambda slope: focal * _brown(slope, brown) + centre, (width, height), source)


def _metashape(path: Path) -> Lens:
    kind, stated = _calibration(path)
    source = str(path)
    width, height = (_count(stated.get(name), name, source) for name in ("width", "height"))
    focal = _value(stated["f"], "f", source)
    cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4 = (_value(stated.get(n, "0"), n, source) for n in _METASHAPE)
    if focal <= 0.0 or p3 or p4:
        what = f"f={focal:g}" if focal <= 0.0 else f"p3={p3:g}, p4={p4:g}"
        raise ThermorenderError(f"{path}: {what} is not allowed; calibrate with a positive f and without p3 and p4")
    brown = (k1, k2, p2, p1, k3)
    if kind == "frame" and not (b1 or b2 or k4):
        return Lens(width, height, focal, (cx, cy), brown, 0.0, source)

    def model(slope: Floats) -> Floats:
        point = _equidistant(slope, ()) if kind == "fisheye" else slope
        x, y = _brown(point, brown, k4).T
        return np.stack([cx + (focal + b1) * x + b2 * y, cy + focal * y], axis=-1)

    return _fitted(model, (width, height), source)


def _calibration(path: Path) -> tuple[str, dict[str, str | None]]:
    """(projection, {tag: text}) of Metashape's calibration of a frame or fisheye camera."""
    root = xml_root(path, "XML", "give Metashape's calibration")
    if root.tag != "calibration" or root.find("f") is None:
        raise ThermorenderError(
            f"{path} is not a camera calibration of Metashape with a focal length f; save one in Metashape's Camera "
            "Calibration as Agisoft camera calibration"
        )
    stated = {each.tag: each.text for each in root}
    kind = (stated.get("projection") or "").strip()
    unknown = [name for name in stated if name not in {"projection", "width", "height", "f", "date", *_METASHAPE}]
    if kind not in ("frame", "fisheye") or unknown:
        what = f"{unknown[0]!r}" if unknown else f"projection={kind!r}"
        raise ThermorenderError(f"{path}: {what} is not read; save the calibration of a frame or fisheye camera")
    return kind, stated


def _brown(slope: Floats, terms: tuple[float, ...], k4: float = 0.0) -> Floats:
    """Brown's model of slopes, (N, 2)."""
    k1, k2, p1, p2, k3 = terms
    x, y = slope.T
    r2 = x**2 + y**2
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return np.stack([x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2),
                     y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y], axis=-1)  # fmt: skip


def _equidistant(slope: Floats, k: list[float] | tuple[()]) -> Floats:
    """Slopes, (N, 2), as angles θ (1 + k₁ θ² + k₂ θ⁴ + …) in the same azimuth."""
    radius = np.linalg.norm(slope, axis=-1, keepdims=True)
    angle = np.arctan(radius)
    distorted = angle * (1.0 + sum(each * angle ** (2 * power) for power, each in enumerate(k, 1)))
    return np.asarray(slope * np.divide(distorted, radius, out=np.ones_like(radius), where=radius > 0.0))


def _fitted(model: Callable[[Floats], Floats], size: tuple[int, int], source: str) -> Lens:
    """The Lens whose Brown model differs least, in the image, from a model of slopes → pixels from the middle."""
    angle = np.tan(np.radians(np.linspace(0.0, _WIDEST_DEG, 641)))
    azimuth = np.radians(np.arange(0.0, 360.0, 5.0))[:, None, None]
    slopes = angle[None, :, None] * np.concatenate([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    with np.errstate(all="ignore"):
        points = model(slopes.reshape(-1, 2)).reshape(slopes.shape)
    # Beyond the first point outside the image, a model may fold back into it.
    inside = np.logical_and.accumulate((np.abs(points) <= 0.5 * np.array(size)).all(axis=-1), axis=1)
    if inside[:, -1].any() or not inside[:, 1].all():
        raise ThermorenderError(
            f"{source}: this lens shows more than {_WIDEST_DEG:g}° from its axis or folds the image; give frames of a "
            "narrower lens, or undistort them"
        )
    slope, point = slopes[inside], points[inside]
    x, y = slope.T
    r2 = (slope**2).sum(axis=-1)
    none, one = np.zeros_like(x), np.ones_like(x)
    # Pixels are linear in (f, f k1, f k2, f p1, f p2, f k3, cx, cy).
    across = [x, x * r2, x * r2**2, 2.0 * x * y, r2 + 2.0 * x**2, x * r2**3, one, none]
    down = [y, y * r2, y * r2**2, r2 + 2.0 * y**2, 2.0 * x * y, y * r2**3, none, one]
    columns = np.concatenate([np.stack(across, axis=-1), np.stack(down, axis=-1)])
    target = point.T.ravel()
    weight = np.linalg.norm(columns, axis=0)
    found = np.linalg.lstsq(columns / weight, target, rcond=None)[0] / weight
    misfit = float(np.abs(columns @ found - target).max())
    if misfit > MOST_MISFIT_PX:
        raise ThermorenderError(
            f"{source}: Brown's model with k1, k2, k3, p1, p2 differs from this lens by {misfit:.2g} pixels, more than "
            f"{MOST_MISFIT_PX:g}; compute the poses with that model (brown), or undistort the frames"
        )
    k1, k2, p1, p2, k3 = (float(each / found[0]) for each in found[1:6])
    return Lens(*size, float(found[0]), (float(found[6]), float(found[7])), (k1, k2, p1, p2, k3), misfit, source)


def _value(value: Any, name: str, source: str) -> float:
    try:
        number = float("nan") if value is None or isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not abs(number) <= _LARGEST:
        raise ThermorenderError(f"{source}: {name}={value!r} is not a number of a lens; give one up to {_LARGEST:g}")
    return number


def _count(value: Any, name: str, source: str) -> int:
    number = _value(value, name, source)
    if number != int(number) or not 1 <= number <= MOST_PIXELS:
        raise ThermorenderError(f"{source}: {name}={value!r} is not allowed; give pixels from 1 to {MOST_PIXELS}")
    return int(number)
