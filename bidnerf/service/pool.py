"""The worker processes of the service, which may be stopped or killed at any time.

A request whose worker dies is passed to another worker. If a request takes too long, or its client disconnects, the
worker is killed and replaced by a fork within milliseconds, so that no computation continues after its client has
left. A process pool of the standard library would lose all its requests when one worker dies, cannot stop a single
worker, and would load the maps again in every worker.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
import time
from functools import partial
from typing import Any

import psutil
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from bidnerf.service.models import Refused
from bidnerf.service.queue import RequestQueue
from bidnerf.service.settings import ServiceLimits
from bidnerf_core.errors import InputError

FORK_SECONDS = 60.0
"""Seconds within which a new worker must report; with an accelerator, it first copies the maps there."""
PAUSE = 1.0
"""Seconds between two attempts to fork a worker."""
LOST = (OSError, EOFError, ValueError, psutil.Error)
"""The exceptions that reading from a process raises if the process has died or sends invalid data."""


class Worker:
    """A running worker process, which answers one request at a time."""

    def __init__(self, pid: int, writer: asyncio.StreamWriter) -> None:
        self.pid, self.stopped, self.ended = pid, "", False
        self.reply = asyncio.get_running_loop().create_future()
        self.reply.cancel()  # no task has been sent yet
        self._writer = writer
        # psutil remembers when the process began, since another process may later have the same number.
        self._process = psutil.Process(pid)

    async def ask(self, task: Any) -> dict[str, Any]:
        """Send a task to the worker and return its answer. Raises one of ``LOST`` if the worker exits before answering."""
        self.reply = asyncio.get_running_loop().create_future()
        self._writer.write(pickle.dumps(task))
        return json.loads(await self.reply) | {"worker": self.pid}

    def kill(self) -> None:
        """Kill the process."""
        self.ended = True
        self._writer.close()
        with contextlib.suppress(psutil.NoSuchProcess):
            self._process.kill()


class Pool:
    """The workers of a service, which share the memory of its maps, and the requests that are waiting for a worker."""

    def __init__(self, order: dict[str, Any], limits: ServiceLimits) -> None:
        """Create a pool that is not yet started; ``order`` is the message for the process that loads the maps, see ``worker.main``."""
        self.map_facts: dict[str, Any] = dict.fromkeys(order["maps"])
        self.queue = RequestQueue[Worker](limits.processes + limits.queue, self.retry_after)
        self.workers = list[Worker]()
        self._order, self._limits = order, limits
        self._keepers = list[asyncio.Task[None]]()
        self._maps: tuple[subprocess.Popen[bytes], socket.socket] | None = None
        self._loading = asyncio.Lock()
        self.registry = CollectorRegistry()
        buckets = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)  # seconds
        count = partial(Counter, registry=self.registry)
        times = partial(Histogram, registry=self.registry, buckets=buckets)
        self.requests = count("bidnerf_requests", "Requests answered.", ["path", "status"])
        self.outcomes = count("bidnerf_outcomes", "Localizations by their outcome.", ["map", "outcome"])
        self.restarts = count("bidnerf_worker_restarts", "Workers replaced.", ["reason"])
        self.seconds = times("bidnerf_request_seconds", "From the arrival of a request to its answer.")
        self.waited = times("bidnerf_queue_seconds", "Waiting for a worker.")
        gauge = partial(Gauge, registry=self.registry)
        gauge("bidnerf_queue_length", "Requests that wait for a worker.").set_function(lambda: self.queue.waiting)
        gauge("bidnerf_requests_in_progress", "Requests that are uploading, waiting or at work.").set_function(
            lambda: self.queue.taken
        )
        gauge("bidnerf_workers", "Workers that are alive.").set_function(lambda: len(self.workers))

    def metric(self, name: str, **labels: str) -> float:
        """Return the current value of a metric, or 0 if it was never counted."""
        return self.registry.get_sample_value(f"bidnerf_{name}", labels) or 0.0

    def retry_after(self) -> int:
        """Return the seconds after which a client that found no free slot may try again, from the mean duration of a request."""
        mean = self.metric("request_seconds_sum") / max(1.0, self.metric("request_seconds_count")) or 1.0
        return max(1, min(60, round(mean * self._limits.queue / self._limits.processes)))

    async def answer(self, task: Any, facts: dict[str, Any]) -> dict[str, Any]:
        """Return a worker's answer to a request. Raises ``Refused`` if every worker that took the request died.

        Cancelling this call kills the worker that is processing the request; the cancellation message gives the
        reason.
        """
        began = time.perf_counter()
        os.makedirs(tempfile.gettempdir(), exist_ok=True)  # something may have removed it
        for attempt in (1, 2, 3):  # the request is refused if three workers die of it
            async with self.queue.executor() as worker:
                if attempt == 1:
                    facts["waited"] = round(time.perf_counter() - began, 4)
                    self.waited.observe(facts["waited"])
                facts["attempts"] = attempt
                with tempfile.TemporaryDirectory(prefix="bidnerf-serve-", ignore_cleanup_errors=True) as folder:
                    try:
                        return await worker.ask((task, folder))
                    except LOST:
                        worker.kill()
                    except asyncio.CancelledError as error:
                        worker.stopped = str(error) or "cancelled"
                        worker.kill()
                        raise
        raise Refused(422, "each of three workers that read this request ended; is the photo damaged, or memory short?")

    async def start(self) -> None:
        """Load the maps and fork the workers. Raises ``InputError`` if the maps cannot be served."""
        try:
            await self._load()
            first = await self._fork()
        except BaseException as error:
            await self.close()
            if isinstance(error, LOST) and not isinstance(error, InputError):
                raise InputError("the process that loads the maps died; was memory short?") from error
            raise
        new = [first, *[None] * (self._limits.processes - 1)]
        self._keepers = [asyncio.create_task(self._keep(worker)) for worker in new]

    async def close(self) -> None:
        """Stop all processes."""
        for keeper in self._keepers:
            keeper.cancel()
        await asyncio.gather(*self._keepers, return_exceptions=True)
        self._end_maps(group=True)

    async def _keep(self, new: tuple[Worker, asyncio.StreamReader] | None) -> None:
        """Keep one worker running: pass its answers to the callers, and replace the worker whenever it ends."""
        while True:
            worker, reader = new or await self._replacement()
            self.workers.append(worker)
            self.queue.add(worker)
            try:
                with contextlib.suppress(*LOST):
                    while (line := await reader.readline()) and not worker.reply.done():
                        worker.reply.set_result(line)
            finally:
                self.workers.remove(worker)
                worker.kill()
            reason = worker.stopped or ("ended" if worker.reply.done() else "died")
            if reason == "died":
                worker.reply.set_exception(EOFError())
            self.restarts.labels(reason=reason).inc()
            new = None

    async def _replacement(self) -> tuple[Worker, asyncio.StreamReader]:
        """Fork a new worker, after reloading the maps if the process that holds them has ended or does not answer."""
        while True:
            async with self._loading:
                try:
                    if self._maps is None:
                        await self._load()
                    return await self._fork()
                except InputError:
                    # The error concerns only the worker, such as too little memory on its accelerator, so reloading the maps would
                    # not help. If the maps cannot be served, the process that loads them ends, which the next fork detects.
                    pass
                except LOST:
                    self._end_maps()
                    self.restarts.labels(reason="maps").inc()
            await asyncio.sleep(PAUSE)

    async def _fork(self) -> tuple[Worker, asyncio.StreamReader]:
        """Fork a worker and return it with the stream of its answers. Raises the same errors as ``_read_greeting``."""
        assert self._maps is not None
        ours, theirs = socket.socketpair()
        with theirs:
            socket.send_fds(self._maps[1], [b"w"], [theirs.fileno()])
        greeting, reader, writer = await _read_greeting(ours, FORK_SECONDS)
        return Worker(greeting["pid"], writer), reader

    async def _load(self) -> None:
        """Start the process that loads the maps. Raises the same errors as ``_read_greeting``."""
        ours, theirs = socket.socketpair()
        with theirs:
            process = subprocess.Popen(
                # -P: no module is imported from the current folder, which may hold anything.
                [sys.executable, "-P", "-m", "bidnerf.service.worker", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C reaches only this process, which then ends the others
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        self._maps = process, ours
        ours.sendall(pickle.dumps(self._order))
        greeting, _, writer = await _read_greeting(ours.dup(), None)
        writer.close()
        self.map_facts = greeting["maps"]

    def _end_maps(self, group: bool = False) -> None:
        """Kill the process that holds the maps and, if ``group`` is set, also the workers that it forked."""
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


async def _read_greeting(
    connection: socket.socket, seconds: float | None
) -> tuple[dict[str, Any], asyncio.StreamReader, asyncio.StreamWriter]:
    """Return the first message of a new process, and streams that accept messages of up to 16 MiB.

    Raises ``InputError`` if the process reports an error, and one of ``LOST`` if it dies or does not answer in time.
    """
    reader, writer = await asyncio.open_connection(sock=connection, limit=2**24)
    try:
        async with asyncio.timeout(seconds):
            greeting: dict[str, Any] = json.loads(await reader.readline())
        if "error" in greeting:
            raise InputError(greeting["error"])
    except BaseException:
        writer.close()
        raise
    return greeting, reader, writer
