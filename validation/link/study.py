"""Latency from request to reply and frames per second of the link, beside frames of the same renderer without it.

The shipped heath from 120 m, looking down from a slow circle, counts. Methods: A rendered, B the visible view
translated, C the translated orthophoto rendered. Clients are processes of their own; with four, each is a vehicle. What
the link costs is the latency minus the time that the server spent on the frame, frame by frame, so that other load of
the machine counts for both.
"""

import json
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np

import thermorender as tr
from thermorender.apps.compare.bench import bench
from thermorender.apps.compare.machine import machine
from thermorender.apps.link.access import token_file
from thermorender.render.flight.live import LiveFrames
from thermorender.trajectory.path import Trajectory
from thermorender.trajectory.rotations import rotation_from_wxyz, wxyz
from thermorender.versions import versions
from validation.drapes import drape, load_drape
from validation.link.client import WARM_UP

SCENE, MAP, RATE_HZ, PRODUCTS = "heath", "fok-1to1", 30.0, ("counts",)
QUALITIES, METHODS = ("fast", "standard"), ("A", "B", "C")
# Allowed cost of a frame's way through the link, median [ms].
AIM_MS = 3.0
HEADER = ("quality", "method", "clients", "latency [ms]", "p99 [ms]", "link [ms]", "p99 [ms]", "frames/s", "beside")
_HEIGHT_M, _RADIUS_M, _SPEED_M_S = 120.0, 30.0, 3.0


def poses(count):
    """Positions and attitudes of a camera on a circle, looking down, (count, 7)."""
    angle = np.arange(count) / RATE_HZ * _SPEED_M_S / _RADIUS_M
    position = np.column_stack([_RADIUS_M * np.sin(angle), _RADIUS_M * np.cos(angle), np.full(count, _HEIGHT_M)])
    down = wxyz(rotation_from_wxyz(np.tile((0.0, 1.0, 0.0, 0.0), (count, 1))))
    return np.column_stack([position, down])


def run(frames, qualities=QUALITIES, methods=METHODS, clients=4, repeats=15, progress=None, device="auto"):
    """Return the result as plain values.

    Parameters
    ----------
    frames : int
        Of each client and case.
    qualities, methods : sequences of str
    clients : int
        At once, in the case with several.
    repeats : int
        Of `bench`.
    progress : callable, optional
        Called with (what, share done).
    device : str
    """
    report, cases, bare = progress or (lambda what, share: None), [], {}
    settings = [(quality, {"quality": quality}) for quality in qualities]
    report("bench", 0.0)
    views = bench((load_drape(SCENE),), repeats, settings=settings, device=device)["scenes"][SCENE]["settings"]
    for number, quality in enumerate(qualities):
        report(f"{quality}: without the link", (number + 0.1) / len(qualities))
        bare[quality] = {"frame_ms": _bare(quality, frames, device),
                         "bench_frames_per_s": views[quality]["views"]["nadir"]["frames_per_s"]}  # fmt: skip
        with _server(quality, device) as port:
            for method in methods:
                for count, free in ((1, False), (clients, False), (1, True)):
                    report(f"{quality}: method {method}, {count} clients", (number + 0.3) / len(qualities))
                    cases.append({"quality": quality, "method": method, "clients": count, "free": free,
                                  **_case(port, method, count, free, frames)})  # fmt: skip
    return {"machine": machine(), "versions": versions(), "frames": frames, "aim_ms": AIM_MS, "bare": bare,
            "cases": cases}  # fmt: skip


def _bare(quality, frames, device):
    """Median time of a frame of the same path with its counts, in this process [ms]."""
    renderer, way, spent = tr.Renderer(load_drape(SCENE), quality, device=device), poses(WARM_UP + frames), []
    live = LiveFrames(renderer, RATE_HZ)
    for k, row in enumerate(way):
        start = time.perf_counter()
        _ = live.take(k / RATE_HZ, Trajectory([k / RATE_HZ], row[None, :3], row[None, 3:])).counts
        spent.append(1e3 * (time.perf_counter() - start))
    return float(np.median(spent[WARM_UP:]))


@contextmanager
def _server(quality, device):
    """The port of a server."""
    command = [sys.executable, "-m", "thermorender", "serve", str(drape(SCENE)), "--port", "0", "--map", MAP,
               "--quality", quality, "--device", device]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        yield int(line.split(" port ")[1].split(";")[0])
    finally:
        process.terminate()
        process.communicate(timeout=60)


def _case(port, method, count, free, frames):
    """Latency and frames per second of some clients at once."""
    task = {"port": port, "token": str(token_file("127.0.0.1", port)), "method": method,
            "map": "" if method == "A" else MAP, "rate_hz": RATE_HZ, "products": PRODUCTS, "frames": frames,
            "free": free, "poses": poses(600).tolist()}  # fmt: skip
    command = [sys.executable, "-m", "validation.link.client"]
    started = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(count)
    ]
    try:
        for seed, process in enumerate(started):
            process.stdin.write(json.dumps({**task, "seed": seed}) + "\n")
            process.stdin.flush()
        for process in started:
            assert process.stdout.readline() == "ready\n"
        for process in started:
            process.stdin.write("go\n")
            process.stdin.flush()
        found = [json.loads(process.communicate(timeout=600)[0]) for process in started]
    finally:
        for process in started:
            process.kill()
            process.wait()
    latency, render, age = (
        np.concatenate([each[key] for each in found]) for key in ("latency_ms", "render_ms", "age_ms")
    )
    # Of several clients, one also waits for the frames of the others.
    cost = latency - (render if count == 1 and not free else age)
    return {
        "latency_ms": float(np.median(latency)), "latency_p99_ms": float(np.percentile(latency, 99)),
        "link_ms": float(np.median(cost)), "link_p99_ms": float(np.percentile(cost, 99)),
        "render_ms": float(np.median(render)), "age_ms": float(np.median(age)),
        "frames_per_s": sum(each["frames"] for each in found) / max(each["seconds"] for each in found),
    }  # fmt: skip


def rows(result):
    """Return a result as table rows of text under HEADER."""
    lines = [
        (quality, "bare", "", f"{bare['frame_ms']:.1f}", "", "", "", f"{1e3 / bare['frame_ms']:.1f}",
         f"bench {bare['bench_frames_per_s']:.1f}")
        for quality, bare in result["bare"].items()
    ]  # fmt: skip
    return lines + [
        (each["quality"], each["method"], f"{each['clients']}{', free' if each['free'] else ''}",
         f"{each['latency_ms']:.1f}", f"{each['latency_p99_ms']:.1f}", f"{each['link_ms']:.2f}",
         f"{each['link_p99_ms']:.2f}", f"{each['frames_per_s']:.1f}", "")
        for each in result["cases"]
    ]  # fmt: skip
