"""Light between surfaces against closed forms, its error estimate, and the cache of traced light."""

import multiprocessing
import os
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import write_mesh
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance, band_radiance_derivative, brightness_temperature
from thermorender.render.geometry import Geometry
from thermorender.render.light import radiosity, solver, transport_cache
from thermorender.render.light.environment import even
from thermorender.render.variant import activate
from validation import made_scenes

BAND = (7.5, 13.5)
WALL = band_radiance(300.0, *BAND)
EMISSIVITIES = np.array([0.9, 0.5, 0.1, 0.01, 0.001])


class Counting:
    """A transport operator that counts its products."""

    def __init__(self, operator):
        self.operator, self.products = operator, 0

    def __matmul__(self, values):
        self.products += 1
        return self.operator @ values


def traced(folder, mesh, rays, seed=0):
    """(Transport, corners (F, 3, 3), areas (F,)) of a mesh."""
    surfaces = tr.load_scene(write_mesh(folder, mesh)).surfaces
    corners = surfaces[0].vertices[surfaces[0].faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return radiosity.trace(Geometry(activate(), surfaces), rays, seed=seed), corners, area


def solved(transport, emissivity, tolerance=1e-6, wall=WALL):
    """(radiance leaving, incident, error bound) of walls at one temperature under a black surround, one node per ε."""
    emitted = np.broadcast_to(wall * np.asarray(emissivity), (len(transport.up), len(emissivity)))
    reflectance = np.broadcast_to(1.0 - np.asarray(emissivity), emitted.shape)
    outside = even(np.zeros(len(emissivity)), np.zeros(len(emissivity)), len(emitted))
    found = solver.solve(transport, emitted, reflectance, outside, tolerance)
    return emitted + reflectance * found.incident, found.incident, found.bound


def rough(count=25, seed=3):
    """Steep random terrain as a mesh of 2 (count − 1)² faces."""
    rows, columns = np.mgrid[:count, :count]
    height = np.random.default_rng(seed).uniform(0.0, 1.5, (count, count))
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([b, d, c])])
    return trimesh.Trimesh(np.column_stack([columns.ravel(), rows.ravel(), height.ravel()]), faces, process=False)


def groove(strips, along):
    """V-groove of 60° along y, with walls 1 m wide of `strips` strips that get narrower towards the bottom."""
    place = np.linspace(0.0, 1.0, strips + 1) ** 2
    vertices, faces, n = [], [], len(along)
    for side in (-1.0, 1.0):
        base = len(vertices)
        vertices += [(side * 0.5 * x, y, np.sqrt(0.75) * x) for x in place for y in along]
        for i in range(strips):
            for j in range(n - 1):
                a = base + i * n + j
                two = ([a, a + 1, a + n], [a + 1, a + n + 1, a + n])
                faces += two if side < 0 else [face[::-1] for face in two]
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.fixture(scope="module")
def cavity(tmp_path_factory):
    """(Transport, area fraction of each face, fraction f of the opening) of a sphere without a tenth of its faces."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    whole = sphere.area
    sphere.update_faces(sphere.triangles_center[:, 2] / np.linalg.norm(sphere.triangles_center, axis=1) < 0.8)
    sphere.invert()
    transport, _, area = traced(tmp_path_factory.mktemp("cavity") / "s", sphere, 1024)
    return transport, area / area.sum(), 1.0 - sphere.area / whole


@pytest.fixture(scope="module")
def terrain(tmp_path_factory):
    return traced(tmp_path_factory.mktemp("terrain") / "s", rough(), 64)[0]


@pytest.mark.slow
def test_spherical_cavity_with_an_opening(cavity):
    transport, weight, opening = cavity
    assert opening == pytest.approx(0.1, abs=1e-3)
    exact = EMISSIVITIES / (1.0 - (1.0 - EMISSIVITIES) * (1.0 - opening))
    leaving, _, _ = solved(transport, EMISSIVITIES)
    error = brightness_temperature(weight @ leaving, *BAND) - brightness_temperature(exact * WALL, *BAND)
    # Standard error of the opening's mean share, from the two halves of the rays, propagated to temperature.
    seen = transport.up.sum(axis=2) + transport.down.astype(float)
    share_error = np.sqrt((((seen[:, 0] - seen[:, 1]) / transport.rays / 2 * weight) ** 2).sum())
    slope = band_radiance_derivative(brightness_temperature(exact * WALL, *BAND), *BAND)
    sigma = exact**2 * (1.0 - EMISSIVITIES) / EMISSIVITIES * WALL * share_error / slope
    report = [
        f"ε {emissivity:g}: {1e3 * off:+.2f} ± {1e3 * one:.2f} mK, {off / one:+.1f} σ"
        for emissivity, off, one in zip(EMISSIVITIES, error, sigma, strict=True)
    ]
    assert sigma.max() < 0.007, report
    assert np.abs(error).max() < 0.010 and np.abs(error / sigma).max() < 3.0, report


@pytest.mark.slow
def test_number_of_products_hardly_depends_on_emissivity(cavity, monkeypatch):
    transport, counted = cavity[0], Counting(cavity[0].operator)
    monkeypatch.setattr(radiosity.Transport, "among", lambda *_: (counted, counted))
    # 1 mK of a wall at 300 K, for every emissivity.
    tolerance = 1e-3 * band_radiance_derivative(300.0, *BAND)
    for emissivity in EMISSIVITIES[:, None]:
        before = counted.products
        assert solved(transport, emissivity, tolerance)[2] <= tolerance
        # Plain bounces would need ln(1e-5) / ln(0.999 · 0.9) = 108 for the last.
        assert counted.products - before <= 20, emissivity


def test_closed_isothermal_enclosure_of_low_emissivity(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
    sphere.invert()
    transport, _, _ = traced(tmp_path / "s", sphere, 64)
    leaving, incident, bound = solved(transport, [0.001], tolerance=0.5e-3 * band_radiance_derivative(300.0, *BAND))
    assert np.abs(brightness_temperature(leaving, *BAND) - 300.0).max() < 1e-3
    # The bound is not exceeded; it allows for the 1000 bounces between these walls.
    assert np.abs(incident - WALL).max() <= bound


@pytest.mark.slow
def test_long_v_groove(tmp_path):
    # Sparrow's integral equation of the walls' radiosity, solved by Gauss quadrature with 200…800 graded nodes: the
    # mean over the mouth, which is as wide as a wall.
    exact = np.array([0.943050, 0.654098, 0.179658])
    along = [-20.0, -8.0, -2.0, -0.5, 0.5, 2.0, 8.0, 20.0]
    transport, corners, area = traced(tmp_path / "s", groove(24, along), 16384)
    middle = np.abs(corners[..., 1]).max(axis=1) < 0.5 + 1e-5
    leaving, _, _ = solved(transport, EMISSIVITIES[:3], tolerance=1e-7, wall=1.0)
    escaping = area * (transport.sky.sum(axis=1) + transport.background)
    found = (escaping[:, None] * leaving)[middle].sum(axis=0)
    assert area[middle].sum() == pytest.approx(2.0, abs=1e-5)
    # Standard error of the escaping light, from the two halves of the rays. Rays start 64 · 2⁻²⁴ · 21 m off the wall,
    # 8e-5 of its width. Less than (1 / 20)² / 12 of a wall's view is more than 20 m away.
    seen = transport.up.sum(axis=2) + transport.down.astype(float)
    half = (seen[:, 0] - seen[:, 1]) / transport.rays / 2 * area
    sigma = np.sqrt(((half[:, None] * leaving)[middle] ** 2).sum(axis=0))
    assert (np.abs(found - exact) < 3.0 * sigma + 8e-5 + 2.1e-4).all(), (found - exact, sigma)


def test_noise_estimate_matches_the_error_against_more_rays(tmp_path):
    random = np.random.default_rng(4)
    mesh = rough()
    # If walls emit (1 − ρ) c under a surround of c, all radiance is c without error. The second node is half of what
    # the first lacks of c = 200, so its error is −½ of the first's: the errors must add with their signs.
    emitted = random.uniform(8.0, 12.0, len(mesh.faces))
    emitted = np.column_stack([emitted, 0.5 * (20.0 - emitted)])
    reflectance = np.full(emitted.shape, 0.9)
    light = (emitted, reflectance, even(np.array([5.0, 97.5]), np.array([90.0, 55.0]), len(emitted)))
    truth = solver.solve(traced(tmp_path / "t", mesh, 64 * 64, seed=9)[0], *light, 1e-5).incident
    ratios = []
    for seed in (0, 1):
        transport = traced(tmp_path / f"s{seed}", mesh, 64, seed)[0]
        found = solver.solve(transport, *light, 1e-5)
        incident, each = found.incident, found.noise
        assert each.shape == (len(mesh.faces),)
        error = (reflectance * (incident - truth)).sum(axis=1)
        ratios.append(np.sqrt(np.mean(each**2) / np.mean(error**2)))
    # 1152 draws give a deviation to 1 / √(2 · 1152) = 2 %. Halves that fill each other's gaps overestimate the noise.
    assert all(0.94 < ratio < 1.5 for ratio in ratios), ratios


def test_halves_have_independent_errors_and_sum_to_the_whole(terrain, tmp_path):
    shares = np.asarray(terrain.operator.sum(axis=1)).ravel() + terrain.sky.sum(axis=1) + terrain.background
    np.testing.assert_allclose(shares, 1.0, atol=1e-12)
    outside = terrain.up.sum(axis=2) + terrain.down
    hits = [terrain.halves(part) for part in terrain.parts()]
    rays = np.concatenate([np.asarray(each.sum(axis=1)).reshape(-1, 2) for each in hits]) + outside
    np.testing.assert_array_equal(rays, terrain.rays)
    assert all(np.shares_memory(each.indices, terrain.seen) for each in hits)
    better = traced(tmp_path / "s", rough(), 4096)[0]
    error = terrain.up.sum(axis=2) / terrain.rays - better.sky.sum(axis=1)[:, None]
    # The estimate of noise could not see errors that both halves have in common.
    assert np.corrcoef(error.T)[0, 1] < 4.0 / np.sqrt(len(error))


def test_odd_and_single_rays(tmp_path):
    transport, _, _ = traced(tmp_path / "s", rough(4), 1)
    assert transport.rays == 1 and (transport.up.sum(axis=2) + transport.down).max() <= 1
    assert np.asarray(transport.operator.sum(axis=1)).max() <= 1.0
    assert [traced(tmp_path / f"s{rays}", rough(4), rays)[0].rays for rays in (64, 65)] == [32, 33]


def test_blocks_of_nodes_change_the_solution_within_its_error(monkeypatch):
    scene = made_scenes.terrain(2000, 64)
    together = tr.Renderer(scene, rays=16).baked
    assert together.plan.spectrum.nodes > 2
    monkeypatch.setattr(solver, "_KRYLOV_BYTES", 8 * together.geometry.face_count * 20 * 2)
    assert [part.stop - part.start for part in solver.blocks(together.geometry.face_count, 5)] == [2, 2, 1]
    apart = tr.Renderer(scene, rays=16).baked
    error = (together.errors_mk["solution"] + apart.errors_mk["solution"]) * together.plan.radiance_per_mk
    for one, other in zip((*together.texels, together.faces), (*apart.texels, apart.faces), strict=True):
        np.testing.assert_allclose(other, one, rtol=3e-7, atol=2.0 * error + 1e-6)
    assert apart.errors_mk["noise"] == pytest.approx(together.errors_mk["noise"], rel=0.06)


def test_threads_do_not_change_a_byte_and_parts_only_the_rounding(terrain, monkeypatch):
    emissivity = [0.95, 0.7, 0.4]
    monkeypatch.setattr(radiosity, "_FACES_AT_ONCE", 100)
    assert len(terrain.parts()) > 5
    found = []
    for count in (1, 3):
        monkeypatch.setattr(solver, "threads", lambda count=count: ThreadPoolExecutor(count))
        found.append(solved(terrain, emissivity)[1])
    np.testing.assert_array_equal(*found)
    monkeypatch.setattr(radiosity, "_FACES_AT_ONCE", 3000)
    assert len(terrain.parts()) == 1
    np.testing.assert_allclose(solved(terrain, emissivity)[1], found[0], rtol=1e-12)


def test_enclosures_without_loss_are_refused(tmp_path):
    box = trimesh.creation.box(extents=(4, 4, 4))
    box.invert()
    transport, _, _ = traced(tmp_path / "s", box, 16)
    with pytest.raises(ThermorenderError, match=r"reflect 1.00000000 of the light between them, which never leaves"):
        solved(transport, [0.0])
    with pytest.raises(ThermorenderError, match=r"does not converge: .* remain where 1e-30 are allowed; give a larger"):
        solved(transport, [0.5, 0.6], tolerance=1e-30)


# ------------------------------------------------------------------------------------------------ the cache


@pytest.fixture
def kept(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept" / "light"


def same(a, b):
    return a.rays == b.rays and all(
        getattr(a, name).dtype == getattr(b, name).dtype and np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("start", "seen", "hits", "up", "down")
    )


def test_cache_returns_what_was_stored(terrain, kept):
    assert transport_cache.load("a" * 40) is None
    assert transport_cache.store("a" * 40, terrain) is None
    assert same(transport_cache.load("a" * 40), terrain)
    assert [path.name for path in kept.iterdir()] == ["a" * 40 + ".npz"]
    # A file renamed to another scene's key is ignored.
    (kept / ("a" * 40 + ".npz")).rename(kept / ("b" * 40 + ".npz"))
    assert transport_cache.load("b" * 40) is None


def test_cache_avoids_tracing_again(kept, tmp_path, monkeypatch):
    geometry = Geometry(activate(), tr.load_scene(write_mesh(tmp_path / "s", rough(8))).surfaces)
    small, why = transport_cache.traced(geometry, 64)
    assert why is None and not kept.exists()
    monkeypatch.setattr(transport_cache, "WORTH_RAYS", 0)
    first, why = transport_cache.traced(geometry, 64)
    assert why is None and same(first, small)
    with monkeypatch.context() as patch:
        patch.setattr(radiosity, "trace", lambda *_: pytest.fail("light was traced again"))
        assert same(transport_cache.traced(geometry, 64)[0], first)
    (file,) = kept.iterdir()
    file.write_bytes(file.read_bytes()[:-500])
    assert same(transport_cache.traced(geometry, 64)[0], first)
    # The damaged file was replaced.
    assert same(transport_cache.load(file.stem), first)


def test_key_depends_on_everything_that_light_depends_on(tmp_path, monkeypatch):
    def geometry(mesh, name):
        surfaces = tr.load_scene(write_mesh(tmp_path / name, mesh)).surfaces
        return SimpleNamespace(mi=activate(), surfaces=surfaces)

    plain, moved, turned = rough(4), rough(4), rough(4)
    moved.vertices[3, 2] += 1e-3
    turned.invert()
    a = geometry(plain, "a")
    assert transport_cache.key(a, 64) == transport_cache.key(geometry(plain, "b"), 64)
    names = [transport_cache.key(a, 64), transport_cache.key(a, 66), transport_cache.key(a, 64, seed=1)]
    names += [transport_cache.key(geometry(moved, "c"), 64), transport_cache.key(geometry(turned, "d"), 64)]
    monkeypatch.setattr(radiosity, "VERSION", radiosity.VERSION + 1)
    names.append(transport_cache.key(a, 64))
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("damage", ["empty", "truncated", "text", "flipped"])
def test_damaged_files_are_ignored(damage, terrain, kept):
    assert transport_cache.store("c" * 40, terrain) is None
    (file,) = kept.iterdir()
    whole = file.read_bytes()
    random = np.random.default_rng(1)
    if damage == "empty":
        versions = [b""]
    elif damage == "truncated":
        versions = [whole[: int(n)] for n in random.integers(1, len(whole), 20)]
    elif damage == "text":
        versions = [b"not light " * 1000]
    else:
        versions = []
        for place in random.integers(0, len(whole), 60):
            changed = bytearray(whole)
            changed[place] ^= 1 << random.integers(8)
            versions.append(bytes(changed))
    for content in versions:
        file.write_bytes(content)
        found = transport_cache.load("c" * 40)
        # A flipped bit in a time stamp and the like does not change the light.
        assert found is None or (damage == "flipped" and same(found, terrain))
    file.write_bytes(versions[0])
    assert transport_cache.store("c" * 40, terrain) is None and same(transport_cache.load("c" * 40), terrain)


def _store_often(folder, name, own, other, count):
    os.environ["THERMORENDER_CACHE"] = str(folder)
    wrong = 0
    for _ in range(count):
        wrong += transport_cache.store(name, own) is not None
        found = transport_cache.load(name)
        wrong += found is None or not (same(found, own) or same(found, other))
    os._exit(wrong)


def test_two_processes_store_at_once(terrain, kept, tmp_path):
    # Different light under one key, so that a mixture of both would match neither.
    plain = [
        radiosity.Transport(*vars(light).values()) for light in (terrain, traced(tmp_path / "s", rough(12), 64)[0])
    ]
    spawn = multiprocessing.get_context("spawn")
    arguments = [(kept.parent, "d" * 40, *pair, 60) for pair in (plain, plain[::-1])]
    both = [spawn.Process(target=_store_often, args=each) for each in arguments]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    assert any(same(transport_cache.load("d" * 40), light) for light in plain) and len(list(kept.iterdir())) == 1


def test_unwritable_folder_gives_the_reason(terrain, tmp_path, monkeypatch):
    # A file where the folder should be: no user, not even root, can write there.
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "file" / "kept"))
    assert transport_cache.load("e" * 40) is None
    why = transport_cache.store("e" * 40, terrain)
    assert "file/kept/light cannot be written (Not a directory); set THERMORENDER_CACHE to a writable folder" in why


def test_interrupted_store_leaves_nothing(terrain, kept, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        transport_cache.store("f" * 40, terrain)
    assert not kept.exists()


def test_least_recently_used_is_removed_first(terrain, kept):
    a, b, c, d, e = (letter * 40 for letter in "abcde")
    for age, name in enumerate((a, b, c)):
        assert transport_cache.store(name, terrain) is None
        os.utime(kept / f"{name}.npz", (1e9 - age, 1e9 - age))
    old, new = (kept / f".{a}.{token}.part.npz" for token in ("01234567", "89abcdef"))
    for part in (old, new):
        part.write_bytes(b"x")
    os.utime(old, (time.time() - 7200,) * 2)
    # c has the oldest time stamp but was just used, so b is next.
    assert transport_cache.load(c) is not None
    size = (kept / f"{a}.npz").stat().st_size
    assert transport_cache.store(d, terrain, limit=3 * size + 100) is None
    assert {path.name for path in kept.iterdir()} == {f"{a}.npz", f"{c}.npz", f"{d}.npz", new.name}
    why = transport_cache.store(e, terrain, limit=1000)
    assert "GB exceed the cache's limit of" in why and not (kept / f"{e}.npz").exists()


def test_trimming_leaves_other_files_alone(terrain, kept):
    # A folder that the user names may hold other files, older than all light and larger than the limit.
    names = ["results.npz", "film.part", f"{'a' * 40}.npz", "light/results.npz", "light/film.part"]
    names += [f"light/{'e' * 39}.npz", "light/.x.01234567.part.npz"]
    for name in names:
        (kept.parent / name).parent.mkdir(parents=True, exist_ok=True)
        (kept.parent / name).write_bytes(bytes(1 << 20))
        os.utime(kept.parent / name, (1e9, 1e9))
    # Less than two of them together: all but the last have to go.
    limit = int(1.5 * sum(getattr(terrain, which).nbytes for which in ("start", "seen", "hits", "up", "down")))
    for name in ("b", "c", "d"):
        assert transport_cache.store(name * 40, terrain, limit=limit) is None
    assert not (kept / f"{'c' * 40}.npz").exists() and (kept / f"{'d' * 40}.npz").exists()
    assert [name for name in names if not (kept.parent / name).exists()] == []
