"""``bidnerf bake``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from bidnerf_core.cli.camera_options import (
    DatasetCamera,
    DatasetDepthUnit,
    MaskHides,
    Masks,
    RegisterDepth,
    depth_registration,
    mask_folder,
)
from bidnerf_core.cli.options import Device, Flag, Largest, MapFolder, option, parse
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c
from bidnerf_core.datasets import DatasetOptions, open_dataset
from bidnerf_core.errors import UsageError
from bidnerf_core.mapping import BakeConfig
from bidnerf_core.maps import load_map


def run(arguments: list[str]) -> None:
    parse("bake", bake, arguments)


def bake(
    map: MapFolder,
    data: Annotated[
        Path | None,
        option(
            "DATA",
            "dataset whose photos give landmarks and whose measured depth gives the surface",
            "rendered images only",
        ),
    ] = None,
    split: Annotated[str, option("NAME", "split of the dataset; all: every image")] = "train",
    camera: DatasetCamera = None,
    register_depth: RegisterDepth = None,
    depth_unit: DatasetDepthUnit = None,
    masks: Masks = None,
    mask_hides: MaskHides = "black",
    largest: Largest = None,
    rendered_landmarks: Annotated[
        Flag, option(None, "replace landmarks of photos by landmarks of rendered images", "")
    ] = False,
    landmark_features: Annotated[
        str | None,
        option("NAME", "detector of the landmarks, one of 'bidnerf plugins features'", "the map's"),
    ] = None,
    device: Device = "cpu",
    config: BakeConfig = BakeConfig(),
) -> None:
    """Find the surface and the landmarks of a map, and store them in the map.

    Depth is rendered from the poses of the training images; what several of these views agree on is kept.
    With --data, measured depth is used directly where views have it, and landmarks are built from the photos;
    without --data they are built from images rendered by the field, which are only as sharp as the field.
    Landmarks from photos are kept unless --data gives new photos or --rendered-landmarks is set.
    """
    if rendered_landmarks and data is not None:
        raise UsageError(
            "--rendered-landmarks uses no photos, but --data gives some;", expected="only one of them"
        )
    if masks is not None and data is None:
        raise UsageError("--masks was given without --data", expected="the dataset that they belong to")
    registration, hiding = depth_registration(register_depth), mask_folder(masks, mask_hides)
    scene = load_map(map, device, baked=False)  # its baked parts may be damaged, and are replaced anyway
    photos = None
    if data is not None:
        photos = open_dataset(
            data,
            scene.bounds.background,
            camera=camera,
            register_depth=registration,
            depth_unit=depth_unit,
            masks=hiding,
        )
    with stopped_by_ctrl_c() as cancel, Display() as progress:
        scene.bake(
            photos,
            config,
            images=DatasetOptions(split=split, largest=largest),
            rendered_landmarks=rendered_landmarks,
            features=landmark_features,
            progress=progress,
            cancel=cancel,
        )
