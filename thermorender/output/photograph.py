"""The photograph of a pose: the orthophoto from that view, and the day's sky."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.srgb import bytes_from_linear, decoded
from thermorender.scene.surface import BACKGROUND, SURFACE
from thermorender.sensor.camera import Camera

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer
    from thermorender.scene.scene import Scene


def photograph(
    renderer: "Renderer", pose: NDArray[np.float64], time_s: float = 0.0, objects: dict[str, Any] | None = None,
    camera: Camera | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:  # fmt: skip
    """Return (image (H, W, 3) uint8 sRGB, covered (H, W) bool) of a camera for visible light, by default the scene's.
    `time_s` and `objects` are as in `Renderer.frame`. Where no surface is visible the image has the sky, by the clouds
    of the scene or its weather; `covered` is where the orthophoto is known."""
    image, covered = renderer.visible(pose, camera, time_s, objects)
    return with_sky(image, renderer.sky(pose, camera, time_s, objects), pose, camera or renderer.scene.camera,
                    cloud_of(renderer.scene)), covered  # fmt: skip


def with_sky(
    image: NDArray[np.uint8], sky: NDArray[np.bool_], pose: NDArray[np.float64], camera: Camera, cloud: float
) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) uint8 with the day's sky where `sky`, (H, W) bool, is true; `cloud` is a share."""
    if not sky.any():
        return image
    rows, columns = np.nonzero(sky)
    slope = camera.directions(np.column_stack([columns + 0.5, rows + 0.5]))
    towards = np.column_stack([slope, np.ones(len(slope))])
    sine = towards @ pose[2, :3] / np.linalg.norm(towards, axis=1)
    image = image.copy()
    image[sky] = bytes_from_linear(sky_colour(sine, cloud))
    return image


def cloud_of(scene: "Scene") -> float:
    """Return the cloud fraction of a scene's weather, or else of its air."""
    weather = scene.spec.weather
    if weather is not None and weather.cloud is not None:
        return weather.cloud
    return scene.air.cloud_fraction if scene.air is not None else 0.0


def sky_of(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return where a truth mask, (H, W) uint8, shows neither the scene nor the ground beyond it."""
    return (mask & (SURFACE | BACKGROUND)) == 0


def sky_colour(sine: ArrayLike, cloud: float = 0.0) -> NDArray[np.float32]:
    """Return the linear sRGB colour of the daytime sky, (..., 3) float32, by the sine of elevation and cloud fraction.
    Blue overhead and white towards the horizon, where the air path is long; grey under clouds, three times as bright at
    the zenith as at the horizon (Moon & Spencer, 1942, the CIE overcast sky). Clouds are uniform. Colours are
    chosen."""
    high = np.clip(np.asarray(sine, np.float32), 0.0, 1.0)[..., None]
    zenith, horizon, grey = (
        decoded(np.array(colour, np.float32) / 255.0) for colour in ((92, 138, 200), (206, 219, 232), (214, 216, 220))
    )
    clear = zenith + (horizon - zenith) * np.exp(-4.0 * high)
    overcast = grey * (1.0 + 2.0 * high) / 3.0
    return ((1.0 - cloud) * clear + cloud * overcast).astype(np.float32)
