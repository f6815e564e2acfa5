"""A frame: the image of the camera from one pose, with its truth; each part is computed on first access.

A frame is a value: a pickled frame contains its truth. Before pickling it refers to its baked scene for the parts that
are not computed yet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.frame.orthoimage import Orthoimage, orthorectified
from thermorender.frame.picture import html, show, span
from thermorender.physics.band import kelvin_table
from thermorender.physics.planck import brightness_temperature
from thermorender.scene.georeference import Place
from thermorender.scene.surface import SATURATED
from thermorender.sensor import readout
from thermorender.sensor.camera import Camera
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.display import DisplaySettings

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Found:
    """The view of a pickled frame, without its scene."""

    images: dict[str, NDArray[Any]]  # From `View.truth`
    objects: dict[str, dict[str, Any]]  # From `View.targets`
    extents: dict[str, dict[str, Any]]  # From `View.labels`
    budget: dict[str, float] | None  # From `View.budget_mk`
    error: NDArray[np.float32] | None  # (H, W), from `View.error_mk`

    def truth(self, sampling: Any) -> dict[str, NDArray[Any]]:
        """Return the truth without the sensor's flags."""
        return dict(self.images)

    def targets(self) -> dict[str, dict[str, Any]]:
        """Return the positions of objects."""
        return self.objects

    def labels(self, seen: NDArray[np.uint32]) -> dict[str, dict[str, Any]]:
        """Return the extents of objects."""
        return self.extents

    def budget_mk(self, radiance: NDArray[np.float32], sampling: Any) -> dict[str, float] | None:
        """Return the error budget of the radiance that was pickled."""
        return self.budget

    def error_mk(self, radiance: NDArray[np.float32], sampling: Any) -> NDArray[np.float32] | None:
        """Return the estimated error of each pixel of the radiance that was pickled."""
        return self.error


@dataclass(frozen=True)
class Audited:
    """An audited frame without its view: its number and its error budget."""

    index: int
    budget_mk: dict[str, float] | None


# Frames are compared by identity, since arrays cannot be compared to one truth value.
@dataclass(frozen=True, eq=False)
class Frame:
    """One LWIR frame.

    Attributes
    ----------
    radiance : (H, W) float32
        Band radiance entering the lens, without noise [W m⁻² sr⁻¹].
    pose : (4, 4) float64
        world_from_camera.
    time_s : float
    index : int
        Number of the frame in its flight; with the seed it determines the noise.
    seed : int
    camera : Camera
    plan : dict
        Settings of the rendering steps.
    materials : tuple of str
        Names of the materials that `truth["material"]` numbers.
    objects : tuple of str
        Names of the objects that `truth["object"]` numbers, from 1.
    time : datetime64 or None
        The instant of the frame, UTC; None if the scene has no weather.
    device : dict
        Device that computed the radiance, and the version of its compiler.
    place : Place or None
        Where the scene lies on Earth, and the CRS of its map; None for a mesh without [frame].
    """

    radiance: NDArray[np.float32] = field(repr=False)
    pose: NDArray[np.float64]
    time_s: float
    index: int
    seed: int
    camera: Camera
    plan: dict[str, Any]
    time: "np.datetime64 | None" = None
    materials: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    device: dict[str, str] = field(repr=False, default_factory=dict)
    place: Place | None = field(repr=False, default=None)
    _view: Any = field(repr=False, default=None)
    _sampling: Any = field(repr=False, default=None)
    _reading: NDArray[np.uint16] | None = field(repr=False, default=None)
    _audited: "Frame | Audited | None" = field(repr=False, default=None)

    def __repr__(self) -> str:
        height, width = self.radiance.shape
        when = "" if self.time is None else f", {self.time}Z"
        return (
            f"Frame({self.index}, {self.camera.name} {width}×{height}, {span(self.apparent_temperature)}, "
            f"at {self.time_s:g} s{when}, seed {self.seed})"
        )

    def __str__(self) -> str:
        low, high, bits = self.radiance.min(), self.radiance.max(), self.camera.bits
        lines = [
            repr(self),
            f"  apparent_temperature  {span(self.apparent_temperature)}, of a blackbody with the same radiance",
            f"  radiance              {low:.4g}–{high:.4g} W m⁻² sr⁻¹ in {_band(self.camera)}, without noise",
            f"  counts, display       {bits}-bit counts with noise; 8 bits for a screen",
            "  truth                 kinetic_temperature [K], emissivity [1], depth [m], position (local) [m], "
            "material, object, mask",
            f"  targets               {', '.join(self.targets) or 'none'}: pixel, visible, range_m [m]",
            "  budget_mk, error_mk   error by cause, and of each pixel [mK at 300 K]",
            "  show, save, to_xarray, orthorectified",
        ]
        if self.place is None:
            lines[-1] = "  show, save, to_xarray; not orthorectified, as the scene has no [frame]"
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return html(self.apparent_temperature, repr(self))

    def show(self) -> None:
        """Draw the apparent temperature with a colour bar [K].

        In a notebook it is a picture below the cell, on a desktop a window, in a terminal without a desktop coloured
        characters. Where the output is not a terminal, the frame's line is printed.
        """
        show(self, self.apparent_temperature)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the frame to a file, whose kind is the suffix of its name.

        Parameters
        ----------
        path : path
            .exr: radiance, apparent temperature and truth, the file that `thermorender render` writes. .npz: the same
            arrays and the counts, with `record`, a text of JSON; without pickle. .tif: apparent temperature, float32
            [K]. .png: the display image, 8 bits.

        Raises
        ------
        ThermorenderError
            Another suffix, or a file that cannot be written.
        """
        from thermorender.frame.save import save

        save(self, path)

    def to_xarray(self) -> "xr.Dataset":
        """Return an xarray.Dataset of the images and the truth, with units.

        Its coordinates are the pixels' middles (x, y) [px], the position that each pixel shows (east, north, up) [m]
        and, in a scene with a place, that position on the scene's map (map_x, map_y) with the CRS in `spatial_ref`.

        Raises
        ------
        ThermorenderError
            xarray is not installed.
        """
        from thermorender.frame.labelled import of_frame

        return of_frame(self)

    def orthorectified(self, metres: float) -> Orthoimage:
        """Return the apparent temperature on the scene's map, at the positions that the pixels show.

        Parameters
        ----------
        metres : float
            Size of a map pixel [m]. Frame pixels within it are averaged as radiance; a finer map repeats them.

        Raises
        ------
        ThermorenderError
            A scene without a place on Earth, a frame without a surface, or a map of too many pixels.
        """
        return orthorectified(self.radiance, self.truth["position"], self.place, metres, self.kelvin_of)

    def kelvin_of(self, radiance: ArrayLike) -> NDArray[np.float32]:
        """Return the apparent temperature of radiances in this camera's band, (…) float32 [K]."""
        return apparent_temperature(radiance, self.camera.band_um)

    def __getstate__(self) -> dict[str, Any]:
        # All parts are computed now, since the scene is not pickled.
        state = dict(vars(self))
        images = state.pop("truth", None) or self._view.truth(self._sampling)
        images = {**images, "mask": images["mask"] & ~np.uint8(SATURATED)}
        found = Found(images, self.targets, self.labels, self.budget_mk, self.error_mk)
        audited = self._audited and Audited(self._audited.index, self.budget_mk)
        return {**state, "_view": found, "_sampling": None, "_audited": audited}

    def with_reading(self, counts: NDArray[np.uint16], how: dict[str, Any]) -> "Frame":
        """Return the frame with the reading of a flight's sensor: counts (H, W) uint16, and `how` for the plan."""
        return replace(self, _reading=counts, plan={**self.plan, "sensor": how})

    def with_audit(self, audited: "Frame | Audited") -> "Frame":
        """Return the frame with the error budget of an earlier frame of its flight."""
        return replace(self, _audited=audited)

    @property
    def audit(self) -> "Frame | Audited":
        """Its error budget for later frames of its flight: with the view, or without it where it is measured."""
        return Audited(self.index, self.budget_mk) if "budget_mk" in vars(self) else self

    @property
    def budget_frame(self) -> int:
        """Number of the frame that `budget_mk` was measured in: its own, or that of an earlier frame of its flight."""
        return self.index if self._audited is None else self._audited.index

    @cached_property
    def budget_mk(self) -> dict[str, float] | None:
        """Error of the radiance, without the sensor's noise, by cause: {cause: root mean square [mK at 300 K]}.

        Over the pixels that show a surface, except for "image". "nodes": largest error of the spectral nodes over the
        spectra of the scene, and the residual bound of the solution. "bake": light between the visible surfaces, from
        two independent halves of its rays and from random walks at some pixels, and light of moving objects, from the
        number of their rays. "sampling": rays
        and texture reads of this frame, from a part of its pixels rendered again. "air": largest error of the spectral
        channels over the same spectra. "mirrors": largest error of reflections up to 80°, and of the third mirror in a
        chain, which is left out. "preview": of a preview of an edit, what it leaves out. "total". "image": the total
        over all pixels; sky and surroundings only have an error of sampling. These are estimates; only that of the
        solution is a bound, and an object that no ray hits is not in them. With a learned emissivity, "emissivity" and
        "emissivity_mean" are the effects of its standard deviations, of a texel and of a mean over many, under the
        unobstructed sky; with air, "gases" is what is not known of its absorption between camera and surfaces. They
        are properties of the scene, so the total leaves them out.
        None for a frame of the reference engine, whose error is its noise. Most frames of a flight have the budget of
        the frame `budget_frame`.
        """
        if self._audited is not None:
            return self._audited.budget_mk
        return self._view.budget_mk(self.radiance, self._sampling)

    @cached_property
    def error_mk(self) -> NDArray[np.float32] | None:
        """Estimated error of each pixel by all causes of `budget_mk`, (H, W) float32 [mK at 300 K].

        Its root mean square is the total of this frame's own budget, except that the budget evaluates the light in one
        sixteenth of the pixels. NaN where no surface is visible; None for a frame of the reference engine.
        """
        return self._view.error_mk(self.radiance, self._sampling)

    @cached_property
    def targets(self) -> dict[str, dict[str, Any]]:
        """The scene's objects but tables of copies or crowns: {name: {"pixel": (column, row) or None, "in_view",
        "visible", "range_m"}}."""
        return self._view.targets()

    @cached_property
    def labels(self) -> dict[str, dict[str, Any]]:
        """How much of each object the image shows, for the objects whose extent meets it. Tables of copies or crowns,
        which are many bodies, have none.

        Returns
        -------
        dict
            {name: {…}} with pixels, whose middle shows the object; silhouette_pixels, whose middle would show it if no
            other surface were there; occluded, the share of those that other surfaces hide; truncated, the share of
            its silhouette beyond the border of the image; full_box, [left, top, width, height] of the whole object
            [px], hidden parts and parts beyond the border included. A share is None where no ray meets the object,
            and the box where it reaches behind the camera.
        """
        return self._view.labels(self.truth["object"])

    @cached_property
    def apparent_temperature(self) -> NDArray[np.float32]:
        """Temperature of the blackbody with each pixel's band radiance, (H, W) float32 [K]; 0 for no radiance."""
        return self.kelvin_of(self.radiance)

    @cached_property
    def counts(self) -> NDArray[np.uint16]:
        """Counts of the detector, with noise, (H, W) uint16; of a camera at rest, unless the frame is of a flight."""
        if self._reading is not None:
            return self._reading
        return sensor_of(self.camera, self.seed).counts_at_rest(self.radiance, self.index)

    @cached_property
    def display(self) -> NDArray[np.uint8]:
        """The counts in 8 bits for a screen, white hot, (H, W) uint8."""
        return DisplaySettings(tails_percent=self.camera.agc_tails_percent).image(self.counts)[1]

    @cached_property
    def truth(self) -> dict[str, NDArray[Any]]:
        """The truth at pixel centres.

        Returns
        -------
        dict
            kinetic_temperature [K], emissivity (band mean at 300 K; towards the camera where it depends on the angle),
            emissivity_std and, for scenes with a learned emissivity, emissivity_mean_std (its standard deviations: of a
            texel whose material is uncertain, and of a mean over many such texels),
            depth along the optical axis [m], each (H, W) float32; position (H, W, 3) float32 in the local frame [m];
            material (H, W) uint8, 255 for none; object (H, W) uint32, from 1 in the order of `objects`, 0 for none;
            mask (H, W) uint8, flags of `thermorender.scene.surface`. NaN (depth: infinity) where nothing is hit.
        """
        found = self._view.truth(self._sampling)
        saturated = readout.saturated(self.counts, self.camera)
        found["mask"] = found["mask"] | np.where(saturated, SATURATED, 0).astype(np.uint8)
        return found


def _band(camera: Camera) -> str:
    return f"{camera.band_um[0]:g}–{camera.band_um[1]:g} µm"


def apparent_temperature(radiance: ArrayLike, band_um: Sequence[float]) -> NDArray[np.float32]:
    """Return the blackbody temperature of band radiances, (…) float32 [K], by table.

    The error is below 0.1 mK up to 1000 K. Zero gives 0 K; negative values, infinities and NaN give NaN, since no
    blackbody has them.
    """
    radiance = np.asarray(radiance)
    with np.errstate(over="ignore", under="ignore"):
        single = radiance.astype(np.float32)
    result, known = kelvin_table(*band_um).kelvin(single.ravel())
    if not known.all():
        with np.errstate(over="ignore"):
            result[~known] = brightness_temperature(radiance.ravel()[~known].astype(np.float64), *band_um)
    return result.reshape(radiance.shape)
