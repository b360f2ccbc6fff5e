"""A background queue of localizations, which run one at a time and report intermediate results."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Literal

from bidnerf_core.datasets import Query
from bidnerf_core.errors import Cancelled, InputError
from bidnerf_core.io import to_plain
from bidnerf_core.localization import Localizer, SearchRecord
from bidnerf_core.progress import job_context
from bidnerf_core.results import BAD_INPUT
from bidnerf_core.viewer.answer import ShownAnswer
from bidnerf_core.viewer.view import localized

MOST_WAITING = 8
"""Maximum number of localizations in the queue."""
KEPT = 64
"""Maximum number of finished localizations whose answers are kept."""

State = Literal["waiting", "searching", "rendering", "done"]


@dataclass
class Job:
    """A requested localization."""

    name: str
    id: str = field(default_factory=lambda: secrets.token_urlsafe(9))
    state: State = "waiting"
    record: SearchRecord | None = None
    answer: ShownAnswer | None = None

    def plain(self, known: str) -> dict[str, Any]:
        """Return the state as JSON values, with the answer unless the client has already seen it in the ``known`` state."""
        steps = [] if self.record is None else list(self.record.steps)
        said = {
            "id": self.id,
            "name": self.name,
            "state": self.state,
            "caption": steps[-1].caption if steps else "",
        }
        return said if self.state == known else said | {"answer": to_plain(self.answer)}


class Busy(Exception):
    """The queue of localizations is full."""


class Jobs:
    """Runs localizations in one thread, in the order in which they were requested."""

    def __init__(self, localizer: Localizer) -> None:
        self._localizer, self._jobs = localizer, dict[str, Job]()
        self._thread = ThreadPoolExecutor(1, "localizing")
        self._lock, self._closed = threading.Lock(), threading.Event()

    def begin(self, name: str, read: Callable[[], Query]) -> Job:
        """Queue the localization of the query that ``read`` returns. Raises ``Busy`` if the queue is full."""
        with self._lock:
            if sum(job.state == "waiting" for job in self._jobs.values()) >= MOST_WAITING:
                raise Busy
            job = Job(name)
            self._jobs[job.id] = job
            done = [each.id for each in self._jobs.values() if each.state == "done"]
            for old in done[: max(0, len(self._jobs) - KEPT)]:
                del self._jobs[old]
        self._thread.submit(self._work, job, read)
        return job

    def find(self, id: str) -> Job | None:
        """Return a localization by its id; None if it is unknown or no longer kept."""
        return self._jobs.get(id)

    def close(self) -> None:
        """Discard the localizations in the queue, and stop the one in progress soon."""
        self._closed.set()
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _work(self, job: Job, read: Callable[[], Query]) -> None:
        def begun(record: SearchRecord) -> None:
            job.record = record

        def found_pose(answer: ShownAnswer) -> None:
            job.answer, job.state = answer, "rendering"

        job.state = "searching"
        try:
            with job_context(cancel=self._closed.is_set):
                job.answer = localized(self._localizer, read(), begun=begun, found_pose=found_pose)
        except Cancelled:
            job.answer = ShownAnswer(job.name, "stopped", False, "the viewer was closed")
        except InputError as error:
            job.answer = ShownAnswer(job.name, BAD_INPUT, False, str(error))
        except Exception as error:  # third-party code may raise anything, which the page has to report
            job.answer = ShownAnswer(job.name, "fault", False, f"{type(error).__name__}: {error}")
            raise
        finally:
            job.state = "done"
