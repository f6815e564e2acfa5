"""Scenes in memory for studies and tests: from any surfaces, and a rough terrain of a given size."""

from pathlib import Path

import numpy as np

from thermorender import defaults
from thermorender.errors import ThermorenderError
from thermorender.materials import library as material_tables
from thermorender.scene.scene import Scene
from thermorender.scene.spec import EmissivitySpec, SceneSpec, TemperatureSpec, TerrainSpec
from thermorender.scene.surface import SURFACE, Surface
from thermorender.sensor.camera import load_camera


def terrain(triangles, texels=None, seed=0, side_m=400.0):
    """Return a Scene of a rough terrain in memory.

    Parameters
    ----------
    triangles : int
        Approximate number of triangles; exact if half of it is a square number, as for 2 million.
    texels : int, optional
        Texels along each side; two per cell by default.
    seed : int
    side_m : float
        Side of the terrain [m].

    Raises
    ------
    ThermorenderError
        Fewer than 8 triangles, or no texel.

    Notes
    -----
    Heights are hills of 6 m with a spectrum falling as frequency^−2.4, and bushes of up to 2 m. Texels are grass,
    sand and loam between 285 and 305 K, the materials in patches.
    """
    if triangles < 8:
        raise ThermorenderError(f"triangles={triangles} is not allowed; give 8 or more")
    if texels is not None and texels < 1:
        raise ThermorenderError(f"texels={texels} is not allowed; give 1 or more along each side")
    rows = int(np.sqrt(triangles / 2))
    columns = round(triangles / 2 / rows)
    rng = np.random.Generator(np.random.Philox(seed))
    hills = 6.0 * _noise(rng, (rows + 1, columns + 1), 2.4)
    height = hills + np.clip(_noise(rng, hills.shape, 1.0) - 1.0, 0.0, 1.0) * 2.0
    east = np.linspace(-0.5, 0.5, columns + 1) * side_m
    north = np.linspace(0.5, -0.5, rows + 1) * side_m
    vertices = np.stack([*np.meshgrid(east, north), height], axis=-1).reshape(-1, 3)
    index = np.arange(len(vertices), dtype=np.int32).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.stack([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)], axis=2).reshape(-1, 3)
    u, v = np.meshgrid(np.linspace(0.0, 1.0, columns + 1), np.linspace(0.0, 1.0, rows + 1))
    shape = (texels, texels) if texels else (2 * rows, 2 * columns)
    patches = _noise(rng, shape, 1.8)
    surface = Surface(
        name="terrain",
        vertices=vertices,
        faces=faces,
        uv=np.stack([u, v], axis=-1).reshape(-1, 2)[faces].astype(np.float32),
        colour=np.full((*shape, 3), 128, np.uint8),
        material=((patches > 0.0).astype(np.uint8) + (patches > 0.8)).astype(np.uint8),
        temperature=np.clip(295.0 + 4.0 * _noise(rng, shape, 1.0), 285.0, 305.0).astype(np.float32),
        flags=np.full(shape, SURFACE, np.uint8),
        texel_m=side_m / shape[1],
    )
    library = material_tables.load_library()
    names = ("grass_green", "soil_loam", "sand_quartz")
    return in_memory(f"{2 * rows * columns} triangles", (surface,), [library[name] for name in names])


def in_memory(name, surfaces, materials, sky=260.0, surroundings=None, camera=defaults.CAMERA, terrain_count=None):
    """Return a Scene of surfaces in memory, without files, a position on Earth or objects."""
    spec = SceneSpec(
        folder=Path(name), title=name,
        terrain=TerrainSpec(None, None, None, "ellipsoid", None),
        temperature=TemperatureSpec("raster"),
        emissivity=EmissivitySpec("classes", None, None, None, {}),
        sky_temperature=sky, surroundings_temperature=surroundings, camera=camera,
        truth_temperature=None, frame=None, objects=(),
    )  # fmt: skip
    return Scene.of_surfaces(spec, surfaces, materials, load_camera(camera), terrain_count)


def _noise(rng, shape, fall):
    """Return Gaussian noise (h, w) of unit variance whose amplitude falls as frequency^−fall."""
    along, across = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    frequency = np.hypot(along, across)
    frequency[0, 0] = np.inf
    values = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * frequency**-fall, s=shape)
    return values / values.std()
