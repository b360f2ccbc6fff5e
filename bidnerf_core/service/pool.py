"""The worker processes of the service, which may be stopped or killed at any time.

Each worker has a thread here, which gives it one request after another. A request whose worker dies is given to a new
one. If a request takes too long, or its client disconnects, its worker is killed and replaced by a fork within
milliseconds, so no computation continues that nobody waits for. A pool of the standard library would lose all its
requests with one worker, cannot stop one, and would load the maps anew in each.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

import psutil

from bidnerf_core.errors import InputError
from bidnerf_core.service.jobs import Job, Queue
from bidnerf_core.service.metrics import Metrics
from bidnerf_core.service.settings import ServiceLimits

FORK_SECONDS = 60.0
"""Time for a new worker to report; on an accelerator it copies the maps first."""
PAUSE = 1.0
"""Seconds between two looks at an idle worker, and between two attempts to reload the maps."""
LOST = (OSError, EOFError, ValueError, psutil.Error)
"""The exceptions that a connection raises if the process at its other end has died or sends nonsense."""


class Lost(Exception):
    """Every worker that took the request died."""


class WorkerProcess:
    """A running worker, as seen by the service."""

    def __init__(self, connection: Connection) -> None:
        """Wait for a new worker's first message. Raises ``InputError`` if the worker cannot serve, and ``LOST`` if it died."""
        self._connection = connection
        if not connection.poll(FORK_SECONDS):
            raise TimeoutError
        self.pid: int = _reply(connection)["pid"]
        # It remembers when the process began, since its number may later be that of another.
        self._process = psutil.Process(self.pid)

    @property
    def ended(self) -> bool:
        """Whether an idle worker has ended: only the end of the connection makes it readable."""
        try:
            return self._connection.poll()
        except OSError:  # it is closed
            return True

    def ask(self, task: Any) -> dict[str, Any]:
        """Return the worker's answer. Raises ``LOST`` if it exits before answering."""
        self._connection.send(task)
        return _reply(self._connection) | {"worker": self.pid}

    def kill(self) -> None:
        """Kill the process; ``ask`` then raises in the thread that waits there."""
        with contextlib.suppress(psutil.NoSuchProcess):
            self._process.kill()


def _reply(connection: Connection) -> dict[str, Any]:
    """Return the JSON that a process sends. Raises ``InputError`` if it states an error, and ``LOST`` if the process died."""
    reply: dict[str, Any] = json.loads(connection.recv_bytes(2**24))  # at most 16 MiB
    if "error" in reply:
        raise InputError(reply["error"])
    return reply


class Pool:
    """The workers of a service and the threads that give them the jobs of its queue."""

    def __init__(self, order: dict[str, Any], limits: ServiceLimits) -> None:
        """``order`` is what the process that loads the maps gets, see ``worker.main``."""
        self.queue = Queue(limits.processes + limits.queue, self._retry_after)
        self.described: dict[str, Any] = {}
        self._order, self._limits = order, limits
        self._workers: dict[int, WorkerProcess] = {}
        self._busy: set[int] = set()
        self._maps: tuple[subprocess.Popen[bytes], socket.socket] | None = None
        self._loading = threading.Lock()
        self._threads: list[threading.Thread] = []
        self.metrics = Metrics(
            {
                "queue_length": ("Requests that wait for a worker.", lambda: self.queue.waiting),
                "requests_in_progress": ("Requests that are uploading, waiting or at work.", lambda: self.queue.taken),
                "workers": ("Workers that are alive.", lambda: len(self.alive)),
            },
            {
                "service": lambda: [os.getpid()],
                "maps": lambda: [] if self._maps is None else [self._maps[0].pid],
                "workers": lambda: self.alive,
            },
        )  # fmt: skip

    @property
    def alive(self) -> list[int]:
        """The process ids of the workers that have not ended."""
        workers = list(self._workers.items())
        return [worker.pid for number, worker in workers if number in self._busy or not worker.ended]

    def _retry_after(self) -> int:
        mean = self.metrics.mean_seconds
        return max(1, min(60, round(mean * self._limits.queue / self._limits.processes)))

    def start(self) -> None:
        """Load the maps and fork the workers. Raises ``InputError`` if the maps cannot be served."""
        try:
            self._load()
            self._workers[0] = self._fork()
        except BaseException as error:
            self.close()
            if isinstance(error, LOST) and not isinstance(error, InputError):
                raise InputError("the process that loads the maps died; was memory short?") from error
            raise
        for number in range(self._limits.processes):
            thread = threading.Thread(target=self._work, args=[number], name=f"worker {number}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def close(self) -> None:
        """End all processes and remove their leftovers."""
        self.queue.close()
        for worker in list(self._workers.values()):
            worker.kill()
        self._end_maps(group=True)
        for thread in self._threads:
            thread.join(2 * PAUSE)
        self._end_maps(group=True)  # one that a thread was loading

    def _work(self, number: int) -> None:
        """Keep one worker alive and give it one job after another."""
        while not self.queue.closed:
            worker = self._workers.get(number)
            if worker is None or worker.ended:
                self._replace(number, "ended")
                continue
            job = self.queue.next(PAUSE)
            if job is not None:
                self._busy.add(number)
                try:
                    job.result.set_result(self._answered(job, number))
                except Exception as error:  # of this process, such as a full disk; the request reports it
                    job.result.set_exception(error)
                finally:
                    self._busy.discard(number)

    def _answered(self, job: Job, number: int) -> dict[str, Any] | None:
        """Return a worker's answer to a job, or None if the job was stopped. Raises ``Lost`` if three workers died of it."""
        self.metrics.waited.observe(job.waited or 0.0)
        os.makedirs(tempfile.gettempdir(), exist_ok=True)  # something may have removed it
        while job.attempts < 3 and (worker := self._workers.get(number)) is not None:
            if worker.ended:  # it ended since it was last looked at, and not because of this job
                self._replace(number, "ended")
                continue
            job.attempts += 1
            with tempfile.TemporaryDirectory(prefix="bidnerf-serve-", ignore_cleanup_errors=True) as folder:
                try:
                    with job.killed_by(worker.kill):
                        return worker.ask((job.task, folder))
                except LOST:
                    self._replace(number, job.stopped or "died")
            if job.stopped:
                return None
        raise Lost

    def _replace(self, number: int, reason: str) -> None:
        """Fork a worker in the place of one that has ended or is killed here.

        If the process that holds the maps has ended or does not answer, they are reloaded first.
        """
        worker = self._workers.pop(number, None)
        if worker is not None:
            worker.kill()
            self.metrics.restarts.labels(reason=reason).inc()
        while number not in self._workers and not self.queue.closed:
            with self._loading:
                try:
                    if self._maps is None:
                        self._load()
                    self._workers[number] = self._fork()
                    return
                except InputError:
                    # The error is the worker's own, such as too little memory on its accelerator, and reloading the maps would
                    # not help. If the maps cannot be served, their process ends, which is noticed when it is to fork.
                    pass
                except LOST:
                    self._end_maps()
                    self.metrics.restarts.labels(reason="maps").inc()
            time.sleep(PAUSE)

    def _fork(self) -> WorkerProcess:
        """Return a new worker. Raises as ``WorkerProcess`` does."""
        ours, theirs = socket.socketpair()
        connection = Connection(ours.detach())
        with theirs:
            if self._maps is None:  # the pool is being closed
                raise EOFError
            socket.send_fds(self._maps[1], [b"w"], [theirs.fileno()])
        return WorkerProcess(connection)

    def _load(self) -> None:
        """Start the process that loads the maps. Raises ``InputError`` if it cannot serve them, and ``LOST`` if it dies."""
        ours, theirs = socket.socketpair()
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-m", "bidnerf_core.service.worker", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C reaches only this process, which then ends the others
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        self._maps = process, ours
        with Connection(os.dup(ours.fileno())) as connection:
            connection.send(self._order)
            self.described = _reply(connection)["maps"]

    def _end_maps(self, group: bool = False) -> None:
        """Kill the process that holds the maps and, with ``group``, the workers that it forked."""
        if self._maps is None:
            return
        process, control = self._maps
        self._maps = None
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if group:
                os.killpg(process.pid, signal.SIGKILL)
            process.kill()
        process.wait()
        control.close()
