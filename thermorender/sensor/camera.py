"""The camera as data: detector, lens, spectral band and read-out numbers of one model, and its pixel rays.

Models are TOML files in `cameras/`; every number there names its source or is marked as assumed. Image
coordinates are in pixels from the upper left corner of the image, so pixel (row i, column j) spans
[j, j+1] × [i, i+1] and its centre is (j + ½, i + ½).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.schema import Where, choice, flag, key, number, read, read_toml
from thermorender.units import ZERO_CELSIUS_K

# More along a side is no microbolometer, and a frame of it fits no memory.
MOST_PIXELS = 16384
_share = number(0.0, 1.0, above=True)
_range_c = number(-ZERO_CELSIUS_K, 5000.0, above=True, count=2, ordered=True)
_noise_mk = number(0.0, 1e5)


@dataclass(frozen=True)
class Camera:
    """One camera model. Keys with a default describe effects; left out, the effect is absent.

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
        Noise-equivalent temperature difference at 300 K [mK] and the f-number it is stated for: all temporal noise
        of a pixel in the middle of the image.
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
        Width of a Gaussian for what the lens blurs besides [px].
    illumination_exponent : float
        n of the cosⁿ fall of the irradiance with field angle: 4 for the natural law, 0 for none.
    vignetting : float
        Share of the light that the lens's rims take away at the corner of the image, besides that.
    case_temperature_c, case_rise_k, case_time_constant_s : float
        Temperature of housing and lens at the start [°C], how much it rises as the camera runs [K], and how fast [s].
    housing_residual : float
        Share of a change of the housing's and lens's own emission since the last flat-field correction that the
        camera does not compensate.
    narcissus_mk, narcissus_radius_px : float
        Apparent temperature of the ring that is the detector's own reflection [mK], and the ring's radius [px].
    shading_mk, shading_mk_per_k : float
        Smooth shading that the shutter does not see, as the lens stands before it: apparent temperature, root mean
        square over the image, at the start [mK], and its growth by each kelvin that the case warms [mK/K].
    absorptance : float
        Share of the irradiance on a pixel's area that heats the pixel.
    time_constant_ms : float
        Thermal time constant of a pixel [ms].
    row_time_us : float
        Time from the read-out of a row to that of the next [µs]; 0: all at once.
    sigma_t_mk, sigma_tv_mk, sigma_th_mk : float
        Noise that changes with each frame: common to the frame, to a row, to a column. Part of the NETD; stated as
        it is [mK].
    sigma_v_mk, sigma_h_mk, sigma_vh_mk : float
        Noise that stays from one flat-field correction to the next: of rows, of columns, of single pixels; stated
        as the NETD is [mK].
    drift_mk_per_k : float
        Growth of the fixed pattern by each kelvin that the case has drifted since the last flat-field correction,
        stated as the NETD is [mK/K].
    responsivity_percent : (2,) floats
        How far the gains that pixels are corrected with lie off: of single pixels, and of a smooth field over the
        image, root mean square [%]. It shows by the scene's difference from the shutter, which is as warm as the case.
    flicker_mk, scale_drift_mk : float
        1/f noise of single pixels, and of the whole scale, since the last flat-field correction: standard deviation
        of each of the octaves between holds of 1 s and of 512 s, stated as the NETD is, of which they are no part
        [mK].
    bad_pixels : float
        Share of the pixels that are dead or hot and are replaced by their neighbours.
    blinking_pixels, blinking_mk, blinking_s : float
        Share of the pixels that jump between two levels, their distance, stated as the NETD is [mK], and the mean
        time at one of them [s]; no part of `bad_pixels`.
    ffc_interval_s, ffc_duration_s : float
        Time from one flat-field correction to the next, 0: none after the start, and how long the image is frozen.
    gain : {"high", "low"}
        Which of the two ranges is used.
    low_gain_range_c : (2,) floats
        Apparent temperatures of the lowest and the highest count in low gain [°C].
    low_gain_netd_mk : float
        NETD in low gain [mK]; as in high gain where 0.
    tlinear_mk : float
        Apparent temperature of one count where counts are linear in temperature, from 0 K on: 40 or 400 mK;
        0: linear in irradiance.
    agc_tails_percent : (2,) floats
        Shares of the darkest and of the brightest pixels that the display's gain control lets saturate [%].
    visible_width : int
        Pixels across the picture of the visible camera beside it; 0: there is none.
    visible_field_of_view_deg : (2,) floats
        Its horizontal and vertical field of view [deg]: square pixels, as many rows as the vertical one holds.
    """

    name: str
    width: int = key(number(1, MOST_PIXELS, whole=True, unit="pixels"))
    height: int = key(number(1, MOST_PIXELS, whole=True, unit="pixels"))
    pixel_pitch_um: float = key(number(0.5, 1000.0))
    focal_length_mm: float = key(number(0.01, 1e5))
    f_number: float = key(number(0.2, 100.0))
    lens_transmittance: float = key(_share)
    band_um: tuple = key(number(0.0, 1000.0, above=True, count=2, ordered=True))
    netd_mk: float = key(number(0.0, 1e5, above=True))
    netd_f_number: float = key(number(0.2, 100.0))
    bits: int = key(number(2, 16, whole=True))
    range_c: tuple = key(_range_c)
    frame_rate_hz: float = key(number(0.0, 1e5, above=True))
    principal_offset_px: tuple = key(number(-MOST_PIXELS, MOST_PIXELS, count=2), (0.0, 0.0))
    distortion: tuple = key(number(count=5), (0.0, 0.0, 0.0, 0.0, 0.0))
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
    responsivity_percent: tuple = key(number(0.0, 20.0, count=2), (0.0, 0.0))
    flicker_mk: float = key(_noise_mk, 0.0)
    scale_drift_mk: float = key(_noise_mk, 0.0)
    bad_pixels: float = key(number(0.0, 0.05), 0.0)
    blinking_pixels: float = key(number(0.0, 0.05), 0.0)
    blinking_mk: float = key(_noise_mk, 0.0)
    blinking_s: float = key(number(0.01, 1e6), 10.0)
    ffc_interval_s: float = key(number(0.0, 1e6), 0.0)
    ffc_duration_s: float = key(number(0.0, 60.0), 0.0)
    gain: str = key(choice("high", "low"), "high")
    low_gain_range_c: tuple = key(_range_c, (-40.0, 550.0))
    low_gain_netd_mk: float = key(_noise_mk, 0.0)
    tlinear_mk: float = key(choice(0.0, 40.0, 400.0), 0.0)
    agc_tails_percent: tuple = key(number(0.0, 49.0, count=2), (0.5, 0.5))
    visible_width: int = key(number(0, MOST_PIXELS, whole=True, unit="pixels"), 0)
    visible_field_of_view_deg: tuple = key(number(1.0, 170.0, count=2), (57.0, 43.0))

    def check(self, where, given):
        """Refuse noise of frames, rows and columns that leaves nothing of the whole, and a lens that folds."""
        temporal = ("sigma_t_mk", "sigma_tv_mk", "sigma_th_mk")
        if sum(getattr(self, name) ** 2 for name in temporal) >= self.gain_netd_mk**2:
            name = "netd_mk" if self.gain_netd_mk == self.netd_mk else "low_gain_netd_mk"
            told = f"{', '.join(temporal)} leave nothing of {name}={self.gain_netd_mk:g}"
            raise where.error(f"{told}, of which they are part; lower them")
        # A folding distortion would otherwise show with the first frame only, after the scene is baked. Where it
        # folds, Newton's steps run off to infinity before they are refused.
        with np.errstate(all="ignore"):
            self.directions(_image_edge(self.width, self.height))

    def __repr__(self):
        across, along = self.field_of_view_deg
        return (
            f"Camera({self.name!r}, {self.width}×{self.height}, {across:.1f}° × {along:.1f}°, "
            f"{self.focal_length_mm:g} mm f/{self.f_number:g}, {self.band_um[0]:g}–{self.band_um[1]:g} µm, "
            f"NETD {self.gain_netd_mk:g} mK)"
        )

    @property
    def visible_camera(self):
        """The visible camera beside it, on the same axis and without distortion, as a Camera; None without one."""
        if not self.visible_width:
            return None
        across, along = np.tan(np.radians(np.array(self.visible_field_of_view_deg) / 2.0))
        rows = round(self.visible_width * along / across)
        focal_mm = self.visible_width / (2.0 * across) * self.pixel_pitch_um * 1e-3
        return replace(
            self, name=f"{self.name}-visible", width=self.visible_width, height=min(max(rows, 1), MOST_PIXELS),
            focal_length_mm=float(focal_mm), principal_offset_px=(0.0, 0.0), distortion=(0.0,) * 5, visible_width=0,
        )  # fmt: skip

    def part(self, rows, columns):
        """Return the Camera that takes a part of its image alone, given by slices with both ends, on the same axis."""
        size = columns.stop - columns.start, rows.stop - rows.start
        middle = columns.start + 0.5 * size[0], rows.start + 0.5 * size[1]
        offset = tuple(float(point - at) for point, at in zip(self._principal_point, middle, strict=True))
        return replace(self, width=size[0], height=size[1], principal_offset_px=offset)

    def coarser(self, by):
        """Return the Camera whose pixels are `by` times as wide: as many as its image has room for from its corner."""
        width, height = (max(count // by, 1) for count in (self.width, self.height))
        offset = tuple(map(float, self._principal_point / by - (0.5 * width, 0.5 * height)))
        pitch_um = by * self.pixel_pitch_um
        return replace(self, width=width, height=height, pixel_pitch_um=pitch_um, principal_offset_px=offset)

    @property
    def count_range_k(self):
        """Apparent temperatures of the lowest and the highest count of the gain in use [K]."""
        return tuple(end + ZERO_CELSIUS_K for end in (self.low_gain_range_c if self.gain == "low" else self.range_c))

    @property
    def gain_netd_mk(self):
        """NETD of the gain in use [mK], at `netd_f_number` and 300 K."""
        return self.low_gain_netd_mk if self.gain == "low" and self.low_gain_netd_mk else self.netd_mk

    @property
    def time_constant_s(self):
        """Thermal time constant of a pixel [s]."""
        return self.time_constant_ms * 1e-3

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
        Newton's method on the Brown–Conrady model (Brown 1971), to 1e-12 of the focal length. OpenCV's
        `undistortPoints` iterates a fixed point: five rounds leave 0.002 pixels at the corner of a strongly
        distorted image, and where the model folds it answers with a wrong direction instead of an error.
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


def model_path(name, where="camera model"):
    """Return the TOML file of a shipped model, or the path itself if it ends in .toml."""
    path = Path(name) if str(name).endswith(".toml") else Path(__file__).parent / "cameras" / f"{name}.toml"
    if not path.is_file():
        known = sorted(item.stem for item in (Path(__file__).parent / "cameras").glob("*.toml"))
        raise ThermorenderError(f"{where} {str(name)!r} is unknown; give one of {', '.join(known)} or a .toml file")
    return path


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
    path = model_path(name, where)
    return read(Camera, read_toml(path), Where(path), name=path.stem)


def _image_edge(width, height):
    """Image coordinates along the border of an image, (N, 2) [px]."""
    across, along = np.linspace(0.0, width, 65), np.linspace(0.0, height, 65)
    sides = [(across, 0.0), (across, float(height)), (0.0, along), (float(width), along)]
    return np.concatenate([np.stack(np.broadcast_arrays(x, y), axis=-1) for x, y in sides])
