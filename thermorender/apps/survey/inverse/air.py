"""The air between camera and ground, removed from the frames of a survey by the scene's air and each pixel's range."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from thermorender import Atmosphere, Camera
from thermorender.apps.survey.inverse.frames import Survey
from thermorender.apps.survey.inverse.linear import RANGE_K
from thermorender.render.air import altitude

if TYPE_CHECKING:
    from thermorender import Renderer

Floats = NDArray[np.float64]
# Temperature at which emissivities are averaged over the band [K].
_REFERENCE_K = 290.0
# Ranges are cast every so many pixels, and at so many points of each side or more.
_EVERY, _POINTS = 8, 33
# Path lengths, and temperatures of the ground, between which the change by the air is interpolated.
_LENGTHS, _TEMPERATURES = 8, 24


def without_air(survey: Survey, camera: Camera, renderer: "Renderer") -> Survey:
    """Return a Survey of apparent temperatures at the ground; frames that removed the air stay as they are.

    Ground of the scene's mean emissivity ε under its sky E leaves L_n(T) = ε B_n(T) + (1−ε) E_n/π in spectral node n,
    and τ_n L_n(T) + P_n arrive. T is solved at each pixel's range from the measured pose, and replaced by the apparent
    temperature of Σ L_n(T). An error of 1 m in a range of 100 m changes 1 % of the correction.
    """
    if renderer.scene.air is None:
        return survey
    own = survey.air_removed or (False,) * len(survey.names)
    kelvin, changes, ground = survey.kelvin.copy(), [], _Ground(renderer, camera)
    for number, (pose, corrected) in enumerate(zip(survey.poses, own, strict=True)):
        if not corrected:
            kelvin[number] += (change := ground.change(survey.kelvin[number], pose))
            changes.append(float(np.nanmedian(change)) if np.isfinite(change).any() else 0.0)
    if not changes:
        return survey
    note = (
        f"the scene's air is removed from {len(changes)} frames, by {np.median(changes):+.2f} K in the median; if "
        "their files were corrected for air before, use a scene without [atmosphere]"
    )
    return replace(survey, kelvin=kelvin, notes=(*survey.notes, note))


class _Ground:
    """The ground of a scene as a camera sees it through the air."""

    def __init__(self, renderer: "Renderer", camera: Camera) -> None:
        self._renderer, self._camera, self._scene = renderer, camera, renderer.scene
        assert renderer.scene.air is not None
        self._air: Atmosphere = renderer.scene.air
        number, count = np.unique(self._scene.surfaces[0].material, return_counts=True)
        each = [self._scene.materials[one].band_emissivity(*camera.band_um, _REFERENCE_K) for one in number]
        emissivity = float(np.average(each, weights=count))
        cosine, weight = np.polynomial.legendre.leggauss(6)
        cosine = 0.5 * (cosine + 1.0)
        sky = (weight * cosine) @ self._air.sky_radiance(np.full(len(cosine), self._scene.altitude_m), cosine)
        # Radiance in each node that leaves ground of each temperature, (T, N), and what looks as warm.
        kelvin = np.arange(RANGE_K[0], RANGE_K[1], 0.5)
        black = self._air.planck(kelvin)
        self._leaving = emissivity * black + (1.0 - emissivity) * sky
        self._black, self._kelvin = black.sum(axis=-1), kelvin
        self._apparent = np.interp(self._leaving.sum(axis=-1), self._black, kelvin)

    def change(self, kelvin: NDArray[np.float32], pose: Floats) -> NDArray[np.float32]:
        """Return apparent temperatures at the ground less those of a frame, (H, W) [K]; 0 if it shows no ground."""
        length, end = self._paths(pose)
        known = kelvin[np.isfinite(kelvin)]
        if not np.isfinite(length).any() or not known.size:
            return np.zeros_like(kelvin)
        start = float(altitude(pose[:3, 3], self._scene.altitude_m))
        length = np.where(np.isfinite(length), length, np.nanmedian(length))
        lengths = np.linspace(length.min(), max(length.max(), length.min() + 1.0), _LENGTHS)
        # The air hardly changes between the ends of a frame's paths.
        ends = np.clip(np.nanmedian(end), start - lengths, start + lengths)
        measured = np.linspace(known.min(), known.max() + 1e-3, _TEMPERATURES)
        change = np.empty((_LENGTHS, _TEMPERATURES))
        for row, through, added in zip(change, *self._air.path(start, ends, lengths), strict=True):
            seen = np.interp(self._leaving @ through + added.sum(), self._black, self._kelvin)
            row[:] = np.interp(measured, seen, self._apparent) - measured
        table = RegularGridInterpolator((lengths, measured), change, bounds_error=False, fill_value=None)
        return np.asarray(table((self._everywhere(length), kelvin)), np.float32)

    def _points(self) -> tuple[Floats, Floats]:
        """Rows and columns of the points of which ranges are cast, up to the edges of the image [px]."""
        rows, columns = (
            np.linspace(0.0, side, max(side // _EVERY + 1, _POINTS))
            for side in (self._camera.height, self._camera.width)
        )
        return rows, columns

    def _paths(self, pose: Floats) -> tuple[Floats, Floats]:
        """(length [m], altitude of the end [m]) of the paths to the ground at the points; NaN for sky."""
        rows, columns = self._points()
        middle = np.stack(np.broadcast_arrays(columns, rows[:, None]), axis=-1)
        slopes = self._camera.directions(middle.reshape(-1, 2))
        way = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) @ pose[:3, :3].T
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        distance, face = self._renderer.faces(np.broadcast_to(pose[:3, 3], way.shape), way)
        length = np.where(face >= 0, distance, np.nan).astype(np.float64)
        reached = pose[:3, 3] + np.where(face >= 0, distance, 0.0)[:, None] * way
        end = np.where(face >= 0, altitude(reached, self._scene.altitude_m), np.nan)
        return length.reshape(middle.shape[:2]), end.reshape(middle.shape[:2])

    def _everywhere(self, length: Floats) -> Floats:
        """Lengths of paths at the pixels' middles, (H, W). Their inverse is nearly linear over the image of a plane."""
        inverse = RegularGridInterpolator(self._points(), 1.0 / length)
        row, column = np.indices((self._camera.height, self._camera.width)) + 0.5
        return np.asarray(1.0 / inverse((row, column)))
