"""The localizations that a viewer was asked for: they run one at a time and report intermediate results."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from bidnerf_core.datasets import Query
from bidnerf_core.errors import Cancelled, InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import to_plain
from bidnerf_core.localization import Localizer, SearchRecord
from bidnerf_core.progress import job_context
from bidnerf_core.results import BAD_INPUT
from bidnerf_core.service import Job, Queue
from bidnerf_core.viewer.answer import no_answer
from bidnerf_core.viewer.packing import Json
from bidnerf_core.viewer.view import localized

log = logging.getLogger("bidnerf.viewer")

PLACES = 10
"""Maximum number of photos that are uploading, waiting or being localized."""

Read = Callable[[], tuple[Query, SE3 | None, int]]
"""Reads what is to be localized: a query, a start, and the seed of the search."""


@dataclass
class ShownJob:
    """A localization, as the page follows it."""

    id: str
    name: str
    state: Literal["waiting", "searching", "rendering", "done"] = "waiting"
    record: SearchRecord | None = None
    answer: Json | None = None

    def plain(self, known: str) -> dict[str, Any]:
        """Return the state as JSON values, with the answer unless the client has already seen it in the ``known`` state."""
        caption = self.record.steps[-1].caption if self.record is not None and self.record.steps else ""
        said = {"id": self.id, "name": self.name, "state": self.state, "caption": caption}
        return said if self.state == known else said | {"answer": to_plain(self.answer)}

    def run(self, localizer: Localizer, read: Read) -> None:
        """Localize what ``read`` returns, and set the answer, which states any error."""
        self.state = "searching"
        try:
            query, start, seed = read()
            self.answer = localized(localizer, query, start, seed, self._follow)
        except Cancelled:
            self.answer = no_answer(self.name, "stopped", "the viewer was closed")
        except InputError as error:
            self.answer = no_answer(self.name, BAD_INPUT, str(error))
        except Exception:  # third-party code may raise anything, with paths of this machine in it
            log.exception("internal error while localizing %s", self.name)
            self.answer = no_answer(self.name, "fault", "internal error, which the viewer's log describes")
        finally:
            self.state = "done"

    def _follow(self, record: SearchRecord, answer: Json | None) -> None:
        self.record, self.answer, self.state = record, answer, "rendering" if answer else "searching"


class Jobs:
    """Runs localizations in a thread, in the order in which they were requested.

    ``shown`` holds them by their ids. Closing the queue discards those that wait, and soon stops the one in progress.
    """

    def __init__(self, localizer: Localizer) -> None:
        self.queue, self._localizer, self.shown = Queue(PLACES), localizer, dict[str, ShownJob]()
        threading.Thread(target=self._work, name="localizing", daemon=True).start()

    def put(self, job: Job, read: Read) -> ShownJob:
        """Queue a localization of what ``read`` returns, for a job of the queue."""
        shown = self.shown[job.id] = ShownJob(job.id, job.name)
        done = [each.id for each in self.shown.values() if each.state == "done"]
        for old in done[: max(0, len(self.shown) - 64)]:  # the answers of 64 localizations stay in memory
            del self.shown[old]
        self.queue.put(job, read)
        return shown

    def _work(self) -> None:
        with job_context(cancel=lambda: self.queue.closed):
            while not self.queue.closed:
                job = self.queue.next()
                if job is not None:
                    self.shown[job.id].run(self._localizer, job.task)
                    job.result.set_result(None)
