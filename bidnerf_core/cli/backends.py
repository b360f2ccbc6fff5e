"""``bidnerf backends``."""

from __future__ import annotations

from typing import Annotated

from rich.table import Table

from bidnerf_core.cli.options import Flag, option, parse
from bidnerf_core.cli.output import print_json, print_table
from bidnerf_core.registry import PluginError, PluginInfo, list_plugins, load_plugin


def run(arguments: list[str]) -> None:
    parse("backends", backends, arguments)


def backends(json: Annotated[Flag, option(None, "print a JSON list", "")] = False) -> None:
    """List the installed kinds of field."""
    infos = list_plugins("backends")
    if json:
        print_json([_row(info) for info in infos])
        return
    faults = ["fault"] if any(info.fault for info in infos) else []
    table = Table("name", "summary", "distribution", "version", *faults, box=None, pad_edge=False)
    for info in infos:
        fault = [info.fault or ""] if faults else []
        table.add_row(info.name, _summary(info), info.distribution, info.version, *fault)
    print_table(table)


def _summary(info: PluginInfo) -> str:
    """Return the summary from the module's docstring or the metadata or, without these, from the imported backend itself."""
    if info.summary or info.fault:
        return info.summary
    try:
        return str(load_plugin("backends", info.name).summary)
    except PluginError:
        return ""  # the fault is reported when the backend is loaded for use


def _row(info: PluginInfo) -> dict[str, str | None]:
    return {
        "name": info.name,
        "summary": _summary(info),
        "distribution": info.distribution,
        "version": info.version,
        "value": info.value,
        "fault": info.fault,
    }
