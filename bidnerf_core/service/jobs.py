"""The bounded queue of jobs that requests wait in, for the threads that do them."""

from __future__ import annotations

import contextlib
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

from bidnerf_core.service.models import Refused


class Job:
    """What a request asks for: it has a place in the queue from the arrival of the request until ``result`` is known."""

    def __init__(self, name: str = "") -> None:
        self.name, self.id = name, uuid.uuid4().hex
        self.task: Any = None  # what is to be done, once it is known
        self.result = Future[Any]()
        self.began = time.perf_counter()
        self.waited: float | None = None  # seconds, once a thread has taken it
        self.attempts = 0
        self.stopped = ""  # the reason, if nobody wants the result any more
        self._kill: Callable[[], None] | None = None
        self._lock = threading.Lock()

    def stop(self, reason: str) -> None:
        """Give the job up, unless it is done: it leaves the queue, or what works on it is killed."""
        with self._lock:
            if not self.result.done():
                self.stopped = self.stopped or reason
                if not self.result.cancel() and self._kill is not None:
                    self._kill()

    @contextlib.contextmanager
    def killed_by(self, kill: Callable[[], None]) -> Iterator[None]:
        """Let ``stop`` call ``kill`` within the block, at once if it was called before."""
        with self._lock:
            self._kill = kill
            if self.stopped:
                kill()
        try:
            yield
        finally:
            with self._lock:
                self._kill = None


class Queue:
    """Jobs in the order of their arrival, at most ``places`` of them: uploading, waiting and at work.

    ``retry_after`` returns the whole seconds after which a place is likely to be free.
    """

    def __init__(self, places: int, retry_after: Callable[[], int] = lambda: 5) -> None:
        self.places, self.taken, self.closed = places, 0, False
        self._retry_after = retry_after
        self._waiting = deque[Job]()
        self._changed = threading.Condition()

    @property
    def waiting(self) -> int:
        """The number of jobs that wait for a thread."""
        return len(self._waiting)

    def enter(self, name: str = "") -> Job:
        """Return a new job, which has a place until it is done or stopped. Raises ``Refused`` if no place is left."""
        with self._changed:
            if self.taken >= self.places:
                headers = {"Retry-After": str(self._retry_after()), "Connection": "close"}
                raise Refused(429, f"all {self.places} places are taken, try again later", headers)
            self.taken += 1
        job = Job(name)
        job.result.add_done_callback(lambda _: self._leave(job))
        return job

    @contextlib.contextmanager
    def place(self, name: str = "") -> Iterator[Job]:
        """Enter a job, which is stopped if the block raises an error, also ``Refused`` if no place is left."""
        job = self.enter(name)
        try:
            yield job
        except BaseException as error:
            job.stop("timeout" if isinstance(error, Refused) and error.status == 504 else "cancelled")
            raise

    def put(self, job: Job, task: Any) -> None:
        """Let a job wait for a thread that does ``task``."""
        job.task = task
        with self._changed:
            self._waiting.append(job)
            self._changed.notify()

    def next(self, timeout: float | None = None) -> Job | None:
        """Wait for the next job; return None if none arrives within ``timeout`` seconds, or the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._waiting, timeout)
            job = self._waiting.popleft() if self._waiting and not self.closed else None
        if job is None or not job.result.set_running_or_notify_cancel():
            return None
        job.waited = time.perf_counter() - job.began
        return job

    def close(self) -> None:
        """Give up the jobs that wait, and let threads return from ``next``."""
        with self._changed:
            self.closed = True
            waiting = list(self._waiting)
            self._changed.notify_all()
        for job in waiting:
            job.stop("closed")

    def _leave(self, job: Job) -> None:
        with self._changed:
            self.taken -= 1
            if job in self._waiting:
                self._waiting.remove(job)
