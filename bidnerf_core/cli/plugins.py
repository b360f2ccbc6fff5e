"""``bidnerf plugins``."""

from __future__ import annotations

from typing import Annotated

import tyro
from rich.table import Table

from bidnerf_core.cli.options import Flag, option, parse
from bidnerf_core.cli.output import print_json, print_table
from bidnerf_core.registry import GROUPS, PluginError, PluginInfo, list_plugins, load_plugin


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
        table.add_row(*of, info.name, summary(info), info.distribution, info.version, *fault)
    print_table(table)


def plain(info: PluginInfo) -> dict[str, str | None]:
    """Return a plugin's description as JSON values."""
    return {
        "name": info.name,
        "summary": summary(info),
        "distribution": info.distribution,
        "version": info.version,
        "value": info.value,
        "fault": info.fault,
    }


def summary(info: PluginInfo) -> str:
    """Return the summary from the docstring or the metadata or, failing these, from the imported plugin itself."""
    if info.summary or info.fault:
        return info.summary
    try:
        return str(getattr(load_plugin(info.group, info.name), "summary", ""))
    except PluginError:
        return ""  # the fault is reported when the plugin is loaded for use
