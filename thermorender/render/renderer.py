"""The renderer: frames of one baked scene, each a function of camera, pose, time and objects alone."""

import warnings
from collections.abc import Iterable, Sequence
from functools import partial
from operator import index as whole
from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender import defaults
from thermorender.errors import ThermorenderError, ThermorenderWarning, shortened
from thermorender.frame import Frame
from thermorender.physics.planck import band_radiance
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.progress import interactive
from thermorender.render import truth
from thermorender.render.air import Vacuum, horizon_of, refuse_camera
from thermorender.render.arrays import Mitsuba, aligned, opaque_view, view_ray
from thermorender.render.baked import BakedScene, Progress, bake
from thermorender.render.dynamic import Objects, object_states
from thermorender.render.flight.frames import FlightFrames
from thermorender.render.geometry import Geometry, refuse_other_surfaces
from thermorender.render.heat.instants import solved_at
from thermorender.render.layers import CasterView, Layer, OutgoingRadiance
from thermorender.render.object_numbers import object_names, object_numbers
from thermorender.render.pixels import slender
from thermorender.render.pixels.sampling import CameraRays
from thermorender.render.pixels.tracer import SampledImage, Tracer
from thermorender.render.plan import Plan, make_plan, refuse_surfaces
from thermorender.render.quality import Sampling
from thermorender.render.variant import activate, active_device
from thermorender.render.view import View, parts_of
from thermorender.scene.georeference import place_of
from thermorender.scene.scene import Scene
from thermorender.scene.surface import FILLED, Surface
from thermorender.scene.temperature_state import Balance
from thermorender.sensor.camera import Camera
from thermorender.timing import phase
from thermorender.trajectory.path import Trajectory
from thermorender.trajectory.rotations import checked_pose

if TYPE_CHECKING:
    from thermorender.render.heat.edited import SolvedHeat
    from thermorender.render.heat.known_light import Record
    from thermorender.render.pixels.parts import PixelParts

# Error above which edge pixels of a visible view get more rays: a share of white, summed over the colours.
_VISIBLE_EDGE = 0.03
# Cameras whose rays stay in memory.
_RAYS_KEPT = 8


class Renderer:
    """Renders frames of one scene.

    Parameters
    ----------
    scene : Scene
    quality : {"fast", "standard", "high"}
        How finely a pixel is sampled; see `thermorender.render.quality.QUALITIES`.
    samples, taps, edge_mk : optional
        Rays per pixel, texture taps per ray, and error above which a pixel that shows an edge gets more rays [mK],
        instead of the quality's.
    rays : int, optional
        Rays per face of the bake, instead of the quality's.
    tolerance_mk : float
        Error allowed to the spectral nodes and to the solution of the bake [mK]. A warning names the error of the
        nodes, which the error budget counts, where the most nodes do not reach it.
    seed : int
        Seed of the sensor's noise.
    device : {"auto", "cpu", "cuda"}
    progress : callable, optional
        Called with (what, share done) while temperatures are solved and the scene is baked. Without it a notebook and
        Python's prompt show a bar.
    like : Renderer, optional
        A renderer of the same surfaces at other temperatures; its traced light is used again.
    edits : bool
        Whether a heat balance keeps what `preview_for` and `heat_terms` need, which takes a twentieth of its time more,
        and 80 bytes for each column of the simulation, which like texels share.
    baked : BakedScene, optional
        The scene with its light, as from `baked` of another renderer; its plan has the settings.

    Attributes
    ----------
    scene : Scene
        Temperatures that follow the weather are solved for the scene's time.
    plan : Plan
        Choices for this scene and the steps left out.

    Raises
    ------
    ThermorenderError
        `scene` is not a Scene, its parts disagree, a setting is out of range, or `like` has other surfaces.
    """

    # Whether `solved_for` makes the renderer of another instant of a flight; that of tiles does not.
    follows_weather = True

    scene: Scene
    plan: Plan
    seed: int
    _asked: Scene
    _like: BakedScene | None
    _baked: BakedScene | None
    _geometry: Geometry
    _camera_rays: "_CamerasRays"
    _heat: "SolvedHeat | None"
    _coloured: list[tuple[Geometry, OutgoingRadiance]] | None

    def __init__(
        self, scene: Scene, quality: Literal["fast", "standard", "high"] = "standard", samples: int | None = None,
        taps: int | None = None, edge_mk: float | None = None, rays: int | None = None, tolerance_mk: float = 5.0,
        seed: int = 0, device: Literal["auto", "cpu", "cuda"] = "auto", progress: Progress | None = None,
        like: "Renderer | None" = None, edits: bool = False, *, baked: BakedScene | None = None,
    ) -> None:  # fmt: skip
        if not isinstance(scene, Scene):
            raise ThermorenderError(
                f"scene={shortened(repr(scene))} is not a Scene; give what load_scene returns, as in "
                "Renderer(load_scene('heath'))"
            )
        if baked is None and self.follows_weather:
            scene.refuse_tiles("Renderer", "use TiledRenderer, or ")
        sampling = Sampling.of(quality, samples, taps, edge_mk, rays, tolerance_mk)
        self._asked, self.seed = scene, whole_number("seed", seed)
        self._like, self._progress, self._baked, self._coloured = None, progress, baked, None
        self._heat = None if like is None or baked is None else like._heat
        if baked is not None:
            self.scene, self.plan, self._geometry = baked.scene, baked.plan, baked.geometry
            self._camera_rays = _CamerasRays(self._geometry.mi) if like is None else like._camera_rays
            return
        scene.refuse_disagreement()
        refuse_surfaces(scene)
        if scene.temperature_state.solved:
            # Before the device is started, so that wrong settings are refused at once.
            self.plan = make_plan(scene, sampling)
        mi = activate(device)
        if like is None:
            self._geometry = Geometry(mi, scene.surfaces)
        else:
            refuse_other_surfaces(like.scene.surfaces, scene.surfaces)
            self._geometry = like._geometry
        self._camera_rays = _CamerasRays(mi)
        if not scene.temperature_state.solved:
            scene, self._heat = _solved(scene, like, self._geometry, progress, edits)
            self.plan = make_plan(scene, sampling)
        if self.plan.beyond_tolerance:
            warnings.warn(self.plan.beyond_tolerance, ThermorenderWarning, stacklevel=2)
        self.scene = scene
        if like is None:
            return
        if like.plan.sampling.rays == self.plan.sampling.rays:
            self._baked = like.baked.seen_as(scene, self.plan)
            self._like = None if self._baked else like.baked

    @classmethod
    def of(cls, baked: BakedScene, seed: int = 0) -> "Renderer":
        """Return the Renderer of a BakedScene, such as one from another process."""
        return cls(baked.scene, seed=seed, baked=baked)

    def seen_by(self, camera: Camera) -> "Renderer":
        """Return the renderer of another camera, by light already traced."""
        return Renderer(self.scene.with_camera(camera), like=self, **self.plan.sampling.settings())

    def prepare(self, pose: ArrayLike | None = None) -> None:
        """Trace and solve what can be before the first frame, or before one from a pose."""
        _ = self.baked

    def expect(self, poses: Iterable[ArrayLike]) -> frozenset[int]:
        """Prepare for frames from poses in this order; return numbers of those before which the frames so far should
        be finished, because they hold memory that is then needed."""
        return frozenset()

    def with_seed(self, seed: int) -> "Renderer":
        """Return this renderer with another seed of the sensor's noise."""
        return Renderer.of(self.baked, seed)

    def __reduce__(self) -> tuple[Any, ...]:
        # Pickled with its light, as another process needs it.
        return Renderer.of, (self.baked, self.seed)

    def solved_for(self, scene: Scene, progress: Progress | None = None) -> "Renderer":
        """Return the Renderer of an edited scene of the same surfaces, by light already traced; see `BakedScene`.

        Temperatures that follow the weather are solved first, and kept for `preview_for` and `heat_terms` where this
        renderer was made with `edits`.
        """
        heat = self._heat
        if not scene.temperature_state.solved:
            refuse_other_surfaces(self.scene.surfaces, scene.surfaces)
            scene, heat = _solved(scene, self, self._geometry, progress, heat is not None)
        made = self._like_this(self.baked.solved_for(scene, progress))
        made._heat = heat
        return made

    def preview_for(self, scene: Scene, progress: Progress | None = None) -> "Renderer":
        """Return the Renderer of a preview of an edited scene; see `BakedScene.preview_for`.

        Where temperatures follow from a heat balance and this renderer was made with `edits`, the temperatures after an
        edit of materials or wind are previewed too. Their estimated errors are added to those of the light. Edits of
        the hour or of the sun are solved, and those whose error would be above half of the change, as of leaves.
        """
        if scene.temperature_state.solved:
            return self._like_this(self.baked.preview_for(scene, progress))
        refuse_other_surfaces(self.scene.surfaces, scene.surfaces)
        found = None if self._heat is None else self._heat.preview(scene)
        if found is None:
            assert scene.time is not None
            known = None if self._heat is None else self._heat.record
            solved = solved_at(scene, [scene.time], self._geometry, progress, known=known)[0]
            return self._like_this(self.baked.preview_for(solved, progress))
        return self._like_this(self.baked.preview_for(found, progress))

    def _like_this(self, baked: BakedScene) -> "Renderer":
        """The Renderer of another light on the same surfaces, with the cameras' rays of this one."""
        return Renderer(baked.scene, seed=self.seed, like=self, baked=baked)

    def __repr__(self) -> str:
        state = "baked" if self._baked is not None else "not baked yet"
        scene = self.scene
        return f"Renderer({scene.name!r}, {scene.camera.name}, {self.plan.nodes} nodes, seed {self.seed}, {state})"

    @property
    def baked(self) -> BakedScene:
        """The BakedScene; light between surfaces is traced and solved on first use."""
        if self._baked is None:
            with interactive(self._progress) as report, phase("light solved"):
                self._baked = bake(self.scene, self.plan, self._geometry, self._like, report)
            self._like = None
        return self._baked

    def outlook(self, poses: NDArray[np.float64]) -> tuple[str, ...]:
        """Return sentences on what frames from poses (n, 4, 4) need before the first one."""
        return ()

    @property
    def cache_note(self) -> str | None:
        """Why traced light could not be kept on disk; None where it was kept or need not be."""
        return self.baked.cache_note

    def frame(
        self, pose: ArrayLike, time_s: float = 0.0, index: int = 0, objects: Objects | None = None,
        sampled_as: Frame | None = None,
    ) -> Frame:  # fmt: skip
        """Return the Frame seen from `pose`.

        Parameters
        ----------
        pose : (4, 4) array
            world_from_camera: camera looks along +z, x right, y down; metres in the scene's local frame.
        time_s : float
            Time on the tracks of dynamic objects [s].
        index : int
            Number of the frame; with the seed it determines the noise.
        objects : dict, optional
            {name of a dynamic object: {column of its track: value}} to use instead of the track's.
        sampled_as : Frame, optional
            A frame of the same view, before or after an edit. Each pixel gets the rays that it had there, so that the
            two frames differ by their light alone. Otherwise the radiance decides which pixels get more.

        Raises
        ------
        ThermorenderError
            The pose is not a rigid transform, the index is not a whole number from 0 on, an object has no track or
            leaves the terrain, or `sampled_as` has another view or other surfaces, or was not rendered here.
        """
        view, like = self._view(pose, time_s, objects), None
        if sampled_as is not None:
            like = sampled_as._sampling
            if like is None or not view.sees_as(sampled_as._view):
                raise ThermorenderError(
                    "sampled_as=… is a frame of another view, of other surfaces, or from another process; give one "
                    "that this renderer, or one of its solved_for or preview_for, made of this pose, time and quality"
                )
        radiance, sampling = view.radiance(like=like)
        return self._frame(view, radiance, time_s, index, self.plan.as_dict(), sampling)

    def frames(
        self, trajectory: Trajectory, rate_hz: float | None = None, start_s: float | None = None,
        stop_s: float | None = None, audit: int = defaults.AUDIT,
    ) -> FlightFrames:  # fmt: skip
        """Return the frames of a flight, to loop over: those that `thermorender.fly` writes, to the same bytes.

        The detector keeps its state from frame to frame, and temperatures of a heat balance follow the flight's time.
        `len` gives their number.

        Parameters
        ----------
        trajectory : Trajectory
        rate_hz : float, optional
            Frames per second; by default the camera's.
        start_s, stop_s : float, optional
            Part of the trajectory's time [s]; the whole by default.
        audit : int
            Frames from one measurement of the error budget to the next; 1 measures it in every frame.

        Raises
        ------
        ThermorenderError
            Times outside the trajectory, weather that ends before it, a camera above the range of the air or above its
            clouds, or an `audit` below 1.
        """
        return FlightFrames(self, trajectory, rate_hz, start_s, stop_s, audit=audit)

    def radiance(
        self, pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None, through_air: bool = True,
        camera: Camera | None = None, lit_s: float | None = None, lit_objects: Objects | None = None,
        only: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Return the band radiance of `frame`, (H, W) float32 [W m⁻² sr⁻¹], without noise or truth.

        Without `through_air` it is the radiance that leaves the surfaces towards the camera; they are still lit through
        the air. `camera` replaces the scene's, for example by a part of its image; band and air stay the scene's. With
        `lit_s` moving objects receive and give the light of that time [s], which saves tracing it for instants close to
        it; `lit_objects` is `objects` at that time, by default the same. `only` (H, W) asks for some pixels: they
        get few rays, whether they show an edge or not, and the others are 0.
        """
        view = self._view(pose, time_s, objects, camera, lit_s, lit_objects)
        sides = view.rays.height, view.rays.width
        if only is None:
            return view.radiance(through_air)[0]
        if np.shape(only) != sides:
            raise ThermorenderError(f"only has the shape {np.shape(only)}; give that of the camera's image, {sides}")
        return view.some(np.asarray(only, bool), through_air)

    def parts_at(
        self, pose: ArrayLike, pixels: ArrayLike, time_s: float = 0.0, objects: Objects | None = None,
        camera: Camera | None = None,
    ) -> "list[PixelParts]":  # fmt: skip
        """Return the PixelParts at pixels (n, 2), each a row and a column: their surface and parts of their radiance.

        Raises
        ------
        ThermorenderError
            A pixel outside the image; pose, time and objects as of `frame`.
        """
        from thermorender.render.pixels.parts import parts_at

        return parts_at(self._view(pose, time_s, objects, camera), pixels)

    def heat_terms(self) -> dict[str, NDArray[np.float32]] | None:
        """Return the terms of the heat balance of each texel at the scene's instant, why it is as warm as it is.

        Each is a mean over the last step of the simulation, of at most five minutes, [W m⁻²] over the texel's area, and
        above 0 where the surface gains heat. They add up to 0, to a few thousandths of a watt. A texel of a mixture has
        the mean of its parts by area, leaves in crowns that of their quarter.

        Returns
        -------
        dict of (T,) float32, or None
            Of the texels of all surfaces as `hits` counts them; NaN where the temperature is not solved. None in a
            preview and at other temperatures than those of the run. The names are

            - "sunlight": absorbed, direct, diffuse and reflected by others; in water and snow also below the surface
            - "longwave": absorbed, of the sky and of what the texel sees of the scene
            - "emission": long-wave, −ε σ T⁴
            - "sensible": convection, from the air
            - "latent": evaporation and transpiration, below 0; dew and frost, above
            - "rain": from rain as warm as the air
            - "conduction": from the layers beneath, below 0 where the ground gains heat
            - "melt": of snow and ice, below 0; water that freezes again, above

        Raises
        ------
        ThermorenderError
            The scene has no heat balance, or this renderer did not keep it.
        """
        state = self.scene.temperature_state
        if not isinstance(state.source, Balance):
            raise ThermorenderError(
                f"{self.scene.where}: heat_terms needs temperatures of the heat balance; give the scene [weather] and "
                "source = 'balance' in [temperature]"
            )
        if self._heat is None:
            raise ThermorenderError(
                "heat_terms needs what a run keeps for edits; make this renderer as Renderer(scene, edits=True), of a "
                "scene of fewer than 4 million texels"
            )
        return self._heat.terms(self.scene)

    def refuse_camera(self, positions: ArrayLike) -> None:
        """Raise for cameras at local positions (…, 3) outside the range of the air or above its clouds."""
        refuse_camera(self.scene, positions)

    def frame_of(
        self, radiance: NDArray[np.float32], pose: ArrayLike, plan: dict[str, Any], time_s: float = 0.0, index: int = 0,
        objects: Objects | None = None,
    ) -> Frame:  # fmt: skip
        """Return the Frame of a radiance image (H, W) made elsewhere for this view; `plan` is its record."""
        return self._frame(self._view(pose, time_s, objects), radiance, time_s, index, plan)

    def visible(
        self, pose: ArrayLike, camera: Camera | None = None, time_s: float = 0.0, objects: Objects | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return (image (H, W, 3) uint8 sRGB, valid (H, W) bool): the orthophoto seen from `pose`.

        The texture contains its own sun and shade; light is averaged linearly over a pixel's rays. Pixels without a
        surface or with unknown colour are not valid. `camera` replaces the scene's.
        """
        if camera is not None and not isinstance(camera, Camera):
            raise ThermorenderError(
                f"camera={shortened(repr(camera))} is not a Camera; give what load_camera returns, and a time as "
                "time_s=…"
            )
        pose, mi = checked_pose(pose), self._geometry.mi
        if self._coloured is None:
            # The geometry may come from another scene with the same surfaces but other colours.
            shapes = [(self._geometry, self.scene.surfaces)]
            shapes += [(Geometry(mi, one.surfaces), one.surfaces) for one in self.scene.tracked_objects]
            self._coloured = [(shape, _colours(shape, surfaces)) for shape, surfaces in shapes]
        nothing = Vacuum(mi, *np.zeros((2, 4)))
        found, _ = self._tracer(self._coloured, nothing, pose, time_s, objects, camera).image(_VISIBLE_EDGE)
        return bytes_from_linear(np.moveaxis(found[:3], 0, -1)), found[3] > 0.999

    def texels(
        self, pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None, static: bool = False
    ) -> NDArray[np.int64]:
        """Return the number of the terrain's texel at each pixel's middle, (H, W) int64; −1 elsewhere.

        Texels are counted row by row over the terrain's surfaces. With `static`, those of objects without a track
        follow, as in `hits` and `heat_terms`.
        """
        view = self._view(pose, time_s, objects)
        valid, number, *_ = truth.pixel_middles(self.baked.device.layers(view.pose, view.states), view.rays)
        count = int(self._geometry.texel_start[-1 if static else self.scene.terrain_count])
        return np.where(valid & (number < count), number.astype(np.int64), -1)

    def sky(
        self, pose: ArrayLike, camera: Camera | None = None, time_s: float = 0.0, objects: Objects | None = None
    ) -> NDArray[np.bool_]:
        """Return where a pixel's middle is above the horizon without a surface, (H, W); `camera` as of `visible`."""
        view = self._view(pose, time_s, objects)
        layers = self.baked.device.layers(view.pose, view.states)
        rays, horizon = self._camera_rays.of(camera or self.scene.camera), horizon_of(self.scene, view.pose)
        valid, _, up, *_ = truth.pixel_middles(layers, rays, horizon)
        return ~valid & up

    def depth(self, pose: ArrayLike, camera: Camera | None = None) -> NDArray[np.float32]:
        """Return the depth along the axis of the static scene at each pixel's middle, (H, W) [m]; infinite without a
        surface.

        `camera` as of `visible`.
        """
        at_rest = CasterView(self._geometry, opaque_view(self._geometry.mi, checked_pose(pose)))
        return np.asarray(
            truth.pixel_middles([at_rest], self._camera_rays.of(camera or self.scene.camera))[3], np.float32
        )

    def hits(self, origin: ArrayLike, direction: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return (distance [m], infinite for a miss; number of the texel, −1 for a miss) of rays into the static scene.

        Parameters
        ----------
        origin, direction : (N, 3) arrays
            Local positions [m], and directions of any length.
        """
        geometry, (hit, ray) = self._geometry, self._cast(origin, direction)
        place = geometry.map_position(geometry.record(hit.face, hit.valid), ray.o + hit.distance * ray.d)
        found = [dr.select(hit.valid, hit.distance, np.inf), geometry.nearest(hit.surface, *place, hit.valid)]
        dr.eval(found)
        distance, texel = (np.array(values) for values in found)
        return distance, np.where(np.isfinite(distance), texel.astype(np.int64), -1)

    def region(self, texel: int, alike: bool = False) -> NDArray[np.int64]:
        """Return the texels connected to one and of its material, such as one roof, ascending, (n,) as of `hits`.

        With `alike`, all texels of its surface that have its material and face up, or do not, as it does: all such
        roofs.

        Raises
        ------
        ThermorenderError
            The static scene has no such texel.
        """
        from thermorender.render.regions import region

        if not 0 <= texel < (count := int(self._geometry.texel_start[-1])):
            raise ThermorenderError(f"texel={texel} is not allowed; give one of 0 … {count - 1}, as `hits` returns")
        material = np.concatenate([surface.material.ravel() for surface in self.scene.surfaces])
        return region(self._geometry, material, texel, alike)

    def faces(self, origin: ArrayLike, direction: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return (distance [m], infinite for a miss; number of the face, −1 for a miss) of rays as of `hits`."""
        hit, _ = self._cast(origin, direction)
        distance, face = np.array(hit.distance), np.array(hit.face).astype(np.int64)
        return distance, np.where(np.isfinite(distance), face, -1)

    @property
    def face_maps(self) -> NDArray[np.float32]:
        """The affine maps from points to texels, (F, 2, 4): gradient and offset of the column, then of the row."""
        return np.array(self._geometry.records).reshape(-1, 2, 4)

    def _cast(self, origin: ArrayLike, direction: ArrayLike) -> tuple[Any, Any]:
        """The Hit of rays into the static scene, and the rays with directions of length 1."""
        mi = self._geometry.mi
        start, way = (np.asarray(given, np.float64).T for given in (origin, direction))
        way = way / np.linalg.norm(way, axis=0)
        ray = mi.Ray3f(mi.Point3f(*map(aligned, start)), mi.Vector3f(*map(aligned, way)))
        return self._geometry.cast(ray), ray

    def objects_seen(
        self, pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None
    ) -> tuple[NDArray[np.int64], list[str]]:
        """Return (number of the object at each pixel's middle, (H, W), −1 elsewhere; names of the objects)."""
        view = self._view(pose, time_s, objects)
        valid, number, *_ = truth.pixel_middles(self.baked.device.layers(view.pose, view.states), view.rays)
        return object_numbers(self.scene, valid, number).astype(np.int64) - 1, list(object_names(self.scene))

    def pictured(
        self, values: NDArray[np.float32], pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None
    ) -> NDArray[np.float32]:
        """Return the mean over each pixel of radiances given to all texels, (H, W) float32, without light or air.

        Parameters
        ----------
        values : (T,) array
            Of the texels of all surfaces, dynamic objects last [W m⁻² sr⁻¹].
        pose, time_s, objects
            As of `frame`. Sky and surroundings are those of `frame`, seen without air.
        """
        pose, mi = checked_pose(pose), self._geometry.mi
        shapes = [self._geometry, *(item.geometry for item in self.baked.device.objects)]
        ends = np.cumsum([shape.texel_start[-1] for shape in shapes])
        parts = np.split(np.asarray(values, np.float32), ends[:-1])
        leaving = [
            (shape, OutgoingRadiance(shape.averaged(part[:, None]))) for shape, part in zip(shapes, parts, strict=True)
        ]
        outside = np.array([self.scene.sky_temperature, self.scene.surroundings_temperature])
        outside = band_radiance(outside, *self.plan.band_um)
        tracer = self._tracer(leaving, Vacuum(mi, *outside[:, None]), pose, time_s, objects)
        return tracer.image(self.plan.sampling.edge_mk * self.plan.radiance_per_mk)[0][0]

    def rays(self, pose: ArrayLike) -> list[Sequence[Any]]:
        """Return the slopes of all rays that a frame from `pose` casts into the static scene, [(x/z, y/z), …]."""
        view = self._view(pose)
        return view.tracer().slopes(view.radiance()[1])

    def cast_only(self, pose: ArrayLike, rays: Sequence[Sequence[Any]]) -> None:
        """Cast rays from `rays` and do nothing else: a lower limit of the time of a frame."""
        mi = self._geometry.mi
        view = opaque_view(mi, checked_pose(pose))
        cast = self._geometry.caster.ray_intersect_preliminary
        dr.eval([cast(view_ray(mi, *view, *slope), coherent=True).t for slope in rays])
        dr.sync_thread()

    def _view(
        self, pose: ArrayLike, time_s: float = 0.0, objects: Objects | None = None, camera: Camera | None = None,
        lit_s: float | None = None, lit_objects: Objects | None = None,
    ) -> "View":  # fmt: skip
        placed, pose = object_states(self.scene, time_s, objects, lit_s, lit_objects), checked_pose(pose)
        self.refuse_camera(pose[:3, 3])
        return View(self.baked, self._camera_rays.of(camera or self.scene.camera), pose, placed)

    def _frame(
        self, view: "View", radiance: NDArray[np.float32], time_s: float, index: int, plan: dict[str, Any],
        sampling: SampledImage | None = None,
    ) -> Frame:  # fmt: skip
        return Frame(
            radiance=radiance, pose=view.scene_pose, time_s=float(time_s), index=whole_number("index", index),
            seed=self.seed,
            camera=self.scene.camera, plan=plan, time=self.scene.time,
            materials=tuple(material.name for material in self.scene.materials), objects=object_names(self.scene),
            device=active_device(), place=place_of(self.scene.frame, self.scene.grid), _view=view, _sampling=sampling,
        )  # fmt: skip

    def _tracer(
        self, leaving: Sequence[tuple[Geometry, OutgoingRadiance]], medium: Vacuum, pose: NDArray[np.float64],
        time_s: float, objects: Objects | None, camera: Camera | None = None,
    ) -> Tracer:  # fmt: skip
        """The Tracer of a view of other radiance than the baked one; dynamic objects follow the static scene."""
        placed, rays, mi = (
            object_states(self.scene, time_s, objects),
            self._camera_rays.of(camera or self.scene.camera),
            self._geometry.mi,
        )
        poses = [np.eye(4), *(state.pose for state in placed)]
        layers = [
            Layer(shape, opaque_view(mi, np.linalg.inv(own) @ pose), outgoing)
            for (shape, outgoing), own in zip(leaving, poses, strict=True)
        ]
        parts = parts_of(self.scene, self._geometry, [shape for shape, _ in leaving[1:]], placed)
        return Tracer(layers, rays, medium, self.plan, partial(slender.rectangles, parts, pose, rays.camera), pose)


class _CamerasRays:
    """The rays of the cameras that were used last."""

    def __init__(self, mi: Mitsuba) -> None:
        self._mi, self._kept = mi, dict[Camera, CameraRays]()

    def of(self, camera: Camera) -> CameraRays:
        """Return the rays of a camera; only the latest cameras are kept, as parts of an image change with each
        frame."""
        kept = self._kept
        rays = kept.get(camera) or CameraRays(self._mi, camera)
        others = [one for one in kept.items() if one[0] != camera]
        # Replaced as a whole: another thread may render another view meanwhile.
        self._kept = dict(others[1 - _RAYS_KEPT :]) | {camera: rays}
        return rays


def _colours(geometry: Geometry, surfaces: Sequence[Surface]) -> OutgoingRadiance:
    """OutgoingRadiance of the linear colour of the surfaces' texels, and 1 where it is known, else 0."""
    linear = linear_from_bytes(np.concatenate([surface.colour.reshape(-1, 3) for surface in surfaces]))
    flags = np.concatenate([surface.flags.ravel() for surface in surfaces])
    known = ((flags & FILLED) == 0).astype(np.float32)
    return OutgoingRadiance(geometry.averaged(np.column_stack([linear, known])))


def _solved(
    scene: Scene, like: "Renderer | None", geometry: Geometry, progress: Progress | None, edits: bool
) -> "tuple[Scene, SolvedHeat | None]":  # fmt: skip
    """(A scene with its temperatures solved, those of `like` where only the camera differs; what edits begin from)."""
    if like is not None and scene.changes(like._asked) <= {"camera"} and (like._heat is not None or not edits):
        known = like.scene.with_camera(scene.camera)
        # A conditional map's temperatures are solved again, as the scene's air is made for the camera's band.
        if known.temperature_state.solved:
            return known, like._heat
    assert scene.time is not None
    with interactive(progress) as report:
        records: list[Record] | None = [] if edits else None
        before = None if like is None or like._heat is None else like._heat.record
        solved = solved_at(scene, [scene.time], geometry, report, records, before)[0]
    if not records:
        return solved, None
    # Imported here, as other renderers do not need it.
    from thermorender.render.heat.edited import SolvedHeat

    return solved, SolvedHeat(solved, records[0])


def whole_number(name: str, value: int) -> int:
    """Return a seed or a frame's number as an int; raise unless the generator of the noise accepts it."""
    try:
        number = whole(value)
    except TypeError:
        number = -1
    if not 0 <= number < 2**64:
        raise ThermorenderError(f"{name}={shortened(repr(value))} is not allowed; give a whole number 0 … 2⁶⁴−1")
    return number
