"""``bidnerf bake``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.common import MapFolder, option, parse, read_views, say
from bidnerf_core.cli.progress import counted
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.mapping import BakeConfig, bake
from bidnerf_core.storage import cameras_of, load_info, load_map, save_surface


def run(arguments: list[str]) -> None:
    """Parse and bake."""
    parse("bake", _bake, arguments)


def _bake(
    map: MapFolder,
    data: Annotated[
        Path | None,
        option("DATA", "dataset whose measured depth is taken where there is some", "rendered depth only"),
    ] = None,
    split: Annotated[str, option("NAME", "which of the dataset's splits")] = "train",
    config: BakeConfig = BakeConfig(),
) -> None:
    """Find the surface that a map shows, and store it in the map.

    Depth is rendered from where the training images were taken; what several of these views agree on is kept. With
    --data, views with measured depth are taken as they are instead; of views without, an imported map takes the places.
    """
    background = load_info(map).bounds.background
    views = [] if data is None else read_views(open_dataset(data, background), split)
    bake_map(map, views, config)


def bake_map(folder: Path, views: Sequence[View], config: BakeConfig) -> None:
    """Bake the map in ``folder``; of ``views``, those with measured depth take the place of rendered ones."""
    began = time.monotonic()
    stored = load_map(folder, surface=False)  # which may be damaged, and is to be replaced
    measured = [view for view in views if view.frame.has_depth]
    places = [(view.frame.intrinsics, view.T_ref_camera) for view in views]
    if not any(view.frame.has_dense_depth for view in measured):
        measured = []  # a few points are no surface
    cameras = [] if measured else cameras_of(stored.info) or places
    if not (measured or cameras):
        raise InputError(
            f"{folder}: holds no cameras to render it from; give a dataset of its views by --data"
        )
    with counted("baking", "views") as report:
        surface = bake(stored.field, stored.bounds, cameras, measured, config, report)
    save_surface(folder, stored.info, surface)
    source = f"{len(measured)} measured" if measured else f"{len(cameras)} rendered"
    say(
        f"{folder}: surface of {len(surface.surfels)} pieces from {source} views, {time.monotonic() - began:.1f} s"
    )
