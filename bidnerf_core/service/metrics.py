"""Counters and times of the service for Prometheus."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import psutil
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

SECONDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
"""Upper bounds of the buckets of times."""


class Metrics:
    """Everything that the service counts.

    ``gauges`` holds descriptions and functions by name, ``processes`` functions that return process ids by kind.
    """

    def __init__(
        self,
        gauges: Mapping[str, tuple[str, Callable[[], float]]],
        processes: Mapping[str, Callable[[], Sequence[int]]],
    ) -> None:
        self.registry = registry = CollectorRegistry()
        self.requests = Counter(
            "bidnerf_requests", "Requests answered.", ["path", "status"], registry=registry
        )
        self.outcomes = Counter(
            "bidnerf_outcomes", "Localizations by their outcome.", ["map", "outcome"], registry=registry
        )
        self.restarts = Counter("bidnerf_worker_restarts", "Workers replaced.", ["reason"], registry=registry)
        text = "From the arrival of a request to its answer."
        self.seconds = Histogram("bidnerf_request_seconds", text, registry=registry, buckets=SECONDS)
        self.waited = Histogram(
            "bidnerf_queue_seconds", "Waiting for a worker.", registry=registry, buckets=SECONDS
        )
        for name, (description, value) in gauges.items():
            Gauge(f"bidnerf_{name}", description, registry=registry).set_function(value)
        text = "Resident memory; pages shared by processes count for each."
        memory = Gauge("bidnerf_resident_bytes", text, ["process"], registry=registry)
        for kind, numbers in processes.items():
            memory.labels(process=kind).set_function(partial(_resident_bytes, numbers))

    def text(self) -> bytes:
        """Return the metrics in Prometheus' format."""
        return generate_latest(self.registry)

    def value(self, name: str, **labels: str) -> float:
        """Return the value of a metric now; 0 for one that was never counted."""
        return self.registry.get_sample_value(f"bidnerf_{name}", labels) or 0.0

    @property
    def mean_seconds(self) -> float:
        """The mean time from the arrival of a request to its answer; 1 s before the first one."""
        count = self.value("request_seconds_count")
        return self.value("request_seconds_sum") / count if count else 1.0


def _resident_bytes(processes: Callable[[], Sequence[int]]) -> float:
    total = 0
    for process in processes():
        with contextlib.suppress(psutil.Error):
            total += psutil.Process(process).memory_info().rss
    return total
