"""Counters and times of the service in Prometheus' text format 0.0.4."""

from __future__ import annotations

import contextlib
import os
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from itertools import accumulate
from pathlib import Path

TEXT = "text/plain; version=0.0.4; charset=utf-8"
SECONDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
"""Upper bounds of the buckets of times."""
PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
"""Bytes per page, the unit of ``/proc/PID/statm``."""


class Histogram:
    """Counts of values per bucket."""

    def __init__(self) -> None:
        self.counts, self.total = [0] * (len(SECONDS) + 1), 0.0

    def add(self, value: float) -> None:
        """Count a value (seconds)."""
        self.counts[bisect_left(SECONDS, value)] += 1
        self.total += value


class Metrics:
    """Everything that the service counts."""

    def __init__(self) -> None:
        self.requests = Counter[tuple[str, int]]()  # by documented path and status
        self.outcomes = Counter[tuple[str, str]]()  # by map asked for, "" if none, and outcome
        self.restarts = Counter[str]()  # of workers, by reason
        self.seconds, self.waited = Histogram(), Histogram()
        self.gauges: dict[str, tuple[str, Callable[[], float]]] = {}
        self.processes: Callable[[], Mapping[str, list[int]]] = dict

    def text(self) -> str:
        """Return the metrics in Prometheus' format."""
        return "\n".join([*self._lines(), ""])

    def _lines(self) -> Iterator[str]:
        yield from _head("requests_total", "counter", "Requests answered.")
        for (path, status), count in sorted(self.requests.items()):
            yield _line("requests_total", count, path=path, status=str(status))
        yield from _head("outcomes_total", "counter", "Localizations by their outcome.")
        for (name, outcome), count in sorted(self.outcomes.items()):
            yield _line("outcomes_total", count, map=name, outcome=outcome)
        yield from _head("worker_restarts_total", "counter", "Workers replaced.")
        for reason, count in sorted(self.restarts.items()):
            yield _line("worker_restarts_total", count, reason=reason)
        yield from _histogram("request_seconds", "From the arrival of a request to its answer.", self.seconds)
        yield from _histogram("queue_seconds", "Waiting for a worker.", self.waited)
        for name, (description, value) in self.gauges.items():
            yield from _head(name, "gauge", description)
            yield _line(name, value())
        yield from _head(
            "resident_bytes", "gauge", "Resident memory; pages shared by processes count for each."
        )
        for kind, numbers in self.processes().items():
            yield _line("resident_bytes", sum(map(resident_bytes, numbers)), process=kind)


def resident_bytes(process: int) -> int:
    """Return the resident memory of a process; 0 if the system does not report it."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * PAGE
    return 0


def _head(name: str, kind: str, description: str) -> Iterator[str]:
    yield f"# HELP bidnerf_{name} {description}"
    yield f"# TYPE bidnerf_{name} {kind}"


def _line(name: str, value: float, **labels: str) -> str:
    shown = ",".join(f'{key}="{_escaped(text)}"' for key, text in labels.items())
    return f"bidnerf_{name}{'{' + shown + '}' if shown else ''} {value:.10g}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _histogram(name: str, description: str, histogram: Histogram) -> Iterator[str]:
    yield from _head(name, "histogram", description)
    bounds = (*(f"{bound:g}" for bound in SECONDS), "+Inf")
    for bound, count in zip(bounds, accumulate(histogram.counts), strict=True):
        yield _line(f"{name}_bucket", count, le=bound)
    yield _line(f"{name}_sum", histogram.total)
    yield _line(f"{name}_count", sum(histogram.counts))
