"""Cost of single precision along the chain: every kernel against itself in double precision, largest difference.

A kernel that is given its array library runs again with the library's doubles, on inputs that single precision holds.
Rays are cast by Embree, which has no double precision; the reference meets the plane of the hit face. The tolerance is
a few ulp: metres and texels times the difference of neighbouring texels, radiance by its slope.
"""

from dataclasses import replace
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


def _largest_k(single, double):
    """Largest difference of radiances [K at 300 K]."""
    return float(np.abs(np.asarray(single, np.float64) - double).max()) / _SLOPE


def _double(mi):
    """Names of Mitsuba's types in double precision, for code that is given the module."""
    return SimpleNamespace(
        Float=mi.Float64, Int32=mi.Int32, UInt32=mi.UInt32, UInt8=mi.UInt8, Bool=mi.Bool,
        Vector2f=mi.Vector2d, Vector3f=mi.Vector3d, Vector4f=mi.Vector4d, Point3f=mi.Point3d,
    )  # fmt: skip


def _both():
    """(mi, its doubles), and a function that rounds an array to single precision and returns it in either's types."""
    from thermorender.render.variant import activate

    mi = activate("cpu")
    return (mi, _double(mi)), lambda types, values: types.Float(np.ascontiguousarray(values, np.float32))


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

    contrast = float(np.abs(np.diff(values, axis=1)).max()) / _SLOPE
    metres = 2.0 * float(np.spacing(np.float32(1.5 * up))) / surface.texel_m * contrast
    texels = 4.0 * float(np.spacing(np.float32(_SIDE_TEXELS))) * contrast
    found = np.array(point).T[valid].astype(np.float64)
    return np.array(single)[valid], read(found), read(exact), metres, texels


@case("precision", "rays and where they hit, from {:g} m", (30.0, 120.0, 1200.0, 10000.0, 40000.0))
def rays(up):
    """The ground is as large as the view, so texels are a pixel wide from any height."""
    _, there, exact, metres, texels = _read(up)
    return Found(_largest_k(there, exact), 0.0, metres + texels)


@case("precision", "places on the map and texels read, from {:g} m", (30.0, 120.0, 1200.0, 10000.0, 40000.0))
def look_up(up):
    """In single precision from the gradients of the map on; a place has an error in world metres, too."""
    single, there, _, metres, texels = _read(up)
    return Found(_largest_k(single, there), 0.0, metres + texels + 4.0 * _ULP_K)


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
    return Found(_largest_k(single, double), 0.0, 4.0 * _ULP_K)


@case("precision", "light between surfaces, kept and reflected")
def light():
    """Nodes are solved in double precision and summed in single; half an ulp plus one for each node of the sum."""
    from thermorender.render.geometry import Geometry
    from thermorender.render.light import environment, radiosity, solver
    from thermorender.render.variant import activate

    plan, scene, texels = _lit()
    (surface,), spectrum = scene.surfaces, plan.spectrum
    geometry = Geometry(activate("cpu"), scene.surfaces)
    known = radiosity.trace(geometry, 64)
    around = environment.of_scene(scene, plan, geometry, known.touching)
    every = slice(0, spectrum.nodes)
    ((emitted, reflectance),) = texels.face_means(
        geometry, plan, surface.material.reshape(-1), surface.temperature.reshape(-1), [every]
    )
    tolerance = 1e-6 * plan.radiance_per_mk
    incident = solver.solve(known, emitted, reflectance, around.at(every), tolerance).incident
    single = texels.light(incident.astype(np.float32), spectrum.reflected[:, 0])[:-1]
    double = incident @ spectrum.reflected[:, 0].T
    found = max(_largest_k(one, other) for one, other in zip(np.array(single).T, double.T, strict=True))
    return Found(found, 0.0, (0.5 + spectrum.nodes) * _ULP_K)


@case("precision", "air of a view, from {:g} m", (2.0, 120.0, 10000.0, 40000.0))
def air(up):
    """The same grid of paths read in double precision: some ulp of its logarithm of length, and of the sum."""
    from thermorender.physics.planck import band_radiance
    from thermorender.render.air import SceneAir
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
        view = SceneAir(types, scene, plan.spectrum).view(np.array([0.0, 0.0, up]), box)
        channels = [types.Float(float(value)) for value in values]
        found.append(np.array(view.at_camera(hit, channels, origin, towards)[0], np.float64))
    # Grid lengths have an ulp of their logarithm times the columns, along which light changes little.
    return Found(_largest_k(*found), 0.0, 16.0 * _ULP_K)


@case("precision", "footprint of a pixel on the map, drawn from 1 m to 40 km, straight down to grazing")
def footprint():
    """Its corners in texels, relative to its size, times 10 K across a pixel."""
    from thermorender.render.pixels.footprint import OnMap
    from thermorender.render.pixels.sampling import Footprint

    kinds, of = _both()
    count, rng = 100_000, np.random.default_rng(1)
    texel_m, pixel = 10.0 ** rng.uniform(-3.0, 1.0, count), 10.0 ** rng.uniform(-5.0, -2.0, count)
    distance, turn = 10.0 ** rng.uniform(0.0, 4.6, count), rng.uniform(0.0, 2.0 * np.pi, count)
    dip = np.arcsin(10.0 ** rng.uniform(-2.0, 0.0, count))
    slope = rng.uniform(-0.5, 0.5, (2, count))
    # The camera looks down by `dip`; the map lies level.
    right = np.array([np.sin(turn), -np.cos(turn), 0.0 * turn])
    ahead = np.array([np.cos(turn) * np.cos(dip), np.sin(turn) * np.cos(dip), -np.sin(dip)])
    down = np.cross(ahead, right, axis=0)
    rows = np.stack([right, down, ahead], axis=1)
    direction = (rows * np.array([*slope, np.ones(count)])[None]).sum(axis=1)
    direction /= np.linalg.norm(direction, axis=0)
    seen = direction[2] < -0.5 * np.sin(dip)
    found = []
    for types in kinds:
        vector = lambda values, kind=types.Vector3f, types=types: kind(*(of(types, each[seen]) for each in values))  # noqa: E731
        flat = np.zeros(count)
        record = [
            types.Vector4f(*(of(types, each[seen]) for each in (1.0 / texel_m if k == 0 else flat,
                                                               1.0 / texel_m if k == 1 else flat, flat, flat)))
            for k in (0, 1)
        ]  # fmt: skip
        of_cell = lambda *values, types=types: [of(types, each[seen]) for each in values]  # noqa: E731
        cell = Footprint(of_cell(*slope), of_cell(pixel, flat), of_cell(flat, pixel), of_cell(flat, flat))
        on_map = OnMap.of(
            types, [vector(row) for row in rows], vector(direction), of(types, distance[seen]), record, cell
        )
        found.append(np.array([*on_map.moved(0.5, 0.5), *on_map.moved(-0.5, 0.5), on_map.area], np.float64))
    size = np.abs(found[1][:4]).max(axis=0)
    return Found(float((np.abs(found[0][:4] - found[1][:4]).max(axis=0) / size).max()) * 10.0, 0.0, 1e-3)


@case("precision", "share of the sky in pixels on the horizon, of {:g} mrad", (10.0, 1.0, 0.01))
def horizon(milliradians):
    """Times 50 K between sky and ground; pixels are drawn on it, in images up to 1024 px wide."""
    import drjit as dr

    from thermorender.render.pixels.footprint import Climb
    from thermorender.render.pixels.sampling import Footprint

    kinds, of = _both()
    count, rng, side = 100_000, np.random.default_rng(2), 1e-3 * milliradians
    slope = np.float32(rng.uniform(-1.0, 1.0, (2, count)) * min(512.0 * side, 0.5))
    roll = rng.uniform(-0.2, 0.2, count)
    # The vertical in camera axes, turned so that the pixel sees the horizon.
    up = np.array([np.sin(roll), -np.cos(roll), 0.0 * roll])
    up[2] = -(up[:2] * slope).sum(axis=0) + side * rng.uniform(-0.7, 0.7, count)
    up = np.float32(up / np.linalg.norm(up, axis=0))
    found = []
    for types in kinds:
        x, y, *axis = (of(types, each) for each in (*slope, *up))
        inverse = dr.rsqrt(1.0 + x * x + y * y)
        cosine = inverse * (axis[0] * x + axis[1] * y + axis[2])
        flat, full = of(types, np.zeros(count)), of(types, np.full(count, side))
        cell = Footprint([x, y], [full, flat], [flat, full], [flat, flat])
        share, *_ = Climb.of([None, None, types.Vector3f(*axis)], cosine, cell).parts(0.0)
        found.append(np.array(share, np.float64))
    # The cosine's terms are as large as the slopes: a few of their ulp, by the height of a pixel.
    ulp = 4.0 * 2.0**-24 * float(np.abs(slope).max()) / side
    return Found(50.0 * float(np.abs(found[0] - found[1]).max()), 0.0, 50.0 * ulp)


@case("precision", "leaves of copies in their places, up to {:g} m from the origin", (100.0, 5000.0))
def placed(far_m):
    """Corners of triangles after their turn, times 10 K per metre: sun and shade within a crown."""
    from thermorender.render.light.leaves import Leaves

    kinds, of = _both()
    count, rng = 100_000, np.random.default_rng(3)
    angle, scale = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.2, 5.0, (3, count)).astype(np.float32)
    turn = np.array([np.cos(angle), np.sin(angle)], np.float32)
    shift = rng.uniform(-far_m, far_m, (3, count)).astype(np.float32)
    corner = rng.uniform(-5.0, 5.0, (3, count))
    found = []
    for types in kinds:
        leaves = Leaves.__new__(Leaves)
        leaves._mi, tables = types, (turn, scale, shift)
        leaves._turn, leaves._scale, leaves._shift = (of(types, each.T.ravel()) for each in tables)
        vector = types.Vector3f(*(of(types, axis) for axis in corner))
        place, *_ = leaves.placed(types.UInt32(np.arange(count, dtype=np.uint32)), vector, vector, vector, vector)
        found.append(np.array(place, np.float64))
    return Found(10.0 * float(np.abs(found[0] - found[1]).max()), 0.0, 20.0 * float(np.spacing(np.float32(far_m))))


@case("precision", "light reflected by water and metals, from grazing to straight down")
def mirrors():
    """What a mirror of each of the directional materials adds to a channel, of drawn light and of the sky."""
    from thermorender.materials.library import load_library
    from thermorender.render.plan import make_plan
    from thermorender.render.reflection.device_tables import DeviceTables
    from validation.made_scenes import terrain

    library = load_library()
    own = [each for each in library.values() if each.emissivity_by_angle is not None][:3]
    scene = terrain(2_000).with_surfaces(materials=tuple(own))
    plan = make_plan(scene)
    kinds, of = _both()
    count, rng = 50_000, np.random.default_rng(4)
    cosine, up = 10.0 ** rng.uniform(-4.0, 0.0, count), rng.uniform(-1.0, 1.0, count)
    kelvin = rng.uniform(250.0, 330.0, (2, count))
    grid, table = plan.spectrum.emitted(np.ones_like, 200.0, 400.0, plan.band_um)
    row = rng.integers(0, len(own), count).astype(np.uint32)
    light = [[np.interp(each, grid, column) for column in table.T] for each in kelvin]
    found = []
    for types in kinds:
        tables = DeviceTables(types, scene, plan)
        black, seen = ([of(types, each) for each in side] for side in light)
        valid = types.Bool(np.arange(count) % 2 == 0)
        added = tables.reflected(types.UInt32(row), of(types, cosine), black, seen, valid, of(types, up))
        found.append(np.array(tables.band(added), np.float64))
    # Sums over channels and their products, some of which cancel.
    return Found(_largest_k(*found), 0.0, 64.0 * _ULP_K)


@case("precision", "means of 10⁷ texels over squares of 512")
def texels():
    """A texture of 300 K with spots of 1000 K."""
    from thermorender.render.pixels import pyramid

    rng = np.random.default_rng(5)
    kelvin = np.where(rng.random((4096, 2560)) < 1e-3, 1000.0, rng.uniform(280.0, 320.0, (4096, 2560)))
    values = band_radiance(kelvin.ravel(), *BAND_UM).astype(np.float32).reshape(4096, 2560, 1)
    levels = list(pyramid.squares(values))
    exact = values[..., 0].astype(np.float64).reshape(8, 512, 5, 512).mean(axis=(1, 3))
    return Found(_largest_k(levels[8][..., 0], exact), 0.0, 9.0 * _ULP_K)


@case("precision", "noise of a frame of 640 × 512 pixels by parts")
def noise():
    """Its parts in double precision, at the camera's noise-equivalent difference."""
    from thermorender.sensor import noise as model
    from thermorender.sensor.camera import load_camera

    camera = load_camera("zenmuse-xt2")
    found = model.temporal_noise(camera, 0, 3).astype(np.float64) / model.noise_power(camera, 1000.0)
    common = [camera.sigma_t_mk, camera.sigma_tv_mk, camera.sigma_th_mk]
    single = np.sqrt(camera.gain_netd_mk**2 - sum(sigma**2 for sigma in common))
    height, width = camera.height, camera.width
    values = model.normal(0, 3, model._FRAME, height * width + 1 + height + width, np.float32(1.0)).astype(np.float64)
    pixel, frame = values[: height * width].reshape(height, width), values[height * width]
    row, column = np.split(values[height * width + 1 :], [height])
    exact = 1e-3 * (single * pixel + common[0] * frame + common[1] * row[:, None] + common[2] * column)
    return Found(float(np.abs(found - exact).max()), 0.0, 4.0 * 2.0**-24 * float(np.abs(exact).max()) + 1e-7)


@case("precision", "shipped network from pictures to temperature")
def network():
    """Its layers on drawn pictures, 256 pixels a side; its output is a temperature above the air."""
    import copy

    import torch

    from thermorender.learned.temperature_map import SHIPPED, load_map

    own = load_map(SHIPPED["procedural-compact+"]).predictor
    planes = np.random.default_rng(7).uniform(-1.0, 1.0, (2, own.encoding.channels, 256, 256)).astype(np.float32)
    found = []
    for number in (torch.float32, torch.float64):
        net = copy.deepcopy(own.net).to("cpu", number)
        with torch.inference_mode():
            given = net(torch.from_numpy(planes).to(number))
        found.append((given[0] if isinstance(given, tuple) else given).numpy()[:, 0])
    return Found(float(np.abs(found[0] - found[1]).max()) * own.encoding.scale, 0.0, 1e-3)


@case(
    "precision",
    "heat of drawn columns, {0[1]} steps of {0[0]:g} s",
    ((1.0, 200), (300.0, 144), (1800.0, 96), (10800.0, 24)),
)
def heat(steps):
    """Surfaces of up to three slabs, 10 µm … 10 m, 0.02 … 400 W m⁻¹ K⁻¹, wet, freezing, under snow, in any weather."""
    from tests.robustness.stepped import DOUBLE, SINGLE, run
    from thermorender.physics import balance, turbulence
    from thermorender.physics.conduction import Slab, layered

    (seconds, number), count, rng = steps, 400, np.random.default_rng(6)
    snow = rng.random(count) < 0.1
    cuts, room = [], []
    for snowy in snow:
        slabs = [
            Slab(10.0 ** rng.uniform(-5.0, 1.0), 0.02 * 2e4 ** rng.random(), 10.0 ** rng.uniform(4.5, 6.6),
                 rng.choice([0.0, 0.05, 0.4]))
            for _ in range(rng.integers(1, 4))
        ]  # fmt: skip
        film, skin = rng.choice([7.7, 25.0]), rng.choice([np.inf, 20.0])
        if rng.random() < 0.4:
            slabs[-1], film = replace(slabs[-1], thickness_m=np.inf), None
        if snowy:
            slabs.insert(0, Slab(10.0 ** rng.uniform(-2.0, 0.0), rng.uniform(0.05, 0.5), rng.uniform(1e5, 1e6), 0.3))
        cuts.append(layered(slabs, skin, film))
        if snowy:
            slabs[0] = replace(slabs[0], water=balance.RETENTION * slabs[0].water)
        room.append(layered(slabs, skin, film).water)
    of = lambda name: list(np.array([getattr(cut, name) for cut in cuts]).T)  # noqa: E731
    rough = 0.5 * 10.0 ** rng.uniform(-4.0, 0.0, count)
    ground = balance.ColumnProperties(
        emissivity=rng.choice([1e-3, 0.1, 0.5, 0.95, 1.0], count), log_wind=np.log(10.0 / rough),
        log_heat=np.log(2.0 / rough) + rng.uniform(1.0, 7.0, count), height_m=2.0,
        resistance=10.0 ** rng.uniform(0.0, 4.0, count), wetness=rng.uniform(0.01, 1.0, count),
        open_water=rng.choice([0.0, 0.0, 1.0], count), leaves=rng.choice([0.0, 1.0], count),
        held=rng.choice([0.0, 0.2, 1e3], count), melting=snow.astype(float), capacity=of("capacity"),
        conductance=of("conductance"), water=of("water"), room=list(np.array(room).T),
        sun_share=list(np.where(rng.random(count) < 0.2, 0.45 / 12.0, 0.0) * np.ones((12, 1))),
    )  # fmt: skip
    mean_k, wind = rng.uniform(230.0, 315.0, count), rng.choice([0.0, 0.5, 3.0, 30.0], count)
    peak, humidity = rng.choice([0.0, 1000.0, 500.0], count), rng.uniform(0.1, 1.0, count)

    def act(t):
        phase = 2.0 * np.pi * t / 86400.0
        sun, kelvin = peak * max(0.0, -np.cos(phase)), mean_k - 7.0 * np.cos(phase - 0.5)
        return balance.Forcing(
            absorbed=0.7 * sun, longwave=0.8 * balance.STEFAN_BOLTZMANN * kelvin**4, sunlight=sun, air_k=kelvin,
            vapour_pa=humidity * turbulence.saturation_vapour(np, kelvin)[0], wind_m_s=wind, pressure_pa=9e4,
            rain_kg_m2_s=1e-4 * (np.sin(3.0 * phase + mean_k) > 0.9), below_k=mean_k,
        )  # fmt: skip

    begin = np.where(snow, np.minimum(mean_k, 272.0), mean_k) + np.zeros((12, 1))
    start_s = 36000.0 if seconds < 60.0 else 0.0
    single, double = (run(kind, ground, act, begin, seconds, number, start_s)[0] for kind in (SINGLE, DOUBLE))
    return Found(float(np.abs(single - double).max()), 0.0, 5e-3)


@case("precision", "black hills seen from 200 m, {:g} km from the origin", (1.0, 5.0, 20.0))
def far(away_km):
    """A frame of them moved away, with their camera, against the frame at the origin: an ulp of places, in texels."""
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose
    from validation.made_scenes import in_memory

    scene, away = _ground(float(_SIDE_TEXELS)), np.array([1e3 * away_km, -1e3 * away_km, 0.0])
    (surface,) = scene.surfaces
    # Vertices that single precision holds at both places.
    vertices = np.float32(surface.vertices + away).astype(np.float64)
    found = []
    for shift in (away, np.zeros(3)):
        moved = replace(surface, vertices=vertices - away + shift)
        at = pose(*(shift + (0.0, 0.0, 200.0)), yaw_deg=20.0, pitch_deg=-90.0)
        one = in_memory("far", (moved,), scene.materials)
        found.append(Renderer(one, "fast", device="cpu").frame(at).radiance.astype(np.float64))
    values = band_radiance(surface.temperature.astype(np.float64), *BAND_UM)
    contrast = float(np.abs(np.diff(values, axis=1)).max()) / _SLOPE
    return Found(_largest_k(*found), 0.0, 4.0 * float(np.spacing(np.float32(1e3 * away_km))) * contrast)


@case("precision", "optics and absorption of the sensor")
def optics():
    """Blur, irradiance and power of 3e5 pixels; the blur adds a hundred numbers with independent errors."""
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
    return Found(_largest_k(found[0] / gain.astype(np.float64), found[1] / gain), 0.0, 8.0 * _ULP_K)


@case("precision", "memory of pixels of {0[1]:g} ms over 10 000 frames of {0[0]:g} ms",
      ((0.1, 10.0), (16.7, 10.0), (0.1, 1000.0), (0.1, 10000.0)))  # fmt: skip
def memory(times):
    """From 300 K to light that flickers by a tenth; the light of each frame has an ulp."""
    from thermorender.sensor.detector import advanced, response_weights, steady

    (step_s, tau_s), rng = 1e-3 * np.array(times), np.random.default_rng(0)
    power = band_radiance(300.0, *BAND_UM) * rng.uniform(0.9, 1.1, 256)
    state, signal = steady(0.0, power.astype(np.float32)), power.astype(np.float32).astype(np.float64)
    old, first, last = response_weights(step_s, tau_s)
    for number in range(1, 10_001):
        before, power = power, band_radiance(300.0, *BAND_UM) * rng.uniform(0.9, 1.1, 256)
        state = advanced(state, number * step_s, power.astype(np.float32), tau_s)
        signal = old * signal + first * before + last * power
    return Found(_largest_k(state.signal, signal), 0.0, _ULP_K)


@case("precision", "apparent temperature, 200 … 1000 K")
def apparent():
    """From a table, from radiance to kelvin in single precision; the table's error is below 0.1 mK."""
    from thermorender.frame import apparent_temperature

    kelvin = np.linspace(200.0, 1000.0, 10_001)
    radiance = band_radiance(kelvin, *BAND_UM).astype(np.float32)
    exact = brightness_temperature(radiance.astype(np.float64), *BAND_UM)
    found = np.abs(apparent_temperature(radiance, BAND_UM) - exact).max()
    return Found(float(found), 0.0, 1e-4 + float(np.spacing(np.float32(1000.0))))
