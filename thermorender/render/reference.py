"""The reference engine: stock Mitsuba path tracing of the same scene, to say how wrong the renderer is.

A spectral variant, a `specfilm` with the camera's band as its response, a stock path integrator, stock diffuse
surfaces and area emitters. The only part of our own is a small texture: Planck radiance of a temperature map
times its material's emissivity, or the reflectance. It shares no transport, bake, plan or node with the renderer;
its wavelengths are sampled at random, so its error is noise that falls with the square root of the samples.
"""

import itertools

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics.planck import C1L, C2
from thermorender.render.geometry import box_of
from thermorender.render.mirrors import directional
from thermorender.render.renderer import checked_pose
from thermorender.render.variant import activate

VARIANTS = {"llvm_ad_mono": "llvm_ad_spectral", "cuda_ad_mono": "cuda_ad_spectral"}
_NAMES = itertools.count()
_SAMPLES_AT_ONCE = 64


def render(scene, pose, samples=64, depth=8, seed=0, device="auto", integrator="path", progress=None):
    """Return band radiance by path tracing, (H, W) float64 [W m⁻² sr⁻¹].

    Parameters
    ----------
    scene : Scene
    pose : (4, 4) array
        world_from_camera.
    samples : int
        Paths per pixel.
    depth : int
        Longest path, counted in surfaces seen.
    seed : int
    device : {"auto", "cpu", "cuda"}
    integrator : {"path", "direct"}
        Mitsuba's; "direct" sees one reflection only.
    progress : callable, optional
        Called with the share done.

    Raises
    ------
    ThermorenderError
        A camera with distortion, a pose that is no rigid transform, samples below 1, a directional material, air.
    """
    pose = checked_pose(pose)
    camera = scene.camera
    if any(camera.distortion) or any(camera.principal_offset_px):
        raise ThermorenderError(
            f"camera {camera.name}: the reference engine has no distortion or principal offset; use another camera"
        )
    mirrors = [scene.materials[number].name for number in directional(scene.materials)]
    if mirrors:
        raise ThermorenderError(
            f"material {mirrors[0]!r} depends on the angle of view, which the reference engine does not know; give a "
            "Lambertian one, such as 'water', 'ice' or 'glass'"
        )
    if scene.air is not None:
        raise ThermorenderError(
            f"scene {scene.name!r} has [atmosphere], which the reference engine does not know; give it a [sky] instead"
        )
    if samples < 1:
        raise ThermorenderError(f"samples={samples} is not allowed; give at least 1 path per pixel")
    mi = activate(device)
    before = mi.variant()
    mi.set_variant(VARIANTS[before])
    try:
        world = mitsuba_scene(mi, scene, pose, integrator, depth)
        total, done = np.zeros((camera.height, camera.width)), 0
        while done < samples:
            count = min(_SAMPLES_AT_ONCE, samples - done)
            # Every part has a seed of its own; the sum over parts is one render of all samples.
            image = mi.render(world, spp=count, seed=(seed << 12) + done)
            total += np.array(image)[..., 0].astype(np.float64) * count
            done += count
            if progress:
                progress(done / samples)
        # The film integrates over nanometres what is radiance per micrometre.
        return total / samples * 1e-3
    finally:
        mi.set_variant(before)


def frame(renderer, pose, samples=64, depth=8, progress=None):
    """Return the Frame of a pose with its radiance path traced; sensor and truth are the renderer's.

    Parameters
    ----------
    renderer : Renderer
    pose, samples, depth, progress
        As in `render`.
    """
    radiance = render(renderer.scene, pose, samples, depth, renderer.seed, progress=progress)
    plan = {"engine": "reference", "paths": samples, "depth": depth}
    return renderer.frame_of(radiance.astype(np.float32), pose, plan)


def squared_error(frame, first, second):
    """Return (mean squared error, its standard error) of an image against two independent noisy references.

    Parameters
    ----------
    frame, first, second : (…) arrays
        The image to be judged, and two renders of the truth with independent noise.

    Notes
    -----
    mean((f − a)(f − b)) is an unbiased estimate of mean((f − truth)²): the noise of a and b is independent, so it
    does not add up as it would in mean((f − a)²).
    """
    product = ((frame - first) * (frame - second)).ravel()
    product = product[np.isfinite(product)]
    return float(product.mean()), float(product.std(ddof=1) / np.sqrt(product.size))


def mitsuba_scene(mi, scene, pose, integrator, depth):
    """Return the Mitsuba scene of stock plugins and the thermal texture, for the active spectral variant."""
    scene.refuse_unwarmed()
    name = f"thermal{next(_NAMES)}"
    limits = box_of(scene)
    middle = float(limits[:, 2].mean())
    _register(mi, name, scene, horizon_m=middle)
    camera = scene.camera
    lower, upper = (1e3 * edge for edge in camera.band_um)
    to_world = pose.copy()
    # Mitsuba's camera looks along +z with x to the left and y up.
    to_world[:3, :2] *= -1.0
    parts = {
        "type": "scene",
        "embree_use_robust_intersections": True,
        "integrator": {"type": integrator, **({"max_depth": depth, "rr_depth": depth} if integrator == "path" else {})},
        "sensor": {
            "type": "perspective",
            "fov": camera.field_of_view_deg[0],
            "fov_axis": "x",
            "near_clip": 1e-3,
            "far_clip": 1e9,
            "to_world": mi.ScalarTransform4f(to_world),
            "sampler": {"type": "multijitter"},
            "film": {
                "type": "specfilm",
                "width": camera.width,
                "height": camera.height,
                "component_format": "float32",
                "rfilter": {"type": "box"},
                "band": {"type": "regular", "wavelength_min": lower, "wavelength_max": upper, "values": "1, 1"},
            },
        },
    }
    # So large that its horizon is that of the camera and of every point of the scene to 1e-3 rad.
    reach = 1e3 * max(float(np.abs(limits).max()), float(np.abs(pose[:3, 3]).max()))
    parts["outside"] = {
        "type": "sphere",
        "radius": reach,
        "center": [0.0, 0.0, middle],
        "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
        "emitter": {"type": "area", "radiance": {"type": name, "what": "outside", "surface": 0}},
    }
    for number, surface in enumerate(scene.surfaces):
        parts[f"s{number}"] = _mesh(mi, name, number, surface, scene.terrain_count)
    return mi.load_dict(parts)


def _mesh(mi, name, number, surface, terrain_count):
    """A surface as a stock mesh with map coordinates, a two-sided diffuse material and an area emitter."""
    properties = mi.Properties()
    texture = {"type": name, "surface": number}
    diffuse = {"type": "diffuse", "reflectance": {**texture, "what": "reflectance"}}
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": diffuse})
    properties["emitter"] = mi.load_dict({"type": "area", "radiance": {**texture, "what": "emission"}})
    # Corners are not shared, since each face has map coordinates of its own.
    corners, uv = surface.vertices[surface.faces], surface.uv
    if number >= terrain_count:
        # A stock area emitter shines to one side; a second skin, a millimetre behind, is the other.
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        corners = np.concatenate([corners, (corners - 1e-3 * normal[:, None])[:, ::-1]])
        uv = np.concatenate([uv, uv[:, ::-1]])
    corners = corners.reshape(-1, 3)
    mesh = mi.Mesh(f"s{number}", len(corners), len(corners) // 3, has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = corners.astype(np.float32).ravel()
    parameters["faces"] = np.arange(len(corners), dtype=np.uint32)
    parameters["vertex_texcoords"] = uv.reshape(-1, 2).astype(np.float32).ravel()
    parameters.update()
    return mesh


def _register(mi, name, scene, horizon_m):
    """Register the texture: spectral radiance, emissivity or reflectance of a surface's texels."""
    import drjit as dr

    outside = scene.spec.sky_temperature, scene.surroundings_temperature
    grid = np.linspace(*scene.camera.band_um, 2401)
    table = np.array([material.emissivity_at(grid) for material in scene.materials])
    spectra = mi.Float(table.astype(np.float32).ravel())
    start, step = float(grid[0]), float(grid[1] - grid[0])
    maps = [
        (
            surface.material.shape,
            mi.Float(surface.temperature.astype(np.float32).ravel()),
            mi.UInt32(surface.material.astype(np.uint32).ravel()),
        )
        for surface in scene.surfaces
    ]

    def planck(wavelength, temperature):
        return C1L / wavelength**5 / (dr.exp(C2 / (wavelength * temperature)) - 1.0)

    class Thermal(mi.Texture):
        def __init__(self, properties):
            mi.Texture.__init__(self, properties)
            self.what, self.surface = properties["what"], int(properties["surface"])

        def eval(self, si, active=True):
            wavelength = si.wavelengths * 1e-3
            if self.what == "outside":
                up = si.p.z >= horizon_m
                warm = [planck(wavelength, t) if t > 0.0 else wavelength * 0.0 for t in outside]
                return dr.select(up, *warm) & active
            (rows, columns), temperature, material = maps[self.surface]
            x, y = si.uv.x * columns - 0.5, si.uv.y * rows - 0.5
            left, top = dr.floor(x), dr.floor(y)
            fx, fy = x - left, y - top
            result = wavelength * 0.0
            position = (wavelength - start) / step
            corners = ((0, 0, (1 - fx) * (1 - fy)), (0, 1, fx * (1 - fy)), (1, 0, (1 - fx) * fy), (1, 1, fx * fy))
            for di, dj, share in corners:
                row = dr.clip(mi.Int32(top) + di, 0, rows - 1)
                column = dr.clip(mi.Int32(left) + dj, 0, columns - 1)
                index = mi.UInt32(row * columns + column)
                base = dr.gather(mi.UInt32, material, index, active) * len(grid)
                epsilon = mi.UnpolarizedSpectrum(0.0)
                for k in range(len(epsilon)):
                    lower = mi.UInt32(dr.clip(position[k], 0.0, len(grid) - 2.0))
                    weight = position[k] - mi.Float(lower)
                    epsilon[k] = dr.lerp(
                        dr.gather(mi.Float, spectra, base + lower, active),
                        dr.gather(mi.Float, spectra, base + lower + 1, active),
                        weight,
                    )
                if self.what == "emission":
                    value = epsilon * planck(wavelength, dr.gather(mi.Float, temperature, index, active))
                else:
                    value = 1.0 - epsilon
                result += share * value
            return result & active

        def mean(self):
            return mi.Float(0.5)

        def is_spatially_varying(self):
            return True

        def to_string(self):
            return f"Thermal[{self.what}]"

    mi.register_texture(name, Thermal)
