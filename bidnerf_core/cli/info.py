"""``bidnerf info``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from bidnerf_core.cli.common import Flag, MapFolder, option, parse, print_json, show
from bidnerf_core.field import levels
from bidnerf_core.serialization import to_plain
from bidnerf_core.storage import load_map


def run(arguments: list[str]) -> None:
    parse("info", info, arguments)


def info(map: MapFolder, json: Annotated[Flag, option(None, "print one JSON object", "")] = False) -> None:
    """Describe a map. It is loaded whole, so that damage is found here."""
    facts = describe(map)
    if json:
        print_json(facts)
        return
    for key, value in facts.items():
        show(f"{key + ':':<12} {_shown(value)}")


def describe(folder: Path) -> dict[str, Any]:
    """Return what ``bidnerf info`` shows of the map in ``folder``."""
    stored = load_map(folder)
    info = stored.info
    parameters = sum(p.numel() for p in stored.field.parameters())  # type: ignore[attr-defined]
    return {
        "map": str(folder),
        "backend": info.backend,
        "data": info.data,
        "cameras": len(info.cameras),
        "step": info.step,
        "complete": info.complete,
        "seconds": round(info.seconds, 1),
        "levels": len(levels(stored.field)),
        "parameters": parameters,
        "surfels": 0 if stored.surface is None else len(stored.surface.surfels),
        "landmarks": 0 if stored.landmarks is None else len(stored.landmarks),
        "trial": None if stored.landmarks is None else to_plain(stored.landmarks.trial),
        "bytes": sum(file.stat().st_size for file in folder.iterdir() if file.is_file()),
        "bounds": to_plain(info.bounds),
        "config": info.config,
        "bidnerf": info.bidnerf,
    }


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(item)}" for key, item in value.items())
    if isinstance(value, list):
        return "(" + ", ".join(_shown(item) for item in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
