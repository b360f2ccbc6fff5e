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
        option("NEW", "photo, folder of photos, or dataset (whose own poses are ignored)"),
    ],
    data: Annotated[
        Path | None,
        option(
            "DATA",
            "dataset that the map was built from",
            "none: images rendered by the field replace it",
        ),
    ] = None,
    split: Annotated[str, option("NAME", "split of the datasets")] = "train",
    steps: Annotated[
        int | None,
        option(
            "N", "training steps", "in proportion to the new photos, at least a quarter of the usual number"
        ),
    ] = None,
    config: BakeConfig = BakeConfig(),
) -> None:
    """Add photos of the same scene to a map: localize them, continue training the field, and update landmarks
    and surface.

    Photos are left out if they cannot be read, if they are not localized in the map, or if the map was built
    from them. The map is replaced only when everything is done: after Ctrl-C, or a kill, it is unchanged, and
    localizers may keep reading it meanwhile.
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
