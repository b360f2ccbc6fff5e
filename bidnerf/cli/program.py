"""``main``, which finds a command among the installed ones, runs it and turns errors into exit statuses."""

from __future__ import annotations

import contextlib
import inspect
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TextIO

from bidnerf.cli.signals import Interrupted, interruptions
from bidnerf_core.errors import (
    Cancelled,
    InputError,
    InputWarning,
    UsageError,
    printable,
    single_line,
    spelled,
    spelling_hint,
)
from bidnerf_core.registry import Plugins, list_plugins


def _command_defects(command: Any) -> Iterator[str]:
    """Yield the reasons why an object is not a command: a function with a docstring and annotated parameters."""
    from bidnerf.cli.parameters import parameters_of  # imported here for the sake of a quick --version

    if not inspect.isfunction(command):
        yield f"it is a {type(command).__name__}, expected a function"
    elif not inspect.getdoc(command):
        yield "it has no docstring, from which its help is made"
    else:
        parameters_of(command)


COMMANDS: Plugins[Callable[..., None]] = Plugins("commands", _command_defects)
"""The functions that run the installed commands, by name."""
DONE, BAD_DATA, WRONG_USAGE, INTERRUPTED, READER_GONE = 0, 1, 2, 130, 141
"""Exit statuses; the last two are 128 plus the number of the signal, as is customary for shells. SIGTERM and SIGHUP lead to
143 and 129."""


def option_name(name: str) -> str:
    """Return the option of a parameter or a setting, such as --depth-unit for ``depth_unit``."""
    return f"--{name.replace('_', '-')}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status; a user error is reported in one line instead of a traceback."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if (
        arguments is None
    ):  # processes that are started import no module from the current folder, which may hold anything
        os.environ["PYTHONSAFEPATH"] = "1"
    _open_streams()
    name = "bidnerf"
    try:
        if given and not given[0].startswith("-") and given[0] in COMMANDS:
            name += f" {given[0]}"
        with interruptions(), _warnings_as_lines(name), _log_as_lines():
            status = _dispatch(given)
            sys.stdout.flush()  # here, where a full disk can still be reported
            return status
    except KeyboardInterrupt as stopped:
        return _report(name, "interrupted", 128 + stopped.number if isinstance(stopped, Interrupted) else INTERRUPTED)
    except Cancelled as stopped:
        return _report(name, str(stopped), INTERRUPTED)
    except BrokenPipeError:
        return READER_GONE
    except OSError as error:  # a full disk, a folder without write permission
        where = f"{error.filename}: " if error.filename else ""
        return _report(name, f"{where}{error.strerror or error}", BAD_DATA)
    except (InputError, ImportError, AttributeError, TypeError) as error:
        # An unsupported version of a package shows as one of these, or as a plugin that cannot be imported for one of them.
        if not isinstance(error, InputError) or isinstance(error.__cause__, ImportError | AttributeError | TypeError):
            with contextlib.suppress(ImportError):  # bidnerf itself is not installed, but runs from its source
                from bidnerf_core.installation import requirements

                for requirement in requirements():
                    if not requirement.is_met:
                        return _report(name, f"{requirement}; pip install -U bidnerf ({error})", BAD_DATA)
        if not isinstance(error, InputError):
            raise
        return _report(name, str(error), WRONG_USAGE if isinstance(error, UsageError) else BAD_DATA)
    except RuntimeError as error:
        if type(error).__name__ != "OutOfMemoryError":  # torch's class; importing torch would delay --help
            raise
        return _report(name, f"the GPU's memory is full, try --device cpu ({error})", BAD_DATA)
    finally:
        try:
            sys.stdout.flush()
        except (OSError, ValueError):
            _discard(sys.stdout)


def _dispatch(given: list[str]) -> int:
    if not given or given[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if given else sys.stderr)
        return DONE if given else WRONG_USAGE
    if given[0] == "--version":
        from importlib.metadata import version

        print(f"bidnerf {version('bidnerf')}")
        return DONE
    if given[0] not in COMMANDS:
        hint = spelling_hint(given[0], [*COMMANDS, "--help", "--version"])
        raise UsageError(f"no command {given[0]!r}{hint}; 'bidnerf --help' lists all commands")
    if any("\0" in word for word in given):
        raise UsageError("an argument holds a NUL character", expected="text")
    from bidnerf.cli.parser import parse  # imported here for the sake of a quick --version

    command = COMMANDS.load(given[0])
    try:
        parse(given[0], command, given[1:])
    except SystemExit as stopped:  # after help, or from a plugin
        return stopped.code if isinstance(stopped.code, int) else DONE if stopped.code is None else BAD_DATA
    return DONE


def _usage() -> str:
    """Return the list of all commands, which imports none of them."""
    infos = list_plugins("commands")
    width = max((len(info.name) for info in infos), default=0)
    lines = [f"  {info.name.ljust(width)}  {info.description}" for info in infos]
    return "\n".join(
        [
            "usage: bidnerf COMMAND ...",
            "",
            *lines,
            "",
            "'bidnerf demo' is a tour of two minutes; 'bidnerf COMMAND --help' describes a command.",
            "'bidnerf --version' prints the version.",
        ]
    )


@contextlib.contextmanager
def _warnings_as_lines(name: str) -> Iterator[None]:
    """Print each distinct ``InputWarning`` once, as one line on stderr, without the source line that Python would add."""
    shown = set[str]()
    with warnings.catch_warnings():

        def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
            if not issubclass(category, InputWarning):
                lines = warnings.formatwarning(message, category, *where[:2]).split("\n")
                sys.stderr.write("\n".join(map(printable, lines)))
            elif str(message) not in shown:  # a broken plugin is reported again with every folder
                shown.add(str(message))
                _report(name, str(message), DONE)

        warnings.simplefilter("always", InputWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield


@contextlib.contextmanager
def _log_as_lines() -> Iterator[None]:
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


def _report(name: str, message: str, status: int) -> int:
    """Print the reason for a failure, or a warning, on one line, and return ``status``, even if stderr is closed."""
    with contextlib.suppress(OSError):
        print(f"{name}: {single_line(spelled(message, option_name))}", file=sys.stderr, flush=True)
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
