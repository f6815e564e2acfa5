"""What methods see and are scored on: a pose of a scene, or a pair of a data set, with its reference."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.training.dataset import Dataset, Pair, ThermalScale
from thermorender.apps.training.map_inputs import NO_MATERIAL, ground_of
from thermorender.frame import apparent_temperature
from thermorender.output.photograph import photograph
from thermorender.render.renderer import Renderer
from thermorender.scene.scene import Scene
from thermorender.scene.surface import FALLBACK, FILLED, SURFACE
from thermorender.trajectory import Trajectory

Image = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class View:
    """A picture with its reference."""

    index: int
    band_um: tuple[float, float]
    visible: NDArray[np.uint8]  # (H, W, 3) uint8 photograph registered to the thermal camera
    texel_m: float | None  # Median ground sampling distance [m]; None where no ground is visible
    known: NDArray[np.bool_]  # (H, W) pixels that are scored: surfaces of known colour and temperature
    truth: NDArray[np.float32] | None  # (H, W) apparent temperature of the reference [K]; None if unknown
    object: NDArray[np.integer]  # (H, W) number of the visible object, −1 for ground and sky
    material: NDArray[np.uint8]  # (H, W) number in `material_names`, 255 for none
    material_names: tuple[str, ...]
    # Of a pose: (H, W) band radiance of the reference [W m⁻² sr⁻¹], time [s], world_from_camera (4, 4), depth along the
    # optical axis (H, W) [m], infinite without a surface, and position of the surface in the world (H, W, 3) [m]
    truth_radiance: NDArray[np.float32] | None = None
    time_s: float = 0.0
    pose: NDArray[np.float64] | None = None
    depth: NDArray[np.float32] | None = None
    position: NDArray[np.float32] | None = None
    # Of a pair: its planes and labels, the card of its data set, and pixels of the sky (H, W), which are not scored
    pair: Pair | None = None
    card: dict[str, Any] | None = None
    sky: NDArray[np.bool_] | None = None

    @property
    def ground(self) -> NDArray[np.bool_]:
        """Pixels of known ground, (H, W)."""
        return self.known & (self.object < 0)


@dataclass(frozen=True)
class Flight:
    """A scene and the poses from which it is seen."""

    scene: Scene
    times: NDArray[np.float64]  # (P,) [s]
    poses: NDArray[np.float64]  # (P, 4, 4) world_from_camera

    @classmethod
    def of(
        cls,
        scene: Scene,
        trajectory: Trajectory,
        rate_hz: float = 1.0,
        start_s: float | None = None,
        stop_s: float | None = None,
    ) -> "Flight":
        """Return the Flight of a Trajectory, or of a part of it [s], with `rate_hz` poses per second."""
        times = trajectory.frame_times(rate_hz, start_s, stop_s)
        return cls(scene, times, trajectory.sampled(times).poses())


def view_of(renderer: Renderer, pose: ArrayLike, time_s: float, index: int, has_truth: bool) -> View:
    """Return the View of a pose; `has_truth` says whether the renderer's temperatures are the true ones."""
    frame = renderer.frame(pose, time_s, index)
    visible, covered = photograph(renderer, frame.pose, time_s)
    images: dict[str, Any] = frame.truth
    camera = renderer.scene.camera
    flags = images["mask"]
    known = covered & ((flags & SURFACE) > 0) & ((flags & FILLED) == 0)
    if has_truth:
        known &= (flags & FALLBACK) == 0
    near = images["depth"][known]
    texel_m = float(np.median(near) / camera.focal_length_px) if near.size else None
    radiance = frame.radiance if has_truth else None
    return View(
        index, camera.band_um, visible, texel_m, known,
        None if radiance is None else apparent_temperature(radiance, camera.band_um),
        renderer.objects_seen(pose, time_s)[0], images["material"],
        tuple(each.name for each in renderer.scene.materials), radiance, float(time_s), frame.pose, images["depth"],
        images["position"],
    )  # fmt: skip


class Levels:
    """Look-up tables of radiance and apparent temperature for the integer values of thermal pictures of a scale."""

    def __init__(self, scale: ThermalScale) -> None:
        self.scale = scale
        self._tables: dict[Any, tuple[NDArray[np.float64], NDArray[np.float32]]] = {}

    def _table(self, values: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        kind = values.dtype
        if kind not in self._tables:
            radiance = self.scale.radiance(np.arange(np.iinfo(kind).max + 1))
            self._tables[kind] = radiance, apparent_temperature(radiance, self.scale.band_um)
        return self._tables[kind]

    def radiance(self, values: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return band radiance [W m⁻² sr⁻¹], float64."""
        return self._table(values)[0][values]

    def temperature(self, values: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return apparent temperature [K], float32."""
        return self._table(values)[1][values]


class PairViews:
    """The Views of the pairs of a Dataset, read one by one."""

    def __init__(self, dataset: Dataset, levels: Levels) -> None:
        # Workers of a cluster have folders of their own.
        self.dataset = Dataset(dataset.folder.absolute(), dataset.card, dataset.entries, dataset.scale)
        self.levels = levels

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, number: int) -> View:
        pair = self.dataset.pair(self.dataset.entries[number])
        band, card = self.dataset.scale.band_um, self.dataset.card
        if "radiance" in pair.truth:
            true = apparent_temperature(pair.truth["radiance"], band)
        else:
            true = self.levels.temperature(pair.thermal)
        known, ground = pair.valid & np.isfinite(true), ground_of(pair)
        material = pair.truth.get("material", np.full(known.shape, NO_MATERIAL, np.uint8))
        return View(
            number, band, pair.visible, pair.entry.texel_m, known & ground, true, np.full(known.shape, -1, np.int8),
            material, tuple(card.get("materials", [])[:NO_MATERIAL]), pair=pair, card=card, sky=known & ~ground,
        )  # fmt: skip

    def __iter__(self) -> Iterator[View]:
        return (self[number] for number in range(len(self)))


def evenly(count: int, most: int) -> list[int]:
    """Return up to `most` different numbers of 0…count − 1, evenly spaced, with the first and the last."""
    numbers: list[int] = np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()
    return list(dict.fromkeys(numbers))
