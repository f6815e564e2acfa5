"""Tiny scenes written to disk for tests."""

import json
from dataclasses import replace

import numpy as np

import thermorender as tr
from thermorender.materials.csv_tables import INDEX_COLUMNS
from thermorender.sensor.camera import load_camera

# A day in July: the weather keys that a heat balance needs.
WEATHER = """[weather]
time = 2018-07-28T12:00:00Z
air_low_c = 12.0
air_high_c = 24.0
humidity = 0.7
wind_m_s = 2.5
cloud = 0.1
"""


def write_raster(path, bands, step=1.0, crs="EPSG:32634", corner=(500000.0, 5780000.0), **options):
    """Write (bands, h, w) as a north-up GeoTIFF with its upper left corner at `corner`."""
    import rasterio

    bands = np.asarray(bands)
    with rasterio.open(
        path, "w", driver="GTiff", count=len(bands), dtype=bands.dtype, height=bands.shape[1], width=bands.shape[2],
        crs=crs, transform=rasterio.Affine(step, 0.0, corner[0], 0.0, -step, corner[1]), **options,
    ) as dataset:  # fmt: skip
        dataset.write(bands)
    return path


def write_terrain(folder, height=None, temperature=None, classes=None, colour=None, texel=0.5, extra="", sky=260.0):
    """Write a terrain scene of 1 m posts and return its folder.

    height (h, w) [m]; temperature and classes (h', w') on the texel grid; colour (h', w', 3).
    """
    folder.mkdir(parents=True, exist_ok=True)
    height = np.zeros((16, 16)) if height is None else np.asarray(height)
    rows, columns = (round(n / texel) for n in height.shape)
    rng = np.random.default_rng(5)
    colour = rng.integers(40, 200, (rows, columns, 3)) if colour is None else colour
    temperature = rng.uniform(285.0, 300.0, (rows, columns)) if temperature is None else temperature
    classes = rng.integers(1, 3, (rows, columns)) if classes is None else classes
    write_raster(folder / "elevation.tif", height[None].astype(np.float32), nodata=np.nan)
    write_raster(folder / "orthophoto.tif", np.moveaxis(np.asarray(colour, np.uint8), -1, 0), texel, photometric="RGB")
    write_raster(folder / "temperature.tif", temperature[None].astype(np.float32), texel, nodata=np.nan)
    write_raster(folder / "classes.tif", classes[None].astype(np.uint8), texel)
    (folder / "scene.toml").write_text(
        f"""title = "tiny"
[terrain]
elevation = "elevation.tif"
orthophoto = "orthophoto.tif"
[temperature]
source = "raster"
raster = "temperature.tif"
[emissivity]
source = "classes"
raster = "classes.tif"
[emissivity.classes]
1 = "grass_green"
2 = "sand_quartz"
[sky]
temperature = {sky}
[truth]
temperature = "temperature.tif"
{extra}
""",
        encoding="utf-8",
    )
    return folder


def scene_object(
    name, size=None, position=(0.0, 0.0, 0.0), temperature=330.0, material="paint_black", shape="box", **more
):
    """Return an object of a scene file, by default a hot black box; `more` holds further keys."""
    keys = {"shape": shape} if "file" not in more else {}
    keys |= {} if size is None else {"size": list(map(float, size))}
    keys |= {"position": list(map(float, position)), "temperature": temperature, "material": material, **more}
    return f'[[object]]\nname = "{name}"\n' + "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())


MARKER = scene_object("marker", [3, 3, 1], [2, 1, 0], material="asphalt")


def write_materials(folder):
    """Write the materials "black" and "sheen", which emits by angle, beside a scene."""
    angles, sheen = (0, 30, 60, 80, 90), (0.9, 0.88, 0.7, 0.3, 0.0)
    spectra = folder / "materials" / "spectra"
    spectra.mkdir(parents=True)
    rows = [",".join(INDEX_COLUMNS)]
    for name, kind in (("black", "lambertian"), ("sheen", "table")):
        cells = dict.fromkeys(INDEX_COLUMNS, "x") | dict.fromkeys([c for c in INDEX_COLUMNS if "colour" in c], "9")
        cells |= {"name": name, "directional": kind, "solar_absorptance": "1", "temperature_k": "300", "samples": "1"}
        rows.append(",".join(cells[column] for column in INDEX_COLUMNS))
    (spectra.parent / "index.csv").write_text("\n".join(rows) + "\n")
    (spectra / "black.csv").write_text("wavelength_um,emissivity,emissivity_std\n7,1,\n14,1,\n")
    lines = [",".join(["wavelength_um", *(f"at_{angle}" for angle in angles)])]
    # Twice as shiny at the band's end as at its start, so that band means would not suffice.
    for wavelength, share in ((7, 0.7), (14, 1.4)):
        shiny = [1.0 - share * (1.0 - value) * (0.7 if value < 0.5 else 1.0) for value in sheen]
        lines.append(",".join([str(wavelength), *(f"{max(value, 0.0):.6f}" for value in shiny)]))
    (spectra / "sheen.csv").write_text("\n".join(lines) + "\n")


def write_balance(folder, extra, source='source = "balance"', **terrain):
    """Write a terrain scene with another temperature source and without truth; `extra` holds its [weather]."""
    path = write_terrain(folder, extra=extra, **terrain) / "scene.toml"
    text = path.read_text(encoding="utf-8").replace('source = "raster"\nraster = "temperature.tif"', source, 1)
    path.write_text(text.replace('[truth]\ntemperature = "temperature.tif"\n', ""), encoding="utf-8")
    return folder


def write_mesh(folder, mesh, temperature=300.0, emissivity=0.9, sky=250.0, extra=""):
    """Write a scene of one grey mesh (a trimesh object) and return its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    mesh.export(folder / "mesh.ply")
    (folder / "scene.toml").write_text(
        f"""[terrain]
mesh = "mesh.ply"
[temperature]
source = "constant"
value = {temperature}
[emissivity]
source = "constant"
value = {emissivity}
[sky]
temperature = {sky}
{extra}
""",
        encoding="utf-8",
    )
    return folder


# 16 × 12 pixels over the field of view of a shipped camera.
CAMERA = replace(load_camera("zenmuse-xt2"), width=16, height=12, pixel_pitch_um=400.0, f_number=12.0)
NARROW = replace(CAMERA, name="narrow", band_um=(8.0, 12.0))


def frame_of(scene, **settings):
    """The radiance of a small frame, looking down."""
    return tr.Renderer(scene, rays=2, samples=1, **settings).frame(tr.pose(0, 0, 12, pitch_deg=-90)).radiance


def flat(east, north):
    """Height of level ground at 0 m."""
    return np.zeros(np.shape(east))


def plane(side, up=0.0):
    """A level square around the origin, as a trimesh object."""
    import trimesh

    h = side / 2
    return trimesh.Trimesh([[-h, -h, up], [h, -h, up], [h, h, up], [-h, h, up]], [[0, 1, 2], [0, 2, 3]])


def coarse(scene, factor=4):
    """Return the scene with a camera of the same field of view and `factor` times fewer pixels a side."""
    return scene.with_camera(scene.camera.coarser(factor))


def narrow(scene, width=160, height=128):
    """Return the scene with its camera cropped to its middle `width` × `height` pixels."""
    camera = scene.camera
    row, column = (camera.height - height) // 2, (camera.width - width) // 2
    return scene.with_camera(camera.part(slice(row, row + height), slice(column, column + width)))


def plane_depth(ground_m=0.0, slope=(0.0, 0.0)):
    """Return a function (pose, Camera) → depth along the axis of the plane height + slope · (east, north) [m]."""

    def depth(pose, camera):
        row, column = np.mgrid[: camera.height, : camera.width] + 0.5
        ray = camera.directions(np.stack([column, row], axis=-1))
        ray = np.concatenate([ray, np.ones((*column.shape, 1))], axis=-1) @ pose[:3, :3].T
        up = np.array([-slope[0], -slope[1], 1.0])
        with np.errstate(divide="ignore"):
            found = (ground_m - up @ pose[:3, 3]) / (ray @ up)
        return np.where(found > 0.0, found, np.inf)

    return depth


# With what an edit of the file by a program may lose: comments, quotes and a number's digits.
HUT = """
# The hut of the owner's brother.
[[object]]
name = "hut"
shape = "box"
size = [3.0, 3.0, 3.0]
position = [0.0, 0.0, 1.5]
temperature = 305.0 # the stove's "on"
material = 'asphalt' # a felt roof's "bitumen"
"""


def write_hut(folder):
    """Write a scene of two classes side by side and a hut; return its folder."""
    columns = np.mgrid[:32, :32][1]
    return write_terrain(folder, classes=np.where(columns < 16, 1, 2), extra=HUT)
