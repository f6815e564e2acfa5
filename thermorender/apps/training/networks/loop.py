"""The training loop of all networks: an epoch is as many crops as there are training pictures.

All random numbers depend on the seed and the step only, so a resumed training gives the same result with the same
number of threads. A diverging training is stopped and returns its best state. `runs` describes the run's folder.
"""

import json
import math
import os
import resource
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from thermorender import files, formats
from thermorender.apps.training.linear_training import fit_linear
from thermorender.apps.training.networks import checkpoint, runs
from thermorender.apps.training.networks.coarse import coarse
from thermorender.apps.training.networks.crops import Crop, Crops, measured
from thermorender.apps.training.networks.learners import Batch, Learner, Scaled, learner_of
from thermorender.apps.training.networks.perception import Perception
from thermorender.apps.training.task import Example, Task
from thermorender.errors import ThermorenderError
from thermorender.learned.linear import Linear
from thermorender.learned.networks.building import net_of, predicted
from thermorender.learned.networks.encoding import Encoding
from thermorender.learned.networks.predictor import MOST_WIDTH, Network, device, state_of
from thermorender.learned.networks.recipes import Recipe, recipe_of

# A greater loss means that the training has exploded; the greatest learning rate.
_EXPLODED, _MOST_RATE = 1e6, 1e3
_MOST_SIDE = 4096
# Share of the training in which the "cosine" schedule rises.
_WARMING = 0.1
# Number of seeds in PyTorch.
_SEEDS = 1 << 63
# Base width below which oneDNN is not used.
_NARROW = 16
# Penalty of a network's linear base, that of `correlation+`.
_BASE_PENALTY = 1e-3
# Validation crops in sample pictures, and in a batch.
_SHOWN = 4
_AT_ONCE = 4
# Validation crops that say how coarse the file's weights may be.
_LOOKED_AT = 32


def train_network(task: Task, method: str) -> Network:
    """Return the Network trained on a Task.

    Options: `width`; `batch`; `crops`, their total number; `side` of the crops [pixels]; `rate`, the learning rate;
    `every`, crops between validations (0: as many as there are training pictures); `bf16`, compute convolutions in
    bfloat16 if the machine can; `tensorboard`, also log for it; `depth`, take depth as input; `published`, see
    `Network`; `jitter`, side that a crop is enlarged to before a square is cut from it (that of the crop: not at all)
    [pixels]; `vgg`, file of the perceptual loss's weights; `architecture` of `unet`, see `recipes`; `tolerance_mk`,
    mean change of the output on validation crops that coarser weights in the file may cause (0: half precision) [mK].
    """
    options = task.options
    recipe = recipe_of(method, options.get("architecture"))
    _refuse(method, recipe, options)
    first, world = _process()
    with ExitStack() as stack:
        folder = files.make_folder(Path(task.run or stack.enter_context(tempfile.TemporaryDirectory())))
        # The best state may be taken while another process trains on.
        if first and not task.best:
            stack.enter_context(files.in_use(folder))
        above_air = recipe.plus and "air_k" in task.examples[0].inputs.conditions
        side = int(options.get("side", recipe.side))
        crops = Crops(task, side, above_air, int(options.get("jitter", side)))
        began = time.perf_counter(), _core_seconds()
        base = _base(task, crops) if above_air else None
        encoding = measured(crops, bool(options.get("depth")), recipe.target, base)
        torch.manual_seed(task.seed % _SEEDS)
        learner = learner_of(recipe, encoding, int(options["width"]), float(options["rate"]))
        if options.get("vgg"):
            assert isinstance(learner, Scaled)
            learner.perceived = Perception(options["vgg"]).to(device())
        run = _Run(task, method, recipe, crops, encoding, learner, folder, first, world)
        # The linear base and the encoding count as training time.
        run.seconds, run.core_seconds = time.perf_counter() - began[0], _core_seconds() - began[1]
        try:
            if task.best:
                run.take()
            else:
                run.train()
        finally:
            crops.close()
        return run.found()


def _refuse(method: str, recipe: Recipe, options: dict[str, Any]) -> None:
    """Raise ThermorenderError for invalid options, before anything is written."""
    size, total, width, rate = options["batch"], options["crops"], options["width"], options["rate"]
    if size < recipe.least_batch or total < size:
        raise ThermorenderError(
            f"batch={size} of crops={total} is not allowed for {method!r}; give a batch of {recipe.least_batch} or "
            "more, and at least as many crops"
        )
    if not 1 <= width <= MOST_WIDTH:
        raise ThermorenderError(f"width={width} is not allowed for {method!r}; give 1…{MOST_WIDTH} channels")
    side = options.get("side", recipe.side)
    if not recipe.whole and side != recipe.side:
        raise ThermorenderError(f"side={side} is not allowed for {recipe.net!r}; give side={recipe.side}")
    if not 0 < side <= _MOST_SIDE or side % recipe.multiple:
        raise ThermorenderError(
            f"side={side} is not allowed for {method!r}; give a multiple of {recipe.multiple} up to {_MOST_SIDE} pixels"
        )
    jitter = options.get("jitter", side)
    if not side <= jitter <= _MOST_SIDE:
        raise ThermorenderError(
            f"jitter={jitter} is not allowed for {method!r}; give {side} (no jitter) to {_MOST_SIDE} pixels"
        )
    if not 0.0 <= options["tolerance_mk"] < math.inf:
        raise ThermorenderError(
            f"tolerance_mk={options['tolerance_mk']:g} is not allowed for {method!r}; give a number of 0 or more"
        )
    if not 0.0 < rate <= _MOST_RATE:
        raise ThermorenderError(f"rate={rate:g} is not allowed for {method!r}; give a number in 0…{_MOST_RATE:g}")


def _base(task: Task, crops: Crops) -> Linear:
    """Linear base of a network, trained on the training pictures."""
    chosen = _Chosen(task.examples, crops.train)
    return fit_linear(replace(task, examples=chosen, options={"penalty": _BASE_PENALTY}, held_out=None))


class _Chosen(Sequence[Example]):
    """Some of the examples of a task, by their numbers."""

    def __init__(self, examples: Sequence[Example], numbers: np.ndarray) -> None:
        self._examples, self._numbers = examples, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, number: Any) -> Any:
        return self._examples[int(self._numbers[number])]


class _Run:
    """A training in progress."""

    def __init__(
        self, task: Task, method: str, recipe: Recipe, crops: Crops, encoding: Encoding, learner: Learner, folder: Path,
        first: bool, world: int,
    ) -> None:  # fmt: skip
        self.task, self.method, self.recipe, self.crops, self.encoding = task, method, recipe, crops, encoding
        self.learner, self.folder, self.first, self.world = learner, folder, first, world
        options = task.options
        self.total, self.size = int(options["crops"]), int(options["batch"])
        self.every = int(options["every"]) or len(crops.train)
        self.half = bool(
            options["bf16"] and (device() == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported())
        )  # fmt: skip
        self.done, self.seconds, self.core_seconds, self.best = 0, 0.0, 0.0, math.inf
        self.stopped: str | None = None
        for part in learner.parts.values():
            part.to(device(), memory_format=torch.channels_last)  # type: ignore[call-overload]  # of PyTorch's stubs
        self.rates = [group["lr"] for each in learner.optimisers.values() for group in each.param_groups]
        self.validated = crops.validation()
        if not any(crop.valid.any() for crop in self.validated):
            raise ThermorenderError(
                f"none of {len(crops.held)} validation pairs has a valid pixel, so networks cannot be compared; give "
                "pairs whose pictures overlap"
            )
        self.kelvin = _Kelvin(task, crops, encoding)
        self.board = _board(folder) if options["tensorboard"] and first else None

    def train(self) -> None:
        """Train to the end, or until the losses explode."""
        self._begin()
        losses: dict[str, list[float]] = {}
        began: tuple[float, float] | None = None
        while self.done < self.total and not self.stopped:
            if began is None:
                began = time.perf_counter(), _core_seconds()
            found = self._step()
            self.done += self.size * self.world
            for name, value in found.items():
                losses.setdefault(name, []).append(value)
            self._report(found)
            if not all(math.isfinite(value) and abs(value) < _EXPLODED for value in found.values()):
                self._stop(found)
            elif self.done % self.every < self.size * self.world or self.done >= self.total:
                self.seconds += time.perf_counter() - began[0]
                self.core_seconds += self.world * _agreed(_core_seconds() - began[1])
                if self.first:
                    self._end_of_epoch({name: float(np.mean(values)) for name, values in losses.items()})
                if _agreed(float(bool(self.stopped))) and not self.stopped:
                    self.stopped = "training exploded"
                losses, began = {}, None

    def take(self) -> None:
        """Take over what a training has reached, and leave its folder as it is."""
        runs.check(self.folder, {name: value for name, value in self._settings().items() if name != "world"})
        last = self.folder / runs.LAST
        if not (last.exists() and (self.folder / runs.BEST).exists()):
            raise ThermorenderError(
                f"{self.folder} has no validated state yet; train on to the first validation, or start again with a "
                "smaller --set every"
            )
        self._take(last)

    def _take(self, last: Path) -> None:
        """Read the state of the last validation."""
        facts = checkpoint.load(last, *self._state())
        self.done, self.best = facts["crops"], facts["best"]
        self.seconds, self.core_seconds = facts["seconds"], facts["core_seconds"]

    def found(self) -> Network:
        """Return the Network of the best state, or of the last epoch with the option `published`."""
        best, published = self.folder / runs.BEST, bool(self.task.options.get("published"))
        if not best.exists():
            raise ThermorenderError(f"{self.method}: {self.stopped}; take a smaller --set rate")
        if published:
            facts, net = checkpoint.load(self.folder / runs.LAST, *self._state()), self.learner.applied
        else:
            net = net_of(self.recipe, self.encoding, int(self.task.options["width"]))
            facts = checkpoint.load(best, {"net": net})
        curve = [{name: line[name] for name in ("crops", "seconds", "core_seconds", "validation_mae_k")}
                 for line in runs.read_log(self.folder)]  # fmt: skip
        trained = {
            "crops": self.done, "best_crops": facts["crops"], "published_crops": self.recipe.published_crops,
            "published_steps": self.recipe.published_steps,
            "seconds": self.seconds, "core_seconds": self.core_seconds, "threads": torch.get_num_threads(),
            "device": device(), "bf16": self.half, "torch": str(torch.__version__),
            "stopped": self.stopped, "curve": curve,
        }  # fmt: skip
        found = Network(
            self.method, int(self.task.options["width"]), self.encoding, self.task.texel_range_m,
            state_of(net), self.crops.above_air, published, trained, self.recipe.net,
        )  # fmt: skip
        if self.task.options["tolerance_mk"]:
            found = self._coarse(found)
        trained["kept_mk"] = self._cost_of_keeping(net.to(device()), found)
        return found

    def _coarse(self, network: Network) -> Network:
        """The Network with the steps that the file keeps its weights in."""
        some = self.validated[:: -(-len(self.validated) // _LOOKED_AT)]
        planes = [self._encoded(some[start : start + _AT_ONCE]).planes for start in range(0, len(some), _AT_ONCE)]
        kelvin = network.encoding.scale * self.kelvin.per_unit
        return coarse(network, planes, 1e-3 * self.task.options["tolerance_mk"] / kelvin)

    def _cost_of_keeping(self, net: nn.Module, network: Network) -> float:
        """Mean absolute change of the validation crops by how the file keeps a network's weights [mK]."""
        kept = Network.of(network.header(), network.arrays()).net
        changes = [
            np.abs(before - after)[crop.valid]
            for (crop, _, before), (_, _, after) in zip(self._guessed(net), self._guessed(kept), strict=True)
        ]
        return 1000.0 * float(np.concatenate(changes).mean())

    def _guessed(self, net: nn.Module, half: bool = False) -> Iterator[tuple[Crop, np.ndarray, np.ndarray]]:
        """Yield (crop, true, guessed) of each validation crop, (side, side) [K]."""
        net.eval()
        for start in range(0, len(self.validated), _AT_ONCE):
            some = self.validated[start : start + _AT_ONCE]
            batch = self._encoded(some)
            with torch.inference_mode(), torch.autocast(device(), torch.bfloat16, enabled=half):
                given = predicted(self.recipe, net, batch.planes)[:, 0].cpu().numpy()
            for crop, each in zip(some, given, strict=True):
                yield crop, *self.kelvin(crop, each)

    def _settings(self) -> dict[str, Any]:
        """The settings of the run, as its folder keeps them."""
        settings = {"method": self.method, "seed": self.task.seed, "options": self.task.options, "world": self.world,
                    "examples": [len(self.task.examples), self.crops.digest(self.validated)],
                    "encoding": self.encoding.header()}  # fmt: skip
        kept: dict[str, Any] = json.loads(json.dumps(settings))
        return kept

    def _begin(self) -> None:
        """Write the run's settings, or resume it."""
        if self.first:
            runs.begin(self.folder, self._settings(), self.task.resume)
        _agreed(0.0)
        last = self.folder / runs.LAST
        if last.exists():
            if not (self.folder / runs.BEST).exists():
                raise ThermorenderError(f"{self.folder} lacks {runs.BEST}, the best state so far; give another --run")
            self._take(last)
            if self.first:
                runs.cut_log(self.folder, self.done)

    def _state(self) -> tuple[dict[str, nn.Module], dict[str, torch.optim.Optimizer]]:
        """Networks and optimisers that a checkpoint holds, by name."""
        return self.learner.parts, self.learner.optimisers

    def _step(self) -> dict[str, float]:
        """Take a step of the learner; return {loss: value}."""
        self._set_rate()
        torch.manual_seed((self.task.seed * 1_000_003 + self.done) % _SEEDS)
        # Each process of a data-parallel training has its own crops.
        batch = self._encoded(self.crops.batch(self.done + self.size * _rank(), self.size))
        for part in self.learner.parts.values():
            part.train()
        onednn: Any = torch.backends.mkldnn
        before = onednn.enabled
        # On some CPUs, oneDNN's gradients of convolutions with few channels free memory twice (PyTorch 2.13).
        onednn.enabled = before and int(self.task.options["width"]) >= _NARROW
        try:
            with torch.autocast(device(), torch.bfloat16, enabled=self.half):
                return {name: _agreed(float(value.detach())) for name, value in self.learner.step(batch).items()}
        finally:
            onednn.enabled = before

    def _encoded(self, crops: Sequence[Crop]) -> Batch:
        """Crops as a Batch on the device."""
        encoding = self.encoding
        target = np.stack([(each.target - encoding.offset) / encoding.scale for each in crops])[:, None]
        if self.recipe.bounded:
            target = np.clip(target, -1.0, 1.0)
        known = np.stack([each.valid for each in crops])[:, None].astype(np.float32)
        planes, wanted, valid = (
            torch.from_numpy(each.astype(np.float32)).to(device())
            for each in (np.stack([encoding.planes(each.inputs) for each in crops]), target * known, known)
        )
        return Batch(planes.contiguous(memory_format=torch.channels_last), wanted, valid)

    def _set_rate(self) -> None:
        """Set the learning rate by the recipe's schedule."""
        share = self.done / self.total
        factor = {
            "constant": 1.0,
            "halfway": min(1.0, 2.0 * (1.0 - share)),
            "cosine": min(share / _WARMING, 1.0) * 0.5 * (1.0 + math.cos(math.pi * share)),
        }[self.recipe.schedule]
        groups = (group for each in self.learner.optimisers.values() for group in each.param_groups)
        for group, rate in zip(groups, self.rates, strict=True):
            group["lr"] = rate * factor

    def _end_of_epoch(self, losses: dict[str, float]) -> None:
        """Validate, and write the log, sample pictures and checkpoints."""
        found = list(self._guessed(self.learner.applied, self.half))
        # Only invalid pixels are left out, so that NaN in the output is noticed.
        off = [np.abs(guessed - true)[crop.valid] for crop, true, guessed in found]
        error = float(np.concatenate(off).mean(dtype=np.float64))
        facts = {"crops": self.done, "seconds": self.seconds, "core_seconds": self.core_seconds}
        shown = found[:: max(len(found) // _SHOWN, 1)][:_SHOWN]
        runs.write_samples(files.make_folder(self.folder / runs.SAMPLES) / f"{self.done:09d}.png", shown)
        if not math.isfinite(error):
            self._stop({"validation": error})
            return
        if error < self.best:
            self.best = error
            checkpoint.save(self.folder / runs.BEST, {"net": self.learner.applied}, facts | {"error_k": error})
        line = {**facts, "losses": losses, "validation_mae_k": error}
        formats.append_json(self.folder / runs.LOG, line)
        nets, optimisers = self._state()
        checkpoint.save(self.folder / runs.LAST, nets, facts | {"best": self.best}, optimisers)
        if self.board:
            for name, value in (*losses.items(), ("validation_mae_k", error)):
                self.board.add_scalar(name, value, self.done)

    def _report(self, losses: dict[str, float]) -> None:
        """Report progress and the losses of a step."""
        now = " ".join(f"{name} {value:.3g}" for name, value in losses.items())
        best = f", validation {self.best:.2f} K at best" if math.isfinite(self.best) else ""
        line = f"{self.method}: {self.done} of {self.total} crops, {now}{best}"
        self.task.progress(line, min(self.done / self.total, 1.0))

    def _stop(self, losses: dict[str, float]) -> None:
        """Stop because of these losses."""
        what = ", ".join(f"{name} {value:.3g}" for name, value in losses.items())
        self.stopped = f"training exploded at crop {self.done} ({what})"


class _Kelvin:
    """Apparent temperatures of a crop and of a network's output for it [K]."""

    def __init__(self, task: Task, crops: Crops, encoding: Encoding) -> None:
        known = np.isfinite(task.temperature) & np.isfinite(task.intensity)
        order = np.argsort(task.intensity[known])
        self.intensity, self.temperature = task.intensity[known][order], task.temperature[known][order]
        self.above_air, self.encoding = crops.above_air, encoding
        # Approximate kelvin of one unit of the target.
        cold, warm = np.interp((0.0, 1.0), self.intensity, self.temperature)
        self.per_unit = 1.0 if self.above_air else float(warm - cold)

    def __call__(self, crop: Crop, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (true, found), (side, side) float64 each, NaN where the crop is not valid."""
        found = given.astype(np.float64) * self.encoding.scale + self.encoding.offset
        true = np.where(crop.valid, crop.target, np.nan)
        if self.above_air:
            air_k = crop.inputs.conditions["air_k"]
            return true + air_k, found + air_k
        return np.interp(true, self.intensity, self.temperature), np.interp(found, self.intensity, self.temperature)


def _core_seconds() -> float:
    """CPU time of this process, all threads [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _agreed(value: float) -> float:
    """Mean of a number over the processes of a data-parallel training; waits for all of them."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return value
    shared = torch.tensor(value, dtype=torch.float64, device=device())
    torch.distributed.all_reduce(shared)
    return float(shared) / torch.distributed.get_world_size()


def _process() -> tuple[bool, int]:
    """(whether this is the one process that writes, number of processes) of a data-parallel training."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world > 1 and not torch.distributed.is_initialized():
        torch.distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return _rank() == 0, world


def _rank() -> int:
    """Number of this process in a data-parallel training."""
    return int(os.environ.get("RANK", "0"))


def _board(folder: Path) -> Any:
    """Writer of a log for TensorBoard."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ThermorenderError(
            "option tensorboard=true needs the package tensorboard; install it with: pip install tensorboard"
        ) from None
    return SummaryWriter(str(folder / "tensorboard"))
