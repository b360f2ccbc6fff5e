"""The localizations that a viewer was asked for: they run one at a time and report intermediate results."""

from __future__ import annotations

import contextlib
import logging
import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

from bidnerf_core.datasets import Query
from bidnerf_core.errors import Cancelled, InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import to_plain
from bidnerf_core.localization import Localizer, SearchRecord
from bidnerf_core.progress import job_context
from bidnerf_core.results import BAD_INPUT
from bidnerf_core.service import Refused
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
    """Runs localizations in a thread, in the order in which they were requested; ``shown`` holds them by their ids."""

    def __init__(self, localizer: Localizer) -> None:
        self.shown = dict[str, ShownJob]()
        self._localizer, self._closed = localizer, threading.Event()
        self._thread = ThreadPoolExecutor(1, "localizing")

    @contextlib.contextmanager
    def place(self, name: str) -> Iterator[ShownJob]:
        """Enter a localization, which is forgotten if the block raises an error. Raises ``Refused`` if no place is left."""
        if sum(each.state != "done" for each in self.shown.values()) >= PLACES:
            headers = {"Retry-After": "5", "Connection": "close"}
            raise Refused(429, f"all {PLACES} places are taken, try again later", headers)
        job = ShownJob(uuid.uuid4().hex, name)
        self.shown[job.id] = job
        try:
            yield job
        except BaseException:
            del self.shown[job.id]
            raise

    def put(self, job: ShownJob, read: Read) -> None:
        """Queue the localization of what ``read`` returns."""
        done = [each.id for each in self.shown.values() if each.state == "done"]
        for old in done[: max(0, len(self.shown) - 64)]:  # the answers of 64 localizations stay in memory
            del self.shown[old]
        self._thread.submit(self._run, job, read)

    def close(self) -> None:
        """Discard the localizations that wait, and soon stop the one in progress."""
        self._closed.set()
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _run(self, job: ShownJob, read: Read) -> None:
        with job_context(cancel=self._closed.is_set):
            job.run(self._localizer, read)
