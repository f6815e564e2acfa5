"""A second renderer, as simple as possible, which frames are compared with feature by feature.

Float64 NumPy. Every ray is tested against every triangle (Möller and Trumbore 1997, doi:10.1080/10867651.1997.10487468,
in the form with Plücker's moments). Light is followed backwards from the camera until it is lost. Every path carries
one random wavelength in each part of the band, and the samples of a pixel cover each part evenly. Surfaces are diffuse,
or mirrors by Fresnel's equations, at every bounce. Air absorbs and emits along every segment of a path, in small steps.
From the scene only data are used: triangles, texels, spectra, refractive indices as tabulated, the camera's numbers,
the tracks, and the air's tables. Nothing is shared with `thermorender.render`.

Beyond the surfaces are the sky and, below the horizon, black ground at the temperature of the surroundings and the
altitude of the scene's origin. Clouds are black at their base and are seen from below only. The sun is a distant point
that lights diffuse surfaces, and an even disc in mirrors.
"""

import csv

import numpy as np

from thermorender.paths import data_folder

# CODATA 2018: 2hc² [W m⁻² sr⁻¹ µm⁴] and hc/k [µm K].
_H, _C, _K = 6.62607015e-34, 299792458.0, 1.380649e-23
C1L, C2 = 2e24 * _H * _C**2, 1e6 * _H * _C / _K
# Reference temperature of the air table's shares, Earth radius including refraction, and the top of the air.
SHARES_K, MEAN_RADIUS_M, TOP_M = 285.0, 6.371e6, 1.0e5
RADIUS_M = MEAN_RADIUS_M / (1.0 - 0.13)
# The sun's brightness temperature by wavelength (ASTM G173-03 up to 4 µm; Saiedy and Goody 1959 at 11.1 µm); solar
# radius and astronomical unit of the IAU.
SUN_K = (3.0, 3.3, 4.0, 8.0, 11.1), (5710.0, 5625.0, 5580.0, 5150.0, 5036.0)
SUN_SR = np.pi * (6.957e8 / 1.495978707e11) ** 2
# Parts of the band in scenes without air; altitudes at which the air is tabulated, 0.3 m apart at the ground.
PARTS, LEVELS_M = 24, 1.5e3 * np.expm1(np.linspace(0.0, np.log1p(TOP_M / 1.5e3), 20001))
# Steps of a ray through the air to space (their error is up to 5 mK of the sky), longest step of others [m], rays at
# once.
SKY_STEPS, STEP_M, AT_ONCE = 120, 150.0, 1 << 14
# Paths with less than this share of the light end at random or continue with more: roulette, which is unbiased.
FAINT = 0.1


class PathTracer:
    """Paths in one scene.

    Parameters
    ----------
    scene : Scene
    time_s : float
        Where on their tracks objects are [s].
    objects : dict, optional
        {name: {column of its track: value}} in place of the track's.
    """

    def __init__(self, scene, time_s=0.0, objects=None):
        self.scene, self.air = scene, scene.air
        placed = [_placed(scene, tracked, time_s, (objects or {}).get(tracked.name, {}))
                  for tracked in scene.tracked_objects]  # fmt: skip
        parts = [(s, s.vertices, s.temperature) for s in scene.surfaces] + [part for each in placed for part in each]
        corner = np.concatenate([vertices[s.faces] for s, vertices, _ in parts])
        self._corner, self._uv = corner[:, 0], np.concatenate([s.uv for s, _, _ in parts]).astype(float)
        self._sides = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        self._across = np.cross(*self._sides)
        self._moments = [np.cross(side, self._corner) for side in self._sides]
        self._normal = self._across / np.linalg.norm(self._across, axis=1, keepdims=True)
        self._surface = np.repeat(np.arange(len(parts)), [len(s.faces) for s, _, _ in parts])
        self._shape = np.array([s.material.shape for s, _, _ in parts])
        self._start = np.cumsum([0] + [s.material.size for s, _, _ in parts])
        self._material = np.concatenate([s.material.ravel() for s, _, _ in parts])
        self._temperature = np.concatenate([np.broadcast_to(t, s.material.shape).ravel() for s, _, t in parts])
        self._index = {number: _refractive_index(scene, material) for number, material in enumerate(scene.materials)
                       if material.directional != "lambertian"}  # fmt: skip
        self._spectrum(scene.camera.band_um)
        low, high = (float(limit(corner[..., 2])) for limit in (np.min, np.max))
        self._nearest = 1e-9 * (1.0 + np.abs(corner).max())
        self._sun = None
        if scene.sun is not None and scene.sun.elevation_deg > 0.0:
            self._sun = self._sunlight(np.linspace(low, high + 1e-3, 5))

    def image(self, pose, samples, seed):
        """Return band radiance, (H, W) [W m⁻² sr⁻¹], by `samples` paths through each pixel's area.

        `pose` is world_from_camera, (4, 4); another seed is another, independent estimate.
        """
        random, camera = np.random.default_rng(seed), self.scene.camera
        pixels = np.arange(camera.width * camera.height)
        radiance = np.empty(len(pixels))
        for part in np.array_split(pixels, max(1, len(pixels) * samples // AT_ONCE)):
            # Position in the pixel, first direction off a surface and wavelengths: each spread evenly, independently of
            # the others.
            order = random.random((len(part), samples, 4 + len(self._low))).argsort(axis=1)
            even = ((order + random.random(order.shape)) / samples).reshape(len(part) * samples, -1)
            column, row = part % camera.width, part // camera.width
            place = np.repeat(np.column_stack([column, row]), samples, axis=0) + even[:, :2]
            local = np.column_stack([undistorted(camera, place), np.ones(len(place))])
            direction = local @ pose[:3, :3].T
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            origin = np.broadcast_to(pose[:3, 3], direction.shape)
            wavelength = self._low + (self._high - self._low) * even[:, 4:]
            found = self._paths(origin, direction, wavelength, even[:, 2:4], random)
            radiance[part] = found.reshape(len(part), samples).mean(axis=1)
        return radiance.reshape(camera.height, camera.width)

    def _paths(self, origin, direction, wavelength, even, random):
        """Band radiance that arrives at `origin` (n, 3) from `direction` (n, 3), (n,)."""
        total, alive = np.zeros(len(origin)), np.arange(len(origin))
        through, mirrored = np.ones((len(origin), len(self._of))), np.zeros(len(origin), bool)
        while alive.size:
            length, face, inside = self._cast(origin, direction)
            hit = face >= 0
            if not hit.all():
                beyond = self._beyond(origin[~hit], direction[~hit], wavelength[~hit])
                if self._sun is not None:
                    beyond += mirrored[~hit, None] * self._disc(origin[~hit], direction[~hit], wavelength[~hit])
                total[alive[~hit]] += (through[~hit] * beyond).sum(axis=1)
            length, face, inside, origin, direction, wavelength, even, through, alive = (
                values[hit] for values in (length, face, inside, origin, direction, wavelength, even, through, alive)
            )
            if self.air is not None and alive.size:
                passed, light = self._segment(origin, direction, length, wavelength)
                total[alive] += (through * light).sum(axis=1)
                through = through * passed
            origin = origin + length[:, None] * direction
            slant = (self._normal[face] * direction).sum(axis=1)
            normal = -np.sign(slant)[:, None] * self._normal[face]
            temperature, material = self._texel(face, inside, random)
            reflectance, mirror = self._reflectance(material, wavelength, np.abs(slant))
            total[alive] += (through * (1.0 - reflectance) * self._black(wavelength, temperature)).sum(axis=1)
            through = through * reflectance
            if self._sun is not None:
                lit = self._lit(origin, normal, wavelength) * ~mirror[:, None]
                total[alive] += (through * lit).sum(axis=1)
            direction = np.where(mirror[:, None], direction - 2.0 * slant[:, None] * self._normal[face],
                                 _off(normal, even))  # fmt: skip
            even = random.random(even.shape)
            # Faint mirrors may show the sun.
            stays = np.where(mirror, 1.0, np.minimum(through.max(axis=1, initial=0.0) / FAINT, 1.0))
            on = random.random(len(alive)) < stays
            through, mirrored = through[on] / stays[on, None], mirror[on]
            origin, direction, wavelength, even, alive = (
                values[on] for values in (origin, direction, wavelength, even, alive)
            )
        return total

    def _cast(self, origin, direction):
        """(length (n,), face (n,), −1 for none, barycentric (n, 2)) of each ray's first hit on a triangle."""
        count = len(origin)
        length, face, inside = np.full(count, np.inf), np.full(count, -1), np.zeros((count, 2))
        level = (self._corner * self._across).sum(axis=1)
        step = max(1, (1 << 21) // len(self._across))
        for first in range(0, count, step):
            part = slice(first, first + step)
            o, d = origin[part], direction[part]
            moment = np.cross(o, d)
            with np.errstate(divide="ignore", invalid="ignore"):
                scale = -1.0 / (d @ self._across.T)
                u = (moment @ self._sides[1].T - d @ self._moments[1].T) * scale
                v = (d @ self._moments[0].T - moment @ self._sides[0].T) * scale
                t = (o @ self._across.T - level) * scale
                t[~((u >= -1e-12) & (v >= -1e-12) & (u + v <= 1.0 + 1e-12) & (t > self._nearest))] = np.inf
            rows, best = np.arange(len(o)), t.argmin(axis=1)
            length[part] = t[rows, best]
            face[part] = np.where(np.isfinite(length[part]), best, -1)
            inside[part] = np.column_stack([u[rows, best], v[rows, best]])
        return length, face, inside

    def _texel(self, face, inside, random):
        """(temperature, material) at points of faces, each from one of the four nearest texels, drawn by bilinear
        weight."""
        surface, (u, v) = self._surface[face], inside.T[..., None]
        at = (1.0 - u - v) * self._uv[face, 0] + u * self._uv[face, 1] + v * self._uv[face, 2]
        size = self._shape[surface][:, ::-1]
        column, row = np.clip(np.floor(at * size - 0.5 + random.random(at.shape)).astype(int), 0, size - 1).T
        texel = self._start[surface] + row * size[:, 0] + column
        return self._temperature[texel], self._material[texel]

    def _reflectance(self, material, wavelength, cosine):
        """(share reflected (n, N), whether by a mirror (n,))."""
        share, mirror = np.empty(wavelength.shape), np.zeros(len(material), dtype=bool)
        for number in np.unique(material):
            own = material == number
            here = wavelength[own]
            if number in self._index:
                table, n, k = self._index[number]
                found = fresnel(cosine[own, None], np.interp(here, table, n), np.interp(here, table, k))
                mirror[own] = True
            else:
                table = self.scene.materials[number]
                found = 1.0 - np.interp(here, table.wavelength_um, table.emissivity)
            share[own] = found
        return share[:, self._of], mirror

    def _spectrum(self, band_um):
        """Parts of the band, and the air's nodes in them: `_of` is the part of each."""
        air = self.air
        if air is None:
            edge = np.linspace(*band_um, PARTS + 1)
            self._low, self._high, self._of = edge[:-1], edge[1:], np.arange(PARTS)
            return
        (self._low, first, self._of) = np.unique(air.lower_um, return_index=True, return_inverse=True)
        self._high = air.upper_um[first]
        density = np.empty((len(LEVELS_M), len(air.density)))
        for column, values in zip(density.T, air.density, strict=True):
            # Exponential between the table's levels, linear where a gas ends.
            column[:] = np.interp(LEVELS_M, air.altitude_m, values)
            level = np.clip(np.searchsorted(air.altitude_m, LEVELS_M, side="right"), 1, len(values) - 1)
            both = (values[level - 1] > 0.0) & (values[level] > 0.0)
            column[both] = np.exp(np.interp(LEVELS_M[both], air.altitude_m, np.log(np.maximum(values, 1e-300))))
        self._extinction = density @ air.absorption.T
        self._air_k = np.interp(LEVELS_M, air.altitude_m, air.temperature)
        self._air_share = self._share(self._air_k)

    def _share(self, temperature):
        """Share of each of the air's nodes in the light of its part of the band, (..., N)."""
        if self.air is None:
            return np.ones(len(self._of))
        kelvin = np.asarray(temperature, dtype=float)[..., None]
        powers = self.air.tilt.shape[1]
        if powers > 1:
            kelvin = np.clip(kelvin, 160.0, 6000.0)
        warmth = C2 * (1.0 / SHARES_K - 1.0 / kelvin)
        share = self.air.weight * np.exp(sum(self.air.tilt[:, k] * warmth ** (k + 1) for k in range(powers)))
        total = np.stack([share[..., self._of == part].sum(axis=-1) for part in range(len(self._low))], axis=-1)
        return share / total[..., self._of]

    def _black(self, wavelength, temperature, share=None):
        """A blackbody's light by node, (n, N), estimated from its one wavelength in each part of the band."""
        if np.ndim(temperature) == 0 and temperature <= 0.0:
            return np.zeros((len(wavelength), len(self._of)))
        planck = C1L / wavelength**5 / np.expm1(C2 / (wavelength * np.asarray(temperature, dtype=float)[..., None]))
        share = self._share(temperature) if share is None else share
        return (planck * (self._high - self._low))[:, self._of] * share

    def _altitude(self, point):
        """Altitude above sea level of points of the local frame."""
        return self.scene.altitude_m + point[:, 2] + (point[:, :2] ** 2).sum(axis=1) / (2.0 * MEAN_RADIUS_M)

    def _segment(self, origin, direction, length, wavelength):
        """(transmittance, light), each (n, N), of straight segments between points of the scene."""
        steps = int(np.clip(np.ceil(length.max() / STEP_M), 2, 200))
        return self._along(self._altitude(origin), direction[:, 2], length, wavelength, np.arange(steps + 1) / steps)

    def _along(self, start, cosine, length, wavelength, parts):
        """As `_segment`, from altitudes along directions, in steps that end at these fractions of the length."""
        near = self._air_at(start, wavelength)
        passed = np.ones_like(near[0])
        light = np.zeros_like(passed)
        for k in range(len(parts) - 1):
            far = self._air_at(_risen(start, cosine, parts[k + 1] * length), wavelength)
            # The mean of an exponential decrease, after Pólya.
            mean = (0.5 * (near[0] + far[0]) + 2.0 * np.sqrt(near[0] * far[0])) / 3.0
            depth = mean * ((parts[k + 1] - parts[k]) * length)[:, None]
            after = np.exp(-depth)
            # The source is linear in depth: ∫ S e^−x dx from 0 to d.
            thin = depth < 1e-4
            mean = np.where(thin, 1.0 - 0.5 * depth, (1.0 - after) / np.where(thin, 1.0, depth))
            light += passed * (near[1] * (1.0 - after) + (far[1] - near[1]) * (mean - after))
            passed *= after
            near = far
        return passed, light

    def _air_at(self, altitude, wavelength):
        """(extinction [m⁻¹], blackbody light of the air) at altitudes, each (n, N)."""
        position = np.log1p(np.clip(altitude, 0.0, TOP_M) / 1.5e3) / np.log1p(TOP_M / 1.5e3) * (len(LEVELS_M) - 1)
        level = np.rint(position).astype(int)
        return self._extinction[level], self._black(wavelength, self._air_k[level], self._air_share[level])

    def _beyond(self, origin, direction, wavelength):
        """Light from beyond the surfaces along rays that hit none, (n, N)."""
        scene, spec, cosine = self.scene, self.scene.spec, direction[:, 2]
        if self.air is None:
            sky, around = (self._black(wavelength, t) for t in (spec.sky_temperature, scene.surroundings_temperature))
            return np.where(cosine[:, None] >= 0.0, sky, around)
        start, found = self._altitude(origin), np.empty((len(origin), len(self._of)))
        above = np.maximum(start - scene.altitude_m, 0.0)
        # Down to the sphere through the scene's origin, or past it.
        middle = (RADIUS_M + start) * cosine
        reach = middle**2 - above * (2.0 * RADIUS_M + start + scene.altitude_m)
        down = (cosine < 0.0) & (reach >= 0.0)
        if down.any():
            length = -middle[down] - np.sqrt(reach[down])
            far = wavelength[down]
            steps = np.linspace(0.0, 1.0, SKY_STEPS + 1)
            passed, light = self._along(start[down], cosine[down], length, far, steps)
            found[down] = light + passed * self._black(far, scene.surroundings_temperature)
        up = ~down
        sky, share, base = self._outward(start[up], cosine[up], wavelength[up])[1], self.air.cloud_fraction, None
        below = start[up] < self.air.cloud_base_m
        if share and below.any():
            base = self.air.cloud_base_m
            passed, light = self._outward(start[up][below], cosine[up][below], wavelength[up][below], base)
            warm = float(np.interp(base, self.air.altitude_m, self.air.temperature))
            cloud = light + passed * self._black(wavelength[up][below], warm)
            sky[below] = (1.0 - share) * sky[below] + share * cloud
        found[up] = sky
        return found

    def _outward(self, start, cosine, wavelength, top_m=TOP_M):
        """(transmittance, light) from altitudes up to another, each (n, N)."""
        start = np.maximum(start, 0.0)
        middle = (RADIUS_M + start) * cosine
        length = -middle + np.sqrt(middle**2 + (top_m - start) * (2.0 * RADIUS_M + top_m + start))
        return self._along(start, cosine, length, wavelength, np.linspace(0.0, 1.0, SKY_STEPS + 1) ** 4)

    def _sunlight(self, height):
        """(direction towards the sun, heights [m], transmittance there (h, N) of the air above, clouds included)."""
        elevation, azimuth = np.radians([self.scene.sun.elevation_deg, self.scene.sun.azimuth_deg])
        towards = np.array([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth),
                            np.sin(elevation)])  # fmt: skip
        at = self.scene.altitude_m + height
        middle = np.broadcast_to(0.5 * (self._low + self._high), (len(at), len(self._low)))
        passed, _ = self._outward(at, np.full(len(at), towards[2]), middle)
        passed *= np.where(at < self.air.cloud_base_m, 1.0 - self.air.cloud_fraction, 1.0)[:, None]
        return towards, height, passed

    def _lit(self, point, normal, wavelength):
        """Sunlight that a white diffuse surface would reflect, (n, N)."""
        towards = self._sun[0]
        cosine = normal @ towards
        seen = cosine > 0.0
        seen[seen] = self._cast(point[seen], np.broadcast_to(towards, (seen.sum(), 3)))[1] < 0
        return np.where(seen, cosine, 0.0)[:, None] * self._bright(point, wavelength) * SUN_SR / np.pi

    def _bright(self, point, wavelength):
        """Radiance of the sun's disc at points, (n, N)."""
        _, height, passed = self._sun
        column = np.stack([np.interp(point[:, 2], height, values) for values in passed.T], axis=1)
        kelvin = np.interp(wavelength, *SUN_K)
        planck = C1L / wavelength**5 / np.expm1(C2 / (wavelength * kelvin))
        share = self._share(np.interp(0.5 * (self._low[0] + self._high[-1]), *SUN_K))
        return (planck * (self._high - self._low))[:, self._of] * share * column

    def _disc(self, point, direction, wavelength):
        """Radiance of the sun along rays, (n, N); 0 beside its disc."""
        off = 2.0 * np.arcsin(0.5 * np.linalg.norm(direction - self._sun[0], axis=1))
        return self._bright(point, wavelength) * (off < np.sqrt(SUN_SR / np.pi))[:, None]


def undistorted(camera, place):
    """Return (x/z, y/z) of image places (n, 2) [px]: Brown and Conrady's model, inverted by fixed-point steps."""
    focal = camera.focal_length_mm * 1e3 / camera.pixel_pitch_um
    middle = np.array([camera.width, camera.height]) / 2 + camera.principal_offset_px
    target = (place - middle) / focal
    k1, k2, p1, p2, k3 = camera.distortion
    point = target.copy()
    for _ in range(200):
        x, y = point.T
        square = x * x + y * y
        across, down = 2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y
        shift = np.column_stack([across, down])
        before, point = point, (target - shift) / (1 + square * (k1 + square * (k2 + square * k3)))[:, None]
        if np.abs(point - before).max() < 1e-13:
            return point
    raise ArithmeticError("the distortion is too strong for fixed-point steps")


def fresnel(cosine, n, k):
    """Return the share of unpolarised light that a smooth surface of index n + ik reflects, broadcast.

    Fresnel's equations of an absorbing medium (Born and Wolf, Principles of Optics, section 14.4), in real numbers:
    (p + iq)² = (n + ik)² − sin²θ.
    """
    cosine = np.maximum(cosine, 1e-9)
    sine2 = 1.0 - cosine**2
    difference = n * n - k * k - sine2
    root = np.sqrt(difference**2 + 4.0 * n * n * k * k)
    p2, q2 = 0.5 * (root + difference), np.maximum(0.5 * (root - difference), 0.0)
    p, slope = np.sqrt(np.maximum(p2, 0.0)), sine2 / cosine
    across = ((cosine - p) ** 2 + q2) / ((cosine + p) ** 2 + q2)
    return 0.5 * across * (1.0 + ((p - slope) ** 2 + q2) / ((p + slope) ** 2 + q2))


def _refractive_index(scene, material):
    """(wavelength [µm], n, k) of a smooth material, from its table."""
    assert material.directional == "fresnel" and material.rms_slope == 0.0, f"{material.name} is not a smooth mirror"
    own = scene.spec.folder / "materials" / "spectra" / f"{material.name}.csv"
    path = own if own.exists() else data_folder("materials") / "spectra" / f"{material.name}.csv"
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert rows[0][:3] == ["wavelength_um", "n", "k"], path
    return np.array([[float(cell) for cell in row[:3]] for row in rows[1:]]).T


def _placed(scene, tracked, time_s, given):
    """[(surface, vertices in the scene, temperature)] of an object with a track: turned clockwise, on the ground."""
    item = tracked.item
    value = dict(zip(("east_m", "north_m", "above_ground_m"), item.position, strict=True))
    value |= {"yaw_deg": item.yaw_deg, "temperature_k": item.temperature}
    value |= {name: np.interp(time_s, tracked.time_s, column) for name, column in tracked.columns.items()} | given
    east, north, angle = value["east_m"], value["north_m"], -np.radians(value["yaw_deg"])
    up = float(scene.ground(east, north)) + value["above_ground_m"] + tracked.lift_m
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return [(s, s.vertices @ turn.T + [east, north, up], value["temperature_k"]) for s in tracked.surfaces]


def _risen(start, cosine, distance):
    """Altitude at a distance along straight rays over the sphere, without cancellation of large numbers."""
    square = distance**2 + 2.0 * (RADIUS_M + start) * distance * cosine
    return start + square / (np.sqrt((RADIUS_M + start) ** 2 + square) + RADIUS_M + start)


def _off(normal, even):
    """Directions off surfaces by the cosine law, (n, 3), from pairs of numbers 0…1."""
    side = np.where(np.abs(normal[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    one = np.cross(normal, side)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    other, radius, angle = np.cross(normal, one), np.sqrt(even[:, :1]), 2.0 * np.pi * even[:, 1:]
    return radius * (np.cos(angle) * one + np.sin(angle) * other) + np.sqrt(1.0 - even[:, :1]) * normal
