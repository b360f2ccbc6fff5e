"""``bidnerf extend``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf_core.cli.options import BakeSettings, MapFolder
from bidnerf_core.cli.output import show
from bidnerf_core.cli.parser import Option, Without
from bidnerf_core.cli.progress import working
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import UsageError, amount
from bidnerf_core.settings import WholeNumbers

if TYPE_CHECKING:
    from bidnerf_core.datasets import Capture


def run(
    map: MapFolder,
    new: Annotated[
        Path,
        Option("NEW", "photo, folder of photos, or dataset (whose own poses are ignored)", positional=True),
    ],
    data: Annotated[
        Path | None,
        Option(
            "DATA", "dataset that the map was built from", "none: images rendered by the field replace it"
        ),
    ] = None,
    steps: Annotated[
        int | None,
        WholeNumbers(1),
        Option(
            "N", "training steps", "in proportion to the new photos, at least a quarter of the usual number"
        ),
    ] = None,
    *,
    images: Annotated[DatasetOptions, Without("masks", "mask_hides", "largest", "background")],
    config: BakeSettings = None,
) -> None:
    """Add photos of the same scene to a map: localize them, continue training the field, and update landmarks and surface.

    Photos are left out if they cannot be read, if they are not localized in the map, or if the map was built from them. The map
    is replaced only when everything is done: after Ctrl-C, or a kill, it is unchanged, and localizers may keep reading it
    meanwhile.
    """
    from bidnerf_core.datasets import find_reader
    from bidnerf_core.maps import extend, load_info

    info = load_info(map)
    given = {
        "--camera": images.camera, "--register-depth": images.register_depth, "--depth-unit": images.depth_unit
    }  # fmt: skip
    stated = [name for name, value in given.items() if value is not None]
    paths = [new] if data is None else [new, data]
    datasets = [path for path in paths if stated and find_reader(path) is not None]
    if stated and not datasets:
        raise UsageError(f"{stated[0]} is for a dataset, but {new} is none; leave it out")
    options = replace(images, background=info.bounds.background)
    opened: dict[Path, Path | Capture] = {path: options.open(path) for path in datasets}
    known = None if data is None else opened.get(data, data)
    with working():
        scene = extend(map, opened.get(new, new), known, split=images.split, steps=steps, config=config)
    added, total = len(scene.info.cameras) - len(info.cameras), len(scene.info.cameras)
    show(f"{map}: {amount(added, 'photo')} added, {amount(total, 'image')} in all")
