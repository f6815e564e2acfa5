"""Procedural scenes in three dimensions: the ground under all objects, buildings with walls, and porous plants.

`thermorender.campaign.three_d` lights and solves a World, and derives from it the surface model and the orthophoto that
a survey from above would give.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.light import normals
from thermorender.apps.lands.procedural.procedural_scene import SyntheticScene, painted, scene_of
from thermorender.apps.lands.solids.skin import Skin
from thermorender.errors import ThermorenderError
from thermorender.physics.srgb import bytes_from_linear
from thermorender.scene.spec import WeatherSpec

GROUND, BUILDINGS, PLANTS = "ground", "buildings", "plants"
# Distance of the ground's posts [m]: walls and crowns are not in it, so that it is smooth.
_POST_M = 1.0


@dataclass(frozen=True, eq=False)
class World:
    """A procedural scene in three dimensions, unlit."""

    scene: SyntheticScene  # Of the bare ground: its elevation, classes, deviations and weather
    skins: tuple[Skin, ...]  # The ground first; coloured by albedo. Heights are above the ellipsoid.
    ground_normal: NDArray[np.float32]  # (3, N, N) float32 normals of the ground's texels with their small relief


def make_world(
    kind: str, seed: int = 0, size_m: float | None = None, texel_m: float | None = None, post_m: float | None = None,
    time: str | np.datetime64 | None = None, weather: WeatherSpec | None = None, again: int = 0,
) -> World:  # fmt: skip
    """Return a procedural scene in three dimensions; arguments, layout and seeds are those of `make`."""
    if weather is not None and weather.snow_depth_m:
        raise ThermorenderError(
            f"snow_depth_m={weather.snow_depth_m:g}: snow on walls and crowns is not modelled; give 0, or leave "
            "three_d out"
        )
    made = painted(kind, seed, size_m, texel_m, post_m, time, weather, again, solid=True)
    canvas, solids = made.canvas, made.canvas.solids
    assert solids is not None
    normal = np.stack(normals(canvas.surface + canvas.relief, made.texel, steepest=1.3))
    skins = [_ground(made.canvas.surface, canvas.albedo, canvas.material, made.size)]
    if len(solids.quads):
        skins.append(solids.quads.skin(BUILDINGS))
    if solids.plants.faces:
        skins.append(solids.plants.skin(PLANTS))
    return World(scene_of(made), (skins[0], *(_within(skin, 0.5 * made.size) for skin in skins[1:])), normal)


def _within(skin: Skin, half: float) -> Skin:
    """A Skin without the faces beyond the ground's edge."""
    inside = (np.abs(skin.vertices[skin.faces].mean(axis=1)[:, :2]) <= half).all(axis=1)
    return replace(skin, faces=skin.faces[inside], uv=skin.uv[inside])


def _ground(
    surface: NDArray[np.float32], albedo: NDArray[np.float32], material: NDArray[np.uint8], size: float
) -> Skin:
    """The ground as a Skin of cells of about 1 m, whose corners have the mean heights around them."""
    import cv2

    count = max(2, round(size / _POST_M))
    cells = cv2.resize(surface - surface.mean(), (count, count), interpolation=cv2.INTER_AREA)
    around = np.pad(cells, 1, "edge").astype(np.float64)
    post = 0.25 * (around[:-1, :-1] + around[:-1, 1:] + around[1:, :-1] + around[1:, 1:]) + float(surface.mean())
    line = np.arange(count + 1) / count
    u, v = np.meshgrid(line, line)
    vertices = np.stack([(u - 0.5) * size, (0.5 - v) * size, post], axis=-1).reshape(-1, 3)
    index = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)])
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)[faces].astype(np.float32)
    return Skin(GROUND, vertices, faces, uv, bytes_from_linear(np.clip(albedo, 0.0, 1.0)), material)
