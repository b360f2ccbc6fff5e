"""The command line ``bidnerf COMMAND ...``: ``main``, and modules that implement one or more commands each."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, TextIO

from bidnerf.cli.running import Interrupted, interruptions
from bidnerf_core.errors import Cancelled, InputError, InputWarning, UsageError, printable, spelling_hint

COMMANDS = {
    "demo": "train a closed-form scene, localize unseen frames in it, and draw the result",
    "backends": "list the installed kinds of field",
    "plugins": "list everything registered by name: backends, readers, methods and others",
    "poses": "find the poses of photos or video frames without poses",
    "train": "build a map from a dataset, or from photos without poses",
    "import": "build a map from a COLMAP model, or a field trained elsewhere: splats, a checkpoint",
    "bake": "add to a map what localization without a start needs, as train does",
    "info": "describe a map",
    "extend": "add photos of the same scene to a map",
    "export": "export the surface, landmarks and cameras of a map for other software",
    "scale": "convert a map to metres",
    "render": "render images and depth of a map from a dataset's poses",
    "localize": "find the poses of photos, or of a dataset's frames, in a map",
    "track": "find the poses of a sequence's frames in a map, in chronological order",
    "evaluate": "localize many frames from perturbed starts, one JSON line per trial",
    "view": "view a map, and localizations in it, on a web page",
    "serve": "serve localization over HTTP: photos in, poses out",
    "compare": "compare several maps from the same starts: success, steps, time, memory",
    "report": "make one page of tables and figures from an evaluation",
}

MODULES = {
    "backends": "plugins",
    "poses": "train",
    "serve": "view",
    "compare": "evaluate",
    "report": "evaluate",
    **dict.fromkeys(("import", "bake", "info", "extend", "export", "scale", "render"), "maps"),
}
"""The module of each command that has no module of its name. The function ``run_COMMAND`` in it runs the command."""
DONE, BAD_INPUT, WRONG_USAGE, INTERRUPTED, READER_GONE = 0, 1, 2, 130, 141
"""Exit statuses; the last two are 128 plus the number of the signal, as is customary for shells. SIGTERM and SIGHUP lead to
143 and 129."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status; a user error is reported in one line instead of a traceback."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    _open_streams()
    name = " ".join(["bidnerf", *[word for word in given[:1] if word in COMMANDS]])
    try:
        with interruptions(), _warnings_as_lines(name), _remarks_as_lines():
            status = _dispatch(given)
            sys.stdout.flush()  # here, where a full disk can still be reported
            return status
    except KeyboardInterrupt as stopped:
        return _failed(name, "interrupted", 128 + stopped.number if isinstance(stopped, Interrupted) else INTERRUPTED)
    except Cancelled as stopped:
        return _failed(name, str(stopped), INTERRUPTED)
    except BrokenPipeError:
        return READER_GONE
    except OSError as error:  # a full disk, a folder without write permission
        where = f"{error.filename}: " if error.filename else ""
        return _failed(name, f"{where}{error.strerror or error}", BAD_INPUT)
    except InputError as error:
        return _failed(name, str(error), WRONG_USAGE if isinstance(error, UsageError) else BAD_INPUT)
    except RuntimeError as error:
        if type(error).__name__ != "OutOfMemoryError":  # torch's class; importing torch would delay --help
            raise
        return _failed(name, f"the GPU's memory is full, try --device cpu ({error})", BAD_INPUT)
    finally:
        try:
            sys.stdout.flush()
        except (OSError, ValueError):
            _discard(sys.stdout)


def _dispatch(given: list[str]) -> int:
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name.ljust(width)}  {what}" for name, what in COMMANDS.items())
    usage = f"usage: bidnerf COMMAND ...\n\n{commands}\n\n'bidnerf COMMAND --help' describes a command."
    if not given or given[0] in ("-h", "--help"):
        print(usage, file=sys.stdout if given else sys.stderr)
        return DONE if given else WRONG_USAGE
    if given[0] == "--version":
        from importlib.metadata import version

        print(f"bidnerf {version('bidnerf')}")
        return DONE
    if given[0] not in COMMANDS:
        unknown = f"no command {given[0]!r}{spelling_hint(given[0], COMMANDS)}"
        return _failed("bidnerf", unknown, WRONG_USAGE, f"\n{usage}")
    if any("\0" in word for word in given):
        raise UsageError("an argument holds a NUL character", expected="text")
    from bidnerf.cli.parser import parse  # imported here for the sake of a quick --version

    module = importlib.import_module(f"bidnerf.cli.{MODULES.get(given[0], given[0])}")
    try:
        parse(given[0], getattr(module, f"run_{given[0]}"), given[1:])
    except SystemExit as stopped:  # after help, or from a plugin
        return stopped.code if isinstance(stopped.code, int) else DONE if stopped.code is None else BAD_INPUT
    return DONE


@contextlib.contextmanager
def _warnings_as_lines(name: str) -> Iterator[None]:
    """Print each distinct ``InputWarning`` once, as one line on stderr, without the source line that Python would add."""
    told = set[str]()
    with warnings.catch_warnings():

        def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
            if not issubclass(category, InputWarning):
                lines = warnings.formatwarning(message, category, *where[:2]).split("\n")
                sys.stderr.write("\n".join(map(printable, lines)))
            elif str(message) not in told:  # a broken plugin is reported again with every folder
                told.add(str(message))
                _failed(name, str(message), DONE)

        warnings.simplefilter("always", InputWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield


@contextlib.contextmanager
def _remarks_as_lines() -> Iterator[None]:
    """Print each message that the library logs as one line on stderr."""
    logger, handler = logging.getLogger("bidnerf"), _Lines()
    before = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before[0])  # unlike an assignment, this clears the logger's cache
        logger.propagate = before[1]


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        # Imported here because importing rich takes longer than --help should.
        from bidnerf.cli.output import say

        say(record.getMessage())


def _failed(name: str, message: str, status: int, more: str = "") -> int:
    """Print the reason for a failure, or a warning, on one line, and return ``status``, even if stderr is closed."""
    with contextlib.suppress(OSError):
        print(f"{name}: {printable(' '.join(message.splitlines()))}", file=sys.stderr)
        print(more, end=more and "\n", file=sys.stderr, flush=True)
    return status


def _open_streams() -> None:
    """Make stdout and stderr accept every character.

    Streams that the shell closed (``>&-``), which are None in Python, are replaced by streams that discard
    everything. Characters that a stream cannot encode are written as backslash escapes.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
            stream.reconfigure(errors="backslashreplace")


def _discard(stream: TextIO) -> None:
    """Discard the remaining buffer of a stream, since flushing it when Python exits would fail again."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
