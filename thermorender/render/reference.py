"""The reference engine: stock Mitsuba path tracing of the same scene, to say how wrong the renderer is.

A spectral variant, a `specfilm` with the camera's band as its response, a stock path integrator, stock diffuse
surfaces and area emitters. Three small parts are our own: a texture, Planck radiance of a temperature map times its
material's emissivity, or the reflectance; surfaces that are diffuse at some texels and mirrors at others, at every
meeting; and a sensor for cameras of any lens, whose rays start anywhere in a pixel.
It shares no transport, bake, plan or node with the renderer; its wavelengths are sampled at random, so its error is
noise that falls with the square root of the samples.
"""

import itertools
from types import SimpleNamespace

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics.fresnel import COSINES
from thermorender.physics.planck import C1L, C2
from thermorender.render.geometry import aligned, box_of, positions
from thermorender.render.mirrors import directional
from thermorender.render.renderer import checked_pose
from thermorender.render.variant import activate, switch

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
        A pose that is no rigid transform, samples below 1, air.
    """
    pose = checked_pose(pose)
    camera = scene.camera
    if scene.air is not None:
        raise ThermorenderError(
            f"scene {scene.name!r} has [atmosphere], which the reference engine does not know; give it a [sky] instead"
        )
    if samples < 1:
        raise ThermorenderError(f"samples={samples} is not allowed; give at least 1 path per pixel")
    mi = activate(device)
    before = mi.variant()
    switch(mi, VARIANTS[before])
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
        switch(mi, before)


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
    scene.refuse_disagreement()
    scene.refuse_unsolved()
    number = next(_NAMES)
    name, lens = f"thermal{number}", f"lens{number}"
    limits = box_of(scene)
    middle = float(limits[:, 2].mean())
    # Mitsuba keeps what is registered as long as the process lives. So what is large belongs to the instances, which
    # end with their scene, and is here only until they are made.
    loaded = SimpleNamespace()
    _register(mi, name, scene, middle, loaded)
    camera = scene.camera
    _register_lens(mi, lens, camera, pose, loaded)
    lower, upper = (1e3 * edge for edge in camera.band_um)
    parts = {
        "type": "scene",
        "embree_use_robust_intersections": True,
        "integrator": {"type": integrator, **({"max_depth": depth, "rr_depth": depth} if integrator == "path" else {})},
        "sensor": {
            "type": lens,
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
    mirrors = np.isin(np.arange(len(scene.materials)), directional(scene.materials))
    for number, surface in enumerate(scene.surfaces):
        parts[f"s{number}"] = _mesh(mi, name, number, surface, scene.terrain_count, mirrors)
    world = mi.load_dict(parts)
    vars(loaded).clear()
    return world


def _register_lens(mi, name, camera, pose, loaded):
    """Register the sensor: a camera's rays through its distortion and principal point, exact at pixels' corners.

    Between these directions are bilinear: within a pixel a lens is linear to 1e-6 of a pixel.
    """
    import drjit as dr

    width, height = camera.width, camera.height
    place = np.stack(np.meshgrid(np.arange(width + 1.0), np.arange(height + 1.0)), axis=-1)
    loaded.slopes = mi.Float(aligned(camera.directions(place)))
    rotation, origin = mi.Matrix3f(pose[:3, :3]), mi.Point3f(pose[:3, 3])

    class Lens(mi.Sensor):
        def __init__(self, properties):
            mi.Sensor.__init__(self, properties)
            self.slopes = loaded.slopes

        def sample_ray(self, time, wavelength_sample, position_sample, aperture_sample, active=True):
            wavelengths, weight = self.sample_wavelengths(
                dr.zeros(mi.SurfaceInteraction3f), wavelength_sample, active
            )
            column, row = position_sample.x * width, position_sample.y * height
            left = dr.clip(mi.Int32(dr.floor(column)), 0, width - 1)
            top = dr.clip(mi.Int32(dr.floor(row)), 0, height - 1)
            corner = mi.UInt32(top * (width + 1) + left)
            across, down = column - mi.Float(left), row - mi.Float(top)
            near, far = (
                dr.lerp(*(dr.gather(mi.Point2f, self.slopes, corner + line + k, active) for k in (0, 1)), across)
                for line in (0, width + 1)
            )
            slope = dr.lerp(near, far, down)
            direction = rotation @ dr.normalize(mi.Vector3f(slope.x, slope.y, 1.0))
            return mi.Ray3f(origin, direction, time, wavelengths), weight

        def sample_ray_differential(self, time, wavelength_sample, position_sample, aperture_sample, active=True):
            ray, weight = self.sample_ray(time, wavelength_sample, position_sample, aperture_sample, active)
            return mi.RayDifferential3f(ray), weight

    mi.register_sensor(name, Lens)


def _mesh(mi, name, number, surface, terrain_count, mirrors):
    """A surface as a stock mesh with map coordinates, a two-sided material and an area emitter.

    `mirrors` tells which materials are directional, (M,) bool.
    """
    properties = mi.Properties()
    texture = {"type": name, "surface": number}
    diffuse = {"type": "diffuse", "reflectance": {**texture, "what": "reflectance"}}
    emitter = {"type": "area", "radiance": {**texture, "what": "emission"}}
    if mirrors[np.unique(surface.material)].any():
        properties["bsdf"] = mi.load_dict({"type": f"{name}-mirror", "surface": number})
        # Only where it is met is the angle known at which it shines.
        emitter["sampling_weight"] = 0.0
    else:
        properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": diffuse})
    properties["emitter"] = mi.load_dict(emitter)
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
    parameters["vertex_positions"] = positions(corners)
    parameters["faces"] = np.arange(len(corners), dtype=np.uint32)
    parameters["vertex_texcoords"] = uv.reshape(-1, 2).astype(np.float32).ravel()
    parameters.update()
    return mesh


def _register(mi, name, scene, horizon_m, loaded):
    """Register what surfaces are made of, by their texels: a texture and a material.

    The texture is spectral radiance, emitted at the angle of view, or the reflectance of diffuse ones.
    """
    import drjit as dr

    outside = scene.spec.sky_temperature, scene.surroundings_temperature
    grid = np.linspace(*scene.camera.band_um, 2401)
    table = np.array([material.emissivity_at(grid) for material in scene.materials])
    spectra = mi.Float(aligned(table))
    start, step = float(grid[0]), float(grid[1] - grid[0])
    # Of each directional material, by angle and wavelength; 0 is none, others are counted from 1.
    by_angle = directional(scene.materials)
    row = np.zeros(len(scene.materials), dtype=np.uint32)
    row[by_angle] = 1 + np.arange(len(by_angle))
    tables = [scene.materials[k].emissivity_at_angle(grid, COSINES[:, None]) for k in by_angle]
    angles = mi.Float(aligned(np.concatenate([np.zeros(1), *map(np.ravel, tables)])))
    maps = [
        (
            surface.material.shape,
            mi.Float(aligned(surface.temperature)),
            mi.UInt32(aligned(surface.material, np.uint32)),
            mi.UInt32(aligned(row[surface.material], np.uint32)),
        )
        for surface in scene.surfaces
    ]

    def planck(wavelength, temperature):
        return C1L / wavelength**5 / (dr.exp(C2 / (wavelength * temperature)) - 1.0)

    def spectrum(values, base, wavelength, active):
        """Values of rows that begin at `base`, linear between wavelengths."""
        position, found = (wavelength - start) / step, mi.UnpolarizedSpectrum(0.0)
        for k in range(len(found)):
            lower = mi.UInt32(dr.clip(position[k], 0.0, len(grid) - 2.0))
            ends = (dr.gather(mi.Float, values, base + lower + more, active) for more in (0, 1))
            found[k] = dr.lerp(*ends, position[k] - mi.Float(lower))
        return found

    def texels(si, surface, active):
        """Yield (share, temperature, emissivity at the angle of view, whether a mirror) of the four round a point."""
        (rows, columns), temperature, material, mirror = maps[surface]
        wavelength, cosine = si.wavelengths * 1e-3, dr.clip(dr.abs(si.wi.z), 0.0, 1.0)
        place = dr.sqrt(cosine) * (len(COSINES) - 1)
        below = dr.minimum(mi.UInt32(place), len(COSINES) - 2)
        square = dr.square(mi.Float(below))
        across = (place * place - square) / (2.0 * mi.Float(below) + 1.0)
        x, y = si.uv.x * columns - 0.5, si.uv.y * rows - 0.5
        left, top = dr.floor(x), dr.floor(y)
        fx, fy = x - left, y - top
        corners = ((0, 0, (1 - fx) * (1 - fy)), (0, 1, fx * (1 - fy)), (1, 0, (1 - fx) * fy), (1, 1, fx * fy))
        for di, dj, share in corners:
            i = dr.clip(mi.Int32(top) + di, 0, rows - 1)
            j = dr.clip(mi.Int32(left) + dj, 0, columns - 1)
            index = mi.UInt32(i * columns + j)
            number = dr.gather(mi.UInt32, mirror, index, active)
            shiny = active & (number > 0)
            base = dr.gather(mi.UInt32, material, index, active) * len(grid)
            emissivity = spectrum(spectra, base, wavelength, active)
            if by_angle:
                base = 1 + ((number - 1) * len(COSINES) + below) * len(grid)
                ends = (spectrum(angles, base + more, wavelength, shiny) for more in (0, len(grid)))
                emissivity = dr.select(shiny, dr.lerp(*ends, across), emissivity)
            yield share, dr.gather(mi.Float, temperature, index, active), emissivity, shiny

    loaded.texels = texels

    class Thermal(mi.Texture):
        def __init__(self, properties):
            mi.Texture.__init__(self, properties)
            self.what, self.surface = properties["what"], int(properties["surface"])
            self.texels = loaded.texels

        def eval(self, si, active=True):
            wavelength = si.wavelengths * 1e-3
            if self.what == "outside":
                up = si.p.z >= horizon_m
                warm = [planck(wavelength, t) if t > 0.0 else wavelength * 0.0 for t in outside]
                return dr.select(up, *warm) & active
            result = wavelength * 0.0
            for share, temperature, emissivity, _ in self.texels(si, self.surface, active):
                emits = self.what == "emission"
                result += share * (emissivity * planck(wavelength, temperature) if emits else 1.0 - emissivity)
            return result & active

        def mean(self):
            return mi.Float(0.5)

        def is_spatially_varying(self):
            return True

        def to_string(self):
            return f"Thermal[{self.what}]"

    class Mirror(mi.BSDF):
        def __init__(self, properties):
            mi.BSDF.__init__(self, properties)
            self.surface, self.texels = int(properties["surface"]), loaded.texels
            both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.DiffuseReflection | both, mi.BSDFFlags.DeltaReflection | both]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def _shares(self, si, active):
            """(diffuse, mirrored share of the light, chance to follow the mirror)."""
            diffuse, mirrored = mi.UnpolarizedSpectrum(0.0), mi.UnpolarizedSpectrum(0.0)
            for share, _, emissivity, shiny in self.texels(si, self.surface, active):
                diffuse += dr.select(shiny, 0.0, share * (1.0 - emissivity))
                mirrored += dr.select(shiny, share * (1.0 - emissivity), 0.0)
            both = dr.mean(diffuse) + dr.mean(mirrored)
            return diffuse, mirrored, dr.select(both > 0.0, dr.mean(mirrored) / both, 0.0)

        def sample(self, context, si, sample1, sample2, active=True):
            diffuse, mirrored, chance = self._shares(si, active)
            follow = sample1 < chance
            out = mi.warp.square_to_cosine_hemisphere(sample2)
            pdf = mi.warp.square_to_cosine_hemisphere_pdf(out) * (1.0 - chance)
            out.z = dr.mulsign(out.z, si.wi.z)
            found = dr.zeros(mi.BSDFSample3f)
            found.wo = dr.select(follow, mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z), out)
            found.pdf = dr.select(follow, chance, pdf)
            found.eta = 1.0
            kinds = mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DiffuseReflection
            found.sampled_type = dr.select(follow, *(mi.UInt32(+kind) for kind in kinds))
            found.sampled_component = dr.select(follow, mi.UInt32(1), mi.UInt32(0))
            weight = dr.select(follow, mirrored / chance, diffuse / (1.0 - chance))
            return found, weight & (active & (found.pdf > 0.0))

        def eval(self, context, si, wo, active=True):
            return self.eval_pdf(context, si, wo, active)[0]

        def pdf(self, context, si, wo, active=True):
            return self.eval_pdf(context, si, wo, active)[1]

        def eval_pdf(self, context, si, wo, active=True):
            diffuse, _, chance = self._shares(si, active)
            cosine = dr.select(si.wi.z * wo.z > 0.0, dr.abs(wo.z), 0.0) / dr.pi
            return diffuse * cosine & active, dr.select(active, (1.0 - chance) * cosine, 0.0)

        def to_string(self):
            return "Mirror[]"

    mi.register_texture(name, Thermal)
    mi.register_bsdf(f"{name}-mirror", Mirror)
