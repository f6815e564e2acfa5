"""The training loop of networks: what it learns, keeps, resumes and refuses, and when it stops."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from support import slow
from training_support import SMALL, example, examples, kelvin, picture, task_of, write

from thermorender import files
from thermorender.apps.training.map_training import train_map
from thermorender.apps.training.networks import checkpoint, coarse, loop
from thermorender.apps.training.networks.crops import Crops
from thermorender.apps.training.networks.loop import train_network
from thermorender.apps.training.networks.runs import cut_log, read_log
from thermorender.apps.training.training_methods import method
from thermorender.errors import ThermorenderError
from thermorender.learned.networks.predictor import Network
from thermorender.learned.networks.recipes import RECIPES
from thermorender.learned.temperature_map import Inputs, load_model

TESTS = Path(__file__).resolve().parents[2]
MORE = {"crops": 72, "every": 24}


@pytest.fixture(autouse=True)
def _one_thread():
    """The number of threads decides the order of sums; a worker has one core, so one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def losses(folder):
    return [(line["crops"], line["losses"], line["validation_mae_k"]) for line in read_log(folder)]


class Stopped(BaseException):
    """Stands in for an interrupt from the keyboard."""


def stopping(at):
    """A progress function that stops the training at its `at`-th step."""
    calls = iter(range(1, 10**6))

    def stop(what, share):
        if next(calls) == at:
            raise Stopped

    return stop


# --- what it learns ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_linear_world_is_learned(tmp_path):
    """A temperature linear in colour: two thirds of its variation are learned in seconds, also on unseen pictures."""
    task = task_of("compact", examples(), tmp_path / "r", width=8, batch=8, crops=400, every=100, rate=4e-3)
    found = train_network(task, "compact")
    errors = [line["validation_mae_k"] for line in read_log(tmp_path / "r")]
    true = kelvin(picture(99))
    spread = np.abs(true - true.mean()).mean()
    assert errors[-1] < errors[0] and errors[-1] < 0.33 * spread
    unseen = 280.0 + 20.0 * found.predict(Inputs(picture(99), 0.2), 0.2)
    assert np.abs(unseen - true).mean() < 0.5 * spread
    assert found.trained["crops"] == 400 and len(found.trained["curve"]) == 4
    assert found.trained["core_seconds"] > 0.0 and found.texel_range_m == (0.2, 0.2)


@pytest.mark.slow
def test_the_spread_is_that_of_the_errors(tmp_path):
    """Noise that colour does not predict, of one standard deviation: the network finds its size."""
    noisy = []
    for each in examples():
        noise = np.random.default_rng(int(each.values[0, 0])).laplace(0.0, 100.0, each.values.shape)
        noisy.append(replace(each, values=np.rint(each.values + noise).astype(np.uint16)))
    options = {"width": 8, "batch": 2, "crops": 600, "every": 300, "rate": 4e-3}
    found = train_network(task_of("compact", noisy, tmp_path / "r", **options), "compact")
    mean, spread = found.with_spread(Inputs(picture(99), 0.2))
    noise = np.random.default_rng(0).laplace(0.0, 1.0, mean.shape)
    error = 280.0 + 20.0 * mean - kelvin(picture(99)) - noise
    stated = 20.0 * np.sqrt((spread**2).mean())
    assert stated == pytest.approx(np.sqrt((error**2).mean()), rel=0.35) and stated > np.sqrt(2.0)


@pytest.mark.parametrize("name", slow("compact", "pix2pix"))
def test_the_cost_of_half_precision_is_reported(tmp_path, name):
    task = task_of(name, examples(), tmp_path / "r", **SMALL)
    found = train_network(task, name)
    halved = Network.of(found.header(), found.arrays())
    crops = Crops(task, task.options.get("side", 256), False).validation()
    changes = [20e3 * np.abs(found.predict(crop.inputs, 0.2) - halved.predict(crop.inputs, 0.2)) for crop in crops]
    wanted = np.concatenate([change[crop.valid] for change, crop in zip(changes, crops, strict=True)]).mean()
    assert found.trained["kept_mk"] == pytest.approx(wanted, rel=1e-3) and wanted > 1e-3


# One that regresses, one that is adversarial, and the smallest; a step of each is in test_networks.py.
QUICK = ("unet", "unet-gan-keras", "compact")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else slow(name)[0] for name in RECIPES if name not in ("compact+", "pix2pix-b25")]
)
def test_every_network_trains(name, tmp_path):
    """Its losses fall, or stay level for adversarial networks; its results are in the folder."""
    batch = {"batch": 2, "crops": 8, "every": 4}
    found = train_network(task_of(name, examples(11), tmp_path / "r", **batch | {"width": 4}), name)
    log = read_log(tmp_path / "r")
    assert [line["crops"] for line in log] == [4, 8]
    assert all(np.isfinite(list(line["losses"].values())).all() for line in log)
    assert {path.name for path in (tmp_path / "r").iterdir()} == {
        "settings.json", "log.jsonl", "last.safetensors", "best.safetensors", "samples"
    }  # fmt: skip
    assert sorted(path.name for path in (tmp_path / "r" / "samples").iterdir()) == ["000000004.png", "000000008.png"]
    assert found.method == name and not found.above_air


@pytest.mark.parametrize(("architecture", "side"), [("autoencoder", 96), ("dense", 64)])
def test_other_architectures_of_a_recipe_are_trained_and_kept(architecture, side, tmp_path):
    options = {"batch": 2, "crops": 4, "every": 4, "width": 4, "architecture": architecture, "side": side}
    found = train_network(task_of("unet", examples(11), **options), "unet")
    again = Network.of(found.header(), found.arrays())
    assert again.recipe.net == architecture and set(again.state) == set(found.state)
    assert np.isfinite(again.predict(Inputs(picture(2, 70, 90), 0.2), 0.2)).all()


@pytest.mark.parametrize(
    ("method", "options", "words"),
    [
        ("unet", {"architecture": "dense"}, "side=96 is not allowed for 'dense'; give side=64"),
        ("unet", {"architecture": "vit"}, "architecture='vit' does not belong to 'unet'; give keras_unet, autoencoder"),
        ("pix2pix", {"architecture": "dense"}, "architecture='dense' does not belong to 'pix2pix'; give unet256"),
    ],
)
def test_architectures_that_a_recipe_does_not_have_are_refused(method, options, words, tmp_path):
    with pytest.raises(ThermorenderError, match=words):
        train_network(task_of(method, examples(), tmp_path / "r", **options), method)


def test_hour_and_weather_are_learned(tmp_path):
    """compact+ gives kelvin above the air, and begins with the linear map."""
    task = task_of("compact+", examples(conditional=True), tmp_path / "r", **SMALL)
    found = train_network(task, "compact+")
    assert found.above_air and found.encoding.base is not None and set(found.needs) == {"terrain", "conditions"}
    rgb = picture(99)
    terrain = {"slope": np.full(rgb.shape[:2], 0.1, np.float32)}
    given = found.predict(Inputs(rgb, 0.2, terrain, {"air_k": 286.0, "wind_m_s": 2.0}), 0.2)
    assert np.abs(given + 286.0 - kelvin(rgb)).mean() < 1.0


@pytest.mark.slow
def test_depth_as_an_input_reduces_the_error(tmp_path):
    """Where temperature depends on depth alone, a network with depth input has a smaller error than one without."""
    deep = []
    for seed in range(20):
        depth = 50.0 * np.exp(np.float32(picture(seed)[..., 0]) / 100.0)
        rgb = np.full((*depth.shape, 3), 128, np.uint8)
        values = np.rint(100.0 * (285.0 + 5.0 * np.log(depth / 50.0))).astype(np.uint16)
        deep.append(replace(example(seed), inputs=Inputs(rgb, 0.2, depth=np.float32(depth)), values=values))
    found = {}
    for depth in (False, True):
        options = {"width": 8, "batch": 8, "crops": 240, "every": 120, "rate": 4e-3}
        train_network(task_of("compact", deep, tmp_path / str(depth), depth=depth, **options), "compact")
        found[depth] = read_log(tmp_path / str(depth))[-1]["validation_mae_k"]
    assert found[True] < 0.7 * found[False]


# --- stopped and resumed ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "at"),
    [("compact", 5), *slow(("pix2pix", 5), ("compact", 1), ("compact", 9), ("unet-gan-keras", 3), ("compact+", 5))],
)
def test_a_stopped_and_resumed_training_is_the_same(tmp_path, name, at):
    """The losses and the network are the same as those of an uninterrupted training."""
    options = SMALL if name.startswith("compact") else SMALL | {"crops": 16, "every": 4, "batch": 2}
    pairs = examples(conditional=name == "compact+")
    whole = train_network(task_of(name, pairs, tmp_path / "whole", **options), name)
    # Some steps of the linear map's fit report progress as well.
    extra = 18 if name == "compact+" else 0
    with pytest.raises(Stopped):
        train_network(task_of(name, pairs, tmp_path / "r", progress=stopping(at + extra), **options), name)
    again = train_network(task_of(name, pairs, tmp_path / "r", resume=True, **options), name)
    assert losses(tmp_path / "r") == losses(tmp_path / "whole")
    for key, values in whole.state.items():
        assert np.array_equal(values, again.state[key]), key


@pytest.mark.slow
@pytest.mark.parametrize(("name", "at"), [("compact", 9), *slow(("pix2pix", 5))])
def test_the_best_state_of_a_stopped_training_is_taken_and_its_run_goes_on(tmp_path, name, at):
    options = SMALL if name == "compact" else SMALL | {"crops": 16, "every": 4, "batch": 2}
    pairs, run = examples(), tmp_path / "r"
    whole = train_network(task_of(name, pairs, tmp_path / "whole", **options), name)
    with pytest.raises(Stopped):
        train_network(task_of(name, pairs, run, progress=stopping(1), **options), name)
    with pytest.raises(ThermorenderError, match="has no validated state yet; train on to the first validation"):
        train_network(replace(task_of(name, pairs, run, **options), best=True), name)
    with pytest.raises(Stopped):
        train_network(task_of(name, pairs, run, progress=stopping(at), resume=True, **options), name)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    # Also while another process trains there.
    with files.in_use(run):
        taken = train_network(replace(task_of(name, pairs, run, **options), best=True), name)
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    log = read_log(run)
    least = min(log, key=lambda line: line["validation_mae_k"])
    assert 0 < len(log) < len(read_log(tmp_path / "whole")) and taken.trained["best_crops"] == least["crops"]
    assert taken.trained["crops"] == log[-1]["crops"]
    with pytest.raises(ThermorenderError, match=r"holds a training of other settings \(options\)"):
        train_network(replace(task_of(name, pairs, run, **options | {"rate": 1e-5}), best=True), name)
    again = train_network(task_of(name, pairs, run, resume=True, **options), name)
    assert all(np.array_equal(values, again.state[key]) for key, values in whole.state.items())


def test_a_training_killed_at_any_moment_and_resumed_is_the_same(tmp_path):
    """A process is killed at random moments and resumed until it ends: nothing is lost and nothing is doubled."""
    # Every step waits, so that a fast machine does not finish before it is killed.
    program = (
        "import sys, time, torch; torch.set_num_threads(1); sys.path.insert(0, sys.argv[1]);"
        "from thermorender.apps.training.networks.loop import train_network;"
        "from training_support import SMALL, examples, task_of;"
        f"MORE = {MORE!r};"
        "slow = lambda what, share: time.sleep(0.05);"
        "task = task_of('compact', examples(), sys.argv[2], resume=True, progress=slow, **SMALL | MORE);"
        "train_network(task, 'compact')"
    )
    train_network(task_of("compact", examples(), tmp_path / "whole", **SMALL | MORE), "compact")
    generator, status, kills = np.random.default_rng(5), None, 0
    for _ in range(4):
        process = subprocess.Popen([sys.executable, "-W", "ignore", "-c", program, str(TESTS), str(tmp_path / "r")])
        # From the first line of the log on, there is something to lose.
        until = time.monotonic() + 60.0
        before = len(read_log(tmp_path / "r"))
        while process.poll() is None and len(read_log(tmp_path / "r")) == before and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(float(generator.uniform(0.0, 0.2)))
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            kills += 1
        status = process.wait()
        if status == 0:
            break
    assert kills >= 2
    task = task_of("compact", examples(), tmp_path / "r", resume=True, **SMALL | MORE)
    again = train_network(task, "compact")
    assert losses(tmp_path / "r") == losses(tmp_path / "whole") and again.trained["crops"] == 72


def test_a_full_disk_loses_nothing(tmp_path, monkeypatch):
    whole = train_network(task_of("compact", examples(), tmp_path / "whole", **SMALL), "compact")
    written, original = iter(range(100)), checkpoint.save_file

    def full(tensors, path, metadata):
        original(tensors, path, metadata)
        if next(written) == 2:
            Path(path).write_bytes(Path(path).read_bytes()[:100])
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "save_file", full)
    with pytest.raises(ThermorenderError, match="cannot be written: No space left"):
        train_network(task_of("compact", examples(), tmp_path / "r", **SMALL), "compact")
    monkeypatch.setattr(checkpoint, "save_file", original)
    assert not list((tmp_path / "r").glob(".*"))
    again = train_network(task_of("compact", examples(), tmp_path / "r", resume=True, **SMALL), "compact")
    assert losses(tmp_path / "r") == losses(tmp_path / "whole")
    assert all(np.array_equal(values, again.state[key]) for key, values in whole.state.items())


@pytest.mark.slow
def test_two_processes_have_the_losses_of_one(tmp_path):
    """Data-parallel with half the batch each: the same crops, so the same losses except for the order of sums."""
    program = tmp_path / "p.py"
    program.write_text(
        f"import sys; sys.path.insert(0, {str(TESTS)!r}); import torch; torch.set_num_threads(1)\n"
        "from thermorender.apps.training.networks.loop import train_network\n"
        "from training_support import SMALL, examples, task_of\n"
        f"task = task_of('compact', examples(), {str(tmp_path / 'two')!r}, **SMALL | {{'batch': 2}})\n"
        "train_network(task, 'compact')\n",
        encoding="utf-8",
    )
    command = [sys.executable, "-W", "ignore", "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([*command, str(program)], check=True, env=environment, capture_output=True, timeout=240)
    train_network(task_of("compact", examples(), tmp_path / "one", **SMALL), "compact")
    for two, one in zip(losses(tmp_path / "two"), losses(tmp_path / "one"), strict=True):
        assert two[0] == one[0] and two[2] == pytest.approx(one[2], rel=0.02)


# --- what goes wrong --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_training_that_explodes_keeps_its_best_state(tmp_path, monkeypatch):
    """The discriminator's weights explode half-way: the training stops, and the result is the best state so far."""
    task = task_of("pix2pix", examples(), tmp_path / "r", width=4, batch=2, crops=24, every=4)
    learner_of, steps = loop.learner_of, iter(range(100))

    def exploding(*given):
        learner = learner_of(*given)
        step = learner.step

        def stepped(batch):
            if next(steps) == 7:
                with torch.no_grad():
                    for weight in learner.parts["discriminator"].parameters():
                        weight *= 1e20
            return step(batch)

        learner.step = stepped
        return learner

    monkeypatch.setattr(loop, "learner_of", exploding)
    found = train_network(task, "pix2pix")
    assert "training exploded at crop 16" in found.trained["stopped"]
    assert all(np.isfinite(values).all() for values in found.state.values())
    log = read_log(tmp_path / "r")
    assert [line["crops"] for line in log] == [4, 8, 12]
    best = min(log, key=lambda line: line["validation_mae_k"])
    assert found.trained["best_crops"] == best["crops"]


def test_a_training_that_explodes_at_once_is_refused(tmp_path):
    task = task_of("unet", examples(), tmp_path / "r", width=4, batch=2, crops=400, every=200, rate=1e3)
    with pytest.raises(ThermorenderError, match=r"unet: training exploded at crop .*; take a smaller --set rate"):
        train_network(task, "unet")


def test_published_keeps_the_last_epoch_and_else_the_best_is_kept(tmp_path, monkeypatch):
    """The validation error rises after the first epoch here."""
    predicted, offsets = loop.predicted, itertools.count(10.0, 10.0)
    monkeypatch.setattr(loop, "predicted", lambda *given: predicted(*given) + next(offsets))
    crops = {}
    for published in (False, True):
        options = {"width": 4, "crops": 3, "every": 1, "published": published, "jitter": 256}
        folder = tmp_path / str(published)
        found = train_network(task_of("pix2pix", examples(), folder, **options), "pix2pix")
        crops[published] = found.trained["best_crops"]
        kept = load_file(folder / ("last.safetensors" if published else "best.safetensors"))
        assert found.published == published
        name = "down.0.0.weight"
        assert np.array_equal(found.state[name], kept[f"net/net/{name}"])
    assert crops == {False: 1, True: 3}


def test_colourless_and_invalid_pictures_do_not_stop_a_training(tmp_path):
    """The pictures include black, white, grey and wholly invalid ones."""
    odd = examples(14)
    for number, level in enumerate((0, 255, 128)):
        odd[number] = replace(odd[number], inputs=Inputs(np.full((96, 128, 3), level, np.uint8), 0.2))
    for number in (4, 8):
        odd[number] = replace(odd[number], valid=np.zeros((96, 128), bool))
    found = train_network(
        task_of("unet-gan-keras", odd, tmp_path / "r", width=4, batch=2, crops=16, every=8), "unet-gan-keras"
    )
    assert found.trained["stopped"] is None and np.isfinite(read_log(tmp_path / "r")[-1]["validation_mae_k"])


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("cyclegan", {"batch": 1}, "batch=1 of crops=.* is not allowed for 'cyclegan'; give a batch of 2 or more"),
        ("unet", {"batch": 0}, "batch=0 of crops=.* is not allowed"),
        ("unet", {"crops": 1}, "batch=8 of crops=1 is not allowed"),
        ("unet", {"width": 0}, "width=0 is not allowed"),
        ("pix2pix", {"jitter": 200}, r"jitter=200 is not allowed for 'pix2pix'; give 256 \(no jitter\) to 4096 pixels"),
        ("unet", {"side": 0}, "side=0 is not allowed for 'unet'; give a multiple of 16 up to 4096 pixels"),
        ("compact", {"side": 100}, "side=100 is not allowed"),
        ("unet", {"width": 10**6}, "width=1000000 is not allowed"),
        ("unet", {"rate": 0.0}, "rate=0 is not allowed"),
        ("unet", {"rate": 1e300}, "is not allowed for 'unet'; give a number in 0…1000"),
        ("unet", {"depth": True}, "the pairs have no depth"),
        ("pix2pixhd", {"vgg": "none.safetensors", "width": 4}, "vgg=none.safetensors holds no weights of VGG-19"),
    ],
)
def test_impossible_trainings_are_refused(tmp_path, name, options, words):
    with pytest.raises(ThermorenderError, match=words):
        train_network(task_of(name, examples(11), tmp_path / "r", **options), name)


def test_nan_does_not_count_as_an_error_of_zero(tmp_path, monkeypatch):
    """A network whose output is NaN has exploded; validation pairs without a valid pixel are refused."""
    monkeypatch.setattr(loop, "predicted", lambda recipe, net, planes: net(planes).float() * np.nan)
    with pytest.raises(ThermorenderError, match="training exploded at crop 4"):
        train_network(task_of("unet", examples(), tmp_path / "r", width=4, batch=2, crops=8, every=4), "unet")
    monkeypatch.undo()
    blind = examples(11)
    blind[9] = replace(blind[9], valid=np.zeros((96, 128), bool))
    with pytest.raises(ThermorenderError, match="none of 1 validation pairs has a valid pixel"):
        train_network(task_of("compact", blind, tmp_path / "b", **SMALL), "compact")


def test_a_pair_without_air_among_others_is_named(tmp_path):
    pairs = examples(conditional=True)
    pairs[9] = replace(pairs[9], inputs=replace(pairs[9].inputs, conditions={"wind_m_s": 2.0}))
    with pytest.raises(ThermorenderError, match="pair number 9 lacks the condition air_k"):
        train_network(task_of("compact+", pairs, tmp_path / "r", **SMALL), "compact+")


@pytest.mark.parametrize("text", ["null\n", "{}\n", '{"crops": "a"}\n', "[]\n", '{"crops": 12, "sec'])
def test_only_the_damaged_line_of_a_log_is_skipped(tmp_path, text):
    epochs = [{"crops": n, "seconds": 1.0, "core_seconds": 1.0, "validation_mae_k": 1.0} for n in (12, 24, 36)]
    first, *rest = (json.dumps(each) + "\n" for each in epochs)
    (tmp_path / "log.jsonl").write_text(first + text.rstrip() + "\n" + "".join(rest), encoding="utf-8")
    assert read_log(tmp_path) == epochs
    cut_log(tmp_path, 24)
    assert read_log(tmp_path) == epochs[:2]
    (tmp_path / "log.jsonl").write_text(first + text, encoding="utf-8")
    assert read_log(tmp_path) == epochs[:1]


def test_a_training_stopped_before_its_first_checkpoint_starts_again(tmp_path, monkeypatch):
    whole = train_network(task_of("compact", examples(), tmp_path / "whole", **SMALL), "compact")
    original = checkpoint.save

    def save(path, *more):
        if path.name.startswith("last"):
            raise Stopped
        original(path, *more)

    monkeypatch.setattr(checkpoint, "save", save)
    with pytest.raises(Stopped):
        train_network(task_of("compact", examples(), tmp_path / "r", **SMALL), "compact")
    monkeypatch.setattr(checkpoint, "save", original)
    again = train_network(task_of("compact", examples(), tmp_path / "r", resume=True, **SMALL), "compact")
    assert losses(tmp_path / "r") == losses(tmp_path / "whole") and again.trained["crops"] == whole.trained["crops"]


def test_a_folder_of_another_training_is_refused(tmp_path):
    train_network(task_of("compact", examples(11), tmp_path / "r", **SMALL), "compact")
    with pytest.raises(ThermorenderError, match="holds a training; continue it with --resume, or give another --run"):
        train_network(task_of("compact", examples(11), tmp_path / "r", **SMALL), "compact")
    with pytest.raises(ThermorenderError, match=r"training of other settings \(seed.*\); give another --run"):
        train_network(task_of("compact", examples(11), tmp_path / "r", seed=4, resume=True, **SMALL), "compact")
    others = [example(seed + 50) for seed in range(11)]
    with pytest.raises(ThermorenderError, match=r"training of other settings \(examples, encoding\)"):
        train_network(task_of("compact", others, tmp_path / "r", resume=True, **SMALL), "compact")
    best = (tmp_path / "r" / "best.safetensors").rename(tmp_path / "best")
    with pytest.raises(ThermorenderError, match=r"lacks best.safetensors"):
        train_network(task_of("compact", examples(11), tmp_path / "r", resume=True, **SMALL), "compact")
    best.rename(tmp_path / "r" / "best.safetensors")
    last = tmp_path / "r" / "last.safetensors"
    last.write_bytes(last.read_bytes()[:-100])
    with pytest.raises(ThermorenderError, match="is not a checkpoint of this training"):
        train_network(task_of("compact", examples(11), tmp_path / "r", resume=True, **SMALL), "compact")


def test_a_folder_in_use_is_refused(tmp_path):
    from thermorender import files

    (tmp_path / "r").mkdir()
    with files.in_use(tmp_path / "r"), pytest.raises(ThermorenderError, match="is being written by another process"):
        train_network(task_of("compact", examples(11), tmp_path / "r", **SMALL), "compact")


# --- coarse weights --------------------------------------------------------------------------------------------


def weights(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def test_steps_are_as_coarse_as_the_sensitivity_of_the_output_allows():
    state = {"strong": weights(64, 64), "weak": weights(64, 64, seed=1), "small": weights(9, seed=2)}
    pictures = weights(64, 500, seed=3)

    def give(state):
        return state["strong"] @ pictures + 0.01 * state["weak"] @ pictures

    steps, shift = coarse.coarsest_steps(state, give, 0.1)
    rounded = state | {name: np.rint(state[name] / step) * step for name, step in steps.items()}
    change = give(rounded) - give(state)
    assert shift == pytest.approx(change.mean(), rel=1e-6) and 0.08 < np.abs(change - shift).mean() <= 0.1
    assert set(steps) == {"strong", "weak"} and steps["weak"] > 20.0 * steps["strong"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["compact", "pix2pix"])
def test_a_network_is_kept_as_coarse_as_the_tolerance_allows(name, tmp_path, monkeypatch):
    # So narrow a network has no large tensors.
    monkeypatch.setattr(coarse, "_LEAST_SIZE", 50)
    halves = train_network(task_of(name, examples(), tmp_path / "r", **SMALL), name)
    narrow = train_network(task_of(name, examples(), tmp_path / "s", **SMALL, tolerance_mk=50.0), name)
    assert halves.trained["kept_mk"] < 10.0 < narrow.trained["kept_mk"] < 75.0
    size = {each: sum(values.nbytes for values in each.arrays().values()) for each in (halves, narrow)}
    assert size[narrow] < 0.7 * size[halves]
    again = Network.of(narrow.header(), narrow.arrays())
    assert again.header() == narrow.header()
    assert all(np.array_equal(values, narrow.arrays()[key]) for key, values in again.arrays().items())


# --- command line -----------------------------------------------------------------------------------------------


def test_the_verb_trains_and_resumes(tmp_path, call):
    write(tmp_path / "d", parts=("train",) * 11 + ("validation", "test"))
    options = [part for name, value in SMALL.items() for part in ("--set", f"{name}={value}")]
    arguments = ("train", "compact", tmp_path / "d", *options, "-o", tmp_path / "m.npz")
    status, out, err = call(*arguments)
    assert status == 0, err
    assert "compact → apparent temperature" in out and (tmp_path / "m.run" / "log.jsonl").is_file()
    status, _, err = call(*arguments)
    assert status == 2 and "continue it with --resume" in err
    status, out, err = call(*arguments, "--resume")
    assert status == 0 and len(read_log(tmp_path / "m.run")) == 4, err
    status, out, err = call("evaluate", tmp_path / "m.npz", "--dataset", tmp_path / "d", "-o", tmp_path / "e")
    assert status == 0 and "m " in out, err
    kept = json.loads((tmp_path / "e" / "evaluation.json").read_text("utf-8"))
    assert kept["models"]["m"]["about"]["training"]["crops"] == 48
    # The run knows its own options.
    at_best = ("train", "compact", tmp_path / "d", "--run", tmp_path / "m.run", "--best", "-o", tmp_path / "n.npz")
    status, out, err = call(*at_best)
    assert status == 0 and "own error" in out, err
    one, other = (load_model(tmp_path / f"{name}.npz") for name in "mn")
    assert one.about["options"] == other.about["options"] and one.error_k == other.error_k
    status, out, err = call("evaluate", tmp_path / "n.npz", "--dataset", tmp_path / "d", "-o", tmp_path / "f")
    assert status == 0 and "n " in out, err
    status, _, err = call(*at_best, "--resume")
    assert status == 2 and "--resume trains on and --best does not" in err
    status, _, err = call("train", "unet", *at_best[2:])
    assert status == 2 and "holds a training of 'compact', not 'unet'; give its method" in err
    status, _, err = call("train", "trees", tmp_path / "d", "--resume", "-o", tmp_path / "n.npz")
    assert status == 2 and "--run, --resume and --best belong to networks, and 'trees' is not one" in err


@pytest.mark.slow
def test_a_network_is_trained_without_a_folder(tmp_path):
    dataset = write(tmp_path / "d", parts=("train",) * 11 + ("validation", "test"))
    model = train_map("m", "unet", dataset, {"width": 4, "batch": 2, "crops": 8})
    assert model.predictor.method == "unet" and model.about["training"]["crops"] == 8


def test_command_line_options_match_the_recipes():
    for name, recipe in RECIPES.items():
        assert method(name).options == recipe.all_options and method(name).plus == recipe.plus
    assert method("pix2pix").options["crops"] == 3511 * 200
