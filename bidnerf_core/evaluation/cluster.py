"""Trials on a cluster: the workers of dask behind an ordinary executor."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from bidnerf_core.errors import InputError

PATIENCE = "20s"
"""Time to wait for the scheduler."""


@contextmanager
def dask_executor(address: str) -> Iterator[tuple[Executor, int]]:
    """Yield an executor of the scheduler at ``address``, and the number of trials that its workers run at once.

    Workers need this package, the same backends, and the maps and data under the same paths. Peak memory is measured per
    process: it is that of one trial only if the worker has one thread (``dask worker --nthreads 1``).

    Raises ``InputError`` where dask is missing, and where no scheduler or worker answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError("--dask needs dask, which is missing: pip install 'bidnerf[cluster]'") from error
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        raise InputError(
            f"no dask scheduler at {address} ({error}), expected one as tcp://host:8786"
        ) from error
    with client:
        threads = sum(client.nthreads().values())
        if threads == 0:
            raise InputError(f"the dask scheduler at {address} has no workers, expected at least one")
        yield client.get_executor(), threads
