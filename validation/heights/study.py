"""Error against run time of views at 45° from several heights, with and without air.

Time is that of the radiance of a whole frame; the error is the sampling error against 256 rays per pixel. Each case is
written when it is measured, and a later run measures the missing ones. Time nothing else meanwhile.

The peers cast one ray per pixel of the first view at the same mesh: this package's ray caster alone, trimesh with
embreex, PyVista's software renderer, and Mitsuba's own integrators. Peers that are not installed are left out.
"""

import time

import numpy as np

from thermorender import defaults, files, formats
from thermorender.apps.compare import bench, machine
from thermorender.apps.compare.sampling_error import converged, optics_sigma_px, rms_mk
from thermorender.render.renderer import Renderer
from thermorender.versions import versions
from validation.convergence.study import STOCK, Stock
from validation.drapes import load_drape
from validation.heights.figure import figure
from validation.kept_cases import kept_cases

HEIGHTS_M = (120.0, 420.0, 1200.0, 10_000.0)
QUALITIES = ("fast", "standard", "high")
AIRS = {"no air": None, "air": ("midlatitude-summer", "rural-23km")}
HEADER = ("scene", "height [m]", "air", "quality", "rays per pixel", "rays only [ms]", "frame [ms]",
          "error [mK]", "after optics [mK]")  # fmt: skip
# Frames timed; the first two compile kernels and do not count.
_FRAMES = 9


def run(folder, scenes=defaults.SCENES, heights=HEIGHTS_M, airs=tuple(AIRS), progress=None, device="auto"):
    """Measure the cases that `heights.json` of a folder lacks; return {case: record}, as written there.

    Parameters
    ----------
    folder : path
    scenes : sequence of str or Scene
    heights : sequence of float
        Above the ground in the middle of the view [m].
    airs : sequence of str
        Some of AIRS.
    progress : callable, optional
        Called with (step, share done).
    device : {"auto", "cpu", "cuda"}
    """
    folder = files.make_folder(folder)
    path = folder / "heights.json"
    kept = kept_cases(path)
    sites = [(load_drape(scene) if isinstance(scene, str) else scene, air) for scene in scenes for air in airs]

    def keep(found):
        kept.update(found)
        formats.write_json(path, {"machine": machine.machine(), "versions": versions(), "cases": kept})
        figure(folder / "heights.png", kept)

    for number, (scene, air) in enumerate(sites):
        renderers = None
        for turn, height in enumerate(heights):
            names = {quality: f"{scene.name}/{height:g} m/{air}/{quality}" for quality in QUALITIES}
            if progress:
                progress(f"{scene.name}, {height:g} m, {air}", (number + turn / len(heights)) / len(sites))
            if not all(name in kept for name in names.values()):
                renderers = renderers or _renderers(scene, air, device)
                pose = bench.views(scene, height)["oblique"]
                truth = converged(renderers["standard"], pose)
                keep({names[q]: {"scene": scene.name, "height_m": height, "air": air, "quality": q,
                                 **_measure(renderers[q], pose, truth)} for q in QUALITIES})  # fmt: skip
    name = f"peers/{sites[0][0].name}"
    if name not in kept:
        keep({name: {"scene": sites[0][0].name, "peers_ms": peers(sites[0][0], heights[0], device)}})
    if progress:
        progress("measured", 1.0)
    return kept


def rows(cases):
    """Return the cases as table rows of text under HEADER, and the peers' times."""
    found = [
        (case["scene"], f"{case['height_m']:g}", case["air"], case["quality"], f"{case['rays_per_pixel']:.2f}",
         f"{case['rays_ms']:.1f}", f"{case['frame_ms']:.1f}", f"{case['error_mk']:.1f}",
         f"{case['optics_error_mk']:.1f}")
        for case in cases.values() if "height_m" in case
    ]  # fmt: skip
    for case in cases.values():
        for name, cpu_ms in case.get("peers_ms", {}).items():
            shown = "not installed" if cpu_ms is None else f"{cpu_ms:.1f} CPU"
            found.append((case["scene"], "", "", name, "", "", shown, "", ""))
    return found


def _renderers(scene, air, device):
    scene = scene.with_air(*AIRS[air]) if AIRS[air] else scene
    found = {}
    for quality in QUALITIES:
        found[quality] = Renderer(scene, quality, device=device, rays=128, like=next(iter(found.values()), None))
        _ = found[quality].baked
    return found


def _measure(renderer, pose, truth):
    """Return times [ms], rays per pixel and errors [mK] of one view; rays and frames alternate."""
    camera, rays = renderer.scene.camera, renderer.rays(pose)
    seconds, image = [], None
    for turn in range(_FRAMES + 2):
        begin = time.perf_counter()
        renderer.cast_only(pose, rays)
        middle = time.perf_counter()
        image = renderer.radiance(pose)
        if turn > 1:
            seconds.append((middle - begin, time.perf_counter() - middle))
    casting, frame = 1e3 * np.median(seconds, axis=0)
    return {
        "rays_per_pixel": sum(len(x) for x, _ in rays) / (camera.width * camera.height),
        "rays_ms": float(casting),
        "frame_ms": float(frame),
        "error_mk": rms_mk(image, truth, camera),
        "optics_error_mk": rms_mk(image, truth, camera, optics_sigma_px(camera)),
    }


def peers(scene, height_m, device="auto"):
    """Return {what: CPU time of one view [ms], None where it is not installed}, at one ray per pixel."""
    renderer, pose = Renderer(scene, device=device), bench.views(scene, height_m)["oblique"]
    single = Renderer(scene, samples=1, edge_mk=np.inf, device=device, like=renderer)
    rays = single.rays(pose)
    found = {
        "rays alone": _cpu_ms(lambda: single.cast_only(pose, rays)),
        "radiance, one ray per pixel": _cpu_ms(lambda: single.radiance(pose)),
        "radiance, standard": _cpu_ms(lambda: renderer.radiance(pose)),
        "frame with sensor, standard": _cpu_ms(lambda: renderer.frame(pose).counts),
        "trimesh with embreex": _trimesh_ms(scene, pose),
        "PyVista, software": _pyvista_ms(scene, pose),
    }
    stock = Stock(renderer.scene, pose, device)
    with stock.active() as mi:
        for name, integrator in STOCK.items():
            method = mi.load_dict(integrator)
            found[f"Mitsuba, {name.removeprefix('stock ')}"] = _cpu_ms(lambda own=method: stock.image(own, 1))
    return found


def _cpu_ms(job):
    """Return the least CPU time of a job over all threads [ms]; it is disturbed least by other processes."""
    times = []
    for _ in range(_FRAMES):
        begin = time.process_time()
        job()
        times.append(time.process_time() - begin)
    return 1e3 * min(times[2:])


def _mesh(scene):
    """Return (vertices, faces) of all surfaces of a scene."""
    starts = np.cumsum([0] + [len(surface.vertices) for surface in scene.surfaces])
    faces = [surface.faces + start for surface, start in zip(scene.surfaces, starts, strict=False)]
    return np.concatenate([surface.vertices for surface in scene.surfaces]), np.concatenate(faces)


def _trimesh_ms(scene, pose):
    try:
        from trimesh import Trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        return None
    camera = scene.camera
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    slopes = camera.directions(np.stack([column.ravel(), row.ravel()], axis=-1))
    way = np.column_stack([slopes, np.ones(len(slopes))]) @ pose[:3, :3].T
    start = np.broadcast_to(pose[:3, 3], way.shape)
    caster = RayMeshIntersector(Trimesh(*_mesh(scene), process=False))
    return _cpu_ms(lambda: caster.intersects_first(start, way))


def _pyvista_ms(scene, pose):
    try:
        import pyvista
    except ImportError:
        return None
    vertices, faces = _mesh(scene)
    camera, size = scene.camera, [scene.camera.width, scene.camera.height]
    plotter = pyvista.Plotter(off_screen=True, window_size=size)
    plotter.add_mesh(pyvista.PolyData.from_regular_faces(vertices, faces), lighting=False)
    middle = pose[:3, 3]
    plotter.camera_position = [middle, middle + pose[:3, 2], -pose[:3, 1]]
    plotter.camera.view_angle = 2.0 * np.degrees(np.arctan(0.5 * camera.height / camera.focal_length_px))
    plotter.show(auto_close=False)
    found = _cpu_ms(lambda: (plotter.render(), plotter.screenshot(return_img=True)))
    plotter.close()
    return found
