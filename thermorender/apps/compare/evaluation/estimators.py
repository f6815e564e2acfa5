"""The scored methods: learned maps, pictures of other programs, and simple baselines.

Each method returns the apparent temperature of a view [K], or None where it has none. Some baselines know more than a
map can (see `knows`): they show how small the error can become.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.evaluation.sums import WIDTH, rows_by, summary
from thermorender.apps.compare.evaluation.training_part import TrainingPart
from thermorender.apps.compare.machine import forget_peak_memory, peak_memory_mib
from thermorender.apps.training.dataset import Entry, Pair
from thermorender.apps.training.map_inputs import NO_MATERIAL, inputs_of
from thermorender.errors import ThermorenderError
from thermorender.formats import decoded
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs, TemperatureMap
from thermorender.sensor.radiometric_files import read_temperature

Image = NDArray[np.floating]
PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")


@dataclass(frozen=True, eq=False)
class View:
    """A pair with its true temperature and the pixels that are scored."""

    pair: Pair
    card: dict[str, Any]  # Card of its data set
    band_um: tuple[float, float]  # (2,) tuple
    true: NDArray[np.float32]  # (H, W) float32 true apparent temperature [K]
    known: NDArray[np.bool_]  # (H, W) bool pixels that are scored
    sky: NDArray[np.bool_]  # (H, W) bool pixels of the sky according to the truth


@dataclass
class Spent:
    """The cost of a map's predictions, and how far it knows its own errors."""

    seconds_per_mpixel: list[float] = field(default_factory=list)  # Run time of each prediction
    peak_mib: float | None = None  # Peak memory of the process during a prediction
    # (5,) float64 for maps that predict a standard deviation σ for each pixel: number of pixels, of errors within σ
    # and within 2 σ, Σσ² and Σ of squared errors [K²]
    covered: NDArray[np.float64] = field(default_factory=lambda: np.zeros(5))
    # (2, sums.WIDTH) float64 for maps that flag colours absent from training: sums of errors of the other and of the
    # flagged pixels
    unseen: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, WIDTH)))

    def add(self, more: "Spent") -> None:
        """Add that of other predictions."""
        self.seconds_per_mpixel += more.seconds_per_mpixel
        self.peak_mib = max(filter(None, (self.peak_mib, more.peak_mib)), default=None)
        self.covered += more.covered
        self.unseen += more.unseen


@dataclass
class LearnedMap:
    """A TemperatureMap as a method."""

    label: str
    model: TemperatureMap
    privileged: bool = False  # Whether it takes the material as input
    spent: Spent = field(default_factory=Spent)  # Of the last prediction

    @property
    def kind(self) -> str:
        """What the report calls it: "privileged" or "map"."""
        return "privileged" if self.privileged else "map"

    @property
    def knows(self) -> str:
        """Its inputs beside the picture."""
        return "the material" if self.privileged else ", ".join(self.model.needs)

    def guess(self, view: View) -> NDArray[np.float32]:
        """Return its apparent temperature, (H, W) float32 [K]."""
        inputs = inputs_of(view.pair, view.card, material=self.privileged)
        forget_peak_memory()
        began = time.perf_counter()
        radiance, spread = self.model.translated(inputs)
        self.spent = Spent([(time.perf_counter() - began) / (radiance.size / 1e6)], peak_memory_mib())
        seen: NDArray[np.float32] = apparent_temperature(radiance, self.model.band_um)
        self._doubt(inputs, seen[view.known].astype(np.float64) - view.true[view.known], spread, view.known)
        return seen

    def _doubt(
        self, inputs: Inputs, error: NDArray[np.float64], spread: Image | None, known: NDArray[np.bool_]
    ) -> None:
        """Compare the map's predicted standard deviations and flags with its errors."""
        if spread is not None:
            here = np.isfinite(error)
            off, sigma = np.abs(error[here]), spread[known][here]
            self.spent.covered += [off.size, (off <= sigma).sum(), (off <= 2.0 * sigma).sum(), (sigma**2).sum(),
                                   (off**2).sum()]  # fmt: skip
        predictor = self.model.predictor
        if hasattr(predictor, "unseen"):
            self.spent.unseen += rows_by(error, predictor.unseen(inputs)[known].astype(np.intp), 2)

    def cost(self, spent: Spent) -> dict[str, Any]:
        """Return {seconds_per_mpixel (median), peak_memory_mib, training_s (from its file)}, and `_doubts`."""
        seconds = spent.seconds_per_mpixel
        return {
            "seconds_per_mpixel": float(np.median(seconds)) if seconds else None,
            "peak_memory_mib": spent.peak_mib,
            "training_s": self.model.about.get("training_s"), **_doubts(spent),
        }  # fmt: skip


def _doubts(spent: Spent) -> dict[str, Any]:
    """Return {"covered": …, "unseen": …}, each None where the map does not predict it."""
    pixels, one, two, variances, squares = map(float, spent.covered)
    covered = None
    if pixels:
        covered = {
            "within_1": one / pixels, "within_2": two / pixels,
            "predicted_rms_k": np.sqrt(variances / pixels), "rmse_k": np.sqrt(squares / pixels),
        }  # fmt: skip
    unseen = None
    if spent.unseen.any():
        rest, own = (summary(row) for row in spent.unseen)
        share = own["pixels"] / max(own["pixels"] + rest["pixels"], 1)
        unseen = {"share": share, "mae_k": own["mae_k"], "elsewhere_k": rest["mae_k"]}
    return {"covered": covered, "unseen": unseen}


@dataclass
class Simple:
    """A method given by one function of a View."""

    label: str
    kind: str
    knows: str
    guess: Callable[[View], Image | None]

    def cost(self, spent: Spent) -> dict[str, Any]:
        """Return nothing: its cost is negligible."""
        return {}


def baselines(training: TrainingPart) -> list[Simple]:
    """Return the baselines that every map is compared with, from a TrainingPart."""

    def constant(view: View) -> Image | None:
        return None if training.mean_k is None else np.full(view.true.shape, training.mean_k)

    def own_mean(view: View) -> Image:
        return np.full(view.true.shape, view.true[view.known].mean(dtype=np.float64) if view.known.any() else np.nan)

    def per_material(view: View) -> Image | None:
        if "material" not in view.pair.truth or training.mean_k is None:
            return None
        # Pixels without a material, or of one that the training part lacks, get the mean of all.
        kelvin: NDArray[np.float64] = np.full(256, training.mean_k)
        for number, name in enumerate(view.card.get("materials", [])[:NO_MATERIAL]):
            kelvin[number] = training.material_k.get(name, training.mean_k)
        return kelvin[view.pair.truth["material"]]

    def air(view: View) -> Image | None:
        kelvin = view.pair.entry.conditions.get("air_k")
        return None if kelvin is None else np.full(view.true.shape, kelvin)

    def balance(view: View) -> Image | None:
        radiance = view.pair.truth.get("balance")
        return None if radiance is None else apparent_temperature(radiance, view.band_um)

    def floor(view: View) -> Image | None:
        radiance = view.pair.truth.get("redrawn")
        if radiance is None:
            return None
        return view.true + (apparent_temperature(radiance, view.band_um) - view.true) / np.sqrt(2.0)

    return [
        Simple("constant: mean of the training part", "baseline", "", constant),
        Simple("the frame's own mean", "baseline", "the truth's mean", own_mean),
        Simple("mean per material", "baseline", "the material", per_material),
        Simple("air temperature", "baseline", "the weather", air),
        Simple("heat balance of tables", "baseline", "shape, material, weather", balance),
        Simple("floor: hidden state redrawn, over √2", "floor", "all but the hidden state", floor),
    ]


class Foreign:
    """Pictures that another program made of the views, named by the pairs' keys.

    A TIFF that declares its unit is used as it is. Other pictures have no scale: the affine fit that minimises their
    squared error against the truth of the scored pairs converts them to kelvin, which favours them.

    Parameters
    ----------
    name : str
    folder : path
    entries : sequence of Entry
        Entries of the scored pairs.

    Raises
    ------
    ThermorenderError
        A pair without a picture.
    """

    kind = "foreign"

    def __init__(self, name: str, folder: str | PathLike[str], entries: Sequence[Entry]) -> None:
        self.name, self.folder = name, Path(folder)
        if not self.folder.is_dir():
            raise ThermorenderError(
                f"--foreign {name}={folder} is not a folder; give a folder with a picture for each pair"
            )
        pictures = {
            path.stem: path.absolute() for path in sorted(self.folder.iterdir()) if path.suffix.lower() in PICTURES
        }
        missing = [entry.key for entry in entries if entry.key not in pictures]
        if missing:
            raise ThermorenderError(
                f"--foreign {name}={folder} has no picture of {len(missing)} of {len(entries)} pairs, the first "
                f"{missing[0]!r}; name each picture by its pair's key, such as {missing[0]}.png"
            )
        self.files = {entry.key: pictures[entry.key] for entry in entries}
        # The first picture decides for all.
        self.scaled = bool(entries) and _declares(self.files[entries[0].key])
        self.fit = (1.0, 0.0) if self.scaled else (0.0, np.nan)

    @property
    def label(self) -> str:
        """Its name, and whether it was fitted."""
        return self.name if self.scaled else f"{self.name} after its best affine fit"

    @property
    def knows(self) -> str:
        """Its knowledge of the truth."""
        return "" if self.scaled else "the truth, by two numbers"

    def cost(self, spent: Spent) -> dict[str, Any]:
        """Return nothing: the cost of pictures is unknown."""
        return {}

    def guess(self, view: View) -> NDArray[np.float64]:
        """Return its apparent temperature, (H, W) float64 [K]."""
        values = self.values(view)
        return values if self.scaled else self.fit[0] * values + self.fit[1]

    def values(self, view: View) -> NDArray[np.float64]:
        """Return a picture's values, (H, W) float64; kelvin where the picture declares its unit."""
        import cv2

        path = self.files[view.pair.entry.key]
        image: NDArray[Any] | None
        if self.scaled:
            image = read_temperature(path)
        else:
            image = decoded(path.read_bytes(), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        if image is not None and image.ndim == 3 and (image[..., :3] == image[..., :1]).all():
            image = image[..., 0]
        if image is None or image.shape != view.true.shape:
            height, width = view.true.shape
            raise ThermorenderError(
                f"{path} is not a grey picture of {width}×{height} pixels, the size of its pair; write it again at "
                "that size and without a palette"
            )
        return image.astype(np.float64)

    def fitted(self, views: Iterable[View]) -> "Foreign":
        """Find the affine fit over Views, where one is needed; return self."""
        if self.scaled:
            return self
        # Σ 1, x, y, x², xy relative to the first values, so that squares stay small.
        moments, origin = np.zeros(5), (0.0, 0.0)
        for view in views:
            x, y = self.values(view)[view.known], view.true[view.known].astype(np.float64)
            if not moments[0] and x.size:
                origin = float(x[0]), float(y[0])
            if x.size:
                x, y = x - origin[0], y - origin[1]
                moments += [x.size, x.sum(), y.sum(), (x * x).sum(), (x * y).sum()]
        count, sum_x, sum_y, xx, xy = moments
        spread = count * xx - sum_x * sum_x
        if spread <= 0.0:
            raise ThermorenderError(
                f"--foreign {self.name}={self.folder}: all values are the same, so no scale can be fitted; give "
                "translated pictures"
            )
        slope = (count * xy - sum_x * sum_y) / spread
        self.fit = slope, (sum_y - slope * sum_x) / count + origin[1] - slope * origin[0]
        return self


def _declares(path: Path) -> bool:
    """Return whether a picture is a TIFF that declares its unit."""
    try:
        return path.suffix.lower() in (".tif", ".tiff") and read_temperature(path) is not None
    except ThermorenderError:
        return False
