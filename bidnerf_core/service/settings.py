"""What the service is told: the limits on requests, how poses are found, and the token."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.settings import to_flat

MEBIBYTE = 2**20
LEAST_TOKEN = 16
"""Minimum length of a token; shorter ones could be guessed."""


def usual_workers() -> int:
    """Return the number of cores that this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return usable or 1


@dataclass(frozen=True)
class ServiceLimits:
    """How many requests are served at a time, and the limits of each.

    A request counts from the moment its head has arrived, so that ``queue`` bounds the memory of uploads too.
    """

    workers: int = 0  # processes that localize, each with one thread; 0: one per core
    queue: int = 16  # requests that may upload or wait besides those at work; further ones get status 429
    timeout: float = 60.0  # seconds for an answer, counted from the complete request; else status 504
    upload_timeout: float = 20.0  # seconds within which a request must have arrived; else status 408
    max_megabytes: float = 32.0  # largest request, in MiB; a larger one gets status 413
    max_megapixels: float = 50.0  # largest image, by the size in its header; a larger one gets status 422

    def __post_init__(self) -> None:
        """Raise ``InputError`` for numbers out of range."""
        if self.workers < 0 or self.queue < 0:
            raise InputError(f"workers is {self.workers} and queue {self.queue}", expected="0 or more")
        for name in ("timeout", "upload_timeout", "max_megabytes", "max_megapixels"):
            value = getattr(self, name)
            if not 0 < value < 1e6:
                raise InputError(f"{name} is {value}", expected="a positive number")

    @property
    def processes(self) -> int:
        """The number of worker processes."""
        return self.workers or usual_workers()

    @property
    def places(self) -> int:
        """The number of requests that may be uploading, waiting or in progress at a time."""
        return self.processes + self.queue

    @property
    def max_bytes(self) -> int:
        """The largest size of a request in bytes."""
        return int(self.max_megabytes * MEBIBYTE)


@dataclass(frozen=True)
class ChosenMethod:
    """How poses are found, and on which device."""

    name: str = "auto"
    config: Mapping[str, Any] = field(
        default_factory=dict
    )  # settings by name; the others keep their defaults
    device: str = "cpu"

    @staticmethod
    def of(name: str, config: Any, device: str) -> ChosenMethod:
        """Return a method with its settings as given to Python's functions: an instance of their type, a dictionary, or None."""
        if config is not None and not isinstance(config, Mapping) and not is_dataclass(config):
            raise InputError(
                f"config is a {type(config).__name__}", expected=f"settings of {name}, or a dictionary"
            )
        return ChosenMethod(name, dict(to_flat(config) if is_dataclass(config) else config or {}), device)


def checked_token(token: str | None) -> str | None:
    """Return a token. Raises ``InputError`` for one that is short or that a header cannot hold."""
    if token is not None and (len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable()):
        raise InputError(
            f"the token has {len(token)} characters",
            expected=f"at least {LEAST_TOKEN} printable ASCII characters",
        )
    return token
