"""The photograph of a pose: the orthophoto seen from there, and the day's sky above it."""

import numpy as np

from thermorender.physics.srgb import bytes_from_linear
from thermorender.scene.surface import BACKGROUND, SURFACE
from thermorender.synthetic.light import sky_colour


def photograph(renderer, pose, time_s=0.0, objects=None, camera=None):
    """Return (image (H, W, 3) uint8 sRGB, covered (H, W) bool): what a camera for visible light sees.

    Parameters
    ----------
    renderer : Renderer
    pose : (4, 4) array
        world_from_camera.
    time_s : float
        Where on their tracks dynamic objects are [s].
    objects : dict, optional
        As of `Renderer.frame`.
    camera : Camera, optional
        In place of the scene's: its pixels then show what the thermal camera's do, as of two registered pictures.

    Returns
    -------
    image : where the scene ends it has the colour of the sky, by the clouds that scene or weather declare.
    covered : where the orthophoto is known.
    """
    image, covered = renderer.visible(pose, camera, time_s, objects)
    return with_sky(image, renderer.sky(pose, camera, time_s, objects), pose, camera or renderer.scene.camera,
                    cloud_of(renderer.scene)), covered  # fmt: skip


def with_sky(image, sky, pose, camera, cloud):
    """Return an image (H, W, 3) uint8 with the day's sky where `sky`, (H, W) bool, says so, under a share of clouds."""
    if not sky.any():
        return image
    rows, columns = np.nonzero(sky)
    slope = camera.directions(np.column_stack([columns + 0.5, rows + 0.5]))
    towards = np.column_stack([slope, np.ones(len(slope))])
    sine = towards @ pose[2, :3] / np.linalg.norm(towards, axis=1)
    image = image.copy()
    image[sky] = bytes_from_linear(sky_colour(sine, cloud))
    return image


def cloud_of(scene):
    """Return the share of the sky that a scene's weather, else its air, declares to be under clouds."""
    weather = scene.spec.weather
    if weather is not None and weather.cloud is not None:
        return weather.cloud
    return scene.air.cloud_fraction if scene.air is not None else 0.0


def sky_of(mask):
    """Return where a truth mask, (H, W) uint8, shows neither the scene nor the ground beyond it."""
    return (mask & (SURFACE | BACKGROUND)) == 0
