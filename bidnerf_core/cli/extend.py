"""``bidnerf extend``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf_core.cli.options import BakeSettings, MapFolder, require
from bidnerf_core.cli.output import show
from bidnerf_core.cli.parser import Option, Without, parse
from bidnerf_core.cli.progress import working
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import UsageError, amount

if TYPE_CHECKING:
    from bidnerf_core.datasets import Capture


@dataclass(frozen=True)
class Extend:
    """Add photos of the same scene to a map: localize them, continue training the field, and update landmarks and surface.

    Photos are left out if they cannot be read, if they are not localized in the map, or if the map was built from them. The map
    is replaced only when everything is done: after Ctrl-C, or a kill, it is unchanged, and localizers may keep reading it
    meanwhile.
    """

    map: MapFolder
    new: Annotated[
        Path,
        Option("NEW", "photo, folder of photos, or dataset (whose own poses are ignored)", positional=True),
    ]
    data: Annotated[
        Path | None,
        Option(
            "DATA", "dataset that the map was built from", "none: images rendered by the field replace it"
        ),
    ] = None
    steps: Annotated[
        int | None,
        Option(
            "N", "training steps", "in proportion to the new photos, at least a quarter of the usual number"
        ),
    ] = None
    images: Annotated[DatasetOptions, Without("masks", "mask_hides", "largest", "background")] = (
        DatasetOptions()
    )
    config: BakeSettings = None
    """settings of the surface and the landmarks"""

    def run(self) -> None:
        from bidnerf_core.datasets import find_reader
        from bidnerf_core.maps import extend, load_info

        if self.steps is not None:
            require("--steps", self.steps, 1)
        info, images = load_info(self.map), self.images
        given = {
            "--camera": images.camera, "--register-depth": images.register_depth, "--depth-unit": images.depth_unit
        }  # fmt: skip
        stated = [name for name, value in given.items() if value is not None]
        paths = [self.new] if self.data is None else [self.new, self.data]
        datasets = [path for path in paths if stated and find_reader(path) is not None]
        if stated and not datasets:
            raise UsageError(f"{stated[0]} is for a dataset, but {self.new} is none; leave it out")
        options = replace(images, background=info.bounds.background)
        opened: dict[Path, Path | Capture] = {path: options.open(path) for path in datasets}
        data = None if self.data is None else opened.get(self.data, self.data)
        with working():
            scene = extend(
                self.map, opened.get(self.new, self.new), data, split=images.split, steps=self.steps, config=self.config,
            )  # fmt: skip
        added, total = len(scene.info.cameras) - len(info.cameras), len(scene.info.cameras)
        show(f"{self.map}: {amount(added, 'photo')} added, {amount(total, 'image')} in all")


def run(arguments: list[str]) -> None:
    parse("extend", Extend, arguments).run()
