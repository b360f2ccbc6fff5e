"""The commands ``bidnerf plugins``, ``bidnerf backends`` and ``bidnerf doctor``, which describe what is installed."""

from __future__ import annotations

import platform
from importlib.metadata import metadata, version
from typing import Annotated, Any

from bidnerf.cli.options import Json
from bidnerf.cli.output import print_json, print_table, show
from bidnerf.cli.parameters import Option
from bidnerf_core.errors import InputError
from bidnerf_core.installation import requirements
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
    """List the installed backends, the kinds of field."""
    _print_infos(list_plugins("backends"), json)


def run_doctor(json: Json = False) -> None:
    """Describe the installation: versions, devices, extras and plugins.

    Please attach the output to bug reports. The exit status is 1 if a package that bidnerf requires is missing, or has a version that is not supported.
    """
    needed = requirements()
    broken = [requirement for requirement in needed if not requirement.is_met]
    extras = {
        name: [each for each in requirements(name) if not each.is_met]
        for name in metadata("bidnerf").get_all("Provides-Extra") or ()
        if name != "all"
    }
    plugins = list[str]()
    for group, noun in GROUPS.items():
        try:
            listed = [info for info in list_plugins(group) if not info.is_bundled or info.fault]
            plugins += [f"{noun} {info.name}: {info.description}" for info in listed]
        except InputError as error:  # such as a table that cannot be imported
            plugins.append(f"{group}: {error}")
    found: dict[str, Any] = {
        "bidnerf": version("bidnerf"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "devices": [] if broken else _devices(),
        "packages": {requirement.name: requirement.installed for requirement in needed},
        "extras": {name: not unmet for name, unmet in extras.items()},
        "plugins": plugins,
    }
    if json:
        print_json(found)
    else:
        rows = [[name, str(found[name])] for name in ("bidnerf", "python", "platform")]
        rows += [["device", device] for device in found["devices"]]
        rows += [[requirement.name, requirement.installed or "missing"] for requirement in needed]
        rows += [
            [
                f"extra {name}",
                (", ".join(str(each) for each in unmet if each.installed) if unmet else "installed")
                or f"not installed; pip install 'bidnerf[{name}]' adds it",
            ]
            for name, unmet in extras.items()
        ]
        for name, text in [*rows, *(["plugin", text] for text in plugins)]:
            show(f"{name:<22}  {text}")  # a line each at any width of the terminal, since it is pasted into reports
    if broken:
        raise InputError(f"{broken[0]}; pip install -U bidnerf")


def _devices() -> list[str]:
    """Return the devices on which fields can compute, with the names of GPUs, or the reason why torch cannot be used."""
    try:
        import torch
    except (ImportError, OSError) as error:  # OSError: a shared library is missing
        return [f"torch cannot be imported ({' '.join(str(error).split())})"]
    gpus = [f"cuda:{i}, {torch.cuda.get_device_name(i)}" for i in range(torch.cuda.device_count())]
    return ["cpu", *gpus, *(["mps"] if torch.backends.mps.is_available() else [])]


def _print_infos(infos: list[PluginInfo], json: bool, *more: str, all_kinds: bool = False) -> None:
    """Print plugins as a table, with their faults if any, or as a JSON list whose entries also have the keys in ``more``."""
    if json:
        keys = (*more, "name", "summary", "distribution", "version", "value", "fault")
        print_json([{key: getattr(info, key) for key in keys} for info in infos])
        return
    table = [[*([info.group] if all_kinds else []), info.name, info.description] for info in infos]
    print_table([*(["group"] if all_kinds else []), "name", "summary"], table, wide="summary")
