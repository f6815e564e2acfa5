"""Several hosts on one machine: network namespaces with their own addresses, joined by a bridge."""

import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import ExitStack

from thermorender.errors import ThermorenderError

_NET = "10.213.77"
_BRIDGE = "trbridge"


def several_hosts(folder, workers=2):
    """Return bytes on the network and times of a flight by workers in namespaces, the scheduler in another.

    Returns
    -------
    dict or str
        worker_bytes: received and sent by the hosts of the workers; or why it was not measured.
    """
    if os.name != "posix" or os.geteuid() or shutil.which("ip") is None:
        return "not measured: namespaces need root and ip"
    try:
        with ExitStack() as stack:
            return _measured(folder, workers, stack)
    except subprocess.CalledProcessError as error:
        return f"not measured: {' '.join(error.cmd)} failed: {error.stderr.strip()}"


def _ip(*words):
    return subprocess.run(["ip", *map(str, words)], check=True, capture_output=True, text=True).stdout


def _measured(folder, workers, stack):
    from thermorender.apps.cluster.connect import Address
    from thermorender.apps.cluster.fly import fly
    from thermorender.output import flight as here
    from validation.cluster import study

    _ip("link", "add", _BRIDGE, "type", "bridge")
    stack.callback(_ip, "link", "del", _BRIDGE)
    _ip("addr", "add", f"{_NET}.1/24", "dev", _BRIDGE)
    _ip("link", "set", _BRIDGE, "up")
    names = ["scheduler", *(f"worker{number}" for number in range(workers))]
    for number, name in enumerate(names, 2):
        space, outside = f"tr-{name}", f"trv{number}"
        _ip("netns", "add", space)
        stack.callback(_ip, "netns", "del", space)
        _ip("link", "add", outside, "type", "veth", "peer", "name", "eth0", "netns", space)
        _ip("link", "set", outside, "master", _BRIDGE, "up")
        _ip("-n", space, "addr", "add", f"{_NET}.{number}/24", "dev", "eth0")
        _ip("-n", space, "link", "set", "eth0", "up")
        _ip("-n", space, "link", "set", "lo", "up")

    def start(name, *command):
        process = subprocess.Popen(
            ["ip", "netns", "exec", f"tr-{name}", sys.executable, "-m", *command], stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        stack.callback(process.wait)
        stack.callback(process.kill)

    address = f"tcp://{_NET}.2:8786"
    start("scheduler", "distributed.cli.dask_scheduler", "--host", f"{_NET}.2", "--no-dashboard")
    time.sleep(5.0)
    for number, name in enumerate(names[1:], 3):
        start(name, "distributed.cli.dask_worker", address, "--host", f"{_NET}.{number}", "--nthreads", "1",
              "--no-nanny", "--no-dashboard", "--name", name)  # fmt: skip
    renderer, path, options = study.setting()
    study._remove(folder)
    here.fly(renderer, path, folder / "whole", options)
    before = [_traffic(f"tr-{name}") for name in names]
    clock = time.perf_counter()
    summary = fly(renderer, path, folder / "hosts", Address(scheduler=address), options, block=study.BLOCK)
    wall_s = time.perf_counter() - clock
    after = [_traffic(f"tr-{name}") for name in names]
    bytes_of = {name: [b - a for a, b in zip(one, two, strict=True)]
                for name, one, two in zip(names, before, after, strict=True)}  # fmt: skip
    blocks = sum(each["blocks"] for each in summary["workers"].values())
    return {
        "wall_s": wall_s, "blocks": blocks, "workers": summary["workers"], "received_and_sent_bytes": bytes_of,
        "worker_bytes_per_block": sum(map(sum, list(bytes_of.values())[1:])) / blocks,
        "same": study.same(folder / "whole", folder / "hosts"),
    }  # fmt: skip


def _traffic(space):
    """Bytes received and sent by a namespace."""
    text = _ip("-n", space, "-s", "link", "show", "eth0")
    numbers = re.findall(r"^\s+(\d+)\s+\d+\s+\d+", text, flags=re.M)
    if len(numbers) != 2:
        raise ThermorenderError("`ip -s link` prints no counters; install iproute2")
    return [int(number) for number in numbers]
