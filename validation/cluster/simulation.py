"""A campaign on many workers, event by event: workers, one scheduler, one shared disk.

Scheduler and disk serve one request at a time, in the order of arrival. A worker asks the scheduler for a block,
renders the frames of the warm-up and of the block, and waits until the disk has taken the block's files. A worker that
comes for the first time reads the scene from the disk. At the end, one process takes over the records.
"""

import heapq
from dataclasses import dataclass


@dataclass(frozen=True)
class Costs:
    """What one piece of work costs.

    Attributes
    ----------
    frame_s, warm_up_frame_s : float
        Of one core [s].
    warm_up : int
        Frames.
    start_s, scene_bytes : float
        Of each worker, once.
    scheduler_s : float
        Of each block.
    frame_bytes : float
    frame_files : int
    disk_bytes_per_s, disk_files_per_s : float
    take_over_s : float
        Of each frame, in one process, at the end.
    """

    frame_s: float
    warm_up_frame_s: float
    warm_up: int
    start_s: float
    scene_bytes: float
    scheduler_s: float
    frame_bytes: float
    frame_files: int
    disk_bytes_per_s: float
    disk_files_per_s: float
    take_over_s: float


class _Server:
    """Serves one request at a time."""

    def __init__(self):
        self.free_s = self.busy_s = 0.0

    def serve(self, asked_s, takes_s):
        """Return when a request is served."""
        self.free_s = max(self.free_s, asked_s) + takes_s
        self.busy_s += takes_s
        return self.free_s


def simulate(costs, frames, workers, block):
    """Return the times of a campaign.

    Returns
    -------
    dict
        hours: until all frames are taken over; efficiency: rendering alone over all workers' time; shares of the time
        in which scheduler and disk are busy, and of all workers' time that the warm-up takes; take_over_hours.
    """
    scheduler, disk = _Server(), _Server()
    blocks, given, end, warm = -(-frames // block), 0, 0.0, 0.0
    # (time, worker, what it asks for, frames); in the order of time, so that both servers see requests as they come.
    coming = [(0.0, worker, "scene", 0) for worker in range(workers)]
    while coming:
        now, worker, wanted, size = heapq.heappop(coming)
        if wanted == "scene":
            now = disk.serve(now, costs.scene_bytes / costs.disk_bytes_per_s) + costs.start_s
            heapq.heappush(coming, (now, worker, "block", 0))
        elif wanted == "write":
            takes = size * (costs.frame_bytes / costs.disk_bytes_per_s + costs.frame_files / costs.disk_files_per_s)
            end = disk.serve(now, takes)
            heapq.heappush(coming, (end, worker, "block", 0))
        elif given < blocks:
            size = min(block, frames - given * block)
            warm_s = costs.warm_up * costs.warm_up_frame_s if given else 0.0
            given, warm = given + 1, warm + warm_s
            now = scheduler.serve(now, costs.scheduler_s) + warm_s + size * costs.frame_s
            heapq.heappush(coming, (now, worker, "write", size))
    take_over = frames * costs.take_over_s
    return {
        "block": block, "workers": workers, "frames": frames, "hours": (end + take_over) / 3600.0,
        "efficiency": frames * costs.frame_s / (workers * (end + take_over)),
        "scheduler": scheduler.busy_s / end, "disk": disk.busy_s / end, "warm_up": warm / (workers * end),
        "take_over_hours": take_over / 3600.0,
    }  # fmt: skip
