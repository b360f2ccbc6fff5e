"""``bidnerf plugins``."""

from __future__ import annotations

from typing import Annotated

import tyro
from rich.table import Table

from bidnerf_core.cli.options import Flag, option, parse
from bidnerf_core.cli.output import print_json, print_table
from bidnerf_core.registry import GROUPS, PluginInfo, list_plugins


def run(arguments: list[str]) -> None:
    parse("plugins", plugins, arguments)


def plugins(
    group: Annotated[
        tyro.conf.Positional[str | None],
        option("[GROUP]", "one kind of plugin: " + ", ".join(GROUPS), "all kinds"),
    ] = None,
    json: Annotated[Flag, option(None, "print a JSON list", "")] = False,
) -> None:
    """List everything registered by name: backends, readers, methods, features, faults, writers, importers and exporters."""
    groups = list(GROUPS) if group is None else [group]
    infos = [info for of in groups for info in list_plugins(of)]
    if json:
        print_json([{"group": info.group} | plain(info) for info in infos])
    else:
        print_infos(infos, with_group=group is None)


def print_infos(infos: list[PluginInfo], with_group: bool = False) -> None:
    """Print a table of plugins, with their faults if any."""
    faults = ["fault"] if any(info.fault for info in infos) else []
    groups = ["group"] if with_group else []
    table = Table(*groups, "name", "summary", "distribution", "version", *faults, box=None, pad_edge=False)
    for info in infos:
        fault = [info.fault or ""] if faults else []
        of = [info.group] if with_group else []
        table.add_row(*of, info.name, info.summary, info.distribution, info.version, *fault)
    print_table(table)


def plain(info: PluginInfo) -> dict[str, str | None]:
    """Return a plugin's description as JSON values."""
    return {
        "name": info.name,
        "summary": info.summary,
        "distribution": info.distribution,
        "version": info.version,
        "value": info.value,
        "fault": info.fault,
    }
