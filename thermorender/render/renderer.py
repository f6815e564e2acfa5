"""The renderer: frames of one baked scene, each a function of camera, pose, time and objects alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import index as whole
from typing import Any, Literal

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.frame import Frame
from thermorender.physics.planck import band_radiance
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.render import truth
from thermorender.render.air import Vacuum, refuse_camera
from thermorender.render.baked import BakedScene, Progress, bake
from thermorender.render.dynamic import Placement, placements
from thermorender.render.geometry import (
    Geometry,
    Layer,
    OutgoingRadiance,
    opaque_view,
    refuse_other_surfaces,
    view_ray,
)
from thermorender.render.pixels import budget, slender
from thermorender.render.pixels.sampling import CameraRays
from thermorender.render.pixels.tracer import Sampling, Tracer
from thermorender.render.plan import Plan, checked, make_plan
from thermorender.render.variant import activate
from thermorender.scene.scene import Scene
from thermorender.scene.surface import FILLED, Surface
from thermorender.scene.temperature_state import Conditional, Moved
from thermorender.sensor.camera import Camera

# Error from which on edge pixels of a visible view get more rays: a share of white, summed over the colours.
_VISIBLE_EDGE = 0.03
# Cameras whose rays are in memory.
_RAYS_KEPT = 4
# {name of a dynamic object: {column of its track: value}}.
Objects = Mapping[str, Mapping[str, float]]


class Renderer:
    """Renders frames of one scene.

    Parameters
    ----------
    scene : Scene
    quality : {"fast", "standard", "high"}
        How finely a pixel is sampled; see `thermorender.render.plan.QUALITIES`.
    samples, taps, edge_mk : optional
        Rays per pixel, texture taps per ray, and the error from which on a pixel that shows an edge gets more rays
        [mK], in place of the quality's own.
    rays : int, optional
        Rays per face of the bake, in place of the quality's own.
    tolerance_mk : float
        Error allowed to the spectral nodes and to the solution of the bake [mK].
    seed : int
        Seed of the sensor's noise.
    device : {"auto", "cpu", "cuda"}
    progress : callable, optional
        Called with (what, share done) while temperatures are solved and the scene is baked.
    like : Renderer, optional
        A renderer of the same surfaces at other temperatures; its traced light is used again.

    Attributes
    ----------
    scene : Scene
        Where its temperatures follow the weather, the scene with these solved for its time.
    plan : Plan
        What this scene needs and what was left out.

    Raises
    ------
    ThermorenderError
        What is not a Scene, one whose parts disagree, a setting out of range, or a `like` of other surfaces.
    """

    scene: Scene
    plan: Plan
    seed: int
    _asked: Scene
    _like: BakedScene | None
    _baked: BakedScene | None
    _geometry: Geometry
    _rays_of: dict[Camera, CameraRays]
    _coloured: list[tuple[Geometry, OutgoingRadiance]] | None

    def __init__(
        self, scene: Scene, quality: Literal["fast", "standard", "high"] = "standard", samples: int | None = None,
        taps: int | None = None, edge_mk: float | None = None, rays: int | None = None, tolerance_mk: float = 5.0,
        seed: int = 0, device: Literal["auto", "cpu", "cuda"] = "auto", progress: Progress | None = None,
        like: "Renderer | None" = None,
    ) -> None:  # fmt: skip
        if not isinstance(scene, Scene):
            raise ThermorenderError(
                f"scene={shortened(repr(scene))} is not a Scene; give what load_scene returns, as in "
                "Renderer(load_scene('heath'))"
            )
        sampling = (quality, samples, taps, edge_mk, rays, tolerance_mk)
        checked(*sampling)
        self._asked, self.seed = scene, _whole("seed", seed)
        self._like, self._progress, self._baked, self._rays_of, self._coloured = None, progress, None, {}, None
        scene.refuse_disagreement()
        if scene.temperature_state.solved:
            # Before the device, so that a setting that does not suit the scene is refused at once.
            self.plan = make_plan(scene, *sampling)
        mi = activate(device)
        if like is None:
            self._geometry = Geometry(mi, scene.surfaces)
        else:
            refuse_other_surfaces(like.scene.surfaces, scene.surfaces)
            self._geometry = like._geometry
        if not scene.temperature_state.solved:
            scene = _solved(scene, like, self._geometry, progress)
            self.plan = make_plan(scene, *sampling)
        self.scene = scene
        if like is None:
            return
        if like.plan.rays == self.plan.rays:
            self._baked = like.baked.seen_as(scene, self.plan)
            self._like = None if self._baked else like.baked

    @classmethod
    def of(cls, baked: BakedScene, seed: int = 0) -> "Renderer":
        """Return the Renderer of a BakedScene, such as one from another process."""
        made = cls.__new__(cls)
        made.scene, made.plan, made.seed = baked.scene, baked.plan, _whole("seed", seed)
        made._asked = baked.scene
        made._like, made._progress, made._baked, made._rays_of, made._coloured = None, None, baked, {}, None
        made._geometry = baked.geometry
        return made

    def __repr__(self) -> str:
        state = "baked" if self._baked is not None else "not baked yet"
        scene = self.scene
        return f"Renderer({scene.name!r}, {scene.camera.name}, {self.plan.nodes} nodes, seed {self.seed}, {state})"

    @property
    def baked(self) -> BakedScene:
        """The BakedScene; light between surfaces is traced and solved when first asked for."""
        if self._baked is None:
            self._baked = bake(self.scene, self.plan, self._geometry, self._like, self._progress)
            self._like = None
        return self._baked

    def frame(
        self, pose: ArrayLike, time_s: float = 0.0, index: int = 0, objects: Objects | None = None
    ) -> Frame:
        """Return the Frame seen from `pose`.

        Parameters
        ----------
        pose : (4, 4) array
            world_from_camera: camera looks along +z, x right, y down; metres in the scene's local frame.
        time_s : float
            Where on their tracks dynamic objects are [s].
        index : int
            Number of the frame; with the seed it decides the noise.
        objects : dict, optional
            {name of a dynamic object: {column of its track: value}} to take instead of the track's.

        Raises
        ------
        ThermorenderError
            A pose that is no rigid transform, an index that is no whole number from 0 on, or an object that does not
            move or leaves the terrain.
        """
        view = self._view(pose, time_s, objects)
        radiance, sampling = view.radiance()
        return self._frame(view, radiance, time_s, index, self.plan.as_dict(), sampling)

    def radiance(
        self, pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None, through_air: bool = True,
        camera: Camera | None = None, lit_s: float | None = None,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Return the band radiance of `frame` alone, (H, W) float32 [W m⁻² sr⁻¹], without noise or truth.

        Without `through_air` it is what leaves the surfaces towards the camera, lit through the air as ever. `camera`
        stands in for the scene's, as one that takes a part of its image does; band and air stay the scene's. With
        `lit_s` moving objects get and give the light of that time [s], which saves tracing it for instants beside it.
        """
        return self._view(pose, time_s, objects, camera, lit_s).radiance(through_air)[0]

    def refuse_camera(self, positions: ArrayLike) -> None:
        """Refuse cameras at positions (…, 3) of the local frame that are above the range of the air, or its clouds."""
        refuse_camera(self.scene, positions)

    def frame_of(
        self, radiance: NDArray[np.float32], pose: ArrayLike, plan: dict[str, Any], time_s: float = 0.0, index: int = 0,
        objects: Objects | None = None,
    ) -> Frame:  # fmt: skip
        """Return the Frame of a radiance image (H, W) made elsewhere for this view; `plan` (a dict) says how."""
        return self._frame(self._view(pose, time_s, objects), radiance, time_s, index, plan)

    def visible(
        self, pose: ArrayLike, camera: Camera | None = None, time_s: float = 0.0, objects: Objects | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return (image (H, W, 3) uint8 sRGB, valid (H, W) bool): the orthophoto seen from `pose`.

        The texture carries its own sun and shade; light is averaged linearly over a pixel's rays. Pixels without
        surface, or where its colour is unknown, are not valid. `camera` stands in for the scene's.
        """
        if camera is not None and not isinstance(camera, Camera):
            raise ThermorenderError(
                f"camera={shortened(repr(camera))} is no Camera; give what load_camera returns, and a time by its "
                "name, time_s"
            )
        pose, mi = checked_pose(pose), self._geometry.mi
        if self._coloured is None:
            # The geometry may be that of another scene of the same surfaces, in other colours.
            shapes = [(self._geometry, self.scene.surfaces)]
            shapes += [(Geometry(mi, one.surfaces), one.surfaces) for one in self.scene.tracked_objects]
            self._coloured = [(shape, _colours(shape, surfaces)) for shape, surfaces in shapes]
        placed = placements(self.scene, time_s, objects)
        poses = [np.eye(4), *(placement.pose for placement in placed)]
        layers = [
            Layer(shape, opaque_view(mi, np.linalg.inv(own) @ pose), outgoing)
            for (shape, outgoing), own in zip(self._coloured, poses, strict=True)
        ]
        nothing, rays = Vacuum(mi, *np.zeros((2, 4))), self._camera_rays(camera)
        parts = _parts(self.scene, self._geometry, [shape for shape, _ in self._coloured[1:]], placed)
        thin = partial(slender.rectangles, parts, pose, rays.camera)
        found, _ = Tracer(layers, rays, nothing, self.plan, thin).image(_VISIBLE_EDGE)
        return bytes_from_linear(np.moveaxis(found[:3], 0, -1)), found[3] > 0.999

    def texels(self, pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None) -> NDArray[np.int64]:
        """Return the number of the terrain's texel that each pixel's middle shows, (H, W) int64; −1 for anything else.

        Texels are counted row by row over the terrain's surfaces.
        """
        view = self._view(pose, time_s, objects)
        valid, number, *_ = truth.pixel_middles(self.baked.device.layers(view.pose, view.placements), view.rays)
        terrain = int(self._geometry.texel_start[self.scene.terrain_count])
        return np.where(valid & (number < terrain), number.astype(np.int64), -1)

    def sky(
        self, pose: ArrayLike, camera: Camera | None = None, time_s: float = 0.0, objects: Objects | None = None
    ) -> NDArray[np.bool_]:
        """Return where a pixel's middle shows nothing and looks above the horizon, (H, W); `camera` as of `visible`."""
        view = self._view(pose, time_s, objects)
        layers = self.baked.device.layers(view.pose, view.placements)
        valid, _, up, *_ = truth.pixel_middles(layers, self._camera_rays(camera))
        return ~valid & up

    def depth(self, pose: ArrayLike, camera: Camera | None = None) -> NDArray[np.float32]:
        """Return how far along the axis each pixel's middle shows the scene at rest, (H, W); infinite where it shows
        nothing [m]. `camera` as of `visible`."""
        at_rest = Layer(self._geometry, opaque_view(self._geometry.mi, checked_pose(pose)), None)
        return np.asarray(truth.pixel_middles([at_rest], self._camera_rays(camera))[4], np.float32)

    def objects_seen(
        self, pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None
    ) -> tuple[NDArray[np.int64], list[str]]:
        """Return (number of the object that each pixel's middle shows, (H, W), −1 for anything else; their names)."""
        view = self._view(pose, time_s, objects)
        valid, number, *_ = truth.pixel_middles(self.baked.device.layers(view.pose, view.placements), view.rays)
        dynamic = [surface for tracked in self.scene.tracked_objects for surface in tracked.surfaces]
        shown = (*self.scene.surfaces, *dynamic)
        owner = [surface.name.split(":")[0] for surface in shown]
        names = list(dict.fromkeys(owner[self.scene.terrain_count :]))
        of = np.array([names.index(name) if name in names else -1 for name in owner])
        ends = np.cumsum([surface.material.size for surface in shown])
        surface = np.minimum(np.searchsorted(ends, number, side="right"), len(shown) - 1)
        return np.where(valid, of[surface], -1), names

    def pictured(
        self, values: NDArray[np.float32], pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None
    ) -> NDArray[np.float32]:
        """Return the mean over each pixel of radiances given to all texels, (H, W) float32: no light, no air.

        Parameters
        ----------
        values : (T,) array
            Of the texels of all surfaces, those of dynamic objects last [W m⁻² sr⁻¹].
        pose, time_s, objects
            As of `frame`. Sky and surroundings are those of `frame`, seen without air.
        """
        pose, mi = checked_pose(pose), self._geometry.mi
        shapes = [self._geometry, *(item.geometry for item in self.baked.device.objects)]
        ends = np.cumsum([shape.texel_start[-1] for shape in shapes])
        parts = np.split(np.asarray(values, np.float32), ends[:-1])
        placed = placements(self.scene, time_s, objects)
        poses = [np.eye(4), *(placement.pose for placement in placed)]
        layers = [
            Layer(shape, opaque_view(mi, np.linalg.inv(own) @ pose), OutgoingRadiance(shape.averaged(part[:, None])))
            for shape, part, own in zip(shapes, parts, poses, strict=True)
        ]
        outside = np.array([self.scene.sky_temperature, self.scene.surroundings_temperature])
        outside = band_radiance(outside, *self.plan.band_um)
        rays, bodies = self._camera_rays(), _parts(self.scene, self._geometry, shapes[1:], placed)
        thin = partial(slender.rectangles, bodies, pose, rays.camera)
        tracer = Tracer(layers, rays, Vacuum(mi, *outside[:, None]), self.plan, thin)
        return tracer.image(self.plan.edge_mk * self.plan.radiance_per_mk)[0][0]

    def rays(self, pose: ArrayLike) -> list[Sequence[Any]]:
        """Return the slopes of all rays that a frame from `pose` casts into the static scene, [(x/z, y/z), …]."""
        view = self._view(pose)
        return view.tracer().slopes(view.radiance()[1])

    def cast_only(self, pose: ArrayLike, rays: Sequence[Sequence[Any]]) -> None:
        """Cast rays, as by `rays`, and nothing else: the floor under the time of a frame."""
        mi = self._geometry.mi
        view = opaque_view(mi, checked_pose(pose))
        cast = self._geometry.caster.ray_intersect_preliminary
        dr.eval([cast(view_ray(mi, *view, *slope), coherent=True).t for slope in rays])
        dr.sync_thread()

    def _view(
        self, pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None, camera: Camera | None = None,
        lit_s: float | None = None,
    ) -> "View":  # fmt: skip
        placed, pose = placements(self.scene, time_s, objects, lit_s), checked_pose(pose)
        self.refuse_camera(pose[:3, 3])
        return View(self.baked, self._camera_rays(camera), pose, placed)

    def _frame(
        self, view: "View", radiance: NDArray[np.float32], time_s: float, index: int, plan: dict[str, Any],
        sampling: Sampling | None = None,
    ) -> Frame:  # fmt: skip
        return Frame(
            radiance=radiance,
            pose=view.pose,
            time_s=float(time_s),
            index=_whole("index", index),
            seed=self.seed,
            camera=self.scene.camera,
            plan=plan,
            time=self.scene.time,
            _view=view,
            _sampling=sampling,
        )

    def _camera_rays(self, camera: Camera | None = None) -> CameraRays:
        camera = camera or self.scene.camera
        if camera not in self._rays_of:
            # The latest alone: parts of an image that things move in are other ones with each frame.
            latest = list(self._rays_of.items())[1 - _RAYS_KEPT :]
            self._rays_of = dict(latest) | {camera: CameraRays(self._geometry.mi, camera)}
        self._rays_of[camera] = rays = self._rays_of.pop(camera)
        return rays


@dataclass(frozen=True)
class View:
    """A baked scene seen from one pose at one time.

    Attributes
    ----------
    baked : BakedScene
    rays : CameraRays
    pose : (4, 4) float64
        world_from_camera.
    placements : tuple of Placement
        Of the dynamic objects.
    """

    baked: BakedScene
    rays: CameraRays
    pose: NDArray[np.float64]
    placements: tuple[Placement, ...]

    def tracer(self, through_air: bool = True) -> Tracer:
        """Return the Tracer of this view."""
        device = self.baked.device
        medium = device.medium(self.pose, self.placements, through_air)
        layers = device.layers(self.pose, self.placements)
        shapes = [item.geometry for item in device.objects]
        parts = _parts(self.baked.scene, self.baked.geometry, shapes, self.placements)
        thin = partial(slender.rectangles, parts, self.pose, self.rays.camera)
        return Tracer(layers, self.rays, medium, self.baked.plan, thin)

    def radiance(self, through_air: bool = True) -> tuple[NDArray[np.float32], Sampling]:
        """Return (band radiance (H, W) float32 [W m⁻² sr⁻¹], Sampling)."""
        plan = self.baked.plan
        limit = plan.edge_mk * plan.radiance_per_mk
        image, sampling = self.tracer(through_air).image(limit)
        return image[0], sampling

    def truth(self) -> dict[str, NDArray[Any]]:
        """Return what is really there, as `Frame.truth` has it, without the sensor's flags."""
        return truth.truth(self.baked, self.rays, self.pose, self.placements)

    def targets(self) -> dict[str, dict[str, Any]]:
        """Return where objects are, as `Frame.targets` has it."""
        return truth.targets(self.baked, self.rays.camera, self.pose, self.placements)

    def budget_mk(self, radiance: NDArray[np.float32], sampling: Sampling | None) -> dict[str, float] | None:
        """Return the error budget, as `Frame.budget_mk` has it, of a radiance image; None without its Sampling."""
        if sampling is None:
            return None
        return budget.budget_mk(self.baked, self.tracer(), self.pose, self.placements, radiance, sampling)

    def error_mk(self, radiance: NDArray[np.float32], sampling: Sampling | None) -> NDArray[np.float32] | None:
        """Return the estimated error of each pixel, as `Frame.error_mk` has it; None without its Sampling."""
        if sampling is None:
            return None
        return budget.error_mk(self.baked, self.tracer(), self.pose, self.placements, radiance, sampling)


def checked_pose(pose: ArrayLike) -> NDArray[np.float64]:
    """Return a pose as (4, 4) float64 after refusing what is no rigid transform."""
    pose = np.array(pose, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.allclose(pose[3], [0, 0, 0, 1]):
        raise ThermorenderError(
            f"pose of shape {pose.shape} is no world_from_camera; give (4, 4) with last row 0 0 0 1"
        )
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0.0:
        raise ThermorenderError(
            "pose has a rotation that is not orthonormal and right-handed; normalise its quaternion"
        )
    return pose


def _parts(
    scene: Scene, geometry: Geometry, moving: Sequence[Geometry], placed: Sequence[Placement]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """What may be thinner than a pixel, as `slender.rectangles` takes it.

    All but ground made of an elevation raster, which hangs together.
    """
    first = scene.terrain_count if scene.spec.terrain.mesh is None else 0
    return [(geometry.boxes(first), np.eye(4)), *((g.boxes(), p.pose) for g, p in zip(moving, placed, strict=True))]


def _colours(geometry: Geometry, surfaces: Sequence[Surface]) -> OutgoingRadiance:
    """The linear colour of the surfaces' texels, and 1 where it is known, else 0, as OutgoingRadiance."""
    linear = linear_from_bytes(np.concatenate([surface.colour.reshape(-1, 3) for surface in surfaces]))
    flags = np.concatenate([surface.flags.ravel() for surface in surfaces])
    known = ((flags & FILLED) == 0).astype(np.float32)
    return OutgoingRadiance(geometry.averaged(np.column_stack([linear, known])))


def _solved(scene: Scene, like: "Renderer | None", geometry: Geometry, progress: Progress | None) -> Scene:
    """A scene with its temperatures solved; those of `like` where it was asked for the same, but for the camera."""
    if like is not None and scene.like_but_for_camera(like._asked):
        known = like.scene.with_camera(scene.camera)
        # Under another band the sky that a conditional map is seen under may differ, and its temperatures with it.
        if known.temperature_state.solved:
            return known
    assert scene.time is not None
    return solved_at(scene, [scene.time], geometry, progress)[0]


def solved_at(
    scene: Scene, times: "Sequence[np.datetime64]", geometry: Geometry | None = None, progress: Progress | None = None
) -> list[Scene]:
    """Return the scene with its temperatures solved for each of some instants, by what its state names as their source.

    Parameters and errors are those of `heat.march.solved`, `heat.moved.moved` and `heat.relief.mapped`.
    """
    # Only here: no other scene needs them.
    source = scene.temperature_state.source
    if isinstance(source, Conditional):
        from thermorender.render.heat.relief import mapped

        return mapped(scene, times, geometry, progress)
    if not isinstance(source, Moved):
        from thermorender.render.heat.march import solved

        return solved(scene, times, geometry, progress)
    from thermorender.render.heat.moved import moved

    return [each.scene for each in moved(scene, times, geometry, progress)]


def _whole(name: str, value: int) -> int:
    """Return what the generator of the noise takes, a seed or the number of a frame, as an int."""
    try:
        number = whole(value)
    except TypeError:
        number = -1
    if not 0 <= number < 2**64:
        raise ThermorenderError(f"{name}={shortened(repr(value))} is not allowed; give a whole number 0 … 2⁶⁴−1")
    return number
