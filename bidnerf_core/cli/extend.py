"""``bidnerf extend``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bidnerf_core.cli.options import MapFolder, option, parse, require
from bidnerf_core.cli.output import show
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c
from bidnerf_core.errors import amount
from bidnerf_core.mapping import BakeConfig
from bidnerf_core.maps.description import load_info
from bidnerf_core.maps.extending import extend as extend_map


def run(arguments: list[str]) -> None:
    parse("extend", extend, arguments)


def extend(
    map: MapFolder,
    new: Annotated[
        Path,
        tyro.conf.Positional,
        option("NEW", "photo, folder of photos, or dataset, whose own poses are not used"),
    ],
    data: Annotated[
        Path | None,
        option(
            "DATA",
            "dataset that the map was made of",
            "none: what the field renders stands in for its images",
        ),
    ] = None,
    split: Annotated[str, option("NAME", "split of the datasets")] = "train",
    steps: Annotated[
        int | None,
        option(
            "N", "training steps", "in proportion to the new photos, a quarter of the usual ones at least"
        ),
    ] = None,
    config: BakeConfig = BakeConfig(),
) -> None:
    """Add photos of its scene to a map: locate them, train the field on, and complete landmarks and surface.

    Photos that cannot be read, that the map does not recognise, or that it was made of, are left out. The map is replaced once
    all is done: Ctrl-C, or a kill, leaves it as it was, and localizers may go on reading it.
    """
    if steps is not None:
        require("--steps", steps, 1)
    before = len(load_info(map).cameras)
    with stopped_by_ctrl_c() as cancel, Display() as progress:
        scene = extend_map(
            map,
            new,
            data,
            split=split,
            steps=steps,
            config=config,
            progress=progress,
            cancel=cancel,
        )
    added = len(scene.info.cameras) - before
    show(f"{map}: {amount(added, 'photo')} added, {amount(len(scene.info.cameras), 'image')} in all")
