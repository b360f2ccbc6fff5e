"""The commands ``bidnerf plugins`` and ``bidnerf backends``."""

from __future__ import annotations

from typing import Annotated

from bidnerf.cli.options import Json
from bidnerf.cli.output import print_json, print_table
from bidnerf.cli.parser import Option
from bidnerf_core.registry import GROUPS, PluginInfo, list_plugins
from bidnerf_core.settings import OneOf


def run_plugins(
    group: Annotated[
        str | None,
        OneOf(GROUPS),
        Option("[GROUP]", f"one kind of plugin: {', '.join(GROUPS)}", "all kinds", positional=True),
    ] = None,
    json: Json = False,
) -> None:
    """List all plugins: backends, readers, methods, commands and others."""
    groups = list(GROUPS) if group is None else [group]
    _print_infos([info for of in groups for info in list_plugins(of)], json, "group", all_kinds=group is None)


def run_backends(json: Json = False) -> None:
    """List the installed kinds of field."""
    _print_infos(list_plugins("backends"), json)


def _print_infos(infos: list[PluginInfo], json: bool, *more: str, all_kinds: bool = False) -> None:
    """Print plugins as a table, with their faults if any, or as a JSON list whose entries also have the keys in ``more``."""
    if json:
        keys = (*more, "name", "summary", "distribution", "version", "value", "fault")
        print_json([{key: getattr(info, key) for key in keys} for info in infos])
        return
    table = [[*([info.group] if all_kinds else []), info.name, info.description] for info in infos]
    print_table([*(["group"] if all_kinds else []), "name", "summary"], table, wide="summary")
