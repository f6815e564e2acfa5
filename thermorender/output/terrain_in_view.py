"""Which frames of a flight show terrain, from the geometry alone, before any is rendered."""

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.scene import Scene

# Frames that are tested, spread over a flight.
_FRAMES = 200
# Corners of each surface.
_CORNERS = 2048
# Directions along each side of the picture.
_SIDE = 7


def shows_terrain(scene: Scene, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each of N poses (N, 4, 4) can show the scene's terrain, (N,), without occlusion: a corner of its
    faces is in the picture, or a direction of the picture meets the terrain's median height above it."""
    camera = scene.camera
    side = np.linspace(0.0, 1.0, _SIDE)
    pixel = np.stack(np.meshgrid(side * camera.width, side * camera.height), axis=-1).reshape(-1, 2)
    slope = camera.directions(pixel)
    rays = np.concatenate([slope, np.ones((len(slope), 1))], axis=1)
    low, high = slope.min(axis=0), slope.max(axis=0)
    corners = np.concatenate(
        [
            each.vertices[each.faces[:: 1 + len(each.faces) // _CORNERS, 0]]
            for each in scene.surfaces[: scene.terrain_count]
        ]
    ).astype(np.float64)
    plane = float(np.median(corners[:, 2]))
    shown = np.zeros(len(poses), bool)
    for k, pose in enumerate(poses):
        x, y, z = ((corners - pose[:3, 3]) @ pose[:3, :3]).T
        z = np.where(z > 0.0, z, np.inf)
        inside = (x >= low[0] * z) & (x <= high[0] * z) & (y >= low[1] * z) & (y <= high[1] * z)
        if (inside & np.isfinite(z)).any():
            shown[k] = True
            continue
        direction = rays @ pose[:3, :3].T
        fall = plane - pose[2, 3]
        down = direction[:, 2] * fall > 0.0
        hit = pose[:3, 3] + direction[down] * (fall / direction[down, 2])[:, None]
        shown[k] = bool(np.isfinite(scene.ground(hit[:, 0], hit[:, 1])).any())
    return shown


def empty_frames_note(scene: Scene, poses: NDArray[np.float64]) -> str | None:
    """Return a warning, with its remedy, if most of a flight's poses (N, 4, 4) cannot show terrain; else None."""
    some = poses[:: 1 + len(poses) // _FRAMES]
    empty = some[~shows_terrain(scene, some)]
    if 2 * len(empty) <= len(some):
        return None
    off = np.isnan(scene.ground(empty[:, 0, 3], empty[:, 1, 3]))
    below = float(np.median(np.degrees(np.arcsin(np.clip(-empty[:, 2, 2], -1.0, 1.0)))))
    looks = f"{abs(below):.0f}° {'below' if below >= 0.0 else 'above'} the horizon"
    if 2 * off.sum() > len(empty):
        middle = np.median(empty[:, :2, 3], axis=0)
        why = (
            f"the flight is off the scene's terrain, about east {middle[0]:.0f} m, north {middle[1]:.0f} m, and the "
            f"camera looks {looks}; move the flight with anchor=E,N,U,HEADING"
        )
    else:
        why = (
            f"the flight is over the terrain, but the camera looks past it, {looks}; point it with mount "
            "YAW,PITCH,ROLL (0,-90,0 looks down), or move the flight "
            "with anchor=E,N,U,HEADING"
        )
    return f"{len(empty)} of {len(some)} frames looked at show no terrain: {why}"
