"""``bidnerf backends``."""

from __future__ import annotations

from bidnerf_core.cli.options import Json
from bidnerf_core.cli.plugins import print_infos
from bidnerf_core.registry import list_plugins


def run(json: Json = False) -> None:
    """List the installed kinds of field."""
    print_infos(list_plugins("backends"), json)
