"""The limits on requests to the service, and the check of its token."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bidnerf_core.errors import InputError
from bidnerf_core.io import usable_cores
from bidnerf_core.settings import EXPERT, Above, Range, Settings

MEBIBYTE = 2**20
LEAST_TOKEN = 16
"""Minimum length of a token; shorter ones could be guessed."""
Limit = Annotated[float, Above(0.0, 1e6), EXPERT]


@dataclass(frozen=True)
class ServiceLimits(Settings):
    """How many requests are served at a time, and the limits of each.

    A request counts from the moment its head has arrived, so that ``queue`` bounds the memory of uploads too.
    """

    workers: Annotated[Annotated[int, Range(1, 1000)] | None, "N"] = None
    """number of single-threaded processes that localize (default: one per core)"""
    # requests that may upload or wait besides those in progress; further ones get status 429
    queue: Annotated[int, Range(0, 100_000), EXPERT, "N"] = 16
    # time for an answer, counted from the complete request; else status 504
    timeout: Annotated[Limit, "SECONDS"] = 60.0
    # time within which a request must have arrived; else status 408
    upload_timeout: Annotated[Limit, "SECONDS"] = 20.0
    # largest request; a larger one gets status 413
    max_megabytes: Annotated[Limit, "MIB"] = 32.0
    # largest image, by the size in its header; a larger one gets status 422
    max_megapixels: Annotated[Limit, "MP"] = 50.0

    @property
    def processes(self) -> int:
        """The number of worker processes, by default the number of cores that this process may use."""
        return self.workers or usable_cores()

    @property
    def max_bytes(self) -> int:
        """The largest size of a request in bytes."""
        return int(self.max_megabytes * MEBIBYTE)

    @property
    def max_pixels(self) -> float:
        """The largest size of an image in pixels."""
        return self.max_megapixels * 1e6


def check_token(token: str | None) -> str | None:
    """Return ``token`` if it is valid. Raises ``InputError`` if it is too short or cannot be sent in a header."""
    if token is not None and (len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable()):
        raise InputError(
            f"the token has {len(token)} characters",
            expected=f"at least {LEAST_TOKEN} printable ASCII characters",
        )
    return token
