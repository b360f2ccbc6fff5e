"""``bidnerf extend``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bidnerf_core.cli.camera_options import (
    DatasetCamera,
    DatasetDepthUnit,
    RegisterDepth,
    depth_registration,
)
from bidnerf_core.cli.options import MapFolder, option, parse, require
from bidnerf_core.cli.output import show
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c
from bidnerf_core.datasets import Dataset, find_reader, open_dataset
from bidnerf_core.errors import UsageError, amount
from bidnerf_core.mapping import BakeConfig
from bidnerf_core.maps import extend as extend_map
from bidnerf_core.maps import load_info


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
    camera: DatasetCamera = None,
    register_depth: RegisterDepth = None,
    depth_unit: DatasetDepthUnit = None,
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
    info = load_info(map)
    before = len(info.cameras)

    def opened(place: Path) -> Path | Dataset:
        given = camera, depth_registration(register_depth), depth_unit
        if given == (None, None, None) or find_reader(place) is None:
            return place
        return open_dataset(place, info.bounds.background, None, given[0], given[1], given[2])

    photos, images = opened(new), None if data is None else opened(data)
    if not any(isinstance(each, Dataset) for each in (photos, images)):
        _refuse_options(new, camera, register_depth, depth_unit)
    with stopped_by_ctrl_c() as cancel, Display() as progress:
        scene = extend_map(
            map,
            photos,
            images,
            split=split,
            steps=steps,
            config=config,
            progress=progress,
            cancel=cancel,
        )
    added = len(scene.info.cameras) - before
    show(f"{map}: {amount(added, 'photo')} added, {amount(len(scene.info.cameras), 'image')} in all")


def _refuse_options(new: Path, *given: object) -> None:
    """Raise ``UsageError`` for options of datasets if there is none."""
    names = "--camera", "--register-depth", "--depth-unit"
    for name, value in zip(names, given, strict=True):
        if value is not None:
            raise UsageError(f"{name} is for a dataset, but {new} is none; leave it out")
