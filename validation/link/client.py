"""One simulator in its own process: `python -m validation.link.client`, with its task as JSON on standard input.

It opens its session, prints "ready", waits for a line, flies, and prints its times as JSON. It imports no renderer.
"""

import json
import sys
import time

from thermorender import link

# Frames that do not count: kernels are compiled, and processes start.
WARM_UP = 5
# Poses per second of a simulation that does not wait.
FREE_HZ = 200.0
# Longest run of a simulation that does not wait [s].
_MOST_S = 120.0


def run(task):
    """Return {latency_ms, render_ms, age_ms: lists, seconds, frames} of a task."""
    with link.connect(port=task["port"], token_path=task["token"]) as server:
        camera = server.open(method=task["method"], map=task["map"], rate_hz=task["rate_hz"], seed=task["seed"])
        poses, products = task["poses"], task["products"]
        for k in range(WARM_UP):
            camera.frame(k / task["rate_hz"], poses[k % len(poses)], products=products)
        print("ready", flush=True)
        sys.stdin.readline()
        found = (_free if task["free"] else _lockstep)(server, camera, task)
    return found


def _lockstep(server, camera, task):
    latency, render, age, start = [], [], [], time.perf_counter()
    for k in range(task["frames"]):
        step, sent = WARM_UP + k, time.perf_counter()
        pose = task["poses"][step % len(task["poses"])]
        reply = camera.frame(step / task["rate_hz"], pose, products=task["products"])
        latency.append(1e3 * (time.perf_counter() - sent))
        render.append(1e3 * reply.render_s)
        age.append(1e3 * reply.age_s)
    return {"latency_ms": latency, "render_ms": render, "age_ms": age, "seconds": time.perf_counter() - start,
            "frames": task["frames"]}  # fmt: skip


def _free(server, camera, task):
    """Poses at a fixed rate; time of the simulation is that of the clock."""
    latency, render, age, sent = [], [], [], {}
    start, step = time.perf_counter(), 0
    server.poll(0.0)
    while len(latency) < task["frames"] and time.perf_counter() - start < _MOST_S:
        at = start + step / FREE_HZ
        reply = server.poll(max(at - time.perf_counter(), 0.0))
        if reply is not None:
            latency.append(1e3 * (time.perf_counter() - sent[reply.id]))
            render.append(1e3 * reply.render_s)
            age.append(1e3 * reply.age_s)
            sent = {number: when for number, when in sent.items() if number > reply.id}
        if time.perf_counter() >= at:
            time_s = (WARM_UP + 1) / task["rate_hz"] + step / FREE_HZ
            pose = task["poses"][int(time_s * task["rate_hz"]) % len(task["poses"])]
            number = camera.send(time_s, pose, products=task["products"], latest=True)
            sent[number] = time.perf_counter()
            step += 1
    return {"latency_ms": latency, "render_ms": render, "age_ms": age, "seconds": time.perf_counter() - start,
            "frames": len(latency)}  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(run(json.loads(sys.stdin.readline()))))
