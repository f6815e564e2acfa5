"""The fits of a scene: some poses of each method, in pieces of ground that all poses and scenes of a land share."""

import zlib

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.referee import emissivities
from thermorender.apps.compare.referee.causes.pooled import Causes
from thermorender.apps.compare.referee.causes.pose_fit import Pair, fit
from thermorender.apps.compare.referee.structure import ALIKE
from thermorender.apps.compare.referee.views import View, evenly
from thermorender.scene.scene import Scene

# Largest number of poses that are fitted per scene and in total; each scene gets at least one.
_POSES, _ALL = 4, 12
# Pieces of ground along a picture's larger side.
_PIECES = 7
# Largest distance to another material at which a pixel may show both [px].
_MOST_REACH_PX = 30


class Fitting:
    """The fits of one scene.

    Parameters
    ----------
    scene : Scene
        The reference's.
    land : str
        Scenes of the same land share pieces of ground.
    poses, scenes : int
        Numbers of the scene's poses and of all scenes.
    """

    def __init__(self, scene: Scene, land: str, poses: int, scenes: int) -> None:
        self._scene, self._land = scene, zlib.crc32(land.encode()) & 0xFFFF
        self._chosen = set(evenly(poses, min(_POSES, max(1, _ALL // scenes))))
        self._emissivity = emissivities.band_emissivities(scene)
        self._known = {each.name: float(e) for each, e in zip(scene.materials, self._emissivity, strict=True)}
        self._side_m: float | None = None
        self._index = -1
        self._cell: NDArray[np.int64] = np.zeros((0, 0), np.int64)
        self._pure: NDArray[np.bool_] = np.zeros((0, 0), np.bool_)

    def add(
        self, causes: Causes, view: View, image: NDArray[np.floating], at: tuple[float, float, float, float] | None
    ) -> None:
        """Add the fit of a View to a method's Causes if this pose is fitted.

        Parameters
        ----------
        causes : Causes
        view : View
            With a reference.
        image : (H, W) array
            Apparent temperature of the method [K].
        at : tuple or None
            Shift of its picture, as `structure.peak` returns it.
        """
        if view.index not in self._chosen or view.truth is None:
            return
        band_um = self._scene.camera.band_um
        if self._index != view.index:
            self._index, self._cell, self._pure = view.index, self._cells(view), self._of_one_material(view)
        ground = view.known & (view.object < 0)
        change = emissivities.change_k(view, self._emissivity, image, self._scene.sky_temperature, band_um)
        pair = Pair(image, view.truth, ground, view.known, view.material, view.material_names, change, self._cell,
                    self._pure)  # fmt: skip
        found = fit(pair, at[:2] if at is not None and abs(at[2]) >= ALIKE else (0.0, 0.0))
        if found is not None:
            causes.fits.append(found)
            causes.emissivity |= self._known

    def _of_one_material(self, view: View) -> NDArray[np.bool_]:
        """Return the pixels that show a single material, (H, W): colours are interpolated between texels."""
        import cv2

        texel_m = self._scene.surfaces[0].texel_m or 0.0
        reach = int(np.clip(np.ceil(texel_m / view.texel_m if view.texel_m else 1.0), 1, _MOST_REACH_PX))
        sides = np.ones((2 * reach + 1,) * 2, np.uint8)
        found: NDArray[np.bool_] = cv2.erode(view.material, sides) == cv2.dilate(view.material, sides)
        return found

    def _cells(self, view: View) -> NDArray[np.int64]:
        """Return the number of the piece of ground of each pixel, (H, W)."""
        place = np.where(view.known[..., None], view.position[..., :2], np.float32(0.0)).astype(np.float64)
        if self._side_m is None:
            seen = view.position[view.known][:, :2]
            sides = np.ptp(np.percentile(seen, [2, 98], axis=0), axis=0) if len(seen) else np.ones(2)
            self._side_m = max(float(sides.max()) / _PIECES, 1e-3)
        number = np.floor(place / self._side_m).astype(np.int64) & 0xFFFFF
        found: NDArray[np.int64] = (self._land << 40) + (number[..., 0] << 20) + number[..., 1]
        return found
