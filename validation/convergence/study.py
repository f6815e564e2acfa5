"""Error against run time of this renderer and of stock Mitsuba path tracing, with a path-traced reference.

A case is one engine at one setting and one pose. Its time is that of a whole frame. Its error is that of the middle of
the frame against two independent reference renders, whose noise therefore does not count
(`thermorender.render.reference.squared_error`). The sampling error is that against the same renderer with 256 rays per
pixel. Cavities of known radiance complete the table. Every case is written when it is measured; a later run measures
the missing ones.
"""

import json
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from math import inf

import numpy as np

from thermorender import defaults, files, formats
from thermorender.apps.compare import bench, machine
from thermorender.apps.compare.sampling_error import (
    after_optics,
    cache_off,
    converged,
    mk_per_radiance,
    optics_sigma_px,
    rms_mk,
)
from thermorender.errors import ThermorenderError
from thermorender.render import reference
from thermorender.render.quality import QUALITIES
from thermorender.render.renderer import Renderer
from thermorender.render.variant import activate, switch
from thermorender.versions import versions
from validation import cavity
from validation.convergence import figure as convergence_report
from validation.drapes import load_drape

OWN, DEFAULT = "thermorender", "standard"
# Paths with two reflections, as in the reference; "direct" has one.
STOCK = {
    "stock path": {"type": "path", "max_depth": 3},
    "stock direct, BSDF samples": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
}
_MOST_AT_ONCE = 64


@dataclass(frozen=True)
class Mode:
    """The extent of the study.

    Attributes
    ----------
    window : (2,) int
        Width and height of the central part of the image whose error is measured [px].
    views : tuple of str
        Names in `bench.views`.
    far_m : tuple of float
        Heights of further views straight down, of sampling only [m].
    reference_paths : int
        Paths per pixel of each of the two reference renders.
    engines, stock : tuples of str and int
        Stock engines, and their paths per pixel.
    sampling : tuple of (int, int, float)
        Rays per pixel, texture taps per ray and the error above which an edge pixel gets more rays [mK], in addition
        to the qualities.
    rays : tuple of int
        Rays per face of the bake, the default first.
    tolerances_mk : tuple of float
        Tolerances of the spectral nodes and the solution [mK], the default first.
    emissivities : tuple of float
        Emissivities of the cavities.
    seconds : float
        Time for timing one case; at least one frame, at most 15 frames.
    """

    window: tuple
    views: tuple
    far_m: tuple
    reference_paths: int
    engines: tuple
    stock: tuple
    sampling: tuple
    rays: tuple
    tolerances_mk: tuple
    emissivities: tuple
    seconds: float


MODES = {
    "quick": Mode(
        window=(96, 80),
        views=("oblique",),
        far_m=(),
        reference_paths=256,
        engines=("stock direct, BSDF samples",),
        stock=(1, 4),
        sampling=((1, 1, inf), (4, 4, inf)),
        rays=(32,),
        tolerances_mk=(20.0,),
        emissivities=(0.5,),
        seconds=0.3,
    ),
    "full": Mode(
        window=(160, 128),
        views=("oblique",),
        far_m=(1200.0, 10000.0),
        reference_paths=1024,
        engines=tuple(STOCK),
        stock=(1, 4, 16, 64),
        sampling=(
            *((rays, 1, inf) for rays in (1, 4, 16)),
            *((1, taps, inf) for taps in (4, 16)),
            *((4, 4, inf), (16, 4, inf)),
            *((1, 4, 60.0), (1, 16, 150.0), (4, 4, 150.0), (8, 4, 24.0)),
        ),
        rays=(128, 16, 32, 64, 256, 512),
        tolerances_mk=(5.0, 1.0, 20.0, 100.0, 1000.0),
        emissivities=(0.9, 0.5, 0.1),
        seconds=2.0,
    ),
}  # fmt: skip


def convergence(scenes=defaults.SCENES, folder="validation", progress=None, mode="full", overwrite=False,
                device="auto"):  # fmt: skip
    """Measure the cases of some scenes; return {case: record}, which is also written.

    Parameters
    ----------
    scenes : sequence of str or Scene
    folder : path
        Folder for `convergence.json`, `convergence.md` and `convergence_<scene>.png`.
    progress : callable, optional
        Called with (step, share done).
    mode : {"full", "quick"} or Mode
    overwrite : bool
        Measure existing cases again.
    device : {"auto", "cpu", "cuda"}

    Raises
    ------
    ThermorenderError
        An unknown mode or scene, or a folder with cases of another mode.
    """
    if isinstance(mode, str) and mode not in MODES:
        raise ThermorenderError(f"mode={mode!r} is unknown; give one of {', '.join(MODES)}")
    mode = MODES[mode] if isinstance(mode, str) else mode
    folder = files.make_folder(folder)
    path = folder / "convergence.json"
    # Converted by JSON, so that it equals the settings read back.
    settings = json.loads(json.dumps({**asdict(mode), "device": device}))
    kept = {} if overwrite else _read(path, settings)
    sites = [Site(scene if not isinstance(scene, str) else load_drape(scene), mode, device) for scene in scenes]
    jobs = [(site, case) for site in sites for case in _cases(site, mode)]
    jobs += [(None, case) for case in cavity.cases(mode.emissivities, mode.rays, device)]
    for number, (site, (name, measure)) in enumerate(jobs):
        if progress:
            progress(name, number / len(jobs))
        if name not in kept:
            kept[name] = measure()
            record = {"settings": settings, "machine": machine.machine(), "versions": versions(), "cases": kept}
            formats.write_json(path, record)
        if site and (number + 1 == len(jobs) or jobs[number + 1][0] is not site):
            convergence_report.figure(folder / f"convergence_{site.scene.name}.png", kept, site.scene)
            site.forget()
    convergence_report.table(folder / "convergence.md", kept, settings)
    if progress:
        progress("measured", 1.0)
    return kept


def _read(path, settings):
    """Return the cases already measured with these settings."""
    if not path.is_file():
        return {}
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        found, cases = stored["settings"], stored["cases"]
    except (ValueError, KeyError, TypeError):
        raise ThermorenderError(f"{path} is damaged; remove it, or overwrite it") from None
    if found != settings:
        raise ThermorenderError(f"{path} has cases of other settings; give another folder, or overwrite it")
    return cases


def _cases(site, mode):
    """Yield (name, function that measures it) of every case of a scene."""

    def named(engine, group, setting, views=mode.views, **more):
        for view in views:
            key = {"scene": site.scene.name, "view": view, "engine": engine, "group": group, "setting": setting}
            yield "/".join(key.values()), lambda key=key: {**key, **site.measure(view=key["view"], **more)}

    # All of them use the same number of rays per face.
    named_settings = {numbers[:3]: name for name, numbers in QUALITIES.items()}
    for numbers in dict.fromkeys((*named_settings, *mode.sampling)):
        name = named_settings.get(numbers)
        label = f"{numbers[0]} · {numbers[1]} · {numbers[2]:g} mK" + (f" ({name})" if name else "")
        keywords = dict(zip(("samples", "taps", "edge_mk"), numbers, strict=True))
        yield from named(OWN, "sampling", label, tuple(site.poses), keywords=keywords, default=name == DEFAULT)
    for rays in mode.rays:
        yield from named(OWN, "bake rays", f"{rays} rays", keywords={"quality": "high", "rays": rays}, rebake=True)
    for tolerance in mode.tolerances_mk:
        yield from named(
            OWN, "nodes", f"{tolerance:g} mK", keywords={"quality": "high", "tolerance_mk": tolerance}, rebake=True
        )
    for name in mode.engines:
        for samples in mode.stock:
            yield from named(name, "stock", f"{samples} paths", integrator=STOCK[name], samples=samples)


class Site:
    """A scene and the data that its cases share, each made when first needed."""

    def __init__(self, scene, mode, device):
        # Stock Mitsuba needs temperatures, too.
        scene = scene if scene.temperature_state.solved else Renderer(scene, device=device).scene
        self.scene, self.mode, self.device = scene, mode, device
        width, height = mode.window
        self.part = scene.with_camera(replace(scene.camera, width=width, height=height))
        self.poses = {view: bench.views(scene)[view] for view in mode.views}
        self.poses |= {f"{height:g} m": bench.views(scene, height)["nadir"] for height in mode.far_m}
        self.sigma = optics_sigma_px(scene.camera)
        self.own = {"rays": mode.rays[0], "tolerance_mk": mode.tolerances_mk[0], "device": device}
        self.forget()

    def forget(self):
        """Release renderers and images."""
        self.base = cache(lambda: Renderer(self.scene, **self.own))
        self.truth = cache(self._truth)
        self.seen = cache(self._seen)
        self.finest = cache(self._finest)
        self.stock = cache(lambda view: Stock(self.scene, self.poses[view], self.device))
        self._baked = None

    def measure(self, view, keywords=None, rebake=False, default=False, integrator=None, samples=None):
        """Return the record of one case."""
        if integrator:
            render = partial(self.stock(view).render, integrator)
            # The first two renders compile kernels; more samples are rendered in parts of this size.
            for _ in range(2):
                render(min(samples, _MOST_AT_ONCE))
            seconds, image = _seconds(partial(render, samples, seed=3), self.mode.seconds)
            found = {"seconds": seconds}
        else:
            renderer, bake_s = self._renderer(keywords, rebake)
            render = partial(renderer.radiance, self.poses[view])
            for _ in range(2):
                render()
            seconds, image = _seconds(render, self.mode.seconds)
            # The budget of the part of the frame whose error is measured.
            part = Renderer(self.part, **{**self.own, **keywords}, like=renderer)
            budget = part.frame(self.poses[view]).budget_mk["total"]
            found = {"seconds": seconds, "bake_s": bake_s, "default": default, "sampling_mk": None, "budget_mk": budget}
        image = self._middle(image)
        if keywords and not rebake:
            seen = self.seen(view)
            found["sampling_mk"] = rms_mk(image[seen], self.finest(view)[seen], self.scene.camera)
        return {
            **found, **self._error(image, view, "error", 0.0), **self._error(image, view, "optics_error", self.sigma)
        }  # fmt: skip

    def _middle(self, image):
        """Return the part of an image whose error is measured."""
        camera, (width, height) = self.scene.camera, self.mode.window
        left, top = (camera.width - width) // 2, (camera.height - height) // 2
        return image[top : top + height, left : left + width]

    def _renderer(self, keywords, rebake):
        """Return (renderer of whole frames, seconds of its bake or None if it uses another's)."""
        settings = {**self.own, **keywords}
        if not rebake:
            return Renderer(self.scene, **settings, like=self.base()), None
        if not self._baked or self._baked[0] != settings:
            # Only the last one is kept, because a finely traced scene fills the memory.
            self._baked = None
            renderer = Renderer(self.scene, **settings)
            start = time.perf_counter()
            with cache_off():
                _ = renderer.baked
            self._baked = settings, renderer, time.perf_counter() - start
        return self._baked[1:]

    def _truth(self, view):
        # The seeds differ from those of the cases, so the noise is independent.
        pose, paths = self.poses[view], self.mode.reference_paths
        return [reference.render(self.part, pose, samples=paths, seed=seed, device=self.device) for seed in (1, 2)]

    def _seen(self, view):
        """Return whether each pixel of the window shows a surface at its centre, bool."""
        part = Renderer(self.part, **self.own, like=self.base())
        return np.isfinite(part.frame(self.poses[view]).truth["depth"])

    def _finest(self, view):
        part = Renderer(self.part, **self.own, like=self.base())
        return converged(part, self.poses[view])

    def _error(self, image, view, name, sigma):
        """Return the RMS error of pixels that show a surface [mK], and its range of two standard errors."""
        images = [np.asarray(image, np.float64), *self.truth(view)]
        seen = self.seen(view)
        scale = mk_per_radiance(images[1][seen], self.scene.camera.band_um)
        if sigma:
            images = [after_optics(one, sigma) for one in images]
        square, standard_error = reference.squared_error(*(one[seen] for one in images))
        low, middle, high = (float(scale * np.sqrt(max(square + k * standard_error, 0.0))) for k in (-2, 0, 2))
        return {f"{name}_mk": middle, f"{name}_range_mk": [low, high]}


class Stock:
    """A scene in stock Mitsuba, built once and rendered by any integrator.

    Parameters
    ----------
    scene : Scene
    pose : (4, 4) array
        world_from_camera.
    device : {"auto", "cpu", "cuda"}
    """

    def __init__(self, scene, pose, device="auto"):
        self._mi = activate(device)
        self._mono = self._mi.variant()
        self._shape = scene.camera.height, scene.camera.width
        with self.active():
            # The sampler with the least noise at few paths.
            self._world = reference.mitsuba_scene(self._mi, scene, pose, "path", 8, "multijitter")

    @contextmanager
    def active(self):
        """Activate the scene's variant within the context; it takes a tenth of a second."""
        switch(self._mi, reference.VARIANTS[self._mono])
        try:
            yield self._mi
        finally:
            switch(self._mi, self._mono)

    def render(self, integrator, samples, seed=0):
        """Return band radiance, (H, W) float64 [W m⁻² sr⁻¹], by an integrator (a Mitsuba dict)."""
        with self.active() as mi:
            method = mi.load_dict(integrator)
            total = np.zeros(self._shape)
            for done in range(0, samples, _MOST_AT_ONCE):
                count = min(_MOST_AT_ONCE, samples - done)
                total += self.image(method, count, (seed << 12) + done) * count
            # The film integrates radiance per micrometre over nanometres.
            return total / samples * 1e-3

    def image(self, method, samples, seed=0):
        """Return the film of an active integrator, (H, W) float64."""
        image = self._mi.render(self._world, integrator=method, spp=samples, seed=seed)
        return np.array(image)[..., 0].astype(np.float64)


def _seconds(job, budget):
    """Return (median seconds of a job, its result)."""
    taken = []
    while not taken or (sum(taken) < budget and len(taken) < 15):
        start = time.perf_counter()
        result = job()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken)), result
