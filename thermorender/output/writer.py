"""Jobs that threads prepare side by side, and that are finished one at a time in their order."""

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, TypeVar

T = TypeVar("T")

# Threads that prepare jobs; encoders of images do not hold Python's lock.
WORKERS = min(4, os.cpu_count() or 1)
# Most jobs in hand. More wait until one is finished, so that memory is bounded.
MOST = WORKERS + 1


class OrderedWriter(Generic[T]):
    """Prepares jobs in threads and finishes them in the order in which they were put. `finish` gets the result of each
    job, in order, in a thread; then `report`, in the caller's thread, before the next job is finished. `put` or `drain`
    raises an error of a job when its turn comes. Nothing is finished after it, and `discard` gets the results of the
    unfinished jobs. Leaving the block without error finishes all jobs."""

    def __init__(
        self, finish: Callable[[T], object], report: Callable[[T], object], discard: Callable[[T], object]
    ) -> None:
        self._finish, self._report, self._discard = finish, report, discard
        self._preparing = ThreadPoolExecutor(WORKERS, "prepare")
        self._finishing = ThreadPoolExecutor(1, "finish")
        self._jobs: deque[Future[T]] = deque()
        # The first job, while it is finished.
        self._first: Future[T] | None = None

    def __enter__(self) -> "OrderedWriter[T]":
        return self

    def put(self, prepare: Callable[[], T]) -> None:
        """Start a job; wait while too many are in hand."""
        self._jobs.append(self._preparing.submit(prepare))
        self._advance(MOST)

    def drain(self) -> None:
        """Wait until all jobs are finished."""
        self._advance(0)

    def _advance(self, most: int) -> None:
        """Report the jobs that are finished; wait until at most `most` are in hand."""
        while self._jobs:
            if self._first is None:
                self._first = self._finishing.submit(self._finished, self._jobs[0])
            if len(self._jobs) <= most and not self._first.done():
                return
            found = self._first.result()
            self._jobs.popleft()
            self._first = None
            self._report(found)

    def _finished(self, job: "Future[T]") -> T:
        found = job.result()
        self._finish(found)
        return found

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.drain()
        finally:
            self._preparing.shutdown(cancel_futures=True)
            self._finishing.shutdown(cancel_futures=True)
            for job in self._jobs:
                if not job.cancelled() and job.exception() is None:
                    self._discard(job.result())
