"""The images that ``localize`` and ``view`` look for: the user's own photos, or frames of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf_core.cli.options import Names, require, require_different, require_one
from bidnerf_core.cli.parser import Option
from bidnerf_core.errors import UsageError

if TYPE_CHECKING:
    from bidnerf_core.camera import CameraSource, Intrinsics
    from bidnerf_core.datasets import DatasetOptions, DepthPoints, QuerySource
    from bidnerf_core.io import Background


@dataclass(frozen=True)
class CameraOptions:
    """The camera of images whose format stores none (default: from EXIF or the map)."""

    focal: Annotated[float | None, Option("PX", "focal length in pixels of the image file")] = None
    hfov: Annotated[float | None, Option("DEG", "horizontal field of view of the upright image")] = None

    def __post_init__(self) -> None:
        require_one({"--focal": self.focal, "--hfov": self.hfov})

    def source(self, images: DatasetOptions, assumed: Sequence[Intrinsics] = ()) -> CameraSource:
        """Return the source of the cameras of single images."""
        from bidnerf_core.camera import CameraSource

        require_one({"--camera": images.camera, "--focal": self.focal, "--hfov": self.hfov})
        assert images.camera is None or isinstance(images.camera, str | Path)
        return CameraSource(images.camera, self.focal, self.hfov, tuple(assumed))


@dataclass(frozen=True)
class QueryOptions:
    """Photos and frames."""

    camera: CameraOptions = CameraOptions()
    depth: Annotated[
        tuple[Path, ...],
        Option("FILE...", "depth images or .npy files of the photos, in the same order, or matched by name"),
    ] = ()
    frame: Annotated[
        Names,
        Option(
            "NAME...", "frames of a dataset, together as a rig (default: each frame of the split on its own)"
        ),
    ] = ()
    window: Annotated[
        int, Option("K", "combine each frame with those before it in the split, K in all, as a rig")
    ] = 1

    def __post_init__(self) -> None:
        require_different("--frame", self.frame)
        require("--window", self.window, 1)
        if self.window > 1 and len(self.frame) > 1:
            raise UsageError(
                f"--window {self.window} with {len(self.frame)} frames",
                expected="one: the last of the window",
            )

    def open(
        self, paths: Sequence[Path], images: DatasetOptions, background: Background | None, assumed: Sequence[Intrinsics],
        points: DepthPoints | None = None,
    ) -> QuerySource:  # fmt: skip
        """Return the queries for the QUERY arguments: image files and folders of them, or one dataset.

        Raises ``InputError`` if there is nothing of either kind, and ``UsageError`` for options that belong to the other kind.
        """
        from bidnerf_core.datasets import Photos, depth_files, find_reader, photo_files
        from bidnerf_core.io import IMAGE_SUFFIXES

        is_dataset = (p.suffix.lower() not in IMAGE_SUFFIXES and find_reader(p) is not None for p in paths)
        if self.frame or any(is_dataset):
            return self._frames(paths, images, background, points)
        if self.window > 1:
            raise UsageError(f"--window {self.window} needs known relative poses", expected="a dataset")
        files = photo_files(paths, self.depth)
        _check_points(points, len(files), "photos; expected one photo")
        depth = depth_files(files, self.depth)
        for option, value in (("--depth-unit", images.depth_unit), ("--register-depth", images.registration)):
            if value and not self.depth:
                raise UsageError(
                    f"{option} was given without --depth", expected="the depth image that it belongs to"
                )
        options = replace(images, camera=self.camera.source(images, assumed), background=background)
        return Photos(files, options, depth, points)

    def _frames(
        self,
        paths: Sequence[Path],
        images: DatasetOptions,
        background: Background | None,
        points: DepthPoints | None,
    ) -> QuerySource:
        from bidnerf_core.datasets import DatasetFrames

        if len(paths) > 1:
            raise UsageError(f"{len(paths)} queries including a dataset", expected="only the dataset")
        given = {"--depth": self.depth or None, "--focal": self.camera.focal, "--hfov": self.camera.hfov}
        for option, value in given.items():
            if value is not None:
                raise UsageError(
                    f"{option} is for photos, but {paths[0]} is a dataset, which has its own; to use its images as"
                    " photos, name the files"
                )
        dataset = replace(images, background=background).open(paths[0])
        source = DatasetFrames(dataset, images.split, self.frame, self.window, points)
        _check_points(points, len(source.names), "frames; name one by --frame")
        return source


def _check_points(points: DepthPoints | None, queries: int, expected: str) -> None:
    if points is not None and points.sparse is None and queries > 1:
        raise UsageError(f"points of a single camera, but {queries} {expected}", where=points.path)
