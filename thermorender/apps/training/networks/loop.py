"""The training loop of all networks.

    for each step of the recipe's crops:
        draw the next crops, encode them, take a step of the learner
        after every epoch: validate, write sample pictures, a line of the log and a checkpoint

An epoch is as many crops as there are training pictures. All random numbers depend on the seed and the step only, so a
resumed training gives the same result as an uninterrupted one with the same number of threads. A training that explodes
is stopped and returns its best state.

The run's folder holds `settings.json`, `log.jsonl`, `last.safetensors` (the state to resume from), `best.safetensors`
(the network with the least validation error) and `samples/`.
"""

import json
import math
import os
import resource
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from thermorender import files, formats
from thermorender.apps.training.networks import checkpoint, runs, samples
from thermorender.apps.training.networks.perception import Perception
from thermorender.errors import ThermorenderError
from thermorender.learned.linear import fit_linear
from thermorender.learned.networks.building import kind_of, learner_of, net_of
from thermorender.learned.networks.crops import Crops
from thermorender.learned.networks.encoding import Encoding
from thermorender.learned.networks.learners import Batch
from thermorender.learned.networks.predictor import MOST_WIDTH, Network, device, state_of
from thermorender.learned.networks.recipes import recipe_of
from thermorender.learned.training import Task
from thermorender.versions import versions

LAST, BEST = "last.safetensors", "best.safetensors"
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
        if first:
            stack.enter_context(files.in_use(folder))
        above_air = recipe.plus and "air_k" in task.examples[0].inputs.conditions
        side = int(options.get("side", recipe.side))
        crops = Crops(task, side, above_air, int(options.get("jitter", side)))
        began = time.perf_counter(), _core_seconds()
        target = (None, None) if recipe.target is None else recipe.target
        base = _base(task, crops) if above_air else None
        encoding = Encoding.measured(crops, bool(options.get("depth")), *target, base)
        torch.manual_seed(task.seed % _SEEDS)
        learner = learner_of(recipe, encoding, int(options["width"]), float(options["rate"]))
        if options.get("vgg"):
            learner.perceived = Perception(options["vgg"]).to(device())
        run = _Run(task, method, recipe, crops, encoding, learner, folder, first, world)
        # The linear base and the encoding count as training time.
        run.seconds, run.core_seconds = time.perf_counter() - began[0], _core_seconds() - began[1]
        try:
            run.train()
        finally:
            crops.close()
        return run.found()


def _refuse(method, recipe, options):
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


def _base(task, crops):
    """A network's linear base, trained on the training pictures."""
    chosen = _Chosen(task.examples, crops.train)
    return fit_linear(replace(task, examples=chosen, options={"penalty": _BASE_PENALTY}, held_out=None))


class _Chosen(Sequence):
    def __init__(self, examples, numbers):
        self._examples, self._numbers = examples, numbers

    def __len__(self):
        return len(self._numbers)

    def __getitem__(self, number):
        return self._examples[int(self._numbers[number])]


class _Run:
    """A training in progress."""

    def __init__(self, task, method, recipe, crops, encoding, learner, folder, first, world):
        self.task, self.method, self.recipe, self.crops, self.encoding = task, method, recipe, crops, encoding
        self.learner, self.folder, self.first, self.world = learner, folder, first, world
        options = task.options
        self.total, self.size = int(options["crops"]), int(options["batch"])
        self.every = int(options["every"]) or len(crops.train)
        self.half = options["bf16"] and (device() == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported())
        self.done, self.seconds, self.core_seconds, self.best, self.stopped = 0, 0.0, 0.0, math.inf, None
        for part in learner.parts.values():
            part.to(device(), memory_format=torch.channels_last)
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
        losses, began = {}, None
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

    def found(self) -> Network:
        """Return the Network of the best state, or of the last epoch with the option `published`."""
        best, published = self.folder / BEST, bool(self.task.options.get("published"))
        if not best.exists():
            raise ThermorenderError(f"{self.method}: {self.stopped}; take a smaller --set rate")
        if published:
            facts, net = checkpoint.load(self.folder / LAST, self.learner), self.learner.applied
        else:
            net = net_of(self.recipe, self.encoding, int(self.task.options["width"]))
            facts = checkpoint.load(best, _Applied(net))
        curve = [{name: line[name] for name in ("crops", "seconds", "core_seconds", "validation_mae_k")}
                 for line in runs.read_log(self.folder)]  # fmt: skip
        trained = {
            "crops": self.done, "best_crops": facts["crops"], "published_crops": self.recipe.published_crops,
            "published_steps": self.recipe.published_steps,
            "seconds": self.seconds, "core_seconds": self.core_seconds, "threads": torch.get_num_threads(),
            "device": device(), "bf16": bool(self.half), "torch": str(torch.__version__),
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

    def _coarse(self, network):
        """A network with the steps that the file keeps its weights in."""
        some = self.validated[:: -(-len(self.validated) // _LOOKED_AT)]
        planes = [self._encoded(some[start : start + _AT_ONCE]).planes for start in range(0, len(some), _AT_ONCE)]
        kelvin = network.encoding.scale * self.kelvin.per_unit
        return network.coarse(planes, 1e-3 * self.task.options["tolerance_mk"] / kelvin)

    def _cost_of_keeping(self, net, network):
        """Mean absolute change of the validation crops by how the file keeps a network's weights [mK]."""
        kept = Network.of(network.header(), network.arrays()).net
        changes = [
            np.abs(before - after)[crop.valid]
            for (crop, _, before), (_, _, after) in zip(self._guessed(net), self._guessed(kept), strict=True)
        ]
        return 1000.0 * float(np.concatenate(changes).mean())

    def _guessed(self, net, half=False):
        """Yield (crop, true, guessed) of each validation crop [K]."""
        net.eval()
        for start in range(0, len(self.validated), _AT_ONCE):
            some = self.validated[start : start + _AT_ONCE]
            batch = self._encoded(some)
            with torch.inference_mode(), torch.autocast(device(), torch.bfloat16, enabled=half):
                given = kind_of(self.recipe).predict(net, batch.planes)[:, 0].cpu().numpy()
            for crop, each in zip(some, given, strict=True):
                yield crop, *self.kelvin(crop, each)

    def _begin(self):
        """Write the run's settings, or resume it."""
        settings = {"method": self.method, "seed": self.task.seed, "options": self.task.options, "world": self.world,
                    "examples": [len(self.task.examples), self.crops.digest(self.validated)],
                    "encoding": self.encoding.header()}  # fmt: skip
        settings = json.loads(json.dumps(settings))
        path, last = self.folder / runs.SETTINGS, self.folder / LAST
        if self.first:
            for each in (self.folder, self.folder / runs.SAMPLES):
                if each.is_dir():
                    files.remove_parts(each)
        if not self.first:
            pass
        elif path.exists() or last.exists():
            kept = runs.read_settings(self.folder)
            differing = [name for name in settings if kept.get(name) != settings[name]]
            if differing:
                raise ThermorenderError(
                    f"{self.folder} holds a training of other settings ({', '.join(differing)}); give another --run"
                )
            if not self.task.resume:
                raise ThermorenderError(
                    f"{self.folder} holds a training; continue it with --resume, or give another --run"
                )
        else:
            formats.write_json(path, settings | {"versions": versions()})
        if self.first and not last.exists():
            # It was stopped in the first epoch.
            runs.cut_log(self.folder, 0)
            (self.folder / BEST).unlink(missing_ok=True)
        _agreed(0.0)
        if last.exists():
            if not (self.folder / BEST).exists():
                raise ThermorenderError(f"{self.folder} lacks {BEST}, the best state so far; give another --run")
            facts = checkpoint.load(last, self.learner)
            self.done, self.best = facts["crops"], facts["best"]
            self.seconds, self.core_seconds = facts["seconds"], facts["core_seconds"]
            if self.first:
                runs.cut_log(self.folder, self.done)

    def _step(self):
        """Take a step of the learner; return {loss: value}."""
        self._set_rate()
        torch.manual_seed((self.task.seed * 1_000_003 + self.done) % _SEEDS)
        # Each process of a data-parallel training has its own crops.
        batch = self._encoded(self.crops.batch(self.done + self.size * _rank(), self.size))
        for part in self.learner.parts.values():
            part.train()
        onednn = torch.backends.mkldnn
        before = onednn.enabled
        # On some CPUs, oneDNN's gradients of convolutions with few channels free memory twice (PyTorch 2.13).
        onednn.enabled = before and int(self.task.options["width"]) >= _NARROW
        try:
            with torch.autocast(device(), torch.bfloat16, enabled=bool(self.half)):
                return {name: _agreed(float(value.detach())) for name, value in self.learner.step(batch).items()}
        finally:
            onednn.enabled = before

    def _encoded(self, crops):
        encoding = self.encoding
        planes = np.stack([encoding.planes(each.inputs) for each in crops])
        target = np.stack([(each.target - encoding.offset) / encoding.scale for each in crops])[:, None]
        if self.recipe.bounded:
            target = np.clip(target, -1.0, 1.0)
        valid = np.stack([each.valid for each in crops])[:, None].astype(np.float32)
        planes, target, valid = (
            torch.from_numpy(np.float32(each)).to(device()) for each in (planes, target * valid, valid)
        )
        return Batch(planes.contiguous(memory_format=torch.channels_last), target, valid)

    def _set_rate(self):
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

    def _end_of_epoch(self, losses):
        """Validate, and write the log, sample pictures and checkpoints."""
        found = list(self._guessed(self.learner.applied, bool(self.half)))
        # Only invalid pixels are left out, so that NaN in the output is noticed.
        off = [np.abs(guessed - true)[crop.valid] for crop, true, guessed in found]
        error = float(np.concatenate(off).mean(dtype=np.float64))
        facts = {"crops": self.done, "seconds": self.seconds, "core_seconds": self.core_seconds}
        shown = found[:: max(len(found) // _SHOWN, 1)][:_SHOWN]
        samples.write(files.make_folder(self.folder / runs.SAMPLES) / f"{self.done:09d}.png", *zip(*shown, strict=True))
        if not math.isfinite(error):
            self._stop({"validation": error})
            return
        if error < self.best:
            self.best = error
            checkpoint.save(self.folder / BEST, _Applied(self.learner.applied), facts | {"error_k": error})
        line = {**facts, "losses": losses, "validation_mae_k": error}
        formats.append_json(self.folder / runs.LOG, line)
        checkpoint.save(self.folder / LAST, self.learner, facts | {"best": self.best})
        if self.board:
            for name, value in (*losses.items(), ("validation_mae_k", error)):
                self.board.add_scalar(name, value, self.done)

    def _report(self, losses):
        now = " ".join(f"{name} {value:.3g}" for name, value in losses.items())
        best = f", validation {self.best:.2f} K at best" if math.isfinite(self.best) else ""
        line = f"{self.method}: {self.done} of {self.total} crops, {now}{best}"
        self.task.progress(line, min(self.done / self.total, 1.0))

    def _stop(self, losses):
        what = ", ".join(f"{name} {value:.3g}" for name, value in losses.items())
        self.stopped = f"training exploded at crop {self.done} ({what})"


class _Applied:
    """A single network, in the form that checkpoints take."""

    def __init__(self, net):
        self.parts, self.optimisers = {"net": net}, {}


class _Kelvin:
    """Apparent temperatures of a crop and of a network's output for it [K]."""

    def __init__(self, task, crops, encoding):
        known = np.isfinite(task.temperature) & np.isfinite(task.intensity)
        order = np.argsort(task.intensity[known])
        self.intensity, self.temperature = task.intensity[known][order], task.temperature[known][order]
        self.above_air, self.encoding = crops.above_air, encoding
        # Kelvin of one unit of what the task is to learn, about.
        cold, warm = np.interp((0.0, 1.0), self.intensity, self.temperature)
        self.per_unit = 1.0 if self.above_air else float(warm - cold)

    def __call__(self, crop, given):
        """Return (true, found), (side, side) float64 each, NaN where the crop is not valid."""
        found = given.astype(np.float64) * self.encoding.scale + self.encoding.offset
        both = np.where(crop.valid, crop.target, np.nan), found
        if self.above_air:
            return tuple(each + crop.inputs.conditions["air_k"] for each in both)
        return tuple(np.interp(each, self.intensity, self.temperature) for each in both)


def _core_seconds():
    """CPU time of this process, all threads [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _agreed(value):
    """The mean of a number over the processes of a data-parallel training; waits for all of them."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return value
    shared = torch.tensor(value, dtype=torch.float64, device=device())
    torch.distributed.all_reduce(shared)
    return float(shared) / torch.distributed.get_world_size()


def _process():
    """(whether this is the one process that writes, number of processes) of a data-parallel training."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world > 1 and not torch.distributed.is_initialized():
        torch.distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return _rank() == 0, world


def _rank():
    return int(os.environ.get("RANK", "0"))


def _board(folder):
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ThermorenderError(
            "option tensorboard=true needs the package tensorboard; install it with: pip install tensorboard"
        ) from None
    return SummaryWriter(str(folder / "tensorboard"))
