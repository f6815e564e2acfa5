"""Every feature of the renderer against a second opinion: the path tracer of `path_tracer`, in standard errors.

A case is a scene made for one feature, a camera in it and how many paths to take. The renderer's band radiance is
compared in blocks of pixels. Several seeds give each pixel's variance, and the pixels of a block that of their
mean. The largest deviation of all blocks must stay below the quantile that, by Student's distribution, one run in a
thousand exceeds. A deviation is only meaningful if the standard error is small, which is asserted too. Beyond
noise, the renderer may deviate by its stated errors: its spectral nodes and channels, its directional reflectances,
the rays of its bake and its sampling.

`python tests/render/test_second_opinions.py` writes all results to `validation/second_opinions.md`.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import trimesh
from copies_support import leaves, surface_m2
from path_tracer import PathTracer
from scipy.stats import t as student

import thermorender as tr
from scenes import scene_object, write_materials, write_mesh, write_terrain
from thermorender.physics.planck import band_radiance_derivative, brightness_temperature
from thermorender.render import reference
from thermorender.render.pixels.budget import sampling_error

BAND = (7.5, 13.5)
AIR = '[atmosphere]\nstandard = "midlatitude-summer"\naerosol = "rural-23km"\n'
# Share of runs in which correct code may fail; largest standard error of a block for a meaningful comparison [mK].
FALSE_ALARM, LARGEST_MK = 1e-3, 30.0
SEEDS, BLOCK, SIZE = 4, 8, (48, 40)
QUALITY = {"quality": "high", "rays": 2048, "tolerance_mk": 1.0}
# The errors that `render.air` and `atmosphere.rays` state for the sky: its table by zenith angle, and ray steps [mK].
SKY_MK = 5.0 + 4.0


@dataclass(frozen=True)
class Case:
    """A scene made for one feature, and its view.

    Attributes
    ----------
    folder : Path
        Of the scene.
    pose : (4, 4) array
    samples : int
        Paths through each pixel, for each of the seeds.
    view : dict
        `time_s` and `objects` of the renderer's frame.
    camera : dict
        Differences from the ideal camera, apart from its few pixels.
    stock : bool
        Whether the reference engine, stock Mitsuba, supports all of it too.
    less : Path or None
        Folder of a scene whose light is subtracted from both, seed by seed: one cause remains, with little noise.
    share : float
        Stated error relative to the radiance, of the sun in mirrors.
    left_out : str
        Effect that the renderer documents as left out: here it must differ from the path tracer.
    """

    folder: Path
    pose: np.ndarray
    samples: int = 16
    view: dict = field(default_factory=dict)
    camera: dict = field(default_factory=dict)
    stock: bool = False
    less: Path | None = None
    share: float = 0.0
    left_out: str = ""

    def scene(self, plain=False):
        """The Scene, with a camera of a few pixels over the same field of view; plain shapes if it has them."""
        plainer = self.folder / "plain"
        scene = tr.load_scene(plainer if plain and plainer.is_dir() else self.folder)
        wide = scene.camera.pixel_pitch_um * scene.camera.width / SIZE[0]
        camera = replace(scene.camera, width=SIZE[0], height=SIZE[1], pixel_pitch_um=wide, **self.camera)
        return scene.with_camera(camera)


@dataclass(frozen=True)
class Opinion:
    """Result of a comparison, in mK; for blocks of pixels.

    Attributes
    ----------
    deviation_mk, error_mk : float
        Of the block that deviates most: renderer minus path tracer, and its standard error.
    apart, limit : float
        Standard errors between that block and the renderer's stated error, and those allowed for the worst of
        all blocks.
    stated_mk : float
        Largest error that the renderer states for its nodes, channels, tables of mirrors and sky.
    mean_mk, mean_error_mk : float
        For the whole image.
    largest_mk : float
        Largest standard error of a block from the paths alone.
    """

    deviation_mk: float
    error_mk: float
    apart: float
    limit: float
    stated_mk: float
    mean_mk: float
    mean_error_mk: float
    largest_mk: float


def traced(case, seed):
    """Return the band radiance of a Case by the path tracer, (H, W) [W m⁻² sr⁻¹]."""
    # Triangles as described, not as split for the light between surfaces.
    with mock.patch("thermorender.scene.shape.refined", lambda terrain, objects, *_, **__: (terrain, objects)):
        scene = case.scene(plain=True)
    return PathTracer(scene, **case.view).image(case.pose, case.samples, seed)


def stock(case, seed):
    """Return the same by the reference engine."""
    return reference.render(case.scene(), case.pose, 20 * case.samples, depth=16, seed=seed)


def opinion(case, engine=traced):
    """Return the Opinion of an engine on the renderer's radiance."""
    renderer = tr.Renderer(case.scene(), **QUALITY)
    frame = renderer.frame(case.pose, **case.view)
    images = np.stack([engine(case, seed) for seed in range(SEEDS)])
    seen, exact = frame.radiance.astype(float), _blocks(images.mean(axis=0))
    band = renderer.scene.camera.band_um
    per_mk = band_radiance_derivative(brightness_temperature(exact, *band), *band) * 1e-3
    if case.less:
        dark = replace(case, folder=case.less)
        seen -= tr.Renderer(dark.scene(), **QUALITY).radiance(case.pose, **case.view)
        images -= np.stack([engine(dark, seed) for seed in range(SEEDS)])
    # Variance of a block's mean from the paths: each pixel's mean has var / SEEDS, and the block a share of theirs.
    paths = np.sqrt(_blocks(images.var(axis=0, ddof=1)) / SEEDS) / BLOCK / per_mk
    everywhere = sum(frame.budget_mk.get(name, 0.0) for name in ("nodes", "air", "mirrors"))
    everywhere += SKY_MK if renderer.scene.air is not None and not case.less else 0.0
    everywhere += case.share * float((exact / per_mk).max())
    own = sampling_error(renderer.plan, frame._view.tracer(), frame.radiance, frame._sampling)
    sampling = np.sqrt(_blocks(np.square(np.nan_to_num(own), dtype=float))) / BLOCK / per_mk
    # The bake's rays have a common error in a whole face; a pixel's sampling is independent. Mirrors do not show the
    # bake and differences have no such noise. Constant light over faces would not explain a difference, as blocks
    # contain several.
    noise = 0.0 if renderer.plan.specular or case.less else renderer.baked.errors_mk["noise"]
    error = np.sqrt(paths**2 + noise**2 + sampling**2)
    deviation = _blocks(seen - images.mean(axis=0)) / per_mk
    apart = np.maximum(np.abs(deviation) - everywhere, 0.0) / error
    worst = np.unravel_index(np.argmax(apart), apart.shape)
    limit = student.isf(0.5 * FALSE_ALARM / apart.size, BLOCK**2 * (SEEDS - 1))
    mean_error = np.sqrt((paths**2).mean() / paths.size)
    found = (deviation[worst], error[worst], apart[worst], limit, everywhere, deviation.mean(), mean_error, paths.max())
    return Opinion(*map(float, found))


def _blocks(image):
    """Means over squares of BLOCK pixels a side."""
    height, width = image.shape
    return image.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean(axis=(1, 3))


# --- one scene for each feature ---------------------------------------------------------------------------


def quad(side, up=0.0, cells=1):
    """A level square of `cells` cells a side."""
    at = np.linspace(-0.5 * side, 0.5 * side, cells + 1)
    x, y = np.meshgrid(at, at)
    vertices = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, up)])
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    ends = corner + 1, corner + cells + 2, corner + cells + 1
    faces = np.concatenate([np.stack([corner, ends[0], ends[1]], 1), np.stack([corner, ends[1], ends[2]], 1)])
    return trimesh.Trimesh(vertices, faces, process=False)


def turned(mesh, angle_deg, axis, up=0.0):
    """The mesh turned about an axis through the origin, and raised."""
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(angle_deg), axis))
    mesh.apply_translation([0.0, 0.0, up])
    return mesh


def written(folder, mesh, material, temperature=300.0, sky=230.0, air=None, extra="", plain=None):
    """Write a scene of one mesh of a material of the library, under a sky of one temperature or under air.

    `plain` is the same shape of fewer triangles, for the path tracer.
    """
    write_mesh(folder, mesh, temperature, sky=sky, extra=extra)
    path = folder / "scene.toml"
    text = path.read_text().replace('source = "constant"\nvalue = 0.9', f'source = "material"\nmaterial = "{material}"')
    path.write_text(text.replace(f"[sky]\ntemperature = {sky}\n", air) if air else text)
    if plain is not None:
        written(folder / "plain", plain, material, temperature, sky, air, extra)
    return folder


def trench(cells):
    """Floor and walls of a box of 4 m that is open at the top."""
    turns = ((0, [1, 0, 0]), (90, [1, 0, 0]), (-90, [1, 0, 0]), (90, [0, 1, 0]), (-90, [0, 1, 0]))
    return trimesh.util.concatenate([turned(quad(4.0, -2.0, cells), angle, axis, 2.0) for angle, axis in turns])


CASES: dict[str, Callable] = {}


def case(feature):
    """Register a function of an empty folder that returns a Case."""
    return lambda function: CASES.setdefault(feature, function)


@case("emission of a raster of temperatures")
def _(folder):
    warm = np.random.default_rng(1).uniform(292.0, 296.0, (32, 32))
    return Case(write_terrain(folder, temperature=warm, sky=0.0), tr.pose(0, 0, 14, pitch_deg=-80), stock=True)


@case("sky on a slope of quartz sand, from 3 km")
def _(folder):
    scene = written(folder, turned(quad(4000.0), 25.0, [1, 0, 0]), "sand_quartz", 305.0)
    return Case(scene, tr.pose(0, 0, 3000, pitch_deg=-90), stock=True)


@case("light between surfaces: a trench")
def _(folder):
    scene = written(folder, trench(10), "paint_metallic", 300.0, 280.0, plain=trench(1))
    return Case(scene, tr.pose(0, 0, 9, pitch_deg=-90), 96, stock=True)


@case("mirror, tilted: what only it shows")
def _(folder):
    # Black, because in mirrors the renderer treats light on other surfaces as diffuse: 57 mK under black paint.
    hot = scene_object("hot", [12, 6, 3], [0, 3.4, 8], 330.0, "black")
    write_materials(folder)
    scene = written(folder, turned(quad(30.0), 20.0, [1, 0, 0]), "gold_polished", 300.0, 290.0, extra=hot)
    return Case(scene, tr.pose(0, -16, 12, pitch_deg=-35), 64, stock=True)


@case("mirror under air: what stands 150 m behind a lake")
def _(folder):
    hot = scene_object("hot", [120, 2, 60], [0, 150, 0], 340.0)
    scene = written(folder, quad(800.0, cells=4), "water_fresnel", 290.0, air=AIR, extra=hot, plain=quad(800.0))
    return Case(scene, tr.pose(0, 0, 4, pitch_deg=-15), 32)


@case("mirror in a mirror")
def _(folder):
    hot = scene_object("hot", [1, 1, 1], [1.5, 0, 0], 280.0, "black")
    write_materials(folder)
    plate = scene_object("plate", [8, 0.1, 8], [0, 6, 0], 300.0, "gold_polished")
    scene = written(folder, quad(30.0), "gold_polished", extra=hot + plate)
    return Case(scene, tr.pose(0, -8, 4, pitch_deg=-20), 100, stock=True)


@case("air, straight down from 3 km")
def _(folder):
    return Case(written(folder, quad(5000.0), "grass_green", 310.0, air=AIR), tr.pose(0, 0, 3000, pitch_deg=-90), 8)


@case("air, at a slant from 30 m over warm ground in cold air")
def _(folder):
    air = AIR.replace("midlatitude-summer", "subarctic-winter")
    scene = written(folder, quad(2000.0), "soil_loam", 300.0, air=air)
    return Case(scene, tr.pose(0, -900, 30, pitch_deg=-19), 12)


@case("air, level from 2 m")
def _(folder):
    far = scene_object("far", [500, 20, 250], [0, 1500, 0], 330.0)
    scene = written(folder, quad(4000.0), "grass_green", 295.0, air=AIR, extra=far)
    return Case(scene, tr.pose(0, -900, 2, pitch_deg=0), 16)


@case("air in the light between surfaces: a valley 1 km wide")
def _(folder):
    # A slope of metallic paint sees a wall 60 K warmer than the air.
    hot = scene_object("hot", [1000, 1, 500], [0, 1000, 0], 360.0)
    slope = turned(quad(300.0), -60.0, [1, 0, 0], 131.0)
    land = trimesh.util.concatenate([quad(2400.0, cells=2), slope])
    scene = written(folder, land, "paint_metallic", 290.0, air=AIR, extra=hot)
    return Case(scene, tr.pose(0, 150, 140, yaw_deg=180, pitch_deg=-5), 16,
                left_out="light between surfaces ignores the air")  # fmt: skip


SUN = "[sun]\nelevation_deg = 40.0\nazimuth_deg = 160.0\n"


@case("sun, with shadow")
def _(folder):
    roof = scene_object("roof", [4, 4, 0.2], [0, 0, 3], 300.0)
    shapes = quad(16.0, cells=24), "paint_metallic", 300.0, 0.0, AIR
    dark = written(folder / "dark", *shapes, roof, quad(16.0))
    scene = written(folder, *shapes, SUN + roof, quad(16.0))
    return Case(scene, tr.pose(0, 0, 30, pitch_deg=-90), 4, less=dark)


CLOUDS = AIR + "cloud_fraction = 0.6\ncloud_base_m = 1200.0\n"


@case("sun between clouds")
def _(folder):
    dark = written(folder / "dark", quad(60.0), "paint_metallic", air=CLOUDS)
    scene = written(folder, quad(60.0), "paint_metallic", air=CLOUDS, extra=SUN)
    return Case(scene, tr.pose(0, 0, 2, pitch_deg=-40), 4, less=dark)


# A telescope of 0.24°, inside the sun's disc of 0.53°.
FAR = {"focal_length_mm": 2500.0}
MIDWAVE = {"band_um": (3.7, 4.8)}


def mirrored(folder, camera):
    """The sun in still water, 100 m away."""
    scene = written(folder, quad(400.0), "water_fresnel", 290.0, air=AIR, extra=SUN)
    return Case(scene, tr.pose(0, 0, 64.28, yaw_deg=160, pitch_deg=-40), 64, camera=camera, share=2e-3)


@case("glint of the sun on still water")
def _(folder):
    return mirrored(folder, FAR)


@case("mid-wave, 3.7–4.8 µm: glint of the sun on still water")
def _(folder):
    return mirrored(folder, FAR | MIDWAVE)


@case("mid-wave: sunlit ground and shadow")
def _(folder):
    roof = scene_object("roof", [4, 4, 0.2], [0, 0, 3], 300.0)
    scene = written(folder, quad(16.0, cells=24), "concrete", 300.0, 0.0, AIR, SUN + roof, quad(16.0))
    return Case(scene, tr.pose(0, 0, 30, pitch_deg=-90), 16, camera=MIDWAVE)


@case("mid-wave: ground of 1500 K through 3 km of air")
def _(folder):
    scene = written(folder, quad(5000.0), "concrete", 1500.0, air=AIR)
    return Case(scene, tr.pose(0, 0, 3000, pitch_deg=-90), 16, camera=MIDWAVE)


@case("a porous crown over colder ground")
def _(folder):
    """Clusters of leaves in a ball of 3 m, 1.2 m²/m³ of one side; the ground shows between them."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-1.4, 1.5, 0.2), np.arange(-1.4, 1.5, 0.2)))
    depth, random = 2.0 * np.sqrt(np.maximum(1.5**2 - x**2 - y**2, 0.0)), np.random.default_rng(1)
    count = round(2.0 * 1.2 * depth.sum() * 0.2**2 / surface_m2(0.45))
    chosen = random.choice(len(depth), count, p=depth / depth.sum())
    plan = np.column_stack([x, y])[chosen] + random.uniform(-0.1, 0.1, (count, 2))
    up = 3.0 + depth[chosen] * (random.uniform(size=count) - 0.5)
    folder.mkdir()
    vertices, faces = leaves(random, np.column_stack([plan, up]), 0.45)
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "crown.ply")
    crown = scene_object("crown", [1, 1, 1], [0, 0, 0], 294.0, "paint_metallic", file="crown.ply")
    scene = written(folder, quad(40.0, cells=32), "sand_quartz", 290.0, 280.0, extra=crown, plain=quad(40.0))
    (folder / "plain" / "crown.ply").write_bytes((folder / "crown.ply").read_bytes())
    return Case(scene, tr.pose(0, -6, 9, pitch_deg=-45), 48, stock=True)


@case("clouds, from below")
def _(folder):
    return Case(written(folder, quad(60.0), "paint_metallic", air=CLOUDS), tr.pose(0, 0, 2, pitch_deg=5), 8)


@case("distortion and principal offset")
def _(folder):
    hot = scene_object("hot", [5, 4, 1], [7.5, 4, 0], 360.0)
    scene = written(folder, quad(40.0, cells=40), "grass_green", extra=hot, plain=quad(40.0))
    bent = {"distortion": (-0.26, 0.10, 7e-4, 3e-4, -0.026), "principal_offset_px": (2.3, -1.7)}
    return Case(scene, tr.pose(0, 0, 25, pitch_deg=-80), 64, camera=bent, stock=True)


@case("moving object: place, heading and temperature at a time")
def _(folder):
    folder.mkdir()
    track = "time_s,east_m,north_m,yaw_deg,temperature_k\n0,-4,1,350,300\n10,6,3,30,380\n"
    (folder / "car.csv").write_text(track)
    car = scene_object("car", [3, 5, 2], [0, 0, 0], 290.0, "paint_metallic", track="car.csv")
    scene = written(folder, quad(40.0, cells=32), "sand_quartz", extra=car, plain=quad(40.0))
    (folder / "plain" / "car.csv").write_text(track)
    return Case(scene, tr.pose(0, 0, 25, pitch_deg=-75), 32, {"time_s": 6.5})


@pytest.mark.slow
@pytest.mark.parametrize("feature", CASES)
def test_renderer_and_others_agree(tmp_path, feature):
    made = CASES[feature](tmp_path / "s")
    for engine in (traced, stock) if made.stock else (traced,):
        found = opinion(made, engine)
        if made.left_out:
            assert found.apart > 2.0 * found.limit, found
        else:
            assert found.largest_mk < LARGEST_MK, (engine.__name__, found)
            assert found.apart < found.limit, (engine.__name__, found)


PAGE = """# Second opinions

Every feature of the renderer against an independent engine: `tests/path_tracer.py`, float64 NumPy, which shares
no transport, bake, plan, sampling or lookup with it, and stock Mitsuba if it supports the whole scene. The
comparison is of band radiance, in mK of apparent temperature, over blocks of {block}×{block} pixels of scenes made for
the feature, at quality high with 2048 rays per face. The worst block exceeds the renderer's stated error of nodes,
channels, mirrors and sky by the most standard errors (s.e.). A test fails if that is more than allowed, which
correct code does once in a thousand runs. `tests/render/test_second_opinions.py` tests each row, and
`python tests/render/test_second_opinions.py` writes this page.

| feature | second opinion | worst block ± s.e. [mK] | stated [mK] | s.e. beyond, allowed | whole image [mK] |
|---|---|---|---|---|---|
{rows}
| lag of pixels over moving or warming surfaces | closed forms, dense instants: `tests/sensor/test_movers.py` | | | | |

Effects that the renderer leaves out, and their size in scenes made to show them:

| effect | second opinion | worst block ± s.e. [mK] | whole image [mK] |
|---|---|---|---|
{left_out}
"""


def page():
    """Return the page of all cases, Markdown."""
    rows, left_out = [], []
    for feature, make in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            made = make(Path(folder) / "s")
            found = {"path tracer": opinion(made)} | ({"stock Mitsuba": opinion(made, stock)} if made.stock else {})
        for name, one in found.items():
            print(feature, name, one, flush=True)
            block = f"{one.deviation_mk:+.1f} ± {one.error_mk:.1f}"
            mean = f"{one.mean_mk:+.1f} ± {one.mean_error_mk:.1f}"
            if made.left_out:
                left_out.append(f"| {feature}: {made.left_out} | {name} | {block} | {mean} |")
            else:
                beyond = f"{one.stated_mk:.1f} | {one.apart:.1f}, {one.limit:.1f}"
                rows.append(f"| {feature} | {name} | {block} | {beyond} | {mean} |")
    return PAGE.format(block=BLOCK, rows="\n".join(rows), left_out="\n".join(left_out))


if __name__ == "__main__":
    path = Path(__file__).resolve().parents[2] / "validation" / "second_opinions.md"
    path.write_text(page(), encoding="utf-8")
