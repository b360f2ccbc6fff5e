"""``bidnerf bake``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.options import BakeSettings, Device, MapFolder
from bidnerf_core.cli.parser import Flag, Option, Without
from bidnerf_core.cli.progress import working
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import UsageError


def run(
    map: MapFolder,
    data: Annotated[
        Path | None,
        Option(
            "DATA",
            "dataset whose photos give landmarks and whose measured depth gives the surface",
            "rendered images only",
        ),
    ] = None,
    rendered_landmarks: Annotated[
        Flag, Option(None, "replace landmarks of photos by landmarks of rendered images")
    ] = False,
    landmark_features: Annotated[
        str | None,
        Option("NAME", "detector of the landmarks, one of 'bidnerf plugins features'", "the map's"),
    ] = None,
    device: Device = "cpu",
    *,
    images: Annotated[DatasetOptions, Without("background")],
    config: BakeSettings = None,
) -> None:
    """Find the surface and the landmarks of a map, and store them in the map.

    Depth is rendered from the poses of the training images; what several of these views agree on is kept. With --data,
    measured depth is used directly where views have it, and landmarks are built from the photos; without --data they are built
    from images rendered by the field, which are only as sharp as the field. Landmarks from photos are kept unless --data gives
    new photos or --rendered-landmarks is set.
    """
    from bidnerf_core.mapping import find_features
    from bidnerf_core.maps import load_map

    if rendered_landmarks and data is not None:
        raise UsageError(
            "--rendered-landmarks uses no photos, but --data gives some;", expected="only one of them"
        )
    if images.masks is not None and data is None:
        raise UsageError("--masks was given without --data", expected="the dataset that they belong to")
    if landmark_features is not None:
        find_features(landmark_features)
    # The parts that are baked may be damaged, and are replaced anyway.
    scene = load_map(map, device, baked=False)
    with working():
        scene.bake(
            data, config, images=images, rendered_landmarks=rendered_landmarks, features=landmark_features
        )
