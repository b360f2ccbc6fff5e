"""``bidnerf backends``."""

from __future__ import annotations

from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from bidnerf_core.cli.common import parse, print_json
from bidnerf_core.registry import BackendInfo, list_backends


def run(arguments: list[str]) -> None:
    parse("backends", backends, arguments)


def backends(json: Annotated[bool, tyro.conf.arg(help="print a JSON list")] = False) -> None:
    """List the installed kinds of field, importing none of them."""
    infos = list_backends()
    if json:
        print_json([_row(info) for info in infos])
        return
    table = Table("name", "summary", "distribution", "version", "fault", box=None, pad_edge=False)
    for info in infos:
        table.add_row(info.name, info.summary, info.distribution, info.version, info.fault or "")
    Console(highlight=False).print(table)


def _row(info: BackendInfo) -> dict[str, str | None]:
    return {
        "name": info.name,
        "summary": info.summary,
        "distribution": info.distribution,
        "version": info.version,
        "value": info.value,
        "fault": info.fault,
    }
