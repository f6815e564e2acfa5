"""Temperatures of walls and other parts of a mesh: faces without a map, and walls against a closed form."""

import numpy as np
import pytest
import trimesh
from PIL import Image

import thermorender as tr
from scenes import WEATHER
from thermorender.render.heat import simulation as heat

AT = np.datetime64("2018-07-28T12:00:00")
FRAME = "[frame]\nlatitude_deg = 52.0\nlongitude_deg = 0.0\nheight_m = 0.0\n"


def mesh_scene(folder, mesh, material, weather=WEATHER):
    folder.mkdir(parents=True, exist_ok=True)
    mesh.export(folder / "m.ply")
    (folder / "scene.toml").write_text(
        f'[terrain]\nmesh = "m.ply"\n[temperature]\nsource = "balance"\n[emissivity]\nsource = "material"\n'
        f'material = "{material}"\n[sky]\ntemperature = 255.0\n{FRAME}{weather}'
    )
    return tr.load_scene(folder)


def faces_of(surface):
    """(corners (F, 3, 3), normals (F, 3), temperatures (F,)) of faces that show one texel each."""
    corner = surface.vertices[surface.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rows, columns = surface.material.shape
    at = (surface.uv[:, 0] * (columns, rows)).astype(int)
    return corner, normal, surface.temperature[at[:, 1], at[:, 0]]


def test_every_face_with_a_colour_of_its_own_has_its_own_sun(tmp_path):
    """Faces that show one texel each: those of a box differ by orientation; each had the sun of the last face."""
    box = trimesh.creation.box((4.0, 4.0, 4.0))
    box.apply_translation((0.0, 0.0, 2.0))
    box.visual.face_colors = np.arange(12)[:, None] * np.array([10, 5, 3, 0]) + np.array([60, 60, 60, 255])
    scene = mesh_scene(tmp_path / "box", box, "roof_rubber")
    solved = heat.solved(scene, [AT])[0]
    _, normal, kelvin = faces_of(solved.surfaces[0])
    south, north, up = (kelvin[normal @ axis > 0.9].mean() for axis in ([0, -1, 0], [0, 1, 0], [0, 0, 1]))
    # The sun is 57° high in the south: 0.54 of the beam on the south wall, 0.84 on the roof, none on the north wall.
    assert up > south + 3.0 and south > north + 5.0


def test_textures_with_margins_have_temperatures(tmp_path):
    """Two textures of which faces show a part only: the heat balance ended in a traceback."""
    for name, colour in (("a", (120, 60, 40)), ("b", (60, 110, 40))):
        Image.fromarray(np.full((8, 8, 3), colour, np.uint8)).save(tmp_path / f"{name}.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd b.png\n")
    plan = "v 0 0 {z}\nv 9 0 {z}\nv 9 9 {z}\nv 0 9 {z}\n"
    (tmp_path / "m.obj").write_text(
        "mtllib m.mtl\n" + plan.format(z=0) + plan.format(z=5) + "vt 0.2 0.2\nvt 0.8 0.2\nvt 0.8 0.8\nvt 0.2 0.8\n"
        "usemtl a\nf 1/1 2/2 3/3 4/4\nusemtl b\nf 5/1 6/2 7/3 8/4\n"
    )
    (tmp_path / "scene.toml").write_text(
        '[terrain]\nmesh = "m.obj"\n[temperature]\nsource = "balance"\n[emissivity]\nsource = "material"\n'
        f'material = "asphalt"\n[sky]\ntemperature = 255.0\n{FRAME}{WEATHER}'
    )
    below, above = (each.temperature for each in heat.solved(tr.load_scene(tmp_path), [AT])[0].surfaces)
    # The upper square shades the lower one.
    assert np.isfinite(below).all() and np.isfinite(above).all() and above.mean() > below.min() + 10.0


# A wall of little mass on a room, so that it is always near its steady state; and its spectrum, of emissivity 0.9.
WALL = {
    "cover": ("bare", ""), "conductivity_w_m_k": (0.2, 0), "density_kg_m3": (300, 0), "specific_heat_j_kg_k": (800, 0),
    "thickness_m": (0.02, 0), "beneath": ("inside", ""), "roughness_m": (0.005, 0), "heat_roughness_ratio": (3.9, 0),
    "wetness": (0, 0), "water_share": (0, 0),
}  # fmt: skip
GREY = (
    "name,title,colour_r,colour_g,colour_b,solar_absorptance,directional,temperature_k,samples,source,citation,licence,"
    "note,rms_slope,solar_absorptance_std\nthin,Thin wall,120,120,120,0.7,lambertian,300,1,chosen,none,CC0,,,0.05\n"
)
AIR_C, INSIDE_C, WIND, DIRECT, DIFFUSE, LONGWAVE = 15.0, 24.0, 25.0, 600.0, 120.0, 330.0
HOURS = (8, 12, 16)
SIDES = {"north": 0.0, "east": 90.0, "south": 180.0, "west": 270.0}


@pytest.fixture(scope="module")
def yard(tmp_path_factory):
    """{hour: (temperatures of a cube's walls by side, of the plain around it) [K]} under a steady wind and sun."""
    folder = tmp_path_factory.mktemp("yard")
    own = folder / "materials"
    (own / "spectra").mkdir(parents=True)
    (own / "thermal").mkdir()
    (own / "index.csv").write_text(GREY)
    (own / "spectra" / "thin.csv").write_text("wavelength_um,emissivity,emissivity_std\n2,0.9,0\n20,0.9,0\n")
    rows = "".join(f'{key},{value},{spread},"chosen: for a test"\n' for key, (value, spread) in WALL.items())
    (own / "thermal" / "thin.csv").write_text("property,value,uncertainty,source\n" + rows)
    times = np.datetime64("2018-07-25T00:30") + np.arange(5 * 24) * np.timedelta64(1, "h")
    day = [5.0 <= (t - t.astype("M8[D]")) / np.timedelta64(1, "h") <= 19.0 for t in times]
    table = [
        f"{t}:00Z,{AIR_C},20,{WIND},{DIRECT * d},{DIFFUSE * d},{LONGWAVE}" for t, d in zip(times, day, strict=True)
    ]
    head = "time_utc,air_c,rh_percent,wind_m_s,sw_direct_normal_w_m2,sw_diffuse_w_m2,lw_down_w_m2"
    (folder / "w.csv").write_text("\n".join([head, *table]) + "\n")
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    box.apply_translation((0.0, 0.0, 1.0))
    plain = trimesh.Trimesh([[-300, -300, 0], [300, -300, 0], [300, 300, 0], [-300, 300, 0]], [[0, 1, 2], [0, 2, 3]])
    for _ in range(4):
        plain = plain.subdivide()
    whole = trimesh.util.concatenate([box, plain])
    tint = np.arange(len(whole.faces)) % 50
    whole.visual.face_colors = np.column_stack([60 + tint, 90 - tint, 0 * tint + 80, 0 * tint + 255])
    weather = f'[weather]\nfile = "w.csv"\ntime = 2018-07-28T12:00:00Z\nsnow_depth_m = 0.0\ninside_c = {INSIDE_C}\n'
    scene = mesh_scene(folder, whole, "thin", weather)
    times = [np.datetime64(f"2018-07-28T{hour:02}:00:00") for hour in HOURS]
    found = {}
    for hour, each in zip(HOURS, heat.solved(scene, times), strict=True):
        corner, normal, kelvin = faces_of(each.surfaces[0])
        towards = {side: [np.sin(np.radians(a)), np.cos(np.radians(a)), 0.0] for side, a in SIDES.items()}
        walls = {side: float(kelvin[normal @ axis > 0.9].mean()) for side, axis in towards.items()}
        middle = corner.mean(axis=1)
        plain_k = float(kelvin[(normal[:, 2] > 0.9) & (middle[:, 2] < 0.01)].mean())
        found[hour] = walls, plain_k
    return found


def sun_of(hour):
    """(azimuth, elevation) [rad] at 52° N, 0° E on 28 July: declination of Cooper (1969), equation of time of Spencer
    (1971), both in Duffie & Beckman, Solar Engineering of Thermal Processes, 1.5.3 and 1.6.1.
    """
    day = 209
    declination = np.radians(23.45) * np.sin(2 * np.pi * (284 + day) / 365)
    b = 2 * np.pi * (day - 1) / 365
    minutes = 229.2 * (0.000075 + 0.001868 * np.cos(b) - 0.032077 * np.sin(b)
                       - 0.014615 * np.cos(2 * b) - 0.04089 * np.sin(2 * b))  # fmt: skip
    angle, latitude = np.radians(15.0 * (hour + minutes / 60.0 - 12.0)), np.radians(52.0)
    sine = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(angle)
    east = -np.cos(declination) * np.sin(angle)
    north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(angle)
    return np.arctan2(east, north), np.arcsin(sine)


def steady(gained, inside_k, exchange):
    """Temperature [K] at which ε σ T⁴ + h (T − air) + U (T − inside) = gained; film of 0.13 m² K/W: ISO 6946."""
    low, high = 250.0, 400.0
    for _ in range(60):
        t = 0.5 * (low + high)
        lost = 0.9 * 5.670374e-8 * t**4 + exchange * (t - AIR_C - 273.15) + (t - inside_k) / (0.02 / 0.2 + 0.13)
        low, high = (t, high) if lost < gained else (low, t)
    return t


@pytest.mark.parametrize("hour", HOURS)
def test_walls_by_orientation_are_those_of_a_steady_state(yard, hour):
    """Conduction, convection, long-wave, sun and light from the plain: within 0.1 K, by side and hour.

    A wall sees half sky and half plain. The exchange is that of neutral air by the logarithmic law (Garratt 1992,
    eq. 3.52), with the wind at the wall from the station's by Wieringa (1986), and 2 W/m²K of calm air. It is neutral
    within 2 % in a wind of 25 m/s.
    """
    walls, plain_k = yard[hour]
    azimuth, elevation = sun_of(hour)
    rough, height = 0.005, 2.0
    wind_m = 10.0
    up = np.log(60.0 / 0.03) / np.log(wind_m / 0.03)
    wind = WIND * up * np.log(wind_m / rough) / np.log(60.0 / rough)
    density = 101325.0 / (287.05 * (AIR_C + 273.15))
    log_heat = np.log(height / rough) + 3.9
    exchange = density * 1005.0 * 0.4**2 * wind / (np.log(wind_m / rough) * log_heat) + 2.0
    level = DIRECT * np.sin(elevation) + DIFFUSE
    for side, degrees in SIDES.items():
        cosine = max(np.cos(elevation) * np.cos(azimuth - np.radians(degrees)), 0.0)
        sun = 0.7 * (DIRECT * cosine + 0.5 * DIFFUSE + 0.5 * 0.3 * level)
        plain = 0.9 * 5.670374e-8 * plain_k**4 + 0.1 * LONGWAVE
        expected = steady(sun + 0.9 * 0.5 * (LONGWAVE + plain), INSIDE_C + 273.15, exchange)
        print(hour, side, walls[side], expected)
        assert walls[side] == pytest.approx(expected, abs=0.1), side
    assert max(walls.values()) - min(walls.values()) > 2.5
