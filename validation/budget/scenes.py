"""Views for which the stated error of a frame is tested: chosen ones of shipped and made scenes, and drawn ones."""

from dataclasses import dataclass

import numpy as np

from thermorender.materials.library import load_library
from thermorender.scene.surface import SURFACE, Surface
from thermorender.trajectory import path
from validation.made_scenes import in_memory

# (height above ground [m], pitch [deg]) of the chosen views of shipped scenes; the last shows the horizon.
CHOSEN = ((120, -90), (420, -90), (1200, -90), (3000, -90), (10_000, -90), (120, -45), (420, -45), (1200, -45),
          (300, -15), (60, -4))  # fmt: skip
# Views are drawn evenly in the logarithm of height and in pitch.
HEIGHTS_M, PITCHES_DEG = (20.0, 20_000.0), (-90.0, -10.0)
_TEXELS = 1536


@dataclass(frozen=True)
class View:
    """A camera above the middle of a scene, looking at it.

    Attributes
    ----------
    height_m, pitch_deg, yaw_deg : float
        Height above the ground at the middle; a pitch of −90° looks down.
    """

    height_m: float
    pitch_deg: float
    yaw_deg: float = 20.0

    @property
    def name(self):
        """Its name in tables."""
        return f"{self.height_m:.0f} m, {-self.pitch_deg:.0f}°"

    def pose(self, scene):
        """Return world_from_camera."""
        vertices = np.concatenate([surface.vertices for surface in scene.surfaces[: scene.terrain_count]])
        east, north = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))[:2]
        ground = float(scene.ground(east, north))
        back = self.height_m / np.tan(np.radians(-self.pitch_deg))
        yaw = np.radians(self.yaw_deg)
        return path.pose(
            east - back * np.sin(yaw), north - back * np.cos(yaw),
            self.height_m + (ground if np.isfinite(ground) else vertices[:, 2].max()),
            yaw_deg=self.yaw_deg, pitch_deg=self.pitch_deg,
        )  # fmt: skip


def drawn(count, seed=0):
    """Return `count` Views drawn from a seed."""
    random = np.random.Generator(np.random.Philox(seed))
    height = np.exp(random.uniform(*np.log(HEIGHTS_M), count))
    pitch, yaw = random.uniform(*PITCHES_DEG, count), random.uniform(0.0, 360.0, count)
    return [View(*(float(value) for value in values)) for values in zip(height, pitch, yaw, strict=True)]


def made(seed=0):
    """Return [(Scene, Views)] of scenes in memory that are hard to sample, with their hardest views."""
    random = np.random.Generator(np.random.Philox(seed))
    shape, library = (_TEXELS, _TEXELS), load_library()
    near, far = 0.157 / 2.5, 0.12
    kinds = random.integers(0, 3, shape)
    ground = [library[name] for name in ("soil_loam", "grass_green", "asphalt")]
    warm = np.array([300.0, 294.0, 312.0])[kinds] + random.normal(0.0, 1.0, shape)
    texels = in_memory("random texels", [level(near, kinds, warm)], ground)
    checker = np.indices(shape).sum(axis=0) % 2
    brass = in_memory("brass checker", [level(near, checker, np.full(shape, 300.0))], [ground[0], library["brass"]])
    fire = np.where(random.random(shape) < 0.005, 900.0, 295.0)
    specks = in_memory("fire specks", [level(far, np.zeros(shape, int), fire)], ground[:1])
    posts = [level(far, np.zeros(shape, int), np.full(shape, 295.0))]
    posts += [box(f"post {number}", random.uniform(-60.0, 60.0, 2), (0.04, 0.04, 2.5), 420.0) for number in range(60)]
    posts = in_memory("posts of 4 cm", posts, [ground[0], library["paint_black"]])
    above = (View(120, -90), View(120, -45))
    return [
        (texels, (*above, View(600, -90))),
        (brass, (*above, View(600, -90))),
        (specks, (View(305, -90), View(305, -45), View(1500, -90))),
        (posts.with_surfaces(terrain_count=1), (*above, View(420, -90), View(3000, -45))),
    ]


def level(texel_m, material, temperature):
    """Return a Surface of level ground at 0 m, two triangles; material and temperature [K] are (rows, columns)."""
    half = 0.5 * texel_m * np.array(material.shape[::-1])
    corner = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    faces = np.array([[0, 3, 1], [1, 3, 2]], np.int32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)[faces]
    vertices = np.column_stack([corner * half, np.zeros(4)])
    return _surface("terrain", vertices, faces, uv, material, temperature, texel_m)


def box(name, place, size, kelvin):
    """Return a Surface of a box of `size` [m] on the ground at `place` (east, north) [m], of the second material."""
    import trimesh

    solid = trimesh.creation.box(extents=size)
    vertices = np.asarray(solid.vertices) + [*place, 0.5 * size[2]]
    faces = np.asarray(solid.faces, np.int32)
    uv = np.full((len(faces), 3, 2), 0.5, np.float32)
    return _surface(name, vertices, faces, uv, np.ones((1, 1), int), np.full((1, 1), kelvin), size[0])


def _surface(name, vertices, faces, uv, material, temperature, texel_m):
    return Surface(
        name=name, vertices=vertices, faces=faces, uv=uv, colour=np.full((*material.shape, 3), 128, np.uint8),
        material=material.astype(np.uint8), temperature=temperature.astype(np.float32),
        flags=np.full(material.shape, SURFACE, np.uint8), texel_m=texel_m,
    )  # fmt: skip
