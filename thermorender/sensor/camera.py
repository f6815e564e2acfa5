"""The camera as data: detector, lens, spectral band and read-out numbers of one model, and its pixel rays.

Models are TOML files in `cameras/`; every number there names its source or is marked as assumed. Image
coordinates are in pixels from the upper left corner of the image, so pixel (row i, column j) spans
[j, j+1] × [i, i+1] and its centre is (j + ½, i + ½).
"""

import difflib
import sys
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.units import ZERO_CELSIUS_K

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# More along a side is no microbolometer, and a frame of it fits no memory.
MOST_PIXELS = 16384


@dataclass(frozen=True)
class Camera:
    """One camera model.

    Attributes
    ----------
    name : str
    width, height : int
        Pixels.
    pixel_pitch_um, focal_length_mm : float
        Detector pitch [µm] and focal length [mm].
    f_number : float
        Ratio of focal length to aperture.
    lens_transmittance : float
        Share of the band radiance the lens passes.
    band_um : (2,) floats
        Spectral band, taken as flat [µm].
    netd_mk, netd_f_number : float
        Noise-equivalent temperature difference at 300 K [mK] and the f-number it is stated for.
    bits : int
        Depth of a count.
    range_c : (2,) floats
        Apparent temperatures of the lowest and the highest count [°C].
    frame_rate_hz : float
    principal_offset_px : (2,) floats
        Principal point from the image centre, right and down [px].
    distortion : (5,) floats
        Brown–Conrady k1, k2, p1, p2, k3 on normalised image coordinates.
    """

    name: str
    width: int
    height: int
    pixel_pitch_um: float
    focal_length_mm: float
    f_number: float
    lens_transmittance: float
    band_um: tuple
    netd_mk: float
    netd_f_number: float
    bits: int
    range_c: tuple
    frame_rate_hz: float
    principal_offset_px: tuple = field(default=(0.0, 0.0))
    distortion: tuple = field(default=(0.0, 0.0, 0.0, 0.0, 0.0))

    @property
    def focal_length_px(self):
        """Focal length in pixels."""
        return self.focal_length_mm * 1e3 / self.pixel_pitch_um

    @property
    def field_of_view_deg(self):
        """Undistorted horizontal and vertical field of view [deg]."""
        return tuple(float(np.degrees(2 * np.arctan(n / 2 / self.focal_length_px))) for n in (self.width, self.height))

    @cached_property
    def _principal_point(self):
        return np.array([self.width / 2, self.height / 2]) + self.principal_offset_px

    def project(self, points):
        """Return image coordinates, (..., 2) [px], of points in camera axes; NaN behind the camera.

        Parameters
        ----------
        points : (..., 3) array
            x right, y down, z forward [m].
        """
        points = np.asarray(points, dtype=np.float64)
        depth = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        return self._distort(points[..., :2] / depth) * self.focal_length_px + self._principal_point

    def directions(self, pixel):
        """Return the directions that image in `pixel`, (..., 2), as x/z and y/z in camera axes.

        Parameters
        ----------
        pixel : (..., 2) array
            Image coordinates [px].

        Raises
        ------
        ThermorenderError
            The distortion cannot be inverted there (its coefficients fold the image).

        Notes
        -----
        Newton's method on the Brown–Conrady model (Brown 1971), to 1e-12 of the focal length.
        """
        target = (np.asarray(pixel, dtype=np.float64) - self._principal_point) / self.focal_length_px
        if not any(self.distortion):
            return target
        point = target.copy()
        step = 1e-7
        for _ in range(30):
            value = self._distort(point)
            error = value - target
            if np.abs(error).max() < 1e-12:
                break
            along_x = (self._distort(point + [step, 0.0]) - value) / step
            along_y = (self._distort(point + [0.0, step]) - value) / step
            determinant = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
            point[..., 0] -= (along_y[..., 1] * error[..., 0] - along_y[..., 0] * error[..., 1]) / determinant
            point[..., 1] -= (along_x[..., 0] * error[..., 1] - along_x[..., 1] * error[..., 0]) / determinant
        # A fold of the model has solutions too, but on its far side: there it turns the image over.
        k1, k2, _, _, k3 = self.distortion
        r2 = (point**2).sum(axis=-1)
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        along = 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))
        inverted = np.abs(self._distort(point) - target).max() < 1e-9
        if not (inverted and radial.min() > 0.0 and along.min() > 0.0):
            raise ThermorenderError(
                f"camera {self.name}: distortion={list(self.distortion)} folds the image before its edge; "
                "check k1, k2, k3"
            )
        return point

    def _distort(self, point):
        k1, k2, p1, p2, k3 = self.distortion
        x, y = point[..., 0], point[..., 1]
        r2 = x**2 + y**2
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2),
                y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )


def load_camera(name, where="camera model"):
    """Return the Camera of a shipped model, or of a TOML file of the same form given by path.

    Parameters
    ----------
    name : str or path
    where : str
        What the name is called where the user wrote it, for messages.

    Raises
    ------
    ThermorenderError
        An unknown model or key, a missing key, or a value out of range; the message names it.
    """
    path = Path(name) if str(name).endswith(".toml") else Path(__file__).parent / "cameras" / f"{name}.toml"
    if not path.is_file():
        known = sorted(item.stem for item in (Path(__file__).parent / "cameras").glob("*.toml"))
        raise ThermorenderError(f"{where} {str(name)!r} is unknown; give one of {', '.join(known)} or a .toml file")
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ThermorenderError(f"{path} is not valid TOML: {error}") from None
    known = {item.name: item for item in fields(Camera) if item.name != "name"}
    for key in raw:
        if key not in known:
            close = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {close[0]!r}? " if close else ""
            raise ThermorenderError(f"{path}: unknown key {key!r}; {hint}allowed are {', '.join(known)}")
    values = {"name": path.stem}
    lengths = {"band_um": 2, "range_c": 2, "principal_offset_px": 2, "distortion": 5}
    for key, item in known.items():
        if key not in raw:
            if isinstance(item.default, tuple):
                continue
            raise ThermorenderError(f"{path}: key {key!r} is missing; add it")
        value = raw[key]
        numbers = value if key in lengths else [value]
        if (
            not isinstance(numbers, list)
            or len(numbers) != lengths.get(key, 1)
            or not all(isinstance(n, (int, float)) and not isinstance(n, bool) and abs(n) < 1e300 for n in numbers)
        ):
            raise ThermorenderError(
                f"{path}: {key}={value!r} is not allowed; give {lengths.get(key, 'a')} finite number(s)"
            )
        if key not in lengths and value <= 0:
            raise ThermorenderError(f"{path}: {key}={value!r} is not allowed; give a number above 0")
        if key in ("width", "height", "bits") and value != int(value):
            raise ThermorenderError(f"{path}: {key}={value!r} is not allowed; give a whole number")
        if key in ("width", "height") and value > MOST_PIXELS:
            raise ThermorenderError(f"{path}: {key}={value!r} is not allowed; give up to {MOST_PIXELS} pixels")
        kind = int if key in ("width", "height", "bits") else float
        values[key] = tuple(map(float, value)) if key in lengths else kind(value)
    for key in ("band_um", "range_c"):
        if not values[key][0] < values[key][1]:
            raise ThermorenderError(f"{path}: {key}={list(values[key])} is not allowed; give the lower value first")
    if not values["band_um"][0] > 0.0:
        raise ThermorenderError(
            f"{path}: band_um={list(values['band_um'])} is not allowed; give wavelengths above 0 µm"
        )
    if not values["range_c"][0] > -ZERO_CELSIUS_K:
        raise ThermorenderError(
            f"{path}: range_c={list(values['range_c'])} is not allowed; give °C above absolute zero"
        )
    if values["lens_transmittance"] > 1.0:
        raise ThermorenderError(
            f"{path}: lens_transmittance={values['lens_transmittance']:g} is not allowed; give a share up to 1"
        )
    if not 2 <= values["bits"] <= 16:
        raise ThermorenderError(f"{path}: bits={values['bits']} is not allowed; give 2…16")
    camera = Camera(**values)
    # A folding distortion would otherwise show with the first frame only, after the scene is baked. Where it
    # folds, Newton's steps run off to infinity before they are refused.
    with np.errstate(all="ignore"):
        camera.directions(_image_edge(camera.width, camera.height))
    return camera


def _image_edge(width, height):
    """Image coordinates along the border of an image, (N, 2) [px]."""
    across, along = np.linspace(0.0, width, 65), np.linspace(0.0, height, 65)
    sides = [(across, 0.0), (across, float(height)), (0.0, along), (float(width), along)]
    return np.concatenate([np.stack(np.broadcast_arrays(x, y), axis=-1) for x, y in sides])
