"""What is scored: learned maps, pictures of other translators, and the simple methods that stand beside them.

Each method gives the apparent temperature of a view [K], or None where it has none to give. Some know what a map
cannot: they say so in `knows`, and are there to show how far an error can be brought down at all.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.campaign.dataset import Pair
from thermorender.campaign.map_inputs import NO_MATERIAL, inputs_of
from thermorender.compare.evaluation.sums import WIDTH, rows_by, summary
from thermorender.compare.machine import forget_peak_memory, peak_memory_mib
from thermorender.errors import ThermorenderError
from thermorender.footage.radiometric_files import read_temperature
from thermorender.formats import decoded
from thermorender.frame import apparent_temperature

PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")


@dataclass(frozen=True, eq=False)
class View:
    """A pair as it is scored.

    Attributes
    ----------
    pair : Pair
    card : dict
        Of its data set.
    band_um : (2,) tuple of float
    true : (H, W) float32
        Apparent temperature [K].
    known : (H, W) bool
        Where it is scored.
    sky : (H, W) bool
        Where the truth tells that there is sky.
    """

    pair: Pair
    card: dict
    band_um: tuple
    true: np.ndarray
    known: np.ndarray
    sky: np.ndarray


@dataclass
class LearnedMap:
    """A TemperatureMap as a method, with what its predictions cost.

    Attributes
    ----------
    label : str
    model : TemperatureMap
    oracle : bool
        Whether it is shown the material.
    seconds_per_mpixel : list of float
        Of each prediction.
    peak_mib : float or None
        Most memory the process held during one.
    covered : (5,) float64
        Where the map tells a standard deviation σ for each pixel: pixels, those with an error within σ and within 2 σ,
        Σσ² and Σ of squared errors [K²].
    unseen : (2, sums.WIDTH) float64
        Where the map tells colours never seen: sums of errors elsewhere, and of those pixels.
    """

    label: str
    model: Any
    oracle: bool = False
    seconds_per_mpixel: list = field(default_factory=list)
    peak_mib: float | None = None
    covered: np.ndarray = field(default_factory=lambda: np.zeros(5))
    unseen: np.ndarray = field(default_factory=lambda: np.zeros((2, WIDTH)))

    @property
    def kind(self):
        """ "oracle" or "map"."""
        return "oracle" if self.oracle else "map"

    @property
    def knows(self):
        """What it is shown beside the picture."""
        return "the material" if self.oracle else ", ".join(self.model.needs)

    def guess(self, view):
        """Return its apparent temperature, (H, W) float32 [K]."""
        inputs = inputs_of(view.pair, view.card, material=self.oracle)
        forget_peak_memory()
        began = time.perf_counter()
        radiance, spread = self.model.translated(inputs)
        self.seconds_per_mpixel.append((time.perf_counter() - began) / (radiance.size / 1e6))
        self.peak_mib = max(filter(None, (self.peak_mib, peak_memory_mib())), default=None)
        found = apparent_temperature(radiance, self.model.band_um)
        self._doubt(inputs, found[view.known].astype(np.float64) - view.true[view.known], spread, view.known)
        return found

    def _doubt(self, inputs, error, spread, known):
        """Hold what the map tells of its own errors against them."""
        if spread is not None:
            here = np.isfinite(error)
            off, told = np.abs(error[here]), spread[known][here]
            self.covered += off.size, (off <= told).sum(), (off <= 2.0 * told).sum(), (told**2).sum(), (off**2).sum()
        predictor = self.model.predictor
        if hasattr(predictor, "unseen"):
            self.unseen += rows_by(error, predictor.unseen(inputs)[known].astype(np.intp), 2)

    def doubt(self):
        """Return {"covered": …, "unseen": …}, each None where the map tells no such thing."""
        pixels, one, two, told, squares = map(float, self.covered)
        covered = None
        if pixels:
            covered = {"within_1": one / pixels, "within_2": two / pixels, "told_rms_k": np.sqrt(told / pixels),
                       "rmse_k": np.sqrt(squares / pixels)}  # fmt: skip
        unseen = None
        if self.unseen.any():
            rest, own = (summary(row) for row in self.unseen)
            share = own["pixels"] / max(own["pixels"] + rest["pixels"], 1)
            unseen = {"share": share, "mae_k": own["mae_k"], "elsewhere_k": rest["mae_k"]}
        return {"covered": covered, "unseen": unseen}

    def cost(self):
        """Return {seconds_per_mpixel, peak_memory_mib, training_s}: a median, the most, and what the file tells.

        With `doubt` beside them.
        """
        return {
            "seconds_per_mpixel": float(np.median(self.seconds_per_mpixel)) if self.seconds_per_mpixel else None,
            "peak_memory_mib": self.peak_mib,
            "training_s": self.model.about.get("training_s"), **self.doubt(),
        }  # fmt: skip


@dataclass
class Simple:
    """A method in one function of a View."""

    label: str
    kind: str
    knows: str
    guess: Any

    def cost(self):
        """Return nothing: it costs nothing worth telling."""
        return {}


def baselines(training):
    """Return the simple methods that stand beside every map, of a TrainingPart."""

    def constant(view):
        return None if training.mean_k is None else np.full(view.true.shape, training.mean_k)

    def own_mean(view):
        return np.full(view.true.shape, view.true[view.known].mean(dtype=np.float64) if view.known.any() else np.nan)

    def per_material(view):
        if "material" not in view.pair.truth or training.mean_k is None:
            return None
        # A material that the training part lacks, and what has none, gets the mean of all.
        kelvin = np.full(256, training.mean_k)
        for number, name in enumerate(view.card.get("materials", [])[:NO_MATERIAL]):
            kelvin[number] = training.material_k.get(name, training.mean_k)
        return kelvin[view.pair.truth["material"]]

    def air(view):
        kelvin = view.pair.entry.conditions.get("air_k")
        return None if kelvin is None else np.full(view.true.shape, kelvin)

    def balance(view):
        found = view.pair.truth.get("balance")
        return None if found is None else apparent_temperature(found, view.band_um)

    def floor(view):
        found = view.pair.truth.get("redrawn")
        if found is None:
            return None
        return view.true + (apparent_temperature(found, view.band_um) - view.true) / np.sqrt(2.0)

    return [
        Simple("constant: mean of the training part", "baseline", "", constant),
        Simple("the frame's own mean", "baseline", "the truth's mean", own_mean),
        Simple("mean per material", "baseline", "the material", per_material),
        Simple("air temperature", "baseline", "the weather", air),
        Simple("heat balance of tables", "baseline", "shape, material, weather", balance),
        Simple("floor: hidden state drawn anew, over √2", "floor", "all but the hidden state", floor),
    ]


class Foreign:
    """Pictures that another program made of the views, named by the pairs' keys.

    A TIFF that declares its unit is taken for what it says. Others carry no scale: their values are brought to kelvin
    by the affine fit that suits the truth of the scored pairs best in least squares, which flatters them.

    Parameters
    ----------
    name : str
    folder : path
    entries : sequence of Entry
        Of the pairs that are scored.

    Raises
    ------
    ThermorenderError
        A pair without a picture.
    """

    kind = "foreign"

    def __init__(self, name, folder, entries):
        self.name, self.folder = name, Path(folder)
        if not self.folder.is_dir():
            raise ThermorenderError(f"--foreign {name}={folder} is no folder; give one with a picture for each pair")
        found = {path.stem: path for path in sorted(self.folder.iterdir()) if path.suffix.lower() in PICTURES}
        missing = [entry.key for entry in entries if entry.key not in found]
        if missing:
            raise ThermorenderError(
                f"--foreign {name}={folder} has no picture of {len(missing)} of {len(entries)} pairs, the first "
                f"{missing[0]!r}; name each by its pair's key, such as {missing[0]}.png"
            )
        self.files = {entry.key: found[entry.key] for entry in entries}
        # As the first of them, so are all.
        self.scaled = bool(entries) and _declares(self.files[entries[0].key])
        self.fit = None if self.scaled else (0.0, np.nan)

    @property
    def label(self):
        """Its name, with what was done to it."""
        return self.name if self.scaled else f"{self.name} after its best affine fit"

    @property
    def knows(self):
        """What it was allowed to know."""
        return "" if self.scaled else "the truth, by two numbers"

    def cost(self):
        """Return nothing: pictures do not tell what they cost."""
        return {}

    def guess(self, view):
        """Return its apparent temperature, (H, W) float64 [K]."""
        values = self.values(view)
        return values if self.scaled else self.fit[0] * values + self.fit[1]

    def values(self, view):
        """Return a picture's values, (H, W) float64; kelvin where it declares them."""
        import cv2

        path = self.files[view.pair.entry.key]
        if self.scaled:
            image = read_temperature(path)
        else:
            image = decoded(path.read_bytes(), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        if image is not None and image.ndim == 3 and (image[..., :3] == image[..., :1]).all():
            image = image[..., 0]
        if image is None or image.shape != view.true.shape:
            height, width = view.true.shape
            raise ThermorenderError(
                f"{path} is no grey picture of {width}×{height} pixels, as its pair is; write it anew at that size, "
                "without a palette"
            )
        return image.astype(np.float64)

    def fitted(self, views):
        """Find the affine fit over Views, where one is needed; return self.

        Raises
        ------
        ThermorenderError
            All values are the same.
        """
        if self.scaled:
            return self
        # Σ 1, x, y, x², xy from the first values on, so that squares stay small.
        moments, origin = np.zeros(5), None
        for view in views:
            x, y = self.values(view)[view.known], view.true[view.known].astype(np.float64)
            if origin is None and x.size:
                origin = float(x[0]), float(y[0])
            if x.size:
                x, y = x - origin[0], y - origin[1]
                moments += x.size, x.sum(), y.sum(), (x * x).sum(), (x * y).sum()
        count, x, y, xx, xy = moments
        spread = count * xx - x * x
        if spread <= 0.0:
            raise ThermorenderError(
                f"--foreign {self.name}={self.folder}: all values are the same, so that no scale can be fitted; give "
                "translated pictures"
            )
        slope = (count * xy - x * y) / spread
        self.fit = slope, (y - slope * x) / count + origin[1] - slope * origin[0]
        return self


def _declares(path):
    """Whether a picture is a TIFF that tells its unit."""
    try:
        return path.suffix.lower() in (".tif", ".tiff") and read_temperature(path) is not None
    except ThermorenderError:
        return False
