"""The reference engine: stock Mitsuba path tracing of the same scene, to measure the renderer's error.

It uses a spectral variant, a `specfilm` with the camera's band as its response, a stock path integrator, stock diffuse
surfaces and area emitters. Three plugins are our own: a texture (Planck radiance of a temperature map times emissivity,
or the reflectance), surfaces that are diffuse at some texels and mirrors at others, and a sensor for any lens. It
shares no transport, bake, plan or node with the renderer. Wavelengths are sampled at random, so its error is Monte
Carlo noise.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.frame import Frame
from thermorender.physics.fresnel import COSINES
from thermorender.physics.planck import C1L, C2
from thermorender.render.arrays import Floats, Jit, Mitsuba, aligned
from thermorender.render.geometry import box_of
from thermorender.render.pixels.shapes import positions
from thermorender.render.reflection.reflectance import directional
from thermorender.render.renderer import Renderer
from thermorender.render.variant import activate, switch
from thermorender.scene.instances import expanded
from thermorender.scene.scene import Scene
from thermorender.scene.surface import Surface
from thermorender.sensor.camera import Camera
from thermorender.trajectory.rotations import checked_pose

VARIANTS = {"llvm_ad_mono": "llvm_ad_spectral", "cuda_ad_mono": "cuda_ad_spectral"}
_NAMES = itertools.count()
_SAMPLES_AT_ONCE = 64
# Distance of the copies behind faces, relative to the largest coordinate or to the length of the rays; short rays see
# no more than this [m].
_BEHIND, _MOST_BEHIND_M = 64.0 * 2.0**-24, 1e-3
# Share of the camera's distance from the scene after which its rays start.
_AHEAD = 0.99


@dataclass
class _Lent:
    """Large arrays on their way to plugin instances, which end with their scene.

    Mitsuba keeps registered classes until the process ends, so they hold this object and not the arrays. Its fields are
    None once the instances exist.
    """

    texels: Any  # What `_texel_reader` returns
    slopes: Jit = None  # Camera rays (x/z, y/z) at the pixels' corners


def render(
    scene: Scene, pose: ArrayLike, samples: int = 64, depth: int = 8, seed: int = 0, device: str = "auto",
    integrator: str = "path", progress: Callable[[float], object] | None = None,
) -> Floats:  # fmt: skip
    """Return band radiance by path tracing, (H, W) float64 [W m⁻² sr⁻¹], from `pose` (4, 4) world_from_camera with
    `samples` paths per pixel of up to `depth` surfaces. `integrator` is Mitsuba's "path", or "direct" with one
    reflection only."""
    pose = checked_pose(pose)
    camera = scene.camera
    if scene.air is not None:
        raise ThermorenderError(
            f"scene {scene.name!r} has [atmosphere], which the reference engine does not support; give [sky] instead"
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
            # Every part has its own seed; the sum over parts is one render of all samples.
            image = mi.render(world, spp=count, seed=(seed << 12) + done)
            total += np.array(image)[..., 0].astype(np.float64) * count
            done += count
            if progress:
                progress(done / samples)
        # The film integrates radiance per micrometre over nanometres.
        return total / samples * 1e-3
    finally:
        switch(mi, before)


def frame(
    renderer: Renderer, pose: ArrayLike, samples: int = 64, depth: int = 8,
    progress: Callable[[float], object] | None = None,
) -> Frame:  # fmt: skip
    """Return the Frame of a pose with its radiance path traced; sensor and truth are the renderer's."""
    renderer.scene.refuse_tiles("the reference")
    radiance = render(renderer.scene, pose, samples, depth, renderer.seed, progress=progress)
    plan = {"engine": "reference", "paths": samples, "depth": depth}
    return renderer.frame_of(radiance.astype(np.float32), pose, plan)


def squared_error(frame: NDArray[Any], first: NDArray[Any], second: NDArray[Any]) -> tuple[float, float]:
    """Return (mean squared error, its standard error) of an image f against independent noisy references a and b.
    mean((f − a)(f − b)) is unbiased, as the noise of a and b is independent."""
    product = ((frame - first) * (frame - second)).ravel()
    product = product[np.isfinite(product)]
    return float(product.mean()), float(product.std(ddof=1) / np.sqrt(product.size))


def mitsuba_scene(
    mi: Mitsuba, scene: Scene, pose: Floats, integrator: str, depth: int, sampler: str = "independent"
) -> Jit:
    """Return the Mitsuba scene of stock plugins and our three parts, for the active spectral variant.

    Mitsuba's stratified samplers have less noise, and correlate neighbouring pixels and the dimensions of a path. The
    mean over a trench of metallic paint is off by 11 mK with "multijitter" and by 15 mK with "stratified".
    """
    scene.refuse_disagreement()
    scene.refuse_unsolved()
    number = next(_NAMES)
    name, lens = f"thermal{number}", f"lens{number}"
    limits = box_of(scene)
    # Hits of rays from far away are no nearer to a face than the rounding of their length.
    eye = pose[:3, 3]
    ahead_m = _AHEAD * float(np.linalg.norm(np.maximum(np.maximum(limits[0] - eye, eye - limits[1]), 0.0)))
    middle = float(limits[:, 2].mean())
    loaded = _Lent(texels=_texel_reader(mi, scene))
    outside = scene.sky_temperature, scene.surroundings_temperature
    mi.register_texture(name, _texture(mi, outside, middle, loaded))
    mi.register_bsdf(f"{name}-mirror", _mirror(mi, loaded))
    camera = scene.camera
    _register_lens(mi, lens, camera, pose, ahead_m, loaded)
    lower, upper = (1e3 * edge for edge in camera.band_um)
    parts: dict[str, Any] = {
        "type": "scene",
        "embree_use_robust_intersections": True,
        "integrator": {"type": integrator, **({"max_depth": depth, "rr_depth": depth} if integrator == "path" else {})},
        "sensor": {
            "type": lens,
            "sampler": {"type": sampler},
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
    # So large that its horizon is the camera's and that of every point of the scene to 1e-3 rad.
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
        parts[f"s{number}"] = _mesh(mi, name, number, surface, eye, ahead_m, mirrors)
    world = mi.load_dict(parts)
    loaded.texels = loaded.slopes = None
    return world


def _register_lens(mi: Mitsuba, name: str, camera: Camera, pose: Floats, ahead_m: float, loaded: _Lent) -> None:
    """Register the sensor: a camera's rays through its distortion and principal point, exact at the pixels' corners and
    bilinear between them: within a pixel a lens is linear to 3e-4 of a pixel, up to k1 = −0.26. They start `ahead_m`
    [m] in front of the camera."""
    width, height = camera.width, camera.height
    place = np.stack(np.meshgrid(np.arange(width + 1.0), np.arange(height + 1.0)), axis=-1)
    loaded.slopes = mi.Float(aligned(camera.directions(place)))
    rotation, origin = mi.Matrix3f(pose[:3, :3]), mi.Point3f(pose[:3, 3])

    class Lens(mi.Sensor):
        def __init__(self, properties: Any) -> None:
            mi.Sensor.__init__(self, properties)
            self.slopes = loaded.slopes

        def sample_ray(
            self, time: Jit, wavelength_sample: Jit, position_sample: Jit, aperture_sample: Jit, active: Jit = True
        ) -> Jit:
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength_sample, active)
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
            return mi.Ray3f(origin + ahead_m * direction, direction, time, wavelengths), weight

        def sample_ray_differential(
            self, time: Jit, wavelength_sample: Jit, position_sample: Jit, aperture_sample: Jit, active: Jit = True
        ) -> Jit:
            ray, weight = self.sample_ray(time, wavelength_sample, position_sample, aperture_sample, active)
            return mi.RayDifferential3f(ray), weight

    mi.register_sensor(name, Lens)


def _mesh(
    mi: Mitsuba, name: str, number: int, surface: Surface, eye: Floats, ahead_m: float, mirrors: NDArray[np.bool_]
) -> Jit:
    """A surface as a stock mesh with map coordinates, a two-sided material and an area emitter; `mirrors` (M,) are
    directional. Rays start `ahead_m` [m] in front of the camera, which is at `eye` (3,)."""
    properties = mi.Properties()
    texture = {"type": name, "surface": number}
    diffuse = {"type": "diffuse", "reflectance": {**texture, "what": "reflectance"}}
    # Mitsuba samples an emitter with a texture by its map: a point of the map must show one point of the surface, which
    # both sides, one-texel bodies and mirrored maps do not. Paths find emitters by chance instead.
    emitter = {"type": "area", "radiance": {**texture, "what": "emission"}, "sampling_weight": 0.0}
    if mirrors[np.unique(surface.material)].any():
        properties["bsdf"] = mi.load_dict({"type": f"{name}-mirror", "surface": number})
    else:
        properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": diffuse})
    properties["emitter"] = mi.load_dict(emitter)
    # Corners are not shared, as each face has its own map coordinates.
    surface = expanded(surface)
    corners, uv = surface.vertices[surface.faces], surface.uv
    # A stock area emitter radiates to one side; a copy behind it radiates to the other, so that a surface emits to both
    # sides as in frames. The copy sticks out round the edges of thin bodies and of steep ground, dark from one side, so
    # it is as near as rays tell apart.
    reach = max(float(np.abs(corners).max()), float(np.abs(eye).max()) - ahead_m)
    nearest = float(np.linalg.norm(corners - eye, axis=-1).min()) - ahead_m
    behind = min(_BEHIND * (1.0 + reach), max(_MOST_BEHIND_M, _BEHIND * nearest))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-300)
    corners = np.concatenate([corners, (corners - behind * normal[:, None])[:, ::-1]])
    uv = np.concatenate([uv, uv[:, ::-1]])
    corners = corners.reshape(-1, 3)
    mesh = mi.Mesh(f"s{number}", len(corners), len(corners) // 3, has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = positions(corners)
    parameters["faces"] = np.arange(len(corners), dtype=np.uint32)
    parameters["vertex_texcoords"] = uv.reshape(-1, 2).astype(np.float32).ravel()
    parameters.update()
    return mesh


def _texel_reader(mi: Mitsuba, scene: Scene) -> Callable[..., Iterator[tuple[Jit, Jit, Jit, Jit]]]:
    """A generator function of the four texels round a surface interaction, for the active spectral variant."""
    grid = np.linspace(*scene.camera.band_um, 2401)
    table = np.array([material.emissivity_at(grid) for material in scene.materials])
    spectra = mi.Float(aligned(table))
    start, step = float(grid[0]), float(grid[1] - grid[0])
    # Emissivity of directional materials by angle and wavelength; row 0 stands for other materials.
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

    def spectrum(values: Jit, base: Jit, wavelength: Jit, active: Jit) -> Jit:
        """Values of rows that begin at `base`, linear between wavelengths."""
        position, found = (wavelength - start) / step, mi.UnpolarizedSpectrum(0.0)
        for k in range(len(found)):
            lower = mi.UInt32(dr.clip(position[k], 0.0, len(grid) - 2.0))
            ends = (dr.gather(mi.Float, values, base + lower + more, active) for more in (0, 1))
            found[k] = dr.lerp(*ends, position[k] - mi.Float(lower))
        return found

    def texels(si: Jit, surface: int, active: Jit) -> Iterator[tuple[Jit, Jit, Jit, Jit]]:
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

    return texels


def _planck(wavelength: Jit, temperature: Jit) -> Jit:
    """Spectral radiance [W m⁻² sr⁻¹ µm⁻¹] at wavelengths [µm] and temperatures [K]."""
    return C1L / wavelength**5 / (dr.exp(C2 / (wavelength * temperature)) - 1.0)


def _texture(mi: Mitsuba, outside: tuple[float, float], horizon_m: float, loaded: _Lent) -> type:
    """The texture: spectral radiance emitted at the angle of view, or the reflectance of diffuse materials."""

    class ThermalTexture(mi.Texture):
        def __init__(self, properties: Any) -> None:
            mi.Texture.__init__(self, properties)
            self.what, self.surface = properties["what"], int(properties["surface"])
            self.texels = loaded.texels

        def eval(self, si: Jit, active: Jit = True) -> Jit:
            wavelength = si.wavelengths * 1e-3
            if self.what == "outside":
                up = si.p.z >= horizon_m
                warm = [_planck(wavelength, t) if t > 0.0 else wavelength * 0.0 for t in outside]
                return dr.select(up, *warm) & active
            result = wavelength * 0.0
            for share, temperature, emissivity, _ in self.texels(si, self.surface, active):
                emits = self.what == "emission"
                result += share * (emissivity * _planck(wavelength, temperature) if emits else 1.0 - emissivity)
            return result & active

        def mean(self) -> Jit:
            return mi.Float(0.5)

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"ThermalTexture[{self.what}]"

    return ThermalTexture


def _mirror(mi: Mitsuba, loaded: _Lent) -> type:
    """The material of surfaces that are diffuse at some texels and mirrors at others."""

    class MirrorBSDF(mi.BSDF):
        def __init__(self, properties: Any) -> None:
            mi.BSDF.__init__(self, properties)
            self.surface, self.texels = int(properties["surface"]), loaded.texels
            both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.DiffuseReflection | both, mi.BSDFFlags.DeltaReflection | both]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def _shares(self, si: Jit, active: Jit) -> tuple[Jit, Jit, Jit]:
            """(diffuse, mirrored share of the light, probability of following the mirror)."""
            diffuse, mirrored = mi.UnpolarizedSpectrum(0.0), mi.UnpolarizedSpectrum(0.0)
            for share, _, emissivity, shiny in self.texels(si, self.surface, active):
                diffuse += dr.select(shiny, 0.0, share * (1.0 - emissivity))
                mirrored += dr.select(shiny, share * (1.0 - emissivity), 0.0)
            both = dr.mean(diffuse) + dr.mean(mirrored)
            return diffuse, mirrored, dr.select(both > 0.0, dr.mean(mirrored) / both, 0.0)

        def sample(self, context: Any, si: Jit, sample1: Jit, sample2: Jit, active: Jit = True) -> Jit:
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

        def eval(self, context: Any, si: Jit, wo: Jit, active: Jit = True) -> Jit:
            return self.eval_pdf(context, si, wo, active)[0]

        def pdf(self, context: Any, si: Jit, wo: Jit, active: Jit = True) -> Jit:
            return self.eval_pdf(context, si, wo, active)[1]

        def eval_pdf(self, context: Any, si: Jit, wo: Jit, active: Jit = True) -> tuple[Jit, Jit]:
            diffuse, _, chance = self._shares(si, active)
            cosine = dr.select(si.wi.z * wo.z > 0.0, dr.abs(wo.z), 0.0) / dr.pi
            return diffuse * cosine & active, dr.select(active, (1.0 - chance) * cosine, 0.0)

        def to_string(self) -> str:
            return "MirrorBSDF[]"

    return MirrorBSDF
