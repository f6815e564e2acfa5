"""Frames of a textured hill by their own ray caster, which shares no code with the adjustment that they test."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from thermorender import Camera, load_camera

# Texture and its step [m], height and half-width of the hill [m], height of the flight [m].
STEP_M, SIDE = 0.25, 1600
HILL_M, WIDE_M, FLIGHT_M = 3.0, 18.0, 60.0
# Focal length [px], principal point [px], k1, k2 of the lens.
LENS = np.array([190.0, 2.0, -3.0, -0.3, 0.08])
WIDTH, HEIGHT = 160, 128


def camera_of(lens) -> Camera:
    """Return a Camera of 160×128 pixels with a lens of `LENS`'s form."""
    focal, right, down, k1, k2 = (float(value) for value in lens)
    return replace(
        load_camera("ideal"), name="small", width=WIDTH, height=HEIGHT, pixel_pitch_um=48.0,
        focal_length_mm=focal * 48e-3, principal_offset_px=(right, down), distortion=(k1, k2, 0.0, 0.0, 0.0),
    )  # fmt: skip


def hill(east, north):
    """Height of the ground [m]."""
    return HILL_M * np.exp(-0.5 * ((east - 10.0) ** 2 + (north + 5.0) ** 2) / WIDE_M**2)


def texture(seed=0):
    """Temperatures on a grid of `STEP_M` about the origin, (SIDE, SIDE) [K], rows northwards."""
    rng = np.random.default_rng(seed)
    fine = gaussian_filter(rng.standard_normal((SIDE, SIDE)), 2.0)
    coarse = gaussian_filter(rng.standard_normal((SIDE, SIDE)), 12.0)
    return 300.0 + 2.0 * fine / fine.std() + 2.0 * coarse / coarse.std()


def flight(lines=3, along=7, step_m=14.0, gap_m=22.0):
    """Poses of lines to and fro that look down, (F, 4, 4), and their order."""
    poses = []
    for line in range(lines):
        turn = 180.0 * (line % 2)
        for number in range(along):
            pose = np.eye(4)
            north = (number - along // 2) * step_m * (1.0 if line % 2 == 0 else -1.0)
            pose[:3, 3] = (line - lines // 2) * gap_m, north, FLIGHT_M
            # The image's right is east and its top north, for yaw 0.
            pose[:3, :3] = (Rotation.from_euler("z", -turn, degrees=True)
                            * Rotation.from_matrix([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])).as_matrix()  # fmt: skip
            poses.append(pose)
    return np.array(poses)


def frame(pose, lens, ground=hill, temperature=None):
    """A frame (H, W) [K] from a pose, by bisection of each ray between 0 and 1.5 flight heights."""
    temperature = texture() if temperature is None else temperature
    focal, right, down, k1, k2 = lens
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    x, y = (column - 0.5 * WIDTH - right) / focal, (row - 0.5 * HEIGHT - down) / focal
    s, t = x.copy(), y.copy()
    for _ in range(60):
        r2 = s**2 + t**2
        radial = 1.0 + r2 * (k1 + k2 * r2)
        s, t = x / radial, y / radial
    way = np.stack([s, t, np.ones_like(s)], axis=-1) @ pose[:3, :3].T
    near, far = np.zeros(s.shape), np.full(s.shape, 1.5 * FLIGHT_M)
    for _ in range(40):
        middle = 0.5 * (near + far)
        point = pose[:3, 3] + middle[..., None] * way
        above = point[..., 2] > ground(point[..., 0], point[..., 1])
        near, far = np.where(above, middle, near), np.where(above, far, middle)
    point = pose[:3, 3] + near[..., None] * way
    place = [point[..., axis] / STEP_M + 0.5 * SIDE for axis in (1, 0)]
    return map_coordinates(temperature, place, order=1, mode="nearest").astype(np.float32)


def measured_poses(poses, metres, degrees, seed=1):
    """Poses with errors of these standard deviations along and about each axis."""
    rng = np.random.default_rng(seed)
    found = poses.copy()
    found[:, :3, 3] += rng.normal(0.0, metres, (len(poses), 3))
    turns = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal((len(poses), 3)))
    found[:, :3, :3] = turns.as_matrix() @ poses[:, :3, :3]
    return found
