"""The command line: ``bidnerf COMMAND ...``, one file per command."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

COMMANDS = {
    "demo": "train a closed-form scene, localize unseen frames in it, draw the result",
    "backends": "the installed kinds of field",
    "train": "make a map from a dataset",
    "info": "describe a map",
    "render": "images and depth of a map from a dataset's poses",
    "localize": "find the pose of images in a map",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status: 0 done, 1 bad input, 2 wrong usage, 130 interrupted."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help"):
        print(_usage())
        return 0 if given else 2
    if given[0] == "--version":
        from importlib.metadata import version

        print(f"bidnerf {version('bidnerf')}")
        return 0
    if given[0] not in COMMANDS:
        print(f"bidnerf: no command {given[0]!r}\n\n{_usage()}", file=sys.stderr)
        return 2
    return _guarded(given[0], given[1:])


def _guarded(command: str, arguments: list[str]) -> int:
    """A user's mistake ends in one line, not in a traceback."""
    from bidnerf_core.errors import InputError

    try:
        importlib.import_module(f"bidnerf_core.cli.{command}").run(arguments)
    except InputError as error:
        print(f"bidnerf {command}: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of our output has gone
        sys.stderr.close()
        return 0
    except OSError as error:  # a full disk, a folder that may not be written
        where = f"{error.filename}: " if error.filename else ""
        print(f"bidnerf {command}: {where}{error.strerror or error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"bidnerf {command}: interrupted", file=sys.stderr)
        return 130
    return 0


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name.ljust(width)}  {what}" for name, what in COMMANDS.items()]
    return "usage: bidnerf COMMAND ...\n\n" + "\n".join(lines) + "\n\n'bidnerf COMMAND --help' tells more."
