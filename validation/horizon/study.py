"""Error of frames toward the horizon, by distance: without far ground, and with far ground of coarser posts.

The truth is the same scene amid posts 100 m apart. Heights are those of a real range, Jacksboro in Tennessee (80 m
posts, a sample of matplotlib), repeated in mirrors; classes follow from the heights and from noise. Temperatures are
those of the heat balance in each scene.
"""

import tempfile
from pathlib import Path

import numpy as np

from thermorender import formats
from thermorender.apps.compare import machine
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.versions import versions

# Side of the square scene, of its posts and texels; of the world, and of the posts and classes of the true one [m].
_NEAR_M, _POST_M, _TEXEL_M = 400.0, 5.0, 1.0
_TRUE_POST_M, _CLASS_M = 100.0, 100.0
POSTS_M, WORLD_M = (200.0, 400.0), 60_000.0
HEIGHTS_M, PITCHES_DEG = (300.0, 3000.0), (-2.0, -5.0, -10.0)
# Ends of the distances that are told apart [m].
RANGES_M = (0.0, 2e3, 5e3, 10e3, 20e3, np.inf)
HEADER = ("far ground", "height [m]", "pitch [°]", *(f"{1e-3 * a:g}–{1e-3 * b:g} km [K]"
          for a, b in zip(RANGES_M[:-1], RANGES_M[1:], strict=True)), "beyond the ground [K]")  # fmt: skip
CLASSES = {1: "grass_green", 2: "grass_dry", 3: "soil_loam", 4: "broadleaf", 5: "conifer", 6: "water"}
_MIDDLE = (500_000.0, 4_050_000.0)
_SCENE = """title = "{name}"
[terrain]
elevation = "near.tif"
{far}
[temperature]
source = "balance"
[weather]
time = 2018-07-28T19:00:00Z
air_low_c = 17.0
air_high_c = 29.0
humidity = 0.8
wind_m_s = 3.0
cloud = 0.0
[emissivity]
source = "classes"
raster = "near_classes.tif"
[emissivity.classes]
{classes}
"""


def run(
    folder, posts_m=POSTS_M, heights_m=HEIGHTS_M, pitches_deg=PITCHES_DEG, world_m=WORLD_M, progress=None, device="auto"
):  # fmt: skip
    """Measure each far ground and view, write `horizon.json`, and return the cases, a list of dicts.

    Parameters
    ----------
    folder : path
        It exists.
    posts_m : sequence of float
        Distances of the posts of far ground [m].
    heights_m, pitches_deg : sequences of float
        Of the cameras above the middle of the scene.
    world_m : float
        Side of the world [m].
    progress : callable, optional
        Called with (step, share done).
    device : {"auto", "cpu", "cuda"}
    """
    cases = []
    with tempfile.TemporaryDirectory() as made:
        write_world(Path(made), posts_m, world_m)
        names = ["true", "none", *(f"{post:g}" for post in posts_m)]
        views, poses = {}, {}
        for number, name in enumerate(names):
            if progress:
                progress(f"far ground: {name}", number / len(names))
            renderer = Renderer(load_scene(Path(made) / name), device=device)
            for height in heights_m:
                for pitch in pitches_deg:
                    scene = renderer.scene
                    pose = scene.pose(0.0, 0.0, height + float(scene.ground(0.0, 0.0)), pitch_deg=pitch)
                    frame = renderer.frame(poses.setdefault((height, pitch), pose))
                    depth = frame.truth["depth"]
                    kelvin = frame.apparent_temperature, np.where(np.isfinite(depth), depth, np.inf)
                    if name == "true":
                        views[height, pitch] = kelvin
                        continue
                    cases.append({
                        "far": name, "height_m": height, "pitch_deg": pitch, "triangles": sum(
                            len(each.faces) for each in scene.surfaces), **_by_range(kelvin[0], *views[height, pitch]),
                    })  # fmt: skip
    record = {"machine": machine.machine(), "versions": versions(), "world_m": world_m, "cases": cases}
    formats.write_json(Path(folder) / "horizon.json", record)
    return cases


def _by_range(found_k, true_k, depth_m):
    """{rms_k: [K] at each of RANGES_M, None where no pixel is; beyond_k: [K] where the true world ends; pixels}."""
    off = np.square(found_k.astype(np.float64) - true_k)
    ground = np.isfinite(depth_m)
    parts = [ground & (depth_m >= a) & (depth_m < b) for a, b in zip(RANGES_M[:-1], RANGES_M[1:], strict=True)]
    rms = [float(np.sqrt(off[part].mean())) if part.any() else None for part in parts]
    return {
        "rms_k": rms, "pixels": [int(part.sum()) for part in parts],
        "beyond_k": float(np.sqrt(off[~ground].mean())) if not ground.all() else None,
    }  # fmt: skip


def rows(cases):
    """Return the cases as table rows of text under HEADER."""
    shown = lambda kelvin: "" if kelvin is None else f"{kelvin:.2f}"  # noqa: E731
    return [
        (case["far"], f"{case['height_m']:g}", f"{case['pitch_deg']:g}", *map(shown, case["rms_k"]),
         shown(case["beyond_k"]))
        for case in cases
    ]  # fmt: skip


def write_world(folder, posts_m, world_m):
    """Write the scenes of one world: "true", "none" without far ground, and one for each distance of posts [m]."""
    classes = "\n".join(f'{number} = "{name}"' for number, name in CLASSES.items())
    for name, post in (("true", _TRUE_POST_M), ("none", None), *((f"{post:g}", post) for post in posts_m)):
        own = folder / name
        own.mkdir()
        _write(own / "near.tif", _heights(*_grid(_NEAR_M, _POST_M)), _POST_M, nodata=np.nan)
        _write(own / "near_classes.tif", _classes(*_grid(_NEAR_M, _TEXEL_M)), _TEXEL_M)
        far = ""
        if post is not None:
            far = 'far = { elevation = "far.tif", classes = "far_classes.tif" }'
            _write(own / "far.tif", _heights(*_grid(world_m, post), side=post), post, nodata=np.nan)
            _write(own / "far_classes.tif", _classes(*_grid(world_m, _CLASS_M)), _CLASS_M)
        (own / "scene.toml").write_text(_SCENE.format(name=name, far=far, classes=classes), "utf-8")


def _grid(side, step):
    """(East, north) (n, n) [m] of the middles of a square's cells, row 0 in the north."""
    middle = (np.arange(round(side / step)) + 0.5) * step - 0.5 * side
    return np.meshgrid(middle, -middle)


def _heights(east, north, side=0.0):
    """Heights at places [m], float32, averaged over squares of a side."""
    import cv2
    from matplotlib.cbook import get_sample_data

    step = 80.0
    source = np.asarray(get_sample_data("jacksboro_fault_dem.npz")["elevation"], np.float32)
    if side > step:
        source = cv2.blur(source, (round(side / step),) * 2, borderType=cv2.BORDER_REFLECT_101)
    column, row = 200.0 + east / step, 170.0 - north / step
    return cv2.remap(source, column.astype(np.float32), row.astype(np.float32), cv2.INTER_CUBIC,
                     borderMode=cv2.BORDER_REFLECT_101)  # fmt: skip


def _classes(east, north):
    """Class numbers at places, uint8: woods on the hills, fields and water in the valleys."""
    height = _heights(east, north, 400.0)
    patch = sum(np.sin(east / a + 1.7 * np.sin(north / b)) * np.cos(north / a - 1.3 * np.sin(east / b))
                for a, b in ((430.0, 610.0), (170.0, 260.0), (1900.0, 1400.0)))  # fmt: skip
    field = np.digitize(patch, (-0.7, 0.0, 0.6)) + 1
    found = np.where(height + 90.0 * patch > 480.0, np.where(patch > 0.3, 5, 4), np.minimum(field, 3))
    return np.where(height < 262.0, 6, found).astype(np.uint8)


def _write(path, values, step, **options):
    import rasterio

    corner = _MIDDLE[0] - 0.5 * step * values.shape[1], _MIDDLE[1] + 0.5 * step * values.shape[0]
    with rasterio.open(
        path, "w", driver="GTiff", count=1, dtype=values.dtype, height=values.shape[0], width=values.shape[1],
        crs="EPSG:32616", transform=rasterio.Affine(step, 0.0, corner[0], 0.0, -step, corner[1]), compress="deflate",
        **options,
    ) as file:  # fmt: skip
        file.write(values[None])
