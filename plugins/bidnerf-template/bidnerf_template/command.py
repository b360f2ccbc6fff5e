"""A command of one's own: ``bidnerf template-parameters MAP``."""

from __future__ import annotations

from bidnerf.cli import Json, MapFolder, print_json, show


def count_parameters(map: MapFolder, json: Json = False) -> None:
    """Count the parameters of a map's field."""
    from bidnerf import load_map  # here, so that --help does not wait for it

    count = sum(parameter.numel() for parameter in load_map(map).field.parameters())
    if json:
        print_json({"parameters": count})
    else:
        show(f"{map}: {count:,} parameters")
