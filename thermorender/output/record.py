"""What a frame is told by: its record, and what made it."""

import numpy as np

from thermorender.render.variant import active_device
from thermorender.versions import versions


def record(frame):
    """Return what a frame's line in `frames.jsonl` says: time, pose, seed, plan and targets, as plain values."""
    return {
        "index": frame.index,
        "time_s": frame.time_s,
        "world_from_camera": np.round(frame.pose, 9).tolist(),
        "seed": frame.seed,
        "camera": frame.camera.name,
        "plan": frame.plan,
        "budget_mk": frame.budget_mk and {cause: round(value, 2) for cause, value in frame.budget_mk.items()},
        "targets": frame.targets,
    }


def made_by():
    """Return what makes the frames of this process, as plain values: {"versions": …, "device": …}."""
    return {"versions": versions(), "device": active_device()}
