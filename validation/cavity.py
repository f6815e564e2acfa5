"""Cavities whose radiance is known in closed form, as the renderer sees them."""

from functools import partial

import numpy as np

from thermorender.materials.material import grey
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.render.renderer import Renderer
from thermorender.scene.surface import SURFACE, Surface
from thermorender.trajectory.path import pose
from validation.made_scenes import in_memory


def cases(emissivities, rays_per_face, device):
    """Yield (name, function that measures it) of cavities, closed and with a tenth of their wall missing."""
    for share in (0.0, 0.1):
        for emissivity in emissivities:
            for rays in rays_per_face:
                setting = f"opening {share:g}, emissivity {emissivity:g}, {rays} rays"
                yield f"cavity/{setting}", partial(measure, setting, share, emissivity, rays, device)


def measure(setting, share, emissivity, rays, device):
    """Return {scene, setting, mean_mk, error_mk} of a spherical cavity with a hole at its top, seen from its middle.

    Notes
    -----
    All of a sphere sees all of it alike: with a share s of its area open to a sky of radiance S, its wall of
    emissivity ε and blackbody radiance B receives x = ((1−s) ε B + s S) / (1 − (1−ε)(1−s)) everywhere.
    """
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.invert()
    whole = ball.area
    # The hole's edge is jagged; what counts is the area that is missing.
    ball.update_faces(ball.triangles_center[:, 2] < (1.0 - 2.0 * share if share else 2.0))
    ball.remove_unreferenced_vertices()
    s = 1.0 - ball.area / whole
    surface = Surface(
        name="wall", vertices=np.array(ball.vertices), faces=np.array(ball.faces, np.int32),
        uv=np.full((len(ball.faces), 3, 2), 0.5, np.float32), colour=np.full((1, 1, 3), 128, np.uint8),
        material=np.zeros((1, 1), np.uint8), temperature=np.full((1, 1), 300.0, np.float32),
        flags=np.full((1, 1), SURFACE, np.uint8), texel_m=1.0,
    )  # fmt: skip
    scene = in_memory("cavity", (surface,), (grey("wall", emissivity),), sky=250.0, surroundings=250.0)
    band = scene.camera.band_um
    black, sky = (float(band_radiance(t, *band)) for t in (300.0, 250.0))
    received = ((1 - s) * emissivity * black + s * sky) / (1 - (1 - emissivity) * (1 - s))
    exact = emissivity * black + (1 - emissivity) * received
    image = Renderer(scene, rays=rays, tolerance_mk=1.0, device=device).radiance(pose(0, 0, 0, pitch_deg=-90.0))
    scale = 1e3 / float(band_radiance_derivative(300.0, *band))
    return {
        "scene": "cavity", "setting": setting, "mean_mk": scale * float(image.astype(np.float64).mean() - exact),
        "error_mk": scale * float(np.sqrt(((image - exact) ** 2).mean())),
    }  # fmt: skip
