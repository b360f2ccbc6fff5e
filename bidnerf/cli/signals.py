"""Signals that stop a command, in a way that lets its results be saved."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from _thread import interrupt_main
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

from bidnerf_core.errors import Cancelled, InputError

# Windows has no SIGHUP.
STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupted(KeyboardInterrupt):
    """Raised when a signal asks the command to stop."""

    def __init__(self, number: int, is_explained: bool = False) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number
        self.is_explained = is_explained  # whether a line has stated what is kept


class Handler:
    """A signal handler that raises ``Interrupted`` in the process that installed it, at once or when the work allows it."""

    def __init__(self) -> None:
        self.process = os.getpid()
        self.writes = False  # every signal waits until results are written
        self.works = False  # the first Ctrl-C waits until the work next checks whether to stop
        self.waiting: int | None = None
        self.raised: int | None = None  # the last signal for which ``Interrupted`` was raised
        self.announce: Callable[[], object] = lambda: None  # tells the user that the work will stop

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self.process:  # a forked worker ends as it would without this handler
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        elif self.writes or (self.works and number == signal.SIGINT and self.waiting is None):
            self.waiting = number
            if not self.writes:  # on a thread, since the handler may have interrupted a print
                threading.Thread(target=self.announce).start()
        else:
            self.raised = number
            raise Interrupted(number)


@contextlib.contextmanager
def interruptions() -> Iterator[None]:
    """Make SIGINT, SIGTERM and SIGHUP raise ``Interrupted``. Signals that are ignored, as under nohup, stay ignored.

    An import that is interrupted may fail in another way, as NumPy's does with a ``RecursionError``: an unexpected error after a signal
    is an ``Interrupted``, too. One that Python ignores, as in the callback of a weak reference, is raised again after a moment.
    Has no effect outside the main thread, the only thread that may handle signals.
    """
    in_main = threading.current_thread() is threading.main_thread()
    usual, handler = (signal.SIG_DFL, signal.default_int_handler), Handler()
    handled = [number for number in STOP_SIGNALS if in_main and signal.getsignal(number) in usual]
    before = {number: signal.signal(number, handler) for number in handled}
    usual_hook, timers = sys.unraisablehook, list[threading.Timer]()

    def raise_again(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, Interrupted):
            timers.append(threading.Timer(0.01, interrupt_main, [unraisable.exc_value.number]))
            timers[-1].start()
        else:
            usual_hook(unraisable)

    if in_main:
        sys.unraisablehook = raise_again
    try:
        yield
    except Exception as error:
        if handler.raised is None or isinstance(error, InputError | Cancelled | OSError):
            raise
        raise Interrupted(handler.raised) from error
    finally:
        try:
            for timer in timers:  # an interruption that is still to come is raised here
                timer.join()
        finally:
            if in_main:
                sys.unraisablehook = usual_hook
            for number, handler_before in before.items():
                signal.signal(number, handler_before)


def installed_handler() -> Handler:
    """Return the handler that ``interruptions`` installed, or one that receives no signals."""
    handlers = map(signal.getsignal, STOP_SIGNALS)
    return next((each for each in handlers if isinstance(each, Handler)), Handler())


@contextlib.contextmanager
def defer_interruptions() -> Iterator[None]:
    """Defer interruptions to the end of the context, so that results are written completely."""
    handler = installed_handler()
    handler.writes = True
    try:
        yield
    finally:
        handler.writes = False
    if handler.waiting is not None:
        raise Interrupted(handler.waiting)
