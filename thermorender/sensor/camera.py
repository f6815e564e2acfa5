"""The camera as data: detector, lens, spectral band and read-out of one model, and its pixel rays.

Models are TOML files in `cameras/`; every number there names its source or is marked as assumed. Image
coordinates are in pixels from the upper left corner of the image, so pixel (row i, column j) spans
[j, j+1] × [i, i+1] and its centre is (j + ½, i + ½).
"""

import os
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics.quanta import photon_growth
from thermorender.schema import Where, choice, flag, key, number, read, read_toml
from thermorender.units import ZERO_CELSIUS_K

# Values of the pixels of an image, (H, W), and a world_from_camera, (4, 4).
Image = NDArray[np.float32]
Pose = NDArray[np.float64]
# No thermal camera has more pixels along a side, and a frame of more does not fit into memory.
MOST_PIXELS = 16384
# Temperature for which an NETD is stated [K].
NETD_REFERENCE_K = 300.0
_share = number(0.0, 1.0, above=True)
_range_c = number(-ZERO_CELSIUS_K, 5000.0, above=True, count=2, ordered=True)
_noise_mk = number(0.0, 1e5)


@dataclass(frozen=True)
class Camera:
    """One camera model. Keys with a default describe effects; an effect without its key is absent.

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
        Share of the band radiance that the lens passes.
    band_um : (2,) floats
        Limits of the spectral band, with flat response [µm].
    netd_mk, netd_f_number : float
        Noise-equivalent temperature difference at 300 K [mK] and the f-number it is stated for: all temporal noise
        of a pixel at the image centre.
    bits : int
        Depth of a count.
    range_c : (2,) floats
        Apparent temperatures of the lowest and the highest count in high gain [°C].
    frame_rate_hz : float
    principal_offset_px : (2,) floats
        Principal point from the image centre, right and down [px].
    distortion : (5,) floats
        Brown–Conrady k1, k2, p1, p2, k3 on normalised image coordinates.
    diffraction : bool
        Whether the lens is limited by diffraction; a perfect point otherwise.
    defocus_um : float
        Distance of the detector from the focal plane [µm].
    blur_sigma_px : float
        Width of a Gaussian for all other blur of the lens [px].
    illumination_exponent : float
        n of the cosⁿ decrease of the irradiance with field angle: 4 for the natural law, 0 for none.
    vignetting : float
        Additional loss of light at the corner of the image by the rims of the lens, as a share.
    case_temperature_c, case_rise_k, case_time_constant_s : float
        Temperature of housing and lens at the start [°C], its rise as the camera runs [K], and the time constant of
        that rise [s].
    housing_residual : float
        Uncompensated share of the change, since the last flat-field correction, of the emission of housing and lens.
    narcissus_mk, narcissus_radius_px : float
        Apparent temperature of the detector's reflection, a ring [mK], and the ring's radius [px].
    shading_mk, shading_mk_per_k : float
        Smooth shading by the lens, which the shutter does not correct: apparent temperature, root mean square over
        the image, at the start [mK], and its growth per kelvin of case warming [mK/K].
    absorptance : float
        Share of the irradiance on a pixel's area that heats the pixel.
    time_constant_ms : float
        Thermal time constant of a pixel [ms].
    row_time_us : float
        Time from the read-out of a row to that of the next [µs]; 0: all at once.
    sigma_t_mk, sigma_tv_mk, sigma_th_mk : float
        Noise that changes with each frame: common to the frame, to a row, to a column. Part of the NETD, stated for
        the same conditions [mK].
    sigma_v_mk, sigma_h_mk, sigma_vh_mk : float
        Noise that is constant between flat-field corrections: of rows, of columns, of single pixels; stated for the
        conditions of the NETD [mK].
    drift_mk_per_k : float
        Growth of the fixed pattern per kelvin of case drift since the last flat-field correction, stated for the
        conditions of the NETD [mK/K].
    responsivity_percent : (2,) floats
        Error of the pixels' gain correction: of single pixels, and of a smooth field over the image, root mean
        square [%]. It acts on the difference between the scene and the shutter, which has the case's temperature.
    flicker_mk, scale_drift_mk : float
        1/f noise of single pixels, and of the whole scale, since the last flat-field correction: standard deviation
        of each octave between holds of 1 s and of 512 s, stated for the conditions of the NETD. Not part of it [mK].
    bad_pixels : float
        Share of the pixels that are dead or hot and are replaced by their neighbours.
    blinking_pixels, blinking_mk, blinking_s : float
        Share of the pixels that jump between two levels, the distance of the levels, stated for the conditions of
        the NETD [mK], and the mean time at one level [s]. Not part of `bad_pixels`.
    ffc_interval_s, ffc_duration_s : float
        Time between flat-field corrections, 0: none after the start, and how long the image is frozen [s].
    gain : {"high", "low"}
        The range in use.
    low_gain_range_c : (2,) floats
        Apparent temperatures of the lowest and the highest count in low gain [°C].
    low_gain_netd_mk : float
        NETD in low gain [mK]; 0: as in high gain.
    tlinear_mk : float
        Apparent temperature of one count where counts are linear in temperature, from 0 K: 40 or 400 mK;
        0: linear in irradiance.
    agc_tails_percent : (2,) floats
        Shares of the darkest and of the brightest pixels that the display's gain control lets saturate [%].
    visible_width : int
        Width of the image of the visible camera beside this one [px]; 0: there is none.
    visible_field_of_view_deg : (2,) floats
        Horizontal and vertical field of view of the visible camera, which has square pixels [deg].
    well_electrons : float
        Electrons that a pixel of a photon detector holds; 0: a microbolometer. A photon detector has no time constant,
        no rolling rows and no low gain. Its NETD is stated for a well half full at 300 K, whatever `netd_f_number`.
    integration_ms : float
        Time over which a photon detector collects light, up to the frame's time [ms].
    quantum_efficiency : float
        Electrons of a photon detector per photon on its area.
    """

    name: str
    width: int = key(number(1, MOST_PIXELS, whole=True, unit="pixels"))
    height: int = key(number(1, MOST_PIXELS, whole=True, unit="pixels"))
    pixel_pitch_um: float = key(number(0.5, 1000.0))
    focal_length_mm: float = key(number(0.01, 1e5))
    f_number: float = key(number(0.2, 100.0))
    lens_transmittance: float = key(_share)
    band_um: tuple[float, float] = key(number(0.0, 1000.0, above=True, count=2, ordered=True))
    netd_mk: float = key(number(0.0, 1e5, above=True))
    netd_f_number: float = key(number(0.2, 100.0))
    bits: int = key(number(2, 16, whole=True))
    range_c: tuple[float, float] = key(_range_c)
    frame_rate_hz: float = key(number(0.0, 1e5, above=True))
    principal_offset_px: tuple[float, float] = key(number(-MOST_PIXELS, MOST_PIXELS, count=2), (0.0, 0.0))
    distortion: tuple[float, ...] = key(number(count=5), (0.0, 0.0, 0.0, 0.0, 0.0))
    diffraction: bool = key(flag, False)
    defocus_um: float = key(number(-1000.0, 1000.0), 0.0)
    blur_sigma_px: float = key(number(0.0, 5.0), 0.0)
    illumination_exponent: float = key(number(0.0, 8.0), 0.0)
    vignetting: float = key(number(0.0, 0.9), 0.0)
    case_temperature_c: float = key(number(-100.0, 150.0), 25.0)
    case_rise_k: float = key(number(-100.0, 100.0), 0.0)
    case_time_constant_s: float = key(number(1.0, 1e6), 600.0)
    housing_residual: float = key(number(0.0, 1.0), 0.0)
    narcissus_mk: float = key(number(-1e5, 1e5), 0.0)
    narcissus_radius_px: float = key(number(1.0, MOST_PIXELS), 100.0)
    shading_mk: float = key(_noise_mk, 0.0)
    shading_mk_per_k: float = key(_noise_mk, 0.0)
    absorptance: float = key(_share, 1.0)
    time_constant_ms: float = key(number(0.0, 10_000.0), 0.0)
    row_time_us: float = key(number(0.0, 1e4), 0.0)
    sigma_t_mk: float = key(_noise_mk, 0.0)
    sigma_tv_mk: float = key(_noise_mk, 0.0)
    sigma_th_mk: float = key(_noise_mk, 0.0)
    sigma_v_mk: float = key(_noise_mk, 0.0)
    sigma_h_mk: float = key(_noise_mk, 0.0)
    sigma_vh_mk: float = key(_noise_mk, 0.0)
    drift_mk_per_k: float = key(_noise_mk, 0.0)
    responsivity_percent: tuple[float, float] = key(number(0.0, 20.0, count=2), (0.0, 0.0))
    flicker_mk: float = key(_noise_mk, 0.0)
    scale_drift_mk: float = key(_noise_mk, 0.0)
    bad_pixels: float = key(number(0.0, 0.05), 0.0)
    blinking_pixels: float = key(number(0.0, 0.05), 0.0)
    blinking_mk: float = key(_noise_mk, 0.0)
    blinking_s: float = key(number(0.01, 1e6), 10.0)
    ffc_interval_s: float = key(number(0.0, 1e6), 0.0)
    ffc_duration_s: float = key(number(0.0, 60.0), 0.0)
    gain: str = key(choice("high", "low"), "high")
    low_gain_range_c: tuple[float, float] = key(_range_c, (-40.0, 550.0))
    low_gain_netd_mk: float = key(_noise_mk, 0.0)
    tlinear_mk: float = key(choice(0.0, 40.0, 400.0), 0.0)
    agc_tails_percent: tuple[float, float] = key(number(0.0, 49.0, count=2), (0.5, 0.5))
    visible_width: int = key(number(0, MOST_PIXELS, whole=True, unit="pixels"), 0)
    visible_field_of_view_deg: tuple[float, float] = key(number(1.0, 170.0, count=2), (57.0, 43.0))
    well_electrons: float = key(number(0.0, 1e12), 0.0)
    integration_ms: float = key(number(0.0, 10_000.0), 0.0)
    quantum_efficiency: float = key(_share, 1.0)

    def check(self, where: Where, given: dict[str, Any]) -> None:
        """Refuse noise of frames, rows and columns that exceeds the NETD, and distortion that folds the image."""
        temporal = ("sigma_t_mk", "sigma_tv_mk", "sigma_th_mk")
        if sum(getattr(self, name) ** 2 for name in temporal) >= self.gain_netd_mk**2:
            name = "netd_mk" if self.gain_netd_mk == self.netd_mk else "low_gain_netd_mk"
            raise where.error(
                f"{', '.join(temporal)} leave nothing of {name}={self.gain_netd_mk:g}, which contains them; lower them"
            )
        self._check_photons(where)
        # Checked here, since otherwise only the first frame would report it, after the scene is baked.
        edge_directions(self)

    def _check_photons(self, where: Where) -> None:
        """Refuse keys that a microbolometer or a photon detector does not have, and an NETD below photon noise."""
        if not self.well_electrons:
            if self.integration_ms or self.quantum_efficiency != 1.0:
                name = "integration_ms" if self.integration_ms else "quantum_efficiency"
                raise where.error(
                    f"{name}={getattr(self, name):g} is of a photon detector; give well_electrons too, or leave it out"
                )
            return
        for name, absent in (("time_constant_ms", 0.0), ("row_time_us", 0.0), ("gain", "high")):
            if getattr(self, name) != absent:
                raise where.error(
                    f"{name}={getattr(self, name)!r} is of a microbolometer; leave it out beside well_electrons"
                )
        longest = 1e3 / self.frame_rate_hz
        if not 0.0 < self.integration_ms <= longest:
            raise where.error(
                f"integration_ms={self.integration_ms:g} is not allowed beside well_electrons; give a number above 0 "
                f"and up to {longest:.4g} ms, a frame of frame_rate_hz={self.frame_rate_hz:g}"
            )
        if self.netd_mk < self.least_netd_mk:
            raise where.error(
                f"netd_mk={self.netd_mk:g} is below the photon noise of a half-full well; give at least "
                f"{self.least_netd_mk:.4g} mK, or more well_electrons"
            )

    def __repr__(self) -> str:
        across, along = self.field_of_view_deg
        return (
            f"Camera({self.name!r}, {self.width}×{self.height}, {across:.1f}° × {along:.1f}°, "
            f"{self.focal_length_mm:g} mm f/{self.f_number:g}, {self.band_um[0]:g}–{self.band_um[1]:g} µm, "
            f"NETD {self.gain_netd_mk:g} mK)"
        )

    def __str__(self) -> str:
        across, along = self.field_of_view_deg
        low, high = self.range_c
        noise = f"NETD {self.gain_netd_mk:g} mK at f/{self.netd_f_number:g} in {self.gain} gain"
        detector = (
            f"time constant {self.time_constant_ms:g} ms, rows {self.row_time_us:g} µs apart, "
            f"shutter every {self.ffc_interval_s:g} s (0: never)"
        )
        if self.well_electrons:
            noise = f"NETD {self.gain_netd_mk:g} mK at 300 K with a half-full well"
            detector = f"photons of {self.integration_ms:g} ms, a well of {self.well_electrons:g} electrons"
        lines = [
            f"{self.name}: {self.width}×{self.height} pixels of {self.pixel_pitch_um:g} µm, "
            f"{self.frame_rate_hz:g} frames per second",
            f"  lens          {self.focal_length_mm:g} mm f/{self.f_number:g}, {across:.1f}° × {along:.1f}°, "
            f"{self.pixel_pitch_um / self.focal_length_mm:.2f} mrad per pixel",
            f"  band          {self.band_um[0]:g}–{self.band_um[1]:g} µm",
            f"  noise         {noise}",
            f"  counts        {self.bits} bits over {low:g}…{high:g} °C of apparent temperature in high gain",
            f"  detector      {detector}",
            f"  photograph    {self._visible_words()}",
        ]
        return "\n".join(lines)

    def _visible_words(self) -> str:
        if not self.visible_width:
            return "no visible camera beside it; visible_width and visible_field_of_view_deg add one"
        across, along = self.visible_field_of_view_deg
        return f"{self.visible_width} pixels wide, {across:g}° × {along:g}°, on the same axis"

    @property
    def visible_camera(self) -> "Camera | None":
        """The visible camera beside this one, a Camera on the same axis and without distortion; None without one."""
        if not self.visible_width:
            return None
        across, along = np.tan(np.radians(np.array(self.visible_field_of_view_deg) / 2.0))
        rows = round(self.visible_width * along / across)
        focal_mm = self.visible_width / (2.0 * across) * self.pixel_pitch_um * 1e-3
        return replace(
            self, name=f"{self.name}-visible", width=self.visible_width, height=min(max(rows, 1), MOST_PIXELS),
            focal_length_mm=float(focal_mm), principal_offset_px=(0.0, 0.0), distortion=(0.0,) * 5, visible_width=0,
        )  # fmt: skip

    def part(self, rows: slice, columns: slice) -> "Camera":
        """Return the Camera of a part of the image, given by slices with both ends, on the same axis."""
        width, height = columns.stop - columns.start, rows.stop - rows.start
        x, y = self._principal_point - (columns.start + 0.5 * width, rows.start + 0.5 * height)
        return replace(self, width=width, height=height, principal_offset_px=(float(x), float(y)))

    def coarser(self, by: int) -> "Camera":
        """Return the Camera whose pixels are `by` times as wide; the image keeps its upper left corner."""
        width, height = (max(count // by, 1) for count in (self.width, self.height))
        x, y = self._principal_point / by - (0.5 * width, 0.5 * height)
        pitch_um, offset, well = by * self.pixel_pitch_um, (float(x), float(y)), by**2 * self.well_electrons
        return replace(
            self, width=width, height=height, pixel_pitch_um=pitch_um, principal_offset_px=offset, well_electrons=well
        )

    @property
    def half_well_per_mk(self) -> float:
        """Growth of the electrons in a half-full well of a photon detector, at 300 K [mK⁻¹]."""
        return 0.5e-3 * self.well_electrons * photon_growth(NETD_REFERENCE_K, *self.band_um)

    @property
    def least_netd_mk(self) -> float:
        """NETD of a photon detector without read noise: of photons, frames, rows and columns [mK]."""
        common = self.sigma_t_mk**2 + self.sigma_tv_mk**2 + self.sigma_th_mk**2
        return float(np.sqrt(0.5 * self.well_electrons / self.half_well_per_mk**2 + common))

    @property
    def absent(self) -> tuple[str, ...]:
        """Keys of a photon detector that a microbolometer does not have; fingerprints and files leave them out."""
        return () if self.well_electrons else ("well_electrons", "integration_ms", "quantum_efficiency")

    @property
    def count_range_k(self) -> tuple[float, float]:
        """Apparent temperatures of the lowest and the highest count of the gain in use [K]."""
        low, high = self.low_gain_range_c if self.gain == "low" else self.range_c
        return low + ZERO_CELSIUS_K, high + ZERO_CELSIUS_K

    @property
    def gain_netd_mk(self) -> float:
        """NETD of the gain in use [mK], at `netd_f_number` and 300 K."""
        return self.low_gain_netd_mk if self.gain == "low" and self.low_gain_netd_mk else self.netd_mk

    @property
    def time_constant_s(self) -> float:
        """Thermal time constant of a pixel [s]."""
        return self.time_constant_ms * 1e-3

    @property
    def memory_s(self) -> float:
        """Integration time of a photon detector, time constant of a microbolometer [s]."""
        return self.integration_ms * 1e-3 if self.well_electrons else self.time_constant_s

    @property
    def focal_length_px(self) -> float:
        """Focal length in pixels."""
        return self.focal_length_mm * 1e3 / self.pixel_pitch_um

    @property
    def field_of_view_deg(self) -> tuple[float, float]:
        """Undistorted horizontal and vertical field of view [deg]."""
        sides = self.width, self.height
        across, down = (float(np.degrees(2 * np.arctan(n / 2 / self.focal_length_px))) for n in sides)
        return across, down

    @cached_property
    def _principal_point(self) -> NDArray[np.float64]:
        return np.array([self.width / 2, self.height / 2]) + self.principal_offset_px

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return image coordinates, (..., 2) [px], of points in camera axes; NaN behind the camera.

        Parameters
        ----------
        points : (..., 3) array
            x right, y down, z forward [m].
        """
        points = np.asarray(points, dtype=np.float64)
        depth = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        return self._distort(points[..., :2] / depth) * self.focal_length_px + self._principal_point

    def directions(self, pixel: ArrayLike) -> NDArray[np.float64]:
        """Return the directions imaged at `pixel`, (..., 2), as x/z and y/z in camera axes.

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
        Newton's method on the Brown–Conrady model (Brown 1971), to 1e-12 of the focal length. OpenCV's
        `undistortPoints` iterates a fixed point: five rounds leave 0.002 pixels at the corner of a strongly
        distorted image, and at a fold of the model it returns a wrong direction instead of an error.
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
        # Beyond a fold the model has solutions too, but they invert the image.
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

    def _distort(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
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


def camera_names() -> list[str]:
    """Return the names of the shipped models, in order."""
    return sorted(item.stem for item in (Path(__file__).parent / "cameras").glob("*.toml"))


def model_path(name: str | PathLike[str], where: str = "camera model") -> Path:
    """Return the TOML file of a shipped model, or the path itself if it ends in .toml."""
    path = Path(name) if str(name).endswith(".toml") else Path(__file__).parent / "cameras" / f"{name}.toml"
    if not os.path.isfile(path):
        known = ", ".join(camera_names())
        raise ThermorenderError(f"{where} {str(name)!r} is unknown; give one of {known} or a .toml file")
    return path


def load_camera(name: str | PathLike[str], where: str = "camera model") -> Camera:
    """Return the Camera of a shipped model, or of a TOML file of the same form given by path.

    Parameters
    ----------
    name : str or path
    where : str
        Where the user gave the name, for error messages.

    Raises
    ------
    ThermorenderError
        An unknown model or key, a missing key, or a value out of range; the message names it.
    """
    path = model_path(name, where)
    return read(Camera, read_toml(path), Where(path), name=path.stem)


def edge_directions(camera: Camera) -> NDArray[np.float64]:
    """Return the directions along the border of the image, (N, 2); raise if the distortion folds the image."""
    # Newton's steps diverge at a fold before they are refused.
    with np.errstate(all="ignore"):
        return camera.directions(_image_edge(camera.width, camera.height))


def _image_edge(width: int, height: int) -> NDArray[np.float64]:
    """Image coordinates along the border of an image, (N, 2) [px]."""
    across, along = np.linspace(0.0, width, 65), np.linspace(0.0, height, 65)
    sides: list[tuple[ArrayLike, ArrayLike]]
    sides = [(across, 0.0), (across, float(height)), (0.0, along), (float(width), along)]
    return np.concatenate([np.stack(np.broadcast_arrays(x, y), axis=-1) for x, y in sides])
