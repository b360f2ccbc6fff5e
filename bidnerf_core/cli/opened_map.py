"""Opening the map that a command works with, and recognising one whose training was interrupted."""

from __future__ import annotations

from pathlib import Path

from bidnerf_core.cli.output import say
from bidnerf_core.errors import InputError
from bidnerf_core.maps.description import load_info
from bidnerf_core.maps.map import Map, load_map


def opened_map(folder: Path) -> Map:
    """Return the map in ``folder``, and print a remark if its training is not complete."""
    stored = load_map(folder)
    if not stored.info.complete:
        say(f"{folder}: {_stopped(stored.info.step)}")
    return stored


def unfinished(folder: Path) -> str | None:
    """Return what a folder holds, if it is a map whose training was interrupted."""
    try:
        info = load_info(folder)
    except InputError:
        return None
    return None if info.complete else f"holds a map, and {_stopped(info.step)}"


def _stopped(step: int) -> str:
    return f"its training stopped at step {step}; 'bidnerf train' with --resume goes on with it"
