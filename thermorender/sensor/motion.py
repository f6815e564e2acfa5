"""How the image moves between two poses over level ground, and an image moved so."""

import numpy as np

# A ray that meets the ground farther than this, over the height above it, sees the sky or what moves like it.
_FARTHEST = 50.0


def motion_px(camera, pose, other, ground_m):
    """Return how far the image moves from one pose to another, the most over nine places of the image [px].

    Parameters
    ----------
    camera : Camera
    pose, other : (4, 4) arrays
        world_from_camera.
    ground_m : float
        Height of the ground, taken as level [m, local up].
    """
    across, along = np.array([0.5, 0.25, 0.0]) * camera.width, np.array([0.5, 0.25, 0.0]) * camera.height
    pixel = np.stack(np.meshgrid(camera.width - 2 * across, camera.height - 2 * along), axis=-1).reshape(-1, 2)
    slope = camera.directions(pixel)
    ray = np.column_stack([slope, np.ones(len(slope))]) @ pose[:3, :3].T
    height = pose[2, 3] - ground_m
    down = -ray[:, 2] * np.sign(height)
    length = abs(height) / np.maximum(down, 1e-9)
    far = length > _FARTHEST * abs(height)
    # What is far away turns with the camera and does not shift.
    start = np.where(far[:, None], 0.0, pose[:3, 3] - other[:3, 3])
    seen = (start + np.where(far, 1.0, length)[:, None] * ray) @ other[:3, :3]
    moved = np.linalg.norm(camera.project(seen) - pixel, axis=1)
    # What leaves the view behind the camera has crossed the whole image.
    return float(np.nan_to_num(moved, nan=np.hypot(camera.width, camera.height)).max())


def homography(camera, seen_from, wanted_from, ground_m):
    """Return the (3, 3) matrix from image coordinates of one view to those of another, for points of level ground.

    Parameters
    ----------
    camera : Camera
        Without distortion.
    seen_from, wanted_from : (4, 4) arrays
        world_from_camera of the view whose coordinates come out, and of that whose go in.
    ground_m : float
        Height of the ground [m, local up].
    """
    f = camera.focal_length_px
    x, y = camera.width / 2 + camera.principal_offset_px[0], camera.height / 2 + camera.principal_offset_px[1]
    # Arrays count from the middle of their first pixel.
    matrix = np.array([[f, 0.0, x - 0.5], [0.0, f, y - 0.5], [0.0, 0.0, 1.0]])
    rotation = seen_from[:3, :3].T @ wanted_from[:3, :3]
    shift = seen_from[:3, :3].T @ (wanted_from[:3, 3] - seen_from[:3, 3])
    normal, distance = wanted_from[2, :3], ground_m - wanted_from[2, 3]
    return matrix @ (rotation + np.outer(shift, normal) / distance) @ np.linalg.inv(matrix)


def warped(image, matrix, smooth):
    """Return (image, inside): an image (H, W) float32 as seen through a homography, and where it was in view.

    `smooth` interpolates with cubic weights rather than linear ones: three quarters of the blur, four times the time.
    """
    import cv2

    size = image.shape[::-1]
    flags = cv2.WARP_INVERSE_MAP | (cv2.INTER_CUBIC if smooth else cv2.INTER_LINEAR)
    moved = cv2.warpPerspective(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    seen = cv2.warpPerspective(np.ones(image.shape, np.uint8), matrix, size, flags=cv2.WARP_INVERSE_MAP)
    return moved, seen
