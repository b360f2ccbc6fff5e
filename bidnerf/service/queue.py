"""The queue of a server: how many requests it accepts at a time, and which idle executor takes the next one.

The executors of the service are processes, see ``pool``; that of the viewer is a thread, since the page shows what a search
does while it runs.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, Protocol, TypeVar

from bidnerf.service.models import Refused
from bidnerf_core.progress import job_context


class Executor(Protocol):
    """What performs one request at a time, such as a process or a thread."""

    @property
    def ended(self) -> bool:
        """Whether it can take no further request."""


AnyExecutor = TypeVar("AnyExecutor", bound=Executor)
Returned = TypeVar("Returned")


class RequestQueue(Generic[AnyExecutor]):
    """The requests that are uploading, waiting or at work, at most ``slots`` at a time, and the executors that are idle.

    Requests are taken in the order in which they began to wait. A request counts from the moment its head has arrived, so that
    ``slots`` bounds the memory of uploads too.
    """

    def __init__(self, slots: int, retry_after: Callable[[], int]) -> None:
        """Create a queue without executors; ``retry_after`` returns the seconds after which a refused client may try again."""
        self.slots, self.taken, self.waiting, self._retry_after = slots, 0, 0, retry_after
        self._idle = asyncio.Queue[AnyExecutor]()

    @contextlib.contextmanager
    def slot(self) -> Iterator[None]:
        """Occupy a slot within the block. Raises ``Refused`` if none is free."""
        if self.taken >= self.slots:
            headers = {"Retry-After": str(self._retry_after()), "Connection": "close"}
            raise Refused(429, f"all {self.slots} places are taken, try again later", headers)
        self.taken += 1
        try:
            yield
        finally:
            self.taken -= 1

    def add(self, executor: AnyExecutor) -> None:
        """Offer an executor to the request that waits longest, or to the next one."""
        self._idle.put_nowait(executor)

    @contextlib.asynccontextmanager
    async def executor(self) -> AsyncIterator[AnyExecutor]:
        """Wait for an idle executor and reserve it within the block; afterwards it is idle again, unless it has ended."""
        self.waiting += 1
        try:
            while (executor := await self._idle.get()).ended:
                pass
        finally:
            self.waiting -= 1
        try:
            yield executor
        finally:
            if not executor.ended:
                self.add(executor)


class ThreadExecutor:
    """A thread that performs one task after the other."""

    ended = False

    def __init__(self, name: str) -> None:
        self._thread = ThreadPoolExecutor(1, name)

    async def run(self, work: Callable[[], Returned]) -> Returned:
        """Return the result of ``work``, which is cancelled (see ``job_context``) if this call is cancelled."""
        cancelled = threading.Event()

        def work_until_cancelled() -> Returned:
            with job_context(cancel=cancelled.is_set):
                return work()

        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, work_until_cancelled)
        finally:
            cancelled.set()

    def close(self) -> None:
        """Refuse further work, and let the thread end as soon as it is idle."""
        self._thread.shutdown(wait=False, cancel_futures=True)
