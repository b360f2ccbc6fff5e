"""Signals that ask a command to stop: each raises an exception in the main thread, so that results can be saved."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

# Windows has no SIGHUP.
ASKED_TO_STOP = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupted(KeyboardInterrupt):
    """Raised when a signal asks the command to stop."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class _Handler:
    """A signal handler that raises ``Interrupted`` in the process that installed it; it can be deferred while results are written."""

    def __init__(self) -> None:
        self.process = os.getpid()
        self.deferring = False
        self.deferred: int | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self.process:  # a forked worker ends as it would without this handler
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        elif self.deferring:
            self.deferred = number
        else:
            raise Interrupted(number)


@contextlib.contextmanager
def interruptions() -> Iterator[None]:
    """Make SIGINT, SIGTERM and SIGHUP raise ``Interrupted``. Signals that are ignored, as under nohup, stay ignored.

    Has no effect outside the main thread, the only thread that may handle signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = (signal.SIG_DFL, signal.default_int_handler)
    handler = _Handler()
    before = {number: signal.getsignal(number) for number in ASKED_TO_STOP}
    ours = [number for number, found in before.items() if found in usual]
    for number in ours:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, before[number])


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Defer interruptions to the end of the context, so that results are written completely."""
    handlers = [found for number in ASKED_TO_STOP if isinstance(found := signal.getsignal(number), _Handler)]
    for handler in handlers:
        handler.deferring = True
    try:
        yield
    finally:
        for handler in handlers:
            handler.deferring = False
    deferred = [handler.deferred for handler in handlers if handler.deferred is not None]
    if deferred:
        raise Interrupted(deferred[0])
