"""A baked scene: light between surfaces is solved and stored in the texels, ready for any view.

It is an immutable value of NumPy arrays, which can be sent to another process. After an edit of temperature, material,
sky or air it is solved again without tracing rays. Each process uploads the arrays to the device at first use.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from thermorender.render.baked_light import with_previewed
from thermorender.render.device import flat
from thermorender.render.edits.preview import prepare, preview
from thermorender.render.edits.solution import solved_change
from thermorender.render.geometry import Geometry, refuse_other_surfaces
from thermorender.render.light import leaves, radiosity, texels, transport_cache
from thermorender.render.light.absorbed import left_out
from thermorender.render.light.solved import SolvedLight, solve_scene
from thermorender.render.loaded import Loaded, LoadedLight
from thermorender.render.plan import Plan, make_plan
from thermorender.render.reflection.device_tables import black_of
from thermorender.render.variant import activate
from thermorender.scene.scene import Scene

# Called with (what, share done).
Progress = Callable[[str, float], object]
_SOLVING = "solving the light between surfaces"


@dataclass(frozen=True, eq=False)
class BakedScene(LoadedLight):
    """A scene with its light.

    Attributes
    ----------
    scene : Scene
    plan : Plan
    transport : Transport or None
        Rays between the faces; None where reflection is left out.
    incident : (F, N) float32 or None
        Mean radiance that each face receives at each spectral node, from which an edit's solution begins
        [W m⁻² sr⁻¹]; None where reflection is left out.
    texels : tuple of (T,) float32
        Radiance that leaves each texel, one array per spectral channel [W m⁻² sr⁻¹].
    faces : (F, K) float32 or None
        Correction of each face, added to its texels [W m⁻² sr⁻¹].
    face_error : (F,) float32 or None
        Mean square error of the light on each face [(W m⁻² sr⁻¹)²].
    errors_mk : dict
        Errors of the reflected light by cause [mK at 300 K]; see `BakedLight`.
    cache_note : str or None
        Why the traced light could not be kept on disk; None where it was kept or need not be.
    """

    def __repr__(self) -> str:
        errors = ", ".join(f"{name} {value:.2g}" for name, value in self.errors_mk.items())
        return f"BakedScene({self.scene.name!r}, {len(self.texels)} channels, errors {errors or 'none'} mK)"

    def solved_for(self, scene: Scene, progress: Progress | None = None) -> "BakedScene":
        """Return the BakedScene of an edited scene: other temperatures, materials, sky or air. No rays are traced.

        Parameters
        ----------
        scene : Scene
            Of the same surfaces.
        progress : callable, optional
            As of `bake`; called every few milliseconds. An exception that it raises ends the solution.

        Raises
        ------
        ThermorenderError
            Surfaces differ, temperatures are not solved, or parts of the scene disagree.
        """
        refuse_other_surfaces(self.scene.surfaces, scene.surfaces)
        exact, old = self.solved, self.plan
        found = solved_change(exact, scene, partial(progress or _silent, _SOLVING, 0.0))
        if found is not None:
            return bake(scene, found[0], like=exact, progress=progress, solved=found[1])
        plan = make_plan(scene, old.sampling)
        return bake(scene, plan, like=exact, progress=progress, start=exact)

    def ready_for_edits(self) -> None:
        """Precompute what previews of edits need, which the first preview does otherwise.

        It takes seconds once for all edits of a geometry, and 0.1 s for each solution.
        """
        prepare(self)

    def preview_for(self, scene: Scene, progress: Progress | None = None) -> "BakedScene":
        """Return a preview of an edited scene: its change to first order, with an estimate of its error.

        An edit of materials or temperatures changes the light of the edited surfaces, and its first reflection by
        others; further reflections of the change are left out. `errors_mk` has an estimate from above of its difference
        from `solved_for`: "preview" on any surface, and "preview_rms" over all. Other edits, and scenes with mirrors or
        with objects on tracks, are solved as by `solved_for`, and have no such error.

        A preview of a preview may begin from it; the estimate then covers both.

        Parameters
        ----------
        scene : Scene
            Of the same surfaces.
        progress : callable, optional
            As of `solved_for`, for edits that are solved.

        Raises
        ------
        ThermorenderError
            As of `solved_for`.
        """
        refuse_other_surfaces(self.scene.surfaces, scene.surfaces)
        found = preview(self, scene)
        return found if isinstance(found, BakedScene) else self.solved_for(scene, progress)

    def seen_as(self, scene: Scene, plan: Plan) -> "BakedScene | None":
        """Return this light under another camera or sampling, or None where `scene` and `plan` change the light."""
        now, before = plan.sampling, self.plan.sampling
        same = (now.rays, now.tolerance_mk, plan.band_um) == (before.rays, before.tolerance_mk, self.plan.band_um)
        same &= scene.changes(self.scene) <= {"camera"}
        return replace(self, scene=scene, plan=plan) if same else None


def _silent(what: str, share: float) -> None:
    """Report nothing."""


def bake(
    scene: Scene,
    plan: Plan,
    geometry: Geometry | None = None,
    like: LoadedLight | None = None,
    progress: Progress | None = None,
    start: LoadedLight | None = None,
    solved: SolvedLight | None = None,
) -> BakedScene:
    """Return the BakedScene of a scene. Rays are reused from `like`, of the same surfaces, if their number per face is
    the same. The solution begins from `start`, of similar light, within its error bound. `solved` is the light where it
    is known."""
    known = None
    if like is not None:
        refuse_other_surfaces(like.scene.surfaces, scene.surfaces)
        geometry = geometry or like.geometry
        known = like.transport if like.plan.sampling.rays == plan.sampling.rays else None
    geometry = geometry or Geometry(activate(), scene.surfaces)
    spectrum, material, temperature = (
        plan.spectrum,
        flat(scene.surfaces, "material"),
        flat(scene.surfaces, "temperature"),
    )
    report_progress, note = progress or _silent, None
    tick = partial(report_progress, _SOLVING, 0.0)
    tick()
    texel = texels.emitted(plan, scene.materials, material, temperature, tick)
    black = None
    # Such a material may occur on dynamic objects only.
    if plan.specular and plan.specular.number[material].any():
        black = black_of(plan, plan.specular.number, material, temperature)
    loaded = Loaded(geometry=geometry)
    if like is not None and known is not None:
        loaded.samples = like.loaded.samples
    if not plan.bake:
        none = dict.fromkeys(("solution", "noise", "faces", "texels"), 0.0)
        none = with_previewed(none, scene)
        return BakedScene(scene, plan, None, None, tuple(texel), None, None, black, None, none, None, loaded)
    if known is None:
        what = "tracing the light between surfaces"
        report_progress(what, 0.0)
        known, note = transport_cache.traced(geometry, plan.sampling.rays, lambda share: report_progress(what, share))
    tick = partial(report_progress, _SOLVING, 0.5)
    tick()
    per_mk, share = plan.radiance_per_mk, geometry.share
    guess = None
    if start is not None and start.incident is not None:
        guess = start.incident @ spectrum.of(start.plan.spectrum)
    if solved is None:
        solved = solve_scene(scene, plan, geometry, known, (material, temperature), guess, tick)
    loaded.solution = solved.kept
    incident, noise = solved.incident, solved.noise
    tick()
    lost: Any = 0.0 if scene.air is None else left_out(scene, known, solved.reflectance)
    face, scatter = texels.reflect(texel, geometry, plan.spectrum, material, incident, tick)
    tick()
    reflected = incident @ solved.mean_reflectance.astype(np.float32)
    varies = texels.variation(geometry, reflected, noise)
    within: Any = 0.0
    distant = np.repeat([each.far for each in geometry.surfaces], np.diff(geometry.face_start))
    if geometry.has_copies:
        within = leaves.within(geometry, radiosity.openness, known.sky.sum(axis=1), reflected)
        within = np.hypot(within, leaves.emitted(geometry, scene, plan))
        near = share if not distant.any() else np.where(distant, 0.0, share) / share[~distant].sum()
        varies = float(np.sqrt(varies**2 + near @ within**2))
    solution = ((1.0 - spectrum.emissivity).max(axis=0) * solved.bounds).sum()
    rms = [np.sqrt(share @ square) for square in (noise**2, scatter)]
    errors = {"solution": solution, "noise": rms[0], "faces": varies, "texels": rms[1]}
    if scene.air is not None:
        errors["air"] = np.sqrt(share @ lost**2)
    errors = with_previewed({name: float(value / per_mk) for name, value in errors.items()}, scene)
    report_progress(_SOLVING, 1.0)
    # Per face, for the error budget of frames, which adds `varies` to all.
    square = (noise**2 + scatter + lost**2 + within**2).astype(np.float32)
    if distant.any():
        more = texels.variation(geometry, reflected, noise, far=True) ** 2 - varies**2
        square[distant] += np.float32(max(more, 0.0))
    return BakedScene(
        scene, plan, known, incident, tuple(texel), face, square, black, solved.static, errors, note, loaded
    )
