"""Flights by the workers of Dask: the bytes of one machine, whatever happens to workers and scheduler."""

import re
import subprocess
import sys
import threading
import time
from contextlib import suppress

import dask
import numpy as np
import pytest
from support import contents

import thermorender as tr
from scenes import coarse, write_terrain
from thermorender.apps.cluster.connect import Address, connected, parse_cluster
from thermorender.apps.cluster.fly import cut, fly
from thermorender.errors import ThermorenderError
from thermorender.output import flight as here
from thermorender.output.flight import FlightOptions

OPTIONS = FlightOptions(rate_hz=30.0, products=("exr", "counts"), audit=5)


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    """(Renderer, Trajectory, folder of the flight on one machine) of 30 frames."""
    folder = tmp_path_factory.mktemp("cluster")
    renderer = tr.Renderer(coarse(tr.load_scene(write_terrain(folder / "tiny")), 8), rays=4, samples=1, seed=3)
    path = tr.Trajectory(
        time_s=np.array([0.0, 0.97]), position=np.array([[-3.0, 0.0, 12.0], [3.0, 0.0, 12.0]]),
        quaternion=np.array([[0.0, 1.0, 0.0, 0.0]] * 2),
    )  # fmt: skip
    here.fly(renderer, path, folder / "whole", OPTIONS)
    return renderer, path, folder / "whole"


@pytest.fixture
def start():
    """Start a command of Dask; return (process, function that waits for a pattern in what it prints)."""
    running = []

    def run(*arguments):
        process = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *map(str, arguments[1:])],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        running.append(process)
        found = []
        reader = threading.Thread(target=lambda: found.extend(process.stdout), daemon=True)
        reader.start()

        def wait(pattern):
            for _ in range(600):
                for line in list(found):
                    if match := re.search(pattern, line):
                        return match
                time.sleep(0.1)
            raise AssertionError("".join(found))

        return process, wait

    yield run
    for process in running:
        process.kill()
        process.wait()
        process.stdout.close()


def scheduler(start, port=0):
    process, wait = start("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    return process, wait(r"Scheduler at:\s+(tcp://\S+)")[1]


def worker(start, address, name):
    return start("worker", address, "--nthreads", 1, "--no-nanny", "--no-dashboard", "--name", name)[0]


def test_address_of_a_cluster(tmp_path):
    config = tmp_path / "dask.yaml"
    config.write_text("scheduler-address: tcp://127.0.0.1:1\n")
    assert parse_cluster("local:2") == Address(local=2)
    assert parse_cluster("tcp://host:8786") == Address(scheduler="tcp://host:8786")
    assert parse_cluster(str(config)) == Address(config=config)
    for text in ("local:0", "local", "host:8786", "tcp://host", str(tmp_path), "no.yaml"):
        with pytest.raises(ThermorenderError, match=r"cluster='.*' is not allowed; give local:N with a number"):
            parse_cluster(text)
    for text, wrong in (
        ("a: 1\n", "has no scheduler-address"),
        ("a: [\n", "is not a Dask configuration in YAML"),
        ("x", "is not a Dask"),
    ):
        config.write_text(text)
        with pytest.raises(ThermorenderError, match=wrong), connected(Address(config=config)):
            pass


def test_no_scheduler_is_one_sentence(monkeypatch):
    monkeypatch.setattr("thermorender.apps.cluster.connect.ANSWER_S", 0.3)
    with pytest.raises(ThermorenderError, match=r"no scheduler answers at tcp://127.0.0.1:9"):
        with connected(Address(scheduler="tcp://127.0.0.1:9")):
            pass
    assert dask.config.get("scheduler-address", None) is None


def test_blocks_begin_at_multiples_of_their_length():
    assert cut([range(3, 10), range(12, 25)], 10) == [range(3, 10), range(12, 20), range(20, 25)]


@pytest.mark.parametrize(("arguments", "wrong"), [
    (("--block", "5"), "--block has no effect without --cluster"),
    (("--cluster", "local:2", "--frames", "0:5"), "--frames and --cluster both divide the flight"),
    (("--frames", "5:5"), "frames='5:5' is not allowed; give FIRST:STOP"),
    (("--frames", "0:5", "--resume"), "--frames needs no --resume"),
    (("--cluster", "local:2", "--preview"), "--preview writes no frames; leave --cluster and --frames out"),
    (("--cluster", "here"), "cluster='here' is not allowed"),
])  # fmt: skip
def test_contradicting_options_are_refused(call, tmp_path, arguments, wrong):
    status, _, errors = call("fly", "heath/survey", "-o", tmp_path / "f", *arguments)
    assert status == 2 and wrong in errors


def test_a_program_without_the_key_of_the_run_cannot_reach_local_workers():
    """Dask runs code that is sent to its port; neither plain connections nor other keys are taken."""
    from distributed import Client, Security

    from thermorender.apps.cluster.local import local_cluster

    with local_cluster(0) as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tls://127.0.0.1:")
        with Client(cluster, set_as_default=False) as own:
            assert own.run_on_scheduler(lambda: 1) == 1
        for stranger, security in ((address.replace("tls:", "tcp:"), None), (address, Security.temporary())):
            with pytest.raises((OSError, TypeError)):
                Client(stranger, security=security, timeout=2, set_as_default=False)


@pytest.mark.slow
def test_two_processes_give_the_bytes_of_one(setting, tmp_path):
    import psutil

    renderer, path, whole = setting
    ports, killed = set(), []

    def progress(done, total):
        mine = [psutil.Process(), *psutil.Process().children(recursive=True)]
        workers = []
        for process in mine:
            # A helper process may end meanwhile.
            with suppress(psutil.NoSuchProcess):
                ports.update(each.laddr for each in process.net_connections("tcp") if each.status == psutil.CONN_LISTEN)
                workers += [process] * ("spawn_main" in " ".join(process.cmdline()))
        if not killed:
            # The block of a worker that is killed is done again.
            killed.append(workers[0])
            killed[0].kill()

    lines, frames = [], {}
    summary = fly(renderer, path, tmp_path / "f", Address(local=2), OPTIONS, block=5, progress=progress,
                  of_worker=lambda name, done, total: frames.update({name: done}),
                  report=lines.append)  # fmt: skip
    assert contents(tmp_path / "f") == contents(whole)
    assert summary["rendered"] == 30 and sum(each["frames"] for each in summary["workers"].values()) >= 30
    assert frames == {name: each["frames"] for name, each in summary["workers"].items()}
    assert sum("was lost; its work is done again" in line for line in lines) == 1
    assert sum("joined" in line for line in lines) >= 2
    # Scheduler, two nannies and two workers, none of them a dashboard.
    assert {address.ip for address in ports} == {"127.0.0.1"} and len(ports) <= 7
    assert here.fly(renderer, path, tmp_path / "f", OPTIONS, verify=True)["rendered"] == 0


@pytest.mark.slow
def test_scheduler_restarted_worker_late_and_resume(setting, tmp_path, start):
    renderer, path, whole = setting
    first, address = scheduler(start)
    worker(start, address, "early")

    def kill(done, total):
        if done >= 10:
            first.kill()

    with pytest.raises(ThermorenderError, match=r"the scheduler was lost .* start it again and continue with resume"):
        fly(renderer, path, tmp_path / "f", Address(scheduler=address), OPTIONS, block=5, progress=kill)
    _, address = scheduler(start)
    worker(start, address, "second")
    late = []

    def join(done, total):
        if not late:
            late.append(worker(start, address, "late"))
            time.sleep(8.0)

    summary = fly(renderer, path, tmp_path / "f", Address(scheduler=address), OPTIONS, block=2, resume=True,
                  progress=join)  # fmt: skip
    assert contents(tmp_path / "f") == contents(whole)
    assert sum(each["frames"] for each in summary["workers"].values()) <= 20
    assert {name.partition("@")[0] for name in summary["workers"]} == {"second", "late"}


@pytest.mark.slow
def test_poison_is_reported_once_and_the_rest_is_finished(setting, tmp_path, start):
    renderer, path, whole = setting
    _, address = scheduler(start)
    worker(start, address, "one")
    folder, lines = tmp_path / "f", []
    # A folder in the place of a frame's file.
    (folder / "frame_000012_counts.png/inside").mkdir(parents=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("thermorender.output.blocks.refuse_used", lambda folder: None)
        patch.setattr("thermorender.output.resume.refuse_used", lambda folder: None)
        with pytest.raises(
            ThermorenderError, match=r"1 of 6 blocks failed, the first: frames 10 to 14 on one@\S+: .*frame_000012"
        ):
            fly(renderer, path, folder, Address(scheduler=address), OPTIONS, block=5, report=lines.append)
    assert sum("frames 10 to 14" in line for line in lines) == 1
    assert len((folder / "frames.jsonl").read_text().splitlines()) == 10
    for index in (*range(10), *range(15, 30)):
        assert (folder / f"frame_{index:06d}.exr").read_bytes() == (whole / f"frame_{index:06d}.exr").read_bytes()
    (folder / "frame_000012_counts.png/inside").rmdir()
    (folder / "frame_000012_counts.png").rmdir()
    assert here.fly(renderer, path, folder, OPTIONS, resume=True)["frames"] == 30
    assert contents(folder) == contents(whole)


@pytest.fixture
def worlds_in_process(monkeypatch):
    """Worlds of two tiny pairs each, rendered in this process where workers would."""
    from contextlib import nullcontext

    from thermorender.apps.training import on_workers, rendered
    from thermorender.apps.training.dataset import Entry
    from thermorender.apps.training.dataset_writer import packed

    def pairs(world, hours, views, camera, materials, report):
        if world.name == getattr(pairs, "poison", None):
            raise ValueError("a poisoned land")
        for number in range(2):
            key, value = f"{world.name}-{number}", np.full((2, 3), world.seed % 200 + number, np.uint16)
            entry = Entry(key, world.part, key, world.name, number, (2, 3))
            yield entry, packed(np.zeros((2, 3, 3), np.uint8), value)

    monkeypatch.setattr(rendered, "_pairs", pairs)
    monkeypatch.setattr(on_workers, "connected", lambda address: nullcontext())
    # In another order than that of the campaign.
    monkeypatch.setattr(on_workers, "results", lambda client, do, units, report: ((k, do(k)) for k in reversed(units)))
    return pairs


def test_worlds_by_workers_have_the_bytes_of_one_machine(worlds_in_process, tmp_path):
    from thermorender.apps.training.on_workers import render_campaign_by
    from thermorender.apps.training.rendered import render_campaign, worlds

    of, address, lines = worlds(2, 1, 1, 0), Address(local=2), []
    one = render_campaign(tmp_path / "one" / "set", of, 1, 2)
    worlds_in_process.poison = of[1].name
    sentence = f"1 of 4 worlds failed, the first: {of[1].name} on .*: ValueError: a poisoned land; the others are"
    with pytest.raises(ThermorenderError, match=sentence):
        render_campaign_by(tmp_path / "two" / "set", of, 1, 2, address, report=lines.append)
    assert len(lines) == 1 and len(list((tmp_path / "two/set/shards").glob("*.tar"))) == 3
    del worlds_in_process.poison
    with pytest.raises(ThermorenderError, match="already holds a data set; give a new folder, or --resume"):
        render_campaign_by(tmp_path / "two" / "set", of, 1, 2, address)
    two = render_campaign_by(tmp_path / "two" / "set", of, 1, 2, address, resume=True)
    assert {entry.key: entry for entry in two.entries} == {entry.key: entry for entry in one.entries}
    for path in (tmp_path / "one/set/shards").glob("*.tar"):
        assert (tmp_path / "two/set/shards" / path.name).read_bytes() == path.read_bytes()


def test_workers_of_another_version_are_refused(monkeypatch):
    from thermorender.apps.cluster.engine import ready
    from thermorender.versions import versions

    ready(versions(), 0)
    with pytest.raises(
        ThermorenderError, match=r"has numpy \S+, the work was started with 0.1; install the same version"
    ):
        ready(versions() | {"numpy": "0.1"}, 0)


def test_simulation_against_closed_forms():
    from dataclasses import replace

    from validation.cluster.simulation import Costs, simulate
    from validation.cluster.study import advice

    free = Costs(
        frame_s=2.0, warm_up_frame_s=0.0, warm_up=0, start_s=0.0, scene_bytes=0.0, scheduler_s=0.0, frame_bytes=0.0,
        frame_files=0, disk_bytes_per_s=1.0, disk_files_per_s=1.0, take_over_s=0.0,
    )  # fmt: skip
    alone = simulate(free, 1000, 10, 10)
    assert alone["hours"] == pytest.approx(1000 * 2.0 / 10 / 3600) and alone["efficiency"] == pytest.approx(1.0)
    # Nine frames of warm-up for ten of a block, but not for the first.
    warm = simulate(replace(free, warm_up=9, warm_up_frame_s=2.0), 1000, 1, 10)
    assert warm["hours"] == pytest.approx((1000 + 99 * 9) * 2.0 / 3600)
    # Saturated: the scheduler serves 100 blocks, the disk 1000 frames, one after another.
    scheduler = simulate(replace(free, scheduler_s=100.0), 1000, 100, 10)
    assert scheduler["hours"] == pytest.approx((100 * 100.0 + 20.0) / 3600) and scheduler["scheduler"] > 0.99
    disk = simulate(replace(free, frame_bytes=50.0), 1000, 100, 10)
    assert disk["hours"] == pytest.approx((1000 * 50.0 + 20.0) / 3600) and disk["disk"] > 0.99
    taken = simulate(replace(free, take_over_s=1.0), 1000, 10, 10)
    assert taken["hours"] - alone["hours"] == pytest.approx(1000 / 3600)
    cases = [simulate(replace(free, warm_up=9, warm_up_frame_s=2.0), 10_000, 1, block) for block in (10, 1000, 5000)]
    assert advice(cases)["block"] == 1000
