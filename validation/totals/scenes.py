"""Scenes in which bodies stand on the ground and on each other, and views of them."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.lands.procedural.three_d import make_world
from thermorender.apps.lands.procedural.three_d import write as write_world
from thermorender.apps.lands.procedural.truth import write
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.scene.load import load_scene

BAND_UM = (7.5, 13.5)
# A camera of 45° by 37° without noise of its own.
CAMERA = """width = 96
height = 78
pixel_pitch_um = 112.18284
focal_length_mm = 13.0
f_number = 1.0
lens_transmittance = 1.0
band_um = [7.5, 13.5]
netd_mk = 0.001
netd_f_number = 1.0
bits = 16
range_c = [-120.0, 700.0]
frame_rate_hz = 30.0
"""
# Drawn for the ground and for bodies on it.
_GROUNDS = ("steel_galvanised_oxidised", "asphalt", "concrete", "aluminium_weathered", "soil_loam", "grass_green")
_BODIES = ("concrete", "paint_metallic", "brick_clay", "steel_galvanised", "paint_black", "aluminium_sheet")


@dataclass(frozen=True)
class Case:
    """A scene and a view of it.

    Attributes
    ----------
    name : str
    make : callable
        (new folder) → path of the scene.
    view : callable
        (Scene) → world_from_camera.
    strip : tuple, optional
        Of the ground, whose closed form is known: lowest and highest x [m], and
        (emissivity of ground, of wall) → temperature [K].
    """

    name: str
    make: Callable[[Path], Path]
    view: Callable[[Any], Any]
    strip: tuple[float, float, Callable[[float, float], float]] | None = None


def chosen() -> list[Case]:
    """Return the eleven chosen cases."""
    # The foot lies in the middle of terrain triangles.
    wall = {"size": [2.0, 30.0, 8.0], "position": [-5.5, 0.0, 0.0]}
    other = {"size": [2.0, 30.0, 8.0], "position": [0.5, 0.0, 0.0]}
    car = [
        _box("body", [1.8, 4.4, 0.7], [0.0, 0.0, 0.25], 320.0, "paint_metallic"),
        _box("cabin", [1.58, 2.2, 0.5], [0.0, -0.35, 0.95], 315.0, "glass"),
        _box("bonnet", [1.6, 1.1, 0.04], [0.0, 1.55, 0.95], 340.0, "paint_metallic"),
    ]

    def case(name, ground, objects, strip=None, down=True, ground_k=300.0, post_m=1.0, slope=0.0):
        view = _down if down else _oblique
        return Case(name, _maker(ground, ground_k, objects, post_m, slope), view, strip)

    steel, hot = "steel_galvanised_oxidised", [_box("wall", **wall, kelvin=330.0)]
    return [
        case("wall of 330 K, steel", steel, hot, (-4.3, -3.9, _beside(330.0, 0.2, 0.6))),
        case("wall of 330 K, steel, 2 m posts", steel, hot, (-4.3, -3.9, _beside(330.0, 0.2, 0.6)),
             post_m=2.0),
        case("wall of 450 K, asphalt", "asphalt", [_box("wall", **wall, kelvin=450.0)],
             (-4.3, -3.9, _beside(450.0, 0.2, 0.6))),
        case("wall of 315 K, asphalt", "asphalt", [_box("wall", **wall, kelvin=315.0)],
             (-4.3, -3.9, _beside(315.0, 0.2, 0.6))),
        case("canyon of 4 m", "concrete", [_box("wall", **wall, kelvin=310.0), _box("other", **other, kelvin=310.0)],
             (-4.3, -0.7, _beside(310.0, 0.2, 3.8, across_m=4.0))),
        case("wall of 330 K, oblique", steel, hot, down=False),
        case("wall of 330 K on a slope", steel, hot, slope=0.3, down=False),
        case("car of three boxes", "asphalt", car, down=False, post_m=0.5),
        Case("village with cars", _land("village", 5151), _village),
        Case("sunken posts as copies", _posts(steel), _oblique),
        case("a hundred small boxes", steel, _small(100), down=False),
    ]  # fmt: skip


def drawn(seed: int = 0) -> list[Case]:
    """Return twenty drawn cases: bodies on grounds, villages with cars, and lands in three dimensions."""
    random = np.random.Generator(np.random.Philox(seed))
    return [*(_bodies(random, number) for number in range(12)), *(_lands(random))]


def _bodies(random, number):
    ground, post = str(random.choice(_GROUNDS)), float(random.choice([0.5, 1.0, 2.0]))
    slope, ground_k = float(random.uniform(0.0, 0.4)), float(random.uniform(285.0, 315.0))
    objects = []
    for k in range(int(random.integers(1, 5))):
        size = [float(v) for v in random.uniform([0.5, 0.5, 0.4], [6.0, 12.0, 8.0])]
        place = [float(v) for v in random.uniform(-8.0, 8.0, 2)] + [float(random.uniform(-0.3, 0.1))]
        objects.append(_box(f"b{k}", size, place, float(random.uniform(270.0, 420.0)), str(random.choice(_BODIES)),
                            yaw_deg=float(random.uniform(0.0, 360.0))))  # fmt: skip
        if random.random() < 0.5:
            top = [0.6 * size[0], 0.5 * size[1], 0.5 * size[2]]
            objects.append({**objects[-1], "name": f"t{k}", "size": top,
                            "position": [*place[:2], place[2] + size[2]],
                            "temperature": float(random.uniform(270.0, 380.0))})  # fmt: skip
    turn, pitch = random.uniform(0.0, 2.0 * np.pi), np.radians(random.uniform(25.0, 90.0))
    far = random.uniform(25.0, 45.0)

    def view(scene):
        reach, up = min(far * np.cos(pitch), 28.0), far * np.sin(pitch)
        return scene.pose(reach * np.sin(turn), reach * np.cos(turn), up, look_at=(0.0, 0.0, 1.0))

    return Case(f"bodies {number} on {ground}", _maker(ground, ground_k, objects, post, slope), view)


def _lands(random):
    for kind, three_d in (("village", False),) * 3 + (("village", True),) * 3 + (("heath", True),) * 2:
        seed = int(random.integers(1000, 9999))
        turn, low = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.3, 1.4)
        far = float(random.uniform(14.0, 40.0))

        def view(scene, turn=turn, low=low, far=far):
            # Within the terrain, to count heights from it.
            reach = min(far * np.cos(low), 16.0)
            return scene.pose(reach * np.sin(turn), reach * np.cos(turn), far * np.sin(low), look_at=(0.0, 0.0, 0.0))

        name = f"{kind} {seed}" + (" in three dimensions" if three_d else "")
        yield Case(name, _land(kind, seed, three_d), view)


def _box(name, size, position, kelvin, material="concrete", yaw_deg=0.0):
    return {"name": name, "shape": "box", "size": size, "position": position, "yaw_deg": yaw_deg,
            "temperature": kelvin, "material": material}  # fmt: skip


def _small(count):
    """Boxes of 0.2 to 0.4 m on a grid of 1 m: more triangles than objects may add."""
    random = np.random.Generator(np.random.Philox(7))
    return [
        _box(f"small{k}", [float(v) for v in random.uniform(0.2, 0.4, 3)], [k % 10 - 6.5, k // 10 - 4.5, 0.0],
             float(random.uniform(280.0, 360.0)), str(random.choice(_BODIES)), float(random.uniform(0.0, 90.0)))
        for k in range(count)
    ]  # fmt: skip


def _down(scene):
    return scene.pose(-3.5, 0.0, 22.0, pitch_deg=-90.0)


def _oblique(scene):
    return scene.pose(12.0, -12.0, 14.0, look_at=(-2.0, 0.0, 1.0))


def _village(scene):
    return scene.pose(0.0, -12.0, 14.0, look_at=(0.0, 0.0, 0.0))


def _land(kind, seed, three_d=False):
    def made(folder):
        if three_d:
            write_world(make_world(kind, seed, 36.0, None, None), folder)
        else:
            write(make(kind, seed, 60.0, 0.5, None), folder)
        text = (folder / "scene.toml").read_text(encoding="utf-8").replace("zenmuse-xt2", "camera.toml")
        (folder / "scene.toml").write_text(text, encoding="utf-8")
        (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
        return folder

    return made


def _posts(ground):
    """Twenty posts, copies of one, a third of each below the ground."""
    post = {**_box("posts", [0.4, 0.4, 3.0], [0.0, 0.0, -1.0], 340.0, "paint_metallic"), "instances": "posts.csv"}

    def made(folder):
        _maker(ground, 300.0, [post], 1.0, 0.0)(folder)
        random = np.random.Generator(np.random.Philox(3))
        rows = (f"{x:.2f},{y:.2f},{yaw:.0f}\n" for x, y, yaw in random.uniform([-9, -9, 0], [9, 9, 90], (20, 3)))
        (folder / "posts.csv").write_text("east_m,north_m,yaw_deg\n" + "".join(rows), encoding="utf-8")
        return folder

    return made


def _maker(ground, kelvin, objects, post_m, slope):
    """Write a scene of level or hilly ground with objects, seen by `CAMERA`, under a sky of 230 K."""

    def made(folder):
        import rasterio

        folder.mkdir(parents=True)
        count = round(60.0 / post_m) + 1
        east, north = np.meshgrid(*2 * [np.linspace(-30.0, 30.0, count)])
        height = slope * (0.5 * east + 3.0 * np.sin(east / 7.0) * np.cos(north / 9.0))
        with rasterio.open(
            folder / "elevation.tif", "w", driver="GTiff", count=1, dtype="float32", height=count, width=count,
            crs="EPSG:32634", transform=rasterio.Affine(post_m, 0.0, 5e5, 0.0, -post_m, 5.78e6),
        ) as file:  # fmt: skip
            file.write(height[None].astype(np.float32))
        (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
        text = f"""[terrain]
elevation = "elevation.tif"
[temperature]
source = "constant"
value = {kelvin}
[emissivity]
source = "material"
material = "{ground}"
[sky]
temperature = 230.0
[camera]
model = "camera.toml"
"""
        for item in objects:
            text += "[[object]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in item.items())
        (folder / "scene.toml").write_text(text, encoding="utf-8")
        return folder

    return made


def _beside(kelvin, near_m, far_m, ground_k=300.0, across_m=None):
    """(emissivities of ground and wall) → mean apparent temperature [K] of ground between two distances from a wall.

    The wall is 30 m long and 8 m high, and its middle 12 m count. With `across_m` the same wall stands on the other
    side. A rectangle of height a above the end of whose foot, at distance c and along b of it, a level element lies,
    has the share [arctan(b/c) − c/√(a² + c²) arctan(b/√(a² + c²))] / 2π of its hemisphere: Howell, Mengüç and Siegel,
    "Thermal radiation heat transfer", configuration C-11. The wall reflects sky and ground once.
    """
    node, weight = np.polynomial.legendre.leggauss(32)
    x = 0.5 * (near_m + far_m) + 0.5 * (far_m - near_m) * node[:, None]
    y = 6.0 * node

    def share(c):
        slant = np.hypot(c, 8.0)
        ends = (np.arctan(b / c) - c / slant * np.arctan(b / slant) for b in (15.0 - y, 15.0 + y))
        return sum(ends) / (2.0 * np.pi) @ weight / 2.0

    walls = share(x) + (0.0 if across_m is None else share(across_m - x))

    def expected(ground, wall):
        sky, own = (band_radiance(t, *BAND_UM) for t in (230.0, ground_k))
        beside = ground * own + (1.0 - ground) * sky
        hot = wall * band_radiance(kelvin, *BAND_UM) + (1.0 - wall) * 0.5 * (sky + beside)
        seen = ground * own + (1.0 - ground) * (walls * hot + (1.0 - walls) * sky)
        return float(brightness_temperature(0.5 * weight @ seen, *BAND_UM))

    return expected


def load(case, folder):
    """Return the Scene of a case, written to a new folder."""
    return load_scene(case.make(folder))
