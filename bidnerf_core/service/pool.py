"""The workers of the service: a bounded queue in front of processes that may be stopped or killed at any
time.

A request whose worker dies is given to another one. If a request takes too long, or its client disconnects,
its worker is killed and replaced by a fork within milliseconds, so no computation continues that nobody waits
for.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.service import wire
from bidnerf_core.service.metrics import Metrics
from bidnerf_core.service.settings import MEBIBYTE, ChosenMethod, ServiceLimits

ATTEMPTS = 3
"""Number of workers that a request may crash before it is answered with an error."""
FORK_SECONDS = 60.0
"""Time for a new worker to report; on an accelerator it copies the maps first."""
PAUSE = 1.0
"""Seconds between two attempts to reload the maps after the process that holds them was killed."""


class Full(Exception):
    """The service already has as many requests as it accepts."""


class TimedOut(Exception):
    """A request was not answered in time."""


class Lost(Exception):
    """Every worker that took the request died."""


@dataclass(eq=False)
class Job:
    """A request that waits for a worker, or is being processed."""

    kind: str  # "localize" or "geopose"
    map: str | None  # None: the one that the photo shows
    parameters: Mapping[str, Any]
    blocks: Mapping[str, bytes]
    deadline: float  # in the event loop's clock
    answer: asyncio.Future[dict[str, Any]]
    body: Mapping[str, Any] | None = None  # of a GeoPose Protocol request
    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    began: float = field(default_factory=time.perf_counter)
    waited: float | None = None  # seconds, once processing has begun
    attempts: int = 0

    @property
    def head(self) -> dict[str, Any]:
        """Content sent to a worker in addition to the blocks."""
        return {
            "id": self.id,
            "kind": self.kind,
            "map": self.map,
            "parameters": self.parameters,
            "body": self.body,
        }


class WorkerProcess:
    """A running worker, as seen by the service."""

    def __init__(self, pid: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.pid, self._reader, self._writer = pid, reader, writer

    @property
    def ended(self) -> bool:
        """Whether the process is known to have ended."""
        return self._reader.at_eof() or self._writer.is_closing()

    async def ask(self, job: Job) -> dict[str, Any]:
        """Send a job to the worker and return its answer.

        Raises ``EOFError`` or ``OSError`` if the worker exits before answering.
        """
        for part in wire.packed(job.head, job.blocks):
            self._writer.write(part)
            await self._writer.drain()
        return await wire.read(self._reader)

    def stop(self) -> None:
        """End the process immediately."""
        if not self.ended:  # otherwise its number may belong to another process
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        self._writer.close()


class Pool:
    """The worker processes and their queue. All methods must run in the same event loop."""

    def __init__(self, maps: Mapping[str, Path], limits: ServiceLimits, method: ChosenMethod) -> None:
        self.limits, self.metrics = limits, Metrics()
        self.described: dict[str, Any] = {}
        self._order = {"maps": {name: str(folder) for name, folder in maps.items()}} | asdict(method)
        self._waiting: deque[Job] = deque()
        self._changed = asyncio.Condition()
        self._workers: dict[int, WorkerProcess] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._nursery: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._loading = asyncio.Lock()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._taken = 0
        self.metrics.gauges = {
            "queue_length": ("Requests that wait for a worker.", lambda: len(self._waiting)),
            "requests_in_progress": ("Requests that are uploading, waiting or at work.", lambda: self._taken),
            "workers": ("Workers that are alive.", lambda: len(self.alive)),
        }
        self.metrics.processes = lambda: {
            "service": [os.getpid()],
            "maps": [] if self._nursery is None else [self._nursery.pid],
            "workers": [worker.pid for worker in self.alive],
        }

    @property
    def alive(self) -> list[WorkerProcess]:
        """The workers that have not ended."""
        return [worker for worker in self._workers.values() if not worker.ended]

    async def start(self) -> None:
        """Load the maps and fork the workers. Raises ``InputError`` if the maps cannot be served."""
        self._folder = tempfile.TemporaryDirectory(prefix="bidnerf-serve-", ignore_cleanup_errors=True)
        try:
            await self._load()
            self._workers[0] = await self._fork()
        except BaseException as error:
            await self.close()
            if isinstance(error, OSError | EOFError):
                raise InputError("the process that loads the maps died; was memory short?") from error
            raise
        self._tasks = [asyncio.create_task(self._work(number)) for number in range(self.limits.processes)]

    async def close(self) -> None:
        """End all processes and remove their leftovers."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for worker in self._workers.values():
            worker.stop()
        self._end_loading(group=True)
        for job in self._waiting:
            job.answer.cancel()
        if self._folder is not None:
            self._folder.cleanup()

    @contextlib.contextmanager
    def place(self) -> Iterator[None]:
        """Hold one of the service's places for requests. Raises ``Full`` if none is left."""
        if self._taken >= self.limits.places:
            raise Full
        self._taken += 1
        try:
            yield
        finally:
            self._taken -= 1

    @property
    def retry_after(self) -> int:
        """Whole seconds after which a place is likely to be free."""
        counted = sum(self.metrics.seconds.counts)
        mean = self.metrics.seconds.total / counted if counted else 1.0
        return max(1, min(60, round(mean * self.limits.queue / self.limits.processes)))

    async def answer(self, job: Job) -> dict[str, Any]:
        """Return a worker's answer to a request; cancelling the call stops the work.

        Raises ``TimedOut``, and ``Lost`` if the request keeps crashing its workers.
        """
        async with self._changed:
            self._waiting.append(job)
            self._changed.notify()
        loop = asyncio.get_running_loop()
        late = loop.call_at(
            job.deadline, lambda: None if job.answer.done() else job.answer.set_exception(TimedOut())
        )
        try:
            return await job.answer
        finally:
            late.cancel()
            if job in self._waiting:
                self._waiting.remove(job)

    async def _work(self, number: int) -> None:
        """Keep one worker alive and give it one request after another."""
        worker = self._workers.get(number)
        while True:
            if worker is None or worker.ended:
                if worker is not None:
                    self.metrics.restarts["ended"] += 1
                    worker.stop()
                worker = self._workers[number] = await self._forked()
            job = await self._next(worker)
            if job is not None and not await self._answered(job, worker):
                worker = None

    async def _next(self, worker: WorkerProcess) -> Job | None:
        """Return the next request, or None if the worker has ended."""
        async with self._changed:
            while not worker.ended:
                while self._waiting:
                    job = self._waiting.popleft()
                    if not job.answer.done():
                        return job
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), PAUSE)  # also to notice a killed worker
        return None

    async def _answered(self, job: Job, worker: WorkerProcess) -> bool:
        """Let a worker answer; return whether it continues or was stopped. A request whose worker died waits
        for another one.
        """
        job.attempts += 1
        if job.waited is None:
            job.waited = time.perf_counter() - job.began
            self.metrics.waited.add(job.waited)
        asking = asyncio.ensure_future(worker.ask(job))
        try:
            await asyncio.wait({asking, job.answer}, return_when=asyncio.FIRST_COMPLETED)
            if asking.done() and asking.exception() is None:
                if not job.answer.done():
                    job.answer.set_result({**asking.result(), "worker": worker.pid})
                return True
        finally:
            if not asking.done():
                asking.cancel()
            await asyncio.wait({asking})  # raises nothing but a cancellation of this task itself
            if not asking.cancelled():
                asking.exception()  # mark as retrieved, or it would be reported as never retrieved
        worker.stop()  # before its files are removed, or it would write more
        self._forget_files(job)
        if job.answer.done():  # timed out, or its client disconnected
            late = not job.answer.cancelled()
            self.metrics.restarts["timeout" if late else "cancelled"] += 1
            return False
        self.metrics.restarts["died"] += 1
        if job.attempts >= ATTEMPTS:
            job.answer.set_exception(Lost())
        else:
            async with self._changed:
                self._waiting.appendleft(job)
                self._changed.notify()
        return False

    def _forget_files(self, job: Job) -> None:
        if self._folder is not None:
            shutil.rmtree(Path(self._folder.name) / job.id, ignore_errors=True)

    async def _forked(self) -> WorkerProcess:
        """Return a new worker. If the process that holds the maps has ended, they are reloaded first."""
        while True:
            try:
                return await asyncio.wait_for(self._fork(), FORK_SECONDS)
            except (OSError, EOFError, TimeoutError, InputError):
                async with self._loading:
                    if self._nursery is None or self._nursery.poll() is not None:
                        self.metrics.restarts["maps"] += 1
                        with contextlib.suppress(InputError, OSError, EOFError):
                            await self._load()
                await asyncio.sleep(PAUSE)

    async def _fork(self) -> WorkerProcess:
        if self._control is None:
            raise EOFError
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                socket.send_fds(self._control, [wire.ANOTHER], [theirs.fileno()])
            except OSError:
                ours.close()
                raise
        reader, writer = await asyncio.open_connection(sock=ours, limit=4 * MEBIBYTE)
        try:
            hello = await wire.read(reader)
        except BaseException:
            writer.close()
            raise
        if "error" in hello:
            writer.close()
            raise InputError(hello["error"])
        return WorkerProcess(hello["pid"], reader, writer)

    async def _load(self) -> None:
        """Start the process that loads the maps. Raises ``InputError`` if it cannot serve them."""
        self._end_loading(group=False)
        assert self._folder is not None
        ours, theirs = socket.socketpair()
        with theirs:
            self._nursery = subprocess.Popen(
                [sys.executable, "-m", "bidnerf_core.service.nursery", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C reaches only this process, which then ends the others
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        self._control = ours
        order = {**self._order, "max_pixels": self.limits.max_megapixels * 1e6, "folder": self._folder.name}
        reply = await asyncio.to_thread(_ordered, ours, order)
        if reply is None:
            raise InputError("the process that loads the maps died; was memory short?")
        if "error" in reply:
            raise InputError(reply["error"])
        self.described = reply["maps"]

    def _end_loading(self, group: bool) -> None:
        """End the process that holds the maps and, with ``group``, the workers that it forked."""
        if self._control is not None:
            self._control.close()  # it then ends all workers, if it is alive
            self._control = None
        if self._nursery is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                if group:
                    os.killpg(self._nursery.pid, signal.SIGKILL)
                self._nursery.kill()
            self._nursery.wait()
            self._nursery = None


def _ordered(control: socket.socket, order: Mapping[str, Any]) -> dict[str, Any] | None:
    try:
        wire.send(control, order)
        reply = wire.receive(control)
    except OSError:
        return None
    return None if reply is None else reply[0]
