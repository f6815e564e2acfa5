"""Stability of geometry: faulty meshes, cameras on, under and in the ground, map coordinates, a round Earth, holes.

Pixels with a flag in the truth mask are known to be wrong and count as right; any other wrong pixel counts as wrong.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from tests.robustness.air import refused
from tests.robustness.cases import Found, case
from thermorender.defaults import BAND_UM
from thermorender.formats import write_text
from thermorender.materials.material import grey
from thermorender.physics.geodesy import FLATTENING, SEMI_MAJOR_AXIS_M
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.scene.meshes.mesh import load, primitive
from thermorender.scene.surface import BACKGROUND, BEHIND, FILLED, SURFACE, Surface
from thermorender.schema import toml_text

_GROUND_K, _SKY_K, _BESIDE_K, _HALF = 300.0, 255.0, 280.0, 0.5
# Level ground of 100 m, its two triangles and their corners on the map.
_CORNERS = [[-50.0, 50.0, 0.0], [50.0, 50.0, 0.0], [50.0, -50.0, 0.0], [-50.0, -50.0, 0.0]]
_FACES = [[0, 3, 1], [1, 3, 2]]
_MAP = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
# Radiance is in single precision, an ulp of 6e-8, and L over dL/dT some 70 K.
_ROUNDING_K = 1e-5
# Extra vertices and faces of faulty meshes, none of which hides the ground from above.
_FAULTS = {
    "duplicate triangles": ([], _FACES),
    "triangles without area": ([[0.0, 0.0, 0.0]], [[0, 0, 1], [0, 4, 2], [2, 2, 2]]),
    "three faces at an edge, the camera in their plane": ([[-50.0, -50.0, -9.0], [50.0, 50.0, -9.0]],
                                                          [[3, 1, 4], [3, 1, 5]]),
}  # fmt: skip
_CAMERAS = {
    "on the ground, looking down": ((0.0, 0.0, 0.0), -90.0), "on the ground, level": ((0.0, 0.0, 0.0), 0.0),
    "1 µm above the ground, level": ((0.0, 0.0, 1e-6), 0.0), "under the ground, looking up": ((3.0, 4.0, -20.0), 80.0),
    "under the ground, looking down": ((3.0, 4.0, -20.0), -90.0), "in a box": ((0.5, 0.0, 2.0), -10.0),
    "in a wall's plane": ((0.0, 0.0, 30.0), -60.0),
}  # fmt: skip


def mesh(vertices, faces, uv=None, kelvin=((_GROUND_K,),), name="terrain"):
    """Return a Surface of the first material; `uv` (V, 2) of its vertices, `kelvin` (rows, columns) of its texels."""
    kelvin, faces = np.array(kelvin, np.float32), np.array(faces, np.int32)
    own = np.full((len(faces), 3, 2), 0.5) if uv is None else np.array(uv)[faces]
    return Surface(
        name=name, vertices=np.array(vertices, np.float64), faces=faces, uv=own.astype(np.float32),
        colour=np.full((*kelvin.shape, 3), 128, np.uint8), material=np.zeros(kelvin.shape, np.uint8),
        temperature=kelvin, flags=np.full(kelvin.shape, SURFACE, np.uint8), texel_m=1.0,
    )  # fmt: skip


def shown(surfaces, place, pitch_deg, emissivity=1.0, yaw_deg=0.0):
    """Return (apparent temperature [K], truth mask) of a view, 160 × 128 pixels of 34 × 27°."""
    from validation.made_scenes import in_memory

    scene = in_memory("geometry", surfaces, (grey("ground", emissivity),), sky=_SKY_K, surroundings=_BESIDE_K)
    return _viewed(scene.with_surfaces(terrain_count=1), place, pitch_deg, yaw_deg)


def _viewed(scene, place, pitch_deg, yaw_deg=0.0, finer=1.0):
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose

    camera = replace(scene.camera, width=160, height=128, pixel_pitch_um=68.0 / finer, f_number=5.0)
    frame = Renderer(scene.with_camera(camera), rays=64, device="cpu").frame(
        pose(*place, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    )
    assert np.isfinite(list(frame.budget_mk.values())).all()
    return brightness_temperature(frame.radiance, *BAND_UM), frame.truth["mask"]


def _worst(kelvin, expected):
    """The value farthest from the expected one; NaN if there is none, or one is not finite."""
    return float(kelvin.flat[np.argmax(np.abs(kelvin - expected))]) if kelvin.size else np.nan


def _even(mask):
    """Where all eight neighbours have the same value, (H, W) bool."""
    return maximum_filter(mask, 3) == minimum_filter(mask, 3)


def _reflecting(below):
    """Apparent temperature of level ground under a sky, or above a ground, of this temperature [K]."""
    both = band_radiance(np.array([_GROUND_K, below]), *BAND_UM)
    return float(brightness_temperature(_HALF * both[0] + (1.0 - _HALF) * both[1], *BAND_UM))


@case("geometry", "{}, of emissivity 0.5", _FAULTS)
def faults(which):
    """ε B(T) + (1 − ε) L_sky, as without the fault; faces that would hide the ground are below it."""
    more, faces = _FAULTS[which]
    kelvin, _ = shown((mesh(_CORNERS + more, _FACES + faces),), (0.0, 0.0, 30.0), -90.0, _HALF)
    return Found(_worst(kelvin, _reflecting(_SKY_K)), _reflecting(_SKY_K), _ROUNDING_K)


@case("geometry", "normals that look down, of emissivity 0.5: pixels without a flag")
def flipped():
    """They show light from below, and each pixel is flagged as a back face."""
    kelvin, mask = shown((mesh(_CORNERS, np.array(_FACES)[:, ::-1]),), (0.0, 0.0, 30.0), -90.0, _HALF)
    wrong = np.where(mask & BEHIND, _reflecting(_SKY_K), kelvin)
    return Found(_worst(wrong, _reflecting(_SKY_K)), _reflecting(_SKY_K), _ROUNDING_K)


@case("geometry", "one triangle and its background")
def triangle():
    """Each of the two at its own temperature, except where they meet."""
    kelvin, mask = shown((mesh(_CORNERS[:3], [[0, 2, 1]]),), (0.0, 0.0, 30.0), -90.0)
    off = np.abs(kelvin - np.where(mask & BACKGROUND, _BESIDE_K, _GROUND_K))
    return Found(float(off[_even(mask)].max()), 0.0, _ROUNDING_K if np.ptp(mask) else np.nan)


@case("geometry", "camera {}: pixels without a flag", _CAMERAS)
def cameras(which):
    """Ground, sky or background, by the mask, except where they meet; from below and within all faces are backs."""
    place, pitch = _CAMERAS[which]
    surfaces = [mesh(_CORNERS, _FACES)]
    if "box" in which:
        surfaces.append(mesh(*primitive("box", (4.0, 4.0, 4.0)), kelvin=((320.0,),), name="box"))
    if "wall" in which:
        surfaces.append(mesh([[0.0, -50.0, 0.0], [0.0, 50.0, 0.0], [0.0, 0.0, 20.0]], [[0, 1, 2]], name="wall"))
    kelvin, mask = shown(tuple(surfaces), place, pitch)
    front = 0.0 if "under" in which or "box" in which else _GROUND_K
    known = np.where(mask & BACKGROUND, _BESIDE_K, np.where(mask & SURFACE, front, _SKY_K))
    off = np.where((mask & BEHIND) | ~_even(mask), 0.0, np.abs(kelvin - known))
    return Found(float(off.max()), 0.0, _ROUNDING_K)


@case("geometry", "a cliff of 40 m seen {}", ("from above", "from its foot"))
def cliff(where):
    """From straight above, its face of 320 K, at the image's middle, has no area; from below it fills the view."""
    corners = [[-50, 50, 0], [0, 50, 0], [0, -50, 0], [-50, -50, 0], [0, 50, -40], [0, -50, -40], [50, 50, -40],
               [50, -50, -40]]  # fmt: skip
    faces = [[0, 3, 1], [1, 3, 2], [1, 2, 4], [4, 2, 5], [4, 5, 6], [6, 5, 7]]
    ground = mesh(corners, faces[:2] + faces[4:])
    wall = mesh(corners, faces[2:4], kelvin=((320.0,),), name="wall")
    above = where == "from above"
    kelvin, mask = shown((ground, wall), (0.0, 0.0, 30.0) if above else (30.0, 0.0, -20.0), -90.0 if above else 0.0,
                         yaw_deg=-90.0)  # fmt: skip
    expected = _GROUND_K if above else 320.0
    return Found(_worst(kelvin, expected) if (mask == SURFACE).all() else np.nan, expected, _ROUNDING_K)


@case("geometry", "a hole of a quarter of the ground")
def hole():
    """A quarter of the pixels show the background, flagged; the others show the ground."""
    corners = [[x, y, 0.0] for y in (50.0, 0.0, -50.0) for x in (-50.0, 0.0, 50.0)]
    cells = [(0, 1, 3, 4), (3, 4, 6, 7), (4, 5, 7, 8)]
    faces = [face for a, b, c, d in cells for face in ([a, c, d], [a, d, b])]
    kelvin, mask = shown((mesh(corners, faces),), (0.0, 0.0, 30.0), -90.0)
    off = np.abs(kelvin - np.where(mask & BACKGROUND, _BESIDE_K, _GROUND_K))[_even(mask)]
    quarter = abs(float((mask == BACKGROUND).mean()) - 0.25) < 0.02
    return Found(float(off.max()), 0.0, _ROUNDING_K if quarter else np.nan)


@case("geometry", "a million triangles: a slope of 45° that warms evenly")
def million():
    """Its temperature at the image's middle: four pixels show 0.2 m, with a hundredth of a kelvin per metre."""
    side = np.linspace(-200.0, 200.0, 708)
    east, north = np.meshgrid(side, -side)
    index = np.arange(east.size).reshape(east.shape)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)])
    uv = np.stack([east, -north], axis=-1).reshape(-1, 2) / 400.0 + 0.5
    warm = _GROUND_K + 0.01 * (np.arange(400) - 199.5)[None, :] * np.ones((2, 1))
    kelvin, _ = shown((mesh(np.stack([east, north, east], axis=-1).reshape(-1, 3), faces, uv, warm),),
                      (10.0, 0.0, 60.0), -90.0)  # fmt: skip
    return Found(float(kelvin[63:65, 79:81].mean()), _GROUND_K + 0.1, 0.01 * 0.2)


@case("geometry", "map coordinates from {0[0]:g} to {0[1]:g}", ((0.0, 3.0), (-7.0, -4.0), (5.5, 8.5)))
def repeated(span):
    """A texture of two halves, 280 and 320 K, is seen three times: the worst of the middles of six stripes."""
    low, high = span
    image = np.zeros((16, 64, 3), np.uint8)
    image[:, 32:] = 255
    uv = [[low, 1.0], [high, 1.0], [high, 0.0], [low, 0.0]]
    with tempfile.TemporaryDirectory() as folder:
        part = _by_file(Path(folder), uv, image)
    warm = np.where(part.colour[..., 0] > 127, 320.0, 280.0)
    kelvin, _ = shown((replace(mesh(part.vertices, part.faces, kelvin=warm), uv=part.uv),), (0.0, 0.0, 150.0), -90.0)
    # Stripes of a sixth of 100 m, with pixels of 0.785 m.
    column = 80.0 + (np.arange(6) - 2.5) * 100.0 / 6.0 * 191.2 / 150.0
    expected = np.where((2.0 * low + np.arange(6)) % 2.0, 320.0, 280.0)
    off = kelvin[64, column.astype(int)] - expected
    return Found(float(np.abs(off).max()), 0.0, _ROUNDING_K)


def _by_file(folder, uv, image):
    """The Part of level ground with a texture, read from an OBJ."""
    from PIL import Image

    Image.fromarray(image).save(folder / "texture.png")
    write_text(folder / "ground.mtl", "newmtl ground\nmap_Kd texture.png\n")
    lines = ["mtllib ground.mtl", "usemtl ground"]
    lines += ["v " + " ".join(map(str, corner)) for corner in _CORNERS] + [f"vt {u} {v}" for u, v in uv]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in _FACES]
    write_text(folder / "ground.obj", "\n".join(lines) + "\n")
    return load(folder / "ground.obj")[0]


# --- maps ---------------------------------------------------------------------------------------------------------


def land(height, warm, post_m, corner, crs="EPSG:32633", **terrain):
    """Return the Scene of black ground of heights (h, w) [m] and texels (n, m) [K] over the same area, read from files.

    `corner` is the map's upper left corner, (easting, northing) [m]; `terrain` goes into the scene file.
    """
    import rasterio

    from thermorender.scene.load import load_scene

    shares = {"elevation": height, "temperature": warm}
    with tempfile.TemporaryDirectory() as folder:
        for name, values in shares.items():
            step = [post_m * height.shape[axis] / values.shape[axis] for axis in (1, 0)]
            transform = rasterio.Affine(step[0], 0.0, corner[0], 0.0, -step[1], corner[1])
            with rasterio.open(
                Path(folder) / f"{name}.tif", "w", driver="GTiff", height=values.shape[0], width=values.shape[1],
                count=1, dtype="float32", crs=crs, transform=transform, nodata=-9999.0,
            ) as file:  # fmt: skip
                file.write(values.astype(np.float32), 1)
        text = {
            "title": "land", "terrain": {"elevation": "elevation.tif", **terrain},
            "temperature": {"source": "raster", "raster": "temperature.tif"},
            "emissivity": {"source": "constant", "value": 1.0}, "sky": {"temperature": _SKY_K},
            "surroundings": {"temperature": _BESIDE_K},
        }  # fmt: skip
        write_text(Path(folder) / "scene.toml", toml_text(text))
        return load_scene(folder)


def _middle(kelvin):
    """Mean of the four pixels in the middle."""
    return float(kelvin[63:65, 79:81].mean())


@case("geometry", "ground at easting 5e5 m, northing 5e6 m, half a kelvin per metre: at a given place of the map")
def utm():
    """Camera 30 m above it. On the zone's central meridian a metre is 0.9996 of the map's; a pixel shows 16 cm."""
    warm = 280.0 + 0.5 * (np.arange(128) + 0.5) * np.ones((128, 1))
    scene = land(np.full((128, 128), 100.0), warm, 1.0, (5e5 - 64.0, 5e6 + 64.0))
    kelvin, _ = _viewed(scene, (10.25 / 0.9996, -7.0 / 0.9996, 30.0), -90.0)
    return Found(_middle(kelvin), 280.0 + 0.5 * (64.0 + 10.25), 0.5 * 30.0 / 191.2 / 10.0)


@case("geometry", "a mesh at easting 5e5 m, northing 5e6 m is refused")
def mesh_on_a_map():
    """Single precision has a resolution of half a metre there."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ground.obj"
        lines = [f"v {x + 5e5} {y + 5e6} {z}" for x, y, z in _CORNERS] + ["f 1 4 2", "f 2 4 3"]
        write_text(path, "\n".join(lines) + "\n")
        return refused(lambda: load(path), "shifted to an origin near it")


@case("geometry", "land of 100 km, posts of 50 m, a kelvin per km: {:g}° below level, from 1 km", (1.5, 2.0))
def round_earth(below_deg):
    """Where the ray meets a circle with the local east-west curvature; on a flat Earth it is several kelvin colder.

    The tolerance is the extent of four pixels along the ground, in kelvin.
    """
    latitude = np.radians(45.0)
    radius = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - FLATTENING * (2.0 - FLATTENING) * np.sin(latitude) ** 2)
    scene = land(np.zeros((11, 2000)), 250.0 + 0.05 * np.arange(2000) * np.ones((11, 1)), 50.0, (45e4, 4983_253.0))
    kelvin, _ = _viewed(scene, (0.0, 0.0, 1000.0), -below_deg, yaw_deg=90.0, finer=100.0)
    slope = np.radians(below_deg)
    # |(s cos a, R + h − s sin a)| = R, the nearer of the two.
    half, apart = (radius + 1e3) * np.sin(slope), 1e3 * (2.0 * radius + 1e3)
    slant = half - np.sqrt(half**2 - apart)
    arc = radius * np.arctan2(slant * np.cos(slope), radius + 1e3 - slant * np.sin(slope))
    seen = slant / 191.2e2 / np.sin(slope - arc / radius)
    return Found(_middle(kelvin), 250.0 - 0.025 + 0.05 * (1000.0 + 0.9996 * arc / 50.0), 2.0 * 1e-3 * seen)


def _slope(**terrain):
    """(temperature, mask) of a slope of 1 : 5 with an island of 12 × 12 missing posts, seen at 45°."""
    east = np.arange(64) - 31.5
    height = 0.2 * east * np.ones((64, 1))
    height[26:38, 26:38] = -9999.0
    scene = land(height, 300.0 + east * np.ones((64, 1)), 1.0, (5e5 - 32.0, 5e6 + 32.0), **terrain)
    return _viewed(scene, (-20.0, 0.0, 20.0), -45.0, yaw_deg=90.0)


@case("geometry", "an island of no data on a slope: pixels of it without a flag")
def island():
    """Cells of 13 m across are missing and flagged: the background of 280 K is seen."""
    kelvin, mask = _slope()
    middle = (slice(54, 74), slice(70, 90))
    flagged = (mask[middle] == BACKGROUND).all()
    return Found(_worst(kelvin[middle], _BESIDE_K), _BESIDE_K, _ROUNDING_K if flagged else np.nan)


@case("geometry", "an island of no data on a slope, filled: where the ray meets the slope, a kelvin per metre")
def filled():
    """From 20 m west and 20 m up at 45° the ray is at −x, the slope at x/5 [m]: they meet at 0. A pixel has 0.2 m."""
    kelvin, mask = _slope(fill=True)
    flagged = (mask[54:74, 70:90] == (SURFACE | FILLED)).all() and not (mask[:, :4] & FILLED).any()
    return Found(_middle(kelvin), 300.0, 0.02 if flagged else np.nan)
