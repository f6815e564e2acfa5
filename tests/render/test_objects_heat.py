"""Temperatures of objects by heat balance: closed forms, the same plate as terrain, and a car over a day."""

import drjit as dr
import numpy as np
import pytest
import trimesh
from scipy.optimize import brentq

import thermorender as tr
from scenes import WEATHER, scene_object, write_balance
from thermorender.physics import balance, turbulence
from thermorender.physics.balance import ColumnProperties, Forcing
from thermorender.physics.conduction import Slab, layered
from thermorender.render.heat.instants import solved_at
from thermorender.render.heat.matter import evaluate
from thermorender.render.heat.steps import Library
from thermorender.render.variant import activate
from thermorender.scene import open_ground

SIGMA = 5.670374419e-8
# The film of moving air behind a sheet: ISO 6946, table 7 [W m⁻² K⁻¹].
BEHIND = 1.0 / 0.04
AIR_K, SKY_K = 285.0, 255.0
# Bodies of a car, each (lowest, highest corner) [m]: x right, y ahead, z up.
CAR = {
    "body": ((-0.9, -2.2, 0.3), (0.9, 0.9, 0.85)),
    "bonnet": ((-0.9, 0.9, 0.3), (0.9, 2.2, 0.85)),
    "cabin": ((-0.8, -1.65, 0.85), (0.8, 0.8, 1.45)),
}


def at_night(scene):
    """The scene at 02:00 UTC, before dawn."""
    return scene.at("2018-07-28T02:00Z")


def write_car(path):
    """Write the boxes of `CAR` as an OBJ file of one object each."""
    lines, count = [], 0
    for name, (low, high) in CAR.items():
        box = trimesh.creation.box(bounds=[low, high])
        lines += [f"o {name}", *("v {:g} {:g} {:g}".format(*vertex) for vertex in box.vertices)]
        lines += ["f {} {} {}".format(*(face + 1 + count)) for face in box.faces]
        count += len(box.vertices)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def upper(surface, height, south_of=np.inf):
    """(temperatures of the faces that look up at a height, and reach south of a place [m], their areas), (n,) [K]."""
    corner = surface.vertices[surface.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    level = (across[:, 2] > 0.99 * np.linalg.norm(across, axis=1)) & (np.ptp(corner[..., 2], axis=1) < 1e-6)
    here = level & (abs(corner[:, 0, 2] - height) < 1e-3) & (corner[..., 1].min(axis=1) < south_of)
    return surface.temperature.ravel()[: len(corner)][here], 0.5 * across[here, 2]


# Through a thicker sheet with air behind, its own resistance counts.
@pytest.mark.parametrize(("thickness_m", "behind"), [(1e-5, BEHIND), (1e-4, BEHIND), (1e-4, None), (1e-3, None)])
def test_steady_sheet_in_the_dark_balances_its_inner_heat(thickness_m, behind):
    """q = ε σ (T⁴ − T_sky⁴) + h (T − T_air), in single precision on the device."""
    mi = activate()
    flux = np.array([0.0, 50.0, 400.0, 2000.0])
    emissivity = 0.9
    sheet = layered([Slab(thickness_m, 60.5, 7854.0 * 434.0)], film=behind)
    one = lambda value: mi.Float(np.full(len(flux), value, np.float32))  # noqa: E731
    # Without roughness only the exchange of calm air is left.
    ground = ColumnProperties(
        emissivity=one(emissivity), log_wind=one(10.0), log_heat=one(1e12), height_m=one(2.0), resistance=one(1e9),
        wetness=one(0.0), open_water=one(0.0), leaves=one(0.0), held=one(0.5), melting=one(0.0),
        capacity=[one(value) for value in sheet.capacity], conductance=[one(value) for value in sheet.conductance],
    )  # fmt: skip
    forcing = Forcing(
        absorbed=one(0.0), longwave=one(SIGMA * SKY_K**4), sunlight=one(0.0), air_k=one(AIR_K), vapour_pa=one(1.0),
        wind_m_s=one(1.0), pressure_pa=one(101325.0), rain_kg_m2_s=one(0.0), below_k=one(AIR_K),
        inner_w_m2=mi.Float(flux.astype(np.float32)),
    )  # fmt: skip
    state = balance.at_rest(Library, [one(AIR_K)] * len(sheet.capacity), ground)
    for _ in range(60):
        state, _ = balance.step(Library, state, ground, forcing, forcing, dr.opaque(mi.Float, 900.0))
        evaluate(state)
    exchange = turbulence.CALM_W_M2_K + (behind or 0.0)
    expected = [
        brentq(lambda t, q=q: emissivity * SIGMA * (t**4 - SKY_K**4) + exchange * (t - AIR_K) - q, 150.0, 900.0)
        for q in flux
    ]
    np.testing.assert_allclose(np.array(state.surface_k), expected, rtol=0.0, atol=1e-3)


@pytest.mark.slow
def test_disc_gives_its_inner_heat_to_sky_and_air(tmp_path):
    """The power of a disc over its area leaves it to the sky, the air and the air behind."""
    side, power = 2.0, 1500.0
    warm = scene_object("warm", [side, side, 1], temperature="balance", shape="disc", inner_heat_w=power)
    scene = at_night(tr.load_scene(write_balance(tmp_path / "s", WEATHER + warm)))
    found = solved_at(scene, [scene.time])[0].surfaces[1].temperature.ravel()[0]
    air = scene.weather.at(scene.time)
    material = next(each for each in scene.materials if each.name == "paint_black")
    column = open_ground.columns([material], scene.weather, 0.0, open_ground.STATION_ROUGHNESS_M)
    # A disc of 64 corners.
    flux = power / (32.0 * np.sin(2.0 * np.pi / 64.0) * (side / 2.0) ** 2)
    exchange, _ = turbulence.convection(
        np, found, air.air_k, air.wind_m_s * column.wind_factor, turbulence.air_density(air.pressure_pa, air.air_k),
        column.ground.log_wind, column.ground.log_heat, column.ground.height_m,
    )  # fmt: skip
    emitted = open_ground.broadband(material) * (SIGMA * found**4 - air.longwave_w_m2)
    left = float((emitted + (exchange + BEHIND) * (found - air.air_k))[0])
    assert found > air.air_k + 5.0
    # A kelvin is worth about 45 W m⁻².
    assert left == pytest.approx(flux, abs=5.0)


PLATE = "v -2 -2 2\nv 2 -2 2\nv 2 2 2\nv -2 2 2\n"
MESH = f"""[terrain]
mesh = "ground.obj"
[temperature]
source = "balance"
[emissivity]
source = "material"
material = "soil_loam"
[sky]
temperature = 260.0
[frame]
latitude_deg = 52.0
longitude_deg = 21.0
height_m = 100.0
{WEATHER}"""


@pytest.mark.slow
@pytest.mark.parametrize("hour", ["02:00", "12:00"])
def test_plate_has_the_temperature_of_the_same_plate_as_a_part_of_the_terrain(tmp_path, hour):
    ground = "v -20 -20 0\nv 20 -20 0\nv 20 20 0\nv -20 20 0\nusemtl soil\nf 1 2 3\nf 1 3 4\n"
    library = "newmtl soil\nKd 0.4 0.3 0.2\nnewmtl plate\nKd 0.1 0.1 0.1\n"
    part = '[[surface]]\nname = "plate"\nmaterial = "paint_black"\n'
    alone = scene_object("plate", position=[0, 0, 2], temperature="balance", file="plate.obj")
    kelvin = []
    for name, more, extra in (("part", f"{PLATE}usemtl plate\nf 5 6 7\nf 5 7 8\n", part), ("object", "", alone)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "m.mtl").write_text(library, encoding="utf-8")
        (folder / "ground.obj").write_text(f"mtllib m.mtl\n{ground}{more}", encoding="utf-8")
        # Its base is the plate itself.
        (folder / "plate.obj").write_text(PLATE.replace(" 2\n", " 0\n") + "f 1 2 3\nf 1 3 4\n", encoding="utf-8")
        (folder / "scene.toml").write_text(MESH + extra, encoding="utf-8")
        scene = tr.load_scene(folder).at(f"2018-07-28T{hour}Z")
        kelvin.append(float(solved_at(scene, [scene.time])[0].surfaces[1].temperature.mean()))
    assert kelvin[0] == pytest.approx(kelvin[1], abs=0.02)


@pytest.mark.slow
def test_car_follows_the_weather_of_a_day(tmp_path):
    """Colder than the air at dawn, a hot roof at noon, and a warmer bonnet where the engine runs."""
    folder = tmp_path / "s"
    folder.mkdir()
    write_car(folder / "car.obj")
    keys = {"temperature": "balance", "file": "car.obj"}
    parked = scene_object("parked", position=[4, 0, 0], **keys)
    running = scene_object("running", position=[-4, 0, 0], inner_heat_w=3000.0, **keys)
    running += "inner_heat_share = {bonnet = 0.8, cabin = 0.2}\n"
    scene = tr.load_scene(write_balance(folder, WEATHER + parked + running, height=np.zeros((24, 24))))
    times = [np.datetime64(f"2018-07-28T{hour}:00") for hour in ("03", "12")]
    dawn, noon = solved_at(scene, times)
    air = scene.weather.at(np.array(times)).air_k
    names = [surface.name for surface in scene.surfaces]
    assert names[1:] == ["parked:car:mesh", *(f"running:car:mesh{part}" for part in ("", ":bonnet", ":cabin"))]
    mean = lambda found: np.average(found[0], weights=found[1])  # noqa: E731
    roofs = [mean(upper(each.surfaces[1], 1.45)) for each in (dawn, noon)]
    assert air[0] - 4.0 < roofs[0] < air[0]
    assert air[1] + 8.0 < roofs[1] < air[1] + 40.0
    # The north side is in shade at noon.
    shaded = noon.surfaces[1].temperature.min()
    assert shaded < air[1] + 1.0
    # Where the cabin covers faces in part, their open part is in the sun.
    assert upper(noon.surfaces[1], 0.85, south_of=-1.66)[0].min() > roofs[1] - 6.0
    for each, roof in zip((dawn, noon), roofs, strict=True):
        # 2400 W on 7.15 m²: some 336 W m⁻² at about 40 W m⁻² K⁻¹.
        assert roof + 3.0 < mean(upper(each.surfaces[3], 0.85)) < roof + 12.0
    area = 2.0 * (1.8 * 1.3 + 1.8 * 0.55 + 1.3 * 0.55)
    assert scene.surfaces[3].inner_w_m2 == pytest.approx(2400.0 / area)
    assert scene.surfaces[2].inner_w_m2 == 0.0
