"""Cost of single precision along the chain: each link against the same in double precision, RMS.

Rays are cast by Embree, which has no double precision; the reference meets the plane of the hit face. The tolerance is
a few ulp: metres and texels times the difference of neighbouring texels, radiance by its slope.
"""

from types import SimpleNamespace

import numpy as np

from tests.robustness.cases import Found, case
from thermorender.defaults import BAND_UM
from thermorender.materials.material import grey
from thermorender.physics.planck import band_radiance, band_radiance_derivative, brightness_temperature

_SIDE_TEXELS = 400
_SLOPE = float(band_radiance_derivative(300.0, *BAND_UM))
# Largest ulp of radiance at 300 K [K].
_ULP_K = float(np.finfo(np.float32).eps * band_radiance(300.0, *BAND_UM)) / _SLOPE


def _rms_k(single, double):
    """Root mean square of a difference of radiances [K at 300 K]."""
    difference = np.asarray(single, np.float64) - double
    return float(np.sqrt(np.mean(np.square(difference)))) / _SLOPE


def _double(mi):
    """Names of Mitsuba's types in double precision, for code that is given the module."""
    return SimpleNamespace(
        Float=mi.Float64, UInt32=mi.UInt32, Bool=mi.Bool, Vector3f=mi.Vector3d, Vector4f=mi.Vector4d, Point3f=mi.Point3d
    )


def _ground(side_m):
    """Scene of rough black ground, seen by the usual camera."""
    from validation.made_scenes import terrain

    scene = terrain(20_000, texels=_SIDE_TEXELS, side_m=side_m)
    black = tuple(grey(f"black {number}", 1.0) for number in range(len(scene.materials)))
    return scene.with_surfaces(materials=black)


def _read(up):
    """Values at pixel centres over rough ground, from straight above: (single precision, in double at the same points,
    in double at points found in double), radiance; and the ulp allowed for points and for places on the map [K]."""
    from thermorender.render.arrays import Channels, opaque_view, view_ray
    from thermorender.render.geometry import Geometry
    from thermorender.render.pixels.sampling import CameraRays
    from thermorender.render.variant import activate
    from thermorender.trajectory.path import pose

    scene = _ground(1.2 * up)
    (surface,), mi, here = scene.surfaces, activate("cpu"), pose(0.0, 0.0, up, yaw_deg=20.0, pitch_deg=-90.0)
    geometry, rays = Geometry(mi, scene.surfaces), CameraRays(mi, scene.camera)
    inside = mi.UInt32(np.arange(len(rays.order), dtype=np.uint32))
    ray = view_ray(mi, *opaque_view(mi, here), *rays.slopes(0.5, 0.5, inside))
    hit = geometry.cast(ray)
    point = ray.o + hit.distance * ray.d
    place = geometry.map_position(geometry.record(hit.face, hit.valid), point)
    values = band_radiance(surface.temperature.astype(np.float64), *BAND_UM)
    lattice = geometry.lattice(hit.surface, hit.valid)
    (single,) = geometry.bilinear(Channels(mi, values.reshape(-1, 1)), lattice, *place, hit.valid)
    valid = np.array(hit.valid)
    row, column = np.divmod(rays.order[valid], scene.camera.width)
    direction = scene.camera.directions(np.stack([column + 0.5, row + 0.5], axis=-1))
    direction = np.column_stack([direction[:, :2], np.ones(len(direction))]) @ here[:3, :3].T
    face = np.array(hit.face)[valid]
    corner = surface.vertices[surface.faces[face]].astype(np.float64)
    edges = corner[:, 1:] - corner[:, :1]
    normal = np.cross(edges[:, 0], edges[:, 1])
    along = ((corner[:, 0] - here[:3, 3]) * normal).sum(axis=1) / (direction * normal).sum(axis=1)
    exact = here[:3, 3] + along[:, None] * direction

    def read(points):
        """Linear between texels, at points of the planes of the faces."""
        gram = edges @ edges.transpose(0, 2, 1)
        share = np.linalg.solve(gram, (edges @ (points - corner[:, 0])[..., None]))[..., 0]
        uv = surface.uv[face].astype(np.float64)
        at = (uv[:, 0] + np.einsum("nk,nka->na", share, uv[:, 1:] - uv[:, :1])) * _SIDE_TEXELS - 0.5
        low = np.floor(at).astype(int)
        part, low, high = at - low, *np.clip([low, low + 1], 0, _SIDE_TEXELS - 1)
        upper, lower = (
            values[line, low[:, 0]] * (1.0 - part[:, 0]) + values[line, high[:, 0]] * part[:, 0]
            for line in (low[:, 1], high[:, 1])
        )
        return upper * (1.0 - part[:, 1]) + lower * part[:, 1]

    contrast = float(np.sqrt(np.mean(np.square(np.diff(values, axis=1))))) / _SLOPE
    metres = 2.0 * float(np.spacing(np.float32(1.5 * up))) / surface.texel_m * contrast
    texels = 4.0 * float(np.spacing(np.float32(_SIDE_TEXELS))) * contrast
    found = np.array(point).T[valid].astype(np.float64)
    return np.array(single)[valid], read(found), read(exact), metres, texels


@case("precision", "rays and where they hit, from {:g} m", (30.0, 120.0, 1200.0, 10000.0))
def rays(up):
    """The ground is as large as the view, so texels are a pixel wide from any height."""
    _, there, exact, metres, texels = _read(up)
    return Found(_rms_k(there, exact), 0.0, metres + texels)


@case("precision", "places on the map and texels read, from {:g} m", (30.0, 120.0, 1200.0, 10000.0))
def look_up(up):
    """In single precision from the gradients of the map on; a place has an error in world metres, too."""
    single, there, _, metres, texels = _read(up)
    return Found(_rms_k(single, there), 0.0, metres + texels + 4.0 * _ULP_K)


def _lit():
    """(Plan, scene, single and double precision of the texels' emission)."""
    from thermorender.render.light import texels
    from thermorender.render.plan import make_plan
    from validation.made_scenes import terrain

    scene = terrain(5_000)
    return make_plan(scene), scene, texels


@case("precision", "emission of texels")
def emission():
    """From a table of temperature; the reference is the same table in double precision."""
    plan, scene, texels = _lit()
    (surface,) = scene.surfaces
    material, temperature = surface.material.reshape(-1), surface.temperature.reshape(-1)
    (single,) = texels.emitted(plan, scene.materials, material, temperature)
    double = np.empty(len(material))
    for number, own in enumerate(scene.materials):
        grid, table = plan.spectrum.emitted(own.emissivity_at, plan.coldest, plan.warmest, plan.band_um)
        double[material == number] = np.interp(temperature[material == number], grid, table[:, 0])
    return Found(_rms_k(single, double), 0.0, 4.0 * _ULP_K)


@case("precision", "light between surfaces, kept and reflected")
def light():
    """Nodes are solved in double precision and summed in single; half an ulp plus one for each node of the sum."""
    from thermorender.render.geometry import Geometry
    from thermorender.render.light import environment, radiosity
    from thermorender.render.variant import activate

    plan, scene, texels = _lit()
    (surface,), spectrum = scene.surfaces, plan.spectrum
    geometry = Geometry(activate("cpu"), scene.surfaces)
    known = radiosity.trace(geometry, 64)
    around = environment.of_scene(scene, plan, geometry)
    every = slice(0, spectrum.nodes)
    ((emitted, reflectance),) = texels.face_means(
        geometry, plan, surface.material.reshape(-1), surface.temperature.reshape(-1), [every]
    )
    tolerance = 1e-6 * plan.radiance_per_mk
    incident = radiosity.solve(known, emitted, reflectance, around.at(every), tolerance).incident
    single = texels.light(incident.astype(np.float32), spectrum.reflected[:, 0])[:-1]
    double = incident @ spectrum.reflected[:, 0].T
    found = max(_rms_k(one, other) for one, other in zip(np.array(single).T, double.T, strict=True))
    return Found(found, 0.0, (0.5 + spectrum.nodes) * _ULP_K)


@case("precision", "air of a view, from {:g} m", (120.0, 10000.0))
def air(up):
    """The same grid of paths read in double precision: some ulp of its logarithm of length, and of the sum."""
    from thermorender.physics.planck import band_radiance
    from thermorender.render.air import Air
    from thermorender.render.geometry import Hit
    from thermorender.render.plan import make_plan
    from thermorender.render.variant import activate
    from validation.made_scenes import terrain

    scene = terrain(5_000, side_m=4.0 * up).with_air("midlatitude-summer", "rural-23km")
    plan, mi = make_plan(scene), activate("cpu")
    count, rng = 20_000, np.random.default_rng(0)
    slope = rng.uniform(-1.0, 1.0, (2, count))
    direction = np.stack([*slope, -np.ones(count)]) / np.sqrt(1.0 + (slope**2).sum(axis=0))
    distance, box = -up / direction[2], np.array([[-2.0 * up, -2.0 * up, -10.0], [2.0 * up, 2.0 * up, 10.0]])
    values = plan.spectrum.basis.sum(axis=1) / plan.spectrum.basis.sum() * band_radiance(300.0, *BAND_UM)
    found = []
    for types in (mi, _double(mi)):
        hit = Hit(mi.Bool(np.ones(count, bool)), types.Float(distance.astype(np.float32)), None, None)
        towards = types.Vector3f(*(types.Float(axis.astype(np.float32)) for axis in direction))
        origin = types.Point3f(0.0, 0.0, up)
        view = Air(types, scene, plan.spectrum).view(np.array([0.0, 0.0, up]), box)
        channels = [types.Float(float(value)) for value in values]
        found.append(np.array(view.at_camera(hit, channels, origin, towards)[0], np.float64))
    # Grid lengths have an ulp of their logarithm times the columns, along which light changes little.
    return Found(_rms_k(*found), 0.0, 16.0 * _ULP_K)


@case("precision", "optics and absorption of the sensor")
def optics():
    """Blur, irradiance and power; the blur adds a hundred numbers with independent errors."""
    from thermorender.sensor.chain import OPTICS, Sensor, in_sequence

    sensor = Sensor(_ground(100.0).camera, seed=0)
    moment, shape = in_sequence(sensor.camera, 0, 0.0), (sensor.camera.height, sensor.camera.width)
    image = band_radiance(np.random.default_rng(0).uniform(280.0, 320.0, shape), *BAND_UM).astype(np.float32)
    found = []
    for kind in (np.float32, np.float64):
        stage_image = image.astype(kind)
        for stage in OPTICS:
            stage_image = stage(stage_image, sensor, moment)
        found.append(stage_image)
    _, gain = sensor.power_law(moment)
    return Found(_rms_k(found[0] / gain.astype(np.float64), found[1] / gain), 0.0, 4.0 * _ULP_K)


@case("precision", "pixels' memory over 10 000 frames of {:g} ms", (0.1, 16.7))
def memory(frame_ms):
    """Time constant of 10 ms; errors decay with it: some ulp in each of τ/Δt frames, and those of the weights."""
    from thermorender.sensor.detector import advanced, response_weights, steady

    tau_s, step_s, rng = 0.010, 1e-3 * frame_ms, np.random.default_rng(0)
    power = band_radiance(300.0, *BAND_UM) * rng.uniform(0.9, 1.1, 256)
    state, signal = steady(0.0, power.astype(np.float32)), power.astype(np.float32).astype(np.float64)
    old, first, last = response_weights(step_s, tau_s)
    for number in range(1, 10_001):
        before, power = power, band_radiance(300.0, *BAND_UM) * rng.uniform(0.9, 1.1, 256)
        state = advanced(state, number * step_s, power.astype(np.float32), tau_s)
        signal = old * signal + first * before + last * power
    return Found(_rms_k(state.signal, signal), 0.0, (4.0 + tau_s / step_s) * _ULP_K)


@case("precision", "apparent temperature, 200 … 1000 K")
def apparent():
    """From a table, from radiance to kelvin in single precision; the table's error is below 0.1 mK."""
    from thermorender.frame import apparent_temperature

    kelvin = np.linspace(200.0, 1000.0, 10_001)
    radiance = band_radiance(kelvin, *BAND_UM).astype(np.float32)
    exact = brightness_temperature(radiance.astype(np.float64), *BAND_UM)
    found = np.abs(apparent_temperature(radiance, BAND_UM) - exact).max()
    return Found(float(found), 0.0, 1e-4 + float(np.spacing(np.float32(1000.0))))
