"""``bidnerf backends``."""

from __future__ import annotations

from typing import Annotated

from bidnerf_core.cli.options import Flag, option, parse
from bidnerf_core.cli.output import print_json
from bidnerf_core.cli.plugins import plain, print_infos
from bidnerf_core.registry import list_plugins


def run(arguments: list[str]) -> None:
    parse("backends", backends, arguments)


def backends(json: Annotated[Flag, option(None, "print a JSON list", "")] = False) -> None:
    """List the installed kinds of field."""
    infos = list_plugins("backends")
    if json:
        print_json([plain(info) for info in infos])
    else:
        print_infos(infos)
