"""A frame: what the camera sees from one pose, with the truth behind it, each part computed when asked for.

A frame is a value: it can be pickled, and then brings its truth with it. Until then it refers to the baked scene that
it shows, for what has not been asked for yet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.scene.surface import SATURATED
from thermorender.sensor import readout
from thermorender.sensor.camera import Camera
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.display import DisplaySettings

# Temperatures that are looked up in a table [K]; others are computed one by one.
_TABLE_K = (10.0, 10000.0)


@dataclass(frozen=True)
class Found:
    """What a pickled frame's scene told of it: its view without the scene.

    Attributes
    ----------
    images : dict
        As by `View.truth`.
    objects : dict
        As by `View.targets`.
    budget : dict or None
        As by `View.budget_mk`.
    error : (H, W) float32 or None
        As by `View.error_mk`.
    """

    images: dict[str, NDArray[Any]]
    objects: dict[str, dict[str, Any]]
    budget: dict[str, float] | None
    error: NDArray[np.float32] | None

    def truth(self) -> dict[str, NDArray[Any]]:
        """Return what is really there, without the sensor's flags."""
        return dict(self.images)

    def targets(self) -> dict[str, dict[str, Any]]:
        """Return where objects are."""
        return self.objects

    def budget_mk(self, radiance: NDArray[np.float32], sampling: Any) -> dict[str, float] | None:
        """Return the error budget of the radiance that was pickled."""
        return self.budget

    def error_mk(self, radiance: NDArray[np.float32], sampling: Any) -> NDArray[np.float32] | None:
        """Return the estimated error of each pixel of the radiance that was pickled."""
        return self.error


# Frames are compared by identity: arrays have no truth value to compare them by.
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
        Number of the frame in its flight; with the seed it decides the noise.
    seed : int
    camera : Camera
    plan : dict
        What was rendered how.
    time : datetime64 or None
        The instant that it shows, UTC; None where the scene has no weather.
    """

    radiance: NDArray[np.float32] = field(repr=False)
    pose: NDArray[np.float64]
    time_s: float
    index: int
    seed: int
    camera: Camera
    plan: dict[str, Any]
    time: "np.datetime64 | None" = None
    _view: Any = field(repr=False, default=None)
    _sampling: Any = field(repr=False, default=None)
    _reading: NDArray[np.uint16] | None = field(repr=False, default=None)

    def __repr__(self) -> str:
        height, width = self.radiance.shape
        kelvin = self.apparent_temperature
        when = "" if self.time is None else f", {self.time}Z"
        return (
            f"Frame({self.index}, {self.camera.name} {width}×{height}, {kelvin.min():.1f}–{kelvin.max():.1f} K, "
            f"at {self.time_s:g} s{when}, seed {self.seed})"
        )

    def __getstate__(self) -> dict[str, Any]:
        # What is found when asked for needs the scene, which does not go along: it is found now.
        state = dict(vars(self))
        images = state.pop("truth", None) or self._view.truth()
        images = {**images, "mask": images["mask"] & ~np.uint8(SATURATED)}
        found = Found(images, self.targets, self.budget_mk, self.error_mk)
        return {**state, "_view": found, "_sampling": None}

    def with_reading(self, counts: NDArray[np.uint16], how: dict[str, Any]) -> "Frame":
        """Return the same frame as a flight's sensor read it: counts (H, W) uint16, and `how` for the plan."""
        return replace(self, _reading=counts, plan={**self.plan, "sensor": how})

    @cached_property
    def budget_mk(self) -> dict[str, float] | None:
        """Error of the radiance, without the sensor's noise, by its causes: {cause: root mean square [mK at 300 K]}.

        Over the pixels that show a surface. "nodes": worst error of the spectral nodes over the spectra that the scene
        may show, and the bound of the solution by its residual; "bake": light between the surfaces that are seen, by
        two independent halves of its rays, and that of moving objects, by how many of theirs it is made of; "sampling":
        rays and texture reads of this frame, by some of its pixels rendered anew; "air": worst error of the spectral
        channels over the same spectra; "mirrors": worst error of what they reflect, up to 80°, and what is left out of
        mirrors in mirrors in mirrors; "total". Estimates from above, and but for the solution no bounds: what no ray
        met and no neighbour of a pixel tells of is not in them. None for a frame of the reference engine, whose error
        is its noise.
        """
        return self._view.budget_mk(self.radiance, self._sampling)

    @cached_property
    def error_mk(self) -> NDArray[np.float32] | None:
        """Estimated error of each pixel by all causes of `budget_mk`, (H, W) float32 [mK at 300 K].

        Its root mean square is that budget's total, but for what differs between all pixels and the sixteenth of them
        in which the light is looked up there. NaN where no surface is shown; None for a frame of the reference engine.
        """
        return self._view.error_mk(self.radiance, self._sampling)

    @cached_property
    def targets(self) -> dict[str, dict[str, Any]]:
        """Where the scene's objects are: {name: {"pixel": (column, row) or None, "in_view", "visible", "range_m"}}."""
        return self._view.targets()

    @cached_property
    def apparent_temperature(self) -> NDArray[np.float32]:
        """Temperature of the blackbody with each pixel's band radiance, (H, W) float32 [K]; 0 for no radiance."""
        return apparent_temperature(self.radiance, self.camera.band_um)

    @cached_property
    def counts(self) -> NDArray[np.uint16]:
        """What the detector reads, with noise, (H, W) uint16; a camera at rest where the frame is not of a flight."""
        if self._reading is not None:
            return self._reading
        return sensor_of(self.camera, self.seed).counts_at_rest(self.radiance, self.index)

    @cached_property
    def display(self) -> NDArray[np.uint8]:
        """The counts spread over 8 bits for a screen, white hot, (H, W) uint8."""
        return DisplaySettings(tails_percent=self.camera.agc_tails_percent).image(self.counts)[1]

    @cached_property
    def truth(self) -> dict[str, NDArray[Any]]:
        """What is really there, at pixel centres.

        Returns
        -------
        dict
            kinetic_temperature [K], emissivity (band mean at 300 K; towards the camera where it depends on the angle),
            depth along the optical axis [m], each (H, W) float32; position (H, W, 3) float32 in the local frame [m];
            material (H, W) uint8, 255 for none; mask (H, W) uint8, flags of `thermorender.scene.surface`. NaN (depth:
            infinity) where nothing is hit.
        """
        found = self._view.truth()
        saturated = readout.saturated(self.counts, self.camera)
        found["mask"] = found["mask"] | np.where(saturated, SATURATED, 0).astype(np.uint8)
        return found


def apparent_temperature(radiance: ArrayLike, band_um: Sequence[float]) -> NDArray[np.float32]:
    """Return the blackbody temperature of band radiances, (…) float32 [K], by table (error below 0.1 mK).

    Zero gives 0 K; negative values, infinities and NaN give NaN, since no blackbody has them.
    """
    radiance = np.asarray(radiance, dtype=np.float64)
    least, most = band_radiance(np.array(_TABLE_K), *band_um)
    usual = (radiance >= least) & (radiance <= most)
    result = np.empty(radiance.shape)
    # Outside, a table would take no end of entries.
    result[~usual] = brightness_temperature(radiance[~usual], *band_um)
    if usual.any():
        known = radiance[usual]
        coldest, warmest = brightness_temperature(np.array([known.min(), known.max()]), *band_um)
        grid = RadianceTable.grid(coldest, warmest)
        result[usual] = RadianceTable(grid, band_radiance(grid, *band_um)).inverse(known)
    with np.errstate(over="ignore"):
        return result.astype(np.float32)
