"""What a flight costs on a cluster: one block and 1, 2 and 4 workers measured here, and many workers simulated.

The simulation takes the seconds of one core measured here, and disks of stated speed. It is not a measurement.
"""

import json
import os
import pickle
import time
from functools import partial
from pathlib import Path

import numpy as np

from thermorender import formats
from thermorender.apps.compare import machine
from thermorender.versions import versions
from validation.cluster.figure import figure
from validation.cluster.simulation import Costs, simulate
from validation.drapes import load_drape

HEADER = (
    "workers", "wall [s]", "cores [s]", "loading [s]", "warm-up [s]", "frames [s]", "moving [s]", "blocks",
    "same bytes",
)  # fmt: skip
WORKERS = (1, 2, 4)
RATE_HZ, FRAMES, BLOCK = 30.0, 48, 12
# Shared disks [bytes/s, files/s]: a network disk of one server, a parallel file system.
DISKS = {"1 GB/s, 5 000 files/s": (1e9, 5e3), "10 GB/s, 50 000 files/s": (1e10, 5e4)}
BLOCKS = (10, 20, 40, 80, 110, 160, 320, 640, 1280, 2560, 5120, 10240)
CAMPAIGN, CAMPAIGN_WORKERS = 1_000_000, 100
_NO_WORK = 1000


def setting():
    """Return (Renderer, Trajectory, FlightOptions): the shipped heath with all products that are one file per frame."""
    import thermorender as tr
    from thermorender.output.flight import FlightOptions

    scene = load_drape("heath")
    renderer = tr.Renderer(scene, rays=16, quality="fast", seed=1)
    ends = np.array([0.0, (FRAMES - 1) / RATE_HZ])
    heights = float(scene.ground(0.0, 0.0)) + 60.0
    path = tr.Trajectory(
        time_s=ends, position=np.array([[-5.0, 0.0, heights], [5.0, 0.0, heights]]),
        quaternion=np.array([[0.0, 1.0, 0.0, 0.0]] * 2),
    )  # fmt: skip
    return renderer, path, FlightOptions(rate_hz=RATE_HZ, products=("exr", "truth", "counts", "display"))


def run(folder, workers=WORKERS, progress=None, hosts=True):
    """Measure and simulate; return the record, as written to `cluster.json`.

    Parameters
    ----------
    folder : path
    workers : sequence of int
        Numbers of local workers.
    progress : callable, optional
        Called with (step, share done).
    hosts : bool
        Measure several hosts too, where network namespaces are permitted.
    """
    folder = Path(folder)
    report = progress or (lambda what, share: None)
    report("one block", 0.0)
    record = {"machine": machine.machine(), "versions": versions(), "rate_hz": RATE_HZ, "frames": FRAMES}
    # Wall times beside other work say little; seconds of cores do.
    record["load_average"] = round(os.getloadavg()[2], 1)
    record["one"] = machine.apart(one_block, folder / "scratch")
    report("scheduler", 0.2)
    record["scheduler"] = machine.apart(scheduler_costs)
    report("workers", 0.3)
    record["workers"] = machine.apart(scaling, folder / "scratch", tuple(workers))
    if hosts:
        from validation.cluster.hosts import several_hosts

        report("hosts", 0.7)
        record["hosts"] = several_hosts(folder / "scratch")
    report("simulation", 0.9)
    record["simulated"] = simulated(record)
    record["advice"] = {name: advice(cases) for name, cases in record["simulated"].items()}
    _remove(folder / "scratch")
    formats.write_json(folder / "cluster.json", record)
    figure(folder / "cluster.png", record)
    return record


def rows(record):
    """Return the scaling as table rows under HEADER."""
    keys = ("wall_s", "core_s", "loading_s", "warm_up_s", "frames_s", "moving_s")
    return [(one["workers"], *(f"{one[key]:.2f}" for key in keys), one["blocks"], one["same"])
            for one in record["workers"]]  # fmt: skip


def _remove(folder):
    import shutil

    shutil.rmtree(folder, ignore_errors=True)


def one_block(folder):
    """Return the seconds of one core of the parts of a block, its bytes, and the memory of a worker."""
    from thermorender.apps.cluster.engine import do_unit, store
    from thermorender.apps.cluster.fly import FlightBlocks
    from thermorender.output.blocks import finished_blocks, join, write_block
    from thermorender.output.flight import Flight

    _remove(folder)
    folder.mkdir(parents=True)
    flight = Flight(*setting(), None)
    flight.sheet = []
    join(folder, flight)
    stored = folder / "blocks" / "flight.pickle"
    stored.parent.mkdir(exist_ok=True)
    job = store(FlightBlocks(folder, flight, *setting()[1:]), stored, 0)
    scene_bytes = stored.stat().st_size
    # Compiles all kernels.
    write_block(flight, folder, 0, 2)
    machine.forget_peak_memory()
    clock = time.process_time()
    first = 2 * BLOCK
    flight.flown.start(first)
    warm_up_s = time.process_time() - clock
    warm_up = first - flight.flown.warm_up(first)
    clock = time.process_time()
    found = write_block(flight, folder, first, 2 * first)
    block_s = time.process_time() - clock - warm_up_s
    record = next((folder / "blocks").glob(f"{first:09d}-*.json"))
    lines = json.loads(record.read_text(encoding="utf-8"))["lines"]
    clock = time.process_time()
    finished_blocks(folder, flight.settings, False)
    formats.append_json(folder / "taken.jsonl", *map(formats.sealed, lines))
    take_over_s = (time.process_time() - clock) / len(lines)
    clock = time.process_time()
    pickle.loads(stored.read_bytes())
    result = {"worker": "worker@host", "loading_s": 0.0, "value": found}
    return {
        "frame_s": block_s / first, "warm_up": warm_up, "warm_up_frame_s": warm_up_s / warm_up,
        "loading_s": time.process_time() - clock, "scene_bytes": scene_bytes,
        "frame_bytes": found["bytes"] / first, "frame_files": len(lines[0]["files"]),
        "record_bytes": record.stat().st_size / first, "take_over_s": take_over_s,
        "sent_bytes": len(pickle.dumps((partial(do_unit, job), range(first, 2 * first)))),
        "returned_bytes": len(pickle.dumps(result)), "memory_mib": machine.peak_memory_mib(),
    }  # fmt: skip


def scheduler_costs():
    """Return the seconds that client and scheduler take for a unit without work, by two local workers."""
    from thermorender.apps.cluster.connect import Address, connected
    from thermorender.apps.cluster.engine import results

    with connected(Address(local=2)) as client:
        list(results(client, _nothing, range(50), lambda line: None))
        clock, core = time.perf_counter(), time.process_time()
        list(results(client, _nothing, range(_NO_WORK), lambda line: None))
        wall, core = time.perf_counter() - clock, time.process_time() - core
    # Client and scheduler are in this process.
    return {"unit_wall_s": wall / _NO_WORK, "unit_s": core / _NO_WORK}


def _nothing(number):
    return {"worker": "", "number": number}


def scaling(folder, workers):
    """Return the times of a flight by each number of local workers, and whether its bytes are those of one process."""
    from thermorender.apps.cluster.connect import Address
    from thermorender.apps.cluster.fly import fly
    from thermorender.output import flight as here

    renderer, path, options = setting()
    _remove(folder)
    clock, core = time.perf_counter(), _core_s()
    here.fly(renderer, path, folder / "whole", options)
    alone_s, alone_core_s = time.perf_counter() - clock, _core_s() - core
    found = []
    for count in workers:
        clock, core = time.perf_counter(), _core_s()
        summary = fly(renderer, path, folder / str(count), Address(local=count), options, block=BLOCK)
        wall_s, core_s = time.perf_counter() - clock, _core_s() - core
        parts = list(summary["workers"].values())
        total = {key: sum(part[key] for part in parts) for key in parts[0]}
        found.append({
            "workers": count, "wall_s": wall_s, "core_s": core_s, "alone_s": alone_s, "alone_core_s": alone_core_s,
            **total, "same": same(folder / "whole", folder / str(count)),
        })  # fmt: skip
        _remove(folder / str(count))
    return found


def _core_s():
    """Seconds of cores that this process and its ended children took."""
    return sum(os.times()[:4])


def same(one, other):
    """Return whether two folders hold the same files."""
    names = [sorted(path.name for path in folder.iterdir()) for folder in (one, other)]
    return names[0] == names[1] and all((one / name).read_bytes() == (other / name).read_bytes() for name in names[0])


def costs_of(record, disk):
    """Return the Costs of a campaign by the measured figures and a disk of stated speed."""
    one = record["one"]
    return Costs(
        frame_s=one["frame_s"], warm_up_frame_s=one["warm_up_frame_s"], warm_up=one["warm_up"],
        # A process starts, loads and compiles; measured as the loading of local workers.
        start_s=max(each["loading_s"] / each["workers"] for each in record["workers"]),
        scene_bytes=one["scene_bytes"], scheduler_s=record["scheduler"]["unit_s"], frame_bytes=one["frame_bytes"],
        # Each file is made, given its name, and moved; so is a record of the frame.
        frame_files=3 * one["frame_files"], disk_bytes_per_s=disk[0], disk_files_per_s=disk[1],
        take_over_s=one["take_over_s"],
    )  # fmt: skip


def simulated(record):
    """Return {disk: [a simulation for each size of block]} of a campaign."""
    return {
        name: [simulate(costs_of(record, disk), CAMPAIGN, CAMPAIGN_WORKERS, block) for block in BLOCKS]
        for name, disk in DISKS.items()
    }


def advice(cases):
    """Return the smallest block within 1 % of the best efficiency, and what is busiest with it."""
    best = max(case["efficiency"] for case in cases)
    case = next(case for case in cases if case["efficiency"] >= 0.99 * best)
    busiest = max(("scheduler", "disk"), key=lambda key: case[key])
    return {"block": case["block"], "efficiency": case["efficiency"], "hours": case["hours"], "busiest": busiest,
            "busy": case[busiest]}  # fmt: skip
