"""Turbid crowns against the leaves that they stand for, drawn one by one and rendered as solid, two-sided squares.

Leaves have the temperatures of the crown's halves at their height, and in the sun, tested among all leaves, more by
the angle between them and the sun. So the sums along rays, gaps, shadows and reflected light are compared, not the
heat balance.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import thermorender as tr
from scenes import WEATHER, coarse, scene_object, write_balance
from thermorender.apps.lands.solids.plants import write_leaf_tables
from thermorender.physics.sun import direction
from thermorender.render.arrays import aligned
from thermorender.render.geometry import Geometry
from thermorender.scene.meshes.mesh import one_texel_each

LEAF_M, SEEDS = 0.1, 3
# Shape, extents [m], places (east, north, base) [m], leaf area density [m²/m³].
PLANTS = {
    "broadleaf": ("sphere", [4.0, 4.0, 4.0], [(-3.0, 2.0, 1.0), (2.5, 1.5, 0.5), (0.5, 4.5, 1.0)], 1.2),
    "conifer": ("sphere", [2.2, 2.2, 7.0], [(-1.5, 2.0, 0.8), (1.2, 3.0, 0.8)], 2.5),
    "hedge": ("box", [6.0, 1.2, 1.6], [(0.0, 2.5, 0.0)], 4.0),
    "crop": ("box", [12.0, 10.0, 0.8], [(0.0, 2.5, 0.0)], 1.5),
}


def write_plants(folder, plant, time):
    """Write a flat scene with a plant whose temperatures follow the weather; return its folder."""
    shape, size, places, density = PLANTS[plant]
    folder.mkdir()
    rows = "".join(f"{east},{north},{up}\n" for east, north, up in places)
    (folder / "places.csv").write_text("east_m,north_m,above_ground_m\n" + rows)
    write_leaf_tables(folder)
    crowns = scene_object("plants", size, shape=shape, instances="places.csv", leaf_area_1_m=density, leaf_m=LEAF_M,
                          material="conifer" if plant == "conifer" else "broadleaf", temperature="balance")  # fmt: skip
    # Of one material: texture behind a crown has an error of its own.
    return write_balance(folder, extra=WEATHER.replace("12:00", time) + crowns, classes=np.ones((32, 32)))


def drawn(renderer, random):
    """The solved scene of a renderer with its crowns as single leaves."""
    scene, field, mi = renderer.scene, renderer.baked.geometry.crowns, renderer.baked.geometry.mi
    (crowns,), surface = field.crowns, scene.surfaces[1]
    azimuth, elevation = scene.weather.sun(scene.time)
    towards = direction(float(elevation), float(azimuth))
    leaves = renderer.baked.device.static_outgoing.leaves
    share = leaves._means(field) if leaves else np.zeros((len(crowns), 4))
    mean, warmer = (each.reshape(-1)[: 8 * len(crowns)].reshape(-1, 4, 2).mean(axis=2)
                    for each in (surface.temperature, surface.scatter_k))  # fmt: skip
    excess = warmer / (1.0 - share)
    shaded = mean - share * excess
    of = np.repeat(np.arange(len(crowns)), random.poisson(crowns.density * crowns.volume / LEAF_M**2))
    unit = random.uniform(-1.0, 1.0, (len(of), 3))
    if not crowns.box:
        unit = random.standard_normal((len(of), 3))
        unit *= random.uniform(size=(len(of), 1)) ** (1.0 / 3.0) / np.linalg.norm(unit, axis=1, keepdims=True)
    middle = unit * crowns.half[of] + crowns.middle[of]
    axes = np.linalg.qr(random.standard_normal((len(of), 3, 3)))[0].transpose(0, 2, 1)
    normal = axes[:, 2] * np.where(np.linalg.det(axes) < 0.0, -1.0, 1.0)[:, None]
    side = 0.5 * LEAF_M * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    square = middle[:, None] + np.einsum("ck,nki->nci", side, axes[:, :2])
    # So thin that the rims of the two sides hide 0.4 % more.
    vertices = np.concatenate([square + 1e-4 * normal[:, None], square[:, ::-1] - 1e-4 * normal[:, None]])
    faces = (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(vertices))[:, None, None]).reshape(-1, 3)
    uv, shape = one_texel_each(len(vertices))

    def solid(kelvin):
        return replace(
            surface, vertices=vertices.reshape(-1, 3), faces=faces.astype(np.int32), uv=np.repeat(uv, 2, axis=0),
            colour=np.broadcast_to(surface.colour[0, 0], (*shape, 3)),
            material=np.full(shape, surface.material.flat[0]), flags=np.ones(shape, np.uint8), instances=None,
            scatter_k=None, temperature=np.resize(np.tile(kelvin, 2), shape).astype(np.float32),
        )  # fmt: skip

    lit = np.zeros(len(of))
    if towards[2] > 0.0:
        among = Geometry(mi, [scene.surfaces[0], solid(np.full(len(of), 290.0))])
        facing = normal * np.sign(normal @ towards)[:, None]
        for _ in range(4):
            place = np.einsum("nk,nki->ni", random.uniform(-0.45, 0.45, (len(of), 2)) * LEAF_M, axes[:, :2])
            start = middle + place + 2e-3 * facing
            ray = mi.Ray3f(mi.Point3f(*map(aligned, start.T)), mi.Vector3f(*towards.tolist()))
            lit += 0.25 * ~np.array(among.caster.ray_test(ray), dtype=bool)
    # Linear in height, and in the volume that is nearer to the middle, with the means of the quarters.
    width = np.abs(unit).max(axis=1) if crowns.box else np.linalg.norm(unit, axis=1)
    shell, core_m = 2.0 * width**3 - 0.5, 0.5 ** (1.0 / 3.0)
    middles = np.array([core_m, 2.0 - core_m]) * (0.5 if crowns.box else 0.375)
    upper = 0.5 + 0.5 * unit[:, 2:] / middles
    weight = np.stack([1.0 - shell, shell], axis=1)[:, :, None] * np.stack([1.0 - upper, upper], axis=-1)
    low, more = ((weight.reshape(-1, 4) * each[of]).sum(axis=1) for each in (shaded, excess))
    kelvin = low + more * lit * 2.0 * np.abs(normal @ towards)
    made = scene.with_surfaces([scene.surfaces[0], solid(kelvin)], terrain_count=1)
    # The ground keeps its temperatures: leaves that are drawn would have other shadows.
    return made.with_solved_temperatures(scene.time, [scene.surfaces[0].temperature])


@pytest.mark.slow
@pytest.mark.parametrize("time", ["12:00", "18:00", "02:00"])
@pytest.mark.parametrize("plant", PLANTS)
def test_crowns_have_the_mean_of_their_leaves_and_state_the_scatter(tmp_path, plant, time):
    fine = tr.load_scene(write_plants(tmp_path / "s", plant, time))
    renderer = tr.Renderer(coarse(fine, 4), rays=512)
    off, scatter, stated = [], [], []
    middle = (0.0, 2.5, 1.5)
    # With pixels four times as wide as a camera's these are like 120 m, 480 m and 1 km.
    views = [(45.0, 40.0, 30.0), (10.0, 160.0, 30.0), (45.0, 250.0, 120.0), (10.0, 330.0, 250.0)]
    for seed in range(SEEDS):
        scene = drawn(renderer, np.random.default_rng(seed))
        # 256 rays for each pixel: of 4 × 4 finer ones, whose number of rays is the largest.
        truth = tr.Renderer(scene.with_camera(fine.camera), rays=128, samples=16, edge_mk=np.inf)
        found = []
        for slant, azimuth, away in views:
            up, turn = np.radians([slant, azimuth])
            place = away * np.array([np.sin(turn) * np.cos(up), np.cos(turn) * np.cos(up), np.sin(up)]) + middle
            pose = tr.pose(*place, look_at=middle)
            frame, other = renderer.frame(pose), truth.frame(pose).radiance
            other = other.reshape(len(other) // 4, 4, -1, 4).mean(axis=(1, 3))
            shown = cv2.dilate((frame.truth["object"] > 0).astype(np.uint8), np.ones((3, 3))) > 0
            shown &= np.isfinite(frame.error_mk)
            difference = (frame.radiance - other)[shown] / renderer.plan.radiance_per_mk / 1e3
            found.append((difference.mean(), np.mean(difference**2), np.mean(frame.error_mk[shown] ** 2) / 1e6))
        mean, square, own = np.array(found).T
        off.append(mean)
        scatter.append(square)
        stated.append(own)
    off, scatter, stated = (np.array(each) for each in (off, scatter, stated))
    error = off.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    print(plant, time, off.mean(axis=0).round(3), error.round(3), np.sqrt(scatter.mean(axis=0)).round(2),
          np.sqrt(stated.mean(axis=0)).round(2))  # fmt: skip
    assert (np.abs(off.mean(axis=0)) < 0.1 + 3.0 * error).all()
    assert (np.sqrt(scatter.mean(axis=0)) < 1.15 * np.sqrt(stated.mean(axis=0))).all()
